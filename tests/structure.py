"""Measures of the package: lines by package and by kind, lengths of functions, files that a computation runs through.

    python tests/structure.py
    python tests/structure.py walks    # files of a refraction, a PSF and a training step; calls to a higher layer

Lines are those of the .py files. A body of a function is its lines after the docstring.
"""

import ast
import functools
import statistics
import sys
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import torch
from layers import FLOORS

import raytrace as rt
from raytrace.system.lens import media
from raytrace.tracing.trace import cross

PACKAGE = Path(__file__).parents[1] / "raytrace"
#: Packages that no other imports: measurements.
APART = ("bench",)
#: Computations whose files `walks` lists.
WALKS = ("read_lens", "refraction", 'psf(lens, "drt")', "optimize", "training step")
#: Of every function that `shared` decorates: its call is that of its caller.
_DECORATION = media.__code__


def lines_of_packages() -> Counter[str]:
    """Lines by package, a folder or a file directly under the package."""
    found = Counter()
    for path in PACKAGE.rglob("*.py"):
        package = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
        found[package] += len(path.read_text(encoding="utf-8").splitlines())
    return found


def lines_by_kind() -> Counter[str]:
    """Lines of the package by kind: docstrings, imports, signatures, comments, blank, and the rest, code."""
    counts = Counter()
    for path in PACKAGE.rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        lines, kinds = text.splitlines(), {}
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.Import | ast.ImportFrom):
                kinds |= dict.fromkeys(range(node.lineno, node.end_lineno + 1), "imports")
            elif isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
                if not isinstance(node, ast.Module):
                    kinds |= dict.fromkeys(range(node.lineno, node.body[0].lineno), "signatures")
                if ast.get_docstring(node) is not None:
                    docstring = node.body[0]
                    kinds |= dict.fromkeys(range(docstring.lineno, docstring.end_lineno + 1), "docstrings")
        for number, line in enumerate(lines, 1):
            plain = "blank" if not line.strip() else "comments" if line.lstrip().startswith("#") else "code"
            counts[kinds.get(number, plain)] += 1
    return counts


def lines_of_library() -> int:
    return sum(lines for package, lines in lines_of_packages().items() if package not in APART)


def body_lengths() -> dict[str, int]:
    """Lines of the body of every function, by "package/file.py:line name"."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                place = f"{path.relative_to(PACKAGE)}:{node.lineno} {node.name}"
                found[place] = _body_length(node)
    return found


def _body_length(function: ast.FunctionDef) -> int:
    body = function.body[ast.get_docstring(function) is not None :]
    return body[-1].end_lineno - body[0].lineno + 1 if body else 0


def median_body() -> float:
    return statistics.median(body_lengths().values())


def walked(run: Callable[[], object]) -> tuple[set[str], set[tuple[str, str]]]:
    """The files of the package whose functions run, and the calls (from, to) that go up to a higher floor."""
    files, upward = set(), set()

    def inside(frame) -> str | None:
        path = Path(frame.f_code.co_filename)
        return path.relative_to(PACKAGE).as_posix() if path.is_relative_to(PACKAGE) else None

    def profile(frame, event, argument) -> None:
        if event != "call" or (name := inside(frame)) is None:
            return
        files.add(name)
        caller = frame.f_back
        while caller and (inside(caller) is None or caller.f_code is _DECORATION):
            caller = caller.f_back
        if caller and _floor(name) > _floor(inside(caller)):
            upward.add((inside(caller), name))

    sys.setprofile(profile)
    try:
        run()
    finally:
        sys.setprofile(None)
    return files, upward


def _floor(name: str) -> int:
    return FLOORS[name.split("/")[0].removesuffix(".py")]


@functools.cache
def walks() -> dict[str, Callable[[], object]]:
    """One refraction at a sphere, the PSF of traced rays, a cycle of optimize, and a training step."""
    lens = rt.read_lens("double_gauss").at(object_distance=25e3, fields=[0, 5])  # rays fill the stop: no warning
    first, second = media(lens, lens.wavelengths[:1])[:2]
    start, along = (torch.tensor(v, dtype=torch.float64)[:, None] for v in ([0.0, 5.0, 0.0], [0.0, 0.0, 1.0]))
    camera = rt.Camera(rt.Variables(lens, "curvature:1-4 sensor"), rt.imaging.RedNet(), model="gaussian")
    pictures, distances = torch.rand(2, 84, 84), torch.tensor([2e4, 3e4], dtype=torch.float64)
    rays = rt.system.Rays(start, along, torch.ones(1, dtype=torch.bool))
    rt.tracing.prepare()  # the compiled trace, whatever this machine has compiled before
    camera(pictures, distances)  # the sampling is chosen at the first call
    psf, read_lens = rt.psf, rt.read_lens
    optimize, triplet = rt.optimize, rt.read_lens("cooke_triplet")
    return {
        "read_lens": lambda: read_lens("double_gauss"),
        "refraction": lambda: cross(lens.surfaces[1], rays, None, 1, first, second),
        'psf(lens, "drt")': lambda: psf(lens, "drt"),
        "optimize": lambda: optimize(triplet, merit="spot", vary="curvature", cycles=1),
        "training step": lambda: (camera(pictures, distances) - camera.target(pictures)).abs().mean().backward(),
    }


def tell_walks() -> None:
    for name, run in walks().items():
        files, upward = walked(run)
        work = sorted(file for file in files if _floor(file) >= FLOORS["tracing"])
        print(f"{name}: {len(files)} files, {len(work)} of them from tracing/ up, {len(upward)} calls upward")
        print(f"  {' '.join(sorted(files))}")


def main() -> None:
    packages, lengths = lines_of_packages(), body_lengths()
    for package, lines in sorted(packages.items(), key=lambda one: -one[1]):
        print(f"{lines:7,} {package}")
    print(
        f"{sum(packages.values()):7,} lines, {lines_of_library():,} of them the library (all but {' and '.join(APART)})"
    )
    print("        " + ", ".join(f"{lines:,} {kind}" for kind, lines in lines_by_kind().most_common()))
    median, long = statistics.median(lengths.values()), sum(length > 25 for length in lengths.values())
    print(f"{len(lengths):7,} functions, median body {median:g} lines, {long} of more than 25")
    for place, length in sorted(lengths.items(), key=lambda one: -one[1])[:5]:
        print(f"{length:7,} {place}")


if __name__ == "__main__":
    tell_walks() if "walks" in sys.argv[1:] else main()

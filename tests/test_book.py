"""The book: its notebooks run, are short, assert their figures, and mention only names and commands that exist."""

import builtins
import importlib
import inspect
import os
import pkgutil
import re
import shlex
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch

import raytrace as rt
from raytrace.cli import build_parser
from raytrace.cli.commands import COMMANDS

DOCS = Path(__file__).parents[1] / "docs"
TUTORIALS = sorted((DOCS / "tutorials").glob("*.md"))
PAGES = [
    DOCS / "index.md",
    *(page for name in ("start", "tutorials", "reference") for page in (DOCS / name).glob("*.md")),
]
CELL = re.compile(r"^```\{code-cell\} *\w*\n((?::.*\n)*)(.*?)^```$", re.M | re.S)
NOTEBOOKS = [page for page in PAGES if CELL.search(page.read_text("utf-8"))]
#: Seconds of a tutorial.
BUDGET = 60


def name_of(page: Path) -> str:
    return str(page.relative_to(DOCS))


def code(page: Path) -> str:
    """The cells of a notebook, one program."""
    return "\n".join(match[2] for match in CELL.finditer(page.read_text("utf-8")))


def commands(page: Path) -> list[str]:
    """The lines of the shell blocks of a page that call raytrace."""
    blocks = re.findall(r"^```(?:sh|bash|console)\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [line.removeprefix("$ ") for line in lines if line.removeprefix("$ ").startswith("raytrace ")]


@pytest.mark.slow
@pytest.mark.parametrize("page", NOTEBOOKS, ids=name_of)
def test_notebook_runs_within_its_time(page, tmp_path):
    """In a process of its own and an empty folder. One thread: its processor time is the time on a free machine."""
    path = os.pathsep.join(filter(None, [str(DOCS.parent), os.environ.get("PYTHONPATH")]))
    environment = {**os.environ, "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1", "PYTHONPATH": path}
    (tmp_path / "notebook.py").write_text(code(page), "utf-8")
    rt.tracing.prepare()  # once for a machine, no part of the tutorial
    before = os.times()
    process = subprocess.run(
        [sys.executable, "notebook.py"], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
    )
    after = os.times()
    assert process.returncode == 0, process.stderr[-4000:]
    assert after.children_user + after.children_system - before.children_user - before.children_system < BUDGET


@pytest.mark.parametrize("page", TUTORIALS, ids=name_of)
def test_tutorial_asserts_its_figures(page):
    text = page.read_text("utf-8")
    assert re.match(r"---\nfile_format: mystnb\nkernelspec:\n  name: python3\n---\n\n# \w", text)
    assert len(re.findall(r"^\s*assert ", code(page), re.M)) >= 3
    compile(code(page), name_of(page), "exec")


def test_tutorials_are_numbered_and_in_the_table_of_contents():
    assert "\ntutorials/*\n" in (DOCS / "index.md").read_text("utf-8")
    numbers = [page.name[:2] for page in TUTORIALS]
    assert len(numbers) == len({*numbers})
    assert all(re.match(r"\d\d_[a-z_]+\.md$", page.name) for page in TUTORIALS)


@pytest.mark.parametrize("page", PAGES, ids=name_of)
def test_names_and_commands_of_a_page_exist(page):
    text = page.read_text("utf-8")
    for name in re.findall(r"\brt\.([A-Za-z_]\w*)", text):
        assert name == "NAME" or hasattr(rt, name), f"rt.{name}"
    known = {command.name for command in COMMANDS}
    for name in re.findall(r"`raytrace ([a-z][\w-]*)", text):
        assert name in known, f"raytrace {name}"
    for line in commands(page):
        words = shlex.split(line, comments=True)
        assert build_parser().parse_args(words[1:]).command == words[1], line


def failing(folder: Path) -> dict:
    """Calls that raise, or warn, each by the name of its class."""
    text = (DOCS.parent / "lenses" / "cooke_triplet.zmx").read_text("utf-8")
    (folder / "grid.zmx").write_text(text.replace("TYPE STANDARD", "TYPE GRID_SAG", 1), "utf-8")
    lens, triplet = rt.read_lens("double_gauss"), rt.read_lens("cooke_triplet")
    row = {"radius": 50, "thickness": 5}
    (folder / "minima").mkdir()
    (folder / "minima" / "search.jsonl").write_text('{"seed": 1}\n', "utf-8")
    pinhole = triplet.replace(triplet.stop, apertures=(rt.system.Aperture("circular", (0.0, 1.5)),))
    return {
        "LensFileError": lambda: rt.read_lens("lens.xyz"),
        "UnsupportedSurface": lambda: rt.read_lens("grid.zmx"),
        "UnknownGlass": lambda: rt.lens([row | {"glass": "N-BK77"}, row], stop=1, f_number=5),
        "BadPrescription": lambda: rt.lens([row | {"glas": "N-BK7"}, row], stop=1, f_number=5),
        "BadMerit": lambda: rt.search(triplet),
        "NoProblem": lambda: rt.search(triplet, merit="spot", vary="curvature", starts=0),
        "BadSearch": lambda: rt.search(triplet, merit="spot", vary="curvature", starts=0, folder="minima"),
        "BadTolerance": lambda: rt.tolerancing.perturbed(
            triplet, [rt.system.Tolerance("radius", (40,), -0.1, 0.1)], [0.0]
        ),
        "OutOfReach": lambda: rt.wavefront(triplet, fields=[80]),
        "NoFocus": lambda: rt.focus(triplet, fields=[80]),
        "NothingToShow": lambda: rt.distortion(triplet, fields=[0]),
        "LostRays": lambda: rt.spot(lens, fields=[80]),
        "UnfilledStop": lambda: rt.spot(lens),
        "Incomplete": lambda: rt.wavefront(pinhole, fields=[0]),
    }


def test_page_of_errors_shows_the_messages(tmp_path, monkeypatch):
    """Of the classes that users meet most."""
    monkeypatch.chdir(tmp_path)
    page = (DOCS / "reference" / "errors.md").read_text("utf-8")
    shown = page.partition("## Other classes")[0]
    rows = dict(re.findall(r"^\| `rt\.(\w+)` \| (.*?) \|", shown, re.M))
    calls = failing(tmp_path)
    assert calls.keys() == rows.keys()
    for name, call in calls.items():
        kind, words = rt.public_name(name), rows[name].removesuffix("…")
        with warnings.catch_warnings(record=True) as issued:
            warnings.simplefilter("always")
            if issubclass(kind, Warning):
                call()
                messages = [str(warning.message) for warning in issued if warning.category is kind]
            else:
                with pytest.raises(kind) as raised:
                    call()
                messages = [str(raised.value)]
        assert any(message.startswith(words) for message in messages), (name, messages)


def test_page_of_errors_lists_every_class():
    page = (DOCS / "reference" / "errors.md").read_text("utf-8")
    listed = {*re.findall(r"^\| `rt\.(\w+)` \|", page, re.M)}
    assert listed == {*rt.ERRORS}


def test_every_error_of_the_package_is_one_of_the_table_and_one_of_python():
    for module in pkgutil.walk_packages(rt.__path__, "raytrace."):
        if not module.name.startswith(("raytrace.__main__", "raytrace.bench")):
            importlib.import_module(module.name)
    kinds, left = set(), [rt.RaytraceError, rt.RaytraceWarning]
    while left:
        kind = left.pop()
        kinds.add(kind)
        left += kind.__subclasses__()
    kinds -= {rt.RaytraceError, rt.RaytraceWarning}
    package = {kind for kind in kinds if kind.__module__.startswith("raytrace.")}
    assert {kind.__name__ for kind in package if not kind.__name__.startswith("_")} == {*rt.ERRORS}
    python = (ValueError, LookupError, OSError, ImportError, RuntimeError, ArithmeticError, UserWarning)
    assert all(issubclass(kind, python) for kind in package)


def test_errors_that_docstrings_name_can_be_caught_by_that_name():
    for name in rt.PUBLIC:
        for sentence in re.findall(r"(?:Raises|Warns) ([^.]*)", rt.public_name(name).__doc__ or ""):
            for word in re.findall(r"\b[A-Z][a-z]+[A-Z]\w+", sentence):
                assert hasattr(rt, word) or hasattr(builtins, word), (name, word)


def test_expressions_of_coming_from_another_program_run(tmp_path, monkeypatch):
    """Complete expressions in the column of raytrace; alone, an option is one of a public function or of `Lens.at`."""
    page = (DOCS / "start" / "coming_from.md").read_text("utf-8")
    cells = re.findall(r"^\|[^|]+\|([^|]+)\|$", page, re.M)
    code = {text for cell in cells for text in re.findall(r"`([^`]+)`", cell) if "…" not in text}
    calls = {text for text in code if re.match(r"(rt|lens)\..*\)", text)}
    monkeypatch.chdir(tmp_path)
    names = {
        "rt": rt,
        "torch": torch,
        "lens": rt.read_lens("double_gauss"),
        "images": torch.ones(1, 9, 9),
        "kernels": torch.ones(3, 3),
    }
    for text in sorted(calls - {'rt.psf(lens, "wave")', "rt.Camera(variables, network)", "rt.spot(lens, rays=10**9)"}):
        if "cuda" in text and not torch.cuda.is_available():
            continue
        of = {"lens": rt.read_lens("scan_lens")} if "configuration" in text else {}
        assert eval(text, names | of) is not None or ".save(" in text, text
    assert len(calls) >= 10
    known = {name for verb in rt.PUBLIC for name in options(rt.public_name(verb))} | {*options(names["lens"].at)}
    options_alone = {match[1] for text in code if (match := re.match(r"(\w+)=", text))}
    assert options_alone - {"entrance_pupil_diameter"} <= known
    assert {"vary", "ray_aiming", "geometric", "through_focus", "numbering"} <= options_alone
    words = next(text for text in code if text.startswith("vary=")).removeprefix("vary=").strip('"')
    tessar = rt.read_lens("tessar")
    result = rt.optimize(tessar, merit="spot", vary=words, cycles=1)
    assert abs(float(result.lens.surfaces[4].curvature + result.lens.surfaces[3].curvature)) < 1e-15


def options(function) -> list[str]:
    return [*inspect.signature(function).parameters] if inspect.isroutine(function) else []


@pytest.mark.slow
def test_book_builds_without_warnings(tmp_path):
    pytest.importorskip("myst_nb", reason="needs the extra [docs]")
    pytest.importorskip("furo", reason="needs the extra [docs]")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "-W",
        "-q",
        "-d",
        str(tmp_path / "doctrees"),
        str(DOCS),
        str(tmp_path / "html"),
    ]
    process = subprocess.run(command, cwd=DOCS.parent, capture_output=True, text=True, timeout=1800)
    assert process.returncode == 0, process.stderr[-4000:]

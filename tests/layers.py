"""The layers of the package, and its modules."""

import ast
import functools
import gc
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "raytrace"

#: Layer of every package, a folder or a file directly under raytrace/; within one, imports have no cycles.
FLOORS = {
    # knows no optics: words of messages; files that travel with the package, processes that share one computation
    "words": -2,
    "files": -1,
    "budget": -1,
    "shards": -1,
    # how figures look; a figure is drawn by its result
    "plotting": 0,
    "maths": 1,
    "stores": 1,
    "settings": 1,
    # data and physics
    "materials": 2,
    "system": 3,
    # lens files
    "io": 4,
    # computations
    "tracing": 5,
    "stock": 6,
    "psf_models": 6,
    "edit": 7,
    "analysis": 7,
    "wave_optics": 7,
    "optimization": 8,
    "tolerancing": 9,
    "imaging": 10,
    "workshop": 10,
    "viewer": 11,
    "cli": 13,
    # the server of agents, and measurements: nothing imports them
    "agents": 14,
    "bench": 14,
    # the public API
    "public": 15,
    "__init__": 15,
    "__main__": 15,
}


def modules() -> dict[str, Path]:
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        name = ".".join(parts[:-1] if parts[-1] == "__init__" and len(parts) > 1 else parts)
        found[name] = path
    return found


MODULES = modules()


def package_of(name: str) -> str:
    return name.split(".")[0]


@functools.cache
def parsed(path: Path) -> ast.Module:
    gc.disable()  # half the time of parsing
    try:
        return ast.parse(path.read_text(encoding="utf-8"))
    finally:
        gc.enable()


def statements(node: ast.AST) -> Iterator[ast.AST]:
    """All statements of a module, class or function, with those of its branches and of what is defined in it."""
    for part in ("body", "orelse", "handlers", "finalbody", "cases"):
        for statement in getattr(node, part, ()):
            yield statement
            yield from statements(statement)

"""Names in docstrings: every dotted one in backticks is a module, or something of a module, a class or a lens."""

import ast
import functools
import importlib
import re
from pathlib import Path
from types import ModuleType

from test_layers import FLOORS, MODULES, PACKAGE, package_of, parsed

import raytrace

DOTTED = re.compile(r"`((?:\w+\.)+\w+)(?:\([^`]*)?`")
#: Ends of the names of files of code, which are there, and of files of data, which nothing holds against.
CODE, DATA = ("py", "cpp", "h"), ("csv", "json", "pt", "zmx")
#: Libraries, and other people's programs that a reader of their files speaks of.
ELSEWHERE = ("nn", "seq_model", "torch")
#: Packages whose modules any docstring may name; modules of the others are named within their package only.
LIBRARY = {*FLOORS} - {"bench", "cli", "plot"}


@functools.cache
def classes() -> list[tuple[str, str]]:
    """Classes, as (module, name)."""
    return [
        (name, node.name) for name in MODULES for node in parsed(MODULES[name]).body if isinstance(node, ast.ClassDef)
    ]


def named(name: str) -> set[str]:
    """The dotted names in the docstrings of a module."""
    nodes = (ast.Module, ast.ClassDef, ast.FunctionDef)
    texts = (ast.get_docstring(node) or "" for node in ast.walk(parsed(MODULES[name])) if isinstance(node, nodes))
    return {found for text in texts for found in DOTTED.findall(text)}


def module(name: str) -> ModuleType:
    return raytrace if name == "__init__" else importlib.import_module(f"raytrace.{name}")


def part(holder: object, word: str) -> object:
    """An attribute of a module or class, a module of a folder, or a field of a class. Raises AttributeError."""
    if hasattr(holder, "__path__") and not hasattr(holder, word):
        importlib.import_module(f"{holder.__name__}.{word}")
    return getattr(holder, "__annotations__", {}).get(word) or getattr(holder, word)


def is_there(dotted: str, name: str) -> bool:
    """Whether a dotted name in a docstring of a module is one, read from the module, its folder, or the package."""
    first, *words = dotted.removeprefix("raytrace.").split(".")
    if first in ELSEWHERE or words[-1:] in [[data] for data in DATA]:
        return True
    if words[-1:] in [[code] for code in CODE]:
        return any(PACKAGE.rglob(dotted)) or (Path(__file__).parent / dotted).exists()
    if dotted in MODULES or first == "rt":
        return dotted in MODULES or words[0] in raytrace.PUBLIC
    within = (package_of(name), *LIBRARY)
    homes = [module(one) for one in MODULES if one.split(".")[-1] == first and package_of(one) in within]
    homes += [getattr(home, first) for home in (module(name), raytrace) if hasattr(home, first)]
    homes += [
        getattr(module(where), one)
        for where, one in classes()
        if one in (first, first.capitalize()) and package_of(where) in within
    ]
    for home in homes:
        try:
            for word in words:
                home = part(home, word)
        except (AttributeError, ImportError):
            continue
        return True
    return False


def test_dotted_names_in_docstrings_are_there():
    """In all modules but those that need the extra [bench]."""
    names = [name for name in MODULES if not name.startswith("bench.peers")]
    assert [(name, dotted) for name in names for dotted in sorted(named(name)) if not is_there(dotted, name)] == []


def test_a_name_of_the_past_is_not_there():
    assert not is_there("psf.dft.Aliased", "wave_optics.plan")
    assert is_there("psf_models.dft.Aliased", "wave_optics.plan")

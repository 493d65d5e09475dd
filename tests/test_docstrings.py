"""Docstrings: every dotted name in backticks is a module, or something of a module, a class or a lens; examples run."""

import ast
import doctest
import functools
import importlib
import re
import textwrap
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
import torch
from layers import FLOORS, MODULES, PACKAGE, package_of, parsed

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


def definitions(node: ast.AST) -> Iterator[ast.AST]:
    """A module, class or function, and all that are defined within, also in its branches."""
    if isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef)):
        yield node
    for part in ("body", "orelse", "handlers", "finalbody"):
        for statement in getattr(node, part, ()):
            yield from definitions(statement)


@functools.cache
def texts(name: str) -> list[str]:
    """The docstrings of a module, its classes and functions."""
    return [ast.get_docstring(node) or "" for node in definitions(parsed(MODULES[name]))]


def named(name: str) -> set[str]:
    """The dotted names in the docstrings of a module."""
    return {found for text in texts(name) for found in DOTTED.findall(text)}


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
        word = words[1] if words[0] in raytrace.NAMESPACES and len(words) > 1 else words[0]
        return dotted in MODULES or word in raytrace.PUBLIC or word in raytrace.ERRORS
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
    assert [(name, dotted) for name in MODULES for dotted in sorted(named(name)) if not is_there(dotted, name)] == []


def test_a_name_of_the_past_is_not_there():
    assert not is_there("psf.dft.Aliased", "wave_optics.plan")
    assert is_there("psf_models.dft.Aliased", "wave_optics.plan")


#: An indented block of a docstring.
BLOCK = re.compile(r"(?:^ {4}.*\n?)+", re.MULTILINE)


def is_code(block: str) -> bool:
    """Whether a block is a session, or Python that calls something: formulas with calls do not parse."""
    try:
        return ">>> " in block or any(isinstance(node, ast.Call) for node in ast.walk(ast.parse(block)))
    except SyntaxError:
        return False


def examples(name: str) -> list[str]:
    """The examples in the docstrings of a module, the blocks of each docstring joined."""
    blocks = [[block for block in map(textwrap.dedent, BLOCK.findall(text)) if is_code(block)] for text in texts(name)]
    return ["\n".join(of_one) for of_one in blocks if of_one]


def given() -> dict:
    """The names that examples take as given, small."""
    torch.manual_seed(1)
    return {
        "rt": raytrace,
        "torch": torch,
        "lens": raytrace.read_lens("cooke_triplet"),
        "element": raytrace.wave_optics.phase_elements("ideal", aperture=1.0)[0],
        "network": raytrace.imaging.UNet(channels=3),
        "picture": torch.rand(3, 160, 240),
        "pictures": torch.rand(1, 3, 128, 128),
        "index": [0],
        "planes": range(3),
        "total": 10,
        "many": 5,
    }


#: Modules with examples, whose docstrings are read when the tests run.
EXAMPLES = ["__init__", "cli.progress", "imaging.camera", "imaging.render", "imaging.variables"]


def test_the_modules_with_examples_are_those_of_the_list():
    assert [name for name in MODULES if examples(name)] == EXAMPLES


@pytest.mark.parametrize("name", EXAMPLES)
def test_examples_in_docstrings_run(name):
    """Sessions print what they show; other examples run on the names of their module and on those of `given`."""
    for code in examples(name):
        names = vars(module(name)) | given()
        if ">>> " in code:
            session = doctest.DocTestParser().get_doctest(code, names, name, None, 0)
            assert not doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(session).failed
        else:
            exec(compile(code, f"an example of {name}", "exec"), names)

"""No computation calls a higher layer; no helper of the tests is written twice, or imported from a test module."""

import ast
import functools
from pathlib import Path
from typing import NamedTuple

import pytest
import structure
from layers import parsed, statements


@pytest.mark.parametrize("computation", structure.WALKS)
def test_a_computation_calls_no_higher_layer(computation):
    assert not structure.walked(structure.walks()[computation])[1]


class Parts(NamedTuple):
    """Of a test file."""

    helpers: dict[str, str]  # where the functions stand that are no tests, by the lines of their bodies
    modules: set[str]  # that it imports


@functools.cache
def parts(path: Path) -> Parts:
    """Bodies are without docstring and indentation; methods are left out."""
    text = path.read_text(encoding="utf-8")
    lines = [line.strip() for line in text.splitlines()]
    nodes = [*statements(parsed.__wrapped__(path))]  # the tree is not stored
    methods = {id(part) for node in nodes if isinstance(node, ast.ClassDef) for part in node.body}
    helpers, modules = {}, set()
    for node in nodes:
        if isinstance(node, ast.ImportFrom):
            modules.add(node.module)
        elif isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.FunctionDef) and not node.name.startswith("test_") and id(node) not in methods:
            body = node.body[ast.get_docstring(node) is not None :]
            helpers["\n".join(lines[body[0].lineno - 1 : node.end_lineno])] = f"{path.name}:{node.lineno} {node.name}"
    return Parts(helpers, modules)


FILES = sorted(Path(__file__).parent.glob("*.py"))


def test_no_two_test_files_define_the_same_helper():
    """A helper of two files is in problems.py, or a fixture in shared_fixtures.py."""
    places = {}
    for path in FILES:
        for text, place in parts(path).helpers.items():
            assert text not in places, f"the same function in {places[text]} and {place}"
            places[text] = place


def test_test_modules_import_helpers_alone():
    """A helper of two test modules is in problems.py, or in a module of helpers."""
    modules = {path.stem for path in FILES if path.name.startswith("test_")}
    for path in FILES:
        assert not parts(path).modules & modules, path.name

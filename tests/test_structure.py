"""No computation calls a higher layer; no helper of the tests is written twice, or imported from a test module."""

import ast
from collections import defaultdict
from pathlib import Path

import pytest
import structure
from layers import parsed


@pytest.mark.parametrize("computation", structure.WALKS)
def test_a_computation_calls_no_higher_layer(computation):
    assert not structure.walked(structure.walks()[computation])[1]


def helpers() -> dict[str, list[str]]:
    """Where the functions of all test files stand that are no tests, by the lines of their bodies without docstring and
    indentation; methods not."""
    found = defaultdict(list)
    for path in sorted(Path(__file__).parent.glob("*.py")):
        tree = parsed.__wrapped__(path)  # not stored
        lines = [line.strip() for line in path.read_text(encoding="utf-8").splitlines()]
        methods = {id(part) for node in ast.walk(tree) if isinstance(node, ast.ClassDef) for part in node.body}
        for node in ast.walk(tree):
            if isinstance(node, ast.FunctionDef) and not node.name.startswith("test_") and id(node) not in methods:
                body = node.body[ast.get_docstring(node) is not None :]
                text = "\n".join(lines[body[0].lineno - 1 : node.end_lineno])
                found[text].append(f"{path.name}:{node.lineno} {node.name}")
    return found


def test_no_two_test_files_define_the_same_helper():
    """A helper of two files is in problems.py, or a fixture in shared_fixtures.py."""
    for places in helpers().values():
        files = {place.partition(":")[0] for place in places}
        assert len(files) == 1, f"the same function in {places}"


def test_test_modules_import_helpers_alone():
    """A helper of two test modules is in problems.py, or in a module of helpers."""
    tests = sorted(Path(__file__).parent.glob("*.py"))
    modules = {path.stem for path in tests if path.name.startswith("test_")}
    for path in tests:
        tree = parsed.__wrapped__(path)  # not stored
        imports = {node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)}
        imports |= {alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names}
        assert not imports & modules, path.name

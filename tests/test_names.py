"""Local names say what they hold."""

import ast

import pytest
from layers import PACKAGE, parsed

#: Words that say nothing of what a variable holds.
EMPTY = {"one", "found", "at", "own", "of", "there", "such", "named"}


def bound_names(tree):
    """Names that a module binds, with their lines: variables, loop variables and arguments, but for options, whose
    name is read with their value, as in `of="points"`."""
    nodes = [*ast.walk(tree)]
    options = {id(option) for node in nodes if isinstance(node, ast.arguments) for option in node.kwonlyargs}
    for node in nodes:
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno
        elif isinstance(node, ast.arg) and id(node) not in options:
            yield node.arg, node.lineno


@pytest.mark.parametrize("folder", sorted(path.name for path in PACKAGE.iterdir() if any(path.glob("*.py"))))
def test_local_names_say_what_they_hold(folder):
    offenders = [
        f"{path.relative_to(PACKAGE)}:{line}: {name}"
        for path in sorted((PACKAGE / folder).rglob("*.py"))
        for name, line in bound_names(parsed(path))
        if name in EMPTY
    ]
    assert not offenders, "\n".join(offenders)

"""Options from the signatures and docstrings of public functions, read from their source. Imports no torch.

A parameter `name: int = 41` is the option `--name N`, and its entry "name: …" in the docstring the help text. A row
{setting: value} of `add_argument` replaces what does not follow from there: the spelling (flag), the type, the text.
"""

import argparse
import ast
import functools
import math
import re
from collections.abc import Mapping
from itertools import zip_longest
from pathlib import Path
from typing import NamedTuple

import raytrace
from raytrace.cli.types import count, positive_finite

_ROOT = Path(raytrace.__file__).parent
_PLAIN = ast.Constant, ast.Tuple, ast.Attribute, ast.expr_context, ast.UnaryOp, ast.USub  # parts of constants


class Parameter(NamedTuple):
    """A parameter of a function, or a field of a dataclass; annotation: as text; help: its entry in the docstring."""

    annotation: str
    default: object
    help: str = ""


@functools.cache
def parameters_of(verb: str) -> dict[str, Parameter]:
    """The parameters of a public function by their names."""
    function, constants = _definition(verb, raytrace.PUBLIC[verb].partition(":")[0])
    arguments = function.args
    given = [None] * (len(arguments.args) - len(arguments.defaults)) + [*arguments.defaults, *arguments.kw_defaults]
    every = [*arguments.args, *arguments.kwonlyargs]
    texts = entries(ast.get_docstring(function) or "", [argument.arg for argument in every])
    return {
        argument.arg: Parameter(
            ast.unparse(argument.annotation), _evaluated(default, constants), texts.get(argument.arg, "")
        )
        for argument, default in zip(every, given, strict=True)
    }


def _definition(name: str, module: str) -> tuple[ast.FunctionDef, dict]:
    """A function of a module, or of the one that the module imports it from, and the constants there."""
    path = _ROOT.joinpath(*module.split("."))
    source = (path / "__init__.py" if path.is_dir() else path.with_suffix(".py")).read_text(encoding="utf-8")
    constants: dict = {}
    for node in ast.parse(source).body:
        if isinstance(node, ast.FunctionDef) and node.name == name:
            return node, constants
        if isinstance(node, ast.ImportFrom) and any((alias.asname or alias.name) == name for alias in node.names):
            return _definition(name, node.module.removeprefix("raytrace."))
        if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name):
            if node.targets[0].id == name and isinstance(node.value, ast.Name):  # a former name
                return _definition(node.value.id, module)
            constants[node.targets[0].id] = _evaluated(node.value, constants)
    raise LookupError(f"{name} is not defined in {path}")


def _evaluated(node: ast.expr | None, constants: Mapping) -> object:
    """A default that is a constant; None for another."""
    names = {"math": math, **constants}
    plain = node is not None and all(
        part.id in names if isinstance(part, ast.Name) else isinstance(part, _PLAIN) for part in ast.walk(node)
    )
    return eval(compile(ast.Expression(node), "", "eval"), names) if plain else None


def entries(docstring: str, names: list[str]) -> dict[str, str]:
    """Texts of the entries "name: …" or "name, other: …" of a docstring, to the end of their sentence."""
    known = "|".join(names)
    start = re.compile(rf"(?:^ *|(?<=[.;] ))((?:{known})(?:,\s(?:{known}))*):\s", re.M)
    texts: dict[str, str] = {}
    for paragraph in docstring.split("\n\n"):
        found = [*start.finditer(paragraph)]
        for match, after in zip_longest(found, found[1:]):
            text = " ".join(paragraph[match.end() : after and after.start()].split())
            text = re.split(r"\. (?=[A-Z])", text)[0].rstrip(" .;").replace('"', "")
            text = re.sub(r"`(\w+)`", lambda word: flag(word[1]) if word[1] in names else word[1], text)
            texts |= dict.fromkeys(re.split(r",\s", match[1]), text)
    return texts


#: Options whose spelling is not that of the parameter: parameters of several values have singular options.
SPELLED = {
    **{"fields": "field", "wavelengths": "wavelength", "frequencies": "frequency", "radii": "radius"},
    **{"object_distances": "object-distance", "depths": "depth", "catalogs": "catalog", "conventions": "reading"},
    "yield_": "yield",
}


def flag(name: str) -> str:
    """The option of a parameter."""
    return f"--{SPELLED.get(name, name).replace('_', '-')}"


def add_parameter(
    group, name: str, parameter: Parameter, row: Mapping, *, keep_default: bool = True
) -> argparse.Action:
    """Add the option of a parameter: row, else the annotation and the docstring. Without the option the value is that
    of the default, or None; a help text that does not mention the default is completed by it."""
    settings = {
        **_reader(parameter.annotation),
        "help": parameter.help.replace("%", "%%"),
        "default": parameter.default,
    }
    settings |= {"flags": (f"--no-{flag(name)[2:]}",), "action": "store_false"} if parameter.default is True else {}
    settings |= row
    default, flags = settings.pop("default"), settings.pop("flags", (flag(name),))
    usual = " ".join(map(_shown, default)) if isinstance(default, tuple) else _shown(default)
    if usual and "action" not in settings and "default" not in settings["help"]:
        settings["help"] += f" (default {usual})"
    if flags[0].startswith("-"):
        settings["dest"] = name
        if keep_default:
            settings["default"] = [*default] if isinstance(default, tuple) else default
    return group.add_argument(*flags, **{key: value for key, value in settings.items() if value is not None})


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else "" if value in (None, "") else str(value)


def _reader(annotation: str) -> dict:
    """Settings of `add_argument` that follow from an annotation: whole numbers are positive, others also finite."""
    if choices := re.search(r"Literal\[(.*?)\]", annotation):
        return {"choices": ast.literal_eval(f"({choices[1]},)")}
    if annotation.startswith("bool"):
        return {"action": argparse.BooleanOptionalAction if "None" in annotation else "store_true"}
    several = {"nargs": "+"} if re.search("Sequence|Numbers|tuple", annotation) else {}
    if re.search(r"\bint\b", annotation):
        return {"type": count, "metavar": "N", **several}
    return ({"type": positive_finite} if re.search("float|Numbers|Tensor", annotation) else {}) | several

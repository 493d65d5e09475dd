"""The tools of agents: a row each. A tool is a command, and its options are the parameters. Imports no torch.

The JSON schema of a parameter follows from its `Option`: name, reader, choices, text and unit. To add a tool: a row of
`TOOLS` with the name of its command.
"""

import argparse
import functools
import re
import typing
from collections.abc import Mapping
from dataclasses import dataclass

from raytrace.cli import types
from raytrace.cli.commands import COMMANDS, Command
from raytrace.cli.options import OPTIONS, add
from raytrace.cli.types import OutputFile, OutputFolder
from raytrace.words import RaytraceError, did_you_mean, known_option

#: Given to the agent at the start, with the full texts of the parameters of `_BRIEF`.
_ABOUT = (
    "A sequential, differentiable ray tracer for lens design. Lenses are named by the name of a shipped lens (the tool "
    "lenses lists them) or by the path of a lens file relative to the folder of this server. Lengths are mm, "
    "wavelengths µm, angles degrees, unless stated otherwise; surfaces count from 1. The parameter json gives all "
    "figures in full precision, plot the picture. Switches are false by default. Parameters of several tools, in full:"
)

#: Texts of parameters that many tools have, in their schemas: an agent reads every schema in every conversation.
_BRIEF = {
    "configuration": "of a multi-configuration file, from 1",
    "catalog": "glass catalog to search first",
    "substitute": "another glass for one of the file, as SSK4=SSK4A",
    "json": "return a JSON document",
    "max_bytes": "memory limit, as 4GB",
    "magnification": "of the paraxial image: sets the object distance",
    "sensor_distance": "from the last vertex to the image",
    "f_number": "image-space F/#",
    "wavelengths": "the first is primary",
    "ray_aiming": "aim rays at the stop",
    "temperature": "of the lens and the air",
    "mount": "material of spacers without an expansion, as aluminium",
    "fields": "field points, y or [x, y], in the lens's kind of field",
}


@dataclass(frozen=True)
class Tool:
    """A command that agents may call; pictured: its figure is returned in any case."""

    name: str
    pictured: bool = False

    @property
    def command(self) -> Command:
        """The row of the command; of a subcommand as `stock_find`."""
        commands = [*COMMANDS, *(child for command in COMMANDS for child in command.subcommands)]
        return next(command for command in commands if command.verb == self.name)

    @functools.cached_property
    def parser(self) -> argparse.ArgumentParser:
        parser = argparse.ArgumentParser(add_help=False)
        add(parser, self.command.options)
        return parser

    @property
    def writes(self) -> bool:
        """Whether a parameter names a file or a folder to write."""
        return any(_is_output(action) for action in self.actions.values())

    @functools.cached_property
    def actions(self) -> dict[str, argparse.Action]:
        """Options by the name of the parameter; not those of figures that are saved, but for `plot`."""
        saved = [action for action in self.parser._actions if action.type is types.picture_file]
        return {action.dest: action for action in self.parser._actions if action.dest == "plot" or action not in saved}

    @property
    def description(self) -> str:
        """What the command does, without sentences on shells."""
        sentences = re.split(r"(?<=\.)\s+", f"{self.command.summary}. {self.command.description}")
        text = self._said(" ".join(s for s in sentences if not re.search("Ctrl-C|torchrun", s)))
        return text[0].upper() + text[1:]

    def in_parameters(self, text: str) -> str:
        """A text with the parameters in place of the options of a shell: `fields` for --field."""
        flags = {flag: row.name for row in OPTIONS.values() for flag in row.flag.split() if flag.startswith("-")}
        flags |= {flag: action.dest for action in self.actions.values() for flag in action.option_strings}

        def parameter(match: re.Match) -> str:
            return f"`{flags.get(match[0], match[0].lstrip('-').replace('-', '_'))}`"

        return re.sub(r"(?<![\w`-])--?[a-z][a-z-]*", parameter, text)

    def _said(self, text: str) -> str:
        """A text of the table in parameters: `in_parameters`, and `target` for OUT."""
        for action in self.actions.values():
            if not action.option_strings:
                text = re.sub(rf"\b{action.metavar}\b", f"`{action.dest}`", text)
        return self.in_parameters(text)

    def schema(self, *, in_full: bool = False) -> dict:
        """The JSON schema of the parameters; in_full: with the full texts of the parameters of `_BRIEF`."""
        properties = {name: self._parameter(action, in_full) for name, action in self.actions.items()}
        if self.writes:
            properties["overwrite"] = {"type": "boolean", "description": "replace files that exist, or resume"}
        required = [name for name, action in self.actions.items() if _is_required(action)]
        return {"type": "object", "properties": properties, "required": required, "additionalProperties": False}

    def _parameter(self, action: argparse.Action, in_full: bool = False) -> dict:
        help_text = (action.help or "").replace("%%", "%")
        is_brief = not in_full and action.dest in _BRIEF and help_text == OPTIONS[action.dest].help
        text = _BRIEF[action.dest] if is_brief else self._said(help_text)
        if action.dest == "plot":
            about = text.removeprefix("save ").partition(" as .png")[0]
            return {
                "type": "boolean",
                **({"default": True} if self.pictured else {}),
                "description": f"return a picture of {about}",
            }
        unit = _UNITS.get(action.metavar if isinstance(action.metavar, str) else "")
        schema = dict({"type": "boolean"} if _is_switch(action) else _SCHEMAS.get(action.type, {"type": "string"}))
        if action.choices is not None:
            schema["enum"] = list(action.choices)
        if _is_list(action):
            schema = {"type": "array", "items": schema}
            if isinstance(action.nargs, int):
                schema |= {"minItems": action.nargs, "maxItems": action.nargs}
        if isinstance(action.default, (bool, int, float, str)) and action.default != "" and action.default is not False:
            schema["default"] = action.default
        negated = "false: " if isinstance(action, argparse._StoreFalseAction) else ""
        return schema | {"description": f"{negated}{text}{f'; unit: {unit}' if unit else ''}"}

    def arguments(self, values: Mapping[str, object]) -> argparse.Namespace:
        """The parsed command line of parameters by name. Raises BadParameter."""
        arguments = {action.dest: _default(action) for action in self.parser._actions}
        names = (*self.actions, "overwrite") if self.writes else (*self.actions,)
        given = {self._known(name, names, values): value for name, value in values.items() if value is not None}
        for name, value in given.items():
            if name in ("plot", "overwrite"):
                arguments[name] = _switched(name, value)
            else:
                arguments[name] = _value(self.actions[name], value)
        for name, action in self.actions.items():
            if _is_required(action) and name not in given:
                raise BadParameter(f"`{name}` is missing: {self._parameter(action)['description']}")
        for group in self.parser._mutually_exclusive_groups:
            several = [f"`{action.dest}`" for action in group._group_actions if action.dest in given]
            if len(several) > 1:
                raise BadParameter(f"{' and '.join(several)} exclude each other; leave one out")
        flags = {name: name for name in names}
        return argparse.Namespace(**arguments, command=self.command.name, run=self.command, flags=flags, suffix="")

    def _known(self, name: str, names: tuple[str, ...], values: Mapping) -> str:
        try:
            return known_option(self.name, name, names, values)
        except TypeError as error:
            raise BadParameter(str(error)) from error


class BadParameter(RaytraceError, ValueError):
    """A call of a tool with a parameter that it does not have, or a value that cannot be."""


#: The tools, in the order of the list.
TOOLS = {
    tool.name: tool
    for tool in (
        Tool("lenses"),
        Tool("check"),
        Tool("info"),
        Tool("layout", pictured=True),
        Tool("spot"),
        Tool("wavefront"),
        Tool("mtf"),
        Tool("psf"),
        Tool("evaluate"),
        Tool("optimize"),
        Tool("search"),
        Tool("tolerance"),
        Tool("report"),
        Tool("compare", pictured=True),
        Tool("convert"),
        Tool("glass"),
        Tool("glasses"),
        Tool("stock_index"),
        Tool("stock_find"),
    )
}


def instructions() -> str:
    """Text for the agent at the start: the conventions, and the full texts of shared parameters."""
    spot = TOOLS["spot"]
    return "\n".join([_ABOUT, *(f"- {name}: {spot.in_parameters(OPTIONS[name].help)}" for name in _BRIEF)])


def tool_of(name: str) -> Tool:
    """The tool of a name. Raises BadParameter."""
    if name not in TOOLS:
        raise BadParameter(f"no tool {name!r}{did_you_mean(name, TOOLS)} (the tools are {', '.join(TOOLS)})")
    return TOOLS[name]


#: Units by the placeholder of the value.
_UNITS = {"MM": "mm", "UM": "µm", "C": "°C", "ATM": "atm", "S": "s", "BYTES": "bytes"}

_COUNT = {"type": "integer", "minimum": 1}
_FROM_0 = {"type": "integer", "minimum": 0}
_ABOVE_0 = {"type": "number", "exclusiveMinimum": 0}
_PAIR = {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2}

#: JSON schemas by reader; values of the others are strings.
_SCHEMAS: dict[object, dict] = {
    types.count: _COUNT,
    types.many: _COUNT,
    types.count_or_none: _FROM_0,
    types.seed_number: _FROM_0,
    types.count_or_all: {"anyOf": [_COUNT, {"const": "all"}]},
    types.memory: {"type": ["integer", "string"]},
    types.finite: {"type": "number"},
    types.not_negative: {"type": "number", "minimum": 0},
    types.positive_finite: _ABOVE_0,
    types.criterion_value: _ABOVE_0,
    types.positive: {"anyOf": [_ABOVE_0, {"const": "inf"}]},
    types.field_point: {"anyOf": [{"type": "number"}, _PAIR]},
    int: {"type": "integer"},
    float: {"type": "number"},
}


def _is_output(action: argparse.Action) -> bool:
    kind = getattr(action.type, "__annotations__", {}).get("return")
    return action.dest != "plot" and bool({kind, *typing.get_args(kind)} & {OutputFile, OutputFolder})


def _is_switch(action: argparse.Action) -> bool:
    return action.nargs == 0 or isinstance(action, argparse.BooleanOptionalAction)


def _is_list(action: argparse.Action) -> bool:
    counted = isinstance(action.nargs, int) and action.nargs > 0
    return counted or action.nargs in ("+", "*") or isinstance(action, argparse._AppendAction)


def _is_required(action: argparse.Action) -> bool:
    return action.required and action.nargs not in ("*", "?")


def _default(action: argparse.Action) -> object:
    """The default of an option, a text read as one of a command line: the name of a file is checked."""
    default = action.default
    return action.type(default) if isinstance(default, str) and callable(action.type) else default


def _value(action: argparse.Action, value: object) -> object:
    """The value of an option from JSON, read as the text of a command line is."""
    name = action.dest
    if _is_switch(action):
        return _switched(name, value)
    if not _is_list(action):
        return _single(action, value)
    values = [_single(action, entry) for entry in (value if isinstance(value, list) else [value])]
    if not values and action.nargs == "+":
        raise BadParameter(f"`{name}` is an empty list; leave it out")
    if isinstance(action.nargs, int) and len(values) != action.nargs:
        raise BadParameter(f"`{name}` has {len(values)} values; expected {action.nargs}")
    return values


def _switched(name: str, value: object) -> bool:
    if not isinstance(value, bool):
        raise BadParameter(f"`{name}` is {value!r}; expected true or false")
    return value


def _single(action: argparse.Action, value: object) -> object:
    parts = value if isinstance(value, list) else [value]
    if not parts or any(isinstance(part, bool) or not isinstance(part, (str, int, float)) for part in parts):
        raise BadParameter(f"`{action.dest}` is {value!r}; expected a number or a text")
    try:
        text = ",".join(map(str, parts))
        entry = action.type(text) if callable(action.type) else text
    except (argparse.ArgumentTypeError, ValueError) as error:
        raise BadParameter(f"`{action.dest}`: {error}") from error
    if action.choices is not None and entry not in action.choices:
        meant = did_you_mean(str(entry), map(str, action.choices))
        listed = ", ".join(map(str, action.choices))
        raise BadParameter(f"`{action.dest}` is {entry!r}{meant}; expected one of {listed}")
    return entry

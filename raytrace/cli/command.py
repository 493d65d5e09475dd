"""A command: its words, its options, and what it runs. Imports no torch.

A command is a file of this folder with

    SUMMARY, DESCRIPTION, EXAMPLES    its words on the help pages
    options(parser)                   its options, each named as the keyword of the verb
    VERB                              the public name it calls, by default that of the file
    run(arguments)                    only where it is more than the verb of a lens: what gives the result, or the
                                      place of it, "room.file.function"
"""

import argparse
import importlib
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import ModuleType

from raytrace.cli.options import max_bytes


@dataclass(frozen=True)
class Command:
    """One command: its words on the help page, its options, and the module that it stands in."""

    name: str
    summary: str
    description: str
    examples: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: ModuleType

    @classmethod
    def of(cls, place: str) -> "Command":
        """The command of a file, "room.file"."""
        module = importlib.import_module(f"raytrace.{place}")
        name = place.rpartition(".")[2].replace("_", "-")
        return cls(name, module.SUMMARY, module.DESCRIPTION, module.EXAMPLES, module.options, module)

    def add_to(self, commands, name: str = "") -> None:
        """Give a group of parsers the one of this command, under its own name or another."""
        child = commands.add_parser(
            name or self.name,
            help=self.summary,
            description=self.description,
            epilog=self.examples,
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        self.add_arguments(child)
        max_bytes(child)
        spelled = {action.dest: action.option_strings[-1] for action in child._actions if action.option_strings}
        child.set_defaults(run=self.run, spelled=spelled)


def as_options(message: str, spelled: Mapping[str, str]) -> str:
    """A message with keywords in backticks, `fields` or `model=drt`, spelled as options: --field, --model drt."""

    def option(found: re.Match) -> str:
        if found[1] not in spelled:
            return found[0]
        return spelled[found[1]] + (f" {found[2]}" if found[2] else "")

    return re.sub(r"`(\w+)(?:=([^`]*))?`", option, message)

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
from collections.abc import Callable
from dataclasses import dataclass
from types import ModuleType


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

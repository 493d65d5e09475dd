"""Commands of studies; found by name, so that nothing of the library imports a study."""

import dataclasses

from raytrace.cli.command import Command

#: The file of each command in raytrace/studies/.
PLACES = {
    "codesign": "codesign.command",
    "focus": "focusing.command",
    "edof": "edof.command",
    "table": "edof.table_command",
    "noise": "edof.noise_command",
    "network": "edof.network_command",
    "free": "edof.free_command",
    "superres": "superres.command",
    "discover": "superres.discover_command",
    "quantise": "quantise.command",
    "etch": "quantise.process_command",
}


def command(name: str) -> Command:
    """The command of a study."""
    return dataclasses.replace(Command.of(f"studies.{PLACES[name]}"), name=name)

"""The commands of `raytrace`: their words, their arguments, and what runs them. Imports no torch."""

from raytrace.cli import wave
from raytrace.cli.command import Command
from raytrace.cli.studies import command

#: The analyses, each a file of this folder.
ANALYSES = (
    *("mtf", "ray_fan", "opd_fan", "wavefront", "distortion", "field_curvature", "lateral_colour"),
    *("relative_illumination", "seidel", "longitudinal_aberration", "distortion_grid", "incidence", "rms_over_field"),
    "encircled_energy",
)

COMMANDS = (
    Command.of("cli.info"),
    Command.of("cli.check"),
    Command.of("cli.convert"),
    Command.of("cli.layout"),
    Command.of("cli.spot"),
    Command.of("cli.focus"),
    Command.of("cli.trace"),
    Command.of("cli.psf"),
    Command.of("cli.compare"),
    Command.of("cli.glass"),
    Command.of("cli.bench"),
    *(Command.of(f"cli.{name}") for name in ANALYSES),
    command("codesign"),
    Command("wave", wave.SUMMARY, wave.DESCRIPTION, wave.EXAMPLES, wave.options, "cli.wave.options"),
)

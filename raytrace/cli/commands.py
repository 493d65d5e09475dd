"""The commands of `raytrace`: their words, their arguments, and what runs them. Imports no torch."""

from raytrace.cli.command import Command

#: The analyses, each a file of this folder.
ANALYSES = (
    *("mtf", "ray_fan", "opd_fan", "wavefront", "distortion", "field_curvature", "lateral_colour"),
    *("relative_illumination", "seidel", "longitudinal_aberration", "chromatic_focal_shift", "distortion_grid"),
    *("incidence", "rms_over_field", "encircled_energy"),
)

#: All commands, in the order of the help page.
COMMANDS = (
    *(Command.of(f"cli.{name}") for name in ("info", "check", "convert", "layout", "spot", "focus", "optimize")),
    *(Command.of(f"cli.{name}") for name in ("search", "evaluate", "trace", "psf")),
    *(Command.of(f"cli.{name}") for name in ("compare", "glass", "bench", *ANALYSES)),
    Command.of("cli.codesign"),
    Command.of("cli.wave"),
)

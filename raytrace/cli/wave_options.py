"""Arguments that the subcommands of `raytrace wave` share. No torch."""

import argparse

from raytrace.cli.options import catalog, count, file_name, positive, positive_finite, size

#: The names that `--element` takes beside files: those of wave.designs.
ELEMENTS = (
    "ideal",
    "singlet",
    "fresnel",
    "multifocal",
    "multifocal-refractive",
    "cubic",
    "cubic-refractive",
    "achromat",
    "hybrid",
)
ENGINES = ("auto", "pupil", "radial", "fresnel", "angular_spectrum")


def camera(parser: argparse.ArgumentParser, *, exact: bool = True, across: float = 5.0, sensor: float = 35.5) -> None:
    """--aperture, --sensor, --exact: what every wave camera has; across, sensor: mm where they are not given."""
    group = parser.add_argument_group("camera")
    group.add_argument(
        "--aperture",
        metavar="MM",
        type=positive_finite,
        default=across,
        help=f"diameter of the aperture (default {across:g})",
    )
    group.add_argument(
        "--sensor",
        metavar="MM",
        type=positive_finite,
        default=sensor,
        help=f"from element to sensor (default {sensor:g})",
    )
    if exact:
        group.add_argument(
            "--exact", action="store_true", help="true spheres instead of Fresnel's paraboloids, in design and PSF"
        )


def element(parser: argparse.ArgumentParser) -> None:
    """--element and what makes one: focus, design wavelength, levels; glass, pitch and span of a file."""
    group = parser.add_argument_group("element")
    group.add_argument(
        "--element",
        metavar="NAME|FILE",
        type=file_name,
        default="singlet",
        help=f"{', '.join(ELEMENTS)} (default singlet), or a file: heights as .npy, .csv, .png, .tif, .dat, .grd, a "
        "smooth element as .json",
    )
    group.add_argument(
        "--focus",
        metavar="MM",
        type=positive,
        default=1000.0,
        help="object distance that a named element is made for; inf allowed (default 1000)",
    )
    group.add_argument(
        "--design-wavelength",
        metavar="UM",
        type=positive_finite,
        help="that it is made for, and wrapped at (default 0.55); a file's heights are wrapped only if this is given",
    )
    group.add_argument(
        "--levels", metavar="N", type=count, help="steps of a wave's height, of wrapped elements (default any height)"
    )
    group.add_argument("--glass", metavar="NAME", help="material of a file's element (default: that of its FILE.json)")
    group.add_argument(
        "--index",
        metavar="N",
        type=positive_finite,
        nargs="+",
        help="refractive index of a file's element at each --wavelength, instead of --glass",
    )
    group.add_argument("--pitch", metavar="MM", type=positive_finite, help="of a file that does not say it")
    group.add_argument(
        "--span", metavar="MM", type=float, nargs=2, help="heights of black and white of a picture that does not say"
    )
    catalog(group)


def light(
    parser: argparse.ArgumentParser,
    *,
    depths: tuple[float, ...] = (500.0, 1000.0, float("inf")),
    wavelengths: tuple[float, ...] = (0.46, 0.55, 0.64),
) -> None:
    """--depth (where there are any), --wavelength: the point sources."""
    group = parser.add_argument_group("light")
    if depths:
        listed = " ".join(f"{depth:g}" for depth in depths)
        group.add_argument(
            "--depth",
            dest="depths",
            metavar="MM",
            type=positive,
            nargs="+",
            default=list(depths),
            help=f"distances of points on the axis; inf allowed (default {listed})",
        )
    group.add_argument(
        "--wavelength",
        dest="wavelengths",
        metavar="UM",
        type=positive_finite,
        nargs="+",
        default=list(wavelengths),
        help=f"in µm (default {' '.join(f'{one:g}' for one in wavelengths)})",
    )


def pixels(parser: argparse.ArgumentParser, *, across: int = 128, pitch: float = 0.00369) -> None:
    """--pixel, --size: the window of the PSF; across: pixels, pitch: mm, where they are not given."""
    group = parser.add_argument_group("window")
    group.add_argument(
        "--pixel", metavar="MM", type=positive_finite, default=pitch, help=f"pixel pitch (default {pitch:g})"
    )
    size(group, f"the window, centred on the axis (default {across})", default=across)


def engine(parser: argparse.ArgumentParser) -> None:
    """--engine, --samples, --tol: how PSFs are computed."""
    group = parser.add_argument_group("sampling")
    group.add_argument(
        "--engine",
        choices=ENGINES,
        default="auto",
        help="auto (default): radial for round elements, else pupil; fresnel and angular_spectrum are references",
    )
    group.add_argument(
        "--samples",
        metavar="N",
        type=count,
        help="across the aperture (radial: between steps of the element) instead of as many as --tol needs",
    )
    group.add_argument(
        "--tol", metavar="T", type=positive_finite, default=1e-3, help="predicted relative L2 error (default 1e-3)"
    )


def feature(group, default: str) -> None:
    """--feature: size of what heights are made in."""
    group.add_argument(
        "--feature", metavar="MM", type=positive_finite, help=f"size of the features of the heights (default {default})"
    )

"""Options that the subcommands of `raytrace wave` share. No torch."""

import argparse

from raytrace.cli.options import catalog, count, file_name, positive, positive_finite, size

#: The names of elements that `--element` takes, those of wave_optics.designs.
ELEMENTS = (
    *("ideal", "singlet", "fresnel", "multifocal", "multifocal-refractive", "cubic", "cubic-refractive", "achromat"),
    "hybrid",
)
ENGINES = ("auto", "pupil", "radial", "fresnel", "angular_spectrum")


def _length(group, flag: str, help: str, default: float | None = None, *, metavar: str = "MM", **more) -> None:
    """An option of a positive, finite number."""
    text = help if default is None else f"{help} (default {default:g})"
    group.add_argument(flag, help=text, default=default, **{"metavar": metavar, "type": positive_finite} | more)


def camera(parser: argparse.ArgumentParser, *, exact: bool = True, across: float = 5.0, sensor: float = 35.5) -> None:
    """--aperture, --sensor, --exact; across, sensor: defaults, mm."""
    group = parser.add_argument_group("camera")
    _length(group, "--aperture", "diameter of the aperture", across)
    _length(group, "--sensor", "from element to sensor", sensor)
    if exact:
        group.add_argument(
            "--exact", action="store_true", help="true spheres instead of Fresnel's paraboloids, in design and PSF"
        )


def element(parser: argparse.ArgumentParser) -> None:
    """--element and its design: focus, wavelength, levels; glass, pitch and span of a file."""
    group = parser.add_argument_group("element")
    group.add_argument(
        "--element",
        metavar="NAME|FILE",
        type=file_name,
        default="singlet",
        help=f"{', '.join(ELEMENTS)} (default singlet), or a file: heights as .npy, .csv, .png, .tif, .dat, .grd, a "
        "smooth element as .json",
    )
    _length(
        group, "--focus", "object distance for which a named element is designed; inf allowed", 1000.0, type=positive
    )
    _length(
        group,
        "--design-wavelength",
        "at which elements are designed and wrapped (default 0.55); heights of a file are wrapped only with it",
        metavar="UM",
    )
    group.add_argument(
        "--levels", metavar="N", type=count, help="steps of a wave's height, of wrapped elements (default any height)"
    )
    group.add_argument("--glass", metavar="NAME", help="material of a file's element (default: that of its FILE.json)")
    _length(
        group,
        "--index",
        "refractive index of a file's element at each --wavelength, instead of --glass",
        metavar="N",
        nargs="+",
    )
    _length(group, "--pitch", "of a file without it")
    group.add_argument(
        "--span", metavar="MM", type=float, nargs=2, help="height range of an image without metadata: black and white"
    )
    catalog(group)


def light(
    parser: argparse.ArgumentParser,
    *,
    depths: tuple[float, ...] = (500.0, 1000.0, float("inf")),
    wavelengths: tuple[float, ...] = (0.46, 0.55, 0.64),
) -> None:
    """--depth (if there are any), --wavelength: the point sources."""
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
        help=f"in µm (default {' '.join(f'{wavelength:g}' for wavelength in wavelengths)})",
    )


def pixels(parser: argparse.ArgumentParser, *, across: int = 128, pitch: float = 0.00369) -> None:
    """--pixel, --size: the window of the PSF; across: pixels, pitch: mm, by default."""
    group = parser.add_argument_group("window")
    _length(group, "--pixel", "pixel pitch", pitch)
    size(group, f"the window, centred on the axis (default {across})", default=across)


def engine(parser: argparse.ArgumentParser) -> None:
    """--engine, --samples, --tol: the computation of PSFs."""
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
    """--feature: size of the features of the heights."""
    _length(group, "--feature", f"size of the features of the heights (default {default})")

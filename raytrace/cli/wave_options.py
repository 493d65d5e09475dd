"""Options that the subcommands of `raytrace wave` share, of the parameters of `rt.wave_optics.wave_psf`. No torch."""

import dataclasses

from raytrace.cli.options import Adder, Option, group, switch
from raytrace.cli.types import count, file_name, positive, positive_finite

#: The names of elements that `--element` takes, those of wave_optics.designs.
ELEMENTS = (
    *("ideal", "singlet", "fresnel", "multifocal", "multifocal-refractive", "cubic", "cubic-refractive", "achromat"),
    "hybrid",
)
OPTIONS = {row.name: row for row in (
    Option("aperture", positive_finite, "MM", "diameter of the aperture", default=5.0),
    Option("sensor", positive_finite, "MM", "from element to sensor", default=35.5),
    switch("exact", "true spheres instead of Fresnel's paraboloids, in design and PSF"),
    Option("element", file_name, "NAME|FILE", f"{', '.join(ELEMENTS)} (default singlet), or a file: heights as .npy, "
           ".csv, .png, .tif, .dat, .grd, a smooth element as .json", default="singlet"),
    Option("focus", positive, "MM", "object distance for which a named element is designed; inf allowed",
           default=1000.0),
    Option("design_wavelength", positive_finite, "UM", "at which elements are designed and wrapped (default 0.55); "
           "heights of a file are wrapped only with it"),
    Option("levels", count, "N", "steps of a wave's height, of wrapped elements (default any height)"),
    Option("glass", None, "NAME", "material of a file's element (default: that of its FILE.json)"),
    Option("index", positive_finite, "N", "refractive index of a file's element at each --wavelength, instead of "
           "--glass", nargs="+"),
    Option("pitch", positive_finite, "MM", "of a file without it"),
    Option("span", float, "MM", "height range of an image without metadata: black and white", nargs=2),
    Option("depths", positive, "MM", "distances of points on the axis; inf allowed", flag="--depth", nargs="+",
           default=(500.0, 1000.0, float("inf"))),
    Option("wavelengths", positive_finite, "UM", "in µm", flag="--wavelength", nargs="+", default=(0.46, 0.55, 0.64)),
    Option("pixel", positive_finite, "MM", "pixel pitch", default=0.00369),
    Option("size", count, "N", "pixels across the window, centred on the axis", default=128),
)}  # fmt: skip


def _rows(title: str, *names: str, **defaults: object) -> Adder:
    """Rows of OPTIONS, under a title, some with other defaults."""
    rows = (OPTIONS[name] for name in names)
    return group(title, *(dataclasses.replace(row, default=defaults.get(row.name, row.default)) for row in rows))


def camera(*, exact: bool = True, **defaults: float) -> Adder:
    """--aperture, --sensor, --exact."""
    return _rows("camera", "aperture", "sensor", *(["exact"] if exact else []), **defaults)


#: --element and its design: focus, wavelength, levels; glass, pitch and span of a file.
element = group(
    "element",
    *(OPTIONS[name] for name in ("element", "focus", "design_wavelength", "levels", "glass", "index", "pitch", "span")),
    "catalog",
)


def light(**defaults: tuple[float, ...]) -> Adder:
    """--depth, unless `depths` is empty, and --wavelength: the point sources."""
    names = ("wavelengths",) if defaults.get("depths") == () else ("depths", "wavelengths")
    return _rows("light", *names, **defaults)


def pixels(**defaults: float) -> Adder:
    """--pixel, --size: the window of the PSF."""
    return _rows("window", "pixel", "size", **defaults)


#: --engine, --samples, --tol: the computation of PSFs.
ENGINE = group(
    "sampling",
    Option("engine", help="auto (default): radial for round elements, else pupil; fresnel and angular_spectrum are "
           "references", choices=("auto", "pupil", "radial", "fresnel", "angular_spectrum"), default="auto"),
    Option("samples", count, "N", "across the aperture (radial: between steps of the element) instead of as many as "
           "--tol needs"),
    Option("tol", positive_finite, "T", "predicted relative L2 error", default=1e-3),
)  # fmt: skip


def feature(default: str) -> Adder:
    """--feature: size of the features of the heights."""
    return Option("feature", positive_finite, "MM", f"size of the features of the heights (default {default})")

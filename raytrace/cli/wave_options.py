"""Options that the subcommands of `raytrace wave` share, of the parameters of `rt.wave_psf`. No torch."""

from typing import Any

from raytrace.cli.options import Adder, catalog, group, option, parameters
from raytrace.cli.types import file_name, positive, positive_finite

#: The names of elements that `--element` takes, those of wave_optics.designs.
ELEMENTS = (
    *("ideal", "singlet", "fresnel", "multifocal", "multifocal-refractive", "cubic", "cubic-refractive", "achromat"),
    "hybrid",
)
_MM = {"metavar": "MM"}
_ROWS: dict[str, dict[str, Any]] = {
    "aperture": {**_MM, "help": "diameter of the aperture"},
    "sensor": {**_MM, "help": "from element to sensor"},
    "exact": {"help": "true spheres instead of Fresnel's paraboloids, in design and PSF"},
    "element": {
        "metavar": "NAME|FILE", "type": file_name, "nargs": None,
        "help": f"{', '.join(ELEMENTS)} (default singlet), or a file: heights as .npy, .csv, .png, .tif, .dat, .grd, "
        "a smooth element as .json",
    },
    "focus": {
        **_MM, "type": positive, "help": "object distance for which a named element is designed; inf allowed",
    },
    "design_wavelength": {
        "metavar": "UM",
        "help": "at which elements are designed and wrapped (default 0.55); heights of a file are wrapped only with it",
    },
    "levels": {"help": "steps of a wave's height, of wrapped elements (default any height)"},
    "glass": {"metavar": "NAME", "help": "material of a file's element (default: that of its FILE.json)"},
    "index": {"metavar": "N", "help": "refractive index of a file's element at each --wavelength, instead of --glass"},
    "pitch": {**_MM, "help": "of a file without it"},
    "span": {**_MM, "type": float, "nargs": 2, "help": "height range of an image without metadata: black and white"},
    "depths": {**_MM, "type": positive, "help": "distances of points on the axis; inf allowed"},
    "wavelengths": {"help": "in µm"},
    "pixel": {"help": "pixel pitch"},
    "size": {"help": "pixels across the window, centred on the axis"},
    "engine": {
        "help": "auto (default): radial for round elements, else pupil; fresnel and angular_spectrum are references",
    },
    "samples": {
        "help": "across the aperture (radial: between steps of the element) instead of as many as --tol needs",
    },
    "tol": {"help": "predicted relative L2 error"},
}  # fmt: skip


def _of_wave_psf(title: str, *names: str, more: Adder | None = None, **defaults: Any) -> Adder:
    rows = {name: _ROWS[name] | ({"default": defaults[name]} if name in defaults else {}) for name in names}
    return group(title, parameters("wave_psf", *names, **rows), *([more] if more else []))


def camera(*, exact: bool = True, **defaults: Any) -> Adder:
    """--aperture, --sensor, --exact."""
    return _of_wave_psf("camera", "aperture", "sensor", *(["exact"] if exact else []), **defaults)


#: --element and its design: focus, wavelength, levels; glass, pitch and span of a file.
element = _of_wave_psf(
    "element", *("element", "focus", "design_wavelength", "levels", "glass", "index", "pitch", "span"), more=catalog
)


def light(**defaults: Any) -> Adder:
    """--depth, unless `depths` is empty, and --wavelength: the point sources."""
    names = ("wavelengths",) if defaults.get("depths") == () else ("depths", "wavelengths")
    return _of_wave_psf("light", *names, **defaults)


def pixels(**defaults: Any) -> Adder:
    """--pixel, --size: the window of the PSF."""
    return _of_wave_psf("window", "pixel", "size", **defaults)


#: --engine, --samples, --tol: the computation of PSFs.
engine = _of_wave_psf("sampling", "engine", "samples", "tol")


def feature(default: str) -> Adder:
    """--feature: size of the features of the heights."""
    help = f"size of the features of the heights (default {default})"
    return option("--feature", metavar="MM", type=positive_finite, help=help)

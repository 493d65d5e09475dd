"""The header lines of a prescription table: aperture, fields, wavelengths and the rest of the system.

# title: Double Gauss            # note: free text; so is a '#' line that is not one of these
# units: mm                      mm, cm, in, m; of every length in the table and the header
# ignore: weight, price          columns to leave out
# object distance: inf           if the table has no row of the object
# stop: 6                        if no row is marked as the stop
# aperture: EPD 33.33            or: F/3 · working F/3 · NA 0.1 · cone angle 5 · stop 10.2, or a name of
                                 APERTURE_KINDS in full
# fields: angle 0 10 14          y of each point, or (x, y) (x, y) …; object height, paraxial image height,
                                 real image height
# field weights: 1 1 1           vdx, vdy, vcx, vcy, van: vignetting factors, one per field
# telecentric: yes
# wavelengths: 0.4861 0.5876     µm, or with the unit: 587.6 nm
# wavelength weights: 1 1
# primary wavelength: 2          counted from 1
# catalogs: SCHOTT OHARA
# ray aiming: paraxial
"""

import difflib
import re
from decimal import Decimal

import torch
from torch import Tensor

from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, Place, shown
from raytrace.formats.spelling import integer, is_number, number
from raytrace.media.glass import LINES
from raytrace.system.lens import APERTURE_KINDS, FIELD_UNITS, RAY_AIMING, Fields, SystemAperture

#: Header keys: "once" or "repeated" (notes).
KEYS = {
    "title": "once",
    "note": "repeated",
    "units": "once",
    "ignore": "once",
    "object distance": "once",
    "stop": "once",
    "aperture": "once",
    "fields": "once",
    "field weights": "once",
    "vdx": "once",
    "vdy": "once",
    "vcx": "once",
    "vcy": "once",
    "van": "once",
    "telecentric": "once",
    "wavelengths": "once",
    "wavelength weights": "once",
    "primary wavelength": "once",
    "catalogs": "once",
    "ray aiming": "once",
}

_OTHER_SPELLINGS = {
    "name": "title",
    "notes": "note",
    "unit": "units",
    "system aperture": "aperture",
    "stop surface": "stop",
    "field": "fields",
    "weights": "wavelength weights",
    "wavelength": "wavelengths",
    "primary": "primary wavelength",
    "catalog": "catalogs",
    "glass catalogs": "catalogs",
}

#: Short names of the system aperture, longest first, as patterns.
_APERTURES = (
    (r"working\s+f[\s/#-]*(?:number|num|no\.?)?", "working_f_number"),
    (r"(?:image\s+)?f[\s/#-]*(?:number|num|no\.?)?", "image_f_number"),
    (r"epd|enpd|entrance pupil", "entrance_pupil_diameter"),
    (r"na|object na", "object_na"),
    (r"cone angle|object cone angle", "object_cone_angle"),
    (r"stop|float by stop", "float_by_stop"),
)

#: Assumed where neither the header nor the stop's semi-diameter tells the aperture: slow enough for any lens.
DEFAULT_F_NUMBER = 10.0

_NUMBERS = re.compile(r"[\s,;]+")

Metadata = dict[str, tuple[str, Place]]


def key_of(name: str) -> tuple[str | None, str | None]:
    """(key, None) of a header name; (None, the key it looks like or None) if it is none."""
    bare = " ".join(re.sub(r"[_\s]+", " ", name).lower().split())
    bare = _OTHER_SPELLINGS.get(bare, bare)
    if bare in KEYS:
        return bare, None
    near = difflib.get_close_matches(bare, [*KEYS, *_OTHER_SPELLINGS], n=1, cutoff=0.8) if len(bare) < 40 else []
    return None, near[0] if near else None


def numbers(metadata: Metadata, key: str) -> list[float] | None:
    """The numbers of a header line, None if it is absent."""
    if key not in metadata:
        return None
    value, place = metadata[key]
    return [number(word, key, place) for word in _NUMBERS.split(value) if word]


def truth(metadata: Metadata, key: str) -> bool:
    """yes or no."""
    if key not in metadata:
        return False
    value, place = metadata[key]
    word = value.strip().lower()
    if word not in ("yes", "on", "true", "1", "no", "off", "false", "0", ""):
        raise LensFileError(f"{key} is {shown(value)}, expected yes or no", place)
    return word in ("yes", "on", "true", "1")


def ray_aiming(metadata: Metadata) -> str:
    """off, paraxial or real."""
    if "ray aiming" not in metadata:
        return "off"
    value, place = metadata["ray aiming"]
    if value.strip().lower() not in RAY_AIMING:
        raise LensFileError(f"ray aiming is {shown(value)}, expected one of {', '.join(RAY_AIMING)}", place)
    return value.strip().lower()


def aperture(metadata: Metadata, stop_semi_diameter: float | None, unit: float, table: Place, report: Draft):
    """The system aperture: of the header, else the stop's semi-diameter, else F/10 with a warning."""
    if "aperture" not in metadata:
        if stop_semi_diameter:
            report.note("no aperture in the header: the beam fills the stop's semi-diameter")
            return SystemAperture("float_by_stop", _tensor(stop_semi_diameter))
        message = f"no aperture: F/{DEFAULT_F_NUMBER:g} is assumed; write it, as '# aperture: EPD 33.33'"
        report.warn(message, table)
        return SystemAperture("image_f_number", _tensor(DEFAULT_F_NUMBER))
    value, place = metadata["aperture"]
    kind, size = _aperture_words(value, place)
    if not size and kind == "float_by_stop" and stop_semi_diameter:
        return SystemAperture(kind, _tensor(stop_semi_diameter))
    found = number(size.removesuffix("mm").removesuffix("deg").strip() or "?", "aperture", place)
    if found <= 0:
        raise LensFileError(f"the aperture is {found:g}, expected a positive number", place)
    scaled = kind in ("entrance_pupil_diameter", "float_by_stop")
    return SystemAperture(kind, _tensor(found * unit if scaled else found))


def _aperture_words(value: str, place: Place) -> tuple[str, str]:
    text = " ".join(value.replace("_", " ").replace("=", " ").split())
    for kind in APERTURE_KINDS:
        name = kind.replace("_", " ")
        if text.lower().startswith(name):
            return kind, text[len(name) :].strip()
    for pattern, kind in _APERTURES:
        found = re.fullmatch(rf"(?:{pattern})\s*((?:\d|\.|[+-]\s*\d).*|)", text, re.IGNORECASE)
        if found:
            return kind, found[1]
    raise LensFileError(f"aperture is {shown(value)}, expected for example 'EPD 33.33', 'F/3', 'NA 0.1'", place)


def fields(metadata: Metadata, unit: float, table: Place, report: Draft) -> Fields:
    """The field points of the header; on axis, with a warning, if there are none."""
    kind, points = "angle", [(0.0, 0.0)]
    if "fields" in metadata:
        kind, points = _field_points(*metadata["fields"])
    else:
        report.warn("no fields: on axis only; write them, as '# fields: angle 0 10 14'", table)
    length = 1.0 if kind == "angle" else unit
    columns = [_per_field(metadata, key, len(points), 0.0) for key in ("vdx", "vdy", "vcx", "vcy", "van")]
    vignetting = torch.tensor(columns, dtype=torch.float64)
    return Fields(
        kind=kind,
        x=_tensor([length * x for x, _ in points]),
        y=_tensor([length * y for _, y in points]),
        weight=_tensor(_per_field(metadata, "field weights", len(points), 1.0)),
        vignetting=vignetting if bool(vignetting.any()) else None,
        telecentric=truth(metadata, "telecentric"),
    )


def _field_points(value: str, place: Place) -> tuple[str, list[tuple[float, float]]]:
    text = " ".join(value.replace("_", " ").split())
    text = re.sub(r"\s*(degrees|degree|deg|°|mm)\s*$", "", text)
    kinds = sorted(FIELD_UNITS, key=len, reverse=True)
    kind = next((kind for kind in kinds if text.lower().startswith(kind.replace("_", " "))), None)
    rest = text[len(kind) :].strip() if kind else text
    kind = kind or "angle"
    pairs = re.fullmatch(r"(?:\([^()]*\)[\s,;]*)+", rest)
    points = []
    for word in re.findall(r"\(([^()]*)\)", rest) if pairs else _NUMBERS.split(rest):
        if not word.strip():
            continue
        found = [number(part, "field", place) for part in _NUMBERS.split(word.strip())]
        if pairs and len(found) != 2:
            raise LensFileError(f"field ({shown(word)}), expected (x, y)", place)
        points.append((found[0], found[1]) if pairs else (0.0, found[0]))
    if not points or len(points) > 1000:
        expected = f"a kind ({', '.join(kind.replace('_', ' ') for kind in FIELD_UNITS)}) and numbers"
        raise LensFileError(f"fields is {shown(value)}, expected {expected}", place)
    return kind, points


def _per_field(metadata: Metadata, key: str, count: int, default: float) -> list[float]:
    found = numbers(metadata, key)
    if found is None:
        return [default] * count
    if len(found) != count:
        raise LensFileError(f"{key} has {len(found)} values for {count} fields", metadata[key][1])
    return found


def wavelengths(metadata: Metadata, table: Place, report: Draft) -> tuple[Tensor, Tensor, int]:
    """Wavelengths in µm, weights, 0-based primary; the d line, with a warning, if there are none."""
    found = [LINES["d"]]
    if "wavelengths" in metadata:
        found = _wavelengths(*metadata["wavelengths"])
    else:
        report.warn(f"no wavelengths: {LINES['d']} µm (d) is taken; write '# wavelengths: 0.5876'", table)
    weights = numbers(metadata, "wavelength weights") or [1.0] * len(found)
    if len(weights) != len(found) or min(weights) < 0:
        message = f"{len(weights)} wavelength weights for {len(found)} wavelengths, expected as many, 0 or more"
        raise LensFileError(message, metadata["wavelength weights"][1])
    primary = 0
    if "primary wavelength" in metadata:
        value, place = metadata["primary wavelength"]
        primary = integer(value, "primary wavelength", place) - 1
        if not 0 <= primary < len(found):
            raise LensFileError(f"primary wavelength is {value}, expected a number from 1 to {len(found)}", place)
    elif len(found) > 1:
        report.note("no primary wavelength in the header: the first is taken")
    return _tensor(found), _tensor(weights), primary


def _wavelengths(value: str, place: Place) -> list[float]:
    words = [word for word in _NUMBERS.split(value) if word]
    unit = "µm" if words and is_number(words[-1]) else (words or [""]).pop()
    powers = {"µm": 0, "μm": 0, "um": 0, "micron": 0, "microns": 0, "nm": -3}
    if unit not in powers or not words or len(words) > 1000:
        raise LensFileError(f"wavelengths is {shown(value)}, expected numbers in µm (or with the unit, nm)", place)
    found = [_decimal(word, powers[unit], place) for word in words]
    for wavelength in found:
        if not 0 < wavelength < 100:
            raise LensFileError(
                f"a wavelength of {wavelength:g} µm, expected 0 to 100 µm; in nm write '587.6 nm'", place
            )
    return found


def _decimal(word: str, power: int, place: Place) -> float:
    """A number times a power of ten, rounded once: 486.1 nm is 0.4861 µm."""
    found = number(word, "wavelength", place)
    return float(Decimal(repr(found)).scaleb(power))


def _tensor(values: float | list[float]) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)

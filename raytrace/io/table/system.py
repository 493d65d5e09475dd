"""The header lines of a prescription table, read and written: aperture, fields, wavelengths, the rest of the system.

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
# telecentric: yes                object space
# afocal: yes                     image space
# wavelengths: 0.4861 0.5876     µm, or with the unit: 587.6 nm
# wavelength weights: 1 1
# primary wavelength: 2          counted from 1
# catalogs: SCHOTT OHARA
# ray aiming: paraxial
# temperature: 40                °C, of the glasses and the air
# pressure: 1                    atm, of the air; 0 is vacuum
# automatic: 1 3 4 margin 5 0.1    semi-diameters that follow the rays, and what is added to them, per cent and mm
# variables: curvature_1 thickness_2:1..20    with their bounds, mm and 1/mm
# conditions: efl=100 edge>=1    met exactly by optimisations (`optimization.conditions`), mm
"""

import math
import re
from collections.abc import Mapping, Sequence
from decimal import Decimal
from pathlib import Path

from torch import Tensor

from raytrace.io.assembly import (
    catalogs_needed,
    environment_at,
    written_automatic,
    written_conditions,
    written_variables,
)
from raytrace.io.source import (
    LensFileError,
    Place,
    exact,
    exact_list,
    integer,
    is_number,
    number,
    quoted,
    shown,
    word,
)
from raytrace.io.table.text import Table
from raytrace.materials.environment import REFERENCE, Environment
from raytrace.materials.glass import LINES
from raytrace.system.lens import APERTURE_KINDS, FIELD_UNITS, RAY_AIMING, Lens

#: Short names of the system aperture, longest first, as patterns.
_APERTURES = (
    (r"(?:paraxial\s+)?working\s+f[\s/#-]*(?:number|num|no\.?)?", "paraxial_working_f_number"),
    (r"(?:image\s+)?f[\s/#-]*(?:number|num|no\.?)?", "image_f_number"),
    (r"epd|enpd|entrance pupil", "entrance_pupil_diameter"),
    (r"na|object na", "object_na"),
    (r"cone angle|object cone angle", "object_cone_angle"),
    (r"stop|float by stop", "float_by_stop"),
)

#: Assumed where neither the header nor the stop's semi-diameter gives the aperture: slow enough for any lens.
DEFAULT_F_NUMBER = 10.0

#: µm: a wavelength this long needs its unit in the table, for it is likely in nm.
_LONGEST = 100.0

_NUMBERS = re.compile(r"[\s,;]+")
_NO, _YES = ("no", "off", "false", "0", ""), ("yes", "on", "true", "1")
#: Header keys of the environment, and the unit that may follow the number.
ENVIRONMENT = {"temperature": "C", "pressure": "atm"}
_VIGNETTING = ("vdx", "vdy", "vcx", "vcy", "van")


def _numbers(table: Table, key: str) -> list[float] | None:
    """The numbers of a header line, None if it is absent."""
    if key not in table.metadata:
        return None
    value, place = table.metadata[key]
    return [number(part, key, place) for part in _NUMBERS.split(value) if part]


def _choice(table: Table, key: str, choices: Sequence[str], expected: str) -> str:
    """The value of a header line that is one of several, the first if it is absent."""
    value, place = table.metadata.get(key, (choices[0], table.place))
    if value.strip().lower() not in choices:
        raise LensFileError(f"{key} is {shown(value)}, expected {expected}", place)
    return value.strip().lower()


def ray_aiming(table: Table) -> str:
    """A key of RAY_AIMING."""
    return _choice(table, "ray aiming", [*RAY_AIMING], f"one of {', '.join(RAY_AIMING)}")


def environment(table: Table) -> Environment | None:
    """Temperature in °C and pressure in atm; None where the header has neither."""
    lines = {key: table.metadata[key] for key in ENVIRONMENT if key in table.metadata}
    places = [place for _, place in lines.values()]
    return environment_of({key: value for key, (value, _) in lines.items()}, places[-1]) if lines else None


def environment_of(cells: Mapping[str, str], place: Place) -> Environment:
    """Of texts for the temperature and the pressure; a missing one is that of catalogs."""
    numbers = list(REFERENCE)
    for k, (key, unit) in enumerate(ENVIRONMENT.items()):
        if key in cells:
            bare = cells[key].strip()
            numbers[k] = number(bare.removesuffix(unit).rstrip("° ") if bare != unit else bare, key, place)
    return environment_at(numbers, place)


def aperture(table: Table, stop_semi_diameter: float | None, unit: float) -> tuple[str, float]:
    """Kind and size of the system aperture: of the header, else the stop's semi-diameter, else F/10 with a warning."""
    if "aperture" not in table.metadata:
        if stop_semi_diameter:
            table.report.note("no aperture in the header: the beam fills the stop's semi-diameter")
            return "float_by_stop", stop_semi_diameter
        message = f"no aperture: F/{DEFAULT_F_NUMBER:g} is assumed; write it, as '# aperture: EPD 33.33'"
        table.report.warn(message, table.place)
        return "image_f_number", DEFAULT_F_NUMBER
    value, place = table.metadata["aperture"]
    text = " ".join(value.replace("_", " ").replace("=", " ").split())
    kinds = ((name, kind) for kind in APERTURE_KINDS if text.lower().startswith(name := kind.replace("_", " ")))
    name, kind = next(kinds, ("", ""))
    size = text[len(name) :].strip()
    if not kind:
        number_behind = r"\s*((?:\d|\.|[+-]\s*\d).*|)"
        matches = ((re.fullmatch(f"(?:{row}){number_behind}", text, re.IGNORECASE), kind) for row, kind in _APERTURES)
        match, kind = next(((match, kind) for match, kind in matches if match), (None, ""))
        if match is None:
            raise LensFileError(f"aperture is {shown(value)}, expected for example 'EPD 33.33', 'F/3', 'NA 0.1'", place)
        size = match[1]
    if not size and kind == "float_by_stop" and stop_semi_diameter:
        return kind, stop_semi_diameter
    amount = number(size.removesuffix("mm").removesuffix("deg").strip() or "?", "aperture", place)
    return kind, amount * unit if kind in ("entrance_pupil_diameter", "float_by_stop") else amount


def fields(table: Table, unit: float) -> dict:
    """The field points of the header; on axis, with a warning, if there are none."""
    kind, points = "angle", [(0.0, 0.0)]
    if "fields" in table.metadata:
        kind, points = _field_points(*table.metadata["fields"])
    else:
        table.report.warn("no fields: on axis only; write them, as '# fields: angle 0 10 14'", table.place)
    length = 1.0 if kind == "angle" else unit
    return {
        "field_kind": kind,
        "x": [length * x for x, _ in points],
        "y": [length * y for _, y in points],
        "field_weights": _per_field(table, "field weights", len(points), 1.0),
        "vignetting": [_per_field(table, key, len(points), 0.0) for key in _VIGNETTING],
        **{key: _choice(table, key, [*_NO, *_YES], "yes or no") in _YES for key in ("telecentric", "afocal")},
    }


def _field_points(value: str, place: Place) -> tuple[str, list[tuple[float, float]]]:
    text = " ".join(value.replace("_", " ").split())
    text = re.sub(r"\s*(degrees|degree|deg|°|mm)\s*$", "", text)
    kinds = sorted(FIELD_UNITS, key=len, reverse=True)
    kind = next((kind for kind in kinds if text.lower().startswith(kind.replace("_", " "))), None)
    rest = text[len(kind) :].strip() if kind else text
    kind = kind or "angle"
    pairs = re.fullmatch(r"(?:\([^()]*\)[\s,;]*)+", rest)
    listed = re.findall(r"\(([^()]*)\)", rest) if pairs else _NUMBERS.split(rest)
    points = []
    for point in filter(str.strip, listed):
        numbers = [number(part, "field", place) for part in _NUMBERS.split(point.strip())]
        if pairs and len(numbers) != 2:
            raise LensFileError(f"field ({shown(point)}), expected (x, y)", place)
        points.append((numbers[0], numbers[1]) if pairs else (0.0, numbers[0]))
    if not points or len(points) > 1000:
        expected = f"a kind ({', '.join(kind.replace('_', ' ') for kind in FIELD_UNITS)}) and numbers"
        raise LensFileError(f"fields is {shown(value)}, expected {expected}", place)
    return kind, points


def _per_field(table: Table, key: str, count: int, default: float) -> list[float]:
    numbers = _numbers(table, key)
    if numbers is not None and len(numbers) != count:
        raise LensFileError(f"{key} has {len(numbers)} values for {count} fields", table.metadata[key][1])
    return [default] * count if numbers is None else numbers


def wavelengths(table: Table) -> dict:
    """Wavelengths in µm, weights, number of the primary one; the d line, with a warning, if there are none."""
    waves, report = [LINES["d"]], table.report
    if "wavelengths" in table.metadata:
        value, place = table.metadata["wavelengths"]
        words = [word for word in _NUMBERS.split(value) if word]
        unit = "" if words and is_number(words[-1]) else (words or ["?"]).pop()
        powers = {"": 0, "µm": 0, "μm": 0, "um": 0, "micron": 0, "microns": 0, "nm": -3}
        if unit not in powers or not words or len(words) > 1000:
            raise LensFileError(f"wavelengths is {shown(value)}, expected numbers in µm (or with the unit, nm)", place)
        # rounded once: 486.1 nm is 0.4861 µm
        waves = [float(Decimal(repr(number(word, "wavelength", place))).scaleb(powers[unit])) for word in words]
        for wavelength in waves:
            if not 0 < wavelength < (math.inf if unit else _LONGEST):
                expected = f"expected 0 to {_LONGEST:g} µm; in nm write '587.6 nm', and '3000 µm' where that is meant"
                raise LensFileError(f"a wavelength of {wavelength:g} µm, {expected}", place)
    else:
        report.warn(f"no wavelengths: {LINES['d']} µm (d) is taken; write '# wavelengths: 0.5876'", table.place)
    value, place = table.metadata.get("primary wavelength", ("1", table.place))
    if "primary wavelength" not in table.metadata and len(waves) > 1:
        report.note("no primary wavelength in the header: the first is taken")
    return {
        "wavelengths": waves,
        "wavelength_weights": _numbers(table, "wavelength weights") or None,
        "primary_wavelength": integer(value, "primary wavelength", place),
    }


def written_environment(air: Environment | None, place: Place) -> dict[str, str]:
    """The texts of an environment by their keys; none where there is none."""
    return {} if air is None else {key: exact(getattr(air, key), key, place) for key in ENVIRONMENT}


def written(lens: Lens, place: Place, catalogs: Sequence[Path] = ()) -> list[tuple[str, str]]:
    """The system of a lens as keys and values of header lines."""

    def listed(numbers: Tensor, quantity: str) -> str:
        return " ".join(exact_list(numbers, quantity, place))

    fields, aperture = lens.fields, lens.aperture
    size = exact(aperture.value, "system aperture", place)
    x, y = exact_list(fields.x, "field", place), exact_list(fields.y, "field", place)
    points = [f"({a}, {b})" for a, b in zip(x, y, strict=True)] if any(fields.x) else y
    vignetting = [] if fields.vignetting is None else zip(_VIGNETTING, fields.vignetting, strict=True)
    unit = " µm" if bool((lens.wavelengths >= _LONGEST).any()) else ""
    lines = [
        ("title", quoted(lens.name) if lens.name else ""),
        *(("note", quoted(note)) for note in lens.notes),
        ("aperture", f"{aperture.kind.replace('_', ' ')} {size}"),
        ("fields", f"{fields.kind.replace('_', ' ')} {' '.join(points)}"),
        ("field weights", listed(fields.weight, "weight of a field")),
        *((key, listed(row, "vignetting factor")) for key, row in vignetting),
        ("telecentric", "yes" if fields.telecentric else ""),
        ("afocal", "yes" if lens.afocal else ""),
        ("wavelengths", listed(lens.wavelengths, "wavelength") + unit),
        ("wavelength weights", listed(lens.wavelength_weights, "weight")),
        ("primary wavelength", str(lens.primary_wavelength)),
        ("catalogs", " ".join(map(word, catalogs_needed(lens, catalogs, place.file)))),
        ("ray aiming", "" if lens.ray_aiming == "auto" else lens.ray_aiming),
        *written_environment(lens.environment, place).items(),
        ("automatic", written_automatic(lens)),
        ("variables", written_variables(lens)),
        ("conditions", written_conditions(lens, place)),
    ]
    return [(key, value) for key, value in lines if value]

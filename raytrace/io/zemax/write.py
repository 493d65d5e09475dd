"""Write a lens as a .zmx file of Zemax OpticStudio: system, surfaces, merit function, configurations.

Every number is written with the digits that read back exactly. Surfaces by numbers that a file does not hold are
converted first (`written_form`). Lines are made in mm. A merit function of lengths and pure numbers depends on the
unit, so a lens with a merit function is written in the unit of its file. A number that came from such a file reads back
as the same number of mm; of other numbers, the file holds the nearest number or its neighbour.
"""

import dataclasses
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from decimal import Context, Decimal
from fractions import Fraction
from functools import partial
from pathlib import Path

from torch import Tensor

from raytrace.io.assembly import catalogs_needed, is_code, is_left_out, listed_name
from raytrace.io.source import (
    MILLIMETRES,
    LensFileError,
    Place,
    exact,
    exact_list,
    is_infinite,
    one_line,
    thickness,
)
from raytrace.io.zemax.configurations import (
    environment_line,
    power_of,
    with_environments,
)
from raytrace.io.zemax.optimization import (
    CURVATURE_SOLVES,
    THICKNESS_SOLVES,
    size_lines,
    statuses,
    tail_lines,
    with_rules,
)
from raytrace.io.zemax.surfaces import (
    AIMING,
    AIMINGS,
    BLANK,
    FAR,
    FIELD_KINDS,
    FIELD_LISTS,
    FIELDS_IN_LISTS,
    GLASS,
    INVERSE,
    NOTE_PIECE,
    POWERS,
    ROWS,
    SIZE,
    SYSTEM_APERTURES,
    TEXT,
    SurfaceType,
    ValueRow,
    aperture_keywords,
    in_millimetres,
    poses_are_parameters,
    spelled_inverse,
    type_of,
    types,
)
from raytrace.io.zemax.written_form import in_file_terms
from raytrace.materials.glass import Glass, abbe_number, mil_glass, nd
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.configurations import Operand, count, same, with_operands
from raytrace.system.elements import mechanical_semi_diameters
from raytrace.system.lens import Lens
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface, is_posed

#: OpticStudio has this many wavelengths.
_WAVELENGTHS = 24


def write(lens: Lens, file: str, *, catalogs: Sequence[Path] = ()) -> bytes:
    """The content of a .zmx file of the lens, in mm or the unit of its merit: ASCII, or UTF-16 where a text needs it.

    file: its name, for messages. catalogs: the user's glass catalogs that the lens was read with.
    Raises LensFileError for data that a .zmx file cannot hold: a batch of lenses, nan, two apertures on one surface,
    more than 8 aspheric terms or 24 wavelengths, a glass whose coefficients are not those of its catalog.
    """
    body = partial(_body, file=file, catalogs=catalogs)
    lens = dataclasses.replace(in_file_terms(lens, Place(file)), ray_aiming=_aiming(lens))
    lines = [*body(lens), *tail_lines(lens.optimization_data, Place(file)), *_operand_lines(lens, body, file)]
    text = "\n".join(lines) + "\n"
    return text.encode("ascii") if text.isascii() else b"\xff\xfe" + text.encode("utf-16-le")


def _body(lens: Lens, file: str, catalogs: Sequence[Path]) -> list[str]:
    """The system and the surfaces."""
    lines = _system(lens, Place(file), catalogs)
    widths = mechanical_semi_diameters(lens, [_stored_size(lens, k) or 0.0 for k in range(len(lens.surfaces))])
    for number, surface in enumerate(lens.surfaces):
        place = Place(file, None, number)
        lines += with_rules(_surface(lens, number, surface, widths[number], place), lens, number, place)
    return _in_unit(lines, 1.0 if lens.optimization_data is None else lens.optimization_data.unit, Place(file))


# -- the system -------------------------------------------------------------------------------------------------------


def _system(lens: Lens, place: Place, catalogs: Sequence[Path]) -> list[str]:
    fields, aperture = lens.fields, lens.aperture
    if len(lens.wavelengths) > _WAVELENGTHS:
        message = f"{len(lens.wavelengths)} wavelengths, a .zmx file has at most {_WAVELENGTHS}; write a table (.csv)"
        raise LensFileError(message, place)
    keyword, flag = SYSTEM_APERTURES[aperture.kind]
    size = exact(aperture.value, "system aperture", place)
    stored = lens.surfaces[lens.stop].semi_diameter
    if aperture.kind == "float_by_stop" and stored is not None and stored != float(aperture.value):
        message = f"the aperture floats by a stop of {float(aperture.value)!r} mm, but its semi-diameter is {stored!r}"
        raise LensFileError(f"{message}; a .zmx file holds one of them", place._replace(surface=lens.stop))
    vignetting = fields.vignetting if fields.vignetting is not None else fields.x.new_zeros(5, len(fields.x))
    weights = exact_list(lens.wavelength_weights, "weight of a wavelength", place)
    waves = zip(exact_list(lens.wavelengths, "wavelength", place), weights, strict=True)
    kind, aiming = FIELD_KINDS.index(fields.kind), _aiming(lens)
    notes = []
    for note in lens.notes:
        text = one_line(note, "a note", place)
        notes += [f"NOTE 0 {text[start : start + NOTE_PIECE]}" for start in range(0, len(text), NOTE_PIECE)] + [
            "NOTE 4"
        ]
    return [
        "VERS 171115 0 0",
        "MODE SEQ",
        f"NAME {one_line(lens.name, 'the title', place)}".rstrip(),
        *notes,
        "PFIL 0 0 0",
        "LANG 0",
        "UNIT MM X W X CM MR CPMM",
        keyword if keyword == "FLOA" else " ".join([keyword, size, *([] if flag is None else [str(flag)])]),
        environment_line(lens, place),
        "GFAC 0 0",
        f"GCAT {' '.join(catalogs_needed(lens, catalogs, place.file))}".rstrip(),
        *([] if aiming == "auto" else [f"RAIM 0 {AIMINGS.index(aiming)} 1 1 0 0 0 0 0"]),
        "PUSH 0 0 0 0 0 0",
        *size_lines(lens.optimization_data),
        f"FTYP {kind} {int(fields.telecentric)} {len(fields.x)} {len(lens.wavelengths)} 0 0 {int(lens.afocal)}",
        "ROPD 2",
        "PICB 1",
        *_fields((fields.x, fields.y, fields.weight, *vignetting), place),
        *(f"WAVM {slot} {wavelength} {weight}" for slot, (wavelength, weight) in enumerate(waves, 1)),
        f"PWAV {lens.primary_wavelength}",
    ]


def _aiming(lens: Lens) -> str:
    """Ray aiming: "auto" aims the rays of a lens with a tilted stop, or with tilted surfaces before it."""
    stop = lens.surfaces[lens.stop]
    moved = stop.is_break or stop.before is not None or any(map(is_posed, lens.surfaces[: lens.stop]))
    return "real" if lens.ray_aiming == "auto" and moved else lens.ray_aiming


def _fields(lists: Sequence[Tensor], place: Place) -> list[str]:
    """The lists of fields, and a line for every field beyond those that they hold."""
    rows = FIELD_LISTS.values()
    texts = [exact_list(numbers, row.quantity, place) for row, numbers in zip(rows, lists, strict=True)]
    lines = [f"{row.keywords[0]} {' '.join(text[:FIELDS_IN_LISTS])}" for row, text in zip(rows, texts, strict=True)]
    further = list(zip(*(text[FIELDS_IN_LISTS:] for text in texts), strict=True))
    number = FIELDS_IN_LISTS + len(further)
    lines += [f"FENF {number} {number}"] if further else []
    return lines + [" ".join(["FEFD", *numbers]) for numbers in further]


# -- a surface --------------------------------------------------------------------------------------------------------


def _stored_size(lens: Lens, number: int) -> float | None:
    """The semi-diameter of a surface as stored, mm, or that of the stop by which the aperture floats."""
    floats = number == lens.stop and lens.aperture.kind == "float_by_stop"
    return float(lens.aperture.value) if floats else lens.surfaces[number].semi_diameter


def _surface(lens: Lens, number: int, surface: Surface, width: float, place: Place) -> list[str]:
    kind = _type(surface, place)
    semi_diameter, fixed = _stored_size(lens, number), surface.mechanical_semi_diameter is not None
    size = "0 0" if semi_diameter is None else f"{exact(semi_diameter, ROWS['SDIA'].quantity, place)} 1"
    # an aperture that follows the semi-diameter from one configuration to the next
    followed = [place.path[:3] for operand in lens.operands if operand.name == "SDIA" for place in operand.paths]
    posed = () if kind == "COORDBRK" or poses_are_parameters(surface) else ((1, "before"), (2, "after"))
    comment = one_line(surface.comment, "the comment", place)
    return [
        f"SURF {number}",
        *(["  STOP"] if number == lens.stop else []),
        f"  TYPE {kind}",
        *(f"  SCBD {side} {_pose(surface, name, place)}" for side, name in posed if getattr(surface, name) is not None),
        f'  CURV {ROWS["CRVT"].write(surface, place)} 0 0 0 0 ""',
        *_numbers(surface, types()[kind], place),
        f"  DISZ {_thickness(surface.thickness, place)}",
        *_glass(surface.glass, place),
        *([] if surface.expansion is None else [f"  TCED {ROWS['TCEX'].write(surface, place)} 0 0"]),
        *([] if surface.conic is None else [f"  CONI {ROWS['CONN'].write(surface, place)}"]),
        f'  DIAM {size} 0 0 1 ""',
        *([] if not surface.chip_zone else [f'  OEMA {exact(surface.chip_zone, "chip zone", place)} 0 0 0 1 ""']),
        f'  MEMA {exact(width, "mechanical semi-diameter", place)} {int(fixed)} 0 0 1 ""',
        *_apertures(surface.apertures, place, ("surfaces", number, "apertures") in followed),
        *([f"  COMM {comment}"] if comment else []),
    ]


def _thickness(number: Tensor, place: Place) -> str:
    text = thickness(number, "INFINITY", place)
    if place.surface == 0 and text != "INFINITY" and float(text) >= FAR:
        raise LensFileError(f"the object is {text} mm away, which OpticStudio takes for infinity; make it inf", place)
    return text


#: Fields of a surface's shape, as an error calls them.
_SHAPE = {
    "curvature": "curvature",
    "conic": "conic constant",
    "coefficients": "aspheric terms",
    "sag_terms": "sag terms",
    "phase": "phase",
}


def _type(surface: Surface, place: Place) -> str:
    """The TYPE of a surface. Raises LensFileError for a surface that no type holds."""
    kind, part = type_of(surface), surface.phase or surface.sag_terms
    feature = "a coordinate break" if surface.is_break else type(part).__name__ if part else surface.kind
    if kind is None:
        message = f"a .zmx file has no type for a surface of {feature}; write a table (.csv)"
        raise LensFileError(message, place)
    row = types()[kind]
    for name, quantity in _SHAPE.items():
        if getattr(surface, name) is not None and name not in row.holds:
            quantity = quantity if quantity.endswith("terms") else f"a {quantity}"
            raise LensFileError(f"{feature} with {quantity}: a {kind} surface has none", place)
    if row.is_break and (not is_left_out(surface.glass) or surface.apertures or surface.after is not None):
        message = "a coordinate break with a medium, an aperture or a pose behind it"
        raise LensFileError(f"{message}; a .zmx file holds none of them: put it on a surface of its own", place)
    if surface.coefficients is not None and surface.coefficients.dim() == 1:
        shape, terms = KINDS[surface.kind], surface.coefficients
        if part is not None and surface.kind != EVEN:
            message = f"{feature} on a surface that is {surface.kind}, expected one that is an {EVEN} at most"
            raise LensFileError(f"{message}; a .zmx file holds no such surface", place)
        most = row.most if kind == "XASPHERE" else shape.most or shape.parameters
        if bool((terms[most:] != 0).any()):
            message = f"{len(terms)} terms (to r^{shape.step * len(terms)}), an {kind} has {most}{row.powers}"
            raise LensFileError(f"{message}; write a table (.csv)", place)
    return kind


def _numbers(surface: Surface, row: SurfaceType, place: Place) -> list[str]:
    """PARM and XDAT lines."""
    try:
        numbers = row.numbers(surface)
    except ValueError as error:
        raise LensFileError(f"{error}; a .zmx file cannot hold it", place) from error
    lines = []
    for j, number in numbers.parameters.items():
        text = exact(number, f"parameter {j} of a surface that is {row.name}", place)
        lines.append(f"  PARM {j} {spelled_inverse(float(text)) if row.parameters[j].power is INVERSE else text}")
    if numbers.terms is None:
        return lines
    terms = exact_list(numbers.terms, f"terms of a surface that is {row.name}", place)
    data = [repr(float(len(terms))), exact(numbers.radius, "radius of normalisation", place), *terms]
    return lines + [f'  XDAT {i} {text} 0 0 1.0 0.0 0 ""' for i, text in enumerate(data, 1)]


def _pose(surface: Surface, name: str, place: Place) -> str:
    """Order, decentres and tilts of an SCBD line, of the pose `before` or `after` a surface."""
    pose = getattr(surface, name)
    if pose.z is not None:
        message = "a decentre along z; add it to the thickness before; a .zmx file cannot hold it"
        raise LensFileError(message, place)
    numbers = (row.write(surface, place) for row in ROWS.values() if row.path.startswith(f"{name}."))
    return " ".join([str(int(pose.tilts_first)), "0", *numbers])


def _glass(glass: Glass, place: Place) -> list[str]:
    if is_left_out(glass):
        return []
    if glass.formula == "mirror":
        return ["  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0"]
    if glass.formula == "constant":
        figures = [*exact_list(glass.coefficients, "index", place), "0", "0"]
    elif glass.formula == "model":
        figures = exact_list(glass.coefficients, "model glass", place)
    else:
        listed = glass.nd_listed or float(nd(glass)), glass.abbe_listed or float(abbe_number(glass))
        words = " ".join(exact(number, "index or Abbe number", place) for number in listed)  # for a substitute
        return [f"  GLAS {listed_name(glass, place)} 0 0 {words} 0 0 0 0 0 0"]
    flag, name = 1, listed_name(glass, place) if glass.name else BLANK
    if name.upper() in ("AIR", "MIRROR"):
        raise LensFileError(f"a glass of index {figures[0]} is named {name!r}; give it another name", place)
    if is_code(name) and exact_list(mil_glass(name).coefficients, "model glass", place) == figures:
        flag = 0
    return [f"  GLAS {name} {flag} 0 {' '.join(figures)} 0 0 0 0 0"]


def _apertures(apertures: tuple[Aperture, ...], place: Place, floats: bool) -> list[str]:
    if not apertures:
        return []
    if len(apertures) > 1:
        message = f"{len(apertures)} apertures, a surface of a .zmx file has one"
        raise LensFileError(f"{message}; put the others on dummy surfaces, or write a table (.csv)", place)
    aperture = apertures[0]
    sizes, shape = [exact(number, "size of the aperture", place) for number in aperture.extent], SHAPES[aperture.shape]
    keyword = "FLAP" if floats else shape.zemax[aperture.obscures]
    lines = [f"  {keyword} {' '.join(sizes)} 0"] if shape.sizes else [f"  {keyword} 0 0 0", *_corners(sizes, place)]
    if any(aperture.centre):
        x, y = (exact(number, ROWS["APDX"].quantity, place) for number in aperture.centre)
        lines.append(f"  OBDC {x} {y}")
    return lines


def _corners(sizes: Sequence[str], place: Place) -> list[str]:
    """UDAD lines of the corners of polygons; 0 0 0 in place of the corner that closes a polygon."""
    points = list(zip(sizes[::2], sizes[1::2], strict=True))
    if any(float(x) == float(y) == 0 for x, y in points):
        raise LensFileError("a polygon has a corner at 0, 0, by which a .zmx file ends it; write a table (.csv)", place)
    first, lines = 0, []
    for k, point in enumerate(points):
        closes = k > first and point == points[first]
        lines.append("0 0 0" if closes else f"{point[0]} {point[1]} 0")
        first = k + 1 if closes else first
    return [f"  UDAD {k} {line}" for k, line in enumerate(lines if lines[-1] == "0 0 0" else [*lines, "0 0 0"], 1)]


# -- the unit of length -----------------------------------------------------------------------------------------------

#: Powers of length of the numbers of solves, by their keywords.
_SOLVES = {
    keyword: {k: power for k, power in enumerate(row.powers, 1 + row.from_surface) if power}
    for keyword, row in THICKNESS_SOLVES.items()
}


def _in_unit(lines: Iterable[str], millimetres: float, place: Place) -> list[str]:
    """The lines of the system and the surfaces, in mm, in a unit of `millimetres`."""
    if millimetres == 1:
        return list(lines)
    unit = next((name for name in ("MM", "CM", "IN", "METER") if MILLIMETRES[name] == millimetres), None)
    if unit is None:
        message = f"a unit of {millimetres!r} mm, expected 1, 10, 25.4 or 1000 (MM, CM, IN, METER)"
        raise LensFileError(message, place)
    angles, row, converted = False, types()["STANDARD"], []
    for line in lines:
        words = line.split()
        keyword = words[0] if words else ""
        if keyword == "UNIT":
            line = line.replace("MM", unit, 1)
        elif keyword == "FTYP":
            angles = words[1] == "0"
        elif keyword == "TYPE":
            row = types()[words[1]]
        if powers := _powers_of(words, row, angles):
            indent = line[: len(line) - len(line.lstrip())]
            numbers = (in_file(w, powers[k], millimetres) if k in powers else w for k, w in enumerate(words))
            line = indent + " ".join(numbers)
        converted.append(line)
    return converted


def _powers_of(words: list[str], row: SurfaceType, angles: bool) -> Mapping[int, int | None]:
    """The power of length of the words of a line that have one; row: the type of its surface."""
    keyword = words[0] if words else ""
    if keyword in ("PARM", "PPAR"):
        j, position = int(words[1]), 2 if keyword == "PARM" else 4
        power = row.parameters[j].power if j in row.parameters else 0
        power = 0 if power is INVERSE and keyword == "PPAR" else power
        return {position: power} if power != 0 and len(words) > position else {}
    if keyword == "XDAT":
        power = {1: 0, 2: 1}.get(int(words[1]), row.terms or 0)
        return {2: power} if power else {}
    if keyword == "CURV" and len(words) > 3 and int(words[2]) in CURVATURE_SOLVES:
        solved = CURVATURE_SOLVES[int(words[2])].powers
        return POWERS["CURV"] | {k: power for k, power in enumerate(solved, 3) if power}
    if keyword in (FIELD_LISTS["x"].keywords[0], FIELD_LISTS["y"].keywords[0]):
        return {} if angles else dict.fromkeys(range(1, len(words)), 1)
    if keyword == "FEFD":
        return {} if angles else {1: 1, 2: 1}
    shape, _ = aperture_keywords().get(keyword, ("", False))
    return dict.fromkeys(range(1, 1 + (SHAPES[shape].sizes or 0)), 1) if shape else (POWERS | _SOLVES).get(keyword, {})


def in_file(word: str, power: int | None, millimetres: float) -> str:
    """A number in powers of mm as one in powers of a unit of `millimetres`; infinity and 0 unchanged."""
    if is_infinite(word) or not float(word):
        return word
    if power is INVERSE:
        length = Fraction(word) / Fraction(repr(millimetres))
        return str(Context(prec=40).divide(Decimal(length.numerator), Decimal(length.denominator)))
    number = float(word)
    start = number / millimetres**power if power >= 0 else number * millimetres**-power
    if not math.isfinite(start):
        return word
    candidates, above, below = [start], start, start  # a number and its neighbours, nearest first
    for _ in range(4):
        above, below = math.nextafter(above, math.inf), math.nextafter(below, -math.inf)
        candidates += [above, below]
    return repr(next((c for c in candidates if in_millimetres(c, power, millimetres) == number), start))


# -- configurations ---------------------------------------------------------------------------------------------------


def _operand_lines(lens: Lens, body: Callable[[Lens], list[str]], file: str) -> list[str]:
    """MNUM and a line for every operand in every configuration, by the row of its value.

    body: the lines of system and surfaces of a lens. Raises LensFileError for operands that the lines cannot give, and
    for a configuration that a file cannot hold.
    """
    original, lens, place = lens, with_environments(lens, Place(file)), Place(file)
    if not lens.operands:
        return ["MNUM 1 1", 'MOFF   0   1 "" 0 0 0 1 1 0 0.0 ""']
    numbers = range(1, count(lens.operands) + 1)
    for k in numbers:
        body(with_operands(lens, k))  # refuses a value that no file can hold
    lines = [f"MNUM {len(numbers)} {lens.current_configuration}"]
    rules = statuses(original, lens.operands)
    for position, operand in enumerate(lens.operands):
        values = [_value(operand, k, lens, place) for k in range(len(numbers))]
        names = [value.upper() for value in values] if operand.media else []
        for k, name in enumerate(names):  # a file identifies glasses by their names, model glasses too
            if not same(operand.media[k], operand.media[names.index(name)]):
                message = f"{operand} has two glasses named {name!r}; a .zmx file distinguishes them by name"
                raise LensFileError(message, place._replace(surface=operand.number))
        parameter = operand.parameter if operand.name in ("PRAM", "EDVA") else 0
        for k, value in zip(numbers, values, strict=True):
            is_text = operand.numbers is None and not (value and all(c in "0123456789+-.eE" for c in value))
            default = ("0", '0 1 1 0 0.0 ""' if is_text else "0 1 1 1.0 0.0 0")
            status, words = rules.get((position, k)) or default
            value = f'"{value}"' if is_text else value
            lines.append(f"{operand.name:<4} {operand.number:>3} {k:>3} {value} {status} {parameter} {words}")
    return lines


def _value(operand: Operand, k: int, lens: Lens, place: Place) -> str:
    """The value of an operand in configuration k, from 0, in the unit of the file."""
    row = ROWS.get(operand.name) if operand.paths else None
    if operand.numbers is not None:
        number = operand.numbers[k]
        if operand.name == "THIC" and operand.number == 0 and number.ndim == 0 and float(number) == math.inf:
            return repr(FAR)
        text = exact(number, str(operand), place)
        return text if row is None else _in_file_unit(text, operand, row, lens)
    content = operand.values()[k]
    if row is not None and row.keyword == "XDAT":
        raise LensFileError(f"{operand}: terms of another number or radius in each configuration, not written", place)
    if row is None:
        return one_line(str(content), str(operand), place).replace('"', "'")
    if row.kind == GLASS:
        line = _glass(operand.media[k], place)
        return line[0].split()[row.word] if line else ""
    if row.kind == SIZE:
        return "0" if content is None else _in_file_unit(exact(content, str(operand), place), operand, row, lens)
    if row.kind == AIMING and content in AIMINGS:
        content = AIMINGS.index(content)
    return one_line(str(content if row.kind in (AIMING, TEXT) else int(content)), str(operand), place).replace('"', "'")


def _in_file_unit(text: str, operand: Operand, row: ValueRow, lens: Lens) -> str:
    """A number of an operand in powers of mm as the file has it."""
    unit, power = 1.0 if lens.optimization_data is None else lens.optimization_data.unit, power_of(row, lens)
    if not row.path:
        parameter = int(operand.name[3]) if operand.name[:3] == "PAR" else operand.parameter
        power = types()[type_of(lens.surfaces[operand.number]) or ""].power(row.keyword, parameter)
        text = spelled_inverse(float(text)) if power is INVERSE else text
    return text if unit == 1 or power == 0 else in_file(text, power, unit)

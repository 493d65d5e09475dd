"""Write a lens as a .zmx file that Zemax OpticStudio reads, every number with the digits that bring it back exactly."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from torch import Tensor

from raytrace.io.materials import catalogs_needed, is_code, is_left_out, listed_name
from raytrace.io.source import LensFileError, Place
from raytrace.io.spelling import exact, exact_list, one_line, thickness
from raytrace.io.zemax import environment as zemax_environment
from raytrace.io.zemax import merit as zemax_merit
from raytrace.io.zemax import optimization_write
from raytrace.io.zemax.keywords import (
    AIMINGS,
    BLANK,
    FIELD_KINDS,
    FIELD_LISTS,
    FIELDS_IN_LISTS,
    NOTE_PIECE,
    SYSTEM_APERTURES,
)
from raytrace.io.zemax.numbers import INVERSE, SurfaceType, numbers_of, spelled_inverse
from raytrace.io.zemax.optimization_write import in_unit, operand_lines, with_pickups
from raytrace.io.zemax.surface_types import stands_in_parameters, type_of, types
from raytrace.materials.glass import Glass, mil_glass
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.lens import Lens
from raytrace.system.poses import Pose
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface, is_posed

#: OpticStudio has this many wavelengths.
_WAVELENGTHS = 24


def write(lens: Lens, file: str, *, catalogs: Sequence[Path] = ()) -> bytes:
    """The content of a .zmx file of the lens, in mm or the unit of its merit: ASCII, or UTF-16 where a text needs it.

    file: its name, for messages. catalogs: the user's glass catalogs that the lens was read with.
    Raises LensFileError for what a .zmx file cannot hold: a batch of lenses, nan, two apertures on one surface, more
    than 8 aspheric terms or 24 wavelengths, a glass whose figures are not those of its catalog.
    """
    body = partial(_body, file=file, catalogs=catalogs)
    lines = [*body(lens), *_merit(lens, Place(file)), *operand_lines(lens, body, file)]
    text = "\n".join(lines) + "\n"
    return text.encode("ascii") if text.isascii() else b"\xff\xfe" + text.encode("utf-16-le")


def _merit(lens: Lens, place: Place) -> list[str]:
    """Merit function and tolerances; the line that there are none of these."""
    merit, tolerances = (
        ((), ())
        if lens.optimization_data is None
        else (lens.optimization_data.merit, lens.optimization_data.tolerances)
    )
    told = [one_line(line, "a tolerance", place) for line in tolerances]
    return [*zemax_merit.lines(merit, place), *(told or ["TOL TOFF   0   0 0 0   0 0 0 0 0"])]


def _body(lens: Lens, file: str, catalogs: Sequence[Path]) -> list[str]:
    """The system and the surfaces."""
    lines = _system(lens, Place(file), catalogs)
    for number, surface in enumerate(lens.surfaces):
        place = Place(file, None, number)
        own = optimization_write.with_rules(_surface(lens, number, surface, place), lens, number, place)
        lines += with_pickups(own, lens, number, place)
    return in_unit(lines, 1.0 if lens.optimization_data is None else lens.optimization_data.unit, Place(file))


def _system(lens: Lens, place: Place, catalogs: Sequence[Path]) -> list[str]:
    fields, aperture = lens.fields, lens.aperture
    if len(lens.wavelengths) > _WAVELENGTHS:
        message = f"{len(lens.wavelengths)} wavelengths, a .zmx file has at most {_WAVELENGTHS}; write a table (.csv)"
        raise LensFileError(message, place)
    keyword, flag = SYSTEM_APERTURES[aperture.kind]
    words = [keyword, exact(aperture.value, "system aperture", place), *([] if flag is None else [str(flag)])]
    _check_floating_stop(lens, place)
    vignetting = fields.vignetting if fields.vignetting is not None else fields.x.new_zeros(5, len(fields.x))
    kind = FIELD_KINDS.index(fields.kind)
    weights = exact_list(lens.wavelength_weights, "weight of a wavelength", place)
    waves = zip(exact_list(lens.wavelengths, "wavelength", place), weights, strict=True)
    return [
        "VERS 171115 0 0",
        "MODE SEQ",
        f"NAME {one_line(lens.name, 'the title', place)}".rstrip(),
        *_notes(lens.notes, place),
        "PFIL 0 0 0",
        "LANG 0",
        "UNIT MM X W X CM MR CPMM",
        keyword if keyword == "FLOA" else " ".join(words),
        zemax_environment.line(lens, place),
        "GFAC 0 0",
        f"GCAT {' '.join(catalogs_needed(lens, catalogs, place.file))}".rstrip(),
        *_ray_aiming(lens),
        "PUSH 0 0 0 0 0 0",
        optimization_write.margin(lens.optimization_data),
        f"FTYP {kind} {int(fields.telecentric)} {len(fields.x)} {len(lens.wavelengths)} 0 0 0",
        "ROPD 2",
        "PICB 1",
        *_fields((fields.x, fields.y, fields.weight, *vignetting), place),
        *(f"WAVM {slot} {wavelength} {weight}" for slot, (wavelength, weight) in enumerate(waves, 1)),
        f"PWAV {lens.primary_wavelength}",
    ]


def _fields(lists: Sequence[Tensor], place: Place) -> list[str]:
    """The lists of fields, and a line for every field beyond those that they hold."""
    texts = [exact_list(numbers, row.what, place) for row, numbers in zip(FIELD_LISTS.values(), lists, strict=True)]
    rows = zip(FIELD_LISTS.values(), texts, strict=True)
    told = [f"{row.keywords[0]} {' '.join(text[:FIELDS_IN_LISTS])}" for row, text in rows]
    further = list(zip(*(text[FIELDS_IN_LISTS:] for text in texts), strict=True))
    count = FIELDS_IN_LISTS + len(further)
    return [*told, *([f"FENF {count} {count}"] if further else []), *(" ".join(["FEFD", *one]) for one in further)]


def _ray_aiming(lens: Lens) -> list[str]:
    """RAIM; none of a lens that specifies no ray aiming, unless a surface up to the stop is posed: it is aimed then."""
    front = lens.surfaces[: lens.stop + 1]
    aiming = "real" if lens.ray_aiming == "auto" and any(map(is_posed, front)) else lens.ray_aiming
    return [] if aiming == "auto" else [f"RAIM 0 {AIMINGS.index(aiming)} 1 1 0 0 0 0 0"]


def _check_floating_stop(lens: Lens, place: Place) -> None:
    """FLOA has no number of its own: it is the stop's DIAM."""
    stored = lens.surfaces[lens.stop].semi_diameter
    if lens.aperture.kind == "float_by_stop" and stored is not None and stored != float(lens.aperture.value):
        message = (
            f"the aperture floats by a stop of {float(lens.aperture.value)!r} mm, but its semi-diameter is {stored!r}"
        )
        raise LensFileError(f"{message}; a .zmx file holds one of them", place._replace(surface=lens.stop))


def _notes(notes: Sequence[str], place: Place) -> list[str]:
    lines = []
    for note in notes:
        text = one_line(note, "a note", place)
        pieces = [text[start : start + NOTE_PIECE] for start in range(0, len(text), NOTE_PIECE)]
        lines += [f"NOTE 0 {piece}" for piece in pieces] + ["NOTE 4"]
    return lines


def _surface(lens: Lens, number: int, surface: Surface, place: Place) -> list[str]:
    kind = _type(surface, place)
    curvature = "0.0" if surface.curvature is None else exact(surface.curvature, "curvature", place)
    semi_diameter = surface.semi_diameter
    if number == lens.stop and lens.aperture.kind == "float_by_stop":
        semi_diameter = float(lens.aperture.value)
    size = "0 0" if semi_diameter is None else f"{exact(semi_diameter, 'semi-diameter', place)} 1"
    lines = [
        f"SURF {number}",
        *(["  STOP"] if number == lens.stop else []),
        f"  TYPE {kind}",
        *_poses(surface, kind, place),
        f'  CURV {curvature} 0 0 0 0 ""',
        *_numbers(surface, types()[kind], place),
        f"  DISZ {thickness(surface.thickness, 'INFINITY', place)}",
        *_glass(surface.glass, place),
        *([] if surface.conic is None else [f"  CONI {exact(surface.conic, 'conic constant', place)}"]),
        f'  DIAM {size} 0 0 1 ""',
        *_apertures(surface.apertures, place, _floats(lens, number)),
    ]
    comment = one_line(surface.comment, "the comment", place)
    return [*lines, f"  COMM {comment}"] if comment else lines


#: Fields of a surface's shape, by what an error calls them.
_SHAPE = {
    "curvature": "curvature",
    "conic": "conic constant",
    "coefficients": "aspheric terms",
    "sag_terms": "added sag terms",
    "phase": "phase",
}


def _type(surface: Surface, place: Place) -> str:
    """The TYPE of a surface. Raises LensFileError for what none holds."""
    found = type_of(surface)
    if found is None:
        message = f"a .zmx file has no type for a surface of {_own(surface)}; write a table (.csv)"
        raise LensFileError(message, place)
    row = types()[found]
    for name, what in _SHAPE.items():
        if getattr(surface, name) is not None and name not in row.holds:
            raise LensFileError(f"{_own(surface)} with a {what}: a {found} surface has none", place)
    if found == "COORDBRK" and (not is_left_out(surface.glass) or surface.apertures or surface.after is not None):
        message = "a coordinate break with a medium, an aperture or a pose behind it"
        raise LensFileError(f"{message}; a .zmx file holds none of them: put it on a surface of its own", place)
    if surface.coefficients is not None and surface.coefficients.dim() == 1:
        _check_terms(surface, found, place)
    return found


def _own(surface: Surface) -> str:
    """What is special of a surface, as an error calls it."""
    if surface.is_break:
        return "a coordinate break"
    return type(surface.phase or surface.sag_terms).__name__ if surface.phase or surface.sag_terms else surface.kind


def _check_terms(surface: Surface, found: str, place: Place) -> None:
    kind, row, terms = KINDS[surface.kind], types()[found], surface.coefficients
    if (surface.phase is not None or surface.sag_terms is not None) and surface.kind != EVEN:
        message = f"{_own(surface)} on a surface that is {surface.kind}, expected one that is an {EVEN} at most"
        raise LensFileError(f"{message}; a .zmx file holds no such surface", place)
    most = row.most if found == "XASPHERE" else kind.most or kind.parameters
    if bool((terms[most:] != 0).any()):
        message = f"{len(terms)} terms (to r^{kind.step * len(terms)}), an {found} has {most}{row.powers}"
        raise LensFileError(f"{message}; write a table (.csv)", place)


def _numbers(surface: Surface, row: SurfaceType, place: Place) -> list[str]:
    """PARM and XDAT lines."""
    try:
        told = row.numbers(surface)
    except ValueError as error:
        raise LensFileError(f"{error}; a .zmx file cannot hold it", place) from error
    lines = []
    for j, number in told.parameters.items():
        text = exact(number, f"parameter {j} of a surface that is {row.name}", place)
        lines.append(f"  PARM {j} {spelled_inverse(float(text)) if row.parameters[j] is INVERSE else text}")
    if told.terms is None:
        return lines
    terms = exact_list(told.terms, f"terms of a surface that is {row.name}", place)
    data = [repr(float(len(terms))), exact(told.radius, "radius of normalisation", place), *terms]
    return lines + [f'  XDAT {i} {text} 0 0 1.0 0.0 0 ""' for i, text in enumerate(data, 1)]


def _poses(surface: Surface, kind: str, place: Place) -> list[str]:
    """SCBD lines of the poses before and behind a surface, but for those that are its PARM."""
    if kind == "COORDBRK" or stands_in_parameters(surface):
        return []
    found = ((1, surface.before), (2, surface.after))
    return [f"  SCBD {where} {_pose(pose, place)}" for where, pose in found if pose is not None]


def _pose(pose: Pose, place: Place) -> str:
    try:
        told = numbers_of(pose)
    except ValueError as error:
        raise LensFileError(f"{error}; a .zmx file cannot hold it", place) from error
    return " ".join([str(int(pose.tilts_first)), "0", *(exact(number, "tilt or decentre", place) for number in told)])


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
        return [f"  GLAS {listed_name(glass, place)} 0 0 1.5 40 0 0 0 0 0 0"]
    flag, name = 1, listed_name(glass, place) if glass.name else BLANK
    if name.upper() in ("AIR", "MIRROR"):
        raise LensFileError(f"a glass of index {figures[0]} is named {name!r}; give it another name", place)
    if is_code(name) and exact_list(mil_glass(name).coefficients, "model glass", place) == figures:
        flag = 0
    return [f"  GLAS {name} {flag} 0 {' '.join(figures)} 0 0 0 0 0"]


def _floats(lens: Lens, number: int) -> bool:
    """Whether the aperture of a surface follows its semi-diameter from one configuration to the next."""
    followed = [place.path[:3] for operand in lens.operands if operand.name == "SDIA" for place in operand.paths]
    return ("surfaces", number, "apertures") in followed


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
        x, y = (exact(number, "decentre of the aperture", place) for number in aperture.centre)
        lines.append(f"  OBDC {x} {y}")
    return lines


def _corners(sizes: Sequence[str], place: Place) -> list[str]:
    """UDAD lines of the corners of polygons; 0 0 0 in place of the corner that comes again."""
    points = list(zip(sizes[::2], sizes[1::2], strict=True))
    if any(float(x) == float(y) == 0 for x, y in points):
        raise LensFileError("a polygon has a corner at 0, 0, by which a .zmx file ends it; write a table (.csv)", place)
    first, lines = 0, []
    for k, point in enumerate(points):
        closes = k > first and point == points[first]
        lines.append("0 0 0" if closes else f"{point[0]} {point[1]} 0")
        first = k + 1 if closes else first
    return [f"  UDAD {k} {line}" for k, line in enumerate(lines if lines[-1] == "0 0 0" else [*lines, "0 0 0"], 1)]

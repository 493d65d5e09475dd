"""The system of a .zmx file: unit, aperture, fields, wavelengths, notes, configurations."""

import re

import torch
from torch import Tensor

from raytrace.formats.report import Draft
from raytrace.formats.source import LensFileError, is_number, shown
from raytrace.formats.zemax_keywords import FIELD_KINDS, FIELD_NAMES, MILLIMETRES
from raytrace.formats.zemax_records import Block, Record
from raytrace.system.lens import RAY_AIMING, Fields, SystemAperture

#: OpticStudio cuts a long note into pieces of this many characters.
NOTE_PIECE = 200

#: More field points or wavelengths than any file has.
_MOST = 1000


def millimetres(system: Block, report: Draft) -> float:
    """Millimetres in the file's unit of length."""
    record = system.last("UNIT")
    if record is None:
        report.note("no UNIT: lengths are in mm")
        return 1.0
    unit = record.words[0].upper() if record.words else ""
    if unit not in MILLIMETRES:
        raise LensFileError(f"UNIT is {shown(unit)}, expected one of MM, CM, IN, METER", record.place)
    if unit != "MM":
        report.note(f"lengths of the file are in {unit}; converted to mm")
    return MILLIMETRES[unit]


def aperture(system: Block, stop_semi_diameter: float | None, unit: float, report: Draft) -> SystemAperture:
    """The system aperture: ENPD, FNUM (0 image space, 1 working), OBNA (0 sine, 1 cone angle) or FLOA (by the stop)."""
    found = system.all("ENPD", "FNUM", "OBNA", "FLOA")
    if not found:
        raise LensFileError("no system aperture; expected one of ENPD, FNUM, OBNA, FLOA", system.place)
    record = found[-1]
    if len({other.keyword for other in found}) > 1:
        names = " and ".join(f"{other.keyword} in line {other.place.line}" for other in found)
        report.warn(f"several system apertures ({names}); the last is used", record.place)
    if record.keyword == "FLOA":
        if not stop_semi_diameter:
            raise LensFileError("FLOA (float by stop size), but the stop surface has no DIAM", record.place)
        return SystemAperture("float_by_stop", _tensor(stop_semi_diameter))
    size = record.number(0, "size of the aperture")
    if size <= 0:
        raise LensFileError(f"{record.keyword} is {shown(record.words[0])}, expected a positive number", record.place)
    if record.keyword == "ENPD":
        return SystemAperture("entrance_pupil_diameter", _tensor(size * unit))
    kinds = ("image_f_number", "working_f_number") if record.keyword == "FNUM" else ("object_na", "object_cone_angle")
    flag = record.integer(1, "kind of the aperture", 0)
    if flag not in (0, 1):
        raise LensFileError(f"{record.keyword} of kind {flag}, expected 0 or 1", record.place)
    return SystemAperture(kinds[flag], _tensor(size))


def _count(system: Block, position: int, what: str) -> int | None:
    record = system.last("FTYP")
    if record is None or len(record.words) <= position:
        return None
    count = record.integer(position, what)
    if not 1 <= count <= _MOST:
        raise LensFileError(f"FTYP: {what} is {count}, expected 1 to {_MOST}", record.place)
    return count


def fields(system: Block, unit: float, report: Draft) -> Fields:
    """The field points: FTYP (kind, telecentric, count), XFLN, YFLN, weights and vignetting factors."""
    record = system.last("FTYP")
    kind = record.integer(0, "kind of field", 0) if record else 0
    if not 0 <= kind < len(FIELD_KINDS):
        name = f" ({FIELD_NAMES[kind]})" if kind in FIELD_NAMES else ""
        raise LensFileError(f"FTYP {kind}{name} is not modelled; expected a kind of field from 0 to 3", record.place)
    x, y = system.last("XFLN", "XFLD"), system.last("YFLN", "YFLD")
    count = _count(system, 2, "number of fields")
    if count is None:
        count = max([1, *(_used(line) for line in (x, y) if line)])
        place = record.place if record else system.place
        report.warn(f"the number of fields is not stated (FTYP, third value); {count} taken", place)
    length = 1.0 if kind == 0 else unit

    def values(name: str, *keywords: str, default: float | None = 0.0) -> list[float]:
        return _list(system, keywords, count, f"{name} of field", default, report)

    columns = (("VDX", 0.0), ("VDY", 0.0), ("VCX", 0.0), ("VCY", 0.0), ("VAN", 0.0))
    vignetting = torch.tensor(
        [values(name, f"{name}N", f"Z{name}", name, default=default) for name, default in columns], dtype=torch.float64
    )
    return Fields(
        kind=FIELD_KINDS[kind],
        x=_tensor([length * value for value in values("x", "XFLN", "XFLD")]),
        y=_tensor([length * value for value in values("y", "YFLN", "YFLD")]),
        weight=_tensor(values("weight", "FWGN", "FWGT", default=1.0)),
        vignetting=vignetting if bool(vignetting.any()) else None,
        telecentric=bool(record.integer(1, "telecentric", 0)) if record else False,
    )


def _used(record: Record) -> int:
    """How many numbers of a list are meant: lists of twelve are padded with zeros."""
    words = list(record.words)
    while len(record.words) >= 12 and len(words) > 1 and words[-1].strip("+-0.eE") == "":
        words.pop()
    return len(words)


def _list(
    system: Block, keywords: tuple[str, ...], count: int, what: str, default: float, report: Draft
) -> list[float]:
    record = system.last(*keywords)
    if record is None:
        return [default] * count
    if len(record.words) < count and what.split()[0] in ("x", "y"):
        raise LensFileError(f"{record.keyword} has {len(record.words)} values for {count} fields", record.place)
    if len(record.words) < count:
        message = f"{record.keyword} has {len(record.words)} values for {count}; the others are taken as {default:g}"
        report.warn(message, record.place)
    return [record.number(position, what, default) for position in range(count)]


def wavelengths(system: Block, report: Draft) -> tuple[Tensor, Tensor, int]:
    """Wavelengths in µm, their weights, and the 0-based position of the primary one.

    WAVM holds padded slots of which FTYP tells the number in use; older files carry lists (WAVN or WAVL).
    """
    slots = {record.integer(0, "number of the wavelength"): record for record in system.all("WAVM")}
    listed, weights = system.last("WAVN", "WAVL"), system.last("WWGN", "WWGT")
    count = _count(system, 3, "number of wavelengths") or _guessed_count(system, slots, report)
    if all(slot in slots for slot in range(1, count + 1)):
        chosen = [slots[slot] for slot in range(1, count + 1)]
        pairs = [(record.number(1, "wavelength"), record.number(2, "weight", 1.0), record.place) for record in chosen]
    elif listed is not None and len(listed.words) >= count:
        weight = [weights.number(k, "weight", 1.0) if weights else 1.0 for k in range(count)]
        pairs = [(listed.number(k, "wavelength"), weight[k], listed.place) for k in range(count)]
    else:
        place = (slots or {0: system}).popitem()[1].place
        found = f"WAVM {', '.join(map(str, sorted(slots)[:6]))}" if slots else "no WAVM"
        raise LensFileError(f"{found}, expected {count} wavelengths (WAVM 1 to {count})", place)
    for wavelength, weight, place in pairs:
        if not wavelength > 0:
            raise LensFileError(f"wavelength {wavelength:g} µm, expected a positive number", place)
        if weight < 0:
            raise LensFileError(f"weight {weight:g} of a wavelength, expected 0 or more", place)
    return _tensor([pair[0] for pair in pairs]), _tensor([pair[1] for pair in pairs]), _primary(system, count, report)


def _guessed_count(system: Block, slots: dict[int, Record], report: Draft) -> int:
    short = system.last("WAVL")
    count = len(short.words) if short else len(slots)
    place = short.place if short else system.place
    if not 1 <= count <= 12:
        raise LensFileError("the number of wavelengths is not stated (FTYP, fourth value)", place)
    report.warn(f"the number of wavelengths is not stated (FTYP, fourth value); {count} taken", place)
    return count


def _primary(system: Block, count: int, report: Draft) -> int:
    record = system.last("PWAV")
    if record is None:
        if count > 1:
            report.warn("no PWAV: the first wavelength is taken as the primary one", system.place)
        return 0
    primary = record.integer(0, "primary wavelength")
    if not 1 <= primary <= count:
        raise LensFileError(f"PWAV is {primary}, expected 1 to {count}, the number of wavelengths", record.place)
    return primary - 1


def notes(system: Block) -> tuple[str, ...]:
    """The notes: NOTE 0 holds text in pieces of 200 characters, any other number ends a note."""
    found, continues = [], False
    for record in system.all("NOTE"):
        kind, _, text = record.text.partition(" ")
        if kind != "0":
            continues = False
            continue
        if continues:
            found[-1] += text
        else:
            found.append(text)
        continues = len(text) >= NOTE_PIECE
    stripped = (note.strip() for note in found)
    return tuple(note for note in stripped if note and note != "Notes...")


def ray_aiming(system: Block) -> str:
    """Whether RAIM, in its second number, asks for rays aimed at the stop: 0 off, 1 paraxial, 2 real reference."""
    record = system.last("RAIM")
    kind = record.integer(1, "ray aiming", 0) if record else 0
    if not 0 <= kind < len(RAY_AIMING):
        raise LensFileError(f"RAIM of kind {kind}, expected 0 (off), 1 (paraxial) or 2 (real)", record.place)
    return list(RAY_AIMING)[kind]


def remarks(system: Block, surfaces: list[Block], tail: list[Record], report: Draft) -> None:
    """Say what the file asks for and the lens does not carry: environment, apodisation, afocal, configurations."""
    environment = system.last("ENVD")
    if environment and environment.words:
        celsius, pressure = environment.number(0, "temperature"), environment.number(1, "pressure", 1.0)
        if (celsius, pressure) != (20.0, 1.0):
            message = f"environment of {celsius:g} °C and {pressure:g} atm; indices are those of 20 °C and 1 atm"
            report.warn(message, environment.place)
    apodisation = system.last("GFAC")
    if apodisation and apodisation.integer(1, "kind of apodisation", 0):
        report.warn("the beam is apodised (GFAC); taken as uniform", apodisation.place)
    field_type = system.last("FTYP")
    if field_type and field_type.integer(6, "afocal", 0):
        report.warn("afocal image space (FTYP, seventh value); the image is taken as a plane", field_type.place)
    configurations = system.last("MNUM")
    count = configurations.integer(0, "number of configurations", 1) if configurations else 1
    if configurations:
        operands = [other for other in tail if _is_operand(other, configurations)]
        active = (
            1 if count == 1 else configurations.integer(1, "active configuration", 0) or _active(surfaces, operands)
        )
        if count > 1:
            _say_which(configurations, count, active, operands, report)
        else:
            _only_configuration(operands, surfaces, report)
        _environment([other for other in operands if not active or int(other.words[1]) == active], report)


def _is_operand(record: Record, head: Record) -> bool:
    """Whether a record after the surfaces is a multi-configuration operand: after MNUM, as `THIC surface number …`."""
    if record.place.line <= head.place.line or record.keyword == "MOFF" or len(record.words) < 3:
        return False
    return all(re.fullmatch(r"-?[0-9]{1,6}", word) for word in record.words[:2])


def _environment(operands: list[Record], report: Draft) -> None:
    """Warn of operands that set a temperature or a pressure, which move every index."""
    told = {"PRES": ("1", "atm", "pressure"), "TEMP": ("20", "°C", "temperature")}
    for operand in operands:
        normal, unit, what = told.get(operand.keyword, (None, "", ""))
        if normal is None or not is_number(operand.words[2]) or float(operand.words[2]) == float(normal):
            continue
        number, value = operand.words[1], float(operand.words[2])
        message = f"{operand.keyword} {value:g} {unit} ({what} of configuration {number}): not followed; "
        report.warn(f"{message}indices are those at {normal} {unit}", operand.place)


def _only_configuration(operands: list[Record], surfaces: list[Block], report: Draft) -> None:
    """Warn of operands of a single configuration, but for those that only repeat what the surfaces hold."""
    for operand in operands:
        if operand.keyword in ("PRES", "TEMP") or _stored(operand, surfaces):
            continue
        surface, _, value = operand.words[:3]
        value = f"{float(value):g}" if is_number(value) else value
        report.warn(f"multi-configuration operand {operand.keyword} {surface} = {value}: not followed", operand.place)


def _stored(operand: Record, surfaces: list[Block]) -> bool | None:
    """Whether a surface holds the value of an operand: None for operands other than CRVT and THIC."""
    keyword = {"CRVT": "CURV", "THIC": "DISZ"}.get(operand.keyword)
    if keyword is None or not is_number(operand.words[2]):
        return None
    surface, value = int(operand.words[0]), float(operand.words[2])
    stored = surfaces[surface].last(keyword) if 0 <= surface < len(surfaces) else None
    if not stored or not stored.words or not is_number(stored.words[0]):
        return None
    return abs(float(stored.words[0]) - value) <= 1e-9 * abs(value)


def _say_which(record: Record, count: int, active: int, operands: list[Record], report: Draft) -> None:
    """The surfaces of a file hold the configuration that was active when it was saved."""
    which = f"configuration {active} of {count}" if active else f"one of {count} configurations"
    varied = ", ".join(sorted({operand.keyword for operand in operands})[:8]) or "nothing"
    message = f"multi-configuration file: {which} read, as stored in its surfaces; they differ in {varied}"
    if active == 1:
        report.note(message)
    else:
        report.warn(message, record.place)


def _active(surfaces: list[Block], operands: list[Record]) -> int:
    """The configuration whose curvatures and thicknesses are those of the surfaces; 0 if that singles out none."""
    agrees: dict[int, bool] = {}
    for operand in operands:
        same = _stored(operand, surfaces)
        if same is not None:
            configuration = int(operand.words[1])
            agrees[configuration] = agrees.get(configuration, True) and same
    active = [configuration for configuration, same in agrees.items() if same]
    return active[0] if len(active) == 1 else 0


def _tensor(numbers: float | list[float]) -> Tensor:
    return torch.tensor(numbers, dtype=torch.float64)

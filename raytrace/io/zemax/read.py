"""Read a sequential lens file of Zemax OpticStudio (.zmx); surface types and their parameters: `surfaces.py`.

Three stages: text -> records with line numbers -> the keyword table -> Lens. Conventions, each verified against numbers
that OpticStudio itself stored:

- The file stores solved values; nothing is solved again. Lengths are in the file's UNIT and become mm.
- DIAM is a semi-diameter and clips no ray. CLAP, FLAP, SQAP, ELAP clip, OBSC, SQOB, ELOB obscure, about OBDC. FLAP, the
  floating aperture, is the circle of the surface's DIAM.
- A surface without TYPE is STANDARD. CURV 0 and CONI 0 become None: a plane, a sphere.
- EVENASPH: PARM j is the coefficient of r^(2j), from r² on.
- WAVM has padded slots, field lists are padded; FTYP gives the numbers in use. PWAV counts from 1.
- The surfaces of a multi-configuration file hold the configuration active when it was saved, normally the first;
  the others are read from its operands.
"""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

from raytrace.io.assembly import MOST_POINTS, CatalogSources, LensDraft, assemble, catalogs_of_lens
from raytrace.io.source import (
    MILLIMETRES,
    Block,
    Draft,
    LensFileError,
    Record,
    UnsupportedSurface,
    refuse_few,
    shown,
    unit_of,
)
from raytrace.io.zemax import configurations, optimization
from raytrace.io.zemax.surfaces import (
    AIMINGS,
    FIELD_KINDS,
    FIELD_LISTS,
    FIELD_NAMES,
    NOTE_PIECE,
    ROWS,
    SYSTEM_APERTURES,
    Sections,
    build,
    measured,
    medium,
    refuse_unsupported,
    sections,
)
from raytrace.system.lens import Lens
from raytrace.system.surface import Surface


def read(
    text: str,
    file: str,
    report: Draft,
    catalogs: Sequence[Path] = (),
    *,
    configuration: int | None = None,
    packed: CatalogSources | None = None,
) -> Lens:
    """The lens of a .zmx text; report: filled.

    file: its name, for messages. catalogs: further glass catalogs (.agf). configuration: its number, from 1; None: the
    one that the surfaces hold. packed: the catalogs of an archive, instead of those in the folder of the file.
    Raises LensFileError, UnsupportedSurface (a type that is not modelled) and UnknownGlass.
    """
    parts = sections(text, file, report)
    _refuse_incomplete(parts)
    refuse_unsupported(parts.surfaces)
    unit = _millimetres(parts.system, report)
    names = tuple(name for record in parts.system.all("GCAT") for name in record.words)
    came = catalogs_of_lens(names, catalogs, report, packed)
    surfaces = [
        build(block, unit, parts.surfaces, catalogs=came, user=catalogs, report=report) for block in parts.surfaces
    ]
    lens = _lens(parts, surfaces, unit, report, file)
    for keyword, position, quantity, message in (
        ("GFAC", 1, "kind of apodisation", "the beam is apodised (GFAC); taken as uniform"),
        (
            "FTYP",
            6,
            "afocal",
            "afocal image space (FTYP, seventh value); spots and wavefronts are those on the image surface",
        ),
    ):
        if parts.system.integer(keyword, quantity, 0, position):
            report.warn(message, parts.system.place_of(keyword))
    of_name = partial(medium, catalogs=came, user=catalogs, report=report.again())
    typed = optimization.typed_surfaces(parts, lens, unit)
    rules = optimization.rules_of(typed, report)
    as_stored = configurations.LensFile(parts, lens, unit, typed, rules, of_name)
    lens, configured = configurations.read(as_stored, report, configuration)
    lens = optimization.read(parts, lens, typed, rules, configured, report)
    configurations.report_environment(parts, lens, report)
    return lens


def _lens(parts: Sections, surfaces: Sequence[Surface], unit: float, report: Draft, file: str) -> Lens:
    """The lens of these surfaces and the records of the system."""
    system, marked = parts.system, _stop(parts.surfaces)
    stop = marked.place.surface or 0
    name, environment = system.last("NAME"), configurations.environment(system)
    aiming, primary = system.last("RAIM"), system.last("PWAV")
    kind = system.integer("RAIM", "ray aiming", 0, 1)
    if not 0 <= kind < len(AIMINGS):
        raise LensFileError(f"RAIM of kind {kind}, expected 0 (off), 1 (paraxial) or 2 (real)", system.place_of("RAIM"))
    wavelengths = _wavelengths(system, report)
    if primary is None and len(wavelengths["wavelengths"]) > 1:
        report.warn("no PWAV: the first wavelength is taken as the primary one", system.place)
    aperture_kind, aperture, source = _aperture(system, surfaces[stop].semi_diameter, unit, report)
    draft = LensDraft(
        surfaces=surfaces,
        stop=stop,
        aperture_kind=aperture_kind,
        aperture=aperture,
        **_fields(system, unit, report),
        **wavelengths,
        primary_wavelength=system.integer("PWAV", "primary wavelength", 1),
        name=name.text.strip() if name else "",
        notes=_notes(system),
        catalogs=tuple(name for record in system.all("GCAT") for name in record.words),
        ray_aiming=AIMINGS[kind] if aiming else "auto",
        afocal=bool(system.integer("FTYP", "afocal", 0, 6)),
        environment=environment,
    )
    draft.sources |= {
        "stop": ("STOP", marked.place),
        "aperture": (f"{source.keyword} is {shown(' '.join(source.words[:1]))}", source.place),
    }
    if primary:
        draft.sources["primary_wavelength"] = ("PWAV", primary.place)
    return assemble(draft, file)


def _refuse_incomplete(parts: Sections) -> None:
    mode = parts.system.last("MODE")
    if mode and mode.words[:1] != ("SEQ",):
        message = f"MODE {' '.join(mode.words)[:40]}: only sequential files (MODE SEQ) are modelled"
        raise UnsupportedSurface(message, mode.place)
    refuse_few(parts.surfaces)
    image = parts.surfaces[-1].last("DISZ")
    if image and image.words and image.words[0].strip("+-0.eE") != "":
        message = f"the last surface has thickness {image.words[0][:40]}, but the image has DISZ 0; image cut off?"
        raise LensFileError(message, image.place)


def _stop(surfaces: Sequence[Block]) -> Record:
    stops = [record for block in surfaces if (record := block.last("STOP"))]
    if not stops:
        raise LensFileError("no surface is marked STOP; add the line STOP to the aperture stop", surfaces[0].place)
    if len(stops) > 1:
        first = stops[0].place.surface
        raise LensFileError(f"a second STOP; surface {first} is the stop already", stops[1].place)
    return stops[0]


def _millimetres(system: Block, report: Draft) -> float:
    """Millimetres in the file's unit of length."""
    record = system.last("UNIT")
    if record is None:
        report.note("no UNIT: lengths are in mm")
        return 1.0
    unit = record.words[0].upper() if record.words else ""
    return unit_of(unit, MILLIMETRES, "UNIT", "one of MM, CM, IN, METER", record.place, report)


def _aperture(system: Block, stop_semi_diameter: float | None, unit: float, report: Draft) -> tuple[str, float, Record]:
    """The system aperture: ENPD, FNUM (0 image space, 1 working), OBNA (0 sine, 1 cone angle) or FLOA (by the stop)."""
    keywords = dict.fromkeys(keyword for keyword, _ in SYSTEM_APERTURES.values())
    record = system.last_of_kind(keywords, "system aperture", report)
    if record.keyword == "FLOA":
        if not stop_semi_diameter:
            raise LensFileError("FLOA (float by stop size), but the stop surface has no DIAM", record.place)
        return "float_by_stop", stop_semi_diameter, record
    size = measured(record, 0, "size of the aperture", unit)
    flag = None if record.keyword == "ENPD" else record.integer(1, "kind of the aperture", 0)
    kind = next((kind for kind, row in SYSTEM_APERTURES.items() if row == (record.keyword, flag)), None)
    if kind is None:
        raise LensFileError(f"{record.keyword} of kind {flag}, expected 0 or 1", record.place)
    if kind == "object_cone_angle" and size > 90:
        message = (
            f"a cone of {record.words[0]} degrees reaches behind the object; rays leave on the same lines forwards"
        )
        limit = f"within {180 - size:g} degrees of the axis, and cover less of a reflector"
        report.warn(f"{message}, {limit}", record.place)
    return kind, size, record


def _count(system: Block, position: int, quantity: str) -> int | None:
    record = system.last("FTYP")
    if record is None or len(record.words) <= position:
        return None
    count = record.integer(position, quantity)
    if not 1 <= count <= MOST_POINTS:
        raise LensFileError(f"FTYP: {quantity} is {count}, expected 1 to {MOST_POINTS}", record.place)
    return count


def _fields(system: Block, unit: float, report: Draft) -> dict:
    """The field points: FTYP (kind, telecentric, count), XFLN, YFLN, weights and vignetting factors."""
    kind = system.integer("FTYP", "kind of field", 0)
    if not 0 <= kind < len(FIELD_KINDS):
        name = f" ({FIELD_NAMES[kind]})" if kind in FIELD_NAMES else ""
        raise LensFileError(
            f"FTYP {kind}{name} is not modelled; expected a kind of field from 0 to 3", system.place_of("FTYP")
        )
    count = _count(system, 2, "number of fields")
    if count is None:
        count = 1
        for line in filter(None, (system.last(*FIELD_LISTS[axis].keywords) for axis in "xy")):
            words = list(line.words)  # lists of twelve are padded with zeros
            while len(line.words) >= 12 and len(words) > 1 and words[-1].strip("+-0.eE") == "":
                words.pop()
            count = max(count, len(words))
        place = system.place_of("FTYP")
        report.warn(f"the number of fields is not stated (FTYP, third value); {count} taken", place)
    lists = {name: _list(system, name, count, report) for name in sorted(FIELD_LISTS, key=str.islower)}
    length = 1.0 if kind == 0 else unit
    return {
        "field_kind": FIELD_KINDS[kind],
        "x": [length * value for value in lists["x"]],
        "y": [length * value for value in lists["y"]],
        "field_weights": lists["weight"],
        "vignetting": [lists[name] for name in FIELD_LISTS if name.isupper()],
        "telecentric": bool(system.integer("FTYP", "telecentric", 0, 1)),
    }


def _list(system: Block, name: str, count: int, report: Draft) -> list[float]:
    """A list over the field points, a row of FIELD_LISTS."""
    keywords, default, _ = FIELD_LISTS[name]
    record = system.last(*keywords)
    if record is None:
        return [default] * count
    if len(record.words) < count:
        message = f"{record.keyword} has {len(record.words)} values for {count}"
        if name in "xy":
            raise LensFileError(f"{message} fields", record.place)
        report.warn(f"{message}; the others are taken as {default:g}", record.place)
    return [record.number(position, f"{name} of field", default) for position in range(count)]


def _wavelengths(system: Block, report: Draft) -> dict:
    """Wavelengths in µm, their weights, and their source.

    WAVM holds padded slots, of which FTYP gives the number in use; older files have lists (WAVN or WAVL).
    """
    slots = {record.integer(0, "number of the wavelength"): record for record in system.all("WAVM")}
    listed, weights = system.last("WAVN", "WAVL"), system.last("WWGN", "WWGT")
    count = _count(system, 3, "number of wavelengths")
    if count is None:
        short = system.last("WAVL")
        count = len(short.words) if short else len(slots)
        place = short.place if short else system.place
        if not 1 <= count <= 12:
            raise LensFileError("the number of wavelengths is not stated (FTYP, fourth value)", place)
        report.warn(f"the number of wavelengths is not stated (FTYP, fourth value); {count} taken", place)
    if all(slot in slots for slot in range(1, count + 1)):
        chosen = [slots[slot] for slot in range(1, count + 1)]
        pairs = [(ROWS["WAVE"].read(record), ROWS["WLWT"].read(record, 1.0, 1.0), record) for record in chosen]
    elif listed is not None and len(listed.words) >= count:
        weight = [weights.number(k, "weight", 1.0) if weights else 1.0 for k in range(count)]
        pairs = [(listed.number(k, "wavelength"), weight[k], listed) for k in range(count)]
    else:
        place = system.place_of("WAVM")
        message = f"WAVM {', '.join(map(str, sorted(slots)[:6]))}" if slots else "no WAVM"
        raise LensFileError(f"{message}, expected {count} wavelengths (WAVM 1 to {count})", place)
    wrong = next((record for wave, weight, record in pairs if not wave > 0 or weight < 0), pairs[0][2])
    source = (wrong.keyword, wrong.place)
    return {
        "wavelengths": [wave for wave, _, _ in pairs],
        "wavelength_weights": [weight for _, weight, _ in pairs],
        "sources": {"wavelengths": source, "wavelength_weights": source},
    }


def _notes(system: Block) -> tuple[str, ...]:
    """The notes: NOTE 0 holds text in lines of 200 characters, any other number ends a note."""
    notes: list[str] = []
    continues = False
    for record in system.all("NOTE"):
        kind, _, text = record.text.partition(" ")
        if kind != "0":
            continues = False
            continue
        if continues:
            notes[-1] += text
        else:
            notes.append(text)
        continues = len(text) >= NOTE_PIECE
    stripped = (note.strip() for note in notes)
    return tuple(note for note in stripped if note and note != "Notes...")

"""Read a sequential lens file of Zemax OpticStudio (.zmx).

Three stages: text -> records with line numbers -> the keyword table -> Lens. Conventions, each settled against numbers
that OpticStudio itself stored:

- The file carries solved values; nothing is solved again. Lengths are in the file's UNIT and become mm.
- DIAM is a semi-diameter, and alone clips no ray. CLAP, FLAP, SQAP, ELAP clip, OBSC, SQOB, ELOB obscure, about OBDC.
  FLAP, the floating aperture, is the circle of the surface's DIAM.
- A surface without TYPE is STANDARD. CURV 0 and CONI 0 become None: a plane, a sphere.
- EVENASPH: PARM j is the coefficient of r^(2j), from r² on.
- WAVM has padded slots, field lists are padded; FTYP tells how many are used. PWAV counts from 1.
- The surfaces of a multi-configuration file hold the configuration active when it was saved, normally the first.
"""

from collections.abc import Sequence
from pathlib import Path

from raytrace.formats import zemax_surface, zemax_system
from raytrace.formats.finite import refuse_overflow
from raytrace.formats.media import report_missing_catalogs
from raytrace.formats.report import Draft, ImportReport
from raytrace.formats.source import LensFileError, UnsupportedSurface
from raytrace.formats.zemax_records import Block, Sections, sections
from raytrace.system.lens import Lens


def read(text: str, file: str, *, catalogs: Sequence[Path] = (), strict: bool = False) -> tuple[Lens, ImportReport]:
    """The lens of a .zmx text and the report of its import.

    file: its name, for messages. catalogs: further glass catalogs (.agf). strict: every warning is an error.
    Raises LensFileError, UnsupportedSurface (a type that is not modelled) and UnknownGlass.
    """
    report = Draft(file, "zmx")
    found = sections(text, file, report)
    _refuse_incomplete(found)
    zemax_surface.refuse_unsupported(found.surfaces)
    system = found.system
    unit = zemax_system.millimetres(system, report)
    stop = _stop(found.surfaces)
    catalog_names = tuple(name for record in system.all("GCAT") for name in record.words)
    report_missing_catalogs(catalog_names, catalogs, report)
    surfaces = tuple(
        zemax_surface.build(block, unit, catalogs=catalog_names, user=catalogs, report=report)
        for block in found.surfaces
    )
    wavelengths, weights, primary = zemax_system.wavelengths(system, report)
    name = system.last("NAME")
    lens = Lens(
        surfaces=surfaces,
        stop=stop,
        aperture=zemax_system.aperture(system, surfaces[stop].semi_diameter, unit, report),
        fields=zemax_system.fields(system, unit, report),
        wavelengths=wavelengths,
        wavelength_weights=weights,
        primary_wavelength=primary,
        name=name.text.strip() if name else "",
        notes=zemax_system.notes(system),
        catalogs=catalog_names,
        ray_aiming=zemax_system.ray_aiming(system),
    )
    refuse_overflow(lens, file)
    zemax_system.remarks(system, found.surfaces, found.tail, report)
    return lens, report.finished(strict=strict)


def _refuse_incomplete(found: Sections) -> None:
    mode = found.system.last("MODE")
    if mode and mode.words[:1] != ("SEQ",):
        message = f"MODE {' '.join(mode.words)[:40]}: only sequential files (MODE SEQ) are modelled"
        raise UnsupportedSurface(message, mode.place)
    surfaces = found.surfaces
    if len(surfaces) < 3:
        message = f"{len(surfaces)} surfaces, expected at least object, one surface and image; file cut off?"
        raise LensFileError(message, surfaces[-1].place)
    image = surfaces[-1].last("DISZ")
    if image and image.words and image.words[0].strip("+-0.eE") != "":
        message = f"the last surface has thickness {image.words[0][:40]}, but the image has DISZ 0; image cut off?"
        raise LensFileError(message, image.place)


def _stop(surfaces: Sequence[Block]) -> int:
    stops = [block.last("STOP") for block in surfaces if block.last("STOP")]
    if not stops:
        raise LensFileError("no surface is marked STOP; add the line STOP to the aperture stop", surfaces[0].place)
    if len(stops) > 1:
        first = stops[0].place.surface
        raise LensFileError(f"a second STOP; surface {first} is the stop already", stops[1].place)
    stop = stops[0].place
    if not 0 < stop.surface < len(surfaces) - 1:
        raise LensFileError("STOP on the object or the image; expected a surface between them", stop)
    return stop.surface

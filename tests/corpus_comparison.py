"""Comparison of a lens file of third parties with an oracle."""

import dataclasses
import functools
import json
import warnings

import torch
from problems import SHARED

from raytrace.io import UnsupportedSurface, read_lens
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import constant, refractive_index
from raytrace.system.lens import Lens
from raytrace.system.rays import start
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.trace import steps

CORPUS = SHARED / "corpus"

RIGHT, REFUSED, WRONG = "loaded and right", "refused by name", "wrong"

MILLIMETRES = {"MM": 1.0, "CM": 10.0, "IN": 25.4, "METER": 1000.0}


@dataclasses.dataclass
class Comparison:
    """One file: outcome, what was refused or wrong, and the largest differences found."""

    file: str
    outcome: str
    details: str
    index: float = 0.0
    first_order: float = 0.0
    rays: float = 0.0
    editions: dict = dataclasses.field(default_factory=dict)


INDEX_TOLERANCE = 1e-6  # glass figures of one edition, computed in float64; the oracle stores its own at 1e-6

FIRST_ORDER_TOLERANCE = 1e-8  # relative: a few hundred roundings of two programs in float64

RAY_TOLERANCE = 1e-9  # mm and direction cosines: a picometre, what two float64 tracers of 100 surfaces agree to

#: Oracle entry -> name in FirstOrder.
FIRST_ORDER = {
    "efl": "effective_focal_length",
    "bfl": "back_focal_distance",
    "enp": "entrance_pupil_position",
    "epd": "entrance_pupil_diameter",
    "exp_from_img": "exit_pupil_position",
    "fno": "f_number",
    "mag": "magnification",
    "parax_img_dist": "paraxial_image_distance",
}

PURE_NUMBERS = ("fno", "mag")

#: Glasses whose shipped figures are not of the oracle's edition: (name, oracle's source) -> largest |Δn| found. None
#: today: every glass of the corpus that is shipped agrees to the last digit.
OTHER_EDITIONS: dict[tuple[str, str], float] = {}


@functools.cache
def oracle() -> dict:
    return json.loads((CORPUS / "oracle.json").read_text(encoding="utf-8"))


@functools.cache
def compare(name: str) -> Comparison:
    """Read one file of the corpus and hold everything its oracle marks as certain against it."""
    entry = oracle()[name]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lens = read_lens(CORPUS / "zmx" / name)
    except (UnsupportedSurface, UnknownGlass) as refusal:
        message = str(refusal).replace(str(CORPUS / "zmx"), "").lstrip("/")
        return Comparison(name, REFUSED, f"{type(refusal).__name__}: {message}")
    result = Comparison(name, RIGHT, "")
    faults = [
        *compare_system(lens, entry),
        *compare_indices(lens, entry, result),
        *compare_first_order(lens, entry, result),
        *compare_rays(lens, entry, result),
    ]
    if faults:
        result.outcome, result.details = WRONG, "; ".join(faults)
    return result


def compare_system(lens: Lens, entry: dict) -> list[str]:
    system = entry["system"]
    found = {
        "surfaces": (len(lens.surfaces), system["nsurf"]),
        "stop": (lens.stop, system["stop"]),
        "primary": (lens.primary_wavelength - 1, system["primary"]),
        "wavelengths": (lens.wavelengths.tolist(), system["waves"]),
        "telecentric": (lens.fields.telecentric, system["telecentric"]),
    }
    return [f"{what} {ours}, oracle {theirs}" for what, (ours, theirs) in found.items() if ours != theirs]


def compare_indices(lens: Lens, entry: dict, result: Comparison) -> list[str]:
    """(a) Every catalog, model and MIL glass at every wavelength of the file."""
    faults = []
    for medium in entry["index"]:
        ours = refractive_index(lens.surfaces[medium["surf"]].glass, lens.wavelengths)
        theirs = torch.tensor(medium["n"], dtype=torch.float64)
        difference = (ours - theirs).abs().max().item()
        key = (medium["glass"], medium["source"])
        if key in OTHER_EDITIONS:
            result.editions[key] = max(difference, result.editions.get(key, 0.0))
        else:  # entries that no second program confirms are held to the same gate: all of them pass
            result.index = max(result.index, difference)
            if not difference <= INDEX_TOLERANCE:
                faults.append(f"index of {medium['glass']} ({medium['source']}) off by {difference:.1e}")
    return faults


def with_media(lens: Lens, n_primary: list[float]) -> Lens:
    """The lens with every medium replaced by the oracle's index; mirrors stay mirrors."""
    surfaces = [
        surface if surface.is_mirror else dataclasses.replace(surface, glass=constant(n))
        for surface, n in zip(lens.surfaces, n_primary, strict=True)
    ]
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def index_of_focal_length(paraxial: dict) -> float:
    """Focal length in air over focal length in the medium of the image, both of the oracle.

    The oracle's F/# is the latter over the entrance pupil diameter, OpticStudio's the former: test_paraxial has
    semi-diameters that OpticStudio stored for an image in glass.
    """
    focal_length = paraxial["efl"]
    return abs(focal_length["efl_air"] / focal_length["own"]) if "efl_air" in focal_length else 1.0


def compare_first_order(lens: Lens, entry: dict, result: Comparison) -> list[str]:
    """(b) First-order data with the media of the oracle, relative to the larger of the number and the focal length."""
    data = first_order(with_media(lens, entry["n_primary"]))
    unit = MILLIMETRES[entry["system"]["unit"]]
    faults = []
    for key, name in FIRST_ORDER.items():
        expected = (entry["paraxial_at_own_index"] or {}).get(key)
        if not isinstance(expected, dict) or not expected["oracle"] or expected["own"] is None:
            continue
        theirs = expected["own"] * (1.0 if key in PURE_NUMBERS else unit)
        if key == "fno":
            theirs *= index_of_focal_length(entry["paraxial_at_own_index"])
        ours = getattr(data, name).item()
        size = max(abs(theirs), 1e-30 if key in PURE_NUMBERS else 1.0)  # 1 mm: a position may be 0
        difference = abs(ours - theirs) / size
        result.first_order = max(result.first_order, difference)
        if not difference <= FIRST_ORDER_TOLERANCE:
            faults.append(f"{name} {ours!r}, oracle {theirs!r}")
    return faults


def compare_rays(lens: Lens, entry: dict, result: Comparison) -> list[str]:
    """(b) Every hit and every direction at every surface, in mm, with the media of the oracle."""
    unit = MILLIMETRES[entry["system"]["unit"]]
    indices = [torch.tensor(n, dtype=torch.float64) for n in media_of(lens, entry["n_primary"])]
    surfaces = [dataclasses.replace(surface, apertures=()) for surface in lens.surfaces[1:]]
    wavelength, faults = lens.primary, []
    for ray in entry["rays"]:
        if not ray["oracle"]:
            continue
        rays = start(
            torch.tensor(ray["P"], dtype=torch.float64) * unit,
            torch.tensor(ray["D"], dtype=torch.float64),
        )
        for number, (crossing, out) in enumerate(
            zip(steps(surfaces, rays, indices=indices, wavelength=wavelength), ray["out"], strict=True), 1
        ):
            if out is None:
                continue
            found = torch.cat([crossing.rays.position, crossing.rays.direction])
            expected = torch.tensor(out, dtype=torch.float64)
            expected[:3] *= unit
            difference = (found - expected).abs().max().item() if bool(crossing.rays.valid) else float("inf")
            result.rays = max(result.rays, difference)
            if not difference <= RAY_TOLERANCE:
                faults.append(f"ray {ray['name']} off by {difference:.1e} mm at surface {number}")
                break
    return faults


def media_of(lens: Lens, n_primary: list[float]) -> list[float]:
    """Indices behind every surface, the medium before a mirror or a coordinate break carried on behind it."""
    media = []
    for surface, n in zip(lens.surfaces, n_primary, strict=True):
        media.append(media[-1] if surface.is_mirror or surface.is_break else n)
    return media


def table() -> list[dict[str, str]]:
    """Its rows in docs/corpus.csv."""
    rows = []
    for r in map(compare, sorted(oracle())):
        editions = [f"{glass} differs from {source} by {d:.1e}" for (glass, source), d in r.editions.items()]
        details = "; ".join(filter(None, [r.details, *editions]))
        rows.append({"corpus": "files of all kinds", "file": r.file, "types": "", **numbers(r), "details": details})
    return rows


def numbers(result: Comparison) -> dict[str, str]:
    """Outcome and largest differences of a file, which a refused one has not."""
    figures = {"index": result.index, "first order, relative": result.first_order, "rays, mm": result.rays}
    known = result.outcome != REFUSED
    return {"outcome": result.outcome} | {name: f"{value:.0e}" if known else "" for name, value in figures.items()}

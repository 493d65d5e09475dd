"""A part of stock: the glass of a vendor's lens file, with its focal lengths, diameters, shape and glasses."""

import dataclasses
import math
import re
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.materials.glass import AIR, Glass, abbe_number, is_air, nd
from raytrace.system.elements import lens_elements
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.shapes import EVEN
from raytrace.system.surface import Surface, is_posed
from raytrace.tracing.geometry import semi_diameters
from raytrace.tracing.paraxial import FirstOrder, first_order
from raytrace.words import RaytraceError

#: Wavelengths of the F, d and C lines, µm.
_LINES = 0.4861327, 0.5875618, 0.6562725

#: Least power over its change from F to C of an achromat; of a single glass, V, it is below 96.
_ACHROMATIC = 200

#: Vendors by patterns of the text of their files.
_VENDORS = {
    "Thorlabs": r"thorlabs|coatingthor|\bTHOR[A-C]\b",
    "Edmund Optics": r"edmund|^zmax_\d|^\s*COAT EO_",
    "Newport": r"newport",
    "OptoSigma": r"opto-?sigma",
    "Excelitas": r"linos|qioptiq|excelitas",
    "Melles Griot": r"melles\s*griot|cvi\s*(laser|mg)",
    "Eksma": r"eksma",
    "Ross Optical": r"ross\s*optical",
    "Comar": r"comar",
    "Asphericon": r"asphericon",
    "LightPath": r"lightpath",
    "Sill": r"sill\s*opti",
}
#: Additions to part numbers in the names of files.
_ADDED = re.compile(r"^zmax[_-]|[-_ ]+(zemax|zmx|zar)\b.*$|\s*\(zmx\).*$", re.IGNORECASE)
#: A diameter in a title, as "Ø10 mm" or "3mm Diameter".
_DIAMETERS = re.compile(r"[Øø]\s*=?\s*([\d.]+)\s*mm|([\d.]+)\s*mm\s*(?:dia\b|diam|Ø|ø)", re.IGNORECASE)


class NoPart(RaytraceError, ValueError):
    """A file that holds no single lens in air, or a part that an index does not have."""


def part_surfaces(lens: Lens) -> tuple[Surface, ...]:
    """The surfaces of the glass of a part; behind the last one is air, without thickness. Raises NoPart."""
    elements = lens_elements(lens)
    glass = [pair for pair in elements if not is_air(lens.surfaces[pair[0]].glass)]
    if not glass or any(surface.is_mirror for surface in lens.surfaces[1:-1]):
        raise NoPart("a mirror" if any(s.is_mirror for s in lens.surfaces[1:-1]) else "no glass")
    first, last = glass[0][0], glass[-1][1]
    if last == len(lens.surfaces) - 1:
        raise NoPart("the glass reaches the image")
    surfaces = lens.surfaces[first : last + 1]
    if any(is_posed(surface) for surface in surfaces):
        raise NoPart("tilted or decentred surfaces")
    if any(surface.phase is not None for surface in surfaces):
        raise NoPart("a grating, hologram or ideal lens")
    if not is_air(surfaces[-1].glass):
        raise NoPart(f"the last element ends in {surfaces[-1].glass.name}, expected air")
    zero = 0 * surfaces[-1].thickness
    bare = [dataclasses.replace(surface, environment=None, comment="") for surface in surfaces]
    bare[-1] = dataclasses.replace(bare[-1], thickness=zero, glass=AIR)
    return tuple(bare)


def alone(surfaces: Sequence[Surface], wavelengths: Tensor, primary: int = 1) -> Lens:
    """A lens of the surfaces of a part alone in air, its object at infinity."""
    far, zero = (wavelengths.new_tensor(number, dtype=torch.float64) for number in (math.inf, 0.0))
    return Lens(
        surfaces=(Surface(far), *surfaces, Surface(zero)),
        stop=1,
        aperture=SystemAperture("entrance_pupil_diameter", zero + 1.0),
        fields=Fields("angle", zero[None], zero[None], zero[None] + 1),
        wavelengths=wavelengths,
        wavelength_weights=torch.ones_like(wavelengths),
        primary_wavelength=primary,
    )


def data_of(surfaces: Sequence[Surface], wavelength: Tensor) -> FirstOrder:
    """First-order data of the surfaces of a part in air."""
    return first_order(alone(surfaces, wavelength.reshape(1)))


def is_round(surfaces: Sequence[Surface]) -> bool:
    """Whether all faces are conics or even aspheres."""
    return all(surface.kind == EVEN and surface.sag_terms is None for surface in surfaces)


@dataclasses.dataclass(frozen=True)
class Figures:
    """What an index holds of a part, apart from the content of its file; lengths in mm.

    part: its number; shape: as "plano-convex", "doublet" or "cylindrical plano-convex"; efl, bfl: at the primary
    wavelength of the file, in the orientation of the file; diameter: outer one, where the file states it, else the
    clear one; clear: of the smaller face; glasses: in the order of the light; abbe: power over its change from F to C,
    nan outside the range of a glass.
    """

    part: str
    vendor: str
    shape: str
    efl: float
    bfl: float
    diameter: float
    clear: float
    thickness: float
    elements: int
    surfaces: int
    glasses: str
    coating: str
    abbe: float
    wavelength: float

    @property
    def is_achromat(self) -> bool:
        """Whether the part is a cemented group whose power changes by less than 1/200 from F to C."""
        return 1 < self.elements == self.surfaces - 1 and abs(self.abbe) > _ACHROMATIC


def figures_of(lens: Lens, file: str, text: str = "") -> Figures:
    """The figures of the part of a lens file; text: of the file, with its vendor and coatings. Raises NoPart."""
    surfaces = part_surfaces(lens)
    data = data_of(surfaces, lens.primary)
    efl, bfl = float(data.effective_focal_length), float(data.back_focal_distance)
    if not math.isfinite(efl):
        raise NoPart("no power: a window or a prism")
    known = [surface.semi_diameter for surface in (surfaces[0], surfaces[-1])]
    if not all(known):
        first = next(k for k, surface in enumerate(lens.surfaces) if surface.glass is surfaces[0].glass)
        rays = semi_diameters(lens)
        known = [known[0] or rays[first], known[1] or rays[first + len(surfaces) - 1]]
    clear = 2 * min(size for size in known if size)
    titles = " ".join((lens.name, *lens.notes))
    glass = [surface for surface in surfaces if not is_air(surface.glass)]
    return Figures(
        part=_number(lens, file),
        vendor=_vendor(f"{Path(file).name}\n{titles}\n{text}"),
        shape=_shape(surfaces),
        efl=efl,
        bfl=bfl,
        diameter=_outer(titles, text, 2 * max(size for size in known if size)),
        clear=clear,
        thickness=float(sum(surface.thickness for surface in surfaces)),
        elements=len(glass),
        surfaces=len(surfaces),
        glasses=" ".join(_glass_name(surface.glass) for surface in glass),
        coating=" ".join(dict.fromkeys(re.findall(r"^\s*COAT (\S+)", text, re.MULTILINE))),
        abbe=_abbe(surfaces),
        wavelength=float(lens.primary),
    )


def _glass_name(glass: Glass) -> str:
    """The name of a glass in one word, of one without a name nd/Vd."""
    name = glass.listed_name or glass.name
    return name.replace(" ", "_") if name else f"{float(nd(glass)):.4f}/{float(abbe_number(glass)):.1f}"


def _number(lens: Lens, file: str) -> str:
    """The part number: the comment of a surface that the name of the file holds, else that name."""
    stem = Path(file).stem
    comments = [surface.comment.strip() for surface in lens.surfaces if re.search(r"\d", surface.comment)]
    inside = [comment for comment in comments if comment.lower() in stem.lower()]
    return max(inside, key=len) if inside else _ADDED.sub("", stem).strip("-_ ") or stem


def _vendor(text: str) -> str:
    vendors = (name for name, pattern in _VENDORS.items() if re.search(pattern, text, re.IGNORECASE | re.MULTILINE))
    return next(vendors, "")


def _outer(titles: str, text: str, clear: float) -> float:
    """The outer diameter: as stated, if it fits to the clear one, else the mechanical one of the file, or the clear."""
    stated = [
        float(number) for pair in _DIAMETERS.findall(titles) for number in pair if re.fullmatch(r"\d+\.?\d*", number)
    ]
    mechanical = [2 * float(size) for size in re.findall(r"^\s*MEMA ([\d.eE+-]+)", text, re.MULTILINE)]
    return max([clear, *(size for size in (*stated, *mechanical) if clear <= size <= 1.5 * clear)])


def _abbe(surfaces: Sequence[Surface]) -> float:
    """Power at d over its change from F to C; nan outside the range of a glass."""
    lines = torch.tensor(_LINES, dtype=torch.float64)
    try:
        blue, yellow, red = first_order(alone(surfaces, lines), lines).power.tolist()
    except ValueError:
        return math.nan
    return yellow / (blue - red) if blue != red else math.inf


def _shape(surfaces: Sequence[Surface]) -> str:
    """The shape by the faces, in either orientation."""
    count = sum(not is_air(surface.glass) for surface in surfaces)
    kind = "" if is_round(surfaces) else "cylindrical " if _is_cylindrical(surfaces) else "freeform "
    if any(surface.conic is not None or surface.coefficients is not None for surface in surfaces) and not kind:
        kind = "aspheric "
    if count > 1:
        names = {2: "doublet", 3: "triplet"}
        return kind + (names.get(count, "group") if count == len(surfaces) - 1 else "air-spaced group")
    bends = [_sign(surfaces[0]), -_sign(surfaces[-1])]  # 1: convex
    low, high = sorted(bends)
    name = {(1, 1): "biconvex", (-1, -1): "biconcave", (0, 1): "plano-convex", (-1, 0): "plano-concave"}
    return kind + name.get((low, high), "meniscus" if low < 0 < high else "plate")


def _is_cylindrical(surfaces: Sequence[Surface]) -> bool:
    return any(surface.kind in ("toroidal", "biconic") for surface in surfaces)


def _sign(surface: Surface) -> int:
    """Of the curvature, of a cylinder that along y or x."""
    numbers = [] if surface.curvature is None else [float(surface.curvature)]
    if surface.coefficients is not None:
        numbers.append(float(surface.coefficients.reshape(-1)[0]))
    return next((1 if number > 0 else -1 for number in numbers if number), 0)

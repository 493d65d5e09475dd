"""The lens of a file, assembled and checked: the same for every format.

A reader collects the data of a file in a `LensDraft`, in mm and µm; `assemble` checks them and makes the lens.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch.utils import _pytree as pytree

from raytrace.io.source import LensFileError, Place, double
from raytrace.materials.environment import Environment
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.surface import SHAPE, Surface

#: More field points or wavelengths than any file has.
MOST_POINTS = 1000

#: Keyword of the file and its place, by the name of a field of `LensDraft`.
Sources = dict[str, tuple[str, Place]]


@dataclasses.dataclass
class LensDraft:
    """The data of a lens file before they are checked; fields as those of `Lens`.

    aperture: mm, degrees or a pure number, by its kind; x, y: mm or degrees; vignetting: VDX, VDY, VCX, VCY, VAN, a
    number for each field; wavelengths: µm. sources: for the messages of errors, that of the aperture with its value.
    """

    surfaces: Sequence[Surface]
    stop: int
    aperture_kind: str
    aperture: float
    field_kind: str
    x: Sequence[float]
    y: Sequence[float]
    wavelengths: Sequence[float]
    field_weights: Sequence[float] | None = None
    vignetting: Sequence[Sequence[float]] | None = None
    telecentric: bool = False
    wavelength_weights: Sequence[float] | None = None
    primary_wavelength: int = 1
    name: str = ""
    notes: tuple[str, ...] = ()
    catalogs: tuple[str, ...] = ()
    ray_aiming: str = "auto"
    environment: Environment | None = None
    sources: Sources = dataclasses.field(default_factory=dict)


def assemble(draft: LensDraft, file: str) -> Lens:
    """The lens of a draft. Raises LensFileError for a quantity out of range, at the keyword that gave it."""

    def refuse(quantity: str, message: str) -> None:
        keyword, place = draft.sources.get(quantity, (quantity, Place(file)))
        raise LensFileError(f"{keyword}{message}", place)

    last = len(draft.surfaces) - 1
    if not 0 < draft.stop < last:
        refuse("stop", f" is surface {draft.stop}, expected 1 to {last - 1}: a surface between object and image")
    if not draft.aperture > 0:
        refuse("aperture", ", expected a positive number")
    count = len(draft.x)
    if not 1 <= count <= MOST_POINTS or len(draft.y) != count:
        refuse("fields", f" has {len(draft.y)} values for {count} fields, expected 1 to {MOST_POINTS} of each")
    field_weights = [1.0] * count if draft.field_weights is None else draft.field_weights
    waves = draft.wavelengths
    if not 1 <= len(waves) <= MOST_POINTS:
        refuse("wavelengths", f" has {len(waves)} values, expected 1 to {MOST_POINTS} wavelengths")
    for wave in waves:
        if not 0 < wave < math.inf:
            refuse("wavelengths", f": wavelength {wave:g} µm, expected a positive number")
    weights = [1.0] * len(waves) if draft.wavelength_weights is None else draft.wavelength_weights
    if len(weights) != len(waves):
        refuse("wavelength_weights", f": {len(weights)} weights for {len(waves)} wavelengths, expected as many")
    if min(weights) < 0:
        refuse("wavelength_weights", f": weight {min(weights):g} of a wavelength, expected 0 or more")
    primary = draft.primary_wavelength
    if not 1 <= primary <= len(waves):
        refuse("primary_wavelength", f" is {primary}, expected 1 to {len(waves)}, the number of wavelengths")
    vignetting = None if draft.vignetting is None else double([list(row) for row in draft.vignetting])
    lens = Lens(
        surfaces=tuple(draft.surfaces),
        stop=draft.stop,
        aperture=SystemAperture(draft.aperture_kind, double(draft.aperture)),
        fields=Fields(
            kind=draft.field_kind,
            x=double([*draft.x]),
            y=double([*draft.y]),
            weight=double([*field_weights]),
            vignetting=vignetting if vignetting is not None and bool(vignetting.any()) else None,
            telecentric=draft.telecentric,
        ),
        wavelengths=double([*waves]),
        wavelength_weights=double([*weights]),
        primary_wavelength=primary,
        name=draft.name,
        notes=draft.notes,
        catalogs=draft.catalogs,
        ray_aiming=draft.ray_aiming,
        environment=draft.environment,
    )
    _refuse_overflow(lens, file)
    return lens


def _refuse_overflow(lens: Lens, file: str) -> None:
    """Raise LensFileError where a number left the 64-bit range when it was converted to mm."""

    def finite(numbers: list) -> bool:
        leaves = [
            torch.as_tensor(leaf, dtype=torch.float64) for leaf in pytree.tree_leaves(numbers) if leaf is not None
        ]
        return all(bool(torch.isfinite(leaf).all()) for leaf in leaves)

    for k, surface in enumerate(lens.surfaces):
        numbers = [getattr(surface, name) for name in SHAPE if name != "kind"]
        numbers += [surface.phase, surface.before, surface.after, surface.semi_diameter]
        numbers += [surface.thickness] if k else []
        numbers += [(*aperture.extent, *aperture.centre) for aperture in surface.apertures]
        if not finite(numbers):
            raise LensFileError("a number is too large once converted to mm", Place(file, None, k))
    if not finite([lens.aperture.value, lens.fields.x, lens.fields.y]):
        raise LensFileError("aperture or field is too large once converted to mm", Place(file))
    distance = lens.surfaces[0].thickness
    if torch.isnan(distance) or distance == -torch.inf:
        raise LensFileError("the object distance is too large once converted to mm", Place(file, None, 0))

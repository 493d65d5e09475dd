"""A lens that came out of a reader holds finite numbers only, but for the distance of the object."""

import torch
from torch.utils import _pytree as pytree

from raytrace.formats.source import LensFileError, Place
from raytrace.system.lens import Lens
from raytrace.system.surface import SHAPE


def refuse_overflow(lens: Lens, file: str) -> None:
    """Raise LensFileError where a number left the 64-bit range when it was converted to mm."""
    for number, surface in enumerate(lens.surfaces):
        shape = pytree.tree_leaves([getattr(surface, name) for name in SHAPE if name != "kind"])
        numbers = [*shape, surface.semi_diameter]
        numbers += [surface.thickness] if number else []
        numbers += [part for aperture in surface.apertures for part in (*aperture.extent, *aperture.centre)]
        if not all(_finite(part) for part in numbers if part is not None):
            raise LensFileError("a number is too large once converted to mm", Place(file, None, number))
    if not (_finite(lens.aperture.value) and _finite(lens.fields.x) and _finite(lens.fields.y)):
        raise LensFileError("aperture or field is too large once converted to mm", Place(file))
    thickness = lens.surfaces[0].thickness
    if torch.isnan(thickness) or thickness == -float("inf"):
        raise LensFileError("the object distance is too large once converted to mm", Place(file, None, 0))


def _finite(number: torch.Tensor | float) -> bool:
    return bool(torch.isfinite(torch.as_tensor(number, dtype=torch.float64)).all())

"""Axis: whether light along it stays on it, from the object to the image, in a straight line."""

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.utils import _pytree as pytree

from raytrace.maths.value import detached
from raytrace.optics.trace import lens_steps
from raytrace.system.lens import Lens
from raytrace.system.phases import kind_of
from raytrace.system.rays import Rays
from raytrace.system.surface import is_posed, is_round
from raytrace.words import named

_STRAIGHT = 1e-9  # mm and direction cosines: an axial ray that leaves the axis by less has not left it


def is_round_about_axis(lens: Lens) -> bool:
    """Whether all of the lens is of revolution about one axis, by its kinds and poses, whatever their numbers are."""
    return all(is_round(surface) and not is_posed(surface) for surface in lens.surfaces)


def is_bent(lens: Lens) -> bool:
    """Whether the axis bends: a surface is tilted or decentred, a coordinate break, or takes an axial ray off it."""
    if any(map(is_posed, lens.surfaces)):
        return True
    if all(map(is_round, lens.surfaces)):
        return False
    if any(isinstance(n, Tensor) and is_functorch_wrapped_tensor(n) for n in pytree.tree_leaves(lens)):
        # Numbers cannot be looked at inside a transform.
        phases = [kind_of(surface.phase) for surface in lens.surfaces if surface.phase is not None]
        return any(not kind.is_round and not kind.slopes for kind in phases)
    return _leaves_the_axis(detached(lens))


@torch.no_grad()
def _leaves_the_axis(lens: Lens) -> bool:
    wavelength = lens.wavelengths[lens.primary_wavelength]
    axis = lens.surfaces[-2].thickness.new_tensor([0.0, 0.0, 1.0])
    rays = Rays(0 * axis, axis, axis[2] > 0)
    off = [0 * axis[:2]]
    for crossing in lens_steps(lens, rays, wavelength):
        off += [crossing.rays.position[:2], crossing.rays.direction[:2]]
    return bool((torch.stack(off).abs() > _STRAIGHT).any())


class Bent(ValueError):
    """What needs an axis is asked of a lens that has none; the message names the surface."""


def need_axis(lens: Lens, what: str, instead: str = "") -> None:
    """Raise Bent for a lens whose axis bends. what: needs one; instead: what else there is."""
    if is_bent(lens):
        told = f"{what} needs one straight axis, but {_bend(lens)}"
        raise Bent(f"{told}; {instead}" if instead else told)


def _bend(lens: Lens) -> str:
    """Which surface bends the axis, in words."""
    for number, surface in enumerate(lens.surfaces):
        if is_posed(surface):
            return f"surface {number} is " + ("a coordinate break" if surface.is_break else "tilted or decentred")
    for number, surface in enumerate(lens.surfaces):
        if not is_round(surface):
            part = surface.departure if surface.phase is None else surface.phase
            return f"surface {number} ({named(part)}) takes light off it"
    return "it bends"

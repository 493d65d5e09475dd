"""Axis: whether light along it stays on it, from the object to the image, in a straight line; ray aiming by that."""

from collections.abc import Sequence
from itertools import islice

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.utils import _pytree as pytree

from raytrace.maths.value import detached
from raytrace.system.lens import Lens
from raytrace.system.phases import kind_of
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface, is_posed, is_round
from raytrace.tracing.trace import lens_steps
from raytrace.words import named

_STRAIGHT = 1e-9  # mm and direction cosines: an axial ray that leaves the axis by less has not left it


def is_round_about_axis(lens: Lens) -> bool:
    """Whether all of the lens is of revolution about one axis, by its kinds and poses, whatever their numbers are."""
    return all(is_round(surface) and not is_posed(surface) for surface in lens.surfaces)


def is_bent(lens: Lens) -> bool:
    """Whether the axis bends: a surface is tilted or decentred, a coordinate break, or takes an axial ray off it."""
    return _bends(lens, lens.surfaces)


def aiming_of(lens: Lens) -> str:
    """How rays of a lens find the stop, "off", "paraxial" or "real": its `ray_aiming`, or what "auto" comes to.

    "auto" is "real" where a surface in front of the stop bends the axis, or the stop is tilted or decentred: the
    straightened entrance pupil is no image of the stop there. Where the axis bends behind the stop it is "off".
    """
    if lens.ray_aiming != "auto":
        return lens.ray_aiming
    stop = lens.surfaces[lens.stop]
    moved = stop.is_break or stop.before is not None
    return "real" if moved or _bends(lens, lens.surfaces[: lens.stop]) else "off"


def _bends(lens: Lens, surfaces: Sequence[Surface]) -> bool:
    """Whether the first surfaces of a lens, which these are, bend its axis."""
    if any(map(is_posed, surfaces)):
        return True
    if all(map(is_round, surfaces)):
        return False
    if any(isinstance(n, Tensor) and is_functorch_wrapped_tensor(n) for n in pytree.tree_leaves(lens)):
        # Numbers cannot be looked at inside a transform.
        phases = [kind_of(surface.phase) for surface in surfaces if surface.phase is not None]
        return any(not kind.is_round and not kind.slopes for kind in phases)
    return _leaves_the_axis(detached(lens), len(surfaces))


@torch.no_grad()
def _leaves_the_axis(lens: Lens, count: int) -> bool:
    wavelength = lens.primary
    axis = lens.surfaces[-2].thickness.new_tensor([0.0, 0.0, 1.0])
    rays = Rays(0 * axis, axis, axis[2] > 0)
    off = [0 * axis[:2]]
    for crossing in islice(lens_steps(lens, rays, wavelength), count - 1):
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
            part = surface.sag_terms if surface.phase is None else surface.phase
            return f"surface {number} ({named(part)}) takes light off it"
    return "it bends"

"""Reuse: from pupil points to the sensor, where what no variable reaches is traced only once.

In an optimisation the same rays meet the same first surfaces again and again. A `Memo` keeps them as they are before
the first surface that a variable moves, and later calls go on from there: with the sensor distance as the only variable
nothing is traced a second time, the rays are only carried to the new sensor.

What depends on a variable is not guessed from the structure of the lens: it is what autograd says requires a gradient.
"""

import dataclasses
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.launch import rays_of_field, vignette
from raytrace.lens import Lens
from raytrace.rays import Rays
from raytrace.trace import Crossing, media, steps, trace_surfaces

#: lens, field (2, ...), wavelength (...) µm, pupil (2, ...): all that a bundle of rays is made from.
Bundle = tuple[Lens, Tensor, Tensor, Tensor]


@dataclasses.dataclass(frozen=True)
class _Front:
    """Rays behind the first `count` surfaces after the object, in the frame of the last of them (of surface 1 if 0).

    crossings: what happened on the way, if that was asked for; indices: of all media, None if a variable moves one.
    """

    count: int
    rays: Rays
    crossings: list[Crossing]
    indices: list[Tensor] | None


@dataclasses.dataclass(frozen=True)
class _Kept:
    """A front, and the numbers of the bundle that it holds for; None stands for a variable."""

    structure: Any
    constants: list[Tensor | None]
    front: _Front

    def holds_for(self, numbers: Sequence[Tensor], structure: Any) -> bool:
        return self.structure == structure and all(
            kept is None or (not number.requires_grad and _equal(kept, number))
            for kept, number in zip(self.constants, numbers, strict=True)
        )


class Memo:
    """Rays that stay as they are from one call to the next: `psf(..., memo=memo)` in a loop of optimisation.

    Every number of the lens, the fields and the wavelengths that requires a gradient is a variable. The others are
    compared at each call, and rays for which one has changed are traced anew; so a memo changes no result.
    most: so many bundles are kept, and the oldest is forgotten first. crossed: surfaces that bundles have been traced
    through so far. Under the transforms of `torch.func`, which hide what they vary, it is passed by.
    """

    def __init__(self, most: int = 64):
        self._kept: list[_Kept] = []
        self._most = most
        self.crossed = 0

    def front(self, bundle: Bundle, *, recorded: bool) -> _Front:
        """The rays as far as no variable reaches, from memory or traced now; recorded: with their crossings."""
        numbers, structure = pytree.tree_flatten((bundle, recorded))
        structure = (structure, tuple(None if isinstance(n, Tensor) else n for n in numbers))
        numbers = [n for n in numbers if isinstance(n, Tensor)]
        for kept in self._kept:
            if kept.holds_for(numbers, structure):
                return kept.front
        front = _constant_front(bundle, recorded)
        self.crossed += front.count
        constants = [None if n.requires_grad else n.detach().clone() for n in numbers]
        self._kept = [*self._kept, _Kept(structure, constants, front)][-self._most :]
        return front


def trace_bundle(bundle: Bundle, memo: Memo | None = None) -> Rays:
    """The rays of field and pupil points at the image surface; everything broadcasts."""
    lens, _, wavelength, _ = bundle
    if memo is None or torch._C._are_functorch_transforms_active():
        return trace_surfaces(lens.surfaces[1:], _launched(bundle), indices=media(lens, wavelength))
    front = memo.front(bundle, recorded=False)
    return trace_surfaces(**_rest(bundle, front, memo))


def cross_bundle(bundle: Bundle, memo: Memo | None = None) -> list[Crossing]:
    """What happens to the rays at every surface after the object."""
    lens, _, wavelength, _ = bundle
    if memo is None or torch._C._are_functorch_transforms_active():
        return list(steps(lens.surfaces[1:], _launched(bundle), indices=media(lens, wavelength)))
    front = memo.front(bundle, recorded=True)
    return [*front.crossings, *steps(**_rest(bundle, front, memo))]


def _launched(bundle: Bundle) -> Rays:
    lens, field, wavelength, pupil = bundle
    return rays_of_field(lens, field, vignette(lens, field, pupil), wavelength=wavelength)


def _rest(bundle: Bundle, front: _Front, memo: Memo) -> dict:
    """How to go on from a front, as arguments of `steps`."""
    lens, _, wavelength, _ = bundle
    done = front.count
    rays = _launched(bundle) if done == 0 and front.rays is None else front.rays
    indices = media(lens, wavelength) if front.indices is None else front.indices
    memo.crossed += len(lens.surfaces) - 1 - done
    return {
        "surfaces": lens.surfaces[1 + done :],
        "rays": rays,
        "indices": indices[done:],
        "side": _side(lens, done),
        "gap": lens.surfaces[done].thickness if done else None,
    }


def _side(lens: Lens, count: int) -> int:
    return -1 if sum(surface.is_mirror for surface in lens.surfaces[1 : count + 1]) % 2 else 1


def _constant_front(bundle: Bundle, recorded: bool) -> _Front:
    """Trace until the rays depend on a variable. Where they do from the start, nothing is kept but that."""
    lens, _, wavelength, _ = bundle
    with torch.enable_grad():
        rays, indices = _launched(bundle), media(lens, wavelength)
    fixed = [index for index in indices if not index.requires_grad]
    kept_indices = indices if len(fixed) == len(indices) else None
    if _varies(rays):
        return _Front(0, None, [], kept_indices)
    count, crossings, surfaces = 0, [], lens.surfaces[1:]
    with torch.enable_grad():
        for crossing in steps(surfaces, rays, indices=indices):
            if _varies(crossing.rays):
                break
            count, rays = count + 1, crossing.rays
            crossings += [crossing] if recorded else []
    return _Front(count, rays, crossings, kept_indices)


def _varies(rays: Rays) -> bool:
    return any(t is not None and t.requires_grad for t in (rays.position, rays.direction, rays.opl))


def _equal(a: Tensor, b: Tensor) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)

"""Quantities of a lens that a loss is a function of: landing points, kernels, transfer functions.

A loss of `rt.optimize` takes one of them, as of="otf", or a function of the lens computes it, as Otf(rings=4)(lens). A
quantity is sampled by as many rays as its settings say, so that the loss is smooth in the numbers of the lens, and
`denser` has more of them: a lens is never judged by the rays that it was optimised on alone.
"""

import dataclasses
from collections.abc import Sequence
from typing import ClassVar, Protocol, Self, runtime_checkable

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import value
from raytrace.maths.sampling import equal_rings
from raytrace.psf_models import model_of, psf
from raytrace.system.lens import Lens, field_points, with_object_distance
from raytrace.tracing.spot import image_rays
from raytrace.tracing.trace import without_apertures
from raytrace.words import did_you_mean, named_value, option

_DENSER = 2  # times as many rings


@runtime_checkable
class Quantity(Protocol):
    """A quantity of a lens at object distances (D,) mm; D = 1, its own one, without any.

    distance_axis: the axis of D.
    """

    distance_axis: ClassVar[int]

    def __call__(self, lens: Lens, object_distances: Tensor | None) -> Tensor: ...

    def denser(self, rings: int | None = None) -> Self:
        """The same quantity by more rays: of so many rings, or twice as many. Raises ValueError for no more."""


def _more(now: int, asked: int | None, what: str) -> int:
    """So many rings as asked for, or twice as many as now."""
    if asked is not None and asked <= now:
        raise ValueError(f"{option('check_rings')} {asked}: expected more than the {what} of the descent, {now}")
    return asked or _DENSER * now


def of_configurations(quantity: Quantity, lens: Lens, object_distances: Tensor | None) -> Tensor:
    """A quantity of every configuration of a lens, one after the other along the axis of object distances."""
    each = [quantity(view, object_distances) for view in lens.configurations]
    return each[0] if len(each) == 1 else torch.cat(each, quantity.distance_axis)


def _at_distances(lens: Lens, object_distances: Tensor | None) -> list[Lens]:
    if object_distances is None:
        return [lens]
    return [with_object_distance(lens, distance) for distance in object_distances]


@value
class Points:
    """Landing points (2, D, F, W, P) mm on the sensor, of object distances, fields, wavelengths and rays.

    The P rays of `rings` rings share the light of the pupil equally. Apertures clip none of them, vignetting factors
    count; rays that fail are nan. About the centroid of a field: points - points.mean((-2, -1), keepdim=True).
    """

    rings: int = 8

    distance_axis: ClassVar[int] = 1

    def __call__(self, lens: Lens, object_distances: Tensor | None = None) -> Tensor:
        pupil, _ = equal_rings(self.rings)
        fields = field_points(None, like=lens)
        lenses = map(without_apertures, _at_distances(lens, object_distances))
        traced = [image_rays(moved, pupil, fields=fields) for moved in lenses]
        return torch.stack([torch.where(rays.valid, rays.position[:2], torch.nan) for rays in traced], 1)

    def denser(self, rings: int | None = None) -> "Points":
        return Points(_more(self.rings, rings, "rings"))


@value
class Otf:
    """Geometric transfer functions (D, F, W, 2, V), complex, of patterns along y (tangential) and x (sagittal).

    frequencies: (V,) cycles/mm on the sensor; about the centroid of all wavelengths of a field; rings: as of `Points`.
    The geometric transfer function neglects diffraction.
    """

    frequencies: Sequence[float] = (10.0, 20.0, 40.0, 80.0)
    rings: int = 8

    distance_axis: ClassVar[int] = 0

    def __call__(self, lens: Lens, object_distances: Tensor | None = None) -> Tensor:
        points = Points(self.rings)(lens, object_distances)
        about = (points - points.mean((-2, -1), keepdim=True)).flip(0).movedim(0, -2)  # (D, F, W, 2, P), y first
        phase = -2 * np.pi * about[..., None, :] * about.new_tensor(self.frequencies)[:, None]
        return torch.polar(torch.ones_like(phase), phase).mean(-1)

    def denser(self, rings: int | None = None) -> "Otf":
        return dataclasses.replace(self, rings=_more(self.rings, rings, "rings"))


@value
class Kernels:
    """PSFs (D, F, W, pixels, pixels) on pixels about the chief ray, of energy 1 for all light of a wavelength.

    model: "gaussian" or "drt"; pixel: mm; order: of the model, as of `psf`, fixed for a loss that is smooth; it takes
    the place of rings.
    """

    model: str = "gaussian"
    pixel: float = 0.005
    pixels: int = 31
    order: int = 5

    distance_axis: ClassVar[int] = 0

    def __call__(self, lens: Lens, object_distances: Tensor | None = None) -> Tensor:
        kernels = psf(
            lens, model_of(self.model, order=self.order), object_distances=object_distances, pixel=self.pixel,
            size=self.pixels, per_wavelength=True,
        ).kernel  # fmt: skip
        return kernels.reshape(-1, *kernels.shape[-4:])

    def denser(self, rings: int | None = None) -> "Kernels":
        return dataclasses.replace(self, order=_more(self.order, rings, "order"))


#: Quantities by the name of `of`.
QUANTITIES = {"points": Points, "otf": Otf, "kernels": Kernels}


def quantity_of(word: "str | Quantity") -> Quantity | None:
    """The quantity of a name, None of "lens". Raises ValueError."""
    if not isinstance(word, str):
        if isinstance(word, Quantity) and not isinstance(word, type):
            return word
        raise TypeError(f"{option('of')} is {named_value(word)}; expected a name, or a quantity as Points(rings=12)")
    if word == "lens":
        return None
    if word == "pictures":
        raise ValueError(f"{option('of', word)}: of which scenes? Give of=rt.imaging.LensPictures(scenes)")
    if word not in QUANTITIES:
        known = ("lens", *QUANTITIES)
        raise ValueError(f"{option('of')} {word!r}: expected {', '.join(known)}{did_you_mean(word, known)}")
    return QUANTITIES[word]()

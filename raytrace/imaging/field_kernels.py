"""PSFs of a lens over the sensor, for pictures that are seen upright.

Rows of a kernel grow towards +y of the sensor and columns towards -x, as the rows and columns of an upright picture do.
A kernel has its origin where the chief ray of the primary wavelength meets the sensor, and sums to 1: the light that
arrives is the relative illumination, an image of its own. Where no chief ray or no light arrives a kernel is 0.

A place is a point of the sensor, whose field point changes with the lens, or a field point, whose image moves with it.

Of a rotationally symmetric lens and the Gaussian model, centroids and covariances along one radius are turned to every
place. Kernels of the other models are computed in one octant and mirrored to the others.

Phase elements at the stop of a lens add their path to its waves (`wave_optics.hybrid`). Of elements alone, in a stop
without a lens, every place has the kernel of the axis: a paraxial camera.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Literal, TypeAlias

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.imaging.sensor import Sensor, landing_of
from raytrace.maths.numerics import safe_divide, safe_sqrt, varies
from raytrace.maths.sampling import Grid, gauss_rings, with_rim
from raytrace.maths.sampling import grid as make_grid
from raytrace.psf_models import (
    DRT,
    MODELS,
    Execution,
    Fourier,
    Gaussian,
    NotConverged,
    Paraxial,
    Wave,
    model_of,
    psf,
)
from raytrace.psf_models.gaussian import gaussian_pixels, wide_gaussian_pixels
from raytrace.psf_models.models import is_sampled_in_common
from raytrace.system.lens import Lens, aligned, is_round_about_axis, one_lens, with_field_kind, with_object_distance
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.launch import field_of_object
from raytrace.tracing.paraxial import axial_beam
from raytrace.tracing.scene import Memo, scene, trace_scene
from raytrace.wave_optics import hybrid
from raytrace.wave_optics.compute import psf as wave_psf
from raytrace.wave_optics.compute import psf_by_depth
from raytrace.wave_optics.direction_grid import TooCoarse
from raytrace.wave_optics.element import Element, is_radial
from raytrace.wave_optics.hybrid import is_stop_alone
from raytrace.wave_optics.plan import Plan
from raytrace.wave_optics.scene import WaveScene
from raytrace.words import RaytraceError, RaytraceWarning, calling_level, named_value

#: Kernels have the sum 1 ("window"), or the share of all light: the rest is lost ("energy"), or an even haze ("haze").
Normalisation: TypeAlias = Literal["window", "energy", "haze"]
#: The same, or the share of the light on the sensor plane ("arrived"): the rest is outside the window.
KernelSum: TypeAlias = Normalisation | Literal["arrived"]
#: A PSF model with its numbers.
Model: TypeAlias = Paraxial | Fourier | Gaussian | DRT | Wave

_SIGMAS = 4.2  # of a Gaussian that the window holds on each side: 1e-4 of the light of a round one is beyond
#: Smallest and largest margin of the window for diffraction, in λN beyond the rays. A circular pupil has
#: 2/(π² R) of its light farther away than R λN (Born & Wolf, Principles of Optics, §8.5.2).
_RINGS = 6.0, 40.0
_ALL_LIGHT = 6.0  # standard deviations beyond which a Gaussian is left out: 2e-9 of the light along a line
_LARGEST = 401  # pixels of a window
_SMALLEST = 21  # pixels of a window of elements
_TAIL = 1e-2  # of the light that a window 1.5 times as large adds
_TOGETHER = 48  # fields of a call of `psf`
_DISTANCES = 8  # object distances of a call of `psf` for pairs of a place and a distance


class WindowTooLarge(RaytraceError, ValueError):
    """A blur of more pixels than a window has."""


class DarkPlaces(RaytraceWarning):
    """Places of the sensor without light, whose kernels are 0."""


class EnergyOutside(RaytraceWarning):
    """Kernels of sum 1 leave out much light, outside their window."""


@dataclasses.dataclass(frozen=True)
class FieldKernels:
    """Kernels at places of the sensor.

    model, order: of the PSF; size: of the window, an odd number of pixels; object_distances: (D,) mm; weights: (C, W),
    the share of every wavelength of the lens in a channel; lateral_colour: whether the light of other wavelengths lies
    where their chief rays meet the sensor, or about the origin; nodes: radii of the Gaussian model at which rays are
    traced; elements: in contact at the stop, with the model "wave"; parameters: of the model, as Paraxial(rho=0.4), or
    Gaussian(rays=points), pupil points in place of an order; center: of the window, "chief" or "centroid" (of the
    light); normalise: "window", kernels of sum 1, of the share of the light through the entrance pupil, or of the light
    that arrives; memo: of rays, for loops over the same field points. Raises ValueError for elements and another model.
    """

    lens: Lens
    sensor: Sensor
    model: str
    order: int
    size: int
    object_distances: Tensor
    weights: Tensor
    lateral_colour: bool = True
    nodes: int = 33
    elements: tuple[Element, ...] = ()
    parameters: Model | None = None
    center: Literal["chief", "centroid"] = "chief"
    normalise: KernelSum = "window"
    memo: Memo | None = None

    def __post_init__(self) -> None:
        check_model(self.model, self.elements)

    def at(self, points: Tensor) -> Tensor:
        """Kernels (N, D, C, size, size) at places (2, N) mm of the sensor."""
        parts = [dataclasses.replace(self, object_distances=distance) for distance in self.object_distances.split(1)]
        return torch.cat([part._of_one_distance(points) for part in parts], 1)

    def paired(self, points: Tensor) -> Tensor:
        """Kernels (N, C, size, size) of pairs: points (2, N) mm, each with its object distance of (N,)."""
        parts, order = [], []
        for group in self._groups():
            kernels = dataclasses.replace(self, object_distances=self.object_distances[group])
            parts.append(kernels._paired(points[:, group]))
            order.append(group)
        return torch.cat(parts)[torch.cat(order).argsort()]

    def of_pairs(self, fields: Tensor, *, of_points: bool = False) -> Tensor:
        """Kernels (N, C, size, size) of field points (2, N), each with its object distance of (N,), and of a batch of N
        lenses each with its lens. of_points: as for `of_fields`."""
        if not MODELS[self.model].traces:  # first-order models image all fields alike
            fields = torch.zeros_like(fields)
        keys = [self.object_distances.detach().isfinite()]
        # Of waves, the kernels of a field are sampled in common; stored rays have one field at all distances.
        is_by_field = MODELS[self.model].by_field or self.memo is not None
        keys += fields.detach() if is_by_field else []
        which = torch.unique(torch.stack([key.to(fields) for key in keys]), dim=1, return_inverse=True)[1]
        most = len(which) if is_by_field else _TOGETHER
        count = 1 if is_sampled_in_common(self.lens, self.model) else most
        parts, order = [], []
        for number in which.unique():
            group = torch.nonzero(which == number)[:, 0]
            kernels, places = self._of(group), fields[:, group[:1]] if is_by_field else fields[:, group, None]
            origin = kernels.origin(places)  # the chief rays of all lenses are aimed and traced at once
            for alike in self._alike(fields[:, group]):
                for some in alike.split(count):
                    part = places if is_by_field else places[:, some]
                    parts.append(kernels._of(some)._about(self._sampled(part, of_points), origin[:, some])[0])
                    order.append(group[some])
        return torch.cat(parts)[torch.cat(order).argsort()]

    def _alike(self, fields: Tensor) -> list[Tensor]:
        """Numbers of fields (2, N) of each symmetry, on the axis, in the y-z plane and others, if apertures may clip.

        The arms of a clipped beam fill the part of the pupil that symmetry needs: that of other fields would change it.
        """
        if varies(fields) or not any(surface.apertures for surface in self.lens.surfaces):
            return [torch.arange(fields.shape[1], device=fields.device)]
        rank = (fields[0] == 0).long() + (fields == 0).all(0)
        return [torch.nonzero(rank == number)[:, 0] for number in rank.unique()]

    def _sampled(self, fields: Tensor, of_points: bool) -> Tensor:
        """Fields of a call; field points that vary break symmetry: one sampling, with derivatives or not."""
        if of_points and MODELS[self.model].in_common and not varies(fields):
            return fields.detach().requires_grad_()
        return fields

    def _of(self, numbers: Tensor) -> "FieldKernels":
        """Of some of the object distances, and of a batch of lenses some of them."""
        lens = self.lens if self.lens.count is None else one_lens(self.lens, numbers)
        return dataclasses.replace(self, lens=lens, object_distances=self.object_distances[numbers])

    def _groups(self) -> list[Tensor]:
        """Numbers of the pairs that `_paired` takes at once: their distances are all finite or all infinite."""
        distances = self.object_distances.detach()
        if self._is_of_waves:
            return [torch.nonzero(distances == distance)[:, 0] for distance in distances.unique()]
        sides = [torch.nonzero(side)[:, 0] for side in (distances.isfinite(), distances.isinf())]
        near_first = (side[distances[side].argsort()] for side in sides if len(side))
        count = _TOGETHER if MODELS[self.model].traces else _DISTANCES
        return [some for side in near_first for some in side.split(count)]

    @property
    def _is_of_waves(self) -> bool:
        """Whether the distances of a call share the sampling of traced waves."""
        return MODELS[self.model].by_field or bool(self.elements)

    def _paired(self, points: Tensor) -> Tensor:
        """`paired` of a group of pairs."""
        distances, which = _distinct(self.object_distances)
        if not MODELS[self.model].traces:
            kernels = dataclasses.replace(self, object_distances=distances)
            return kernels._in_parts(torch.zeros_like(points[:, :1]))[0, which]
        if self._has_radii:
            radii, places = self._distinct_radii(points)
            pairs, number = torch.unique(places * len(distances) + which, return_inverse=True)
            fields = self._of_radii(radii)[:, pairs // len(distances), None]
            kernels = dataclasses.replace(self, object_distances=distances[pairs % len(distances)])
            return self._gaussians(points, [moment[:, 0][None, number] for moment in kernels._moments(fields)])[:, 0]
        if not self._is_of_waves:
            return self._mirrored(points, lambda places, some: self._of(some)._of_places(places)[:, None], which)[:, 0]
        if len(distances) == 1:
            return dataclasses.replace(self, object_distances=distances)._of_one_distance(points)[:, 0]
        pairs = zip(distances.split(1), points.split(1, 1), strict=True)  # each with its own derivative by the distance
        return torch.cat([dataclasses.replace(self, object_distances=z)._of_one_distance(p)[:, 0] for z, p in pairs])

    @property
    def _has_radii(self) -> bool:
        """Whether all azimuths of a radius have the same moments, about the chief ray, whatever light is vignetted."""
        is_centred = self.center == "chief" and self.normalise in ("window", "arrived")
        is_centred = is_centred and not has_points(self.parameters)
        return self.model == "gaussian" and is_centred and is_round_about_axis(self.lens)

    @property
    def _model(self) -> Model:
        parameters = model_of(self.model) if self.parameters is None else self.parameters
        return parameters if has_points(parameters) else dataclasses.replace(parameters, order=self.order)

    def _of_one_distance(self, points: Tensor) -> Tensor:
        if not MODELS[self.model].traces:  # first-order models image all fields alike
            return self._in_parts(torch.zeros_like(points[:, :1])).expand(points.shape[1], *(-1,) * 4)
        compute = self._turned if self._has_radii else self._in_parts
        return self._mirrored(
            points, lambda places, some: compute(places), torch.zeros_like(points[0], dtype=torch.long)
        )

    def _mirrored(self, points: Tensor, compute: Callable[[Tensor, Tensor], Tensor], distance: Tensor) -> Tensor:
        """Kernels (N, D, C, size, size) of points (2, N) mm, of a round lens computed in one octant and mirrored.

        compute: points (2, n), and their numbers among the N -> kernels (n, D, C, size, size); distance: (N,) number of
        the object distance of each.
        """
        if not is_round_about_axis(self.lens) or not all(map(is_radial, self.elements)):
            return compute(points, torch.arange(points.shape[1], device=points.device))
        octant = torch.stack([points.abs().amin(0), points.abs().amax(0)])
        keys = torch.cat([(octant / self.sensor.pitch * 1e6).round(), distance[None].to(octant)])
        places, which = torch.unique(keys, dim=1, return_inverse=True)
        numbers = torch.arange(points.shape[1], device=which.device)
        if self.model == "gaussian" and places.shape[1] == points.shape[1]:  # no place is the image of another
            return compute(points, numbers)
        first = torch.full_like(places[0], points.shape[1], dtype=torch.int64)
        first = first.scatter_reduce(0, which, numbers, "amin")
        kernels = compute(octant[:, first], first)[which].flip(-1)  # columns towards +x
        for mask, move in (
            (points[0].abs() > points[1].abs(), lambda kernel: kernel.transpose(-1, -2)),
            (points[0] < 0, lambda kernel: kernel.flip(-1)),
            (points[1] < 0, lambda kernel: kernel.flip(-2)),
        ):
            kernels = torch.where(mask[:, None, None, None, None], move(kernels), kernels)
        return kernels.flip(-1)

    def _of_places(self, points: Tensor) -> Tensor:
        """Kernels (N, C, size, size) of points (2, N) mm, each with its object distance, by the PSF model."""
        fields = self.sensor.fields(self.lens, points)
        arrives = ~fields.isnan().any(0)
        kernels = self.of_pairs(fields.nan_to_num(0.0), of_points=True)
        return torch.where(arrives[:, None, None, None], kernels, 0.0)

    def _in_parts(self, points: Tensor) -> Tensor:
        """By the PSF model, field by field; the chief rays of all places are aimed and traced at once."""
        fields = self.sensor.fields(self.lens, points) if MODELS[self.model].traces else points
        arrives = ~fields.isnan().any(0)
        kernels = self.of_fields(fields.nan_to_num(0.0), of_points=True)
        return torch.where(arrives[:, None, None, None, None], kernels, 0.0)

    def of_fields(self, fields: Tensor, *, of_points: bool = False) -> Tensor:
        """Kernels (F, D, C, size, size) of field points (2, F); of a batch of D lenses one for each.

        By the PSF model, field by field; the chief rays of all fields are aimed and traced at once. of_points: the
        field points belong to points of the sensor, and vary with the lens.
        """
        count = 1 if is_sampled_in_common(self.lens, self.model) else _TOGETHER
        kernels, order, origin = [], [], self.origin(fields)
        for alike in self._alike(fields):
            for some in alike.split(count):
                kernels.append(self._about(self._sampled(fields[:, some], of_points), origin[:, :, some]))
                order.append(some)
        return torch.cat(kernels)[torch.cat(order).argsort()]

    def _about(self, fields: Tensor, origin: Tensor) -> Tensor:
        """Kernels (F, D, C, size, size) of fields (2, F), (2, D, F) about their origins, of one call of the model."""
        light, arrived = self.light(fields, origin) if self.elements else self._of_model(fields, origin)
        weights = self.weights.to(light)
        light = torch.einsum("cw,dfwij->fdcij", weights, light).flip(-1)
        return _normalised(light, torch.einsum("cw,dfw->fdc", weights, arrived), self.normalise)

    def _of_model(self, fields: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
        """Light (D, F, W, h, w), columns towards +x, and that on the whole sensor plane (D, F, W); 1 = all through the
        entrance pupil."""
        numbers = pytree.tree_leaves((self.lens, self.object_distances))
        with torch.set_grad_enabled(torch.is_grad_enabled() and any(map(varies, numbers))):
            psfs = [
                psf(
                    self.lens, self._model, fields=fields, wavelengths=wavelengths, per_wavelength=True, grid=window,
                    object_distances=self.object_distances, center="axis" if self.center == "chief" else "centroid",
                    execution=Execution(memo=self.memo),
                )
                for wavelengths, window in self._windows(origin)
            ]  # fmt: skip
            return torch.cat([part.kernel for part in psfs], 2), torch.cat([part.arrived for part in psfs], 2)

    def light(self, fields: Tensor, origin: Tensor) -> tuple[Tensor, Tensor]:
        """`_of_model` of fields (2, F) of a lens with elements."""
        kernels = []
        for wavelengths, window in self._windows(origin):
            view = scene(self.lens, fields, self.object_distances, wavelengths)
            centre = window.centre[..., None].expand(2, *view.shape)
            window = dataclasses.replace(window, centre=centre)
            kernels.append(hybrid.kernels(view, self.elements, window, order=self.order))
        return torch.cat([part.kernel for part in kernels], 2), torch.cat([part.arrived for part in kernels], 2)

    def _windows(self, origin: Tensor) -> Iterator[tuple[Tensor, Grid]]:
        """Wavelengths with a common origin, µm, and their pixels about it, whose centres are (2, D, F)."""
        wavelengths, pitch = self.lens.wavelengths, origin.new_tensor(self.sensor.pitch)
        groups = [wavelengths] if self.lateral_colour else wavelengths.split(1)
        if self.center == "centroid":
            origin = torch.zeros_like(origin)
        for some, centre in zip(groups, origin.unbind(-1), strict=True):
            yield some, make_grid(pitch, self.size, centre)

    def _turned(self, points: Tensor) -> Tensor:
        """Gaussians of the moments along a radius, turned to the azimuth of every place."""
        distinct, which = self._distinct_radii(points)
        if len(distinct) <= self.nodes:
            moments = [moment[:, which] for moment in self._moments(self._of_radii(distinct))]
        else:  # linear between radii: vignetting factors are, too, with a kink on the axis
            nodes = radii(points, self.nodes)
            each = self._moments(self._of_radii(nodes))
            moments = [along(nodes, moment.movedim(1, 0), points).movedim(0, 1) for moment in each]
            moments[-1] = (moments[-1] > 1 - 1e-9).to(moments[-1])  # no light between a radius with and one without
        return self._gaussians(points, moments)

    def _distinct_radii(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Radii (K,) mm of places (2, N), to 1e-6 of a pixel, and the number of each place's radius among them."""
        radius = safe_sqrt((points * points).sum(0)) / self.sensor.pitch
        units, which = torch.unique((radius * 1e6).round(), return_inverse=True)
        return units * (1e-6 * self.sensor.pitch), which

    def _gaussians(self, points: Tensor, moments: list[Tensor]) -> Tensor:
        """Kernels (N, D, C, size, size) of `_moments` (D, N, W) at places (2, N)."""
        radius = safe_sqrt((points * points).sum(0))
        unit = torch.where(radius > 0, points / torch.where(radius > 0, radius, 1.0), points.new_tensor([[0.0], [1.0]]))
        shift, sagittal, tangential, light = moments
        pitch, variance = self.sensor.pitch, torch.minimum(sagittal, tangential).amin((0, 2))
        # Of each place alone, so that kernels do not depend on other places: the rule, and the pixels with light.
        wide = variance >= pitch**2
        reach = shift.abs() + _ALL_LIGHT * torch.maximum(sagittal, tangential).sqrt()
        needed = 2 * torch.ceil(reach.amax((0, 2)).detach() / pitch + 0.5) + 1
        sizes = [self.size]
        while sizes[-1] > _SMALLEST:
            sizes.append(sizes[-1] // 4 * 2 + 1)
        rank = sum((needed <= size).to(torch.int64) for size in sizes[1:])
        kernels, order = [], []
        for number in torch.unique(2 * rank + wide).tolist():
            size, pixels = sizes[number // 2], (gaussian_pixels, wide_gaussian_pixels)[number % 2]
            window = make_grid(points.new_tensor(pitch), size)
            for some in torch.nonzero(2 * rank + wide == number)[:, 0].split(_TOGETHER):
                x, y = -unit[0, some, None], unit[1, some, None]  # columns of the kernel grow towards -x
                pairs = (y * y, x * x), (-x * y, x * y), (x * x, y * y)
                covariance = torch.stack([sagittal[:, some] * a + tangential[:, some] * b for a, b in pairs])
                centroid = torch.stack([x * shift[:, some], y * shift[:, some]])
                part = light[:, some, :, None, None] * pixels(window, centroid, covariance)  # (D, N, W, size, size)
                weights = self.weights.to(part)
                arrived = torch.einsum("cw,dfw->fdc", weights, light[:, some])
                part = _normalised(torch.einsum("cw,dfwij->fdcij", weights, part), arrived, self.normalise)
                kernels.append(torch.nn.functional.pad(part, [(self.size - size) // 2] * 4))
                order.append(some)
        return torch.cat(kernels)[torch.cat(order).argsort()]

    def _of_radii(self, radii: Tensor) -> Tensor:
        """Field points (2, K) of radii (K,) mm along +y; nan where no chief ray arrives."""
        return self.sensor.fields(self.lens, torch.stack([torch.zeros_like(radii), radii]))

    def _moments(self, fields: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Centroid from the origin, mm, sagittal and tangential variance, mm², and 1 where light arrives, else 0,
        (D, K, W) of field points (2, K), (2, D, K) of `_of_radii`."""
        arrives, fields = ~fields.isnan().any(0), fields.nan_to_num(0.0)
        axis = 1 if fields.dim() == 2 else 0  # of fields, or of pairs
        parts, order = [], []
        for some in self._alike(fields.flatten(1)):
            distances = self.object_distances if axis else self.object_distances[some]
            kernels, places = dataclasses.replace(self, object_distances=distances), fields[:, some]
            spots = psf(
                self.lens, self._model, fields=places, object_distances=distances, per_wavelength=True,
                grid=make_grid(fields.new_tensor(1.0), 1),
            )  # fmt: skip
            known = arrives[some][..., None] & ~spots.centroid[1].isnan()
            shift = spots.centroid[1] - kernels.origin(places)[1]
            each = (torch.where(known, moment, 0.0) for moment in (shift, spots.covariance[0], spots.covariance[2]))
            parts.append((*each, known.to(shift)))
            order.append(some)
        number = torch.cat(order).argsort()
        shift, sagittal, tangential, light = (
            torch.cat(p, axis).index_select(axis, number) for p in zip(*parts, strict=True)
        )
        return shift, sagittal, tangential, light

    def origin(self, fields: Tensor) -> Tensor:
        """Points (2, D, N, 1 or W) mm where chief rays of fields (2, N), (2, D, N) meet the sensor: see `origin`."""
        if not varies(fields) and not bool(fields.any()) and is_round_about_axis(self.lens):
            return fields.new_zeros(2, len(self.object_distances), fields.shape[-1], 1).expand(
                -1, -1, -1, 1 if self.lateral_colour else len(self.lens.wavelengths)
            )
        return origin(self.lens, fields, self.object_distances, lateral_colour=self.lateral_colour)


@dataclasses.dataclass(frozen=True)
class ElementKernels:
    """Kernels of elements alone, the same at every place of the sensor, as `FieldKernels` of a lens.

    lens: `stop_alone`, the stop of the elements and the sensor distance; other arguments as for `FieldKernels`.
    exact: the true spheres instead of Fresnel's paraboloids; plan: the sampling, of an earlier call: for loops; memo:
    of sums that do not depend on the heights.
    """

    lens: Lens
    elements: tuple[Element, ...]
    sensor: Sensor
    size: int
    object_distances: Tensor
    weights: Tensor
    exact: bool = False
    normalise: KernelSum = "window"
    plan: Plan | None = None
    memo: Memo | None = None

    @property
    def scene(self) -> WaveScene:
        sensor_distance = self.lens.surfaces[-2].thickness
        window = make_grid(sensor_distance.new_tensor(self.sensor.pitch), self.size)
        wavelengths = self.lens.wavelengths
        return WaveScene(self.elements, sensor_distance, self.object_distances, wavelengths, window, self.exact)

    def light(self) -> Tensor:
        """Light (D, W, h, w) in each pixel, columns towards +x; 1 = all through the aperture."""
        whole = self.scene
        return (psf_by_depth(whole) if self.plan is None else wave_psf(whole, plan=self.plan, memo=self.memo)).kernel

    def share(self, light: Tensor) -> Tensor:
        """Share (D, C) of the light of `light` that lies in the window."""
        return light.sum((-2, -1)) @ self.weights.to(light).T

    def of_light(self, light: Tensor) -> Tensor:
        """Kernels (D, C, size, size) of `light`."""
        kernels = (self.weights.to(light) @ light.flatten(2)).unflatten(2, light.shape[2:]).flip(-1)
        return of_sum_1(kernels) if self.normalise == "window" else kernels

    def at(self, points: Tensor) -> Tensor:
        """Kernels (N, D, C, size, size) at places (2, N) mm of the sensor."""
        kernels = self.of_light(self.light())
        return kernels.expand(points.shape[1], *kernels.shape)

    def paired(self, points: Tensor) -> Tensor:
        """Kernels (N, C, size, size) of pairs: places (2, N) mm, each with its object distance of (N,)."""
        distances, which = _distinct(self.object_distances)
        kernels = dataclasses.replace(self, object_distances=distances).at(points[:, :1])[0]
        return kernels if len(kernels) == len(which) else kernels.index_select(0, which)


def _distinct(distances: Tensor) -> tuple[Tensor, Tensor]:
    """Distinct distances and, of each distance, its number among them; all of them where they have derivatives."""
    some, which = distances.detach().unique(return_inverse=True)
    if varies(distances) or len(some) == len(distances):
        return distances, torch.arange(len(distances), device=distances.device)
    return some, which


def channel_moments(
    lens: Lens, sensor: Sensor, points: Tensor, object_distances: Tensor, *, lateral_colour: bool
) -> tuple[Tensor, Tensor]:
    """Centroid mm and variance mm² (2, D, N, C) in x and y of the rays of each channel at places (2, N) mm.

    About the origin of the kernels, and to a few percent: to compare spectra.
    """
    fields = sensor.fields(lens, points)
    fields = fields[:, ~fields.isnan().any(0)]
    spots = psf(
        lens, model_of("gaussian", order=4), fields=fields, object_distances=object_distances, per_wavelength=True,
        grid=make_grid(points.new_tensor(1.0), 1),
    )  # fmt: skip
    place = spots.centroid - origin(lens, fields, object_distances, lateral_colour=lateral_colour)
    weights = sensor.weights(lens.wavelengths, lens.wavelength_weights).to(place)
    mean = (place.nan_to_num(0.0)) @ weights.T
    square = (spots.covariance[::2] + place.square()).nan_to_num(0.0) @ weights.T
    return mean, square - mean.square()


def field_kernels(
    lens: Lens,
    sensor: Sensor,
    model: str,
    order: int,
    size: int,
    object_distances: Tensor,
    weights: Tensor,
    lateral_colour: bool = True,
    elements: Sequence[Element] = (),
) -> FieldKernels | ElementKernels:
    """Kernels over the sensor: of a lens, with elements at its stop, or of elements behind a stop alone."""
    elements = tuple(elements)
    if elements and is_stop_alone(lens):
        check_model(model, elements)
        return ElementKernels(lens, elements, sensor, size, object_distances, weights)
    return FieldKernels(lens, sensor, model, order, size, object_distances, weights, lateral_colour, elements=elements)


def has_points(parameters: Model | None) -> bool:
    """Whether the parameters of a PSF model are pupil points of their own rays."""
    return isinstance(getattr(parameters, "rays", None), Tensor)


def check_model(model: str | None, elements: Sequence[Element]) -> None:
    """Raise ValueError for elements and a model of rays."""
    if elements and model != "wave":
        raise ValueError(
            f"model {model!r} with phase elements: only waves diffract at their heights; expected model 'wave', or a "
            "smooth element as a lens of its own: raytrace.wave_optics.hybrid.element_lens(element, …)"
        )


def by_angle(lens: Lens) -> Lens:
    """The lens with angles in place of object heights: the image of an angle is the same at all object distances.

    Lenses with other fields are unchanged, and lenses telecentric in object space, where the image of a height is the
    same at all object distances.
    """
    if lens.fields.kind != "object_height" or lens.fields.telecentric:
        return lens
    angled = with_field_kind(lens, "angle")
    x, y = field_of_object(angled, torch.stack([lens.fields.x, lens.fields.y]), axial_beam(lens))
    return dataclasses.replace(angled, fields=dataclasses.replace(angled.fields, x=x, y=y))


def origin(lens: Lens, fields: Tensor, distances: Tensor, *, lateral_colour: bool) -> Tensor:
    """Points where the chief rays of fields (2, N), (2, D, N) meet the sensor, mm: (2, D, N, 1), without lateral colour
    (2, D, N, W).

    The rays come from objects at distances (D,) mm through the centre of the pupil; vignetting factors are left out.
    """
    lens = aligned(with_object_distance(lens, distances), 2, exactly=True)
    return landing_of(lens, fields[..., None], lens.primary[None] if lateral_colour else lens.wavelengths)


def radii(points: Tensor, count: int) -> Tensor:
    """Equally spaced radii (count,) mm from the axis to the farthest of points (2, ...)."""
    steps = torch.linspace(0, 1, count, dtype=points.dtype, device=points.device)
    return steps * torch.hypot(*points.flatten(1)).max().clamp_min(1e-3)  # the point of a single pixel is on the axis


def along(radii: Tensor, curve: Tensor, points: Tensor) -> Tensor:
    """Values (*points, ...) at points (2, *points) mm of a function (R, ...) of equally spaced radii, linear."""
    place = torch.hypot(*points) / radii[1]
    left = place.floor().clamp_max(len(radii) - 2).long()
    part = (place - left).reshape(*place.shape, *(1,) * (curve.dim() - 1))
    return (1 - part) * curve[left] + part * curve[left + 1]


def of_sum_1(kernels: Tensor) -> Tensor:
    """Kernels (..., h, w) over their sums; 0 without light."""
    return safe_divide(kernels, kernels.sum((-2, -1), keepdim=True))


def _normalised(light: Tensor, arrived: Tensor, normalise: KernelSum) -> Tensor:
    """Kernels (..., h, w) of light, of which (...) arrives on the whole sensor plane."""
    if normalise == "window":
        return of_sum_1(light)
    return safe_divide(light, arrived[..., None, None]) if normalise == "arrived" else light


def check_points(points: Tensor, count: int) -> None:
    """Raise ValueError for places (2, count) mm of another shape, or that are not finite, TypeError for others."""
    if not isinstance(points, Tensor):
        raise TypeError(f"points: {named_value(points)}; expected a tensor (2, {count}) mm, x and y on the sensor")
    if tuple(points.shape) != (2, count):
        advice = ", as points.T" if tuple(points.shape) == (count, 2) else ""
        raise ValueError(
            f"points of shape {tuple(points.shape)}: expected (2, {count}) mm, a place for each image{advice}"
        )
    if not bool(torch.isfinite(points.detach()).all()):
        beyond = int((~torch.isfinite(points.detach())).any(0).sum())
        raise ValueError(f"{beyond} of {count} points are nan or infinite: expected places of the sensor in mm")


def warn_of_dark_places(kernels: Tensor, points: Tensor) -> None:
    """Warn DarkPlaces of kernels (B, C, h, w) at points (2, B) mm that are 0 in a channel."""
    dark = (kernels.detach() == 0).flatten(2).all(2).any(1)
    if bool(dark.any()):
        x, y = min(points.detach()[:, dark].T.tolist(), key=lambda point: math.hypot(*point))
        warnings.warn(
            f"{int(dark.sum())} of {len(dark)} places of the sensor receive no light in the window, and their kernels "
            f"are 0: the nearest to the axis is ({x:.4g}, {y:.4g}) mm; give a sensor within the image circle",
            DarkPlaces,
            stacklevel=calling_level(),
        )


def window_size(
    lens: Lens,
    sensor: Sensor,
    model: str,
    points: Tensor,
    object_distances: Tensor,
    *,
    lateral_colour: bool = True,
    elements: Sequence[Element] = (),
    tol: float = math.inf,
) -> int:
    """An odd number of pixels that holds the light at places (2, N) mm of the sensor. Raises WindowTooLarge.

    tol: share of the light of diffraction that may lie outside. Of elements: a window 1.5 times as large holds at most
    1 % more; without a lens at most 401 pixels.
    """
    if elements and is_stop_alone(lens):
        return _window_of_elements(lens, sensor, model, points, object_distances, _SMALLEST, elements)
    with torch.no_grad():
        fields = sensor.fields(lens, points)
        fields = fields[:, ~fields.isnan().any(0)] if MODELS[model].traces else torch.zeros_like(fields[:, :1])
        how = {"tails": model != "drt", "lateral_colour": lateral_colour}
        reach = max(_reach(lens, sensor, fields, distance, **how) for distance in object_distances.split(1))
        if MODELS[model].waves:
            rings = min(max(2 / (math.pi**2 * tol), _RINGS[0]), _RINGS[1])
            reach = reach + rings * 1e-3 * float(lens.wavelengths.max() * axial_f_number(lens))
    size = 2 * math.ceil(reach / sensor.pitch + 0.5) + 1
    if size > _LARGEST:
        raise WindowTooLarge(
            f"the blur reaches {1e3 * reach:.0f} µm, {size} pixels of {1e3 * sensor.pitch:g} µm across, more than "
            f"{_LARGEST}: focus the lens, as by rt.focus(lens).lens, take larger pixels, or a smaller sensor (--sensor)"
        )
    if not elements:
        return size
    return _window_of_elements(lens, sensor, model, points[:, ::6], object_distances, size, elements)


@torch.no_grad()
def _window_of_elements(
    lens: Lens, sensor: Sensor, model: str, points: Tensor, distances: Tensor, size: int, elements: Sequence[Element]
) -> int:
    """A window of at least `size` pixels, such that one 1.5 times as large holds little more light."""
    weights = sensor.weights(lens.wavelengths, lens.wavelength_weights).to(points)
    kernels = field_kernels(lens, sensor, model, 0, size, distances, weights, elements=elements)
    fields = sensor.fields(lens, points)
    fields = fields[:, ~fields.isnan().any(0)]
    while True:
        size = kernels.size
        larger = min(_LARGEST, 2 * math.ceil(0.75 * size) + 1)
        kernels = dataclasses.replace(kernels, size=larger)
        if isinstance(kernels, ElementKernels):
            light = kernels.light()
        else:
            parts = (dataclasses.replace(kernels, object_distances=distance) for distance in distances.split(1))
            light = torch.cat([part.light(fields, part.origin(fields))[0] for part in parts])
        edge = (larger - size) // 2
        inner, outer = (part.sum((-2, -1)) for part in (light[..., edge:-edge, edge:-edge], light))
        if bool((outer - inner <= _TAIL * outer).all()):
            return size
        if larger == _LARGEST and isinstance(kernels, ElementKernels):
            return _LARGEST
        if larger == _LARGEST:
            share = 100 * float((inner / outer).min())
            raise WindowTooLarge(
                f"the light of the elements spreads over more than {_LARGEST} pixels of {1e3 * sensor.pitch:g} µm: "
                f"{size} hold {share:.0f} % of that in {_LARGEST}; take larger pixels"
            )


def _reach(lens: Lens, sensor: Sensor, fields: Tensor, distance: Tensor, *, tails: bool, lateral_colour: bool) -> float:
    """Largest distance in x or y, mm, of light from the origin of its kernel; tails: of Gaussians, too."""
    batch = scene(lens, fields, distance, lens.wavelengths)
    rays = trace_scene(batch, with_rim(*gauss_rings(8, 24, dtype=fields.dtype, device=fields.device))[0])
    centre = origin(lens, fields, distance, lateral_colour=lateral_colour)[..., None]
    offset = torch.where(rays.valid, rays.position[:2] - centre, torch.nan)
    reach = offset.abs().nan_to_num(0.0).max()
    if tails:
        mean = offset.nanmean(-1, keepdim=True)
        sigma = (offset - mean).square().nanmean(-1).sqrt()
        reach = torch.maximum(reach, (mean[..., 0].abs() + _SIGMAS * sigma).nan_to_num(0.0).max())
    return float(reach)


def order_of(
    lens: Lens,
    sensor: Sensor,
    model: str,
    fields: Tensor,
    object_distances: Tensor,
    size: int,
    tol: float,
    *,
    elements: Sequence[Element] = (),
    center: Literal["chief", "centroid"] = "chief",
    parameters: Model | None = None,
) -> int:
    """The order of the model that meets the tolerance at field points (2, F); those that are nan do not count.

    With elements at the stop of a lens: the lowest order from which the next one differs by less. Elements alone, and
    models of pupil points, have no orders: 0.
    """
    if not MODELS[model].traces and len(MODELS[model].orders) == 1:
        return MODELS[model].orders[0]
    if has_points(parameters) or (elements and is_stop_alone(lens)):
        return 0
    with torch.no_grad():
        fields = fields[:, ~fields.isnan().any(0)] if MODELS[model].traces else torch.zeros_like(fields[:, :1])
        if elements:
            return _order_of_elements(lens, sensor, model, fields, object_distances, size, tol, elements)
        # Width and light in the window determine the error of a Gaussian: a single pixel is enough.
        pitch, size = (sensor.pitch * size, 1) if MODELS[model].by_width else (sensor.pitch, size)
        grid = make_grid(fields.new_tensor(pitch), size)
        # Each field alone: a clipped beam has more rays of an order than the beams of other fields.
        return max(
            psf(
                lens, parameters or model, fields=field, object_distances=object_distances, grid=grid, center=center,
                tol=tol,
            ).order or 0
            for field in fields.split(1, 1)
        )  # fmt: skip


def _order_of_elements(
    lens: Lens,
    sensor: Sensor,
    model: str,
    fields: Tensor,
    distances: Tensor,
    size: int,
    tol: float,
    elements: Sequence[Element],
) -> int:
    weights, before = sensor.weights(lens.wavelengths, lens.wavelength_weights).to(fields), None
    for order in MODELS[model].orders:
        kernels = FieldKernels(lens, sensor, model, order, size, distances, weights, elements=tuple(elements))
        try:
            parts = (dataclasses.replace(kernels, object_distances=distance) for distance in distances.split(1))
            light = torch.cat([part.of_fields(fields) for part in parts], 1)
        except TooCoarse:
            if before is None:
                raise
            break
        change = math.inf if before is None else float((light - before).abs().sum((-2, -1)).max())
        if change <= tol:
            return order - 1
        before = light
    message = f"the kernels of order {order - 1} still change by {change:.1e} of their light, above {tol:.1e}"
    warnings.warn(message, NotConverged, stacklevel=calling_level())
    return order - 1

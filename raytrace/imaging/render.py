"""Pictures that a lens projects onto a sensor: blur over the whole field, distortion, illumination, colour, depth.

    sensor = rt.Sensor(size=(24, 16), pixels=(240, 160), response="rgb")
    image = rt.render(lens, picture, sensor=sensor).image

A picture is the image of an ideal lens of the same focal length. The real lens moves every point of it to the landing
of its chief ray (distortion), multiplies it by the relative illumination, and spreads it by the kernel of its place and
colour:

    y(r) = Σ_r′ h(r - r′; r′) E(r′) x(p(r′))

p(r′): the paraxial image of the object whose chief ray meets the sensor at r′; E: relative illumination; h: of sum 1.
"""

import dataclasses
import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from os import PathLike
from pathlib import Path
from typing import Any, Self, TypeAlias, cast

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.analysis.illumination import relative_illumination
from raytrace.budget import OverBudget, afford
from raytrace.imaging.field_kernels import (
    FieldKernels,
    WindowTooLarge,
    along,
    by_angle,
    channel_moments,
    check_model,
    check_points,
    field_kernels,
    order_of,
    radii,
    warn_of_dark_places,
    window_size,
)
from raytrace.imaging.image import as_picture, blur, depth_masks, encoded, extended_layers, linearised, occlusion
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.spectral_response import band
from raytrace.imaging.varying_blur import bilinear, varying_blur
from raytrace.imaging.warp import resampled
from raytrace.io.pictures import write_light, write_picture
from raytrace.materials.glass import OutOfRange
from raytrace.maths.numerics import as_tensor, placed, varies
from raytrace.maths.result import Result, plain
from raytrace.plotting.style import FIELD_COLOURS, Figure, array, new_figure, styled
from raytrace.psf_models import MODELS, NotConverged, model_name
from raytrace.psf_models.dft import TooManyPoints
from raytrace.system.lens import Lens, check_media, field_points, is_round_about_axis, with_wavelengths
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.launch import object_field
from raytrace.tracing.paraxial import axial_beam
from raytrace.tracing.ray_failures import OutOfReach
from raytrace.wave_optics.compute import COLOURS, DESIGN
from raytrace.wave_optics.element import Element, in_contact
from raytrace.wave_optics.hybrid import is_stop_alone, stop_alone
from raytrace.words import RaytraceWarning, calling_level, former_name, option

#: A PSF model, its order and the pixels across its window.
ModelChoice: TypeAlias = tuple[str, int, int]

_FIRST_NODES, _MOST_NODES = 5, 65  # kernel nodes along the longer side of the sensor, at first and at most
_DEGREE = 13  # degree of the distortion polynomial of a lens without rotational symmetry
_FIT = 25  # points along a side at which this polynomial is fitted
_LIT = 33  # radii at which the illumination of a rotationally symmetric lens is computed
_RADII = 257  # radii at which the chief rays of a rotationally symmetric lens are traced
_COARSE = 600  # pixels along the longer side on which the flux is computed
_ROUNDS = 4  # iterations of the flux
_PLANES = 8  # default number of layers of a depth map
_AZIMUTHS = 64  # azimuths of the image circle of a lens without rotational symmetry
_EDGE, _PARTS = 0.01, 20  # tolerance of the radius of the image circle, pixels; subdivisions of a refinement
_ABOUT = 1 / 400  # the same tolerance where a sensor is refused, relative to the distance of its corner
_BEYOND_FIELDS = 1.5  # accepted distance of the corners of a sensor over the image height of the largest field
_MOST_NUMBERS = 2**27  # numbers of all kernels of such a sensor: about a minute for a picture of 240 × 160 pixels
_SIZES = 12  # sizes of sensors among which the largest possible one is searched
_FAINT = 1e-3  # relative illumination that is treated as 0: few rays pass so narrow a beam
_WAVELENGTHS = 6, 9, 13, 19, 28, 41  # numbers of wavelengths over the response of a sensor
_CELLS = 8  # cells between nodes in whose centres the interpolation is checked
_WIDE = 12.0  # λN: larger blurs are not compared with the wave model, about 1 s a position and wavelength
_BEYOND = 0.72  # Σ |h - ĥ| without diffraction of a point in the centre of a pixel, times the pixel pitch over λN
_COPIES = 6  # copies of kernels and image held in memory together
#: Shares of the tolerance: of the PSF model, of the wavelengths, of the interpolation between nodes and of low rank.
_MODEL, _SPECTRUM, _BETWEEN, _LOW_RANK = 0.2, 0.1, 0.5, 0.2
#: Effects that each PSF model neglects.
_NEGLECTED = {
    "paraxial": "aberrations and diffraction",
    "fourier": "aberrations",
    "gaussian": "the shape of the blur (a Gaussian of equal variance) and diffraction",
    "drt": "diffraction",
    "wave": "polarisation",
}


class BeyondFields(RaytraceWarning):
    """A sensor much larger than the image of the lens's fields."""


@dataclasses.dataclass(frozen=True)
class ImageFormation:
    """Image formation of a lens on a sensor, for any number of pictures: kernels, light and distortion, from `optics`.

    kernels: (m, n, D, C, h, w) at nodes from edge to edge of the sensor; flux: (D, C, H′, W′), light of every point of
    a white scene, on larger pixels; illumination: (H, W) relative illumination, None means 1; ideal: (2, H, W), column
    and row of the picture imaged onto every pixel, None without distortion; planes: (D,) 1/mm, reciprocal object
    distances of the kernels; error: estimated error of the kernels between the nodes, Σ |h - ĥ| at the centre of a
    cell, mean over cells; nan of requested nodes; model, order: of the PSF; reason: for the model; wavelengths: (W,)
    µm; lit: (H, W), pixels at which a chief ray and light arrive, None means all; sampling: picture pixels per sensor
    pixel and side: all maps refer to picture pixels; haze: (D, C), of phase elements alone: the light outside the
    window of the kernels, which is spread evenly over the image, or None.
    """

    sensor: Sensor
    kernels: Tensor
    flux: Tensor
    illumination: Tensor | None
    ideal: Tensor | None
    planes: Tensor
    error: float
    model: str
    order: int
    tol: float
    wavelengths: Tensor
    reason: str = ""
    lit: Tensor | None = None
    sampling: int = 1
    haze: Tensor | None = None

    def __call__(
        self,
        picture: Tensor,
        depth: Tensor | None = None,
        *,
        background: Tensor | None = None,
        softness: float = 0.0,
        boundary: str = "reflect",
        progress: Callable[[int, int], object] | None = None,
    ) -> Tensor:
        """Images (..., C, H, W) of pictures (..., C, H, W), noise-free; depth: (..., H, W) mm; others: see `render`."""
        picture = checked_picture(picture, self.sensor, self.sampling)
        background = None if background is None else checked_picture(background, self.sensor, self.sampling)
        if depth is None and len(self.planes) > 1:
            raise ValueError(
                f"kernels exist for {len(self.planes)} object distances: give {option('depth')}, "
                "the distance (H, W) mm of every pixel"
            )
        depth = None if depth is None else checked_depth(depth, picture)

        def warped(part: Tensor) -> Tensor:
            return part if self.ideal is None else resampled(part, self.ideal, boundary)

        blurs = 1 if depth is None else 2 * len(self.planes)
        each = None if progress is None else _of_several(progress, blurs)
        blurred = partial(varying_blur, boundary=boundary, tol=_LOW_RANK * self.tol, progress=each)
        flux = [enlarged(part, picture) for part in self.flux]
        flux = flux if self.lit is None else [part * self.lit for part in flux]
        window: Sequence[Tensor | float] = [1.0] * len(self.planes)
        haze: Tensor | float = 0.0
        if self.haze is not None:
            share = self.haze.to(picture)[..., None, None]
            window, haze = (1 - share).unbind(), share.mean(0) * (flux[0] * picture).mean((-2, -1), keepdim=True)
        if depth is None:
            image = window[0] * blurred(flux[0] * warped(picture), self.kernels[:, :, 0]) + haze
            return binned(image, self.sampling)
        shade = 1.0 if self.illumination is None else self.illumination.to(picture)
        shade = shade if self.lit is None else torch.where(self.lit, shade, 1.0)
        planes = self.planes.to(depth)
        step = float(planes.diff().min()) if len(planes) > 1 else 0.0
        masks = depth_masks(1 / depth, planes, softness=softness * step)
        # Light and mask of a layer are distorted alike: pixels at the edge of an object see a share of it.
        parts = warped(torch.cat([masks[..., None, :, :] * picture[..., None, :, :, :], masks[..., None, :, :]], -3))
        behind = None if background is None else warped(background)

        def layers() -> Iterator[tuple[Tensor, Tensor]]:
            each = extended_layers(parts[..., :-1, :, :], parts[..., -1, :, :], behind)
            for d, (light, cover) in enumerate(each):
                light, coverage = (blurred(flux[d] * part, self.kernels[:, :, d]) for part in (light, cover / shade))
                yield window[d] * light, coverage

        return binned(occlusion(layers()) + haze, self.sampling)


def binned(image: Tensor, count: int) -> Tensor:
    """The mean (..., H, W) of count × count pixels of images (..., count H, count W)."""
    if count == 1:
        return image
    pooled = torch.nn.functional.avg_pool2d(image.reshape(-1, 1, *image.shape[-2:]), count)
    return pooled.reshape(*image.shape[:-2], *pooled.shape[-2:])


def _of_several(progress: Callable[[int, int], object], blurs: int) -> Callable[[int, int], None]:
    """The progress of several blurs in turn: each later one is expected to take as many convolutions as the current."""
    finished, left, current = 0, blurs, 0

    def advance(done: int, total: int) -> None:
        nonlocal finished, left, current
        current += done
        progress(done, finished + left * total)
        if current == total:
            finished, left, current = finished + total, left - 1, 0

    return advance


def sampling_of(picture: Tensor, sensor: Sensor) -> int:
    """Pixels of pictures (..., C, H, W) in one of the sensor, along a side. Raises ValueError for no whole number."""
    (columns, rows), (height, width) = sensor.pixels, picture.shape[-2:]
    count = height // rows
    if (height, width) != (count * rows, count * columns) or not count:
        raise ValueError(
            f"picture {width} × {height} pixels, sensor {columns} × {rows} pixels: each side of the picture must be k "
            f"times that of the sensor, k = 1, 2, …; resize the picture, or use Sensor(pixels=({width}, {height}))"
        )
    return count


def checked_picture(picture: Tensor, sensor: Sensor, sampling: int = 1) -> Tensor:
    """Pictures (..., C, H, W) of the channels of the sensor and of its sampled size. Raises ValueError for others."""
    picture = as_picture(picture)
    channels = len(sensor.channels)
    picture = picture[None] if picture.dim() == 2 else picture
    rows, columns = picture.shape[-2:]
    if sampling_of(picture, sensor) != sampling:
        raise ValueError(
            f"a picture of {columns} × {rows} pixels; the kernels are prepared for {sampling} × {sampling} picture "
            "pixels in a pixel of the sensor: resize the picture, or call `render` again"
        )
    if picture.shape[-3] not in (1, channels):
        raise ValueError(
            f"a picture of {picture.shape[-3]} channels on a sensor of {channels}: expected (..., {channels}, rows, "
            "columns)"
        )
    if not bool(torch.isfinite(picture).all()):
        count = int((~torch.isfinite(picture)).sum())
        raise ValueError(f"{count} numbers of the picture are not finite: expected finite values")
    return picture.expand(*picture.shape[:-3], channels, rows, columns)


def checked_depth(depth: Tensor, picture: Tensor) -> Tensor:
    """Distances (..., H, W) mm of the pixels of pictures (..., C, H, W). Raises ValueError for others."""
    depth = torch.as_tensor(depth, dtype=picture.dtype, device=picture.device)
    if depth.shape[-2:] != picture.shape[-2:]:
        raise ValueError(
            f"a depth map of shape {tuple(depth.shape)} and a picture of {tuple(picture.shape)}: expected the distance "
            "of every pixel"
        )
    if bool(depth.isnan().any()) or bool((depth <= 0).any()):
        raise ValueError(
            "a depth map with nan, zero or negative numbers: expected distances above 0 in mm from surface 1; inf is "
            "allowed"
        )
    return depth


def optics(
    lens: Lens,
    sensor: Sensor,
    *,
    elements: Element | Sequence[Element] = (),
    model: str | None = None,
    wavelengths: Sequence[float] | Tensor | None = None,
    object_distances: Tensor | None = None,
    tol: float = 1e-2,
    distortion: bool = True,
    lateral_colour: bool = True,
    illumination: bool = True,
    nodes: tuple[int, int] | None = None,
    order: int | None = None,
    size: int | None = None,
    sampling: int = 1,
) -> ImageFormation:
    """Prepare a lens and its sensor for `ImageFormation.__call__`; arguments as for `render`.

    elements: at the stop; of elements alone the lens is `wave_optics.hybrid.stop_alone`. object_distances: (D,) mm of
    layers, by default the lens's; nodes: (m, n) of the grid of kernels, instead of as many as the tolerance
    needs; order, size: of the PSF model and of its window, as of an earlier call, for loops; sampling: pixels of the
    pictures in one of the sensor, along a side.
    """
    elements, whole = in_contact(elements), sensor
    if sampling > 1:
        columns, rows = sensor.pixels
        sensor = dataclasses.replace(sensor, pixels=(sampling * columns, sampling * rows), mosaic="none")
    model = None if model is None else model_name(model)
    if order is not None and model is None and not elements:
        raise ValueError(f"order {order} without a model: give model=…, one of {', '.join(MODELS)}")
    model = model or ("wave" if elements else None)
    check_model(model, elements)
    like = lens.surfaces[-2].thickness
    lens = lens if object_distances is None else by_angle(lens)
    distances = lens.surfaces[0].thickness if object_distances is None else as_tensor(object_distances)
    distances = distances.to(like).reshape(-1)
    planes, nearer = (1 / distances).sort()
    distances = distances[nearer]
    of_fields = lens
    if wavelengths is not None:
        lens = _at_specified(lens, as_tensor(wavelengths).to(like))
    sampled = lens
    response = sensor.response if wavelengths is None and len(lens.wavelengths) > 1 else None
    if not is_stop_alone(lens):
        few = lens if response is None else _at_wavelengths(lens, *band(response), _WAVELENGTHS[0])
        image_circle = partial(_image_circle, of_fields, sensor, like)
        _check_reach(few, sensor, image_circle, model, size, nodes, distances, lateral_colour, tol)
    circle = None if is_stop_alone(lens) else _image_circle(of_fields, sensor, like)
    corners, diagonal = (_within(circle, places) for places in (_places(sensor, 5, 5, like), _diagonal(lens, sensor)))
    if response is not None and not is_stop_alone(lens):
        sampled = _over_response(lens, sensor, band(response), diagonal, distances, lateral_colour, _SPECTRUM * tol)
    weights = sensor.weights(sampled.wavelengths, sampled.wavelength_weights).to(like)
    chosen, reason = _model_of(
        sampled, sensor, model, order, size, corners, diagonal, distances, weights, tol, lateral_colour, elements
    )
    model, order, size = chosen
    _afford_kernels((3, 3) if nodes is None else nodes, len(distances), weights, size, sensor)
    kernels = field_kernels(sampled, sensor, model, order, size, distances, weights, lateral_colour, elements)
    haze = None
    if isinstance(kernels, FieldKernels):
        grid, error = _grid(kernels, circle, nodes, _BETWEEN * tol, like)
    else:
        light = kernels.light()
        grid, haze, error = kernels.of_light(light)[None, None], 1 - kernels.share(light), 0.0
    along_radii = is_round_about_axis(lens) and (illumination or distortion)
    places = _every_pixel(sensor, like) if along_radii or circle is not None else None
    lit = None if circle is None or places is None else _is_lit(circle, places)
    pixels = _within(circle, places) if along_radii and places is not None else None
    shade = _illumination(lens, sensor, circle, pixels, like) if illumination else None
    ideal = _ideal(lens, sensor, circle, pixels, like) if distortion and not is_stop_alone(lens) else None
    flux = _flux(grid, shade, sensor)
    shade = shade if lit is None or shade is None else shade * lit
    return ImageFormation(
        whole, grid, flux, shade, ideal, planes, error, model, order, tol, sampled.wavelengths.detach(), reason, lit,
        sampling, haze,
    )  # fmt: skip


def _check_reach(
    lens: Lens,
    sensor: Sensor,
    image_circle: Callable[[float], tuple[Tensor, Tensor] | None],
    model: str | None,
    size: int | None,
    nodes: tuple[int, int] | None,
    distances: Tensor,
    lateral_colour: bool,
    tol: float,
) -> None:
    """Warn BeyondFields of a sensor whose corners lie far beyond the image of the lens's largest field.

    There the blur grows so fast that the tolerance needs the largest number of nodes. Raises WindowTooLarge or
    OverBudget, with the largest sensor of the same shape, where kernels of them as large as those of the corners cannot
    be computed; image_circle: function of the tolerance of its radius, mm.
    """
    corner, height = float(torch.hypot(*sensor.corners).max()), _image_height(lens, sensor)
    if not height or corner <= _BEYOND_FIELDS * height:
        return
    weights, circle = sensor.weights(lens.wavelengths, lens.wavelength_weights), image_circle(_ABOUT * corner)

    def check(share: float) -> None:
        width, height = sensor.size
        part = dataclasses.replace(sensor, size=(share * width, share * height))
        corners = _within(circle, part.corners.to(lens.surfaces[-2].thickness))
        kernel_arguments = lens, part, model or "gaussian", corners, distances
        window = size or window_size(*kernel_arguments, lateral_colour=lateral_colour, tol=tol)
        m, n = nodes or _nodes(part, _MOST_NODES)
        if len(distances) * len(weights) * m * n * window**2 > _MOST_NUMBERS:
            raise OverBudget(f"kernels of {window} × {window} pixels at {m} × {n} positions of the sensor take minutes")
        _afford_kernels((m, n), len(distances), weights, window, part)

    place = (
        f"the corners of the sensor lie {corner:.3g} mm from the axis, {corner / height:.2g} times the image height of "
        f"the largest field, {height:.3g} mm"
    )
    try:
        check(1.0)
    except (WindowTooLarge, OverBudget) as error:
        works = _BEYOND_FIELDS * height / corner
        for share in np.linspace(works, 1, _SIZES, endpoint=False)[1:].tolist():  # from below: they may fail in between
            try:
                check(share)
            except (WindowTooLarge, OverBudget):
                break
            works = share
        sides = " × ".join(f"{works * side:.3g}" for side in sensor.size)
        columns, rows = sensor.pixels
        raise type(error)(
            f"{place}, and the blur there is too large: take a sensor of at most about {sides} mm (--sensor) for "
            f"{columns} × {rows} pixels, or give the lens larger fields, lens.at(fields=…); {error}"
        ) from None
    warnings.warn(
        f"{place}: the blur beyond that height may take minutes to compute; take a smaller sensor (--sensor), or give "
        "the lens larger fields, lens.at(fields=…)",
        BeyondFields,
        stacklevel=calling_level(),
    )


def _image_height(lens: Lens, sensor: Sensor) -> float:
    """Largest distance from the axis, mm, at which the chief rays of the lens's fields meet the sensor."""
    fields = field_points(None, like=lens).detach()
    return float(torch.hypot(*sensor.landing(lens, fields)).detach().nan_to_num(0.0).max())


def _diagonal(lens: Lens, sensor: Sensor) -> Tensor:
    """Points (2, N) mm on the diagonal, of a rotationally symmetric lens before a centred sensor on one half of it."""
    half = is_round_about_axis(lens) and not any(sensor.offset)
    shares = (0.0, 0.5, 1.0) if half else (-1.0, -0.5, 0.0, 0.5, 1.0)
    return sensor.on_diagonal(shares).to(lens.surfaces[-2].thickness)


@torch.no_grad()
def _over_response(
    lens: Lens,
    sensor: Sensor,
    ends: tuple[float, float],
    places: Tensor,
    distances: Tensor,
    lateral_colour: bool,
    tol: float,
) -> Lens:
    """The lens at as many equidistant wavelengths over the response as the kernels of the channels need.

    The error of a number is the change of the channels' Gaussian kernels to about 1.5 times as many: of a shift d and a
    difference v of variance, Σ |h - ĥ| = √(2/π) d/σ + √(2/πe) v/σ². ends: of the response, µm. Warns NotConverged.
    """
    sensor.weights(lens.wavelengths)  # raises if the wavelengths lie outside the response
    before = None
    for count in _WAVELENGTHS:
        sampled = _at_wavelengths(lens, *ends, count)
        mean, variance = channel_moments(sampled, sensor, places, distances, lateral_colour=lateral_colour)
        if before is not None:
            square = variance + sensor.pitch**2 / 12
            shift, wider = mean - before[1], variance - before[2]
            moved = math.sqrt(2 / math.pi) * shift.abs() / square.sqrt()
            change = float((moved + math.sqrt(2 / (math.pi * math.e)) * wider.abs() / square).max())
            if change <= tol:
                return before[0]
        before = sampled, mean, variance
    message = (
        f"the kernels of {len(sampled.wavelengths)} wavelengths over the response of the sensor have an estimated "
        f"error of {change:.1e}, above {tol:.1e}"
    )
    warnings.warn(message, NotConverged, stacklevel=calling_level())
    return sampled


def _at_specified(lens: Lens, wavelengths: Tensor) -> Lens:
    """The lens at wavelengths (W,) µm, whose primary one, to which distortion refers, stays if it is among them."""
    if torch.equal(wavelengths, lens.wavelengths):
        return lens
    same = torch.nonzero(wavelengths == lens.primary)[:, 0].tolist()
    return dataclasses.replace(with_wavelengths(lens, wavelengths), primary_wavelength=1 + (same or [0])[0])


def _at_wavelengths(lens: Lens, low: float, high: float, count: int) -> Lens:
    """The lens at about `count` equidistant wavelengths from low to high, µm, first the primary one."""
    step, primary = (high - low) / count, float(lens.primary)
    numbers = range(math.ceil((low - primary) / step), math.floor((high - primary) / step) + 1)
    wavelengths = [lens.primary]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", OutOfRange)  # at the ends, where the sensor hardly responds
        for number in numbers:
            try:
                check_media(lens, lens.primary[None] + number * step)
            except ValueError:
                continue
            wavelengths += [lens.primary + number * step] if number else []
        return with_wavelengths(lens, torch.stack(wavelengths))


def _model_of(
    lens: Lens,
    sensor: Sensor,
    model: str | None,
    order: int | None,
    size: int | None,
    corners: Tensor,
    diagonal: Tensor,
    distances: Tensor,
    weights: Tensor,
    tol: float,
    lateral_colour: bool,
    elements: tuple[Element, ...],
) -> tuple[ModelChoice, str]:
    """Model, order and window of the kernels, and the reason for the model.

    Without a model: the first model of the sequence of `psf_models` that traces rays and whose kernels on the diagonal
    differ from those of the next model by less than the tolerance. Warns NotConverged where waves need too many rays.
    """

    def fitted(name: str) -> ModelChoice:
        window = size or window_size(
            lens, sensor, name, corners, distances, lateral_colour=lateral_colour, elements=elements, tol=tol
        )
        if order is not None:
            return name, order, window
        kernel_arguments = lens, sensor, name, sensor.fields(lens, diagonal), distances, window, _MODEL * tol
        return name, order_of(*kernel_arguments, elements=elements), window

    if model is not None:
        return fitted(model), ""
    ring = 1e-3 * float(lens.wavelengths.max() * axial_f_number(lens))  # λN
    airy, reason = 1.22 * ring, ""
    chosen: ModelChoice | None = None
    before: Tensor | None = None
    with torch.no_grad():
        for row in (row for row in MODELS.values() if row.is_automatic and row.traces):
            try:
                if row.waves and chosen and (reach := 0.5 * chosen[2] * sensor.pitch / ring) > _WIDE:
                    raise TooManyPoints(
                        f"the blur radius is {reach:.0f} λN, and the wave model is tried up to {_WIDE:g} λN: choose "
                        f"{option('model', 'wave')}, or focus the lens"
                    )
                choice = fitted(row.name)
                kernels = field_kernels(lens, sensor, *choice, distances, weights, lateral_colour).at(diagonal)
            except WindowTooLarge:  # only the tails of a Gaussian exceed the window
                if row.name != "gaussian":
                    raise
                continue
            except (TooManyPoints, OverBudget) as error:
                if chosen is None:
                    raise
                # Of a point in the middle of a pixel: a circular pupil has 2/(π² R) of its light beyond R λN.
                share = _BEYOND * ring / sensor.pitch
                reason = f"at most {100 * share:.2g} % of the energy of an image point"
                if share > tol:
                    message = f"the PSF model {chosen[0]} neglects diffraction, {reason}; {error}"
                    warnings.warn(message, NotConverged, stacklevel=calling_level())
                return chosen, reason
            if chosen is not None and before is not None:
                gap = _kernel_difference(kernels, before)
                if gap <= tol and (row.waves or sensor.pitch > 4 * airy):
                    return chosen, f"kernels of {row.name} differ by {gap:.1e}, Σ|Δh|"
                reason = f"kernels of {chosen[0]} differ by {gap:.1e}, Σ|Δh|"
            chosen, before = choice, kernels
    assert chosen is not None  # of DRT, or it raised
    return chosen, reason


def _kernel_difference(kernels: Tensor, others: Tensor) -> float:
    """Largest Σ |h - ĥ| of kernels (..., h, w) in windows of any size with a common centre."""
    size = max(kernels.shape[-1], others.shape[-1])
    padded = [torch.nn.functional.pad(part, [(size - part.shape[-1]) // 2] * 4) for part in (kernels, others)]
    return float((padded[0] - padded[1]).abs().sum((-2, -1)).max())


def _afford_kernels(nodes: tuple[int, int], count: int, weights: Tensor, size: int, sensor: Sensor) -> None:
    """Raise OverBudget for kernels of `count` distances, or images, that memory does not hold."""
    (m, n), channels = nodes, len(weights)
    (columns, rows), each = sensor.pixels, _COPIES * weights.element_size()
    problem = f"kernels of {size} × {size} pixels at {m} × {n} positions of the sensor need too much memory"
    remedy = "take a larger {tol} or a smaller {sensor}, or focus the lens ({size} sets their window)"
    afford(each * channels * count * m * n * size * size, problem, helps=remedy)
    problem = f"{columns} × {rows} pixels of {channels} channels need too much memory"
    afford(each * channels * columns * rows, problem, helps="take a picture of fewer pixels")


def _image_circle(lens: Lens, sensor: Sensor, like: Tensor, edge: float | None = None) -> tuple[Tensor, Tensor] | None:
    """Centre (2, 1) mm and radii (A,) mm of the image circle at equidistant azimuths, or None if it holds the sensor.

    Outside the circle no chief ray or no light reaches the sensor. A rotationally symmetric lens has one radius. edge:
    tolerance of the radii, mm.
    """
    edge = _EDGE * sensor.pitch if edge is None else edge
    with torch.no_grad(), warnings.catch_warnings():
        is_symmetric = is_round_about_axis(lens)
        middle = like.new_zeros(2, 1) if is_symmetric else sensor.landing(lens, like.new_zeros(2, 1)).nan_to_num(0.0)
        angle = torch.arange(1 if is_symmetric else _AZIMUTHS, dtype=like.dtype, device=like.device)
        angle = 2 * math.pi / len(angle) * angle
        ray = torch.stack([torch.sin(angle), torch.cos(angle)])
        inside, width = torch.zeros_like(angle), torch.hypot(*(sensor.corners.to(like) - middle)).max()
        parts = torch.arange(1, _PARTS, dtype=like.dtype, device=like.device)[:, None]
        warnings.simplefilter("ignore", RaytraceWarning)  # of rays outside
        if bool(_has_light(lens, sensor, middle + width * ray).all()):
            return None
        for _ in range(math.ceil(math.log(float(width) / edge, _PARTS))):
            width = width / _PARTS
            places = middle[..., None] + (inside + width * parts) * ray[:, None]  # (2, parts, A)
            arrives = _has_light(lens, sensor, places.flatten(1)).unflatten(0, places.shape[1:])
            inside = inside + width * arrives.long().cumprod(0).sum(0)
        return middle, inside


def _has_light(lens: Lens, sensor: Sensor, points: Tensor) -> Tensor:
    return illumination_at(lens, sensor, points) > _FAINT


def _radius(circle: tuple[Tensor, Tensor], points: Tensor) -> tuple[Tensor, Tensor]:
    """Distances (...) of points (2, ...) from the centre of an image circle, and its radius in their directions."""
    middle, radii_ = circle
    x, y = points - middle.reshape(2, *(1,) * (points.dim() - 1))
    azimuth_index = torch.atan2(x, y) / (2 * math.pi) % 1 * len(radii_)
    left = azimuth_index.floor().long() % len(radii_)
    part = azimuth_index - azimuth_index.floor()
    return torch.hypot(x, y), (1 - part) * radii_[left] + part * radii_[(left + 1) % len(radii_)]


def _is_lit(circle: tuple[Tensor, Tensor], points: Tensor) -> Tensor:
    distance, radius = _radius(circle, points)
    return distance <= radius


def _within(circle: tuple[Tensor, Tensor] | None, points: Tensor) -> Tensor:
    """Points (2, ...) mm, those outside the image circle moved to its edge, towards its centre."""
    if circle is None:
        return points
    (distance, radius), middle = _radius(circle, points), circle[0].reshape(2, *(1,) * (points.dim() - 1))
    return middle + (points - middle) * (radius / distance.clamp_min(1e-9)).clamp_max(1.0)


def _places(sensor: Sensor, m: int, n: int, like: Tensor, shift: float = 0.0) -> Tensor:
    """Places (2, m·n) mm of a grid from edge to edge of the sensor; shift: by a part of a cell."""
    columns, rows = sensor.pixels
    lines = []
    for count, nodes in ((rows, m), (columns, n)):
        steps = torch.arange(nodes - (shift > 0), dtype=like.dtype, device=like.device) + shift
        lines.append(steps * (count / max(nodes - 1, 1)) - 0.5 if nodes > 1 else steps.new_tensor([0.5 * (count - 1)]))
    row, column = torch.meshgrid(*lines, indexing="ij")
    return sensor.points(column.flatten(), row.flatten())


def _nodes(sensor: Sensor, count: int) -> tuple[int, int]:
    """Numbers of rows and columns of a grid of nodes, `count` of them along the longer side."""
    columns, rows = sensor.pixels
    m, n = (max(2, round((count - 1) * side / max(columns, rows)) + 1) for side in (rows, columns))
    return m, n


def _grid(
    kernels: FieldKernels,
    circle: tuple[Tensor, Tensor] | None,
    nodes: tuple[int, int] | None,
    tol: float,
    like: Tensor,
) -> tuple[Tensor, float]:
    """Kernels (m, n, D, C, h, w) at as many nodes as the tolerance needs, and the error of their interpolation.

    Error: Σ |h - ĥ| at the centre of a cell, ĥ the mean of the four kernels at its corners, mean over 8 cells. Nodes
    outside the image circle have the kernels of its edge. Raises OverBudget.
    """
    sensor = kernels.sensor

    def kernels_at(places: Tensor) -> Tensor:
        return kernels.at(_within(circle, places))

    if nodes is not None:
        return kernels_at(_places(sensor, *nodes, like)).unflatten(0, nodes), math.nan
    count = _FIRST_NODES
    with torch.no_grad():
        while True:
            m, n = _nodes(sensor, count)
            _afford_kernels((m, n), len(kernels.object_distances), kernels.weights, kernels.size, sensor)
            grid = kernels_at(_places(sensor, m, n, like)).unflatten(0, (m, n))
            middles = _places(sensor, m, n, like, 0.5)
            # Cells evenly spaced in the order of their distance from the middle of the sensor.
            outwards = torch.hypot(*(middles - middles.mean(1, keepdim=True))).argsort(stable=True)
            some = torch.linspace(0, len(outwards) - 1, min(_CELLS, len(outwards)), device=like.device)
            cells = outwards[some.round().long()]
            mean = (0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])).flatten(0, 1)[cells]
            error = float((mean - kernels_at(middles[:, cells])).abs().sum((-2, -1)).amax((1, 2)).mean())
            if error <= tol or count >= _MOST_NODES:
                break
            # The error of linear interpolation falls with the square of the cell, of sharp kernels with its power 1.4.
            count = min(_MOST_NODES, max(count + 2, math.ceil(1.1 * (count - 1) * (error / tol) ** 0.7) + 1))
    if error > tol:
        message = f"the kernels between {m} × {n} nodes have an estimated error of {error:.1e}, above {tol:.1e}"
        warnings.warn(message, NotConverged, stacklevel=calling_level())
    numbers = pytree.tree_leaves((kernels.lens, kernels.object_distances, kernels.elements))
    if torch.is_grad_enabled() and any(map(varies, numbers)):
        grid = kernels_at(_places(sensor, m, n, like)).unflatten(0, (m, n))
    return grid, error


def _flux(kernels: Tensor, illumination: Tensor | None, sensor: Sensor) -> Tensor:
    """Light v (D, C, H′, W′) of the points of a white scene, whose image is the relative illumination E.

    Kernels that vary over the field move light: Σ_r′ h(r - r′; r′) is not 1 everywhere, but the irradiance of a white
    scene depends on the solid angle of the exit pupil alone, not on aberrations. v: the fixed point of v + E - A v, A
    the blur, from E on; smooth, so that larger pixels, which kernels and E are averaged over, are enough.
    """
    if illumination is None and kernels.shape[:2] == (1, 1):
        return kernels.new_ones(*kernels.shape[2:4], 1, 1)
    columns, rows = sensor.pixels
    factor = max(1, 2 * math.ceil(max(rows, columns) / _COARSE / 2) - 1)
    coarse = _pooled(kernels, factor)
    size = math.ceil(rows / factor), math.ceil(columns / factor)
    white = kernels.new_ones(kernels.shape[3], rows, columns) if illumination is None else illumination.to(kernels)
    white = torch.nn.functional.adaptive_avg_pool2d(white.expand(kernels.shape[3], rows, columns), size)
    flux = []
    for kernel in coarse.unbind(2):
        light = white
        for _ in range(_ROUNDS):
            light = light + white - varying_blur(light, kernel)
        flux.append(light)
    return torch.stack(flux)


def _pooled(kernels: Tensor, factor: int) -> Tensor:
    """Kernels (..., h, w) on pixels larger by an odd factor, about the same middle."""
    if factor == 1:
        return kernels
    size = [2 * math.ceil((n - factor) / 2 / factor) + 1 for n in kernels.shape[-2:]]
    down, right = ((n * factor - old) // 2 for n, old in zip(size, kernels.shape[-2:], strict=True))
    padded = torch.nn.functional.pad(kernels, (right, right, down, down))
    return padded.unflatten(-1, (size[1], factor)).unflatten(-3, (size[0], factor)).sum((-3, -1))


def enlarged(light: Tensor, picture: Tensor) -> Tensor:
    """Numbers (C, H′, W′) on larger pixels, at the pixels of pictures (..., C, H, W), bilinear."""
    if light.shape[-2:] == picture.shape[-2:]:
        return light.to(picture)
    light, size = light.to(picture)[None], picture.shape[-2:]
    return torch.nn.functional.interpolate(light, size=size, mode="bilinear", align_corners=False)[0]


def _illumination(
    lens: Lens, sensor: Sensor, circle: tuple[Tensor, Tensor] | None, pixels: Tensor | None, like: Tensor
) -> Tensor:
    """Relative illumination (H, W) of the pixels; outside the image circle, the value at its edge.

    pixels: places of a round lens within the circle.
    """
    if pixels is not None:
        nodes = radii(pixels, _LIT)
        return along(nodes, illumination_at(lens, sensor, torch.stack([torch.zeros_like(nodes), nodes])), pixels)
    grid = illumination_at(lens, sensor, _within(circle, _places(sensor, _FIT, _FIT, like))).reshape(_FIT, _FIT)
    across, down = (bilinear(count, 0, _FIT, like=like) for count in sensor.pixels)
    return down.T @ grid @ across


def illumination_at(lens: Lens, sensor: Sensor, points: Tensor) -> Tensor:
    """Relative illumination (N,) at points (2, N) mm of the sensor; 0 where no light arrives."""
    fields = sensor.fields(lens, points)
    arrives = ~fields.isnan().any(0)
    values = torch.zeros_like(fields[0, arrives])
    if len(values):
        with suppress(OutOfReach):  # every field is out of reach: illumination 0
            values = relative_illumination(lens, fields=fields[:, arrives]).illumination
    return placed(values.nan_to_num(0.0), arrives)


def _ideal(
    lens: Lens, sensor: Sensor, circle: tuple[Tensor, Tensor] | None, pixels: Tensor | None, like: Tensor
) -> Tensor:
    """Picture column and row (2, H, W) for each pixel: the paraxial image point of the object whose chief ray meets it.

    Chief rays near the axis set the scale at the current sensor distance. Of a rotationally symmetric lens, whose
    pixels are given, linear between 257 radii; else polynomials of degree 13 through 25 × 25 chief rays. Outside the
    image circle the displacement is proportional to the radius, or equal to the displacement at the edge.
    """
    if pixels is not None:
        nodes = radii(pixels, _RADII)
        image = _paraxial_image(lens, sensor, torch.stack([torch.zeros_like(nodes[1:]), nodes[1:]]))[1] / nodes[1:]
        scale = along(nodes, torch.cat([torch.ones_like(image[:1]), image]), pixels)
        return sensor.pixel_of(scale * _every_pixel(sensor, like))
    points = _within(circle, _places(sensor, _FIT, _FIT, like))
    shift = sensor.pixel_of(_paraxial_image(lens, sensor, points)) - sensor.pixel_of(points)
    columns, rows = sensor.pixels
    down, across = (_chebyshev(count, _FIT, like) for count in (rows, columns))
    # Least squares by the pseudoinverse along either axis.
    fitted = [torch.linalg.pinv(down[0]) @ part.reshape(_FIT, _FIT) @ torch.linalg.pinv(across[0]).T for part in shift]
    shift = torch.stack([down[1] @ part @ across[1].T for part in fitted])
    lines = (torch.arange(n, dtype=like.dtype, device=like.device) for n in (rows, columns))
    row, column = torch.meshgrid(*lines, indexing="ij")
    return torch.stack([column, row]) + shift


def _paraxial_image(lens: Lens, sensor: Sensor, points: Tensor) -> Tensor:
    """Paraxial images (2, N) mm of the objects whose chief rays meet the sensor at points (2, N) mm; where no chief ray
    arrives, the point itself."""
    near = 1e-4 * points.abs().max() * torch.eye(2, dtype=points.dtype, device=points.device)
    fields = sensor.fields(lens, torch.cat([points, near], 1))
    extents = object_field(lens, fields.nan_to_num(0.0), axial_beam(lens))[0]
    scale = near @ torch.linalg.inv(extents[:, -2:])  # mm of the image per unit of the object
    return torch.where(fields[:, :-2].isnan().any(0), points, scale @ extents[:, :-2])


def _chebyshev(count: int, places: int, like: Tensor) -> tuple[Tensor, Tensor]:
    """T_j at `places` from edge to edge of `count` pixels, (places, J), and at the pixels, (count, J)."""
    fitted = torch.linspace(-1, 1, places, dtype=like.dtype, device=like.device)
    pixels = (torch.arange(count, dtype=like.dtype, device=like.device) + 0.5) * (2 / count) - 1
    orders = torch.arange(_DEGREE + 1, dtype=like.dtype, device=like.device)
    at_places, at_pixels = (torch.cos(torch.acos(x.clamp(-1, 1))[:, None] * orders) for x in (fitted, pixels))
    return at_places, at_pixels


def _every_pixel(sensor: Sensor, like: Tensor) -> Tensor:
    """Places (2, H, W) mm."""
    columns, rows = sensor.pixels
    row = torch.arange(rows, dtype=like.dtype, device=like.device)[:, None].expand(rows, columns)
    column = torch.arange(columns, dtype=like.dtype, device=like.device).expand(rows, columns)
    return sensor.points(column, row)


def render(
    lens: Lens | Element | Sequence[Element],
    picture: Tensor,
    *,
    sensor: Sensor | None = None,
    elements: Element | Sequence[Element] = (),
    sensor_distance: float | Tensor | None = None,
    wavelengths: Sequence[float] | Tensor | None = None,
    depth: Tensor | None = None,
    background: Tensor | None = None,
    model: str | None = None,
    tol: float = 1e-2,
    planes: int = _PLANES,
    softness: float = 0.0,
    size: int | None = None,
    boundary: str = "reflect",
    distortion: bool = True,
    lateral_colour: bool = True,
    illumination: bool = True,
    progress: Callable[[int, int], object] | None = None,
) -> "Rendering":
    """The picture that a lens projects onto its sensor, without noise, differentiable in the numbers of the lens.

    lens: or phase elements in contact without a lens, `sensor_distance` mm before the sensor, of an object at infinity
        or of `depth`.
    picture: (..., C, H, W), or (H, W), linear in light; integers of 8 or 16 bits are encoded as sRGB (IEC 61966-2-1).
    sensor: with the number of pixels of the picture, or 1/k of it along a side (a scene sampled more finely); by
        default of the size that the largest field of the lens fills to its corners, one channel, or "rgb" of three.
    wavelengths: (W,) µm. Default: of a sensor with a response, as many over it as `tol` requires; otherwise, or if the
        lens has one wavelength, those of the lens; of elements 0.55, or 0.46, 0.55 and 0.64 of a sensor in colour.
    depth: (H, W) mm from surface 1 to the object in every pixel, inf allowed: layers from far to near at `planes`
        equally spaced reciprocal distances, of which near ones cover far ones; softness: of the transition between
        layers, a logistic function of so large a share of the difference of their reciprocal distances.
    background: a picture of the farthest layer without the objects in front of it, which a blurred silhouette shows;
        by default every layer continues behind nearer ones as its visible surroundings do.
    elements: phase elements in contact at the stop of the lens, of `rt.wave_optics.phase_elements` or
        `rt.wave_optics.phase_element`.
    model: of the PSF, see `rt.psf`; by default the first of "gaussian", "drt" and "wave" whose kernels differ from
        the next model's by less than `tol`; with elements "wave".
    tol: upper bound of the estimated error Σ |h - ĥ| of the kernels; a picture with values from 0 to 1 then errs by at
        most half of it.
    size: pixels across their window, an odd number, by default as many as hold the light.
    boundary: the scene beyond the edge of the picture: "reflect", its mirror image, or "zero", black.
    distortion, lateral_colour, illumination: False ignores the effect.
    progress: called with the number of convolutions done since the last call, and their total.
    Raises ValueError for a picture, depth map or sensor that do not fit, WindowTooLarge for a blur of over 401 pixels,
    OverBudget for kernels that memory does not hold.
    """
    light = linearised(picture)
    light = light[None] if light.dim() == 2 else light
    if not isinstance(lens, Lens):
        if elements:
            raise ValueError("elements without a lens are the first argument of render: leave out elements=…")
        elements, wavelengths_of_stop, wavelengths = lens, wavelengths, None
        lens = element_in_stop(elements, sensor, sensor_distance, wavelengths_of_stop)
    elif sensor_distance is not None:
        raise ValueError("sensor_distance applies to elements without a lens; use lens.at(sensor_distance=…)")
    sensor = default_sensor(lens, light) if sensor is None else sensor
    sampling, distances = sampling_of(light, sensor), None
    light = checked_picture(light, sensor, sampling)
    if depth is not None:
        depth = checked_depth(depth, light)
        distances = 1 / plane_distances(depth.double(), planes)
    elif background is not None:
        raise ValueError(f"{option('background')} requires {option('depth')}, distances of the objects before it")
    background = None if background is None else checked_picture(linearised(background), sensor, sampling)
    ready = optics(
        lens, sensor, elements=elements, model=model, wavelengths=wavelengths, object_distances=distances, tol=tol,
        distortion=distortion, lateral_colour=lateral_colour, illumination=illumination, size=size, sampling=sampling,
    )  # fmt: skip
    image = ready(light, depth, background=background, softness=softness, boundary=boundary, progress=progress)
    return Rendering(image, binned(light, sampling), lens, ready)


def element_in_stop(
    elements: Element | Sequence[Element],
    sensor: Sensor | None,
    sensor_distance: float | Tensor | None,
    wavelengths: Sequence[float] | Tensor | None,
) -> Lens:
    """The stop of elements without a lens; arguments as for `render`. Raises ValueError for a missing one."""
    parts = in_contact(elements)
    if not parts:
        raise ValueError(
            "no element: expected one or several in contact, of rt.wave_optics.phase_elements or "
            "rt.wave_optics.phase_element"
        )
    if sensor is None or sensor_distance is None:
        raise ValueError("elements without a lens: give sensor=rt.Sensor(…) and sensor_distance=…, mm")
    if wavelengths is None:
        wavelengths = COLOURS if sensor.response is not None else (DESIGN,)
    return stop_alone(parts, sensor_distance=sensor_distance, wavelengths=wavelengths)


def render_patches(
    lens: Lens,
    patches: Tensor,
    points: Tensor,
    *,
    sensor: Sensor,
    size: int,
    order: int,
    elements: Element | Sequence[Element] = (),
    model: str | None = None,
    object_distances: Tensor | None = None,
    lateral_colour: bool = True,
    illumination: bool = False,
) -> Tensor:
    """Images (B, C, H - size + 1, W - size + 1) of patches (B, C, H, W) centred at points (2, B) mm: for training.

    Each patch has the kernel of its centre, and with `illumination` the relative illumination there; distortion and its
    change over a patch are neglected. size, order: of the window and of the PSF model, as of `kernels` and `order` of
    the `ImageFormation` of the initial lens by the same model. model: by default "gaussian"; elements: as for `render`,
    with the model "wave". object_distances: (B,) mm from surface 1
    to the object of each patch, or one of all, inf allowed; by default the lens's. Differentiable in the numbers
    of the lens, of the elements and in the distances.
    Warns DarkPlaces of points without light, whose kernels are 0. Raises ValueError for numbers of patches, points and
    distances that differ, and for points that are not finite.
    """
    patches = as_picture(patches)
    if patches.dim() != 4 or points.shape != (2, len(patches)):
        raise ValueError(
            f"patches of shape {tuple(patches.shape)} at points of shape {tuple(points.shape)}: expected (B, C, H, W) "
            "and (2, B) mm"
        )
    kernels = patch_kernels(
        lens, points, sensor=sensor, size=size, order=order, elements=elements, model=model,
        object_distances=object_distances, lateral_colour=lateral_colour, illumination=illumination,
    )  # fmt: skip
    return blur(patches, kernels.to(patches))


def patch_kernels(
    lens: Lens,
    points: Tensor,
    *,
    sensor: Sensor,
    size: int,
    order: int,
    elements: Element | Sequence[Element] = (),
    model: str | None = None,
    object_distances: Tensor | None = None,
    lateral_colour: bool = True,
    illumination: bool = False,
) -> Tensor:
    """Kernels (B, C, size, size) of the channels at points (2, B) mm; arguments as for `render_patches`."""
    check_points(points, points.shape[-1])
    distances = like = lens.surfaces[0].thickness
    if object_distances is not None:
        distances = torch.as_tensor(object_distances, dtype=like.dtype, device=like.device)
        _check_distances(distances, points.shape[1])
        lens = by_angle(lens)
    distances = distances.reshape(-1).expand(points.shape[1])
    weights = sensor.weights(lens.wavelengths, lens.wavelength_weights).to(distances)
    elements = in_contact(elements)
    model = model or ("wave" if elements else "gaussian")
    of_places = field_kernels(lens, sensor, model, order, size, distances, weights, lateral_colour, elements)
    kernels = of_places.paired(points)
    warn_of_dark_places(kernels, points)
    return illumination_at(lens, sensor, points)[:, None, None, None] * kernels if illumination else kernels


def _check_distances(distances: Tensor, count: int) -> None:
    if distances.numel() != 1 and distances.shape != (count,):
        raise ValueError(
            f"object_distances of shape {tuple(distances.shape)} of {count} patches: expected one distance in mm, or "
            f"({count},), one of each patch"
        )
    if bool(distances.isnan().any()) or bool((distances == 0).any()):
        raise ValueError("object_distances with nan or 0: expected distances in mm from surface 1; inf is allowed")


def plane_distances(depth: Tensor, planes: int) -> Tensor:
    """Reciprocal distances (D,) 1/mm of at most so many layers of a depth map."""
    inverse = 1 / depth
    known = inverse[torch.isfinite(inverse) & (inverse >= 0)]
    if not len(known) or planes < 1:
        raise ValueError("a depth map without distances above 0, or no planes: expected distances in mm from surface 1")
    levels = known.unique()
    ends = float(levels[0]), float(levels[-1])
    return levels if len(levels) <= planes else torch.linspace(*ends, planes, dtype=depth.dtype, device=depth.device)


def default_sensor(
    lens: Lens,
    picture: Tensor,
    *,
    size: tuple[float, float] | None = None,
    offset: tuple[float, float] = (0, 0),
    **others: Any,
) -> Sensor:
    """A sensor for pictures (..., C, H, W), by default so large that the largest field of the lens lies in its corners.

    size, offset, others: parameters of `Sensor`; response: by default none for one channel, "rgb" for three.
    """
    rows, columns = picture.shape[-2:]
    others = {"response": {1: None, 3: "rgb"}.get(picture.shape[-3]), **others}
    if size is not None:
        return Sensor(size=size, pixels=(columns, rows), offset=offset, **others)
    reach = _image_height(lens, Sensor(size=(1.0, rows / columns), pixels=(columns, rows)))
    if not reach:
        raise ValueError(f"all fields are on the axis and give the sensor no size: give {option('sensor')}")
    pitch = 2 * reach / math.hypot(columns, rows)
    return Sensor(size=(columns * pitch, rows * pitch), pixels=(columns, rows), offset=offset, **others)


@dataclasses.dataclass(frozen=True, repr=False)
class Rendering(Result):
    """image: (..., C, H, W), noise-free irradiance; 1 = white on the axis with an ideal lens of the same aperture.

    picture: the same of the ideal lens; optics: the lens and its sensor, for more pictures: `optics(picture)`.
    `save` writes .png, .tif and .npy of a single image.
    """

    image: Tensor
    picture: Tensor
    lens: Lens
    optics: ImageFormation

    def with_picture(
        self,
        picture: Tensor,
        depth: Tensor | None = None,
        **options: Any,
    ) -> Self:
        """The rendering of another picture of the same size by the same optics.

        options: background, softness, boundary, progress, as for `render`.
        """
        ready = self.optics
        light = checked_picture(linearised(picture), ready.sensor, ready.sampling)
        image = ready(light, depth, **options)
        return dataclasses.replace(self, image=image, picture=binned(light, ready.sampling))

    def raw(self, index: Tensor | Sequence[int] | None = None, seed: int = 0) -> Self:
        """The rendering with the noise, the quantisation and the Bayer mosaic (..., 1, H, W) of the sensor.

        index, seed: of the noise, see `Sensor.capture`.
        """
        return dataclasses.replace(self, image=self.optics.sensor.capture(self.image, index, seed))

    def demosaiced(self, index: Tensor | Sequence[int] | None = None, seed: int = 0) -> Self:
        """The rendering as `raw`, with the missing colours of the mosaic interpolated (..., C, H, W)."""
        raw = self.raw(index, seed)
        return dataclasses.replace(raw, image=self.optics.sensor.demosaic(raw.image))

    another = former_name("another", "with_picture")
    recorded = former_name("recorded", "raw")
    captured = former_name("captured", "demosaiced")

    def save(self, path: str | PathLike, bits: int = 8) -> None:
        """Write a single image of one or three channels.

        .png: sRGB levels of 8 or 16 bits; .tif: light, 32-bit floating-point numbers; .npy: light (C, H, W), an array;
        .json as other results.
        """
        path = Path(path)
        suffix = path.suffix.lower()
        if suffix not in (".png", ".tif", ".npy"):
            return super().save(path)
        image = self.image.detach()
        if image[..., 0, 0].numel() not in (1, 3):
            raise ValueError(f"{path}: an image of shape {tuple(image.shape)}; expected one, of one or three channels")
        image = image.reshape(-1, *image.shape[-2:])
        if suffix == ".png":
            write_picture(path, array(encoded(image)), bits)
        else:
            write_light(path, array(image))

    def text(self) -> list[str]:
        ready = self.optics
        columns, rows = ready.sensor.pixels
        m, n, depths = ready.kernels.shape[:3]
        names, count = ", ".join(ready.sensor.channels), len(ready.wavelengths)
        if count == 1 and len(ready.sensor.channels) > 1:
            names = f"all channels at the single wavelength of the lens, {float(ready.wavelengths[0]):.4g} µm"
        lines = [
            f"{columns} × {rows} pixels of {1e3 * ready.sensor.pitch:.4g} µm, {names}",
            f"kernels of {ready.kernels.shape[-1]} × {ready.kernels.shape[-2]} pixels at {m} × {n} field positions"
            + (f" and {depths} depths" if depths > 1 else "")
            + (
                f", {ready.sampling} × {ready.sampling} of these in a pixel of the sensor" if ready.sampling > 1 else ""
            ),
            f"PSF model {ready.model}, {count} wavelength{'s' * (count > 1)}; neglected: {_NEGLECTED[ready.model]}"
            + (f" ({ready.reason})" if ready.reason else ""),
        ]
        if math.isfinite(ready.error):
            lines.append(f"estimated interpolation error between field positions {ready.error:.1e}, Σ|Δh|")
        if ready.haze is not None:
            outside = 100 * float(ready.haze.detach().max())
            lines.append(f"energy outside the PSF window, added as a uniform background: at most {outside:.1f} %")
        if ready.lit is not None:
            dark = 100 * (1 - float(ready.lit.double().mean()))
            lines.append(f"{dark:.1f} % of the sensor is outside the image circle, black")
        if (darkest := self._darkest()) is not None:
            lines.append(f"minimum relative illumination{self._inside()} {100 * darkest:.1f} %")
        if ready.ideal is not None and max(ready.ideal.shape[-2:]) > 1:
            last, first = self._ends(ready.ideal)
            (column, row), ideal = last - first, ready.ideal[:, last[1], last[0]] - ready.ideal[:, first[1], first[0]]
            longer = math.hypot(column, row) / math.hypot(*ideal.tolist()) - 1
            lines.append(f"distortion of the diagonal{self._inside()} {100 * longer:+.2f} %")
        return lines

    def _inside(self) -> str:
        return "" if self.optics.lit is None else " inside the image circle"

    def _darkest(self) -> float | None:
        """Relative illumination of the darkest pixel in the image circle; None if it is ignored or all is dark."""
        ready = self.optics
        if ready.illumination is None or (ready.lit is not None and not bool(ready.lit.any())):
            return None
        return float((ready.illumination if ready.lit is None else ready.illumination[ready.lit]).detach().min())

    def _ends(self, ideal: Tensor) -> np.ndarray:
        """Column and row (2, 2) of the last and the first pixel on the diagonal that light reaches."""
        rows, columns = ideal.shape[-2:]
        steps = np.linspace(0, 1, max(rows, columns))
        places = np.stack([(columns - 1) * steps, (rows - 1) * steps], 1).round().astype(int)
        lit = None if self.optics.lit is None else array(self.optics.lit)[places[:, 1], places[:, 0]]
        places = places if lit is None or lit.sum() < 2 else places[lit]
        return places[[-1, 0]]

    def __str__(self) -> str:
        return "\n".join(self.text())

    def document(self) -> dict:
        ready = self.optics
        return {
            "lens": self.lens.name,
            "sensor": {"size": list(ready.sensor.size), "pixels": list(ready.sensor.pixels)},
            "kernels": list(ready.kernels.shape),
            "model": ready.model,
            "wavelengths": ready.wavelengths.tolist(),
            "error": plain(ready.error),
            "darkest": self._darkest(),
        }

    @styled
    def draw(self) -> Figure:
        """The ideal lens's picture and the image, both in detail at the centre and at the upper left corner, and the
        kernels there, of several depths the farthest; brightness is encoded as sRGB."""
        ideal, image = (_shown(picture) for picture in (self.picture, self.image))
        ready = self.optics
        rows, columns = image.shape[:2]
        size = max(min(rows, columns) // 8, min(64, (min(rows, columns) + 2) // 3))
        kernels = ready.kernels[:, :, 0]
        m, n = kernels.shape[:2]
        middle = kernels[(m - 1) // 2 : m // 2 + 1, (n - 1) // 2 : n // 2 + 1].mean((0, 1))
        window = f"{kernels.shape[-1]} × {kernels.shape[-2]} pixels"
        details = {
            "centre": ((rows - size) // 2, (columns - size) // 2, middle, FIELD_COLOURS[2]),
            "corner": (0, 0, kernels[0, 0], FIELD_COLOURS[0]),
        }
        heights = 5.0 * rows / columns + 0.3, 2.0
        figure = new_figure(10.0, sum(heights) + 0.3)
        width, height = ready.sensor.size
        figure.suptitle(
            f"{self.lens.name}   {width:.4g} × {height:.4g} mm, {columns} × {rows} pixels of "
            f"{1e3 * ready.sensor.pitch:.4g} µm", fontsize=9,
        )  # fmt: skip
        whole, close = cast(np.ndarray, figure.subfigures(2, 1, height_ratios=heights))
        pictures = {"ideal lens": ideal, "this lens": image}
        for panel, (title, picture) in zip(whole.subplots(1, 2), pictures.items(), strict=True):
            panel.imshow(picture, vmin=0, vmax=1, cmap="gray")
            panel.set_title(title)
            panel.axis("off")
            for row, column, _, colour in details.values():
                right, below = (
                    column - 0.5 + np.array([0, size, size, 0, 0]),
                    row - 0.5 + np.array([0, 0, size, size, 0]),
                )
                panel.plot(right, below, color=colour, linewidth=1.2, scalex=False, scaley=False, clip_on=False)
        panels = iter(close.subplots(1, 6))
        for place, (row, column, kernel, colour) in details.items():
            detail = slice(row, row + size), slice(column, column + size)
            shown = {f"{place}, {title}": picture[detail] for title, picture in pictures.items()}
            shown[f"kernel, {window}"] = _shown(kernel / kernel.amax())
            for title, part in shown.items():
                panel = next(panels)
                panel.imshow(part, vmin=0, vmax=1, cmap="gray", interpolation="nearest")
                panel.set_title(title)
                panel.set_xticks([])
                panel.set_yticks([])
                for spine in panel.spines.values():
                    spine.set(visible=True, color=colour, linewidth=1.2)
        return figure


def _shown(light: Tensor) -> np.ndarray:
    """Levels (H, W) or (H, W, 3) of the first of pictures (..., C, H, W), of two channels the first one."""
    first = encoded(light.detach().reshape(-1, *light.shape[-3:])[0])
    return array(first[0] if len(first) < 3 else first[:3].movedim(0, -1))

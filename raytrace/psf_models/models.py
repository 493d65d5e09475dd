"""The public call `psf`, the table of the PSF models, and the choice of the order of a model for a tolerance.

Each model gives `kernels(scene, grid, order=…) -> Kernels`, a pure function: energy integrated over pixels, 1 = all
light through the entrance pupil. Its orders form a sequence of growing accuracy. `by_tolerance` raises the order until
the estimated error meets a tolerance; `climb` does so over models (`model="auto"`).
"""

import contextlib
import dataclasses
import functools
import itertools
import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.budget import OverBudget, afford, within
from raytrace.maths.numerics import safe_divide, safe_sqrt, varies
from raytrace.maths.sampling import Grid, gauss_rings, sobol
from raytrace.maths.sampling import grid as make_grid
from raytrace.psf_models import drt, fourier, gaussian, paraxial, wave
from raytrace.psf_models.dft import TooManyPoints
from raytrace.psf_models.result import (
    DRT,
    EmptyPsf,
    Fourier,
    Gaussian,
    Kernels,
    Parameters,
    Paraxial,
    Psf,
    Wave,
    combined,
    mixture,
    polychromatic,
    without_dark,
)
from raytrace.shards import Share, agreeing, gathered, total
from raytrace.system.lens import Lens, field_points, one_lens, with_object_distance
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.ray_failures import beam_hint, ray_failures, warn_of_failures
from raytrace.tracing.scene import Memo, Scene, chief_landing, scene, symmetry
from raytrace.words import RaytraceWarning, calling_level, did_you_mean, option

PIXEL, SIZE = 0.005, 21  # mm; a window of 105 µm
_PIXEL_BYTES = 16  # of a kernel and of the one that is added to it


@dataclasses.dataclass(frozen=True)
class Execution:
    """How `psf` computes, without effect on the numbers.

    memo: rays of earlier calls, reused where nothing before them has changed.
    share: of this process (`shards.share()`), if all processes call alike; each gets all kernels, without gradient.
    max_bytes: memory limit; independent rays are traced in chunks, in any number, without gradient; progress: (count,
        unit) -> a progress bar, see `cli.progress`.
    empty: value of a PSF that no ray reaches: "nan", kernel 0 and moments nan, all with gradient 0, or "error".
    """

    memo: Memo | None = None
    share: Share | None = None
    max_bytes: float | None = None
    progress: Callable[[int, str], contextlib.AbstractContextManager[Any]] | None = None
    empty: str = "nan"


@dataclasses.dataclass(frozen=True)
class Model:
    """A PSF model and its sequence of orders.

    name: as `psf` takes it; title: for tables and figures.
    kernels: (scene, grid, order=…) -> Kernels; orders: from the coarsest to the finest.
    parameters: the class of its numbers, as `psf` takes them; those other than order and rays are keywords of
        `kernels`.
    lean: `kernels` without the residual, where that costs time.
    plain: (scene, grid, rays=…) -> Kernels of independent rays; None for models without them.
    of_points: (scene, grid, points) -> Kernels of the rays through pupil points (2, P); None for models without them.
    traces: whether it traces rays, with derivatives in all numbers of the lens; otherwise it uses first-order data
        alone and images a field without distortion.
    waves: whether it includes diffraction: moments are those inside the window.
    is_automatic: whether `model="auto"` tries it.
    row, compared: its row in `compare`, and the arguments of `psf` used there.
    by_field: whether decisions are made for each field alone: processes then share out whole fields.
    by_pair: whether they are made for each pair of an object distance and a field: processes share out whole pairs.
    in_common: whether all kernels of a call have the sampling of the widest and of the least symmetric of them: it is
        called for each lens and object distance, and by cameras for each kernel, which so depend on no others.

    The error of an order is extrapolated from its changes (`by_tolerance`), unless `proof` is set:
    by_width: whether the error is that of σ, instead of the kernel.
    proof: the error of an order is this multiple of its difference from the next, which is computed.
    first: ratio of successive changes assumed while only one change is known; None: two are needed.
    least, most: bounds on the ratios measured after that; margin: factor on the estimate.
    unseen: share of `Kernels.residual` added to the error, which two orders may have in common.
    floor: smallest error, by rounding. The constants cover 95 % of the cases that docs/psf_error.md calls fitted.
    """

    name: str
    title: str
    kernels: Callable[..., Kernels]
    orders: Sequence[int]
    parameters: type[Parameters]
    lean: Callable[..., Kernels] | None = None
    plain: Callable[..., Kernels] | None = None
    of_points: Callable[[Scene, Grid, Tensor], Kernels] | None = None
    traces: bool = True
    waves: bool = False
    is_automatic: bool = False
    row: int = 0
    compared: Mapping = dataclasses.field(default_factory=dict)
    by_field: bool = False
    by_pair: bool = False
    in_common: bool = False
    by_width: bool = False
    proof: float | None = None
    first: float | None = None
    least: float = 0.0
    most: float = 0.0
    margin: float = 1.0
    unseen: float = 0.0
    floor: float = 0.0


# fourier and wave use the same sums; torch's J₀ is accurate to 3e-7 only.
_wave_model = functools.partial(Model, waves=True, first=0.23, least=1e-3, most=0.5, floor=1e-7, compared={"tol": 1e-3})

# fmt: off
_ROWS = (
    # First-order data: a Gaussian of the defocus blur.
    Model("paraxial", "paraxial", paraxial.kernels, (0,), Paraxial, traces=False, is_automatic=True, row=2),
    # The same with diffraction: a defocused (and aberrated) circular pupil.
    _wave_model("fourier", "Fourier", fourier.kernels, range(-2, 6), Fourier, traces=False, row=3),
    # Centroid and covariance of traced rays. Gauss rings converge irregularly: the change of one order does not predict
    # that of the next, so the error is proven.
    Model(
        "gaussian", "Gaussian DRT", gaussian.kernels, (2, 3, 4, 5, 6, 8, 10, 12, 16, 24), Gaussian,
        lean=gaussian.kernels_alone, of_points=gaussian.kernels_of_points, is_automatic=True, row=1,
        compared={"tol": 1e-3}, by_pair=True, by_width=True, proof=2.0, least=1e-4, most=0.6, margin=2.0, floor=1e-11,
    ),
    # All traced rays: geometric optics. Each order halves the error; an accidentally small change is not believed. The
    # table of rings for rotationally symmetric light (radial.py) is accurate to 1e-5.
    Model(
        "drt", "DRT", drt.kernels, range(11), DRT, plain=drt.kernels_of_rays, of_points=drt.kernels_of_points,
        is_automatic=True, row=0, in_common=True, compared={"model": DRT(rays=256)},
        first=0.6, least=0.6, most=0.6, unseen=0.15, floor=1e-5,
    ),
    # The traced wavefront: diffraction with the true aberrations.
    _wave_model("wave", "wave", wave.kernels, range(-2, 6), Wave, is_automatic=True, by_field=True, row=4),
)
# fmt: on

#: Names of the diffraction PSF in other programs.
_DIFFRACTION = ("huygens", "fft")

#: The models by name, in order of growing fidelity.
MODELS = {row.name: row for row in _ROWS}


def is_sampled_in_common(lens: Lens, model: str) -> bool:
    """Whether the sampling of a kernel depends on the others of a call: of DRT, of waves that apertures may clip."""
    row = MODELS[model]
    return row.in_common or (row.by_field and any(surface.apertures for surface in lens.surfaces))


class NotConverged(RaytraceWarning):
    """A PSF whose estimated error stays above the tolerance at the finest order."""


def model_name(name: str, *others: str) -> str:
    """The name of a model in MODELS, or one of the `others`, from a name in any case. Raises ValueError."""
    known, word = (*others, *MODELS), name.lower()
    if word not in known:
        meant = "; the diffraction PSF is wave" if word in _DIFFRACTION else did_you_mean(name, known)
        raise ValueError(f"model {name!r} is not known; expected {', '.join(known)}{meant}")
    return word


def model_of(name: str, **numbers: Any) -> Parameters:
    """A model with its numbers, by its name. Raises ValueError for an unknown name or number."""
    if name == "auto":
        given = ", ".join(numbers)
        raise ValueError(f"auto chooses by a tolerance: leave {given} out, or name the model that has {given}")
    name = model_name(name)
    if "rays" in numbers and not MODELS[name].traces:
        raise ValueError(f"{name} traces no rays: leave rays out")
    known = {field.name for field in dataclasses.fields(MODELS[name].parameters)}
    if unknown := ", ".join(sorted(numbers.keys() - known)):
        raise ValueError(f"{unknown}: no number of the model {name}; leave it out")
    return MODELS[name].parameters(**numbers)


def name_of(parameters: Paraxial | Fourier | Gaussian | DRT | Wave) -> str:
    """The name of a model that is given with its numbers."""
    return next(name for name, model in MODELS.items() if isinstance(parameters, model.parameters))


def psf(
    lens: Lens,
    model: str | Parameters = "auto",
    *,
    fields: Tensor | Sequence | None = None,
    object_distances: Tensor | Sequence[float] | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    wavelength_weights: Tensor | Sequence[float] | None = None,
    pixel: float | None = None,
    size: int | tuple[int, int] | None = None,
    grid: Grid | None = None,
    center: Literal["axis", "chief", "centroid"] | None = None,
    window: str = "follows",
    tol: float | None = None,
    normalise: Literal["energy", "window"] = "energy",
    per_wavelength: bool = False,
    execution: Execution | None = None,
) -> Psf:
    """PSFs of a lens, differentiable in every number of the lens, its sensor distance and the grid.

    Derivatives include the motion of the window. Two edges have no derivative: the rim of a beam where rays miss a
    surface or are totally reflected, in all models; and every aperture for independent rays (`DRT(rays=…)`),
    because a vignetted ray drops out abruptly.

    model: "auto", "paraxial", "fourier", "gaussian", "drt" or "wave", or a model with its numbers, as `DRT(rays=2000)`:
        rays: instead of a tolerance, about that many rays per kernel, the error estimated from half of them; order:
        instead, an order of the model, as in `Psf.order` of an earlier call: for loops; nothing is estimated.
    fields: y, pairs (x, y) or (2, F) in the lens's kind of field, or (2, D, F), others for each object distance;
        object_distances: (D,) mm, inf allowed; wavelengths: (W,) µm with wavelength_weights: (W,); by default those of
        the lens. Kernels are summed over the wavelengths; per_wavelength: each wavelength has a kernel, (D, F, W, rows,
        columns), of energy 1 for all its light.
    pixel, size: pitch in mm, 0.005 by default, and number, one or (rows, columns), 21 by default; grid: instead, pixels
        whose centre is (2,) or (2, D, F).
    center: origin of the grid's centre: "axis", "chief" (the chief ray at the primary wavelength) or "centroid" (of the
        rays). By default "chief"; "axis" for a `grid` and fields.
    window: "follows": a window about the chief ray or the centroid moves with it, in the derivatives too, so that a
        shift of the whole image changes no kernel. "fixed": the window has no derivative: the pixels of a sensor that
        does not move. The kernels are the same.
    tol: bound on the estimated error, 0.01 by default; the coarsest order that meets it is returned.
    normalise: "energy" (1 = all light through the entrance pupil) or "window" (each kernel sums to 1).
    Of a batch of L lenses, at one object distance, the first axis of the result counts the lenses instead. Without an
    order, that of each object distance or lens is chosen alone, and so is the model of "auto", and at any order the
    cells of "drt": its PSFs are those of a call for it alone. `model` and `order` of the result are then the finest of
    them.
    execution: memory, processes and progress, see `Execution`.

    Raises ValueError for invalid arguments, EmptyPsf if no ray at all reaches the sensor. Warns NotConverged and,
    outside of loops (without an order or a memo), UnfilledStop.
    """
    execution = execution or Execution()
    center = center or ("chief" if fields is None or grid is None else "axis")
    name = model_name(model, "auto") if isinstance(model, str) else name_of(model)
    for parameter, (word, words) in {
        "center": (center, ("axis", "chief", "centroid")),
        "window": (window, ("follows", "fixed")),
        "normalise": (normalise, ("energy", "window")),
        "empty": (execution.empty, ("nan", "error")),
    }.items():
        if word not in words:
            raise ValueError(f"{parameter} {word!r} is not known; expected {', '.join(words)}")
    parameters: Parameters | None = None  # of "auto"
    if name != "auto":
        parameters = MODELS[name].parameters() if isinstance(model, str) else model
    order, rays = (getattr(parameters, number, None) for number in ("order", "rays"))
    points = rays if isinstance(rays, Tensor) else None
    for wrong, message in (
        (tol is not None and rays is not None, "tol and rays exclude each other: tol chooses the number of rays"),
        (
            order is not None and (tol, rays) != (None, None),
            "an order fixes the amount of work: it excludes tol and rays",
        ),
        (tol is not None and not tol > 0, f"tol {tol}: expected a number above 0"),
        (
            rays is not None and points is None and (rays < 1 or rays % 1),
            f"rays {rays}: expected a whole number above 0",
        ),
        (
            points is not None and (points.dim() != 2 or len(points) != 2 or not points.numel()),
            f"rays of shape {tuple(getattr(rays, 'shape', ()))}: expected pupil points (2, P), or their number",
        ),
        (points is not None and MODELS[name].of_points is None, f"{name} takes a number of rays, not pupil points"),
        (grid is not None and (pixel, size) != (None, None), "a grid has a pixel and a size: leave these out"),
        (pixel is not None and not pixel > 0, f"pixel {pixel}: expected a number above 0"),
    ):
        if wrong:
            raise ValueError(message)
    like = lens.wavelengths

    def row(numbers: Tensor | Sequence[float]) -> Tensor:
        return numbers if isinstance(numbers, Tensor) else like.new_tensor(numbers)

    base = make_grid(like.new_tensor(pixel or PIXEL), size or SIZE) if grid is None else grid
    fields = fields if isinstance(fields, Tensor) else field_points(fields, like=lens)
    distances = lens.surfaces[0].thickness.reshape(-1) if object_distances is None else row(object_distances)
    if (lenses := lens.count) is not None:
        if len(distances) not in (1, lenses):
            raise ValueError(f"{len(distances)} object_distances for a batch of {lenses} lenses; expected one")
        distances = distances.expand(lenses)
    weights = lens.wavelength_weights if wavelengths is None and wavelength_weights is None else wavelength_weights
    wavelengths = like if wavelengths is None else row(wavelengths)
    weights = torch.ones_like(wavelengths) if weights is None else row(weights)
    for parameter, values in (("object_distances", distances), ("wavelengths", wavelengths)):
        if values.dim() != 1 or not len(values):
            raise ValueError(f"{parameter} of shape {tuple(values.shape)}; expected one axis")
        if bool(values.isnan().any()) or bool((values == 0).any()):
            others = f"expected numbers other than 0 and nan; give others by {option(parameter)}"
            raise ValueError(f"{parameter} {values.tolist()}; {others}")
    D = len(distances)
    if fields.dim() not in (2, 3) or fields.shape[:-1] != (2, D)[: fields.dim() - 1] or not fields.numel():
        raise ValueError(f"fields of shape {tuple(fields.shape)}; expected (2, F), or (2, {D}, F)")
    if weights.shape != wavelengths.shape:
        raise ValueError(f"{weights.numel()} wavelength_weights for {len(wavelengths)} wavelengths")
    if bool((weights < 0).any()) or not bool(weights.sum() > 0):
        raise ValueError(f"wavelength_weights {weights.tolist()} are below 0 or sum to 0")
    F, W = fields.shape[-1], len(wavelengths) if per_wavelength else 1
    rows, columns = base.shape
    afford(
        _PIXEL_BYTES * D * F * W * rows * columns,
        f"{D * F * W:,} PSFs of {rows:,} × {columns:,} pixels",
        helps="ask for a smaller {size}, or fewer {fields} at once",
    )
    if order is None and execution.memo is None:
        warn_of_filling(with_object_distance(lens, distances.min()), fields.flatten(1))
    shares = weights / weights.sum()

    def compute(chosen: Tensor) -> Psf:
        centre = base.centre[:, chosen] if base.centre.dim() > 1 and base.centre.shape[1] > 1 else base.centre
        part = lens if lenses in (None, len(chosen)) else one_lens(lens, chosen)
        drive = _driver(part, name, parameters, tol or 0.01, execution)
        with torch.enable_grad():  # fields that vary break symmetry, without derivatives too
            places = fields if fields.dim() == 2 else fields[:, chosen]
        batch = scene(part, places, distances[chosen], wavelengths, execution.memo)
        origin = None  # of the grids on the sensor, (2, D, F) mm, with its derivatives; None for the axis
        if center == "axis" or symmetry(batch) == "round":
            pass
        elif center == "centroid":
            alone = gaussian.kernels_alone(batch, make_grid(batch.wavelengths.new_tensor(1.0), 1), order=6)
            origin = polychromatic(alone, batch, shares, "").centroid
        else:
            origin = chief_landing(dataclasses.replace(batch, wavelengths=part.primary[None]))[..., 0]
        if origin is not None and window == "fixed":
            origin = origin.detach()
        if origin is not None or centre.dim() > 1:  # a single point stays a single point
            centre = centre if centre.dim() > 1 else centre.reshape(2, 1, 1)
            centre = centre if origin is None else centre + origin
            centre = centre[..., None].expand(*centre.shape, len(wavelengths))
        return drive(batch, dataclasses.replace(base, centre=centre), None if per_wavelength else shares)

    # A choice is made for each object distance, or lens, alone: no PSF depends on its neighbours. A fixed amount of
    # work is done together, for finite distances and infinite ones apart.
    infinite, numbers = torch.isinf(distances), torch.arange(len(distances), device=distances.device)
    is_fixed = points is not None or (rays is not None and MODELS[name].plain is not None)
    is_fixed = is_fixed or (order is not None and not MODELS[name].in_common)
    groups = [numbers[~infinite], numbers[infinite]] if is_fixed else list(numbers.split(1))
    groups = [group for group in groups if len(group)]
    with within(execution.max_bytes) if execution.max_bytes is not None else contextlib.nullcontext():
        psfs = _merged([compute(group) for group in groups], torch.cat(groups).argsort())
    trials = gauss_rings(6, dtype=fields.dtype, device=fields.device)[0]
    # Only traced light can fail to arrive; light outside the window has arrived.
    if psfs.rays and not bool((psfs.energy > 0).any()) and not bool((psfs.ray_covariance != 0).any()):
        trial = with_object_distance(lens if lenses is None else one_lens(lens, 0), distances[0].detach())
        failures = ray_failures(
            trial, trials, fields=fields.flatten(1)[:, :1].detach(), wavelengths=wavelengths[:1].detach()
        )
        reasons = "; ".join(filter(None, (failures.words(0, 0), beam_hint(trial))))
        raise EmptyPsf(f"no ray reaches the sensor: {reasons}")
    if normalise == "window":
        # Over the brightest pixel first: in a nearly dark window the square of the sum would underflow in derivatives.
        scaled = safe_divide(psfs.kernel, psfs.kernel.detach().amax((-2, -1), keepdim=True))
        kernel = safe_divide(scaled, scaled.sum((-2, -1), keepdim=True))
        psfs = dataclasses.replace(psfs, kernel=kernel, normalised="window")
    psfs = without_dark(psfs, execution.empty)
    dark = psfs.ray_centroid[0].detach().isnan()
    if bool(dark.any()):  # warn LostRays of every field with a wavelength of which no ray reaches the sensor
        dark = dark if dark.dim() > 2 else dark[..., None].expand(*dark.shape, len(wavelengths))
        for number, (distance, failed) in enumerate(zip(distances.detach(), dark, strict=True)):
            where = f"object at {float(distance):g} mm, " if lenses is None else f"lens {number}, "
            prefix = where if len(distances) > 1 else ""
            trial = with_object_distance(lens if lenses is None else one_lens(lens, number), distance)
            places = (fields if fields.dim() == 2 else fields[:, number]).detach()
            warn_of_failures(trial, trials, failed, fields=places, wavelengths=wavelengths.detach(), prefix=prefix)
    return dataclasses.replace(
        psfs,
        lens=lens,
        fields=fields,
        object_distances=distances,
        wavelengths=wavelengths,
        wavelength_weights=shares,
        parameters=parameters or MODELS[psfs.model].parameters(),
        framed=(grid, pixel, size) != (None, None, None),
    )


def _driver(
    lens: Lens, name: str, parameters: Parameters | None, tol: float, execution: Execution
) -> Callable[..., Psf]:
    """The function (scene, grid, weights) -> Psf that the arguments of `psf` select."""
    share = execution.share if execution.share is not None and execution.share.processes > 1 else None
    if share is not None:
        check_shares(lens, parameters)

    def configured(row: Model, numbers: Parameters) -> Model:
        keywords = {field.name: getattr(numbers, field.name) for field in dataclasses.fields(numbers)}
        keywords = {key: number for key, number in keywords.items() if key not in ("order", "rays")}
        row = dataclasses.replace(row, kernels=functools.partial(row.kernels, **keywords)) if keywords else row
        if share is None:
            return row
        deal = functools.partial(shared, share=share, by_field=row.by_field, by_pair=row.by_pair)
        plain = row.plain and functools.partial(plain_rays_shared, row.plain, share)
        return dataclasses.replace(row, kernels=deal(row.kernels), lean=row.lean and deal(row.lean), plain=plain)

    if parameters is None:
        candidates = [row for row in _ROWS if row.is_automatic and (row.traces or paraxial.has_one_focus(lens))]
        return functools.partial(climb, candidates=[configured(row, row.parameters()) for row in candidates], tol=tol)
    model = configured(MODELS[name], parameters)
    if parameters.order is not None:
        return functools.partial(by_order, model=model, order=parameters.order)
    rays, max_bytes = getattr(parameters, "rays", None), execution.max_bytes
    if rays is None:
        return functools.partial(by_tolerance, model=model, tol=tol)
    if isinstance(rays, Tensor):
        return functools.partial(by_points, model=model, points=rays)
    if max_bytes is None or model.plain is None:
        return functools.partial(by_rays, model=model, count=int(rays))

    def stream(batch: Scene, pixels: Grid, weights: Tensor | None) -> Psf:
        bars = execution.progress
        with bars(int(rays) * math.prod(batch.shape), "ray") if bars else contextlib.nullcontext() as bar:
            update = bar and bar.update
            whole, half = drt.stream_kernels(batch, pixels, int(rays), max_bytes=max_bytes, progress=update)
        return _of_halves(whole, half, batch, weights, MODELS[name])

    return stream


def _merged(parts: Sequence[Psf], order: Tensor) -> Psf:
    """One PSF of those of several object distances or lenses, in this order; of the finest model among them.

    `order` is the finest of that model's, for loops; a residual that a model does not have is nan.
    """
    if len(parts) == 1:
        return parts[0]
    model = max((part.model for part in parts), key=list(MODELS).index)
    finest = max((part for part in parts if part.model == model), key=lambda part: part.order or 0)
    if any(part.residual is not None for part in parts):
        known = (torch.full_like(part.error, torch.nan) if part.residual is None else part.residual for part in parts)
        parts = [dataclasses.replace(part, residual=residual) for part, residual in zip(parts, known, strict=True)]
    merged = combined(parts, lambda tensors, axis: torch.cat(tensors, axis).index_select(axis, order))
    centre = finest.grid.centre
    if centre.dim() > 1:
        centre = torch.cat([part.grid.centre for part in parts], 1).index_select(1, order)
    reason = "; ".join(dict.fromkeys(part.reason for part in parts if part.reason))
    return dataclasses.replace(
        merged,
        grid=dataclasses.replace(finest.grid, centre=centre),
        model=model,
        waves=finest.waves,
        order=finest.order,
        reason=reason,
    )


def by_order(batch: Scene, pixels: Grid, weights: Tensor | None, model: Model, order: int) -> Psf:
    """The kernels of one order, without error estimate and residual: for loops."""
    if order not in model.orders:
        orders = ", ".join(map(str, model.orders))
        raise ValueError(f"{model.name} has no order {order}; expected one of {orders}")
    return _at(order, model.lean or model.kernels, batch, pixels, weights, model)


def _at(
    order: int, kernels: Callable[..., Kernels], batch: Scene, pixels: Grid, weights: Tensor | None, model: Model
) -> Psf:
    psfs = polychromatic(kernels(batch, pixels, order=order), batch, weights, model.name)
    return dataclasses.replace(psfs, order=order)


def by_tolerance(batch: Scene, pixels: Grid, weights: Tensor | None, model: Model, tol: float) -> Psf:
    """Raise the order until the estimated error meets the tolerance; see `_estimate`. Warns NotConverged."""
    with torch.no_grad():
        before: Psf | None = None
        changes: list[Tensor] = []
        for order in model.orders:
            psfs = _at(order, model.kernels, batch, pixels, weights, model)
            if before is not None:
                changes.append(_change(before, psfs, model))
            rounding = _rounding(batch, pixels, psfs, model)
            if model.proof is not None and before is not None:
                error = model.proof * changes[-1] + rounding
                if bool((error <= tol).all()):
                    psfs = before
                    break
            error = _estimate(model, changes, psfs, rounding)
            if model.proof is None and bool((error <= tol).all()):
                break
            before = psfs
    reason = ""
    if not bool((error <= tol).all()):
        reason = f"{model.name}: the estimated error {float(error.max()):.1e} stays above the tolerance {tol:g}"
        warnings.warn(reason, NotConverged, stacklevel=calling_level())
    residual, chosen = psfs.residual, psfs.order
    # Derivatives by any number of the scene, the pixels or the model.
    numbers = pytree.tree_leaves((batch, pixels, weights, getattr(model.kernels, "keywords", {})))
    if chosen is not None and torch.is_grad_enabled() and any(varies(number) for number in numbers):
        psfs = by_order(batch, pixels, weights, model, chosen)
    return dataclasses.replace(psfs, error=error, residual=residual, reason=reason)


def by_points(batch: Scene, pixels: Grid, weights: Tensor | None, model: Model, points: Tensor) -> Psf:
    """The kernels of the rays through pupil points (2, P), without error estimate."""
    if model.of_points is None:
        raise ValueError(f"{model.name} takes a number of rays, not pupil points")
    return polychromatic(model.of_points(batch, pixels, points.to(batch.fields)), batch, weights, model.name)


def by_rays(batch: Scene, pixels: Grid, weights: Tensor | None, model: Model, count: int) -> Psf:
    """About `count` rays per kernel; the error is the change from half as many."""
    if model.plain is not None:
        whole, half = (model.plain(batch, pixels, rays=n) for n in (count, max(count // 2, 1)))
        return _of_halves(whole, half, batch, weights, model)
    before: Psf | None = None
    coarser: Psf | None = None
    for order in model.orders:
        psfs = _at(order, model.kernels, batch, pixels, weights, model)
        if psfs.rays > count:
            break
        before, coarser = psfs, before
    if before is None:
        raise ValueError(f"{model.name} needs at least {psfs.rays} rays a kernel; {count} requested")
    return before if coarser is None else dataclasses.replace(before, error=_change(coarser, before, model).detach())


def _of_halves(whole: Kernels, half: Kernels, batch: Scene, weights: Tensor | None, model: Model) -> Psf:
    """The PSF of independent rays; its error is the change from half as many."""
    psfs, coarser = (polychromatic(kernels, batch, weights, model.name) for kernels in (whole, half))
    return dataclasses.replace(psfs, error=_kernel_change(coarser, psfs).detach())


def climb(batch: Scene, pixels: Grid, weights: Tensor | None, candidates: Sequence[Model], tol: float) -> Psf:
    """The first model whose kernels differ from those of the next by less than the tolerance.

    Where diffraction would need too many samples, the geometric model is returned with a NotConverged warning.
    """
    here = by_tolerance(batch, pixels, weights, candidates[0], tol)
    for model in candidates[1:]:
        try:
            above = by_tolerance(batch, pixels, weights, model, tol)
        except (TooManyPoints, OverBudget) as error:
            if not model.waves:
                raise
            reason = f"{here.model}: not compared with waves: {error}"
            warnings.warn(reason, NotConverged, stacklevel=calling_level())
            return dataclasses.replace(here, reason=reason)
        with torch.no_grad():
            gap = float(_kernel_change(above, here).max())
            # Where a pixel and its blur are both narrower than two Airy discs, agreement of ray models proves nothing.
            airy = 1.22e-3 * batch.wavelengths.max() * axial_f_number(batch.lens).max()
            blur = 2 * safe_sqrt(above.ray_covariance[0] + above.ray_covariance[2])
            is_diffracted = gap <= tol and bool((torch.maximum(blur, pixels.pitch) < 4 * airy).any())
        if gap <= tol and (model.waves or not is_diffracted):
            reason = f"{here.model}: its kernels differ from those of {model.name} by {gap:.1e}, within {tol:g}"
            return dataclasses.replace(here, reason=reason)
        here, below = above, here.model
    return dataclasses.replace(here, reason=f"{here.model}: {below} differs from it by {gap:.1e}, more than {tol:g}")


def _estimate(model: Model, changes: list[Tensor], psfs: Psf, rounding: Tensor) -> Tensor:
    """Estimated error (D, F) after changes δ_1 … δ_n between orders; inf while too few are known.

    The geometric series δ_n ρ/(1 - ρ) times a margin, ρ the largest ratio of successive changes so far, so that a
    single small change is not believed; plus the share of the residual that no change shows, and rounding.
    """
    if len(model.orders) == 1:
        return torch.zeros_like(psfs.energy)
    ratios = [safe_divide(later, earlier) for earlier, later in itertools.pairwise(changes)]
    if ratios:
        rho = torch.stack(ratios).amax(0).clamp(model.least, model.most)
    elif changes and model.first is not None:
        rho = torch.full_like(psfs.energy, model.first)
    else:
        return torch.full_like(psfs.energy, torch.inf)
    unseen = model.unseen * psfs.residual if model.unseen and psfs.residual is not None else 0.0
    return model.margin * changes[-1] * rho / (1 - rho) + unseen + rounding


def _rounding(batch: Scene, pixels: Grid, psfs: Psf, model: Model) -> Tensor:
    """Error (D, F) by rounding of directions over a focal length, in σ or pixels; inf if σ itself is rounding."""
    # Waves are summed in float64: the lens data round, which defocuses the image by ε f and so blurs it by ε f/2N.
    data = first_order(batch.lens)
    numbers = data.effective_focal_length, data.paraxial_working_f_number
    focal, f_number = (t.abs().reshape(-1)[:1] for t in numbers)
    spread = torch.finfo(psfs.kernel.dtype).eps * torch.where(torch.isfinite(focal), focal, 1.0)
    if model.waves:
        spread = spread / (2 * torch.where(torch.isfinite(f_number), f_number, 1.0))
    width = safe_sqrt(psfs.covariance[0] + psfs.covariance[2]) if model.by_width else pixels.pitch
    error = safe_divide(spread, width)
    if model.by_width:
        error = torch.where(error > 0.3, torch.inf, error)
    return error.clamp_min(model.floor).expand(psfs.energy.shape)


def _change(before: Psf, after: Psf, model: Model) -> Tensor:
    """Relative L1 difference of two kernels, or of two Gaussians the relative difference (D, F) of σ and of energy."""
    if not model.by_width:
        return _kernel_change(before, after)
    width = after.covariance[0] + after.covariance[2]
    variance = 0.5 * safe_divide((before.covariance[::2] - after.covariance[::2]).abs().sum(0), width)
    return torch.maximum(variance, safe_divide((before.energy - after.energy).abs(), after.energy))


def _kernel_change(before: Psf, after: Psf) -> Tensor:
    """Relative L1 difference of two kernels, in units of the second's energy; 0 where both are empty."""
    return safe_divide((before.kernel - after.kernel).abs().sum((-2, -1)), after.energy)


def check_shares(lens: Lens, parameters: Parameters | None) -> None:
    """Raise ValueError for derivatives and for options that differ between kernels: processes cannot share them."""
    leaves = [leaf for leaf in pytree.tree_leaves((lens, parameters)) if isinstance(leaf, Tensor)]
    if torch.is_grad_enabled() and any(leaf.requires_grad for leaf in leaves):
        raise ValueError("kernels that processes share have no gradient: leave share out, or use torch.no_grad()")
    if any(isinstance(leaf, Tensor) and leaf.dim() > 1 for leaf in pytree.tree_leaves(parameters)):
        raise ValueError("processes share kernels of one rho and one zernike only: leave share out")


def shared(
    kernels: Callable[..., Kernels], share: Share, *, by_field: bool = False, by_pair: bool = False
) -> Callable[..., Kernels]:
    """The same kernels, each process computing a block; all processes get all of them, without gradient.

    by_field: decisions are made for each field alone: either whole fields are dealt out, or each field is divided;
    by_pair: for each pair of an object distance and a field: its wavelengths stay together.
    """

    def compute(scene: Scene, grid: Grid, **options: Any) -> Kernels:
        cut = _cuts(scene.shape, share.processes, by_field=by_field, by_pair=by_pair)
        if math.prod(cut) == 1:
            return kernels(scene, grid, **options)
        # Processes beyond the number of blocks repeat a block, so that all take part in all decisions.
        distances, fields, wavelengths = block = _block(scene.shape, cut, share.rank % math.prod(cut))
        part = scene.of(distances)
        part = dataclasses.replace(part, fields=part.fields[..., fields], wavelengths=part.wavelengths[wavelengths])
        centre = grid.centre
        for axis, chosen in enumerate(block, 1):  # axes of length 1 hold for all
            if centre.dim() > 1 and centre.shape[axis] > 1:
                centre = centre[(slice(None),) * axis + (chosen,)]
        with agreeing() as largest:
            if not (by_field and cut[1] > 1):
                part = dataclasses.replace(part, largest=largest)
            light = kernels(part, dataclasses.replace(grid, centre=centre), **options)
            rays = int(largest(torch.tensor(light.rays)))

        def whole(parts: list[Tensor], before: int) -> Tensor:
            (part,) = parts
            joined = part.new_zeros(*part.shape[:before], *scene.shape, *part.shape[before + 3 :])
            if share.rank < math.prod(cut):  # the process does not repeat a block
                joined[(slice(None),) * before + block] = part.detach()
            return total(joined)

        return dataclasses.replace(combined([light], whole), grid=grid, rays=rays)

    return compute


def plain_rays_shared(plain: Callable[..., Kernels], share: Share, scene: Scene, grid: Grid, *, rays: int) -> Kernels:
    """Kernels of `rays` Sobol rays, each process tracing a share of them."""

    def some(count: int, **like: Any) -> tuple[Tensor, Tensor]:
        points, weights = sobol(count, **like)
        return points[:, share.part(count)], weights[share.part(count)]

    light = plain(scene, grid, rays=rays, sampling=some)
    arrived, centroid, covariance = (
        gathered(t).movedim(0, -1) for t in (light.arrived, light.centroid, light.covariance)
    )
    centroid, covariance = mixture(arrived, centroid, covariance)
    return dataclasses.replace(
        light, kernel=total(light.kernel), arrived=arrived.sum(-1), centroid=centroid, covariance=covariance
    )


def _cuts(shape: Sequence[int], processes: int, *, by_field: bool, by_pair: bool = False) -> tuple[int, ...]:
    """Number of parts along each axis that minimises the largest block; of equal ones the fewest parts."""
    choices = itertools.product(*(range(1, min(count, processes) + 1) for count in shape))
    fitting = [cut for cut in choices if math.prod(cut) <= processes]
    if by_field:
        fitting = [cut for cut in fitting if cut[1] == 1 or cut[0] * cut[2] == 1]
    if by_pair:
        fitting = [cut for cut in fitting if cut[2] == 1]
    return min(
        fitting, key=lambda cut: (math.prod(-(-n // k) for n, k in zip(shape, cut, strict=True)), math.prod(cut))
    )


def _block(shape: Sequence[int], cut: Sequence[int], number: int) -> tuple[slice, ...]:
    """Block `number` of the axes of `shape` divided into `cut` parts."""
    axes = zip(np.unravel_index(number, cut), cut, shape, strict=True)
    return tuple(Share(int(part), parts).part(count) for part, parts, count in axes)

"""The public call `psf`: every PSF model, driven by a tolerance instead of a number of rays.

Kernels may be shared between processes, one block of object distances × fields × wavelengths each. Decisions made for
the whole scene (number of rays, cell size, vignetting) go through `Scene.largest`, which then holds for all blocks, so
that the kernels equal those of one process to rounding. Independent rays may be streamed within a memory budget, in any
number (tracing/streaming.py).
"""

import contextlib
import dataclasses
import functools
import itertools
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.budget import within
from raytrace.maths import pupil
from raytrace.maths.grid import Grid
from raytrace.maths.grid import grid as make_grid
from raytrace.maths.numerics import safe_divide
from raytrace.maths.pupil import gauss_rings
from raytrace.psf_models import gaussian
from raytrace.psf_models.drt import deposit
from raytrace.psf_models.models import (
    DRT,
    MODELS,
    RUNGS,
    Fourier,
    Gaussian,
    Model,
    Paraxial,
    Wave,
    between,
    by_order,
    by_rays,
    by_tolerance,
    climb,
)
from raytrace.psf_models.paraxial import has_one_focus
from raytrace.psf_models.result import EmptyPsf, Kernels, Psf, combined, mixture, polychromatic, without_dark
from raytrace.shards import Share, agreeing, gathered, total
from raytrace.system.lens import Lens, field_points, with_object_distance
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.ray_failures import beam_hint, ray_failures, warn_of_failures
from raytrace.tracing.scene import Memo, Scene, beam_share, chief_landing, scene, symmetry
from raytrace.tracing.streaming import (
    MAX_BYTES,
    Moments,
    Progress,
    chunk_size,
    hits,
    merge,
    moments,
    nothing,
    pupil_chunks,
    shots_of,
    stacked,
)


def shared_model(model: Model, share: Share) -> Model:
    """The model computed jointly by processes that all call it alike; all get all kernels, without gradient.

    Each process computes a block of kernels (whole fields of a model with `by_field`), or a share of independent rays.
    A single kernel without independent rays is computed by every process.
    """
    deal = functools.partial(shared, share=share, by_field=model.by_field)
    plain = model.plain and functools.partial(_plain_rays, model.plain, share)
    return dataclasses.replace(model, kernels=deal(model.kernels), lean=model.lean and deal(model.lean), plain=plain)


def check_shares(lens: Lens, parameters) -> None:
    """Raise ValueError for derivatives and for options that differ between kernels: processes cannot share them."""
    leaves = [leaf for leaf in pytree.tree_leaves((lens, parameters)) if isinstance(leaf, Tensor)]
    if torch.is_grad_enabled() and any(leaf.requires_grad for leaf in leaves):
        raise ValueError("kernels that processes share have no gradient: leave share out, or use torch.no_grad()")
    if any(isinstance(leaf, Tensor) and leaf.dim() > 1 for leaf in pytree.tree_leaves(parameters)):
        raise ValueError("processes share kernels of one rho and one zernike only: leave share out")


def shared(kernels: Callable[..., Kernels], share: Share, *, by_field: bool = False) -> Callable[..., Kernels]:
    """The same kernels, each process computing a block; all processes get all of them, without gradient.

    by_field: decisions are made for each field alone: either whole fields are dealt out, or each field is divided.
    """

    def compute(scene: Scene, grid: Grid, **options) -> Kernels:
        cut = _cuts(scene.shape, share.processes, by_field=by_field)
        if math.prod(cut) == 1:
            return kernels(scene, grid, **options)
        # Processes beyond the number of blocks repeat a block, so that all take part in all decisions.
        block = _block(scene.shape, cut, share.rank % math.prod(cut))
        distances, fields, wavelengths = block
        part = dataclasses.replace(
            scene,
            lens=with_object_distance(scene.lens, scene.lens.surfaces[0].thickness[distances]),
            fields=scene.fields[:, fields],
            wavelengths=scene.wavelengths[wavelengths],
        )
        centre = grid.centre
        for axis, chosen in enumerate(block, 1):  # axes of length 1 hold for all
            if centre.dim() > 1 and centre.shape[axis] > 1:
                centre = centre[(slice(None),) * axis + (chosen,)]
        with agreeing() as largest:
            if not (by_field and cut[1] > 1):
                part = dataclasses.replace(part, largest=largest)
            light = kernels(part, dataclasses.replace(grid, centre=centre), **options)
            rays = int(largest(torch.tensor(light.rays)))
        light = _joined(light, scene.shape, block if share.rank < math.prod(cut) else None)
        return dataclasses.replace(light, grid=grid, rays=rays)

    return compute


def _plain_rays(plain: Callable[..., Kernels], share: Share, scene: Scene, grid: Grid, *, rays: int) -> Kernels:
    """Kernels of `rays` Sobol rays, each process tracing a share of them."""

    def some(count: int, **like) -> tuple[Tensor, Tensor]:
        points, weights = pupil.sobol(count, **like)
        return points[:, share.part(count)], weights[share.part(count)]

    light = plain(scene, grid, rays=rays, sampling=some)
    arrived, *moments = (gathered(t).movedim(0, -1) for t in (light.arrived, light.centroid, light.covariance))
    centroid, covariance = mixture(arrived, *moments)
    return dataclasses.replace(
        light, kernel=total(light.kernel), arrived=arrived.sum(-1), centroid=centroid, covariance=covariance
    )


def _cuts(shape: Sequence[int], processes: int, *, by_field: bool) -> tuple[int, int, int]:
    """Number of parts along each axis that minimises the largest block; of equal ones the fewest parts."""
    choices = itertools.product(*(range(1, min(count, processes) + 1) for count in shape))
    fitting = [cut for cut in choices if math.prod(cut) <= processes]
    if by_field:
        fitting = [cut for cut in fitting if cut[1] == 1 or cut[0] * cut[2] == 1]
    return min(
        fitting, key=lambda cut: (math.prod(-(-n // k) for n, k in zip(shape, cut, strict=True)), math.prod(cut))
    )


def _block(shape: Sequence[int], cut: Sequence[int], number: int) -> tuple[slice, ...]:
    """Block `number` of the axes of `shape` divided into `cut` parts."""
    slices = []
    for count, parts in zip(reversed(shape), reversed(cut), strict=True):
        number, part = divmod(number, parts)
        slices.append(Share(part, parts).part(count))
    return tuple(reversed(slices))


def _joined(light: Kernels, shape: Sequence[int], block: tuple[slice, ...] | None) -> Kernels:
    """All kernels from the blocks of all processes; block: of this process, None if another process has it too."""

    def whole(parts: list[Tensor], before: int) -> Tensor:
        (part,) = parts
        joined = part.new_zeros(*part.shape[:before], *shape, *part.shape[before + 3 :])
        if block is not None:
            joined[(slice(None),) * before + block] = part.detach()
        return total(joined)

    return combined([light], whole)


@torch.no_grad()
def stream_kernels(
    scene: Scene,
    grid: Grid,
    rays: int,
    *,
    sampling: str = "sobol",
    seed: int = 0,
    width: float = 0.25,
    max_bytes: float = MAX_BYTES,
    progress: Progress | None = None,
) -> tuple[Kernels, Kernels]:
    """Kernels of `rays` independent rays for each distance, field and wavelength, as `drt.kernels_of_rays`, and of the
    first half of them; without derivatives.

    sampling, seed: as for `stream_spots`; width: half width in pixels of the blur of each ray, 0 for none; max_bytes:
    additional memory; progress: called with the number of rays traced since the last call. Sums are float64.
    """
    shape, lens = scene.shape, scene.lens
    like = lens.surfaces[-2].thickness
    at = (with_object_distance(lens, d) for d in lens.surfaces[0].thickness.flatten().unbind(0))
    shots = [s for here in at for s in shots_of(here, rays, scene.fields, scene.wavelengths, None, None)[0]]
    centre = grid.centre.reshape(2, *(grid.centre.shape[1:] or (1, 1, 1))).expand(2, *shape)
    grids = [dataclasses.replace(grid, centre=c) for c in centre.flatten(1).unbind(1)]
    size = chunk_size(shots[0], max_bytes, kept=3 * 8 * len(shots) * grid.rows * grid.columns)
    references: list[Tensor] = []
    sums, kernels = [nothing(like)] * len(shots), like.new_zeros(len(shots), *grid.shape, dtype=torch.float64)
    done, half = 0, max(1, rays // 2)
    for points in pupil_chunks(rays, size, sampling=sampling, seed=seed, like=like, cut=half):
        for k, s in enumerate(shots):
            found, valid = hits(s, points)
            if not done:
                references.append(moments(found, valid, like.new_zeros(2)).mean.to(like.dtype))
            sums[k] = merge(sums[k], moments(found, valid, references[k]))
            kernels[k] += deposit(grids[k], found, valid.double(), width)
            if progress is not None:
                progress(points.shape[1])
        done += points.shape[1]
        if done == half:
            before = kernels.clone()
    m = stacked([Moments(m.count, r + m.mean, m.scatter) for r, m in zip(references, sums, strict=True)], shape)
    light = beam_share(scene).double()
    about, arrived = (m.mean, safe_divide(m.scatter, m.count)), light * m.count / rays
    whole, first = (
        k.unflatten(0, shape) * (light / count)[..., None, None] for k, count in ((kernels, rays), (before, half))
    )
    return Kernels(whole, grid, *about, rays, arrived=arrived), Kernels(first, grid, *about, half, arrived=arrived)


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
    progress: Callable | None = None
    empty: str = "nan"


PIXEL, SIZE = 0.005, 21  # mm; a window of 105 µm


def psf(
    lens: Lens,
    model: str | Paraxial | Fourier | Gaussian | DRT | Wave = "auto",
    *,
    fields: Tensor | Sequence | None = None,
    object_distances: Tensor | Sequence[float] | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    wavelength_weights: Tensor | Sequence[float] | None = None,
    pixel: float | None = None,
    size: int | tuple[int, int] | None = None,
    grid: Grid | None = None,
    center: str | None = None,
    window: str = "follows",
    tol: float | None = None,
    normalise: str = "energy",
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
    fields: y, pairs (x, y) or (2, F) in the lens's kind of field; object_distances: (D,) mm, inf allowed; wavelengths:
    (W,)
        µm with wavelength_weights: (W,); by default those of the lens. Kernels are summed over the wavelengths;
        per_wavelength: each wavelength has a kernel, (D, F, W, rows, columns), of energy 1 for all its light.
    pixel, size: pitch in mm, 0.005 by default, and number, one or (rows, columns), 21 by default; grid: instead, pixels
        whose centre is (2,) or (2, D, F).
    center: origin of the grid's centre: "axis", "chief" (the chief ray at the primary wavelength) or "centroid" (of the
        rays). By default "axis" if fields are specified, "chief" for the lens's fields.
    window: "follows": a window about the chief ray or the centroid moves with it, in the derivatives too, so that a
    shift
        of the whole image changes no kernel. "fixed": the window has no derivative: the pixels of a sensor that does
        not move. The kernels are the same.
    tol: bound on the estimated error, 0.01 by default; the coarsest order that meets it is returned.
    normalise: "energy" (1 = all light through the entrance pupil) or "window" (each kernel sums to 1).
    execution: memory, processes and progress, see `Execution`.

    Raises ValueError for invalid arguments, EmptyPsf if no ray at all reaches the sensor. Warns NotConverged and,
    outside of loops (without an order or a memo), UnfilledStop.
    """
    name = model if isinstance(model, str) else next(k for k, m in MODELS.items() if isinstance(model, m.parameters))
    _check_choices(name, center, window, normalise)
    parameters = MODELS[name].parameters() if isinstance(model, str) and name != "auto" else model
    order, rays = (getattr(parameters, number, None) for number in ("order", "rays"))
    execution = execution or Execution()
    memo, share = execution.memo, execution.share
    center = center or ("chief" if fields is None else "axis")
    _check(tol=tol, rays=rays, order=order, grid=grid, pixel=pixel, size=size)
    like = lens.wavelengths
    framed = (grid, pixel, size) != (None, None, None)
    base = make_grid(like.new_tensor(pixel or PIXEL), size or SIZE) if grid is None else grid
    fields = fields if isinstance(fields, Tensor) else field_points(fields, like=lens)
    distances = lens.surfaces[0].thickness if object_distances is None else object_distances
    distances = distances.reshape(1) if object_distances is None else _row(distances, like)
    weights = lens.wavelength_weights if wavelengths is None and wavelength_weights is None else wavelength_weights
    wavelengths = like if wavelengths is None else _row(wavelengths, like)
    weights = torch.ones_like(wavelengths) if weights is None else _row(weights, like)
    _check_batch(fields, distances, wavelengths, weights)
    if order is None and memo is None:
        warn_of_filling(with_object_distance(lens, distances.min()), fields)
    drive = _driver(lens, name, parameters, tol, execution)
    if share is not None and share.processes > 1:
        check_shares(lens, parameters)
    shares = weights / weights.sum()
    summed = None if per_wavelength else shares

    def compute(chosen: Tensor) -> Psf:
        centre = base.centre[:, chosen] if base.centre.dim() > 1 else base.centre
        batch = scene(lens, fields, distances[chosen], wavelengths, memo)
        origin = _centre(batch, lens, center, shares)
        if origin is not None and window == "fixed":
            origin = origin.detach()
        centre = _with_centre(centre, origin, len(wavelengths))
        return drive(batch, dataclasses.replace(base, centre=centre), summed)

    infinite = torch.isinf(distances)
    with within(execution.max_bytes) if execution.max_bytes is not None else contextlib.nullcontext():
        if bool(infinite.any()) and not bool(infinite.all()):
            psfs = _merged(compute(~infinite), compute(infinite), infinite)
        else:
            psfs = compute(torch.ones_like(infinite))
    # Only traced light can fail to arrive; light outside the window has arrived.
    if psfs.rays and not bool((psfs.energy > 0).any()) and not bool((psfs.ray_covariance != 0).any()):
        trial = with_object_distance(lens, distances[0].detach())
        points = gauss_rings(6, dtype=fields.dtype, device=fields.device)[0]
        failures = ray_failures(trial, points, fields=fields[:, :1].detach(), wavelengths=wavelengths[:1].detach())
        reasons = "; ".join(filter(None, (failures.words(0, 0), beam_hint(trial))))
        raise EmptyPsf(f"no ray reaches the sensor: {reasons}")
    if normalise == "window":
        # Over the brightest pixel first: in a nearly dark window the square of the sum would underflow in derivatives.
        scaled = safe_divide(psfs.kernel, psfs.kernel.detach().amax((-2, -1), keepdim=True))
        kernel = safe_divide(scaled, scaled.sum((-2, -1), keepdim=True))
        psfs = dataclasses.replace(psfs, kernel=kernel, normalised="window")
    psfs = without_dark(psfs, execution.empty)
    _warn_of_dark(lens, fields, distances, wavelengths, psfs)
    return dataclasses.replace(
        psfs,
        lens=lens,
        fields=fields,
        object_distances=distances,
        wavelengths=wavelengths,
        wavelength_weights=shares,
        parameters=MODELS[psfs.model].parameters() if name == "auto" else parameters,
        framed=framed,
    )


def _driver(lens: Lens, model: str, parameters, tol: float | None, execution: Execution):
    """The function (scene, grid, weights) -> Psf that the arguments of `psf` select."""
    share, max_bytes, progress = execution.share, execution.max_bytes, execution.progress
    order, rays = (None if n is None else int(n) for n in (getattr(parameters, k, None) for k in ("order", "rays")))

    def configured(name: str) -> Model:
        row = MODELS[name]
        numbers = row.parameters() if model == "auto" else parameters
        keywords = {f.name: getattr(numbers, f.name) for f in dataclasses.fields(numbers)}
        keywords = {key: number for key, number in keywords.items() if key not in ("order", "rays")}
        if keywords:
            row = dataclasses.replace(row, kernels=functools.partial(row.kernels, **keywords))
        return shared_model(row, share) if share is not None and share.processes > 1 else row

    def stream(batch: Scene, pixels: Grid, weights: Tensor | None) -> Psf:
        with progress(rays * math.prod(batch.shape), "ray") if progress else contextlib.nullcontext() as bar:
            halves = stream_kernels(batch, pixels, rays, max_bytes=max_bytes, progress=bar and bar.update)
        return between(*halves, weights, MODELS[model])

    if model == "auto":
        rungs = [configured(name) for name in RUNGS if MODELS[name].traces or has_one_focus(lens)]
        return functools.partial(climb, rungs=rungs, tol=tol or 0.01)
    if rays is not None and max_bytes is not None and MODELS[model].plain is not None:
        return stream
    if order is not None:
        return functools.partial(by_order, model=configured(model), order=order)
    if rays is not None:
        return functools.partial(by_rays, model=configured(model), count=rays)
    return functools.partial(by_tolerance, model=configured(model), tol=tol or 0.01)


def _row(numbers: Tensor | Sequence[float], like: Tensor) -> Tensor:
    return numbers if isinstance(numbers, Tensor) else like.new_tensor(numbers)


def _warn_of_dark(lens: Lens, fields: Tensor, distances: Tensor, wavelengths: Tensor, psfs: Psf) -> None:
    """Warn LostRays of every field with a wavelength of which no ray reaches the sensor, with the ray status."""
    dark = psfs.ray_centroid[0].detach().isnan()
    if not bool(dark.any()):
        return
    dark = dark if dark.dim() > 2 else dark[..., None].expand(*dark.shape, len(wavelengths))
    points = gauss_rings(6, dtype=fields.dtype, device=fields.device)[0]
    for distance, lost in zip(distances.detach(), dark, strict=True):
        at = f"object at {float(distance):g} mm, " if len(distances) > 1 else ""
        trial = with_object_distance(lens, distance)
        warn_of_failures(trial, points, lost, fields=fields.detach(), wavelengths=wavelengths.detach(), at=at)


def _check_choices(model: str, center: str | None, window: str, normalise: str) -> None:
    known = {"model": (model, ("auto", *MODELS)), "center": (center or "axis", ("axis", "chief", "centroid"))}
    known |= {"window": (window, ("follows", "fixed")), "normalise": (normalise, ("energy", "window"))}
    for name, (word, words) in known.items():
        if word not in words:
            raise ValueError(f"{name} {word!r} is not known; expected {', '.join(words)}")


def _check(*, tol, rays, order, grid, pixel, size) -> None:
    for refused, message in (
        (
            tol is not None and rays is not None,
            "tol and rays exclude each other: a tolerance chooses the number of rays",
        ),
        (
            order is not None and (tol is not None or rays is not None),
            "an order fixes the amount of work: it excludes tol and rays",
        ),
        (tol is not None and not tol > 0, f"tol {tol}: expected a number above 0"),
        (rays is not None and (rays < 1 or rays % 1), f"rays {rays}: expected a whole number above 0"),
        (grid is not None and (pixel, size) != (None, None), "grid says pixel and size: leave them out, or the grid"),
        (pixel is not None and not pixel > 0, f"pixel {pixel}: expected a number above 0"),
    ):
        if refused:
            raise ValueError(message)


def _check_batch(fields: Tensor, distances: Tensor, wavelengths: Tensor, weights: Tensor) -> None:
    if fields.dim() != 2 or len(fields) != 2 or not fields.numel():
        raise ValueError(f"fields of shape {tuple(fields.shape)}; expected (2, F)")
    for name, values in (("object_distances", distances), ("wavelengths", wavelengths)):
        if values.dim() != 1 or not len(values):
            raise ValueError(f"{name} of shape {tuple(values.shape)}; expected one axis")
        if bool(values.isnan().any()) or bool((values == 0).any()):
            raise ValueError(
                f"{name} {values.tolist()}; expected numbers other than 0 and nan; give others by `{name}`"
            )
    if weights.shape != wavelengths.shape:
        raise ValueError(f"{weights.numel()} wavelength_weights for {len(wavelengths)} wavelengths")
    if bool((weights < 0).any()) or not bool(weights.sum() > 0):
        raise ValueError(f"wavelength_weights {weights.tolist()} are below 0 or sum to 0")


def _centre(batch: Scene, lens: Lens, center: str, weights: Tensor) -> Tensor | None:
    """Origin of the grids on the sensor, with its derivatives: None for the axis, else (2, D, F) mm."""
    if center == "axis":
        return None
    if center == "centroid" and symmetry(batch) != "round":
        pixel = make_grid(batch.wavelengths.new_tensor(1.0), 1)
        return polychromatic(gaussian.kernels_alone(batch, pixel, order=6), weights, "").centroid
    return chief_landing(dataclasses.replace(batch, wavelengths=lens.primary[None]))[..., 0]


def _with_centre(base: Tensor, origin: Tensor | None, wavelengths: int) -> Tensor:
    """A base (2,) or (2, D, F) relative to an origin, for all wavelengths; a single point stays a single point."""
    if origin is None and base.dim() == 1:
        return base
    centre = base if base.dim() > 1 else base.reshape(2, 1, 1)
    centre = centre if origin is None else centre + origin
    return centre[..., None].expand(*centre.shape, wavelengths)


def _merged(finite: Psf, infinite: Psf, mask: Tensor) -> Psf:
    """The PSFs of finite and of infinite object distances, in their original order."""
    order = torch.argsort(torch.cat([torch.nonzero(~mask)[:, 0], torch.nonzero(mask)[:, 0]]))

    def in_order(parts: Sequence[Tensor], axis: int) -> Tensor:
        return torch.cat(parts, axis).index_select(axis, order)

    merged, centre = combined([finite, infinite], in_order), finite.grid.centre
    if centre.dim() > 1:
        centre = in_order([centre, infinite.grid.centre], 1)
    reason = "; ".join(dict.fromkeys(filter(None, (finite.reason, infinite.reason))))
    return dataclasses.replace(merged, grid=dataclasses.replace(finite.grid, centre=centre), reason=reason)

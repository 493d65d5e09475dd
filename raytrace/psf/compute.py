"""One call for every PSF model, driven by a tolerance instead of a number of rays."""

import dataclasses
import functools
import itertools
import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.grid import Grid
from raytrace.grid import grid as make_grid
from raytrace.lens import Lens
from raytrace.numerics import safe_divide, safe_sqrt
from raytrace.paraxial import first_order
from raytrace.psf import diffraction, fourier, gaussian, paraxial, raymap, rays
from raytrace.scene import EmptyPsf, Kernels, Scene, scene, trace_scene
from raytrace.value import value


class NotConverged(UserWarning):
    """A PSF whose estimated error stayed above the tolerance at the finest order there is."""


@value
class Psf:
    """PSFs over object distance × field.

    kernel: (D, F, rows, columns), integrated over pixels.
    grid: where the pixels lie on the sensor, centre (2,) or (2, D, F) mm.
    energy: (D, F) inside the window, of the light through the entrance pupil.
    error: (D, F) estimated relative L1 error of the kernel against the model's own limit (`gaussian`: relative error
        of σ); nan where it was not estimated. How far it can be believed is measured in docs/psf_error.md.
    centroid: (2, D, F) mm; covariance: (3, D, F) xx, xy, yy in mm², of the distribution before pixel integration.
    residual: (D, F) how wrong the model itself is, where it can tell, or None.
    model: its name; rays: traced for each kernel; reason: why `auto` chose the model, or a remark on convergence.
    normalised: "energy" (1 = all light through the entrance pupil) or "window" (each kernel sums to 1).
    """

    kernel: Tensor
    grid: Grid
    energy: Tensor
    error: Tensor
    centroid: Tensor
    covariance: Tensor
    residual: Tensor | None = None
    model: str = ""
    rays: int = 0
    reason: str = ""
    normalised: str = "energy"


@dataclasses.dataclass(frozen=True)
class Model:
    """A PSF model as a ladder of orders, each finer than the one before.

    kernels: (scene, grid, order) -> Kernels; orders: from the coarsest to the finest.
    by_width: True if the error is that of σ, False if it is that of the kernel.
    left: the error that remains behind the last change of the kernel, in units of that change; None if the rate of
        convergence is to be measured. The constants cover 95 % of the cases of docs/psf_error.md.
    """

    kernels: Callable[[Scene, Grid, int], Kernels]
    orders: Sequence[int]
    by_width: bool = False
    left: float | None = None


MODELS: dict[str, Model] = {
    "paraxial": Model(lambda scene, grid, order: paraxial.kernels(scene, grid), (0,)),
    "fourier": Model(lambda scene, grid, order: fourier.kernels(scene, grid, order=order), range(6), left=0.2),
    "gaussian": Model(
        lambda scene, grid, order: gaussian.kernels(scene, grid, order=order), (2, 3, 4, 5, 6, 8, 10, 12, 16, 24), True
    ),
    "drt": Model(lambda scene, grid, order: raymap.kernels(scene, grid, order=order), range(11), left=1.5),
    "wave": Model(lambda scene, grid, order: diffraction.kernels(scene, grid, order=order), range(6), left=0.2),
}

#: Models from the one that knows least to the one that knows most: the rungs of `model="auto"`.
LADDER = ("paraxial", "gaussian", "drt", "wave")


def psf(
    lens: Lens,
    model: str = "auto",
    *,
    fields: Tensor | None = None,
    object_distances: Tensor | None = None,
    wavelengths: Tensor | None = None,
    wavelength_weights: Tensor | None = None,
    grid: Grid | None = None,
    center: str = "axis",
    tol: float | None = None,
    rays: int | None = None,
    normalise: str = "energy",
) -> Psf:
    """PSFs of a lens, differentiable in every number of the lens, its sensor distance and the grid.

    model: a key of MODELS, or "auto".
    fields: (2, F) in the lens's kind of field, its own by default; object_distances: (D,) mm, inf allowed, the lens's
    by default; wavelengths: (W,) µm with wavelength_weights: (W,), summed over; the lens's own by default.
    grid: pixels, by default 21 × 21 of 5 µm; center: what the grid's centre counts from: "axis", "chief" (the chief
    ray at the primary wavelength) or "centroid".
    tol: bound on the estimated error, 0.01 by default; the coarsest order that meets it is returned. rays: instead,
    about that many rays per kernel (`drt`: plain Sobol rays), the error then estimated from half of them.
    normalise: "energy" (1 = all light through the entrance pupil) or "window".
    Raises ValueError for arguments that make no sense, EmptyPsf if no ray of the whole batch reaches the sensor;
    a single empty kernel of a batch is 0 with gradient 0. Warns NotConverged.
    """
    _check(model, center, normalise, tol, rays)
    fields = torch.stack([lens.fields.x, lens.fields.y]) if fields is None else fields
    distances = lens.surfaces[0].thickness.reshape(1) if object_distances is None else object_distances
    weights = lens.wavelength_weights if wavelengths is None else None
    weights = wavelength_weights if wavelength_weights is not None else weights
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    weights = torch.ones_like(wavelengths) if weights is None else weights
    _check_batch(fields, distances, wavelengths, weights)
    base = make_grid(wavelengths.new_tensor(0.005), 21) if grid is None else grid
    compute = functools.partial(
        _group, lens, model, fields, wavelengths, weights / weights.sum(), base, center, tol or 0.01, rays
    )
    infinite = torch.isinf(distances)
    if bool(infinite.any()) and not bool(infinite.all()):
        found = _merge(compute(distances[~infinite]), compute(distances[infinite]), infinite)
    else:
        found = compute(distances)
    # Only traced light can be lost; light beside the window is not.
    if found.rays and not bool((found.energy > 0).any()) and not bool((found.covariance != 0).any()):
        raise EmptyPsf("no ray reaches the sensor: the lens is blocked or the field is outside its reach")
    if normalise == "window":
        kernel = safe_divide(found.kernel, found.energy[..., None, None])
        found = dataclasses.replace(found, kernel=kernel, normalised="window")
    return found


def _check(model: str, center: str, normalise: str, tol: float | None, rays: int | None) -> None:
    if model != "auto" and model not in MODELS:
        raise ValueError(f"model {model!r} is not known; expected auto, {', '.join(MODELS)}")
    if center not in ("axis", "chief", "centroid"):
        raise ValueError(f"center {center!r} is not known; expected axis, chief or centroid")
    if normalise not in ("energy", "window"):
        raise ValueError(f"normalise {normalise!r} is not known; expected energy or window")
    if tol is not None and rays is not None:
        raise ValueError("tol and rays exclude each other: a tolerance chooses the number of rays")
    if tol is not None and not tol > 0:
        raise ValueError(f"tol {tol:g}: expected a number above 0")
    if rays is not None and rays < 1:
        raise ValueError(f"rays {rays}: expected a whole number above 0")
    if rays is not None and model == "auto":
        raise ValueError("auto chooses by a tolerance: give tol, or rays and a model that traces them")
    if rays is not None and model in ("paraxial", "fourier"):
        raise ValueError(f"{model} traces no rays: leave rays out")


def _check_batch(fields: Tensor, distances: Tensor, wavelengths: Tensor, weights: Tensor) -> None:
    if fields.dim() != 2 or len(fields) != 2 or not fields.numel():
        raise ValueError(f"fields of shape {tuple(fields.shape)}; expected (2, F)")
    for name, values in (("object_distances", distances), ("wavelengths", wavelengths)):
        if values.dim() != 1 or not len(values):
            raise ValueError(f"{name} of shape {tuple(values.shape)}; expected one axis")
        if bool(values.isnan().any()) or bool((values == 0).any()):
            raise ValueError(f"{name} {values.tolist()}; expected numbers other than 0 and nan")
    if weights.shape != wavelengths.shape:
        raise ValueError(f"{weights.numel()} wavelength_weights for {len(wavelengths)} wavelengths")
    if bool((weights < 0).any()) or not bool(weights.sum() > 0):
        raise ValueError(f"wavelength_weights {weights.tolist()} are below 0 or sum to 0")


def _group(lens, model, fields, wavelengths, weights, base, center, tol, rays, distances) -> Psf:
    """The PSFs of object distances (D,) that are all finite or all infinite."""
    batch = scene(lens, fields, distances, wavelengths)
    place = _centre(batch, lens, center, weights)
    pixels = dataclasses.replace(base, centre=_with_centre(base.centre, place, len(wavelengths)))
    if model == "auto":
        return _climb(batch, pixels, weights, tol)
    if rays is not None:
        return _by_rays(batch, pixels, weights, model, rays)
    return _by_tolerance(batch, pixels, weights, model, tol)


def _by_tolerance(batch: Scene, pixels: Grid, weights: Tensor, model: str, tol: float) -> Psf:
    """Climb the orders until the estimated error of the last meets the tolerance; see `_estimate`."""
    ladder = MODELS[model]
    with torch.no_grad():
        lost = _lost_light(batch) if ladder.by_width else None
        before, changes, error = None, [], None
        for order in ladder.orders:
            found = _polychromatic(ladder.kernels(batch, pixels, order), weights, model)
            if before is not None:
                changes.append(_width_change(before, found) if ladder.by_width else _kernel_change(before, found))
            error = _estimate(ladder, changes, order, lost, like=found.energy)
            if bool((error <= tol).all()):
                break
            before = found
    reason = ""
    if not bool((error <= tol).all()):
        reason = f"{model}: the estimated error {float(error.max()):.1e} stays above the tolerance {tol:g}"
        warnings.warn(reason, NotConverged, stacklevel=4)
    if torch.is_grad_enabled():
        found = _polychromatic(ladder.kernels(batch, pixels, order), weights, model)
    return dataclasses.replace(found, error=error, reason=reason)


def _estimate(ladder: Model, changes: list[Tensor], order: int, lost: Tensor | None, *, like: Tensor) -> Tensor:
    """Estimated error (D, F) after changes δ_1 … δ_n from one order to the next; inf while too few are known.

    Cells (`drt`) halve their error with each order, waves divide it by 10 or more: the error left is a constant
    `left` times δ_n. Gauss rings (`gaussian`) converge as fast as the lens is smooth, so the geometric series
    δ_n ρ/(1 - ρ) is summed, ρ the largest ratio of successive changes so far: one lucky small change is not believed.
    Rings that an edge crosses jump instead by up to half a ring's weight, π/4n of the light, or by all that is lost.
    A floor stands for rounding.
    """
    if len(ladder.orders) == 1:
        return torch.zeros_like(like)
    floor = 1e-12 if like.dtype == torch.float64 else 1e-5
    if not changes or (ladder.left is None and len(changes) < 2):
        return torch.full_like(like, torch.inf)
    if ladder.left is not None:
        error = ladder.left * changes[-1]
    else:
        ratios = [safe_divide(later, earlier) for earlier, later in itertools.pairwise(changes)]
        rho = torch.stack(ratios).amax(0).clamp(1e-4, 0.9)
        error = changes[-1] * rho / (1 - rho)
    if lost is not None:
        error = torch.maximum(error, torch.minimum(2 * lost, torch.full_like(lost, 0.8 / order)))
    return error.clamp_min(floor)


def _lost_light(batch: Scene) -> Tensor:
    """The largest share (D, F) of the beam that is lost, over wavelengths, by rings between those of any order; 0
    where it arrives as a whole or not at all."""
    fold = gaussian.symmetry(batch)
    points, share = gaussian.fold_pupil(20, fold, batch.wavelengths)
    arrived = torch.where(trace_scene(batch, points).valid, share, 0.0).sum(-1)
    arrived = arrived.expand(batch.shape)
    return torch.where(arrived > 0, (1 - arrived).clamp_min(0.0), 0.0).amax(-1)


def _by_rays(batch: Scene, pixels: Grid, weights: Tensor, model: str, count: int) -> Psf:
    """About `count` rays a kernel; the error is the change from half as many."""
    if model == "drt":
        found, half = (
            _polychromatic(rays.kernels(batch, pixels, rays=max(n, 1)), weights, model) for n in (count, count // 2)
        )
        return dataclasses.replace(found, error=_kernel_change(half, found).detach())
    ladder, before = MODELS[model], None
    for order in ladder.orders:
        found = _polychromatic(ladder.kernels(batch, pixels, order), weights, model)
        if found.rays > count:
            break
        before, coarser = found, before
    if before is None:
        raise ValueError(f"{model} needs at least {found.rays} rays a kernel; {count} given")
    if len(ladder.orders) == 1:
        return dataclasses.replace(before, error=torch.zeros_like(before.energy))
    if coarser is None:
        return before
    change = _width_change(coarser, before) if ladder.by_width else _kernel_change(coarser, before)
    return dataclasses.replace(before, error=change.detach())


def _climb(batch: Scene, pixels: Grid, weights: Tensor, tol: float) -> Psf:
    """The first rung of LADDER whose kernels differ from those of the next by less than the tolerance."""
    here = _by_tolerance(batch, pixels, weights, LADDER[0], tol)
    for name in LADDER[1:]:
        above = _by_tolerance(batch, pixels, weights, name, tol)
        with torch.no_grad():
            gap = float(_kernel_change(above, here).max())
        if gap <= tol and (name == "wave" or not _diffracts(batch, pixels, above)):
            said = f"{here.model}: its kernels differ from those of {name} by {gap:.1e}, within {tol:g}"
            return dataclasses.replace(here, reason=said)
        here, below = above, here.model
    return dataclasses.replace(here, reason=f"wave: {below} differs from it by {gap:.1e}, more than {tol:g}")


def _diffracts(batch: Scene, pixels: Grid, light: Psf) -> bool:
    """Whether somewhere neither a pixel nor the blur is twice as wide as the Airy disc: rays alike prove nothing."""
    with torch.no_grad():
        airy = 1.22e-3 * batch.wavelengths.max() * first_order(batch.lens).working_f_number.max()
        blur = 2 * safe_sqrt(light.covariance[0] + light.covariance[2])
        return bool((torch.maximum(blur, pixels.pitch) < 4 * airy).any())


def _polychromatic(found: Kernels, weights: Tensor, model: str) -> Psf:
    """Sum over wavelengths by their weights; moments are those of the sum of the distributions."""
    share = weights / weights.sum()
    centroid = (share * found.centroid).sum(-1)
    offset = found.centroid - centroid[..., None]
    spread = torch.stack([offset[0] * offset[0], offset[0] * offset[1], offset[1] * offset[1]])
    kernel = (share[:, None, None] * found.kernel).sum(-3)
    centre = found.grid.centre if found.grid.centre.dim() == 1 else found.grid.centre[..., 0]
    energy = kernel.sum((-2, -1))
    return Psf(
        kernel=kernel,
        grid=dataclasses.replace(found.grid, centre=centre),
        energy=energy,
        error=torch.full_like(energy.detach(), torch.nan),
        centroid=centroid,
        covariance=(share * (found.covariance + spread)).sum(-1),
        residual=None if found.residual is None else (share * found.residual).sum(-1),
        model=model,
        rays=found.rays,
    )


def _kernel_change(one: Psf, other: Psf) -> Tensor:
    """Relative L1 difference (D, F) of two kernels, in units of the second's energy; 0 where both are empty."""
    return safe_divide((one.kernel - other.kernel).abs().sum((-2, -1)), other.energy)


def _width_change(one: Psf, other: Psf) -> Tensor:
    """Relative difference (D, F) of σ, from the larger change of the two variances, and of the energy."""
    width = other.covariance[0] + other.covariance[2]
    variance = 0.5 * safe_divide((one.covariance[::2] - other.covariance[::2]).abs().sum(0), width)
    return torch.maximum(variance, safe_divide((one.energy - other.energy).abs(), other.energy))


def _centre(batch: Scene, lens: Lens, center: str, weights: Tensor) -> Tensor | None:
    """Where the grids stand: None for the axis, else (2, D, F) mm, not differentiated: a sensor does not move."""
    if center == "axis":
        return None
    with torch.no_grad():
        if center == "centroid":
            pixel = make_grid(batch.wavelengths.new_tensor(1.0), 1)
            return _polychromatic(gaussian.kernels(batch, pixel, order=6), weights, "gaussian").centroid
        primary = lens.wavelengths[lens.primary_wavelength][None]
        rays = trace_scene(dataclasses.replace(batch, wavelengths=primary), batch.fields.new_zeros(2, 1))
        return rays.position[:2, :, :, 0, 0]


def _with_centre(base: Tensor, place: Tensor | None, wavelengths: int) -> Tensor:
    if place is None:
        return base
    centre = base.reshape(2, *(1,) * 2) + place if base.dim() == 1 else base + place
    return centre[..., None].expand(*centre.shape, wavelengths)


def _merge(finite: Psf, infinite: Psf, mask: Tensor) -> Psf:
    """Put the PSFs of finite and of infinite object distances back in their order."""

    def place(one: Tensor, other: Tensor, axis: int) -> Tensor:
        joined = torch.cat([one, other], axis)
        order = torch.argsort(torch.cat([torch.nonzero(~mask)[:, 0], torch.nonzero(mask)[:, 0]]))
        return joined.index_select(axis, order)

    centre = finite.grid.centre
    if centre.dim() > 1:
        centre = place(centre, infinite.grid.centre, 1)
    return dataclasses.replace(
        finite,
        kernel=place(finite.kernel, infinite.kernel, 0),
        grid=dataclasses.replace(finite.grid, centre=centre),
        energy=place(finite.energy, infinite.energy, 0),
        error=place(finite.error, infinite.error, 0),
        centroid=place(finite.centroid, infinite.centroid, 1),
        covariance=place(finite.covariance, infinite.covariance, 1),
        residual=None if finite.residual is None else place(finite.residual, infinite.residual, 0),
        rays=max(finite.rays, infinite.rays),
        reason="; ".join(dict.fromkeys(filter(None, (finite.reason, infinite.reason)))),
    )

"""Ladders: every PSF model as orders of growing effort, climbed until the estimated error meets a tolerance."""

import dataclasses
import functools
import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.kernels import diffraction, fourier, gaussian, paraxial, raymap, rays
from raytrace.kernels.sharing import shared
from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.value import value
from raytrace.optics.paraxial import first_order
from raytrace.optics.scene import EmptyPsf, Kernels, Scene, is_dark, varies
from raytrace.optics.spot import where_lit
from raytrace.shards import Share


class NotConverged(UserWarning):
    """A PSF whose estimated error stayed above the tolerance at the finest order there is."""


@value
class Psf:
    """PSFs over object distance × field, or object distance × field × wavelength: (D, F, W) for each (D, F) below.

    kernel: (D, F, rows, columns), integrated over pixels; summed over the wavelengths by their weights, or with an
        axis of them, (D, F, W, rows, columns).
    grid: where the pixels lie on the sensor, centre (2,) or (2, D, F) mm.
    energy: (D, F) inside the window, of the light through the entrance pupil.
    error: (D, F) estimated relative L1 error of the kernel against the model's own limit (`gaussian`: relative error
        of σ); nan where it was not estimated. How far it can be believed is measured in docs/psf_error.md.
    centroid: (2, D, F) mm; covariance: (3, D, F) xx, xy, yy in mm², of the distribution before pixel integration:
        of all its light; of "fourier" and "wave" of the light inside the window, because behind a hard edge the second
        moment grows with the window without limit. nan with gradient 0 where no ray reaches the sensor.
    ray_centroid, ray_covariance: the same of geometric optics, whatever the window: of "wave" those of the rays, of
        "fourier" of its geometric limit, of the other models again centroid and covariance.
    residual: (D, F) how wrong the model itself is, where it can tell, or None.
    model: its name; order: of its ladder, to repeat with `psf(order=…)`, None for plain rays; rays: traced for each
        kernel; reason: why `auto` chose the model, or a remark on convergence.
    normalised: "energy" (1 = all light through the entrance pupil) or "window" (each kernel sums to 1).
    wavelengths, wavelength_weights: (W,) µm and shares of 1, that the kernels are summed over or have an axis of.
    """

    kernel: Tensor
    grid: Grid
    energy: Tensor
    error: Tensor
    centroid: Tensor
    covariance: Tensor
    ray_centroid: Tensor
    ray_covariance: Tensor
    residual: Tensor | None = None
    model: str = ""
    order: int | None = None
    rays: int = 0
    reason: str = ""
    normalised: str = "energy"
    wavelengths: Tensor | None = None
    wavelength_weights: Tensor | None = None

    @property
    def wavelengths_summed(self) -> bool:
        """Whether each kernel is a sum over wavelengths; otherwise their axis is behind that of the fields."""
        return self.kernel.dim() == 4


@dataclasses.dataclass(frozen=True)
class Model:
    """A PSF model as a ladder of orders, each finer than the one before.

    kernels: (scene, grid, order=…) -> Kernels; orders: from the coarsest to the finest.
    lean: the same without the residual, where that costs time; None if it does not.
    plain: (scene, grid, rays=…) -> Kernels of that many plain rays; None if the model has an order of rays only.
    by_width: True if the error is that of σ, False if it is that of the kernel.
    proof: the error of an order is so many times its difference from the next, which is computed to prove it; None: the
        error of the finer of two orders is extrapolated from their difference, by the numbers that follow.
    first: ratio of successive changes that is taken for granted while only one change is known; None: two are needed.
    least, most: bounds on the ratios measured after that; margin: a factor on the estimate, see `_estimate`.
    unseen: share of `Kernels.residual` that counts as error: what two orders may have in common.
    shares_rays, by_field: how processes share its kernels, see `with_shares`.
    floor: what rounding leaves at least. The constants cover 95 % of the cases that docs/psf_error.md calls fitted.
    """

    kernels: Callable[..., Kernels]
    orders: Sequence[int]
    lean: Callable[..., Kernels] | None = None
    plain: Callable[..., Kernels] | None = None
    by_width: bool = False
    proof: float | None = None
    first: float | None = None
    least: float = 0.0
    most: float = 0.0
    margin: float = 1.0
    unseen: float = 0.0
    floor: float = 0.0
    shares_rays: bool = False
    by_field: bool = False


MODELS: dict[str, Model] = {
    "paraxial": Model(lambda scene, grid, order, **options: paraxial.kernels(scene, grid, **options), (0,)),
    # torch's J₀ is good to 3e-7 only.
    "fourier": Model(fourier.kernels, range(-2, 6), first=0.23, least=1e-3, most=0.5, floor=1e-7),
    "gaussian": Model(
        gaussian.kernels,
        (2, 3, 4, 5, 6, 8, 10, 12, 16, 24),
        lean=gaussian.kernels_alone,
        by_width=True,
        shares_rays=True,
        # Rings converge as fast as the lens is smooth, in leaps: what is left after one says nothing of the next.
        proof=2.0,
        least=1e-4,
        most=0.6,
        margin=2.0,
        floor=1e-11,
    ),
    # Cells halve their error with each order: no faster, whatever a lucky change says. The table of rings that round
    # light is read from (radial.py) is good to 1e-5.
    "drt": Model(
        raymap.kernels, range(11), plain=rays.kernels, first=0.6, least=0.6, most=0.6, unseen=0.15, floor=1e-5
    ),
    "wave": Model(diffraction.kernels, range(-2, 6), first=0.23, least=1e-3, most=0.5, floor=1e-7, by_field=True),
}

#: Models from the one that knows least to the one that knows most: the rungs of `model="auto"`.
LADDER = ("paraxial", "gaussian", "drt", "wave")


def with_options(options: Mapping[str, Mapping]) -> dict[str, Model]:
    """MODELS, the kernels of some with further arguments: {"paraxial": {"rho": 0.4}}."""
    models = dict(MODELS)
    for name, arguments in options.items():
        models[name] = dataclasses.replace(models[name], kernels=functools.partial(models[name].kernels, **arguments))
    return models


def with_shares(models: Mapping[str, Model], share: Share, *, kernels: int) -> dict[str, Model]:
    """The models, computed together by processes that all call them alike and all get the kernels, without gradient.

    Each process computes some of the kernels, and whole fields of a model that decides `by_field`. Rays are dealt out
    where they are plain, and where there is only one kernel, of a model that `shares_rays`. A single kernel of another
    one is not cut: every process computes it.
    """

    def of(model: Model) -> Model:
        deal = functools.partial(shared, share=share, by_field=model.by_field)
        if kernels == 1:
            deal = functools.partial(functools.partial, share=share) if model.shares_rays else lambda same: same
        return dataclasses.replace(
            model,
            kernels=deal(model.kernels),
            lean=model.lean and deal(model.lean),
            plain=model.plain and functools.partial(model.plain, share=share),
        )

    return {name: of(model) for name, model in models.items()}


def by_order(
    batch: Scene, pixels: Grid, weights: Tensor | None, models: Mapping[str, Model], model: str, order: int
) -> Psf:
    """The kernels of one order, for loops that have planned it: no error is estimated, and no residual."""
    ladder = models[model]
    if order not in ladder.orders:
        raise ValueError(f"{model} has no order {order}; expected one of {', '.join(map(str, ladder.orders))}")
    found = polychromatic((ladder.lean or ladder.kernels)(batch, pixels, order=order), weights, model)
    return dataclasses.replace(found, order=order)


def by_tolerance(
    batch: Scene, pixels: Grid, weights: Tensor | None, models: Mapping[str, Model], model: str, tol: float
) -> Psf:
    """Climb the orders until the estimated error of the last meets the tolerance; see `_estimate`."""
    ladder = models[model]
    with torch.no_grad():
        before, changes = None, []
        for order in ladder.orders:
            found = polychromatic(ladder.kernels(batch, pixels, order=order), weights, model)
            found = dataclasses.replace(found, order=order)
            if before is not None:
                changes.append(_width_change(before, found) if ladder.by_width else _kernel_change(before, found))
            rounding = _rounding(batch, pixels, found, ladder)
            if ladder.proof is not None and changes:
                error = ladder.proof * changes[-1] + rounding
                if bool((error <= tol).all()):
                    found = before
                    break
            error = _estimate(ladder, changes, found, rounding)
            if ladder.proof is None and bool((error <= tol).all()):
                break
            before = found
    reason = ""
    if not bool((error <= tol).all()):
        reason = f"{model}: the estimated error {float(error.max()):.1e} stays above the tolerance {tol:g}"
        warnings.warn(reason, NotConverged, stacklevel=4)
    residual, order = found.residual, found.order
    if torch.is_grad_enabled() and _vary(batch, pixels, weights, ladder.kernels):
        found = by_order(batch, pixels, weights, models, model, order)
    return dataclasses.replace(found, error=error, residual=residual, reason=reason)


def _vary(batch: Scene, pixels: Grid, weights: Tensor, kernels: Callable[..., Kernels]) -> bool:
    """Whether a derivative may be asked for by any number of the scene, the pixels or the model's own options."""
    options = getattr(kernels, "keywords", {})
    return any(varies(number) for number in pytree.tree_leaves((batch, pixels, weights, options)))


def _estimate(ladder: Model, changes: list[Tensor], found: Psf, rounding: Tensor) -> Tensor:
    """Estimated error (D, F) after changes δ_1 … δ_n from one order to the next; inf while too few are known.

    The geometric series δ_n ρ/(1 - ρ) times a margin, ρ the largest ratio of successive changes so far: one lucky small
    change is not believed. Added are the share of the model's residual that no change shows, and rounding.
    """
    if len(ladder.orders) == 1:
        return torch.zeros_like(found.energy)
    ratios = [safe_divide(later, earlier) for earlier, later in itertools.pairwise(changes)]
    if ratios:
        rho = torch.stack(ratios).amax(0).clamp(ladder.least, ladder.most)
    elif changes and ladder.first is not None:
        rho = torch.full_like(found.energy, ladder.first)
    else:
        return torch.full_like(found.energy, torch.inf)
    unseen = ladder.unseen * found.residual if ladder.unseen else 0.0
    return ladder.margin * changes[-1] * rho / (1 - rho) + unseen + rounding


def _rounding(batch: Scene, pixels: Grid, found: Psf, ladder: Model) -> Tensor:
    """Error (D, F) by rounding, at least the model's floor.

    Of rays: that of directions, over a focal length, in units of σ or of a pixel; inf for a σ that is rounding itself.
    In float32 the measured error is 0.02 to 0.7 of it. Waves are summed in float64 whatever they start from: there it
    is the rounding of the lens, whose image is out of focus by ε f and so blurred by ε f/2N.
    """
    paraxial = first_order(batch.lens)
    focal, f_number = (t.abs().reshape(-1)[:1] for t in (paraxial.effective_focal_length, paraxial.working_f_number))
    spread = torch.finfo(found.kernel.dtype).eps * torch.where(torch.isfinite(focal), focal, 1.0)
    if found.model in ("fourier", "wave"):
        spread = spread / (2 * torch.where(torch.isfinite(f_number), f_number, 1.0))
    width = safe_sqrt(found.covariance[0] + found.covariance[2]) if ladder.by_width else pixels.pitch
    error = safe_divide(spread, width)
    if ladder.by_width:
        error = torch.where(error > 0.3, torch.inf, error)
    return error.clamp_min(ladder.floor).expand(found.energy.shape)


def by_rays(
    batch: Scene, pixels: Grid, weights: Tensor | None, models: Mapping[str, Model], model: str, count: int
) -> Psf:
    """About `count` rays a kernel; the error is the change from half as many."""
    ladder, before = models[model], None
    if ladder.plain is not None:
        found, half = (
            polychromatic(ladder.plain(batch, pixels, rays=max(n, 1)), weights, model) for n in (count, count // 2)
        )
        return dataclasses.replace(found, error=_kernel_change(half, found).detach())
    for order in ladder.orders:
        found = polychromatic(ladder.kernels(batch, pixels, order=order), weights, model)
        if found.rays > count:
            break
        before, coarser = dataclasses.replace(found, order=order), before
    if before is None:
        raise ValueError(f"{model} needs at least {found.rays} rays a kernel; {count} given")
    if len(ladder.orders) == 1:
        return dataclasses.replace(before, error=torch.zeros_like(before.energy))
    if coarser is None:
        return before
    change = _width_change(coarser, before) if ladder.by_width else _kernel_change(coarser, before)
    return dataclasses.replace(before, error=change.detach())


def climb(batch: Scene, pixels: Grid, weights: Tensor | None, models: Mapping[str, Model], tol: float) -> Psf:
    """The first rung of LADDER whose kernels differ from those of the next by less than the tolerance."""
    here = by_tolerance(batch, pixels, weights, models, LADDER[0], tol)
    for name in LADDER[1:]:
        above = by_tolerance(batch, pixels, weights, models, name, tol)
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
        blur = 2 * safe_sqrt(light.ray_covariance[0] + light.ray_covariance[2])
        return bool((torch.maximum(blur, pixels.pitch) < 4 * airy).any())


def polychromatic(found: Kernels, weights: Tensor | None, model: str) -> Psf:
    """Sum over wavelengths by their weights, moments being those of the sum of the distributions; None keeps each."""
    own, energy = (found.centroid, found.covariance), found.kernel.sum((-2, -1))
    rays, is_geometric = found.ray_moments, found.ray_centroid is None
    kernel, residual = found.kernel, found.residual
    if weights is not None:
        share = weights / weights.sum()
        kernel = (share[:, None, None] * kernel).sum(-3)
        residual = None if residual is None else (share * residual).sum(-1)
        rays = _summed_moments(*rays, torch.where(found.dark, 0.0, share))
        # What lies inside a window counts by its light there.
        own = rays if is_geometric else _summed_moments(*own, share * energy)
        energy = kernel.sum((-2, -1))
    centre = found.grid.centre if found.grid.centre.dim() == 1 else found.grid.centre[..., 0]
    return Psf(
        kernel=kernel,
        grid=dataclasses.replace(found.grid, centre=centre),
        energy=energy,
        error=torch.full_like(energy.detach(), torch.nan),
        centroid=own[0],
        covariance=own[1],
        ray_centroid=rays[0],
        ray_covariance=rays[1],
        residual=residual,
        model=model,
        rays=found.rays,
    )


def without_dark(found: Psf, empty: str = "nan") -> Psf:
    """The PSFs with moments that are nan where no ray reaches the sensor; empty: as for `psf`."""
    rays = found.ray_centroid, found.ray_covariance
    dark = is_dark(found.kernel, *rays, found.rays, of_waves=found.model in ("fourier", "wave"))
    if empty == "error" and bool(dark.any()):
        places = ", ".join(str(tuple(place)) for place in torch.nonzero(dark)[:3].tolist())
        raise EmptyPsf(
            f"no ray reaches the sensor in {int(dark.sum())} of {dark.numel()} PSFs, those of index {places}"
        )
    centroid, covariance, *rays = where_lit(~dark, found.centroid, found.covariance, *rays, empty=empty)
    return dataclasses.replace(
        found, centroid=centroid, covariance=covariance, ray_centroid=rays[0], ray_covariance=rays[1]
    )


def _summed_moments(centroid: Tensor, covariance: Tensor, share: Tensor) -> tuple[Tensor, Tensor]:
    """Moments (2, D, F), (3, D, F) of a sum of distributions (2, D, F, W), (3, D, F, W), by shares."""
    part = safe_divide(share, share.sum(-1, keepdim=True).expand(share.shape))
    x, y = centroid
    mean_x, mean_y = (part * x).sum(-1), (part * y).sum(-1)
    x, y = x - mean_x[..., None], y - mean_y[..., None]
    spread = torch.stack([x * x, x * y, y * y])
    return torch.stack([mean_x, mean_y]), (part * (covariance + spread)).sum(-1)


def _kernel_change(one: Psf, other: Psf) -> Tensor:
    """Relative L1 difference of two kernels, in units of the second's energy; 0 where both are empty."""
    return safe_divide((one.kernel - other.kernel).abs().sum((-2, -1)), other.energy)


def _width_change(one: Psf, other: Psf) -> Tensor:
    """Relative difference (D, F) of σ, from the larger change of the two variances, and of the energy."""
    width = other.covariance[0] + other.covariance[2]
    variance = 0.5 * safe_divide((one.covariance[::2] - other.covariance[::2]).abs().sum(0), width)
    return torch.maximum(variance, safe_divide((one.energy - other.energy).abs(), other.energy))

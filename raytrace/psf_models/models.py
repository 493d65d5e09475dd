"""Table of the PSF models, and the drivers that choose the order of a model for a tolerance.

Each model gives `kernels(scene, grid, order=…) -> Kernels`, a pure function: energy integrated over pixels, 1 = all
light through the entrance pupil. Its orders form a sequence of growing accuracy. `by_tolerance` raises the order until
the estimated error meets a tolerance; `climb` does so over models (`model="auto"`).
"""

import dataclasses
import itertools
import warnings
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.budget import OverBudget
from raytrace.maths.grid import Grid
from raytrace.maths.numerics import safe_divide, safe_sqrt, varies
from raytrace.psf_models import drt, fourier, gaussian, paraxial, wave
from raytrace.psf_models.dft import TooManyPoints
from raytrace.psf_models.result import Kernels, Psf, polychromatic
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene
from raytrace.words import calling_level


@dataclasses.dataclass(frozen=True)
class Model:
    """A PSF model and its sequence of orders.

    name: as `psf` takes it; title: for tables and figures.
    kernels: (scene, grid, order=…) -> Kernels; orders: from the coarsest to the finest.
    lean: the same without the residual, where that costs time; None if it does not.
    plain: (scene, grid, rays=…) -> Kernels of independent rays; None if the model has none.
    options: further keywords of `kernels`, passed on by `psf`.
    traces: whether it traces rays, with derivatives in all numbers of the lens; otherwise it uses first-order data
    alone
        and images a field without distortion.
    waves: whether it includes diffraction: moments are those inside the window.
    is_rung: whether `model="auto"` tries it.
    row, compared: its row in `compare`, and the arguments used there.

    The error of an order is extrapolated from its changes (`by_tolerance`), unless `proof` is set:
    by_width: whether the error is that of σ, instead of the kernel.
    proof: the error of an order is this multiple of its difference from the next, which is computed.
    first: ratio of successive changes assumed while only one change is known; None: two are needed.
    least, most: bounds on the ratios measured after that; margin: factor on the estimate.
    unseen: share of `Kernels.residual` added to the error, which two orders may have in common.
    floor: smallest error, by rounding. The constants cover 95 % of the cases that docs/psf_error.md calls fitted.
    by_field: whether decisions are made for each field alone: processes then share out whole fields.
    """

    name: str
    title: str
    kernels: Callable[..., Kernels]
    orders: Sequence[int]
    lean: Callable[..., Kernels] | None = None
    plain: Callable[..., Kernels] | None = None
    options: tuple[str, ...] = ()
    traces: bool = True
    waves: bool = False
    is_rung: bool = False
    row: int = 0
    compared: Mapping = dataclasses.field(default_factory=dict)
    by_width: bool = False
    proof: float | None = None
    first: float | None = None
    least: float = 0.0
    most: float = 0.0
    margin: float = 1.0
    unseen: float = 0.0
    floor: float = 0.0
    by_field: bool = False


# fourier and wave use the same sums; torch's J₀ is accurate to 3e-7 only.
_OF_WAVES = {"waves": True, "first": 0.23, "least": 1e-3, "most": 0.5, "floor": 1e-7, "compared": {"tol": 1e-3}}

# fmt: off
_ROWS = (
    # First-order data: a Gaussian of the defocus blur.
    Model("paraxial", "paraxial", paraxial.kernels, (0,), options=("rho",), traces=False, is_rung=True, row=2),
    # The same with diffraction: a defocused (and aberrated) circular pupil.
    Model("fourier", "Fourier", fourier.kernels, range(-2, 6), options=("zernike",), traces=False, row=3, **_OF_WAVES),
    # Centroid and covariance of traced rays. Gauss rings converge irregularly: the change of one order does not predict
    # that of the next, so the error is proven.
    Model(
        "gaussian", "Gaussian DRT", gaussian.kernels, (2, 3, 4, 5, 6, 8, 10, 12, 16, 24), lean=gaussian.kernels_alone,
        is_rung=True, row=1, compared={"tol": 1e-3},
        by_width=True, proof=2.0, least=1e-4, most=0.6, margin=2.0, floor=1e-11,
    ),
    # All traced rays: geometric optics. Each order halves the error; an accidentally small change is not believed. The
    # table of rings for rotationally symmetric light (radial.py) is accurate to 1e-5.
    Model(
        "drt", "DRT", drt.kernels, range(11), plain=drt.kernels_of_rays, is_rung=True, row=0, compared={"rays": 256},
        first=0.6, least=0.6, most=0.6, unseen=0.15, floor=1e-5,
    ),
    # The traced wavefront: diffraction with the true aberrations.
    Model("wave", "wave", wave.kernels, range(-2, 6), is_rung=True, by_field=True, row=4, **_OF_WAVES),
)
# fmt: on

#: The models by name, in order of growing fidelity.
MODELS = {row.name: row for row in _ROWS}

#: The models that `model="auto"` tries in turn.
RUNGS = tuple(row.name for row in _ROWS if row.is_rung)


class NotConverged(UserWarning):
    """A PSF whose estimated error stayed above the tolerance at the finest order there is."""


def by_order(batch: Scene, pixels: Grid, weights: Tensor | None, model: Model, order: int) -> Psf:
    """The kernels of one order, without error estimate and residual: for loops."""
    if order not in model.orders:
        orders = ", ".join(map(str, model.orders))
        raise ValueError(f"{model.name} has no order {order}; expected one of {orders}")
    return _at(order, model.lean or model.kernels, batch, pixels, weights, model)


def _at(order: int, kernels: Callable[..., Kernels], batch: Scene, pixels: Grid, weights: Tensor | None, model: Model):
    found = polychromatic(kernels(batch, pixels, order=order), weights, model.name)
    return dataclasses.replace(found, order=order)


def by_tolerance(batch: Scene, pixels: Grid, weights: Tensor | None, model: Model, tol: float) -> Psf:
    """Raise the order until the estimated error meets the tolerance; see `_estimate`. Warns NotConverged."""
    with torch.no_grad():
        before, changes = None, []
        for order in model.orders:
            found = _at(order, model.kernels, batch, pixels, weights, model)
            if before is not None:
                changes.append(_change(before, found, model))
            rounding = _rounding(batch, pixels, found, model)
            if model.proof is not None and changes:
                error = model.proof * changes[-1] + rounding
                if bool((error <= tol).all()):
                    found = before
                    break
            error = _estimate(model, changes, found, rounding)
            if model.proof is None and bool((error <= tol).all()):
                break
            before = found
    reason = ""
    if not bool((error <= tol).all()):
        reason = f"{model.name}: the estimated error {float(error.max()):.1e} stays above the tolerance {tol:g}"
        warnings.warn(reason, NotConverged, stacklevel=calling_level())
    residual, order = found.residual, found.order
    # Derivatives by any number of the scene, the pixels or the model's own options.
    numbers = pytree.tree_leaves((batch, pixels, weights, getattr(model.kernels, "keywords", {})))
    if torch.is_grad_enabled() and any(varies(number) for number in numbers):
        found = by_order(batch, pixels, weights, model, order)
    return dataclasses.replace(found, error=error, residual=residual, reason=reason)


def by_rays(batch: Scene, pixels: Grid, weights: Tensor | None, model: Model, count: int) -> Psf:
    """About `count` rays per kernel; the error is the change from half as many."""
    if model.plain is not None:
        halves = (model.plain(batch, pixels, rays=n) for n in (count, max(count // 2, 1)))
        return between(*halves, weights, model)
    before, coarser = None, None
    for order in model.orders:
        found = _at(order, model.kernels, batch, pixels, weights, model)
        if found.rays > count:
            break
        before, coarser = found, before
    if before is None:
        raise ValueError(f"{model.name} needs at least {found.rays} rays a kernel; {count} given")
    if len(model.orders) == 1:
        return dataclasses.replace(before, error=torch.zeros_like(before.energy))
    return before if coarser is None else dataclasses.replace(before, error=_change(coarser, before, model).detach())


def between(found: Kernels, half: Kernels, weights: Tensor | None, model: Model) -> Psf:
    """The PSF of independent rays; its error is the change from half as many."""
    found, half = (polychromatic(kernels, weights, model.name) for kernels in (found, half))
    return dataclasses.replace(found, error=_kernel_change(half, found).detach())


def climb(batch: Scene, pixels: Grid, weights: Tensor | None, rungs: Sequence[Model], tol: float) -> Psf:
    """The first model whose kernels differ from those of the next by less than the tolerance.

    Where diffraction would need too many samples (a spectrum many pixels long), the geometric model is returned with a
    NotConverged warning.
    """
    here = by_tolerance(batch, pixels, weights, rungs[0], tol)
    for model in rungs[1:]:
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
        if gap <= tol and (model.waves or not _diffracts(batch, pixels, above)):
            reason = f"{here.model}: its kernels differ from those of {model.name} by {gap:.1e}, within {tol:g}"
            return dataclasses.replace(here, reason=reason)
        here, below = above, here.model
    return dataclasses.replace(here, reason=f"{here.model}: {below} differs from it by {gap:.1e}, more than {tol:g}")


def _diffracts(batch: Scene, pixels: Grid, light: Psf) -> bool:
    """Whether any pixel and blur are both narrower than two Airy discs: agreement of ray models then proves nothing."""
    with torch.no_grad():
        airy = 1.22e-3 * batch.wavelengths.max() * axial_f_number(batch.lens).max()
        blur = 2 * safe_sqrt(light.ray_covariance[0] + light.ray_covariance[2])
        return bool((torch.maximum(blur, pixels.pitch) < 4 * airy).any())


def _estimate(model: Model, changes: list[Tensor], found: Psf, rounding: Tensor) -> Tensor:
    """Estimated error (D, F) after changes δ_1 … δ_n between orders; inf while too few are known.

    The geometric series δ_n ρ/(1 - ρ) times a margin, ρ the largest ratio of successive changes so far, so that a
    single small change is not believed; plus the share of the residual that no change shows, and rounding.
    """
    if len(model.orders) == 1:
        return torch.zeros_like(found.energy)
    ratios = [safe_divide(later, earlier) for earlier, later in itertools.pairwise(changes)]
    if ratios:
        rho = torch.stack(ratios).amax(0).clamp(model.least, model.most)
    elif changes and model.first is not None:
        rho = torch.full_like(found.energy, model.first)
    else:
        return torch.full_like(found.energy, torch.inf)
    unseen = model.unseen * found.residual if model.unseen else 0.0
    return model.margin * changes[-1] * rho / (1 - rho) + unseen + rounding


def _rounding(batch: Scene, pixels: Grid, found: Psf, model: Model) -> Tensor:
    """Error (D, F) by rounding, at least the model's floor.

    Of rays: the rounding of directions over a focal length, in units of σ or of a pixel; inf if σ itself is rounding.
    In float32 the measured error is 0.02 to 0.7 of it. Waves are summed in float64: the rounding is that of the lens
    data, whose image is defocused by ε f and so blurred by ε f/2N.
    """
    paraxial = first_order(batch.lens)
    focal, f_number = (
        t.abs().reshape(-1)[:1] for t in (paraxial.effective_focal_length, paraxial.paraxial_working_f_number)
    )
    spread = torch.finfo(found.kernel.dtype).eps * torch.where(torch.isfinite(focal), focal, 1.0)
    if model.waves:
        spread = spread / (2 * torch.where(torch.isfinite(f_number), f_number, 1.0))
    width = safe_sqrt(found.covariance[0] + found.covariance[2]) if model.by_width else pixels.pitch
    error = safe_divide(spread, width)
    if model.by_width:
        error = torch.where(error > 0.3, torch.inf, error)
    return error.clamp_min(model.floor).expand(found.energy.shape)


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

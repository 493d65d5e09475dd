"""One call for every PSF model, driven by a tolerance instead of a number of rays."""

import dataclasses

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.kernels import gaussian
from raytrace.kernels.ladder import (
    MODELS,
    Psf,
    by_order,
    by_rays,
    by_tolerance,
    climb,
    polychromatic,
    with_options,
    with_shares,
    without_dark,
)
from raytrace.maths.grid import Grid
from raytrace.maths.grid import grid as make_grid
from raytrace.maths.numerics import safe_divide
from raytrace.maths.pupil import gauss_rings
from raytrace.optics.losses import beam_hint, losses
from raytrace.optics.reuse import Memo
from raytrace.optics.scene import EmptyPsf, Scene, scene, trace_scene
from raytrace.shards import Share
from raytrace.system.lens import Lens, with_object_distance


def psf(
    lens: Lens,
    model: str = "auto",
    *,
    fields: Tensor | None = None,
    object_distances: Tensor | None = None,
    wavelengths: Tensor | None = None,
    wavelength_weights: Tensor | None = None,
    grid: Grid | None = None,
    center: str | None = None,
    tol: float | None = None,
    rays: int | None = None,
    order: int | None = None,
    normalise: str = "energy",
    per_wavelength: bool = False,
    rho: Tensor | float = 0.5,
    zernike: Tensor | None = None,
    memo: Memo | None = None,
    share: Share | None = None,
    empty: str = "nan",
) -> Psf:
    """PSFs of a lens, differentiable in every number of the lens, its sensor distance and the grid.

    model: a key of MODELS, or "auto".
    fields: (2, F) in the lens's kind of field, its own by default; object_distances: (D,) mm, inf allowed, the lens's
    by default; wavelengths: (W,) µm with wavelength_weights: (W,), the lens's own by default. Kernels are summed over
    the wavelengths; per_wavelength: each has a kernel instead, (D, F, W, rows, columns) of energy 1 for all its light.
    grid: pixels, by default 21 × 21 of 5 µm, its centre (2,) or (2, D, F); center: what the grid's centre counts from:
    "axis", "chief" (the chief ray at the primary wavelength) or "centroid" (of the rays). By default "axis" for fields
    that are given and "chief" for the lens's own.
    tol: bound on the estimated error, 0.01 by default; the coarsest order that meets it is returned. rays: instead,
    about that many rays per kernel (`drt`: plain Sobol rays), the error then estimated from half of them.
    order: instead, an order of the model's ladder, as `Psf.order` of an earlier call tells it: for loops, it estimates
    nothing.
    normalise: "energy" (1 = all light through the entrance pupil) or "window".
    rho: of `paraxial`, σ over the blur radius. zernike: of `fourier`, Noll coefficients from 1 on, mm RMS of path.
    memo: rays of earlier calls, which are not traced again where nothing before them has changed.
    share: of this process (`shards.share()`), if all processes call psf alike to compute the kernels together; each
    gets all of them, equal to those of one process to rounding, without gradient.
    empty: what a PSF of a batch is that no ray reaches: "nan", its kernel 0 and its moments nan, all with gradient 0,
    or "error". Raises ValueError for arguments that make no sense, EmptyPsf if no ray at all reaches the sensor. Warns
    NotConverged.
    """
    center = default_center(fields) if center is None else center
    _check(model, center, normalise, tol=tol, rays=rays, order=order)
    fields = torch.stack([lens.fields.x, lens.fields.y]) if fields is None else fields
    distances = lens.surfaces[0].thickness.reshape(1) if object_distances is None else object_distances
    weights = lens.wavelength_weights if wavelengths is None else None
    weights = wavelength_weights if wavelength_weights is not None else weights
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    weights = torch.ones_like(wavelengths) if weights is None else weights
    _check_batch(fields, distances, wavelengths, weights)
    base = make_grid(wavelengths.new_tensor(0.005), 21) if grid is None else grid
    models = with_options({"paraxial": {"rho": rho}, "fourier": {"zernike": zernike}})
    if share is not None and share.processes > 1:
        _check_shares(lens, rho, zernike)
        models = with_shares(models, share, kernels=len(distances) * fields.shape[1] * len(wavelengths))
    drive = {
        "auto": lambda *scene: climb(*scene, models, tol or 0.01),
        "order": lambda *scene: by_order(*scene, models, model, order),
        "rays": lambda *scene: by_rays(*scene, models, model, rays),
        "tol": lambda *scene: by_tolerance(*scene, models, model, tol or 0.01),
    }["auto" if model == "auto" else "order" if order is not None else "rays" if rays is not None else "tol"]
    shares = weights / weights.sum()
    kept = None if per_wavelength else shares

    def compute(chosen: Tensor) -> Psf:
        centre = base.centre[:, chosen] if base.centre.dim() > 1 else base.centre
        own = dataclasses.replace(base, centre=centre)
        return drive(*_group(lens, fields, distances[chosen], wavelengths, shares, own, center, memo), kept)

    infinite = torch.isinf(distances)
    if bool(infinite.any()) and not bool(infinite.all()):
        found = _merge(compute(~infinite), compute(infinite), infinite)
    else:
        found = compute(torch.ones_like(infinite))
    # Only traced light can be lost; light beside the window is not.
    if found.rays and not bool((found.energy > 0).any()) and not bool((found.ray_covariance != 0).any()):
        raise EmptyPsf(f"no ray reaches the sensor: {_lost(lens, fields, distances, wavelengths)}")
    if normalise == "window":
        found = dataclasses.replace(found, kernel=_of_its_window(found.kernel), normalised="window")
    return dataclasses.replace(without_dark(found, empty), wavelengths=wavelengths, wavelength_weights=shares)


def _lost(lens: Lens, fields: Tensor, distances: Tensor, wavelengths: Tensor) -> str:
    """Where the rays of the first field and wavelength end, and what to do about a beam too wide."""
    lens = with_object_distance(lens, distances[0].detach())
    points = gauss_rings(6, dtype=fields.dtype, device=fields.device)[0]
    found = losses(lens, points, fields=fields[:, :1].detach(), wavelengths=wavelengths[:1].detach())
    return "; ".join(filter(None, (found.words(0, 0), beam_hint(lens))))


def default_center(fields: Tensor | None) -> str:
    """What windows are centred on by default: the axis for fields that are given, and else, of the lens's own fields,
    which may lie far from it, the chief ray.
    """
    return "chief" if fields is None else "axis"


def _of_its_window(kernel: Tensor) -> Tensor:
    """Kernels (..., rows, columns) that sum to 1, or are 0; over their brightest pixel first: where a window holds next
    to no light, the square of its sum, by which a derivative is divided, would be no number.
    """
    scaled = safe_divide(kernel, kernel.detach().amax((-2, -1), keepdim=True))
    return safe_divide(scaled, scaled.sum((-2, -1), keepdim=True))


def _check(model: str, center: str, normalise: str, *, tol: float | None, rays: int | None, order: int | None) -> None:
    if model != "auto" and model not in MODELS:
        raise ValueError(f"model {model!r} is not known; expected auto, {', '.join(MODELS)}")
    if center not in ("axis", "chief", "centroid"):
        raise ValueError(f"center {center!r} is not known; expected axis, chief or centroid")
    if normalise not in ("energy", "window"):
        raise ValueError(f"normalise {normalise!r} is not known; expected energy or window")
    if tol is not None and rays is not None:
        raise ValueError("tol and rays exclude each other: a tolerance chooses the number of rays")
    if order is not None and (tol is not None or rays is not None or model == "auto"):
        raise ValueError("order belongs to one model and excludes tol and rays: an order says how much work is done")
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


def _check_shares(*numbers) -> None:
    """What processes cannot share: derivatives, and options that differ between kernels."""
    leaves = [leaf for leaf in pytree.tree_leaves(numbers) if isinstance(leaf, Tensor)]
    if torch.is_grad_enabled() and any(leaf.requires_grad for leaf in leaves):
        raise ValueError("kernels that processes share have no gradient: leave share out, or use torch.no_grad()")
    if any(isinstance(option, Tensor) and option.dim() > 1 for option in numbers):
        raise ValueError("processes share kernels of one rho and one zernike only: leave share out")


def _group(lens, fields, distances, wavelengths, weights, base, center, memo) -> tuple[Scene, Grid]:
    """The scene and the pixels of object distances (D,) that are all finite or all infinite."""
    batch = scene(lens, fields, distances, wavelengths, memo)
    place = _centre(batch, lens, center, weights)
    return batch, dataclasses.replace(base, centre=_with_centre(base.centre, place, len(wavelengths)))


def _centre(batch: Scene, lens: Lens, center: str, weights: Tensor) -> Tensor | None:
    """Where the grids stand: None for the axis, else (2, D, F) mm, not differentiated: a sensor does not move."""
    if center == "axis":
        return None
    with torch.no_grad():
        if center == "centroid":
            pixel = make_grid(batch.wavelengths.new_tensor(1.0), 1)
            return polychromatic(gaussian.kernels_alone(batch, pixel, order=6), weights, "gaussian").centroid
        primary = lens.wavelengths[lens.primary_wavelength][None]
        rays = trace_scene(dataclasses.replace(batch, wavelengths=primary), batch.fields.new_zeros(2, 1))
        return rays.position[:2, :, :, 0, 0]


def _with_centre(base: Tensor, place: Tensor | None, wavelengths: int) -> Tensor:
    """A base (2,) or (2, D, F), counted from a place, for all wavelengths; a base that is one point stays it."""
    if place is None and base.dim() == 1:
        return base
    centre = base if base.dim() > 1 else base.reshape(2, 1, 1)
    centre = centre if place is None else centre + place
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
        ray_centroid=place(finite.ray_centroid, infinite.ray_centroid, 1),
        ray_covariance=place(finite.ray_covariance, infinite.ray_covariance, 1),
        residual=None if finite.residual is None else place(finite.residual, infinite.residual, 0),
        rays=max(finite.rays, infinite.rays),
        reason="; ".join(dict.fromkeys(filter(None, (finite.reason, infinite.reason)))),
    )

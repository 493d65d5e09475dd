"""Wavefront: optical path to the reference sphere, without ever subtracting two long paths.

A longer path is a positive OPD: light with OPD growing towards +y lands towards +y.
"""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.maths import zernike
from raytrace.maths.numerics import Number, dot, root, safe_divide, safe_sqrt, unit, value
from raytrace.maths.sampling import gauss_rings
from raytrace.system.lens import media
from raytrace.system.rays import Rays
from raytrace.tracing.base_ray import base_ray
from raytrace.tracing.clear_pupil import arms_of, is_clipped
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene, beam_share, trace_scene
from raytrace.tracing.spot import where_lit
from raytrace.tracing.trace import is_bent, without_apertures

_WORST_CONDITION = 1e4  # of a fit of Zernike polynomials: beyond, its coefficients say nothing of the pupil


@value
class Wavefront:
    """OPD over the pupil of every object distance, field and wavelength of a scene.

    opd: (D, F, W, P) mm of optical path against the chief ray's; 0 where no ray arrives.
    direction: (3, D, F, W, P) unit vectors from the reference sphere to its centre; L and M are the coordinates of the
        diffraction integral.
    energy: (D, F, W, P) share of the entrance pupil's light that each ray carries to the sensor; 0 if lost.
    landing: (2, D, F, W, P) mm, where rays meet the sensor, from the centre.
    valid: (D, F, W, P) bool; usable: also rays that were only vignetted.
    pupil: (2, P) or (2, D, F, W, P) fractions of the entrance pupil before vignetting factors, Zernike's coordinates.
    weights: of the pupil points, mean over the disc.
    centre: (3, D, F, W) mm on the sensor, the chief ray's point; radius: (D, F, W) mm of the sphere, along the chief
        ray from the plane of the exit pupil to the image, inf for a telecentric lens, negative for a pupil behind it.
    wavelength: (W,) µm; index: (W,) of the image space.
    """

    opd: Tensor
    direction: Tensor
    energy: Tensor
    landing: Tensor
    valid: Tensor
    usable: Tensor
    pupil: Tensor
    weights: Tensor
    centre: Tensor
    radius: Tensor
    wavelength: Tensor
    index: Tensor


def path_to_reference_sphere(rays: Number, centre: Number, curvature: Number, index: Number) -> Number:
    """Reduced path W (...) in mm of rays up to the reference sphere they are about to cross; OPD = W - W_chief.

        W = W_rays + n [ κ e²/(1 + √(1 - κ² e²)) - (P - Q)·d ],   e = |(P - Q) - ((P - Q)·d) d|

    less n/κ of the axial ray, so that no long path is ever formed (Hopkins' equally inclined chord).
    rays: with `opl`; centre Q: (3, ...) mm in the frame of the rays; curvature κ: 1/mm, 0 for a plane; index n behind.
    Tensors, or vectors of dual numbers.
    """
    offset = rays.position - centre
    along = dot(offset, rays.direction)
    across = offset - rays.direction * along
    e_squared = dot(across, across)
    bend = curvature * e_squared
    return rays.opl + index * (bend / (1 + root(1 - curvature * bend)) - along)


def towards_centre(rays: Number, centre: Number, curvature: Number) -> Number:
    """Unit vectors (3, ...) from where rays cross the reference sphere to its centre, (Q - q)/R.

    s = √(1 - κ² e²) d - κ e: the ray's own direction for a plane. Arguments as for `path_to_reference_sphere`.
    """
    offset = rays.position - centre
    across = (offset - rays.direction * dot(offset, rays.direction)) * curvature
    return rays.direction * root(1 - dot(across, across)) - across


def wavefront_of(
    scene: Scene, pupil: Tensor, weights: Tensor | None = None, *, reference: Tensor | None = None
) -> Wavefront:
    """The wavefront of a scene at pupil points, on the sphere about the chief ray's point of the sensor.

    pupil: (2, P), or (2, D, F, W, P) where every kernel has its own points (axes of length 1 broadcast);
    weights: (P,) or (D, F, W, P), shares of the disc's area, equal by default. Every share carries equal light.
    reference: () µm, the wavelength whose sphere serves all; by default each has that of its own chief ray. The OPD
    is against the wavelength's own chief ray in either case.
    The chief ray goes through the centre of the (vignetted) pupil, blocked or not; where it cannot be traced, the mean
    of the rays that arrive takes its place.
    """
    weights = torch.full_like(pupil[0], 1.0) / pupil.shape[-1] if weights is None else weights
    with_chief = torch.cat([torch.zeros_like(pupil[..., :1]), pupil], -1)
    rays, usable = _on_sensor(scene, with_chief)
    if reference is None:
        centre, radius = _reference_sphere(scene, rays, usable)
    else:
        alone = dataclasses.replace(scene, wavelengths=reference.reshape(1), memo=None)
        common = with_chief if pupil.dim() == 2 else with_chief[:, :, :, :1]
        centre, radius = _reference_sphere(alone, *_on_sensor(alone, common))
    index = media(scene.lens, scene.wavelengths)[-2]
    path = path_to_reference_sphere(rays, centre, 1 / radius, index[:, None])
    opd = torch.where(rays.valid, path - _at_chief(path, rays.valid, usable), 0.0)
    direction = towards_centre(rays, centre, 1 / radius)
    landing = torch.where(usable, rays.position[:2] - centre[:2], 0.0)
    energy = torch.where(rays.valid[..., 1:], weights * beam_share(scene)[..., None], 0.0)
    return Wavefront(
        opd=opd[..., 1:],
        direction=direction[..., 1:],
        energy=energy,
        landing=landing[..., 1:],
        valid=rays.valid[..., 1:],
        usable=usable[..., 1:],
        pupil=pupil,
        weights=weights,
        centre=centre[..., 0].expand(3, *scene.shape),
        radius=radius[..., 0].expand(scene.shape),
        wavelength=scene.wavelengths,
        index=index,
    )


def clear_wavefront(scene: Scene, rings: int, arms: int, *, reference: Tensor | None = None) -> Wavefront:
    """The wavefront at points that integrate over the clear pupil: `rms` of it is that of all light that arrives.

    Gauss rings and arms where every ray of the scene arrives, else nodes on the clear parts of the arms, see
    `tracing.clear_pupil`, whose edges move with the lens: derivatives are those of the integral. reference: as for
    `wavefront_of`.
    """
    points, weights = gauss_rings(rings, arms, dtype=scene.wavelengths.dtype, device=scene.wavelengths.device)
    front = wavefront_of(scene, points, weights, reference=reference)
    if scene.everywhere(front.valid.all()) and not is_clipped(scene):
        return front
    return wavefront_of(scene, *arms_of(scene, arms).rule(rings), reference=reference)


def _on_sensor(scene: Scene, with_chief: Tensor) -> tuple[Rays, Tensor]:
    """Rays of pupil points, the chief ray first, and which of them reach the sensor, vignetted or not."""
    rays = trace_scene(scene, with_chief)
    if is_bent(scene.lens):
        # Behind turned axes coordinates do not show which rays would arrive if nothing vignetted them.
        if not any(surface.apertures for surface in scene.lens.surfaces):
            return rays, rays.valid
        with torch.no_grad():
            unclipped = dataclasses.replace(scene, lens=without_apertures(scene.lens), memo=None)
            return rays, rays.valid | trace_scene(unclipped, with_chief).valid
    usable = rays.valid | (rays.position != 0).any(0) | (rays.direction[:2] != 0).any(0)
    # A chief ray along the axis has the numbers of a failed ray, but is valid.
    on_axis = (scene.fields == 0).all(0)[..., None, None] & (with_chief[..., :1] == 0).all(0)
    return rays, torch.cat([usable[..., :1] | on_axis, usable[..., 1:]], -1)


def _at_chief(quantity: Tensor, valid: Tensor, usable: Tensor) -> Tensor:
    """The chief ray's value, or the mean where there is no chief ray; keeps the axis of rays."""
    others = torch.where(valid, quantity, 0.0).sum(-1, keepdim=True)
    mean = safe_divide(others, valid.sum(-1, keepdim=True).to(quantity.dtype))
    return torch.where(usable[..., :1], quantity[..., :1], mean)


def _reference_sphere(scene: Scene, rays: Rays, usable: Tensor) -> tuple[Tensor, Tensor]:
    """Centre (3, D, F, W, 1) mm, the chief ray's point of the sensor, and signed radius (D, F, W, 1) mm.

    The radius runs along the chief ray from the plane of the paraxial exit pupil, or, where the axis bends, from that
    across the base ray halfway between the images of the stop; inf for a pupil at infinity.
    """
    centre = _at_chief(rays.position, rays.valid, usable)
    direction = unit(_at_chief(rays.direction, rays.valid, usable))
    if is_bent(scene.lens):
        return centre, _from_bent_pupil(scene, centre, direction)
    N = direction[2]
    pupil = first_order(scene.lens).exit_pupil_position[..., None]
    finite = torch.isfinite(pupil) & (N != 0)
    along = (centre[2] - torch.where(finite, pupil, 0.0)) / torch.where(finite, N, 1.0)
    return centre, torch.where(finite & (along != 0), along, torch.inf)


def _from_bent_pupil(scene: Scene, centre: Tensor, direction: Tensor) -> Tensor:
    """Radius (D, F, W, 1) mm along chief rays from the plane across the base ray at the mean vergence of both pupils.

    R = ((C - B)·b - z)/(d·b),  z = 2/(1/z_t + 1/z_s) the place of the pupil along the base ray B + z b
    """
    base = base_ray(scene.lens)
    tangential, sagittal = base.exit_pupil_position
    place = safe_divide(2 * tangential, 1 + tangential / sagittal)
    place = torch.where(torch.isinf(tangential), 2 * sagittal, place)
    vertex, along = (vector[..., None] for vector in (base.position, base.direction))
    slant = dot(direction, along)
    finite = base.valid[..., None] & torch.isfinite(place)[..., None] & (slant != 0)
    ahead = dot(centre - vertex, along) - torch.where(finite, place[..., None], 0.0)
    radius = ahead / torch.where(finite, slant, 1.0)
    return torch.where(finite & (radius != 0), radius, torch.inf)


def rms(wavefront: Wavefront, *, empty: str = "nan") -> Tensor:
    """RMS of the OPD about its mean (D, F, W), mm; empty: its value where no light arrives, see `spot_of`."""
    share = _share(wavefront)
    centred = torch.where(wavefront.valid, wavefront.opd - (share * wavefront.opd).sum(-1, keepdim=True), 0.0)
    return where_lit(_is_lit(wavefront), safe_sqrt((share * centred * centred).sum(-1)), empty=empty)[0]


def peak_to_valley(wavefront: Wavefront, *, empty: str = "nan") -> Tensor:
    """Largest less smallest OPD (D, F, W), mm, over the rays that arrive; empty: as for `rms`."""
    highest = torch.where(wavefront.valid, wavefront.opd, -torch.inf).amax(-1)
    lowest = torch.where(wavefront.valid, wavefront.opd, torch.inf).amin(-1)
    lit = wavefront.valid.any(-1)
    return where_lit(lit, torch.where(lit, highest - lowest, 0.0), empty=empty)[0]


def zernike_coefficients(
    wavefront: Wavefront, count: int = 37, numbering: str = "noll", *, empty: str = "nan"
) -> Tensor:
    """Coefficients 1 … count (D, F, W, count) in mm, fitted to the rays that arrive.

    numbering: "noll", of polynomials that are 1 in RMS, or "fringe", of polynomials that are 1 at the rim.
    empty: their value where the light fills too little of the entrance pupil to separate them (a fit would enlarge
    the least deviation ten thousand times, as in the middle 0.55 of the radius), see `spot_of`.
    Raises ValueError for another numbering.
    """
    if numbering not in zernike.NUMBERINGS:
        raise ValueError(f"Zernike terms by {numbering!r}: expected one of {', '.join(zernike.NUMBERINGS)}")
    order_of, unity = zernike.NUMBERINGS[numbering]
    orders = [order_of(j) for j in range(1, count + 1)]
    basis = _basis(wavefront, orders)
    terms, known = zernike.fit_known(wavefront.opd, basis, wavefront.energy, worst=_WORST_CONDITION)
    terms = terms * terms.new_tensor([zernike.norm(*order) for order in orders]) if unity == "rim" else terms
    return where_lit(known[..., None], terms, empty=empty)[0]


def without(wavefront: Wavefront, count: int) -> Tensor:
    """OPD (D, F, W, P) in mm less its best Noll terms 1 … count: 1 piston, 3 also tilt, 4 also focus."""
    basis = _basis(wavefront, [zernike.noll(j) for j in range(1, count + 1)])
    fitted = torch.einsum("...j,j...p->...p", zernike.fit(wavefront.opd, basis, wavefront.energy), basis)
    return torch.where(wavefront.valid, wavefront.opd - fitted, 0.0)


def _basis(wavefront: Wavefront, orders: Sequence[zernike.Order]) -> Tensor:
    return zernike.polynomials(orders, *wavefront.pupil)


def _is_lit(wavefront: Wavefront) -> Tensor:
    return wavefront.energy.sum(-1) != 0


def _share(wavefront: Wavefront) -> Tensor:
    return safe_divide(wavefront.energy, wavefront.energy.sum(-1, keepdim=True))

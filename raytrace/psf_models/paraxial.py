"""Paraxial PSF: the defocus of a thin lens, as a Gaussian."""

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import detached, is_wrapped, safe_divide
from raytrace.maths.sampling import Grid
from raytrace.psf_models.gaussian import gaussian_pixels
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens, media
from raytrace.system.surface import is_round
from raytrace.tracing.base_ray import base_ray
from raytrace.tracing.launch import is_at_infinity, object_field
from raytrace.tracing.paraxial import axial_beam, chief_ray, first_order, signed, system_matrix
from raytrace.tracing.scene import Scene, is_on_axis
from raytrace.tracing.trace import Bent, is_bent, need_axis

_ALIKE = 1e-3  # of the power: sections that differ by less have one focus


def kernels(scene: Scene, grid: Grid, *, order: int = 0, rho: float | Tensor = 0.5) -> Kernels:
    """Isotropic Gaussians of σ = ρ ε around the paraxial chief ray, with all the light of the entrance pupil.

    order: 0, the only one; rho: 0.5 gives the second moment per axis of a uniform disc of radius ε. In focus σ is 0 and
    so is its gradient: the Gaussian's energy moves between pixels with σ², so nothing is lost.
    Raises Bent for a lens whose axis bends, or whose powers along x and y differ.
    """
    need_one_focus(scene.lens, "the paraxial PSF model", "take model=gaussian, drt or wave, which trace rays")
    sigma = rho * blur_radius(scene)
    variance = (sigma * sigma).expand(scene.shape)
    centroid = chief_ray_height(scene)
    kernel = gaussian_pixels(grid, centroid, torch.stack([variance, variance]))
    covariance = torch.stack([variance, torch.zeros_like(variance), variance])
    return Kernels(kernel, grid, centroid, covariance, rays=0, arrived=torch.ones_like(variance))


def need_one_focus(lens: Lens, what: str, instead: str) -> None:
    """Raise Bent for a lens without one axis, or with different powers along x and y; words as for `need_axis`."""
    need_axis(lens, what, instead)
    if has_one_focus(lens):
        return
    number = next(k for k, surface in enumerate(lens.surfaces) if not is_round(surface))
    raise Bent(f"{what} needs one focus, but surface {number} has different powers along x and y; {instead}")


def has_one_focus(lens: Lens) -> bool:
    """Whether a lens has one axis, and the same power along x and y."""
    if is_bent(lens):
        return False
    numbers = pytree.tree_leaves(lens)
    if all(map(is_round, lens.surfaces)) or any(map(is_wrapped, numbers)):
        return True
    with torch.no_grad():
        tangential, sagittal = 1 / base_ray(detached(lens)).focal_length.flatten(1)
    largest = torch.maximum(tangential.abs(), sagittal.abs())
    return bool(((tangential - sagittal).abs() <= _ALIKE * largest).all())


def blur_radius(scene: Scene) -> Tensor:
    """ε = R |1 - z_i (1/f - 1/z_o)|, (D, 1, W) mm; derivative 0 in focus.

    R: radius of the entrance pupil; z_i: from the rear principal plane to the sensor, z_o: from the object to the
    front one, both along the light. In media other than air 1/z_o is multiplied by n/n′.
    """
    lens = scene.lens
    wavelengths = scene.wavelengths
    paraxial = first_order(lens, wavelengths)
    n = signed(lens.surfaces[1:-1], media(lens, wavelengths)[:-1])
    z_i = torch.sign(n[-1]) * (lens.surfaces[-2].thickness - paraxial.rear_principal_plane)
    z_o = lens.surfaces[0].thickness + paraxial.front_principal_plane
    vergence = safe_divide((n[0] / n[-1].abs()).expand_as(z_o), z_o)
    defocus = 1 - z_i * (1 / paraxial.effective_focal_length - vergence)
    return 0.5 * paraxial.entrance_pupil_diameter * defocus.abs()


def chief_ray_height(scene: Scene) -> Tensor:
    """Where the paraxial ray through the centre of the entrance pupil meets the sensor, (2, D, F, W) mm."""
    lens, wavelengths = scene.lens, scene.wavelengths
    if is_on_axis(scene):
        return wavelengths.new_zeros(2, *scene.shape)
    beam = axial_beam(lens)
    field, _ = object_field(lens, scene.fields[..., None], beam)
    distance, pupil = lens.surfaces[0].thickness, beam.entrance_pupil_position
    n = signed(lens.surfaces[1:-1], media(lens, wavelengths)[:-1])
    A, B, C, D = system_matrix(lens.surfaces[1:-1], n, wavelengths)
    to_sensor = lens.surfaces[-2].thickness / n[-1]
    at_infinity, telecentric, heights = is_at_infinity(lens), lens.fields.telecentric, []
    for extent in field:
        y, slope = chief_ray(
            extent, at_infinity=at_infinity, distance=distance, entrance_pupil=pupil, parallel=telecentric
        )
        omega = n[0] * slope
        heights.append((A * y + B * omega + to_sensor * (C * y + D * omega)).expand(scene.shape))
    return torch.stack(heights)

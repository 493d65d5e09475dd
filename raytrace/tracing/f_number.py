"""The F/# of the real cone of light."""

import torch
from torch import Tensor

from raytrace.system.lens import Lens, media
from raytrace.tracing.base_ray import base_ray
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.spot import image_rays
from raytrace.tracing.trace import is_bent


def working_f_number(lens: Lens) -> Tensor:
    """1/(2 n′ sin θ′) of the real marginal ray of the axial object point at the primary wavelength, ().

    The ray passes the rim of the (aimed) pupil; θ′, its angle to the axis behind the lens, determines diffraction and
    illuminance. `FirstOrder.paraxial_working_f_number` has the slope of the paraxial ray. inf where it runs along
    the axis, nan where it is lost. Where the axis bends θ′ is half the angle between two rays of opposite rims.
    """
    wavelength = lens.primary[None]
    n_image = media(lens, wavelength)[-2]
    if is_bent(lens):
        rims = lens.wavelengths.new_tensor([[0.0, 0.0], [1.0, -1.0]])
        rays = image_rays(lens, rims, fields=torch.zeros_like(rims[:, :1]), wavelengths=wavelength)
        step = rays.direction[:, 0, 0, 0] - rays.direction[:, 0, 0, 1]
        number = 1 / (n_image[0] * torch.linalg.vector_norm(step))
        return torch.where(rays.valid.all(), number, torch.nan)
    rim = lens.wavelengths.new_tensor([[0.0], [1.0]])
    rays = image_rays(lens, rim, fields=torch.zeros_like(rim), wavelengths=wavelength)
    L, M, _ = rays.direction[:, 0, 0, 0]
    return torch.where(rays.valid[0, 0, 0], 0.5 / (n_image * torch.hypot(L, M))[0], torch.nan)


def axial_f_number(lens: Lens) -> Tensor:
    """1/(2 n′ |u′|) (...) of the paraxial rays of the axial object point at the primary wavelength.

    Where the axis bends, of rays close to the base ray: the geometric mean of both sections, that of the ellipse that
    light fills; that of one where the other is parallel.
    """
    if not is_bent(lens):
        return first_order(lens).paraxial_working_f_number
    tangential, sagittal = base_ray(lens).paraxial_working_f_number
    both = torch.isfinite(tangential) & torch.isfinite(sagittal)
    mean = torch.sqrt(torch.where(both, tangential * sagittal, 1.0))
    return torch.where(both, mean, torch.minimum(tangential, sagittal))

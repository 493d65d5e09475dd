"""The F/# of the real cone of light."""

import torch
from torch import Tensor

from raytrace.optics.focus import image_rays
from raytrace.optics.trace import media
from raytrace.system.lens import Lens


def real_working_f_number(lens: Lens) -> Tensor:
    """1/(2 n′ sin θ′) of the real marginal ray of the axial object point at the primary wavelength, ().

    The ray goes through the rim of the (aimed) pupil, θ′ is its angle to the axis behind the lens: what diffraction and
    light depend on, where `FirstOrder.working_f_number` has the slope of the paraxial ray. inf where it runs along the
    axis, nan where it is lost.
    """
    rim = lens.wavelengths.new_tensor([[0.0], [1.0]])
    wavelength = lens.wavelengths[lens.primary_wavelength][None]
    rays = image_rays(lens, rim, fields=torch.zeros_like(rim), wavelengths=wavelength)
    n_image = media(lens, wavelength)[-2]
    L, M, _ = rays.direction[:, 0, 0, 0]
    found = 0.5 / (n_image * torch.hypot(L, M))[0]
    return torch.where(rays.valid[0, 0, 0], found, torch.nan)

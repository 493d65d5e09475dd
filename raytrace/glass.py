"""Glass: dispersion formulas and the media that use them.  (SKELETON: the glass helper owns and completes this file.)"""

import torch
from torch import Tensor

from raytrace.value import value


@value
class Glass:
    """A refracting medium: a dispersion formula with its coefficients.

    name: as written in the lens file, "" for air.
    formula: key of FORMULAS ("constant", "model", "schott", "sellmeier_1", ...), or "mirror".
    coefficients: (m, ...) of the formula, float64.
    catalog: name of the catalog the glass came from, "" if none.
    wavelength_range: µm (shortest, longest) or None.
    """

    name: str
    formula: str
    coefficients: Tensor
    catalog: str = ""
    wavelength_range: tuple[float, float] | None = None


def constant(index: float | Tensor, name: str = "") -> Glass:
    """A medium of one refractive index at every wavelength."""
    return Glass(name, "constant", torch.as_tensor(index, dtype=torch.float64).reshape(1))


AIR = constant(1.0)
MIRROR = Glass("MIRROR", "mirror", torch.ones(1, dtype=torch.float64))

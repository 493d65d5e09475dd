"""Aim: the camera that an element is made for, and the path that brings one point to its sensor."""

import math

import torch
from torch import Tensor

from raytrace.maths.value import value

#: How steep a sphere may be, (R/z)², for its series to be worth summing.
_STEEPEST = 0.8


@value
class Aim:
    """What an element is to do: bring a point on the axis to the sensor, through an aperture, at one wavelength.

    radius: of the aperture, mm; sensor, focus: distances of the sensor and of the point, mm (focus may be infinite);
    wavelength: of the design, µm. exact: true spheres instead of their parabolas.
    """

    radius: Tensor
    sensor: Tensor
    focus: Tensor
    wavelength: Tensor
    exact: bool = False


def aim(
    *,
    radius: float | Tensor = 2.5,
    sensor: float | Tensor = 35.5,
    focus: float | Tensor = 1000.0,
    wavelength: float | Tensor = 0.55,
    exact: bool = False,
) -> Aim:
    """The Aim of these numbers, by default f/7.1 at 1 m. Raises ValueError for one that is not positive and finite."""
    numbers = {"radius": radius, "sensor": sensor, "focus": focus, "wavelength": wavelength}
    for name, number in numbers.items():
        if not number > 0 or (name != "focus" and not number < math.inf):
            unit = "µm" if name == "wavelength" else "mm"
            raise ValueError(f"the {name} is {float(number):g} {unit}; expected a positive number")
    found = (n if isinstance(n, Tensor) else torch.tensor(n, dtype=torch.float64) for n in numbers.values())
    return Aim(*found, exact=exact)


def converging(aim: Aim, focus: Tensor | None = None) -> Tensor:
    """Coefficients c_k (K,) mm^(1 - 2k) of the path Σ_k c_k r^(2k) that brings a point at `focus` mm to the sensor.

        -(1/z_f + 1/z_s) r²/2,   exact: -Σ_z (√(r² + z²) - z) = -Σ_z Σ_k (½ choose k) r^(2k)/z^(2k - 1)

    The series ends where its terms at the rim fall below 1e-13 z. focus: that of the aim by default.
    Raises ValueError where a true sphere is steeper than its series can follow.
    """
    vergences = 1 / torch.stack([aim.focus if focus is None else focus.to(aim.sensor), aim.sensor])
    if not aim.exact:
        return -0.5 * vergences.sum(0, keepdim=True)
    k = torch.arange(1, _terms(aim.radius, vergences) + 1).to(vergences)
    binomial = torch.cumprod((1.5 - k) / k, 0)
    return -(binomial * vergences[:, None] ** (2 * k - 1)).sum(0)


def _terms(radius: Tensor, vergences: Tensor) -> int:
    steepness = float((radius * vergences.max()).detach()) ** 2
    if steepness > _STEEPEST:
        nearest = float(1 / vergences.detach().max())
        raise ValueError(
            f"a sphere around a point {nearest:g} mm away is too steep over an aperture of {float(radius):g} mm: "
            f"expected at least {1 / math.sqrt(_STEEPEST):.2f} radii, or the paraxial form (exact=False)"
        )
    return max(2, math.ceil(math.log(1e-13) / math.log(steepness)))

"""RMS over the field: of the wavefront, of each wavelength and of all together, or of the spot."""

import math

import torch
from torch import Tensor

from raytrace.analysis.fans import REFERENCES
from raytrace.analysis.setting import field_range, scene_of, wavelength_weights
from raytrace.maths.numerics import safe_sqrt
from raytrace.maths.pupil import gauss_rings
from raytrace.maths.result import Result, axis
from raytrace.maths.value import value
from raytrace.optics.focus import image_rays
from raytrace.optics.spot import spot_of, spot_of_points
from raytrace.optics.wavefront import rms, wavefront_of
from raytrace.system.lens import Lens

_RINGS = 10, 40
QUANTITIES = ("wavefront", "spot")


@value
class RmsOverField(Result):
    """RMS of every field: `rms` (F, W) of each wavelength, `polychromatic` (F,) of all by their weights.

    Of the wavefront: waves about the mean; of the spot: mm about the centroid. nan where no light arrives.
    strehl: (F,) Σ w exp(-(2π σ)²) of the wavefronts that make `polychromatic` (Mahajan 1983); None of spots.
    fields: (2, F); wavelengths: (W,) µm; quantity: one of QUANTITIES; reference: that of the polychromatic wavefront.
    """

    rms: Tensor
    polychromatic: Tensor
    strehl: Tensor | None
    fields: Tensor
    wavelengths: Tensor
    quantity: str
    reference: str

    def columns(self) -> dict[str, Tensor]:
        return {
            "field_x": axis(self.fields[0], 0, 2),
            "field_y": axis(self.fields[1], 0, 2),
            "wavelength": axis(self.wavelengths, 1, 2),
            "rms": self.rms,
        }

    def summary(self) -> dict[str, Tensor]:
        """The columns of a table with a row for every field."""
        table = {"field_x": self.fields[0], "field_y": self.fields[1], "polychromatic": self.polychromatic}
        return table if self.strehl is None else {**table, "strehl": self.strehl}


def rms_over_field(
    lens: Lens,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    size: int = 21,
    quantity: str = "wavefront",
    reference: str = "primary",
    pupil: tuple[Tensor, Tensor] | None = None,
) -> RmsOverField:
    """RMS wavefront error, or RMS spot radius, over the field.

    Each wavelength by itself is judged on the sphere about its own chief ray. Together they are √(Σ w σ²) on one
    sphere, that of the lens's primary wavelength (reference "primary": lateral colour counts, as in OpticStudio's RMS
    vs. field) or each on its own ("own"). Spots together are one spot about its own centroid.
    fields: (2, F), by default `size` from the axis to the lens's largest; wavelengths: (W,) µm; pupil: points (2, P)
    and weights (P,), Gauss rings by default. Raises ValueError for another quantity or reference.
    """
    for word, known in ((quantity, QUANTITIES), (reference, REFERENCES)):
        if word not in known:
            raise ValueError(f"{word!r}: expected one of {', '.join(known)}")
    fields = field_range(lens, size) if fields is None else fields
    like = {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}
    points, weights = gauss_rings(*_RINGS, **like) if pupil is None else pupil
    shares = wavelength_weights(lens, wavelengths)
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    if quantity == "spot":
        rays = image_rays(lens, points, fields=fields, wavelengths=wavelengths)
        joint = (shares[:, None] * weights).flatten()
        whole = spot_of_points(rays.position[:2].flatten(2), rays.valid.flatten(1), joint).rms_radius
        return RmsOverField(spot_of(rays, weights).rms_radius, whole, None, fields, wavelengths, quantity, reference)
    view = scene_of(lens, fields, wavelengths)
    waves = 1e-3 * wavelengths
    each = rms(wavefront_of(view, points, weights))[0] / waves
    primary = lens.wavelengths[lens.primary_wavelength]
    joint = each if reference == "own" else rms(wavefront_of(view, points, weights, reference=primary))[0] / waves
    together = (shares * joint * joint).sum(-1)
    return RmsOverField(
        rms=each,
        polychromatic=torch.where(together.isnan(), torch.nan, safe_sqrt(together)),
        strehl=(shares * torch.exp(-((2 * math.pi * joint) ** 2))).sum(-1),
        fields=fields,
        wavelengths=wavelengths,
        quantity=quantity,
        reference=reference,
    )

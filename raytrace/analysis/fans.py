"""Fans: transverse ray aberration and OPD along the two principal sections of the pupil."""

import torch
from torch import Tensor

from raytrace.analysis.setting import scene_of
from raytrace.maths.pupil import fan as pupil_fan
from raytrace.maths.result import Result, axis, masked
from raytrace.maths.value import value
from raytrace.optics.wavefront import Wavefront, wavefront_of
from raytrace.system.lens import Lens

#: Whose sphere an OPD is measured on.
REFERENCES = ("primary", "own")


@value
class Fan(Result):
    """Aberration over the pupil of every field and wavelength.

    tangential: (F, W, P) over pupil y at x = 0; sagittal: (F, W, P) over pupil x at y = 0; 0 where no ray arrives.
        Of a ray fan: ε_y and ε_x in mm from the chief ray of the primary wavelength; of an OPD fan: waves.
    tangential_valid, sagittal_valid: (F, W, P) bool.
    pupil: (P,) from -1 to 1; fields: (2, F); wavelengths: (W,) µm; quantity: "ray" or "opd".
    """

    tangential: Tensor
    sagittal: Tensor
    tangential_valid: Tensor
    sagittal_valid: Tensor
    pupil: Tensor
    fields: Tensor
    wavelengths: Tensor
    quantity: str

    def columns(self) -> dict[str, Tensor]:
        return {
            "field_x": axis(self.fields[0], 0, 3),
            "field_y": axis(self.fields[1], 0, 3),
            "wavelength": axis(self.wavelengths, 1, 3),
            "pupil": axis(self.pupil, 2, 3),
            "tangential": masked(self.tangential, self.tangential_valid),
            "sagittal": masked(self.sagittal, self.sagittal_valid),
        }


def ray_fan(lens: Lens, *, fields: Tensor | None = None, wavelengths: Tensor | None = None, size: int = 41) -> Fan:
    """Transverse aberrations ε = (x, y) of a ray less the primary wavelength's chief ray on the sensor, mm.

    size: rays across the pupil, odd to have the chief ray among them. The primary wavelength is the lens's, asked for
    or not.
    """
    front = _front(lens, fields, wavelengths, size, "primary")
    return _fan(lens, fields, front, front.landing[1], front.landing[0], "ray")


def opd_fan(
    lens: Lens,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    size: int = 41,
    reference: str = "primary",
) -> Fan:
    """OPD in waves against the chief ray of each wavelength; `size` as for `ray_fan`.

    reference: the sphere, "primary": about the point of the lens's primary wavelength for all, so that lateral colour
    shows as tilt and axial colour as defocus; "own": about each wavelength's own point, which takes lateral colour out.
    """
    front = _front(lens, fields, wavelengths, size, reference)
    waves = front.opd / (1e-3 * front.wavelength[:, None])
    return _fan(lens, fields, front, waves, waves, "opd")


def _front(lens: Lens, fields: Tensor | None, wavelengths: Tensor | None, size: int, reference: str) -> Wavefront:
    """The wavefront of both fans, the one along y first."""
    if reference not in REFERENCES:
        raise ValueError(f"reference {reference!r}: expected one of {', '.join(REFERENCES)}")
    like = {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}
    points = torch.cat([pupil_fan(size, along, **like)[0] for along in "yx"], 1)
    primary = lens.wavelengths[lens.primary_wavelength] if reference == "primary" else None
    return wavefront_of(scene_of(lens, fields, wavelengths), points, reference=primary)


def _fan(lens, fields, front: Wavefront, along_y: Tensor, along_x: Tensor, quantity: str) -> Fan:
    size = front.pupil.shape[1] // 2
    valid = front.valid[0]
    along_y, along_x = (torch.where(valid, part[0], 0.0) for part in (along_y, along_x))
    return Fan(
        tangential=along_y[..., :size],
        sagittal=along_x[..., size:],
        tangential_valid=valid[..., :size],
        sagittal_valid=valid[..., size:],
        pupil=front.pupil[1, :size],
        fields=torch.stack([lens.fields.x, lens.fields.y]) if fields is None else fields,
        wavelengths=front.wavelength,
        quantity=quantity,
    )

"""Fans: transverse ray aberration and OPD along the two principal sections of the pupil."""

import torch
from torch import Tensor

from raytrace.analysis.frame import Tabular, axis, masked
from raytrace.analysis.setting import primary_number, scene_of
from raytrace.lens import Lens
from raytrace.pupil import fan as pupil_fan
from raytrace.value import value
from raytrace.wavefront import Wavefront, wavefront


@value
class Fan(Tabular):
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

    size: rays across the pupil, odd to have the chief ray among them.
    """
    front = _front(lens, fields, wavelengths, size)
    reference = front.centre[:2, ..., primary_number(lens, wavelengths), None, None]
    missed = front.landing + front.centre[:2, ..., None] - reference
    return _fan(lens, fields, front, missed[1], missed[0], "ray")


def opd_fan(lens: Lens, *, fields: Tensor | None = None, wavelengths: Tensor | None = None, size: int = 41) -> Fan:
    """OPD in waves, each wavelength on the sphere about its own chief ray's point; `size` as for `ray_fan`."""
    front = _front(lens, fields, wavelengths, size)
    waves = front.opd / (1e-3 * front.wavelength[:, None])
    return _fan(lens, fields, front, waves, waves, "opd")


def _front(lens: Lens, fields: Tensor | None, wavelengths: Tensor | None, size: int) -> Wavefront:
    """The wavefront of both fans, the one along y first."""
    like = {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}
    points = torch.cat([pupil_fan(size, along, **like)[0] for along in "yx"], 1)
    return wavefront(scene_of(lens, fields, wavelengths), points)


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

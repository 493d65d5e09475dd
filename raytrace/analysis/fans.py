"""Fans: transverse ray aberration and OPD along the two principal sections of the pupil."""

from typing import Literal

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.panels import by_wavelength, drawn_at_least, field_labels, finished, ruled, seen
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import Numbers, Points, like, primary_wavelength, scene_of, setting
from raytrace.maths.numerics import safe_divide, value
from raytrace.maths.result import Column, masked
from raytrace.maths.sampling import fan as pupil_fan
from raytrace.plotting.style import GREY, Figure, array, new_figure, styled
from raytrace.system.lens import Lens
from raytrace.tracing.spot import chief_arrives, image_rays
from raytrace.tracing.wavefront import Wavefront, wavefront_of

#: Wavelengths whose chief ray centres the reference sphere of an OPD.
REFERENCES = ("primary", "own")
_UNIT = {"ray": "mm", "opd": "waves"}


@value
class Fan(Analysis):
    """Aberration over the pupil of every field and wavelength.

    tangential: (F, W, P) over pupil y at x = 0; sagittal: (F, W, P) over pupil x at y = 0; 0 where no ray arrives.
        Of a ray fan: ε_y and ε_x in mm from the chief ray of the primary wavelength; of an OPD fan: waves.
    tangential_valid, sagittal_valid: (F, W, P) bool.
    pupil: (P,) from -1 to 1; fields: (2, F); quantity: "ray" or "opd".
    """

    lens: Lens
    fields: Tensor
    pupil: Tensor
    tangential: Tensor
    sagittal: Tensor
    tangential_valid: Tensor
    sagittal_valid: Tensor
    quantity: str

    EVERY = 5
    COMMAND = property(lambda self: f"{self.quantity}-fan")
    COLUMNS = property(lambda self: [Column(name, _UNIT[self.quantity]) for name in ("tangential", "sagittal")])

    def columns(self) -> dict[str, Tensor]:
        tangential = masked(self.tangential, self.tangential_valid)
        sagittal = masked(self.sagittal, self.sagittal_valid)
        heads = self.heads(wavelength=self.wavelengths, pupil=self.pupil)
        return {**heads, "tangential": tangential, "sagittal": sagittal}

    @styled
    def draw(self) -> Figure:
        """A row for each field: the tangential fan on the left, the sagittal one on the right, one scale for all."""
        labels, ray = field_labels(self), self.quantity == "ray"
        figure = new_figure(6.6, 1.45 * len(labels) + 1.1)
        axes = figure.subplots(len(labels), 2, sharex=True, sharey=True, squeeze=False)
        shown = [seen(self.tangential, self.tangential_valid), seen(self.sagittal, self.sagittal_valid)]
        for (row, column), panel in np.ndenumerate(axes):
            values = (1e3 if ray else 1.0) * shown[column][row].T
            by_wavelength(ruled(panel), self, array(self.pupil), values, linewidth=1.2)
            panel.axhline(0, color=GREY, linewidth=0.6)
            panel.axvline(0, color=GREY, linewidth=0.6)
        for panel, label in zip(axes[:, 0], labels, strict=True):
            panel.set_ylabel(label)
        axes[0][0].set_title("tangential" + (": ε$_y$ over pupil y" if ray else ": over pupil y"))
        axes[0][1].set_title("sagittal" + (": ε$_x$ over pupil x" if ray else ": over pupil x"))
        for panel in axes[-1]:
            panel.set_xlim(-1, 1)
            panel.set_xlabel("pupil coordinate")
        figure.supylabel("transverse aberration (µm)" if ray else "OPD (waves)", fontsize=8.5)
        drawn_at_least(axes.flat, 1e-3 if ray else 1e-4, "y")
        return finished(axes[0][0], self, "ray fans" if ray else "OPD fans", len(self.wavelengths))


def ray_fan(lens: Lens, *, fields: Points = None, wavelengths: Numbers = None, points: int = 41) -> Fan:
    """Transverse aberrations ε = (x, y) of a ray less the primary wavelength's chief ray on the sensor, mm.

    fields: y or (x, y) in the lens's kind of field; wavelengths: µm, the first one primary; points: rays across the
    pupil, odd to have the chief ray among them.
    """
    lens, fields = setting(lens, fields, wavelengths)
    return ray_fan_of(lens, fields, points)


def ray_fan_of(lens: Lens, fields: Tensor, points: int) -> Fan:
    """The ray fan of fields (2, F), which need not be in reach. Where no chief ray arrives, the mean of the rays of the
    primary wavelength takes its place."""
    pupil = _pupil(lens, points)
    rays = image_rays(lens, torch.cat([torch.zeros_like(pupil[:, :1]), pupil], 1), fields=fields)
    hits, valid = rays.position[:2], rays.valid
    primary = slice(lens.primary_wavelength - 1, lens.primary_wavelength)
    lit = valid[:, primary]
    total = torch.where(lit, hits[:, :, primary], 0.0).sum(-1)
    arrives = chief_arrives(lens, rays, fields, lens.wavelengths)[:, primary]
    centre = torch.where(arrives, hits[:, :, primary, 0], safe_divide(total, lit.sum(-1).to(total.dtype)))
    x, y = (hits - centre[..., None])[..., 1:]
    return _fan(lens, fields, pupil, valid[..., 1:], y, x, "ray")


def opd_fan(
    lens: Lens,
    *,
    fields: Points = None,
    wavelengths: Numbers = None,
    points: int = 41,
    reference: Literal["primary", "own"] = "primary",
) -> Fan:
    """OPD in waves against the chief ray of each wavelength; arguments as for `ray_fan`.

    points: rays across the pupil; reference: the sphere, "primary": about the point of the primary wavelength for all,
    so that lateral colour shows as tilt and axial colour as defocus; "own": about each wavelength's own point, which
    takes lateral colour out.
    """
    lens, fields = setting(lens, fields, wavelengths)
    front = _front(lens, fields, points, reference)
    waves = front.opd / (1e-3 * front.wavelength[:, None])
    return _fan(lens, fields, front.pupil, front.valid[0], waves[0], waves[0], "opd")


def _front(lens: Lens, fields: Tensor, size: int, reference: str) -> Wavefront:
    """The wavefront of both fans."""
    if reference not in REFERENCES:
        raise ValueError(f"reference {reference!r}: expected one of {', '.join(REFERENCES)}")
    primary = primary_wavelength(lens) if reference == "primary" else None
    return wavefront_of(scene_of(lens, fields), _pupil(lens, size), reference=primary)


def _pupil(lens: Lens, size: int) -> Tensor:
    """Points (2, 2 size) of both fans, the one along y first."""
    return torch.cat([pupil_fan(size, along, **like(lens))[0] for along in "yx"], 1)


def _fan(
    lens: Lens, fields: Tensor, pupil: Tensor, valid: Tensor, along_y: Tensor, along_x: Tensor, quantity: str
) -> Fan:
    size = pupil.shape[1] // 2
    along_y, along_x = (torch.where(valid, part, 0.0) for part in (along_y, along_x))
    return Fan(
        lens=lens,
        fields=fields,
        pupil=pupil[1, :size],
        tangential=along_y[..., :size],
        sagittal=along_x[..., size:],
        tangential_valid=valid[..., :size],
        sagittal_valid=valid[..., size:],
        quantity=quantity,
    )

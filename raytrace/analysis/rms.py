"""RMS over the field: of the wavefront, of each wavelength and of all together, or of the spot."""

import math
from functools import partial
from typing import Literal

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.fans import REFERENCES
from raytrace.analysis.panels import by_wavelength, chart, field_axis, field_name, finished
from raytrace.analysis.result import OverField
from raytrace.analysis.setting import Numbers, Points, primary_wavelength, scene_of, setting, wavelength_shares
from raytrace.maths.numerics import safe_sqrt, value
from raytrace.maths.result import Column, Table
from raytrace.maths.sampling import SAMPLINGS
from raytrace.plotting.style import GREY, INK, Figure, array, styled
from raytrace.system.lens import Lens
from raytrace.tracing.clear_pupil import clear_pupil
from raytrace.tracing.spot import image_rays, spot_of, spot_of_points
from raytrace.tracing.wavefront import clear_wavefront, rms, wavefront_of

_RINGS = 10, 40


@value
class RmsOverField(OverField):
    """RMS of every field: `rms` (F, W) of each wavelength, `polychromatic` (F,) of all by their weights.

    Of the wavefront: waves about the mean; of the spot: mm about the centroid. nan where no light arrives.
    strehl: (F,) Σ w exp(-(2π σ)²) of the wavefronts that make `polychromatic` (Mahajan 1983); None of spots.
    fields: (2, F); reference: of the polychromatic wavefront; pupil: points (2, P) and weights (P,) of the rays,
    None of the clear pupil.
    """

    lens: Lens
    fields: Tensor
    rms: Tensor
    polychromatic: Tensor
    strehl: Tensor | None
    reference: str
    pupil: tuple[Tensor, Tensor] | None

    COMMAND = "rms-over-field"
    COLUMNS = (
        Column("rms", "waves"), Column("strehl", "", ".4f", "Strehl"),
        Column("polychromatic", "waves", heading="all, weighted"),
        Column("polychromatic_um", "µm", heading="all, weighted"),
    )  # fmt: skip

    @property
    def quantity(self) -> str:
        """The quantity of the RMS, "wavefront" or "spot"."""
        return "spot" if self.strehl is None else "wavefront"

    def columns(self) -> dict[str, Tensor]:
        return {**self.heads(wavelength=self.wavelengths), **self._listed("rms")}

    def _listed(self, name: str) -> dict[str, Tensor]:
        """The column of a number that is stored: waves, µm of spots."""
        return {name: getattr(self, name)} if self.strehl is not None else {f"{name}_um": 1e3 * getattr(self, name)}

    def about(self) -> dict[str, str]:
        return {"quantity": self.quantity, "reference": self.reference}

    def summary(self) -> dict[str, Tensor]:
        table = {**self.heads(), **self._listed("polychromatic")}
        return table if self.strehl is None else {**table, "strehl": self.strehl}

    def tables(self) -> list[Table]:
        """A row for each field, a column for each wavelength."""
        ((name, rms),), summary = self._listed("rms").items(), self.summary()
        strehl = {"strehl": summary.pop("strehl")} if "strehl" in summary else {}
        return [Table({**summary, **self.by_wavelength(rms, self.column(name).unit), **strehl})]

    def at(self, fields: Tensor) -> "RmsOverField":
        return rms_of_fields(self.lens, fields, self.quantity == "spot", self.reference, self.pupil)

    @styled
    def draw(self) -> Figure:
        """RMS over the field: all wavelengths together in black, each in its colour; Maréchal's limit dotted."""
        curves = self.drawn()
        waves = curves.quantity == "wavefront"
        quantity = "RMS wavefront error" if waves else "RMS spot radius"
        panel = chart(5.6, 3.8, field_name(curves.lens), f"{quantity} ({'waves' if waves else 'µm'})")
        order = np.argsort(field_axis(curves))
        field, scale = field_axis(curves)[order], 1.0 if waves else 1e3
        by_wavelength(panel, curves, field, scale * array(curves.rms)[order], linewidth=1.2)
        if len(curves.wavelengths) > 1:
            together = scale * array(curves.polychromatic)[order]
            panel.plot(field, together, color=INK, linewidth=1.6, label="all, weighted")
        if waves:
            panel.axhline(1 / 14, color=GREY, linewidth=0.8, linestyle=":", label="λ/14")
        panel.set_ylim(bottom=0)
        if field.max() > field.min():
            panel.set_xlim(field.min(), field.max())
        return finished(panel, curves, quantity, 5)


def rms_over_field(
    lens: Lens,
    *,
    fields: Points = None,
    wavelengths: Numbers = None,
    samples: int = 11,
    spot: bool = False,
    reference: Literal["primary", "own"] = "primary",
    pupil: tuple[Tensor, Tensor] | None = None,
) -> RmsOverField:
    """RMS wavefront error, or with `spot` RMS spot radius, over the field.

    Each wavelength by itself is judged on the sphere about its own chief ray. Together they are √(Σ w σ²) on one
    sphere, that of the primary wavelength (reference "primary": lateral colour counts, as in OpticStudio's RMS vs.
    field) or each on its own ("own"). Spots together are one spot about its own centroid. fields: y or (x, y), by
    default `samples` from the axis to the lens's largest; wavelengths: µm; spot: RMS spot radius about the centroid
    instead; reference: centres of the reference spheres of the wavelengths together, the "primary" one's chief ray, so
    that lateral colour counts, or each one's "own"; pupil: points (2, P) and weights (P,) of rays, of
    which those that arrive count; by default light is integrated over the clear pupil, up to its edges. Raises
    ValueError for another reference.
    """
    if reference not in REFERENCES:
        raise ValueError(f"reference {reference!r}: expected one of {', '.join(REFERENCES)}")
    lens, fields = setting(lens, fields, wavelengths, samples=samples)
    return rms_of_fields(lens, fields, spot, reference, pupil)


def rms_of_fields(
    lens: Lens, fields: Tensor, spot: bool, reference: str, pupil: tuple[Tensor, Tensor] | None = None
) -> RmsOverField:
    """As `rms_over_field` of fields (2, F) of a lens that is set and whose rays are known to arrive."""
    shares = wavelength_shares(lens)
    if spot:
        rings = SAMPLINGS["gauss"][2]  # as of `spot`
        points, weights = clear_pupil(lens, fields=fields, rings=rings, arms=4 * rings) if pupil is None else pupil
        rays = image_rays(lens, points, fields=fields)
        joint = (shares[:, None] * weights).flatten(-2)
        whole = spot_of_points(rays.position[:2].flatten(2), rays.valid.flatten(1), joint).rms_radius
        return RmsOverField(lens, fields, spot_of(rays, weights).rms_radius, whole, None, reference, pupil)
    view, waves = scene_of(lens, fields), 1e-3 * lens.wavelengths
    front_of = partial(clear_wavefront, view, *_RINGS) if pupil is None else partial(wavefront_of, view, *pupil)
    each = joint = rms(front_of())[0] / waves
    if reference == "primary":
        joint = rms(front_of(reference=primary_wavelength(lens)))[0] / waves
    together = (shares * joint * joint).sum(-1)
    polychromatic = torch.where(together.isnan(), torch.nan, safe_sqrt(together))
    strehl = (shares * torch.exp(-((2 * math.pi * joint) ** 2))).sum(-1)
    return RmsOverField(lens, fields, each, polychromatic, strehl, reference, pupil)

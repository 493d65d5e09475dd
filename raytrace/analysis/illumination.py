"""Relative illumination: how much light a field's cone brings to the sensor, against the axis."""

import math

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.panels import chart, few, field_axis, field_name, finished, marks
from raytrace.analysis.result import OverField, shown
from raytrace.analysis.setting import Numbers, Points, like, refuse_axis, scene_of, setting, wavelength_shares
from raytrace.maths import zernike
from raytrace.maths.numerics import safe_divide, value
from raytrace.maths.sampling import gauss_rings
from raytrace.plotting.style import GREY, Figure, array, field_colour, styled
from raytrace.system.lens import Lens
from raytrace.tracing.clear_pupil import arms_of, is_clipped
from raytrace.tracing.wavefront import wavefront_of

_RINGS = 24, 96
_CLEAR = 12, 96  # rings and arms of a clipped pupil
_WORST_CONDITION = 1e8  # of the fit of that map
_TERMS = 45  # Zernike terms (to degree 8) of the map from the pupil to directions


@value
class RelativeIllumination(OverField):
    """Relative illumination over the field.

    illumination: (F,), 1 on the axis; projected_solid_angle: (F,) sr; fields: (2, F).
    marked: whether the fields were specified, and are marked on the curve.
    """

    lens: Lens
    fields: Tensor
    illumination: Tensor
    projected_solid_angle: Tensor
    marked: bool = False

    COMMAND = "relative-illumination"

    def columns(self) -> dict[str, Tensor]:
        return {
            **self.heads(),
            "illumination": self.illumination,
            "projected_solid_angle": self.projected_solid_angle,
        }

    def at(self, fields: Tensor) -> "RelativeIllumination":
        return _illumination(self.lens, fields)

    @styled
    def draw(self) -> Figure:
        """Relative illumination over the field, and cos⁴θ where fields are angles. Requested fields are marked."""
        curves = self.drawn()
        panel = chart(5.4, 3.6, field_name(curves.lens), "relative illumination")
        order = np.argsort(field_axis(curves), kind="stable")
        field, values = field_axis(curves)[order], array(curves.illumination)[order]
        look = {"color": field_colour(0), "linewidth": 1.5, "clip_on": False, "zorder": 3, **few(field)}
        panel.plot(field, values, label="this lens", **look)
        if self.marked:
            marks(panel, field_axis(self), array(self.illumination), field_colour(0))
        if curves.lens.fields.kind == "angle":
            fine = np.linspace(0, field.max(), 100)
            panel.plot(fine, np.cos(np.deg2rad(fine)) ** 4, color=GREY, linewidth=1.0, linestyle=":", label="cos⁴θ")
        panel.set(xlim=(0, field.max() or 1.0), ylim=(0, 1.05 * max(1.0, values.max())))
        return finished(panel, curves, "relative illumination", 2)


def relative_illumination(
    lens: Lens, *, fields: Points = None, wavelengths: Numbers = None, samples: int = 11
) -> RelativeIllumination:
    """E(field)/E(axis) of a uniformly bright object (Lambertian), without losses in glass:

        E = B ∬ dL dM = B π Σ_j w_j |∂(L, M)/∂p|_j      over the rays that arrive

    (L, M) the directions from the reference sphere at the exit pupil to the chief ray's point (Born & Wolf §4.8.3): the
    pupil as the sensor sees it, whatever the aberrations. fields: y or (x, y); by default `samples` from the axis to
    the lens's largest; wavelengths: µm. A clipped beam is integrated up to its edge (`tracing.clear_pupil`), whose
    motion the derivatives include; where an obscuration or a polygon clips, to about 1e-3.
    """
    asked = fields is not None
    lens, fields = setting(lens, fields, wavelengths, samples=samples)
    if not asked:
        refuse_axis(fields)
    return shown(_illumination(lens, fields, marked=asked))


def _illumination(lens: Lens, fields: Tensor, *, marked: bool = False) -> RelativeIllumination:
    points, weights = gauss_rings(*_RINGS, **like(lens))
    scene = scene_of(lens, torch.cat([torch.zeros_like(fields[:, :1]), fields], 1))
    front = wavefront_of(scene, points, weights)
    orders = [zernike.noll(j) for j in range(1, _TERMS + 1)]
    basis, usable = zernike.polynomials(orders, *points), front.usable
    # Fields without a lost ray share their weights, hence one factorisation.
    light = weights.expand(1, 1, 1, -1) if bool(usable.all()) else torch.where(usable, weights, 0.0)
    # Where light comes through a small part of the pupil alone, the slopes of the map are not known from it.
    fitted, known = zernike.fit_known(front.direction[:2], basis, light, worst=_WORST_CONDITION)
    lit = front.valid
    if not bool(front.valid.all()) and is_clipped(scene, points):
        points, weights = arms_of(scene, _CLEAR[1]).rule(_CLEAR[0])
        lit = torch.ones_like(weights, dtype=torch.bool)
        slopes = (slope.movedim(0, -2) for slope in zernike.gradients(orders, *points))
        (L_x, M_x), (L_y, M_y) = ((fitted[..., None, :] @ slope)[..., 0, :] for slope in slopes)
    else:
        (L_x, M_x), (L_y, M_y) = (fitted @ slope for slope in zernike.gradients(orders, *points))
    jacobian = (L_x * M_y - L_y * M_x).abs()
    angle = math.pi * torch.where(lit & known[..., None], weights * jacobian, 0.0).sum(-1)[0]
    angle = torch.where(known[0] | ~front.valid[0].any(-1), angle, torch.nan)
    solid = (angle * wavelength_shares(lens)).sum(-1)
    return RelativeIllumination(lens, fields, safe_divide(solid[1:], solid[:1].expand_as(solid[1:])), solid[1:], marked)

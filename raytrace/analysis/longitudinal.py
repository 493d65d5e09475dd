"""Longitudinal aberration: where rays of an axial object point cross the axis, over the pupil."""

import torch
from torch import Tensor

from raytrace.analysis.panels import by_wavelength, chart, drawn_at_least, finished, seen
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import Numbers, like
from raytrace.budget import RAY_BYTES, afford
from raytrace.maths.numerics import safe_divide, value
from raytrace.maths.result import axis, masked
from raytrace.plotting.style import GREY, Figure, array, styled
from raytrace.system.lens import Lens, with_wavelengths
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.spot import image_rays
from raytrace.tracing.trace import need_axis

_NEAR_AXIS = 1e-4  # of the pupil: the ray that replaces the central one leaves 1e-8 of the spherical aberration


@value
class LongitudinalAberration(Analysis):
    """Crossings (W, P) with the axis, mm along z from the sensor, of rays at heights `pupil` (P,) from 0 to 1.

    The first one is the paraxial focus of each wavelength. valid: (W, P) bool, whether there is a crossing.
    """

    lens: Lens
    pupil: Tensor
    crossing: Tensor
    valid: Tensor

    COMMAND = "longitudinal-aberration"
    EVERY = 5

    def columns(self) -> dict[str, Tensor]:
        return {
            "wavelength": axis(self.wavelengths, 0, 2),
            "pupil": axis(self.pupil, 1, 2),
            "crossing": masked(self.crossing, self.valid),
        }

    @styled
    def draw(self) -> Figure:
        """Crossings with the axis over the height in the pupil, drawn upwards."""
        panel = chart(4.2, 4.4, "crossing with the axis, from the sensor (mm)", "height in the pupil")
        by_wavelength(panel, self, seen(self.crossing, self.valid).T, array(self.pupil), linewidth=1.4)
        panel.axvline(0, color=GREY, linewidth=0.6)
        panel.set_ylim(0, 1)
        panel.locator_params(axis="x", nbins=6)
        drawn_at_least([panel], 1e-6, "x")
        return finished(panel, self, "longitudinal aberration", 3)


def longitudinal_aberration(lens: Lens, *, wavelengths: Numbers = None, points: int = 41) -> LongitudinalAberration:
    """Spherical aberration of every wavelength as -y N/M of rays (0, M, N) through points of the pupil's y axis.

    wavelengths: µm; points: rays from the axis to the rim of the pupil. A ray parallel to the axis behind the lens has
    no crossing, nor has a lost one. Raises Bent for a lens whose axis bends.
    """
    need_axis(lens, "longitudinal aberration", "`field_curvature` and `ray_fan` follow the chief ray")
    lens = lens if wavelengths is None else with_wavelengths(lens, wavelengths)
    count = points * len(lens.wavelengths)
    afford(RAY_BYTES * count, f"{count:,} rays", helps="ask for fewer {points}")
    pupil = torch.linspace(0.0, 1.0, points, **like(lens))
    heights = torch.cat([torch.full_like(pupil[:1], _NEAR_AXIS), pupil[1:]])
    on_axis = torch.stack([torch.zeros_like(heights), heights])
    field = torch.zeros_like(on_axis[:, :1])
    warn_of_filling(lens, field)
    rays = image_rays(lens, on_axis, fields=field)
    _, M, N = rays.direction[:, 0]
    crossing = -safe_divide(rays.position[1, 0] * N, M)
    return LongitudinalAberration(lens, pupil, crossing, rays.valid[0] & (M != 0))

"""Chromatic focal shift: where each wavelength has its paraxial focus."""

import torch
from torch import Tensor

from raytrace.analysis.panels import chart, drawn_at_least, finished
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import NothingToShow, Numbers, like, primary_wavelength
from raytrace.budget import RAY_BYTES, afford
from raytrace.maths.numerics import value
from raytrace.plotting.style import FAINT, GREY, INK, Figure, array, number_text, styled, wavelength_colours
from raytrace.system.lens import Lens, check_media, with_wavelengths
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.trace import side_behind
from raytrace.words import option


@value
class ChromaticFocalShift(Analysis):
    """Paraxial foci of wavelengths (W,) µm: shift (W,) mm from that of the lens's primary one.

    depth_of_focus: () mm, ±λ/(2 n sin²θ) of the primary wavelength, within which the wavefront errs by a quarter wave.
    """

    lens: Lens
    wavelength: Tensor
    shift: Tensor
    depth_of_focus: Tensor

    COMMAND = "chromatic-focal-shift"
    EVERY = 10

    def columns(self) -> dict[str, Tensor]:
        return {"wavelength": self.wavelength, "shift": self.shift}

    def about(self) -> dict[str, float]:
        extent = self.shift.max() - self.shift.min()
        return {"largest_shift": float(extent), "depth_of_focus": float(self.depth_of_focus)}

    @styled
    def draw(self) -> Figure:
        """The focus over wavelength, drawn sideways, between the limits of a quarter wave."""
        panel = chart(4.2, 4.4, "paraxial focus, from that of the primary wavelength (mm)", "wavelength (µm)")
        places, shift, depth = array(self.wavelength), array(self.shift), float(self.depth_of_focus)
        limits = f"±{1e3 * depth:.3g} µm: λ/4 of wavefront"
        panel.axvspan(-depth, depth, color=FAINT, alpha=0.45, linewidth=0, label=limits)
        for low, high, a, b in zip(places, places[1:], shift, shift[1:], strict=False):
            panel.plot([a, b], [low, high], color=wavelength_colours([0.5 * (low + high)])[0], linewidth=2.0)
        panel.plot(shift, places, color=INK, linewidth=0.4, zorder=1, label="paraxial focus")
        panel.axvline(0, color=GREY, linewidth=0.6)
        panel.set_ylim(places[0], places[-1])
        drawn_at_least([panel], 1e-6, "x")
        total = number_text(1e3 * float(shift.max() - shift.min()), 3)
        return finished(panel, self, f"chromatic focal shift, {total} µm in all", 1)


def chromatic_focal_shift(lens: Lens, *, wavelengths: Numbers = None, samples: int = 101) -> ChromaticFocalShift:
    """The paraxial focus over wavelength, as -n y/ω of the axial marginal ray, along the light.

    wavelengths: µm, of which the first is primary; samples: wavelengths of the curve, over their range, by default that
    of the lens's own.
    Raises NothingToShow for a lens of a single
    wavelength, and for one without an image.
    """
    lens = lens if wavelengths is None else with_wavelengths(lens, wavelengths)
    low, high = lens.wavelengths.min(), lens.wavelengths.max()
    if not bool(high > low):
        raise NothingToShow(
            f"nothing to show over wavelength: the lens has a single one; give a range by {option('wavelengths')}"
        )
    afford(RAY_BYTES * samples, f"{samples:,} wavelengths", helps="ask for fewer {samples}")
    places = low + (high - low) * torch.linspace(0.0, 1.0, samples, **like(lens))
    check_media(lens, places)
    primary = primary_wavelength(lens)
    data = first_order(lens, torch.cat([primary[None], places]))
    focus = data.paraxial_image_distance
    if not bool(torch.isfinite(focus).all()):
        raise NothingToShow("nothing to show over wavelength: the lens has no image at a finite distance")
    forward = side_behind(lens.surfaces)
    depth = 0.5e-3 * primary / data.image_na[0] ** 2
    return ChromaticFocalShift(lens, places, forward * (focus[1:] - focus[0]), depth)

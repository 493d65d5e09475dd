"""Thermal: focus, focal length, spot and MTF over temperature, the sensor fixed in the mount and refocused."""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from raytrace.analysis.mtf import frequency_range, mtf
from raytrace.analysis.panels import ruled
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import NothingToShow, Numbers, Points, like, setting, wavelength_shares
from raytrace.materials.environment import NoThermalCoefficients
from raytrace.materials.mounts import expansion_of
from raytrace.maths.numerics import value
from raytrace.maths.result import Column
from raytrace.maths.sampling import SAMPLINGS, gauss_rings
from raytrace.plotting.style import FAINT, GREY, INK, Figure, array, fill, new_figure, number_text, styled
from raytrace.system.lens import Lens, temperature_of, with_sensor_distance
from raytrace.tracing.focus import focus_of_rms, mean_rms_radius
from raytrace.tracing.paraxial import first_order
from raytrace.words import option

_RINGS = SAMPLINGS["gauss"][2]
_LARGER = {"fixed": INK, "refocused": "#0072B2"}


@value
class Thermal(Analysis):
    """A lens over temperatures (T,) °C; focal length, back focal distance and sensor distance (T,) mm.

    focus_shift: (T,) mm of the best focus of all fields from the sensor, along the light, less that at the temperature
        of the lens; the sensor is fixed in the mount, which expands.
    rms: (2, T) mm, RMS spot radius of all fields and wavelengths, the sensor fixed and refocused; modulation: (2, T),
        the lowest of all fields, tangential and sagittal, at `frequency` () cycles/mm.
    depth_of_focus: () mm, ±λ/(2 n sin²θ) of the primary wavelength; expansion: () 1e-6/K, of the mount.
    fields: (2, F); lens: at its own temperature, with its mount.
    """

    lens: Lens
    fields: Tensor
    temperatures: Tensor
    effective_focal_length: Tensor
    back_focal_distance: Tensor
    sensor_distance: Tensor
    focus_shift: Tensor
    rms: Tensor
    modulation: Tensor
    frequency: Tensor
    depth_of_focus: Tensor
    expansion: Tensor

    COMMAND = "thermal"
    COLUMNS = (
        Column("temperature", "°C", "g"), Column("effective_focal_length", "mm", ".6f", "EFL"),
        Column("back_focal_distance", "mm", ".6f", "BFD"), Column("sensor_distance", "mm", ".6f", "sensor\ndistance"),
        Column("focus_shift_um", "µm", ".3f", "focus shift"), Column("rms_fixed_um", "µm", ".4f", "RMS spot,\nfixed"),
        Column("rms_refocused_um", "µm", ".4f", "RMS spot,\nrefocused"),
        Column("modulation_fixed", "", ".4f", "lowest MTF,\nfixed"),
        Column("modulation_refocused", "", ".4f", "lowest MTF,\nrefocused"),
    )  # fmt: skip

    def columns(self) -> dict[str, Tensor]:
        lengths = ("effective_focal_length", "back_focal_distance", "sensor_distance")
        return {
            "temperature": self.temperatures,
            **{name: getattr(self, name) for name in lengths},
            "focus_shift_um": 1e3 * self.focus_shift,
            **{f"rms_{name}_um": 1e3 * rms for name, rms in zip(_LARGER, self.rms, strict=True)},
            **{f"modulation_{name}": lowest for name, lowest in zip(_LARGER, self.modulation, strict=True)},
        }

    def about(self) -> dict[str, Any]:
        return {
            "reference_temperature": float(temperature_of(self.lens)),
            "mount_expansion": float(self.expansion),
            "frequency": float(self.frequency),
            "depth_of_focus_um": 1e3 * float(self.depth_of_focus),
        }

    @styled
    def draw(self) -> Figure:
        """Focus shift between the limits of a quarter wave, RMS spot radius and modulation over temperature."""
        figure, celsius = new_figure(10.5, 3.6), array(self.temperatures)
        shift, spots, contrast = (ruled(panel) for panel in figure.subplots(1, 3))
        depth = 1e3 * float(self.depth_of_focus)
        shift.axhspan(-depth, depth, color=FAINT, alpha=0.45, linewidth=0, label=f"±{depth:.3g} µm: λ/4 of wavefront")
        shift.plot(
            celsius,
            1e3 * array(self.focus_shift),
            "o-",
            color=INK,
            markersize=3.5,
            label="best focus, the sensor fixed",
        )
        for curve, (name, colour) in enumerate(_LARGER.items()):
            look: dict[str, Any] = dict(color=colour, markersize=3.5, label=f"sensor {name}")
            spots.plot(celsius, 1e3 * array(self.rms[curve]), "o-", **look)
            contrast.plot(celsius, array(self.modulation[curve]), "o-", **look)
        cycles = number_text(float(self.frequency), 4)
        names = "focus shift (µm)", "RMS spot radius (µm)", f"lowest modulation at {cycles} cycles/mm"
        for panel, name in zip((shift, spots, contrast), names, strict=True):
            panel.set_xlabel("temperature (°C)")
            panel.set_ylabel(name)
            panel.axvline(float(temperature_of(self.lens)), color=GREY, linewidth=0.8)
            panel.legend(fontsize=7.5)
        spots.set_ylim(bottom=0)
        contrast.set_ylim(0, 1)
        title = f"{self.lens.name or 'Lens'}\nover temperature, mount of {float(self.expansion):g}e-6/K"
        figure.suptitle(fill(title, figure.get_figwidth(), 10, bold=True), fontweight="bold", fontsize=10)
        return figure


def thermal(
    lens: Lens,
    temperatures: Sequence[float] = (-20.0, 60.0),
    *,
    mount: str | float = "aluminium",
    samples: int = 9,
    modulation_frequency: float | None = None,
    fields: Points = None,
    wavelengths: Numbers = None,
) -> Thermal:
    """Focus, focal length, RMS spot and MTF over a range of temperatures, °C, the sensor fixed and refocused.

    The lens expands from its own temperature, 20 °C without an environment, as of `Lens.at`; its air warms with it.
    mount: material of all spaces without a stated expansion and of the way to the sensor, of `materials.MOUNTS`, or
    1e-6/K; samples: temperatures from the lowest to the highest; modulation_frequency: cycles/mm, by default half of
    those that `rt.mtf` shows; fields: y or (x, y), by default the lens's own, of equal weight; wavelengths: µm. Focus
    and spots are those of least RMS radius over fields and wavelengths. Differentiable, but for the modulation.
    Warns NoThermalCoefficients. Raises ValueError for an unknown mount or a range that is none.
    """
    if len(temperatures) != 2 or not temperatures[0] < temperatures[1]:
        raise ValueError(f"{option('temperatures')} {[*temperatures]}: expected the lowest and the highest, °C")
    low, high = temperatures
    if samples < 2:
        raise ValueError(f"{option('samples', str(samples))}: expected 2 temperatures or more")
    lens, fields = setting(lens.at(mount=mount), fields, wavelengths)
    celsius = low + (high - low) * torch.linspace(0.0, 1.0, samples, **like(lens))
    lens.at(temperature=celsius[(celsius - temperature_of(lens)).abs().argmax()])  # warns of glasses, once
    frequency = modulation_frequency
    if frequency is None:
        frequency = float(frequency_range(_focused(lens, fields), fields, 3)[1])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoThermalCoefficients)
        nominal = _focused(lens, fields).surfaces[-2].thickness - lens.surfaces[-2].thickness
        rows = [_row(lens.at(temperature=each), fields, frequency, nominal) for each in celsius]
    columns = [torch.stack(column) for column in zip(*rows, strict=True)]
    if not bool(torch.isfinite(columns[3]).all()):
        raise NothingToShow("nothing to show over temperature: no ray reaches the image, or the lens has no focus")
    depth = 0.5e-3 * lens.primary / first_order(lens).image_na ** 2
    cycles, expansion = lens.wavelengths.new_tensor([frequency, expansion_of(mount)])
    focal, back, sensor, shift, rms, modulation = columns
    return Thermal(
        lens, fields, celsius, focal, back, sensor, shift, rms.T, modulation.T, cycles, depth.reshape(()), expansion
    )


def _row(lens: Lens, fields: Tensor, frequency: float, nominal: Tensor) -> tuple[Tensor, ...]:
    """The numbers of a `Thermal` at the temperature of a lens."""
    data, sensor, refocused = first_order(lens), lens.surfaces[-2].thickness, _focused(lens, fields)
    rule, both = gauss_rings(_RINGS, **like(lens)), (lens, refocused)
    spots = torch.stack([mean_rms_radius(each, *rule, **_scene(each, fields)) for each in both])
    shift = refocused.surfaces[-2].thickness - sensor - nominal
    with torch.no_grad():
        curves = [mtf(each, [frequency], fields=fields) for each in both]
        lowest = torch.stack([torch.minimum(curve.tangential, curve.sagittal).amin() for curve in curves])
    return data.effective_focal_length, data.back_focal_distance, sensor, shift, spots, lowest


def _scene(lens: Lens, fields: Tensor) -> dict[str, Any]:
    return dict(rings=_RINGS, fields=fields, wavelength_weights=wavelength_shares(lens))


def _focused(lens: Lens, fields: Tensor) -> Lens:
    rule = gauss_rings(_RINGS, **like(lens))
    return with_sensor_distance(lens, focus_of_rms(lens, *rule, **_scene(lens, fields)))

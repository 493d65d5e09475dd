"""Thermal: focus, focal length, spot and MTF over temperature, the sensor fixed in the mount and refocused."""

import warnings
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from raytrace.analysis.mtf import frequency_range, modulations
from raytrace.analysis.panels import ruled
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import NothingToShow, Numbers, Points, like, setting, wavelength_shares
from raytrace.materials.environment import NoThermalCoefficients
from raytrace.materials.mounts import expansion_of, mount_words
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Table
from raytrace.maths.sampling import SAMPLINGS, gauss_rings
from raytrace.plotting.style import FAINT, GREY, INK, Figure, array, fill, new_figure, styled
from raytrace.system.lens import Lens, aligned, temperature_of, with_sensor_distance
from raytrace.tracing.focus import focus_of_rms, mean_rms_radius
from raytrace.tracing.paraxial import first_order
from raytrace.words import option

_RINGS = SAMPLINGS["gauss"][2]
_FREQUENCIES = 41
#: What `thermal` computes over temperature.
MEASURES = ("focus", "rms", "mtf")
_LARGER = {"fixed": INK, "refocused": "#0072B2"}


@value
class Thermal(Analysis):
    """A lens over temperatures (T,) °C; focal length, back focal distance and sensor distance (T,) mm.

    focus_shift: (T,) mm of the best focus of all fields from the sensor, along the light, less that at the temperature
        of the lens; the sensor is fixed in the mount, which expands.
    rms: (2, T) mm, RMS spot radius of all fields and wavelengths, the sensor fixed and refocused; modulation: (2, T),
        the lowest of all fields, tangential and sagittal, at `frequency` () cycles/mm. None where they are not asked.
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
    rms: Tensor | None
    modulation: Tensor | None
    frequency: Tensor | None
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
        columns = {
            "temperature": self.temperatures,
            **{name: getattr(self, name) for name in lengths},
            "focus_shift_um": 1e3 * self.focus_shift,
        }
        if self.rms is not None:
            columns |= {f"rms_{name}_um": 1e3 * rms for name, rms in zip(_LARGER, self.rms, strict=True)}
        if self.modulation is not None:
            columns |= {f"modulation_{name}": low for name, low in zip(_LARGER, self.modulation, strict=True)}
        return columns

    def about(self) -> dict[str, Any]:
        return {
            "reference_temperature": float(temperature_of(self.lens)),
            "mount_expansion": float(self.expansion),
            **({} if self.frequency is None else {"frequency": float(self.frequency)}),
            "depth_of_focus_um": 1e3 * float(self.depth_of_focus),
        }

    def scene(self) -> str:
        """The mount and the frequency of the MTF."""
        words = [f"mount: {mount_words(float(self.expansion))}, of spaces that state no expansion"]
        words += [] if self.frequency is None else [f"MTF at {self.frequency:.4g} cycles/mm"]
        return "; ".join(words)

    def tables(self) -> list[Table]:
        depth = f"a focus shift of ±{1e3 * float(self.depth_of_focus):.3g} µm is λ/4 of wavefront"
        return [Table(self.columns(), [f"{self.scene()}; {depth}"])]

    @styled
    def draw(self) -> Figure:
        """Focus shift between the limits of a quarter wave, RMS spot radius and modulation over temperature."""
        curves: list[tuple[Tensor, str, float | None]] = []
        if self.rms is not None:
            curves.append((1e3 * self.rms, "RMS spot radius (µm)", None))
        if self.modulation is not None and self.frequency is not None:
            curves.append((self.modulation, f"lowest modulation at {self.frequency:.4g} cycles/mm", 1.0))
        count, celsius = 1 + len(curves), array(self.temperatures)
        figure = new_figure({1: 5.2, 2: 7.4, 3: 10.5}[count], 3.6)
        shift, *others = (ruled(panel) for panel in figure.subplots(1, count, squeeze=False)[0])
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
        for panel, (pair, _, top) in zip(others, curves, strict=True):
            for curve, (name, colour) in zip(pair, _LARGER.items(), strict=True):
                panel.plot(celsius, array(curve), "o-", color=colour, markersize=3.5, label=f"sensor {name}")
            panel.set_ylim(0, top)
        names = "focus shift (µm)", *(name for _, name, _ in curves)
        for panel, name in zip((shift, *others), names, strict=True):
            panel.set_xlabel("temperature (°C)")
            panel.set_ylabel(name)
            panel.axvline(float(temperature_of(self.lens)), color=GREY, linewidth=0.8)
            panel.legend(fontsize=7.5)
        title = f"{self.lens.name or 'Lens'}\nover temperature, mount: {mount_words(float(self.expansion))}"
        figure.suptitle(fill(title, figure.get_figwidth(), 10, bold=True), fontweight="bold", fontsize=10)
        return figure


def thermal(
    lens: Lens,
    temperatures: Sequence[float] = (-20.0, 60.0),
    *,
    mount: str | float = "aluminium",
    samples: int = 9,
    measure: str | Sequence[str] = MEASURES,
    modulation_frequency: float | None = None,
    fields: Points = None,
    wavelengths: Numbers = None,
) -> Thermal:
    """Focus, focal length, RMS spot and MTF over a range of temperatures, °C, the sensor fixed and refocused.

    The lens expands from its own temperature, 20 °C without an environment, as of `Lens.at`; its air warms with it.
    mount: material of all spaces without a stated expansion and of the way to the sensor, of `materials.MOUNTS`, or
    1e-6/K; samples: temperatures from the lowest to the highest; measure: those of "focus", "rms" and "mtf" that are
    computed, the focal length and the focus always; the MTF takes most of the time; modulation_frequency: cycles/mm, by
    default that of a lowest modulation of 0.5 in focus at its own temperature; fields: y or (x, y), by default the
    lens's own, of equal weight; wavelengths: µm. Focus and spots are those of least RMS radius over fields and
    wavelengths. Differentiable, but for the modulation.
    Warns NoThermalCoefficients. Raises ValueError for an unknown mount or a range that is none.
    """
    if len(temperatures) != 2 or not temperatures[0] < temperatures[1]:
        raise ValueError(f"{option('temperatures')} {[*temperatures]}: expected the lowest and the highest, °C")
    low, high = temperatures
    measures = measure.split() if isinstance(measure, str) else [*measure]
    if unknown := [name for name in measures if name not in MEASURES]:
        raise ValueError(f"{option('measure')} {unknown[0]!r}: expected {', '.join(MEASURES)}")
    if samples < 2:
        raise ValueError(f"{option('samples', str(samples))}: expected 2 temperatures or more")
    lens, fields = setting(lens.at(mount=mount), fields, wavelengths)
    celsius = low + (high - low) * torch.linspace(0.0, 1.0, samples, **like(lens))
    lens.at(temperature=celsius[(celsius - temperature_of(lens)).abs().argmax()])  # warns of glasses, once
    focused, frequency = _focused(lens, fields), modulation_frequency if "mtf" in measures else None
    if "mtf" in measures and frequency is None:
        frequency = _frequency_of_half_contrast(focused, fields)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NoThermalCoefficients)
        nominal = focused.surfaces[-2].thickness - lens.surfaces[-2].thickness
        rows = [_row(lens.at(temperature=each), fields, frequency, nominal, "rms" in measures) for each in celsius]
    lengths = [torch.stack([row[0][n] for row in rows]) for n in range(4)]
    rms, modulation = _stacked([row[1] for row in rows]), _stacked([row[2] for row in rows])
    if not bool(torch.isfinite(lengths[3]).all()):
        raise NothingToShow("nothing to show over temperature: no ray reaches the image, or the lens has no focus")
    depth = 0.5e-3 * lens.primary / first_order(lens).image_na ** 2
    cycles = None if frequency is None else lens.wavelengths.new_tensor(frequency)
    expansion = lens.wavelengths.new_tensor(expansion_of(mount))
    focal, back, sensor, shift = lengths
    return Thermal(
        lens, fields, celsius, focal, back, sensor, shift, rms, modulation, cycles, depth.reshape(()), expansion
    )  # fmt: skip


def _frequency_of_half_contrast(lens: Lens, fields: Tensor) -> float:
    """The lowest frequency, cycles/mm to two digits, at which a field has a modulation of 0.5, tangential or sagittal;
    if none is that low, the highest one that `rt.mtf` shows."""
    frequencies = frequency_range(lens, fields, _FREQUENCIES)
    with torch.no_grad():
        lowest = torch.minimum(*modulations(aligned(lens, 3), fields, frequencies)).amin(0)
    below = torch.nonzero(lowest < 0.5)
    k = int(below[0]) if len(below) else len(lowest) - 1
    fraction = ((lowest[k - 1] - 0.5) / (lowest[k - 1] - lowest[k])).clamp(0, 1) if len(below) and k else 1.0
    frequency = frequencies[max(k - 1, 0)] + fraction * (frequencies[k] - frequencies[max(k - 1, 0)])
    return float(f"{float(frequency):.2g}")


def _stacked(pairs: Sequence[Tensor | None]) -> Tensor | None:
    """Pairs (2,) of every temperature as (2, T); None where they are not asked."""
    asked = [pair for pair in pairs if pair is not None]
    return torch.stack(asked, 1) if asked else None


def _row(
    lens: Lens, fields: Tensor, frequency: float | None, nominal: Tensor, spots: bool
) -> tuple[tuple[Tensor, Tensor, Tensor, Tensor], Tensor | None, Tensor | None]:
    """The lengths, RMS spot radii and modulations of a `Thermal` at the temperature of a lens."""
    data, sensor, refocused = first_order(lens), lens.surfaces[-2].thickness, _focused(lens, fields)
    rule, both, radii, lowest = gauss_rings(_RINGS, **like(lens)), (lens, refocused), None, None
    shift = refocused.surfaces[-2].thickness - sensor - nominal
    if spots:
        radii = torch.stack([mean_rms_radius(each, *rule, **_scene(each, fields)) for each in both])
    if frequency is not None:
        with torch.no_grad():
            cycles = lens.wavelengths.new_tensor([frequency])
            curves = [modulations(aligned(each, 3), fields, cycles) for each in both]
            lowest = torch.stack([torch.minimum(*pair).amin() for pair in curves])
    return (data.effective_focal_length, data.back_focal_distance, sensor, shift), radii, lowest


def _scene(lens: Lens, fields: Tensor) -> dict[str, Any]:
    return dict(rings=_RINGS, fields=fields, wavelength_weights=wavelength_shares(lens))


def _focused(lens: Lens, fields: Tensor) -> Lens:
    rule = gauss_rings(_RINGS, **like(lens))
    return with_sensor_distance(lens, focus_of_rms(lens, *rule, **_scene(lens, fields)))

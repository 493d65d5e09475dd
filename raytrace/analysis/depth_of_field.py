"""Depth of field: the object distances that are sharp enough with a fixed sensor, and the hyperfocal distance.

By paraxial rays an object at the distance d from the entrance pupil of diameter D, its sensor in focus at s, has

    a blur of diameter c = D m s |1/d - 1/s|,   m the magnification at s
    a wavefront of W = (n/8) D² |1/d - 1/s| at the rim

so that the limits are 1/d = 1/s ± Δ (Greenleaf, Photographic Optics, 1950), with Δ = c/(D m s), or 2 λ/(n D²) of a
quarter wave (Rayleigh). The hyperfocal distance is the s of 1/s = Δ: f²/(N c) + f from the front principal plane.
Traced limits are those of the real lens: its aberrations, defocus and apertures count.
"""

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.optimize
import scipy.special
import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.analysis.mtf import mtf
from raytrace.analysis.panels import chart, field_labels, finished
from raytrace.analysis.result import Analysis
from raytrace.analysis.rms import rms_of_fields
from raytrace.analysis.setting import NothingToShow, Numbers, Points, like, setting, wavelength_shares
from raytrace.maths.numerics import detached, value, varies
from raytrace.maths.result import Column, Table, number, object_text
from raytrace.maths.sampling import gauss_rings
from raytrace.plotting.style import FAINT, GREY, INK, Figure, array, field_colours, number_text, styled
from raytrace.system.lens import Lens, index_behind, with_field_kind, with_sensor_distance
from raytrace.tracing.focus import focus_of_rms
from raytrace.tracing.launch import field_of_object, paraxial_field
from raytrace.tracing.paraxial import axial_beam, first_order
from raytrace.words import option

QUARTER_WAVE = 0.25 / math.sqrt(12)  # waves RMS of a defocus of λ/4 at the rim
_FIRST, _GROWTH, _MOST = 0.25, 1.3, 60  # steps of the search for a limit, in units of the paraxial Δ
_RINGS = 12
_POINTS = 41  # of a drawn curve


@value
class DepthOfField(Analysis):
    """Limits of sharpness in object space, mm from the object to surface 1, inf where infinity is sharp.

    near, far: (F,) traced, nan where a field is not sharp at the object distance of the lens; in_focus: (F,) the
        criterion there. paraxial_near, paraxial_far: () on the axis.
    hyperfocal, hyperfocal_near: () traced, of all fields together: the nearest object in focus whose far limit is
        infinity, and its near limit; paraxial_hyperfocal, paraxial_hyperfocal_near: () on the axis.
    depth_of_focus: () mm, ± of the sensor, paraxial. criterion: blur, modulation or wavefront; limit: its value, mm, 1
        or waves RMS; frequency: cycles/mm of the modulation, 0 of others; fields: (2, F) as angles of chief rays.
    """

    lens: Lens
    fields: Tensor
    near: Tensor
    far: Tensor
    in_focus: Tensor
    paraxial_near: Tensor
    paraxial_far: Tensor
    hyperfocal: Tensor
    hyperfocal_near: Tensor
    paraxial_hyperfocal: Tensor
    paraxial_hyperfocal_near: Tensor
    depth_of_focus: Tensor
    criterion: str
    limit: float
    frequency: float

    COMMAND = "depth-of-field"
    COLUMNS = (
        *(Column(name, "mm", ".6g") for name in ("near", "far", "depth")),
        Column("blur_um", "µm", ".4f", "blur\nin focus"), Column("modulation", "", ".4f", "modulation\nin focus"),
        Column("wavefront", "waves", ".5f", "RMS wavefront\nin focus"),
    )  # fmt: skip

    def columns(self) -> dict[str, Tensor]:
        name, scale = ("blur_um", 1e3) if self.criterion == "blur" else (self.criterion, 1.0)
        sizes = {"near": self.near, "far": self.far, "depth": self.far - self.near}
        return {**self.heads(), **sizes, name: scale * self.in_focus}

    def about(self) -> dict[str, Any]:
        names = ("near", "far", "hyperfocal", "hyperfocal_near")
        paraxial = {f"paraxial_{name}": number(getattr(self, f"paraxial_{name}")) for name in names}
        return {
            "criterion": self.criterion,
            "limit": self.limit,
            **({"frequency": self.frequency} if self.criterion == "modulation" else {}),
            "object_distance": number(self.lens.surfaces[0].thickness),
            **paraxial,
            "far_is_infinite": [math.isinf(distance) for distance in self.far.tolist()],
            "hyperfocal": number(self.hyperfocal),
            "hyperfocal_near": number(self.hyperfocal_near),
            "depth_of_focus_um": 1e3 * float(self.depth_of_focus),
        }

    def limit_text(self) -> str:
        return {
            "blur": f"a blur of {1e3 * self.limit:.6g} µm in diameter (of the uniform disc of the same RMS radius)",
            "modulation": f"a modulation of {self.limit:g} at {self.frequency:g} cycles/mm",
            "wavefront": f"an RMS wavefront of {self.limit:.4g} waves"
            + (", a quarter wave of defocus" if self.limit == QUARTER_WAVE else ""),
        }[self.criterion]

    def tables(self) -> list[Table]:
        def words(distance: Tensor) -> str:
            return "-" if math.isnan(distance) else object_text(float(distance))

        blurred = torch.isnan(self.near)
        label = "object distance    " if bool(blurred.all()) else "object in focus at "
        title = [
            f"sharp to {self.limit_text()}",
            f"  {label}  {words(self.lens.surfaces[0].thickness)}, measured to surface 1",
            f"  paraxial limits      {words(self.paraxial_near)} to {words(self.paraxial_far)}",
            f"  hyperfocal distance  {words(self.hyperfocal)}, near limit {words(self.hyperfocal_near)}; paraxial "
            f"{words(self.paraxial_hyperfocal)}, {words(self.paraxial_hyperfocal_near)}",
            f"  depth of focus       ±{1e3 * float(self.depth_of_focus):.6g} µm at the sensor, paraxial",
        ]
        if bool(blurred.any()):
            title += [
                "  -: not sharp with the sensor where it is; paraxial limits assume a sensor in paraxial focus.",
                "     Focus the lens at this object distance (raytrace focus), or give another limit.",
            ]
        title.append("")
        return [Table(self.columns(), title)]

    @styled
    def draw(self) -> Figure:
        """The criterion over the object distance for each field, and its limit."""
        focused, ends = float(1 / self.lens.surfaces[0].thickness.detach()), 1 / array(self.near)
        paraxial = [1 / float(self.paraxial_near)]
        span = max([abs(end - focused) for end in [*ends, *paraxial] if math.isfinite(end)])
        vergence = np.linspace(max(focused - 2 * span, 0.02 * span), focused + 2 * span, _POINTS)
        measured = _Measure(detached(self.lens), self.fields.detach(), self.criterion, self.limit, self.frequency)
        scale = 1e3 if self.criterion == "blur" else 1.0
        with torch.no_grad():
            curves = scale * np.stack([array(measured.quantity(u)) for u in vergence.tolist()], -1)
        names = {"blur": "diameter of the blur (µm)", "wavefront": "RMS wavefront (waves)",
            "modulation": f"modulation at {number_text(self.frequency, 4)} cycles/mm"}  # fmt: skip
        panel = chart(6.4, 3.8, "object distance (m)", names[self.criterion])
        for label, colour, curve in zip(field_labels(self), field_colours(len(curves)), curves, strict=True):
            panel.plot(1e-3 / vergence, curve, color=colour, linewidth=1.5, label=label)
        panel.axhline(scale * self.limit, color=INK, linewidth=0.9, linestyle=(0, (5, 3)), label="limit")
        far = min(float(self.paraxial_far), 1 / vergence[0])
        panel.axvspan(1e-3 * float(self.paraxial_near), 1e-3 * far, color=FAINT, alpha=0.4, linewidth=0,
            label="paraxial depth of field")  # fmt: skip
        if focused > 0:
            panel.axvline(1e-3 / focused, color=GREY, linewidth=0.8)
        panel.set_ylim(bottom=0)
        low, high = 1e-3 / vergence[-1], 1e-3 / vergence[0]
        if high > 3 * low:
            panel.set_xscale("log")
            ticks = [step * 10.0**e for e in range(-4, 7) for step in (1, 2, 5)]
            panel.set_xticks([tick for tick in ticks if low <= tick <= high])
            panel.set_xticks([], minor=True)
            panel.xaxis.set_major_formatter(lambda x, place: f"{x:g}")
        panel.set_xlim(low, high)
        return finished(panel, self, "depth of field", 3)


def depth_of_field(
    lens: Lens,
    *,
    blur: float | None = None,
    modulation: float | None = None,
    modulation_frequency: float | None = None,
    wavefront: float | None = None,
    fields: Points = None,
    wavelengths: Numbers = None,
) -> DepthOfField:
    """Near and far limits of sharpness with the sensor where it is, and the hyperfocal distance, traced and paraxial.

    Sharp is one of: blur, the largest diameter in mm of the blur (circle of confusion): of the uniform disc that has
    the RMS radius of the spot; modulation, the least MTF at modulation_frequency cycles/mm, tangential and sagittal;
    wavefront, the largest RMS in waves; by default that of a quarter wave of defocus, 0.0722. fields: y or (x, y), of
    the points in focus, by default the axis; off the axis objects move along the chief ray; wavelengths: µm. The
    diameter of the entrance pupil is the same at every distance. Distances have derivatives by the numbers of the lens.
    Raises ValueError for two criteria, NothingToShow for an afocal lens or one that is sharp nowhere.
    """
    limits = {"blur": blur, "modulation": modulation, "wavefront": wavefront}
    given = {name: limit for name, limit in limits.items() if limit is not None} or {"wavefront": QUARTER_WAVE}
    if len(given) > 1:
        raise ValueError(f"{' and '.join(map(option, given))} exclude each other: leave one out")
    ((criterion, limit),) = given.items()
    if not (limit > 0 and (criterion != "modulation" or limit < 1)):
        most = " and below 1" if criterion == "modulation" else ""
        raise ValueError(f"{option(criterion, limit)}: expected a number above 0{most}")
    if (criterion == "modulation") != (modulation_frequency is not None):
        raise ValueError(f"{option('modulation')} and {option('modulation_frequency')} go together: give both or none")
    frequency = float(modulation_frequency or 0.0)
    lens, fields = setting(lens, [0.0] if fields is None else fields, wavelengths)
    lens, fields = _by_angles(lens, fields)
    data = first_order(lens)
    if not bool(torch.isfinite(data.effective_focal_length)) or not bool(data.power.abs() > 0):
        raise NothingToShow("nothing to show: an afocal lens has no depth of field")
    paraxial = _Paraxial(lens, criterion, limit, frequency)
    measured = _Measure(lens, fields, criterion, limit, frequency)
    with torch.no_grad():
        in_focus = measured.excess(float(1 / lens.surfaces[0].thickness.detach()))
    ends = [
        _limits(measured.of(f), float(paraxial.step.detach())) if in_focus[f] <= 0 else _NONE
        for f in range(len(in_focus))
    ]
    near, far = (torch.stack([like_lens(lens, pair[k]) for pair in ends]) for k in (0, 1))
    hyperfocal, hyperfocal_near = _hyperfocal(measured, paraxial)
    if bool(torch.isnan(near).all()) and bool(torch.isnan(hyperfocal)):
        quantity = measured.quantity(float(1 / lens.surfaces[0].thickness.detach()))
        least = float(quantity.max() if criterion == "modulation" else quantity.min())
        unit = {"blur": " mm", "modulation": "", "wavefront": " waves RMS"}[criterion]
        raise NothingToShow(
            f"nothing to show: no field is sharp at any distance; the {criterion} at the object distance of the lens "
            f"is {least:.4g}{unit} at best, the limit {limit:.4g}{unit}; focus the lens, or give another limit"
        )
    return DepthOfField(
        lens=lens,
        fields=fields,
        near=near,
        far=far,
        in_focus=measured.quantity(1 / lens.surfaces[0].thickness),
        paraxial_near=paraxial.near(),
        paraxial_far=paraxial.far(),
        hyperfocal=hyperfocal,
        hyperfocal_near=hyperfocal_near,
        paraxial_hyperfocal=paraxial.hyperfocal(),
        paraxial_hyperfocal_near=paraxial.hyperfocal_near(),
        depth_of_focus=paraxial.depth_of_focus(),
        criterion=criterion,
        limit=float(limit),
        frequency=frequency,
    )


_NONE = (math.nan, math.nan)


def like_lens(lens: Lens, number: Tensor | float) -> Tensor:
    """A number as a tensor of the lens."""
    return number if isinstance(number, Tensor) else torch.tensor(number, **like(lens))


def _by_angles(lens: Lens, fields: Tensor) -> tuple[Lens, Tensor]:
    """The lens with the angles of its chief rays as fields (2, F), and the diameter of its entrance pupil fixed."""
    beam = axial_beam(lens)
    angled = with_field_kind(lens, "angle")
    fields = field_of_object(angled, paraxial_field(lens, fields, beam), beam)
    return angled.at(entrance_pupil_diameter=beam.entrance_pupil_diameter), fields


class _Paraxial:
    """Limits by the formulas at the head of this module; numbers () with derivatives."""

    def __init__(self, lens: Lens, criterion: str, limit: float, frequency: float):
        data = first_order(lens)
        self.pupil, self.position = data.entrance_pupil_diameter, data.entrance_pupil_position
        self.index = index_behind(lens, 0, lens.primary)
        self.focal = self.index / data.power.abs()
        self.front = data.front_focal_distance
        self.data, self.waves = data, 1e-3 * lens.primary
        blur = limit
        if criterion == "modulation":  # of the uniform disc: 2 J1(x)/x, x = π ν c
            blur = (
                scipy.optimize.brentq(lambda x: 2 * scipy.special.j1(x) / x - limit, 1e-9, 3.8317) / math.pi / frequency
            )
        self.blur = None if criterion == "wavefront" else blur
        self.share = limit / QUARTER_WAVE
        #: 1/s of the object in focus, from the entrance pupil, and Δ.
        distance = lens.surfaces[0].thickness
        self.vergence = 1 / (distance + self.position)
        ratio = 1 / (1 + (self.front - self.position) * self.vergence)  # s over the distance from the focal point
        self.step = self._step(ratio)

    def _step(self, ratio: Tensor | float) -> Tensor:
        """Δ; ratio: of s to the distance from the front focal point, f/s times which is the magnification."""
        if self.blur is None:
            return self.share * 2 * self.waves / (self.index * self.pupil**2)
        return self.blur / (self.pupil * self.focal * ratio)

    def _from_surface(self, vergence: Tensor) -> Tensor:
        """The distance to surface 1 of an object; inf beyond infinity."""
        is_near = vergence > 0
        return torch.where(is_near, 1 / torch.where(is_near, vergence, 1.0) - self.position, torch.inf)

    def near(self) -> Tensor:
        return self._from_surface(self.vergence + self.step)

    def far(self) -> Tensor:
        return self._from_surface(self.vergence - self.step)

    def _hyperfocal_vergence(self) -> Tensor:
        if self.blur is None:
            return self._step(1.0)
        return 1 / (self.focal * self.pupil / self.blur - self.front + self.position)

    def hyperfocal(self) -> Tensor:
        return self._from_surface(self._hyperfocal_vergence())

    def hyperfocal_near(self) -> Tensor:
        return self._from_surface(2 * self._hyperfocal_vergence())

    def depth_of_focus(self) -> Tensor:
        """c/(2 tan u') of the paraxial marginal ray, or λ n'/(2 NA²) of a quarter wave."""
        if self.blur is None:
            return self.share * 0.5 * self.waves / self.data.image_na**2
        return self.blur * self.data.paraxial_working_f_number


@dataclasses.dataclass(frozen=True)
class _Measure:
    """A lens, its fields (2, F) as angles, and what is sharp."""

    lens: Lens
    fields: Tensor
    criterion: str
    limit: float
    frequency: float

    def of(self, field: int) -> "_Measure":
        return dataclasses.replace(self, fields=self.fields[:, field : field + 1])

    @property
    def constant(self) -> "_Measure":
        return dataclasses.replace(self, lens=detached(self.lens), fields=self.fields.detach())

    def with_sensor(self, distance: Tensor | float) -> "_Measure":
        return dataclasses.replace(self, lens=with_sensor_distance(self.lens, distance))

    def at(self, vergence: Tensor | float) -> Lens:
        """The lens with its object at 1/vergence from surface 1."""
        is_finite = vergence.detach() != 0 if isinstance(vergence, Tensor) else vergence != 0
        return self.lens.at(object_distance=1 / vergence if is_finite else math.inf)

    def quantity(self, vergence: Tensor | float) -> Tensor:
        """The criterion (F,) of an object at 1/vergence."""
        lens = self.at(vergence)
        if self.criterion == "modulation":
            curves = mtf(lens, [self.frequency], fields=self.fields)
            return torch.minimum(curves.tangential, curves.sagittal)[:, 0]
        rms = rms_of_fields(lens, self.fields, self.criterion == "blur", "primary").polychromatic
        return 2 * math.sqrt(2) * rms if self.criterion == "blur" else rms

    def excess(self, vergence: Tensor | float) -> Tensor:
        """(F,) above 0 where it is not sharp, in units of the limit; without light 1."""
        sign = -1.0 if self.criterion == "modulation" else 1.0
        excess = sign * (self.quantity(vergence) / self.limit - 1)
        return torch.where(torch.isnan(excess), 1.0, excess)


def _limits(measured: _Measure, step: float) -> tuple[Tensor, Tensor]:
    """Near and far limit () mm of one field."""
    plain, focused = measured.constant, float(1 / measured.lens.surfaces[0].thickness.detach())

    def excess(vergence: float) -> float:
        with torch.no_grad():
            return float(plain.excess(vergence).max())

    ends = []
    for side in (1.0, -1.0):
        root = _crossing(excess, focused, side * step, least=0.0)
        ends.append(_attached(lambda u: measured.excess(u).max(), lambda u: plain.excess(u).max(), root, measured.lens))
    near, far = (1 / end if bool(end > 0) else torch.full_like(end, torch.inf) for end in ends)
    return near, far


def _crossing(excess: Callable[[float], float], start: float, step: float, *, least: float = -math.inf) -> float:
    """Where an excess, not above 0 at the start, becomes 0 in the direction of a step; `least` if it does not by then.

    nan where no crossing is found.
    """
    inside, size = start, _FIRST * step
    for _ in range(_MOST):
        outside = max(inside + size, least)
        if excess(outside) > 0:
            return float(scipy.optimize.brentq(excess, inside, outside, xtol=1e-14 * abs(step), rtol=1e-12))
        if outside == least:
            return least
        inside, size = outside, size * _GROWTH
    return math.nan


def _attached(
    function: Callable[[Tensor], Tensor], plain: Callable[[Tensor], Tensor], root: float, lens: Lens
) -> Tensor:
    """A root with the derivatives of the lens: u - g(u)/g'(u), g' a number."""
    u = like_lens(lens, root)
    if not any(map(varies, pytree.tree_leaves(lens))) or not math.isfinite(root) or root == 0:
        return u
    with torch.enable_grad():
        vergence = u.detach().requires_grad_()
        (slope,) = torch.autograd.grad(plain(vergence), vergence)
    return u - function(u) / slope


def _hyperfocal(measured: _Measure, paraxial: _Paraxial) -> tuple[Tensor, Tensor]:
    """The hyperfocal distance and its near limit, () mm, of all fields together; nan where infinity is never sharp.

    The sensor moves from the focus of infinity until infinity is just sharp; then the object in focus is looked for.
    """
    lens = measured.lens
    rule = gauss_rings(_RINGS, **like(lens))
    scene: dict[str, Any] = dict(rings=_RINGS, fields=measured.fields, wavelength_weights=wavelength_shares(lens))
    plain = measured.constant

    def focus(measure: _Measure, vergence: Tensor | float) -> Tensor:
        return focus_of_rms(measure.at(vergence), *rule, **scene)

    def at_infinity(measure: _Measure, sensor: Tensor | float) -> Tensor:
        return measure.with_sensor(sensor).excess(0.0).max()

    with torch.no_grad():
        best = float(focus(plain, 0.0))
        if not math.isfinite(best) or float(at_infinity(plain, best)) > 0:
            return like_lens(lens, math.nan), like_lens(lens, math.nan)
        near = paraxial._hyperfocal_vergence().detach()
        step = float(focus(plain, float(near))) - best
        sensor = _crossing(lambda z: float(at_infinity(plain, z)), best, step)
    if not math.isfinite(sensor):
        return like_lens(lens, math.nan), like_lens(lens, math.nan)
    sensor_at = _attached(lambda z: at_infinity(measured, z), lambda z: at_infinity(plain, z), sensor, lens)
    side = math.copysign(1.0, step)
    with torch.no_grad():
        vergence = _crossing(lambda u: side * (float(focus(plain, u)) - sensor), 0.0, float(near))
    focused = _attached(lambda u: focus(measured, u) - sensor_at, lambda u: focus(plain, u), vergence, lens)
    refocused = dataclasses.replace(
        measured, lens=with_sensor_distance(measured.lens, sensor_at).at(object_distance=1 / focused.detach())
    )
    ends = [_limits(refocused.of(f), float(near))[0] for f in range(measured.fields.shape[1])]
    return 1 / focused, torch.stack(ends).amax()

"""Operands of modulation and of the Strehl ratio.

The MTF of diffraction follows from a few rings of rays, and that of rays is a sum over a beam; both are traced with all
the rows' rays. A beam that apertures clip and the Strehl ratio are functions of `analysis.mtf` and `psf_models.wave`,
with their derivatives by torch.
"""

import dataclasses
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.mtf import clear_circle, cutoff, mtf_on_grid
from raytrace.analysis.pupil_autocorrelation import Fit, layout_of, otf
from raytrace.analysis.setting import scene_of
from raytrace.maths.numerics import Dual, Number, slope_of, value_of
from raytrace.optimization.operands.operand import (
    BadRow,
    Evaluate,
    EvaluationContext,
    Line,
    Operand,
    OrLost,
    Planner,
    RowValue,
    per_row,
)
from raytrace.optimization.operands.paraxial import image_index
from raytrace.optimization.operands.wavefront import beam_of, colours_of, rings, sphere_of
from raytrace.psf_models.strehl import strehl
from raytrace.system.lens import Lens
from raytrace.tracing.scene import Scene
from raytrace.tracing.trace import is_bent
from raytrace.tracing.wavefront import path_to_reference_sphere, towards_centre

_MISSED = 0.02  # waves of RMS that the polynomials of a wave may leave
_NOTHING = 1e-30  # in the square of a modulation, whose root has a slope there
_RULES = (12, 16, 20, 28, 40, 56, 80, 112, 160)  # points along and across
_POINTS = 32  # across the pupil at sampling 1
_RINGS = 8  # of rays at sampling 1
_DEGREE, _HIGHEST = 10, 16  # of the polynomials of a wave, at sampling 0 and of any

#: Tangential, sagittal, and their mean.
_SHARES = {"T": (1.0, 0.0), "S": (0.0, 1.0), "A": (0.5, 0.5)}


def _field_number(line: Line, planner: Planner) -> int:
    """The field of a row, from 0: its number is in the column of Hx. Raises BadRow."""
    count, number = len(planner.lens.fields.x), line.row.numbers[0]
    if number != int(number) or not 1 <= number <= count:
        raise BadRow(line, f"names field {number:g}: this lens has fields 1 to {count}")
    return int(number) - 1


def _field_part(planner: Planner, number: int) -> tuple[float, float]:
    """(Hx, Hy) of a field, from 0."""
    fields, largest = planner.lens.fields, float(planner.lens.fields.extent) or 1.0
    return float(fields.x[number]) / largest, float(fields.y[number]) / largest


def _scene(lens: Lens, number: int, colours: Iterable[int]) -> Scene:
    """The scene of a field and some of the wavelengths."""
    field = torch.stack([lens.fields.x, lens.fields.y])[:, number, None]
    return dataclasses.replace(scene_of(lens, field), wavelengths=lens.wavelengths[list(colours)])


def _shares(colours: dict[int, float], like: Tensor) -> Tensor:
    weights = like.new_tensor(list(colours.values()))
    return weights / weights.sum()


# -- of diffraction, from a few rays -----------------------------------------------------------------------------------


class Section(NamedTuple):
    """A frequency in cycles/mm of patterns that vary along x (0) or y (1)."""

    frequency: float
    axis: int


class Pupil:
    """The rays of one field (2,) at some wavelengths and their shares.

    A field on the y axis of a lens of revolution needs the right half of the pupil, the axis one arm.
    """

    def __init__(self, planner: Planner, number: int, colours: dict[int, float], degree: int):
        """number: of the field, from 0."""
        self.field = _field_part(planner, number)
        self.colours = np.array(list(colours))
        self.shares = np.array(list(colours.values())) / sum(colours.values())
        mirrored, is_round = _symmetry(planner, number)
        self.layout = layout_of(degree, half=mirrored)
        radius = np.round(np.hypot(*self.layout.points), 14)
        points = np.stack([0 * radius, radius]) if is_round else self.layout.points
        self.turn = self.layout.points / radius if is_round else None
        asked = [[planner.ask(w, self.field, p, clips=True) for p in points.T.tolist()] for w in colours]
        self.rays = np.array(asked)
        self.chiefs = np.array([planner.ask(w, self.field, (0.0, 0.0), clips=True) for w in colours])

    @property
    def kind(self) -> tuple:
        """The kind of the beam; beams of one kind are evaluated together."""
        return self.layout.degree, self.layout.half, len(self.colours)

    def turned(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Components (..., R) of directions, for a round beam from those of its arm."""
        return (x, y) if self.turn is None else (self.turn[0] * y, self.turn[1] * y)


def _symmetry(planner: Planner, number: int) -> tuple[bool, bool]:
    """Whether the beam of a field is mirrored in the y axis, and whether it is round."""
    fields = planner.lens.fields
    if not planner.view.is_symmetric or float(fields.x[number]) != 0:
        return False, False
    factors = [0.0] * 5 if fields.vignetting is None else fields.vignetting[:, number].tolist()
    vdx, vdy, vcx, vcy, angle = factors
    mirrored = vdx == 0 and angle == 0
    return mirrored, mirrored and float(fields.y[number]) == 0 and vdy == 0 and vcx == vcy


#: Numbers and their slopes behind an axis of variables.
Slopes: TypeAlias = tuple[np.ndarray, np.ndarray]


class Waves(NamedTuple):
    """The waves of beams: `wave` (B, R) in waves, `directions` s (2, B, R) in 1/mm, `places` (2, B) mm of chief rays on
    the image, each with its slopes behind an axis of variables, or None; blur: mm; valid: (B, R)."""

    wave: Slopes
    directions: Slopes
    places: Slopes
    blur: np.ndarray
    valid: np.ndarray

    def of(self, rows: np.ndarray) -> "Waves":
        """The waves of some beams."""
        (wave, by_wave), (s, by_s), (place, by_place) = self.wave, self.directions, self.places
        return Waves(
            (wave[..., rows, :], by_wave[..., rows, :]), (s[..., rows, :], by_s[..., rows, :]),
            (place[..., rows], by_place[..., rows]), self.blur[rows], self.valid[rows],
        )  # fmt: skip


def waves_of(context: EvaluationContext, beams: Sequence[Pupil]) -> Waves:
    """The waves of beams of one kind, those of one beam after those of another."""
    rays, chiefs, colours = (
        np.concatenate([getattr(beam, name) for beam in beams]) for name in ("rays", "chiefs", "colours")
    )
    shape, each, count = rays.shape, np.repeat(np.arange(len(rays)), rays.shape[1]), context.state.count
    hits, chief = context.hits(rays.ravel(), clips=True), context.hits(chiefs, clips=True)
    sphere, index = sphere_of(context, chief, is_bent(context.planner.lens)), image_index(context, colours)
    per_wave = 1e3 / np.array(context.planner.view.wavelengths)[colours]
    path = path_to_reference_sphere(hits, *sphere.at(each), index[each])
    path = path - path_to_reference_sphere(chief, *sphere, index)[each]
    scale = (index * per_wave)[each]
    numbers = [path * per_wave[each], *(scale * part for part in towards_centre(hits, *sphere.at(each))[:2])]
    values = [value_of(part).reshape(shape) for part in numbers]
    slopes = [slope_of(part, count).reshape(count, *shape) for part in numbers]
    offset = [np.abs(value_of(hits.position[k]) - value_of(chief.position[k])[each]).reshape(shape) for k in range(2)]
    places = [chief.position[k] for k in range(2)]
    return Waves(
        (values[0], slopes[0]),
        (_turned(beams, *values[1:]), _turned(beams, *slopes[1:])),
        (np.stack([value_of(part) for part in places]), np.stack([slope_of(part, count) for part in places], 1)),
        np.maximum(*offset).max(-1),
        hits.valid.reshape(shape) & chief.valid[:, None],
    )


def _turned(beams: Sequence[Pupil], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Components (..., B, R) of all rays, one beam after the other: (2, ..., B, R)."""
    size = len(beams[0].colours)
    places = [(..., slice(k * size, (k + 1) * size), slice(None)) for k in range(len(beams))]
    return np.concatenate(
        [np.stack(beam.turned(x[chosen], y[chosen])) for beam, chosen in zip(beams, places, strict=True)], -2
    )


def modulations(
    context: EvaluationContext, beams: Sequence[Pupil], sections: Sequence[Section]
) -> tuple[Dual | np.ndarray, np.ndarray]:
    """MTF (F, Q) of beams of one kind in sections, and for which of them (F,) their rays suffice."""
    waves, colours = waves_of(context, beams), len(beams[0].colours)
    suffice = waves.valid.all(-1).reshape(-1, colours).all(-1)
    values = np.full((len(beams), len(sections)), np.nan)
    slopes = np.zeros((context.state.count, *values.shape))
    # A phase of 2π ν blur to either side needs so many points of a rule.
    needed = 10 + 4.0 * waves.blur.reshape(-1, colours).max(-1) * max(section.frequency for section in sections)
    rule = np.array([next((n for n in _RULES if n >= least), 0) for least in needed])
    suffice &= rule > 0
    if suffice.any():
        chosen = np.flatnonzero(suffice)
        some = waves.of((chosen[:, None] * colours + np.arange(colours)).ravel())
        fit = Fit(beams[0].layout, some.wave[0], some.directions[0])
        shares = np.stack([beams[k].shares for k in chosen.tolist()])
        points = int(rule[chosen].max())
        values[chosen], slopes[:, chosen] = _modulated(fit, some, sections, shares, points, context.state.count)
        suffice[chosen] &= (fit.missed.reshape(-1, colours) < _MISSED).all(-1)
    return (Dual(values, slopes) if context.state.count else values), suffice


def _modulated(
    fit: Fit, waves: Waves, sections: Sequence[Section], shares: np.ndarray, points: int, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """MTF (F, Q), and its slopes (n, F, Q)."""
    fields, colours = shares.shape
    axes = np.array([section.axis for section in sections])
    frequencies = np.array([section.frequency for section in sections])
    along_y = torch.from_numpy(axes == 1)[:, None, None, None]
    with torch.set_grad_enabled(count > 0):
        polynomials = torch.from_numpy(fit.polynomials)[:, None].repeat(1, len(sections), 1, 1, 1)
        places = torch.from_numpy(waves.places[0])[axes]
        polynomials.requires_grad_(count > 0), places.requires_grad_(count > 0)
        shear = torch.from_numpy(frequencies[:, None] / fit.scale[axes])
        parts = otf(torch.where(along_y, polynomials, polynomials.mT), shear, points)
        turn = -2 * np.pi * torch.from_numpy(frequencies)[:, None] * places
        parts = (parts * torch.exp(1j * turn)).unflatten(-1, (fields, colours))
        total = (torch.from_numpy(shares) * parts).sum(-1)
        contrast = torch.sqrt(total.real**2 + total.imag**2 + _NOTHING)
    values = contrast.detach().numpy().T
    if not count:
        return values, np.zeros((0, *values.shape))
    by_fit, by_place = (part.numpy() for part in torch.autograd.grad(contrast.sum(), (polynomials, places)))
    by_wave, by_directions = fit.by_rays(by_fit)
    slopes = _gathered(by_wave, waves.wave[1], fields)
    for k in range(2):
        slopes = slopes + _gathered(by_directions[k], waves.directions[1][k], fields)
    moved = (by_place * waves.places[1][:, axes]).reshape(count, len(sections), fields, colours).sum(-1)
    return values, slopes + moved.swapaxes(1, 2)


def _gathered(by: np.ndarray, slopes: np.ndarray, fields: int) -> np.ndarray:
    """Σ over the rays and colours of a field: from (Q, B, R) and (n, B, R) to (n, F, Q)."""
    by = by.reshape(len(by), fields, -1).transpose(1, 2, 0)
    return (slopes.reshape(len(slopes), fields, -1).transpose(1, 0, 2) @ by).swapaxes(0, 1)


# -- of diffraction ----------------------------------------------------------------------------------------------------


class Wave:
    """The wave of one field at one sampling, of one wavelength or all, and the modulations that rows need of it.

    From the rays of a few rings (`pupil_autocorrelation.py`). Where apertures stop some of them, on a grid by torch,
    with a backward pass for each number.
    """

    def __init__(self, line: Line, planner: Planner):
        self.planner, self.field, self.colours = planner, _field_number(line, planner), colours_of(line, planner)
        self.least = _POINTS * 2 ** (line.row.integers[0] - 1)
        self.asked: dict[tuple[float, str], int] = {}
        self._on_grid = OrLost(line, lambda context: context.state.through_torch(self._grid, clips=True))
        self._last: tuple[EvaluationContext | None, Sequence | None] = None, None
        degree = min(_DEGREE + 2 * line.row.integers[0], _HIGHEST)
        self.beam = Pupil(planner, self.field, self.colours, degree)

    def ask(self, frequency: float, section: str) -> int:
        """The place of a modulation among those of the wave."""
        return self.asked.setdefault((frequency, section), len(self.asked))

    def _grid(self, lens: Lens) -> list[Tensor]:
        frequencies = sorted({frequency for frequency, _ in self.asked})
        scene, shares = _scene(lens, self.field, self.colours), _shares(self.colours, lens.wavelengths)
        both = mtf_on_grid(scene, lens.wavelengths.new_tensor(frequencies), shares, least=self.least)
        columns = {frequency: k for k, frequency in enumerate(frequencies)}
        return [_mean(s, lambda axis, k=columns[f]: both[1 - axis][0, k]) for f, s in self.asked]

    def __call__(self, context: EvaluationContext) -> Sequence | None:
        if self._last[0] is not context:
            numbers: Sequence | None = context.once(_by_few_rays, self.planner.shared(AllWaves)).get(self)
            if numbers is None:
                numbers = self._on_grid(context)
            else:
                self._on_grid.succeeded = True  # a later lens that is too blurred for the grid is no error
            self._last = context, numbers
        return self._last[1]


class AllWaves:
    """The waves of all rows of modulation in a configuration."""

    def __init__(self, planner: Planner):
        self.planner = planner
        self._waves: dict[tuple, Wave] = {}

    def of(self, line: Line) -> Wave:
        key = line.row.integers, line.row.numbers[0]
        if key not in self._waves:
            self._waves[key] = Wave(line, self.planner)
        return self._waves[key]

    def by_kind(self) -> list[list[Wave]]:
        """The waves that are evaluated together."""
        kinds: dict[tuple, list[Wave]] = {}
        for wave in self._waves.values():
            kinds.setdefault(wave.beam.kind, []).append(wave)
        return list(kinds.values())


def _by_few_rays(context: EvaluationContext, waves: AllWaves) -> dict[Wave, list]:
    """The modulations of the waves that a few rays suffice for."""
    numbers = {}
    for some in waves.by_kind():
        asked = {(f, axis) for wave in some for f, s in wave.asked for axis in range(2) if _SHARES[s][1 - axis]}
        sections = [Section(*each) for each in sorted(asked)]
        modulation, suffice = modulations(context, [wave.beam for wave in some], sections)
        columns = {section: k for k, section in enumerate(sections)}
        for k in np.flatnonzero(suffice):
            by_section = {section: modulation[k][place] for section, place in columns.items()}
            numbers[some[k]] = [
                _mean(s, lambda axis, f=f, values=by_section: values[Section(f, axis)]) for f, s in some[k].asked
            ]
    return numbers


def _mean(section: str, modulation: Callable[..., Number]) -> Number:
    """The MTF of a section, or the mean of both, of the modulation along an axis."""
    return sum(share * modulation(axis) for axis, share in zip((1, 0), _SHARES[section], strict=True) if share)


def _by_waves(lines: Sequence[Line], planner: Planner, *, section: str) -> Evaluate:
    """The MTF of diffraction along one section of the pupil, or the mean of both."""

    def row(line: Line) -> RowValue:
        _check(line)
        wave = planner.shared(AllWaves).of(line)
        return _entry(wave, wave.ask(line.row.numbers[1], section))

    return per_row(map(row, lines))


def _entry(numbers: Callable[[EvaluationContext], Sequence | None], place: int = 0) -> RowValue:
    """The number at a place among those of a context; nan if there are none."""

    def number(context: EvaluationContext) -> Number:
        values = numbers(context)
        return np.nan if values is None else values[place]

    return number


def _check(line: Line) -> None:
    """Check sampling and frequency. Raises BadRow."""
    if not 1 <= line.row.integers[0] <= 6:
        raise BadRow(line, f"has the sampling {line.row.integers[0]}: expected 1 to 6")
    if not line.row.numbers[1] > 0:
        raise BadRow(
            line, f"has the frequency {line.row.numbers[1]:g}: expected cycles/mm above 0 in its fourth column"
        )


def _strehl_ratio(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """The Strehl ratio of one wavelength, or the weighted mean of all."""

    def row(line: Line) -> RowValue:
        field, colours = _field_number(line, planner), colours_of(line, planner)

        def ratio(lens: Lens) -> list[Tensor]:
            ratios = strehl(_scene(lens, field, colours))[0, 0]
            return [(_shares(colours, ratios) * ratios).sum()]

        return _entry(OrLost(line, lambda context: context.state.through_torch(ratio, clips=True)))

    return per_row(map(row, lines))


# -- of rays -----------------------------------------------------------------------------------------------------------


def _by_rays(section: str) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The MTF of rays, |Σ w exp(-2πi ν y)|; times that of a perfect lens where the third number is 0."""
    return lambda lines, planner: per_row(_of_rays(line, section, planner) for line in lines)


def _of_rays(line: Line, section: str, planner: Planner) -> RowValue:
    _check(line)
    frequency, colours = line.row.numbers[1], colours_of(line, planner)
    of_beam = dataclasses.replace(
        line.row,
        integers=(_RINGS * 2 ** (line.row.integers[0] - 1), line.row.integers[1]),
        numbers=(*_field_part(planner, _field_number(line, planner)), 0.0, 0.0),
    )
    beam = beam_of(line._replace(row=of_beam), rings, True, planner)

    def perfect(lens: Lens) -> list[Tensor]:
        parts = clear_circle(frequency / cutoff(lens, lens.wavelengths[list(colours)]))
        return [(_shares(colours, parts) * parts).sum()]

    def modulation(weights: np.ndarray, place: Number) -> Number:
        # As `analysis.mtf` by real numbers: dual numbers are real, and torch would take a pass for each of many rays.
        phase = 2 * np.pi * frequency * (place - weights @ place)
        real, imaginary = weights @ np.cos(phase), weights @ np.sin(phase)
        return np.sqrt(real * real + imaginary * imaginary)

    def number(context: EvaluationContext) -> Number:
        hits = context.hits(beam.rays, clips=True)
        weights = beam.weights(hits.valid)
        if weights is None:
            return np.nan
        contrast = _mean(section, lambda axis: modulation(weights, hits.position[axis]))
        return contrast if line.row.numbers[2] else contrast * context.state.through_torch(perfect)[0]

    return number


_TAKES = "", "colour"
_COLUMNS = "int1 sampling, int2 wavelength (0: all by weight), field number, cycles/mm"
_WAVES = (
    "rays of 7 + int1 rings, 10 at the most, from which the wave follows by polynomials; where apertures stop some, at "
    "least 16 · 2^int1 points across the pupil; the column of the grid is not read"
)
_RAYS = "4 · 2^int1 rings of rays; times the MTF of a perfect lens, unless the column behind the frequency is not 0"

_SECTIONS = {"T": "along y", "S": "along x", "A": "mean of both sections"}

MODULATION = {
    **{
        f"MTF{s}": Operand(
            partial(_by_waves, section=s), f"diffraction MTF {text}; {_COLUMNS}", convention=_WAVES, takes=_TAKES
        )
        for s, text in _SECTIONS.items()
    },
    **{
        f"GMT{s}": Operand(_by_rays(s), f"geometric MTF {text}; {_COLUMNS}", convention=_RAYS, takes=_TAKES)
        for s, text in _SECTIONS.items()
    },
    "STRH": Operand(
        _strehl_ratio,
        "Strehl ratio; int2 wavelength (0: all by weight), field number",
        convention="the best point of the image; as many rays as it needs, int1 is not read; mean of all wavelengths",
        takes=_TAKES,
    ),
}

"""Operands of modulation and of the Strehl ratio.

The MTF of diffraction follows from a few rings of rays, that of rays is a sum over a beam; both are
traced with all the rows' rays. What remains, a beam that apertures clip and the Strehl ratio, are the functions of
`analysis.mtf` and `psf_models.wave`, with their derivatives by torch.

Beams whose modulation of diffraction is asked for: their rays, and the MTF of all of them with its derivatives.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.mtf import clear_circle, cutoff, modulation, otf_along
from raytrace.analysis.pupil_autocorrelation import Fit, exit_pupil, layout_of, otf
from raytrace.analysis.setting import scene_of
from raytrace.maths.dual import Dual, slope_of, value_of
from raytrace.optimization.context import BadRow, Evaluate, EvaluationContext, Found, Line, Operand, Planner
from raytrace.optimization.operands.custom import OrLost
from raytrace.optimization.operands.paraxial import listed
from raytrace.optimization.operands.wavefront import (
    Beam,
    beam_of,
    colours_of,
    image_index,
    rings,
    sphere_of,
)
from raytrace.psf_models.wave import strehl
from raytrace.system.lens import Lens
from raytrace.tracing.aiming import is_bent
from raytrace.tracing.scene import Scene
from raytrace.tracing.wavefront import path_to_reference_sphere, towards_centre

_MISSED = 0.02  # waves of RMS that the polynomials of a wave may leave
_NOTHING = 1e-30  # in the square of a modulation, whose root has a slope there
_RULES = (12, 16, 20, 28, 40, 56, 80, 112, 160)  # points along and across


class Section(NamedTuple):
    """A frequency in cycles/mm of patterns that vary along x (0) or y (1)."""

    frequency: float
    axis: int


class Pupil:
    """The rays of one field (2,) at some wavelengths and their shares.

    Of a field on the y axis of a lens of revolution the right half of the pupil tells the wave, of the axis one arm.
    """

    def __init__(self, planner: Planner, number: int, colours: dict[int, float], degree: int):
        """number: of the field, from 0."""
        fields = planner.lens.fields
        largest = float(torch.hypot(fields.x, fields.y).max()) or 1.0
        self.field = float(fields.x[number]) / largest, float(fields.y[number]) / largest
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
        """What beams have in common that are evaluated together."""
        return self.layout.degree, self.layout.half, len(self.colours)

    def turned(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Components (..., R) of directions, from those of the arm where one tells all."""
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


class Sent(NamedTuple):
    """The waves of beams: `wave` (B, R) in waves, `directions` s (2, B, R) in 1/mm, `places` (2, B) mm of chief rays on
    the image, each with its slopes behind an axis of variables, or None; blur: mm; valid: (B, R)."""

    wave: tuple[np.ndarray, np.ndarray]
    directions: tuple[np.ndarray, np.ndarray]
    places: tuple[np.ndarray, np.ndarray]
    blur: np.ndarray
    valid: np.ndarray


def sent(context: EvaluationContext, beams: Sequence[Pupil]) -> Sent:
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
    found = [path * per_wave[each], *(scale * part for part in towards_centre(hits, *sphere.at(each))[:2])]
    values = [value_of(part).reshape(shape) for part in found]
    slopes = [slope_of(part, count).reshape(count, *shape) for part in found]
    offset = [np.abs(value_of(hits.position[k]) - value_of(chief.position[k])[each]).reshape(shape) for k in range(2)]
    places = [chief.position[k] for k in range(2)]
    return Sent(
        (values[0], slopes[0]),
        (_turned(beams, *values[1:]), _turned(beams, *slopes[1:])),
        (np.stack([value_of(part) for part in places]), np.stack([slope_of(part, count) for part in places], 1)),
        np.maximum(*offset).max(-1),
        hits.valid.reshape(shape) & chief.valid[:, None],
    )


def _turned(beams: Sequence[Pupil], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Components (..., B, R) of all rays, one before the other: (2, ..., B, R)."""
    size = len(beams[0].colours)
    places = [(..., slice(k * size, (k + 1) * size), slice(None)) for k in range(len(beams))]
    return np.concatenate([np.stack(beam.turned(x[at], y[at])) for beam, at in zip(beams, places, strict=True)], -2)


def modulations(
    context: EvaluationContext, beams: Sequence[Pupil], sections: Sequence[Section]
) -> tuple[Dual | np.ndarray, np.ndarray]:
    """MTF (F, Q) of beams of one kind in sections, and for which of them (F,) their rays tell it."""
    light, colours = sent(context, beams), len(beams[0].colours)
    told = light.valid.all(-1).reshape(-1, colours).all(-1)
    values, slopes = (
        np.full((len(beams), len(sections)), np.nan),
        np.zeros((context.state.count, len(beams), len(sections))),
    )
    rule = _rule(light.blur.reshape(-1, colours).max(-1), sections)
    told &= rule > 0
    for chosen in [np.flatnonzero(told)] if told.any() else []:
        some = _picked(light, (chosen[:, None] * colours + np.arange(colours)).ravel())
        fit = Fit(beams[0].layout, some.wave[0], some.directions[0])
        shares = np.stack([beams[k].shares for k in chosen])
        found = _modulated(fit, some, sections, shares, int(rule[chosen].max()), context.state.count)
        values[chosen], slopes[:, chosen] = found
        told[chosen] &= (fit.missed.reshape(-1, colours) < _MISSED).all(-1)
    return (Dual(values, slopes) if context.state.count else values), told


def _picked(light: Sent, rows: np.ndarray) -> Sent:
    wave, directions = ([part[..., rows, :] for part in pair] for pair in (light.wave, light.directions))
    places = [part[..., rows] for part in light.places]
    return Sent(tuple(wave), tuple(directions), tuple(places), light.blur[rows], light.valid[rows])


def _rule(blur: np.ndarray, sections: Sequence[Section]) -> np.ndarray:
    """Points (F,) of a rule that a phase of 2π ν blur to either side asks for; 0 where that is too many."""
    needed = 10 + 4.0 * blur * max(section.frequency for section in sections)
    return np.array([next((n for n in _RULES if n >= least), 0) for least in needed])


def _modulated(fit: Fit, light: Sent, sections: Sequence[Section], shares: np.ndarray, points: int, count: int):
    """MTF (F, Q), and its slopes (n, F, Q)."""
    fields, colours = shares.shape
    axes = np.array([section.axis for section in sections])
    frequencies = np.array([section.frequency for section in sections])
    along_y = torch.from_numpy(axes == 1)[:, None, None, None]
    with torch.set_grad_enabled(count > 0):
        polynomials = torch.from_numpy(fit.polynomials)[:, None].repeat(1, len(sections), 1, 1, 1)
        places = torch.from_numpy(light.places[0])[axes]
        polynomials.requires_grad_(count > 0), places.requires_grad_(count > 0)
        shear = torch.from_numpy(frequencies[:, None] / fit.scale[axes])
        parts = otf(torch.where(along_y, polynomials, polynomials.mT), shear, points)
        turn = -2 * np.pi * torch.from_numpy(frequencies)[:, None] * places
        parts = (parts * torch.exp(1j * turn)).unflatten(-1, (fields, colours))
        total = (torch.from_numpy(shares) * parts).sum(-1)
        found = torch.sqrt(total.real**2 + total.imag**2 + _NOTHING)
    values = found.detach().numpy().T
    if not count:
        return values, np.zeros((0, *values.shape))
    by_fit, by_place = (part.numpy() for part in torch.autograd.grad(found.sum(), (polynomials, places)))
    by_wave, by_directions = fit.by_rays(by_fit)
    slopes = _gathered(by_wave, light.wave[1], fields)
    for k in range(2):
        slopes = slopes + _gathered(by_directions[k], light.directions[1][k], fields)
    moved = (by_place * light.places[1][:, axes]).reshape(count, len(sections), fields, colours).sum(-1)
    return values, slopes + moved.swapaxes(1, 2)


def _gathered(by: np.ndarray, slopes: np.ndarray, fields: int) -> np.ndarray:
    """Σ over the rays and colours of a field: from (Q, B, R) and (n, B, R) to (n, F, Q)."""
    one = by.reshape(len(by), fields, -1).transpose(1, 2, 0)
    return (slopes.reshape(len(slopes), fields, -1).transpose(1, 0, 2) @ one).swapaxes(0, 1)


_POINTS = 32  # across the pupil at sampling 1
_RINGS = 8  # of rays at sampling 1
_DEGREE, _HIGHEST = 10, 16  # of the polynomials of a wave, at sampling 0 and of any

#: Tangential, sagittal, and their mean.
_SHARES = {"T": (1.0, 0.0), "S": (0.0, 1.0), "A": (0.5, 0.5)}


def field_of(line: Line, planner: Planner) -> Tensor:
    """The field (2, 1) whose number stands where others have Hx. Raises BadRow."""
    fields, number = planner.lens.fields, line.row.numbers[0]
    if number != int(number) or not 1 <= number <= len(fields.x):
        raise BadRow(line, f"names field {number:g}: this lens has fields 1 to {len(fields.x)}")
    return torch.stack([fields.x, fields.y])[:, int(number) - 1, None]


def view_of(lens: Lens, field: Tensor, colours: Sequence[int]) -> Scene:
    """The scene of a field and some of the wavelengths."""
    return dataclasses.replace(scene_of(lens, field), wavelengths=lens.wavelengths[list(colours)])


def shares_of(colours: dict[int, float], like: Tensor) -> Tensor:
    weights = like.new_tensor(list(colours.values()))
    return weights / weights.sum()


# -- of diffraction ----------------------------------------------------------------------------------------------------


def diffraction_mtf(
    lens: Lens, field: Tensor, colours: dict[int, float], frequencies: Tensor, least: int
) -> tuple[Tensor, Tensor]:
    """Tangential and sagittal MTF (K,) of one field and some wavelengths, by weight, each at its own place.

    least: points across the pupil, more where the blur needs them.
    """
    pupil = exit_pupil(view_of(lens, field, colours), least=least)
    weights = shares_of(colours, pupil.light) * pupil.light
    shift = pupil.centre - pupil.centre[..., :1]
    sections = zip((pupil.amplitude.mT, pupil.amplitude), pupil.step.flip(0), shift.flip(0), strict=True)
    return tuple(
        modulation(otf_along(lines, pupil.energy, frequencies, step), frequencies, place, weights)[0]
        for lines, step, place in sections
    )


class Wave:
    """The wave of one field at one sampling, of one wavelength or all, and what rows of any operand ask of it.

    From the rays of a few rings (`pupil_autocorrelation.py`). Where apertures stop some of them, from
    those of a grid by torch, with a pass backward for each number.
    """

    def __init__(self, line: Line, planner: Planner):
        self.planner, self.field, self.colours = planner, field_of(line, planner), colours_of(line, planner)
        self.least = _POINTS * 2 ** (line.row.integers[0] - 1)
        self.asked: dict[tuple[float, str], int] = {}
        self._numbers = OrLost(line, lambda context: context.state.through_torch(self.told, clips=True))
        self._found: tuple[EvaluationContext | None, Sequence | None] = None, None
        degree = min(_DEGREE + 2 * line.row.integers[0], _HIGHEST)
        self.beam = Pupil(planner, int(line.row.numbers[0]) - 1, self.colours, degree)

    def ask(self, frequency: float, section: str) -> int:
        return self.asked.setdefault((frequency, section), len(self.asked))

    def told(self, lens: Lens) -> list[Tensor]:
        frequencies = sorted({frequency for frequency, _ in self.asked})
        every = lens.wavelengths.new_tensor(frequencies)
        both = diffraction_mtf(lens, self.field, self.colours, every, self.least)
        at = {frequency: k for k, frequency in enumerate(frequencies)}
        return [sum(share * m[at[f]] for share, m in zip(_SHARES[s], both, strict=True)) for f, s in self.asked]

    def __call__(self, context: EvaluationContext) -> Sequence | None:
        if self._found[0] is not context:
            told = context.once(_by_few_rays, self.planner.shared(Waves)).get(self)
            self._found = context, self._numbers(context) if told is None else told
        return self._found[1]


class Waves:
    """The waves of all rows of modulation in a configuration."""

    def __init__(self, planner: Planner):
        self.planner, self._found = planner, {}

    def of(self, line: Line) -> Wave:
        key = line.row.integers, line.row.numbers[0]
        if key not in self._found:
            self._found[key] = Wave(line, self.planner)
        return self._found[key]

    def by_kind(self) -> list[list[Wave]]:
        """Those that are evaluated together."""
        found: dict[tuple, list[Wave]] = {}
        for wave in self._found.values():
            found.setdefault(wave.beam.kind, []).append(wave)
        return list(found.values())


def _by_few_rays(context: EvaluationContext, waves: Waves) -> dict[Wave, list]:
    """What waves are asked for, of those that a few rays tell."""
    found = {}
    for some in waves.by_kind():
        asked = {(f, axis) for one in some for f, s in one.asked for axis in range(2) if _SHARES[s][1 - axis]}
        sections = [Section(*each) for each in sorted(asked)]
        modulation, told = modulations(context, [one.beam for one in some], sections)
        at = {section: k for k, section in enumerate(sections)}
        for k in np.flatnonzero(told):
            found[some[k]] = [_shared(modulation[k], at, *each) for each in some[k].asked]
    return found


def _shared(modulation, at: dict[Section, int], frequency: float, section: str):
    """The MTF of a section, or the mean of two, from those (Q,) of a beam."""
    shares = zip((1, 0), _SHARES[section], strict=True)
    return sum(share * modulation[at[Section(frequency, axis)]] for axis, share in shares if share)


def by_waves(section: str) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The MTF of diffraction along one section of the pupil, or the mean of both."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        asked = []
        for line in lines:
            _check(line)
            wave = planner.shared(Waves).of(line)
            asked.append((wave, wave.ask(line.row.numbers[1], section)))

        def evaluate(context: EvaluationContext) -> Found:
            found = [(wave(context), place) for wave, place in asked]
            return Found(listed([np.nan if n is None else n[place] for n, place in found], context.state.count))

        return evaluate

    return plan


def _check(line: Line) -> None:
    if not 1 <= line.row.integers[0] <= 6:
        raise BadRow(line, f"has the sampling {line.row.integers[0]}: expected 1 to 6")
    if not line.row.numbers[1] > 0:
        raise BadRow(
            line, f"has the frequency {line.row.numbers[1]:g}: expected cycles/mm above 0 in its fourth column"
        )


def strehl_ratio(lines: Sequence[Line], planner: Planner) -> Evaluate:
    """Of one wavelength, or the mean of all by weight."""

    def of(line: Line) -> OrLost:
        field, colours = field_of(line, planner), colours_of(line, planner)

        def told(lens: Lens) -> list[Tensor]:
            ratios = strehl(view_of(lens, field, colours))[0, 0]
            return [(shares_of(colours, ratios) * ratios).sum()]

        return OrLost(line, lambda context: context.state.through_torch(told, clips=True))

    tell = [of(line) for line in lines]

    def evaluate(context: EvaluationContext) -> Found:
        found = [numbers(context) for numbers in tell]
        return Found(listed([np.nan if n is None else n[0] for n in found], context.state.count))

    return evaluate


# -- of rays -----------------------------------------------------------------------------------------------------------


def by_rays(section: str) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The MTF of rays, |Σ w exp(-2πi ν y)|; times that of a perfect lens where the third number is 0."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        tell = [_of_rays(line, section, planner) for line in lines]
        return lambda context: Found(listed([one(context) for one in tell], context.state.count))

    return plan


def _of_rays(line: Line, section: str, planner: Planner) -> Callable[[EvaluationContext], object]:
    _check(line)
    frequency = line.row.numbers[1]
    beam = _beam(line, planner)
    colours = colours_of(line, planner)

    def perfect(lens: Lens) -> list[Tensor]:
        parts = clear_circle(frequency / cutoff(lens, lens.wavelengths[list(colours)]))
        return [(shares_of(colours, parts) * parts).sum()]

    def tell(context: EvaluationContext):
        hits = context.hits(beam.rays, clips=True)
        weights = beam.weights(hits.valid)
        if weights is None:
            return np.nan
        shares = zip((1, 0), _SHARES[section], strict=True)
        found = sum(share * _modulation(weights, hits.position[k], frequency) for k, share in shares if share)
        return found if line.row.numbers[2] else found * context.state.through_torch(perfect)[0]

    return tell


def _beam(line: Line, planner: Planner) -> Beam:
    """The beam of a row whose field is told by its number."""
    largest = float(torch.hypot(planner.lens.fields.x, planner.lens.fields.y).max())
    x, y = (field_of(line, planner)[:, 0] / (largest or 1.0)).tolist()
    row = dataclasses.replace(line.row, integers=(_RINGS * 2 ** (line.row.integers[0] - 1), line.row.integers[1]))
    row = dataclasses.replace(row, numbers=(x, y, 0.0, 0.0))
    return beam_of(line._replace(row=row), rings, True, planner)


def _modulation(weights: np.ndarray, place, frequency: float):
    phase = 2 * np.pi * frequency * (place - weights @ place)
    real, imaginary = weights @ np.cos(phase), weights @ np.sin(phase)
    return np.sqrt(real * real + imaginary * imaginary)


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
        f"MTF{s}": Operand(by_waves(s), f"diffraction MTF {text}; {_COLUMNS}", convention=_WAVES, takes=_TAKES)
        for s, text in _SECTIONS.items()
    },
    **{
        f"GMT{s}": Operand(by_rays(s), f"geometric MTF {text}; {_COLUMNS}", convention=_RAYS, takes=_TAKES)
        for s, text in _SECTIONS.items()
    },
    "STRH": Operand(
        strehl_ratio,
        "Strehl ratio; int2 wavelength (0: all by weight), field number",
        convention="the best point of the image; as many rays as it needs, int1 is not read; mean of all wavelengths",
        takes=_TAKES,
    ),
}

"""Operands of modulation and of the Strehl ratio.

The MTF of diffraction follows from a few rings of rays (`sheared.py`), that of rays is a sum over a beam; both are
traced with all the rows' rays. What remains, a beam that apertures clip and the Strehl ratio, are the functions of
`analysis.mtf` and `kernels.diffraction`, with their derivatives by torch.
"""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.aperture import exit_pupil
from raytrace.analysis.mtf import clear_circle, cutoff, modulation, otf_along
from raytrace.analysis.setting import scene_of
from raytrace.kernels.diffraction import strehl
from raytrace.merit.measure import OrLost
from raytrace.merit.paraxial import listed
from raytrace.merit.plan import BadRow, Evaluate, Found, Line, Now, Operand, Planner
from raytrace.merit.quality import Beam, beam_of, colours_of, rings
from raytrace.merit.sheared import Pupil, Section, modulations
from raytrace.optics.scene import Scene
from raytrace.system.lens import Lens

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

    From the rays of a few rings (`shear.py`). Where these do not tell it, as where apertures stop some of them, from
    those of a grid by torch, with a pass backward for each number.
    """

    def __init__(self, line: Line, planner: Planner):
        self.planner, self.field, self.colours = planner, field_of(line, planner), colours_of(line, planner)
        self.least = _POINTS * 2 ** (line.row.integers[0] - 1)
        self.asked: dict[tuple[float, str], int] = {}
        self._numbers = OrLost(line, lambda now: now.moment.through_torch(self.told, clips=True))
        self._found: tuple[Now | None, Sequence | None] = None, None
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

    def __call__(self, now: Now) -> Sequence | None:
        if self._found[0] is not now:
            told = now.once(_by_few_rays, self.planner.shared(Waves)).get(self)
            self._found = now, self._numbers(now) if told is None else told
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


def _by_few_rays(now: Now, waves: Waves) -> dict[Wave, list]:
    """What waves are asked for, of those that a few rays tell."""
    found = {}
    for some in waves.by_kind():
        asked = {(f, axis) for one in some for f, s in one.asked for axis in range(2) if _SHARES[s][1 - axis]}
        sections = [Section(*each) for each in sorted(asked)]
        modulation, told = modulations(now, [one.beam for one in some], sections)
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

        def evaluate(now: Now) -> Found:
            found = [(wave(now), place) for wave, place in asked]
            return Found(listed([np.nan if n is None else n[place] for n, place in found], now.moment.count))

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

        return OrLost(line, lambda now: now.moment.through_torch(told, clips=True))

    tell = [of(line) for line in lines]

    def evaluate(now: Now) -> Found:
        found = [numbers(now) for numbers in tell]
        return Found(listed([np.nan if n is None else n[0] for n in found], now.moment.count))

    return evaluate


# -- of rays -----------------------------------------------------------------------------------------------------------


def by_rays(section: str) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The MTF of rays, |Σ w exp(-2πi ν y)|; times that of a perfect lens where the third number is 0."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        tell = [_of_rays(line, section, planner) for line in lines]
        return lambda now: Found(listed([one(now) for one in tell], now.moment.count))

    return plan


def _of_rays(line: Line, section: str, planner: Planner) -> Callable[[Now], object]:
    _check(line)
    frequency = line.row.numbers[1]
    beam = _beam(line, planner)
    colours = colours_of(line, planner)

    def perfect(lens: Lens) -> list[Tensor]:
        parts = clear_circle(frequency / cutoff(lens, lens.wavelengths[list(colours)]))
        return [(shares_of(colours, parts) * parts).sum()]

    def tell(now: Now):
        hits = now.hits(beam.rays, clips=True)
        weights = beam.weights(hits.valid)
        if weights is None:
            return np.nan
        shares = zip((1, 0), _SHARES[section], strict=True)
        found = sum(share * _modulation(weights, hits.position[k], frequency) for k, share in shares if share)
        return found if line.row.numbers[2] else found * now.moment.through_torch(perfect)[0]

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
        f"MTF{s}": Operand(by_waves(s), f"diffraction MTF {text}; {_COLUMNS}", reading=_WAVES, takes=_TAKES)
        for s, text in _SECTIONS.items()
    },
    **{
        f"GMT{s}": Operand(by_rays(s), f"geometric MTF {text}; {_COLUMNS}", reading=_RAYS, takes=_TAKES)
        for s, text in _SECTIONS.items()
    },
    "STRH": Operand(
        strehl_ratio,
        "Strehl ratio; int2 wavelength (0: all by weight), field number",
        reading="the best point of the image; as many rays as it needs, int1 is not read; of all wavelengths the mean",
        takes=_TAKES,
    ),
}

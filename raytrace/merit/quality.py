"""Operands of image quality: RMS of spots and wavefronts over a whole beam.

A beam is traced with all the rows' rays. Its RMS is the length of a vector, an entry for every ray, which is what the
solver is given: smooth where the RMS is 0, and no second derivative is lost.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from raytrace.maths.dual import Dual, slope_of, value_of
from raytrace.maths.pupil import gauss_rings, square
from raytrace.merit.path import Fit, opd_of
from raytrace.merit.plan import BadRow, Evaluate, Found, Line, Now, Operand, Planner

_LEAST_ARMS = 6


class Beam(NamedTuple):
    """The rays (R,) of a row: their numbers, colours (from 0), pupil points (2, R), and shares of the light.

    clips: whether apertures stop some; then what arrives counts, else a ray that does not leaves no value.
    """

    line: Line
    rays: np.ndarray
    colours: np.ndarray
    points: np.ndarray
    shares: np.ndarray
    clips: bool

    def weights(self, valid: np.ndarray) -> np.ndarray | None:
        """Shares of those that arrive, 1 together; None where the row has no value."""
        if not valid.all() and not (self.clips and valid.any()):
            return None
        shares = self.shares * valid
        return shares / shares.sum()


def rings(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (2, P) and weights (P,) of Gaussian quadrature in r², four arms a ring and six at the least."""
    return tuple(part.numpy() for part in gauss_rings(count, max(4 * count, _LEAST_ARMS)))


def rectangular(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Those of the cells of a square grid inside the pupil, `count` of them along half its side."""
    return tuple(part.numpy() for part in square(2 * count))


def beam_of(line: Line, rule: Callable, clips: bool, planner: Planner) -> Beam:
    """int1: the size of the rule; int2: the wavelength, 0 for all by their weights; Hx, Hy: the field."""
    if line.row.integers[0] < 1:
        raise BadRow(line, "asks for no rays: give 1 ring or more")
    points, weights = rule(line.row.integers[0])
    colours = colours_of(line, planner)
    rays = [planner.ask(w, line.field, point, clips=clips) for w in colours for point in points.T.tolist()]
    every = np.repeat(np.array(list(colours)), len(weights))
    shares = (np.array(list(colours.values()))[:, None] * weights).ravel()
    return Beam(line, np.array(rays), every, np.tile(points, len(colours)), shares / shares.sum(), clips)


def colours_of(line: Line, planner: Planner) -> dict[int, float]:
    """Wavelengths, from 0, that a row is about, and their weights: its own, or with int2 = 0 all that have one."""
    if line.row.integers[1] > 0:
        return {line.wavelength: 1.0}
    weights = planner.lens.wavelength_weights.tolist()
    return {w: weight for w, weight in enumerate(weights) if weight > 0}


def rms_of(vectors: Callable, rule: Callable, *, clips: bool) -> Callable[[Sequence[Line], Planner], Evaluate]:
    """The RMS of rows, each the length of what `vectors` gives of its beam."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        tell = vectors([beam_of(line, rule, clips, planner) for line in lines], planner)

        def evaluate(now: Now) -> Found:
            parts = _side_by_side(tell(now), now.moment.count)
            return Found(np.sqrt((parts * parts).sum(0)), (parts,))

        return evaluate

    return plan


def _side_by_side(vectors: Sequence, count: int):
    """Vectors (K,) of any length, or None, as columns (K, R), 0 below and nan for None."""
    longest = max((len(value_of(one)) for one in vectors if one is not None), default=1)
    values, slopes = np.zeros((longest, len(vectors))), np.zeros((count, longest, len(vectors)))
    for column, one in enumerate(vectors):
        if one is None:
            values[:, column] = np.nan
            continue
        size = len(value_of(one))
        values[:size, column] = value_of(one)
        if count:
            slopes[:, :size, column] = slope_of(one, count)
    return Dual(values, slopes) if count else values


def spot(*, about_chief: bool):
    """√w (x - x₀) and √w (y - y₀) mm on the image, from the centroid or the primary wavelength's chief ray."""

    def vectors(beams: Sequence[Beam], planner: Planner) -> Callable[[Now], list]:
        chiefs = [np.array([planner.ask(planner.primary, beam.line.field, (0.0, 0.0))]) for beam in beams]

        def of(beam: Beam, chief: np.ndarray, now: Now):
            hits, centre = now.hits(beam.rays, clips=beam.clips), now.hits(chief)
            weights = beam.weights(hits.valid)
            if weights is None or (about_chief and not centre.valid[0]):
                return None
            root, parts = np.sqrt(weights), []
            for k in range(2):
                place = hits.position[k]
                parts.append(root * (place - (centre.position[k][0] if about_chief else weights @ place)))
            return np.concatenate(parts)

        return lambda now: [of(beam, chief, now) for beam, chief in zip(beams, chiefs, strict=True)]

    return vectors


def wave(*, tilted: bool):
    """√w W, waves, about the mean of each colour on its own sphere; tilted: about its tilt too, the centroid's."""

    def vectors(beams: Sequence[Beam], planner: Planner) -> Callable[[Now], list]:
        rays = np.concatenate([beam.rays for beam in beams])
        own = [(w, beam.line.field) for beam in beams for w in beam.colours.tolist()]
        opd = opd_of(rays, own, planner, clips=beams[0].clips)
        ends = np.cumsum([len(beam.rays) for beam in beams])
        places = [slice(end - len(beam.rays), end) for beam, end in zip(beams, ends, strict=True)]
        fits = [Fit(_terms(beam, tilted), beam.shares) for beam in beams]

        def tell(now: Now) -> list:
            valid, found = opd(now)
            return [of(*one, valid, found) for one in zip(beams, fits, places, strict=True)]

        return tell

    def of(beam: Beam, fit: Fit, place: slice, valid: np.ndarray, found):
        weights = beam.weights(valid[place])
        return None if weights is None else np.sqrt(weights) * fit.less(found[place], valid[place])

    return vectors


def _terms(beam: Beam, tilted: bool) -> np.ndarray:
    """(R, K): of every colour 1 and, where `tilted`, the pupil point."""
    own = (beam.colours[:, None] == np.unique(beam.colours)).astype(float)
    return np.concatenate([own, *(own * part[:, None] for part in beam.points)] if tilted else [own], 1)


_RINGS = "int1 rings of four arms each, six at the least; a ray that does not arrive leaves no value"
_GRID = "a grid of 2 int1 × 2 int1 cells across the pupil; what apertures stop does not count"

_TABLE = {
    "RSCE": (spot(about_chief=False), True, "RMS radius of a spot about its centroid"),
    "RSCH": (spot(about_chief=True), True, "RMS radius of a spot about the chief ray of the primary wavelength"),
    "RSRE": (spot(about_chief=False), False, "RMS radius of a spot about its centroid"),
    "RSRH": (spot(about_chief=True), False, "RMS radius of a spot about the chief ray of the primary wavelength"),
    "RWCE": (wave(tilted=True), True, "RMS wavefront error about the centroid, waves"),
    "RWCH": (wave(tilted=False), True, "RMS wavefront error about the chief ray, waves"),
    "RWRE": (wave(tilted=True), False, "RMS wavefront error about the centroid, waves"),
    "RWRH": (wave(tilted=False), False, "RMS wavefront error about the chief ray, waves"),
}

QUALITY = {
    name: Operand(
        rms_of(vector, rings if whole else rectangular, clips=not whole),
        f"{text}; int1 rays, int2 wavelength (0: all by weight), Hx Hy",
        length=1 if name.startswith("RS") else 0,
        reading=_RINGS if whole else _GRID,
        takes=("", "colour"),
    )
    for name, (vector, whole, text) in _TABLE.items()
}

"""Operands of optical path: the wavefront against a reference sphere, its RMS and that of spots, paths of single rays.

The sphere is centred where the chief ray meets the image and passes through the axial point of the exit pupil; that of
`wavefront_of` has the radius along the chief ray from the plane of the exit pupil.

A row of an RMS is traced with all other rows' rays. Its RMS is the length of a vector, an entry for every ray, which
the solver uses: smooth where the RMS is 0, and no second derivative is lost.
"""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple, TypeAlias

import numpy as np
from torch import Tensor

from raytrace.maths.numerics import Dual, Number, Vector, dot, slope_of, value_of
from raytrace.maths.sampling import gauss_rings, square
from raytrace.optimization.lens_state import Hits
from raytrace.optimization.operands.operand import (
    BadRow,
    Evaluate,
    EvaluationContext,
    Line,
    Operand,
    Plan,
    Planner,
    RowValue,
    RowValues,
    known,
    per_row,
)
from raytrace.optimization.operands.paraxial import image_index
from raytrace.system.lens import Lens
from raytrace.system.surface import is_flat
from raytrace.tracing.base_ray import base_ray
from raytrace.tracing.trace import is_bent
from raytrace.tracing.wavefront import path_to_reference_sphere


class Sphere(NamedTuple):
    """Reference spheres (...): centre, three of mm on the image; curvature κ = 1/R in 1/mm along the light."""

    centre: Vector
    curvature: Number

    def at(self, places: np.ndarray) -> "Sphere":
        return Sphere(Vector(part[places] for part in self.centre), self.curvature[places])


def sphere_of(context: EvaluationContext, chief: Hits, bent: bool) -> Sphere:
    """Reference spheres about the image points of chief rays, through the exit pupil of the primary wavelength.

    κ = 0 for a pupil at infinity.

        κ = D sign(v·d)/|v|,   v = D (C - E),   E_z = -n′ B/D - T

    B, D: of the lens behind the stop; T: behind its last surface. Where the axis bends, the pupil lies on the base ray,
    halfway between the images of the stop in both sections by vergence.
    """
    centre = x, y, z = Vector(chief.position)
    if bent:
        *base, weight = context.state.through_torch(_pupil_on_base_ray(context.planner.primary))
        v = tuple(weight * (c - b) - d for c, b, d in zip(centre, base[:3], base[3:], strict=True))
    else:
        data = context.state.gaussian(context.planner.primary)
        B, weight = data.rear
        v = weight * x, weight * y, weight * (z + context.state.thickness[-2]) + data.n_image * B
    side = np.sign(value_of(dot(v, chief.direction)))
    return Sphere(centre, side * weight / np.sqrt(dot(v, v)))


def _pupil_on_base_ray(wavelength: int) -> Callable[[Lens], Sequence[Tensor]]:
    """A function of a lens: image point and direction of the base ray, and the mean vergence of the pupils in 1/mm."""

    def numbers(lens: Lens) -> Sequence[Tensor]:
        base = base_ray(lens, lens.wavelengths[wavelength])
        return *base.position, *base.direction, 0.5 * (1 / base.exit_pupil_position).sum(0)

    return numbers


# -- the wavefront -----------------------------------------------------------------------------------------------------


def opd_of(
    rays: np.ndarray, beams: Sequence[tuple], planner: Planner, *, clips: bool = False
) -> Callable[[EvaluationContext], tuple[np.ndarray, Number]]:
    """OPD (R,) in waves of rays by their numbers, and which of them and their chief rays arrive.

    beams: (wavelength from 0, field) of each; clips: whether apertures stop rays, though not chief rays.
    """
    numbers = {beam: number for number, beam in enumerate(dict.fromkeys(beams))}
    rows = np.array([numbers[beam] for beam in beams])
    chief = centres = np.array([planner.ask(w, field, (0.0, 0.0)) for w, field in numbers])
    if planner.conventions.opd_chief == "primary":
        centres = np.array([planner.ask(planner.primary, field, (0.0, 0.0)) for _, field in numbers])
    wavelength = np.array([w for w, _ in numbers])
    waves = 1e-3 * np.array(planner.view.wavelengths)[wavelength]
    waves = waves if planner.conventions.opd_sign == "longer" else -waves
    bent = is_bent(planner.lens)

    def opd(context: EvaluationContext) -> tuple[np.ndarray, Number]:
        hits, chief_hits, about = context.hits(rays, clips=clips), context.hits(chief), context.hits(centres)
        sphere, index = sphere_of(context, about, bent), image_index(context, wavelength)
        zero = path_to_reference_sphere(chief_hits, *sphere, index)
        difference = (path_to_reference_sphere(hits, *sphere.at(rows), index[rows]) - zero[rows]) / waves[rows]
        return hits.valid & (chief_hits.valid & about.valid)[rows], difference

    return opd


def _opd_less(
    lines: Sequence[Line], planner: Planner, *, terms: Callable[[Sequence[Line], Planner], np.ndarray]
) -> Evaluate:
    """OPD in waves less the best fit of some terms (R, K) of rows, by the weights of the rows; K = 0: the OPD."""
    opd = opd_of(planner.rays(lines), [(line.wavelength, line.field) for line in lines], planner)
    weights = np.array([max(line.row.weight, 0.0) for line in lines])
    for places in _groups(lines):
        if not weights[places].any():
            weights[places] = 1.0
    fit = Fit(terms(lines, planner), weights)

    def evaluate(context: EvaluationContext) -> RowValues:
        valid, values = opd(context)
        return RowValues(known(valid, fit.less(values, valid)))

    return evaluate


class Fit:
    """Least squares with basis (R, K) and weights (R,): v - B (√w B)⁺ √w v, over the valid entries."""

    def __init__(self, basis: np.ndarray, weights: np.ndarray):
        self.basis, self.weights = basis, weights
        self.inverse = self._inverse(weights)

    def _inverse(self, weights: np.ndarray) -> np.ndarray:
        root = np.sqrt(weights)
        return np.linalg.pinv(root[:, None] * self.basis) * root

    def less(self, values: Number, valid: np.ndarray) -> Number:
        """Values (R,) less their fit; valid: (R,)."""
        if not self.basis.shape[1]:
            return values
        inverse = self.inverse if valid.all() else self._inverse(self.weights * valid)
        return values - self.basis @ (inverse @ values)


def _groups(lines: Sequence[Line], *, colours: bool = True) -> list[list[int]]:
    """Places of the rows of each field, and, unless `colours` is False, of each wavelength."""
    groups: dict[tuple, list[int]] = {}
    for place, line in enumerate(lines):
        groups.setdefault((line.field, line.wavelength if colours else None), []).append(place)
    return list(groups.values())


def _nothing(lines: Sequence[Line], planner: Planner) -> np.ndarray:
    return np.zeros((len(lines), 0))


def _piston(lines: Sequence[Line], planner: Planner) -> np.ndarray:
    """1 for each field and wavelength."""
    return _columns(lines, _groups(lines), np.ones(len(lines)))


def _piston_and_tilt(lines: Sequence[Line], planner: Planner) -> np.ndarray:
    """1 for each field and wavelength, and the pupil point, by the convention `opd_tilt`.

    A field that is mirrored in a plane through the axis, of whose pupil rows leave out half, has no tilt out of it. A
    tilt that all wavelengths have in common is one of the path: more waves of the shorter ones.
    """
    x, y = np.array([line.pupil for line in lines]).T
    if planner.view.is_symmetric:
        on_y = np.array([line.field[0] == 0 for line in lines])
        x, y = np.where(on_y, 0.0, x), np.where(on_y & [line.field[1] == 0 for line in lines], 0.0, y)
    groups = _groups(lines)
    if planner.conventions.opd_tilt == "common":
        groups = _groups(lines, colours=False)
        waves = np.array(planner.view.wavelengths)[[line.wavelength for line in lines]]
        x, y = x / waves, y / waves
    return np.concatenate([_piston(lines, planner), _columns(lines, groups, x), _columns(lines, groups, y)], 1)


def _columns(lines: Sequence[Line], groups: list[list[int]], number: np.ndarray) -> np.ndarray:
    columns = np.zeros((len(lines), len(groups)))
    for column, places in enumerate(groups):
        columns[places, column] = number[places]
    return columns[:, columns.any(0)]


# -- paths of single rays ----------------------------------------------------------------------------------------------


def _between_surfaces(leg: Callable[[Line, Planner], tuple[int, int, int]]) -> Plan:
    """Optical path in mm of a ray between two surfaces.

    leg: both, and the wavelength; surface 0 is the object, or surface 1 for an object at infinity.
    """
    return lambda lines, planner: per_row(_path_of(line, *leg(line, planner), planner) for line in lines)


def _path_of(line: Line, first: int, last: int, wavelength: int, planner: Planner) -> RowValue:
    """The reduced path between the surfaces, and that of the axis."""
    first, last = sorted((first, last))
    source = planner.lens.surfaces[0]
    from_object = first == 0 and bool(source.thickness.isfinite())
    if from_object and not is_flat(source):
        raise BadRow(line, "measures from a curved or tilted object, which it cannot; name another surface")
    first = max(first, 1)
    start, end = (np.array([planner.ray(line, surface=s, wavelength=wavelength)]) for s in (first, max(last, 1)))

    def path(context: EvaluationContext) -> Number:
        hits, behind = context.hits(start, surface=first), context.hits(end, surface=max(last, 1))
        index, gaps = context.state.index(wavelength), context.state.thickness
        length = behind.opl - hits.opl + sum(index[k] * gaps[k] for k in range(first, last))
        if from_object:
            launch = context.starts(start, first)
            way = (launch.position[2] + gaps[0]) / launch.direction[2]
            length = length + (hits.opl - launch.opl) + index[0] * way
        return known(hits.valid & behind.valid, length)[0]

    return path


_WAVELENGTH = "", "wavelength"
_SPHERE = (
    "about the image point of the chief ray of the row's wavelength (convention `opd_chief`), through the axial point "
    "of the exit pupil; a longer path is positive (`opd_sign`)"
)

PATH = {
    "OPDC": Operand(
        partial(_opd_less, terms=_nothing),
        "optical path difference to the chief ray, waves; Hx Hy Px Py",
        convention=_SPHERE,
        takes=_WAVELENGTH,
    ),
    "OPDM": Operand(
        partial(_opd_less, terms=_piston),
        "the same less its mean over the rows of its field and wavelength, by weight",
        convention=_SPHERE,
        takes=_WAVELENGTH,
    ),
    "OPDX": Operand(
        partial(_opd_less, terms=_piston_and_tilt),
        "the same less the piston and tilt that fit its field and wavelength best, by weight",
        convention=f"{_SPHERE}; a tilt for every wavelength (`opd_tilt`)",
        takes=_WAVELENGTH,
    ),
    "OPTH": Operand(
        _between_surfaces(lambda line, planner: (0, line.row.integers[0], line.wavelength)),
        "optical path of a ray to a surface, from the object, or from surface 1 if that is at infinity",
        length=1,
        takes=("surface", "wavelength"),
    ),
    "PLEN": Operand(
        _between_surfaces(lambda line, planner: (*line.row.integers, planner.primary)),
        "optical path of a ray of the primary wavelength from one surface to another",
        length=1,
        takes=("surface", "surface"),
    ),
}


# -- beams: RMS of spots and wavefronts --------------------------------------------------------------------------------

_LEAST_ARMS = 6


class Beam(NamedTuple):
    """The rays (R,) of a row: their numbers, colours (from 0), pupil points (2, R), and shares of the light.

    clips: whether apertures stop some; then the rays that arrive count, else a lost ray leaves no value.
    """

    line: Line
    rays: np.ndarray
    colours: np.ndarray
    points: np.ndarray
    shares: np.ndarray
    clips: bool

    def weights(self, valid: np.ndarray) -> np.ndarray | None:
        """Shares of the rays that arrive, 1 together; None where the row has no value."""
        if not valid.all() and not (self.clips and valid.any()):
            return None
        shares = self.shares * valid
        return shares / shares.sum()


#: Pupil points (2, P) and weights (P,) of a rule by its size.
Rule: TypeAlias = Callable[[int], tuple[np.ndarray, np.ndarray]]

#: The vectors of beams at a state, None of a beam without a value.
Vectors: TypeAlias = Callable[[Sequence[Beam], Planner], Callable[[EvaluationContext], list[Number]]]


def rings(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (2, P) and weights (P,) of Gaussian quadrature in r², four arms a ring and six at the least."""
    points, weights = gauss_rings(count, max(4 * count, _LEAST_ARMS))
    return points.numpy(), weights.numpy()


def _rectangular(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and weights of the cells of a square grid inside the pupil, `count` of them along half its side."""
    points, weights = square(2 * count)
    return points.numpy(), weights.numpy()


def beam_of(line: Line, rule: Rule, clips: bool, planner: Planner) -> Beam:
    """int1: the size of the rule; int2: the wavelength, 0 for all by their weights; Hx, Hy: the field."""
    if line.row.integers[0] < 1:
        raise BadRow(line, "asks for no rays: give 1 ring or more")
    points, weights = rule(line.row.integers[0])
    colours = colours_of(line, planner)
    rays = [planner.ask(w, line.field, point, clips=clips) for w in colours for point in points.T.tolist()]
    of_ray = np.repeat(np.array(list(colours)), len(weights))
    shares = (np.array(list(colours.values()))[:, None] * weights).ravel()
    return Beam(line, np.array(rays), of_ray, np.tile(points, len(colours)), shares / shares.sum(), clips)


def colours_of(line: Line, planner: Planner) -> dict[int, float]:
    """Wavelengths of a row, from 0, and their weights: its own, or with int2 = 0 all that have one."""
    if line.row.integers[1] > 0:
        return {line.wavelength: 1.0}
    weights = planner.lens.wavelength_weights.tolist()
    return {w: weight for w, weight in enumerate(weights) if weight > 0}


def _rms_of(lines: Sequence[Line], planner: Planner, *, vectors: Vectors, rule: Rule, clips: bool) -> Evaluate:
    """The RMS of rows, each the length of the vector of its beam; vectors: None of a row without a value."""
    of_beams = vectors([beam_of(line, rule, clips, planner) for line in lines], planner)

    def evaluate(context: EvaluationContext) -> RowValues:
        columns, count = of_beams(context), context.state.count
        longest = max((len(value_of(column)) for column in columns if column is not None), default=1)
        values, slopes = np.zeros((longest, len(lines))), np.zeros((count, longest, len(lines)))
        for place, column in enumerate(columns):
            if column is None:
                values[:, place] = np.nan
                continue
            size = len(value_of(column))
            values[:size, place] = value_of(column)
            slopes[:, :size, place] = slope_of(column, count)
        parts = Dual(values, slopes) if count else values
        return RowValues(np.sqrt((parts * parts).sum(0)), (parts,))

    return evaluate


def _spot(*, about_chief: bool) -> Vectors:
    """√w (x - x₀) and √w (y - y₀) mm on the image, from the centroid or the primary wavelength's chief ray."""

    def vectors(beams: Sequence[Beam], planner: Planner) -> Callable[[EvaluationContext], list[Number]]:
        chiefs = [np.array([planner.ask(planner.primary, beam.line.field, (0.0, 0.0))]) for beam in beams]

        def of(beam: Beam, chief: np.ndarray, context: EvaluationContext) -> Number:
            hits, centre = context.hits(beam.rays, clips=beam.clips), context.hits(chief)
            weights = beam.weights(hits.valid)
            if weights is None or (about_chief and not centre.valid[0]):
                return None
            root, parts = np.sqrt(weights), []
            for k in range(2):
                place = hits.position[k]
                parts.append(root * (place - (centre.position[k][0] if about_chief else weights @ place)))
            return np.concatenate(parts)

        return lambda context: [of(beam, chief, context) for beam, chief in zip(beams, chiefs, strict=True)]

    return vectors


def _wave(*, tilted: bool) -> Vectors:
    """√w W, waves, about the mean of each colour on its own sphere; tilted: about its tilt too, the centroid's."""

    def vectors(beams: Sequence[Beam], planner: Planner) -> Callable[[EvaluationContext], list[Number]]:
        rays = np.concatenate([beam.rays for beam in beams])
        fields = [(w, beam.line.field) for beam in beams for w in beam.colours.tolist()]
        opd = opd_of(rays, fields, planner, clips=beams[0].clips)
        ends = np.cumsum([len(beam.rays) for beam in beams])
        places = [slice(end - len(beam.rays), end) for beam, end in zip(beams, ends, strict=True)]
        fits = [Fit(_terms(beam, tilted), beam.shares) for beam in beams]

        def numbers(context: EvaluationContext) -> list[Number]:
            valid, values = opd(context)
            return [of(*parts, valid, values) for parts in zip(beams, fits, places, strict=True)]

        return numbers

    def of(beam: Beam, fit: Fit, place: slice, valid: np.ndarray, values: Number) -> Number:
        weights = beam.weights(valid[place])
        return None if weights is None else np.sqrt(weights) * fit.less(values[place], valid[place])

    return vectors


def _terms(beam: Beam, tilted: bool) -> np.ndarray:
    """(R, K): of every colour 1 and, where `tilted`, the pupil point."""
    constants = (beam.colours[:, None] == np.unique(beam.colours)).astype(float)
    return np.concatenate(
        [constants, *(constants * part[:, None] for part in beam.points)] if tilted else [constants], 1
    )


_RINGS = (
    "int1 rings of four arms each, six at the least, over the whole pupil: apertures stop no ray; a lost ray leaves no "
    "value"
)
_GRID = (
    "a grid of 2 int1 × 2 int1 cells across the pupil; rays that apertures stop do not count: no integral up to their "
    "edges, as by `spot` and `wavefront`"
)

_SPOT, _WAVEFRONT = "RMS radius of a spot about", "RMS wavefront error about"
#: The second and the last letter: spot or wavefront, about the centroid or the chief ray.
_VECTORS = (
    ("S", "E", _spot(about_chief=False), f"{_SPOT} its centroid"),
    ("S", "H", _spot(about_chief=True), f"{_SPOT} the chief ray of the primary wavelength"),
    ("W", "E", _wave(tilted=True), f"{_WAVEFRONT} the centroid, waves"),
    ("W", "H", _wave(tilted=False), f"{_WAVEFRONT} the chief ray, waves"),
)

#: RSCE to RWRH; the third letter: C rings, R grid.
QUALITY = {
    f"R{quantity}{rule}{about}": Operand(
        partial(_rms_of, vectors=vector, rule=points, clips=clips),
        f"{text}; int1 rays, int2 wavelength (0: all by weight), Hx Hy",
        length=int(quantity == "S"),
        convention=convention,
        takes=("", "colour"),
    )
    for rule, points, clips, convention in (("C", rings, False, _RINGS), ("R", _rectangular, True, _GRID))
    for quantity, about, vector, text in _VECTORS
}

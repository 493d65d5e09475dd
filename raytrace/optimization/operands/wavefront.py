"""Operands of image quality: RMS of spots and wavefronts over a whole beam.

A beam is traced with all the rows' rays. Its RMS is the length of a vector, an entry for every ray, which is what the
solver is given: smooth where the RMS is 0, and no second derivative is lost.

Operands of optical path: the wavefront against a reference sphere, and the paths of single rays.

The sphere is centred where the chief ray meets the image and passes through the axial point of the exit pupil; that of
`wavefront_of` has the radius along the chief ray from the plane of the exit pupil.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from raytrace.maths.dual import Dual, Vector, slope_of, value_of
from raytrace.maths.numerics import dot
from raytrace.maths.pupil import gauss_rings, square
from raytrace.optimization.context import BadRow, Evaluate, EvaluationContext, Found, Line, Operand, Planner
from raytrace.optimization.operands.paraxial import listed
from raytrace.optimization.operands.rays import known
from raytrace.optimization.ray_bundle import Hits
from raytrace.tracing.aiming import is_bent
from raytrace.tracing.base_ray import base_ray
from raytrace.tracing.wavefront import path_to_reference_sphere


class Sphere(NamedTuple):
    """Reference spheres (...): centre, three of mm on the image; curvature κ = 1/R in 1/mm along the light."""

    centre: Vector
    curvature: object

    def at(self, places: np.ndarray) -> "Sphere":
        return Sphere(Vector(part[places] for part in self.centre), self.curvature[places])


def sphere_of(context: EvaluationContext, chief: Hits, bent: bool) -> Sphere:
    """About where chief rays land, through the exit pupil of the primary wavelength; κ = 0 for one at infinity.

        κ = D sign(v·d)/|v|,   v = D (C - E),   E_z = -n′ B/D - T

    B, D: of the lens behind the stop; T: behind its last surface. Where the axis bends, the pupil lies on the base ray,
    halfway between the images of the stop in both sections by vergence.
    """
    centre = x, y, z = Vector(chief.position)
    if bent:
        (bx, by, bz, *along), weight = _pupil_on_base_ray(context)
        v = tuple(weight * (c - b) - d for c, b, d in zip(centre, (bx, by, bz), along, strict=True))
    else:
        data = context.state.gaussian(context.planner.primary)
        B, weight = data.rear
        v = weight * x, weight * y, weight * (z + context.state.thickness[-2]) + data.n_image * B
    side = np.sign(value_of(dot(v, chief.direction)))
    return Sphere(centre, side * weight / np.sqrt(dot(v, v)))


def _pupil_on_base_ray(context: EvaluationContext) -> tuple[list, object]:
    """Where the base ray meets the image and its direction there, and the mean vergence 1/mm of the exit pupils."""

    def told(lens):
        base = base_ray(lens, lens.wavelengths[context.planner.primary])
        return *base.position, *base.direction, 0.5 * (1 / base.exit_pupil_position).sum(0)

    *numbers, vergence = context.state.through_torch(told)
    return numbers, vergence


# -- the wavefront -----------------------------------------------------------------------------------------------------


def opd_of(
    rays: np.ndarray, beams: Sequence[tuple], planner: Planner, *, clips: bool = False
) -> Callable[[EvaluationContext], tuple[np.ndarray, object]]:
    """OPD (R,) in waves of rays by their numbers, and which of them and their chief rays arrive.

    beams: (wavelength from 0, field) of each; clips: whether apertures stop rays, though not chief rays.
    """
    every = {beam: number for number, beam in enumerate(dict.fromkeys(beams))}
    of = np.array([every[beam] for beam in beams])
    chief = np.array([planner.ask(w, field, (0.0, 0.0)) for w, field in every])
    about = chief
    if planner.conventions.opd_chief == "primary":
        about = np.array([planner.ask(planner.primary, field, (0.0, 0.0)) for _, field in every])
    wavelength = np.array([w for w, _ in every])
    waves = 1e-3 * np.array(planner.view.wavelengths)[wavelength]
    waves = waves if planner.conventions.opd_sign == "longer" else -waves
    bent = is_bent(planner.lens)

    def opd(context: EvaluationContext) -> tuple[np.ndarray, object]:
        hits, chiefs, centres = context.hits(rays, clips=clips), context.hits(chief), context.hits(about)
        sphere, index = sphere_of(context, centres, bent), image_index(context, wavelength)
        zero = path_to_reference_sphere(chiefs, *sphere, index)
        found = (path_to_reference_sphere(hits, *sphere.at(of), index[of]) - zero[of]) / waves[of]
        return hits.valid & (chiefs.valid & centres.valid)[of], found

    return opd


def image_index(context: EvaluationContext, wavelengths: np.ndarray):
    """Index in front of the image at wavelengths, counted from 0."""
    found = [np.abs(context.state.index(w)[-2]) for w in wavelengths]
    return listed(found, context.state.count) if any(isinstance(n, Dual) for n in found) else np.array(found)


def opd_less(terms: Callable[[Sequence[Line], Planner], np.ndarray]):
    """OPD in waves less what fits best of some terms (R, K) of rows, by the weights of the rows; K = 0: the OPD."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        opd = opd_of(planner.rays(lines), [(line.wavelength, line.field) for line in lines], planner)
        fit = Fit(terms(lines, planner), _weights(lines))

        def evaluate(context: EvaluationContext) -> Found:
            valid, found = opd(context)
            return Found(known(valid, fit.less(found, valid)))

        return evaluate

    return plan


class Fit:
    """Least squares with basis (R, K) and weights (R,): v - B (√w B)⁺ √w v, over the entries that are there."""

    def __init__(self, basis: np.ndarray, weights: np.ndarray):
        self.basis, self.weights = basis, weights
        self.inverse = self._inverse(weights)

    def _inverse(self, weights: np.ndarray) -> np.ndarray:
        root = np.sqrt(weights)
        return np.linalg.pinv(root[:, None] * self.basis) * root

    def less(self, values, valid: np.ndarray):
        """Values (R,) less their fit; valid: (R,) which count."""
        if not self.basis.shape[1]:
            return values
        inverse = self.inverse if valid.all() else self._inverse(self.weights * valid)
        return values - self.basis @ (inverse @ values)


def _weights(lines: Sequence[Line]) -> np.ndarray:
    """(R,) those of rows, all alike for a field and wavelength without any."""
    weights = np.array([max(line.row.weight, 0.0) for line in lines])
    for places in _groups(lines):
        if not weights[places].any():
            weights[places] = 1.0
    return weights


def _groups(lines: Sequence[Line], *, colours: bool = True) -> list[list[int]]:
    """Places of the rows of each field, and, unless `colours` is False, of each wavelength."""
    found: dict[tuple, list[int]] = {}
    for place, line in enumerate(lines):
        found.setdefault((line.field, line.wavelength if colours else None), []).append(place)
    return list(found.values())


def nothing(lines: Sequence[Line], planner: Planner) -> np.ndarray:
    return np.zeros((len(lines), 0))


def piston(lines: Sequence[Line], planner: Planner) -> np.ndarray:
    """1 for each field and wavelength."""
    return _columns(lines, _groups(lines), np.ones(len(lines)))


def piston_and_tilt(lines: Sequence[Line], planner: Planner) -> np.ndarray:
    """1 for each field and wavelength, and the pupil point, by the convention `opd_tilt`.

    A field that is mirrored in a plane through the axis, of whose pupil rows leave out half, has no tilt out of it. A
    tilt that all wavelengths have in common is one of the path: so many waves more the shorter they are.
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
    return np.concatenate([piston(lines, planner), _columns(lines, groups, x), _columns(lines, groups, y)], 1)


def _columns(lines: Sequence[Line], groups: list[list[int]], number: np.ndarray) -> np.ndarray:
    found = np.zeros((len(lines), len(groups)))
    for column, places in enumerate(groups):
        found[places, column] = number[places]
    return found[:, found.any(0)]


# -- paths of single rays ----------------------------------------------------------------------------------------------


def between_surfaces(leg: Callable[[Line, Planner], tuple[int, int, int]]):
    """Optical path in mm of a ray between two surfaces.

    leg: both, and the wavelength; surface 0 is the object, or surface 1 where that is at infinity.
    """

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        paths = [_path_of(line, *leg(line, planner), planner) for line in lines]
        return lambda context: Found(listed([path(context) for path in paths], context.state.count))

    return plan


def _path_of(
    line: Line, first: int, last: int, wavelength: int, planner: Planner
) -> Callable[[EvaluationContext], object]:
    """Reduced path between the surfaces, and that of the axis, which it lacks."""
    first, last = sorted((first, last))
    source = planner.lens.surfaces[0]
    from_object = first == 0 and bool(source.thickness.isfinite())
    if from_object and not source.is_plane:
        raise BadRow(line, "measures from a curved object, which it cannot; name another surface")
    first = max(first, 1)
    begin, end = (np.array([planner.ray(line, surface=s, wavelength=wavelength)]) for s in (first, max(last, 1)))

    def path(context: EvaluationContext):
        hits, behind = context.hits(begin, surface=first), context.hits(end, surface=max(last, 1))
        index, gaps = context.state.index(wavelength), context.state.thickness
        axis = sum(index[k] * gaps[k] for k in range(first, last))
        found = behind.opl - hits.opl + axis
        if from_object:
            start = context.starts(begin, surface=first)
            way = (start.position[2] + gaps[0]) / start.direction[2]
            found = found + (hits.opl - start.opl) + index[0] * way
        return known(hits.valid & behind.valid, found)[0]

    return path


def _to_surface(line: Line, planner: Planner) -> tuple[int, int, int]:
    return 0, line.row.integers[0], line.wavelength


def _from_one_to_another(line: Line, planner: Planner) -> tuple[int, int, int]:
    return *line.row.integers, planner.primary


_WAVELENGTH = "", "wavelength"
_SPHERE = (
    "about the image point of the chief ray of the row's wavelength (convention `opd_chief`), through the axial point "
    "of the exit pupil; a longer path is positive (`opd_sign`)"
)

PATH = {
    "OPDC": Operand(
        opd_less(nothing),
        "optical path difference to the chief ray, waves; Hx Hy Px Py",
        convention=_SPHERE,
        takes=_WAVELENGTH,
    ),
    "OPDM": Operand(
        opd_less(piston),
        "the same less its mean over the rows of its field and wavelength, by weight",
        convention=_SPHERE,
        takes=_WAVELENGTH,
    ),
    "OPDX": Operand(
        opd_less(piston_and_tilt),
        "the same less the piston and tilt that fit its field and wavelength best, by weight",
        convention=f"{_SPHERE}; a tilt for every wavelength (`opd_tilt`)",
        takes=_WAVELENGTH,
    ),
    "OPTH": Operand(
        between_surfaces(_to_surface),
        "optical path of a ray to a surface, from the object, or from surface 1 if that is at infinity",
        length=1,
        takes=("surface", "wavelength"),
    ),
    "PLEN": Operand(
        between_surfaces(_from_one_to_another),
        "optical path of a ray of the primary wavelength from one surface to another",
        length=1,
        takes=("surface", "surface"),
    ),
}


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

        def evaluate(context: EvaluationContext) -> Found:
            parts = _side_by_side(tell(context), context.state.count)
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

    def vectors(beams: Sequence[Beam], planner: Planner) -> Callable[[EvaluationContext], list]:
        chiefs = [np.array([planner.ask(planner.primary, beam.line.field, (0.0, 0.0))]) for beam in beams]

        def of(beam: Beam, chief: np.ndarray, context: EvaluationContext):
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


def wave(*, tilted: bool):
    """√w W, waves, about the mean of each colour on its own sphere; tilted: about its tilt too, the centroid's."""

    def vectors(beams: Sequence[Beam], planner: Planner) -> Callable[[EvaluationContext], list]:
        rays = np.concatenate([beam.rays for beam in beams])
        own = [(w, beam.line.field) for beam in beams for w in beam.colours.tolist()]
        opd = opd_of(rays, own, planner, clips=beams[0].clips)
        ends = np.cumsum([len(beam.rays) for beam in beams])
        places = [slice(end - len(beam.rays), end) for beam, end in zip(beams, ends, strict=True)]
        fits = [Fit(_terms(beam, tilted), beam.shares) for beam in beams]

        def tell(context: EvaluationContext) -> list:
            valid, found = opd(context)
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
        convention=_RINGS if whole else _GRID,
        takes=("", "colour"),
    )
    for name, (vector, whole, text) in _TABLE.items()
}

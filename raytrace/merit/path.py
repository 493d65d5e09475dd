"""Operands of optical path: the wavefront against a reference sphere, and the paths of single rays.

The sphere is centred where the chief ray meets the image and goes through the axial point of the exit pupil. No two
long paths are ever subtracted: see `optics.wavefront.path_to_reference_sphere`, whose formula stands here for dual
numbers.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from raytrace.maths.dual import Dual, value_of
from raytrace.merit.bundle import Hits
from raytrace.merit.paraxial import listed
from raytrace.merit.plan import BadRow, Evaluate, Found, Line, Now, Operand, Planner
from raytrace.merit.rays import known
from raytrace.optics.axis import is_bent
from raytrace.optics.base_ray import base_ray


class Sphere(NamedTuple):
    """Reference spheres (...): centre, three of mm on the image; curvature κ = 1/R in 1/mm along the light."""

    centre: tuple
    curvature: object

    def at(self, places: np.ndarray) -> "Sphere":
        return Sphere(tuple(part[places] for part in self.centre), self.curvature[places])


def sphere_of(now: Now, chief: Hits, bent: bool) -> Sphere:
    """About where chief rays land, through the exit pupil of the primary wavelength; κ = 0 for one at infinity.

        κ = D sign(v·d)/|v|,   v = D (C - E),   E_z = -n′ B/D - T

    B, D: of the lens behind the stop; T: behind its last surface. Where the axis bends, the pupil lies on the base ray,
    halfway between the images of the stop in both sections by vergence.
    """
    centre = x, y, z = chief.position
    if bent:
        (bx, by, bz, *along), weight = _pupil_on_base_ray(now)
        v = tuple(weight * (c - b) - d for c, b, d in zip(centre, (bx, by, bz), along, strict=True))
    else:
        data = now.moment.gaussian(now.planner.primary)
        B, weight = data.rear
        v = weight * x, weight * y, weight * (z + now.moment.thickness[-2]) + data.n_image * B
    side = np.sign(value_of(dot(v, chief.direction)))
    return Sphere(centre, side * weight / np.sqrt(dot(v, v)))


def _pupil_on_base_ray(now: Now) -> tuple[list, object]:
    """Where the base ray meets the image and its direction there, and the mean vergence 1/mm of the exit pupils."""

    def told(lens):
        base = base_ray(lens, lens.wavelengths[now.planner.primary])
        return *base.position, *base.direction, 0.5 * (1 / base.exit_pupil_position).sum(0)

    *numbers, vergence = now.moment.through_torch(told)
    return numbers, vergence


def path_to(sphere: Sphere, hits: Hits, index: np.ndarray):
    """Reduced path in mm of rays up to the sphere that they are about to cross.

    W = W_ray + n [ κ e²/(1 + √(1 - κ² e²)) - (P - Q)·d ],   e² = |P - Q|² - ((P - Q)·d)²
    """
    offset = tuple(at - centre for at, centre in zip(hits.position, sphere.centre, strict=True))
    along = dot(offset, hits.direction)
    across = dot(offset, offset) - along * along
    bend = sphere.curvature * across
    sagitta = bend / (1 + np.sqrt(np.maximum(1 - sphere.curvature * bend, 0.0)))
    return hits.opl + index * (sagitta - along)


def directions_to(sphere: Sphere, hits: Hits) -> tuple:
    """Unit vectors from where rays cross the sphere to its centre, √(1 - κ² e²) d - κ e: `wavefront.towards_centre`."""
    offset = tuple(at - centre for at, centre in zip(hits.position, sphere.centre, strict=True))
    along = dot(offset, hits.direction)
    across = [sphere.curvature * (o - along * d) for o, d in zip(offset, hits.direction, strict=True)]
    root = np.sqrt(np.maximum(1 - dot(across, across), 0.0))
    return tuple(root * d - e for d, e in zip(hits.direction, across, strict=True))


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


# -- the wavefront -----------------------------------------------------------------------------------------------------


def opd_of(
    rays: np.ndarray, beams: Sequence[tuple], planner: Planner, *, clips: bool = False
) -> Callable[[Now], tuple[np.ndarray, object]]:
    """OPD (R,) in waves of rays by their numbers, and which of them and their chief rays arrive.

    beams: (wavelength from 0, field) of each; clips: whether apertures stop rays, though not chief rays.
    """
    every = {beam: number for number, beam in enumerate(dict.fromkeys(beams))}
    of = np.array([every[beam] for beam in beams])
    chief = np.array([planner.ask(w, field, (0.0, 0.0)) for w, field in every])
    about = chief
    if planner.readings.opd_chief == "primary":
        about = np.array([planner.ask(planner.primary, field, (0.0, 0.0)) for _, field in every])
    wavelength = np.array([w for w, _ in every])
    waves = 1e-3 * np.array(planner.view.wavelengths)[wavelength]
    waves = waves if planner.readings.opd_sign == "longer" else -waves
    bent = is_bent(planner.lens)

    def opd(now: Now) -> tuple[np.ndarray, object]:
        hits, chiefs, centres = now.hits(rays, clips=clips), now.hits(chief), now.hits(about)
        sphere, index = sphere_of(now, centres, bent), image_index(now, wavelength)
        zero = path_to(sphere, chiefs, index)
        found = (path_to(sphere.at(of), hits, index[of]) - zero[of]) / waves[of]
        return hits.valid & (chiefs.valid & centres.valid)[of], found

    return opd


def image_index(now: Now, wavelengths: np.ndarray):
    """Index in front of the image at wavelengths, counted from 0."""
    found = [np.abs(now.moment.index(w)[-2]) for w in wavelengths]
    return listed(found, now.moment.count) if any(isinstance(n, Dual) for n in found) else np.array(found)


def opd_less(terms: Callable[[Sequence[Line], Planner], np.ndarray]):
    """OPD in waves less what fits best of some terms (R, K) of rows, by the weights of the rows; K = 0: the OPD."""

    def plan(lines: Sequence[Line], planner: Planner) -> Evaluate:
        opd = opd_of(planner.rays(lines), [(line.wavelength, line.field) for line in lines], planner)
        fit = Fit(terms(lines, planner), _weights(lines))

        def evaluate(now: Now) -> Found:
            valid, found = opd(now)
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
    """1 for each field and wavelength, and the pupil point, by the reading `opd_tilt`.

    A field that is mirrored in a plane through the axis, of whose pupil rows leave out half, has no tilt out of it. A
    tilt that all wavelengths have in common is one of the path: so many waves more the shorter they are.
    """
    x, y = np.array([line.pupil for line in lines]).T
    if planner.view.is_symmetric:
        on_y = np.array([line.field[0] == 0 for line in lines])
        x, y = np.where(on_y, 0.0, x), np.where(on_y & [line.field[1] == 0 for line in lines], 0.0, y)
    groups = _groups(lines)
    if planner.readings.opd_tilt == "common":
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
        return lambda now: Found(listed([path(now) for path in paths], now.moment.count))

    return plan


def _path_of(line: Line, first: int, last: int, wavelength: int, planner: Planner) -> Callable[[Now], object]:
    """Reduced path between the surfaces, and that of the axis, which it lacks."""
    first, last = sorted((first, last))
    source = planner.lens.surfaces[0]
    from_object = first == 0 and bool(source.thickness.isfinite())
    if from_object and not source.is_plane:
        raise BadRow(line, "measures from a curved object, which it cannot; name another surface")
    first = max(first, 1)
    begin, end = (np.array([planner.ray(line, surface=s, wavelength=wavelength)]) for s in (first, max(last, 1)))

    def path(now: Now):
        hits, behind = now.hits(begin, surface=first), now.hits(end, surface=max(last, 1))
        index, gaps = now.moment.index(wavelength), now.moment.thickness
        axis = sum(index[k] * gaps[k] for k in range(first, last))
        found = behind.opl - hits.opl + axis
        if from_object:
            start = now.starts(begin, surface=first)
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
    "about the image point of the chief ray of the row's wavelength (reading `opd_chief`), through the axial point of "
    "the exit pupil; a longer path is positive (`opd_sign`)"
)

PATH = {
    "OPDC": Operand(
        opd_less(nothing),
        "optical path difference to the chief ray, waves; Hx Hy Px Py",
        reading=_SPHERE,
        takes=_WAVELENGTH,
    ),
    "OPDM": Operand(
        opd_less(piston),
        "the same less its mean over the rows of its field and wavelength, by weight",
        reading=_SPHERE,
        takes=_WAVELENGTH,
    ),
    "OPDX": Operand(
        opd_less(piston_and_tilt),
        "the same less the piston and tilt that fit its field and wavelength best, by weight",
        reading=f"{_SPHERE}; a tilt for every wavelength (`opd_tilt`)",
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

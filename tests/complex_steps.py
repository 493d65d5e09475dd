"""Derivatives of rays by complex steps: a trace of its own in numpy's complex numbers, as an oracle to all digits.

The derivative of an analytic function is Im f(x + i h)/h, to rounding for h = 1e-40 (Squire and Trapp, SIAM Review 40,
110, 1998). The trace knows what its tests need: an object at infinity, centred and posed conics with even terms,
constant indices, an entrance pupil diameter, F-number and pickup solves, and real ray aiming.
"""

from collections.abc import Callable

import numpy as np

import raytrace as rt

STEP = 1e-40

#: The plane of each tilt, from its first axis to its second.
_TILTS = {"tilt_x": (1, 2), "tilt_y": (2, 0), "tilt_z": (0, 1)}

Numbers = dict[tuple[int, str], complex]


def numbers_of(lens: rt.Lens) -> Numbers:
    """The numbers of a lens by surface and name, 0 where it has none."""
    numbers: Numbers = {(0, "aperture"): complex(lens.aperture.value)}
    for k, surface in enumerate(lens.surfaces):
        for name in ("thickness", "curvature", "conic"):
            number = getattr(surface, name)
            numbers[k, name] = 0j if number is None or not np.isfinite(float(number)) else complex(number)
        for name in ("x", "y", *_TILTS):
            number = None if surface.before is None else getattr(surface.before, name)
            numbers[k, name] = 0j if number is None else complex(number)
        terms = [] if surface.coefficients is None else surface.coefficients.tolist()
        numbers |= {(k, f"a{2 * j + 2}"): complex(terms[j] if j < len(terms) else 0.0) for j in range(4)}
        constant = surface.glass.formula == "constant"
        numbers[k, "index"] = complex(surface.glass.coefficients[0]) if constant else 1 + 0j
    return numbers


class Tracer:
    """Rays of a lens, by its numbers; solve: changes numbers that follow from others."""

    def __init__(self, lens: rt.Lens, solve: Callable[["Tracer", Numbers], None] | None = None):
        self.last, self.stop = len(lens.surfaces) - 1, lens.stop
        self.aims, self.solve = lens.ray_aiming == "real", solve
        self.numbers = numbers_of(lens)

    def derivative(self, at: tuple[int, str], fields, pupil) -> np.ndarray:
        """∂(x, y, L, M, N, path)/∂number (6, F, P) on the image."""
        moved = self.numbers | {at: self.numbers[at] + 1j * STEP}
        return self.image(moved, fields, pupil).imag / STEP

    def image(self, numbers: Numbers, fields, pupil) -> np.ndarray:
        """x, y, L, M, N and path (6, F, P) of rays of fields (2, F) in degrees through pupil points (2, P)."""
        if self.solve:
            self.solve(self, numbers)
        rows = []
        for field in np.asarray(fields).T:
            points = np.asarray(pupil, dtype=complex)
            if self.aims:
                points = self._aimed(numbers, field, points)
            rows.append(self._traced(numbers, *self._launched(numbers, field, points), self.last))
        return np.stack(rows, 1)

    def marginal_before(self, numbers: Numbers, surface: int) -> tuple[complex, complex]:
        """Height and n u of the paraxial marginal ray in front of a surface."""
        y, omega = 0.5 * numbers[0, "aperture"], 0j
        for k in range(1, surface):
            omega = omega - y * self._power(numbers, k)
            y = y + omega * numbers[k, "thickness"] / numbers[k, "index"]
        return y, omega

    def _power(self, numbers: Numbers, k: int) -> complex:
        return (numbers[k, "curvature"] + 2 * numbers[k, "a2"]) * (numbers[k, "index"] - numbers[k - 1, "index"])

    def _entrance_pupil(self, numbers: Numbers) -> complex:
        """Distance from surface 1: B/A of the matrix to the stop, times the index of the object space."""
        rays = [[1 + 0j, 0j], [0j, 1 + 0j]]
        for k in range(1, self.stop):
            for ray in rays:
                ray[1] = ray[1] - ray[0] * self._power(numbers, k)
                ray[0] = ray[0] + ray[1] * numbers[k, "thickness"] / numbers[k, "index"]
        return numbers[0, "index"] * rays[1][0] / rays[0][0]

    def _launched(self, numbers: Numbers, field: np.ndarray, points: np.ndarray):
        """Positions and directions (3, P) in front of surface 1, and the path."""
        radius, depth = 0.5 * numbers[0, "aperture"], self._entrance_pupil(numbers)
        slope = np.tan(np.deg2rad(field))
        length = np.sqrt(slope @ slope + 1)
        position = np.stack([radius * points[0], radius * points[1], depth + 0 * points[0]])
        direction = np.stack([part / length + 0 * points[0] for part in (*slope, 1.0)])
        return position, direction, numbers[0, "index"] * (position * direction).sum(0)

    def _aimed(self, numbers: Numbers, field: np.ndarray, target: np.ndarray) -> np.ndarray:
        """Points of the entrance pupil whose rays pass the stop at `target` times its radius."""

        def at_stop(field, points):
            return self._traced(numbers, *self._launched(numbers, field, points), self.stop)[:2]

        radius = at_stop(np.zeros(2), np.array([[0j], [1 + 0j]]))[1, 0]  # of the real marginal ray
        points, near = target, 1e-5
        for _ in range(6):  # with differences as Jacobian
            missed = at_stop(field, points) - radius * target
            by_x, by_y = (
                (at_stop(field, points + step) - at_stop(field, points - step)) / (2 * near)
                for step in (np.array([[near], [0]]), np.array([[0], [near]]))
            )
            determinant = by_x[0] * by_y[1] - by_y[0] * by_x[1]
            step_x = (by_y[1] * missed[0] - by_y[0] * missed[1]) / determinant
            step_y = (by_x[0] * missed[1] - by_x[1] * missed[0]) / determinant
            points = points - np.stack([step_x, step_y])
        return points

    def _traced(self, numbers: Numbers, position: np.ndarray, direction: np.ndarray, path, last: int) -> np.ndarray:
        """x, y, L, M, N and path (6, P) behind a surface, in its axes."""
        for k in range(1, last + 1):
            before, behind = numbers[k - 1, "index"], numbers[min(k, self.last - 1), "index"]
            if k > 1:
                position = position - np.array([0, 0, numbers[k - 1, "thickness"]])[:, None]
                path = path - before * numbers[k - 1, "thickness"]
            position = position - np.array([numbers[k, "x"], numbers[k, "y"], 0])[:, None]
            for name, (i, j) in _TILTS.items():
                angle = numbers[k, name] * np.pi / 180
                turn = np.eye(3, dtype=complex)
                turn[i, i] = turn[j, j] = np.cos(angle)
                turn[i, j], turn[j, i] = np.sin(angle), -np.sin(angle)
                position, direction = turn @ position, turn @ direction
            length, normal = self._hit(numbers, k, position, direction)
            position, path = position + length * direction, path + before * length
            direction = _refracted(direction, normal, before / behind)
        return np.stack([position[0], position[1], *direction, path])

    def _hit(self, numbers: Numbers, k: int, position: np.ndarray, direction: np.ndarray):
        """The length of the rays to a surface, and its unit normals (3, P) there, by Newton's method from its conic."""
        c, shape = numbers[k, "curvature"], 1 + numbers[k, "conic"]
        terms = [numbers[k, f"a{2 * j + 2}"] for j in range(4)]
        (x, y, z), (L, M, N) = position, direction
        A = c * (L * L + M * M + shape * N * N)
        B = N - c * (x * L + y * M + shape * z * N)
        C = c * (x * x + y * y + shape * z * z) - 2 * z
        length = C / (B + np.sqrt(B * B - A * C))
        for _ in range(6):
            x, y, z = position + length * direction
            u = x * x + y * y
            w = np.sqrt(1 - shape * c * c * u)
            sag = c * u / (1 + w) + sum(a * u ** (j + 1) for j, a in enumerate(terms))
            slope = c / w + 2 * sum((j + 1) * a * u**j for j, a in enumerate(terms))  # by r, over r
            length = length - (z - sag) / (N - slope * (x * L + y * M))
        normal = np.stack([-slope * x, -slope * y, np.ones_like(x)])
        return length, normal / np.sqrt((normal * normal).sum(0))


def _refracted(direction: np.ndarray, normal: np.ndarray, ratio: complex) -> np.ndarray:
    """Snell's law for unit vectors (3, P); ratio: of the index before to that behind."""
    cosine = (direction * normal).sum(0)
    return ratio * direction + (np.sqrt(1 - ratio * ratio * (1 - cosine * cosine)) - ratio * cosine) * normal

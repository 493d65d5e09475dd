"""Gaps: what stands behind the surfaces of a lens: thicknesses at centre and edge, and sags, with derivatives.

A gap goes from a surface to the next one that is no coordinate break. All of them are found at once, when the first row
asks at a moment; arrays (S,) have an entry for every surface, of which only those that were asked for mean anything.
"""

from collections.abc import Iterable

import numpy as np
import torch

from raytrace.maths.dual import Dual, value_of
from raytrace.media.glass import is_air
from raytrace.merit.moment import Moment
from raytrace.merit.plan import Now, Planner
from raytrace.merit.semi_diameters import SemiDiameters
from raytrace.system.lens import Lens
from raytrace.system.shapes import EVEN
from raytrace.system.surface import Surface, sag_at

#: Where on the edge of a surface a row looks, by its code: +y, +x, -y, -x.
SIDES = ((0.0, 1.0), (1.0, 0.0), (0.0, -1.0), (-1.0, 0.0))

_EDGE = 1e-4  # of 1 - (1+k) c² s²: how near its edge the root of a conic is held


class Gaps:
    """The gaps of a lens in one configuration."""

    def __init__(self, planner: Planner):
        view, surfaces = planner.view, planner.lens.surfaces
        self.semi_diameters = planner.shared(SemiDiameters)
        self.is_air = _in_air(planner.lens)
        #: -1 behind an odd number of mirrors, where light goes towards -z.
        self.side = np.where(view.indices[0] < 0, -1.0, 1.0)
        #: The surface behind each that ends its gap.
        self.end = np.array([_next(surfaces, k) for k in range(len(surfaces))])
        self.stored = {"thickness": np.array(view.thickness), "curvature": np.array(view.curvature)}
        self.stored |= {"conic": np.array([0.0 if s.conic is None else float(s.conic.detach()) for s in surfaces])}
        terms = [_even_terms(surface) for surface in surfaces]
        self.terms = [f"a{2 * j + 2}" for j in range(max(map(len, terms)))]
        for j, name in enumerate(self.terms):
            self.stored[name] = np.array([own[j] if j < len(own) else 0.0 for own in terms])
        self.others = [k for k, surface in enumerate(surfaces) if not (surface.is_break or is_even(surface))]

    def ask_edges(self, surfaces: Iterable[int]) -> None:
        """Tell, while rows are planned, behind which surfaces edges will be looked at."""
        self.semi_diameters.ask([k for start in surfaces for k in (start, int(self.end[start]))])

    def numbers(self, moment: Moment, quantity: str):
        """A number (S,) of all surfaces."""
        values, slopes = self.stored[quantity].copy(), None
        for (surface, name), number in moment.numbers.items():
            if name == quantity:
                values[surface] = value_of(number)
                if isinstance(number, Dual):
                    slopes = np.zeros((moment.count, len(values))) if slopes is None else slopes
                    slopes[:, surface] = number.slope
        return values if slopes is None else Dual(values, slopes)

    def centre(self, now: Now):
        """mm on the axis, as the lens has them."""
        return now.once(self._centre)

    def _centre(self, now: Now):
        own = found = self.numbers(now.moment, "thickness")
        start = np.arange(len(self.end))
        for step in range(1, int((self.end - start).max())):
            within = start + step < self.end
            found = found + np.where(within, own[np.where(within, start + step, 0)], 0.0)
        return found

    def edge(self, now: Now, code: int = 0):
        """mm at the edge: t + z′ - z, each surface at its own semi-diameter; code: the number of a side in `SIDES`."""
        return now.once(self._edge, code)

    def _edge(self, now: Now, code: int):
        z = self.sag(now, code)
        return self.centre(now) + (z[self.end] - z)

    def whole(self, now: Now, code: int = 0):
        """mm along the axis between what stands out furthest, of both surfaces, be it at the centre or at the edge."""
        z = self.sag(now, code)
        return self.centre(now) + (np.maximum(z[self.end], 0.0) - np.minimum(z, 0.0))

    def sag(self, now: Now, code: int = 0):
        """mm at the semi-diameters."""
        return now.once(self._sag, code)

    def _sag(self, now: Now, code: int):
        heights = self.semi_diameters.at(now)
        found = self._even_sag(now.moment, heights)
        asked = [k for k in self.others if not np.isnan(value_of(heights)[k])]
        if not asked:
            return found
        count = now.moment.count
        found = found if isinstance(found, Dual) or not count else Dual(found, np.zeros((count, 1)))
        values, slopes = value_of(found).copy(), found.full().copy() if count else None
        for k in asked:
            one = _sag_by_torch(now.moment, k, heights[k], SIDES[code])
            values[k] = value_of(one)
            if count:
                slopes[:, k] = one.slope
        return Dual(values, slopes) if count else values

    def shortfall(self, now: Now):
        """mm by which surfaces fall short of their semi-diameters s, below 0 where they reach them: s (q - 1)/2.

        q = (1+k) c² s² is 1 where a conic closes at s; near there it is s - 1/(|c| √(1+k)).
        """
        return now.once(self._shortfall)

    def _shortfall(self, now: Now):
        heights = self.semi_diameters.at(now)
        return 0.5 * heights * (self._closing(now.moment, heights * heights) - 1.0)

    def _closing(self, moment: Moment, u):
        """(1+k) c² u, which is 1 at the edge of a closed conic."""
        c = self.numbers(moment, "curvature")
        return (1 + self.numbers(moment, "conic")) * (c * c) * u

    def _even_sag(self, moment: Moment, heights):
        """c u/(1 + √(1 - q)) + Σ a_j u^j, u = s², q = (1+k) c² u.

        Of a conic that closes within s, from 1 - q = ε on, 1 - q is ε/(1 + τ + τ²), τ = 1 - (1 - q)/ε: above 0, with
        two continuous derivatives.
        """
        u, c = heights * heights, self.numbers(moment, "curvature")
        left = 1 - self._closing(moment, u)
        closed = value_of(left) < _EDGE
        if closed.any():
            over = np.where(closed, 1 - left / _EDGE, 0.0)
            left = np.where(closed, _EDGE / (1 + over + over * over), left)
        found = c * u / (1 + np.sqrt(left))
        power = u
        for name in self.terms:
            found = found + power * self.numbers(moment, name)
            power = power * u
        return found


def is_even(surface: Surface) -> bool:
    """Whether the sag is that of a conic with even terms at most, which is told here in numpy."""
    return surface.departure is None and (surface.coefficients is None or surface.kind == EVEN)


def _even_terms(surface: Surface) -> list[float]:
    return surface.coefficients.tolist() if surface.coefficients is not None and is_even(surface) else []


def _next(surfaces: tuple[Surface, ...], start: int) -> int:
    """The next surface that is no coordinate break, or the image."""
    last = len(surfaces) - 1
    return next((k for k in range(start + 1, last) if not surfaces[k].is_break), last)


def _in_air(lens: Lens) -> np.ndarray:
    """Whether the medium behind every surface is air; mirrors and breaks keep the one before."""
    found: list[bool] = []
    for surface in lens.surfaces:
        keeps = found and (surface.is_mirror or surface.is_break)
        found.append(found[-1] if keeps else is_air(surface.glass))
    return np.array(found)


def _sag_by_torch(moment: Moment, surface: int, height, side: tuple[float, float]):
    """The sag of a surface of any kind, a number ()."""
    with torch.enable_grad():
        leaves, lens = moment.view.leaves({at: value_of(n) for at, n in moment.numbers.items()})
        s = torch.tensor(float(value_of(height)), dtype=torch.float64, requires_grad=True)
        z = sag_at(lens.surfaces[surface], side[0] * s, side[1] * s)
        if not moment.count:
            return float(z.detach())
        by_height = torch.autograd.grad(z, s, retain_graph=True)[0]
        return moment.chained(z, leaves) + float(by_height) * (height - value_of(height))

"""Semi-diameters: how far the light of all fields reaches from the vertex of every surface, with derivatives.

    s = (1 + a/100) max √(x² + y²) + c

over all fields and wavelengths and the ends of the two diameters of the pupil, at every moment; a per cent and c mm are
the margin of `Intent`, which neither the stop nor the image has. The derivative is that of the ray that is largest.
"""

from collections.abc import Iterable

import numpy as np

from raytrace.maths.dual import Dual
from raytrace.merit.bundle import Bundle, Marks
from raytrace.merit.plan import Now, Planner
from raytrace.merit.solves import ENDS


class SemiDiameters:
    """Those of the surfaces that are asked for; rays are traced only where one of these follows them."""

    def __init__(self, planner: Planner):
        lens, view = planner.lens, planner.view
        self.given = given_semi_diameters(view)
        percent, length = (0.0, 0.0) if lens.intent is None else lens.intent.semi_diameter_margin
        without = (lens.stop, planner.image)
        surfaces = range(len(lens.surfaces))
        self.factors = np.array([1.0 if k in without else 1 + percent / 100 for k in surfaces])
        self.lengths = np.array([0.0 if k in without else length for k in surfaces])
        self.view, self.asked, self._bundle = view, set(), None

    def ask(self, surfaces: Iterable[int]) -> None:
        """Tell, while rows are planned, whose semi-diameters will be looked at."""
        self.asked |= set(surfaces)

    def at(self, now: Now):
        """mm (S,) of all surfaces; nan of those that were not asked for, and where no ray arrives."""
        return now.once(self._found)

    def _found(self, now: Now):
        found = np.full(len(self.factors), np.nan)
        follow = sorted(self.asked - set(self.given))
        slopes = np.zeros((now.moment.count, len(found)))
        if follow:
            places = np.array(follow) - 1
            heights, by = largest_heights(self.bundle(follow[-1]).marks(now.moment), places)
            found[follow] = self.factors[follow] * heights + self.lengths[follow]
            if by is not None:
                slopes[:, follow] = self.factors[follow] * by
        for surface, number in self.given.items():
            found[surface] = number
        return Dual(found, slopes) if now.moment.count else found

    def bundle(self, last: int) -> Bundle:
        """The rays up to a surface; `last` is the same in every call, once rows are planned."""
        if self._bundle is None:
            self._bundle = outermost(self.view, last)
        return self._bundle


def given_semi_diameters(view) -> dict[int, float]:
    """mm, by surface: those that stay as they are; the object's is 0 where none is told."""
    surfaces, intent = view.lens.surfaces, view.lens.intent
    stay = range(len(surfaces)) if intent is None else intent.semi_diameters
    told = {k: float(surfaces[k].semi_diameter) for k in stay if surfaces[k].semi_diameter}
    return {0: surfaces[0].semi_diameter or 0.0} | told


def outermost(view, last: int) -> Bundle:
    """The rays through the `ENDS` of all fields and wavelengths, on the surfaces 1 to `last`."""
    fields, found = view.lens.fields, Bundle(view, last)
    x, y = fields.x.detach().numpy(), fields.y.detach().numpy()
    largest = np.hypot(x, y).max() or 1.0
    for wavelength in range(len(view.wavelengths)):
        for field in zip((x / largest).tolist(), (y / largest).tolist(), strict=True):
            for end in ENDS:
                found.ask(wavelength, field, end)
    return found


def largest_heights(marks: Marks, places: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Largest √(x² + y²) mm (P,) at some surfaces of a bundle, and its derivatives (V, P); nan where no ray arrives."""
    x, y, valid = marks.x[places], marks.y[places], marks.valid[places]
    heights = np.where(valid, np.hypot(x, y), -1.0)
    ray, rows = heights.argmax(-1), np.arange(len(places))
    found = heights[rows, ray]
    found = np.where(found < 0, np.nan, found)
    if marks.by_x is None:
        return found, None
    cosine, sine = (part[rows, ray] / np.where(found > 0, found, 1.0) for part in (x, y))
    by_x, by_y = (part[places, :, ray] for part in (marks.by_x, marks.by_y))
    return found, np.where(np.isnan(found)[:, None], 0.0, cosine[:, None] * by_x + sine[:, None] * by_y).T

"""Samplings: points and weights on the unit disc, and grids of pixels.

Every rule of the disc returns points (2, P) and weights (P,) that sum to 1 and integrate over its area:
Σ w f(x, y) ≈ (1/π) ∬ f dx dy.
"""

import functools
import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from raytrace.budget import afford
from raytrace.maths.numerics import value
from raytrace.words import option

_BY_EIGENVALUES = 256  # points of a Gaussian rule at most
_POINT_BYTES = 64  # of a point and its weight, with the memory to compute them


def _at_least_one(rule: str, **sizes: float) -> None:
    """Raise ValueError for a rule without points."""
    for name, size in sizes.items():
        if not size >= 1:
            raise ValueError(f"{rule}: {option(name)} is {size}; expected 1 or more")


def _afford(count: float, rule: str, size: str) -> None:
    """Raise OverBudget for a rule whose `count` points do not fit into memory."""
    afford(_POINT_BYTES * count, f"{rule}: {count:.3g} points of the pupil", helps=f"ask for fewer {{{size}}}")


def gauss_rings(
    rings: int = 6,
    arms: int | None = None,
    *,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> tuple[Tensor, Tensor]:
    """Gaussian quadrature in r², equal angles: exact for polynomials up to degree 4·rings - 2 (Forbes, JOSA A 5, 1988).

    arms: angles per ring, 4·rings by default (exact for as many azimuthal harmonics); the first lies half a step off
    the x axis, so that the pattern is symmetric in x and in y.
    """
    arms = 4 * rings if arms is None else arms
    _at_least_one("gauss_rings", rings=rings, arms=arms)
    _afford(rings * arms, f"{rings} rings of {arms} arms", "rings")
    nodes, weights = gauss_legendre(rings)
    radius = np.sqrt(0.5 * (nodes + 1))
    angle = (np.arange(arms) + 0.5) * (2 * math.pi / arms)
    points = np.stack([np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()])
    return _tensors(points, np.repeat(0.5 * weights / arms, arms), dtype, device)


@functools.lru_cache(maxsize=64)
def gauss_legendre(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Nodes and weights of the Gaussian rule of `count` points on [-1, 1].

    Many points are computed by Newton's method from Tricomi's estimate, in time count² where the eigenvalues of a
    matrix take count³: 5000 nodes in 0.1 s, not in a minute (Hale, Townsend, SIAM J. Sci. Comput. 35, 2013, §2).
    """
    if count <= _BY_EIGENVALUES:
        return np.polynomial.legendre.leggauss(count)
    k = np.arange(1, count // 2 + 1)
    x = np.cos(np.pi * (4 * k - 1) / (4 * count + 2)) * (1 - 1 / (8 * count**2) + 1 / (8 * count**3))
    x = np.concatenate([x, [0.0] * (count % 2)])
    for _ in range(3):
        before, value = np.ones_like(x), x
        for j in range(2, count + 1):
            before, value = value, x * value + (1 - 1 / j) * (x * value - before)
        slope = count * (before - x * value) / (1 - x * x)
        x = x - value / slope
    weight = 2 / ((1 - x * x) * slope**2)
    nodes, weights = (np.concatenate([sign * t[: len(k)], t[::-1]]) for sign, t in ((-1, x), (1, weight)))
    return nodes, weights * (2 / weights.sum())


def hexapolar(
    rings: float = 6, *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> tuple[Tensor, Tensor]:
    """The centre and `rings` rings of 6, 12, 18, … points at radii j/rings; each ring carries its share of the area.

    rings: 1 or more; between whole numbers the outermost ring lies inside the edge (what a density of rays, rings²,
    leads to: OpticStudio traces a wavelength of weight w with √w times the rings).
    """
    _at_least_one("hexapolar", rings=rings)
    _afford(3.0 * rings * (rings + 1) + 1, f"{rings} hexapolar rings", "rings")
    points, weights = [np.zeros((2, 1))], [np.array([0.25])]
    for ring in range(1, int(rings) + 1):
        angle = np.arange(6 * ring) * (math.pi / 3 / ring)
        points.append(ring / rings * np.stack([np.cos(angle), np.sin(angle)]))
        outer = rings if ring == int(rings) else ring + 0.5  # half way between rings, or the edge
        weights.append(np.full(6 * ring, (outer**2 - (ring - 0.5) ** 2) / (6 * ring)))
    return _tensors(np.concatenate(points, axis=1), np.concatenate(weights) / rings**2, dtype, device)


def equal_rings(
    rings: int = 8, *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> tuple[Tensor, Tensor]:
    """Rings of 2·rings points (at least 8) at the mean r² of rings of equal area: all points share the light equally.

    The error of the mean of a function smooth in r² falls as 1/rings².
    """
    _at_least_one("equal_rings", rings=rings)
    arms = max(8, 2 * rings)
    _afford(rings * arms, f"{rings} equal rings", "rings")
    radius = np.sqrt((np.arange(rings) + 0.5) / rings)
    angle = (np.arange(arms) + 0.5) * (2 * math.pi / arms)
    points = np.stack([np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()])
    return _equal(points, dtype, device)


def square(
    across: int = 16, *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> tuple[Tensor, Tensor]:
    """Cell centres of an across × across grid over [-1, 1]² that lie inside the disc, equal weights."""
    _at_least_one("square", across=across)
    _afford(float(across) ** 2, f"a square grid of {across} points across", "points")
    axis = (2 * np.arange(across) + 1 - across) / across
    x, y = (grid.ravel() for grid in np.meshgrid(axis, axis))
    kept = x * x + y * y <= 1
    return _equal(np.stack([x[kept], y[kept]]), dtype, device)


def sobol(
    count: int = 256, *, seed: int = 0, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> tuple[Tensor, Tensor]:
    """Scrambled Sobol points mapped to the disc by r = √u, equal weights; the same points for the same seed."""
    _at_least_one("sobol", count=count)
    _afford(count, f"{count} Sobol points", "points")
    engine = torch.quasirandom.SobolEngine(2, scramble=True, seed=seed)
    return _disc(engine.draw(count, dtype=torch.float64), dtype, device)


def random(
    count: int = 256,
    *,
    generator: torch.Generator | None = None,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> tuple[Tensor, Tensor]:
    """Independent uniform points of the disc, equal weights; drawn from `generator`, or from a new one of `seed`."""
    _at_least_one("random", count=count)
    _afford(count, f"{count} random points", "points")
    generator = torch.Generator().manual_seed(seed) if generator is None else generator
    return _disc(torch.rand(count, 2, generator=generator, dtype=torch.float64), dtype, device)


def fan(
    count: int = 21, axis: str = "y", *, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None
) -> tuple[Tensor, Tensor]:
    """`count` points from -1 to 1 along x or y, equal weights: for drawing, not for integrating."""
    _at_least_one("fan", count=count)
    _afford(count, f"a fan of {count} rays", "points")
    line = np.linspace(-1, 1, count) if count > 1 else np.zeros(1)
    zero = np.zeros_like(line)
    return _equal(np.stack([line, zero] if axis == "x" else [zero, line]), dtype, device)


def with_rim(points: Tensor, weights: Tensor, arms: int = 72) -> tuple[Tensor, Tensor]:
    """The same rule with points of weight 0 on the rim: they count for a largest radius, not for a mean."""
    angle = np.arange(arms) * (2 * math.pi / arms)
    rim = points.new_tensor(np.stack([np.cos(angle), np.sin(angle)]))
    return torch.cat([points, rim], 1), torch.cat([weights, weights.new_zeros(arms)])


def _disc(uniform: Tensor, dtype: torch.dtype, device: torch.device | str | None) -> tuple[Tensor, Tensor]:
    radius, angle = torch.sqrt(uniform[:, 0]), 2 * math.pi * uniform[:, 1]
    return _equal(torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)]).numpy(), dtype, device)


def _equal(points: np.ndarray, dtype: torch.dtype, device: torch.device | str | None) -> tuple[Tensor, Tensor]:
    count = points.shape[1]
    return _tensors(points, np.full(count, 1.0 / count), dtype, device)


def _tensors(
    points: np.ndarray, weights: np.ndarray, dtype: torch.dtype, device: torch.device | str | None
) -> tuple[Tensor, Tensor]:
    return torch.as_tensor(points, dtype=dtype, device=device), torch.as_tensor(weights, dtype=dtype, device=device)


#: Samplings by name: the rule, the option of its size (rings, points across, or points) and the default of that size.
SAMPLINGS: dict[str, tuple[Callable[..., tuple[Tensor, Tensor]], str, int]] = {
    "gauss": (gauss_rings, "rings", 12),
    "hexapolar": (hexapolar, "rings", 12),
    "square": (square, "points", 32),
    "sobol": (sobol, "points", 1024),
    "random": (random, "points", 1024),
}


def sampled(
    sampling: str = "gauss",
    *,
    rings: int | None = None,
    points: int | None = None,
    seed: int = 0,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> tuple[Tensor, Tensor]:
    """Points (2, P) and weights (P,) of a rule of SAMPLINGS.

    rings: of gauss and hexapolar, 12 by default; points: across the pupil of square (32), in all of sobol and random
    (1024), whose generator takes the seed. Raises ValueError for another sampling, or the size of another.
    """
    if sampling not in SAMPLINGS:
        raise ValueError(f"sampling {sampling!r}: expected one of {', '.join(SAMPLINGS)}")
    rule, counted, size = SAMPLINGS[sampling]
    given = {"rings": rings, "points": points}
    wrong = "points" if counted == "rings" else "rings"
    if given[wrong] is not None:
        takers = option("sampling", ", ".join(name for name, row in SAMPLINGS.items() if row[1] == wrong))
        raise ValueError(f"{option(wrong)} belongs to {takers}; {sampling} takes {option(counted)}")
    seeds = {"seed": seed} if rule in (sobol, random) else {}
    return rule(size if given[counted] is None else given[counted], **seeds, dtype=dtype, device=device)


@value
class Grid:
    """rows × columns square pixels.

        x_i = centre_x + (i - (columns - 1)/2)·pitch,   y_j likewise: an odd grid has a pixel at its centre

    pitch: scalar, mm; rows, columns: how many; centre: (2, ...) mm on the sensor, batch axes as those of the kernels.
    """

    pitch: Tensor
    rows: int
    columns: int
    centre: Tensor

    @property
    def shape(self) -> tuple[int, int]:
        return self.rows, self.columns


def grid(pitch: Tensor | float, size: int | tuple[int, int], centre: Tensor | None = None) -> Grid:
    """A grid of `size` pixels (rows, columns; one number for a square) around `centre`, by default the axis."""
    rows, columns = (size, size) if isinstance(size, int) else size
    pitch = torch.as_tensor(pitch, dtype=torch.float64) if not isinstance(pitch, Tensor) else pitch
    return Grid(pitch, rows, columns, pitch.new_zeros(2) if centre is None else centre)


def centres(grid: Grid) -> tuple[Tensor, Tensor]:
    """x (..., columns) and y (..., rows) of the pixel centres, mm."""
    return _line(grid, 0, grid.columns, 0.0), _line(grid, 1, grid.rows, 0.0)


def edges(grid: Grid) -> tuple[Tensor, Tensor]:
    """x (..., columns + 1) and y (..., rows + 1) of the pixel edges, mm."""
    return _line(grid, 0, grid.columns + 1, -0.5), _line(grid, 1, grid.rows + 1, -0.5)


def _line(grid: Grid, axis: int, count: int, first: float) -> Tensor:
    pixels = grid.columns if axis == 0 else grid.rows
    position = torch.arange(count, dtype=grid.pitch.dtype, device=grid.pitch.device) + (first - 0.5 * (pixels - 1))
    return grid.centre[axis][..., None] + position * grid.pitch

"""Cost: what waves take in memory, told in the words of a lens before they are summed."""

import math
from collections.abc import Sequence

from raytrace.budget import afford
from raytrace.maths.grid import Grid
from raytrace.optics.paraxial import first_order
from raytrace.optics.scene import Scene

_HELPS = "give a larger --tol, a smaller --size or --pixel, a slower aperture (--f-number), --model drt"


def afford_rings(what: str, scene: Scene, rings: int, phase: float) -> None:
    """Raise OverBudget where a pupil of so many Gauss rings is too much.

    phase: radians along a pupil radius. n rings are counted as a matrix n × n: so do the points that they serve grow.
    """
    D, F, W = scene.shape
    turns = phase / (2 * math.pi)
    afford(
        24.0 * rings**2 + 128.0 * rings * D * F * W,
        f"{what} at {_speed(scene)} needs {rings:,} rings of the pupil: the phase turns {turns:,.0f} times",
        helps=_HELPS,
    )


def afford_sensor(what: str, scene: Scene, grid: Grid, nodes: int) -> None:
    """Raise OverBudget where the light at `nodes`² points of each pixel is too much; fields come one by one."""
    D, _, W = scene.shape
    rows, columns = grid.rows * nodes, grid.columns * nodes
    afford(
        64.0 * D * W * rows * columns,
        f"{what} at {_speed(scene)} needs {columns:,} × {rows:,} points of the sensor for {D * W} kernels",
        helps=_HELPS,
    )


def afford_cells(kernels: Sequence[int], across: int, along: int, *, each: float) -> None:
    """Raise OverBudget where cells of the pupil narrow enough for the pixels, `each` so many bytes, are too much.

    kernels: (D, F, W); across, along: cells round the pupil and from its centre to its rim.
    """
    count = math.prod(kernels)
    afford(
        each * count * across * along,
        f"the ray-traced PSF needs {across:,} × {along:,} cells of the pupil for each of {count} kernels: the blur is "
        "wide beside a pixel",
        helps="give a larger --pixel, fewer fields or wavelengths at once, --rays, --model gaussian",
    )


def _speed(scene: Scene) -> str:
    return f"F/{float(first_order(scene.lens).working_f_number.detach().abs().min()):.3g}"

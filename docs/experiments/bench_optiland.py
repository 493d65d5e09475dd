"""The optimiser compared with those of Optiland: Optiland's sample lenses with one merit function, in both programs.

    python docs/experiments/bench_optiland.py

    M² = Σ w (v - t)² / Σ w

over rows of lens files: TRAC, the distance of a ray on the image from the centroid of its field, at the points of a
Gaussian quadrature of the pupil and of half of it off the axis, and EFFL. In Optiland it is an operand of its registry,
so that all rays of a wavelength are traced in one call of `trace_generic`, in two forms whose squares sum to M²:

    "rays": a residual for x and y of every ray;
    "spots": the root mean square of every field and wavelength, as in Optiland's tutorials.

Variables, their scales, the solvers and their derivatives are Optiland's: least squares (MINPACK's Levenberg-Marquardt
by differences, numpy), and Adam with autograd (torch, float64) with the rate of its defaults. Both programs start from
the same lens and trace the same rays. Time is processor time of one thread. The ratio compares the time of Optiland's
solver with the time after which this package reaches the same M². Needs the extra [bench].
"""

import argparse
import dataclasses
import math
import sys
import time
import warnings
from collections.abc import Callable, Sequence

import numpy as np
import optiland.backend as be
import torch
from optiland.optic import Optic
from optiland.optimization import LeastSquares, OptimizationProblem, TorchAdamOptimizer
from optiland.optimization.operand.operand import operand_registry
from optiland.samples.objectives import CookeTriplet, DoubleGauss
from pages import digits, listing
from torch import Tensor

from raytrace.materials.glass import AIR, Glass, from_table
from raytrace.maths.sampling import gauss_legendre
from raytrace.optimization.optimize import optimize
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.optimization_data import OptimizationData, Row, Vary
from raytrace.system.surface import Surface
from raytrace.tracing.compiled import prepare
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.trace import trace_lens

RINGS, ARMS = 3, 6
AGREE = 1e-9  # of the merits of both programs, relative
_APERTURES = {"EPD": "entrance_pupil_diameter", "imageFNO": "image_f_number"}

#: Optiland's sample, its variable radii and thicknesses by surface, and the focal length to be held, mm.
PROBLEMS: dict[str, tuple[type[Optic], tuple[int, ...], tuple[int, ...], float]] = {
    "cooke triplet": (CookeTriplet, (1, 2, 3, 4, 5, 6), (6,), 50.0),
    "double Gauss": (DoubleGauss, (1, 2, 3, 5, 7, 9, 10, 11), (5, 6, 11), 100.0),
}


@dataclasses.dataclass(frozen=True)
class Problem:
    """A problem for both programs.

    lens: Optiland's at the start, with variables and rows; moved: by how much, as a part of itself, every
    variable was moved up and down in turn from the sample. merit_in_optiland: M² at the start.
    """

    name: str
    moved: float
    lens: Lens
    variables: tuple[Vary, ...]
    rows: tuple[Row, ...]
    merit_in_optiland: float

    def optic(self) -> Optic:
        """Optiland's lens at the start, in the back end that is set."""
        sample, radii, thicknesses, _ = PROBLEMS[self.name]
        return _moved(sample(), radii, thicknesses, self.moved)


def problem(name: str, *, moved: float = 0.0) -> Problem:
    """A row of PROBLEMS. Raises ValueError if the two programs do not find the same merit at its start."""
    sample, radii, thicknesses, focal_length = PROBLEMS[name]
    be.set_backend("numpy")
    optic = _moved(sample(), radii, thicknesses, moved)
    lens = lens_of(optic)
    rows = (Row("EFFL", (0, lens.primary_wavelength), target=focal_length, weight=1.0), *spot_rows(lens))
    variables = tuple(
        Vary(number, quantity)
        for quantity, numbers in (("curvature", radii), ("thickness", thicknesses))
        for number in numbers
    )
    theirs, ours = float(posed(optic, rows, variables, "rays").sum_squared()), float(merit_of(lens, rows))
    if not abs(theirs - ours) <= AGREE * ours:
        raise ValueError(f"{name}: M² is {ours:.12g} here and {theirs:.12g} in Optiland")
    lens = dataclasses.replace(lens, optimization_data=OptimizationData(variables=variables, merit=rows))
    return Problem(name, moved, lens, variables, rows, theirs)


def spot_rows(lens: Lens, rings: int = RINGS, arms: int = ARMS) -> tuple[Row, ...]:
    """TRAC of every field, wavelength and point of the pupil, one arm of it on the axis and half of it elsewhere.

    Weights are those of the field's programs: π times the ring's, over fields, wavelengths and arms.
    """
    nodes, weights = gauss_legendre(rings)
    counts = len(lens.fields.y) * len(lens.wavelengths)
    rows = []
    for height in (lens.fields.y / lens.fields.y.abs().max()).tolist():
        angles = [math.pi * (2 * arm / arms - 0.5) for arm in range(arms)] if height else [math.pi / 2]
        angles = [angle for angle in angles if math.cos(angle) > 1e-9] or angles
        for wavelength in range(len(lens.wavelengths)):
            for node, ring in zip(nodes.tolist(), weights.tolist(), strict=True):
                radius, weight = math.sqrt(0.5 * (1 + node)), math.pi * 0.5 * ring / counts / len(angles)
                points = [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]
                rows += [Row("TRAC", (0, wavelength + 1), (0.0, height, *point), weight=weight) for point in points]
    return tuple(rows)


def lens_of(optic: Optic) -> Lens:
    """Optiland's centred lens of spheres, with its indices at its wavelengths and the primary one's place."""
    wavelengths = [float(one.value) for one in optic.wavelengths.wavelengths]
    last = len(optic.surfaces) - 1
    surfaces = []
    for number, surface in enumerate(optic.surfaces):
        radius = float(surface.geometry.radius)
        if number in (0, last):
            thickness = math.inf if number == 0 else 0.0
        else:
            thickness = float(optic.surfaces[number + 1].geometry.cs.z) - float(surface.geometry.cs.z)
        curvature = None if math.isinf(radius) else _real(1 / radius)
        surfaces.append(Surface(_real(thickness), curvature=curvature, glass=_glass_of(surface, wavelengths)))
    heights = _real([float(field.y) for field in optic.fields.fields])
    return Lens(
        surfaces=tuple(surfaces),
        stop=next(number for number, surface in enumerate(optic.surfaces) if surface.is_stop),
        aperture=SystemAperture(_APERTURES[optic.aperture.ap_type], _real(float(optic.aperture.value))),
        fields=Fields("angle", torch.zeros_like(heights), heights, torch.ones_like(heights)),
        wavelengths=_real(wavelengths),
        wavelength_weights=torch.ones(len(wavelengths), dtype=torch.float64),
        primary_wavelength=int(optic.wavelengths.primary_index) + 1,
        name=type(optic).__name__,
    )


def _glass_of(surface, wavelengths: Sequence[float]) -> Glass:
    indices = [float(np.asarray(be.to_numpy(surface.material_post.n(one))).item()) for one in wavelengths]
    return AIR if all(index == 1 for index in indices) else from_table(wavelengths, indices)


def merit_of(lens: Lens, rows: Sequence[Row]) -> Tensor:
    """M² of EFFL and TRAC rows by this package's rays; in fields on y rows stand for their mirror images, too."""
    total, merit = sum(row.weight for row in rows), torch.zeros((), dtype=torch.float64)
    for row in rows:
        if row.operand == "EFFL":
            merit = merit + row.weight * (first_order(lens).effective_focal_length - row.target) ** 2
    rays = [row for row in rows if row.operand == "TRAC"]
    for height in dict.fromkeys(row.numbers[1] for row in rays):
        hits = [
            _hits(lens, [row for row in rays if row.numbers[1] == height and row.integers[1] == 1 + k])
            for k in range(len(lens.wavelengths))
        ]
        x, y, weight = (torch.cat(part) for part in zip(*hits, strict=True))
        centre = (weight * y).sum() / weight.sum() if height else 0.0
        merit = merit + (weight * (x**2 + (y - centre) ** 2)).sum()
    return merit / total


def _hits(lens: Lens, rows: Sequence[Row]) -> tuple[Tensor, Tensor, Tensor]:
    """x, y (R,) mm on the image of rows of one field and wavelength, and their weights."""
    wavelength = lens.wavelengths[rows[0].integers[1] - 1]
    field = lens.fields.y.abs().max() * _real(rows[0].numbers[:2])[:, None]
    points = _real([row.numbers[2:] for row in rows]).T
    rays = trace_lens(lens, launch(lens, points, fields=field, wavelengths=wavelength[None]), wavelength)
    return (*rays.position[:2, 0, 0], _real([row.weight for row in rows]))


def _moved(optic: Optic, radii: Sequence[int], thicknesses: Sequence[int], part: float) -> Optic:
    factors = [1 + part * (-1) ** place for place in range(len(radii) + len(thicknesses))]
    for number, factor in zip(radii, factors, strict=False):
        optic.updater.set_radius(factor * float(optic.surfaces[number].geometry.radius), number)
    for number, factor in zip(thicknesses, factors[len(radii) :], strict=True):
        gap = optic.surfaces[number + 1].geometry.cs.z - optic.surfaces[number].geometry.cs.z
        optic.updater.set_thickness(factor * float(gap), number)
    return optic


def _real(numbers) -> Tensor:
    return torch.as_tensor(numbers, dtype=torch.float64)


# -- Optiland ----------------------------------------------------------------------------------------------------------


class _Shared:
    """The rays of all rows in Optiland, traced once for a state of the lens, a call a wavelength."""

    def __init__(self, optic: Optic, rows: Sequence[Row], how: str):
        self.optic = optic
        rays = [row for row in rows if row.operand == "TRAC"]
        self.rays = sorted(rays, key=lambda row: row.integers[1])
        weight = np.array([row.weight for row in self.rays])
        height = np.array([row.numbers[1] for row in self.rays])
        colour = np.array([row.integers[1] for row in self.rays])
        same = (height[:, None] == height) & (height != 0)
        mean = same * weight / np.maximum((same * weight).sum(1, keepdims=True), 1e-300)
        self.bundles = [
            (float(optic.wavelengths.wavelengths[k - 1].value), np.array([r.numbers for r in self.rays])[colour == k].T)
            for k in np.unique(colour)
        ]
        spots = [(h, k) for h in np.unique(height) for k in np.unique(colour)]
        share = np.array([weight * (height == h) * (colour == k) for h, k in spots])
        self.mean, self.share = be.array(mean), be.array(share / sum(row.weight for row in rows))
        self.evaluate = {"rays": self._rays, "spots": self._spots}[how]
        total = sum(row.weight for row in rows)
        self.weights = [1.0] * len(spots) if how == "spots" else np.tile(np.sqrt(weight / total), 2).tolist()
        self.values: object = None

    def at(self, place: int):
        """One number of them, traced anew with the first: Optiland evaluates operands in order."""
        if place == 0:
            self.values = self.evaluate()
        return self.values[place]

    def _on_image(self):
        ends = [
            self.optic.ray_tracer.trace_generic(*(be.array(part) for part in numbers), wavelength, record=False)
            for wavelength, numbers in self.bundles
        ]
        x, y = (be.concatenate([getattr(end, axis) for end in ends]) for axis in "xy")
        return x, y - self.mean @ y

    def _rays(self):
        return be.concatenate(self._on_image())

    def _spots(self):
        x, y = self._on_image()
        return be.sqrt(self.share @ (x**2 + y**2))


operand_registry.register("shared_rays", lambda rays, place: rays.at(place), overwrite=True)


def posed(optic: Optic, rows: Sequence[Row], variables: Sequence[Vary], how: str) -> OptimizationProblem:
    """The problem in Optiland's terms, by "rays" or by "spots"; its `sum_squared()` is M²."""
    found, shared = OptimizationProblem(), _Shared(optic, rows, how)
    total = sum(row.weight for row in rows)
    for place, weight in enumerate(shared.weights):
        found.add_operand("shared_rays", target=0.0, weight=weight, input_data={"rays": shared, "place": place})
    for row in rows:
        if row.operand == "EFFL":
            weight = math.sqrt(row.weight / total)
            found.add_operand("f2", target=row.target, weight=weight, input_data={"optic": optic})
    for vary in variables:
        kind = {"curvature": "radius", "thickness": "thickness"}[vary.quantity]
        found.add_variable(optic, kind, surface_number=vary.surface)
    return found


# -- solvers -----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Run:
    """A run of a solver: M² at its ends, processor seconds, evaluations; reached: seconds in which this package gets
    to its end, nan for the package itself."""

    lens: str
    moved: float
    solver: str
    start: float
    end: float
    seconds: float
    evaluations: int
    reached: float = math.nan


class _Counted(LeastSquares):
    """Optiland's least squares with a count of its evaluations."""

    evaluations = 0

    def _compute_residuals_vector(self, x):
        self.evaluations += 1
        return super()._compute_residuals_vector(x)


def least_squares(problem: Problem, *, tolerance: float = 1e-3) -> Run:
    """Optiland's least squares; tolerance: of the sum of squares, its default."""
    be.set_backend("numpy")
    asked = posed(problem.optic(), problem.rows, problem.variables, "rays")
    solver = _Counted(asked)
    name = f"least squares, rays, tolerance {tolerance:g}"
    return _run(problem, name, asked, lambda: solver.optimize(tol=tolerance), lambda: solver.evaluations)


def adam(problem: Problem, steps: int) -> Run:
    """Optiland's Adam with the rate 1e-2 and the decay 0.99 of its defaults."""
    be.set_backend("torch")
    be.set_precision("float64")
    be.grad_mode.disable()
    optic = problem.optic()
    be.grad_mode.enable()
    try:
        asked = posed(optic, problem.rows, problem.variables, "spots")
        solve = lambda: TorchAdamOptimizer(asked).optimize(n_steps=steps, lr=1e-2, gamma=0.99, disp=False)  # noqa: E731
        return _run(problem, f"Adam, spots, {steps} steps of 0.01 · 0.99ⁿ", asked, solve, lambda: steps)
    finally:
        be.grad_mode.disable()
        be.set_backend("numpy")


def _run(problem: Problem, name: str, asked: OptimizationProblem, solve: Callable, evaluations: Callable) -> Run:
    start = float(asked.sum_squared())  # compiles its loops, too
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        began = time.process_time()
        solve()
        seconds = time.process_time() - began
    return Run(problem.name, problem.moved, name, start, float(asked.sum_squared()), seconds, evaluations())


def compared(name: str, moved: float, steps: int) -> list[Run]:
    """A sample lens optimised by this package and by both solvers of Optiland."""
    same = problem(name, moved=moved)
    others = [least_squares(same), adam(same, steps)]
    began = time.process_time()
    result = optimize(same.lens)
    seconds, merits = time.process_time() - began, result.history[:, 0].square()
    ends = result.merit_before**2, result.merit_after**2
    runs = [Run(name, moved, "this package", *ends, seconds, result.evaluations)]
    for run in others:
        cycles = (merits <= run.end).nonzero()
        reached = float(result.history[int(cycles[0]), 4]) if len(cycles) else math.inf
        runs.append(dataclasses.replace(run, reached=reached))
    return runs


def report(runs: Sequence[Run]) -> list[str]:
    """The table of docs/optimise.md."""
    columns = {
        "lens": lambda run: run.lens,
        "start": lambda run: f"sample ± {run.moved:.0%}" if run.moved else "sample",
        "solver": lambda run: run.solver,
        "M² before": lambda run: f"{run.start:.5g}",
        "M² after": lambda run: f"{run.end:.6g}",
        "processor s": lambda run: f"{run.seconds:.3g}",
        "evaluations": lambda run: str(run.evaluations),
        "this package reaches it in, s": lambda run: digits(run.reached, ".3g", "–"),
        "ratio": lambda run: digits(run.seconds / run.reached, ".0f", "–") if run.reached else "–",
    }
    return listing(columns, runs)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--lens", choices=PROBLEMS, nargs="+", default=[*PROBLEMS], help="sample lenses of Optiland")
    parser.add_argument("--steps", metavar="N", type=int, default=40, help="steps of Adam (default 40)")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    options(parser)
    arguments = parser.parse_args(argv)
    torch.set_num_threads(1)
    prepare()
    runs = [run for name in arguments.lens for moved in (0.0, 0.02) for run in compared(name, moved, arguments.steps)]
    print("\n".join(report(runs)))


if __name__ == "__main__":
    sys.exit(main())

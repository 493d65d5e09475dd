"""Speed of PSFs against their error: `raytrace bench psf` with peers, Sobol and random rays, direct sums and targets.

    python docs/experiments/bench_psf.py --docs FOLDER

docs/compare.md quotes the targets; all rows are in docs/speed_vs_error.csv. Random rays are brought to an error
of 1 %, direct Huygens sums to 1e-3; numbers of rays that would take too long are extrapolated.
"""

import argparse
import dataclasses
import functools
import math
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path

import bench_kit as kit
import torch
from bench_figures import psf_figure
from bench_kit import Page, Request, in_words
from pages import listing, milliseconds, yes

from raytrace.bench.measure import clock
from raytrace.bench.psf import (
    Case,
    Method,
    PsfRow,
    Truth,
    cases,
    errors_of,
    measured_rows,
    methods,
    relative_l1,
    row_of,
    truth_of,
)
from raytrace.cli.progress import progress
from raytrace.maths.numerics import to
from raytrace.maths.sampling import Grid, random
from raytrace.psf_models import MODELS, NotConverged, drt
from raytrace.psf_models.direct_sum import Sampling, direct_sum, sampling_of
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens
from raytrace.tracing.scene import Scene

#: Field angles in degrees, object distance in mm (None: that of the lens) and pixel pitch in mm of the published cases.
USUAL = {
    "double_gauss": ((0.0, 14.0), 1e4, 0.005),
    "phone": ((0.0,), None, 0.001),
    "hubble": ((0.0,), None, 0.005),
}
FINEST_WAVE = 3  # order of the wave model that its estimates are compared with
SOBOL = (256, 4096)
RANDOM, DIRECT = "random rays", "direct sum"
RAYS_ERROR, WAVE_ERROR = 0.01, 1e-3  # of random rays and of direct sums
GAUSSIAN_ERROR = 1e-6  # of σ and of the centroid
GAUSSIAN_RAYS = {True: 8, False: 40}  # on the axis, off it
FASTER = 50.0
PIECE = 2**16  # random rays at a time
PILOT = 2**17  # random rays whose error predicts how many are needed
PATIENCE = 20.0  # s: longer runs are extrapolated
LADDER = ((0.65, -1), (0.75, -1), (0.75, 0))  # parts of the wave model's rings and arms, added nodes; cheapest first
SQUARE = (64, 96)  # points across the square pupil grids that are run


@dataclasses.dataclass(frozen=True)
class Row(PsfRow):
    """own_error: the error that `estimate` bounds, against the finest order of the model (`gaussian`: of σ and energy,
    else of the kernel); extrapolated: from runs with fewer rays."""

    own_error: float | None = None
    extrapolated: bool = False


def published_cases(name: str, lens: Lens) -> list[Case]:
    """Those of USUAL, other lenses as `raytrace bench psf` has them."""
    if name not in USUAL:
        return cases(name, lens)
    fields, distance, pitch = USUAL[name]
    distance = float(lens.surfaces[0].thickness) if distance is None else distance
    return [Case(lens, name, field, distance, pitch) for field in fields]


def all_methods() -> list[Method]:
    """Those of `raytrace bench psf`, and Sobol rays."""
    sobol = [
        Method("Sobol rays", f"{rays} rays", functools.partial(drt.kernels_of_rays, rays=rays), "rays")
        for rays in SOBOL
    ]
    return methods() + sobol


def estimated_rows(truth: Truth, rows: Sequence[PsfRow]) -> list[Row]:
    """The rows, those with an estimate with the true error."""
    by_name, extended = {(method.model, method.sampling): method for method in methods()}, []
    finest = functools.cache(lambda: MODELS["wave"].kernels(truth.case.scene, truth.windows["wave"], order=FINEST_WAVE))
    for row in rows:
        error = None
        if row.estimate is not None:
            dtype, method = getattr(torch, row.dtype), by_name[row.model, row.sampling]
            with warnings.catch_warnings(), torch.no_grad():
                warnings.simplefilter("ignore", NotConverged)
                result = method.run(to(truth.case.scene, dtype=dtype), to(truth.windows[row.against], dtype=dtype))
                kernel = result.kernel.double().reshape(result.kernel.shape[-2:])
                exact = finest().kernel[0, 0, 0] if row.against == "wave" else truth.kernels[row.against]
            error = relative_l1(kernel, exact)
            if row.against == "gaussian":
                variance, energy = truth.sigma**2, float(exact.sum())
                excess = result.covariance.double().reshape(3)[::2] - variance
                error = max(float(0.5 * excess.abs().sum() / variance.sum()), abs(float(kernel.sum()) / energy - 1))
        extended.append(Row(**dataclasses.asdict(row), own_error=error))
    return extended


def bounds(row: Row) -> bool:
    """Whether the estimate bounds the error."""
    return row.own_error <= row.estimate


def bounds_closely(row: Row) -> bool:
    """Whether it does so within a factor of 10."""
    return row.own_error <= row.estimate <= 10 * row.own_error


def random_histogram(scene: Scene, grid: Grid, count: int, *, piece: int = PIECE, seed: int = 0) -> Kernels:
    """The histogram of independent random rays, in pieces."""
    generator = torch.Generator().manual_seed(seed)
    sampling = functools.partial(random, generator=generator)
    sizes = [min(piece, count - first) for first in range(0, count, piece)]
    parts = [drt.kernels_of_rays(scene, grid, rays=size, sampling=sampling, width=0) for size in sizes]
    centroid, covariance, kernel, arrived = (
        sum(size / count * values for size, values in zip(sizes, column, strict=True))
        for column in zip(*((part.centroid, part.covariance, part.kernel, part.arrived) for part in parts), strict=True)
    )
    return Kernels(kernel, grid, centroid, covariance, count, arrived)


def random_rows(truth: Truth, dtype: torch.dtype, threads: int) -> list[Row]:
    """Random rays: some thousands, and as many as bring the histogram to RAYS_ERROR (error ∝ rays^-1/2)."""
    scene, grid = to(truth.case.scene, dtype=dtype), to(truth.windows["rays"], dtype=dtype)

    @torch.no_grad()
    def run(count: int) -> Row:
        now = clock(threads)
        start = now()
        result = random_histogram(scene, grid, count)
        seconds = now() - start
        method = Method(RANDOM, f"{count:,} rays", random_histogram, "rays")
        return Row(**vars(row_of(truth, method, dtype, count, forward_s=seconds, **errors_of(truth, "rays", result))))

    run(1000)  # fills caches
    rows = [run(1000), run(10_000), run(PILOT)]
    pilot = rows[-1]
    needed = math.ceil(PILOT * (pilot.l1_error / RAYS_ERROR) ** 2)
    if needed <= 1000:
        return rows
    if needed * pilot.forward_s / PILOT > PATIENCE:
        return [*rows, _extrapolated(pilot, needed, RAYS_ERROR)]
    rows.append(run(needed))
    if RAYS_ERROR < rows[-1].l1_error < 1.5 * RAYS_ERROR:  # errors of random rays scatter; more is rounding
        rows.append(run(math.ceil(1.1 * needed * (rows[-1].l1_error / RAYS_ERROR) ** 2)))
    return rows


def direct_rows(truth: Truth, threads: int) -> list[Row]:
    """Direct sums over Gauss rings, up to the cheapest that meets WAVE_ERROR, and over square grids, extrapolated.

    The error of a square grid, of its ragged rim, falls with a power of the number of rays.
    """
    window, rows = truth.windows["wave"], []
    first = sampling_of(truth.case.scene, window)

    def run(sampling: Sampling) -> Row:
        now = clock(threads)
        start = now()
        kernel, count = direct_sum(truth.case.scene, window, sampling)
        seconds = now() - start
        method = Method(f"{DIRECT}, {'rings' if sampling.arms else 'grid'}", str(sampling), direct_sum, "wave")
        l1 = relative_l1(kernel, truth.kernels["wave"])
        return Row(**vars(row_of(truth, method, torch.float64, count, forward_s=seconds, l1_error=l1, model_error=l1)))

    for part, more in LADDER:
        sampling = first.scaled(part, more)
        rows.append(run(sampling))
        if rows[-1].l1_error <= WAVE_ERROR:
            break
    coarse, fine = square = [run(Sampling(across, 0, sampling.nodes)) for across in SQUARE]
    rows += square
    if fine.l1_error > WAVE_ERROR and fine.l1_error < coarse.l1_error:
        power = math.log(coarse.l1_error / fine.l1_error) / math.log(fine.rays / coarse.rays)
        rays = math.ceil(fine.rays * (fine.l1_error / WAVE_ERROR) ** (1 / power))
        rows.append(_extrapolated(fine, rays, WAVE_ERROR))
    return rows


def _extrapolated(row: Row, rays: int, error: float) -> Row:
    """With as many rays as the error needs, and time in proportion to them."""
    sampling = f"{rays:,} rays" if row.model == RANDOM else f"{round(math.sqrt(4 * rays / math.pi))}² grid"
    errors = {"l1_error": error, "sigma_error": None, "centroid_error": None, "model_error": None}
    seconds = row.forward_s * rays / row.rays
    return dataclasses.replace(row, sampling=sampling, rays=rays, forward_s=seconds, extrapolated=True, **errors)


def rows_of(case: Case, request: Request, bar) -> list[Row]:
    """Every method and peer, random rays and direct sums of a case."""
    truth, threads, dtypes = truth_of(case, bar.write), request.threads, (torch.float64, torch.float32)
    tasks = [(method, dtype) for method in all_methods() for dtype in dtypes]
    tasks += [(method, torch.float64) for method in request.peers.psf_methods(truth)] if request.peers else []
    rows = measured_rows(truth, tasks, request.arguments.repeats, threads, say=bar.write)
    bar.update(1)
    extended = estimated_rows(truth, rows) + [row for dtype in dtypes for row in random_rows(truth, dtype, threads)]
    return extended + (direct_rows(truth, threads) if "wave" in truth.kernels else [])


# -- targets -----------------------------------------------------------------------------------------------------------


def _power(number: float) -> str:
    return f"{number:.0e}".replace("e-0", "e-")


def targets(rows: Sequence[Row]) -> list[tuple[str, str, str, bool]]:
    """Target, case, measurement, and whether it is met: in float64, the estimates also in float32."""
    double, single = ([row for row in rows if row.dtype == dtype] for dtype in ("float64", "float32"))
    goals = []
    for lens, field in dict.fromkeys((row.lens, row.field) for row in double):
        chosen = [row for row in double if (row.lens, row.field) == (lens, field) and row.estimate is None]
        goals += [(goal, f"{lens}, {field:g}", *rest) for goal, *rest in _of_case(chosen, on_axis=field == 0)]
    order = list(dict.fromkeys(goal for goal, *_ in goals))
    goals.sort(key=lambda goal: order.index(goal[0]))
    for estimates, dtype in ((judged(double), "float64"), (judged(single), "float32")):
        for words, fact, least in (
            ("estimates bound the true error in ≥ 95 %", bounds, 0.95),
            ("estimates bound it within ten times in ≥ 50 %", bounds_closely, 0.5),
        ):
            share = sum(map(fact, estimates)) / max(len(estimates), 1)
            goals += [(words, dtype, f"{share:.0%} of {len(estimates)}", share >= least)] if estimates else []
    return goals


def _of_case(rows: Sequence[Row], *, on_axis: bool) -> list[tuple[str, str, bool]]:
    def meeting(model: str, error: float) -> list[Row]:
        return [row for row in rows if row.model == model and row.l1_error is not None and row.l1_error <= error]

    gaussians = [row for row in rows if row.model == "gaussian"]
    close = [row.rays for row in gaussians if max(row.sigma_error, row.centroid_error) <= GAUSSIAN_ERROR]
    most = GAUSSIAN_RAYS[on_axis]
    words = f"Gaussian parameters to {_power(GAUSSIAN_ERROR)} with ≤ {most} rays {'on' if on_axis else 'off'} the axis"
    goals = [(words, f"{min(close)} rays" if close else "not reached", bool(close) and min(close) <= most)]
    waves = [row.l1_error for row in rows if row.model == "wave"]
    words = f"geometric PSF to {RAYS_ERROR:.0%} at ≥ {FASTER:.0f}× less time than random rays"
    goals += _ratio(words, meeting("drt", RAYS_ERROR), meeting(RANDOM, RAYS_ERROR))
    if waves:
        words = f"wave PSF within {_power(WAVE_ERROR)} of the direct sum"
        goals.append((words, f"{min(waves):.1e}", min(waves) <= WAVE_ERROR))
    for rule, name in (("grid", "a square grid"), ("rings", "Gauss rings")):
        words = f"wave PSF at ≥ {FASTER:.0f}× less time than the direct sum over {name} that comes as close"
        goals += _ratio(words, meeting("wave", WAVE_ERROR), meeting(f"{DIRECT}, {rule}", WAVE_ERROR))
    return goals


def _ratio(goal: str, fast: Sequence[Row], slow: Sequence[Row]) -> list[tuple[str, str, bool]]:
    """The fastest of each."""
    if not fast or not slow:
        return []
    ours, theirs = (min(rows, key=lambda row: row.forward_s) for rows in (fast, slow))
    ratio = theirs.forward_s / ours.forward_s
    words = (
        f"{ratio:.0f}×: {milliseconds(ours.forward_s)} ms ({ours.sampling}, {ours.l1_error:.1e}) against "
        f"{'extrapolated ' * theirs.extrapolated}{milliseconds(theirs.forward_s)} ms ({theirs.sampling})"
    )
    return [(goal, words, ratio >= FASTER)]


def judged(rows: Sequence[Row]) -> list[Row]:
    """Rows with an estimate, once each: two tolerances may be met by the same kernel."""
    estimated = (row for row in rows if row.estimate is not None)
    return list({(row.lens, row.field, row.model, row.dtype, row.estimate): row for row in estimated}.values())


def bench(request: Request) -> Page:
    """Every method on every case, random rays, direct sums and targets."""
    names = dict.fromkeys(request.arguments.lenses or USUAL)
    chosen = [case for name in names for case in published_cases(Path(name).stem, request.open_lens(name))]
    with progress(len(chosen), "case", what="measuring") as bar:
        rows = [row for case in chosen for row in rows_of(case, request, bar)]
    names = ("target", "case", "measured", "met")
    columns = {name: (lambda goal, k=k: goal[k]) for k, name in enumerate(names)} | {"met": lambda goal: yes(goal[3])}
    goals, machine = targets(rows), request.about()
    about = {"repeats": request.arguments.repeats, "machine": machine}
    about["targets"] = [dict(zip(names, goal, strict=True)) for goal in goals]
    lines = [
        "## Targets",
        "",
        *listing(columns, goals),
        "",
        f"{in_words(machine)}. All rows: [csv](speed_vs_error.csv).",
    ]
    titles = {(case.name, case.field): case.title for case in chosen}
    return Page(rows, lines, about, functools.partial(psf_figure, titles=titles), ("tables.md", "speed_vs_error"))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lenses", metavar="LENS", nargs="*", help="as for `raytrace bench psf`")
    kit.shared(parser, "tables.md, speed_vs_error.csv and speed_vs_error.png")


def main(argv: Sequence[str] | None = None) -> None:
    kit.run(bench, options, argv, peers=True)


if __name__ == "__main__":
    sys.exit(main())

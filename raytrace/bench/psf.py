"""Speed of PSFs beside their error: time forward and forward + backward of every model against converged references.

Geometric models are compared with `drt.reference` (10⁸ random rays would be no closer), waves with the direct
Huygens sum, the others with their own limit: Gaussians with that of converged moments, the Fourier model with its
finest order.
"""

import dataclasses
import math
import statistics
import time
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.bench import psf_report
from raytrace.bench.huygens import Sampling, direct_sum, moments
from raytrace.bench.measure import clock, name_of, nothing, with_leaves
from raytrace.bench.psf_cases import DIRECT, RANDOM, USUAL, Case, Method, cases, doors, methods, random_histogram
from raytrace.bench.report import Asked, Measured
from raytrace.cli.progress import progress
from raytrace.maths.grid import Grid
from raytrace.maths.pupil import gauss_rings
from raytrace.maths.value import to
from raytrace.psf_models import MODELS, NotConverged, Psf, drt, paraxial, wave
from raytrace.psf_models.dft import nodes_per_pixel, rings_and_arms
from raytrace.psf_models.pixels import gaussian_pixels
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens
from raytrace.tracing.scene import Scene
from raytrace.tracing.wavefront import wavefront_of

_PIECE = 2**16  # random rays at a time
_PILOT = 2**17  # random rays that find how many are needed
_PATIENCE = 20.0  # s: what would take longer is extrapolated
_LIMIT = 0.4  # s for the repeats of one figure
_REFERENCE = 0.75  # of the rings and arms of the wave model's order 0 and some more, for the reference
_LADDER = ((0.65, -1), (0.75, -1), (0.75, 0))  # of its rings and arms, and of its nodes; cheapest first
_FINEST_WAVE = 3  # order of the wave model that stands for its limit
_SQUARE = (64, 96)  # points across the square pupil grids that are run


@dataclasses.dataclass(frozen=True)
class PsfRow:
    """One figure. Errors are relative; None where a quantity does not exist or was not measured.

    forward_s, both_s: median seconds, the second with one backward pass. l1_error: of the kernel against its model's
    limit; sigma_error: of σx or σy, the larger; centroid_error: in units of σ; estimate: what `psf` says of own_error,
    the error against the model's own finest order (`gaussian`: of σ and of the energy, else of the kernel);
    model_error: of the kernel against the direct sum of waves.
    against: what l1_error counts from; extrapolated: not run, but computed from runs with fewer rays.
    """

    lens: str
    field: float
    model: str
    sampling: str
    dtype: str
    rays: int
    forward_s: float
    both_s: float | None = None
    l1_error: float | None = None
    sigma_error: float | None = None
    centroid_error: float | None = None
    estimate: float | None = None
    own_error: float | None = None
    model_error: float | None = None
    against: str = "rays"
    extrapolated: bool = False


# -- what a case converges to ------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Truth:
    """What a case converges to. kernels: (rows, columns) by the name of the limit; windows: their grids.

    centroid: (2,) mm; sigma: (2,) mm of the rays; rings, arms, nodes: the wave model's own sampling at order 0.
    """

    case: Case
    kernels: dict[str, Tensor]
    windows: dict[str, Grid]
    centroid: Tensor
    sigma: Tensor
    rings: int = 0
    arms: int = 0
    nodes: int = 0


@torch.no_grad()
def truth_of(case: Case, say: Callable[[str], object] = nothing) -> Truth:
    """The converged kernels of a case; without those of a model that refuses the lens, which is said."""
    scene = case.scene
    light = moments(scene)
    window = case.window(light.centroid)
    shape = gaussian_pixels(window, *(t.reshape(2, 1, 1, 1) for t in (light.centroid, light.variance)))
    own = case.window(paraxial.chief_ray_height(scene).flatten())
    kernels = {
        "rays": drt.reference(scene, window)[0, 0, 0],
        "gaussian": light.energy * shape[0, 0, 0],
        "paraxial": paraxial.kernels(scene, own).kernel[0, 0, 0],
    }
    windows = dict.fromkeys(("rays", "gaussian", "wave"), window) | dict.fromkeys(("paraxial", "fourier"), own)
    sampling = 0, 0, 0
    try:
        kernels["fourier"] = MODELS["fourier"].kernels(scene, own, order=MODELS["fourier"].orders[-1]).kernel[0, 0, 0]
    except ValueError as refusal:
        say(f"{case.title}: {refusal}")
    try:
        rings, arms, nodes = sampling = wave_sampling(scene, window)
        finest = Sampling(*_scaled(rings + 4, arms + 16, _REFERENCE), nodes + 2)
        waves = direct_sum(scene, window, finest)[0]
        kernels["finest wave"] = MODELS["wave"].kernels(scene, window, order=_FINEST_WAVE).kernel[0, 0, 0]
        kernels["wave"] = waves
    except ValueError as refusal:
        say(f"{case.title}: {refusal}")
    return Truth(case, kernels, windows, light.centroid, torch.sqrt(light.variance), *sampling)


def wave_sampling(scene: Scene, grid: Grid) -> tuple[int, int, int]:
    """Rings, arms and nodes across a pixel that the wave model takes at order 0, from the phase over the pupil."""
    front = wavefront_of(scene, *gauss_rings(8, 32))
    offset = torch.linalg.vector_norm(grid.centre - front.centre[:2, 0, 0, 0])
    reach = float(offset + grid.pitch * math.hypot(grid.rows, grid.columns) / 2)
    L, M = front.direction[:2, 0, 0, 0]
    spread = torch.hypot(L - L.mean(), M - M.mean()).max()
    cutoff = 2e3 * float(spread * front.index[0] / front.wavelength[0])
    return (
        *rings_and_arms(wave.phase_along_radius(front, reach), 0),
        nodes_per_pixel(float(grid.pitch), cutoff, 0),
    )


def _scaled(rings: int, arms: int, part: float) -> tuple[int, int]:
    return max(4, round(part * rings)), max(8, 4 * round(part * arms / 4))


# -- the measurement ---------------------------------------------------------------------------------------------------


def bench(asked: Asked) -> Measured:
    """Every method on every case."""
    found = cases([(Path(name).stem, asked.open_lens(name)) for name in dict.fromkeys(asked.arguments.lenses or USUAL)])
    repeats = asked.arguments.repeats
    others = {"peer_methods": asked.peers.psf_methods} if asked.peers else {}
    with progress(steps(found), what="measuring") as bar:
        rows = measure(found, repeats=repeats, threads=asked.threads, progress=bar.update, say=bar.write, **others)
    about = asked.about()
    titles, goals = {(case.name, case.field): case.title for case in found}, psf_report.targets(rows)
    lines = psf_report.lines(rows, goals, titles=titles, about=about, repeats=repeats)
    document = {"repeats": repeats, "machine": about, "targets": [dataclasses.asdict(one) for one in goals]}
    return Measured(rows, lines, document, ("psf_figure", titles))


def measure(
    cases: Sequence[Case],
    *,
    repeats: int,
    threads: int,
    peer_methods: Callable[[Truth], Sequence[Method]] = lambda truth: (),
    progress: Callable[[int], object] = nothing,
    say: Callable[[str], object] = nothing,
) -> list[PsfRow]:
    """Every method on every case; what a method refuses is said, and left out. progress: of `steps(cases)`."""
    rows: list[PsfRow] = []
    for case in cases:
        truth = truth_of(case, say)
        progress(1)
        for method in (*methods(), *doors()):
            for dtype in (torch.float64, torch.float32):
                rows += _kept(truth, method, dtype, repeats, threads, say)
                progress(1)
        for dtype in (torch.float64, torch.float32):
            rows += random_rows(truth, dtype, threads)
            progress(1)
        rows += direct_rows(truth, threads) if "wave" in truth.kernels else []
        progress(1)
        for method in peer_methods(truth):
            rows += _kept(truth, method, torch.float64, repeats, threads, say)
        progress(1)
    return rows


def steps(cases: Sequence[Case]) -> int:
    """How often `measure` reports progress."""
    return len(cases) * (2 * len([*methods(), *doors()]) + 5)


def _kept(truth: Truth, method: Method, dtype: torch.dtype, repeats: int, threads: int, say) -> list[PsfRow]:
    """The row of a method, or none where it has no limit or refuses the case."""
    if method.against not in truth.kernels:
        return []
    try:
        return [one_row(truth, method, dtype, repeats=repeats, threads=threads)]
    except ValueError as refusal:
        say(f"{truth.case.title}, {method.model}, {method.sampling}: {refusal}")
        return []


def one_row(truth: Truth, method: Method, dtype: torch.dtype, *, repeats: int, threads: int) -> PsfRow:
    """Time and errors of one method."""
    scene, grid = to(truth.case.scene, dtype=dtype), to(truth.windows[method.against], dtype=dtype)
    both = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)  # its words are in the row: the estimate
        with torch.no_grad():
            found = method.run(scene, grid)  # fills caches
            forward = timed(lambda: method.run(scene, grid), repeats, threads)
        if method.has_gradient:
            both = timed(lambda: gradient(method, scene, grid), repeats, threads)
    errors = errors_of(truth, method.against, found)
    return _row(truth, method, dtype, found.rays, forward_s=forward, both_s=both, **errors)


def random_rows(truth: Truth, dtype: torch.dtype, threads: int) -> list[PsfRow]:
    """Random rays: some thousands, and as many as bring the histogram to RAYS_ERROR (error ∝ rays^-1/2)."""
    scene, grid = to(truth.case.scene, dtype=dtype), to(truth.windows["rays"], dtype=dtype)
    wanted = psf_report.RAYS_ERROR

    @torch.no_grad()
    def run(count: int) -> PsfRow:
        now = clock(threads)
        began = now()
        found = random_histogram(scene, grid, count, piece=_PIECE)
        seconds = now() - began
        method = Method(RANDOM, f"{count:,} rays", random_histogram, "rays")
        return _row(truth, method, dtype, count, forward_s=seconds, **errors_of(truth, "rays", found))

    run(1000)  # fills caches
    rows = [run(1000), run(10_000), run(_PILOT)]
    pilot = rows[-1]
    needed = math.ceil(_PILOT * (pilot.l1_error / wanted) ** 2)
    if needed <= 1000:
        return rows
    if needed * pilot.forward_s / _PILOT > _PATIENCE:
        return [*rows, _extrapolated(pilot, needed, wanted)]
    rows.append(run(needed))
    if wanted < rows[-1].l1_error < 1.5 * wanted:  # errors of random rays scatter; more than that is rounding
        rows.append(run(math.ceil(1.1 * needed * (rows[-1].l1_error / wanted) ** 2)))
    return rows


def direct_rows(truth: Truth, threads: int) -> list[PsfRow]:
    """Direct sums over Gauss rings, up to the cheapest that meets WAVE_ERROR, and over square grids, extrapolated.

    The error of a square grid falls with a power of its rays: it is that of its ragged rim.
    """
    window, rows, wanted = truth.windows["wave"], [], psf_report.WAVE_ERROR

    def run(sampling: Sampling) -> PsfRow:
        now = clock(threads)
        began = now()
        kernel, count = direct_sum(truth.case.scene, window, sampling)
        seconds = now() - began
        method = Method(f"{DIRECT}, {'rings' if sampling.arms else 'grid'}", str(sampling), direct_sum, "wave")
        l1 = relative_l1(kernel, truth.kernels["wave"])
        return _row(truth, method, torch.float64, count, forward_s=seconds, l1_error=l1, model_error=l1)

    for part, more in _LADDER:
        nodes = max(2, truth.nodes + more)
        rows.append(run(Sampling(*_scaled(truth.rings, truth.arms, part), nodes)))
        if rows[-1].l1_error <= wanted:
            break
    coarse, fine = square = [run(Sampling(across, 0, nodes)) for across in _SQUARE]
    rows += square
    if fine.l1_error > wanted and fine.l1_error < coarse.l1_error:
        power = math.log(coarse.l1_error / fine.l1_error) / math.log(fine.rays / coarse.rays)
        rows.append(_extrapolated(fine, math.ceil(fine.rays * (fine.l1_error / wanted) ** (1 / power)), wanted))
    return rows


def _extrapolated(row: PsfRow, rays: int, error: float) -> PsfRow:
    """The same with as many rays as the error needs, and time in proportion to them."""
    sampling = f"{rays:,} rays" if row.model == RANDOM else f"{round(math.sqrt(4 * rays / math.pi))}² grid"
    seconds = row.forward_s * rays / row.rays
    return dataclasses.replace(
        row, sampling=sampling, rays=rays, forward_s=seconds, l1_error=error, sigma_error=None, centroid_error=None,
        model_error=None, extrapolated=True,
    )  # fmt: skip


def gradient(method: Method, scene: Scene, grid: Grid) -> tuple[Tensor | None, ...]:
    """Derivatives of a number made of the kernel, by every curvature, conic, coefficient and thickness of the lens."""
    lens, leaves = with_all_leaves(scene.lens)
    kernel = method.run(dataclasses.replace(scene, lens=lens), grid).kernel
    pattern = torch.cos(torch.arange(kernel.shape[-2] * kernel.shape[-1], dtype=kernel.dtype))
    return torch.autograd.grad(kernel.flatten() @ pattern, leaves, allow_unused=True)


def with_all_leaves(lens: Lens) -> tuple[Lens, list[Tensor]]:
    """The lens with leaves for every shape that is modelled and every thickness behind surface 1, and the leaves."""
    names = ("curvature", "conic", "coefficients", "thickness")
    numbers = [(k, name) for k in range(1, len(lens.surfaces) - 1) for name in names]
    return with_leaves(lens, [(k, name) for k, name in numbers if getattr(lens.surfaces[k], name) is not None])


def timed(call: Callable[[], object], repeats: int, threads: int) -> float:
    """Median time of a call; slow ones are repeated less often."""
    now, seconds, end = clock(threads), [], time.perf_counter() + _LIMIT
    while not seconds or (len(seconds) < repeats and time.perf_counter() < end):
        began = now()
        call()
        seconds.append(now() - began)
    return statistics.median(seconds)


def errors_of(truth: Truth, against: str, found: Kernels) -> dict[str, float | None]:
    """Errors of what a method found; moments only of those that have the rays' moments for a limit."""
    kernel = found.kernel.detach().double().reshape(found.kernel.shape[-2:])
    errors = {"l1_error": relative_l1(kernel, truth.kernels[against])}
    if "wave" in truth.kernels:
        errors["model_error"] = relative_l1(kernel, truth.kernels["wave"])
    estimate = getattr(found, "error", None)
    if estimate is not None:
        errors["estimate"], errors["own_error"] = float(estimate), own_error(truth, against, found)
    if getattr(found, "covariance", None) is not None and float(truth.sigma.min()) > 0:
        moments = found.ray_moments if isinstance(found, Kernels) else (found.ray_centroid, found.ray_covariance)
        centroid, covariance = (moment.detach().double().flatten() for moment in moments)
        errors["sigma_error"] = float((torch.sqrt(covariance[::2]) / truth.sigma - 1).abs().max())
        offset = centroid - truth.centroid
        errors["centroid_error"] = float(offset.norm() / truth.sigma.norm())
    return errors


def own_error(truth: Truth, against: str, found: Psf) -> float:
    """The error that `psf` estimates: of the kernel, or of the variances and the energy of a Gaussian."""
    kernel = found.kernel.detach().double().reshape(found.kernel.shape[-2:])
    if against != "gaussian":
        return relative_l1(kernel, truth.kernels["finest wave" if against == "wave" else against])
    variance = truth.sigma**2
    width = 0.5 * (found.covariance.detach().double().reshape(3)[::2] - variance).abs().sum() / variance.sum()
    energy, total = float(kernel.sum()), float(truth.kernels["gaussian"].sum())
    return max(float(width), abs(energy / total - 1))


def relative_l1(kernel: Tensor, reference: Tensor) -> float:
    """Σ |k - r| / Σ r."""
    return float((kernel - reference).abs().sum() / reference.sum())


def _row(truth: Truth, method: Method, dtype: torch.dtype, rays: int, **figures) -> PsfRow:
    case, name = truth.case, name_of(dtype)
    return PsfRow(case.name, case.field, method.model, method.sampling, name, rays, against=method.against, **figures)

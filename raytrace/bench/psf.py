"""Speed of PSFs against their error: time forward and forward + backward of every model, against converged kernels.

Limits: `drt.reference` for geometric models (closer than 10⁸ random rays), the direct Huygens sum for waves, the
Gaussian of converged moments, and the finest order of the Fourier model.
"""

import dataclasses
import functools
import math
import statistics
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.bench.figures import psf_figure
from raytrace.bench.huygens import Sampling, direct_sum, moments
from raytrace.bench.measure import clock, name_of, nothing, with_leaves
from raytrace.bench.psf_cases import PIXELS, USUAL, Case, Method, cases, methods
from raytrace.bench.report import Measured, Request, clock_of, in_words, milliseconds, table, yes
from raytrace.cli.progress import progress
from raytrace.maths.numerics import to
from raytrace.maths.sampling import Grid, gauss_rings
from raytrace.psf_models import MODELS, NotConverged, Psf, drt, paraxial, wave
from raytrace.psf_models.dft import nodes_per_pixel, rings_and_arms
from raytrace.psf_models.pixels import gaussian_pixels
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens
from raytrace.tracing.scene import Scene
from raytrace.tracing.wavefront import wavefront_of

_LIMIT = 0.4  # s for the repeats of a measurement
_REFERENCE = 0.75  # of the rings and arms of the wave model's order 0, and some more, for the reference
_FINEST_WAVE = 3  # order of the wave model that its estimates are compared with


@dataclasses.dataclass(frozen=True)
class PsfRow:
    """A measurement. Errors are relative; None where a quantity does not exist.

    forward_s, both_s: median seconds, the second with a backward pass. l1_error: of the kernel against the limit
    `against`; sigma_error: of σx or σy, the larger; centroid_error: in units of σ; estimate: the error that `psf`
    reports, of own_error, the error against the finest order of the model (`gaussian`: of σ and energy, else of the
    kernel); model_error: of the kernel against the direct sum of waves; extrapolated: from runs with fewer rays.
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


# -- limits ------------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Truth:
    """Limits of a case. kernels: (rows, columns) by name; windows: their grids; centroid, sigma: (2,) mm of the rays;
    rings, arms, nodes: sampling of the wave model at order 0.
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
    """The converged kernels of a case. Models that refuse the lens are reported and left out."""
    scene = case.scene
    centroid, variance, energy = moments(scene)
    window = case.window(centroid)
    shape = gaussian_pixels(window, *(t.reshape(2, 1, 1, 1) for t in (centroid, variance)))
    about_chief = case.window(paraxial.chief_ray_height(scene).flatten())
    kernels = {
        "rays": drt.reference(scene, window)[0, 0, 0],
        "gaussian": energy * shape[0, 0, 0],
        "paraxial": paraxial.kernels(scene, about_chief).kernel[0, 0, 0],
    }
    windows = dict.fromkeys(("rays", "gaussian", "wave"), window) | dict.fromkeys(("paraxial", "fourier"), about_chief)
    sampling = 0, 0, 0
    try:
        fourier = MODELS["fourier"]
        kernels["fourier"] = fourier.kernels(scene, about_chief, order=fourier.orders[-1]).kernel[0, 0, 0]
    except ValueError as refusal:
        say(f"{case.title}: {refusal}")
    try:
        rings, arms, nodes = sampling = wave_sampling(scene, window)
        waves, _ = direct_sum(scene, window, Sampling(*scaled(rings + 4, arms + 16, _REFERENCE), nodes + 2))
        kernels["finest wave"] = MODELS["wave"].kernels(scene, window, order=_FINEST_WAVE).kernel[0, 0, 0]
        kernels["wave"] = waves
    except ValueError as refusal:
        say(f"{case.title}: {refusal}")
    return Truth(case, kernels, windows, centroid, torch.sqrt(variance), *sampling)


def wave_sampling(scene: Scene, grid: Grid) -> tuple[int, int, int]:
    """Rings, arms and nodes across a pixel of the wave model at order 0, from the phase over the pupil."""
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


def scaled(rings: int, arms: int, part: float) -> tuple[int, int]:
    """A part of rings and arms, at least 4 and 8."""
    return max(4, round(part * rings)), max(8, 4 * round(part * arms / 4))


# -- measurement -------------------------------------------------------------------------------------------------------


def bench(request: Request) -> Measured:
    """Every method on every case."""
    rows, titles, about = measured_rows(request)
    lines = report(rows, titles=titles, about=about["machine"], repeats=about["repeats"])
    return Measured(rows, lines, about, functools.partial(psf_figure, titles=titles))


def measured_rows(
    request: Request, more: Callable[[Truth, int], Sequence[PsfRow]] = lambda truth, threads: ()
) -> tuple[list[PsfRow], dict, dict]:
    """Rows, titles of the cases by lens and field, repeats and machine. more: further rows of a case and threads."""
    names = dict.fromkeys(request.arguments.lenses or USUAL)
    chosen = cases([(Path(name).stem, request.open_lens(name)) for name in names])
    repeats, rows = request.arguments.repeats, []
    with progress(steps(chosen), what="measuring") as bar:
        how = {"repeats": repeats, "threads": request.threads, "progress": bar.update, "say": bar.write}
        peer_methods = request.peers.psf_methods if request.peers else lambda truth: ()
        rows = measure(chosen, peer_methods=peer_methods, more=more, **how)
    titles = {(case.name, case.field): case.title for case in chosen}
    return rows, titles, {"repeats": repeats, "machine": request.about()}


def steps(cases: Sequence[Case]) -> int:
    """Number of calls of `progress` by `measure`."""
    return len(cases) * (2 * len(methods()) + 2)


def measure(
    cases: Sequence[Case],
    *,
    repeats: int,
    threads: int,
    peer_methods: Callable[[Truth], Sequence[Method]] = lambda truth: (),
    more: Callable[[Truth, int], Sequence[PsfRow]] = lambda truth, threads: (),
    progress: Callable[[int], object] = nothing,
    say: Callable[[str], object] = nothing,
) -> list[PsfRow]:
    """Every method on every case. Methods without a limit are left out, and those that refuse the case are reported."""
    rows: list[PsfRow] = []
    for case in cases:
        truth = truth_of(case, say)
        progress(1)
        both = (torch.float64, torch.float32)
        tasks = [(method, dtype, 1) for method in methods() for dtype in both]
        for method, dtype, step in [*tasks, *((method, torch.float64, 0) for method in peer_methods(truth))]:
            if method.against in truth.kernels:
                try:
                    rows.append(measured_row(truth, method, dtype, repeats=repeats, threads=threads))
                except ValueError as refusal:
                    say(f"{case.title}, {method.model}, {method.sampling}: {refusal}")
            progress(step)
        rows += more(truth, threads)
        progress(1)
    return rows


def measured_row(truth: Truth, method: Method, dtype: torch.dtype, *, repeats: int, threads: int) -> PsfRow:
    """Time and errors of a method."""
    scene, grid = to(truth.case.scene, dtype=dtype), to(truth.windows[method.against], dtype=dtype)
    both = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)  # the row holds the estimate
        with torch.no_grad():
            result = method.run(scene, grid)  # fills caches
            forward = timed(lambda: method.run(scene, grid), repeats, threads)
        if method.has_gradient:
            both = timed(lambda: gradient(method, scene, grid), repeats, threads)
    errors = errors_of(truth, method.against, result)
    return row_of(truth, method, dtype, result.rays, forward_s=forward, both_s=both, **errors)


def row_of(truth: Truth, method: Method, dtype: torch.dtype, rays: int, **figures) -> PsfRow:
    case, name = truth.case, name_of(dtype)
    return PsfRow(case.name, case.field, method.model, method.sampling, name, rays, against=method.against, **figures)


def gradient(method: Method, scene: Scene, grid: Grid) -> tuple[Tensor | None, ...]:
    """Derivatives of a weighted sum of the kernel with respect to all curvatures, conics, coefficients, thicknesses."""
    lens, leaves = with_all_leaves(scene.lens)
    kernel = method.run(dataclasses.replace(scene, lens=lens), grid).kernel
    pattern = torch.cos(torch.arange(kernel.shape[-2] * kernel.shape[-1], dtype=kernel.dtype))
    return torch.autograd.grad(kernel.flatten() @ pattern, leaves, allow_unused=True)


def with_all_leaves(lens: Lens) -> tuple[Lens, list[Tensor]]:
    """The lens with leaves for all modelled shape parameters and thicknesses of its surfaces, and the leaves."""
    names = ("curvature", "conic", "coefficients", "thickness")
    numbers = [(k, name) for k in range(1, len(lens.surfaces) - 1) for name in names]
    return with_leaves(lens, [(k, name) for k, name in numbers if getattr(lens.surfaces[k], name) is not None])


def timed(call: Callable[[], object], repeats: int, threads: int) -> float:
    """Median time of a call; slow ones are repeated less often."""
    now, seconds, end = clock(threads), [], time.perf_counter() + _LIMIT
    while not seconds or (len(seconds) < repeats and time.perf_counter() < end):
        start = now()
        call()
        seconds.append(now() - start)
    return statistics.median(seconds)


def errors_of(truth: Truth, against: str, result: Kernels | Psf) -> dict[str, float | None]:
    """Errors of the kernel, of the moments if there are some, and of the estimate."""
    kernel = result.kernel.detach().double().reshape(result.kernel.shape[-2:])
    errors = {"l1_error": relative_l1(kernel, truth.kernels[against])}
    if "wave" in truth.kernels:
        errors["model_error"] = relative_l1(kernel, truth.kernels["wave"])
    if isinstance(result, Psf):
        errors["estimate"], errors["own_error"] = float(result.error), own_error(truth, against, result)
    if result.covariance is not None and float(truth.sigma.min()) > 0:
        parts = result.ray_moments if isinstance(result, Kernels) else (result.ray_centroid, result.ray_covariance)
        centroid, covariance = (moment.detach().double().flatten() for moment in parts)
        errors["sigma_error"] = float((torch.sqrt(covariance[::2]) / truth.sigma - 1).abs().max())
        errors["centroid_error"] = float((centroid - truth.centroid).norm() / truth.sigma.norm())
    return errors


def own_error(truth: Truth, against: str, result: Psf) -> float:
    """The error that `psf` estimates: of the kernel, or of the variances and the energy of a Gaussian."""
    kernel = result.kernel.detach().double().reshape(result.kernel.shape[-2:])
    if against != "gaussian":
        return relative_l1(kernel, truth.kernels["finest wave" if against == "wave" else against])
    variance = truth.sigma**2
    width = 0.5 * (result.covariance.detach().double().reshape(3)[::2] - variance).abs().sum() / variance.sum()
    return max(float(width), abs(float(kernel.sum()) / float(truth.kernels["gaussian"].sum()) - 1))


def relative_l1(kernel: Tensor, reference: Tensor) -> float:
    """Σ |k - r| / Σ r."""
    return float((kernel - reference).abs().sum() / reference.sum())


# -- report ------------------------------------------------------------------------------------------------------------


def report(
    rows: Sequence[PsfRow], *, titles: Mapping[tuple[str, float], str], about: Mapping, repeats: int,
    head: Sequence[str] = (),
) -> list[str]:  # fmt: skip
    """The page. titles: of the cases, by lens and field; head: further lines above the tables."""
    lines = [
        f"Times of one kernel of {PIXELS} × {PIXELS} pixels, ms: median {clock_of(about)} of up to {repeats} warm "
        "runs.",
        *("", in_words(about) + ".", "", *head, "## How to read the tables", "", *_LEGEND, ""),
    ]
    for case, title in titles.items():
        pairs: dict[tuple[str, str], list] = {}  # of dtypes, float64 first
        for row in sorted(rows, key=lambda row: row.dtype == "float32"):
            if (row.lens, row.field) == case and row.estimate is None:
                pairs.setdefault((row.model, row.sampling), []).append(row)
        order = dict.fromkeys((row.model, row.sampling) for row in rows)
        lines += [f"## {title}", "", *table(_CASE, [pairs[key] for key in order if key in pairs]), ""]
    estimated = [row for row in rows if row.estimate is not None]
    columns = {"case": lambda row: titles[row.lens, row.field]} | _ESTIMATES
    return [*lines, "## Driven by a tolerance", "", *table(columns, estimated)]


def bounds(row: PsfRow) -> bool:
    """Whether the estimate bounds the error."""
    return row.own_error <= row.estimate


def bounds_closely(row: PsfRow) -> bool:
    """Whether it does so within a factor of 10."""
    return row.own_error <= row.estimate <= 10 * row.own_error


_LEGEND = (
    "Two values in a cell: float64 / float32. `+ backward`: forward and the gradient with respect to every curvature, "
    "conic, asphere coefficient and thickness. An asterisk: extrapolated from the lines above it.",
    "",
    "- L1 error: Σ|k - r|/Σr of the kernel. `drt`, Sobol and random rays: against 2 million cells of the ray map. "
    "`wave`, direct sums, Optiland's waves: against the direct Huygens sum. `gaussian`: against the Gaussian of "
    "converged moments. `paraxial`, `fourier`: against their own finest order.",
    "- σ error: of σx or σy, the larger; centroid error: in units of σ; both against converged moments of the rays, "
    "for `paraxial` and `fourier`, too: there they are errors of the model.",
    "- from wave: L1 difference of the kernel from the direct Huygens sum, the error of the model. `paraxial` and "
    "`fourier` are compared in a window about their own chief ray, so that distortion does not count twice.",
    "- Optiland's kernels are scaled to the energy of the reference: shapes are compared.",
)


def _error(number: float | None) -> str:
    return "" if number is None else "0" if number == 0 else f"{number:.1e}"


def _both(name: str, form: Callable[[float | None], str]) -> Callable[[Sequence], str]:
    """A quantity of both dtypes in one cell."""

    def cell(pair: Sequence) -> str:
        if all(getattr(row, name) is None for row in pair):
            return ""
        alone = "– / " if len(pair) == 1 and pair[0].dtype == "float32" else ""
        return alone + " / ".join(form(getattr(row, name)) for row in pair)

    return cell


_CASE = {
    "model": lambda pair: pair[0].model,
    "sampling": lambda pair: pair[0].sampling + ("*" if pair[0].extrapolated else ""),
    "rays": lambda pair: " / ".join(dict.fromkeys(f"{row.rays:,}" for row in pair)),
    "forward": _both("forward_s", milliseconds),
    "+ backward": _both("both_s", milliseconds),
    "L1 error": _both("l1_error", _error),
    "σ error": _both("sigma_error", _error),
    "centroid error": _both("centroid_error", _error),
    "from wave": lambda pair: _error(pair[0].model_error),
}
_ESTIMATES = {
    "model": lambda row: row.model,
    "asked": lambda row: row.sampling.removeprefix("tol "),
    "dtype": lambda row: row.dtype,
    "estimated": lambda row: _error(row.estimate),
    "true": lambda row: _error(row.own_error),
    "bounds": lambda row: yes(bounds(row)),
    "within ten": lambda row: yes(bounds_closely(row)),
    "rays": lambda row: f"{row.rays:,}",
    "forward": lambda row: milliseconds(row.forward_s),
    "+ backward": lambda row: milliseconds(row.both_s),
}

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
from raytrace.bench.measure import clock, name_of, nothing, with_leaves
from raytrace.bench.report import Measured, Request, clock_of, in_words
from raytrace.cli.progress import progress
from raytrace.maths.numerics import to
from raytrace.maths.sampling import Grid, grid
from raytrace.pages import listing, milliseconds, yes
from raytrace.psf_models import MODELS, NotConverged, Psf, direct_sum, drt, paraxial, psf
from raytrace.psf_models.direct_sum import Sampling, moments, sampling_of
from raytrace.psf_models.gaussian import gaussian_pixels
from raytrace.psf_models.gaussian import kernels as gaussian_kernels
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens, with_object_distance
from raytrace.tracing.paraxial import first_order, largest_field
from raytrace.tracing.scene import Scene, scene

_LIMIT = 0.4  # s for the repeats of a measurement
_FINEST_WAVE = 3  # order of the wave model that its estimates are compared with
PIXELS = 21  # across every window
#: Field angles in degrees, object distance in mm (None: that of the lens) and pixel pitch in mm of the default cases.
USUAL = {
    "double_gauss": ((0.0, 14.0), 1e4, 0.005),
    "phone": ((0.0,), None, 0.001),
    "hubble": ((0.0,), None, 0.005),
}
_ORDERS = {
    "gaussian": (2, 3, 4, 5, 6, 8, 12),
    "drt": (0, 1, 2, 3, 4, 6),
    "fourier": tuple(MODELS["fourier"].orders[:3]),
    "wave": tuple(MODELS["wave"].orders[:3]),
}
_TOLERANCES = {"gaussian": (1e-2, 1e-4, 1e-6), "drt": (1e-1, 1e-2, 1e-3), "fourier": (1e-2, 1e-4), "wave": (1e-2, 1e-3)}
_SOBOL = (256, 4096)


# -- cases and methods ------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case:
    """A lens, field, object distance (mm) and pixel pitch (mm): a panel of the figure."""

    lens: Lens
    name: str
    field: float
    distance: float
    pitch: float

    @property
    def title(self) -> str:
        return f"{self.name}, {self.field:g}{'°' if self.lens.fields.kind == 'angle' else ' mm'}"

    @property
    def scene(self) -> Scene:
        """The primary wavelength alone, float64."""
        wavelength = self.lens.primary[None]
        field = wavelength.new_tensor([[0.0], [self.field]])
        return scene(self.lens, field, wavelength.new_tensor([self.distance]), wavelength)

    def window(self, centre: Tensor) -> Grid:
        return grid(centre.new_tensor(self.pitch), PIXELS, centre)


@dataclasses.dataclass(frozen=True)
class Method:
    """A way to compute a kernel. run: (scene, grid) -> kernel, centroid, covariance and rays.

    against: the limit of its error: "rays", "wave", or its own: "gaussian", "paraxial", "fourier".
    """

    model: str
    sampling: str
    run: Callable[[Scene, Grid], Kernels | Psf]
    against: str
    has_gradient: bool = True


def cases(lenses: Sequence[tuple[str, Lens]]) -> list[Case]:
    """The default conditions of the lenses of USUAL; others at their own distance, on the axis and at the largest
    field, with a window of at least 7 σ and 8 λN."""
    chosen = []
    for name, lens in lenses:
        fields, distance, pitch = USUAL.get(name, (dict.fromkeys((0.0, float(largest_field(lens)[1]))), None, None))
        distance = float(lens.surfaces[0].thickness) if distance is None else distance
        chosen += [Case(lens, name, field, distance, pitch or _pitch(lens, field, distance)) for field in fields]
    return chosen


def methods() -> list[Method]:
    """Every model at several orders, Sobol rays, and `psf(…, tol=…)` with the estimate of its error."""

    def to_tolerance(model: str, tol: float, scene: Scene, grid: Grid) -> Psf:
        conditions = {"fields": scene.fields, "wavelengths": scene.wavelengths}
        distances = scene.lens.surfaces[0].thickness.flatten()
        return psf(scene.lens, model, object_distances=distances, grid=grid, tol=tol, **conditions)

    limits = {model: "rays" if model == "drt" else model for model in _ORDERS}
    chosen = [Method("paraxial", "closed form", paraxial.kernels, "paraxial")]
    for model, orders in _ORDERS.items():
        for order in orders:
            sampling = f"{order} rings" if model == "gaussian" else f"order {order}"
            run = functools.partial(MODELS[model].kernels, order=order)
            chosen.append(Method(model, sampling, run, limits[model]))
    for rays in _SOBOL:
        run = functools.partial(drt.kernels_of_rays, rays=rays)
        chosen.append(Method("Sobol rays", f"{rays} rays", run, "rays"))
    for model, tolerances in _TOLERANCES.items():
        for tol in tolerances:
            run = functools.partial(to_tolerance, model, tol)
            chosen.append(Method(model, f"tol {tol:.0e}".replace("e-0", "e-"), run, limits[model]))
    return chosen


def _pitch(lens: Lens, field: float, distance: float) -> float:
    """A round pixel pitch whose window of PIXELS holds 7 σ of the rays and 8 λN."""
    with torch.no_grad():
        light = gaussian_kernels(Case(lens, "", field, distance, 1.0).scene, grid(1.0, 1), order=8)
        width = 7 * float(light.covariance[::2].max().sqrt())
        number = float(first_order(with_object_distance(lens, distance)).paraxial_working_f_number)
        airy = 8e-3 * float(lens.primary) * number
    pitch = max(width, airy if math.isfinite(airy) else 0.0, 1e-6) / PIXELS
    decade = 10.0 ** math.floor(math.log10(pitch))
    return next(step for step in (decade, 2 * decade, 5 * decade, 10 * decade) if step >= pitch * (1 - 1e-9))


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
    sampling: of the wave model at order 0.
    """

    case: Case
    kernels: dict[str, Tensor]
    windows: dict[str, Grid]
    centroid: Tensor
    sigma: Tensor
    sampling: Sampling | None = None


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
    sampling = None
    try:
        fourier = MODELS["fourier"]
        kernels["fourier"] = fourier.kernels(scene, about_chief, order=fourier.orders[-1]).kernel[0, 0, 0]
    except ValueError as refusal:
        say(f"{case.title}: {refusal}")
    try:
        sampling, waves = sampling_of(scene, window), direct_sum.reference(scene, window)
        kernels["finest wave"] = MODELS["wave"].kernels(scene, window, order=_FINEST_WAVE).kernel[0, 0, 0]
        kernels["wave"] = waves
    except ValueError as refusal:
        say(f"{case.title}: {refusal}")
    return Truth(case, kernels, windows, centroid, torch.sqrt(variance), sampling)


# -- measurement -------------------------------------------------------------------------------------------------------


def bench(
    request: Request,
    more: Callable[[Truth, int], Sequence[PsfRow]] = lambda truth, threads: (),
) -> Measured:
    """Every method on every case. more: further rows of a case and threads."""
    names = dict.fromkeys(request.arguments.lenses or USUAL)
    chosen = cases([(Path(name).stem, request.open_lens(name)) for name in names])
    repeats, peer_methods = request.arguments.repeats, request.peers.psf_methods if request.peers else lambda truth: ()
    with progress(steps(chosen), what="measuring") as bar:
        how = {"repeats": repeats, "threads": request.threads, "progress": bar.update, "say": bar.write}
        rows = measure(chosen, peer_methods=peer_methods, more=more, **how)
    about = {"repeats": repeats, "machine": request.about()}
    titles = {(case.name, case.field): case.title for case in chosen}
    lines = report(rows, titles=titles, about=about["machine"], repeats=repeats)
    return Measured(rows, lines, about, functools.partial(psf_figure, titles=titles))


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
    if isinstance(result, Psf):  # with an estimate: of the kernel, or of the variances and the energy of a Gaussian
        errors["estimate"] = float(result.error)
        errors["own_error"] = relative_l1(kernel, truth.kernels["finest wave" if against == "wave" else against])
        if against == "gaussian":
            variance, energy = truth.sigma**2, float(truth.kernels["gaussian"].sum())
            excess = result.covariance.detach().double().reshape(3)[::2] - variance
            width = float(0.5 * excess.abs().sum() / variance.sum())
            errors["own_error"] = max(width, abs(float(kernel.sum()) / energy - 1))
    if result.covariance is not None and float(truth.sigma.min()) > 0:
        parts = result.ray_moments if isinstance(result, Kernels) else (result.ray_centroid, result.ray_covariance)
        centroid, covariance = (moment.detach().double().flatten() for moment in parts)
        errors["sigma_error"] = float((torch.sqrt(covariance[::2]) / truth.sigma - 1).abs().max())
        errors["centroid_error"] = float((centroid - truth.centroid).norm() / truth.sigma.norm())
    return errors


def relative_l1(kernel: Tensor, reference: Tensor) -> float:
    """Σ |k - r| / Σ r."""
    return float((kernel - reference).abs().sum() / reference.sum())


# -- report ------------------------------------------------------------------------------------------------------------


def report(
    rows: Sequence[PsfRow], *, titles: Mapping[tuple[str, float], str], about: Mapping, repeats: int
) -> list[str]:
    """The page. titles: of the cases, by lens and field."""
    lines = [
        f"Times of one kernel of {PIXELS} × {PIXELS} pixels, ms: median {clock_of(about)} of up to {repeats} warm "
        "runs.",
        *("", in_words(about) + ".", "", "## How to read the tables", "", *_LEGEND, ""),
    ]
    for case, title in titles.items():
        pairs: dict[tuple[str, str], list] = {}  # of dtypes, float64 first
        for row in sorted(rows, key=lambda row: row.dtype == "float32"):
            if (row.lens, row.field) == case and row.estimate is None:
                pairs.setdefault((row.model, row.sampling), []).append(row)
        order = dict.fromkeys((row.model, row.sampling) for row in rows)
        lines += [f"## {title}", "", *listing(_CASE, [pairs[key] for key in order if key in pairs]), ""]
    estimated = [row for row in rows if row.estimate is not None]
    columns = {"case": lambda row: titles[row.lens, row.field]} | _ESTIMATES
    return [*lines, "## Driven by a tolerance", "", *listing(columns, estimated)]


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

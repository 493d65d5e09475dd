"""Speed of PSFs against their error: time forward and forward + backward of every model, against converged kernels.

References: `drt.reference` for geometric models (closer than 10⁸ random rays), the direct Huygens sum for waves, the
Gaussian of converged moments, and the finest order of the Fourier model.
"""

import dataclasses
import functools
import math
import statistics
import time
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from operator import attrgetter
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from raytrace.bench.measure import DTYPES, clock, name_of, nothing, with_leaves
from raytrace.bench.result import Figure, Measured, Quantity, clock_name, curves, machine
from raytrace.cli.progress import progress
from raytrace.maths.numerics import to
from raytrace.maths.result import Column
from raytrace.maths.sampling import Grid, grid
from raytrace.psf_models import MODELS, NotConverged, Psf, direct_sum, drt, paraxial, psf
from raytrace.psf_models.direct_sum import moments
from raytrace.psf_models.gaussian import gaussian_pixels
from raytrace.psf_models.result import Kernels
from raytrace.system.lens import Lens
from raytrace.tracing.paraxial import first_order, largest_field
from raytrace.tracing.scene import Scene, scene

PIXELS = 21  # across every window
_LIMIT = 0.4  # s for the repeats of a measurement
_LEAST = 1e-9  # errors below are rounding, and not drawn
_ORDERS = {
    "gaussian": (2, 3, 4, 5, 6, 8, 12),
    "drt": (0, 1, 2, 3, 4, 6),
    "fourier": tuple(MODELS["fourier"].orders[:3]),
    "wave": tuple(MODELS["wave"].orders[:3]),
}
_TOLERANCES = {"gaussian": (1e-2, 1e-4, 1e-6), "drt": (1e-1, 1e-2, 1e-3), "fourier": (1e-2, 1e-4), "wave": (1e-2, 1e-3)}


# -- cases and methods ------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Case:
    """A lens, field, object distance (mm) and pixel pitch (mm)."""

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

    against: the reference of its error: "rays", "wave", or its own: "gaussian", "paraxial", "fourier".
    """

    model: str
    sampling: str
    run: Callable[[Scene, Grid], Kernels | Psf]
    against: str
    has_gradient: bool = True


def cases(name: str, lens: Lens) -> list[Case]:
    """A lens on the axis and at its largest field, in a window of at least 7 σ and 8 λN."""
    distance = float(lens.surfaces[0].thickness)
    fields = dict.fromkeys((0.0, float(largest_field(lens)[1])))
    return [Case(lens, name, field, distance, _pitch(lens, field, distance)) for field in fields]


def methods() -> list[Method]:
    """Every model at several orders, and `psf(…, tol=…)` with the estimate of its error."""

    def to_tolerance(model: str, tol: float, scene: Scene, grid: Grid) -> Psf:
        distances = scene.lens.surfaces[0].thickness.flatten()
        conditions: dict[str, Any] = {"fields": scene.fields, "wavelengths": scene.wavelengths}
        return psf(scene.lens, model, object_distances=distances, grid=grid, tol=tol, **conditions)

    references = {model: "rays" if model == "drt" else model for model in _ORDERS}
    chosen = [Method("paraxial", "closed form", paraxial.kernels, "paraxial")]
    for model, orders in _ORDERS.items():
        for order in orders:
            sampling = f"{order} rings" if model == "gaussian" else f"order {order}"
            run = functools.partial(MODELS[model].kernels, order=order)
            chosen.append(Method(model, sampling, run, references[model]))
    for model, tolerances in _TOLERANCES.items():
        for tol in tolerances:
            name, to_tol = f"tol {tol:.0e}".replace("e-0", "e-"), functools.partial(to_tolerance, model, tol)
            chosen.append(Method(model, name, to_tol, references[model]))
    return chosen


def _pitch(lens: Lens, field: float, distance: float) -> float:
    """The pixel pitch whose window of PIXELS holds 7 σ of the rays and 8 λN."""
    with torch.no_grad():
        light = MODELS["gaussian"].kernels(Case(lens, "", field, distance, 1.0).scene, grid(1.0, 1), order=8)
        width = 7 * float(light.ray_moments[1][::2].max().sqrt())
        number = float(first_order(lens.at(object_distance=distance)).paraxial_working_f_number)
    airy = 8e-3 * float(lens.primary) * number
    return max(width, airy if math.isfinite(airy) else 0.0, 1e-6) / PIXELS


# -- references --------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Truth:
    """Converged kernels of a case.

    kernels: (rows, columns) by name; windows: their grids; centroid, sigma: (2,) mm of the rays.
    """

    case: Case
    kernels: dict[str, Tensor]
    windows: dict[str, Grid]
    centroid: Tensor
    sigma: Tensor


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
    finest = functools.partial(MODELS["fourier"].kernels, scene, about_chief, order=MODELS["fourier"].orders[-1])
    for name, reference in {
        "fourier": lambda: finest().kernel[0, 0, 0],
        "wave": lambda: direct_sum.reference(scene, window),
    }.items():
        try:
            kernels[name] = reference()
        except ValueError as refusal:
            say(f"{case.title}: {refusal}")
    return Truth(case, kernels, windows, centroid, torch.sqrt(variance))


# -- measurement -------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class PsfRow:
    """A measurement. Errors are relative; None where a quantity does not exist.

    forward_s, both_s: median seconds, the second with a backward pass. l1_error: of the kernel against the reference
    `against`; sigma_error: of σx or σy, the larger; centroid_error: in units of σ; estimate: the error that `psf`
    reports; model_error: of the kernel against the direct sum of waves.
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
    model_error: float | None = None
    against: str = "rays"


PRINTED: Mapping[Column, Quantity] = {
    Column("lens", form="<"): attrgetter("lens"),
    Column("field", form="g"): attrgetter("field"),
    Column("model", form="<"): attrgetter("model"),
    Column("sampling", form="<"): attrgetter("sampling"),
    Column("dtype", form="<"): attrgetter("dtype"),
    Column("rays", form=".0f"): attrgetter("rays"),
    Column("forward", "ms", ".3g"): lambda row: 1e3 * row.forward_s,
    Column("both", "ms", ".3g", "with\ngradient"): lambda row: row.both_s and 1e3 * row.both_s,
    Column("L1", form=".1e", heading="L1\nerror"): attrgetter("l1_error"),
    Column("sigma", form=".1e", heading="σ\nerror"): attrgetter("sigma_error"),
    Column("centroid", form=".1e", heading="centroid\nerror"): attrgetter("centroid_error"),
    Column("estimate", form=".1e", heading="estimated\nerror"): attrgetter("estimate"),
    Column("wave", form=".1e", heading="from\nwave"): attrgetter("model_error"),
}


def bench(lenses: Mapping[str, Lens], *, repeats: int, threads: int) -> Measured:
    """Every method on the axis and at the largest field of the lenses."""
    chosen = [case for name, lens in lenses.items() for case in cases(Path(name).stem, lens)]
    rows: list[PsfRow] = []
    with progress(len(chosen) * (2 * len(methods()) + 1), what="measuring") as bar:
        for case in chosen:
            truth = truth_of(case, bar.write)
            bar.update(1)
            tasks = [(method, dtype) for method in methods() for dtype in DTYPES]
            rows += measured_rows(truth, tasks, repeats, threads, progress=bar.update, say=bar.write)
    about = {"pixels": PIXELS, "repeats": repeats, "machine": machine()}
    notes = (
        f"Times of one kernel of {PIXELS} × {PIXELS} pixels: median {clock_name(threads)} of up to {repeats} warm "
        "runs; with the gradient by every curvature, conic, asphere coefficient and thickness.",
        "L1 error: Σ|k - r|/Σr of the kernel, for drt against 2 million cells of the ray map, for wave against the "
        "direct Huygens sum, for gaussian against the Gaussian of converged moments, for paraxial and fourier against "
        "their finest order.",
        "σ error: of σx or σy, the larger; centroid error: in units of σ; both against converged moments of the rays. "
        "Estimated error: as psf reports it for a tolerance.",
        "From wave: L1 difference of the kernel from the direct Huygens sum, the error of the model. paraxial and "
        "fourier are compared in a window about their own chief ray, without distortion.",
    )
    return Measured(rows, about, PRINTED, notes, figure)


def measured_rows(
    truth: Truth, tasks: Iterable[tuple[Method, torch.dtype]], repeats: int, threads: int,
    *, progress: Callable[[int], object] = nothing, say: Callable[[str], object] = nothing,
) -> list[PsfRow]:  # fmt: skip
    """A row of every method and dtype. Methods without a reference are left out, those that refuse are reported."""
    rows: list[PsfRow] = []
    for method, dtype in tasks:
        if method.against in truth.kernels:
            try:
                rows.append(measured_row(truth, method, dtype, repeats, threads))
            except ValueError as refusal:
                say(f"{truth.case.title}, {method.model}, {method.sampling}: {refusal}")
        progress(1)
    return rows


def measured_row(truth: Truth, method: Method, dtype: torch.dtype, repeats: int, threads: int) -> PsfRow:
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


def row_of(truth: Truth, method: Method, dtype: torch.dtype, rays: int, **figures: Any) -> PsfRow:
    case, name = truth.case, name_of(dtype)
    return PsfRow(case.name, case.field, method.model, method.sampling, name, rays, against=method.against, **figures)


def gradient(method: Method, scene: Scene, grid: Grid) -> tuple[Tensor | None, ...]:
    """Derivatives of a weighted sum of the kernel by all modelled curvatures, conics, coefficients and thicknesses."""
    names, lens = ("curvature", "conic", "coefficients", "thickness"), scene.lens
    numbers = [(k, name) for k in range(1, len(lens.surfaces) - 1) for name in names]
    lens, leaves = with_leaves(lens, [(k, name) for k, name in numbers if getattr(lens.surfaces[k], name) is not None])
    kernel = method.run(dataclasses.replace(scene, lens=lens), grid).kernel
    pattern = torch.cos(torch.arange(kernel.shape[-2] * kernel.shape[-1], dtype=kernel.dtype))
    return torch.autograd.grad(kernel.flatten() @ pattern, leaves, allow_unused=True)


def timed(call: Callable[[], object], repeats: int, threads: int) -> float:
    """Median time of a call; slow ones are repeated less often."""
    seconds: list[float] = []
    now, end = clock(threads), time.perf_counter() + _LIMIT
    while not seconds or (len(seconds) < repeats and time.perf_counter() < end):
        start = now()
        call()
        seconds.append(now() - start)
    return statistics.median(seconds)


def errors_of(truth: Truth, against: str, result: Kernels | Psf) -> dict[str, float | None]:
    """Errors of the kernel, of the moments if there are some, and of the estimate."""
    kernel = result.kernel.detach().double().reshape(result.kernel.shape[-2:])
    errors: dict[str, float | None] = {"l1_error": relative_l1(kernel, truth.kernels[against])}
    if "wave" in truth.kernels:
        errors["model_error"] = relative_l1(kernel, truth.kernels["wave"])
    if isinstance(result, Psf):
        errors["estimate"] = float(result.error)
    if result.covariance is not None and float(truth.sigma.min()) > 0:
        parts = result.ray_moments if isinstance(result, Kernels) else (result.ray_centroid, result.ray_covariance)
        centroid, covariance = (moment.detach().double().flatten() for moment in parts)
        errors["sigma_error"] = float((torch.sqrt(covariance[::2]) / truth.sigma - 1).abs().max())
        errors["centroid_error"] = float((centroid - truth.centroid).norm() / truth.sigma.norm())
    return errors


def relative_l1(kernel: Tensor, reference: Tensor) -> float:
    """Σ |k - r| / Σ r."""
    return float((kernel - reference).abs().sum() / reference.sum())


def figure(rows: Sequence[PsfRow]) -> Figure:
    """Time over error of every model at fixed samplings in float64, a panel for each case."""
    panels: dict[str, dict[str, list]] = {}
    for row in sorted(rows, key=attrgetter("rays")):
        if row.dtype == "float64" and row.estimate is None and row.l1_error and row.l1_error > _LEAST:
            lines = panels.setdefault(f"{row.lens}, {row.field:g}", {})
            lines.setdefault(row.model, []).append((row.l1_error, row.forward_s))
    return curves(panels, "relative L1 error of the kernel", "time of one kernel, s")

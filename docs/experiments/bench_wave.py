"""Speed of wave PSFs against their error, of every engine and of the method of Sitzmann et al. (2018).

    python docs/experiments/bench_wave.py --docs docs

One kernel of the comparison of extended depth of field: a PMMA lens of 5 mm for 1 m, 35.5 mm before the sensor, a point
at 0.5 m in blue, where the blur is widest and the wave shortest. Errors are relative L2 norms against converged
kernels. Gradients are with respect to the coefficients of the lens.
"""

import argparse
import dataclasses
import math
import statistics
import sys
import warnings
from collections.abc import Callable, Mapping, Sequence

import bench_kit as kit
import torch
from bench_figures import dtype_keys, framed, look
from bench_kit import Page, Request
from matplotlib.figure import Figure
from pages import digits, listing, measured, yes
from torch import Tensor

from raytrace.bench.measure import clock, name_of, nothing
from raytrace.cli.progress import progress
from raytrace.materials.glass import index
from raytrace.maths.numerics import to
from raytrace.maths.result import number
from raytrace.maths.sampling import grid
from raytrace.plotting import style
from raytrace.psf_models.dft import Aliased, phasor
from raytrace.tracing.scene import Memo
from raytrace.wave_optics import propagation
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import aim, singlet
from raytrace.wave_optics.plan import AliasedSampling
from raytrace.wave_optics.plan import plan as plan_of
from raytrace.wave_optics.scene import WaveScene

WAVELENGTH, DEPTH, PIXEL, SIZE = 0.46, 500.0, 0.00369, 128
#: Samples across and padding of Sitzmann's method: 2 µm over 5 mm, and half as wide again.
SAMPLES, PADDED = 2500, 3744
SITZMANN = "sitzmann"
#: Ratio of times that is the target, at an error of at most so much.
TARGET, ERROR = 100.0, 3e-4

_PUPIL = (96, 128, 160, 256, 512)
_REFUSED = (48, 64)
_RADIAL = ({"samples": 70}, {"samples": 80}, {"tol": 1e-3}, {"tol": 1e-4}, {"tol": 1e-6})
_TRANSFER = (1700, 2500)
_SLOW, _FEW = 0.5, 3  # s: slower calls are repeated so often
_FINEST = {"samples": 130, "nodes": 10}  # radii between steps of the element, and nodes of pixels, of the reference
_OTHER = {"samples": 768, "nodes": 8}  # of the pupil engine that it is compared with
#: By engine: name; of the figure, number of the colour, marker and label.
ENGINES = {
    "pupil": ("pupil matrix DFT", 0, "o", "pupil matrix DFT"),
    "radial": ("ring integrals", 1, "s", "ring integrals"),
    "fresnel": ("Fresnel transfer function, band limit", 4, "D", "Fresnel transfer, band limit"),
    "angular_spectrum": ("angular spectrum, band limit, true spheres", 3, "v", "angular spectrum"),
    SITZMANN: ("Fresnel transfer function as Sitzmann et al. (2018)", 2, "*", "as Sitzmann 2018"),
}


@dataclasses.dataclass(frozen=True)
class WaveRow:
    """A measurement. engine: or SITZMANN; samples: across the aperture; error: relative L2 of the kernel.

    predicted: error that the plan predicts; cold_s: first forward call; forward_s, both_s: median seconds of a step
    that changes heights alone, the second with the gradient; refused: whether the plan refuses this sampling.
    """

    engine: str
    sampling: str
    dtype: str
    samples: int
    error: float
    predicted: float | None
    cold_s: float | None
    forward_s: float
    both_s: float
    refused: bool = False


@dataclasses.dataclass(frozen=True)
class Entrant:
    """An engine at a sampling. prepare() -> run(coefficients) -> kernel, constants computed once; truth: its limit."""

    engine: str
    sampling: str
    dtype: torch.dtype
    samples: int
    prepare: Callable[[], Callable[[Tensor], Tensor]]
    truth: Tensor
    predicted: float | None = None
    refused: bool = False


def bench(request: Request) -> Page:
    """Every engine at several samplings, and the method of Sitzmann et al. (2018), in one thread."""
    chosen, repeats = entrants(), request.arguments.repeats
    with progress(len(chosen) * (1 + repeats), what="measuring") as bar:
        rows = [measure(entrant, repeats=repeats, progress=bar.update) for entrant in chosen]
    difference, goals = agreement(bench_scene()), target(rows)
    document = {"repeats": repeats, "machine": request.about(), "agreement": number(difference)}
    document["targets"] = [dataclasses.asdict(goal) | {"met": goal.met} for goal in goals]
    page = lines(rows, agreement=difference, about=document["machine"], repeats=repeats)
    return Page(rows, page, document, wave_figure, ("wave_bench.md", "wave/speed_vs_error"))


def bench_scene(*, exact: bool = False, size: int = SIZE) -> WaveScene:
    """One depth, one wavelength."""
    number = torch.tensor(1.0, dtype=torch.float64).new_tensor
    return WaveScene(
        elements=singlet(aim(exact=exact)),
        sensor_distance=number(35.5),
        depths=number([DEPTH]),
        wavelengths=number([WAVELENGTH]),
        grid=grid(number(PIXEL), size),
        exact=exact,
    )


def reference(scene: WaveScene) -> Tensor:
    """The converged kernel (rows, columns) by ring integrals."""
    return psf(scene, engine="radial", **_FINEST).kernel[0, 0]


def agreement(scene: WaveScene) -> float:
    """Relative L2 distance of a converged kernel of the pupil engine, another integral, from the reference."""
    return distance(psf(scene, engine="pupil", **_OTHER).kernel[0, 0], reference(scene))


def distance(kernel: Tensor, truth: Tensor) -> float:
    """Relative L2."""
    return float((kernel.double() - truth).norm() / truth.norm())


def entrants(*, size: int = SIZE, sitzmann: int = SAMPLES) -> list[Entrant]:
    """The engines, coarse to fine, and Sitzmann's method with `sitzmann` samples across."""
    scene, exact = bench_scene(size=size), bench_scene(exact=True, size=size)
    truths, double = (reference(scene), reference(exact)), torch.float64
    chosen = []
    for dtype in (double, torch.float32):
        chosen += [entrant(scene, truths[0], dtype, "pupil", samples=n) for n in _PUPIL]
        chosen += [entrant(scene, truths[0], dtype, "radial", **how) for how in _RADIAL]
    chosen += [refused(scene, truths[0], n) for n in _REFUSED]
    chosen += [entrant(scene, truths[0], double, "fresnel", samples=n) for n in _TRANSFER]
    chosen += [entrant(exact, truths[1], double, "angular_spectrum", samples=n) for n in _TRANSFER]
    return chosen + [sitzmann_method(scene, dtype, samples=sitzmann) for dtype in (double, torch.float32)]


def measure(entrant: Entrant, *, repeats: int, progress: Callable[[int], object] = nothing) -> WaveRow:
    """Error, and median processor times of warm calls; progress: of 1 + repeats."""
    now, coefficients, forward, both = clock(1), coefficients_of(entrant.dtype), [], []
    start = now()
    run = entrant.prepare()
    with torch.no_grad():
        kernel = run(coefficients)
    cold = now() - start
    progress(1)
    for turn in range(repeats):
        progress(1)
        if turn >= _FEW and statistics.median(both) > _SLOW:
            continue
        start = now()
        with torch.no_grad():
            run(coefficients)
        forward.append(now() - start)
        start = now()
        gradient(run, coefficients)
        both.append(now() - start)
    names = ("engine", "sampling", "samples", "predicted", "refused")
    times = {"cold_s": cold, "forward_s": statistics.median(forward), "both_s": statistics.median(both)}
    error = distance(kernel, entrant.truth)
    return WaveRow(dtype=name_of(entrant.dtype), error=error, **{n: vars(entrant)[n] for n in names}, **times)


def gradient(run: Callable[[Tensor], Tensor], coefficients: Tensor) -> Tensor:
    """Of a weighted sum of the kernel, with respect to the coefficients of the lens."""
    free = coefficients.detach().clone().requires_grad_()
    kernel = run(free)
    pattern = torch.cos(torch.arange(kernel.numel(), dtype=kernel.dtype)).reshape(kernel.shape)
    return torch.autograd.grad((kernel * pattern).sum(), free)[0]


# -- the engines -------------------------------------------------------------------------------------------------------


def entrant(scene: WaveScene, truth: Tensor, dtype: torch.dtype, engine: str, **sampling) -> Entrant:
    """An engine at a sampling that its plan allows."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Aliased)
        chosen = plan_of(scene, engine=engine, **sampling)
    padded = "" if engine == "pupil" else f", padded {chosen.pad:g}×"
    words = f"{chosen.samples} radii" if engine == "radial" else f"{chosen.samples}²{padded}"
    return Entrant(engine, words, dtype, chosen.samples, _prepared(scene, chosen, dtype), truth, chosen.error)


def refused(scene: WaveScene, truth: Tensor, samples: int) -> Entrant:
    """A sampling that the plan refuses: copies of the image alias into the window."""
    try:
        plan_of(scene, engine="pupil", samples=samples)
    except AliasedSampling:
        chosen = dataclasses.replace(plan_of(scene, engine="pupil", samples=128), samples=samples, error=math.nan)
        run = _prepared(scene, chosen, torch.float64)
        return Entrant("pupil", f"{samples}²", torch.float64, samples, run, truth, refused=True)
    raise ValueError(f"{samples} samples are not refused; expected a sampling that aliases")


def _prepared(scene: WaveScene, chosen, dtype: torch.dtype) -> Callable[[], Callable[[Tensor], Tensor]]:
    """The memo keeps all that the coefficients do not change."""
    scene = to(scene, dtype=dtype)
    (element,) = scene.elements

    def prepare():
        memo = Memo()

        def run(free: Tensor) -> Tensor:
            # True spheres have further coefficients than that of r²: they stay.
            coefficients = torch.cat([free, element.profile.coefficients[len(free) :]])
            profile = dataclasses.replace(element.profile, coefficients=coefficients)
            changed = dataclasses.replace(scene, elements=(dataclasses.replace(element, profile=profile),))
            return psf(changed, plan=chosen, memo=memo).kernel[0, 0]

        return run

    return prepare


def coefficients_of(dtype: torch.dtype) -> Tensor:
    """The coefficient of r² that all start from, (1,)."""
    return bench_scene().elements[0].profile.coefficients[:1].to(dtype)


def sitzmann_method(scene: WaveScene, dtype: torch.dtype, *, samples: int = SAMPLES) -> Entrant:
    """The field on a grid of 2 µm propagated by Fresnel's transfer function, padded to 1.5 times, without a band limit.

    As the published code does (Sitzmann et al., ACM Trans. Graph. 37, 114, 2018): a hard aperture, heights on the grid,
    phases in float64 before the field is rounded, kernels sampled at the points of the grid. The limit is the intensity
    of the converged field at these points; sphere and transfer function are computed once.
    """
    padded = PADDED * samples // SAMPLES
    padded += (padded - samples) % 2
    pitch = 5.0 / samples
    x = (torch.arange(samples, dtype=torch.float64) - 0.5 * (samples - 1)) * pitch
    side = int(PIXEL * scene.grid.rows / 2 / pitch)
    seen = slice(samples // 2 - side, samples - samples // 2 + side)
    r = torch.sqrt(x[seen] ** 2 + x[seen, None] ** 2)
    distances, place = torch.unique(r, return_inverse=True)
    waves = propagation.radial_field(scene, distances, _FINEST["samples"])[0, 0]
    truth = (waves.real**2 + waves.imag**2)[place] * pitch**2

    def prepare():
        wavelength, z = 1e-3 * WAVELENGTH, float(scene.sensor_distance)
        r2 = x * x + (x * x)[:, None]
        inside = (r2 <= 2.5**2).to(dtype)
        sphere = 0.5 * r2 / DEPTH / wavelength
        bend = r2 * ((float(index(scene.elements[0].glass, WAVELENGTH)) - 1) / wavelength)
        scale = pitch / math.sqrt(math.pi * 2.5**2)
        f = torch.fft.fftfreq(padded, pitch, dtype=torch.float64)
        H = phasor(-0.5 * wavelength * z * (f * f + (f * f)[:, None]))
        H = H.to(torch.complex128 if dtype == torch.float64 else torch.complex64)
        margin = (padded - len(x)) // 2
        crop = slice(margin + seen.start, margin + seen.stop)

        def run(coefficients: Tensor) -> Tensor:
            phase = phasor(sphere + coefficients[0].double() * bend).to(H.dtype)
            field = torch.nn.functional.pad(scale * inside * phase, (margin,) * 4)
            U = torch.fft.ifft2(torch.fft.fft2(field) * H)[crop, crop]
            return U.real**2 + U.imag**2

        return run

    words = f"{samples}² at {1e3 * pitch:g} µm, padded to {padded}²"
    return Entrant(SITZMANN, words, dtype, samples, prepare, truth)


# -- the page ----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Target:
    """The fastest run of an engine within ERROR, the fastest of Sitzmann's method, and the ratios of their times."""

    best: WaveRow
    opponent: WaveRow
    forward: float
    both: float
    cold: float

    @property
    def met(self) -> bool:
        return min(self.forward, self.both) >= TARGET


def target(rows: Sequence[WaveRow]) -> list[Target]:
    """For each engine that comes within ERROR, the fastest first."""
    opponent = min((row for row in rows if row.engine == SITZMANN), key=lambda row: row.both_s)
    goals = []
    for engine in dict.fromkeys(row.engine for row in rows if row.engine != SITZMANN):
        close = [row for row in rows if row.engine == engine and row.error <= ERROR and not row.refused]
        if close:
            best = min(close, key=lambda row: row.both_s)
            ratios = opponent.forward_s / best.forward_s, opponent.both_s / best.both_s
            goals.append(Target(best, opponent, *ratios, opponent.forward_s / best.cold_s))
    return sorted(goals, key=lambda goal: -goal.both)


def lines(rows: Sequence[WaveRow], *, agreement: float, about: Mapping[str, str | int], repeats: int) -> list[str]:
    """The page."""
    columns = {
        name: (lambda row, form=form: f"*{form(row)}*" if row.refused else form(row)) for name, form in _ROWS.items()
    }
    goals, others = target(rows), [row for row in rows if row.engine == SITZMANN or row.refused]
    faster = (f"{ENGINES[goal.best.engine][0]} {goal.both:.0f} times" for goal in goals if goal.met)
    return [
        "# Waves behind a phase element: speed against error",
        "",
        f"Faster than the method of Sitzmann et al. (2018) at an error of at most {ERROR:g}, forward and gradient: "
        f"{', '.join(faster) or 'none'}.",
        "",
        "    python docs/experiments/bench_wave.py --docs docs",
        "",
        f"One kernel: a PMMA lens of 5 mm designed for 1 m, 35.5 mm before the sensor; point at {DEPTH / 1e3:g} m, "
        f"{1e3 * WAVELENGTH:g} nm, {SIZE} × {SIZE} pixels of {1e3 * PIXEL:g} µm, integrated over them. Error: relative "
        "L² of the kernel against converged ring integrals, from which a converged matrix DFT differs by "
        f"{agreement:.1e}. Times are of a step that changes heights alone, as in learning: *forward*, and *with "
        "gradient* with respect to the coefficients of the lens.",
        "",
        "![Time over error of the engines](wave/speed_vs_error.png)",
        "",
        f"The fastest sampling of each engine within this error, relative to the fastest run of their method; target "
        f"{TARGET:g} ×:",
        "",
        *listing(_GOALS, goals),
        "",
        *listing(columns, [*(goal.best for goal in goals), *others]),
        "",
        "Rows in italics are refused by `plan` (`AliasedSampling`) and forced here. *Predicted*: by `plan`. *First*: "
        "first forward call.",
        "",
        measured(f"up to {repeats} calls", about) + ". All samplings: [speed_vs_error.csv](wave/speed_vs_error.csv).",
    ]


def _ratio(value: float) -> str:
    return f"{value:.0f} ×" if value >= 10 else f"{value:.2g} ×"


def _error(value: float | None) -> str:
    return digits(value, ".1e" if value is not None and value < 1 else ".1f", "–")


_GOALS = {
    "engine": lambda goal: ENGINES[goal.best.engine][0],
    "sampling": lambda goal: f"{goal.best.sampling}, {goal.best.dtype}",
    "error": lambda goal: f"{goal.best.error:.1e}",
    "forward": lambda goal: _ratio(goal.forward),
    "with gradient": lambda goal: _ratio(goal.both),
    "met": lambda goal: yes(goal.met),
}
_ROWS = {
    "engine": lambda row: ENGINES[row.engine][0],
    "sampling": lambda row: row.sampling,
    "dtype": lambda row: row.dtype,
    "error": lambda row: _error(row.error),
    "predicted": lambda row: _error(row.predicted),
    "forward, ms": lambda row: f"{1e3 * row.forward_s:.3g}",
    "with gradient, ms": lambda row: f"{1e3 * row.both_s:.3g}",
    "first, ms": lambda row: f"{1e3 * row.cold_s:.3g}",
}


@style.styled
def wave_figure(rows: Sequence[Mapping]) -> Figure:
    """Time over error, forward and with the gradient: full marks float64, open ones float32, crosses refused."""
    figure = style.new_figure(7.6, 3.6)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for panel, key, title in zip(panels, ("forward_s", "both_s"), ("forward", "forward and gradient"), strict=True):
        lines: dict[tuple, list] = {}
        for row in rows:
            lines.setdefault((row["engine"], row["dtype"], row["refused"]), []).append((row["error"], 1e3 * row[key]))
        crosses = [point for (*_, is_refused), points in lines.items() if is_refused for point in points]
        for engine, (_, colour, marker, label) in ENGINES.items():
            for dtype, dashes in (("float64", "-"), ("float32", ":")):
                points = lines.get((engine, dtype, False), [(math.nan, math.nan)])
                marks = look(colour, dashes, marker, hollow=dtype == "float32") | {"linewidth": 0.9}
                panel.plot(*zip(*points, strict=True), label=label if dtype == "float64" else None, **marks)
        crosses = crosses or [(math.nan, math.nan)]
        panel.plot(*zip(*crosses, strict=True), "x", color=style.field_colour(7), label="refused by the plan")
        framed(panel, title, "relative L² error of the kernel")
    panels[0].set_ylabel("time of one kernel, ms")
    handles = [*panels[0].get_legend_handles_labels()[0], *dtype_keys()]
    figure.legend(handles=handles, loc="outside lower center", ncols=4)
    return figure


def options(parser: argparse.ArgumentParser) -> None:
    kit.shared(parser, "wave_bench.md and wave/")


def main(argv: Sequence[str] | None = None) -> None:
    kit.run(bench, options, argv, peers=False)


if __name__ == "__main__":
    sys.exit(main())

"""Speed of PSFs of waves beside their error, of every engine and of the method of Sitzmann et al. (2018).

The scene is one kernel of the comparison of extended depth of field: a PMMA lens of 5 mm for 1 m, 35.5 mm before the
sensor, and a point at 0.5 m in blue, where the blur is widest and the wave shortest. Errors are relative L2 norms
against converged kernels. Gradients are those of the lens's own coefficients, for everyone.
"""

import dataclasses
import math
import statistics
import warnings
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from raytrace.bench.measure import clock, name_of, nothing
from raytrace.bench.report import Asked, Measured, digits, table, yes
from raytrace.cli.progress import progress
from raytrace.materials.glass import index
from raytrace.maths.grid import grid
from raytrace.maths.result import number
from raytrace.maths.value import to
from raytrace.pages import measured
from raytrace.psf_models.dft import Aliased, phasor
from raytrace.shards import torch_threads
from raytrace.tracing.scene import Memo
from raytrace.wave_optics import propagation
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import aim, singlet
from raytrace.wave_optics.plan import AliasedSampling
from raytrace.wave_optics.plan import plan as plan_of
from raytrace.wave_optics.scene import WaveScene

WAVELENGTH, DEPTH, PIXEL, SIZE = 0.46, 500.0, 0.00369, 128
#: Samples across and padding of Sitzmann's method: 2 µm over 5 mm, half as wide again.
SAMPLES, PADDED = 2500, 3744
SITZMANN = "sitzmann"
#: What the opponent is to be beaten by, at an error of at most so much.
TARGET, ERROR = 100.0, 3e-4

_PUPIL = (96, 128, 160, 256, 512)
_REFUSED = (48, 64)
_RADIAL = ({"samples": 70}, {"samples": 80}, {"tol": 1e-3}, {"tol": 1e-4}, {"tol": 1e-6})
_TRANSFER = (1700, 2500)
_SLOW, _FEW = 0.5, 3  # s: what takes longer is repeated so often
_FINEST = {"samples": 130, "nodes": 10}  # radii between steps of the element, and nodes of pixels, of the limit
_OTHER = {"samples": 768, "nodes": 8}  # of the pupil engine beside it
_NAMES = {
    "pupil": "pupil matrix DFT",
    "radial": "ring integrals",
    "fresnel": "Fresnel transfer function, band limit",
    "angular_spectrum": "angular spectrum, band limit, true spheres",
    SITZMANN: "Fresnel transfer function as Sitzmann et al. (2018)",
}


@dataclasses.dataclass(frozen=True)
class WaveRow:
    """One figure. engine: or SITZMANN; sampling: in words; samples: across the aperture; error: relative L2 of
    the kernel.

    predicted: that of the plan; cold_s: forward with nothing kept from before; forward_s, both_s: median seconds of a
    step that changes heights alone, the second with the gradient. refused: the plan does not allow this sampling.
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
    """Who is measured. prepare() -> run(coefficients) -> kernel, the constants made once; truth: its limit."""

    engine: str
    sampling: str
    dtype: torch.dtype
    samples: int
    prepare: Callable[[], Callable[[Tensor], Tensor]]
    truth: Tensor
    predicted: float | None = None
    refused: bool = False


def bench(asked: Asked) -> Measured:
    """Every engine at several samplings beside the method of Sitzmann et al. (2018), in one thread."""
    found, repeats = entrants(), asked.arguments.repeats
    with progress(len(found) * (1 + repeats), what="measuring") as bar:
        rows = [measure(entrant, repeats=repeats, progress=bar.update) for entrant in found]
    apart, goals = agreement(bench_scene()), target(rows)
    document = {"repeats": repeats, "machine": asked.about(), "agreement": number(apart)}
    document["targets"] = [dataclasses.asdict(one) | {"met": one.met} for one in goals]
    page = lines(rows, agreement=apart, about=document["machine"], repeats=repeats)
    return Measured(rows, page, document, ("wave_figure",), ("wave_bench.md", "wave/speed_vs_error"))


def bench_scene(*, exact: bool = False, size: int = SIZE) -> WaveScene:
    """The scene: one depth, one wavelength."""
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
    """The converged kernel (rows, columns), of ring integrals."""
    return psf(scene, engine="radial", **_FINEST).kernel[0, 0]


def agreement(scene: WaveScene) -> float:
    """Relative L2 distance of that from a converged kernel of the pupil engine: two rules, two integrals."""
    return distance(psf(scene, engine="pupil", **_OTHER).kernel[0, 0], reference(scene))


def distance(kernel: Tensor, truth: Tensor) -> float:
    """Relative L2."""
    return float((kernel.double() - truth).norm() / truth.norm())


def entrants(*, size: int = SIZE, sitzmann: int = SAMPLES) -> list[Entrant]:
    """Everyone: the engines, coarse to fine, and Sitzmann's method, with `sitzmann` samples across."""
    scene, exact = bench_scene(size=size), bench_scene(exact=True, size=size)
    truths, double = (reference(scene), reference(exact)), torch.float64
    found = []
    for dtype in (double, torch.float32):
        found += [entrant(scene, truths[0], dtype, "pupil", samples=n) for n in _PUPIL]
        found += [entrant(scene, truths[0], dtype, "radial", **how) for how in _RADIAL]
    found += [refused(scene, truths[0], n) for n in _REFUSED]
    found += [entrant(scene, truths[0], double, "fresnel", samples=n) for n in _TRANSFER]
    found += [entrant(exact, truths[1], double, "angular_spectrum", samples=n) for n in _TRANSFER]
    return found + [sitzmann_method(scene, dtype, samples=sitzmann) for dtype in (double, torch.float32)]


def measure(entrant: Entrant, *, repeats: int, progress: Callable[[int], object] = nothing) -> WaveRow:
    """Error, and median processor times of warm calls in one thread; progress: of 1 + repeats."""
    now, start, forward, both = clock(1), coefficients_of(entrant.dtype), [], []
    with torch_threads(1):
        began = now()
        run = entrant.prepare()
        with torch.no_grad():
            kernel = run(start)
        cold = now() - began
        progress(1)
        for turn in range(repeats):
            progress(1)
            if turn >= _FEW and statistics.median(both) > _SLOW:
                continue
            began = now()
            with torch.no_grad():
                run(start)
            forward.append(now() - began)
            began = now()
            gradient(run, start)
            both.append(now() - began)
    return WaveRow(
        engine=entrant.engine,
        sampling=entrant.sampling,
        dtype=name_of(entrant.dtype),
        samples=entrant.samples,
        error=distance(kernel, entrant.truth),
        predicted=entrant.predicted,
        cold_s=cold,
        forward_s=statistics.median(forward),
        both_s=statistics.median(both),
        refused=entrant.refused,
    )


def gradient(run: Callable[[Tensor], Tensor], coefficients: Tensor) -> Tensor:
    """Of a number made of the kernel, by the coefficients of the lens."""
    free = coefficients.detach().clone().requires_grad_()
    kernel = run(free)
    pattern = torch.cos(torch.arange(kernel.numel(), dtype=kernel.dtype)).reshape(kernel.shape)
    (found,) = torch.autograd.grad((kernel * pattern).sum(), free)
    return found


# -- the engines -------------------------------------------------------------------------------------------------------


def entrant(scene: WaveScene, truth: Tensor, dtype: torch.dtype, engine: str, **sampling) -> Entrant:
    """An engine at a sampling, as its plan allows it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Aliased)
        chosen = plan_of(scene, engine=engine, **sampling)
    padded = "" if engine == "pupil" else f", padded {chosen.pad:g}×"
    words = f"{chosen.samples} radii" if engine == "radial" else f"{chosen.samples}²{padded}"
    return Entrant(engine, words, dtype, chosen.samples, _prepared(scene, chosen, dtype), truth, chosen.error)


def refused(scene: WaveScene, truth: Tensor, samples: int) -> Entrant:
    """What the plan refuses: copies of the image inside the window."""
    try:
        plan_of(scene, engine="pupil", samples=samples)
    except AliasedSampling:
        chosen = dataclasses.replace(plan_of(scene, engine="pupil", samples=128), samples=samples, error=math.nan)
        run = _prepared(scene, chosen, torch.float64)
        return Entrant("pupil", f"{samples}²", torch.float64, samples, run, truth, refused=True)
    raise ValueError(f"{samples} samples are not refused: the bench shows here what must be")


def _prepared(scene: WaveScene, chosen, dtype: torch.dtype) -> Callable[[], Callable[[Tensor], Tensor]]:
    """What the coefficients do not change is kept from the first call on."""
    scene = to(scene, dtype=dtype)

    def prepare():
        memo = Memo()
        return lambda free: psf(_with(scene, free), plan=chosen, memo=memo).kernel[0, 0]

    return prepare


def _with(scene: WaveScene, coefficients: Tensor) -> WaveScene:
    (element,) = scene.elements
    # Of true spheres there are more coefficients than that of r²: they stay.
    rest = element.profile.coefficients[len(coefficients) :]
    profile = dataclasses.replace(element.profile, coefficients=torch.cat([coefficients, rest]))
    return dataclasses.replace(scene, elements=(dataclasses.replace(element, profile=profile),))


def coefficients_of(dtype: torch.dtype) -> Tensor:
    """The coefficient of r² that every entrant starts from, (1,)."""
    return bench_scene().elements[0].profile.coefficients[:1].to(dtype)


def sitzmann_method(scene: WaveScene, dtype: torch.dtype, *, samples: int = SAMPLES) -> Entrant:
    """The field on a grid of 2 µm carried on by Fresnel's transfer function, padded to 1.5 times, without a band limit.

    As the published code does (Sitzmann et al., ACM Trans. Graph. 37, 114, 2018): a hard aperture, heights
    on the grid, phases in float64 before the field is rounded, kernels sampled at the grid's own points. It is judged
    there, against intensities of the converged field at those points; sphere and transfer function are made once.
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
        return _transfer_run(scene, dtype, x, pitch, padded, seen)

    words = f"{samples}² at {1e3 * pitch:g} µm, padded to {padded}²"
    return Entrant(SITZMANN, words, dtype, samples, prepare, truth)


def _transfer_run(
    scene: WaveScene, dtype: torch.dtype, x: Tensor, pitch: float, padded: int, seen: slice
) -> Callable[[Tensor], Tensor]:
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


# -- what was found ----------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Target:
    """The fastest engine within ERROR against Sitzmann's method of the same or the faster dtype: ratios of times."""

    best: WaveRow
    opponent: WaveRow
    forward: float
    both: float
    cold: float

    @property
    def met(self) -> bool:
        return min(self.forward, self.both) >= TARGET


def target(rows: Sequence[WaveRow]) -> list[Target]:
    """One for each engine that comes within ERROR, the fastest first, against the fastest run of Sitzmann's method."""
    opponent = min((row for row in rows if row.engine == SITZMANN), key=lambda row: row.both_s)
    found = []
    for engine in dict.fromkeys(row.engine for row in rows if row.engine != SITZMANN):
        own = [row for row in rows if row.engine == engine and row.error <= ERROR and not row.refused]
        if own:
            best = min(own, key=lambda row: row.both_s)
            ratios = opponent.forward_s / best.forward_s, opponent.both_s / best.both_s
            found.append(Target(best, opponent, *ratios, opponent.forward_s / best.cold_s))
    return sorted(found, key=lambda one: -one.both)


def lines(rows: Sequence[WaveRow], *, agreement: float, about: Mapping[str, str | int], repeats: int) -> list[str]:
    """The page."""
    return [
        "# Waves behind a phase element: speed beside error",
        "",
        "    raytrace bench wave --docs docs",
        "",
        f"One kernel: a PMMA lens of 5 mm made for 1 m, 35.5 mm before the sensor, a point at {DEPTH / 1e3:g} m in "
        f"{1e3 * WAVELENGTH:g} nm, {SIZE} × {SIZE} pixels of {1e3 * PIXEL:g} µm, integrated over them. Error: relative "
        "L² of the kernel against converged ring integrals, from which a converged matrix DFT differs by "
        f"{agreement:.1e}. Times are of a step that changes heights alone, as in learning: *forward*, and *with "
        "gradient* by the coefficients of the lens; *first* is a forward call that nothing is kept from.",
        "",
        "![Time over error of the engines](wave/speed_vs_error.png)",
        "",
        f"Target: {TARGET:g} × less time than their method at an error of at most {ERROR:g}. The fastest sampling "
        "of each engine that comes so close, beside the fastest run of their method:",
        "",
        *table(_GOALS, target(rows)),
        "",
        *table({name: _in_italics(form) for name, form in _ROWS.items()}, rows),
        "",
        "Rows in italics are refused by `plan` (`AliasedSampling`) and forced here. *Predicted* is what `plan` says of "
        "the error.",
        "",
        measured(f"up to {repeats} calls", about) + ". All figures: [speed_vs_error.csv](wave/speed_vs_error.csv).",
    ]


def _ratio(value: float) -> str:
    return f"{value:.0f} ×" if value >= 10 else f"{value:.2g} ×"


def _error(value: float | None) -> str:
    return digits(value, ".1e" if value is not None and value < 1 else ".1f", "–")


def _in_italics(form: Callable[[WaveRow], str]) -> Callable[[WaveRow], str]:
    return lambda row: f"*{form(row)}*" if row.refused else form(row)


_GOALS = {
    "engine": lambda one: _NAMES[one.best.engine],
    "sampling": lambda one: f"{one.best.sampling}, {one.best.dtype}",
    "error": lambda one: f"{one.best.error:.1e}",
    "forward": lambda one: _ratio(one.forward),
    "with gradient": lambda one: _ratio(one.both),
    "met": lambda one: yes(one.met),
}
_ROWS = {
    "engine": lambda row: _NAMES[row.engine],
    "sampling": lambda row: row.sampling,
    "dtype": lambda row: row.dtype,
    "error": lambda row: _error(row.error),
    "predicted": lambda row: _error(row.predicted),
    "forward, ms": lambda row: f"{1e3 * row.forward_s:.3g}",
    "with gradient, ms": lambda row: f"{1e3 * row.both_s:.3g}",
    "first, ms": lambda row: f"{1e3 * row.cold_s:.3g}",
}

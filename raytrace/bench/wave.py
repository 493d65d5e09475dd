"""Measure PSFs of waves: time forward and forward + backward beside the error, of every engine and Sitzmann's method.

The scene is one kernel of the comparison of extended depth of field: a PMMA lens of 5 mm for 1 m, 35.5 mm before the
sensor, and a point at 0.5 m in blue, where the blur is widest and the wave shortest. Errors are relative L2 norms
against converged kernels. Gradients are those of the lens's own coefficients, for everyone.
"""

import dataclasses
import math
import statistics
import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.bench.measure import clock
from raytrace.kernels.dft import Aliased, phasor
from raytrace.maths.grid import grid
from raytrace.maths.value import to
from raytrace.media.glass import index
from raytrace.optics.reuse import Memo
from raytrace.wave import radial
from raytrace.wave.designs import aim, singlet
from raytrace.wave.plan import AliasedSampling
from raytrace.wave.plan import plan as plan_of
from raytrace.wave.psf import psf
from raytrace.wave.scene import WaveScene

WAVELENGTH, DEPTH, PIXEL, SIZE = 0.46, 500.0, 0.00369, 128
#: Samples across and padding of Sitzmann's method: 2 µm over 5 mm, half as wide again.
SAMPLES, PITCH, PADDED = 2500, 2e-3, 3744
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
    limit = reference(scene)
    other = psf(scene, engine="pupil", **_OTHER).kernel[0, 0]
    return float((other - limit).norm() / limit.norm())


def entrants(*, size: int = SIZE, sitzmann: int = SAMPLES) -> list[Entrant]:
    """Everyone: the engines, coarse to fine, and Sitzmann's method, with `sitzmann` samples across."""
    scene, exact = bench_scene(size=size), bench_scene(exact=True, size=size)
    truths = reference(scene), reference(exact)
    found = []
    for dtype in (torch.float64, torch.float32):
        found += [_entrant(scene, truths[0], dtype, "pupil", samples=n) for n in _PUPIL]
        found += [_entrant(scene, truths[0], dtype, "radial", **how) for how in _RADIAL]
    double = torch.float64
    found += [_coarse(scene, truths[0], n) for n in _REFUSED]
    found += [_entrant(scene, truths[0], double, "fresnel", samples=n) for n in _TRANSFER]
    found += [_entrant(exact, truths[1], double, "angular_spectrum", samples=n) for n in _TRANSFER]
    return found + [sitzmann_method(scene, dtype, samples=sitzmann) for dtype in (torch.float64, torch.float32)]


def measure(
    found: Sequence[Entrant], *, repeats: int, progress: Callable[[int], object] = lambda done: None
) -> list[WaveRow]:
    """Everyone in turns, in one thread: processor time. progress: of len(found) · (1 + repeats)."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        rows = []
        for entrant in found:
            rows.append(measure_one(entrant, repeats=repeats, progress=progress))
        return rows
    finally:
        torch.set_num_threads(before)


def measure_one(entrant: Entrant, *, repeats: int, progress: Callable[[int], object] = lambda done: None) -> WaveRow:
    """Error, and median times of warm calls."""
    now = clock(1)
    start = _coefficients(entrant.dtype)
    began = now()
    run = entrant.prepare()
    with torch.no_grad():
        kernel = run(start).double()
    cold = now() - began
    error = float((kernel - entrant.truth).norm() / entrant.truth.norm())
    progress(1)
    forward, both = [], []
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
        dtype=str(entrant.dtype).removeprefix("torch."),
        samples=entrant.samples,
        error=error,
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


def _entrant(scene: WaveScene, truth: Tensor, dtype: torch.dtype, engine: str, **sampling) -> Entrant:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Aliased)
        chosen = plan_of(scene, engine=engine, **sampling)
    if engine == "radial":
        words = f"{chosen.samples} radii"
    else:
        words = f"{chosen.samples}²" + (f", padded {chosen.pad:g}×" if engine != "pupil" else "")
    return Entrant(engine, words, dtype, chosen.samples, _prepared(scene, chosen, dtype), truth, chosen.error)


def _coarse(scene: WaveScene, truth: Tensor, samples: int) -> Entrant:
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


def _coefficients(dtype: torch.dtype) -> Tensor:
    return bench_scene().elements[0].profile.coefficients[:1].to(dtype)


# -- Sitzmann's method -------------------------------------------------------------------------------------------------


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
    waves = radial.field(scene, distances, _FINEST["samples"])[0, 0]
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

"""Speeds of the trace and ratios to peers, for `bench_speed.py`: batches, with gradient, aspheres, the sensor step.

Every ratio is of medians of calls in turns, so that other load of the machine affects all alike.
"""

import dataclasses
import itertools
import math
import statistics
from collections.abc import Callable, Mapping, Sequence

import torch
from bench_kit import Request, clock_of, in_words
from bench_reference import COLUMNS, errors_of
from pages import listing
from torch import Tensor

from raytrace.bench.measure import (
    DTYPES,
    SAMPLE,
    Row,
    Tracer,
    clock,
    field_rays,
    measured_rows,
    name_of,
    nothing,
    squared_radius,
    variables,
    with_leaves,
)
from raytrace.io import read_lens
from raytrace.maths.numerics import to
from raytrace.maths.result import plain
from raytrace.maths.sampling import sobol
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens, media, with_object_distance
from raytrace.system.prescription import lens as lens_of
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.compiled import prepare, trace_engine
from raytrace.tracing.focus import spot_parabola
from raytrace.tracing.launch import rays_of_field
from raytrace.tracing.scene import Memo, trace_bundle
from raytrace.tracing.trace import trace_lens

_PIECE = 2**16
_PIECES = (_PIECE, 2**18)  # rays at a time that tracers are tried with, and all at once
_LARGEST_GRAPH = {"eager": 2**18, "Optiland": 3 * _PIECE}  # rays of a graph
_MANY = 100  # steps timed together that take microseconds


@dataclasses.dataclass(frozen=True)
class Sizes:
    """rays: of the ratios; counts: of the figure; small: of the small batch; sensor: for each of `distances`."""

    rays: int = 2**20
    counts: tuple[int, ...] = (2**8, 2**10, 2**12, 2**14, 2**16, 2**18, 2**20)
    small: int = 328
    sensor: int = 2**20
    distances: int = 41


QUICK = Sizes(2**16, (2**8, 2**12, 2**16), sensor=2**14, distances=5)


@dataclasses.dataclass(frozen=True)
class Bench:
    """Measurements of one dtype. peers: of the double Gauss and of the aspheres."""

    dtype: torch.dtype
    sizes: Sizes
    repeats: int
    threads: int
    peers: Sequence[Tracer] = ()
    asphere_peers: Sequence[Tracer] = ()

    def rows(
        self, what: str, lens: Lens, count: int, tasks: Sequence[tuple[Tracer, str]], *, gradient: bool = False
    ) -> list[Row]:
        """Rows of tasks, a tracer and "forward" or "backward" each, with errors of `SAMPLE` rays.

        Those of this package in a batch as large as the timed one (with a graph, at most 2¹⁶). gradient: whether
        gradients are compared.
        """
        copies, sample = max(1, min(count, _PIECE) // SAMPLE), field_rays(lens, SAMPLE)
        errors = {
            tracer: errors_of(
                tracer, lens, sample, copies=copies if isinstance(tracer, EngineTracer) else 1, gradient=gradient
            )
            for tracer, _ in tasks
        }
        graphs = lambda tracer: _LARGEST_GRAPH.get(prepare() if isinstance(tracer, EngineTracer) else "Optiland")  # noqa: E731
        how = {"sizes": _PIECES, "graphs": graphs, "repeats": self.repeats, "threads": self.threads}
        rows = measured_rows([(tracer, work, errors[tracer]) for tracer, work in tasks], lens, count, **how)
        return [dataclasses.replace(row, dtype=name_of(self.dtype), what=what) for row in rows]


def benches_of(request: Request, sizes: Sizes) -> list[Bench]:
    """A bench for each dtype, with the peers."""
    lenses, peers, how = (double_gauss(), three_aspheres()), request.peers, (request.arguments.repeats, request.threads)
    rivals = {dtype: [peers.rivals(lens, dtype) for lens in lenses] if peers else [] for dtype in DTYPES}
    return [Bench(dtype, sizes, *how, *rivals[dtype]) for dtype in DTYPES]


def measure(benches: Sequence[Bench], *, progress: Callable[[int], object] = nothing) -> tuple[list, dict]:
    """Rows, and the ratios of each dtype by name. progress: called with 1 for each of STAGES and benches."""
    rows: list[Row] = []
    ratios: dict[str, dict[str, float | None]] = {}
    prepare()
    for bench, stage in itertools.product(benches, STAGES):
        more, values = stage(bench)
        rows += more
        ratios[name_of(bench.dtype)] = ratios.get(name_of(bench.dtype), {}) | values
        progress(1)
    return rows, ratios


# -- stages: rows and ratios -------------------------------------------------------------------------------------------


def _forward(bench: Bench) -> tuple[list[Row], dict]:
    """Without the optical path, which Optiland always computes."""
    lens, sizes, rows = double_gauss(), bench.sizes, []
    tracers = [*_own(lens, bench.dtype), *bench.peers]
    for count in sorted({*sizes.counts, sizes.rays}):
        chosen = [tracer for tracer in tracers if count <= getattr(tracer, "most", math.inf)]
        rows += bench.rows("forward", lens, count, [(tracer, "forward") for tracer in chosen])
    last = [row for row in rows if row.rays == sizes.rays]
    return rows, {"forward_over_optiland": over(last, "Optiland"), "forward_s": last[0].seconds}


def _backward(bench: Bench) -> tuple[list[Row], dict]:
    """Forward + backward to every curvature, thickness and index; in turns with the forward trace of this package."""
    lens = double_gauss()
    tracers = [_own(lens, bench.dtype)[0], *(peer for peer in bench.peers if peer.has_gradient)]
    tasks = [(tracers[0], "forward"), *((tracer, "backward") for tracer in tracers)]
    forward, *rows = bench.rows("backward", lens, bench.sizes.rays, tasks, gradient=True)
    ratio = rows[0].seconds / forward.seconds
    return rows, {"backward_over_forward": ratio, "backward_over_optiland": over(rows, "Optiland")}


def _small(bench: Bench) -> tuple[list[Row], dict]:
    """A few hundred rays, forward + backward, as in co-design."""
    lens = double_gauss()
    tracers = [*_own(lens, bench.dtype), *(peer for peer in bench.peers if peer.has_gradient)]
    rows = bench.rows("backward", lens, bench.sizes.small, [(tracer, "backward") for tracer in tracers])
    return rows, {"small_batch_ms": 1e3 * rows[0].seconds, "small_batch_over_optiland": over(rows, "Optiland")}


def _asphere(bench: Bench) -> tuple[list[Row], dict]:
    """The three aspheres, forward."""
    lens = three_aspheres()
    tracers = [*_own(lens, bench.dtype), *bench.asphere_peers]
    rows = bench.rows("asphere", lens, bench.sizes.rays, [(tracer, "forward") for tracer in tracers])
    return rows, {"asphere_over_optiland": over(rows, "Optiland")}


def _sensor(bench: Bench) -> tuple[list[Row], dict]:
    """A step of optimising the sensor distance over many object distances: from parabolas, with a `Memo`, retraced.

    Gains: time of tracing launched rays anew relative to the step from the spots' parabolas (`focus.spot_parabola`),
    and to a step that carries every ray of a memo to the sensor.
    """
    lens, leaf = with_sensor_leaf(to(double_gauss(), dtype=bench.dtype))
    distances = torch.linspace(10e3, 50e3, bench.sizes.distances, dtype=torch.float64).tolist()
    pupil = sobol(bench.sizes.sensor)[0].to(bench.dtype)
    field = torch.stack([lens.fields.x, lens.fields.y])[:, len(lens.fields.x) // 2, None]
    bundles = [(with_object_distance(lens, distance), field, lens.wavelengths[0], pupil) for distance in distances]
    memo, times, now = Memo(), [], clock(bench.threads)
    parabolas = []
    for bundle in bundles:
        end = trace_bundle(bundle, memo)  # fills the memo
        slope(end, leaf)
        parabolas.append(torch.stack(spot_parabola(detached(end))))
    parabolas = torch.stack(parabolas, -1)
    with torch_threads(bench.threads):
        for _ in range(max(1, min(bench.repeats, 3))):
            seconds = [0.0, 0.0]
            for bundle in bundles:
                with torch.no_grad():
                    rays = rays_of_field(bundle[0], field, pupil, wavelength=bundle[2])
                start = now()
                slope(trace_lens(bundle[0], rays, bundle[2]), leaf)
                middle = now()
                slope(trace_bundle(bundle, memo), leaf)
                seconds = [seconds[0] + middle - start, seconds[1] + now() - middle]
            start = now()
            for _ in range(_MANY):
                slope_of_parabolas(parabolas, leaf, float(leaf.detach()))
            times.append([*seconds, (now() - start) / _MANY])
    retraced, with_memo, summed = (statistics.median(column) for column in zip(*times, strict=True))
    gains = {"sensor_step_gain": retraced / summed, "sensor_step_gain_of_memo": retraced / with_memo}
    return [], gains | {"sensor_step_s": summed, "sensor_rays": bench.sizes.sensor, "sensor_distances": len(distances)}


def slope(rays: Rays, leaf: Tensor) -> Tensor:
    """Derivative of the mean squared spot radius with respect to a number of the lens."""
    x, y = rays.position[0], rays.position[1]
    centroid = torch.stack([x.detach().mean(), y.detach().mean()])
    return torch.autograd.grad(squared_radius(x, y, centroid), leaf)[0]


def slope_of_parabolas(parabolas: Tensor, leaf: Tensor, start: float) -> Tensor:
    """The derivative with respect to the sensor distance, summed over spots, from their parabolas (3, D) at `start`."""
    constant, linear, square = parabolas
    shift = leaf - start
    return torch.autograd.grad((constant + 2 * shift * linear + shift * shift * square).sum(), leaf)[0]


def with_sensor_leaf(lens: Lens) -> tuple[Lens, Tensor]:
    """The lens with its sensor distance as a leaf, and the leaf."""
    lens, leaves = with_leaves(lens, [(len(lens.surfaces) - 2, "thickness")])
    return lens, leaves[0]


def detached(rays: Rays) -> Rays:
    """The rays without their graph."""
    return dataclasses.replace(rays, position=rays.position.detach(), direction=rays.direction.detach())


STAGES = (_forward, _backward, _small, _asphere, _sensor)

# -- lenses and tracers ------------------------------------------------------------------------------------------------


def double_gauss() -> Lens:
    return read_lens("double_gauss")


def three_aspheres() -> Lens:
    """Three strong even aspheres (r⁴ to r¹⁰), 14 mm at F/1.8, 10 degrees off the axis.

    At the rim of the beam their terms add 0.8, 0.9 and 0.3 mm of sag, and 37, 39 and 18 degrees of slope.
    """
    rows = (
        (0.09, -0.8, (0.0, 3.2e-3, -8e-5, 2.4e-6, -1.6e-8), 4.0, 1.53),
        (-0.02, 0.5, (0.0, -4.8e-3, 1.2e-4, -3.2e-6, 2.4e-8), 3.0, 1.64),
        (-0.05, -1.5, (0.0, 3.6e-3, -1.2e-4, 2.8e-6, -2e-8), 14.0, 1.0),
    )
    names = ("curvature", "conic", "coefficients", "thickness", "glass")
    surfaces = [dict(zip(names, row, strict=True)) | {"semi_diameter": 5.0} for row in rows]
    return lens_of(surfaces, stop=1, entrance_pupil_diameter=8.0, fields=[10.0], wavelengths=[0.55])


class EngineTracer(Tracer):
    """The trace of an engine, "auto" (the program's choice) or "eager", with derivatives also by the index of every
    medium."""

    def __init__(self, lens: Lens, dtype: torch.dtype, *, engine: str):
        super().__init__(lens, dtype)
        self.engine = engine
        self.name = "raytrace" if engine == "auto" else f"raytrace, {engine}"
        self.surfaces, self.indices, self.leaves = leaves_of(self.lens)

    def forward(self, rays: Rays) -> tuple[Tensor, Tensor | None]:
        with trace_engine(self.engine):
            return super().forward(rays)

    def gradient(self, rays: Rays, centroid: Tensor) -> Sequence[Tensor]:
        with trace_engine(self.engine):
            return super().gradient(rays, centroid)


def leaves_of(lens: Lens) -> tuple[tuple[Surface, ...], list[Tensor], list[Tensor]]:
    """Surfaces after the object with the leaves of `variables`, the indices of all media, and the leaves: those of the
    surfaces, then the indices. Neighbouring gaps of one medium share one."""
    moving, leaves = with_leaves(lens, variables(lens))
    fixed = media(lens, lens.primary)
    indices = list(fixed)
    for number, index in enumerate(fixed):
        if number > 0 and index is fixed[number - 1]:
            indices[number] = indices[number - 1]
        else:
            indices[number] = index.detach().clone().requires_grad_()
            leaves.append(indices[number])
    return moving.surfaces[1:], indices, leaves


def _own(lens: Lens, dtype: torch.dtype) -> list[Tracer]:
    return [EngineTracer(lens, dtype, engine=engine) for engine in ("auto", "eager")]


def over(rows: Sequence[Row], name: str) -> float | None:
    """Speed of this package relative to the fastest tracer whose name starts so; None if there is none."""
    others = [row.seconds for row in rows if row.tracer.startswith(name)]
    return min(others) / next(row.seconds for row in rows if row.tracer == "raytrace") if others else None


# -- report ------------------------------------------------------------------------------------------------------------

#: Ratios in words; {rays}, {small}, {sensor} and {distances} are those of `Sizes`.
WORDS = {
    "forward_over_optiland": "forward, {rays} rays, double Gauss: speed over Optiland's best back end",
    "backward_over_forward": "forward + backward to all curvatures, thicknesses and indices: time over own forward",
    "backward_over_optiland": "… speed over Optiland's",
    "small_batch_ms": "{small} rays forward + backward, ms",
    "small_batch_over_optiland": "… speed over Optiland's",
    "asphere_over_optiland": "three strong even aspheres, {rays} rays: speed over Optiland's best back end",
    "sensor_step_gain": "step of the sensor distance, {sensor} rays × {distances}: × retracing",
    "sensor_step_gain_of_memo": "… with a `Memo` that carries every ray to the sensor",
}
_TASKS = {
    "forward": "double Gauss, forward",
    "backward": "double Gauss, forward + backward",
    "asphere": "three aspheres, forward",
}


def sizes_in_words(sizes: Sizes) -> dict[str, str]:
    """Numbers of rays, powers of two as such, by the name of the field."""
    words = {name: f"{count:,}" for name, count in dataclasses.asdict(sizes).items() if name != "counts"}
    for name, count in {"rays": sizes.rays, "sensor": sizes.sensor}.items():
        if count.bit_count() == 1:
            words[name] = "2" + str(count.bit_length() - 1).translate(str.maketrans("0123456789", "⁰¹²³⁴⁵⁶⁷⁸⁹"))
    return words


def document(rows: Sequence[Row], ratios: Mapping[str, Mapping[str, float | None]]) -> dict:
    """For JSON: the ratios of each dtype, and the speeds in millions of rays × surfaces / s."""
    documents: dict[str, dict] = {}
    for dtype, values in ratios.items():
        speeds: dict[str, dict[str, dict[str, float]]] = {}
        for row in (row for row in rows if row.dtype == dtype):
            speeds.setdefault(row.what, {}).setdefault(row.tracer, {})[str(row.rays)] = row.speed / 1e6
        documents[dtype] = plain({**values}) | {"millions_per_second": speeds}
    return documents


def speeds(rows: Sequence[Row], sizes: Sizes, about: Mapping, repeats: int) -> list[str]:
    """Figure and table of a page."""
    most = {row.tracer: min(sizes.rays, max(r.rays for r in rows if r.tracer == row.tracer)) for row in rows}
    names = ("what", "dtype", "rays", "tracer", "M/s", "position error, nm", "gradient error")
    columns = {name: COLUMNS[name] for name in names} | {"what": lambda row: _TASKS[row.what]}
    shown = listing(columns, [row for row in rows if row.rays in (sizes.small, most[row.tracer])])
    return [*figure_lines(about, repeats), "", *shown]


def figure_lines(about: Mapping, repeats: int) -> list[str]:
    """Figure of a page with its caption."""
    return [
        *("![Speed over number of rays](speed.png)", ""),
        f"Medians of {repeats} turns of all tracers, of {clock_of(about)}; {in_words(about, ' ', ', ')}. All figures: "
        "[speed.csv](speed.csv).",
    ]

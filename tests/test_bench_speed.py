"""The speed benchmark: its limits trace what the package traces, its definitions hold, its page is written. No timings.

Whole processes are stood in for, but for slow tests: each would start torch anew.
"""

import json
import math

import pytest
import torch
from scripts import script

from raytrace.bench import measure as timing
from raytrace.bench.measure import Row, Tracer, field_rays, in_turns, squared_radius
from raytrace.io import read_lens
from raytrace.maths.numerics import to
from raytrace.system.rays import Rays
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.compiler import NoCompiler
from raytrace.tracing.focus import spot_parabola
from raytrace.tracing.scene import Memo, trace_bundle
from raytrace.tracing.trace import trace_lens, trace_surfaces

extended, speed, errors_of = script("bench_speed"), script("bench_ratios"), script("bench_reference").errors_of
Limit, build, KEPT = extended.Limit, extended.build, script("pages").KEPT
STAGES, Bench, Sizes, EngineTracer = speed.STAGES, speed.Bench, speed.Sizes, speed.EngineTracer
document, measure, slope, leaves_of = speed.document, speed.measure, speed.slope, speed.leaves_of
three_aspheres, with_sensor_leaf = speed.three_aspheres, speed.with_sensor_leaf

pytestmark = pytest.mark.usefixtures("same_threads")

#: Ratios of bench_ratios.py.
KEYS = {
    "forward_over_optiland", "backward_over_forward", "backward_over_optiland", "small_batch_ms", "sensor_step_gain",
    "small_batch_over_optiland", "asphere_over_optiland",
}  # fmt: skip
#: Those of bench_speed.py in addition.
ADDED = {
    "forward_over_limit", "forward_over_plain_limit", "asphere_over_limit", "bytes_per_ray", "spot_process_ratio",
    "two_process_gain",
}  # fmt: skip
TINY = Sizes(600, (64,), small=16, sensor=64, distances=2)
#: mm on the image: rounding of 12 surfaces, a hundred millimetres of path.
AGREES = {torch.float32: 1e-4, torch.float64: 1e-10}


@pytest.fixture(autouse=True)
def processes(monkeypatch):
    """Substitutes for processes: other numbers for other dtypes."""
    monkeypatch.setattr(extended, "bytes_per_ray", lambda dtype, rays, threads: (100.0 * dtype.itemsize, rays))
    monkeypatch.setattr(extended, "spot_process_ratio", lambda repeats: (1.25, 2.5, 2.0))
    monkeypatch.setattr(extended, "two_process_gain", lambda dtype, rays, seconds, repeats: (1.8, 10.0, 18.0))
    monkeypatch.setattr(timing, "SHORTEST", 0.0)  # one call a turn
    monkeypatch.setattr(speed, "SAMPLE", 6)


@pytest.fixture(scope="module")
def built():
    try:
        return build()
    except NoCompiler as error:
        pytest.skip(str(error))


def compared(limit, lens, rays):
    """Largest distance of position and direction, where both come through; and that the same rays do."""
    lens, rays = to(lens, dtype=limit.dtype), to(rays, dtype=limit.dtype)
    with torch.no_grad(), trace_engine("eager"):
        expected = trace_lens(lens, rays, lens.primary)
    found = limit.trace(rays)
    assert torch.equal(found.valid, expected.valid)
    alive = expected.valid
    return max(
        float((found.position - expected.position)[:, alive].abs().max()),
        float((found.direction - expected.direction)[:, alive].abs().max()),
    )


# -- the limits --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("dtype", AGREES, ids=str)
@pytest.mark.parametrize("name", ["double_gauss", "tessar", "cooke_triplet"])
def test_safe_limit_traces_what_the_package_traces(built, name, dtype):
    """1000 rays: whole blocks and a part of one, shared by two threads."""
    lens = read_lens(name)
    limit = Limit(built, lens, dtype, safe=True, threads=2)
    assert compared(limit, lens, field_rays(lens, 1000)) < AGREES[dtype]


@pytest.mark.slow
def test_work_of_several_threads_is_that_of_one(built):
    """So many rays that three threads get unequal shares."""
    lens = read_lens("double_gauss")
    rays = field_rays(lens, 20_001)
    one, three = (Limit(built, lens, torch.float64, safe=True, threads=n).trace(rays) for n in (1, 3))
    assert torch.equal(one.position, three.position)
    assert torch.equal(one.direction, three.direction)
    assert bool(three.valid.all())


@pytest.mark.slow
@pytest.mark.parametrize("dtype", AGREES, ids=str)
def test_rays_fail_in_the_safe_limit_too(built, dtype):
    """Rays that miss or are totally reflected continue as axial ones; rays that failed before stay so.

    In float32 rays that graze a surface differ by more: the package takes roots in float64.
    """
    lens = to(read_lens("double_gauss"), dtype=dtype)
    spread = torch.linspace(-1.0, 1.0, 900, dtype=dtype)
    position = torch.stack([70 * spread, 40 * torch.cos(9 * spread), -5 + 0 * spread])
    direction = torch.stack([0.6 * torch.sin(31 * spread), 0.5 * torch.cos(17 * spread), 1 + 0 * spread])
    rays = Rays(position, direction / torch.linalg.vector_norm(direction, dim=0), spread.abs() < 0.9)
    limit = Limit(built, lens, dtype, safe=True)
    found = limit.trace(rays)
    assert bool(torch.isfinite(found.position).all())
    assert 0.05 < float(found.valid.double().mean()) < 0.6
    with torch.no_grad(), trace_engine("eager"):
        expected = trace_lens(lens, rays, lens.wavelengths[0])
    differ = int((found.valid ^ expected.valid).sum())
    assert differ == 0 if dtype == torch.float64 else differ < 5
    both, bound = found.valid & expected.valid, AGREES[dtype] if dtype == torch.float64 else 0.05
    assert float((found.position - expected.position)[:, both].abs().max()) < bound


@pytest.mark.slow
def test_plain_limit_is_the_textbook(built):
    lens = read_lens("double_gauss")
    limit = Limit(built, lens, torch.float64, safe=False)
    assert compared(limit, lens, field_rays(lens, 1000)) < AGREES[torch.float64]


@pytest.mark.slow
@pytest.mark.parametrize("dtype", AGREES, ids=str)
def test_limit_of_the_aspheres_converges_in_the_steps_it_is_given(built, dtype):
    lens = three_aspheres()
    steps = extended.newton_steps(built, lens, dtype)
    assert 3 <= steps <= 6  # strong, but not wild
    rays = field_rays(lens, 1000)
    assert compared(Limit(built, lens, dtype, safe=True, steps=steps), lens, rays) < AGREES[dtype]
    # Too few steps are noticed by the residual, not passed off as a crossing.
    assert not bool(Limit(built, lens, dtype, safe=True, steps=0).trace(to(rays, dtype=dtype)).valid.all())


@pytest.mark.slow
def test_limits_refuse_unsupported_surfaces(built):
    for lens, safe in ((read_lens("hubble"), True), (three_aspheres(), False)):
        with pytest.raises(ValueError, match="know"):
            Limit(built, lens, torch.float64, safe=safe)
    limit = Limit(built, read_lens("double_gauss"), torch.float64, safe=True)
    with pytest.raises(ValueError, match="expected"):
        limit.trace(to(field_rays(read_lens("double_gauss"), 8), dtype=torch.float32))
    assert "-march=native" in built.words


def test_no_compiler_is_an_error():
    with pytest.raises(NoCompiler, match="no-such-compiler"):
        build("no-such-compiler")


# -- what is measured --------------------------------------------------------------------------------------------------


def test_the_aspheres_are_strong_and_right():
    lens = three_aspheres()
    errors = errors_of(EngineTracer(lens, torch.float64, engine="eager"), lens, field_rays(lens, 24))
    assert errors["position"] < 1e-7  # nm
    for surface in lens.surfaces[1:4]:
        powers = torch.tensor([3.0 ** (2 * j) for j in range(1, 6)], dtype=torch.float64)
        assert float((surface.coefficients * powers).sum().abs()) > 0.1  # mm at a height of 3 mm


def test_gradient_is_by_curvatures_thicknesses_and_every_index():
    """The last of the leaves are indices; theirs against central differences of the merit."""
    lens = read_lens("double_gauss")
    rays, centroid = field_rays(lens, 50), torch.zeros(2, dtype=torch.float64)
    found = EngineTracer(lens, torch.float64, engine="eager").gradient(rays, centroid)
    surfaces, indices, leaves = leaves_of(lens)
    with trace_engine("eager"):
        few = Tracer(lens, torch.float64).gradient(rays, centroid)  # 8 curvatures and 11 thicknesses
    assert torch.equal(torch.stack(found[:19]), torch.stack(few))
    assert len(found) == len(leaves) == 19 + 11  # runs of one medium: air in front to air behind
    assert indices[5] is indices[6]  # the stop bends nothing

    def merit(number: int, step: float):
        moved = [index.detach() for index in leaves[19:]]
        moved[number] = moved[number] + step
        at = {id(leaf): index for leaf, index in zip(leaves[19:], moved, strict=True)}
        end = trace_surfaces(surfaces, rays, indices=[at[id(index)] for index in indices])
        return float(squared_radius(*end.position[:2], centroid).detach())

    for number in range(11):
        expected = (merit(number, 1e-6) - merit(number, -1e-6)) / 2e-6
        assert float(found[19 + number]) == pytest.approx(expected, rel=1e-6)


def test_slope_of_the_sensor_step_is_a_derivative_with_and_without_memory():
    """The mean squared radius is a parabola in the sensor distance: central differences are exact but for rounding."""
    lens, leaf = with_sensor_leaf(read_lens("double_gauss"))
    pupil = torch.tensor([[0.3, -0.7, 0.1], [0.2, 0.4, -0.9]], dtype=torch.float64)
    bundle = (lens, torch.zeros(2, 1, dtype=torch.float64), lens.wavelengths[0], pupil)
    memo = Memo()
    for _ in range(2):
        assert float(slope(trace_bundle(bundle, memo), leaf)) == pytest.approx(
            float(slope(trace_bundle(bundle), leaf)), rel=1e-13
        )

    def merit(step: float) -> float:
        with torch.no_grad():
            x, y, _ = trace_bundle((lens.at(sensor_distance=leaf + step), *bundle[1:])).position
            return float(((x - x.mean()) ** 2 + (y - y.mean()) ** 2).mean())

    expected = (merit(0.01) - merit(-0.01)) / 0.02
    assert float(slope(trace_bundle(bundle), leaf)) == pytest.approx(expected, rel=1e-9)
    parabola = torch.stack(spot_parabola(speed.detached(trace_bundle(bundle))))
    assert float(speed.slope_of_parabolas(parabola, leaf, float(leaf.detach()))) == pytest.approx(expected, rel=1e-9)


def test_entrants_take_turns():
    said = []
    seconds = in_turns({name: lambda name=name: said.append(name) for name in "ab"}, repeats=3, threads=1)
    assert {name: len(taken) for name, taken in seconds.items()} == {"a": 3, "b": 3}
    assert said == [*"aabb", *"ababab"]  # behind two calls of each to warm up


class Peer(EngineTracer):
    """A peer that is this package under another name."""

    backend = "torch"

    def __init__(self, lens, dtype):
        super().__init__(lens, dtype, engine="eager")
        self.name = "Optiland, torch"


@pytest.fixture(scope="module")
def measured(request):
    """Rows and ratios of both dtypes on tiny batches, with limits if there is a compiler, and a substitute peer."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(timing, "SHORTEST", 0.0)
        lenses, built = (speed.double_gauss(), three_aspheres()), request.getfixturevalue("built")
        benches = [Bench(dtype, TINY, 1, 1, *([Peer(lens, dtype)] for lens in lenses)) for dtype in speed.DTYPES]
        steps, before = [], torch.get_num_threads()
        rows, ratios = measure([extended.with_limits(bench, built)[0] for bench in benches], progress=steps.append)
        torch.set_num_threads(before)
        assert len(steps) == len(STAGES) * len(benches)
        for dtype, numbers in ratios.items():
            numbers |= extended.of_limits(rows, dtype, TINY)
        return rows, ratios


@pytest.mark.slow
def test_every_ratio_is_there_for_both_dtypes(measured):
    _, ratios = measured
    assert list(ratios) == ["float32", "float64"]
    for dtype, numbers in ratios.items():
        assert set(numbers) >= KEYS, dtype
        assert all(numbers[key] > 0 for key in KEYS), dtype


@pytest.mark.slow
def test_ratios_are_those_of_the_speeds(measured):
    rows, ratios = measured
    for dtype, numbers in ratios.items():
        speeds = {(row.what, row.tracer, row.rays): row.speed for row in rows if row.dtype == dtype}

        def ratio(what, tracer, rays=TINY.rays, speeds=speeds):
            return speeds[what, "raytrace", rays] / speeds[what, tracer, rays]

        assert numbers["forward_over_limit"] == pytest.approx(ratio("forward", "safe limit"))
        assert numbers["forward_over_plain_limit"] == pytest.approx(ratio("forward", "plain limit"))
        assert numbers["forward_over_optiland"] == pytest.approx(ratio("forward", "Optiland, torch"))
        assert numbers["backward_over_optiland"] == pytest.approx(ratio("backward", "Optiland, torch"))
        assert numbers["small_batch_over_optiland"] == pytest.approx(ratio("backward", "Optiland, torch", TINY.small))
        assert numbers["asphere_over_limit"] == pytest.approx(ratio("asphere", "safe limit"))
        small_s = 12 * TINY.small / speeds["backward", "raytrace", TINY.small]
        assert numbers["small_batch_ms"] == pytest.approx(1e3 * small_s)


@pytest.mark.slow
def test_tables_have_the_accuracy_of_every_speed(measured):
    """nm on the image: rounding of float32 at 20 mm, and of float64."""
    rows, _ = measured
    bound = {"float32": 1e3, "float64": 1e-4}
    for row in rows:
        assert row.seconds > 0
        if row.rays != TINY.small:
            assert 0 < row.position < bound[row.dtype], row
            assert row.what != "backward" or 0 < row.gradient < 1e-3, row


@pytest.mark.slow
def test_page_table_and_figure_hold_the_figures(measured, tmp_path):
    rows, ratios = measured
    about = {"processor": "one", "torch threads": 2}
    others = {"bytes_per_ray": 64.0, "bytes_per_ray_rays": 99, "spot_process_ratio": 1.2, "two_process_gain": 1.5}
    ratios = {dtype: numbers | others | {"asphere_newton_steps": 4} for dtype, numbers in ratios.items()}
    page = extended.lines(ratios, sizes=TINY, about=about, compiled="cc -O3", repeats=1)
    found = extended.Page(rows, page, {}, extended.speed_figure, ("speed.md", "speed"))
    (tmp_path / "speed.md").write_text(f"stale\n{KEPT}\nwords\n")
    found.save_page(tmp_path)
    page = (tmp_path / "speed.md").read_text(encoding="utf-8")
    assert page.endswith(f"{KEPT}\nwords\n")
    assert "bench_limit.cpp`, cc -O3" in page
    assert "of time of day; processor one" in page
    judged = [
        extended.met(key, bound, at_most, dtype, values[key])
        for key, _, bound, at_most in extended.TARGETS
        for dtype, values in ratios.items()
    ]
    assert page.count(" (missed) |") == judged.count(False) > 0
    assert len((tmp_path / "speed.csv").read_text().splitlines()) == 1 + len(rows)
    figure = found.plot()
    assert [panel.get_title() for panel in figure.axes] == ["float32", "float64"]
    assert all(panel.get_xscale() == panel.get_yscale() == "log" for panel in figure.axes)
    labels = {line.get_label() for line in figure.axes[0].get_lines()}
    assert labels == {"raytrace", "raytrace, eager", "safe limit", "plain limit", "Optiland, torch"}


def test_targets_are_judged_on_the_right_side():
    by_key = {key: (key, bound, at_most) for key, _, bound, at_most in extended.TARGETS}

    def met(key, value, dtype="float32"):
        return extended.met(*by_key[key], dtype, value)

    assert speed.sizes_in_words(Sizes())["rays"] == "2²⁰"
    assert met("forward_over_limit", 0.7) is True
    assert met("forward_over_limit", 0.69) is False
    assert met("small_batch_ms", 0.5) is True
    assert met("small_batch_ms", 0.51) is False
    assert met("bytes_per_ray", 100.0, "float64") is None
    assert met("bytes_per_ray", None) is None
    assert met("bytes_per_ray", math.nan) is None
    assert set(by_key) | {"forward_over_plain_limit"} == KEYS | ADDED


def test_document_has_speeds_by_entrant_in_millions():
    row = Row("raytrace", "float32", "forward", False, 64, 64, 1e-3, 5e6, 1.0, None, None)
    found = document([row], {"float32": {"two_process_gain": math.inf, "bytes_per_ray": 64.0}})
    assert found["float32"]["millions_per_second"] == {"forward": {"raytrace": {"64": 5.0}}}
    assert found["float32"]["two_process_gain"] is None
    assert found["float32"]["bytes_per_ray"] == 64.0


# -- the script --------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_script_writes_page_table_and_figure(monkeypatch, tmp_path, capsys):
    """Without compiler and peers, whose ratios are None."""

    def refuse():
        raise NoCompiler("no C++ compiler found")

    monkeypatch.setattr(extended, "build", refuse)
    monkeypatch.setattr(speed, "QUICK", TINY)
    kept = tmp_path / "speed.md"
    kept.write_text(f"stale\n{KEPT}\nby hand\n", encoding="utf-8")
    extended.main(["--quick", "--repeats", "1", "--no-peers", "--json", "--docs", str(tmp_path)])
    document = json.loads(capsys.readouterr().out)
    for dtype in ("float32", "float64"):
        assert set(document[dtype]) >= KEYS | ADDED
        for key in KEYS | ADDED:
            absent = key.endswith(("over_limit", "over_plain_limit", "over_optiland"))
            assert (document[dtype][key] is None) == absent, key
    assert document["machine"]["torch threads"] == 1
    page = kept.read_text(encoding="utf-8")
    assert page.endswith(f"{KEPT}\nby hand\n")
    assert "of processor time" in page
    assert "stale" not in page
    assert (tmp_path / "speed.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "speed.csv").exists()


@pytest.mark.slow
def test_processes_answer():
    """Each in its units; the memory of a ray is at least what comes back: 6 numbers and a flag."""
    found, rays = extended.bytes_per_ray(torch.float32, 2**16, threads=1)
    assert rays == 2**16
    assert 25 < found < 1e5
    gain, one, two = extended.two_process_gain(torch.float64, 2**12, seconds=0.2, repeats=1)
    assert gain == two / one > 0
    ratio, spot, bare = extended.spot_process_ratio(1)
    assert ratio == spot / bare > 0.3

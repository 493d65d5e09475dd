"""The benchmark of wave PSFs: its references, its opponent and its page. No timings."""

import csv
import io
import math

import pytest
import torch
from scripts import script

bench, KEPT = script("bench_wave"), script("pages").KEPT
ERROR, SITZMANN, WaveRow = bench.ERROR, bench.SITZMANN, bench.WaveRow
agreement, bench_scene, coefficients_of, distance = (
    bench.agreement,
    bench.bench_scene,
    bench.coefficients_of,
    bench.distance,
)
entrant, gradient, lines, measure = bench.entrant, bench.gradient, bench.lines, bench.measure
reference, refused, target = bench.reference, bench.refused, bench.target

SMALL = 64  # pixels of 3.69 µm: all of the blur but its rim


@pytest.fixture(scope="module")
def scene():
    return bench_scene(size=SMALL)


def error(one):
    return distance(one.prepare()(coefficients_of(one.dtype)), one.truth)


def test_two_converged_references_agree(scene, monkeypatch):
    """Ring integrals and a matrix DFT: nothing in common but the scene."""
    monkeypatch.setattr(bench, "_OTHER", {"samples": 400, "nodes": 6})
    assert agreement(scene) < 3e-5


@pytest.mark.slow
def test_sitzmanns_method_comes_to_the_same_waves(scene):
    """At 3.125 µm a sample, just below λz/(D + blur): right to the staircase of its rim, 1e-3 of the light."""
    method = bench.sitzmann_method(scene, torch.float64, samples=1600)
    assert "padded to 2396²" in method.sampling
    assert error(method) < 2e-3


def test_engines_are_as_good_as_predicted_and_refused_ones_are_wrong(scene):
    truth = reference(scene)
    good = entrant(scene, truth, torch.float64, "pupil", samples=160)
    assert error(good) < 2 * good.predicted
    wrong = refused(scene, truth, 40)
    assert wrong.refused
    assert error(wrong) > 0.5
    with pytest.raises(ValueError, match="not refused"):
        refused(scene, truth, 160)


def test_all_take_the_same_gradient(scene):
    """Of the kernel by the lens's coefficient: two engines, one number, to the errors of their kernels."""
    truth, start = reference(scene), coefficients_of(torch.float64)
    found = [
        gradient(entrant(scene, truth, torch.float64, engine, **how).prepare(), start)
        for engine, how in (("pupil", {"samples": 256, "nodes": 7}), ("radial", {"tol": 1e-6}))
    ]
    assert float(found[0]) == pytest.approx(float(found[1]), rel=1e-3)


def row(engine="pupil", error=1e-4, forward=1e-3, both=2e-3, **more):
    given = {"sampling": "128²", "dtype": "float64", "samples": 128, "predicted": 1e-3, "cold_s": 5e-3}
    return WaveRow(engine=engine, error=error, forward_s=forward, both_s=both, **(given | more))


ROWS = [
    row(),
    row(error=2 * ERROR, both=1e-4),
    row(error=2.4, both=1e-4, refused=True, predicted=math.nan),
    row("radial", error=1e-6, forward=5e-4, both=1e-3, sampling="95 radii"),
    row(SITZMANN, forward=0.5, both=1.0, predicted=None),
    row(SITZMANN, forward=0.3, both=0.15, predicted=None, dtype="float32"),
]


def test_target_is_judged_by_the_fastest_within_the_error():
    found = target(ROWS)
    assert [one.best.engine for one in found] == ["radial", "pupil"]
    assert [(one.forward, one.both, one.met) for one in found] == [
        (pytest.approx(600), pytest.approx(150), True),
        (pytest.approx(300), pytest.approx(75), False),
    ]
    assert found[0].opponent.dtype == "float32"


@pytest.mark.slow
def test_page_and_table_hold_the_figures(tmp_path):
    said = lines(ROWS, agreement=3e-6, about={"processor": "one"}, repeats=5)
    found = bench.Page(ROWS, said, {}, bench.wave_figure, ("wave_bench.md", "wave/speed"))
    (tmp_path / "wave_bench.md").write_text(f"stale\n{KEPT}\nwords of a reader\n")
    found.save_page(tmp_path)
    page = (tmp_path / "wave_bench.md").read_text()
    assert "stale" not in page
    assert (tmp_path / "wave" / "speed.png").read_bytes().startswith(b"\x89PNG")
    assert page.endswith(f"{KEPT}\nwords of a reader\n")
    assert "| ring integrals | 95 radii, float64 | 1.0e-06 | 600 × | 150 × | yes |" in page
    assert "| *pupil matrix DFT* | *128²* | *float64* | *2.4* | *–* |" in page
    read = list(csv.DictReader(io.StringIO((tmp_path / "wave" / "speed.csv").read_text())))
    assert [float(line["both_s"]) for line in read] == [one.both_s for one in ROWS]
    assert read[-1]["predicted"] == ""
    assert len(found.plot().axes) == 2


@pytest.mark.slow
def test_script_writes_the_page(monkeypatch, tmp_path):
    """A few samplings of small kernels; their errors are of no interest here."""
    few = bench.entrants
    monkeypatch.setattr(bench, "entrants", lambda: few(size=16, sitzmann=200))
    for name, value in (("_PUPIL", (128,)), ("_RADIAL", ({"tol": 1e-3},)), ("_REFUSED", ()), ("_TRANSFER", (500,))):
        monkeypatch.setattr(bench, name, value)
    monkeypatch.setattr(bench, "agreement", lambda scene: 1e-6)
    bench.main(["--repeats", "1", "--docs", str(tmp_path)])
    assert "python docs/experiments/bench_wave.py --docs docs" in (tmp_path / "wave_bench.md").read_text("utf-8")
    assert len((tmp_path / "wave" / "speed_vs_error.csv").read_text().splitlines()) == 9


def test_measure_counts_its_progress(scene):
    truth = reference(scene)
    done = []
    found = measure(entrant(scene, truth, torch.float32, "radial", tol=1e-3), repeats=2, progress=done.append)
    assert sum(done) == 3
    assert found.error < 1e-3
    assert found.dtype == "float32"
    assert min(found.forward_s, found.both_s, found.cold_s) > 0

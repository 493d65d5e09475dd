"""The PSF benchmark: its direct Huygens sum, references and targets, and the command from end to end. No timings."""

import dataclasses
import json
import math

import pytest
import torch
from problems import plano_hyperbolic, vector
from scripts import script

from raytrace.bench import psf as bench
from raytrace.bench.psf import Case, Method, cases, gradient, measured_rows, methods, truth_of
from raytrace.cli import main
from raytrace.io import read_lens
from raytrace.psf_models import MODELS, drt, wave
from raytrace.psf_models.direct_sum import Sampling, moments

pytestmark = pytest.mark.usefixtures("threads")

extended = script("bench_psf")
published_cases = extended.published_cases


def test_random_histogram_is_one_histogram_however_it_is_cut():
    case = published_cases("double_gauss", read_lens("double_gauss"))[0]
    window = case.window(moments(case.scene, 6, 24)[0])
    whole = extended.random_histogram(case.scene, window, 3000, piece=3000)
    cut = extended.random_histogram(case.scene, window, 3000, piece=1000)
    assert (whole.kernel - cut.kernel).abs().max() < 1e-12
    reference = drt.reference(case.scene, window, lines=512)[0, 0, 0]
    assert 0.1 < bench.relative_l1(whole.kernel[0, 0, 0], reference) < 0.4  # 0.8 Σ√p/√3000


def test_published_cases_and_others():
    fixed, free = published_cases("double_gauss", read_lens("double_gauss")), cases("tessar", read_lens("tessar"))
    assert [case.pitch for case in published_cases("tessar", read_lens("tessar"))] == [case.pitch for case in free]
    assert [case.field for case in fixed] == [0.0, 14.0]
    assert fixed[0].distance == 1e4
    assert [case.field for case in free] == [0.0, float(read_lens("tessar").fields.y.abs().max())]
    for case in free:
        assert math.isinf(case.distance)
        sigma = float(moments(case.scene, 8, 32)[1].sqrt().max())
        assert bench.PIXELS * case.pitch == pytest.approx(max(7 * sigma, 8 * 0.59e-3 * 4.6), rel=0.1)


def test_gradients_are_by_all_that_is_modelled():
    """Curvatures, conics, coefficients and thicknesses; against a difference by the sensor distance."""
    lens = read_lens("phone")
    case = Case(lens, "phone", 0.0, math.inf, 1e-3)
    method = Method("gaussian", "4 rings", lambda s, g: MODELS["gaussian"].kernels(s, g, order=4), "gaussian")
    slopes = gradient(method, case.scene, case.window(vector(0.0, 0.0)))
    kinds = sum(
        getattr(surface, name) is not None
        for surface in lens.surfaces[1:-1]
        for name in ("curvature", "conic", "coefficients", "thickness")
    )
    assert len(slopes) == kinds
    assert all(slope is None or bool(torch.isfinite(slope).all()) for slope in slopes)
    pattern = torch.cos(torch.arange(21 * 21, dtype=torch.float64))

    def value(step):
        s = dataclasses.replace(case, lens=lens.at(sensor_distance=lens.surfaces[-2].thickness + step)).scene
        with torch.no_grad():
            return float(method.run(s, case.window(vector(0.0, 0.0))).kernel.flatten() @ pattern)

    assert float(slopes[-1]) == pytest.approx((value(1e-6) - value(-1e-6)) / 2e-6, rel=1e-5)


def row(**others):
    figures = {"lens": "l", "field": 0.0, "model": "drt", "sampling": "order 1", "dtype": "float64", "rays": 9}
    return extended.Row(**(figures | {"forward_s": 0.01, "l1_error": 5e-3} | others))


def test_targets_compare_the_quickest_that_come_as_close():
    rows = [
        row(sampling="order 4", forward_s=0.02, l1_error=1e-3),  # slower
        row(),
        row(sampling="order 0", forward_s=0.001, l1_error=0.02),  # too coarse
        row(model="random rays", sampling="10 rays", forward_s=0.1, l1_error=0.3),
        row(model="random rays", sampling="99 rays", forward_s=0.6, l1_error=0.01),
        row(model="gaussian", sampling="2 rings", rays=2, sigma_error=1e-5, centroid_error=0.0),
        row(model="gaussian", sampling="3 rings", rays=9, sigma_error=1e-7, centroid_error=0.0),
        row(model="wave", l1_error=2e-4, forward_s=0.1),
        row(model="direct sum, grid", forward_s=20.0, l1_error=1e-3, extrapolated=True),
        row(model="direct sum, rings", forward_s=1.0, l1_error=1e-4),
        row(model="drt", sampling="tol 1e-2", forward_s=1e-9, estimate=1e-2, own_error=5e-3),
        row(model="drt", sampling="tol 1e-1", forward_s=1e-9, estimate=1e-2, own_error=5e-3),
        row(model="wave", sampling="tol 1e-2", forward_s=1e-9, estimate=1e-2, own_error=2e-2),
    ]
    assert len(extended.judged(rows)) == 2
    found = {goal: (measured, met) for goal, _, measured, met in extended.targets(rows)}
    assert [met for _, met in found.values()] == [False, True, True, True, False, False, True]
    words = [measured for measured, _ in found.values()]
    assert words[0] == "9 rays"
    assert words[1].startswith("60×: 10 ms")
    assert words[3].startswith("200×: 100 ms (order 1, 2.0e-04) against extrapolated")
    assert words[4].startswith("10×")
    assert words[5:] == ["50% of 2", "50% of 2"]


@pytest.mark.slow
def test_estimates_are_compared_with_true_errors(few):
    case = published_cases("hubble", read_lens("hubble"))[0]
    truth = truth_of(case)
    (method,) = [method for method in methods() if method.sampling.startswith("tol")]
    (measured,) = extended.estimated_rows(truth, measured_rows(truth, [(method, torch.float64)], 1, 1))
    assert measured.own_error == measured.l1_error  # of the Fourier model both against its finest order
    assert extended.bounds(measured)


def test_random_rays_reach_the_error_they_are_asked_for(monkeypatch):
    monkeypatch.setattr(extended, "RAYS_ERROR", 0.1)
    monkeypatch.setattr(extended, "PILOT", 4000)
    case = published_cases("double_gauss", read_lens("double_gauss"))[0]
    window = case.window(vector(0.0, 0.0))
    kernels = {"rays": drt.reference(case.scene, window, lines=512)[0, 0, 0]}
    truth = bench.Truth(case, kernels, {"rays": window}, vector(0.0, 0.0), moments(case.scene, 6, 24)[1].sqrt())
    found = extended.random_rows(truth, torch.float64, 1)
    assert 0.08 < found[-1].l1_error < 0.12
    assert found[3].rays == pytest.approx(4000 * (found[2].l1_error / 0.1) ** 2, abs=1)  # error ∝ rays^-1/2


def test_square_grids_are_extrapolated_by_the_power_their_error_falls_with(monkeypatch):
    """An error of rays^-3/4 and a time of 1 s for 100 rays: 1e-3 needs 10⁴ rays and 100 s."""
    case = Case(plano_hyperbolic(diameter=1.0), "stigmatic", 0.0, math.inf, 0.005)
    ones, now = torch.ones(21, 21, dtype=torch.float64), [0.0]

    def direct_sum(scene, window, sampling):
        rays = sampling.rings * (sampling.arms or sampling.rings)
        now[0] += rays / 100
        return ones * (1 + rays**-0.75), rays

    monkeypatch.setattr(extended, "direct_sum", direct_sum)
    monkeypatch.setattr(extended, "clock", lambda threads: lambda: now[0])
    kernels, windows = {"wave": ones}, {"wave": case.window(vector(0.0, 0.0))}
    monkeypatch.setattr(extended, "sampling_of", lambda scene, window: Sampling(40, 160, 4))
    truth = bench.Truth(case, kernels, windows, vector(0.0, 0.0), vector(1.0, 1.0))
    *rings, coarse, fine, far = extended.direct_rows(truth, 1)
    assert [line.model for line in rings] == ["direct sum, rings"] * 3
    assert (coarse.rays, fine.rays, far.extrapolated) == (64**2, 96**2, True)
    assert far.rays == pytest.approx(1e4, abs=2)
    assert far.forward_s == pytest.approx(100, rel=1e-3)


@pytest.fixture
def few(monkeypatch):
    """One coarse order of each model and small direct sums."""
    monkeypatch.setattr(bench, "_ORDERS", {"gaussian": (4,), "drt": (0,), "fourier": (0,), "wave": (0,)})
    monkeypatch.setattr(bench, "_TOLERANCES", {"fourier": (0.01,)})
    monkeypatch.setattr(extended, "FINEST_WAVE", 1)
    monkeypatch.setattr(extended, "SOBOL", (256,))
    monkeypatch.setattr(extended, "PILOT", 20_000)
    monkeypatch.setattr(extended, "PATIENCE", 0.05)
    monkeypatch.setattr(extended, "SQUARE", (16, 24))
    monkeypatch.setattr(bench, "PIXELS", 7)
    monkeypatch.setattr(bench, "cases", published_cases)


@pytest.mark.slow
def test_command_writes_everything(few, tmp_path, capsys):
    names = ["bench", "psf", "hubble", "--repeats", "1", "--threads", "1"]
    files = [str(tmp_path / name) for name in ("r.json", "r.png")]
    assert main([*names, "-o", files[0], "--plot", files[1]]) == 0
    document = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    rows = {(line["field"], line["model"], line["dtype"]): line for line in document["rows"]}
    assert rows[0.0, "drt", "float64"]["l1_error"] < 0.01
    assert rows[0.0, "gaussian", "float64"]["sigma_error"] < 0.1
    assert rows[0.0, "fourier", "float32"]["both_s"] > 0
    assert document["machine"]["torch threads"] == 1
    assert (tmp_path / "r.png").read_bytes().startswith(b"\x89PNG")
    assert capsys.readouterr().out.count("hubble  ") == len(document["rows"])


@pytest.mark.slow
def test_script_adds_random_rays_direct_sums_and_targets(few, tmp_path, capsys):
    extended.main(["hubble", "--repeats", "1", "--no-peers", "--json", "--docs", str(tmp_path)])
    document = json.loads(capsys.readouterr().out)
    assert {target["case"] for target in document["targets"]} >= {"hubble, 0"}
    assert {row["model"] for row in document["rows"]} >= {"random rays", "direct sum, rings", "direct sum, grid"}
    assert "## Targets" in (tmp_path / "tables.md").read_text("utf-8")


def test_refusals_are_reported(few, monkeypatch):
    def refuse(*arguments):
        raise ValueError("too steep")

    monkeypatch.setattr(bench.direct_sum, "reference", refuse)
    case = Case(plano_hyperbolic(diameter=1.0), "stigmatic", 0.0, math.inf, 0.005)
    done, said = [], []
    truth = truth_of(case, said.append)
    assert said == ["stigmatic, 0°: too steep"]
    assert truth.kernels.keys() == {"rays", "gaussian", "paraxial", "fourier"}
    tasks = [(method, torch.float64) for method in methods()]
    rows = measured_rows(truth, tasks, 1, 1, progress=done.append, say=said.append)
    assert sum(done) == len(tasks)
    assert not [line for line in rows if line.model == "wave"]


def test_peer_sees_the_same_kernels():
    """Optiland at full field, coma and all: turned or shifted by a pixel, its kernels would be off by 0.3 and more."""
    pytest.importorskip("optiland", reason="needs the extra [bench]")
    peer = script("bench_peers")
    case = published_cases("double_gauss", read_lens("double_gauss"))[1]
    window = case.window(moments(case.scene, 8, 32)[0])
    kernels = {
        "rays": drt.reference(case.scene, window, lines=512)[0, 0, 0],
        "wave": wave.kernels(case.scene, window).kernel[0, 0, 0].detach(),
    }
    truth = bench.Truth(case, kernels, dict.fromkeys(kernels, window), window.centre, vector(0.02, 0.02))
    differences = {}
    for method in peer.psf_methods(truth):
        if method.sampling.startswith(("100,000", "64²", "128²")):
            kernel = method.run(case.scene, window).kernel
            differences[method.model] = bench.relative_l1(kernel, kernels[method.against])
    assert differences["Optiland histogram"] < 0.05
    assert differences["Optiland Huygens"] < 0.06
    assert differences["Optiland FFT"] < 0.12

"""The benchmark of tolerancing runs end to end; the lens moved as in Optiland's tutorial has its figures."""

import json

import pytest
import torch
from scripts import script

from raytrace.maths.sampling import gauss_rings

tolerance = script("bench_tolerance")

pytestmark = pytest.mark.usefixtures("same_threads")


def test_the_first_radius_moved_has_the_printed_figures():
    found = tolerance.sweep(tolerance.triplet(), [radius for radius, *_ in tolerance.PUBLISHED])
    for (_, efl, rms), (f, spot) in zip(tolerance.PUBLISHED, found, strict=True):
        assert f == pytest.approx(efl, abs=5.1e-7)
        assert spot == pytest.approx(rms, abs=5.1e-7)


def test_every_row_and_the_figure(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(tolerance, "TRIALS", 16)
    tolerance.main(["--no-peers", "--repeats", "1", "--docs", str(tmp_path), "--json"])
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["rays"] for row in rows] == [549, 216]
    assert all(row["errors"] == 27 and row["lenses"] == 16 and row["speed"] > 0 for row in rows)
    assert (tmp_path / "tolerancing.png").stat().st_size > 1000


def test_the_sensor_is_at_the_least_mean_square():
    lens = tolerance.triplet()
    study = tolerance.study(lens, gauss_rings(3, 6))
    errors = torch.zeros(1, len(study.tolerances), dtype=torch.float64)
    q, shift, _ = study.compensated(errors)
    for step in (-1e-3, 1e-3):
        assert float(study.quantity(errors, shift + step)) > float(q)
    assert float(q) == pytest.approx(float(study.quantity(errors, shift)), rel=1e-12)


def test_optiland_computes_the_same_lenses():
    pytest.importorskip("optiland")
    peers = script("bench_peers")
    errors = tolerance.draw_errors(tolerance.tolerances(), 3)
    found, _ = peers.tolerancing(tolerance.tolerances(), errors, 4, lambda: None, 1)
    study = tolerance.study(tolerance.triplet(), tolerance.equal_rings(4))
    mine = study.compensated(errors)[0].sqrt()
    assert mine.tolist() == pytest.approx(found, rel=1e-10)

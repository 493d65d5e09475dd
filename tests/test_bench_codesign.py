"""The accuracy benchmark of co-design: limits, entrants, tables, and the command from end to end. No timings."""

import csv
import io
import json
import statistics

import pytest
import torch

from raytrace.bench import codesign_accuracy as bench
from raytrace.bench import codesign_report as report
from raytrace.bench.codesign_accuracy import Accuracy, Entrant, ModelError, Place, distances_of, entrants, found
from raytrace.cli import main
from raytrace.files import shipped
from raytrace.formats import read_lens
from raytrace.kernels import psf
from raytrace.system.lens import with_sensor_distance

pytestmark = pytest.mark.usefixtures("threads")

SENSOR = 57.66


@pytest.fixture(scope="module")
def lens():
    return read_lens(shipped("lenses") / "double_gauss.zmx")


def named(sampling: str) -> Entrant:
    return next(entrant for entrant in entrants() if entrant.sampling == sampling)


@pytest.fixture(scope="module", params=[0.0, 14.0], ids=["axis", "edge"])
def measured(request, lens):
    """Few entrants at one place with 3 object distances (off the axis 1, limits take seconds), and the models."""
    samples = 1 if request.param else 3
    names = ("2 rings", "4 rings", "24 random", "37 hexapolar", "map, order 0", "map, order 2", "256 splatted")
    names += ("1024 splatted", "256 counted")
    chosen = [named(name) for name in names]
    counted = []
    rows, gaps = bench.measure(
        lens, fields=[request.param], sensors=[SENSOR], samples=samples, chosen=chosen, repeats=1, draws=2,
        progress=counted.append,
    )  # fmt: skip
    assert sum(counted) == bench.steps(chosen, fields=1, sensors=1, repeats=1)
    return {row.sampling: row for row in rows}, gaps


def test_quadrature_converges_and_plain_averages_do_not(measured):
    """docs/codesign_accuracy.md: 4 rings 1e-6 of σ and better than 1e-5, dozens of plain rays some per cent."""
    rows, _ = measured
    assert rows["4 rings"].sigma_error < 1e-5 < rows["2 rings"].sigma_error < 0.2
    assert rows["4 rings"].l1_error < 1e-4
    assert rows["4 rings"].slope_error < 1e-4
    for name in ("24 random", "37 hexapolar"):
        assert rows[name].sigma_error > 1e-2
        assert rows[name].slope_error > 0.1
        assert rows[name].rays == int(name.split()[0])


def test_ray_map_beats_hundreds_of_rays(measured):
    """Few rays through the map are closer than a thousand plain ones, in the kernel and more so in its slope."""
    rows, _ = measured
    assert rows["map, order 2"].l1_error < rows["map, order 0"].l1_error < 0.05
    assert rows["map, order 2"].rays < 64
    assert rows["256 splatted"].l1_error > rows["1024 splatted"].l1_error > 5 * rows["map, order 0"].l1_error
    assert rows["1024 splatted"].slope_error > 5 * rows["map, order 0"].slope_error
    assert rows["256 counted"].slope_error is None
    assert rows["256 counted"].both_ms > 0


def test_models_are_far_from_drt_and_paraxial_farthest_in_the_mean(measured):
    _, gaps = measured
    means = {
        model: statistics.mean(gap.l1_error for gap in gaps if gap.model == model)
        for model in ("paraxial", "fourier", "gaussian")
    }
    assert all(0 <= gap.l1_error <= 2 for gap in gaps)
    assert 0.1 < means["gaussian"] < means["paraxial"]


def test_slope_is_the_derivative_of_the_kernel(lens):
    """Against central differences over 0.2 µm, whose own error is of the order of 1e-4."""
    distances, step = distances_of(2), 1e-4
    entrant = named("4 rings")
    slope = found(Place(lens, 0.0, SENSOR), entrant, distances).slope
    ahead, behind = (found(Place(lens, 0.0, SENSOR + d), entrant, distances).kernel for d in (step, -step))
    torch.testing.assert_close(slope, (ahead - behind) / (2 * step), rtol=0, atol=1e-3 * float(slope.abs().max()))


def test_limit_is_what_psf_gives(lens):
    """The door, in the experiment's window and normalisation, comes to the same kernels off the axis."""
    distances = distances_of(2)
    place = Place(lens, 14.0, SENSOR)
    own = found(place, named("map, order 2"), distances).kernel
    through_door = psf(
        with_sensor_distance(lens, SENSOR), "drt", fields=torch.tensor([[0.0], [14.0]], dtype=torch.float64),
        object_distances=distances, wavelengths=torch.tensor([bench.WAVELENGTH], dtype=torch.float64),
        center="chief", normalise="window", order=2,
    )  # fmt: skip
    torch.testing.assert_close(own, through_door.kernel[:, 0], rtol=1e-6, atol=1e-9)


def test_page_and_table_say_what_was_measured():
    rows = [
        Accuracy(0.0, 57.66, "gaussian", "4 rings", 4, 3.8e-7, 5e-13, 0.0123, 9.87),
        Accuracy(0.0, 57.66, "drt", "256 counted", 256, 0.02, 0.5, None, 11.0),
    ]
    gaps = [ModelError(14.0, 57.66, "paraxial", d, e) for d, e in ((1e4, 0.2), (5e4, 1.0))]
    page = report.markdown(rows, gaps, about={"cores": 2}, repeats=5, kept="By hand.")
    assert "| Gaussian DRT | 4 | quadrature, 4 rings | 3.8e-07 | < 1e-9 | 0.0123 | 9.9 |" in page
    assert "| DRT | 256 | random, counted | 0.02 | 0.5 | – | 11.0 |" in page
    assert "| 14° off the axis, 57.66 mm | 0.60 (0.20 – 1.00) |" in page
    assert page.endswith(f"{report.KEPT}\nBy hand.\n")
    read = list(csv.DictReader(io.StringIO(report.table(rows))))
    assert read[1]["slope_error"] == ""
    assert float(read[0]["sigma_error"]) == 3.8e-7


def test_command_writes_page_tables_and_figure(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "FIELDS", (0.0,))
    monkeypatch.setattr(bench, "SENSORS", (SENSOR,))
    monkeypatch.setattr(bench, "SAMPLES", 2)
    few = [named("4 rings"), named("map, order 0")]
    monkeypatch.setattr(bench, "entrants", lambda: few)
    assert main(["bench", "codesign", "--repeats", "1", "--json", "--docs", str(tmp_path)]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [row["rays"] for row in document["rows"]] == [4, 8]
    assert len(document["models"]) == 3 * bench.SAMPLES
    page = (tmp_path / "codesign_accuracy.md").read_text()
    assert "quadrature, 4 rings" in page
    assert "nothing by hand" not in page
    for name in ("accuracy.csv", "model_error.csv", "accuracy.png"):
        assert (tmp_path / "codesign" / name).stat().st_size > 100
    (tmp_path / "codesign_accuracy.md").write_text(page + "nothing by hand\n")
    assert main(["bench", "codesign", "--repeats", "1", "--docs", str(tmp_path)]) == 0
    assert "nothing by hand" in (tmp_path / "codesign_accuracy.md").read_text()


@pytest.mark.parametrize("option", [["--rays", "100"], ["--csv", "x.csv"], ["some.zmx"]])
def test_command_refuses_what_belongs_to_the_others(option, capsys):
    assert main(["bench", "codesign", *option]) != 0
    assert "bench codesign takes no" in capsys.readouterr().err

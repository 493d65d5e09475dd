"""Fresh networks for known lenses: paired differences of known losses, runs that go on, the page and the command."""

import csv
import functools
import json
import math
from pathlib import Path

import pytest
from PIL import Image

from raytrace.imaging.training import DamagedRun
from raytrace.studies.codesign import retrain_page
from raytrace.studies.codesign.retrain import Retrained, effects, last_epochs, sensors_of, settings_of_lens
from raytrace.studies.codesign.settings import Settings
from raytrace.studies.pictures import dead_leaves

_LITTLE = "--depth 4 --width 4 --patch 16 --size 7 --epochs 3 --crops 2 --batch 4 --precision float32"
SMALL = tuple(_LITTLE.split(" "))


def losses_of(**losses):
    return [
        Retrained(model, seed, 57.7, loss, 2 * loss, {"10000": loss, "50000": loss / 2})
        for model, values in losses.items()
        for seed, loss in enumerate(values)
    ]


def test_effects_are_means_of_differences_by_seed_with_their_intervals():
    """Student's t by hand: differences of 1, 2 and 3 %, mean 2 %, s = 1 %, t(0.975, 2) = 4.3027."""
    found = losses_of(gaussian=[1.0, 2.0, 4.0], drt=[1.01, 2.04, 4.12])
    one, last = effects(found)
    assert (one.model, one.reference, one.loss, one.seeds) == ("drt", "gaussian", "l1", 3)
    assert one.mean == pytest.approx(0.02)
    reach = 4.302653 * 0.01 / math.sqrt(3)
    assert (one.low, one.high) == pytest.approx((0.02 - reach, 0.02 + reach), rel=1e-6)
    # t = 2/(1/√3), two degrees of freedom: p = 1 - t/√(t² + 2)
    t = 2 * math.sqrt(3)
    assert one.p == pytest.approx(1 - t / math.sqrt(t * t + 2), rel=1e-9)
    assert not one.is_clear
    assert (last.loss, last.mean) == ("l1_last_epochs", pytest.approx(0.02))


def test_what_all_seeds_share_is_no_noise():
    """Seeds differ by 50 %, lenses by 1 % in each: clear, where two unpaired means would say nothing."""
    found = losses_of(gaussian=[1.0, 1.5, 1.25], paraxial=[1.0101, 1.5150, 1.2624])
    assert effects(found)[0].is_clear
    assert effects(found)[0].low > 0.009


def test_effects_at_object_distances_are_those_of_the_losses_there():
    one, other = effects(losses_of(gaussian=[1.0, 2.0], drt=[1.01, 2.04]), losses=("50000", "10000"))
    assert (one.loss, other.loss) == ("50000", "10000")
    assert one.mean == other.mean == pytest.approx(0.015)


def test_only_seeds_that_both_lenses_have_are_compared():
    found = [
        one for one in losses_of(gaussian=[1.0, 2.0, 3.0], drt=[1.1, 2.0, 9.0]) if (one.model, one.seed) != ("drt", 2)
    ]
    assert {one.seeds for one in effects(found)} == {2}
    assert effects(losses_of(gaussian=[1.0], drt=[1.0])) == []
    assert effects(losses_of(drt=[1.0, 2.0])) == []


def test_the_last_two_epochs_of_a_log():
    assert last_epochs([9, 9, 5, 5, 1, 3], 3) == 3.5
    assert last_epochs([4, 6], 1) == 5


def test_networks_see_all_light_at_the_sensor_as_it_is():
    """Whatever chose the lens: a few rays, bounds that the sensor is beyond, a focal length held by a space."""
    begun = Settings(vary="sensor thickness:2", bounds="sensor:57,57.5", hold="efl", rays=12, noise=0.05)
    assert settings_of_lens(begun, 57.8, 3) == Settings(model="drt", start="57.8", seed=3, noise=0.05)


def test_sensors_are_means_over_seeds(tmp_path):
    table = tmp_path / "table2.csv"
    table.write_text("model,seed,sensor_mm\ngaussian,0,57.5\nparaxial,0,57.8\ngaussian,1,57.7\n")
    assert sensors_of(table) == {"paraxial": 57.8, "gaussian": pytest.approx(57.6)}
    table.write_text("model,seed,sensor_mm\nwave,0,57.5\n")
    with pytest.raises(DamagedRun, match="rows of wave; expected paraxial"):
        sensors_of(table)
    table.write_text("lens,place\nparaxial,57.5\n")
    with pytest.raises(DamagedRun, match="expected the columns model and sensor_mm"):
        sensors_of(table)


@pytest.fixture
def retraining(command):
    return functools.partial(command, "codesign", "retrain", "double_gauss")


def test_the_command_trains_fresh_networks_on_frozen_lenses(retraining, tmp_path):
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for number, sample in enumerate(dead_leaves(10, size=48).samples):
        Image.fromarray(sample).save(pictures / f"{number}.png")
    Path("table2.csv").write_text("model,seed,sensor_mm\nparaxial,0,57.77\ngaussian,0,57.57\n")
    told = ("--data", pictures, "-o", "fresh")
    command = ("--sensors", "table2.csv", *told, "--docs", "docs", *SMALL)
    code, out, err = retraining(*command, "--seeds", "0", "1", "--page", "second", "--json")
    assert code == 0, err
    document = json.loads(out)
    assert [(one["model"], one["seed"]) for one in document["rows"]] == [
        (model, seed) for seed in (0, 1) for model in ("paraxial", "gaussian")
    ]
    for one in document["rows"]:
        folder = Path(f"fresh/{one['model']}-{one['seed']}")
        with (folder / "retrain/log.csv").open(newline="") as file:
            log = list(csv.DictReader(file))
        assert {float(row["sensor"]) for row in log} == {document["sensors"][one["model"]]}  # held
        assert one["l1_last_epochs"] == pytest.approx(last_epochs([float(row["loss"]) for row in log], 3))
        assert 0 < one["l1"] < 0.5
        assert json.loads((folder / "retrain/settings.json").read_text())["model"] == "drt"
    assert {one["model"] for one in document["effects"]} == {"paraxial"}
    page = Path("docs/second_retrain.md").read_text(encoding="utf-8")
    assert "| lens of | loss | seeds | more than Gaussian DRT's | p |" in page
    assert "Unfinished" not in page
    assert " --docs docs --seeds 0 1 --page second --" in page
    code, out, err = retraining(*told, "--docs", "again", "--page", "second", "--report-only", "--json")
    assert (code, json.loads(out)) == (0, document), err  # what was begun, by the settings that are kept
    assert Path("again/second_retrain.md").read_text(encoding="utf-8") == page
    code, out, err = retraining(*told, "--models", "paraxial", "--report-only")
    assert code == 0, err
    assert "-o FOLDER --docs docs --models paraxial --seeds 0 1 --" in Path("fresh/codesign_retrain.md").read_text()
    with Path("docs/second/retrain.csv").open(newline="") as file:
        assert len(list(csv.DictReader(file))) == 4
    with Path("docs/second/retrain_distance.csv").open(newline="") as file:
        losses = {(row["model"], row["seed"], row["distance_m"]): float(row["l1"]) for row in csv.DictReader(file)}
    for one in document["rows"]:
        for distance, loss in one["by_distance"].items():
            assert losses[one["model"], str(one["seed"]), str(float(distance) / 1e3)] == loss
    code, out, err = retraining(*command, "--seeds", "0", "1", "2", "--report-only")
    assert code == 0, err
    assert "not finished: paraxial 2, gaussian 2" in out
    assert "**Unfinished: 4 of 6 networks.**" in Path("docs/codesign_retrain.md").read_text(encoding="utf-8")
    Path("table2.csv").write_text("model,seed,sensor_mm\nparaxial,0,57.70\ngaussian,0,57.57\n")
    code, _, err = retraining(*command, "--seeds", "0")
    assert code == 1
    assert "fresh holds another run: sensors was" in err


def test_a_report_of_no_study_leaves_the_page_that_is_there(retraining):
    Path("table2.csv").write_text("model,seed,sensor_mm\nparaxial,0,57.77\n")
    told = ("--docs", "docs", "--report-only", "--limit", "10", *SMALL)
    code, out, err = retraining("--sensors", "table2.csv", "-o", "fersh", *told)
    assert (code, out, err) == (1, "", "raytrace: error: fersh: no study was begun here\n")
    assert not Path("docs").exists()
    assert not Path("fersh").exists()


def test_lenses_that_are_not_in_the_table_are_named(retraining, monkeypatch):
    monkeypatch.setattr(retrain_page, "_train", lambda *given: pytest.fail("trained"))
    Path("table2.csv").write_text("model,seed,sensor_mm\nparaxial,0,57.77\ngaussian,0,57.57\n")
    models = ("--models", "paraxial", "drt", "fourier")
    code, _, err = retraining("--sensors", "table2.csv", "-o", "fresh", *models, "--limit", "10")
    assert code == 1
    assert err == "raytrace: error: table2.csv: no lens of drt, fourier; --models of paraxial, gaussian\n"


def test_without_a_table_of_lenses_it_says_what_is_missing(retraining):
    code, _, err = retraining("-o", "fresh")
    assert code == 1
    assert "give the table of the lenses, --sensors table2.csv, and a folder" in err

"""The studies of colour cameras: paired differences, the table, and a little study that resumes."""

import csv
import dataclasses
import io
import math

import pytest
from scripts import script

from raytrace.imaging.pictures import dead_leaves

study = script("camera_codesign")


def row(training, seed, network):
    return {"lens": "phone", "training": training, "seed": seed, "network": network, "network_0": network}


def test_differences_are_paired_by_seed():
    """1 dB and 3 dB, whatever the pictures of a seed are worth: 2 dB, half width t(0.975, 1) · √2 / √2."""
    rows = [row("gaussian", 0, 21.0), row("drt", 0, 20.0), row("gaussian", 1, 33.0), row("drt", 1, 30.0)]
    mean, half = study.differences(rows, "phone", "gaussian", "drt", "network")
    assert mean == pytest.approx(2.0)
    assert half == pytest.approx(12.7062, rel=1e-4)
    assert math.isnan(study.differences(rows[:2], "phone", "gaussian", "drt", "network")[1])
    assert [*csv.DictReader(io.StringIO(study.table(rows)))][2]["network"] == "33.0000"


def test_settings_of_the_studies_differ_in_the_model_alone(tmp_path):
    one = study.Study("models", tmp_path, 1.0, 6, ("phone",), dead_leaves(10, size=84, colour=True))
    first, second = (dataclasses.asdict(one.settings("phone", arm, 3)) for arm in ("gaussian", "drt"))
    assert {name for name in first if first[name] != second[name]} == {"model"}
    assert one.settings("phone", "frozen", 3) == one.settings("phone", "gaussian", 3)
    apart = dataclasses.replace(one, kind="apart")
    assert {apart.settings("cooke_triplet", arm, 0).model for arm in study.ARMS["apart"]} == {"gaussian"}


@pytest.mark.slow
def test_a_little_study_is_trained_tested_and_resumed(tmp_path, monkeypatch):
    """Each of the trainings apart: its row has a PSNR at every place, and a second call computes nothing anew."""
    monkeypatch.setattr(study, "BASE", dataclasses.replace(study.BASE, width=4, patch=24, size=15, batch=4))
    for name, number in (("REFINED", 2), ("BANK", 8), ("TESTED", 2), ("DISTANCES", 2)):
        monkeypatch.setattr(study, name, number)
    one = study.Study("apart", tmp_path, 3.0, 0, ("cooke_triplet",), dead_leaves(10, size=48, colour=True))
    one.folder.mkdir(exist_ok=True)
    rows = [study.row_of(one, "cooke_triplet", arm, 0) for arm in study.ARMS["apart"]]
    for found in rows:
        assert all(5 < found[f"{kind}_{place:g}"] < 60 for kind in ("network", "wiener") for place in study.PLACES)
        assert found["steps"] >= 2
    stored = next(tmp_path.glob("cooke_triplet/*/0/row.json"))
    before = stored.stat().st_mtime_ns
    assert study.row_of(one, "cooke_triplet", study.ARMS["apart"][0], 0) == rows[0]
    assert stored.stat().st_mtime_ns == before
    figure = study.draw(one, rows, "together")
    assert len(figure.axes) == len(study.ARMS["apart"]) - 1

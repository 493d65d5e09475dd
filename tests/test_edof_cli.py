"""`raytrace wave edof` and `raytrace wave table` at the door."""

import json

import numpy as np
import pytest

from raytrace.cli import main
from raytrace.cli.wave import SUBCOMMANDS
from raytrace.studies.edof import report
from raytrace.studies.edof.table import ROWS


def run(capsys, *words):
    code = main(["wave", *words])
    return code, *capsys.readouterr()


def test_one_row_as_json(capsys, monkeypatch):
    monkeypatch.setattr(report, "_LEAVES", 6)
    code, out, err = run(capsys, "table", "--rows", "singlet", "fresnel", "--json")
    assert code == 0, err
    rows = json.loads(out)["rows"]
    assert {(row["content"], row["row"]) for row in rows} == {
        (content, row) for content in ("sharp leaves", "smooth leaves") for row in ("fresnel", "singlet")
    }
    for row in rows:
        assert 8 < row["wiener"] <= row["blind"] + 1 < 30
    gains = {row["row"]: row["gain_blind"] for row in rows if row["content"] == "sharp leaves"}
    assert gains["fresnel"] == 0
    assert gains["singlet"] == pytest.approx(1.8, abs=0.6)  # of forty pictures +1.8


def test_unknown_rows_are_refused(capsys):
    code, out, err = run(capsys, "table", "--rows", "holey")
    assert (code, out) == (1, "")
    assert f"--rows holey: expected {', '.join(ROWS)}" in err


@pytest.mark.slow
def test_an_element_is_learned_kept_and_gone_on_with(capsys, tmp_path):
    words = ("edof", "--element", "smooth", "--starts", "1", "--steps", "3", "-o", str(tmp_path / "run"), "--json")
    code, out, err = run(capsys, *words)
    assert code == 0, err
    outcome = json.loads(out)
    assert outcome["settings"]["kind"] == "smooth"
    assert np.load(tmp_path / "run" / "heights.npy").ndim == 2
    code, again, err = run(capsys, *words)
    assert code == 0
    assert "finished before" in err
    assert json.loads(again) == outcome
    code, out, err = run(capsys, *words[:-1], "--rate", "0.5")
    assert (code, out) == (1, "")
    assert "rate was 0.02, now 0.5" in err


def test_every_form_teaches():
    for command in SUBCOMMANDS:
        name = command.name.removeprefix("wave-")
        assert len(command.description) > 200
        assert f"raytrace wave {name}" in command.examples

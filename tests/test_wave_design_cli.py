"""`raytrace wave design` and `restore`, and the table of elements."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scripts import script

from raytrace.cli import main, wave_run
from raytrace.cli.commands import WAVE_COMMANDS as SUBCOMMANDS
from raytrace.cli.runner import CommandError
from raytrace.imaging.pictures import dead_leaves

table = script("wave_edof")
LEARNED = str(Path(__file__).parents[1] / "docs/wave/elements/learned-0.01.npy")


def run(capsys, *words):
    code = main(["wave", *words])
    return code, *capsys.readouterr()


@pytest.mark.slow
def test_one_row_as_json(capsys, monkeypatch):
    monkeypatch.setattr(wave_run, "LEAF_COUNT", 6)
    assert not table.main(["--rows", "singlet", "fresnel", "--json"])
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert {(row["content"], row["row"]) for row in rows} == {
        (content, row) for content in ("sharp leaves", "smooth leaves") for row in ("fresnel", "singlet")
    }
    for row in rows:
        assert 8 < row["wiener"] <= row["blind"] + 1 < 30
    gains = {row["row"]: row["gain_blind"] for row in rows if row["content"] == "sharp leaves"}
    assert gains["fresnel"] == 0
    assert gains["singlet"] == pytest.approx(1.8, abs=0.6)  # of forty pictures +1.8


def test_unknown_rows_are_refused():
    with pytest.raises(CommandError, match=f"--rows holey: expected {', '.join(table.ROWS)}"):
        table.main(["--rows", "holey"])


@pytest.mark.slow
def test_scenes_are_simulated_and_restored(capsys, tmp_path):
    """Behind a learned element restoration gains decibels at 0.5 m; a captured image alone has no PSNR."""
    scene = np.stack([leaves for leaves in dead_leaves(3, size=128, seed=2, smallest=3.0).samples], -1)
    Image.fromarray(scene).save(tmp_path / "scene.png")
    words = ("restore", str(tmp_path / "scene.png"), "--element", LEARNED, "-o", str(tmp_path / "out"), "--json")
    small = ("--size", "127", "--depth", "500", "1000", "inf")
    code, out, err = run(capsys, *words, *small, "--simulate", "500")
    assert code == 0, err
    (record,) = json.loads(out)["images"]
    assert record["psnr_restored"] > record["psnr_image"] + 2
    assert Image.open(tmp_path / "out" / "scene.png").size == (128, 128)
    image = str(tmp_path / "out" / "scene_image.png")
    code, out, err = run(capsys, "restore", image, *words[2:], *small)
    assert code == 0, err
    assert "psnr_image" not in json.loads(out)["images"][0]
    code, _, err = run(capsys, *words, "--size", "64")
    assert (code, "take an odd number" in err) == (1, True)
    code, _, err = run(capsys, *words, "--wavelength", "0.5", "0.6")
    assert (code, "1 or 3 channels" in err) == (1, True)


@pytest.mark.slow
def test_an_element_is_learned_kept_and_gone_on_with(capsys, tmp_path, monkeypatch):
    phases, progress = [], wave_run.progress
    monkeypatch.setattr(
        wave_run, "progress", lambda *work, what, **more: phases.append(what) or progress(*work, what=what, **more)
    )
    words = ("design", "--element", "smooth", "--starts", "1", "--steps", "3", "-o", str(tmp_path / "run"), "--json")
    code, out, err = run(capsys, *words)
    assert code == 0, err
    outcome = json.loads(out)
    assert outcome["settings"]["kind"] == "smooth"
    assert outcome["initial"]["by_depth"].keys() == outcome["by_depth"].keys()
    assert outcome["initial"]["mean"] != outcome["mean"]
    assert outcome["expected_error"].keys() == {"initial", "designed"}
    for phase in ("training pictures", "spectrum of the pictures", "initial element", "compiling the trace"):
        assert f"smooth, seed 0: {phase}" in phases
    assert "smooth, seed 0: optimisation" in phases
    assert "smooth, seed 0: image quality" in phases
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

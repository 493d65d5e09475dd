"""`raytrace codesign`: runs that resume, comparisons and their page, and errors of one line."""

import contextlib
import csv
import dataclasses
import functools
import io
import json
import os
import re
import shutil
import subprocess
import sys
import warnings
from pathlib import Path

import pytest
import torch
from PIL import Image
from scripts import script

import raytrace
from raytrace import cli
from raytrace.cli import codesign_run
from raytrace.cli.progress import Lines
from raytrace.imaging.codesign import lens_at_start
from raytrace.imaging.pictures import dead_leaves
from raytrace.imaging.training import OtherSettings
from raytrace.io import read_lens
from raytrace.settings import CodesignSettings
from raytrace.tracing.paraxial import paraxial_image_distance

study = script("codesign_study")
_LITTLE = "--depth 4 --width 4 --patch 16 --size 7 --epochs 1 --crops 4 --batch 4 --precision float32 --optimizer adam"
SMALL = tuple(_LITTLE.split(" "))
PARAXIAL = (*SMALL, "--model", "paraxial")


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """Ten pictures of 48 pixels: eight train, 32 crops, eight steps of an epoch."""
    folder = tmp_path_factory.mktemp("pictures")
    for number, sample in enumerate(dead_leaves(10, size=48).samples):
        Image.fromarray(sample).save(folder / f"{number}.png")
    return folder


@pytest.fixture
def run(command):
    """Run a subcommand of `raytrace codesign` in an empty folder: exit code, standard output, standard error."""
    return functools.partial(command, "codesign")


def read(path):
    return json.loads(Path(path).read_text())


def rows(path):
    return list(csv.DictReader(Path(path).read_text().splitlines()))


def interrupt(monkeypatch, name: str, step: int):
    """Stop like a user at a step of one of the two steps of a run."""
    run_model = codesign_run.run_model

    def interrupted(*positional, **named):
        for found, number, record in run_model(*positional, **named):
            if (found, number) == (name, step):
                raise KeyboardInterrupt
            yield found, number, record

    monkeypatch.setattr(codesign_run, "run_model", interrupted)


@pytest.fixture(scope="module")
def finished(pictures, tmp_path_factory):
    """A finished run of PARAXIAL on these pictures with its figure: folder, standard output and error, progress."""
    folder = tmp_path_factory.mktemp("finished")
    out, err, shown = io.StringIO(), io.StringIO(), []
    words = ("--data", str(pictures), *PARAXIAL, "-o", "one", "--json", "--plot", "loss.png")
    with pytest.MonkeyPatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        patch.chdir(folder)
        patch.setattr(Lines, "set_postfix_str", lambda self, text="", refresh=True: shown.append(text))
        code = cli.main(["codesign", "double_gauss", *words])
    assert code == 0, err.getvalue()
    return folder, out.getvalue(), err.getvalue(), shown


@pytest.fixture
def one(finished, tmp_path):
    """A copy of the folder of that run."""
    return shutil.copytree(finished[0] / "one", tmp_path / "one")


@pytest.fixture
def compare(capsys, tmp_path, monkeypatch):
    """Run the script of a study in an empty folder: standard output, standard error."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        script("codesign").main(list(map(str, words)))
        return capsys.readouterr()

    return run


# ---------------------------------------------------------------- one model


def test_a_run_reports_its_results(run, pictures, finished, one):
    _, out, err, _ = finished
    document, kept = json.loads(out), read("one/outcome.json")
    assert {key: document[key] for key in kept} == kept
    assert (document["model"], document["settings"]["width"], document["settings"]["patch"]) == ("paraxial", 4, 16)
    assert [float(d) for d in kept["by_distance"]] == [1e3 * z for z in (10, 15, 20, 25, 30, 35, 40, 45, 50)]
    for step in ("joint", "refine"):
        assert [int(row["step"]) for row in rows(f"one/{step}/log.csv")] == list(range(8))
    assert re.search(r"paraxial, seed 0, joint, epoch 1 of 1: loss 0\.\d+, sensor 57\.8\d+ mm, focus 2\d\.\d m\n", err)
    code, text, err = run("double_gauss", "--data", pictures, *PARAXIAL, "-o", "one", "--resume")
    assert code == 0
    assert "finished before, nothing to train" in err
    assert f"after step 2, with DRT PSFs      {kept['l1_drt']:.5f}" in text
    assert f"sensor at {kept['sensor_mm']:.4f} mm" in text


def test_a_finished_run_is_reported_without_its_pictures(run, one, monkeypatch):
    """A hundred pictures of dead leaves took a minute."""
    monkeypatch.setattr(codesign_run, "pictures_of", None)
    code, text, err = run("double_gauss", *PARAXIAL, "-o", "one", "--resume")
    assert (code, "finished before, nothing to train" in err) == (0, True)
    assert f"sensor at {read('one/outcome.json')['sensor_mm']:.4f} mm" in text
    code, _, err = run("double_gauss", *PARAXIAL, "-o", "one", "--resume", "--noise", "0.2")
    assert (code, "one/joint holds another run: noise was 0.1, now 0.2" in err) == (1, True)


@pytest.mark.slow  # by the library by default: test_camera.py
def test_a_stopped_run_resumes_to_the_same_end(run, pictures, monkeypatch):
    command = ("double_gauss", "--data", pictures, *SMALL, "--model", "paraxial", "--vary", "sensor", "thickness:5")
    assert run(*command, "-o", "whole")[0] == 0
    for step in (("joint", 5), ("refine", 3)):
        with monkeypatch.context() as patch:
            interrupt(patch, *step)
            code, out, err = run(*command, "-o", "parts")
            assert (code, out, err.splitlines()[-1]) == (130, "", "raytrace: error: interrupted")
    code, _, err = run(*command, "-o", "parts", "--resume")
    assert code == 0
    assert "resumes after step 8 of 16" in err
    for name in ("outcome.json", "joint/log.csv", "refine/log.csv"):
        assert Path(f"parts/{name}").read_bytes() == Path(f"whole/{name}").read_bytes()
    found = read("whole/outcome.json")
    assert set(found["variables"]) == {"sensor", "thickness_5"}
    code, out, err = run(*command, "--noise", "0.2", "-o", "parts")
    assert (code, out) == (1, "")
    assert "parts/joint holds another run: noise was 0.1, now 0.2; choose another folder" in err
    assert len(err.splitlines()) == 1


@pytest.mark.slow
def test_a_run_as_built_resumes_and_lists_its_perturbed_cameras(run, pictures, monkeypatch):
    few = ("--limits", "thickness=0.1", "element_decenter=0.05", "--rays", "20", "--drt-rays", "20", "--cameras", "2")
    command = ("double_gauss", "--data", pictures, *SMALL, "--center", "chief", *few, "--as-built")
    code, text, err = run(*command, "-o", "whole")
    assert code == 0, err
    with monkeypatch.context() as patch:
        interrupt(patch, "joint", 5)
        assert run(*command, "-o", "parts")[0] == 130
    assert run(*command, "-o", "parts", "--resume")[0] == 0
    for name in ("outcome.json", "joint/log.csv", "refine/log.csv"):
        assert Path(f"parts/{name}").read_bytes() == Path(f"whole/{name}").read_bytes()
    found = read("whole/outcome.json")
    assert [*found["l1_as_built"]] == [*found["psnr_as_built"]] == ["1", "2"]
    assert "2 perturbed cameras that training never draws, mean ± standard deviation (trained as built):" in text
    assert f"{sum(found['l1_as_built'].values()) / 2:.5f} ± " in text
    code, _, err = run(*command[:-1], "-o", "parts")
    assert code == 1
    assert "parts/joint holds another run: as_built was True, now False; choose another folder" in err


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--as-built",), "the lens has no tolerances of its own: give --limits, as .* or --grade, as"),
        (("--limits", "radius:40=0.1%"), "surface 40"),
        (("--grade", "precison"), "invalid choice: 'precison'"),
        (("--grade", "high", "--model", "paraxial"), "model 'paraxial' traces no rays of a lens as built"),
        (("--grade", "high", "--loss", "spectral"), "--as-built, --grade and --limits belong to training"),
        (("--turns", "1", "--loss", "spectral"), "--turns belongs to training"),
        (("--grade", "high", "--rays", "20"), "not supported with fixed pupil points .*: give center chief"),
    ],
)
def test_wrong_tolerances_of_a_run_are_refused(run, pictures, words, message):
    code, out, err = run("double_gauss", "--data", pictures, *SMALL, "-o", "none", *words)
    assert (code in (1, 2), out) == (True, "")
    assert re.search(message, err), err
    assert not Path("none").exists()


def test_other_pictures_are_another_run(run, pictures, one):
    code, _, err = run("double_gauss", "--data", pictures, *PARAXIAL, "-o", "one", "--limit", "9")
    assert code == 1
    assert re.fullmatch(r"raytrace: error: one/joint holds another run: pictures was '10, .*', now '9, .*\n", err)


def test_without_pictures_leaves_are_made(run):
    code, out, err = run("double_gauss", "--loss", "spectral", "--model", "paraxial", "--limit", "5", "--json")
    assert code == 0
    assert "training on 5 pictures of dead leaves" in err
    found = json.loads(out)
    assert found["course"][0] > found["error"] == pytest.approx(min(found["course"]), rel=1e-6)
    assert found["error_drt"] > found["error"]
    assert found["focus_paraxial_m"] > 25


def test_objects_without_an_image_are_refused(run, pictures):
    """10 to 50 m lie within the focal length of 57.6 m: no sensor distance is an answer."""
    code, out, err = run("hubble", "--data", pictures, "--loss", "spectral")
    assert (code, out) == (1, "")
    assert "hubble: no real image of an object at 10000 mm: it lies within the focal length" in err
    assert "give --near, --far and --focus-distance beyond the focal length" in err
    assert len(err.splitlines()) == 1


@pytest.mark.slow
def test_the_learned_lens_is_a_file_that_traces(run, command, pictures):
    """Of the closed form and of a run; the file holds the sensor that was said, and its spots are small."""
    options = ("--data", pictures, *PARAXIAL, "--crops", "1", "--wavelength", "0.53", "0.62")
    code, out, err = run("double_gauss", *options, "--loss", "spectral", "-o", "learned.zmx", "--json")
    assert code == 0, err
    found, lens = json.loads(out), read_lens("learned.zmx")
    assert found["settings"]["wavelengths"] == lens.wavelengths.tolist() == [0.53, 0.62]
    assert float(lens.surfaces[-2].thickness) == found["sensor_mm"]
    assert (found["penalty"], found["no_optimum"], found["at_end"]) == (0.0, "", [])
    code, out, err = command("spot", "learned.zmx", "--json")
    assert code == 0, err
    assert "rms" in out
    code, out, err = run("double_gauss", *options, "-o", "run.zmx", "--json")
    assert code == 0, err
    assert float(read_lens("run.zmx").surfaces[-2].thickness) == json.loads(out)["sensor_mm"]
    assert float(read_lens("run/lens.zmx").surfaces[-2].thickness) == read("run/outcome.json")["sensor_mm"]


@pytest.mark.slow
def test_wavelengths_of_the_file_are_an_option(run, pictures):
    options = ("--data", pictures, *SMALL, "--model", "paraxial", "--loss", "spectral", "--json")
    lens = read_lens(raytrace.files.shipped("lenses") / "cooke_triplet.zmx")
    code, out, err = run("cooke_triplet", *options, "--file-wavelengths")
    assert code == 0, err
    settings = json.loads(out)["settings"]
    assert sorted(settings["wavelengths"]) == sorted(lens.wavelengths.tolist())
    assert settings["wavelengths"][0] == float(lens.primary)
    code, _, err = run("cooke_triplet", *options, "--file-wavelengths", "--wavelength", "0.5")
    assert code == 1
    assert "leave out --wavelength" in err


@pytest.mark.slow
def test_the_penalty_is_reported_with_the_loss(run, pictures):
    """Elements thinner than 0.3 mm and thicker than 0.9 mm, of glasses without names; on every row of the log."""
    options = ("--data", pictures, *PARAXIAL, "--crops", "1", "--vary", "sensor", "--json")
    code, out, err = run("phone", *options, "--glass-thickness", "0.3:0.9", "--edge", "0.1", "-o", "thin")
    assert code == 0, err
    found = json.loads(out)
    surfaces = read_lens("thin/lens.zmx").surfaces
    glass = [float(surfaces[k].thickness) for k in (2, 4, 6, 8, 10, 12, 14)]
    expected = sum(max(0, 0.3 - t) ** 2 + max(0, t - 0.9) ** 2 for t in glass)
    assert found["penalty"] == pytest.approx(expected, rel=1e-3)
    assert found["limits"]["glass"] == [0.3, 0.9]
    log = rows("thin/joint/log.csv")
    assert all(float(row["penalty"]) == pytest.approx(found["penalty"], rel=1e-12) for row in log)
    code, text, _ = run("phone", *options[:-1], "--glass-thickness", "0.3:0.9", "--edge", "0.1", "-o", "thin")
    assert (
        f"penalty {found['penalty']:.6g} mm², not part of the loss; thicknesses: glass 0.3 to 0.9, its edge 0.1" in text
    )
    code, _, err = run("phone", *options, "--glass-thickness", "0.9:0.3", "-o", "wrong")
    assert code == 1
    assert "'0.9:0.3': expected 0 ≤ least < greatest" in err


@pytest.mark.slow
def test_a_run_begins_where_the_closed_form_ends(run, pictures):
    """One command: the log of the training begins where `--loss spectral` ends."""
    command = ("double_gauss", "--data", pictures, *SMALL, "--model", "paraxial", "--rho", "0.3", "-o", "one")
    assert run(*command, "--loss", "spectral")[0] == 0
    code, _, err = run(*command, "--start", "spectral")
    assert code == 0, err
    assert float(rows("one/joint/log.csv")[0]["sensor"]) == read("one/spectral.json")["sensor_mm"]
    # The sensor's bounds reach both.
    bounded = (*command[:-1], "two", "--bounds", "sensor:57.85,58")
    code, _, err = run(*bounded, "--loss", "spectral")
    message = "no optimum inside sensor from 57.85 to 58: the loss still falls at its end"
    assert (code, err.splitlines()[-1]) == (1, f"raytrace: error: {message}")
    assert read("two/spectral.json")["no_optimum"] == message
    assert read("two/spectral.json")["at_end"] == ["sensor"]
    code, _, err = run(*bounded, "--start", "spectral")
    assert code == 0, err
    assert f"start spectral: {message}" in err
    assert read("two/spectral.json")["sensor_mm"] == pytest.approx(57.85, abs=1e-9)
    assert min(float(row["sensor"]) for row in rows("two/joint/log.csv")) >= 57.85 - 1e-9
    assert read("one/spectral.json")["sensor_mm"] < 57.84


@pytest.mark.slow
def test_a_lens_by_steps_of_second_order_stays_while_the_network_is_trained(run, pictures):
    """The lens of every step of the training is the optimum of `--loss spectral` with the same optimizer."""
    command = ("double_gauss", "--data", pictures, *PARAXIAL, "--optimizer", "lm", "-o", "one")
    assert run(*command, "--loss", "spectral")[0] == 0
    code, _, err = run(*command)
    assert code == 0, err
    sensors = [float(row["sensor"]) for row in rows("one/joint/log.csv")]
    assert sensors == pytest.approx([read("one/spectral.json")["sensor_mm"]] * len(sensors), abs=1e-9)


@pytest.mark.slow
def test_spots_between_the_fields_of_a_codesign_are_said(run, pictures):
    options = ("--patch", "16", "--size", "7", "--loss", "spectral", "--model", "paraxial", "--field", "0", "12")
    code, out, err = run("cooke_triplet", "--data", pictures, *options)
    assert code == 0, err
    assert "to the spots of the fields and wavelengths of the loss:" in out
    (spot,) = json.loads(run("cooke_triplet", "--data", pictures, *options, "--json")[1])["between"]
    assert spot["samples"] == "fields"
    assert spot["radius"] > 0


def test_spots_much_larger_between_the_fields_of_a_codesign_are_warned_of():
    """A field of tangential focus at its edge: halfway spots are those of `rt.spot`."""
    lens, settings = read_lens("double_gauss"), CodesignSettings(fields=(0.0, 14.0), near=1e4, far=1e5)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", raytrace.WorseBetween)
        (gap,) = codesign_run._between_fields(lens, settings)
    view = lens.at(fields=[7], wavelengths=[*settings.wavelengths], object_distance=2 / (1e-4 + 1e-5))
    assert gap.radius == pytest.approx(float(raytrace.spot(view).whole.rms_radius), rel=1e-6)
    assert codesign_run._between_fields(lens, dataclasses.replace(settings, fields=(0.0,))) == ()
    assert codesign_run._between_fields(lens, dataclasses.replace(settings, sensor=(24.0, 16.0))) == ()


@pytest.mark.slow
def test_spectral_at_infinity_is_valid_json(run, pictures):
    """A sensor kept 0.4 mm nearer than the focal plane: null in the file and in --json, "infinity" in words."""
    command = ("double_gauss", "--data", pictures, "--loss", "spectral", "--patch", "16", "--size", "7")
    bounded = (*command, "--model", "paraxial", "--start", "57.1", "--bounds", "sensor:57,57.1", "-o", "closed")
    code, out, err = run(*bounded, "--json")
    assert code == 1
    assert "error: no optimum inside sensor from 57 to 57.1: the loss still falls at its end" in err
    kept = Path("closed/spectral.json").read_text()
    for document in (json.loads(text, parse_constant=pytest.fail) for text in (out, kept)):
        assert document["focus_paraxial_m"] is document["focus_rms_m"] is None
    assert "in focus: infinity (paraxial), infinity (least RMS spot)" in run(*bounded)[1]


def test_progress_counts_the_batches_of_a_test(finished):
    *_, shown = finished
    assert shown.count("testing, batch 2 of 2") == 3 + 9
    assert any(text.startswith("refine, loss 0.") for text in shown)


@pytest.mark.slow
def test_the_closed_form_prints_its_course_and_draws_it_as_training_does(run, pictures, finished):
    command = ("double_gauss", "--data", pictures, "--loss", "spectral", "--patch", "16", "--size", "7")
    code, out, err = run(*command, "-o", "closed", "--batch", "4", "--plot", "loss.png")
    assert code == 0, err
    found = read("closed/spectral.json")
    assert len(re.findall(r"^ +\d+ +0\.\d{8} +0$", out, re.M)) == len(found["course"])
    assert f"sensor at {found['sensor_mm']:.4f} mm" in out
    assert f"{found['focus_rms_m']:.2f} m (least RMS spot)" in out
    for folder in (finished[0], Path()):
        assert (folder / "loss.png").read_bytes().startswith(b"\x89PNG")


WRONG = {
    "folder": (["--data", "nowhere"], "nowhere: no such folder"),
    "empty": (["--data", "."], r"\.: no pictures found"),
    "small": (["--patch", "64"], "none of 10 pictures has 70 × 70 pixels"),
    "variables": (["--vary", "radius:3"], "'radius:3': expected a number of a lens; did you mean curvature"),
    "surface": (["--vary", "thickness:99"], "surface 99; this lens has surfaces 1 to 11 to vary"),
    "range": (["--near", "60000"], "--near 60000 is not nearer than --far 50000"),
    "start": (
        ["--start", "somewhere"],
        "start 'somewhere': expected paraxial, rms, spectral, gaussian or a sensor distance in mm",
    ),
    "depth": (["--depth", "3"], "expected an even depth"),
    "batch": (["--batch", "99"], "8 pictures to train on, 4 crops of each, do not fill one batch of 99"),
    "resume": (["--resume"], "out: no run was started here"),
    "number": (
        ["--rate-network", "1e30", "--normalise", "energy"],
        r"step \d: (the loss is nan|a gradient is not finite); lower the learning rate; no checkpoint",
    ),
    "bounds": (["--bounds", "sensor:58"], "'sensor:58': expected a variable and its bounds, like thickness_5:8..12"),
    "bounded": (["--bounds", "thickness_5:8,12"], "bounds for thickness_5, not among the variables"),
    "field": (["--field", "95"], "a field angle is below 90 degrees"),
}


@pytest.mark.parametrize(("options", "message"), WRONG.values(), ids=WRONG)
def test_errors_are_one_line(run, pictures, options, message):
    code, out, err = run("double_gauss", "--data", pictures, *SMALL, "--model", "paraxial", "-o", "out", *options)
    assert (code, out, len(err.splitlines())) == (1, "", 1), err
    assert re.match(f"raytrace: error: .*{message}", err)
    assert "a defect" not in err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("double_gauss",), "no folder to keep the run in: give -o FOLDER"),
        (("double_gauss", "--loss", "spectral", "--resume", "-o", "out"), "--resume belongs to training"),
    ],
)
def test_words_and_options_that_do_not_fit(run, arguments, message):
    code, out, err = run(*arguments)
    assert (code, out, len(err.splitlines())) == (1, "", 1), err
    assert message in err


@pytest.mark.slow
def test_two_processes_find_the_minima_of_one(run, pictures, tmp_path):
    """Only the order of float32 sums differs: losses agree to 1e-4, and one process speaks."""
    command = ("double_gauss", "--data", str(pictures), *SMALL, "--model", "paraxial")
    assert run(*command, "-o", "one")[0] == 0
    torchrun = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2"]
    words = [*torchrun, "-m", "raytrace", "codesign", *command, "-o", str(tmp_path / "two"), "--json"]
    environment = {**os.environ, "PYTHONPATH": str(Path(raytrace.__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, capture_output=True, text=True, timeout=120, env=environment)
    assert done.returncode == 0, done.stderr
    one, two = read("one/outcome.json"), read("two/outcome.json")
    assert json.loads(done.stdout)["l1_drt"] == two["l1_drt"]
    for key in ("l1_joint", "l1_before", "l1_drt", "sensor_mm"):
        assert two[key] == pytest.approx(one[key], rel=1e-4)
    logs = [rows(f"{folder}/refine/log.csv") for folder in ("one", "two")]
    assert len(logs[0]) == len(logs[1]) == 8


# ---------------------------------------------------------------- compare


def test_a_study_that_was_not_started_is_refused(compare):
    for options in (("--report-only",), ("--resume",)):
        with pytest.raises(codesign_run.CommandError, match="out: no study was started here"):
            compare("double_gauss", "-o", "out", *options)
    with pytest.raises(codesign_run.CommandError, match="give -o FOLDER"):
        compare("double_gauss")
    with pytest.raises(codesign_run.CommandError, match="add paraxial to --models"):
        compare("double_gauss", *SMALL, "--limit", 5, "-o", "out", "--models", study.AFTER_PARAXIAL)


@pytest.mark.slow
def test_compare_writes_the_table_and_the_page(compare, pictures):
    """Paraxial, and Gaussian DRT begun where that ended; then the page again with a seed that is missing."""
    after = study.AFTER_PARAXIAL
    options = ("--data", pictures, "-o", "study", "--docs", "docs")
    again = (*SMALL, "--models", after, "paraxial", "--seeds", "3", "--json")
    document = json.loads(compare("double_gauss", *options, *again).out)
    kept = {model: read(f"study/{model}-3/outcome.json") for model in ("paraxial", after)}
    table = rows("docs/codesign/table2.csv")
    assert [row["model"] for row in table] == ["paraxial", after]
    for row in table:
        assert tuple(row) == study.COLUMNS
        of_file = [key for key in study.COLUMNS[1:] if "last_epochs" not in key]
        assert {key: float(row[key]) for key in of_file} == {key: kept[row["model"]][key] for key in of_file}
        with open(f"study/{row['model']}-3/joint/log.csv", newline="") as file:
            course = [float(step["sensor"]) for step in csv.DictReader(file)]
        assert float(row["sensor_last_epochs_mm"]) == pytest.approx(sum(course) / len(course))  # of one epoch
        assert float(row["sensor_range_last_epochs_mm"]) == pytest.approx(max(course) - min(course))
    begun = read(f"study/{after}-3/joint/settings.json")
    assert (begun["model"], float(begun["start"])) == ("gaussian", kept["paraxial"]["sensor_mm"])
    assert [row["sensor_mm"] for row in document["rows"]] == [kept[model]["sensor_mm"] for model in kept]
    assert document["missing"] == []
    assert {claim["answer"] for claim in document["claims"]} == {"not applicable"}
    page = Path("docs/codesign.md").read_text(encoding="utf-8")
    for name in re.findall(r"\(codesign/(\w+\.\w+)\)", page):
        if name == "sweep.csv":  # of a study of its own, which the page keeps
            continue
        assert Path("docs/codesign", name).read_bytes().startswith(b"\x89PNG") == name.endswith(".png")
    assert {"loss.png", "focus.png", "blur.png", "distance.png", "examples.png", "scan.png"} <= set(
        re.findall(r"\w+\.png", page)
    )
    one = kept["paraxial"]
    assert f"| paraxial | 1 | {one['l1_joint']:.4f} | {one['l1_drt']:.4f} |" in page
    optimum = rows("docs/codesign/spectral.csv")
    assert [row["model"] for row in optimum] == ["paraxial", after]
    assert [one["model"] for one in document["closed_form"]] == ["paraxial", after]
    assert f"| {float(optimum[0]['sensor_mm']):.4f} | {one['sensor_mm']:.4f} |" in page
    assert "| 0.0415 | 0.0504 | 33.9 |" in page
    claims = rows("docs/codesign/claims.csv")
    assert len(claims) == 21
    assert "Gaussian DRT is not among the models of this study" in {row["figures"] for row in claims}
    # The page of a study with a seed that is missing, and words written by hand.
    assert page.endswith("again -->\n")
    Path("docs/codesign.md").write_text(f"{page}\nWritten by hand.\n", encoding="utf-8")
    out = compare("double_gauss", *options, "--report-only", "--models", "paraxial", "--seeds", "3", "4").out
    new = Path("docs/codesign.md").read_text(encoding="utf-8")
    assert "**Unfinished: 1 of 2 runs.** Missing, by model and seed: paraxial 4." in new
    assert new.endswith("Written by hand.\n")
    assert "not finished: paraxial 4" in out
    assert len(rows("docs/codesign/table2.csv")) == 1
    with pytest.raises(OtherSettings, match=r"study .*noise was 0\.1, now 0\.2"):
        compare("double_gauss", *options, *SMALL, "--noise", "0.2", "--models", "paraxial", "--seeds", "3")


@pytest.mark.slow
def test_precision_that_was_found_is_kept(run, pictures, monkeypatch):
    """A machine that would choose otherwise the second time goes on with the first choice."""
    monkeypatch.setattr(codesign_run, "faster_precision", lambda shape: "float32")
    options = [word for word in SMALL if word not in ("--precision", "float32")]
    command = ("double_gauss", "--data", pictures, *options, "--model", "paraxial", "-o", "one", "--json")
    first = json.loads(run(*command)[1])
    monkeypatch.setattr(codesign_run, "faster_precision", lambda shape: "bfloat16")
    assert json.loads(run(*command)[1]) == first


def test_focus_of_a_sensor_is_its_paraxial_conjugate():
    """There and back: the paraxial image of an object, and the object of that image, to 0.01 %."""
    lens = read_lens(codesign_run.find_lens("double_gauss"))
    focus = codesign_run.focus_of(lens, CodesignSettings())
    begun = lens_at_start(lens, CodesignSettings())
    for distance in (12.0, 25.0, 33.9):
        image = paraxial_image_distance(begun, torch.tensor(1e3 * distance, dtype=torch.float64))
        assert focus(float(image)) == pytest.approx(distance, rel=1e-4)
    assert codesign_run.focus_of(lens, CodesignSettings(vary="sensor thickness:5")) is None


@pytest.mark.slow
def test_ray_aiming_is_a_setting_of_a_run(run, pictures):
    """The learned lens and the record of the settings have the aiming that the option specifies."""
    options = ("retrofocus", "--ray-aiming", "real", "--data", pictures, *SMALL, "-o", "run")
    assert run(*options)[0] == 0
    assert read("run/joint/settings.json")["ray_aiming"] == "real"
    assert read_lens("run/lens.zmx").ray_aiming == "real"


def test_a_lens_is_aimed_before_training():
    """As the option specifies, by default as its file does."""
    lens = read_lens("retrofocus").at(ray_aiming="paraxial")
    settings = {aiming: CodesignSettings(ray_aiming=aiming) for aiming in (None, "off", "real")}
    aimed = {aiming: lens_at_start(lens, setting).ray_aiming for aiming, setting in settings.items()}
    assert aimed == {None: "paraxial", "off": "off", "real": "real"}

"""The sweep of the closed form: what is varied, what the answer says of known optima, table, page and command."""

import csv
import dataclasses
import json
import math
import re
from pathlib import Path

import pytest
import torch
from PIL import Image

from raytrace.cli import main
from raytrace.files import shipped, write_table
from raytrace.io import read_lens
from raytrace.pages import KEPT, kept_of, markdown
from raytrace.stores import DamagedLine
from raytrace.studies.codesign import sweep as module
from raytrace.studies.codesign.closed_form import power_spectrum
from raytrace.studies.codesign.figures import sweep_figure
from raytrace.studies.codesign.optima import Optimum, closed_form
from raytrace.studies.codesign.settings import Settings
from raytrace.studies.codesign.setup import Experiment
from raytrace.studies.codesign.sweep import COLUMNS, COMBINED, DEFAULT, Kept, Row, cases, distinct, readings, sweep
from raytrace.studies.codesign.sweep_page import Sweep
from raytrace.studies.codesign.sweep_parts import answers, beam
from raytrace.studies.pictures import dead_leaves

SMALL = Settings(depth=2, width=2, patch=16, size=7, crops=2)


def row(factor, value, model, paraxial, rms, *, error_drt=0.01, sensor=57.8):
    return Row(model, sensor, paraxial, rms, 0.009, error_drt, factor=factor, value=value)


def found_of(rows, lens="double_gauss"):
    """A sweep of six pictures that found these rows."""
    pictures = dead_leaves(6, size=8)
    given = Experiment(lens=None, name=lens, settings=SMALL, train=pictures, test=pictures, about={}, kind="pictures")
    return Sweep(rows, given, of_paper=True)


def known(**gaussian):
    """A default and one other reading (F/4); gaussian: both focus distances of Gaussian DRT by reading."""
    default, other = gaussian["default"], gaussian["other"]
    return [
        row(DEFAULT, "as set", "paraxial", 34.0, 20.0, error_drt=0.012, sensor=57.81),
        row(DEFAULT, "as set", "fourier", 35.0, 21.0, error_drt=0.0125, sensor=57.80),
        row(DEFAULT, "as set", "gaussian", *default, error_drt=0.011, sensor=57.71),
        row(DEFAULT, "as set", "drt", 60.0, 25.0, error_drt=0.010, sensor=57.72),
        row("f_number", "4", "paraxial", 33.0, 22.0, error_drt=0.012, sensor=57.85),
        row("f_number", "4", "fourier", 34.5, 22.0, error_drt=0.012, sensor=57.84),
        row("f_number", "4", "gaussian", *other, error_drt=0.010, sensor=57.75),
        row("f_number", "4", "drt", 50.0, 25.0, error_drt=0.010, sensor=57.76),
    ]


def changes(settings, base):
    """The settings that are not as in the base, but for the model."""
    names = [field.name for field in dataclasses.fields(Settings) if field.name != "model"]
    return {name for name in names if getattr(settings, name) != getattr(base, name)}


def test_every_factor_is_varied_alone_and_some_with_the_aperture():
    base = dataclasses.replace(SMALL, tol=0.02)
    seen = {}
    for case in cases(base):
        changed = changes(case.settings, base)
        if case.factor == COMBINED:
            assert changed <= {"f_number", "noise", "normalise", "spread"} or changed <= {
                "f_number",
                "rays",
                "sampling",
            }
        else:
            assert changed <= ({"rays", "sampling"} if case.factor == "hexapolar" else {case.factor})
            seen.setdefault((case.factor, case.settings.model), []).append(case.value)
    apertures = seen["f_number", "gaussian"]
    assert {"1.6", "1.74", "1.76", "1.78", "1.8", "2", "3", "4", "5", "6.5"} <= set(apertures)
    assert apertures == seen["f_number", "drt"] == sorted(apertures, key=float)
    assert seen["rho", "paraxial"] == ["0.3", "0.5", "0.7"]
    assert {model for factor, model in seen if factor == "rho"} == {"paraxial"}
    assert seen["noise", "drt"] == ["0.01", "0.1"]
    assert seen["normalise", "fourier"] == ["window", "energy"]
    assert seen["spread", "paraxial"] == ["uniform", "reciprocal"]
    assert seen["start", "paraxial"] == ["paraxial", "rms"]
    assert seen["rays", "gaussian"] == seen["hexapolar", "drt"] == ["12", "50", "256"]
    assert {model for factor, model in seen if factor in ("rays", "hexapolar")} == {"gaussian", "drt"}


def test_what_does_not_reach_a_model_is_no_other_case_of_it(monkeypatch):
    """Plain rays are of traced models, ρ of paraxial optics: of the others the same optimum is looked up."""
    monkeypatch.setattr(module, "TOGETHER", {("f_number", "rays"): (1.76, 3.0)})
    together = [case for case in cases(SMALL) if case.factor == COMBINED and "rays" in case.value]
    assert {case.settings.rays for case in together if case.settings.model in ("paraxial", "fourier")} == {None}
    assert {case.settings.rays for case in together if case.settings.model == "drt"} == {12, 50, 256}


def test_rows_are_the_optima_and_none_is_sought_twice(monkeypatch, tmp_path):
    """Two factors of a small window: the rows against `closed_form` itself."""
    monkeypatch.setattr(module, "MODELS", ("gaussian",))
    factors = [dataclasses.replace(one, models=("gaussian",)) for one in module.FACTORS if one.name != "rho"]
    factors = [one for one in factors if one.name in ("noise", "start")]
    factors = [one if one.name == "start" else dataclasses.replace(one, values=(0.01,)) for one in factors]
    sought = []
    monkeypatch.setattr(module, "closed_form", lambda *given: sought.append(given[1]) or closed_form(*given))
    lens = read_lens(shipped("lenses") / "double_gauss.zmx")
    spectrum = power_spectrum(dead_leaves(4, size=48), 22)
    rows = sweep(lens, SMALL, spectrum, factors=factors)
    assert len(sought) == len(set(sought)) == 3  # default, less noise, start at the best spot
    expected = closed_form(lens, dataclasses.replace(SMALL, noise=0.01), spectrum)
    (found,) = (one for one in rows if one.value == "0.01" and one.factor == "noise")
    assert (found.sensor_mm, found.error_drt) == (expected.sensor_mm, expected.error_drt)
    # Less noise, less error; and the optimum is no matter of the start: to a micrometre.
    default, less, begun, best = rows
    assert less.error < default.error
    assert (begun.value, best.value) == ("paraxial", "rms")
    assert best.sensor_mm == pytest.approx(begun.sensor_mm, abs=1e-3)
    assert begun.sensor_mm == default.sensor_mm
    write_table(tmp_path / "sweep.csv", rows, COLUMNS)
    with open(tmp_path / "sweep.csv", newline="") as file:
        read = list(csv.DictReader(file))
    assert tuple(read[0]) == COLUMNS == (
        "factor", "value", "model", "sensor_mm", "focus_paraxial_m", "focus_rms_m", "error", "error_drt",
        "penalty", "no_optimum", "downhill_mm",
    )  # fmt: skip
    assert [float(one["sensor_mm"]) for one in read] == [one.sensor_mm for one in rows]


def test_a_factor_that_does_not_reach_a_model_leaves_it_as_it_was():
    rows = [*known(default=(100.0, 31.0), other=(55.0, 30.0)), row("rho", "0.3", "paraxial", 31.0, 18.0)]
    found = {one.text: one for one in readings(rows)}
    assert list(found) == ["as set", "F/4", "ρ 0.3"]
    assert found["ρ 0.3"].of["gaussian"] is found["as set"].of["gaussian"]
    assert found["ρ 0.3"].of["paraxial"].focus_paraxial_m == 31.0
    assert found["as set"].penalty("paraxial") == pytest.approx(0.2)
    assert found["F/4"].penalty("gaussian") == 0
    repeated = [*rows, *(dataclasses.replace(one, factor="noise", value="0.1") for one in rows[:4])]
    assert [one.text for one in distinct(readings(repeated))] == ["as set", "F/4", "ρ 0.3"]


def test_the_papers_numbers_answer_yes_by_the_definition_that_has_them():
    by_paraxial = answers(readings(known(default=(100.0, 31.0), other=(27.0, 30.0))))
    assert [one.appears for one in by_paraxial] == [True, False, False]
    one = by_paraxial[0]
    assert (one.readings, one.nearer, one.closest, one.focus) == (2, 1, "F/4", (33.0, 34.5, 27.0))
    assert (one.least, one.greatest, one.appear_in) == (-6.0, 66.0, 1)
    by_own = answers(readings(known(default=(math.inf, 28.0), other=(55.0, 30.0))))
    assert [one.appears for one in by_own] == [False, False, True]
    assert by_own[0].greatest == math.inf  # the default, at infinity
    assert by_own[2].closest == "as set"
    neither = answers(readings(known(default=(100.0, 31.0), other=(55.0, 30.0))))
    assert [one.appears for one in neither] == [False] * 3
    assert [one.nearer for one in neither] == [0, 0, 2]


def test_all_three_numbers_must_appear_together():
    """Two of the three, each to 2 m, are no answer."""
    rows = known(default=(100.0, 31.0), other=(27.0, 30.0))
    far = [dataclasses.replace(one, focus_paraxial_m=39.0) if one.model == "fourier" else one for one in rows]
    assert not answers(readings(far))[0].appears


def test_the_page_answers_and_keeps_what_was_written_below():
    rows = known(default=(math.inf, 31.0), other=(55.0, 30.0))
    text = markdown(found_of(rows).parts(), "By hand.")
    command = text.splitlines()[2].strip()
    assert command.startswith("raytrace codesign sweep double_gauss --data DIR --docs docs ")
    assert "--patch 16" in command
    assert "**No.** In no reading do the paper's 33.9, 35.7, 27.3 m appear" in text
    assert "nearer one when focus is each model's own (in 2 of 2 readings)" in text
    assert "| as set | 34.0 / 20.0 | 35.0 / 21.0 | ∞ / 31.0 | 60.0 / 25.0 | -100 |" in text
    assert "| F/4 | +20.0 % | +20.0 % | +0.0 % | +0.0 % |" in text
    # √(0.012/0.009) - 1 to √(0.0125/0.009) - 1
    claim = "| traced, the simple models err +21.4 % and +24.8 % more, to 5 points | 0 of 2 |"
    assert f"{claim} +15.5 % to +15.5 % and +15.5 % to +17.9 % | 0 of 0 | – |" in text
    assert kept_of(text) == "By hand."
    yes = markdown(found_of(known(default=(27.0, 31.0), other=(55.0, 30.0))).parts())
    assert (
        "**Yes, in 1 of 2 readings, in 1 of them with a gain.** Each reading is tried with 3 definitions of focus"
        in yes
    )
    assert "The paper's 33.9, 35.7, 27.3 m appear, to 2 m, when focus is the paraxial conjugate" in yes
    assert "root of the error (as set: +" in yes
    assert "## Where the descent" not in yes
    elsewhere = [dataclasses.replace(one, downhill_mm=one.sensor_mm + 0.1 * (one.model == "drt")) for one in rows]
    assert "| F/4 | DRT | 57.7600 | 57.8600 | 50.0 |" in markdown(found_of(elsewhere).parts())


@pytest.mark.parametrize(("distance", "told"), [(25e3, "25 m"), (4e3, "4 m"), (math.inf, "infinity")])
def test_vignetting_is_of_the_beam_from_the_distance_of_focus(lens, distance, told):
    settings = dataclasses.replace(SMALL, focus_distance=distance)
    _, table, about = beam(dataclasses.replace(found_of([]).given, settings=settings, lens=lens))
    assert about.startswith(f"Of the beam on the axis from {told}, by the semi-diameters")
    assert "| F/1.6 |" in table


def test_the_published_page_is_what_its_table_says():
    """Above the mark to the letter, from the rows of sweep.csv."""
    docs = Path(__file__).parents[1] / "docs"
    words = {"factor", "value", "model", "no_optimum"}
    with open(docs / "codesign" / "sweep.csv", newline="") as file:
        read = list(csv.DictReader(file))
    rows = [Row(**{key: text if key in words else float(text) for key, text in one.items()}) for one in read]
    with open(docs / "codesign" / "scale.csv", newline="") as file:
        scales = list(csv.DictReader(file))
    lens = read_lens(shipped("lenses") / "double_gauss.zmx")
    given = dataclasses.replace(found_of(rows).given, settings=Settings(), train=range(960), lens=lens)
    page = (docs / "codesign_sweep.md").read_text(encoding="utf-8")
    assert markdown(Sweep(rows, given, of_paper=True, scales=scales).parts(), kept_of(page)) == page


def test_the_figure_has_a_panel_for_each_factor_and_definition_and_a_place_for_infinity():
    rows = [*known(default=(100.0, 31.0), other=(math.inf, 30.0)), row("rho", "0.3", "paraxial", 31.0, 18.0)]
    figure = sweep_figure(found_of(rows))
    assert len(figure.axes) == 4
    aperture = figure.axes[0]
    assert [text.get_text() for text in aperture.get_xticklabels()] == ["F/4"]
    ((gaussian,),) = (line.get_ydata() for line in aperture.lines if line.get_label() == "Gaussian DRT")
    assert gaussian == 0  # -1/∞
    assert "∞" in [text.get_text() for text in aperture.get_yticklabels()]
    assert [line.get_label() for line in figure.axes[1].lines if not line.get_label().startswith("_")] == ["paraxial"]


@pytest.fixture
def quick(monkeypatch, tmp_path):
    """The command with optima that cost nothing, in an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RAYTRACE_TRACEBACK", raising=False)

    def instantly(lens, settings, spectrum):
        assert spectrum.dtype == torch.float64
        far = settings.model == "gaussian" and settings.noise == 0.01
        return Optimum(settings.model, 57.8, math.inf if far else 33.0, 20.0, 0.01, 0.01)

    monkeypatch.setattr(module, "closed_form", instantly)


def test_the_command_writes_table_figure_and_page(quick, capsys):
    command = ["codesign", "sweep", "double_gauss", "--limit", "2", "--docs", "docs"]
    assert main([*command, "--json"]) == 0
    out, err = capsys.readouterr()
    document = json.loads(out, parse_constant=pytest.fail)
    assert len(document["rows"]) == len(cases(Settings()))
    assert {one["focus_paraxial_m"] for one in document["rows"] if one["value"] == "0.01"} == {33.0, None}
    assert {one["scale"] for one in document["scales"]} == set(module.SCALES)
    assert [one["appears"] for one in document["answers"]] == [False] * 3
    assert err.endswith("raytrace: written: docs/codesign_sweep.md\n")
    text = Path("docs/codesign_sweep.md").read_text(encoding="utf-8")
    with open("docs/codesign/sweep.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == len(document["rows"])
    for name in re.findall(r"\((codesign/sweep\.\w+)\)", text):
        assert (Path("docs") / name).stat().st_size > 0
    Path("docs/codesign_sweep.md").write_text(f"{text}\nBy hand.\n", encoding="utf-8")
    assert main(command) == 0
    assert "the paraxial conjugate: Gaussian DRT focused nearer than paraxial in 0 of" in capsys.readouterr().out
    assert Path("docs/codesign_sweep.md").read_text(encoding="utf-8") == f"{text.rstrip()}\nBy hand.\n"
    assert KEPT in text


def test_with_a_folder_all_optima_are_kept_those_of_resized_pictures_too(quick, monkeypatch, capsys):
    command = ["codesign", "sweep", "double_gauss", "--limit", "2", "-o", "out", "--json"]
    assert main(command) == 0
    first = json.loads(capsys.readouterr().out)
    monkeypatch.setattr(module, "closed_form", lambda *given: pytest.fail("sought again"))
    assert main(command) == 0
    assert json.loads(capsys.readouterr().out) == first
    assert {one["scale"] for one in first["scales"]} == set(module.SCALES)


def test_pictures_too_small_for_the_least_scale_are_refused_before_anything_is_sought(quick, monkeypatch, capsys):
    """84 pixels of a patch and its margin, at 0.75 times the size: 111 are one too few."""
    Path("pictures").mkdir()
    for number, sample in enumerate(dead_leaves(2, size=111).samples):
        Image.fromarray(sample).save(f"pictures/{number}.png")
    instantly = module.closed_form
    monkeypatch.setattr(module, "closed_form", lambda *given: pytest.fail("sought"))
    command = ["codesign", "sweep", "double_gauss", "--data", "pictures", "-o", "out"]
    assert main(command) == 1
    said = capsys.readouterr().err
    assert "none of 2 pictures has 112 × 112 pixels, a patch and its margin where pictures are made 0.75 times" in said
    for number, sample in enumerate(dead_leaves(2, size=112).samples):
        Image.fromarray(sample).save(f"pictures/{number}.png")
    monkeypatch.setattr(module, "closed_form", instantly)
    assert main(command) == 0


def test_optima_are_kept_and_not_sought_again(quick, monkeypatch):
    """A sweep that was stopped in the middle of a line goes on behind the one before; ∞ is read as it was."""
    kept, spectrum = Kept(Path("optima.jsonl")), torch.ones(22, 22, dtype=torch.float64)
    first = sweep(None, SMALL, spectrum, kept=kept)
    assert math.inf in {one.focus_paraxial_m for one in first}
    lines = kept.path.read_text().splitlines(keepends=True)
    kept.path.write_text("".join(lines[:-3]) + lines[-3][:40])
    sought, instantly = [], module.closed_form
    monkeypatch.setattr(module, "closed_form", lambda *given: sought.append(given[1]) or instantly(*given))
    assert [one.focus_paraxial_m for one in sweep(None, SMALL, spectrum, kept=kept)] == [
        one.focus_paraxial_m for one in first
    ]
    assert len(sought) == 3
    assert kept.path.read_text().splitlines(keepends=True) == lines
    assert len(sweep(None, SMALL, spectrum, kept=kept)) == len(first)
    assert len(sought) == 3


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        ("[{", "Expecting property name"),
        ("[{}]", "a list of 1, expected 2 of them"),
        ('[{"colour": 1}, {"error": 1}]', "unexpected keyword argument 'colour'"),
        ("[1, 2]", "entry 1: found 1, expected names and values"),
        ('[{"vary": {}}, {"error": 1}]', "unhashable"),
        ("[{}, {}]", "'error' is missing"),
        ('[{}, {"error": NaN}]', "error: found NaN, expected a finite number"),
        ("\udcff", "can't decode byte 0xff"),
    ],
)
def test_a_damaged_line_of_kept_optima_is_reported_and_the_others_stay(line, reason, tmp_path):
    kept = Kept(tmp_path / "optima.jsonl", ("error",))
    kept.add(SMALL, {"error": 0.01})
    with kept.path.open("a", encoding="utf-8", errors="surrogateescape") as file:
        file.write(f"{line}\n")
    other = dataclasses.replace(SMALL, seed=7)
    kept.add(other, {"error": 0.02})
    with pytest.warns(DamagedLine, match=rf"optima.jsonl, line 2: .*{reason}.*; the line is ignored"):
        assert kept.read() == {SMALL: {"error": 0.01}, other: {"error": 0.02}}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "no folder to write to: give --docs DOCS or -o FOLDER"),
        (["--model", "drt", "-o", "out"], "--model belongs to codesign LENS"),
        (["--models", "drt", "-o", "out"], "--models belongs to codesign compare LENS"),
        (["--resume", "-o", "out"], "--resume belongs to codesign LENS and codesign compare LENS"),
        (["--loss", "spectral", "-o", "out"], "--loss spectral belongs to codesign LENS"),
    ],
)
def test_words_and_options_that_do_not_fit(quick, capsys, options, message):
    assert main(["codesign", "sweep", "double_gauss", "--limit", "2", *options]) == 1
    out, err = capsys.readouterr()
    assert (out, len(err.splitlines())) == ("", 1), err
    assert message in err

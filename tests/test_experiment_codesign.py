"""Studies: tables and claims from runs whose numbers are known, the closed form's optima, pages."""

import csv
import dataclasses
import itertools
import json
import math

import pytest
import torch
from scripts import script

from raytrace.cli import build_parser
from raytrace.cli.codesign import ROWS
from raytrace.cli.codesign_run import settings_of
from raytrace.cli.settings import words as words_of
from raytrace.files import shipped, write_table
from raytrace.imaging import codesign as optima
from raytrace.imaging.closed_form import even_distances, optimise_closed_form, patch_spectrum, scan
from raytrace.imaging.codesign import (
    Optimum,
    Outcome,
    closed_form,
    initial_camera,
    lens_at_start,
    make_batch,
    write_outcome,
)
from raytrace.imaging.pictures import dead_leaves
from raytrace.io import read_lens
from raytrace.settings import CodesignSettings
from raytrace.system.lens import with_object_distance, with_sensor_distance
from raytrace.tracing.focus import best_focus
from raytrace.tracing.paraxial import first_order, paraxial_image_distance

page_script, study, judged = script("codesign"), script("codesign_study"), script("codesign_claims")
focus_marks = script("codesign_figures").focus_marks
kept_of, markdown = script("pages").kept_of, script("pages").markdown
CAPTIONS, Report = page_script.CAPTIONS, page_script.Report
CLAIMS, Seen, claims, is_of_paper = judged.CLAIMS, judged.Measurements, judged.claims, judged.is_of_paper
AFTER_PARAXIAL, COLUMNS, StepTime = study.AFTER_PARAXIAL, study.COLUMNS, study.StepTime
blur_diameters, closed_forms, courses = study.blur_diameters, study.closed_forms, study.courses
losses_by_distance, outcomes, run_folder = study.losses_by_distance, study.outcomes, study.run_folder
run_settings, settled, step_times, summaries = study.run_settings, study.settled, study.step_times, study.summaries


def paraxial_image(lens):
    return paraxial_image_distance(lens, lens.surfaces[0].thickness)


SMALL = CodesignSettings(optimizer="adam", depth=2, width=2, patch=16, size=7, epochs=1, batch=4, crops=2)
MICROMETRE = 1e-3

SIMULATED = ("paraxial", "fourier", "gaussian", "drt")

#: The paper's table as runs of two seeds, a thousandth above and below; sensors in its order.
PAPER = {
    "paraxial": (0.0415, 0.0504, 33.9, 57.78),
    "fourier": (0.0408, 0.0509, 35.7, 57.77),
    "gaussian": (0.0429, 0.0430, 27.3, 57.85),
}


@pytest.fixture(scope="module")
def lens():
    return read_lens(shipped("lenses") / "double_gauss.zmx")


@pytest.fixture(scope="module")
def pictures():
    return dead_leaves(6, size=48)


def run(model, seed, *, l1_joint, l1_drt, focus, sensor, by_distance=None):
    return study.StudyOutcome(
        model=model,
        seed=seed,
        l1_joint=l1_joint,
        l1_before=0.06,
        l1_drt=l1_drt,
        focus_paraxial_m=focus,
        focus_rms_m=focus - 1,
        sensor_mm=sensor,
        variables={"sensor": sensor},
        by_distance=by_distance or {"10000": l1_drt + 0.01, "25000": l1_drt, "50000": l1_drt + 0.002},
    )


def paper(by_distance=None, **changed):
    """Runs with the figures of the paper, except some models; by_distance: 0.04 less than the loss of DRT."""
    at = by_distance and {z: loss - 0.043 for z, loss in by_distance.items()}
    return [
        run(
            model,
            seed,
            l1_joint=joint,
            l1_drt=drt,
            focus=focus + 0.1 * sign,
            sensor=sensor + 1e-3 * sign,
            by_distance=at and {z: drt + more for z, more in at.items()},
        )
        for model, (joint, drt, focus, sensor) in {**PAPER, **changed}.items()
        for seed, sign in enumerate((-1, 1))
    ]


def answers(found, times=()):
    return [claim.answer for claim in claims(found, times)]


TIMES = [StepTime(model, psf, 1.0, 80.0) for model, psf in zip(SIMULATED, (1.0, 2.0, 3.0, 9.0), strict=True)]


#: The statements of the paper's text on its Figures 4 and 5 as numbers.
SEEN = Seen(
    distances=(10.0, 25.0, 35.0, 50.0),
    blur={
        "paraxial": (0.05, 0.010, 0.002, 0.010),
        "fourier": (0.05, 0.012, 0.002, 0.009),
        "gaussian": (0.03, 0.004, 0.008, 0.015),
    },
    settled={"paraxial": 0.3, "fourier": 0.25, "gaussian": 0.1},
)
TEXTS = [text for text, *_ in CLAIMS]


def said_no(found, seen=SEEN):
    """The claims that are answered no, by how they begin."""
    return {claim.text for claim in claims(found, TIMES, seen) if claim.answer == "no"}


def number_of(beginning):
    (number,) = [k for k, text in enumerate(TEXTS) if text.startswith(beginning)]
    return TEXTS[number]


def test_the_numbers_of_the_paper_answer_yes():
    found = paper(by_distance={"10000": 0.049, "15000": 0.060, "25000": 0.044, "50000": 0.050})
    assert {claim.answer for claim in claims(found, TIMES, SEEN)} == {"yes"}
    of = {claim.text: claim for claim in claims(found, TIMES, SEEN)}
    assert of["The simple models lose much to DRT (+21 %, +25 %)"].figures == (
        "+21.4 % and +24.8 %: 0.0 points off at most"
    )
    assert of["Gaussian DRT loses little (+0.2 %)"].figures == "+0.2 %: 0.0 points off at most"
    assert "33.9 m and 35.7 m" in of["Paraxial and Fourier optics agree"].figures


@pytest.mark.parametrize(
    ("changed", "no"),
    [
        ({"fourier": (0.0408, 0.0509, 39.0, 57.77)}, ("Paraxial and Fourier optics agree", "… at 33.9")),
        ({"gaussian": (0.0429, 0.0430, 27.3, 57.7815)}, ("Gaussian DRT chooses",)),
        ({"gaussian": (0.0429, 0.0430, 64.0, 57.64)}, ("… focused nearer", "… at 27.3 m")),
        ({"gaussian": (0.0429, 0.0430, 31.0, 57.85)}, ("… at 27.3 m",)),
        (
            {"paraxial": (0.0450, 0.0504, 33.9, 57.78)},
            ("The simple models lose much", "Fourier optics' loss of step 1"),
        ),
        ({"gaussian": (0.0418, 0.0430, 27.3, 57.85)}, ("Gaussian DRT loses little",)),
        (
            {"gaussian": (0.0505, 0.0506, 27.3, 57.85)},
            ("Losses are", "The lens of Gaussian", "… by 17", "… at all object", "… most at 20"),
        ),
    ],
)
def test_other_numbers_answer_no(changed, no):
    found = paper(**changed)
    distances = {"10000": 0.049, "15000": 0.060, "25000": 0.0, "50000": 0.002}
    found = [
        dataclasses.replace(one, by_distance={z: one.l1_drt + more for z, more in distances.items()}) for one in found
    ]
    assert said_no(found) == {number_of(one) for one in no}


@pytest.mark.parametrize(
    ("seen", "no"),
    [
        ({"settled": {**SEEN.settled, "fourier": 0.6}}, "The focus is near"),
        ({"blur": {**SEEN.blur, "fourier": (0.05, 0.001, 0.002, 0.009)}}, "The simple lenses' blur"),
        ({"blur": {**SEEN.blur, "gaussian": (0.03, 0.004, 0.002, 0.009)}}, "… that of Gaussian DRT is larger"),
        ({"blur": {**SEEN.blur, "gaussian": (0.045, 0.020, 0.020, 0.030)}}, "… but smaller overall"),
        ({"blur": {**SEEN.blur, "gaussian": (0.050, 0.001, 0.001, 0.011)}}, "… and varies less"),
    ],
)
def test_other_figures_answer_no(seen, no):
    found = paper(by_distance={"10000": 0.049, "15000": 0.060, "25000": 0.044, "50000": 0.050})
    assert said_no(found, dataclasses.replace(SEEN, **seen)) == {number_of(no)}


def test_gains_at_distances_are_those_over_the_better_of_both():
    found = paper()
    everywhere, most = (TEXTS.index(number_of(one)) for one in ("… at all object", "… most at 20"))
    losing = {"10000": 0.07, "25000": 0.044, "50000": 0.05}
    found = [dataclasses.replace(one, by_distance=losing) if one.model == "gaussian" else one for one in found]
    assert [answers(found)[k] for k in (everywhere, most)] == ["no", "yes"]
    far = {"10000": 0.05, "25000": 0.050, "50000": 0.040}
    found = [dataclasses.replace(one, by_distance=far) if one.model == "gaussian" else one for one in found]
    assert [answers(found)[k] for k in (everywhere, most)] == ["yes", "no"]
    assert f"{100 * (0.0524 / 0.040 - 1):+.1f} % at 50 m" in claims(found, ())[everywhere].figures


def test_a_claim_that_is_not_answered_has_a_reason():
    """Not by a run that is missing where all have ended, but more than the sensor varied, or at other distances."""
    judged = {one.text: one for one in claims(paper(), TIMES, dataclasses.replace(SEEN, settled={}))}
    early, near = (judged[number_of(text)] for text in ("The focus is near", "All lose less at 10 m"))
    assert (early.holds, early.figures) == (None, "answered only where the sensor alone varies")
    assert (near.holds, near.figures) == (None, "no losses at 10 and 15 m")
    assert early.answer == near.answer == "not applicable"
    nothing = {one.text: one for one in claims([], (), SEEN, pending=SIMULATED)}
    assert nothing[number_of("Paraxial and Fourier optics agree")].figures == "no finished run of paraxial"
    fewer = dataclasses.replace(SEEN, settled={"paraxial": 0.3})
    runs = {one.text: one for one in claims(paper()[:2], TIMES, fewer, pending=["fourier"])}
    assert runs[number_of("The focus is near")].figures == "no finished run of fourier"


def test_a_course_is_settled_after_its_last_change():
    assert settled([25.0, 30.0, 33.0, 34.0, 34.5]) == 0.4
    assert settled([34.0, 34.0]) == 0


@pytest.mark.parametrize(
    ("milliseconds", "answers_of_costs"),
    [
        ((1.0, 2.0, 3.0, 9.0), ["yes", "yes"]),
        ((1.0, 2.9, 3.0, 9.0), ["no", "yes"]),
        ((1.0, 2.0, 3.0, 3.2), ["yes", "no"]),
        ((4.0, 2.0, 3.0, 1.0), ["no", "no"]),
    ],
)
def test_the_order_of_costs_is_the_papers(milliseconds, answers_of_costs):
    """Simple optics, then Gaussian DRT, then DRT; between paraxial and Fourier the paper names no order. Without DRT
    there is no answer."""
    times = [StepTime(model, psf, 1.0, 80.0) for model, psf in zip(SIMULATED, milliseconds, strict=True)]
    assert answers((), times)[-2:] == answers_of_costs
    assert answers((), times[:3])[-2:] == ["not applicable"] * 2
    by_time = sorted(zip(milliseconds, ("paraxial", "Fourier", "Gaussian DRT", "DRT"), strict=True))
    assert claims((), times)[-2].figures == ", ".join(f"{name} {time:.1f} ms" for time, name in by_time)


@pytest.mark.parametrize(
    ("pending", "answer", "why"),
    [
        (("gaussian", "drt"), "not run yet", "no finished run of gaussian"),
        ((), "not applicable", "Gaussian DRT is not among the models of this study"),
    ],
)
def test_missing_runs_leave_claims_open(pending, answer, why):
    """Not run yet where the study has the model, else not applicable: no run will answer it."""
    found = [one for one in paper() if one.model != "gaussian"]
    simple = ("Paraxial and Fourier optics agree", "… at 33.9", "The simple models lose much")
    asked = {claim.text: claim for claim in claims(found, TIMES, pending=pending)}
    most = asked[number_of("… most at 20")]
    assert (most.answer, most.figures, most.pending) == (answer, why, bool(pending))
    assert {asked[number_of(one)].answer for one in simple} <= {"yes", "no"}
    assert {claim.answer for claim in claims([], (), pending=SIMULATED)} == {"not run yet"}
    assert set(answers([])) == {"not applicable"}


def test_summaries_are_means_and_deviations_of_the_runs(tmp_path):
    found = paper()
    first = summaries(found)[0]
    assert (first.model, first.seeds) == ("paraxial", 2)
    assert first.mean["focus_paraxial_m"] == pytest.approx(33.9, rel=1e-12)
    assert first.deviation["focus_paraxial_m"] == pytest.approx(0.1 * math.sqrt(2), rel=1e-9)
    assert summaries(found[:1])[0].deviation["sensor_mm"] == 0
    write_table(tmp_path / "table.csv", found, COLUMNS)
    with open(tmp_path / "table.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["sensor_mm"]) for row in rows] == [one.sensor_mm for one in found]
    distances, losses = losses_by_distance(found)
    assert distances == [1e4, 2.5e4, 5e4]
    assert losses["fourier"] == [[0.0509 + 0.01, 0.0509, 0.0509 + 0.002]] * 2


def keep(study, row, one):
    folder = run_folder(study, row, one.seed)
    (folder / "joint").mkdir(parents=True)
    write_outcome(Outcome(**{field.name: getattr(one, field.name) for field in dataclasses.fields(Outcome)}), folder)
    (folder / "joint" / "log.csv").write_text(f"step,loss,sensor\n0,0.5,{one.sensor_mm}\n1,0.25,57.5\n")


def test_a_study_reads_finished_runs_by_row(tmp_path):
    own = run("paraxial", 1, l1_joint=0.04, l1_drt=0.05, focus=34.0, sensor=57.8)
    assert run_settings(tmp_path, AFTER_PARAXIAL, 1, SMALL) is None
    keep(tmp_path, "paraxial", own)
    after = run_settings(tmp_path, AFTER_PARAXIAL, 1, SMALL)
    assert after == dataclasses.replace(SMALL, model="gaussian", seed=1, start="57.8")
    keep(tmp_path, AFTER_PARAXIAL, dataclasses.replace(own, model="gaussian", sensor_mm=57.6))
    found = outcomes(tmp_path, ("paraxial", "drt", AFTER_PARAXIAL), (0, 1))
    assert [(one.model, one.seed, one.sensor_mm) for one in found] == [("paraxial", 1, 57.8), (AFTER_PARAXIAL, 1, 57.6)]
    assert courses(tmp_path, found, "sensor") == {"paraxial": [[57.8, 57.5]], AFTER_PARAXIAL: [[57.6, 57.5]]}
    assert courses(tmp_path, found, "curvature_3") == courses(tmp_path, found, "loss", "refine") == {}


# ---------------------------------------------------------------- the closed form


@pytest.fixture(scope="module")
def spectrum(pictures):
    return patch_spectrum(pictures, SMALL.patch + SMALL.size - 1)


@pytest.mark.slow
@pytest.mark.parametrize("model", [pytest.param("paraxial", marks=pytest.mark.slow), "gaussian"])
def test_optimum_is_the_least_of_its_scan(lens, spectrum, model, tmp_path):
    settings = dataclasses.replace(SMALL, model=model)
    found = closed_form(lens, settings, spectrum)
    own = initial_camera(lens, settings)
    begun, distances = own.variables.numbers()["sensor"], even_distances(own)
    around = [found.sensor_mm + shift * MICROMETRE for shift in (-20, 0, 20)]
    low, least, high = scan(own, spectrum, around, distances)
    assert least < min(low, high)
    assert least == pytest.approx(found.error, rel=1e-9)
    assert own.variables.numbers()["sensor"] == begun
    assert found.course[0] == pytest.approx(scan(own, spectrum, [begun], distances)[0], rel=1e-9)
    # Both definitions of focus hold: an object there has its image on the sensor, to a nanometre.
    lens = with_sensor_distance(lens_at_start(lens, settings), found.sensor_mm)
    for image, distance in ((paraxial_image, found.focus_paraxial_m), (best_focus, found.focus_rms_m)):
        place = image(with_object_distance(lens, 1e3 * distance))
        assert float(place) == pytest.approx(found.sensor_mm, abs=1e-3 * MICROMETRE)
    own.use("drt")
    at_optimum = scan(own, spectrum, [found.sensor_mm], distances)[0]
    assert at_optimum == pytest.approx(found.error_drt, rel=0.02)  # the plan's tolerance
    write_table(tmp_path / "spectral.csv", [found], optima.OPTIMUM_COLUMNS)
    with open(tmp_path / "spectral.csv", newline="") as file:
        (row,) = csv.DictReader(file)
    assert (row["model"], float(row["error_drt"])) == (model, found.error_drt)


def test_closed_forms_of_rows_begin_where_the_rows_do(lens, spectrum, monkeypatch):
    """Gaussian DRT after paraxial begins at the optimum of paraxial optics, found even where that is no row itself."""
    begun = []

    def instantly(lens, settings, spectrum):
        begun.append((settings.model, settings.start))
        return Optimum(settings.model, 57.8, 33.0, 19.0, 0.01, 0.01, lens=lens)

    monkeypatch.setattr(study, "closed_form", instantly)
    rows = ("gaussian", AFTER_PARAXIAL)
    assert [one.model for one in closed_forms(lens, SMALL, spectrum, rows)] == list(rows)
    assert begun == [("gaussian", "paraxial"), ("paraxial", "paraxial"), ("gaussian", "57.8")]
    begun.clear()
    rows = (AFTER_PARAXIAL, "paraxial")
    assert [one.model for one in closed_forms(lens, SMALL, spectrum, rows)] == list(rows)
    assert begun == [("paraxial", "paraxial"), ("gaussian", "57.8")]


@pytest.mark.parametrize(
    ("noise", "starts"),
    [pytest.param(0.1, ("57.4", "paraxial", "57.95"), marks=pytest.mark.slow), (0.01, ("57.4", "paraxial"))],
)
def test_the_optimum_of_gaussian_drt_is_no_matter_of_where_it_begins(lens, pictures, noise, starts):
    """To a micrometre. With little noise the first step of 1 mm that scipy would take lands behind another optimum."""
    spectrum, places = patch_spectrum(pictures, 36), []
    for start in starts:
        own = initial_camera(lens, dataclasses.replace(SMALL, size=21, noise=noise, start=start))
        optimise_closed_form(own, spectrum, distances=even_distances(own, 9))
        places.append(own.variables.numbers()["sensor"])
    assert max(places) - min(places) < MICROMETRE


def test_blur_of_an_almost_paraxial_lens_is_that_of_similar_triangles(lens):
    """At F/100 spots are discs of uniform light: RMS diameter = D |v - s|/(v √2), v from the exit pupil."""
    settings = dataclasses.replace(SMALL, f_number=100.0)
    narrow = lens_at_start(lens, settings)
    distances = narrow.wavelengths.new_tensor([1e4, 2e4, 5e4])
    found = blur_diameters(narrow, distances)
    sensor = float(narrow.surfaces[-2].thickness)
    for distance, blur in zip(distances.tolist(), found.tolist(), strict=True):
        own = with_object_distance(narrow, distance)
        paraxial, image = first_order(own), float(paraxial_image(own))
        behind_pupil = image - float(paraxial.exit_pupil_position) - sensor
        ratio = abs(image - sensor) / abs(behind_pupil)
        expected = float(paraxial.exit_pupil_diameter) * ratio / math.sqrt(2)
        assert blur == pytest.approx(expected, rel=0.01)  # spherical aberration, 1/1000 of that at F/3


@pytest.mark.slow
def test_time_of_a_step_leaves_the_cameras_as_they_were(lens, pictures):
    cameras = [initial_camera(lens, dataclasses.replace(SMALL, model=model)) for model in ("paraxial", "drt")]
    for own in cameras:
        own.plan()
    before = [{key: value.clone() for key, value in own.state_dict().items()} for own in cameras]
    found = step_times(cameras, make_batch(pictures, SMALL, [0, 1, 2, 3], 0), repeats=2)
    assert [one.model for one in found] == ["paraxial", "drt"]
    assert all(min(one.psf, one.image, one.network) > 0 for one in found)
    for own, state in zip(cameras, before, strict=True):
        assert all(torch.equal(value, state[key]) for key, value in own.state_dict().items())
        assert all(parameter.grad is None for parameter in own.parameters())


# ---------------------------------------------------------------- the page


def test_the_page_names_settings_that_are_not_usual():
    report = Report(
        lens="double_gauss",
        pictures="6 pictures",
        settings=dataclasses.replace(SMALL, f_number=4.0, fields=(0.0, 10.0), vary="sensor thickness:5"),
        outcomes=tuple(paper()),
        missing=(("drt", 2),),
        optima=(),
        times=tuple(TIMES),
        figures=("loss.png",),
        machine={"cores": 2},
        is_of_paper=True,
    )
    page = markdown(report.parts(), "By hand.")
    command = page.splitlines()[4].strip()
    assert command.startswith("python docs/experiments/codesign.py double_gauss --data DIR -o FOLDER --docs docs ")
    for option in ("--f-number 4.0", "--field 0 10", "--vary sensor thickness:5", "--seeds 0 1 2", "--patch 16"):
        assert option in command
    assert "--noise" not in command
    assert "| paraxial | 2 | 0.0415 ± 0.0000 | 0.0504 ± 0.0000 | +21.4 % | 33.9 ± 0.1 |" in page
    assert "**Unfinished: 6 of 7 runs.** Missing, by model and seed: drt 2." in page
    assert f"![Loss in training](codesign/loss.png)\n\n*{CAPTIONS['loss.png']}*" in page
    assert kept_of(page) == "By hand."
    assert "[claims.csv](codesign/claims.csv)" in page
    assert "[sweep.csv](codesign/sweep.csv)" in page
    other = markdown(dataclasses.replace(report, is_of_paper=False).parts())
    assert "paper" not in other
    assert "sweep.csv" not in other
    second = markdown(dataclasses.replace(report, folder="second", is_of_paper=False).parts())
    assert "--page second" in second.splitlines()[4]
    assert "](second/loss.png)" in second
    assert "codesign/" not in second
    begun = dataclasses.replace(report.settings, start="spectral", rho=0.3, bounds="sensor:57,58")
    page_of_begun = markdown(dataclasses.replace(report, settings=begun).parts())
    assert "from the optimum of the closed form" in page_of_begun
    gaussian = markdown(dataclasses.replace(report, settings=dataclasses.replace(begun, start="gaussian")).parts())
    assert "from the optimum of the closed form of Gaussian DRT. " in gaussian
    assert "--start spectral" in page_of_begun
    assert "--rho 0.3" in page_of_begun
    assert "--bounds sensor:57,58" in page_of_begun
    assert markdown(report.parts(), kept_of(page)) == page


def test_the_options_of_a_page_are_read_back_as_its_settings():
    settings = dataclasses.replace(
        SMALL,
        f_number=4.0,
        fields=(0.0, 10.0),
        vary="sensor thickness:5",
        bounds="sensor:57,58",
        wavelengths=(0.5, 0.6),
        wavelength_weights=(1.0, 2.0),
        normalise="energy",
        edge=0.3,
    )
    words = " ".join(words_of(settings, ROWS)).split()
    assert settings_of(build_parser().parse_args(["codesign", "double_gauss", *words])) == settings


def test_marks_of_the_focus_axis_are_round_and_apart():
    """Images of a thin lens of 100 mm: 1/v = 1/f - 1/z."""
    distances = [float(z) for z in range(5, 2000)]
    images = [1 / (1 / 100 - 1 / (1e3 * z)) for z in distances]
    conjugates = images[::-1], distances[::-1]
    low, high = images[distances.index(100.0)], images[distances.index(20.0)]
    marks = focus_marks(conjugates, low - 1e-6, high + 1e-6)
    assert {20, 25, 30, 50, 100} <= set(marks)
    assert all(20 <= z <= 100 for z in marks)
    places = [images[distances.index(z)] for z in marks]
    assert min(a - b for a, b in itertools.pairwise(places)) > (high - low) / 12


def test_only_the_papers_lens_has_its_claims():
    paths = sorted(shipped("lenses").glob("*.zmx"))
    assert [path.stem for path in paths if is_of_paper(read_lens(path))] == ["double_gauss"]
    assert is_of_paper(with_sensor_distance(read_lens(shipped("lenses") / "double_gauss.zmx"), 57.0))


def test_a_table_of_finished_runs_is_read_back(tmp_path):
    """By model and seed, from several studies; an unfinished run has no row."""
    numbers = dict.fromkeys(("l1_joint", "l1_before", "l1_drt", "focus_paraxial_m", "focus_rms_m", "sensor_mm"), 0.1)
    for study, model, seed in (("b", "gaussian", 0), ("a", "paraxial", 1), ("b", "paraxial", 0)):
        folder = tmp_path / study / f"{model}-{seed}"
        folder.mkdir(parents=True)
        run = {"model": model, "seed": seed, **numbers, "by_distance": {"10000": 0.07, "12500": seed}, "penalty": 0.0}
        (folder / "outcome.json").write_text(json.dumps(run), "utf-8")
    (tmp_path / "a" / "fourier-0").mkdir()
    rows = judged.table_of([tmp_path / "a", tmp_path / "b"])
    assert [(row["model"], row["seed"]) for row in rows] == [("paraxial", 0), ("paraxial", 1), ("gaussian", 0)]
    write_table(tmp_path / "table.csv", rows)
    runs = judged.outcomes_of(tmp_path / "table.csv")
    assert [run.by_distance for run in runs] == [{"10000": 0.07, "12500": float(row["l1_12.5m"])} for row in rows]
    assert all(run.l1_drt == run.sensor_mm == 0.1 for run in runs)
    earlier = [{**row, "l1_drt": "0.2"} for row in judged.rows_of(tmp_path / "table.csv")]
    joined = judged.table_of([tmp_path / "a"], earlier)  # further runs replace rows of their model and seed alone
    assert [(row["model"], float(row["l1_drt"])) for row in joined] == [
        ("paraxial", 0.2), ("paraxial", 0.1), ("gaussian", 0.2),
    ]  # fmt: skip
    assert judged.rows_of(tmp_path / "a" / "table.csv") == []

"""The lens as built: changes at the limits by brute force, expectation against Monte Carlo, files of trials."""

import dataclasses
import math
import subprocess
import sys
import time
from functools import partial

import pytest
import torch
from problems import SHARED
from scipy.optimize import minimize_scalar

import raytrace as rt
from raytrace.cli import main
from raytrace.system.configurations import Operand
from raytrace.tolerancing import monte_carlo
from raytrace.tolerancing.criteria import criterion_of
from raytrace.tolerancing.study import Study, views_of
from raytrace.tracing.spot import image_rays

LIMITS = "radius=0.1% thickness=0.03 element_decenter=0.03 element_tilt=0.05"


@pytest.fixture(scope="module")
def triplet():
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="off", fields=[0, 8.4, -8.4, 11.9, -11.9])
    return rt.focus(lens, fields=[0, 8.4, 11.9]).lens


@pytest.fixture(scope="module")
def built(triplet):
    return rt.tolerance(triplet, limits=LIMITS, trials=500)


def rms(lens):
    """RMS spot radius, µm, of all fields, by `rt.spot` with the same pupil points."""
    whole = rt.spot(lens, rings=4).whole
    return 1e3 * float(whole.mean_square_radius.mean().sqrt())


def focused(lens):
    """The least RMS over the sensor distance, by a search that knows no derivative."""
    start = float(lens.surfaces[-2].thickness)
    return minimize_scalar(
        lambda shift: rms(lens.at(sensor_distance=start + shift)), bracket=(-0.2, 0.2), tol=1e-10
    ).fun


def check_changes(lens, rows, judge, accuracy):
    """The changes at both limits of every row are those of single lenses, judged one by one."""
    found = rt.tolerance(lens, rows, trials=0, rings=4)
    nominal = judge(lens)
    assert float(found.nominal) == pytest.approx(nominal, abs=accuracy)
    for n in range(len(rows)):
        for limit, change in ((rows.minimum[n], found.minimum[n]), (rows.maximum[n], found.maximum[n])):
            errors = torch.zeros(len(rows), dtype=torch.float64)
            errors[n] = limit
            assert float(change) == pytest.approx(
                judge(rt.tolerancing.perturbed(lens, rows, errors)) - nominal, abs=accuracy
            )


def test_changes_at_the_limits_are_those_of_single_lenses(triplet):
    rows = rt.tolerances(triplet, "radius:3=0.1% thickness:3=0.05 element_tilt:3=0.05", compensators=[])
    check_changes(triplet, rows, rms, 1e-9)


@pytest.mark.slow
def test_changes_at_the_limits_are_those_of_refocused_lenses(triplet):
    rows = rt.tolerances(triplet, "radius:3=0.1% thickness:3=0.05 element_decenter:3=0.05 element_tilt:3=0.05")
    check_changes(triplet, rows, focused, 1e-8)


def test_slope_is_the_derivative_of_the_change(triplet):
    small = rt.tolerances(triplet, "radius=0.0001%")
    found = rt.tolerance(triplet, small, trials=0)
    torch.testing.assert_close(found.maximum - found.minimum, 2 * found.slope, rtol=1e-4, atol=1e-10)


def test_expectation_is_the_mean_of_the_trials(built):
    spread = float(built.trials.std()) / math.sqrt(len(built.trials))
    assert abs(float(built.expected - built.trials.mean())) < 4 * spread
    assert float(built.expected) == pytest.approx(float(built.trials.mean()), rel=0.02)
    squares = built.trials.square()
    error = float(squares.std()) / math.sqrt(len(squares))
    assert abs(float(built.expected_square - squares.mean())) < 4 * error
    assert float(built.nominal) < float(built.expected) < float(built.estimated)


def test_percentiles_and_yield(built):
    median = built.percentile(50)
    assert built.yield_at(float(median)) == pytest.approx(0.5, abs=0.003)
    assert built.yield_at(0.0) == 0
    predicted = torch.quantile(built.predicted, 0.9)
    assert float(predicted) == pytest.approx(float(built.percentile(90)), rel=0.01)


def test_rss_is_as_opticstudio_prints_it(built):
    rss = (0.5 * (built.minimum**2 + built.maximum**2)).sum().sqrt()
    assert float(built.estimated) == pytest.approx(float(built.nominal + rss), rel=1e-12)


@pytest.mark.slow
def test_a_trial_is_the_same_in_any_study(triplet, built):
    fewer = rt.tolerance(triplet, limits=LIMITS, trials=260)
    torch.testing.assert_close(fewer.trials, built.trials[:260], rtol=1e-10, atol=0)
    other = rt.tolerance(triplet, limits=LIMITS, trials=20, seed=1)
    assert not torch.allclose(other.trials, built.trials[:20])


def test_many_trials_are_worth_compiling(triplet, monkeypatch):
    """The trace is compiled, once for a machine, for the rays of 3,000 lenses, not for those of 2."""
    prepared = []
    monkeypatch.setattr(monte_carlo, "prepare", lambda: prepared.append("compiled"))
    study = Study(views_of(triplet, partial(criterion_of, "rms"), None, 4, 6), rt.tolerances(triplet, LIMITS), loss=1.0)
    zero = torch.zeros(1, dtype=torch.float64)
    monkeypatch.setattr(
        study, "compensated", lambda e: (zero.expand(len(e)), zero.expand(len(e), 1), zero.expand(len(e)))
    )
    for trials, expected in ((2, []), (3000, ["compiled"])):
        monte_carlo.monte_carlo(study, trials, 0, checkpoint=None, share=None, progress=None)
        assert prepared == expected


@pytest.mark.slow
def test_trials_of_a_file_are_not_traced_again(triplet, tmp_path):
    file = tmp_path / "trials.jsonl"
    first = rt.tolerance(triplet, limits=LIMITS, trials=1100, checkpoint=file)
    lines = file.read_text().splitlines(keepends=True)
    assert len(lines) == 3  # the study, and two pieces
    file.write_text("".join(lines[:2]) + lines[2][:40])  # as a killed process leaves it
    again = rt.tolerance(triplet, limits=LIMITS, trials=1100, checkpoint=file)
    assert torch.equal(first.trials, again.trials)
    assert torch.equal(first.changes, again.changes)
    with pytest.raises(rt.BadTolerance, match="trials of another study"):
        rt.tolerance(triplet, limits="radius=0.2%", trials=1100, checkpoint=file)


def test_compensators_stay_within_their_limits(triplet):
    free = rt.tolerances(triplet, LIMITS)
    held = dataclasses.replace(free, compensators=(rt.system.Compensator(7, "thickness", -0.02, 0.03),))
    found = rt.tolerance(triplet, held, trials=100)
    assert float(found.changes.min()) >= -0.02
    assert float(found.changes.max()) <= 0.03
    assert found.at_limit(0) == int(((found.changes == -0.02) | (found.changes == 0.03)).sum()) > 0
    assert f"at a limit in {found.at_limit(0)}" in str(found)
    assert found.unsettled == 0
    none = rt.tolerance(triplet, dataclasses.replace(free, compensators=()), trials=100)
    assert none.changes.shape == (100, 0)
    assert float(none.trials.mean()) > float(found.trials.mean())


def test_wavefront_as_built(triplet):
    found = rt.tolerance(triplet, limits="radius=0.05% thickness=0.01", criterion="wavefront", trials=64, fields=[0, 5])
    assert float(found.expected) == pytest.approx(float(found.trials.mean()), rel=0.02)
    assert found.unit == "waves"


def test_report_table_and_figure(built, tmp_path):
    text = str(built)
    assert "500 trials (seed 0)" in text
    assert "compensator thickness of surface 7" in text
    frame = built.to_frame()
    assert list(frame["tolerance"][:1]) == [built.tolerances.labels[int(built.worst[0])]]
    assert built.document()["expected"] == float(built.expected)
    built.plot(tmp_path / "as_built.png")
    assert (tmp_path / "as_built.png").stat().st_size > 10_000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"criterion": "sharpness"}, "criterion 'sharpness': expected one of rms, wavefront"),
        ({"trials": -1}, "trials -1"),
        ({"limits": "radius=0"}, "no tolerances"),
        ({"grade": "hgih"}, "did you mean high"),
    ],
)
def test_wrong_options_are_refused(triplet, words, message):
    with pytest.raises(ValueError, match=message):
        rt.tolerance(triplet, **{"limits": LIMITS, **words})


def test_compensators_that_the_lens_does_not_have_or_need(triplet):
    rows = rt.tolerances(triplet, LIMITS)
    for one, message in (
        (rt.system.Compensator(12), "surfaces 0 to 7"),
        (rt.system.Compensator(1, "colour"), "the surface does not have it"),
        (rt.system.Compensator(0), "does not improve the criterion"),
        (rt.system.Compensator(8), "surfaces 0 to 7"),
    ):
        with pytest.raises(rt.BadTolerance, match=message):
            rt.tolerance(triplet, dataclasses.replace(rows, compensators=(one,)), trials=0)


FILES = SHARED / "tolerance" / "dev"


@pytest.mark.slow
@pytest.mark.needs(FILES)
@pytest.mark.parametrize("file", sorted(FILES.glob("*.zmx")), ids=lambda file: file.stem)
def test_tolerances_of_a_file(file):
    """Whatever light is lost: of SC_Tol_RflScp2 decentres may leave the most clipped of five fields in the dark."""
    found = rt.tolerance(rt.read_lens(file), trials=50, light_loss=1.0)
    assert len(found.tolerances) == len(rt.tolerancing.read_tolerances(file))
    arrives = found.trials.isfinite()
    assert bool((found.lost[~arrives] > 0.15).all())
    assert int(arrives.sum()) >= (45 if file.stem == "SC_Tol_RflScp2" else 50)
    assert float(found.expected) == pytest.approx(float(found.trials[arrives].mean()), rel=0.15)


@pytest.mark.slow
def test_no_error_alone_does_more_than_the_increment(triplet):
    free = rt.tolerance(triplet, limits=LIMITS, trials=0)
    held = rt.tolerance(triplet, limits=LIMITS, trials=0, increment=0.1, workshop="any")
    before, after = (torch.cat([found.minimum, found.maximum]) for found in (free, held))
    assert int((before > 0.1).sum()) > 5
    assert torch.allclose(after, before.clamp(max=0.1), atol=1e-6)
    narrower = held.tolerances.maximum < free.tolerances.maximum
    assert torch.equal(narrower, free.maximum > 0.1)
    assert len(held.tightened()) == int(((free.maximum > 0.1) | (free.minimum > 0.1)).sum())
    assert f"limits tightened of {len(held.tightened())} of" in str(held)


@pytest.mark.slow
def test_limits_of_a_yield_have_it_at_less_tightness_than_a_common_factor(triplet, built):
    goal, free = float(built.percentile(60)), built
    found = rt.tolerance(triplet, limits=LIMITS, trials=1500, goal=goal, yield_=0.9, workshop="any")
    assert found.summary()["yield_by_second_order"] == pytest.approx(0.9, abs=0.01)
    assert found.yield_at(goal) == pytest.approx(0.9, abs=0.03)  # 4 σ of the binomial distribution
    factors = found.tolerances.maximum / free.tolerances.maximum
    assert bool((factors <= 1).all())
    low, high = 0.01, 1.0  # the common factor of the same yield, by halving
    for _ in range(8):
        factor = 0.5 * (low + high)
        rows = [
            dataclasses.replace(row, minimum=factor * row.minimum, maximum=factor * row.maximum)
            for row in free.tolerances
        ]
        again = rt.tolerance(triplet, dataclasses.replace(free.tolerances, rows=tuple(rows)), trials=0, goal=goal)
        good = again.summary()["yield_by_second_order"] >= 0.9
        low, high = (factor, high) if good else (low, factor)
    assert float((1 / factors).mean()) < 0.95 / low


def test_a_yield_that_is_met_leaves_the_limits(triplet):
    found = rt.tolerance(triplet, limits="radius=0.001%", trials=0, goal=40.0, yield_=0.9)
    assert found.given is None
    assert found.summary()["yield_by_second_order"] == 1.0


def test_impossible_goals_are_refused(triplet):
    with pytest.raises(rt.BadTolerance, match=r"`goal` 1 µm: the nominal lens has .* not reach .*`yield_=0.9`"):
        rt.tolerance(triplet, limits=LIMITS, trials=0, goal=1.0, yield_=0.9)
    with pytest.raises(ValueError, match="a share of the lenses between 0 and 1"):
        rt.tolerance(triplet, limits=LIMITS, trials=0, yield_=90.0)
    with pytest.raises(ValueError, match=r"expected .* above 0"):
        rt.tolerance(triplet, limits=LIMITS, trials=0, increment=0.0)


def test_a_goal_that_the_nominal_lens_misses_is_no_share_of_lenses(triplet, capsys):
    with pytest.warns(rt.GoalMissed, match=r"`goal` 0.9 µm: the nominal lens has \d.*; a share .* `yield_=0.9`"):
        built = rt.tolerance(triplet, limits="radius=0.1%", trials=0, goal=0.9)
    assert built.summary()["yield_by_second_order"] == 0
    for option, hint in {
        "--goal": "a share of the lenses is --yield 0.9",
        "--yield": "a share is written as 0.9",
    }.items():
        assert main(["tolerance", "cooke_triplet", option, "90%"]) == 2
        assert hint in capsys.readouterr().err


def test_second_order_of_each_limit(built):
    close = built.second_maximum - built.maximum
    assert float(close.abs().max()) < 0.01 * float(built.maximum.abs().max())
    table = built.table_of_shares()
    assert torch.allclose(table["predicted"], table["trials"], rtol=0.02)


@pytest.mark.slow
def test_perturbed_lenses_find_their_stop_as_the_nominal_one():
    lens = rt.read_lens("cooke_triplet")  # auto: off, whose elements are tilted then
    rows = rt.tolerances(lens, grade="precision", compensators=[])
    assert rt.tolerancing.perturbed(lens, rows, [0.0] * len(rows)).ray_aiming == "off"
    nominal = rt.tolerance(lens.at(fields=[0, 8.4, -8.4]), rows, trials=0, rings=4).nominal
    assert float(nominal) == pytest.approx(rms(lens.at(fields=[0, 8.4, -8.4])), abs=1e-9)


PLATE = [{"thickness": 5, "glass": "N-BK7"}, {"thickness": 50}]


def test_a_compensator_without_effect_is_refused():
    plate = rt.lens(PLATE, stop=1, entrance_pupil_diameter=10, fields=[0, 5])
    with pytest.raises(rt.BadTolerance, match=r"thickness of surface 2: .*not improve"):
        rt.tolerance(plate, limits="thickness=0.1", trials=0)


@pytest.mark.slow
def test_a_million_trials_of_a_plane_plate():
    plate = rt.lens(PLATE, stop=1, entrance_pupil_diameter=10, fields=[0, 5])
    rows = rt.tolerances(plate, "thickness=0.1 index=0.001", compensators=[])
    found = rt.tolerance(plate, rows, trials=1_000_000)
    # The beam stays parallel: the RMS distance from its centre is that of the pupil, R/√2.
    assert float((found.trials - 5000 / math.sqrt(2)).abs().max()) < 1e-6
    assert float(found.expected) == pytest.approx(5000 / math.sqrt(2), rel=1e-12)


@pytest.mark.slow
def test_a_killed_study_loses_nothing(triplet, tmp_path):
    trials, file = 6000, tmp_path / "trials.jsonl"
    script = (
        "import raytrace as rt\n"
        "lens = rt.read_lens('cooke_triplet').at(ray_aiming='off', fields=[0, 8.4, -8.4, 11.9, -11.9])\n"
        "lens = rt.focus(lens, fields=[0, 8.4, 11.9]).lens\n"
        f"rt.tolerance(lens, limits={LIMITS!r}, trials={trials}, checkpoint={str(file)!r})\n"
    )
    process = subprocess.Popen([sys.executable, "-W", "ignore", "-c", script])
    while not (file.exists() and len(file.read_bytes().splitlines()) > 2):
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    before = len(file.read_bytes().splitlines())
    again = rt.tolerance(triplet, limits=LIMITS, trials=trials, checkpoint=file)
    assert 2 < before < 1 + math.ceil(trials / 1024)
    assert torch.equal(again.trials, rt.tolerance(triplet, limits=LIMITS, trials=trials).trials)


@pytest.mark.slow
def test_trials_without_light_are_counted_by_every_criterion():
    """A decentre of ±30 mm: some lenses let no light of a field through; they have neither spot nor wavefront."""
    lens = rt.read_lens("cooke_triplet").at(fields=[0, 11.9], ray_aiming="off")
    rows = rt.tolerancing.ToleranceTable((rt.system.Tolerance("element_decenter_y", (1, 2), -30.0, 30.0),))
    dark = [
        rt.tolerance(lens, rows, criterion=name, trials=24, seed=1, rings=2).trials.isnan()
        for name in ("rms", "wavefront")
    ]
    assert bool(dark[0].any())
    assert not bool(dark[0].all())
    assert torch.equal(*dark)


# -- one sampling rule, all configurations, lost light ---------------------------------------------------------------


@pytest.mark.parametrize("name", ["cooke_triplet", "double_gauss", "cemented_achromat"])
def test_the_nominal_criterion_is_that_of_spot(name):
    lens = rt.read_lens(name)
    rows = rt.tolerances(lens, "thickness=0.01", compensators=[])
    whole, weight = rt.spot(lens).whole, lens.fields.weight
    root = float(((weight * whole.mean_square_radius).sum() / weight.sum()).sqrt())
    assert float(rt.tolerance(lens, rows, trials=0).nominal) == pytest.approx(1e3 * root, rel=1e-4)


def clipped_triplet():
    rims = {k: (rt.system.Aperture("circular", (0.0, 10.0)),) for k in (1, 6)}
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="off")
    for k, apertures in rims.items():
        lens = lens.replace(k, apertures=apertures)
    return lens


@pytest.mark.slow
def test_the_nominal_criterion_of_a_clipped_lens_is_that_of_its_clear_pupil():
    lens = clipped_triplet()
    rows = rt.tolerances(lens, "thickness=0.01", compensators=[])
    spots = rt.spot(lens)
    assert bool((spots.rays < spots.launched).any())
    root = float((lens.fields.weight * spots.whole.mean_square_radius / lens.fields.weight.sum()).sum().sqrt())
    found = rt.tolerance(lens, rows, trials=0, fields=None)
    assert float(found.nominal) == pytest.approx(1e3 * root, rel=1e-4)


@pytest.mark.slow
def test_light_that_a_lens_loses_is_counted_and_bounded():
    """A rim that moves across the beam by 4 mm: its share of the pupil of the axial field is that of two discs."""
    lens = rt.lens(
        [{"thickness": 1.0}, {"radius": 50.0, "thickness": 5.0, "glass": "N-BK7"}, {"radius": -50.0, "thickness": 45}],
        stop=1, entrance_pupil_diameter=10.0, fields=(0.0,), wavelengths=(0.5876,),
    )  # fmt: skip
    lens = lens.replace(1, apertures=(rt.system.Aperture("circular", (0.0, 6.0)),))
    rows = rt.tolerancing.ToleranceTable(
        (rt.system.Tolerance("surface_decenter_x", (1,), -4.0, 4.0), rt.system.Tolerance("thickness", (2,), -1, 1))
    )
    d, R, r = 4.0, 6.0, 5.0
    a, b = (math.acos((d * d + s * s - t * t) / (2 * d * s)) for s, t in ((r, R), (R, r)))
    both = r * r * (a - math.sin(2 * a) / 2) + R * R * (b - math.sin(2 * b) / 2)
    found = rt.tolerance(lens, rows, trials=40, seed=2)
    assert float(found.lost_maximum[0]) == pytest.approx(1 - both / (math.pi * r * r), abs=0.02)
    assert float(found.lost_maximum[1]) == 0
    assert bool(found.maximum[0].isnan())
    failed = found.trials.isnan()
    assert torch.equal(failed, found.lost > found.light_loss)
    assert 0 < int(failed.sum()) < 40
    text = str(found)
    assert f"{int(failed.sum())} failed, by more than 5 %, and count as the worst" in text
    assert "1 tolerances lose more than 5 % of the light at a limit: not in RSS" in text
    assert "no compensator" in text
    assert bool(found.estimated.isfinite())
    free = rt.tolerance(lens, rows, trials=40, seed=2, light_loss=1.0)
    assert not bool(free.trials.isnan().any())
    torch.testing.assert_close(free.trials[~failed], found.trials[~failed])


def test_all_configurations_are_judged():
    lens = rt.read_lens("double_gauss").with_configurations(thickness={6: [12.4281, 14.0]})
    rows = [rt.system.Tolerance("operand", (), -0.1, 0.1, configuration=k + 1, operand=0) for k in range(2)]
    rows = rt.tolerancing.ToleranceTable((*rows, rt.system.Tolerance("thickness", (1,), -0.05, 0.05)))
    found = rt.tolerance(lens, rows, trials=0)
    assert found.configurations == 2
    assert float(found.maximum.abs().min()) > 1e-4
    for errors in torch.eye(3, dtype=torch.float64) * rows.maximum:
        squares = []
        for each in lens.configurations:
            alone = rt.tolerance(
                dataclasses.replace(rt.tolerancing.perturbed(each, rows, errors), operands=()),
                rt.tolerancing.ToleranceTable((rt.system.Tolerance("thickness", (1,), -1e-9, 1e-9),)), trials=0,
            )  # fmt: skip
            squares.append(float(alone.nominal) ** 2)
        k = int(errors.argmax())
        assert float(found.nominal + found.maximum[k]) == pytest.approx((sum(squares) / 2) ** 0.5, rel=1e-4)


@pytest.mark.slow
def test_configurations_count_by_their_weights():
    """CWGT 1 and 3: q is the mean by weight; of weights 0 and 1 that of the second one alone; of 0 and 0 the mean."""
    lens = rt.read_lens("double_gauss").with_configurations(thickness={6: [12.4281, 14.0]})
    rows = rt.tolerancing.ToleranceTable((rt.system.Tolerance("thickness", (3,), -0.05, 0.05),))

    def square(weights):
        weight = Operand("CWGT", numbers=torch.tensor(weights, dtype=torch.float64))
        weighted = dataclasses.replace(lens, operands=(*lens.operands, weight))
        return float(rt.tolerance(weighted, rows, trials=0, rings=4).nominal) ** 2

    alone = [float(rt.tolerance(one, rows, trials=0, rings=4).nominal) ** 2 for one in map(bare, lens.configurations)]
    assert square([1.0, 3.0]) == pytest.approx(0.25 * alone[0] + 0.75 * alone[1], rel=1e-12)
    assert square([0.0, 1.0]) == pytest.approx(alone[1], rel=1e-12)
    assert square([0.0, 0.0]) == pytest.approx(0.5 * sum(alone), rel=1e-12)


def bare(lens):
    """A configuration without the others."""
    return dataclasses.replace(lens, operands=(), current_configuration=1)


@pytest.mark.slow
def test_a_compensator_of_a_configuration_adjusts_it_alone():
    """As CMCO: each configuration has its own sensor distance, so that each is at its best alone."""
    lens = rt.read_lens("cooke_triplet").with_configurations(thickness={2: [12.93, 12.6], 7: [77.4, 77.0]})
    place = next(k for k, operand in enumerate(lens.operands) if operand.number == 7)
    rows = rt.system.Tolerance("thickness", (1,), -0.05, 0.05)
    both = tuple(rt.system.Compensator(7, configuration=k + 1, operand=place) for k in range(2))
    found = rt.tolerance(lens, rt.tolerancing.ToleranceTable((rows,), both), trials=4, rings=6)
    single = rt.tolerancing.ToleranceTable((rows,), (rt.system.Compensator(7),))
    lenses = [dataclasses.replace(each, operands=()) for each in lens.configurations]
    alone = [rt.tolerance(each, single, trials=4, rings=6) for each in lenses]
    expected = math.hypot(*(float(each.nominal) for each in alone)) / 2**0.5
    assert float(found.nominal) == pytest.approx(expected, rel=1e-6)
    for k, each in enumerate(alone):
        assert torch.allclose(found.changes[:, k], each.changes[:, 0], atol=1e-6)
    with pytest.raises(rt.BadTolerance, match="2 operands in configurations 1 to 2"):
        rt.tolerance(
            lens,
            rt.tolerancing.ToleranceTable((rows,), (rt.system.Compensator(7, configuration=3, operand=place),)),
            trials=0,
        )


@pytest.mark.slow
def test_tolerances_of_a_file_have_its_compensators_alone(tmp_path):
    """The same analysis by the lens, by its tolerances as read, and by the command."""
    lines = ["TOL TTHI 2 3 -0.05 0.05 0 0 0", "TOL TRAD 1 0 -0.1 0.1 0 0 0"]
    for extra, count in (([], 0), (["TOL COMP 7 0 -0.1 0.1 0 0 0"], 1)):
        file = tmp_path / f"tolerances{count}.zmx"
        rt.write_lens(rt.read_lens("cooke_triplet"), file)
        text = file.read_text(encoding="utf-16" if file.read_bytes()[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8")
        file.write_text(text + "\n".join([*extra, *lines]) + "\n", encoding="utf-8")
        lens = rt.read_lens(file)
        by_lens, by_file = (
            rt.tolerance(lens, trials=8),
            rt.tolerance(lens, rt.tolerancing.read_tolerances(file), trials=8),
        )
        assert len(by_lens.tolerances.compensators) == count
        assert torch.equal(by_lens.trials, by_file.trials)
        assert torch.equal(by_lens.maximum, by_file.maximum)


# -- studies that fail in part -----------------------------------------------------------------------------------------


def test_a_compensator_listed_twice_is_refused(triplet):
    rows = rt.tolerances(triplet, "radius=0.1%", compensators=[rt.system.Compensator(7), rt.system.Compensator(7)])
    with pytest.raises(rt.BadTolerance, match=r"two of them .*leave one out"):
        rt.tolerance(triplet, rows, trials=0)


@pytest.mark.parametrize("decentre", [30.0, 60.0])
def test_trials_without_light_leave_the_figures_of_the_others(triplet, decentre, tmp_path):
    lens = triplet.at(fields=[0, 8.4])
    rows = rt.tolerancing.ToleranceTable(
        (rt.system.Tolerance("element_decenter_y", (3, 4), -decentre, decentre, distribution="end_points"),
         rt.system.Tolerance("element_decenter_y", (1, 2), -0.1, 0.1)),
        (rt.system.Compensator(7),),
    )  # fmt: skip
    if decentre == 30:
        rows = dataclasses.replace(rows, rows=(dataclasses.replace(rows[0], distribution="normal"), rows[1]))
    found = rt.tolerance(lens, rows, trials=24, seed=3)
    text, summary = str(found), found.summary()
    assert bool(found.estimated.isfinite())
    assert "nan" not in text.split("tolerance ")[0].replace("mean nan, σ nan, best nan, worst nan", "")
    assert summary["failed"] == (24 if decentre == 60 else int(found.trials.isnan().sum())) > 0
    assert math.isfinite(summary["mean"]) == (decentre == 30)
    found.draw().savefig(tmp_path / "figure.png")


def rms_angle(lens):
    """RMS angle, mrad, of the directions of rays at the sensor about their mean, of all fields."""
    points, weights = rt.maths.gauss_rings(12)
    directions = image_rays(lens, points).direction.flatten(-2)
    shares = lens.wavelength_weights / lens.wavelength_weights.sum()
    weights = (shares[:, None] * weights).flatten()
    offset = directions - (weights * directions).sum(-1, keepdim=True)
    return 1e3 * float((weights * offset.square().sum(0)).sum(-1).mean().sqrt())


def test_an_afocal_lens_is_judged_in_angle(tmp_path):
    """Against the directions of the rays; a file keeps the kind of image space."""
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="off", fields=[0, 8.4, -8.4])
    lens = dataclasses.replace(lens, afocal=True)
    rt.write_lens(lens, tmp_path / "afocal.zmx")
    with pytest.warns(UserWarning, match="afocal image space"):
        assert rt.read_lens(tmp_path / "afocal.zmx").afocal
    found = rt.tolerance(lens, rt.tolerances(lens, "element_decenter:3=0.05"), trials=4)
    assert (found.criterion, found.unit) == ("RMS angle", "mrad")
    assert not bool(found.changes.any())  # the sensor distance has no effect
    for judged, each in ((found.nominal, lens), (found.trials[2], found.trial(2))):
        assert float(judged) == pytest.approx(rms_angle(each), rel=1e-4)

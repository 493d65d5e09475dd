"""Optimising: the step, the descent, the function and its command."""

import dataclasses
import json

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch
from problems import SHARED
from scipy.optimize import minimize
from scripts import script

import raytrace as rt
from raytrace.optimization import least_squares as paths
from raytrace.optimization.conditions import Condition
from raytrace.optimization.least_squares import Linear, NoStep, Sides, SolverOptions, SumOfSquares, least_squares
from raytrace.optimization.merit import DefaultMerit
from raytrace.optimization.optimized_figure import optimize_report
from raytrace.optimization.problem import NoProblem, Problem, Recovery
from raytrace.optimization.variables import design_variables
from raytrace.system.optimization_data import OptimizationData, Row, Vary
from raytrace.system.poses import Pose
from raytrace.system.surface import Surface

FAR = np.inf
NONE = np.zeros(0)


# -- the step ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(12))
def test_a_step_is_the_least_of_its_model_under_its_conditions(seed):
    """Beside a general minimiser; conditions are met to rounding."""
    draw = np.random.default_rng(seed)
    n, sides, equalities = int(draw.integers(2, 9)), int(draw.integers(0, 7)), int(draw.integers(0, 2))
    J, r = draw.normal(size=(n + 5, n)), draw.normal(size=n + 5)
    one_sided = Sides(draw.normal(size=sides), draw.normal(size=(sides, n)), draw.integers(0, 3, size=sides))
    A, c = draw.normal(size=(equalities, n)), 0.1 * draw.normal(size=equalities)
    lower, upper = -draw.uniform(0, 1, n), draw.uniform(0, 1, n)
    scale, damping = np.sqrt((J**2).sum(0)), 1e-3
    model = Linear(
        r, J, sides=one_sided, held=(c, A), limits=(NONE, np.zeros((0, n))), lower=lower, upper=upper, scale=scale
    )

    def cost(p):
        return ((J @ p + r) ** 2).sum() + damping * ((scale * p) ** 2).sum() + one_sided.at(p).cost()

    held = [{"type": "eq", "fun": lambda p: A @ p + c}] if equalities else []
    other = minimize(
        cost, np.zeros(n), bounds=[*zip(lower, upper, strict=True)], constraints=held, method="SLSQP",
        options={"maxiter": 1000, "ftol": 1e-14},
    )  # fmt: skip
    if not other.success:
        pytest.skip("the other minimiser gave up")
    found = model.step(damping)
    assert np.abs(A @ found + c).max(initial=0) < 1e-12
    assert (found >= lower - 1e-12).all()
    assert (found <= upper + 1e-12).all()
    assert cost(found) <= other.fun * (1 + 1e-6)


def test_conditions_that_exclude_each_other_allow_no_step():
    model = Linear(
        np.ones(2), np.eye(2), sides=Sides.none(2), held=(np.array([-5.0]), np.array([[1.0, 0.0]])),
        limits=(NONE, np.zeros((0, 2))), lower=np.full(2, -1.0), upper=np.full(2, 1.0), scale=np.ones(2),
    )  # fmt: skip
    with pytest.raises(NoStep):
        model.step(1e-3)
    assert model.step(1e-3, share=0.1)[0] == pytest.approx(0.5)


# -- the descent -------------------------------------------------------------------------------------------------------


def squares(residuals, jacobian, held=None):
    """A problem of plain functions of x."""

    def state(x, derivatives):
        n = len(x)
        c, A = (NONE, np.zeros((0, n))) if held is None else held(x)
        return SumOfSquares(
            x, residuals(x), 0, Sides.none(n), c, NONE, jacobian(x) if derivatives else None, A, np.zeros((0, n))
        )

    return state


def rosenbrock(x):
    return np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])


def by_rosenbrock(x):
    return np.array([[-20 * x[0], 10.0], [-1.0, 0.0]])


@pytest.mark.parametrize("bends", [True, False])
def test_a_curved_valley_is_followed_to_its_end(bends):
    end = least_squares(
        squares(rosenbrock, by_rosenbrock), np.array([-1.2, 1.0]), lower=np.full(2, -FAR), upper=np.full(2, FAR),
        options=SolverOptions(bends=bends),
    )  # fmt: skip
    assert end.state.x == pytest.approx([1, 1], abs=1e-9)
    assert end.evaluations < 100


def test_bounds_and_equalities_are_met_exactly():
    """On the circle x² + y² = 2 within x ≤ 0.5 the least is where the bound meets the circle."""
    held = lambda x: (np.array([x @ x - 2.0]), 2 * x[None])  # noqa: E731
    end = least_squares(
        squares(rosenbrock, by_rosenbrock, held), np.array([-1.0, 0.5]),
        lower=np.full(2, -FAR), upper=np.array([0.5, FAR]),
    )  # fmt: skip
    assert abs(end.state.held[0]) < 1e-12
    assert end.state.x[0] <= 0.5
    along = np.linspace(np.pi / 2 - np.arcsin(0.5 / np.sqrt(2)), 2 * np.pi - np.pi / 3, 200_001)
    circle = np.sqrt(2) * np.stack([np.cos(along), np.sin(along)])
    circle = circle[:, circle[0] <= 0.5]
    assert end.state.cost <= (rosenbrock(circle) ** 2).sum(0).min() + 1e-6


def test_an_interrupt_keeps_the_best():
    def stop(cycle, state):
        if cycle.number == 3:
            raise KeyboardInterrupt

    end = least_squares(
        squares(rosenbrock, by_rosenbrock), np.array([-1.2, 1.0]), lower=np.full(2, -FAR), upper=np.full(2, FAR),
        watch=stop,
    )  # fmt: skip
    assert end.stopped == "interrupted"
    assert end.state.cost < rosenbrock(np.array([-1.2, 1.0])) @ rosenbrock(np.array([-1.2, 1.0]))


def test_an_interrupt_before_the_first_cycle_keeps_the_start():
    def evaluate(x, derivatives):
        if derivatives:
            raise KeyboardInterrupt
        return squares(rosenbrock, by_rosenbrock)(x, False)

    start = np.array([-1.2, 1.0])
    end = least_squares(evaluate, start, lower=np.full(2, -FAR), upper=np.full(2, FAR))
    assert (end.stopped, end.state.x.tolist()) == ("interrupted", start.tolist())


# -- lenses ------------------------------------------------------------------------------------------------------------


def problem_of(lens, vary, **options):
    free = design_variables(lens, vary)
    return Problem(free, DefaultMerit().rows(lens), **options)


def test_a_triplet_becomes_sharper_and_the_merit_is_that_of_the_lens_it_gives(triplet):
    found = rt.optimize(triplet, merit="spot", vary="curvature thickness", bounds="thickness:1,90", cycles=40)
    assert found.merit_after < 0.5 * found.merit_before
    again = rt.optimize(found.lens, merit="spot", vary="curvature", cycles=1)
    assert again.merit_before == pytest.approx(found.merit_after, rel=1e-9)
    radii = rt.spot(found.lens, wavelengths=found.lens.wavelengths).rms_radius
    assert radii.mean() < rt.spot(triplet, wavelengths=triplet.wavelengths).rms_radius.mean()
    thicknesses = [float(surface.thickness) for surface in found.lens.surfaces[1:-1]]
    assert min(thicknesses) >= 1 - 1e-12
    assert found.contributions.sum() == pytest.approx(1)


def test_the_focal_length_is_held_exactly_from_a_lens_that_has_another(triplet):
    goal = Condition(Row("EFFL", target=90.0))
    found = rt.optimize(triplet, merit="spot", vary="curvature sensor", hold=[goal])
    assert float(rt.first_order(found.lens).effective_focal_length) == pytest.approx(90, abs=1e-8)
    assert found.merit_after < found.merit_before


def test_a_limit_is_kept_where_it_is_in_the_way_and_is_let_go_where_it_is_not(triplet):
    free = rt.optimize(triplet, merit="spot", vary="curvature sensor")
    length = float(rt.first_order(free.lens).effective_focal_length)
    tight = rt.optimize(
        triplet, merit="spot", vary="curvature sensor", hold=[Condition(Row("EFFL", target=length + 3), ">=")]
    )
    assert float(rt.first_order(tight.lens).effective_focal_length) == pytest.approx(length + 3, abs=1e-6)
    loose = rt.optimize(
        triplet, merit="spot", vary="curvature sensor", hold=[Condition(Row("EFFL", target=length - 3), ">=")]
    )
    assert loose.merit_after == pytest.approx(free.merit_after, rel=1e-4)
    assert tight.merit_after > free.merit_after


@pytest.mark.slow
def test_both_engines_end_at_the_same_lens(triplet):
    ends = []
    for engine in ("eager", "auto"):
        with rt.tracing.trace_engine(engine):
            found = rt.optimize(
                triplet, merit=rt.optimization.DefaultMerit("spot", rings=2), vary="curvature:1-3 sensor"
            )
            ends.append(found.variables_after)
    assert torch.allclose(*ends, rtol=1e-6, atol=1e-9)


def test_the_order_of_rows_does_not_matter(triplet):
    rows = [row for row in DefaultMerit().rows(triplet) if row.operand == "TRAC"]
    ends = [rt.optimize(triplet, merit=one, vary="curvature:1-3 sensor") for one in (rows, rows[::-1])]
    assert ends[0].merit_after == pytest.approx(ends[1].merit_after, rel=1e-9)
    assert torch.allclose(ends[0].variables_after, ends[1].variables_after, rtol=1e-5)


def test_a_merit_in_inches_ends_at_the_same_lens(triplet):
    rows = DefaultMerit().rows(triplet)
    variables = tuple(Vary(k, "curvature") for k in (1, 2, 3))
    ends = []
    for unit in (1.0, 25.4):
        in_unit = dataclasses.replace(triplet, optimization_data=OptimizationData(variables, (), rows, unit=unit))
        ends.append(rt.optimize(in_unit))
    assert ends[0].merit_after == pytest.approx(25.4 * ends[1].merit_after, rel=1e-9)
    assert torch.allclose(ends[0].variables_after, ends[1].variables_after, rtol=1e-6)


def test_boundaries_are_known_on_both_sides_and_add_up_to_their_rows(triplet):
    rows = DefaultMerit(glass_thickness=(4.0, 8.0), air_thickness=(1.0, 9.0), edge=3.0).rows(triplet)
    free = design_variables(triplet, "curvature thickness")
    problem = Problem(free, rows)
    x = problem.model.start
    found, state = problem.evaluated(x, True), problem.state(x, True)
    assert (state.sides.excess < 0).any()
    assert (state.sides.excess > 0).any()
    assert state.cost == pytest.approx(found.merit**2, rel=1e-12)
    slopes = np.stack(
        [
            (problem.state(x + h, False).sides.excess - problem.state(x - h, False).sides.excess) / (2 * h.max())
            for h in np.diag(1e-6 * np.maximum(np.abs(x), 1e-2))
        ],
        -1,
    )
    assert slopes == pytest.approx(state.sides.slope, rel=1e-5, abs=1e-5 * np.abs(slopes).max())


@pytest.mark.slow
def test_boundaries_end_a_descent_without_chattering(triplet):
    """Thicknesses come to rest where the rest of the merit presses them, each within a few steps of its boundary."""
    found = rt.optimize(
        triplet,
        merit=rt.optimization.DefaultMerit("spot", glass_thickness="2:9", air_thickness="0.5:90", edge=1.0),
        vary="curvature thickness",
        hold=[Condition(Row("EFFL", target=101.2))],
    )
    assert found.stopped in ("gradient", "merit")
    assert found.cycles < 80
    assert found.merit_after < 0.5 * found.merit_before
    glass = [float(surface.thickness) for k, surface in enumerate(found.lens.surfaces) if k in (1, 3, 6)]
    assert max(glass) < 9.2


def test_a_merit_that_is_no_sum_of_squares_is_descended_by_its_gradient(triplet):
    """The mean of the RMS radii over the field, not their mean square; within bounds."""

    def merit(lens):
        return rt.spot(lens, fields=[0, 8.4], wavelengths=lens.wavelengths).rms_radius.mean()

    found = rt.optimize(triplet, merit=merit, vary="curvature:1-3 sensor", bounds="curvature_1:0.02,0.03", cycles=8)
    assert float(merit(found.lens)) == pytest.approx(found.merit_after, rel=1e-9)
    assert found.merit_after < 0.9 * found.merit_before
    assert 0.02 <= float(found.lens.surfaces[1].curvature) <= 0.03
    assert found.plot().axes
    assert found.document()["operands"] == []
    held = rt.optimize(triplet, merit=merit, vary="curvature:1-3 sensor", hold="efl=100", cycles=3).lens
    assert float(rt.first_order(held).effective_focal_length) == pytest.approx(100, abs=1e-4)


def test_bounds_stay_with_the_lens(triplet, tmp_path):
    lens = dataclasses.replace(triplet, optimization_data=None)
    found = rt.optimize(lens, merit="spot", vary="curvature:1 thickness:1,2", bounds="thickness_1:1..", cycles=1).lens
    assert [one.bounds for one in found.optimization_data.variables] == [(), (1.0, float("inf")), ()]
    rt.write_lens(found, tmp_path / "lens.zmx")
    assert rt.read_lens(tmp_path / "lens.zmx").optimization_data.variables == found.optimization_data.variables


# -- lost rays ---------------------------------------------------------------------------------------------------------


def bent_too_far(lens):
    """The lens with surfaces so steep that rays miss them or are totally reflected."""
    lens = lens.at(entrance_pupil_diameter=float(rt.first_order(lens).entrance_pupil_diameter))
    return lens.replace(4, curvature=torch.tensor(-0.06, dtype=torch.float64))


def test_the_miss_of_a_failed_ray_has_the_derivative_of_differences(triplet):
    problem = problem_of(bent_too_far(triplet), "curvature thickness")
    x = problem.model.start
    found = problem.evaluated(x)
    rows = np.nonzero(found.lost)[0]
    assert len(rows) > 3
    recovery = Recovery(problem.evaluation)
    missed, slopes, _ = recovery.excess(x, rows, derivatives=True)
    assert (missed > 0).all()
    for i in range(len(x)):
        h = 1e-6 * max(abs(x[i]), 1e-2)
        ends = [recovery.excess(x + h * sign * np.eye(len(x))[i], rows, derivatives=False)[0] for sign in (1, -1)]
        assert (ends[0] - ends[1]) / (2 * h) == pytest.approx(slopes[:, i], rel=1e-4, abs=1e-5 * np.abs(slopes).max())


@pytest.mark.slow
def test_a_lens_that_loses_rays_gets_them_back(triplet):
    lens = bent_too_far(triplet)
    before = problem_of(lens, "curvature")
    assert before.state(before.model.start, False).lost > 3
    found = rt.optimize(lens, merit="spot", vary="curvature sensor", seconds=20)
    after = problem_of(found.lens, "curvature")
    assert after.state(after.model.start, False).lost == 0
    assert found.merit_after < 0.1


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_document_has_the_fixed_keys_and_the_lens_round_trips(command_line):
    words = ["optimize", "cooke_triplet", "--merit", "spot", "--vary"]
    done = command_line(*words, "curvature sensor", "--json", "-o", "better.zmx", "--cycles", 6)
    assert done.code == 0, done.err
    document = done.document
    assert [*document] == [
        "merit_before", "merit_after", "cycles", "evaluations", "seconds", "stopped", "variables", "operands",
        "conditions", "between",
    ]  # fmt: skip
    assert [*document["variables"][0]] == ["name", "before", "after"]
    assert [*document["operands"][0]] == ["row", "operand", "target", "weight", "before", "after"]
    assert document["cycles"] <= 6
    own = command_line("optimize", "better.zmx", "--json", "--cycles", 1).document
    assert own["merit_before"] == pytest.approx(document["merit_after"], rel=1e-9)
    assert sorted(one["name"] for one in own["variables"]) == sorted(one["name"] for one in document["variables"])


def test_log_checkpoint_and_resume(command_line, tmp_path):
    words = ["optimize", "cooke_triplet", "--merit", "spot", "--vary", "curvature sensor"]
    done = command_line(*words, "--json", "--log", "log.csv", "--checkpoint", "kept.json", "--cycles", 4)
    assert done.code == 0, done.err
    lines = (tmp_path / "log.csv").read_text().splitlines()
    assert lines[0].startswith("cycle,merit,")
    assert len(lines) == 1 + done.document["cycles"]
    kept = json.loads((tmp_path / "kept.json").read_text())
    assert kept["merit"] == pytest.approx(done.document["merit_after"])
    again = command_line(*words, "--json", "--resume", "kept.json", "--cycles", 4).document
    assert again["merit_after"] < done.document["merit_after"] * (1 + 1e-12)
    other = command_line("optimize", "cooke_triplet", "--merit", "spot", "--vary", "conic:1", "--resume", "kept.json")
    assert "a checkpoint of other variables" in other.error


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--merit", "spot"], "the file has no variables: --vary names them"),
        (["--vary", "curvature"], "no merit function of its own: choose one by --merit spot"),
        (["--merit", "spot", "--vary", "curvature", "--bounds", "curvature:3,2"], "3 is not less than 2"),
        (["--merit", "spot", "--vary", "curvature", "-o", "lens.foo"], "expected a name that ends in .zmx"),
        (["--merit", "spots", "--vary", "curvature"], "did you mean spot"),
    ],
)
def test_errors_of_optimize_are_one_line(words, said, command_line):
    assert said in command_line("optimize", "cooke_triplet", *words).error


def test_a_merit_without_weight_and_one_without_light_are_refused(triplet):
    with pytest.raises(NoProblem, match=r"no row .* has a weight"):
        rt.optimize(triplet, merit=[Row("EFFL")], vary="curvature")
    row = Row("TRAC", (0, 1), (0.0, 0.0, 0.0, 40.0), weight=1.0)
    with pytest.raises(NoProblem, match="no ray"):
        rt.optimize(triplet, merit=[row], vary="sensor")


@pytest.mark.slow
def test_the_figure_shows_before_and_after(triplet, tmp_path):
    found = rt.optimize(triplet, merit="spot", vary="curvature sensor", cycles=5)
    figure = found.plot(tmp_path / "report.png")
    titles = [axes.get_title() for axes in figure.axes]
    assert any(title.startswith("Before: merit") for title in titles)
    assert any(title.startswith("After: merit") for title in titles)
    assert "Merit function" in titles


# -- files with a merit function, where they are at hand ---------------------------------------------------------------

FILES = SHARED / "merit" / "dev"
KNOWN = json.loads((FILES / "oracle.json").read_text())["files"] if (FILES / "oracle.json").exists() else []
QUICK = ("sc_hamm2", "Schmidt-Cassegrain", "sc_slit", "PyZDDE__Doublet", "sc_cooke2", "AchromaticAt800")


def of_files():
    """Every file, the longest slow."""
    for known in KNOWN:
        if (FILES / known["file"]).exists():
            marks = () if any(name in known["file"] for name in QUICK) else pytest.mark.slow
            yield pytest.param(known, marks=marks, id=known["file"])


@pytest.mark.needs(FILES)
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("known", [*of_files()])
def test_a_file_reaches_the_known_merit_from_its_design_and_from_a_moved_one(known):
    lens = rt.read_lens(FILES / known["file"])
    found = rt.optimize(lens, seconds=20)
    assert found.merit_after <= found.merit_before * (1 + 1e-9)
    best = max(known["mf_best"], 1e-9)  # below it is rounding
    if known["settled"]:
        assert found.merit_after <= max(1.0001 * known["mf_stored"], best)
    else:
        assert found.merit_after <= 1.0001 * best
    free = design_variables(lens)
    model = free
    factors = script("bench_optimise").factors(known, [one.name for one in free.variables])
    moved = rt.optimize(model.lens_at(model.start * factors), seconds=20)
    assert moved.merit_before == pytest.approx(known["from_perturbed"]["mf_start"], rel=1e-3)
    assert moved.merit_after <= 1.01 * best


@pytest.mark.parametrize("fell", [*(pytest.param(f, marks=pytest.mark.slow) for f in (0.9, 1e-3)), 1e-7, 0.0])
def test_labels_of_the_merit_history_differ(fell):
    """Also where the merit hardly changes: labels, and what the axis says that they are counted from."""
    found = rt.optimize(rt.read_lens("singlet"), merit="spot", vary="sensor", cycles=3)
    history = torch.zeros(2, 5, dtype=torch.float64)
    history[:, 0] = 0.0453529 * (1 - fell * torch.tensor([0.4, 1.0]))
    changed = dataclasses.replace(found, history=history, merit_before=0.0453529)
    axes = next(a for part in optimize_report(changed).subfigs for a in part.axes if a.get_ylabel() == "merit")
    axes.figure.figure.canvas.draw()
    labels = [label.get_text() for label in axes.get_yticklabels() if label.get_text()]
    assert len(labels) >= 2
    assert len(set(labels)) == len(labels)
    plt.close("all")


def test_lenses_and_spots_before_and_after_are_drawn_on_one_scale():
    """Spots of 100 µm and 7 µm: dots in panels of one size, the small ones enlarged with their factor."""
    found = rt.optimize(rt.read_lens("double_gauss"), merit="spot", vary="sensor", cycles=1)
    assert float(rt.spot(found.lens).rms_radius.max()) < 0.8 * float(rt.spot(found.before).rms_radius.max())
    figure = optimize_report(found)
    layouts, spots = (part.axes for part in figure.subfigs[:2])
    for panels in (layouts, spots):
        spans = {tuple(round(float(np.diff(limit())[0]), 9) for limit in (a.get_xlim, a.get_ylim)) for a in panels}
        assert len(spans) == 1
    plt.close("all")


@pytest.mark.slow
def test_rays_along_the_image_behind_a_break_of_90_degrees_are_no_end_of_an_optimisation(triplet, capfd):
    """They meet the image nowhere and miss it by no number that has a derivative."""
    turned = Surface(torch.tensor(37.4, dtype=torch.float64), before=Pose(tilt_x=torch.tensor(90.0)), is_break=True)
    lens = dataclasses.replace(triplet, surfaces=(*triplet.surfaces[:8], turned, triplet.surfaces[8]))
    problem = problem_of(lens, "curvature")
    state = problem.state(problem.model.start, True)
    assert state.lost
    assert np.isfinite(state.jacobian).all()
    found = rt.optimize(lens, merit=rt.optimization.DefaultMerit("spot", rings=1, arms=2), vary="curvature:1", cycles=1)
    assert "nan" not in str(found)
    assert "DLASCL" not in capfd.readouterr().out


def test_a_row_without_a_derivative_is_refused_with_its_name(triplet):
    """0 · ∞, where a root begins."""
    bad = Row(
        rt.optimization.Measure("bad", lambda lens: 1 + (0 * lens.surfaces[1].curvature).abs().sqrt()), weight=1.0
    )
    with pytest.raises(NoProblem, match=r"row 1 .*bad, .*derivative by curvature_1"):
        rt.optimize(triplet, merit=[bad], vary="curvature:1", cycles=1)


def test_operands_of_which_no_row_counts_are_not_evaluated_on_the_way(triplet):
    """Rows without a weight are shown at both ends alone; those that a row of arithmetic takes are evaluated."""
    called = []
    idle = Row(rt.optimization.Measure("idle", lambda lens: called.append(1) or lens.surfaces[1].curvature))
    rows = [*DefaultMerit(rings=1, arms=2).rows(triplet), idle]
    found = rt.optimize(triplet, merit=rows, vary="curvature:1-3", cycles=6)
    assert found.values_after[-1] == pytest.approx(float(found.lens.surfaces[1].curvature))
    assert len(called) < 10 < found.evaluations
    used = [*rows, Row("OPVA", (len(rows), 0), weight=1.0)]
    called.clear()
    assert rt.optimize(triplet, merit=used, vary="curvature:1-3", cycles=6).evaluations <= len(called)


def test_cycles_are_limited_where_neither_they_nor_the_time_are(monkeypatch):
    """Along a narrow valley a merit may fall for ever; who gives a time has all of it."""
    monkeypatch.setattr(paths, "_UNLIMITED", 3)
    state, start, ends = squares(rosenbrock, by_rosenbrock), np.array([-1.2, 1.0]), np.full(2, FAR)
    found = paths.best_of_paths(state, start, lower=-ends, upper=ends)
    assert (found.cycles, found.stopped) == (3, "cycles")
    assert paths.best_of_paths(state, start, lower=-ends, upper=ends, seconds=60).cycles > 3
    assert paths.best_of_paths(state, start, lower=-ends, upper=ends, cycles=5).cycles == 5


def test_each_cycle_is_watched_with_its_lens_and_an_interrupt_keeps_the_last():
    lens, seen = rt.read_lens("cooke_triplet"), []

    def watch(cycle, shown):
        seen.append((cycle, shown))
        if cycle.number == 3:
            raise KeyboardInterrupt

    found = rt.optimize(lens, merit="spot", vary="curvature", watch=watch)
    assert (found.stopped, found.cycles) == ("interrupted", 3)
    assert [cycle.merit for cycle, _ in seen] == found.history[:, 0].tolist()
    last = seen[-1][1]
    for a, b in zip(last.surfaces, found.lens.surfaces, strict=True):
        assert a.curvature is b.curvature is None or float(a.curvature) == float(b.curvature)
    assert last.optimization_data.variables == found.lens.optimization_data.variables
    assert float(rt.evaluate(last, merit="spot").merit) == pytest.approx(seen[-1][0].merit, rel=1e-9)


@pytest.mark.slow
def test_an_mtf_that_starts_near_zero_is_reported():
    """Through spots first the same merit function ends far lower, and the line is gone."""
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="paraxial", fields=[0.0, 8.4])
    unsharp = lens.at(sensor_distance=lens.surfaces[-2].thickness + 2)
    mtf = dict(merit=rt.optimization.DefaultMerit("mtf", frequencies=[20]), vary="sensor")
    stuck = rt.optimize(unsharp, **mtf)
    better = rt.optimize(rt.optimize(unsharp, merit="spot", vary="sensor").lens, **mtf)
    assert "2 of 2 rows of the MTF start below 0.1, where it hardly has a slope: minimise `merit=spot` first" in str(
        stuck
    )
    assert stuck.merit_after > 0.9 * stuck.merit_before > 1.2 * better.merit_after
    assert "rows of the MTF start" not in str(better)

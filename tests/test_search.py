"""Global search: starts, the journal, distinct minima, the function and its command."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas
import pytest
import torch

import raytrace as rt
from raytrace.edit.surfaces import without
from raytrace.materials.glass import is_air
from raytrace.optimization.conditions import conditions_of
from raytrace.optimization.curriculum import Growth, Plan, Step
from raytrace.optimization.least_squares import SolverOptions, least_squares
from raytrace.optimization.merit import DefaultMerit, Evaluation
from raytrace.optimization.moves import projected, started_at, thinned
from raytrace.optimization.opening import opened
from raytrace.optimization.operands.operand import conventions_of
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.removal import Closing
from raytrace.optimization.saddle_points import Enlargement, divided, enlarged, saddle
from raytrace.optimization.search import Minima
from raytrace.optimization.search_tasks import (
    BadSearch,
    Journal,
    Minimum,
    SearchProblem,
    SearchStopped,
    TaskResult,
    length_of,
    space_of,
)
from raytrace.optimization.variables import DesignVariables, bounds_of, design_variables

PLANE = float("inf")
PLAIN = {"unit": 1.0, "skip_unknown": False, "conventions": conventions_of(None)}  # of a problem
HOW = {
    "merit": rt.optimization.DefaultMerit("spot", glass_thickness="2:8", edge=1.0, rings=2),
    "vary": "curvature thickness",
}


def plates(*glasses, diameter=10.0, fields=(0.0, 7.0)):
    rows = [row for glass in glasses for row in (dict(thickness=4, glass=glass), dict(thickness=2))]
    rows[-1]["thickness"] = 45
    return rt.lens(rows, stop=2, fields=fields, entrance_pupil_diameter=diameter, name="Plates")


@pytest.fixture(scope="module")
def plate():
    return plates(1.6)


@pytest.fixture(scope="module")
def found(plate):
    return rt.search(plate, hold="efl=50", starts=8, **HOW)


# -- starts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("glasses", [(1.6,), (1.6, 1.8), (1.6, 1.8, 1.5, 1.7)])
def test_starts_have_the_focal_length_and_the_sensor_at_the_paraxial_focus(glasses):
    lens = plates(*glasses)
    free = design_variables(lens, "curvature thickness")
    model = DesignVariables(free.lens, free.variables)
    space = space_of(model, bounds_of(free.lens, free.variables, "sensor:1..500"), 50.0)
    points = [model.start, *space.sobol(1, 16, seed=0)]
    brought = 0
    for x in map(space.prepared, points):
        assert (x >= space.lower).all()
        assert (x <= space.upper).all()
        made = model.lens_at(x)
        length = float(rt.first_order(made).effective_focal_length)
        if length == pytest.approx(50, rel=1e-6):
            brought += 1
            distance = float(rt.tracing.paraxial_image_distance(made, np.inf))
            assert float(made.surfaces[-2].thickness) == pytest.approx(np.clip(distance, 1, 500), rel=1e-9)
    assert brought >= 12  # steep ones of other signs have no such scale within their bounds


def test_starts_are_spread_evenly_and_are_the_same_in_any_order(plate):
    free = design_variables(plate, "curvature thickness")
    model = DesignVariables(free.lens, free.variables)
    space = space_of(model, bounds_of(free.lens, free.variables), 50.0)
    blocks = [space.sobol(k, 8, seed=3) for k in range(8)]
    assert np.array_equal(space.sobol(5, 8, seed=3), blocks[5])
    assert not np.array_equal(space.sobol(5, 8, seed=4), blocks[5])
    parts = (np.concatenate(blocks) - space.low) / (space.high - space.low)
    counts = [np.histogram(part, 8, (0, 1))[0] for part in parts.T]
    assert np.array_equal(counts, np.full_like(counts, 8))  # a net: as many in each eighth


@pytest.mark.slow
def test_a_start_that_loses_rays_of_half_the_beam_is_opened_step_by_step(monkeypatch):
    steep = plates(1.8, diameter=36.0, fields=(0.0, 25.0))
    for k, c in ((1, -0.05), (2, -0.06)):
        steep = steep.replace(k, curvature=torch.tensor(c, dtype=torch.float64))
    lost = []

    def recorded(problem, x, **bounds):
        found = opened(problem, x, **bounds)
        lost.append([problem.state(one, False).lost for one in (x, found[0])])
        return found

    monkeypatch.setattr("raytrace.optimization.search.opened", recorded)
    found = [rt.search(steep, hold="efl=50", starts=1, bounds=f"curvature:-{c}..{c}", **HOW).merit for c in (0.1, 0.06)]
    assert lost[0][0] > 0
    assert lost[0][1] == 0
    assert torch.allclose(*found, rtol=1e-3)


def test_the_focal_length_is_that_held_that_of_a_row_or_that_of_the_lens():
    lens = rt.read_lens("cooke_triplet")
    model, own = DesignVariables(lens), float(rt.first_order(lens).effective_focal_length)
    rows = DefaultMerit().rows(lens)
    assert length_of(model, rows, 1.0, ()) == pytest.approx(own)
    aimed = (*rows, rt.system.Row("EFFL", target=3.0, weight=1.0))
    assert length_of(model, aimed, 25.4, ()) == pytest.approx(76.2)
    assert length_of(model, aimed, 1.0, conditions_of(lens, "efl=70")) == 70


# -- minima ------------------------------------------------------------------------------------------------------------


def ended(x, merit, lost=0):
    return TaskResult(float(lost), 0.0, merit, 1.0, np.array(x, dtype=float))


def test_a_minimum_is_kept_once_and_the_best_of_its_finds():
    minima = Minima(np.ones(2))
    assert minima.add(ended([0.5, 0.5], 2.0), "a", 1)
    assert not minima.add(ended([0.501, 0.5], 2.001), "b", 2)
    assert minima.add(ended([0.5, 0.9], 2.0), "c", 3)
    assert minima.add(ended([0.1, 0.1], 1.0), "d", 4)
    assert not minima.add(ended([0.9, 0.1], 0.1, lost=1), "e", 5)
    assert [(one.task, one.descents) for one in minima.each] == [("d", 1), ("a", 2), ("c", 1)]
    assert minima.add(ended([0.505, 0.5], 1.99), "f", 6)
    assert [(one.task, one.descents) for one in minima.each] == [("d", 1), ("f", 3), ("c", 1)]


def test_a_lens_and_the_same_turned_round_are_one():
    minima = Minima(np.ones(2), (np.array([1, 0]), np.array([-1.0, -1.0])))
    assert minima.add(ended([0.5, -0.2], 1.0), "a", 1)
    assert not minima.add(ended([0.2, -0.5], 1.0), "b", 2)


@pytest.mark.slow
def test_the_one_minimum_of_a_singlet_is_found_from_everywhere(found):
    assert len(found.lenses) == 1
    assert found.times_reached.tolist() == [8]  # four starts that are followed, and four hops
    assert found.lens is found.lenses[0]


@pytest.mark.slow
def test_each_minimum_is_reported_once_and_is_one():
    how = {
        **HOW,
        "hold": "efl=50",
        "bounds": "thickness:0.25..17.5 thickness:1,3:2..8 sensor:2.5..100 curvature:-0.08..0.08",
    }
    found = rt.search(plates(1.5, 1.8), starts=8, **how)
    assert len(found.lenses) >= 2
    assert (found.merit[1:] >= found.merit[:-1]).all()
    assert found.focal_length.tolist() == pytest.approx([50] * len(found.lenses), rel=1e-6)
    best = rt.optimize(found.lens, cycles=30, **how)
    assert best.merit_before == pytest.approx(float(found.merit[0]), rel=1e-9)
    assert best.merit_after > 0.97 * best.merit_before
    ranges = found.variables.max(0).values - found.variables.min(0).values
    apart = (found.variables[:, None] - found.variables).abs() / ranges
    assert (apart.amax(-1) + torch.eye(len(found.lenses)) > 0.03).all()


@pytest.mark.slow
def test_the_best_singlet_is_that_of_a_scan_over_its_bending(plate, found):
    """Of one thin lens with its stop near, the bending decides."""
    scanned = []
    for first in np.linspace(-0.06, 0.06, 7):
        bent = plate.replace(1, curvature=torch.tensor(first, dtype=torch.float64))
        bent = bent.replace(2, curvature=torch.tensor(first - 1 / 30, dtype=torch.float64))
        scanned.append(
            rt.optimize(bent, hold="efl=50", bounds="thickness:1..80 curvature:-0.08..0.08", **HOW).merit_after
        )
    assert float(found.merit[0]) <= min(scanned) * 1.02


# -- a thin meniscus inserted ------------------------------------------------------------------------------------------


def test_a_meniscus_without_thickness_changes_no_ray_and_no_merit():
    lens = rt.read_lens("cooke_triplet")
    free = design_variables(lens, "curvature thickness:2,4 sensor curvature:6=-curvature:1")
    rows = (
        *DefaultMerit().rows(lens),
        rt.system.Row("REAY", (6, 2), (0, 1, 0, 1), target=5, weight=1),
        rt.system.Row("MNEG", (1, 6)),
    )
    asked = SearchProblem(
        free, rows, conditions_of(lens, "bfd>=40"), bounds_of(free.lens, free.variables), None, None, PLAIN
    )
    before = asked.whole.evaluated(asked.model.start)
    for k in (1, 2, 3, 4, 7):
        one = enlarged(lens, asked, k)
        made, moved = one.model.lens_at(one.model.start), lambda s, k=k: s + 2 if s >= k else s
        assert [made.surfaces[moved(s)].glass for s in range(7)] == [surface.glass for surface in lens.surfaces[:7]]
        assert made.stop == moved(lens.stop)
        assert {surface.glass.name for surface in made.surfaces[k - 1 : k + 3]} >= {made.surfaces[k + 2].glass.name}
        after = one.whole.evaluated(one.model.start)
        assert after.residuals == pytest.approx(before.residuals, abs=1e-12)
        variables = {(moved(v.surface), v.quantity) for v in free.variables}
        added = {(s, quantity) for s in (k, k + 1) for quantity in ("curvature", "thickness")}
        assert {(v.surface, v.quantity) for v in one.model.variables} == variables | added
        assert {(moved(6), moved(1))} == {(v.surface, v.source) for v in one.model.solves}


def test_a_range_of_gaps_is_that_of_old_and_a_part_of_the_new_ones():
    rows = (
        rt.system.Row("MNEG", (1, 6), target=2.0, weight=1),
        rt.system.Row("MXCG", (1, 6), target=9.0, weight=1),
        rt.system.Row("EFFL"),
    )
    numbers = lambda part: [(row.operand, row.integers, row.target) for row in thinned(rows, (3, 4), part)]  # noqa: E731
    others = [("MXCG", (1, 6), 9.0), ("EFFL", (0, 0), 0.0)]
    assert numbers(0) == [("MNEG", (1, 2), 2.0), *others, ("MNEG", (5, 6), 2.0)]
    assert numbers(0.5) == [*numbers(0), ("MNEG", (3, 4), 1.0)]
    assert numbers(1) == [("MNEG", (1, 6), 2.0), *others]


@pytest.fixture(scope="module")
def best_triplet():
    """What is asked of a triplet, and the lens at its minimum."""
    lens = rt.read_lens("cooke_triplet")
    free = design_variables(lens, "curvature thickness")
    rows, held = tuple(DefaultMerit(rings=2).rows(lens)), conditions_of(lens, "efl=100")
    bounds = bounds_of(free.lens, free.variables, "thickness:1..30 sensor:60..120")
    asked = SearchProblem(free, rows, held, bounds, (2.0, 8.0), (0.5, 30.0), PLAIN)
    x, space = asked.model.start, asked.space
    for options in (SolverOptions(), SolverOptions(damping=1e-8)):
        x = least_squares(asked.whole.state, x, lower=space.lower, upper=space.upper, options=options).state.x
    return asked, asked.model.lens_at(x)


@pytest.mark.parametrize("k", [1, 2, 4])
def test_at_a_minimum_the_meniscus_is_a_saddle_with_one_way_down(best_triplet, k):
    """The merit has no slope along any step that meets the conditions, and curves down along one alone."""
    asked, lens = best_triplet
    place = Enlargement((k, k + 1), (k, k + 1), enlarged(lens, asked, k))
    stage, x = place.stage(0.0, 1, SolverOptions()), place.task.model.start
    size = np.sqrt(stage.problem.state(x, False).cost)
    found = saddle(stage.problem, x, stage.moves(x))
    assert np.abs(found.slope).max() < 1e-7 * size
    curves = np.linalg.eigvalsh(found.curves)
    assert curves[0] < -1e-9 < curves[1]
    for sign in (1.0, -1.0):
        state = stage.problem.state(place.displaced(stage, sign), False)
        assert np.sqrt(state.cost) < size
        assert np.abs(state.held).max() < 1e-9


def test_along_both_lines_of_a_null_meniscus_the_merit_stays(best_triplet):
    asked, lens = best_triplet
    one = enlarged(lens, asked, 4)
    places = [[(v.surface, v.quantity) for v in one.model.variables].index((s, "curvature")) for s in (4, 5, 6)]
    before = one.whole.evaluated(one.model.start).residuals
    for pair in (places[:2], places[1:]):
        x = one.model.start.copy()
        x[pair] += 0.004
        assert one.whole.evaluated(x).residuals == pytest.approx(before, abs=1e-10)


@pytest.mark.slow
def test_from_a_singlet_to_better_lenses_of_two_elements(found, tmp_path):
    how = {**HOW, "hold": "efl=50"}
    two = rt.search(found.lens, moves="insert:1", folder=tmp_path, **how)
    assert (two.stopped, two.starts) == ("moves", 2)
    assert float(two.merit[0]) < 0.8 * float(found.merit[0])
    assert (two.merit[1:] >= two.merit[:-1]).all()
    assert {task.partition(",")[0] for task in two.tasks} == {"the lens > insert 1"}
    assert (two.elements == 2).all()
    assert two.focal_length.tolist() == pytest.approx([50] * len(two.lenses), rel=1e-6)
    for lens in two.lenses:
        glass = [k for k in range(1, 5) if not is_air(lens.surfaces[k].glass)]
        assert glass == [1, 3]
        assert min(float(lens.surfaces[k].thickness) for k in glass) > 2 - 1e-3
        assert min(edge_of(lens, k) for k in glass) > 1 - 1e-3
    again = rt.search(found.lens, moves="insert:1", folder=tmp_path, **how)
    assert torch.equal(again.variables, two.variables)
    with pytest.raises(BadSearch, match="a search of other moves"):
        rt.search(found.lens, moves="insert:2", folder=tmp_path, **how)


def edge_of(lens, k):
    """Thickness of the glass behind surface k where the widest beam of all goes through it."""
    row = rt.system.Row("ETVA", (k, 0), weight=1.0)
    return float(rt.evaluate(lens, merit=[row]).values[0])


@pytest.mark.slow
def test_from_a_triplet_to_better_lenses_of_four_elements():
    merit = rt.optimization.DefaultMerit("spot", glass_thickness="2:12", air_thickness="0.5:40", edge=1.0)
    how = {"merit": merit, "vary": "curvature thickness", "hold": "efl=100"}
    triplet = rt.read_lens("cooke_triplet")
    three = rt.optimize(triplet, cycles=200, **how)
    four = rt.search(triplet, moves="insert:1,4,7", **how)
    assert len(four.lenses) == 6
    assert (four.merit < three.merit_after).all()
    assert float(four.merit[0]) < 0.65 * three.merit_after
    assert float(four.spots[0].max()) < 0.008


# -- one element less --------------------------------------------------------------------------------------------------


def test_without_power_and_thickness_an_element_changes_no_ray(best_triplet):
    asked, lens = best_triplet
    removal = Closing(3, lens, asked)
    stage = removal.stage(0.0)
    x = np.clip(removal._whole.model.start, stage.lower, stage.upper)
    thin, reduced = removal._whole.model.lens_at(x), removal.reduced
    assert [surface.glass.name for surface in reduced.model.lens.surfaces].count("SK4") == 2
    assert torch.allclose(rt.spot(without(thin, 3, 4)[0]).rms_radius, rt.spot(thin).rms_radius, rtol=1e-9)
    assert len(reduced.model.variables) == len(asked.model.variables) - 4
    assert reduced.whole.merit(reduced.whole.evaluated(removal.without(x)), removal.without(x)) == pytest.approx(
        stage.problem.merit(stage.problem.evaluated(x), x), rel=1e-9
    )


def test_the_stop_and_the_image_keep_their_places(best_triplet):
    _, lens = best_triplet
    assert (lens.stop, without(lens, 6, 7)[0].stop, without(lens, 1, 2)[0].stop) == (5, 5, 3)
    for k in (1, 3, 6):
        total = sum(float(surface.thickness) for surface in lens.surfaces[1:-1])
        shorter = sum(float(surface.thickness) for surface in without(lens, k, k + 1)[0].surfaces[1:-1])
        gone = sum(float(surface.thickness) for surface in lens.surfaces[1:3]) if k == 1 else 0.0
        assert shorter == pytest.approx(total - gone, rel=1e-12)


@pytest.mark.slow
def test_an_element_that_was_inserted_is_removed_again(best_triplet):
    """Of four elements the removal of any, the best one of all, is at least as good as the triplet."""
    asked, lens = best_triplet
    how = {
        "merit": asked.rows,
        "vary": "curvature thickness",
        "hold": "efl=100",
        "bounds": "thickness:1..30 sensor:60..120",
    }
    three = rt.optimize(lens, **how)
    four = rt.search(lens, moves="insert:4", **how)
    again = rt.search(four.lens, moves="delete", **how)
    assert (again.stopped, again.starts) == ("moves", 4)
    assert float(again.merit[0]) <= 1.001 * three.merit_after
    assert len(again.lens.surfaces) == len(lens.surfaces)


# -- minima of a loss --------------------------------------------------------------------------------------------------


def mean_distance(points):
    """A loss that is no sum of squares: the mean distance of rays from their centroid, mm."""
    about = points - points.mean((-2, -1), keepdim=True)
    return (about.square().sum(0) + 1e-12).sqrt().mean()


def test_minima_of_the_merit_are_followed_to_minima_of_a_loss(tmp_path):
    triplet = rt.read_lens("cooke_triplet").at(wavelengths=[0.5876])
    how = {"merit": "spot", "vary": "curvature:1,2 sensor", "hold": "efl", "starts": 2, "seed": 1}
    how["bounds"] = "sensor:60..90"
    of_merit = rt.search(triplet, **how)
    of_loss = rt.search(triplet, loss=mean_distance, of=rt.optimization.Points(4), folder=tmp_path, **how)
    quantity = rt.optimization.Points(8)  # by which the ends are checked
    values = [float(mean_distance(quantity(lens))) for lens in of_loss.lenses]
    assert of_loss.loss.tolist() == pytest.approx(values, rel=1e-9)
    assert values == sorted(values)
    assert values[0] < 0.999 * min(float(mean_distance(quantity(lens))) for lens in of_merit.lenses)
    assert of_loss.focal_length.tolist() == pytest.approx(of_merit.focal_length.tolist(), rel=1e-6)
    assert (of_loss.merit >= of_merit.merit.min() * (1 - 1e-6)).all()
    again = rt.search(triplet, loss=mean_distance, of=rt.optimization.Points(4), folder=tmp_path, **how)
    assert torch.equal(again.variables, of_loss.variables)
    assert "loss" in str(of_loss)
    with pytest.raises(NoProblem, match="as_built"):
        rt.search(triplet, loss=mean_distance, as_built=rt.tolerancing.AsBuilt(grade="precision"), **how)


def steep(points):
    return (1e3 * mean_distance(points)) ** 6


def test_lenses_without_an_element_are_followed_to_minima_of_a_loss(tmp_path):
    """Those whose loss is more than twice that of the best one are left out."""
    triplet = rt.read_lens("cooke_triplet").at(wavelengths=[0.5876], fields=[0, 4], f_number=12)
    how = {"merit": "spot", "vary": "curvature sensor", "hold": "efl", "bounds": "sensor:20..140", "moves": "delete"}
    quantity, denser = rt.optimization.Points(4), rt.optimization.Points(8)
    of_spots = rt.search(triplet, **how)
    of_loss = rt.search(triplet, loss=steep, of=quantity, folder=tmp_path, **how)
    before = [float(steep(quantity(lens))) for lens in of_spots.lenses]
    assert (of_loss.stopped, len(of_loss.lenses)) == ("moves", sum(loss <= 2 * min(before) for loss in before))
    assert 0 < len(of_loss.lenses) < len(of_spots.lenses)
    assert {len(lens.surfaces) for lens in of_loss.lenses} == {len(triplet.surfaces) - 2}
    by_denser = [float(steep(denser(lens))) for lens in of_loss.lenses]
    assert of_loss.loss.tolist() == pytest.approx(by_denser, rel=0.02)
    assert of_loss.loss[0] < 0.999 * min(float(steep(denser(lens))) for lens in of_spots.lenses)
    again = rt.search(triplet, loss=steep, of=quantity, folder=tmp_path, **how)
    assert torch.equal(again.variables, of_loss.variables)


# -- moves -------------------------------------------------------------------------------------------------------------


def problem_of(lens, rows, hold, vary="curvature thickness", bounds="thickness:1..30 sensor:40..120"):
    free = design_variables(lens, vary)
    ends = bounds_of(free.lens, free.variables, bounds)
    return SearchProblem(free, tuple(rows), conditions_of(lens, hold), ends, (2.0, 8.0), (0.5, 30.0), PLAIN)


def test_an_element_in_two_parts_of_half_its_power_changes_no_ray(best_triplet):
    asked, lens = best_triplet
    cut = divided(lens, asked, 1)
    made = cut.model.lens
    c = [0.0 if surface.curvature is None else float(surface.curvature) for surface in made.surfaces]
    assert c[1] - c[2] == pytest.approx(c[3] - c[4], rel=1e-12)
    assert c[2] == c[3]
    assert [surface.glass.name for surface in made.surfaces[1:5]] == ["SK4", "", "SK4", ""]
    assert float(made.surfaces[2].thickness) == 0
    before = asked.whole.evaluated(started_at(asked, variables_at(asked, lens)).model.start)
    assert cut.whole.evaluated(cut.model.start).residuals == pytest.approx(before.residuals, abs=1e-10)
    assert len(cut.model.variables) == len(asked.model.variables) + 4


def variables_at(asked, lens):
    return dataclasses.replace(asked.model, lens=lens).start


@pytest.mark.parametrize(("k", "gaps"), [(1, (1, 2)), (4, (4, 5)), (7, (7, 8))])
def test_boundaries_hold_for_new_gaps_too_at_either_end_of_the_lens(k, gaps):
    merit = DefaultMerit(glass_thickness="2:8", air_thickness="0.5:12", edge=1.0, rings=2)
    lens = rt.read_lens("cooke_triplet")
    one = enlarged(lens, problem_of(lens, merit.rows(lens), "efl=100"), k)
    for row in one.rows:
        if row.operand in ("MNCG", "MNEG", "MNCA", "MNEA", "MXCG", "MXCA"):
            assert row.integers[0] <= gaps[0], row
            assert row.integers[1] >= gaps[1], row


def test_a_projection_restores_focal_length_defocus_and_conditions(best_triplet):
    """Of a lens of whose middle element 40 % of the power and the thickness are taken away."""
    asked, lens = best_triplet
    closing = Closing(3, lens, asked)
    whole, stage = closing._whole, closing.stage(0.6)
    start = whole.model.start
    flat = np.clip(start, stage.lower, stage.upper)

    def figures(x):
        made = whole.model.lens_at(x)
        focus = float(rt.tracing.paraxial_image_distance(made, np.inf))
        return float(rt.first_order(made).effective_focal_length), float(made.surfaces[-2].thickness) - focus

    assert figures(start)[0] == pytest.approx(100, rel=1e-9)
    assert abs(figures(flat)[0] - 100) > 20
    at = projected(whole.space, start)(stage, start)
    assert figures(at) == pytest.approx(figures(start), rel=1e-6)
    assert np.abs(stage.problem.state(at, False).held).max() < 1e-9
    fixed = stage.lower == stage.upper
    assert fixed.sum() == 3
    assert np.array_equal(at[fixed], stage.lower[fixed])


def doublet():
    """Two elements whose facing surfaces differ a little, f = 100 mm."""
    rows = [dict(radius=61, thickness=6, glass="N-BK7"), dict(radius=-45, thickness=0.6)]
    rows += [dict(radius=-44, thickness=2.5, glass="N-SF5"), dict(radius=-130, thickness=95)]
    colours = {"wavelengths": [0.4861327, 0.5875618, 0.6562725], "primary_wavelength": 2, "catalogs": ["schott"]}
    return rt.lens([dict(thickness=1), *rows], stop=1, entrance_pupil_diameter=20, fields=[0, 1.5], **colours)


CEMENTED = {
    "merit": DefaultMerit("spot", rings=2, glass_thickness="2:8", air_thickness="0.2:10", edge=1.0),
    "vary": "curvature sensor thickness:3",
    "hold": "efl=100",
    "bounds": "sensor:60..120 thickness:3:0.2..10",
}


def test_facing_surfaces_that_nearly_agree_are_cemented():
    found = rt.search(doublet(), moves="cement", **CEMENTED)
    assert (found.stopped, found.elements.tolist(), found.groups.tolist()) == ("moves", [2], [1])
    assert [surface.glass.name for surface in found.lens.surfaces] == ["", "", "N-BK7", "N-SF5", "", ""]
    assert float(found.focal_length[0]) == pytest.approx(100, rel=1e-8)
    again = rt.optimize(found.lens, **{**CEMENTED, "vary": "curvature sensor", "bounds": "sensor:60..120"})
    assert again.merit_after == pytest.approx(float(found.merit[0]), rel=1e-3)
    cemented = rt.edit.cement(doublet(), "3-4")
    best = rt.optimize(cemented, **{**CEMENTED, "vary": "curvature sensor", "bounds": "sensor:60..120"})
    assert float(found.merit[0]) <= best.merit_after * 1.01


def singlet():
    rows = [dict(thickness=2), dict(radius=51.68, thickness=4, glass="N-BK7"), dict(thickness=95)]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=20, fields=[0, 3], catalogs=["schott"], name="Singlet")


UP_AND_DOWN = {
    "merit": DefaultMerit("spot", rings=2, glass_thickness="2:8", air_thickness="0.5:10"),
    "vary": "curvature sensor",
    "hold": "efl=100",
    "bounds": "sensor:60..120",
    "moves": "split delete",
    "elements": "1:2",
    "keep": 1,
}


@pytest.fixture(scope="module")
def one_and_two(tmp_path_factory):
    folder = tmp_path_factory.mktemp("moves")
    return folder, rt.search(singlet(), folder=folder, **UP_AND_DOWN)


def test_the_best_lens_of_every_number_of_elements_is_found(one_and_two):
    folder, found = one_and_two
    assert found.elements.tolist() == [2, 1]
    assert float(found.merit[0]) < 0.7 * float(found.merit[1])
    assert found.focal_length.tolist() == pytest.approx([100, 100], rel=1e-8)
    assert {number: len(lens.surfaces) for number, lens in found.of_elements.items()} == {1: 5, 2: 7}
    one = rt.optimize(singlet(), **{key: UP_AND_DOWN[key] for key in ("merit", "vary", "hold", "bounds")})
    assert float(found.merit[1]) <= one.merit_after * 1.001
    two = found.of_elements[2]
    glass = [k for k, surface in enumerate(two.surfaces) if surface.glass.name == "N-BK7"]
    assert min(float(two.surfaces[k].thickness) for k in glass) > 2 - 1e-3
    keys = [json.loads(line).get("task", "") for line in (folder / "search.jsonl").read_text().splitlines()]
    assert any("> delete" in key for key in keys)  # down again
    assert "elements" in str(found)


def test_a_search_by_moves_resumes_with_the_same_result(one_and_two, tmp_path):
    folder, found = one_and_two
    lines = (folder / "search.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "search.jsonl").write_text("".join(lines[:-3]))
    again = rt.search(singlet(), folder=tmp_path, **UP_AND_DOWN)
    assert torch.equal(again.variables.nan_to_num(), found.variables.nan_to_num())
    assert again.tasks == found.tasks
    with pytest.raises(BadSearch, match="a search of other elements"):
        rt.search(singlet(), folder=tmp_path, **UP_AND_DOWN | {"elements": "1:3"})


@pytest.mark.slow
def test_lenses_of_every_number_of_elements_are_at_minima_of_a_loss():
    """Moves lead from the minima of the merit function, and lenses are kept by the loss."""
    quantity = rt.optimization.Points(4)
    found = rt.search(singlet(), loss=mean_distance, of=quantity, **UP_AND_DOWN)
    assert found.elements.tolist() == [2, 1]
    denser = rt.optimization.Points(8)
    assert found.loss.tolist() == pytest.approx([float(mean_distance(denser(lens))) for lens in found.lenses], rel=0.02)
    assert found.focal_length.tolist() == pytest.approx([100, 100], rel=1e-7)
    for lens in found.lenses:
        how = {key: UP_AND_DOWN[key] for key in ("vary", "hold", "bounds")}
        again = rt.optimize(lens, loss=mean_distance, of=quantity, first=None, **how)
        assert again.loss.end > 0.98 * again.loss.start


@pytest.mark.slow
def test_moves_from_the_best_minima_of_starts():
    how = {**UP_AND_DOWN, "moves": "insert split", "elements": 2}
    plate = singlet().replace(2, curvature=None)
    found = rt.search(plate, starts=4, **how)
    assert (found.elements == 2).all()
    assert all(task.split(" > ")[0].endswith(("followed", "hop 0", "hop 1", "hop 2", "hop 3")) for task in found.tasks)


# -- a curriculum ------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def phone_plates():
    return rt.read_lens("phone_plates")


def test_a_step_has_its_part_of_aperture_and_field_and_its_terms(phone_plates):
    plan = Plan("phone", phone_plates, None, None, ["efl=6", "chief_ray_angle<=30"], None)
    first = plan.problem(phone_plates, Step(0.4, 0.5, 4))
    last = plan.problem(phone_plates, Step(1.0, 1.0, 9, ("conic", "a4"), 6))
    assert float(rt.first_order(first.model.lens).entrance_pupil_diameter) == pytest.approx(0.4 * 3)
    assert first.model.lens.fields.y.tolist() == pytest.approx([0, 5, 10, 15])
    assert last.model.lens.fields.extent == pytest.approx(30)
    assert len(last.model.variables) == len(first.model.variables) + 20
    held = {condition.name: (condition.relation, condition.row.target) for condition in last.conditions}
    assert held == {"efl": ("=", 6.0), "chief_ray_angle": ("<=", 30.0), "total_track": ("<=", 8.1), "bfd": (">=", 0.48)}
    assert first.glass == pytest.approx((0.18, 0.96))


@pytest.mark.parametrize(
    ("lens", "hold", "said"),
    [
        ("phone_plates", None, "needs the focal length"),
        ("folded_relay", "efl=6", "kind"),
    ],
)
def test_a_curriculum_refuses_what_it_cannot_begin_with(lens, hold, said):
    with pytest.raises(NoProblem, match=said):
        rt.search(lens, kind="phone", hold=hold)


def test_unknown_kinds_and_other_ways_beside_a_kind_are_refused(phone_plates):
    with pytest.raises(NoProblem, match="expected phone"):
        rt.search(phone_plates, kind="fone", hold="efl=6")
    with pytest.raises(NoProblem, match="goes without"):
        rt.search(phone_plates, kind="phone", moves="insert")
    with pytest.raises(NoProblem, match="a merit function of its own"):
        rt.search(phone_plates, kind="phone", hold="efl=6", merit="wavefront")


def test_the_step_at_which_a_curriculum_ends_is_said(phone_plates, monkeypatch):
    plan = Plan("phone", phone_plates, None, None, ["efl=6"], None)
    start = plan.problem(phone_plates, plan.curriculum.steps[0])
    minimum = Minimum(TaskResult(0.0, 0.0, 1.0, 0.0, start.model.start), "3, followed", 0.0)
    growth = Growth(plan, SimpleNamespace(through=lambda progress: None, each=lambda: [(start, minimum)]),
                    Journal(None, {}, np.inf))  # fmt: skip
    monkeypatch.setattr(Growth, "_is_far", lambda *args: False)
    monkeypatch.setattr(Growth, "_descended", lambda self, task, step: TaskResult(2.0, 0.0, 1.0, 0.0, task.model.start))
    growth.through(None)
    assert growth.each() == []
    assert growth.ended == [
        "from minimum 3, followed: failing rays in 2 rows at 40% of the aperture and 50% of the field"
    ]


@pytest.mark.slow
def test_from_plates_to_a_phone_lens_that_is_as_sharp_between_its_fields(phone_plates, tmp_path):
    result = rt.search(phone_plates, kind="phone", hold="efl=6", starts=2, folder=tmp_path)
    lens = result.lens
    assert result.stopped == "steps"
    data = rt.first_order(lens)
    assert float(data.effective_focal_length) == pytest.approx(6, rel=1e-6)
    assert float(data.f_number) == pytest.approx(2, rel=1e-6)
    dense = rt.spot(lens, fields=torch.linspace(0, 30, 61).tolist(), rings=20)
    assert float(dense.whole.rms_radius.max()) < 0.004
    assert float(result.between[0]) < 1.5
    assert sum(float(surface.thickness) for surface in lens.surfaces[1:-1]) < 1.35 * 6 + 1e-6
    again = rt.search(phone_plates, kind="phone", hold="efl=6", starts=2, folder=tmp_path)
    assert torch.equal(again.variables, result.variables)


# -- the journal -------------------------------------------------------------------------------------------------------


def test_tasks_that_are_known_are_not_done_again_and_a_torn_line_is(tmp_path):
    done = []

    def task(name):
        return name, lambda: done.append(name) or ended([1.0 / 3, 2.0], 0.1)

    about = {"seed": 1}
    Journal(tmp_path, about, np.inf).each([task("a"), task("b")], 2)
    path = tmp_path / "search.jsonl"
    path.write_text(path.read_text()[:-9])
    again = Journal(tmp_path, about, np.inf).each([task("a"), task("b"), task("c")], 2)
    assert done == ["a", "b", "b", "c"]
    assert np.array_equal(again[0].x, [1.0 / 3, 2.0])
    with pytest.raises(BadSearch, match="a search of other seed"):
        Journal(tmp_path, {"seed": 2}, np.inf)
    with pytest.raises(SearchStopped):
        Journal(tmp_path, about, 0.0).each([task("d")], 2)


@pytest.mark.slow
def test_a_resumed_search_ends_as_an_uninterrupted_one(plate, found, tmp_path):
    class Bar:
        """Interrupts at the fifth start."""

        def __init__(self, *arguments):
            self.n = 0

        def update(self, n):
            self.n += n
            if self.n == 5:
                raise KeyboardInterrupt

        set_postfix_str = close = lambda self, *arguments: None

    with pytest.raises(NoProblem, match=r"0 starts; .* 4 descents, .*nearest.zmx") as error:
        rt.search(plate, hold="efl=50", starts=8, folder=tmp_path, progress=Bar, **HOW)
    assert "it is not at its minimum yet" in str(error.value) or "efl=50 at " in str(error.value)
    nearest = rt.read_lens(tmp_path / "nearest.zmx")
    assert float(rt.first_order(nearest).effective_focal_length) == pytest.approx(50, rel=1e-3)
    kept = (tmp_path / "search.jsonl").read_text().splitlines()
    assert 1 + 4 <= len(kept) < 1 + 8
    whole = rt.search(plate, hold="efl=50", starts=8, folder=tmp_path, **HOW)
    assert torch.equal(whole.variables, found.variables)
    assert torch.equal(whole.times_reached, found.times_reached)
    assert whole.tasks == found.tasks
    assert not (tmp_path / "nearest.zmx").exists()


@pytest.mark.slow
def test_processes_find_the_minima_of_one(plate, found, tmp_path):
    rt.write_lens(plate, tmp_path / "plate.csv")
    words = "plate.csv --merit spot --vary curvature thickness --glass-thickness 2:8 --edge 1 --rings 2 --hold efl=50"
    command = [
        sys.executable,
        "-m",
        "torch.distributed.run",
        "--standalone",
        "--nproc-per-node",
        "2",
        "-m",
        "raytrace",
        "search",
    ]
    done = subprocess.run(
        [*command, *words.split(), "--starts", "8", "--json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"},
    )
    assert done.returncode == 0, done.stderr
    merits = [row["merit"] for row in json.loads(done.stdout)["results"]]
    assert merits == pytest.approx(found.merit.tolist(), rel=1e-9)


# -- the command -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_folder_holds_lenses_a_table_and_figures(found, tmp_path):
    found.save(tmp_path)
    (tmp_path / "minimum_99.zmx").write_text("of a longer search")
    found.save(tmp_path)
    numbers = [f"minimum_{k:02d}" for k in range(1, len(found.lenses) + 1)]
    files = {path.name for path in tmp_path.iterdir()}
    assert files == {f"{name}{suffix}" for name in numbers for suffix in (".zmx", ".png")} | {"minima.csv", "best.png"}
    table = pandas.read_csv(tmp_path / "minima.csv")
    assert table["merit"].tolist() == found.merit.tolist()
    own = rt.read_lens(tmp_path / "minimum_01.zmx")
    assert rt.first_order(own).effective_focal_length == pytest.approx(50)
    assert rt.spot(own).rms_radius.reshape(-1).tolist() == pytest.approx(found.spots[0].tolist(), rel=1e-6)


def test_the_command_writes_its_minima_and_resumes(command_line, tmp_path):
    words = ["search", "singlet", "--merit", "spot", "--vary", "curvature sensor", "--hold", "efl=50", "-o", "minima"]
    done = command_line(*words, "--starts", 2, "--json")
    assert done.code == 0, done.err
    assert [*done.document] == ["starts", "descents", "seconds", "stopped", "results"]
    assert (tmp_path / "minima" / "minimum_01.zmx").exists()
    again = command_line(*words, "--starts", 2, "--json")
    assert again.document["results"] == done.document["results"]
    other = command_line(*words, "--starts", 2, "--seed", 7)
    assert "keeps a search of other seed" in other.error


MOVES = ["--merit", "spot", "--vary", "curvature sensor", "--hold", "efl=50", "--moves"]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--merit", "spot"], "--vary names them"),
        (["--vary", "curvature"], "choose one by --merit spot"),
        (["--merit", "spot", "--vary", "curvature"], "--hold its focal length, as efl=50"),
        (
            ["--merit", "spot", "--vary", "curvature", "--hold", "efl=50", "--seconds", "1e-9"],
            "no lens without failing rays",
        ),
        (["--merit", "spot", "--vary", "curvatures", "--hold", "efl=50"], "did you mean curvature"),
        (["--merit", "spot", "--vary", "curvature glass", "--hold", "efl=50"], "--vary glass is for optimize"),
        (["--merit", "spot", "--vary", "curvature", "--moves", "insert:3"], "surface 3 is none before the image"),
        (["--merit", "spot", "--vary", "curvature:1", "--moves", "insert:2"], "has a curvature that does not vary"),
        (["--merit", "spot", "--vary", "curvature", "--moves", "insrt"], "did you mean insert?"),
        (["--merit", "spot", "--vary", "curvature", "--moves", "delete:2"], "begins no element"),
        (["--merit", "spot", "--vary", "curvature", "--moves", "delete:1"], "begins the element that is the stop"),
        (["--merit", "spot", "--vary", "curvature", "--moves", "split:2"], "surface 2 begins no element"),
        (["--merit", "spot", "--vary", "curvature", "--moves", "cement:1"], "no air space between two glasses"),
        (["--merit", "spot", "--vary", "curvature", "--elements", "2"], "--elements goes with --moves"),
        ([*MOVES, "insert", "--keep", "2"], "--keep goes with --elements"),
        ([*MOVES, "insert:1", "--elements", "2"], "surface numbers are of the given lens"),
        ([*MOVES, "insert", "--elements", "1:"], "expected numbers of elements from 1 on, as 4"),
        ([*MOVES, "cement", "--elements", "2"], "the lens has 1; more are made by --moves insert split"),
        ([*MOVES, "cement"], "no air space between two glasses whose facing curvatures"),
    ],
)
def test_errors_of_search_are_one_line(words, said, plate, command_line, tmp_path):
    rt.write_lens(plate, tmp_path / "plate.csv")
    assert said in command_line("search", "plate.csv", *words).error


@pytest.mark.slow
@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_plane_plates_have_no_focal_length_and_no_warning():
    """Of a plate f = ∞ without a derivative, in a row and in a search, where the power that f has is held."""
    rows = [dict(radius=torch.inf, thickness=4, glass="N-BK7"), dict(radius=torch.inf, thickness=95)]
    plate = rt.lens(rows, stop=1, entrance_pupil_diameter=10, fields=[0, 1])
    free = design_variables(plate, "curvature sensor")
    model = DesignVariables(free.lens, free.variables)
    for name in ("EFFL", "ISFN"):
        found = Evaluation(model, [rt.system.Row(name, (0, 1) if name == "EFFL" else (0, 0), weight=1.0)])(
            model.start, derivatives=True
        )
        assert np.isinf(found.values).all()
        assert not found.jacobian.any()
    found = rt.search(plate, merit="spot", vary="curvature sensor", hold="efl=100", starts=1, seed=0)
    assert float(rt.first_order(found.lenses[0]).effective_focal_length) == pytest.approx(100, rel=1e-9)


@pytest.mark.slow
def test_a_search_without_a_lens_names_what_its_nearest_one_misses(plate):
    """F/5 is not F/3, which no linear model of one point excludes."""
    with pytest.raises(NoProblem, match=r"2 starts; .*working_f_number=3") as error:
        rt.search(plate, hold="efl=50 working_f_number=3", starts=2, **HOW)
    assert "hold less" in str(error.value)


@pytest.mark.slow
def test_a_triplet_from_plates_with_two_limits_and_real_aiming():
    """50 mm, F/4, 20°: limits of back focal distance and distortion are met together, as the analyses say."""
    rows = [(4, "N-LAK9"), (4,), (4, "N-SF5"), (4,), (4,), (4, "N-LAK9"), (40,)]
    rows = [dict(zip(("thickness", "glass"), row, strict=False)) for row in rows]
    colours = {"wavelengths": [0.4861327, 0.5875618, 0.6562725], "primary_wavelength": 2, "catalogs": ["schott"]}
    plates = rt.lens(rows, stop=5, entrance_pupil_diameter=12.5, fields=[0, 14, 20], **colours)
    plates = dataclasses.replace(plates, ray_aiming="real")
    merit = rt.optimization.DefaultMerit("spot", glass_thickness=(1.5, 8), air_thickness=(0.5, 12), edge=1)
    hold = "efl=50 bfd>=35 distortion<=2%"
    found = rt.search(plates, merit=merit, vary="curvature thickness", hold=hold, starts=1)
    for lens in found.lenses:
        assert float(rt.first_order(lens).effective_focal_length) == pytest.approx(50, rel=1e-6)
        assert float(lens.surfaces[-2].thickness) >= 35 - 1e-4
        assert float(rt.distortion(lens).f_tan[:, 1].abs().max()) <= 0.02 + 1e-6
    assert float(found.merit[0]) < 0.02

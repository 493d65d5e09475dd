"""Glasses that vary: the hull of a catalog, what the expansion foretells, and the glasses that a lens ends with."""

import dataclasses
import json
import re

import numpy as np
import pytest
import torch
from scipy.stats import spearmanr

import raytrace as rt
from raytrace.cli import main
from raytrace.materials.catalogs import shipped_catalog
from raytrace.materials.glass import abbe_number, nd, refractive_index
from raytrace.optimization.checkpoint import BadCheckpoint
from raytrace.optimization.conditions import conditions_of
from raytrace.optimization.glass_choice import (
    Choice,
    DescendedDesign,
    Design,
    Pool,
    catalogs_of,
    expansion,
    hull,
    pool_of,
)
from raytrace.optimization.least_squares import Sides, SumOfSquares, least_squares
from raytrace.optimization.merit import merit_for
from raytrace.optimization.problem import NoProblem
from raytrace.optimization.variables import design_variables, without_glass
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.parameter_paths import BadVariables
from raytrace.tracing.compiled import prepare

NONE = np.zeros(0)
MERIT = rt.optimization.DefaultMerit("spot", glass_thickness=(2.0, 20.0), air_thickness=(0.3, 100.0), edge=1.0)


@pytest.fixture(scope="module")
def triplet():
    prepare()
    return rt.read_lens("cooke_triplet")


def choice_of(lens, words="curvature thickness glass", **options) -> Choice:
    function = merit_for(lens, MERIT)
    free, surfaces = without_glass(design_variables(lens, words), words)
    far = np.full(len(free.variables), np.inf)
    pool = pool_of(lens, catalogs_of(lens))
    return Choice(free, surfaces, pool, function.rows, conditions_of(lens, "efl=100"), (-far, far), **options)


@pytest.fixture(scope="module")
def found(triplet):
    return rt.optimize(triplet, merit=MERIT, vary="curvature thickness glass", hold="efl=100", cycles=40)


# -- the glasses -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_hull_holds_all_of_its_points_and_no_more(count):
    points = np.random.default_rng(1).normal(size=(60, count)) * [0.1, 15.0, 3e-3][:count] + [1.6, 50.0, 0.0][:count]
    normal, reach = hull(points)
    assert (points @ normal.T <= reach + 1e-9).all()
    assert np.isclose((points @ normal.T - reach).max(0), 0, atol=1e-9).all()  # every side touches one
    assert (points.mean(0) @ normal.T < reach).all()
    beyond = points.mean(0) + 1.01 * (points[:10] - points.mean(0)) * 4
    assert ((beyond @ normal.T > reach).any(1)).any()


def test_the_hull_of_points_in_a_plane_is_their_box():
    normal, reach = hull(np.array([[1.5, 60.0], [1.6, 60.0], [1.7, 60.0]]))
    assert (np.array([1.55, 60.0]) @ normal.T <= reach + 1e-9).all()
    assert (np.array([1.75, 60.0]) @ normal.T > reach).any()


@pytest.mark.parametrize("wavelengths", [(0.53,), (0.45, 0.65), (0.4861, 0.5876, 0.6563), (0.45, 0.5, 0.55, 0.6, 0.65)])
def test_numbers_of_a_glass_give_its_indices_at_the_wavelengths_of_the_lens(wavelengths):
    """Exactly, up to three; BK7's are those of its data sheet at the lines F, d and C."""
    at = torch.tensor(wavelengths, dtype=torch.float64)
    glasses = [shipped_catalog("SCHOTT").glasses[name] for name in ("N-BK7", "N-SF6", "N-KZFS4")]
    pool = Pool(glasses, at)
    assert pool.count == min(3, len(wavelengths))
    for glass in glasses:
        off = refractive_index(pool.model(pool.numbers_of(glass)), at) - refractive_index(glass, at)
        assert float(off.abs().max()) < (1e-12 if len(wavelengths) < 4 else 2e-4)
    if wavelengths == (0.4861, 0.5876, 0.6563):
        expected = [float(nd(glasses[0])), float(abbe_number(glasses[0]))]
        assert np.allclose(pool.numbers_of(glasses[0])[:2], expected, rtol=1e-3)


def test_glasses_to_choose_from_are_current_and_cover_the_wavelengths(triplet):
    pool = pool_of(triplet, catalogs_of(triplet))
    assert {glass.status for glass in pool.glasses} == {"preferred", ""}
    assert "N-BK7" in {glass.name for glass in pool.glasses}
    assert "SK4" not in {glass.name for glass in pool.glasses}
    assert all(glass.wavelength_range[0] <= 0.4861 and glass.wavelength_range[1] >= 0.6563 for glass in pool.glasses)
    assert {glass.catalog for glass in pool_of(triplet, catalogs_of(triplet, ["OHARA"])).glasses} == {"OHARA"}
    with pytest.raises(NoProblem, match="catalog"):
        catalogs_of(triplet, ["NOWHERE"])


def test_radiation_hard_glasses_are_not_chosen_unless_asked_for(triplet):
    """SF6G05 is preferred by its maker, and transmits 0.36 of blue light at 0.46 µm."""
    catalogs = catalogs_of(triplet, ["SCHOTT"])
    names = {words: {glass.name for glass in pool_of(triplet, catalogs, words).glasses} for words in ("", "any")}
    assert "SF6" in names[""]
    assert not names[""] & {"BK7G18", "F2G12", "SF6G05"}
    assert {"BK7G18", "F2G12", "SF6G05", "SK4"} <= names["any"]
    cheap = pool_of(triplet, catalogs, ["preferred", "price<=1.5"])
    assert {glass.relative_price <= 1.5 for glass in cheap.glasses} == {True}
    with pytest.raises(NoProblem, match=r"0 of 366 glasses of SCHOTT; left out: .*acid not listed.*glasses.*catalog"):
        pool_of(triplet, catalogs, "acid<=1")


# -- the expansion -----------------------------------------------------------------------------------------------------


def test_the_expansion_of_a_linear_merit_predicts_the_minimum():
    """Residuals linear in all: the least over the variables that follow, with equalities, found by elimination."""
    draw = np.random.default_rng(2)
    J, r = draw.normal(size=(30, 7)), draw.normal(size=30)
    A, c = draw.normal(size=(1, 7)), draw.normal(size=1)
    state = SumOfSquares(np.zeros(7), r, 0, Sides.none(7), c, NONE, J, A, np.zeros((0, 7)))
    foretold = expansion(state, np.array([5, 6]), np.arange(5), np.zeros((0, 7)))
    for d in draw.normal(size=(5, 2)):
        system = np.block([[J[:, :5].T @ J[:, :5], A[:, :5].T], [A[:, :5], np.zeros((1, 1))]])
        right = -np.concatenate([J[:, :5].T @ (r + J[:, 5:] @ d), c + A[:, 5:] @ d])
        y = np.linalg.solve(system, right)[:5]
        least = np.linalg.norm(r + J @ np.concatenate([y, d]))
        assert foretold.merit(d) == pytest.approx(least, rel=1e-3)  # of the damping


@pytest.mark.slow
def test_predicted_merits_rank_the_optimised_merits(triplet):
    """Spearman's correlation, over glasses from all of the map, each optimised in place of the last one's."""
    choice = choice_of(triplet)
    start = least_squares(
        choice.problem({}, ()).state, choice.problem({}, ()).model.start, lower=choice.bounds[0],
        upper=choice.bounds[1], cycles=60,
    )  # fmt: skip
    own = {k: triplet.surfaces[k].glass for k in choice.surfaces}
    design = DescendedDesign(start.state.x, own, start.state)
    for surface in choice.surfaces:
        merits = choice.predicted(design, [surface], ())[surface]
        some = np.argsort(merits)[::5]
        glasses = [choice.candidates[surface][0][i] for i in some]
        reached = [choice.descend(Design(design.x, own | {surface: g}), (), 15).merit for g in glasses]
        assert spearmanr(merits[some], reached)[0] > 0.85


# -- the lens ----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_lens_ends_with_glasses_of_the_catalog_and_no_worse_than_with_its_own(triplet, found):
    own = rt.optimize(triplet, merit=MERIT, vary="curvature thickness", hold="efl=100", cycles=40)
    assert found.merit_after <= own.merit_after * 1.0001
    assert found.merit_after < 0.95 * own.merit_after
    glasses = [found.lens.surfaces[k].glass for k in (1, 3, 6)]
    assert all(glass.catalog == "SCHOTT" and glass.formula != "model" for glass in glasses)
    kinds = [step.kind for step in found.glasses]
    assert kinds[:5] == ["own", "model", "snap", "snap", "snap"]
    assert set(kinds[5:]) <= {"swap"}
    assert found.glasses[1].reached < found.glasses[0].reached
    assert {step.surface for step in found.glasses if step.kind == "snap"} == {1, 3, 6}
    assert found.merit_after <= min(step.reached for step in found.glasses if step.kind in ("own", "swap")) * 1.0001


@pytest.mark.slow
def test_the_lens_is_written_with_its_glasses_and_reads_the_same(found, tmp_path):
    found.save(tmp_path / "found.zmx")
    again = rt.read_lens(tmp_path / "found.zmx")
    names = [found.lens.surfaces[k].glass.name for k in (1, 3, 6)]
    assert [again.surfaces[k].glass.name for k in (1, 3, 6)] == names
    assert all(name in str(found) for name in names) or "SK4" in names or "SF2" in names


@pytest.mark.slow
def test_the_figure_has_the_merit_of_every_step_of_the_choice(found):
    figure = found.draw()
    (axes,) = (
        one
        for each in figure.subfigs
        for sub in [each, *each.subfigs]
        for one in sub.axes
        if "Merit" in one.get_title()
    )
    merits = axes.lines[0].get_ydata()
    assert merits[: 1 + len(found.glasses)] == pytest.approx(
        [found.merit_before, *(one.reached for one in found.glasses)]
    )
    assert len(merits) == 1 + len(found.glasses) + len(found.history) > 3
    assert axes.get_xlabel().startswith("step of the choice of glasses")


@pytest.mark.slow
def test_it_is_reproducible(triplet, found):
    again = rt.optimize(triplet, merit=MERIT, vary="curvature thickness glass", hold="efl=100", cycles=40)
    assert again.merit_after == found.merit_after
    assert [step.name for step in again.glasses] == [step.name for step in found.glasses]


def test_which_glasses_vary(triplet):
    words = "curvature glass:3"
    assert without_glass(design_variables(triplet, words), words)[1] == (3,)
    substitute = (Solve(1, "glass", "substitute"),)
    pickup = (Solve(6, "glass", "pickup", source=1),)
    for kept, expected in (((), (1, 3, 6)), (substitute, (1,)), (pickup, (1, 3))):
        lens = rt.read_lens("cooke_triplet")
        lens = dataclasses.replace(
            lens, optimization_data=OptimizationData(variables=(Vary(1, "curvature"),), kept=kept)
        )
        free, surfaces = without_glass(design_variables(lens, "glass"), "glass")
        assert surfaces == expected
        assert free.variables == (Vary(1, "curvature"),)
    with pytest.raises(BadVariables, match="nothing but glasses"):
        without_glass(design_variables(triplet, "glass"), "glass")


@pytest.mark.slow
def test_a_glass_that_is_picked_up_follows(triplet):
    """The last element has the first one's glass at every step."""
    optimization_data = OptimizationData(kept=(Solve(6, "glass", "pickup", source=1),))
    lens = dataclasses.replace(triplet, optimization_data=optimization_data)
    found = rt.optimize(lens, merit=MERIT, vary="curvature sensor glass:1", hold="efl=100", cycles=3)
    assert found.lens.surfaces[6].glass.name == found.lens.surfaces[1].glass.name
    assert {step.surface for step in found.glasses} <= {0, 1}


def test_the_command_prints_the_sequence(capsys):
    words = ["optimize", "cooke_triplet", "--merit", "spot", "--vary", "curvature", "sensor", "glass:3"]
    main([*words, "--hold", "efl=100", "--cycles", "2", "--catalog", "HOYA", "--json"])
    document = json.loads(capsys.readouterr().out)
    steps = document["glasses"]
    assert [step["step"] for step in steps[:3]] == ["own", "model", "snap"]
    assert {step["glass"] for step in steps[2]["tried"]} & set(shipped_catalog("HOYA").glasses)
    assert steps[2]["surface"] == 3
    assert steps[2]["tried"]
    assert re.search(r"of 432 glasses of HOYA; left out: 196 obsolete", document["chosen_from"])
    main([*words, "--cycles", "2", "--glasses", "preferred", "price<=2"])
    text = capsys.readouterr().out
    assert re.search(r"surface 3: \S+ \(SCHOTT\)", text)
    assert re.search(r"of 366 glasses of SCHOTT; left out: 232 obsolete, .* not price<=2", text)
    name, price = re.search(r"^ +3 +(\S+) +SCHOTT +preferred +\S+ +\S+ +(\S+)", text, re.MULTILINE).groups()
    assert shipped_catalog("SCHOTT").glasses[name].relative_price == pytest.approx(float(price), rel=1e-5)
    assert float(price) <= 2


# -- interrupted -------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_interrupted_exchanges_resume(triplet, tmp_path, monkeypatch):
    """Ended hard behind the first exchanges, and begun again from the checkpoint: the same lens to the last digit."""
    path, done = tmp_path / "kept.json", []
    how = {"merit": MERIT, "vary": "curvature glass:1,6", "hold": "efl=100", "cycles": 2, "checkpoint": path}
    whole = rt.optimize(triplet, **how)
    swap = Choice._swap

    def ended(self, surface, merits):
        if len(done) == 1:
            raise RuntimeError("the machine stops")
        done.append(surface)
        return swap(self, surface, merits)

    monkeypatch.setattr(Choice, "_swap", ended)
    with pytest.raises(RuntimeError, match="the machine stops"):
        rt.optimize(triplet, **how)
    monkeypatch.undo()
    kept = json.loads(path.read_text())
    assert set(kept["glasses"]) == {"1", "6"}
    again = rt.optimize(triplet, resume=path, **how)
    assert [s.glass.name for s in again.lens.surfaces] == [s.glass.name for s in whole.lens.surfaces]
    assert again.merit_after == pytest.approx(whole.merit_after, rel=1e-12)
    with pytest.raises(BadCheckpoint, match="a checkpoint of other glasses that vary"):
        rt.optimize(triplet, resume=path, **(how | {"vary": "curvature"}))

"""Radial errors, and limits that a workshop makes: by hand, by closed forms, and by all combinations of steps."""

import itertools
import math
import re

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.system.tolerance_data import Tolerance
from raytrace.tolerancing.grades import GRADES
from raytrace.tolerancing.makeable import Makeable
from raytrace.tolerancing.radial import limits_alone
from raytrace.tolerancing.second_order import SecondOrder
from raytrace.tolerancing.study import moments
from raytrace.tolerancing.table import ToleranceTable
from raytrace.tolerancing.tightening import limited_to_change, limited_to_yield
from raytrace.tracing.geometry import semi_diameters
from raytrace.workshop.indications import Indications
from raytrace.workshop.parts import Face

T = Tolerance


@pytest.fixture(scope="module")
def achromat():
    return rt.read_lens("cemented_achromat")


def radial(kind="element_decenter", size=0.02, surfaces=(1, 3), **more):
    part = size / math.sqrt(2)
    return [T(f"{kind}_{axis}", surfaces, -part, part, group=f"{kind} {surfaces}", **more) for axis in "xy"]


# -- radial errors ----------------------------------------------------------------------------------------------------


def test_a_word_makes_a_radial_error_of_its_magnitude(achromat):
    table = rt.tolerances(achromat, "element_decenter_radial=0.02 wedge_radial=0.01 thickness=0.05")
    sizes = {error.name: error.magnitude for error in table.radial.values()}
    assert sizes == {"element_decenter_radial": pytest.approx(0.02), "surface_runout_radial": pytest.approx(0.01)}
    text = str(table)
    assert len(re.findall(r"element_decenter_radial of surfaces 1-3 +-0.02 +0.02 +mm", text)) == 1
    assert "_x" not in text
    assert table.columns()["maximum"].tolist().count(pytest.approx(0.02)) == 1
    # both of a word replace radial ones, and one component takes the pair along
    for more in ("element_decenter=0.01", "element_decenter_x=0.01"):
        kinds = [row.kind for row in rt.tolerances(achromat, f"element_decenter_radial=0.02 {more}")]
        assert kinds == (["element_decenter_x", "element_decenter_y"] if more[16] == "=" else ["element_decenter_x"])
    with pytest.raises(rt.BadTolerance, match="the limit of a radial error is its magnitude"):
        rt.tolerances(achromat, "wedge_radial=-0.01..0.02")


def test_a_grade_may_be_radial(achromat):
    apart, linked = (rt.tolerances(achromat, grade="precision", radial=radial) for radial in (False, True))
    assert not apart.radial
    assert len(linked) == len(apart)
    assert {(error.name, round(error.magnitude, 12)) for error in linked.radial.values()} == {
        ("surface_runout_radial", 0.01), ("element_decenter_radial", 0.05), ("element_tilt_radial", 0.05)
    }  # fmt: skip


@pytest.mark.parametrize(
    ("distribution", "share"), [("uniform", 0.5), ("disc", 0.25), ("end_points", 0.0), ("parabolic", 0.125)]
)
def test_magnitudes_and_directions_of_random_errors(distribution, share):
    """The share of lenses within half the radius: of the disc its area; the direction is uniform."""
    draws = rt.tolerancing.draw_errors(radial(distribution=distribution), 20_000)
    sizes = draws.square().sum(1).sqrt()
    assert float(sizes.max()) <= 0.02 * (1 + 1e-12)
    assert float((sizes < 0.01).double().mean()) == pytest.approx(share, abs=0.013)  # 4 σ
    angles = torch.atan2(draws[:, 1], draws[:, 0])
    for order in (1, 2, 3):
        assert abs(complex(torch.exp(1j * order * angles).mean())) < 4 / math.sqrt(20_000)
    for row, column in zip(radial(distribution=distribution), draws.T, strict=True):
        assert moments(row)[1] == pytest.approx(float(column.var()), rel=0.05)


def test_the_worst_direction_is_that_of_a_closed_form():
    """q = a R cos(φ - φ₁) + b R² cos 2(φ - φ₂), by a search over 10⁵ directions."""
    table = ToleranceTable((*radial(), T("thickness", (1,), -0.1, 0.2)))
    first, second, a, b = 0.7, 2.1, 3.0, 90.0

    def change(x, y):
        phi, r = np.arctan2(y, x), np.hypot(x, y)
        return a * r * np.cos(phi - first) + b * r**2 * np.cos(2 * (phi - second))

    def harm(errors):
        x, y, z = errors.numpy().T
        return torch.from_numpy(change(x, y) + z**2)

    low, high, direction = limits_alone(table, harm)
    phi = np.linspace(0, 2 * np.pi, 100_001)
    around = change(0.02 * np.cos(phi), 0.02 * np.sin(phi))
    assert float(direction[0]) == pytest.approx(math.degrees(phi[around.argmax()]), abs=0.13)
    assert direction[1:].isnan().all()
    assert float(harm(high)[0]) == pytest.approx(around.max(), rel=1e-5)
    assert float(high[0].square().sum().sqrt()) == pytest.approx(0.02, rel=1e-14)
    assert torch.equal(low[0], -high[0])
    assert (high[2].tolist(), low[2].tolist()) == ([0, 0, 0.2], [0, 0, -0.1])
    # inverse sensitivity: no direction does more than the increment, one just reaches it
    tight = limited_to_change(table, harm, 0.02).tolerances
    size = tight.radial[0].magnitude
    assert change(size * np.cos(phi), size * np.sin(phi)).max() == pytest.approx(0.02, rel=1e-4)
    assert (tight[2].minimum, tight[2].maximum) == (-0.1, pytest.approx(math.sqrt(0.02), rel=1e-6))


def test_the_worst_direction_of_a_lens_is_that_of_all_directions(achromat):
    """Of one field off axis; lenses without compensators, by spots of single lenses."""
    lens = achromat.at(fields=[3.0])
    table = rt.tolerances(lens, "element_decenter_radial=0.3", compensators=[])
    built = rt.tolerance(lens, table, trials=0, rings=3, fields=[(0.0, 3.0)])

    def rms(errors):
        whole = rt.spot(rt.tolerancing.perturbed(lens, table, errors), rings=3, fields=[(0.0, 3.0)]).whole
        return 1e3 * float(whole.mean_square_radius.mean().sqrt())

    nominal = rms([0.0, 0.0])
    phi = torch.deg2rad(torch.arange(0, 360, 15).double())
    changes = [rms([0.3 * math.cos(p), 0.3 * math.sin(p)]) - nominal for p in phi.tolist()]
    worst = math.radians(float(built.direction[0]))
    assert float(built.maximum[0]) >= max(changes) - 1e-9
    assert float(built.maximum[0]) == pytest.approx(
        rms([0.3 * math.cos(worst), 0.3 * math.sin(worst)]) - nominal, abs=1e-8
    )
    assert float(built.minimum[0]) == pytest.approx(
        rms([-0.3 * math.cos(worst), -0.3 * math.sin(worst)]) - nominal, abs=1e-8
    )
    assert abs(float(built.direction[0])) == pytest.approx(90, abs=1) or float(built.direction[0]) == 270
    assert "element_decenter_radial of surfaces 1-3" in str(built)
    assert "worst\ndirection" not in str(built)
    assert "direction, °" in str(built)


def test_a_drawing_has_the_magnitude_of_a_radial_error():
    rows = (*radial("surface_tilt", 0.1, (2,)), *radial("element_decenter", 0.02, (1, 2)))
    indications = Indications(ToleranceTable(rows), {})
    face = Face(2, rt.read_lens("cemented_achromat").surfaces[2], 0.0, 1, 5.0)
    assert indications.tilt(face) == pytest.approx(0.1)
    assert indications.centring(face) == "4/6′"
    assert indications.mounting(1, 2) == ("0.02 radial", "–")


# -- limits of a workshop ---------------------------------------------------------------------------------------------


def test_finest_limits_are_those_of_the_grade_in_the_unit_of_the_row(achromat):
    lens, figures = achromat, GRADES["high"]
    h, c = semi_diameters(lens)[3], abs(float(lens.surfaces[3].curvature))
    error = max(0.0005 * c, 0.6328e-3 / h**2)  # 0.05 % or one fringe: N λ/2 = ½ h² Δc
    wedge = figures["wedge"].limit / (2 * h)
    expected = {
        T("radius", (3,), -9, 9, unit="%"): 100 * error / c,
        T("radius", (3,), -9, 9): error / c**2,
        T("power", (3,), -99, 99): error * h**2 / 0.6328e-3,
        T("curvature", (3,), -9, 9): error,
        T("thickness", (1,), -9, 9): 0.025,
        T("surface_runout_x", (3,), -9, 9): 0.005,
        T("surface_tilt_x", (3,), -9, 9): math.degrees(math.atan(wedge)),
        T("surface_decenter_x", (3,), -9, 9): wedge / c,
        T("element_tilt_x", (1, 3), -9, 9): 0.02,
        T("index", (1,), -9, 9): 0.0002,
        T("conic", (3,), -9, 9): 0.0,
        T("irregularity_angle", (3,), -90, 90): 90,  # no matter of tightness
        T("element_decenter_y", (1, 3), -0.01, 0.01): 0.01,  # given finer than the workshop has it
    }
    makes = Makeable(lens, ToleranceTable(tuple(expected)), "high")
    assert makes.finest.tolist() == pytest.approx(list(expected.values()), rel=1e-12)


def test_limits_are_rounded_down_to_steps_and_linked(achromat):
    rows = [T(f"element_decenter_{axis}", (1, 3), -0.1, 0.1) for axis in "xy"]
    table = ToleranceTable((*rows, T("thickness", (1,), -0.15, 0.15), *radial(size=0.1, surfaces=(1, 2))))
    makes = Makeable(achromat, table, "high")
    assert makes.classes.tolist() == [0, 0, 1, 2, 2]
    assert makes.given.tolist() == pytest.approx([0.1, 0.15, 0.1])
    assert makes.rounded(np.array([0.0334, 0.0199, 0.0449])).tolist() == pytest.approx([0.03, 0.025, 0.04])

    def harm(errors):  # linear: a change of 1 at 0.0199, 0.0334; 0.01; and 0.03 in any direction
        scale = torch.tensor([0.0199, 0.0334, 0.01], dtype=torch.float64)
        return torch.maximum((errors[:, :3].abs() / scale).sum(1), errors[:, 3:].square().sum(1).sqrt() / 0.03)

    exact = limited_to_change(table, harm, 1.0).tolerances
    assert [row.maximum for row in exact] == pytest.approx([0.0199, 0.0334, 0.01, *2 * [0.03 / math.sqrt(2)]], rel=1e-7)
    proposal = limited_to_change(table, harm, 1.0, makes)
    decentres, thickness, pair = proposal.tolerances[:2], proposal.tolerances[2], proposal.tolerances.radial[3]
    assert [row.maximum for row in decentres] == pytest.approx([0.02, 0.02])  # the finest, above 0.015 of the step
    assert thickness.maximum == pytest.approx(0.025)
    assert pair.magnitude == pytest.approx(0.03)
    assert proposal.finest == (0, 2)
    assert makes.cost(proposal.tolerances) == pytest.approx(0.02 / 0.02 + 0.025 / 0.025 + 0.02 / 0.03)
    assert makes.cost(table) == pytest.approx(0.02 / 0.1 + 0.025 / 0.15 + 0.02 / 0.1)


def a_model(*curvatures):
    """q = 1 + Σ k e²: a lens whose errors do not mix."""
    H = 2 * torch.diag(torch.tensor(curvatures, dtype=torch.float64))
    none = torch.zeros(0, dtype=torch.float64)
    n = len(curvatures)
    return SecondOrder(H.new_ones(()), H.new_zeros(n), H, none, H.new_zeros(n, 0), H.new_zeros(0, 0), none, none)


@pytest.mark.parametrize("costs", ["", "thickness=5"])
def test_a_yield_has_the_least_cost_of_all_combinations_of_steps(achromat, costs):
    rows = (
        *(T(f"element_decenter_{axis}", (1, 3), -0.1, 0.1) for axis in "xy"),
        T("thickness", (1,), -0.15, 0.15), T("index", (1,), -0.001, 0.001),
    )  # fmt: skip
    table, model = ToleranceTable(rows), a_model(300.0, 200.0, 150.0, 3e6)
    makes = Makeable(achromat, table, "high", costs)
    goal, share = 1.6, 0.9

    def traced(errors):
        return model(errors)[0]

    proposal = limited_to_yield(table, model, traced, goal, share, 3, makes)
    draws = rt.tolerancing.draw_errors(table, 2**15, 4)

    def met(limits):
        return float((model(makes.factors(limits) * draws)[0] <= goal).double().mean())

    steps = (
        np.arange(0.02, 0.1001, 0.005),
        [0.025, *np.arange(0.03, 0.1501, 0.01)],
        np.arange(0.0002, 0.00101, 0.0001),
    )
    weights = np.array([1.0, 5.0 if costs else 1.0, 1.0])
    combinations = [np.array(limits) for limits in itertools.product(*steps)]
    price = {k: float(weights @ (makes.finest / limits)) for k, limits in enumerate(combinations)}
    cheapest = next(price[k] for k in sorted(price, key=price.get) if met(combinations[k]) >= share)
    cost = makes.cost(proposal.tolerances)
    assert proposal.share == pytest.approx(met(makes.given * _ratios(proposal, table, makes)), abs=0.01)
    assert proposal.share >= share - 0.005
    assert cost == pytest.approx(cheapest, rel=0.03)  # greedy in the last step
    assert not proposal.finest
    x, y, thickness, _ = proposal.tolerances
    assert (x.maximum, x.minimum) == (y.maximum, y.minimum)
    assert x.maximum / 0.005 == pytest.approx(round(x.maximum / 0.005))
    assert thickness.maximum / 0.01 == pytest.approx(round(thickness.maximum / 0.01))


def _ratios(proposal, table, makes):
    return np.array([proposal.tolerances[m[0]].maximum / table[m[0]].maximum for m in makes.members])


def test_an_expensive_tolerance_is_tightened_less(achromat):
    table, model = (
        ToleranceTable((T("thickness", (1,), -0.15, 0.15), T("index", (1,), -0.001, 0.001))),
        a_model(60, 1.35e6),
    )

    def limits(costs):
        makes = Makeable(achromat, table, "high", costs)
        proposal = limited_to_yield(table, model, lambda errors: model(errors)[0], 1.3, 0.9, 3, makes)
        return [row.maximum for row in proposal.tolerances]

    (thickness, index), (dear, cheap) = limits(""), limits("thickness=9")
    assert dear > thickness
    assert cheap < index
    with pytest.raises(rt.BadTolerance, match="costs wedge: none of the tolerances is of this kind"):
        limits("wedge=2")
    with pytest.raises(rt.BadTolerance, match="expected a positive weight"):
        limits("thickness=-1..2")


def test_a_yield_that_the_workshop_does_not_reach(achromat):
    """No limit is finer than its own; the share is that of the finest limits."""
    table, model = (
        ToleranceTable((T("thickness", (1,), -0.15, 0.15), T("index", (1,), -0.001, 0.001))),
        a_model(900, 1e6),
    )
    makes = Makeable(achromat, table, "precision")
    proposal = limited_to_yield(table, model, lambda errors: model(errors)[0], 1.1, 0.99, 3, makes)
    assert [row.maximum for row in proposal.tolerances] == pytest.approx([0.05, 0.0005])
    assert proposal.finest == (0, 1)
    assert proposal.share < 0.98


def test_a_missed_target_is_reported(achromat):
    lens = rt.focus(achromat.at(fields=[0.0])).lens
    with pytest.warns(rt.GoalMissed, match=r"surface_runout_x of surface 3.* exceed.*workshop \(precision\)"):
        built = rt.tolerance(lens, limits="wedge:3=0.05", trials=0, rings=3, increment=1e-6, workshop="precision")
    assert [row.maximum for row in built.tolerances] == pytest.approx([0.01, 0.01])
    text = str(built)
    assert "at the finest limit of the workshop (precision): surface_runout_x of surface 3" in text
    assert "the target is not reached" in text
    assert built.summary()["target_reached"] is False
    assert built.cost == pytest.approx((0.2, 1.0))
    with pytest.raises(ValueError, match="workshop 'hgih'"):
        rt.tolerance(lens, limits="wedge:3=0.05", trials=0, workshop="hgih")

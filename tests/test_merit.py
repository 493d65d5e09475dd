"""Merit functions as values, and what a lens is worth row by row, in Python and from the command line."""

import dataclasses
import json
import random
import re
from pathlib import Path

import numpy as np
import pytest
from problems import SHARED

import raytrace as rt
from raytrace.optimization.merit import UnknownOperand
from raytrace.system.optimization_data import OptimizationData, Row

DEVELOPMENT = SHARED / "merit" / "dev"


@pytest.fixture(scope="module")
def spot(lens):
    return rt.Merit.default(lens, rings=4, arms=8)


FOCAL = Row("EFFL", target=100.0, weight=0.5)
OWN = rt.Merit((FOCAL,))


def test_the_merit_is_the_weighted_spot(lens, spot):
    """Σ w v²/Σ w over rays of all fields is the mean square radius of their spots about the centroid."""
    found = rt.evaluate(lens, merit=spot)
    assert float(found.merit) ** 2 == pytest.approx(float(rt.spot(lens).mean_square_radius.mean()), rel=2e-4)


def test_values_weights_and_contributions_are_those_of_the_merit(lens, spot):
    found = rt.evaluate(lens, merit=spot + OWN)
    value, weight, target = (column.numpy() for column in (found.values, found.weights, found.targets))
    square = weight * (value - target) ** 2
    assert float(found.merit) == pytest.approx(np.sqrt(square.sum() / weight.sum()), rel=1e-12)
    np.testing.assert_allclose(found.contributions.numpy(), square / square.sum(), rtol=1e-9, atol=1e-15)
    assert float(found.values[-1]) == pytest.approx(float(rt.first_order(lens).effective_focal_length), rel=1e-12)


def test_the_order_of_rows_does_not_matter(lens, spot):
    rows = [*spot, FOCAL, Row("EFFL", (0, 1), target=99.0, weight=0.1)]
    expected = float(rt.evaluate(lens, merit=rows).merit)
    for seed in range(3):
        mixed = random.Random(seed).sample(rows, len(rows))
        assert float(rt.evaluate(lens, merit=mixed).merit) == pytest.approx(expected, rel=1e-12)


def test_merit_functions_are_joined_and_weighed(lens, spot):
    both = spot + OWN
    assert len(both) == len(spot) + 1
    doubled = 2 * both
    assert float(rt.evaluate(lens, merit=doubled).merit) == pytest.approx(float(rt.evaluate(lens, merit=both).merit))
    heavy = both.with_weights(EFFL=7.0).with_targets({len(both): 90.0})
    assert (heavy.rows[-1].weight, heavy.rows[-1].target) == (7.0, 90.0)
    assert heavy.rows[2] == both.rows[2]
    for wrong, said in (({"by_row": {99: 1.0}}, "no row 99"), ({"EFFK": 1.0}, "did you mean EFFL")):
        with pytest.raises(rt.BadMerit, match=said):
            rt.Merit((FOCAL,)).with_weights(**wrong)


def test_rows_of_arithmetic_keep_to_their_rows_when_they_move(lens, spot):
    ratio = rt.Merit((FOCAL, Row("TOTR"), Row("DIVI", (2, 1), target=1.0, weight=1.0), Row("SINE", (1, 1))))
    alone, behind = rt.evaluate(lens, merit=ratio), rt.evaluate(lens, merit=spot + ratio)
    assert behind.values[-4:].tolist() == alone.values.tolist()
    assert float(alone.values[2]) == pytest.approx(float(alone.values[1] / alone.values[0]), rel=1e-12)


def test_configurations_are_distinguished(lens):
    zoom = lens.with_configurations(thickness={6: [12.4281, 16.0], 11: [57.9, 52.0]})
    found = rt.evaluate(zoom, merit="spot")
    assert {*found.configurations.tolist()} == {1, 2}
    one, two = (float(rt.evaluate(zoom, merit="spot", configuration=k).merit) for k in (1, 2))
    assert float(found.merit) ** 2 == pytest.approx((one**2 + two**2) / 2, rel=1e-12)
    alone = rt.evaluate(zoom.configuration(2), merit=rt.Merit.default(lens))
    assert float(alone.merit) == pytest.approx(two, rel=1e-12)
    joined = rt.Merit.default(zoom) + OWN
    assert rt.evaluate(zoom, merit=joined).configurations.tolist()[-1] == 1
    rows = rt.evaluate(zoom, merit=rt.optimization.DefaultMerit("spot", edge=1.0), configuration=2)
    assert {*rows.configurations.tolist()} == {2}


def test_the_file_s_merit_function_is_meant_without_another(lens):
    own = dataclasses.replace(lens, optimization_data=OptimizationData(merit=(FOCAL,), unit=25.4))
    found = rt.evaluate(own)
    assert (found.unit, len(found.row)) == (25.4, 1)
    assert rt.Merit.of(own).rows == (FOCAL,)
    assert [row.operand for row in rt.Merit.of(own, edge=1.0)] == ["EFFL", "MNEG"]
    with pytest.raises(rt.BadMerit, match="no merit function of its own"):
        rt.evaluate(lens)


def test_an_operand_that_is_not_known_is_an_error_unless_it_is_skipped(lens):
    rows = [FOCAL, Row("QXYZ", weight=1.0), Row("QABC")]
    with pytest.raises(UnknownOperand, match="row 2 of the merit function: operand QXYZ"):
        rt.evaluate(lens, merit=rows)
    found = rt.evaluate(lens, merit=rt.Merit(tuple(rows), skip_unknown=True))
    assert found.skipped == (2, 3)
    assert "left out, unknown: rows 2 (QXYZ), 3 (QABC)" in str(found)
    assert float(found.merit) == pytest.approx(abs(float(found.values[0]) - 100))


def test_a_function_of_a_lens_is_a_row_by_its_name(lens):
    def power(one):
        return rt.first_order(one).power

    found = rt.evaluate(lens, merit=rt.Merit((Row(power, target=0.01, weight=1.0),)) + OWN)
    assert float(found.values[0]) == pytest.approx(1 / float(found.values[1]), rel=1e-12)
    assert found.to_frame().operand.tolist() == ["power", "EFFL"]
    assert "power" in str(found)


def test_conventions_are_chosen_by_text(lens):
    def merit(conventions):
        return rt.Merit((Row("SPHA", (0, 1), weight=1.0),), conventions=conventions)

    usual, other = (float(rt.evaluate(lens, merit=merit(words)).values[0]) for words in (None, "seidel=wavefront"))
    assert other == pytest.approx(usual / 8, rel=1e-12)
    spelled = rt.evaluate(lens, merit=merit(["focal_length=in-air", "seidel=wavefront"]))
    assert float(spelled.values[0]) == other
    with pytest.raises(ValueError, match=r"did you mean seidel\?"):
        merit("seidl=wavefront")
    with pytest.raises(ValueError, match="expected one of coefficients, wavefront"):
        merit("seidel=waves")


def test_merit_functions_in_inches_and_in_millimetres_are_joined(lens):
    inches = rt.Merit((Row("EFFL", target=4.0, weight=1.0), Row("PETC", target=-0.254)), 25.4)
    joined = inches + OWN
    assert joined.rows[2].target == pytest.approx(100 / 25.4)
    assert (OWN + inches).rows[1].target == pytest.approx(4 * 25.4)
    assert (OWN + inches).rows[2].target == pytest.approx(-0.01)
    assert len(rt.Merit.default(lens) + inches) == len(rt.Merit.default(lens)) + 2
    value = float(rt.first_order(lens).effective_focal_length)
    both = [float(rt.evaluate(lens, merit=one).values[0]) for one in (joined, OWN + inches)]
    assert both == pytest.approx([value / 25.4, value], rel=1e-12)
    edged = rt.Merit.of(
        dataclasses.replace(lens, optimization_data=OptimizationData(merit=inches.rows, unit=25.4)), edge=2.54
    )
    assert edged.rows[-1].target == pytest.approx(0.1)


def test_failed_rays_are_reported(lens):
    wide = lens.at(fields=[0, 80])
    found = rt.evaluate(wide, merit="spot")
    assert bool(found.lost.any())
    assert re.search(r"^\d+ rows have lost their ray$", str(found), re.M)
    frame = found.to_frame()
    assert frame.value[found.lost.numpy()].isna().all()
    assert frame.operand.iloc[0] == "TRAC"


def test_long_tables_share_lines_and_list_every_row_when_asked(lens):
    together, every = (
        str(rt.evaluate(lens, merit=rt.optimization.DefaultMerit("spot", rings=6), each=each)) for each in (False, True)
    )
    rows = len(rt.evaluate(lens, merit=rt.optimization.DefaultMerit("spot", rings=6)).row)
    assert len(every.splitlines()) == 3 + rows  # the merit, headings and units
    assert len(together.splitlines()) == 3 + 3
    assert str(rt.Merit.default(lens)).count("TRAC") == 21


@pytest.mark.needs(DEVELOPMENT)
@pytest.mark.parametrize(
    "name", ["Project_X__sc_schmidt3.ZMX", "Project_X__sc_scan3.ZMX", "Project_X__sc_maksutov2.zmx"]
)
def test_a_stored_merit_is_that_of_the_oracle(name):
    files = json.loads((DEVELOPMENT / "oracle.json").read_text())["files"]
    expected = next(one for one in files if one["file"] == name)
    found = rt.evaluate(rt.read_lens(DEVELOPMENT / name))
    assert float(found.merit) == pytest.approx(expected["mf_stored"], rel=1e-8)


# -- the command -------------------------------------------------------------------------------------------------------


def test_the_command_prints_the_result_of_the_function(command):
    code, out, err = command("evaluate", "double_gauss", "--merit", "spot", "--rings", 4, "--arms", 8)
    assert code == 0, err
    assert out.startswith("merit 0.14")
    code, out, err = command("evaluate", "double_gauss", "--merit", "spot", "--json")
    document = json.loads(out)
    assert [*document] == ["analysis", "merit", "unit", "skipped", "results"]
    assert document["results"][0] == {
        **{"row": 3, "configuration": 1, "operand": "TRAC", "target": 0.0, "lost": False},
        **{name: document["results"][0][name] for name in ("arguments", "weight", "value", "contribution_percent")},
    }
    assert sum(one["contribution_percent"] for one in document["results"]) == pytest.approx(100)


def test_boundaries_are_rows_of_the_command(command):
    words = ("--glass-thickness", "2:15", "--air-thickness", "0.5:50", "--edge", 1)
    code, out, err = command("evaluate", "double_gauss", "--merit", "spot", *words, "--json")
    assert code == 0, err
    operands = [one["operand"] for one in json.loads(out)["results"]]
    assert {"MNCG", "MXCG", "MNEG", "MNCA", "MXCA", "MNEA"} < {*operands}


def test_the_figure_shows_the_parts(command):
    code, _, err = command("evaluate", "double_gauss", "--merit", "wavefront", "--plot", "merit.png")
    assert code == 0, err
    assert Path("merit.png").stat().st_size > 5000


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "no merit function of its own: choose one by --merit spot"),
        (("--merit", "spots"), "did you mean spot?"),
        (("--merit", "mtf"), "--merit mtf goes with --frequency"),
        (("--rings", 3), "--rings belongs to a default merit function: name it by --merit"),
        (("--merit", "spot", "--arms", 5), "an even number"),
        (("--merit", "spot", "--glass-thickness", "15:2"), "0 ≤ least < greatest"),
        (("--merit", "spot", "--configuration", 2), "configuration 2"),
    ],
)
def test_errors_of_evaluate_are_one_line(command, words, said):
    code, out, err = command("evaluate", "double_gauss", *words)
    assert code in (1, 2)
    assert out == ""
    assert len(err.splitlines()) == 1
    assert said in err

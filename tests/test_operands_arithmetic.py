"""Rows of arithmetic: what they make of other rows, in whatever order those stand; rows that name what is not there."""

import math

import numpy as np
import pytest
from merit_cases import check_derivatives, model_of, values_of

import raytrace as rt
from raytrace.optimization.merit import Circle, Evaluation, UnknownOperand
from raytrace.optimization.operands.arithmetic import ARITHMETIC
from raytrace.optimization.operands.operand import BadRow
from raytrace.optimization.variables import DesignVariables
from raytrace.system.optimization_data import Row, Vary

pytestmark = pytest.mark.usefixtures("compiler")

A, B, C = 3.0, -0.4, 0.7
CONSTANTS = [Row("CONS", target=A), Row("CONS", target=B), Row("BLNK", text="between"), Row("CONS", target=C)]
SPREAD = (A + B + C) / 3

CASES = {
    "OPVA": (Row("OPVA", (1, 0)), A),
    "DIFF": (Row("DIFF", (1, 2)), A - B),
    "SUMM": (Row("SUMM", (1, 4)), A + C),
    "PROD": (Row("PROD", (1, 2)), A * B),
    "DIVI": (Row("DIVI", (1, 2)), A / B),
    "PROB": (Row("PROB", (1, 0), (5.0, 0, 0, 0)), 5 * A),
    "DIVB": (Row("DIVB", (1, 0), (5.0, 0, 0, 0)), A / 5),
    "RECI": (Row("RECI", (2, 0)), 1 / B),
    "ABSO": (Row("ABSO", (2, 0)), -B),
    "SQRT": (Row("SQRT", (1, 0)), math.sqrt(A)),
    "OSUM": (Row("OSUM", (1, 4)), A + B + C),
    "QSUM": (Row("QSUM", (4, 1)), math.sqrt(A * A + B * B + C * C)),
    "MINN": (Row("MINN", (1, 4)), B),
    "MAXX": (Row("MAXX", (1, 4)), A),
    "EQUA": (Row("EQUA", (1, 4)), (A - SPREAD) + (SPREAD - B) + (SPREAD - C)),
    "EQUA within": (Row("EQUA", (1, 4), target=1.5), (A - SPREAD)),
    "SINE": (Row("SINE", (1, 0)), math.sin(A)),
    "SINE of degrees": (Row("SINE", (1, 1)), math.sin(math.radians(A))),
    "COSI": (Row("COSI", (2, 0)), math.cos(B)),
    "TANG": (Row("TANG", (2, 1)), math.tan(math.radians(B))),
    "ASIN": (Row("ASIN", (4, 0)), math.asin(C)),
    "ACOS": (Row("ACOS", (4, 1)), math.degrees(math.acos(C))),
    "ATAN": (Row("ATAN", (1, 0)), math.atan(A)),
    "LOGT": (Row("LOGT", (1, 0)), math.log10(A)),
    "LOGE": (Row("LOGE", (1, 0)), math.log(A)),
    "LOGE of a negative": (Row("LOGE", (2, 0)), 0.0),
    "OPGT met": (Row("OPGT", (1, 0), target=2.0), 2.0),
    "OPGT": (Row("OPGT", (1, 0), target=4.0), A),
    "OPLT met": (Row("OPLT", (1, 0), target=4.0), 4.0),
    "OPLT": (Row("OPLT", (1, 0), target=2.0), A),
    "ABGT": (Row("ABGT", (2, 0), target=0.5), -B),
    "ABLT": (Row("ABLT", (2, 0), target=0.1), -B),
}


@pytest.mark.parametrize("case", CASES)
def test_values_of_arithmetic_rows(case):
    row, expected = CASES[case]
    assert values_of("thick lens", [*CONSTANTS, row])[-1] == pytest.approx(expected, rel=1e-14)


def test_every_row_of_the_table_has_a_case():
    assert set(ARITHMETIC) == {row.operand for row, _ in CASES.values()} | {"CONS"}


@pytest.mark.parametrize("row", [Row("SQRT", (2, 0)), Row("ASIN", (1, 0)), Row("DIVI", (1, 5)), Row("RECI", (5, 0))])
def test_undefined_values_count_as_failed(row):
    """A row that takes the value of a lost one is lost too."""
    model, rows = model_of("thick lens"), [*CONSTANTS, Row("CONS"), Row("OPVA", (7, 0), weight=1.0), row]
    found = Evaluation(model, rows)(model.start, derivatives=True)
    assert math.isnan(found.values[-1])
    assert list(np.flatnonzero(found.lost)) == [5]
    assert found.merit == 10.0
    assert np.isfinite(found.jacobian).all()


FOCUS = 1.23


def tangled():
    """Rows of the lens and of rows, each with what it refers to by name: name -> (row, names)."""
    return {
        "focal length": (Row("EFFL"), ()),
        "height": (Row("REAY", (3, 1), (0.0, 0.7, 0.0, 0.5)), ()),
        "aperture": (Row("ISNA"), ()),
        "constant": (Row("CONS", target=FOCUS), ()),
        "product": (Row("PROD"), ("focal length", "aperture")),
        "ratio": (Row("DIVI"), ("product", "height")),
        "root": (Row("SQRT"), ("absolute",)),
        "absolute": (Row("ABSO"), ("less",)),
        "less": (Row("DIFF"), ("ratio", "constant")),
        "angle": (Row("ATAN"), ("root",)),
        "bounded": (Row("OPLT", target=0.01), ("angle",)),
    }


def in_an_order(names):
    """The rows in an order, between text, as (rows, place of each)."""
    rows, places = [Row("BLNK")], {}
    for name in names:
        rows.append(tangled()[name][0])
        places[name] = len(rows)
    for name, place in places.items():
        to = [places[other] for other in tangled()[name][1]]
        if to:
            rows[place - 1] = Row(rows[place - 1].operand, ([*to, 0])[:2], target=rows[place - 1].target)
    return [Row(row.operand, tuple(row.integers), row.numbers, row.target, 1.0) for row in rows], places


@pytest.mark.parametrize("seed", range(4))
def test_the_order_of_rows_does_not_matter(seed):
    names, model = list(tangled()), model_of("near")
    results = []
    for order in (names, list(np.random.default_rng(seed).permutation(names)), names[::-1]):
        rows, places = in_an_order(order)
        rows[0] = Row("BLNK")
        found = Evaluation(model, rows)(model.start, derivatives=True)
        slopes = {rows[k].operand: found.jacobian[found.of_row == k] for k in found.of_row}
        results.append(({name: found.values[place - 1] for name, place in places.items()}, slopes, found.merit))
    for values, slopes, merit in results[1:]:
        assert values == results[0][0]
        assert merit == pytest.approx(results[0][2], rel=1e-15)
        assert all(np.array_equal(slopes[name], results[0][1][name]) for name in slopes)
    values = results[0][0]
    less = values["focal length"] * values["aperture"] / values["height"] - FOCUS
    assert values["angle"] == pytest.approx(math.atan(math.sqrt(abs(less))), rel=1e-14)


def test_derivatives_through_rows():
    check_derivatives("near", shifted())


def shifted():
    """The tangled rows without text in front."""
    rows, _ = in_an_order(list(tangled()))
    moved = []
    for row in rows[1:]:
        to = tuple(max(n - 1, 0) for n in row.integers) if row.operand in ARITHMETIC else row.integers
        moved.append(Row(row.operand, to, row.numbers, row.target, row.weight))
    return moved


def test_rows_of_other_configurations():
    """The focal length of one over that of another, and what it moves by, from either."""
    zoom = rt.read_lens("double_gauss").with_configurations(thickness={6: [12.4281, 16.0]})
    model = DesignVariables(zoom, (Vary(1, "curvature"), Vary(6, "thickness", configuration=2, operand=0)))
    rows = [Row("CONF", (1, 0)), Row("DIVI", (3, 5), weight=1.0), Row("EFFL"), Row("CONF", (2, 0)), Row("EFFL")]
    found = Evaluation(model, rows)(model.start, derivatives=True)
    lengths = [float(rt.first_order(one).effective_focal_length) for one in zoom.configurations]
    assert found.values[[2, 4]] == pytest.approx(lengths, rel=1e-12)
    assert found.values[1] == pytest.approx(lengths[0] / lengths[1], rel=1e-12)
    assert Evaluation(model, [*rows, Row("CONF", (1, 0))])(model.start).values[1] == found.values[1]
    for i, step in enumerate((1e-7, 1e-4)):
        ahead, back = (Evaluation(model, rows)(model.start + side * step * np.eye(2)[i]).values[1] for side in (1, -1))
        assert found.jacobian[0, i] == pytest.approx((ahead - back) / (2 * step), rel=1e-6)
    with pytest.raises(BadRow, match=r"CONF .*configuration 3: .*configurations 1 to 2$"):
        Evaluation(model, [Row("CONF", (3, 0))])


def test_values_are_taken_in_the_unit_of_the_rows():
    rows = [Row("EFFL"), Row("PETC"), Row("PROD", (1, 2)), Row("PROD", (1, 1))]
    mm, inches = values_of("near", rows), values_of("near", rows, unit=25.4)
    assert inches == pytest.approx([mm[0] / 25.4, mm[1] * 25.4, mm[2], mm[3] / 25.4**2], rel=1e-14)


BAD = {
    "a row that is not there": (
        [Row("CONS"), Row("DIFF", (1, 9))],
        r"^row 2 of the merit function: DIFF takes the value of row 9: there are rows 1 to 2; rows added by ",
    ),
    "row 0": ([Row("ABSO")], r"^row 1 .* ABSO takes the value of row 0: there are rows 1 to 1; rows added by "),
    "text": (
        [Row("BLNK"), Row("RECI", (1, 0))],
        r"^row 2 .* RECI takes the value of row 1, which has none: BLNK, text$",
    ),
    "text alone": (
        [Row("DMFS"), Row("OSUM", (1, 1))],
        r"^row 2 .* takes the values of rows 1 to 1: none of them has one$",
    ),
    "a range beyond": (
        [Row("CONS"), Row("OSUM", (1, 7))],
        r"^row 2 .* rows 1 to 7: there are rows 1 to 2; rows added by ",
    ),
    "a surface": ([Row("REAY", (40, 1))], r"^row 1 .* REAY names surface 40: this lens has surfaces 1 to 4$"),
    "a surface below": ([Row("REAB", (-1, 1))], r"^row 1 .* REAB names surface -1: .* 0 to 4 \(0: the object\)$"),
    "the object at infinity": ([Row("REAY", (0, 1))], r"^row 1 .* REAY names surface 0: .* surfaces 1 to 4.*$"),
    "incidence on the object": ([Row("RAID", (0, 1))], r"^row 1 .* RAID names surface 0: .* surfaces 1 to 4$"),
    "a wavelength": (
        [Row("EFFL", (0, 5))],
        r"^row 1 .* EFFL names wavelength 5: .* wavelengths 0 to 1 \(0: the primary one\)$",
    ),
    "a wavelength of rays": ([Row("TRAR", (0, 3))], r"^row 1 .* TRAR names wavelength 3: .*$"),
    "a field": (
        [Row("TFNO", (4, 1))],
        r"^row 1 .* TFNO names field 4: this lens has fields 0 to 1 \(0: the largest\)$",
    ),
    "a configuration": (
        [Row("CONF", (2, 0)), Row("EFFL")],
        r"^row 1 .* CONF names configuration 2: .* configuration 1 alone$",
    ),
    "a primary wavelength": ([Row("PRIM", (0, 2))], r"^row 1 .* PRIM names wavelength 2: .* wavelength 1 alone$"),
}


@pytest.mark.parametrize("case", BAD)
def test_rows_that_refer_to_missing_rows(case):
    rows, message = BAD[case]
    with pytest.raises(BadRow, match=message):
        Evaluation(model_of("thick lens"), rows)


def test_a_circle():
    rows = [Row("CONS"), Row("DIFF", (1, 4)), Row("ABSO", (2, 0)), Row("SQRT", (3, 0))]
    with pytest.raises(Circle, match=r"^rows (2 → 4 → 3 → 2|4 → 3 → 2 → 4|3 → 2 → 4 → 3) of the merit function"):
        Evaluation(model_of("thick lens"), rows)
    with pytest.raises(Circle, match="rows 1 → 1"):
        Evaluation(model_of("thick lens"), [Row("OSUM", (1, 2)), Row("CONS")])


def test_rows_on_rows_that_are_skipped():
    model = model_of("thick lens")
    rows = [Row("WHAT"), Row("EFFL", weight=1.0), Row("ABSO", (1, 0)), Row("DIFF", (2, 3), weight=1.0)]
    with pytest.raises(UnknownOperand, match=r"^row 4 .*DIFF .* row 3, ABSO, .*`skip_"):
        Evaluation(model, rows)
    evaluation = Evaluation(model, rows, skip_unknown=True)
    assert evaluation.skipped == (1, 3, 4)
    assert evaluation(model.start).merit == pytest.approx(values_of("thick lens", [Row("EFFL")])[0])
    with pytest.raises(UnknownOperand, match=r"row 1 .*: operand WHAT is not known"):
        Evaluation(model, [Row("WHAT", weight=1.0)])
    with pytest.raises(UnknownOperand, match=r"DISG .*did you mean DIS"):
        Evaluation(model, [Row("DISG", weight=1.0)])


def test_one_argument_of_a_row_is_its_first():
    assert Row("OPLT", 3, 0.5) == Row("OPLT", (3, 0), (0.5, 0.0, 0.0, 0.0))
    assert Row("REAY", [4, 1], (0, 0.7)) == Row("REAY", (4, 1), (0, 0.7, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"REAY: `integers` .*at most 2"):
        Row("REAY", (1, 2, 3))

"""Glass: every formula against 30-digit answers, its derivatives, the edges where there is no index, the two doors."""

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from differences import gradcheck, gradgradcheck
from hypothesis import given, settings
from hypothesis import strategies as st
from problems import for_examples

from raytrace.materials.glass import (
    AIR,
    BY_NUMBER,
    FORMULAS,
    LINES,
    MIRROR,
    Glass,
    InvalidIndex,
    OutOfRange,
    abbe_number,
    check_wavelengths,
    constant,
    index,
    mil_glass,
    model_glass,
    nd,
    normal_line_deviation,
    refractive_index,
    sellmeier,
)

ULP = 2.0**-52  # one unit in the last place of an index between 1 and 2
DISPERSION = json.loads((Path(__file__).parent / "oracles" / "dispersion.json").read_text())["cases"]
BK7 = sellmeier(
    [1.03961212, 0.231792344, 1.01046945],
    [0.00600069867, 0.0200179144, 103.560653],
    name="N-BK7",
    catalog="SCHOTT",
    wavelength_range=(0.3, 2.5),
)


def float64(numbers, **options):
    return torch.tensor(numbers, dtype=torch.float64, **options)


def case_id(case):
    return f"{case['formula']}-{case['wavelength']}"


@pytest.mark.parametrize("case", DISPERSION, ids=case_id)
def test_formula_gives_the_index_of_the_definition(case):
    n = refractive_index(Glass("", case["formula"], float64(case["coefficients"])), float64(case["wavelength"]))
    # Four roundings of the index; the 30-digit answer itself is rounded once on reading.
    assert abs(n.item() - float(case["n"])) <= 4 * ULP * float(case["n"])


@pytest.mark.parametrize("case", DISPERSION, ids=case_id)
def test_slope_is_the_derivative_of_the_definition(case):
    wavelength = float64(case["wavelength"], requires_grad=True)
    n = refractive_index(Glass("", case["formula"], float64(case["coefficients"])), wavelength)
    slope = torch.autograd.grad(n, wavelength)[0].item() if n.requires_grad else 0.0  # constant: no link to wavelength
    expected = float(case["slope"])
    # The power series add terms of both signs: 1e-13 of the slope is what their roundings leave.
    assert abs(slope - expected) <= 1e-13 * abs(expected)


def test_every_formula_has_a_case():
    assert {case["formula"] for case in DISPERSION} == set(FORMULAS)
    assert list(BY_NUMBER) == list(range(1, 14))
    assert BY_NUMBER[4] == "sellmeier_2"
    assert BY_NUMBER[13] == "extended_3"


@pytest.mark.parametrize("formula", FORMULAS)
def test_first_and_second_derivatives_in_wavelength_and_coefficients(formula):
    cases = [case for case in DISPERSION if case["formula"] == formula]
    case = min(cases, key=lambda case: abs(case["wavelength"] - 1.0))  # where no power of λ is large
    coefficients = float64(case["coefficients"], requires_grad=True)
    wavelengths = case["wavelength"] * float64([1.0, 1.07, 1.21])
    wavelengths.requires_grad_(formula != "constant")

    def n(coefficients, wavelength):
        return refractive_index(Glass("", formula, coefficients), wavelength)

    # Central differences of step 1e-6: 1e-10 of noise over gradients up to 1e3, 1e-5 of it on steep terms (λ⁻¹²).
    assert gradcheck(n, (coefficients, wavelengths), rtol=1e-5, atol=1e-6)
    assert gradgradcheck(n, (coefficients, wavelengths), rtol=1e-5, atol=1e-5)


# -- next to a pole, beyond it, and where there is nothing -------------------------------------------------------------


def test_index_and_slope_next_to_a_pole_are_exact_to_rounding():
    """At 0.1414847 µm, 4e-7 from the second pole of N-BK7, n = 884; 30-digit answers by mpmath."""
    wavelength = float64(0.1414847, requires_grad=True)
    n = refractive_index(BK7, wavelength)
    (slope,) = torch.autograd.grad(n, wavelength)
    assert n.item() == pytest.approx(884.265431592678415, rel=8 * ULP)
    square = 0.1414847**2  # λ² alone, rounded, would be wrong in the seventh digit of the distance to the pole
    assert abs(square - 0.0200179144) < 3e-8
    step = 1e-13
    difference = refractive_index(BK7, float64([0.1414847 + step, 0.1414847 - step]))
    # A central difference over 2e-13 µm sees the index to 1e-13 of 884 on a change of 4e-4: three digits.
    assert slope.item() == pytest.approx((difference[0] - difference[1]).item() / (2 * step), rel=5e-2)


def test_slope_far_above_the_poles_does_not_cancel():
    """dn/dλ of N-BK7 at 1 mm is -5.7e-11 of terms that are 1e-3 each when written as a quotient."""
    wavelength = float64(1000.0, requires_grad=True)
    (slope,) = torch.autograd.grad(refractive_index(BK7, wavelength), wavelength)
    strengths, poles = BK7.coefficients[0::2].tolist(), BK7.coefficients[1::2].tolist()
    exact = -sum(b * c * 1000.0 / (1e6 - c) ** 2 for b, c in zip(strengths, poles, strict=True))
    assert slope.item() == pytest.approx(exact / refractive_index(BK7, wavelength).item(), rel=8 * ULP)


NOWHERE = [10.0, 10.17, 10.1764754, 0.0, -0.5, math.nan, math.inf]


@pytest.mark.parametrize("wavelength", NOWHERE)
def test_no_index_is_zero_without_a_nan_in_value_or_gradient(wavelength):
    numbers = float64([wavelength, 0.5875618], requires_grad=True)
    coefficients = BK7.coefficients.clone().requires_grad_()
    n = refractive_index(replace(BK7, coefficients=coefficients), numbers)
    assert n[0] == 0.0
    assert n[1] == refractive_index(BK7, float64(0.5875618))
    gradients = torch.autograd.grad(n.sum(), [numbers, coefficients], create_graph=True)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    assert gradients[0][0] == 0.0
    assert gradients[0][1] < 0.0  # the good wavelength keeps its slope
    second = torch.autograd.grad(sum(gradient.sum() for gradient in gradients), [numbers, coefficients])
    assert all(torch.isfinite(gradient).all() for gradient in second)


@pytest.mark.parametrize(
    "formula", ["sellmeier_1", "sellmeier_2", "sellmeier_4", "herzberger", "handbook_1", "handbook_2"]
)
def test_exactly_on_a_pole_there_is_no_index(formula):
    pole = {
        "sellmeier_1": [1.0, 0.25, 0.2, 0.01, 1.0, 100.0],
        "sellmeier_2": [0.4, 1.0, 0.5, 0.1, 0.1],
        "sellmeier_4": [2.0, 1.0, 0.25, 1.0, 100.0],
        "herzberger": [2.5, 0.1, 0.01, 0.0, 0.0, 0.0],
        "handbook_1": [2.5, 0.1, 0.25, 0.01],
        "handbook_2": [2.5, 0.1, 0.25, 0.01],
    }[formula]
    wavelength = float64(math.sqrt(0.028) if formula == "herzberger" else 0.5, requires_grad=True)
    coefficients = float64(pole, requires_grad=True)
    n = refractive_index(Glass("", formula, coefficients), wavelength)
    if formula == "herzberger":  # λ² = 0.028 has no double: the nearest one is within 1e-17 of the pole
        assert torch.isfinite(n)
    else:
        assert n == 0.0
    gradients = torch.autograd.grad(n, [wavelength, coefficients])
    assert all(torch.isfinite(gradient).all() for gradient in gradients)


def test_a_term_of_no_strength_has_no_pole():
    """Catalogs pad with K = L = 0, and a strength of 0 may stand at any pole."""
    glass = sellmeier([1.2, 0.0], [0.01, 0.25])
    assert refractive_index(glass, float64(0.5)) == refractive_index(sellmeier([1.2], [0.01]), float64(0.5))


@pytest.mark.parametrize("examples", [75, pytest.param(300, marks=pytest.mark.slow)])
def test_whatever_the_numbers_the_index_is_positive_or_zero_and_its_gradient_zero_there(examples):
    def check(formula, numbers, wavelength):
        coefficients = float64(numbers[: FORMULAS[formula].count], requires_grad=True)
        wavelengths = float64([wavelength], requires_grad=True)
        n = refractive_index(Glass("", formula, coefficients), wavelengths)
        assert torch.isfinite(n).all()
        assert (n >= 0.0).all()
        if n == 0.0 and all(abs(number) < 1e30 for number in numbers):
            gradients = torch.autograd.grad(n.sum(), [coefficients, wavelengths], allow_unused=True)
            assert all((gradient == 0.0).all() for gradient in gradients if gradient is not None)

    anything = st.floats(allow_nan=True, allow_infinity=True)
    lists = st.lists(anything, min_size=10, max_size=10)
    for_examples(examples, check, formula=st.sampled_from(sorted(FORMULAS)), numbers=lists, wavelength=anything)


# -- the public functions ----------------------------------------------------------------------------------------------


def test_index_warns_outside_the_range_and_names_glass_wavelength_and_range():
    with pytest.warns(OutOfRange, match=r"N-BK7 .*10\.6 µm.* 0\.3 to 2\.5 µm"):
        n = index(BK7, float64([0.55, 10.6]))
    assert n[1].item() == pytest.approx(3.895422492943524, rel=4 * ULP)  # mpmath


def test_a_missing_index_is_refused_with_place_glass_wavelength_formula_and_range():
    with pytest.raises(InvalidIndex) as caught:
        check_wavelengths(BK7, [0.55, 10.0], where="a.zmx:31, surface 2")
    for part in ("a.zmx:31, surface 2", "N-BK7 (SCHOTT)", "at 10 µm", "sellmeier_1", "0.3 to 2.5 µm"):
        assert part in str(caught.value)
    for wrong in (0.0, -1.0, math.nan, math.inf):
        with pytest.raises(InvalidIndex):
            index(BK7, wrong)


def test_no_warning_inside_the_range_and_at_its_ends():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        index(BK7, float64([0.3, 0.55, 2.5]))
        index(BK7, torch.tensor([0.3, 2.5], dtype=torch.float32))  # 0.3 rounds to below 0.3
        index(AIR, 1e3)
        check_wavelengths(MIRROR, [math.nan])


def test_an_index_below_one_is_an_index():
    assert index(constant(0.9), 0.5) == 0.9


def test_a_mirror_has_no_index():
    with pytest.raises(InvalidIndex, match="mirror"):
        refractive_index(MIRROR, float64(0.5))


# -- shapes, dtypes, transforms ----------------------------------------------------------------------------------------


def test_any_shape_and_the_dtype_of_the_wavelength():
    wavelengths = torch.linspace(0.4, 0.7, 6, dtype=torch.float64).reshape(2, 1, 3)
    assert refractive_index(BK7, wavelengths).shape == (2, 1, 3)
    assert refractive_index(AIR, wavelengths).shape == (2, 1, 3)
    assert refractive_index(BK7, float64(0.5)).shape == ()
    single = refractive_index(BK7, wavelengths.float())
    assert single.dtype == torch.float32
    # Evaluated in double: only wavelength (6e-8 · slope 0.1) and result are rounded to float32.
    assert torch.allclose(single.double(), refractive_index(BK7, wavelengths), rtol=0.0, atol=1.5e-7)


def test_a_population_of_glasses_broadcasts_against_the_wavelengths():
    strengths = float64([[1.0, 1.1], [0.2, 0.3]])
    both = sellmeier(strengths, float64([[0.006, 0.007], [0.02, 0.03]]))
    n = refractive_index(both, float64([0.4, 0.5, 0.6])[:, None])
    assert n.shape == (3, 2)
    alone = sellmeier([1.1, 0.3], [0.007, 0.03])
    assert torch.equal(n[:, 1], refractive_index(alone, float64([0.4, 0.5, 0.6])))
    assert abbe_number(both).shape == (2,)


def test_torch_func_transforms_accept_it():
    wavelengths = float64([0.45, 0.55, 0.65])

    def n(glass, wavelength):
        return refractive_index(glass, wavelength)

    slopes = torch.func.vmap(lambda wavelength: torch.func.grad(n, argnums=1)(BK7, wavelength))(wavelengths)
    jacobian = torch.func.jacfwd(n, argnums=1)(BK7, wavelengths)
    assert torch.allclose(jacobian.diagonal(), slopes, rtol=1e-14, atol=0.0)  # the same sums in another order
    by_coefficient = torch.func.jacrev(lambda c: refractive_index(replace(BK7, coefficients=c), wavelengths))
    assert by_coefficient(BK7.coefficients).shape == (3, 6)


@pytest.mark.slow
def test_torch_compile_accepts_it():
    wavelengths = float64([0.45, 0.55, 0.65])
    compiled = torch.compile(refractive_index, backend="eager", fullgraph=True)
    assert torch.equal(compiled(BK7, wavelengths), refractive_index(BK7, wavelengths))


# -- figures of a glass ------------------------------------------------------------------------------------------------


def test_bk7_has_its_published_figures():
    assert nd(BK7).item() == pytest.approx(1.51680003450058844, rel=2 * ULP)  # mpmath
    assert abbe_number(BK7).item() == pytest.approx(64.17, abs=0.005)  # SCHOTT, rounded to two decimals
    assert normal_line_deviation(BK7).item() == pytest.approx(-0.0009, abs=5e-5)  # SCHOTT, rounded to four decimals


def test_a_medium_without_dispersion_has_abbe_number_zero():
    assert abbe_number(AIR) == 0.0
    assert normal_line_deviation(AIR) == 0.0
    assert nd(AIR) == 1.0


# -- model glass and MIL code ------------------------------------------------------------------------------------------

FIT_LINES = float64([0.5876, 0.4861, 0.6563, 0.4358])


@given(st.floats(1.3, 2.2), st.floats(15.0, 100.0), st.floats(-0.05, 0.05))
@settings(max_examples=100, deadline=None)
def test_model_glass_meets_its_three_numbers_at_the_lines_of_the_fit(n, v, deviation):
    d, blue, red, violet = refractive_index(model_glass(n, v, deviation), FIT_LINES).tolist()
    assert d == n
    dispersion = (n - 1) / v
    # Differences of indices near 2, each rounded a few times; the ratio divides by a dispersion ≥ 0.003.
    assert blue - red == pytest.approx(dispersion, abs=16 * ULP)
    assert (violet - blue) / (blue - red) == pytest.approx(0.6438 - 0.001682 * v + deviation, abs=1e-11)


def test_model_glass_by_an_independent_fit():
    """BK7 by its two numbers stays within 1e-4 of the true index over the visible, the accuracy of such a model."""
    model = model_glass(1.5168, 64.17, -0.0009)
    visible = torch.linspace(0.42, 0.68, 27, dtype=torch.float64)
    assert (refractive_index(model, visible) - refractive_index(BK7, visible)).abs().max() < 1e-4


def test_abbe_number_zero_is_a_constant_index():
    glass = model_glass(1.6, 0.0)
    assert torch.equal(refractive_index(glass, FIT_LINES), torch.full((4,), 1.6, dtype=torch.float64))
    numbers = float64([1.6, 0.0, 0.0], requires_grad=True)
    n = refractive_index(Glass("", "model", numbers), float64(0.45))
    assert torch.autograd.grad(n, numbers)[0].tolist() == [1.0, 0.0, 0.0]


def test_model_glass_is_differentiable_in_its_three_numbers():
    numbers = [float64(number, requires_grad=True) for number in (1.6, 45.0, 0.003)]

    def n(nd_, vd, dpgf):
        return refractive_index(model_glass(nd_, vd, dpgf), FIT_LINES)

    assert gradcheck(n, numbers)
    assert gradgradcheck(n, numbers)


def test_mil_code():
    glass = mil_glass("517642")
    assert glass.name == "517642"
    assert glass.coefficients.tolist() == [1.517, 64.2, 0.0]
    assert nd(glass).item() == pytest.approx(1.517, abs=2e-6)  # the d line itself is 4e-5 µm from the fit's 0.5876
    for wrong in ("51764", "5176421", "51764x", "５１７６４２", ""):
        with pytest.raises(ValueError, match="six digits"):
            mil_glass(wrong)


@pytest.mark.parametrize("numbers", [(math.nan, 60.0), (0.0, 60.0), (1.5, -3.0), (1.5, 60.0, math.inf)])
def test_model_glass_refuses_numbers_that_are_no_glass(numbers):
    with pytest.raises(ValueError, match="model glass"):
        model_glass(*numbers)


def test_sellmeier_refuses_unpaired_coefficients():
    with pytest.raises(ValueError, match="as many strengths as poles"):
        sellmeier([1.0, 2.0], [0.01])
    assert sellmeier([1.0] * 4, [0.01] * 4).formula == "sellmeier_3"
    assert sellmeier([1.0] * 5, [0.01] * 5).formula == "sellmeier_5"


def test_lines_are_in_order_of_wavelength():
    assert list(LINES.values()) == sorted(LINES.values())


def test_an_index_at_a_plain_number_is_that_of_a_tensor():
    glass = Glass("", "schott", float64([2.27, -0.01, 0.01, 1e-4, 0.0, 0.0]))
    assert float(refractive_index(glass, 0.5876)) == float(refractive_index(glass, float64(0.5876)))
    assert refractive_index(glass, [0.4861, 0.6563]).shape == (2,)


def test_a_glass_is_shown_in_a_line():
    assert repr(BK7) == "<Glass: N-BK7 (SCHOTT), n_d 1.5168, V_d 64.1673>"
    assert repr(constant(1.0)) == "<Glass: air>"
    assert repr(constant(1.5)) == "<Glass: n 1.5>"
    two = replace(BK7, coefficients=torch.stack([BK7.coefficients, 1.1 * BK7.coefficients], 1))
    indices = nd(two).tolist()
    assert f"n_d {indices[0]:.6g} to {indices[1]:.6g}, V_d " in repr(two)
    shown = []
    torch.func.vmap(lambda k: shown.append(repr(replace(BK7, coefficients=k))) or k.sum(), 1)(two.coefficients)
    assert shown == ["<Glass: N-BK7 (SCHOTT)>"]

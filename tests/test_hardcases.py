"""The hard cases: values, statuses, roots, gradients and OPD against 30-digit references.

Oracle: tests/oracles/hardcases.json.gz (mpmath at 220 digits; schema in its `meta`). RAYTRACE_HARDCASES=FILE runs the
same test on another file of that schema, every case of every kind. score = |error|/(u·cond), with u = 2⁻⁵³ (2⁻²⁴ in
float32), is 1 for what an exact algorithm loses by the rounding of its inputs.
"""

import math
import warnings
from decimal import Decimal, getcontext

import hardcases_gaussian
import hardcases_property
import hardcases_splat
import hardcases_wave
import pytest
import torch
from hardcases_scene import CASES, OUTPUTS, Scene, of_kind

from raytrace.materials.glass import InvalidIndex, OutOfRange, check_wavelengths, refractive_index, sellmeier
from raytrace.tracing.wavefront import path_to_reference_sphere

getcontext().prec = 60

ROUNDING = {torch.float64: 2.0**-53, torch.float32: 2.0**-24}
SMALLEST = {torch.float64: 2.0**-1074, torch.float32: 2.0**-149}  # spacing of denormal numbers
VALUE_SCORE = 30.0  # for chains of up to 20 surfaces
LONG_CHAIN_SCORE = 100.0  # rounding accumulates over more than 20 surfaces
GRADIENT_SCORE = 100.0
OPD_WAVES = {torch.float64: 1e-11, torch.float32: 3e-3}
STATUS = {"tangent": "miss", "tir_critical": "tir"}  # limits of a miss and of total reflection


def by_engine() -> list:
    """Parameters of a test: all cases by both engines; torch alone traces one case of each family but in the slow
    suite."""
    listed = [case for kind in dict.fromkeys(c["kind"] for c in CASES) for case in of_kind(kind)]
    first = {(case.values[0]["kind"], case.values[0].get("family")): case.id for case in reversed(listed)}
    return [
        pytest.param(
            *case.values,
            engine,
            id=f"{case.id}-{engine}",
            marks=pytest.mark.slow if engine == "eager" and case.id not in first.values() else (),
        )
        for engine in ("eager", "compiled")
        for case in listed
    ]


@pytest.mark.parametrize(("case", "engine"), by_engine(), indirect=["engine"])
def test_hard_case(case, engine):
    check(case)


def check(case: dict) -> None:
    """Run a case by its kind; one of a kind that is not known fails."""
    if case["kind"] not in KINDS:
        pytest.fail(f"{case['id']}: no check for cases of kind {case['kind']!r}; known are {', '.join(KINDS)}")
    KINDS[case["kind"]](case)


def test_a_case_that_is_not_known_fails():
    with pytest.raises(pytest.fail.Exception, match="no check for cases of kind 'spots'"):
        check({"id": "A9-d-0", "kind": "spots"})
    with pytest.raises(pytest.fail.Exception, match="no law 'shuffle'"):
        check({"id": "A7-d-shuffle", "kind": "property", "data": {"of": CASES[0]["id"]}})
    with pytest.raises(pytest.fail.Exception, match="no system 'F99'"):
        check({"id": "A7-d-permute", "kind": "property", "data": {"of": "F99"}})


def error(value: float, expected: str) -> float:
    """|value - expected| with the expected decimal at its full length; inf for a value that is not finite."""
    return float(abs(Decimal(value) - Decimal(expected))) if math.isfinite(value) else math.inf


def check_trace(case):
    check_float64(case)
    check_float32(case)
    check_gradients_of_shared_numbers(case)


def check_float64(case):
    scene = Scene(case, torch.float64)
    result = scene.run()
    for i, expected in enumerate(case["expected"]):
        assert result["status"][i] == STATUS.get(expected["status"], expected["status"]), f"ray {i}"
        assert result["fail_surface"][i] == expected["fail_surface"], f"ray {i}"
        if expected["status"] == "ok":
            check_values(case, result, i, [*expected["hits"][-1], *expected["dirs"][-1], expected["opl"]])
    check_gradients(case, scene, result)
    check_opd(case, result, scene, torch.float64)


def check_float32(case):
    """Values and statuses against the exact answers for inputs rounded to float32."""
    scene = Scene(case, torch.float32)
    result = scene.run()
    for i, expected in enumerate(case["expected"]):
        reference = expected.get("f32_inputs")
        if reference is None:
            continue
        assert result["status"][i] == STATUS.get(reference["status"], reference["status"]), f"ray {i}, float32"
        if reference["status"] == "ok":
            check_values(case, result, i, [*reference["hit"], *reference["dir"], reference["opl"]])
    check_opd(case, result, scene, torch.float32)


def check_gradients_of_shared_numbers(case):
    """One number of the lens seen by every ray of the batch: no lost neighbour may make its gradient NaN."""
    scene = Scene(case, torch.float64, shared=True)
    result = scene.run()
    total = sum(result[output].sum() for output in OUTPUTS)
    found = torch.autograd.grad(total, list(scene.parameters.values()), allow_unused=True)
    for name, gradient in zip(scene.parameters, found, strict=True):
        assert gradient is None or torch.isfinite(gradient).all(), name


def check_values(case, result, i, reference):
    """Score of every output of ray i; a case without `cond` is judged by status and root alone."""
    if case["expected"][i].get("cond") is not None:
        gate = LONG_CHAIN_SCORE if len(case["surfaces"]) > 20 else VALUE_SCORE
        assert score(case, result, i, reference) <= gate, f"ray {i}, {result['x'].dtype}"


def score(case, result, i, reference) -> float:
    """The largest |error|/(u·cond) over the outputs of ray i."""
    cond = case["expected"][i]["cond"]
    scores = []
    for output, value in zip(OUTPUTS, reference, strict=True):
        computed = result[output][i]
        unit_rounding = max(ROUNDING[computed.dtype] * cond[output], smallest(case, computed.dtype))
        scores.append(error(computed.item(), value) / unit_rounding)
    return max(scores)


def smallest(case, dtype):
    """Error that a direction rounded to the spacing of denormal numbers makes at the end of the system, mm."""
    return SMALLEST[dtype] * (1 + sum(abs(surface["thickness"]) for surface in case["surfaces"]))


def check_gradients(case, scene, result):
    for place, found in gradient_scores(case, scene, result).items():
        assert found <= GRADIENT_SCORE, place


def gradient_scores(case, scene, result) -> dict[tuple, float]:
    """Scores by (ray, output, parameter).

    A derivative may err by its own conditioning, and by what moves the output by less than its rounding:
    scale = grad_cond + |g| + cond/max(1, |p|). The last term only decides for derivatives too small to matter, such
    as d x/d k = 1e-34 of an almost flat surface.
    """
    unit_rounding, leaves, scores = ROUNDING[torch.float64], scene.parameters, {}
    least, sizes = smallest(case, torch.float64), {name: leaf.abs().tolist() for name, leaf in leaves.items()}
    for output in OUTPUTS:
        if not any(output in expected.get("grad", ()) for expected in case["expected"]):
            continue
        found = torch.autograd.grad(result[output].sum(), list(leaves.values()), retain_graph=True, allow_unused=True)
        gradients = {name: None if g is None else g.tolist() for name, g in zip(leaves, found, strict=True)}
        for i, expected in enumerate(case["expected"]):
            for name, value in expected.get("grad", {}).get(output, {}).items():
                if value is None:
                    continue
                gradient = 0.0 if gradients[name] is None else gradients[name][i]
                size = max(1.0, sizes[name][i])
                scale = expected["grad_cond"][output][name] + abs(float(value)) + expected["cond"][output] / size
                scale = max(unit_rounding * scale, least)
                scores[i, output, name] = error(gradient, value) / scale
    return scores


def check_opd(case, result, scene, dtype):
    if "opd" in case:
        assert max(opd_errors(case, result, scene, dtype)) <= OPD_WAVES[dtype]


def opd_errors(case, result, scene, dtype) -> list[float]:
    """|error| in waves of the path to the reference sphere against the chief ray's, ray by ray."""
    opd = case["opd"]
    centre = torch.tensor(opd["center"], dtype=dtype)[:, None]
    radius = torch.tensor(opd["radius"], dtype=dtype)
    W = path_to_reference_sphere(result["last"], centre, 1 / radius, scene.indices[-1])
    W = (W - W[opd["chief"]]) / opd["wavelength_mm"]
    return [error(W[i].item(), expected) for i, expected in enumerate(opd["W_waves"]) if expected is not None]


def check_index(case):
    """Sellmeier index and its gradient inside and outside the range of the glass, next to poles, n² ≤ 0 and n < 1."""
    data, expected = case["data"], case["expected"]
    B = torch.tensor(data["B"], dtype=torch.float64, requires_grad=True)
    C = torch.tensor(data["C"], dtype=torch.float64, requires_grad=True)
    wavelength = torch.tensor(data["wavelength_um"], dtype=torch.float64, requires_grad=True)
    glass = sellmeier(B, C, data["glass"], wavelength_range=tuple(data["range_um"]))
    n = refractive_index(glass, wavelength)
    n.backward()
    gradients = {"wavelength": wavelength.grad.item()}
    gradients |= {f"B{j}": B.grad[j].item() for j in range(3)} | {f"C{j}": C.grad[j].item() for j in range(3)}
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        if expected["status"] == "invalid":
            with pytest.raises(InvalidIndex, match=data["glass"]):
                check_wavelengths(glass, wavelength)
            assert n.item() == 0.0
            assert all(gradient == 0.0 for gradient in gradients.values())
            return
        check_wavelengths(glass, wavelength)
    assert any(issubclass(entry.category, OutOfRange) for entry in caught) == (not expected["in_range"])
    assert error(n.item(), expected["n"]) <= VALUE_SCORE * ROUNDING[torch.float64] * float(expected["n"])
    for name, value in expected["grad"].items():
        allowed = GRADIENT_SCORE * ROUNDING[torch.float64] * abs(float(value))
        assert error(gradients[name], value) <= allowed, name


KINDS = {
    "trace": check_trace,
    "index": check_index,
    "spot": hardcases_gaussian.check_spot,
    "gauss_pixel": hardcases_gaussian.check_gauss_pixel,
    "splat": hardcases_splat.check_splat,
    "fft_psf": hardcases_wave.check_fft_psf,
    "huygens": hardcases_wave.check_huygens,
    "property": hardcases_property.check_property,
}


def table() -> str:
    """Markdown: per family the rays, and the worst value, gradient and OPD error of both dtypes."""
    families: dict[str, dict[str, float]] = {}
    for case in CASES:
        if case["kind"] != "trace":
            continue
        worst = families.setdefault(case["family"], dict.fromkeys(("rays", "right", "f64", "f32", "grad", "opd"), 0))
        double, single = Scene(case, torch.float64), Scene(case, torch.float32)
        result = double.run()
        result_32 = single.run()
        for i, expected in enumerate(case["expected"]):
            worst["rays"] += 1
            worst["right"] += result["status"][i] == STATUS.get(expected["status"], expected["status"])
            if expected["status"] != "ok" or "cond" not in expected:
                continue
            reference = [*expected["hits"][-1], *expected["dirs"][-1], expected["opl"]]
            worst["f64"] = max(worst["f64"], score(case, result, i, reference))
            rounded = expected.get("f32_inputs")
            if rounded is not None and rounded["status"] == "ok":
                reference = [*rounded["hit"], *rounded["dir"], rounded["opl"]]
                worst["f32"] = max(worst["f32"], score(case, result_32, i, reference))
        worst["grad"] = max([worst["grad"], *gradient_scores(case, double, result).values()])
        if "opd" in case:
            worst["opd"] = max([worst["opd"], *opd_errors(case, result, double, torch.float64)])
    lines = [
        "| family | rays | status right | value, float64 | value, float32 | gradient, float64 | OPD, float64, waves |",
        "|---|---|---|---|---|---|---|",
    ]
    for family, w in families.items():
        opd = f"{w['opd']:.1e}" if w["opd"] else ""
        lines.append(
            f"| {family} | {w['rays']} | {w['right']} | {w['f64']:.2g} | {w['f32']:.2g} | {w['grad']:.2g} | {opd} |"
        )
    total, right = (sum(w[key] for w in families.values()) for key in ("rays", "right"))
    return "\n".join([*lines, "", f"{right} of {total} rays right."])


if __name__ == "__main__":
    print(table())

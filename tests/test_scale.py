"""Scale: a lens of 10¹²⁰ mm, or of 10⁻¹²⁰, traces as one of a millimetre does, and so do all its derivatives.

Powers of two change no digit of a number, so what is scaled has to come out bit for bit, or nearly so where
the compiled trace takes another way for far rays. With float32 the same for 2^±36. Beside it: statuses of float32 rays.
"""

import copy
import math
from fractions import Fraction

import numpy as np
import pytest
import torch
from hardcases_scene import CASES, OUTPUTS, Scene
from hits import hit_jacobian
from problems import both_engines
from torch.testing import assert_close

from raytrace.materials.glass import AIR, constant
from raytrace.system.rays import Rays, start
from raytrace.system.surface import Surface
from raytrace.tracing.compiled import engine
from raytrace.tracing.refraction import refract
from raytrace.tracing.trace import trace_surfaces

LENGTHS = {"x", "y", "z", "opl"}
ASPHERES = [case for case in CASES if case.get("family") == "asphere" and len(case["surfaces"]) < 5]


def length_power(name: str) -> int:
    """The power of a length in a number of a scene or an output."""
    first, _, last = name.partition(".")
    if name in LENGTHS or first in ("o", "object", "aim") or last == "thickness":
        return 1
    if last.startswith("a"):
        return 1 - int(last[1:])
    return -1 if last == "c" else 0


def scaled(case: dict, power: int) -> dict:
    """The case with all its lengths multiplied by 2^power."""
    case = copy.deepcopy(case)
    for surface in case["surfaces"]:
        for key, by in (("c", -1), ("thickness", 1), ("semi_diameter", 1)):
            if surface.get(key):
                surface[key] = math.ldexp(surface[key], by * power)
        if "a" in surface:
            surface["a"] = [math.ldexp(a, power * (1 - (2 * j + 4))) for j, a in enumerate(surface["a"])]
    for ray in case["rays"]:
        for key in {"o", "object", "aim"} & set(ray):
            ray[key] = [math.ldexp(v, power) for v in ray[key]]
    return case


def with_terms(case: dict, terms: int) -> dict:
    """The aspheres of the case with their first so many terms, or, with none, as even aspheres whose terms are 0."""
    case = copy.deepcopy(case)
    for surface in case["surfaces"]:
        if "a" in surface:
            surface["a"] = surface["a"][:terms] or [0.0]
    return case


def usual(limit: float) -> list[dict]:
    """One case of every family, of few surfaces, whose lengths are all within a factor `limit` of a millimetre."""
    found = {}
    for case in CASES:
        if (
            case["kind"] != "trace"
            or len(case["surfaces"]) > 4
            or not any(expected["status"] == "ok" for expected in case["expected"])
        ):
            continue
        lengths = [v for ray in case["rays"] for key in ("o", "object", "aim") for v in ray.get(key, ())]
        lengths += [s["thickness"] for s in case["surfaces"]]
        lengths += [1 / s["c"] for s in case["surfaces"] if s.get("c")]
        if all(1 / limit < abs(v) < limit for v in lengths if v):
            found.setdefault(case["family"], with_terms(case, 0))
    return list(found.values())


def outcome(case: dict, dtype: torch.dtype) -> tuple[dict, dict]:
    """Outputs of the last ray that arrives, and their derivatives by every number, backward and forward."""
    ray = max(i for i, expected in enumerate(case["expected"]) if expected["status"] == "ok")
    scene = Scene(case, dtype, shared=True, rays=[ray])
    rays, origin = scene.launch()
    last = trace_surfaces(scene.surfaces, rays, indices=scene.indices)
    assert last.valid.all()
    values = dict(zip(OUTPUTS, (*last.position, *last.direction, last.opl + origin), strict=True))
    derivatives = {}
    for output in ("x", "M", "opl"):
        found = torch.autograd.grad(
            values[output].sum(), list(scene.parameters.values()), retain_graph=True, allow_unused=True
        )
        for name, gradient in zip(scene.parameters, found, strict=True):
            derivatives[output, name] = 0.0 if gradient is None else float(gradient.sum())
    own = [name for name in scene.parameters if name[0] in "sn" and not name.endswith("thickness")]
    if engine() == "eager":
        own = []  # torch's forward derivative of r² by a curvature leaves the range of numbers
    fixed = Rays(rays.position.detach(), rays.direction.detach(), rays.valid)
    variables = [scene.parameters[name] for name in own]
    jacobian = hit_jacobian(scene.surfaces, fixed, variables, indices=scene.indices)[..., 0] if own else []
    for name, (x, y) in zip(own, jacobian, strict=True):
        derivatives["x", f"forward {name}"], derivatives["y", f"forward {name}"] = float(x), float(y)
    return {name: float(value.detach()) for name, value in values.items()}, derivatives


def check_scaling(case: dict, power: int, dtype: torch.dtype, *, tolerance: float) -> None:
    values, derivatives = outcome(case, dtype)
    big_values, big = outcome(scaled(case, power), dtype)
    numbers = torch.finfo(dtype)
    low, high = math.log2(numbers.tiny / numbers.eps), math.log2(numbers.max) - 4
    for name, value in values.items():
        assert_close(big_values[name], math.ldexp(value, power * length_power(name)), rtol=tolerance, atol=0.0)
    for (output, name), derivative in derivatives.items():
        place = power * (length_power(output) - length_power(name.removeprefix("forward ")))
        if derivative and low < math.frexp(derivative)[1] + place < high:
            wanted, floor = math.ldexp(derivative, place), math.ldexp(tolerance, int(min(place, high)))
            assert abs(big[output, name] - wanted) <= tolerance * abs(wanted) + floor, (output, name)


def up_and_down(power: int):
    """Of a test: the scale 2^power by one engine and 2^-power by the other, each by both in the slow suite."""
    quick, slow = ((power, "compiled"), (-power, "eager")), ((power, "eager"), (-power, "compiled"))
    listed = [*quick, *(pytest.param(*case, marks=pytest.mark.slow) for case in slow)]
    return pytest.mark.parametrize(("power", "engine"), listed, indirect=["engine"])


@up_and_down(398)
@pytest.mark.parametrize("case", usual(1e30), ids=lambda case: case["id"])
def test_every_derivative_follows_the_scale(case, power, engine):
    check_scaling(case, power, torch.float64, tolerance=1e-9)


@up_and_down(300)
@pytest.mark.parametrize("case", ASPHERES, ids=lambda case: case["id"])
def test_those_of_a_fourth_power_do(case, power, engine):
    """Higher coefficients themselves leave the range of numbers. Rays that miss without the others are left out."""
    case = with_terms(case, 1)
    try:
        outcome(case, torch.float64)
    except AssertionError:
        pytest.skip("the ray needs the higher terms")
    check_scaling(case, power, torch.float64, tolerance=1e-9)


@up_and_down(36)
@pytest.mark.parametrize("case", usual(1e3), ids=lambda case: case["id"])
def test_in_float32_too(case, power, engine):
    check_scaling(case, power, torch.float32, tolerance=2e-3)


@pytest.mark.parametrize("power", [200, -200])
def test_second_derivatives_follow_the_scale(power):
    """Of a conic and of an asphere, by curvature, conic constant and the place of the ray."""

    def hit(numbers: torch.Tensor, scale: int, aspheric: bool) -> torch.Tensor:
        curvature, conic, y = numbers
        front = Surface(
            thickness=torch.tensor(math.ldexp(8.0, scale), dtype=torch.float64),
            curvature=curvature,
            conic=conic,
            coefficients=torch.zeros(1, dtype=torch.float64) if aspheric else None,
            glass=constant(1.5),
        )
        back = Surface(thickness=front.thickness, glass=AIR)
        length = math.ldexp(1.0, scale)
        rays = start(
            torch.stack([0 * y + 0.3 * length, y, 0 * y - 2 * length])[:, None],
            torch.tensor([0.05, -0.1, 1.0], dtype=torch.float64)[:, None],
        )
        one, glass = (torch.tensor(n, dtype=torch.float64) for n in (1.0, 1.5))
        return trace_surfaces([front, back], rays, indices=[one, glass, one]).position[1, 0]

    for aspheric in (False, True):
        plain = torch.tensor([0.1, -0.4, 1.2], dtype=torch.float64)
        powers = torch.tensor([-1, 0, 1])
        found = torch.func.hessian(hit)(plain, 0, aspheric)
        big = torch.func.hessian(hit)(torch.ldexp(plain, power * powers), power, aspheric)
        wanted = torch.ldexp(found, power * (1 - powers[:, None] - powers))
        assert_close(big, wanted, rtol=1e-11, atol=0.0)


# -- statuses of float32 rays ------------------------------------------------------------------------------------------


def near_critical(count: int) -> np.ndarray:
    """(count, 4) float32 curvature, index, height and 1 if light passes: h c n within 1e-10 of 1, but not on it."""
    random = np.random.default_rng(7)
    c, n = random.uniform(0.01, 0.1, 400_000).astype("f4"), random.uniform(1.4, 2.0, 400_000).astype("f4")
    h = (1 / (c.astype("f8") * n)).astype("f4")
    near = np.abs(c.astype("f8") * n * h - 1) < 1e-10
    rows = [
        (c, n, h, product < 1)
        for c, n, h in zip(c[near], n[near], h[near], strict=True)
        if (product := Fraction(float(c)) * Fraction(float(n)) * Fraction(float(h))) != 1
    ]
    return np.array(rows[:count], dtype="f4")


@both_engines
@pytest.mark.parametrize("shape", ["sphere", "conic", "asphere"])
def test_float32_is_no_reason_for_another_status_at_the_critical_angle(shape, engine):
    """A ray parallel to the axis meets a sphere under sin θ = h c; from glass to air it passes where n h c < 1."""
    rows = near_critical(60)
    assert 10 < rows[:, 3].sum() < 50
    for c, n, h, passes in torch.from_numpy(rows):
        surface = Surface(
            thickness=torch.tensor(1.0),
            curvature=-c,
            conic=None if shape == "sphere" else torch.tensor(0.0),
            coefficients=torch.zeros(2) if shape == "asphere" else None,
            glass=AIR,
        )
        rays = start(torch.stack([0 * h, h, 0 * h - 7.3])[:, None], torch.tensor([0.0, 0.0, 1.0])[:, None])
        found = trace_surfaces([surface], rays, indices=[n, torch.tensor(1.0)])
        assert bool(found.valid) == bool(passes), (float(c), float(n), float(h))
        assert torch.isfinite(found.direction).all()


def test_a_better_discriminant_decides_and_leaves_the_gradient():
    cosine = torch.tensor([0.6, 0.6], requires_grad=True)
    direction = [torch.tensor([0.8, 0.8]), torch.zeros(2), torch.tensor([0.6, 0.6])]
    n = [torch.zeros(2), torch.zeros(2), torch.ones(2)]
    sure = torch.tensor([1e-60, -1e-60], dtype=torch.float64)
    (_, _, N), passes = refract(direction, n, cosine, 1.0, torch.tensor(1.25), torch.tensor(1.0), sure)
    assert passes.tolist() == [True, False]
    assert torch.isfinite(N).all()
    (gradient,) = torch.autograd.grad(N.sum(), cosine)
    assert torch.isfinite(gradient).all()

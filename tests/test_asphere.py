"""Even aspheres: sag and slopes, the first crossing among several, derivatives through the search, batches, vmap."""

import math
from decimal import Decimal, localcontext

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import surface

from raytrace.system.intersection import intersect
from raytrace.system.shapes import EVEN
from raytrace.system.surface import sag, sag_and_derivatives

ROUNDING = 2.0**-53


def tensor(x, **options):
    return torch.tensor(x, dtype=torch.float64, **options)


CURVATURE_AND_SHAPE = (0.1, 0.5)  # as float64 holds them


def textbook_sag(u: float) -> Decimal:
    """(1 - √(1 - (1+k) c² u)) / ((1+k) c) of c = 0.1, k = -0.5 in 80 digits, where it may cancel."""
    with localcontext() as context:
        context.prec = 80
        c, shape = (Decimal(x) for x in CURVATURE_AND_SHAPE)
        return (1 - (1 - shape * c * c * Decimal(u)).sqrt()) / (shape * c)


def test_sag_without_coefficients_is_the_conic_and_slopes_are_its_derivatives():
    u = tensor([0.0, 1e-30, 1.0, 90.0], requires_grad=True)
    c, k = tensor(0.1), tensor(-0.5)
    S, dS, d2S = sag_and_derivatives(u, c, k, None)
    exact = [float(textbook_sag(x)) for x in u.tolist()]
    assert torch.allclose(S.detach(), tensor(exact), rtol=4 * ROUNDING, atol=0)  # facts/numerics 3.2: 3.2 roundings
    (slope,) = torch.autograd.grad(S.sum(), u, create_graph=True)
    (bend,) = torch.autograd.grad(slope.sum(), u)
    assert torch.allclose(slope, dS, rtol=1e-14)
    assert torch.allclose(bend, d2S, rtol=1e-14)


def test_slopes_of_all_terms_by_autograd():
    u = tensor([0.0, 0.5, 20.0], requires_grad=True)
    S, dS, d2S = sag_and_derivatives(u, tensor(0.05), tensor(1.2), tensor([1e-2, -2e-3, 3e-5, 1e-7]))
    (slope,) = torch.autograd.grad(S.sum(), u, create_graph=True)
    (bend,) = torch.autograd.grad(slope.sum(), u)
    assert torch.allclose(slope, dS, rtol=1e-13)
    assert torch.allclose(bend, d2S, rtol=1e-12)


def test_terms_that_are_all_zero_leave_the_conic():
    conic = surface(0.03, conic=-0.7)
    asphere = surface(0.03, conic=-0.7, coefficients=[0.0, 0.0, 0.0])
    position = tensor([[0.0, 3.0, -8.0], [0.0, 1.0, 2.0], [-5.0, 0.0, 1.0]])
    direction = tensor([[0.0, 0.1, 0.3], [0.0, -0.2, 0.0], [1.0, 0.97, 0.95]])
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    a, b = intersect(asphere, position, direction), intersect(conic, position, direction)
    assert torch.equal(a[1], b[1])
    assert (a[0] - b[0]).abs().max() <= 20 * ROUNDING  # mm; points up to 8 mm off the axis


def test_an_r2_term_is_a_paraboloid():
    """a₁ r² alone is a conic of c = 2 a₁, k = -1: two formulas, one surface."""
    parabola, term = surface(0.04, conic=-1.0), surface(None, coefficients=[0.02])
    position = tensor([[0.0, 3.0, 15.0], [0.0, 1.0, 20.0], [-5.0, 0.0, 1.0]])
    direction = tensor([[0.0, 0.1, 0.3], [0.0, -0.2, 0.0], [1.0, 0.97, 0.95]])
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    a, b = intersect(term, position, direction), intersect(parabola, position, direction)
    assert a[1].all()
    assert torch.allclose(a[0], b[0], rtol=0, atol=200 * ROUNDING)


GULL = {"curvature": 0.0, "coefficients": [-0.02, 1.2e-4], "semi_diameter": 12.0}


def test_first_crossing_of_a_gull_wing():
    """A ray nearly across the wings meets them up to four times; the first in its direction of propagation counts."""
    gull = surface(**GULL)
    heights = torch.linspace(-0.8, 0.5, 27, dtype=torch.float64)
    position = torch.stack([torch.full_like(heights, -20.0), torch.zeros_like(heights), heights])
    tilt = tensor([math.cos(0.02), 0.0, math.sin(0.02)])[:, None].expand(3, 27)
    hit, met = intersect(gull, position, tilt)
    t = torch.linspace(0, 45, 45001, dtype=torch.float64)
    for i in range(27):
        x, z = position[0, i] + t * tilt[0, i], position[2, i] + t * tilt[2, i]
        F = z - (-0.02 * x**2 + 1.2e-4 * x**4)
        crosses = (F[:-1] <= 0) & (F[1:] > 0) & (x[1:].abs() <= 12.0)
        assert bool(met[i]) or not bool(crosses.any()), i
        if bool(crosses.any()):
            first = x[:-1][crosses][0]
            assert abs(hit[0, i] - first) <= 1e-3, i  # mm: the spacing of the scan


def test_root_of_a_batch_equals_roots_one_by_one():
    gull = surface(**GULL)
    generator = torch.Generator().manual_seed(2)
    position = torch.rand(3, 200, generator=generator, dtype=torch.float64) * 20 - 10
    direction = torch.randn(3, 200, generator=generator, dtype=torch.float64)
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    hit, met = intersect(gull, position, direction)
    for i in range(0, 200, 7):
        alone, met_alone = intersect(gull, position[:, i : i + 1], direction[:, i : i + 1])
        assert torch.equal(alone[:, 0], hit[:, i])
        assert met_alone[0] == met[i]
    residual = hit[2] - sag(gull, hit[0] ** 2 + hit[1] ** 2)
    assert residual[met].abs().max() <= 1e-13  # mm: tens of roundings of coordinates of 10 mm


@pytest.mark.parametrize(
    "kind", ["curvature", "conic", "coefficients", pytest.param("position", marks=pytest.mark.slow)]
)
def test_derivatives_through_the_search_with_failed_rays(kind):
    """First and second derivatives of the hit, in a batch with a ray that misses and one found by the bracket."""
    numbers = {
        "curvature": tensor(0.01),
        "conic": tensor(0.5),
        "coefficients": tensor([-0.02, 1.2e-4]),
        "position": tensor([[1.0, -20.0, 500.0], [2.0, 0.0, 0.0], [-3.0, -0.55, 0.0]]),
        "direction": tensor([[0.1, math.cos(0.02), 0.0], [0.2, 0.0, 0.0], [0.9, math.sin(0.02), 1.0]]),
    }

    def hits(x):
        n = {**numbers, kind: x}
        s = surface(n["curvature"], conic=n["conic"], coefficients=n["coefficients"], semi_diameter=12.0)
        hit, met = intersect(s, n["position"], n["direction"])
        assert met.tolist() == [True, True, False]
        return hit

    x = numbers[kind].requires_grad_()
    assert gradcheck(hits, x, eps=1e-7, atol=1e-5, rtol=1e-4)
    assert gradgradcheck(hits, x, eps=1e-7, atol=1e-3, rtol=1e-3)


def test_population_of_aspheres_by_broadcasting_and_by_vmap():
    generator = torch.Generator().manual_seed(3)
    coefficients = 1e-4 * torch.randn(2, 5, generator=generator, dtype=torch.float64)
    curvature = 0.02 + 0.01 * torch.rand(5, generator=generator, dtype=torch.float64)
    position = tensor([[0.0, 3.0, 4.0], [0.0, 1.0, 2.0], [-5.0, 0.0, 1.0]])
    direction = tensor([[0.0, 0.1, 0.3], [0.0, -0.2, 0.0], [1.0, 0.97, 0.95]])
    direction = direction / torch.linalg.vector_norm(direction, dim=0)

    def hit(c, a):
        return intersect(surface(c, conic=-0.2, coefficients=a, semi_diameter=8.0), position, direction)[0]

    one_by_one = torch.stack([hit(c, a) for c, a in zip(curvature, coefficients.T, strict=True)])
    assert torch.equal(torch.func.vmap(hit, in_dims=(0, 1))(curvature, coefficients), one_by_one)
    assert torch.equal(torch.func.vmap(hit, in_dims=(None, 1))(curvature[0], coefficients)[0], one_by_one[0])
    broadcast = hit(curvature[:, None], coefficients[:, :, None])
    assert torch.equal(broadcast.movedim(1, 0), one_by_one)


def test_nested_vmap():
    """Fields outside, lenses inside: two mapped axes on different arguments."""
    a = tensor([[1e-4, 2e-4, 3e-4]])
    x = tensor([0.0, 1.0, 2.0, 3.0])

    def height(a, x):
        position = torch.stack([x, torch.zeros_like(x), torch.zeros_like(x) - 1])
        axis = torch.zeros(3, dtype=torch.float64).index_fill(0, torch.tensor(2), 1.0)
        return intersect(surface(0.01, coefficients=a), position, axis)[0][2]

    found = torch.func.vmap(torch.func.vmap(height, in_dims=(1, None)), in_dims=(None, 0))(a, x)
    expected = torch.stack([torch.stack([height(a[:, i], xi) for i in range(3)]) for xi in x])
    assert torch.equal(found, expected)


@pytest.mark.slow
def test_operator_passes_the_checks_of_torch_library():
    p = tensor([[0.0, 1.0], [0.5, 2.0], [-1.0, 0.0]])
    d = tensor([[0.0, 0.0], [0.0, 0.0], [1.0, 1.0]])
    arguments = (p, d, tensor(0.02), tensor(-1.0), tensor([0.0, 1e-5]), EVEN, [], "", math.inf)
    torch.library.opcheck(torch.ops.raytrace.first_crossing.default, arguments)


def test_empty_batch_and_no_hits():
    nothing = torch.zeros(3, 0, dtype=torch.float64)
    hit, met = intersect(surface(0.1, coefficients=[1e-3]), nothing, nothing)
    assert hit.shape == (3, 0)
    assert met.shape == (0,)
    far = tensor([[100.0], [0.0], [0.0]])
    hit, met = intersect(surface(0.1, coefficients=[1e-3]), far, tensor([[0.0], [0.0], [1.0]]))
    assert not met.any()
    assert torch.equal(hit, torch.zeros_like(hit))

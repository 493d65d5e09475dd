"""Sags that differ along x and y: toroids, biconics, polynomials, fringe terms, irregularity, a tilted plane."""

import dataclasses
import math

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import both_engines, points, scalar, vector
from torch.testing import assert_close

from raytrace.maths import zernike
from raytrace.maths.bivariate import powers
from raytrace.maths.numerics import to
from raytrace.system.intersection import intersect, normal
from raytrace.system.rays import start
from raytrace.system.sag_terms import FringeSag, IrregularSag, PolynomialSag, TiltSag, as_polynomial, relief
from raytrace.system.shapes import KINDS
from raytrace.system.surface import Surface, sag_at, vertex_curvature
from raytrace.tracing.trace import trace_surfaces


def close(found, true, *, rtol: float = 0.0, atol: float = 0.0):
    assert_close(found, true, rtol=rtol, atol=atol)


def freeform(kind: str, curvature, conic, *coefficients: float, **others) -> Surface:
    c, k = (None if number is None else scalar(number) for number in (curvature, conic))
    return Surface(scalar(5.0), c, k, vector(*coefficients), kind=kind, **others)


def departing(sag_terms, curvature=1 / 30, conic=-0.6) -> Surface:
    c, k = (None if number is None else scalar(number) for number in (curvature, conic))
    return Surface(scalar(5.0), c, k, sag_terms=sag_terms)


def fringes(count: int = 37) -> FringeSag:
    return FringeSag(vector(*(0.01 / j for j in range(1, count + 1))), scalar(8.0), scalar(0.5), scalar(-0.4))


def polynomial(count: int = 27) -> PolynomialSag:
    return PolynomialSag(vector(*(0.01 / j * (-1) ** j for j in range(1, count + 1))), scalar(8.0))


IRREGULAR = IrregularSag(scalar(0.01), scalar(0.02), scalar(0.013), scalar(25.0), scalar(8.0))

ALL = {
    "toroid": freeform("toroidal", 1 / 40, -0.7, -1 / 26, 1e-4, 2e-6, 1e-9),
    "toroid of one curve": freeform("toroidal", -1 / 30, None, -1 / 60),
    "cylinder along x": freeform("toroidal", None, None, 1 / 20),
    "cylinder along y": freeform("toroidal", 1 / 20, None, 0.0),
    "biconic": freeform("biconic", 1 / 30, -1.0, -1 / 50, 0.5),
    "biconic of positive curvatures": freeform("biconic", 1 / 30, 0.3, 1 / 50, -2.5),
    "fringe": departing(fringes()),
    "polynomial": departing(polynomial()),
    "irregular": departing(IRREGULAR),
    "tilted plane": departing(TiltSag(scalar(0.3), scalar(-0.2)), None, None),
    "polynomial on a toroid": dataclasses.replace(freeform("toroidal", 1 / 40, None, 1 / 60), sag_terms=polynomial(9)),
}
each = pytest.mark.parametrize("name", ALL)


def bundle(count: int = 300, reach: float = 5.0, tilt: float = 0.3):
    direction = torch.cat([points(count, tilt, 2), torch.ones(1, count, dtype=torch.float64)])
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    position = torch.cat([points(count, reach, 1), torch.zeros(1, count, dtype=torch.float64)])
    return position - 15 * direction, direction


@each
def test_hits_lie_on_the_sag_and_normals_are_its_slopes(name):
    surface = ALL[name]
    hit, met = intersect(surface, *bundle())
    assert met.all()
    assert (hit[2] - sag_at(surface, hit[0], hit[1])).abs().max() < 4e-15
    x, y = (part.clone().requires_grad_() for part in hit[:2])
    slopes = torch.autograd.grad(sag_at(surface, x, y).sum(), (x, y), allow_unused=True)
    n, squared = normal(surface, hit)
    for part, slope in zip(n, slopes, strict=False):
        close(-part / n[2], torch.zeros_like(x) if slope is None else slope, atol=1e-14)
    close(torch.as_tensor(squared).expand_as(x), n[0] ** 2 + n[1] ** 2 + n[2] ** 2, rtol=1e-14)


@each
def test_derivatives_of_the_sag_are_written_out_right(name):
    surface = ALL[name]
    x, y = points(200, 5.0, 1).requires_grad_().unbind()
    a = surface.coefficients
    if a is None:
        found = relief(surface.sag_terms).sag(x, y)
    else:
        c, k = (scalar(0.0) if number is None else number for number in (surface.curvature, surface.conic))
        found = KINDS[surface.kind].form.sag(c, k, a, x, y, 2)

    def slopes(of):
        given = (
            torch.autograd.grad(of.sum(), (x, y), create_graph=True, allow_unused=True)
            if of.requires_grad
            else (None,) * 2
        )
        return [torch.zeros_like(x) if slope is None else slope for slope in given]

    z_x, z_y = slopes(found.z)
    close(found.x, z_x, atol=1e-15)
    close(found.y, z_y, atol=1e-15)
    for part, true in zip((found.xx, found.xy), slopes(z_x), strict=True):
        close(part, true, atol=1e-15)
    close(found.yy, slopes(z_y)[1], atol=1e-15)


def test_a_toroid_of_equal_curvatures_is_a_sphere_and_a_biconic_a_conic():
    x, y = points(200, 5.0, 1)
    sphere = Surface(scalar(5.0), scalar(1 / 30))
    close(sag_at(freeform("toroidal", 1 / 30, None, 1 / 30), x, y), sag_at(sphere, x, y), atol=1e-15)
    conic = dataclasses.replace(sphere, conic=scalar(-1.7))
    close(sag_at(freeform("biconic", 1 / 30, -1.7, 1 / 30, -1.7), x, y), sag_at(conic, x, y), atol=1e-15)


def test_sections_and_curvatures_at_the_vertex():
    y = torch.linspace(-5, 5, 11, dtype=torch.float64)
    toroid = ALL["toroid"]
    curve = dataclasses.replace(toroid, kind="even asphere", coefficients=toroid.coefficients[1:])
    close(sag_at(toroid, 0 * y, y), sag_at(curve, 0 * y, y), atol=1e-16)
    close(sag_at(toroid, y, 0 * y), sag_at(Surface(scalar(0.0), scalar(-1 / 26)), y, 0 * y), atol=1e-15)
    close(vertex_curvature(toroid), vertex_curvature(curve))
    assert float(vertex_curvature(toroid)) == pytest.approx(1 / 40 + 2e-4, rel=1e-15)
    mean = 1 / 30 - 0.01 * (1 / 3 + 1 / 5) / 64
    assert float(vertex_curvature(departing(polynomial()))) == pytest.approx(mean, rel=1e-14)


def test_fringe_terms_are_the_polynomials_that_are_one_at_the_rim():
    x, y = points(100, 4.0, 1)
    sag_terms = fringes()
    u, v = (x - 0.5) / 8, (y + 0.4) / 8
    orders = [zernike.fringe(j) for j in range(1, 38)]
    rim = torch.tensor([zernike.norm(*order) for order in orders], dtype=torch.float64)
    basis = zernike.polynomials(orders, u, v) / rim[:, None]
    close(relief(sag_terms).sag(x, y).z, sag_terms.coefficients @ basis, atol=1e-16)
    assert orders[36] == (12, 0)
    # A few by their formula: tilt x, tilt y, focus, astigmatism, coma.
    for j, true in ((2, u), (3, v), (4, 2 * (u * u + v * v) - 1), (6, 2 * u * v), (7, (3 * (u * u + v * v) - 2) * u)):
        close(basis[j - 1], true, atol=1e-15)


def test_polynomial_terms_are_in_order():
    assert powers(9) == [(1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]
    x, y = points(50, 5.0, 1)
    sag_terms = polynomial()
    direct = sum(c * (x / 8) ** i * (y / 8) ** j for (i, j), c in zip(powers(27), sag_terms.coefficients, strict=True))
    close(relief(sag_terms).sag(x, y).z, direct, atol=1e-16)


def test_irregularity_and_tilt_are_their_formulas():
    x, y = points(50, 5.0, 1)
    turn, rho = math.radians(25), (x * x + y * y).sqrt() / 8
    v = (y * math.cos(turn) - x * math.sin(turn)) / 8
    close(relief(IRREGULAR).sag(x, y).z, 0.01 * rho**4 + 0.02 * v**2 + 0.013 * rho**2 * v, atol=1e-17)
    tilt = TiltSag(scalar(0.3), scalar(-0.2))
    close(relief(tilt).sag(x, y).z, 0.3 * x - 0.2 * y, atol=1e-15)
    assert as_polynomial(tilt).coefficients.tolist() == [0.3, -0.2]


LONG = dict.fromkeys(
    ("fringe", "irregular", "polynomial", "polynomial on a toroid", "cylinder along y"), pytest.mark.slow
)


@pytest.mark.parametrize("name", [pytest.param(name, marks=LONG.get(name, ())) for name in ALL])
def test_derivatives_of_the_hit_by_every_number_with_failed_rays(name):
    surface = ALL[name]
    position = vector(0.3, 2.0, -1.5, 900.0, 0.4, -1.0, 2.2, 900.0, -9.0, -8.0, -9.0, -7.0).reshape(3, 4)
    direction = vector(0.1, -0.2, 0.05, 0.0, -0.1, 0.1, 0.2, 0.0, 1.0, 1.0, 1.0, 1.0).reshape(3, 4)
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    fields = [f for f in ("curvature", "conic", "coefficients", "sag_terms") if getattr(surface, f) is not None]
    tensors, spec = torch.utils._pytree.tree_flatten([getattr(surface, f) for f in fields])

    def hits(*numbers):
        parts = dict(zip(fields, torch.utils._pytree.tree_unflatten(numbers, spec), strict=True))
        hit, met = intersect(dataclasses.replace(surface, **parts), position, direction)
        return torch.where(met, hit, 0.0)

    given = tuple(number.clone().requires_grad_() for number in tensors)
    many = sum(number.numel() for number in given) > 8  # then in random directions
    assert gradcheck(hits, given, atol=1e-6, fast_mode=many)
    assert gradgradcheck(hits, given, atol=1e-6, fast_mode=True)


# -- hard cases ----------------------------------------------------------------------------------------------------


def one_ray(position, direction):
    d = vector(*direction)
    return vector(*position)[:, None], (d / torch.linalg.vector_norm(d))[:, None]


@both_engines
@pytest.mark.parametrize("scale", [1e-100, 1e-3, 1.0, 1e3, 1e100])
@pytest.mark.parametrize("kind", ["toroidal", "biconic"])
def test_all_lengths_may_be_larger_or_smaller(engine, kind, scale):
    """A lens and its rays, enlarged: the same directions, and hits that are enlarged."""

    def traced(by):
        numbers = {"toroidal": [-1 / 26 / by], "biconic": [-1 / 26 / by, 0.4]}[kind]
        face = freeform(kind, 1 / 40 / by, -1.0, *numbers)
        position, direction = bundle(50, 4.0)
        rays = start(position * by, direction, torch.zeros(50, dtype=torch.float64))
        return trace_surfaces([face], rays, indices=vector(1.0, 1.5).unbind())

    end, true = traced(scale), traced(1.0)
    assert torch.equal(end.valid, true.valid)
    assert true.valid.all()
    close(end.position / scale, true.position, atol=1e-14)
    close(end.direction, true.direction, atol=4e-15)


@both_engines
def test_the_inner_sheet_of_a_toroid_is_not_met(engine):
    """A ring of radius 10 about y turned at 26 mm: light that goes through its hole towards the far side misses it."""
    toroid = freeform("toroidal", 1 / 10, None, 1 / 26)
    rays = start(vector(0.0, 27.0, 3.0, 0.0, 0.0, 11.0, -5.0, -5.0, -5.0).reshape(3, 3), _along_z(3))
    end = trace_surfaces([toroid], rays, indices=vector(1.0, 1.5).unbind())
    assert end.valid.tolist() == [True, False, False]


def _along_z(count: int) -> torch.Tensor:
    zero = torch.zeros(count, dtype=torch.float64)
    return torch.stack([zero, zero, zero + 1])


@both_engines
def test_a_cylinder_is_met_up_to_its_edge(engine):
    """z = R - √(R² - x²) to rounding, at 1 - 1e-9 of the radius as well; beyond it there is nothing."""
    x = 20 * vector(0.0, 0.5, 0.99, 1 - 1e-6, 1 - 1e-9, 1 + 1e-9, 1.5)
    rays = start(torch.stack([x, 0 * x + 3, 0 * x - 5]), _along_z(7))
    along_x, along_y = freeform("toroidal", None, None, 1 / 20), freeform("toroidal", 1 / 20, None, 0.0)
    for face, turned in ((along_x, False), (along_y, True)):
        given = dataclasses.replace(rays, position=rays.position[[1, 0, 2]]) if turned else rays
        end = trace_surfaces([face], given, indices=[scalar(1.0)] * 2)
        assert end.valid.tolist() == [True] * 5 + [False] * 2
        true = 20 - torch.sqrt((20 - x[:5]) * (20 + x[:5]))
        close(end.position[2, :5], true, atol=1e-10)  # rounding of x, 4e-15 mm, on a slope of 2e4
        close(end.position[2, :4], true[:4], atol=2e-12)


@both_engines
def test_a_toroid_of_conic_minus_one_and_negative_radius(engine):
    """A parabola c y²/2 turned at R = -26: the hit lies on (26 + z)² + x² = (26 + g)² with g = c y²/2."""
    face = freeform("toroidal", 1 / 40, -1.0, -1 / 26)
    end = trace_surfaces([face], start(*bundle(200, 6.0)), indices=[scalar(1.0)] * 2)
    x, y, z = end.position
    assert end.valid.all()
    g = y * y / 80
    close((26 + z) ** 2 + x * x, (26 + g) ** 2, rtol=1e-14)


@both_engines
def test_float32_and_float64_miss_the_same_rays(engine):
    face = freeform("biconic", 1 / 8, -1.0, 1 / 9, 0.2)
    rays = start(*bundle(400, 9.0, 0.5))
    end, single = (
        trace_surfaces([to(face, dtype=d)], to(rays, dtype=d), indices=[scalar(1.0).to(d), scalar(1.5).to(d)])
        for d in (torch.float64, torch.float32)
    )
    assert 20 < int((~end.valid).sum()) < 380
    assert torch.equal(end.valid, single.valid)
    assert_close(single.position.double(), end.position, rtol=0, atol=2e-4)

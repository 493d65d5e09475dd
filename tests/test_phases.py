"""Phases: every kind's gradient is that of its path, light keeps Malus' law, and known lenses focus where they must."""

import dataclasses
import math

import pytest
import torch
from bends import real
from differences import gradcheck, gradgradcheck

import raytrace as rt
from raytrace.maths.bivariate import fringe_to_powers, polynomial_xy, powers
from raytrace.maths.zernike import fringe
from raytrace.system.phases import added_path, power_of
from raytrace.system.rays import start
from raytrace.system.surface import Surface
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import axial_path, trace_lens, trace_surfaces

WAVELENGTH = torch.tensor(0.55, dtype=torch.float64)


def some(count: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) * 2 - 1


PHASES = {
    "grating": rt.system.Grating(real(0.3), real(-1.0)),
    "radial": rt.system.RadialPhase(300 * some(3), real(5.0), real(1.0)),
    "polynomial": rt.system.PolynomialPhase(300 * some(9), real(4.0), real(-1.0)),
    "fringe": rt.system.FringePhase(20 * some(37), real(6.0), real(1.0)),
    "hologram": rt.system.Hologram(real([1.0, 2.0, -50.0]), real([0.0, -3.0, 80.0]), real(0.6328), real(1.0)),
}


@pytest.mark.parametrize("name", PHASES)
def test_the_gradient_is_that_of_the_path(name):
    x, y = (4 * some(40, 1)).requires_grad_(), (4 * some(40, 2)).requires_grad_()
    found = added_path(PHASES[name], x, y, WAVELENGTH)
    by_x, by_y = torch.autograd.grad(found.path.sum(), (x, y), allow_unused=True)
    scale = found.y.abs().max()
    assert (found.x - (0 if by_x is None else by_x)).abs().max() < 1e-12 * scale
    assert (found.y - by_y).abs().max() < 1e-12 * scale


def test_the_path_at_the_vertex_is_the_constant_of_the_terms():
    """Of the fringe terms 1, 2ρ² - 1, …: one wave of piston is a path of one wavelength; of all other kinds 0."""
    for name, phase in PHASES.items():
        found = float(added_path(phase, real(0.0), real(0.0), WAVELENGTH).path)
        signs = {1: 1, 4: -1, 9: 1, 16: -1, 25: 1, 36: -1, 37: 1}
        terms = sum(sign * float(phase.coefficients[k - 1]) for k, sign in signs.items()) if name == "fringe" else 0.0
        assert abs(found - terms * 0.55e-3) < 1e-15, name


@pytest.mark.parametrize("engine", ["eager", "compiled"])
def test_a_wave_of_piston_is_a_wave_of_path_with_its_derivative(engine):
    """Zernike's first fringe term: λ times the order, along every ray, in both engines."""

    def path(piston):
        phase = rt.system.FringePhase(torch.stack([piston, *real([0.0, 0.3, 0.2]).unbind()]), real(6.0), real(2.0))
        surfaces = [Surface(real(5.0), phase=phase), Surface(real(0.0))]
        x = torch.linspace(-3, 3, 4096, dtype=torch.float64)
        rays = start(torch.stack([x, 0.1 * x, 0 * x]), torch.stack([0 * x, 0 * x, 1 + 0 * x]), 0 * x)
        with rt.tracing.trace_engine(engine):
            return trace_surfaces(surfaces, rays, indices=[real(1.0)] * 3, wavelength=WAVELENGTH).opl

    piston = real(1.0).requires_grad_()
    found = path(piston)
    assert ((found - path(real(0.0))).detach() - 2 * 0.55e-3).abs().max() < 1e-15  # mm
    (slope,) = torch.autograd.grad(found.mean(), piston)
    assert abs(float(slope) - 2 * 0.55e-3) < 1e-15


@pytest.mark.parametrize("name", PHASES)
def test_the_power_is_the_bend_of_the_path_at_the_vertex(name):
    def path(at):
        return added_path(PHASES[name], at[0], at[1], WAVELENGTH).path

    bend = torch.autograd.functional.hessian(path, torch.zeros(2, dtype=torch.float64))
    for axis, power in enumerate(power_of(PHASES[name], WAVELENGTH)):
        assert abs(float(power) + float(bend[axis, axis])) < 1e-12 * (1 + float(bend.abs().max()))


def test_fringe_terms_in_their_usual_order():
    """1, ρ cos φ, ρ sin φ, 2ρ² - 1, ρ² cos 2φ, …, 6ρ⁴ - 6ρ² + 1 as term 9; and 37 the pure 12th order."""
    assert [fringe(k) for k in range(1, 11)] == [
        (0, 0), (1, 1), (1, -1), (2, 0), (2, 2), (2, -2), (3, 1), (3, -1), (4, 0), (3, 3)
    ]  # fmt: skip
    assert (fringe(36), fringe(37)) == ((10, 0), (12, 0))
    x, y = some(20, 3), some(20, 4)
    rho, phi = torch.hypot(x, y), torch.atan2(y, x)
    for number in range(1, 38):
        n, m = fringe(number)
        expected = sum(
            (-1) ** s
            * math.factorial(n - s)
            / (math.factorial(s) * math.factorial((n + abs(m)) // 2 - s) * math.factorial((n - abs(m)) // 2 - s))
            * rho ** (n - 2 * s)
            for s in range((n - abs(m)) // 2 + 1)
        ) * (torch.cos(m * phi) if m >= 0 else torch.sin(-m * phi))
        terms = torch.zeros(37, dtype=torch.float64)
        terms[number - 1] = 1.0
        matrix, constants = map(real, fringe_to_powers(37))
        found = polynomial_xy(matrix @ terms, x, y).z + constants @ terms
        assert (found - expected).abs().max() < 1e-10, number


def test_polynomials_in_their_order_with_exact_derivatives():
    assert powers(9) == [(1, 0), (0, 1), (2, 0), (1, 1), (0, 2), (3, 0), (2, 1), (1, 2), (0, 3)]
    c, x, y = some(14), some(8, 5), some(8, 6)
    found = polynomial_xy(c, x, y)
    assert (found.z - sum(a * x**i * y**j for a, (i, j) in zip(c, powers(14), strict=True))).abs().max() < 1e-14

    def at(x, y):
        return polynomial_xy(c, x, y).z.sum()

    x, y = x.requires_grad_(), y.requires_grad_()
    slopes = torch.autograd.grad(at(x, y), (x, y), create_graph=True)
    xx, xy = torch.autograd.grad(slopes[0].sum(), (x, y), retain_graph=True)
    yy = torch.autograd.grad(slopes[1].sum(), y)[0]
    for got, expected in zip(found[1:], (*slopes, xx, xy, yy), strict=True):
        assert (got - expected).abs().max() < 1e-13


def plane_wave(count: int = 12, size: float = 4.0, slope: float = 0.05):
    grid = torch.linspace(-size, size, count, dtype=torch.float64)
    x, y = (axis.flatten() for axis in torch.meshgrid(grid, grid, indexing="xy"))
    direction = real([[0.02], [slope], [1.0]]) * torch.ones(3, count * count, dtype=torch.float64)
    direction = direction / torch.linalg.vector_norm(direction[:, 0])
    position = torch.stack([x, y, torch.zeros_like(x)])
    return start(position, direction, (direction * position).sum(0))


@pytest.mark.parametrize("name", PHASES)
@pytest.mark.parametrize("mirror", [False, True])
def test_malus_law(name, mirror):
    """Behind a phase rays stay normal to surfaces of equal path: ∂(path)/∂(start) = n d · ∂P/∂(start)."""
    glass = rt.materials.MIRROR if mirror else rt.materials.AIR
    surfaces = [
        Surface(thickness=real(-9.0 if mirror else 9.0), curvature=real(0.02), phase=PHASES[name], glass=glass),
        Surface(thickness=real(0.0)),
    ]
    n = [real(1.0), real(1.0 if mirror else 1.5), real(1.0 if mirror else 1.5)]
    begun = plane_wave(size=2.0)
    position = begun.position.clone().requires_grad_()
    rays = start(position, begun.direction, (begun.direction * position).sum(0))
    end = trace_surfaces(surfaces, rays, indices=n, wavelength=WAVELENGTH)
    path = end.opl + axial_path(surfaces, n)
    assert end.valid.float().mean() > 0.9
    by_path = torch.autograd.grad(path[end.valid].sum(), position, retain_graph=True)[0][:2]
    total = torch.zeros_like(by_path)
    for axis in range(3):
        weight = (n[-1] * end.direction[axis]).detach()[end.valid]
        total = (
            total
            + torch.autograd.grad((end.position[axis][end.valid] * weight).sum(), position, retain_graph=True)[0][:2]
        )
    assert (by_path - total)[:, end.valid].abs().max() < 1e-12


def lens_of(phase, *, object_distance: float, image: float, field: float = 0.0) -> rt.Lens:
    row = dict(radius=math.inf, thickness=image, phase=phase)
    return rt.lens(
        [row], stop=1, entrance_pupil_diameter=20, object_distance=object_distance, fields=[field], wavelengths=[0.55]
    )


@pytest.mark.parametrize(
    ("distance", "field"), [(math.inf, 0.0), (math.inf, 20.0), (75.0, 0.0), (75.0, 15.0), (200.0, -40.0)]
)
def test_an_ideal_lens_has_no_aberrations_at_its_conjugate(distance, field):
    image = 50.0 if math.isinf(distance) else 1 / (1 / 50 - 1 / distance)
    lens = lens_of(rt.system.IdealLens(0.02, 0.02), object_distance=distance, image=image, field=field)
    assert abs(float(rt.first_order(lens).effective_focal_length) - 50) < 1e-12
    spot = rt.spot(lens)
    assert float(spot.rms_radius.max()) < 1e-11
    opd = rt.wavefront(lens)
    assert float(opd.rms.abs().max()) < 1e-7  # waves


def test_a_diffractive_lens_focuses_by_its_wavelength():
    """A₁ = -π R²/(λ f): at another wavelength the focal length goes with 1/λ."""
    a1 = -math.pi * 25 / (0.55e-3 * 100)
    lens = lens_of(rt.system.RadialPhase([a1], 5.0, 1.0), object_distance=math.inf, image=100.0)
    assert abs(float(rt.first_order(lens).effective_focal_length) - 100) < 1e-10
    other = rt.first_order(lens, real(0.5))
    assert abs(float(other.effective_focal_length) - 110) < 1e-10


def test_facets_bend_as_the_surface_above_the_plane():
    ball = Surface(
        thickness=real(20.0), curvature=real(1 / 40), conic=real(-1.0), glass=rt.materials.find_glass("N-BK7")
    )
    flat = dataclasses.replace(ball, phase=rt.system.Facets())
    n, rays = [real(1.0), real(1.5), real(1.5)], plane_wave(slope=0.0)
    image = Surface(thickness=real(0.0))
    curved = trace_surfaces([ball], rays, indices=n[:2])
    faceted = trace_surfaces([flat], rays, indices=n[:2])
    assert float(faceted.position[2].abs().max()) == 0
    # A parabola has the same slope along its axis: rays along it are bent alike, from the plane.
    along = start(rays.position, real([[0.0], [0.0], [1.0]]).expand(3, 144), real(0.0))
    curved, faceted = (trace_surfaces([s], along, indices=n[:2]) for s in (ball, flat))
    assert (curved.direction - faceted.direction).abs().max() < 1e-14
    end = trace_surfaces([flat, image], along, indices=n)
    assert end.valid.all()


@pytest.mark.parametrize("engine", ["eager", "compiled"])
@pytest.mark.parametrize("index", [(1.0, 1.5), (1.5, 1.0)])
def test_beyond_the_edge_of_its_conic_a_fresnel_lens_loses_light_and_has_no_derivative(engine, index, monkeypatch):
    monkeypatch.setenv("RAYTRACE_TRACE", engine)
    x = torch.tensor([1.0, 10.5, 40.0], dtype=torch.float64, requires_grad=True)
    curvature, conic = (torch.tensor(n, dtype=torch.float64, requires_grad=True) for n in (0.1, 0.0))
    flat = Surface(
        thickness=real(5.0),
        curvature=curvature,
        conic=conic,
        phase=rt.system.Facets(),
        glass=rt.materials.find_glass("N-BK7"),
    )
    zero = torch.zeros_like(x)
    rays = start(torch.stack([x, zero, zero]), torch.stack([zero, zero, zero + 1]), real(0.0))
    n = [*map(real, index), real(index[1])]
    end = trace_surfaces([flat, Surface(thickness=real(0.0))], rays, indices=n)
    assert end.valid.tolist() == [True, False, False]
    by_x, *others = torch.autograd.grad(end.position[0].sum() + end.opl.sum(), [x, curvature, conic])
    assert by_x[1:].tolist() == [0.0, 0.0]
    assert all(torch.isfinite(one).all() for one in (by_x, *others))
    alone = trace_surfaces([flat, Surface(thickness=real(0.0))], rays_of(rays, 1), indices=n)
    again = torch.autograd.grad(alone.position[0].sum() + alone.opl.sum(), [curvature, conic])
    assert [float(one) for one in others] == pytest.approx([float(one) for one in again], rel=1e-12)


def rays_of(rays, count):
    """The first rays alone."""
    return start(rays.position[:, :count].detach(), rays.direction[:, :count], real(0.0))


@pytest.mark.parametrize("engine", ["eager", "compiled"])
def test_facets_of_a_mirror_reflect_as_the_mirror_above_the_plane(engine, monkeypatch):
    """A parabola in facets: light along the axis crosses it at half the radius, 20 mm, less what the plane is lower."""
    monkeypatch.setenv("RAYTRACE_TRACE", engine)
    bowl = Surface(
        thickness=real(0.0),
        curvature=real(-1 / 40),
        conic=real(-1.0),
        glass=rt.materials.MIRROR,
        phase=rt.system.Facets(),
    )
    height = torch.linspace(1.0, 10.0, 32, dtype=torch.float64)
    zero = torch.zeros_like(height)
    rays = start(torch.stack([zero, height, zero]), torch.stack([zero, zero, zero + 1]), real(0.0))
    end = trace_surfaces([bowl], rays, indices=[real(1.0), real(1.0)])
    assert end.valid.all()
    assert (end.direction[2] < 0).all()
    assert end.direction[1] / end.direction[2] == pytest.approx(height / (20 - height**2 / 80), rel=1e-12)


@pytest.mark.parametrize("name", PHASES)
def test_derivatives_by_every_number_of_a_phase(name):
    rays, phase = plane_wave(count=4, size=2.0), PHASES[name]
    index = [real(1.0), real(1.5), real(1.5)]
    numbers = [getattr(phase, field.name) for field in dataclasses.fields(phase)]
    leaves = [(number * (0.05 if name == "fringe" else 1)).clone().requires_grad_() for number in numbers]

    def trace(*leaves):
        surface = Surface(thickness=real(5.0), curvature=real(0.01), phase=type(phase)(*leaves))
        surfaces = [surface, Surface(thickness=real(0.0))]
        end = trace_surfaces(surfaces, rays, indices=index, wavelength=WAVELENGTH)
        return end.position[:2], end.opl

    assert gradcheck(trace, leaves, atol=1e-5)
    assert gradgradcheck(lambda *n: trace(*n)[0][:, 3], leaves, atol=1e-4, fast_mode=True)


@pytest.mark.parametrize("engine", ["eager", "compiled"])
def test_the_path_of_an_ideal_lens_is_smooth_in_both_powers(engine):
    """By one power alone, at equal ones, a derivative is that of differences: the path has no jump there."""

    def total(power_x, power_y):
        lens = lens_of(rt.system.IdealLens(power_x, power_y), object_distance=80.0, image=60.0, field=3.0)
        rays = launch(lens, points.expand(2, -1))
        with rt.tracing.trace_engine(engine):
            return trace_lens(lens, rays, lens.wavelengths[:, None]).opl.sum()

    points = rt.maths.gauss_rings(4, dtype=torch.float64)[0].repeat(1, 100)  # as many as the compiled trace is worth
    powers = [torch.tensor(0.02, dtype=torch.float64, requires_grad=True) for _ in range(2)]
    found = torch.autograd.grad(total(*powers), powers)
    step = 1e-6
    for k, derivative in enumerate(found):
        ends = [total(*(p.detach() + sign * step * (j == k) for j, p in enumerate(powers))) for sign in (1, -1)]
        assert float(derivative) == pytest.approx(float(ends[0] - ends[1]) / (2 * step), rel=1e-6)

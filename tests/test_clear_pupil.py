"""The clear pupil: areas known exactly, edges that move as they must, gaps."""

import math

import numpy as np
import pytest
import torch
from problems import double_gauss, lens, number, scalar, surface, vector

from raytrace.psf_models.drt import trace_clearances
from raytrace.system.surface import Aperture
from raytrace.tracing import clear_pupil as clear_pupil_module
from raytrace.tracing.clear_pupil import Arms, Edges, Kinks, arms_of
from raytrace.tracing.scene import Scene, scene

RADIUS = 5.0  # of the entrance pupil, mm
EDGE = 1e-10  # two Newton steps from an edge enclosed in 1/2048, the slope good to 1/2048 of the radius


def window(*apertures: Aperture, diameter=2 * RADIUS) -> Scene:
    """Apertures in the entrance pupil of a thin lens: the clear pupil is what they leave of the disc."""
    flat = lens(
        [surface(None, 1.0, apertures=apertures), surface(0.01, 2.0, 1.5), surface(None, 100.0)],
        aperture=("entrance_pupil_diameter", diameter),
    )
    return scene(flat, vector(0.0, 0.0)[:, None], vector(math.inf), vector(0.55))


def area(result: Scene, count: int = 256) -> torch.Tensor:
    return arms_of(result, count).rule(3)[1].sum()


@pytest.mark.parametrize(
    ("apertures", "expected", "allowed"),
    [
        ([Aperture("circular", (0.0, 4.0))], 0.64, EDGE),
        ([Aperture("circular", (1.0, 4.0))], 0.64 - 0.04, EDGE),
        ([Aperture("circular", (0.0, 3.0), False, (0.5, 1.0))], 0.36, EDGE),
        ([Aperture("circular", (0.0, 2.0), True, (0.5, 1.0))], 1 - 0.16, EDGE),
        ([Aperture("elliptic", (4.0, 2.0))], 0.32, 1e-9),
        # Corners, and arms tangent to a disc, leave the trapezoidal rule its step squared, or that to the power 3/2.
        ([Aperture("rectangular", (3.0, 2.0))], 24 / (25 * math.pi), 1e-4),
        ([Aperture("circular", (0.0, 1.0), True, (1.5, 2.0))], 1 - 0.04, 1e-4),
        (
            [Aperture("circular", (0.0, 0.5), True, (x, y)) for x, y in ((1.5, 1.5), (2.7, 2.7))],
            1 - 2 * 0.01,
            3e-4,
        ),
        # A vane that reaches beyond the pupil, so that some arms are blocked as a whole.
        ([Aperture("rectangular", (0.4, 5.5), True)], 1 - 2 / math.pi * (0.08 * 0.9936**0.5 + math.asin(0.08)), 1e-6),
    ],
)
def test_area_of_the_clear_pupil(apertures, expected, allowed):
    assert float(area(window(*apertures))) == pytest.approx(expected, abs=allowed)


def test_a_vane_takes_its_share_of_the_aberrations():
    """ρ⁴ over the disc without a strip |x| < b, integrated over the width of the strip: edges are steep beside it."""
    half = 0.08
    points, weights = arms_of(window(Aperture("rectangular", (RADIUS * half, 1.1 * RADIUS), True)), 48).rule(12)
    nodes, shares = (number(part) for part in np.polynomial.legendre.leggauss(12))
    x = 0.5 * half * (nodes + 1)
    h = torch.sqrt(1 - x**2)
    strip = 4 / math.pi * (0.5 * half * shares * (x**4 * h + 2 / 3 * x**2 * h**3 + h**5 / 5)).sum()
    found = (weights * points.square().sum(0) ** 2).sum()
    assert found.item() == pytest.approx(1 / 3 - strip.item(), rel=1e-6)


def test_the_area_moves_with_the_corners_to_second_order():
    """A slit of half width b: A = 2/π (b √(1 - b²) + asin b), the angles of whose corners move."""
    b = scalar(0.6).requires_grad_()
    found = area(window(Aperture("rectangular", (9.0, RADIUS * b))), 32)
    first = torch.autograd.grad(found, b, create_graph=True)[0]
    second = torch.autograd.grad(first, b)[0]
    assert found.item() == pytest.approx(2 / math.pi * (0.6 * 0.8 + math.asin(0.6)), abs=1e-9)
    assert first.item() == pytest.approx(4 / math.pi * 0.8, rel=1e-6)
    assert second.item() == pytest.approx(-4 / math.pi * 0.6 / 0.8, rel=2e-3)  # the slope is good to 1/2048


def test_a_clear_pupil_is_whole_and_a_blocked_one_dark():
    whole = arms_of(window(), 8)
    assert whole.inner.shape == whole.outer.shape == (1, 1, 1, 8)
    assert bool((whole.inner == 0).all())
    assert float((whole.outer - 1).abs().max()) < 1e-15
    dark = arms_of(window(Aperture("circular", (0.0, 9.0), True)), 8)
    assert bool((dark.inner == 0).all() and (dark.outer == 0).all())


@pytest.mark.parametrize("radius", [0.02, 0.5, 3.0])
def test_edge_is_where_rays_begin_to_miss_a_surface(radius):
    """A sphere of a radius below that of the pupil; the share of a narrow edge is no smaller than the light's."""
    ball = lens([surface(1 / radius, 100.0, 1.5)], aperture=("entrance_pupil_diameter", 2 * RADIUS))
    arms = arms_of(scene(ball, vector(0.0, 0.0)[:, None], vector(math.inf), vector(0.55)), 8)
    assert float((arms.outer - radius / RADIUS).abs().max()) < 1e-6


def test_edge_is_where_the_ray_grazes_the_aperture():
    glass = double_gauss()
    result = scene(
        glass.replace(6, apertures=(Aperture("circular", (0.0, 9.0)),)),
        vector(0.0, 3.0)[:, None],
        vector(1e4),
        vector(0.53),
    )
    arms = arms_of(result, 12)
    ends = arms.origin[..., None] + arms.outer * arms.unit
    _, (clearance, *_) = trace_clearances(result, ends)
    assert float((ends * ends).sum(0).max()) < 1
    assert float(clearance.abs().max()) < 1e-10


@pytest.mark.slow
def test_edges_move_with_the_pupil_to_second_order():
    """Of an opening of radius b the share b²/R² is clear: derivatives -2 b²/R³ and 6 b²/R⁴ by the pupil radius R."""
    opening = Aperture("circular", (0.0, 3.0), False, (0.5, 0.5))

    def share(radius):
        return area(window(opening, diameter=2 * radius), 64)

    radius = scalar(RADIUS)
    assert float(torch.func.grad(share)(radius)) == pytest.approx(-2 * 9 / RADIUS**3, rel=1e-6)
    assert float(torch.func.jacfwd(share)(radius)) == pytest.approx(-2 * 9 / RADIUS**3, rel=1e-6)
    second = torch.autograd.functional.hessian(share, radius)
    assert float(second) == pytest.approx(6 * 9 / RADIUS**4, rel=1e-3)


def test_edges_of_any_shape_move():
    """The clear share of a rectangle falls as 1/R²: its derivative is -2/R of itself."""

    def share(radius):
        return area(window(Aperture("rectangular", (3.0, 2.0)), diameter=2 * radius), 64)

    radius = scalar(RADIUS).requires_grad_()
    whole = share(radius)
    (slope,) = torch.autograd.grad(whole, radius)
    assert float(slope) == pytest.approx(-2 / RADIUS * float(whole.detach()), rel=1e-6)


def test_rings_integrate_odd_powers_between_arms_of_unlike_length():
    """∫ r³ over a disc that touches the middle: powers of r in opposite arms do not cancel there."""
    angle = (torch.arange(64, dtype=torch.float64) + 0.5) * (2 * math.pi / 64)
    unit = torch.stack([torch.cos(angle), torch.sin(angle)])[:, None, None, None]
    outer = (2 * 0.4 * unit[0]).clamp_min(0.0)
    share = torch.full_like(outer, 1 / 64)
    radius, none = torch.stack([torch.zeros_like(outer), outer]), outer[..., :0]
    edges = Edges(radius, torch.zeros_like(radius, dtype=torch.int64), torch.zeros_like(radius), outer > 0)
    kinks = Kinks(none, none, edges.number[..., :0], 64)
    arms = Arms(torch.zeros(2, 1, 1, 1, dtype=torch.float64), unit, share, *radius, 0, edges, kinks)
    points, weights = arms.rule(4)
    # (1/π) ∫ (2 a cos θ)⁵/5 dθ over the right half, ∫ cos⁵ = 16/15.
    expected = 0.8**5 / 5 * (16 / 15) / math.pi
    assert float((weights * points.square().sum(0) ** 1.5).sum()) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("apertures", [[], [Aperture("circular", (0.0, 1.0), True, (0.0, 2.0))]])
def test_rays_are_counted(monkeypatch, apertures):
    traced = []

    def counting(trace):
        def count(result, pupil):
            traced.append(pupil.shape[-1])
            return trace(result, pupil)

        return count

    for name in ("trace_apertures", "trace_scene"):
        plain = getattr(clear_pupil_module, name)
        monkeypatch.setattr(f"raytrace.tracing.clear_pupil.{name}", counting(plain))
    arms = arms_of(window(Aperture("circular", (0.0, 3.0), False, (2.0, 2.0)), *apertures), 16)
    assert sum(traced) == arms.rays
    assert arms.outer.shape[-1] == (32 if apertures else arms.unit.shape[-1])


def test_edges_of_convex_apertures_take_few_rays():
    """A scan of eight steps, and three rays a round: two rounds enclose a smooth edge in 2⁻¹¹ of its arm."""
    arms = arms_of(window(Aperture("circular", (0.0, 3.0), False, (2.0, 2.0))), 48)
    assert arms.rays < 30 * (64 + arms.unit.shape[-1])

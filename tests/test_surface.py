"""Surface: sag, normal, intersection and clear aperture, each by its law."""

import math

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import FEMTOMETRE, surface, turned, vector

from raytrace.system.apertures import Aperture, inside
from raytrace.system.intersection import intersect, normal
from raytrace.system.surface import sag

KINDS = {
    "plane": surface(),
    "plane with a curvature of 0": surface(0.0),
    "sphere": surface(0.05),
    "concave sphere": surface(-0.05),
    "ellipsoid": surface(0.05, conic=-0.5),
    "oblate ellipsoid": surface(0.05, conic=2.0),
    "paraboloid": surface(0.05, conic=-1.0),
    "hyperboloid": surface(-0.05, conic=-3.0),
    "almost a plane": surface(1e-200, conic=1e9),
    "asphere": surface(0.05, conic=-1.0, coefficients=[1e-3, -2e-5, 1e-7], semi_diameter=10.0),
    "asphere on a plane": surface(None, coefficients=[0.0, 2e-5], semi_diameter=10.0),
}
each_kind = pytest.mark.parametrize("shape", KINDS.values(), ids=KINDS.keys())


def rays(count: int = 60):
    """Rays at up to 40° through points up to 9 mm off the axis, from before and behind the vertex, both ways."""
    generator = torch.Generator().manual_seed(6)
    position = torch.rand(3, count, generator=generator, dtype=torch.float64) * 12 - 6
    direction = torch.randn(3, count, generator=generator, dtype=torch.float64) * 0.3
    direction[2] = torch.where(torch.arange(count) % 2 == 0, 1.0, -1.0)
    return position, direction / torch.linalg.vector_norm(direction, dim=0)


@each_kind
def test_hit_lies_on_the_surface_and_on_the_ray(shape):
    position, direction = rays()
    hit, met = intersect(shape, position, direction)
    assert met.float().mean() > 0.9
    assert (hit[2] - sag(shape, hit[0] ** 2 + hit[1] ** 2))[met].abs().max() <= 20 * FEMTOMETRE
    across = torch.linalg.cross(hit - position, direction, dim=0)
    assert across[:, met].abs().max() <= 20 * FEMTOMETRE


@each_kind
def test_normal_is_the_gradient_of_the_sag(shape):
    """n ∝ (-∂z/∂x, -∂z/∂y, 1), and its squared length is as returned."""
    x = vector(0.0, 1.0, -3.0, 5.0).requires_grad_()
    y = vector(0.0, 2.0, 1.0, -5.0).requires_grad_()
    z = sag(shape, x * x + y * y)
    slopes = torch.autograd.grad(z.sum(), (x, y)) if z.requires_grad else (torch.zeros(4), torch.zeros(4))
    n, norm_squared = normal(shape, (x.detach(), y.detach(), z.detach()))
    n = torch.stack(torch.broadcast_tensors(*n))
    assert (n[0] / n[2] + slopes[0]).abs().max() <= 1e-14
    assert (n[1] / n[2] + slopes[1]).abs().max() <= 1e-14
    assert ((n * n).sum(0) - norm_squared).abs().max() <= 1e-14
    assert (n[2] > 0).all()


@each_kind
def test_crossing_is_in_the_direction_of_propagation(shape):
    """The normal (n_z > 0) looks along the ray's own z direction, whichever way it travels."""
    position, direction = rays()
    hit, met = intersect(shape, position, direction)
    n = torch.stack(torch.broadcast_tensors(*normal(shape, hit)[0]))
    assert ((n * direction).sum(0) * direction[2] > 0)[met].all()


@each_kind
def test_origin_may_slide_along_the_ray(shape):
    position, direction = rays()
    hit, met = intersect(shape, position, direction)
    for distance, tolerance in ((7.0, 50), (-1e3, 1e3), (1e6, 1e6)):
        other, met_there = intersect(shape, position + distance * direction, direction)
        assert torch.equal(met, met_there)
        # The start itself is rounded: 2⁻⁵³ of its distance.
        assert (other - hit)[:, met].abs().max() <= tolerance * 1e-15 * 20


@each_kind
def test_surface_turned_about_z_is_the_same(shape):
    position, direction = rays()
    hit, _ = intersect(shape, position, direction)

    assert torch.equal(intersect(shape, turned(position), turned(direction))[0], turned(hit))


@each_kind
def test_ray_reversed_meets_the_mirrored_surface(shape):
    """z → -z turns curvature and terms round: the same hit, mirrored."""
    position, direction = rays()
    hit, met = intersect(shape, position, direction)

    def opposite(x):
        return None if x is None else -x

    mirrored = surface(
        opposite(shape.curvature),
        conic=shape.conic,
        coefficients=opposite(shape.coefficients),
        semi_diameter=shape.semi_diameter,
    )
    flip = vector(1.0, 1.0, -1.0)[:, None]
    other, met_there = intersect(mirrored, position * flip, direction * flip)
    assert torch.equal(met, met_there)
    assert (other * flip - hit)[:, met].abs().max() <= 5 * FEMTOMETRE


@pytest.mark.parametrize("kind", ["sphere", "ellipsoid", "paraboloid", "plane with a curvature of 0", "hyperboloid"])
def test_derivatives_of_a_conic_with_rays_that_miss(kind):
    shape = KINDS[kind]
    position = vector(1.0, 3.0, 400.0).expand(3, 3).clone()
    position = torch.stack([vector(1.0, 3.0, 400.0), vector(0.5, -2.0, 300.0), vector(-4.0, 1.0, 0.0)])
    direction = torch.stack([vector(0.1, -0.2, 0.0), vector(0.0, 0.3, 0.0), vector(1.0, 1.0, 1.0)])
    c = shape.curvature.clone().requires_grad_()
    k = (torch.zeros(()).double() if shape.conic is None else shape.conic.clone()).requires_grad_()

    def hits(c, k, position, direction):
        unit = direction / torch.sqrt((direction * direction).sum(0))
        return intersect(surface(c, conic=k), position, unit)[0][:, :2]

    arguments = (c, k, position.requires_grad_(), direction.requires_grad_())
    assert gradcheck(hits, arguments)
    assert gradgradcheck(hits, arguments)
    hit, met = intersect(surface(c, conic=k), position, direction / torch.sqrt((direction * direction).sum(0)))
    gradients = torch.autograd.grad(hit.sum(), arguments)
    assert all(torch.isfinite(gradient).all() for gradient in gradients)
    if not met[2]:
        assert (gradients[2][:, 2] == 0).all()


def test_all_rays_missing_give_zero_gradients():
    c = vector(0.1)[0].requires_grad_()
    k = vector(0.5)[0].requires_grad_()
    position = torch.stack([vector(20.0, 1e9), vector(0.0, 3.0), vector(0.0, 0.0)]).requires_grad_()
    direction = torch.stack([vector(0.0, 0.0), vector(0.0, 0.0), vector(1.0, -1.0)]).requires_grad_()
    hit, met = intersect(surface(c, conic=k), position, direction)
    assert not met.any()
    assert (hit == 0).all()
    for gradient in torch.autograd.grad(hit.sum(), (c, k, position, direction), allow_unused=True):
        assert gradient is None or (gradient == 0).all()


@pytest.mark.parametrize("tilt", [1e-200, 1e-310, 0.0])
def test_a_ray_along_a_plane_misses_it_or_meets_it_at_a_finite_point(tilt):
    position = vector(0.0, 0.0, -1.0)[:, None].requires_grad_()
    hit, met = intersect(surface(), position, vector(1.0, 0.0, tilt)[:, None])
    assert torch.isfinite(hit).all()
    assert not (met and tilt < 1e-300)
    assert torch.isfinite(torch.autograd.grad(hit.sum(), position)[0]).all()


def test_plane_and_zero_curvature_are_the_same_surface():
    position, direction = rays()
    plane, flat = intersect(surface(), position, direction)[0], intersect(surface(0.0), position, direction)[0]
    assert (plane - flat).abs().max() <= 5 * FEMTOMETRE


@pytest.mark.parametrize("lenses", [2, 3, 4])
@pytest.mark.parametrize("shape", [{"conic": -0.3}, {}, {"conic": -0.3, "coefficients": [1e-4, 1e-6]}], ids=str)
def test_population_of_surfaces_meets_rays_of_fewer_axes(lenses, shape):
    """Curvatures (lenses, 1) against rays (3, P): three lenses must not be taken for three components."""
    position, direction = rays(7)
    curvatures = torch.linspace(0.01, 0.05, lenses, dtype=torch.float64)
    hit, met = intersect(surface(curvatures[:, None], **shape), position, direction)
    assert hit.shape == (3, lenses, 7)
    for i, c in enumerate(curvatures):
        alone, met_alone = intersect(surface(c, **shape), position, direction)
        assert torch.equal(hit[:, i], alone)
        assert torch.equal(met[i], met_alone)


class TestAperture:
    POINTS = torch.stack([vector(0.0, 3.0, 5.0, 5.1, 0.0), vector(0.0, 0.0, 0.0, 0.0, 2.0), torch.zeros(5).double()])

    def clear(self, *apertures):
        return inside(apertures, self.POINTS).tolist()

    def test_none_clips_nothing(self):
        assert inside(surface(semi_diameter=0.1).apertures, self.POINTS) is None

    def test_circle_and_ring_keep_their_edges(self):
        assert self.clear(Aperture("circular", (0.0, 5.0))) == [True, True, True, False, True]
        assert self.clear(Aperture("circular", (2.0, 5.0))) == [False, True, True, False, True]

    def test_obscuration_blocks_its_inside_and_not_its_edge(self):
        assert self.clear(Aperture("circular", (0.0, 5.0), obscures=True)) == [False, False, True, True, False]
        assert self.clear(Aperture("circular", (2.0, 5.0), obscures=True)) == [True, False, True, True, True]

    def test_rectangle_and_ellipse(self):
        assert self.clear(Aperture("rectangular", (5.0, 1.0))) == [True, True, True, False, False]
        assert self.clear(Aperture("elliptic", (5.0, 2.0))) == [True, True, True, False, True]
        assert self.clear(Aperture("rectangular", (5.0, 2.0), obscures=True)) == [False, False, True, True, True]

    def test_decentred(self):
        assert self.clear(Aperture("circular", (0.0, 1.0), centre=(4.0, 0.0))) == [False, True, True, False, False]

    def test_several_must_all_pass(self):
        ring = Aperture("circular", (0.0, 5.0)), Aperture("circular", (0.0, 3.0), obscures=True)
        assert self.clear(*ring) == [False, True, True, False, False]


def test_sag_beyond_the_edge_is_finite():
    beyond = vector(401.0, 1e6).requires_grad_()
    z = sag(surface(0.05), beyond)
    assert torch.isfinite(z).all()
    assert torch.isfinite(torch.autograd.grad(z.sum(), beyond)[0]).all()


def test_half_sphere_at_its_edge():
    hit, met = intersect(surface(0.1), vector(10.0 * math.sin(1.5), 0.0, -5.0)[:, None], vector(0.0, 0.0, 1.0)[:, None])
    assert met.all()
    assert abs(hit[2].item() - 10 * (1 - math.cos(1.5))) <= 1e-13


def test_radius_is_that_of_the_curvature_and_infinite_of_a_plane():
    assert surface(0.05).radius == 20
    assert surface(-0.05).radius == -20
    assert surface().radius == surface(0.0).radius == math.inf

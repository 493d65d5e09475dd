"""Sag terms from a conic: the spline and Zernike sags, rays through them, derivatives, and who must know of them."""

import dataclasses
import math

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import lens, points, surface, vector

from raytrace.io import read_lens, write_lens
from raytrace.io.source import LensFileError
from raytrace.maths import zernike
from raytrace.maths.numerics import to
from raytrace.maths.sampling import grid
from raytrace.psf_models import model_of, psf
from raytrace.system.intersection import intersect, normal
from raytrace.system.lens import media
from raytrace.system.rays import start
from raytrace.system.sag_terms import GridSag, Relief, ZernikeSag, about_vertex, relief, spline
from raytrace.system.surface import sag, sag_at
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import scene, symmetry
from raytrace.tracing.trace import steps, trace_lens

RADIUS = vector(4.0)[0]


def oblique(count: int = 40, reach: float = 2.5) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and unit directions of rays that come from everywhere before the vertex plane."""
    direction = torch.cat([points(count, 0.3, seed=1), torch.ones(1, count, dtype=torch.float64)])
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    position = torch.cat([points(count, reach), torch.zeros(1, count, dtype=torch.float64)])
    return position - 20 * direction, direction


def noll(**terms: float) -> ZernikeSag:
    """Coefficients by Noll's number, z4=… mm, over RADIUS."""
    orders = {int(name[1:]): c for name, c in terms.items()}
    return ZernikeSag(vector(*(orders.get(j, 0.0) for j in range(1, max(orders) + 1))), RADIUS)


def even_terms(a2: float, a4: float) -> ZernikeSag:
    """a₂ r² + a₄ r⁴ in Noll's terms: ρ² = (Z₄/√3 + 1)/2 and ρ⁴ = (Z₁₁/√5 + 6 ρ² - 1)/6."""
    square, fourth = a2 * float(RADIUS) ** 2, a4 * float(RADIUS) ** 4
    return noll(z1=square / 2 + fourth / 3, z4=(square + fourth) / 2 / math.sqrt(3), z11=fourth / 6 / math.sqrt(5))


def sampled(function, size: int, width: float = 8.0) -> GridSag:
    pitch = vector(width / size)[0]
    line = (torch.arange(size, dtype=torch.float64) - 0.5 * (size - 1)) * pitch
    return GridSag(function(line[None, :], line[:, None]), pitch)


def wavy(x, y):
    return 0.05 * torch.sin(1.1 * x + 0.3) * torch.cos(0.8 * y) + 0.004 * x * y * y


def bumpy() -> ZernikeSag:
    return noll(z1=0.01, z2=0.02, z3=-0.01, z4=0.01, z5=0.008, z7=0.006, z9=-0.004, z14=0.003)


ALL = {
    "zernike": dataclasses.replace(surface(0.03, 5.0, 1.5, conic=-0.6), sag_terms=bumpy()),
    "zernike on an asphere": dataclasses.replace(surface(0.02, 5.0, 1.5, coefficients=[1e-3, 1e-5]), sag_terms=bumpy()),
    "grid": dataclasses.replace(surface(0.03, 5.0, 1.5), sag_terms=sampled(wavy, 12)),
    "grid on a plane": dataclasses.replace(surface(None, 5.0, 1.5), sag_terms=sampled(wavy, 12)),
}


@pytest.mark.parametrize("sag_terms", [bumpy(), sampled(wavy, 12)], ids=["zernike", "grid"])
def test_slopes_are_the_derivatives_of_the_sag(sag_terms):
    x, y = points(50, 3.0).requires_grad_().unbind()
    found = relief(sag_terms).sag(x, y)
    of_x, of_y = torch.autograd.grad(found.z.sum(), (x, y), create_graph=True)
    of_xx, of_xy = torch.autograd.grad(of_x.sum(), (x, y), retain_graph=True)
    (of_yy,) = torch.autograd.grad(of_y.sum(), y)
    for slope, derived in zip(found[1:], (of_x, of_y, of_xx, of_xy, of_yy), strict=True):
        assert torch.allclose(slope, derived, rtol=1e-11, atol=1e-14)


def test_zernike_sag_is_the_sum_of_the_polynomials():
    """To 1e-14 of the sum also at high orders, where powers of x and y would have lost six digits."""
    x, y = points(200, 2.8)
    coefficients = torch.linspace(-1, 1, 136, dtype=torch.float64)
    orders = [zernike.noll(j) for j in range(1, 137)]
    expected = torch.tensordot(coefficients, zernike.polynomials(orders, x / RADIUS, y / RADIUS), 1)
    found = relief(ZernikeSag(coefficients, RADIUS)).sag(x, y).z
    assert (found - expected).abs().max() < 1e-13 * coefficients.abs().sum()


def test_spline_passes_through_its_heights_and_its_error_falls_with_the_fourth_power_up_to_the_rim():
    x, y = points(2000, 4.0)
    errors = []
    for size in (16, 32, 64):
        sag_terms = sampled(wavy, size)
        line = (torch.arange(size, dtype=torch.float64) - 0.5 * (size - 1)) * sag_terms.pitch
        at = relief(sag_terms).sag(line.expand(size, size), line[:, None].expand(size, size)).z
        assert (at - sag_terms.heights).abs().max() < 1e-15
        errors.append(float((relief(sag_terms).sag(x, y).z - wavy(x, y)).abs().max()))
    assert errors[0] / errors[1] > 10
    assert errors[1] / errors[2] > 12
    assert errors[2] < 4e-6  # mm; near the rim one-sided: 1.3 h⁴ of a fourth derivative of 0.07


def test_cubics_are_splines_exactly():
    def cubic(x, y):
        return 0.01 * x**3 - 0.02 * x * x * y + 0.03 * y**3 + x * y + 0.5

    x, y = points(100, 4.0)
    sag_terms = sampled(cubic, 9)
    assert (relief(sag_terms).sag(x, y).z - cubic(x, y)).abs().max() < 1e-13


def test_large_grids_are_filtered_in_parts_as_in_one_go():
    heights = torch.rand(300, 5, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    small = relief(GridSag(heights[:60], vector(1.0)[0])).numbers[0]
    large = relief(GridSag(heights, vector(1.0)[0])).numbers[0]
    assert (small[:20] - large[:20]).abs().max() < 1e-14  # the far end is 40 points away: (2 - √3)^40
    line = torch.arange(300, dtype=torch.float64) - 149.5
    at = Relief("SplineSag", (large, vector(1.0)[0])).sag(torch.zeros(300, dtype=torch.float64), line).z
    assert (at - heights[:, 2]).abs().max() < 1e-14


def test_rows_are_y_and_columns_x():
    heights = torch.zeros(6, 7, dtype=torch.float64)
    heights[0, 5] = 1.0  # the smallest y, near the largest x
    shape = relief(GridSag(heights, vector(0.5)[0]))
    assert float(shape.sag(vector(1.0), vector(-1.25)).z) == pytest.approx(1.0)
    assert bool(shape.covers(vector(1.74), vector(1.49)))
    assert not bool(shape.covers(vector(1.0), vector(1.51)))


def test_a_spline_found_once_is_the_grid_bit_for_bit_with_its_gradients():
    """Through rays with lost ones: hits, directions, and derivatives by heights and pitch."""
    gradients = []
    for prepared in (lambda grid: grid, spline):
        grid = sampled(wavy, 12)
        inputs = [grid.heights.clone().requires_grad_(), grid.pitch.clone().requires_grad_()]
        face = dataclasses.replace(ALL["grid"], sag_terms=prepared(GridSag(*inputs)))
        found = through(face, start(*oblique()))
        gradients.append((found.detach(), *torch.autograd.grad((found * found.detach().cos()).sum(), inputs)))
    for a, b in zip(*gradients, strict=True):
        assert torch.allclose(a, b, rtol=1e-13, atol=1e-13 * float(a.abs().max()))
    assert torch.equal(gradients[0][0], gradients[1][0])


def test_a_grid_of_three_heights_is_refused():
    with pytest.raises(ValueError, match="3 × 5 heights"):
        relief(GridSag(torch.zeros(3, 5, dtype=torch.float64), RADIUS))


def beyond(front, sag_terms_free, tolerance):
    """Hits, normals and refracted directions of one surface against those of another of the same shape."""
    rays = start(*oblique())
    for one, other in zip(
        *(list(steps([s], rays, indices=vector(1.0, 1.5))) for s in (front, sag_terms_free)), strict=True
    ):
        assert torch.equal(one.rays.valid, other.rays.valid)
        assert (one.rays.position - other.rays.position).abs().max() < tolerance
        assert (one.rays.direction - other.rays.direction).abs().max() < 10 * tolerance
    at = intersect(front, *oblique())[0]
    unit = [torch.stack(normal(s, at)[0]) for s in (front, sag_terms_free)]
    unit = [n / torch.linalg.vector_norm(n, dim=0) for n in unit]
    assert (unit[0] - unit[1]).abs().max() < 10 * tolerance


def test_even_terms_as_sag_terms_are_the_asphere():
    asphere = surface(0.03, 5.0, 1.5, conic=-0.6, coefficients=[2e-3, -3e-5])
    beyond(dataclasses.replace(asphere, coefficients=None, sag_terms=even_terms(2e-3, -3e-5)), asphere, 1e-13)
    flat = surface(None, 5.0, 1.5, coefficients=[2e-3, -3e-5])
    beyond(dataclasses.replace(flat, coefficients=None, sag_terms=even_terms(2e-3, -3e-5)), flat, 1e-13)


def test_even_terms_on_a_grid_are_the_asphere_but_for_the_error_of_the_spline():
    """Error of a cubic spline: 5/384 h⁴ D'''' along each axis, D'''' = 24 a₄ and 8 a₄; normals 1/h of that."""
    asphere = surface(0.03, 5.0, 1.5, coefficients=[0.0, -3e-5])
    for size in (16, 64):
        gridded = sampled(lambda x, y: -3e-5 * (x * x + y * y) ** 2, size)
        plain = dataclasses.replace(asphere, coefficients=None, sag_terms=gridded)
        beyond(plain, asphere, 1e-6 * (16 / size) ** 3)


def test_tilt_is_a_prism():
    """A plane tilted by α refracts a ray along the axis by asin(n sin α) - α towards the thicker side."""
    slope = 0.1
    tilted = dataclasses.replace(surface(None, 10.0), sag_terms=noll(z3=slope * float(RADIUS) / 2))
    linear = dataclasses.replace(surface(None, 10.0), sag_terms=sampled(lambda x, y: slope * y + 0 * x, 8))
    rays = start(
        torch.stack([*points(10, 3.0), torch.full((10,), -5.0, dtype=torch.float64)]), vector(0, 0, 1)[:, None]
    )
    alpha = math.atan(slope)
    expected = math.asin(1.5 * math.sin(alpha)) - alpha
    for face in (tilted, linear):
        (crossing,) = steps([face], rays, indices=vector(1.5, 1.0))
        out = crossing.rays
        assert (torch.atan2(out.direction[1], out.direction[2]) - expected).abs().max() < 1e-14
        assert (out.position[2] - slope * out.position[1]).abs().max() < 1e-15


@pytest.mark.parametrize("face", ALL.values(), ids=ALL)
def test_hits_lie_on_ray_and_surface_and_snells_invariant_holds(face):
    position, direction = oblique()
    (crossing,) = steps([face], start(position, direction), indices=vector(1.0, 1.5))
    hit, out = crossing.rays.position, crossing.rays.direction
    assert crossing.rays.valid.all()
    assert (hit[2] - sag_at(face, hit[0], hit[1])).abs().max() < 1e-14
    assert torch.linalg.vector_norm(torch.linalg.cross(hit - position, direction, dim=0), dim=0).max() < 1e-13
    n = torch.stack(normal(face, hit)[0])
    n = n / torch.linalg.vector_norm(n, dim=0)
    before, after = (torch.linalg.cross(d, n, dim=0) for d in (direction, out))
    assert (before - 1.5 * after).abs().max() < 1e-14
    assert (torch.linalg.vector_norm(out, dim=0) - 1).abs().max() < 1e-15


def test_rays_beyond_the_grid_miss_and_leave_no_trace_in_gradients():
    face = ALL["grid"]
    heights = face.sag_terms.heights.clone().requires_grad_()
    face = dataclasses.replace(face, sag_terms=GridSag(heights, face.sag_terms.pitch))
    position, direction = torch.tensor([[0.0, 3.9, 4.5], [1.0, 0, 0], [-3.0, -3, -3]]), torch.tensor([0.0, 0, 1])
    rays = start(position.double(), direction.double()[:, None])
    (crossing,) = steps([face], rays, indices=vector(1.0, 1.5))
    assert crossing.missed.tolist() == [False, False, True]
    assert crossing.rays.position[:, 2].tolist() == [0, 0, 0]
    (gradient,) = torch.autograd.grad(crossing.rays.direction[:2, 2].sum(), heights)
    assert (gradient == 0).all()


def test_a_ray_that_newton_throws_off_is_found_by_the_bracketed_search():
    """Ripples of 0.8 mm, 2 mm long, seen at 60°: Newton's method from the plane wanders; the hit is a true crossing."""
    rippled = dataclasses.replace(
        surface(None, 5.0, semi_diameter=6.0), sag_terms=sampled(lambda x, y: 0.4 * torch.sin(3 * y) + 0 * x, 120, 12.0)
    )
    y = torch.linspace(-3, 3, 61, dtype=torch.float64)
    direction = torch.tensor([0.0, math.sin(1.0), math.cos(1.0)], dtype=torch.float64)[:, None]
    position = torch.stack([torch.zeros_like(y), y, torch.zeros_like(y)]) - 5 * direction
    hit, met = intersect(rippled, position, direction.expand(3, 61))
    assert met.all()
    assert (hit[2] - sag_at(rippled, hit[0], hit[1])).abs().max() < 1e-13
    alone = torch.stack([intersect(rippled, position[:, i : i + 1], direction)[0][:, 0] for i in range(0, 61, 12)], 1)
    assert torch.equal(hit[:, ::12], alone)


def through(face, rays):
    """Positions and directions behind a surface, of rays one of which misses and one is lost in total reflection."""
    (crossing,) = steps([face], rays, indices=vector(1.5, 1.0))
    return torch.cat([crossing.rays.position, crossing.rays.direction[:2]])


def with_lost_rays():
    position = torch.tensor([[0.3, -1.1, 9.0, 0.5], [0.2, 0.9, 0.0, 0.1], [-2.0, -2.0, -2.0, -2.0]])
    direction = torch.tensor([[0.02, -0.1, 0.0, 0.1], [0.1, 0.05, 0.0, 1.0], [1.0, 1.0, 1.0, 0.6]])
    return start(position.double(), direction.double())


@pytest.mark.parametrize("direction", ["one", pytest.param("each", marks=pytest.mark.slow)])
@pytest.mark.parametrize("kind", ["zernike", pytest.param("grid", marks=pytest.mark.slow)])
def test_first_and_second_derivatives_by_every_number_with_failed_rays(kind, direction):
    """First derivatives along one random direction of all numbers, or by each of them; second ones along one."""
    face = dataclasses.replace(ALL[kind], curvature=vector(-0.03)[0], semi_diameter=4.0)
    sag_terms, rays = noll(z2=0.02, z3=-0.01, z5=0.008, z7=0.006), with_lost_rays()
    if kind == "grid":
        sag_terms = sampled(wavy, 4)

    def traced(shape, scale, curvature, height):
        changed = dataclasses.replace(face, sag_terms=type(sag_terms)(shape, scale), curvature=curvature)
        lifted = rays.position + torch.stack([0 * height, height, 0 * height])[:, None]
        return through(changed, dataclasses.replace(rays, position=lifted))

    shape, scale = (getattr(sag_terms, field.name) for field in dataclasses.fields(sag_terms))
    inputs = [t.clone().requires_grad_() for t in (shape, scale, face.curvature, vector(0.0)[0])]
    (crossing,) = steps([dataclasses.replace(face, sag_terms=sag_terms)], rays, indices=vector(1.5, 1.0))
    assert crossing.rays.valid.tolist() == [True, True, kind == "zernike", False]
    assert gradcheck(traced, inputs, atol=1e-6, fast_mode=direction == "one")
    assert gradgradcheck(traced, inputs, atol=1e-5, rtol=1e-3, fast_mode=True)


@pytest.mark.parametrize("face", ALL.values(), ids=ALL)
def test_float32_rays(face):
    rays = start(*oblique())
    exact = through(face, rays)
    single = through(to(face, dtype=torch.float32), to(rays, dtype=torch.float32))
    assert single.dtype == torch.float32
    assert (single.double() - exact).abs().max() < 4e-6  # 20 mm of path have a spacing of 2e-6 mm


@pytest.mark.parametrize("kind", ["zernike", "grid"])
def test_transforms_of_torch_func(kind):
    """vmap over sag_terms and over rays is a loop; forward and backward derivatives are the same."""
    face, rays = ALL[kind], start(*oblique(6))
    name = "coefficients" if kind == "zernike" else "heights"
    shape = getattr(face.sag_terms, name)

    def traced(shape, position=rays.position):
        changed = dataclasses.replace(face, sag_terms=dataclasses.replace(face.sag_terms, **{name: shape}))
        return through(changed, dataclasses.replace(rays, position=position))

    several = torch.stack([shape, 0.5 * shape, 0 * shape])
    assert torch.equal(torch.func.vmap(traced)(several), torch.stack([traced(one) for one in several]))
    moved = torch.stack([rays.position, rays.position + 0.1])
    together = torch.func.vmap(lambda position: traced(shape, position))(moved)
    assert torch.equal(together, torch.stack([traced(shape, position) for position in moved]))
    forward, backward = torch.func.jacfwd(traced)(shape), torch.func.jacrev(traced)(shape)
    assert (forward - backward).abs().max() < 1e-13


def singlet(sag_terms, **others):
    front = dataclasses.replace(surface(0.02, 4.0, 1.5), sag_terms=sag_terms)
    return lens([front, surface(-0.02, 48.0)], aperture=("entrance_pupil_diameter", 6.0), **others)


@pytest.mark.slow
def test_sag_terms_is_not_round_whatever_its_numbers():
    """Astigmatism seen by one meridian would look round; the covariance of all models shows both axes."""
    round_lens, astigmatic = singlet(None), singlet(noll(z6=2e-3))
    axis = vector(0.0, 0.0)[:, None]
    far = vector(math.inf)
    assert symmetry(scene(round_lens, axis, far, round_lens.wavelengths)) == "round"
    assert symmetry(scene(astigmatic, axis, far, astigmatic.wavelengths)) == "none"
    for model in ("gaussian", "drt", "wave"):
        found = psf(astigmatic, model_of(model, order=2), fields=axis, grid=grid(0.02, 21))
        xx, _, yy = found.covariance[:, 0, 0]
        assert xx / yy > 1.2 or yy / xx > 1.2
    rays = trace_lens(astigmatic, launch(astigmatic, vector(0, 1, 1, 0).reshape(2, 2), fields=axis), vector(0.55))
    assert rays.position[1, 0, 0, 0].abs() > 0.01
    assert (rays.position[1, 0, 0, 0].abs() - rays.position[0, 0, 0, 1].abs()).abs() > 0.005


def test_paraxial_power_sees_the_mean_curvature_of_the_vertex():
    base = singlet(None)
    bent = base.replace(1, curvature=base.surfaces[1].curvature + 2 * 1e-3)
    expected = float(first_order(bent).effective_focal_length)
    gridded = sampled(lambda x, y: 1e-3 * (x * x + y * y), 8)
    twisted = ZernikeSag(torch.cat([even_terms(1e-3, 0.0).coefficients[:4], vector(0.01, 0.02)]), RADIUS)
    for sag_terms in (even_terms(1e-3, 0.0), gridded, twisted):
        assert float(first_order(singlet(sag_terms)).effective_focal_length) == pytest.approx(expected, rel=1e-12)


def test_no_table_holds_sag_terms(tmp_path):
    with pytest.raises(LensFileError, match=r"surface 1.*[zZ]ernike ?[sS]ag"):
        write_lens(singlet(bumpy()), tmp_path / "lens.csv")


def test_a_file_of_opticstudio_holds_noll_s_polynomials_as_powers(tmp_path):
    write_lens(singlet(bumpy()), tmp_path / "lens.zmx")
    found = read_lens(tmp_path / "lens.zmx").surfaces[1].sag_terms
    polynomial, _ = about_vertex(bumpy())
    assert found.coefficients.equal(polynomial.coefficients)
    assert found.radius.equal(polynomial.radius)


def test_sag_by_radius_alone_is_refused():
    with pytest.raises(ValueError, match="sag_at"):
        sag(ALL["grid"], vector(1.0))


def test_media_and_dummies_do_not_care():
    """sag terms between equal media bends nothing."""
    idle = lens([dataclasses.replace(surface(None, 5.0), sag_terms=bumpy()), surface(None, 5.0)])
    rays = launch(idle, points(5, 0.5))
    assert len(media(idle, idle.wavelengths[0])) == 4
    assert torch.equal(trace_lens(idle, rays, idle.wavelengths[0]).direction, rays.direction)

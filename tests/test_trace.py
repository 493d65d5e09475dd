"""Tracing: laws of refraction and reflection, exact systems, derivatives with lost rays, transforms of torch."""

import dataclasses
import math

import pytest
import torch
from differences import gradcheck, gradgradcheck
from problems import (
    FEMTOMETRE,
    PICOMETRE,
    aspheric_singlet,
    both_engines,
    double_gauss,
    lens,
    rays_of_problem,
    scalar,
    stigmatic_problems,
    surface,
    vector,
    vignetting_aperture,
)

from raytrace.materials.glass import MIRROR, sellmeier
from raytrace.maths.numerics import dot, to
from raytrace.maths.sampling import hexapolar
from raytrace.system.intersection import normal
from raytrace.system.lens import media
from raytrace.system.rays import Rays, start
from raytrace.tracing.launch import launch
from raytrace.tracing.refraction import reflect, refract
from raytrace.tracing.trace import axial_path, steps, trace_lens, trace_surfaces

ROUNDING = 2.0**-53

pytestmark = pytest.mark.usefixtures("engine")


def refracted(d, n, norm_squared, n1, n2):
    """Snell's law on (3, ...) tensors."""
    out, passes = refract(d, n, (n * d).sum(0), norm_squared, n1, n2)
    return torch.stack(out), passes


def reflected(d, n, norm_squared):
    """The law of reflection on (3, ...) tensors."""
    return torch.stack(reflect(d, n, (n * d).sum(0), norm_squared))


AXIS = vector(0.0, 0.0, 1.0)


def parallel(heights, dtype=torch.float64) -> Rays:
    heights = torch.as_tensor(heights, dtype=dtype)
    zero = torch.zeros_like(heights)
    return start(torch.stack([zero, heights, zero]), torch.stack([zero, zero, zero + 1]), zero)


@both_engines
@pytest.mark.parametrize("problem", stigmatic_problems(), ids=lambda problem: problem.name)
def test_stigmatic_system_images_a_point_into_a_point(problem):
    last = trace_surfaces(problem.surfaces, rays_of_problem(problem), indices=[scalar(n) for n in problem.media])
    assert last.valid.all()
    offset = vector(*problem.image)[:, None] - last.position
    distance = torch.linalg.vector_norm(torch.linalg.cross(offset, last.direction, dim=0), dim=0)
    # The oval is interpolated by 16 even terms (1 pm); the others are exact but for rounding.
    assert distance.max() <= (1 * PICOMETRE if problem.name == "Cartesian oval" else 300 * FEMTOMETRE)


@pytest.mark.parametrize("n1", [1.0, 1.5, 3.0])
@pytest.mark.parametrize("n2", [1.0, 1.5, 4.0])
def test_refraction_conserves_the_cross_product_and_the_plane_of_incidence(n1, n2):
    generator = torch.Generator().manual_seed(7)
    d = torch.randn(3, 500, generator=generator, dtype=torch.float64)
    n = torch.randn(3, 500, generator=generator, dtype=torch.float64)
    d = d / torch.linalg.vector_norm(d, dim=0)
    out, passes = refracted(d, n, (n * n).sum(0), scalar(n1), scalar(n2))
    size = torch.linalg.vector_norm(n, dim=0)
    before, after = n1 * torch.linalg.cross(n, d, dim=0) / size, n2 * torch.linalg.cross(n, out, dim=0) / size
    assert (after - before)[:, passes].abs().max() <= 20 * ROUNDING * max(n1, n2)
    assert (torch.linalg.vector_norm(out, dim=0) - 1)[passes].abs().max() <= 4 * ROUNDING
    assert ((out * n).sum(0) * (d * n).sum(0) > 0)[passes].all()  # light goes on
    sine = n1 / n2 * torch.linalg.vector_norm(torch.linalg.cross(n, d, dim=0), dim=0) / size
    assert torch.equal(passes, sine < 1)
    if n1 == n2:
        assert torch.equal(out, d * torch.rsub(dot(d, d), 1.5, alpha=0.5))  # not turned at all


def test_reflection_keeps_the_angle():
    generator = torch.Generator().manual_seed(8)
    d, n = torch.randn(2, 3, 500, generator=generator, dtype=torch.float64)
    d = d / torch.linalg.vector_norm(d, dim=0)
    out = reflected(d, n, (n * n).sum(0))
    assert ((out * n).sum(0) + (d * n).sum(0)).abs().max() <= 20 * ROUNDING
    assert (reflected(out, n, (n * n).sum(0)) - d).abs().max() <= 8 * ROUNDING


def test_fresnel_plate_displaces_and_does_not_turn():
    """Plane plate: the ray leaves parallel, displaced by t (tan θ - tan θ')."""
    angle = vector(0.0, 0.3, 1.0, 1.5)
    direction = torch.stack([torch.zeros(4).double(), torch.sin(angle), torch.cos(angle)])
    rays = start(torch.zeros(3, 4, dtype=torch.float64), direction, torch.zeros(4, dtype=torch.float64))
    plate = lens([surface(None, 10.0, 1.5), surface(None, 5.0)])
    out = trace_lens(plate, rays, plate.wavelengths[0])
    inner = torch.asin(torch.sin(angle) / 1.5)
    expected = 10 * torch.tan(inner) + 5 * torch.tan(angle)
    assert (out.direction - direction).abs().max() <= 30 * ROUNDING  # N = 0.07: twice 1/N of a rounding
    # tan θ at 1.5 rad loses 20 digits' units of θ: sec² θ · θ / tan θ.
    assert ((out.position[1] - expected) / (1 + expected)).abs().max() <= 500 * ROUNDING
    path = 1.5 * 10 / torch.cos(inner) + 5 / torch.cos(angle)
    total = out.opl + axial_path(plate.surfaces[1:], media(plate, plate.wavelengths[0]))
    assert ((total - path) / path).abs().max() <= 500 * ROUNDING


def test_ball_lens_has_its_closed_form():
    """Ball of index n: total deviation 2 (asin(h/R) - asin(h/nR))."""
    radius, n = 10.0, 1.5
    h = vector(0.0, 1e-9, 3.0, 6.6, 9.9)
    ball = lens([surface(1 / radius, 2 * radius, n), surface(-1 / radius, 50.0)])
    out = trace_lens(ball, parallel(h), ball.wavelengths[0])
    deviation = 2 * (torch.asin(h / radius) - torch.asin(h / (n * radius)))
    assert (torch.atan2(-out.direction[1], out.direction[2]) - deviation).abs().max() <= 20 * ROUNDING


def test_dummy_surfaces_and_equal_indices_change_nothing():
    plain = double_gauss()
    surfaces = list(plain.surfaces)
    air = dataclasses.replace(surfaces[5], thickness=scalar(4.0))
    rest = surface(None, 14.253 - 4.0)
    split = dataclasses.replace(plain, surfaces=(*surfaces[:5], air, rest, *surfaces[6:]))
    rays = parallel([0.0, 5.0, -16.0])
    one, other = trace_lens(plain, rays, plain.wavelengths[0]), trace_lens(split, rays, plain.wavelengths[0])
    assert (one.position - other.position).abs().max() <= 100 * FEMTOMETRE
    total = [x.opl + axial_path(s.surfaces[1:], media(s, s.wavelengths[0])) for x, s in ((one, plain), (other, split))]
    assert (total[0] - total[1]).abs().max() <= 100 * FEMTOMETRE


def test_zero_thickness_and_repeated_vertices():
    thin = lens([surface(0.02, 0.0, 1.5), surface(-0.02, 0.0), surface(None, 0.0), surface(None, 50.0)])
    out = trace_lens(thin, parallel([0.0, 1e-3, 5.0]), thin.wavelengths[0])
    assert out.valid.all()
    assert abs(out.position[1, 1].item()) <= 1e-6  # mm: f = 50 mm, third-order blur of a 1 µm beam


def test_start_in_the_middle_of_a_lens():
    system = double_gauss()
    indices = media(system, system.wavelengths[0])
    rays = parallel([0.0, 5.0, -16.0])
    whole = trace_lens(system, rays, system.wavelengths[0])
    front = trace_surfaces(system.surfaces[1:7], rays, indices=indices[:7])
    x, y, z = front.position
    moved = dataclasses.replace(front, position=torch.stack([x, y, z - system.surfaces[6].thickness]), opl=None)
    rest = trace_surfaces(system.surfaces[7:], moved, indices=indices[6:])
    assert torch.equal(rest.position, whole.position)
    assert torch.equal(rest.direction, whole.direction)


def test_reasons_of_loss_are_reported_once_and_add_up():
    system = lens(
        [surface(0.1, 15.0, 1.8, apertures=vignetting_aperture(9.0)), surface(-0.01, 5.0), surface(0.3, 5.0, 1.5)]
    )
    heights = [0.0, 2.0, 8.5, 9.5, 11.0, 3.5]
    crossings = list(steps(system.surfaces[1:], parallel(heights), indices=media(system, system.wavelengths[0])))
    lost = sum((c.missed.int() + c.totally_reflected.int() + c.clipped.int()) for c in crossings)
    assert torch.equal(lost == 0, crossings[-1].rays.valid)
    assert lost.tolist() == [0, 0, 1, 2, 1, 0]
    assert crossings[0].clipped[3]  # vignetted, goes on …
    assert crossings[1].totally_reflected[3]  # … and ends here
    assert crossings[0].missed[4]


def test_all_rays_lost_gives_zero_gradients():
    system = double_gauss()
    numbers = leaves(system)
    rays = parallel([500.0, 1e6, -300.0])
    out = trace_lens(with_leaves(system, numbers), rays, system.wavelengths[0])
    assert not out.valid.any()
    for gradient in torch.autograd.grad(
        out.position.sum() + out.direction.sum() + out.opl.sum(), numbers, allow_unused=True
    ):
        # An axial ray takes their place; its direction may be off by a rounding, and so its path.
        assert gradient is None or gradient.abs().max() <= 1e-14


def leaves(system) -> list[torch.Tensor]:
    flat, _ = torch.utils._pytree.tree_flatten(system.surfaces)
    return [x.detach().clone().requires_grad_() for x in flat]


def with_leaves(system, numbers):
    _, structure = torch.utils._pytree.tree_flatten(system.surfaces)
    return dataclasses.replace(system, surfaces=torch.utils._pytree.tree_unflatten(list(numbers), structure))


LOSSY = lens(
    [
        surface(0.05, 6.0, 1.6, conic=-0.3, apertures=vignetting_aperture(9.0)),
        surface(-0.03, 2.0, coefficients=[1e-3, -1e-5], semi_diameter=12.0),
        surface(-0.08, 3.0, 1.7),
        surface(0.09, -10.0, MIRROR, conic=0.4),
        surface(0.02, -5.0),
    ],
    object_distance=50.0,
)


def lossy_rays() -> Rays:
    """Rays that arrive, that miss, that are totally reflected and that are vignetted, in one batch."""
    y = vector(0.0, 3.0, -5.0, 9.5, 30.0, 7.0, 4.0)
    M = vector(0.0, 0.05, 0.1, 0.0, 0.0, 0.9, -0.3)
    zero = torch.zeros_like(y)
    return start(torch.stack([zero + 0.5, y, zero - 1]), torch.stack([zero + 0.02, M, zero + 1]), zero)


def test_the_lossy_system_loses_rays_in_every_way():
    crossings = list(steps(LOSSY.surfaces[1:], lossy_rays(), indices=media(LOSSY, LOSSY.wavelengths[0])))
    assert any(c.missed.any() for c in crossings)
    assert any(c.clipped.any() for c in crossings)
    assert 0 < crossings[-1].rays.valid.sum() < 7


#: Of the systems whose first and second derivatives take a second each.
DEFAULT = (("eager", 2), ("compiled", 0), ("compiled", 4))


@pytest.mark.parametrize(
    ("engine", "number"),
    [
        pytest.param(engine, k, marks=pytest.mark.slow if (engine, k) not in DEFAULT else ())
        for engine in ("eager", "compiled")
        for k in range(5)
    ],
    indirect=["engine"],
)
def test_first_and_second_derivatives_of_every_number_with_failed_rays(number):
    """Thickness, curvature, conic, terms and index of each surface, and the rays themselves."""
    flat, structure = torch.utils._pytree.tree_flatten(LOSSY.surfaces[1 + number])
    rays = lossy_rays()

    def outputs(position, direction, *factors):
        # Numbers as factors of their own size, so that a difference of 1e-6 is small for r⁴ terms too.
        numbers = [x * factor for x, factor in zip(flat, factors, strict=True)]
        changed = torch.utils._pytree.tree_unflatten(numbers, structure)
        surfaces = (*LOSSY.surfaces[: 1 + number], changed, *LOSSY.surfaces[2 + number :])
        system = dataclasses.replace(LOSSY, surfaces=surfaces)
        out = trace_lens(system, start(position, direction, torch.zeros_like(position[0])), LOSSY.wavelengths[0])
        return torch.cat([out.position[:2], out.direction, out.opl[None]])

    given = (rays.position.clone().requires_grad_(), rays.direction.clone().requires_grad_())
    arguments = (*given, *(torch.ones_like(x).requires_grad_() for x in flat))
    assert gradcheck(outputs, arguments, atol=1e-5, rtol=1e-4)
    seconds = (rays.position, rays.direction, *arguments[2:])
    assert gradgradcheck(outputs, seconds, atol=1e-4, rtol=1e-3)


def image_height(curvature, thickness, terms, rays=None):
    front = surface(curvature, thickness, 1.53, conic=scalar(-0.4), coefficients=terms, semi_diameter=9.0)
    system = lens([front, surface(-0.02, 30.0, conic=0.5)])
    return trace_lens(system, rays or parallel([0.0, 1.0, 4.0, 30.0]), system.wavelengths[0]).position[1]


POINT = (scalar(0.02), scalar(5.0), vector(2e-3, -1e-5, 2e-8))


def test_vmap_over_populations_of_lenses():
    generator = torch.Generator().manual_seed(9)
    scale = 1 + 0.2 * torch.rand(5, generator=generator, dtype=torch.float64)
    c, t, a = scale * POINT[0], scale * POINT[1], scale[:, None] * POINT[2]
    expected = torch.stack([image_height(*x) for x in zip(c, t, a, strict=True)])
    assert torch.equal(torch.func.vmap(image_height)(c, t, a), expected)
    only_terms = torch.func.vmap(image_height, in_dims=(None, None, 0))(POINT[0], POINT[1], a)
    assert torch.equal(only_terms[2], image_height(POINT[0], POINT[1], a[2]))


def test_vmap_over_whole_lenses():
    lenses = [double_gauss(), double_gauss()]
    lenses[1] = dataclasses.replace(
        lenses[1], surfaces=tuple(dataclasses.replace(s, thickness=1.01 * s.thickness) for s in lenses[1].surfaces)
    )
    stacked = torch.utils._pytree.tree_map(lambda *x: torch.stack(x), *lenses)
    rays = parallel([0.0, 5.0, -16.0])
    found = torch.func.vmap(lambda system: trace_lens(system, rays, system.wavelengths[0]).position)(stacked)
    for i, system in enumerate(lenses):
        assert torch.equal(found[i], trace_lens(system, rays, system.wavelengths[0]).position)


def test_forward_and_reverse_jacobians_agree_and_the_hessian_is_symmetric():
    numbers = torch.cat([POINT[0][None], POINT[1][None], POINT[2]])

    def heights(x):
        return image_height(x[0], x[1], x[2:])

    forward, reverse = torch.func.jacfwd(heights)(numbers), torch.func.jacrev(heights)(numbers)
    assert torch.allclose(forward, reverse, rtol=1e-11, atol=1e-12)
    assert (forward[3] == 0).all()  # the ray that misses
    hessian = torch.func.hessian(lambda x: (heights(x) ** 2).sum())(numbers)
    scale = hessian.abs().diagonal().sqrt()
    assert ((hessian - hessian.T).abs() <= 1e-9 * scale[:, None] * scale).all()
    reverse_hessian = torch.func.jacrev(torch.func.jacrev(lambda x: (heights(x) ** 2).sum()))(numbers)
    assert torch.allclose(hessian, reverse_hessian, rtol=1e-8, atol=1e-9)


def compiled_equals_eager(backend: str, system):
    rays = parallel([0.0, 1.0, 4.0, 300.0])
    call = torch.compile(
        lambda system, rays, w: trace_lens(system, rays, w), fullgraph=True, backend=backend, dynamic=False
    )
    found, expected = call(system, rays, system.wavelengths[0]), trace_lens(system, rays, system.wavelengths[0])
    assert torch.equal(found.valid, expected.valid)
    # A compiler may contract a·b + c into one rounding.
    tolerance = 0.0 if backend == "aot_eager" else 1 * PICOMETRE
    assert (found.position - expected.position).abs().max() <= tolerance
    assert (found.direction - expected.direction).abs().max() <= tolerance
    assert (found.opl - expected.opl).abs().max() <= tolerance


@pytest.mark.slow
def test_compiled_trace_equals_the_eager_one_bit_for_bit():
    """An asphere, a conic and a mirror in one graph without a break."""
    front = surface(0.02, 5.0, 1.53, coefficients=[2e-3, -1e-5], semi_diameter=9.0)
    compiled_equals_eager("aot_eager", lens([front, surface(-0.02, -30.0, MIRROR, conic=0.5)]))


@pytest.mark.slow
@pytest.mark.parametrize("build", [double_gauss, aspheric_singlet])
@pytest.mark.parametrize("backend", ["aot_eager", "inductor"])
def test_whole_lens_compiled(build, backend):
    compiled_equals_eager(backend, build())


@pytest.mark.slow
def test_compiled_gradient_equals_the_eager_one():
    def merit(c, t, a):
        return (image_height(c, t, a, rays=parallel([0.0, 1.0, 4.0, 30.0])) ** 2).sum()

    inputs = [x.clone().requires_grad_() for x in POINT]
    compiled = torch.compile(merit, fullgraph=True, backend="aot_eager")
    found, expected = torch.autograd.grad(compiled(*inputs), inputs), torch.autograd.grad(merit(*inputs), inputs)
    assert all(torch.allclose(a, b, rtol=1e-12) for a, b in zip(found, expected, strict=True))


@pytest.mark.parametrize("build", [double_gauss, aspheric_singlet])
def test_float32_follows_float64(build):
    system = build()
    narrow = to(system, dtype=torch.float32)
    heights = [0.0, 1.0, -3.5, 300.0]
    one = trace_lens(system, parallel(heights), system.wavelengths[0])
    other = trace_lens(narrow, parallel(heights, torch.float32), narrow.wavelengths[0])
    assert other.position.dtype == other.direction.dtype == other.opl.dtype == torch.float32
    assert torch.equal(one.valid, other.valid)
    # A dozen surfaces of roundings of 6e-8 of lengths of 100 mm.
    assert (one.position - other.position).abs().max() <= 2e-4
    assert (one.direction - other.direction).abs().max() <= 5e-6


def test_autocast_does_not_touch_the_trace():
    system = double_gauss()
    rays = parallel([0.0, 5.0])
    with torch.autocast("cpu", dtype=torch.bfloat16):
        found = trace_lens(system, rays, system.wavelengths[0])
    assert torch.equal(found.position, trace_lens(system, rays, system.wavelengths[0]).position)


def test_fields_wavelengths_and_pupil_together_equal_one_at_a_time():
    flint = sellmeier([1.34, 0.2, 0.93], [0.0099, 0.0447, 111.9])
    system = double_gauss(glasses=(flint, flint, flint), wavelengths=(0.45, 0.53, 0.65))
    points, _ = hexapolar(2)
    whole = trace_lens(system, launch(system, points), system.wavelengths[:, None])
    assert whole.position.shape == (3, 3, 3, 19)
    for f in range(3):
        field = torch.stack([system.fields.x[f : f + 1], system.fields.y[f : f + 1]])
        for w in range(3):
            wavelength = system.wavelengths[w : w + 1]
            alone = trace_lens(system, launch(system, points, fields=field, wavelengths=wavelength), wavelength)
            assert torch.equal(alone.position[:, 0, 0], whole.position[:, f, w])
            assert torch.equal(alone.opl[0, 0], whole.opl[f, w])


@both_engines
@pytest.mark.parametrize("count", [2, 3, 4])
def test_wavelengths_against_rays_of_fewer_axes(count):
    """(W, 1) wavelengths against (3, P) rays: three wavelengths must not be taken for three components."""
    flint = sellmeier([1.34, 0.2, 0.93], [0.0099, 0.0447, 111.9])
    system = lens([surface(0.02, 5.0, flint), surface(-0.02, 50.0, conic=-0.2)])
    rays = parallel([0.0, 1.0, 2.0, 3.0, 30.0])
    wavelengths = torch.linspace(0.4, 0.7, count, dtype=torch.float64)
    found = trace_lens(system, rays, wavelengths[:, None])
    assert found.position.shape == (3, count, 5)
    for i, wavelength in enumerate(wavelengths):
        alone = trace_lens(system, rays, wavelength)
        assert torch.equal(found.position[:, i], alone.position)
        assert torch.equal(found.opl[i], alone.opl)
        assert torch.equal(found.valid[i], alone.valid)


@both_engines
@pytest.mark.parametrize("count", [2, 3, 4])
@pytest.mark.parametrize("which", ["curvature", "thickness"])
def test_population_against_rays_of_fewer_axes(count, which):
    system = lens([surface(0.02, 5.0, 1.5), surface(-0.02, 50.0)])
    rays = parallel([0.0, 1.0, 2.0, 3.0, 30.0])
    scale = torch.linspace(0.9, 1.1, count, dtype=torch.float64)
    number = getattr(system.surfaces[1], which)

    def changed(value):
        return system.replace(1, **{which: value})

    found = trace_lens(changed((scale * number)[:, None]), rays, system.wavelengths[0])
    for i in range(count):
        alone = trace_lens(changed(scale[i] * number), rays, system.wavelengths[0])
        assert torch.equal(found.position[:, i], alone.position)


def test_start_of_positions_and_directions_of_different_axes():
    position = torch.arange(3.0).double().reshape(3, 1)
    direction = torch.randn(3, 3, 4, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    rays = start(position, direction)
    assert rays.position.shape == rays.direction.shape == (3, 3, 4)
    assert torch.equal(rays.position, position[:, :, None].expand(3, 3, 4))


def test_odd_and_even_numbers_of_mirrors():
    """A Mangin-free pair: light comes back after one mirror and goes on after two; indices stay positive."""
    one = lens([surface(-0.01, -50.0, MIRROR)])
    out = trace_lens(one, parallel([0.0, 1.0]), one.wavelengths[0])
    assert (out.direction[2] < 0).all()
    assert abs(out.position[1, 1].item()) <= 1e-4  # mm: h³/4R² of spherical aberration at f
    two = lens([surface(-0.01, -30.0, MIRROR), surface(-0.02, 80.0, MIRROR)])
    out = trace_lens(two, parallel([0.0, 1.0]), two.wavelengths[0])
    assert (out.direction[2] > 0).all()
    assert all(n > 0 for n in media(two, two.wavelengths[0]))


def test_second_surface_mirror_keeps_the_glass():
    mangin = lens([surface(None, 10.0, 1.5), surface(None, -10.0, MIRROR), surface(None, -20.0)])
    direction = torch.stack([vector(0.0), vector(0.5), vector(math.sqrt(0.75))])
    rays = start(torch.zeros(3, 1, dtype=torch.float64), direction)
    out = trace_lens(mangin, rays, mangin.wavelengths[0])
    inner = math.asin(0.5 / 1.5)
    assert out.position[1].item() == pytest.approx(20 * math.tan(inner) + 20 * math.tan(math.asin(0.5)), rel=1e-14)
    assert [n.item() for n in media(mangin, mangin.wavelengths[0])] == [1.0, 1.5, 1.5, 1.0, 1.0]


def test_path_between_images_is_the_same_for_all_rays():
    """Fermat: in a stigmatic system every ray from the source to its image has the same path."""
    for problem in stigmatic_problems():
        if problem.image != (0.0, 0.0, 0.0):
            continue
        last = trace_surfaces(problem.surfaces, rays_of_problem(problem), indices=[scalar(n) for n in problem.media])
        assert (last.opl - last.opl[0]).abs().max() <= (1e-9 if problem.name == "Cartesian oval" else 1e-12), (
            problem.name
        )


def test_a_plane_on_an_input_that_needs_no_gradient_makes_no_graph():
    system = double_gauss()
    assert not trace_lens(system, parallel([1.0]), system.wavelengths[0]).position.requires_grad


def test_inputs_are_not_changed():
    rays = lossy_rays()
    copies = [rays.position.clone(), rays.direction.clone(), rays.valid.clone(), rays.opl.clone()]
    trace_lens(LOSSY, rays, LOSSY.wavelengths[0])
    for a, b in zip((rays.position, rays.direction, rays.valid, rays.opl), copies, strict=True):
        assert torch.equal(a, b)


def test_normal_of_every_surface_is_used_with_its_length():
    """The conic normal is not of unit length: refraction must not depend on it."""
    n, norm_squared = normal(surface(0.05, conic=-0.5), (vector(5.0), vector(0.0), vector(0.63)))
    n = torch.stack(n)
    d = torch.stack([vector(0.0), vector(0.0), vector(1.0)])
    one = refracted(d, n, norm_squared, scalar(1.0), scalar(1.5))[0]
    other = refracted(d, n / torch.sqrt(norm_squared), torch.ones(1).double(), scalar(1.0), scalar(1.5))[0]
    assert (one - other).abs().max() <= 4 * ROUNDING

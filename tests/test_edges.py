"""Edges: derivatives of clipped beams by numbers that move the rim's image in the pupil, against finer quadrature."""

import dataclasses
import math

import numpy as np
import pytest
import torch
from differences import slopes_by_differences
from problems import double_gauss, lens, number, scalar, surface, vector

import raytrace as rt
from raytrace.maths.numerics import to
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import SystemAperture
from raytrace.system.optimization_data import Vary
from raytrace.system.surface import Aperture
from raytrace.tracing.clear_pupil import arms_of, clear_pupil, is_clipped
from raytrace.tracing.scene import scene, trace_scene

NUMBERS = {"f_number": 3.0, "front": 20.0, "rear": 16.0, "curvature": 0.0184661976, "field": 10.0}
STEPS = {"f_number": 1e-4, "front": 1e-3, "rear": 1e-3, "curvature": 1e-7, "field": 1e-3}


def clipped(f_number, front, rear, curvature, field, *, rims: int):
    """The double Gauss whose first surface has a rim, or its first and last; and its field (2, 1)."""
    glass = double_gauss()
    glass = glass.replace(1, curvature=curvature, apertures=(Aperture("circular", (0.0, front)),))
    if rims == 2:
        glass = glass.replace(11, apertures=(Aperture("circular", (0.0, rear)),))
    glass = dataclasses.replace(glass, aperture=SystemAperture("image_f_number", f_number))
    return glass, torch.stack([torch.zeros_like(field), field])[:, None]


def moments(hits, weights):
    """Share of the pupil, centroid y and mean square radius of points (2, P)."""
    share = weights / weights.sum()
    centroid = (share * hits).sum(-1)
    return torch.stack([weights.sum(), centroid[1], (share * (hits - centroid[:, None]) ** 2).sum()])


def by_quadrature(glass, fields, *, rings=16, arms=96):
    points, weights = clear_pupil(glass, fields=fields, rings=rings, arms=arms)
    batch = scene(glass, fields, vector(math.inf), glass.wavelengths)
    return moments(trace_scene(batch, points[:, None]).position[:2, 0, 0, 0], weights[0, 0])


@torch.no_grad()
def by_bisection(glass, fields, arms=2000):
    """The same of rays that pass or do not, on arms from a point near the middle of the clear pupil."""
    batch = scene(glass, fields, vector(math.inf), glass.wavelengths)
    angle = (torch.arange(arms, dtype=torch.float64) + 0.5) * (2 * math.pi / arms)
    unit = torch.stack([torch.cos(angle), torch.sin(angle)])
    passes, blocked = torch.zeros_like(angle), torch.ones_like(angle)
    for _ in range(40):
        middle = 0.5 * (passes + blocked)
        through = trace_scene(batch, middle * unit).valid[0, 0, 0]
        passes, blocked = torch.where(through, middle, passes), torch.where(through, blocked, middle)
    nodes, weights = (t[:, None] for t in torch.as_tensor(LEGENDRE))
    radius = 0.5 * (nodes + 1) * passes
    hits = trace_scene(batch, (radius * unit[:, None]).flatten(1)).position[:2, 0, 0, 0]
    return moments(hits, (weights * radius * passes / arms).flatten())


LEGENDRE = np.stack(np.polynomial.legendre.leggauss(12))


@pytest.mark.parametrize("rims", [1, 2])
def test_clear_pupil_is_that_of_rays_that_pass(rims):
    glass, fields = clipped(*(scalar(n) for n in NUMBERS.values()), rims=rims)
    # Corners of the clear pupil leave the 2000 equal angles of the reference an error of 1e-6.
    torch.testing.assert_close(by_quadrature(glass, fields), by_bisection(glass, fields), rtol=3e-6, atol=0)


def test_two_crossing_rims_have_the_area_of_a_lens_and_its_derivatives():
    """Discs of radii a, b at a distance d overlap in the area A = a²(α - sin α cos α) + b²(β - sin β cos β)."""
    a, b, d, radius = (scalar(n).requires_grad_() for n in (4.0, 3.0, 2.5, 6.0))
    openings = (Aperture("circular", (0.0, a)), Aperture("circular", (0.0, b), False, (0.0, d)))
    window = lens(
        [surface(None, 1.0, apertures=openings), surface(0.01, 2.0, 1.5), surface(None, 100.0)],
        aperture=("entrance_pupil_diameter", 2 * radius),
    )
    alpha = torch.acos((d * d + a * a - b * b) / (2 * d * a))
    beta = torch.acos((d * d + b * b - a * a) / (2 * d * b))
    area = a * a * (alpha - alpha.sin() * alpha.cos()) + b * b * (beta - beta.sin() * beta.cos())
    expected = area / (math.pi * radius**2)
    _, weights = clear_pupil(window, fields=number([[0.0], [0.0]]))
    numbers = (a, b, d, radius)
    torch.testing.assert_close(weights.sum(), expected, rtol=1e-9, atol=0)
    found, wanted = (torch.stack(torch.autograd.grad(share, numbers)) for share in (weights.sum(), expected))
    torch.testing.assert_close(found, wanted, rtol=1e-6, atol=0)


def spot(glass, fields):
    spots = rt.spot(glass, fields=fields)
    return torch.stack([spots.centroid[1, 0, 0], spots.mean_square_radius[0, 0]])


def psf(model):
    def both(glass, fields):
        found = rt.psf(glass, model, fields=fields, pixel=0.004, size=5)
        return torch.stack([found.ray_centroid[1, 0, 0], found.ray_covariance[0, 0, 0] + found.ray_covariance[2, 0, 0]])

    return both


def energy(glass, fields):
    return rt.psf(glass, rt.psf_models.Gaussian(order=3), fields=fields, pixel=0.03, size=61).energy[0]


def illumination(glass, fields):
    return rt.relative_illumination(glass, fields=fields).projected_solid_angle


#: Quantity, entries of `moments` that it is, and its error: of few rings, of cells, of the quadrature.
QUANTITIES = {
    "spot": (spot, slice(1, 3), 2e-6),
    "energy": (energy, slice(0, 1), 2e-6),
    "gaussian": (psf(rt.psf_models.Gaussian(order=4)), slice(1, 3), 2e-5),
    "drt": (psf(rt.psf_models.DRT(order=4)), slice(1, 3), 1e-2),
    "wave": (psf(rt.psf_models.Wave(order=0)), slice(1, 3), 2e-6),
}


def differences(function, rims: int, names) -> dict[str, torch.Tensor]:
    """Central differences of a function of the clipped lens by each number."""
    found = {}
    for name in names:
        ends = []
        for sign in (1, -1):
            numbers = NUMBERS | {name: NUMBERS[name] + sign * STEPS[name]}
            ends.append(function(*clipped(*(scalar(n) for n in numbers.values()), rims=rims)))
        found[name] = (ends[0] - ends[1]) / (2 * STEPS[name])
    return found


def derivatives(function, rims: int, names) -> dict[str, torch.Tensor]:
    numbers = {name: scalar(n).requires_grad_() for name, n in NUMBERS.items()}
    values = function(*clipped(*numbers.values(), rims=rims))
    rows = [torch.autograd.grad(value, [numbers[name] for name in names], retain_graph=True) for value in values]
    return {name: torch.stack([row[k] for row in rows]) for k, name in enumerate(names)}


@pytest.mark.parametrize(
    ("quantity", "rims"),
    [
        pytest.param(quantity, rims, marks=pytest.mark.slow if rims == 1 else ())
        for quantity in QUANTITIES
        for rims in (1, 2)
    ],
)
def test_derivatives_are_those_of_finer_quadrature(quantity, rims):
    function, entries, error = QUANTITIES[quantity]
    names = [name for name in NUMBERS if rims == 2 or name != "rear"]
    computed = derivatives(function, rims, names)
    expected = differences(lambda *where: by_quadrature(*where)[entries], rims, names)
    for name in names:
        torch.testing.assert_close(
            computed[name], expected[name], rtol=error, atol=0, msg=lambda m, n=name: f"{n}: {m}"
        )


@pytest.mark.parametrize("rims", [pytest.param(1, marks=pytest.mark.slow), 2])
def test_relative_illumination_has_the_derivative_of_its_number(rims):
    names = ["f_number", "front", "field"]
    computed, expected = (find(illumination, rims, names) for find in (derivatives, differences))
    for name in names:
        torch.testing.assert_close(computed[name], expected[name], rtol=2e-6, atol=0)


def test_a_rim_that_clips_nothing_changes_no_number():
    whole = double_gauss()
    rimmed = whole.replace(1, apertures=(Aperture("circular", (0.0, 60.0)),))
    for one, other in zip(rt.spot(rimmed).each.points, rt.spot(whole).each.points, strict=True):
        assert torch.equal(one, other)
    assert torch.equal(rt.spot(rimmed).rms_radius, rt.spot(whole).rms_radius)
    assert torch.equal(rt.relative_illumination(rimmed).illumination, rt.relative_illumination(whole).illumination)


def test_a_kernel_does_not_depend_on_the_others():
    """Fields with and without kinks at once, and each alone."""
    glass, _ = clipped(*(scalar(n) for n in NUMBERS.values()), rims=2)
    together = rt.spot(glass, fields=[0.0, 6.0, 14.0])
    for k, field in enumerate((0.0, 6.0, 14.0)):
        alone = rt.spot(glass, fields=[field])
        torch.testing.assert_close(alone.rms_radius[0], together.rms_radius[k], rtol=1e-12, atol=0)


def test_radii_of_a_clipped_spot_reach_its_edge():
    """The radii are those of 32768 rays that pass or do not."""
    glass, fields = clipped(*(scalar(n) for n in NUMBERS.values()), rims=2)
    spots = rt.spot(glass, fields=fields)
    many = rt.spot(glass, fields=fields, sampling="sobol", points=2**15)
    assert float(spots.geometric_radius / many.geometric_radius - 1) == pytest.approx(0, abs=1e-3)
    assert float(spots.rms_radius / many.rms_radius - 1) == pytest.approx(0, abs=5e-4)
    assert int(spots.rays) < spots.launched


@pytest.mark.parametrize("engine", ["eager", "compiled"], indirect=True)
def test_extents_may_be_tensors(engine):
    glass, fields = clipped(*(scalar(n) for n in NUMBERS.values()), rims=2)
    plain, _ = clipped(*(scalar(n) for n in NUMBERS.values()), rims=2)
    plain = plain.replace(1, apertures=(Aperture("circular", (0.0, 20.0)),))
    plain = plain.replace(11, apertures=(Aperture("circular", (0.0, 16.0)),))
    points = 1.4 * torch.rand(2, 200, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) - 0.7
    ends = [trace_scene(scene(one, fields, vector(math.inf), one.wavelengths), points) for one in (glass, plain)]
    assert torch.equal(ends[0].valid, ends[1].valid)
    assert not bool(ends[0].valid.all())
    assert to(glass, dtype=torch.float32).surfaces[1].apertures[0].extent[1].dtype == torch.float32


def test_arms_of_a_pupil_that_is_not_clipped_are_whole():
    batch = scene(double_gauss(), number([[0.0], [10.0]]), vector(math.inf), vector(0.53))
    assert not is_clipped(batch, number([[0.0], [0.0]]))
    assert float(arms_of(batch, 16).rule(4)[1].sum()) == pytest.approx(1, abs=1e-14)


@pytest.mark.slow
def test_a_merit_function_of_a_clipped_spot_has_the_derivatives_of_the_light():
    """By the system aperture and the thicknesses before and behind the stop, whose rims clip at 72 % of the pupil."""
    glass, _ = clipped(*(scalar(n) for n in NUMBERS.values()), rims=2)

    def size(glass):
        return rt.spot(glass, fields=[10.0]).rms_radius[0, 0]

    model = DesignVariables(glass, (Vary(0, "aperture"), Vary(5, "thickness"), Vary(6, "thickness")))
    evaluation = Evaluation(model, [rt.system.Row(rt.optimization.Measure("size", size), weight=1.0)])
    found = evaluation(model.start, derivatives=True)
    expected = slopes_by_differences(evaluation, model.start, 1e-4)
    np.testing.assert_allclose(found.jacobian, expected, rtol=1e-6)
    assert float(found.values[0]) == pytest.approx(float(size(glass)), rel=1e-12)

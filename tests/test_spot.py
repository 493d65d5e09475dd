"""Spot: the statistics of points, exact where the textbook formulas cancel, and never NaN."""

import math

import numpy as np
import pytest
import torch
from test_hardcases import of_kind

from raytrace.rays import Rays
from raytrace.spot import spot, spot_of_points

ROUNDING = 2.0**-53


def tensor(x):
    return torch.tensor(x, dtype=torch.float64)


def floats(values):
    return [float(v) for v in values]


@pytest.mark.parametrize("case", of_kind("spot"))
def test_hard_case(case):
    """Centroid, mean square and RMS radius with their gradients, against exact rational arithmetic."""
    data, expected = case["data"], case["expected"]
    x, y = (tensor(floats(data[key])).requires_grad_() for key in "xy")
    found = spot_of_points(torch.stack([x, y]), torch.tensor(data["valid"]), tensor(data["weight"]))
    mean_square = torch.autograd.grad(found.mean_square_radius, x, retain_graph=True)[0]
    rms = torch.autograd.grad(found.rms_radius, x)[0]
    assert torch.isfinite(rms).all()
    if expected["status"] == "undefined":  # documented: an empty spot has radius 0, at the origin
        assert found.rms_radius == found.mean_square_radius == 0
        assert (mean_square == 0).all()
        return
    centroid = tensor(floats(expected["centroid"]))
    assert (found.centroid - centroid).abs().max() <= 4 * ROUNDING * centroid.abs().max()
    size = float(expected["rms"])
    rounded = 4 * ROUNDING * centroid.abs().max().item()  # of the mean
    if 1e-140 < size < 1e140:  # beyond, the mean *square* leaves the range of float64
        assert found.mean_square_radius.item() == pytest.approx(float(expected["mean_square_radius"]), rel=1e-13)
        reference = tensor(floats(expected["grad_mean_square_x"]))
        # Differences of points to the centroid are exact but for the rounding of the mean.
        assert (mean_square - reference).abs().max() <= 1e-13 * size + rounded
    assert found.rms_radius.item() == pytest.approx(size, rel=1e-13)
    if expected["grad_rms_x"] is None:
        assert (rms == 0).all()
    else:
        reference = tensor(floats(expected["grad_rms_x"]))
        assert (rms - reference).abs().max() <= 1e-13 + rounded / size


def test_weighted_radius_by_numpy():
    generator = np.random.default_rng(1)
    points, weights = generator.normal(size=(2, 50)), generator.random(50)
    valid = generator.random(50) < 0.8
    w = np.where(valid, weights, 0) / weights[valid].sum()
    centre = points @ w
    square = ((points - centre[:, None]) ** 2).sum(0)
    found = spot_of_points(tensor(points), torch.tensor(valid), tensor(weights))
    assert found.rms_radius.item() == pytest.approx(math.sqrt(square @ w), rel=1e-14)
    assert found.geometric_radius.item() == pytest.approx(math.sqrt(square[valid].max()), rel=1e-14)
    assert found.rays.item() == valid.sum()


def test_a_picometre_spot_a_metre_off_the_axis():
    """1 pm is nine spacings of float64 at 1000 mm; these points are exact, and so is their RMS radius."""
    step = 2.0**-40  # 0.9 pm
    points = tensor([[1000.0, 1000.0 + step, 1000.0, 1000.0 + step], [-500.0, -500.0, -500.0 + step, -500.0 + step]])
    found = spot_of_points(points, torch.ones(4, dtype=torch.bool))
    assert found.rms_radius.item() == pytest.approx(step / math.sqrt(2), rel=1e-15)


@pytest.mark.parametrize("points", [[[1.25], [-3.5]], [[1.1, 1.1], [0.3, 0.3]]])
def test_one_point_or_identical_points_have_radius_and_gradient_zero(points):
    points = tensor(points).requires_grad_()
    found = spot_of_points(points, torch.ones(points.shape[1], dtype=torch.bool))
    assert found.rms_radius == found.geometric_radius == 0
    (gradient,) = torch.autograd.grad(found.rms_radius + found.geometric_radius, points)
    assert (gradient == 0).all()


@pytest.mark.parametrize("shape", [(2, 0), (2, 3, 0), (2, 0, 5)])
def test_no_points(shape):
    found = spot_of_points(torch.zeros(shape, dtype=torch.float64), torch.zeros(shape[1:], dtype=torch.bool))
    assert found.rms_radius.shape == shape[1:-1]
    assert torch.isfinite(found.centroid).all()
    assert found.rays.sum() == 0


def test_batches_equal_spots_one_by_one():
    generator = torch.Generator().manual_seed(4)
    points = torch.randn(2, 3, 4, 20, generator=generator, dtype=torch.float64)
    valid = torch.rand(3, 4, 20, generator=generator) < 0.7
    whole = spot_of_points(points, valid)
    for i in range(3):
        for j in range(4):
            alone = spot_of_points(points[:, i, j], valid[i, j])
            assert alone.rms_radius.item() == pytest.approx(whole.rms_radius[i, j].item(), rel=1e-14)
            assert torch.allclose(alone.centroid, whole.centroid[:, i, j], rtol=1e-14, atol=1e-15)


def test_derivatives_of_the_mean_square():
    generator = torch.Generator().manual_seed(5)
    points = torch.randn(2, 6, generator=generator, dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([True, True, False, True, True, False])
    weights = torch.rand(6, generator=generator, dtype=torch.float64)

    def statistics(p):
        found = spot_of_points(p, valid, weights)
        return found.mean_square_radius, found.rms_radius, found.geometric_radius, found.centroid

    assert torch.autograd.gradcheck(statistics, points)
    assert torch.autograd.gradgradcheck(lambda p: statistics(p)[:2], points)


def test_float32_keeps_its_digits():
    points = tensor([[1000.0, 1000.0 + 2**-13, 1000.0], [0.0, 0.0, 2**-13]])
    found = spot_of_points(points.float(), torch.ones(3, dtype=torch.bool))
    exact = spot_of_points(points, torch.ones(3, dtype=torch.bool)).rms_radius.item()
    assert found.rms_radius.item() == pytest.approx(exact, rel=1e-6)


def test_spot_of_rays_ignores_lost_ones():
    position = tensor([[0.0, 1.0, 77.0], [0.0, 0.0, 77.0], [0.0, 0.0, 0.0]])
    direction = torch.zeros_like(position)
    direction[2] = 1.0
    found = spot(Rays(position, direction, torch.tensor([True, True, False])))
    assert found.centroid.tolist() == [0.5, 0.0]
    assert found.rms_radius == found.geometric_radius == 0.5

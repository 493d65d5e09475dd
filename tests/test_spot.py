"""Spot: the statistics of points, exact where the textbook formulas cancel, and never NaN."""

import json
import math

import numpy as np
import pytest
import torch
from differences import gradcheck, gradgradcheck
from hardcases_scene import of_kind
from problems import floats, number, vector

import raytrace as rt
from raytrace.cli import main
from raytrace.files import shipped
from raytrace.io import read_lens
from raytrace.maths.sampling import hexapolar
from raytrace.system.rays import Rays
from raytrace.tracing.ray_failures import LostRays
from raytrace.tracing.spot import EmptySpot, chief_reference, image_rays, spot_of, spot_of_points

ROUNDING = 2.0**-53


@pytest.mark.parametrize("case", of_kind("spot"))
def test_hard_case(case):
    """Centroid, mean square and RMS radius with their gradients, against exact rational arithmetic."""
    data, expected = case["data"], case["expected"]
    x, y = (number(floats(data[key])).requires_grad_() for key in "xy")
    found = spot_of_points(torch.stack([x, y]), torch.tensor(data["valid"]), number(data["weight"]))
    mean_square = torch.autograd.grad(found.mean_square_radius, x, retain_graph=True)[0]
    rms = torch.autograd.grad(found.rms_radius, x)[0]
    assert torch.isfinite(rms).all()
    if expected["status"] == "undefined":  # documented: nan with gradient 0
        assert found.rms_radius.isnan()
        assert found.mean_square_radius.isnan()
        assert (mean_square == 0).all()
        return
    centroid = number(floats(expected["centroid"]))
    assert (found.centroid - centroid).abs().max() <= 4 * ROUNDING * centroid.abs().max()
    size = float(expected["rms"])
    rounded = 4 * ROUNDING * centroid.abs().max().item()  # of the mean
    if 1e-140 < size < 1e140:  # beyond, the mean *square* leaves the range of float64
        assert found.mean_square_radius.item() == pytest.approx(float(expected["mean_square_radius"]), rel=1e-13)
        reference = number(floats(expected["grad_mean_square_x"]))
        # Differences of points to the centroid are exact but for the rounding of the mean.
        assert (mean_square - reference).abs().max() <= 1e-13 * size + rounded
    assert found.rms_radius.item() == pytest.approx(size, rel=1e-13)
    if expected["grad_rms_x"] is None:
        assert (rms == 0).all()
    else:
        reference = number(floats(expected["grad_rms_x"]))
        assert (rms - reference).abs().max() <= 1e-13 + rounded / size


def test_weighted_radius_by_numpy():
    generator = np.random.default_rng(1)
    points, weights = generator.normal(size=(2, 50)), generator.random(50)
    valid = generator.random(50) < 0.8
    w = np.where(valid, weights, 0) / weights[valid].sum()
    centre = points @ w
    square = ((points - centre[:, None]) ** 2).sum(0)
    found = spot_of_points(number(points), torch.tensor(valid), number(weights))
    assert found.rms_radius.item() == pytest.approx(math.sqrt(square @ w), rel=1e-14)
    assert found.geometric_radius.item() == pytest.approx(math.sqrt(square[valid].max()), rel=1e-14)
    assert found.rays.item() == valid.sum()


def test_a_picometre_spot_a_metre_off_the_axis():
    """1 pm is nine spacings of float64 at 1000 mm; these points are exact, and so is their RMS radius."""
    step = 2.0**-40  # 0.9 pm
    points = number([[1000.0, 1000.0 + step, 1000.0, 1000.0 + step], [-500.0, -500.0, -500.0 + step, -500.0 + step]])
    found = spot_of_points(points, torch.ones(4, dtype=torch.bool))
    assert found.rms_radius.item() == pytest.approx(step / math.sqrt(2), rel=1e-15)


@pytest.mark.parametrize("points", [[[1.25], [-3.5]], [[1.1, 1.1], [0.3, 0.3]]])
def test_one_point_or_identical_points_have_radius_and_gradient_zero(points):
    points = number(points).requires_grad_()
    found = spot_of_points(points, torch.ones(points.shape[1], dtype=torch.bool))
    assert found.rms_radius == found.geometric_radius == 0
    (gradient,) = torch.autograd.grad(found.rms_radius + found.geometric_radius, points)
    assert (gradient == 0).all()


@pytest.mark.parametrize("shape", [(2, 0), (2, 3, 0), (2, 0, 5)])
def test_no_points(shape):
    found = spot_of_points(torch.zeros(shape, dtype=torch.float64), torch.zeros(shape[1:], dtype=torch.bool))
    assert found.rms_radius.shape == shape[1:-1]
    assert found.centroid.isnan().all()
    assert found.rays.sum() == 0


def batch_with_a_lost_spot():
    """Points (2, 2, 5) of two spots, the second of which no ray reaches, with its exact neighbour."""
    generator = torch.Generator().manual_seed(7)
    points = torch.randn(2, 2, 5, generator=generator, dtype=torch.float64).requires_grad_()
    return points, torch.tensor([[True] * 5, [False] * 5])


@pytest.mark.parametrize("name", ["mean_square_radius", "rms_radius", "geometric_radius", "centroid"])
@pytest.mark.parametrize("reduce", [torch.sum, torch.nansum, torch.nanmean])
def test_a_lost_spot_is_nan_and_leaves_the_derivatives_of_others_alone(name, reduce):
    """Nor is it worth anything: 0 with gradient 0 would make losing every ray the best a merit can do."""
    points, valid = batch_with_a_lost_spot()
    found = getattr(spot_of_points(points, valid), name)
    assert found[..., 1].isnan().all()
    assert found[..., 0].isfinite().all()
    (gradient,) = torch.autograd.grad(reduce(found), points)
    one = points[:, 0].detach().requires_grad_()
    (alone,) = torch.autograd.grad(reduce(getattr(spot_of_points(one, valid[0]), name)), one)
    assert torch.allclose(gradient[:, 0], alone, rtol=1e-12, atol=1e-15)
    assert (gradient[:, 1] == 0).all()


def test_a_mask_by_rays_makes_a_merit_finite_with_finite_second_derivatives():
    points, valid = batch_with_a_lost_spot()

    def merit(p):
        found = spot_of_points(p, valid)
        return torch.where(found.rays > 0, found.mean_square_radius, 7.0).sum()

    assert merit(points) > 7
    assert gradgradcheck(merit, points)
    assert torch.func.hessian(merit)(points.detach()).isfinite().all()


def test_a_lost_spot_can_be_an_error():
    points, valid = batch_with_a_lost_spot()
    with pytest.raises(EmptySpot, match=r"1 of 2 spots, first that of index \(1,\)"):
        spot_of_points(points, valid, empty="error")
    whole = spot_of_points(points[:, :1], valid[:1], empty="error")
    assert torch.equal(whole.rms_radius, spot_of_points(points, valid).rms_radius[:1])
    with pytest.raises(ValueError, match="expected 'nan' or 'error'"):
        spot_of_points(points, valid, empty="zero")


def test_rays_without_weight_make_no_spot():
    points, _ = batch_with_a_lost_spot()
    found = spot_of_points(points, torch.ones(2, 5, dtype=torch.bool), number([[1.0] * 5, [0.0] * 5]))
    assert found.rms_radius.isnan().tolist() == [False, True]


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

    assert gradcheck(statistics, points)
    assert gradgradcheck(lambda p: statistics(p)[:2], points)


def test_float32_keeps_its_digits():
    points = number([[1000.0, 1000.0 + 2**-13, 1000.0], [0.0, 0.0, 2**-13]])
    found = spot_of_points(points.float(), torch.ones(3, dtype=torch.bool))
    exact = spot_of_points(points, torch.ones(3, dtype=torch.bool)).rms_radius.item()
    assert found.rms_radius.item() == pytest.approx(exact, rel=1e-6)


def test_spot_of_rays_ignores_lost_ones():
    position = number([[0.0, 1.0, 77.0], [0.0, 0.0, 77.0], [0.0, 0.0, 0.0]])
    direction = torch.zeros_like(position)
    direction[2] = 1.0
    found = spot_of(Rays(position, direction, torch.tensor([True, True, False])))
    assert found.centroid.tolist() == [0.5, 0.0]
    assert found.rms_radius == found.geometric_radius == 0.5


def test_radii_about_another_point_follow_the_theorem_of_parallel_axes():
    """Mean square about a point = about the centroid + distance², and the largest radius is counted from there."""
    generator = np.random.default_rng(2)
    points, weights = number(generator.normal(size=(2, 3, 40))), number(generator.random(40))
    valid = torch.as_tensor(generator.random((3, 40)) < 0.8)
    about = number([[0.3], [-1.0]]).requires_grad_()
    own, other = (spot_of_points(points, valid, weights, about=at) for at in (None, about))
    torch.testing.assert_close(other.centroid, own.centroid)
    apart = ((own.centroid - about) ** 2).sum(0)
    torch.testing.assert_close(other.mean_square_radius, own.mean_square_radius + apart)
    torch.testing.assert_close(other.rms_radius**2, other.mean_square_radius)
    far = torch.where(valid, torch.hypot(*(points - about[..., None])), 0.0).amax(-1)
    torch.testing.assert_close(other.geometric_radius, far)
    gradient = torch.autograd.grad(other.mean_square_radius.sum(), about)[0]
    torch.testing.assert_close(gradient, (2 * (about - own.centroid)).sum(1, keepdim=True))


def test_the_command_takes_equal_weights_about_the_chief_ray(capsys):
    """`--weights equal --reference chief`: as the library has it, and not what the defaults give."""
    arguments = ["spot", "cooke_triplet", "--sampling", "hexapolar", "--rings", "6", "--json"]
    found = []
    for options in ([], ["--weights", "equal", "--reference", "chief"]):
        assert main([*arguments, *options]) == 0
        found.append(json.loads(capsys.readouterr().out))
    lens = read_lens(shipped("lenses") / "cooke_triplet.zmx")
    fields = torch.stack([lens.fields.x, lens.fields.y])
    expected = spot_of(image_rays(lens, hexapolar(6)[0]), about=chief_reference(lens, fields))
    radii = number([entry["rms_radius_um"] for entry in found[1]["results"]]).reshape(3, 3)
    torch.testing.assert_close(radii, 1e3 * expected.rms_radius, rtol=1e-12, atol=0)
    assert found[0]["reference"] == "centroid"
    assert all(a["rms_radius_um"] != b["rms_radius_um"] for a, b in zip(*(d["results"] for d in found), strict=True))
    assert main([*arguments, "--rays", "1000", "--reference", "chief"]) == 1


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::raytrace.UnfilledStop")
def test_spots_of_a_batch_are_those_of_its_lenses():
    """Irregular surfaces, some lenses clipped; and a batch of none."""
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="off", fields=[0], wavelengths=[0.5876])
    radius = 0.5 * float(rt.first_order(lens).entrance_pupil_diameter) + 0.3
    lens = lens.replace(1, apertures=(rt.system.Aperture("circular", (0.0, radius)),))
    rows = rt.tolerances(lens, "irregularity:3=0.5 element_decenter:1=1", compensators=[])
    errors = rt.tolerancing.draw_errors(rows, 3, seed=1)
    errors[0, -2:] = 0
    lenses = rt.tolerancing.perturbed(lens, rows, errors)
    for reference in ("centroid", "chief"):
        several = rt.spot(lenses, rings=4, reference=reference)
        clipped = (several.rays < several.launched).flatten(1).any(-1)
        for k in range(3):
            alone = rt.spot(rt.tolerancing.perturbed(lens, rows, errors[k]), rings=4, reference=reference)
            for name in ("rms_radius", "geometric_radius", "rays"):
                torch.testing.assert_close(getattr(several, name)[k], getattr(alone, name), rtol=1e-10, atol=0)
            torch.testing.assert_close(several.whole.rms_radius[k], alone.whole.rms_radius, rtol=1e-10, atol=0)
    assert bool(clipped.any())
    assert not bool(clipped.all())
    assert rt.spot(rt.tolerancing.perturbed(lens, rows, torch.zeros(0, len(rows)))).rms_radius.shape == (0, 1, 1)


@pytest.mark.parametrize("rings", [2, 3])
def test_a_field_that_loses_its_rays_changes_no_other(rings):
    """Few rings, of which every rule has a sum of its own: the fields that lose nothing keep theirs."""
    triplet = read_lens("cooke_triplet")
    alone, both = vector(0.0, 8.0), vector(0.0, 8.0, 80.0)
    with pytest.warns(LostRays):
        together = rt.spot(triplet, fields=both, rings=rings)
    with pytest.warns(LostRays):
        distance = rt.focus(triplet, fields=both, rings=rings).sensor_distance
    spots = rt.spot(triplet, fields=alone, rings=rings)
    torch.testing.assert_close(together.rms_radius[:2], spots.rms_radius, rtol=1e-12, atol=0)
    torch.testing.assert_close(together.centroid[:, :2], spots.centroid, rtol=1e-12, atol=1e-14)
    focus = rt.focus(triplet, fields=alone, rings=rings).sensor_distance
    torch.testing.assert_close(distance, focus, rtol=1e-13, atol=0)


def test_statistics_of_many_spots_are_those_of_each():
    """More points than are processed at once, some invalid, one spot dark."""
    generator = torch.Generator().manual_seed(2)
    points = torch.randn(2, 9, 3, 5000, generator=generator, dtype=torch.float64)
    valid = torch.rand(9, 3, 5000, generator=generator) > 0.2
    valid[4, 1] = False
    valid[:, :, 0] = False
    weights = torch.rand(5000, generator=generator, dtype=torch.float64)
    names = ("centroid", "mean_square_radius", "rms_radius", "geometric_radius")
    for about in (None, torch.randn(2, 9, 3, generator=generator, dtype=torch.float64)):
        several = spot_of_points(points, valid, weights, about=about)
        for k, j in ((0, 0), (4, 1), (8, 2)):
            alone = spot_of_points(
                points[:, k, j], valid[k, j], weights, about=None if about is None else about[:, k, j]
            )
            for name in names:
                torch.testing.assert_close(
                    getattr(several, name)[..., k, j], getattr(alone, name), rtol=1e-13, atol=0, equal_nan=True
                )
    k, j = 2, 1
    mask, share = valid[k, j], weights[valid[k, j]] / weights[valid[k, j]].sum()
    mean = (share * points[:, k, j, mask]).sum(-1)
    square = (share * ((points[:, k, j, mask] - mean[:, None]) ** 2).sum(0)).sum()
    found = spot_of_points(points, valid, weights)
    torch.testing.assert_close(found.centroid[:, k, j], mean, rtol=1e-12, atol=1e-15)
    torch.testing.assert_close(found.rms_radius[k, j], square.sqrt(), rtol=1e-13, atol=0)


@pytest.mark.parametrize("weighting", ["common", "each"])
def test_spots_that_lose_nothing_are_those_beside_a_lost_ray(weighting):
    """A lost ray changes the way to the numbers, not the numbers; the weights are common to all spots, or of each."""
    generator = torch.Generator().manual_seed(4)
    points = 1e3 + torch.randn(2, 5, 3, 40, generator=generator, dtype=torch.float64)
    weights = torch.rand(5, 3, 40, generator=generator, dtype=torch.float64)
    weights = weights[0, 0] if weighting == "common" else weights
    everywhere = torch.ones(5, 3, 40, dtype=torch.bool)
    all_arrive = spot_of_points(points, everywhere, weights)
    lost = torch.full((2, 5, 3, 1), torch.nan, dtype=torch.float64)
    more = torch.nn.functional.pad(weights, (1, 0), value=0.3)
    one_lost = spot_of_points(torch.cat([lost, points], -1), torch.nn.functional.pad(everywhere, (1, 0)), more)
    for name in ("centroid", "mean_square_radius", "rms_radius", "geometric_radius", "rays"):
        torch.testing.assert_close(getattr(all_arrive, name), getattr(one_lost, name), rtol=1e-13, atol=0)


@pytest.mark.parametrize("is_any_lost", [True, False])
def test_statistics_in_several_pieces_have_their_derivatives(monkeypatch, is_any_lost):
    monkeypatch.setattr("raytrace.tracing.spot._PIECE", 5)
    points = torch.randn(2, 3, 5, generator=torch.Generator().manual_seed(6), dtype=torch.float64, requires_grad=True)
    valid = torch.tensor([[True] * 5, [False, True, True, False, True], [True, False] * 2 + [True]])
    valid = valid if is_any_lost else torch.ones_like(valid)

    def figures(points):
        spots = spot_of_points(points, valid)
        return spots.centroid, spots.mean_square_radius, spots.rms_radius, spots.geometric_radius

    assert gradcheck(figures, (points,))
    assert gradgradcheck(figures, (points,))

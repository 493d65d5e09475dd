"""Results that analyses share within `computed_once`."""

import pytest
import torch

import raytrace as rt
from raytrace.analysis import cross_section
from raytrace.analysis.chief import distortion
from raytrace.maths.sampling import fan
from raytrace.system import lens as system_lens
from raytrace.system.lens import computed_once, media, shared
from raytrace.tracing.launch import launch, stop_radius
from raytrace.tracing.trace import lens_steps, points_on_surfaces
from raytrace.viewer.compute import refresh
from raytrace.viewer.state import initial


def test_within_a_result_is_computed_once_and_outside_each_time():
    calls = []

    @shared
    def twice(lens, wavelength):
        calls.append(wavelength)
        return 2 * wavelength

    lens, blue = rt.read_lens("cooke_triplet"), torch.tensor([0.48, 0.5])
    with torch.no_grad(), computed_once():
        assert twice(lens, blue) is twice(lens, blue.clone())
        assert [*map(len, (twice(lens, blue[:1]), twice(lens, blue[:, None])))] == [1, 2]
    with torch.no_grad():
        twice(lens, blue), twice(lens, blue)
    assert len(calls) == 5


def test_a_result_is_that_of_its_own_lens():
    first, second = rt.read_lens("cooke_triplet"), rt.read_lens("double_gauss")
    for compute in (rt.first_order, stop_radius):
        with torch.no_grad(), computed_once():
            numbers = [compute(lens) for lens in (first, second, first, second)]
        assert [*map(id, numbers[:2])] == [*map(id, numbers[2:])]
        assert str(numbers[0]) == str(compute(first)) != str(compute(second))


def test_no_result_is_shared_while_gradients_are_recorded():
    lens = rt.read_lens("cooke_triplet")
    lens = lens.replace(1, curvature=lens.surfaces[1].curvature.clone().requires_grad_())
    with computed_once():
        with torch.no_grad():
            assert not rt.first_order(lens).effective_focal_length.requires_grad
        assert rt.first_order(lens).effective_focal_length.requires_grad
        assert media(lens, lens.primary) is not media(lens, lens.primary)


def test_an_edited_lens_is_a_new_one():
    with torch.no_grad(), computed_once():
        lens = rt.read_lens("cooke_triplet")
        lengths = []
        for _ in range(20):  # numbers of a lens that is gone are not those of a new one in its place
            lens = lens.replace(1, curvature=1.01 * lens.surfaces[1].curvature)
            lengths.append(float(rt.first_order(lens).effective_focal_length))
    assert len(set(lengths)) == 20


@pytest.mark.parametrize("name", ["cooke_triplet", "phone"])
def test_the_numbers_of_the_viewer_are_those_without_sharing(name, monkeypatch):
    state = initial(rt.read_lens(name))
    together = refresh(state)
    monkeypatch.setattr("raytrace.viewer.compute.computed_once", torch.no_grad)
    assert refresh(state) == together


@pytest.mark.parametrize("name", ["cooke_triplet", "hubble", "folded_relay", "off_axis_telescope"])
def test_points_on_surfaces_are_those_of_the_crossings(name):
    rt.tracing.prepare()
    lens = rt.read_lens(name)
    wavelength = lens.primary
    rays = launch(lens, 0.9 * fan(2, "y", dtype=torch.float64)[0], fields=None, wavelengths=wavelength[None])
    points = points_on_surfaces(lens, rays, wavelength)
    assert points is not None
    for at, crossing in zip(points.unbind(1), lens_steps(lens, rays, wavelength), strict=True):
        torch.testing.assert_close(at, crossing.rays.position, rtol=1e-13, atol=1e-12)


def test_paths_with_a_lost_ray_are_traced_step_by_step():
    lens = rt.read_lens("cooke_triplet").at(fields=[40.0])
    rays = launch(lens, fan(5, "y", dtype=torch.float64)[0], wavelengths=lens.primary[None])
    assert points_on_surfaces(lens, rays, lens.primary) is None
    paths = cross_section.ray_paths(
        lens,
        fan(5, "y", dtype=torch.float64)[0],
        fields=torch.tensor([[0.0], [40.0]]),
        wavelength=lens.primary,
        z_start=-5.0,
    )
    assert {path.status for path in paths[0]} != {"ok"}


@pytest.mark.parametrize("name", ["cooke_triplet", "folded_relay"])
def test_a_public_function_shares_results_within_its_call(name, monkeypatch):
    """It evaluates indices less often than its parts do alone, for the same numbers; a variable lens shares nothing."""
    lens, evaluate, evaluations = rt.read_lens(name), system_lens._refractive_indices, []
    monkeypatch.setattr(system_lens, "_refractive_indices", lambda *its: evaluations.append(its) or evaluate(*its))

    def counted(compute, lens):
        evaluations.clear()
        return compute(lens).height, len(evaluations)

    (height, few), (expected, many) = counted(rt.distortion, lens), counted(distortion, lens)
    assert torch.equal(height, expected)
    assert few <= many / 2
    thickness = lens.surfaces[2].thickness.clone().requires_grad_()
    varied = lens.replace(2, thickness=thickness)
    (height, count), (expected, alone) = counted(rt.distortion, varied), counted(distortion, varied)
    assert count == alone
    slopes = [torch.autograd.grad(heights.sum(), thickness)[0] for heights in (height, expected)]
    assert slopes[0] == slopes[1] != 0

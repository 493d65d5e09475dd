"""A batch of lenses gives what a loop over its lenses gives, values and derivatives, in one call."""

import math
import warnings

import pytest
import torch

import raytrace as rt
from raytrace.system.sag_terms import GridSag

LENSES = ("cooke_triplet", "double_gauss", "phone")


@pytest.fixture(autouse=True)
def _quiet():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rt.UnfilledStop)
        yield


def perturbed(name, count=3, ray_aiming="off", posed=True):
    """A batch of lenses whose curvatures, thicknesses, conics, aspheric terms and poses differ."""
    lens = rt.focus(rt.read_lens(name).at(ray_aiming=ray_aiming)).lens
    error = torch.linspace(-1, 1, count, dtype=torch.float64)
    last = len(lens.surfaces) - 1
    for k, surface in enumerate(lens.surfaces[1:last], 1):
        change = {"thickness": surface.thickness * (1 + 1e-3 * k * error)}
        if surface.curvature is not None:
            change["curvature"] = surface.curvature * (1 + 1e-3 * error / k)
        if surface.conic is not None:
            change["conic"] = surface.conic + 1e-3 * error
        if surface.coefficients is not None:
            change["coefficients"] = surface.coefficients[:, None] * (1 + 1e-3 * error)
        lens = lens.replace(k, **change)
    if not posed:
        return lens
    lens = lens.replace(2, before=rt.system.Pose(y=0.002 * error, tilt_x=0.01 * error))
    return lens.replace(3, after=rt.system.Pose(tilt_x=-0.01 * error, tilts_first=True))


def psf_of(model, pixel=0.004):
    """Kernels (L, F, 21, 21), (F, 21, 21) of a single lens."""

    def kernels(lens):
        found = rt.psf(lens, model, pixel=pixel)
        return found.kernel if lens.count else found.kernel[0]

    return kernels


MODELS = {
    "paraxial": rt.psf_models.Paraxial(order=0),
    "fourier": rt.psf_models.Fourier(order=1),
    "gaussian": rt.psf_models.Gaussian(order=6),
}
MODELS |= {"wave": rt.psf_models.Wave(order=0)}

VERBS = {
    "effective focal length": lambda lens: rt.first_order(lens).effective_focal_length,
    "rays": lambda lens: rt.tracing.rays(lens).position.movedim(0, -1),
    "rms": lambda lens: rt.spot(lens).rms_radius,
    "centroid": lambda lens: rt.spot(lens).centroid.movedim(0, -1),
    "spots of all wavelengths": lambda lens: rt.spot(lens, reference="chief").whole.mean_square_radius,
    "wavefront": lambda lens: rt.wavefront(lens, size=31).rms,
    "zernike": lambda lens: rt.wavefront(lens, size=31, terms=9).coefficients,
    "strehl": lambda lens: rt.wavefront(lens, size=31).strehl,
    "geometric mtf": lambda lens: rt.mtf(lens, [30.0], geometric=True).tangential,
    **{f"psf {name}": psf_of(model) for name, model in MODELS.items()},
    "psf drt": psf_of(rt.psf_models.DRT(order=1), pixel=0.03),
    "trace": lambda lens: rt.trace(lens).position.movedim(0, -1),
    "hexapolar": lambda lens: rt.spot(lens, sampling="hexapolar", rings=4).mean_square_radius,
}


#: What takes seconds: sums of waves over a wide blur.
LONG = ("wavefront", "zernike", "strehl", "psf wave", "psf fourier")


#: Accuracy relative to the peak: dark pixels are small differences of waves, and all lenses of a batch have the Fourier
#: transform of the widest blur, whose error at order 1 this is.
OF_THE_PEAK = {"psf wave": 2e-9, "psf fourier": 2e-3}


def compare(verb, name, ray_aiming):
    lenses = perturbed(name, ray_aiming=ray_aiming, posed=verb not in ("psf paraxial", "psf fourier"))
    assert lenses.count == 3
    together = VERBS[verb](lenses)
    each = torch.stack([VERBS[verb](lenses[k]) for k in range(3)])
    if verb in OF_THE_PEAK:
        peak = each.amax((-1, -2), keepdim=True)
        assert float(((together - each).abs() / peak).max()) < OF_THE_PEAK[verb]
        return
    torch.testing.assert_close(together, each, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("verb", [verb for verb in VERBS if verb not in LONG])
def test_batch_is_a_loop(verb):
    compare(verb, "cooke_triplet", "off")


def test_the_beam_that_misses_the_stop_is_that_of_the_worst_lens():
    lens = rt.read_lens("cooke_triplet")
    gap = lens.surfaces[2].thickness + torch.tensor([0.0, 0.5], dtype=torch.float64)
    with warnings.catch_warnings(record=True) as of_batch:
        warnings.simplefilter("always")
        rt.spot(lens.replace(2, thickness=gap))
    with warnings.catch_warnings(record=True) as of_worst:
        warnings.simplefilter("always")
        for k in range(2):
            rt.spot(lens.replace(2, thickness=gap[k]))
    assert str(of_batch[0].message) in [str(one.message) for one in of_worst]


@pytest.mark.parametrize("verb", ["rms", "psf gaussian"])
def test_batch_of_aimed_rays_is_a_loop(verb):
    compare(verb, "cooke_triplet", "real")


@pytest.mark.slow
@pytest.mark.parametrize("ray_aiming", ["off", "real"])
@pytest.mark.parametrize("name", LENSES)
@pytest.mark.parametrize("verb", VERBS)
def test_batch_is_a_loop_for_all_lenses(verb, name, ray_aiming):
    compare(verb, name, ray_aiming)


def test_derivative_of_every_lens():
    error = torch.tensor([-0.01, 0.0, 0.02], dtype=torch.float64, requires_grad=True)
    lens = rt.read_lens("cooke_triplet")

    def merit(change):
        return rt.spot(lens.replace(2, thickness=lens.surfaces[2].thickness + change)).mean_square_radius

    (slopes,) = torch.autograd.grad(merit(error).sum(), error)
    for k in range(3):
        one = error[k].detach().clone().requires_grad_()
        (slope,) = torch.autograd.grad(merit(one).sum(), one)
        assert abs(float(slopes[k]) / float(slope) - 1) < 1e-10


def test_batch_of_lenses_in_a_list():
    lens = rt.read_lens("double_gauss")
    lenses = [lens.replace(1, radius=radius) for radius in (60.0, 61.0, 62.0)]
    found = rt.system.batch(lenses)
    assert found.surfaces[1].curvature.shape == (3,)
    assert found.surfaces[2].curvature is lens.surfaces[2].curvature
    assert torch.equal(rt.spot(found).rms_radius[1], rt.spot(lenses[1]).rms_radius)
    assert found[2].surfaces[1].curvature.shape == ()
    assert found[:2].count == 2
    assert [float(1 / one.surfaces[1].curvature) for one in found] == pytest.approx([60, 61, 62])


def test_wrong_batches_are_refused():
    lens, two = rt.read_lens("double_gauss"), torch.ones(2, dtype=torch.float64)
    with pytest.raises(ValueError, match=r"surface 1: .* 2 lenses, surface 2: .* 3"):
        lens.replace(1, thickness=two).replace(2, thickness=torch.ones(3, dtype=torch.float64)).at(ray_aiming="off")
    with pytest.raises(TypeError, match="a single lens"):
        lens[0]
    with pytest.raises(IndexError, match="lens 2 of a batch of 2"):
        lens.replace(1, thickness=two)[2]
    with pytest.raises(ValueError, match="no lenses"):
        rt.system.batch([])
    with pytest.raises(ValueError, match="lens 1 has other surfaces"):
        rt.system.batch([lens, rt.read_lens("singlet")])
    with pytest.raises(ValueError, match="one lens, not a batch"):
        rt.spot(lens.replace(1, thickness=8.0 + two)).plot()


def test_table_and_document_have_the_lens():
    lens = rt.read_lens("cooke_triplet").replace(2, thickness=torch.tensor([6.0, 6.1], dtype=torch.float64))
    spots = rt.spot(lens)
    frame = spots.to_frame()
    assert sorted(set(frame["lens"])) == [0, 1]
    assert len(frame) == spots.rms_radius.numel()
    assert spots.document()["results"][-1]["lens"] == 1
    assert "lens" in str(spots)


@pytest.mark.parametrize(
    "verb",
    [
        *(pytest.param(verb, marks=pytest.mark.slow) for verb in ("rms", "centroid")),
        "spots of all wavelengths",
        "psf gaussian",
    ],
)
def test_a_clipped_batch_is_a_loop(verb):
    """The pupil of every lens ends at its own rims."""
    lens = rt.read_lens("double_gauss").at(fields=[0, 10], ray_aiming="off")
    for k, radius in ((1, 20.0), (11, 16.0)):
        lens = lens.replace(k, apertures=(rt.system.Aperture("circular", (0.0, radius)),))
    gap = lens.surfaces[2].thickness + torch.tensor([0.0, 0.05, 0.1], dtype=torch.float64)
    lenses = lens.replace(2, thickness=gap)
    assert not bool(rt.spot(lens).arrivals.rays.valid.all())
    each = torch.stack([VERBS[verb](lenses[k]) for k in range(3)])
    torch.testing.assert_close(VERBS[verb](lenses), each, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize(
    "verb",
    [
        rt.relative_illumination, rt.seidel, rt.focus, rt.info, rt.mtf,
        lambda lenses: rt.mtf(lenses, [30.0], geometric=True, through_focus=0.1),
        lambda lenses: rt.spot(lenses, rays=1000),
        lambda lenses: rt.psf(lenses, object_distances=[1e3, 2e3, 3e3]),
    ],
)  # fmt: skip
def test_what_takes_one_lens_refuses_a_batch(verb):
    lens = rt.read_lens("cooke_triplet")
    with pytest.raises(ValueError, match="batch"):
        verb(lens.replace(2, thickness=torch.tensor([12.9, 13.0], dtype=torch.float64)))


def test_a_value_with_axes_of_its_own_is_no_batch():
    heights = torch.zeros(5, 7, dtype=torch.float64)
    grid = rt.read_lens("singlet").replace(1, sag_terms=GridSag(heights, torch.tensor(5.0, dtype=torch.float64)))
    assert grid.count is None


def test_orders_are_chosen_for_each_lens_and_distance_alone():
    """A PSF is that of a call for it alone, whatever the others need."""
    lens = rt.read_lens("tessar")
    bent = lens.replace(1, curvature=0.98 * lens.surfaces[1].curvature)
    together = rt.psf(rt.system.batch([lens, bent]), "gaussian", fields=[10.0])
    alone = [rt.psf(each, "gaussian", fields=[10.0]) for each in (lens, bent)]
    assert alone[0].order != alone[1].order
    assert torch.equal(together.kernel, torch.cat([each.kernel for each in alone]))
    distances = [1e4, math.inf, 500.0]
    together = rt.psf(lens, "gaussian", fields=[0.0], object_distances=distances)
    alone = [rt.psf(lens, "gaussian", fields=[0.0], object_distances=[distance]) for distance in distances]
    assert len({each.order for each in alone}) > 1
    assert torch.equal(together.kernel, torch.cat([each.kernel for each in alone]))
    assert together.order == max(each.order for each in alone)

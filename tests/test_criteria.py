"""Criteria of the lens as built: equal to functions of single lenses, exact gradients, the right way round."""

import pytest
import torch

import raytrace as rt
from raytrace.system.lens import aligned
from raytrace.tolerancing.criteria import Sampling, criterion_of

SMALL = "radius=0.02% thickness=0.005 element_decenter=0.005 element_tilt=0.01"

pytestmark = pytest.mark.filterwarnings("ignore::raytrace.UnfilledStop")

LIMITS = "radius=0.1% thickness=0.02 element_decenter=0.02 element_tilt=0.03"


@pytest.fixture(scope="module")
def triplet():
    """A Cooke triplet of f = 101 mm at F/8, focused for the fields of the tests."""
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="off", fields=[0, 5], f_number=8.0)
    return rt.focus(lens).lens


def sampling_of(lens):
    points = torch.stack([lens.fields.x, lens.fields.y])
    return Sampling(points, torch.full_like(points[0], 1 / points.shape[1]), *rt.maths.gauss_rings(4, 6))


def check_gradient(lens, word, **options):
    """The derivative of q of a batch by every error is that of differences of single lenses."""
    rows = rt.tolerances(lens, LIMITS)
    sampling = sampling_of(lens)
    criterion = criterion_of(word, lens, sampling, **options)

    def quantity(errors):
        return criterion.quantity(aligned(rt.tolerancing.perturbed(lens, rows, errors), 3), sampling)

    errors = rt.tolerancing.draw_errors(rows, 2, seed=3).requires_grad_()
    (slopes,) = torch.autograd.grad(quantity(errors).sum(), errors)
    step = 1e-3 * rows.maximum
    for k in range(2):
        moved = torch.cat([errors[k].detach() + side * torch.diag(step) for side in (1, -1)])
        values = quantity(moved)
        differences = (values[: len(rows)] - values[len(rows) :]) / 2
        torch.testing.assert_close(slopes[k] * step, differences, rtol=1e-4, atol=1e-4 * float(differences.abs().max()))


# -- MTF ---------------------------------------------------------------------------------------------------------------


def mtf_of(lens, frequency):
    found = rt.mtf(lens, [frequency], geometric=False)
    return float(0.5 * (found.tangential + found.sagittal).mean())


@pytest.mark.parametrize("frequency", [10.0, pytest.param(40.0, marks=pytest.mark.slow)])
def test_mtf_is_that_of_single_lenses(triplet, frequency):
    rows = rt.tolerances(triplet, LIMITS, compensators=[])
    errors = rt.tolerancing.draw_errors(rows, 3)
    sampling = sampling_of(triplet)
    criterion = criterion_of(f"mtf@{frequency:g}", triplet, sampling)
    values = criterion.value(criterion.quantity(aligned(rt.tolerancing.perturbed(triplet, rows, errors), 3), sampling))
    for k in range(3):
        assert float(values[k]) == pytest.approx(
            mtf_of(rt.tolerancing.perturbed(triplet, rows, errors[k]), frequency), abs=5e-4
        )


@pytest.mark.slow
def test_mtf_has_exact_derivatives(triplet):
    check_gradient(triplet, "mtf@30")


@pytest.mark.slow
def test_changes_of_the_mtf_are_those_of_single_lenses(triplet):
    rows = rt.tolerances(triplet, "radius:3=0.1%", compensators=[])
    found = rt.tolerance(triplet, rows, criterion="mtf@30", trials=0, fields=[0, 5])
    for n in range(len(rows)):
        for limit, change in ((rows.minimum[n], found.minimum[n]), (rows.maximum[n], found.maximum[n])):
            errors = torch.zeros(1, len(rows), dtype=torch.float64)
            errors[0, n] = limit
            alone = rt.tolerance(
                rt.tolerancing.perturbed(triplet, rows, errors[0]), rows, criterion="mtf@30", trials=0, fields=[0, 5]
            )
            assert float(found.nominal + change) == pytest.approx(float(alone.nominal), abs=1e-5)


@pytest.mark.slow
def test_mtf_as_built_reads_the_right_way_round(triplet):
    found = rt.tolerance(triplet, limits=LIMITS, criterion="mtf@20", trials=24)
    assert found.better == "larger"
    assert float(found.estimated) < float(found.expected) < float(found.nominal)
    assert float(found.expected) == pytest.approx(float(found.trials.mean()), rel=0.02)
    assert float(found.percentile(98)) < float(found.percentile(50)) < float(found.percentile(2))
    assert found.yield_at(float(found.percentile(80))) == pytest.approx(0.8, abs=0.05)
    assert found.yield_at(0.0) == 1
    assert found.yield_at(1.0) == 0
    worst = int(found.worst[0])
    assert float(torch.minimum(found.minimum, found.maximum)[worst]) == float(
        torch.minimum(found.minimum, found.maximum).min()
    )
    text = str(found)
    assert "larger is better" in text
    assert "share of the trials above a limit" in text
    assert found.summary()["worst"] == float(found.trials.min())


@pytest.mark.slow
def test_compensated_mtf_is_the_best_over_the_sensor_distance(triplet):
    rows = rt.tolerances(triplet, "thickness:3=0.05")
    found = rt.tolerance(triplet, rows, criterion="mtf@30", trials=0, fields=[0, 5])
    lens = rt.tolerancing.perturbed(triplet, rows, rows.maximum)
    sampling = sampling_of(lens)
    criterion = criterion_of("mtf@30", triplet, sampling)
    shifts = torch.linspace(-0.2, 0.2, 201, dtype=torch.float64)
    moved = lens.at(sensor_distance=float(lens.surfaces[-2].thickness)).replace(
        len(lens.surfaces) - 2, thickness=lens.surfaces[-2].thickness + shifts
    )
    best = float(criterion.value(criterion.quantity(aligned(moved, 3), sampling)).max())
    assert float(found.nominal + found.maximum.sum()) == pytest.approx(best, abs=2e-5)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("mtf", "expected a frequency in cycles/mm, as mtf@30"),
        ("mtf@many", "expected a frequency in cycles/mm, as mtf@30"),
        ("mtf@0", "0 cycles/mm: expected more than 0 and less than the cutoff"),
        ("mtf@400", "400 cycles/mm: expected more than 0 and less than the cutoff, 257"),
        ("wavefornt", "did you mean wavefront"),
    ],
)
def test_criteria_that_there_are_not(triplet, word, message):
    with pytest.raises(ValueError, match=message):
        rt.tolerance(triplet, limits=LIMITS, criterion=word, trials=0)


def test_mtf_of_a_clipped_beam_is_refused(triplet):
    clipped = triplet.replace(4, apertures=(rt.system.Aperture("circular", (0.0, 3.0)),))
    with pytest.raises(ValueError, match=r"rays of field .* are clipped or fail"):
        rt.tolerance(clipped, limits=LIMITS, criterion="mtf@20", trials=0)


# -- merit functions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["spot", pytest.param("wavefront", marks=pytest.mark.slow)])
def test_merit_is_that_of_single_lenses(triplet, kind):
    rows, sampling = rt.tolerances(triplet, LIMITS + " irregularity=0.5 index=0.0005"), sampling_of(triplet)
    errors = rt.tolerancing.draw_errors(rows, 2)
    criterion = criterion_of("merit", triplet, sampling, merit=kind)
    values = criterion.value(criterion.quantity(aligned(rt.tolerancing.perturbed(triplet, rows, errors), 3), sampling))
    for k in range(2):
        alone = rt.evaluate(rt.tolerancing.perturbed(triplet, rows, errors[k]), merit=kind)
        assert float(values[k]) == pytest.approx(float(alone.merit), rel=1e-9)


def test_merit_has_exact_derivatives(triplet):
    merit = rt.Merit.default(triplet, "spot") + rt.Merit((rt.system.Row("EFFL", (0, 2), target=100.0, weight=0.1),))
    check_gradient(triplet, "merit", merit=merit)


def test_evaluate_takes_a_batch(triplet):
    distance = torch.tensor([77.0, 77.4, 77.8], dtype=torch.float64, requires_grad=True)
    lenses = triplet.replace(7, thickness=distance)
    found = rt.evaluate(lenses, merit="spot")
    alone = [rt.evaluate(triplet.at(sensor_distance=float(d)), merit="spot") for d in distance]
    torch.testing.assert_close(found.merit.detach(), torch.stack([one.merit for one in alone]), rtol=1e-12, atol=0)
    torch.testing.assert_close(found.values, torch.stack([one.values for one in alone]), rtol=1e-10, atol=1e-13)
    (slope,) = torch.autograd.grad(found.merit.sum(), distance)
    ends = rt.evaluate(triplet.replace(7, thickness=distance.detach() + 1e-5), merit="spot").merit
    starts = rt.evaluate(triplet.replace(7, thickness=distance.detach() - 1e-5), merit="spot").merit
    torch.testing.assert_close(slope, (ends - starts) / 2e-5, rtol=1e-6, atol=0)
    assert "lost" in str(found)


@pytest.mark.slow
def test_merit_as_built(triplet):
    rows = rt.tolerances(triplet, "radius=0.1% element_decenter=0.02")
    found = rt.tolerance(triplet, rows, criterion="merit", merit="spot", trials=16)
    spread = float(found.trials.std()) / len(found.trials) ** 0.5
    assert abs(float(found.expected - found.trials.mean())) < 5 * spread
    assert float(found.nominal) < float(found.expected)
    with pytest.raises(rt.BadMerit, match="no merit function of its own"):
        rt.tolerance(triplet, rows, criterion="merit")
    with pytest.raises(ValueError, match="`merit` belongs to the criterion merit"):
        rt.tolerance(triplet, rows, merit="spot")


# -- PSF ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["gaussian", "drt"])
def test_change_of_the_psf_is_that_of_single_lenses(triplet, model):
    rows, sampling = rt.tolerances(triplet, LIMITS), sampling_of(triplet)
    errors = rt.tolerancing.draw_errors(rows, 2)
    criterion = criterion_of("psf", triplet, sampling, model=model, pixel=0.004, size=33)
    values = criterion.value(criterion.quantity(aligned(rt.tolerancing.perturbed(triplet, rows, errors), 3), sampling))
    numbers = {"gaussian": rt.psf_models.Gaussian, "drt": rt.psf_models.DRT}[model](order=criterion.settings[1])
    h0 = rt.psf(triplet, numbers, pixel=0.004, size=33).kernel
    for k in range(2):
        h = rt.psf(rt.tolerancing.perturbed(triplet, rows, errors[k]), numbers, pixel=0.004, size=33).kernel
        change = ((h - h0).square().sum((-2, -1)) / h0.square().sum((-2, -1))).mean().sqrt()
        assert float(values[k]) == pytest.approx(float(change), rel=1e-9 if model == "gaussian" else 5e-3)


@pytest.mark.slow
def test_change_of_the_psf_has_exact_derivatives(triplet):
    check_gradient(triplet, "psf", pixel=0.004, size=33)


@pytest.mark.slow
def test_change_of_the_psf_as_built(triplet):
    found = rt.tolerance(triplet, limits=SMALL, criterion="psf", trials=24, pixel=0.01, size=15)
    assert float(found.nominal) < 1e-9
    spread = float(found.trials.std()) / len(found.trials) ** 0.5
    assert float(found.expected) == pytest.approx(float(found.trials.mean()), abs=4 * spread)
    torch.testing.assert_close(found.slope.max(), found.maximum.max(), rtol=0.1, atol=0)
    with pytest.raises(ValueError, match="belong to the criterion psf"):
        rt.tolerance(triplet, limits=SMALL, pixel=0.01)
    with pytest.raises(ValueError, match="did you mean gaussian"):
        rt.tolerance(triplet, limits=SMALL, criterion="psf", model="gausian")


# -- boresight ---------------------------------------------------------------------------------------------------------


def test_boresight_is_that_of_the_chief_ray(triplet):
    found = rt.tolerance(triplet, limits=LIMITS, criterion="boresight", trials=200)
    assert float(found.nominal) == 0
    assert not bool(found.changes.any())
    for n in (int(found.worst[0]), int(found.worst[-1])):
        errors = torch.zeros(len(found.tolerances), dtype=torch.float64)
        errors[n] = found.tolerances.maximum[n]
        chief = (
            rt.trace(rt.tolerancing.perturbed(triplet, found.tolerances, errors), fields=0.0)
            .position[:2]
            .flatten(1)[:, 0]
        )
        assert 1e3 * float(torch.linalg.vector_norm(chief)) == pytest.approx(float(found.maximum[n]), abs=1e-9)
    spread = float(found.trials.std()) / len(found.trials) ** 0.5
    assert abs(float(found.expected - found.trials.mean())) < 4 * spread
    text = str(found)
    assert "compensator thickness of surface 7: it stays, as it has no effect" in text
    assert "as an angle, divided by the focal length, mrad: expected" in text
    assert found.angle == pytest.approx(1e-3 / float(rt.first_order(triplet).effective_focal_length))


def test_boresight_has_exact_derivatives(triplet):
    check_gradient(triplet, "boresight")


def test_boresight_of_a_decentred_lens_is_its_decentre(triplet):
    whole = rt.tolerancing.ToleranceTable((rt.system.Tolerance("element_decenter_y", (1, 7), -0.03, 0.03),))
    found = rt.tolerance(triplet, whole, criterion="boresight", trials=0)
    assert float(found.maximum[0]) == pytest.approx(30.0, abs=0.1)
    assert float(found.slope[0]) == pytest.approx(float(found.maximum[0]), rel=1e-5)


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("criterion", ["rms", "wavefront", "boresight"])
def test_surfaces_that_cross_are_traced_as_they_stand(triplet, criterion):
    """A gap of 2 mm with an error of -3 mm: rays go back by 1 mm, as in OpticStudio."""
    rows = rt.tolerancing.ToleranceTable((rt.system.Tolerance("thickness", (4,), -3.0, 3.0, adjust=6),))
    found = rt.tolerance(triplet, rows, criterion=criterion, trials=0)
    crossed = triplet.replace(4, thickness=-1.0).replace(6, thickness=float(triplet.surfaces[6].thickness) + 3.0)
    alone = rt.tolerance(crossed, rows, criterion=criterion, trials=0)
    assert float(found.nominal + found.minimum) == pytest.approx(float(alone.nominal), rel=1e-9, abs=1e-12)


def test_compensator_that_moves_nothing_is_refused(triplet):
    rows = rt.tolerances(triplet, "radius=0.1%", compensators=[rt.system.Compensator(5, "tilt_z")])
    with pytest.raises(rt.BadTolerance, match=r"no effect .*; leave it out"):
        rt.tolerance(triplet, rows, trials=0)

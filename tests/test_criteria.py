"""Criteria of the lens as built: equal to functions of single lenses, exact gradients, the right way round."""

import pytest
import torch

import raytrace as rt
from raytrace.system.lens import aligned
from raytrace.tolerancing.criteria import Sampling, criterion_of

pytestmark = pytest.mark.filterwarnings("ignore::raytrace.UnfilledStop")

LIMITS = "radius=0.1% thickness=0.02 element_decenter=0.02 element_tilt=0.03"


@pytest.fixture(scope="module")
def triplet():
    """A Cooke triplet of f = 101 mm at F/8, focused for the fields of the tests."""
    lens = rt.read_lens("cooke_triplet").at(ray_aiming="off", fields=[0, 5], f_number=8.0)
    return rt.focus(lens).lens


def sampling_of(lens):
    points = torch.stack([lens.fields.x, lens.fields.y])
    return Sampling(points, torch.full_like(points[0], 1 / points.shape[1]), *rt.gauss_rings(4, 6))


def check_gradient(lens, word, **options):
    """The derivative of q of a batch by every error is that of differences of single lenses."""
    rows = rt.tolerances(lens, LIMITS)
    sampling = sampling_of(lens)
    criterion = criterion_of(word, lens, sampling, **options)

    def quantity(errors):
        return criterion.quantity(aligned(rt.perturbed(lens, rows, errors), 3), sampling)

    errors = rt.draw_errors(rows, 2, seed=3).requires_grad_()
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


@pytest.mark.parametrize("frequency", [10.0, 40.0])
def test_mtf_is_that_of_single_lenses(triplet, frequency):
    rows = rt.tolerances(triplet, LIMITS, compensators=[])
    errors = rt.draw_errors(rows, 3)
    sampling = sampling_of(triplet)
    criterion = criterion_of(f"mtf@{frequency:g}", triplet, sampling)
    values = criterion.value(criterion.quantity(aligned(rt.perturbed(triplet, rows, errors), 3), sampling))
    for k in range(3):
        assert float(values[k]) == pytest.approx(mtf_of(rt.perturbed(triplet, rows, errors[k]), frequency), abs=5e-4)


def test_mtf_has_exact_derivatives(triplet):
    check_gradient(triplet, "mtf@30")


def test_changes_of_the_mtf_are_those_of_single_lenses(triplet):
    rows = rt.tolerances(triplet, "radius:3=0.1%", compensators=[])
    found = rt.tolerance(triplet, rows, criterion="mtf@30", trials=0, fields=[0, 5])
    for n in range(len(rows)):
        for limit, change in ((rows.minimum[n], found.minimum[n]), (rows.maximum[n], found.maximum[n])):
            errors = torch.zeros(1, len(rows), dtype=torch.float64)
            errors[0, n] = limit
            alone = rt.tolerance(
                rt.perturbed(triplet, rows, errors[0]), rows, criterion="mtf@30", trials=0, fields=[0, 5]
            )
            assert float(found.nominal + change) == pytest.approx(float(alone.nominal), abs=1e-5)


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
    lens = rt.perturbed(triplet, rows, rows.maximum)
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
    clipped = triplet.replace(4, apertures=(rt.Aperture("circular", (0.0, 3.0)),))
    with pytest.raises(ValueError, match=r"rays of field .* are clipped or fail"):
        rt.tolerance(clipped, limits=LIMITS, criterion="mtf@20", trials=0)

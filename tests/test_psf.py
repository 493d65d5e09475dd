"""One call for every PSF model: its contract and its derivatives."""

import dataclasses
import math
import warnings
from pathlib import Path

import pytest
import torch
from differences import gradcheck
from problems import field, number, sharp_double_gauss

import raytrace as rt
from raytrace.maths.sampling import Grid, grid
from raytrace.psf_models import DRT, EmptyPsf, Execution, Fourier, Gaussian, NotConverged, Paraxial, Wave, model_of, psf
from raytrace.system.lens import Lens, SystemAperture, with_object_distance, with_sensor_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.trace import trace_lens

LENSES = Path(__file__).parents[1] / "lenses"
TRACED = ("gaussian", "drt", "wave")
EVERY = ("paraxial", "fourier", *TRACED)
CHEAP = ("paraxial", "gaussian", "drt")  # what every kernel has in common needs no waves


def double_gauss(stop: float | None = None, sensor: float = 57.8817685) -> Lens:
    """That of `sharp_double_gauss`, in green."""
    return sharp_double_gauss(stop, sensor).at(wavelengths=[0.53])


def slow(lens: Lens) -> Lens:
    """The lens with a beam of 8 mm: few waves to sum."""
    return dataclasses.replace(lens, aperture=SystemAperture("entrance_pupil_diameter", number(8.0)))


def made_for(model: str, lens: Lens) -> Lens:
    return slow(lens) if model in ("fourier", "wave") else lens


def blocked(lens: Lens) -> Lens:
    return lens.replace(5, apertures=(Aperture("circular", (900.0, 901.0)),))


def rms(values: torch.Tensor) -> float:
    return float(values.square().mean().sqrt())


# Contract -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", CHEAP)
def test_shapes_and_description_of_the_result(model):
    result = psf(
        made_for(model, double_gauss()),
        model,
        fields=field(0.0, 2.0),
        object_distances=number([1e4, 25e3, math.inf]),
        grid=grid(0.01, (7, 9)),
        center="chief",
        tol=0.1,
    )
    assert result.kernel.shape == (3, 2, 7, 9)
    assert result.energy.shape == result.error.shape == (3, 2)
    assert result.centroid.shape == (2, 3, 2)
    assert result.covariance.shape == (3, 3, 2)
    assert result.grid.centre.shape == (2, 3, 2)
    assert (result.model, result.normalised) == (model, "energy")
    assert bool(torch.isfinite(result.kernel).all() and torch.isfinite(result.error).all())
    assert bool((result.error <= 0.1).all() and (result.error >= 0).all())
    torch.testing.assert_close(result.kernel.sum((-2, -1)), result.energy)
    assert result.rays > 0 if model in TRACED else result.rays == 0


@pytest.mark.parametrize("model", ["paraxial", "gaussian", "drt"])
def test_a_batch_is_its_single_kernels_in_the_order_asked_for(model):
    lens, distances = double_gauss(), (25e3, math.inf, 1e4)
    options = {"model": model, "grid": grid(0.02, 7), "tol": 1e-3}
    whole = psf(lens, object_distances=number(distances), fields=field(0.0), **options)
    for d, distance in enumerate(distances):
        one = psf(lens, object_distances=number([distance]), fields=field(0.0), **options)
        # Each meets the tolerance by itself, the batch by its worst entry.
        torch.testing.assert_close(whole.kernel[d], one.kernel[0], atol=1e-3, rtol=0)
        torch.testing.assert_close(whole.covariance[:, d], one.covariance[:, 0], atol=1e-12, rtol=2e-3)


def test_plain_numbers_are_as_good_as_tensors():
    numbers = {"fields": [0, (1, 2)], "object_distances": [25e3, math.inf], "wavelengths": [0.5, 0.6], "size": 7}
    tensors = {
        "fields": number([[0.0, 1.0], [0.0, 2.0]]),
        "object_distances": number([25e3, math.inf]),
        "wavelengths": number([0.5, 0.6]),
        "grid": grid(0.01, 7),
    }
    one, other = (
        psf(double_gauss(), Gaussian(order=3), center="axis", **o) for o in ({**numbers, "pixel": 0.01}, tensors)
    )
    torch.testing.assert_close(one.kernel, other.kernel, rtol=0, atol=0)
    with pytest.raises(ValueError, match="a grid has a pixel and a size"):
        psf(double_gauss(), "gaussian", grid=grid(0.01, 7), size=7)
    with pytest.raises(ValueError, match="below 90 degrees"):
        psf(double_gauss(), "gaussian", fields=[90])


def test_a_window_follows_the_chief_ray_unless_the_grid_is_given():
    """An off-axis kernel has its light; a grid with fields is the pixels of the sensor, about the axis."""
    lens, order = double_gauss(), Gaussian(order=3)
    chosen = psf(lens, order, fields=[0, 10])
    torch.testing.assert_close(chosen.kernel, psf(lens, order, fields=[0, 10], center="chief").kernel, rtol=0, atol=0)
    assert bool((chosen.energy > 0.05).all())
    fixed = psf(lens, order, fields=[10], grid=grid(0.005, 21))
    torch.testing.assert_close(fixed.grid.centre, number([0.0, 0.0]))


@pytest.mark.parametrize("per_wavelength", [False, True])
def test_a_psf_is_a_table_a_document_and_words(per_wavelength):
    options = {"fields": [0, (1, 2)], "object_distances": [25e3, math.inf], "wavelengths": [0.5, 0.6]}
    result = psf(double_gauss(), Gaussian(order=3), center="chief", per_wavelength=per_wavelength, **options)
    frame, entries = result.to_frame(), result.document()["results"]
    assert len(frame) == len(entries) == result.energy.numel() == (8 if per_wavelength else 4)
    for row, entry, line in zip(frame.itertuples(), entries, str(result).splitlines()[3:], strict=True):
        assert [row.field_x, row.field_y] == entry["field"]
        assert row.object_distance == (entry["object_distance"] or math.inf)
        assert [row.centroid_x, row.centroid_y] == entry["centroid"]
        assert (1e-3 * row.sigma_x_um) ** 2 == pytest.approx(entry["covariance"][0][0], rel=1e-12)
        assert row.energy == entry["energy"]
        assert f"{row.energy:.4f}" in line
        assert not per_wavelength or row.wavelength == entry["wavelength"]


def test_normalised_by_its_window_a_kernel_sums_to_one_and_keeps_the_energy():
    lens, where = double_gauss(), grid(0.005, 3)
    by_energy, by_window = (
        psf(lens, "gaussian", fields=field(0.0), object_distances=number([1e4]), grid=where, normalise=name)
        for name in ("energy", "window")
    )
    assert 0 < float(by_energy.energy) < 0.9
    torch.testing.assert_close(by_window.kernel.sum(), number(1.0))
    torch.testing.assert_close(by_window.energy, by_energy.energy)
    torch.testing.assert_close(by_window.kernel * by_energy.energy, by_energy.kernel)
    assert by_window.normalised == "window"


@pytest.mark.parametrize("model", ["paraxial", "gaussian", "drt"])
def test_centre_of_the_window_is_an_absolute_place_on_the_sensor(model):
    """Wherever the window is centred, the kernel's own mean, from absolute pixel places, is the same point."""
    lens, means = double_gauss(), []
    for center in ("chief", "centroid"):
        result = psf(
            lens,
            model,
            fields=field(3.0),
            object_distances=number([1e4]),
            grid=grid(0.02, 9),
            center=center,
            normalise="window",
            tol=0.1,
        )
        offset = (torch.arange(9, dtype=torch.float64) - 4) * 0.02
        mean_y = result.grid.centre[1, 0, 0] + (result.kernel[0, 0].sum(1) * offset).sum()
        means.append(float(mean_y))
    assert means[0] == pytest.approx(means[1], abs=3e-3)
    assert means[0] == pytest.approx(float(result.centroid[1, 0, 0]), abs=3e-3)


def test_chief_is_the_landing_point_of_the_chief_ray_and_centroid_the_mean_of_the_light():
    lens = with_object_distance(double_gauss(), 1e4)
    options = {"fields": field(0.0, 14.0), "object_distances": number([1e4]), "grid": grid(0.01, 5)}
    rays = trace_lens(lens, launch(lens, number([[0.0], [0.0]]), fields=field(0.0, 14.0)), lens.wavelengths[:, None])
    chief = psf(lens, "gaussian", center="chief", **options)
    torch.testing.assert_close(chief.grid.centre[:, 0], rays.position[:2, :, 0, 0], atol=1e-12, rtol=0)
    centroid = psf(lens, "gaussian", center="centroid", tol=1e-6, **options)
    torch.testing.assert_close(centroid.grid.centre, centroid.centroid, atol=1e-6, rtol=0)
    axis = psf(lens, "gaussian", **options)
    assert axis.grid.centre.tolist() == [0.0, 0.0]


def test_own_centre_of_the_grid_counts_from_the_point_asked_for():
    lens, shift = double_gauss(), number([0.01, -0.02])
    options = {"fields": field(4.0), "object_distances": number([1e4]), "center": "chief"}
    plain = psf(lens, "gaussian", grid=grid(0.01, 5), **options)
    moved = psf(lens, "gaussian", grid=grid(number(0.01), 5, shift), **options)
    torch.testing.assert_close(moved.grid.centre, plain.grid.centre + shift[:, None, None])
    torch.testing.assert_close(moved.kernel[..., 2:, :-1], plain.kernel[..., :-2, 1:], atol=1e-12, rtol=0)


@pytest.mark.parametrize("model", ["paraxial", "fourier", "gaussian", "drt"])
def test_polychromatic_kernel_is_the_weighted_sum(model):
    lens = made_for(model, double_gauss())
    options = {"fields": field(0.0), "object_distances": number([1e4]), "grid": grid(0.02, 5), "tol": 1e-3}
    blue, red = (psf(lens, model, wavelengths=number([w]), **options) for w in (0.48, 0.65))
    both = psf(lens, model, wavelengths=number([0.48, 0.65]), wavelength_weights=number([3.0, 1.0]), **options)
    torch.testing.assert_close(both.kernel, 0.75 * blue.kernel + 0.25 * red.kernel, atol=2e-4, rtol=0)
    torch.testing.assert_close(both.covariance, 0.75 * blue.covariance + 0.25 * red.covariance, rtol=5e-3, atol=1e-12)


def test_moments_of_a_polychromatic_kernel_hold_the_lateral_colour():
    """Cov = Σ w (Cov_w + offset_w²): with colours apart the whole is wider than the mean of its parts."""
    lens = double_gauss()
    options = {"fields": field(14.0), "object_distances": number([1e4]), "tol": 1e-4}
    parts = [psf(lens, "gaussian", wavelengths=number([w]), **options) for w in (0.48, 0.65)]
    both = psf(lens, "gaussian", wavelengths=number([0.48, 0.65]), **options)
    apart = 0.5 * (parts[0].centroid - parts[1].centroid)[1]
    expected = 0.5 * (parts[0].covariance[2] + parts[1].covariance[2]) + apart**2
    torch.testing.assert_close(both.covariance[2], expected, rtol=1e-4, atol=0)
    assert float(apart.abs()) > 1e-4


@pytest.mark.parametrize("model", ["gaussian", "drt"])
def test_energy_is_the_transmitted_share(model):
    """Of an aperture that clips the beam; the last of 4,000 rays along a radius that passes says how much."""
    lens = with_object_distance(double_gauss(stop=9.0), 1e4)
    radius = torch.linspace(0, 1, 4001, dtype=torch.float64)
    rays = trace_lens(
        lens, launch(lens, torch.stack([0 * radius, radius]), fields=field(0.0)), lens.wavelengths[:, None]
    )
    share = float(radius[rays.valid.flatten()].max()) ** 2
    assert 0.1 < share < 0.9
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)
        result = psf(lens, model, fields=field(0.0), grid=grid(0.1, 41), tol=0.01)
    # The step of the radius, 1/4000, is 4e-4 of the area.
    assert float(result.energy) == pytest.approx(share, abs=1e-3)


# Models chosen, rays counted ------------------------------------------------------------------------------------------


def test_auto_chooses_by_the_scene_and_gives_the_reason():
    options = {"fields": field(0.0), "tol": 0.1}
    far = psf(slow(double_gauss()), object_distances=number([1500.0]), grid=grid(0.5, 5), **options)
    assert far.model == "paraxial"
    assert "paraxial: its kernels differ from those of gaussian by" in far.reason
    sharp = psf(slow(double_gauss()), object_distances=number([25e3]), grid=grid(0.001, 5), **options)
    assert sharp.model == "wave"
    assert "\n" not in sharp.reason
    assert "more than 0.1" in sharp.reason


def test_auto_stays_with_rays_where_waves_are_too_many():
    """A spectrum of 26 mm: its light lands where a window's waves turn a thousand times."""
    with pytest.warns(NotConverged, match=r"drt: not compared with waves: .*\d+ pupil points"):
        result = rt.psf(rt.read_lens("spectrometer"), "auto", tol=0.5, size=9)
    assert result.model == "drt"
    assert "not compared with waves" in result.reason
    assert bool((result.kernel.sum((-1, -2)) > 0).all())


def test_number_of_rays_is_kept_to():
    options = {"fields": field(0.0), "object_distances": number([1e4]), "grid": grid(0.01, 11)}
    plain = psf(double_gauss(), DRT(rays=256), **options)
    assert plain.rays == 256
    assert 0.01 < float(plain.error) < 1
    few = psf(double_gauss(), Gaussian(rays=5), **options)
    assert few.rays <= 5
    with pytest.raises(ValueError, match="wave needs at least"):
        psf(slow(double_gauss()), Wave(rays=1), **options)
    with pytest.raises(ValueError, match=r"gaussian .*at least 2 rays .*1 requested"):
        psf(double_gauss(), Gaussian(rays=1), **options)


def test_an_order_repeats_the_result_of_a_tolerance():
    options = {"fields": field(14.0), "object_distances": number([1e4]), "center": "chief"}
    result = psf(double_gauss(), "gaussian", tol=1e-3, **options)
    again = psf(double_gauss(), Gaussian(order=result.order), **options)
    torch.testing.assert_close(again.kernel, result.kernel, atol=0, rtol=0)
    assert again.rays == result.rays
    assert bool(again.error.isnan().all())


def test_rho_and_zernike_reach_their_models():
    options = {"fields": field(0.0), "object_distances": number([1e4])}
    plain, narrow = (psf(double_gauss(), Paraxial(rho=rho), **options) for rho in (0.5, 0.25))
    torch.testing.assert_close(narrow.covariance, plain.covariance / 4)
    coma = number([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 2e-4])  # Noll 7
    options["grid"] = grid(0.02, 5)
    bent = psf(slow(double_gauss()), Fourier(zernike=coma), **options)
    assert float((bent.kernel - bent.kernel.flip(-2)).abs().sum()) > 1e-3
    assert float((bent.kernel - bent.kernel.flip(-1)).abs().sum()) < 1e-9


def test_a_tighter_tolerance_takes_more_rays_and_errs_less():
    options = {"fields": field(14.0), "object_distances": number([1e4]), "center": "chief"}
    loose, tight = (psf(double_gauss(), "gaussian", tol=t, **options) for t in (0.1, 1e-8))
    assert loose.rays < tight.rays
    assert float(tight.error) <= 1e-8 < float(loose.error) <= 0.1
    true = float((loose.covariance - tight.covariance)[2].abs() / (2 * tight.covariance[2]))
    assert true <= float(loose.error)


@pytest.mark.slow
def test_an_unreachable_tolerance_is_reported():
    with pytest.warns(NotConverged, match=r"gaussian: the estimated error .* 1e-11"):
        result = psf(double_gauss(stop=11.5), "gaussian", fields=field(14.0), object_distances=number([1e4]), tol=1e-11)
    assert float(result.error) > 1e-11
    assert "stays above" in result.reason


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"model": "geometric"}, "model 'geometric' is not known; expected auto, paraxial"),
        ({"model": "Huygens"}, "expected auto, .*wave; the diffraction PSF is wave"),
        ({"center": "middle"}, "center 'middle' is not known"),
        ({"normalise": "peak"}, "normalise 'peak' is not known"),
        ({"model": Gaussian(rays=5), "tol": 0.1}, "exclude each other"),
        ({"tol": 0.0}, "expected a number above 0"),
        ({"tol": math.nan}, "expected a number above 0"),
        ({"model": DRT(rays=0)}, "rays 0: expected"),
        ({"model": DRT(rays=2.5)}, "rays 2.5: expected a whole number"),
        ({"model": Gaussian(order=3), "tol": 0.1}, "an order fixes the amount of work: it excludes tol and rays"),
        ({"model": DRT(rays=5, order=3)}, "an order fixes the amount of work"),
        ({"model": Gaussian(order=99)}, "gaussian has no order 99; expected one of 2, 3, 4"),
        ({"fields": number([1.0, 2.0, 3.0])}, r"fields of shape \(3,\); expected \(2, F\)"),
        ({"object_distances": number(1e4)}, r"object_distances of shape .* expected one axis"),
        ({"object_distances": number([1e4, math.nan])}, "object_distances .* nan"),
        ({"wavelengths": number([0.5, 0.6]), "wavelength_weights": number([1.0])}, "1 wavelength_weights"),
        ({"wavelengths": number([0.5]), "wavelength_weights": number([0.0])}, "sum to 0"),
    ],
)
def test_arguments_that_make_no_sense_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        psf(double_gauss(), **{"model": "gaussian", **options})


def test_the_name_of_a_model_is_read_in_any_case():
    assert psf(double_gauss(), "Gaussian", fields=field(0.0)).model == "gaussian"


@pytest.mark.parametrize(
    ("name", "numbers", "message"),
    [
        ("auto", {"rays": 100}, "auto chooses by a tolerance"),
        ("paraxial", {"rays": 100}, "paraxial traces no rays"),
        ("geometric", {}, "model 'geometric' is not known; expected paraxial"),
    ],
)
def test_numbers_of_another_model_are_refused(name, numbers, message):
    with pytest.raises(ValueError, match=message):
        model_of(name, **numbers)


# Nothing arrives ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", TRACED)
def test_a_blocked_lens_is_an_error_and_a_dark_window_is_not(model):
    with pytest.raises(EmptyPsf, match="no ray reaches the sensor"):
        psf(blocked(double_gauss()), model, fields=field(0.0), object_distances=number([1e4]), grid=grid(0.01, 5))
    if model != "wave":
        where = grid(number(0.01), 5, number([3.0, 0.0]))
        beside = psf(double_gauss(), model, fields=field(0.0), object_distances=number([1e4]), grid=where)
        assert float(beside.energy) < 1e-12


@pytest.mark.parametrize("model", ["gaussian", "drt"])
def test_one_empty_kernel_of_a_batch_is_zero_with_derivative_zero(model):
    lens = slow(double_gauss(stop=3.0))
    far_out = field(0.0, 40.0)
    curvature = lens.surfaces[3].curvature.clone().requires_grad_()
    # A hole in front passes the beam of the axis, not that of 40°.
    lens = lens.replace(1, apertures=(Aperture("circular", (0.0, 5.0)),)).replace(3, curvature=curvature)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)
        result = psf(lens, model, fields=far_out, object_distances=number([1e4]), grid=grid(0.02, 5), tol=0.1)
    assert float(result.energy[0, 0].detach()) > 0
    assert float(result.energy[0, 1].detach()) == 0
    for tensor in (result.kernel, result.energy, result.error, result.centroid[..., 0], result.covariance[..., 0]):
        assert bool(torch.isfinite(tensor).all())
    (empty,) = torch.autograd.grad(result.kernel[0, 1].square().sum(), curvature, retain_graph=True)
    assert float(empty) == 0
    (whole,) = torch.autograd.grad(result.kernel.square().sum(), curvature)
    assert math.isfinite(float(whole))
    assert float(whole) != 0


@pytest.mark.parametrize(
    "model", [Gaussian(order=3), DRT(order=0), DRT(rays=200), Wave(order=-2)], ids=lambda model: type(model).__name__
)
def test_a_kernel_without_light_has_no_place_and_no_width(model):
    """nan, not 0: a width of 0 is what a merit likes best; the width of its neighbour keeps its derivative."""
    lens = double_gauss()
    curvature = lens.surfaces[1].curvature.clone().requires_grad_()
    lens = lens.replace(1, curvature=curvature)
    work = {"object_distances": number([25e3])}
    both = psf(lens, model, fields=field(0, 85), **work)
    for name in ("centroid", "covariance", "ray_centroid", "ray_covariance"):
        assert getattr(both, name)[:, 0, 1].isnan().all()
        assert getattr(both, name)[:, 0, 0].isfinite().all()
    assert both.energy[0, 1] == 0
    whole, lit = (
        torch.autograd.grad(total, curvature, retain_graph=True)[0]
        for total in (both.ray_covariance.nansum(), both.ray_covariance[:, 0, 0].sum())
    )
    assert whole == lit != 0
    with pytest.raises(EmptyPsf, match=r"1 of 2 PSFs, those of index \(0, 1\)"):
        psf(lens, model, fields=field(0, 85), execution=Execution(empty="error"), **work)
    with pytest.raises(EmptyPsf, match=r"144 rays .*86 missed surface 1, 58 .*surface 2"):
        psf(lens, model, fields=field(85), **work)


# Derivatives ----------------------------------------------------------------------------------------------------------


def with_numbers(lens: Lens, curvature, thickness, sensor) -> Lens:
    return with_sensor_distance(lens.replace(3, curvature=curvature).replace(4, thickness=thickness), sensor)


@pytest.mark.parametrize("model", ["paraxial", "fourier", pytest.param("gaussian", marks=pytest.mark.slow), "drt"])
def test_derivatives_in_the_lens_the_sensor_and_the_grid_with_rays_vignetted(model):
    lens = slow(double_gauss(stop=2.0)) if model in ("fourier", "wave") else double_gauss(stop=9.0)

    def kernel(curvature, thickness, sensor, pitch):
        changed = with_numbers(lens, curvature, thickness, sensor)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotConverged)
            return psf(
                changed,
                model,
                fields=field(2.0),
                object_distances=number([1e4]),
                grid=Grid(pitch, 3, 3, number([0.001, 3.55])),
                tol=0.3,
            ).kernel

    inputs = [lens.surfaces[3].curvature, lens.surfaces[4].thickness, lens.surfaces[-2].thickness, number(0.03)]
    inputs = [t.clone().requires_grad_() for t in inputs]
    traced = kernel(*inputs)
    assert float(traced.sum().detach()) > 0.05
    for t, gradient in zip(inputs, torch.autograd.grad(traced[0, 0, 1].square().sum(), inputs), strict=True):
        assert float(gradient.abs()) > 0, t
    # A kernel of `drt` is smooth in pieces: a curvature may change by less than the way to the next, 1e-8/mm.
    assert gradcheck(kernel, inputs, eps=1e-9, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_derivatives_in_the_object_distance_and_the_field():
    lens = double_gauss()

    def moments(distance, angle):
        result = psf(lens, "gaussian", object_distances=distance[None], fields=torch.stack([0 * angle, angle])[:, None])
        return result.centroid, result.covariance

    inputs = number(1e4).requires_grad_(), number(3.0).requires_grad_()
    assert gradcheck(moments, inputs, eps=1e-4, atol=1e-8, rtol=1e-3)


# Physics --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["paraxial", "fourier", "gaussian", "drt"])
def test_a_positive_field_lands_at_positive_y_at_f_tan_theta(model):
    """To the distortion of the design at 1°, 2e-5, and a fiftieth of a pixel."""
    lens = made_for(model, double_gauss(sensor=57.4851290372))
    result = psf(lens, model, fields=field(1.0), object_distances=number([math.inf]), center="chief", tol=0.05)
    height = float(first_order(lens).effective_focal_length) * math.tan(math.radians(1.0))
    assert float(result.centroid[1, 0, 0]) == pytest.approx(height, abs=1.5e-3)
    assert float(result.grid.centre[1, 0, 0]) == pytest.approx(height, abs=1.5e-3)
    assert float(result.centroid[0, 0, 0]) == pytest.approx(0.0, abs=1e-12)
    middle = result.kernel[0, 0, 6:15, 6:15].sum()
    assert float(middle) > 0.5 * float(result.energy)


@pytest.mark.parametrize("model", [Gaussian(order=2), DRT(order=0)])
def test_each_object_distance_may_have_its_own_field(model):
    lens, window = rt.read_lens("cooke_triplet"), {"pixel": 0.02, "size": 7}
    distances, fields = torch.tensor([2e3, 9e3]), torch.tensor([[[0.0], [3.0]], [[10.0], [-5.0]]], dtype=torch.float64)
    pairs = rt.psf(lens, model, fields=fields, object_distances=distances, **window)
    for k in range(2):
        alone = rt.psf(lens, model, fields=fields[:, k], object_distances=distances[k : k + 1], **window)
        assert float((pairs.kernel[k] - alone.kernel[0]).abs().max()) < 1e-12
        assert pairs.document()["results"][k]["field"] == fields[:, k, 0].tolist()
    assert pairs.columns()["field_y"].tolist() == [[10.0], [-5.0]]
    with pytest.raises(ValueError, match=r"expected \(2, F\), or \(2, 3, F\)"):
        rt.psf(lens, model, fields=fields, object_distances=[2e3, 9e3, 1e4], **window)

"""Sensor: pixels and their chief rays, spectral response, Bayer mosaic, and noise of the size asked for."""

import dataclasses
import importlib.util
import math

import pytest
import torch
from problems import draws

import raytrace as rt
from raytrace.imaging.spectral_response import GAUSSIANS
from raytrace.tracing.spot import chief_points

#: Lenses, and sensors whose corners have a chief ray.
LENSES = {
    "double_gauss": (36.0, 24.0),
    "cooke_triplet": (24.0, 16.0),
    "phone": (4.2, 2.8),
    "lenses/examples/scan_lens.zmx": (12.0, 12.0),
}


def sensor(**numbers) -> rt.Sensor:
    """A small one with pixels of 5 µm."""
    return rt.Sensor(**{"size": (0.04, 0.03), "pixels": (8, 6), **numbers})


def grid_of(one: rt.Sensor, count: int = 4) -> torch.Tensor:
    """Points (2, count, count) mm over the sensor, to its edges."""
    columns, rows = (torch.linspace(-0.5, n - 0.5, count, dtype=torch.float64) for n in one.pixels)
    return one.points(columns, rows[:, None])


def with_kind(lens: rt.Lens, kind: str) -> rt.Lens:
    """The lens on the axis alone, with another kind of field, without vignetting factors."""
    zero = torch.zeros_like(lens.fields.y[:1])
    return dataclasses.replace(lens, fields=rt.system.Fields(kind, zero, zero, zero + 1))


# -- pixels


def test_pixels_are_those_of_the_inverted_image():
    """Rows grow towards +y, columns towards -x, from the centre of the sensor."""
    one = rt.Sensor((24.0, 16.0), (4800, 3200), offset=(0.25, -0.5))
    assert one.pitch == pytest.approx(0.005, rel=1e-15)
    assert one.half_diagonal == pytest.approx(math.hypot(12, 8), rel=1e-15)
    x, y = one.points(torch.tensor([0, 4799, 2399.5]), torch.tensor([0, 3199, 1599.5])).tolist()
    assert x == pytest.approx([0.25 + 2399.5 * 0.005, 0.25 - 2399.5 * 0.005, 0.25], abs=1e-5)
    assert y == pytest.approx([-0.5 - 1599.5 * 0.005, -0.5 + 1599.5 * 0.005, -0.5], abs=1e-5)
    assert one.corners.tolist() == [
        pytest.approx([12.25, -11.75, 12.25, -11.75], abs=1e-12),
        pytest.approx([-8.5, -8.5, 7.5, 7.5], abs=1e-12),
    ]
    columns, rows = 4800 * draws(3, 4), 3200 * draws(3, 4, seed=1)
    found = one.pixel_of(one.points(columns, rows))
    torch.testing.assert_close(found, torch.stack([columns, rows]), atol=1e-9, rtol=0)


def test_a_picture_is_the_upright_view_of_the_scene():
    """An object at +x lies right of the middle of the picture, one at +y above it."""
    one = rt.Sensor((4.0, 4.0), (10, 10))
    lens = with_kind(rt.read_lens("double_gauss").at(object_distance=1e4), "object_height")
    right, up = one.landing(lens, torch.tensor([[100.0, 0.0], [0.0, 100.0]]).double()).T
    column, row = one.pixel_of(right).tolist()
    assert column > 6
    assert row == pytest.approx(4.5, abs=1e-9)
    column, row = one.pixel_of(up).tolist()
    assert column == pytest.approx(4.5, abs=1e-9)
    assert row < 3


# -- chief rays


@pytest.mark.parametrize("name", LENSES)
def test_fields_are_inverted_by_landing(name):
    lens, (width, height) = rt.read_lens(name), LENSES[name]
    one = rt.Sensor((width, height), (600, round(600 * height / width)))
    points = grid_of(one)
    fields = one.fields(lens, points)
    assert bool(torch.isfinite(fields).all())
    torch.testing.assert_close(one.landing(lens, fields), points, atol=1e-9, rtol=0)


@pytest.mark.parametrize("kind", ["angle", "object_height", "paraxial_image_height", "real_image_height"])
@pytest.mark.parametrize("distance", [math.inf, 2e3])
def test_fields_are_of_the_kind_of_the_lens(kind, distance):
    """Against chief rays that are launched at the fields found."""
    if kind == "object_height" and math.isinf(distance):
        pytest.skip("no heights of an object at infinity")
    lens = with_kind(rt.read_lens("double_gauss").at(object_distance=distance), kind)
    points = grid_of(rt.Sensor((24.0, 16.0), (600, 400)), 3).flatten(1)
    landed, valid = chief_points(lens, sensor().fields(lens, points), lens.primary[None])
    assert valid.all()
    torch.testing.assert_close(landed[..., 0], points, atol=1e-9, rtol=0)


def test_chief_rays_land_by_wavelength():
    lens = rt.read_lens("cooke_triplet")
    fields = torch.tensor([[0.0, 5.0, -8.0], [0.0, 12.0, 10.0]]).double()
    landed = sensor().landing(lens, fields, lens.wavelengths)
    expected, _ = chief_points(with_kind(lens, "angle"), fields, lens.wavelengths)
    torch.testing.assert_close(landed, expected, atol=1e-12, rtol=0)
    primary = landed[..., lens.primary_wavelength - 1]
    torch.testing.assert_close(sensor().landing(lens, fields), primary, atol=1e-12, rtol=0)
    assert float((landed[:, 2, 0] - landed[:, 2, 2]).norm()) > 1e-4  # lateral colour, mm


def test_points_without_a_chief_ray_are_nan_and_leave_the_others():
    lens = rt.read_lens("singlet")
    points = torch.tensor([[0.0, 1.0, 1e4, math.nan], [0.5, 0.0, 0.0, 0.0]]).double().requires_grad_()
    fields = sensor().fields(lens, points)
    assert fields.isnan().tolist() == [[False, False, True, True]] * 2
    landed = sensor().landing(lens, fields.detach())
    assert landed.isnan().tolist() == [[False, False, True, True]] * 2
    fields[:, :2].sum().backward()
    assert bool(torch.isfinite(points.grad).all())
    assert bool((points.grad[:, 2:] == 0).all())


def test_a_batch_of_lenses_has_fields_of_each():
    lens = rt.read_lens("double_gauss")
    both = rt.system.batch([lens, lens.at(sensor_distance=57.0)])
    points = grid_of(rt.Sensor((24.0, 16.0), (600, 400)), 3)
    fields = sensor().fields(both, points)
    assert fields.shape == (2, 2, 3, 3)
    for k in range(2):
        torch.testing.assert_close(fields[:, k], sensor().fields(both[k], points), atol=1e-11, rtol=0)


@pytest.mark.parametrize("name", ["double_gauss", "cooke_triplet"])
def test_derivatives_by_numbers_of_the_lens(name):
    """Of field points and of landing points, by a curvature and an air space, against central differences."""
    lens, points = rt.read_lens(name), torch.tensor([[-8.0, 3.0], [5.0, -6.0]]).double()
    one, fields = sensor(), torch.tensor([[4.0, -6.0], [-3.0, 5.0]]).double()

    def results(curvature, thickness):
        changed = lens.replace(2, curvature=curvature, thickness=thickness)
        return torch.stack([one.fields(changed, points), one.landing(changed, fields)])

    numbers = [getattr(lens.surfaces[2], name).detach() for name in ("curvature", "thickness")]
    found = torch.autograd.functional.jacobian(results, tuple(numbers))
    for k, step in enumerate((1e-7, 1e-4)):
        high, low = ([n + sign * step * (j == k) for j, n in enumerate(numbers)] for sign in (1, -1))
        expected = (results(*high) - results(*low)) / (2 * step)
        assert float(expected.abs().min()) > 0
        torch.testing.assert_close(found[k], expected, rtol=1e-5, atol=1e-7 * float(expected.abs().max()))


# -- spectral response


def test_weights_of_three_gaussians_sum_to_one():
    one, wavelengths = sensor(response="rgb"), torch.linspace(0.4, 0.7, 61, dtype=torch.float64)
    assert one.channels == ("r", "g", "b")
    weights = one.weights(wavelengths)
    torch.testing.assert_close(weights.sum(-1), torch.ones(3).double())
    for row, (centre, width) in zip(weights, GAUSSIANS.values(), strict=True):
        assert abs(float(wavelengths[row.argmax()]) - centre) < 0.005
        half = row > 0.5 * row.max()
        assert float(half.sum()) * 0.005 == pytest.approx(width, abs=0.006)


def test_a_grey_sensor_has_the_weights_of_the_lens():
    one, lens = sensor(), rt.read_lens("cooke_triplet")
    assert one.channels == ("grey",)
    assert one.weights([0.5, 0.6]).tolist() == [[0.5, 0.5]]
    weights = one.weights(lens.wavelengths, torch.tensor([1.0, 2.0, 1.0]))
    assert weights.tolist() == [[0.25, 0.5, 0.25]]


TABLE = {"wavelengths": (0.4, 0.5, 0.7), "sensitivities": ((0.0, 2.0, 0.0), (1.0, 1.0, 3.0))}


def test_tables_are_linear_between_their_wavelengths_and_zero_outside():
    one = sensor(response=TABLE)
    assert one.channels == ("channel 1", "channel 2")
    at = torch.tensor([0.3, 0.45, 0.6, 0.7, 0.8], dtype=torch.float64)
    first, second = one.weights(at)
    assert first.tolist() == pytest.approx([0, 0.5, 0.5, 0, 0], abs=1e-12)
    assert second.tolist() == pytest.approx([0, 1 / 6, 2 / 6, 3 / 6, 0], abs=1e-12)


def test_tables_of_all_spellings_are_one(tmp_path):
    table = sensor(response={**TABLE, "names": ("red", "dark")}).response
    for scale, header in ((1.0, "wavelength_um"), (1e3, "wavelength_nm")):
        path = tmp_path / f"{header}.csv"
        rows = zip(TABLE["wavelengths"], *TABLE["sensitivities"], strict=True)
        lines = [f"{header}, red, dark", *(f"{scale * at},{red},{dark}" for at, red, dark in rows), ""]
        path.write_text("\n".join(lines), "utf-8-sig")
        read = sensor(response=path).response
        assert read == sensor(response=str(path)).response
        assert read.names == table.names
        assert read.wavelengths == pytest.approx(table.wavelengths, rel=1e-15)
        assert read.sensitivities == table.sensitivities
    tensors = [torch.tensor(numbers, dtype=torch.float64) for numbers in TABLE.values()]
    assert sensor(response=tensors) == sensor(response=TABLE)


def test_plain_data_of_a_sensor_make_an_equal_one():
    for response in (None, "rgb", TABLE):
        one = sensor(response=response, full_well=1e4, read_noise=2.0, bits=10, offset=(1.0, 2.0))
        assert rt.Sensor(**dataclasses.asdict(one)) == one


@pytest.mark.skipif(importlib.util.find_spec("colour") is None, reason="needs the extra [colour]")
def test_measured_cameras():
    """Their maxima as measured; the Gaussians of "rgb" are the best ones for the Nikon's."""
    wavelengths = torch.linspace(0.38, 0.78, 81, dtype=torch.float64)
    nikon, sigma = (sensor(response=name) for name in ("Nikon 5100 (NPL)", "Sigma SDMerill (NPL)"))
    assert nikon.channels == sigma.channels == ("r", "g", "b")
    assert wavelengths[nikon.weights(wavelengths).argmax(-1)].tolist() == pytest.approx([0.595, 0.53, 0.46])
    assert wavelengths[sigma.weights(wavelengths).argmax(-1)].tolist() == pytest.approx([0.63, 0.59, 0.48])
    for row, (centre, width) in zip(nikon.response.sensitivities, GAUSSIANS.values(), strict=True):

        def missed(centre, width, row=row):
            gaussian = torch.exp(-4 * math.log(2) * ((wavelengths - centre) / width) ** 2)
            measured = torch.tensor(row).double()
            return float((measured - gaussian * (measured @ gaussian) / (gaussian @ gaussian)).square().sum())

        for move in (-0.002, 0.002):
            assert missed(centre, width) < missed(centre + move, width)
            assert missed(centre, width) < missed(centre, width + move)


@pytest.mark.skipif(importlib.util.find_spec("colour") is not None, reason="the extra [colour] is installed")
def test_a_measured_camera_names_the_extra_it_needs():
    with pytest.raises(ImportError, match=r"pip install 'raytrace\[colour\]'"):
        sensor(response="Nikon 5100 (NPL)")


# -- Bayer mosaic


def mosaics():
    return [sensor(response="rgb", mosaic=pattern) for pattern in ("RGGB", "BGGR", "GRBG", "GBRG")]


@pytest.mark.parametrize("one", mosaics(), ids=lambda one: one.mosaic)
def test_the_pattern_is_that_of_the_sensor_for_patches_at_any_origin(one):
    """Every channel of the image holds its own number: 1 red, 2 green, 3 blue."""
    image = torch.tensor([1.0, 2.0, 3.0]).double()[:, None, None].expand(3, 6, 8)
    whole = one.sample(image)
    assert whole.shape == (1, 6, 8)
    letters = "".join("RGB"[int(number) - 1] for number in whole[0, :2, :2].flatten())
    assert letters == one.mosaic
    origins = torch.tensor([[0, 0], [1, 0], [0, 1], [3, 1], [2, 3]])
    patches = one.sample(image[None, :, :3, :4].expand(5, 3, 3, 4), origins)
    for patch, (column, row) in zip(patches, origins.tolist(), strict=True):
        assert torch.equal(patch, whole[:, row : row + 3, column : column + 4])
        assert torch.equal(one.sample(image[:, :3, :4], (column, row)), patch)


@pytest.mark.parametrize("one", mosaics(), ids=lambda one: one.mosaic)
def test_demosaicing_is_bilinear(one):
    """Uniform colours are exact everywhere, linear ones off the border, and recorded values are kept."""
    row, column = torch.arange(6.0).double()[:, None], torch.arange(8.0).double()
    for origin in ((0, 0), (1, 0), (3, 5)):
        uniform = torch.tensor([1.0, 2.0, 3.0]).double()[:, None, None].expand(3, 6, 8)
        torch.testing.assert_close(one.demosaic(one.sample(uniform, origin), origin), uniform, atol=1e-14, rtol=0)
        linear = torch.stack([row + column, 2 * row - column, column - 3 * row])
        found = one.demosaic(one.sample(linear, origin), origin)
        torch.testing.assert_close(found[:, 1:-1, 1:-1], linear[:, 1:-1, 1:-1], atol=1e-13, rtol=0)
        mosaic = draws(2, 1, 6, 8)
        torch.testing.assert_close(one.sample(one.demosaic(mosaic, origin), origin), mosaic, atol=1e-15, rtol=0)


def test_mosaic_and_demosaicing_are_linear_with_the_transpose_as_gradient():
    one, origins = sensor(response="rgb", mosaic="GRBG"), torch.tensor([[1, 0], [2, 3]])
    for function, shape in ((one.sample, (2, 3, 5, 4)), (one.demosaic, (2, 1, 5, 4))):
        x, dx = draws(*shape).requires_grad_(), draws(*shape, seed=1)
        y = function(x, origins)
        weights = draws(*y.shape, seed=2)
        (gradient,) = torch.autograd.grad((weights * y).sum(), x)
        assert float((gradient * dx).sum()) == pytest.approx(float((weights * function(dx, origins)).sum()), rel=1e-12)
        torch.testing.assert_close(function(x + 2 * dx, origins), y + 2 * function(dx, origins))


# -- noise


@pytest.mark.parametrize("level", [0.02, 0.5])
@pytest.mark.parametrize("recorded", [False, True], ids=["Poisson", "Gaussian"])
def test_noise_has_the_mean_and_the_variance_of_shot_and_read_noise(level, recorded):
    """Within 5 standard errors; (level N + read²)/N² with N electrons at saturation."""
    full_well, read = 1000.0, 4.0
    one = sensor(full_well=full_well, read_noise=read)
    picture = torch.full((4, 1, 250, 200), level, dtype=torch.float64, requires_grad=recorded)
    noise = (one.capture(picture, seed=3) - level).detach()
    variance, count = (level * full_well + read**2) / full_well**2, noise.numel()
    assert abs(float(noise.mean())) < 5 * math.sqrt(variance / count)
    # The variance of a sample variance: (kurtosis excess + 2) σ⁴/n, with an excess of 1/(level N) for counts.
    spread = variance * math.sqrt((2 + 1 / (level * full_well)) / count)
    assert abs(float(noise.var()) - variance) < 5 * spread


def test_shot_noise_is_counted_in_whole_electrons_unless_a_gradient_is_recorded():
    one, picture = sensor(full_well=50), 0.5 * draws(2, 1, 6, 8).abs()
    electrons = 50 * one.capture(picture)
    torch.testing.assert_close(electrons, electrons.round(), atol=1e-12, rtol=0)
    recorded = 50 * one.capture(picture.requires_grad_()).detach()
    assert float((recorded - recorded.round()).abs().max()) > 0.1
    with torch.no_grad():
        assert torch.equal(one.capture(picture), electrons / 50)


def test_read_noise_without_a_full_well_is_relative():
    noise = sensor(read_noise=0.01).capture(torch.full((1, 250, 400), 0.5, dtype=torch.float64)) - 0.5
    assert float(noise.std()) == pytest.approx(0.01, rel=5 / math.sqrt(2 * noise.numel()))


@pytest.mark.parametrize("recorded", [False, True], ids=["Poisson", "Gaussian"])
def test_noise_depends_on_seed_and_index_alone(recorded):
    one = sensor(response="rgb", full_well=1000, read_noise=3.0)
    pictures = 0.5 + 0.1 * draws(4, 3, 6, 8)
    pictures = pictures.requires_grad_(recorded)
    whole = one.capture(pictures, index=[7, 8, 9, 10], seed=1)
    for part in ([2], [3, 0], [1, 2, 3, 0]):
        assert torch.equal(one.capture(pictures[part], index=[7 + k for k in part], seed=1), whole[part])
    assert torch.equal(
        one.capture(pictures.unflatten(0, (2, 2)), torch.tensor([[7, 8], [9, 10]]), 1).flatten(0, 1), whole
    )
    assert torch.equal(one.capture(pictures[2], index=9, seed=1), whole[2])
    strided = pictures.movedim(1, -1).contiguous().movedim(-1, 1)
    assert torch.equal(one.capture(strided, index=[7, 8, 9, 10], seed=1), whole)
    same = pictures[:1].expand(3, -1, -1, -1)
    for others in (one.capture(same, index=[7, 8, 9], seed=1), one.capture(same, index=[7, 8, 9], seed=2)):
        assert not torch.equal(others[0], others[1])
    assert not torch.equal(one.capture(pictures[:1], index=[7], seed=2), whole[:1])


def test_quantisation_passes_the_gradient_and_saturation_stops_it():
    one = sensor(bits=4)
    picture = torch.tensor([[[-0.1, 0.2, 0.61, 1.2]]], dtype=torch.float64, requires_grad=True)
    digital = one.capture(picture)
    assert (15 * digital.detach()).flatten().tolist() == pytest.approx([0, 3, 9, 15], abs=1e-12)
    (gradient,) = torch.autograd.grad(digital.sum(), picture)
    assert gradient.flatten().tolist() == [0, 1, 1, 0]
    continuous = sensor().capture(picture).detach()
    assert continuous.flatten().tolist() == [-0.1, 0.2, 0.61, 1.0]


def test_the_gradient_of_a_capture_is_that_of_its_numbers():
    """Of mosaic and noise, against central differences with the same random numbers; without quantisation."""
    one = sensor(response="rgb", mosaic="RGGB", full_well=1000, read_noise=3.0)
    picture, change = 0.3 + 0.4 * draws(2, 3, 6, 8).abs().clamp(max=1), draws(2, 3, 6, 8, seed=1)
    weights = draws(2, 1, 6, 8, seed=2)

    def total(x):
        return (weights * one.capture(x.requires_grad_(), seed=4, origin=(1, 1))).sum()

    (gradient,) = torch.autograd.grad(total(picture), picture)
    step = 1e-5
    picture = picture.detach()
    expected = (total(picture + step * change) - total(picture - step * change)) / (2 * step)
    assert float((gradient * change).sum()) == pytest.approx(float(expected.detach()), rel=1e-8)


def test_a_mosaic_is_captured_pixel_by_pixel():
    one = sensor(response="rgb", mosaic="BGGR", bits=8)
    pictures = torch.arange(2 * 3 * 4 * 4, dtype=torch.uint8).reshape(2, 3, 4, 4)
    origins = torch.tensor([[1, 0], [0, 1]])
    found = one.capture(pictures, origin=origins)
    torch.testing.assert_close(255 * found, one.sample(pictures.float(), origins))


# -- patches


def test_random_patches_lie_on_the_sensor_and_depend_on_seed_and_index_alone():
    one = rt.Sensor((0.05, 0.04), (10, 8))
    origins = one.random_patches(torch.arange(200), (3, 4), seed=5)
    assert origins.shape == (200, 2)
    assert origins.amin(0).tolist() == [0, 0]
    assert origins.amax(0).tolist() == [6, 5]  # 10 - 4 columns, 8 - 3 rows
    assert torch.equal(one.random_patches([150, 3], (3, 4), seed=5), origins[[150, 3]])
    assert not torch.equal(one.random_patches(torch.arange(200), (3, 4), seed=6), origins)
    # Uniform: each of 7 columns is expected 200/7 times.
    counts = origins[:, 0].bincount(minlength=7).double()
    assert float(((counts - 200 / 7) ** 2 / (200 / 7)).sum()) < 22.5  # χ² of 6 degrees of freedom, 0.1 %
    assert one.random_patches([0], (8, 10)).tolist() == [[0, 0]]


def test_centres_of_patches():
    one = sensor(offset=(0.001, 0.0))
    points = one.patch_points(torch.tensor([[0, 0], [4, 2]]), (3, 4))
    expected = one.points(torch.tensor([1.5, 5.5]), torch.tensor([1.0, 3.0]))
    torch.testing.assert_close(points, expected.double(), atol=1e-8, rtol=0)
    whole = one.patch_points(torch.tensor([[0, 0]]), (6, 8))
    assert whole.flatten().tolist() == pytest.approx([0.001, 0.0], abs=1e-15)


# -- errors

RGB = torch.full((3, 6, 8), 0.5)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: rt.Sensor((36, 24), (6000, 3000)), r"6 × 8 µm.*give size=\(36, 18\), or pixels=\(6000, 4000\)"),
        (lambda: rt.Sensor((35.9, 23.9), (7952, 5304)), r"give size=\(35.9, 23.94537\d*\)$"),
        (lambda: rt.Sensor((36, 0)), "size .*expected .*above 0"),
        (lambda: rt.Sensor(24.0), "size 24.0: expected"),
        (lambda: rt.Sensor(pixels=(10.5, 7)), "pixels .*whole numbers"),
        (lambda: rt.Sensor(offset=(0, math.nan)), "offset .*expected"),
        (lambda: rt.Sensor(full_well=-5), "full_well -5: expected electrons, above 0"),
        (lambda: rt.Sensor(full_well=math.nan), "full_well nan: expected electrons"),
        (lambda: rt.Sensor(read_noise=-1), "read_noise -1: expected 0"),
        (lambda: rt.Sensor(read_noise=2.5), "fraction of level 1.*full_well"),
        (lambda: rt.Sensor(bits=0), "bits 0: expected a whole number from 1"),
        (lambda: rt.Sensor(mosaic="RGBG", response="rgb"), "mosaic 'RGBG': expected none or .*RGGB"),
        (lambda: rt.Sensor(mosaic="RGGB"), 'with 1 channels.*response="rgb"'),
        (lambda: rt.Sensor(response="rbg"), 'response .rbg.: expected None, "rgb", a table.*Nikon'),
        (lambda: rt.Sensor(response="nothing.csv"), "no such file"),
        (lambda: rt.Sensor(response={"wavelength": [1]}), "a mapping of wavelength; expected"),
        (lambda: rt.Sensor(response=([0.4, 0.5], [[1.0]])), r"2 wavelengths and channels of \[1\] sensitivities"),
        (lambda: rt.Sensor(response=([400, 500], [[1.0, 1.0]])), "divide nm by 1000"),
        (lambda: rt.Sensor(response=([0.5, 0.4], [[1.0, 1.0]])), "sort the table"),
        (lambda: rt.Sensor(response=([0.4, 0.5], [[1.0, -1.0]])), "channel grey: expected sensitivities from 0"),
        (lambda: sensor(response="rgb").weights([1.55]), "channel r .*no response.*1.55 µm.*0.51.* to 0.70"),
        (lambda: sensor().weights([0.5], torch.ones(2)), "2 wavelength_weights; expected 1"),
        (lambda: sensor().capture(RGB), r"\(3, 6, 8\): expected \(..., 1, H, W\)"),
        (lambda: sensor(response="rgb").capture(RGB[:1]), r"\(..., 3, H, W\), the channels r, g, b"),
        (lambda: sensor(response="rgb").capture(RGB * math.nan), "144 pixels that are nan"),
        (lambda: sensor(response="rgb").capture((RGB * 9).int()), "its white is unknown"),
        (lambda: sensor(response="rgb").capture(RGB[None], index=[1, 2]), r"whole numbers \(1,\) from 0 up"),
        (lambda: sensor(response="rgb").capture(RGB[None], index=[-1]), "from 0 up"),
        (lambda: sensor(full_well=9).capture(RGB[:1], seed=-1), "seed -1: expected a whole number"),
        (lambda: mosaics()[0].capture(RGB[None], origin=torch.zeros(3, 2).long()), "one for each image"),
        (lambda: mosaics()[0].sample(RGB, (0.5, 1.0)), "expected whole"),
        (lambda: mosaics()[0].demosaic(RGB), r"expected \(..., 1, H, W\)"),
        (lambda: sensor().random_patches([0], 7), "7 × 7 pixels on a sensor of 6 × 8"),
        (lambda: sensor().fields("double_gauss", torch.zeros(3, 4)), r"points of shape \(3, 4\)"),
    ],
)
def test_wrong_input_is_one_clear_error(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_kinds_of_input_that_are_wrong():
    with pytest.raises(TypeError, match="response: 5; expected"):
        sensor(response=5)
    with pytest.raises(TypeError, match=r"Sensor.fields: `lens` is None"):
        sensor().fields(None, torch.zeros(2, 1))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wavelength,r\n400,1\n", r"table.csv:1: header 'wavelength,r'; expected wavelength_nm"),
        ("wavelength_nm,r\n400,1\n500,one\n", r"table.csv:3: '500,one'; expected 2 numbers"),
        ("wavelength_nm,r\n400,1\n\n500\n", r"table.csv:4: '500'; expected 2 numbers"),
        ("wavelength_nm,r\n", r"table.csv: response: 0 wavelengths"),
        ("wavelength_um,r\n400,1\n500,1\n", r"table.csv: .*divide nm by 1000"),
    ],
)
def test_a_wrong_table_is_named_with_its_line(tmp_path, text, message):
    (tmp_path / "table.csv").write_text(text, "utf-8")
    with pytest.raises(ValueError, match=message):
        sensor(response=tmp_path / "table.csv")


def test_points_on_the_diagonal_begin_at_the_middle_of_a_shifted_sensor():
    sensor = rt.Sensor((24, 16), (240, 160), offset=(1.0, -2.0))
    points = sensor.on_diagonal([0.0, 0.5, 1.0])
    assert points.T.tolist() == [[1.0, -2.0], [7.0, -6.0], [13.0, -10.0]]


def test_dark_frames_keep_the_mean_and_the_variance_of_their_noise():
    """25 e² of read noise and Δ²/12 of quantisation; without a black level the lower half would be cut."""
    dark = torch.zeros(1, 200, 300, dtype=torch.float64)
    one = rt.Sensor(size=(3.0, 2.0), pixels=(300, 200), full_well=2000, read_noise=5, bits=10)
    electrons = 2000 * one.capture(dark)
    step = 2000 * (1 + one.black) / 1023
    assert float(electrons.mean()) == pytest.approx(0, abs=0.1)
    assert float(electrons.var()) == pytest.approx(25 + step**2 / 12, rel=0.03)
    cut = 2000 * dataclasses.replace(one, black_level=0).capture(dark)
    assert float(cut.mean()) > 1.9
    assert float(one.capture(torch.ones_like(dark)).max()) == 1.0
    with pytest.raises(ValueError, match="black_level -1: expected 0 or more"):
        dataclasses.replace(one, black_level=-1)

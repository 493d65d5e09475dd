"""The MTF of slanted edges: of profiles known in closed form, and of a scene behind a lens and a sensor."""

import json
import math

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.tracing.spot import image_rays

PITCH = 0.004  # mm
ROWS, COLUMNS = 80, 64


def edge(angle, sigma, *, rows=ROWS, columns=COLUMNS):
    """A step from 0.2 to 0.8 behind a Gaussian of so many pixels, point-sampled."""
    turn = math.radians(angle)
    row, column = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (rows, columns)), indexing="ij")
    distance = (column - columns / 2 + 0.3) * math.cos(turn) - (row - rows / 2) * math.sin(turn)
    return 0.2 + 0.6 * (0.5 + 0.5 * torch.erf(distance / (sigma * math.sqrt(2))))


def of_gaussian(frequencies, sigma):
    return torch.exp(-2 * (math.pi * frequencies * PITCH * sigma) ** 2)


@pytest.mark.parametrize("angle", [3.0, 5.0, 8.0, -5.0, 20.0])
@pytest.mark.parametrize("sigma", [0.5, 1.0, 2.0])
def test_a_gaussian_is_measured_up_to_a_cycle_a_pixel(angle, sigma):
    found = rt.imaging.slanted_edge_mtf(edge(angle, sigma), PITCH)
    assert found.across == "x"
    assert found.angle == pytest.approx(angle, abs=5e-3)
    torch.testing.assert_close(found.mtf, of_gaussian(found.frequencies, sigma), rtol=0, atol=2e-3)
    assert float(found.frequencies[-1]) == pytest.approx(1 / PITCH)
    assert found.mtf50 == pytest.approx(math.sqrt(math.log(2) / 2) / (math.pi * sigma * PITCH), rel=5e-3)


def test_an_edge_along_the_rows_and_a_falling_one():
    upright = rt.imaging.slanted_edge_mtf(edge(5.0, 1.0), PITCH)
    lying = rt.imaging.slanted_edge_mtf(edge(5.0, 1.0).T, PITCH)
    falling = rt.imaging.slanted_edge_mtf(1 - edge(5.0, 1.0), PITCH)
    assert lying.across == "y"
    torch.testing.assert_close(lying.mtf, upright.mtf, rtol=0, atol=1e-12)
    torch.testing.assert_close(falling.mtf, upright.mtf, rtol=0, atol=1e-9)


def test_noise_of_one_percent_leaves_the_mtf():
    """A mean of 25 edges: each has noise of its own, which has no bias at half of the Nyquist frequency."""
    generator = torch.Generator().manual_seed(0)
    pictures = [edge(5.0, 1.0) + 0.006 * torch.randn(ROWS, COLUMNS, generator=generator).double() for _ in range(25)]
    found = [rt.imaging.slanted_edge_mtf(picture, PITCH) for picture in pictures]
    assert max(abs(one.angle - 5.0) for one in found) < 0.1
    quarter = 0.25 / PITCH
    mean = torch.stack([one.at(quarter) for one in found]).mean()
    assert float(mean) == pytest.approx(float(of_gaussian(torch.tensor(quarter), 1.0)), abs=0.01)


def test_sixteen_bits_are_decoded_and_floats_are_light():
    light = edge(5.0, 1.0)
    encoded = torch.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    levels = np.round(65535 * encoded.numpy()).astype(np.uint16)
    found, wanted = rt.imaging.slanted_edge_mtf(levels, PITCH), rt.imaging.slanted_edge_mtf(light, PITCH)
    frequencies = torch.linspace(0, 0.5 / PITCH, 9)
    torch.testing.assert_close(found.at(frequencies), wanted.at(frequencies), rtol=0, atol=2e-3)
    assert (
        float((rt.imaging.slanted_edge_mtf(encoded, PITCH).at(frequencies) - wanted.at(frequencies)).abs().max()) > 5e-3
    )


def test_the_derivative_by_the_picture():
    """Bins do not change, but where the fitted line moves a pixel over a border: none here."""
    picture, direction = edge(5.3, 1.0), torch.zeros(ROWS, COLUMNS, dtype=torch.float64)
    direction[30:50] = edge(5.3, 2.0)[30:50]
    direction -= direction.mean()

    def modulation(size):
        return rt.imaging.slanted_edge_mtf(picture + size * direction, PITCH).mtf[8]

    size = torch.zeros((), dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(modulation(size), size)
    step = 1e-7
    difference = float(modulation(step) - modulation(-step)) / (2 * step)
    assert abs(float(slope)) > 1e-3
    assert float(slope) == pytest.approx(difference, rel=1e-4)


@pytest.mark.parametrize(
    ("picture", "message"),
    [
        (torch.rand(40, 40, generator=torch.Generator().manual_seed(0)), "no edge: the light on both sides differs by"),
        (torch.ones(40, 40), "no edge: the light on both sides differs by 0"),
        (edge(0.0, 1.0), "expected 1 or more; turn it by about 5°"),
        (edge(45.0, 1.0, rows=40), "bins empty: expected an angle of a few degrees"),
        (edge(5.0, 1.0) * torch.linspace(0, 1, ROWS)[:, None].roll(40, 0) ** 4, "no straight edge"),
        (edge(5.0, 1.0, rows=15), r"picture of shape \(15, 64\): expected \(H, W\) of one channel, 16 pixels or more"),
        (edge(5.0, 1.0, columns=16, rows=60), "pixels from the border of the picture: expected 6 or more"),
        (edge(5.0, 1.0)[None], r"shape \(1, 80, 64\): expected \(H, W\)"),
        ((400 * edge(5.0, 1.0) - 60).clamp(0, 255).to(torch.uint8), "at level 0 or 255, clipped"),
        (edge(5.0, 1.0) / torch.zeros(ROWS, 1), "nan or infinite"),
    ],
)
def test_bad_pictures_are_one_clear_error(picture, message):
    with pytest.raises(ValueError, match=message):
        rt.imaging.slanted_edge_mtf(picture, PITCH)


def test_a_bad_pitch_is_an_error():
    with pytest.raises(ValueError, match=r"pitch 0.*in mm, above 0"):
        rt.imaging.slanted_edge_mtf(edge(5.0, 1.0), 0)


def test_table_document_and_figure(tmp_path):
    found = rt.imaging.slanted_edge_mtf(edge(5.0, 1.0), PITCH)
    assert "edge 5.00° from the columns, MTF50 46.86 cycles/mm" in str(found)
    assert list(found.to_frame().columns) == ["frequency", "mtf"]
    found.save(tmp_path / "edge.json")
    assert json.loads((tmp_path / "edge.json").read_text())["mtf50"] == pytest.approx(found.mtf50)
    found.plot(tmp_path / "edge.png")
    assert (tmp_path / "edge.png").stat().st_size > 1000


# -- the whole camera


def rendered(lens, model, height, across, *, pitch, fine, half=30, reach=16, angle=5.0):
    """A slanted edge behind a lens, on sensor pixels about an image height, and the field of its middle.

    It is rendered on pixels of pitch/fine and averaged over pixels: there the scene is not aliased, and the distortion
    interpolates it.
    """
    side = fine * 2 * (half + reach)
    sensor = rt.Sensor(size=(side * pitch / fine,) * 2, pixels=(side, side), offset=(0.0, height))
    turn = math.radians(angle)
    row, column = torch.meshgrid(*(torch.arange(side, dtype=torch.float64) - side / 2,) * 2, indexing="ij")
    scene = ((column * math.cos(turn) - row * math.sin(turn)) > 0.3).double()
    scene = 0.2 + 0.6 * (scene if across == "x" else scene.T)
    with torch.no_grad():
        image = rt.render(lens, scene[None], sensor=sensor, model=model).image[0]
    picture = image.unflatten(0, (-1, fine)).unflatten(2, (-1, fine)).mean((1, 3))
    return picture[reach:-reach, reach:-reach], sensor.fields(lens, torch.tensor([[0.0], [height]]))


def across_edge(lens, fields, frequencies, across, angle):
    """Modulation (K,) by rays of one field along the normal of an edge, at an angle in degrees from x or y."""
    points, weights = rt.maths.gauss_rings(40, 160)
    rays = image_rays(lens, points, fields=fields)
    shares = (weights * rays.valid[0]) * lens.wavelength_weights[:, None]
    x, y = (part[0] for part in rays.position[:2])
    first, second = (x, y) if across == "x" else (y, x)
    place = first * math.cos(math.radians(angle)) + second * math.sin(math.radians(angle))
    waves = torch.exp(2j * math.pi * frequencies[:, None, None] * place)
    return (waves * shares).sum((1, 2)).abs() / shares.sum()


@pytest.mark.parametrize(
    ("name", "model", "height", "across", "fine"),
    [
        pytest.param(*case, marks=() if case[:3] == ("double_gauss", "drt", 0.0) else pytest.mark.slow)
        for case in (
            ("double_gauss", "drt", 0.0, "x", 4),
            ("double_gauss", "drt", 12.0, "x", 4),
            ("double_gauss", "drt", 12.0, "y", 4),
            ("double_gauss", "wave", 0.0, "x", 2),
            ("double_gauss", "wave", 12.0, "x", 3),
            ("double_gauss", "wave", 12.0, "y", 3),
            ("cooke_triplet", "drt", 0.0, "y", 4),
            ("cooke_triplet", "drt", 14.0, "x", 2),
            ("cooke_triplet", "drt", 14.0, "y", 2),
            ("cooke_triplet", "wave", 0.0, "y", 2),
        )
    ],
)
def test_the_rendered_edge_has_the_mtf_of_the_lens_and_of_a_pixel(name, model, height, across, fine):
    """To 1 %, up to the Nyquist frequency, or from half of the pixels, whose scene is aliased beyond, to its half.

    Of rays across the edge, 5° from the section of `rt.mtf`, which for the coma of the triplet is 1 % apart.
    """
    lens, pitch = rt.focus(rt.read_lens(name)).lens, 0.006
    picture, fields = rendered(lens, model, height, across, pitch=pitch, fine=fine)
    found = rt.imaging.slanted_edge_mtf(picture, pitch)
    assert found.across == across
    below = found.frequencies <= (0.5 if fine == 4 else 0.25) / pitch
    frequencies = found.frequencies[below]
    curves = rt.mtf(lens, frequencies, fields=fields, geometric=model == "drt")
    of_lens = {"x": curves.sagittal, "y": curves.tangential}[across][0]
    if model == "drt":
        section = across_edge(lens, fields, frequencies, across, 0.0)
        torch.testing.assert_close(section, of_lens, rtol=0, atol=1e-4)
        of_lens = across_edge(lens, fields, frequencies, across, found.angle)
    turn = math.radians(found.angle)
    sinc = torch.sinc(frequencies * pitch * math.cos(turn)) * torch.sinc(frequencies * pitch * math.sin(turn))
    assert float(sinc.min()) < 0.95
    torch.testing.assert_close(found.mtf[below], of_lens * sinc, rtol=0, atol=0.01)

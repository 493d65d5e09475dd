"""Every public function that takes pictures, given all kinds of pictures: right, or one clear error."""

import numpy as np
import pytest
import torch
from problems import generator

import raytrace as rt
from raytrace.imaging.image import decoded
from raytrace.imaging.restoration import mean_square_error

GREY = torch.arange(2 * 24 * 24, dtype=torch.int64).reshape(2, 24, 24).mul(37).remainder(256).to(torch.uint8)
KERNEL = torch.full((3, 3), 1 / 9)
FILTER = rt.imaging.wiener(torch.fft.fft2(torch.nn.functional.pad(KERNEL, (0, 21, 0, 21))), 0.1)
MASKS = torch.stack([torch.ones(24, 24), torch.zeros(24, 24)])


def camera() -> rt.Camera:
    lens = rt.read_lens("double_gauss")
    return rt.Camera(rt.Variables(lens, "sensor"), rt.imaging.RedNet(), model="paraxial")


#: Function of pictures (B, H, W).
TAKEN = {
    "blur": lambda x: rt.imaging.blur(x, KERNEL),
    "blur_layers": lambda x: rt.imaging.blur_layers(x, MASKS, KERNEL.expand(2, 2, 3, 3)),
    "add_noise": lambda x: rt.imaging.add_noise(x, 0.1, generator=generator(0)),
    "add_shot_noise": lambda x: rt.imaging.add_shot_noise(x, 100, generator=generator(0)),
    "count_electrons": lambda x: rt.imaging.count_electrons(x, 100, generator=generator(0)),
    "digitise": lambda x: rt.imaging.digitise(x, 4),
    "power_spectrum": rt.imaging.power_spectrum,
    "cross_spectrum": lambda x: rt.imaging.cross_spectrum(x[None]).real,
    "restore": lambda x: rt.imaging.restore(x, FILTER),
    "restore_jointly": lambda x: rt.imaging.restore_jointly(x, FILTER.expand(2, 2, 24, 24)),
    "mean_square_error": lambda x: mean_square_error(x, x.flip(0)),
    "Camera.image": lambda x: camera().image(x, torch.tensor([10e3, 20e3])),
    "Camera.forward": lambda x: camera()(x, torch.tensor([10e3, 20e3])),
    "Camera.restore": lambda x: camera().restore(x[:, None]),
    "Camera.target": lambda x: camera().target(x),
    "RedNet": lambda x: rt.imaging.RedNet()(x[:, None]),
    "UNet": lambda x: rt.imaging.UNet()(x[:, None]),
}


#: Those that take light: integers are levels of sRGB.
LIGHT = ("Camera.image", "Camera.forward", "Camera.target")


@pytest.mark.parametrize("name", TAKEN)
def test_integers_are_read_as_0_to_1(name):
    """8 bits and 16 give what floating-point numbers in [0, 1] give; other integers have no known white."""
    levels = GREY.float() / 255
    wanted = TAKEN[name](decoded(levels) if name in LIGHT else levels)
    for given in (GREY, (GREY.int() * 257).to(torch.uint16)):
        torch.testing.assert_close(TAKEN[name](given), wanted, rtol=1e-5, atol=1e-6)
    assert float(wanted.detach().abs().max()) > 0
    if name != "mean_square_error":  # of two pictures
        with pytest.raises(ValueError, match=r"int64: .*expected .* picture.float\(\) / 255"):
            TAKEN[name](GREY.long())


@pytest.mark.parametrize("name", TAKEN)
def test_double_precision_is_kept(name):
    """Of floating-point pictures; the network keeps its own."""
    if name not in ("RedNet", "UNet"):  # which are torch modules in the precision of its weights
        assert TAKEN[name](GREY.double() / 255).dtype == torch.float64
    assert TAKEN[name](GREY.float() / 255).dtype == torch.float32


def test_arrays_are_pictures():
    assert torch.equal(rt.imaging.blur(np.asarray(GREY), KERNEL), rt.imaging.blur(GREY, KERNEL))


#: What is refused: (call, words of the error).
REFUSED = {
    "colours in a camera": (
        lambda: camera().image(torch.rand(3, 3, 24, 24), torch.tensor([10e3, 20e3, 30e3])),
        r"shape \(3, 3, 24, 24\) at 3 object distances: expected \(3, 1, H, W\)",
    ),
    "another number of distances": (
        lambda: camera().image(torch.rand(2, 24, 24), torch.tensor([10e3, 20e3, 30e3])),
        r"shape \(2, 24, 24\) at 3 object distances",
    ),
    "0 to 255 in a camera": (
        lambda: camera()(255 * torch.rand(1, 24, 24), torch.tensor([10e3])),
        r"values up to 25\d.*: expected 0 to 1, .*; divide it by the white level",
    ),
    "colours in the network": (
        lambda: rt.imaging.RedNet()(torch.rand(1, 3, 24, 24)),
        r"expected grey ones \(B, 1, H, W\)",
    ),
    "kernels of other colours": (
        lambda: rt.imaging.blur(torch.rand(3, 24, 24), KERNEL.expand(4, 3, 3)),
        r"picture of shape \(3, 24, 24\) and a kernel of shape \(4, 3, 3\): the axes .* do not broadcast",
    ),
    "layers of other colours": (
        lambda: rt.imaging.blur_layers(torch.rand(3, 24, 24), MASKS, KERNEL.expand(2, 4, 3, 3)),
        "a picture of 3 colours and kernels of 4",
    ),
    "layers of a picture without colours": (
        lambda: rt.imaging.blur_layers(torch.rand(24, 24), MASKS, KERNEL.expand(2, 1, 3, 3)),
        r"picture of shape \(24, 24\): expected \(..., C, H, W\)",
    ),
    "filters of other colours": (
        lambda: rt.imaging.restore(torch.rand(3, 24, 24), FILTER.expand(2, 24, 24)),
        "image of shape .* and a filter of shape .* do not broadcast",
    ),
    "a spectrum of one picture": (
        lambda: rt.imaging.power_spectrum(torch.rand(24, 24)),
        r"expected \(B, ..., rows, columns\)",
    ),
    "an integer kernel": (lambda: rt.imaging.blur(GREY, torch.ones(3, 3, dtype=torch.uint8)), "a kernel of uint8"),
    "errors of integers": (
        lambda: rt.imaging.psnr((GREY[0] - GREY[1]) ** 2),
        "a mean square error of uint8.*convert pictures",
    ),
    "complex numbers": (lambda: rt.imaging.blur(torch.fft.fft2(GREY.float()), KERNEL), "a picture of complex64"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_pictures_are_refused(name):
    call, words = REFUSED[name]
    with pytest.raises(ValueError, match=words):
        call()


def test_colours_are_a_batch_of_a_camera():
    """As the error teaches: each channel is blurred by the kernel of its picture's distance."""
    own, distances = camera(), torch.tensor([10e3, 20e3, 30e3])
    colours = torch.rand(3, 3, 24, 24, generator=generator(0))
    found = own.image(colours.flatten(0, 1), distances.repeat_interleave(3)).unflatten(0, (3, 3))
    for number, channels in enumerate(colours.unbind(1)):
        torch.testing.assert_close(found[:, number], own.image(channels, distances))
    one = own.image(colours[0, 0], distances)  # one picture at every distance
    torch.testing.assert_close(one, own.image(colours[:1, 0].expand(3, -1, -1), distances))

"""Image formation: a convolution with its adjoint, layers of depth, and noise of the size asked for."""

import math

import pytest
import torch
from differences import gradcheck
from problems import draws, gaussian, generator

from raytrace.imaging.image import (
    BOUNDARIES,
    COMPOSITIONS,
    EXTENSIONS,
    add_noise,
    add_shot_noise,
    blur,
    blur_layers,
    count_electrons,
    depth_masks,
    digitise,
    extend,
    transfer_functions,
    visible,
)

#: Rounding of an FFT of some hundred pixels of order one.
ROUNDING = 1e-13


def direct(picture: torch.Tensor, kernel: torch.Tensor) -> torch.Tensor:
    """Σ_ab h_ab x_(i - a, j - b), written out."""
    return torch.nn.functional.conv2d(picture[None, None], kernel.flip(-1, -2)[None, None])[0, 0]


@pytest.mark.parametrize("size", [(5, 5), (4, 7), (1, 3), (1, 1)])
def test_blur_is_a_convolution(size):
    picture, kernel = draws(3, 20, 17), draws(3, *size, seed=1)
    found = blur(picture, kernel)
    assert found.shape == (3, 20 - size[0] + 1, 17 - size[1] + 1)
    for one, x, h in zip(found, picture, kernel, strict=True):
        torch.testing.assert_close(one, direct(x, h), atol=ROUNDING, rtol=0)


@pytest.mark.parametrize("size", [(5, 5), (4, 7), (6, 2)])
@pytest.mark.parametrize("boundary", ["circular", "zero", "reflect"])
def test_borders(boundary, size):
    """Against a sum over an extended picture by torch's own padding."""
    picture, kernel = draws(12, 9), draws(*size, seed=1)
    (h, w), mode = size, {"circular": "circular", "zero": "constant", "reflect": None}[boundary]
    before, after = (h - 1 - h // 2, w - 1 - w // 2), (h // 2, w // 2)
    if mode:
        pads = (before[1], after[1], before[0], after[0])
        padded = torch.nn.functional.pad(picture[None, None], pads, mode=mode)[0, 0]
    else:  # torch's reflection leaves the border pixel out
        rows, columns = torch.cat([picture.flip(0), picture, picture.flip(0)]), picture.shape
        tiled = torch.cat([rows.flip(1), rows, rows.flip(1)], 1)
        padded = tiled[columns[0] - before[0] : 2 * columns[0] + after[0]]
        padded = padded[:, columns[1] - before[1] : 2 * columns[1] + after[1]]
    torch.testing.assert_close(blur(picture, kernel, boundary=boundary), direct(padded, kernel), atol=ROUNDING, rtol=0)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("size", [(3, 3), (4, 4), (5, 2), (8, 7)])
def test_a_point_in_the_middle_of_the_kernel_gives_the_picture_back(boundary, size):
    picture, kernel = draws(2, 9, 10), torch.zeros(size, dtype=torch.float64)
    kernel[size[0] // 2, size[1] // 2] = 1.0
    expected = visible(picture, size) if boundary == "valid" else picture
    torch.testing.assert_close(blur(picture, kernel, boundary=boundary), expected, atol=1e-15, rtol=0)


def test_a_point_becomes_the_kernel():
    point, kernel = torch.zeros(9, 9, dtype=torch.float64), draws(3, 3)
    point[4, 4] = 1.0
    torch.testing.assert_close(blur(point, kernel)[2:5, 2:5], kernel, atol=1e-15, rtol=0)


@pytest.mark.parametrize(("origin", "shift"), [("pixel", -0.5), ("grid", 0.0)])
def test_an_even_symmetric_kernel_shifts_by_half_a_pixel_unless_given(origin, shift):
    """A wave stays in phase, or lags by half a pixel: what a PSF on an even Grid does."""
    x = torch.arange(32, dtype=torch.float64)
    wave = (2 * math.pi * 3 / 32 * x).cos().expand(16, 32)
    kernel = gaussian(0.8, 6)
    weight = (kernel * torch.cos(2 * math.pi * 3 / 32 * (torch.arange(6, dtype=torch.float64) - 2.5))).sum()
    expected = weight * (2 * math.pi * 3 / 32 * (x - shift)).cos().expand(16, 32)
    found = blur(wave, kernel, boundary="circular", origin=origin)
    torch.testing.assert_close(found, expected, atol=ROUNDING, rtol=0)


@pytest.mark.parametrize("origin", ["pixel", "grid"])
@pytest.mark.parametrize(("shape", "size"), [((16, 16), (5, 5)), ((16, 15), (4, 4)), ((9, 12), (3, 6))])
def test_transfer_function_is_that_of_the_circular_blur(origin, shape, size):
    picture, kernel = draws(*shape), draws(2, *size, seed=1)
    expected = torch.fft.ifft2(torch.fft.fft2(picture) * transfer_functions(kernel, shape, origin=origin))
    assert float(expected.imag.abs().max()) < 1e-15 * float(expected.real.abs().max())
    found = blur(picture, kernel, boundary="circular", origin=origin)
    torch.testing.assert_close(found, expected.real, atol=ROUNDING, rtol=0)


def test_a_flat_picture_keeps_its_level_to_the_border():
    kernel = draws(7, 7)
    found = blur(torch.full((30, 30), 0.3, dtype=torch.float64), kernel / kernel.sum())
    torch.testing.assert_close(found, torch.full((24, 24), 0.3, dtype=torch.float64), atol=1e-15, rtol=0)


@pytest.mark.parametrize("boundary", ["valid", "reflect"])
def test_derivatives(boundary):
    inputs = [draws(2, n, n, seed=n).requires_grad_() for n in (7, 4)]
    assert gradcheck(lambda x, h: blur(x, h, boundary=boundary), inputs)


def test_an_extension_mirrors_at_both_borders_and_tapers_without_a_jump():
    line = torch.tensor([[1.0, 2.0, 5.0, 9.0]])
    assert extend(line, (1, 10), boundary="reflect").tolist() == [[1, 2, 5, 9, 9, 5, 2, 5, 2, 1]]
    assert extend(line, (1, 6), boundary="zero").tolist() == [[1, 2, 5, 9, 0, 0]]
    ramp = torch.linspace(0, 1, 40, dtype=torch.float64).expand(3, 40)
    tapered = extend(ramp, (3, 60), boundary="taper")
    jumps = (tapered - tapered.roll(1, -1)).abs()
    assert float(jumps.max()) < 0.1 < float((ramp - ramp.roll(1, -1)).abs().max())


def test_mismatched_shapes_are_refused():
    with pytest.raises(ValueError, match=r"9 × 3 pixels .* 8 × 8"):
        blur(torch.zeros(8, 8), torch.zeros(9, 3))
    with pytest.raises(ValueError, match="'wrap': expected valid, circular"):
        blur(torch.zeros(8, 8), torch.zeros(3, 3), boundary="wrap")
    with pytest.raises(ValueError, match=r"'grid' .* 4 × 3 .*odd sizes, or another boundary"):
        blur(torch.zeros(8, 8), torch.zeros(4, 3), origin="grid")
    with pytest.raises(ValueError, match=r"9 × 9 pixels .* 8 × 8"):
        transfer_functions(torch.zeros(9, 9), 8)
    with pytest.raises(ValueError, match="finite, ascending"):
        depth_masks(torch.zeros(4, 4), torch.tensor([500.0, 1000.0, math.inf]))
    with pytest.raises(ValueError, match="2 masks and kernels of 3 depths"):
        blur_layers(torch.zeros(1, 8, 8), torch.zeros(2, 8, 8), torch.zeros(3, 1, 3, 3))
    with pytest.raises(ValueError, match="0 bits"):
        digitise(torch.zeros(2), 0)


# --- layers of depth


PLANES = torch.tensor([0.0, 1.0, 1.5, 2.0], dtype=torch.float64)


@pytest.mark.parametrize("settings", [{}, {"softness": 0.1}, {"feather": 1.5}, {"softness": 0.2, "feather": 0.7}])
def test_masks_are_shares(settings):
    masks = depth_masks(3 * draws(2, 20, 15) - 0.5, PLANES, **settings)
    assert masks.shape == (2, 4, 20, 15)
    torch.testing.assert_close(masks.sum(-3), torch.ones(2, 20, 15, dtype=torch.float64), atol=1e-15, rtol=0)
    assert float(masks.min()) > -1e-15


def test_hard_masks_take_the_nearest_plane_and_soft_ones_approach_them():
    depth = 3 * draws(20, 15) - 0.5
    nearest = (depth - PLANES[:, None, None]).abs().argmin(0)
    hard = depth_masks(depth, PLANES)
    assert torch.equal(hard.argmax(0), nearest)
    assert set(hard.unique().tolist()) == {0.0, 1.0}
    at_planes = depth_masks(PLANES[:, None], PLANES, softness=0.025)[..., 0]
    torch.testing.assert_close(at_planes, torch.eye(4, dtype=torch.float64), atol=1e-4, rtol=0)  # 2 exp(-10)
    halfway = depth_masks(torch.full((1, 1), 1.25, dtype=torch.float64), PLANES, softness=0.025)[:, 0, 0]
    torch.testing.assert_close(halfway, torch.tensor([0, 0.5, 0.5, 0], dtype=torch.float64), atol=1e-4, rtol=0)


def scene() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """A colour picture, three layers, and kernels of three depths and colours."""
    masks = depth_masks(3 * draws(2, 24, 20, seed=4), PLANES[1:], feather=1.0)
    kernels = torch.stack([torch.stack([gaussian(0.5 + d + 0.3 * c, 7) for c in range(3)]) for d in range(3)])
    return draws(2, 3, 24, 20), masks, kernels


@pytest.mark.parametrize("composition", COMPOSITIONS)
@pytest.mark.parametrize("boundary", ["valid", "circular"])
def test_one_depth_everywhere_is_a_uniform_blur(composition, boundary):
    picture, masks, kernels = scene()
    for d in range(3):
        only = torch.zeros_like(masks)
        only[:, d] = 1.0
        found = blur_layers(picture, only, kernels, composition=composition, boundary=boundary)
        torch.testing.assert_close(found, blur(picture, kernels[d], boundary=boundary), atol=ROUNDING, rtol=0)
        if composition != "occlusion":  # blurred alike everywhere: masks do not matter
            found = blur_layers(picture, masks, kernels[d][None], composition=composition, boundary=boundary)
            torch.testing.assert_close(found, blur(picture, kernels[d], boundary=boundary), atol=ROUNDING, rtol=0)


@pytest.mark.parametrize("composition", COMPOSITIONS)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_layers_in_focus_give_the_picture(composition, boundary):
    picture, _, kernels = scene()
    masks = depth_masks(3 * draws(2, 24, 20, seed=4), PLANES[1:])
    kernels = torch.zeros_like(kernels)
    kernels[..., 3, 3] = 1.0
    expected = visible(picture, (7, 7)) if boundary == "valid" else picture
    found = blur_layers(picture, masks, kernels, composition=composition, boundary=boundary)
    torch.testing.assert_close(found, expected, atol=ROUNDING, rtol=0)


@pytest.mark.parametrize("composition", ["masked", "occlusion"])
def test_a_flat_scene_stays_flat_and_lost_light_darkens(composition):
    picture, masks, kernels = scene()
    flat = torch.full_like(picture, 0.4)
    found = blur_layers(flat, masks, 0.5 * kernels, composition=composition)
    torch.testing.assert_close(found, torch.full_like(found, 0.2), atol=ROUNDING, rtol=0)


def test_light_adds_up():
    picture, masks, kernels = scene()
    found = blur_layers(picture, masks, kernels, composition="sum", boundary="circular")
    torch.testing.assert_close(found.sum((-2, -1)), picture.sum((-2, -1)), rtol=1e-13, atol=0)


def test_a_blurred_near_edge_lies_over_the_sharp_background():
    """Two flat half planes: a in front and blurred, b behind and sharp, which continues behind a: α a + (1 - α) b."""
    masks = torch.zeros(2, 1, 40, dtype=torch.float64)
    masks[1, :, :20], masks[0, :, 20:] = 1.0, 1.0
    picture = 0.9 * masks[1] + 0.2 * masks[0]
    line = torch.exp(-0.5 * (torch.arange(-4, 5, dtype=torch.float64) / 2) ** 2)
    near, sharp = line[None] / line.sum(), torch.eye(9, dtype=torch.float64)[4][None]
    kernels = torch.stack([sharp, near])[:, None]
    found = blur_layers(picture[None], masks, kernels, boundary="reflect")[0]
    alpha = blur(masks[1], near, boundary="reflect")
    expected = 0.9 * alpha + 0.2 * (1 - alpha)
    torch.testing.assert_close(found, expected, atol=ROUNDING, rtol=0)
    # The other way round the sharp near edge hides all of the blurred background: no halo on either side.
    found = blur_layers(picture[None], masks, kernels.flip(0), boundary="reflect")[0]
    torch.testing.assert_close(found, picture, atol=ROUNDING, rtol=0)
    # By the sum the background keeps its light where the edge covers it, and none lies behind the edge: α - m of it.
    added = blur_layers(picture[None], masks, kernels, composition="sum", boundary="reflect")[0]
    torch.testing.assert_close(added - expected, 0.2 * (alpha - masks[1]), atol=ROUNDING, rtol=0)
    assert float(alpha[0, 20]) == pytest.approx(float(line[5:].sum() / line.sum()), abs=ROUNDING)


@pytest.mark.parametrize("composition", COMPOSITIONS)
def test_derivatives_of_layers(composition):
    picture, depth = draws(1, 6, 6), 2 * draws(6, 6, seed=1)
    kernels = torch.stack([gaussian(w, 3) for w in (0.5, 0.8, 1.2)])[:, None]

    def image(picture, depth, kernels):
        return blur_layers(picture, depth_masks(depth, PLANES[:3], softness=0.3), kernels, composition=composition)

    assert gradcheck(image, [x.requires_grad_() for x in (picture, depth, kernels)])


# --- the sensor


def test_noise_has_the_deviation_asked_for_and_repeats_with_its_seed():
    picture = torch.full((400, 400), 0.5, dtype=torch.float64)
    first, again = (add_noise(picture, 0.1, generator=generator()) for _ in range(2))
    assert torch.equal(first, again)
    # 160,000 draws: three deviations of the estimate are 0.0005 of the width, 0.00075 of the mean.
    assert float((first - picture).std()) == pytest.approx(0.1, abs=6e-4)
    assert float((first - picture).mean()) == pytest.approx(0.0, abs=1e-3)


def test_every_sample_has_an_independent_deviation():
    picture = torch.full((3, 1, 300, 300), 0.5, dtype=torch.float64)
    sigma = torch.tensor([0.001, 0.004, 0.01], dtype=torch.float64).reshape(3, 1, 1, 1)
    noise = add_noise(picture, sigma, generator=generator(6)) - picture
    torch.testing.assert_close(noise.std((-3, -2, -1)), sigma[:, 0, 0, 0], rtol=0.01, atol=0)


@pytest.mark.parametrize("noisy", [add_shot_noise, count_electrons])
def test_shot_noise_grows_with_the_light(noisy):
    """Mean x and variance x/N at four levels, 90,000 draws each: the variance to 2 % (four deviations)."""
    levels = torch.tensor([0.0, 0.1, 0.5, 1.0], dtype=torch.float64)
    found = noisy(levels[:, None].expand(4, 90_000), 50.0, generator=generator())
    assert torch.equal(found[0], torch.zeros(90_000, dtype=torch.float64))
    torch.testing.assert_close(found.mean(-1), levels, atol=2e-3, rtol=0)
    torch.testing.assert_close(found[1:].var(-1), levels[1:] / 50, rtol=0.02, atol=0)


def test_counts_are_whole_and_skewed_as_poisson():
    counts = 5 * count_electrons(torch.full((200_000,), 0.8, dtype=torch.float64), 5.0, generator=generator())
    torch.testing.assert_close(counts, counts.round(), atol=1e-12, rtol=0)
    assert float((counts == 0).to(torch.float64).mean()) == pytest.approx(math.exp(-4.0), rel=0.05)


def test_gradients_of_noise():
    picture = draws(3, 3).requires_grad_()
    assert gradcheck(lambda x: add_shot_noise(x, 100.0, generator=generator()), picture)
    dark = torch.tensor([0.0, -0.1, 0.2], dtype=torch.float64, requires_grad=True)
    for noisy in (add_shot_noise, count_electrons):
        (slope,) = torch.autograd.grad(noisy(dark, 100.0, generator=generator()).sum(), dark)
        assert bool(torch.isfinite(slope).all())
        assert slope[:2].tolist() == [1.0, 1.0]


def test_levels_of_the_digitiser_and_their_gradient():
    x = torch.tensor([-0.2, 0.0, 0.49 / 255, 0.51 / 255, 0.7, 1.0, 1.3], dtype=torch.float64, requires_grad=True)
    found = digitise(x, 8)
    expected = torch.tensor([0, 0, 0, 1, 178, 255, 255], dtype=torch.float64) / 255
    torch.testing.assert_close(found.detach(), expected, atol=1e-15, rtol=0)
    (slope,) = torch.autograd.grad(found.sum(), x)
    assert slope.tolist() == [0, 1, 1, 1, 1, 1, 0]
    fine = draws(100_000)
    assert float((digitise(fine, 4) - fine).std()) == pytest.approx(1 / 15 / math.sqrt(12), rel=0.01)


@pytest.mark.parametrize("boundary", EXTENSIONS)
def test_single_precision_stays_single(boundary):
    picture, kernel = draws(12, 9, dtype=torch.float32), gaussian(1.0, 4).to(torch.float32)
    found = blur(picture, kernel, boundary=boundary, origin="grid")
    assert found.dtype == torch.float32
    exact = blur(picture.to(torch.float64), kernel.to(torch.float64), boundary=boundary, origin="grid")
    torch.testing.assert_close(found.to(torch.float64), exact, atol=1e-6, rtol=0)

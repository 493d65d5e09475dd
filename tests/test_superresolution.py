"""Super-resolution: against the dense best linear estimate, drawn noise, and deconvolution at factor 1."""

import math

import pytest
import torch
from problems import covariance, draws, gaussian

from raytrace.imaging.image import blur, transfer_functions, visible
from raytrace.imaging.restoration import (
    depth_invariant_wiener,
    errors,
    mean_square_error,
    power_law,
    psnr,
    restore,
    within,
)
from raytrace.studies.pictures import dead_leaves
from raytrace.studies.superres.inversion import (
    bicubic,
    coarse_image,
    coarse_transfer,
    inversion,
    inversion_errors,
    joint_errors,
    joint_inversion,
    joint_superresolve,
    least_error,
    superresolve,
)


def places(*points: tuple[int, int, float], size: int = 9) -> torch.Tensor:
    """A kernel of points (row, column, share) around its middle."""
    kernel = torch.zeros(size, size, dtype=torch.float64)
    for row, column, share in points:
        kernel[size // 2 + row, size // 2 + column] = share
    return kernel


#: The picture at three places, apart by other than whole pixels of the sensor (2 pixels of the picture).
THREE = places((0, 0, 0.5), (0, 3, 0.3), (3, 1, 0.2))


def dense(kernel: torch.Tensor, size: tuple[int, int], factor: int) -> torch.Tensor:
    count = size[0] * size[1]
    points = torch.eye(count, dtype=torch.float64).reshape(count, *size)
    return coarse_image(points, kernel, factor, boundary="circular").reshape(count, -1).T


@pytest.mark.parametrize(("factor", "boundary"), [(1, "circular"), (2, "circular"), (2, "reflect"), (3, "valid")])
def test_a_pixel_of_the_sensor_averages_over_those_of_the_picture(factor, boundary):
    picture, kernel = draws(2, 16, 20), draws(5, 3, seed=1)
    blurred = blur(picture, kernel, boundary=boundary)  # 12 × 18 where valid
    expected = torch.nn.functional.avg_pool2d(blurred, factor)
    torch.testing.assert_close(coarse_image(picture, kernel, factor, boundary=boundary), expected, atol=1e-14, rtol=0)


@pytest.mark.parametrize(("size", "factor"), [((12, 12), 2), ((9, 12), 3), ((15, 9), 3), ((16, 8), 4)])
def test_transfer_folds_the_aliases(size, factor):
    """Y = 1/s² Σ_m T_m X_m: the image in the pixels is the image by frequencies, for even and odd sizes."""
    picture, kernel = draws(*size), draws(4, 5, seed=1)
    product = coarse_transfer(kernel, size, factor) * torch.fft.fft2(picture)
    rows, columns = size[0] // factor, size[1] // factor
    Y = sum(
        product[m * rows : (m + 1) * rows, l * columns : (l + 1) * columns]
        for m in range(factor)
        for l in range(factor)
    )
    image = coarse_image(picture, kernel, factor, boundary="circular")
    torch.testing.assert_close(torch.fft.ifft2(Y / factor**2), image.to(torch.complex128), atol=1e-13, rtol=0)


@pytest.mark.parametrize(("size", "factor"), [((8, 8), 2), ((9, 9), 3), ((6, 9), 3)])
def test_is_the_dense_best_linear_estimate(size, factor):
    """C⟨A⟩ᵀ(⟨A C Aᵀ⟩ + σ²)⁻¹ of two kernels, and the error of each as the trace of its matrix."""
    sigma, S = 0.1, power_law(size)
    kernels = draws(2, 4, 3, seed=1) / 12
    T, C = coarse_transfer(kernels, size, factor), covariance(S)
    A = torch.stack([dense(kernel, size, factor) for kernel in kernels])
    count, coarse = size[0] * size[1], (size[0] // factor, size[1] // factor)
    white = sigma**2 * torch.eye(A.shape[-2], dtype=torch.float64)
    best = C @ A.mean(0).T @ torch.linalg.inv((A @ C @ A.mT).mean(0) + white)
    image = draws(*coarse, seed=2)
    found = superresolve(image, inversion(T, S, sigma, factor), factor)
    torch.testing.assert_close(found.flatten(), best @ image.flatten(), atol=1e-11, rtol=0)
    left = best @ A - torch.eye(count, dtype=torch.float64)
    expected = torch.stack([(one @ C @ one.T + best @ white @ best.T).trace() / count for one in left])
    torch.testing.assert_close(inversion_errors(T, S, sigma, factor), expected, rtol=1e-11, atol=0)


def test_factor_one_is_deconvolution():
    kernels, S, sigma = draws(2, 5, 4, seed=1) / 20, power_law((12, 10)), 0.1
    H = transfer_functions(kernels, (12, 10))
    T = coarse_transfer(kernels, (12, 10), 1)
    torch.testing.assert_close(T, H, atol=1e-15, rtol=0)
    G = inversion(T, S, sigma, 1)
    torch.testing.assert_close(G, depth_invariant_wiener(H, S, sigma), atol=1e-14, rtol=0)
    torch.testing.assert_close(inversion_errors(T, S, sigma, 1), errors(H, S, sigma), rtol=1e-12, atol=0)
    image = draws(12, 10)
    torch.testing.assert_close(superresolve(image, G, 1), restore(image, G), atol=1e-14, rtol=0)
    torch.testing.assert_close(bicubic(image, 1), image, atol=1e-15, rtol=0)


@pytest.mark.parametrize("factor", [2, 3])
@pytest.mark.parametrize("blind", [True, False])
def test_closed_form_is_the_error_of_drawn_pictures_and_noise(factor, blind):
    """96 periodic pictures drawn of the spectrum, two kernels, colours: within 1 % of the closed form."""
    size, sigma = (72, 60), 0.02
    S = power_law(size, exponent=1.5)
    white = torch.randn(96, 1, 1, *size, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    pictures = torch.fft.ifft2(S.sqrt() * torch.fft.fft2(white)).real
    kernels = torch.stack([torch.stack([THREE, gaussian(0.8)]), torch.stack([gaussian(1.0), gaussian(2.0)])])
    T = coarse_transfer(kernels, size, factor)
    G = inversion(T if blind else T[:1], S, sigma, factor)
    image = coarse_image(pictures, kernels, factor, boundary="circular")
    image = image + sigma * torch.randn(image.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    found = mean_square_error(superresolve(image, G, factor), pictures).mean(0)
    torch.testing.assert_close(found, inversion_errors(T, S, sigma, factor, filter=G), rtol=0.01, atol=0)


def test_no_other_inversion_does_better():
    T, S = coarse_transfer(torch.stack([THREE, gaussian(1.0)]), 18, 3), power_law(18)
    G, best = inversion(T, S, 0.1, 3), inversion_errors(T, S, 0.1, 3).mean()
    change = torch.view_as_complex(draws(18, 18, 2, seed=7) - 0.5)
    rises = [float(inversion_errors(T, S, 0.1, 3, filter=G + t * change).mean() - best) for t in (1e-2, 2e-2)]
    assert rises[0] > 0
    assert rises[1] / rises[0] == pytest.approx(4.0, rel=1e-6)  # stationary, and quadratic


def test_a_picture_without_aliases_comes_back():
    """Only frequencies below the sensor's own, no noise: all of it, in place, at both factors."""
    x = torch.arange(24, dtype=torch.float64)
    picture = (2 * math.pi * x / 24).cos()[:, None] + (2 * math.pi * 2 * x / 24 + 1).sin()
    low = torch.fft.fft2(picture).abs() > 1e-9
    for factor in (2, 3):
        T = coarse_transfer(gaussian(0.7, 5)[None], 24, factor)
        image = coarse_image(picture, gaussian(0.7, 5), factor, boundary="circular")
        found = superresolve(image, inversion(T, low.to(torch.float64), 0.0, factor), factor)
        torch.testing.assert_close(found, picture, atol=1e-12, rtol=0)


def test_beats_bicubic_on_pictures_with_borders():
    """8 dead leaves by pixels twice as large, noise 0.005: PSNR over bicubic, measured 0.33 dB of a sharp lens, 1.96 dB
    of a blurred one, whose picture is the better by 0.26 dB: fewer aliases."""
    samples = dead_leaves(8, size=96).samples
    pictures = torch.stack([torch.as_tensor(sample) for sample in samples]).to(torch.float64) / 255
    noise = 0.005 * torch.randn(8, 44, 44, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    truth, found = visible(pictures, (9, 9)), []
    for kernel in (places((0, 0, 1.0)), gaussian(1.0)):
        image = coarse_image(pictures, kernel, 2) + noise
        G = inversion(coarse_transfer(kernel[None], 104, 2), power_law(104), 0.005, 2)
        for fine in (superresolve(image, G, 2, boundary="taper"), bicubic(image, 2)):
            found.append(float(psnr(mean_square_error(fine, truth, margin=4).mean())))
    assert found[0] > found[1] + 0.25
    assert found[2] > found[3] + 1.7
    assert found[2] > found[0] + 0.15


# --- what one image can tell, and several


def test_no_kernel_tells_more_from_one_image_than_the_strongest_alias():
    """Kernels of all kinds stay above the least error; an ideal low pass without noise reaches it."""
    S = power_law(24)
    for factor in (2, 3):
        least = least_error(S, factor)
        for kernel in (THREE, gaussian(1.0), places((0, 0, 1.0)), draws(9, 9, seed=1), draws(9, 9, seed=2) - 0.5):
            assert float(inversion_errors(coarse_transfer(kernel[None], 24, factor), S, 0.0, factor)) > float(least)
        aliases = S.reshape(factor, 24 // factor, factor, 24 // factor)
        low = (aliases == aliases.amax((0, 2), keepdim=True)).reshape(24, 24)
        # Where two aliases are equally strong, to see both is as good as to see one.
        torch.testing.assert_close(inversion_errors(1.0 * low[None] + 0j, S, 0.0, factor)[0], least, rtol=1e-12, atol=0)


@pytest.mark.parametrize(("size", "factor", "count"), [((8, 8), 2, 3), ((9, 6), 3, 2), ((8, 6), 2, 5)])
def test_joint_inversion_is_the_dense_best_linear_estimate(size, factor, count):
    """Two unknown sets of views: C⟨A⟩ᵀ(⟨A C Aᵀ⟩ + σ²)⁻¹ of stacked matrices, and the error of each set."""
    sigma, S = 0.1, power_law(size)
    kernels = draws(2, count, 4, 3, seed=1) / 12
    T, C = coarse_transfer(kernels, size, factor), covariance(S)
    A = torch.stack([torch.cat([dense(kernel, size, factor) for kernel in views]) for views in kernels])
    white = sigma**2 * torch.eye(A.shape[-2], dtype=torch.float64)
    best = C @ A.mean(0).T @ torch.linalg.inv((A @ C @ A.mT).mean(0) + white)
    images = draws(count, size[0] // factor, size[1] // factor, seed=2)
    G = joint_inversion(T, S, sigma, factor)
    found = joint_superresolve(images, G, factor)
    torch.testing.assert_close(found.flatten(), best @ images.flatten(), atol=1e-11, rtol=0)
    left = best @ A - torch.eye(C.shape[0], dtype=torch.float64)
    expected = torch.stack([(one @ C @ one.T + best @ white @ best.T).trace() / C.shape[0] for one in left])
    torch.testing.assert_close(joint_errors(T, S, sigma, factor), expected, rtol=1e-11, atol=0)


def test_one_view_is_no_view():
    kernels, S = torch.stack([THREE, gaussian(1.0)]), power_law(18)
    T = coarse_transfer(kernels, 18, 3)
    one, G = inversion(T, S, 0.1, 3), joint_inversion(T[:, None], S, 0.1, 3)
    torch.testing.assert_close(G[0], one, atol=1e-13, rtol=0)
    torch.testing.assert_close(joint_errors(T[:, None], S, 0.1, 3), inversion_errors(T, S, 0.1, 3), rtol=1e-12, atol=0)
    colours = torch.stack([T, T.flip(0)], 1)[:, :, None]  # (Z, colours, 1, rows, columns)
    expected = inversion_errors(colours[:, :, 0], S, 0.1, 3)
    torch.testing.assert_close(joint_errors(colours, S, 0.1, 3), expected, rtol=1e-12, atol=0)


def test_a_kernel_of_several_places_tells_aliases_of_a_small_scene_apart():
    """A scene on a dark ground at four places of one sensor, each at another half of a pixel: its views lie apart.

    Each has a quarter of the light, against a sharp lens with all of it; noise 0.001. Measured: 19.1 dB of the lens,
    29.6 dB jointly; by the closed form 19.7 and 30.5 dB.
    """
    sigma = 0.001
    scene = torch.as_tensor(dead_leaves(1, size=64).samples[0]).to(torch.float64) / 255
    fade = torch.sin(math.pi * (torch.arange(64) + 0.5) / 64).clamp(max=0.5) * 2
    scene = torch.nn.functional.pad(scene * fade[:, None] * fade, (16, 16, 16, 16))  # 96 × 96
    apart = [(-48, -48), (-48, 49), (49, -48), (49, 49)]
    wide = places(*[(row, column, 0.25) for row, column in apart], size=101)
    sensor = coarse_image(torch.nn.functional.pad(scene, (54, 54, 54, 54)), wide, 2, boundary="circular")
    noise = sigma * torch.randn(sensor.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    views = torch.stack([(sensor + noise)[27 + r // 2 : 75 + r // 2, 27 + c // 2 : 75 + c // 2] for r, c in apart])
    parts = torch.stack([places((row % 2, column % 2, 0.25)) for row, column in apart])
    S = power_law(96)
    T = coarse_transfer(parts[None], 96, 2)
    found = joint_superresolve(views, joint_inversion(T, S, sigma, 2), 2)
    lens = places((0, 0, 1.0))
    alone = coarse_image(scene, lens, 2, boundary="circular") + noise[:48, :48]
    plain = superresolve(alone, inversion(coarse_transfer(lens[None], 96, 2), S, sigma, 2), 2)
    left = [float(psnr(mean_square_error(x, scene, margin=16))) for x in (plain, found)]
    assert left[1] > left[0] + 8
    expected = [inversion_errors(coarse_transfer(lens[None], 96, 2), S, sigma, 2), joint_errors(T, S, sigma, 2)]
    assert float(expected[1]) < 0.1 * float(expected[0])
    assert float(expected[1]) < float(least_error(S, 2)) < float(expected[0])


def test_bicubic_keeps_parabolas_in_place():
    """x² at the middles of fine pixels from coarse samples, away from the borders: exact, so nothing is shifted."""
    for factor in (2, 3):
        x = torch.arange(12, dtype=torch.float64)
        image = (0.1 * x**2 - x)[:, None] + 0.05 * x**2
        fine = (torch.arange(12 * factor, dtype=torch.float64) + 0.5) / factor - 0.5
        expected = (0.1 * fine**2 - fine)[:, None] + 0.05 * fine**2
        found = within(bicubic(image[None, None], factor)[0, 0], 3 * factor)
        torch.testing.assert_close(found, within(expected, 3 * factor), atol=1e-12, rtol=0)


@pytest.mark.parametrize("origin", ["pixel", "grid"])
def test_derivatives(origin):
    S = power_law((6, 6))

    def closed_form(kernels):
        T = coarse_transfer(kernels, 6, 2, origin=origin)
        picture = superresolve(draws(3, 3), inversion(T, S, 0.1, 2), 2)
        joint = joint_errors(T[None], S, 0.1, 2)
        return (
            inversion_errors(T, S, 0.1, 2),
            joint,
            picture,
            coarse_image(draws(6, 6), kernels, 2, boundary="circular"),
        )

    assert torch.autograd.gradcheck(closed_form, (draws(2, 4, 3, seed=1) / 12).requires_grad_())


def test_no_noise_and_no_light_stay_finite():
    T = torch.zeros(1, 6, 6, dtype=torch.complex128)
    assert bool((inversion(T, power_law(6), 0.0, 2) == 0).all())
    assert float(inversion_errors(T, power_law(6), 0.0, 2)) == pytest.approx(float(power_law(6).mean()))
    assert bool((joint_inversion(T[None], power_law(6), 0.0, 2) == 0).all())
    same = coarse_transfer(gaussian(1.0)[None, None].expand(1, 3, -1, -1), 12, 2)  # views that agree tell no more
    again = float(joint_errors(same, power_law(12), 0.0, 2))
    assert again == pytest.approx(float(inversion_errors(same[:, 0], power_law(12), 0.0, 2)), rel=1e-6)


def test_single_precision_stays_single():
    T, S = coarse_transfer(gaussian(1.0)[None].to(torch.float32), 12, 2), power_law(12).to(torch.float32)
    assert T.dtype == torch.complex64
    found = inversion_errors(T, S, 0.1, 2)
    assert found.dtype == torch.float32
    exact = inversion_errors(coarse_transfer(gaussian(1.0)[None], 12, 2), power_law(12), 0.1, 2)
    torch.testing.assert_close(found.to(torch.float64), exact, rtol=1e-5, atol=0)
    image = draws(6, 6, dtype=torch.float32)
    assert superresolve(image, inversion(T, S, 0.1, 2), 2).dtype == bicubic(image, 2).dtype == torch.float32


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="8 × 9 pixels, 2 to one of the sensor: expected multiples"):
        coarse_image(torch.zeros(8, 9), torch.ones(1, 1), 2)
    with pytest.raises(ValueError, match="10 × 12 pixels, 3 to one of the sensor"):
        coarse_transfer(torch.ones(1, 3, 3), (10, 12), 3)
    with pytest.raises(ValueError, match="an image of 4 × 4 pixels, a filter for 6 × 6: expected equal"):
        superresolve(torch.zeros(4, 4), torch.zeros(12, 12), 2)

"""Super-resolution by a phase element: the laws of its closed forms, and what learning and several places give."""

import argparse
import dataclasses

import pytest
import torch

from raytrace.cli.studies import command
from raytrace.imaging.restoration import errors, mean_square_error, psnr
from raytrace.studies.edof.world import periodic, scene, spectrum, transfer
from raytrace.studies.pictures import dead_leaves
from raytrace.studies.superres.experiment import (
    FIELD,
    Plate,
    coarse,
    error_of,
    full_frame,
    hologram,
    joint_error_of,
    kernels,
    learn,
    learn_heights,
    lens,
    multiplexed,
    parts_of_a_pixel,
    places_of,
    polynomials_on_lens,
    sectors,
    sensor_image,
    small_scenes,
    taken,
    tiles,
    views,
    wide_kernels,
    world_of,
)
from raytrace.studies.superres.inversion import coarse_image, least_error
from raytrace.wave_optics.compute import psf

LEAVES = dead_leaves(6, size=64)
WORLD = world_of([0.55], noise=0.001, size=33)


def S_of(size: int = 96) -> torch.Tensor:
    return spectrum(periodic(LEAVES, size))


def plate(count: int = 4, factor: int = 2) -> Plate:
    return Plate(WORLD, places_of(count), parts_of_a_pixel(count, factor))


def points(*places: tuple[int, int], share: float, size: int = 145) -> torch.Tensor:
    """A kernel of points (row, column) around its middle, one colour."""
    kernel = torch.zeros(1, size, size, dtype=torch.float64)
    for row, column in places:
        kernel[0, size // 2 + row, size // 2 + column] = share
    return kernel


def test_factor_one_is_deconvolution():
    found = psf(scene(lens(WORLD), WORLD))
    H = transfer(found, 48)[0]
    T = coarse(found.kernel[0], 48, 1)
    torch.testing.assert_close(T, H, atol=1e-14, rtol=0)
    expected = errors(H[None], S_of(48), 0.01).mean()
    torch.testing.assert_close(error_of(T, S_of(48), 0.01, 1), expected, rtol=1e-12, atol=0)


def test_taken_is_what_large_pixels_average():
    pictures, kernel = periodic(LEAVES, 48), kernels(lens(WORLD), WORLD)
    image = taken(pictures, coarse(kernel, 48, 3), 3, torch.zeros(()))
    haze = (1 - kernel.sum()) * pictures.mean((-2, -1))[:, None, None]
    expected = coarse_image(pictures, kernel[0], 3, boundary="circular") + haze
    torch.testing.assert_close(image[:, 0], expected, atol=1e-13, rtol=0)


def test_learning_ends_below_its_start_and_above_the_bound():
    """From a little of every term: at one colour a lens in focus is a stationary point, where nothing is learned."""
    S, variables = S_of(), polynomials_on_lens(WORLD, 15)
    random = 0.03 * torch.randn(15, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    course = learn(variables, WORLD, S, 2, steps=8, start=random)
    with torch.no_grad():
        T = [coarse(kernels(own, WORLD), 96, 2) for own in (lens(WORLD), variables())]
        plain, end = (float(error_of(one, S, WORLD.noise, 2)) for one in T)
    assert end == pytest.approx(min(course), rel=1e-6)
    assert float(least_error(S, 2)) < end < min(course[0], 0.99 * plain)


def test_closed_form_is_what_is_restored():
    """Pictures the filter was made for: within 5 %, for their aliases are not as independent as the closed form has."""
    pictures = periodic(dead_leaves(12, size=64), 96)
    rows = full_frame({"lens": lens(WORLD)}, WORLD, 2, train=pictures, test=pictures)
    assert [row.name for row in rows] == ["lens, bicubic", "lens, MMSE"]
    assert 10 ** (-0.1 * rows[1].psnr) == pytest.approx(10 ** (-0.1 * rows[1].closed), rel=0.05)
    assert rows[1].psnr > rows[0].psnr + 0.5


@pytest.mark.parametrize(("count", "factor"), [(3, 2), (4, 2), (4, 3)])
def test_views_are_the_scene_at_its_places(count, factor):
    """A kernel of points at the places: every view is its share of the image of the scene, exactly."""
    scenes, places = small_scenes(LEAVES), places_of(count)
    kernel = points(*places, share=1 / count)
    found = views(sensor_image(scenes, kernel, factor), kernel, places, factor)
    alone = torch.nn.functional.avg_pool2d(scenes, factor) / count
    assert found.shape == (len(scenes), 1, count, FIELD // factor, FIELD // factor)
    for view in found.unbind(2):
        torch.testing.assert_close(view[:, 0], alone, atol=1e-13, rtol=0)
    assert float(tiles(kernel, places)[0, 1].sum()) == pytest.approx(1 / count)


def test_places_at_the_same_part_of_a_pixel_tell_no_more_than_one():
    """Four equal views of a quarter each, noise σ: as one view of half the light (noise averages over four)."""
    S, places = spectrum(small_scenes(LEAVES)), places_of(4)
    same = joint_error_of(points(*places, share=0.25), places, S, 0.001, 2)
    one = error_of(coarse(points((0, 0), share=1.0, size=33), FIELD, 2), S, 0.002, 2)
    torch.testing.assert_close(same, one, rtol=1e-9, atol=0)


@pytest.mark.parametrize("make", [sectors, hologram])
def test_plates_show_the_scene_at_their_places(make):
    """Most light within a place's tile, as much at each, its centre of gravity there to a tenth of a pixel."""
    own = plate()
    with torch.no_grad():
        kernel = wide_kernels(make(own), WORLD, samples=400)
    parts = tiles(kernel, own.places)[0]
    light = parts.sum((-2, -1))
    assert float(light.sum()) > 0.8
    assert float(light.max() / light.min()) < 1.02
    middle = parts[..., 16:-16, 16:-16]  # tails of the others aside
    x = torch.arange(15, dtype=torch.float64) - 7
    for place, part in zip(own.parts, middle, strict=True):
        centre = torch.stack([(part.sum(1) * x).sum(), (part.sum(0) * x).sum()]) / part.sum()
        torch.testing.assert_close(centre, place, atol=0.1, rtol=0)


def test_several_places_beat_the_bound_of_one_image():
    """Four places by waves added: measured 5.5 dB over the lens behind its best inversion, noise 0.001."""
    scenes, own = small_scenes(LEAVES), plate()
    with torch.no_grad():
        kernel = wide_kernels(hologram(own), WORLD, samples=400)
    row, sensor = multiplexed("waves", kernel, own, 2, train=scenes, test=scenes)
    plain = full_frame({"lens": lens(WORLD)}, WORLD, 2, train=scenes, test=scenes)[1]
    assert row.psnr > plain.psnr + 4
    assert row.closed > float(psnr(least_error(spectrum(scenes), 2))) + 3
    assert sensor.shape[:2] == (len(scenes), 1)
    assert row.psnr == pytest.approx(row.closed, abs=0.4)  # stray light counts as noise in the closed form
    again = psnr(mean_square_error(row.estimate, scenes[:, None]).mean())
    assert row.psnr == pytest.approx(float(again))


@pytest.mark.slow
def test_learned_heights_are_no_worse_than_their_start():
    own, S = plate(3), spectrum(small_scenes(LEAVES))
    start = hologram(own)
    with torch.no_grad():
        before = joint_error_of(wide_kernels(start, WORLD, samples=400), own.places, S, WORLD.noise, 2)
    learned = learn_heights(own, start, S, 2, steps=5)
    with torch.no_grad():
        after = joint_error_of(wide_kernels(learned, WORLD, samples=400), own.places, S, WORLD.noise, 2)
    assert float(after) < float(before)


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match="5 places: expected 3 or 4"):
        places_of(5)
    with pytest.raises(ValueError, match="32 × 32 pixels, expected 64 at least"):
        small_scenes(dead_leaves(1, size=32))


def test_colours_keep_their_axis():
    world = dataclasses.replace(WORLD, wavelengths=(0.46, 0.64))
    pictures = periodic(LEAVES, 96)
    rows = full_frame({"lens": lens(world)}, world, 3, train=pictures, test=pictures)
    assert all(len(row.by_colour) == 2 and row.estimate.shape == (6, 2, 96, 96) for row in rows)


@pytest.mark.parametrize("name", ["focus", "edof", "table", "superres", "quantise"])
def test_examples_are_arguments_that_are_taken(name):
    found, parser = command(name), argparse.ArgumentParser()
    found.add_arguments(parser)
    lines = [line.split() for line in found.examples.splitlines()[1:]]
    assert lines
    for words in lines:
        assert words[:3] == ["raytrace", "wave", name]
        parser.parse_args(words[3:])

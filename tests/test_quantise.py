"""What fabrication costs: the law of kinoforms, steps of height, and learning with steps in the loop."""

import dataclasses
import json
import math

import pytest
import torch

from raytrace.cli import main
from raytrace.materials.catalogs import find_glass
from raytrace.studies.edof.report import learn
from raytrace.studies.edof.settings import Settings
from raytrace.studies.edof.world import World, expected_error, periodic, quality, scene, spectrum, transfer
from raytrace.studies.pictures import dead_leaves
from raytrace.studies.quantise.experiment import (
    WAYS,
    Judge,
    efficiency,
    law,
    learn_on,
    made,
    read,
    steps_of,
    tolerances_of,
    whole,
)
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element, EvenPowers, Rings, as_pixels, as_rings, period
from raytrace.wave_optics.element_files import read_element, write_element
from raytrace.wave_optics.height_maps import write_heights

#: Small, and quick: 1 mm, f/20, one colour, three depths.
WORLD = World(radius=0.5, sensor_distance=20.0, depths=(200.0, 400.0, math.inf), design=400.0, wavelengths=(0.5, 0.6),
              size=48, noise=0.01)  # fmt: skip
PICTURES = periodic(dead_leaves(6, size=64), 96)


def fresnel(pitch: float = 0.002) -> Element:
    made_for = aim(radius=WORLD.radius, sensor=WORLD.sensor_distance, focus=WORLD.design)
    (element,) = baseline("fresnel", made_for, pitch=pitch)
    return element


def judge() -> Judge:
    return Judge(WORLD, spectrum(PICTURES))


def bumpy() -> Element:
    """The lens and half a wave more: nothing that a step would not change."""
    element = whole(fresnel(0.01))
    r = torch.arange(len(element.profile.heights), dtype=torch.float64)
    heights = element.profile.heights + 0.3e-3 * torch.sin(0.4 * r)
    return dataclasses.replace(element, profile=dataclasses.replace(element.profile, heights=heights))


@pytest.mark.parametrize("levels", [2, 3, 4, 8, 16, 64])
def test_a_kinoform_keeps_the_law(levels):
    """Steps as narrow as they come, 5 mm at f/7.1: sinc²(1/L) to 2e-4."""
    (lens,) = baseline("singlet", aim())
    assert efficiency(made(lens, levels, wrap=True), World()) == pytest.approx(law(levels), abs=2e-4)


def test_any_height_keeps_all_light_and_rings_some():
    """A flat ring of width w at a slope of s waves/mm keeps sinc²(s w); over the area of f/7.1 rings, 0.890 of it."""
    (lens,), (rings,) = (baseline(name, aim()) for name in ("singlet", "fresnel"))
    assert efficiency(made(lens, 0, wrap=True), World()) == pytest.approx(1.0, abs=1e-9)
    r = 2.5 * torch.sqrt((torch.arange(100_000, dtype=torch.float64) + 0.5) / 100_000)
    slope = r * (1 / 1000 + 1 / 35.5) / 0.55e-3
    expected = float(torch.sinc(slope * 0.002).mean() ** 2)
    assert efficiency(rings, World()) == pytest.approx(expected, abs=2e-3)
    assert law(0) == 1.0


@pytest.mark.parametrize("levels", [2, 16])
def test_made_has_its_levels(levels):
    element = bumpy()
    step = float(period(element.glass, 0.55)) / levels
    high = made(element, levels, wrap=False).profile.heights
    torch.testing.assert_close(high / step, torch.round(high / step), atol=1e-9, rtol=0)
    below = element.profile.heights - high
    assert float(below.min()) > -1e-3 * step
    assert float(below.max()) < step
    assert made(element, levels, wrap=True).levels == levels
    assert made(element, 0, wrap=False) is not element
    torch.testing.assert_close(made(element, 0, wrap=False).profile.heights, element.profile.heights, rtol=0, atol=0)


def test_judge_is_the_closed_form_of_edof():
    element, own = fresnel(), judge()
    found = psf(scene((element,), WORLD))
    expected = expected_error(transfer(found, 96), spectrum(PICTURES), WORLD.noise)
    torch.testing.assert_close(own.error(element), expected, rtol=1e-4, atol=0)
    shown = quality((element,), WORLD, train=PICTURES, test=PICTURES).mean["blind"]
    assert own.restored(element, PICTURES) == pytest.approx(shown, abs=0.02)  # noise drawn there, expected here


def test_a_wrap_at_its_own_wavelength_costs_nothing():
    mono = dataclasses.replace(WORLD, wavelengths=(0.55,))
    own, element = Judge(mono, spectrum(PICTURES)), bumpy()
    wrapped, not_wrapped = (own.closed(made(element, 0, wrap=wrap)) for wrap in (True, False))
    assert wrapped == pytest.approx(not_wrapped, abs=1e-9)
    colours = judge()
    assert colours.closed(made(element, 0, wrap=True)) < colours.closed(made(element, 0, wrap=False)) - 0.05


def test_steps_in_the_loop_are_no_worse_than_steps_afterwards():
    own, stepped = judge(), made(bumpy(), 2, wrap=True)
    trained = learn_on(stepped, own, steps=4, rate=0.05)
    assert own.closed(trained) > own.closed(stepped) + 0.01
    assert trained.levels == 2
    assert own.closed(learn_on(stepped, own, steps=0)) == own.closed(stepped)


def test_rows_of_every_way_and_level():
    own = judge()
    rows, elements = steps_of("bumpy", bumpy(), own, PICTURES, levels=(2, 64), ways=tuple(WAYS), steps=2)
    assert [(row.made, row.levels) for row in rows] == [(way, n) for way in WAYS for n in (0, 2, 64)]
    by = {(row.made, row.levels): row for row in rows}
    for way in ("whole", "wrapped", "looped"):
        assert by[way, 64].closed == pytest.approx(by[way, 0].closed, abs=0.02)
        assert by[way, 2].closed < by[way, 0].closed
    assert by["looped", 0].closed >= by["wrapped", 0].closed
    assert by["trained", 0].closed == by["looped", 0].closed  # as many steps, nothing quantised
    for n in (0, 2, 64):
        assert by["trained", n].closed >= by["wrapped", n].closed
    assert own.closed(elements["trained", 2]) == by["trained", 2].closed


def test_errors_of_height_cost_little_and_repeat():
    own = judge()
    element = made(bumpy(), 16, wrap=True)
    rows = tolerances_of("bumpy", "wrapped", element, own, nm=(0.0, 20.0, 200.0), count=3)
    again = tolerances_of("bumpy", "wrapped", element, own, nm=(0.0, 20.0, 200.0), count=3)
    assert rows == again
    assert rows[0].least == rows[0].greatest == pytest.approx(own.closed(element), abs=1e-9)
    assert abs(rows[1].mean - rows[0].mean) < 0.3
    assert abs(rows[2].mean - rows[0].mean) > 10 * abs(rows[1].mean - rows[0].mean)


def test_a_file_of_rings_is_the_element_it_was_written_from(capsys, tmp_path):
    """A kinoform of 1 mm in 20 µm rings by its whole heights; what is neither heights nor a run is refused."""
    element = whole(fresnel(0.02))
    write_element(element, tmp_path / "rings.npy", design_wavelength=0.55)
    words = ["--levels", "4", "--tolerance", "20", "--steps", "0", "--aperture", "1", "--limit", "2"]
    given = ["wave", "quantise", "--element", str(tmp_path / "rings.npy"), *words]
    assert main([*given, "--wrap", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["levels"]
    assert [(row["element"], row["made"], row["levels"]) for row in rows] == [
        ("rings.npy", "wrapped", n) for n in (0, 4)
    ]
    world = dataclasses.replace(World(), radius=0.5)
    for row in rows:
        assert row["efficiency"] == efficiency(made(element, row["levels"], wrap=True), world)
        assert 5 < row["closed"] < 40
    assert main([*given, "--wrap"]) == 0
    assert "\nwrapped: wrapped and quantised afterwards\n" in capsys.readouterr().out
    assert main([*given, "--aperture", "5"]) == 1
    assert "less than the aperture of 5 mm" in capsys.readouterr().err
    assert main(["wave", "quantise", "--element", "lens.txt"]) == 1
    assert "or a height map (.npy" in capsys.readouterr().err


@pytest.mark.parametrize("suffix", [".npy", ".csv", ".png", ".tiff", ".dat"])
def test_pixels_are_made_as_rings_are(tmp_path, suffix):
    """A lens in pixels of 12.5 µm from every format: the law of its levels beside whole pixels, and the same PSNR."""
    (lens,) = baseline("singlet", aim(radius=WORLD.radius, sensor=WORLD.sensor_distance, focus=WORLD.design))
    write_heights(as_pixels(lens, 0.0125).profile, tmp_path / f"lens{suffix}")
    element = read_element(str(tmp_path / f"lens{suffix}"), aperture=1.0, glass=lens.glass)
    some, all_ = (efficiency(made(element, levels, wrap=True), WORLD) for levels in (8, 0))
    assert some == pytest.approx(law(8) * all_, rel=0.02)
    if suffix == ".dat":
        assert judge().closed(element) == pytest.approx(judge().closed(as_rings(lens, 0.0125)), abs=0.3)


def test_what_is_no_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"no settings.json; expected the folder of a run"):
        read(tmp_path, spectrum(PICTURES))


def test_a_run_is_read_with_other_pictures_and_not_begun_with_them(tmp_path):
    """The element as it was learned; of a run that has no start yet none is sought by pictures that are not its own."""
    leaves, folder = dead_leaves(4, size=48, seed=1), tmp_path / "run"
    settings = Settings(terms=3, pitch=0.02, starts=1, start_steps=2, steps=2, size=96)
    own = dataclasses.replace(WORLD, size=47)
    camera = learn(settings, own, leaves, folder, "run")
    element, world = read(folder, spectrum(PICTURES))
    assert world == own
    assert torch.equal(element.numbers, camera.variables()[0].numbers)
    (folder / "start.pt").unlink()
    with pytest.raises(ValueError, match=r"no start.pt; let `raytrace wave edof` finish"):
        read(folder, spectrum(PICTURES))
    assert not (folder / "start.pt").exists()


def test_radial_elements_only():
    assert isinstance(whole(fresnel()).profile, Rings)
    smooth = Element(EvenPowers(torch.zeros(1, dtype=torch.float64)), torch.tensor(0.5), find_glass("PMMA"))
    assert whole(smooth).period is None

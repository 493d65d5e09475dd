"""`raytrace wave psf` and `focus`: fixed forms, arrays and JSON against the library, files, and how they refuse."""

import argparse
import functools
import inspect
import json
import math
import re
import subprocess
import sys
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
import torch
from problems import number

import raytrace as rt
from raytrace.cli import wave_options
from raytrace.cli.commands import WAVE_COMMANDS
from raytrace.cli.options import add
from raytrace.materials.glass import index
from raytrace.maths.sampling import grid
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import BASELINES, aim, baseline
from raytrace.wave_optics.element_files import read_element, read_label, write_element
from raytrace.wave_optics.fabrication import as_rings
from raytrace.wave_optics.figures import height_figure
from raytrace.wave_optics.height_maps import write_heights
from raytrace.wave_optics.plan import ENGINES, plan
from raytrace.wave_optics.scene import WaveScene

FORM = ["--focus", "1000", "--depth", "500", "1000", "inf", "--wavelength", "0.46", "0.55", "0.64"]
FORM += ["--pixel", "0.00369", "--size", "128"]
SMALL = ["--depth", "1000", "--wavelength", "0.55", "--size", "16"]


@pytest.fixture
def run(command):
    """Run a subcommand of `raytrace wave` in an empty folder: exit code, standard output, standard error."""
    return functools.partial(command, "wave")


def library(elements, depths, wavelengths, size=128):
    return psf(WaveScene(elements, number(35.5), number(depths), number(wavelengths), grid(number(0.00369), size)))


@pytest.mark.slow
def test_fixed_form_gives_the_librarys_kernels(run, tmp_path):
    code, out, err = run("psf", "--element", "singlet", *FORM, "--json", "-o", "psf.npz", "--plot", "psf.png")
    assert code == 0, err
    result = library(baseline("singlet", aim()), [500.0, 1000.0, math.inf], [0.46, 0.55, 0.64])
    with np.load(tmp_path / "psf.npz") as arrays:
        np.testing.assert_allclose(arrays["psf"], result.kernel.numpy(), rtol=0, atol=1e-12)
        np.testing.assert_allclose(arrays["energy"], arrays["psf"].sum((-2, -1)), atol=1e-12)
        assert arrays["pixel_pitch"] == 0.00369
        assert arrays["depths"].tolist() == [500.0, 1000.0, math.inf]
        assert arrays["wavelengths"].tolist() == [0.46, 0.55, 0.64]
        assert (str(arrays["engine"]), float(arrays["error"])) == ("radial", result.error)
        assert arrays["centre"].tolist() == [0.0, 0.0]
        # Centred on the axis: an even window has no pixel of its own there.
        np.testing.assert_allclose(arrays["psf"], arrays["psf"][..., ::-1, ::-1], atol=1e-9)
    document = json.loads(out)
    assert [(r["depth"], r["wavelength"]) for r in document["results"][-2:]] == [(None, 0.55), (None, 0.64)]
    assert document["results"][4]["energy"] == pytest.approx(float(result.energy[1, 1]), abs=1e-12)
    # Blur of a disc: half of the light within a/√2 (2.5 mm · 35.5 mm · 1 dioptre), to the pixel.
    assert document["results"][1]["half_energy_radius_um"] == pytest.approx(2.5 * 35.5 / math.sqrt(2), abs=3.69)
    assert (tmp_path / "psf.png").read_bytes()[:4] == b"\x89PNG"


def test_the_command_is_the_verb(run):
    """One name, the same options, the same defaults, the same result."""
    parser = argparse.ArgumentParser(add_help=False)
    add(parser, WAVE_COMMANDS[0].options)
    keywords = inspect.signature(rt.wave_optics.wave_psf).parameters
    for action in parser._actions:
        if action.dest not in ("json", "output", "catalog", "max_bytes") and not action.dest.startswith("plot"):
            assert action.default == keywords[action.dest].default, action.dest
    _, out, _ = run("psf", "--element", "fresnel", *SMALL, "--json")
    result = rt.wave_optics.wave_psf("fresnel", depths=[1000], wavelengths=[0.55], size=16)
    assert json.loads(out) == result.document()
    assert run("psf", "--element", "fresnel", *SMALL)[1] == f"{result}\n"
    assert result.to_frame().half_energy_radius_um[0] == 1e3 * float(result.half_energy_radius)


@pytest.mark.parametrize("engine", ["radial", "pupil"])
def test_the_peak_does_not_depend_on_whether_the_window_is_even(engine):
    """An even window has a corner of four pixels on the axis: 0.21 each, where a pixel about the axis holds 0.49."""
    even, odd = (
        rt.wave_optics.wave_psf("ideal", depths=[1000], wavelengths=[0.55], size=size, engine=engine, tol=1e-3)
        for size in (16, 15)
    )
    assert float(even.kernel.max()) < 0.5 * float(odd.kernel.max())
    assert float(odd.peak) == float(odd.kernel.max()) == pytest.approx(0.492, abs=2e-3)
    assert float(even.peak) == pytest.approx(float(odd.peak), rel=2e-3)  # by the error of the plan
    assert even.document()["results"][0]["peak"] == float(even.peak)


def test_kernels_of_an_element_at_hand_are_differentiable():
    (lens,) = rt.wave_optics.phase_elements("singlet", aperture=1.0)

    def peak(power):
        return rt.wave_optics.wave_psf(lens.with_numbers(power), depths=[500], wavelengths=[0.55], size=8).kernel.max()

    power, step = lens.numbers.clone().requires_grad_(), 1e-6
    (result,) = torch.autograd.grad(peak(power), power)
    expected = (peak(lens.numbers + step) - peak(lens.numbers - step)) / (2 * step)
    assert float(result) == pytest.approx(float(expected), rel=1e-6)


def test_names_and_engines_are_those_of_the_library():
    assert tuple(BASELINES) == wave_options.ELEMENTS
    assert ("auto", *ENGINES) == get_args(inspect.signature(rt.wave_optics.wave_psf).parameters["engine"].annotation)


@pytest.mark.parametrize("element", ["ideal", "singlet", "fresnel", "multifocal", "hybrid", "multifocal-refractive"])
def test_named_elements(run, element):
    code, out, err = run("psf", "--element", element, *SMALL, "--aperture", "1", "--json")
    assert code == 0, err
    document = json.loads(out)
    assert document["element"] == element
    assert 0 < document["results"][0]["energy"] <= 1


def test_an_element_of_a_file_is_the_element_that_was_written(run, tmp_path):
    """A kinoform in 16 steps as heights not yet wrapped: glass, wave and steps come from the command line."""
    (lens,) = baseline("fresnel", aim(radius=0.5), levels=16)
    write_heights(as_rings(lens, 0.002).profile, tmp_path / "rings.npy")
    arguments = ("--aperture", "1", *SMALL, "--json")
    made = ("--glass", "F_SILICA", "--design-wavelength", "0.55", "--levels", "16")
    code, out, err = run("psf", "--element", "rings.npy", *made, *arguments)
    assert code == 0, err
    named = json.loads(run("psf", "--element", "fresnel", "--levels", "16", *arguments)[1])
    assert json.loads(out)["results"][0]["peak"] == pytest.approx(named["results"][0]["peak"], rel=1e-6)
    whole = json.loads(run("psf", "--element", "rings.npy", "--glass", "F_SILICA", *arguments)[1])
    assert whole["results"][0]["peak"] != pytest.approx(named["results"][0]["peak"], rel=1e-4)


def test_heights_keep_the_material_that_they_were_learned_for(run, tmp_path):
    """Rings of fused silica: without an option the kernel is theirs, not that of PMMA."""
    (lens,) = baseline("fresnel", aim(radius=0.5))
    element = as_rings(lens, 0.002)
    write_element(element, tmp_path / "rings.npy", design_wavelength=0.55)
    result = read_label(tmp_path / "rings.npy")
    wavelengths = torch.tensor([0.46, 0.55, 0.64], dtype=torch.float64)
    assert torch.equal(index(result.glass, wavelengths), index(element.glass, wavelengths))
    assert (result.design_wavelength, result.pitch, result.aperture) == (0.55, 0.002, 1.0)
    arguments = ("psf", "--element", "rings.npy", "--aperture", "1", *SMALL, "--json")
    peaks = {}
    for glass in ((), ("--glass", "F_SILICA"), ("--glass", "PMMA")):
        code, out, err = run(*arguments, *glass)
        assert code == 0, err
        peaks[glass] = json.loads(out)["results"][0]["peak"]
    assert peaks[()] == peaks["--glass", "F_SILICA"]
    assert peaks[()] > 1.01 * peaks["--glass", "PMMA"]
    # A bare file says nothing, and is not guessed at; a damaged label is no crash.
    (tmp_path / "rings.npy.json").write_text('{"material": "F_SILICA", "formula": "sellmeier_1"}')
    code, _, err = run(*arguments)
    assert code == 1
    assert "rings.npy.json: is no label of a height map ('catalog' is missing); remove it" in err
    (tmp_path / "rings.npy.json").unlink()
    code, _, err = run(*arguments)
    assert code == 1
    assert "rings.npy: has no material (there is no rings.npy.json); give --glass NAME" in err
    np.save(tmp_path / "bare.npy", element.profile.heights.numpy())
    code, _, err = run("psf", "--element", "bare.npy", "--aperture", "1", *SMALL)
    assert code == 1
    assert "pitch" in err


def test_a_smooth_element_is_a_file_of_its_coefficients(run, tmp_path):
    """Bit for bit, in its material and in no larger an aperture; polynomials without symmetry only in their own."""
    lens, plate = baseline("cubic-refractive", aim(radius=0.5))
    for element, name in ((lens, "lens.json"), (plate, "plate.json")):
        write_element(element, tmp_path / name, design_wavelength=0.55)
        again = read_element(tmp_path / name, aperture=1.0)
        assert type(again.profile) is type(element.profile)
        assert torch.equal(again.numbers, element.numbers)
        assert torch.equal(again.glass.coefficients, element.glass.coefficients)
    named, own = (
        run("psf", "--element", name, "--aperture", "1", *SMALL, "--json")[1] for name in ("singlet", "lens.json")
    )
    assert json.loads(named)["results"] == json.loads(own)["results"]
    for arguments, words in (
        (("lens.json", "--aperture", "2"), "lens.json: is made for an aperture of 1 mm, not 2 mm"),
        (("plate.json", "--aperture", "0.5"), "plate.json: is made for an aperture of 1 mm, not 0.5 mm"),
        (("lens.json", "--aperture", "1", "--pitch", "0.002"), "is smooth"),
        (("other.json", "--aperture", "1"), "other.json: is no smooth element"),
    ):
        code, _, err = run("psf", "--element", *arguments, *SMALL)
        assert code == 1
        assert words in err


def test_expensive_computations_are_reported_or_refused(run):
    """The cubic element at its full size: seconds where it was minutes; what no memory is left for is refused."""
    words = ("psf", "--element", "cubic", "--depth", "1000", "--wavelength", "0.55")
    code, out, err = run(*words, "--max-bytes", "10MB")
    assert (code, out) == (1, "")
    assert "B; 10 MB may be taken): take fewer by --samples or a larger --tol, a smaller window by --size" in err
    parts = baseline("cubic", aim())
    double = {"dtype": torch.float64}
    seen = WaveScene(
        parts,
        torch.tensor(35.5, **double),
        torch.tensor([500.0, 1000.0, math.inf], **double),
        torch.tensor([0.46, 0.55, 0.64], **double),
        grid(torch.tensor(0.00369, **double), 128),
    )
    chosen = plan(seen)
    assert chosen.error < 1e-3
    assert chosen.flops < 5e10
    assert chosen.memory < 3e9


def test_heights_of_all_parts_are_drawn():
    """The round lens and the cubic plate over it: two maps, the second odd in x and y."""
    elements = baseline("cubic-refractive", aim(radius=0.5))
    figure = height_figure(elements, title="cubic-refractive")
    maps = [axes.images[0].get_array() for axes in figure.axes if axes.images]
    assert len(maps) == len(elements) == 2
    round_part, plate = (np.ma.filled(one, np.nan) for one in maps)
    inside = ~np.isnan(plate)
    assert np.allclose(round_part[inside], round_part[::-1, ::-1][inside], atol=1e-9)
    assert np.allclose(plate[inside], -plate[::-1, ::-1][inside], atol=1e-9)
    assert np.nanmax(np.abs(plate)) > 1
    titles = [axes.get_title() for axes in figure.axes if axes.images]
    assert titles == ["smooth, round; PMMA", "smooth, free form; PMMA"]


def test_exact_spheres_and_paraboloids_differ(run):
    peaks = [
        json.loads(run("psf", "--element", "ideal", *SMALL, "--json", *more)[1])["results"][0]["peak"]
        for more in ((), ("--exact",))
    ]
    assert 1e-4 < abs(peaks[0] / peaks[1] - 1) < 0.05


@pytest.mark.slow
def test_text_and_the_other_figures(run, tmp_path):
    names = {"--heights": "h.png", "--encircled": "e.svg"}
    words = [word for pair in names.items() for word in pair]
    code, out, err = run("psf", "--element", "fresnel", "--aperture", "1", *SMALL, "--plot", "k.pdf", *words)
    assert code == 0, err
    assert "radial engine" in out
    assert re.search(r"^ +mm +µm.*\n +1000 +0.55 ", out, re.M)
    for name in ("k.pdf", *names.values()):
        assert (tmp_path / name).stat().st_size > 2000
        assert f"written: {name}" in err


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--element", "singlett"], 1, "did you mean singlet?"),
        (["--element", "none.npy"], 1, "none.npy: cannot be read: No such file"),
        (["--engine", "pupil", "--samples", "48", "--depth", "500"], 1, "repeat the image every"),
        (["--engine", "radial", "--element", "cubic"], 1, "radial engine needs round elements"),
        (["--wavelength", "0.3"], 1, "PMMA has indices from 0.365 to 1.06 µm, none at 0.3"),
        (["--levels", "16"], 1, "the element singlet is smooth"),
        (["--glass", "F_SILICA"], 1, "--glass belongs to a height map"),
        (["-o", "psf.txt"], 1, "psf.txt: expected a name that ends in .npz"),
        (["--caustic", "psf.npz"], 2, "'psf.npz' is no picture (.png, .pdf, .svg)"),
        (["-o", "no/psf.npz"], 1, "no/psf.npz: cannot be written"),
        (["--depth", "0"], 2, "not above 0"),
        (["--wavelength", "green"], 2, "not a number"),
        (["--engine", "best"], 2, "invalid choice"),
        (["--size", "0"], 2, "not above 0"),
    ],
)
def test_errors_are_one_line(run, tmp_path, words, code, message):
    result, out, err = run("psf", *words)
    assert (result, out) == (code, "")
    assert message in err
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith("raytrace: error: ")
    assert list(tmp_path.iterdir()) == []


def test_a_small_file_names_its_aperture(run, tmp_path):
    write_heights(as_rings(baseline("fresnel", aim(radius=0.5))[0], 0.002).profile, tmp_path / "small.npy")
    code, _, err = run("psf", "--element", "small.npy")
    assert code == 1
    assert "less than the aperture of 5 mm; give --aperture 1" in err


@pytest.mark.parametrize("name", [command.name.removeprefix("wave-") for command in WAVE_COMMANDS])
def test_help_teaches_by_example(run, name):
    from raytrace.cli import build_parser

    code, out, err = run(name, "--help")
    assert (code, err) == (0, "")
    examples = re.findall("^  raytrace .*", out.split("examples:")[1], re.M)
    assert len(examples) >= 2
    for line in examples:
        words = line.split("|")[0].split()
        assert words[:3] == ["raytrace", "wave", name]
        assert build_parser().parse_args(words[1:]).subcommand == name


def test_parsing_loads_no_torch():
    code = (
        "import sys; from raytrace.cli import main; main(['wave', 'psf', '--help']);"
        "sys.exit(bool({'torch', 'numpy', 'matplotlib', 'tqdm'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[1], capture_output=True, timeout=120)
    assert done.returncode == 0

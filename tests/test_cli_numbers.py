"""The command on what has no number: lost rays, quantities that do not exist, wavelengths that nothing is known at."""

from pathlib import Path

import pytest
import torch

import raytrace as rt
from raytrace.tracing.spot import image_rays

LENSES = Path(__file__).parents[1] / "lenses"


COMMANDS = [
    "info hubble",
    "spot double_gauss",
    "focus double_gauss",
    "mtf double_gauss",
    "compare-models double_gauss",
    "psf double_gauss",
    "glass N-BK7",
    "wave psf --element cubic --depth 500",
    "codesign double_gauss --loss spectral",
]


@pytest.mark.parametrize("command", COMMANDS)
def test_nanometres_are_refused_by_every_command(run, command):
    found = run(*command.split(), "--wavelength", 550)
    assert found.code == 1
    assert found.out == ""
    assert found.err.count("\n") == 1
    assert "a wavelength of 550 µm" in found.err
    assert "did you mean 0.55?" in found.err


@pytest.mark.parametrize("command", ["info", "spot", "focus", "trace", "psf --model paraxial", "distortion", "layout"])
def test_extrapolation_is_reported_once_for_each_glass(run, command):
    name, *options = command.split()
    found = run(name, "double_gauss", "--wavelength", 3, *options, *(["--plot", "x.png"] if name == "layout" else []))
    assert found.code == 0
    warned = [line for line in found.err.splitlines() if "extrapolated" in line]
    assert [line.split(": ")[3].split(" is ")[0] for line in warned] == ["SK2 (SCHOTT)", "SK16 (SCHOTT)", "F5 (SCHOTT)"]
    assert warned[0].endswith("is extrapolated to 3 µm; its coefficients hold from 0.31 to 2.325 µm")


def test_extrapolation_is_reported_of_a_wavelength_of_codesign(run):
    found = run("codesign", "double_gauss", "--loss", "spectral", "--wavelength", 3, "--data", "missing")
    assert found.err.count("is extrapolated to 3 µm") == 3


@pytest.mark.parametrize("model", ["gaussian", "drt"])
def test_a_psf_without_light_is_a_dash_null_and_a_warning(run, model):
    found = run("psf", "cooke_triplet", "--field", 0, 80, "--model", model, "--tol", 0.1)
    assert found.out.splitlines()[-1].split()[:6] == ["inf", "80", "-", "-", "-", "-"]
    assert "field 80 degrees, 0.486133, 0.587562, 0.656273 µm: all 144 rays lost: missed surface 2" in found.err
    lost = run("psf", "cooke_triplet", "--field", 0, 80, "--model", model, "--tol", 0.1, "--json").document["results"][
        1
    ]
    assert lost["centroid"] == [None, None]
    assert lost["covariance"] == [[None, None], [None, None]]
    assert lost["energy"] == 0


NA = {"ENPD 12.5": "OBNA 0.1 0", "DISZ INFINITY": "DISZ 200"}


@pytest.mark.parametrize("command", ["spot", "spot --rays 500", "focus --field 0", "compare-models"])
def test_an_object_na_of_a_distant_object_is_reported_with_a_remedy(run, command):
    """An entrance pupil of 5 m in front of a lens of 12 mm."""
    text = (LENSES / "singlet.zmx").read_text(encoding="utf-8")
    for old, new in NA.items():
        text = text.replace(old, new)
    Path("na.zmx").write_text(text, encoding="utf-8")
    name, *options = command.split()
    distance = ["--focus-distance" if name == "compare-models" else "--object-distance", 25000]
    found = run(name, "na.zmx", *distance, *options)
    assert "all " in found.err
    assert "rays lost: missed surface 3" in found.err
    assert "the aperture is an object NA of 0.1, whose entrance pupil is" in found.err
    assert "F-number" in found.err
    assert "nan" not in found.out
    held = run(name, "na.zmx", *distance, *options, "--epd", 12.5) if name != "compare-models" else None
    assert held is None or "lost" not in held.err


def test_wavefronts_of_aimed_rays(run):
    """The retrofocus aims its rays at the stop: points of the pupil meet an axis of object distances there."""
    (row, *_) = run("wavefront", "retrofocus", "--field", 0, "--size", 8, "--json").document["summary"]
    assert 0.1 < row["rms"] < 1


def singlet(name: str, *changes: tuple[str, str]) -> str:
    """The shipped singlet with some of its lines changed, as a file in the current folder."""
    text = (LENSES / "singlet.zmx").read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text
        text = text.replace(old, new, 1)
    Path(f"{name}.zmx").write_text(text, encoding="utf-8")
    return f"{name}.zmx"


PLATE = ("CURV -0.01934984520123839", "CURV 0")
NARROW = "the beam of field 10.5 has no width: its vignetting factors leave nothing of the pupil"
AFOCAL = "the Fourier model has no pupil here"
BLOCKED = ("DIAM 14.79 1 0 0 1", "OBSC 0 60 0\n  DIAM 14.79 1 0 0 1")
LOST = "no ray of field 0 degrees reaches the sensor: all 217 rays lost: vignetted at surface 2"


@pytest.mark.parametrize(
    ("command", "change", "message"),
    [
        ("mtf --frequency 5", ("VCYN 0 0 0", "VCYN 0 1 1"), NARROW),
        ("encircled-energy", ("VCXN 0 0 0", "VCXN 0 1 1"), NARROW),
        ("psf --model fourier", ("DISZ 100.0", "DISZ 0"), AFOCAL),
        ("psf --model fourier", PLATE, AFOCAL),
        ("mtf --frequency 5", BLOCKED, LOST),
        ("mtf --frequency 5 --geometric", BLOCKED, LOST),
        ("encircled-energy --geometric", BLOCKED, LOST),
        ("wavefront", BLOCKED, LOST),
        ("spot", ("ENPD 12.5", "OBNA 1.5 0"), "aperture object_na needs an object at a finite distance"),
        ("focus --criterion mean", BLOCKED, "no ray reaches the image"),
    ],
)
def test_undefined_quantities_are_one_line_with_the_cause(run, command, change, message):
    name, *options = command.split()
    found = run(name, singlet("nasty", change), *options)
    assert found.code == 1
    assert found.out == ""
    assert message in found.err.splitlines()[-1]
    assert "defect" not in found.err


def test_a_cone_at_a_right_angle_is_refused(run):
    lens = singlet("wide", ("ENPD 12.5", "OBNA 1 0"), ("DISZ INFINITY", "DISZ 200"))
    assert "aperture object_na 1: expected less than the index 1 before surface 1" in run("info", lens).err


@pytest.mark.parametrize("diameter", [6.0, 12.5])
def test_focus_by_the_mean_distance_on_a_clipped_image(run, diameter):
    """20 µm of image, 2 mm out of focus: wherever the sensor goes, the rays that reached it go with it.

    Rays near the axis are left, which meet at the paraxial focus that the file's source publishes, 100 mm; and of the
    wide beam, those of its outermost 0.6 %, a fifth of this light, which spherical aberration brings together at 98 mm.
    """
    lens = singlet("clipped", ("DISZ 100.0", "DISZ 98"), ("ENPD 12.5", f"ENPD {diameter}"))
    text = Path(lens).read_text(encoding="utf-8").rstrip("\n")
    Path(lens).write_text(text + "\n  CLAP 0 0.02 0\n", encoding="utf-8")
    found = run("focus", lens, "--criterion", "mean", "--json")
    assert "of the rays fail or are vignetted" in found.err
    clipped = rt.read_lens(lens)
    y = (torch.arange(20_000, dtype=torch.float64) + 0.5) / 20_000
    fan = torch.stack([torch.zeros_like(y), y])
    rays = image_rays(clipped, fan, fields=torch.zeros(2, 1, dtype=torch.float64), wavelengths=clipped.primary[None])
    light = torch.where(rays.valid, y, 0.0).flatten()
    height, slope = (t.flatten() for t in (rays.position[1], rays.direction[1] / rays.direction[2]))
    shifts = torch.arange(-100, 300, dtype=torch.float64) / 100
    mean = ((height + shifts[:, None] * slope).abs() * light).sum(1)
    dense = 98 + float(shifts[mean.argmin()])
    assert found.document["sensor_after"] == pytest.approx(dense, abs=0.01)
    assert dense == pytest.approx(100 if diameter == 6 else 98.31, abs=0.05)


def test_info_prints_infinite_or_a_dash_where_a_quantity_is_undefined(run):
    text = run("info", singlet("plate", PLATE)).out
    assert "nan" not in text
    assert "-inf" not in text
    for quantity, word in (
        ("effective focal length", "afocal"),
        ("F/#", "infinite"),
        ("paraxial image distance", "infinite"),
    ):
        line = next(line for line in text.splitlines() if line.strip().startswith(quantity))
        assert line.removeprefix(f"  {quantity}").split()[0] == word
    touching = run("info", singlet("touching", ("DISZ INFINITY", "DISZ 0"))).out
    (line,) = (line for line in touching.splitlines() if line.strip().startswith("magnification"))
    lens = rt.read_lens("touching.zmx")
    stop, front, back = lens.surfaces[1:4]
    n = float(rt.materials.refractive_index(front.glass, lens.primary))
    reach = float(stop.thickness) + float(front.thickness) / n
    enlarged = 1 / (1 - (1 - n) * float(back.curvature) * reach)  # of an object on the stop, in front of a flat face
    assert float(line.split()[1]) == pytest.approx(enlarged, rel=1e-8)
    assert "nan" not in touching


def test_an_almost_fully_vignetted_cone_gives_finite_numbers(run):
    found = run("wavefront", "double_gauss", "--f-number", 0.5, "--field", 0, "--size", 8, "--json")
    assert "field 0 degrees: the light fills too little of the entrance pupil for Zernike coefficients" in found.err
    assert {row["coefficient"] for row in found.document["results"]} == {None}
    assert found.document["summary"][0]["rms"] > 1
    lost = run("relative-illumination", "double_gauss", "--f-number", 0.1, "--samples", 3)
    assert "nothing to show" in lost.err  # nor a solid angle of 1e13 sr


@pytest.mark.parametrize(
    "command",
    [
        "double_gauss --field 0,3 --wavelength 0.55",  # through a map of the rays
        "cooke_triplet --f-number 1.2 --field 0,3 --wavelength 0.55",  # of rays, some of them lost
    ],
)
def test_a_blur_of_very_many_pixels_is_refused_before_it_is_cut_into_cells(run, command):
    """Cells as narrow as a pixel: 33 million of 130 bytes, or 16 million of 33, for each kernel."""
    defocused = ["--object-distance", 1000, "--pixel", 1e-4, "--size", 9, "--tol", 0.5, "--model", "drt"]
    found = run("psf", *command.split(), *defocused, "--max-bytes", "300MB")
    assert found.code == 1
    assert found.out == ""
    assert "pupil cells for each of 1 kernels: the blur spans many pixels" in found.err.splitlines()[-1]
    assert "300 MB may be taken): give a larger --pixel" in found.err


def test_an_object_in_the_first_surface_has_no_invariant_and_no_aberrations(run):
    text = run("seidel", singlet("touching", ("DISZ INFINITY", "DISZ 0")), "--kind", "waves").out
    assert "optical invariant - mm" in text
    assert "nan" not in text

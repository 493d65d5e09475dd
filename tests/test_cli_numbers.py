"""The command on what has no number: lost rays, quantities that do not exist, wavelengths that nothing is known at."""

import json
from pathlib import Path
from typing import NamedTuple

import pytest

from raytrace.cli import main

LENSES = Path(__file__).parents[1] / "lenses"


class Outcome(NamedTuple):
    code: int
    out: str
    err: str

    @property
    def document(self) -> dict:
        return json.loads(self.out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))


@pytest.fixture
def run(capsys, monkeypatch, tmp_path):
    """Run one command line in an empty folder."""
    monkeypatch.chdir(tmp_path)

    def command(*words) -> Outcome:
        capsys.readouterr()
        code = main([str(word) for word in words])
        return Outcome(code, *capsys.readouterr())

    return command


COMMANDS = [
    "info hubble",
    "spot double_gauss",
    "focus double_gauss",
    "mtf double_gauss",
    "compare double_gauss",
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


@pytest.mark.parametrize("command", ["info", "spot", "focus", "trace", "psf --model paraxial", "lateral", "layout"])
def test_extrapolation_is_told_once_for_each_glass(run, command):
    verb, *options = command.split()
    found = run(verb, "double_gauss", "--wavelength", 3, *options, *(["--plot", "x.png"] if verb == "layout" else []))
    assert found.code == 0
    told = [line for line in found.err.splitlines() if "extrapolated" in line]
    assert [line.split(": ")[3].split(" is ")[0] for line in told] == ["SK2 (SCHOTT)", "SK16 (SCHOTT)", "F5 (SCHOTT)"]
    assert told[0].endswith("is extrapolated to 3 µm; its coefficients hold from 0.31 to 2.325 µm")


def test_extrapolation_is_told_of_a_wavelength_of_codesign(run):
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


@pytest.mark.parametrize("command", ["spot", "spot --rays 500", "focus --field 0", "compare"])
def test_an_object_na_far_away_is_told_with_what_would_hold_the_beam(run, command):
    """An entrance pupil of 5 m in front of a lens of 12 mm."""
    text = (LENSES / "singlet.zmx").read_text(encoding="utf-8")
    for old, new in NA.items():
        text = text.replace(old, new)
    Path("na.zmx").write_text(text, encoding="utf-8")
    verb, *options = command.split()
    distance = ["--focus-distance" if verb == "compare" else "--object-distance", 25000]
    found = run(verb, "na.zmx", *distance, *options)
    assert "all " in found.err
    assert "rays lost: missed surface 3" in found.err
    assert "the aperture is an object NA of 0.1, whose entrance pupil is" in found.err
    assert "F-number" in found.err
    assert "nan" not in found.out
    held = run(verb, "na.zmx", *distance, *options, "--epd", 12.5) if verb != "compare" else None
    assert held is None or "lost" not in held.err


def test_wavefronts_of_aimed_rays(run):
    """The retrofocus aims its rays at the stop: points of the pupil meet an axis of object distances there."""
    (row, *_) = run("wavefront", "retrofocus", "--field", 0, "--size", 8, "--json").document["summary"]
    assert 0.1 < row["rms"] < 1

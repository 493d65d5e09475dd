"""The command on what has no number: lost rays, quantities that do not exist, wavelengths that nothing is known at."""

import json
from typing import NamedTuple

import pytest

from raytrace.cli import main


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

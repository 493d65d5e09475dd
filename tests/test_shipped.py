"""Type hints of the package, and the sources of the frozen oracles."""

import inspect
import json
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import raytrace as rt

ROOT = Path(__file__).parents[1]
ORACLES = ROOT / "tests" / "oracles"
DESCRIBED = dict(re.findall(r"^\| `([^`]+)` \| (.+) \|$", (ORACLES / "README.md").read_text(encoding="utf-8"), re.M))

FUNCTIONS = [name for name in rt.PUBLIC if inspect.isfunction(rt.public_name(name))]


def test_type_checkers_know_that_the_package_has_hints():
    """The file is in the installed package, and the wheel takes the whole of that folder."""
    assert (Path(rt.__file__).parent / "py.typed").is_file()
    build = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["hatch"]["build"]
    assert build["targets"]["wheel"]["packages"] == ["raytrace"]
    assert "exclude" not in build["targets"]["wheel"]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_public_verb_has_type_hints(name):
    signature = inspect.signature(rt.public_name(name))
    bare = [one.name for one in signature.parameters.values() if one.annotation is one.empty]
    assert not bare
    assert signature.return_annotation is not signature.empty


def test_every_file_of_oracles_is_described_and_every_described_file_is_there():
    there = {path.name for path in ORACLES.iterdir() if path.is_file()} - {"README.md"}
    assert there == set(DESCRIBED)
    for description in DESCRIBED.values():
        for generator in re.findall(r"`(\w+\.py)`", description):
            assert (ORACLES / generator).is_file(), generator


def test_dispersion_oracles_equal_the_output_of_their_generator():
    pytest.importorskip("mpmath")
    done = subprocess.run([sys.executable, ORACLES / "make_dispersion.py"], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout) == json.loads((ORACLES / "dispersion.json").read_text())

"""CONTRIBUTING.md: its changes apply to a copy of the package, and the tests that it shows pass there."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
#: A file in backticks, and the block of its change or of its text.
BLOCK = re.compile(r"^`([\w/.]+)`[^\n]*:\n\n(`{3,})(diff|python)\n(.*?)^\2$", re.M | re.S)
BLOCKS = [(path, kind, text) for path, _, kind, text in BLOCK.findall((ROOT / "CONTRIBUTING.md").read_text("utf-8"))]
TESTS = [path for path, kind, _ in BLOCKS if kind == "python" and path.startswith("tests/")]


def changed(text: str, change: str) -> str:
    """A text after the changes of a block; each place occurs once."""
    for place in change.split("…\n"):
        lines = place.splitlines(keepends=True)
        before, after = ("".join(line[1:] for line in lines if line[0] in signs) for signs in (" -", " +"))
        assert text.count(before) == 1, f"once expected, found {text.count(before)} times:\n{before}"
        text = text.replace(before, after)
    return text


@pytest.fixture(scope="module")
def copy(tmp_path_factory) -> Path:
    """A copy of the repository with all changes of the page."""
    root = tmp_path_factory.mktemp("contribution")
    for folder in ("raytrace", "tests", "docs"):
        shutil.copytree(ROOT / folder, root / folder, ignore=shutil.ignore_patterns("__pycache__", "_build", "*.png"))
    for name in ("glass_catalogs", "lenses", "pyproject.toml", "README.md"):
        (root / name).symlink_to(ROOT / name)
    for path, kind, text in BLOCKS:
        file = root / path
        assert file.exists() == (kind == "diff"), path
        file.write_text(changed(file.read_text("utf-8"), text) if kind == "diff" else text, "utf-8")
    run(root, "tests/test_stub.py")
    return root


def run(root: Path, *words: str, compiler: str = "no-compiler") -> str:
    """The output of Python in a copy. Torch traces, unless there is a compiler: it takes a minute to compile a copy."""
    settings = {"PYTHONPATH": str(root), "MPLBACKEND": "Agg", "CXX": compiler, "RAYTRACE_CACHE": str(root / "cache")}
    process = subprocess.run(
        [sys.executable, *words], cwd=root, env=os.environ | settings, capture_output=True, text=True, timeout=1800
    )
    assert process.returncode == 0, process.stdout[-4000:] + process.stderr[-2000:]
    return process.stdout


def passed(root: Path, *words: str, **settings) -> int:
    """How many tests pass in a copy; the others of these fail."""
    summary = run(root, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-n", "0", *words, **settings).splitlines()[-1]
    return int(re.match(r"(\d+) passed", summary)[1])


def test_every_addition_has_a_test_that_the_page_runs():
    page = (ROOT / "CONTRIBUTING.md").read_text("utf-8")
    assert len(TESTS) == 4
    for path in TESTS:
        assert f"\npytest {path}\n" in page


@pytest.mark.parametrize(("path", "kind", "text"), BLOCKS, ids=[path for path, *_ in BLOCKS])
def test_every_change_applies(path, kind, text):
    """To a file of the repository; a new file is Python."""
    file = ROOT / path
    assert file.exists() == (kind == "diff")
    new = changed(file.read_text("utf-8"), text) if kind == "diff" else text
    if path.endswith(".py"):
        compile(new, path, "exec")


@pytest.mark.slow
def test_the_shown_tests_pass(copy):
    assert passed(copy, "-k", "not compiled", *TESTS) >= 8


@pytest.mark.slow
def test_the_shown_sag_is_compiled(copy):
    """The trace of the copy, with its adjoint and its tangents."""
    assert passed(copy, "-k", "compiled", "tests/test_ripple.py", compiler="") == 2


@pytest.mark.slow
def test_the_code_is_formatted_and_its_command_runs(copy):
    files = [path for path, _, _ in BLOCKS if path.endswith(".py")]
    run(copy, "-m", "ruff", "check", "-q", *files)
    run(copy, "-m", "ruff", "format", "--check", "-q", *files)
    assert "miss" in run(copy, "-m", "raytrace", "pupil-aberration", "double_gauss", "--samples", "3")


@pytest.mark.slow
def test_the_changed_package_keeps_its_structure(copy):
    """The tests of the repository that a commit runs, but for counts of files: those are of the compiled trace."""
    (line,) = re.findall(r"^pytest (tests/test_layers.*)$", (ROOT / "CONTRIBUTING.md").read_text("utf-8"), re.M)
    run(copy, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-k", "not runs_through_few_files", *line.split())

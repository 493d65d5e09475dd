"""Shared by all tests: settings (hypothesis draws the same examples in every run), and fixtures."""

import functools
import gc
import json
from typing import NamedTuple

import pytest
import torch
from hypothesis import settings

from raytrace import cli
from raytrace.analysis.focus_report import focus
from raytrace.io import read_lens
from raytrace.tracing.compiled import prepare, trace_engine
from raytrace.tracing.compiler import NoCompiler, library

gc.disable()  # while tests are collected: nothing that imports make is garbage

settings.register_profile("reproducible", derandomize=True, deadline=None)
settings.load_profile("reproducible")


@pytest.fixture(scope="session", autouse=True)
def _compiled_trace():
    """Tests trace as a user does who has compiled the trace before, whichever of them comes first."""
    prepare()


@pytest.fixture(scope="session", autouse=True)
def _one_parser():
    """The parser of the command line, built once for all commands of a session instead of once for each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "build_parser", functools.cache(cli.build_parser))
        yield


@pytest.fixture(scope="session", autouse=True)
def _imports_are_no_garbage():
    """The collector leaves alone what imports and the collection of tests have made, instead of looking it through."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)  # trees and tensors of a test are many: looked through less often than by default
    gc.enable()


@pytest.fixture
def compiler():
    """Skips what needs the compiled trace where it cannot be had."""
    try:
        library()
    except NoCompiler as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def lens():
    """The shipped double Gauss."""
    return read_lens("double_gauss")


@pytest.fixture(scope="module")
def triplet():
    """The shipped Cooke triplet."""
    return read_lens("cooke_triplet")


@pytest.fixture(scope="module")
def focused_triplet(triplet):
    """The same at its best focus."""
    return focus(triplet).lens


@pytest.fixture
def engine(request):
    """Traces by torch alone, or as `problems.both_engines` says."""
    name = getattr(request, "param", "eager")
    with trace_engine(name):
        yield name


class Outcome(NamedTuple):
    """What became of a command line."""

    code: int
    out: str
    err: str

    @property
    def document(self) -> dict:
        """The one JSON document on standard output, read strictly: no NaN, no Infinity, nothing after it."""
        return json.loads(self.out, parse_constant=lambda name: pytest.fail(f"{name} is not JSON"))

    @property
    def error(self) -> str:
        """The message of a command that failed: one line, nothing on standard output."""
        assert self.code in (1, 2), self
        assert self.out == ""
        lines = [line for line in self.err.splitlines() if not line.startswith("raytrace: warning: ")]
        assert len(lines) == 1, self.err
        assert lines[0].startswith("raytrace: error: ")
        assert "a defect of raytrace" not in lines[0]
        assert "Traceback" not in self.err
        return lines[0]


@pytest.fixture
def command_line(capsys, tmp_path, monkeypatch):
    """Run a command line in an empty folder: exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)
    for name in ("RAYTRACE_CATALOGS", "RAYTRACE_TRACEBACK"):
        monkeypatch.delenv(name, raising=False)

    def call(*arguments) -> Outcome:
        capsys.readouterr()
        code = cli.main([*map(str, arguments)])
        return Outcome(code, *capsys.readouterr())

    return call


@pytest.fixture
def run(command_line):
    """The same by its short name; where `command` is a word that is run, too."""
    return command_line


@pytest.fixture
def command(command_line):
    """The same; `run` then is a subcommand."""
    return command_line


@pytest.fixture
def threads():
    """Threads of torch as they were, whatever the test sets."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture
def same_threads():
    """A command may set them for a while, and must leave as many as there were."""
    before = torch.get_num_threads()
    yield
    assert torch.get_num_threads() == before, "another number of threads was left behind"

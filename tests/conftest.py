"""Settings of all tests: hypothesis draws the same examples in every run, and parallel workers take a core each."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is loaded: threads of workers would hinder each other

import pytest
from hypothesis import settings

from raytrace.cli import main
from raytrace.fused import prepare, tracing

settings.register_profile("reproducible", derandomize=True, deadline=None)
settings.load_profile("reproducible")


@pytest.fixture(scope="session", autouse=True)
def _compiled_trace():
    """Tests trace as a user does who has compiled the trace before, whichever of them comes first."""
    prepare()


@pytest.fixture
def engine(request):
    """Traces by torch alone, or as `problems.both_engines` says."""
    name = getattr(request, "param", "eager")
    with tracing(name):
        yield name


@pytest.fixture
def command(capsys, tmp_path, monkeypatch):
    """Run a command line in an empty folder: exit code, standard output, standard error."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("RAYTRACE_TRACEBACK", raising=False)

    def call(*arguments):
        capsys.readouterr()
        code = main([*map(str, arguments)])
        return code, *capsys.readouterr()

    return call

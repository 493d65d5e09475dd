"""Settings of all tests: hypothesis draws the same examples in every run."""

import pytest
from hypothesis import settings

from raytrace.cli import main

settings.register_profile("reproducible", derandomize=True, deadline=None)
settings.load_profile("reproducible")


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

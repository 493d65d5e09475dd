"""Loads `shared_fixtures.py`, except in the process of `pytest -n` that only distributes tests to its workers."""

import contextlib
import importlib
import os
from pathlib import Path

import pytest

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is loaded: threads of workers would hinder each other


def pytest_configure(config):
    if not config.getoption("numprocesses", None):
        config.pluginmanager.import_plugin("shared_fixtures")


@pytest.hookimpl(tryfirst=True)
def pytest_collection(session):
    """Before a worker collects all tests it imports a part of the files, whose compiled form the other workers read."""
    worker = os.environ.get("PYTEST_XDIST_WORKER", "").removeprefix("gw")
    if worker and not any(".py" in argument for argument in session.config.args):
        files = sorted(Path(__file__).parent.glob("test_*.py"))
        for path in files[int(worker) :: session.config.workerinput["workercount"]]:
            with contextlib.suppress(pytest.skip.Exception):  # of a whole file
                importlib.import_module(path.stem)


@pytest.hookimpl(tryfirst=True)  # before `-m` deselects
def pytest_collection_modifyitems(items):
    lines = (Path(__file__).parent / "slow_cases.txt").read_text(encoding="utf-8").splitlines()
    names = {line for line in lines if line and not line.startswith("#")}
    for item in items:
        if item.nodeid in names:
            item.add_marker(pytest.mark.slow)

"""Loads `shared_fixtures.py`, except in the process of `pytest -n` that only distributes tests to its workers.

Leaves out tests of files that no clone has, and reports how many.
"""

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


#: The number of tests that are left out, for want of files of third parties.
LEFT_OUT = pytest.StashKey[int]()


def needs_missing(item: pytest.Item) -> bool:
    return not all(Path(folder).exists() for mark in item.iter_markers("needs") for folder in mark.args)


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_collection_modifyitems(config, items):
    """Marks slow cases before `-m` deselects, and then leaves out tests of missing files."""
    lines = (Path(__file__).parent / "slow_cases.txt").read_text(encoding="utf-8").splitlines()
    names = {line for line in lines if line and not line.startswith("#")}
    for item in items:
        if item.nodeid in names:
            item.add_marker(pytest.mark.slow)
    yield
    missing = [item for item in items if needs_missing(item)]
    if missing:
        items[:] = [item for item in items if not needs_missing(item)]
        config.hook.pytest_deselected(items=missing)
    config.stash[LEFT_OUT] = len(missing)


def pytest_sessionfinish(session):
    if hasattr(session.config, "workeroutput"):  # of `pytest -n`: every worker collects the same tests
        session.config.workeroutput["left_out"] = session.config.stash.get(LEFT_OUT, 0)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node):
    node.config.stash[LEFT_OUT] = getattr(node, "workeroutput", {}).get("left_out", 0)


def pytest_terminal_summary(terminalreporter, config):
    if count := config.stash.get(LEFT_OUT, 0):
        terminalreporter.write_line(f"{count} tests are left out: they read files of third parties in ../shared.")

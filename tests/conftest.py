"""Loads `shared_fixtures.py`, except in the process of `pytest -n` that only distributes tests to its workers."""

import os

if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # before torch is loaded: threads of workers would hinder each other


def pytest_configure(config):
    if not config.getoption("numprocesses", None):
        config.pluginmanager.import_plugin("shared_fixtures")

"""The scripts of docs/experiments as modules."""

import importlib
import sys
from pathlib import Path
from types import ModuleType

FOLDER = Path(__file__).parents[1] / "docs" / "experiments"


def script(name: str) -> ModuleType:
    """A script by its name; scripts import one another."""
    if str(FOLDER) not in sys.path:
        sys.path.insert(0, str(FOLDER))
    return importlib.import_module(name)

"""Studies: each brings the words of its command; found by name, so that nothing of the library imports a study."""

import importlib


def words(study: str) -> tuple:
    """The entries of a study's command or subcommands, WORDS of `raytrace/studies/STUDY/words.py`."""
    return importlib.import_module(f"raytrace.studies.{study}.words").WORDS

"""Lens files of Zemax OpticStudio: .zmx, read and written, and .zar archives, read.

A new surface type is a row in `surfaces.py`, a keyword a row in `keywords.py`; tests: `tests/test_zemax*.py`.
"""

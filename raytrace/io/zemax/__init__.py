"""Lens files of Zemax OpticStudio: .zmx, read and written, and .zar archives, read.

A surface type, a keyword and its power of length are rows in `surfaces.py`; tests: `tests/test_zemax*.py`.
"""

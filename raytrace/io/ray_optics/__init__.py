"""Optical models of ray-optics (.roa), read; tests: `tests/test_roa.py`."""

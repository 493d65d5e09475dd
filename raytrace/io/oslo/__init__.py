"""Lens files of OSLO (.len), read: a command is a row in `keywords.py`; tests: `tests/test_oslo.py`."""

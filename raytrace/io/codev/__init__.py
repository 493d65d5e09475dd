"""Lens files of CODE V (.seq), read and written: a command is a row in `keywords.py`; tests: `tests/test_codev.py`."""

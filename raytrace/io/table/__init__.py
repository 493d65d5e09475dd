"""Prescription tables (.csv, .tsv, .txt); a column is a row in `columns.py`; `tests/test_table.py`."""

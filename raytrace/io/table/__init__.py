"""Prescription tables (.csv, .tsv, .txt, and tables of pandas), read and written.

columns    headings and the quantity of each
text       header lines, headings and cells of a text; spellings of numbers
system     aperture, fields, wavelengths and the rest of the system in header lines, read and written
read       surfaces, media, stop, object and image, read
write      the columns, written

To add a spelling of a heading: a word of `_SPELLINGS` in `columns`; a heading to leave out: `_OTHERS`. A header key: a
row of `_KEYS` in `text`, its reader and its line of `written` in `system`.

Tests: `tests/test_table.py`, also of pandas; layouts of patents and programs in `tests/test_table_layouts.py`.
"""

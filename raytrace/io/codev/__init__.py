"""Lens files of CODE V (.seq), read and written.

keywords    the commands, a row each, and a text sorted by them into the system and its surfaces
glass       media: of catalogs, by index and Abbe number, and private ones; read and written
read        the system, surfaces, poses and apertures, read
write       the same, written

To add a command that is left out or refused: its reason in `LEFT_OUT` or `REFUSED`. A command that is read: its word in
`SYSTEM_READ` or `SURFACE_READ`. A kind of field, of aperture, or a number of a pose: a row of `FIELD_KINDS`,
`SYSTEM_APERTURES`, `APERTURES` or `POSE_WORDS`, which reader and writer use. A formula of private glasses: a row of
`FORMULA_WORDS` in `glass`.

Tests: `tests/test_codev.py`, and real files in `tests/test_corpus.py`.
"""

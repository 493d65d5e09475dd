"""Lens files of Zemax OpticStudio: .zmx, read and written, and .zar archives, read.

surfaces          the tables: keywords, values with path, unit and operand (`ROWS`), types of surface; surfaces read
read              the system, and the lens
configurations    multi-configuration operands, read; environments of surfaces, read and written
optimization      variables, solves, pickups, merit function and tolerances, read and written
tolerances        the lines of tolerances as rows
written_form      the lens in the terms of a file: sag terms, decentres along z
write             the system, surfaces, apertures and operands, written; the unit of the file
archive           members of a .zar archive, unpacked

To add:
- a keyword that is left out: its reason in `SYSTEM_IGNORED` or `SURFACE_IGNORED`;
- a value, or an operand of configurations: a row of `ROWS`: keyword, word, path in the lens, power of length, quantity;
  reader, writer, units and operand use it;
- a number of a surface type: a row of its PARM in `_TYPES`; a type: a row of `_TYPES`, or, of rotationally symmetric
  terms, the name `zemax` of its kind in `system.shapes`;
- a solve: a row of `CURVATURE_SOLVES` or `THICKNESS_SOLVES`.

Tests: `tests/test_zemax*.py`, `tests/test_configurations.py`, `tests/test_environment.py`, `tests/test_solves.py`; real
files in `tests/test_corpus*.py`; `tests/test_opticstudio*.py` compare with numbers that OpticStudio stored.
"""

"""Media: glasses, dispersion formulas, catalogs, temperature and pressure.

glass          dispersion formulas (`FORMULAS`), media and their refractive indices
agf            the file format of glass catalogs, read and written
catalogs       a glass by its name: order of the catalogs, aliases, suggestions
environment    indices at a temperature and a pressure
mounts         expansion of the materials of spacers, a row of `MOUNTS` each
selection      `rt.glasses`: glasses by status, price, transmittance and resistance
properties     `rt.glass`: catalog data, indices and thermal changes of a glass

To add a formula: a function of coefficients and wavelength, and a row of `FORMULAS`. A catalog: its file in
`glass_catalogs/`, and its name in `SHIPPED`; another name of it: a row of `CATALOG_NAMES`; another spelling of a glass:
a line of `glass_catalogs/ALIASES.csv`.

Tests: `tests/test_glass.py`, `tests/test_glass_table.py`, `tests/test_catalogs.py`, `tests/test_environment.py`,
`tests/test_glass_selection.py`.
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)

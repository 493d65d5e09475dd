"""Media: dispersion formulas, glasses, catalogs."""

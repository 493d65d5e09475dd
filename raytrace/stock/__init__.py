"""Stock: parts of vendors and test plates of a workshop.

parts      the glass of a vendor's lens file: focal lengths, diameters, shape, glasses
index      `stock_index`: the parts of a folder in one file, an SQLite database; `stock_find`: parts by their figures
plates     lists of test plates

`rt.edit.insert_part` puts a part into a lens, `rt.optimize(stock=…)` and `rt.optimize(test_plates=…)` fit lenses to
parts and plates. Tests: `tests/test_stock.py`, `tests/test_fit.py`.
"""

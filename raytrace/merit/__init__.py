"""Merit functions: rows of operands, evaluated with the exact derivatives of all rows by the variables of a lens."""

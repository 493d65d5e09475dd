"""Operands of merit functions, a file a family: paraxial data, aberrations, rays, wavefront, MTF, boundaries, sums.

A new operand is a function of an `EvaluationContext` and a row of `table.OPERANDS`; its test compares it with the
analysis of the same quantity (`tests/test_operands_*.py`).
"""

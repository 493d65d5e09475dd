"""Optimisation of a lens by its merit function.

variables         variable syntax; `DesignVariables`: the lens as a function of its variables
lens_state        the lens at given variables: numbers, solves, first-order data and rays, with derivatives
operands/         operands of merit functions, a file a family; `operand`: their definition; `table`: all of them
merit             default merit functions, merit functions as values, their evaluation with the Jacobian
merit_of_batch    merit functions of a batch of lenses, with derivatives
jacobian          derivatives of rays, merit functions and any function of a lens by its variables
evaluate          the value of a merit function row by row, with its table and figure
conditions        conditions of a lens: their syntax, their rows in its merit function, those that a call meets
problem           merit function and conditions as the sum of squares of the solver
least_squares     damped least squares (Levenberg–Marquardt) under bounds and conditions; L-BFGS-B of tensors
optimize          `optimize`: opening and descent
opening           rays brought through a lens at which most of them fail
attained          targets and attained values of conditions and boundaries
contradictions    conditions that exclude one another
loss              losses: spots first, descents, restarts, check by denser rays; `lifted`: a loss as a sum of squares;
                  `quantities`: landing points, transfer functions and PSFs, of which losses are functions
optimized         `Optimized`, the result of `optimize`; `optimized_figure`: its figure
checkpoint        state of a descent, from which it resumes
glass_choice      variable glasses of catalogs
search            `search`: minima found globally; `search_tasks`: its parts; `loss_minima`: minima of a loss from there
lens_moves        the search by moves: `moves`, `saddle_points` (insert, split), `removal` (delete, cement)
file_check        `check`: import report of a lens file, and which operands are evaluated

A new operand is a function of an `EvaluationContext` and a row of the table at the end of its family's file; its test
compares it with the analysis of the same quantity (`tests/test_operands_FAMILY.py`). Every number of a surface that
`system.parameter_paths` lists can vary. Tests of variables and constraints: `tests/test_variable_syntax.py`,
`test_constraints.py`; of the descent: `test_optimize.py`, `test_attained.py`, `test_checkpoint.py`; `test_search.py`.
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)

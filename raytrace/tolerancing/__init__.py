"""Tolerancing: errors of manufacture as values, and lenses with such errors.

table           `ToleranceTable`: rows, compensators and the wavelength of the test
perturbation    `perturbed`: the lens with an error for each row, one lens or many
sampling        `draw_errors`: random errors, the same for a trial in any batch
files           `read_tolerances`: the rows of a .zmx file
criteria        RMS spot radius, RMS wavefront, MTF, merit, change of the PSF, boresight: of a batch of lenses
study           `Study`: a criterion as a function of errors and compensators, its best compensators, its second order
radial          radial errors at their limits, in the direction of their largest change
makeable        limits that a workshop makes, their steps and their costs
tightening      limits by inverse sensitivity, and those of a yield at least cost
monte_carlo     the criterion of random lenses, resumable
analysis        `tolerance` and its result: sensitivities, expectation, trials, table and figure
as_built        `AsBuilt`: the expectation as a term of a merit function, with exact derivatives
grades          `tolerances`: rows of published grades and of limits
jacobian        `jacobian`: derivatives of any quantity by design variables and errors

A kind of error is a row of `KINDS` in `system/tolerance_data.py`.
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)

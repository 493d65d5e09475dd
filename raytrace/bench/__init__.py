"""`raytrace bench`: speed against error of the trace, of PSFs and of pictures, on a lens and a machine of the user.

| module      | contents                                                                             |
|-------------|--------------------------------------------------------------------------------------|
| `command`   | the command: its subjects and their options                                          |
| `trace`     | speed of the trace over the number of rays                                           |
| `psf`       | time of every PSF model at every sampling, and its error against a converged kernel  |
| `camera`    | time of a training step and of a picture, and its error against direct superposition |
| `measure`   | tracers, their errors, and calls timed in turns                                      |
| `reference` | a ray tracer of 50 digits, the reference of the trace                                |
| `result`    | measurements as text, CSV, JSON and figure                                           |

Comparisons with other packages, limits of the machine and the published pages are `docs/experiments/bench_*.py`.
Tests: `tests/test_bench_*.py`.
"""

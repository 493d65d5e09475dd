"""Benchmarks: speed against error, by independent references of high precision, and compared with other packages.

| module      | contents                                                                                    |
|-------------|---------------------------------------------------------------------------------------------|
| `command`   | `raytrace bench trace`, `psf` and `speed`                                                   |
| `measure`   | tracers, their errors, and calls timed in turns                                             |
| `trace`     | speed of the trace over the number of rays                                                  |
| `speed`     | ratios to peers: batches, gradients, aspheres, the step of the sensor distance              |
| `psf`       | cases and methods of PSFs, their converged kernels, times and errors                        |
| `reference` | a ray tracer of 50 digits, reference of the others                                          |
| `peers`     | Optiland and ray-optics, with the extra [bench]                                             |
| `report`    | rows as page, CSV, JSON and figure; `figures` draws                                         |

A PSF case is a row of `psf.USUAL`, a method a row of `psf.methods`, a stage of the speed benchmark a row of
`speed.STAGES`; a peer has the methods of `measure.Tracer`. Tests: `tests/test_bench*.py`. Scripts that make the
published pages from these measurements are `docs/experiments/bench_*.py`.
"""

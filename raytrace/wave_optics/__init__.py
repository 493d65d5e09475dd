"""Wave optics: thin phase elements, the propagation of light behind them, and their PSFs.

| module        | contents                                                                                        |
|---------------|-------------------------------------------------------------------------------------------------|
| element       | height profiles (pixels, rings, Zernike, even powers): table KINDS; path, wrapping, levels       |
| designs       | named elements: lens, kinoform, multifocal, cubic plate, achromat: table BASELINES              |
| fabrication   | rings and pixels of a smooth element, etchable heights, tolerances                              |
| height_maps   | files of heights: table FORMATS; element_files: heights with a label                            |
| scene         | point sources, elements in contact, sensor                                                      |
| plan          | choice of engine and sampling, predicted cost and error: table ENGINES                          |
| pupil         | matrix Fourier transform of the residual path                                                   |
| propagation   | radial engine of round elements; Fresnel and angular-spectrum propagation                       |
| mixed         | round elements with steps in contact with smooth ones that are not round                        |
| compute       | `wave_psf`, `phase_elements`, the result and caustics; figures                                   |
| hybrid        | an element on a surface of a traced lens: `hybrid_psf`, `element_lens`                          |

To add:

- a profile: a value and its height in `element`, a row of KINDS;
- a named element: a function of an `Aim` in `designs`, a row of BASELINES;
- a file format: a pair (read, write) in `height_maps`, a row of FORMATS;
- an engine: a plan with its error, and kernels, a row of `plan.ENGINES`.

Tests: tests/test_wave_MODULE.py; test_wave_psf (compute), test_wave_plan_errors (predicted errors),
test_wave_propagation and test_wave_radial (engines).
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)

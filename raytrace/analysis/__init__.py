"""Analyses of a lens: a file each has the computation, the result with its table, and the figure.

| function                                    | result                                                         |
|---------------------------------------------|----------------------------------------------------------------|
| layout, spot, focus                         | cross section, spot diagram, best sensor distance              |
| ray_fan, opd_fan                            | aberrations along the two sections of the pupil                |
| wavefront                                   | OPD over the pupil, Zernike coefficients, Strehl ratio         |
| mtf                                         | modulation, of diffraction or of rays, through focus           |
| encircled_energy                            | light within a radius, of diffraction or of rays               |
| distortion, field_curvature, lateral_colour | from chief rays and close rays around them                     |
| relative_illumination                       | light of a field against the axis                              |
| vignetting                                  | light cut over the field, and the surfaces that cut it         |
| footprint                                   | beams on a surface with its apertures                          |
| rms_over_field                              | RMS wavefront or spot, each wavelength and all together        |
| seidel                                      | third-order aberrations and colours by surface, their sums     |
| chromatic_focal_shift                       | where each wavelength has its paraxial focus                   |
| longitudinal_aberration                     | where rays cross the axis, over the pupil                      |
| thermal                                     | focus, spot and MTF over temperature                           |
| depth_of_field                              | near and far limits of sharpness, hyperfocal distance          |
| distortion_grid                             | image of a square grid of object points                        |
| incidence                                   | angles at which beams meet every surface and the sensor        |
| intercepts                                  | named rays at every surface, the largest heights and angles    |
| sag                                         | sag, slope, aspheric departure, best-fit sphere of a surface   |
| compare, abilities                          | PSF models, and the properties that each can represent         |

`result` has what their results share (a lens, fields, a summary), `setting` their fields and wavelengths, `panels`
their figures of curves. Fields are y or (x, y), wavelengths in µm.

To add an analysis: a file with a function, whose docstring has an entry for each parameter, and a subclass of
`Analysis` with `columns`, and `draw` for a figure; a row of `PUBLIC` in `raytrace/__init__.py` and of `COMMANDS` in
`cli/commands.py`. The text, CSV, JSON and the options of the command follow from those. Tests: `test_analysis` (all of
them), `test_plot_analysis` (figures), `test_result` (units) and `test_NAME` (each by itself).
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)

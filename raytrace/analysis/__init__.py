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
| rms_over_field                              | RMS wavefront or spot, each wavelength and all together        |
| seidel                                      | third-order aberrations and colours by surface, their sums     |
| chromatic_focal_shift                       | where each wavelength has its paraxial focus                   |
| longitudinal_aberration                     | where rays cross the axis, over the pupil                      |
| distortion_grid                             | image of a square grid of object points            |
| incidence                                   | angles at which beams meet every surface and the sensor        |
| compare, abilities                          | PSF models, and the properties that each can represent         |

Fields are y or (x, y), wavelengths in µm.
"""

from raytrace.analysis.compare import Abilities as Abilities
from raytrace.analysis.compare import Comparison as Comparison
from raytrace.analysis.compare import abilities as abilities
from raytrace.analysis.compare import common_focus as common_focus
from raytrace.analysis.compare import compare as compare
from raytrace.analysis.compare import side_by_side as side_by_side

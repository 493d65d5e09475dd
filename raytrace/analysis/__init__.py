"""Analyses of a lens: each a function of the lens that gives a value which tabulates, prints and draws itself.

| verb                                        | what it shows                                                  |
|---------------------------------------------|----------------------------------------------------------------|
| ray_fan, opd_fan                            | aberrations along the two sections of the pupil                |
| wavefront                                   | OPD over the pupil, Zernike coefficients, Strehl ratio         |
| mtf                                         | modulation, of diffraction or of rays, through focus           |
| encircled_energy                            | light within a radius, of diffraction or of rays               |
| distortion, field_curvature, lateral_colour | what chief rays and the close rays about them show             |
| relative_illumination                       | light of a field against the axis                              |
| rms_over_field                              | RMS wavefront or spot, each wavelength and all together        |
| seidel                                      | third-order aberrations and colours by surface, their sums     |
| chromatic_focal_shift                       | where each wavelength has its paraxial focus                   |
| longitudinal_aberration                     | where rays cross the axis, over the pupil                      |
| distortion_grid                             | a square grid of object points as the sensor sees it           |
| incidence                                   | angles at which beams meet every surface and the sensor        |
| compare, abilities                          | PSF models side by side, and what each of them can represent   |

Each takes fields as y or (x, y), wavelengths in µm, and the options of its command; a file of this folder holds one, or
a few that are alike.
"""

from raytrace.analysis.compare import Abilities as Abilities
from raytrace.analysis.compare import Comparison as Comparison
from raytrace.analysis.compare import abilities as abilities
from raytrace.analysis.compare import common_focus as common_focus
from raytrace.analysis.compare import compare as compare
from raytrace.analysis.compare import side_by_side as side_by_side

"""Analyses of a lens: each a function of the lens that gives a value, with `to_frame()` and, of tensors, gradients.

| call                                      | what it shows                                                  |
|-------------------------------------------|----------------------------------------------------------------|
| ray_fan, opd_fan                          | aberrations along the two sections of the pupil                |
| wavefront_map                             | OPD over the pupil, Noll's Zernike coefficients                |
| mtf, mtf_through_focus                    | modulation, of diffraction or of rays                          |
| encircled_energy                          | light within a radius, of diffraction or of rays               |
| distortion, field_curvature, lateral_colour | what chief rays and the close rays about them show           |
| relative_illumination                     | light of a field against the axis                              |
| rms_over_field                            | RMS wavefront or spot, each wavelength and all together        |
| seidel                                    | third-order aberrations and colours by surface, their sums     |
| longitudinal_aberration                   | where rays cross the axis, over the pupil                      |
| grid_distortion                           | a square grid of object points as the sensor sees it           |
| incidence                                 | angles at which beams meet every surface and the sensor        |
| compare, abilities                        | PSF models side by side, and what each of them can represent   |
"""

from raytrace.analysis.chief import Distortion as Distortion
from raytrace.analysis.chief import FieldCurvature as FieldCurvature
from raytrace.analysis.chief import LateralColour as LateralColour
from raytrace.analysis.chief import distortion as distortion
from raytrace.analysis.chief import field_curvature as field_curvature
from raytrace.analysis.chief import lateral_colour as lateral_colour
from raytrace.analysis.compare import Abilities as Abilities
from raytrace.analysis.compare import Comparison as Comparison
from raytrace.analysis.compare import abilities as abilities
from raytrace.analysis.compare import common_focus as common_focus
from raytrace.analysis.compare import compare as compare
from raytrace.analysis.compare import side_by_side as side_by_side
from raytrace.analysis.encircled import EncircledEnergy as EncircledEnergy
from raytrace.analysis.encircled import encircled_energy as encircled_energy
from raytrace.analysis.fans import Fan as Fan
from raytrace.analysis.fans import opd_fan as opd_fan
from raytrace.analysis.fans import ray_fan as ray_fan
from raytrace.analysis.grid import GridDistortion as GridDistortion
from raytrace.analysis.grid import grid_distortion as grid_distortion
from raytrace.analysis.illumination import RelativeIllumination as RelativeIllumination
from raytrace.analysis.illumination import relative_illumination as relative_illumination
from raytrace.analysis.incidence import Incidence as Incidence
from raytrace.analysis.incidence import incidence as incidence
from raytrace.analysis.longitudinal import LongitudinalAberration as LongitudinalAberration
from raytrace.analysis.longitudinal import longitudinal_aberration as longitudinal_aberration
from raytrace.analysis.mtf import Mtf as Mtf
from raytrace.analysis.mtf import ThroughFocusMtf as ThroughFocusMtf
from raytrace.analysis.mtf import cutoff as cutoff
from raytrace.analysis.mtf import diffraction_limit as diffraction_limit
from raytrace.analysis.mtf import mtf as mtf
from raytrace.analysis.mtf import mtf_through_focus as mtf_through_focus
from raytrace.analysis.rms import RmsOverField as RmsOverField
from raytrace.analysis.rms import rms_over_field as rms_over_field
from raytrace.analysis.seidel import Seidel as Seidel
from raytrace.analysis.seidel import seidel as seidel
from raytrace.analysis.wavefronts import WavefrontMap as WavefrontMap
from raytrace.analysis.wavefronts import wavefront_map as wavefront_map

"""Geometric optics: rays through a lens, first-order data, spots and wavefronts.

| module        | contents                                                                                       |
|---------------|------------------------------------------------------------------------------------------------|
| refraction    | Snell's law, reflection, diffraction by gratings, ideal lenses                                 |
| trace         | the trace over surfaces; Jacobian of the hits; whether the axis bends                          |
| compiled      | the same trace in C++ (`cpp/`), its gradient and tangents; compiler: builds it once            |
| paraxial      | first-order data                                                                               |
| base_ray      | first-order data about the base ray of a lens whose axis bends                                 |
| aiming        | rays through given points of the stop, and to given image points                               |
| launch        | rays of field and pupil points before surface 1; vignetting factors; filling of the stop       |
| scene         | object distances × fields × wavelengths; rays reused between calls (Memo)                      |
| clear_pupil   | points and weights over the pupil that passes all apertures; its edge moves with the lens      |
| spot          | centroid, RMS and geometric radius; rays on the sensor                                         |
| focus         | sensor distance of least RMS spot, paraxial image distances                                    |
| wavefront     | OPD on the reference sphere, RMS, Zernike coefficients                                         |
| f_number      | working F/#                                                                                    |
| streaming     | spots and gradients over any number of rays, in chunks                                         |
| ray_failures  | where rays miss, are totally reflected or vignetted; warnings                                  |
| ray_listing   | `rt.trace`: positions and directions surface by surface                                        |
| geometry      | surfaces and gaps that cannot be made; frames of the surfaces                                  |
| lens_report   | `rt.info`                                                                                      |

To add an interaction of light with a surface: a row of `system.phases.PHASES`, its deflection in `refraction`, and
its form in cpp/paths.h. A quantity of rays is a function of `Rays`, `Scene` or `Wavefront`.

Tests: tests/test_MODULE.py; test_compiled, test_compiled_sags, test_compiled_poses (C++ against torch), test_vignetting
and test_cone_angle (launch), test_wavefront_map, test_opticstudio (frozen listings of OpticStudio),
test_no_sync (no host synchronisation), test_scale (Jacobians).
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)

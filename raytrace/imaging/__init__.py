"""Imaging: cameras of a lens or a phase element, image formation, restoration, training and co-design.

| module          | contents                                                                                |
|-----------------|-----------------------------------------------------------------------------------------|
| camera          | lens, sensor and network as one module                                                  |
| variables       | of lenses and phase elements, thickness limits                                          |
| image           | convolution with PSFs, layered scenes; noise and quantisation of the sensor             |
| restoration     | linear filters (Wiener) and their errors in closed form                                 |
| network         | RED-Net                                                                                 |
| pictures        | folders of photographs, dead-leaves images                                              |
| training        | runs that resume                                                                        |
| closed_form     | a camera's error behind the best linear filter, and its minimum                         |
| codesign        | lens and network trained together                                                       |
| wave_camera     | camera with a phase element: kernels, errors, image quality; octant: of round elements  |
| wave_design     | design of the phase element                                                             |
| descent         | L-BFGS-B with exact gradients                                                           |

The only `nn.Module`s are here. Tests: tests/test_MODULE.py, test_imaging_variables (thickness limits), test_restoration
(restoration), test_wave_* (phase elements).
"""

from raytrace.imaging.camera import Camera as Camera
from raytrace.imaging.network import RedNet as RedNet
from raytrace.imaging.variables import PhaseVariables as PhaseVariables
from raytrace.imaging.variables import Variables as Variables

"""Imaging: cameras of a lens or a phase element, image formation, restoration, training and co-design.

| module          | contents                                                                                |
|-----------------|-----------------------------------------------------------------------------------------|
| camera          | optics (lens, phase element or both), sensor and restoration as one module              |
| variables       | of lenses and phase elements, thickness limits                                          |
| image           | convolution with PSFs, layered scenes; noise and quantisation of the sensor             |
| render          | pictures of a lens over its sensor; field_kernels, varying_blur, warp: PSFs, distortion |
| sensor          | pixels and their field points, Bayer mosaic, capture; spectral_response: of its channels |
| restoration     | linear filters (Wiener) and their errors in closed form                                 |
| camera_filters  | filters of a camera that follow from its current kernels                                |
| lens_pictures   | pictures of small scenes by a lens, for losses of `rt.optimize`                         |
| network         | RED-Net and a small U-Net                                                               |
| pictures        | folders of photographs, dead-leaves images                                              |
| training        | runs that resume                                                                        |
| closed_form     | a camera's error behind the best linear filter, and its minimum; octant: of round elements |
| codesign        | lens and network trained together                                                       |
| wave_camera     | numbers of a camera with an element alone, periodic pictures, image quality             |
| wave_design     | design of the phase element: start, loss and steps                                      |

The only `nn.Module`s are here. To add a restoration network: a module from images to images of the same size, passed
as `rt.Camera(variables, network)`. To add a filter: a function of transfer functions in `restoration`.

Tests: tests/test_MODULE.py; test_imaging_variables (thickness limits), test_wave_camera, test_wave_camera_noise,
test_wave_design_cli (phase elements).
"""

from raytrace import namespace
from raytrace.imaging.camera import Camera as Camera
from raytrace.imaging.network import RedNet as RedNet
from raytrace.imaging.variables import PhaseVariables as PhaseVariables
from raytrace.imaging.variables import Variables as Variables

__getattr__, __dir__ = namespace(__name__)

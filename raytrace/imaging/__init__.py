"""Imaging: a lens or thin element with variables, image formation, sensor noise, restoration and training.

camera (lens, sensor and network as one module), variables (of lenses and elements, thickness limits), image (blur by
PSFs), sensor (noise), restoration (Wiener filters and their errors), network (RED-Net), training (resumable runs).
The only `nn.Module`s of the package are here. Tests: test_camera, test_variables, test_held, test_image,
test_deconvolve, test_network, test_training.
"""

from raytrace.imaging.camera import Camera as Camera
from raytrace.imaging.network import RedNet as RedNet
from raytrace.imaging.variables import PhaseVariables as PhaseVariables
from raytrace.imaging.variables import Variables as Variables

"""Camera: what makes pictures and restores them, and what is learned: a lens or an element alone, or with a network.

The only `nn.Module`s of the package stand here.
"""

from raytrace.camera.camera import Camera as Camera
from raytrace.camera.network import RedNet as RedNet
from raytrace.camera.phase import PhaseVariables as PhaseVariables
from raytrace.camera.variables import Variables as Variables

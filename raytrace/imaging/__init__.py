"""Camera: what makes pictures and restores them, and what is learned: a lens or an element alone, or with a network.

The only `nn.Module`s of the package stand here.
"""

from raytrace.imaging.camera import Camera as Camera
from raytrace.imaging.network import RedNet as RedNet
from raytrace.imaging.variables import PhaseVariables as PhaseVariables
from raytrace.imaging.variables import Variables as Variables

"""Camera: what is learned, lenses alone or together with a network. The only `nn.Module`s of the package."""

from raytrace.camera.camera import Camera as Camera
from raytrace.camera.network import RedNet as RedNet
from raytrace.camera.variables import Variables as Variables

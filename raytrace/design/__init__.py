"""Design: what is learned, lenses alone or together with a network. The only `nn.Module`s of the package."""

from raytrace.design.camera import Camera as Camera
from raytrace.design.network import RedNet as RedNet
from raytrace.design.variables import Variables as Variables

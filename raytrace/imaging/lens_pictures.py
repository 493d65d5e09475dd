"""Pictures of small scenes by a lens, at its fields, object distances and wavelengths: a quantity for losses."""

import dataclasses
from typing import ClassVar

from torch import Tensor

from raytrace.imaging.image import blur
from raytrace.maths.numerics import value
from raytrace.optimization.quantities import Kernels
from raytrace.system.lens import Lens


@value
class LensPictures:
    """Pictures (N, D, F, W, h, w) of scenes at D object distances, F fields and W wavelengths, without noise.

    scenes: (N, C, H, W') linear light on pixels of the sensor, C 1 or the number of wavelengths; kernels: the PSFs by
    which they are blurred, of p pixels: h = H - p + 1 and w = W' - p + 1 pixels of a picture see no edge. The PSF of a
    field is that of a whole scene, which lies about the image of the field point.
    """

    scenes: Tensor
    kernels: Kernels = Kernels()

    distance_axis: ClassVar[int] = 1

    def __call__(self, lens: Lens, object_distances: Tensor | None = None) -> Tensor:
        kernels = self.kernels(lens, object_distances)
        return blur(self.scenes.to(kernels)[:, None, None], kernels)

    def denser(self, rings: int | None = None) -> "LensPictures":
        return dataclasses.replace(self, kernels=self.kernels.denser(rings))

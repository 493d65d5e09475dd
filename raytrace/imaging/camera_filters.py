"""Linear filters between a camera's image and its network, from the current transfer functions of its optics.

A camera calls its filter with H (Z, C, rows, columns) at the filter's `distances`, mm, on periods of its `spectrum`.
"""

from collections.abc import Sequence
from typing import TypeAlias

from torch import Tensor, nn

from raytrace.imaging.restoration import depth_invariant_wiener, towards_measurement
from raytrace.imaging.sensor import Sensor


class DepthInvariantFilter(nn.Module):
    """The best filter for objects at all distances (Z,) mm at once, whose pictures have the spectrum S (rows, columns).

    The sensor gives the noise.
    """

    spectrum: Tensor
    distances: Tensor

    def __init__(self, spectrum: Tensor, distances: Sequence[float]):
        super().__init__()
        self.register_buffer("spectrum", spectrum, persistent=False)
        self.register_buffer("distances", spectrum.new_tensor(distances), persistent=False)

    def forward(self, transfer: Tensor, sensor: Sensor) -> Tensor:
        """G (C, rows, columns)."""
        return depth_invariant_wiener(transfer, self.spectrum, sensor.noise_deviation(self.spectrum))


class TowardsMeasurement(nn.Module):
    """The filter `towards_measurement` for an object at a trainable distance, at first `distance` mm.

    v, t: square roots of the weight γ and of the distance in m, both trained (Sitzmann et al., 2018).
    """

    spectrum: Tensor

    def __init__(self, spectrum: Tensor, distance: float):
        super().__init__()
        self.register_buffer("spectrum", spectrum, persistent=False)
        self.v = nn.Parameter(spectrum.new_tensor(0.1))
        self.t = nn.Parameter(spectrum.new_tensor(1e-3 * distance).sqrt())

    @property
    def distances(self) -> Tensor:
        """The trained distance (1,) mm."""
        return 1e3 * self.t.square().reshape(1)

    def forward(self, transfer: Tensor, sensor: Sensor) -> Tensor:
        """G (C, rows, columns)."""
        return towards_measurement(transfer[0], self.v.square())


LinearFilter: TypeAlias = DepthInvariantFilter | TowardsMeasurement

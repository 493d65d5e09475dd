"""Grid distortion: where a square grid of object points lands on the sensor."""

import torch
from torch import Tensor

from raytrace.analysis.setting import field_range, in_object_space, unvignetted
from raytrace.maths.numerics import safe_divide, safe_sqrt
from raytrace.maths.result import Result, axis, masked
from raytrace.maths.value import value
from raytrace.optics.arrivals import chief_points
from raytrace.optics.launch import is_at_infinity
from raytrace.system.lens import Lens

_NEAR_AXIS = (
    1e-4  # of the largest field: chief rays there give the scale of the image; it leaves 1e-8 of the distortion
)


@value
class GridDistortion(Result):
    """Chief rays (2, W, N, N) mm on the sensor, of a grid of object points along y (rows) and x (columns).

    actual: where they land; ideal: where they would without distortion, by the linear map of rays close to the axis.
    distortion: (W, N, N) relative, |actual|/|ideal| - 1 from the image of the axis; 0 there. valid: (W, N, N) bool.
    fields: (2, N, N) tan θ of an object at infinity, else mm of it; wavelengths: (W,) µm.
    """

    actual: Tensor
    ideal: Tensor
    distortion: Tensor
    valid: Tensor
    fields: Tensor
    wavelengths: Tensor

    def columns(self) -> dict[str, Tensor]:
        (x, y), (ideal_x, ideal_y) = (masked(point, self.valid) for point in (self.actual, self.ideal))
        return {
            "wavelength": axis(self.wavelengths, 0, 3),
            "field_x": self.fields[0],
            "field_y": self.fields[1],
            "ideal_x": ideal_x,
            "ideal_y": ideal_y,
            "actual_x": x,
            "actual_y": y,
            "distortion": masked(self.distortion, self.valid),
        }

    def largest(self) -> Tensor:
        """The distortion (W,) of largest size, with its sign; 0 where no ray arrives."""
        shown = torch.where(self.valid, self.distortion, 0.0).flatten(1)
        return shown.gather(1, shown.abs().argmax(1, keepdim=True))[:, 0]


def grid_distortion(lens: Lens, *, wavelengths: Tensor | None = None, size: int = 11) -> GridDistortion:
    """Distortion over a `size` × `size` grid whose corners are the lens's largest field, square in tan θ or in mm.

    With the points (0, 0), (δ, 0) and (0, δ) close to the axis the ideal image of a field f is J f, J their differences
    over δ, counted from the image of the axis: on the sensor as it stands, whatever its focus. wavelengths: (W,) µm,
    the lens's primary one by default. Vignetting factors are left out: chief rays go through the middle of the pupil.
    """
    lens = unvignetted(lens)
    wavelengths = lens.wavelengths[lens.primary_wavelength][None] if wavelengths is None else wavelengths
    lens, _, corner, found = in_object_space(lens, field_range(lens, 2)[:, 1:])
    half = safe_sqrt((corner * corner).sum() / 2)
    line = half * (2 * torch.arange(size, dtype=half.dtype, device=half.device) + 1 - size) / max(size - 1, 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    step = _NEAR_AXIS * half
    zero = torch.zeros_like(step)
    close = torch.stack([torch.stack([zero, step, zero]), torch.stack([zero, zero, step])])
    wanted = torch.cat([close, torch.stack([x, y]).flatten(1)], 1)
    points, valid = chief_points(
        lens, torch.rad2deg(torch.atan(wanted)) if is_at_infinity(lens) else wanted, wavelengths
    )
    valid = valid & found
    points = (points - points[:, :1]).movedim(1, -1)  # (2, W, 3 + N²)
    along_x, along_y = points[..., 1:2] / step, points[..., 2:3] / step
    ideal = along_x * wanted[0, 3:] + along_y * wanted[1, 3:]
    length, reached = (safe_sqrt((p * p).sum(0)) for p in (ideal, points[..., 3:]))
    grid = (size, size)
    return GridDistortion(
        actual=points[..., 3:].unflatten(-1, grid),
        ideal=ideal.unflatten(-1, grid),
        distortion=safe_divide(reached - length, length).unflatten(-1, grid),
        valid=valid.movedim(0, -1)[:, 3:].unflatten(-1, grid),
        fields=torch.stack([x, y]),
        wavelengths=wavelengths,
    )

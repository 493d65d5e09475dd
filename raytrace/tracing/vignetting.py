"""Vignetting factors: the part of the entrance pupil that a field fills, an ellipse, and how it changes over the field.

The factors of a field make an affine map of the pupil, p' = V + M p. Between the fields of a lens, maps are
interpolated:

- all fields on one half-line from the axis (0, 14, 20 degrees along y): linearly in the distance from the axis, where
  the pupil is whole if no field is listed there, and the ellipse turns with the field, as in a lens of revolution;
- all on one line through the axis, on both sides of it: linearly along that line, at the foot of the perpendicular;
- elsewhere: by weights 1/distance² of all fields (Shepard, 1968).

Each is exact at the fields of the lens, continuous, and beyond the last field stays what it is there.
"""

import torch
from torch import Tensor

from raytrace.maths.numerics import broadcast_shape, dot_2, safe_divide, safe_sqrt
from raytrace.system.lens import Lens

_OFF_LINE = 1e-9  # of the largest field


def vignette(lens: Lens, field: Tensor, pupil: Tensor) -> Tensor:
    """Pupil points shrunk and shifted by the vignetting factors of a field: p' = V + (1 - C) p, in axes turned by VAN.

    field: (2, ...) in the lens's own kind of field, pupil: (2, ...), result (2, ...) broadcast.
    """
    if lens.fields.vignetting is None:
        return torch.stack([p.expand(broadcast_shape(field.shape[1:], p.shape)) for p in pupil])
    x, y, xx, xy, yy = _map_of(lens, field)
    return torch.stack([x + (xx * pupil[0] + xy * pupil[1]), y + (xy * pupil[0] + yy * pupil[1])])


def _map_of(lens: Lens, field: Tensor) -> Tensor:
    """V_x, V_y, M_xx, M_xy, M_yy (5, ...) of fields (2, ...)."""
    listed = torch.stack([lens.fields.x, lens.fields.y]).reshape(2, -1, *(1,) * (field.dim() - 1))
    maps = _maps(lens.fields.vignetting).reshape(5, *listed.shape[1:])
    same = (listed == field[:, None]).all(0)
    first = same & (same.to(torch.int64).cumsum(0) == 1)
    own = torch.where(first, maps, 0.0).sum(1)
    return torch.where(same.any(0), own, _between(listed, maps, field[:, None]))


def _maps(factors: Tensor) -> Tensor:
    """The maps (5, F) of vignetting factors (5, F): VDX, VDY, VCX, VCY, VAN."""
    vdx, vdy, vcx, vcy, angle = factors
    return _turned(torch.stack([vdx, vdy, 1 - vcx, torch.zeros_like(vcx), 1 - vcy]), *_cos_sin(angle))


def _cos_sin(degrees: Tensor) -> tuple[Tensor, Tensor]:
    return torch.cos(torch.deg2rad(degrees)), torch.sin(torch.deg2rad(degrees))


def _turned(maps: Tensor, c: Tensor, s: Tensor) -> Tensor:
    """R V and R M Rᵀ for the rotation R by the angle of cosine c and sine s."""
    x, y, xx, xy, yy = maps
    return torch.stack(
        [
            c * x - s * y,
            s * x + c * y,
            c * c * xx - 2 * c * s * xy + s * s * yy,
            c * s * (xx - yy) + (c * c - s * s) * xy,
            s * s * xx + 2 * c * s * xy + c * c * yy,
        ]
    )


def _between(listed: Tensor, maps: Tensor, field: Tensor) -> Tensor:
    """Maps (5, ...) by one of the three rules; listed: (2, F, ...), maps: (5, F, ...), field: (2, 1, ...)."""
    radius = safe_sqrt(dot_2(listed, listed))
    largest, place = radius.max(0, keepdim=True)
    x, y = (safe_divide(torch.gather(part, 0, place), largest) for part in listed)
    line = torch.stack([x, torch.where(largest > 0, y, 1.0)])
    along, across = dot_2(line, listed), _cross(line, listed)
    on_line = (across.abs() <= _OFF_LINE * largest).all(0)
    one_sided = (along >= -_OFF_LINE * largest).all(0)
    by_radius = _by_radius(radius, maps, line, field)
    by_line = _linear(along, maps, dot_2(line, field))
    return torch.where(on_line, torch.where(one_sided, by_radius, by_line), _by_distance(listed, maps, field))


def _by_radius(radius: Tensor, maps: Tensor, line: Tensor, field: Tensor) -> Tensor:
    """Linear in the distance from the axis, turned with the field; an axis that is not listed has the whole pupil."""
    axis = torch.where((radius == 0).any(0, keepdim=True), -1.0, 0.0).to(radius.dtype)
    whole = maps.new_tensor([0.0, 0.0, 1.0, 0.0, 1.0]).reshape(5, *(1,) * (maps.dim() - 1))
    asked = safe_sqrt(dot_2(field, field))
    found = _linear(torch.cat([axis, radius]), torch.cat([whole.expand(5, *axis.shape), maps], 1), asked)
    cosine = torch.where(asked > 0, safe_divide(dot_2(line, field), asked), 1.0)
    return _turned(found, cosine[0], safe_divide(_cross(line, field), asked)[0])


def _by_distance(listed: Tensor, maps: Tensor, field: Tensor) -> Tensor:
    """Weights 1/distance², taken against the nearest so that none overflows."""
    distance = dot_2(listed - field, listed - field)
    weight = safe_divide(distance.amin(0).expand_as(distance), distance)
    return safe_divide((weight * maps).sum(1), weight.sum(0))


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[0] * b[1] - a[1] * b[0]


def _linear(knots: Tensor, maps: Tensor, at: Tensor) -> Tensor:
    """Maps (5, ...) linear between knots (F, ...) in any order, constant outside; at: (1, ...)."""
    at = torch.minimum(torch.maximum(at, knots.amin(0)), knots.amax(0))
    low, below = torch.where(knots <= at, knots, -torch.inf).max(0, keepdim=True)
    high, above = torch.where(knots >= at, knots, torch.inf).min(0, keepdim=True)
    share = safe_divide(at - low, high - low)
    shape = (5, *below.shape)
    first, last = (
        torch.gather(maps.expand(5, maps.shape[1], *below.shape[1:]), 1, index.expand(shape))
        for index in (below, above)
    )
    return ((1 - share) * first + share * last)[:, 0]

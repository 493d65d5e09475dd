"""Launch of bundles: rays through the paraxial entrance pupil, with derivatives by what the pupil moves with."""

import numpy as np

from raytrace.maths.dual import value_of
from raytrace.merit.moment import Moment


def launched(moment: Moment, field: np.ndarray, pupil: np.ndarray):
    """Rays through the paraxial entrance pupil, as `optics.launch` starts them: position, direction and path."""
    data = moment.gaussian(moment.primary)
    kind, distance = moment.lens.fields.kind, moment.thickness[0]
    index = np.abs(moment.view.indices[:, :1])
    radius, depth = 0.5 * moment.entrance_pupil_diameter, data.entrance_pupil_position
    at_infinity = np.isinf(value_of(distance))
    if kind == "angle":
        slope = np.tan(np.deg2rad(field))
        x, y = slope if at_infinity else (-(distance + depth) * part for part in slope)
    elif kind == "object_height":
        x, y = field
    else:
        scale = -data.C / data.n_object if at_infinity else (data.C + data.D * moment.vergence) / moment.vergence
        x, y = (scale * part for part in field)
    aim = radius * pupil[0], radius * pupil[1], depth
    if at_infinity:
        length = np.sqrt(x * x + y * y + 1.0)
        direction = x / length, y / length, 1.0 / length
        return aim, direction, index * dot(aim, direction)
    source = x, y, -distance
    chord = tuple(a - o for a, o in zip(aim, source, strict=True))
    length, far = np.sqrt(dot(chord, chord)), np.sqrt(dot(source, source))
    # Towards +z: a virtual object lies behind surface 1, and a pupil may lie before the object.
    is_backward, is_virtual = value_of(depth) < -value_of(distance), value_of(distance) < 0
    direction = tuple((-part if is_backward else part) / length for part in chord)
    if abs(value_of(distance)) < abs(value_of(depth)):
        return source, direction, index * (far if is_virtual else -far)
    path = (dot(aim, aim) - 2 * dot(aim, source)) / (length + far)
    if is_backward:
        path = -path if is_virtual else -path - 2 * far
    return aim, direction, index * path


def dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]

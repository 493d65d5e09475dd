"""Launch: from a field point and pupil points to rays in front of surface 1."""

from torch import Tensor

from raytrace.numerics import dot, unit
from raytrace.rays import Rays
from raytrace.trace import start


def rays_from_point(point: Tensor, aim: Tensor, *, index: Tensor) -> Rays:
    """Rays of an object point O through aim points A, started at A; their path counts from |O|.

        W0 = n (|A|² - 2 A·O) / (|A - O| + |O|)

    point, aim: (3, ...) mm in the frame of surface 1; index: (...) of the object space. Any object distance.
    """
    chord = aim - point
    length = dot(chord, unit(chord)) + dot(point, unit(point))
    opl = index * (dot(aim, aim) - 2 * dot(aim, point)) / length
    return start(aim, chord, opl)


def rays_from_infinity(direction: Tensor, aim: Tensor, *, index: Tensor) -> Rays:
    """Rays of a plane wave through aim points A, started at A; W0 = n A·d is the wave's phase there.

    direction: (3, ...) of any length; aim: (3, ...) mm in the frame of surface 1; index: (...) of the object space.
    """
    return start(aim, direction, index * dot(aim, unit(direction)))

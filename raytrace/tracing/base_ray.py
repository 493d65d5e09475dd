"""Base ray: the axial chief ray of a lens whose axis bends, and first-order data about it, in both sections.

The ray of the axial object point through the middle of the stop is traced at the primary wavelength; neighbouring rays
are its derivatives, through the graph of the trace. From four of them, moved and turned in the sections of the local
x and y of the start, follow all first-order figures, as from (y, n u) in a straight lens. First derivatives of the
figures are exact; second ones lack the third derivatives of the intersection: 0.3 % off where measured.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import (
    broadcast_shape,
    dot,
    in_forward_mode,
    in_transform,
    is_any,
    safe_sqrt,
    unit,
    value,
    varies,
)
from raytrace.system.lens import Lens, batch_shape, media, shared
from raytrace.system.poses import Gap, Pose, direction_in, point_in
from raytrace.system.rays import Rays, start
from raytrace.system.surface import Surface, gap_behind
from raytrace.tracing.aiming import aim_at_middle
from raytrace.tracing.paraxial import axial_beam, cone_angle, object_distance_of
from raytrace.tracing.trace import is_bent, points_at, steps

_PARALLEL = 1e-15  # rad per mm, and other quantities that are 0 but for rounding


@value
class BaseRay:
    """The axial chief ray on the image, and first-order data about it at one wavelength; mm.

    valid: (...) whether it reaches the image. position, direction: (3, ...) on the image and in front of it, in its
    frame. Entries (2, ...) are those of the tangential section, of rays turned about the local x of the start, and of
    the sagittal section. Distances count along the base ray, positive in the direction of light. The others:

    focal_length: of a parallel beam, -y/u′ with u′ behind the lens, in its medium: positive where it converges; its
        sign follows the section through mirrors and turned axes.
    way_to_image: (...) from the last surface before the image that is not a coordinate break.
    back_focal_distance, image_distance: from there to the focus of neighbouring rays from infinity or the object.
    entrance_pupil_position: from the plane of the vertex of surface 1 to the image of the stop in object space.
    exit_pupil_position: from the image surface to that in image space; diameters > 0.
    paraxial_working_f_number: 1/(2 n′ |u′|) of rays from the axial object point through the rim of the stop.
    magnification: of the image of each section, 0 for an object at infinity; its sign as that of the focal length.
    A quantity that does not exist, such as the focal length of an afocal lens, is infinite.
    """

    valid: Tensor
    position: Tensor
    direction: Tensor
    way_to_image: Tensor
    focal_length: Tensor
    back_focal_distance: Tensor
    entrance_pupil_position: Tensor
    entrance_pupil_diameter: Tensor
    exit_pupil_position: Tensor
    exit_pupil_diameter: Tensor
    image_distance: Tensor
    paraxial_working_f_number: Tensor
    magnification: Tensor


@value
class Entrance:
    """The plane at which rays that fill the stop are aimed, to first order about the base ray.

    position: (...) mm along z from the vertex of surface 1; centre: (2, ...) mm, the base ray's point of it; spread:
    (2, 2, ...) mm, from pupil points to its points; turn: (2, 2, ...), from pupil points to those of the stop, turned
    or mirrored as the image of the stop is; radius: (...) mm of the stop.
    """

    position: Tensor
    centre: Tensor
    spread: Tensor
    turn: Tensor
    radius: Tensor


def base_ray(lens: Lens, wavelength: Tensor | None = None) -> BaseRay:
    """The axial chief ray and first-order data about it; wavelength: (...) µm, the primary one by default.

    `first_order` has the figures of the straightened lens, as OpticStudio; the two agree in a lens with an axis. First
    derivatives are exact; second ones lack the third derivatives of the trace.
    """
    wavelength = lens.primary if wavelength is None else wavelength
    near = _near(lens, wavelength)
    front, like = near.front, near.X
    moves, kappa = torch.eye(2, dtype=like.dtype, device=like.device), front.vergence[..., None, None]
    parallel = near.behind(moves, 0 * moves)
    fan = near.behind(moves, kappa * moves)
    # Through the middle of the stop, A m + B t = 0, also where A = 0, as chief rays are parallel in object space: of
    # object points 1 mm off the base ray, over κ.
    through = _inverse(front.A + kappa * front.B)
    chief = near.behind(through @ front.B, -through @ front.A)
    # From the axial object point to the rim of the stop.
    move = front.radius[..., None, None] * through @ front.Q
    rim = near.behind(move, kappa * move)
    exit_pupil, image = _closest(chief), _closest(fan)
    across = _at(rim, exit_pupil)
    magnification = torch.zeros_like(image)
    if is_any(kappa != 0):
        height = kappa * _at(chief, image)
        magnification = _sign(near.carried, height) * _length(height)
    return BaseRay(
        valid=near.valid,
        position=near.position,
        direction=near.direction,
        way_to_image=near.last,
        focal_length=_first(_sign(near.carried, -parallel[1]) * _over(1.0, _length(parallel[1]))),
        back_focal_distance=_first(_closest(parallel) + near.last[..., None]),
        entrance_pupil_position=_first(torch.diagonal(front.E, dim1=-2, dim2=-1)),
        entrance_pupil_diameter=_first(2 * front.radius[..., None] * _length(front.H_inverse)),
        exit_pupil_position=_first(exit_pupil),
        exit_pupil_diameter=_first(2 * _length(across)),
        image_distance=_first(image + near.last[..., None]),
        paraxial_working_f_number=_first(_over(0.5, near.n_image[..., None] * _length(rim[1]))),
        magnification=_first(magnification),
    )


def entrance_of(lens: Lens) -> Entrance:
    """The entrance of a bent lens for rays of the primary wavelength that fill the stop."""
    near = _front(lens, lens.primary)
    kappa = near.vergence
    first, second = torch.diagonal(near.E, dim1=-2, dim2=-1).unbind(-1)
    # The plane halfway between the images of the stop in both sections, if those are one; else that of the vertex.
    middle = 0.5 * (first + second)
    middle = torch.where((kappa * (first - second)).abs() < 0.5 * (1 + kappa * middle).abs(), middle, 0.0)
    wide = (near.radius * (1 + kappa * middle))[..., None, None]
    spread = wide * _inverse(near.A + kappa[..., None, None] * near.B) @ near.Q
    spread, turn = (torch.movedim(m.flip(-1, -2), (-2, -1), (0, 1)) for m in (spread, near.Q))
    return Entrance(middle * near.launched[2], near.aim + middle * near.launched[:2], spread, turn, near.radius)


class _Front(NamedTuple):
    """The base ray up to the stop, and derivatives of neighbouring rays by their start: matrices (..., rows, columns).

    Columns are tangential and sagittal: rays moved across the base ray along the local y and x of the start, mm, or
    turned towards them, radians. A, B: (..., 2, 2) from moves and turns to the y and x of the stop. E: a ray turned by
    u and moved by -E u meets the middle of the stop. Q, H_inverse: A = Q H (polar). aim: (2, ...) mm, launched:
    (3, ...) of the base ray in the plane of the vertex of surface 1; vergence: (...) 1/mm of the object from that
    plane; radius: (...) mm of the stop.
    """

    A: Tensor
    B: Tensor
    E: Tensor
    Q: Tensor
    H_inverse: Tensor
    aim: Tensor
    launched: Tensor
    vergence: Tensor
    radius: Tensor


class _Near(NamedTuple):
    """The base ray up to the image, and derivatives of neighbouring rays as of `_Front`.

    X: (..., 3, 4) from moves and turns to the displacement across the base ray at the image, D: to the direction in
    front of it. position, direction: (3, ...) and valid: (...) on the image; last: (...) mm to it from the last real
    surface; carried: (..., 3, 2) the local y and x of the start behind mirrors and turned axes; n_image: (...) n′.
    """

    front: _Front
    X: Tensor
    D: Tensor
    position: Tensor
    direction: Tensor
    valid: Tensor
    last: Tensor
    carried: Tensor
    n_image: Tensor

    def behind(self, move: Tensor, turn: Tensor) -> tuple[Tensor, Tensor]:
        """X and D (..., 3, k) of k rays that are moved and turned at the start, (..., 2, k) each."""
        X, D = (m[..., :2] @ move + m[..., 2:] @ turn for m in (self.X, self.D))
        return X, D


@shared
def _front(lens: Lens, wavelength: Tensor) -> _Front:
    """By the trace to the stop, without the surfaces behind it."""
    distance = object_distance_of(lens)
    aim = _aim(lens, wavelength)
    launched = _start_direction(aim, distance)
    axes, on_stop = _axes(launched), points_at(lens, wavelength, (lens.stop,))

    def traced(change: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        (position,), arrives = on_stop(_neighbours(aim, launched, axes, change))
        return position.flip(0), (arrives,)

    batch = broadcast_shape(aim.shape[1:], distance.shape, wavelength.shape, batch_shape(lens))
    _, to_stop, _ = _linearised(traced, aim.new_zeros(4, *batch), (lens, wavelength), 2)
    return _front_of(lens, aim, launched, to_stop)


def _neighbours(aim: Tensor, launched: Tensor, axes: tuple[Tensor, Tensor], change: Tensor) -> Rays:
    """Rays (3, K, ...) at the start, moved and turned by changes (4, K, ...) along the axes."""
    t, s, turn_t, turn_s = change
    up, right = (axis[:, None] for axis in axes)
    position = torch.stack([*aim, torch.zeros_like(aim[0])])[:, None]
    return start(position + t * up + s * right, launched[:, None] + turn_t * up + turn_s * right)


def _front_of(lens: Lens, aim: Tensor, launched: Tensor, to_stop: Tensor) -> _Front:
    """to_stop: (2, 4, ...) from moves and turns to the y and x of the stop."""
    distance, to_stop = object_distance_of(lens), torch.movedim(to_stop, (0, 1), (-2, -1))
    A, B = to_stop[..., :2], to_stop[..., 2:]
    Q, H_inverse = _polar(A)
    # Not 1/(distance · length), whose derivative by the length is 0 · inf for an object at infinity.
    vergence = (1 / distance) / _length(torch.stack([*(aim / distance), torch.ones_like(aim[0])]), 0)
    radius = _stop_radius(lens, H_inverse, _over(A, vergence[..., None, None])[..., 0] + B[..., 0])
    return _Front(A, B, _inverse(A) @ B, Q, H_inverse, aim, launched, vergence, radius)


@shared
def _near(lens: Lens, wavelength: Tensor) -> _Near:
    distance = object_distance_of(lens)
    aim = _aim(lens, wavelength)
    launched = _start_direction(aim, distance)
    indices = media(lens, wavelength)
    axes, image = _axes(launched), len(lens.surfaces) - 1
    real = max([k for k in range(1, image) if not lens.surfaces[k].is_break], default=image - 1)

    def traced(change: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
        rays = _neighbours(aim, launched, axes, change)
        arrives, ways = rays.valid, []
        for crossing in steps(lens.surfaces[1:], rays, indices=indices, wavelength=wavelength):
            arrives = arrives & ~(crossing.missed | crossing.totally_reflected)
            ways.append(crossing.rays)
        stop, last, image = ways[lens.stop - 1], ways[real - 1], ways[-1]
        moving = torch.cat([stop.position[:2].flip(0), image.position, image.direction])
        return moving, (arrives, last.position, *(way.direction for way in ways))

    batch = broadcast_shape(aim.shape[1:], distance.shape, wavelength.shape, batch_shape(lens))
    figures, slopes, (valid, last, *ways) = _linearised(traced, aim.new_zeros(4, *batch), (lens, wavelength), 8)
    position, direction = figures[2:5], figures[5:]
    to_stop, moved, D = slopes.split((2, 3, 3))
    X = moved - dot(moved, direction[:, None]) * direction[:, None]
    X, D = (torch.movedim(part, (0, 1), (-2, -1)) for part in (X, D))
    valid, last, ways = valid[0], last[:, 0], [way[:, 0] for way in ways]
    return _Near(
        _front_of(lens, aim, launched, to_stop), X, D, position, direction, valid,
        last=_way_to_image(lens.surfaces[real:], last, position, direction),
        carried=_carried(lens, launched, axes, ways),
        n_image=indices[-1],
    )  # fmt: skip


def _aim(lens: Lens, wavelength: Tensor) -> Tensor:
    """Where the base ray meets the plane of the vertex of surface 1, (2, ...) mm: so that it passes the stop's middle.

    The axis where that is straight, where chief rays are parallel to it, or where no ray finds the middle of the stop.
    """
    distance = object_distance_of(lens)
    axis = distance.new_zeros(2, *broadcast_shape(distance.shape, wavelength.shape, batch_shape(lens)))
    if lens.fields.telecentric or not is_bent(lens):
        return axis

    def through(aim: Tensor) -> Rays:
        position = torch.stack([*aim, torch.zeros_like(aim[0])])
        return start(position, _start_direction(aim, distance))

    size = 0.5 * axial_beam(lens).entrance_pupil_diameter.detach()
    size = torch.where(torch.isfinite(size) & (size > 0), size, 1.0)
    return aim_at_middle(lens, through, axis, wavelength, size)[0]


def _start_direction(aim: Tensor, distance: Tensor) -> Tensor:
    """Direction (3, ...) of the ray of the axial object point to the aim (2, ...) in the plane z = 0."""
    x, y = aim / distance
    return unit(torch.stack([x, y, torch.ones_like(x)]))


def _axes(launched: Tensor) -> tuple[Tensor, Tensor]:
    """Local y and x (3, ...) across a direction (3, ...)."""
    L, M, N = launched
    up = unit(torch.stack([-M * L, 1 - M * M, -M * N]))
    return up, torch.linalg.cross(up, launched, dim=0)


def _linearised(
    function: Callable[[Tensor], tuple[Tensor, tuple[Tensor, ...]]], point: Tensor, given: object, figures_count: int
) -> tuple[Tensor, Tensor, tuple[Tensor, ...]]:
    """f (m, ...) at a point (n, ...), its Jacobian (m, n, ...), and f's second result; given: numbers f depends on;
    figures_count: m."""
    # One backward pass of m copies: in forward mode, tangents of plain numbers cost four times as much as the trace.

    def units(count: int) -> Tensor:
        ones = torch.eye(count, dtype=point.dtype, device=point.device)
        return ones.reshape(count, count, *(1,) * (point.dim() - 1)).expand(count, count, *point.shape[1:])

    if in_transform() or in_forward_mode():
        change, start = units(len(point)), point[:, None]
        figures, slopes, others = torch.func.jvp(function, (start + 0 * change,), (change,), has_aux=True)  # type: ignore[misc]  # two of three
        return figures[:, 0], slopes, others
    recorded = torch.is_grad_enabled() and any(map(varies, pytree.tree_leaves(given)))
    with torch.enable_grad():
        copies = point[:, None].repeat(1, figures_count, *(1,) * (point.dim() - 1)).requires_grad_()
        figures, others = function(copies)
        # Of a scalar: with weights `grad` imports sympy, 1.4 s.
        (slopes,) = torch.autograd.grad((figures * units(figures_count)).sum(), copies, create_graph=recorded)
    if not recorded:
        figures, *others = (part.detach() for part in (figures, *others))
    return figures[:, 0], slopes.transpose(0, 1), others


def _way_to_image(surfaces: Sequence[Surface], place: Tensor, position: Tensor, direction: Tensor) -> Tensor:
    """Way (...) in mm along the base ray from its place (3, ...) on the first of these surfaces to the image."""
    for surface, next_one in itertools.pairwise(surfaces):
        for pose, thickness in ((surface.after, surface.thickness), (next_one.before, None)):
            place = place if pose is None else _in_axes(point_in, pose, place)
            place = place if thickness is None else torch.stack([place[0], place[1], place[2] - thickness])
    return dot(position - place, direction)


def _in_axes(how: Callable, pose: Pose, vector: Tensor) -> Tensor:
    return torch.stack(torch.broadcast_tensors(*how(pose, vector.unbind(0))))


@torch.no_grad()
def _carried(lens: Lens, launched: Tensor, axes: Sequence[Tensor], ways: Sequence[Tensor]) -> Tensor:
    """The axes (..., 3, 2) behind all surfaces: reflected by mirrors, else turned by the least angle; ways: directions
    (3, ...) of the base ray behind every surface."""
    d, gap, axes = launched, None, list(axes)
    for surface, after in zip(lens.surfaces[1:], ways, strict=True):
        for pose in (gap.pose if isinstance(gap, Gap) else None, surface.before):
            if pose is not None:
                d, *axes = (_in_axes(direction_in, pose, v) for v in (d, *axes))
        step, mean = after - d, (d + after) / (1 + dot(d, after))
        across = unit(step) if surface.is_mirror else step / (1 + dot(d, after))
        for k, axis in enumerate(axes):
            # A mirror: v - 2 (v·n) n; else Rodrigues' turn of v ⟂ d towards d': v - (v·d')(d + d')/(1 + d·d').
            bent = 2 * dot(axis, across) * across if surface.is_mirror else dot(axis, after) * mean
            axes[k] = axis - bent
        d, gap = after, gap_behind(surface)
    return torch.movedim(torch.stack(axes, 1), (0, 1), (-2, -1))


def _stop_radius(lens: Lens, H_inverse: Tensor, of_turn: Tensor) -> Tensor:
    """Radius (...) of the stop: of the file; of the paraxial marginal ray with paraxial aiming; or such that tangential
    rays of the object's cone, of_turn (..., 2) mm at 1 rad, meet its rim, or its tangential image fills the pupil."""
    batch = H_inverse[..., 0, 0]
    if lens.aperture.kind == "float_by_stop":
        return lens.aperture.value + 0 * batch
    straight = axial_beam(lens)
    if lens.aperture.kind in ("object_na", "object_cone_angle"):
        radius = torch.tan(cone_angle(lens, media(lens, lens.primary)[0])) * _length(of_turn, -1)
    else:
        radius = _over(0.5 * straight.entrance_pupil_diameter, _length(H_inverse)[..., 0])
    if lens.ray_aiming != "paraxial":
        return radius
    straightened = straight.stop_height.abs() + 0 * batch
    return torch.where(torch.isfinite(straightened), straightened, radius)


def _inverse(m: Tensor) -> Tensor:
    """Inverse of matrices (..., 2, 2); infinite for singular ones."""
    a, b, c, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]
    adjugate = torch.stack([torch.stack([d, -b], -1), torch.stack([-c, a], -1)], -2)
    return _over(adjugate, (a * d - b * c)[..., None, None])


def _polar(m: Tensor) -> tuple[Tensor, Tensor]:
    """Q and H⁻¹ of m = Q H (..., 2, 2), Q orthogonal, held fixed, and H symmetric above 0.

    Q = (m + s cof m)/|…| with s the sign of det m.
    """
    a, b, c, d = (part.detach() for part in (m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]))
    side = torch.where(a * d - b * c < 0, -1.0, 1.0).to(a.dtype)
    p, q = a + side * d, b - side * c
    size = torch.hypot(p, q)
    p, q = (torch.where(size > 0, part / torch.where(size > 0, size, 1.0), unit) for part, unit in ((p, 1.0), (q, 0.0)))
    Q = torch.stack([torch.stack([p, q], -1), torch.stack([-side * q, side * p], -1)], -2)
    return Q, _inverse(m) @ Q


def _closest(ray: tuple[Tensor, Tensor]) -> Tensor:
    """Where rays of X, D (..., 3, k) come closest to the base ray, mm from the image along it, (..., k)."""
    X, D = ray
    size = _length(D)
    return torch.where(size > _PARALLEL, -_over((X * D).sum(-2), (D * D).sum(-2)), torch.inf)


def _at(ray: tuple[Tensor, Tensor], place: Tensor) -> Tensor:
    """Where rays of X, D (..., 3, k) are across the base ray at places (..., k) along it."""
    return ray[0] + place[..., None, :] * ray[1]


def _sign(carried: Tensor, vectors: Tensor) -> Tensor:
    return torch.where((carried * vectors).sum(-2).detach() < 0, -1.0, 1.0).to(vectors.dtype)


def _length(vectors: Tensor, axis: int = -2) -> Tensor:
    """Lengths (...) of vectors; infinite for a vector of nan, as of an inverse that does not exist."""
    square = (vectors * vectors).sum(axis)
    return torch.where(square.isnan(), torch.inf, safe_sqrt(square))


def _over(numerator: Tensor | float, denominator: Tensor) -> Tensor:
    """A quotient that is infinite, without a derivative, where the denominator is 0."""
    finite = denominator.abs() > _PARALLEL
    return torch.where(finite, numerator / torch.where(finite, denominator, 1.0), torch.inf)


def _first(figures: Tensor) -> Tensor:
    """Figures (..., 2) as (2, ...); nan becomes infinite."""
    figures = torch.movedim(figures, -1, 0)
    return torch.where(torch.isnan(figures), torch.inf, figures)

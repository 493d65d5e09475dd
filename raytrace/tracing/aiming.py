"""Ray aiming: rays through given points of the stop, and chief rays to given image points.

Roots of traced residuals are found by Newton's method from the paraxial rays; where it fails, by continuation from the
axis to the full field. Many rays of one pupil start from series through a few of them. Each root is independent of the
others of a batch.
"""

from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths import zernike
from raytrace.maths.numerics import broadcast_shape, in_transform, is_any, safe_divide, varies, with_batch_axes
from raytrace.maths.sampling import gauss_rings
from raytrace.maths.tangents import values_alone
from raytrace.system.lens import Lens, batch_shape
from raytrace.system.rays import Rays
from raytrace.tracing.trace import points_at

_STAGES = 1, 20  # the full field at once; rays that fail in 20 steps of the field, each started from those before
_STEPS = 8  # Newton steps at each stage
_TOLERANCE = 1e-7  # of the radius of the stop and of the height of the image, in float64
_FEW = 1000  # rays that cost less to trace in copies than to differentiate more than once
_LOST = 1e-2  # a root missed by more at one stage is abandoned
_CLOSE = 0.1  # of the tolerance: Newton's next step then ends at rounding
_MANY, _DEGREE = 600, 12  # rays of one pupil that start from series of this degree, through 224 rays
_CHORDS = 4  # steps from there

_length = partial(torch.linalg.vector_norm, dim=0)

#: Residuals (n, ...) of unknowns (n, ...) at a fraction of the field, and whether the rays reach the target surface.
Residual = Callable[[Tensor, float], tuple[Tensor, Tensor]]


def aim_at_stop(
    lens: Lens,
    through: Callable[[Tensor, float], Rays],
    pupil: Tensor,
    turned: Callable[[Tensor], Tensor],
    wavelength: Tensor,
    radius: Tensor,
) -> tuple[Tensor, Tensor]:
    """Entrance pupil points (2, ...) whose rays pass the stop at turned(pupil) times `radius`; whether they pass (...).

    Light at an angle θ that enters a length δ in front of the paraxial entrance pupil crosses it at δ tan θ from the
    axis: the points of a wide-angle lens grow as 1/cos θ.
    pupil: (2, ...), initial points too; radius: mm, negative where the entrance pupil is an inverted image of the stop;
    through(pupil, fraction): rays of a fraction of the field.
    """
    pupil = with_batch_axes(pupil, radius.dim())  # the radius may have an axis of object distances that points lack
    first_point = (pupil[..., :1] if pupil.dim() > 1 else pupil).detach()
    target, first = turned(pupil), through(first_point, 1.0)
    on_stop = points_at(lens, wavelength, (lens.stop,))

    def missed(aim: Tensor, fraction: float, target: Tensor = target) -> tuple[Tensor, Tensor]:
        (position,), arrives = on_stop(through(aim, fraction))
        return torch.stack([hit / radius - to for hit, to in zip(position, target, strict=True)]), arrives

    def near() -> tuple[Tensor, Tensor]:
        """Roots (2, ...), and columns (2, 2, ...) of inverse Jacobians, as Zernike series through those of few rays."""
        fractions = pupil.detach()
        shared = fractions[(slice(None), *[slice(1)] * (fractions.dim() - 2))]
        fractions = shared if torch.equal(shared.expand_as(fractions), fractions) else fractions
        low, high = fractions.amin(-1, keepdim=True), fractions.amax(-1, keepdim=True)
        low = torch.stack([torch.where(low[0] >= 0, -high[0], low[0]), low[1]])  # half a pupil represents all of it
        centre, half = 0.5 * (low + high), 0.5 * (high - low)
        disc = safe_divide(fractions - centre, half)
        size = _length(disc).amax(-1, keepdim=True)
        points, weights = gauss_rings(_DEGREE // 2 + 2, 2 * _DEGREE + 4, dtype=size.dtype, device=size.device)
        few = centre + half * size * with_batch_axes(points, fractions.dim() - 1)
        aim, _ = aim_at_stop(lens, through, few, turned, wavelength, radius)
        rows = _error_and_jacobian(partial(missed, target=turned(few)), aim, 1.0)[1]
        inverse = [_solve(rows, unit) for unit in rows[0].new_tensor([[1.0, 0.0], [0.0, 1.0]])]
        orders = [zernike.noll(j) for j in range(1, (_DEGREE + 1) * (_DEGREE + 2) // 2 + 1)]
        series = (torch.stack([aim.detach(), *inverse]) * weights) @ zernike.polynomials(orders, *points).T
        basis = zernike.polynomials(orders, *safe_divide(disc, size.expand_as(disc)))
        start, *columns = torch.einsum("...j,j...p->...p", series, basis)
        return start, torch.stack(columns)

    of_one_pupil = broadcast_shape(first.shape, wavelength.shape)[-1:] == (1,) and pupil.shape[-1] >= _MANY
    given = lens, first, target, radius, wavelength
    batch = broadcast_shape(pupil.shape[1:], first.shape, wavelength.shape, batch_shape(lens))
    start = with_batch_axes(pupil.detach(), len(batch)).expand(2, *batch)
    aim, is_root = _root(
        missed,
        start,
        origin=lambda start: start,
        given=given,
        near=near if of_one_pupil else None,
        size=lambda fraction: safe_divide(torch.ones_like(start[0]), through(first_point, fraction).direction[2].abs()),
    )
    return torch.stack([torch.where(is_root, at_root, to) for at_root, to in zip(aim, pupil, strict=True)]), is_root


def aim_at_middle(
    lens: Lens, through: Callable[[Tensor], Rays], start: Tensor, wavelength: Tensor, size: Tensor
) -> tuple[Tensor, Tensor]:
    """Points (2, ...) whose rays pass the centre of the stop, else the start; and whether they pass it (...).

    through(points): rays; size: () mm, the scale of the residual. Second derivatives are exact too.
    """

    on_stop = points_at(lens, wavelength, (lens.stop,))

    def missed(point: Tensor, fraction: float) -> tuple[Tensor, Tensor]:
        (position,), arrives = on_stop(through(point))
        return position / size, arrives

    root, is_root = _root(missed, start, origin=lambda start: start, given=(lens, through(start.detach()), size))
    root = root - _solve(_error_and_jacobian(missed, root.detach(), 1.0)[1], missed(root, 1.0)[0])
    return torch.where(is_root, root, start), is_root


def aim_at_image(
    lens: Lens, through: Callable[[Tensor, Tensor], Rays], height: Tensor, estimate: Tensor, radius: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Fields (2, ...) whose primary chief rays meet the image at `height`, and whether they do (...).

    A field is 0 where they do not. through(field, pupil): rays; height: (2, ...) mm; estimate: (2, ...), initial field;
    radius: of the stop, whose centre the chief ray passes, or None if it passes that of the paraxial entrance pupil.
    """
    wavelength = lens.primary
    size = torch.linalg.vector_norm(height.detach(), dim=0)
    size = torch.where(size > 0, size, 1.0)
    landing = points_at(lens, wavelength, (lens.stop, len(lens.surfaces) - 1))

    def missed(unknown: Tensor, fraction: float) -> tuple[Tensor, Tensor]:
        pupil = torch.zeros_like(unknown[:2]) if radius is None else unknown[2:]
        (stop, image), arrives = landing(through(unknown[:2], pupil))
        off = [(hit - fraction * to) / size for hit, to in zip(image, height, strict=True)]
        if radius is not None:  # at the stop, chief rays of all heights may share one point
            off = torch.broadcast_tensors(*off, *(hit / radius for hit in stop))
        return torch.stack(off), arrives

    start = estimate if radius is None else torch.cat([estimate, torch.zeros_like(estimate)])
    first = through(start[:2].detach(), torch.zeros_like(start[:2]))
    given = lens, height, first, radius
    batch = broadcast_shape(first.shape, height.shape[1:], batch_shape(lens))
    start = with_batch_axes(start.detach(), len(batch)).expand(len(start), *batch)
    unknown, is_root = _root(missed, start, origin=torch.zeros_like, given=given)
    return torch.where(is_root, unknown[:2], 0.0), is_root


def _root(
    residual: Residual,
    start: Tensor,
    *,
    origin: Callable[[Tensor], Tensor],
    given: object,
    near: Callable[[], tuple[Tensor, Tensor]] | None = None,
    size: Callable[[float], Tensor] | None = None,
) -> tuple[Tensor, Tensor]:
    """Unknowns (n, ...) where the residuals of the full field vanish, and whether they do (...).

    start: of every root; origin: axial roots; given: all numbers on which the residuals depend; near: makes starts
    (n, ...), and the columns (n, n, ...) of inverse Jacobians, for chord steps that are tried first; size: by which the
    roots grow at a fraction of the field, 1 if None.
    """
    tolerance = _TOLERANCE if start.dtype == torch.float64 else 1e-4
    # Roots not found are evaluated on the axis, where every derivative is finite.
    root, is_root = origin(start), torch.zeros_like(start[0], dtype=torch.bool)
    last_step, close = torch.zeros_like(root), _CLOSE * tolerance
    searches: list[Callable[[], tuple[Tensor, Tensor, Tensor]]] = [
        partial(_followed, residual, start, origin(start), stages, close, size) for stages in _STAGES
    ]
    if near is not None and not in_transform():
        searches.insert(0, partial(_chords, residual, near, close))
    for search in searches:
        followed, worst, step = search()
        new = (worst <= tolerance) & ~is_root
        root, last_step = torch.where(new, followed, root), torch.where(new, step, last_step)
        is_root = is_root | new
        if not is_any(~is_root):
            break
    root = root - last_step
    if not any(map(varies, pytree.tree_leaves(given))):  # else the last step is attached: first derivatives are exact
        return root, is_root
    return root - _solve(_error_and_jacobian(residual, root, 1.0)[1], residual(root, 1.0)[0]), is_root


@torch.no_grad()
def _chords(
    residual: Residual, near: Callable[[], tuple[Tensor, Tensor]], close: float
) -> tuple[Tensor, Tensor, Tensor]:
    """As `_followed`, at the full field from close starts: steps by the columns of constant inverse Jacobians."""
    root, columns = near()
    step = torch.zeros_like(root)
    for _ in range(_CHORDS):
        root = root - step
        error, arrives = residual(root, 1.0)
        parts = (column * part for column, part in zip(columns, error.detach(), strict=True))
        step = sum(parts, start=torch.zeros_like(root))
        worst = torch.where(arrives, error.detach().abs().amax(0), torch.inf)
        if not is_any(worst > close):
            break
    return root, worst, step


def _followed(
    residual: Residual,
    start: Tensor,
    origin: Tensor,
    stages: int,
    close: float,
    size: Callable[[float], Tensor] | None = None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The roots at the full field, by continuation from the axis, their errors, and the next Newton step."""
    # A stage starts from the extrapolation of the two before or, if better, from the last root, both relative to their
    # sizes. A Newton step that loses the ray or increases the residual is shortened and rejected.
    before, root = origin, origin + (start - origin) / stages
    sought = torch.ones_like(root[0], dtype=torch.bool)
    for stage in range(1, stages + 1):
        fraction = stage / stages
        earlier, last = before, root
        if size is not None and stage > 1:
            earlier, root = (size(fraction) / size((stage - k) / stages) * t for k, t in ((2, before), (1, root)))
        error, step = _error_and_step(residual, root, fraction)
        if stage > 1:
            ahead = 2 * root - earlier
            error_ahead, step_ahead = _error_and_step(residual, ahead, fraction)
            nearer = _length(error_ahead) < _length(error)
            before, root = last, torch.where(nearer, ahead, root)
            error, step = torch.where(nearer, error_ahead, error), torch.where(nearer, step_ahead, step)
        share = torch.ones_like(root[0])
        for _ in range(_STEPS):
            moving = sought & (_length(error) > close)
            if not is_any(moving):
                break
            trial = root - share * step
            trial_error, trial_step = _error_and_step(residual, trial, fraction)
            better = moving & (_length(trial_error) < _length(error))
            root, error = torch.where(better, trial, root), torch.where(better, trial_error, error)
            step, share = torch.where(better, trial_step, step), torch.where(better, 1.0, share / 4)
        sought = sought & (_length(error) <= _LOST)
        if not is_any(sought):
            break
    worst = error.abs().amax(0)
    return root, worst if stage == stages else torch.full_like(worst, torch.inf), step


def _error_and_step(residual: Residual, point: Tensor, fraction: float) -> tuple[Tensor, Tensor]:
    """The residuals (n, ...), inf where the ray does not arrive, and Newton's step (n, ...)."""
    error, rows, arrives = _error_and_jacobian(residual, point, fraction)
    return torch.where(arrives, error, torch.inf), _solve(rows, error)


def _error_and_jacobian(residual: Residual, point: Tensor, fraction: float) -> tuple[Tensor, list[Tensor], Tensor]:
    """r(p) (n, ...), the rows ∂r_i/∂p, each (n, ...), of each entry's own Jacobian, and whether its ray arrives.

    Outside the graph. A few rays are traced in n copies, one for every row: one backward pass costs less than n.
    """
    count = len(point)
    if point[0].numel() <= _FEW:
        copies = point[:, None].expand(count, count, *point.shape[1:])
        value, pull, arrives = _pulled_back(lambda p: residual(p, fraction), copies)
        units = torch.eye(count, dtype=value.dtype, device=value.device)
        jacobian = pull(units.reshape(count, count, *(1,) * (point.dim() - 1)).expand_as(value).contiguous())
        return value[:, 0], list(jacobian.unbind(1)), arrives[0]
    value, pull, arrives = _pulled_back(lambda p: residual(p, fraction), point)
    units = torch.eye(count, dtype=value.dtype, device=value.device).reshape(count, count, *(1,) * (value.dim() - 1))
    return value, [pull(unit.expand_as(value)) for unit in units], arrives


def _pulled_back(function: Callable, point: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor], Tensor]:
    """f(p), the map from v to vᵀ ∂f/∂p, and the second result of f; outside the graph."""
    # `torch.func` only inside its transforms: its first call imports sympy, 1.4 s.
    if in_transform():
        value, pull_all, arrives = torch.func.vjp(function, point, has_aux=True)  # type: ignore[misc]  # two of three
        return value.detach(), lambda v: pull_all(v)[0].detach(), arrives
    with torch.enable_grad(), values_alone():
        point = point.detach().requires_grad_()
        value, arrives = function(point)

    def pull(v: Tensor) -> Tensor:  # of a scalar: with weights `grad` imports sympy, too
        with torch.enable_grad():
            return torch.autograd.grad((value * v).sum(), point, retain_graph=True)[0]

    return value.detach(), pull, arrives


def _solve(rows: list[Tensor], error: Tensor) -> Tensor:
    """Solve the n × n systems, by Cramer's rule if n is 2; 0 where singular."""
    if len(rows) == 2:
        of_x, of_y = rows
        determinant = of_x[0] * of_y[1] - of_x[1] * of_y[0]
        return torch.stack(
            [
                safe_divide(error[0] * of_y[1] - of_x[1] * error[1], determinant),
                safe_divide(of_x[0] * error[1] - error[0] * of_y[0], determinant),
            ]
        )
    matrix, error = torch.stack([row.movedim(0, -1) for row in rows], -2), error.movedim(0, -1)[..., None]
    trial, singular = torch.linalg.solve_ex(matrix, error.detach())
    usable = ((singular == 0) & torch.isfinite(trial).all(-1).all(-1))[..., None, None]
    safe = torch.where(usable, matrix, torch.eye(len(rows), dtype=matrix.dtype, device=matrix.device))
    return torch.linalg.solve_ex(safe, torch.where(usable, error, 0.0))[0][..., 0].movedim(-1, 0)

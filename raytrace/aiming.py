"""Ray aiming: the points of the entrance pupil whose rays pass given points of the stop."""

from collections.abc import Callable

import torch
from torch import Tensor

from raytrace.lens import Lens
from raytrace.numerics import broadcast_shape, safe_divide
from raytrace.rays import Rays
from raytrace.trace import media, steps

_AIMING_STAGES = 1, 20  # the field in one go, and for rays that fail in 20 parts, each started from those before it
_AIMING_STEPS = 8  # Newton steps at each stage
_AIMING_TOLERANCE = 1e-7  # of the stop radius, in float64


def at_stop(lens: Lens, rays: Rays, wavelength: Tensor) -> tuple[Tensor, Tensor]:
    """Where rays in front of surface 1 meet the stop, (2, ...) mm, and whether they do: a vignetted ray does."""
    arrives = rays.valid
    indices = media(lens, wavelength)[: lens.stop + 1]
    for crossing in steps(lens.surfaces[1 : lens.stop + 1], rays, indices=indices):
        rays, arrives = crossing.rays, arrives & ~(crossing.missed | crossing.totally_reflected)
    return rays.position[:2], arrives


def aim_at_stop(
    lens: Lens, through: Callable[..., Rays], pupil: Tensor, wavelength: Tensor, radius: Tensor
) -> tuple[Tensor, Tensor]:
    """Entrance pupil points (2, ...) whose rays pass the stop at `pupil` times `radius`; and whether found (...).

    radius: mm, negative where the entrance pupil is an inverted image of the stop; through(pupil, fraction): rays of a
    fraction of the field. Newton's method, where it fails followed from the axis to the full field; the last step is
    attached, so first derivatives are exact.
    """

    def reach(pupil: Tensor, fraction: float = 1.0) -> tuple[Tensor, Tensor]:
        position, arrives = at_stop(lens, through(pupil, fraction), wavelength)
        return position / radius, arrives

    with torch.no_grad():
        batch = broadcast_shape(reach(pupil)[0].shape[1:], pupil.shape[1:])
    target = torch.stack([p.expand(batch) for p in pupil])
    tolerance = _AIMING_TOLERANCE if pupil.dtype == torch.float64 else 1e-4
    aim, found = target.detach().clone(), torch.zeros(batch, dtype=torch.bool, device=pupil.device)
    for stages in _AIMING_STAGES:
        followed = _follow(reach, target.detach(), stages)
        error, _, arrives = _error_and_jacobian(reach, followed, target.detach())
        close = (error.abs() <= tolerance).all(0) & arrives
        aim, found = torch.where(close & ~found, followed, aim), found | close
        if bool(found.all()):
            break
    _, jacobian, _ = _error_and_jacobian(reach, aim, target.detach())
    attached = aim - _solve(jacobian, reach(aim)[0] - target)
    return torch.where(found, attached, target), found


def _follow(reach: Callable, target: Tensor, stages: int) -> Tensor:
    """Pupil points whose rays reach the target, followed from the axis to the full field in so many stages.

    Each stage starts where the two before it point to, or where the last one ended if that is nearer. A Newton step
    that loses the ray or leads away from the target is shortened, and not taken.
    """
    before = aim = target.clone()
    for stage in range(1, stages + 1):

        def at_stage(q: Tensor, fraction: float = stage / stages):
            return reach(q, fraction)

        here, ahead = (_error_and_jacobian(at_stage, start, target) for start in (aim, 2 * aim - before))
        nearer = ahead[2] & (~here[2] | (_length(ahead[0]) < _length(here[0])))
        before, aim = aim, torch.where(nearer, 2 * aim - before, aim)
        size = torch.where(nearer, _length(ahead[0]), torch.where(here[2], _length(here[0]), torch.inf))
        step = torch.where(nearer, _solve(ahead[1], ahead[0]), _solve(here[1], here[0]))
        share = torch.ones_like(size)
        for _ in range(_AIMING_STEPS):
            error, jacobian, arrives = _error_and_jacobian(at_stage, aim - share * step, target)
            better = arrives & (_length(error) < size)
            aim = torch.where(better, aim - share * step, aim)
            size, step = torch.where(better, _length(error), size), torch.where(better, _solve(jacobian, error), step)
            share = torch.where(better, 1.0, share / 4)
    return aim


def _error_and_jacobian(function: Callable[[Tensor], Tensor], point: Tensor, target: Tensor):
    """f(p) - target (2, ...), the rows ∂f_x/∂p, ∂f_y/∂p (2, ...) of each ray's own Jacobian, and whether it arrives.

    All outside the graph; function: p -> f(p), arrives.
    """
    value, pull, arrives = torch.func.vjp(function, point, has_aux=True)
    x, y = torch.zeros_like(value), torch.zeros_like(value)
    x[0], y[1] = 1.0, 1.0
    return (value - target).detach(), (pull(x)[0].detach(), pull(y)[0].detach()), arrives


def _length(vector: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vector, dim=0)


def _solve(jacobian: tuple[Tensor, Tensor], error: Tensor) -> Tensor:
    """Solve the 2 × 2 systems by Cramer's rule; 0 where singular."""
    of_x, of_y = jacobian
    determinant = of_x[0] * of_y[1] - of_x[1] * of_y[0]
    return torch.stack(
        [
            safe_divide(error[0] * of_y[1] - of_x[1] * error[1], determinant),
            safe_divide(of_x[0] * error[1] - error[0] * of_y[0], determinant),
        ]
    )

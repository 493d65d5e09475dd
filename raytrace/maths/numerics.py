"""Arithmetic whose value and gradient stay finite: every argument is made safe *before* the operation."""

from collections.abc import Sequence

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.autograd import forward_ad


def safe_sqrt(x: Tensor) -> Tensor:
    """√x where x > 0, else 0 with gradient 0 (a plain `where` after `sqrt` would leave a NaN gradient)."""
    positive = x > 0
    return torch.where(positive, torch.sqrt(torch.where(positive, x, 1.0)), 0.0)


def safe_divide(numerator: Tensor, denominator: Tensor) -> Tensor:
    """numerator/denominator where the denominator is not 0, else 0 with gradient 0."""
    nonzero = denominator != 0
    return torch.where(nonzero, numerator / torch.where(nonzero, denominator, 1.0), 0.0)


def dot(a, b):
    """Scalar product over the leading axis of length 3, of tensors or of three dual numbers each.

    Written out, not summed over an axis: a reduction may associate differently in batches of different shape, and
    results must not depend on how rays are batched.
    """
    ax, ay, az = a
    bx, by, bz = b
    return torch.addcmul(ax * bx + ay * by, az, bz) if isinstance(az, Tensor) else ax * bx + ay * by + az * bz


def dot_2(a: Tensor, b: Tensor) -> Tensor:
    """Scalar product over a leading axis of length 2."""
    return a[0] * b[0] + a[1] * b[1]


def differentiating() -> bool:
    """True if derivatives may be asked for: a graph is recorded, or a forward derivative (`jvp`) is under way.

    False only under `torch.no_grad()` with no forward derivative; then what serves derivatives alone is left out.
    """
    return torch.is_grad_enabled() or getattr(forward_ad, "_current_level", 0) >= 0


def varies(number: Tensor | float | None) -> bool:
    """Whether a derivative by this number may be requested: backward, forward, or by a transform of torch.func.

    Inside nested transforms a tensor shows only the innermost one: any wrapped tensor may vary for an outer one.
    """
    if not isinstance(number, Tensor):
        return False
    if number.requires_grad or is_functorch_wrapped_tensor(number):
        return True
    return getattr(forward_ad, "_current_level", -1) >= 0 and forward_ad.unpack_dual(number).tangent is not None


def with_batch_axes(vector: Tensor, count: int) -> Tensor:
    """The vector (3, ...) with at least `count` batch axes: axes of length 1 are put in behind its components.

    Broadcasting aligns shapes from the right, so that a factor (W, 1) would meet a vector (3, P) at its components.
    """
    missing = count + 1 - vector.dim()
    return vector if missing <= 0 else vector.reshape(vector.shape[0], *(1,) * missing, *vector.shape[1:])


def broadcast_shape(*shapes: Sequence[int]) -> torch.Size:
    """The shape that all shapes broadcast to. Raises ValueError where there is none.

    `torch.broadcast_shapes` is the same, but its first call loads a library of computer algebra: 0.3 s.
    """
    sizes = [1] * max([0, *(len(shape) for shape in shapes)])
    for shape in shapes:
        for place in range(1, len(shape) + 1):
            if shape[-place] != 1:
                if sizes[-place] not in (1, shape[-place]):
                    raise ValueError(f"shapes {', '.join(str(tuple(shape)) for shape in shapes)} do not broadcast")
                sizes[-place] = shape[-place]
    return torch.Size(sizes)


def unit(vector: Tensor) -> Tensor:
    """vector/|vector| over the leading axis of length 3; scaled first, so that 1e-200 and 1e200 keep their direction.

    A zero or non-finite vector comes back as NaN-free zeros, which callers flag by `norm == 0`.
    """
    largest = vector.detach().abs().amax(0)
    usable = (largest > 0) & torch.isfinite(largest)
    scaled = torch.where(usable, vector, 0.0) / torch.where(usable, largest, 1.0)
    norm = torch.sqrt(torch.where(usable, dot(scaled, scaled), 1.0))
    return scaled / norm


def polynomial(coefficients: Tensor, x: Tensor) -> Tensor:
    """Σ_j coefficients[j]·x^j by Horner's rule; `coefficients`: (m, ...), broadcast against `x`."""
    if len(coefficients) == 0:
        return torch.zeros_like(x)
    *lower, total = coefficients.unbind(0)
    total = total.expand(broadcast_shape(total.shape, x.shape))
    for coefficient in reversed(lower):
        total = torch.addcmul(coefficient, total, x)
    return total

"""Second order: a mean square as a quadratic form of errors and compensators, the compensators at their best in limits.

With the derivatives of q by errors e and compensators c, those of second order by differences of exact gradients,

    Q(e, c) = q₀ + g·e + ½ e·H e + ½ (c - c(e))·C (c - c(e)),    c(e) = c₀ + e K,    q(e) = min_c Q(e, c)

c(e) are the best compensators without limits, which are linear in the errors; g and H are those of the lens that they
bring to its best. Within limits q is larger by the last term, of the compensator nearest to c(e) in the measure of C.
By the errors q has the derivatives of Q at that compensator.

The mean of q without limits is exact, with the means m and variances Σ of the errors, and a control variate of the
rest:

    E[q] = q₀ + g·m + ½ (tr(H Σ) + m·H m)

Source of the expansion: Rimmer, Appl. Opt. 9, 533 (1970).
"""

from collections.abc import Callable

import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide, value

_SWEEPS = 64  # over the compensators, each in turn at its best


@value
class SecondOrder:
    """q₀ (), g (N,), H (N, N), c₀ (C,), K (N, C), C (C, C), and the limits (C,) of the compensators.

    c counts from the compensators of the nominal lens, where the derivatives are taken.
    """

    q0: Tensor
    g: Tensor
    H: Tensor
    start: Tensor
    response: Tensor
    curvature: Tensor
    least: Tensor
    most: Tensor

    def __call__(self, errors: Tensor) -> tuple[Tensor, Tensor]:
        """q (L,) of errors (L, N), and its derivatives (L, N) by them."""
        free, bent = self._free(errors)
        pull = self._short_of(self.start + errors @ self.response)
        force = pull @ self.curvature
        return free + 0.5 * (force * pull).sum(-1), self.g + bent - force @ self.response.T

    def _free(self, errors: Tensor) -> tuple[Tensor, Tensor]:
        """q (L,) without limits of the compensators, and H e (L, N)."""
        bent = errors @ self.H
        return self.q0 + errors @ self.g + 0.5 * (bent * errors).sum(-1), bent

    def _short_of(self, best: Tensor) -> Tensor:
        """By how much compensators (L, C) within their limits differ from the best ones (L, C) without limits.

        Each in turn is put where q is least, the others held: in a box this descent ends at the minimum.
        """
        moved = torch.clamp(best, self.least, self.most)
        pull, count = moved - best, best.shape[-1]
        for _ in range(_SWEEPS if count > 1 and bool((pull != 0).any()) else 0):
            for k in range(count):
                force = pull @ self.curvature[:, k] - pull[:, k] * self.curvature[k, k]
                wanted = best[:, k] - force / self.curvature[k, k]
                pull[:, k] = torch.clamp(wanted, self.least[k], self.most[k]) - best[:, k]
        return pull

    def means(
        self, errors: Tensor, mean: Tensor, variance: Tensor, value: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """f (K,) of draws (K, N), the means () of f and of q, and the share () of draws whose q is below 0, as none is.

        value: f of q; mean, variance: (N,) of the errors.
        """
        (free, _), q = self._free(errors), self(errors)[0]
        exact = self.q0 + self.g @ mean + 0.5 * (torch.diagonal(self.H) @ variance + mean @ self.H @ mean)
        drawn, off = value(q.clamp_min(0)), free - free.mean()
        square = (off * off).sum()
        expected = [
            part.mean() - safe_divide((off * part).sum(), square) * (free.mean() - exact)
            for part in (drawn, q.clamp_min(0))
        ]
        return drawn, expected[0], expected[1].clamp_min(0), (q < 0).to(q).mean()

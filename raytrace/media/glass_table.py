"""Glass from a table: refractive indices measured at a few wavelengths, as a dispersion formula through them."""

from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.media.glass import Glass

#: Powers of λ in Schott's formula, the first m of which m measured indices decide, and where each stands in it.
_POWERS, _PLACES = (0, -2, 2, -4, -6, -8), (0, 2, 1, 3, 4, 5)


def from_table(
    wavelengths: Sequence[float] | Tensor, indices: Sequence[float] | Tensor, *, name: str = "table"
) -> Glass:
    """The glass n² = a₀ + a₂ λ⁻² + a₁ λ² + a₃ λ⁻⁴ + … through indices (m,) at wavelengths (m,) µm.

    Up to six indices are met exactly, more by least squares. Differentiable in the indices.
    Raises ValueError for lists of unequal length, for equal wavelengths and for numbers that are none.
    """
    w, n = (torch.as_tensor(part, dtype=torch.float64) for part in (wavelengths, indices))
    if w.dim() != 1 or w.shape != n.shape or not len(w):
        raise ValueError(f"{n.numel()} indices at {w.numel()} wavelengths: expected one each")
    if not bool((w > 0).all() & torch.isfinite(w).all() & (n > 0).all() & torch.isfinite(n).all()):
        raise ValueError(f"wavelengths {w.tolist()} µm and indices {n.tolist()}: expected finite, positive numbers")
    if len(torch.unique(w)) < len(w):
        raise ValueError(f"a wavelength stands twice in {w.tolist()}: expected one index for each")
    terms = min(len(w), len(_POWERS))
    basis = torch.stack([w**power for power in _POWERS[:terms]], -1)
    found = torch.linalg.lstsq(basis, (n * n)[:, None]).solution[:, 0]
    coefficients = found.new_zeros(6).index_put((torch.tensor(_PLACES[:terms]),), found)
    return Glass(name, "schott", coefficients, wavelength_range=(float(w.min()), float(w.max())))

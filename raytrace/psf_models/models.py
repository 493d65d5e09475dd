"""The table of PSF models: a row is all that the rest of the package knows of one.

Each gives `kernels(scene, grid, order=…) -> Kernels`, energy integrated over pixels, 1 = all light through the entrance
pupil: a pure function, which `ladder.py` drives to a tolerance, `sharing.py` shares between processes and
`streaming.py` feeds ray by ray.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence

from raytrace.psf_models import diffraction, drt, fourier, gaussian, paraxial, rays
from raytrace.psf_models.result import Kernels


@dataclasses.dataclass(frozen=True)
class Model:
    """A PSF model as a ladder of orders, each finer than the one before.

    name: as `psf` takes it; title: what people call it.
    kernels: (scene, grid, order=…) -> Kernels; orders: from the coarsest to the finest.
    lean: the same without the residual, where that costs time; None if it does not.
    plain: (scene, grid, rays=…) -> Kernels of that many plain rays; None if the model has an order of rays only.
    options: further keywords of `kernels`, which `psf` hands on.
    traces: whether it follows rays through the lens, and so has derivatives by all its numbers; otherwise by those of
        first order alone, and it places the light of a field where a lens without distortion would.
    waves: whether its light is diffracted: moments are those inside the window, a close-up costs waves.
    is_rung: whether `model="auto"` tries it, which climbs from the model that knows least.
    row, compared: its place in `compare`, and how it is driven there.

    The error of an order, where not `proof`, is extrapolated from its changes (`ladder.by_tolerance`):
    by_width: True if the error is that of σ, False if it is that of the kernel.
    proof: the error of an order is so many times its difference from the next, which is computed to prove it.
    first: ratio of successive changes that is taken for granted while only one change is known; None: two are needed.
    least, most: bounds on the ratios measured after that; margin: a factor on the estimate.
    unseen: share of `Kernels.residual` that counts as error: what two orders may have in common.
    floor: what rounding leaves at least. The constants cover 95 % of the cases that docs/psf_error.md calls fitted.
    by_field: whether it takes its decisions for each field by itself: then processes deal out whole fields.
    """

    name: str
    title: str
    kernels: Callable[..., Kernels]
    orders: Sequence[int]
    lean: Callable[..., Kernels] | None = None
    plain: Callable[..., Kernels] | None = None
    options: tuple[str, ...] = ()
    traces: bool = True
    waves: bool = False
    is_rung: bool = False
    row: int = 0
    compared: Mapping = dataclasses.field(default_factory=dict)
    by_width: bool = False
    proof: float | None = None
    first: float | None = None
    least: float = 0.0
    most: float = 0.0
    margin: float = 1.0
    unseen: float = 0.0
    floor: float = 0.0
    by_field: bool = False


# Waves have the same sums, on pupils that differ; torch's J₀ is good to 3e-7 only.
_OF_WAVES = {"waves": True, "first": 0.23, "least": 1e-3, "most": 0.5, "floor": 1e-7, "compared": {"tol": 1e-3}}

# fmt: off
_ROWS = (
    # Focal length, principal planes, entrance pupil: a Gaussian of the defocus blur.
    Model("paraxial", "paraxial", paraxial.kernels, (0,), options=("rho",), traces=False, is_rung=True, row=2),
    # The same with diffraction: a defocused (and aberrated) circular pupil.
    Model("fourier", "Fourier", fourier.kernels, range(-2, 6), options=("zernike",), traces=False, row=3, **_OF_WAVES),
    # Centroid and covariance of traced rays. Rings converge as fast as the lens is smooth, in leaps: what is left after
    # one says nothing of the next.
    Model(
        "gaussian", "Gaussian DRT", gaussian.kernels, (2, 3, 4, 5, 6, 8, 10, 12, 16, 24), lean=gaussian.kernels_alone,
        is_rung=True, row=1, compared={"tol": 1e-3},
        by_width=True, proof=2.0, least=1e-4, most=0.6, margin=2.0, floor=1e-11,
    ),
    # All traced rays: geometric optics. Cells halve their error with each order: no faster, whatever a lucky change
    # says. The table of rings that round light is read from (radial.py) is good to 1e-5.
    Model(
        "drt", "DRT", drt.kernels, range(11), plain=rays.kernels, is_rung=True, row=0, compared={"rays": 256},
        first=0.6, least=0.6, most=0.6, unseen=0.15, floor=1e-5,
    ),
    # The traced wavefront: diffraction with the true aberrations.
    Model("wave", "wave", diffraction.kernels, range(-2, 6), is_rung=True, by_field=True, row=4, **_OF_WAVES),
)
# fmt: on

#: The models by name, from the one that knows least of a lens.
MODELS = {row.name: row for row in _ROWS}

#: The rungs of `model="auto"`.
RUNGS = tuple(row.name for row in _ROWS if row.is_rung)

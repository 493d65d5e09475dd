"""Point spread functions: five models behind one differentiable call.

    psf(lens, model="gaussian", fields=…, object_distances=…, grid=grid(0.005, 21), tol=1e-3) -> Psf

| model    | what it knows of the lens                                                       | module         |
|----------|---------------------------------------------------------------------------------|----------------|
| paraxial | focal length, principal planes, entrance pupil: a Gaussian of the defocus blur  | paraxial.py    |
| fourier  | the same, with diffraction: a defocused (and aberrated) circular pupil          | fourier.py     |
| gaussian | centroid and covariance of traced rays                                          | gaussian.py    |
| drt      | all traced rays: geometric optics                                               | rays.py        |
| wave     | the traced wavefront: diffraction with the true aberrations                     | diffraction.py |

Each gives `kernels(scene, grid, …) -> Kernels`, energy integrated over pixels, 1 = all light through the entrance
pupil. `ladder.py` drives them to a tolerance, and climbs them for `model="auto"`; `compute.py` is the call.
"""

from raytrace.kernels.closeup import CloseUp as CloseUp
from raytrace.kernels.closeup import close_up as close_up
from raytrace.kernels.compute import default_center as default_center
from raytrace.kernels.compute import psf as psf
from raytrace.kernels.ladder import MODELS as MODELS
from raytrace.kernels.ladder import NotConverged as NotConverged
from raytrace.kernels.ladder import Psf as Psf
from raytrace.optics.reuse import Memo as Memo
from raytrace.optics.scene import EmptyPsf as EmptyPsf

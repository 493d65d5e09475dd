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

from raytrace.psf.closeup import CloseUp as CloseUp
from raytrace.psf.closeup import close_up as close_up
from raytrace.psf.compute import default_center as default_center
from raytrace.psf.compute import psf as psf
from raytrace.psf.ladder import MODELS as MODELS
from raytrace.psf.ladder import NotConverged as NotConverged
from raytrace.psf.ladder import Psf as Psf
from raytrace.reuse import Memo as Memo
from raytrace.scene import EmptyPsf as EmptyPsf

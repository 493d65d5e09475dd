"""Point spread functions: five models behind one differentiable call.

    psf(lens, model="gaussian", fields=…, object_distances=…, pixel=0.005, size=21, tol=1e-3) -> Psf

`models.py` has the call, the table of the models, the choice of an order and the work of several
processes.

| model    | data of the lens                                                                | module         |
|----------|---------------------------------------------------------------------------------|----------------|
| paraxial | focal length, principal planes, entrance pupil: a Gaussian of the defocus blur  | paraxial.py    |
| fourier  | the same, with diffraction: a defocused (and aberrated) circular pupil          | fourier.py     |
| gaussian | centroid and covariance of traced rays                                          | gaussian.py    |
| drt      | all traced rays: geometric optics                                               | drt.py         |
| wave     | the traced wavefront: diffraction with the true aberrations                     | wave.py        |
"""

from raytrace.psf_models.figures import CloseUp as CloseUp
from raytrace.psf_models.figures import close_up_of as close_up_of
from raytrace.psf_models.models import DRT as DRT
from raytrace.psf_models.models import MODELS as MODELS
from raytrace.psf_models.models import Execution as Execution
from raytrace.psf_models.models import Fourier as Fourier
from raytrace.psf_models.models import Gaussian as Gaussian
from raytrace.psf_models.models import NotConverged as NotConverged
from raytrace.psf_models.models import Paraxial as Paraxial
from raytrace.psf_models.models import Wave as Wave
from raytrace.psf_models.models import model_of as model_of
from raytrace.psf_models.models import psf as psf
from raytrace.psf_models.result import EmptyPsf as EmptyPsf
from raytrace.psf_models.result import Kernels as Kernels
from raytrace.psf_models.result import Psf as Psf
from raytrace.tracing.scene import Memo as Memo

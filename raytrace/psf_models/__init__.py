"""Point spread functions: five models behind one differentiable call.

    psf(lens, model="gaussian", fields=…, object_distances=…, pixel=0.005, size=21, tol=1e-3) -> Psf

| module          | contents                                                                                     |
|-----------------|----------------------------------------------------------------------------------------------|
| models          | `psf`; table of the models, choice of an order for a tolerance, kernels shared by processes  |
| result          | Kernels of a model, Psf; moments of rays                                                     |
| paraxial        | first-order data: a Gaussian of the defocus blur                                             |
| fourier         | the same with diffraction: a defocused (and aberrated) circular pupil                        |
| gaussian        | centroid and covariance of traced rays; a Gaussian integrated over pixels                    |
| drt             | all traced rays: geometric optics                                                            |
| wave            | the traced wavefront: diffraction with the true aberrations                                  |
| radial          | rotationally symmetric light along one radius                                                |
| dft             | sums of waves: matrix DFT, Bessel functions, Huygens                                         |
| direct_sum      | the direct Huygens sum: converged kernels of waves, reference of the wave model              |
| cross_section   | profiles of PSFs through peak or centroid, line spreads, their widths                         |
| figures         | figures of PSFs, the finely sampled light in them                                            |

To add a model: a module with `kernels(scene, grid, *, order) -> Kernels`, a class of its numbers and a row of `_ROWS`
in `models`; `psf`, the command and `rt.compare_models` read the row.

Tests: tests/test_psf_MODULE.py; test_psf (the call), test_psf_laws (all models), test_psf_estimates (tolerances),
test_psf_derivatives, test_psf_rays (independent rays), test_direct_sum, test_shards (processes), test_plot_psf.
"""

from raytrace import namespace
from raytrace.psf_models.cross_section import CrossSection as CrossSection
from raytrace.psf_models.figures import CloseUp as CloseUp
from raytrace.psf_models.figures import close_up_of as close_up_of
from raytrace.psf_models.models import MODELS as MODELS
from raytrace.psf_models.models import Execution as Execution
from raytrace.psf_models.models import NotConverged as NotConverged
from raytrace.psf_models.models import model_name as model_name
from raytrace.psf_models.models import model_of as model_of
from raytrace.psf_models.models import name_of as name_of
from raytrace.psf_models.models import psf as psf
from raytrace.psf_models.result import DRT as DRT
from raytrace.psf_models.result import EmptyPsf as EmptyPsf
from raytrace.psf_models.result import Fourier as Fourier
from raytrace.psf_models.result import Gaussian as Gaussian
from raytrace.psf_models.result import Kernels as Kernels
from raytrace.psf_models.result import Paraxial as Paraxial
from raytrace.psf_models.result import Psf as Psf
from raytrace.psf_models.result import Wave as Wave
from raytrace.tracing.scene import Memo as Memo

__getattr__, __dir__ = namespace(__name__)

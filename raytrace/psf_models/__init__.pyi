# ruff: noqa: I001
from raytrace.psf_models.figures import CloseUp as CloseUp
from raytrace.psf_models.figures import close_up_of as close_up_of
from raytrace.psf_models.models import DRT as DRT
from raytrace.psf_models.models import Execution as Execution
from raytrace.psf_models.models import Fourier as Fourier
from raytrace.psf_models.models import Gaussian as Gaussian
from raytrace.psf_models.models import MODELS as MODELS
from raytrace.psf_models.models import NotConverged as NotConverged
from raytrace.psf_models.models import Paraxial as Paraxial
from raytrace.psf_models.models import Wave as Wave
from raytrace.psf_models.models import model_of as model_of
from raytrace.psf_models.models import name_of as name_of
from raytrace.psf_models.models import psf as psf
from raytrace.psf_models.result import EmptyPsf as EmptyPsf
from raytrace.psf_models.result import Kernels as Kernels
from raytrace.psf_models.result import Psf as Psf
from raytrace.tracing.scene import Memo as Memo

# ruff: noqa: I001
from raytrace.tolerancing.as_built import AsBuilt as AsBuilt
from raytrace.tolerancing.elements import cemented_groups as cemented_groups
from raytrace.tolerancing.elements import lens_elements as lens_elements
from raytrace.tolerancing.files import read_tolerances as read_tolerances
from raytrace.tolerancing.grades import tolerances as tolerances
from raytrace.tolerancing.jacobian import Jacobian as Jacobian
from raytrace.tolerancing.jacobian import jacobian as jacobian
from raytrace.tolerancing.perturbation import perturbed as perturbed
from raytrace.tolerancing.sampling import draw_errors as draw_errors
from raytrace.tolerancing.toleranced import Toleranced as Toleranced
from raytrace.tolerancing.toleranced import tolerance as tolerance
from raytrace.tolerancing.tolerances import Tolerances as Tolerances

from raytrace.maths.numerics import to as to
from raytrace.maths.sampling import gauss_rings as gauss_rings
from raytrace.maths.sampling import grid as grid
from raytrace.maths.sampling import hexapolar as hexapolar
from raytrace.maths.sampling import sobol as sobol

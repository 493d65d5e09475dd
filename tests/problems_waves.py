"""A thin plastic lens in front of a sensor."""

from problems import scalar, vector

from raytrace.materials.glass import constant
from raytrace.maths.sampling import grid
from raytrace.wave_optics.element import Element, EvenPowers
from raytrace.wave_optics.scene import WaveScene

R, Z = 2.5, 35.5  # mm

PLASTIC = constant(2.0)  # a path of the height itself


def lens(focus=1000.0, *, radius=R, distance=Z, exact=False, glass=PLASTIC, extra=0.0):
    """Focuses a point at `focus` mm onto the sensor; extra: mm of defocus at the rim."""
    a, b = 1 / focus, 1 / distance
    powers = [-(a + b) / 2 + extra / radius**2]
    if exact:  # the series of both spheres, the next term is 1e-12 mm
        powers += [(a**3 + b**3) / 8, -(a**5 + b**5) / 16, 5 * (a**7 + b**7) / 128, -7 * (a**9 + b**9) / 256]
    return Element(EvenPowers(vector(*powers)), scalar(radius), glass)


def scene(*elements, depths=(1000.0,), wavelengths=(0.55,), size=32, pitch=0.00369, centre=(0.0, 0.0), exact=False):
    elements = elements or (lens(exact=exact),)
    window = grid(scalar(pitch), size, vector(*centre))
    return WaveScene(elements, scalar(Z), vector(*depths), vector(*wavelengths), window, exact)


def relative(result, expected):
    """Largest relative L2 error of the kernels."""
    return float(((result - expected).flatten(2).norm(dim=-1) / expected.flatten(2).norm(dim=-1)).max())

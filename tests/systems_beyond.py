"""Systems beyond centred spheres: conics, toroids, and a tilted grating spectrometer."""

import math

import torch
from torch import Tensor

from raytrace.bench.measure import SAMPLE, Tracer, field_rays
from raytrace.files import shipped
from raytrace.io import read_lens
from raytrace.materials.glass import AIR, MIRROR, Glass, constant
from raytrace.maths.numerics import to
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.phases import Grating
from raytrace.system.poses import Pose
from raytrace.system.surface import Surface
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.trace import trace_lens

WAVELENGTH, LINES = 0.55, 0.3  # µm, and lines per µm


def conics() -> Lens:
    """The double Gauss with a conic constant on every surface, planes as well."""
    lens = read_lens(shipped("lenses") / "double_gauss.zmx")
    for number, surface in enumerate(lens.surfaces[1:-1], 1):
        c = _real(0.0) if surface.curvature is None else surface.curvature
        lens = lens.replace(number, curvature=c, conic=_real(-0.01 * number))
    return lens


def toroids() -> Lens:
    """The same with toroids, whose curvature along x is 3 % stronger; planes become cylinders."""
    lens = conics()
    for number, surface in enumerate(lens.surfaces[1:-1], 1):
        c = 1.03 * surface.curvature + 1e-4
        lens = lens.replace(number, kind="toroidal", coefficients=c[None])
    return lens


def spectrometer() -> Lens:
    """Czerny-Turner: slit, window, collimator, grating, camera mirror and detector, all but the slit tilted."""
    fold, grating = 8.0, -20.0  # degrees
    sine = math.sin(math.radians(-grating)) + LINES * WAVELENGTH  # of the diffracted ray
    off = -math.degrees(math.asin(sine))
    surfaces = (
        _surface(40.0),
        _surface(2.0, glass=constant(1.46), before=_tilt(5.0)),
        _surface(108.0, after=_tilt(-5.0)),
        _surface(-140.0, curvature=-1 / 300, glass=MIRROR, before=_tilt(fold), after=_tilt(fold)),
        _surface(140.0, glass=MIRROR, before=_tilt(grating), after=_tilt(off), phase=Grating(_real(LINES), _real(1.0))),
        _surface(-150.0, curvature=-1 / 300, glass=MIRROR, before=_tilt(-fold), after=_tilt(-fold)),
        _surface(0.0, before=_tilt(-3.0)),
    )
    zero = torch.zeros(1, dtype=torch.float64)
    one = zero + 1
    return Lens(
        surfaces=surfaces,
        stop=3,
        aperture=SystemAperture("entrance_pupil_diameter", _real(25.0)),
        fields=Fields("angle", zero, zero, one),
        wavelengths=WAVELENGTH * one,
        wavelength_weights=one,
    )


#: Systems by name.
SYSTEMS = {"conics": conics, "toroids": toroids, "tilted grating spectrometer": spectrometer}


def error_of(tracer: Tracer) -> float:
    """nm between the tracer and the eager float64 trace of the same numbers, the largest of a few rays."""
    rays = to(field_rays(tracer.lens, SAMPLE), dtype=tracer.dtype)
    wavelength = tracer.lens.primary.double()
    tracer.prepare()
    with torch.no_grad(), trace_engine("eager"):
        exact = trace_lens(*(to(x, dtype=torch.float64) for x in (tracer.lens, rays)), wavelength)
    return 1e6 * float((tracer.forward(rays)[0].double() - exact.position[:2]).abs().max())


def _surface(thickness: float, *, curvature: float | None = None, glass: Glass = AIR, **others) -> Surface:
    c = None if curvature is None else _real(curvature)
    return Surface(_real(thickness), curvature=c, glass=glass, **others)


def _tilt(degrees: float) -> Pose:
    return Pose(tilt_x=_real(degrees))


def _real(number: float) -> Tensor:
    return torch.tensor(number, dtype=torch.float64)

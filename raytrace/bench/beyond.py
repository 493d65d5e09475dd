"""Systems beyond centred spheres, and what each costs beside plain conics: rays × surfaces / s of one over the other.

Surfaces are those a ray meets: turns of the axes between them are part of their price.
"""

import dataclasses
import math
import statistics
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.bench.measure import DTYPES, SAMPLE, Own, field_rays, in_turns, name_of, nothing
from raytrace.bench.report import table
from raytrace.files import shipped
from raytrace.formats import read_lens
from raytrace.fused import tracing
from raytrace.maths.value import to
from raytrace.media.glass import AIR, MIRROR, Glass, constant
from raytrace.optics.trace import trace_lens
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.phases import Grating
from raytrace.system.pose import Pose
from raytrace.system.surface import Surface

MOST = 100_000  # rays
WORK = ("forward", "forward+backward")
_WAVELENGTH, _LINES = 0.55, 0.3  # µm, and lines per µm


def conics() -> Lens:
    """The double Gauss with a conic constant on every surface, planes as well."""
    lens = read_lens(shipped("lenses") / "double_gauss.zmx")
    for number, surface in enumerate(lens.surfaces[1:-1], 1):
        c = _real(0.0) if surface.curvature is None else surface.curvature
        lens = lens.replace(number, curvature=c, conic=_real(-0.01 * number))
    return lens


def toroids() -> Lens:
    """The same with every surface a toroid, its curvature along x 3 % stronger, planes as cylinders."""
    lens = conics()
    for number, surface in enumerate(lens.surfaces[1:-1], 1):
        c = 1.03 * surface.curvature + 1e-4
        lens = lens.replace(number, kind="toroidal", coefficients=c[None])
    return lens


def spectrometer() -> Lens:
    """Czerny and Turner's: slit, window, collimator, grating, camera mirror and detector; all but the slit tilted."""
    fold, grating = 8.0, -20.0
    sine = math.sin(math.radians(-grating)) + _LINES * _WAVELENGTH  # of the diffracted ray
    off = -math.degrees(math.asin(sine))
    surfaces = (
        _surface(40.0),
        _surface(2.0, glass=_silica(), before=_tilt(5.0)),
        _surface(108.0, after=_tilt(-5.0)),
        _surface(-140.0, curvature=-1 / 300, glass=MIRROR, before=_tilt(fold), after=_tilt(fold)),
        _surface(
            140.0,
            glass=MIRROR,
            before=_tilt(grating),
            after=_tilt(off),
            phase=Grating(_real(_LINES), _real(1.0)),
        ),
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
        wavelengths=_WAVELENGTH * one,
        wavelength_weights=one,
    )


#: What is measured, each over the first.
SYSTEMS = {"conics": conics, "toroids": toroids, "tilted grating spectrometer": spectrometer}


@dataclasses.dataclass(frozen=True)
class Row:
    """One figure. seconds: median; error: nm, largest distance from the eager float64 trace of the same numbers."""

    system: str
    dtype: str
    what: str
    rays: int
    surfaces: int
    seconds: float
    speed: float
    ratio: float
    error: float


def calls(repeats: int) -> int:
    """How many steps of progress `measure` makes."""
    return repeats * len(SYSTEMS) * len(DTYPES) * len(WORK)


def measure(count: int, *, repeats: int, threads: int, progress: Callable[[int], object] = nothing) -> list[Row]:
    """Time every system with the optical path; progress: of `calls(repeats)`."""
    count = min(count, MOST)
    lenses = {name: make() for name, make in SYSTEMS.items()}
    tracers = {(name, dtype): Own(lenses[name], dtype, with_path=True) for name in SYSTEMS for dtype in DTYPES}
    jobs = {}
    for (name, dtype), tracer in tracers.items():
        rays = to(field_rays(lenses[name], count), dtype=dtype)
        jobs[name, dtype, WORK[0]] = (lambda tracer=tracer, rays=rays: tracer.forward(rays)), nothing
        centroid = tracer.forward(rays)[0].mean(1)
        jobs[name, dtype, WORK[1]] = (
            (lambda tracer=tracer, rays=rays, centroid=centroid: tracer.gradient(rays, centroid)),
            nothing,
        )
    errors = {key: error_of(tracer) for key, tracer in tracers.items()}
    seconds = in_turns(jobs, repeats=repeats, threads=threads, progress=progress)
    return [_row(key, lenses, count, seconds, errors) for key in jobs]


def _row(key: tuple, lenses: dict, count: int, seconds: dict, errors: dict) -> Row:
    name, dtype, what = key
    plain = next(iter(SYSTEMS))
    each = {one: _met(lenses[one]) * count / statistics.median(seconds[one, dtype, what]) for one in (name, plain)}
    # Turn by turn, for what else the machine does changes from one to the next.
    over = [b / a for a, b in zip(seconds[name, dtype, what], seconds[plain, dtype, what], strict=True)]
    return Row(
        name,
        name_of(dtype),
        what,
        count,
        _met(lenses[name]),
        statistics.median(seconds[key]),
        each[name],
        statistics.median(over) * _met(lenses[name]) / _met(lenses[plain]),
        errors[name, dtype],
    )


def _met(lens: Lens) -> int:
    return sum(not surface.is_break for surface in lens.surfaces[1:])


def error_of(tracer: Own) -> float:
    """nm between the tracer and the eager trace in float64 of the same numbers, the largest of a few rays."""
    rays = to(field_rays(tracer.lens, SAMPLE), dtype=tracer.dtype)
    with torch.no_grad(), tracing("eager"):
        exact = trace_lens(*(to(x, dtype=torch.float64) for x in (tracer.lens, rays)), tracer.wavelength)
    return 1e6 * _largest(tracer.forward(rays)[0].double() - exact.position[:2])


def _largest(x: Tensor) -> float:
    return float(x.abs().max())


def report(rows: Sequence[Row]) -> list[str]:
    """A table of them."""
    columns = {
        "system": lambda row: row.system,
        "surfaces": lambda row: str(row.surfaces),
        "rays": lambda row: f"{row.rays:,}",
        "what": lambda row: row.what,
        "dtype": lambda row: row.dtype,
        "M/s": lambda row: f"{row.speed / 1e6:.1f}",
        "× conics": lambda row: f"{row.ratio:.2f}",
        "difference, nm": lambda row: f"{row.error:.2g}",
    }
    return [
        "",
        "Other systems, with path, by the trace that the program chooses: speed in millions of rays × surfaces per "
        "second, and over that of conics turn by turn, the median. Difference: the largest from the eager trace in "
        f"float64 of the same numbers, over {SAMPLE} rays.",
        "",
        *table(columns, rows),
    ]


def _surface(thickness: float, *, curvature: float | None = None, glass: Glass = AIR, **others) -> Surface:
    c = None if curvature is None else _real(curvature)
    return Surface(_real(thickness), curvature=c, glass=glass, **others)


def _tilt(degrees: float) -> Pose:
    return Pose(tilt_x=_real(degrees))


def _silica() -> Glass:
    return constant(1.46)


def _real(number: float) -> Tensor:
    return torch.tensor(number, dtype=torch.float64)

"""Systems beyond centred spheres, and what each costs beside plain conics: rays × surfaces / s of one over the other.

Surfaces are those a ray meets: turns of the axes between them are part of their price.
"""

import dataclasses
import math
import statistics
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.bench.measure import (
    DTYPES,
    PIECES,
    SAMPLE,
    Job,
    Own,
    Tracer,
    field_rays,
    in_best_pieces,
    in_turns,
    name_of,
    nothing,
)
from raytrace.bench.report import digits, table
from raytrace.files import shipped
from raytrace.io import read_lens
from raytrace.materials.glass import AIR, MIRROR, Glass, constant
from raytrace.maths.value import to
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.phases import Grating
from raytrace.system.poses import Pose
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.trace import trace_lens

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
    """One figure. seconds: median; ratio: speed over that of the same tracer on conics; error: nm, largest distance
    from the eager float64 trace of the same numbers; over_peer: speed over that of Optiland's torch back end at the
    same task, None for Optiland itself or without it; lacks: what a tracer leaves out of the task.
    """

    system: str
    dtype: str
    what: str
    rays: int
    surfaces: int
    seconds: float
    speed: float
    ratio: float
    error: float
    tracer: str = "raytrace"
    over_peer: float | None = None
    lacks: str = ""


def calls(repeats: int, *, with_peers: bool = False) -> int:
    """How many steps of progress `measure` makes."""
    own = len(DTYPES) * len(WORK)
    return repeats * len(SYSTEMS) * (own + (own + 1 if with_peers else 0))


def measure(
    count: int,
    *,
    repeats: int,
    threads: int,
    peers_of: Callable[[Lens], Sequence[Tracer] | None] = nothing,
    progress: Callable[[int], object] = nothing,
) -> list[Row]:
    """Time every system with the optical path, in turns. peers_of: peers with a lens; progress: of `calls(…)`."""
    count = min(count, MOST)
    lenses = {name: make() for name, make in SYSTEMS.items()}
    tracers = {}
    for name, lens in lenses.items():
        for one in (*(Own(lens, dtype, with_path=True) for dtype in DTYPES), *(peers_of(lens) or ())):
            tracers[name, one.name, one.dtype] = one
    jobs = {
        (*key, what): _job(one, what, to(field_rays(lenses[key[0]], count), dtype=one.dtype), threads)
        for key, one in tracers.items()
        for what in WORK[: 1 + one.has_gradient]
    }
    errors = {key: error_of(one) for key, one in tracers.items()}
    seconds = in_turns(jobs, repeats=repeats, threads=threads, progress=progress)
    return [_row(key, lenses, count, seconds, errors[key[:3]], tracers[key[:3]]) for key in jobs]


def _job(tracer: Tracer, what: str, rays: Rays, threads: int) -> Job:
    """A call on all rays: by this package at once, which divides them itself; a peer's in the pieces that suit it."""
    tracer.prepare()
    centroid = tracer.forward(rays)[0].mean(1)
    work = tracer.forward if what == WORK[0] else lambda rays: tracer.gradient(rays, centroid)
    if isinstance(tracer, Own):
        return (lambda: work(rays)), tracer.prepare
    return in_best_pieces(work, rays, tracer.prepare, sizes=PIECES, threads=threads)[0]


def _row(key: tuple, lenses: dict, count: int, seconds: dict, error: float, tracer: Tracer) -> Row:
    name, who, dtype, what = key
    others = [one for one in seconds if (one[0], *one[2:]) == (name, dtype, what) and one[1].endswith("torch")]
    return Row(
        name,
        name_of(dtype),
        what,
        count,
        _met(lenses[name]),
        statistics.median(seconds[key]),
        _met(lenses[name]) * count / statistics.median(seconds[key]),
        _over(seconds, (next(iter(SYSTEMS)), *key[1:]), key, lenses),
        error,
        who,
        _over(seconds, others[0], key, lenses) if others and who == "raytrace" else None,
        "" if isinstance(tracer, Own) else tracer.lacks(gradient=what != WORK[0]),
    )


def _over(seconds: dict, other: tuple, key: tuple, lenses: dict) -> float:
    """Speed of one over another's, turn by turn, for what else the machine does changes from one to the next."""
    over = [b / a for a, b in zip(seconds[key], seconds[other], strict=True)]
    return statistics.median(over) * _met(lenses[key[0]]) / _met(lenses[other[0]])


def _met(lens: Lens) -> int:
    return sum(not surface.is_break for surface in lens.surfaces[1:])


def error_of(tracer: Tracer) -> float:
    """nm between the tracer and the eager trace in float64 of the same numbers, the largest of a few rays."""
    rays = to(field_rays(tracer.lens, SAMPLE), dtype=tracer.dtype)
    wavelength = tracer.lens.primary.double()
    tracer.prepare()
    with torch.no_grad(), trace_engine("eager"):
        exact = trace_lens(*(to(x, dtype=torch.float64) for x in (tracer.lens, rays)), wavelength)
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
        "tracer": lambda row: row.tracer,
        "M/s": lambda row: f"{row.speed / 1e6:.1f}",
        "× conics": lambda row: f"{row.ratio:.2f}",
        "× Optiland": lambda row: digits(row.over_peer, ".1f"),
        "difference, nm": lambda row: f"{row.error:.2g}",
        "without": lambda row: row.lacks,
    }
    if all(row.over_peer is None for row in rows):
        del columns["tracer"], columns["× Optiland"], columns["without"]
    return [
        "",
        "Other systems, with path, by the trace that the program chooses: speed in millions of rays × surfaces per "
        "second, and over that of the same tracer on conics turn by turn, the median. Difference: the largest from the "
        f"eager trace in float64 of the same numbers, over {SAMPLE} rays. Without: what a tracer leaves out.",
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

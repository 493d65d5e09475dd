"""The limits of this machine: `limit.cpp` built by the compiler found, and traced with as any other tracer.

Nothing is allocated, dispatched or differentiated there: what a trace of this arithmetic could reach on these cores.
"""

import ctypes
import dataclasses
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.bench.measure import name_of, shape_of
from raytrace.maths.value import to
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface, is_even
from raytrace.tracing.compiler import NoCompiler, compiler, private_folder, run_compiler

#: Beside -O3 -march=native: roots and comparisons as vector instructions, which errno and traps would forbid; no
#: arithmetic changes by that. The others are tried first, and left out where a compiler does not know them.
FLAGS = ("-O3", "-march=native", "-fno-math-errno", "-fno-trapping-math")
_WIDEST, _THREADS = "-mprefer-vector-width=512", "-fopenmp"
_TERMS = 8
_MOST_STEPS = 24
_PLANE, _SPHERE, _ASPHERE = range(3)


class _Surface(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_int32) for name in ("kind", "bends", "terms", "reserved")),
        *((name, ctypes.c_double) for name in ("gap", "curvature", "shape", "before", "behind")),
        ("coefficients", ctypes.c_double * _TERMS),
    )


@dataclasses.dataclass(frozen=True)
class Built:
    """The compiled limits and how they were made, for people."""

    library: ctypes.CDLL
    compiler: str
    flags: tuple[str, ...]

    @property
    def words(self) -> str:
        return f"{self.compiler} {' '.join(self.flags)}"


def build(named: str | None = None) -> Built:
    """Compile the limits: a second or two. named: the compiler, as `compiler` takes it. Raises NoCompiler."""
    program = compiler(named)
    try:
        with private_folder() as folder:
            for flags in ((*FLAGS, _WIDEST, _THREADS), (*FLAGS, _THREADS), FLAGS):
                made = _compiled(program, flags, folder)
                if isinstance(made, ctypes.CDLL):
                    version = run_compiler(*program, "--version", folder=folder).stdout
                    return Built(made, version.splitlines()[0] if version else program[0], flags)
    except OSError as error:
        raise NoCompiler(f"the limits cannot be built: {error}") from None
    raise NoCompiler(f"{' '.join(program)} does not build the limits: {made}")


def _compiled(program: Sequence[str], flags: Sequence[str], folder: Path) -> ctypes.CDLL | str:
    """The limits, or why they cannot be had. Linked without -fopenmp: threads are torch's, as the compiled trace's."""
    source, compiled, file = Path(__file__).with_name("limit.cpp").absolute(), folder / "limit.o", folder / "limit.so"
    for words in (["-std=c++17", *flags, "-fPIC", "-c", source, "-o", compiled], ["-shared", compiled, "-o", file]):
        done = run_compiler(*program, *map(str, words), folder=folder)
        if done.returncode:
            return done.stderr.strip().splitlines()[0] if done.stderr.strip() else f"exit {done.returncode}"
    try:
        return ctypes.CDLL(str(file))
    except OSError as error:
        return str(error)


class Limit:
    """One lens in the limits. safe: with the arithmetic of the trace, else the plain one (see `limit.cpp`).

    steps: of Newton's method on aspheres. Raises ValueError for what the limits do not know: mirrors, apertures,
    departures, conics without aspheric terms, aspheres in the plain one.
    """

    with_path = False
    has_gradient = False

    def __init__(self, built: Built, lens: Lens, dtype: torch.dtype, *, safe: bool, steps: int = 0, threads: int = 1):
        if not 0 <= steps <= _MOST_STEPS:
            raise ValueError(f"{steps} steps of Newton's method: expected 0 to {_MOST_STEPS}")
        self.name = "safe limit" if safe else "plain limit"
        self.dtype, self.safe, self.steps, self.threads = dtype, safe, steps, threads
        lens = to(lens, dtype=dtype)
        self._surfaces = _surfaces(lens, safe)
        self._call = getattr(built.library, f"trace_{name_of(dtype)}")
        self._call.restype = None
        self._out: Rays | None = None

    def prepare(self) -> None:
        pass

    def forward(self, rays: Rays) -> tuple[Tensor, None]:
        return self.trace(rays).position[:2], None

    def trace(self, rays: Rays) -> Rays:
        """The rays (3, P) behind the last surface. The memory of the result is that of the call before."""
        position, direction, valid = (a.contiguous() for a in (rays.position, rays.direction, rays.valid))
        if position.dtype != self.dtype or direction.dtype != self.dtype or position.dim() != 2:
            raise ValueError(f"rays {tuple(position.shape)} of {position.dtype}: expected (3, P) of {self.dtype}")
        if self._out is None or self._out.position.shape != position.shape:
            self._out = Rays(torch.zeros_like(position), torch.zeros_like(direction), torch.zeros_like(valid))
        tensors = (position, direction, valid, self._out.position, self._out.direction, self._out.valid)
        self._call(
            self._surfaces,
            len(self._surfaces),
            *(ctypes.c_void_p(tensor.data_ptr()) for tensor in tensors),
            ctypes.c_int64(position.shape[1]),
            self.steps,
            int(not self.safe),
            self.threads,
        )
        return self._out


def _surfaces(lens: Lens, safe: bool) -> ctypes.Array:
    indices = media(lens, lens.primary)
    gaps = [0.0, *(float(surface.thickness) for surface in lens.surfaces[1:-1])]  # rays stand at the first surface
    rows = zip(lens.surfaces[1:], gaps, indices[:-1], indices[1:], strict=True)
    found = [_surface(number, *row) for number, row in enumerate(rows, 1)]
    if not safe and any(one.kind == _ASPHERE for one in found):
        raise ValueError("the plain limit knows planes and spheres only")
    return (_Surface * len(found))(*found)


def _surface(number: int, surface: Surface, gap: float, n1: Tensor, n2: Tensor) -> _Surface:
    conic_alone = surface.conic is not None and surface.coefficients is None
    if surface.is_mirror or surface.apertures or not is_even(surface) or conic_alone:
        raise ValueError(f"surface {number}: the limits know planes, spheres and even aspheres that refract")
    curvature, conic, a = shape_of(surface, number)
    if len(a) > _TERMS:
        raise ValueError(f"surface {number}: {len(a)} aspheric terms; the limits know up to {_TERMS}")
    return _Surface(
        kind=_PLANE if surface.is_plane else _ASPHERE if a else _SPHERE,
        bends=int(n2 is not n1),
        terms=len(a),
        gap=gap,
        curvature=curvature,
        shape=1 + conic,
        before=float(n1),
        behind=float(n2),
        coefficients=(ctypes.c_double * _TERMS)(*a),
    )

"""Choice: which trace carries a batch of rays, torch's own operators ("eager") or the compiled one ("compiled").

The program chooses by what is there and what pays; `trace_engine` and the environment variable RAYTRACE_TRACE force
either.
"""

import contextlib
import contextvars
import os
import sys
from collections.abc import Iterator

import torch
from torch import Tensor
from torch.autograd import forward_ad

from raytrace.system.rays import Rays
from raytrace.tracing.compiled.library import NoCompiler, is_built, library

ENGINES = ("auto", "eager", "compiled")

WORTH_COMPILING = 2**23  # rays × surfaces of one call: it takes torch 0.3 s, and compiling, once for a machine, 10 s

_engine: contextvars.ContextVar[str | None] = contextvars.ContextVar("engine", default=None)
_refused: list[str] = []


@contextlib.contextmanager
def trace_engine(engine: str) -> Iterator[None]:
    """Within the block, trace by this engine: "eager", "compiled" or "auto".

    "auto", the default, takes the compiled trace for tensors on the CPU where it has been compiled already, compiles
    it for a batch that is worth it, and else falls back to eager. "compiled" raises NoCompiler where it cannot be had,
    but still leaves to torch what it has no form for: other devices, forward derivatives, transforms of torch.func,
    height maps, kinds of sag that are not compiled, and Fresnel lenses but of even aspheres.
    Raises ValueError for another name.
    """
    token = _engine.set(_checked(engine, "trace_engine"))
    try:
        yield
    finally:
        _engine.reset(token)


def engine() -> str:
    """The engine asked for: by `trace_engine`, by RAYTRACE_TRACE, or "auto"."""
    return _engine.get() or _checked(os.environ.get("RAYTRACE_TRACE") or "auto", "RAYTRACE_TRACE")


def prepare() -> str:
    """Make the compiled trace ready, compiling it if need be: "compiled", or "eager" without it.

    For loops of many small batches, which would not compile it by themselves, and for runs whose numbers must not
    depend on when somebody else compiled it.
    """
    return "compiled" if engine() != "eager" and _available(build=True) else "eager"


def uses_compiled(rays: Rays, numbers: Tensor, surfaces: int) -> bool:
    """Whether the compiled trace carries these rays; numbers: any number of the lens, for its device and dtype."""
    asked = engine()
    if asked == "eager" or not _has_form(rays, numbers):
        return False
    if asked == "compiled":
        library()
        return True
    return _available(build=rays.direction[0].numel() * surfaces >= WORTH_COMPILING)


def _has_form(rays: Rays, numbers: Tensor) -> bool:
    """Whether these are plain tensors of float32 or float64 on the CPU, and no forward derivative is under way."""
    kinds = {rays.direction.dtype, rays.position.dtype, *(() if rays.opl is None else (rays.opl.dtype,))}
    return (
        rays.direction.device.type == "cpu"
        and numbers.device.type == "cpu"
        and kinds in ({torch.float32}, {torch.float64})
        and not torch._C._are_functorch_transforms_active()
        and getattr(forward_ad, "_current_level", -1) < 0
        and not torch.compiler.is_compiling()
    )


def _available(*, build: bool) -> bool:
    if _refused or not (build or is_built()):
        return False
    try:
        library()
    except NoCompiler as error:
        _refused.append(str(error))
        print(f"raytrace: {error}; tracing by torch alone", file=sys.stderr)
        return False
    return True


def _checked(name: str, origin: str) -> str:
    if name not in ENGINES:
        raise ValueError(f"{origin} {name!r}: expected one of {', '.join(ENGINES)}")
    return name

"""Library: the C++ of this folder, compiled once for this machine and kept on disk for every process after.

The name of the kept file is a digest of the sources, the flags, the compiler and the processor, so that none of them
can change unnoticed. Nothing else is built, whatever the lens: its structure is data to the compiled trace.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shutil
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import torch

SOURCES = ("block.h", "loops.h", "careful.h", "adjoint.h", "tangent.h", "trace.cpp")
FLAGS = ("-O3", "-std=c++17", "-fPIC", "-fopenmp-simd", "-fno-math-errno", "-fno-trapping-math")
#: Flags that not every compiler, processor or torch knows: tried in this order, the last none. With -fopenmp, which
#: stands only where it compiles, threads are those of the OpenMP that torch has loaded: two of them would wait for each
#: other's turn at full power.
_THREADS, _PROCESSOR, _VECTORS = ("-fopenmp",), ("-march=native",), ("-mprefer-vector-width=512",)
_TRIED = (_THREADS + _PROCESSOR + _VECTORS, _THREADS + _PROCESSOR, _PROCESSOR + _VECTORS, _PROCESSOR, ())
_COMPILERS = ("c++", "g++", "clang++")


class NoCompiler(RuntimeError):
    """The compiled trace cannot be had on this machine; the message says why."""


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled trace, built now if it was not before. Raises NoCompiler."""
    path = _kept_at()
    if not path.exists():
        _build(path)
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise NoCompiler(f"{path} cannot be loaded ({error}); remove it and try again") from None


@functools.cache
def is_built() -> bool:
    """Whether an earlier process, or this one, has compiled the trace: then it costs a millisecond to load."""
    try:
        return _kept_at().exists()
    except NoCompiler:
        return False


def compiler() -> str:
    """Path of the C++ compiler: the environment's CXX, or the first of c++, g++, clang++. Raises NoCompiler."""
    own = os.environ.get("CXX")
    found = shutil.which(own) if own else next(filter(None, map(shutil.which, _COMPILERS)), None)
    if found is None:
        raise NoCompiler(f"no C++ compiler found ({own or ', '.join(_COMPILERS)})")
    return found


def cache_folder() -> Path:
    """Where compiled code is kept: RAYTRACE_CACHE, or raytrace/ in the user's cache folder."""
    own = os.environ.get("RAYTRACE_CACHE")
    if own:
        return Path(own)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "raytrace"


@functools.cache
def _kept_at() -> Path:
    digest = hashlib.sha256()
    for name in SOURCES:
        digest.update(Path(__file__).with_name(name).read_bytes())
    program = compiler()
    stamp = os.stat(program)
    digest.update(
        repr((FLAGS, _TRIED, torch.__version__, program, stamp.st_size, stamp.st_mtime_ns, _processor())).encode()
    )
    return cache_folder() / f"trace-{digest.hexdigest()[:20]}.so"


def _processor() -> str:
    """What tells processors apart for which other code is made."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return "\n".join(sorted({line for line in lines if line.startswith(("model name", "flags", "Features"))}))
    except OSError:
        return f"{platform.machine()} {platform.processor()}"


def _build(path: Path) -> None:
    program, source = compiler(), Path(__file__).with_name("trace.cpp")
    note = threading.Timer(
        1.0, lambda: print("raytrace: compiling the trace, once for this machine …", file=sys.stderr)
    )
    note.daemon = True
    note.start()
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=path.parent) as folder:
            made, compiled = Path(folder) / path.name, Path(folder) / "trace.o"
            for own in _TRIED:
                done = _run(program, *FLAGS, *own, "-c", str(source), "-o", str(compiled))
                if done.returncode == 0:
                    done = _run(program, "-shared", str(compiled), "-o", str(made))
                if done.returncode == 0 and _can_be_loaded(made):
                    os.replace(made, path)
                    return
    except OSError as error:
        raise NoCompiler(
            f"{path.parent}: {error.strerror or error}; set RAYTRACE_CACHE to a folder to write to"
        ) from None
    finally:
        note.cancel()
    said = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[0]
    raise NoCompiler(f"{program} cannot compile the trace: {said}")


def _run(*words: str) -> subprocess.CompletedProcess:
    return subprocess.run(words, capture_output=True, text=True)


def _can_be_loaded(path: Path) -> bool:
    """Whether what the code needs is there: its threads are torch's."""
    try:
        ctypes.CDLL(str(path))
    except OSError:
        return False
    return True

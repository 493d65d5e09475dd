"""Library: the C++ of this folder, compiled once for this machine and kept on disk for every process after.

The name of the kept file is a digest of the sources, the flags, the compiler and the processor, so that none of them
can change unnoticed. Nothing else is built, whatever the lens: its structure is data to the compiled trace.
"""

import ctypes
import functools
import hashlib
import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

import torch

from raytrace.tracing.compiled.trust import check_file, open_folder, private_folder

#: The folder of the C++ sources.
CPP = Path(__file__).absolute().parents[1] / "cpp"
SOURCES = (
    *("block.h", "sags.h", "freeform.h", "apertures.h", "paths.h", "sag_terms.h", "loops.h", "facets.h", "phases.h"),
    *("search.h", "careful.h", "adjoint.h", "tangent.h", "phase_slopes.h", "turns.h", "trace.cpp"),
)
FLAGS = ("-O3", "-std=c++17", "-fPIC", "-fopenmp-simd", "-fno-math-errno", "-fno-trapping-math")
#: Flags that not every compiler, processor or torch knows: tried in this order, the last none. With -fopenmp, which
#: stands only where it compiles, threads are those of the OpenMP that torch has loaded: two of them would wait for each
#: other's turn at full power.
_THREADS, _PROCESSOR, _VECTORS = ("-fopenmp",), ("-march=native",), ("-mprefer-vector-width=512",)
_TRIED = (_THREADS + _PROCESSOR + _VECTORS, _THREADS + _PROCESSOR, _PROCESSOR + _VECTORS, _PROCESSOR, ())
_COMPILERS = ("c++", "g++", "clang++")
_BUILDING = "building-"
_DAY = 24 * 3600.0  # s
_LONG = 90 * _DAY


class NoCompiler(RuntimeError):
    """The compiled trace cannot be had on this machine; the message says why."""


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled trace, built now if it was not before. Raises NoCompiler.

    Only a file that nobody but this user can have written is loaded (see `trust`). Where the cache folder is not
    safe or cannot be written, the trace is built for this process alone, in a private temporary folder.
    """
    if os.name != "posix":
        raise NoCompiler("the compiled trace is for POSIX systems")
    if not _is_kept():
        try:
            _keep(cache_folder())
        except OSError as error:
            _say(f"{_told(error)}; compiling in a private folder for this process alone (RAYTRACE_CACHE sets another)")
            return _for_this_process()
    path = cache_folder() / _file_name()
    with suppress(OSError):
        os.utime(path)  # when it was used last, for `_remove_old`
    return _loaded(path)


@functools.cache
def is_built() -> bool:
    """Whether an earlier process, or this one, has compiled the trace: then it costs a millisecond to load."""
    try:
        return os.name == "posix" and _is_kept()
    except NoCompiler:
        return False


def compiler(named: str | None = None) -> tuple[str, ...]:
    """The C++ compiler, its path and words: the one named, the environment's CXX, or the first of c++, g++, clang++.

    Looked for in the absolute folders of PATH alone, never in the current one. Raises NoCompiler.
    """
    own = named or os.environ.get("CXX")
    try:
        given = [tuple(shlex.split(own))] if own and own.strip() else [(name,) for name in _COMPILERS]
    except ValueError as error:
        raise NoCompiler(f"CXX {own!r}: {error}") from None
    for program, *words in given:
        if os.sep in program and not os.path.isabs(program):
            raise NoCompiler(f"CXX {program!r}: expected an absolute path, or a name to look for in PATH")
        found = shutil.which(program, path=_safe_path())
        if found:
            return (found, *words)
    raise NoCompiler(f"no C++ compiler found ({own or ', '.join(_COMPILERS)})")


def run_compiler(*words: str, folder: Path) -> subprocess.CompletedProcess:
    """Run a program of `compiler` in a private folder, which then is where it finds what has no absolute path."""
    environment = os.environ | {"PATH": _safe_path()}
    return subprocess.run(
        words, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=600
    )


@functools.cache
def cache_folder() -> Path:
    """Where compiled code is kept: RAYTRACE_CACHE, or raytrace/ in the user's cache folder; an absolute path."""
    for name, below in (("RAYTRACE_CACHE", ""), ("XDG_CACHE_HOME", "raytrace")):
        given = os.environ.get(name)
        if given and os.path.isabs(given):
            return Path(given) / below
        if given:
            _say(f"{name} {given!r} is not an absolute path: ignored")
    return Path(os.path.expanduser("~/.cache/raytrace"))


@functools.cache
def _file_name() -> str:
    """`trace-MACHINE-INSTALLATION-DIGEST.so`: a home that machines share holds a file for each kind of them."""
    program, *words = compiler()
    stamp = os.stat(program)
    sources = [(CPP / name).read_bytes() for name in SOURCES]
    how = (FLAGS, _TRIED, torch.__version__, program, words, stamp.st_size, stamp.st_mtime_ns, _processor())
    return f"{_of_this_installation()}{_digest(sources, how, length=10)}.so"


@functools.cache
def _of_this_machine() -> str:
    return f"trace-{_digest(platform.machine(), _processor('model name'), length=4)}-"


@functools.cache
def _of_this_installation() -> str:
    return f"{_of_this_machine()}{_digest(__file__, sys.prefix, torch.__version__, length=4)}-"


def _digest(*known: object, length: int) -> str:
    return hashlib.blake2b(repr(known).encode(), digest_size=length).hexdigest()


def _is_kept() -> bool:
    """Whether the compiled trace is there, and nobody else can have written it."""
    try:
        folder = open_folder(cache_folder())
    except OSError:
        return False
    try:
        check_file(_file_name(), folder)
    except OSError:
        return False
    finally:
        os.close(folder)
    return True


def _keep(folder: Path) -> None:
    """Build the trace into the cache folder. Raises OSError where that is not safe or cannot be written, NoCompiler."""
    os.close(open_folder(folder, make=True))
    path = folder / _file_name()
    if path.exists():
        _say(f"{path} can be somebody else's: compiled anew")
    with tempfile.TemporaryDirectory(prefix=_BUILDING, dir=folder) as private:
        os.replace(_build(Path(private)), path)
    _remove_old(folder)


def _for_this_process() -> ctypes.CDLL:
    try:
        with private_folder() as private:
            return _loaded(_build(private))
    except OSError as error:
        raise NoCompiler(f"the trace cannot be compiled: {_told(error)}") from None


def _told(error: OSError) -> str:
    return f"{error.filename}: {error.strerror}" if error.filename else str(error)


def _remove_old(folder: Path) -> None:
    """Remove what this installation compiled before, and what none of this machine has used for long.

    A process that runs on such a file keeps it until it ends.
    """
    now = time.time()
    for path in folder.glob("trace-*.so"):
        with suppress(OSError):
            status = path.lstat()
            is_machine_s = path.name.startswith(_of_this_machine()) or path.name.count("-") == 1
            is_old = path.name.startswith(_of_this_installation()) or (is_machine_s and now - status.st_mtime > _LONG)
            if is_old and path.name != _file_name() and status.st_uid == os.geteuid():
                path.unlink()
    for path in folder.glob(f"{_BUILDING}*"):
        with suppress(OSError):
            if now - path.lstat().st_mtime > _DAY:
                shutil.rmtree(path, ignore_errors=True)


def _processor(*only: str) -> str:
    """What tells processors apart for which other code is made."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return "\n".join(
            sorted({line for line in lines if line.startswith(only or ("model name", "flags", "Features"))})
        )
    except OSError:
        return f"{platform.machine()} {platform.processor()}"


def _build(folder: Path) -> Path:
    """The trace, compiled into a private folder. Raises NoCompiler, and OSError where it cannot be written."""
    program, source = compiler(), CPP / "trace.cpp"
    note = threading.Timer(1.0, _say, ["compiling the trace, once for this machine …"])
    note.daemon = True
    note.start()
    made, compiled = folder / _file_name(), folder / "trace.o"
    try:
        for own in _TRIED:
            done = run_compiler(*program, *FLAGS, *own, "-c", str(source), "-o", str(compiled), folder=folder)
            if done.returncode == 0:
                done = run_compiler(*program, "-shared", str(compiled), "-o", str(made), folder=folder)
            if done.returncode == 0 and _can_be_loaded(made):
                made.chmod(0o600)
                return made
    except subprocess.TimeoutExpired as error:
        raise NoCompiler(f"{program[0]} has not compiled the trace in {error.timeout:g} s") from None
    finally:
        note.cancel()
    said = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[0]
    raise NoCompiler(f"{' '.join(program)} cannot compile the trace: {said}")


def _can_be_loaded(path: Path) -> bool:
    """Whether what the code needs is there: its threads are torch's."""
    try:
        ctypes.CDLL(str(path))
    except OSError:
        return False
    return True


def _loaded(path: Path) -> ctypes.CDLL:
    try:
        return ctypes.CDLL(str(path))
    except OSError as error:
        raise NoCompiler(f"{path} cannot be loaded ({error}); remove it and try again") from None


def _safe_path() -> str:
    """PATH without the current folder and others that are relative to it."""
    folders = os.environ.get("PATH", os.defpath).split(os.pathsep)
    return os.pathsep.join(folder for folder in folders if os.path.isabs(folder))


def _say(words: str) -> None:
    print(f"raytrace: {words}", file=sys.stderr)

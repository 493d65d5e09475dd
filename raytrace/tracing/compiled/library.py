"""Choice: which trace carries a batch of rays, torch's own operators ("eager") or the compiled one ("compiled").

The program chooses by what is there and what pays; `trace_engine` and the environment variable RAYTRACE_TRACE force
either.


Trust: what may be executed is what nobody but this user, and root, can have written.

A folder is reached from the root step by step, each step checked on the opened folder itself and links followed by
hand, so that nobody can swap one meanwhile. Known from ssh's StrictModes and from Tsafrir et al., "Portably solving
file TOCTTOU races with hardness amplification" (2008): behind a path of safe folders there is no race.


Library: the C++ of this folder, compiled once for this machine and kept on disk for every process after.

The name of the kept file is a digest of the sources, the flags, the compiler and the processor, so that none of them
can change unnoticed. Nothing else is built, whatever the lens: its structure is data to the compiled trace.

"""

import contextlib
import contextvars
import ctypes
import errno
import functools
import hashlib
import os
import platform
import shlex
import shutil
import stat
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import torch
from torch import Tensor
from torch.autograd import forward_ad

from raytrace.system.rays import Rays

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


_MOST_LINKS = 40
#: To pass through a folder takes no right to list it. Systems that are not POSIX lack these, and the compiled trace.
_FOLDER = getattr(os, "O_PATH", 0) | sum(getattr(os, name, 0) for name in ("O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC"))


class Untrusted(OSError):
    """Somebody else could write here; the message says where, and who."""


def open_folder(path: Path, *, make: bool = False) -> int:
    """A descriptor of a folder that, with all above it, nobody else can change; the caller closes it.

    make: make what is missing of it, for this user alone. Raises Untrusted where somebody else can change it or
    where `path` is relative, OSError where it is missing or cannot be read or made.
    """
    path = Path(path)
    if not path.is_absolute():
        raise Untrusted(f"{path}: not an absolute path")
    names, so_far, links = list(path.parts[1:]), Path(path.root), 0
    here = os.open(path.root, _FOLDER)
    try:
        while True:
            _refuse(os.fstat(here), so_far, passing=bool(names))
            if not names:
                return here
            name = names.pop(0)
            target = _link(name, here, so_far)
            if target is not None:
                links += 1
                if links > _MOST_LINKS:
                    raise Untrusted(f"{path}: too many links")
                names = [*target.parts[target.is_absolute() :], *names]
                name = target.root or "."
            so_far = Path(os.path.normpath(so_far / name))
            there = _step(here, name, so_far, make=make)
            os.close(here)
            here = there
    except BaseException:
        os.close(here)
        raise


def objection(status: os.stat_result, *, passing: bool = False, mine: bool = False) -> str:
    """Why somebody else could change this file or folder, or what is in it; "" where nobody can.

    passing: of this folder only the one way on matters, which is checked for itself: it may be like /tmp, where only
    owners rename and remove. mine: it has to be this user's, not root's.
    """
    user = os.geteuid()
    if status.st_uid not in ((user,) if mine else (0, user)):
        return f"belongs to user {status.st_uid}, not to {user}"
    if passing and status.st_mode & stat.S_ISVTX:
        return ""
    if status.st_mode & stat.S_IWOTH:
        return "can be written by everybody (chmod go-w)"
    return "can be written by its group (chmod g-w)" if status.st_mode & stat.S_IWGRP else ""


def check_file(name: str, folder: int) -> None:
    """Raise Untrusted unless the file of that name in a trusted folder is a plain one, written by this user alone.

    Checked on the opened file; OSError where there is none.
    """
    file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
    try:
        status = os.fstat(file)
    finally:
        os.close(file)
    said = objection(status, mine=True) if stat.S_ISREG(status.st_mode) else "is no plain file"
    if said:
        raise Untrusted(f"{name} {said}")


@contextmanager
def private_folder() -> Iterator[Path]:
    """A new folder for this user alone in the system's folder for temporary files; removed behind the block.

    Raises Untrusted where others could exchange it.
    """
    with tempfile.TemporaryDirectory(prefix="raytrace-") as made:
        os.close(open_folder(Path(made).absolute()))
        yield Path(made)


def _step(here: int, name: str, path: Path, *, make: bool) -> int:
    """The folder of that name in `here`."""
    try:
        return os.open(name, _FOLDER, dir_fd=here)
    except OSError as error:
        if not (make and error.errno == errno.ENOENT):
            raise OSError(error.errno, error.strerror, str(path)) from None
    try:
        with suppress(FileExistsError):
            os.mkdir(name, 0o700, dir_fd=here)
        return os.open(name, _FOLDER, dir_fd=here)
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from None


def _link(name: str, folder: int, path: Path) -> Path | None:
    """Where a link points to, None for what is no link. Raises Untrusted for a link of somebody else's."""
    try:
        status = os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return None
    if not stat.S_ISLNK(status.st_mode):
        return None
    if status.st_uid not in (0, os.geteuid()):
        raise Untrusted(f"{path / name} {objection(status)}")
    return Path(os.readlink(name, dir_fd=folder))


def _refuse(status: os.stat_result, path: Path, *, passing: bool) -> None:
    said = objection(status, passing=passing)
    if said:
        raise Untrusted(f"{path} {said}")


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

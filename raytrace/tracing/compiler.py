"""The C++ of `cpp/`, compiled once for this machine and stored on disk for later processes.

The name of the file is a digest of the sources, the flags, the compiler and the processor. The structure of a lens is
data to the compiled trace: no lens needs another compilation.

Only files that this user or root alone can have written are executed. A folder is reached from the root step by step,
each step checked on the opened folder and links followed by hand, so that nobody can exchange one meanwhile: as ssh's
StrictModes, and Tsafrir et al., "Portably solving file TOCTTOU races with hardness amplification" (2008).
"""

import ctypes
import errno
import fcntl
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
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from pathlib import Path

import torch

from raytrace.words import RaytraceError

_MOST_LINKS = 40
#: Passing through a folder needs no right to list it. Systems that are not POSIX lack these, and the compiled trace.
_FOLDER = getattr(os, "O_PATH", 0) | sum(getattr(os, name, 0) for name in ("O_DIRECTORY", "O_NOFOLLOW", "O_CLOEXEC"))


class Untrusted(RaytraceError, OSError):
    """Another user could write in a folder; the message has the folder and its owner."""


def open_folder(path: Path, *, make: bool = False) -> int:
    """A descriptor of a folder that no other user can change, nor those above it; the caller closes it.

    make: create missing folders, for this user alone. Raises Untrusted for a folder that another user can change and
    for a relative `path`, OSError for one that is missing or cannot be read or created.
    """
    path = Path(path)
    if not path.is_absolute():
        raise Untrusted(f"{path}: not an absolute path")
    names, so_far, links = list(path.parts[1:]), Path(path.root), 0
    here = os.open(path.root, _FOLDER)
    try:
        while True:
            if reason := objection(os.fstat(here), passing=bool(names)):
                raise Untrusted(f"{so_far} {reason}")
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
            step = _step(here, name, so_far, make=make)
            os.close(here)
            here = step
    except BaseException:
        os.close(here)
        raise


def objection(status: os.stat_result, *, passing: bool = False, mine: bool = False) -> str:
    """Why another user could change this file or folder or its contents; "" if none can.

    passing: only the next folder of the path matters, which is checked itself: this one may be like /tmp, where only
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
    """Raise Untrusted unless a file in a trusted folder is a plain one that this user alone can write.

    Checked on the opened file; OSError where there is none.
    """
    file = os.open(name, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, dir_fd=folder)
    try:
        status = os.fstat(file)
    finally:
        os.close(file)
    if reason := objection(status, mine=True) if stat.S_ISREG(status.st_mode) else "is no plain file":
        raise Untrusted(f"{name} {reason}")


@contextmanager
def private_folder() -> Iterator[Path]:
    """A new temporary folder for this user alone, removed after the block. Raises Untrusted."""
    with tempfile.TemporaryDirectory(prefix="raytrace-") as made:
        os.close(open_folder(Path(made).absolute()))
        yield Path(made)


def _step(here: int, name: str, path: Path, *, make: bool) -> int:
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
    """The target of a link, None if it is none. Raises Untrusted for a link of another user's."""
    try:
        status = os.stat(name, dir_fd=folder, follow_symlinks=False)
    except FileNotFoundError:
        return None
    if not stat.S_ISLNK(status.st_mode):
        return None
    if status.st_uid not in (0, os.geteuid()):
        raise Untrusted(f"{path / name} {objection(status)}")
    return Path(os.readlink(name, dir_fd=folder))


#: The folder of the C++ sources.
CPP = Path(__file__).absolute().parent / "cpp"
SOURCES = (
    *("block.h", "jet.h", "sags.h", "apertures.h", "paths.h", "sag_terms.h", "loops.h", "facets.h", "phases.h"),
    *("search.h", "careful.h", "adjoint.h", "tangent.h", "phase_slopes.h", "turns.h", "trace.cpp"),
)
FLAGS = ("-O3", "-std=c++17", "-fPIC", "-fopenmp-simd", "-fno-math-errno", "-fno-trapping-math")
#: Flags that not every compiler, processor or torch supports: tried in this order, the last none. With -fopenmp,
#: threads are those of the OpenMP that torch has loaded: two OpenMP libraries would wait for each other at full power.
_THREADS, _PROCESSOR, _VECTORS = ("-fopenmp",), ("-march=native",), ("-mprefer-vector-width=512",)
_TRIED = (_THREADS + _PROCESSOR + _VECTORS, _THREADS + _PROCESSOR, _PROCESSOR + _VECTORS, _PROCESSOR, ())
_REALS = "float", "double"  # each an object of its own
_COMPILERS = ("c++", "g++", "clang++")
_TAKES = "a minute or two"
_BUILDING = "building-"
_DAY = 24 * 3600.0  # s
_LONG = 90 * _DAY


class NoCompiler(RaytraceError, RuntimeError):
    """The compiled trace is unavailable on this machine; the message says why."""


@functools.cache
def library() -> ctypes.CDLL:
    """The compiled trace, compiled now if it was not before. Raises NoCompiler.

    Where the cache folder is not safe or cannot be written, it is compiled for this process alone, in a private folder.
    """
    if os.name != "posix":
        raise NoCompiler("the compiled trace is for POSIX systems")
    if not _is_kept():
        folder = cache_folder()
        try:
            os.close(open_folder(folder, make=True))
            with _alone_in(folder):
                if not _is_kept():  # else another process has compiled it meanwhile
                    if (folder / _file_name()).exists():
                        _say(f"{folder / _file_name()} can be another user's: compiled anew")
                    if not _is_of_another_installation(folder):
                        with tempfile.TemporaryDirectory(prefix=_BUILDING, dir=folder) as private:
                            os.replace(_build(Path(private)), folder / _file_name())
                    _remove_old(folder)
        except OSError as error:
            reason = _reason(error)
            _say(f"{reason}; compiling in a private folder for this process alone (RAYTRACE_CACHE sets another)")
            try:
                with private_folder() as private:
                    return _loaded(_build(private))
            except OSError as error:
                raise NoCompiler(f"the trace cannot be compiled: {_reason(error)}") from None
    path = cache_folder() / _file_name()
    with suppress(OSError):
        os.utime(path)  # the time of the last use, for `_remove_old`
    return _loaded(path)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Processes that need the same code compile it once: the others wait here for the first."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        with suppress(OSError):  # not every file system has locks
            fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


@functools.cache
def is_built() -> bool:
    """Whether the trace has been compiled: then it loads in a millisecond."""
    try:
        return os.name == "posix" and _is_kept()
    except NoCompiler:
        return False


def compiler(command: str | None = None) -> tuple[str, ...]:
    """The C++ compiler, its path and options: the command, by default CXX of the environment or c++, g++ or clang++.

    Searched in the absolute folders of PATH alone, never in the current one. Raises NoCompiler.
    """
    wish = command or os.environ.get("CXX")
    try:
        candidates = [tuple(shlex.split(wish))] if wish and wish.strip() else [(name,) for name in _COMPILERS]
    except ValueError as error:
        raise NoCompiler(f"CXX {wish!r}: {error}") from None
    for program, *words in candidates:
        if os.sep in program and not os.path.isabs(program):
            raise NoCompiler(f"CXX {program!r}: expected an absolute path, or a name to look for in PATH")
        if path := shutil.which(program, path=_safe_path()):
            return (path, *words)
    raise NoCompiler(f"no C++ compiler found ({wish or ', '.join(_COMPILERS)})")


def run_compiler(*words: str, folder: Path) -> subprocess.CompletedProcess:
    """Run a program of `compiler` in a private folder, so that no relative path leads elsewhere."""
    environment = os.environ | {"PATH": _safe_path()}
    return subprocess.run(
        words, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=1800
    )


@functools.cache
def cache_folder() -> Path:
    """Where compiled code is kept: RAYTRACE_CACHE, or raytrace/ in the user's cache folder; an absolute path."""
    for name, below in (("RAYTRACE_CACHE", ""), ("XDG_CACHE_HOME", "raytrace")):
        folder = os.environ.get(name)
        if folder and os.path.isabs(folder):
            return Path(folder) / below
        if folder:
            _say(f"{name} {folder!r} is not an absolute path: ignored")
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
    """Whether the compiled trace is there and no other user can have written it."""
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


def _is_of_another_installation(folder: Path) -> bool:
    """Whether another installation of this user, as a virtual environment, has compiled the same code; it is linked."""
    digest = _file_name().rpartition("-")[2]
    for path in sorted(folder.glob(f"{_of_this_machine()}*-{digest}")):
        with suppress(OSError, NoCompiler):  # another user's, or linked to another torch
            opened = open_folder(folder)
            try:
                check_file(path.name, opened)
            finally:
                os.close(opened)
            _loaded(path)
            os.link(path, folder / _file_name())
            return True
    return False


def _reason(error: OSError) -> str:
    return f"{error.filename}: {error.strerror}" if error.filename else str(error)


def _remove_old(folder: Path) -> None:
    """Remove earlier files of this installation, and those unused for _LONG; a process keeps a file it has loaded."""
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
    """The properties of the processor that the compiled code depends on."""
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
    note = threading.Timer(2.0, _say, [f"compiling the trace for this machine (once, {_TAKES}) …"])
    note.daemon = True
    note.start()
    made, objects = folder / _file_name(), {real: str(folder / f"{real}.o") for real in _REALS}

    def compiled(flags: Sequence[str], real: str) -> subprocess.CompletedProcess:
        words = (*FLAGS, *flags, f"-DRAYTRACE_REAL={real}", "-c", str(source), "-o", objects[real])
        return run_compiler(*program, *words, folder=folder)

    try:
        for flags in _TRIED:
            with ThreadPoolExecutor(len(_REALS)) as side_by_side:
                each = side_by_side.map(functools.partial(compiled, flags), _REALS)
                done = max(each, key=lambda run: run.returncode != 0)
            if done.returncode == 0:
                done = run_compiler(*program, "-shared", *objects.values(), "-o", str(made), folder=folder)
            if done.returncode == 0:
                with suppress(OSError):  # its threads are torch's: the code needs those that torch has loaded
                    ctypes.CDLL(str(made))
                    made.chmod(0o600)
                    return made
    except subprocess.TimeoutExpired as error:
        raise NoCompiler(f"{program[0]} has not compiled the trace in {error.timeout:g} s") from None
    finally:
        note.cancel()
    reason = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()[0]
    raise NoCompiler(f"{' '.join(program)} cannot compile the trace: {reason}")


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

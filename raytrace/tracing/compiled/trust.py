"""Trust: what may be executed is what nobody but this user, and root, can have written.

A folder is reached from the root step by step, each step checked on the opened folder itself and links followed by
hand, so that nobody can swap one meanwhile. Known from ssh's StrictModes and from Tsafrir et al., "Portably solving
file TOCTTOU races with hardness amplification" (2008): behind a path of safe folders there is no race.
"""

import errno
import os
import stat
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

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

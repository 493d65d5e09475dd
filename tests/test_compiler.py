"""Only compiled code of this user is run: checks of folders, links and files; a planted library is refused."""

import ctypes
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from raytrace.tracing import compiler as library
from raytrace.tracing.compiler import (
    NoCompiler,
    Untrusted,
    check_file,
    compiler,
    objection,
    open_folder,
    private_folder,
)

pytestmark = pytest.mark.skipif(os.name != "posix", reason="owners and modes are POSIX's")

NOBODY = 65_000


def refused(path: Path, **keywords) -> str:
    with pytest.raises(Untrusted) as found:
        open_folder(path, **keywords)
    return str(found.value)


def test_a_folder_of_this_user_is_opened_and_made_for_him_alone(tmp_path):
    made = tmp_path / "one" / "two"
    with pytest.raises(FileNotFoundError):
        open_folder(made)
    before = os.umask(0)
    try:
        os.close(open_folder(made, make=True))
    finally:
        os.umask(before)
    assert [path.stat().st_mode & 0o777 for path in (made, made.parent)] == [0o700, 0o700]


@pytest.mark.parametrize(("mode", "said"), [(0o777, "everybody"), (0o775, "its group"), (0o1777, "everybody")])
def test_a_folder_that_others_write_is_refused(tmp_path, mode, said):
    """Nor one below it, unless only owners remove and rename there, as in /tmp."""
    (tmp_path / "open" / "own").mkdir(parents=True, mode=0o700)
    (tmp_path / "open").chmod(mode)
    assert f"{tmp_path / 'open'} can be written by {said}" in refused(tmp_path / "open")
    if mode & 0o1000:
        os.close(open_folder(tmp_path / "open" / "own"))
    else:
        assert f"{tmp_path / 'open'} can be written by {said}" in refused(tmp_path / "open" / "own")


def test_a_relative_folder_is_refused(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert "not an absolute path" in refused(Path("."))


def test_links_are_followed_step_by_step(tmp_path):
    """Through safe folders they lead on; through one that others write, at either end, they do not."""
    for name in ("open", "own"):
        (tmp_path / name).mkdir(mode=0o700)
    (tmp_path / "to_own").symlink_to(tmp_path / "own")
    (tmp_path / "own" / "back").symlink_to("../own")
    (tmp_path / "open" / "to_own").symlink_to(tmp_path / "own")
    (tmp_path / "to_open").symlink_to("open")
    (tmp_path / "round").symlink_to("round")
    (tmp_path / "open").chmod(0o777)
    same = os.stat(tmp_path / "own").st_ino
    for path in ("to_own", "own/back/back", "to_own/../own"):
        folder = open_folder(tmp_path / path)
        assert os.fstat(folder).st_ino == same
        os.close(folder)
    for path in ("open/to_own", "to_open"):
        assert "can be written by everybody" in refused(tmp_path / path)
    assert "too many links" in refused(tmp_path / "round")


def test_files_of_other_users_are_refused(tmp_path, monkeypatch):
    """To another user our own folders and files are somebody else's (root's folders he has to trust)."""
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "file").chmod(0o600)
    folder = open_folder(tmp_path)
    check_file("file", folder)
    monkeypatch.setattr(library.os, "geteuid", lambda: NOBODY)
    with pytest.raises(Untrusted, match=f"user {os.getuid()}, not to {NOBODY}"):
        check_file("file", folder)
    os.close(folder)
    if os.getuid():
        assert f"belongs to user {os.getuid()}, not to {NOBODY}" in refused(tmp_path)


def test_root_is_trusted_with_folders_and_nobody_else():
    def status(owner: int, mode: int) -> os.stat_result:
        return os.stat_result((mode, 1, 1, 1, owner, 0, 0, 0, 0, 0))

    own = os.geteuid()
    assert objection(status(0, 0o40755)) == objection(status(own, 0o40700)) == ""
    assert objection(status(0, 0o41777), passing=True) == ""
    assert objection(status(NOBODY, 0o40700)) == f"belongs to user {NOBODY}, not to {own}"
    assert objection(status(NOBODY, 0o41700), passing=True)
    assert objection(status(NOBODY, 0o100600), mine=True)


@pytest.mark.parametrize("mode", [0o666, 0o620])
def test_a_file_that_others_write_is_refused(tmp_path, mode):
    (tmp_path / "file").write_bytes(b"")
    (tmp_path / "file").chmod(mode)
    (tmp_path / "link").symlink_to("file")
    os.mkfifo(tmp_path / "pipe", 0o600)
    folder = open_folder(tmp_path)
    for name, said in (("file", "can be written"), ("pipe", "is no plain file")):
        with pytest.raises(Untrusted, match=said):
            check_file(name, folder)
    with pytest.raises(OSError, match="link"):
        check_file("link", folder)
    os.close(folder)


def test_a_temporary_folder_that_others_could_exchange_is_refused(tmp_path, monkeypatch):
    with private_folder() as folder:
        assert folder.stat().st_mode & 0o777 == 0o700
    assert not folder.exists()
    tmp_path.chmod(0o777)
    monkeypatch.setattr(library.tempfile, "tempdir", str(tmp_path))
    with pytest.raises(Untrusted, match="can be written by everybody"), private_folder():
        pass
    assert not list(tmp_path.iterdir())


# -- the compiled trace ------------------------------------------------------------------------------------------------

PLANTED = """
#include <stdio.h>
__attribute__((constructor)) static void run(void) { fclose(fopen("%s", "w")); }
"""

PROBE = """
import os, sys, torch
from raytrace.tracing import compiler as library
from raytrace.tracing.compiled import uses_compiled
from raytrace.system.rays import Rays
one = torch.ones(3, 1, dtype=torch.float64)
for word in sys.argv[1:]:
    name, _, value = word.partition("=")
    os.environ[name] = value
    library.cache_folder.cache_clear()
    library.is_built.cache_clear()
    print(uses_compiled(Rays(one, one, one[0] > 0), one, 1), flush=True)
    del os.environ[name]
"""


@pytest.fixture(scope="module")
def plant(tmp_path_factory):
    """A library that leaves a mark when it is loaded, and the mark."""
    folder = tmp_path_factory.mktemp("plant")
    mark = folder / "mark"
    (folder / "plant.c").write_text(PLANTED % mark)
    try:
        words = [*compiler(), "-x", "c", "-shared", "-fPIC", str(folder / "plant.c"), "-o", str(folder / "plant.so")]
    except NoCompiler as error:
        pytest.skip(str(error))
    subprocess.run(words, check=True)
    return folder / "plant.so", mark


@pytest.mark.slow
def test_a_planted_library_is_not_run(tmp_path, plant):
    """Neither from a folder that others write, nor as a file that others write, nor from the current folder."""
    planted, mark = plant

    def put(folder: Path, *, folder_mode: int = 0o700, mode: int = 0o600) -> Path:
        folder.mkdir(parents=True)
        shutil.copy(planted, folder / library._file_name())
        (folder / library._file_name()).chmod(mode)
        folder.chmod(folder_mode)
        return folder

    shared, writable = put(tmp_path / "shared", folder_mode=0o777), put(tmp_path / "writable", mode=0o666)
    put(tmp_path / "cache")
    put(tmp_path / "odd" / "raytrace")
    relative = ("RAYTRACE_CACHE=cache", "XDG_CACHE_HOME=odd")
    own = {name: value for name, value in os.environ.items() if name not in ("RAYTRACE_TRACE", "RAYTRACE_CACHE")}
    own |= {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "HOME": str(tmp_path / "home")}
    words = [sys.executable, "-c", PROBE, f"RAYTRACE_CACHE={shared}", f"RAYTRACE_CACHE={writable}", *relative]
    done = subprocess.run(words, env=own, cwd=tmp_path, capture_output=True, text=True, check=True)
    assert not mark.exists()
    assert done.stdout == 4 * "False\n"
    assert done.stderr == "".join(
        f"raytrace: {name} {value!r} is not an absolute path: ignored\n"
        for name, value in (word.split("=") for word in relative)
    )
    ctypes.CDLL(str(planted))  # it does leave a mark
    assert mark.exists()


@pytest.mark.parametrize("name", ["RAYTRACE_CACHE", "XDG_CACHE_HOME"])
def test_a_cache_below_the_current_folder_is_ignored(name, monkeypatch, capsys):
    for other in ("RAYTRACE_CACHE", "XDG_CACHE_HOME"):
        monkeypatch.delenv(other, raising=False)
    usual = library.cache_folder.__wrapped__()
    monkeypatch.setenv(name, "cache")
    assert library.cache_folder.__wrapped__() == usual
    assert usual.is_absolute()
    assert capsys.readouterr().err == f"raytrace: {name} 'cache' is not an absolute path: ignored\n"


@pytest.fixture
def quick(tmp_path, monkeypatch):
    """The cache in a folder of the test's own, and nothing compiled: a file that says where it was built."""
    made = []

    def build(folder: Path) -> Path:
        (folder / library._file_name()).write_bytes(b"new")
        made.append(folder)
        return folder / library._file_name()

    monkeypatch.setattr(library, "cache_folder", lambda: tmp_path)
    monkeypatch.setattr(library, "_build", build)
    monkeypatch.setattr(library, "_loaded", lambda path: path)
    try:
        library._file_name()
    except NoCompiler as error:
        pytest.skip(str(error))
    return made


def test_an_unsafe_folder_is_left_alone_and_reported(quick, tmp_path, capsys):
    tmp_path.chmod(0o777)
    loaded = library.library.__wrapped__()
    assert loaded.parent == quick[0]
    assert tmp_path not in loaded.parents
    assert not loaded.exists()  # loaded, and removed
    assert not list(tmp_path.iterdir())
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(
        f"raytrace: {tmp_path} can be written by everybody (chmod go-w); compiling in a private folder"
    )


def test_a_folder_that_cannot_be_written_is_reported(quick, tmp_path, monkeypatch, capsys):
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(library, "cache_folder", lambda: tmp_path / "file" / "cache")
    assert library.library.__wrapped__().parent == quick[0]
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"raytrace: {tmp_path / 'file'}: Not a directory; compiling in a private folder")


def test_a_file_that_others_can_write_is_replaced(quick, tmp_path, capsys):
    kept = tmp_path / library._file_name()
    kept.write_bytes(b"planted")
    kept.chmod(0o666)
    assert library.library.__wrapped__() == kept
    assert kept.read_bytes() == b"new"
    assert "compiled anew" in capsys.readouterr().err
    kept.chmod(0o600)
    assert library.library.__wrapped__() == kept
    assert len(quick) == 1


def test_the_same_code_of_another_installation_is_not_compiled_again(quick, tmp_path):
    digest = library._file_name().rpartition("-")[2]
    other = tmp_path / f"{library._of_this_machine()}other-{digest}"
    other.write_bytes(b"compiled before")
    other.chmod(0o600)
    kept = library.library.__wrapped__()
    assert kept == tmp_path / library._file_name()
    assert kept.read_bytes() == b"compiled before"
    assert not quick
    kept.unlink()
    other.chmod(0o666)  # others can have changed it
    assert library.library.__wrapped__().read_bytes() == b"new"


def test_old_files_are_removed_and_those_of_others_kept(quick, tmp_path):
    """Gone: of this installation, older code; of this machine, or of nobody knows which, the long unused."""
    own, machine = library._of_this_installation(), library._of_this_machine()
    gone = [f"{own}0123.so", f"{machine}other-0123.so", "trace-0123.so", "building-old"]
    stay = [f"{machine}other-4567.so", "trace-ffffffff-other-0123.so", "trace-4567.so", "notes.txt", "building-new"]
    for name in (*gone, *stay):
        (tmp_path / name).mkdir() if name.startswith("building") else (tmp_path / name).write_bytes(b"")
    long_ago = time.time() - 100 * 24 * 3600
    for name in (*gone[1:], "trace-ffffffff-other-0123.so"):
        os.utime(tmp_path / name, (long_ago, long_ago))
    library.library.__wrapped__()
    assert {path.name for path in tmp_path.iterdir()} == {*stay, library._file_name()}


def test_the_compiler_is_not_looked_for_in_the_current_folder(tmp_path, monkeypatch):
    (tmp_path / "c++").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "c++").chmod(0o755)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", os.pathsep.join(["", ".", "../" + tmp_path.name]))
    with pytest.raises(NoCompiler, match=r"no C\+\+ compiler found"):
        compiler()
    with pytest.raises(NoCompiler, match="expected an absolute path"):
        compiler("./c++")
    monkeypatch.setenv("PATH", str(tmp_path))
    assert compiler() == (str(tmp_path / "c++"),)
    monkeypatch.setenv("CXX", f"{tmp_path}/c++ -m64 '-DA=1 2'")
    assert compiler() == (str(tmp_path / "c++"), "-m64", "-DA=1 2")


def test_the_compiler_runs_in_a_private_folder(tmp_path, monkeypatch):
    """Programs that the compiler starts (`as`) and folders in CPATH are not those of the current folder."""
    monkeypatch.setenv("PATH", os.pathsep.join([".", os.environ["PATH"]]))
    done = library.run_compiler("/bin/sh", "-c", "pwd; echo $PATH", folder=tmp_path)
    place, path = done.stdout.splitlines()
    assert place == os.path.realpath(tmp_path)
    assert all(map(os.path.isabs, path.split(os.pathsep)))


def test_several_at_once_compile_once(tmp_path, monkeypatch):
    """Four that start together, as the workers of a test run do: one compiles, the others wait for its file."""
    compiled = []

    def build(folder: Path) -> Path:
        compiled.append(folder)
        time.sleep(0.1)  # long enough that the others have asked
        made = folder / "trace.so"
        made.touch(0o600)
        return made

    replaced = {"_file_name": lambda: "trace.so", "cache_folder": lambda: tmp_path / "cache", "_remove_old": str}
    for name, value in {**replaced, "_build": build, "_loaded": lambda path: path.name}.items():
        monkeypatch.setattr(library, name, value)
    with ThreadPoolExecutor(4) as pool:
        loaded = list(pool.map(lambda _: library.library.__wrapped__(), range(4)))
    assert loaded == ["trace.so"] * 4
    assert len(compiled) == 1

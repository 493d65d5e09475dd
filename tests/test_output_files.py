"""Output files: checked before the computation, never an input, replaced as a whole; unsaved results are printed."""

import os
import re
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from raytrace.files import check_output, check_output_folder, shipped, write_atomically, write_text

OPTIMIZE = "optimize lens.zmx --merit spot --vary curvature --cycles 1"


@pytest.fixture
def lens(tmp_path):
    path = tmp_path / "lens.zmx"
    path.write_bytes((shipped("lenses") / "singlet.zmx").read_bytes())
    return path


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (f"{OPTIMIZE} --log lens.zmx", "--log lens.zmx: is the file of LENS too"),
        (f"{OPTIMIZE} --checkpoint ./lens.zmx", "--checkpoint ./lens.zmx: is the file of LENS too"),
        (f"{OPTIMIZE} -o lens.zmx", "lens.zmx: is the file of LENS too"),
        (f"{OPTIMIZE} -o link.zmx", "link.zmx: is the file of LENS too"),
        (f"{OPTIMIZE} --log a.csv --checkpoint a.csv", "--checkpoint a.csv: is the file of --log too"),
        (f"{OPTIMIZE} --log k.csv --resume k.csv", "--log k.csv: is the file of --resume too"),
        (f"{OPTIMIZE} -o no/dir/x.zmx", "no/dir/x.zmx: cannot be written: the folder .*no/dir does not exist"),
        (f"{OPTIMIZE} -o folder", "expected a name that ends in .zmx"),
        (f"{OPTIMIZE} -o folder.zmx", "folder.zmx: is a folder"),
        (f"{OPTIMIZE} -o lens.zmx/x.zmx", "the folder .*lens.zmx is a file, not a folder"),
        (f"{OPTIMIZE} --plot no/x.png", "no/x.png: cannot be written"),
        (f"{OPTIMIZE} -o x.foo", "x.foo: expected a name that ends in .zmx"),
        ("focus lens.zmx -o x.foo", "x.foo: expected a name that ends in .zmx"),
        ("focus lens.zmx -o lens.zmx", "lens.zmx: is the file of LENS too"),
        ("focus lens.zmx --plot no/x.png", "no/x.png: cannot be written"),
        ("spot lens.zmx -o lens.zmx", "lens.zmx: is the file of LENS too"),
        ("spot lens.zmx -o x.zmx", "x.zmx: expected a name that ends in .csv"),
        ("psf lens.zmx -o no/x.npz", "no/x.npz: cannot be written"),
        ("psf lens.zmx -o x.npy", "x.npy: expected a name that ends in .npz"),
        ("layout lens.zmx --plot no/x.png", "no/x.png: cannot be written"),
        ("convert lens.zmx lens.zmx", "lens.zmx: is the file of SOURCE too"),
        ("convert lens.zmx no/x.csv", "no/x.csv: cannot be written"),
        ("trace lens.zmx --rays rays.csv -o rays.csv", "rays.csv: is the file of --rays too"),
        ("search lens.zmx --merit spot --vary curvature -o lens.zmx", "lens.zmx: is a file; give the name of a folder"),
        ("wave psf --element e.json --aperture 1 --plot no/x.png", "no/x.png: cannot be written"),
        ("bench trace -o no/x.csv", "no/x.csv: cannot be written"),
        ("codesign lens.zmx -o lens.zmx", "lens.zmx: is the file of LENS too"),
    ],
)
def test_outputs_are_refused_before_the_work(words, said, lens, command_line, tmp_path):
    (tmp_path / "link.zmx").symlink_to(lens)
    (tmp_path / "folder.zmx").mkdir()
    (tmp_path / "rays.csv").write_text("x,y\n0,0\n")
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()}
    done = command_line(*words.split())
    assert done.code == 1
    assert re.search(said, done.error), done.error
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.is_file()} == before


def test_folders_are_checked(tmp_path, monkeypatch):
    check_output_folder(tmp_path / "a" / "b")  # will be made
    check_output(tmp_path / "x.csv", (".csv",))
    monkeypatch.setattr(os, "access", lambda *arguments: False)
    for check in (check_output, check_output_folder):
        with pytest.raises(OSError, match="no permission to write in"):
            check(tmp_path / "x")


def test_a_result_that_cannot_be_saved_is_printed(lens, command_line, monkeypatch):
    """A disk that is full by then: text or JSON on standard output, the reason on the other, exit code 1."""

    def full(path, write):
        raise OSError(28, "cannot be written: No space left on device", str(path))

    monkeypatch.setattr("raytrace.io.write_atomically", full)
    monkeypatch.setattr("raytrace.plotting.style.write_atomically", full)
    for words in (f"{OPTIMIZE} -o x.zmx", "focus lens.zmx -o x.zmx", "spot lens.zmx --plot x.png"):
        text, document = command_line(*words.split()), command_line(*words.split(), "--json")
        assert (text.code, document.code) == (1, 1)
        assert "raytrace: error: x." in text.err
        assert "No space left on device" in text.err
        assert text.out.strip()
        assert document.document


def test_files_that_a_search_cannot_write_are_reported_and_its_minima_are_printed(lens, command_line, monkeypatch):
    def full(*arguments):
        raise OSError(28, "No space left on device", "minimum_01.zmx")

    monkeypatch.setattr("raytrace.optimization.search.write_lens", full)
    words = "search lens.zmx --merit spot --vary sensor --starts 1 --rings 2 -o minima --bounds sensor:80..120"
    done = command_line(*words.split())
    assert done.code == 1
    assert "raytrace: warning: minima: not all minima are written" in done.err
    assert "minimum" in done.out


# -- replaced as a whole ----------------------------------------------------------------------------------------------


def test_remains_of_a_killed_writer_are_removed_and_files_of_another_kept(tmp_path):
    path = tmp_path / "kept.json"
    (tmp_path / ".kept.json.0123456789ab.tmp").write_text("half")
    (tmp_path / ".kept.json.backup.tmp").write_text("not ours")
    (tmp_path / ".other.json.0123456789ab.tmp").write_text("of another file")

    def within(file):
        file.write(b"outer")
        write_text(path, "inner")  # at the same time

    write_atomically(path, within)
    assert path.read_text() == "outer"
    names = {one.name for one in tmp_path.iterdir()}
    assert names == {"kept.json", ".kept.json.backup.tmp", ".other.json.0123456789ab.tmp"}


@pytest.mark.parametrize("named", [False, True])
def test_a_process_killed_while_it_writes_leaves_the_file_as_it_was(named, tmp_path):
    """Without a name the temporary file is gone with its process; else the next write removes it."""
    path = tmp_path / "kept.json"
    write_text(path, "before")
    code = (
        "import os, sys, time\nfrom raytrace import files\n"
        + ("files._unnamed = lambda folder: None\n" if named else "")
        + "def slow(file):\n    file.write(b'half'); file.flush(); print('now', flush=True); time.sleep(60)\n"
        + "files.write_atomically(sys.argv[1], slow)"
    )
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    process = subprocess.Popen([sys.executable, "-c", code, path], stdout=subprocess.PIPE, env=env)
    assert process.stdout.readline() == b"now\n"
    write_text(path, "meanwhile")
    assert len(list(tmp_path.iterdir())) == 1 + named  # a living process is not disturbed
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stdout.close()
    assert path.read_text() == "meanwhile"
    write_text(path, "after")
    assert list(tmp_path.iterdir()) == [path]


def test_a_new_file_has_the_permissions_of_any_other(tmp_path):
    (tmp_path / "plain").write_text("")
    write_text(tmp_path / "whole", "")
    assert (tmp_path / "plain").stat().st_mode == (tmp_path / "whole").stat().st_mode


@pytest.mark.slow
def test_a_full_disk_costs_a_search_nothing_that_it_found(tmp_path):
    """ulimit -f: no file may be longer than 4 blocks; what a first search found is still there after a second one."""
    words = "search cooke_triplet --merit spot --vary curvature --starts 12 --rings 2 -o minima --seconds"
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    run = {"cwd": tmp_path, "env": env, "capture_output": True, "text": True, "timeout": 300}
    first = f"{sys.executable} -m raytrace {words} 15"
    subprocess.run(["bash", "-c", first], **run)
    path = tmp_path / "minima" / "search.jsonl"
    before = path.read_bytes()
    assert before.count(b"\n") > 1
    done = subprocess.run(["bash", "-c", f"ulimit -f 4; {first}"], **run)
    assert path.read_bytes().startswith(before)
    assert done.returncode == 1
    assert "from 12 starts" in done.stdout

"""Stores: records line by line, schemas, and clear errors for damaged journals, outcomes and labels."""

import json
import math
import os
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from problems_stores import STRANGE, put
from scripts import script

from raytrace import stores
from raytrace.files import append_text
from raytrace.imaging.codesign import Outcome
from raytrace.imaging.training import DamagedRun, OtherSettings, Run
from raytrace.materials.catalogs import find_glass
from raytrace.optimization.search_tasks import BadSearch, Journal, TaskResult
from raytrace.stores import (
    DamagedLine,
    Document,
    Kind,
    Lines,
    Records,
    Unfit,
    anything,
    either,
    exactly,
    fields_of,
    listed,
    mapped,
    number,
    parsed,
    record,
    text,
    whole,
)
from raytrace.wave_optics.element import Element, Rings
from raytrace.wave_optics.element_files import read_label, write_element
from raytrace.wave_optics.height_maps import HeightMapError

Store = script("experiments").Store


# -- schemas ----------------------------------------------------------------------------------------------------------

REFUSED = {
    "a finite number, found null": (number(), None),
    "true": (number(), True),
    "expected a finite number from 0": (number(0), -1.0),
    "expected a finite number from 0 to 1": (number(0, 1), 1.5),
    "found NaN": (number(infinite=True), math.nan),
    "found Infinity": (number(), math.inf),
    "a whole number above 1e20": (number(), 10**400),
    "expected a whole number from 1": (whole(1), 0),
    "found 1.0, expected a whole number": (whole(), 1.0),
    "found 1, expected a text": (text, 1),
    "a list of 1, expected 2 of them": (listed(number(), 2, 2), [1.0]),
    "a list of 3, expected 1 to 2 of them": (listed(number(), 1, 2), [1, 2, 3]),
    "entry 2: found": (listed(number()), [1.0, "a"]),
    "found a list of 0, expected names": (mapped(number()), []),
    "a: found null": (mapped(number()), {"a": None}),
    "'b' is missing": (record({"a": number(), "b": text}), {"a": 1}),
    "a: b: found": (record({"a": record({"b": text})}), {"a": {"b": 2}}),
    "c: found": (record({}, {"c": text}), {"c": 2}),
    "found a list of 1, expected names and values": (record({}, {"c": text}), ["c"]),
    'found "d", expected "a" or null': (exactly("a", None), "d"),
    "expected a text": (either(number(), text), []),
    "found 'colour', expected model": (fields_of(Outcome), {"colour": 1}),
    "'model' is missing": (fields_of(Outcome), {}),
}


@pytest.mark.parametrize("words", REFUSED)
def test_a_schema_reports_found_and_expected_values(words):
    check, value = REFUSED[words]
    with pytest.raises(Unfit) as error:
        check(value)
    assert all(part in str(error.value) for part in words.split(", found")), error.value
    assert len(str(error.value)) < 250


@pytest.mark.parametrize("name", STRANGE)
def test_a_schema_takes_or_refuses_whatever_json_holds(name):
    """No other error than Unfit leaves a check, at any depth."""
    checks = (number(), whole(), text, listed(number()), mapped(anything), record({"a": number()}), fields_of(Outcome))
    for check in checks:
        for content in (STRANGE[name], f'{{"a": {STRANGE[name]}}}', f"[{STRANGE[name]}]"):
            try:
                check(parsed(content.encode("utf-8", "surrogateescape")))
            except Unfit:
                continue


# -- lines ------------------------------------------------------------------------------------------------------------


def test_records_behind_a_damaged_line_are_kept_and_a_torn_one_is_cut_off(tmp_path):
    path = tmp_path / "lines"
    store = Lines(path, number())
    for value in (1.0, 2.0, 3.0):
        store.append(value)
    put(path, path.read_text().replace("2.0", "nan") + "4.")
    again = Lines(path, number())
    with pytest.warns(DamagedLine, match=r"lines, line 2: .*JSON.*ignored"):
        assert again.read(ValueError, "")[1] == [(1, 1.0), (3, 3.0)]
    again.append(5.0)
    again.append(6.0)
    assert path.read_text() == "1.0\nnan\n3.0\n5.0\n6.0\n"
    put(path, "1.0\n2.0")  # as an editor leaves it
    once = Lines(path, number())
    assert once.read(ValueError, "")[1] == [(1, 1.0), (2, 2.0)]
    once.append(3.0)
    assert path.read_text() == "1.0\n2.0\n3.0\n"


def test_many_damaged_lines_are_counted(tmp_path):
    put(tmp_path / "lines", "x\n" * 50 + "1\n")
    with pytest.warns(DamagedLine) as said:
        assert Lines(tmp_path / "lines", number()).read(ValueError, "")[1] == [(51, 1.0)]
    assert len(said) == 6
    assert "lines: 50 damaged lines in all" in str(said[-1].message)


def test_a_failed_append_leaves_the_file_unchanged(tmp_path, monkeypatch):
    """A disk that is full in the middle of a record."""
    path = tmp_path / "lines"
    append_text(path, "1\n")
    written = []

    class Full:
        """A file of which every second write fails."""

        def __init__(self, file):
            self.file = file

        def write(self, data):
            if written:
                raise OSError(28, "No space left on device")
            written.append(data)
            return self.file.write(data[:3])

        def __getattr__(self, name):
            return getattr(self.file, name)

        def __enter__(self):
            return self

        def __exit__(self, *error):
            self.file.close()

    monkeypatch.setattr("builtins.open", lambda *a, _open=open, **how: Full(_open(*a, **how)))
    with pytest.raises(OSError, match="cannot be written: No space left"):
        append_text(path, "23456\n")
    monkeypatch.undo()
    assert written
    assert path.read_text() == "1\n"


# -- the journal of a search ------------------------------------------------------------------------------------------

ABOUT = {"seed": 1, "variables": ["curvature_1", "sensor"]}
GOOD = {"task": "b", "lost": 0.0, "missed": 0.0, "merit": 0.25, "seconds": 0.5, "x": [1.0, 2.0]}


def journal(folder: Path, *between: str) -> Path:
    """A journal of three tasks with a line in the place of the second."""
    path = folder / "search.jsonl"
    lines = [json.dumps(GOOD | {"task": task}) for task in "abc"]
    put(path, "\n".join([json.dumps(ABOUT), lines[0], *between, lines[2]]) + "\n")
    return path


def damaged_tasks():
    for name, content in STRANGE.items():
        yield f"line {name}", content
        for field in GOOD:
            pairs = (f"{json.dumps(k)}: {content if k == field else json.dumps(v)}" for k, v in GOOD.items())
            value = f"{{{', '.join(pairs)}}}"
            if not (field == "task" and name in ("text", "lone half")):
                yield f"{field} {name}", value
    for field in GOOD:
        yield f"without {field}", json.dumps({key: value for key, value in GOOD.items() if key != field})
    yield "short x", json.dumps(GOOD | {"x": [1.0]})
    yield "long x", json.dumps(GOOD | {"x": [1.0, 2.0, 3.0]})
    yield "x of texts", json.dumps(GOOD | {"x": ["1", "2"]})
    yield "nan in x", json.dumps(GOOD | {"x": [1.0, math.nan]})
    yield "negative merit", json.dumps(GOOD | {"merit": -1.0})


def test_damaged_lines_of_a_journal_are_reported_and_their_tasks_done_again(tmp_path):
    for name, line in damaged_tasks():
        path, done = journal(tmp_path, line), []

        def task(key, done=done):
            return key, lambda: done.append(key) or TaskResult(0.0, 0.0, 0.25, 0.5, np.array([1.0, 2.0]))

        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            ends = Journal(tmp_path, ABOUT, math.inf).each([task(key) for key in "abc"], 2)
        assert [str(one.message) for one in said if "search.jsonl, line 3: " in str(one.message)], name
        assert done == ["b"], name
        assert all(np.array_equal(end.x, [1.0, 2.0]) for end in ends)
        assert path.read_bytes().startswith(json.dumps(ABOUT).encode()), name
        assert path.read_bytes().count(b"\n") == 5, name  # the damaged line is left where it is


@pytest.mark.parametrize("name", [name for name in STRANGE if name != "names"])
def test_a_damaged_first_line_of_a_journal_is_refused_and_nothing_is_lost(name, tmp_path):
    path = journal(tmp_path, json.dumps(GOOD))
    rest = path.read_bytes().partition(b"\n")[2]
    path.write_bytes(STRANGE[name].encode("utf-8", "surrogateescape") + b"\n" + rest)
    before = path.read_bytes()
    with pytest.raises(BadSearch, match=r"search.jsonl, line 1: .*name a new folder"):
        Journal(tmp_path, ABOUT, math.inf)
    assert path.read_bytes() == before


def test_a_journal_is_appended_to_and_never_rewritten(tmp_path):
    """Its inode and its lines stay; what a full disk refuses is warned of."""
    path = journal(tmp_path, json.dumps(GOOD))
    before, inode = path.read_bytes(), path.stat().st_ino
    again = Journal(tmp_path, ABOUT, math.inf)
    again.each([("d", lambda: TaskResult(0.0, 0.0, 0.25, 0.5, np.array([1.0, 2.0])))], 2)
    assert path.read_bytes().startswith(before)
    assert (len(again.known), path.stat().st_ino) == (4, inode)


# -- outcomes and logs of runs ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", STRANGE)
def test_damaged_settings_of_a_run_are_reported_with_their_file(name, tmp_path):
    put(tmp_path / "settings.json", STRANGE[name])
    with pytest.raises(ValueError, match=r"settings.json.*remove the folder|another run.*another folder") as error:
        Run(tmp_path, {"a": 1})
    assert name == "names" or isinstance(error.value, DamagedRun)


@pytest.mark.parametrize("row", ["1,nan", "1", "1,2,3", "one,2", "-1,2", "1.5,2"])
def test_a_damaged_row_of_a_log_is_named_and_the_others_stay(row, tmp_path):
    run = Run(tmp_path, {"a": 1})
    put(run.log, f"step,loss\n0,1\n{row}\n2,3\n")
    with pytest.raises(DamagedRun, match=f"log.csv, line 3: .*'{row}', expected 2 numbers"):
        run.rows()
    with pytest.warns(DamagedLine, match=r"log.csv, line 3: .*; the line is dropped"):
        run.drop_rows_from(9)
    assert run.rows() == [{"step": 0.0, "loss": 1.0}, {"step": 2.0, "loss": 3.0}]


# -- the store that all share -----------------------------------------------------------------------------------------

IDENTITY = {"rate": 0.1, "seed": 1}
KIND = Kind(DamagedRun, "begin anew", OtherSettings, "{path} holds others: {difference}")
_NUMBER = record({"value": number()})


def document(path: Path, of: dict) -> object:
    store = Document(path, of, KIND)
    if not path.exists():
        store.write({"value": 0.1})
    return store.read(_NUMBER)["value"]


def records(path: Path, of: dict) -> object:
    store = Records(path, of, KIND, _NUMBER)
    if not (found := store.read()):
        store.append({"value": 0.1})
        found = Records(path, of, KIND, _NUMBER).read()
    return found[0][1]["value"]


def folder(path: Path, of: dict) -> object:
    return Store(path, of).number("value", lambda: 0.1)


STORES = {"document": document, "records": records, "folder": folder}


@pytest.mark.parametrize("name", STORES)
def test_a_store_resumes_and_refuses_another_identity_and_damage(name, tmp_path):
    open_store, path = STORES[name], tmp_path / "kept"
    assert open_store(path, IDENTITY) == open_store(path, IDENTITY) == 0.1
    with pytest.raises(OtherSettings, match=r"kept holds .*: rate was 0.1, now 0.2"):
        open_store(path, IDENTITY | {"rate": 0.2})
    files = [path] if path.is_file() else [path / "settings.json", path / "value.json"]
    for file in files:
        content = file.read_bytes()
        put(file, "x")
        with pytest.raises(DamagedRun, match=f"{file.name}, line 1: is no JSON"):
            open_store(path, IDENTITY)
        file.write_bytes(content)


@pytest.mark.parametrize("name", STORES)
def test_a_store_does_not_wait_for_a_pipe(name, tmp_path):
    path = tmp_path / "kept"
    if name == "folder":
        STORES[name](path, IDENTITY)
        path = path / "value.json"
        path.unlink()
    os.mkfifo(path)
    with pytest.raises(OSError, match="is not a regular file"):
        STORES[name](tmp_path / "kept", IDENTITY)


@pytest.mark.parametrize("name", STORES)
def test_a_store_reads_no_file_above_its_bound(name, tmp_path, monkeypatch):
    STORES[name](tmp_path / "kept", IDENTITY)
    monkeypatch.setattr(stores, "_MOST", 8)
    with pytest.raises(OSError, match="is larger than"):
        STORES[name](tmp_path / "kept", IDENTITY)


def test_files_of_a_run_are_no_pipes(tmp_path):
    run = Run(tmp_path, {"a": 1})
    for path in (run.checkpoint, run.log):
        os.mkfifo(path)
    with pytest.raises(DamagedRun, match="is not a regular file"):
        run.load()
    for read in (run.rows, lambda: run.drop_rows_from(1)):
        with pytest.raises(OSError, match="is not a regular file"):
            read()


def test_arrays_of_a_store_round_trip_and_damaged_ones_are_refused(tmp_path):
    given = {"heights": np.arange(6.0).reshape(2, 3)}
    for compute in (lambda: given, None):
        found = Store(tmp_path, IDENTITY).arrays("a", compute)
        assert np.array_equal(found["heights"], given["heights"])
    put(tmp_path / "a.npz", "no archive")
    with pytest.raises(DamagedRun, match=r"a.npz: no .npz file .*remove it"):
        Store(tmp_path, IDENTITY).arrays("a", None)


# -- labels of elements -----------------------------------------------------------------------------------------------


def test_damaged_labels_are_refused_in_a_line(tmp_path):
    one = torch.tensor(0.1, dtype=torch.float64)
    element = Element(Rings(torch.zeros(8, dtype=torch.float64), one), 8 * one, find_glass("PMMA"))
    path, label = write_element(element, tmp_path / "rings.npy", design_wavelength=0.55)
    whole_label = json.loads(label.read_text())
    assert read_label(path).aperture == pytest.approx(1.6)
    fields = [key for key in whole_label if key != "wavelength_range"]
    texts = ("material", "catalog")
    cases = {
        f"{field} {name}": "{"
        + ", ".join(f"{json.dumps(k)}: {content if k == field else json.dumps(v)}" for k, v in whole_label.items())
        + "}"
        for field in fields
        for name, content in STRANGE.items()
        if not (field in texts and name in ("text", "lone half"))
    }
    for name, content in STRANGE.items():
        cases[f"all {name}"] = content
    for name, value in {
        "short": {"coefficients": whole_label["coefficients"][:-1]},
        "nested": {"coefficients": [[c] for c in whole_label["coefficients"]]},
        "nan": {"coefficients": [math.nan, *whole_label["coefficients"][1:]]},
        "range": {"wavelength_range": [1.0, 0.4]},
        "range of one": {"wavelength_range": [1.0]},
        "no pitch": {"pitch": 0},
        "formula": {"formula": "sellmeier"},
        "profile": {"profile": "spline", "coefficients_of_profile": [1]},
        "no profile": {"profile": "Noll's polynomials, mm RMS", "coefficients_of_profile": []},
    }.items():
        cases[name] = json.dumps(whole_label | value)
    for name, content in cases.items():
        put(label, content)
        with pytest.raises(HeightMapError, match=r"rings.npy.json(:\d+)?: .*height map.*remove") as error:
            read_label(path)
        assert "\n" not in str(error.value), name
        assert len(str(error.value)) < 500, name


def test_a_label_is_not_waited_for(tmp_path):
    os.mkfifo(tmp_path / "rings.npy.json")
    with pytest.raises(HeightMapError, match="is not a regular file"):
        read_label(tmp_path / "rings.npy")

"""Files: tables and texts are written as a whole, and read back."""

import csv
import dataclasses
import json

import pytest

from raytrace.files import table, write_json, write_table, write_text


@dataclasses.dataclass(frozen=True)
class Run:
    name: str
    seconds: float
    error: float | None


RUNS = [Run("a, b", 1 / 3, None), Run('"c"', 2e-300, 0.1)]


def test_a_table_brings_every_number_back(tmp_path):
    write_table(tmp_path / "runs.csv", RUNS)
    with (tmp_path / "runs.csv").open(newline="", encoding="utf-8") as file:
        found = list(csv.DictReader(file))
    assert [(row["name"], float(row["seconds"])) for row in found] == [(run.name, run.seconds) for run in RUNS]
    assert [row["error"] for row in found] == ["", "0.1"]


def test_mappings_and_values_make_the_same_table_with_columns_in_any_order():
    columns = ["error", "name"]
    assert table(RUNS, columns) == table(map(dataclasses.asdict, RUNS), columns) == 'error,name\n,"a, b"\n0.1,"""c"""\n'


def test_numbers_are_written_as_asked():
    assert table(RUNS[:1], floats="{:.3g}".format) == 'name,seconds,error\n"a, b",0.333,\n'
    assert table([{"x": 0.12345, "n": 3}], floats=lambda x: round(x, 3)) == "x,n\n0.123,3\n"


def test_a_table_without_rows_has_its_headings():
    assert table([], ["a", "b"]) == "a,b\n"


@pytest.mark.parametrize(
    "write", [lambda path: write_json(path, {"a": object()}), lambda path: write_table(path, [{"a": 1}], ["b"])]
)
def test_a_failed_write_leaves_the_file_unchanged(tmp_path, write):
    path = tmp_path / "kept"
    write_text(path, "größer")
    with pytest.raises((TypeError, KeyError)):
        write(path)
    assert path.read_bytes() == "größer".encode()
    assert list(tmp_path.iterdir()) == [path]


def test_a_document_round_trips(tmp_path):
    write_json(tmp_path / "found.json", {"radius": 0.1, "fields": [0, None]})
    assert json.loads((tmp_path / "found.json").read_text()) == {"radius": 0.1, "fields": [0, None]}

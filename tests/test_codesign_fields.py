"""Co-design over the field: errors by field against the whole, light in windows, table, page and command."""

import csv
import dataclasses
import re
from pathlib import Path

import pytest
import torch

from raytrace.pages import kept_of, markdown
from raytrace.studies.codesign import fields as module
from raytrace.studies.codesign import fields_page
from raytrace.studies.codesign.closed_form import camera_error, even_distances, power_spectrum
from raytrace.studies.codesign.experiment import camera
from raytrace.studies.codesign.fields import Row, camera_at, cases, energies, error_by_field
from raytrace.studies.codesign.fields_page import Fields
from raytrace.studies.codesign.optima import Optimum
from raytrace.studies.codesign.settings import MODELS, Settings
from raytrace.studies.codesign.setup import Experiment
from raytrace.studies.pictures import dead_leaves

SMALL = Settings(depth=2, width=2, patch=16, size=31, fields=(0.0, 9.8))


def test_all_fields_in_both_windows_and_the_axis_alone():
    found = [(one.settings.size, one.settings.fields) for one in cases(SMALL)]
    assert found == [(31, (0.0, 9.8))] * 4 + [(21, (0.0, 9.8))] * 4 + [(31, (0.0,))] * 4
    assert [one.settings.model for one in cases(SMALL)] == [*MODELS] * 3
    assert len(cases(dataclasses.replace(SMALL, size=21))) == 8


def test_errors_by_field_are_those_of_the_one_filter_of_all(lens):
    """Their mean is the error of the closed form, which has another formula; of one field it is that field's."""
    own = camera(lens, dataclasses.replace(SMALL, model="gaussian"))
    spectrum, distances = power_spectrum(dead_leaves(4, size=64), 46), even_distances(own, 4)
    found = error_by_field(own, spectrum, distances)
    assert float(found.mean()) == pytest.approx(float(camera_error(own, spectrum, distances).detach()), rel=1e-10)
    assert float(found[0]) != pytest.approx(float(found[1]), rel=1e-3)
    turned = camera(lens, dataclasses.replace(SMALL, model="gaussian", fields=(9.8, 0.0)))
    torch.testing.assert_close(error_by_field(turned, spectrum, distances), found.flip(0), rtol=1e-9, atol=0)


def test_light_in_windows_is_that_of_smaller_windows_and_some_more(lens):
    settings = dataclasses.replace(SMALL, model="gaussian", normalise="energy")
    rows = energies(camera_at(lens, 57.9, settings), (11, 21, 31))
    assert [(one["field"], one["pixels"]) for one in rows] == [(y, n) for y in (0.0, 9.8) for n in (11, 21, 31)]
    for place in ("energy_nearest", "energy_mean"):
        for field in (rows[:3], rows[3:]):
            light = [one[place] for one in field]
            assert 0 < light[0] < light[1] < light[2] < 1 + 1e-6
    smaller = energies(camera_at(lens, 57.9, dataclasses.replace(settings, size=21)), (21,))
    assert smaller[0]["energy_nearest"] == pytest.approx(rows[1]["energy_nearest"], rel=1e-2)


def test_a_few_rays_choose_a_lens_and_all_light_judges_it(lens, monkeypatch):
    monkeypatch.setattr(module, "closed_form", instantly)
    monkeypatch.setattr(module, "even_distances", lambda own, *given, **named: even_distances(own, 2))
    monkeypatch.setattr(fields_page, "energies", lambda own, sizes, spread: energies(own, sizes)[0]["energy_nearest"])
    spectrum = power_spectrum(dead_leaves(2, size=48), 24)
    found = []
    for rays in (None, 12):
        settings = dataclasses.replace(SMALL, size=9, rays=rays, tol=0.1, model="drt")
        row = Row("drt", 57.7, 33.0, 20.0, 0.01, 0.01, window=9, fields=settings.fields)
        given = Experiment(lens, "double_gauss", settings, (), (), {}, "pictures")
        found.append((module._found(lens, settings, spectrum)["by_field"], fields_page._energies(given, [row])))
    assert found[0] == found[1]


def instantly(lens, settings, spectrum):
    """An optimum that costs nothing."""
    return Optimum(settings.model, 57.7 + len(settings.model) / 1e3, 33.0, 20.0, 0.01, 0.012, downhill_mm=57.8)


@pytest.fixture
def quick(command, monkeypatch):
    """The command with optima that cost nothing, at two distances."""

    monkeypatch.setattr(module, "closed_form", instantly)
    monkeypatch.setattr(module, "even_distances", lambda own, *given, **named: even_distances(own, 2))
    words = "double_gauss --limit 2 --size 9 --patch 16 --tol 0.1 --docs docs -o out"
    return lambda *more: command("codesign", "fields", *words.split(), *more)


def test_the_command_writes_tables_and_page_and_goes_on(quick, monkeypatch):
    code, out, err = quick("--field", "0", "9.8")
    assert code == 0, err
    # The beam of 9.8 degrees misses the stop by 2.5 %: said of the result, at the end.
    assert err.splitlines()[-2] == "raytrace: written: docs/codesign_off_axis.md"
    assert "rays miss the stop" in err.splitlines()[-1]
    assert "9 pixels, 0, 9.8" in out
    written = {name: Path(f"docs/codesign/{name}.csv") for name in ("off_axis", "off_axis_energy", "off_axis_time")}
    first = {name: list(csv.DictReader(path.read_text().splitlines())) for name, path in written.items()}
    page = Path("docs/codesign_off_axis.md").read_text(encoding="utf-8")
    for row in first["off_axis"]:
        assert f"{float(row['sensor_mm']):.4f}" in page
        if row["window"] == "9" and row["fields"] == "0 9.8":
            assert f"| {float(row['error_drt_at_0']):.6f} | {float(row['error_drt_at_9.8']):.6f} |" in page
    for row in first["off_axis_energy"]:
        assert f"{float(row['energy_nearest']):.2f} ({float(row['energy_mean']):.2f})" in page
    assert {row["model"] for row in first["off_axis_time"]} == {*MODELS}
    before = written["off_axis"].read_text()
    monkeypatch.setattr(module, "closed_form", lambda *given: pytest.fail("sought again"))
    assert quick("--field", "0", "9.8")[0] == 0
    assert written["off_axis"].read_text() == before


def test_times_are_of_one_thread(quick, monkeypatch):
    """Of processor time, the sum over threads; behind it there are as many as before."""
    threads, timed = [2], []
    monkeypatch.setattr(torch, "get_num_threads", lambda: threads[-1])
    monkeypatch.setattr(torch, "set_num_threads", threads.append)
    monkeypatch.setattr(module, "_median_ms", lambda *given: timed.append(threads[-1]) or 1.0)
    monkeypatch.setattr(module, "error_by_field", lambda own, *given: torch.zeros(own.fields.shape[1]))
    monkeypatch.setattr(fields_page, "_energies", lambda *given: [])
    code, _, err = quick("--field", "0", "9.8")
    assert (code, threads, set(timed)) == (0, [2, 1, 2], {1}), err
    assert "one thread; " in (page := Path("docs/codesign_off_axis.md").read_text(encoding="utf-8"))
    assert "torch threads 1" in page


def test_a_field_is_needed(quick):
    code, out, err = quick()
    assert (code, out, len(err.splitlines())) == (1, "", 1)
    assert "no field beside the axis: give --field 0 9.8 14, and leave out --vary" in err


def test_the_published_page_is_what_its_tables_say(lens):
    """Above the mark to the letter, but for the machine that times were taken on."""
    docs, words = Path(__file__).parents[1] / "docs", {"fields", "model", "no_optimum"}
    tables = {}
    for name in ("off_axis", "off_axis_energy", "off_axis_time"):
        with open(docs / "codesign" / f"{name}.csv", newline="") as file:
            tables[name] = list(csv.DictReader(file))
    rows = [_row({k: v if k in words else float(v or "nan") for k, v in one.items()}) for one in tables["off_axis"]]
    settings = Settings(fields=(0.0, 9.8, 14.0), size=51)
    given = Experiment(lens, "double_gauss", settings, range(960), dead_leaves(2, size=8), {}, "pictures")
    page = (docs / "codesign_off_axis.md").read_text(encoding="utf-8")
    made = markdown(
        Fields(rows, tables["off_axis_energy"], tables["off_axis_time"], given, {"processor": "any"}).parts(),
        kept_of(page),
    )
    machine = re.compile(r"one thread; .*?\. \[")
    assert machine.sub("[", made) == machine.sub("[", page)
    assert [one.model for one in rows] == [*MODELS] * 3


def _row(one):
    known = {field.name for field in dataclasses.fields(Row)} - {"fields", "window"}
    return Row(
        **{name: value for name, value in one.items() if name in known},
        window=int(one["window"]),
        fields=(fields := tuple(map(float, one["fields"].split()))),
        by_field=tuple(one[f"error_drt_at_{y:g}"] for y in fields),
    )

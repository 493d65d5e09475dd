"""The script of optimisations: a page of a file and of derivatives."""

import dataclasses

import pytest
from scripts import script

from raytrace.io import read_lens
from raytrace.optimization.merit import DefaultMerit
from raytrace.system.optimization_data import OptimizationData, Vary

bench = script("bench_optimise")


def test_variables_are_moved_by_names_of_the_oracle():
    known = {
        "variables": ["thickness:3", "p:2/2"],
        "x_stored": [2.0, 0.0],
        "from_perturbed": {"x_start": [2.1, 1.0]},
    }
    assert bench.factors(known, ["a4_2", "thickness_3"]).tolist() == pytest.approx([1.0, 1.05])


def test_script_writes_page_table_and_figure(tmp_path, monkeypatch):
    lens = read_lens("singlet")
    data = OptimizationData(variables=(Vary(1, "curvature"),), merit=DefaultMerit("spot").rows(lens))
    monkeypatch.setattr(bench, "read_lens", lambda name: dataclasses.replace(lens, optimization_data=data))
    bench.main(["singlet.zmx", "--repeats", "1", "--docs", str(tmp_path)])
    page = (tmp_path / "optimise.md").read_text("utf-8")
    assert "| singlet.zmx | 1 |" in page
    assert "## Derivatives" in page
    assert (tmp_path / "optimise.png").exists()
    assert len((tmp_path / "optimise.csv").read_text().splitlines()) == 2

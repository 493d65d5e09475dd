"""The script of optimisations: a page of a file and of derivatives."""

import pytest
from scripts import script

from raytrace.files import shipped

bench = script("bench_optimise")


def test_variables_are_moved_by_names_of_the_oracle():
    known = {
        "variables": ["thickness:3", "p:2/2"],
        "x_stored": [2.0, 0.0],
        "from_perturbed": {"x_start": [2.1, 1.0]},
    }
    assert bench.factors(known, ["a4_2", "thickness_3"]).tolist() == pytest.approx([1.0, 1.05])


def test_script_writes_page_table_and_figure(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(bench, "MOST", 0.5)
    lens = shipped("lenses") / "double_gauss.zmx"
    bench.main([str(lens), "--repeats", "1", "--docs", str(tmp_path)])
    page = (tmp_path / "optimise.md").read_text("utf-8")
    assert "| double_gauss.zmx | " in page
    assert "## Derivatives" in page
    assert (tmp_path / "optimise.png").exists()
    assert len((tmp_path / "optimise.csv").read_text().splitlines()) == 2

"""A small network behind the filter: patches of what the filter leaves, learning that resumes, errors beside it."""

import json
import math

import pytest
import torch

from raytrace.cli import main
from raytrace.imaging.network import RedNet, RedNetShape
from raytrace.imaging.training import Run
from raytrace.studies.edof import network_report, report
from raytrace.studies.edof.network import Filtered, errors_behind, learn_network, patches
from raytrace.studies.edof.table import Content
from raytrace.studies.edof.world import World, periodic, spectrum, transfer
from raytrace.studies.edof.world import scene as scene_of
from raytrace.studies.pictures import dead_leaves
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import aim, baseline

SMALL = World(depths=(500.0, 1000.0, math.inf), wavelengths=(0.55,), size=63, pixel=0.00738)
PICTURES = periodic(dead_leaves(8, size=96, seed=5, smallest=2.5), 192)


def camera(name="singlet") -> Filtered:
    H = transfer(psf(scene_of(baseline(name, aim()), SMALL)), 192)
    return Filtered.of(H, spectrum(PICTURES[:5]), SMALL.noise)


def test_patches_are_what_the_filter_makes_of_pictures():
    given, true = patches(camera(), PICTURES[:3])
    assert given.shape == true.shape == (3 * 8, 1, 64, 64)
    assert given.dtype == torch.float32
    left = float((given - true).square().mean())
    assert 1e-4 < left < 0.1
    again, _ = patches(camera(), PICTURES[:3])
    assert torch.equal(given, again)


def test_a_run_that_is_broken_off_ends_as_one_that_was_not(tmp_path):
    """Six steps; finished, its data are not made again. Without a step the filter's picture stays as it is."""
    own = camera()

    def data():
        return patches(own, PICTURES[:2])

    def broken(steps):
        for number, step in enumerate(steps):
            yield step
            if number == 2:
                return

    whole = learn_network(tmp_path / "whole", data, {}, steps=6)
    learn_network(tmp_path / "broken", data, {}, steps=6, bar=broken)
    resumed = learn_network(tmp_path / "broken", data, {}, steps=6)
    finished = learn_network(tmp_path / "whole", lambda: pytest.fail("made anew"), {}, steps=6)
    for other in (resumed, finished):
        assert all(torch.equal(a, b) for a, b in zip(whole.parameters(), other.parameters(), strict=True))
    found = errors_behind(own, RedNet(RedNetShape(6, 16)), PICTURES[:2])
    assert found["filter"].shape == (2, 3, 1)
    torch.testing.assert_close(found["network"], found["filter"], rtol=1e-5, atol=0)


@pytest.mark.slow
def test_a_network_learns_what_the_filter_leaves(tmp_path):
    own = camera()
    network = learn_network(tmp_path, lambda: patches(own, PICTURES[:5]), {}, steps=60)
    found = errors_behind(own, network, PICTURES[:3])
    assert float(found["network"].mean()) < float(found["filter"].mean())
    assert float(found["network"][:, 1].mean()) < 0.98 * float(found["filter"][:, 1].mean())  # in focus


def test_a_network_is_that_of_its_pictures(capsys, monkeypatch, tmp_path):
    """Kept errors too: as many others, to learn from or to restore, are refused."""
    errors = {name: torch.ones(2, 3, 1, dtype=torch.float64) for name in ("filter", "network")}
    monkeypatch.setattr(network_report, "World", lambda: SMALL)
    monkeypatch.setattr(network_report, "learn_network", lambda folder, data, about, **how: Run(folder, about))
    monkeypatch.setattr(network_report, "errors_behind", lambda *given, **how: errors)

    def judged(train, test) -> int:
        content = Content("sharp leaves", PICTURES[train], PICTURES[test])
        monkeypatch.setattr(network_report, "contents_of", lambda arguments: ([content], None))
        return main(["wave", "network", "--rows", "fresnel", "-o", str(tmp_path)])

    assert judged([0, 1], [2, 3]) == judged([0, 1], [2, 3]) == 0
    for others in (([0, 4], [2, 3]), ([0, 1], [2, 4])):
        assert judged(*others) == 1
        assert "pictures was '4, blake2" in capsys.readouterr().err


def test_baselines_alone_are_rows(capsys):
    assert main(["wave", "network", "--rows", "learned", "-o", "nowhere"]) == 1
    assert "--rows learned: expected fresnel" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_learns_judges_and_goes_on(capsys, monkeypatch, tmp_path):
    monkeypatch.setattr(report, "_LEAVES", 6)
    monkeypatch.setattr(network_report, "_RESTORED", 2)
    words = ["wave", "network", "--rows", "fresnel", "singlet", "--steps", "2", "-o", str(tmp_path / "run")]
    words += ["--docs", str(tmp_path / "docs"), "--json"]
    assert main(words) == 0
    first = json.loads(capsys.readouterr().out)
    rows = {row["row"]: row for row in first["rows"]}
    assert rows["fresnel"]["over_filter"] == 0
    assert rows["singlet"]["over_filter"] > 1
    assert "| PMMA singlet |" in (tmp_path / "docs/wave_network.md").read_text()
    assert main(words) == 0
    assert json.loads(capsys.readouterr().out) == first

"""Pages of the wave-optics camera: the command at the head repeats it, and it says what it was made from."""

import argparse
import dataclasses

import numpy as np
import pytest
import torch
from PIL import Image

from raytrace.cli import main
from raytrace.cli.studies import command
from raytrace.studies.edof import free_report, network_report, noise_report, report
from raytrace.studies.edof.free_command import Settings as Free
from raytrace.studies.edof.network_command import Settings as Network
from raytrace.studies.edof.noise import Gains, Interval
from raytrace.studies.edof.noise_command import Settings as Noise
from raytrace.studies.edof.noise_report import OverNoise, Score
from raytrace.studies.edof.settings import NANOMETRE
from raytrace.studies.edof.table import Content
from raytrace.studies.edof.world import FILTERS, World
from raytrace.studies.publish import published
from raytrace.studies.quantise import report as quantise_report
from raytrace.studies.quantise.command import Settings as Quantise
from raytrace.studies.quantise.experiment import Steps, Tolerance
from raytrace.studies.quantise.process_command import Settings as Etch
from raytrace.studies.superres import report as superres_report
from raytrace.studies.superres.command import Settings as Superres
from raytrace.studies.superres.discover_command import Settings as Discover
from raytrace.studies.superres.experiment import Row
from raytrace.studies.superres.report import Block, Scene
from raytrace.wave_optics.designs import aim, baseline

#: Settings of every command with all of them changed, as its parser would give them.
CHANGED = {
    "noise": Noise(seed=1, noise=(0.003, 0.0123456789), starts=2, steps=7),
    "network": Network(seed=1, noise=0.02, steps=7),
    "free": Free(seed=1, starts=("rings", "random"), feature=0.004, noise=0.02, steps=7, rate=0.1),
    "etch": Etch(1, (1,), (4,), 40 * NANOMETRE, (0.02, 0.03), 2, 7, 8, 9),
    "superres": Superres(1, (2, 3), ([0.55], [0.46, 0.64]), 0.003, (4,), 7, 0),
    "discover": Discover(1, ([0.5, 0.6],), 0.003, (0.2,), 1, 7),
    "quantise": Quantise(1, ("fresnel",), "PMMA", 4.0, 0.004, (-0.001, 0.002), (4, 16), (5.0,), False, 0, 7, 8),
}


def taken(name: str, words: str) -> argparse.Namespace:
    """What the parser of a command makes of its own words."""
    parser = argparse.ArgumentParser()
    command(name).add_arguments(parser)
    return parser.parse_args(words.split())


def head(page) -> tuple[str, argparse.Namespace]:
    """The command at the head of a page, and what its parser takes from it."""
    line = page.read_text().split("\n\n")[1].strip()
    _, _, name, words = line.split(" ", 3)
    return line, taken(name, words.removesuffix(" --docs docs"))


@pytest.mark.parametrize("name", CHANGED)
def test_settings_are_repeated_by_their_words(name):
    """To the last digit, lists, units, flags and repeated options alike; defaults need no words."""
    settings = CHANGED[name]
    assert all(getattr(settings, field.name) != field.default for field in dataclasses.fields(settings))
    needed = {"etch": " -o F", "free": " --from F -o F", "network": " -o F"}.get(name, "")
    assert type(settings).of(vars(taken(name, " ".join(settings.words()) + needed))) == settings
    assert type(settings)().words() == []


def test_models_of_etching_are_elements_over_noise():
    """The same folder serves both commands by their defaults."""
    assert Etch().learn == Noise().steps


@pytest.mark.parametrize("names", [("noise", "etch"), ("network",), ("free",), ("discover",)], ids=" ".join)
def test_examples_that_share_a_folder_are_of_one_run(names):
    """Pictures and steps: nothing that one keeps is refused by the next."""
    kept: dict[str, set] = {}
    for name in names:
        for line in command(name).examples.splitlines()[1:]:
            own = taken(name, line.split(" ", 5)[-1])
            steps = own.learn or Etch().learn if name == "etch" else own.steps or CHANGED[name].__class__().steps
            if own.folder:
                kept.setdefault(own.folder, set()).add((own.data, own.limit, steps))
    assert all(len(runs) == 1 for runs in kept.values())


def test_files_are_named_as_the_reader_has_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    docs = tmp_path / "pages"
    assert published(docs / "wave/elements/own.npy", docs) == "docs/wave/elements/own.npy"
    assert published("pages/own.npy", "pages") == "docs/own.npy"
    assert published("own/rings.npy", docs) == "own/rings.npy"
    assert published(tmp_path / "own/rings.npy", docs) == "rings.npy"


def over_noise(*rows: str) -> OverNoise:
    own = Interval(1.0, 0.9, 1.1)
    gains = Gains(20.0, own, 20.5, own)
    scores = [Score("sharp leaves", filter, 0.02, row, gains) for filter in FILTERS for row in rows]
    return OverNoise(scores, {"sharp leaves": 8})


def test_the_page_over_noise_names_its_files(tmp_path, monkeypatch):
    """Those it was given at its head, those it kept at its end; without any there is nothing to judge again."""
    settings = Noise(noise=(0.02,), seed=3)
    given = [str(tmp_path / "wave/elements/own-0.02.npy")]
    own = argparse.Namespace(rows=["fresnel"], elements=given, data=None, limit=80, docs=str(tmp_path))
    kept = {
        "learned-0.02.npy": baseline("fresnel", aim())[0],
        "learned-smooth-0.02.json": baseline("singlet", aim())[0],
    }
    noise_report._publish(over_noise("fresnel", "own-0.02"), kept, settings, own)
    line, read = head(tmp_path / "wave_noise.md")
    assert read.elements == ["docs/wave/elements/own-0.02.npy"]
    assert (Noise.of(vars(read)), read.rows, read.data) == (settings, ["fresnel"], None)
    text = (tmp_path / "wave_noise.md").read_text()
    names = " ".join(f"docs/wave/elements/{name}" for name in kept)
    assert f"raytrace wave noise --rows fresnel --elements {names} --noises 0.02\n" in text
    noise_report._publish(over_noise("fresnel", "own-0.02"), {}, settings, own)
    assert "to be judged again" not in (tmp_path / "wave_noise.md").read_text()
    assert line in (tmp_path / "wave_noise.md").read_text()


def test_the_page_of_networks_counts_its_pictures(monkeypatch, tmp_path):
    errors = {name: torch.ones(2, 3, 1, dtype=torch.float64) for name in ("filter", "network")}
    leaves = Content("sharp leaves", torch.ones(3, 8, 8, dtype=torch.float64), torch.ones(2, 8, 8, dtype=torch.float64))
    monkeypatch.setattr(network_report, "contents_of", lambda arguments: ([leaves], None))
    monkeypatch.setattr(network_report, "_judged", lambda *given: errors)
    words = ["--rows", "singlet", "--limit", "9", "--steps", "7", "--seed", "2", "-o", str(tmp_path / "run")]
    assert main(["wave", "network", *words, "--docs", str(tmp_path)]) == 0
    assert "patches of 3 pictures of sharp leaves at depths" in (tmp_path / "wave_network.md").read_text()
    _, read = head(tmp_path / "wave_network.md")
    assert (Network.of(vars(read)), read.rows, read.limit) == (Network(steps=7, seed=2), ["singlet"], 9)


def test_the_table_is_repeated_and_counts_its_pictures():
    words = "--rows fresnel singlet --also learned-zernike --data DIR --limit 9 --steps 7 --starts 1 --seed 2"
    line = report._command(taken("table", words))
    again = vars(taken("table", line.removeprefix("raytrace wave table").removesuffix("--docs docs")))
    assert again == vars(taken("table", words)) | {"folder": "FOLDER"}
    assert report._command(taken("table", "")) == "raytrace wave table -o FOLDER --docs docs"
    given = [
        Content(name, torch.ones(4, 2, 2), torch.ones(count, 2, 2)) for name, count in (("leaves", 1), ("pictures", 3))
    ]
    text = "\n".join(report._parts(report.Table({}), given, World(), line, [], {"lens": baseline("singlet", aim())[0]}))
    assert (
        "Judged on 1 pictures of leaves, 3 pictures, expected over noise, none drawn; filters are made for 4, 4" in text
    )
    assert "Heights, largest less smallest inside the aperture: lens " in text


def test_free_heights_say_how_they_began(tmp_path):
    """Starts and size of a map are those of the run."""
    settings = Free(starts=("random",), feature=0.01)
    found = free_report.Freed([], {}, {"sharp leaves": 8}, settings)
    text = "\n".join(free_report._parts(found, "command"))
    assert "Maps of 500 × 500 pixels of 10 µm" in text
    assert (
        "steps of Adam from random polynomials (Noll's up to 36, 0.5 µm RMS each) on a lens for 1 m; each with" in text
    )
    assert "random change of 20 nm RMS" in text
    assert "A learned map takes 1 MB" in text
    whole = "\n".join(free_report._parts(dataclasses.replace(found, settings=Free()), "command"))
    assert "A learned map takes 25 MB" in whole
    assert "from the learned rings, from the cubic plate of best strength on a lens for 1 m, from random" in whole


@pytest.mark.parametrize("data", [False, True])
def test_the_page_of_super_resolution(data, monkeypatch, tmp_path):
    """Pictures counted, starts told; the figure only where it is drawn: pictures of others are not for pages."""
    folder = tmp_path / "pictures"
    folder.mkdir()
    for number in range(5):
        Image.fromarray(np.full((96, 96), number, np.uint8)).save(folder / f"{number}.png")
    estimate = torch.rand(1, 1, 96, 96, dtype=torch.float64)
    rows = [Row(name, 20.0, 20.0, (20.0,), estimate) for name in ("bicubic", "MMSE", "learned")]
    kernel, drawn = estimate[0] + 0.1, {}
    drawn |= dict.fromkeys(("plain lens", "learned", "plate", "sensor"), kernel) | {"row": rows[0]}
    drawn |= dict.fromkeys(("picture", "scene"), kernel[0])
    block = Block(2, (0.55,), Scene(rows, 21.0), Scene(rows, 21.0), drawn)
    monkeypatch.setattr(superres_report, "_block", lambda *given: block)
    monkeypatch.setattr(superres_report, "_over_noise", lambda *given: [{"noise": 0.01, "bicubic": 20.0}])
    words = ["--starts", "2", "--seed", "3", "--limit", "5", *(["--data", str(folder)] if data else [])]
    assert main(["wave", "superres", *words, "--docs", str(tmp_path)]) == 0
    text = (tmp_path / "wave_superres.md").read_text()
    _, read = head(tmp_path / "wave_superres.md")
    assert (Superres.of(vars(read)), read.limit) == (Superres(starts=2, seed=3), 5)
    assert read.data == ("DIR" if data else None)
    assert f"made for 4 {'pictures' if data else 'pictures of dead leaves'} and restore 1 others" in text
    assert "from 2 random starts around it" in text
    assert ("superres.png" in text) == (tmp_path / "wave/superres.png").exists() == (not data)


def test_the_page_of_fabrication(monkeypatch, tmp_path):
    """Every setting at its head, its pictures counted."""

    def steps_of(name, element, judge, test, *, levels, ways, **how):
        rows = [Steps(name, way, n, 20.0, 20.0, 0.9) for way in ways for n in (0, *levels)]
        return rows, {(way, n): element for way in ways for n in (0, *levels)}

    monkeypatch.setattr(quantise_report, "steps_of", steps_of)
    monkeypatch.setattr(
        quantise_report, "tolerances_of", lambda name, way, *given, **how: [Tolerance(name, way, 4, 5.0, 0.0, 0.0, 0.0)]
    )
    monkeypatch.setattr(quantise_report, "_etched", lambda levels: [quantise_report.Etched(4, 0.8, 0.8, 0.7)])
    settings = Quantise(element=("fresnel",), levels=(4,), tolerance=(5.0,), wrap=True, learn=7, starts=1, seed=2)
    words = " ".join(settings.words()).split()
    assert main(["wave", "quantise", *words, "--limit", "5", "--docs", str(tmp_path)]) == 0
    _, read = head(tmp_path / "wave_quantise.md")
    assert (Quantise.of(vars(read)), read.limit) == (settings, 5)
    text = (tmp_path / "wave_quantise.md").read_text()
    assert "made for 4 pictures of dead leaves, of each the middle 128 × 128 pixels and their mirror images" in text
    assert "The same of 1 others, restored by it" in text

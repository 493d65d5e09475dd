"""Pages of the wave-optics camera: the command on top reproduces the page, and the text names its data."""

import argparse
import shlex

import pytest
import torch
from scripts import script

from raytrace.cli import build_parser
from raytrace.cli.settings import words as words_of
from raytrace.cli.wave_design import NANOMETRE, ROWS
from raytrace.imaging.wave_camera import FILTERS, WaveCameraConfig
from raytrace.settings import DesignSettings
from raytrace.wave_optics.designs import aim, baseline

edof, noise = script("wave_edof"), script("wave_noise")
Content, Gains, Interval, OverNoise, Score = edof.Content, noise.Gains, noise.Interval, noise.OverNoise, noise.Score
Noise, published = noise.Settings, script("experiments").published


def taken(name: str, words: str) -> argparse.Namespace:
    """Arguments of a script from a command line."""
    parser = argparse.ArgumentParser()
    script(name).options(parser)
    return parser.parse_args(words.split())


def head(page) -> tuple[str, argparse.Namespace]:
    """The command on top of a page, and its arguments."""
    line = next(part.strip() for part in page.read_text().split("\n\n") if part.startswith("    python "))
    _, name, words = line.split(" ", 2)
    return line, taken(name.removeprefix("docs/experiments/").removesuffix(".py"), words.removesuffix(" --docs docs"))


def test_settings_are_repeated_by_their_words():
    """To the last digit, lists and units alike; defaults need no words."""
    settings = Noise(seed=1, noise=(0.003, 0.0123456789), starts=2, steps=7)
    words = " ".join(words_of(settings, noise.ROWS_OF_SETTINGS))
    assert Noise.of(vars(taken("wave_noise", words))) == settings
    assert words_of(Noise(), noise.ROWS_OF_SETTINGS) == []
    design = DesignSettings(seed=1, kind="smooth", levels=4, tolerance=40 * NANOMETRE, rate=0.1, steps=7, starts=2)
    given = build_parser().parse_args(shlex.split("wave design -o F " + " ".join(words_of(design, ROWS))))
    assert (given.kind, given.levels, given.steps) == ("smooth", 4, 7)
    assert given.tolerance == pytest.approx(design.tolerance)


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
    noise._publish(over_noise("fresnel", "own-0.02"), kept, settings, own)
    line, read = head(tmp_path / "wave_noise.md")
    assert read.elements == ["docs/wave/elements/own-0.02.npy"]
    assert (Noise.of(vars(read)), read.rows, read.data) == (settings, ["fresnel"], None)
    text = (tmp_path / "wave_noise.md").read_text()
    names = " ".join(f"docs/wave/elements/{name}" for name in kept)
    assert f"python docs/experiments/wave_noise.py --rows fresnel --elements {names} --noises 0.02\n" in text
    noise._publish(over_noise("fresnel", "own-0.02"), {}, settings, own)
    assert "The kept elements" not in (tmp_path / "wave_noise.md").read_text()
    assert line in (tmp_path / "wave_noise.md").read_text()


def test_the_table_is_repeated_and_counts_its_pictures():
    words = "--rows fresnel singlet --also learned-zernike --data DIR --limit 9 --steps 7 --starts 1 --seed 2"
    line = edof._command(taken("wave_edof", words))
    words_again = line.removeprefix("python docs/experiments/wave_edof.py").removesuffix("--docs docs")
    again = vars(taken("wave_edof", words_again))
    assert again == vars(taken("wave_edof", words)) | {"folder": "FOLDER"}
    assert edof._command(taken("wave_edof", "")) == "python docs/experiments/wave_edof.py -o FOLDER --docs docs"
    given = [
        Content(name, torch.ones(4, 2, 2), torch.ones(count, 2, 2)) for name, count in (("leaves", 1), ("pictures", 3))
    ]
    text = "\n".join(
        edof._parts(edof.Table({}), given, WaveCameraConfig(), line, [], {"lens": baseline("singlet", aim())[0]})
    )
    assert "Tested on 1 pictures of leaves, 3 pictures, in closed form over noise; filters are made for 4, 4" in text
    assert "Heights, largest less smallest inside the aperture: lens " in text

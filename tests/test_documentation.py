"""Documentation: quoted commands parse, and columns and labels use the terms of the field."""

import argparse
import re
import shlex
from pathlib import Path

import pytest
from scripts import script

from raytrace.cli import build_parser
from raytrace.cli.commands import COMMANDS

ROOT = Path(__file__).parents[1]


def commands(page: str) -> list[str]:
    """The indented or fenced lines of a page that call raytrace, variables of the environment before them or not."""
    text = page.replace("\\\n", " ")
    return re.findall(r"^(?: {4})?(?:[A-Z_]+=\S+ )*(raytrace [a-z].*)$", text, re.MULTILINE)


#: Pages of the repository; those in `generated` are made by docs/generate.py.
DOCS = sorted(path for path in ROOT.glob("docs/**/*.md") if not {"generated", "_build"} & {*path.parts})
PAGES = [
    path
    for path in (*DOCS, ROOT / "README.md")
    if path.parent.name in ("docs", "reference", "gallery", ROOT.name) and commands(path.read_text("utf-8"))
]


@pytest.mark.parametrize("page", DOCS, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_in_sentences_exist(page):
    known = {c.name for c in COMMANDS} | {"wave psf", "wave design", "wave restore"}
    text = re.sub(r"^Frozen: .*$", "", page.read_text("utf-8"), flags=re.MULTILINE)
    for words in re.findall(r"`raytrace ([a-z][^`]*)`", text):
        first, *more = words.split()
        name = f"{first} {more[0]}" if first == "wave" and more else first
        assert name in known, f"`raytrace {words}`"


@pytest.mark.parametrize("page", DOCS, ids=lambda path: str(path.relative_to(ROOT)))
def test_quoted_scripts_understand_their_options(page):
    for name, words in re.findall(r"python docs/experiments/(\w+)\.py([^`\n]*)", page.read_text("utf-8")):
        if name.endswith("_optiland"):
            pytest.importorskip("optiland", reason="needs the extra [bench]")
        parser = argparse.ArgumentParser()
        script(name).options(parser)
        parser.parse_args(shlex.split(words))


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_quoted_commands_are_understood(page):
    for line in commands(page.read_text("utf-8")):
        words = shlex.split(line, comments=True)
        assert build_parser().parse_args(words[1:]).command == words[1], line


@pytest.mark.slow
def test_the_error_axis_of_learning_has_numbers():
    focusing = script("focusing")
    figure = focusing.learn_to_focus(focusing.Setting(samples=16), steps=2, frames=(0, 2)).plot()
    figure.canvas.draw()
    (error,) = [axes for axes in figure.axes if axes.get_ylabel() == "mean square error"]
    low, high = error.get_ylim()
    said = [tick.label2.get_text() for tick in error.yaxis.get_major_ticks() if low <= tick.get_loc() <= high]
    assert len([words for words in said if words]) >= 2


def test_the_caption_of_a_single_kernel_stays_on_its_page():
    from page import outside

    import raytrace

    found = raytrace.wave_optics.wave_psf(
        "singlet", depths=[500], wavelengths=[0.46], size=8, engine="pupil", samples=600
    )
    assert not outside(found.plot())

"""Names, notes and comments of a lens round-trip through tables; others are refused in .zmx files or reported."""

import dataclasses
import warnings
from pathlib import Path

import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st
from problems import for_examples

from raytrace.io import LensFileError, LensFileWarning, read_lens, source, write_lens
from raytrace.io.frames import lens_from_frame, to_frame

LENSES = Path(__file__).parents[1] / "lenses"
TABLES = (".csv", ".tsv", ".txt")

#: What has been lost on the way: marks of comments, quotes, separators, blanks, control characters, lone surrogates.
NASTY = st.text(
    st.sampled_from("aé表😀 \t\n\r\"'\\#,;:|=\0\x1f\x7f\x85\u2028\u3000\u00a0\ufffd\ufeff\ud800"), max_size=12
)


LENS = read_lens(LENSES / "double_gauss.zmx")


def with_texts(name: str, note: str, comment: str):
    return dataclasses.replace(LENS.replace(3, comment=comment), name=name, notes=(note, "between", note))


def texts_of(lens) -> tuple:
    return lens.name, lens.notes, tuple(surface.comment for surface in lens.surfaces)


@settings(max_examples=30)
@given(name=NASTY, note=NASTY, comment=NASTY)
@example("# a", "#", "# 1")
@example("title: x", "note: aperture: EPD 3", "stop")
@example('"quoted"', '"quoted"', '"quoted"')
@example("", "", "")
@example("a,,", "a,,", "a,,")
@example(" both ", "\ttab\t", "two\nlines")
@example("image", "No,R,d,nd", "nan")
@pytest.mark.parametrize("suffix", [".csv", ".txt", pytest.param(".tsv", marks=pytest.mark.slow)])
def test_any_text_round_trips_through_a_table(suffix, tmp_path_factory, name, note, comment):
    lens = with_texts(name, note, comment)
    path = tmp_path_factory.mktemp("texts") / f"lens{suffix}"
    with warnings.catch_warnings(action="error"):
        write_lens(lens, path)
        assert texts_of(read_lens(path)) == texts_of(lens)


@settings(max_examples=30)
@given(name=NASTY, note=NASTY, comment=NASTY)
@example(" a", "b ", "\tc")
@example("Notes...", "Notes...", "x" * 500)
def test_a_text_round_trips_through_a_zmx_file_or_is_refused_or_reported(tmp_path_factory, name, note, comment):
    lens = with_texts(name, note, comment)
    path = tmp_path_factory.mktemp("texts") / "lens.zmx"
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        try:
            write_lens(lens, path)
        except LensFileError:
            assert not path.exists()
            return
    same = texts_of(read_lens(path)) == texts_of(lens)
    assert same != any(warning.category is LensFileWarning for warning in caught)


def test_a_warning_names_the_text_that_a_zmx_file_loses(tmp_path):
    with pytest.warns(LensFileWarning, match=r"surface 3 \(' x '\): not preserved"):
        write_lens(with_texts("a", "b", " x "), tmp_path / "lens.zmx")


@settings(max_examples=30)
@given(name=NASTY, note=NASTY, comment=NASTY)
def test_any_text_round_trips_through_pandas(name, note, comment):
    lens = with_texts(name, note, comment)
    assert texts_of(lens_from_frame(to_frame(lens))) == texts_of(lens)


@pytest.mark.parametrize("examples", [100, pytest.param(500, marks=pytest.mark.slow)])
def test_words_round_trip(examples):
    def round_trip(listed):
        assert source.words(" ".join(map(source.word, listed))) == listed

    for_examples(examples, round_trip, listed=st.lists(NASTY.filter(bool), min_size=1))


def test_plain_texts_stay_plain():
    for text in ("Größe 2: λ", "a, b", "# 1", "it's", 'the "front" lens', "表面\u30001", "a  b"):
        assert source.quoted(text) == text


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wavelengths": torch.tensor([-0.55], dtype=torch.float64)}, "-0.55"),
        ({"wavelength_weights": torch.tensor([-1.0], dtype=torch.float64)}, "weight"),
        ({"stop": 0}, "(?i)stop"),
    ],
)
@pytest.mark.parametrize("suffix", [".csv", ".zmx"])
def test_texts_that_could_not_be_read_are_not_written(changes, message, suffix, tmp_path):
    lens = dataclasses.replace(read_lens(LENSES / "double_gauss.zmx"), **changes)
    path = tmp_path / f"lens{suffix}"
    with pytest.raises(LensFileError, match=message):
        write_lens(lens, path)
    assert not path.exists()

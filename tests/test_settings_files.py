"""Settings of trainings from files and single words: what overrides what, and what is refused."""

import json

import pytest

from raytrace.cli import build_parser
from raytrace.cli.codesign_run import settings_of
from raytrace.cli.settings import BadSettings
from raytrace.settings import CodesignSettings


def settings(*words) -> CodesignSettings:
    return settings_of(build_parser().parse_args(["codesign", "double_gauss", *map(str, words)]))


def test_a_file_gives_settings_that_options_override(tmp_path):
    file = tmp_path / "run.toml"
    file.write_text(
        'vary = "sensor curvature:1"\nepochs = 3\n[scene]\nfields = [0, 10]\nf_number = 4\n'
        "[as-built]\nas_built = true\n"
    )
    given = settings("--settings", file)
    assert (given.vary, given.epochs, given.fields) == ("sensor curvature:1", 3, (0.0, 10.0))
    assert (given.f_number, given.as_built, given.batch) == (4.0, True, CodesignSettings.batch)
    other = settings("--settings", file, "--epochs", 5, "--set", "epochs=4", "decay=cosine", "wavelengths=[0.5, 0.6]")
    assert (other.epochs, other.decay, other.wavelengths, other.fields) == (5, "cosine", (0.5, 0.6), (0.0, 10.0))


def test_a_finished_run_gives_its_settings(tmp_path):
    """`settings.json` has more entries, of the lens and the pictures, that are no settings."""
    before = settings("--vary", "sensor", "thickness:5", "--set", "rays=12", "edge=0.5", "sensor=[24, 16]")
    file = tmp_path / "settings.json"
    file.write_text(json.dumps(vars(before) | {"lens": "double_gauss", "pictures": "abc", "part": "joint"}))
    assert settings("--settings", file) == before


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("epoch = 3", "'epoch' is no setting; did you mean epochs"),
        ('epochs = "three"', "epochs = 'three': expected int"),
        ("epochs = true", "epochs = True: expected int"),
        ('step = "waves"', "step = 'waves': expected 'sag' or 'blur'"),
        ("epochs = 3 4", "no TOML"),
    ],
)
def test_what_is_no_setting_is_refused(tmp_path, content, words):
    file = tmp_path / "run.toml"
    file.write_text(content)
    with pytest.raises(BadSettings, match=words):
        settings("--settings", file)


def test_single_words_need_a_name_and_files_have_to_exist(tmp_path):
    with pytest.raises(BadSettings, match="--set epochs: expected NAME=VALUE"):
        settings("--set", "epochs")
    with pytest.raises(BadSettings, match=r"nothing\.toml: cannot be read"):
        settings("--settings", tmp_path / "nothing.toml")

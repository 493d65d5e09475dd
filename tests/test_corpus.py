"""Real lens files against an oracle: each is loaded and right, or refused by name; none is wrong.

Oracle: ../shared/corpus/oracle.json, entries marked `oracle: true` (two independent programs, or numbers OpticStudio
stored in the file, agree). `python tests/test_corpus_types.py docs` writes docs/corpus.md and docs/corpus.csv.
"""

import pytest
from corpus_comparison import CORPUS, OTHER_EDITIONS, REFUSED, WRONG, compare, oracle

from raytrace.io.zemax.surfaces import types

FILES = sorted(oracle()) if (CORPUS / "oracle.json").exists() else []


@pytest.mark.needs(CORPUS)
@pytest.mark.parametrize("name", FILES)
def test_file_is_right_or_refused_by_name(name):
    result = compare(name)
    assert result.outcome != WRONG, result.details


@pytest.mark.needs(CORPUS)
def test_unsupported_files_are_the_refused_ones():
    """A file is refused for what the oracle knows the project not to model, or for a glass that is not shipped."""
    modelled = set(types())
    for name in FILES:
        result = compare(name)
        beyond = set(oracle()[name]["types"]) - modelled
        assert (result.outcome == REFUSED and "UnsupportedSurface" in result.details) == bool(beyond), name


@pytest.mark.needs(CORPUS)
def test_other_editions_are_still_other_and_their_differences_as_listed():
    found = {}
    for name in FILES:
        for key, difference in compare(name).editions.items():
            found[key] = max(difference, found.get(key, 0.0))
    assert found.keys() == OTHER_EDITIONS.keys()
    for key, difference in found.items():
        assert difference == pytest.approx(OTHER_EDITIONS[key], rel=0.1), key  # the table gives two digits

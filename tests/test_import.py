"""What lens files leave to be found: glasses that are picked up, fields beyond twelve, long waves."""

import pytest
from test_zemax import file, read

from raytrace.formats import read_lens, write_lens

#: A pickup of a medium with figures that are left from before.
PICKUP = "GLAS {name} 2 0 1.5 40 0 0 0 0 0 0"


@pytest.mark.parametrize(
    ("glass", "name", "index"),
    [("", "", 1.0), ("GLAS ___BLANK 1 0 1.7 0 0", "", 1.7), ("GLAS MINE 1 0 1.65 0 0", "MINE", 1.65)],
    ids=["air", "unnamed model glass", "named model glass"],
)
def test_a_medium_that_is_picked_up_is_that_of_its_surface(glass, name, index, tmp_path):
    """Its index, and not the figures in the line of the pickup; it is written such that it comes back."""
    text = file(object_=glass, stop=PICKUP.format(name=name or "___BLANK")).replace("DISZ INFINITY", "DISZ 100")
    lens, report = read(text)
    glass = lens.surfaces[2].glass
    assert (glass.name, glass.coefficients.tolist()) == (name, [index])
    assert [(one.surface, one.source) for one in lens.intent.solves] == [(2, 0)]
    assert not report.warnings
    write_lens(lens, tmp_path / "again.zmx")
    again = read_lens(tmp_path / "again.zmx")
    assert again.intent == lens.intent
    assert again.surfaces[2].glass.coefficients.equal(glass.coefficients)


def test_a_pickup_of_a_medium_follows_a_configuration():
    """Air in one configuration, a glass in the other, and the surface that picks it up with it."""
    tail = 'MNUM 2 1\nGLSS   0   1 "" 0 0 0 1 1 0 0\nGLSS   0   2 "F2" 0 0 0 1 1 0 0'
    text = file(stop=PICKUP.format(name="___BLANK"), tail=tail).replace("DISZ INFINITY", "DISZ 100")
    lens = read(text)[0]
    assert [one.surfaces[2].glass.name for one in lens.configurations] == ["", "F2"]


def test_a_pickup_of_another_glass_than_its_name_is_reported():
    text = file(object_="GLAS F2 0 0 1.5 40", stop="GLAS SF5 2 0 1.5 40").replace("DISZ INFINITY", "DISZ 100")
    lens, report = read(text)
    assert lens.surfaces[2].glass.name == "SF5"
    assert report.warnings == (
        "lens.zmx:30, surface 2: GLAS SF5 is a pickup from surface 0, which has F2; SF5 is taken",
    )

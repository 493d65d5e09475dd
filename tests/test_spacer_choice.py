"""Materials of spacers chosen by an optimisation over temperatures, against all combinations."""

import itertools

import pytest
import torch

import raytrace as rt
from raytrace.materials.mounts import MOUNTS
from raytrace.optimization.spacer_choice import with_spacers, without_spacers
from raytrace.system.expansion import spaces

WARM = (-20.0, 60.0)


def achromat(middle="aluminium", last="aluminium"):
    """An air-spaced achromat on its axis, in one colour, with two spacers."""
    rows = [
        dict(radius=60.0, thickness=6.0, glass="N-BK7"),
        dict(radius=-50.0, thickness=4.0, expansion=middle),
        dict(radius=-45.0, thickness=2.0, glass="F2"),
        dict(radius=-150.0, thickness=94.0, expansion=last),
    ]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=12.0, fields=[0], wavelengths=[0.5876], catalogs=["SCHOTT"])
    return rt.focus(lens).lens


def thermal_defocus(lens):
    """mm, of the paraxial focus from the sensor, between both temperatures."""
    ends = [lens.at(temperature=celsius) for celsius in WARM]
    cold, hot = (float(rt.first_order(each).back_focal_distance - each.surfaces[-2].thickness) for each in ends)
    return hot - cold


def test_spaces_are_those_of_air():
    lens = achromat()
    assert spaces(lens.surfaces) == [2, 4]
    warm = lens.with_temperatures(WARM)
    assert without_spacers(warm, "sensor spacer glass") == (["sensor", "glass"], [(2,), (4,)])
    assert without_spacers(warm, "sensor barrel") == (["sensor"], [(2, 4)])
    assert without_spacers(warm, ["sensor", "spacer:4"]) == (["sensor"], [(4,)])
    assert without_spacers(warm, "sensor") == ("sensor", [])
    for words, message in (
        ("spacer:3", r"no spacer behind surface 3; this lens has spaces behind 2, 4"),
        ("spacer barrel", "the spacer behind surface 2 is named twice"),
    ):
        with pytest.raises(rt.BadVariables, match=message):
            without_spacers(warm, words)
    with pytest.raises(rt.BadVariables, match=r"has one temperature.*with_temperatures"):
        without_spacers(lens, "sensor spacer")


def test_expansions_of_a_spacer_are_those_of_a_lens_made_with_it():
    changed = with_spacers(achromat(), {2: 1.3, 4: 45.0})
    made = achromat("invar", "peek")
    for a, b in zip(changed.at(temperature=60).surfaces, made.at(temperature=60).surfaces, strict=True):
        torch.testing.assert_close(a.thickness, b.thickness, rtol=0, atol=1e-12)


def test_the_material_is_that_of_the_least_thermal_defocus():
    """Of one spacer, by the paraxial defocus of every listed material."""
    lens = achromat().with_temperatures(WARM)
    found = rt.optimize(lens, merit="spot", vary="sensor spacer:4")
    defocus = {name: abs(thermal_defocus(achromat(last=name))) for name in MOUNTS}
    best = min(defocus, key=defocus.get)
    assert best != "aluminium"
    (step,) = found.spacers
    assert step.names == (best,)
    assert float(found.lens.surfaces[4].expansion) == MOUNTS[best].expansion
    assert float(found.lens.surfaces[2].expansion) == MOUNTS["aluminium"].expansion
    assert found.merit_after < 0.9 * found.merit_before
    assert step.reached == pytest.approx(step.predicted, rel=0.02)
    assert f"spacer of 4: {best}" in str(found)
    assert found.document()["spacers"][0]["spacers"] == [
        {"surfaces": [4], "material": best, "expansion_before": 23.6}
    ]  # fmt: skip
    # the thicknesses of the hot lens are those of a lens with that spacer
    hot, made = found.lens.configuration(3), achromat(last=best).at(temperature=60)
    moved = float(found.lens.surfaces[4].thickness - achromat().surfaces[4].thickness)
    assert float(hot.surfaces[4].thickness - made.surfaces[4].thickness) == pytest.approx(moved, rel=2e-3)


def test_two_materials_are_the_best_of_all_combinations():
    """Each combination optimised by itself."""
    names = ("aluminium", "invar", "peek", "titanium")
    lens = achromat().with_temperatures(WARM)
    found = rt.optimize(lens, merit="spot", vary="sensor spacer", mounts=names)

    def merit(materials):
        numbers = {k: MOUNTS[name].expansion for k, name in zip((2, 4), materials, strict=True)}
        return rt.optimize(with_spacers(lens, numbers), merit="spot", vary="sensor").merit_after

    merits = {materials: merit(materials) for materials in itertools.product(names, repeat=2)}
    best = min(merits, key=merits.get)
    assert found.spacers[-1].names == best
    assert found.merit_after == pytest.approx(merits[best], rel=1e-6)
    assert found.merit_after < found.merit_before


def test_one_material_of_a_barrel():
    names = ("aluminium", "invar", "titanium")
    lens = achromat().with_temperatures(WARM)
    found = rt.optimize(lens, merit="spot", vary="sensor barrel", mounts=" ".join(names))
    defocus = {name: abs(thermal_defocus(achromat(name, name))) for name in names}
    best = min(defocus, key=defocus.get)
    chosen = [float(found.lens.surfaces[k].expansion) for k in (2, 4)]
    assert chosen == [MOUNTS[best].expansion] * 2


def test_materials_that_are_the_best_stay():
    lens = achromat().with_temperatures(WARM)
    best = rt.optimize(lens, merit="spot", vary="sensor spacer:4").lens
    again = rt.optimize(best, merit="spot", vary="sensor spacer:4")
    assert not again.spacers
    assert again.merit_after == pytest.approx(again.merit_before, rel=1e-6)
    with pytest.raises(rt.NoProblem, match="goes without `checkpoint`"):
        rt.optimize(lens, merit="spot", vary="sensor spacer", checkpoint="state.json")
    with pytest.raises(ValueError, match="mount 'wood'"):
        rt.optimize(lens, merit="spot", vary="sensor spacer", mounts="wood")


@pytest.mark.slow
def test_glasses_and_spacers_together(tmp_path):
    """A catalog glass and a listed material; with the material of the lens it is not better; the file keeps both."""
    lens = achromat().with_temperatures(WARM)
    settings = dict(merit="spot", hold="efl@1=100", cycles=5, glasses="preferred price<=1.2")
    words = "sensor curvature:4 glass:3"
    both = rt.optimize(lens, vary=f"{words} barrel", mounts="aluminium invar", **settings)
    glasses = rt.optimize(lens, vary=words, **settings)
    assert both.merit_after <= glasses.merit_after * (1 + 1e-6)
    assert any(step.surface == 3 for step in both.glasses)
    assert float(both.lens.surfaces[2].expansion) == float(both.lens.surfaces[4].expansion) in (23.6, 1.3)
    both.save(tmp_path / "athermal.zmx")
    back = rt.read_lens(tmp_path / "athermal.zmx")
    for k in (2, 4):
        assert float(back.surfaces[k].expansion) == pytest.approx(float(both.lens.surfaces[k].expansion))
    assert back.surfaces[3].glass.name == both.lens.surfaces[3].glass.name

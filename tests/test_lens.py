"""Lens: wavelengths in another unit are refused, glasses used outside their range are warned of, everywhere."""

import dataclasses
import warnings
from pathlib import Path

import pytest
import torch
from problems import lens, surface, vector

from raytrace import distortion, refractive_index, spot
from raytrace.io import LensFileError, read_lens, write_lens
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import (
    MIRROR,
    ImplausibleWavelength,
    InvalidIndex,
    OutOfRange,
    check_unit,
    model_glass,
)
from raytrace.materials.glass import constant as medium
from raytrace.system.lens import check, check_media, with_wavelengths

LENSES = Path(__file__).parents[1] / "lenses"
MIRRORS = lens([surface(-0.01, -50.0, MIRROR), surface(-0.01, 60.0, MIRROR)])
AIR_ALONE = lens([surface(None, 50.0)])
CONSTANT = lens([surface(0.02, 5.0, 1.5), surface(None, 50.0)])


@pytest.mark.parametrize("system", [MIRRORS, AIR_ALONE, CONSTANT], ids=["mirrors", "air", "constant"])
@pytest.mark.parametrize(
    ("wavelength", "guess"),
    [(550.0, "did you mean 0.55?"), (10600.0, "did you mean 10.6?"), (5.876e-7, "did you mean 0.5876?"), (1e9, None)],
)
def test_another_unit_is_refused_with_a_guess_also_where_no_glass_would_know(system, wavelength, guess):
    for refuse in (
        lambda: with_wavelengths(system, [0.55, wavelength]),
        lambda: distortion(system, fields=vector(0.0, 1.0)[:, None], wavelengths=vector(wavelength)),
    ):
        with pytest.raises(ImplausibleWavelength) as error:
            refuse()
        assert f"a wavelength of {wavelength:g} µm" in str(error.value)
        assert (guess in str(error.value)) if guess else ("did you mean" not in str(error.value))


@pytest.mark.parametrize("wavelength", [1e-4, 0.0135, 0.193, 0.55, 5.0, 10.6, 39.0])
def test_wavelengths_that_lenses_and_mirrors_are_made_for_pass(wavelength):
    check(with_wavelengths(MIRRORS, [wavelength]))


@pytest.mark.parametrize("wrong", [0.0, -0.55, float("inf"), float("nan")])
def test_impossible_wavelengths_are_refused(wrong):
    with pytest.raises(ImplausibleWavelength):
        check_unit(vector(0.55, wrong))


def test_the_range_of_a_glass_is_believed_beyond_the_bounds():
    """Plastics for terahertz waves, say."""
    clear = dataclasses.replace(medium(1.43, "TPX"), wavelength_range=(20.0, 3000.0))
    with pytest.raises(ImplausibleWavelength):
        check_unit(vector(300.0))
    check_unit(vector(300.0), [clear])
    with_wavelengths(lens([surface(0.02, 5.0, clear), surface(None, 50.0)]), [300.0])


def test_extrapolated_glasses_are_named_with_their_range_each_once():
    gauss = read_lens(LENSES / "double_gauss.zmx")
    with pytest.warns(OutOfRange) as warned:
        moved = with_wavelengths(gauss, [3.0], where="gauss")
    assert [str(w.message).split(" is ")[0] for w in warned] == [
        "gauss, surface 1: SK2 (SCHOTT)",
        "gauss, surface 3: SK16 (SCHOTT)",
        "gauss, surface 4: F5 (SCHOTT)",
    ]
    assert "extrapolated to 3 µm; its coefficients hold from 0.31 to 2.325 µm" in str(warned[0].message)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with_wavelengths(moved, [3.0, 0.55])  # known since the lens has it
    with pytest.raises(InvalidIndex, match="surface 1: SK2"):
        check_media(gauss, vector(9.0))
    with pytest.warns(OutOfRange, match="surface 1: SK2"):
        distortion(gauss, fields=vector(0.0, 1.0)[:, None], wavelengths=vector(3.0))


def test_other_wavelengths_count_alike_and_the_first_is_primary():
    found = with_wavelengths(read_lens(LENSES / "cooke_triplet.zmx"), [0.6, 0.5])
    assert found.wavelengths.tolist() == [0.6, 0.5]
    assert found.wavelength_weights.tolist() == [1.0, 1.0]
    assert found.primary_wavelength == 1
    assert torch.equal(with_wavelengths(found, vector(0.5), vector(2.0)).wavelength_weights, vector(2.0))


def test_wavelengths_of_files_are_accepted_and_impossible_ones_refused(tmp_path):
    """A wavelength of 486 µm is warned of by the range of the glass; tables, which people type, need the unit."""
    text = (LENSES / "singlet.zmx").read_text(encoding="utf-8")
    wrong = tmp_path / "nm.zmx"
    wrong.write_text(text.replace("WAVM 1 0.4861327 1", "WAVM 1 486.1327 1"), encoding="utf-8")
    found = read_lens(wrong)
    with pytest.warns(OutOfRange, match=r"is extrapolated to 486\.1327 µm"):
        check_media(found, found.wavelengths)
    table = tmp_path / "nm.csv"
    head = "# wavelengths: 587.6\n# stop: 1\n# entrance pupil diameter: 10\n"
    table.write_text(head + "surface,radius,thickness,glass\n1,50,5,N-BK7\n2,,100,\nimage,,,\n", encoding="utf-8")
    with pytest.raises(LensFileError, match=r"nm\.csv:1.*in nm write '587\.6 nm'"):
        read_lens(table)
    table.write_text(table.read_text(encoding="utf-8").replace("587.6", "587.6 nm"), encoding="utf-8")
    assert read_lens(table).wavelengths.tolist() == [0.5876]
    for name in ("out.zmx", "out.csv"):
        with pytest.raises(LensFileError, match="a wavelength of 0 µm"):
            write_lens(dataclasses.replace(CONSTANT, wavelengths=vector(0.0)), tmp_path / name)
        assert not (tmp_path / name).exists()


def test_a_glass_is_replaced_by_its_name_index_or_nd_and_vd():
    triplet = read_lens(LENSES / "cooke_triplet.zmx")
    named = triplet.replace(1, glass="S-BSM16").surfaces[1].glass
    assert (named.name, named.catalog) == ("S-BSM16", "OHARA")
    assert triplet.replace(1, glass="mirror").surfaces[1].is_mirror
    assert float(refractive_index(triplet.replace(1, glass=1.5).surfaces[1].glass, vector(0.55))) == 1.5
    model = triplet.replace(1, glass=(1.62, 60.3)).surfaces[1].glass
    assert torch.equal(refractive_index(model, vector(0.55)), refractive_index(model_glass(1.62, 60.3), vector(0.55)))
    with pytest.raises(UnknownGlass, match=r"surface 1: unknown glass 'S-BSM166'.*S-BSM16 "):
        triplet.replace(1, glass="S-BSM166")


def test_weights_and_the_primary_wavelength_are_conditions():
    triplet = read_lens(LENSES / "cooke_triplet.zmx")
    found = triplet.at(wavelengths=[0.6, 0.5], wavelength_weights=[1, 3], primary_wavelength=2, field_weights=[1, 2, 0])
    assert found.wavelength_weights.tolist() == [1, 3]
    assert float(found.primary) == 0.5
    assert found.fields.weight.tolist() == [1, 2, 0]
    assert torch.equal(found.fields.vignetting, triplet.fields.vignetting)
    heavy = spot(found).whole.rms_radius
    assert not torch.allclose(heavy, spot(found.at(wavelength_weights=[1, 1])).whole.rms_radius)
    with pytest.raises(ValueError, match=r"`wavelength_weights`: 2 .*expected 3"):
        triplet.at(wavelength_weights=[1, 2])
    with pytest.raises(ValueError, match=r"`field_weights` .*from 0 up"):
        triplet.at(field_weights=[1, -1, 0])
    with pytest.raises(ValueError, match=r"primary wavelength number 3; .* 1 to 2"):
        found.at(primary_wavelength=3)

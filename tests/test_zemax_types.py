"""Every type of surface of a .zmx file: its rays by definition, its units, there and back, and what stays refused."""

import dataclasses
import math
import random
import re
from pathlib import Path

import numpy as np
import pytest
import zemax_by_definition
from hypothesis import strategies as st
from problems import for_examples, number
from problems_files import damaged, leaves, read_damaged
from problems_zemax_types import CASES, GLASS, file, parm, read, text, xdat

import raytrace as rt
from raytrace.io import LensFileError, UnsupportedSurface
from raytrace.io.source import Place, decode
from raytrace.io.zemax import write as zemax_write
from raytrace.io.zemax.surfaces import inverse, spelled_inverse, types
from raytrace.system.lens import media
from raytrace.system.rays import start
from raytrace.tracing.trace import steps

MILLIMETRES = {"MM": 1.0, "IN": 25.4, "METER": 1000.0}


def again(lens) -> tuple[rt.Lens, str]:
    """The lens that comes back, and the file."""
    written = decode(zemax_write.write(lens, "lens.zmx"), Place("lens.zmx"))
    return read(written)[0], written


def test_every_type_has_a_case():
    assert {kind for kind, _ in CASES.values()} == set(types())


def rays(seed: int) -> list[tuple[list[float], list[float]]]:
    """Some at the stop, one of them parallel to the axis but off the vertex."""
    source = random.Random(seed)
    found = [([0.1, 0.2, 0.0], [0.0, 0.0, 1.0])]
    for _ in range(6):
        slopes = np.array([source.uniform(-0.15, 0.15), source.uniform(-0.15, 0.15), 1.0])
        found.append(([source.uniform(-4, 4), source.uniform(-4, 4), 0.0], list(slopes / np.linalg.norm(slopes))))
    return found


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        pytest.param(name, unit, marks=pytest.mark.slow if unit != "MM" and number % 4 else ())
        for unit in MILLIMETRES
        for number, name in enumerate(CASES)
    ],
)
def test_rays_go_as_the_definitions_say(name, unit):
    lens, wavelength, mm = read(text(name, unit))[0], 0.6, MILLIMETRES[unit]
    indices = media(lens, number(wavelength))
    for P, D in rays(len(name)):
        expected = zemax_by_definition.trace(text(name, unit), P, D, wavelength)
        found = start(mm * number(P), number(D))
        walk = steps(lens.surfaces[1:], found, indices=indices, wavelength=number(wavelength))
        for crossing, out in zip(walk, expected, strict=True):
            if out is not None:
                assert bool(crossing.rays.valid)
                assert np.abs(crossing.rays.position.numpy() / mm - out[:3]).max() < 2e-12  # of the unit
                assert np.abs(crossing.rays.direction.numpy() - out[3:]).max() < 1e-12


@pytest.mark.parametrize("unit", MILLIMETRES)
@pytest.mark.parametrize("name", CASES)
def test_every_type_round_trip_bit_identically(name, unit):
    lens, report = read(text(name, unit, "CLAP 0 6"))
    if CASES[name][0] != "COORDBRK":
        assert lens.surfaces[2].apertures
        assert report.warnings == ()
    lens_again, written = again(lens)
    assert leaves(lens_again) == leaves(lens)
    known = {"XASPHERE": {"EVENASPH", "XASPHERE"}, "JONESMAT": {"STANDARD"}}.get(CASES[name][0], {CASES[name][0]})
    assert any(f"  TYPE {kind}\n" in written for kind in known)
    assert leaves(again(lens_again)[0]) == leaves(lens)


# -- there and back ---------------------------------------------------------------------------------------------------

amounts = st.floats(1e-5, 1e5).flatmap(lambda x: st.sampled_from([x, -x, 0.0]))
#: PARM that only some numbers suit.
_SUITED = {
    ("COORDBRK", 6): st.sampled_from([0, 1]),
    ("PARAXIAL", 1): amounts.filter(bool),
    ("PARAXIAL", 2): st.integers(0, 3),
    ("PARAX_XY", 3): st.integers(0, 3),
    ("HOLOGRM2", 3): amounts.filter(bool),
    ("HOLOGRM2", 6): amounts.filter(bool),
    ("HOLOGRM2", 7): st.floats(0.1, 10),
}


@st.composite
def seconds(draw) -> str:
    """The lines of a surface of any type, with any numbers."""
    kind = draw(st.sampled_from(sorted(types())))
    row, lines = types()[kind], [f"TYPE {kind}"]
    if "curvature" in row.holds:
        lines += [f"CURV {draw(amounts)}", f"CONI {draw(amounts)}"]
    lines += [f"PARM {j} {draw(_SUITED.get((kind, j), amounts))}" for j in row.parameters]
    if row.terms is not None and kind != "TOROIDAL":
        terms = draw(st.lists(amounts, max_size=min(row.most, 20)))
        lines += xdat(draw(st.floats(1e-3, 1e3)), *terms).split("\n")
    if kind not in ("COORDBRK", "IRREGULA"):
        numbers = st.lists(amounts, min_size=5, max_size=5)
        poses = (f"SCBD {w} {draw(st.integers(0, 1))} 0 {' '.join(map(str, draw(numbers)))}" for w in (1, 2))
        lines += draw(st.lists(st.sampled_from([*poses]), unique=True))
        lines.append(draw(st.sampled_from(["", GLASS, "GLAS MIRROR"])))
    return "\n".join(lines)


@pytest.mark.parametrize("examples", [12, *(pytest.param(n, marks=pytest.mark.slow) for n in (40, 400))])
def test_any_lens_round_trip_bit_identically(examples):
    def round_trip(second, unit):
        lens = read(file(second, unit))[0]
        found = again(lens)[0]
        assert leaves(found) == leaves(lens)
        assert leaves(again(found)[0]) == leaves(lens)

    for_examples(examples, round_trip, second=seconds(), unit=st.sampled_from(["MM", "CM", "IN", "METER"]))


@pytest.mark.parametrize("examples", [100, pytest.param(500, marks=pytest.mark.slow)])
def test_every_reciprocal_is_the_one_of_a_text(examples):
    def check(value, sign):
        text = spelled_inverse(sign * value)
        assert inverse(text, 1.0) == sign * value
        assert math.isfinite(float(text))

    for_examples(examples, check, value=st.floats(1e-300, 1e300), sign=st.sampled_from([1.0, -1.0]))


def test_a_length_is_converted_before_its_reciprocal_is_rounded():
    assert inverse("1D1", 25.4) == 1 / 254
    assert inverse("0.0", 25.4) == 0.0
    assert spelled_inverse(1 / 37.3) == "37.3"


@pytest.mark.parametrize("examples", [60, *(pytest.param(n, marks=pytest.mark.slow) for n in (200, 600))])
def test_damaged_files_of_every_type_give_a_lens_or_a_clear_error(examples):
    def read_one(seed, name):
        read_damaged(Path("lens.zmx"), damaged(text(name).encode(), random.Random(seed)))

    for_examples(examples, read_one, seed=st.integers(0, 2**63), name=st.sampled_from(sorted(CASES)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"coefficients": number([1e-9] * 9), "kind": "odd asphere"}, "ODDASPHE has 8"),
        (
            {"coefficients": number([1e-9]), "phase": rt.system.Grating(number(0.1), number(1.0))},
            "a DGRATING surface has none",
        ),
        (
            {"curvature": number(0.1), "phase": rt.system.IdealLens(number(0.1), number(0.1))},
            "a PARAXIAL surface has none",
        ),
        ({"is_break": True, "glass": rt.materials.MIRROR}, "holds none of them"),
        ({"before": rt.system.Pose(x=number([1.0, 2.0]))}, "a file holds one lens"),
        ({"before": rt.system.Pose(tilt_x=number(math.nan))}, "tilt or decentre is nan"),
    ],
)
def test_lenses_that_a_file_cannot_hold_are_refused(changes, message):
    lens = read(text("standard"))[0]
    bare = dataclasses.replace(lens.surfaces[2], curvature=None, conic=None, glass=rt.materials.AIR)
    surface = dataclasses.replace(bare, **changes)
    with pytest.raises(LensFileError, match=message) as caught:
        zemax_write.write(
            dataclasses.replace(lens, surfaces=(*lens.surfaces[:2], surface, *lens.surfaces[3:])), "a.zmx"
        )
    assert caught.value.surface == 2


# -- what stays refused, and what is said -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ("TYPE COORDBRK\nPARM 6 2", r"type COORDBRK \(coordinate break\) of order 2 \(PARM 6"),
        ("TYPE COORDBRK\nSCBD 1 0 0 0 0 5 0 0", r"type COORDBRK \(coordinate break\) with a tilt"),
        ("SCBD 1 7 0 0 0 5 0 0", "SCBD 1 of order 7"),
        ("SCBD 4 0 0 0 0 5 0 0", "SCBD 4 of order 0"),
        ("TYPE TOROIDAL\nXDAT 1 2\nXDAT 2 9\nXDAT 4 0.1", r"type TOROIDAL \(toroidal\) with Zernike terms"),
        (
            "TYPE IRREGULA\nPARM 3 9\nSCBD 1 0 0 1 0 5 0 0",
            "type IRREGULA .* with tilts of its own .* and of the surface",
        ),
        ("TYPE HOLOGRM2\nCURV 0.1\nPARM 3 9\nPARM 6 9\nPARM 7 0.5", "on a curved surface"),
    ],
)
def test_unmodelled_features_are_refused_by_name_surface_and_line(second, message):
    with pytest.raises(UnsupportedSurface, match=message) as caught:
        read(file(second))
    assert (caught.value.surface, caught.value.file) == (2, "lens.zmx")
    assert caught.value.line is not None


@pytest.mark.parametrize("kind", ["COORDBRK", "PARAXIAL", "DGRATING"])
@pytest.mark.parametrize("surface", [0, 4])
def test_object_and_image_are_no_breaks_and_bend_no_light(kind, surface):
    content = text("standard").replace(f"SURF {surface}\n  TYPE STANDARD", f"SURF {surface}\n  TYPE {kind}")
    with pytest.raises(UnsupportedSurface, match=f"surface {surface}: type {kind} .*object or the image"):
        read(content)


def test_an_object_is_perpendicular_to_the_axis():
    with pytest.raises(UnsupportedSurface, match=r"surface 0: .*object with a tilt"):
        read(text("standard").replace("SURF 0\n", "SURF 0\n  SCBD 2 0 0 0 0 5 0 0\n"))


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ("TYPE PARAXIAL\nPARM 1 0", "a focal length of 0"),
        ("TYPE PARAXIAL\nPARM 1 1e-320", "too small a length"),
        ("TYPE PARAXIAL\nPARM 1 10\nPARM 2 7", "an OPD mode of 7"),
        ("TYPE BINARY_2\nXDAT 1 1\nXDAT 2 10\nXDAT 3 5", "no order of diffraction"),
        ("TYPE BINARY_2\nPARM 0 1\nXDAT 1 2\nXDAT 3 5", "no XDAT 2"),
        ("TYPE BINARY_2\nPARM 0 1\nXDAT 1 2\nXDAT 2 -3\nXDAT 3 5", "expected a positive length"),
        ("TYPE FZERNPHA\nPARM 0 1\nXDAT 1 38\nXDAT 2 3", "expected 0 to 37"),
        ("TYPE BINARY_2\nPARM 0 1\nXDAT 1 1.5\nXDAT 2 3", "expected a whole number"),
        ("TYPE HOLOGRM2\nPARM 3 9\nPARM 7 0.5", "a construction point at the vertex"),
        ("TYPE HOLOGRM2\nPARM 3 9\nPARM 6 9", "construction wavelength of 0 µm"),
        ("TYPE IRREGULA\nDIAM 0\nPARM 5 1", "no semi-diameter"),
        ("PARM one 1", "number of the parameter is 'one'"),
        ("SCBD 1 0 0 nan", "finite number"),
    ],
)
def test_numbers_out_of_range_are_one_clear_error(second, message):
    with pytest.raises(LensFileError, match=message) as caught:
        read(file(second))
    assert caught.value.surface == 2


@pytest.mark.parametrize(
    ("second", "where", "said"),
    [
        ("TYPE JONESMAT\nPARM 1 1", "notes", "PARM 1 of a JONESMAT surface is not used: polarisation"),
        ("TYPE DGRATING\nPARM 3 1", "warnings", "PARM 3: a DGRATING has parameters 1 to 2; left out"),
        ("TYPE EVENASPH\nPARM 9 1", "warnings", r"PARM 9: an EVENASPH has parameters 1 to 8 \(r² to r\^16\)"),
        ("TYPE STANDARD\nPARM 1 1", "notes", "PARM 1 is not used by a STANDARD surface"),
        ("TYPE STANDARD\nXDAT 3 1", "notes", "XDAT 3 is not used by a STANDARD surface"),
        ("TYPE XASPHERE\nXDAT 1 1\nXDAT 2 9\nXDAT 4 1", "warnings", "XDAT 4: XDAT 1 states 1 terms, to XDAT 3"),
        ("TYPE COORDBRK\nCURV 0.1", "notes", "CURV is not used by a COORDBRK surface"),
        ("TYPE COORDBRK\nGLAS MIRROR", "warnings", "GLAS on a coordinate break is not used"),
        ("TYPE COORDBRK\nSCBD 3 3 1", "notes", "coordinate return; its solved values"),
    ],
)
def test_unused_data_are_reported(second, where, said):
    report = read(file(second))[1]
    assert [one for one in getattr(report, where) if re.search(said, one)]
    assert all(keyword.status != "unknown" for keyword in report.keywords)


def test_terms_of_an_extended_asphere_in_parm_are_those_of_an_even_asphere():
    """Some programs write them so; of a surface with XDAT they are left out, as in OpticStudio."""
    lines = f"TYPE XASPHERE\nCURV 0.02\n{parm(1, 0.0, 1e-6, -1e-9)}\n{GLASS}"
    system, report = read(file(lines))
    assert any("XASPHERE without XDAT: PARM 1 to 8 are taken as its terms" in text for text in report.warnings)
    assert system.surfaces[2].coefficients.tolist() == [0.0, 1e-6, -1e-9]
    assert read(file(f"{lines}\n{xdat(2, 0.4)}"))[0].surfaces[2].coefficients.tolist() == [0.1]

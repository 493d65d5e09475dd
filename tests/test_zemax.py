"""The .zmx reader: what each keyword means, in small files."""

import json
import math
import re

import pytest
from problems_zemax import file, lens, read

import raytrace as rt
from raytrace.io import LensFileError, UnsupportedSurface, read_lens, read_lens_with_report, write_lens
from raytrace.io.source import Place, decode
from raytrace.materials.catalogs import UnknownGlass, find_glass
from raytrace.materials.glass import MIRROR, mil_glass


def test_a_singlet_is_read_number_for_number():
    found, report = read(file())
    assert [float(s.thickness) for s in found.surfaces] == [math.inf, 4.0, 47.5, 0.0]
    assert float(found.surfaces[1].curvature) == 0.02
    assert found.surfaces[0].curvature is None
    assert found.surfaces[1].conic is None
    assert found.surfaces[1].semi_diameter == 6.0
    assert found.surfaces[1].apertures == ()  # a semi-diameter alone clips no ray
    assert found.surfaces[1].glass.catalog == "SCHOTT"
    assert (found.stop, found.name, found.catalogs) == (2, "A singlet", ("SCHOTT",))
    assert report.warnings == ()


def test_only_the_slots_that_ftyp_counts_are_wavelengths_and_pwav_counts_from_one():
    found = lens()
    assert found.wavelengths.tolist() == [0.4861327, 0.5875618]
    assert found.wavelength_weights.tolist() == [1.0, 0.5]
    assert found.primary_wavelength == 2


def test_older_lists_of_wavelengths_and_fields():
    old = {"W1": "WAVL 0.4 0.5", "W2": "WWGT 1 2", "W3": "", "X": "XFLD 0 0", "Y": "YFLD 0 3.5"}
    found = lens(**old)
    assert found.wavelengths.tolist() == [0.4, 0.5]
    assert found.wavelength_weights.tolist() == [1.0, 2.0]
    assert found.fields.y.tolist() == [0.0, 3.5]
    padded = lens(W1="WAVN 0.4 0.5 0.55 0.55", W2="WWGN 1 2 1 1", W3="")
    assert padded.wavelengths.tolist() == [0.4, 0.5]


@pytest.mark.parametrize(("unit", "mm"), [("MM", 1.0), ("CM", 10.0), ("IN", 25.4), ("INCH", 25.4), ("METER", 1000.0)])
def test_unit_converts_every_length_and_no_other_number(unit, mm):
    text = file(
        UNIT=f"UNIT {unit} X W X CM MR CPMM",
        FTYP="FTYP 1 0 2 2 0 0 0",
        object_="CONI -0.5",
        surface="TYPE EVENASPH\nPARM 1 0.25\nPARM 2 1e-3\nCLAP 1 5\nOBDC 0.5 -0.25\nCONI -1",
    ).replace("DISZ INFINITY", "DISZ 100")
    found = read(text)[0]
    first = found.surfaces[1]
    assert float(found.surfaces[0].thickness) == 100 * mm
    assert float(first.thickness) == 4 * mm
    assert float(first.curvature) == 0.02 / mm
    assert first.coefficients.tolist() == [0.25 / mm, 1e-3 / mm**3]
    assert float(first.conic) == -1.0
    assert first.semi_diameter == 6 * mm
    assert first.apertures[0].extent == (mm, 5 * mm)
    assert first.apertures[0].centre == (0.5 * mm, -0.25 * mm)
    assert float(found.aperture.value) == 10 * mm
    assert found.fields.y.tolist() == [0.0, 7 * mm]
    assert found.wavelengths.tolist() == [0.4861327, 0.5875618]


@pytest.mark.parametrize("kind", ["0", "1", "2", "3"])
def test_field_angles_are_not_lengths(kind):
    found = lens(UNIT="UNIT CM", FTYP=f"FTYP {kind} 0 2 2").fields
    names = ("angle", "object_height", "paraxial_image_height", "real_image_height")
    assert found.kind == names[int(kind)]
    assert found.y.tolist() == [0.0, 7.0 if kind == "0" else 70.0]


@pytest.mark.parametrize(
    ("line", "kind", "value"),
    [
        ("ENPD 10", "entrance_pupil_diameter", 10.0),
        ("FNUM 5.5 0", "image_f_number", 5.5),
        ("FNUM 5.5", "image_f_number", 5.5),
        ("FNUM 5.5 1", "paraxial_working_f_number", 5.5),
        ("OBNA 0.1478 0", "object_na", 0.1478),
        ("OBNA 160 1", "object_cone_angle", 160.0),
        ("FLOA", "float_by_stop", 5.5),
    ],
)
def test_system_aperture(line, kind, value):
    found = lens(APERTURE=line).aperture
    assert (found.kind, float(found.value)) == (kind, value)


def test_telecentric_weights_and_vignetting():
    extra = "FWGN 1 2\nVDXN 0 0\nVDYN 0 -0.059\nVCXN 0 0.05\nVCYN 0 0.09\nVANN 0 1.5"
    found = lens(FTYP="FTYP 0 1 2 2", X=f"XFLN 0 0\n{extra}").fields
    assert found.telecentric
    assert found.weight.tolist() == [1.0, 2.0]
    assert found.vignetting.tolist() == [[0, 0], [0, -0.059], [0, 0.05], [0, 0.09], [0, 1.5]]
    old = lens(X=f"XFLN 0 0\n{extra}".replace("VCYN", "ZVCY").replace("VDYN", "VDY")).fields
    assert old.vignetting[3].tolist() == [0, 0.09]
    assert old.vignetting[1].tolist() == [0, -0.059]
    assert lens(X="XFLN 0 0\nVCYN 0 0").fields.vignetting is None


def test_field_order_is_kept():
    assert lens(FTYP="FTYP 0 0 3 2", Y="YFLN 5 -5 0").fields.y.tolist() == [5.0, -5.0, 0.0]


@pytest.mark.parametrize(
    ("line", "shape", "extent", "obscures"),
    [
        ("CLAP 1 5 0", "circular", (1.0, 5.0), False),
        ("OBSC 0 3 0", "circular", (0.0, 3.0), True),
        ("SQAP 7 8 3", "rectangular", (7.0, 8.0), False),
        ("SQOB 7 8", "rectangular", (7.0, 8.0), True),
        ("ELAP 7 8", "elliptic", (7.0, 8.0), False),
        ("ELOB 7 8", "elliptic", (7.0, 8.0), True),
    ],
)
def test_apertures(line, shape, extent, obscures):
    (found,) = lens(surface=line).surfaces[1].apertures
    assert (found.shape, found.extent, found.obscures, found.centre) == (shape, extent, obscures, (0.0, 0.0))


def test_floating_aperture_clips_at_the_semi_diameter_as_it_now_is():
    (found,) = lens(surface="FLAP 0 5.9 0").surfaces[1].apertures
    assert found.extent == (0.0, 6.0)


def test_user_aperture_is_warned_of_and_refused_when_strict():
    text = file(surface="USAP 0 0 0\nUDAD 1 0 0 0")
    assert "user-defined aperture" in read(text)[1].warnings[0]
    with pytest.raises(LensFileError, match="user-defined aperture"):
        read(text, strict=True)


def test_even_asphere_starts_at_r2_and_keeps_zero_terms():
    (_, first, *_) = lens(surface="TYPE EVENASPH\nPARM 1 0\nPARM 2 1e-6\nPARM 3 0").surfaces
    assert first.coefficients.tolist() == [0.0, 1e-6, 0.0]
    (_, none, *_) = lens(surface="TYPE EVENASPH").surfaces
    assert none.coefficients.tolist() == [0.0] * 8


def test_missing_type_is_standard():
    text = file().replace("  TYPE STANDARD\n", "")
    assert float(read(text)[0].surfaces[1].curvature) == 0.02


def _glass(line: str):
    return read(file().replace("GLAS N-BK7 0 0 1.5 40", line))[0].surfaces[1].glass


def test_glass_columns_are_placeholders_unless_flagged_as_a_model():
    listed = find_glass("SF5", catalogs=("SCHOTT",))
    for flag in (0, 2, 3):
        assert _glass(f"GLAS SF5 {flag} 0 1.5 40 0").coefficients.equal(listed.coefficients)
    model = _glass("GLAS SF5 1 0 1.6 33 0.001")
    assert (model.name, model.formula, model.coefficients.tolist()) == ("SF5", "model", [1.6, 33.0, 0.001])
    blank = _glass("GLAS ___BLANK 1 0 1.6 33 0.001 1 1 1 0 0")
    assert (blank.name, blank.coefficients.tolist()) == ("", [1.6, 33.0, 0.001])
    assert _glass("GLAS ___BLANK 2 5 1.6 33 0").formula == "model"


def test_model_glass_without_dispersion_six_digit_code_mirror_and_air():
    assert (_glass("GLAS ___BLANK 1 0 1.507 0 0").formula) == "constant"
    assert _glass("GLAS ___BLANK 1 0 1.507 0 0").coefficients.tolist() == [1.507]
    code = _glass("GLAS 517642 0 0 7734.3 17972 29.4")
    assert (code.name, code.coefficients.tolist()) == ("517642", mil_glass("517642").coefficients.tolist())
    assert _glass("GLAS MIRROR 0 0 -1 0") is MIRROR
    assert _glass("GLAS AIR").coefficients.tolist() == [1.0]


def test_unknown_glass_names_file_line_and_surface():
    with pytest.raises(UnknownGlass, match=r"lens\.zmx:\d+, surface 1.*NOSUCH"):
        _glass("GLAS NOSUCH 0 0 1.5 40")


def test_notes_are_joined_where_the_program_cut_them():
    long = "x" * 200
    found = lens(NAME=f"NOTE 0 {long}\nNOTE 0 yz\nNOTE 4\nNOTE 0 second\nNOTE 0 Notes...\nNAME  title ")
    assert found.notes == (f"{long}yz", "second")
    assert found.name == "title"


@pytest.mark.parametrize(("number", "kind"), [(0, "off"), (1, "paraxial"), (2, "real")])
def test_ray_aiming_is_the_second_number_of_raim(number, kind, tmp_path):
    found = lens(PWAV=f"PWAV 1\nRAIM 0 {number} 1 1 0 0 0 0 0 1")
    assert found.ray_aiming == kind
    for name in ("lens.zmx", "lens.csv"):
        write_lens(found, tmp_path / name)
        assert read_lens(tmp_path / name).ray_aiming == kind


def test_ray_aiming_of_another_kind_is_refused():
    with pytest.raises(LensFileError, match=r"RAIM .*3, expected 0 .*, 1 .* or 2"):
        lens(PWAV="PWAV 1\nRAIM 0 3 1 1")


def test_comment():
    assert lens(surface="COMM front of the crown ").surfaces[1].comment == "front of the crown"


def test_a_mirror_and_a_dummy_surface_stay():
    text = file().replace("GLAS N-BK7 0 0 1.5 40", "GLAS MIRROR").replace("CURV -0.02", "CURV 0")
    found = read(text)[0]
    assert found.surfaces[1].is_mirror
    assert found.surfaces[2].curvature is None
    assert len(found.surfaces) == 4


@pytest.mark.parametrize(
    "kind", ["XOSPHERE", "NONSEQCO", "USERSURF", "GRINSUR5", "BIREFR_I", "GRID_SAG", "BINARY_3", "QED_TYPE"]
)
def test_types_that_are_not_modelled_are_refused_by_name_surface_and_line(kind):
    text = file(stop=f"TYPE {kind}", surface="GLAS NOSUCH")
    line = text.split("\n").index(f"  TYPE {kind}") + 1
    with pytest.raises(UnsupportedSurface, match=rf"lens\.zmx:{line}, surface 2: type {kind}"):
        read(text)


def test_surfaces_to_be_ignored_are_refused():
    with pytest.raises(UnsupportedSurface, match="ignored"):
        lens(surface="IGNR 1")


def test_files_that_are_not_sequential_are_refused():
    with pytest.raises(UnsupportedSurface, match="MODE NSC"):
        lens(MODE="MODE NSC")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"APERTURE": ""}, "no system aperture"),
        ({"APERTURE": "ENPD 0"}, "expected a positive"),
        ({"APERTURE": "ENPD ten"}, "expected a finite number"),
        ({"APERTURE": "ENPD"}, "is missing"),
        ({"APERTURE": "FNUM 2 7"}, "kind 7"),
        ({"UNIT": "UNIT FURLONG"}, "UNIT is 'FURLONG'"),
        ({"FTYP": "FTYP 4 0 2 2"}, "theodolite"),
        ({"FTYP": "FTYP 0 0 0 2"}, "number of fields is 0"),
        ({"FTYP": "FTYP 0 0 2 9"}, "expected 9 wavelengths"),
        ({"Y": "YFLN 0"}, "YFLN has 1 values for 2 fields"),
        ({"PWAV": "PWAV 3"}, "PWAV is 3"),
        ({"W1": "WAVM 1 -0.5 1"}, "expected a positive number"),
        ({"W1": "WAVM 1 nan 1"}, "finite"),
        ({"surface": "DISZ nan"}, "thickness is 'nan'"),
        ({"surface": "DISZ INFINITY"}, "only the object"),
        ({"surface": "DISZ 1e999"}, "too large"),
        ({"surface": "DISZ 1e306", "UNIT": "UNIT METER"}, "too large once converted"),
        ({"surface": "CURV inf"}, "CURV: curvature is 'inf'"),
        ({"surface": "DIAM -1"}, "semi-diameter"),
        ({"surface": "CLAP -1 2"}, "negative size"),
        ({"surface": "GLAS"}, "without a name"),
        ({"surface": "STOP"}, "a second STOP"),
        ({"object_": "DISZ -INFINITY"}, "only the object"),
        ({"object_": "DISZ nan"}, "finite"),
    ],
)
def test_bad_input_is_one_clear_error_with_file_and_line(changes, message):
    with pytest.raises(LensFileError, match=message) as caught:
        lens(**changes)
    assert caught.value.file == "lens.zmx"
    assert "\n" not in str(caught.value)


def test_missing_parts_are_named():
    text = file()
    with pytest.raises(LensFileError, match="no surface is marked STOP"):
        read(text.replace("  STOP\n", ""))
    with pytest.raises(LensFileError, match="image"):
        read(text[: text.index("SURF 3")])
    with pytest.raises(LensFileError, match="no DISZ"):
        read(text.replace("  DISZ 47.5\n", ""))
    with pytest.raises(LensFileError, match="surface 2 should follow"):
        read(text.replace("SURF 2", "SURF 3"))
    with pytest.raises(LensFileError, match="no SURF line"):
        read("MODE SEQ\nENPD 3\n")


def test_encodings():
    text = file(NAME="NAME Objectif à 4 lentilles, λ")
    for content in (
        text.encode("utf-16"),
        b"\xfe\xff" + text.encode("utf-16-be"),
        text.encode("utf-16-le"),
        text.encode("utf-16-be"),
        text.encode("utf-8"),
        text.encode("utf-8-sig"),
        text.replace("\n", "\r\n").encode("utf-16"),
    ):
        assert decode(content, Place("lens.zmx")) == text
    latin = text.replace("λ", "é").encode("latin-1")
    assert "Objectif à 4 lentilles, é" in decode(latin, Place("lens.zmx"))


@pytest.mark.parametrize("content", [b"", b"  \n", b"\x00\x01\x02\x03" * 99, b"PK\x03\x04\x07", b"\xff\xfeV\x00E"])
def test_binary_files_are_refused(content):
    with pytest.raises(LensFileError):
        decode(content, Place("lens.zmx"))


def test_report_sorts_every_keyword():
    text = file(
        PWAV="PWAV 2\nVERS 1 2 3\nPFIL 0 0 0\nXYZW 1", surface="COAT AR\nQQQQ 3", tail="BLNK\nEFFL 0 2\nMNUM 1 1"
    )
    report = read(text)[1]
    status = {keyword.name: keyword.status for keyword in report.keywords}
    assert status["SURF"] == status["VERS"] == "read"
    assert status["PFIL"] == status["COAT"] == "ignored"
    assert status["BLNK"] == status["EFFL"] == "read"
    assert status["XYZW"] == status["QQQQ"] == "unknown"
    assert all(keyword.reason for keyword in report.keywords if keyword.status == "ignored")
    assert len(report.warnings) == 2
    assert "unknown" in str(report)
    assert "surface 1: N-BK7, SCHOTT" in str(report)
    assert json.loads(json.dumps(report.document()))["keywords"][0]["count"] == 1
    with pytest.raises(LensFileError, match=r"unknown keyword .*1 more"):
        read(text, strict=True)


@pytest.mark.parametrize(
    ("operand", "said"),
    [
        ("PRES   0   1 0.0 0 0 0 1 1 1.0 0.0 0", r"PRES 0 atm .*configuration 1.*indices are those at 1 atm"),
        ("TEMP   0   1 40 0 0 0 1 1 1.0 0.0 0", r"TEMP 40 °C .*configuration 1.*indices are those at 20 °C"),
        ("GLSS   1   1 N-SF6 0 0 0 1 1 0 0.0 0", r"operand GLSS 1 = N-SF6: not followed"),
        ("PRAM   1   1 -10.0 0 3 0 1 1 1.0 0.0 0", r"operand PRAM 1 = -10: not followed"),
        ("THIC   1   1 3.5 0 0 0 1 1 1.0 0.0 0", r"operand THIC 1 = 3.5: not followed"),
    ],
)
@pytest.mark.parametrize("count", ["1", "1 1", ""])
def test_operands_of_a_single_configuration_are_reported_by_name_value_and_line(operand, said, count):
    text = file(tail=f"MNUM {count}\n{operand}")
    line = text.splitlines().index(operand) + 1
    assert [warning for warning in read(text)[1].warnings if re.search(rf":{line}.*{said}", warning)]
    with pytest.raises(LensFileError, match=said):
        read(text, strict=True)


def test_operands_that_change_nothing_are_not_reported():
    quiet = 'MNUM 1\nMOFF 0 1 "" 0\nPRES 0 1 1.0 0 0 0 1 1 1.0 0.0 0\nTEMP 0 1 20 0 0 0 1 1\nTHIC 1 1 4 0 0\nCSUM 5'
    assert not read(file(tail=quiet))[1].warnings
    for active in (1, 2):
        warnings = read(file(tail=f"MNUM 2 {active}\nPRES 0 1 1.0 0 0\nPRES 0 2 0.0 0 0"))[1].warnings
        assert any("PRES 0 atm (pressure of configuration 2)" in warning for warning in warnings) == (active == 2)


def test_the_configuration_read_from_a_file_is_reported():
    tail = "MNUM 2{}\nTHIC 1 1 {} 1 0\nTHIC 1 2 {} 1 0"
    first = read(file(tail=tail.format(" 1", 4, 5)))[1]
    assert "configuration 1 of 2" in first.notes[0]
    second = read(file(tail=tail.format("", 3, 4)))[1]  # the stored thickness is that of configuration 2
    assert "configuration 2 of 2" in second.warnings[0]


def test_environment_apodisation_and_afocal_are_warned_of():
    report = read(file(PWAV="PWAV 1\nENVD 100 1 0\nGFAC 1 1", FTYP="FTYP 0 0 2 2 0 0 1"))[1]
    assert [word in " ".join(report.warnings) for word in ("100 °C", "apodised", "afocal")] == [True] * 3


def test_repeated_keyword_warns_and_the_last_counts():
    found, report = read(file(surface="CURV 0.03"))
    assert float(found.surfaces[1].curvature) == 0.03
    assert "CURV occurs again" in report.warnings[0]


def test_files_that_lost_their_indentation():
    text = "\n".join(line.strip() for line in file(tail="BLNK\nEFFL 0 2").split("\n"))
    assert float(read(text)[0].surfaces[2].thickness) == 47.5


def test_files_with_other_indentation():
    """Every line indented, as OpTaliX writes them, and surface 0 alone without, as DeepLens does."""
    text = file(tail="BLNK\nEFFL 0 2\nMNUM 1 1")
    straight, report = read("\n".join(f" {line}" for line in text.split("\n")))
    assert [float(s.thickness) for s in straight.surfaces] == [math.inf, 4.0, 47.5, 0.0]
    assert report.warnings == ()
    assert [row.operand for row in straight.optimization_data.merit] == ["BLNK", "EFFL"]
    before, after = text.split("SURF 1", 1)
    mixed, report = read("SURF 1".join([before.replace("\n  ", "\n"), after]))
    assert [float(s.thickness) for s in mixed.surfaces] == [math.inf, 4.0, 47.5, 0.0]
    assert report.warnings == ()


def test_an_object_at_1e10_is_at_infinity(tmp_path):
    """OpticStudio has infinity there; other programs write 1e20."""
    for distance, expected in [("1.0E+10", math.inf), ("0.1E+21", math.inf), ("9e9", 9e9)]:
        found = read(file().replace("DISZ INFINITY", f"DISZ {distance}"))[0]
        assert float(found.surfaces[0].thickness) == expected
    with pytest.raises(LensFileError, match=r"surface 0: the object is 2\d+\.0 mm away, .*; make it inf"):
        write_lens(rt.with_object_distance(found, 2e10), tmp_path / "far.zmx")


def test_fortran_exponents():
    assert float(lens(surface="CURV 2.5D-02").surfaces[1].curvature) == 0.025


def test_suffix_decides_and_is_not_case_sensitive(tmp_path):
    path = tmp_path / "LENS.ZMX"
    path.write_text(file())
    assert read_lens_with_report(path)[0].stop == 2

"""Prescription tables: headings, separators, glass cells, header lines, pandas."""

import math
import subprocess
import sys

import pandas as pd
import pytest

from raytrace.io import FORMATS, LensFileError, UnsupportedSurface, write_lens
from raytrace.io.frames import lens_from_frame, to_frame
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import MIRROR, mil_glass

#: Table 3 of "On the use of differentiable optical models for lens and neural network co-design", as pasted from it.
TABLE_3 = """\
Table 3. The optical starting point for our experiment on co-design.

Surface\tCurvature\tThickness\tMaterial
Sphere 1\t0.0184661976\t8.74664\tSK2
Sphere 2\t0.0065564346\t0.5\t
Sphere 3\t0.027815929\t14.0\tSK16
Plan 4\t\t3.77696\tF5
Sphere 5\t0.04490361\t14.253\t
Aperture\t\t12.4281\t
Sphere 6\t-0.03893318\t3.777\tF5
Plan 7\t\t10.834\tSK16
Sphere 8\t-0.027041482\t0.5\t
Sphere 9\t0.0050912\t6.8581\tSK16
Sphere 10\t-0.014892576\t58.5\t
Image plan\t\t\t
"""

SYSTEM = "# aperture: EPD 10\n# fields: angle 0 5\n# wavelengths: 0.5876\n# catalogs: SCHOTT\n"
SINGLET = "surface,type,radius,thickness,glass\n1,stop,50,4,N-BK7\n2,,-50,47.5,\n3,image,,,\n"


def read(text: str, **options):
    return FORMATS[".csv"].read(text, "lens.csv", **options)


def lens(rows: str = SINGLET, system: str = SYSTEM):
    return read(system + rows)[0]


def test_table_3_loads_as_pasted_with_its_assumptions_in_the_report():
    found, report = read(TABLE_3)
    assert found.stop == 6
    assert len(found.surfaces) == 13
    curvatures = [0.0 if s.curvature is None else float(s.curvature) for s in found.surfaces]
    assert curvatures[1:7] == [0.0184661976, 0.0065564346, 0.027815929, 0.0, 0.04490361, 0.0]
    assert [s.glass.name for s in found.surfaces[1:5]] == ["SK2", "", "SK16", "F5"]
    assert float(found.surfaces[0].thickness) == math.inf
    assert float(found.surfaces[11].thickness) == 58.5
    assert (found.aperture.kind, float(found.aperture.value)) == ("image_f_number", 10.0)
    assert found.wavelengths.tolist() == [0.5875618]
    assert found.fields.y.tolist() == [0.0]
    assumed = " ".join(report.warnings)
    assert all(word in assumed for word in ("no wavelengths", "no fields", "no aperture"))
    assert found.surfaces[1].comment == "Sphere 1"
    with pytest.raises(LensFileError, match="strict"):
        read(TABLE_3, strict=True)


def test_table_3_with_header_lines_assumes_nothing():
    header = "# aperture: EPD 33.33\n# fields: angle 0 10 14\n# wavelengths: 0.530\n# catalogs: SCHOTT\n"
    found, report = read(header + TABLE_3, strict=True)
    assert report.warnings == ()
    assert (found.aperture.kind, float(found.aperture.value)) == ("entrance_pupil_diameter", 33.33)
    assert found.fields.y.tolist() == [0.0, 10.0, 14.0]


@pytest.mark.parametrize("separator", [",", ";", "\t"])
def test_separators(separator):
    found = lens(SINGLET.replace(",", separator))
    assert float(found.surfaces[1].curvature) == 1 / 50


def test_decimal_commas_with_semicolons():
    found = lens("surface;radius;thickness;glass\n1;50,5;3,25;N-BK7\nStop;inf;0;\nImage;;;\n")
    assert float(found.surfaces[1].thickness) == 3.25


def test_columns_aligned_by_blanks():
    text = """\
Surface     Radius    Thickness   Glass    Semi-diameter
1            50.5       4         N-BK7    12.5
Aperture                2.25                6.1
3           -50.5      90         air
Image plane
"""
    found = lens(text, "")
    assert [float(s.thickness) for s in found.surfaces] == [math.inf, 4, 2.25, 90, 0]
    assert [s.semi_diameter for s in found.surfaces] == [None, 12.5, 6.1, None, None]
    assert (found.stop, found.aperture.kind, float(found.aperture.value)) == (2, "float_by_stop", 6.1)
    with pytest.raises(LensFileError, match="heading of its own"):
        lens(text.replace("1            50.5", "1 50.5"), "")


@pytest.mark.parametrize(
    ("heading", "value"),
    [
        ("Radius", "40"),
        ("R", "40"),
        ("ROC [mm]", "40"),
        ("Radius of curvature", "40"),
        ("Curvature", "0.025"),
        ("C", "0.025"),
        ("CURV (1/mm)", "0.025"),
    ],
)
def test_headings_of_the_shape(heading, value):
    found = lens(f"No,{heading},Thickness,Glass\n1,{value},4,N-BK7\nStop,,2,\nImage,,,\n")
    assert float(found.surfaces[1].curvature) == 0.025
    assert found.surfaces[2].curvature is None


@pytest.mark.parametrize("plane", ["", "inf", "Infinity", "INFINITY", "0", "∞", "-inf"])
def test_radius_of_a_plane(plane):
    assert lens(SINGLET.replace("-50,47.5", f"{plane},47.5")).surfaces[2].curvature is None


def test_conic_terms_and_diameter():
    text = "surface,type,r,t,glass,k,diameter,A4,r^6,8th order\n"
    text += "1,stop,50,4,N-BK7,-1,20,1e-6,,-2e-12\n2,,,40,,0,,,,\n3,image,,,,,,,,\n"
    first, second = lens(text).surfaces[1:3]
    assert float(first.conic) == -1
    assert second.conic is None
    assert first.coefficients.tolist() == [0.0, 1e-6, 0.0, -2e-12]
    assert second.coefficients is None
    assert first.semi_diameter == 10.0
    odd = lens(text.replace("A4", "A3")).surfaces[1]
    assert (odd.kind, odd.coefficients.tolist()) == ("odd asphere", [0.0, 0.0, 1e-6, 0.0, 0.0, 0.0, 0.0, -2e-12])


def _glass(cell: str):
    return lens(SINGLET.replace("N-BK7", cell)).surfaces[1].glass


def test_glass_cells():
    assert _glass("N-BK7").catalog == "SCHOTT"
    assert _glass("1.5").coefficients.tolist() == [1.5]
    assert _glass("1.5168/64.17").coefficients.tolist() == [1.5168, 64.17, 0.0]
    assert _glass("1.5168/64.17/0.001").coefficients.tolist() == [1.5168, 64.17, 0.001]
    assert _glass("517642").coefficients.tolist() == mil_glass("517642").coefficients.tolist()
    assert _glass("mirror") is MIRROR
    assert _glass("Air").coefficients.tolist() == [1.0]
    assert _glass("").name == ""
    named = _glass("WATER=1.333")
    assert (named.name, named.coefficients.tolist()) == ("WATER", [1.333])
    with pytest.raises(UnknownGlass, match=r"lens\.csv:6, surface 1"):
        _glass("NOSUCH")
    with pytest.raises(LensFileError, match="expected an index"):
        _glass("1.5/60/0/1")


def test_columns_of_figures_define_a_glass_and_are_compared_with_a_name():
    text = "surface,type,radius,thickness,glass,nd,vd\n1,stop,50,4,{},{}\n2,image,,,,,\n"
    assert lens(text.format("", "1.5168,64.17")).surfaces[1].glass.coefficients.tolist() == [1.5168, 64.17, 0.0]
    assert lens(text.format("", "1.33,")).surfaces[1].glass.coefficients.tolist() == [1.33]
    assert read(SYSTEM + text.format("N-BK7", "1.5168,64.17"))[1].warnings == ()
    assert "contradict" not in (warning := read(SYSTEM + text.format("N-BK7", "1.6,64.17"))[1].warnings[0])
    assert "the catalog is used" in warning


def test_stop_by_column_type_name_or_header():
    rows = "surface,radius,thickness,glass,{}\n1,50,4,N-BK7,{}\n2,,3,,{}\n3,-50,40,,{}\n4,,,,{}\n"
    assert lens(rows.format("stop", "", "x", "", "")).stop == 2
    assert lens(rows.format("type", "sphere", "Stop", "", "")).stop == 2
    assert lens(rows.format("comment", "", "", "the stop", "")).stop == 3
    assert lens(rows.format("comment", "", "", "", ""), SYSTEM + "# stop: 1\n").stop == 1
    with pytest.raises(LensFileError, match="no row is the stop"):
        lens(rows.format("comment", "", "", "", ""))
    with pytest.raises(LensFileError, match="a second stop"):
        lens(rows.format("stop", "x", "x", "", ""))
    with pytest.raises(LensFileError, match="expected 1 to 3"):
        lens(rows.format("comment", "", "", "", ""), SYSTEM + "# stop: 4\n")


def test_object_by_row_or_header():
    assert float(lens(system=SYSTEM + "# object distance: 250\n").surfaces[0].thickness) == 250
    row = SINGLET.replace("glass\n", "glass\n0,object,,300,\n")
    found = lens(row)
    assert float(found.surfaces[0].thickness) == 300
    assert len(found.surfaces) == 4
    with pytest.raises(LensFileError, match="row of the object"):
        lens(row, SYSTEM + "# object distance: 250\n")


@pytest.mark.parametrize(
    ("value", "kind", "number"),
    [
        ("EPD 33.33", "entrance_pupil_diameter", 33.33),
        ("EPD = 33.33 mm", "entrance_pupil_diameter", 33.33),
        ("entrance pupil diameter 33.33", "entrance_pupil_diameter", 33.33),
        ("F/3", "image_f_number", 3.0),
        ("f/# 2.8", "image_f_number", 2.8),
        ("F-number 2.8", "image_f_number", 2.8),
        ("working F/4", "paraxial_working_f_number", 4.0),
        ("NA 0.1", "object_na", 0.1),
        ("cone angle 5", "object_cone_angle", 5.0),
        ("stop 10.2", "float_by_stop", 10.2),
    ],
)
def test_aperture_of_the_header(value, kind, number):
    found = lens(system=SYSTEM.replace("EPD 10", value)).aperture
    assert (found.kind, float(found.value)) == (kind, number)


def test_fields_and_wavelengths_of_the_header():
    def fields(value):
        return lens(system=SYSTEM.replace("angle 0 5", value)).fields

    assert fields("0, 7, 10 deg").y.tolist() == [0.0, 7.0, 10.0]
    pairs = fields("object height (1, 2) (3, -4)")
    assert (pairs.kind, pairs.x.tolist(), pairs.y.tolist()) == ("object_height", [1.0, 3.0], [2.0, -4.0])
    assert fields("real image height 0 21.6 mm").kind == "real_image_height"
    colours = SYSTEM.replace("0.5876", "486.1 587.6 656.3 nm\n# primary wavelength: 2\n# weights: 1 2 1")
    found = lens(system=colours)
    assert found.wavelengths.tolist() == [0.4861, 0.5876, 0.6563]
    assert (found.primary_wavelength, found.wavelength_weights.tolist()) == (2, [1.0, 2.0, 1.0])


@pytest.mark.parametrize("unit", ["in", "inches"])
def test_units_of_the_header(unit):
    found = lens(system=SYSTEM + f"# units: {unit}\n")
    assert float(found.surfaces[1].thickness) == 4 * 25.4
    assert float(found.surfaces[1].curvature) == (1 / 50) / 25.4
    assert float(found.aperture.value) == 254.0
    with pytest.raises(LensFileError, match="# units: in"):
        lens(SINGLET.replace("radius", "radius (in)"))


def test_apertures_of_a_row():
    cell = "circular 1 5 + obscuration rectangular 2 3 at 0.5 -1"
    first, second = lens(f"No,R,T,apertures\nStop,,4,{cell}\nImage,,,\n").surfaces[1].apertures
    assert (first.shape, first.extent, first.obscures) == ("circular", (1.0, 5.0), False)
    assert (second.shape, second.extent, second.centre) == ("rectangular", (2.0, 3.0), (0.5, -1.0))
    assert second.obscures


def test_a_spreadsheet_may_have_padded_and_quoted_the_header():
    system = '"# fields: angle 0, 5",,,,\n# aperture: EPD 10,,,,\n# wavelengths: 0.5876,,,,\n# catalogs: SCHOTT,,,,\n'
    found, report = read(system + SINGLET)
    assert found.fields.y.tolist() == [0.0, 5.0]
    assert report.warnings == ()


def test_comment_lines_are_notes_and_a_slip_of_the_pen_is_warned_of():
    found, report = read(SYSTEM + "# Source: a book\n# apertur: EPD 3\n" + SINGLET)
    assert found.notes == ("Source: a book", "apertur: EPD 3")
    assert "did you mean 'aperture'?" in report.warnings[0]


def test_a_column_that_is_not_known_is_warned_of():
    rows = SINGLET.replace("glass\n", "glass,maker\n", 1).replace("N-BK7\n", "N-BK7,Schott\n")
    assert "unknown keyword column maker" in read(SYSTEM + rows)[1].warnings[0]


@pytest.mark.parametrize("kind", ["coordinate break", "toroidal", "grating", "paraxial", "polynomial", "biconic"])
def test_types_that_are_not_modelled_are_refused(kind):
    with pytest.raises(UnsupportedSurface, match=r"lens\.csv:7, surface 2"):
        lens(SINGLET.replace("2,,", f"2,{kind},"))


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("nonsense\n", "no line of headings"),
        ("surface,radius,thickness\n", "0 rows"),
        ("surface,radius,thickness\nstop,nan?,3\nimage,,\n", "expected a finite number"),
        ("surface,radius,thickness\nstop,1e-400,3\nimage,,\n", None),
        ("surface,radius,thickness\nstop,1e-310,3\nimage,,\n", "too small"),
        ("surface,radius,thickness\nstop,,inf\nimage,,\n", "expected a finite number"),
        ("surface,radius,thickness\nstop,,\nimage,,\n", None),
        ("surface,radius,thickness\nstop,,3,9\nimage,,\n", "no column"),
        ("surface,radius,curvature,thickness\nstop,10,0.2,3\nimage,,,\n", "contradict"),
        ("surface,radius,thickness\nstop,,3\n2,5,3\n", "no column names a medium"),
        ("surface,type,radius,thickness\nstop,,,3\n2,image,,3\n3,,,0\n", "rows after the image"),
        ("surface,radius,thickness,sd\nstop,,3,-1\nimage,,,\n", "semi-diameter"),
        ('surface,radius,thickness\nstop,"3"4,3\nimage,,\n', "quotes"),
    ],
)
def test_bad_tables_are_one_clear_error(rows, message):
    if message is None:
        if "1e-400" in rows:
            assert lens(rows).surfaces[1].curvature is None
        else:
            with pytest.raises(LensFileError, match="no thickness"):
                lens(rows)
        return
    with pytest.raises(LensFileError, match=message) as caught:
        lens(rows)
    assert caught.value.file == "lens.csv"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("# aperture: large", "expected for example"),
        ("# aperture: EPD -3", "EPD|positive"),
        ("# fields: angle", "expected a kind"),
        ("# fields: angle (1, 2, 3)", "expected .x, y."),
        ("# wavelengths: 587.6", "in nm"),
        ("# wavelengths: 0.5 furlong", "expected numbers"),
        ("# primary wavelength: 2", "expected 1 to 1"),
        ("# wavelength weights: 1 2", "wavelength weights: 2 weights"),
        ("# vcy: 0.1", "1 values for 2 fields"),
        ("# telecentric: perhaps", "expected yes or no"),
        ("# units: ells", "expected mm"),
        ("# object distance: nan", "object distance"),
    ],
)
def test_bad_header_lines_name_their_line(line, message):
    with pytest.raises(LensFileError, match=message) as caught:
        read(SYSTEM + line + "\n" + SINGLET)
    assert caught.value.line == 5


def test_frame_out_and_in():
    found = lens()
    frame = to_frame(found)
    assert list(frame["thickness"]) == [math.inf, 4.0, 47.5, 0.0]
    assert frame.index.name == "surface"
    again = lens_from_frame(frame, strict=True)
    assert float(again.surfaces[1].curvature) == 1 / 50
    assert again.fields.y.tolist() == [0.0, 5.0]


def test_frame_of_a_designer():
    frame = pd.DataFrame(
        {
            "Radius": [50.0, math.inf, -50.0, math.nan],
            "Thickness": [4, 2, 45.5, None],
            "Glass": ["N-BK7", None, None, None],
            "Stop": [False, True, False, False],
        }
    )
    found = lens_from_frame(frame, aperture="F/5", fields=[0, 3.5], wavelengths=0.55, object_distance=200)
    assert found.stop == 2
    assert float(found.surfaces[0].thickness) == 200
    assert found.fields.y.tolist() == [0.0, 3.5]
    assert found.wavelengths.tolist() == [0.55]
    with pytest.raises(LensFileError, match="DataFrame"):
        lens_from_frame(frame.drop(columns="Thickness"))


@pytest.mark.slow
def test_reading_a_table_loads_no_pandas():
    code = "import sys, raytrace.io; sys.exit('pandas' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("suffix", [".csv", ".zmx"])
def test_a_written_file_states_the_catalog_of_an_ambiguous_glass(suffix, tmp_path):
    """F5 of SCHOTT and of HOYA differ: a file that is read without its catalog warns, the written one does not."""
    found, report = read(SYSTEM.replace("# catalogs: SCHOTT\n", "") + SINGLET.replace("N-BK7", "F5"))
    assert "F5 is taken from SCHOTT" in " ".join(report.warnings)
    path = tmp_path / f"written{suffix}"
    write_lens(found, path)
    again, report = FORMATS[suffix].read(path.read_bytes().decode(), str(path))
    assert again.catalogs == ("SCHOTT",)
    assert not report.warnings

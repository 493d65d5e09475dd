"""Prescriptions as patents, books and programs print them: read by the names of their columns, or refused by name.

The oracle is the focal length that each source itself states.
"""

import pytest
import torch
from problems import focal_length
from problems_tables import LOWENTHAL, NOCTILUX, summilux

from raytrace.io import FORMATS, LensFileError
from raytrace.io.source import Place, decode
from raytrace.io.table.columns import meaning
from raytrace.materials.glass import LINES, abbe_number, nd, refractive_index
from raytrace.tracing.paraxial import first_order

SYSTEM = "# wavelengths: 0.5876\n# fields: angle 0\n# aperture: F/4\n"


def read(text: str, system: str = SYSTEM, **options):
    return FORMATS[".csv"].read(system + text, "lens.csv", **options)


def test_the_tables_have_the_focal_lengths_that_their_sources_state():
    lens, report = read(NOCTILUX)
    assert abs(focal_length(lens) - 52) < 0.05
    assert abs(float(first_order(lens).back_focal_distance) - 27.68) < 0.01
    assert (lens.stop, lens.surfaces[1].semi_diameter) == (6, 26.6)
    assert "column '有効径' is a diameter: halved" in report.notes
    assert len(report.warnings) == 1
    assert "no row of the image: added 27.68 mm behind the last surface" in report.warnings[0]
    lens, _ = read(LOWENTHAL)
    assert abs(focal_length(lens) - 100.4) < 0.05  # indices to three decimals
    assert abs(float(first_order(lens).back_focal_distance) - 55.07) < 0.1
    assert (lens.stop, lens.surfaces[6].semi_diameter) == (6, 21.3)


@pytest.mark.parametrize(
    "headings",
    [
        "No.,R,Nd,νd,d",
        "No.,R,Nd,Vd,D",
        "S,r,nd,vd,t",
        "Surface number,Radius of curvature R (mm),Refractive index nd,Abbe number νd,Thickness d (mm)",
        "Surface,Curvature radius,Index,Abbe No.,Distance",
        "#,ROC [mm],n(d),Abbe#,Thickness/mm",
        "i,Ri,Ndi,νdi,Di",
        "i,ri,ni,νi,di",
        "Surface,rn,n,v,dn",
        "面番号,Ｒ,Ｎｄ,νｄ,ｄ",
        "面番号,曲率半径R,屈折率nd,アッベ数νd,面間隔d",
        "面号,曲率半径,折射率,阿贝数,厚度",
        "Fläche,Krümmungsradius,Brechzahl,Abbesche Zahl,Dicke",
        "Surface,Rayon,Indice,Nombre d'Abbe,Épaisseur",
        "Surf,Radius,Refractive index at d-line,V-number,Thickness",
        "Surf,RDY,Index (587.56 nm),Abbe value,THI",
    ],
)
def test_headings_of_patents_and_programs(headings):
    lens, report = read(summilux(headings, "No R n V d"))
    assert abs(focal_length(lens) - 50) < 0.002
    glass = lens.surfaces[5].glass
    assert glass.coefficients.tolist() == [1.63003, 35.4, 0.0]
    assert lens.stop == 7
    assert len(report.warnings) == 1  # the image


def test_a_diameter_is_halved_and_a_semi_diameter_is_not():
    for headings, scale in (
        ("No,R,thickness,nd,νd,D", 0.5),
        ("No,R,d,nd,νd,φ", 0.5),
        ("No,R,d,nd,νd,CA", 0.5),
        ("No,R,d,nd,νd,有効半径", 1.0),
        ("No,R,d,nd,νd,SD", 1.0),
        ("No,R,d,nd,νd,Effective diameter", 0.5),
    ):
        lens, report = read(summilux(headings, "No R d n V D"))
        assert lens.surfaces[7].semi_diameter == scale * 24.1
        assert ("halved" in " ".join(report.notes)) == (scale == 0.5)


@pytest.mark.parametrize(
    ("headings", "message"),
    [
        ("No,R,d,nd,νd,D", "columns 'd' and 'D' could each be the thickness; write 'thickness' and 'diameter'"),
        ("No,R,d,nd,νd,t", "columns 't' and 'd' could each be the thickness"),
        ("No,R,thickness,nd,νd,d", "columns 'thickness' and 'd' could each be the thickness"),
        ("No,R,thickness,nd,νd,Distance", "columns 'thickness' and 'Distance' could each be the thickness"),
        ("No,R,d,nd,νd,r", "columns 'R' and 'r' are both the radius"),
        ("No,R,d,nd,νd,h", "column 'h' holds numbers"),
        ("No,R,d,nx,νd,φ", "column 'nx' holds numbers"),
        ("No,R,d,n(1064nm),νd,φ", r"column 'n\(1064nm\)' holds numbers"),
        ("No,R,d,n,νe,φ", "column 'n' does not name its spectral line; write 'nd' or 'ne'"),
        ("No,R,d,ne,ν,φ", "column 'ν' does not name its spectral line; write 'Vd' or 'Ve'"),
        ("No,R,d,index,nd,φ", "column 'index' does not name its spectral line"),
        ("No,R,d,nd,νd,κ", "column 'κ' holds numbers"),
        ("No,R,d,nd,νd,A", "column 'A' holds numbers"),
        ("No,R,d,nd,νd,φ (in)", "not in mm; write the header line '# units: in'"),
        ("No,R,d (μm),nd,νd,φ", "is in μm; convert it to mm"),
        ("No,R,d,nd,νd,", "column '' holds numbers"),
        ("No,R,d,thing,νd,φ", "column 'thing' holds numbers"),
    ],
)
def test_ambiguous_columns_are_refused(headings, message):
    with pytest.raises(LensFileError, match=message) as caught:
        read(summilux(headings, "No R d n V D"))
    assert caught.value.line is not None


def test_a_column_may_be_left_out_by_name():
    text = summilux("No,R,d,nd,νd,h", "No R d n V D")
    lens, report = read(text, SYSTEM + "# ignore: h, weight\n")
    assert abs(focal_length(lens) - 50) < 0.002
    assert any(keyword.name == "column h" and keyword.status == "ignored" for keyword in report.keywords)
    lens, report = read(summilux("No,R,d,nd,νd,f (mm)", "No R d n V D"))
    (focal,) = [keyword for keyword in report.keywords if keyword.name == "column f (mm)"]
    assert (focal.status, focal.reason) == ("ignored", "a focal length follows from the surfaces")


def test_a_table_without_its_index_is_no_lens_in_air():
    with pytest.raises(LensFileError, match="no column names a medium"):
        read(summilux("No,R,d", "No R d"))
    with pytest.raises(LensFileError, match=r"abbe d is 45\.2, but no index is given"):
        read(summilux("No,R,d,νd", "No R d V"))
    with pytest.raises(LensFileError, match=r"'air', .* 1\.5168"):
        read("No,R,d,glass,nd\n1,50,3,air,1.5168\nstop,,40,,\nimage,,,,\n")


def test_units_of_headings_agree_with_those_of_the_header():
    text = "No,R (in),d [in],nd\nstop,2,0.1,1.5\n2,-2,2,\nimage,,,\n"
    lens, _ = read(text, SYSTEM + "# units: in\n")
    assert float(lens.surfaces[1].thickness) == 0.1 * 25.4
    with pytest.raises(LensFileError, match=r"column 'R \(mm\)' is not in in"):
        read(text.replace("(in)", "(mm)"), SYSTEM + "# units: in\n")


def test_headings_over_two_lines_and_between_bars():
    text = summilux("Surface,Radius of,Thickness,Refractive,Abbe\nnumber,curvature,,index nd,number νd")
    assert abs(focal_length(read(text)[0]) - 50) < 0.002
    text = summilux("No,R,d,nd,νd\n,(mm),(mm),,")
    assert abs(focal_length(read(text)[0]) - 50) < 0.002
    rows = [f"| {line.replace(',', ' | ')} |" for line in summilux("No,R,d,nd,νd").splitlines()]
    text = "\n".join([rows[0], "|---|:--:|---|---|--:|", *rows[1:]])
    assert abs(focal_length(read(text)[0]) - 50) < 0.002


def glass_of(columns: str, cells: str):
    return (
        read(f"No,R,d,{columns}\nstop,50,4,{cells}\n2,-50,40{',' * (columns.count(',') + 1)}\nimage,,\n")[0]
        .surfaces[1]
        .glass
    )


def at(glass, line: str) -> float:
    return float(refractive_index(glass, torch.tensor(LINES[line], dtype=torch.float64)))


def test_indices_at_several_lines_make_the_dispersion():
    """Figures of N-BK7 (SCHOTT, data sheet): its indices, its Abbe numbers, its partial dispersion."""
    sheet = {"g": 1.52668, "F": 1.52238, "e": 1.51872, "d": 1.51680, "C": 1.51432}
    glass = glass_of("nd,nF,nC,ng", "1.51680,1.52238,1.51432,1.52668")
    assert all(abs(at(glass, line) - wanted) < 1e-5 for line, wanted in sheet.items())
    assert float(abbe_number(glass)) == pytest.approx(0.5168 / 0.00806, rel=1e-3)  # least squares
    glass = glass_of("nd,nF,nC", "1.51680,1.52238,1.51432")
    assert float(abbe_number(glass)) == pytest.approx(0.5168 / 0.00806, rel=1e-9)
    glass = glass_of("nC,ne,nF", "1.51432,1.51872,1.52238")
    assert all(abs(at(glass, line) - sheet[line]) < 1e-9 for line in "CeF")
    assert abs(at(glass, "d") - sheet["d"]) < 1e-5
    glass = glass_of("ne,νe", "1.51872,63.96")
    assert abs(at(glass, "e") - 1.51872) < 1e-9
    assert (1.51872 - 1) / (at(glass, "F'") - at(glass, "C'")) == pytest.approx(63.96, rel=1e-9)
    assert all(abs(at(glass, line) - wanted) < 4e-5 for line, wanted in sheet.items())
    glass = glass_of("nd,νd,θgF", "1.51680,64.17,0.5349")
    assert (at(glass, "g") - at(glass, "F")) / (at(glass, "F") - at(glass, "C")) == pytest.approx(0.5349, abs=1e-4)
    assert glass_of("ne", "1.51872").coefficients.tolist() == [1.51872]
    assert glass_of("nd,νd", "1.51680,64.17").coefficients.tolist() == [1.5168, 64.17, 0.0]
    with pytest.raises(LensFileError, match="rises with the wavelength"):
        glass_of("nF,nC", "1.51432,1.52238")


def test_the_sodium_line_is_not_the_helium_line():
    assert (meaning("nD").name, meaning("nd").name, meaning("ND").name) == ("index D", "index d", "index d")
    assert (meaning("nF").name, meaning("nF'").name, meaning("nf").name) == ("index F", "index F'", "index F")


@pytest.mark.parametrize(
    "label", ["stop", "STO", "5(stop)", "5 (Stop)", "5S", "S", "AS", "5AS", "絞り", "(Aperture stop)"]
)
def test_marks_of_the_stop(label):
    text = f"No,R,d,nd\n1*,50,4,1.5\n{label},∞,4,\n3,-50,40,\nimage,,,\n"
    assert read(text)[0].stop == 2
    text = "No,R,d,nd\nr1,50,4,1.5\nr2,{},4,\nr3,-50,40,\nimage,,,\n"
    for radius in ("∞ (stop)", "(stop)", "AS", "Stop", "STOP ∞", "plane (aperture)"):
        lens = read(text.format(radius))[0]
        assert (lens.stop, lens.surfaces[2].curvature) == (2, None)


def radius_of(cell: str, other: str = "-40", separator: str = ";", index: str = "1.5") -> float:
    rows = f"No;R;d;nd\nstop;{cell};4;{index}\n2;{other};40;\nimage;;;\n".replace(";", separator)
    return 1 / float(read(rows)[0].surfaces[1].curvature)


def test_numbers_as_people_write_them():
    assert radius_of("−52,5") == pytest.approx(-52.5)
    assert radius_of("– 52.5") == pytest.approx(-52.5)
    assert radius_of("52.5*") == pytest.approx(52.5)
    assert radius_of("1,234.5") == pytest.approx(1234.5)
    assert radius_of("1,234", "-40.5") == pytest.approx(1234)
    assert radius_of("1,234", "-40,5", index="1,5") == pytest.approx(1.234)
    assert read("No;R;d;nd\nstop;50;4;1,516\n2;-50;40;\nimage;;;\n")[0].surfaces[1].glass.coefficients.tolist() == [
        1.516
    ]
    assert radius_of('"1,234.5"', separator=",") == pytest.approx(1234.5)
    with pytest.raises(LensFileError, match=r"'1,234': .*Write 1\.234 or 1234"):
        radius_of("1,234", index="2")
    with pytest.raises(LensFileError, match="a decimal comma or thousands"):
        radius_of("1,234", "-40,5")
    for plane in ("plano", "Plane", "flat", "平面", "—", "∞", "1.#INF"):
        rows = f"No,R,d,nd\nstop,{plane},4,1.5\n2,-40,40,\nimage,,,\n"
        assert read(rows)[0].surfaces[1].curvature is None


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("stop,50,d1,1.5\n2,-50,40,\nimage,,,\n", "a distance given elsewhere; write its number"),
        ("stop,50,(variable),1.5\n2,-50,40,\nimage,,,\n", "a distance given elsewhere; write its number"),
        ("stop,50,4,1.5\n2,-50,Bf,\n", "a distance given elsewhere; write its number"),
        ("stop,50,4,1.5\n2,-50,,\n", "without a distance to the image; fill in its thickness"),
        ("stop,50,4,1.5\n2,-50,40,\n3,20,,\n", "without a distance to the image"),
        ("stop,50,4,1.5\n2,-50,40,\nf = 100 mm,,,\n", "the last row is called 'f = 100 mm'|coefficient"),
        ("stop,50,4,1.5\n2,-50,40,\nimage,,,\nK = -0.5,A4 = 1e-5,,\n", "coefficient in a line of its own"),
        ("stop,50,4,0.0015\n2,-50,40,\nimage,,,\n", None),
        ("stop,50,4,-1.5\n2,-50,40,\nimage,,,\n", "index d is -1.5"),
    ],
)
def test_missing_data_are_requested(rows, message):
    if message is None:
        assert float(nd(read("No,R,d,nd\n" + rows)[0].surfaces[1].glass)) == 0.0015
        return
    with pytest.raises(LensFileError, match=message):
        read("No,R,d,nd\n" + rows)


def test_a_radius_of_zero_on_a_lens_is_reported():
    rows = "No,R,d,nd\n1,0,4,1.5\n2,50,3,\nstop,0,3,\n3,-50,4,1.5\n4,0.0,40,\nimage,0,,\n"
    _, report = read(rows)
    assert report.warnings == ("lens.csv:5: radius 0 of surface 1, 5 is taken as a plane; write inf if it is one",)


def test_a_table_in_a_national_encoding_is_asked_for_in_utf_8():
    content = NOCTILUX.encode("shift-jis", "replace")
    with pytest.raises(LensFileError, match=r"in Shift-JIS or GBK\? Save it as UTF-8"):
        read(decode(content, Place("lens.csv")))
    assert abs(focal_length(read(decode(NOCTILUX.encode("utf-16"), Place("lens.csv")))[0]) - 52) < 0.05


def test_an_object_without_a_distance_is_far_away():
    rows = "No,R,d,nd\nobject,,{},\nstop,50,4,1.5\n2,-50,40,\nimage,,,\n"
    assert float(read(rows.format(""))[0].surfaces[0].thickness) == float("inf")
    assert float(read(rows.format("0"))[0].surfaces[0].thickness) == 0
    assert float(read(rows.format(""), SYSTEM + "# object distance: 250\n")[0].surfaces[0].thickness) == 250


def test_a_missing_image_surface_is_added_and_reported():
    lens, report = read("No,R,d,nd\nstop,50,4,1.5\n2,-50,40,\n")
    assert [float(surface.thickness) for surface in lens.surfaces[1:]] == [4, 40, 0]
    assert "no row of the image: added 40 mm behind the last surface" in report.warnings[0]
    with pytest.raises(LensFileError, match="strict"):
        read("No,R,d,nd\nstop,50,4,1.5\n2,-50,40,\n", strict=True)

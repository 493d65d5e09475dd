"""Drawings and solids: volumes by closed forms, sheets to scale without overlaps, indications, DXF and STEP files."""

import itertools
import math
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import raytrace as rt
from raytrace.workshop import dxf, step
from raytrace.workshop.indications import stated, toleranced
from raytrace.workshop.parts import DEVIATION, NoSolid, parts_of

RADII, THICKNESS, SEMI = (50.0, -80.0), 8.0, 12.0


def singlet(front=None, back=None, **options):
    """A biconvex lens, of other numbers where they are given."""
    rows = [
        {"radius": RADII[0], "thickness": THICKNESS, "glass": "N-BK7", "semi_diameter": SEMI} | (front or {}),
        {"radius": RADII[1], "thickness": 50, "semi_diameter": SEMI} | (back or {}),
    ]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=10, **options)


def asphere():
    return singlet({"conic": -0.8, "coefficients": (0.0, -3e-6, 2e-9)}, {"radius": 90.0, "conic": 0.5})


def cap(radius, h):
    """Volume of a cap of a sphere of that radius up to the height h from the axis."""
    radius = abs(radius)
    s = radius - math.sqrt(radius**2 - h**2)
    return math.pi * s**2 * (radius - s / 3)


def mass(shape):
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    properties = GProp_GProps()
    BRepGProp.VolumeProperties_s(shape, properties, 1e-13)
    return properties.Mass()


def test_a_spherical_lens_has_the_volume_of_its_caps():
    """The cylinder between the rims and a cap at each side."""
    (part,) = parts_of(singlet())
    s = [abs(radius) - math.sqrt(radius**2 - SEMI**2) for radius in RADII]
    assert part.edge == pytest.approx(THICKNESS - sum(s), rel=1e-13)
    expected = math.pi * SEMI**2 * (THICKNESS - sum(s)) + sum(cap(radius, SEMI) for radius in RADII)
    assert part.volume == pytest.approx(expected, rel=1e-12)
    pytest.importorskip("OCP")
    assert mass(step.solid(part)) == pytest.approx(expected, rel=1e-12)


def test_chamfers_take_rings_of_triangles_from_a_plate():
    """A triangle with legs c at the rim R, by Pappus: 2π (R - c/3) c²/2."""
    plane = {"radius": math.inf}
    (part,) = parts_of(singlet(plane, plane), margin=1.0, chamfer=0.5)
    assert part.rim == SEMI + 1
    expected = math.pi * 13**2 * THICKNESS - 2 * 2 * math.pi * (13 - 0.5 / 3) * 0.125
    assert part.volume == pytest.approx(expected, rel=1e-12)
    assert part.edge == pytest.approx(THICKNESS - 1)
    pytest.importorskip("OCP")
    assert mass(step.solid(part)) == pytest.approx(expected, rel=1e-12)


def test_a_concave_face_ends_with_a_flat():
    """A planoconcave lens whose clear aperture is 10 of 13 mm: the plate less the cap."""
    lens = singlet({"radius": -40.0, "semi_diameter": 10.0}, {"radius": math.inf, "semi_diameter": 13.0})
    (part,) = parts_of(lens)
    s = 40 - math.sqrt(40**2 - 10**2)
    expected = math.pi * 13**2 * (THICKNESS + s) - cap(40, 10)
    assert part.volume == pytest.approx(expected, rel=1e-12)
    assert part.edge == pytest.approx(THICKNESS + s, rel=1e-13)


def test_an_asphere_is_a_spline_within_its_deviation():
    lens = asphere()
    (part,) = parts_of(lens)
    for segment in part.profile():
        if segment.face is not None:
            curve, deviation = segment.spline()
            r = np.sort(np.random.default_rng(0).uniform(0, SEMI, 5000))
            assert np.abs(curve(r) - segment.face.z(r)).max() <= 1.01 * deviation <= 1.01 * DEVIATION
    table = rt.sag(lens, 1, step=3.0)
    assert part.faces[0].z(table.radii.numpy()) == pytest.approx(table.sag.numpy(), abs=1e-14)
    pytest.importorskip("OCP")
    assert mass(step.solid(part)) == pytest.approx(part.volume, abs=2 * DEVIATION * math.pi * SEMI**2)


def test_elements_behind_a_mirror_and_mirrors_are_seen_along_the_light():
    primary, secondary = parts_of(rt.read_lens("hubble"), substrate=300.0)
    assert primary.faces[0].curvature < 0 < secondary.faces[0].curvature  # concave, then convex
    assert primary.thickness == 300
    assert secondary.edge == pytest.approx(300)


# -- indications


def test_indications_follow_from_tolerances():
    lens = singlet()
    words = rt.draw(lens, limits="radius:1=0.2% power:2=-4..3 irregularity=0.5 wedge=0.02 conic:1=0.01").indications
    (part,) = parts_of(lens)
    front, back = part.faces
    assert words.radius(front, "CX") == "R 50 CX ± 0.1"
    fringe = 0.6328 / 0.54607
    assert words.form(front) == f"3/–({0.5 * fringe:.3g})"
    assert words.form(back) == f"3/{4 * fringe:.3g}({0.5 * fringe:.3g})"
    assert words.centring(front) == "4/ –"
    assert words.tilt(back) == pytest.approx(math.degrees(math.atan(0.02 / (2 * SEMI))), rel=1e-12)
    assert words.centring(back) == "4/2.9′"
    assert words.others(part) == ["conic of surface 1: -0.01 to 0.01"]
    assert stated("0/20 1/3x0.16 2/1;1") == {"0": "0/20", "1": "1/3×0.16", "2": "2/1;1"}


def test_radial_tolerances_are_on_the_sheets():
    """The magnitudes of the grade, whose figures along x and y they replace."""
    drawings = rt.draw("cooke_triplet", elements=[1], grade="precision", radial=True)
    assert drawings.indications.mounting(1, 2) == ("0.05 radial", "3′ radial")
    assert rt.draw("cooke_triplet", grade="precision").indications.mounting(1, 2) == ("± 0.05", "± 3′")
    texts = [text for *_, text, _ in drawings.sheet(1).texts]
    assert "decentre in the mount 0.05 radial" in texts
    table = rt.tolerances(rt.read_lens("cooke_triplet"), grade="precision", radial=True)
    assert drawings.indications.radial == {
        (error.name, table[first].surfaces): error.magnitude for first, error in table.radial.items()
    }
    with pytest.raises(rt.BadTolerance, match=r"radial.* goes with .*grade.* or .*limits"):
        rt.draw("cooke_triplet", radial=True)


@pytest.mark.parametrize(
    ("length", "limit", "text"),
    [(8.74664, 0.05, "8.747 ± 0.05"), (8.74664, 0.2, "8.75 ± 0.2"), (8.74664, 5, "8.75 ± 5"), (14, 0.05, "14 ± 0.05"),
     (8.74664, 0.01, "8.747 ± 0.01"), (0.2494321, 0.001, "0.2494 ± 0.001"), (8.74664, None, "8.747")],
)  # fmt: skip
def test_a_length_is_printed_to_a_tenth_of_its_tolerance(length, limit, text):
    row = None if limit is None else rt.system.Tolerance("thickness", (1,), -limit, limit)
    assert toleranced(length, row) == text


def test_diameters_are_rounded_up_in_drawings_and_solids():
    """A fixed mechanical diameter is as in the file, and no clear one is larger."""
    exact = rt.tracing.geometry.semi_diameters(rt.read_lens("phone"))
    for part in parts_of(rt.read_lens("phone")):
        for face in part.faces:
            assert exact[face.number] <= face.clear < exact[face.number] + 0.005
            assert 100 * 2 * face.clear == pytest.approx(round(100 * 2 * face.clear), abs=1e-9)
            assert part.rim >= face.clear
    (part,) = parts_of(singlet({"semi_diameter": 9.6212}, {"semi_diameter": 4.0}), margin=1.0)
    assert (part.faces[0].clear, part.rim) == (9.625, 10.625)
    fixed = singlet({"semi_diameter": 9.6212, "mechanical_semi_diameter": 9.6212}, {"semi_diameter": 0.30011})
    (part,) = parts_of(fixed)
    assert (part.faces[0].clear, part.faces[1].clear, part.rim) == (9.6212, 0.3005, 9.6212)
    texts = [text for *_, text, _ in rt.draw(fixed, elements=[1]).sheet(1).texts]
    assert {"⌀ 19.2424", "⌀e 19.2424", "⌀e 0.601"} <= set(texts)


# -- sheets


@pytest.mark.parametrize(("name", "sheet"), [("double_gauss", 1), ("double_gauss", 2), ("phone", 4), ("hubble", 3)])
def test_texts_of_a_sheet_do_not_overlap(name, sheet):
    figure = rt.draw(name, elements=[], grade="precision", date="2026-11-29").draw(sheet)
    renderer, width = figure.canvas.get_renderer(), figure.bbox.width
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in figure.axes[0].texts if text.get_text()]
    for (first, a), (second, b) in itertools.combinations(boxes, 2):
        assert not a.padded(-2).overlaps(b.padded(-2)), (first, second)
    for text, box in boxes:
        assert box.x0 > 0.02 * width, text
        assert box.x1 < 0.98 * width, text


def test_an_element_is_drawn_to_the_scale_of_its_title_block():
    (paper,) = rt.draw(singlet(), elements=[1], margin=0.5).sheets()
    (scale,) = (re.fullmatch(r"Scale (\d+) : 1", text)[1] for *_, text, _ in paper.texts if text.startswith("Scale"))
    (outline,) = (points for points, kind in paper.lines if kind == "outline")
    assert np.ptp(outline[1]) == pytest.approx(int(scale) * 2 * 12.5, rel=1e-12)
    assert np.ptp(outline[0]) == pytest.approx(int(scale) * THICKNESS, rel=1e-12)
    assert any(text == "⌀ 25" for *_, text, _ in paper.texts)


def test_files_have_a_page_a_sheet_and_come_back_the_same(tmp_path):
    drawings = rt.draw("cemented_achromat", elements=[])
    names = [paper.title for paper in drawings.sheets()]
    assert names == ["Assembly", "Element 1", "Element 2", "Cemented elements 1, 2"]
    contents = []
    for name in ("a.pdf", "b.pdf"):
        rt.draw("singlet", elements=[], date="2026-11-29").save(tmp_path / name)
        contents.append((tmp_path / name).read_bytes())
    assert contents[0] == contents[1]
    assert len(re.findall(rb"/Type /Page\b", contents[0])) == 2
    rt.draw("singlet").save(tmp_path / "one.svg")
    drawings.save(tmp_path / "parts.csv")
    assert {path.name for path in tmp_path.iterdir()} == {"a.pdf", "b.pdf", "one.svg", "parts.csv"}
    assert drawings.to_frame().thickness.tolist() == [4.0, 2.5]


def test_the_assembly_has_the_stop_and_sheets_the_names_of_elements():
    lens = rt.edit.rename(rt.read_lens("cooke_triplet"), comments={1: "front crown"})
    assembly, element, *_ = rt.draw(lens, elements=[]).sheets()
    texts = [text for *_, text, _ in assembly.texts]
    assert (
        texts[texts.index(f"stop, surface {lens.stop}") + 1]
        == f"⌀ {2 * rt.tracing.geometry.semi_diameters(lens)[lens.stop]:.3f}"
    )
    assert any(text == "Element 1: front crown" for *_, text, _ in element.texts)
    at_a_face = rt.draw("cemented_achromat").sheets()[0]
    assert not any(text.startswith("stop,") for *_, text, _ in at_a_face.texts)


def test_the_command_writes_a_sheet(command):
    code, out, err = command(
        "draw", "singlet", "--elements", 1, "--grade", "high", "--date", "2026-11-29", "-o", "1.svg"
    )
    assert code == 0, err
    assert "Optimax Systems" in out
    assert Path("1.svg").stat().st_size > 10_000


# -- files of CAD


def test_a_dxf_file_has_exact_arcs_on_layers(tmp_path):
    ezdxf = pytest.importorskip("ezdxf")
    paths = tmp_path / "a.dxf", tmp_path / "b.dxf"
    for path in paths:
        rt.draw(singlet(), elements=[1]).save(path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    document = ezdxf.readfile(paths[0])
    assert document.units == ezdxf.units.MM
    assert set(dxf.LAYERS) <= {layer.dxf.name for layer in document.layers}
    arcs = document.modelspace().query("ARC")
    assert sorted(arc.dxf.radius for arc in arcs) == pytest.approx([50, 50, 80, 80], rel=1e-14)
    for arc in arcs:
        heights = sorted(abs(point.y) for point in (arc.start_point, arc.end_point))
        assert heights == pytest.approx([0, SEMI], abs=1e-9)
    rt.draw(asphere(), elements=[1]).save(paths[0])
    splines = ezdxf.readfile(paths[0]).modelspace().query("SPLINE")
    (part,) = parts_of(asphere())
    shift = -min(part.faces[0].z(np.linspace(0, SEMI, 500)).min(), 0)
    points = np.array([list(point)[:2] for point in splines[0].construction_tool().approximate(200)])
    assert points[:, 0] - shift == pytest.approx(part.faces[0].z(np.abs(points[:, 1])), abs=2 * DEVIATION)


def read(path):
    from OCP.STEPControl import STEPControl_Reader

    reader = STEPControl_Reader()
    reader.ReadFile(str(path))
    reader.TransferRoots()
    return reader.OneShape()


def test_a_step_file_has_the_parts_at_their_places(tmp_path):
    pytest.importorskip("OCP")
    from OCP.BRepGProp import BRepGProp
    from OCP.GProp import GProp_GProps

    paths = tmp_path / "a.step", tmp_path / "b.step"
    for path in paths:
        drawings = rt.draw("folded_relay", margin=0.5)
        drawings.save(path)
    assert paths[0].read_bytes() == paths[1].read_bytes()
    shape = read(paths[0])
    assert mass(shape) == pytest.approx(sum(part.volume for part in drawings.parts), rel=1e-9)
    assert "PRODUCT('Folded relay, 1:1'" in paths[0].read_text()
    properties, centre = GProp_GProps(), np.zeros(3)
    BRepGProp.VolumeProperties_s(shape, properties, 1e-10)
    frames = rt.tracing.geometry.frames(drawings.lens)
    total = 0.0
    for part in drawings.parts:  # the centre of mass of every part is on its axis
        r, w = np.polynomial.legendre.leggauss(200)
        r, w = 0.5 * part.rim * (r + 1), 0.5 * part.rim * w
        front, back = part.ends(r)
        z = math.pi * (w * r) @ (back**2 - front**2) / part.volume
        frame = frames[part.surfaces[0]]
        place = frame.origin.numpy() + part.faces[0].side * z * frame.axes[:, 2].numpy()
        centre += part.volume * place
        total += part.volume
    found = properties.CentreOfMass()
    assert [found.X(), found.Y(), found.Z()] == pytest.approx((centre / total).tolist(), abs=1e-6)


def test_an_aperture_cuts_its_mirror():
    pytest.importorskip("OCP")
    mirror = {"radius": math.inf, "thickness": -50, "glass": "MIRROR", "semi_diameter": 20.0}
    rectangle = rt.system.Aperture("rectangular", (8.0, 5.0), centre=(2.0, 3.0))
    lens = rt.lens([mirror | {"apertures": (rectangle,)}], stop=1, entrance_pupil_diameter=5)
    (part,) = parts_of(lens, substrate=4.0)
    assert mass(step.solid(part)) == pytest.approx(4 * 8 * 5 * 4, rel=1e-12)
    assert math.isnan(part.volume)


@pytest.mark.parametrize(("suffix", "library"), [(".dxf", "ezdxf"), (".step", "OCP")])
def test_a_missing_extra_is_named(suffix, library, monkeypatch, tmp_path):
    for name in [name for name in sys.modules if name.split(".")[0] == library]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(rt.MissingExtra, match=r"pip install 'raytrace\[cad\]'"):
        rt.draw(singlet()).save(tmp_path / f"lens{suffix}")


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"elements": [2]}, "expected numbers from 1 to 1"),
        ({"indications": "7/3"}, "expected one of 0/…, 1/…"),
        ({"indications": "3/2(1)"}, "3/ and 4/ follow from the tolerances"),
        ({"chamfer": 4.0}, "no glass is left at its rim"),
        ({"chamfer": -1.0}, "expected a length of 0 mm or more"),
        ({"substrate": 0.0}, "expected a length above 0 mm"),
    ],
)
def test_requests_that_cannot_be_drawn_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        rt.draw(singlet(), **options)


def test_what_is_no_solid_of_revolution_is_reported():
    with pytest.raises(ValueError, match="nothing to draw"):
        rt.draw("cylinder_pair")
    text = str(rt.draw("spectrometer"))
    assert "not drawn: a thin structure, without glass" in text
    with pytest.raises(ValueError, match="element 3 is not drawn"):
        rt.draw("spectrometer", elements=[3])
    with pytest.raises(NoSolid, match="positive edge"):
        rt.draw(singlet({"thickness": 1.0}))


def test_every_file_of_several_sheets_is_reported(run, tmp_path):
    outcome = run("draw", "cooke_triplet", "--elements", "1", "2", "-o", tmp_path / "parts.svg")
    assert sorted(path.name for path in tmp_path.glob("*.svg")) == ["parts_1.svg", "parts_2.svg"]
    assert [f"parts_{k}.svg" in outcome.err for k in (1, 2)] == [True, True]
    assert "parts.svg" not in outcome.err

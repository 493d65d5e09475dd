"""Parts of vendors: figures by closed forms, an index that suffices alone, and parts in a lens."""

import dataclasses
import json
import math
import shutil
import sqlite3

import pytest
from problems import SHARED
from problems_zemax import archive
from torch.testing import assert_close

import raytrace as rt
from raytrace.agents.tools import TOOLS
from raytrace.agents.worker import answer
from raytrace.cli import main
from raytrace.edit.parts import turned_part
from raytrace.materials.agf import Catalog, write_agf
from raytrace.stock.parts import part_surfaces

CORPUS = SHARED / "corpus" / "zmx"
N_BK7 = 1.5168000345005885  # Sellmeier's equation at 0.5875618 µm

PLANO_CONVEX = [dict(radius=25.84, thickness=4, glass="N-BK7"), dict(thickness=45)]
MENISCUS = [dict(radius=30, thickness=3, glass="N-SF11"), dict(radius=60, thickness=45)]
WINDOW = [dict(thickness=3, glass="N-BK7"), dict(thickness=45)]
MIRROR = [dict(radius=-100, thickness=-50, glass="MIRROR")]


def achromat(f: float, thicknesses=(4.0, 2.0)) -> list[dict]:
    """A cemented lens of thin-lens powers V₁/(V₁ - V₂) and -V₂/(V₁ - V₂), with an equiconvex crown."""
    (n1, v1), (n2, v2) = (N_BK7, 64.17), (1.672707, 32.25)  # N-BK7, N-SF5
    c1 = v1 / (v1 - v2) / f / (n1 - 1) / 2
    c3 = -c1 + v2 / (v1 - v2) / f / (n2 - 1)
    radii = [1 / c for c in (c1, -c1, c3)]
    glasses = [dict(thickness=thicknesses[0], glass="N-BK7"), dict(thickness=thicknesses[1], glass="N-SF5"), {}]
    return [{"thickness": 0.9 * f} | glass | {"radius": radius} for radius, glass in zip(radii, glasses, strict=True)]


def lens_of(rows, diameter: float = 12.0, **options) -> rt.Lens:
    rows = [row | {"semi_diameter": diameter / 2} for row in rows]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=0.8 * diameter, **options)


@pytest.fixture
def folder(tmp_path):
    """A vendor's folder: three parts, one of them in an archive, and files without a part."""
    inside = tmp_path / "vendor"
    (inside / "doublets").mkdir(parents=True)
    rt.write_lens(lens_of(PLANO_CONVEX, name="Plano-convex, by Edmund"), inside / "PX-50.zmx")
    rt.write_lens(lens_of(MENISCUS, 25.0), inside / "M-80.zmx")
    rt.write_lens(lens_of(achromat(50)), tmp_path / "lens.zmx")
    content = {"AC-50.ZMX": (tmp_path / "lens.zmx").read_bytes()}
    (inside / "doublets" / "AC-50.zar").write_bytes(archive(content))
    rt.write_lens(lens_of(WINDOW), inside / "window.zmx")
    rt.write_lens(lens_of(MIRROR), inside / "mirror.zmx")
    rt.write_lens(lens_of(PLANO_CONVEX), inside / "doublets" / "PX-50.zmx")  # once more
    (inside / "damaged.zmx").write_text("SURF 0\n  CURV x\n")
    (inside / "readme.pdf").write_text("none of them")
    return inside


@pytest.fixture
def index(folder, tmp_path):
    file = tmp_path / "stock.sqlite"
    rt.stock_index(folder, file)
    return file


# -- the index ---------------------------------------------------------------------------------------------------------


def test_figures_of_parts_are_those_of_closed_forms(index):
    (part,) = rt.stock_find(index, part="px-50").parts
    f = 25.84 / (N_BK7 - 1)
    assert part.figures.efl == pytest.approx(f, rel=1e-9)
    assert part.figures.bfl == pytest.approx(f - 4 / N_BK7, rel=1e-9)
    assert (part.figures.diameter, part.figures.thickness) == (12, 4)
    assert (part.figures.shape, part.figures.glasses, part.figures.elements) == ("plano-convex", "N-BK7", 1)
    assert part.figures.vendor == "Edmund Optics"
    assert part.figures.abbe == pytest.approx(64.17, abs=0.01)
    (meniscus,) = rt.stock_find(index, shape="meniscus").parts
    n, t = 1.78472, 3
    power = (n - 1) * (1 / 30 - 1 / 60) + (n - 1) ** 2 * t / (n * 30 * 60)
    assert meniscus.figures.efl == pytest.approx(1 / power, rel=1e-5)


def test_files_without_a_part_are_listed_with_the_reason(folder, tmp_path):
    made = rt.stock_index(folder, tmp_path / "stock.sqlite")
    assert {part.part for part in made.parts} == {"PX-50", "M-80", "AC-50"}
    reasons = dict(made.unread)
    assert reasons.pop("damaged.zmx").startswith("1, surface 0: 1 surfaces, expected")
    assert reasons == {
        "window.zmx": "no power: a window or a prism",
        "mirror.zmx": "a mirror",
        "doublets/PX-50.zmx": "part PX-50 is in another file too",
    }
    assert "a mirror" in str(made)


def test_the_index_suffices_alone(folder, index):
    shutil.rmtree(folder)
    for rows, name in ((PLANO_CONVEX, "PX-50"), (achromat(50), "AC-50")):
        (part,) = rt.stock_find(index, part=name).parts
        for stored, made in zip(part_surfaces(part.lens), part_surfaces(lens_of(rows)), strict=True):
            assert_close(stored.thickness, made.thickness, rtol=0, atol=0)
            assert_close(stored.radius, made.radius, rtol=1e-15, atol=0)
            assert (stored.glass.name, stored.semi_diameter) == (made.glass.name, made.semi_diameter)


def test_glasses_of_a_catalog_in_the_folder_are_in_the_index(tmp_path):
    own = tmp_path / "vendor"
    own.mkdir()
    glass = dataclasses.replace(rt.materials.find_glass("N-BK7"), name="OWN-1", catalog="OWN", listed_name="")
    write_agf(Catalog("OWN", {"OWN-1": glass}), own / "own.agf")
    lens = lens_of([PLANO_CONVEX[0] | {"glass": glass}, PLANO_CONVEX[1]])
    rt.write_lens(dataclasses.replace(lens, catalogs=("OWN",)), own / "PX.zmx", catalogs=[own / "own.agf"])
    rt.stock_index(own, tmp_path / "own.sqlite")
    shutil.rmtree(own)
    (part,) = rt.stock_find(tmp_path / "own.sqlite").parts
    assert part.lens.surfaces[1].glass.name == "OWN-1"
    assert float(rt.first_order(part.lens).effective_focal_length) == pytest.approx(25.84 / (N_BK7 - 1), rel=1e-9)


def test_parts_are_found_by_ranges_and_sorted_by_distance(index):
    assert [part.figures.part for part in rt.stock_find(index).parts] == ["PX-50", "AC-50", "M-80"]
    near = rt.stock_find(index, efl=50, diameter=12)
    offs = [100 * (abs(part.figures.efl / 50 - 1) + abs(part.figures.diameter / 12 - 1)) for part in near.parts]
    assert [part.distance for part in near.parts] == pytest.approx(sorted(offs))
    assert [part.figures.part for part in rt.stock_find(index, achromat=True).parts] == ["AC-50"]
    assert [part.figures.part for part in rt.stock_find(index, efl="60..100").parts] == ["M-80"]
    assert [part.figures.part for part in rt.stock_find(index, diameter=(20, 30)).parts] == ["M-80"]
    assert [part.figures.part for part in rt.stock_find(index, glass=["n-sf5", "N-BK7"]).parts] == ["AC-50"]
    assert [part.figures.part for part in rt.stock_find(index, elements=2).parts] == ["AC-50"]
    assert rt.stock_find(index, efl=45, tolerance=5).parts == ()
    assert len(rt.stock_find(index, efl=45, tolerance=15).parts) == 2
    frame = near.to_frame()
    assert list(frame.part) == [part.figures.part for part in near.parts]
    for wrong in ("50mm", "60..50", 0.0, float("inf")):
        with pytest.raises(rt.BadStock, match=r"expected a length in mm, as 50, or a range"):
            rt.stock_find(index, efl=wrong)


def test_a_table_of_parts_is_read(tmp_path):
    table = tmp_path / "parts.csv"
    table.write_text(
        "part,radius_1,thickness_1,glass_1,radius_2,thickness_2,glass_2,radius_3,diameter,vendor,coating\n"
        "P1,25.84,4,N-BK7,inf,,,,12,Own,MgF2\n"
        "P2,30,5,N-BK7,-25,2,N-SF5,-80,25,,\n"
        "P3,30,5,N-BK8,-25,,,,25,,\n"
        "P4,30,5,N-BK7,,,,,25,,\n"
        "P5,3o,5,N-BK7,-25,,,,25,,\n"
    )
    made = rt.stock_index(table, tmp_path / "own.sqlite")
    assert [(part.part, part.vendor, part.coating, part.shape) for part in made.parts] == [
        ("P1", "Own", "MgF2", "plano-convex"),
        ("P2", "", "", "doublet"),
    ]
    assert made.parts[0].efl == pytest.approx(25.84 / (N_BK7 - 1), rel=1e-9)
    reasons = dict(made.unread)
    assert "did you mean N-BK7" in reasons["P3.zmx"] or "N-BK8" in reasons["P3.zmx"]
    assert reasons["P4.zmx"] == "parts.csv:5: expected radius_2, the last face, behind glass_1"
    assert reasons["P5.zmx"] == "parts.csv:6, radius_1: '3o' is no number"
    table.write_text("part,radius_1,thicknes_1,glass_1,radius_2\n")
    with pytest.raises(rt.BadStock, match=r"parts\.csv:1: no column 'thicknes_1'"):
        rt.stock_index(table, tmp_path / "own.sqlite")


def test_no_index_is_refused_in_words(index, tmp_path):
    with pytest.raises(rt.BadStock, match=r"none\.sqlite: no such index of stock; `raytrace stock index FOLDER"):
        rt.stock_find(tmp_path / "none.sqlite")
    (tmp_path / "text.sqlite").write_text("no database at all, of any kind")
    with pytest.raises(rt.BadStock, match=r"text\.sqlite: no index of stock \(file is not a database\)"):
        rt.stock_find(tmp_path / "text.sqlite")
    with sqlite3.connect(index) as database:
        database.execute("PRAGMA user_version = 9")
    with pytest.raises(rt.BadStock, match="version 9 of an index of stock, expected 1; make it again"):
        rt.stock_find(index)
    before = index.read_bytes()
    (tmp_path / "empty").mkdir()
    with pytest.raises(rt.BadStock, match=r"empty: no part in 0 files; expected files \.zmx, \.zar"):
        rt.stock_index(tmp_path / "empty", index)
    assert index.read_bytes() == before
    with pytest.raises(rt.BadStock, match="no such folder; expected a folder of lens files, or a table"):
        rt.stock_index(tmp_path / "nowhere", index)


@pytest.mark.needs(CORPUS)
def test_files_of_vendors_have_their_listed_figures(tmp_path):
    """The focal lengths and diameters that the titles of the files state."""
    vendor = tmp_path / "vendor"
    vendor.mkdir()
    for name in (
        "RayTracing__AC254-125-A-Zemax_ZMX_",
        "Kraken-Optical-Simulator__zmax_84383",
        "octave-wagenaarlab__AL108-A",
    ):
        shutil.copy(CORPUS / f"{name}.zmx", vendor)
    shutil.copy(CORPUS / "optiland__thorlabs_lj1598l1.zmx", vendor)
    rt.stock_index(vendor, tmp_path / "stock.sqlite")
    parts = {part.figures.part: part.figures for part in rt.stock_find(tmp_path / "stock.sqlite").parts}
    listed = {
        "AC254-125-A": ("Thorlabs", 125.0, 25.4, "doublet", "N-BK7 N-SF5", "THORA"),
        "84383": ("Edmund Optics", -6.0, 3.0, "plano-concave", "N-SF11", "EO_NIRI_785"),
        "AL108-A": ("Thorlabs", 8.0, 10.0, "aspheric plano-convex", "S-LAH64", "THORA"),
    }
    for name, (vendor_of, efl, diameter, *texts) in listed.items():
        assert (parts[name].vendor, parts[name].diameter) == (vendor_of, diameter)
        assert parts[name].efl == pytest.approx(efl, rel=1e-3)
        assert [parts[name].shape, parts[name].glasses, parts[name].coating] == texts
    assert parts["LJ1598L1"].shape == "cylindrical plano-convex"
    assert [name for name, part in parts.items() if part.is_achromat] == ["AC254-125-A"]


# -- parts in a lens ---------------------------------------------------------------------------------------------------


def test_a_part_turned_twice_is_the_part():
    faces = part_surfaces(lens_of(achromat(50)))
    again = turned_part(turned_part(faces))
    for face, same in zip(faces, again, strict=True):
        assert_close(face.radius, same.radius, rtol=1e-15, atol=0)
        assert (float(face.thickness), face.glass) == (float(same.thickness), same.glass)


def test_an_inserted_part_is_that_of_the_file_or_turned(index):
    (part,) = rt.stock_find(index, part="AC-50").parts
    stop = rt.lens([dict(thickness=10)], stop=1, entrance_pupil_diameter=5)
    as_listed = rt.edit.insert_part(stop, 2, part)
    turned = rt.edit.insert_part(stop, 2, part, reverse=True, gap=7)
    assert [surface.comment for surface in as_listed.surfaces] == ["", "", "AC-50", "", "", ""]
    own = rt.first_order(part.lens)
    f = float(own.effective_focal_length)
    for lens, ends in ((as_listed, ("front", "rear")), (turned, ("rear", "front"))):
        data = rt.first_order(lens)
        assert float(data.effective_focal_length) == pytest.approx(f, rel=1e-12)
        planes = {"front": -own.front_principal_plane, "rear": own.rear_principal_plane}
        assert float(data.rear_principal_plane) == pytest.approx(float(planes[ends[1]]), rel=1e-9)
    assert float(turned.surfaces[-2].thickness) == 7
    again = rt.edit.reverse(turned, "AC-50")
    for k in range(2, 5):
        assert_close(again.surfaces[k].radius, as_listed.surfaces[k].radius, rtol=1e-15, atol=0)


def test_rows_and_variables_follow_an_inserted_part(index):
    (part,) = rt.stock_find(index, part="PX-50").parts
    lens = rt.read_lens("cooke_triplet").with_conditions("thickness:7>=70")
    new = rt.edit.insert_part(lens, 6, part, gap=1)
    rows = [row.integers for row in new.optimization_data.merit if row.operand == "TTHI"]
    assert rows == [(9, 9)]
    assert {6, 7} <= {*new.optimization_data.semi_diameters}
    with pytest.raises(rt.BadEdit, match="SK4 is before surface 2; parts are in air"):
        rt.edit.insert_part(lens, 2, part)


def test_a_part_of_the_same_power_in_place_of_an_element_keeps_the_focal_length(tmp_path):
    """Of an object at infinity, as the principal planes stay where they are."""
    lens = rt.read_lens("cooke_triplet")
    element = [dict(radius=204.52, thickness=5.9, glass="N-SK16"), dict(radius=-37.05, thickness=70)]
    for k, radius in ((6, 204.52), (7, -37.05)):
        lens = lens.replace(k, radius=radius, **({"glass": "N-SK16"} if k == 6 else {}))
    bent = rt.edit.bend(rt.lens(element, stop=1, entrance_pupil_diameter=20), "1-2", 1.0)
    rt.write_lens(bent, tmp_path / "bent.zmx")
    for reverse in (False, True):
        new = rt.edit.replace_part(lens, "6-7", tmp_path / "bent.zmx", reverse=reverse)
        assert_close(
            rt.first_order(new).effective_focal_length, rt.first_order(lens).effective_focal_length, rtol=1e-10, atol=0
        )
        assert new.surfaces[6].comment == "bent"
        image = [float(rt.first_order(each).back_focal_distance - each.surfaces[7].thickness) for each in (lens, new)]
        assert image[1] == pytest.approx(image[0], abs=1e-9)
    with pytest.raises(rt.BadEdit, match="3-5: is no single element"):
        rt.edit.replace_part(lens, "3-5", tmp_path / "bent.zmx")


def test_the_commands_index_find_and_insert(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["stock", "index", "vendor"]) == 0
    out, err = capsys.readouterr()
    assert "stock.sqlite: 3 parts" in out
    assert "written: stock.sqlite" in err
    assert main(["stock", "find", "--efl", "50", "--diameter", "12", "--achromat", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert [entry["part"] for entry in document["results"]] == ["AC-50"]
    assert math.isclose(document["results"][0]["efl"], 50, rel_tol=0.05)
    assert main(["stock", "find", "--efl", "45..55", "-o", "found.csv"]) == 0
    assert (tmp_path / "found.csv").read_text().count("\n") == 3
    words = ["cooke_triplet", "--insert-part", "8", "ac-50", "reversed", "gap=2", "-o", "with_part.zmx"]
    assert main(["edit", *words]) == 0
    assert [surface.comment for surface in rt.read_lens("with_part.zmx").surfaces[8:11]] == ["AC-50", "", ""]
    capsys.readouterr()
    assert main(["edit", "cooke_triplet", "--insert-part", "8", "AC-51", "-o", "x.zmx"]) == 1
    assert "no part 'AC-51' among 3; did you mean AC-50?" in capsys.readouterr().err


def test_agents_find_parts(folder, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert {"stock_index", "stock_find"} <= {*TOOLS}
    made = answer("stock_index", {"folder": "vendor"})
    assert not made["is_error"], made["text"]
    found = answer("stock_find", {"efl": 50, "achromat": True, "json": True})
    assert [entry["part"] for entry in found["document"]["results"]] == ["AC-50"]
    again = answer("stock_index", {"folder": "vendor"})
    assert again["is_error"]
    assert again["text"] == "`output`: stock.sqlite exists; give another name, or `overwrite`"

"""Remarks of the prescription on surfaces that are not conics; poses of typed rows."""

from functools import partial

import pytest
import torch
from problems_zemax_types import CASES, read, text

import raytrace as rt
from raytrace.tracing.lens_report import entries, remarks

REMARKS = {
    "standard": [],
    "break": ["coordinate break", "decentre x 1.5 y -2 mm", "tilt x 7° y -5° z 11°"],
    "break of order 1": ["coordinate break", "tilt x 7° y -5° z 11°", "decentre x 1.5 y -2 mm"],
    "grating": ["grating of 0.3 lines/µm, order -1"],
    "ideal lens": ["ideal lens, f 37.3 mm"],
    "crossed ideal lens": ["ideal lens, f 50 mm in x, -76.9231 mm in y"],
    "binary 2": ["binary 2 over 10 mm, order 2"],
    "hologram": ["hologram of 0.55 µm, order 1"],
    "tilted": ["plane with slopes 0.2, -0.35"],
    "toroid": ["toroidal", "radius x -60"],
    "cylinder": ["toroidal", "radius x inf"],
    "biconic": ["biconic", "radius x 30", "conic x 0.4"],
    "tilts first": ["before: tilt x -2° y 5° z 10°", "decentre x 0.5 y 0.1 mm", "behind: tilt x 30° y 10°"],
}


@pytest.mark.parametrize("name", REMARKS)
def test_a_surface_is_described_in_the_words_of_the_field(name):
    lens = read(text(name))[0]
    assert remarks(lens.surfaces[2]) == REMARKS[name]
    row = str(rt.info(lens)).split("\n")[-3]
    assert row.endswith(", ".join([*(["conic -0.4"] if name == "standard" else []), *REMARKS[name], "the second"])) or (
        ", ".join(REMARKS[name]) in row and name in ("toroid", "biconic")  # their conic comes first
    )
    assert (row.split()[1] == "-") == ("break" in name)


@pytest.mark.parametrize("name", CASES)
def test_every_type_has_its_entries_in_the_document(name):
    lens = read(text(name))[0]
    known = {
        "surface",
        "curvature",
        "conic",
        "coefficients",
        "thickness",
        "glass",
        "indices",
        "semi_diameter",
        "semi_diameter_is_fixed",
        "chip_zone",
        "mechanical_semi_diameter",
        "mechanical_semi_diameter_is_fixed",
        "comment",
    }
    found = rt.info(lens).document()["surfaces"]
    assert found[1].keys() == known
    assert found[2].keys() - known == entries(lens.surfaces[2]).keys()
    assert ("is_break" in found[2]) == ("break" in name)


def test_a_document_holds_the_numbers_of_a_phase_and_a_pose():
    found = rt.info(read(text("tilted grating"))[0]).document()["surfaces"][2]
    assert found["phase"] == {"kind": "Grating", "frequency": 0.3, "order": -1.0}
    pose = {"x": 0.3, "y": -0.2, "tilt_x": 4.0, "tilt_y": -3.0, "tilt_z": 25.0, "tilts_first": False}
    assert found["before"] == pose


def test_the_glass_column_of_info_has_the_figures_of_a_medium_without_a_name():
    rows = [
        dict(radius=50, thickness=5, glass=(1.62, 36.4)),
        dict(radius=-60, thickness=1, glass=1.5),
        dict(radius=-70, thickness=9, glass="N-BK7"),
        dict(radius=-80, thickness=70),
    ]
    found = rt.info(rt.lens(rows, stop=1, f_number=9))
    assert found.words()["glass"] == ["", "1.62/36.4", "n 1.5", "N-BK7", "", ""]
    assert [row["glass"] for row in found.document()["surfaces"]] == [None, "1.62/36.4", "n 1.5", "N-BK7", None, None]
    assert all(label in str(found) for label in ("1.62/36.4 ", "n 1.5 ", "N-BK7 "))


def test_a_typed_row_takes_the_numbers_of_its_poses():
    """By the names of variables; the same lens as with values of Pose, and its derivatives."""
    tilt = torch.tensor(1.5, dtype=torch.float64, requires_grad=True)
    posed = dict(x=0.2, y=-0.3, tilt_x=tilt, tilt_z=20, tilts_first=True, y_after=0.3, tilt_x_after=-1.5)
    rows = [dict(radius=50, thickness=5, glass="N-BK7", **posed), dict(radius=-60, thickness=70)]
    lens = rt.lens(rows, stop=1, f_number=9, fields=[0, 2])
    number = partial(torch.tensor, dtype=torch.float64)
    before = rt.system.Pose(x=number(0.2), y=number(-0.3), tilt_x=tilt, tilt_z=number(20.0), tilts_first=True)
    after = rt.system.Pose(y=number(0.3), tilt_x=number(-1.5))
    plain = rt.lens(
        [{k: v for k, v in row.items() if k not in posed} for row in rows], stop=1, f_number=9, fields=[0, 2]
    )
    expected = plain.replace(1, before=before, after=after)
    assert lens.surfaces[1].before.tilts_first
    centroid, wanted = (rt.spot(one).whole.centroid for one in (lens, expected))
    assert centroid.equal(wanted)
    (slope,), (like,) = (torch.autograd.grad(part.sum(), tilt) for part in (centroid, wanted))
    assert slope == like != 0
    turned = lens.replace(1, tilt_x=2.5)  # the other numbers of the pose stay
    assert (float(turned.surfaces[1].before.tilt_x), float(turned.surfaces[1].before.y)) == (2.5, -0.3)


def test_impossible_poses_of_a_typed_row_are_refused():
    row = dict(radius=50, thickness=5)
    with pytest.raises(rt.BadPrescription, match=r"surface 1: .*before and tilt_x .*leave one out"):
        rt.lens([row | dict(before=rt.system.Pose(), tilt_x=2)], stop=1, f_number=9)
    with pytest.raises(rt.BadPrescription, match=r"surface 1 .*'tiltx'; did you mean tilt_x"):
        rt.lens([row | dict(tiltx=2)], stop=1, f_number=9)
    with pytest.raises(rt.BadPrescription, match="'steep' is not a number"):
        rt.lens([row | dict(tilt_x="steep")], stop=1, f_number=9)


def test_a_catalog_that_is_not_there_is_refused_by_its_name():
    """A list of catalogs that are not searched would take the glass from another one in silence."""
    rows = [dict(radius=50, thickness=5, glass="N-BK7"), dict(thickness=90)]
    with pytest.raises(ValueError, match=r"catalogs: 'no such file'.*SCHOTT, OHARA"):
        rt.lens(rows, stop=1, entrance_pupil_diameter=10, catalogs=["SCHOTT", "no such file"])
    assert rt.lens(rows, stop=1, entrance_pupil_diameter=10, catalogs=["nikon"]).catalogs == ("nikon",)


def test_poses_of_the_object_other_than_tilts_are_refused():
    """A tilt of the object is traced (test_launch); its place is stated by the fields and the distance."""
    rows = [dict(radius=50, thickness=5, glass="N-BK7"), dict(thickness=90)]
    near = rt.lens(rows, stop=1, entrance_pupil_diameter=10, object_distance=200, fields=[5])
    for numbers, message in (
        (dict(y=1), r"surface 0: the object is decentred \(y\)"),
        (dict(tilt_x_after=1), "surface 0: a pose behind the object"),
    ):
        with pytest.raises(ValueError, match=message):
            near.replace(0, **numbers)
    with pytest.raises(ValueError, match="surface 0: a tilted object at infinity"):
        rt.lens(rows, stop=1, entrance_pupil_diameter=10).replace(0, tilt_x=1)
    by_angle = rt.lens(rows, stop=1, entrance_pupil_diameter=10, object_distance=200, field_kind="angle", fields=[5])
    with pytest.raises(ValueError, match=r"angle.*expected object heights"):
        by_angle.replace(0, tilt_x=1)
    with pytest.raises(ValueError, match="surface 0 is tilted"):
        rt.seidel(near.replace(0, tilt_x=1))

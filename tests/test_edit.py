"""Edits of a lens: laws of scaling and of turned lenses, elements of the same power, and new numbers everywhere."""

import dataclasses
import json
import math
import warnings

import pytest
import torch
from problems import SHARED, scalar, vector
from torch.testing import assert_close

import raytrace as rt
from raytrace.cli import main
from raytrace.edit.scaling import scale
from raytrace.edit.turning import _TURNED, turned
from raytrace.optimization.operands.boundaries import BOUNDARIES
from raytrace.optimization.operands.table import OPERANDS
from raytrace.system.configurations import differences
from raytrace.system.dimensions import ARGUMENTS, DIMENSION, POWERS, scaled
from raytrace.system.elements import cemented_groups
from raytrace.system.optimization_data import OptimizationData, Row, Solve, Vary
from raytrace.system.phases import PHASES, FringePhase, Hologram, PolynomialPhase, added_path
from raytrace.system.rays import start
from raytrace.system.sag_terms import (
    SAG_TERMS,
    FringeSag,
    GridSag,
    IrregularSag,
    PolynomialSag,
    PowerSag,
    TiltSag,
    ZernikeSag,
    spline,
)
from raytrace.system.shapes import HEADS, KINDS
from raytrace.system.surface import Surface, sag_at
from raytrace.tolerancing.files import tolerances_of
from raytrace.tracing.trace import rays_at

SHIPPED = ["double_gauss", "phone", "hybrid_achromat", "cylinder_pair", "folded_relay", "spectrometer", "hubble"]


def quietly(function, *arguments, **options):
    """The result of a function, without its warnings."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rt.RaytraceWarning)
        return function(*arguments, **options)


# -- scale -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", SHIPPED)
def test_rays_of_a_scaled_lens_are_scaled(name):
    lens = rt.read_lens(name)
    larger = rt.edit.scale(lens, 1.7)
    before, after = rt.first_order(lens), rt.first_order(larger)
    for length in ("effective_focal_length", "entrance_pupil_diameter", "exit_pupil_position", "petzval_radius"):
        assert_close(getattr(after, length), 1.7 * getattr(before, length), rtol=1e-12, atol=0.0)
    assert_close(after.f_number, before.f_number, rtol=1e-12, atol=0.0)
    spots = [quietly(rt.spot, each, rings=4).rms_radius for each in (lens, larger)]
    rounding = 1e-15 * abs(float(before.effective_focal_length))
    assert_close(spots[1], 1.7 * spots[0], rtol=1e-11, atol=rounding)


def test_seidel_sums_of_a_scaled_lens_are_scaled():
    lens = rt.read_lens("cooke_triplet")
    before, after = (rt.seidel(each).to_frame() for each in (lens, rt.edit.scale(lens, 2.5)))
    for name in ("S1", "S2", "S3", "S4", "S5"):
        columns = [column for column in before if column.lower().startswith(name.lower())]
        for column in columns:
            assert_close(vector(*after[column]), 2.5 * vector(*before[column]), rtol=1e-12, atol=1e-18)


def test_a_lens_is_scaled_to_a_focal_length():
    lens = rt.edit.scale("cooke_triplet", efl=50)
    assert float(rt.first_order(lens).effective_focal_length) == pytest.approx(50, rel=1e-14)
    assert lens.name.endswith("scaled by 0.494164")
    with pytest.raises(rt.BadEdit, match="EFL of 101"):
        rt.edit.scale("cooke_triplet", efl=-50)
    with pytest.raises(rt.BadEdit, match="above 0"):
        rt.edit.scale("cooke_triplet", -1)
    with pytest.raises(rt.BadEdit, match="one of the two"):
        rt.edit.scale("cooke_triplet")


def test_derivatives_by_the_factor_are_those_of_differences():
    lens = rt.read_lens("phone")

    def spot(factor):
        return quietly(rt.spot, rt.edit.scale(lens, factor), rings=3).rms_radius.sum()

    factor = scalar(1.3).requires_grad_()
    value = spot(factor)
    (first,) = torch.autograd.grad(value, factor, create_graph=True)
    assert float(first) == pytest.approx(float(value) / 1.3, rel=1e-9)
    efl = rt.first_order(rt.edit.scale(lens, factor)).power
    (slope,) = torch.autograd.grad(efl, factor, create_graph=True)
    (second,) = torch.autograd.grad(slope, factor)
    assert float(slope) == pytest.approx(-float(efl) / 1.3, rel=1e-12)
    assert float(second) == pytest.approx(2 * float(efl) / 1.3**2, rel=1e-12)
    step = 1e-5
    difference = (spot(scalar(1.3 + step)) - spot(scalar(1.3 - step))) / (2 * step)
    assert float(first) == pytest.approx(float(difference), rel=1e-8)


X, Y = vector(0.3, -0.8, 1.1, 0.0), vector(0.9, 0.2, -0.7, -1.2)
TERMS = {
    "grid": GridSag(
        torch.randn(6, 7, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) * 1e-3, scalar(0.6)
    ),
    "noll": ZernikeSag(vector(*range(1, 16)) * 1e-3, scalar(2.0)),
    "fringe": FringeSag(vector(*range(1, 40)) * 1e-4, scalar(3.0), scalar(0.2), scalar(-0.1)),
    "powers": PolynomialSag(vector(*range(1, 15)) * 1e-3, scalar(2.0)),
    "irregular": IrregularSag(*(scalar(k) for k in (1e-3, 2e-3, 3e-3, 25.0, 2.0))),
    "tilt": TiltSag(scalar(0.01), scalar(0.02)),
    "centred": PowerSag(*(scalar(k) for k in (0.3, -0.2, 2.0, 1e-3)), vector(1, 2, 3, 4, 5, 6, 7) * 1e-3),
}
TERMS["spline"] = spline(TERMS["grid"])
SURFACES = {
    **{name: Surface(scalar(1), scalar(0.05), scalar(-0.5), sag_terms=terms) for name, terms in TERMS.items()},
    "even": Surface(scalar(1), scalar(0.05), scalar(-0.5), vector(1e-3, 2e-4, -3e-5)),
    "odd": Surface(scalar(1), scalar(0.05), scalar(-0.5), vector(1e-3, 2e-4, -3e-5), kind="odd asphere"),
    "toroidal": Surface(scalar(1), scalar(0.05), scalar(-0.5), vector(-0.02, 2e-4, -3e-5), kind="toroidal"),
    "biconic": Surface(scalar(1), scalar(0.05), scalar(-0.5), vector(-0.02, 0.7), kind="biconic"),
}


@pytest.mark.parametrize("name", SURFACES)
def test_a_surface_of_any_kind_is_scaled_and_turned(name):
    surface = SURFACES[name]
    z = sag_at(surface, X, Y)
    assert_close(sag_at(scaled(surface, 1.7), 1.7 * X, 1.7 * Y), 1.7 * z, rtol=1e-12, atol=1e-15)
    assert_close(sag_at(turned(surface), -X, Y), -z, rtol=1e-12, atol=1e-15)
    assert not [*differences(turned(turned(surface)), surface)]


@pytest.mark.parametrize(
    "phase",
    [
        PolynomialPhase(vector(*range(1, 10)), scalar(2.0), scalar(1.0)),
        FringePhase(vector(*range(1, 12)), scalar(2.0), scalar(1.0)),
        Hologram(vector(1, 2, -30), vector(-2, 1, 50), scalar(0.55), scalar(1.0)),
    ],
    ids=lambda phase: type(phase).__name__,
)
def test_a_phase_adds_the_same_path_from_either_side(phase):
    surface = Surface(scalar(1), phase=phase)
    here, there = (added_path(each.phase, x, Y, scalar(0.5)) for each, x in ((surface, X), (turned(surface), -X)))
    assert_close(there.path, here.path, rtol=1e-12, atol=1e-15)
    assert_close(there.x, -here.x, rtol=1e-12, atol=1e-15)
    larger = added_path(scaled(phase, 1.7), 1.7 * X, 1.7 * Y, scalar(0.5))
    assert_close(larger.path, 1.7 * here.path, rtol=1e-12, atol=1e-15)
    assert_close(larger.y, here.y, rtol=1e-12, atol=1e-15)


ROWS = [
    Row("TRAC", numbers=(0, 0.7, 0.3, 0.5), weight=1),
    Row("EFFL", target=90, weight=0.1),
    Row("TTHI", (1, 6), weight=0),
]
ROWS += [
    Row("OPLT", (3, 0), target=50, weight=0.2),
    Row("CVVA", (1, 0), weight=0),
    Row("RECI", (5, 0), target=30, weight=0.05),
]
ROWS += [Row("MNCA", (1, 6), target=12, weight=1), Row("DIFF", (2, 3), target=3, weight=0.1)]


def with_rows(lens, rows, **data):
    return dataclasses.replace(lens, optimization_data=OptimizationData(merit=tuple(rows), **data))


def test_a_merit_function_of_lengths_is_scaled():
    lens = with_rows(rt.read_lens("cooke_triplet"), ROWS)
    before, after = (quietly(rt.evaluate, each) for each in (lens, rt.edit.scale(lens, 2)))
    assert float(after.merit) == pytest.approx(2 * float(before.merit), rel=1e-12)


def test_frequencies_and_arithmetic_have_their_power_and_unknown_units_are_named():
    rows = [
        Row("CONS", target=3.0, weight=1),
        Row("GMTA", (3, 0), (1, 30, 0, 0), 0.5, 1),
        Row("PROD", (3, 4), target=4),
    ]
    rows = [
        *rows[:2],
        Row("EFFL", weight=0),
        Row("TOTR", weight=0),
        Row("PROD", (3, 4), target=4.0),
        Row("RWCE", target=0.1),
    ]
    lens = with_rows(rt.read_lens("cooke_triplet"), rows)
    with pytest.warns(rt.LeftAsItWas, match=r"target 3 of row 1 CONS$"):
        new = scale(lens, 2).optimization_data.merit
    assert (new[0].target, new[1].numbers[1], new[4].target, new[5].target) == (3.0, 15.0, 16.0, 0.1)


def test_rules_configurations_and_tolerances_are_scaled():
    lens = rt.read_lens("cooke_triplet").with_configurations(thickness={7: [80.0, 85.0]}, curvature={1: [0.02, 0.03]})
    solves = (
        Solve(3, "curvature", "pickup", source=1, scale=2.0, offset=0.01),
        Solve(4, "thickness", "position", (30.0,), source=1),
        Solve(7, "curvature", "power", (0.02,)),
    )
    lines = (
        "TOL TRAD 1 0 -0.2 0.3 0 0 0",
        "TOL TRAD 1 1 -0.2 0.3 0 0 0",
        "TOL TTHI 2 4 -0.1 0.1 0",
        "TOL TETX 1 2 -0.2 0.2 0",
    )
    lens = with_rows(lens, (), variables=(Vary(2, "thickness", bounds=(1.0, 9.0)),), solves=solves, tolerances=lines)
    new = rt.edit.scale(lens, 2)
    data = new.optimization_data
    assert [(solve.offset, solve.numbers, solve.scale) for solve in data.solves] == [
        (0.005, (), 2.0), (0.0, (60.0,), 1.0), (0.0, (0.01,), 1.0)]  # fmt: skip
    assert data.variables[0].bounds == (2.0, 18.0)
    limits = [(row.minimum, row.maximum) for row in tolerances_of(new)]
    assert limits == [(-0.4, 0.6), (-0.2, 0.3), (-0.2, 0.2), (-0.2, 0.2)]
    for number in (1, 2):
        efls = [float(rt.first_order(each.configuration(number)).effective_focal_length) for each in (lens, new)]
        assert efls[1] == pytest.approx(2 * efls[0], rel=1e-12)


# -- reverse -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [*SHIPPED, "off_axis_telescope", "cemented_achromat"])
def test_a_lens_reversed_twice_is_the_lens(name):
    lens = rt.read_lens(name)
    once = quietly(rt.edit.reverse, lens)
    assert [*differences(quietly(rt.edit.reverse, once), lens)] == []
    assert [*differences(once, lens)]
    efls = [abs(float(rt.first_order(each).effective_focal_length)) for each in (once, lens)]
    assert efls[0] == pytest.approx(efls[1], rel=1e-9)


def bent() -> rt.Lens:
    """An element that is decentred and tilted, of a freeform and a conic face, at a finite distance."""
    rows = [
        dict(radius=60, thickness=6, glass="N-SF11", x=0.4, tilt_y=1.0, tilt_x=-2, tilts_first=True, tilt_z_after=3.0,
             sag_terms=PolynomialSag(vector(1, 2, 3, 4, 5, 6, 7) * 1e-3, scalar(5.0))),
        dict(radius=-80, conic=-1.5, thickness=10, y=0.3, tilt_y_after=0.5),
        dict(radius=90, thickness=4, glass="N-BK7", y_after=0.2), dict(radius=-50, thickness=100),
    ]  # fmt: skip
    return rt.lens(rows, stop=2, entrance_pupil_diameter=6, object_distance=150, fields=[0, (1, 2)])


@pytest.mark.parametrize("name", ["bent", "folded_relay", "cooke_triplet"])
def test_rays_run_backwards_through_the_reversed_lens(name):
    lens = bent() if name == "bent" else rt.read_lens(name).at(object_distance=180.0, fields=[0.0, 2.0])
    back = quietly(rt.edit.reverse, lens, swap_conjugates=True)
    distance, last = lens.surfaces[0].thickness, len(lens.surfaces) - 1
    point = torch.stack([*vector(0.8, -1.3), -distance])[:, None].expand(3, 5)
    towards = torch.stack([vector(0, 1.5, -1, 0.5, 0.0), vector(0, 0.5, 1, -1.5, 1.0), 0 * vector(*range(5))])
    (there,) = rays_at(lens, lens.primary, (last,))(start(point, towards - point))
    turn = vector(-1, 1, -1)[:, None]
    gap = back.surfaces[0].thickness
    begin = start(turn * there.position - vector(0, 0, 1)[:, None] * gap, -turn * there.direction)
    (end,) = rays_at(back, back.primary, (last,))(begin)
    assert bool(there.valid.all() and end.valid.all())
    expected = turn * (point + vector(0, 0, 1)[:, None] * distance)
    assert_close(end.position, expected, rtol=0.0, atol=1e-10)


def test_swapped_conjugates_have_the_same_beam_and_fields():
    lens = rt.read_lens("cooke_triplet").at(object_distance=300.0)
    lens = lens.at(sensor_distance=float(rt.first_order(lens).paraxial_image_distance))
    back = rt.edit.reverse(lens, swap_conjugates=True)
    before, after = rt.first_order(lens), rt.first_order(back)
    assert float(before.magnification * after.magnification) == pytest.approx(1, rel=1e-9)
    assert float(after.optical_invariant) == pytest.approx(float(before.optical_invariant), rel=1e-9)
    with pytest.raises(rt.BadEdit, match="at infinity"):
        rt.edit.reverse("cooke_triplet", swap_conjugates=True)


def test_a_group_is_turned_in_its_place():
    lens = rt.read_lens("cooke_triplet")
    new = rt.edit.reverse(lens, "1-2")
    radii = [float(surface.radius) for surface in new.surfaces[1:3]]
    assert radii == [-float(lens.surfaces[2].radius), -float(lens.surfaces[1].radius)]
    assert new.surfaces[2].thickness is lens.surfaces[2].thickness
    with pytest.raises(rt.BadEdit, match="whole cemented group"):
        rt.edit.reverse("cemented_achromat", "2-3")
    with pytest.raises(rt.BadEdit, match="odd number of mirrors"):
        rt.edit.reverse("scan_lens")


def test_pickups_rows_and_tolerances_follow_a_turned_group():
    lens = rt.read_lens("cooke_triplet")
    solves = (Solve(2, "curvature", "pickup", source=1, scale=-1.0), Solve(7, "curvature", "f_number", (4.0,)),
              Solve(2, "thickness", "pickup", source=1, offset=1.0))  # fmt: skip
    lines = ("TOL TRAD 1 0 -0.2 0.3 0 0 0", "TOL TTHI 1 2 -0.1 0.1 0", "TOL TETX 1 2 -0.2 0.3 0", "TOL COMP 7 0 0 0")
    lines = (*lines, "TOL TSDY 3 0 -0.1 0.2 0", "TCMM kept")
    rows = [
        Row("CVGT", (1, 0), target=0.01, weight=1),
        Row("MNCG", (1, 5), target=2, weight=1),
        Row("SPHA", (0, 2), weight=1),
    ]
    lens = with_rows(
        lens, rows, variables=(Vary(1, "curvature", bounds=(0.01, 0.05)),), solves=solves, tolerances=lines
    )
    with pytest.warns(rt.LeftOut, match=r"reverse 1-7: .*: solve curvature of surface 7: f_number 4$"):
        new = rt.edit.reverse(lens).optimization_data
    # pickups look back: the number in front is the variable, as in files
    assert new.variables == (Vary(6, "curvature", bounds=(0.01, 0.05)),)
    assert new.solves == (
        Solve(7, "curvature", "pickup", source=6, scale=-1.0),
        Solve(6, "thickness", "pickup", source=5, offset=-1.0),
    )
    assert [(row.operand, row.integers, row.target) for row in new.merit] == [
        ("CVLT", (7, 0), -0.01), ("MNCG", (2, 6), 2), ("SPHA", (0, 2), 0.0)]  # fmt: skip
    assert new.tolerances == ("TOL TRAD 7 0 -0.3 0.2 0 0 0", "TOL TTHI 6 5 -0.1 0.1 0", "TOL MPVT 1 0 0 0 0 0 0",
                              "TOL TETX 6 7 -0.3 0.2 0", "TOL MPVT 0 0 0 0 0 0 0", "TOL COMP 7 0 0 0",
                              "TOL TSDY 5 0 -0.1 0.2 0", "TCMM kept")  # fmt: skip


# -- insert, delete, join ----------------------------------------------------------------------------------------------


def zoom() -> rt.Lens:
    """The triplet with configurations, solves, rows and tolerances of many surfaces."""
    lens = rt.read_lens("cooke_triplet").with_configurations(thickness={2: [5.0, 6.0], 4: [10.0, 9.0]})
    solves = (
        Solve(3, "curvature", "pickup", source=1, scale=-1.1),
        Solve(7, "thickness", "marginal_height", (0.0, 0.0)),
    )
    variables = (Vary(5, "curvature"), Vary(1, "thickness"), Vary(4, "thickness", 2, 1))
    lines = (
        "TOL TRAD 3 0 -0.2 0.3 0 0 0",
        "TCMM of the negative",
        "TOL TEDX 3 4 -0.1 0.1 0",
        "TOL TMCO 2 1 -0.1 0.1 0",
    )
    rows = [
        *ROWS,
        Row("MNCG", (3, 3), target=1, weight=1),
        Row("OPGT", (9, 0), target=2, weight=1),
        Row("OSUM", (2, 9)),
    ]
    return with_rows(lens, rows, variables=variables, solves=solves, tolerances=lines)


@pytest.mark.parametrize("before", [1, 3, 5, 7])
def test_a_plane_without_thickness_changes_nothing(before):
    lens = zoom()
    new = rt.edit.insert(lens, before)
    assert len(new.surfaces) == len(lens.surfaces) + 1
    values = [quietly(rt.evaluate, each) for each in (lens, new)]
    # MNCA counts the gap without thickness, too, and OSUM adds its value
    same = [k for k, row in enumerate(lens.optimization_data.merit) if row.name not in ("MNCA", "OSUM")]
    before_and_after = (vector(*each.to_frame()["value"])[same] for each in values)
    assert_close(*before_and_after, rtol=1e-10, atol=1e-10)
    for number in (1, 2):
        powers = [rt.first_order(each.configuration(number)).power for each in (lens, new)]
        assert_close(*powers, rtol=1e-13, atol=0.0)
    ends = [row.surfaces for row in tolerances_of(new)]
    assert ends == [tuple(k + (k >= before) for k in row.surfaces) for row in tolerances_of(lens)]
    assert [*differences(rt.edit.join(new, before), lens)] == []


def test_what_refers_to_a_deleted_surface_is_named_in_one_warning():
    names = ("pickup curvature of surface 3 = -1.1 × curvature of surface 1", "row 9 MNCG 3 3", "row 10 OPGT 9 0",
             "tolerance TRAD 3 0", "tolerance TEDX 3 4")  # fmt: skip
    with pytest.warns(rt.LeftOut) as messages:
        new = rt.edit.delete(zoom(), "3-4")
    (message,) = [str(each.message) for each in messages if each.category is rt.LeftOut]
    assert message.startswith("delete 3-4: left out with the surfaces: ")
    assert all(name in message for name in names), message
    data = new.optimization_data
    assert [row.name for row in data.merit] == [row.name for row in ROWS] + ["OSUM"]
    assert data.merit[-1].integers == (2, 8)
    assert data.merit[6].integers == (1, 4)
    assert data.variables[:2] == (Vary(3, "curvature"), Vary(1, "thickness"))
    assert (len(new.surfaces), new.stop) == (7, 3)
    for number, thickness in ((1, 5.0 + 10.0), (2, 6.0 + 9.0)):  # the joined gap differs as both gaps did
        inner = float(zoom().surfaces[3].thickness)
        assert float(new.configuration(number).surfaces[2].thickness) == pytest.approx(thickness + inner, rel=1e-14)


def test_a_stop_that_is_deleted_stays_as_a_plane():
    lens = rt.lens([dict(radius=50, thickness=5, glass="N-BK7"), dict(radius=-60, thickness=3),
                    dict(radius=80, thickness=4, glass="N-SF6"), dict(radius=-90, thickness=60)],
                   stop=2, entrance_pupil_diameter=5)  # fmt: skip
    new = rt.edit.delete(lens, (1, 2))
    assert (len(new.surfaces), new.stop, new.surfaces[1].is_plane, new.surfaces[1].glass.name) == (5, 1, True, "")
    assert [float(surface.thickness) for surface in new.surfaces[1:-1]] == [3, 4, 60]
    assert not math.isfinite(float(new.surfaces[0].thickness))
    with pytest.raises(rt.BadEdit, match="is the stop"):
        rt.edit.join("cooke_triplet", 5)


def test_edits_that_a_lens_does_not_allow_are_refused():
    for edit, at, words in (
        (rt.edit.delete, 9, "surfaces 9-9: this lens has surfaces 0 to 8"),
        (rt.edit.join, 1, "refracts"),
        (rt.edit.insert, 0, "in front of the object"),
        (rt.edit.split, "2-3", "no glass"),
        (rt.edit.split, "1-3", "two surfaces of one element"),
        (rt.edit.delete, "nothing", "no surface has the comment 'nothing'"),
    ):
        with pytest.raises(rt.BadEdit, match=words):
            edit("cooke_triplet", at)
    with pytest.raises(rt.BadEdit, match="is a mirror"):
        rt.edit.delete("hubble", 2)


def test_surfaces_are_chosen_by_their_comment():
    lens = rt.edit.rename("cemented_achromat", "achromat", comments={2: "Front Doublet"})
    first = next(k for k, surface in enumerate(lens.surfaces) if surface.comment == "Front Doublet")
    assert (lens.name, first) == ("achromat", 2)
    lens = rt.edit.rename(lens, comments={"front doublet": "", 1: "front doublet"})
    whole = rt.edit.reverse(lens, "front doublet")
    assert [*differences(whole, rt.edit.reverse(lens, "1-3"))] == []


# -- split and bend ----------------------------------------------------------------------------------------------------


def singlet(**changes) -> rt.Lens:
    rows = [dict(radius=60, thickness=6, glass="N-BK7") | changes, dict(radius=-90, thickness=80)]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=8, fields=[0, 3])


def test_an_element_is_split_without_a_change_of_its_rays():
    lens = rt.read_lens("cooke_triplet")
    for at, share in (("1-2", 0.5), ("3-4", 0.2)):
        new = rt.edit.split(lens, at, share=share)
        assert len(new.surfaces) == len(lens.surfaces) + 2
        assert_close(rt.first_order(new).power, rt.first_order(lens).power, rtol=1e-14, atol=0.0)
        spots = [quietly(rt.spot, each, rings=4).rms_radius for each in (lens, new)]
        assert_close(*spots, rtol=1e-9, atol=1e-12)
    new = rt.edit.split(lens, 3)
    spots = [quietly(rt.spot, each, rings=4).rms_radius for each in (lens, new)]
    assert_close(*spots, rtol=1e-9, atol=1e-12)


def test_parts_that_lie_apart_have_the_power_of_the_element():
    lens = singlet()
    new = rt.edit.split(lens, "1-2", share=0.3, gap=0.7, curvature=0.004)
    assert_close(rt.first_order(new).power, rt.first_order(lens).power, rtol=1e-13, atol=0.0)
    assert [float(new.surfaces[k].thickness) for k in (1, 2, 3)] == pytest.approx([1.8, 0.7, 4.2], rel=1e-14)


@pytest.mark.parametrize("shape", [-2.0, -1.0, 0.0, 0.4, 1.0, 3.0])
def test_a_bent_element_keeps_its_power(shape):
    for lens in (singlet(), singlet(coefficients=vector(2e-4, 1e-6))):
        new = rt.edit.bend(lens, "1-2", shape)
        assert_close(rt.first_order(new).power, rt.first_order(lens).power, rtol=1e-12, atol=0.0)
    new = rt.edit.bend(singlet(), "1-2", shape)
    c = [float(surface.curvature) for surface in new.surfaces[1:3]]
    assert (c[0] + c[1]) / (c[0] - c[1]) == pytest.approx(shape, abs=1e-12)
    thin = rt.edit.bend(singlet(), "1-2", shape, keep="thin")
    c = [float(surface.curvature) for surface in thin.surfaces[1:3]]
    assert c[0] - c[1] == pytest.approx(1 / 60 + 1 / 90, rel=1e-13)


def test_derivatives_by_the_shape_are_those_of_differences():
    def curvature(shape):
        return rt.edit.bend(singlet(), "1-2", shape).surfaces[1].curvature

    shape = scalar(0.6).requires_grad_()
    (first,) = torch.autograd.grad(curvature(shape), shape, create_graph=True)
    (second,) = torch.autograd.grad(first, shape)
    step = 1e-4
    ends = [float(curvature(scalar(0.6 + side * step))) for side in (-1, 0, 1)]
    assert float(first) == pytest.approx((ends[2] - ends[0]) / (2 * step), rel=1e-8)
    assert float(second) == pytest.approx((ends[2] - 2 * ends[1] + ends[0]) / step**2, rel=1e-4)


# -- tables, files and the command -------------------------------------------------------------------------------------


def test_every_kind_is_scaled_and_turned():
    """A new kind of sag or phase has its powers of length, and its turned numbers."""
    assert {*SAG_TERMS, *PHASES} <= {*POWERS}
    assert {*SAG_TERMS, *PHASES} <= {*_TURNED}
    assert {head for kind in KINDS.values() for head in kind.heads} <= {*HEADS}


def test_rows_number_what_the_operands_take():
    """The table of arguments agrees with the operands that are evaluated, and knows operands alone."""
    surfaces = ("surface", "place", "met surface")
    for name, operand in OPERANDS.items():
        first, second = ARGUMENTS.get(name, ("", ""))
        assert (operand.takes[0] == "contribution") == (first == "contribution")
        if name not in BOUNDARIES and operand.refers is None:
            assert (operand.takes[0] in surfaces) == (first in ("surface", "gap")), name
            assert (operand.takes[1] in surfaces) == bool(second), name
        assert (operand.refers is not None and name != "CONS") == (first in ("row", "rows")), name
    assert not [name for name in BOUNDARIES if ARGUMENTS[name][0] not in ("surface", "gap")]
    assert not {*ARGUMENTS} - {*DIMENSION}


FILES = sorted(
    path
    for folder in ("corpus/zmx", "merit/dev", "tolerance/dev", "tier2/dev")
    for path in (SHARED / folder).glob("*")
    if path.suffix.lower() == ".zmx"
)


def assert_same_but_for_spelling(new, lens):
    """Whether two lenses are alike, also in what the lines of their tolerances mean."""
    rows = ([dataclasses.replace(row, source="") for row in tolerances_of(each)] for each in (new, lens))
    for one, other in zip(*rows, strict=True):
        assert one == other
    if lens.optimization_data is not None:
        lines = lens.optimization_data.tolerances
        new = dataclasses.replace(new, optimization_data=dataclasses.replace(new.optimization_data, tolerances=lines))
    assert [*differences(new, lens)] == []


# -- cement ------------------------------------------------------------------------------------------------------------


def air_spaced(gap=0.0, difference=0.0):
    rows = [dict(radius=60, thickness=6, glass="N-BK7"), dict(radius=-45, thickness=gap)]
    rows += [dict(radius=1 / (-1 / 45 + difference), thickness=2.5, glass="N-SF5"), dict(radius=-130, thickness=95)]
    return rt.lens(rows, stop=3, entrance_pupil_diameter=20, fields=[0, 1.5], catalogs=["schott"])


def test_surfaces_that_touch_are_cemented_without_a_change_of_any_ray():
    lens = air_spaced()
    new = rt.edit.cement(lens, "2-3")
    assert [surface.glass.name for surface in new.surfaces] == ["", "N-BK7", "N-SF5", "", ""]
    assert (new.stop, len(new.surfaces)) == (2, len(lens.surfaces) - 1)
    assert_close(rt.spot(new).rms_radius, rt.spot(lens).rms_radius, rtol=1e-10, atol=1e-14)
    assert cemented_groups(new) == [(1, 3)]


def test_the_shared_surface_has_the_mean_curvature_and_what_follows_moves_forward():
    lens = air_spaced(gap=0.7, difference=0.002)
    new = rt.edit.cement(lens, (2, 3))
    assert float(new.surfaces[2].curvature) == pytest.approx(-1 / 45 + 0.001, rel=1e-12)
    track = [sum(float(surface.thickness) for surface in each.surfaces[1:-1]) for each in (lens, new)]
    assert track[0] - track[1] == pytest.approx(0.7, rel=1e-12)
    bent = torch.tensor(-0.03, dtype=torch.float64, requires_grad=True)
    rt.first_order(rt.edit.cement(lens, "2-3", curvature=bent)).effective_focal_length.sum().backward()
    assert bent.grad is not None
    assert float(bent.grad) != 0


def test_what_refers_to_the_second_surface_is_left_out_and_named():
    data = OptimizationData(
        variables=tuple(Vary(k, quantity) for k, quantity in ((2, "curvature"), (3, "curvature"), (2, "thickness"),
                                                             (3, "thickness"), (4, "curvature")))
    )  # fmt: skip
    lens = dataclasses.replace(air_spaced(gap=0.5), optimization_data=data)
    with pytest.warns(rt.LeftOut, match=r"cement 2-3: left out with the air space: .*curvature"):
        new = rt.edit.cement(lens, "2-3")
    left = [(variable.surface, variable.quantity) for variable in new.optimization_data.variables]
    assert left == [(2, "curvature"), (2, "thickness"), (3, "curvature")]


@pytest.mark.parametrize(
    ("surfaces", "message"),
    [
        ("2", "expected the two surfaces of an air space"),
        ("1-2", "no air space between two glasses"),
        ("4-5", "no air space|none of this lens"),
    ],
)
def test_other_surfaces_are_not_cemented(surfaces, message):
    with pytest.raises(rt.BadEdit, match=message):
        rt.edit.cement(air_spaced(gap=0.5), surfaces)


def test_elements_of_one_glass_are_not_cemented():
    lens = air_spaced(gap=0.5)
    lens = lens.replace(3, glass=lens.surfaces[1].glass)
    with pytest.raises(rt.BadEdit, match="both elements are of N-BK7"):
        rt.edit.cement(lens, "2-3")


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem[-40:])
def test_files_keep_their_numbers_through_edits(path):
    """A plane that is inserted and joined, and a lens that is turned twice, or scaled there and back, is the lens."""
    try:
        lens = quietly(rt.read_lens, path)
    except rt.LensFileError:
        pytest.skip("is not read")
    for before in (1, lens.stop, len(lens.surfaces) - 1):
        new = quietly(rt.edit.insert, lens, before)
        assert (new.stop, len(new.surfaces)) == (lens.stop + (lens.stop >= before), len(lens.surfaces) + 1)
        for number, (one, other) in enumerate(zip(lens.configurations, new.configurations, strict=True)):
            powers = [rt.first_order(each).power for each in (one, other)]
            assert_close(*powers, rtol=1e-9, atol=1e-15, msg=f"configuration {number + 1}")
        table = tolerances_of(new)
        assert [row.surfaces for row in table] == [
            tuple(k + (k >= before) for k in row.surfaces) for row in tolerances_of(lens)
        ]
        with warnings.catch_warnings():
            warnings.simplefilter("error", rt.LeftOut)
            again = rt.edit.join(new, before) if not new.surfaces[before].is_mirror else lens
        assert_same_but_for_spelling(again, lens)
    larger = quietly(rt.edit.scale, lens, 2.0)
    smaller = quietly(rt.edit.scale, larger, 0.5)
    assert_same_but_for_spelling(dataclasses.replace(smaller, name=lens.name), lens)
    try:
        back = quietly(rt.edit.reverse, quietly(rt.edit.reverse, lens))
    except rt.BadEdit:
        return
    assert [*differences(dataclasses.replace(back, optimization_data=lens.optimization_data), lens)] == []


def test_the_command_edits_in_order(tmp_path, capsys):
    out = tmp_path / "out.zmx"
    words = ["edit", "cooke_triplet", "--at", "1-2", "--comment", "front", "--reverse", "--scale", "2", "--json"]
    words += ["--insert", "3", "radius=50,thickness=4,glass=N-BK7", "radius=-50,thickness=1", "-o", str(out)]
    assert main(words) == 0
    document = json.loads(capsys.readouterr().out)
    assert (document["surfaces"], document["stop"]) == ({"before": 9, "after": 11}, {"before": 5, "after": 7})
    lens, new = rt.read_lens("cooke_triplet"), rt.read_lens(out)
    assert float(new.surfaces[1].radius) == pytest.approx(-2 * float(lens.surfaces[2].radius), rel=1e-14)
    assert (new.surfaces[2].comment, new.surfaces[3].glass.name) == ("front", "N-BK7")
    assert main(["edit", "cooke_triplet", "--efl", "50", "--rename", "fifty", "-o", str(out)]) == 0
    assert "101.180979" in capsys.readouterr().out
    assert rt.read_lens(out).name == "fifty"


@pytest.mark.slow
def test_the_command_writes_temperatures_that_an_optimisation_makes_athermal(tmp_path, capsys):
    out, better = str(tmp_path / "warm.zmx"), str(tmp_path / "athermal.zmx")
    words = ["--temperatures", "-20", "20", "60", "5=invar", "--mount", "aluminium", "--json", "-o", out]
    assert main(["edit", "cooke_triplet", *words]) == 0
    assert json.loads(capsys.readouterr().out)["configurations"] == {"before": 1, "after": 3}
    warm = rt.read_lens(out)
    assert [float(each.environment.temperature) for each in warm.configurations] == [20, -20, 60]
    assert {k: float(warm.surfaces[k].expansion) for k in (2, 4, 5, 7)} == {2: 23.6, 4: 23.6, 5: 1.3, 7: 23.6}
    hot = rt.read_lens("cooke_triplet").replace(5, expansion=1.3).at(mount="aluminium").at(temperature=60)
    for one, other in zip(warm.configuration(3).surfaces, hot.surfaces, strict=True):
        assert float(one.thickness) == pytest.approx(float(other.thickness), rel=1e-12)
    words = ["--merit", "spot", "--vary", "sensor", "spacer:7", "--mounts", "aluminium", "invar", "-o", better]
    assert main(["optimize", out, *words]) == 0
    shifts = [rt.thermal(rt.read_lens(path), samples=2, measure="focus").focus_shift for path in (out, better)]
    assert float((shifts[1][1] - shifts[1][0]).abs()) < 0.5 * float((shifts[0][1] - shifts[0][0]).abs())


def test_a_mount_alone_states_the_expansion_of_all_spaces(tmp_path):
    out = str(tmp_path / "mounted.zmx")
    words = ["--insert", "3", "radius=inf,thickness=2,glass=N-BK7", "thickness=1", "--mount", "titanium"]
    assert main(["edit", "cooke_triplet", *words, "-o", out]) == 0
    stated = [surface.expansion for surface in rt.read_lens(out).surfaces]
    assert [k for k, each in enumerate(stated) if each is not None] == [2, 4, 6, 7, 9]


def test_the_command_stores_the_system_and_conditions(tmp_path):
    out = tmp_path / "out.zmx"
    words = (
        "f_number=5 fields=0,7,10 field_weights=2,1,1 wavelengths=0.48,0.55,0.64 primary_wavelength=2 ray_aiming=real"
    )
    words = ["--system", *words.split(), "object_distance=2000", "--conditions", "efl=100", "edge>=1"]
    assert main(["edit", "cooke_triplet", *words, "-o", str(out)]) == 0
    lens = rt.read_lens("cooke_triplet").at(
        f_number=5, fields=[0, 7, 10], field_weights=[2, 1, 1], wavelengths=[0.48, 0.55, 0.64], primary_wavelength=2,
        ray_aiming="real", object_distance=2000,
    )  # fmt: skip
    new = rt.read_lens(out)
    assert [*map(str, new.conditions)] == [*map(str, lens.with_conditions("efl=100 edge>=1").conditions)]
    assert (new.ray_aiming, new.primary_wavelength) == ("real", 2)
    assert torch.equal(rt.spot(new).rms_radius, rt.spot(lens).rms_radius)
    assert (
        main(["edit", str(out), "--system", "fields=0:0,3:-4", "--conditions", "none", "-o", str(tmp_path / "x.zmx")])
        == 0
    )
    bare = rt.read_lens(tmp_path / "x.zmx")
    assert (bare.conditions, bare.fields.x.tolist(), bare.fields.y.tolist()) == ((), [0.0, 3.0], [0.0, -4.0])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--temperatures", "hot"], "--temperatures hot: expected °C"),
        (["--temperatures", "20"], "expected one other than 20 °C, that of the lens"),
        (["--temperatures", "60", "1=invar"], "no space behind 1; this lens has spaces behind 2, 4, 5, 7"),
        (["--temperatures", "60", "--mount", "wood"], "mount 'wood': expected one of aluminium"),
        ([], "no edit is given"),
        (["--reverse", "foo"], "no surface has the comment 'foo'"),
        (["--bend", "1-2"], "no surfaces; give numbers as 3-4"),
        (["--bend", "1-2", "flat"], "'flat': expected a shape factor"),
        (["--split", "1-2", "air=2"], "no setting 'air'"),
        (["--delete"], "no surfaces; give numbers"),
        (["--system", "fnumber=4"], "no 'fnumber'; did you mean f_number?"),
        (["--system", "fields=0,b"], "'0,b' is no number or list of them"),
        (["--conditions", "elf=100"], "'elf' is nothing to hold"),
    ],
)
def test_the_command_refuses_in_words(words, message, tmp_path, capsys):
    assert main(["edit", "cooke_triplet", *words, "-o", str(tmp_path / "out.zmx")]) == 1
    assert message in capsys.readouterr().err

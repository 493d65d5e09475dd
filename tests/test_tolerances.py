"""Tolerances: errors of manufacture against explicit coordinate breaks, closed forms and finite differences."""

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from problems import SHARED, number

import raytrace as rt
from raytrace.materials.environment import Environment, index_in
from raytrace.materials.glass import LINES, InvalidIndex, abbe_number, index, model_glass, with_index_errors
from raytrace.system.poses import Pose, pose_of, rows_along, undone
from raytrace.system.sag_terms import FringeSag, GridSag, PolynomialSag, TiltSag, ZernikeSag, spline
from raytrace.system.surface import sag_at
from raytrace.system.tolerance_data import KINDS
from raytrace.tolerancing.grades import GRADES
from raytrace.tolerancing.study import moments
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import trace_lens

T = rt.system.Tolerance
HEAD = """VERS 130000
MODE SEQ
UNIT MM X W X CM MR CPMM
ENPD 8
FTYP 0 0 2 1 0 0 0
RAIM 0 0 1 1 0 0 0 0 0
XFLN 0 0
YFLN 0 5
WAVM 1 0.55 1
PWAV 1"""
#: Curvature, thickness and index of the surfaces of a lens with a cemented doublet; then its sensor.
SURFACES = [
    (0.02, 3.0, 1.6, 8.0),
    (-0.015, 1.5, 1.7, 8.0),
    (-0.004, 5.0, 0.0, 8.0),
    (0.03, 2.5, 1.5, 7.0),
    (0.01, 40.0, 0.0, 7.0),
]


def standard(curvature, thickness, index, semi_diameter, *, stop=False) -> str:
    glass = f"\n  GLAS ___BLANK 1 0 {index} 0 0 0 0 0 0 0" if index else ""
    size = f"DIAM {semi_diameter} 1 0 0 1"
    return (
        f"  {'STOP' if stop else 'TYPE STANDARD'}\n  CURV {curvature!r} 0 0 0 0\n  DISZ {thickness!r}{glass}\n  {size}"
    )


def coordinate_break(x=0.0, y=0.0, tilt_x=0.0, tilt_y=0.0, tilt_z=0.0, *, order=0, thickness=0.0) -> str:
    numbers = (x, y, tilt_x, tilt_y, tilt_z, order)
    parameters = "\n".join(f"  PARM {j} {number!r}" for j, number in enumerate(numbers, 1))
    return f"  TYPE COORDBRK\n{parameters}\n  DISZ {thickness!r}"


def back(*numbers: float, thickness=0.0) -> str:
    """The coordinate break that undoes one."""
    return coordinate_break(*(-number for number in numbers), order=1, thickness=thickness)


def read(tmp_path, *blocks: str) -> rt.Lens:
    blocks = ["  TYPE STANDARD\n  DISZ INFINITY", *blocks, "  TYPE STANDARD\n  DISZ 0"]
    text = "\n".join([HEAD, *(f"SURF {k}\n{block}" for k, block in enumerate(blocks))])
    path = tmp_path / "lens.zmx"
    path.write_text(text + "\n", encoding="utf-8")
    return rt.read_lens(path)


def blocks(**changed) -> list[str]:
    return [standard(*numbers, stop=k == 0) for k, numbers in enumerate(SURFACES)]


@pytest.fixture
def nominal(tmp_path):
    return read(tmp_path, *blocks())


def hits(lens, start=None, shift=0.0):
    """Position and direction (6, ...) on the sensor of rays that start as those of another lens.

    shift: mm along z of the axes in front of surface 1, relative to those of the other lens.
    """
    start = lens if start is None else start
    points = torch.tensor([[0.0, 0.3, -0.8], [0.0, 0.7, -0.4]], dtype=torch.float64)
    fields = torch.tensor([[0.0, 3.0], [0.0, 5.0]], dtype=torch.float64)
    rays = launch(start, points, fields=fields, wavelengths=start.wavelengths)
    rays = dataclasses.replace(
        rays, position=rays.position - torch.tensor([0, 0, shift], dtype=torch.float64)[:, None, None, None]
    )
    end = trace_lens(lens, rays, start.wavelengths[:, None])
    assert end.valid.all()
    return torch.cat([end.position, end.direction])


def close(one, other, atol=1e-12):
    torch.testing.assert_close(one, other, rtol=0, atol=atol)


MOVE = (0.2, -0.1, 0.7, -0.4, 1.3)
NAMES = ("element_decenter_x", "element_decenter_y", "element_tilt_x", "element_tilt_y", "element_roll")


def element(first, last, **known):
    return [T(name, (first, last), -2, 2, **known) for name in NAMES]


def test_an_element_is_moved_as_between_two_coordinate_breaks(nominal, tmp_path):
    found = rt.tolerancing.perturbed(nominal, element(1, 3), MOVE)
    s = blocks()
    s[2] = standard(-0.004, -4.5, 0.0, 8.0)
    dummy = standard(0.0, 5.0, 0.0, 8.0)
    explicit = read(tmp_path, coordinate_break(*MOVE), *s[:3], back(*MOVE, thickness=4.5), dummy, *s[3:])
    close(hits(found, nominal), hits(explicit, nominal))
    assert (hits(found, nominal) - hits(nominal))[:2].abs().max() > 0.01


@pytest.mark.parametrize("name", NAMES)
def test_the_sign_of_each_motion_is_that_of_a_coordinate_break(name, nominal, tmp_path):
    move = [0.3 if other == name else 0.0 for other in NAMES]
    found = rt.tolerancing.perturbed(nominal.replace(4, conic=-3.0), [T(name, (4, 5), -1, 1)], [0.3])
    s = blocks()
    s[3] += "\n  CONI -3"
    s[4] = standard(0.01, -2.5, 0.0, 7.0)
    dummy = standard(0.0, 40.0, 0.0, 7.0)
    explicit = read(tmp_path, *s[:3], coordinate_break(*move), *s[3:], back(*move, thickness=2.5), dummy)
    close(hits(found, nominal), hits(explicit, nominal))


def test_a_pivot_lies_behind_the_first_vertex(nominal, tmp_path):
    found = rt.tolerancing.perturbed(nominal, [T("element_tilt_x", (4, 5), -2, 2, pivot=6.0)], [0.7])
    s = blocks()
    s[2] = standard(-0.004, 11.0, 0.0, 8.0)  # to the pivot
    s[4] = standard(0.01, 3.5, 0.0, 7.0)
    turn = coordinate_break(tilt_x=0.7, thickness=-6.0)
    rest = standard(0.0, 36.5, 0.0, 7.0)
    explicit = read(tmp_path, *s[:3], turn, *s[3:], back(0, 0, 0.7, 0, 0), rest)
    close(hits(found, nominal), hits(explicit, nominal))


def test_elements_move_inside_groups_and_surfaces_inside_elements(nominal, tmp_path):
    rows = [*element(4, 5), T("surface_decenter_x", (4,), -1, 1), *element(1, 5), T("surface_decenter_y", (1,), -1, 1)]
    group = (-0.3, 0.2, -0.5, 0.9, -2.0)
    found = rt.tolerancing.perturbed(nominal, rows, [*MOVE, 0.15, *group, -0.25])
    s = blocks()
    s[0] = standard(0.02, 0.0, 1.6, 8.0)
    s[3] = standard(0.03, 0.0, 1.5, 7.0)
    s[4] = standard(0.01, -2.5, 0.0, 7.0)
    explicit = read(
        tmp_path,
        *(coordinate_break(*group), coordinate_break(0, -0.25), s[0].replace("STOP", "TYPE STANDARD")),
        *(back(0, -0.25, thickness=3.0), "  STOP\n" + s[1], s[2]),
        *(coordinate_break(*MOVE), coordinate_break(0.15), s[3], back(0.15, thickness=2.5), s[4]),
        *(back(*MOVE, thickness=2.5), standard(0.0, -12.0, 0.0, 8.0), back(*group, thickness=12.0)),
        standard(0.0, 40.0, 0.0, 7.0),
    )
    # the object at infinity stays where it is: rays start from axes that follow the vertex of surface 1
    group = Pose(*map(number, (-0.3, 0.2)), None, *map(number, (-0.5, 0.9, -2.0)))
    z = pose_of(rows_along([group, Pose(y=number(-0.25))])).z
    close(hits(found, nominal, shift=float(z)), hits(explicit, nominal))


def test_errors_of_mirrors_between_coordinate_breaks(tmp_path):
    mirror = "  TYPE STANDARD\n  CURV -0.004 0 0 0 0\n  DISZ {}\n  GLAS MIRROR 0 0 1.5 40 0 0 0 0 0 0\n  DIAM 9 1 0 0 1"
    front = "  STOP\n  TYPE STANDARD\n  DISZ 20"
    fold = coordinate_break(tilt_x=-40.0)
    nominal = read(tmp_path, front, fold, mirror.format("0"), coordinate_break(tilt_x=-40.0, thickness=-30.0))
    assert rt.tolerancing.lens_elements(nominal) == [(3, 3)]
    found = rt.tolerancing.perturbed(nominal, element(3, 3), MOVE)
    moved = [coordinate_break(*MOVE), mirror.format("0"), back(*MOVE)]
    explicit = read(tmp_path, front, fold, *moved, coordinate_break(tilt_x=-40.0, thickness=-30.0))
    close(hits(found, nominal), hits(explicit, nominal))
    # a group that contains the breaks
    found = rt.tolerancing.perturbed(nominal, element(2, 4), MOVE)
    inner = [fold, mirror.format("0"), coordinate_break(tilt_x=-40.0)]
    undo = [coordinate_break(tilt_x=40.0), coordinate_break(tilt_x=40.0), back(*MOVE)]
    again = [fold, coordinate_break(tilt_x=-40.0, thickness=-30.0)]
    explicit = read(tmp_path, front, coordinate_break(*MOVE), *inner, *undo, *again)
    close(hits(found, nominal), hits(explicit, nominal))


def test_a_surface_with_a_pose_of_its_own_keeps_it(nominal):
    inner, behind = rt.system.Pose(y=0.4, tilt_x=3.0, tilt_z=20.0), rt.system.Pose(tilt_x=-1.0)
    posed = nominal.replace(4, before=inner, after=behind)
    found = rt.tolerancing.perturbed(posed, [*element(4, 4), T("surface_decenter_x", (4,), -1, 1)], [*MOVE, 0.3])
    shift, outer = (rt.system.Pose(x=number(0.3)), rt.system.Pose(*map(number, MOVE[:2]), None, *map(number, MOVE[2:])))
    surface, zero = posed.surfaces[4], number(0.0)

    def axes(pose, thickness=zero):
        return rt.system.Surface(thickness, before=pose, is_break=True)

    bare = dataclasses.replace(surface, before=shift, after=undone(shift), thickness=zero)
    inner, behind = surface.before, surface.after
    chain = [axes(outer), axes(inner), bare, axes(behind)]
    chain += [axes(undone(behind)), axes(undone(inner)), axes(undone(outer)), axes(inner)]  # back, and forward again
    chain.append(axes(behind, surface.thickness))
    surfaces = (*posed.surfaces[:4], *chain, *posed.surfaces[5:])
    close(hits(found, nominal), hits(dataclasses.replace(posed, surfaces=surfaces), nominal))


# -- numbers ----------------------------------------------------------------------------------------------------------

#: A row of every kind, with an error.
ROWS = [
    (T("radius", (1,), -1, 1), 0.4),
    (T("radius", (4,), -1, 1, unit="%"), -0.6),
    (T("power", (2,), -9, 9), 5.0),
    (T("curvature", (3,), -1, 1), 1e-4),
    (T("conic", (4,), -1, 1), 0.2),
    (T("thickness", (1,), -1, 1, adjust=3), 0.1),
    (T("thickness", (4,), -1, 1), -0.07),
    (T("index", (1,), -1, 1), 1e-3),
    (T("index", (6,), -1, 1), -2e-3),
    (T("abbe", (6,), -9, 9), 3.0),
    (T("abbe", (6,), -9, 9, unit="%"), 0.8),
    (T("parameter", (5,), -1, 1, parameter="a4"), 1e-6),
    (T("parameter", (4,), -1, 1, parameter="tilt_x"), 0.1),
    (T("surface_decenter_x", (3,), -1, 1), 0.1),
    (T("surface_decenter_y", (4,), -1, 1), -0.1),
    (T("surface_tilt_x", (2,), -1, 1), 0.2),
    (T("surface_tilt_y", (4,), -1, 1), 0.1),
    (T("surface_runout_x", (5,), -1, 1), 0.02),
    (T("surface_runout_y", (2,), -1, 1), 0.01),
    (T("irregularity", (3,), -9, 9), 2.0),
    (T("irregularity_angle", (3,), -90, 90), 35.0),
    (T("zernike", (3,), -1, 1, term=7), 1e-4),
    (T("fringe", (3,), -1, 1, term=8), 0.5),
    (T("element_decenter_x", (4, 5), -1, 1), 0.1),
    (T("element_decenter_y", (1, 3), -1, 1), -0.1),
    (T("element_decenter_z", (4, 5), -1, 1), 0.2),
    (T("element_tilt_x", (1, 3), -1, 1), 0.3),
    (T("element_tilt_y", (1, 5), -1, 1, pivot=2.0), 0.2),
    (T("element_roll", (1, 5), -9, 9), 4.0),
]


@pytest.fixture
def asphere(nominal):
    """The lens with terms of an asphere on surface 5, and a dispersive plate in front of its sensor."""
    lens = nominal.replace(5, coefficients=[0.0, 2e-6], thickness=20.0)
    plate = dataclasses.replace(lens.surfaces[5], curvature=None, coefficients=None)
    pair = [dataclasses.replace(plate, glass=model_glass(1.5, 60.0), thickness=number(3.0)), plate]
    lens = dataclasses.replace(lens, surfaces=(*lens.surfaces[:6], *pair, lens.surfaces[6]))
    return lens.at(wavelengths=[0.55, 0.48, 0.65])


def test_every_kind_of_error_has_a_row_here():
    assert {row.kind for row, _ in ROWS} == set(KINDS) - {"operand"}


def errors(factor=1.0):
    return factor * torch.tensor([value for _, value in ROWS], dtype=torch.float64)


@pytest.mark.parametrize("place", range(len(ROWS)), ids=lambda place: f"{place}-{ROWS[place][0].kind}")
def test_every_kind_of_error_is_written_and_read_back(place, asphere, tmp_path):
    found = rt.tolerancing.perturbed(asphere, *zip(*(ROWS[k] for k in sorted({place, 19, 20})), strict=True))
    rt.write_lens(found, tmp_path / "lens.zmx")
    close(hits(rt.read_lens(tmp_path / "lens.zmx")), hits(found), atol=1e-11)


def test_all_kinds_of_errors_are_written_and_read_back(asphere, tmp_path):
    found = rt.tolerancing.perturbed(asphere, *zip(*ROWS, strict=True))
    rt.write_lens(found, tmp_path / "lens.zmx")
    close(hits(rt.read_lens(tmp_path / "lens.zmx")), hits(found), atol=1e-11)


def test_no_error_is_the_nominal_lens(asphere):
    rows = [row for row, _ in ROWS]
    close(hits(rt.tolerancing.perturbed(asphere, rows, errors(0.0)), asphere), hits(asphere), 1e-13)
    for row, value in ROWS:
        moved = hits(rt.tolerancing.perturbed(asphere, [row], [value]), asphere) - hits(asphere)
        alone = ("irregularity_angle", "element_roll")  # nothing turns but what is round
        assert (moved.abs().max() > 1e-7) == (row.kind not in alone), row


@pytest.mark.parametrize("engine", ["eager", "compiled"])
def test_a_batch_of_lenses_is_each_of_them(engine, asphere, compiler):
    rows = [row for row, _ in ROWS]
    batch = torch.stack([errors(factor) for factor in (1.0, -0.5, 0.0)])
    with rt.tracing.trace_engine(engine):
        together = hits(rt.tolerancing.perturbed(asphere, rows, batch), asphere)
        for k, one in enumerate(batch):
            close(together[:, k], hits(rt.tolerancing.perturbed(asphere, rows, one), asphere), 1e-13)


@pytest.mark.parametrize("place", range(len(ROWS)))
def test_the_derivative_by_an_error_is_that_of_the_rays(place, asphere):
    rows, step = [row for row, _ in ROWS], 1e-4 * abs(ROWS[place][1])
    weights = torch.linspace(-1, 1, 6, dtype=torch.float64)[:, None, None, None]

    def total(values):
        return (weights * hits(rt.tolerancing.perturbed(asphere, rows, values), asphere)).sum()

    values = errors().requires_grad_()
    (slope,) = torch.autograd.grad(total(values), values)
    one = torch.zeros(len(rows), dtype=torch.float64)
    one[place] = step
    with torch.no_grad():
        stencil = [total(errors() + k * one) for k in (-2, -1, 1, 2)]
    expected = (stencil[0] - 8 * stencil[1] + 8 * stencil[2] - stencil[3]) / (12 * step)
    assert float(slope[place]) == pytest.approx(float(expected), rel=1e-5, abs=1e-9 / step * 1e-3)


def test_the_derivative_by_a_number_of_the_lens(nominal):
    curvature = number(0.02).requires_grad_()
    found = rt.tolerancing.perturbed(nominal.replace(1, curvature=curvature), [T("radius", (1,), -1, 1)], [0.5])
    (slope,) = torch.autograd.grad(found.surfaces[1].curvature, curvature)
    assert float(slope) == pytest.approx(1 / (1 + 0.02 * 0.5) ** 2, rel=1e-14)


def test_what_no_error_touches_stays_the_same(nominal):
    found = rt.tolerancing.perturbed(nominal, [T("thickness", (2,), -1, 1)], [0.1])
    for k, (old, new) in enumerate(zip(nominal.surfaces, found.surfaces, strict=True)):
        assert (old is new) == (k != 2)
    assert found.surfaces[2].curvature is nominal.surfaces[2].curvature
    assert found.fields is nominal.fields


def test_a_fringe_of_power_is_half_a_wave_of_sag_at_the_semi_diameter(nominal):
    lens = nominal.replace(1, conic=-0.7)
    found = rt.tolerancing.perturbed(
        lens, rt.tolerancing.ToleranceTable((T("power", (1,), -9, 9),), test_wavelength=0.5), [3.0]
    )
    h = number(8.0)
    old, new = (sag_at(one.surfaces[1], 0 * h, h) for one in (lens, found))
    assert float(new - old) == pytest.approx(3 * 0.25e-3, rel=1e-9)
    plane = rt.tolerancing.perturbed(nominal.replace(1, curvature=None), [T("power", (1,), -9, 9)], [2.0])
    assert float(sag_at(plane.surfaces[1], h, 0 * h)) == pytest.approx(0.6328e-3, rel=1e-12)


#: Errors of a face, and the angles θx and θy that it is tilted by: a sphere about (sin θy cos θx, -sin θx, …)/c.
TILTS = {
    "surface_tilt_x": ("surface_tilt_x", 0.4, (0.4, 0.0)),
    "surface_tilt_y": ("surface_tilt_y", -0.3, (0.0, -0.3)),
    "surface_runout_x": ("surface_runout_x", 0.05, (0.0, -math.degrees(math.atan(0.05 / 16)))),
    "surface_runout_y": ("surface_runout_y", 0.05, (math.degrees(math.atan(0.05 / 16)), 0.0)),
    "element_tilt_x": ("element_tilt_x", 0.4, (0.4, 0.0)),
}


@pytest.mark.parametrize("name", TILTS)
@pytest.mark.parametrize("k", [1, 2, 3])
def test_a_tilted_sphere_is_the_sphere_about_a_moved_centre(name, k, nominal):
    kind, value, tilts = TILTS[name]
    found = rt.tolerancing.perturbed(nominal, [T(kind, (k, k) if kind.startswith("element") else (k,), -1, 1)], [value])
    tilt_x, tilt_y = map(math.radians, tilts)
    axis = np.array([math.sin(tilt_y), -math.sin(tilt_x) * math.cos(tilt_y), math.cos(tilt_x) * math.cos(tilt_y)])
    start = launch(
        nominal, torch.tensor([[0.0, 0.3], [0.5, -0.8]]).double(), fields=torch.tensor([[0.0], [5.0]]).double()
    )
    position, direction = (part.flatten(1).numpy() for part in (start.position, start.direction))
    vertex, before = np.zeros(3), 1.0
    for j, (curvature, thickness, *_) in enumerate(SURFACES, 1):
        centre = vertex + (axis if j == k else np.array([0, 0, 1])) / curvature
        offset = position - centre[:, None]
        along, power = (offset * direction).sum(0), (offset**2).sum(0) - 1 / curvature**2
        root = np.sign(curvature) * np.sqrt(along**2 - power)
        position = position + (-along - root) * direction
        normal = (centre[:, None] - position) * curvature
        after = float(index(nominal.surfaces[j].glass, nominal.wavelengths))
        cosine = (direction * normal).sum(0)
        kept = np.sqrt(1 - (before / after) ** 2 * (1 - cosine**2))
        direction = before / after * direction + (kept - before / after * cosine) * normal
        vertex, before = vertex + np.array([0, 0, thickness]), after
    position = position + (vertex[2] - position[2]) / direction[2] * direction
    end = trace_lens(found, start, nominal.wavelengths[:, None]).position.flatten(1)
    close(end[:2], torch.from_numpy(position[:2]), 1e-12)


def test_the_change_by_a_wedge_is_that_of_a_decentred_sphere():
    lens = rt.read_lens("double_gauss")
    radius = float(lens.surfaces[1].radius)
    rows = [T("surface_tilt_x", (1,), -0.1, 0.1), T("element_tilt_x", (1, 1), -0.1, 0.1)]
    step = radius * math.sin(math.radians(0.1))
    rows.append(T("element_decenter_y", (1, 1), -step, step))
    rows, rays = (
        rt.tolerancing.ToleranceTable(tuple(rows), (rt.system.Compensator(11),)),
        {"fields": [0, 10, 14, -10, -14], "rings": 4, "arms": 6},
    )
    tilt, element, decentre = rt.tolerance(lens, rows, trials=0, **rays).maximum
    assert float(tilt) == pytest.approx(float(element), rel=1e-12)
    assert float(tilt) == pytest.approx(float(decentre), rel=3e-4)  # a sphere, shifted along z by R (1 - cos θ)
    assert float(tilt) == pytest.approx(0.6031, abs=1e-4)  # a plane added to the sag had 6.627


@pytest.mark.parametrize("angle", [0.0, 30.0])
def test_irregularity_is_half_spherical_half_astigmatism(angle, nominal):
    rows = [T("irregularity", (2,), -9, 9), T("irregularity_angle", (2,), -90, 90)]
    found = rt.tolerancing.perturbed(nominal, rows, [2.0, angle])
    x, y = torch.meshgrid(*[torch.linspace(-8, 8, 9, dtype=torch.float64)] * 2, indexing="ij")
    added = sag_at(found.surfaces[2], x, y) - sag_at(nominal.surfaces[2], x, y)
    turn = math.radians(angle)
    v, rho2 = (y * math.cos(turn) - x * math.sin(turn)) / 8, (x * x + y * y) / 64
    close(added, 2 * 0.6328e-3 / 4 * (rho2**2 + v * v), 1e-16)
    # by Zernike's fringe terms Z_9, Z_4, Z_5 and Z_6
    z5, z6 = (x * x - y * y) / 64, 2 * x * y / 64
    z4, z9 = 2 * rho2 - 1, 6 * rho2**2 - 6 * rho2 + 1
    bent = (z5 * math.cos(2 * turn) + z6 * math.sin(2 * turn)) / 2
    close(added, 2 * 0.6328e-3 / 4 * (z9 / 6 + 3 * z4 / 4 - bent + 7 / 12), 1e-16)


def test_the_limit_of_a_zernike_term_is_its_rms(nominal):
    found = rt.tolerancing.perturbed(nominal, [T("zernike", (2,), -1, 1, term=11)], [1e-3])
    x, y = 8 * torch.randn(2, 40_000, generator=torch.Generator().manual_seed(1), dtype=torch.float64).clamp(-1, 1)
    rho2 = (x * x + y * y) / 64
    added = sag_at(found.surfaces[2], x, y) - sag_at(nominal.surfaces[2], x, y)
    close(added, 1e-3 * math.sqrt(5) * (6 * rho2**2 - 6 * rho2), 1e-14)  # without its constant, which is a thickness


SAGS = {
    "polynomial": PolynomialSag(torch.tensor([1e-3, -2e-3, 3e-3]).double(), torch.tensor(6.0).double()),
    "fringe": FringeSag(*(torch.tensor(v).double() for v in ([1e-3, 2e-3, -1e-3, 4e-4, 5e-4], 7.0, 0.5, -0.8))),
    "zernike": ZernikeSag(torch.tensor([1e-4, 2e-4, -3e-4, 1e-4]).double(), torch.tensor(9.0).double()),
    "tilt": TiltSag(torch.tensor(0.01).double(), torch.tensor(-0.02).double()),
}


@pytest.mark.parametrize("name", SAGS)
def test_sag_terms_stay_under_an_error(name, nominal):
    lens = nominal.replace(2, sag_terms=SAGS[name])
    rows = [T("irregularity", (2,), -9, 9), T("zernike", (2,), -1, 1, term=3)]
    found = rt.tolerancing.perturbed(lens, rows, [3.0, 0.1])
    x, y = torch.tensor([[0.0, 3.0, -5.0], [1.0, -2.0, 4.0]], dtype=torch.float64)
    added = 3 * 0.6328e-3 / 4 * (((x * x + y * y) / 64) ** 2 + y * y / 64) + 0.1 * 2 * y / 8
    close(sag_at(found.surfaces[2], x, y), sag_at(lens.surfaces[2], x, y) + added, 1e-15)


def test_heights_of_a_grid_stay_under_an_error(nominal):
    heights = 1e-4 * torch.sin(torch.arange(33.0 * 33).reshape(33, 33)).double()
    lens = nominal.replace(2, sag_terms=GridSag(heights, number(0.5)))
    x, y = torch.tensor([[0.0, 3.1, -5.2], [1.3, -2.0, 4.0]], dtype=torch.float64)
    added = 3 * 0.6328e-3 / 4 * (((x * x + y * y) / 64) ** 2 + y * y / 64)
    spline_lens = nominal.replace(2, sag_terms=spline(lens.surfaces[2].sag_terms))
    for one in (lens, spline_lens):
        found = rt.tolerancing.perturbed(one, [T("irregularity", (2,), -9, 9)], [3.0])
        close(sag_at(found.surfaces[2], x, y), sag_at(one.surfaces[2], x, y) + added, 1e-9)


# -- media ------------------------------------------------------------------------------------------------------------


def test_an_index_error_moves_the_index_at_all_wavelengths_and_an_abbe_error_turns_it_about_d():
    glass = rt.materials.find_glass("N-BK7")
    wavelengths = torch.tensor([LINES["d"], LINES["F"], LINES["C"], 1.0], dtype=torch.float64)
    found = with_index_errors(glass, index=number(2e-3))
    close(index(found, wavelengths), index(glass, wavelengths) + 2e-3, 1e-15)
    found = with_index_errors(found, abbe=number(1.5))
    n = index(found, wavelengths)
    assert float(n[0] - index(glass, wavelengths)[0]) == pytest.approx(2e-3, abs=1e-7)  # the model's d line is 0.5876
    expected = abbe_number(glass) + 1.5
    nominal_nd = index(glass, wavelengths)[0]
    assert float((nominal_nd - 1) / (n[1] - n[2])) == pytest.approx(float(expected), rel=1e-5)
    percent = with_index_errors(glass, abbe=number(1.0), percent=True)
    n = index(percent, wavelengths)
    assert float((n[0] - 1) / (n[1] - n[2])) == pytest.approx(1.01 * float(abbe_number(glass)), rel=1e-5)


def test_a_glass_with_errors_keeps_its_thermal_coefficients():
    glass = rt.materials.find_glass("N-BK7")
    hot = Environment(number(60.0), number(1.0))
    at = torch.tensor([0.5, 0.6], dtype=torch.float64)
    found = index_in(with_index_errors(glass, index=number(1e-4)), at, hot)
    close(found, index_in(glass, at, hot) + 1e-4, 1e-7)


def test_a_glass_without_dispersion_has_no_abbe_error(nominal):
    with pytest.raises(rt.BadTolerance, match="no dispersion"):
        rt.tolerancing.perturbed(nominal, [T("abbe", (1,), -1, 1)], [0.5])
    with pytest.raises(InvalidIndex, match="no Abbe number"):
        with_index_errors(nominal.surfaces[1].glass, abbe=number(0.5))
    assert not [row for row in rt.tolerances(nominal, grade="precision") if row.kind == "abbe"]
    assert [row.surfaces for row in rt.tolerances("cooke_triplet", "abbe=1%")] == [(1,), (3,), (6,)]


# -- elements ---------------------------------------------------------------------------------------------------------


def test_elements_are_found_from_the_media(nominal):
    assert rt.tolerancing.lens_elements(nominal) == [(1, 2), (2, 3), (4, 5)]
    assert rt.tolerancing.cemented_groups(nominal) == [(1, 3)]
    assert rt.tolerancing.lens_elements(rt.read_lens("double_gauss")) == [
        (1, 2),
        (3, 4),
        (4, 5),
        (7, 8),
        (8, 9),
        (10, 11),
    ]
    assert rt.tolerancing.cemented_groups(rt.read_lens("double_gauss")) == [(3, 5), (7, 9)]


def test_a_plane_inside_glass_belongs_to_the_element_and_a_mirror_inside_glass_too(nominal):
    glass, zero = nominal.surfaces[1].glass, number(1.0)
    inside = rt.system.Surface(zero, glass=glass)
    surfaces = (*nominal.surfaces[:2], inside, *nominal.surfaces[2:])
    assert rt.tolerancing.lens_elements(dataclasses.replace(nominal, surfaces=surfaces))[0] == (1, 3)
    mirror = rt.system.Surface(-zero, glass=rt.materials.MIRROR)
    surfaces = (*nominal.surfaces[:2], mirror, rt.system.Surface(zero), nominal.surfaces[-1])
    assert rt.tolerancing.lens_elements(dataclasses.replace(nominal, surfaces=surfaces)) == [(1, 3)]


def test_the_page_of_kinds_is_that_of_the_table():
    page = (Path(__file__).parents[1] / "docs" / "reference" / "tolerances.md").read_text("utf-8")
    for name, kind in KINDS.items():
        assert f"| `{name}` | {kind.unit} | {kind.operand} | {kind.words} |" in page


# -- random errors ----------------------------------------------------------------------------------------------------


def test_a_trial_is_the_same_in_any_batch():
    rows = [row for row, _ in ROWS]
    every = rt.tolerancing.draw_errors(rows, 20, seed=7)
    assert torch.equal(every[5:9], rt.tolerancing.draw_errors(rows, 4, seed=7, first=5))
    assert not torch.equal(every, rt.tolerancing.draw_errors(rows, 20, seed=8))
    fewer = rt.tolerancing.draw_errors(rows[:3], 20, seed=7)
    assert torch.equal(every[:, :3], fewer)


@pytest.mark.parametrize(
    ("distribution", "variance"),
    [
        ("normal", None),
        pytest.param("uniform", 1 / 3, marks=pytest.mark.slow),
        pytest.param("parabolic", 3 / 5, marks=pytest.mark.slow),
        ("end_points", 1.0),
    ],
)
def test_errors_have_their_distribution(distribution, variance):
    row = T("thickness", (1,), 1.0, 3.0, distribution=distribution, sigmas=1.5)
    errors = rt.tolerancing.draw_errors([row], 40_000, seed=3)[:, 0] - 2.0
    assert errors.abs().max() <= 1
    if variance is None:  # of the normal distribution truncated at 1.5 standard deviations
        a = 1.5
        density, inside = math.exp(-a * a / 2) / math.sqrt(2 * math.pi), math.erf(a / math.sqrt(2))
        variance = (1 - 2 * a * density / inside) / a**2
    assert float(errors.mean()) == pytest.approx(0, abs=4 * math.sqrt(variance / 40_000))
    assert float((errors**2).mean()) == pytest.approx(variance, rel=0.03)


def test_rows_of_a_group_share_an_rms():
    rows = [T("zernike", (1,), -2e-4, 2e-4, term=j, group="a", distribution="end_points") for j in (4, 5, 6, 7)]
    errors = rt.tolerancing.draw_errors([*rows, T("thickness", (1,), -1, 1)], 50)
    torch.testing.assert_close((errors[:, :4] ** 2).sum(1).sqrt(), torch.full((50,), 4e-4, dtype=torch.float64))


@pytest.mark.parametrize("distribution", ["normal", "uniform", "parabolic"])
def test_the_errors_of_a_group_have_a_random_direction_and_the_size_of_a_row(distribution):
    rows = [T(f"surface_decenter_{axis}", (1,), -0.1, 0.1, group="a", distribution=distribution) for axis in "xy"]
    errors = rt.tolerancing.draw_errors(rows, 20_000)
    size = errors.square().sum(1).sqrt() / math.sqrt(2)
    alone = rt.tolerancing.draw_errors([dataclasses.replace(rows[0], group="")], 20_000).abs().flatten()
    quantiles = torch.linspace(0.1, 1, 9, dtype=torch.float64)
    assert torch.allclose(torch.quantile(size, quantiles), torch.quantile(alone, quantiles), atol=2.5e-3)
    angle = torch.atan2(errors[:, 1], errors[:, 0])
    assert float(torch.stack([(n * angle).cos().mean() for n in (1, 2, 3)]).abs().max()) < 0.02
    mean, variance = moments(rows[0])
    assert mean == 0
    assert float(errors.square().mean()) == pytest.approx(variance, rel=0.02)
    assert float((errors[:, 0] * errors[:, 1]).mean()) == pytest.approx(0, abs=0.03 * variance)


def test_errors_of_a_table_have_its_density():
    density = ((0.0, 0.0), (0.2, 3.0), (0.5, 0.0), (0.9, 1.0), (1.0, 1.0))
    row = T("thickness", (1,), -1.0, 3.0, distribution="table", density=density)
    errors = rt.tolerancing.draw_errors([row], 50_000)[:, 0]
    x, p = np.array(density).T
    fine = np.linspace(0, 1, 4001)
    share = np.interp(fine, x, p)
    share = np.cumsum(share) / share.sum()
    for cut in (0.1, 0.3, 0.6, 0.95):
        assert float((errors < -1 + 4 * cut).double().mean()) == pytest.approx(np.interp(cut, fine, share), abs=6e-3)
    mean, variance = moments(row)
    assert float(errors.mean()) == pytest.approx(mean, abs=0.02)
    assert float(errors.var()) == pytest.approx(variance, rel=0.02)
    with pytest.raises(rt.BadTolerance, match="rising fractions"):
        rt.tolerancing.draw_errors([dataclasses.replace(row, density=((0.5, 1.0), (0.2, 1.0)))], 1)


# -- what a lens does not have ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (T("radius", (9,), -1, 1), "surfaces 1 to 5"),
        (T("raduis", (1,), -1, 1), "radius"),
        (T("radius", (1,), 1, -1), "minimum not above the maximum"),
        (T("radius", (1,), -1, math.inf), "finite limits"),
        (T("radius", (1,), -1, 1, distribution="gauss"), "expected one of normal"),
        (T("radius", (1,), -1, 1, sigmas=0.0), "more than 0"),
        (T("radius", (1, 2), -1, 1), "expected one surface"),
        (T("element_tilt_x", (3, 1), -1, 1), r"expected \(1, 3\)"),
        (T("thickness", (0,), -1, 1), "infinite"),
        (T("thickness", (1,), -1, 1, adjust=12), "adjusting surface 12"),
        (T("index", (3,), -1, 1), "followed by air"),
        (T("parameter", (1,), -1, 1, parameter="a3"), "no 'a3'"),
        (T("zernike", (1,), -1, 1, term=1), "from 2 to 231"),
        (T("operand", (), -1, 1, configuration=1, operand=0), "0 operands"),
    ],
)
def test_a_tolerance_that_the_lens_does_not_have_is_refused(row, message, nominal):
    with pytest.raises(rt.BadTolerance, match=message):
        rt.tolerancing.perturbed(nominal, [row], [0.0])


def test_elements_that_share_a_cemented_surface_are_refused_with_the_fix(nominal):
    message = (
        r"shares the cemented surface 2 with 1-2 .* tolerance the cemented group \(1, 3\), or the surfaces \(3, 3\)"
    )
    with pytest.raises(rt.BadTolerance, match=message):
        rt.tolerancing.perturbed(nominal, [*element(1, 2), *element(2, 3)], torch.zeros(10))


def test_elements_that_share_a_part_are_refused(nominal):
    with pytest.raises(rt.BadTolerance, match="shares a part of surfaces 1-3"):
        rt.tolerancing.perturbed(nominal, [*element(1, 3), *element(2, 5)], torch.zeros(10))


def test_a_radius_of_a_plane_and_a_wrong_number_of_errors_are_refused(nominal):
    with pytest.raises(rt.BadTolerance, match="plane"):
        rt.tolerancing.perturbed(nominal.replace(1, curvature=None), [T("radius", (1,), -1, 1)], [0.1])
    with pytest.raises(rt.BadTolerance, match=r"expected \(1,\)"):
        rt.tolerancing.perturbed(nominal, [T("radius", (1,), -1, 1)], [0.1, 0.2])


def test_a_surface_that_no_ray_reaches_has_no_fringes(nominal):
    bare = nominal.replace(1, semi_diameter=None).replace(3, thickness=-1e9)
    lens = dataclasses.replace(bare, optimization_data=None)
    lens = lens.replace(1, radius=1e-6)  # smaller than the beam
    with pytest.raises(rt.BadTolerance, match="no semi-diameter"):
        rt.tolerancing.perturbed(lens, [T("power", (1,), -1, 1)], [1.0])


# -- the lines of a file ----------------------------------------------------------------------------------------------

TAIL = """TOL COMP 5 0 -2 2 0 0 0
TCMM Default compensator on back focus.
TOL TWAV 0 0 0.5461 0 0 0 0
TOL TRAD 1 0 -0.2 0.2 0 0 0
TOL TRAD 2 1 -0.1 0.1 0 0 0
TOL TFRN 4 0 -1 2 0 0 0
TOL TTHI 1 3 -0.1 0.1 0 0 0
TOL TTHI 3 3 -0.1 0.1 0 0 0
TOL STAT 1 0 0 0 0 0 0
TOL TETX 1 3 -0.2 0.2 0 0 0
TOL SAVE 7 0 0 0 0 0 0
TOL TSDY 4 0 -0.2 0.2 0 0 0
TOL STAT 0 3 0 0 0 0 0
TOL TIRR 4 0 -0.5 0.5 0 0 0
TOL TEZI 5 6 -3e-4 3e-4 4 0 0
TOL TIND 1 0 -1e-3 1e-3 0 0 0
TOL TPAR 4 2 -1e-6 1e-6 0 0 0
TOL CPAR 4 3 -1e-8 1e-8 0 0 0
TOL ISOB 4 9 -1 1 0 0 0
TOL TQQQ 4 9 -1 1 0 0 0
TOL TOFF 0 0 0 0 0 0 0
"""


def with_lines(tmp_path, tail: str, head: str = HEAD):
    text = "\n".join(
        [head, "SURF 0\n  TYPE STANDARD\n  DISZ INFINITY", *(f"SURF {k}\n{s}" for k, s in enumerate(blocks(), 1))]
    )
    path = tmp_path / "made.zmx"
    path.write_text(f"{text}\nSURF 6\n  TYPE STANDARD\n  DISZ 0\n{tail}MNUM 1\n", encoding="utf-8")
    return path


def test_every_line_is_read_or_named(tmp_path):
    path = with_lines(tmp_path, TAIL)
    found = rt.tolerancing.read_tolerances(path)
    assert found.test_wavelength == 0.5461
    assert [(row.kind, row.surfaces, row.minimum, row.maximum) for row in found[:6]] == [
        ("radius", (1,), -0.2, 0.2),
        ("radius", (2,), -0.1, 0.1),
        ("power", (4,), -1.0, 2.0),
        ("thickness", (1,), -0.1, 0.1),
        ("thickness", (3,), -0.1, 0.1),
        ("element_tilt_x", (1, 3), -0.2, 0.2),
    ]
    assert [found[k].unit for k in (0, 1, 2)] == ["mm", "%", "fringes"]
    assert [found[k].adjust for k in (3, 4)] == [3, None]
    assert [found[k].distribution for k in (0, 5, 6, 7)] == ["normal", "uniform", "uniform", "normal"]
    assert [found[k].sigmas for k in (0, 7)] == [2.0, 3.0]
    assert found.saves == ((5, 7),)
    kinds = [row.kind for row in found[7:]]
    assert kinds == ["irregularity", "irregularity_angle", *["zernike"] * 3, "index", "parameter"]
    assert [row.term for row in found[9:12]] == [4, 5, 6]
    assert found[9].maximum == pytest.approx(3e-4 / math.sqrt(3))
    assert found[-1].parameter == "a4"
    line = path.read_text("utf-8").splitlines().index("TOL TRAD 1 0 -0.2 0.2 0 0 0") + 1
    assert found[0].source == f"made.zmx:{line}"
    assert [(one.surface, one.parameter, one.minimum) for one in found.compensators] == [
        (5, "thickness", -2.0),
        (4, "a6", -1e-8),
    ]
    assert [text.split(": ")[1] for text in found.unread] == ["ISOB", "TQQQ", "TOFF"]
    checked = rt.check(path)
    assert [text.split(": ")[1] for text in checked.unread_tolerances] == ["ISOB", "TQQQ", "TOFF"]
    assert "    not read: tolerance line:20: TQQQ: an operand that is not known" in str(checked).splitlines()
    draws = rt.tolerancing.draw_errors(found, 4)
    assert rt.tolerancing.perturbed(rt.read_lens(path), found, draws).surfaces[4].coefficients.shape == (2, 4, 1, 1, 1)


def lines_of(tmp_path, *lines):
    return rt.tolerancing.read_tolerances(with_lines(tmp_path, "".join(f"TOL {line}\n" for line in lines)))


def test_radial_decentres_are_groups_of_both_components(tmp_path):
    found = lines_of(tmp_path, "STAT 1 0", "TSDR 4 0 -0.2 0.2", "TEDR 1 3 -0.1 0.1")
    kinds = [(row.kind, row.surfaces, row.maximum, row.distribution) for row in found]
    assert kinds == [
        ("surface_decenter_x", (4,), pytest.approx(0.2 / math.sqrt(2)), "uniform"),
        ("surface_decenter_y", (4,), pytest.approx(0.2 / math.sqrt(2)), "uniform"),
        ("element_decenter_x", (1, 3), pytest.approx(0.1 / math.sqrt(2)), "uniform"),
        ("element_decenter_y", (1, 3), pytest.approx(0.1 / math.sqrt(2)), "uniform"),
    ]
    sizes = rt.tolerancing.draw_errors(found, 500)[:, :2].square().sum(1).sqrt()
    assert 0.19 < float(sizes.max()) <= 0.2
    assert float(sizes.mean()) == pytest.approx(0.1, rel=0.1)
    assert found.leaders.tolist() == [0, 0, 2, 2]


def test_a_roll_turns_an_element_about_the_centre_of_its_seat(nominal, tmp_path):
    lines = ("TARX 4 5 -2 1", "TARY 4 5 -1 2 5", "TRLX 4 5 -0.1 0.2", "TRLY 4 5 -0.1 0.2", "TRLR 4 5 -0.1 0.1 5")
    angle_x, angle_y, along_x, along_y, *radial = lines_of(tmp_path, *lines)
    assert (angle_x.kind, angle_x.minimum, angle_x.pivot) == ("element_tilt_x", -2, pytest.approx(1 / 0.03))
    assert (angle_y.kind, angle_y.maximum, angle_y.pivot) == ("element_tilt_y", 2, pytest.approx(2.5 + 1 / 0.01))
    # the seat is the same sphere, with its vertex elsewhere
    for row, limit, axis in ((along_x, along_x.minimum, 0), (along_y, along_y.maximum, 1)):
        rolled = rt.tolerancing.perturbed(nominal, [row], [limit])
        pose = pose_of(rows_along([rolled.surfaces[4].before]))
        assert float((pose.x, pose.y)[axis]) == pytest.approx(0.2, rel=1e-12)
        rear = rt.tolerancing.perturbed(nominal, [T(row.kind, (5, 5), -9, 9, pivot=row.pivot - 2.5)], [limit])
        close(hits(rolled, nominal), hits(rear, nominal), 1e-10)
    assert [row.kind for row in radial] == ["element_tilt_y", "element_tilt_x"]
    assert {row.group for row in radial} == {radial[0].source}


def test_a_roll_on_a_plane_is_a_decentre_and_by_an_angle_nothing(tmp_path):
    path = with_lines(tmp_path, "TOL TRLX 4 5 -0.1 0.2\nTOL TARX 4 5 -0.1 0.2\n")
    path.write_text(path.read_text("utf-8").replace("CURV 0.03 0 0 0 0", "CURV 0 0 0 0 0"), encoding="utf-8")
    found = rt.tolerancing.read_tolerances(path)
    assert [(row.kind, row.minimum, row.maximum) for row in found] == [("element_decenter_x", -0.1, 0.2)]
    assert "plane surface 4" in found.unread[0]


def test_pivots_of_tilts_of_elements(tmp_path):
    edge = 0.03 * 49 / (1 + math.sqrt(1 - (0.03 * 7) ** 2))
    rear = 2.5 + 0.01 * 49 / (1 + math.sqrt(1 - (0.01 * 7) ** 2))
    lines = [line for code in range(5) for line in (f"MPVT {code}", "TETX 4 5 -1 1")]
    found = lines_of(tmp_path, "TETY 4 5 -1 1", *lines)
    assert [row.pivot for row in found] == pytest.approx([0, 0, 2.5, edge, rear, 1.25], rel=1e-12)


def test_fringe_terms_of_a_file_have_their_sum_of_squares_at_the_rim(nominal, tmp_path):
    found = lines_of(tmp_path, "TWAV 0 0 0.5", "TEXI 2 8 -3 3 5")
    assert [(row.kind, row.term, row.group != "") for row in found] == [("fringe", j, True) for j in range(5, 9)]
    draws = rt.tolerancing.draw_errors(found, 20)
    torch.testing.assert_close(draws.square().sum(1).sqrt(), torch.full((20,), 3.0).double())
    lens = rt.tolerancing.perturbed(nominal, dataclasses.replace(found, rows=found.rows[:1]), [3.0])
    x, y = torch.tensor([[8.0, 0.0, 4.0], [0.0, 8.0, 4.0]], dtype=torch.float64)
    added = sag_at(lens.surfaces[2], x, y) - sag_at(nominal.surfaces[2], x, y)
    close(added, 3 * 0.25e-3 * torch.tensor([1.0, -1.0, 0.0]).double(), 1e-15)  # ρ² cos 2φ, half a wave a fringe


def test_a_table_of_a_distribution_lies_beside_the_file(tmp_path):
    tail = "TOL STAT 3 0 0 0 0 0 0\nTCMM lot.dat\nTOL TTHI 1 3 -0.1 0.1 0 0 0\n"
    path = with_lines(tmp_path, tail)
    without = rt.tolerancing.read_tolerances(path)
    assert without[0].distribution == "normal"
    assert "lot.dat is not beside the file" in without.unread[0]
    (tmp_path / "lot.dat").write_text("0 1\n0.5 0\n1 3\n")
    found = rt.tolerancing.read_tolerances(path)
    assert (found[0].distribution, found[0].density) == ("table", ((0.0, 1.0), (0.5, 0.0), (1.0, 3.0)))
    assert rt.tolerances(rt.read_lens(path))[0].density == found[0].density  # the lens holds the table
    (tmp_path / "lot.dat").write_text("0 1\n0.5 x\n")
    with pytest.raises(rt.LensFileError, match=r"lot.dat: expected two numbers a line"):
        rt.read_lens(path)


@pytest.mark.slow
def test_a_group_is_at_its_limits_at_once_and_a_line_of_the_table(tmp_path):
    found = lines_of(tmp_path, "COMP 5 0", "TEZI 5 6 -3e-4 3e-4 4", "TSDR 4 0 -0.2 0.2", "ISOB 1 0 -1 1")
    lens = rt.read_lens(tmp_path / "made.zmx").at(fields=[0.0])
    lens = rt.focus(lens).lens
    built = rt.tolerance(lens, found, trials=0)
    nominal, least, most = (
        rt.focus(rt.tolerancing.perturbed(lens, found, errors), rings=8).lens
        for errors in (torch.zeros(5), *(found.alone(limits)[0] for limits in (found.minimum, found.maximum)))
    )
    sizes = [1e3 * float(rt.spot(one, rings=8).rms_radius) for one in (nominal, least, most)]
    assert float(built.minimum[0]) == pytest.approx(sizes[1] - sizes[0], abs=2e-3)
    assert float(built.maximum[0]) == pytest.approx(sizes[2] - sizes[0], abs=2e-3)
    assert built.minimum[[1, 2, 4]].tolist() == [0, 0, 0]
    assert sorted(built.worst.tolist()) == [0, 3]
    text = str(built)
    assert "zernike 4 … zernike 6 of surface 5" in text
    assert "surface_decenter_radial of surface 4" in text
    assert "made.zmx:48: ISOB: figure by ISO 10110-5" in text.splitlines()[-1]
    tight = rt.tolerance(lens, found, trials=0, increment=1e-3, workshop="any")
    assert max(tight.minimum.max(), tight.maximum.max()) < 1.001e-3
    assert len({round(row.maximum, 12) for row in tight.tolerances[:3]}) == 1


def test_lengths_of_a_file_in_inches_become_millimetres(tmp_path):
    lines = "TOL COMP 5 0 -2 2\nTOL TRAD 1 0 -0.2 0.2\nTOL TCUR 1 0 -0.1 0.1\nTOL TETX 1 3 -1 1\nTOL TPAR 4 2 -1 1\n"
    found = rt.tolerancing.read_tolerances(with_lines(tmp_path, lines, HEAD.replace("UNIT MM", "UNIT IN")))
    limits = [row.maximum for row in found]
    assert limits == pytest.approx([0.2 * 25.4, 0.1 / 25.4, 1.0, 25.4**-3])
    assert found.compensators[0].maximum == pytest.approx(2 * 25.4)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("TOL TRAD 9 0 -1 1", r"made.zmx:\d+: TRAD: surface 9; this lens has surfaces 0 to 6"),
        ("TOL TRAD 1 0 -1 x", r"made.zmx:\d+: TRAD: maximum is 'x', expected a finite number"),
        ("TOL TRAD 1 0 2 1", r"TRAD: minimum 2 above maximum 1"),
        ("TOL TETX 4 2 -1 1", r"TETX: last surface 2 before 4"),
        ("TOL TUDX 4 0 -1 1", r"TUDX: surface 4 is no coordinate break"),
        ("TOL TMCO 1 1 -1 1", r"TMCO: row 1; this lens has 0 operands"),
        ("TOL TWAV 0 0 0", r"TWAV: test wavelength in µm is 0, expected more than 0"),
        ("TOL TEZI 4 300 -1 1", r"TEZI: terms 2 to 300"),
        ("TOL STAT 0 -1", r"STAT: -1 standard deviations"),
        ("TOL STAT 4 0", r"STAT: distribution 4, expected 0 to 3"),
        ("TOL TEXI 4 38 -1 1", r"TEXI: terms 2 to 38"),
        ("TOL MPVT 5", r"MPVT: pivot 5, expected 0 to 4"),
        ("TOL TARX 1 3 -1 1 4", r"TARX: the seat, surface 4, is not one of the element 1 to 3"),
        ("TOL TRLX 1 3 -99 99", r"TRLX: a decentre beyond the radius 50 mm of surface 1"),
    ],
)
def test_a_line_that_the_lens_does_not_have_is_refused(line, message, tmp_path):
    with pytest.raises(rt.LensFileError, match=message):
        rt.tolerancing.read_tolerances(with_lines(tmp_path, line + "\n"))


def test_a_file_without_tolerances_is_refused(tmp_path):
    with pytest.raises(rt.LensFileError, match="no lines of tolerances"):
        rt.tolerancing.read_tolerances(with_lines(tmp_path, ""))


DEVELOPMENT = SHARED / "tolerance" / "dev"
#: Rows of each file, with an angle for each irregularity.
REAL = {"SC_Tol_Cooke": 47, "SC_Tol_singlet2": 11, "sc_tol_DblPass3": 17, "sc_tol_scan1": 26, "ASL10142-1064": 9}


@pytest.mark.needs(DEVELOPMENT)
@pytest.mark.parametrize("name", REAL)
def test_files_of_others_are_read_and_their_lenses_made(name):
    path = DEVELOPMENT / f"{name}.zmx"
    lens, found = rt.read_lens(path), rt.tolerancing.read_tolerances(path)
    text = path.read_bytes()
    text = text.decode("utf-16" if text[:2] in (b"\xff\xfe", b"\xfe\xff") else "utf-8")
    lines = [line for line in text.splitlines() if line.startswith("TOL ")]
    angles = sum(row.kind == "irregularity_angle" for row in found)
    assert len(found) - angles + len(found.compensators) + 1 == len(lines)
    assert len(found) == REAL[name]
    assert not found.unread
    draws = rt.tolerancing.draw_errors(found, 2, seed=5)
    for one in lens.configurations:
        together = rt.tolerancing.perturbed(one, found, draws)
        alone = rt.tolerancing.perturbed(one, found, draws[1])
        rays = launch(one, torch.tensor([[0.0, 0.3], [0.2, -0.4]], dtype=torch.float64))
        ends = [trace_lens(made, rays, one.primary) for made in (together, alone)]
        assert ends[1].valid.any()
        close(ends[0].position[:, 1], ends[1].position, 1e-12)


@pytest.mark.needs(DEVELOPMENT)
def test_errors_of_a_lens_in_double_pass_are_in_both_passes():
    path = DEVELOPMENT / "sc_tol_DblPass3.zmx"
    lens, found = rt.read_lens(path), rt.tolerancing.read_tolerances(path)
    errors = torch.zeros(len(found), dtype=torch.float64)
    values = {"radius of surface 2": 0.2, "thickness of surface 2": 0.1, "index of surface 2": 1e-3}
    values |= {"parameter x of surface 1": 0.15, "parameter tilt_x of surface 1": 0.1}
    values |= {"irregularity of surface 3": 0.2, "surface_decenter_x of surface 2": 0.05}
    for label, value in values.items():
        errors[found.labels.index(label)] = value
    s = rt.tolerancing.perturbed(lens, found, errors).surfaces
    assert float(1 / s[10].curvature) == pytest.approx(float(1 / s[2].curvature), rel=1e-14)
    assert float(1 / s[2].curvature - 1 / lens.surfaces[2].curvature) == pytest.approx(0.2, rel=1e-9)
    assert [float(s[k].thickness) for k in (2, 3, 4)] == pytest.approx([4.3, -4.3, 4.3])
    assert float(s[9].thickness) == pytest.approx(-4.3)
    assert s[9].glass is s[2].glass
    assert [float(s[k].before.x) for k in (1, 4, 8, 11)] == pytest.approx([0.15, -0.15, 0.15, -0.15])
    assert [float(s[k].before.tilt_x) for k in (1, 4, 8, 11)] == pytest.approx([0.1, -0.1, 0.1, -0.1])
    h = number(7.0)
    sags = [float(sag_at(s[k], 0 * h, h) - sag_at(lens.surfaces[k], 0 * h, h)) for k in (3, 9)]
    assert sags[0] == pytest.approx(sags[1], rel=1e-12)
    assert abs(sags[0]) > 1e-6
    assert [float(s[k].before.x) for k in (2, 10)] == pytest.approx([0.05, 0.05])


@pytest.mark.needs(DEVELOPMENT)
def test_an_error_of_an_operand_is_in_its_configuration_alone():
    path = DEVELOPMENT / "sc_tol_scan1.zmx"
    lens, found = rt.read_lens(path), rt.tolerancing.read_tolerances(path)
    place = next(k for k, row in enumerate(found) if row.kind == "operand" and row.configuration == 2)
    made = rt.tolerancing.perturbed(lens, found, torch.zeros(len(found)).index_fill(0, torch.tensor(place), 0.5))
    angles = [float(one.surfaces[3].before.tilt_x) for one in made.configurations]
    assert angles == pytest.approx([-10, -4.5, 0, 5, 10])
    assert [float(one.surfaces[5].before.tilt_x) for one in made.configurations] == pytest.approx([10, 4.5, 0, -5, -10])


# -- grades and limits ------------------------------------------------------------------------------------------------


def test_a_grade_has_rows_for_every_face_element_and_gap_with_their_source(nominal):
    found = rt.tolerances(nominal, grade="precision")
    places = {kind: [row.surfaces for row in found if row.kind == kind] for kind in KINDS}
    assert sorted(places["radius"] + places["power"]) == [(1,), (2,), (3,), (4,), (5,)]
    assert places["irregularity"] == [(1,), (2,), (3,), (4,), (5,)]
    assert places["thickness"] == [(1,), (2,), (4,), (3,)]
    assert [row.adjust for row in found if row.kind == "thickness"] == [3, 3, 5, None]
    assert places["element_tilt_x"] == [(1, 3), (4, 5)]
    assert places["surface_runout_x"] == [(2,), (3,), (5,)]
    assert places["index"] == [(1,), (2,), (4,)]
    assert all(row.source for row in found)
    assert [one.surface for one in found.compensators] == [5]
    assert "Manufacturing Tolerance Chart" in str(found)


def test_a_radius_may_differ_by_the_larger_of_its_part_and_of_fringes(nominal):
    """One fringe is N λ |R|/h² of a radius: 0.0494 % of surface 1, 0.066 % of surface 2."""
    found = rt.tolerances(nominal, grade="high")
    assert [row.surfaces for row in found if row.kind == "radius"] == [(1,), (4,)]
    assert [row.surfaces for row in found if row.kind == "power"] == [(2,), (3,), (5,)]
    plane = rt.tolerances(nominal.replace(1, curvature=None), grade="high")
    assert (1,) in [row.surfaces for row in plane if row.kind == "power"]
    made = rt.tolerancing.perturbed(nominal, [T("power", (1,), -1, 1)], [1.0]).surfaces[1]
    assert abs(0.02 / float(made.curvature) - 1) == pytest.approx(0.6328e-3 / (0.02 * 64), rel=0.02)


def test_the_page_has_the_figures_of_the_grades():
    page = (Path(__file__).parents[1] / "docs" / "reference" / "tolerances.md").read_text("utf-8")
    table = page.partition("| limit ± |")[2]
    for word in GRADES["precision"]:
        figures = [GRADES[name][word] for name in ("commercial", "precision", "high")]
        parts = [
            f"{one.limit:g}{one.unit}" + (f" or {one.fringes:g} fringes" if one.fringes else "") for one in figures
        ]
        line = next(line for line in table.splitlines() if line.startswith(f"| `{word}`"))
        assert [cell.strip() for cell in line.split("|")[2:5]] == parts
        assert all(part in line for one in figures for part in one.source.split("; "))


def test_the_grades_get_tighter():
    grades = [GRADES[name] for name in ("commercial", "precision", "high")]
    for word in grades[0]:
        limits = [grade[word].limit for grade in grades]
        assert limits == sorted(limits, reverse=True), word
        assert len({*limits}) == 3


def test_limits_take_the_place_of_a_grade(nominal):
    text = "radius=0.3% power:2=-1..4 thickness=0.02 air=0 element_tilt=0.05 irregularity:1,3=0.25 element_roll=1"
    found = rt.tolerances(nominal, text, grade="commercial", distribution="uniform")
    limits = {(row.kind, row.surfaces): (row.minimum, row.maximum, row.unit) for row in found}
    assert limits["radius", (1,)] == (-0.3, 0.3, "%")
    assert ("radius", (2,)) not in limits
    assert limits["power", (2,)] == (-1.0, 4.0, "fringes")
    assert limits["thickness", (1,)] == (-0.02, 0.02, "mm")
    assert ("thickness", (3,)) not in limits
    assert limits["element_tilt_y", (1, 3)] == (-0.05, 0.05, "degrees")
    assert limits["irregularity", (1,)] == (-0.25, 0.25, "fringes")
    assert limits["irregularity", (2,)] == (-2.0, 2.0, "fringes")
    assert limits["element_roll", (4, 5)] == (-1.0, 1.0, "degrees")
    row = next(row for row in found if row.kind == "radius")
    assert (row.source, row.distribution) == ("limits radius=0.3%", "uniform")
    assert (
        rt.tolerancing.perturbed(nominal, found, rt.tolerancing.draw_errors(found, 1)[0]).surfaces[1]
        is not nominal.surfaces[1]
    )


def test_limits_alone_and_of_a_file(nominal, tmp_path):
    assert [row.kind for row in rt.tolerances(nominal, "curvature=1e-5")] == ["curvature"] * 5
    lens = rt.read_lens(with_lines(tmp_path, TAIL))
    read = rt.tolerancing.read_tolerances(tmp_path / "made.zmx")
    assert [dataclasses.replace(row, source="", group="") for row in rt.tolerances(lens)] == [
        dataclasses.replace(row, source="", group="") for row in read
    ]
    found = rt.tolerances(lens, "thickness=0.5")
    assert [(row.surfaces, row.maximum) for row in found if row.kind == "thickness"] == [
        ((3,), 0.1),
        ((1,), 0.5),
        ((2,), 0.5),
        ((4,), 0.5),
    ]
    assert len(found.compensators) == 2


@pytest.mark.parametrize(
    ("limits", "grade", "message"),
    [
        ("", None, "no tolerances of its own"),
        ("", "fine", "expected one of commercial, precision, high"),
        ("radius", None, "expected a kind and its limit"),
        ("raduis=1", None, "no tolerance 'raduis'; did you mean radius"),
        ("index=1%", None, "only radius and abbe"),
        ("index=x", None, "expected a number"),
        ("index=-1", None, "expected a positive number"),
        ("index=2..1", None, "limits 2 to 1"),
        ("index:3=1e-3", None, "surface 3 has no index; it belongs to 1, 2, 4"),
        ("radius:1--2=1", None, "is no surface number"),
    ],
)
def test_limits_that_no_lens_has_are_refused(limits, grade, message, nominal):
    with pytest.raises(rt.BadTolerance, match=message):
        rt.tolerances(nominal, limits, grade=grade)


def test_tolerances_print_and_are_saved(nominal, tmp_path):
    found = rt.tolerances(nominal, "radius=0.1% element_tilt=0.05")
    assert "radius of surface 1" in str(found)
    assert "element_tilt_x of surfaces 1-3" in str(found)
    assert "compensator: thickness of surface 5" in str(found)
    found.save(tmp_path / "tolerances.json")
    found.save(tmp_path / "tolerances.csv")
    rows = json.loads((tmp_path / "tolerances.json").read_text("utf-8"))["tolerances"]
    assert rows[0] == {
        **{"kind": "radius", "surfaces": [1], "minimum": -0.1, "maximum": 0.1, "unit": "%", "distribution": "normal"},
        **{"sigmas": 2.0, "pivot": 0.0, "term": 0, "configuration": 0, "source": "limits radius=0.1%"},
    }
    assert (tmp_path / "tolerances.csv").read_text("utf-8").count("radius of surface") == 5


def test_errors_go_through_transforms_and_single_precision(asphere):
    rows = [row for row, _ in ROWS]
    sensor, values = sensor_of(asphere, rows), errors().requires_grad_()
    weights = torch.tensor([1.0, -0.7], dtype=torch.float64)[:, None, None, None]
    (slope,) = torch.autograd.grad((weights * sensor(values)).sum(), values)
    forward = torch.func.jacfwd(sensor)(errors())
    close((weights[..., None] * forward).flatten(0, -2).sum(0), slope, 1e-10)
    batch = torch.stack([errors(), errors(-0.5)])
    close(torch.func.vmap(sensor)(batch).transpose(0, 1), sensor(batch), 1e-12)
    single = rt.tolerancing.perturbed(rt.to(asphere, dtype=torch.float32), rows, batch).surfaces[1:]
    numbers = [number for surface in single for number in (surface.thickness, surface.curvature) if number is not None]
    assert {number.dtype for number in numbers} == {torch.float32}


def sensor_of(lens, rows):
    """Errors -> (2, ...) mm on the sensor."""
    points = torch.tensor([[0.0, 0.3, -0.8], [0.0, 0.7, -0.4]], dtype=torch.float64)
    fields = torch.tensor([[0.0, 3.0], [0.0, 5.0]], dtype=torch.float64)
    rays = launch(lens, points, fields=fields, wavelengths=lens.wavelengths)
    return lambda values: trace_lens(
        rt.tolerancing.perturbed(lens, rows, values), rays, lens.wavelengths[:, None]
    ).position[:2]


def test_lines_behind_the_configurations_are_read(tmp_path):
    source = Path(__file__).parents[1] / "lenses" / "cooke_triplet.zmx"
    lines = [
        "MNUM 1 1",
        'MOFF   0   1 "" 0 0 0 1 1 0 0.0 ""',
        "TOL COMP 7 0 -1 1 0 0 0",
        "TOL TTHI 2 4 -0.02 0.02 0 0 0",
    ]
    file = tmp_path / "triplet.zmx"
    file.write_text(source.read_text() + "\n".join(lines) + "\n")
    found = rt.tolerancing.read_tolerances(file)
    assert [row.kind for row in found] == ["thickness"]
    assert [(one.surface, one.parameter, one.maximum) for one in found.compensators] == [(7, "thickness", 1.0)]
    assert not found.unread


def test_one_surface_may_move_in_several_ways_alone_and_in_its_element():
    lens = rt.read_lens("cooke_triplet")
    rows = [rt.system.Tolerance(f"element_decenter_{axis}", (k, k), -0.1, 0.1) for axis in "xy" for k in (3, 4)]
    rows += [rt.system.Tolerance("element_tilt_x", (3, 4), -0.1, 0.1)]
    moved = rt.tolerancing.perturbed(lens, rows, [0.1, 0.0, 0.05, 0.0, 0.1])
    single = rt.tolerancing.perturbed(rt.tolerancing.perturbed(lens, rows[4:], [0.1]), rows[:4], [0.1, 0.0, 0.05, 0.0])
    assert not torch.equal(rt.spot(moved).whole.centroid, rt.spot(lens).whole.centroid)
    assert rt.spot(single).whole.valid.all()


# -- stored in a lens


def plain_rows(table):
    """The rows and compensators of a table by their numbers, in the order of their places."""
    rows = [
        (row.kind, row.surfaces, row.minimum, row.maximum, row.distribution, row.sigmas, row.adjust, row.pivot,
         row.parameter, row.term, bool(row.group), row.configuration, row.operand)
        for row in table.rows
    ]  # fmt: skip
    moved = [(c.variable, c.minimum, c.maximum) for c in table.compensators]
    return [sorted(map(repr, rows)), moved, table.test_wavelength]


@pytest.mark.parametrize(
    "words",
    [
        {"grade": "precision"},
        {"grade": "high", "distribution": "uniform", "sigmas": 2.0},
        {"grade": "precision", "limits": "power=2 curvature:2=1e-5 element_roll=0.25 surface_decenter:3=0.125"},
        {"limits": "surface_tilt=0.0625 conic:2=-0.25..0.5", "sigmas": 3.0},
    ],
)
def test_a_lens_stores_its_tolerances(words, nominal, tmp_path):
    table = rt.tolerances(nominal, compensators=[rt.system.Compensator(5, "thickness", -0.5, 0.25)], **words)
    # an Abbe number in % is stored as a number
    numbers = [row.unit == "%" and row.kind == "abbe" for row in table.rows]
    exact = dataclasses.replace(table, rows=tuple(r for r, n in zip(table.rows, numbers, strict=True) if not n))
    rt.write_lens(nominal.with_tolerances(exact), tmp_path / "stored.zmx")
    again = rt.tolerancing.read_tolerances(tmp_path / "stored.zmx")
    assert plain_rows(again) == plain_rows(exact)
    assert {row.source for row in again} == {row.source for row in exact}
    assert not again.unread


def test_an_abbe_number_in_per_cent_is_stored_as_a_number(nominal):
    lens = rt.read_lens("cooke_triplet")
    table = rt.tolerances(lens, "abbe=0.5%")
    stored = rt.tolerances(lens.with_tolerances(table))
    for row, old in zip(stored, table, strict=True):
        expected = 0.005 * float(abbe_number(lens.surfaces[old.surfaces[0]].glass))
        assert (row.minimum, row.maximum) == pytest.approx((-expected, expected), rel=1e-12)
    for k, error in enumerate((0.5, -0.25)):  # the same glass
        lenses = [
            rt.tolerancing.perturbed(lens, each, [error * each[k].maximum if n == k else 0.0 for n in range(len(each))])
            for each in (table, stored)
        ]
        glasses = [each.surfaces[table[k].surfaces[0]].glass for each in lenses]
        assert float(index(glasses[0], 0.45)) == pytest.approx(float(index(glasses[1], 0.45)), abs=1e-13)


def test_radial_errors_are_stored_with_both_components(tmp_path):
    lens = rt.read_lens("cooke_triplet")
    table = rt.tolerances(lens, grade="precision", radial=True)
    rt.write_lens(lens.with_tolerances(table), tmp_path / "stored.zmx")
    again = rt.tolerancing.read_tolerances(tmp_path / "stored.zmx")
    operands = [line.split()[1] for line in (tmp_path / "stored.zmx").read_text().splitlines() if "TOL T" in line]
    assert operands.count("TEDR") == 3
    assert operands.count("TETX") == operands.count("TIRX") == operands.count("TIRY") == 3

    def magnitudes(of):
        return {(error.name, of[first].surfaces): error.magnitude for first, error in of.radial.items()}

    assert magnitudes(again).keys() == magnitudes(table).keys()
    assert all(magnitudes(again)[key] == pytest.approx(size, rel=1e-14) for key, size in magnitudes(table).items())


def test_stored_tolerances_are_in_the_unit_of_the_file(nominal):
    lens = nominal.with_conditions("efl=40")
    inches = dataclasses.replace(lens, optimization_data=dataclasses.replace(lens.optimization_data, unit=25.4))
    table = rt.tolerances(inches, "thickness=0.0254 curvature=1e-5", compensators=[rt.system.Compensator(5)])
    stored = inches.with_tolerances(table)
    line = next(line for line in stored.optimization_data.tolerances if "TTHI" in line)
    assert float(line.split()[5]) == pytest.approx(0.001, rel=1e-12)
    again = rt.tolerances(stored)
    assert [row.maximum for row in again] == pytest.approx([row.maximum for row in table], rel=1e-14)


@pytest.mark.needs(DEVELOPMENT)
@pytest.mark.parametrize("name", REAL)
def test_tolerances_of_files_of_others_are_stored_again(name):
    lens = rt.read_lens(DEVELOPMENT / f"{name}.zmx")
    table = rt.tolerances(lens)
    again = rt.tolerances(lens.with_tolerances(table))
    assert sorted(again.minimum.tolist()) == pytest.approx(sorted(table.minimum.tolist()), rel=1e-12)
    assert sorted(f"{row.name} {row.where} {row.distribution}" for row in again) == sorted(
        f"{row.name} {row.where} {row.distribution}" for row in table
    )
    assert [c.variable for c in again.compensators] == [c.variable for c in table.compensators]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"limits": "element_decenter_z=0.1"}, "no operand"),
        ({"limits": "element_decenter_radial=0.1", "distribution": "disc"}, "'disc'; a .zmx file has normal"),
    ],
)
def test_tolerances_without_a_line_are_refused(words, message, nominal):
    with pytest.raises(rt.BadTolerance, match=message):
        nominal.with_tolerances(rt.tolerances(nominal, **words))


def test_stored_tolerances_are_removed_by_none(nominal):
    stored = nominal.with_tolerances(rt.tolerances(nominal, grade="high"))
    assert stored.with_tolerances(()).optimization_data.tolerances == ()
    with pytest.raises(rt.BadTolerance):
        nominal.with_tolerances([T("radius", (17,), -0.1, 0.1)])

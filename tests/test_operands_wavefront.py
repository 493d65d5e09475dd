"""Operands of optical path: against the wavefront, the paths between hits, an oracle, and finite differences."""

import itertools
import json

import numpy as np
import pytest
import torch
from bends import folded
from differences import slopes_by_differences
from problems import SHARED, surface, values, vector
from problems import lens as lens_of

import raytrace as rt
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.operands.operand import BadRow, Conventions
from raytrace.optimization.operands.wavefront import Fit
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import media
from raytrace.system.optimization_data import Row, Vary
from raytrace.tracing.launch import rays_of_field, vignette
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import scene
from raytrace.tracing.trace import lens_steps, trace_lens
from raytrace.tracing.wavefront import path_to_reference_sphere, wavefront_of

DEVELOPMENT = SHARED / "merit" / "dev"
WAVES = 1e-7  # what the oracle is held to

POINTS = [(0.0, 0.0), (0.0, 0.95), (0.5, -0.4), (-0.3, 0.7), (0.8, 0.1), (0.0, -0.6), (0.6, 0.6), (-0.9, 0.2)]
FIELDS = [(0.0, 0.0), (0.0, 0.7), (0.4, 0.6)]


def rows(operand: str, *, wavelengths=(1, 2, 3), fields=FIELDS, points=POINTS) -> list[Row]:
    """Rows with unlike weights."""
    asked = [(w, h, p) for h in fields for w in wavelengths for p in points]
    return [Row(operand, (0, w), (*h, *p), weight=0.5 + 0.1 * (k % 7)) for k, (w, h, p) in enumerate(asked)]


def beam(lens: rt.Lens, w: int, field, points) -> tuple[rt.system.Rays, torch.Tensor, torch.Tensor]:
    """Rays on the image of one wavelength and field (part of the largest), the index there and the wavelength."""
    largest = torch.hypot(lens.fields.x, lens.fields.y).max()
    at, wavelength = largest * vector(*field)[:, None], lens.wavelengths[w]
    pupil = vignette(lens, at, torch.tensor(points, dtype=torch.float64).T)
    rays = rays_of_field(lens, at, pupil, wavelength=wavelength)
    return trace_lens(lens, rays, wavelength), media(lens, wavelength)[-2], wavelength


def opd_by_definition(lens: rt.Lens, w: int, field, points, about: int | None = None) -> np.ndarray:
    """Waves, on the sphere about the chief ray's point through the axial point of the exit pupil."""
    rays, index, wavelength = beam(lens, w, field, [(0.0, 0.0), *points])
    centre = beam(lens, w if about is None else about, field, [(0.0, 0.0)])[0].position
    pupil = torch.stack([0 * centre[0], 0 * centre[0], first_order(lens).exit_pupil_position.reshape(1)])
    radius = torch.linalg.vector_norm(centre - pupil, dim=0)
    radius = radius * torch.sign(((centre - pupil) * rays.direction[:, :1]).sum(0))
    path = path_to_reference_sphere(rays, centre, 1 / radius, index)
    return ((path[1:] - path[0]) / (1e-3 * wavelength)).numpy()


# -- the wavefront ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["double_gauss_28deg", "cooke_triplet", "hubble", "telephoto"])
def test_opdc_is_the_path_to_the_sphere_through_the_pupils_axial_point(name):
    """To a femtometre or two, what is left of float64 behind 60 m of telescope."""
    lens = rt.read_lens(name)
    colours = range(1, len(lens.wavelengths) + 1)
    found = values(lens, rows("OPDC", wavelengths=colours))
    expected = np.concatenate([opd_by_definition(lens, w - 1, h, POINTS) for h in FIELDS for w in colours])
    assert np.abs(found - expected).max() < 3e-2 * WAVES


def test_opdc_is_the_wavefront_of_the_analyses_up_to_the_radius_of_the_sphere():
    """Radii to the plane and to the axial point of the pupil differ: not on the axis, and elsewhere by e²/2 of that."""
    lens = rt.read_lens("cooke_triplet")
    points = torch.tensor(POINTS, dtype=torch.float64).T
    for field, tolerance in (((0.0, 0.0), 1e-10), ((0.0, 0.7), 1e-3)):
        largest = torch.hypot(lens.fields.x, lens.fields.y).max()
        front = wavefront_of(
            scene(lens, largest * vector(*field)[:, None], lens.surfaces[0].thickness[None], lens.wavelengths), points
        )
        expected = (front.opd[0, 0] / (1e-3 * lens.wavelengths[:, None])).flatten()
        lit = front.valid[0, 0].flatten().numpy()
        found = values(lens, rows("OPDC", fields=[field]))
        assert lit.sum() > 12
        assert np.abs(found - expected.numpy())[lit].max() < tolerance * np.abs(found).max()


def test_a_telecentric_lens_has_a_plane_for_a_sphere():
    stop = surface(None, 100.0)
    singlet = surface(0.01, 5.0, 1.5), surface(-0.01, 96.0)
    plain = lens_of([stop, *singlet], aperture=("entrance_pupil_diameter", 8.0))
    front = float(first_order(plain).front_focal_distance)
    telecentric = plain.replace(1, thickness=100.0 - (front - 0.0))
    pupil = first_order(telecentric).exit_pupil_position.abs()
    assert float(pupil) > 1e12
    asked = rows("OPDC", wavelengths=(1,), fields=[(0.0, 0.0)])
    rays, index, wavelength = beam(telecentric, 0, (0.0, 0.0), [(0.0, 0.0), *POINTS])
    path = path_to_reference_sphere(rays, rays.position[:, :1], torch.tensor(0.0).double(), index)
    found = values(telecentric, asked)
    assert np.abs(found - ((path[1:] - path[0]) / (1e-3 * wavelength)).numpy()).max() < WAVES
    assert np.abs(found).max() > 1.0


def test_a_folded_lens_has_the_wavefront_of_the_straight_one():
    """The pupil is then that about the base ray: the same about an axis that a mirror has bent."""
    lens = rt.read_lens("double_gauss_28deg")
    bent = folded(lens, len(lens.surfaces) - 2, tilt_x=35.0, tilt_y=10.0)
    asked = rows("OPDC", fields=[(0.0, 0.0), (0.0, 0.7)])
    straight, turned = values(lens, asked), values(bent, asked)
    assert np.abs(straight - turned).max() < WAVES
    assert np.abs(straight).max() > 1.0


# -- what is taken off it ----------------------------------------------------------------------------------------------


def groups(asked: list[Row]) -> list[list[int]]:
    found = {}
    for k, row in enumerate(asked):
        found.setdefault((row.numbers[:2], row.integers[1]), []).append(k)
    return list(found.values())


def test_opdx_is_minimal_over_piston_and_tilt():
    """Least squares: what is left is at right angles to 1, x and y, by weight, in every field and colour."""
    lens = rt.read_lens("double_gauss_28deg")
    asked = rows("OPDX", fields=[(0.3, 0.6), (0.0, 0.7)])
    weights = np.array([row.weight for row in asked])
    x, y = np.array([row.numbers[2:] for row in asked]).T
    found, plain = values(lens, asked), values(lens, rows("OPDC", fields=[(0.3, 0.6), (0.0, 0.7)]))
    for places in groups(asked):
        w, v = weights[places], found[places]
        terms = [1.0, y[places]] + ([x[places]] if asked[places[0]].numbers[0] else [])
        assert max(abs((w * v * term).sum()) for term in terms) < 1e-9 * np.abs(plain).max()
        difference = plain[places] - v
        basis = np.stack([np.ones(len(places)), x[places], y[places]], 1)
        left = difference - basis @ np.linalg.lstsq(basis, difference, rcond=None)[0]
        assert np.abs(left).max() < 1e-9 * np.abs(plain).max()


def test_opdm_has_no_mean():
    lens = rt.read_lens("double_gauss_28deg")
    asked = rows("OPDM")
    weights, found, plain = np.array([row.weight for row in asked]), values(lens, asked), values(lens, rows("OPDC"))
    for places in groups(asked):
        mean = np.average(plain[places], weights=weights[places])
        assert np.abs(found[places] - (plain[places] - mean)).max() < 1e-10


def test_half_a_pupil_gives_the_tilt_of_the_whole():
    """Rows of a symmetric lens leave out the half of the pupil where x < 0: no tilt along x then."""
    lens = rt.read_lens("double_gauss_28deg")
    part = [(0.0, 0.9), (0.5, 0.5), (0.7, -0.2), (0.3, -0.8)]
    both = part + [(-x, y) for x, y in part]
    for field, whole in (((0.0, 0.8), both), ((0.0, 0.0), both + [(x, -y) for x, y in both])):
        few, many = ([Row("OPDX", (0, 2), (*field, *p), weight=1.0) for p in points] for points in (part, whole))
        assert np.abs(values(lens, few) - values(lens, many)[:4]).max() < 1e-10


def test_a_row_without_weight_shows_a_value_and_changes_no_other():
    lens = rt.read_lens("cooke_triplet")
    asked = rows("OPDX")
    silent = [*asked, Row("OPDX", (0, 2), (0.0, 0.7, 0.1, 0.99))]
    found = values(lens, silent)
    assert np.array_equal(found[:-1], values(lens, asked))
    assert np.isfinite(found[-1])
    alone = [Row("OPDX", row.integers, row.numbers) for row in asked]
    equal = [Row("OPDX", row.integers, row.numbers, weight=3.0) for row in asked]
    assert np.abs(values(lens, alone) - values(lens, equal)).max() < 1e-12


def test_a_fit_leaves_out_missing_rays():
    basis = np.stack([np.ones(6), np.arange(6.0)], 1)
    weights, there = np.array([1.0, 2, 1, 3, 1, 1]), np.array([1, 1, 0, 1, 1, 1], dtype=bool)
    numbers = np.array([0.3, -1.0, 99.0, 4.0, 1.0, 0.5])
    found = Fit(basis, weights).less(numbers, there)
    expected = Fit(basis[there], weights[there]).less(numbers[there], there[there])
    assert np.abs(found[there] - expected).max() < 1e-13


# -- open conventions --------------------------------------------------------------------------------------------------


def test_a_common_tilt_is_one_of_the_path():
    """It leaves more than a tilt for each colour; what is left has no common tilt, by weight, in mm."""
    lens = rt.read_lens("double_gauss_28deg")
    asked = rows("OPDX", fields=[(0.0, 0.7)])
    weights, y = np.array([row.weight for row in asked]), np.array([row.numbers[3] for row in asked])
    waves = lens.wavelengths.numpy()[[row.integers[1] - 1 for row in asked]]
    each, common = values(lens, asked), values(lens, asked, conventions=Conventions(opd_tilt="common"))
    assert weights @ common**2 > (1 + 1e-6) * (weights @ each**2)
    assert abs((weights * common * y / waves).sum()) < 1e-9
    assert max(abs((weights[p] * common[p]).sum()) for p in groups(asked)) < 1e-9
    single = rows("OPDX", wavelengths=(2,))
    assert np.abs(values(lens, single) - values(lens, single, conventions=Conventions(opd_tilt="common"))).max() < 1e-12


def test_the_sphere_of_the_primary_wavelength():
    lens = rt.read_lens("double_gauss_28deg")
    asked = rows("OPDC", fields=[(0.0, 0.7)])
    found = values(lens, asked, conventions=Conventions(opd_chief="primary"))
    primary = lens.primary_wavelength - 1
    expected = np.concatenate([opd_by_definition(lens, w, (0.0, 0.7), POINTS, about=primary) for w in range(3)])
    assert np.abs(found - expected).max() < 1e-3 * WAVES
    assert np.abs(found - values(lens, asked)).max() > 1e-3


def test_the_sign_of_a_longer_path():
    lens = rt.read_lens("cooke_triplet")
    asked = rows("OPDC")
    assert np.array_equal(values(lens, asked), -values(lens, asked, conventions=Conventions(opd_sign="shorter")))


def test_a_reading_that_is_not_known_is_refused_by_name():
    with pytest.raises(ValueError, match=r"`opd_tilt` 'mine': .*per wavelength, common"):
        Conventions(opd_tilt="mine")


# -- paths -------------------------------------------------------------------------------------------------------------


def paths_between_hits(lens: rt.Lens, w: int, field, point) -> tuple[list[float], float]:
    """Optical path (mm) from surface k to k + 1, from 1 on, and from the object's plane to surface 1."""
    largest, wavelength = torch.hypot(lens.fields.x, lens.fields.y).max(), lens.wavelengths[w]
    at = largest * vector(*field)
    rays = rays_of_field(lens, at, vignette(lens, at, vector(*point)), wavelength=wavelength)
    n, vertex, hits = media(lens, wavelength), 0.0, []
    begun, along = rays.position.flatten(), rays.direction.flatten()
    for k, crossing in enumerate(lens_steps(lens, rays, wavelength), 1):
        at = crossing.rays.position.flatten().clone()
        at[2] += vertex
        hits.append(at)
        vertex = vertex + lens.surfaces[k].thickness
    legs = [float(n[k] * torch.dist(a, b)) for k, (a, b) in enumerate(itertools.pairwise(hits), 1)]
    source = begun - (begun[2] + lens.surfaces[0].thickness) / along[2] * along
    first = float(n[0] * torch.dist(source, hits[0])) if lens.surfaces[0].thickness.isfinite() else 0.0
    return legs, first


@pytest.mark.parametrize(
    ("name", "distance"),
    [("cooke_triplet", np.inf), ("cooke_triplet", 400.0), ("cooke_triplet", 12.0), ("hubble", np.inf)],
)
def test_paths_are_sums_of_index_times_distance(name, distance):
    lens = rt.read_lens(name)
    if np.isfinite(distance):
        lens = rt.system.with_object_distance(lens, torch.tensor(distance).double())
    last, w = len(lens.surfaces) - 1, len(lens.wavelengths) - 1
    numbers = (0.3, 0.5, 0.4, -0.6)
    legs, first = paths_between_hits(lens, w, numbers[:2], numbers[2:])
    own, _ = paths_between_hits(lens, lens.primary_wavelength - 1, numbers[:2], numbers[2:])
    found = values(
        lens,
        [
            Row("OPTH", (last, w + 1), numbers),
            Row("OPTH", (2, w + 1), numbers),
            Row("OPTH", (1, w + 1), numbers),
            Row("PLEN", (2, last), numbers),
            Row("PLEN", (last, 2), numbers),
            Row("PLEN", (1, 3), numbers),
        ],
    )
    expected = [first + sum(legs), first + legs[0], first, sum(own[1:]), sum(own[1:]), sum(own[:2])]
    assert np.abs(found - expected).max() < 1e-12 * max(expected) + 1e-12


def test_paths_in_inches():
    lens = rt.read_lens("cooke_triplet")
    row = Row("PLEN", (1, 5), (0.0, 0.5, 0.0, 0.3))
    assert values(lens, [row], unit=25.4)[0] == pytest.approx(values(lens, [row])[0] / 25.4, rel=1e-15)


def test_a_surface_that_is_not_there_is_named():
    lens = rt.read_lens("cooke_triplet")
    last = len(lens.surfaces) - 1
    with pytest.raises(BadRow, match=rf"^row 1 .*OPTH .*surface 40: .*surfaces 0 to {last}"):
        values(lens, [Row("OPTH", (40, 1))])


# -- derivatives -------------------------------------------------------------------------------------------------------


VARIABLES = (Vary(1, "curvature"), Vary(4, "thickness"), Vary(6, "curvature"), Vary(6, "thickness"))
LOST = (0.0, 2.4)  # a pupil point whose ray misses a surface, and one whose field's chief ray arrives all the same


@pytest.mark.parametrize(
    "conventions", [Conventions(), Conventions(opd_tilt="common", opd_chief="primary", opd_sign="shorter")]
)
@pytest.mark.parametrize("operand", ["OPDC", "OPDM", "OPDX", "OPTH", "PLEN"])
def test_derivatives_with_failed_rays(operand, conventions):
    lens = rt.read_lens("cooke_triplet")
    last = len(lens.surfaces) - 1
    asked = rows(operand, fields=[(0.0, 0.7), (0.4, 0.6)], points=[*POINTS, LOST])
    integers = {"OPTH": lambda w: (last, w), "PLEN": lambda w: (2, last)}.get(operand, lambda w: (0, w))
    asked = [Row(operand, integers(row.integers[1]), row.numbers, weight=row.weight) for row in asked]
    model = DesignVariables(lens, VARIABLES)
    evaluation = Evaluation(model, asked, conventions=conventions)
    found = evaluation(model.start, derivatives=True)
    assert 0 < found.lost.sum() < len(asked) / 2
    expected = slopes_by_differences(evaluation, model.start) * evaluation.factors[:, None]
    there = ~found.lost[found.of_row]
    assert not found.jacobian[~there].any()
    difference = np.abs(found.jacobian - expected[found.of_row])[there]
    assert (difference.max(0) < 1e-8 * np.abs(expected[found.of_row][there]).max(0)).all()


def test_derivatives_of_a_path_from_an_object_that_moves():
    """The launch moves with the object, the entrance pupil and the focal length."""
    lens = rt.system.with_object_distance(rt.read_lens("cooke_triplet"), torch.tensor(300.0).double())
    model = DesignVariables(lens, (Vary(0, "thickness"), Vary(1, "curvature"), Vary(2, "thickness")))
    numbers = (0.3, 0.5, 0.4, -0.6)
    asked = [Row("OPTH", (s, 3), numbers, weight=1.0) for s in (1, 3, 7)] + [Row("OPDC", (0, 1), numbers, weight=1.0)]
    evaluation = Evaluation(model, asked)
    found = evaluation(model.start, derivatives=True)
    expected = slopes_by_differences(evaluation, model.start) * evaluation.factors[:, None]
    assert (np.abs(found.jacobian - expected[found.of_row]).max(0) < 1e-7 * np.abs(expected).max(0)).all()


def test_derivatives_of_a_bent_lens():
    lens = rt.read_lens("cooke_triplet")
    bent = folded(lens, len(lens.surfaces) - 2, tilt_x=35.0)
    model = DesignVariables(bent, (Vary(1, "curvature"), Vary(2, "thickness"), Vary(6, "curvature")))
    evaluation = Evaluation(model, rows("OPDC", wavelengths=(2,), fields=[(0.0, 0.5)]))
    found = evaluation(model.start, derivatives=True)
    expected = slopes_by_differences(evaluation, model.start) * evaluation.factors[:, None]
    assert (np.abs(found.jacobian - expected).max(0) < 1e-6 * np.abs(expected).max(0)).all()


# -- oracle ------------------------------------------------------------------------------------------------------------


@pytest.mark.needs(DEVELOPMENT)
@pytest.mark.parametrize("name", ["Apochromat3.zmx", "sc_maksutov2.zmx", "sc_schmidt3.ZMX", "sc_slit.ZMX"])
def test_stored_designs_agree_with_the_oracle(name):
    """In size: which sign a longer path has is not settled."""
    path = DEVELOPMENT / f"Project_X__{name}"
    entries = {entry["file"]: entry for entry in json.loads((DEVELOPMENT / "oracle.json").read_text())["files"]}
    expected = np.array([abs(v["value"]) for v in entries[path.name]["values"] if v["op"].startswith("OPD")])
    lens = rt.read_lens(str(path))
    asked = [row for row in lens.optimization_data.merit if row.operand.startswith("OPD")]
    found = np.abs(values(lens, asked))
    assert len(expected) == len(found) > 2
    assert np.abs(found - expected).max() < WAVES

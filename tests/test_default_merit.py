"""Default merit functions against those that OpticStudio stored in files, and their sums as integrals."""

import json
import re

import numpy as np
import pytest
from problems import SHARED

import raytrace as rt
from raytrace.optimization.merit import BadMerit, DefaultMerit

DEVELOPMENT = SHARED / "merit" / "dev"
PRINTED = 1e-6  # the files hold six to twelve digits

SQUARE = [(0, 0), (1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (1, -1), (-1, 1), (-1, -1)]

#: Files with an unchanged default merit function, and the options with which it was made.
STORED = {
    "Project_X__AchromaticAt800nmF25mm.ZMX": {},
    "Project_X__Apochromat3.zmx": {"rings": 5},
    "Project_X__Elliptical_reflector_320_degree_light_cone_.zmx": {"rings": 6},
    "Project_X__Relay_lens.zmx": {},
    "Project_X__sc_cooke2.ZMX": {},
    "Project_X__sc_hamm1.zmx": {},
    "Project_X__sc_hamm2.zmx": {},
    "Project_X__sc_maksutov2.zmx": {},
    "Project_X__sc_scan3.ZMX": {},
    "Project_X__sc_scan4.ZMX": {},
    "Project_X__sc_schmidt3.ZMX": {},
    "Project_X__sc_slit.ZMX": {},
    "PyZDDE__ConcentricSpheres.zmx": {"fields": SQUARE},  # as the rows tell; other fields came later
    "PyZDDE__Doublet.ZMX": {},
    "cots-objective-design__COTS-0002-01-0.zmx": {},
}
KINDS = {
    "TRAC": ("spot", "centroid"),
    "TRCX": ("spot", "centroid"),  # the second half of the file has TRCY
    "TRAR": ("spot", "chief"),
    "OPDX": ("wavefront", "centroid"),
    "OPDC": ("wavefront", "chief"),
}


def stored(path):
    """(operand, rows (wavelength, Hx, Hy, Px, Py, target, weight), rings and arms) of a file's ray rows."""
    raw = path.read_bytes()
    text = raw.decode("utf-16" if raw[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin1")
    lines = [line.split() for line in text.splitlines()]
    rows = [line for line in lines if line and line[0] in KINDS]
    sampling = re.search(r"GQ (\d+) rings (\d+) arms", text)
    rule = dict(zip(("rings", "arms"), map(int, sampling.groups()), strict=True)) if sampling else {}
    return rows[0][0], np.array([[float(number) for number in row[2:9]] for row in rows]), rule


@pytest.mark.needs(DEVELOPMENT)
@pytest.mark.parametrize("name", STORED)
def test_a_stored_default_merit_function_is_made_again_row_by_row(name):
    path = DEVELOPMENT / name
    operand, expected, rule = stored(path)
    options = {**rule, **STORED[name]}
    kind, reference = KINDS[operand]
    lens = rt.read_lens(path)
    lens = lens.at(fields=options.pop("fields")) if "fields" in options else lens
    rows = [row for row in DefaultMerit(kind, reference=reference, **options).rows(lens) if row.weight]
    found = np.array([[row.integers[1], *row.numbers, row.target, row.weight] for row in rows])
    assert found.shape == expected.shape
    np.testing.assert_array_equal(found[:, 0], expected[:, 0])
    np.testing.assert_allclose(found[:, 1:5], expected[:, 1:5], atol=PRINTED)
    np.testing.assert_allclose(found[:, 5:], expected[:, 5:], rtol=3 * PRINTED)


def test_the_rows_of_a_triplet_have_the_weights_that_opticstudio_prints():
    """Figures of a stored merit function of 4 fields and 3 wavelengths, of the rings of one arm."""
    triplet = rt.read_lens("cooke_triplet").at(
        fields=[0, 12.6, 17.8, 21.7], wavelengths=[0.4861327, 0.5875618, 0.6562725]
    )
    rows = [row for row in DefaultMerit().rows(triplet) if row.weight]
    assert len(rows) == 3 * 3 + 3 * 3 * 3 * 3
    axis, first = rows[:3], rows[9:18]
    assert [row.weight for row in axis] == pytest.approx([7.27220522e-2, 1.16355283e-1, 7.27220522e-2], rel=1e-8)
    assert [row.numbers[2] for row in axis] == pytest.approx([3.35710687e-1, 7.07106781e-1, 9.41965145e-1], rel=1e-8)
    assert [row.weight for row in first[:3]] == pytest.approx([row.weight / 3 for row in axis])
    assert first[0].numbers == pytest.approx((0, 12.6 / 21.7, 1.67855344e-1, 2.90733983e-1), rel=1e-8)
    assert first[3].numbers[3] == 0
    assert first[6].numbers[3] < 0


@pytest.mark.parametrize("fields", [[0, 7], [(3, 0), (0, 7)]], ids=["on y", "off y"])
@pytest.mark.parametrize(("rings", "arms"), [(3, 6), (4, 8), (6, 12)])
def test_the_weighted_sum_over_rows_is_an_integral_over_the_pupil(fields, rings, arms):
    """Σ w f(P) of a field and wavelength is its share of ∬ f dP, exact for polynomials up to the order of the rule."""
    lens = rt.read_lens("double_gauss").at(fields=fields, wavelengths=[0.5, 0.6])
    rows = [row for row in DefaultMerit(rings=rings, arms=arms, wavelength_weights=[1, 3]).rows(lens) if row.weight]
    outer = [row for row in rows if row.numbers[:2] != (0, 0) and row.numbers[1] > 0 and row.integers[1] == 2]
    w, (x, y) = np.array([row.weight for row in outer]), np.array([row.numbers[2:] for row in outer]).T
    share = 3 / (2 * 2)
    # ∬ 1 = π, ∬ y² = π/4, ∬ x² y² = π/24
    assert w.sum() == pytest.approx(np.pi * share, rel=1e-12)
    assert (w * y**2).sum() == pytest.approx(np.pi / 4 * share, rel=1e-12)
    assert (w * x**2 * y**2).sum() == pytest.approx(np.pi / 24 * share, rel=1e-12)
    assert len(outer) == rings * (arms // 2 if fields == [0, 7] else arms)


def test_weights_of_fields_and_wavelengths_are_those_of_the_lens_or_given():
    lens = rt.read_lens("double_gauss").at(fields=[0, 7, 14], wavelengths=[0.5, 0.6])
    one = sum(row.weight for row in DefaultMerit().rows(lens))
    assert one == pytest.approx(np.pi, rel=1e-12)
    rows = DefaultMerit(field_weights=[2, 0, 1], wavelength_weights=[0.5, 0]).rows(lens)
    assert {row.integers[1] for row in rows if row.weight} == {1}
    assert {row.numbers[1] for row in rows if row.weight} == {0, 1}
    assert sum(row.weight for row in rows) == pytest.approx(np.pi * 3 / 3 * 0.5 / 2, rel=1e-12)


def test_every_configuration_has_its_rows():
    zoom = rt.read_lens("double_gauss").with_configurations(thickness={6: [12.4281, 16.0], 11: [57.9, 52.0]})
    rows = DefaultMerit(glass_thickness=(2, 15)).rows(zoom)
    places = [number for number, row in enumerate(rows) if row.operand == "CONF"]
    assert [rows[place].integers[0] for place in places] == [1, 2]
    assert rows[places[0] + 1 : places[1]] == rows[places[1] + 1 :] or len(rows) == 2 + 2 * (places[1] - places[0])
    assert [row.operand for row in DefaultMerit().rows(zoom, [2])][2] == "CONF"
    assert "CONF" not in {row.operand for row in DefaultMerit().rows(rt.read_lens("double_gauss"))}


def test_boundaries_are_rows_over_all_surfaces():
    lens = rt.read_lens("double_gauss")
    rows = DefaultMerit(glass_thickness="2:15", air_thickness=(0.5, 50), edge=1).rows(lens)
    bounds = {row.operand: (*row.integers, row.target, row.weight) for row in rows if row.operand[:2] in ("MN", "MX")}
    assert bounds == {
        "MNCA": (1, 11, 0.5, 1),
        "MXCA": (1, 10, 50, 1),  # not of the space before the image
        "MNEA": (1, 11, 0.5, 1),
        "MNCG": (1, 11, 2, 1),
        "MXCG": (1, 11, 15, 1),
        "MNEG": (1, 11, 1, 1),
    }
    assert {row.operand for row in DefaultMerit(edge=1).rows(lens) if row.weight} == {"MNEG", "TRAC"}
    assert "MXCG" not in {row.operand for row in DefaultMerit(glass_thickness=(2, float("inf"))).rows(lens)}


def test_other_kinds_have_operands_of_their_own():
    lens = rt.read_lens("double_gauss")
    assert {row.operand for row in DefaultMerit("angular").rows(lens) if row.weight} == {"ANAC"}
    assert {row.operand for row in DefaultMerit("angular", reference="chief").rows(lens) if row.weight} == {"ANAR"}
    rows = [row for row in DefaultMerit("mtf", frequencies=[10, 40]).rows(lens) if row.weight]
    assert [row.numbers[:2] for row in rows] == [(f, v) for f in (1, 2, 3) for v in (10, 40)]
    assert {(row.operand, row.target, row.integers) for row in rows} == {("MTFA", 1, (1, 0))}
    assert sum(row.weight for row in rows) == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize(
    ("kind", "options", "said"),
    [
        ("spots", {}, "did you mean spot"),
        ("spot", {"arms": 5}, "an even number"),
        ("spot", {"rings": 0}, "expected 1 or more"),
        ("spot", {"reference": "axis"}, "expected one of centroid, chief"),
        ("spot", {"frequencies": [10]}, "goes with `frequencies`"),
        ("mtf", {}, "goes with `frequencies`"),
        ("mtf", {"frequencies": float("nan")}, "expected finite numbers"),
        ("spot", {"field_weights": [1]}, "1 weights, and the lens has 3 fields"),
        ("spot", {"wavelength_weights": [-1]}, "0 or more"),
    ],
)
def test_impossible_merit_functions_are_refused(kind, options, said):
    with pytest.raises(BadMerit, match=re.escape(said)):
        DefaultMerit(kind, **options).rows(rt.read_lens("double_gauss"))


@pytest.mark.needs(DEVELOPMENT)
def test_the_list_of_stored_merit_functions_is_that_of_the_oracle():
    path = DEVELOPMENT / "oracle.json"
    files = {one["file"] for one in json.loads(path.read_text())["files"] if one["copied"]}
    edited = {"Project_X__Schmidt-Cassegrain.zmx", "Project_X__sc_scan2.ZMX"}  # by hand, after they were made
    assert files == {*STORED, *edited}

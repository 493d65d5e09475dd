"""Operands of aberrations: against the analyses, stored figures, and derivatives against differences."""

import dataclasses

import numpy as np
import pytest
import torch
from merit_cases import LENSES, check_derivatives, lens_of, model_of, values_of
from problems import SHARED, fields

import raytrace as rt
from raytrace.analysis.seidel import OF_WAVEFRONT
from raytrace.files import shipped
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.operands.operand import BadRow, Conventions
from raytrace.optimization.variables import DesignVariables
from raytrace.system.optimization_data import Row
from raytrace.tracing.paraxial import first_order

pytestmark = pytest.mark.usefixtures("compiler")

STORED = SHARED / "merit" / "dev"
SUMS = ("SPHA", "COMA", "ASTI", "FCUR")


@pytest.mark.parametrize("name", [n for n in LENSES if LENSES[n].fields.kind == "angle"])
def test_seidel_sums_are_those_of_the_verb(name):
    """At the primary wavelength, of every surface and of all; W040 = S1/8 and so on."""
    lens = lens_of(name)
    found = rt.seidel(lens, kind="waves").contributions[:5, 0].numpy()
    last = len(lens.surfaces) - 2
    for which, (operand, share) in enumerate(zip((*SUMS, "DIST"), OF_WAVEFRONT[:5], strict=True)):
        computed = values_of(name, [Row(operand, (k, 0)) for k in range(1, last + 1)])
        size = np.abs(found).max()
        assert computed / share == pytest.approx(found[which], rel=1e-10, abs=1e-12 * size), operand
        if operand in SUMS:
            assert values_of(name, [Row(operand)])[0] == pytest.approx(computed.sum(), rel=1e-9, abs=1e-12 * size)


def values_of_lens(lens, rows):
    return Evaluation(DesignVariables(lens), rows)(np.zeros(0)).values


def test_spherical_aberration_of_another_wavelength():
    """Of an object at infinity its marginal ray is the same one."""
    lens = lens_of("colours")
    assert lens.aperture.kind == "entrance_pupil_diameter"
    single = lens.at(wavelengths=[float(lens.wavelengths[2])])
    assert values_of_lens(lens, [Row("SPHA", (0, 3))]) == pytest.approx(
        values_of_lens(single, [Row("SPHA")]), rel=1e-12
    )


@pytest.mark.parametrize("name", ["colours", "near", "aspheres", "telescope"])
def test_distortion_is_that_of_the_verb(name):
    lens = lens_of(name)
    wave = lens.primary_wavelength - 1
    y = lens.fields.y[lens.fields.y.abs() > 0]
    numbers = [int(k) + 1 for k in np.flatnonzero(lens.fields.y.numpy())]
    found = rt.distortion(lens, fields=y, wavelengths=[float(lens.wavelengths[wave])]).f_tan[:, 0].numpy()
    computed = values_of(name, [Row("DIMX", (k, 0)) for k in numbers])
    assert computed == pytest.approx(100 * np.abs(found), rel=1e-6, abs=1e-6)
    largest = int(y.abs().argmax())
    assert values_of(name, [Row("DIST")])[0] == pytest.approx(100 * found[largest], rel=1e-6, abs=1e-6)
    assert values_of(name, [Row("DIMX")])[0] == pytest.approx(computed[largest], rel=1e-12)


def test_distortion_below_its_target_is_met():
    (computed,) = values_of("colours", [Row("DIMX", (0, 2))])
    row = Row("DIMX", (0, 2), target=computed + 0.5, weight=1.0)
    assert values_of("colours", [row])[0] == row.target
    model = model_of("colours")
    found = Evaluation(model, [row])(model.start, derivatives=True)
    assert found.merit == 0
    assert not found.jacobian.any()


def test_distortion_in_lengths():
    """100 (h/h0 - 1) is the part of h0 by which h is off."""
    rows = [Row("DIST", (0, 2)), Row("DIST", (0, 2), (1.0, 0, 0, 0)), Row("REAY", (8, 2), (0.0, 1.0, 0.0, 0.0))]
    lens = lens_of("colours").at(fields=[0.0, 20.0])
    part, length, height = values_of_lens(lens, rows)
    assert height - height / (1 + part / 100) == pytest.approx(length, rel=1e-9)
    inches = Evaluation(DesignVariables(lens), rows[1:2], unit=25.4)(np.zeros(0)).values
    assert inches == pytest.approx([length / 25.4], rel=1e-12)


def test_calibrated_distortion_fits_f_theta():
    """Against numpy's least squares over the real chief rays."""
    lens = lens_of("colours").at(fields=[0.0, 20.0])
    rows = [Row("REAY", (8, 2), (0.0, k / 30, 0.0, 0.0)) for k in range(1, 31)]
    y = values_of_lens(lens, rows)
    theta = np.deg2rad(float(lens.fields.y.max())) * np.arange(1, 31) / 30
    f = np.linalg.lstsq(theta[:, None], y, rcond=None)[0][0]
    computed = values_of_lens(lens, [Row("DISC", (0, 2)), Row("DISC", (0, 2), (1.0, 0, 0, 0))])
    assert computed == pytest.approx([100 * np.abs(y / (f * theta) - 1).max(), np.abs(y - f * theta).max()], rel=1e-10)


@pytest.mark.parametrize("name", ["colours", "near", "aspheres"])
def test_field_curvature_is_that_of_the_verb(name):
    lens = lens_of(name)
    largest = float(lens.fields.y.abs().max())
    parts, wave = [0.0, 0.5, 1.0], lens.primary_wavelength - 1
    y = torch.tensor([part * largest for part in parts], dtype=torch.float64)
    found = rt.field_curvature(lens, fields=y, wavelengths=[float(lens.wavelengths[wave])])
    for operand, curve in (("FCGS", found.sagittal), ("FCGT", found.tangential)):
        computed = values_of(name, [Row(operand, (0, 0), (0.0, part, 0.0, 0.0)) for part in parts])
        assert computed == pytest.approx(curve[:, 0].numpy(), rel=1e-7, abs=1e-8), operand


def test_colours():
    lens = lens_of("colours")
    blue, red = (float(first_order(lens, lens.wavelengths[k]).paraxial_image_distance) for k in (0, 2))
    rows = [Row("AXCL", (1, 3)), Row("AXCL"), Row("AXCL", (3, 1)), Row("AXCL", (1, 3), (0.02, 0, 0, 0))]
    computed = values_of("colours", rows)
    assert computed[:3] == pytest.approx([blue - red, blue - red, red - blue], rel=1e-10)
    assert computed[3] == pytest.approx(blue - red, abs=3e-4 * abs(blue))  # close to the axis, but for spherochromatism
    lateral = rt.lateral_colour(lens, fields=lens.fields.y.max()[None]).shift[0]
    assert values_of("colours", [Row("LACL", (1, 3))])[0] == pytest.approx(float(lateral[0] - lateral[2]), rel=1e-8)


def test_axial_colour_of_a_zone_is_where_real_rays_cross():
    rows = [Row(o, (8, w), (0.0, 0.0, 0.0, 0.8)) for w in (1, 3) for o in ("REAZ", "REAY", "REAB", "REAC")]
    z, y, m, n = values_of("colours", rows).reshape(2, 4).T
    blue, red = z - y * n / m
    assert values_of("colours", [Row("AXCL", (1, 3), (0.8, 0, 0, 0))])[0] == pytest.approx(blue - red, rel=1e-12)


def test_vignetting_leaves_the_chief_ray_in_the_middle():
    lens = LENSES["near"]
    decentred = torch.stack([torch.full_like(lens.fields.y, x) for x in (0.05, 0.1, 0.2, 0.3, 10.0)])
    vignetted = dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, vignetting=decentred))
    rows = [Row("DIST"), Row("LACL"), Row("FCGT", (0, 0), (0, 1, 0, 0)), Row("FCGS", (0, 0), (0, 0.6, 0, 0))]
    computed = values_of_lens(vignetted, rows)
    assert computed == pytest.approx(values_of("near", rows), rel=1e-9)
    assert values_of_lens(vignetted, [Row("WFNO")]) != values_of("near", [Row("WFNO")])


def test_other_readings():
    """Each by its own definition from the first choice."""
    lens = lens_of("colours").at(fields=[0.0, 20.0])
    rows = [Row("AXCL"), Row("LACL"), *(Row(operand) for operand in SUMS), Row("DIST", (2, 0))]
    conventions = Conventions(colour="second", seidel="wavefront", f_theta="axis included")
    first, other = (
        values_of_lens(lens, rows),
        Evaluation(DesignVariables(lens), rows, conventions=conventions)(np.zeros(0)).values,
    )
    assert first / other == pytest.approx([-1, -1, *OF_WAVEFRONT[:5]], rel=1e-12)
    theta = np.deg2rad(20.0) * np.arange(1, 30) / 29
    y = values_of_lens(lens, [Row("REAY", (8, 2), (0.0, k / 29, 0.0, 0.0)) for k in range(1, 30)])
    off = 100 * np.abs(y / (theta * (y @ theta) / (theta @ theta)) - 1).max()
    computed = Evaluation(DesignVariables(lens), [Row("DISC", (0, 2))], conventions=conventions)(np.zeros(0)).values
    assert computed == pytest.approx([off], rel=1e-10)


def rows_of(name):
    lens = LENSES[name]
    found = [Row(operand) for operand in SUMS] + [Row("DIST", (2, 0)), Row("COMA", (1, 1))]
    if len(lens.wavelengths) > 1:
        found += [Row("AXCL"), Row("AXCL", (1, 2), (0.7, 0, 0, 0)), Row("LACL"), Row("SPHA", (0, 2))]
    if float(lens.fields.y.abs().max()) > 0:
        found += [
            Row("DIST"),
            Row("DIMX"),
            Row("DIMX", (0, 0), (0.0, 5.0, 0.0, 0.0)),
            Row("DISC"),
            Row("DIST", (0, 0), (1.0, 0, 0, 0)),
        ]
    return found + [Row(o, (0, 0), (0.0, 0.6, 0.0, 0.0)) for o in ("FCGS", "FCGT")]


@pytest.mark.parametrize("name", LENSES)
def test_derivatives(name):
    check_derivatives(name, rows_of(name), bar=1e-5)


STATED = {
    "tilts": ("folded_relay", [Row("SPHA")], "SPHA is of a straight axis: tilts and decentres bend this one$"),
    "an axis": (None, [Row("DIMX", (1, 0))], "DIMX names field 1, on the axis, where nothing is distorted$"),
    "heights": (None, [Row("DISC")], "DISC is of angles of the field; this lens has a field of object height$"),
    "the image": (
        None,
        [Row("COMA", (12, 1))],
        r"COMA names surface 12: this lens has surfaces 0 to 11 \(0: all of them\)$",
    ),
}


@pytest.mark.parametrize("case", STATED)
def test_rows_that_a_lens_cannot_have(case):
    file, rows, message = STATED[case]
    height = fields("object_height", (0.0, 5.0))
    lens = LENSES["near"] if file is None else rt.read_lens(shipped("lenses") / "examples" / f"{file}.zmx")
    lens = dataclasses.replace(lens, fields=height) if case == "heights" else lens
    with pytest.raises(BadRow, match=f"^row 1 of the merit function: {message}"):
        Evaluation(DesignVariables(lens), rows)


@pytest.mark.needs(STORED)
def test_stored_colours_and_first_order():
    """Of an achromat, a relay and an objective, by an independent program."""
    achromat = rt.read_lens(STORED / "Project_X__AchromaticAt800nmF25mm.ZMX")
    rows = [Row("EFFL", (0, 2)), *(Row("AXCL", pair) for pair in ((1, 2), (1, 3), (2, 3)))]
    computed = values_of_lens(achromat, [*rows, Row("AXCL", (1, 2), (1.0, 0, 0, 0))])
    expected = [25.000000186276296, -1.5263507433971313e-4, -9.497033723029347e-4, -7.970682979632215e-4]
    assert computed == pytest.approx([*expected, 2.03767120160947e-3], rel=1e-8, abs=1e-9)
    relay = rt.read_lens(STORED / "Project_X__Relay_lens.zmx")
    computed = values_of_lens(relay, [Row("PMAG", (0, 2))])
    assert computed == pytest.approx([-1.0025646219094495], rel=1e-8)
    objective = rt.read_lens(STORED / "cots-objective-design__COTS-0002-01-0.zmx")
    angles = [Row("RAID", (28, 1), (0.0, part, 0.0, 0.0)) for part in (1.0, 0.707, 0.5)]
    rows = [Row("EFFL"), Row("ISNA"), Row("TTHI", (1, 27)), Row("EXPP"), Row("RECI", (4, 0)), *angles]
    expected = [26.708411248206637, 0.19660294433427764, 95.0, 16.54623591670614, 0.06043670627168659]
    computed = values_of_lens(objective, rows)
    assert computed == pytest.approx([*expected, 7.101377889136207, 4.93879600033236, 3.463984195311042], rel=1e-8)

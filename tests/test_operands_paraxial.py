"""Operands of first order: against the lens's own first order, and derivatives against finite differences."""

import math

import numpy as np
import pytest
from merit_cases import LENSES, check_derivatives, is_near, lens_of, values_of

from raytrace.optimization.operands.operand import Conventions
from raytrace.system.optimization_data import Row
from raytrace.tracing.f_number import working_f_number
from raytrace.tracing.paraxial import first_order

pytestmark = pytest.mark.usefixtures("compiler")

#: What `FirstOrder` calls them.
NAMES = {
    "EFFL": "effective_focal_length",
    "PMAG": "magnification",
    "AMAG": "angular_magnification",
    "ISNA": "image_na",
    "OBSN": "object_na",
    "ISFN": "f_number",
    "ENPP": "entrance_pupil_position",
    "EPDI": "entrance_pupil_diameter",
    "EXPP": "exit_pupil_position",
    "EXPD": "exit_pupil_diameter",
    "PETZ": "petzval_radius",
}


@pytest.mark.parametrize("name", LENSES)
def test_first_order_is_that_of_the_lens(name):
    data = first_order(lens_of(name))
    computed = values_of(name, [Row(operand) for operand in NAMES])
    expected = [float(getattr(data, word)) for word in NAMES.values()]
    assert dict(zip(NAMES, computed, strict=True)) == pytest.approx(
        dict(zip(NAMES, expected, strict=True)), rel=1e-11, abs=1e-13
    )
    assert values_of(name, [Row("PETC")])[0] == pytest.approx(1 / float(data.petzval_radius), rel=1e-11)


@pytest.mark.parametrize("name", LENSES)
def test_first_order_of_a_wavelength(name):
    lens = lens_of(name)
    for number in range(1, len(lens.wavelengths) + 1):
        data = first_order(lens, lens.wavelengths[number - 1])
        for operand in ("EFFL", "PMAG", "AMAG", "PETZ"):
            (computed,) = values_of(name, [Row(operand, (0, number))])
            assert computed == pytest.approx(float(getattr(data, NAMES[operand])), rel=1e-11, abs=1e-13), operand


def axis_of(lens):
    """The number of the field on the axis, 0 where none is."""
    on = np.flatnonzero((lens.fields.x.numpy() == 0) & (lens.fields.y.numpy() == 0))
    return int(on[0]) + 1 if len(on) else 0


@pytest.mark.parametrize("name", LENSES)
def test_f_numbers_of_the_axis(name):
    """WFNO is the lens's own; on the axis of a round lens all the cones are one, EFNO's but for its aberrations."""
    lens = lens_of(name)
    expected, number = float(working_f_number(lens)), axis_of(lens)
    assert values_of(name, [Row("WFNO")])[0] == pytest.approx(expected, rel=1e-12)
    if number:
        wave = lens.primary_wavelength
        rows = [Row("TFNO", (number, wave)), Row("SFNO", (number, wave)), Row("EFNO", (0, wave), (number, 0, 0, 0))]
        assert values_of(name, rows) == pytest.approx([expected] * 3, rel=1e-11)


def test_lengths():
    """The Cassegrain folds: its track is from the image, or the primary mirror, to the secondary."""
    lens = LENSES["two aspheric mirrors"]
    t = [float(surface.thickness) for surface in lens.surfaces]
    assert t[1:4] == [30.0, -70.0, 150.0]
    rows = [Row("TOTR"), Row("TTHI", (1, 3)), Row("TTHI", (2, 2)), Row("TTHI", (3, 1))]
    assert values_of("two aspheric mirrors", rows) == pytest.approx([150.0, 110.0, -70.0, 110.0])
    assert values_of("two aspheric mirrors", rows, unit=10.0) == pytest.approx([15.0, 11.0, -7.0, 11.0])


def test_other_readings():
    """In air behind glass, and the sum of thicknesses of what folds."""
    conventions = Conventions(focal_length="in air", total_track="sum")
    inside = values_of("immersed image", [Row("EFFL")])[0]
    assert values_of("immersed image", [Row("EFFL")], conventions=conventions)[0] == pytest.approx(
        inside / 1.5, rel=1e-12
    )
    assert values_of("two aspheric mirrors", [Row("TOTR")], conventions=conventions)[0] == pytest.approx(110.0)


@pytest.mark.parametrize("name", ["near", "thick lens", "concave mirror", "immersed image"])
def test_paraxial_image_height_is_that_of_rays_close_to_the_axis(name):
    lens = LENSES[name]
    data, last = first_order(lens), len(lens.surfaces) - 1
    defocus = float(data.paraxial_image_distance - lens.surfaces[last - 1].thickness)
    close = 1e-4
    rows = [Row(operand, (last, 0), (0.0, close, 0.0, 0.0)) for operand in ("REAY", "REAB", "REAC")]
    y, m, n = values_of(name, rows)
    largest = float(lens.fields.y.abs().max())
    slope = math.tan(math.radians(largest)) / math.tan(math.radians(close * largest))
    scale = slope if lens.fields.kind == "angle" else 1 / close
    assert values_of(name, [Row("PIMH")])[0] == pytest.approx((y + defocus * m / n) * scale, rel=1e-6)


def first_order_rows(name):
    last = len(LENSES[name].surfaces) - 1
    operands = [*NAMES, "PIMH", "WFNO", "EFNO", "TOTR", "PETC"]
    left = () if is_near(name) else ("PMAG", "OBSN")
    left += ("TOTR",) if name == "telescope" else ()  # surface 1 is at the secondary
    rows = [Row(operand) for operand in operands if operand not in left]
    return [*rows, Row("EFFL", (0, 1)), Row("TTHI", (1, last - 1)), Row("TFNO", (1, 1)), Row("SFNO", (0, 1))]


@pytest.mark.parametrize("name", LENSES)
def test_derivatives(name):
    check_derivatives(name, first_order_rows(name))

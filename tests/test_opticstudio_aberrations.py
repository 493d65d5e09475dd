"""Aberrations of an F/2.7 objective as OpticStudio printed them: Seidel, longitudinal, grid, incidence, RMS, F/#.

Figures and prescription: github.com/VendettaMask/opticalsystem, artifacts/zemax/123456-zemax-2026-r1-baseline, analyses
006, 008, 010, 049, 075, 077, 079 and 116 (OpticStudio 2026 R1).
"""

import math

import numpy as np
import pytest
import torch
from problems import fields, lens, scalar, surface, vector

from raytrace import distortion_grid, incidence, longitudinal_aberration, rms_over_field, seidel
from raytrace.materials.glass import Glass
from raytrace.tracing.f_number import working_f_number
from raytrace.tracing.paraxial import first_order

WAVELENGTHS = 0.42, 0.44, 0.46

#: Indices of the glasses at these wavelengths, as printed.
INDICES = {
    "D-ZLAF85LN": (1.8773604267, 1.871288472, 1.866115597),
    "H-K9L": (1.5283932512, 1.5262735509, 1.5244357671),
    "H-ZBAF1": (1.6395914017, 1.6363461644, 1.6335585462),
    "H-ZBAF20": (1.72742983, 1.7224320776, 1.718197006),
    "H-ZLAF2A": (1.8282056708, 1.8234376766, 1.8193442209),
    "H-ZLAF53BGT": (1.8680618893, 1.861491599, 1.8559187073),
    "H-ZLAF68N": (1.9169880776, 1.9104824918, 1.9049446396),
    "H-ZLAF96": (2.1120802274, 2.0998392915, 2.0896313663),
    "H-ZPK5": (1.6054410454, 1.6031130267, 1.601097921),
    "H-ZPK7": (1.5806951197, 1.5785560254, 1.5767036235),
}

#: Curvature, thickness and glass of surfaces 1 to the last before the image; the stop is surface 9.
PRESCRIPTION = (
    (0.0249836237246, 3.000201210602, "H-ZBAF20"),
    (0.09124185592221, 3.679775316105, None),
    (-0.01450743649312, 3.070138846515, "H-ZBAF1"),
    (0.05833481040332, 2.586091139825, None),
    (-0.01928573615998, 5.000266472939, "D-ZLAF85LN"),
    (-0.03617413981245, 5.000384494214, None),
    (0.04069525903975, 5.000451110429, "H-ZLAF2A"),
    (-0.03016290778824, 5.000543655633, None),
    (0.0, 2.229310753536, None),
    (-0.05695704540871, 5.000335412821, "H-ZPK5"),
    (-0.1103721764585, 5.000511745831, "H-ZLAF53BGT"),
    (-0.05704108942639, 1.161017145845, None),
    (0.01527037606922, 1.499849538896, "H-ZLAF96"),
    (0.06682018072587, 3.796148267567, "H-ZPK7"),
    (-0.02802734215111, 1.002817509045, None),
    (0.04240621255808, 5.000099557145, "H-ZLAF68N"),
    (0.009385128825989, 11.0, None),
    (0.0, 1.0, "H-K9L"),
    (0.0, 0.5, None),
    (0.0, 0.5, "H-K9L"),
    (0.0, 3.495991831727553, None),
)


def through(indices) -> Glass:
    """A glass of these indices: Conrady's formula n = n₀ + A/λ + B/λ^3.5 has as many coefficients."""
    wavelength = vector(*WAVELENGTHS)
    terms = torch.stack([torch.ones_like(wavelength), 1 / wavelength, wavelength**-3.5], 1)
    return Glass("", "conrady", torch.linalg.solve(terms, vector(*indices)))


def objective(field=None):
    glasses = {name: through(indices) for name, indices in INDICES.items()}
    return lens(
        [surface(c or None, t, glasses.get(name, 1.0)) for c, t, name in PRESCRIPTION],
        stop=9,
        object_distance=500.0,
        aperture=("image_f_number", 2.7),
        field=field or fields("real_image_height", (0.0, 4.5)),
        wavelengths=WAVELENGTHS,
        primary_wavelength=2,
        ray_aiming="paraxial",
    )


@pytest.fixture(scope="module")
def system():
    return objective()


def test_first_order(system):
    data = first_order(system)
    assert data.optical_invariant.item() == pytest.approx(0.8298, abs=5e-5)
    # Its exit pupil is 5e-6 off a 30-digit trace of these indices, and the angular magnification with it.
    assert data.angular_magnification.item() == pytest.approx(0.2045419, abs=2e-7)
    assert working_f_number(system).item() == pytest.approx(2.743459, abs=5e-7)


def test_seidel_sum_and_yni(system):
    found = seidel(system)
    assert found.summary()["S1"].item() == pytest.approx(0.000625, abs=5e-7)
    assert found.marginal_yni[0, 0].item() == pytest.approx(0.1011, abs=5e-5)


#: Height in the pupil, and where rays of the three wavelengths cross the axis, mm.
CROSSINGS = {
    0.01: (0.003304423797511336, -9.186779479808387e-07, 0.0034608276398091667),
    0.5: (0.001713332429737669, -0.0021417384438455426, 0.0009427376121671577),
    1.0: (9.177395531735218e-05, -0.004620732612111075, -0.0020051640624932417),
}


def test_longitudinal_aberration(system):
    """To 2.5 nm, which the indices, printed to 5e-11, leave; at the axis OpticStudio takes a ray at 0.005."""
    found = longitudinal_aberration(system, points=101)
    for pupil, expected in CROSSINGS.items():
        torch.testing.assert_close(found.crossing[:, round(100 * pupil)], vector(*expected), rtol=0, atol=2.5e-6)
    assert found.crossing[0, 0].item() == pytest.approx(0.003305, abs=5e-7)


def test_angle_of_incidence_on_the_sensor(system):
    """Of the upper ray at 0.7 of the field."""
    found = incidence(system, fields=vector(0.0, 3.15)[:, None])
    assert found.summary()["upper"].item() == pytest.approx(-6.784391, abs=6e-7)


def test_distortion_grid():
    """Its grid reaches to the field angle 23.70386965° that it takes for the largest image height."""
    found = distortion_grid(objective(fields("angle", (23.70386965,))), points=5)
    assert 100 * found.largest().item() == pytest.approx(-4.558131, abs=6e-7)


#: Field mm: RMS in waves of all wavelengths together, and of each.
RMS = {
    0.0: (0.024264131561536027, 0.009922679040379408, 0.03936229204135638, 0.010880930439037512),
    2.1: (0.040727941936887856, 0.011963872069399804, 0.059611962633699306, 0.06788452807081798),
    4.5: (0.0763747638193352, 0.09801522456221173, 0.0515303539354262, 0.09254277459215253),
}


def test_rms_over_the_field(system):
    """By its quadrature of 3 rings of 6 arms, the first on the x axis; together on the primary wavelength's sphere."""
    nodes, shares = np.polynomial.legendre.leggauss(3)
    radius, angle = np.sqrt((nodes + 1) / 2)[:, None], np.arange(6) * (math.pi / 3)
    points = torch.as_tensor(np.stack([(radius * np.cos(angle)).ravel(), (radius * np.sin(angle)).ravel()]))
    rule = points, torch.as_tensor(np.repeat(shares / 12, 6))
    heights = vector(*RMS)
    found = rms_over_field(system, fields=torch.stack([torch.zeros_like(heights), heights]), pupil=rule)
    expected = torch.tensor(list(RMS.values()), dtype=torch.float64)
    torch.testing.assert_close(found.polychromatic, expected[:, 0], rtol=0, atol=5e-8)
    torch.testing.assert_close(found.rms, expected[:, 1:], rtol=0, atol=5e-8)


def test_a_singlet_at_f_10():
    """github.com/MREYE-LUMC/ZOSPy, tests/data/reference, 25.1.1 system data of its simple system."""
    plate = [surface(None, 0.0), surface(0.05, 1.0, 1.5), surface(-0.05, 19.792)]
    simple = lens(plate, aperture=("float_by_stop", scalar(1.0)), wavelengths=(0.543,))
    assert working_f_number(simple).item() == pytest.approx(10.05939, abs=5e-6)
    assert first_order(simple).angular_magnification.item() == pytest.approx(0.9833333, abs=5e-8)

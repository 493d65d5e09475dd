"""Seidel aberrations: the limit of real rays, the chief laws of the sums, and figures that OpticStudio printed."""

import dataclasses
import math

import pytest
import torch
from differences import gradcheck
from merit_cases import FIELD, SYSTEMS
from problems import fields, lens, scalar, surface, vector

from raytrace import seidel
from raytrace.io import read_lens
from raytrace.materials.glass import MIRROR, model_glass
from raytrace.system.lens import (
    Lens,
    SystemAperture,
    media,
    with_object_distance,
    with_sensor_distance,
    with_wavelengths,
)
from raytrace.system.sag_terms import ZernikeSag
from raytrace.tracing.paraxial import first_order, marginal_ray, signed, system_matrix
from raytrace.tracing.spot import image_rays

INF = math.inf


def in_paraxial_focus(system: Lens, distance: float) -> Lens:
    system = with_object_distance(system, distance)
    return with_sensor_distance(system, first_order(system).paraxial_image_distance)


def image_slope(system: Lens) -> torch.Tensor:
    """n′u′ of the paraxial marginal ray."""
    n = signed(system.surfaces[1:-1], media(system, system.wavelengths[0])[:-1])
    _, _, C, D = system_matrix(system.surfaces[1:-1], n)
    y, omega = marginal_ray(system)
    return C * y + D * omega


def third_order(system: Lens, scale: float, pupil: torch.Tensor) -> torch.Tensor:
    """Real (ε_x, ε_y)/scale³ in the paraxial image plane, of the lens with aperture and field reduced by `scale`."""
    diameter = scale * first_order(system).entrance_pupil_diameter
    small = dataclasses.replace(system, aperture=SystemAperture("entrance_pupil_diameter", diameter))
    angle = math.degrees(math.atan(scale * math.tan(math.radians(8.0))))
    hits = image_rays(small, pupil, fields=vector(0.0, angle)[:, None]).position[:2, 0, 0]
    ideal = -scale * seidel(system).invariant / image_slope(system)
    return (hits - torch.stack([torch.zeros_like(ideal), ideal])) / scale**3


@pytest.mark.parametrize("distance", [INF, 300.0])
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_sums_are_the_third_order_of_real_rays(name, distance):
    """ε to the third order in aperture and field (Welford 1986, §8.4), from two scales: what is left is O(scale⁴)."""
    system = in_paraxial_focus(SYSTEMS[name], distance)
    angle = torch.linspace(0.2, 6.0, 7, dtype=torch.float64)
    pupil = torch.cat([torch.stack([torch.sin(angle), torch.cos(angle)]), torch.zeros(2, 1, dtype=torch.float64)], 1)
    coarse, fine = (third_order(system, scale, pupil) for scale in (0.02, 0.01))
    real = (4 * fine - coarse) / 3
    S1, S2, S3, S4, S5 = seidel(system).contributions.sum(-1)[:5]
    sine, cosine = pupil
    rho = torch.hypot(sine, cosine)
    y = S1 * cosine * rho**2 + S2 * (rho**2 + 2 * cosine**2) + (3 * S3 + S4) * cosine + S5
    x = S1 * sine * rho**2 + S2 * 2 * sine * cosine + (S3 + S4) * sine
    expected = torch.stack([x, y]) / (2 * image_slope(system))
    torch.testing.assert_close(real, expected, rtol=0, atol=float(2e-5 * expected.abs().max()))


@pytest.mark.parametrize("name", SYSTEMS)
def test_the_sum_of_s4_is_petzvals(name):
    """Σ S4 = H² Σ c (n′ - n)/(n n′), which the Petzval radius is -1/n′ over (Welford, eq. 8.40)."""
    system = SYSTEMS[name]
    data, found = first_order(system), seidel(system)
    n_image = signed(system.surfaces[1:-1], media(system, system.wavelengths[0])[:-1])[-1]
    expected = -(found.invariant**2) / (n_image * data.petzval_radius)
    torch.testing.assert_close(found.summary()["S4"], expected, rtol=1e-12, atol=1e-18)
    assert found.invariant.abs().item() == pytest.approx(data.optical_invariant.item(), rel=1e-12)


@pytest.mark.parametrize("distance", [INF, 300.0])
def test_colours_are_the_first_order_of_close_wavelengths(distance):
    """TAXC and TLAC: by how much a paraxial marginal and chief ray of a shorter wavelength land higher."""
    glass = model_glass(1.6, 35.0)
    system = lens(
        [surface(0.02, 5.0, glass), surface(-0.01, 9.0), surface(None, 95.0)],
        stop=3,
        field=fields("angle", (1e-3,)),
        wavelengths=(0.55, 0.5498, 0.5502),
        aperture=("entrance_pupil_diameter", 2e-3),
    )
    system = in_paraxial_focus(system, distance)
    rays = image_rays(system, vector(0.0, 0.0, 0.0, 1.0).reshape(2, 2), fields=vector(0.0, 1e-3)[:, None])
    chief, upper = rays.position[1, 0].unbind(-1)
    found = seidel(system, kind="transverse").summary()
    assert (chief[1] - chief[2]).item() == pytest.approx(found["TLAC"].item(), rel=1e-5)
    assert ((upper - chief)[1] - (upper - chief)[2]).item() == pytest.approx(found["TAXC"].item(), rel=1e-5)


def test_a_paraboloid_with_the_stop_in_its_focal_plane_has_neither_spherical_aberration_nor_astigmatism():
    """Schroeder, Astronomical Optics, §6.2."""
    system = lens([surface(None, 100.0), surface(-1 / 200, -100.0, MIRROR, conic=-1.0)], field=FIELD)
    sums = seidel(system).summary()
    assert sums["S1"].abs().item() < 1e-18
    assert sums["S3"].abs().item() < 1e-15
    assert sums["S2"].abs().item() > 1e-4


def test_a_curvature_carries_its_derivatives():
    def sums(curvature, conic):
        front = surface(curvature, 5.0, 1.5, conic=conic, coefficients=[0.0, 1e-6])
        system = lens([surface(None, 7.0), front, surface(-0.01, 95.0)], field=FIELD, wavelengths=(0.55, 0.5, 0.6))
        return seidel(system, kind="waves").contributions

    curvature, conic = (scalar(x).requires_grad_() for x in (0.02, -0.5))
    assert gradcheck(sums, (curvature, conic))


def test_undefined_coefficients_are_nan_and_asymmetric_lenses_refused():
    afocal = lens([surface(0.02, 150.0), surface(None, 10.0)], field=FIELD)  # a curved dummy: no power
    assert bool(torch.isnan(seidel(afocal, kind="transverse").contributions).all())
    assert bool((seidel(afocal).contributions == 0).all())
    with pytest.raises(ValueError, match="expected one of coefficients, waves"):
        seidel(afocal, kind="wave")
    bumpy = surface(0.02, 5.0, 1.5, sag_terms=ZernikeSag(vector(0.0, 0.0, 0.0, 1e-3), scalar(5.0)))
    with pytest.raises(ValueError, match="surface 1 has added sag terms"):
        seidel(lens([bumpy, surface(None, 90.0)]))


#: Surfaces 1 and 2 of the 28 degree double Gauss (SK2, SK16, F5; Smith 1990 after Mandler) as OpticStudio prints them
#: at 0.5876 µm with F and C, quoted in a public repository's notes on parsing such tables: S1 … S5, CLA, CTR.
PRINTED = [
    [0.114175, -0.008176, 0.000586, 0.120467, -0.008669, -0.034, 0.002],
    [0.000396, -0.005093, 0.065502, -0.042772, -0.292349, -0.002, 0.029],
]


def test_the_signs_and_units_are_those_that_designers_print():
    """The media are those of the shipped lens by name; catalogs of another edition leave 2e-5 of the figures."""
    system = with_wavelengths(read_lens("lenses/double_gauss.zmx"), [0.5876, 0.4861, 0.6563])
    found = seidel(system).contributions[:, 0, :2].T
    expected = torch.tensor(PRINTED, dtype=torch.float64)
    torch.testing.assert_close(found[:, :5], expected[:, :5], rtol=2e-5, atol=6e-7)
    torch.testing.assert_close(found[:, 5:], expected[:, 5:], rtol=0, atol=6e-4)

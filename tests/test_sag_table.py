"""Sag table: closed forms of spheres and paraboloids, a dense least squares, derivatives, the command."""

import math

import numpy as np
import pandas
import pytest
import torch
from scipy.optimize import minimize

import raytrace as rt

NANOMETRE = 1e-6  # mm


def plate(radius=50.0, conic=0.0, h=10.0, **surface):
    front = {"radius": radius, "conic": conic, "thickness": 5, "glass": "N-BK7", "semi_diameter": h} | surface
    return rt.lens([front, {"thickness": 90}], stop=1, entrance_pupil_diameter=2 * h)


def test_a_sphere_is_its_own_best_fit():
    for kind in ("rms", "offset", "rim"):
        table = rt.sag(plate(-30.0), 1, step=2.5, best_fit=kind)
        r = table.radii
        assert r.tolist() == [0, 2.5, 5, 7.5, 10]
        assert torch.allclose(table.sag, -(30 - torch.sqrt(900 - r * r)), rtol=0, atol=1e-8 * NANOMETRE)
        assert torch.allclose(table.slope, -r / torch.sqrt(900 - r * r), rtol=1e-13, atol=0)
        assert float(table.best_fit_radius) == pytest.approx(-30, rel=1e-12)
        assert float(table.largest) < 1e-6 * NANOMETRE
        assert table.best_fit_departure.abs().max() < 1e-6 * NANOMETRE


def test_the_sphere_through_the_rim_of_a_paraboloid():
    """Through z = h²/2R: the radius (h² + z²)/2z = R + z/2; from the vertex sphere r⁴/8R³ is missing, to r⁶."""
    table = rt.sag(plate(50.0, -1.0), 1, best_fit="rim")
    z = 10.0**2 / (2 * 50)
    assert float(table.best_fit_radius) == pytest.approx(50 + z / 2, rel=1e-14)
    assert float(table.best_fit_departure[-1]) == pytest.approx(0, abs=1e-8 * NANOMETRE)
    r = table.radii
    assert torch.allclose(table.vertex_departure, r * r / 100 - (50 - torch.sqrt(2500 - r * r)), atol=1e-7 * NANOMETRE)
    assert float(table.slope[-1]) == pytest.approx(10 / 50, rel=1e-14)


@pytest.mark.parametrize("kind", ["rms", "offset"])
def test_the_best_fit_sphere_is_that_of_a_dense_least_squares(kind):
    table = rt.sag(plate(25.0, -0.6, coefficients=(0.0, 2e-5, -4e-8)), 1, best_fit=kind)
    r = np.sqrt((np.arange(40_000) + 0.5) / 40_000) * 10  # equal areas
    c, u = 1 / 25, r * r
    z = c * u / (1 + np.sqrt(1 - 0.4 * c * c * u)) + 2e-5 * u**2 - 4e-8 * u**3

    def departure(numbers):
        sphere = numbers[0] * u / (1 + np.sqrt(1 - numbers[0] ** 2 * u))
        return z - sphere - (numbers[1] if kind == "offset" else 0.0)

    fit = minimize(lambda n: 1e3 * (departure(n) ** 2).mean(), [c, 0.0], method="Nelder-Mead", options={
        "xatol": 1e-12, "fatol": 1e-17, "maxiter": 4000})  # fmt: skip
    assert float(table.best_fit_curvature) == pytest.approx(fit.x[0], rel=1e-7)
    assert float(table.rms) == pytest.approx(math.sqrt(fit.fun / 1e3), rel=1e-7)
    assert float(table.largest) == pytest.approx(abs(departure(fit.x)).max(), rel=1e-3)
    if kind == "offset":
        assert float(table.offset) == pytest.approx(fit.x[1], abs=0.1 * NANOMETRE)


@pytest.mark.parametrize("kind", ["rms", "offset", "rim"])
def test_numbers_of_the_fit_have_first_and_second_derivatives(kind):
    def figures(numbers):
        curvature, conic, a4 = numbers
        surface = {"curvature": curvature, "conic": conic, "coefficients": torch.stack([0 * a4, 1e-5 * a4])}
        front = {"thickness": 5, "glass": "N-BK7", "semi_diameter": 10.0} | surface
        lens = rt.lens([front, {"thickness": 90}], stop=1, entrance_pupil_diameter=20)
        table = rt.sag(lens, 1, best_fit=kind)
        return torch.stack([table.best_fit_radius, 1e3 * table.rms, 1e3 * table.offset, table.steepest])

    at = torch.tensor([0.03, -0.5, 2.0], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(figures, at, eps=1e-6, atol=1e-6, rtol=1e-5, fast_mode=True)
    assert torch.autograd.gradgradcheck(figures, at, eps=1e-6, atol=1e-5, rtol=1e-4, fast_mode=True)


def test_a_toroid_has_a_section_along_each_azimuth():
    lens = plate(50.0, 0.0, kind="toroidal", coefficients=(0.01,))
    for azimuth, radius in ((90, 50), (0, 100)):
        table = rt.sag(lens, 1, azimuth=azimuth, step=5)
        assert table.sag.tolist() == pytest.approx([0, *(radius - math.sqrt(radius**2 - r * r) for r in (5, 10))])
    assert 50 < float(table.best_fit_radius) < 100


def test_the_command_writes_the_table(command):
    code, out, err = command("sag", "phone", 3, "--step", 0.25, "-o", "sag.csv", "--plot", "sag.png")
    assert code == 0, err
    table = rt.sag("phone", 3, step=0.25)
    assert pandas.read_csv("sag.csv").sag.tolist() == table.sag.tolist()
    assert "best-fit sphere  radius −19.21498 mm" in out
    assert table.document()["best_fit_radius"] == pytest.approx(-19.21498, abs=1e-5)
    assert table.units()["best_fit_departure_um"] == "µm"


@pytest.mark.parametrize(
    ("surface", "options", "words"),
    [
        (9, {}, "surface 9 does not exist; expected a surface with a sag, from 1 to 3"),
        (1, {"best_fit": "area"}, "expected one of rms, offset, rim"),
        (1, {"semi_diameter": 50.0}, "below 50 mm, where the sag ends"),
        (1, {"step": -1.0}, "expected a length above 0 mm"),
    ],
)
def test_requests_without_an_answer_are_refused(surface, options, words):
    with pytest.raises(ValueError, match=words):
        rt.sag(plate(), surface, **options)

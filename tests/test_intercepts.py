"""Intercepts: a ray on a sphere by hand, Snell's law, and the table of `trace` and `incidence`."""

import math

import pytest
import torch
from problems import scalar

import raytrace as rt
from raytrace.analysis.intercepts import RAYS
from raytrace.system.lens import media

RADIUS, INDEX, HEIGHT = 50.0, 1.5, 10.0


def one_sphere(radius=RADIUS) -> rt.Lens:
    rows = [dict(radius=radius, thickness=120, glass=INDEX)]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=2 * HEIGHT, fields=[0, 5], wavelengths=[0.55])


def test_a_parallel_ray_on_a_sphere():
    """sin I = h/R, sin I' = sin I/n; the cosines of the refracted ray, and the sag."""
    found = rt.intercepts(one_sphere(), fields=[0], rays="upper")
    at, along = found.position[:, 0, 0, 0, 0].tolist(), found.direction[:, 0, 0, 0, 0].tolist()
    incidence = math.asin(HEIGHT / RADIUS)
    refraction = math.asin(math.sin(incidence) / INDEX)
    assert float(found.incidence[0, 0, 0, 0]) == pytest.approx(math.degrees(incidence), rel=1e-14)
    assert float(found.refraction[0, 0, 0, 0]) == pytest.approx(math.degrees(refraction), rel=1e-14)
    assert at == pytest.approx([0, HEIGHT, RADIUS - math.sqrt(RADIUS**2 - HEIGHT**2)], abs=1e-13)
    bent = incidence - refraction
    assert along == pytest.approx([0, -math.sin(bent), math.cos(bent)], abs=1e-14)


def test_angles_have_derivatives():
    """d/dR arcsin(h/R)."""
    radius = scalar(RADIUS).requires_grad_()
    found = rt.intercepts(one_sphere(radius), fields=[0], rays=["upper"])
    (slope,) = torch.autograd.grad(found.incidence[0, 0, 0, 0], radius)
    expected = -math.degrees(HEIGHT / RADIUS / math.sqrt(RADIUS**2 - HEIGHT**2))
    assert float(slope) == pytest.approx(expected, rel=1e-12)
    chief = rt.intercepts(one_sphere(radius), fields=[0], rays=["chief"])
    (slope,) = torch.autograd.grad(chief.incidence.sum(), radius)
    assert float(slope) == 0  # not nan, on the axis


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["double_gauss_28deg", "folded_relay", "spectrometer", "phone", "hubble"])
def test_angles_are_those_of_incidence_and_obey_snell(name):
    lens = rt.read_lens(name)
    fields = torch.stack([lens.fields.x, lens.fields.y])
    found = rt.intercepts(lens, fields=fields, rays=["lower", "chief", "upper"])
    signed = rt.incidence(lens, fields=fields, surfaces=True)
    if name not in ("spectrometer", "folded_relay"):  # whose rays leave the plane of the angle
        assert torch.equal(found.valid, signed.valid)
        assert torch.allclose(found.incidence, signed.angle.abs(), atol=1e-9)
    indices = [float(n) for n in media(lens, lens.primary)]
    frame = found.to_frame()
    for k, surface in enumerate(lens.surfaces[1:], 1):
        rows = frame[(frame.surface == k) & frame.incidence.notna()]
        if surface.is_mirror:
            assert rows.refraction.tolist() == pytest.approx(rows.incidence.tolist(), abs=1e-9)
        elif surface.phase is None and k < len(lens.surfaces) - 1:
            n, n_ = indices[k - 1], indices[k]
            left, right = (m * torch.sin(torch.deg2rad(torch.tensor(a.to_numpy())))
                           for m, a in ((n, rows.incidence), (n_, rows.refraction)))  # fmt: skip
            assert torch.allclose(left, right, atol=1e-12)


@pytest.mark.filterwarnings("ignore")
def test_points_are_those_of_the_trace():
    lens = rt.read_lens("cooke_triplet").at(wavelengths=[0.55])
    found = rt.intercepts(lens, fields=[8], rays=["chief", "upper", "left"]).to_frame()
    points = torch.tensor([RAYS[name][::-1] for name in ("chief", "upper", "left")], dtype=torch.float64).T
    table = rt.trace(lens, rt.tracing.rays(lens, fields=[8], pupil=points)).to_frame()
    for name in "xyzlmn":
        assert found[name].tolist() == pytest.approx(table[name].tolist(), abs=1e-12)


@pytest.mark.filterwarnings("ignore")
def test_the_largest_numbers_are_those_of_the_table(tmp_path):
    found = rt.intercepts("double_gauss_28deg", wavelengths=[0.5, 0.6])
    frame, summary = found.to_frame(), found.document()["summary"]
    for row in summary:
        here = frame[frame.surface == row["surface"]]
        best = here.loc[here.incidence.idxmax()]
        assert row["incidence"] == best.incidence
        assert row["incidence_field_y"] == best.field_y
        assert row["incidence_ray"] == best.ray
        assert row["height"] == pytest.approx((here.x**2 + here.y**2).max() ** 0.5, rel=1e-14)
    found.plot(tmp_path / "angles.png")


def test_an_unknown_ray_is_refused():
    with pytest.raises(ValueError, match=r"chef.*expected chief, upper, lower, right, left"):
        rt.intercepts(one_sphere(), rays="chef")


def test_the_text_states_the_wavelengths_of_the_largest_numbers():
    lens = rt.read_lens("cooke_triplet")
    assert f"largest numbers of all fields and rays, at {lens.primary:g} µm" in str(rt.intercepts(lens))
    assert "at 0.4861, 0.6563 µm" in str(rt.intercepts(lens, wavelengths=[0.4861, 0.6563]))

"""A script with the public API: every line runs as written."""

import numpy as np
import pytest
import torch
from problems import number

import raytrace as rt

ROWS = [
    {"radius": 37.4, "thickness": 5.9, "glass": "SK4"},
    {"radius": -341.48, "thickness": 12.93},
    {"radius": -42.65, "thickness": 2.5, "glass": "SF2"},
    {"radius": 36.4, "thickness": 2.0},
    {"thickness": 9.85},
    {"radius": 204.52, "thickness": 5.9, "glass": "SK4"},
    {"radius": -37.05, "thickness": 77.405},
]
pytestmark = pytest.mark.filterwarnings("ignore::raytrace.materials.catalogs.AmbiguousGlass")


@pytest.fixture
def lens():
    return rt.lens(
        ROWS, stop=5, f_number=3.5, fields=[0, 8.4, 11.9], wavelengths=[0.4861, 0.5876, 0.6563], primary_wavelength=2
    )


def test_a_lens_comes_from_a_shipped_name_or_plain_numbers_and_goes_to_a_file(lens, tmp_path):
    shipped = rt.read_lens("cooke_triplet")
    assert float(rt.first_order(lens).effective_focal_length) == pytest.approx(101.181, abs=1e-3)
    rt.write_lens(shipped, tmp_path / "out.zmx")
    again = rt.read_lens(tmp_path / "out.zmx")
    assert float(rt.first_order(again).power) == float(rt.first_order(shipped).power)


def test_a_lens_prints_its_prescription_and_first_order_data(lens):
    printed = str(lens)
    assert "effective focal length         101.181005  mm" in printed
    assert sum(line.split()[:1] == [str(k)] for k in range(9) for line in printed.splitlines()) == 9
    page = lens._repr_html_()
    assert "<svg" in page
    assert "<table" in page


def test_rays_are_launched_and_traced(lens):
    rays = rt.tracing.rays(lens, fields=[0, 14], pupil=rt.maths.gauss_rings(6))
    end = rt.trace(lens, rays)
    assert end.position.shape == (3, 2, 3, rt.maths.gauss_rings(6)[0].shape[1])
    assert bool(end.valid[0].all())
    alone = rt.trace(lens)
    frame = alone.to_frame()
    assert set(frame.surface) == set(range(1, len(lens.surfaces)))
    assert sorted(frame.field_y.unique()) == [0, 8.4, 11.9]


def test_verbs_carry_the_gradient_of_a_replaced_number(lens):
    """Against finite differences, through conditions, spot and refocusing."""

    def radius(curvature):
        changed = lens.at(object_distance=25e3, f_number=4).replace(3, curvature=curvature)
        return rt.spot(rt.focus(changed).lens, fields=[8.4], rings=4).rms_radius.sum()

    curvature = number(-1 / 42.65).requires_grad_()
    radius(curvature).backward()
    with torch.no_grad():
        h = 1e-7
        slope = (radius(curvature + h) - radius(curvature - h)) / (2 * h)
    assert float(curvature.grad) == pytest.approx(float(slope), rel=1e-5)


def test_spot_and_psf_are_results_that_draw_and_tabulate_themselves(lens, tmp_path):
    spot = rt.spot(lens)
    assert spot.rms_radius.shape == (3, 3)
    spot.plot(tmp_path / "spot.png")
    assert (tmp_path / "spot.png").stat().st_size > 10_000
    psf = rt.psf(lens, "drt", tol=1e-2)
    assert psf.kernel.shape == (1, 3, 21, 21)
    frame = psf.to_frame()
    assert frame.field_y.tolist() == [0, 8.4, 11.9]
    np.testing.assert_array_equal(frame.energy, psf.energy.flatten())
    apart = rt.psf(lens, "gaussian", tol=1e-2, per_wavelength=True).to_frame()
    assert apart.wavelength.tolist() == [0.4861, 0.5876, 0.6563] * 3


def test_a_focused_lens_is_a_lens(lens):
    before, after = (float(rt.spot(each, fields=[0]).rms_radius[0, 1]) for each in (lens, rt.focus(lens).lens))
    assert after < before


def test_a_lens_learns_with_a_network(lens):
    module = rt.Variables(lens, "curvature:1-4 sensor")
    camera = rt.Camera(module, rt.imaging.RedNet())
    assert {name for name, _ in camera.named_parameters()} > {
        f"variables.{name}" for name, _ in module.named_parameters()
    }
    restored = camera(torch.rand(1, 84, 84), torch.tensor([25e3], dtype=torch.float64))
    restored.mean().backward()
    assert all(bool(parameter.grad.isfinite().all()) for parameter in module.parameters())

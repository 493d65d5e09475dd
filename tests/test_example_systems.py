"""The example systems that travel with the package: what each of them is for, in numbers."""

import math

import pytest
import torch

import raytrace as rt
from raytrace.files import shipped
from raytrace.maths.sampling import fan

EXAMPLES = sorted(path.stem for path in (shipped("lenses") / "examples").glob("*.zmx"))


@pytest.mark.parametrize("name", EXAMPLES)
def test_every_example_is_opened_by_its_name_traced_and_drawn(name, tmp_path):
    lens = rt.read_lens(name)
    assert lens.notes
    assert bool(rt.trace(lens).valid.all())
    for view in ("yz", "xz"):
        rt.layout(lens, view=view, rays=3).plot(tmp_path / f"{view}.png", dpi=60)
    rt.write_lens(lens, tmp_path / "copy.zmx")
    assert (tmp_path / "copy.zmx").read_text() == (shipped("lenses") / "examples" / f"{name}.zmx").read_text()


def test_confocal_conics_are_stigmatic_off_their_axis():
    telescope = rt.read_lens("off_axis_telescope")
    assert float(rt.first_order(telescope).effective_focal_length) == pytest.approx(-2000, rel=1e-12)
    assert float(rt.spot(telescope, fields=[0]).rms_radius.max()) < 1e-9
    rays = rt.trace(telescope, rt.tracing.rays(telescope, fields=[0], pupil=rt.maths.gauss_rings(6)))
    assert float(rays.opl[rays.valid].std()) < 1e-10
    begun = rt.tracing.rays(telescope, fields=[0], pupil=fan(3)[0])
    assert begun.position[1].flatten().tolist() == pytest.approx([50.0, 100.0, 150.0])


def test_the_folded_relay_is_a_relay_of_one_to_one():
    relay = rt.read_lens("folded_relay")
    end = rt.trace(relay, rt.tracing.rays(relay, fields=[0, 3.5, -5], pupil=torch.zeros(2, 1, dtype=torch.float64)))
    assert end.position[1, :, 1, 0].tolist() == pytest.approx([0.0, -3.5, 5.0], abs=0.02)
    assert float(rt.spot(relay).rms_radius.max()) < 0.021


def test_the_spectrum_lies_on_the_image_in_order():
    """d y/dλ = f × lines per mm / cos β of the camera, about 0.06 mm a nm."""
    spectrometer = rt.read_lens("spectrometer")
    spots = rt.spot(spectrometer)
    assert float(spots.rms_radius.max()) < 0.02
    y = rt.trace(spectrometer, rt.tracing.rays(spectrometer)).position[1].mean(-1)[0]
    assert float(y[2]) == pytest.approx(0.0, abs=0.05)
    assert (y.diff() / 50).tolist() == pytest.approx(
        [-0.6 * 1e-3 * 97 / math.cos(math.radians(9.5)) * 1.02] * 4, rel=0.05
    )


def test_crossed_cylinders_have_one_focus_and_two_focal_lengths():
    pair = rt.read_lens("cylinder_pair")
    rim = torch.tensor([[0.01, 0.0], [0.0, 0.01]], dtype=torch.float64)
    end = rt.trace(pair, rt.tracing.rays(pair, pupil=rim))
    slopes = end.direction[:2, 0, 0] / end.direction[2, 0, 0]
    along_x, along_y = -0.08 / float(slopes[0, 0]), -0.08 / float(slopes[1, 1])
    assert (along_x, along_y) == (pytest.approx(50, rel=0.01), pytest.approx(100, rel=0.01))
    assert float(rt.spot(pair).rms_radius) < 0.03


def test_the_scan_lens_has_spots_at_f_theta_in_each_configuration():
    lens = rt.read_lens("scan_lens")
    heights = [float(rt.spot(one).centroid[1]) for one in lens.configurations]
    assert heights == pytest.approx([0.0, -160 * math.radians(20), 160 * math.radians(20)], abs=0.1)
    assert max(float(rt.spot(one).rms_radius) for one in lens.configurations) < 0.0015


def test_diffraction_undoes_the_dispersion_of_the_glass():
    hybrid = rt.read_lens("hybrid_achromat")
    assert float(rt.first_order(hybrid).effective_focal_length) == pytest.approx(100, abs=0.02)
    bare = hybrid.replace(2, phase=None)
    shifts = [rt.chromatic_focal_shift(lens).shift for lens in (hybrid, bare)]
    largest = [float(shift.max() - shift.min()) for shift in shifts]
    assert largest[0] < 0.3 < 1.5 < largest[1]

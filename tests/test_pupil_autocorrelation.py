"""MTF of large blurs: the wave by polynomials, the sheared pupil by quadrature, rays where diffraction is no matter."""

import json

import pytest
import torch
from matplotlib.text import Text

import raytrace as rt
from raytrace.analysis import mtf
from raytrace.analysis import pupil_autocorrelation as aperture
from raytrace.analysis import pupil_autocorrelation as smooth_pupil
from raytrace.analysis.setting import scene_of
from raytrace.budget import TakesLong
from raytrace.cli import main


def defocused(by: float) -> rt.Lens:
    lens = rt.focus(rt.read_lens("double_gauss"), fields=[0.0]).lens
    return lens.at(sensor_distance=float(lens.surfaces[-2].thickness) + by)


def both(found) -> torch.Tensor:
    return torch.stack([found.tangential, found.sagittal])


@pytest.fixture
def rough(monkeypatch):
    """No polynomial gives the wave, as where an aperture stops light within the beam."""
    for module in (aperture, mtf):
        monkeypatch.setattr(module, "polynomials_of", lambda *_: None)


@pytest.mark.parametrize(("name", "field"), [("double_gauss", 10.0), ("tessar", 12.2)])
def test_a_wave_by_polynomials_is_that_of_the_traced_grid(name, field, monkeypatch):
    """To 1e-4 waves at every ray, so that the modulation agrees far below the 5e-4 that such a grid leaves."""
    lens, frequencies = rt.read_lens(name), [2.0, 8.0, 20.0, 60.0]
    fitted = both(rt.mtf(lens, frequencies, fields=[field]))
    monkeypatch.setattr(aperture, "_TRACED", aperture._MOST)
    assert (fitted - both(rt.mtf(lens, frequencies, fields=[field]))).abs().max() < 2e-5


@pytest.mark.slow
def test_a_blurred_field_takes_a_few_thousand_rays(monkeypatch):
    """On a grid of 768 points across the pupil, 450,000 rays a wavelength if all were traced."""
    traced = []

    def counted(scene, pupil, *others, _trace=smooth_pupil.wavefront_of):
        traced.append(pupil.shape[-1])
        return _trace(scene, pupil, *others)

    for module in (aperture, smooth_pupil):
        monkeypatch.setattr(module, "wavefront_of", counted)
    lens, field = rt.read_lens("split_triplet"), torch.tensor([[0.0], [15.0]]).double()
    rt.mtf(lens, fields=[15.0])
    assert aperture.points_needed(smooth_pupil.beam_of(scene_of(lens, field))) > 700
    assert sum(traced) < 8_000


@pytest.mark.slow
def test_the_quadrature_of_a_sheared_pupil_is_the_limit_of_the_grid():
    """700 points across leave 1e-3, at the edge of the first zero; twice as many a quarter of that."""
    lens = defocused(3.0)
    frequencies = mtf.frequency_range(lens, torch.zeros(2, 1).double(), 21)
    scene = scene_of(lens, torch.zeros(2, 1).double())
    sheared = torch.stack(mtf._sheared(scene, frequencies)())
    shares = mtf.wavelength_shares(lens)
    coarse, fine = (torch.stack(mtf.mtf_on_grid(scene, frequencies, shares, **size)) for size in ({}, {"size": 1280}))
    assert (sheared - coarse).abs().max() < 1.2e-3
    assert (sheared - fine).abs().max() < 3e-4


def test_a_blur_beyond_any_grid_has_a_modulation_of_diffraction():
    """A defocus of 20 mm asks for 4,500 points across; derivatives are those of the number."""
    distance = defocused(20.0).surfaces[-2].thickness.clone().requires_grad_()
    lens = defocused(20.0)

    def modulation(at):
        return rt.mtf(lens.at(sensor_distance=at), [0.5], fields=[0.0]).tangential.sum()

    (slope,) = torch.autograd.grad(modulation(distance), distance)
    step = 1e-4
    with torch.no_grad():
        difference = (modulation(distance + step) - modulation(distance - step)) / (2 * step)
        assert not rt.mtf(lens, [0.5], fields=[0.0]).geometric
    assert float(slope) == pytest.approx(float(difference), rel=1e-5)


def mirror(defocus: float) -> rt.Lens:
    """A parabola of F/3.33, which is perfect in its focus."""
    surface = {"radius": -2000.0, "conic": -1.0, "thickness": -1000.0 - defocus, "glass": "MIRROR"}
    return rt.lens([surface], stop=1, entrance_pupil_diameter=300.0, wavelengths=[0.5], fields=[0.0])


def test_rays_serve_where_diffraction_is_no_matter(monkeypatch):
    """In blurs of 3,700 points across and more, to 1e-3 of diffraction; in a smaller one the field is refused."""
    lens = mirror(20.0)
    scene = scene_of(lens, torch.zeros(2, 1).double())
    frequencies = mtf.frequency_range(lens, scene.fields, 41)
    wave = torch.stack(mtf._sheared(scene, frequencies)())
    for module in (aperture, mtf):
        monkeypatch.setattr(module, "polynomials_of", lambda *_: None)
    found = rt.mtf(lens)
    assert found.by_rays.all()
    assert found.geometric
    assert (both(found) - wave).abs().max() < 1e-3
    assert found.tangential.min() < 0.01
    with pytest.raises(ValueError, match="1280: focus the lens, or use geometric"):
        rt.mtf(lens, frequencies, geometric=False)
    with pytest.raises(ValueError, match="1280: focus the lens, or use geometric"):
        rt.mtf(mirror(8.0))


@pytest.mark.parametrize(("defocus", "change"), [(5.0, 2.73e-3), (20.0, 8.4e-4)])
def test_the_change_by_diffraction_is_predicted(defocus, change):
    """change: of the MTF of rays to that of the sheared pupil, by quadrature."""
    lens = mirror(defocus)
    scene = scene_of(lens, torch.zeros(2, 1).double())
    frequencies = mtf.frequency_range(lens, scene.fields, 41)
    wave, rays = mtf._sheared(scene, frequencies)(), mtf._geometric(lens, scene.fields, frequencies)
    assert (wave[0] - rays[0]).abs().max() == pytest.approx(change, rel=0.02)
    assert mtf._change_by_diffraction(scene, frequencies, rays) == pytest.approx(change, rel=0.3)


def test_text_json_and_figure_report_which_fields_are_geometric(rough, monkeypatch, capsys):
    monkeypatch.setattr(aperture, "_MOST", 192)
    lens = defocused(1.5)
    found = rt.mtf(lens, [0.02])
    part = rt.mtf(lens, [0.02], fields=[0.0])
    mixed = mtf.Mtf(lens, found.fields, *[getattr(found, n) for n in ("frequencies", "tangential", "sagittal")],
                    limit=None, geometric=False, by_rays=torch.tensor([False, True, False]))  # fmt: skip
    assert part.document()["transfer"] == "geometric"
    assert mixed.document()["transfer"] == "diffraction (geometric for 10 degrees)"
    assert str(mixed).splitlines()[-1] == "transfer: diffraction (geometric for 10 degrees)"
    monkeypatch.setattr(mtf.Mtf, "drawn", lambda result: result)
    titles = [text.get_text() for text in mixed.plot().findobj(Text)]
    assert any("diffraction (geometric for 10 degrees) MTF" in title for title in titles)
    assert main(["mtf", "tessar", "--frequency", "5", "--geometric", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["transfer"] == "geometric"
    assert main(["mtf", "singlet", "--frequency", "5", "--no-geometric", "--field", "0", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["transfer"] == "diffraction"


def test_a_blur_of_too_many_points_names_the_option_and_the_field_outside(monkeypatch, capsys):
    monkeypatch.setattr(aperture, "_MOST", 100)
    lens = defocused(1.5)
    with pytest.raises(
        aperture.TooManyPoints, match=r"use geometric rays, `geometric=True`; field 15 degrees is outside .*, 14$"
    ):
        rt.mtf(lens, [5.0], fields=[15.0], geometric=False)
    with pytest.raises(aperture.TooManyPoints, match=r"use geometric rays, `geometric=True`$"):
        rt.mtf(lens, [5.0], fields=[14.0], geometric=False)
    conditions = "--sensor-distance", "59.4", "--field", "14"
    assert main(["mtf", "double_gauss", *conditions, "--frequency", "5", "--no-geometric"]) == 1
    assert "use geometric rays, --geometric" in capsys.readouterr().err


def test_a_long_trace_is_predicted(rough, monkeypatch):
    monkeypatch.setattr(aperture, "_SURFACE_SECONDS", 1e-3)
    with pytest.warns(TakesLong, match=r"[0-9,]+ rays: .*minutes; .*use geometric rays"):
        rt.mtf(rt.read_lens("double_gauss"), [5.0], fields=[0.0], geometric=False)

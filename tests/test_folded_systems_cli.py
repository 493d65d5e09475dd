"""Commands on folded systems: a figure that shows the whole system, or one line with the reason for its absence."""

import numpy as np
import pytest
import torch
from bends import pose
from matplotlib.backends.backend_agg import FigureCanvasAgg

import raytrace as rt
from raytrace.analysis.compare_models import abilities
from raytrace.analysis.layout_3d import draw
from raytrace.words import named, with_article


@pytest.mark.parametrize("command", ["incidence", "rms-over-field", "distortion-grid", "distortion", "field-curvature"])
def test_analyses_over_fields_name_a_lens_without_fields(run, tmp_path, command):
    """A curve over one field point is an empty figure."""
    figure = tmp_path / "figure.png"
    outcome = run(command, "spectrometer", "--plot", str(figure))
    assert outcome.code == 1
    assert outcome.err.count("\n") == 1
    assert "spectrometer: nothing to show over the field" in outcome.err
    assert "--field" in outcome.err or command == "distortion-grid"
    assert not figure.exists()


@pytest.mark.parametrize(
    ("argv", "said"),
    [
        (["seidel", "hybrid_achromat"], "surface 2 is a radial phase: Seidel's theory is of even powers of r; `wave"),
        (["seidel", "spectrometer"], "one straight axis, but surface 5 is a coordinate break; `wavefront`"),
        (["convert", "cylinder_pair", "OUT.csv"], "surface is toroidal, which this format does not hold"),
        (["convert", "hybrid_achromat", "OUT.csv"], "has a phase (a radial phase), which this format does not hold"),
        (["convert", "folded_relay", "OUT.csv"], "tilted or decentred, which this format does not hold; a .zmx file"),
        (["compare-models", "folded_relay"], "ask for kernels of one model by `psf`"),
    ],
)  # fmt: skip
def test_a_refusal_names_the_surface_and_the_alternatives(run, tmp_path, argv, said):
    outcome = run(*(str(tmp_path / word) if word == "OUT.csv" else word for word in argv))
    assert (outcome.code, outcome.out) == (1, "")
    assert said in outcome.err
    assert not list(tmp_path.iterdir())


def test_kinds_in_words():
    assert named(rt.system.IdealLens(0.1, 0.1)) == "an ideal lens"
    assert with_article("biconic") == "a biconic"


def plate() -> rt.Lens:
    """A tilted plate in a wide beam, which is as wide on the sensor."""
    tilt = {"before": pose(tilt_x=20.0), "after": pose(tilt_x=-20.0, tilts_first=True)}
    rows = [dict(thickness=5.0), dict(thickness=10.0, glass="N-BK7", **tilt), dict(thickness=20.0)]
    return rt.lens(rows, stop=1, entrance_pupil_diameter=50)


@pytest.mark.parametrize("name", ["plate", "cylinder_pair", "folded_relay"])
def test_all_that_is_drawn_in_space_lies_inside_the_picture(name):
    """The sensor too, which is drawn larger than where rays end."""
    lens = plate() if name == "plate" else rt.read_lens(name)
    figure = draw(lens, torch.stack([lens.fields.x, lens.fields.y]), lens.wavelengths[:1], 7)
    FigureCanvasAgg(figure).draw()
    (axes,) = figure.axes
    for drawn in axes.collections:
        points = np.concatenate([path.vertices for path in drawn.get_paths()])
        seen = axes.transData.transform(points)
        assert (seen >= axes.bbox.min).all()
        assert (seen <= axes.bbox.max).all()


def test_a_parallel_beam_has_encircled_energy(tmp_path):
    """Its F-number is infinite, which is no radius to draw up to."""
    beam = rt.lens([dict(thickness=5.0), dict(thickness=20.0)], stop=1, entrance_pupil_diameter=0.8)
    found = rt.encircled_energy(beam)
    assert torch.isfinite(found.radii).all()
    assert 0.9 < float(found.share.detach().max()) < 1  # some light is diffracted into the shadow
    found.plot(tmp_path / "share.png")


def test_models_are_compared_where_a_surface_is_curved():
    ideal = rt.lens(
        [dict(thickness=50.0, phase=rt.system.IdealLens(0.02, 0.02))], stop=1, entrance_pupil_diameter=5, fields=[0, 1]
    )
    with pytest.raises(ValueError, match=r"no .*surface .*is curved; ask for kernels"):
        abilities(ideal)


def test_an_object_at_the_first_surface_is_refused_with_the_way_out():
    lens = rt.read_lens("singlet").at(fields=[0.0])
    with pytest.raises(ValueError, match=r"0 and nan; .*`object_distances`"):
        rt.psf(lens, "drt", object_distances=[0.0])


def test_a_spectrum_is_no_blur_of_waves():
    """Five colours 3 mm apart: of waves alone the light would be counted over and over."""
    lens = rt.read_lens("spectrometer")
    with pytest.raises(ValueError, match=r"`geometric`, .*`wavelengths`"):
        rt.encircled_energy(lens)
    assert float(rt.encircled_energy(lens, geometric=True).share.detach().max()) <= 1


def test_light_is_counted_once_however_large_the_radius():
    """Beyond where waves are followed all of it is inside: a share is never above 1."""
    lens = rt.read_lens("double_gauss").at(wavelengths=[0.5876], fields=[0.0])
    share = rt.encircled_energy(lens, [0.1, 0.2, 0.3, 0.5, 3.0]).share.detach()[0]
    assert (share.diff() >= 0).all()
    assert share[2] > 0.95
    assert share[3:].tolist() == [1.0, 1.0]

"""Figures: what they draw is where the lens and its rays are, and what they print is what the analysis says."""

import dataclasses
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.patches import Circle
from problems import number

import raytrace as rt
from raytrace.analysis import cross_section
from raytrace.analysis.focus_report import focus_rays
from raytrace.analysis.spot_diagram import airy_radius, field_spots, shares_of
from raytrace.io import read_lens
from raytrace.materials.glass import constant
from raytrace.maths.sampling import fan, gauss_rings
from raytrace.plotting import style
from raytrace.system.lens import Fields, Lens, SystemAperture, field_label, with_object_distance, with_sensor_distance
from raytrace.system.surface import Aperture, Surface, sag
from raytrace.tracing.focus import focus_of_rms
from raytrace.tracing.paraxial import first_order, paraxial_image_distance
from raytrace.tracing.spot import image_rays, spot_of_points

LENSES = Path(__file__).parents[1] / "lenses"
NANOMETRE = 1e-6
PUPIL = gauss_rings(4)


def by_gid(figure, gid: str) -> list:
    return [artist for artist in figure.findobj() if (artist.get_gid() or "").startswith(gid)]


def words(figure) -> str:
    return "\n".join(text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text")))


def fans(lens: Lens, rays: int = 5) -> list[list[cross_section.RayPath]]:
    fields = torch.stack([lens.fields.x, lens.fields.y])
    wavelength = lens.primary
    return cross_section.ray_paths(lens, fan(rays)[0], fields=fields, wavelength=wavelength, z_start=-10.0)


@pytest.fixture(scope="module")
def double_gauss(lens) -> Lens:
    return lens


# layout


@pytest.mark.parametrize("name", ["double_gauss", "hubble", "phone", "tessar", "singlet"])
def test_drawn_rays_bend_on_the_surfaces_and_end_on_the_image(name):
    lens = read_lens(name)
    z = cross_section.vertices(lens)
    paths = [path for field in fans(lens) for path in field]
    assert any(path.status == "ok" for path in paths)
    for path in paths:
        assert path.corners[-1] == path.surface
        if path.status == "ok":
            assert path.surface == len(lens.surfaces) - 1
        for height, depth, k in zip(path.y[1:], path.z[1:], path.corners[1:], strict=True):
            radius_squared = torch.tensor(height**2, dtype=torch.float64)
            assert abs(depth - z[k] - float(sag(lens.surfaces[k], radius_squared))) < NANOMETRE, (name, k)


def test_drawn_rays_end_where_the_traced_rays_end(double_gauss):
    heights = np.array([[path.y[-1] for path in field] for field in fans(double_gauss, 7)])
    traced = image_rays(double_gauss, fan(7)[0], wavelengths=double_gauss.wavelengths[:1]).position[1, :, 0]
    np.testing.assert_allclose(heights, traced.numpy(), atol=NANOMETRE)


def test_a_stop_behind_the_first_vertex_does_not_fold_the_rays():
    # The stop of this lens lies inside its first element and is written before it, with a negative thickness.
    for path in (path for field in fans(read_lens("phone")) for path in field):
        assert 1 not in path.corners
        assert (np.diff(path.z) > 0).all()


def test_the_glass_of_the_figure_is_bounded_by_the_sag(double_gauss):
    figure = rt.layout(double_gauss).plot()
    z = cross_section.vertices(double_gauss)
    elements = {int(artist.get_gid().split()[1]): artist.get_xy() for artist in by_gid(figure, "glass")}
    assert set(elements) == {1, 3, 4, 7, 8, 10}
    for k, corners in elements.items():
        half = len(corners) // 2
        for surface, profile in ((k, corners[:half]), (k + 1, corners[half:-1])):
            clear = np.abs(profile[:, 1]) <= double_gauss.surfaces[surface].semi_diameter
            assert clear.sum() > 50
            expected = sag(double_gauss.surfaces[surface], torch.as_tensor(profile[clear, 1] ** 2)).numpy()
            np.testing.assert_allclose(profile[clear, 0] - z[surface], expected, atol=NANOMETRE)


def test_global_vertices_follow_negative_thicknesses_and_infinite_ones_are_refused(double_gauss):
    np.testing.assert_allclose(cross_section.vertices(read_lens("hubble"))[1:], [0, 4906.071, 0, 6406.2])
    with pytest.raises(ValueError, match="surface 11 has a thickness of inf"):
        rt.layout(with_sensor_distance(double_gauss, math.inf)).plot()


def test_a_surface_without_semi_diameter_is_drawn_as_far_as_its_rays_reach(double_gauss):
    bare = dataclasses.replace(
        double_gauss, surfaces=tuple(dataclasses.replace(s, semi_diameter=None) for s in double_gauss.surfaces)
    )
    radii = cross_section.drawn_radii(bare)
    highest = {}
    for path in (path for field in fans(bare, 11) for path in field):
        for height, k in zip(path.y[1:], path.corners[1:], strict=True):
            highest[k] = max(highest.get(k, 0.0), abs(height))
    assert len(highest) == 11  # ten refracting surfaces and the image
    for k, height in highest.items():
        assert height <= radii[k] <= 1.06 * height


def test_flats_of_an_element_never_cut_its_other_surface():
    thin = Surface(thickness=number(1.0), curvature=number(0.05), semi_diameter=12.0)
    plane = Surface(thickness=number(1.0), semi_diameter=5.0)
    z, y = cross_section.element(thin, plane, 0.0, 1.0, (12.0, 5.0), (False, False))
    half = len(z) // 2
    assert (z[half:][::-1] - z[:half] >= 0).all()
    assert abs(np.abs(y).max() - math.sqrt(20**2 - 19**2)) < 0.2  # where a sphere of 20 mm is 1 mm deep


def one_surface(curvature: float, index: float, aperture: float, apertures: tuple = ()) -> Lens:
    """Light inside glass of an index meets a spherical surface to air."""
    one = torch.ones(1, dtype=torch.float64)
    return Lens(
        surfaces=(
            Surface(thickness=number(math.inf)),
            Surface(thickness=number(5.0), glass=constant(index), semi_diameter=aperture),
            Surface(thickness=number(30.0), curvature=number(curvature), apertures=apertures, semi_diameter=aperture),
            Surface(thickness=number(0.0)),
        ),
        stop=1,
        aperture=SystemAperture("entrance_pupil_diameter", number(2 * aperture)),
        fields=Fields("angle", 0 * one, 0 * one, one),
        wavelengths=0.55 * one,
        wavelength_weights=one,
    )


@pytest.mark.parametrize(
    ("curvature", "aperture", "apertures", "status"),
    [
        (-1 / 10, 9.0, (), "tir"),
        (-1 / 10, 12.0, (), "miss"),
        (-1 / 40, 9.0, (Aperture("circular", (0.0, 5.0)),), "vignetted"),
    ],
)
def test_a_failed_or_vignetted_ray_ends_at_its_surface(curvature, aperture, apertures, status):
    lens = one_surface(curvature, 1.5, aperture, apertures)
    (paths,) = fans(lens, 3)
    assert [path.status for path in paths] == [status, "ok", status]
    for path in (paths[0], paths[2]):
        assert path.surface == 2
        assert abs(path.y[-1]) == pytest.approx(aperture)  # the rays are parallel to the axis
        depth = 0.0 if status == "miss" else float(sag(lens.surfaces[2], number(aperture**2)))
        assert path.z[-1] == pytest.approx(5.0 + depth)
    figure = rt.layout(lens, rays=3).plot()
    assert len(by_gid(figure, "lost ray")) == 2
    assert len(by_gid(figure, "ray")) == 1


def test_an_obscured_telescope_loses_its_central_rays_and_its_primary_has_a_hole():
    lens = read_lens("hubble")
    paths = fans(lens, 11)
    axial = paths[0]
    assert [path.status == "vignetted" for path in axial] == [abs(p) < 396 / 1200 for p in np.linspace(-1, 1, 11)]
    assert all(path.surface == 1 for path in axial if path.status == "vignetted")
    through = max(
        abs(np.interp(4906.071, path.z[-2:], path.y[-2:])) for f in paths for path in f if path.status == "ok"
    )
    hole = cross_section.hole_radius(2, cross_section.vertices(lens), 1200.0, paths)
    assert through < hole < 396.0
    assert cross_section.hole_radius(3, cross_section.vertices(lens), 155.0, paths) == 0.0


def test_rays_of_a_near_object_start_on_it_and_those_of_a_far_one_in_front_of_the_lens(double_gauss):
    near = dataclasses.replace(
        double_gauss, fields=dataclasses.replace(double_gauss.fields, kind="object_height", y=number([0.0, -5.0, -9.0]))
    )
    near = with_object_distance(near, 200.0)
    near = with_sensor_distance(near, paraxial_image_distance(near, number(200.0)))
    figure = rt.layout(near).plot()
    starts = [(line.get_xdata()[0], line.get_ydata()[0]) for line in by_gid(figure, "ray")]
    assert {round(z, 9) for z, _ in starts} == {-200.0}
    assert {round(y, 9) + 0.0 for _, y in starts} == {0.0, -5.0, -9.0}
    far = rt.layout(double_gauss.at(object_distance=25000.0)).plot()
    lengths = {round(line.get_xdata()[0], 6) for line in by_gid(far, "ray")}
    assert len(lengths) == 1
    assert -50 < lengths.pop() < 0


def test_layout_describes_its_rays(double_gauss):
    text = words(rt.layout(double_gauss.at(object_distance=25000.0)).plot())
    for expected in (double_gauss.name, "EFL 99.51 mm", "F/2.99", "object at 25 m", "0°", "10°", "14°", "20 mm"):
        assert expected in text
    colours = {line.get_color() for line in by_gid(rt.layout(double_gauss).plot(), "ray")}
    assert colours == set(style.FIELD_COLOURS[:3])


# spot diagram


def test_printed_radii_are_those_of_the_spot():
    lens = read_lens("cooke_triplet")
    rays = image_rays(lens, PUPIL[0])
    weights = (lens.wavelength_weights[:, None] * PUPIL[1]).flatten()
    expected = spot_of_points(rays.position[:2].flatten(2), rays.valid.flatten(1), weights)
    text = words(rt.spot(lens, rings=4).plot())
    for radius in expected.rms_radius:
        assert f"RMS {style.number_text(1000 * float(radius))} µm" in text
    whole, dots = field_spots(lens, pupil=PUPIL)
    torch.testing.assert_close(whole.rms_radius, expected.rms_radius, rtol=1e-12, atol=0)
    assert (whole.geometric_radius >= expected.geometric_radius).all()  # the dots reach the rim of the pupil
    assert dots.points.shape[1:3] == (3, 3)
    for radius in rt.spot(lens, rings=4).whole.geometric_radius:  # as the table has it
        assert f"GEO {style.number_text(1000 * float(radius))} µm" in text
    assert "0.4861 µm" in text
    assert "Field angle 8.4°" in text


def test_wavelengths_that_are_given_weigh_the_same_unless_given():
    lens = dataclasses.replace(read_lens("cooke_triplet"), wavelength_weights=number([1.0, 2.0, 1.0]))
    assert shares_of(lens, None, None).tolist() == [1, 2, 1]
    assert shares_of(lens, number([0.5, 0.6]), None).tolist() == [1, 1]
    assert shares_of(lens, number([0.5, 0.6]), number([3.0, 1.0])).tolist() == [3, 1]


def test_airy_circle_is_the_first_dark_ring(double_gauss):
    data = first_order(double_gauss)
    radius = 1.22 * 0.530e-3 * float(data.effective_focal_length) / 33.33
    assert float(airy_radius(double_gauss)) == pytest.approx(radius, rel=1e-9)
    circles = [artist for artist in by_gid(rt.spot(double_gauss, rings=4).plot(), "Airy") if isinstance(artist, Circle)]
    assert [circle.radius for circle in circles] == pytest.approx([radius] * 3)


def test_panels_share_one_scale_and_are_centred_on_the_centroid():
    lens = read_lens("cooke_triplet")
    figure = rt.spot(lens, rings=4).plot()
    whole, _ = field_spots(lens, pupil=PUPIL)
    assert len({axes.get_xlim() for axes in figure.axes}) == 1
    (_, half) = figure.axes[0].get_xlim()
    assert float(whole.geometric_radius.max()) < half < 1.5 * float(whole.geometric_radius.max())
    for f, axes in enumerate(figure.axes):
        farthest = max(
            np.hypot(line.get_xdata(), line.get_ydata()).max() for line in axes.lines if len(line.get_xdata()) > 100
        )
        # Dots stand in the middle of their area, 0.96 of the way to the rim, which the geometric radius includes.
        assert 0.85 * float(whole.geometric_radius[f]) < farthest <= float(whole.geometric_radius[f]) * (1 + 1e-12)


def test_a_fully_vignetted_field_is_reported(double_gauss):
    blind = double_gauss.replace(6, apertures=(Aperture("circular", (0.0, 20.0), obscures=True),))
    assert "no ray reaches" in words(rt.spot(blind, rings=4).plot())
    with pytest.raises(rt.NoFocus, match="no ray reaches the image"):
        rt.focus(blind)
    rt.layout(blind).plot()


# through focus


def test_curve_passes_through_the_spot_of_the_moved_sensor_and_its_minimum_is_the_focus(double_gauss):
    points, weights = gauss_rings(6)
    lens = with_object_distance(double_gauss, 25000.0)
    axis = torch.zeros(2, 1, dtype=torch.float64)
    figure = rt.focus(lens, rings=6).plot(by="field")
    curve = max(figure.axes[0].lines, key=lambda line: len(line.get_xdata()))
    best = float(focus_of_rms(lens, points, weights, fields=axis))
    lowest = curve.get_xdata()[np.argmin(curve.get_ydata())]
    assert abs(lowest - best) < 2 * np.diff(curve.get_xdata())[0]
    assert "57.6620 mm, 7.075 µm" in words(figure)  # as an independent calculation has it
    moved = with_sensor_distance(lens, curve.get_xdata()[17])
    rays = image_rays(moved, points, fields=axis)
    radius = spot_of_points(rays.position[:2], rays.valid, weights).rms_radius
    assert curve.get_ydata()[17] == pytest.approx(1000 * float(radius), rel=1e-9)
    marks = {text.get_text(): text.xy[0] for text in figure.axes[0].texts if text.get_rotation() == 90}
    assert marks["sensor"] == 58.5
    assert marks["paraxial focus"] == pytest.approx(57.8817685209, abs=1e-9)


def test_curves_by_wavelength_find_the_axial_colour():
    lens = read_lens("singlet")
    fields = torch.zeros(2, 1, dtype=torch.float64)
    bundle = focus_rays(lens, fields=fields, wavelengths=None, wavelength_weights=None, pupil=PUPIL, by="wavelength")
    paraxial = [float(first_order(lens, wavelength).back_focal_distance) for wavelength in lens.wavelengths]
    assert list(np.argsort(bundle.best)) == list(np.argsort(paraxial)) == [0, 1, 2]
    assert "0.4861 µm" in words(rt.focus(lens, wavelengths=lens.wavelengths, rings=4).plot(by="wavelength"))
    with pytest.raises(ValueError, match="expected 'field' or 'wavelength'"):
        rt.focus(lens).plot(by="colour")


# focus report


def test_focus_report_prints_the_sensor_and_the_spot_before_and_after(double_gauss):
    found = rt.focus(double_gauss, object_distances=[25000.0], rings=6)
    figure = found.plot()
    text = words(figure)
    for expected in ("sensor before: 58.5000 mm", "sensor after: 57.6620 mm, 7.075 µm", "RMS 7.075 µm", "RMS 100.2 µm"):
        assert expected in text
    assert "paraxial focus: 57.8818 mm, 27.16 µm" in text
    assert "object at 25 m" in text
    scales = {
        axes.get_xlim()
        for axes in figure.findobj(lambda a: hasattr(a, "get_xlim"))
        if axes.get_title().startswith("Spot ")
    }
    assert len(scales) == 1
    assert {line.get_xdata()[-1] for line in by_gid(figure, "ray")} == {cross_section.vertices(found.lens)[-1]}


@pytest.mark.slow
def test_focus_report_takes_several_objects_and_fields(double_gauss):
    fields = number([[0.0, 0.0], [0.0, 14.0]])
    found = rt.focus(double_gauss, object_distances=[25000.0, math.inf], fields=fields, rings=4)
    text = words(dataclasses.replace(found, lens=with_sensor_distance(double_gauss, 57.9)).plot())
    for label in ("25 m, 0°:", "25 m, 14°:", "infinity, 0°:", "infinity, 14°:", "paraxial foci"):
        assert label in text
    assert text.count("RMS ") - text.count("RMS spot radius") - text.count("least RMS") == 8


# saving, and leaving no trace


@pytest.mark.parametrize(
    ("suffix", "start"), [("png", b"\x89PNG"), ("pdf", b"%PDF"), ("svg", b"<?xml"), ("PNG", b"\x89PNG")]
)
def test_save_writes_the_format_of_the_suffix_and_the_same_bytes_again(double_gauss, tmp_path, suffix, start):
    layout = rt.layout(double_gauss, rays=3)
    for name in ("a", "b"):
        style.save(layout.plot(), tmp_path / f"{name}.{suffix}", dpi=60)
    first, second = ((tmp_path / f"{name}.{suffix}").read_bytes() for name in ("a", "b"))
    assert first.startswith(start)
    assert first == second
    assert sorted(path.name for path in tmp_path.iterdir()) == [f"a.{suffix}", f"b.{suffix}"]


@pytest.mark.parametrize("name", ["figure.bmp", "figure", "figure.zmx"])
def test_an_unknown_suffix_is_refused_by_name(double_gauss, tmp_path, name):
    with pytest.raises(ValueError, match=r"expected one of \.png, \.pdf, \.svg"):
        style.save(style.new_figure(1, 1), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_a_failing_save_leaves_the_old_file_and_nothing_else(tmp_path, monkeypatch):
    target = tmp_path / "figure.png"
    target.write_bytes(b"old")
    figure = style.new_figure(1, 1)

    def broken(file, **settings):
        file.write(b"half a figure")
        raise MemoryError

    monkeypatch.setattr(figure, "savefig", broken)
    with pytest.raises(MemoryError):
        style.save(figure, target)
    assert target.read_bytes() == b"old"
    assert [path.name for path in tmp_path.iterdir()] == ["figure.png"]
    with pytest.raises(OSError, match="nowhere"):
        style.save(style.new_figure(1, 1), tmp_path / "nowhere" / "figure.png")


@pytest.mark.slow
def test_figures_touch_neither_pyplot_nor_the_settings_of_the_reader():
    script = (
        "import sys, matplotlib\n"
        "before = dict(dict.items(matplotlib.rcParams))  # raw: looking up the backend would load pyplot\n"
        "import raytrace as rt\n"
        "rt.layout(rt.read_lens('singlet'), rays=3).plot()\n"
        "assert 'matplotlib.pyplot' not in sys.modules\n"
        "assert dict(dict.items(matplotlib.rcParams)) == before\n"
    )
    subprocess.run([sys.executable, "-W", "ignore", "-c", script], check=True, cwd=LENSES.parent)


def test_the_lens_keeps_its_gradients(double_gauss):
    thickness = double_gauss.surfaces[-2].thickness.clone().requires_grad_()
    lens = double_gauss.at(sensor_distance=thickness)
    for figure in (
        rt.layout(lens, rays=3).plot(),
        rt.spot(lens, rings=4).plot(),
        rt.focus(lens, rings=4).plot(by="field"),
    ):
        assert figure.axes
    assert thickness.grad is None
    assert thickness.requires_grad


# words and colours


@pytest.mark.parametrize(
    ("value", "text"),
    [(99.99999, "100.0"), (7.0753, "7.075"), (-0.01134, "−0.01134"), (1045.2, "1045"), (0.0, "0"), (math.nan, "–")],
)
def test_numbers_keep_four_significant_digits(value, text):
    assert style.number_text(value) == text


@pytest.mark.parametrize(("length", "text"), [(0.05, "50 µm"), (20.0, "20 mm"), (1000.0, "1 m"), (5e-5, "0.05 µm")])
def test_round_lengths(length, text):
    assert style.round_text(style.round_length(1.3 * length)) == text


def test_field_labels_carry_their_unit(double_gauss):
    assert field_label(double_gauss, (0.0, -14.0)) == "−14°"
    assert field_label(double_gauss, (3.0, 4.5)) == "(3, 4.5)°"
    heights = dataclasses.replace(double_gauss, fields=dataclasses.replace(double_gauss.fields, kind="object_height"))
    assert field_label(heights, (0.0, 5.0)) == "5 mm"


def test_wavelength_colours_follow_the_eye():
    blue, green, red = style.wavelength_colours([0.4861327, 0.53, 0.6562725])
    assert np.argmax(blue) == 2
    assert np.argmax(green) == 1
    assert np.argmax(red) == 0
    infrared = style.wavelength_colours([3.0, 4.0, 5.0])
    assert len(set(infrared)) == 3


def test_a_notebook_shows_the_figure():
    image = rt.layout("singlet").plot()._repr_png_()
    assert image.startswith(b"\x89PNG")
    assert len(image) > 10_000

"""Frames of surfaces in space, and layouts of folded systems."""

import dataclasses
import math

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.analysis import cross_section, layout_3d
from raytrace.maths.sampling import fan
from raytrace.system.surface import sag_at
from raytrace.tracing.geometry import frames


def folded(tilt_y: float = 0.0) -> rt.Lens:
    """A plano-convex lens, a fold by 90° and a tilted sensor."""
    tilt = rt.system.Pose(tilt_x=45.0, tilt_y=tilt_y)
    return rt.lens(
        [
            dict(thickness=10.0),
            dict(radius=51.68, thickness=5.0, glass="N-BK7", semi_diameter=12.0),
            dict(thickness=40.0, semi_diameter=12.0),
            dict(thickness=-56.0, glass="MIRROR", before=tilt, after=rt.system.Pose(tilt_x=45.0), semi_diameter=14.0),
        ],
        stop=1,
        entrance_pupil_diameter=16,
        fields=[0, 3],
    )


def test_frames_of_a_fold_by_a_right_angle():
    """The light goes up after the mirror, along -z of axes that lie on their side."""
    found = frames(folded())
    assert torch.allclose(found[4].origin, torch.tensor([0.0, 0.0, 55.0], dtype=torch.float64))
    assert torch.allclose(found[5].origin, torch.tensor([0.0, 56.0, 55.0], dtype=torch.float64), atol=1e-12)
    assert torch.allclose(found[5].axes[:, 2], torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64), atol=1e-15)
    point = torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    assert torch.allclose(found[5].inside(found[5].outside(point)), point, atol=1e-13)


@pytest.mark.parametrize("tilt_y", [0.0, 20.0])
def test_rays_in_space_are_straight_between_surfaces_and_lie_on_them(tilt_y):
    lens = folded(tilt_y)
    placed, fields = frames(lens), torch.stack([lens.fields.x, lens.fields.y])
    points = torch.cat([fan(5, axis)[0] for axis in "xy"], 1)
    paths = cross_section.ray_paths(lens, points, fields=fields, wavelength=lens.wavelengths[0], z_start=-10.0)
    found = [path for field in paths for path in field]
    assert {path.status for path in found} == {"ok"}
    for path in found:
        for k, corner in zip(path.corners[1:], path.points.T[1:], strict=True):
            x, y, z = placed[k].inside(torch.tensor(corner))
            assert abs(float(z - sag_at(lens.surfaces[k], x, y))) < 1e-12
    end = rt.trace(lens, rt.tracing.rays(lens, pupil=points))
    drawn = np.array([path.points[:, -1] for path in found]).reshape(2, 10, 3)
    traced = placed[-1].outside(end.position[:, :, 0]).permute(1, 2, 0).numpy()
    assert np.abs(drawn - traced).max() < 1e-11


def test_the_fold_is_drawn_upward_and_seen_from_above_edge_on():
    lens = folded()
    figure = rt.layout(lens).plot()
    sensor = next(line for line in figure.axes[0].lines if line.get_gid() == "sensor")
    assert np.abs(sensor.get_ydata() - 56).max() < 1e-9
    from_above = cross_section.sections(lens, "xz")
    assert from_above[5].across == pytest.approx([0.0, 1.0])
    assert from_above[5].along == pytest.approx([0.0, 0.0], abs=1e-12)
    glass = [artist for artist in figure.axes[0].patches if str(artist.get_gid()).startswith("glass")]
    assert len(glass) == 1


def test_a_wedge_of_glass_is_bounded_by_its_tilted_faces():
    there, back = rt.system.Pose(tilt_x=-20.0), rt.system.Pose(tilt_x=20.0)
    front = dict(thickness=10.0, glass="N-BK7", semi_diameter=5.0, before=there, after=back)
    prism = rt.lens([front, dict(thickness=30.0, semi_diameter=6.0, before=back)], stop=1, entrance_pupil_diameter=5)
    (glass,) = [patch for patch in rt.layout(prism).plot().axes[0].patches if str(patch.get_gid()) == "glass 1"]
    corners = glass.get_xy()
    near, far = corners[: len(corners) // 2], corners[len(corners) // 2 : -1]
    slope = math.tan(math.radians(20))
    assert np.abs(near[:, 0] + slope * near[:, 1]).max() < 1e-9
    assert np.abs(far[:, 0] - (10 + slope * far[:, 1])).max() < 1e-9
    assert np.abs(near[-1] - far[0])[1] < 2  # the outline goes round, and does not cross itself


@pytest.mark.parametrize("view", [*(pytest.param(view, marks=pytest.mark.slow) for view in ("yz", "xz")), "3d"])
def test_views(tmp_path, view):
    rt.layout(folded(), view=view, rays=3).plot(tmp_path / "view.png")
    assert (tmp_path / "view.png").stat().st_size > 10_000


def test_colours_by_wavelength():
    lens = folded()
    with pytest.raises(ValueError, match="view=zy"):
        rt.layout(lens, view="zy")
    figure = rt.layout(lens, fields=[0], wavelengths=[0.45, 0.65], rays=3).plot()
    rays = [line for line in figure.axes[0].lines if line.get_gid() == "ray"]
    assert len(rays) == 6
    assert len({line.get_color() for line in rays}) == 2
    assert "0.45 µm" in "".join(text.get_text() for text in figure.legends[0].get_texts())


@pytest.mark.slow
def test_an_aperture_larger_than_its_surface_leaves_the_drawing_as_it_is():
    lens = rt.read_lens("cooke_triplet")
    for aperture in (
        rt.system.Aperture("circular", (0.0, 1e6), False, (0.0, 1.0)),
        rt.system.Aperture("circular", (12.0, 1e6), True),
    ):
        first = dataclasses.replace(lens.surfaces[1], apertures=(aperture,))
        wide = dataclasses.replace(lens, surfaces=(lens.surfaces[0], first, *lens.surfaces[2:]))
        figure = rt.layout(wide).plot()
        assert all(np.abs(line.get_ydata()).max() < 50 for line in figure.axes[0].lines)
        space, plain = (rt.layout(one, view="3d").plot().axes[0] for one in (wide, lens))
        assert space.get_zlim() == pytest.approx(plain.get_zlim(), abs=5)


def test_obscurations_are_seen_in_space(monkeypatch):
    lens = rt.read_lens("cooke_triplet")
    vane = rt.system.Aperture("rectangular", (2.0, 6.0), True)
    surface = dataclasses.replace(lens.surfaces[1], apertures=(vane,))
    lens, drawn = dataclasses.replace(lens, surfaces=(lens.surfaces[0], surface, *lens.surfaces[2:])), []
    monkeypatch.setattr(layout_3d, "_add_tiles", lambda axes, tiles, **look: drawn.append((look["facecolor"], tiles)))
    rt.layout(lens, view="3d").plot()
    (tiles,) = [tiles for colour, tiles in drawn if colour == "#8c8c8c"]
    corners = np.concatenate(tiles)  # z, x and y
    size = float(lens.surfaces[1].semi_diameter) / 40  # of a tile
    assert np.abs(corners[:, 1]).max() == pytest.approx(2.0, abs=size)
    assert np.abs(corners[:, 2]).max() == pytest.approx(6.0, abs=size)


def test_a_decentred_aperture_shows_that_part_of_a_mirror():
    part = rt.system.Aperture("circular", (0.0, 54.0), False, (0.0, 100.0))
    mirror = dict(radius=-1000.0, conic=-1.0, thickness=-500.0, glass="MIRROR", apertures=(part,))
    tilted = rt.lens([dict(thickness=600.0), mirror], stop=1, entrance_pupil_diameter=300, fields=[0])
    (face,) = [line for line in rt.layout(tilted).plot().axes[0].lines if line.get_gid() == "mirror 2"]
    assert (face.get_ydata().min(), face.get_ydata().max()) == (46.0, 154.0)
    assert np.abs(face.get_xdata() - (600 - face.get_ydata() ** 2 / 2000)).max() < 1e-9


def test_rays_by_wavelength_show_the_spectrum_on_the_image():
    """The landing points of every wavelength are drawn next to the layout, in the colours of the traced rays."""
    lens = rt.read_lens("spectrometer")
    figure = rt.layout(lens, wavelengths=[0.45, 0.55, 0.65]).plot()
    lines = [line for line in figure.axes[1].lines if line.get_marker() == "."]
    assert len({line.get_color() for line in lines}) == 3
    traced = rt.spot(lens, wavelengths=[0.45, 0.55, 0.65]).centroid[1, 0]
    drawn = [float(np.mean(line.get_ydata())) for line in lines]
    assert drawn == pytest.approx(traced.tolist(), abs=0.01)


@pytest.mark.slow
def test_two_planes_in_one_place_are_drawn(tmp_path):
    """The length of the figure is then that of the beam's width."""
    rows = [dict(thickness=0)]
    flat = rt.lens(rows, stop=1, entrance_pupil_diameter=1, object_distance=3, wavelengths=[0.55])
    for view in ("section", "3d"):
        path = tmp_path / f"{view}.png"
        rt.layout(flat, **({} if view == "section" else {"view": view})).plot(path)
        assert path.stat().st_size > 1000

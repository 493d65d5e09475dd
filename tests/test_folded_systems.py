"""Folded and tilted systems: folds change no image, tilted sensors follow geometry, rigid motion changes nothing."""

import dataclasses
import math

import bends
import pytest
import torch
from bends import pose, real
from differences import gradcheck

import raytrace as rt
from raytrace.analysis.setting import scene_of
from raytrace.tracing.focus import along_normal, focus_of_rms
from raytrace.tracing.scene import symmetry
from raytrace.tracing.trace import Bent
from raytrace.tracing.wavefront import rms, wavefront_of

FIELDS = [0.0, 7.0, 14.0]


def lens_in_focus() -> rt.Lens:
    return rt.focus(rt.read_lens("double_gauss")).lens.at(fields=FIELDS, wavelengths=[0.5876, 0.4861, 0.6563])


def folds(lens: rt.Lens) -> dict[str, rt.Lens]:
    last = len(lens.surfaces) - 2
    one = bends.folded(lens, last, 0.6, tilt_x=45.0)
    return {
        "90° about x": one,
        "90° about y": bends.folded(lens, last, 0.6, tilt_y=-45.0),
        "askew": bends.folded(lens, last, 0.6, tilt_x=20.0, tilt_y=30.0),
        "before the stop": bends.folded(lens, 4, tilt_x=3.0),
        "two": bends.folded(one, last + 1, 0.5, tilt_x=-45.0),
        "180°": bends.folded(lens, last, 0.6),
        "180°, z turned": bends.turned_back(lens, last, 0.6),
    }


def images(lens: rt.Lens) -> dict[str, torch.Tensor]:
    """Numbers (fields first) that a plane mirror does not change, but for the side that images stand on."""
    fields = torch.tensor([[0.0] * len(FIELDS), FIELDS], dtype=torch.float64)
    spots = rt.spot(lens)
    front = wavefront_of(scene_of(lens, fields), *rt.maths.gauss_rings(6))
    mtf = rt.mtf(lens, [20.0, 50.0])
    curvature = rt.field_curvature(lens, fields=FIELDS)
    away = torch.where(curvature.valid, curvature.tangential - curvature.sagittal, 0.0)
    return {
        "spot": spots.rms_radius,
        "place": spots.centroid,
        "wavefront": 1e3 * front.opd / front.wavelength[:, None],
        "radius": front.radius,
        "rms": rms(front),
        "tangential": mtf.tangential,
        "sagittal": mtf.sagittal,
        "astigmatism": away.abs(),
        "distortion": rt.distortion(lens, fields=FIELDS).f_tan,
        "colour": rt.lateral_colour(lens, fields=FIELDS).shift,
        "light": rt.relative_illumination(lens, fields=FIELDS).illumination,
        "gaussian": rt.psf(lens, rt.psf_models.Gaussian(order=4), center="chief", size=9).kernel,
        "drt": rt.psf(lens, rt.psf_models.DRT(rays=4096), center="chief", size=9).kernel,
        "encircled": rt.encircled_energy(lens, [0.005, 0.01]).share,
    }


@pytest.fixture(scope="module")
def unfolded():
    lens = lens_in_focus()
    return lens, images(lens)


QUICK = ("before the stop",)


@pytest.mark.parametrize(
    "fold",
    [pytest.param(f, marks=() if f in QUICK else pytest.mark.slow) for f in folds(rt.read_lens("double_gauss"))],
)
def test_a_fold_changes_no_image(unfolded, fold):
    lens, expected = unfolded
    for name, number in images(folds(lens)[fold]).items():
        other = expected[name]
        if fold == "180°, z turned":  # x looks the other way
            other = other.flip(-1) if name in ("gaussian", "drt") else other
            other = other * real([-1.0, 1.0])[:, None, None] if name == "place" else other
            if name == "wavefront":
                continue
        assert (number - other).abs().max() < (1e-7 if name == "light" else 1e-9), name


def test_a_fold_changes_no_wave_kernel(unfolded):
    lens = unfolded[0].at(wavelengths=[0.5876], fields=[7.0])
    fold = folds(lens)["90° about x"]
    kernels = [rt.psf(one, rt.psf_models.Wave(order=4), center="chief", size=9).kernel for one in (lens, fold)]
    assert (kernels[0] - kernels[1]).abs().max() < 1e-7 * kernels[0].max()


def test_symmetry_shortcuts_are_off_where_axes_bend(unfolded):
    lens = unfolded[0]
    axis = torch.zeros(2, 1, dtype=torch.float64)
    assert symmetry(scene_of(lens, axis)) == "round"
    assert symmetry(scene_of(folds(lens)["askew"], axis)) == "none"


def test_the_best_model_is_chosen_without_those_that_need_an_axis(unfolded):
    found = rt.psf(folds(unfolded[0])["askew"].at(wavelengths=[0.5876]), "auto", fields=[0.0], tol=0.05)
    assert "paraxial" not in found.reason


def test_decentring_and_tilting_everything_changes_nothing(unfolded):
    """A break in front of a lens, the object at infinity turned with it: the fields are those of the new axes."""
    lens = unfolded[0]
    shifted = bends.inserted(
        lens, 0, [rt.system.Surface(real(0.0)), rt.system.Surface(real(0.0), before=pose(x=3.0, y=-2.0), is_break=True)]
    )
    entrance = rt.first_order(lens).entrance_pupil_position
    rays = rt.tracing.rays(lens, pupil=rt.maths.hexapolar(4)[0])
    moved = dataclasses.replace(rays, position=rays.position + real([3.0, -2.0, 0.0])[:, None, None, None])
    ends = rt.trace(lens, rays), rt.trace(shifted, moved)
    assert (ends[0].position - ends[1].position).abs().max() < 1e-11
    aimed = shifted.at(ray_aiming="paraxial")
    spots = rt.spot(aimed).rms_radius, rt.spot(lens.at(ray_aiming="paraxial")).rms_radius
    assert (spots[0] - spots[1]).abs().max() < 1e-9
    assert torch.isfinite(entrance)


def test_a_tilted_sensor_has_the_spots_of_geometry():
    """A cone of half angle u about a tilted sensor's normal: hits are those of the plane, stretched by 1/cos θ."""
    f, theta = 100.0, 40.0
    lens = rt.lens([{"thickness": f, "phase": rt.system.IdealLens(1 / f, 1 / f)}], stop=1, entrance_pupil_diameter=1e-3)
    away = lens.at(sensor_distance=f + 5.0)
    tilted = bends.on_tilted_sensor(away, tilt_x=theta)
    flat, slant = (rt.spot(one, sampling="hexapolar", rings=6).each for one in (away, tilted))
    widths = [(torch.nan_to_num(one.points) ** 2).mean(-1).sqrt()[:, 0, 0] for one in (flat, slant)]
    assert widths[1][0] == pytest.approx(float(widths[0][0]), rel=1e-4)
    assert widths[1][1] == pytest.approx(float(widths[0][1]) / math.cos(math.radians(theta)), rel=1e-4)


def test_scheimpflug():
    """Objects in a plane tilted by θ are sharp on a sensor tilted by θ′, tan θ′ = |m| tan θ: every field at its own."""
    f, s = 50.0, 200.0
    image = 1 / (1 / f - 1 / s)
    theta = math.degrees(math.atan(image / s * math.tan(math.radians(20.0))))
    lens = rt.lens(
        [{"thickness": image, "phase": rt.system.IdealLens(1 / f, 1 / f)}],
        stop=1, entrance_pupil_diameter=10.0, object_distance=s, fields=[0.0],
    )  # fmt: skip
    sharp, blurred = [], []
    for h in (-20.0, 0.0, 20.0):
        near = lens.at(object_distance=s + h * math.tan(math.radians(20.0)), fields=[h])
        for radii, turn in ((sharp, theta), (blurred, -theta)):
            radii.append(float(rt.spot(bends.on_tilted_sensor(near, tilt_x=turn)).rms_radius))
    assert min(max(sharp), max(blurred)) < 1e-9
    assert max(*sharp, *blurred) > 1e-2


def test_focus_moves_a_tilted_sensor_to_the_least_spot():
    lens = bends.on_tilted_sensor(lens_in_focus().at(fields=[0.0]), tilt_x=30.0, tilt_y=-10.0)
    points, weights = rt.maths.gauss_rings(8)
    best = focus_of_rms(lens.at(sensor_distance=lens.surfaces[-2].thickness + 0.3), points, weights)
    assert float(along_normal(lens)) == pytest.approx(math.cos(math.radians(30)) * math.cos(math.radians(10)))

    def radius(distance):
        return float(rt.spot(lens.at(sensor_distance=distance), rings=8).mean_square_radius.mean())

    least = radius(best)
    assert all(radius(best + step) > least for step in (-1e-3, 1e-3))


def test_focus_behind_folds_is_where_it_is_without():
    lens = rt.read_lens("double_gauss")
    plain = rt.focus(lens)
    last = len(lens.surfaces) - 2
    for fold, side in ((bends.folded(lens, last, 0.6, tilt_x=45.0), -1), (bends.turned_back(lens, last, 0.6), 1)):
        found, ahead = rt.focus(fold), 0.6 * lens.surfaces[last].thickness
        assert found.is_real
        assert float(side * found.sensor_distance + ahead) == pytest.approx(float(plain.sensor_distance), abs=1e-9)
        assert float(side * found.paraxial + ahead) == pytest.approx(float(plain.paraxial), abs=1e-9)


def test_a_perfect_lens_has_no_wavefront_of_its_own():
    for distance in (math.inf, 200.0):
        image = 1 / (1 / 50 - 1 / distance)
        lens = rt.lens(
            [{"thickness": 30.0, "phase": rt.system.IdealLens(1 / 50, 1 / 50)}, {"thickness": image - 30.0}],
            stop=1, entrance_pupil_diameter=25.0, object_distance=distance, fields=[0.0],
        )  # fmt: skip
        for one in (lens, bends.folded(lens, 2, 0.5, tilt_x=45.0)):
            assert float(rt.wavefront(one, size=15).rms.max()) < 1e-9


def test_a_spectrum_is_separated_on_the_sensor():
    """Wavelengths land where the grating sends them; each spot is small about its own centroid alone."""
    found = rt.spot(bends.spectrometer().at(fields=[0.0]), reference="chief")
    y = found.centroid[1, 0]
    assert float((y[1] - y[0]) * (y[2] - y[1])) > 0
    assert abs(float(y[2] - y[0])) > 5.0
    own = rt.spot(bends.spectrometer().at(fields=[0.0]))
    assert float(own.rms_radius.max()) < 0.1 * abs(float(y[2] - y[0]))
    assert float(found.rms_radius[0, 0]) == pytest.approx(
        math.hypot(float(own.rms_radius[0, 0]), float(y[1] - y[0])), rel=1e-2
    )


def test_failed_rays_behind_turned_axes_are_no_wavefront():
    """A ray that missed a surface has numbers of its own behind a fold: they are not taken for a vignetted ray's."""
    lens = rt.lens(
        [{"thickness": 20.0}, {"radius": 12.0, "thickness": 4.0, "glass": 1.5}, {"radius": -12.0, "thickness": 14.0}],
        stop=1, entrance_pupil_diameter=26.0, fields=[0.0],
    )  # fmt: skip
    fold = bends.folded(lens, 3, 0.5, tilt_x=40.0)
    points, weights = rt.maths.gauss_rings(8)
    fronts = [
        wavefront_of(scene_of(one, torch.zeros(2, 1, dtype=torch.float64)), points, weights) for one in (lens, fold)
    ]
    assert 0 < int(fronts[0].usable.sum()) < fronts[0].usable.numel()
    assert torch.equal(fronts[0].usable, fronts[1].usable)
    assert (fronts[0].opd - fronts[1].opd).abs().max() < 1e-10


@pytest.mark.slow
def test_derivatives_by_tilts():
    points, weights = rt.maths.gauss_rings(4)

    def merits(tilt, decentre):
        lens = rt.lens(
            [
                {"radius": 60.0, "thickness": 5.0, "glass": 1.6, "before": pose(tilt_x=tilt, x=decentre)},
                {"radius": -80.0, "thickness": 40.0, "after": pose(tilt_x=-tilt, x=-decentre)},
                {"thickness": -30.0, "glass": "MIRROR", "before": pose(tilt_x=40.0 + tilt), "after": pose(tilt_x=40.0)},
            ],
            stop=1, entrance_pupil_diameter=6.0, fields=[0.0, 2.0],
        )  # fmt: skip
        front = wavefront_of(
            scene_of(lens, torch.tensor([[0.0, 0.0], [0.0, 2.0]], dtype=torch.float64)), points, weights
        )
        mtf = rt.mtf(lens, [5.0], geometric=True)
        kernel = rt.psf(lens, rt.psf_models.Gaussian(order=3), center="axis", size=3, pixel=0.6).kernel
        return rt.spot(lens, rings=4).mean_square_radius, 1e3 * rms(front), mtf.tangential, mtf.sagittal, kernel

    at = [real(number).requires_grad_() for number in (3.0, 0.5)]
    assert gradcheck(merits, at, eps=1e-5, atol=1e-5)


@pytest.mark.slow
def test_the_strehl_ratio_is_differentiated_by_a_tilt():
    def ratio(tilt):
        mirror = {"radius": -400.0, "conic": -1.0, "glass": "MIRROR", "thickness": -200.0}
        lens = rt.lens([mirror | {"before": pose(tilt_x=tilt), "after": pose(tilt_x=tilt)}], stop=1, f_number=10.0)
        return rt.wavefront(lens, size=9).strehl

    assert gradcheck(ratio, [real(0.3).requires_grad_()], eps=1e-5, atol=1e-4)


def cylinders() -> rt.Lens:
    return rt.lens(
        [{"thickness": 0.0, "phase": rt.system.IdealLens(1 / 60, 1 / 50)}, {"thickness": 54.0}],
        stop=1, entrance_pupil_diameter=4.0, fields=[0.0],
    )  # fmt: skip


def toroid() -> rt.Lens:
    """A plano-convex lens of focal lengths 100 mm along y and 120 mm along x."""
    front = {"radius": 50.0, "kind": "toroidal", "coefficients": [1 / 60], "thickness": 4.0, "glass": 1.5}
    return rt.lens([front, {"thickness": 100.0}], stop=1, entrance_pupil_diameter=6.0, fields=[0.0, 3.0])


def test_a_toroid_has_the_foci_of_its_sections():
    found = rt.base_ray(toroid())
    assert found.focal_length.tolist() == pytest.approx([100.0, 120.0], abs=1e-9)
    assert found.back_focal_distance.tolist() == pytest.approx([100 - 4 / 1.5, 120 - 4 / 1.5], abs=1e-9)
    curvature = rt.field_curvature(toroid(), fields=[0.0])
    assert float(curvature.tangential) == pytest.approx(-4 / 1.5, abs=1e-5)
    assert float(curvature.sagittal) == pytest.approx(20 - 4 / 1.5, abs=1e-5)


def test_two_foci_show_in_focus_field_curvature_and_mtf():
    """Lines at 50 and 60 mm: their places from the sensor, the least spot between them, and what is sharp at each."""
    lens = cylinders()
    found = rt.field_curvature(lens, fields=[0.0])
    assert float(found.tangential) == pytest.approx(-4.0, abs=1e-6)
    assert float(found.sagittal) == pytest.approx(6.0, abs=1e-6)
    # Σ W cov / Σ W var of a disc: 1/s = (1/50 + 1/60)/(1/50² + 1/60²)
    best = (1 / 50 + 1 / 60) / (1 / 50**2 + 1 / 60**2)
    assert float(rt.focus(lens).sensor_distance) == pytest.approx(best, abs=1e-9)
    lines = [rt.mtf(lens.at(sensor_distance=at), [50.0]) for at in (50.0, 60.0)]
    assert float(lines[0].tangential) > 0.4 > 0.1 > float(lines[0].sagittal)
    assert float(lines[1].sagittal) > 0.4 > 0.1 > float(lines[1].tangential)


def test_models_of_one_focus_refuse_two():
    with pytest.raises(Bent, match=r"surface 1 has different powers along x and y; take model"):
        rt.psf(cylinders(), "paraxial")
    with pytest.raises(Bent, match="needs one focus"):
        rt.psf(cylinders(), "fourier")


@pytest.mark.parametrize("name", ["fold", "spectrometer", "mirror", "toroid"])
def test_light_paths_and_rays_are_of_one_wave(name):
    """Malus and Dupin: the path grows over the image as the rays lean, ∂W = n d·∂P, by central differences."""
    lens = {
        "fold": lambda: bends.folded(rt.read_lens("double_gauss"), 10, tilt_x=45.0),
        "spectrometer": bends.spectrometer,
        "mirror": lambda: bends.on_tilted_sensor(bends.tilted_mirror(-200.0, 30.0, 80.0), tilt_x=25.0, tilt_y=10.0),
        "toroid": toroid,
    }[name]()
    generator = torch.Generator().manual_seed(3)
    points, step = torch.rand(2, 20, generator=generator, dtype=torch.float64) - 0.5, 1e-4
    ways = real([[1.0, -1.0, 0.0, 0.0], [0.0, 0.0, 1.0, -1.0]]) * step
    around = (points[:, None] + ways[:, :, None]).flatten(1)
    middle, beside = (rt.trace(lens, rt.tracing.rays(lens, pupil=p, fields=[0.0])) for p in (points, around))
    moved, grown = beside.position.unflatten(-1, (2, 2, -1)), beside.opl.unflatten(-1, (2, 2, -1))
    moved, grown = moved[..., 0, :] - moved[..., 1, :], grown[..., 0, :] - grown[..., 1, :]
    lag = grown - (middle.direction[..., None, :] * moved).sum(0)
    assert float((lag.abs() / torch.linalg.vector_norm(moved, dim=0).amax()).max()) < 1e-6


def test_strehl_and_mtf_of_a_fold_that_is_not_quite_one():
    """A mirror tilted by δ turns all light by 2 δ: the image moves by 2 δ f, and is no worse."""
    f, tilt = 200.0, 0.05
    lens = rt.lens([{"thickness": f, "phase": rt.system.IdealLens(1 / f, 1 / f)}], stop=1, entrance_pupil_diameter=10.0)
    fold = bends.folded(lens, 1, 0.25, tilt_x=45.0)
    mirror = dataclasses.replace(fold.surfaces[2], before=pose(tilt_x=45.0 + tilt), after=pose(tilt_x=45.0 - tilt))
    off = dataclasses.replace(fold, surfaces=(*fold.surfaces[:2], mirror, *fold.surfaces[3:]))
    place = float(rt.spot(off).centroid[1, 0, 0])
    assert abs(place) == pytest.approx(0.75 * f * math.tan(math.radians(2 * tilt)), rel=1e-9)
    assert float(rt.wavefront(off, size=9).strehl) == pytest.approx(1.0, abs=1e-3)

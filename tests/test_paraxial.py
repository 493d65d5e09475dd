"""First order: the limit of real rays, the identities of Gaussian optics, conjugates, mirrors and pupils."""

import dataclasses
import json
import math
import re
from fractions import Fraction
from pathlib import Path

import pytest
import torch
from differences import gradcheck
from problems import aspheric_singlet, double_gauss, fields, lens, scalar, surface, vector

import raytrace as rt
from raytrace.cli import main
from raytrace.io import read_lens, write_lens
from raytrace.materials.glass import MIRROR, constant
from raytrace.system.lens import media, with_object_distance
from raytrace.system.rays import start
from raytrace.tracing.f_number import working_f_number
from raytrace.tracing.paraxial import first_order, paraxial_image_distance, signed, system_matrix
from raytrace.tracing.trace import trace_lens, trace_surfaces

INF = math.inf


def thick_lens(**others):
    return lens([surface(0.02, 5.0, 1.5), surface(-0.01, 95.0)], **others)


def cassegrain(**others):
    """A concave paraboloid and a convex hyperboloid: two mirrors, light again towards +z."""
    primary = surface(-1 / 200, -70.0, MIRROR, conic=-1.0)
    secondary = surface(-0.0267, 150.0, MIRROR, conic=-2.25)
    return lens([surface(None, 100.0), primary, secondary], stop=2, **others)


SYSTEMS = {
    "thick lens": thick_lens(),
    "double Gauss": double_gauss(),
    "asphere with an r² term": aspheric_singlet(),
    "concave mirror": lens([surface(-0.01, -50.0, MIRROR)]),
    "convex mirror": lens([surface(0.01, -30.0, MIRROR)]),
    "two mirrors": cassegrain(),
    "Mangin": lens([surface(-0.01, 5.0, 1.5), surface(-0.012, -5.0, MIRROR), surface(-0.01, -40.0)]),
    "three mirrors": lens([surface(-0.01, -20.0, MIRROR), surface(0.02, 30.0, MIRROR), surface(-0.004, -30.0, MIRROR)]),
    "immersed image": lens([surface(0.05, 60.0, 1.5)]),
}
each = pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS.keys())


@each
@pytest.mark.parametrize("distance", [INF, 1e4, 300.0])
def test_real_rays_near_the_axis_tend_to_the_paraxial_image(system, distance):
    """The crossing with the axis differs from the paraxial one by O(h²); two heights give the limit."""
    system = with_object_distance(system, distance)
    image = first_order(system).paraxial_image_distance
    height = vector(1e-3, 2e-3)
    zero = torch.zeros_like(height)
    direction = torch.stack([zero, height / distance, zero + 1])
    indices = media(system, system.wavelengths[0])
    rays = start(torch.stack([zero, height, zero]), direction)
    out = trace_surfaces(system.surfaces[1:], rays, indices=indices)
    shift = -out.position[1] * out.direction[2] / out.direction[1]
    crossing = system.surfaces[-2].thickness + (4 * shift[0] - shift[1]) / 3
    assert crossing.item() == pytest.approx(image.item(), rel=1e-9, abs=1e-9)


@each
def test_system_matrix_has_determinant_one(system):
    n = signed(system.surfaces[1:-1], media(system, system.wavelengths[0])[:-1])
    A, B, C, D = system_matrix(system.surfaces[1:-1], n)
    assert (A * D - B * C).item() == pytest.approx(1.0, abs=1e-12)


@each
@pytest.mark.parametrize("distance", [1e4, 300.0, 77.0])
def test_newtons_equation_and_the_magnification(system, distance):
    """x x′ = f f′ and m = -x′/f′ = -f/x, distances from the focal points, in signed indices."""
    data = first_order(with_object_distance(system, distance))
    n = signed(system.surfaces[1:-1], media(system, system.wavelengths[0])[:-1])
    f, f_image = -n[0] / data.power, n[-1] / data.power
    x = -distance - data.front_focal_distance
    x_image = data.paraxial_image_distance - data.back_focal_distance
    assert (x * x_image).item() == pytest.approx((f * f_image).item(), rel=1e-9)
    assert data.magnification.item() == pytest.approx((-x_image / f_image).item(), rel=1e-9)
    assert data.magnification.item() == pytest.approx((-f / x).item(), rel=1e-9)


def test_an_object_at_surface_1_is_the_limit_of_one_before_it():
    """A file may say so (DISZ 0): its figures are numbers, and those of an object a picometre away."""
    system = thick_lens()
    touching, near = (first_order(with_object_distance(system, scalar(d))) for d in (0.0, 1e-9))
    for name in ("magnification", "paraxial_image_distance"):
        assert float(getattr(touching, name)) == pytest.approx(float(getattr(near, name)), rel=1e-7), name


@each
def test_object_distance_tends_to_infinity(system):
    far = first_order(with_object_distance(system, 1e12))
    infinite = first_order(with_object_distance(system, INF))
    focal = infinite.effective_focal_length.abs().item()
    assert far.paraxial_image_distance.item() == pytest.approx(infinite.back_focal_distance.item(), abs=focal**2 / 1e11)
    assert infinite.magnification == 0


@each
def test_principal_planes_are_conjugate_at_magnification_one(system):
    data = first_order(system)
    conjugate = first_order(with_object_distance(system, -data.front_principal_plane))
    if data.front_principal_plane != 0:
        assert conjugate.paraxial_image_distance.item() == pytest.approx(data.rear_principal_plane.item(), abs=1e-8)
        assert conjugate.magnification.item() == pytest.approx(1.0, rel=1e-9)


@pytest.mark.parametrize("stop", range(1, 12))
def test_pupils_are_images_of_the_stop(stop):
    """A real ray near the axis from the entrance pupil's centre passes the stop's and the exit pupil's centre."""
    system = double_gauss(stop=stop)
    data = first_order(system)
    slope = 1e-5
    direction = torch.stack([vector(0.0), vector(slope), vector(1.0)])
    start_point = torch.stack([vector(0.0), vector(0.0), data.entrance_pupil_position[None]])
    rays = start(start_point, direction)
    at_stop = trace_surfaces(
        system.surfaces[1 : stop + 1], rays, indices=media(system, system.wavelengths[0])[: stop + 1]
    )
    assert abs(at_stop.position[1].item()) <= 1e-12  # mm; third order: slope³ · 100 mm
    last = trace_lens(system, rays, system.wavelengths[0])
    crossing = -last.position[1] * last.direction[2] / last.direction[1]
    assert crossing.item() == pytest.approx(data.exit_pupil_position.item(), rel=1e-6)
    ratio = data.exit_pupil_diameter / data.entrance_pupil_diameter
    angular = (last.direction[1] / last.direction[2]).item() / slope
    assert ratio.item() == pytest.approx(abs(1 / angular), rel=1e-7)  # Lagrange's invariant between the pupils


def test_thick_lens_by_hand():
    """Rational arithmetic: φ = φ1 + φ2 - φ1 φ2 d/n."""
    phi1, phi2, d, n = Fraction(1, 100), Fraction(1, 200), 5, Fraction(3, 2)
    phi = phi1 + phi2 - phi1 * phi2 * d / n
    data = first_order(thick_lens())
    assert data.effective_focal_length.item() == pytest.approx(float(1 / phi), rel=1e-14)
    assert data.back_focal_distance.item() == pytest.approx(float((1 - phi1 * d / n) / phi), rel=1e-14)
    assert data.front_focal_distance.item() == pytest.approx(float(-(1 - phi2 * d / n) / phi), rel=1e-14)
    assert data.petzval_radius.item() == pytest.approx(float(-1 / (phi1 / n + phi2 / n)), rel=1e-14)


def test_double_gauss_as_published():
    system = read_lens(Path(__file__).parents[1] / "lenses" / "double_gauss.zmx")
    data = first_order(system)
    assert data.effective_focal_length.item() == pytest.approx(99.5145515666, abs=1e-9)
    assert data.back_focal_distance.item() == pytest.approx(57.4851290372, abs=1e-9)
    for distance, image in ((25000.0, 57.8817685209), (10000.0, 58.4786601704)):
        assert paraxial_image_distance(system, scalar(distance)).item() == pytest.approx(image, abs=1e-9)
        moved = first_order(with_object_distance(system, distance))
        assert moved.paraxial_image_distance.item() == pytest.approx(image, abs=1e-9)


@pytest.mark.parametrize(("curvature", "focal"), [(-0.01, 50.0), (0.01, -50.0)])
def test_mirror_signs(curvature, focal):
    """A concave mirror (c < 0 for light towards +z) has a positive focal length and its focus before it."""
    data = first_order(lens([surface(curvature, -50.0, MIRROR)]))
    assert data.effective_focal_length.item() == pytest.approx(focal, rel=1e-14)
    assert data.back_focal_distance.item() == pytest.approx(-focal, rel=1e-14)
    assert data.petzval_radius.abs().item() == pytest.approx(50.0, rel=1e-14)


def test_an_r2_term_bends_like_a_curvature():
    one = first_order(lens([surface(0.02, 5.0, 1.5, coefficients=[0.005, 1e-6]), surface(None, 50.0)]))
    other = first_order(lens([surface(0.03, 5.0, 1.5), surface(None, 50.0)]))
    assert one.effective_focal_length.item() == pytest.approx(other.effective_focal_length.item(), rel=1e-15)


APERTURES = {
    "entrance_pupil_diameter": (12.0, INF),
    "image_f_number": (8.0, INF),
    "paraxial_working_f_number": (8.0, 400.0),
    "object_na": (0.01, 400.0),
    "object_cone_angle": (0.6, 400.0),
    "float_by_stop": (5.0, 400.0),
}


@pytest.mark.parametrize("kind", APERTURES)
def test_every_kind_of_aperture_gives_the_beam_it_means(kind):
    number, distance = APERTURES[kind]
    system = double_gauss(aperture=(kind, number), object_distance=distance)
    data = first_order(system)
    meaning = {
        "entrance_pupil_diameter": data.entrance_pupil_diameter,
        "image_f_number": data.f_number,
        "paraxial_working_f_number": data.paraxial_working_f_number,
        "object_na": data.object_na,
        "object_cone_angle": torch.rad2deg(torch.asin(data.object_na)),
        "float_by_stop": stop_height(system, data),
    }
    assert meaning[kind].item() == pytest.approx(number, rel=1e-13)


def test_the_f_number_of_an_image_in_glass_is_of_the_focal_length_in_air():
    """Of a distant object it is 1/(2 n′ u′). For a concentric relay at F/0.5, object and image in glass, OpticStudio
    stores the semi-diameter of the stop (Dyson 1959, in nzhagen/LensLibrary)."""
    n, number = 1.5058500185530872, 0.5
    distant = first_order(lens([surface(0.05, 60.0, n)], aperture=("image_f_number", number)))
    assert distant.paraxial_working_f_number.item() == pytest.approx(number, rel=1e-12)
    assert distant.entrance_pupil_diameter.item() == pytest.approx(1 / (0.05 * (n - 1) * number), rel=1e-12)
    near, far = -0.027832623508658449, -0.01
    relay = [surface(near, 64.1), surface(far, -64.1, MIRROR), surface(near, -35.91951355497, n)]
    system = lens(relay, aperture=("image_f_number", number), object_distance=35.9, stop=2, wavelengths=(0.253,))
    heights = fields("object_height", (0.0, 2.0, 4.0))
    immersed = dataclasses.replace(system.surfaces[0], glass=constant(n))
    system = dataclasses.replace(system, surfaces=(immersed, *system.surfaces[1:]), fields=heights, ray_aiming="off")
    assert system.with_semi_diameters().surfaces[2].semi_diameter == pytest.approx(31.54521074503, rel=1e-10)
    assert first_order(system).f_number.item() == pytest.approx(number, rel=1e-12)


def test_an_object_at_surface_1_has_the_numerical_aperture_of_its_cone():
    system = lens([surface(None, 100.0), surface(0.02, 5.0, 1.5), surface(-0.02, 60.0)], object_distance=0.0, stop=2,
                  aperture=("object_na", 0.05))  # fmt: skip
    near = first_order(with_object_distance(system, 1e-9))
    data = first_order(system)
    assert data.object_na.item() == pytest.approx(0.05, rel=1e-12)
    assert data.image_na.item() == pytest.approx(near.image_na.item(), rel=1e-9)
    assert data.paraxial_working_f_number.item() == pytest.approx(near.paraxial_working_f_number.item(), rel=1e-9)


def stop_height(system, data):
    """Height at the stop of the paraxial ray through the edge of the entrance pupil, from real rays at 1e-6 of it."""
    n0 = 1e-6 * data.entrance_pupil_diameter / 2
    distance = system.surfaces[0].thickness
    point = torch.stack([vector(0.0), n0[None], data.entrance_pupil_position[None]])
    slope = n0 / (distance + data.entrance_pupil_position)
    rays = start(point, torch.stack([vector(0.0), slope[None], vector(1.0)]))
    indices = media(system, system.wavelengths[0])[: system.stop + 1]
    return 1e6 * trace_surfaces(system.surfaces[1 : system.stop + 1], rays, indices=indices).position[1].abs()


def test_afocal_lens_has_an_infinite_focal_length_and_no_nan_elsewhere():
    afocal = lens([surface(0.01, 0.0, 1.5), surface(None, 0.0, 1.5), surface(0.01, 10.0)])
    data = first_order(afocal)
    assert torch.isinf(data.effective_focal_length)
    assert torch.isfinite(data.entrance_pupil_position)


def test_every_entry_is_differentiable_and_per_wavelength():
    system = double_gauss()
    c = system.surfaces[1].curvature.clone().requires_grad_()

    def numbers(c):
        data = first_order(double_gauss(object_distance=700.0).replace(1, curvature=c))
        return tuple(
            torch.atleast_1d(entry) for name, entry in data.columns().items() if name != "entrance_pupil_diameter"
        )

    assert gradcheck(numbers, c, eps=1e-7, atol=1e-2, rtol=1e-5)
    assert first_order(system, vector(0.5, 0.6, 0.7)).effective_focal_length.shape == (3,)


def test_a_quantity_that_is_infinite_in_practice_is_printed_in_words():
    """As in `info`; a number of another lens, and the table of the file, keep it."""
    data = rt.first_order(rt.read_lens(Path(__file__).parent / "cases" / "telecentric.zmx"))
    assert data.infinite() == {
        "effective_focal_length": "afocal", "entrance_pupil_position": "telecentric", "exit_pupil_position":
        "telecentric", "exit_pupil_diameter": "infinite", "back_focal_distance": "infinite", "front_focal_distance":
        "infinite", "front_principal_plane": "infinite", "rear_principal_plane": "infinite",
    }  # fmt: skip
    assert data.telecentric_spaces == ["object", "image"]
    printed = str(data).splitlines()
    assert re.fullmatch(r"effective focal length +afocal +mm; -2\.146e\+06 mm by first-order data", printed[0])
    assert re.fullmatch(r"exit pupil position +telecentric +mm, from the image; .*", printed[7])
    rows = [re.sub(r"  +", "  ", line) for line in printed]
    quantities = rt.info(rt.read_lens(Path(__file__).parent / "cases" / "telecentric.zmx")).quantities()
    assert {"  ".join(row).rstrip() for row in quantities if row[0] != "working F/#"} <= set(rows)
    assert data.columns()["effective_focal_length"].item() == pytest.approx(-(50**2) / 0.001165, rel=1e-3)
    assert rt.first_order(double_gauss()).infinite() == {}


@each
def test_the_chief_ray_s_slope_and_the_pupils_keep_lagrange_s_invariant(system):
    """n ū r = n′ ū′ r′ at the two pupils of radius r and r′."""
    data = first_order(with_object_distance(system, 300.0))
    n, n_image = (float(media(system, system.wavelengths[0])[k]) for k in (0, -2))
    ratio = n * data.entrance_pupil_diameter / (n_image * data.exit_pupil_diameter)
    assert data.angular_magnification.abs().item() == pytest.approx(ratio.item(), rel=1e-12)


def test_the_invariant_is_the_same_however_the_field_is_given():
    """Angle, object height and image height of one field: |n ū y| = |n u h| = |n′ u′ h′|."""
    system = with_object_distance(thick_lens(), 300.0)
    data = first_order(system)
    angle = 6.0
    height = math.tan(math.radians(angle)) * (300.0 + float(data.entrance_pupil_position))
    sizes = {"angle": angle, "object_height": height, "paraxial_image_height": height * float(data.magnification)}
    found = [
        first_order(dataclasses.replace(system, fields=fields(kind, (y,)))).optical_invariant.item()
        for kind, y in sizes.items()
    ]
    assert found == pytest.approx([found[0]] * 3, rel=1e-12)


def test_a_lens_telecentric_in_object_space_keeps_its_cone():
    """The stop in the rear focal plane, entrance pupil at infinity: NA, F/# and invariant are those of the cone."""
    front = lens([surface(0.02, 5.0, 1.5), surface(-0.02, 49.0)], object_distance=60.0)
    focus = float(first_order(front).back_focal_distance)
    system = lens(
        [surface(0.02, 5.0, 1.5), surface(-0.02, focus), surface(None, 50.0)],
        stop=3,
        object_distance=60.0,
        aperture=("object_na", 0.1),
        field=fields("object_height", (3.0,), telecentric=True),
    )
    data = first_order(system)
    assert data.object_na.item() == pytest.approx(0.1, rel=1e-12)
    assert data.optical_invariant.item() == pytest.approx(3.0 * 0.1 / math.sqrt(0.99), rel=1e-12)
    assert bool(torch.isfinite(data.paraxial_working_f_number))


def test_the_working_f_number_is_of_the_sine_of_the_real_ray():
    """A paraboloid of focal length f: sin θ = h/(f + h²/4f) of the ray at height h; nan for a lens that loses it."""
    f, h = 100.0, 60.0
    mirror = lens([surface(-1 / (2 * f), -f, MIRROR, conic=-1.0)], aperture=("entrance_pupil_diameter", 2 * h))
    sine = h / (f + h * h / (4 * f))  # the focus is f + h²/4f away from where the ray meets the mirror
    assert working_f_number(mirror).item() == pytest.approx(1 / (2 * sine), rel=1e-12)
    assert first_order(mirror).paraxial_working_f_number.item() == pytest.approx(f / (2 * h), rel=1e-12)
    immersed = lens([surface(0.05, 60.0, 1.5)], aperture=("entrance_pupil_diameter", 1e-3))
    assert working_f_number(immersed).item() == pytest.approx(
        first_order(immersed).paraxial_working_f_number.item(), rel=1e-6
    )
    assert bool(working_f_number(lens([surface(0.2, 10.0, 1.5)], aperture=("entrance_pupil_diameter", 12.0))).isnan())


def test_info_prints_undefined_quantities_as_a_dash(capsys, tmp_path):
    afocal = lens([surface(None, 5.0, 1.5), surface(None, 20.0)], field=fields("angle", (3.0,)))
    write_lens(afocal, tmp_path / "plate.csv")
    assert main(["info", str(tmp_path / "plate.csv")]) == 0
    text = capsys.readouterr().out
    assert "nan" not in text
    assert "optical invariant" in text
    assert main(["info", str(tmp_path / "plate.csv"), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["optical_invariant"] == pytest.approx(5.0 * math.tan(math.radians(3.0)))
    assert document["working_f_number"] is None


def test_info_prints_the_working_f_number_of_real_light_and_the_paraxial_one_under_its_name():
    """A parabola of f = 100 mm, F/1: the real ray meets it h²/4f in front of its vertex, the paraxial one in it."""
    h, f = 50.0, 100.0
    mirror = rt.lens(
        [dict(radius=-2 * f, conic=-1, thickness=-f, glass="MIRROR")], stop=1, entrance_pupil_diameter=2 * h
    )
    document, text = rt.info(mirror).document(), str(rt.info(mirror))
    slope = h / (f - h * h / (4 * f))
    real = 1 / (2 * math.sin(math.atan(slope)))
    assert document["working_f_number"] == pytest.approx(real, rel=1e-12)
    assert document["paraxial_working_f_number"] == pytest.approx(1.0, rel=1e-12)
    assert "real_working_f_number" not in document
    lines = {line.split("  ")[1].strip(): line for line in text.splitlines() if "working F/#" in line}
    assert f"{real:.9g}" in lines["working F/#"]
    assert " 1 " in lines["paraxial working F/#"]


def test_first_order_data_are_a_table_with_a_row_for_each_wavelength():
    triplet = read_lens("cooke_triplet")
    found = first_order(triplet, vector(0.5, 0.6))
    frame = found.to_frame()
    assert frame["effective_focal_length"].tolist() == found.effective_focal_length.tolist()
    assert frame["f_number"].tolist() == found.f_number.tolist()
    assert len(first_order(triplet).to_frame()) == 1


# -- conjugates of a magnification -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["double_gauss", "cooke_triplet", "telephoto", "hubble"])
@pytest.mark.parametrize("magnification", [-0.001, -0.1, -1.0, -3.0])
def test_a_lens_has_the_magnification_that_is_specified(name, magnification):
    """Newton's equations: m = -f/x, x the distance of the object from the front focal point, and x' = -f m."""
    before = rt.read_lens(name)
    found, data = before.at(magnification=magnification), first_order(before)
    assert float(first_order(found).magnification) == pytest.approx(magnification, rel=1e-11)
    focal, side = abs(float(data.effective_focal_length)), math.copysign(1.0, float(before.surfaces[-2].thickness))
    distance = -focal / magnification - float(data.front_focal_distance)
    assert float(found.surfaces[0].thickness) == pytest.approx(distance, rel=1e-11)
    image = float(data.back_focal_distance) - side * focal * magnification
    assert float(found.surfaces[-2].thickness) == pytest.approx(image, rel=1e-11)
    kept = before.at(magnification=magnification, sensor_distance=50.0)
    assert float(kept.surfaces[-2].thickness) == 50.0
    assert torch.equal(kept.surfaces[0].thickness, found.surfaces[0].thickness)


def test_conjugates_of_a_magnification_have_derivatives():
    def distances(curvature, magnification):
        lens = thick_lens().replace(1, curvature=curvature).at(magnification=magnification)
        return torch.stack([lens.surfaces[0].thickness, lens.surfaces[-2].thickness])

    gradcheck(distances, (scalar(0.02).requires_grad_(), scalar(-0.4).requires_grad_()))


def test_magnifications_that_no_real_object_has_are_refused(capsys):
    lens = thick_lens()
    with pytest.raises(
        ValueError, match=r"an object at .* mm, whose image, at .* mm, is virtual; .* have negative ones"
    ):
        lens.at(magnification=3.0)
    with pytest.raises(ValueError, match="behind surface 1"):
        lens.at(magnification=0.5)
    with pytest.raises(ValueError, match="a number other than 0"):
        lens.at(magnification=0.0)
    with pytest.raises(ValueError, match="exclude each other"):
        lens.at(magnification=-1, object_distance=100)
    assert main(["info", "singlet", "--magnification", "2", "--json"]) == 1
    assert "is virtual" in capsys.readouterr().err
    assert main(["info", "singlet", "--magnification", "-0.5", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["magnification"] == pytest.approx(-0.5, rel=1e-12)

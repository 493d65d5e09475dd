"""CODE V sequences: conventions by figures of public files, which other people wrote, and what is refused by name."""

import dataclasses
import math
import random
from pathlib import Path

import pytest
import torch
from hypothesis import strategies as st
from problems import NANOMETRE, for_examples, number
from problems_codev import ACHROMAT, ASPHERE, DOUBLE_GAUSS, EVERYTHING, QUESTAR, THREE_MIRRORS, sequence
from problems_files import damaged, leaves, read_damaged, sized

import raytrace as rt
from raytrace.io import FORMATS, LensFileError, LensFileWarning, read_lens, read_lens_with_report, write_lens
from raytrace.io.codev.keywords import FIELD_KINDS, POSE_WORDS, SURFACE_READ, SYSTEM_READ
from raytrace.io.source import Place, UnsupportedSurface, decode
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import constant, index, model_glass
from raytrace.system.apertures import Aperture
from raytrace.system.lens import Lens, SystemAperture
from raytrace.system.phases import RadialPhase
from raytrace.system.poses import Pose, undone
from raytrace.system.rays import Rays
from raytrace.tracing.trace import trace_lens

MICROMETRE = 1e-3


def of(text: str, file: str = "lens.seq", **options):
    return FORMATS[".seq"].read(decode(text.encode(), Place(file)), file, **options)


def again(lens: Lens) -> Lens:
    return of(FORMATS[".seq"].write(lens, "lens.seq").decode())[0]


SINGLET = sequence("S 50 4 NBK7_SCHOTT\nSTO\nS -50 48")


# -- figures that CODE V stored: the distance of the paraxial image, to which PIM had put the image --------------------


SMALL = sequence(
    "S 0.8 0.5 NPSK53A_SCHOTT\nSTO\nS -0.8 0.5 NLASF9_SCHOTT\nS -4.5 0.9176749924408083\nPIM", "EPD 0.4;WL 587.6"
)


def test_an_afocal_image_space_is_read_and_written():
    surfaces = "S 50 5 NBK7_SCHOTT\nSTO\nS -50 40"
    for line, afocal in (("AFI", True), ("AFI Y", True), ("AFI NO", False), ("", False)):
        lens, _ = of(sequence(surfaces, f"EPD 10;WL 587.6;YAN 0;{line}"))
        assert lens.afocal is afocal
        assert again(lens).afocal is afocal
    with pytest.raises(LensFileError, match="AFI MAYBE: expected Y or N"):
        of(sequence(surfaces, "EPD 10;WL 587.6;YAN 0;AFI MAYBE"))


@pytest.mark.parametrize(
    ("text", "stored"),
    [
        (DOUBLE_GAUSS.format("PIM", 0), 61.4875364179821),
        (QUESTAR, 25.4 * 10.21528463036717),
        (ACHROMAT, 95.95194415183156),
        (SMALL, 0.9176749924408083),
        (ASPHERE, 31.09123483490374),
    ],
    ids=["double Gauss", "inches and mirrors", "radii", "lanthanum", "asphere"],
)
def test_the_paraxial_image_is_where_code_v_put_it(text, stored):
    lens, _ = of(text)
    found = rt.first_order(lens)
    image = float(lens.surfaces[-2].thickness)
    assert image == pytest.approx(stored, rel=1e-14)
    assert float(found.back_focal_distance) == pytest.approx(stored, rel=1e-9)  # an object at 1e12 mm: 1e-8 mm


def test_a_stored_distance_that_is_not_the_paraxial_one_is_solved_and_reported():
    wrong = ACHROMAT.replace("95.95194415183156", "0")
    lens, report = of(wrong)
    assert float(lens.surfaces[-2].thickness) == pytest.approx(95.95194415183156, rel=1e-12)
    assert "PIM puts the image at 95.9519442 mm, where 0 mm is stored" in report.warnings[0]
    with pytest.raises(LensFileError, match="PIM"):
        of(wrong, strict=True)


def test_the_thickness_of_the_image_is_the_defocus_that_sharpens_it():
    sharp, paraxial = (of(DOUBLE_GAUSS.format("PIM", defocus))[0] for defocus in (-0.4002686453541377, 0))
    assert float(sharp.surfaces[-2].thickness) == 61.4875364179821 - 0.4002686453541377
    rms = [float(rt.spot(lens, fields=[0]).rms_radius.mean()) for lens in (sharp, paraxial)]
    assert rms[0] < 0.5 * rms[1]


# -- decentres and tilts ----------------------------------------------------------------------------------------------


def bundle(x: float, y: float, field: tuple[float, float], radius: float, count: int) -> Rays:
    """Parallel rays through the plane of surface 1 about a point, in a direction by two angles."""
    side = torch.linspace(-1, 1, count, dtype=torch.float64) if count > 1 else number([0.0])
    X, Y = (part.flatten() for part in torch.meshgrid(side, side, indexing="ij"))
    inside = X * X + Y * Y <= 1
    X, Y = x + radius * X[inside], y + radius * Y[inside]
    direction = number([*(math.tan(math.radians(angle)) for angle in field), 1.0])
    direction = (direction / direction.norm())[:, None].expand(3, len(X))
    return Rays(torch.stack([X, Y, torch.zeros_like(X)]), direction, torch.ones(len(X), dtype=torch.bool))


def at_stop(lens: Lens, rays: Rays) -> torch.Tensor:
    bare = [dataclasses.replace(surface, apertures=()) for surface in lens.surfaces[: lens.stop + 1]]
    until = dataclasses.replace(lens, surfaces=tuple(bare))
    return trace_lens(until, rays, lens.wavelengths[0]).position[:2, 0]


def through_stop(lens: Lens, field: tuple[float, float]) -> list[float]:
    """Where on surface 1 the ray starts that goes through the centre of the stop; by Newton's method."""
    start = number([0.0, 150.0])
    for _ in range(8):
        middle, right, above = (
            at_stop(lens, bundle(*(start + step).tolist(), field, 0.0, 1))
            for step in (number([0.0, 0.0]), number([1e-3, 0.0]), number([0.0, 1e-3]))
        )
        slopes = torch.stack([right - middle, above - middle], 1) / 1e-3
        start = start - torch.linalg.solve(slopes, middle)
    return start.tolist()


def images(text: str) -> tuple[torch.Tensor, torch.Tensor, bool]:
    """Chief rays (2, F) and RMS radii (F,) mm on the image, and whether all the light passes the apertures."""
    lens, _ = of(text)
    centres, radii, passes = [], [], True
    for field in zip(lens.fields.x.tolist(), lens.fields.y.tolist(), strict=True):
        x, y = through_stop(lens, field)
        end = trace_lens(lens, bundle(x, y, field, 50.0, 9), lens.wavelengths[0])
        passes &= bool(end.valid.all())
        hit = end.position[:2]
        centres.append(hit.mean(1))
        radii.append((hit - hit.mean(1, keepdim=True)).square().sum(0).mean().sqrt())
    return torch.stack(centres, 1), torch.stack(radii), passes


def test_an_off_axis_telescope_images_as_its_title_says():
    """F/4.0 at 100 mm: 400 mm tan 2° from the axis to the edge; sharp, centred, within its mirrors' rims."""
    centres, radii, passes = images(THREE_MIRRORS)
    assert passes
    assert float(radii.max()) < 1.5 * MICROMETRE
    assert float(centres[:, 1].abs().max()) < 0.3 * MICROMETRE
    edge = 400 * math.tan(math.radians(2))
    assert (centres[1, 0] - centres[1, 2]) / 2 == pytest.approx(edge, rel=0.02)
    assert centres[0, 3] == pytest.approx(edge, rel=0.02)


@pytest.mark.parametrize(
    ("old", "new"), [("ADE ", "ADE -"), ("YDE ", "YDE -"), ("DAR; ", ""), ("DAR; ", "REV; "), ("ADY ", "ADY -")]
)
def test_the_telescope_images_no_other_way(old, new):
    try:
        _, radii, passes = images(THREE_MIRRORS.replace(old, new).replace("--", ""))
    except (torch.linalg.LinAlgError, RuntimeError):  # no ray comes through
        return
    assert not passes or float(radii.max()) > 0.5


def test_an_off_axis_paraboloid_is_sharp_on_a_plane_turned_by_90_degrees():
    """Edmund Optics 35571: the focus of the parabola lies on the image, 88.9 mm from its centre."""
    lens, report = of(
        sequence(
            "S 0 150\nSTO\nS -177.8 -88.90000000000001 REFL\nCON\nK -1.0\nXDE 0.0; YDE -177.8; ZDE 0.0\nCIR 12.7\n"
            "ADY 177.8\nTHI HMY 0.0\nS 0 -88.90000000000001\nXDE 0.0; YDE 177.8; ZDE 0.0\nS 0 0\n"
            "XDE 0.0; YDE -177.8; ZDE 0.0\nADE 89.99999999999997; BDE 0.0; CDE 0.0",
            "EPD 25.4;WL 587.6;XAN 0;YAN 0",
        )
    )
    end = trace_lens(lens, bundle(0, 0, (0, 0), 12.69, 8), lens.wavelengths[0])
    assert bool(end.valid.all())
    assert float(end.position[0].abs().max()) < NANOMETRE
    assert float((end.position[1] - end.position[1].mean()).abs().max()) < NANOMETRE
    assert float(end.position[1].mean().abs()) == pytest.approx(88.9, abs=NANOMETRE)
    assert bool((end.direction[2] < -0.9).all())  # behind one mirror light runs against z
    assert [keyword.status for keyword in report.keywords if keyword.name == "THI"] == ["ignored"]


def test_a_bend_turns_the_axis_twice_and_keeps_the_ray_on_it():
    """ray-optics, folded_lenses.seq: after three folds of 60°, -60° and -45° the ray along the axis is on it."""
    text = sequence(
        "S 0 5\nSTO\nS 0 -2.25 REFL\nADE 60; BEN\nS -.67 -.3 NBK7_SCHOTT\nS 0 -0.05\nS 0 -.2 NBK7_SCHOTT\n"
        "S -.77095 -2.25\nS 0 2.25 REFL\nADE -60; BEN\nS -.67 0.2 NBK7_SCHOTT\nS 0 0.05\nS 0 .3 NBK7_SCHOTT\n"
        "S -.59225 2.25\nS 0 -5 REFL\nADE -45; BEN",
        "EPD 1;WL 555;YAN 0",
        "RDM N",
    )
    lens, _ = of(text)
    end = trace_lens(lens, bundle(0, 0, (0, 0), 0.0, 1), lens.wavelengths[0])
    assert float(end.position.abs().max()) < 1e-14
    assert end.direction[:, 0].tolist() == pytest.approx([0, 0, -1], abs=1e-15)
    straight, _ = of(text.replace("BEN", "DAR"))
    assert not bool(trace_lens(straight, bundle(0, 0, (0, 0), 0.0, 1), lens.wavelengths[0]).valid.all())


def test_a_reverse_decentre_leads_back():
    """ray-optics, dec_rev_tilt_test.seq: what a surface tilts, REV with the same numbers undoes behind another."""
    text = sequence(
        "S 0 3\nSTO\nS 0 2.82842712\nYDE 2; ADE 45\nS 0 0\nREV; ADE 45\nS 0 3\nYDE -4", "EPD 1;WL 550;YAN 0"
    )
    lens, _ = of(text)
    end = trace_lens(lens, bundle(0, 0, (0, 0), 0.5, 4), lens.wavelengths[0])
    assert torch.allclose(end.position[1].mean(), number(0.0), atol=1e-8)
    assert torch.allclose(end.direction, number([0.0, 0.0, 1.0])[:, None].expand(end.direction.shape), atol=1e-15)


POSES = {
    "basic": (Pose(x=number(1.0), y=number(-2.0), z=number(0.5), tilt_x=number(3.0), tilt_z=number(7.0)), None),
    "return": (one := Pose(y=number(0.1), tilt_x=number(-8.4), tilt_y=number(0.3)), undone(one)),
    "reverse": (None, undone(Pose(x=number(0.7), tilt_y=number(1 / 3)))),
    "break": (Pose(y=number(0.1), tilt_x=number(45.0)), None),
    "break, tilts first": (undone(Pose(y=number(0.1), tilt_x=number(45.0))), None),
}


@pytest.mark.parametrize("kind", POSES)
def test_poses_round_trip_bit_identically(kind):
    before, after = POSES[kind]
    lens = read_lens("double_gauss").replace(6, before=before, after=after, is_break=kind.startswith("break"))
    assert leaves(again(dataclasses.replace(lens, stop=5))) == leaves(dataclasses.replace(lens, stop=5))


def test_tilts_about_x_and_y_are_left_handed_and_that_about_z_is_right_handed():
    """So LightTools' manual says of itself and of CODE V, and OpticStudio's converter turns the same two signs."""
    pose = of(SINGLET.replace("STO", "STO\nXDE 1; YDE 2; ZDE 3; ADE 4; BDE 5; CDE 6"))[0].surfaces[1].before
    assert [float(getattr(pose, name)) for name in POSE_WORDS] == [1, 2, 3, -4, -5, 6]
    assert not pose.tilts_first


def test_a_landscape_lens_in_curvatures_by_paraxial_image_heights():
    """ray-optics, landscape_lens.seq: scaled to a focal length of 10, its image at the paraxial focus."""
    surfaces = "S 0 1.664\nSTO\nS -0.2 0.22 NBK7_SCHOTT !was 500.625\nS -0.387040626 10.150245"
    lens, _ = of(sequence(surfaces, "EPD 1;WL 650 550 450;REF 2;YIM 0 3", "RDM N"))
    found = rt.first_order(lens)
    assert float(found.effective_focal_length) == pytest.approx(10, abs=1e-7)
    assert float(found.back_focal_distance) == pytest.approx(10.150245, abs=1e-6)
    assert lens.fields.kind == "paraxial_image_height"
    assert float(rt.spot(lens).centroid[1, 1, 1]) == pytest.approx(3.0, rel=0.02)  # but for distortion


def test_a_fold_round_trips_and_poses_without_a_command_are_refused():
    lens, tilt = read_lens("hubble"), Pose(y=number(2.0), tilt_x=number(30.0))
    mirror = next(k for k, surface in enumerate(lens.surfaces) if surface.is_mirror)
    bent = lens.replace(mirror, before=tilt, after=Pose(tilt_x=number(30.0)))
    assert leaves(again(bent)) == leaves(bent)
    with pytest.raises(LensFileError, match="no command for"):
        again(lens.replace(mirror, before=tilt, after=tilt))


# -- diffractive surfaces ---------------------------------------------------------------------------------------------

HYBRID = sequence(
    "S 9.93 3.7 'E48'\nSTO\nASP; K -0.71; A -0.1581980090969e-4; B -0.2770951746068999e-6; C -0.1216086045095e-8\n"
    "DIF DOE; HOR 1.0; HWL 587.5618; HCT R; HCO C1 -0.001807322521767816; HCC C1 100\nS -48.3 12.94603127272",
    "EPD 12;WL 656.2725 587.5618 486.1327;REF 2;YAN 0\nPRV\nPWL 800 700 650 600 587.6 546.1 486.1 480 440\n"
    "'E48' 1.5257 1.527 1.5286 1.5306 1.53116 1.5334 1.5378 1.5384 1.5427\nEND",
)  # Edmund Optics 65988, an aspheric hybrid of 12.5 mm for 15 mm


@pytest.mark.parametrize(("sign", "sharp"), [("-", True), ("", False)])
def test_a_hybrid_lens_is_sharp_where_its_file_says(sign, sharp):
    lens, _ = of(HYBRID.replace("C1 -", f"C1 {sign}"))
    end = trace_lens(lens, bundle(0, 0, (0, 0), 6.0, 15), lens.wavelengths[1])
    rms = float(end.position[:2].square().sum(0).mean().sqrt())
    assert rms < 0.6 * MICROMETRE if sharp else rms > 0.4
    assert leaves(again(lens)) == leaves(lens)
    focus = rt.first_order(lens)
    assert (float(focus.effective_focal_length) == pytest.approx(15.0, abs=0.05)) == sharp


@pytest.mark.parametrize("radius", [1.0, 7.3, 1 / 3])
def test_phases_round_trip_bit_identically(radius):
    phase = RadialPhase(number([-17.3, 1 / 7, 0.0, 1e-30]), number(radius), number(-2.0))
    lens = read_lens("cooke_triplet").replace(2, phase=phase)
    assert leaves(again(lens)) == leaves(lens)


# -- apertures, fields, glasses ---------------------------------------------------------------------------------------


def test_vignetting_is_converted_as_code_v_does_for_a_lens_of_opticstudio():
    """A patent's lens read into CODE V 2026: VDY -0.1670, VCY 0.4315 became VUY 0.5985, VLY 0.2645."""
    lens, _ = of(SINGLET.replace("YAN 0", "YAN 0 10;VUY 0 0.5985;VLY 0 0.2645"))
    assert lens.fields.vignetting[:, 1].tolist() == [0.0, -0.167, 0.0, 0.4315, 0.0]
    lens, _ = of(DOUBLE_GAUSS.format("", 0))
    assert lens.fields.vignetting[3].tolist() == [0.0, 0.225, 0.4]
    assert lens.fields.vignetting[1].tolist() == [0.0, 0.025, 0.0]


@pytest.mark.parametrize("factors", [(0.1, 0.3), (1 / 3, 0.7), (-0.167, 0.4315), (1e-9, 0.9), (1e-30, 1.0)])
def test_vignetting_round_trip_bit_identically(factors):
    lens = read_lens("double_gauss")
    given = number([[0.0, a, 0.0] for a in (0.0, factors[0], -factors[0] / 7, factors[1], 0.0)])
    lens = dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, vignetting=given))
    assert leaves(again(lens)) == leaves(lens)


def test_glasses_by_their_figures():
    """Optiland takes 569.631 for 1.569 and 63.1, 517642 for 1.517 and 64.2; files of Edmund Optics have more digits."""
    found = {}
    for word in ("569.631", "517642", "517000.520000", "516800.641700", "1.5168:64.17"):
        glass = of(SINGLET.replace("NBK7_SCHOTT", word))[0].surfaces[1].glass
        found[word] = tuple(glass.coefficients.tolist()[:2])
    assert found["569.631"] == (1.569, 63.1)
    assert found["517642"] == (1.517, 64.2)
    assert found["517000.520000"] == (1.517, 52.0)
    assert found["516800.641700"] == found["1.5168:64.17"] == (1.5168, 64.17)
    with pytest.raises(LensFileError, match=r"the glass is '1\.5'"):
        of(SINGLET.replace("NBK7_SCHOTT", "1.5"))


def test_glasses_by_their_names():
    for word, name, catalog in (
        ("SLAL8_OHARA", "S-LAL8", "OHARA"),
        ("nbk7", "N-BK7", "SCHOTT"),
        ("'F5'", "F5", "SCHOTT"),
    ):
        glass = of(SINGLET.replace("NBK7_SCHOTT", word))[0].surfaces[1].glass
        assert (glass.name, glass.catalog) == (name, catalog)
    with pytest.raises(UnknownGlass, match="NBK8_SCHOTT"):
        of(SINGLET.replace("NBK7_SCHOTT", "NBK8_SCHOTT"))


def test_a_catalog_in_the_folder_of_the_file_is_found_by_its_name(tmp_path):
    written = "CC mine\nNM MY-1 1 0 1.6 50 0 -1\nGC\nED 0 0 0 0 0\nCD 2.56 0 0 0 0 0\nLD 0.3 2.5\n"
    (tmp_path / "Mine.agf").write_text(written)
    path = tmp_path / "lens.seq"
    path.write_text(SINGLET.replace("NBK7_SCHOTT", "MY1_MINE"))
    lens, report = read_lens_with_report(path)
    assert (lens.surfaces[1].glass.name, float(index(lens.surfaces[1].glass, 0.5))) == ("MY-1", 1.6)
    assert any("Mine.agf in the folder of the lens" in note for note in report.notes)
    write_lens(lens, tmp_path / "again.seq")
    assert leaves(read_lens(tmp_path / "again.seq")) == leaves(sized(lens))
    with pytest.raises(UnknownGlass, match="MY1_MINE"):
        of(path.read_text())


def private(rows: str, word: str) -> str:
    return SINGLET.replace("SO 0", f"PRV\n{rows}\nEND\nSO 0").replace("NBK7_SCHOTT", word)


def test_private_glasses():
    """Norland gives n_D = 1.56 for NOA61, whose formula is in files of Edmund Optics, as does the table of E48."""
    formula = "PWL 550\n'NOA61' LAU 2.36390625 0.0 0.025493134 -0.000580235 -0.349933e-5 0.445404e-7"
    glass = of(private(formula, "'NOA61'"))[0].surfaces[1].glass
    assert float(index(glass, 0.5893)) == pytest.approx(1.56, abs=0.005)
    waves, indices = "1000 800 700 650 600 587.6 546.1 486.1 440 404.7", "1.5211 1.5238 1.527 1.5286 1.5306 1.53116"
    table = f"PWL {waves}\n'E48' {indices}&\n 1.5334 1.5378 1.5428 1.5476"
    lens, report = of(private(table, "E48"))
    assert float(index(lens.surfaces[1].glass, 0.5876)) == pytest.approx(1.53116, abs=1e-14)
    assert "its 10 indices" in report.notes[0]
    with pytest.raises(LensFileError, match="formula GMS, which is not modelled"):
        of(private("PWL 500\n'X' GMS 1 2 3", "X"))
    assert "index of X at 587.6 nm is estimated" in of(private("PWL 500 600\n'X' 1.51 1.50", "X"))[1].notes[0]


def test_glasses_of_no_catalog_round_trip():
    lens = of(private("PWL 587.6 500 600\n'X' 1.502 1.51 1.50", "X"))[0]
    for glass in (lens.surfaces[1].glass, constant(1.333), constant(1.333, "WATER"), model_glass(1.6, 40.0)):
        changed = lens.replace(2, glass=glass)
        assert leaves(again(changed)) == leaves(changed)
    for glass, message in (
        (model_glass(1.6, 40.0, 0.01), "ΔPgF"),
        (model_glass(1.5, 60, name="X1"), "leave out the name"),
    ):
        with pytest.raises(LensFileError, match=message):
            again(lens.replace(2, glass=glass))


def test_apertures_clip_and_obscure():
    text = SINGLET.replace("S -50", "CIR 4; ADY 1; CIR OBS L'A' 0.5\nCIR EDG 6\nS -50")
    first = of(text)[0].surfaces[1]
    assert leaves(first.apertures) == leaves(
        (
            Aperture("circular", (0.0, 4.0), False, (0.0, 1.0)),
            Aperture("circular", (0.0, 0.5), True, (0.0, 0.0)),
        )
    )
    assert first.semi_diameter == 6.0
    ring = read_lens("double_gauss").replace(3, apertures=(Aperture("circular", (1.0, 9.0), False, (0.1, 0.0)),))
    assert leaves(again(ring)) == leaves(ring)
    with pytest.raises(LensFileError, match="2 clear apertures"):
        of(SINGLET.replace("S -50", "CIR 4; CIR L'B' 3\nS -50"))
    with pytest.raises(LensFileError, match="without REY"):
        of(SINGLET.replace("S -50", "REX 4\nS -50"))


# -- the language -----------------------------------------------------------------------------------------------------


def test_commands_are_joined_parted_cut_short_and_commented():
    lens, _ = of(
        "RDM;LEN NEW\ntitle 'a; b ! c & d' ! not this\nwl 486.1 &\n 587.6 ; ref 2; epd 1&\n0\n"
        "dim c\nyan 0 &\n  5\nso 0 1e10\ns 5 .4 'nbk7_schott'; stop\ns2 -5 4.8\nk s1 0; CUY S1 0.1\nsi 0 0\n"
    )
    assert lens.name == "a; b ! c & d"
    assert lens.wavelengths.tolist() == [0.4861, 0.5876]
    assert (lens.primary_wavelength, lens.fields.y.tolist(), lens.stop) == (2, [0.0, 5.0], 1)
    assert float(lens.aperture.value) == 100.0
    assert float(lens.surfaces[1].curvature) == 0.1 / 10
    assert float(lens.surfaces[2].curvature) == 1 / -50


def test_of_zoom_positions_the_first_is_read_and_reported():
    text = SINGLET.replace("GO", "ZOO 3\nZOO THI S2 47 30 20\nZOO THC S2 100 100 100\nTIT Z2 'two'\nTHI Z1 S1 5\nGO")
    lens, report = of(text)
    assert [float(surface.thickness) for surface in lens.surfaces[1:3]] == [5.0, 47.0]
    assert "3 zoom positions (ZOO): the first is read" in report.warnings[0]


def test_a_lens_module_is_reported():
    lens, report = of(SINGLET.replace("STO", "STO\nCCY 0; THC 0\nXYZ 4\nXDE 0.0"))
    status = {keyword.name: keyword.status for keyword in report.keywords}
    assert (status["CCY"], status["XYZ"], status["RDM"]) == ("ignored", "unknown", "read")
    assert "unknown keyword XYZ" in report.warnings[0]
    assert lens.surfaces[1].before is None


REFUSED = {
    "HOE": "HOE (diffractive surface)",
    "YTO\nRDX 5": "YTO (toroid or cylinder)",
    "CYL": "CYL (toroid or cylinder)",
    "SPS XYP": "SPS (special surface)",
    "GRT\nGRS 0.001": "GRT (diffractive surface)",
    "RET S1": "RET (return to an earlier surface)",
    "GLB S1": "GLB (global coordinates)",
    "NSS": "NSS (non-sequential surfaces)",
    "XOD 1": "XOD (centre of a tilt off the vertex)",
    "IN other.seq": "IN (another file)",
    "AUT": "AUT (optimisation)",
    "NA 0.25": "NA (numerical aperture in image space)",
    "LCL NUM X": "LCL (macro)",
}


@pytest.mark.parametrize("command", REFUSED)
def test_unmodelled_features_are_refused_by_name_line_and_surface(command):
    with pytest.raises(UnsupportedSurface) as caught:
        of(SINGLET.replace("STO", f"STO\n{command}"))
    assert f"{REFUSED[command]} is not modelled" in str(caught.value)
    assert (caught.value.line, caught.value.surface) == (7, 1)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("RDM;", "", "radius (RDM) or a curvature (RDM N)"),
        ("SI 0 0", "", "no SI, the image"),
        ("WL 587.6", "WL 587.6 486.1", "no REF"),
        ("WL 587.6", "WL 587.6;REF 2", "REF is 2, expected 1 to 1"),
        ("YAN 0", "YAN 0;YOB 1", "several kinds"),
        ("YAN 0", "YAN 0;VUX 0.1", "without its other side"),
        ("EPD 10", "FNO 5", "FNO of an object at a finite distance"),
        ("EPD 10", "", "no system aperture"),
        ("EPD 10", "EPD 10;NAO 0.1", "several system apertures (EPD in line 3 and NAO in line 3)"),
        ("STO", "STO\nA 1e-5", "put ASP before it"),
        ("STO", "STO\nK -1", "put CON or ASP before it"),
        ("STO", "STO\nCON; CUF 0.5", "CUF 0.5"),
        ("STO", "STO\nTHI S1 (2*3)x'", "does not end"),
        ("S -50 48", "S -50 ^f", "variables of macros"),
        ("S -50 48", "S9 -50 48", "S9 where S2 should follow"),
        ("S -50 48", "S -50 48 REFL\nADE 3; BDE 4; BEN", "tilts about several axes"),
        ("S -50 48", "S -50 48 REFL\nRMD TIR", "RMD TIR"),
        ("STO", "STO\nDIF GRT", "DIF GRT (diffractive surface)"),
        ("STO", "STO\nDIF DOE; HWL 500; HCT XY", "HCT XY is not modelled"),
        ("STO", "STO\nDIF DOE; HCT R", "without the wavelength"),
        ("STO", "STO\nDIF DOE; HWL 500; HCT R; HCO X1 1", "HCO X1"),
        ("S -50 48", "S -50 48 &", "S with 5 words"),
        ("GO", "LEN", "several lenses"),
        ("GO", "S 0 0", "after SI"),
    ],
)
def test_ambiguous_or_wrong_commands_are_refused_with_the_reason(old, new, message):
    text = SINGLET.replace("1e14", "500") if "finite" in message else SINGLET
    with pytest.raises(LensFileError) as caught:
        of(text.replace(old, new, 1))
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_with_every_supported_command_round_trips():
    lens, report = of(EVERYTHING)
    met = {keyword.name for keyword in report.keywords if keyword.status == "read"}
    wanted = (
        SYSTEM_READ
        | SURFACE_READ
        | {f"!raytrace {word}" for word in ("aiming", "catalogs", "note", "radius", "unnamed")}
    )
    elsewhere = {"EPD", "FNO", "SO", "SI", *(word for pair in FIELD_KINDS.values() for word in pair)}
    assert wanted - elsewhere <= met
    assert leaves(again(lens)) == leaves(lens)


# -- writing ----------------------------------------------------------------------------------------------------------


def test_a_written_lens_is_one_that_code_v_reads():
    """Lines of at most 80 characters, a word of four letters at most for a command, wavelengths in nm."""
    lens = dataclasses.replace(read_lens("cooke_triplet"), notes=("a note",))
    text = FORMATS[".seq"].write(lens, "lens.seq").decode()
    assert max(map(len, text.splitlines())) <= 80
    assert text.startswith("RDM N;LEN\n!raytrace note a note\n")
    assert "SO 0.0 0.1e14\n" in text
    assert f"WL {' '.join(f'{1e3 * w:.10g}' for w in lens.wavelengths.tolist())}" in text
    assert text.endswith("GO\n")


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"coefficients": number([1e-3, 1e-9])}, "a term of r²"),
        ({"coefficients": number([0.0] + [1e-9] * 10)}, r"terms to r\^22"),
        ({"coefficients": number([0.0, 1e-9]), "kind": "odd asphere"}, "no type for an odd asphere"),
        ({"apertures": (Aperture("circular", (1.0, 2.0), True),)}, "a ring that obscures"),
        ({"apertures": (Aperture("polygon", (0.0, 1.0, 1.0, 0.0, 2.0, 2.0)),)}, "a polygon"),
        ({"apertures": (Aperture("circular", (0.0, 2.0)),) * 2}, "several clear apertures"),
        ({"comment": "both ' and \""}, "both kinds of quotes"),
        ({"glass": constant(1.5, "two words")}, "one word"),
    ],
)
def test_data_that_a_sequence_cannot_hold_are_refused(changes, message, tmp_path):
    with pytest.raises(LensFileError, match=message) as caught:
        write_lens(read_lens("double_gauss").replace(3, **changes), tmp_path / "lens.seq")
    assert caught.value.surface == 3
    assert list(tmp_path.iterdir()) == []


def test_apertures_of_a_lens_that_a_sequence_cannot_hold_are_refused():
    lens = read_lens("double_gauss")
    for aperture in (
        SystemAperture("float_by_stop", number(9.0)),
        SystemAperture("paraxial_working_f_number", number(3.0)),
    ):
        with pytest.raises(LensFileError, match="set `entrance_pupil_diameter`"):
            again(dataclasses.replace(lens, aperture=aperture))
    with pytest.raises(LensFileError, match="a temperature or pressure"):
        again(lens.at(temperature=40))
    far = lens.at(object_distance=2e10)
    with pytest.raises(LensFileError, match="which CODE V takes for infinity"):
        again(far)


def test_a_lens_at_the_temperature_of_its_catalogs_is_written():
    """20 °C and 1 atm, of the lens and of surfaces, lose nothing where the catalogs are of 20 °C, too."""
    lens = read_lens("double_gauss")
    warm = lens.at(temperature=20, pressure=1)
    local = warm.replace(2, environment=warm.environment)
    assert leaves(again(warm)) == leaves(again(lens))
    assert leaves(again(local)) == leaves(again(lens))
    lengths = [float(rt.first_order(each).effective_focal_length) for each in (again(warm), warm)]
    assert lengths[0] == pytest.approx(lengths[1], rel=1e-14)
    for other in (lens.at(pressure=0), local.replace(2, environment=warm.at(temperature=25).environment)):
        with pytest.raises(LensFileError, match="a temperature or pressure other than 20 °C and 1 atm"):
            again(other)


def test_a_glass_of_a_catalog_of_another_temperature_is_refused_with_its_surface():
    lens = rt.lens([dict(radius=50, thickness=4, glass="S-LAH60MQ"), dict(radius=-50, thickness=48)], stop=1,
        entrance_pupil_diameter=10)  # fmt: skip
    again(lens)
    with pytest.raises(LensFileError, match="S-LAH60MQ at 20 °C, whose catalog is of 25 °C") as caught:
        again(lens.at(temperature=20))
    assert caught.value.surface == 1


def test_a_file_cut_off_anywhere_is_no_shorter_lens():
    text = FORMATS[".seq"].write(read_lens("cooke_triplet"), "lens.seq").decode()
    lens = of(text)[0]
    for end in range(0, len(text), 7):
        try:
            cut = of(text[:end] or "!")[0]
        except (LensFileError, UnknownGlass):
            continue
        assert len(cut.surfaces) == len(lens.surfaces)


@pytest.mark.parametrize("examples", [20, *(pytest.param(n, marks=pytest.mark.slow) for n in (60, 400))])
def test_damaged_files_give_a_lens_that_round_trips_or_a_clear_error(examples):
    def read_one(seed, which):
        text = (ASPHERE, DOUBLE_GAUSS.format("PIM", -0.4), EVERYTHING, QUESTAR, THREE_MIRRORS)[which]
        read_damaged(Path("lens.seq"), damaged(text.encode(), random.Random(seed)))

    for_examples(examples, read_one, seed=st.integers(0, 2**63), which=st.integers(0, 4))


def test_convert_and_check_know_the_suffix(tmp_path: Path):
    found = rt.convert("double_gauss", tmp_path / "lens.seq")
    assert found.document()["surfaces"] == 13
    rt.convert(tmp_path / "lens.seq", tmp_path / "back.zmx")
    assert leaves(read_lens(tmp_path / "back.zmx")) == leaves(sized(read_lens("double_gauss")))
    report = read_lens_with_report(tmp_path / "lens.seq", strict=True)[1]
    assert (report.format, report.stop_surface) == ("seq", 6)
    (tmp_path / "no.seq").write_text(SINGLET.replace("STO\n", ""))
    with pytest.warns(LensFileWarning, match="no STO"):
        read_lens(tmp_path / "no.seq")

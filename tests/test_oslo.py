"""The .len reader: every convention against a figure that others wrote, OSLO itself where it is said so.

Sources of the figures: the lens files cox2_01 and cox3_07 (lens-designs.com, MIT licence), Elphel's open lens and the
doublet of Sinclair Optics' user guide, which OSLO wrote with their focal length in the line LEN NEW; what OSLO EDU 6.6
printed of a conic singlet, a mirror, a triplet, a double Gauss and a phone lens (fixtures F3, F4, F6 and results of
AberrationCalculator and WavefrontErrorCalculator, jaruiz6363); the Cassegrain of Optiland's tests.
"""

import dataclasses
import math
import warnings

import pytest
import torch
from problems import rotation
from problems_oslo import CONIC, FAR, SINGLET, double_gauss, text

import raytrace as rt
from raytrace.analysis.seidel import seidel
from raytrace.cli import main
from raytrace.io import FORMATS, LensFileError, UnsupportedSurface, convert, read_lens
from raytrace.materials.catalogs import UnknownGlass, find_glass
from raytrace.materials.glass import refractive_index
from raytrace.system.lens import check
from raytrace.tracing.geometry import frames
from raytrace.tracing.scene import scene
from raytrace.tracing.wavefront import wavefront_of


def read(*arguments, strict=False, **options):
    return FORMATS[".len"].read(text(*arguments, **options), "lens.len", strict=strict)


def lens(*arguments, **options):
    return read(*arguments, **options)[0]


def focal_length(found) -> float:
    return float(rt.first_order(found).effective_focal_length)


# -- figures of OSLO --------------------------------------------------------------------------------------------------


def test_focal_length_of_the_doublet_of_the_user_guide():
    """Its last curvature and thickness are solved for, and one glass is picked up; OSLO states 60."""
    found, report = read(
        (FAR, "GLA LASF35; RD 100; TH 5", "AIR; TH 1", "PK GLA -2; RD 50; TH 5", "AIR; PU -0.25; PY 0"),
        "EBR 15",
        "ANG 0.0000572957795",
        "UNI 1.0",
        waves="WV 0.6328; WW 1.0",
        stated="60 5",
    )
    first = rt.first_order(found)
    assert float(first.effective_focal_length) == pytest.approx(60, rel=1e-12)
    assert float(first.back_focal_distance) == pytest.approx(float(found.surfaces[4].thickness), rel=1e-12)
    assert found.surfaces[3].glass.name == "LASF35"
    assert found.wavelengths.tolist() == [0.6328]
    assert [note for note in report.notes if "solved again" in note] == [
        "surface 4: PU -0.25 solved again, curvature 0.0144483003 in mm",
        "surface 4: PY 0 solved again, thickness 53.4533679 in mm",
    ]


COX = "WV 0.58756 0.48613 0.65627; WW 1.0 1.0 1.0"


def test_focal_length_of_an_eyepiece_by_indices():
    """cox2_01, 1.0017: indices at wavelengths; no AST; an object at 1e10; its angle by its height."""
    local = "WV 0.58756; WV2 0.48613"
    found = lens(
        (
            "AIR; TH 9.9999999996e+09; AP 4.0e+09",
            "AIR; TH 0.4",
            f"{local}; GLA 1.573000 1.573 1.573; TH 0.23; AP 0.647",
            "AIR; RD -0.885034073812; TH 0.1",
            f"{local}; GLA 1.510000 1.51 1.51; RD 1.041992289257; TH 0.3",
            f"{local}; GLA 1.648000 1.648 1.648; RD -0.798020908148; TH 0.09",
            "AIR; RD 2.824060999718; TH 0.1",
            f"{local}; GLA 1.516000 1.516 1.516; RD 1.769911504425; TH 0.3",
            "AIR; PY 0.0; AP 0.46",
        ),
        "EBR 0.150000000006",
        "OBH -4.0e+09",
        waves=COX,
        stated="1.0017 9",
    )
    assert round(focal_length(found), 4) == 1.0017
    assert found.stop == 1
    assert found.fields.y.tolist() == pytest.approx([0, math.degrees(math.atan(0.28)), math.degrees(math.atan(0.4))])
    assert found.wavelengths.tolist() == [0.58756, 0.48613, 0.65627]


def test_focal_length_of_a_double_gauss_with_a_glass_by_three_indices():
    """cox3_07, 1.0011."""
    found = lens(
        (
            "AIR; TH 1.0e+10; AP 3.6397023429e+09",
            "WV 0.58756; WV2 0.48613; WV3 0.65627; GLA MOD G1 1.564 1.571047 1.56094; RD 1.0; TH 0.165; AP 0.33",
            "GLA SF5; RD -0.580686371291; TH 0.035",
            "AIR; RD -2.314814814815; TH 0.002",
            "GLA F7; RD 0.330600370272; TH 0.172",
            "AIR; RD 0.224502166446; TH 0.132",
            "AIR; TH 0.13; AST",
            "GLA F8; RD -0.311100049776; TH 0.052",
            "GLA SK16; RD 1.721170395869; TH 0.124",
            "AIR; RD -0.387596899225; TH 0.002",
            "GLA SK16; RD 2.62467191601; TH 0.083",
            "AIR; RD -0.865126741068; PY 0.0",
        ),
        "EBR 0.329999999979",
        "OBH -3.6397023429e+09",
        waves=COX,
        stated="1.0011 12",
    )
    assert round(focal_length(found), 4) == 1.0011
    assert float(found.fields.y[-1]) == pytest.approx(20, abs=1e-8)  # tan 20° is 0.36397023427
    at = torch.tensor([0.58756, 0.48613, 0.65627], dtype=torch.float64)
    assert refractive_index(found.surfaces[1].glass, at).tolist() == pytest.approx([1.564, 1.571047, 1.56094])


def test_focal_length_of_the_lens_of_elphel():
    """4.5003, by OSLO 6.6: 22 surfaces, eleven glasses, a beam by its F-number; AP CHK clips."""
    numbers = [  # glass, radius, thickness, AP CHK
        ("", 0, 10.0, 0), ("LASF14A", 44.1995256671779, 2.0, 9.5), ("", 246.68766848992, 0.5000001103036, 9.5),
        ("SK16", 28.7407314472329, 0.9798916508493, 6.6), ("", 4.6429368607625, 2.043637125802, 4.2),
        ("BAF51", 10.1726461943981, 2.500074734125, 4.6), ("", 4.6194936713085, 2.0, 3.2),
        ("SF57", 14.5286371088468, 2.53446840913, 4.5), ("", -20.3628934582945, 0.4325974576629, 4.5),
        ("", 0, 1.303905326818, 0), ("SF58", -30.5356011642403, 1.5, 3.7),
        ("N-SK15", 8.9309914413009, 1.955799332857, 3.7), ("", -7.4851654524717, 0.5101658615876, 3.7),
        ("N-FK51A", 24.789133523564, 1.5, 4.5),
        ("", -12.6157169320602, 0.7118119056204, 4.5), ("N-FK51", 11.3993328018745, 2.052132855473, 4.5),
        ("", -31.829134195541, 5.7, 4.5), ("N-BK7", -8.0, 0.5, 4.0), ("", 0, 0, 4.5),
        ("N-BK7", 0, 0.4, 4.0), ("", 0, 0, 4.0),
    ]  # fmt: skip
    surfaces = [
        f"{f'GLA {glass}' if glass else 'AIR'}; RD {radius}; TH {thickness}; AP CHK {size}"
        + ("; AST; DRW ON" if k == 10 else "")
        for k, (glass, radius, thickness, size) in enumerate(numbers, 1)
    ]
    tail = "DLRS 3; VAR NEW; V 1 2 0 CV 0.0 0.0 1.0 0.0000799939095; END"
    found, report = read(
        ("AIR; TH 1.0e+20; AP 7.8128562651e+19", *surfaces),
        'FNO 1.8; ANG 38.0; DES "OSLO"; UNI 1.0',
        waves="DRW ON; CBK 1; WV 0.58756 0.48613 0.65627; WW 1.0 0.35 0.7",
        stated="4.5003 22",
        tail=tail,
    )
    first = rt.first_order(found)
    assert round(float(first.effective_focal_length), 4) == 4.5003
    assert float(first.f_number) == pytest.approx(1.8)
    assert (found.stop, len(found.surfaces)) == (10, 23)
    assert found.wavelength_weights.tolist() == [1.0, 0.35, 0.7]
    assert found.surfaces[2].apertures[0].extent == (0.0, 9.5)
    assert found.surfaces[10].apertures == ()
    assert not any("LEN NEW states" in note for note in report.notes)
    assert {one.name: one.status for one in report.keywords}["V"] == "ignored"


SEIDEL = {
    "a conic singlet with r⁴": (
        ("AST; AP CHK 10; TH 0", *CONIC),
        "EBR 10; ANG 5",
        [
            (0.1234650216023, -0.030672627895, -0.0134175361068, -0.0203517202392, -0.0147721355299),
            (-0.0965771178951, 0.0465414927294, -0.0224288174331, -0.0050879300598, 0.0132605997289),
        ],
    ),
    "a parabolic mirror": (
        ("AST; TH 0", "RD -200; RFH; CC -1; TH -100"),
        "EBR 20; ANG 0.5",
        [(0.0, 0.0087268677908, -0.0007615822144, 0.0007615822144, 0.0)],
    ),
    "a triplet with two aspheres": (
        (
            *("RD 60; GLA N-BK7; CC -0.4; AD 3e-7; TH 8", "RD -180; TH 5", "AST; TH 0", "RD -90; GLA N-SF2; TH 3"),
            *("RD 70; TH 6", "RD 55; GLA N-BK7; TH 8", "RD -65; AD -2.2e-7; AE 5e-11; TH 80"),
        ),
        "EBR 10; ANG 14",
        [
            (-0.0541581526644, -0.0483351504922, -0.063530658942, -0.1444817095517, -0.2508745345811),
            (-0.082496459173, 0.1413591277959, -0.2422213415161, -0.0481605698506, 0.4975744914386),
            (0.1596817788319, -0.2079045686477, 0.2706903065633, 0.1111268571209, -0.4971232992188),
            (0.0479964274295, 0.0867134025574, 0.1566619556034, 0.1428773877268, 0.5411668545149),
            (-0.0820736348683, -0.1332512406745, -0.2163410109689, -0.15761641042, -0.6071412633238),
            (-0.261023475528, 0.1557628317881, -0.117679582384, -0.1333677318939, 0.1694561069576),
        ],
    ),
}


@pytest.mark.parametrize("name", SEIDEL)
def test_third_order_aberrations_are_those_that_oslo_prints(name):
    """EBR, ANG, RD, CC, AD, GLA, RFH, AST and the signs behind a mirror, to the last digit that OSLO prints."""
    surfaces, system, printed = SEIDEL[name]
    found = lens((FAR, *surfaces), system)
    sums = seidel(found, kind="transverse")
    columns = dict(zip(sums.names, sums.contributions[:, 0], strict=True))
    ours = torch.stack([columns["TSPH"], columns["TSCO"], 0.5 * columns["TAST"], columns["TPFC"], columns["TDIS"]], 1)
    powered = [k for k, surface in enumerate(found.surfaces[1:-1]) if surface.curvature is not None]
    theirs = torch.tensor(printed, dtype=torch.float64)
    assert (ours[powered] - theirs).abs().max() < 2e-13


def opd(found, wavelength: float, points) -> list[float]:
    """Waves on axis, at heights of the pupil on y, with the sign of OSLO, which counts a path too long as positive."""
    y = torch.tensor(points, dtype=torch.float64)
    wavelengths, axis = torch.tensor([wavelength], dtype=torch.float64), torch.zeros(2, 1, dtype=torch.float64)
    view = scene(found, axis, found.surfaces[0].thickness.reshape(1), wavelengths)
    return (-1e3 / wavelength * wavefront_of(view, torch.stack([0 * y, y])).opd).flatten().tolist()


@pytest.mark.filterwarnings("ignore")
def test_path_differences_in_waves_are_those_that_oslo_traces():
    """UNI 1 is a millimetre: paths are in waves."""
    found, _ = FORMATS[".len"].read(double_gauss("WV 0.58756; WW 1"), "lens.len")
    theirs = [-0.0166099413374108, -0.0719477735201281, -0.189106686954516]
    assert opd(found, 0.58756, [0.5, 0.75, 1.0]) == pytest.approx(theirs, abs=1e-7)


@pytest.mark.filterwarnings("ignore")
def test_the_first_wavelength_is_the_primary_one():
    """OSLO's chief ray of 14°, mm: of the F line where that is the first wavelength."""
    for waves, height in (("0.48613 0.58756 0.65627", 24.945679), ("0.58756 0.48613 0.65627", 24.9495)):
        found = FORMATS[".len"].read(double_gauss(f"WV {waves}; WW 1 1 1"), "lens.len")[0].at(ray_aiming="real")
        rays = rt.tracing.rays(found, fields=[14], pupil=torch.zeros(2, 1, dtype=torch.float64))
        end = rt.trace(found, rays)
        digits = len(str(height).partition(".")[2])
        assert round(float(end.position[1].flatten()[found.primary_wavelength - 1]), digits) == pytest.approx(
            height, abs=0.6 * 10**-digits
        )


def test_terms_up_to_the_tenth_power_are_those_that_oslo_traces():
    """US 8264785, example 4: two strong aspheres, with the indices that OSLO had; an object at 11.26 m."""
    beam = math.sin(math.atan(3 / (11260 + 1.9730244453955057)))  # of a pupil of 6 mm
    found = lens(
        (
            *("TH 11260", "RD 6.3; GLA 1.77250307047595; TH 1.9", "RD 63.75; TH 0.52", "AST; TH 1.12"),
            *("RD -8.672; GLA 1.84666685653666; TH 0.6", "RD 6.05; TH 0.54", "RD 13.65; GLA 1.88300423497903; TH 2.85"),
            "RD -5.77; TH 0.56",
            "RD -14.114; CC 12.1439; AD -0.00306922; AE 8.30265E-05; AF -3.27459E-06; AG 7.22622E-07;"
            "GLA 1.5831319530305; TH 1.5",
            "RD -57.581; CC 33.0793; AD -0.00296779; AE 5.76757E-05; AF -8.34737E-07; AG 1.35585E-07; TH 6.88",
        ),
        f"NAO {beam!r}; OBH 3550",
        waves="WV 0.5875618",
    )
    theirs = [0.000704021105098126, -0.0523370172591485, -0.0551047325948045]
    assert opd(found, 0.5875618, [0.5, 0.75, 1.0]) == pytest.approx(theirs, abs=2e-6)
    assert found.fields.kind == "object_height"
    assert found.fields.y.tolist() == [0.0, 2485.0, 3550.0]


def test_the_mirrors_of_a_cassegrain():
    """Optiland's, 1555.556: RFL; thicknesses and radii as they stand behind mirrors."""
    found = lens(
        ("AIR; RD 0; TH 1e+10", "RFL; RD -4000; TH -1800; CC -1", "RFL; RD 1400; TH 2200; CC -2.5"), "EBR 200; ANG 0.1"
    )
    assert focal_length(found) == pytest.approx(1555.556, abs=5e-4)


@pytest.mark.filterwarnings("ignore")
def test_the_beam_of_a_far_object_by_its_f_number():
    """Of Optiland: a Petzval lens at the d line, 50.58453 and FNO 1.4, and the radius of its beam, 18.0659."""
    found = lens(
        (
            *("TH 1e10", "GLA N-LAK12; RD 33.6931; TH 10.16", "RD -68.37426; TH 1.524"),
            *("GLA SF4; RD -50.87112; TH 4.064", "RD 138.4275; TH 2.54", "TH 22.85746; AP 18.0659; AST"),
            *("GLA N-LAK12; RD 29.77896; TH 7.62", "RD -62.48908; TH 5.64134", "GLA LF5; RD -21.8821; TH 2.032"),
            "RD 76.29906; TH 9.95934",
        ),
        "FNO 1.4; ANG 7",
        waves="WV 0.5875618",
    )
    first = rt.first_order(found)
    assert float(first.effective_focal_length) == pytest.approx(50.58453, abs=5e-5)
    assert 0.5 * float(first.entrance_pupil_diameter) == pytest.approx(18.0659, abs=5e-5)


def test_the_beam_of_a_near_object_by_its_sine():
    """0.04993761694389224 is what a public exporter writes for 10 mm at 200 mm."""
    found = lens(("TH 200", "AST; TH 20", "RD 50; GLA N-BK7; TH 4", "RD -50; TH 50"), "NAO 0.04993761694389224; OBH 10")
    assert float(rt.first_order(found).entrance_pupil_diameter) == pytest.approx(20, rel=1e-12)


def test_numbers_of_surfaces_before():
    """Optiland's tests: radius -1/0.09 with conic -1 and terms of the other sign, thicknesses 3 and 5, index 1.5."""
    first = "GLA 1.5; RD 10; CC -1; AD .001; TH 2"
    found = lens((FAR, first, "PK CVM -1 .01; PK TH -1 1; PK GLA -1", "AIR; PK CV -1 0; TH 5"), "EBR 1")
    one, two, three = found.surfaces[1:4]
    assert [1 / float(surface.curvature) for surface in (two, three)] == pytest.approx([-1 / 0.09, -1 / 0.09])
    assert float(two.conic) == -1
    assert torch.equal(two.coefficients, -one.coefficients)
    assert (float(two.thickness), refractive_index(two.glass, found.wavelengths).tolist()) == (3.0, [1.5])
    folded = lens((FAR, "RD 10; TH 2", "PK THM -1; UNI 10", "PK THM -1 1"), "EBR 1")
    assert [float(surface.thickness) for surface in folded.surfaces[1:4]] == [20.0, -20.0, 30.0]


# -- tilts ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", ["", "DT 1;", "DT -1;"])
def test_the_order_and_the_signs_of_tilts(order):
    """Those that Lambda Research tells for another program, +TLC, -TLB, -TLA by the right hand; Optiland's matrices."""
    tilts = f"{order} DCX 1; DCY 2; DCZ 3; TLA 10; TLB 20; TLC 30"
    found = lens((FAR, f"GLA 1.5; RD 20; TH 2; {tilts}", "RD -20; TH 20"), "EBR 2")
    x, y, z = rotation("x", -10), rotation("y", -20), rotation("z", 30)
    expected = z @ y @ x if "-" in order else x @ y @ z
    shift = torch.tensor([1.0, 2, 3], dtype=torch.float64)
    here, behind = frames(found)[1:3]
    assert (here.axes - expected).abs().max() < 1e-15
    assert (here.origin - (expected @ shift if "-" in order else shift)).abs().max() < 1e-14
    assert (behind.axes - expected).abs().max() < 1e-15  # the following surfaces are in the axes of the surface
    assert (behind.origin - here.origin - 2 * expected[:, 2]).abs().max() < 1e-14


def test_a_return_leads_back():
    """Optiland's tests: behind RCO the next vertex is at 0, 0, 2."""
    for tilts in ("DCY 4; TLA 30", "DT -1; DCX 1; DCY 2; DCZ 3; TLA 10; TLB 20; TLC 30"):
        found = lens((FAR, f"GLA 1.5; RD 20; TH 2; {tilts}; RCO", "RD -20; TH 20"), "EBR 2")
        behind = frames(found)[2]
        assert behind.origin.tolist() == pytest.approx([0, 0, 2], abs=1e-14)
        assert (behind.axes - torch.eye(3)).abs().max() < 1e-15


def test_a_mirror_that_bends_the_axis():
    """Optiland's tests: behind a mirror of TLA 45 with BEN, TH -10 leads to 0, -10, 0, and the ray with it."""
    found = lens((FAR, "RFH; TLA 45; BEN; TH -10"), "EBR 1")
    assert frames(found)[2].origin.tolist() == pytest.approx([0, -10, 0], abs=1e-14)
    end = rt.trace(found, rt.tracing.rays(found, fields=[0], pupil=torch.zeros(2, 1, dtype=torch.float64)))
    assert end.position.flatten().tolist() == pytest.approx([0, 0, 0], abs=1e-14)
    assert end.direction.flatten().abs().tolist() == pytest.approx([0, 0, 1], abs=1e-14)


def test_a_tilted_lens_is_written_as_a_lens_file_of_opticstudio(tmp_path):
    path = tmp_path / "fold.len"
    surfaces = (
        "GLA N-BK7; RD 50; TH 4; DCY 1; TLA 3; TLC 5",
        "TH 30; AST",
        "RFL; TLA 45; BEN; TH -10; DT 1",
        "TH -5; TLB 2",
    )
    path.write_text(text((FAR, *surfaces), "EBR 1; ANG 1"))
    convert(path, tmp_path / "fold.zmx")
    ours, theirs = (frames(read_lens(one)) for one in (path, tmp_path / "fold.zmx"))
    for one, other in zip(ours[1:], theirs[1:], strict=True):
        assert (one.origin - other.origin).abs().max() < 1e-12
        assert (one.axes - other.axes).abs().max() < 1e-14


def test_the_pentaprism_of_the_user_guide():
    """Sinclair Optics' list of it: faces of 2, mirrors at TLA 22.5 with BEN, 2.414214, -2 and 2.414214 between them.

    A pentaprism turns light by 90° whatever its own tilt, along 2 + √2 times its face, and lets it out at right angles.
    """
    for tilt in ("", "TLA 3;"):
        found = lens(
            (
                *("TH 1e20", f"{tilt} TH 1", "GLA 1.57; TH 2.414214", "RFL; TLA 22.5; BEN; TH -2"),
                *("RFL; TLA 22.5; BEN; TH 2.414214", "AIR; TH 1; RCO"),
            ),
            "EBR 0.1",
        )
        entrance, first, second, leaving = frames(found)[2:6]
        assert float(entrance.axes[:, 2] @ leaving.axes[:, 2]) == pytest.approx(0, abs=1e-12)
        path = (first.origin - entrance.origin, second.origin - first.origin, leaving.origin - second.origin)
        assert sum(float(leg.norm()) for leg in path) == pytest.approx(2 * (2 + math.sqrt(2)), abs=1e-5)
        # The exit face is at right angles to the entrance face, an edge of 1 away.
        corner = leaving.origin - entrance.origin
        assert abs(float(corner @ entrance.axes[:, 2])) == pytest.approx(1, abs=1e-5)
        assert abs(float(corner @ leaving.axes[:, 2])) == pytest.approx(1, abs=1e-5)
        end = rt.trace(found, rt.tracing.rays(found, fields=[0], pupil=torch.zeros(2, 1, dtype=torch.float64)))
        if not tilt:
            assert end.position.flatten().tolist() == pytest.approx([0, 0, 0], abs=1e-5)


def test_lengths_in_inches():
    """RD 20 at UNI 25.4 is 508 mm (optical-format-import), and every other length goes with it."""
    surfaces = ("TH 1e20", "RD 20; GLA N-BK7; TH 1; AP CHK 2; AD 1e-3; AE 1e-4", "RD -20; TH 5; AST")
    inches, millimetres = (lens(surfaces, f"UNI {unit}; EBR 1; ANG 3") for unit in (25.4, 1))
    assert 1 / float(inches.surfaces[1].curvature) == pytest.approx(508)
    assert focal_length(inches) == pytest.approx(25.4 * focal_length(millimetres))
    assert inches.surfaces[1].apertures[0].extent == (0.0, 50.8)
    assert float(inches.aperture.value) == 50.8
    landing = [rt.spot(one, fields=[3], rays=64).rms_radius / unit for one, unit in ((inches, 25.4), (millimetres, 1))]
    assert float(landing[0]) == pytest.approx(float(landing[1]))


# -- the rest of a file -----------------------------------------------------------------------------------------------


def test_a_singlet_is_read_number_for_number():
    found, report = read(
        ("AIR; TH 1e20; AP 1e19", 'GLA N-BK7; RD 50; TH 4; AP 6; NOT "front"', "RD -50; TH 47.5; AST; AP CHK 5.5"),
        'EBR 5; ANG 7; SNO1 "a note"; SNO2 ""; DES "me"',
        title='A \\"singlet\\"; // of mine',
        waves="WV 0.58756 0.48613; WW 1 0.5",
        stated="48.8",
    )
    assert (found.name, found.notes) == ('A "singlet"; // of mine', ("a note",))
    assert [float(surface.thickness) for surface in found.surfaces] == [math.inf, 4.0, 47.5, 0.0]
    assert [surface.semi_diameter for surface in found.surfaces] == [None, 6.0, 5.5, None]
    assert found.surfaces[1].apertures == ()
    assert found.surfaces[1].comment == "front"
    assert (found.stop, found.primary_wavelength) == (2, 1)
    assert found.wavelength_weights.tolist() == [1.0, 0.5]
    assert found.fields.y.tolist() == pytest.approx(
        [0.0, math.degrees(math.atan(0.7 * math.tan(math.radians(7)))), 7.0]
    )
    assert (found.aperture.kind, float(found.aperture.value)) == ("entrance_pupil_diameter", 10.0)
    assert report.warnings == ()
    assert read(SINGLET, "EBR 5", strict=True)
    check(found)


def test_commands_are_separated_by_lines_or_semicolons_in_any_case():
    one = text(SINGLET, "EBR 5; ANG 7")
    lines = one.replace("; ", "\n").replace("RD", "rd").replace("GLA N-BK7", "gla  n-bk7  // a comment; NXT")
    assert "rd 50" in lines
    first, second = (FORMATS[".len"].read(each, "lens.len")[0] for each in (one, lines))
    assert [float(s.thickness) for s in first.surfaces] == [float(s.thickness) for s in second.surfaces]
    assert focal_length(first) == focal_length(second)


def test_a_curvature_is_one_over_the_radius():
    assert focal_length(lens((FAR, "CV 0.02; GLA N-BK7; TH 4", "RD -50; TH 47.5"), "EBR 5")) == focal_length(
        lens(SINGLET, "EBR 5")
    )


@pytest.mark.parametrize("height", [0.0, 1.5, -2.0])
def test_a_height_of_the_axial_ray_is_met(height):
    found = lens((FAR, "RD 50; GLA N-BK7; TH 4", f"RD -50; PY {height}"), "EBR 5")
    first = rt.first_order(found)
    y = 5 * float(found.surfaces[2].thickness - first.back_focal_distance) / -float(first.effective_focal_length)
    assert y == pytest.approx(height, abs=1e-12)


@pytest.mark.parametrize("system", ["EBR 5", "FNO 4"])
def test_the_focus_of_a_near_or_far_object_is_solved_for(system):
    found = lens((FAR, "RD 50; GLA N-BK7; TH 4", "RD -50; PY 0"), system)
    assert float(found.surfaces[2].thickness) == pytest.approx(float(rt.first_order(found).back_focal_distance))
    near = lens(("TH 200", "RD 50; GLA N-BK7; TH 4", "RD -50; PY 0"), "NAO 0.01; OBH 1")
    assert float(near.surfaces[2].thickness) == pytest.approx(float(rt.first_order(near).paraxial_image_distance))


def test_the_focus_behind_a_mirror_is_solved_for():
    found = lens((FAR, "RFL; RD -200; PY 0; AST"), "EBR 5")
    assert float(found.surfaces[1].thickness) == pytest.approx(-100)


def test_wavelengths_one_by_one():
    found = lens(SINGLET, "EBR 5", waves="WV 0.6 0.5; WV3 0.7; WV1 0.55; WW 1 1 1; WW2 0.25")
    assert found.wavelengths.tolist() == [0.55, 0.5, 0.7]
    assert found.wavelength_weights.tolist() == [1.0, 0.25, 1.0]
    found, report = read(SINGLET, "EBR 5", waves="")
    assert found.wavelengths.tolist() == [0.58756, 0.48613, 0.65627]
    assert "no WV: the program's own wavelengths" in report.warnings[0]


def test_the_stated_focal_length_is_compared():
    assert any("states a focal length of 99 mm" in note for note in read(SINGLET, "EBR 5", stated="99 3")[1].notes)


def test_glasses_are_looked_up_and_never_replaced():
    with pytest.raises(UnknownGlass, match="H_BAF13"):
        lens((FAR, "RD 50; GLA H_BAF13; TH 4", "TH 50"), "EBR 5")
    found = lens(SINGLET, "EBR 5")
    assert torch.equal(found.surfaces[1].glass.coefficients, find_glass("N-BK7").coefficients)


def test_commands_that_change_nothing_are_reported_with_their_reason():
    surfaces = (FAR, "RD 50; GLA N-BK7; TH 4; TCE 71; DRW ON; LMO ELE; TOX 0", "RD -50; TH 40")
    _, report = read(surfaces, "EBR 5; TELE OFF; FOO 1", tail="CFG NEW\nTH 1 2 8\nEND\n")
    statuses = {keyword.name: (keyword.status, keyword.reason) for keyword in report.keywords}
    assert {name for name, (status, _) in statuses.items() if status == "ignored"} >= {
        *("TCE", "DRW", "LMO", "TOX", "TELE", "CFG")
    }
    assert all(reason for status, reason in statuses.values() if status == "ignored")
    assert statuses["FOO"] == ("unknown", "")
    assert any("CFG (further configurations)" in warning for warning in report.warnings)
    assert any("unknown keyword FOO: left out" in warning for warning in report.warnings)


REFUSED = {
    "TOX 1": "about another point",
    "GC 1": "axes of its own",
    "RCO 1; TLA 1": "RCO 1",
    "BEN; TLA 45": "on a mirror",
    "BEN ON": "BEN ON",
    "ASP ASR 4": "general asphere",
    "AS3 1e-6": "general asphere",
    "CVX 0.01": "toroid",
    "RDX 100": "toroid",
    "PFL 100": "perfect lens",
    "GSP 0.001": "grating",
    "APN 1": "special apertures",
    "ATP A 2": "special apertures",
    "AX1 A -1": "special apertures",
    "LMO NSS": "not sequential",
    "PUC 0": "by chief ray",
    "PYC 0": "by chief ray",
    "EC 10": "by chief ray or by edge",
    "PK LN -1 1": "pickup",
    "PK AP -1": "pickup",
    "PK GLA -1 2": "pickup",
    "PK": "pickup",
    "PK GLA 1": "how many surfaces before",
    "PK GLA -9": "how many surfaces before",
    "GLA MOD 1.6 50": "index and Abbe number",
    "GLA 517642": "no index",
    "AP 3 4": "expected AP r",
    "DOE 1": "'DOE' is not known",
    "NAP 0.1": "image side",
    "GIH 2": "image height",
    "TELE ON": "telecentric",
    "WARM ON": "wide-angle",
    "AFO": "afocal",
    "GTO 1": "jump",
}


@pytest.mark.parametrize("command", REFUSED)
def test_unmodelled_features_are_refused_by_name_and_place(command):
    with pytest.raises(UnsupportedSurface, match=REFUSED[command]) as caught:
        lens((FAR, f"RD 50; GLA N-BK7; TH 4; {command}", "RD -50; TH 40"), "EBR 5")
    assert caught.value.line == 4
    assert command.partition(";")[0].split()[0] in str(caught.value)


@pytest.mark.parametrize(
    ("surfaces", "system", "message"),
    [
        (SINGLET, "FNO 4; NAO 0.1", "NAO of an object at infinity"),
        (("TH 100", *SINGLET[1:]), "EBR 5", "EBR of a near object"),
        (("TH 100", *SINGLET[1:]), "FNO 5", "FNO of a near object"),
        (("TH 100", *SINGLET[1:]), "NAO 0.1; ANG 5", "ANG (a field angle) of a near object"),
        ((FAR, "RD 50; GLA N-BK7; TH 4", "PU -0.1; TH 40"), "FNO 4", "PU .* for a beam by EBR only"),
        ((FAR, "RD 50; GLA N-BK7; TH 4", "RD -50; PY 1"), "FNO 4", "PY 1 .* PY 0 for any"),
        ((FAR, "RD 50; GLA N-BK7; TH 4", "RD -50; PY 0; TH 4"), "EBR 5", "give the same number twice"),
        ((FAR, "RD 50; GLA N-BK7; TH 4", "RD -50; PU -0.1; TH 4"), "EBR 5", "give the same number twice"),
        ((FAR, "TH 4", "PY 0"), "EBR 5", "never reaches that height"),
        ((FAR, "TH 4", "PU -0.1; TH 5"), "EBR 5", "no curvature here refracts"),
        ((FAR, "RD 50; CV 0.02; TH 4", "TH 5"), "EBR 5", "CV, but RD in line"),
        ((FAR, "RD 50; TH 1e10", "TH 5"), "EBR 5", "only the object may be at infinity"),
        (("TH 1e20; RFL", "TH 5", "TH 5"), "EBR 5", "RFL (a mirror) of the object"),
        (SINGLET, "EBR 5; WV 0.5 0", "expected a positive number"),
        (SINGLET, "EBR -5", "EBR is '-5', expected a positive number"),
        (SINGLET, "ANG 5", "no system aperture"),
        (SINGLET, "EBR 5; ANG 90", "less than 90 degrees"),
        (SINGLET, "EBR 5; UNI 0", "expected the millimetres"),
        (SINGLET, "EBR x", "EBR: size of the aperture is 'x'"),
        ((FAR, "RD 50; AST; TH 4", "AST; TH 5"), "EBR 5", "a second AST; surface 1"),
        (("TH 1e20; AST", "TH 4", "TH 5"), "EBR 5", "AST is surface 0"),
        ((FAR, "AP -1; TH 4", "TH 5"), "EBR 5", "AP is -1"),
        ((FAR, "GLA; TH 4", "TH 5"), "EBR 5", "without a name"),
        ((FAR, "WV 0.5; GLA 1.5 1.6 1.7 1.8; TH 4", "TH 5"), "EBR 5", "4 indices for 3 wavelengths"),
        ((FAR,), "EBR 5", "2 surfaces, expected at least"),
        ((FAR, "TLA 1; DT 3", "TH 5"), "EBR 5", "DT is 3"),
        (("TH 1e20; TLA 1", "TH 4", "TH 5"), "EBR 5", "TLA (a tilted or decentred object)"),
        ((FAR, "TLA 5; RD 50; GLA N-BK7; TH 4", "PY 0"), "EBR 5", "PY (a solve) in a lens with tilted"),
        ((FAR, "RFL; TLA 5; TLB 5; BEN; TH -4", "TH 5"), "EBR 5", "by TLA or by TLB alone"),
        ((FAR, "RFL; TLA 5; DCY 1; BEN; TH -4", "TH 5"), "EBR 5", "by TLA or by TLB alone"),
        ((FAR, "RFL; TLA 5; RCO; BEN; TH -4", "TH 5"), "EBR 5", "without RCO"),
        ((FAR, "RD 50; TH 4", "RD 5; PK CV -1"), "EBR 5", "RD in line 5 and PK CV -1 give the same number twice"),
        ((FAR, "RD 50; GLA N-BK7; TH 4", "PU -0.1; PK CV -1"), "EBR 5", "PK in line 5 and PU give the same"),
        ((FAR, "GLA N-BK7; TH 4", "PU -0.1; TH 3", "PK CV -1"), "EBR 5", "PK CV -1 of a number that is solved for"),
        ((FAR, "RFL; TH -4", "PK GLA -1"), "EBR 5", "picks up a mirror"),
    ],
)
def test_unreadable_files_are_refused_in_a_line(surfaces, system, message):
    waves = "" if "WV" in system else "WV 0.58756; WW 1"
    pattern = message if ".*" in message else message.replace("(", r"\(").replace(")", r"\)")
    with pytest.raises(LensFileError, match=pattern) as caught:
        lens(surfaces, system, waves=waves)
    assert str(caught.value).startswith("lens.len:")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "expected LEN NEW"),
        ("RD 5\n", "expected LEN NEW"),
        ("LEN OLD\n", "expected LEN NEW"),
        (text(SINGLET, "EBR 5").replace("END 3", ""), "no END after 4 surfaces"),
        (text(SINGLET, "EBR 5", end=7), "END states that the image is surface 7, but it is 3"),
        (text(SINGLET, "EBR 5", stated="50 2"), "LEN NEW states that the image is surface 2, but it is 3"),
        (text(SINGLET, "EBR 5", waves="TH 0.1; WV 0.5"), "focus shift"),
        (text(SINGLET, "EBR 5", waves="PY 0; WV 0.5"), "solve"),
        (text(SINGLET, "EBR 5", waves="WV 0.5; WW 1 2"), "WW has 2 values for 1 wavelengths"),
        (text(SINGLET, "EBR 5", waves="WV 0.5; WV3 0.6"), "WV3, but 1 wavelengths precede it"),
        ("LEN NEW; EBR 1\n" + "NXT\n" * 1100 + "END\n", "more than 1000 surfaces"),
    ],
)
def test_a_file_that_is_no_lens_or_cut_off_is_refused(content, message):
    with pytest.raises(LensFileError, match=message):
        FORMATS[".len"].read(content, "lens.len")


def test_a_repeated_command_is_warned_of():
    _, report = read((FAR, "RD 50; RD 60; GLA N-BK7; TH 4", "TH 50"), "EBR 5; FNO 4; ANG 1; OBH -1e19")
    text = "\n".join(report.warnings)
    assert "RD occurs again (first in line 4); the last is used" in text
    assert "several system apertures (EBR in line 2 and FNO in line 2); the last is used" in text
    assert "several fields (ANG in line 2 and OBH in line 2); the last is used" in text


def test_a_lens_file_of_oslo_is_converted_and_gone_on_with(tmp_path, capsys):
    path = tmp_path / "lens.len"
    path.write_text(text(SINGLET, "EBR 5; ANG 7", stated="48.95 3"))
    convert(path, tmp_path / "lens.zmx")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        first, second = read_lens(path), read_lens(tmp_path / "lens.zmx")
    assert str(first) == str(dataclasses.replace(second, notes=first.notes))
    assert main(["spot", str(path)]) == 0
    assert main(["check", str(path), "--strict"]) == 0
    assert "(len)" in capsys.readouterr().out
    with pytest.raises(LensFileError, match=r"a \.len file is read, but not written"):
        convert(path, tmp_path / "again.len")


def test_a_binary_file_is_named_as_one_of_code_v(tmp_path):
    """CODE V saves lenses under the same suffix; a damaged text is none."""
    path = tmp_path / "lens.len"
    path.write_bytes(b"CODEV\0\0\1" + bytes(range(256)) * 8)
    with pytest.raises(LensFileError, match=r"lens\.len: is binary: .*CODE V.*\.seq"):
        read_lens(path)
    path.write_text("RDM;LEN\nSO 0 1e13\nS 50 4 NBK7\nSI 0 0\n")
    with pytest.raises(LensFileError, match=r"CODE V: rename the file to \.seq"):
        read_lens(path)
    path.write_bytes(text(SINGLET).encode() + b"\x07\n")
    with pytest.raises(LensFileError, match=r"holds the character U\+0007"):
        read_lens(path)
    path.write_bytes(text(SINGLET, "EBR 5", "ANG 10").encode("utf-16"))
    assert len(read_lens(path).surfaces) == 4

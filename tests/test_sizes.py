"""Sizes of parts: mechanical semi-diameters and chip zones in files, drawings, edges, edits and trainings."""

import dataclasses
import math

import pytest
import torch
from problems import SHARED
from problems_files import assert_same, sized
from problems_zemax import file, read

import raytrace as rt
from raytrace.imaging.variables import Limits, violation
from raytrace.io import read_lens, write_lens
from raytrace.system.elements import mechanical_semi_diameters as of_clear
from raytrace.system.optimization_data import OptimizationData
from raytrace.tracing.geometry import mechanical_semi_diameters, polished_semi_diameters, semi_diameters
from raytrace.workshop.parts import NoSolid, parts_of

FILES = sorted(
    path
    for folder in ("corpus/zmx", "tier2/dev", "merit/dev", "tolerance/dev")
    for path in (SHARED / folder).glob("*")
    if path.suffix.lower() == ".zmx"
)


def doublet(**changes):
    """Three surfaces of clear semi-diameters 12, 11 and 10 mm, cemented, and a stop behind them."""
    rows = [
        dict(radius=60.0, thickness=8.0, glass="N-BK7", semi_diameter=12.0),
        dict(radius=-45.0, thickness=3.0, glass="N-SF2", semi_diameter=11.0),
        dict(radius=-150.0, thickness=5.0, semi_diameter=10.0),
        dict(thickness=80.0, semi_diameter=6.0),
    ]
    return rt.lens(rows, stop=4, entrance_pupil_diameter=12, fields=[0, 1], **changes)


def sag(radius, h):
    return math.copysign(abs(radius) - math.sqrt(radius**2 - h**2), radius)


def test_automatic_mechanical_semi_diameters_are_those_of_the_cemented_group():
    lens = doublet()
    assert mechanical_semi_diameters(lens)[1:5] == [12.0, 12.0, 12.0, 6.0]
    assert mechanical_semi_diameters(lens.replace(3, chip_zone=2.5))[1:5] == [12.5, 12.5, 12.5, 6.0]
    fixed = lens.replace(1, mechanical_semi_diameter=13.0).replace(3, mechanical_semi_diameter=10.5)
    assert mechanical_semi_diameters(fixed)[1:5] == [13.0, 13.0, 10.5, 6.0]
    alone = dataclasses.replace(lens, optimization_data=OptimizationData(shares_mechanical=False))
    assert mechanical_semi_diameters(alone, [math.nan, 12.0, 11.0, 10.0, 6.0, 3.0])[1:5] == [12.0, 11.0, 10.0, 6.0]


@pytest.mark.needs(SHARED)
def test_mechanical_semi_diameters_are_those_that_opticstudio_stored():
    """All automatic ones of 17 files, from the semi-diameters and chip zones beside them, bit for bit."""
    compared = 0
    for path in FILES:
        content = path.read_bytes()
        text = content.decode("utf-16" if content[:2] in (b"\xff\xfe", b"\xfe\xff") else "latin-1")
        if "MEMA" not in text:
            continue
        unit, stored = 1000.0 if "UNIT METER" in text else 1.0, []
        for words in map(str.split, text.splitlines()):
            stored += [0.0] * (words[:1] == ["SURF"])
            if words[:1] == ["MEMA"]:
                assert words[2] == "0"
                stored[-1] = float(words[1]) * unit
        lens = read_lens(path)
        assert of_clear(lens, [surface.semi_diameter or 0.0 for surface in lens.surfaces]) == stored, path.name
        compared += len(stored)
    assert compared >= 190


#: Lines of a surface between air and glass, and of a whole file, as OpticStudio writes them.
FRONT = 'TCED 7.1 0 0\nDIAM 6 1 0 0 1 ""\nOEMA 0.25 0 0 0 1 ""\nMEMA 7.5 1 0 0 1 ""\nCLAP 0.5 5.75 0\nOBDC 0.125 -0.25'
BACK = 'TCED 23.6 0 0\nDIAM 5.5 0 0 0 1 ""\nMEMA 7.5 0 0 0 1 ""\nFLAP 0 5.5 0'
ENVIRONMENTS = """\
MNUM 2 1
TEMP 0 1 20 0 0 0 1 1 1.0 0.0 0
TEMP 0 2 60 0 0 0 1 1 1.0 0.0 0
PRES 0 1 1.0 0 0 0 1 1 1.0 0.0 0
PRES 0 2 0.5 0 0 0 1 1 1.0 0.0 0
THIC 2 1 47.5 0 0 0 1 1 1.0 0.0 0
THIC 2 2 47.53 0 0 0 1 1 1.0 0.0 0"""


@pytest.mark.parametrize(("unit", "mm"), [("MM", 1.0), ("IN", 25.4), ("METER", 1000.0)])
@pytest.mark.parametrize("shared", ["1 1", "0 0"])
def test_a_file_with_temperatures_expansion_and_sizes_keeps_its_meaning(unit, mm, shared, tmp_path):
    text = file(
        UNIT=f"UNIT {unit} X W X CM MR CPMM\nENVD 20 1 1\nSDMA 5 1 0.25\nOMMA {shared}",
        surface=FRONT,
        stop=BACK,
        tail=ENVIRONMENTS,
    )
    lens, report = read(text)
    front, back = lens.surfaces[1:3]
    assert (front.chip_zone, front.mechanical_semi_diameter) == (0.25 * mm, 7.5 * mm)
    assert (back.chip_zone, back.mechanical_semi_diameter) == (None, None)
    assert [float(surface.expansion) for surface in (front, back)] == [7.1, 23.6]
    assert front.apertures[0].extent == (0.5 * mm, 5.75 * mm)
    assert mechanical_semi_diameters(lens)[1] == 7.5 * mm
    assert (mechanical_semi_diameters(lens)[2] == 7.5 * mm) == (shared == "1 1")
    assert [float(lens.configuration(k).environment.temperature) for k in (1, 2)] == [20.0, 60.0]
    assert [float(lens.configuration(k).environment.pressure) for k in (1, 2)] == [1.0, 0.5]
    states = {row["name"]: row["status"] for row in report.document()["keywords"]}
    assert {states[keyword] for keyword in ("MEMA", "OEMA", "OMMA", "TCED", "CLAP", "TEMP", "PRES")} == {"read"}
    write_lens(lens, tmp_path / "again.zmx")
    again = read_lens(tmp_path / "again.zmx")
    assert_same(again, sized(lens))
    for k in (1, 2):
        assert_same(again.configuration(k).surfaces, sized(lens).configuration(k).surfaces)
    written = [line.split() for line in (tmp_path / "again.zmx").read_text().splitlines()]
    in_millimetres = unit == "MM"  # other units are written where rows of a merit function have it
    if in_millimetres:
        rows = [words[1:6] for words in written if words[0] == "MEMA"]
        width = "7.5" if shared == "1 1" else "5.5"
        assert rows[1:3] == [["7.5", "1", "0", "0", "1"], [width, "0", "0", "0", "1"]]
        assert [words[1] for words in written if words[0] == "OEMA"] == ["0.25"]
    assert ["OMMA", *shared.split()] in written


def test_a_pickup_of_a_mechanical_semi_diameter_is_kept(tmp_path):
    lens, _ = read(file(stop='MEMA 7.5 2 1 0 1 ""'))
    (rule,) = lens.optimization_data.kept
    assert (rule.surface, rule.quantity, rule.kind, rule.source) == (2, "mechanical_semi_diameter", "pickup", 1)
    write_lens(lens, tmp_path / "again.zmx")
    assert '  MEMA 7.5 2 1 0 1 ""' in (tmp_path / "again.zmx").read_text().splitlines()
    assert read_lens(tmp_path / "again.zmx").optimization_data.kept == (rule,)


@pytest.mark.parametrize("line", ['MEMA -1 1 0 0 1 ""', 'OEMA -0.5 0 0 0 1 ""'])
def test_a_negative_size_is_refused_with_its_line(line):
    with pytest.raises(rt.LensFileError, match=rf"lens\.zmx:\d+, surface 1: {line[:4]} is .*0 or more"):
        read(file(surface=line))


@pytest.mark.parametrize("suffix", [".zmx", ".csv", ".seq"])
def test_all_formats_bring_the_sizes_back(suffix, tmp_path):
    lens = doublet().replace(1, chip_zone=0.3).replace(3, mechanical_semi_diameter=1 / 3 + 12)
    write_lens(lens, tmp_path / f"lens{suffix}")
    assert_same(read_lens(tmp_path / f"lens{suffix}").surfaces, sized(lens).surfaces)


def test_sizes_follow_a_factor_and_a_temperature():
    lens = doublet().replace(1, chip_zone=0.3, mechanical_semi_diameter=13.0)
    large = rt.edit.scale(lens, 2.0).surfaces[1]
    assert (large.semi_diameter, large.chip_zone, large.mechanical_semi_diameter) == (24.0, 0.6, 26.0)
    warm = lens.at(temperature=120).surfaces[1]
    growth = warm.semi_diameter / 12.0
    assert 1e-4 < growth - 1 < 2e-3
    assert (warm.chip_zone, warm.mechanical_semi_diameter) == pytest.approx((0.3 * growth, 13.0 * growth), rel=1e-15)


def test_a_part_with_a_flange_has_the_volume_of_its_caps_and_cylinders():
    """Faces follow their sag up to the chip zone, and are flat from there to the fixed diameter."""
    rows = [
        dict(radius=50.0, thickness=8.0, glass="N-BK7", semi_diameter=10.0, chip_zone=0.5),
        dict(radius=-80.0, thickness=50.0, semi_diameter=10.0, mechanical_semi_diameter=14.0),
    ]
    lens = rt.lens(rows, stop=1, entrance_pupil_diameter=10)
    (part,) = parts_of(lens, margin=1.0)  # which a fixed diameter does not take
    s = sag(50.0, 10.5), sag(80.0, 10.0)
    edge = 8.0 - sum(s)
    caps = [math.pi * depth**2 * (radius - depth / 3) for depth, radius in zip(s, (50.0, 80.0), strict=True)]
    assert (part.rim, part.faces[0].clear) == (14.0, 10.0)
    assert part.edge == pytest.approx(edge, rel=1e-13)
    assert part.volume == pytest.approx(math.pi * 14.0**2 * edge + sum(caps), rel=1e-12)
    assert [14.0 in abs(points[1]) for points in (segment.points() for segment in part.profile())].count(True) >= 2
    with pytest.raises(NoSolid, match=r"mechanical semi-diameter of 9 mm .* surface 1, 10 mm"):
        parts_of(lens.replace(1, mechanical_semi_diameter=9.0).replace(2, mechanical_semi_diameter=9.0))


def test_parts_of_a_cemented_group_have_one_diameter():
    assert [part.rim for part in parts_of(doublet())] == [12.0, 12.0]
    assert [part.rim for part in parts_of(doublet().replace(2, chip_zone=2.0), margin=0.5)] == [13.5, 13.5]


def test_the_edge_of_a_condition_is_at_the_chip_zone_and_that_of_a_file_is_not():
    lens = rt.lens(
        [
            dict(radius=50.0, thickness=8.0, glass="N-BK7", semi_diameter=12.0),
            dict(radius=-80.0, thickness=50.0, semi_diameter=11.0),
        ],
        stop=1,
        entrance_pupil_diameter=10,
    )
    wide = lens.replace(1, chip_zone=1.0)
    for design, rim in ((lens, 12.0), (wide, 13.0)):
        edge = 8.0 - sag(50.0, rim) - sag(80.0, rim)
        assert f"{edge:.6g}" in str(design.with_conditions("edge>=9"))
        of_file = rt.evaluate(design, merit=rt.Merit([rt.system.Row("ETVA", (1, 0), weight=1)])).values.tolist()
        assert of_file == pytest.approx([8.0 - sag(50.0, 12.0) - sag(80.0, 11.0)], rel=1e-12)  # both at their own
        limits = Limits((0.0, math.inf), (0.0, math.inf), edge + 0.5)
        assert float(violation(design, limits)) == pytest.approx(0.25, rel=1e-9)


def test_a_limit_of_a_training_takes_semi_diameters_of_the_rays_with_their_derivative():
    """No semi-diameter is stored: the edge is where the outermost ray meets the lens."""

    def shortfall(thickness):
        rows = [
            dict(radius=40.0, thickness=5.0),
            dict(radius=60.0, thickness=thickness, glass="N-BK7"),
            dict(radius=-60.0, thickness=50.0),
        ]
        lens = rt.lens(rows, stop=1, entrance_pupil_diameter=14, fields=[0, 8])
        return violation(lens, Limits((0.0, math.inf), (0.0, math.inf), 6.0))

    at = torch.tensor(4.0, dtype=torch.float64, requires_grad=True)
    value = shortfall(at)
    (slope,) = torch.autograd.grad(value, at)
    above, below = (float(shortfall(torch.tensor(4.0 + h, dtype=torch.float64))) for h in (1e-5, -1e-5))
    assert float(value.detach()) > 1
    assert float(slope) == pytest.approx((above - below) / 2e-5, rel=1e-7)


def test_semi_diameters_are_edited_for_all_surfaces_and_for_some():
    lens = rt.lens(
        [dict(radius=50.0, thickness=5.0, glass="N-BK7"), dict(radius=-50.0, thickness=46.0)],
        stop=1,
        entrance_pupil_diameter=10,
        fields=[0, 5],
    )
    rays = semi_diameters(lens)
    made = rt.edit.semi_diameters(lens, margin=(2, 0.5), chip_zone=0.25)
    assert [surface.chip_zone for surface in made.surfaces] == [None, 0.25, 0.25, None]
    assert [surface.semi_diameter for surface in made.surfaces[1:]] == pytest.approx(
        [rays[1], 1.02 * rays[2] + 0.5, rays[3]], rel=1e-14
    )
    assert mechanical_semi_diameters(made)[1:3] == [polished_semi_diameters(made)[2]] * 2
    fixed = rt.edit.semi_diameters(made, "1-2", clear=6.0, mechanical=7.0)
    assert [surface.semi_diameter for surface in fixed.surfaces[1:3]] == [6.0, 6.0]
    assert fixed.replace(1, radius=70).with_semi_diameters().surfaces[2].semi_diameter == 6.0
    assert mechanical_semi_diameters(fixed)[1:3] == [7.0, 7.0]
    free = rt.edit.semi_diameters(fixed, clear="auto", mechanical="auto", chip_zone=0)
    assert semi_diameters(free) == pytest.approx(semi_diameters(made), nan_ok=True)
    assert not any(surface.chip_zone or surface.mechanical_semi_diameter for surface in free.surfaces)
    for wrong, words in ((dict(mechanical=5.0), "smaller than its clear one"), (dict(chip_zone=-1), "length in mm")):
        with pytest.raises(rt.BadEdit, match=words):
            rt.edit.semi_diameters(made, "1-2", **wrong)


def test_the_command_sizes_a_lens_and_prints_both(run, tmp_path):
    path = tmp_path / "sized.zmx"
    words = ["margin=2,0.5", "chip_zone=0.5", "--semi-diameters", "1-2", "mechanical=20"]
    run("edit", "cooke_triplet", "--semi-diameters", *words, "-o", path)
    text = run("info", path).out
    assert "semi-dia.  mech. s.-d." in text
    surfaces = run("info", path, "--json").document["surfaces"]
    assert [surfaces[k]["mechanical_semi_diameter"] for k in (1, 2)] == [20.0, 20.0]
    assert [surfaces[k]["mechanical_semi_diameter_is_fixed"] for k in (2, 3)] == [True, False]
    third = max(surfaces[k]["semi_diameter"] for k in (3, 4)) + 0.5
    assert surfaces[3]["mechanical_semi_diameter"] == pytest.approx(third, rel=1e-12)
    failed = run("edit", "cooke_triplet", "--semi-diameters", "margin=a", "-o", path)
    assert "--semi-diameters margin=a: expected per cent and mm, as 2,0.5" in failed.error


def test_automatic_semi_diameters_of_an_optimised_lens_follow_its_rays():
    lens = rt.read_lens("cooke_triplet").with_semi_diameters(fixed=())
    optimised = rt.optimize(lens, vary="curvature:1-4", merit="spot", cycles=3).lens
    sizes = [surface.semi_diameter for surface in optimised.surfaces[1:]]
    assert sizes == pytest.approx([float(size) for size in semi_diameters(optimised)[1:]], rel=1e-6)
    assert max(abs(one - surface.semi_diameter) for one, surface in zip(sizes, lens.surfaces[1:], strict=True)) > 0.01

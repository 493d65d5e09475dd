"""Configurations: each is the file as it would be saved in it; one lens with shared numbers; written and chosen."""

import dataclasses
import json
import re
from pathlib import Path

import pytest
import torch
from problems import SHARED
from problems_configurations import ANGLES, CASES, operands, scan, two
from problems_files import leaves, readable, sized
from problems_zemax import file, read

import raytrace as rt
from raytrace.cli import main
from raytrace.io import LensFileError, LensFileWarning, read_lens, write_lens
from raytrace.system.configurations import differences, part

REAL_FILES = {path.name: path for name in ("scan3", "scan4", "splitter", "temp5") for path in SHARED.rglob(f"*{name}*")}
REAL = [REAL_FILES[name] for name in sorted(REAL_FILES) if name.lower().endswith(".zmx")]


def saved_alike(one, other) -> bool:
    """Whether two lenses are alike; what is None in one may be 0 in the other, for it is modelled for the operand."""
    for path in differences(one, other):
        a, b = part(one, path), part(other, path)
        zeros = [x is None or (isinstance(x, torch.Tensor) and not bool(x.any())) for x in (a, b)]
        if path[0] not in ("operands", "current_configuration") and not all(zeros):
            return False
    return True


@pytest.mark.parametrize("unit", ["MM", "IN"])
@pytest.mark.parametrize("name", CASES)
def test_every_configuration_is_the_file_as_it_would_be_saved_in_it(name, unit, tmp_path):
    tail, changes, (before, after) = CASES[name]
    text = file(**changes, tail=tail, UNIT=f"UNIT {unit}")
    assert text.count(before) == 1
    saved = text.replace(before, after)
    saved = saved.replace("SURF 2\n  STOP", "SURF 2") if name == "stop" else saved
    lens, report = read(text)
    assert [warning for warning in report.warnings if "occurs again" not in warning] == []
    assert any("configuration 1 of 2 read, as stored" in note for note in report.notes)
    assert lens.current_configuration == 1
    assert len(lens.configurations) == 2
    assert saved_alike(lens.configuration(1), lens)
    assert saved_alike(lens.configuration(2), read(saved[: saved.index("MNUM")])[0])
    assert not saved_alike(lens.configuration(2), lens)
    assert saved_alike(lens.configuration(2).configuration(1), lens)
    again = read(saved.replace("MNUM 2 1", "MNUM 2 2"))[0]
    assert saved_alike(again, lens.configuration(2))
    assert saved_alike(again.configuration(1), lens)
    for one in (lens, again):
        write_lens(one, tmp_path / "lens.zmx")
        assert leaves(read_lens(tmp_path / "lens.zmx")) == leaves(sized(one))


def test_a_scanning_mirror_turns_the_light_by_twice_its_angle_and_its_pickup_turns_back(tmp_path):
    lens, report = read(scan())
    assert report.warnings == ()
    write_lens(lens, tmp_path / "lens.zmx")
    assert leaves(read_lens(tmp_path / "lens.zmx")) == leaves(sized(lens))
    (operand,) = lens.operands
    assert (operand.name, operand.number, operand.parameter) == ("PRAM", 3, 3)
    assert [(place.path[1], place.factor) for place in operand.paths] == [(3, 1.0), (5, -1.0)]
    for angle, one in zip(ANGLES, lens.configurations, strict=True):
        end = rt.trace(one, rt.tracing.rays(one, fields=[0], pupil=torch.zeros(2, 1, dtype=torch.float64)))
        height = 80 * torch.tan(torch.deg2rad(torch.tensor(2 * angle, dtype=torch.float64)))
        assert abs(abs(float(end.position[1])) - abs(float(height))) < 1e-12
    for active in (2, 3, 5):  # whichever was current when it was saved
        again = read(scan(active))[0]
        assert again.current_configuration == active
        for one, other in zip(again.configurations, lens.configurations, strict=True):
            assert saved_alike(one, other)


def test_numbers_without_an_operand_are_shared_by_configurations_with_derivatives():
    lens = read(file(tail=two("THIC", 1, "4", "5.5")))[0]
    values = lens.operands[0].numbers.clone().requires_grad_()
    curvature = lens.surfaces[2].curvature.clone().requires_grad_()
    varied = lens.replace(2, curvature=curvature)
    varied = dataclasses.replace(varied, operands=(dataclasses.replace(lens.operands[0], numbers=values),))
    focal = [rt.first_order(one).effective_focal_length for one in varied.configurations]
    by_value, by_curvature = torch.autograd.grad(focal[1], (values, curvature))
    assert by_value[0] == 0
    h = 1e-5
    moved = lens.replace(2, curvature=curvature.detach())
    ends = [
        rt.first_order(moved.configuration(2).replace(1, thickness=5.5 + d)).effective_focal_length for d in (h, -h)
    ]
    assert abs(float(by_value[1]) - float((ends[0] - ends[1]) / (2 * h))) < 1e-6
    assert float(by_curvature) != 0


def test_replaced_numbers_belong_to_the_current_configuration_and_conditions_to_all():
    lens = read(file(tail=two("THIC", 2, "47.5", "40")))[0]
    moved = lens.configuration(2).replace(2, thickness=41.0)
    assert [float(one.surfaces[2].thickness) for one in moved.configurations] == [47.5, 41.0]
    held = lens.at(sensor_distance=30.0)
    assert [float(one.surfaces[2].thickness) for one in held.configurations] == [30.0, 30.0]
    assert float(lens.at(configuration=2).surfaces[2].thickness) == 40.0
    fields = read(file(tail=two("YFIE", 2, "7", "3")))[0].at(fields=[1.0])
    assert fields.configuration(2).fields.y.tolist() == [1.0]


def test_configurations_are_made_from_plain_numbers(tmp_path):
    lens = rt.read_lens("double_gauss").with_configurations(thickness={6: [12.0, 16.0], 5: [14.0, 10.0]})
    assert [[float(one.surfaces[k].thickness) for k in (5, 6)] for one in lens.configurations] == [[14, 12], [10, 16]]
    write_lens(lens, tmp_path / "zoom.zmx")
    assert leaves(read_lens(tmp_path / "zoom.zmx")) == leaves(sized(lens))
    for wrong, said in (
        ({"glass": {1: [1.5]}}, "'glass' does not differ"),
        ({"fields": [[0, 10], [0, 5]]}, "'fields' does not differ.*as image heights, by `field_kind`"),
        ({"thickness": {99: [1.0]}}, "surface 99"),
        ({"thickness": {1: [1.0, 2.0], 2: [1.0]}}, "lists of values of one length"),
    ):
        with pytest.raises(ValueError, match=said):
            lens.with_configurations(**wrong)


def test_a_configuration_that_is_not_there_is_refused():
    lens = read(file(tail=two("THIC", 1, "4", "5")))[0]
    with pytest.raises(ValueError, match=r"configuration 3: .*configurations 1 to 2"):
        lens.configuration(3)
    assert read(file())[0].configurations[0].current_configuration == 1
    with pytest.raises(ValueError, match="has one configuration"):
        read(file())[0].configuration(2)


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("IGNR 1 {} {}", "not modelled"),
        ("GLSS 1 {} N-BK7{}", "unknown glass"),
        ("THIC 9 {} {}", "THIC of surface 9"),
        ("THIC 1 {} 1e{}99", "too large"),
    ],
)
def test_unsupported_operands_are_reported_and_the_configuration_refused(line, said):
    text = file(tail=operands(line.format(1, 0), line.format(2, 7)))
    lens, report = read(text)
    number = text.splitlines().index(line.format(1, 0)) + 1
    assert any(re.search(rf"lens.zmx:{number}.*not followed.*{said}", warning) for warning in report.warnings)
    with pytest.raises(ValueError, match=rf"configuration 2: .*{said}"):
        lens.configuration(2)
    with pytest.raises(LensFileError, match=said):
        read(text, configuration=2)


def test_an_operand_of_an_aperture_that_is_not_stored_is_reported_and_its_configuration_refused():
    lens, report = read(file(tail=operands("APMX 1 1 5 0 0", "APMX 1 2 3 0 0")))
    assert any("APMX" in warning and "no such part" in warning for warning in report.warnings)
    assert lens.surfaces[1].apertures == ()
    with pytest.raises(ValueError, match=r"configuration 2: .*no such part"):
        lens.configuration(2)


def test_operands_that_contradict_the_surfaces_are_reported_with_line_and_number():
    text = file(tail=operands("CRVT 1 1 0.021 0 0", "CRVT 1 2 0.03 0 0", "THIC 1 1 4 0 0", "THIC 1 2 5 0 0"))
    warnings = read(text)[1].warnings
    line = text.splitlines().index("CRVT 1 1 0.021 0 0") + 1
    assert len(warnings) == 1
    assert re.search(rf":{line}.*CRVT 1 = 0.021.*holds 0.02 \(configuration 1\)", warnings[0])
    rounded = file(tail=operands("CRVT 1 1 0.02000000000001 0 0", "CRVT 1 2 0.03 0 0"))
    assert read(rounded)[1].warnings == ()


def test_unknown_known_and_missing_operands_are_reported():
    text = file(tail=operands("QQQQ 1 1 3", 'COTN 1 1 "AR" 0 0', 'COTN 1 2 "" 0 0', "THIC 1 2 5 0 0", "THIC 1 7 5"))
    _, report = read(text)
    status = {keyword.name: keyword.status for keyword in report.keywords}
    assert (status["QQQQ"], status["COTN"], status["THIC"]) == ("unknown", "ignored", "read")
    said = " ".join(report.warnings)
    for piece in ("unknown keyword QQQQ", "THIC 1 has no value for configuration 1", "configuration 7, of 2"):
        assert piece in said


def test_ray_solves_that_operands_change_are_reported():
    solved = {"stop": "MAZH 0 0"}
    text = file(tail=two("THIC", 1, "4", "5"), **solved)
    assert any(
        "solved for configuration 1" in warning and "DISZ of surface 2" in warning for warning in read(text)[1].warnings
    )
    assert read(file(tail=two("YFIE", 2, "7", "3"), **solved))[1].warnings == ()
    both = operands("THIC 1 1 4 0 0", "THIC 1 2 5 0 0", "THIC 2 1 47.5 0 0", "THIC 2 2 46 0 0")
    assert read(file(tail=both, **solved))[1].warnings == ()


PICKUPS = {
    "thickness": (two("THIC", 1, "4", "5"), "PZUP 1 2 1 0", ("DISZ 47.5", "DISZ 9"), "thickness", 11.0),
    "curvature": (two("CRVT", 1, "0.02", "0.03"), "", ("CURV -0.02", "CURV -0.02 4 1 -1 0"), "curvature", -0.03),
    "glass": (two("GLSS", 1, '"N-BK7"', '"N-SF6"'), "GLAS N-BK7 2 1 1.5 64", ("", ""), "glass", "N-SF6"),
    "another rule": (
        two("THIC", 1, "4", "5"),
        "PZUP 1 2 1 0",
        ("", ""),
        "thickness",
        47.5,
    ),  # for 47.5 is not 2 · 4 + 1
}


@pytest.mark.parametrize("name", PICKUPS)
def test_pickups_are_followed_and_written_and_other_rules_left(name, tmp_path):
    tail, stop, (before, after), field, expected = PICKUPS[name]
    lens = read(file(tail=tail, stop=stop).replace(before or " ", after or " "))[0]
    found = getattr(lens.configuration(2).surfaces[2], field)
    assert (found.name if field == "glass" else float(found)) == expected
    write_lens(lens, tmp_path / "lens.zmx")
    assert leaves(read_lens(tmp_path / "lens.zmx")) == leaves(sized(lens))


def test_a_focal_length_that_is_picked_up_is_followed_by_its_reciprocal(tmp_path):
    ideal = "TYPE PARAXIAL\nPARM 1 50\nPARM 2 1"
    stop = "TYPE PARAXIAL\nPARM 1 150\nPARM 2 1\nPPAR 1 1 3 0 0"
    text = file(tail=two("PRAM", 1, "50", "80", 1), surface=ideal, stop=stop)
    text = text.replace("CURV 0.02", "CURV 0").replace("CURV -0.02", "CURV 0")
    lens, report = read(text)
    assert not any("not followed" in line for line in (*report.warnings, *report.notes))
    powers = [float(one.surfaces[2].phase.power_y) for one in lens.configurations]
    assert powers == pytest.approx([1 / 150, 1 / 240], rel=1e-15)
    write_lens(lens, tmp_path / "lens.zmx")
    assert leaves(read_lens(tmp_path / "lens.zmx")) == leaves(sized(lens))
    broken = text.replace("PPAR 1 1 3 0 0", "PPAR 1 1 2 50 0")  # with an offset the reciprocal is not proportional
    with pytest.raises(ValueError, match="picked up by a rule that is not followed"):
        read(broken)[0].configuration(2)


def test_terms_of_another_radius_are_followed_and_not_written(tmp_path):
    surface = "TYPE XASPHERE\nXDAT 1 1\nXDAT 2 10\nXDAT 3 0.1"
    lens = read(file(tail=two("EDVA", 1, "10", "5", 2), surface=surface))[0]
    assert [one.surfaces[1].coefficients.tolist() for one in lens.configurations] == [[0.1 / 10**2], [0.1 / 5**2]]
    with pytest.raises(LensFileError, match=r"EDVA 1 2: .*number or radius"):
        write_lens(lens, tmp_path / "lens.zmx")


def test_weights_and_comments_are_kept_with_the_lens(tmp_path):
    tail = operands('MOFF 0 1 "far" 0 0', 'MOFF 0 2 "near" 0 0', "CWGT 0 1 1 0 0", "CWGT 0 2 2.5 0 0")
    lens = read(file(tail=tail))[0]
    assert [operand.values() for operand in lens.operands] == [["far", "near"], [1.0, 2.5]]
    write_lens(lens, tmp_path / "lens.zmx")
    assert leaves(read_lens(tmp_path / "lens.zmx")) == leaves(sized(lens))


def test_a_table_reports_that_it_holds_one_configuration(tmp_path):
    lens = read(file(tail=two("THIC", 1, "4", "5")))[0].configuration(2)
    with pytest.warns(LensFileWarning, match="other configurations, 2 in all"):
        write_lens(lens, tmp_path / "lens.csv")
    assert float(read_lens(tmp_path / "lens.csv").surfaces[1].thickness) == 5.0


@pytest.mark.needs(SHARED)
@pytest.mark.parametrize("path", REAL, ids=lambda path: path.name)
@pytest.mark.filterwarnings("ignore")
def test_real_files_have_all_their_configurations(path, tmp_path):
    lens = readable(path)
    if lens is None:  # refused by name
        return
    assert len(lens.configurations) > 1
    assert saved_alike(lens.configurations[lens.current_configuration - 1], lens)
    write_lens(lens, tmp_path / "lens.zmx")
    again = read_lens(tmp_path / "lens.zmx")
    for one, other in zip(lens.configurations, again.configurations, strict=True):
        assert leaves(one) == leaves(other)


# -- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def zoom(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("zoom.zmx").write_text(
        file(tail=operands("THIC 1 1 4 0 0", "THIC 1 2 5 0 0", "GLSS 1 1 N-BK7", "GLSS 1 2 N-SF6"))
    )


def test_the_command_opens_any_configuration(zoom, capsys):
    for number, (thickness, glass) in enumerate([(4.0, "N-BK7"), (5.0, "N-SF6")], 1):
        assert main(["info", "zoom.zmx", "--configuration", str(number), "--json"]) == 0
        found = json.loads(capsys.readouterr().out)
        assert (found["surfaces"][1]["thickness"], found["surfaces"][1]["glass"]) == (thickness, glass)
    for command in (["info"], ["spot"], ["check"], ["trace"]):
        assert main([*command, "zoom.zmx", "--configuration", "3"]) == 1
        assert "zoom.zmx:33: configuration 3: this lens has configurations 1 to 2" in capsys.readouterr().err
    assert main(["info", "double_gauss", "--configuration", "2"]) == 1
    assert "configuration 2" in capsys.readouterr().err


def test_info_prints_the_configuration(zoom, capsys):
    assert main(["info", "zoom.zmx", "--configuration", "2"]) == 0
    assert re.search(r"configuration +2 of 2\n", capsys.readouterr().out)
    assert main(["info", "zoom.zmx", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["configuration"], found["configurations"]) == (1, 2)
    assert main(["info", "double_gauss", "--json"]) == 0
    assert "configuration" not in capsys.readouterr().out


def test_check_lists_differences_between_configurations(zoom, capsys):
    assert main(["check", "zoom.zmx"]) == 0
    out = capsys.readouterr().out
    assert re.search(r"THIC 1 +4 +5\n", out)
    assert re.search(r"GLSS 1 +N-BK7 +N-SF6\n", out)
    assert main(["check", "zoom.zmx", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["configurations"][0] == {"operand": "THIC 1", "values": [4.0, 5.0]}
    assert main(["check", "double_gauss", "--json"]) == 0
    assert "configurations" not in json.loads(capsys.readouterr().out)


def test_the_lens_of_a_configuration_is_written_with_all_of_them(zoom, capsys):
    assert main(["convert", "zoom.zmx", "second.zmx", "--configuration", "2"]) == 0
    second = read_lens("second.zmx", configuration=2)
    assert second.current_configuration == 2
    assert [float(one.surfaces[1].thickness) for one in second.configurations] == [4.0, 5.0]
    assert main(["focus", "zoom.zmx", "--configuration", "2", "-o", "focused.zmx"]) == 0
    focused = read_lens("focused.zmx", configuration=2)
    assert float(focused.surfaces[1].thickness) == 5.0
    assert float(focused.surfaces[2].thickness) != 47.5
    capsys.readouterr()


def test_layout_draws_all_configurations_in_one_figure(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("scan.zmx").write_text(scan())
    assert main(["layout", "scan.zmx", "--configuration", "all", "--plot", "scan.png"]) == 0, capsys.readouterr().err
    assert Path("scan.png").stat().st_size > 10_000
    lens = read_lens("scan.zmx")
    figure = rt.layout(lens, configuration="all", rays=3).plot()
    drawn = [line for line in figure.axes[0].lines if line.get_gid() == "ray"]
    assert len(drawn) == 5 * 3
    assert len({line.get_color() for line in drawn}) == 5
    heights = sorted({round(float(line.get_xdata()[-1]) + float(line.get_ydata()[-1]), 6) for line in drawn})
    assert len(heights) > 5
    one = rt.layout(lens, configuration=2, rays=3).plot()
    assert len([line for line in one.axes[0].lines if line.get_gid() == "ray"]) == 3
    with pytest.raises(ValueError, match="shows one configuration"):
        rt.layout(lens, configuration="all", view="3d")

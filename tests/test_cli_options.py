"""Options of the commands: one name has one meaning; options with several values; suggestions for misspelt options."""

import argparse
import ast
import csv
import inspect
import io
import json
import math
import re
import subprocess
import sys
import typing
from collections import defaultdict
from pathlib import Path

import numpy as np
import pandas
import pytest
import torch
from layers import parsed

import raytrace as rt
from raytrace import distortion, opd_fan, ray_fan
from raytrace.cli import build_parser, options
from raytrace.cli.commands import COMMANDS, WAVE_COMMANDS
from raytrace.cli.runner import RUNNER_OPTIONS, find_lens
from raytrace.cli.types import PICTURES, picture_file
from raytrace.imaging.sensor import PATTERNS
from raytrace.io import read_lens
from raytrace.io.pictures import read_depth
from raytrace.maths.sampling import hexapolar
from raytrace.optimization.merit import KINDS, DefaultMerit, Merit, merit_of_options
from raytrace.psf_models import MODELS, Execution
from raytrace.tolerancing.grades import GRADES
from raytrace.tracing.ray_failures import LOST, STATUS, ray_failures
from raytrace.tracing.spot import arrivals
from raytrace.words import did_you_mean, in_command, option, with_options

#: Options whose form differs between commands, and why.
DIFFERENT = {
    "--rays": "a fixed form of trace is a table of rays; elsewhere a number, of bench several",
    "--output": "a folder, where what a command makes is a run; height maps may be pictures",
    "--step": "codesign chooses the unit of its variables, sag takes a length",
    "--start": "compare-models chooses from two places, codesign takes a distance, too",
    "--shape": "of a part, and of the area of encircled energy",
    "--element": "named elements, kinds that are learned, and several of either",
    "--configuration": "layout draws all of them in one figure",
    "--log": "optimize writes one; elsewhere the scale of a figure",
    "--resume": "codesign finds its own runs",
    "--depth": "layers of a network, distances of points, and a map",
    "--tolerance": "a height error of etching, a switch for the lens as built, and in % of the figures of parts",
    "--sensor": "its distance from an element, and its size",
    "--efl": "edit scales to a number, stock finds parts within a range",
    "--elements": "draw has sheets of some, stock finds parts of a number of them",
    "--glass": "one of a phase element, several of a part",
}


def parsers(parser=None, name=()):
    """Every command and subcommand with its parser."""
    parser = parser or build_parser()
    children = [action for action in parser._actions if isinstance(action, argparse._SubParsersAction)]
    if not children:
        yield " ".join(name), parser
    for child in children:
        for word, one in child.choices.items():
            yield from parsers(one, (*name, word))


PARSERS = dict(parsers())


def actions(option):
    """The actions of an option by command."""
    return {name: parser._option_string_actions.get(option) for name, parser in PARSERS.items()}


def test_an_option_means_the_same_everywhere():
    forms = defaultdict(lambda: defaultdict(list))
    for name, parser in PARSERS.items():
        for action in parser._actions:
            for flag in action.option_strings:
                if flag.startswith("--"):
                    forms[flag][action.type, action.metavar, action.nargs].append(name)
    different = {option: dict(found) for option, found in forms.items() if len(found) > 1}
    assert set(different) == set(DIFFERENT)


@pytest.mark.parametrize("name", PARSERS)
def test_data_pixels_and_figures_have_their_own_options(name):
    known = PARSERS[name]._option_string_actions
    if "-o" in known:
        assert known["-o"].option_strings == ["-o", "--output"]
        assert "figure" not in known["-o"].help
        others = {"render": ("x.pdf", "ends in .png"), "draw": ("x.zmx", "is no drawing")}
        others["report"] = ("x.png", "is no report")
        wrong, said = others.get(name, ("x.png", "is a picture: figures are saved by"))
        with pytest.raises(argparse.ArgumentTypeError, match=said):
            known["-o"].type(wrong)
    if "--size" in known and known["--size"].help != argparse.SUPPRESS:
        assert known["--size"].help.startswith("pixels across")
    if "--plot" in known:
        assert known["--plot"].type is picture_file


@pytest.mark.parametrize("option", ["--field", "--object-distance", "--wavelength"])
def test_conditions_take_several_values(option):
    taken = {name: action for name, action in actions(option).items() if action is not None}
    assert len(taken) > 10
    assert {action.nargs for action in taken.values()} == {"+"}


def test_field_points_may_lie_off_the_axis_of_y(command):
    words = ("spot", "double_gauss", "--rings", 4, "--json", "--wavelength", 0.55, "--field")
    code, out, err = command(*words, 7, "-7", "-7,0", "-3,4", "4,-3", "-1e-3")
    assert code == 0, err
    found = json.loads(out)["results"]
    assert [one["field"] for one in found] == [[0, 7], [0, -7], [-7, 0], [-3, 4], [4, -3], [0, -0.001]]
    radii = [one["rms_radius_um"] for one in found]
    assert radii[1] == pytest.approx(radii[0], rel=1e-12)  # a lens of revolution
    assert radii[2] == pytest.approx(radii[0], rel=1e-9)
    assert radii[3] == pytest.approx(radii[4], rel=1e-9)
    assert found[2]["centroid"] == pytest.approx([found[1]["centroid"][1], 0], abs=1e-12)


def test_several_object_distances_are_one_result_each(command):
    words = ("info", "double_gauss", "--json", "--object-distance")
    both = json.loads(command(*words, 25000, "inf")[1])["results_by_object_distance"]
    alone = [json.loads(command(*words, distance)[1]) for distance in (25000, "inf")]
    assert both == [{"object_distance": 25000, **alone[0]}, {"object_distance": None, **alone[1]}]
    code, out, err = command("ray-fan", "tessar", "--object-distance", 1000.5, "inf", "--plot", "fan.png")
    assert code == 0, err
    assert re.findall("^object at .*", out, re.M) == ["object at 1000.5 mm", "object at infinity"]
    names = sorted(path.name for path in Path().glob("*.png"))
    assert names == ["fan_1000.5mm.png", "fan_infinity.png"]
    assert all(f"written: {name}" in err for name in names)


def test_the_ray_table_of_a_spot_holds_its_spot(command):
    """The weighted moments of the rows are the spot; rays that are lost are named, without a place."""
    words = ("spot", "double_gauss", "--field", "3,13", 0, "--rings", 5)
    code, out, err = command(*words, "--json", "-o", "rays.csv")
    assert code == 0, err
    table = pandas.read_csv("rays.csv")
    assert [*table][-2:] == ["weight", "status"]
    assert table.groupby(["field_x", "field_y"]).weight.sum().tolist() == pytest.approx([1, 1])
    for found in json.loads(out)["results"]:
        rows = table[(table.field_y == found["field"][1]) & (table.wavelength == found["wavelength"])]
        assert len(rows) == found["launched"]
        assert (rows.status == "vignetted").sum() == found["vignetted"]
        rows = rows[rows.status == "ok"]
        assert len(rows) == found["rays"]
        centre = [np.average(rows[name], weights=rows.weight) for name in "xy"]
        assert centre == pytest.approx(found["centroid"], abs=1e-12)
        square = (rows.x - centre[0]) ** 2 + (rows.y - centre[1]) ** 2
        radius = 1e3 * math.sqrt(np.average(square, weights=rows.weight))
        assert radius == pytest.approx(found["rms_radius_um"], rel=1e-9)
    for words in (("-o", "rays.npz"), ("--rays", "100", "-o", "rays.csv")):
        assert command("spot", "double_gauss", *words)[0] == 1
    assert [path.name for path in Path().iterdir()] == ["rays.csv"]


def test_fates_of_a_ray_table_are_those_that_rays_are_counted_by():
    lens = read_lens(find_lens("cooke_triplet"))
    field = torch.tensor([[0.0, 0.0], [80.0, 25.0]], dtype=torch.float64)
    points, weights = hexapolar(4)
    found, lost = arrivals(lens, points, weights, fields=field), ray_failures(lens, points, fields=field)
    for place, name in enumerate(LOST):
        counted = (found.status == STATUS.index(name)).sum(-1)
        assert counted.tolist() == lost.lost[place].sum(0).tolist(), name
    assert not (found.status[0] == 0).any()
    assert torch.equal(found.rays.valid, found.status == 0)
    shown = found.to_frame()
    assert not shown[shown.status.isin(["miss", "tir", "unaimed"])].x.notna().any()


def test_chief_and_marginal_rays_are_labelled(command):
    words = ("trace", "double_gauss", "--object-distance", 25000, "inf", "--field", "3,4", 10, "--wavelength", 0.5, 0.6)
    code, out, err = command(*words)
    assert code == 0, err
    table = pandas.read_csv(io.StringIO(out))
    names = ["object_distance", "field_x", "field_y", "wavelength", "pupil_x", "pupil_y"]
    assert ",".join(table) == ",".join(["ray,surface,x,y,z,l,m,n,opl,status", *names])
    first = table[table.surface == 1]
    assert len(first) == first.ray.nunique() == len(first[names].drop_duplicates()) == 2 * 2 * 2 * 4
    chief = (first.pupil_x == 0) & (first.pupil_y == 0)
    # From infinity, in air, the direction in front of surface 1 is the field; behind it the ray still leans that way.
    assert (first[chief & (first.field_x == 0)].l == 0).all()
    assert (first[chief & (first.field_x == 3)].l > 0).all()
    rows = json.loads(command(*words, "--json")[1])["results"]
    assert {row["object_distance"] for row in rows} == {25000, None}
    one = command("trace", "double_gauss", "--object-distance", "inf", "--field", 10, "--wavelength", 0.5)[1]
    alone = pandas.read_csv(io.StringIO(one))
    same = table[(table.object_distance == math.inf) & (table.field_y == 10) & (table.wavelength == 0.5)]
    assert alone.drop(columns="ray").equals(same.drop(columns="ray").reset_index(drop=True))


def test_rays_of_a_table_keep_their_form(command):
    Path("in.csv").write_text("x,y,z,l,m,n\n0,1,-5,0,0,1\n")
    code, out, err = command("trace", "singlet", "--rays", "in.csv", "--field", 3)
    assert code == 0
    assert out.splitlines()[0] == "ray,surface,x,y,z,l,m,n,opl,status"
    assert "change nothing" in err
    Path("in.csv").write_text("x,y,z,l,m,n\n")
    assert command("trace", "singlet", "--rays", "in.csv")[1] == "ray,surface,x,y,z,l,m,n,opl,status\n"


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        ("spto", 2, "did you mean spot?"),
        ("wave psff", 2, "did you mean psf?"),
        ("spot duble_gauss", 1, "did you mean double_gauss?"),
        ("spot DOUBLE_GAUS", 1, "did you mean double_gauss?"),
        ("spot mien.zmx", 1, "did you mean mine.zmx?"),
        ("spot double_gauss --sampling gaus", 2, "did you mean gauss?"),
        ("seidel tessar --csv seidel.csv", 2, "unknown option --csv; tables are saved by -o FILE.csv"),
        ("seidel tessar -o seidel.txt", 1, "seidel.txt"),
        ("layout double_gauss -o layout.png", 2, "unknown option -o; figures are saved by --plot"),
        ("spot double_gauss --plto spot.png", 2, "unknown option --plto; did you mean --plot?"),
        ("wave psf --elment=cubic", 2, "unknown option --elment; did you mean --element?"),
        ("wave psf --element cubc", 1, "did you mean cubic?"),
        ("codesign double_gauss --field 5,5 --loss spectral", 1, "co-design takes field points along y"),
        ("psf double_gauss -o psf.png", 2, "'psf.png' is a picture: figures are saved by --plot"),
        ("mtf tessar --plot mtf.npz", 2, "'mtf.npz' is no picture (.png, .pdf, .svg)"),
        ("spot double_gauss --field 1,2,3", 2, "'1,2,3' is not a field point, Y or X,Y"),
        ("spot double_gauss --field 0,91", 1, "--field 91: a field angle is below 90 degrees"),
        ("spot double_gauss --points 30", 1, "gauss takes --rings"),
        ("spot double_gauss --sampling sobol --rings 3", 1, "sobol takes --points"),
    ],
)
def test_errors_suggest_similar_options(command, words, code, message):
    Path("mine.zmx").write_text("not read")
    found, out, err = command(*words.split())
    assert (found, out) == (code, "")
    assert message in err
    assert err.count("\n") == 1
    assert [path.name for path in Path().iterdir()] == ["mine.zmx"]


def test_without_a_similar_option_there_is_no_suggestion():
    assert did_you_mean("--colour", ["--field", "--plot"]) == ""
    assert did_you_mean("Plot", ["plot"]) == "; did you mean plot?"
    assert set(PICTURES) == {".png", ".pdf", ".svg"}


@pytest.mark.parametrize(
    ("analysis", "lens"),
    [
        pytest.param(analysis, lens, marks=pytest.mark.slow if lens == "phone" and analysis != "mtf" else ())
        for analysis in ("mtf", "ray-fan", "opd-fan", "wavefront", "distortion", "encircled-energy", "incidence")
        for lens in ("phone", "hubble", "telephoto")
    ],
)
def test_a_field_out_of_reach_is_reported_with_cause_and_help(command, analysis, lens):
    field = 5 if lens == "hubble" else 60
    code, out, err = command(analysis, lens, "--field", field, "--plot", "figure.png")
    assert (code, out) == (1, "")
    assert f"{lens}: no ray of field {field} degrees reaches the sensor: all 217 rays lost: " in err
    assert "at surface" in err or "missed surface" in err
    assert re.search(r"the fields of the lens reach [\d.]+ degrees, give --field within", err)
    assert err.count("\n") == 1
    assert not [*Path().iterdir()]


def test_curves_show_the_reachable_fields_and_report_the_others(command):
    code, out, err = command("ray-fan", "tessar", "--field", 0, 80, "--points", 3, "--json")
    assert code == 0
    assert "warning: no ray of field 80 degrees reaches the sensor" in err
    rows = json.loads(out)["results"]
    assert {row["tangential"] is None for row in rows if row["field_y"] == 80} == {True}
    assert {row["tangential"] is None for row in rows if row["field_y"] == 0} == {False}


FLAT = "# wavelengths: 0.5 0.6\n# fields: angle 0 5\nsurface,radius,thickness,glass,diameter,stop\n"
FLAT += "0,inf,inf,,,\n1,inf,5,N-BK7,10,1\n2,inf,50,,10,\n3,inf,0,,,\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "lateral-colour hubble",
            "lateral colour is a difference of wavelengths, and there is one, 0.6328 µm; give",
        ),
        ("distortion hubble --field 0", "all fields are on the axis; give others by --field"),
        ("lateral-colour tessar --field 0", "all fields are on the axis; give others by --field"),
        ("field-curvature tessar --field 0 --plot curvature.png", "all fields are on the axis; give others by --field"),
        ("field-curvature flat.csv", "no number of field curvature exists for this lens"),
        (
            "compare-models hubble",
            "within the focal length, or the lens diverges (paraxial image at -1068.25 mm); its focal len",
        ),
        ("compare-models hubble --focus-distance inf", "give --focus-distance and --object-distance beyond, or inf"),
    ],
)
def test_an_analysis_without_results_is_reported(command, words, message):
    Path("flat.csv").write_text(FLAT)
    code, out, err = command(*words.split())
    assert (code, out) == (1, "")
    assert message in err
    assert [path.name for path in Path().iterdir()] == ["flat.csv"]


def test_close_rays_of_a_field_in_any_meridian_have_the_foci_of_its_own(command):
    """A lens of revolution: the sections of a field turn with it."""
    code, out, err = command("field-curvature", "tessar", "--field", 9, "9,0", "-9,0", "--json")
    assert code == 0, err
    upright, *turned = [[row for row in json.loads(out)["results"] if row["field_x"] == x] for x in (0, 9, -9)]
    for rows in turned:
        for name in ("tangential", "sagittal"):
            assert [row[name] for row in rows] == pytest.approx([row[name] for row in upright], rel=1e-7)
    assert upright[0]["tangential"] != pytest.approx(upright[0]["sagittal"], rel=0.1)


def test_a_thinned_table_states_its_number_of_points(command):
    for name, points, listed in (("ray-fan", 41, 9), ("opd-fan", 21, 5)):
        out = command(name, "tessar", "--field", 0, "--wavelength", 0.55, "--points", points)[1]
        assert out.splitlines()[-1] == f"{listed} of {points} points of each curve; --json lists all"
        assert len(out.splitlines()) == 2 + listed + 1
    assert "points of each curve" not in command("ray-fan", "tessar", "--points", 9)[1]


PARABOLA = "# wavelengths: 0.5\n# fields: angle 0 1\nsurface,radius,thickness,glass,conic,diameter,stop\n"
PARABOLA += "0,inf,inf,,,,\n1,-200,-100,MIRROR,-1,20,1\n2,inf,0,,,,\n"


def test_axes_do_not_magnify_rounding(tmp_path):
    """A parabola's image of infinity is perfect: its fans lie on the axis of a scale that means something."""
    (tmp_path / "parabola.csv").write_text(PARABOLA)
    lens = read_lens(tmp_path / "parabola.csv")
    axis = torch.zeros(2, 1, dtype=torch.float64)
    for found in (ray_fan(lens, fields=axis), opd_fan(lens, fields=axis)):
        assert float(found.tangential.abs().max()) < 1e-9
        panels = found.plot().axes
        assert panels[0].get_ylim()[1] >= 1e-4
        assert "everywhere" in panels[0].texts[0].get_text()
    off_axis = ray_fan(lens, fields=axis + 1)
    assert not off_axis.plot().axes[0].texts
    off_line = distortion(lens, fields=[(0, 1), (1, 0)])
    assert off_line.plot().axes[0].lines[0].get_marker() == "o"  # few fields: points are seen


# -- the table of options and the functions ----------------------------------------------------------------------------

#: Parameters without an option, and why.
NO_OPTION = {
    **dict.fromkeys(("progress", "watch", "share"), "given by the runner"),
    **dict.fromkeys(("path", "catalogs"), "files, by LENS and --catalog"),
    **dict.fromkeys(("lens", "pupil", "grid", "elements", "tolerances"), "an object; LENS is the lens"),
    **dict.fromkeys(("execution", "as_built", "merit"), "an object, whose fields have options"),
    "window": "the kernels of a picture of the whole field, in Python",
}
#: Parameters of one command's function without an option: a loss is a function of Python.
OF_PYTHON = {
    "optimize": {"loss", "of", "object_distances", "first", "restarts", "check_rings"},
    "search": {"loss", "of", "object_distances"},
    "compare": {"names"},
    "report": {"path"},
}
#: Functions whose parameters are options of a command, by a parameter of its public function that holds them.
PARTS = {
    "merit": (merit_of_options, DefaultMerit, Merit.of),
    "as_built": (rt.tolerancing.AsBuilt,),
    "sensor": (rt.Sensor, rt.Sensor.capture, read_depth),
    "model": (rt.psf_models.DRT, rt.psf_models.Paraxial),
    "execution": (Execution,),
}
#: Options of the runner of one command.
OF_ONE_RUN = {"render": {"png_bits", "raw"}, "psf": {"cross_section"}}

VERBS = [command for command in (*COMMANDS, *WAVE_COMMANDS) if command.verb in rt.PUBLIC]


def rows(command):
    """The actions of a command by their destination, help aside."""
    parser = argparse.ArgumentParser(add_help=False)
    options.add(parser, command.options)
    return {action.dest: action for action in parser._actions}


def parameters(*functions):
    return {name for function in functions for name in inspect.signature(function).parameters}


@pytest.mark.parametrize("command", VERBS, ids=lambda command: command.name)
def test_options_are_the_parameters_of_the_function(command):
    keywords, actions = inspect.signature(rt.public_name(command.verb)).parameters, rows(command)
    parts = {name for part, functions in PARTS.items() if part in keywords for name in parameters(*functions)}
    names = {name for name in actions if not name.startswith("plot_")} - OF_ONE_RUN.get(command.name, set())
    assert names - {*RUNNER_OPTIONS} <= {*keywords} | parts
    assert {*keywords} - {*actions} <= {*NO_OPTION} | OF_PYTHON.get(command.name, set())


@pytest.mark.parametrize("command", VERBS, ids=lambda command: command.name)
def test_defaults_of_options_are_those_of_the_function(command):
    actions = rows(command)
    for name, parameter in inspect.signature(rt.public_name(command.verb)).parameters.items():
        if name in actions and name not in RUNNER_OPTIONS:
            default, stated = parameter.default, actions[name].default
            if stated is None and default not in (None, inspect.Parameter.empty):  # the function's own
                assert "default" in actions[name].help or name in ("fields", "wavelengths"), name
            elif stated is not None:
                assert stated == default, name


def test_choices_are_the_rows_of_the_tables_of_the_package():
    assert (*MODELS,) == options.MODELS
    assert (*GRADES,) == options.GRADES
    by_name = {command.name: rows(command) for command in COMMANDS}
    assert by_name["optimize"]["merit"].choices == (*KINDS,)
    assert by_name["render"]["mosaic"].choices == ("none", *PATTERNS)


def literals(annotation):
    """The choices of an annotation Literal[…], also within a union."""
    parts = typing.get_args(annotation)
    return parts if typing.get_origin(annotation) is typing.Literal else sum(map(literals, parts), ())


@pytest.mark.parametrize("command", VERBS, ids=lambda command: command.name)
def test_choices_are_those_of_the_annotation(command):
    actions = rows(command)
    for name, parameter in inspect.signature(rt.public_name(command.verb)).parameters.items():
        if name in actions and (choices := literals(parameter.annotation)):
            assert (*actions[name].choices,) == choices, name


def test_the_command_line_reads_no_source_and_imports_no_function():
    """No docstring or annotation can change a command: the modules of the functions are neither loaded nor read."""
    code = """
import builtins, io, pathlib, sys
from raytrace import cli
from raytrace.cli import commands
builtins.open = io.open = pathlib.Path.read_text = None
cli.version = str
cli.build_parser()
print(*sorted(name for name in sys.modules if name.startswith("raytrace.") and not name.startswith("raytrace.cli.")))
"""
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert loaded == ["raytrace.budget", "raytrace.cli", "raytrace.files", "raytrace.settings", "raytrace.words"]


@pytest.mark.parametrize("command", [*COMMANDS, *WAVE_COMMANDS], ids=lambda command: command.name)
def test_every_option_has_a_help_text(command):
    assert all(action.help for action in rows(command).values())


def test_the_viewer_opens_a_lens_at_an_object_distance(command, monkeypatch):
    lenses = []
    monkeypatch.setattr("raytrace.viewer.server.serve", lambda lens, **options: lenses.append(lens))
    assert command("view", "double_gauss", "--object-distance", 500) == (0, "", "")
    assert float(lenses[0].surfaces[0].thickness) == 500


def test_options_of_other_commands_are_not_built():
    def count(parser):
        (commands,) = (a for a in parser._actions if isinstance(a, argparse._SubParsersAction))
        return {name: len(child._actions) for name, child in commands.choices.items()}

    every, one = count(build_parser()), count(build_parser("mtf"))
    assert one["mtf"] == every["mtf"] > 10
    assert {name for name, number in one.items() if number > 1} == {"mtf"}


def test_the_table_of_an_analysis_is_written_by_o(command):
    assert command("seidel", "singlet", "-o", "seidel.csv")[0] == 0
    rows = csv.DictReader(io.StringIO(Path("seidel.csv").read_text()))
    expected = rt.seidel("singlet").to_frame()
    assert [float(row["S1"]) for row in rows] == expected["S1"].tolist()
    assert command("distortion", "singlet", "--field", "1", "-o", "distortion.json")[0] == 0
    assert json.loads(Path("distortion.json").read_text()) == rt.distortion("singlet", fields=[1]).document()


def test_an_option_is_named_as_its_reader_writes_it():
    assert option("ray_aiming", "real") == "`ray_aiming=real`"
    with in_command({"ray_aiming": "--ray-aiming", "fields": "--field"}):
        assert option("ray_aiming", "real") == "--ray-aiming real"
        assert option("fields") == "--field"
        assert option("tol", 0.1) == "`tol=0.1`"  # not an option of that command
        assert with_options("fewer {fields}, {ray_aiming=off}") == "fewer --field, --ray-aiming off"
    assert option("fields") == "`fields`"


def sentences(tree):
    """Texts of a module, docstrings aside, with their lines."""
    nodes = [*ast.walk(tree)]
    docstrings = {id(node.value) for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if isinstance(node, ast.Constant) and isinstance(node.value, str) and id(node) not in docstrings:
            yield node.value, node.lineno


def test_messages_name_options_by_a_function():
    """`words.option("fields")` is --field in a command, and `fields` in Python; names of functions stay."""
    package, names = Path(rt.__file__).parent, {name for command in COMMANDS for name in rows(command)}
    others = ("cli/commands.py", "optimization/operands/", "imaging/camera.py", "io/__init__.py", "bench/")
    offenders = [
        f"{path.relative_to(package)}:{line}: `{word}`"
        for path in sorted(package.rglob("*.py"))
        if not str(path.relative_to(package)).startswith(others)
        for text, line in sentences(parsed(path))
        for word in re.findall(r"`(\w+)(?:=[^`]*)?`", text)
        if word in names and word not in rt.PUBLIC
    ]
    assert not offenders, "\n".join(offenders)

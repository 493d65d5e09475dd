"""Constraints of an optimisation as words: each word names a quantity of the lens."""

import dataclasses
import math
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from problems import vector

import raytrace as rt
from raytrace.materials.glass import is_air
from raytrace.optimization.attained import attained
from raytrace.optimization.conditions import WORDS, BadHold, conditions_of
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import Problem
from raytrace.optimization.variables import DesignVariables
from raytrace.system.lens import Fields, is_round_about_axis
from raytrace.system.optimization_data import Row, Vary
from raytrace.tracing.f_number import working_f_number
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import trace_lens


def value(lens, hold):
    (one,) = conditions_of(lens, hold)
    assert one.row.weight == 0
    return float(Evaluation(DesignVariables(lens), [one.row])(np.zeros(0)).values[0])


def chief_height(lens):
    rays = launch(lens, torch.zeros(2, 1, dtype=torch.float64))  # the centre of the pupil, of every field
    return float(trace_lens(lens, rays, lens.wavelengths[:, None]).position[1].max())


EXPECTED = {
    "efl=1": lambda lens: float(rt.first_order(lens).effective_focal_length),
    "f_number=1": lambda lens: float(rt.first_order(lens).f_number),
    "total_track<=1": lambda lens: sum(float(surface.thickness) for surface in lens.surfaces[1:-1]),
    "bfd>=1": lambda lens: float(lens.surfaces[-2].thickness),
    "thickness:3-5=1": lambda lens: sum(float(lens.surfaces[k].thickness) for k in (3, 4, 5)),
    "thickness:6<=1": lambda lens: float(lens.surfaces[6].thickness),
    "image_height=1": chief_height,
    "entrance_pupil_diameter=1": lambda lens: float(rt.first_order(lens).entrance_pupil_diameter),
    "entrance_pupil=1": lambda lens: float(rt.first_order(lens).entrance_pupil_position),
    "REAY(12,0,0,1,0,0)=1": chief_height,
    "EFFL(0,1)=1": lambda lens: float(
        rt.first_order(lens.at(wavelengths=[float(lens.wavelengths[0])])).effective_focal_length
    ),
}


@pytest.mark.parametrize("hold", EXPECTED)
def test_a_word_names_a_number_of_the_lens(lens, hold):
    assert value(lens, hold) == pytest.approx(EXPECTED[hold](lens), rel=1e-9)


def primary_of(values, lens):
    return float(values[..., lens.primary_wavelength - 1].reshape(-1)[-1])


def largest_of(lens):
    """The largest field: along y, or the outermost where the lens is not round."""
    if is_round_about_axis(lens):
        return torch.hypot(lens.fields.x, lens.fields.y).max()[None]
    k = int(torch.hypot(lens.fields.x, lens.fields.y).argmax())
    return torch.stack([lens.fields.x[k], lens.fields.y[k]])[:, None]


def distortion_of(lens):
    curve = rt.distortion(lens)
    return 100 * float(curve.f_tan[:, lens.primary_wavelength - 1].abs().max())


def between_colours(curve, lens):
    return float(curve[lens.wavelengths.argmin()] - curve[lens.wavelengths.argmax()])


def focal_shift(lens):
    low, high = rt.chromatic_focal_shift(lens, samples=2).shift
    return float(low - high)


def paraxial_height(lens):
    data, size = rt.first_order(lens), float(torch.hypot(lens.fields.x, lens.fields.y).max())
    if lens.fields.kind in ("paraxial_image_height", "real_image_height"):
        return size
    if lens.fields.kind == "angle" and not math.isfinite(float(lens.surfaces[0].thickness)):
        return float(data.effective_focal_length) * math.tan(math.radians(size))
    if lens.fields.kind == "angle":
        distance = float(lens.surfaces[0].thickness + data.entrance_pupil_position)
        size = -distance * math.tan(math.radians(size))
    return float(data.magnification) * size


def extent(lens):
    """From the first to the last vertex of a straight axis."""
    places = np.cumsum([0.0, *(float(surface.thickness) for surface in lens.surfaces[1:-1])])
    return float(np.ptp(places))


def chief_angle(lens):
    angle = rt.incidence(lens, fields=largest_of(lens)).angle
    return abs(float(angle[0, 0, 1, -1]))


#: The number of the public analysis of each word.
ANALYSES = {
    "efl": lambda lens: float(rt.first_order(lens).effective_focal_length),
    "f_number": lambda lens: float(rt.first_order(lens).f_number),
    "working_f_number": lambda lens: float(working_f_number(lens)),
    "numerical_aperture": lambda lens: float(rt.first_order(lens).image_na),
    "magnification": lambda lens: float(rt.first_order(lens).magnification),
    "angular_magnification": lambda lens: float(rt.first_order(lens).angular_magnification),
    "total_track": extent,
    "bfd": lambda lens: float(lens.surfaces[-2].thickness),
    "image_height": lambda lens: abs(primary_of(rt.distortion(lens, fields=largest_of(lens)).height, lens)),
    "paraxial_image_height": paraxial_height,
    "distortion": distortion_of,
    "petzval_radius": lambda lens: float(rt.first_order(lens).petzval_radius),
    "entrance_pupil_diameter": lambda lens: float(rt.first_order(lens).entrance_pupil_diameter),
    "entrance_pupil": lambda lens: float(rt.first_order(lens).entrance_pupil_position),
    "exit_pupil": lambda lens: float(rt.first_order(lens).exit_pupil_position),
    "chief_ray_angle": chief_angle,
    "lateral_colour": lambda lens: between_colours(rt.lateral_colour(lens, fields=largest_of(lens)).shift[0], lens),
    "axial_colour": focal_shift,
}


def with_image_fields(lens):
    fields = Fields("real_image_height", vector(0.0, 0.0, 3.0), vector(0.0, 10.0, 18.0), torch.ones(3).double())
    return dataclasses.replace(lens, fields=fields)


#: Vignetting, real aiming, an object near by, fields along x, aspheres, fields that are images, mirrors, bent axes.
ZOO = {
    "cooke_triplet": lambda lens: lens,
    "retrofocus": lambda lens: lens,
    "double_gauss_28deg": lambda lens: lens.at(object_distance=1500.0),
    "tessar": lambda lens: dataclasses.replace(lens.at(fields=[(0.0, 0.0), (7.0, 3.0)]), ray_aiming="real"),
    "phone": lambda lens: lens,
    "double_gauss": lambda lens: with_image_fields(lens.at(wavelengths=[0.5, 0.6])),
    "hubble": lambda lens: lens.at(wavelengths=[0.5, 0.7]),
    "folded_relay": lambda lens: lens,
    "off_axis_telescope": lambda lens: lens.at(wavelengths=[0.5, 0.7]),
}


@pytest.mark.parametrize("name", ZOO)
def test_a_condition_reports_the_number_of_the_analysis_of_its_name(name):
    lens = ZOO[name](rt.read_lens(name))
    conditions = conditions_of(lens, ["distortion<=9%" if word == "distortion" else f"{word}<=1e9" for word in WORDS])
    model = DesignVariables(lens, (Vary(1, "curvature"),))
    problem = Problem(model, [Row("EFFL", target=1.0, weight=1.0)], conditions)
    numbers = {one.name: one.reached for one in attained(problem, problem.evaluated(model.start))}
    assert [*numbers] == [*WORDS] == [*ANALYSES]
    expected = {word: analysis(lens) for word, analysis in ANALYSES.items()}
    assert numbers.pop("distortion") == pytest.approx(expected.pop("distortion"), rel=1e-7, abs=1e-8)
    assert numbers == pytest.approx(expected, rel=1e-8, abs=1e-10)


def test_a_limit_reports_the_number_that_is_reached_and_not_its_target():
    lens = rt.read_lens("cooke_triplet")
    hold = "efl=101.2 distortion<=2% MNCG(1,7)>=1"
    found = rt.optimize(lens, merit="spot", vary="curvature sensor", hold=hold, cycles=3)
    numbers = {one.name: one.reached for one in found.conditions}
    assert numbers["distortion"] == pytest.approx(distortion_of(found.lens), rel=1e-9)
    assert numbers["distortion"] < 1.9
    least = min(float(surface.thickness) for surface in found.lens.surfaces[1:-1] if not is_air(surface.glass))
    assert numbers["MNCG(1,7)"] == pytest.approx(least, rel=1e-9)


def test_distortion_is_held_over_the_whole_field():
    """A limit is kept by the field of the largest distortion, which is none that the lens lists."""
    lens = rt.read_lens("phone")
    limit = 0.9 * distortion_of(lens)
    found = rt.optimize(lens, merit="spot", vary="curvature a4", hold=f"distortion<={limit!r}%", cycles=20)
    (condition,) = found.conditions
    assert condition.met
    assert condition.reached == pytest.approx(distortion_of(found.lens), rel=1e-7)
    assert condition.reached <= limit * (1 + 1e-6)


def test_magnification_is_of_an_object_near_by(lens):
    near = lens.at(object_distance=300)
    assert value(near, "magnification=-0.5") == pytest.approx(float(rt.first_order(near).magnification), rel=1e-9)


def test_every_word_is_an_operand_that_is_known():
    assert {word.operand for word in WORDS.values()} <= {*OPERANDS}


def test_the_page_lists_every_word():
    page = (Path(__file__).parents[1] / "docs" / "reference" / "merit.md").read_text(encoding="utf-8")
    assert all(f"| `{name}` | {word.operand} | {word.text}" in page for name, word in WORDS.items())


def test_conditions_are_rows_and_relations(lens):
    text = "efl = 50 total_track<=80 distortion <= 2 % bfd≥30 f_number==4 image_height=21.6mm"
    found = conditions_of(lens, text)
    assert [(one.row.operand, one.relation, one.row.target) for one in found] == [
        ("EFFL", "=", 50),
        ("TOTR", "<=", 80),
        ("DIMX", "<=", 2),
        ("TTHI", ">=", 30),
        ("ISFN", "=", 4),
        ("REAR", "=", 21.6),
    ]
    assert found[3].row.integers == (11, 11)
    assert found[5].row.numbers == (0, 1, 0, 0)
    assert conditions_of(lens, None) == ()
    assert conditions_of(lens, ["efl=50", "f_number=4 bfd>=30"])[2].row.operand == "TTHI"


def test_a_condition_may_be_of_one_configuration(lens):
    zoom = lens.with_configurations(thickness={6: [12.4281, 16.0]})
    found = conditions_of(zoom, "efl@1=50 efl@2=100 total_track<=200")
    assert [one.configuration for one in found] == [1, 2, 0]


def test_a_name_alone_keeps_the_number_of_the_lens(lens):
    zoom = lens.with_configurations(thickness={6: [12.4281, 16.0]})
    kept, track, limit = conditions_of(zoom, "efl@2 total_track distortion")
    second = zoom.configuration(2)
    assert kept.row.target == pytest.approx(float(rt.first_order(second).effective_focal_length), rel=1e-12)
    assert track.row.target == pytest.approx(sum(float(surface.thickness) for surface in lens.surfaces[1:-1]))
    assert (kept.relation, kept.configuration, limit.relation) == ("=", 2, "<=")
    result = rt.optimize(lens, merit="spot", vary="curvature:1-4", hold="efl", cycles=2)
    focal_length = rt.first_order(lens).effective_focal_length
    assert float(rt.first_order(result.lens).effective_focal_length) == pytest.approx(float(focal_length), rel=1e-8)


def test_a_number_that_a_lens_does_not_have_is_not_kept(lens):
    afocal = lens.replace(11, curvature=math.inf)
    with pytest.raises(BadHold, match="keeps the number of the lens as it is, which is nan"):
        conditions_of(afocal, "efl")


@pytest.mark.parametrize(
    ("hold", "said"),
    [
        ("efl>", "expected a name, = or <= or >=, and a number"),
        ("efl=long", "'long' is no number in mm"),
        ("efl=inf", "'inf' is no number"),
        ("f_number=4mm", "'4mm' is no number"),
        ("f_numbr=50", "did you mean f_number?"),
        ("focal_length=50", "nothing to hold; expected one of efl, f_number"),
        ("focal_length=50", "did you mean efl?"),
        ("bfl>=30", "did you mean bfd?"),
        ("distortion=2%", "expected distortion<=2%"),
        ("MNEG(1,6)<=1", "MNEG(1,6) is a limit on one side; expected MNEG(1,6)>=1"),
        ("EFFK=50", "did you mean EFFL?"),
        ("REAY(1.5,0)=2", "expected two whole numbers"),
        ("REAY(8,0,x)=2", "expected two whole numbers"),
        ("thickness:12=2", "gaps behind surfaces 0 to 11"),
        ("efl@2=50", "configuration 2; this lens has 1"),
    ],
)
def test_impossible_constraints_are_refused(lens, hold, said):
    with pytest.raises(BadHold, match=re.escape(said)):
        conditions_of(lens, hold)


def test_without_a_field_off_the_axis_there_is_no_image_height(lens):
    with pytest.raises(BadHold, match="all fields are on the axis"):
        conditions_of(lens.at(fields=[0]), "image_height=20")


# -- held while a lens is optimised ------------------------------------------------------------------------------------


def test_constraints_are_met_by_an_optimised_lens():
    lens = rt.read_lens("cooke_triplet")
    track = sum(float(surface.thickness) for surface in lens.surfaces[1:-1])
    hold = f"efl=99 total_track<={track - 0.5} thickness:1=3.2"
    found = rt.optimize(lens, merit="spot", vary="curvature thickness:1 sensor", hold=hold, cycles=12)
    assert float(rt.first_order(found.lens).effective_focal_length) == pytest.approx(99, rel=1e-8)
    assert sum(float(surface.thickness) for surface in found.lens.surfaces[1:-1]) <= track - 0.5 + 1e-8
    assert float(found.lens.surfaces[1].thickness) == pytest.approx(3.2, rel=1e-9)


def test_a_zoom_lens_is_held_in_each_configuration():
    lens = rt.read_lens("double_gauss").with_configurations(thickness={6: [12.4281, 14.0], 11: [57.9, 57.0]})
    lengths = [float(rt.first_order(one).effective_focal_length) for one in lens.configurations]
    hold = f"efl@1={lengths[0] - 0.5} efl@2={lengths[1] + 0.5}"
    found = rt.optimize(lens, merit="spot", vary="curvature thickness:6 sensor", hold=hold, cycles=8)
    after = [float(rt.first_order(one).effective_focal_length) for one in found.lens.configurations]
    assert after == pytest.approx([lengths[0] - 0.5, lengths[1] + 0.5], rel=1e-7)


def test_constraints_are_in_millimetres_for_a_merit_function_in_inches():
    lens = rt.read_lens("cooke_triplet")
    inches = rt.Merit(rt.Merit.default(lens).rows, 25.4)
    found = rt.optimize(lens, merit=inches, vary="curvature sensor", hold="efl=99", cycles=6)
    assert float(rt.first_order(found.lens).effective_focal_length) == pytest.approx(99, rel=1e-8)

"""Constraints of an optimisation as words: each word names a quantity of the lens."""

import re
from pathlib import Path

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.optimization.merit import Evaluation
from raytrace.optimization.operands.table import OPERANDS
from raytrace.optimization.problem import WORDS, BadHold, conditions_of
from raytrace.optimization.variables import Model
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import trace_lens


def value(lens, hold):
    (one,) = conditions_of(lens, hold)
    assert one.row.weight == 0
    return float(Evaluation(Model(lens), [one.row])(np.zeros(0)).values[0])


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


def test_magnification_is_of_an_object_near_by(lens):
    near = lens.at(object_distance=300)
    assert value(near, "magnification=-0.5") == pytest.approx(float(rt.first_order(near).magnification), rel=1e-9)


def test_every_word_is_an_operand_that_is_known():
    assert {word.operand for word in WORDS.values()} <= {*OPERANDS}


def test_the_page_lists_every_word():
    page = (Path(__file__).parents[1] / "docs" / "merit.md").read_text(encoding="utf-8")
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


@pytest.mark.parametrize(
    ("hold", "said"),
    [
        ("efl", "expected a name, = or <= or >=, and a number"),
        ("efl=long", "'long' is no number in mm"),
        ("efl=inf", "'inf' is no number"),
        ("f_number=4mm", "'4mm' is no number"),
        ("f_numbr=50", "did you mean f_number?"),
        ("focal_length=50", "nothing to hold; expected one of efl, f_number"),
        ("focal_length=50", "did you mean efl?"),
        ("bfl>=30", "did you mean bfd?"),
        ("distortion=2%", "expected distortion<=2%"),
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

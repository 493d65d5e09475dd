"""Compensators within the conditions of a lens."""

import math

import pytest
import torch

import raytrace as rt
from raytrace.optimization.attained import attained_by
from raytrace.system.tolerance_data import Compensator
from raytrace.tolerancing.compensators import within_conditions
from raytrace.tolerancing.study import with_changes

GAP = 12.93  # behind surface 2 of the Cooke triplet, mm


@pytest.mark.parametrize(
    ("condition", "least", "most"),
    [
        ("air_thickness>=12.5", 12.5 - GAP, math.inf),
        ("air_thickness:2-3<=13", -math.inf, 13 - GAP),
        ("thickness:2>=12.9", 12.9 - GAP, math.inf),
        ("glass_thickness>=12.5", -math.inf, math.inf),  # a gap of air
        ("air_thickness:4>=1", -math.inf, math.inf),  # another gap
        ("thickness:2-3<=15.5", -math.inf, math.inf),  # of two gaps
        ("thickness:2=12.93", -math.inf, math.inf),  # exact values hold for the nominal lens
        ("total_track<=117", -math.inf, math.inf),
        ("air_thickness>=13", -math.inf, math.inf),  # which the lens does not meet
        ("off:air_thickness>=12.5", -math.inf, math.inf),
        ("MNCT(1,4,0,0,0,0)>=12.5", 12.5 - GAP, math.inf),
        ("CTLT(2,0,0,0,0,0)<=13", -math.inf, 13 - GAP),
    ],
)
def test_a_condition_on_the_gap_limits_the_compensator(condition, least, most):
    lens = rt.read_lens("cooke_triplet").with_conditions(condition)
    ((found,), words) = within_conditions(lens, [Compensator(2)])
    assert (found.minimum, found.maximum) == (pytest.approx(least, abs=1e-9), pytest.approx(most, abs=1e-9))
    assert len(words) == int(math.isfinite(least) or math.isfinite(most))


def test_the_narrower_limit_counts():
    lens = rt.read_lens("cooke_triplet").with_conditions("air_thickness:2>=12.5 air_thickness:2<=13")
    ((found,), words) = within_conditions(lens, [Compensator(2, minimum=-0.1, maximum=1.0)])
    assert (found.minimum, found.maximum) == (-0.1, pytest.approx(13 - GAP, abs=1e-9))
    assert len(words) == 1


@pytest.mark.parametrize(
    ("parameter", "surface", "condition"),
    [("thickness", 2, "air_edge:2>=10"), ("curvature", 1, "edge:1>=2"), ("curvature", 2, "air_edge:2>=10")],
)
def test_an_edge_is_at_its_limit_at_the_limit_of_the_compensator(parameter, surface, condition):
    """The condition of the lens there, as `info` lists it."""
    lens = rt.read_lens("cooke_triplet").with_conditions(condition)
    ((found,), words) = within_conditions(lens, [Compensator(surface, parameter)])
    ends = [end for end in (found.minimum, found.maximum) if math.isfinite(end)]
    assert len(words) == 1
    (end,) = ends
    at_end = with_changes(lens, [found], torch.tensor([end], dtype=torch.float64))
    (attained,) = attained_by(at_end)
    assert attained.reached == pytest.approx(attained.asked, abs=1e-6)
    assert end != 0


@pytest.mark.filterwarnings("ignore::raytrace.NotReached")
def test_trials_keep_the_condition_of_the_adjusted_space():
    lens = rt.focus(rt.read_lens("cemented_achromat").at(fields=[0.0])).lens
    k = len(lens.surfaces) - 2
    lens = lens.with_conditions(f"thickness:{k}<={float(lens.surfaces[k].thickness) + 0.02}")
    settings = dict(limits="radius=0.5%", trials=40, rings=3)
    bound, free = rt.tolerance(lens, **settings), rt.tolerance(lens, hold=False, **settings)
    assert float(bound.changes.max()) == pytest.approx(0.02, abs=1e-9)
    assert float(free.changes.max()) > 0.1
    assert float(bound.changes.min()) == pytest.approx(float(free.changes.min()), abs=1e-6)
    assert "compensators within the conditions of the lens" in str(bound)
    assert not free.conditions


def test_co_design_without_the_conditions_of_the_lens(command):
    lens = rt.read_lens("cooke_triplet").with_conditions("total_track<=120 edge>=0.5")
    kept = rt.imaging.Variables(lens, "curvature:1-3").conditions
    assert kept == ("total_track<=120", "edge:1-7>=0.5") or len(kept) == 2
    assert rt.imaging.Variables(lens, "curvature:1-3", stored=False).conditions == ()
    code, out, _ = command("codesign", "--help")
    assert code == 0
    assert "--no-hold" in out

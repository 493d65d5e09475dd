"""Cones of light at the object that reach beyond a right angle: an ellipse images its one focus into the other."""

import dataclasses

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.io import write_lens
from raytrace.system.optimization_data import OptimizationData, Row, Vary


def ellipse(cone: float) -> rt.Lens:
    """Foci 100 and 800 mm from the vertex: c = ½ (1/100 + 1/800), and an eccentricity of 700/900."""
    mirror = {"radius": -1600 / 9, "conic": -((7 / 9) ** 2), "thickness": -800.0, "glass": "MIRROR"}
    lens = rt.lens([mirror], stop=1, entrance_pupil_diameter=10.0, object_distance=100.0, wavelengths=[0.55])
    number = torch.tensor(cone, dtype=torch.float64)
    rows = tuple(Row("TRAR", (0, 1), (0.0, 0.0, 0.0, r), weight=1.0) for r in (0.3, 0.6, 0.9))
    optimization_data = OptimizationData((Vary(1, "curvature"), Vary(1, "conic")), (), rows)
    aperture = dataclasses.replace(lens.aperture, kind="object_cone_angle", value=number)
    return dataclasses.replace(lens, aperture=aperture, optimization_data=optimization_data)


@pytest.mark.parametrize("cone", [20.0, 160.0])
def test_every_command_takes_a_cone_beyond_a_right_angle(cone, tmp_path, command_line):
    path = tmp_path / "ellipse.zmx"
    write_lens(ellipse(cone), path)
    found = command_line("optimize", path, "--json").document
    assert found["merit_after"] < 1e-9
    for words in (("evaluate",), ("info",), ("check",), ("spot", "--json"), ("layout", "--plot", tmp_path / "l.png")):
        assert command_line(words[0], path, *words[1:]).code == 0
    assert float(rt.spot(rt.read_lens(path)).rms_radius.max()) < 1e-9


@pytest.mark.parametrize("cone", [90.0, 180.0, 200.0])
def test_a_cone_whose_rim_lies_in_the_plane_of_the_object_is_refused(cone):
    with pytest.raises(ValueError, match=rf"object_cone_angle {cone:g} .*less than 180, and not 90"):
        rt.spot(ellipse(cone).at(fields=[0.0]))


def test_a_lens_at_other_conditions_keeps_its_cone():
    lens = ellipse(160.0).at(fields=[0.0])
    assert np.isclose(float(lens.aperture.value), 160.0)


def test_the_traced_part_of_a_cone_beyond_a_right_angle_is_reported(tmp_path):
    path = tmp_path / "ellipse.zmx"
    write_lens(ellipse(160.0), path)
    with pytest.warns(UserWarning, match=r"ellipse\.zmx:\d+: .*20 degrees"):
        rt.read_lens(path)

"""The study of depth from defocus: what its sensor distances are learned by."""

import numpy as np
import pytest
import torch
from scripts import script

import raytrace as rt
from raytrace.imaging.restoration import power_law

study = script("camera_depth")


@pytest.fixture
def design(monkeypatch):
    """Of Gaussian PSFs and few depths."""
    monkeypatch.setattr(study, "DEPTHS", 9)
    monkeypatch.setattr(study, "PIXELS", 256)
    lens = rt.read_lens("double_gauss").at(f_number=study.F_NUMBER)
    return study.Design(study.Setup(lens, power_law(study.PATCH)), "gaussian")


def test_losses_have_derivatives_by_the_sensor_distance(design):
    step = 1e-5
    for number in (0, 1):
        values = []
        for shift in (-step, 0.0, step):
            with torch.no_grad():
                design.sensor.fill_(0.25 + shift)
            values.append(design.errors()[number])
        (found,) = torch.autograd.grad(values[1], design.sensor)
        assert float(found) == pytest.approx(float((values[2] - values[0]).detach()) / (2 * step), rel=1e-4)


def test_the_learned_sensor_is_no_worse_than_those_of_the_scan(design, monkeypatch):
    monkeypatch.setattr(study, "SENSORS", np.linspace(-0.2, 0.4, 7))
    scan = [design.report(sensor) for sensor in study.SENSORS]
    for weight, key in ((0.0, "error"), (1.0, "depth_mD")):
        best = min(row[key] for row in scan)
        assert design.report(study.learned(design, weight, scan))[key] <= best
    assert {row["bound_mD"] > 0 for row in scan} == {True}

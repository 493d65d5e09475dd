"""`raytrace bench camera` runs end to end on small pictures; the error against direct superposition. No timings."""

import json

import pytest
import torch
from scripts import script

import raytrace as rt
from raytrace.bench import camera
from raytrace.cli import main

pytestmark = pytest.mark.usefixtures("same_threads")
SENSOR = rt.Sensor((18.0, 13.5), (3600, 2700), response="rgb")
SMALL = rt.Sensor((18.0, 13.5), (96, 72), response="rgb")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(camera, "PIXELS", SMALL.pixels)
    monkeypatch.setattr(camera, "TOLERANCES", (0.1, 0.03))


@pytest.mark.slow
def test_every_row_and_the_figure(capsys, tmp_path):
    assert main(["bench", "camera", "--repeats", "1", "--threads", "1", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["sensor_mm"] == [18.0, 13.5]
    step, *pictures = document["rows"]
    assert step["seconds"] > 0
    assert [row["tol"] for row in pictures] == [0.1, 0.03]
    assert all(row["error"] < row["tol"] for row in pictures)
    picture = tmp_path / "camera.png"
    script("bench_camera").figure(document["rows"]).savefig(picture)
    assert picture.stat().st_size > 1000


@pytest.mark.slow
def test_a_lens_of_the_user_has_its_largest_field_in_the_corners(capsys):
    assert main(["bench", "camera", "tessar", "--repeats", "1", "--threads", "1"]) == 0
    text = capsys.readouterr().out
    chip = rt.render(rt.focus(rt.read_lens("tessar")).lens, torch.zeros(3, 72, 96)).optics.sensor
    assert f"Lens tessar at its best focus, sensor of {chip.size[0]:.4g} × {chip.size[1]:.4g} mm" in text


def test_the_error_is_seen(focused_triplet, monkeypatch):
    """A picture that is wrong by 2 % has that error; one of many kernels has less than 1e-3."""
    monkeypatch.setattr(camera, "_CROP", 4)
    picture = torch.rand(3, 72, 96, generator=torch.Generator().manual_seed(0))
    system = camera.blur_alone(focused_triplet, SMALL, nodes=(19, 25), tol=1e-3, order=4)
    with torch.no_grad():
        image = system(picture, boundary="zero")
    assert camera.error(focused_triplet, system, picture, image) < 2e-3
    assert camera.error(focused_triplet, system, picture, 1.02 * image) == pytest.approx(0.02, abs=2e-3)


def test_a_step_has_gradients_by_every_variable(focused_triplet):
    variables = rt.Variables(focused_triplet, "curvature thickness")
    patches = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    points = torch.tensor([[0.0, 3.0], [0.0, 4.0]], dtype=torch.float64)
    how = {"sensor": SENSOR, "size": 21, "order": 4}
    image = camera.render_patches(variables(), patches, points, **how)
    assert image.shape == (2, 3, 12, 12)
    image.square().mean().backward()
    assert all(float(parameter.grad.abs()) > 0 for parameter in variables.parameters())

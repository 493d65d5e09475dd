"""`raytrace bench camera` runs end to end on small pictures; the error against direct superposition. No timings."""

import json

import pytest
import torch

import raytrace as rt
from raytrace.bench import camera
from raytrace.cli import main

pytestmark = pytest.mark.usefixtures("same_threads")
SMALL = rt.Sensor((18.0, 13.5), (96, 72), response="rgb")


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr(camera, "SENSOR", SMALL)
    monkeypatch.setattr(camera, "TOLERANCES", (0.1, 0.03))


@pytest.mark.slow
def test_every_row_and_the_figure(capsys, tmp_path):
    figure = tmp_path / "camera.png"
    assert (
        main(["bench", "camera", "--repeats", "1", "--threads", "1", "--no-peers", "--plot", str(figure), "--json"])
        == 0
    )
    step, *pictures = json.loads(capsys.readouterr().out)["rows"]
    assert step["seconds"] > 0
    assert [row["tol"] for row in pictures] == [0.1, 0.03]
    assert all(row["error"] < row["tol"] for row in pictures)
    assert figure.stat().st_size > 1000


def test_the_error_is_seen(monkeypatch):
    """A picture that is wrong by 2 % has that error; one of many kernels has less than 1e-3."""
    monkeypatch.setattr(camera, "_CROP", 4)
    lens, picture = camera.triplet(), torch.rand(3, 72, 96, generator=torch.Generator().manual_seed(0))
    blur_alone = {"model": "gaussian", "order": 4, "distortion": False, "illumination": False}
    blur_alone |= {"wavelengths": lens.wavelengths}
    system = camera.optics(lens, SMALL, nodes=(19, 25), tol=1e-3, **blur_alone)
    with torch.no_grad():
        image = system(picture, boundary="zero")
    assert camera.error(lens, system, picture, image) < 2e-3
    assert camera.error(lens, system, picture, 1.02 * image) == pytest.approx(0.02, abs=2e-3)


def test_a_step_has_gradients_by_every_variable():
    lens = camera.triplet()
    variables = rt.Variables(lens, "curvature thickness")
    patches = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0))
    points = torch.tensor([[0.0, 3.0], [0.0, 4.0]], dtype=torch.float64)
    how = {"sensor": camera.STEP_SENSOR, "size": 21, "order": 4}
    image = camera.render_patches(variables(), patches, points, **how)
    assert image.shape == (2, 3, 12, 12)
    image.square().mean().backward()
    assert all(float(parameter.grad.abs()) > 0 for parameter in variables.parameters())

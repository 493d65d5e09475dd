"""Laws that point spread functions obey whatever the lens: diffraction in closed form, reversal, and reuse of rays."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import problems
import pytest
import torch
from problems import number, vector

from raytrace.io import read_lens
from raytrace.maths.sampling import grid
from raytrace.psf_models import Execution, Memo, model_of, psf, wave
from raytrace.system.lens import SystemAperture, with_sensor_distance
from raytrace.system.surface import Aperture
from raytrace.tracing.scene import scene

LENSES = Path(__file__).parents[1] / "lenses"
WAVELENGTH, FOCUS, DIAMETER = 0.55e-3, 50.0, 0.5  # mm
MODEL_ORDER = {"gaussian": 4, "drt": 1, "wave": -1}


def perfect(defocus: float = 0.0):
    """A plano-hyperbolic lens, perfect on the axis, its sensor `defocus` mm behind its focus."""
    return problems.plano_hyperbolic(defocus, diameter=DIAMETER, focus=FOCUS)


def along_radius(lens, radii: torch.Tensor) -> torch.Tensor:
    """Intensity per mm² of the wave model at radii (K,) mm."""
    own = scene(lens, vector(0.0, 0.0)[:, None], vector(math.inf), lens.wavelengths)
    U = wave.amplitude(wave.waves(own, radii.max(), order=2), radii, vector(0.0))[0, 0, 0, 0]
    return U.real**2 + U.imag**2


def test_encircled_energy_of_the_wave_model():
    """1 - J₀² - J₁² of v = πr/λN, and so all of the light in the end (Parseval): to NA² and the rule of integration."""
    scale = WAVELENGTH * FOCUS / DIAMETER
    nodes, weights = (torch.as_tensor(a) for a in np.polynomial.legendre.leggauss(200))
    for v in (1.0, 3.8317, 10.0, 40.0):
        r = 0.5 * (nodes + 1) * v / math.pi * scale
        inside = (along_radius(perfect(), r) * 2 * math.pi * r * weights).sum() * 0.5 * v / math.pi * scale
        expected = 1 - torch.special.bessel_j0(number(v)) ** 2 - torch.special.bessel_j1(number(v)) ** 2
        assert float(inside) == pytest.approx(float(expected), abs=1e-4)


def test_defocus_on_the_axis_is_sinc_squared_of_the_wave_model():
    """I(0)/I₀ = sinc²(u/4), u = 2π NA² δ/λ · R/(R + δ), R from the exit pupil to the focus (Born & Wolf § 8.8.2)."""
    na, radius = 0.5 * DIAMETER / FOCUS, FOCUS + 1 / (1.5 / 10.0 - 1 / FOCUS)
    for u in (1.0, 4.0, 4 * math.pi, 16.0):
        delta = u * WAVELENGTH / (2 * math.pi * na**2)
        lens = perfect(delta)
        own = scene(lens, vector(0.0, 0.0)[:, None], vector(math.inf), lens.wavelengths)
        light = wave.waves(own, 0.0, order=2)
        U = wave.amplitude(light, vector(0.0), vector(0.0)).flatten()
        result = (U.real**2 + U.imag**2) / (light.amplitude.sum() / WAVELENGTH) ** 2
        quarter = 0.25 * u * radius / (radius + delta)
        assert float(result) == pytest.approx((math.sin(quarter) / quarter) ** 2, abs=2e-4)


@pytest.mark.parametrize("model", ["paraxial", "fourier", "gaussian", "drt", "wave"])
def test_a_field_on_the_other_side_turns_the_kernel_over(model):
    """Reversal: the lens is round, so what a field gives in +y, its opposite gives in -y, coma and all."""
    lens = read_lens(LENSES / "double_gauss.zmx")
    lens = dataclasses.replace(lens, aperture=SystemAperture("entrance_pupil_diameter", number(8.0)))
    angles = number([[0.0, 0.0], [3.0, -3.0]])
    centre = psf(lens, "gaussian", fields=angles[:, :1], object_distances=number([2e4]), tol=0.1).centroid[:, 0, 0]
    centre = torch.round(centre / 0.005) * 0.005
    up, down = (
        psf(
            lens, model, fields=angles[:, f : f + 1], object_distances=number([2e4]), tol=0.05,
            grid=grid(number(0.005), 9, side * centre),
        ).kernel[0, 0]
        for f, side in ((0, 1), (1, -1))
    )  # fmt: skip
    assert float(up.sum()) > 0.3
    torch.testing.assert_close(up, down.flip(0), atol=1e-9, rtol=0)
    torch.testing.assert_close(up, up.flip(1), atol=1e-9, rtol=0)
    if model in ("drt", "wave"):
        assert float((up - up.flip(0)).abs().sum()) > 1e-3


@pytest.mark.parametrize("model", ["gaussian", "drt", "wave"])
@pytest.mark.parametrize("stop", [None, 2.0])
def test_a_memo_changes_no_kernel_and_traces_less(model, stop):
    """The sensor is the variable: after the first call no bundle of rays crosses more than that plane."""
    lens = read_lens(LENSES / "double_gauss.zmx")
    lens = dataclasses.replace(lens, aperture=SystemAperture("entrance_pupil_diameter", number(8.0)))
    if stop is not None:
        lens = lens.replace(5, apertures=(Aperture("circular", (0.0, stop)),))
    sensor, memo = number(57.9).requires_grad_(), Memo()
    options = {
        "fields": number([[0.0], [2.0]]),
        "object_distances": number([1e4, 2e4]),
        "grid": grid(0.01, 5),
        "center": "chief",
    }
    repeated = model_of(model, order=MODEL_ORDER[model])
    for shift in (0.0, 0.02):
        with_memo, plain = (
            psf(with_sensor_distance(lens, sensor + shift), repeated, execution=Execution(memo=m), **options)
            for m in (memo, None)
        )
        torch.testing.assert_close(with_memo.kernel, plain.kernel, atol=1e-13, rtol=0)
        gradients = [torch.autograd.grad(result.kernel[..., 2].sum(), sensor)[0] for result in (with_memo, plain)]
        torch.testing.assert_close(*gradients, rtol=1e-9, atol=1e-12)
    crossed, bundles = memo.crossed, []
    original = Memo.front

    def counting(self, *arguments):
        bundles.append(1)
        return original(self, *arguments)

    Memo.front = counting
    try:
        psf(with_sensor_distance(lens, sensor + 0.04), repeated, execution=Execution(memo=memo), **options)
    finally:
        Memo.front = original
    assert memo.crossed - crossed == len(bundles), "each bundle crosses the sensor and nothing else"

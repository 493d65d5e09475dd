"""The Jacobian of a default merit function at its real size, against torch's own derivatives of the same rows."""

import numpy as np
import pytest
import torch

from raytrace.io import read_lens
from raytrace.optimization.merit import DefaultMerit, Evaluation
from raytrace.optimization.variables import design_variables
from raytrace.system.parameter_paths import with_numbers_of
from raytrace.tracing.launch import rays_of_field, vignette
from raytrace.tracing.trace import trace_lens

pytestmark = pytest.mark.usefixtures("compiler")


def residuals(lens, rows) -> torch.Tensor:
    """Weighted x and y of every ray from the centroid of its field, x of which is 0 by symmetry."""
    largest = torch.hypot(lens.fields.x, lens.fields.y).max()
    asked = torch.tensor([row.numbers for row in rows], dtype=torch.float64).T
    wavelength = lens.wavelengths[[row.integers[1] - 1 for row in rows]][:, None]
    field = largest * asked[:2, :, None]
    rays = rays_of_field(lens, field, vignette(lens, field, asked[2:, :, None]), wavelength=wavelength)
    hits = trace_lens(lens, rays, wavelength).position[:2, :, 0]
    weights = torch.tensor([row.weight for row in rows], dtype=torch.float64)
    same = (asked[1][:, None] == asked[1]) * weights
    centre = (same * hits[1]).sum(-1) / same.sum(-1)
    y = hits[1] - torch.where(asked[1] == 0, 0.0, centre)
    return torch.sqrt(weights / weights.sum()) * torch.stack([hits[0], y])


def test_the_jacobian_is_that_of_autograd():
    lens = read_lens("double_gauss").at(wavelengths=[0.4861327, 0.5875618, 0.6562725])
    rows = [row for row in DefaultMerit("spot", rings=6, arms=6).rows(lens) if row.operand == "TRAC"]
    free = design_variables(lens, "curvature thickness")
    model = free
    found = Evaluation(model, rows)(model.start, derivatives=True)
    leaf = torch.tensor(model.start, requires_grad=True)
    at = {(one.surface, one.quantity): number for one, number in zip(free.variables, leaf, strict=True)}
    expected = residuals(with_numbers_of(free.lens, at), rows)
    assert len(free.variables) >= 18
    assert np.allclose(found.residuals, expected.detach().reshape(-1).numpy(), rtol=0, atol=1e-12)
    generator = np.random.default_rng(0)
    for weights in generator.normal(size=(4, len(found.residuals))):
        (slope,) = torch.autograd.grad(expected.reshape(-1) @ torch.from_numpy(weights), leaf, retain_graph=True)
        ours = weights @ found.jacobian
        assert np.allclose(ours, slope.numpy(), rtol=1e-10, atol=1e-10 * np.abs(slope.numpy()).max())

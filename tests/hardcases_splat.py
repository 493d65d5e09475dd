"""Hard cases of kind "splat": points on pixel centres, on edges, at the border and far outside the window.

Schema: data x, y (mm), pixel_pitch (mm), shape (rows, columns), pixel centres at (i - (columns - 1)/2)·pitch; expected
image, inside_energy and the one-sided derivatives of loss = Σ image[iy][ix]·((ix + 1)² + 3 (iy + 2) + ix iy).
"""

import torch

from raytrace.maths.sampling import grid
from raytrace.psf_models.drt import splat

EXACT = 1e-14  # of a weight of 1


def check_splat(case: dict) -> None:
    """The image within 1e-14, the energy inside the window, and derivatives between the two one-sided ones."""
    data, expected = case["data"], case["expected"]
    points = torch.tensor([data["x"], data["y"]], dtype=torch.float64, requires_grad=True)
    pixels = grid(data["pixel_pitch"], tuple(data["shape"]))
    image = splat(pixels, points, torch.ones_like(points[0]))
    wanted = torch.tensor([[float(cell) for cell in line] for line in expected["image"]], dtype=torch.float64)
    assert torch.isfinite(image).all()
    assert (image - wanted).abs().max() <= EXACT
    assert abs(float(image.detach().sum()) - float(expected["inside_energy"])) <= EXACT * max(1, len(data["x"]))
    rows, columns = (torch.arange(n, dtype=torch.float64) for n in data["shape"])
    value = (columns + 1) ** 2 + 3 * (rows[:, None] + 2) + columns * rows[:, None]
    (slope,) = torch.autograd.grad((image * value).sum(), points)
    assert torch.isfinite(slope).all()
    scale = float(value.max()) / data["pixel_pitch"]
    for result, sides in zip(slope[0].tolist(), expected.get("dloss_dx", []), strict=False):
        low, high = sorted((float(sides["left"]), float(sides["right"])))
        assert low - EXACT * scale <= result <= high + EXACT * scale

"""Checks of the hard cases of kind "gauss_pixel" and "spot"; called for every case by test_hardcases.py.

Gates: a pixel's energy to 50 u of itself, to 2000 u in a far tail, where exp(-t²/2) is as badly conditioned as that;
RMS of a spot to 1e-14 of itself.
"""

import math
from decimal import Decimal, getcontext

import torch
from problems import floats

from raytrace.maths.sampling import Grid
from raytrace.psf_models.gaussian import gaussian_pixels
from raytrace.tracing.spot import spot_of_points

getcontext().prec = 60

ROUNDING = 2.0**-53
PIXEL_SCORE, TAIL_SCORE = 50.0, 2000.0
TAIL = 1e-6  # of all energy: a pixel with less is a tail
SMALLEST = 1e-290  # below, denormal numbers have no relative precision
SPOT_RELATIVE = 1e-14
#: Rotated far tails, where the reference's own quadrature keeps only four digits (a graded rule of 8,000 nodes in
#: 30-digit arithmetic, and one in the other order of integration, give 1.85143186483561e-46 for its 1.851466e-46).
ROTATED_TAIL, ROTATED_TAIL_RELATIVE = 1e-30, 1e-4


def relative(value: float, expected: Decimal) -> float:
    """|value - expected|/|expected|; where denormal numbers rule, or 0 is expected, |value - expected|."""
    if not math.isfinite(value):
        return math.inf
    error = abs(Decimal(value) - expected)
    return float(error / abs(expected)) if abs(expected) > Decimal(SMALLEST) else float(error)


def check_gauss_pixel(case: dict) -> float:
    """Energy and derivatives of the listed pixels, and the energy in the window; returns the worst score over gate."""
    places = {f"{p['iy']},{p['ix']}": p for p in case["expected"]["pixels"]}
    worst = 0.0
    straight = case["data"]["cov_xx_xy_yy"][1] == 0
    for components in (2, 3) if straight else (3,):
        pixels, leaves = gaussian_of(case, components)
        assert torch.isfinite(pixels).all()
        for place, expected in places.items():
            pixel = pixels[expected["iy"], expected["ix"]]
            worst = max(worst, check_pixel(pixel, expected, place, rotated=not straight))
            gradients = torch.autograd.grad(pixel, leaves, retain_graph=True)
            assert all(torch.isfinite(g).all() for g in gradients), place
            worst = max(worst, check_pixel_gradients(pixel.item(), gradients, leaves, expected, place))
        energy = Decimal(case["expected"]["window_energy"])
        gate = TAIL_SCORE if energy < Decimal(TAIL) and not is_wide(case) else PIXEL_SCORE
        result = relative(pixels.sum().item(), energy) / ROUNDING
        assert result <= gate, f"window energy: {result:.3g} u"
        worst = max(worst, result / gate)
    return worst


def gaussian_of(case: dict, components: int) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    data = case["data"]
    xx, xy, yy = data["cov_xx_xy_yy"]
    mean = torch.tensor(data["mean"], dtype=torch.float64, requires_grad=True)
    covariance = torch.tensor([xx, yy] if components == 2 else [xx, xy, yy], dtype=torch.float64, requires_grad=True)
    rows, columns = data["shape"]
    pitch = torch.tensor(data["pixel_pitch"], dtype=torch.float64)
    grid = Grid(pitch, rows, columns, torch.zeros(2, dtype=torch.float64))
    return gaussian_pixels(grid, mean, covariance), (mean, covariance)


def is_wide(case: dict) -> bool:
    """σ far above the window: every pixel is small, none is a tail."""
    return min(case["data"]["cov_xx_xy_yy"][::2]) > (5 * case["data"]["pixel_pitch"] * max(case["data"]["shape"])) ** 2


def check_pixel(pixel: torch.Tensor, expected: dict, place: str, *, rotated: bool) -> float:
    value = Decimal(expected["value"])
    gate = ROUNDING * (TAIL_SCORE if value < Decimal(TAIL) else PIXEL_SCORE)
    if rotated and value < Decimal(ROTATED_TAIL):
        gate = ROTATED_TAIL_RELATIVE
    result = relative(pixel.item(), value)
    assert result <= gate, f"pixel {place}: {result / ROUNDING:.3g} u"
    return result / gate


def check_pixel_gradients(pixel: float, gradients, leaves, expected: dict, place: str) -> float:
    """A derivative may err by its own gate and by what moves the pixel by its rounding (divided by the input)."""
    if "grad_mx_my_sxx_syy" not in expected:
        return 0.0
    result = [*gradients[0].tolist(), gradients[1][0].item(), gradients[1][-1].item()]
    inputs = [*leaves[0].tolist(), leaves[1][0].item(), leaves[1][-1].item()]
    sigmas = [math.sqrt(leaves[1][i].item()) for i in (0, -1)]
    worst = 0.0
    for got, wanted, number, scale in zip(
        result, expected["grad_mx_my_sxx_syy"], inputs, [*sigmas, *inputs[2:]], strict=True
    ):
        assert math.isfinite(got), place
        gate = TAIL_SCORE if pixel < TAIL else 2 * PIXEL_SCORE
        unit = abs(float(Decimal(wanted))) + abs(pixel) / max(abs(number), scale)
        error = float(abs(Decimal(got) - Decimal(wanted)))
        assert error <= gate * ROUNDING * unit + SMALLEST, f"pixel {place}: derivative {got} for {wanted}"
        worst = max(worst, error / (gate * ROUNDING * unit + SMALLEST))
    return worst


def check_spot(case: dict) -> float:
    """Centroid, mean square, RMS and their gradients; returns the worst error over its gate."""
    data, expected = case["data"], case["expected"]
    points = torch.tensor([floats(data["x"]), floats(data["y"])], dtype=torch.float64, requires_grad=True)
    valid = torch.tensor(data["valid"])
    spot = spot_of_points(points, valid, torch.tensor(data["weight"], dtype=torch.float64))
    gradients = {
        name: torch.autograd.grad(value, points, retain_graph=True)[0]
        for name, value in (("mean_square", spot.mean_square_radius), ("rms", spot.rms_radius))
    }
    if expected["status"] == "undefined":
        assert math.isnan(spot.rms_radius.item())
        assert math.isnan(spot.mean_square_radius.item())
        assert all((g == 0).all() for g in gradients.values())
        return 0.0
    worst = 0.0
    size = max(abs(points[:, valid]).max().item(), 5e-324)
    for got, wanted in zip(spot.centroid.tolist(), expected["centroid"], strict=True):
        error = float(abs(Decimal(got) - Decimal(wanted)))
        assert error <= 4 * ROUNDING * size, f"centroid {got} for {wanted}"
    if expected["rms"] is not None:
        result = relative(spot.rms_radius.item(), Decimal(expected["rms"]))
        assert result <= SPOT_RELATIVE, f"RMS: {result:.3g}"
        worst = result / SPOT_RELATIVE
    mean_square = Decimal(expected["mean_square_radius"])
    if Decimal("1e-300") < mean_square < Decimal("1e300"):
        result = relative(spot.mean_square_radius.item(), mean_square)
        assert result <= 2 * SPOT_RELATIVE, f"mean square: {result:.3g}"
        worst = max(worst, result / (2 * SPOT_RELATIVE))
    for name in ("mean_square", "rms"):
        reference = expected.get(f"grad_{name}_x")
        got = gradients[name][0]
        assert torch.isfinite(gradients[name]).all(), name
        if reference is None:
            assert (got == 0).all(), name
            continue
        largest = max(abs(float(Decimal(g))) for g in reference)
        for g, wanted in zip(got.tolist(), reference, strict=True):
            error = float(abs(Decimal(g) - Decimal(wanted)))
            gate = 10 * SPOT_RELATIVE * largest
            assert error <= gate, f"derivative of {name}: {g} for {wanted}"
            worst = max(worst, error / gate if gate else 0.0)
    return worst

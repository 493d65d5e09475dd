"""How far the estimated errors of PSFs can be believed.

`python tests/test_psf_estimates.py` measures them over lenses, fields and distances: the table of docs/psf_error.md.
"""

import math
import warnings
from pathlib import Path

import pytest
import torch

from raytrace.formats import read_lens
from raytrace.grid import grid
from raytrace.psf import NotConverged, psf

LENSES = Path(__file__).parents[1] / "lenses"


def number(x) -> torch.Tensor:
    return torch.tensor(x, dtype=torch.float64)


def field(*angles: float) -> torch.Tensor:
    return number([[0.0] * len(angles), list(angles)])


#: Lens, fields, object distances in mm, pixel pitch in mm.
CASES = (
    ("double_gauss", (0.0, 14.0), (1e4, 25e3), 0.005),
    ("cooke_triplet", (0.0, 14.0), (2e4, math.inf), 0.005),
    ("tessar", (0.0, 10.0), (2e4, math.inf), 0.005),
    ("phone", (0.0, 20.0), (500.0,), 0.0015),
    ("hubble", (0.0, 0.05), (math.inf,), 0.005),
    ("singlet", (0.0, 3.0), (5e3, math.inf), 0.02),
)
#: Tolerances asked of each model, and that of its converged reference.
TOLERANCES = {
    "gaussian": ((1e-1, 1e-2, 1e-3, 1e-4), 1e-30),
    "drt": ((1e-1, 3e-2, 1e-2), 1e-3),
    "fourier": ((1e-1, 1e-3, 1e-5), 1e-7),
}


def one_case(model: str, name: str, angle: float, distance: float, pitch: float) -> list[tuple[float, float, float]]:
    """(tolerance, estimated error, true error) of one kernel for every tolerance."""
    lens, (tolerances, best) = read_lens(LENSES / f"{name}.zmx"), TOLERANCES[model]
    options = {"fields": field(angle), "object_distances": number([distance]), "grid": grid(pitch, 21)}
    options |= {"wavelengths": lens.wavelengths[lens.primary_wavelength][None], "center": "centroid"}
    if model == "fourier":
        # An ideal lens has no distortion: its light lands elsewhere.
        centre = psf(lens, "paraxial", **options).centroid[:, 0, 0]
        options |= {"grid": grid(number(pitch), 21, centre), "center": "axis"}
    found = []
    with warnings.catch_warnings(), torch.no_grad():
        warnings.simplefilter("ignore", NotConverged)
        reference = psf(lens, model, tol=best, **options)
        for tol in tolerances:
            one = psf(lens, model, tol=tol, **options)
            found.append((tol, float(one.error), true_error(model, one, reference)))
    return found


def true_error(model: str, one, reference) -> float:
    if model != "gaussian":
        return float((one.kernel - reference.kernel).abs().sum() / reference.kernel.sum())
    a, b = one.covariance[::2], reference.covariance[::2]
    width = 0.5 * (a - b).abs().sum() / b.sum()
    return max(float(width), float((one.energy - reference.energy).abs() / reference.energy))


def coverage(model: str, cases) -> tuple[int, float, float]:
    """How many estimates; the share that bound the true error; the share that do, within a factor of ten."""
    found = [entry for name, angles, distances, pitch in cases for angle in angles for distance in distances
             for entry in one_case(model, name, angle, distance, pitch)]  # fmt: skip
    bounds = [true <= estimate for _, estimate, true in found]
    close = [true <= estimate <= 10 * true for _, estimate, true in found]
    return len(found), sum(bounds) / len(found), sum(close) / len(found)


@pytest.mark.parametrize("model", ["gaussian", "drt"])
def test_estimates_bound_the_true_error(model):
    count, bounds, close = coverage(model, [("double_gauss", (0.0, 14.0), (1e4, 25e3), 0.005)])
    assert count >= 12
    assert bounds >= 0.95
    assert close >= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("model", TOLERANCES)
def test_estimates_bound_the_true_error_of_every_lens(model):
    count, bounds, close = coverage(model, CASES)
    assert count >= 24
    assert bounds >= 0.95
    assert close >= 0.5


if __name__ == "__main__":
    for row in TOLERANCES:
        print("| {} | {} | {:.0%} | {:.0%} |".format(row, *coverage(row, CASES)), flush=True)

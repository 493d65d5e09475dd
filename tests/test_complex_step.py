"""Derivatives of random systems against complex steps through an independent trace in numpy.

A complex step has no difference of close numbers: f'(x) = Im f(x + ih)/h to rounding for h = 1e-30, where central
differences of these systems err by up to 1e-5 at any step. Source: Squire & Trapp (1998), SIAM Review 40, 110.
"""

import numpy as np
import pytest
import torch

import raytrace as rt
from raytrace.system.rays import start
from raytrace.system.surface import Surface
from raytrace.tracing.trace import trace_surfaces

STEP = 1e-30
RAYS = 12
NUMBERS = ("curvature", "conic", "thickness", "a4", "a6", "index")


def system(seed: int) -> dict[str, np.ndarray]:
    """Numbers of a random system of three to seven aspheres, whose rays meet the first one within 4 mm of the axis."""
    random = np.random.default_rng(seed)
    count = int(random.integers(3, 8))
    return {
        "curvature": random.uniform(-0.05, 0.05, count),
        "conic": random.uniform(-2.0, 1.0, count),
        "thickness": random.uniform(1.0, 6.0, count),
        "a4": random.uniform(-1e-5, 1e-5, count),
        "a6": random.uniform(-1e-7, 1e-7, count),
        "index": np.concatenate([[1.0], random.uniform(1.0, 1.8, count)]),
    }


def beam(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points (3, RAYS) mm on the plane of the first vertex and directions (3, RAYS)."""
    random = np.random.default_rng(1000 + seed)
    position = np.concatenate([random.uniform(-2.8, 2.8, (2, RAYS)), np.zeros((1, RAYS))])
    slope = random.uniform(-0.1, 0.1, (2, RAYS))
    direction = np.concatenate([slope, np.ones((1, RAYS))])
    return position, direction / np.sqrt((direction**2).sum(0))


def sag(of, k, u):
    """Sag and its derivative by u = x² + y² of surface k."""
    c, root = of["curvature"][k], np.sqrt(1 - (1 + of["conic"][k]) * of["curvature"][k] ** 2 * u)
    return c * u / (1 + root) + of["a4"][k] * u**2 + of["a6"][k] * u**3, (
        0.5 * c / root + 2 * of["a4"][k] * u + 3 * of["a6"][k] * u**2
    )


def hits(of, position, direction):
    """x and y (2, RAYS) on the plane behind the last surface, of real or complex numbers."""
    p, d = position.astype(of["curvature"].dtype), direction.astype(of["curvature"].dtype)
    for k in range(len(of["curvature"])):
        t = -p[2] / d[2]
        for _ in range(12):
            x, y, z = p + t * d
            z_of, slope = sag(of, k, x * x + y * y)
            t = t - (z - z_of) / (d[2] - 2 * slope * (x * d[0] + y * d[1]))
        p = p + t * d
        _, slope = sag(of, k, p[0] ** 2 + p[1] ** 2)
        normal = np.stack([-2 * slope * p[0], -2 * slope * p[1], np.ones_like(slope)])
        normal = normal / np.sqrt((normal**2).sum(0))
        ratio = of["index"][k] / of["index"][k + 1]
        cosine = (normal * d).sum(0)
        d = ratio * d + (np.sqrt(1 - ratio**2 * (1 - cosine**2)) - ratio * cosine) * normal
        p = p - np.stack([0 * p[0], 0 * p[0], 0 * p[0] + of["thickness"][k]])
    return (p - p[2] / d[2] * d)[:2]


def by_torch(of, position, direction, weights, engine):
    """The weighted sum of hits and its derivatives by every number."""
    leaves = {name: torch.tensor(value, requires_grad=True) for name, value in of.items()}
    zero = torch.zeros((), dtype=torch.float64)
    surfaces = [
        Surface(
            thickness=leaves["thickness"][k],
            curvature=leaves["curvature"][k],
            conic=leaves["conic"][k],
            coefficients=torch.stack([zero, leaves["a4"][k], leaves["a6"][k]]),
        )
        for k in range(len(of["curvature"]))
    ]
    rays = start(torch.tensor(position), torch.tensor(direction), zero)
    indices = [*leaves["index"].unbind(), leaves["index"][-1]]
    with rt.tracing.trace_engine(engine):
        end = trace_surfaces([*surfaces, Surface(thickness=zero)], rays, indices=indices)
    assert end.valid.all()
    total = (torch.tensor(weights) * end.position[:2]).sum()
    return float(total.detach()), dict(zip(leaves, torch.autograd.grad(total, [*leaves.values()]), strict=True))


def compare(seed: int, engine: str) -> int:
    """Every derivative of a system to 1e-10 of the largest of its kind; how many there are."""
    of, weights = system(seed), np.random.default_rng(2000 + seed).standard_normal((2, RAYS))
    position, direction = beam(seed)
    total, found = by_torch(of, position, direction, weights, engine)
    assert total == pytest.approx(float((weights * hits(of, position, direction)).sum()), rel=1e-11)
    for name in NUMBERS:
        expected = np.empty(len(of[name]))
        for k in range(len(expected)):
            moved = {key: value.astype(complex) for key, value in of.items()}
            moved[name][k] += 1j * STEP
            expected[k] = (weights * hits(moved, position, direction)).sum().imag / STEP
        assert found[name].numpy() == pytest.approx(expected, rel=1e-10, abs=1e-10 * np.abs(expected).max()), name
    return sum(len(of[name]) for name in NUMBERS)


@pytest.mark.parametrize(
    ("engine", "systems"),
    [("compiled", 3), *(pytest.param(e, 12, marks=pytest.mark.slow) for e in ("eager", "compiled"))],
)
def test_derivatives_of_random_systems_are_those_of_complex_steps(engine, systems):
    assert sum(compare(seed, engine) for seed in range(systems)) > 25 * systems


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["eager", "compiled"])
def test_derivatives_of_many_random_systems_are_those_of_complex_steps(engine):
    assert sum(compare(seed, engine) for seed in range(12, 400)) > 10_000

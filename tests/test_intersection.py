"""Every valid hit lies on its surface, a ray without one crosses nothing, and both engines agree: random surfaces."""

import pytest
import torch
from problems import both_engines, scalar, vector

from raytrace.system.intersection import normal
from raytrace.system.rays import Rays, start
from raytrace.system.sag_terms import PolynomialSag
from raytrace.system.shapes import KINDS
from raytrace.system.surface import Surface, sag_at
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.trace import trace_surfaces

ROUNDING = 1e-12  # mm, of the coordinates of a hit; on a slope it moves the sag by slope × rounding
ON_SURFACE = 1e-9  # mm along the axis, above rounding on a slope


def random_surface(kind: str, random: torch.Generator) -> Surface:
    """A strongly curved surface of a kind of sag, or of a conic with added sag."""

    def uniform(low: float, high: float) -> float:
        return low + (high - low) * float(torch.rand((), generator=random, dtype=torch.float64))

    def may(number: float) -> float | None:
        return number if uniform(0, 1) < 0.5 else None

    c, k, radius = scalar(uniform(-0.05, 0.05)), may(uniform(-3, 2)), may(uniform(5, 60))
    others = {"semi_diameter": radius}
    if kind == "even asphere":
        others["coefficients"] = vector(uniform(-1e-3, 1e-3), uniform(-1e-6, 1e-6))
    elif kind == "odd asphere":
        others["coefficients"] = vector(uniform(-0.05, 0.05), uniform(-1e-3, 1e-3), uniform(-1e-5, 1e-5))
    elif kind == "toroidal":
        heads = [uniform(-0.05, 0.05), uniform(-1e-3, 1e-3), uniform(-1e-6, 1e-6)]
        others["coefficients"] = vector(*heads[: 1 if uniform(0, 1) < 0.6 else 3])
    elif kind == "biconic":
        others["coefficients"] = vector(uniform(-0.05, 0.05), uniform(-3, 2))
    else:
        others["sag_terms"] = PolynomialSag(vector(*(uniform(-0.1, 0.1) for _ in range(9))), scalar(20.0))
    return Surface(
        scalar(5.0), c, None if k is None else scalar(k), kind=kind if kind in KINDS else "even asphere", **others
    )


def wide_rays(count: int, random: torch.Generator) -> Rays:
    """Rays from anywhere about a surface, inclined by up to about 45°."""
    position = (torch.rand(3, count, generator=random, dtype=torch.float64) - 0.5) * vector(100, 100, 10)[:, None]
    x, y = (torch.rand(2, count, generator=random, dtype=torch.float64) - 0.5) * 1.6
    direction = torch.stack([x, y, torch.ones_like(x)]) / torch.sqrt(1 + x * x + y * y)
    return start(position, direction, torch.zeros(count, dtype=torch.float64))


def hits(surface: Surface, rays: Rays, engine: str) -> Rays:
    with trace_engine(engine):
        return trace_surfaces([surface], rays, indices=[scalar(1.0)] * 2)


def is_off(surface: Surface, end: Rays) -> torch.Tensor:
    """Whether (n,) rays are valid at a point that does not satisfy the equation of the surface."""
    x, y, z = end.position
    nx, ny, nz = normal(surface, (x, y, z))[0]
    slope = torch.hypot(torch.as_tensor(nx), torch.as_tensor(ny)) / torch.as_tensor(nz).abs()
    return end.valid & ~((z - sag_at(surface, x, y)).abs() <= ON_SURFACE + ROUNDING * slope)


def compare(kind: str, count: int, rays: int, seed: int) -> dict[str, int]:
    """Numbers of rays: hits, hits off their surface by engine, and hits of one engine alone."""
    random = torch.Generator().manual_seed(seed)
    sums = dict.fromkeys(("hits", "eager off", "compiled off", "by one engine"), 0)
    for _ in range(count):
        surface, bundle = random_surface(kind, random), wide_rays(rays, random)
        eager, compiled = (hits(surface, bundle, engine) for engine in ("eager", "compiled"))
        sums["hits"] += int(eager.valid.sum())
        sums["eager off"] += int(is_off(surface, eager).sum())
        sums["compiled off"] += int(is_off(surface, compiled).sum())
        sums["by one engine"] += int((eager.valid != compiled.valid).sum())
    return sums


KINDS_TESTED = ["even asphere", "odd asphere", "toroidal", "biconic", "added sag"]

#: Share of hits that one engine alone finds, 98 of 298,357 of the toroids below: rays behind a surface for less than
#: 1/96 of their stretch are found or missed depending on the start of Newton's method, which differs in the compiled
#: loops.
GRAZING = 4e-4


def check(kind: str, count: int, rays: int, seed: int) -> None:
    sums = compare(kind, count, rays, seed)
    assert sums["hits"] > 0.3 * count * rays
    assert sums["eager off"] == sums["compiled off"] == 0
    assert sums["by one engine"] <= GRAZING * sums["hits"]


@pytest.mark.parametrize("kind", KINDS_TESTED)
def test_hits_satisfy_the_equation_of_their_surface(compiler, kind):
    check(kind, 4, 100, 5)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS_TESTED)
def test_hits_of_many_random_surfaces_satisfy_their_equation(compiler, kind):
    check(kind, 285, 1800, 1)


#: Kind, curvature, coefficients, semi-diameter, position and direction of a ray whose slope on the surface is near its
#: largest: where the conic closes, or far from the vertex.
STEEP = {
    "where the conic closes": (
        "even asphere",
        (-0.036381678447950296, (-0.00017232064084787098, -1.7130613348537356e-07), None),
        (-44.826439194857194, 4.905550646491374, 0.3824602191824389),
        (-0.5283823370739633, 0.06404418141146435, 0.8465875316206777),
    ),
    "where odd terms meet the edge of the conic": (
        "odd asphere",
        (
            0.02931703115298198,
            (0.004291296476589754, -1.88405979588851e-05, -5.299759522774956e-07),
            51.724944770182105,
        ),
        (38.856900773782414, 37.122651506098336, -0.9370841004788599),
        (-0.24934869410680888, -0.45383480317376373, 0.8554876972671555),
    ),
}


@both_engines
@pytest.mark.parametrize("name", STEEP)
def test_a_hit_on_a_steep_slope_is_on_the_surface(engine, name):
    kind, (curvature, coefficients, rim), position, direction = STEEP[name]
    surface = Surface(scalar(5.0), scalar(curvature), kind=kind, coefficients=vector(*coefficients), semi_diameter=rim)
    ray = start(vector(*position)[:, None], vector(*direction)[:, None], scalar(0.0)[None])
    end = hits(surface, ray, engine)
    assert bool(end.valid)
    assert not bool(is_off(surface, end))


#: Curvatures along y and x, semi-diameter, foot and direction of a ray, and height of its crossing or None.
TOROIDS = {
    "a change of sign at the edge of the sheet is no crossing": (
        (0.020569377044351106, -0.02384788085811452, 60.0),
        (1.101954606799538, 42.64192640307111, -1.5071660405593266),
        (0.44161219033044297, 0.44125381038851985, 0.7812001972408614),
        None,
    ),
    "a crossing outside the semi-diameter counts where none is within": (
        (0.04618779263055464, 0.03444083254419504, 20.0),
        (-2.310699189505857, 23.708353246653196, -0.1068436536441744),
        (0.1458027622834503, -0.12405935660738253, 0.9815043711307035),
        18.275992836837887,
    ),
}


@both_engines
@pytest.mark.parametrize("with_rim", [True, False], ids=["semi-diameter", "no semi-diameter"])
@pytest.mark.parametrize("name", TOROIDS)
def test_a_wide_ray_at_a_toroid(engine, name, with_rim):
    (c, c_x, rim), position, direction, height = TOROIDS[name]
    others = {"kind": "toroidal", "semi_diameter": rim if with_rim else None}
    face = Surface(scalar(5.0), scalar(c), None, vector(c_x), **others)
    rays = start(vector(*position)[:, None], vector(*direction)[:, None], torch.zeros(1, dtype=torch.float64))
    end = hits(face, rays, engine)
    assert end.valid.tolist() == [height is not None]
    if height is not None:
        assert float(end.position[2, 0]) == pytest.approx(height, abs=1e-12)  # mm, rounding

"""The compiled trace of tilted and decentred surfaces, coordinate breaks, gratings, phases and ideal lenses."""

import itertools
import random

import pytest
import torch
from compiled_rays import CLOSE, assert_same_rays, both, leaves_of_rays, some_rays, with_leaves
from hits import hit_jacobian
from problems import lens, scalar, surface, vector
from torch.autograd import gradcheck, gradgradcheck
from torch.testing import assert_close

import raytrace as rt
from raytrace.materials.glass import MIRROR
from raytrace.maths.numerics import to
from raytrace.system.lens import media
from raytrace.system.poses import Gap, Pose, direction_in, passage, point_in
from raytrace.system.rays import Rays, start
from raytrace.system.sag_terms import FringeSag, PolynomialSag, TiltSag
from raytrace.system.shapes import EVEN
from raytrace.system.surface import Aperture, Surface, gap_behind
from raytrace.tracing import compiled
from raytrace.tracing.compiled import push, rows_of, task_of, trace_compiled, trace_engine
from raytrace.tracing.trace import points_at, trace_surfaces

pytestmark = pytest.mark.usefixtures("compiler")

WAVELENGTHS = vector(0.48, 0.55, 0.65)[:, None]
ANGLES = {"x": 0.4, "y": -0.3, "z": 0.2, "tilt_x": 7.0, "tilt_y": -5.0, "tilt_z": 40.0}


def posed(scale: float = 1.0, *, tilts_first: bool = False, **numbers: float) -> Pose:
    return Pose(**{name: scalar(scale * number) for name, number in numbers.items()}, tilts_first=tilts_first)


def broken(thickness: float, **numbers) -> Surface:
    return Surface(scalar(thickness), before=posed(**numbers), is_break=True)


def drawn(*shape: int, size: float = 1.0, seed: int = 5) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return size * torch.randn(shape, generator=generator, dtype=torch.float64)


GRATING = rt.system.Grating(scalar(0.15), scalar(1.0))
RADIAL = rt.system.RadialPhase(vector(-40.0, 12.0, 3.0), scalar(10.0), scalar(1.0))
FREE = rt.system.PolynomialPhase(drawn(14, size=60.0), scalar(20.0), scalar(-1.0))
FRINGE = rt.system.FringePhase(drawn(37, size=0.5), scalar(30.0), scalar(1.0))
HOLOGRAM = rt.system.Hologram(vector(3.0, -2.0, -40.0), vector(-5.0, 4.0, 60.0), scalar(0.55), scalar(1.0))
ROUND, UNLIKE = (rt.system.IdealLens(scalar(0.01), scalar(power), scalar(0.002)) for power in (0.01, -0.004))

#: Each is entered by rays of a wide cone; between them stand all kinds, mirrors, breaks, and rays lost in every way.
SYSTEMS = {
    "tilted": [
        surface(0.02, 5.0, 1.6, before=posed(**ANGLES), after=posed(-1.0, **ANGLES, tilts_first=True)),
        surface(-0.02, 4.0, conic=-0.6, before=posed(x=0.5, tilt_x=-4.0)),
        surface(-0.01, 6.0, 1.5, coefficients=[1e-3, -1e-6], semi_diameter=20.0, after=posed(y=1.0, tilts_first=True)),
        surface(None, 3.0, before=posed(tilt_y=20.0), apertures=(Aperture("rectangular", (9.0, 8.0)),)),
        surface(None, 0.0, before=posed(tilt_x=-12.0, tilt_z=30.0)),
    ],
    "folded": [
        surface(None, 20.0),
        broken(0.0, tilt_x=45.0),
        surface(None, 0.0, MIRROR),
        broken(-20.0, tilt_x=45.0, x=0.3),
        surface(0.01, -6.0, 1.5),
        broken(-3.0, y=1.0, tilt_y=-6.0),
        surface(-0.01, -10.0, before=posed(tilt_z=15.0)),
        surface(-0.005, 15.0, MIRROR, conic=-1.0, before=posed(tilt_x=-10.0), after=posed(tilt_x=-10.0)),
        broken(4.0, tilt_y=3.0),
        broken(0.0, tilt_x=2.0, tilts_first=True),
    ],
    "phases": [
        surface(0.01, 5.0, 1.6, phase=GRATING),
        surface(-0.01, 8.0, conic=0.3, phase=RADIAL, before=posed(tilt_x=9.0)),
        surface(0.005, 6.0, 1.5, coefficients=[1e-4, 2e-6], phase=FREE, semi_diameter=40.0),
        surface(None, 6.0, phase=FRINGE, apertures=(Aperture("circular", (0.0, 14.0)),)),
        surface(0.004, 6.0, kind="odd asphere", coefficients=[1e-3, 1e-4], phase=RADIAL, semi_diameter=40.0),
        surface(-0.004, -20.0, MIRROR, phase=GRATING, before=posed(tilt_x=12.0), after=posed(tilt_x=-3.0)),
        surface(0.01, -7.0, MIRROR, phase=FRINGE),
    ],
    "holograms": [
        surface(None, 5.0, 1.6, phase=HOLOGRAM),
        surface(-0.01, 8.0, conic=0.3, phase=HOLOGRAM, before=posed(tilt_x=9.0)),
        surface(0.004, -20.0, MIRROR, phase=HOLOGRAM, before=posed(tilt_x=12.0), after=posed(tilt_x=-3.0)),
        surface(None, -7.0, sag_terms=FringeSag(drawn(37, size=0.01), scalar(30.0), scalar(1.0), scalar(-2.0))),
        surface(None, -7.0, sag_terms=TiltSag(scalar(0.1), scalar(-0.2)), phase=GRATING),
    ],
    "facets": [
        surface(0.03, 5.0, 1.6, phase=rt.system.Facets(), conic=-0.5),
        surface(-0.02, 8.0, coefficients=[1e-3, 2e-5, -1e-7], phase=rt.system.Facets(), before=posed(tilt_x=9.0)),
        surface(None, 8.0, 1.5, phase=rt.system.Facets()),
    ],
    "ideal": [
        surface(None, 12.0, phase=ROUND),
        surface(None, 5.0, 1.5, phase=UNLIKE, before=posed(**ANGLES)),
        surface(0.02, 10.0),
        surface(None, -10.0, MIRROR),
        surface(None, -14.0, phase=ROUND, after=posed(tilt_y=4.0)),
    ],
    "evanescent": [
        surface(None, 3.0, phase=rt.system.Grating(scalar(1.7), scalar(1.0))),
        surface(None, 2.0, phase=rt.system.Grating(scalar(1.7), scalar(-1.0)), before=posed(tilt_x=10.0)),
        surface(0.02, 2.0, 1.5),
    ],
}


def given(name: str, dtype=torch.float64, *, with_path: bool = True, count: int = 300):
    """Surfaces, rays (3, 3, P) of every wavelength, and how they are traced."""
    system = to(lens(SYSTEMS[name]), dtype=dtype)
    rays = some_rays(count, dtype)
    opl = rays.opl[None] if with_path else None
    rays = Rays(rays.position[:, None], rays.direction[:, None], rays.valid[None], opl)
    how = {"indices": media(system, WAVELENGTHS), "wavelength": WAVELENGTHS}
    return system.surfaces[1:], rays, how


def traced(name: str, dtype=torch.float64, **options):
    surfaces, rays, how = given(name, dtype, **options)
    return both(lambda: trace_surfaces(surfaces, rays, **how))


@pytest.mark.parametrize("with_path", [True, False])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("name", SYSTEMS)
def test_rays_are_those_of_torch(name, dtype, with_path):
    compiled, eager = traced(name, dtype, with_path=with_path)
    assert_same_rays(compiled, eager, 20 * CLOSE[dtype])
    assert eager.shape == (3, 300)
    assert 0 < int(eager.valid.sum()) < 900


@pytest.mark.parametrize("name", SYSTEMS)
def test_all_of_a_system_is_compiled(name):
    surfaces, rays, how = given(name)
    assert trace_compiled(surfaces, rays, **how, side=1, gap=None, eager=None) is not None
    later = {"indices": how["indices"][1:], "wavelength": WAVELENGTHS, "side": 1}
    gap = gap_behind(surfaces[0])
    assert isinstance(gap, Gap) == (name == "tilted")
    behind = trace_surfaces(surfaces[:1], rays, **{**how, "indices": how["indices"][:2]})
    assert trace_compiled(surfaces[1:], behind, **later, gap=gap, eager=None) is not None
    compiled, eager = both(lambda: trace_surfaces(surfaces[1:], behind, **later, gap=gap))
    assert_same_rays(compiled, eager, 20 * CLOSE[torch.float64])


@pytest.mark.parametrize("with_path", [True, False])
@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-11), (torch.float32, 5e-3)])
@pytest.mark.parametrize("name", SYSTEMS)
def test_the_adjoint_equals_autograd(name, dtype, close, with_path):
    surfaces, rays, how = given(name, dtype, with_path=with_path)
    weights = drawn(7, 3, 300, seed=8).to(dtype)

    def gradients():
        own, indices, leaves = with_leaves(surfaces, how["indices"])
        start = [x.clone().requires_grad_() for x in (rays.position, rays.direction)]
        opl = rays.opl.clone().requires_grad_() if with_path else None
        end = trace_surfaces(own, Rays(*start, rays.valid, opl), indices=indices, wavelength=WAVELENGTHS)
        out = [end.position, end.direction, *([end.opl[None]] if with_path else [])]
        merit = sum((w * x).sum() for w, x in zip(weights.split([3, 3, 1]), out, strict=False))
        return torch.autograd.grad(merit, [*leaves, *start, *([opl] if with_path else [])], allow_unused=True)

    compiled, eager = both(gradients)
    for f, e in zip(compiled, eager, strict=True):
        if e is None:
            assert f is None or not f.any()
            continue
        assert torch.isfinite(f).all()
        assert float((f - e).abs().max()) <= close * (float(e.abs().max()) + 1.0)


@pytest.mark.parametrize("name", SYSTEMS)
def test_forward_derivatives_are_the_gradients_of_torch(name):
    """Σ w ∂hit/∂v of every number, and what a change of all of them at once does to direction and path."""
    surfaces, rays, how = given(name, count=40)
    weights = drawn(7, 3, 40, seed=8)
    own, indices, leaves = with_leaves(surfaces, how["indices"])
    with trace_engine("compiled"):
        hits = hit_jacobian(own, rays, leaves, indices=indices, wavelength=WAVELENGTHS)
        task = task_of(own, rays, indices=indices, wavelength=WAVELENGTHS)
        table = task.inputs[3]
        change = torch.zeros_like(table).requires_grad_()
        towards = torch.autograd.grad(table, leaves, change, create_graph=True, allow_unused=True)
        steps = [drawn(*leaf.shape, size=0.1, seed=seed) for seed, leaf in enumerate(leaves)]
        moved = sum((t * step).sum() for t, step in zip(towards, steps, strict=True) if t is not None)
        pushed = push(task, torch.autograd.grad(moved, change)[0][None])
    with trace_engine("eager"):
        end = trace_surfaces(own, rays, indices=indices, wavelength=WAVELENGTHS)
        by_hit, by_rest = (
            torch.autograd.grad(merit, leaves, allow_unused=True, retain_graph=True)
            for merit in (
                (weights[:2] * end.position[:2]).sum(),
                (weights[3:6] * end.direction).sum() + (weights[6] * end.opl).sum(),
            )
        )
    expected = torch.cat(
        [(torch.zeros_like(x) if g is None else g).reshape(-1) for x, g in zip(leaves, by_hit, strict=True)]
    )
    assert_close((hits * weights[:2]).sum((1, 2, 3)), expected, rtol=1e-10, atol=1e-10)
    found = (weights[3:6] * pushed.by_direction[:, 0]).sum() + (weights[6] * pushed.by_opl[0]).sum()
    assert_close(found, sum((g * step).sum() for g, step in zip(by_rest, steps, strict=True) if g is not None))


@pytest.mark.parametrize("name", SYSTEMS)
def test_rays_behind_all_surfaces_at_once_are_those_behind_each(name):
    """Positions, paths, validity and forward derivatives, lost rays included, where axes turn on the way too."""
    surfaces, rays, how = given(name, count=40)
    indices, wavelength = how["indices"], WAVELENGTHS
    task = task_of(surfaces, rays, indices=indices, wavelength=wavelength)
    change = drawn(2, *task.inputs[3].shape, size=0.01, seed=3) * task.inputs[3].abs()
    with trace_engine("compiled"):
        found = push(task, change, everywhere=True)
        bare = push(task, change[:0], everywhere=True)
        for number, row in enumerate(rows_of(task.structure, surfaces), 1):
            part = task_of(surfaces[:number], rays, indices=indices[: number + 1], wavelength=wavelength)
            columns = _columns_of(part, task)
            one = push(part, change[..., columns])
            for name in ("position", "direction", "by_position", "by_direction"):
                assert_close(getattr(found, name)[:, row], getattr(one, name), rtol=0, atol=0, equal_nan=True)
            for name in ("opl", "by_opl", "valid"):
                assert_close(getattr(found, name)[row], getattr(one, name), rtol=0, atol=0, equal_nan=True)
            assert torch.equal(bare.position[:, row], one.position)
    assert row == len(task.structure.layout) - 1


def _columns_of(part, whole) -> list[int]:
    """Where the numbers of the first surfaces stand in the table of all of them."""
    found = {}
    for own, other in zip(part.structure.layout.tolist(), whole.structure.layout.tolist(), strict=False):
        for places in ((6,), (7,), (8,), (10,), (11,)):
            found |= {own[k]: other[k] for k in places}
        found |= {own[9] + j: other[9] + j for j in range(own[3])}
        found |= {own[15] + j: other[15] + j for j in range(own[14])}
        found |= {own[17] + j: other[17] + j for j in range(own[16] + 4 if own[16] else 0)}
    return [found[k] for k in range(part.inputs[3].shape[-1])]


@pytest.mark.parametrize("glass", [1.0, 1.5, MIRROR])
def test_whether_an_order_is_evanescent_is_not_left_to_rounding(glass):
    """Rays of float32 about the angle where their order leaves the surface along it, decided by both as in float64."""
    n2 = glass if isinstance(glass, float) else 1.0
    sine = torch.linspace(-2e-6, 2e-6, 801, dtype=torch.float64) + n2 - 0.8
    rays = start(torch.zeros(3, 801), torch.stack([0 * sine, sine, torch.sqrt(1 - sine * sine)]).float(), None)
    grating = surface(None, 0.0, glass, phase=rt.system.Grating(scalar(1.6), scalar(1.0)))
    grating = to(grating, dtype=torch.float32)
    n = [torch.tensor(1.0), torch.tensor(n2)]
    found = both(lambda: trace_surfaces([grating], rays, indices=n, wavelength=torch.tensor(0.5)).valid)
    slope = (torch.tensor(1.6) * torch.tensor(0.5)).double()
    _, M, N = rays.direction.double()
    squared = N * N + (n[1].double() ** 2 - 1) - slope * (2 * M + slope)
    assert torch.equal(found[0], found[1])
    assert 100 < int(found[0].sum()) < 700
    sure = squared.abs() > 1e-12
    assert torch.equal(found[0][sure], squared[sure] > 0)


SHAPES = [("plane", None), ("sphere", None), ("conic", None), ("free", EVEN), ("free", "toroidal"), ("free", "biconic")]
SHAPES += [("departed", None), ("departed", EVEN)]
SAG_TERMS = [
    TiltSag(scalar(0.1), scalar(-0.05)),
    PolynomialSag(drawn(9, size=0.1), scalar(20.0)),
    FringeSag(drawn(20, size=0.01), scalar(20.0), scalar(1.0), scalar(-2.0)),
]


def drawn_system(seed: int) -> list[Surface]:
    """Surfaces of any kind in any order, tilted and decentred anyhow, breaks and mirrors among them."""
    chance = random.Random(seed)
    phases = [None, None, GRATING, RADIAL, FREE, FRINGE, HOLOGRAM, ROUND, UNLIKE]
    surfaces, side = [], 1
    for _ in range(8):
        poses = [None if chance.random() < 0.5 else any_pose(chance) for _ in range(2)]
        gap = side * chance.uniform(0.0, 8.0)
        if chance.random() < 0.25:
            surfaces.append(Surface(scalar(gap), before=poses[0], after=poses[1], is_break=True))
            continue
        shape, kind = chance.choice(SHAPES)
        mirror = chance.random() < 0.25
        side = -side if mirror else side
        surfaces.append(
            surface(
                None if shape == "plane" else chance.uniform(-0.02, 0.02),
                side * abs(gap),
                MIRROR if mirror else chance.choice([1.0, 1.5, 1.7]),
                conic=chance.uniform(-2.0, 1.0) if shape == "conic" else None,
                coefficients=[1e-3, chance.uniform(-1e-6, 1e-6)] if kind else None,
                kind=kind or EVEN,
                sag_terms=chance.choice(SAG_TERMS) if shape == "departed" else None,
                phase=chance.choice(phases),
                before=poses[0],
                after=poses[1],
                semi_diameter=60.0,
                apertures=(Aperture("circular", (0.0, 25.0)),) if chance.random() < 0.2 else (),
            )
        )
    return surfaces


def any_pose(chance: random.Random) -> Pose:
    names = [name for name in ANGLES if chance.random() < 0.6]
    sizes = {name: chance.uniform(-8.0, 8.0) if "tilt" in name else chance.uniform(-1.0, 1.0) for name in names}
    return posed(**sizes, tilts_first=chance.random() < 0.5)


@pytest.mark.parametrize("seed", range(12))
def test_systems_drawn_at_random(seed):
    """Rays, and the gradient of all that comes out by all that goes in, with the path or without it by turns."""
    system = lens(drawn_system(seed))
    rays, indices = some_rays(200), media(system, WAVELENGTHS)
    rays = Rays(rays.position[:, None], rays.direction[:, None], rays.valid[None], rays.opl[None] if seed % 2 else None)
    weights = drawn(7, 3, 200, seed=seed)

    def outcome():
        own, n, leaves = with_leaves(system.surfaces[1:], indices)
        end = trace_surfaces(own, rays, indices=n, wavelength=WAVELENGTHS)
        merit = (weights[:3] * end.position).sum() + (weights[3:6] * end.direction).sum()
        merit = merit if end.opl is None else merit + (weights[6] * end.opl).sum()
        return end, torch.autograd.grad(merit, leaves, allow_unused=True)

    (compiled, by_compiled), (eager, by_eager) = both(outcome)
    size = max(100.0, float(eager.position.detach().abs().max()))
    assert_same_rays(compiled, eager, 1e-12, size)
    for f, e in zip(by_compiled, by_eager, strict=True):
        assert (e is None) or float((f - e).abs().max()) <= 1e-10 * (float(e.abs().max()) + size)


@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_gradients_are_differences_and_have_gradients_of_their_own(order):
    """By finite differences; second ones pass through the eager trace, whose surfaces are rebuilt from the table."""
    rays = some_rays(7)
    rays = Rays(rays.position[:, None], rays.direction[:, None], rays.valid[None], rays.opl[None])
    mean, wavelength = scalar(0.5), vector(0.5, 0.6)[:, None]
    names = list(ANGLES)

    def trace(frequency, radius, terms, power, *angles):
        tilt = Pose(**dict(zip(names, angles, strict=True)))
        surfaces = [
            surface(0.02, 3.0, 1.5, before=tilt, phase=rt.system.Grating(frequency, scalar(1.0)), after=tilt),
            surface(-0.01, 4.0, 1.6, phase=rt.system.RadialPhase(terms, radius, scalar(1.0))),
            broken(0.0, tilt_y=4.0),
            surface(None, 5.0, MIRROR, phase=rt.system.PolynomialPhase(10 * terms, radius, scalar(1.0))),
            surface(None, -8.0, phase=rt.system.IdealLens(power, power, 0.5 * power)),
            surface(None, before=Pose(tilt_x=angles[0])),
        ]
        n = [scalar(1.0), scalar(1.5), scalar(1.6)]
        end = trace_surfaces(surfaces, rays, indices=[*n, n[2], n[2], n[0], n[0]], wavelength=wavelength)
        assert end.valid.sum() == 12
        return end.position[:2], end.direction, end.opl

    start = (mean * 0.2, scalar(8.0), vector(-3.0, 2.0), scalar(0.01), *(scalar(0.5 * a) for a in ANGLES.values()))
    start = [x.clone().requires_grad_() for x in start]
    with trace_engine("compiled"):
        if order == 1:
            assert gradcheck(trace, start, rtol=1e-5, atol=1e-6)
            return
        assert gradgradcheck(lambda *x: trace(*x)[0][..., 1:3], start, rtol=1e-4, atol=1e-5)
        assert gradgradcheck(lambda *x: trace(*x)[2][..., 1:3], start, rtol=1e-4, atol=1e-5)


def test_neither_neighbours_nor_threads_change_anything():
    surfaces, rays, how = given("phases", count=20_000)

    def outcome(threads):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            own, indices, leaves = with_leaves(surfaces, how["indices"])
            end = trace_surfaces(own, rays, indices=indices, wavelength=WAVELENGTHS)
            return *leaves_of_rays(end), *torch.autograd.grad(end.position.square().sum(), leaves, allow_unused=True)
        finally:
            torch.set_num_threads(before)

    with trace_engine("compiled"):
        for one, two in zip(outcome(1), outcome(2), strict=True):
            assert one is two is None or torch.equal(one, two)
        chosen = torch.tensor([1, 15, 16, 17, 255, 256, 300, 19_999])
        alone = trace_surfaces(surfaces, Rays(*(x[..., chosen] for x in leaves_of_rays(rays))), **how)
        together = trace_surfaces(surfaces, rays, **how)
    for part, whole in zip(leaves_of_rays(alone), leaves_of_rays(together), strict=True):
        assert torch.equal(part, whole[..., chosen])


@pytest.mark.parametrize(("first", "second"), list(itertools.product([None, False, True], repeat=2)))
def test_a_passage_is_its_steps_one_after_the_other(first, second):
    poses = [None if order is None else posed(**ANGLES, tilts_first=order) for order in (first, second)]
    gap = scalar(3.0) if poses[0] is None else Gap(poses[0], scalar(3.0))
    point, direction = drawn(3, 20), drawn(3, 20, seed=6)
    rows = passage(gap, poses[1])
    there, along = list(point), list(direction)
    if poses[0] is not None:
        there, along = point_in(poses[0], there), direction_in(poses[0], along)
    there = [there[0], there[1], there[2] - 3.0]
    if poses[1] is not None:
        there, along = point_in(poses[1], there), direction_in(poses[1], along)
    for row, at, way in zip(rows, there, along, strict=True):
        assert_close(sum(r * p for r, p in zip(row, [*point, 1.0], strict=True)), at, rtol=0, atol=1e-14)
        assert_close(sum(r * d for r, d in zip(row[:3], direction, strict=True)), way, rtol=0, atol=1e-14)


def test_a_plane_edge_on_loses_the_rays_along_it_alone():
    """At 90° exactly, where nothing may become NaN, not even a gradient."""
    heights = torch.linspace(-2.0, 2.0, 5, dtype=torch.float64)
    direction = torch.stack([0 * heights, 0.1 * (heights > 0).double(), 1 + 0 * heights])
    rays = start(torch.stack([0 * heights, heights, 0 * heights]), direction, None)
    tilt, n = scalar(90.0).requires_grad_(), scalar(1.0)
    surfaces = [surface(None, 4.0, before=Pose(tilt_x=tilt), after=posed(tilt_x=-90.0)), surface()]
    for end in both(lambda: trace_surfaces(surfaces, rays, indices=[n] * 3)):
        assert end.valid.tolist() == [False, False, False, True, True]
        (gradient,) = torch.autograd.grad(end.position.sum(), tilt, retain_graph=True)
        assert torch.isfinite(gradient)
        assert_close(end.position[1, 3:], heights[3:] + 0.4, rtol=0, atol=1e-14)


def test_numbers_of_a_search_are_prepared_once(monkeypatch):
    """Of tilted surfaces and rays that differ from call to call: the rays are those of a trace by itself, with and
    without derivatives, whose numbers are two kinds."""
    lens = rt.read_lens("double_gauss")
    tolerances = rt.tolerances(lens, grade="commercial")
    curvature = torch.zeros((), dtype=torch.float64, requires_grad=True)
    lens = lens.replace(3, curvature=lens.surfaces[3].curvature + curvature)
    lens = rt.tolerancing.perturbed(lens, tolerances, rt.tolerancing.draw_errors(tolerances, 2, seed=1))
    made, structure_of = [], compiled.structure_of
    search = points_at(lens, lens.primary, (lens.stop, len(lens.surfaces) - 1))
    bundles = [
        start(vector(0.1 * n, -0.5, 2.0, 1.0, 0.5, 0.0).reshape(3, 2), vector(0.0, 0.1, 1.0)[:, None]) for n in (1, 2)
    ]
    monkeypatch.setattr(compiled, "structure_of", lambda *a: (made.append(a), structure_of(*a))[1])
    for rays in (*bundles, *bundles):
        with torch.no_grad():
            search(rays)
        points, _ = search(rays)
        count = len(made)
        alone, _ = points_at(lens, lens.primary, (lens.stop, len(lens.surfaces) - 1))(rays)
        del made[count:]
        for point, other in zip(points, alone, strict=True):
            assert torch.equal(point, other)
            slope, wanted = (torch.autograd.grad(t.sum(), curvature, retain_graph=True)[0] for t in (point, other))
            torch.testing.assert_close(slope, wanted, rtol=1e-12, atol=0)
    assert len(made) == 4  # two runs of surfaces, without derivatives and with them

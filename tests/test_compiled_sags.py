"""Sags that are not round in the compiled trace: rays, adjoint and tangents as torch finds them."""

import dataclasses
import time

import pytest
import torch
from compiled_rays import CLOSE, assert_same_rays, both, some_rays, with_leaves
from hits import hit_jacobian
from problems import scalar, vector
from torch.autograd import gradcheck, gradgradcheck
from torch.utils._pytree import tree_flatten, tree_leaves, tree_unflatten

from raytrace.materials.glass import MIRROR
from raytrace.maths.numerics import to
from raytrace.system.rays import Rays, start
from raytrace.system.sag_terms import (
    SAG_TERMS,
    FringeSag,
    GridSag,
    IrregularSag,
    PolynomialSag,
    PowerSag,
    TiltSag,
    ZernikeSag,
)
from raytrace.system.surface import Surface
from raytrace.tracing.compiled import is_expressible, trace_engine
from raytrace.tracing.trace import trace_surfaces


def freeform(kind: str, curvature, conic, *coefficients: float, thickness: float = 4.0, **others) -> Surface:
    c, k = (None if number is None else scalar(number) for number in (curvature, conic))
    return Surface(scalar(thickness), c, k, vector(*coefficients), kind=kind, **others)


def departed(sag_terms, curvature=None, conic=None, *coefficients: float) -> Surface:
    c, k = (None if number is None else scalar(number) for number in (curvature, conic))
    return Surface(scalar(4.0), c, k, vector(*coefficients) if coefficients else None, sag_terms=sag_terms)


def drawn(count: int, size: float, seed: int = 3) -> torch.Tensor:
    return size * torch.randn(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


#: Surfaces between two media. Steep enough for rays of `some_rays` to miss some of them.
FACES = {
    "toroid": freeform("toroidal", 1 / 14, -0.7, -1 / 11, 1e-3, -2e-5, 1e-7),
    "toroid of one curve": freeform("toroidal", 1 / 12, None, 1 / 9),
    "cylinder along x": freeform("toroidal", None, None, 1 / 7),
    "cylinder along y": freeform("toroidal", 1 / 14, None, 0.0),
    "biconic": freeform("biconic", 1 / 12, -1.0, -1 / 15, 0.5),
    "biconic of positive curvatures": freeform("biconic", 1 / 12, 0.3, 1 / 9, -2.5),
    "tilted plane": departed(TiltSag(scalar(0.3), scalar(-0.2))),
    "polynomial": departed(PolynomialSag(drawn(9, 0.3), scalar(6.0)), 1 / 14, -0.7),
    "polynomial on an asphere": departed(PolynomialSag(drawn(5, 0.3), scalar(6.0)), 1 / 14, None, 1e-3, 2e-5, -1e-7),
    "polynomial without terms": departed(PolynomialSag(vector(), scalar(6.0)), 1 / 14),
    "irregular": departed(IrregularSag(*map(scalar, (0.2, -0.3, 0.1, 30.0, 7.0))), -1 / 20),
    "fringe": departed(FringeSag(drawn(11, 0.02), *map(scalar, (14.0, 0.5, -0.7))), 1 / 20, None, 1e-4),
    "Zernike": departed(ZernikeSag(drawn(11, 0.02), scalar(9.0)), 1 / 20, 0.4),
}
each = pytest.mark.parametrize("name", FACES)

#: Two by whom derivatives that take seconds, one number after the other by torch, are compared in every run.
QUICK = "toroid", "biconic"
two_of_each = pytest.mark.parametrize(
    "name", [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in FACES]
)
END = Surface(scalar(0.0))


def systems(name: str) -> list[Surface]:
    """The surface refracting into glass and out of it, and reflecting."""
    face = FACES[name]
    mirror = dataclasses.replace(face, glass=MIRROR, thickness=scalar(-9.0), semi_diameter=5.0)
    return [face, dataclasses.replace(face, curvature=scalar(-0.02), thickness=scalar(6.0)), mirror]


def indices(dtype=torch.float64) -> list[torch.Tensor]:
    air, glass = scalar(1.0).to(dtype), scalar(1.6).to(dtype)
    return [air, glass, air, air]


@each
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_rays_of_all_fates_are_traced_as_by_torch(name, dtype):
    """With optical paths, and without: then the compiled trace leaves them out and gives the same rays."""
    surfaces, rays = to(systems(name), dtype=dtype), some_rays(dtype=dtype)
    assert all(is_expressible(surface) for surface in surfaces)
    compiled, eager = both(lambda: trace_surfaces(surfaces, rays, indices=indices(dtype)))
    assert 5 < int((~eager.valid).sum()) < 690
    assert_same_rays(compiled, eager, 10 * CLOSE[dtype])
    with trace_engine("compiled"):
        without = trace_surfaces(surfaces, dataclasses.replace(rays, opl=None), indices=indices(dtype))
    assert without.opl is None
    assert_same_rays(without, dataclasses.replace(eager, opl=None), 10 * CLOSE[dtype])


@pytest.mark.parametrize("conic", [None, 2.0, -3.0])
@pytest.mark.parametrize("terms", [(), (2e-4, -3e-6)])
def test_a_crossing_beyond_the_rim_counts_where_none_lies_within_it(conic, terms):
    """Rays of any slope at a steep bowl, of which many cross it inside the rim and outside, some in both places."""
    bowl = departed(PolynomialSag(drawn(14, 0.01), scalar(6.0)), 1 / 9, conic, *terms)
    bowl = dataclasses.replace(bowl, semi_diameter=4.0)
    spread = torch.rand(4, 3000, generator=torch.Generator().manual_seed(5), dtype=torch.float64) * 2 - 1
    ones = torch.ones(3000, dtype=torch.float64)
    rays = start(torch.stack([6 * spread[0], 6 * spread[1], -ones]), torch.stack([3 * spread[2], 3 * spread[3], ones]))
    compiled, eager = both(lambda: trace_surfaces([bowl], rays, indices=indices()[:2]))
    radius = torch.hypot(*eager.position[:2])
    near = (radius > 4.0) & (radius < 1.125 * 4.0) & eager.valid
    assert int(near.sum()) > 50
    assert_same_rays(compiled, eager, 1e-13)


def test_rays_a_little_beyond_a_rim_are_traced_as_fast_as_within_it():
    """They are not looked for one by one: half of these rays are beyond the rim."""
    bowl = departed(PolynomialSag(drawn(14, 1e-4), scalar(6.0)), 1 / 30)
    angle = torch.arange(60000, dtype=torch.float64)
    radius = 3.9 + 0.2 * (angle % 2)
    position = torch.stack([radius * angle.cos(), radius * angle.sin(), -torch.ones_like(angle)])
    rays = start(position, position.new_tensor([0.0, 0.0, 1.0])[:, None])
    seconds = {}
    with trace_engine("compiled"):
        for rim in (4.0, 5.0) * 3:
            surface = dataclasses.replace(bowl, semi_diameter=rim)
            begin = time.process_time()
            trace_surfaces([surface], rays, indices=indices()[:2])
            seconds.setdefault(rim, []).append(time.process_time() - begin)
    assert min(seconds[4.0]) < 3 * min(seconds[5.0])


@each
@pytest.mark.parametrize(("dtype", "close"), [(torch.float64, 1e-11), (torch.float32, 2e-3)])
@pytest.mark.parametrize("with_path", [True, False])
def test_the_adjoint_equals_autograd(name, dtype, close, with_path):
    rays, given_surfaces = some_rays(dtype=dtype), to(systems(name), dtype=dtype)
    weights = torch.randn(7, 700, generator=torch.Generator().manual_seed(1), dtype=torch.float64).to(dtype)

    def gradients():
        surfaces, media, leaves = with_leaves(given_surfaces, indices(dtype))
        given = [rays.position.clone().requires_grad_(), rays.direction.clone().requires_grad_()]
        opl = rays.opl.clone().requires_grad_() if with_path else None
        end = trace_surfaces(surfaces, Rays(*given, rays.valid, opl), indices=media)
        out = [end.position, end.direction, *([end.opl[None]] if with_path else [])]
        merit = sum((w * x).sum() for w, x in zip(weights.split([3, 3, 1]), out, strict=False))
        return torch.autograd.grad(merit, [*leaves, *given, *([opl] if with_path else [])], allow_unused=True)

    for f, e in zip(*both(gradients), strict=True):
        if e is None:
            assert f is None or not f.any()
            continue
        assert torch.isfinite(f).all()
        assert float((f - e).abs().max()) <= close * (float(e.abs().max()) + 1.0)


@pytest.mark.parametrize(
    "name", [name if name == "biconic" else pytest.param(name, marks=pytest.mark.slow) for name in FACES]
)
@pytest.mark.parametrize(
    ("dtype", "close"), [(torch.float64, 1e-11), pytest.param(torch.float32, 2e-3, marks=pytest.mark.slow)]
)
def test_the_tangents_equal_those_of_torch(name, dtype, close):
    rays = some_rays(200, dtype=dtype)
    surfaces, media, leaves = with_leaves(to(systems(name), dtype=dtype), indices(dtype))
    compiled, eager = both(lambda: hit_jacobian(surfaces, rays, leaves, indices=media))
    for f, e in zip(compiled, eager, strict=True):
        assert float((f - e).abs().max()) <= close * (float(e.abs().max()) + 1.0)


@two_of_each
def test_gradients_by_differences_and_their_gradients_with_failed_rays(name):
    face = FACES[name]
    rays = Rays(*(part[..., 46:54] for part in (some_rays().position, some_rays().direction, some_rays().valid)))

    def hits(curvature, conic, *others):
        changed = tree_unflatten(list(others), kinds)
        if "coefficients" in changed:
            changed["coefficients"] = changed["coefficients"] * share
        surfaces = [dataclasses.replace(face, curvature=curvature, conic=conic, **changed), END]
        end = trace_surfaces(surfaces, rays, indices=[*indices()[:2], indices()[1]])
        return torch.where(end.valid, end.position[:2], 0.0)

    numbers = [scalar(0.03) if n is None else n for n in (face.curvature, face.conic)]
    more = {name: getattr(face, name) for name in ("coefficients", "sag_terms") if getattr(face, name) is not None}
    if "coefficients" in more:
        share = 3.0 ** (-2 * torch.arange(len(more["coefficients"]), dtype=torch.float64))  # so that all weigh alike
        more["coefficients"] = more["coefficients"] / share
    others, kinds = tree_flatten(more)
    numbers = tuple(number.clone().requires_grad_() for number in (*numbers, *others))
    with trace_engine("compiled"):
        assert gradcheck(hits, numbers, atol=1e-6)
        assert gradgradcheck(hits, numbers, atol=1e-5, fast_mode=True)


@each
def test_rays_do_not_depend_on_their_neighbours_nor_gradients_on_threads(name):
    rays = some_rays(40_000)

    def gradient(threads):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            surfaces, media, leaves = with_leaves(systems(name), indices())
            end = trace_surfaces(surfaces, rays, indices=media)
            return torch.autograd.grad((end.position**2).sum(), leaves, allow_unused=True)
        finally:
            torch.set_num_threads(before)

    with trace_engine("compiled"):
        for a, b in zip(gradient(1), gradient(2), strict=True):
            assert a is b is None or torch.equal(a, b)
        some = slice(1237, 1300)
        few = Rays(rays.position[:, some], rays.direction[:, some], rays.valid[some], rays.opl[some])
        alone, among = (trace_surfaces(systems(name), given, indices=indices()) for given in (few, rays))
    assert torch.equal(alone.position, among.position[:, some])
    assert torch.equal(alone.direction, among.direction[:, some])


@pytest.mark.parametrize("name", [name for name, face in FACES.items() if face.sag_terms is not None])
def test_powers_are_the_sag_terms(name):
    """At points all over and beyond its disc, with slopes and second derivatives."""
    sag_terms = FACES[name].sag_terms
    kind = SAG_TERMS[type(sag_terms).__name__]
    powers = kind.powers(sag_terms)
    x, y = drawn(200, 6.0, seed=1), drawn(200, 6.0, seed=2)
    given, expected = (
        row.sag(tree_leaves(row.prepare(of)), x, y, 2)
        for row, of in ((SAG_TERMS["PowerSag"], powers), (kind, sag_terms))
    )
    for g, e in zip(given, expected, strict=True):
        assert float((g - e).abs().max()) <= 1e-11 * (1.0 + float(e.abs().max()))
    bound = SAG_TERMS["PowerSag"].size(tree_leaves(powers), torch.hypot(x, y))
    assert bool((expected.z.abs() <= bound * (1 + 1e-12)).all())


def test_unsupported_surfaces_are_traced_by_torch():
    """Heights on a grid, terms of a degree whose powers would lose digits, and odd bases."""
    faces = [
        departed(GridSag(torch.zeros(4, 4, dtype=torch.float64), scalar(5.0))),
        departed(ZernikeSag(drawn(92, 1e-3), scalar(9.0))),
        dataclasses.replace(departed(TiltSag(scalar(0.1), scalar(0.0)), 0.01, None, 1e-3), kind="odd asphere"),
    ]
    assert not any(is_expressible(face) for face in faces)
    with pytest.raises(ValueError, match="no Jacobian for height maps"):
        hit_jacobian(faces[:1], some_rays(5), [faces[0].thickness.clone().requires_grad_()], indices=indices()[:2])


def test_powers_that_differ_from_lens_to_lens_are_compiled_with_their_gradients():
    coefficients = torch.stack([drawn(9, 1e-3, seed=k) for k in range(3)], 1)[..., None].requires_grad_()
    face = departed(PowerSag(*(scalar(n) for n in (0.1, -0.2, 4.0, 1e-3)), coefficients), 0.02)
    assert is_expressible(face)
    rays, weights = some_rays(300), drawn(300, 1.0, seed=9)

    def traced():
        end = trace_surfaces([face, END], rays, indices=indices()[:3])
        total = (weights * end.position[:2]).sum()
        (slope,) = torch.autograd.grad(total, coefficients, create_graph=True)
        (bend,) = torch.autograd.grad((slope * slope).sum(), coefficients)
        return end, slope.detach(), bend

    (compiled, slope, bend), (eager, slope_eager, bend_eager) = both(traced)
    assert compiled.position.shape == (3, 3, 300)
    assert_same_rays(compiled, eager, 1e-12)
    for f, e in ((slope, slope_eager), (bend, bend_eager)):
        assert float((f - e).abs().max()) <= 1e-11 * float(e.abs().max())

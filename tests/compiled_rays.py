"""What tests of the compiled trace compare: rays of all fates, both traces of them, and how far they may be apart."""

import dataclasses

import torch
from torch.testing import assert_close
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import to
from raytrace.system.rays import Rays, start
from raytrace.tracing.compiled import trace_engine

#: What both traces may differ by, in direction cosines and as a share of the size of a system.
CLOSE = {torch.float64: 1e-14, torch.float32: 2e-6}


def some_rays(count: int = 700, dtype=torch.float64, seed: int = 4) -> Rays:
    """Rays in a wide cone: most arrive, the others are lost in all ways."""
    generator = torch.Generator().manual_seed(seed)
    spread = torch.randn(4, count, generator=generator, dtype=torch.float64)
    ones = torch.ones(count, dtype=torch.float64)
    position = torch.stack([3 * spread[0], 3 * spread[1], -ones])
    direction = torch.stack([0.08 * spread[2], 0.08 * spread[3], ones])
    direction[:, ::50] = torch.stack([ones, ones, 0.1 * ones])[:, ::50]
    return to(start(position, direction, torch.zeros(count, dtype=torch.float64)), dtype=dtype)


def both(call):
    found = []
    for name in ("compiled", "eager"):
        with trace_engine(name):
            found.append(call())
    return found


def assert_same_rays(compiled: Rays, eager: Rays, close: float, size: float = 100.0) -> None:
    """To a share `close` of the size (mm) of the system."""
    assert torch.equal(compiled.valid, eager.valid)
    assert_close(compiled.position, eager.position, rtol=0, atol=close * size)
    assert_close(compiled.direction, eager.direction, rtol=0, atol=close)
    if eager.opl is not None:
        assert_close(compiled.opl, eager.opl, rtol=close, atol=close * size)


def leaves_of_rays(rays: Rays):
    return rays.position, rays.direction, rays.valid, rays.opl


def with_leaves(surfaces, indices):
    """Surfaces whose numbers are leaves, indices that are, and all of them."""
    leaves = []

    def leaf(number):
        leaves.append(number.detach().clone().requires_grad_())
        return leaves[-1]

    names = ("thickness", "curvature", "conic", "coefficients", "sag_terms", "phase", "before", "after")
    own = [
        dataclasses.replace(s, **{n: pytree.tree_map(leaf, getattr(s, n)) for n in names if getattr(s, n) is not None})
        for s in surfaces
    ]
    distinct = {id(index): leaf(index) for index in indices}
    return own, [distinct[id(index)] for index in indices], leaves

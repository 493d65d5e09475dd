"""Scenes: their symmetry, and the share of the pupil that vignetting factors leave."""

import dataclasses

import pytest
import torch
from problems import double_gauss, vector

from raytrace.system.lens import Lens
from raytrace.system.surface import Aperture
from raytrace.tracing.scene import Scene, beam_share, scene, symmetry, trace_scene

FIELDS = 0.0, 10.0, 14.0  # those of the lens


def of(lens: Lens, *fields: tuple[float, float]) -> Scene:
    return scene(
        lens, vector(*(x for pair in zip(*fields, strict=True) for x in pair)).reshape(2, -1), vector(1e4), vector(0.53)
    )


def stopped(*apertures: Aperture) -> Lens:
    lens = double_gauss()
    return lens.replace(6, apertures=apertures)


def vignetted(field: int, **factors: float) -> Lens:
    lens = double_gauss()
    table = torch.zeros(5, len(FIELDS), dtype=torch.float64)
    for name, number in factors.items():
        table[("vdx", "vdy", "vcx", "vcy", "van").index(name), field] = number
    return dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, vignetting=table))


AXIS, UP, ASIDE = (0.0, 0.0), (0.0, 10.0), (1e-6, 10.0)


@pytest.mark.parametrize(
    ("lens", "fields", "expected"),
    [
        (double_gauss(), (AXIS,), "round"),
        (double_gauss(), (AXIS, UP), "mirror"),
        (double_gauss(), (AXIS, ASIDE), "none"),
        (stopped(Aperture("circular", (3.0, 9.0))), (AXIS,), "round"),
        (stopped(Aperture("rectangular", (9.0, 9.0))), (AXIS,), "mirror"),
        (stopped(Aperture("elliptic", (9.0, 8.0), False, (0.0, 1.0))), (UP,), "mirror"),
        (stopped(Aperture("circular", (0.0, 9.0), False, (0.0, 1.0))), (AXIS,), "mirror"),
        (stopped(Aperture("circular", (0.0, 9.0), True, (1.0, 0.0))), (AXIS,), "none"),
        (vignetted(0, vcx=0.1, vcy=0.1), (AXIS,), "round"),
        (vignetted(0, vcy=0.1), (AXIS,), "mirror"),
        (vignetted(0, vdy=0.1), (AXIS,), "mirror"),
        (vignetted(1, vdx=0.1), (AXIS, UP), "none"),
        (vignetted(1, vcy=0.1, van=20.0), (UP,), "none"),
        (vignetted(1, vdx=0.1), (AXIS,), "round"),  # factors of a field that is not asked for
    ],
)
def test_symmetry_of_fields_apertures_and_vignetting(lens, fields, expected):
    found = of(lens, *fields)
    assert symmetry(found) == expected
    # The law itself: what is symmetric in x lands and is stopped symmetrically.
    disc = torch.rand(2, 200, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 1.4 - 0.7
    here, there = trace_scene(found, disc), trace_scene(found, disc * vector(-1.0, 1.0)[:, None])
    alike = (here.position[0] + there.position[0]).abs().max() < 1e-12 and bool((here.valid == there.valid).all())
    assert bool(alike) == (expected != "none")


def test_numbers_that_break_the_symmetry_when_they_move_have_none():
    still, factors = of(double_gauss(), AXIS), vignetted(0, vcx=0.1, vcy=0.1)
    moving = dataclasses.replace(still, fields=still.fields.clone().requires_grad_())
    assert (symmetry(still), symmetry(moving)) == ("round", "none")
    table = factors.fields.vignetting.clone().requires_grad_()
    moving = dataclasses.replace(factors, fields=dataclasses.replace(factors.fields, vignetting=table))
    assert (symmetry(of(factors, AXIS)), symmetry(of(moving, AXIS))) == ("round", "none")


@pytest.mark.parametrize("transform", ["grad", "jacfwd", "hessian", "dual", "vmap", "inner", "outer"])
def test_fields_under_a_transform_have_no_symmetry(transform):
    lens, seen = double_gauss(), []

    def look(fields):
        seen.append(symmetry(Scene(of(lens, AXIS).lens, fields, vector(0.53))))
        return fields.square().sum()

    fields = vector(0.0, 0.0)[:, None]
    if transform == "dual":
        with torch.autograd.forward_ad.dual_level():
            look(torch.autograd.forward_ad.make_dual(fields, torch.ones_like(fields)))
    elif transform == "vmap":
        torch.func.vmap(look)(fields[None])
    elif transform in ("inner", "outer"):
        # The inner transform is by another number; the fields pass through it as constants.
        first, second = torch.func.jacfwd, torch.func.jacrev
        first, second = (first, second) if transform == "inner" else (second, first)
        first(lambda f: second(lambda c: look(f * (1 + 0 * c.detach())) + c)(vector(1.0)[0]))(fields)
    else:
        getattr(torch.func, transform)(look)(fields)
    assert set(seen) == {"none"}


def test_fields_under_a_transform_keep_their_symmetry():
    lens, fields, seen = of(double_gauss(), AXIS).lens, vector(0.0, 0.0)[:, None], []

    def look(curvature):
        seen.append(symmetry(Scene(lens.replace(3, curvature=curvature), fields, vector(0.53))))
        return curvature.square()

    for transform in (torch.func.grad, torch.func.jacfwd):
        transform(look)(lens.surfaces[3].curvature)
    assert set(seen) == {"round"}


def test_share_of_the_beam_is_the_product_of_both_compressions():
    share = beam_share(of(vignetted(1, vcx=0.1, vcy=0.4, vdy=0.2, van=30.0), AXIS, UP))
    assert share.shape == (1, 2, 1)
    torch.testing.assert_close(share.flatten(), vector(1.0, 0.9 * 0.6))

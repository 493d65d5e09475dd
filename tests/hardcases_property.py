"""Hard cases of kind "property": what holds of a batch however rays are ordered, split, stored or joined by bad ones.

A case names the system in `data.of` and the law at the end of its id, as A7-d-permute-mixed: the law "permute", with
lost rays.
"""

import copy

import pytest
import torch
from differences import gradcheck, gradgradcheck
from hardcases_scene import CASES, OUTPUTS, Scene
from problems import turned
from torch.testing import assert_close

from raytrace.system.rays import Rays, start
from raytrace.tracing.compiled import engine
from raytrace.tracing.trace import trace_surfaces

SYSTEMS = {case["id"]: case for case in CASES if case["kind"] == "trace"}
SCALE = 2.0**20


def check_property(case: dict) -> None:
    """Ask the law that the case names of the system that it names; unknown ones fail."""
    name = case["id"].split("-", 2)[2].removesuffix("-mixed")
    if name not in LAWS:
        pytest.fail(f"{case['id']}: no law {name!r}; known are {', '.join(LAWS)}")
    if case["data"]["of"] not in SYSTEMS:
        pytest.fail(f"{case['id']}: no system {case['data']['of']!r} in this file")
    LAWS[name](SYSTEMS[case["data"]["of"]])


def outcome(case: dict, rays: list[int] | None = None) -> tuple[torch.Tensor, list, dict]:
    """Outputs (7, P), statuses, and the derivatives of every output of every ray to every number, by name."""
    scene = Scene(case, torch.float64, rays=rays)
    result = scene.run()
    values = torch.stack([result[output] for output in OUTPUTS])
    gradients = {}
    for row, output in zip(values, OUTPUTS, strict=True):
        computed = torch.autograd.grad(row.sum(), list(scene.parameters.values()), retain_graph=True, allow_unused=True)
        for name, gradient in zip(scene.parameters, computed, strict=True):
            gradients[output, name] = torch.zeros(values.shape[1:]) if gradient is None else gradient
    return values.detach(), result["status"], gradients


def assert_same(part, whole, rays):
    """`part` is bit for bit the rays `rays` of `whole`."""
    assert torch.equal(part[0], whole[0][:, rays])
    assert part[1] == [whole[1][i] for i in rays]
    for key, gradient in part[2].items():
        assert torch.equal(gradient, whole[2][key][rays]), key


def permuting_rays_permutes_results(case):
    whole = outcome(case)
    order = torch.randperm(len(case["rays"]), generator=torch.Generator().manual_seed(5)).tolist()
    assert_same(outcome(case, order), whole, order)
    assert_same(outcome(case, order[::-1]), whole, order[::-1])


def rays_alone_equal_rays_in_a_batch(case):
    whole = outcome(case)
    for i in range(len(case["rays"])):
        assert_same(outcome(case, [i]), whole, [i])
    both = [0, len(case["rays"]) - 1]
    assert_same(outcome(case, both), whole, both)


def a_lost_neighbour_changes_no_gradient(case):
    whole = outcome(case)
    assert all(torch.isfinite(gradient).all() for gradient in whole[2].values())
    for i, expected in enumerate(case["expected"]):
        if expected["status"] == "ok":
            assert_same(outcome(case, [i]), whole, [i])


def raw(case: dict, scene: Scene) -> tuple[torch.Tensor, torch.Tensor]:
    """Positions and directions of the case's rays, as given."""
    rays, _ = scene.launch()
    if "o" not in scene.rays[0]:
        return rays.position.detach(), rays.direction.detach()
    return tuple(torch.tensor([ray[key] for ray in scene.rays], dtype=torch.float64).T.clone() for key in "od")


def traced(scene: Scene, position: torch.Tensor, direction: torch.Tensor) -> Rays:
    rays = start(position, direction, torch.zeros_like(position[0]))
    return trace_surfaces(scene.surfaces, rays, indices=scene.indices)


def assert_equal_rays(computed: Rays, expected: Rays):
    assert torch.equal(computed.position, expected.position)
    assert torch.equal(computed.direction, expected.direction)
    assert torch.equal(computed.opl, expected.opl)
    assert torch.equal(computed.valid, expected.valid)


def turning_rays_by_90_degrees_turns_results(case):
    scene = Scene(case, torch.float64, shared=True)
    position, direction = raw(case, scene)
    plain = traced(scene, position, direction)

    computed = traced(scene, turned(position), turned(direction))
    expected = Rays(turned(plain.position), turned(plain.direction), plain.valid, plain.opl)
    if engine() == "eager":
        assert_equal_rays(computed, expected)
        return
    # The compiled trace fuses y² into x² + y² and rounds once: not the same in x and y.
    assert torch.equal(computed.valid, expected.valid)
    for name in ("position", "direction", "opl"):
        assert_close(getattr(computed, name), getattr(expected, name), rtol=1e-14, atol=1e-14)


def light_goes_back_the_way_it_came(case):
    """The mirror image in z of the system, traversed from its last hit, leads back to the start."""
    scene = Scene(case, torch.float64, shared=True)
    position, direction = raw(case, scene)
    last = traced(scene, position, direction)
    reversed_case = copy.deepcopy(case)
    reversed_case["surfaces"] = reversed_case["surfaces"][::-1]
    reversed_case["media"] = case["media"][::-1]
    gaps = [surface["thickness"] for surface in case["surfaces"][:-1]][::-1]
    for surface, gap in zip(reversed_case["surfaces"], [*gaps, 0.0], strict=True):
        surface["c"], surface["thickness"] = -surface["c"], gap
        if "a" in surface:
            surface["a"] = [-a for a in surface["a"]]
    back = Scene(reversed_case, torch.float64, shared=True)
    flip = torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)[:, None]
    computed = traced(back, last.position * flip, -last.direction * flip)
    assert bool(computed.valid.all())
    offset = position * flip - computed.position
    across = torch.linalg.cross(offset, computed.direction, dim=0)
    size = sum(abs(surface["thickness"]) for surface in case["surfaces"]) + position.abs().max()
    # A few hundred roundings of the length of the system: two passes through every surface.
    assert across.abs().max() <= 300 * 2.0**-53 * size
    assert (computed.direction + direction * flip).abs().max() <= 300 * 2.0**-53


def lengths_times_a_power_of_two_scale_exactly(case):
    scaled = copy.deepcopy(case)
    for surface in scaled["surfaces"]:
        surface["c"] /= SCALE
        surface["thickness"] *= SCALE
        if surface["semi_diameter"] is not None:
            surface["semi_diameter"] *= SCALE
        if "a" in surface:
            surface["a"] = [a / SCALE ** (2 * j + 3) for j, a in enumerate(surface["a"])]
    scene, big = Scene(case, torch.float64, shared=True), Scene(scaled, torch.float64, shared=True)
    position, direction = raw(case, scene)
    plain, computed = traced(scene, position, direction), traced(big, SCALE * position, direction)
    assert bool(plain.valid.any())
    assert torch.equal(computed.position, SCALE * plain.position)
    assert torch.equal(computed.direction, plain.direction)
    assert torch.equal(computed.opl, SCALE * plain.opl)


def no_rays_give_no_rays(case):
    scene = Scene(case, torch.float64, shared=True)
    rays = traced(scene, torch.zeros(3, 0, dtype=torch.float64), torch.zeros(3, 0, dtype=torch.float64))
    assert rays.position.shape == rays.direction.shape == (3, 0)
    assert rays.valid.shape == rays.opl.shape == (0,)
    total = rays.position.sum() + rays.direction.sum() + rays.opl.sum()
    numbers = [p for name, p in scene.parameters.items() if name[0] in "sn"]
    computed = torch.autograd.grad(total, numbers, allow_unused=True)
    assert all(gradient is None or (gradient == 0).all() for gradient in computed)


def memory_layout_does_not_matter(case):
    scene = Scene(case, torch.float64, shared=True)
    position, direction = raw(case, scene)
    plain = traced(scene, position, direction)
    interleaved = torch.stack([position, direction], dim=-1).transpose(0, 1).contiguous().transpose(0, 1)
    assert_equal_rays(traced(scene, interleaved[..., 0], interleaved[..., 1]), plain)
    for i in range(position.shape[1]):
        expanded = traced(scene, position[:, i : i + 1].expand(3, 4), direction[:, i : i + 1].expand(3, 4))
        for j in range(4):
            assert torch.equal(expanded.position[:, j], plain.position[:, i])
            assert torch.equal(expanded.direction[:, j], plain.direction[:, i])
            assert torch.equal(expanded.opl[j], plain.opl[i])
    shaped = traced(scene, position.reshape(3, 1, -1, 1), direction.reshape(3, 1, -1, 1))
    assert torch.equal(shaped.position.reshape(3, -1), plain.position)


NAN, INF = float("nan"), float("inf")
BAD_RAYS = [
    ((NAN, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, 0.0, NAN), (0.0, 0.0, 1.0)),
    ((INF, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, 0.0, -INF), (0.0, 0.0, 1.0)),
    ((0.0, 0.0, 0.0), (NAN, 0.0, 1.0)),
    ((0.0, 0.0, 0.0), (0.0, INF, 1.0)),
    ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
]


def bad_rays_are_flagged_and_change_nothing(case):
    count = len(case["rays"])
    scene = Scene(case, torch.float64)
    joined = Scene(case, torch.float64, rays=[*range(count), *[0] * len(BAD_RAYS)])
    position, direction = raw(case, scene)
    plain = traced(scene, position, direction)
    bad_position, bad_direction = (torch.tensor(rows, dtype=torch.float64).T for rows in zip(*BAD_RAYS, strict=True))
    position = torch.cat([position, bad_position], dim=1).requires_grad_()
    direction = torch.cat([direction, bad_direction], dim=1).requires_grad_()
    computed = traced(joined, position, direction)
    assert not computed.valid[count:].any()
    for values in (computed.position, computed.direction, computed.opl):
        assert torch.isfinite(values).all()
    assert_equal_rays(
        Rays(computed.position[:, :count], computed.direction[:, :count], computed.valid[:count], computed.opl[:count]),
        plain,
    )
    names = [name for name in joined.parameters if name[0] in "sn"]
    alone = torch.autograd.grad(objective(plain), [scene.parameters[name] for name in names], allow_unused=True)
    inputs = [*(joined.parameters[name] for name in names), position, direction]
    gradients = torch.autograd.grad(objective(computed), inputs, allow_unused=True)
    for name, before, after in zip(names, alone, gradients, strict=False):
        assert (before is None) == (after is None), name
        if after is not None:
            assert torch.equal(after[:count], before), name
    for name, gradient in zip([*names, "position", "direction"], gradients, strict=True):
        if gradient is not None:
            assert torch.isfinite(gradient).all(), name
            # A lost ray leaves along the axis, where the terms of its derivatives cancel to a rounding of 1.
            assert (gradient[..., count:].abs() <= (1e-14 if name in names else 0.0)).all(), name


def objective(rays: Rays) -> torch.Tensor:
    weight = torch.arange(1.0, 4.0, dtype=torch.float64)[:, None]
    return (weight * rays.position).sum() + (weight * rays.direction).sum() + rays.opl.sum()


def directions_of_any_length_are_normalised(case):
    """Bit for bit by powers of two; by other factors to the rounding of every component of factor·d."""
    scene = Scene(case, torch.float64, shared=True)
    position, direction = raw(case, scene)
    plain = traced(scene, position, direction)
    for factor in (2.0**-900, 2.0**900):
        assert_equal_rays(traced(scene, position, factor * direction), plain)
    for factor in (3.0, 1e-200, 1e200):
        computed = traced(scene, position, factor * direction)
        for i, expected in enumerate(case["expected"]):
            if expected["status"] == "ok" and expected.get("cond"):
                assert bool(computed.valid[i])
                # cond is what the outputs change by per relative change of every input.
                cond = [max(expected["cond"][output] for output in outputs) for outputs in (OUTPUTS[:3], OUTPUTS[3:6])]
                moved = (computed.position - plain.position)[:, i].abs().max()
                turned = (computed.direction - plain.direction)[:, i].abs().max()
                assert moved <= 30 * 2.0**-53 * cond[0], f"ray {i}, {factor:g}"
                assert turned <= 30 * 2.0**-53 * cond[1], f"ray {i}, {factor:g}"


def derivatives_equal_differences(case):
    scene = Scene(case, torch.float64, shared=True)
    scene.launch()
    names = [name for name in scene.parameters if not name.startswith(("o.", "d."))]
    values = [scene.parameters[name].detach().clone().requires_grad_() for name in names]

    def outputs(*numbers):
        fresh = Scene(case, torch.float64, shared=True)
        fresh.parameters = dict(zip(names, numbers, strict=True))
        fresh.surfaces = [fresh._surface(i, s) for i, s in enumerate(case["surfaces"])]
        fresh.indices = fresh._media()
        last = traced(fresh, *raw(case, fresh))
        return torch.cat([last.position, last.direction, last.opl[None]])

    # Centred differences of 1e-6 of numbers of order 1: 1e-9 relative and 1e-10 absolute rounding, per unit of output.
    assert gradcheck(outputs, values, eps=1e-6, atol=1e-6, rtol=1e-4)
    assert gradgradcheck(outputs, values, eps=1e-6, atol=1e-5, rtol=1e-3)


LAWS = {
    "permute": permuting_rays_permutes_results,
    "split": rays_alone_equal_rays_in_a_batch,
    "bad-neighbour": a_lost_neighbour_changes_no_gradient,
    "rotate": turning_rays_by_90_degrees_turns_results,
    "reverse": light_goes_back_the_way_it_came,
    "scale": lengths_times_a_power_of_two_scale_exactly,
    "empty": no_rays_give_no_rays,
    "noncontiguous": memory_layout_does_not_matter,
    "nan-input": bad_rays_are_flagged_and_change_nothing,
    "unnormalised": directions_of_any_length_are_normalised,
    "gradcheck": derivatives_equal_differences,
}

"""Values: frozen, walked by torch.func and pytree, moved as a whole, never compared by ==."""

import copy
import dataclasses
import os
import pickle
import subprocess
import sys

import pytest
import torch
from problems import aspheric_singlet, double_gauss, surface
from torch.utils import _pytree as pytree

import raytrace as rt
from raytrace.materials.environment import Environment
from raytrace.materials.glass import AIR
from raytrace.maths.numerics import to
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Solve
from raytrace.system.rays import Rays
from raytrace.system.sag_terms import TiltSag
from raytrace.tracing.trace import trace_lens


def test_values_are_frozen_and_have_no_dict():
    rays = Rays(torch.zeros(3, 2), torch.zeros(3, 2), torch.ones(2, dtype=torch.bool))
    with pytest.raises(dataclasses.FrozenInstanceError):
        rays.valid = None
    assert not hasattr(rays, "__dict__")


def test_comparing_values_is_identity_and_never_raises():
    one, other = surface(0.1), surface(0.1)
    assert one == one
    assert one != other
    assert len({one, other}) == 2


def test_tree_holds_numbers_only_and_is_rebuilt():
    lens = aspheric_singlet(name="asphere", notes=("a", "b"))
    leaves, structure = pytree.tree_flatten(lens)
    assert all(isinstance(leaf, torch.Tensor) for leaf in leaves)
    back = pytree.tree_unflatten(leaves, structure)
    assert isinstance(back, Lens)
    assert (back.name, back.notes, back.stop) == ("asphere", ("a", "b"), 1)
    assert back.surfaces[1].coefficients is lens.surfaces[1].coefficients
    assert back.surfaces[2].coefficients is None
    assert [s.glass.formula for s in back.surfaces] == [s.glass.formula for s in lens.surfaces]


def test_structure_of_equal_lenses_is_equal_so_that_trees_can_be_mapped_together():
    one, other = double_gauss(), double_gauss()
    total = pytree.tree_map(lambda a, b: a + b, one, other)
    assert torch.equal(total.surfaces[1].curvature, 2 * one.surfaces[1].curvature)


def test_to_float32_converts_every_floating_tensor_and_traces():
    lens = to(aspheric_singlet(), dtype=torch.float32)
    assert {leaf.dtype for leaf in pytree.tree_leaves(lens)} == {torch.float32}
    rays = Rays(
        torch.tensor([[0.0], [2.0], [0.0]]), torch.tensor([[0.0], [0.0], [1.0]]), torch.ones(1, dtype=torch.bool)
    )
    out = trace_lens(lens, rays, lens.wavelengths)
    assert out.position.dtype == out.direction.dtype == torch.float32
    assert to(rays, dtype=torch.float64).valid.dtype == torch.bool
    assert to(rays, dtype=torch.float64).opl is None


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_numbers_of_16_bits_are_refused(dtype):
    """A spot of 22 µm was 36 µm in float16: a height of 10 mm has steps of 8 µm there."""
    lens = rt.read_lens("cooke_triplet")
    with pytest.raises(ValueError, match="float32 or"):
        rt.to(lens, dtype=dtype)
    coarse = dataclasses.replace(lens, wavelengths=lens.wavelengths.to(dtype))
    for function in (rt.spot, rt.info, rt.layout):
        with pytest.raises(ValueError, match=f"dtype {dtype}"):
            function(coarse)


def test_air_is_not_changed_by_moving_a_lens():
    before = AIR.coefficients.dtype
    to(double_gauss(), dtype=torch.float32)
    assert AIR.coefficients.dtype == before


def test_a_value_survives_pickling_between_processes():
    """Data loaders send values to workers; a checkpoint should be a lens file all the same."""
    lens = pickle.loads(pickle.dumps(aspheric_singlet()))
    assert torch.equal(lens.surfaces[1].coefficients, aspheric_singlet().surfaces[1].coefficients)


LOADED = """
import sys, torch
from raytrace import Lens
lens = torch.load(sys.argv[1])
assert type(lens) is Lens
torch.save([leaf.detach() for leaf in torch.utils._pytree.tree_leaves(lens)], sys.argv[2])
"""


@pytest.mark.slow
def test_a_lens_of_torch_save_is_loaded_by_default_in_another_process(tmp_path):
    """With poses, phases, sag terms, apertures, configurations, an environment, variables and a merit function."""
    lens = dataclasses.replace(double_gauss(), notes=("a note",)).with_configurations(thickness={6: [12.0, 16.0]})
    lens = dataclasses.replace(lens, environment=Environment(torch.tensor(40.0), torch.tensor(1.0))).replace(
        3, tilt_x=1.0, apertures=(rt.system.Aperture("circular", (0.0, 20.0)),)
    )
    lens = lens.replace(
        5,
        phase=rt.system.Grating(frequency=torch.tensor(0.01), order=torch.tensor(1.0)),
        sag_terms=TiltSag(torch.tensor(0.1), torch.tensor(0.2)),
    )
    merit = (rt.system.Row("EFFL", (0, 1), target=100.0, weight=1.0),)
    data = OptimizationData(
        (rt.system.Vary(1, "curvature"),), (Solve(11, "thickness", "marginal_height", (0.0, 0.0)),), merit
    )
    lens = dataclasses.replace(lens, optimization_data=data)
    torch.save(lens, tmp_path / "lens.pt")
    again = torch.load(tmp_path / "lens.pt")
    assert again.optimization_data == data
    words = [sys.executable, "-c", LOADED, str(tmp_path / "lens.pt"), str(tmp_path / "leaves.pt")]
    subprocess.run(words, check=True, env=os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))})
    for copied in (again, copy.deepcopy(lens)):
        for one, other in zip(pytree.tree_leaves(lens), pytree.tree_leaves(copied), strict=True):
            assert one is None or torch.equal(one, other)
    for one, other in zip(pytree.tree_leaves(lens), torch.load(tmp_path / "leaves.pt"), strict=True):
        assert torch.equal(one, other)

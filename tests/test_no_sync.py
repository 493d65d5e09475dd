"""No operator of the trace, forward or backward, makes the host wait for a device."""

import dataclasses
from collections import Counter

import pytest
import torch
from problems import double_gauss, lens, surface, vector
from torch.utils._python_dispatch import TorchDispatchMode

from raytrace.materials.glass import MIRROR
from raytrace.maths.numerics import to
from raytrace.maths.sampling import sobol
from raytrace.system import intersection as search
from raytrace.system.lens import media
from raytrace.system.rays import Rays
from raytrace.system.surface import Aperture
from raytrace.tracing.compiled import trace_engine
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import trace_surfaces

#: Operators whose result, or the shape of it, the host has to read from the device.
READS = {
    "_local_scalar_dense", "item", "is_nonzero", "equal", "nonzero", "nonzero_numpy", "argwhere", "masked_select",
    "unique_dim", "_unique", "_unique2", "unique_consecutive", "bincount", "repeat_interleave", "_assert_async",
}  # fmt: skip
COPIES = {"_to_copy", "copy_", "to"}
#: Operators of this package, and what each runs where no mode can see it.
OWN = {"first_crossing": search.search}


class HostReads(TorchDispatchMode):
    """Count the operators that would make the host wait, were the tensors on a device of their own."""

    def __init__(self):
        super().__init__()
        self.found = Counter()

    def __torch_dispatch__(self, operator, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        library, name = operator._schema.name.split("::")
        if library == "raytrace":
            with self:
                return OWN[name](*args, **kwargs)
        if name in READS or (name in COPIES and leaves_the_device(args, kwargs)) or selects_by_mask(name, args):
            self.found[name] += 1
        return operator(*args, **kwargs)


def leaves_the_device(args, kwargs) -> bool:
    source, devices = args[-1] if len(args) > 1 and isinstance(args[1], torch.Tensor) else args[0], []
    if isinstance(source, torch.Tensor) and source.device.type != "cpu":
        devices = [kwargs.get("device"), args[0].device]
    return any(device is not None and torch.device(device).type == "cpu" for device in devices)


def selects_by_mask(name: str, args) -> bool:
    """Indexing by a mask gives as many entries as are true: the host must know how many."""
    if name not in ("index", "index_put", "index_put_", "_index_put_impl_"):
        return False
    return any(i is not None and i.dtype in (torch.bool, torch.uint8) for i in args[1])


def clipped():
    found = double_gauss()
    edges = [
        Aperture("circular", (0.0, 15.0)),
        Aperture("rectangular", (12.0, 12.0)),
        Aperture("elliptic", (9.0, 10.0), obscures=True),
    ]
    for k, edge in zip((1, 6, 11), edges, strict=True):
        found = found.replace(k, apertures=(edge,))
    return found


def conics():
    return lens([surface(0.02, 4.0, 1.5, conic=-0.7), surface(-0.02, 1.0, conic=0.3), surface(-0.01, 40.0, conic=-1.0)])


def mirrors():
    return lens([surface(-0.002, -200.0, MIRROR, conic=-1.0), surface(-0.003, 150.0, MIRROR), surface(None, 100.0)])


def planes():
    return lens([surface(None, 5.0, 1.5), surface(None, 3.0), surface(0.0, 4.0, 1.6), surface(0.0, 30.0)])


def strong_asphere():
    """An asphere that some rays miss and for some of which Newton's method alone does not find the way."""
    return lens(
        [
            surface(0.02, 5.0, 1.53, conic=-0.4, coefficients=[2e-3, -3e-4, 4e-6], semi_diameter=9.0),
            surface(None, 30.0),
        ],
        aperture=("entrance_pupil_diameter", 24.0),
    )


SYSTEMS = [double_gauss, clipped, conics, mirrors, planes]


def trainable(system):
    """The lens with every curvature, conic, thickness and coefficient asking for a derivative."""

    def leaf(number):
        return None if number is None else number.clone().requires_grad_()

    surfaces = [
        dataclasses.replace(
            s, curvature=leaf(s.curvature), conic=leaf(s.conic), coefficients=leaf(s.coefficients),
            thickness=s.thickness if k == 0 else leaf(s.thickness),
        )
        for k, s in enumerate(system.surfaces)
    ]  # fmt: skip
    return dataclasses.replace(system, surfaces=tuple(surfaces))


def prepared(system, device="cpu"):
    """A trainable lens, its rays, and its media, on the device: what the trace itself is given."""
    system = trainable(to(system, device=device))
    points = sobol(64, device=device)[0]
    with torch.no_grad():
        rays = launch(system, points, fields=vector(0.0, 8.0).to(device)[:, None])
        indices = media(system, system.wavelengths[:, None])
    return system, Rays(rays.position, rays.direction, rays.valid, rays.opl), indices


def forward_and_backward(system, rays, indices):
    end = trace_surfaces(system.surfaces[1:], rays, indices=indices)
    merit = (torch.where(end.valid, end.position[:2], 0.0) ** 2).sum() + torch.where(end.valid, end.opl, 0.0).sum()
    merit.backward()
    return end


def test_reads_are_counted():
    x, mask = vector(1.0, 2.0, 3.0), torch.tensor([True, False, True])
    with HostReads() as reads:
        bool(x.any())
        x[mask]
        float(x[0])
        torch.nonzero(x)
        x.clone()[mask] = x[0]
        torch.where(mask, x, 0.0)
        x[torch.tensor([0, 2])]
    assert sum(reads.found.values()) == 5, reads.found


@pytest.mark.parametrize("make", SYSTEMS)
def test_trace_reads_nothing_back(make):
    system, rays, indices = prepared(make())
    with trace_engine("eager"), HostReads() as reads:
        end = forward_and_backward(system, rays, indices)
    assert not reads.found
    assert bool(end.valid.any())
    slopes = [s.curvature.grad for s in system.surfaces[1:] if s.curvature is not None]
    assert all(bool(torch.isfinite(slope)) for slope in slopes)


@pytest.mark.parametrize("make", SYSTEMS)
def test_trace_without_derivatives_reads_nothing_back(make):
    system, rays, indices = prepared(make())
    with torch.no_grad(), trace_engine("eager"), HostReads() as reads:
        trace_surfaces(system.surfaces[1:], rays, indices=indices)
    assert not reads.found


def test_trace_needs_no_numbers_of_its_rays():
    """Tensors of the device "meta" have a shape and no numbers: whatever reads one raises."""
    _, rays, indices = prepared(clipped())
    there = trainable(to(clipped(), device="meta"))
    media_there = {id(n): n.to("meta") for n in indices}
    with trace_engine("eager"):
        end = trace_surfaces(
            there.surfaces[1:],
            to(rays, device="meta"),
            indices=[media_there[id(n)] for n in indices],
        )
        end.position.sum().backward()
    assert end.position.shape == rays.position.shape
    assert there.surfaces[1].curvature.grad.device.type == "meta"


def test_search_of_an_asphere_reads_nothing_back_off_the_cpu(monkeypatch):
    """On the CPU the search ends when all rays have arrived, which is a read; elsewhere it takes every step it may."""
    found = []
    for early in (True, False):
        if not early:
            monkeypatch.setattr(search, "_reads_are_free", lambda tensor: False)
        system, rays, indices = prepared(strong_asphere())
        with trace_engine("eager"), HostReads() as reads:
            end = forward_and_backward(system, rays, indices)
        # That reads are found where they are shows that they would be.
        assert bool(reads.found) == early
        found.append((end.valid, end.position, end.opl, system.surfaces[1].coefficients.grad))
    for one, other in zip(*found, strict=True):
        assert torch.equal(one, other)
    assert bool(found[0][0].any())
    assert not bool(found[0][0].all())


@pytest.mark.parametrize("kind", ["even asphere", "toroidal"])
def test_roots_by_every_step_are_those_of_the_search_that_ends_early(kind, monkeypatch):
    """Of rays in all directions, most of which cross the surface several times or miss it."""
    generator = torch.Generator().manual_seed(1)
    foot, direction = torch.randn(2, 3, 300, dtype=torch.float64, generator=generator)
    direction = direction / torch.linalg.vector_norm(direction, dim=0)
    of_surface = [torch.tensor(x, dtype=torch.float64) for x in (0.1, 0.3, (0.0, 1e-4, -2e-6))]
    early = search.search(5 * foot, direction, *of_surface, kind, [], "", 6.0)
    monkeypatch.setattr(search, "_reads_are_free", lambda tensor: False)
    late = search.search(5 * foot, direction, *of_surface, kind, [], "", 6.0)
    assert torch.equal(early[0], late[0])
    assert torch.equal(early[1], late[1])
    assert 100 < int(early[1].sum()) < 250


@pytest.mark.slow  # 5 s for every step on a device without numbers; that no step reads one is shown above
def test_search_of_an_asphere_needs_no_numbers_off_the_cpu():
    shapes = {"foot": (3, 5), "direction": (3, 5), "curvature": (), "conic": (), "coefficients": (3,)}
    given = {name: torch.empty(shape, dtype=torch.float64, device="meta") for name, shape in shapes.items()}
    t, met = search.search(**given, kind="even asphere", numbers=[], sag_terms="", rim=9.0)
    assert t.shape == met.shape == (5,)


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
@pytest.mark.parametrize("make", [*SYSTEMS, strong_asphere])
def test_trace_never_synchronises_a_gpu(make):
    forward_and_backward(*prepared(make(), "cuda"))  # loads the libraries
    system, rays, indices = prepared(make(), "cuda")
    torch.cuda.synchronize()
    before = torch.cuda.get_sync_debug_mode()
    torch.cuda.set_sync_debug_mode("error")
    try:
        end = forward_and_backward(system, rays, indices)
    finally:
        torch.cuda.set_sync_debug_mode(before)
    assert bool(end.valid.any())

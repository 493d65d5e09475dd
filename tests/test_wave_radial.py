"""The radial engine: rings, zones and smooth profiles along one radius, and the derivatives of its Bessel functions."""

import dataclasses
import math

import pytest
import torch
from problems import scalar, vector
from problems_waves import PLASTIC, R, Z, lens, relative, scene

from raytrace.psf_models.dft import bessel_j0, bessel_j1
from raytrace.tracing.scene import Memo
from raytrace.wave_optics import propagation
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.element import Element, EvenPowers, Rings
from raytrace.wave_optics.plan import plan


def rings(count=40, pitch=None, radius=R):
    heights = 1e-3 * torch.rand(count, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    return Element(Rings(heights, scalar(radius / count if pitch is None else pitch)), scalar(radius), PLASTIC)


def test_bessel_functions_have_derivatives():
    """Those of torch.special lose the graph without an error."""
    x = torch.tensor([0.0, 0.3, 2.0, 2.4, 7.5, 30.0], dtype=torch.float64, requires_grad=True)
    for function in (bessel_j0, bessel_j1):
        assert function(x).requires_grad
        assert torch.autograd.gradcheck(function, x)
        assert torch.autograd.gradgradcheck(function, x)


def test_rings_against_their_closed_form():
    """Each ring is a difference of two Airy fields, where the wavelets' phase does not vary: at the sphere's centre.

    A lens that focuses carries rings of 0 and of half a wave; U(ρ) = Σ ± (2π/λz) [r J₁(2πρr/λz)/(2πρ/λz)].
    """
    count = 5
    heights = 0.5 * 0.55e-3 * (torch.arange(count) % 2).double()
    zones = Element(Rings(heights, scalar(R / count)), scalar(R), PLASTIC)
    s = scene(lens(), zones)
    rho = torch.linspace(1e-4, 0.05, 200, dtype=torch.float64)
    q = 2 * math.pi * rho / (0.55e-3 * Z)
    edge = torch.linspace(0, R, count + 1, dtype=torch.float64)
    disc = edge[:, None] * bessel_j1(edge[:, None] * q) / q
    signs = 1 - 2 * (torch.arange(count) % 2).double()
    expected = (signs[:, None] * disc.diff(dim=0)).sum(0) * 2 * math.sqrt(math.pi) / (R * 0.55e-3 * Z)
    result = propagation.radial_field(s, rho, 40)[0, 0]
    # The Bessel functions of torch err by up to 5e-7 about x = 5.
    assert (result.real - expected).abs().max() < 3e-6 * expected.abs().max()
    assert result.imag.abs().max() < 1e-9 * expected.abs().max()


def test_rings_of_unlike_pitches_and_the_edge_that_cuts_one():
    """Edges of all rings, sorted, none twice and none beyond the aperture."""
    s = scene(rings(5, 0.5), rings(10, 0.25), rings(3, 0.9))
    expected = [0, 0.25, 0.5, 0.75, 0.9, 1, 1.25, 1.5, 1.75, 1.8, 2, 2.25, 2.5]
    assert torch.allclose(propagation.edges(s), vector(*expected))


def test_zones_lie_where_the_height_has_wrapped():
    """√(2 m λ/P), to a nanometre."""
    power = 1 / 1000 + 1 / Z
    s = scene(dataclasses.replace(lens(), period=scalar(0.55e-3)))
    result = propagation.edges(s)[1:-1]
    m = torch.arange(1, len(result) + 1, dtype=torch.float64)
    assert len(result) == int(R**2 * power / 2 / 0.55e-3)
    assert (result - torch.sqrt(2 * m * 0.55e-3 / power)).abs().max() < 1e-6


def test_nodes_converge():
    """Twice the nodes between the steps of a wrapped lens and of rings change nothing beyond the plan's error."""
    wrapped = dataclasses.replace(lens(), period=scalar(0.55e-3), levels=4)
    for elements in ((wrapped,), (rings(),), (lens(), rings(100))):
        s = scene(*elements, depths=(500.0, math.inf), wavelengths=(0.46, 0.64))
        made = plan(s, tol=1e-3)
        fine = psf(s, samples=2 * made.samples, nodes=10)
        assert relative(psf(s, plan=made).kernel, fine.kernel) < made.error < 1e-3


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("what", ["heights", "coefficients", "distance", "depth", "wavelength", "radius", "pitch"])
def test_gradients(what, exact):
    """Each parameter kind against finite differences, in kernels large enough to see."""
    start = {
        "heights": rings(6, radius=0.5).profile.heights,
        "coefficients": lens().profile.coefficients,
        "distance": scalar(Z),
        "depth": vector(800.0),
        "wavelength": vector(0.55),
        "radius": scalar(0.5),
        "pitch": scalar(0.00369),
    }[what]

    def kernel(number):
        plate, power = rings(6, radius=0.5), lens(radius=0.5)
        if what == "heights":
            plate = dataclasses.replace(plate, profile=Rings(number, plate.profile.pitch))
        if what == "coefficients":
            power = dataclasses.replace(power, profile=EvenPowers(number))
        if what == "radius":
            plate, power = (dataclasses.replace(e, radius=number) for e in (plate, power))
        s = scene(power, plate, depths=(800.0,), size=6, exact=exact)
        s = dataclasses.replace(
            s,
            sensor_distance=number if what == "distance" else s.sensor_distance,
            depths=number if what == "depth" else s.depths,
            wavelengths=number if what == "wavelength" else s.wavelengths,
            grid=dataclasses.replace(s.grid, pitch=number) if what == "pitch" else s.grid,
        )
        return 1e3 * psf(s, plan=made).kernel

    made = plan(scene(lens(radius=0.5), rings(6, radius=0.5), depths=(800.0,), size=6, exact=exact), tol=1e-6)
    step = {"heights": 1e-8, "coefficients": 1e-8, "radius": 1e-6, "pitch": 1e-7, "wavelength": 1e-6}.get(what, 1e-4)
    number = start.clone().requires_grad_()
    assert torch.autograd.gradcheck(kernel, number, eps=step, atol=1e-5, rtol=2e-4)
    assert torch.autograd.grad(kernel(number).square().sum(), number)[0].abs().max() > 0


def test_a_memo_changes_no_result_and_saves_the_bessel_functions():
    """While heights and coefficients vary nothing is made again; anything else that changes is seen."""
    memo, s = Memo(), scene(lens(), rings())
    made = plan(s)
    for step in range(3):
        moved = dataclasses.replace(s, elements=(lens(), _moved(rings(), 1e-5 * step)))
        assert torch.equal(psf(moved, plan=made, memo=memo).kernel, psf(moved, plan=made).kernel)
    assert memo.made == 1
    for change in (
        {"depths": vector(900.0)},
        {"wavelengths": vector(0.56)},
        {"sensor_distance": scalar(Z + 0.01)},
        {"exact": True},
    ):
        moved = dataclasses.replace(s, **change)
        assert torch.equal(psf(moved, plan=made, memo=memo).kernel, psf(moved, plan=made).kernel)
    assert memo.made == 5
    distance = scalar(Z).requires_grad_()
    moved = dataclasses.replace(s, sensor_distance=distance)
    assert psf(moved, plan=made, memo=memo).kernel.requires_grad


def test_a_memo_sees_zones_move():
    """Where a wrapped smooth height jumps depends on its coefficients."""
    memo = Memo()
    for focus in (1000.0, 500.0):
        s = scene(dataclasses.replace(lens(focus), period=scalar(0.55e-3)))
        made = plan(s)
        assert torch.equal(psf(s, plan=made, memo=memo).kernel, psf(s, plan=made).kernel)


def _moved(element, by):
    return dataclasses.replace(element, profile=Rings(element.profile.heights + by, element.profile.pitch))

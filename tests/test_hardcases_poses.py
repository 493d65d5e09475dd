"""Hard cases of tilted, toroidal, diffractive and ideal surfaces: at the cut-off, edge-on, far, tiny, huge.

Whatever becomes of a ray, nothing is NaN, and what is lost steers nothing.
"""

import math

import pytest
import torch
from bends import pose, real
from differences import gradcheck, gradgradcheck
from problems import both_engines, surface, vector
from torch.testing import assert_close

import raytrace as rt
from raytrace.materials.glass import MIRROR
from raytrace.maths.numerics import to
from raytrace.system.poses import Pose
from raytrace.system.rays import Rays, start
from raytrace.system.surface import Surface
from raytrace.tracing.trace import axial_path, trace_surfaces

ONE, WAVELENGTH = real(1.0), real(0.5)
IMAGE = surface()
DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32])


def beam(y, slope=0.0, x=0.0, z=0.0) -> Rays:
    """Rays at heights y whose slopes dy/dz are given; at x, in the plane z."""
    y, slope, x = torch.broadcast_tensors(*(torch.as_tensor(v, dtype=torch.float64) for v in (y, slope, x)))
    return start(torch.stack([x, y, 0 * y + z]), torch.stack([0 * y, slope, 0 * y + 1]), 0 * y)


def bundle(count: int = 40, size: float = 3.0) -> Rays:
    """Rays askew."""
    x, y, u, v = torch.rand(4, count, generator=torch.Generator().manual_seed(3), dtype=torch.float64) * 2 - 1
    return start(size * torch.stack([x, y, 0 * x]), torch.stack([0.1 * u, 0.1 * v, 0 * x + 1]), 0 * x)


def trace(surfaces, rays, *, index=None, dtype=torch.float64, wavelength=WAVELENGTH) -> Rays:
    index = [ONE] * (len(surfaces) + 1) if index is None else index
    surfaces, rays, wavelength = (to(given, dtype=dtype) for given in (surfaces, rays, wavelength))
    distinct = {id(n): n.to(dtype) for n in index}
    return trace_surfaces(surfaces, rays, indices=[distinct[id(n)] for n in index], wavelength=wavelength)


def assert_no_nan(rays: Rays, *leaves: torch.Tensor) -> None:
    """Not in the rays, nor in the derivatives of all of them."""
    assert all(torch.isfinite(part).all() for part in (rays.position, rays.direction, rays.opl))
    if leaves:
        total = rays.position.sum() + rays.direction.sum() + rays.opl.sum()
        for found in torch.autograd.grad(total, leaves, allow_unused=True, retain_graph=True):
            assert found is None or torch.isfinite(found).all()


@both_engines
@DTYPES
@pytest.mark.parametrize("glass", [rt.materials.AIR, MIRROR])
@pytest.mark.parametrize("off", [-64, -1, 0, 1, 64])
def test_an_order_at_its_cut_off(engine, dtype, glass, off):
    """sin θ = order · frequency · λ: below 1 light grazes away, at 1 and above there is none, and it steers nothing."""
    frequency = torch.tensor(2.0 + 4 * off * torch.finfo(dtype).eps, dtype=dtype).requires_grad_()
    grating = surface(None, 0.0, glass, phase=rt.system.Grating(frequency, torch.ones((), dtype=dtype)))
    end = trace([grating], beam([0.0, 1.0]), dtype=dtype)
    assert end.valid.tolist() == [off < 0] * 2
    assert_no_nan(end, frequency)
    (steered,) = torch.autograd.grad(end.direction[2].sum(), frequency, allow_unused=True)
    if off < 0:
        sine = 0.5 * frequency.detach().double()
        assert_close(end.direction[1].double(), sine.expand(2), rtol=0, atol=2 * torch.finfo(dtype).eps)
        cosine = torch.sqrt((1 - sine) * (1 + sine)) * (-1 if glass is MIRROR else 1)
        assert_close(end.direction[2].double(), cosine.expand(2), rtol=1e-3, atol=0)
        assert_close(steered.double(), -2 * 0.5 * sine / cosine, rtol=1e-3, atol=0)
    else:
        assert steered is None or float(steered) == 0


@both_engines
def test_failed_rays_have_no_gradient(engine):
    """The derivatives of all rays are those of the rays that arrive, of tilts, phases and toroids alike."""
    rays = beam(
        torch.linspace(-12, 12, 49, dtype=torch.float64), slope=torch.where(torch.arange(49) % 3 == 0, 0.4, 0.0)
    )

    def derivatives(rays):
        tilt, frequency, terms = real(5.0), real(1.1), vector(-90.0, 30.0)
        leaves = [leaf.requires_grad_() for leaf in (tilt, frequency, terms)]
        surfaces = [
            surface(1 / 30, 3.0, kind="toroidal", coefficients=[1 / 14, 1e-5], before=Pose(tilt_x=tilt)),
            surface(None, 4.0, phase=rt.system.Grating(frequency, ONE), before=Pose(tilt_x=2 * tilt, y=tilt / 9)),
            surface(0.02, 2.0, phase=rt.system.RadialPhase(terms, real(4.0), ONE), semi_diameter=30.0),
            IMAGE,
        ]
        end = trace(surfaces, rays)
        assert_no_nan(end, *leaves)
        return end.valid, torch.autograd.grad((end.position[:2] ** 2).sum() + end.opl.sum(), leaves)

    valid, found = derivatives(rays)
    assert 3 < int(valid.sum()) < 46
    there = Rays(rays.position[:, valid], rays.direction[:, valid], rays.valid[valid], rays.opl[valid])
    for all_rays, arriving in zip(found, derivatives(there)[1], strict=True):
        assert_close(all_rays, arriving, rtol=1e-11, atol=1e-11)


@both_engines
@DTYPES
def test_a_toroid_is_the_sheet_of_its_vertex(engine, dtype):
    """z = R - √((R - g)² - x²): where g has passed R is the inner sheet, which no ray may take for the surface."""
    y, x = torch.meshgrid(torch.linspace(-29, 29, 30), torch.linspace(-12, 12, 25), indexing="ij")
    rays = beam(y.flatten(), x=x.flatten(), z=-1.0)
    radius = real(10.0).requires_grad_()
    toroid = surface(1 / 30, 0.0, kind="toroidal", coefficients=torch.stack([1 / radius]))
    end = trace([toroid], rays, dtype=dtype)
    g = 30 - torch.sqrt(900 - rays.position[1] ** 2)
    inside = (g < 10) & ((10 - g) > rays.position[0].abs())
    clear = ((10 - g) - rays.position[0].abs()).abs() > 1e-3
    assert torch.equal(end.valid[clear], inside[clear])
    sag = 10 - torch.sqrt(torch.where(inside, (10 - g) ** 2 - rays.position[0] ** 2, 0.0))
    sure = inside & clear
    close = 1e-10 if dtype == torch.float64 else 2e-4
    assert_close(end.position[2][sure].double(), sag[sure], rtol=0, atol=close)
    assert_no_nan(end, radius)


@both_engines
@DTYPES
def test_a_cone_at_its_vertex(engine, dtype):
    """z = a r has no normal on its axis, where rays cross it; off the axis the slope a refracts rays."""
    slope = real([0.2, 0.0, 1e-4]).requires_grad_()
    cone = surface(None, 2.0, 1.5, kind="odd asphere", coefficients=slope)
    end = trace([cone, IMAGE], beam([0.0, 1e-30, 1e-9, -1e-9, 1.0]), index=[ONE, real(1.5), real(1.5)], dtype=dtype)
    assert end.valid.all()
    assert_no_nan(end, slope)
    assert float(end.direction[1, 0].detach()) == 0
    angle = math.atan(0.2)
    bent = math.sin(math.asin(math.sin(angle) / 1.5) - angle)
    assert_close(end.direction[1, 2:4].double(), vector(bent, -bent), rtol=1e-6, atol=0)


@both_engines
@DTYPES
@pytest.mark.parametrize("steep", [1e6, -1e6])
def test_an_ideal_lens_at_any_slope(engine, dtype, steep):
    """tan θ′ = tan θ - y/f, of any tan θ, forward and backward; a ray along the plane does not meet it, or goes on."""
    power = real(0.02).requires_grad_()
    ideal = surface(None, 0.0, phase=rt.system.IdealLens(power, power))
    rays = beam([0.0, 10.0, -4.0], slope=[steep, steep, 0.0])
    end = trace([ideal], rays, dtype=dtype)
    assert end.valid.all()
    assert_close((end.direction[1] / end.direction[2]).double(), vector(steep, steep - 0.2, 0.08), rtol=1e-6, atol=0)
    assert_no_nan(end, power)
    along = start(vector(0, 3.0, 0).reshape(3, 1), vector(0, 1.0, 0).reshape(3, 1), torch.zeros(1, dtype=torch.float64))
    for before in ([], [surface(None, 5.0)]):
        end = trace([*before, ideal, IMAGE], along, dtype=dtype)
        assert_no_nan(end, power)
    assert not end.valid.any()


@both_engines
@DTYPES
@pytest.mark.parametrize("kind", [{}, {"curvature": 0.02}, {"glass": MIRROR}, {"glass": 1.5}])
@pytest.mark.parametrize("name", ["tilt_x", "tilt_y"])
def test_a_surface_edge_on(engine, dtype, kind, name):
    """Rays along z in its plane and off it; no coordinate is undefined."""
    rays = beam([-1.0, 0.0, 1.0, 1e-300], x=[-1.0, 0.0, 1.0, -1e-300])
    index = [ONE, real(1.5), real(1.5)] if kind.get("glass") == 1.5 else None
    for tilt in (90.0, 90 + 1e-12, 90 - 1e-12, 270.0):
        leaf = real(tilt).requires_grad_()
        edge = surface(before=Pose(**{name: leaf}), **{"curvature": None, "thickness": 1.0, **kind})
        assert_no_nan(trace([edge, IMAGE], rays, index=index, dtype=dtype), leaf)


def test_the_medium_continues_through_a_break_and_a_mirror_behind_it():
    """A Mangin mirror with a break inside its glass and one that undoes it is the one without."""
    glass = rt.materials.find_glass("N-BK7")
    turn = {"x": 0.5, "tilt_x": 8.0, "tilt_y": -3.0}
    there = rt.system.Surface(thickness=real(0.0), before=pose(**turn), is_break=True)
    again = {name: -number for name, number in turn.items()}
    back = rt.system.Surface(thickness=real(5.0), before=pose(**again, tilts_first=True), is_break=True)
    rows = [dict(radius=-80.0, thickness=5.0, glass=glass), dict(radius=-120.0, thickness=-5.0, glass="MIRROR")]
    plain = rt.lens([*rows, dict(radius=-80.0, thickness=-60.0)], stop=1, entrance_pupil_diameter=10, fields=[0, 2])
    front = plain.replace(1, thickness=real(0.0))
    mirrored = rt.system.Surface(thickness=real(-5.0), before=pose(**again, tilts_first=True), is_break=True)
    surfaces = [
        *front.surfaces[:2], there, back,
        plain.replace(2, thickness=real(0.0)).surfaces[2], there, mirrored, *plain.surfaces[3:],
    ]  # fmt: skip
    broken = rt.Lens(**{**fields_of(plain), "surfaces": tuple(surfaces)})
    ends = [rt.trace(lens, rt.tracing.rays(lens, pupil=rt.maths.gauss_rings(3))) for lens in (plain, broken)]
    assert ends[0].valid.all()
    assert_close(ends[0].position, ends[1].position, rtol=0, atol=1e-12)
    assert_close(ends[0].direction, ends[1].direction, rtol=0, atol=1e-14)


def fields_of(lens: rt.Lens) -> dict:
    return {name: getattr(lens, name) for name in lens.__dataclass_fields__}


@both_engines
@DTYPES
@pytest.mark.parametrize("far", [1.0, 1e6, 1e12])
def test_breaks_that_undo_each_other(engine, dtype, far):
    """To the rounding of the way between them, tilts and all."""
    turn = {"x": far, "y": -2 * far, "z": 0.3 * far, "tilt_x": 20.0, "tilt_y": -33.0, "tilt_z": 71.0}
    back = {name: -number for name, number in turn.items()}
    breaks = [
        Surface(real(0.0), before=pose(**turn), is_break=True),
        Surface(real(4.0), before=pose(**back, tilts_first=True), is_break=True),
    ]
    end = trace([*breaks, IMAGE], bundle(), dtype=dtype)
    plain = trace([surface(None, 4.0), IMAGE], bundle(), dtype=dtype)
    eps = torch.finfo(dtype).eps
    assert_close(end.position, plain.position, rtol=0, atol=8 * eps * (far + 4))
    assert_close(end.direction, plain.direction, rtol=0, atol=8 * eps)
    assert_close(end.opl, plain.opl, rtol=0, atol=16 * eps * (far + 4))


@both_engines
@pytest.mark.parametrize("tiny", [1e-12, 1e-300])
def test_a_tiny_tilt_has_its_tiny_effect(engine, tiny):
    """A mirror turned by α turns light by 2α, to the rounding of 1."""
    mirror = surface(None, -1.0, MIRROR, before=pose(tilt_x=tiny), after=pose(tilt_x=-tiny))
    image = trace([mirror, IMAGE], beam([0.0]))
    assert_close(image.position[1].abs(), vector(math.radians(2 * tiny)), rtol=1e-12, atol=0)


@both_engines
@DTYPES
def test_distant_surfaces_are_missed_or_plane(engine, dtype):
    """A ball 10¹² mm aside is missed and steers nothing; a plane there is the plane here."""
    aside = real(1e12).requires_grad_()
    ball = surface(0.02, 3.0, before=Pose(y=aside))
    end = trace([ball, IMAGE], bundle(), dtype=dtype)
    assert not end.valid.any()
    assert_no_nan(end, aside)
    plane = surface(None, 3.0, before=Pose(y=aside), after=Pose(y=-aside))
    end = trace([plane, IMAGE], bundle(), dtype=dtype)
    assert end.valid.all()
    plain = trace([surface(None, 3.0), IMAGE], bundle(), dtype=dtype)
    assert_close(end.position, plain.position, rtol=0, atol=4 * torch.finfo(dtype).eps * 1e12)
    assert_no_nan(end, aside)


def some_of_all(scale: float) -> list[Surface]:
    """A system of tilts, a toroid, a biconic, phases and an ideal lens, all of its lengths multiplied."""

    def length(number):
        return real(number * scale)

    turn = {"tilt_x": real(9.0), "tilt_y": real(-4.0), "tilt_z": real(30.0)}
    here = Pose(x=length(0.3), y=length(-0.2), z=length(0.1), **turn)
    hologram = rt.system.Hologram(real([1.0, 2.0, -50.0]) * scale, real([0.0, -3.0, 80.0]) * scale, real(0.6), ONE)
    radial = rt.system.RadialPhase(vector(-60.0, 20.0) * scale, length(5.0), ONE)
    free = rt.system.PolynomialPhase(vector(9.0, -7.0, 5.0, 30.0, -20.0) * scale, length(5.0), ONE)
    return [
        surface(0.02 / scale, length(4.0), 1.5, kind="toroidal", coefficients=[0.03 / scale], before=here),
        surface(-0.01 / scale, length(5.0), kind="biconic", coefficients=[0.02 / scale, -0.5]),
        surface(None, length(3.0), phase=rt.system.Grating(real(0.4), ONE), after=here),
        Surface(length(2.0), before=here, is_break=True),
        surface(0.01 / scale, length(2.0), phase=radial),
        surface(None, length(2.0), phase=free),
        surface(None, length(-6.0), MIRROR, phase=hologram),
        surface(
            None, length(-9.0), phase=rt.system.IdealLens(real(0.01 / scale), real(0.02 / scale), real(0.003 / scale))
        ),
        IMAGE,
    ]


@both_engines
@pytest.mark.parametrize(
    ("dtype", "power"), [(torch.float64, 200), (torch.float64, -200), (torch.float32, 16), (torch.float32, -16)]
)
def test_all_of_it_follows_the_scale(engine, dtype, power):
    """Powers of two change no digit: rays come out bit for bit, or nearly, and so do derivatives by a tilt."""
    index = [ONE, real(1.5), *[ONE] * 8]
    found = []
    for scale in (1.0, math.ldexp(1.0, power)):
        surfaces, rays = some_of_all(scale), bundle(size=2.0)
        tilt = real(9.0).requires_grad_()
        surfaces[4] = surface(0.01 / scale, real(2.0 * scale), phase=surfaces[4].phase, before=Pose(tilt_x=tilt))
        rays = Rays(rays.position * scale, rays.direction, rays.valid, rays.opl)
        end = trace(surfaces, rays, index=index, dtype=dtype)
        assert end.valid.float().mean() > 0.6
        (steered,) = torch.autograd.grad(end.position[1].sum(), tilt)
        found.append((end.position / scale, end.direction, end.opl / scale, steered / scale, end.valid))
    close = 1e-12 if dtype == torch.float64 else 2e-3
    for plain, scaled in zip(*found, strict=True):
        assert_close(scaled, plain, rtol=close, atol=close)


@pytest.mark.parametrize("engine", [pytest.param("eager", marks=pytest.mark.slow), "compiled"], indirect=True)
@pytest.mark.parametrize("order", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_derivatives_with_failed_rays_by_every_number(order, engine):
    """By finite differences, of first and of second order; some rays are evanescent, some miss, some are cut off."""
    rays = beam([-9.0, -1.0, 0.5, 2.0, 40.0, 1.0], slope=[0.0, 0.02, -0.03, 0.05, 0.0, 0.95])
    names = ("x", "y", "z", "tilt_x", "tilt_y", "tilt_z")

    def traced(frequency, radii, terms, point, *numbers):
        tilted = Pose(**dict(zip(names, numbers, strict=True)))
        surfaces = [
            surface(radii[0], 3.0, 1.5, kind="toroidal", coefficients=radii[1:], semi_diameter=8.0),
            surface(None, 3.0, phase=rt.system.Grating(frequency, ONE), before=tilted),
            surface(0.01, 4.0, phase=rt.system.RadialPhase(terms, real(5.0), ONE), after=tilted),
            surface(None, 3.0, phase=rt.system.Hologram(point, real([0.0, 3.0, 60.0]), real(0.5), ONE)),
            IMAGE,
        ]
        end = trace(surfaces, rays, index=[ONE, real(1.5), *[ONE] * 4])
        assert 1 < int(end.valid.sum()) < 6
        return end.position[:2], end.direction, end.opl

    given = [real(0.9), vector(0.02, 0.03), vector(-30.0, 5.0), vector(1.0, 2.0, -50.0)]
    given += [real(n) for n in (0.2, -0.1, 0.3, 5.0, -4.0, 30.0)]
    given = [leaf.requires_grad_() for leaf in given]
    if order == 1:
        assert gradcheck(traced, given, atol=1e-6, rtol=1e-5)
    else:
        assert gradgradcheck(lambda *g: traced(*g)[0], given, atol=1e-4, rtol=1e-4, fast_mode=True)


def test_a_fold_by_half_turns_is_the_path_there_and_back():
    """A flat mirror and a break of 180° behind it: light runs along +z once more, path and all."""
    there = surface(None, 0.0, MIRROR)
    back = Surface(real(7.0), before=pose(tilt_y=180.0), is_break=True)
    turned = [surface(None, 5.0), there, back, IMAGE]
    end = trace(turned, bundle())
    plain = trace([surface(None, 12.0), IMAGE], bundle())
    assert_close(end.position[1], plain.position[1], rtol=0, atol=1e-14)
    assert_close(end.position[0], -plain.position[0], rtol=0, atol=1e-14)
    paths = [
        e.opl + axial_path(s, [ONE] * (len(s) + 1)) for e, s in ((end, turned), (plain, [surface(None, 12.0), IMAGE]))
    ]
    assert_close(*paths, rtol=0, atol=1e-13)

"""The PSF of a wave scene: its derivatives, its precision, and hard cases."""

import dataclasses
import math

import pytest
import torch
from differences import gradcheck
from problems import scalar, vector
from problems_waves import PLASTIC, R, Z, lens, relative, scene

import raytrace as rt
from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import InvalidIndex, OutOfRange, sellmeier
from raytrace.maths.numerics import to
from raytrace.psf_models.dft import phasor
from raytrace.tracing.scene import Memo
from raytrace.wave_optics import compute, pupil
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.element import Element, EvenPowers, Pixels, Rings, Zernike, path
from raytrace.wave_optics.plan import plan


def random(*shape, scale=2e-4):
    return scale * torch.rand(*shape, generator=torch.Generator().manual_seed(3), dtype=torch.float64)


def plate(kind, radius=0.3):
    profile = {
        "pixels": Pixels(random(8, 8), scalar(0.075)),
        "zernike": Zernike(random(8)),
        "rings": Rings(random(4), scalar(0.075)),
    }[kind]
    return Element(profile, scalar(radius), PLASTIC)


@pytest.mark.parametrize(
    ("kind", "what"),
    [
        (kind, what)
        for kind in ("zernike", "pixels", "mixed")
        for what in ("heights", "distance", "depth", "wavelength", "radius", "pitch", "centre")
        if (kind, what) != ("mixed", "radius")  # sampled cells move over the steps between pixels
    ],
)
def test_gradients_of_the_pupil_engine(what, kind):
    """Every parameter kind against finite differences; cells that the edge cuts move with the radius."""
    exact = kind == "zernike"
    elements = {
        "zernike": (lens(radius=0.3), plate("zernike")),
        "pixels": (plate("pixels"),),
        "mixed": (lens(radius=0.3), plate("pixels")),
    }[kind]
    free = "coefficients" if kind == "zernike" else "heights"
    start = {
        "heights": getattr(elements[-1].profile, free),
        "distance": scalar(Z),
        "depth": vector(800.0),
        "wavelength": vector(0.55),
        "radius": scalar(0.29),
        "pitch": scalar(0.02),
        "centre": vector(0.01, 0.02),
    }[what]

    def kernel(number):
        parts = elements
        if what == "heights":
            profile = dataclasses.replace(parts[-1].profile, **{free: number})
            parts = (*parts[:-1], dataclasses.replace(parts[-1], profile=profile))
        if what == "radius":
            parts = tuple(dataclasses.replace(e, radius=number) for e in parts)
        s = scene(*parts, depths=(800.0,), size=4, pitch=0.02, exact=exact)
        window = {"pitch": {"pitch": number}, "centre": {"centre": number}}.get(what, {})
        s = dataclasses.replace(
            s,
            sensor_distance=number if what == "distance" else s.sensor_distance,
            depths=number if what == "depth" else s.depths,
            wavelengths=number if what == "wavelength" else s.wavelengths,
            grid=dataclasses.replace(s.grid, **window),
        )
        return 100 * psf(s, plan=made).kernel

    made = plan(scene(*elements, depths=(800.0,), size=4, pitch=0.02, exact=exact), engine="pupil", samples=32, nodes=3)
    step = {"heights": 1e-8, "radius": 1e-6, "pitch": 1e-7, "centre": 1e-6, "wavelength": 1e-6}.get(what, 1e-4)
    number = start.clone().requires_grad_()
    assert gradcheck(kernel, number, eps=step, atol=1e-5, rtol=3e-4)
    assert torch.autograd.grad(kernel(number).square().sum(), number)[0].abs().max() > 0


@pytest.mark.parametrize("engine", ["fresnel", "angular_spectrum"])
def test_gradients_of_the_transfer_functions(engine):
    s = scene(lens(radius=0.2), plate("zernike", 0.2), size=4, exact=engine != "fresnel")
    made = plan(s, engine=engine, samples=64)

    def kernel(coefficients, distance):
        element = dataclasses.replace(s.elements[1], profile=Zernike(coefficients))
        moved = dataclasses.replace(s, elements=(s.elements[0], element), sensor_distance=distance)
        return 100 * psf(moved, plan=made).kernel

    inputs = random(8).requires_grad_(), scalar(Z).requires_grad_()
    assert gradcheck(kernel, inputs, eps=1e-6, atol=1e-5, rtol=1e-3)


@pytest.mark.parametrize("engine", ["pupil", "radial", "fresnel"])
def test_single_precision(engine):
    """complex64 within 1e-4 of complex128, to 10 m and infinity; 1 cm leaves 3e-4 of the light in the window."""
    depths = (10.0, 500.0, 1e4, math.inf)
    glass = find_glass("PMMA")
    thick = Element(EvenPowers(vector(-0.5 * (1e-3 + 1 / Z) / 0.4936)), scalar(0.6), glass)
    s = scene(thick, depths=depths, wavelengths=(0.46, 0.64), size=16)
    result = psf(to(s, dtype=torch.float32), engine=engine, samples={"pupil": 280}.get(engine))
    assert result.kernel.dtype == torch.float32
    expected = psf(s, plan=result.plan)
    assert relative(result.kernel.double()[1:], expected.kernel[1:]) < 1e-4
    assert relative(result.kernel.double(), expected.kernel) < 5e-4


def test_the_naive_phase_would_fail():
    """The canary of the test above: k·r from 10 m steps by 8 rad in float32, and the result is noise."""
    x = torch.linspace(-R, R, 101, dtype=torch.float32)
    r2 = (x * x + (x * x)[:, None]).double()
    naive = (torch.sqrt(r2.float() + 1e4**2) / 0.55e-3).float()
    exact = (r2 / (1e4 + torch.sqrt(r2 + 1e8))) / 0.55e-3
    apart = phasor(naive).to(torch.complex128) - phasor(exact + 1e4 / 0.55e-3)
    assert apart.abs().max() > 1


def test_energy_is_the_light_in_the_window():
    """A window grows towards all of the light, whatever the sharpness, and no kernel is negative."""
    for depth in (1000.0, 500.0):
        energies = [psf(scene(depths=(depth,), size=n, pitch=0.008)).energy for n in (16, 64)]
        assert energies[0] < energies[1] < 1
        assert energies[1] > 0.99
    assert psf(scene()).kernel.min() >= -1e-9
    assert psf(scene(), engine="pupil").kernel.min() >= 0


def test_hard_depths():
    """Infinity, one centimetre, the focus itself and the first zero of the axis, all at once; then one alone."""
    zero = 1 / (1 / 1000.0 + 2 * 0.55e-3 / 0.5**2)  # one wave at the rim
    depths = (math.inf, 10.0, 1000.0, zero)
    s = scene(lens(radius=0.5), depths=depths, size=15)
    ring, cells = psf(s, tol=1e-6), psf(s, engine="pupil", samples=512)
    assert torch.isfinite(ring.kernel).all()
    assert relative(cells.kernel, ring.kernel) < cells.error < 1e-2
    middle = ring.kernel[:, 0, 7, 7]
    assert middle[2] == middle.max()
    assert middle[3] < 0.3 * ring.kernel[3].max()
    alone = psf(scene(lens(radius=0.5), depths=depths[:1], size=15), tol=1e-6)
    assert relative(alone.kernel, ring.kernel[:1]) < 1e-6


@pytest.mark.parametrize("engine", ["pupil", "radial", "fresnel"])
def test_gradients_at_infinity_are_finite(engine):
    """1/z' is what the sphere depends on: the slope in the depth itself is 0 at infinity."""
    for exact in (False, True):
        s = scene(lens(radius=0.5, exact=exact), size=8, depths=(math.inf, 1000.0), exact=exact)
        depths = s.depths.clone().requires_grad_()
        kernel = psf(dataclasses.replace(s, depths=depths), engine=engine).kernel
        gradient = torch.autograd.grad(kernel.square().sum(), depths)[0]
        assert gradient[0] == 0
        assert torch.isfinite(gradient).all()


def test_wavelengths_that_the_glass_does_not_know():
    """Refused where there is no index, named where it is extrapolated."""
    glass = sellmeier(vector(1.0), vector(0.25), "TEST", wavelength_range=(0.52, 0.7))
    for wavelength, expectation in ((0.45, pytest.raises(InvalidIndex)), (0.51, pytest.warns(OutOfRange))):
        with expectation:
            psf(scene(dataclasses.replace(lens(), glass=glass), wavelengths=(wavelength,)))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"elements": ()}, "needs an element"),
        ({"depths": scalar(5.0)}, "expected depths"),
        ({"depths": vector(5.0, 0.0)}, "depths .* greater than 0"),
        ({"wavelengths": vector(-0.5)}, "wavelengths .* greater than 0"),
        ({"sensor_distance": scalar(0.0)}, "sensor distance .* greater than 0"),
        ({"sensor_distance": scalar(math.inf)}, "infinite"),
    ],
)
def test_scenes_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ValueError, match=message):
        psf(dataclasses.replace(scene(), **change))


def test_a_window_that_is_not_square():
    """Rows and columns differ: a wide window holds the middle of a square one."""
    element = (lens(), Element(Zernike(vector(0, 0, 0, 0, 1e-4, 2e-4, 1e-4)), scalar(R), PLASTIC))
    square, wide = psf(scene(*element, size=20), samples=160), psf(scene(*element, size=(8, 20)), samples=160)
    assert wide.kernel.shape == (1, 1, 8, 20)
    assert relative(wide.kernel, square.kernel[..., 6:14, :]) < 1e-12
    rounded = [psf(scene(size=n), samples=60).kernel for n in (20, (8, 20))]
    assert relative(rounded[1], rounded[0][..., 6:14, :]) < 1e-4


def test_a_tilted_element_moves_the_light():
    """Light is bent towards the thicker side: a slope 2c/R of the path along x moves it by z times that, two pixels."""
    tilt = Element(Zernike(vector(0, 2 * 0.00369 * R / (2 * Z))), scalar(R), PLASTIC)
    result, straight = (psf(scene(lens(), *extra, size=33), samples=160, nodes=5) for extra in ((tilt,), ()))
    assert relative(result.kernel[..., 2:], straight.kernel[..., :-2]) < 1e-3


@pytest.mark.parametrize("kind", ["zernike", "pixels"])
def test_a_memo_of_the_pupil_engine(kind):
    memo, elements = Memo(), (plate(kind),)
    s = scene(*elements, size=8)
    made = plan(s)
    free = "coefficients" if kind == "zernike" else "heights"
    for factor in (1.0, 0.5):
        profile = dataclasses.replace(elements[0].profile, **{free: factor * getattr(elements[0].profile, free)})
        moved = dataclasses.replace(s, elements=(dataclasses.replace(elements[0], profile=profile),))
        assert torch.equal(psf(moved, plan=made, memo=memo).kernel, psf(moved, plan=made).kernel)
    assert memo.made == 1


@pytest.mark.parametrize("size", [6, 7])
def test_kernels_one_by_one_are_those_at_once_and_share_the_light_behind_the_pixels(monkeypatch, size):
    element = plate("pixels")
    options = {"sensor": float(Z), "depths": [500.0, 1000.0, math.inf], "wavelengths": [0.46, 0.55], "size": size}
    at_once = rt.wave_optics.wave_psf(element, **options)
    monkeypatch.setattr(compute, "_CHUNK", 0.0)
    made, behind = [], pupil.behind_pixels
    monkeypatch.setattr(pupil, "behind_pixels", lambda *scene: made.append(scene) or behind(*scene))
    alone = rt.wave_optics.wave_psf(element, **options)
    assert len(made) == 2  # of the wavelengths
    assert relative(alone.kernel, at_once.kernel) < 1e-14
    assert (alone.axial is None) == (size == 7)
    assert alone.axial is None or torch.allclose(alone.axial, at_once.axial, rtol=1e-14, atol=0)
    assert alone.kernel.shape == (3, 2, size, size)


@pytest.mark.parametrize(("shape", "parts", "middle"), [((9, 9), 3, (0.0, 0.0)), ((8, 10), 4, (0.02, -0.01))])
def test_pixels_that_the_edge_leaves_whole_are_summed_as_their_cells(shape, parts, middle):
    """Against the sum over every cell with its area in the aperture, with derivatives by heights, radius and pitch."""
    heights, radius, pitch = (
        random(*shape).requires_grad_(),
        scalar(0.29).requires_grad_(),
        scalar(0.075).requires_grad_(),
    )
    element = Element(Pixels(heights, pitch), radius, PLASTIC)
    s = scene(element, size=4)
    s = dataclasses.replace(s, grid=dataclasses.replace(s.grid, centre=vector(*middle)))
    sums = pupil.prepare_pixels(s, 3, 2, parts=parts)
    assert 0 < len(sums.rows) < shape[0] * shape[1]  # some are cut, and some are whole
    x, y, cell = pupil._lattice(s, parts)
    edges = [torch.cat([c - 0.5 * cell, c[-1:] + 0.5 * cell]) / radius for c in (x, y)]
    light = radius**2 * pupil._cell_areas(*edges) / (s.sensor_distance * math.sqrt(math.pi) * radius)
    wavelengths = 1e-3 * s.wavelengths[:, None, None]
    U = (
        light
        / wavelengths
        * phasor(path(s.elements, *torch.broadcast_tensors(x, y[:, None]), s.wavelengths) / wavelengths)
    )
    U = sums.to_pixels.along_y @ U @ sums.to_pixels.along_x.mT
    every, found = U.real**2 + U.imag**2, pupil.intensity(s, sums)
    torch.testing.assert_close(found, every, rtol=0, atol=1e-13 * float(every.detach().max()))
    weights = random(*every.shape)
    by = [heights, radius, pitch]
    slopes, wanted = (torch.autograd.grad((t * weights).sum(), by, retain_graph=True) for t in (found, every))
    for slope, other in zip(slopes, wanted, strict=True):
        torch.testing.assert_close(slope, other, rtol=0, atol=1e-11 * float(other.abs().max()))

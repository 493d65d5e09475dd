"""Super-resolution by a phase element: pictures finer than the sensor's pixels, from one exposure.

A sensor pixel covers s × s pixels of the picture (`inversion`). Two ways to use the element are compared:

    full frame    the scene fills the sensor: a kernel can only choose which of the s² aliases of a frequency is seen;
                  learned by the closed-form error of the best linear inversion, over Noll's polynomials on a lens
    multiplexed   a small scene on a dark ground, shown at V places apart, each at another part of a sensor pixel:
                  V equations for s² aliases, inverted jointly

A wedge of path x·u/z shows the scene at u. A plate shows it at V places by a wedge on each sector of the aperture, by
the phase of all their waves added, or by heights that are learned; each place has about 1/V of the light.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.imaging.restoration import mean_square_error, psnr
from raytrace.imaging.variables import PhaseVariables
from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import index
from raytrace.maths.value import detached
from raytrace.studies.descent import minimise
from raytrace.studies.edof.world import WAVELENGTH, World, scene, spectrum
from raytrace.studies.pictures import Pictures, draws
from raytrace.studies.superres.inversion import (
    bicubic,
    coarse_transfer,
    inversion,
    inversion_errors,
    joint_errors,
    joint_inversion,
    joint_superresolve,
    superresolve,
)
from raytrace.tracing.scene import Memo
from raytrace.wave_optics.compute import psf
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element, Pixels, Zernike
from raytrace.wave_optics.plan import plan

#: Pixels of the picture along a small scene, of its dark border, and of the window of one place.
FIELD, BORDER, TILE = 96, 16, 47
_CELLS = 400  # of a plate, across the aperture
_START = 23  # last number of the key of a random start

Elements = tuple[Element, ...]


def world_of(wavelengths: Sequence[float], *, noise: float = 0.01, depth: float = 1000.0, size: int = 65) -> World:
    """One depth in focus. size: odd, so that kernels stand on a pixel and bicubic pictures in place."""
    return World(depths=(depth,), design=depth, wavelengths=tuple(wavelengths), size=size, noise=noise)


def lens(world: World) -> Elements:
    """The plain PMMA lens for the world's depth, at 0.55 µm."""
    return baseline("singlet", aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design))


def kernels(elements: Elements, world: World) -> Tensor:
    """(W, size, size) of the world's one depth, 1 = all light through the aperture."""
    return psf(scene(elements, world)).kernel[0]


def coarse(kernel: Tensor, size: int, factor: int) -> Tensor:
    """T (..., size, size) of kernels (..., h, w) and large pixels; light that misses the window is even haze."""
    T = coarse_transfer(kernel, size, factor)
    haze = torch.zeros_like(T.real)
    haze[..., 0, 0] = 1
    return T + haze * (1 - kernel.sum((-2, -1)))[..., None, None]


def error_of(T: Tensor, S: Tensor, noise: float, factor: int) -> Tensor:
    """Mean square error of the best linear inversion that knows the kernels: mean over T (W, n, n)."""
    return inversion_errors(T[None], S, noise, factor).mean()


# --- full frame


def polynomials_on_lens(world: World, terms: int = 45) -> PhaseVariables:
    """Noll's polynomials up to `terms`, from none, in contact with the plain lens that stays; changes in µm RMS."""
    plain = lens(world)
    radius = plain[0].radius.detach()
    return PhaseVariables(Element(Zernike(radius.new_zeros(terms)), radius, find_glass("PMMA")), others=plain)


def learn(
    variables: PhaseVariables, world: World, S: Tensor, factor: int, *, steps: int = 60, start: Tensor | None = None
) -> tuple[float, ...]:
    """Bring variables to the least closed-form error; returns its course. start: changes to begin with."""
    if start is not None:
        with torch.no_grad():
            variables.change.copy_(start)
    how, memo = plan(scene(variables(), world)), Memo()

    def error() -> Tensor:
        kernel = psf(scene(variables(), world), plan=how, memo=memo).kernel[0]
        return error_of(coarse(kernel, S.shape[-1], factor), S, world.noise, factor)

    return minimise([variables.change], error, steps=steps).course


def learned_lens(
    world: World,
    S: Tensor,
    factor: int,
    *,
    terms: int = 45,
    starts: int = 2,
    spread: float = 0.03,
    steps: int = 60,
    seed: int = 0,
) -> Elements:
    """The best of the plain lens and so many random starts around it (µm RMS a term), each learned."""
    best, least = None, math.inf
    for number in range(starts + 1):
        own = polynomials_on_lens(world, terms)
        random = torch.as_tensor(draws(seed, number, _START).standard_normal(terms)).to(own.change)
        found = learn(own, world, S, factor, steps=steps, start=spread * random if number else None)
        if min(found) < least:
            best, least = own, min(found)
    return detached(best())


def taken(pictures: Tensor, T: Tensor, factor: int, noise: Tensor) -> Tensor:
    """Images (B, W, n/s, n/s) of periodic pictures (B, n, n); noise: added."""
    seen = torch.fft.ifft2(torch.fft.fft2(pictures)[:, None] * T).real
    return seen[..., ::factor, ::factor] + noise


def noise_for(shape: Sequence[int], deviation: float, *, seed: int = 0) -> Tensor:
    """Drawn once, float64: the same of every element on the same sensor."""
    generator = torch.Generator().manual_seed(seed)
    return deviation * torch.randn(*shape, generator=generator, dtype=torch.float64)


# --- multiplexed


def small_scenes(pictures: Pictures) -> Tensor:
    """Scenes (B, FIELD, FIELD) in [0, 1] on a dark ground: the middle of pictures, faded at its border."""
    side = FIELD - 2 * BORDER
    fade = torch.sin(math.pi * (torch.arange(side, dtype=torch.float64) + 0.5) / side).clamp(max=0.5) * 2
    found = []
    for sample in pictures.samples:
        if min(sample.shape) < side:
            raise ValueError(f"a picture of {sample.shape[0]} × {sample.shape[1]} pixels, expected {side} at least")
        row, column = ((n - side) // 2 for n in sample.shape)
        patch = torch.as_tensor(sample[row : row + side, column : column + side].astype(np.float64) / 255)
        found.append(torch.nn.functional.pad(patch * fade[:, None] * fade, (BORDER,) * 4))
    return torch.stack(found)


def places_of(count: int) -> tuple[tuple[int, int], ...]:
    """(row, column) of 3 or 4 places a field apart: pixels of the picture, whole ones of sensors 2 or 3 × larger."""
    half = FIELD // 2
    found = {
        3: ((-half, -half), (-half, half), (half, 0)),
        4: ((-half, -half), (-half, half), (half, -half), (half, half)),
    }
    if count not in found:
        raise ValueError(f"{count} places: expected 3 or 4")
    return found[count]


def parts_of_a_pixel(count: int, factor: int) -> Tensor:
    """(count, 2): the first places as they are, half a sensor pixel right, down, and both; in pixels of the picture."""
    return 0.5 * factor * torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]][:count], dtype=torch.float64)


@dataclasses.dataclass(frozen=True)
class Plate:
    """The plain lens, and where a plate of square cells in contact with it shows the scene: pixels of the picture.

    places: whole pixels of the sensor, where views are cut out; parts: (V, 2) pixels beside them.
    """

    world: World
    places: tuple[tuple[int, int], ...]
    parts: Tensor

    def paths(self) -> Tensor:
        """(V, cells, cells) mm of the wedges."""
        return wedges(self.world, torch.tensor(self.places) + self.parts, _CELLS)

    def elements(self, path: Tensor) -> Elements:
        """The plate of a path (cells, cells) mm, and the lens."""
        return plated(self.world, path)


def wedges(world: World, places: Tensor, cells: int) -> Tensor:
    """x·u/z (V, cells, cells) mm of a wedge to each of places (V, 2), pixels of the picture from the axis."""
    x = (torch.arange(cells, dtype=torch.float64) - 0.5 * (cells - 1)) * (2 * world.radius / cells)
    u = places * (world.pixel / world.sensor_distance)
    return u[:, :1, None] * x[:, None] + u[:, 1:, None] * x


def plated(world: World, path: Tensor) -> Elements:
    """The plate of PMMA of a path (cells, cells) mm at the design's wavelength, in contact with the plain lens."""
    plain, glass = lens(world), find_glass("PMMA")
    radius, excess = plain[0].radius.detach(), index(glass, path.new_tensor(WAVELENGTH)) - 1
    return Element(Pixels(path / excess, 2 * radius / len(path)), radius, glass), *plain


def summed(paths: Tensor, *key: int) -> Tensor:
    """The phase of the waves of paths (V, cells, cells) mm, added, as a path (cells, cells) mm:

    λ₀/2π · arg Σ_v exp(i (2π/λ₀ path_v + φ_v))     φ_v drawn by the key: in step, orders would meet at the places
    """
    phase = 2 * math.pi / (1e-3 * WAVELENGTH) * paths
    drawn = torch.as_tensor(draws(*key).uniform(0, 2 * math.pi, len(paths)))
    total = torch.polar(torch.ones_like(phase), phase + drawn[:, None, None]).sum(0)
    return 1e-3 * WAVELENGTH / (2 * math.pi) * torch.angle(total)


def sectors(plate: Plate) -> Elements:
    """A wedge on each of as many equal sectors: nothing is wasted, but every place has the blur of its sector."""
    paths = plate.paths()
    side = torch.arange(_CELLS, dtype=paths.dtype) - 0.5 * (_CELLS - 1)
    turn = torch.atan2(side[:, None], side) / (2 * math.pi) % 1
    own = (turn * len(paths)).long().clamp(max=len(paths) - 1)
    return plate.elements(paths.gather(0, own[None])[0])


def hologram(plate: Plate, *, seed: int = 0) -> Elements:
    """The phase of all wedges' waves added: every place has the blur of the whole aperture, some light goes astray."""
    paths = plate.paths()
    return plate.elements(summed(paths, seed, len(paths), _START))


def learn_heights(plate: Plate, elements: Elements, S: Tensor, factor: int, *, steps: int = 30) -> Elements:
    """Free heights of all cells at the least closed-form error of the joint inversion, from a plate's own."""
    # Of 160 000 heights each does little: in units of 0.1 mm gradients are well above where L-BFGS ends.
    variables = PhaseVariables(elements[0], unit=0.1, others=elements[1:])
    memo = Memo()

    def error() -> Tensor:
        kernel = wide_kernels(variables(), plate.world, samples=_CELLS, memo=memo)
        return joint_error_of(kernel, plate.places, S, plate.world.noise, factor)

    minimise([variables.change], error, steps=steps)
    return detached(variables())


def wide_kernels(elements: Elements, world: World, *, samples: int = 2 * _CELLS, memo: Memo | None = None) -> Tensor:
    """(W, K, K) of a plate, over all places; samples: across the aperture, a multiple of the cells."""
    found = scene(elements, dataclasses.replace(world, size=FIELD + TILE + 2))
    return psf(found, plan=plan(found, engine="pupil", samples=samples, nodes=4), memo=memo).kernel[0]


def tiles(kernel: Tensor, places: Sequence[tuple[int, int]]) -> Tensor:
    """Kernels (..., V, TILE, TILE) of the places, out of one (..., K, K)."""
    middle, half = kernel.shape[-1] // 2, TILE // 2
    found = []
    for row, column in places:
        rows, columns = (slice(middle + n - half, middle + n + half + 1) for n in (row, column))
        found.append(kernel[..., rows, columns])
    return torch.stack(found, -3)


def joint_error_of(kernel: Tensor, places: Sequence[tuple[int, int]], S: Tensor, noise: float, factor: int) -> Tensor:
    """Mean square error of the joint inversion of all places, in closed form, mean over colours.

    Light beside the places throws other images of the scene over the views: more noise, σ² + ⟨S⟩ Σ k² over it.
    """
    own = tiles(kernel, places)
    astray = kernel.square().sum((-2, -1)) - own.square().sum((-3, -2, -1))
    sigma = torch.sqrt(noise**2 + S.mean() * astray.clamp_min(0.0).mean())
    return joint_errors(coarse_transfer(own, FIELD, factor)[None], S, sigma, factor).mean()


def sensor_image(scenes: Tensor, kernel: Tensor, factor: int) -> Tensor:
    """Images (B, W, M/s, M/s) without noise of scenes (B, n, n) on a dark ground, as far as kernels (W, K, K) reach."""
    side = _reach(kernel, factor)
    dark = torch.nn.functional.pad(scenes, (side,) * 4)
    T = coarse_transfer(kernel, dark.shape[-1], factor)
    return taken(dark, T, factor, T.real.new_zeros(()))


def views(sensor: Tensor, kernel: Tensor, places: Sequence[tuple[int, int]], factor: int) -> Tensor:
    """What lies at the places of a sensor: (..., V, n/s, n/s)."""
    side, n = _reach(kernel, factor), FIELD // factor
    found = []
    for row, column in places:
        top, left = (side + row) // factor, (side + column) // factor
        found.append(sensor[..., top : top + n, left : left + n])
    return torch.stack(found, -3)


def _reach(kernel: Tensor, factor: int) -> int:
    return -(-(kernel.shape[-1] // 2) // factor) * factor


# --- what each is worth


@dataclasses.dataclass(frozen=True)
class Row:
    """One way to a picture. closed, psnr: dB, of the closed form (None of bicubic) and of restored test pictures;
    by_colour: (W,) dB; estimate: (B, W, n, n) the restored pictures."""

    name: str
    closed: float | None
    psnr: float
    by_colour: tuple[float, ...]
    estimate: Tensor = dataclasses.field(repr=False, compare=False)


def row_of(name: str, closed: Tensor | None, estimate: Tensor, pictures: Tensor) -> Row:
    """Judge estimates (B, W, n, n) of pictures (B, n, n)."""
    left = mean_square_error(estimate, pictures[:, None]).mean(0)
    dB = None if closed is None else float(psnr(closed))
    return Row(name, dB, float(psnr(left.mean())), tuple(psnr(left).tolist()), estimate)


@torch.no_grad()
def full_frame(
    elements: dict[str, Elements], world: World, factor: int, *, train: Tensor, test: Tensor, seed: int = 0
) -> list[Row]:
    """Of every element the MMSE inversion, and of the first bicubic interpolation; test pictures (B, n, n) periodic."""
    S, n = spectrum(train), test.shape[-1]
    noise = noise_for((len(test), len(world.wavelengths), n // factor, n // factor), world.noise, seed=seed)
    rows = []
    for name, own in elements.items():
        T = coarse(kernels(own, world), n, factor)
        image = taken(test, T, factor, noise)
        if not rows:
            rows.append(row_of(f"{name}, bicubic", None, bicubic(image, factor), test))
        restored = superresolve(image, inversion(T[None], S, world.noise, factor), factor)
        rows.append(row_of(f"{name}, MMSE", error_of(T, S, world.noise, factor), restored, test))
    return rows


@torch.no_grad()
def multiplexed(
    name: str, kernel: Tensor, plate: Plate, factor: int, *, train: Tensor, test: Tensor, seed: int = 0
) -> tuple[Row, Tensor]:
    """The joint inversion of a kernel's (W, K, K) places, and its sensor images; scenes (B, FIELD, FIELD)."""
    S, noise, places = spectrum(train), plate.world.noise, plate.places
    sensor = sensor_image(test, kernel, factor)
    sensor = sensor + noise_for(sensor.shape, noise, seed=seed)
    T = coarse_transfer(tiles(kernel, places), FIELD, factor)[None]
    G = joint_inversion(T, S, noise, factor)
    found = joint_superresolve(views(sensor, kernel, places, factor), G, factor)
    return row_of(name, joint_error_of(kernel, places, S, noise, factor), found, test), sensor

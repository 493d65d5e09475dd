"""Extended depth of field: how well one phase element and one linear filter show scenes at every depth, in all colours.

The pictures are periodic (mirrored to twice their size, so that nothing jumps), each at one depth. Light that lands
beyond the window of the kernel is no loss: it comes back as haze, even over the picture. Two filters restore them: the
classic Wiener filter of the design depth with the best constant γ, and the best linear one that knows no depth.
"""

import dataclasses
import functools
import math
import warnings
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import scipy.optimize
import torch
from torch import Tensor, nn

from raytrace.imaging.image import transfer_functions
from raytrace.imaging.octant import Octant, fits
from raytrace.imaging.pictures import Pictures, draws
from raytrace.imaging.restoration import depth_invariant_error, depth_invariant_wiener, power_spectrum, psnr, wiener
from raytrace.maths.grid import grid
from raytrace.maths.result import Result
from raytrace.optimization.solver import NoOptimum, minimise_tensors
from raytrace.tracing.scene import Memo
from raytrace.wave_optics.compute import ElementPsf, psf
from raytrace.wave_optics.element import Element, Rings
from raytrace.wave_optics.plan import plan
from raytrace.wave_optics.scene import WaveScene, is_round

FILTERS = ("wiener", "blind")  # of restoration
WAVELENGTH = 0.55  # µm: that elements are designed for, and wrapped at
_START = 21  # last number of the key of a random start


@dataclasses.dataclass(frozen=True)
class WaveCameraConfig:
    """Where the camera works. Lengths in mm, wavelengths in µm.

    depths: of the scenes; design: the depth whose kernel the Wiener filter inverts; pixel, size: of the window of the
    kernels, an odd number, so that no picture is shifted; noise: standard deviation, for pictures in [0, 1].
    """

    radius: float = 2.5
    sensor_distance: float = 35.5
    depths: tuple[float, ...] = (500.0, 2000 / 3, 1000.0, 2000.0, math.inf)
    design: float = 1000.0
    wavelengths: tuple[float, ...] = (0.46, 0.55, 0.64)
    pixel: float = 0.00369
    size: int = 255
    noise: float = 0.01
    exact: bool = False


def depth_text(depth: float, infinity: str = "infinity") -> str:
    """A depth in mm as a reader would say it."""
    return infinity if math.isinf(depth) else f"{1e-3 * depth:.3g} m"


def scene(elements: Sequence[Element], world: WaveCameraConfig, *, depths: Sequence[float] | None = None) -> WaveScene:
    """What a world looks like through elements in contact."""
    like = elements[0].radius
    return WaveScene(
        elements=tuple(elements),
        sensor_distance=like.new_tensor(world.sensor_distance),
        depths=like.new_tensor(world.depths if depths is None else depths),
        wavelengths=like.new_tensor(world.wavelengths),
        grid=grid(like.new_tensor(world.pixel), world.size),
        exact=world.exact,
    )


def kernels(
    elements: Sequence[Element], world: WaveCameraConfig, *, depths: Sequence[float] | None = None
) -> ElementPsf:
    """PSFs of elements in a world. Where they are not round, depth by depth, for memory, to half a per cent; rings with
    anything else are sampled at their own pitch (2,500 cells across 5 mm of 2 µm rings).
    """
    own = scene(elements, world, depths=depths)
    if is_round(own):
        return psf(own)
    samples = None
    rings = [element.profile.pitch for element in elements if isinstance(element.profile, Rings)]
    if rings:
        samples = math.ceil(float(2 * elements[0].radius / min(rings)))
    parts = [
        psf(dataclasses.replace(own, depths=depth[None]), tol=5e-3, samples=samples) for depth in own.depths.unbind()
    ]
    return ElementPsf(torch.cat([part.kernel for part in parts]), own, parts[0].plan)


def transfer(found: ElementPsf, size: int) -> Tensor:
    """H (D, W, size, size) of kernels normalised by the light through the aperture; what misses the window is haze."""
    H = transfer_functions(found.kernel, size)
    haze = torch.zeros_like(H.real)
    haze[..., 0, 0] = 1
    return H + haze * (1 - found.energy)[..., None, None]


def periodic(pictures: Pictures, size: int) -> Tensor:
    """Pictures (B, size, size) in [0, 1], float64: the middle of each, mirrored to one period of an endless picture."""
    half, found = size // 2, []
    for sample in pictures.samples:
        if min(sample.shape) < half:
            raise ValueError(f"a picture of {sample.shape[0]} × {sample.shape[1]} pixels, expected {half} at least")
        row, column = ((n - half) // 2 for n in sample.shape)
        found.append(mirrored(sample[row : row + half, column : column + half].astype(np.float64) / 255))
    return torch.as_tensor(np.stack(found))


def mirrored(picture: np.ndarray) -> np.ndarray:
    """A picture (h, w) and its mirror images: one period (2h, 2w) of a picture without a jump."""
    picture = np.concatenate([picture, picture[::-1]], 0)
    return np.concatenate([picture, picture[:, ::-1]], 1)


def spectrum(pictures: Tensor) -> Tensor:
    """S (size, size) of periodic pictures (B, size, size)."""
    return power_spectrum(pictures, window="none")


def power(picture: Tensor) -> Tensor:
    """|X|² (n, n) of a periodic picture (n, n), over the number of its pixels."""
    transformed = torch.fft.fft2(picture)
    return (transformed.real**2 + transformed.imag**2) / picture.numel()


def errors_of_pictures(H: Tensor, G: Tensor, noise: float, powers: Tensor) -> Tensor:
    """Mean square errors (B, D, W) of pictures of `power` (B, n, n) behind filters G, expected over noise."""
    left = torch.view_as_real(1 - G * H).square().sum(-1).flatten(2)  # (D, W, n²)
    added = noise**2 * torch.view_as_real(G).square().sum(-1).mean((-2, -1))
    return (left @ powers.flatten(1).T / left.shape[-1]).movedim(-1, 0) + added


def expected_error(H: Tensor, S: Tensor, noise: float) -> Tensor:
    """Mean square error behind the best blind filter, in closed form, mean over colours."""
    return depth_invariant_error(H, S, noise).mean()


class ClosedForm:
    """`expected_error` of elements in one world, for pictures of spectrum S (n, n); differentiable. What their heights
    do not change is kept: first, the elements that the sampling is planned for, have their steps where others will.
    dtype: of the sums over a radius.
    """

    def __init__(
        self, first: Sequence[Element], world: WaveCameraConfig, S: Tensor, *, dtype: torch.dtype = torch.float64
    ):
        self.world, self.S, self._memo, self._dtype = world, S, Memo(), dtype
        self._first = scene(first, world)
        self.plan = plan(self._first)

    @functools.cached_property
    def _octant(self) -> Octant | None:
        if not fits(self._first, self.plan, self.S):
            return None
        return Octant(self._first, self.plan, self.S.shape[-1], dtype=self._dtype)

    def __call__(self, elements: Sequence[Element]) -> Tensor:
        if self._octant is not None:
            return self._octant.error(scene(elements, self.world), self.S, self.world.noise)
        return expected_error(self.transfer(elements), self.S, self.world.noise)

    def transfer(self, elements: Sequence[Element]) -> Tensor:
        """H (D, W, n, n)."""
        return transfer(psf(scene(elements, self.world), plan=self.plan, memo=self._memo), self.S.shape[-1])


@dataclasses.dataclass(frozen=True)
class Quality:
    """What an element is worth, by filter: PSNR in dB of restored pictures.

    by_depth: (D,) of each filter, of the error pooled over pictures and colours; mean: over the depths; of_pictures:
    the mean of the PSNRs of single pictures at each depth; spread: best less worst depth; by_colour: (W,), mean over
    the depths; gamma: of the Wiener filter; energy: (D, W) inside the window.
    """

    by_depth: dict[str, tuple[float, ...]]
    by_colour: dict[str, tuple[float, ...]]
    mean: dict[str, float]
    of_pictures: dict[str, float]
    spread: dict[str, float]
    gamma: float
    energy: tuple[tuple[float, ...], ...]


@torch.no_grad()
def quality(
    elements: Sequence[Element],
    world: WaveCameraConfig,
    *,
    train: Tensor,
    test: Tensor,
    found: ElementPsf | None = None,
) -> Quality:
    """Of test pictures (B, N, N), expected over noise, behind filters made for training pictures (A, N, N) alone."""
    found = kernels(elements, world) if found is None else found
    size = test.shape[-1]
    H, S = transfer(found, size), spectrum(train)
    if world.design in world.depths:
        at_design = H[world.depths.index(world.design)]
    else:
        at_design = transfer(kernels(elements, world, depths=[world.design]), size)[0]
    gamma = best_gamma(H, S, world.noise, at_design)
    filters = {"wiener": wiener(at_design, gamma), "blind": depth_invariant_wiener(H, S, world.noise)}
    powers = torch.stack([power(picture) for picture in test])
    by_depth, by_colour, of_pictures = {}, {}, {}
    for name, G in filters.items():
        each = errors_of_pictures(H, G, world.noise, powers)  # (B, D, W)
        left = each.mean(0)
        of_pictures[name] = float(psnr(each.mean(-1)).mean())
        by_depth[name] = tuple(psnr(left.mean(1)).tolist())
        by_colour[name] = tuple(psnr(left).mean(0).tolist())
    return Quality(
        by_depth,
        by_colour,
        {name: float(np.mean(values)) for name, values in by_depth.items()},
        of_pictures,
        {name: max(values) - min(values) for name, values in by_depth.items()},
        gamma,
        tuple(map(tuple, found.energy.tolist())),
    )


@dataclasses.dataclass(frozen=True)
class Judged(Result):
    """Elements in a world: their kernels and what they are worth."""

    elements: Sequence[Element]
    world: WaveCameraConfig
    kernels: ElementPsf
    quality: Quality

    FIGURE = "plotting.wave_design.element_figure"


def restored(H: Tensor, G: Tensor, pictures: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """What the sensor sees and what the filter makes of it, each (B, W, N, N), of pictures (B, N, N) at one depth.

    H, G: (W, N, N); noise: (B, W, N, N), added.
    """
    seen = torch.fft.ifft2(torch.fft.fft2(pictures)[:, None] * H).real + noise
    return seen, torch.fft.ifft2(torch.fft.fft2(seen) * G).real


def best_gamma(H: Tensor, S: Tensor, noise: float, at_design: Tensor) -> float:
    """The constant γ of the Wiener filter of the design depth (W, N, N) that errs least over all depths."""

    # The error of G = H*/(|H|² + γ), ⟨S|1 - G H_z|² + σ²|G|²⟩, needs but two means over the depths.
    own = at_design.real**2 + at_design.imag**2
    along = S * (at_design.conj() * H.mean(0)).real
    power = own * (S * (H.real**2 + H.imag**2).mean(0) + noise**2)
    rest = float(S.mean())

    def error(logarithm: float) -> float:
        weight = 1 / (own + 10**logarithm)
        return rest + float((weight * (power * weight - 2 * along)).mean())

    # Coarse steps first: far from the best γ the error is flat.
    places = np.arange(-6.0, 2.0, 0.5)
    start = min(places, key=error)
    if start in (places[0], places[-1]):
        message = f"no optimum of the filter's constant inside 10^{places[0]:g} to 10^{places[-1]:g}"
        warnings.warn(f"{message}: the error still falls at its end", NoOptimum, stacklevel=2)
    return 10 ** float(scipy.optimize.minimize_scalar(error, bounds=(start - 0.5, start + 0.5), method="bounded").x)


def best_of_starts(
    variables: Callable[[], nn.Module],
    world: WaveCameraConfig,
    spectrum: Tensor,
    *,
    starts: int,
    spread: float,
    steps: int,
    seed: int = 0,
    progress: Callable[[Iterable], Iterable] = iter,
) -> nn.Module:
    """Phase variables at the least closed-form error that L-BFGS reaches from random starts; several optima exist.

    variables: makes them anew; spread: standard deviation of the first changes; starts 0: as they are made.
    """
    best, least = variables(), math.inf
    for number in progress(range(starts)):
        own = variables()
        with torch.no_grad():
            for p in own.parameters():
                p.copy_(torch.as_tensor(spread * draws(seed, number, _START).standard_normal(p.shape)))
        expected = ClosedForm(own(), world, spectrum)

        def error(own=own, expected=expected) -> Tensor:
            return expected(own())

        found = min(minimise_tensors(list(own.parameters()), error, steps=steps).values)
        if found < least:
            best, least = own, found
    return best

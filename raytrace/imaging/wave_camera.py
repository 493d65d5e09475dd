"""A camera with a phase element and a linear filter for extended depth of field: its kernels, errors and image quality.

Pictures are periodic (mirrored to twice their size, without a jump at the border), each at one depth. Light outside the
window of the kernel is not lost: it is even haze over the whole picture. Two filters restore them: the Wiener filter of
the design depth with the best constant γ, and the best depth-invariant one ("blind" in stored results).
"""

import dataclasses
import functools
import math
import warnings
from collections.abc import Sequence
from typing import cast

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

from raytrace.imaging.image import transfer_functions
from raytrace.imaging.octant import Octant, fits
from raytrace.imaging.pictures import Pictures
from raytrace.imaging.restoration import depth_invariant_error, depth_invariant_wiener, power_spectrum, psnr, wiener
from raytrace.maths.result import Result
from raytrace.maths.sampling import grid
from raytrace.optimization.least_squares import NoOptimum
from raytrace.plotting.style import (
    FIELD_COLOURS,
    GREY,
    Axes,
    Figure,
    SubFigure,
    array,
    new_figure,
    styled,
    wavelength_colours,
)
from raytrace.tracing.scene import Memo
from raytrace.wave_optics.compute import ElementPsf, psf, psf_by_depth
from raytrace.wave_optics.element import Element, height
from raytrace.wave_optics.plan import plan
from raytrace.wave_optics.scene import WaveScene

FILTERS = ("wiener", "blind")  # of restoration
WAVELENGTH = 0.55  # µm, at which elements are designed and wrapped
_BLACK = 1e-5  # of the brightest pixel of a row of kernels
_TALL = 10.0  # µm of height, many waves, beyond which the texture is drawn as a difference


@dataclasses.dataclass(frozen=True)
class WaveCameraConfig:
    """Lengths in mm, wavelengths in µm.

    depths: of the objects; design: the depth whose kernel the Wiener filter inverts; pixel, size: of the window of the
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
    """A depth in mm as text, in m."""
    return infinity if math.isinf(depth) else f"{1e-3 * depth:.3g} m"


def scene(elements: Sequence[Element], config: WaveCameraConfig, *, depths: Sequence[float] | None = None) -> WaveScene:
    """The camera's objects, through elements in contact; depths: mm, other than its own."""
    like = elements[0].radius
    return WaveScene(
        elements=tuple(elements),
        sensor_distance=like.new_tensor(config.sensor_distance),
        depths=like.new_tensor(config.depths if depths is None else depths),
        wavelengths=like.new_tensor(config.wavelengths),
        grid=grid(like.new_tensor(config.pixel), config.size),
        exact=config.exact,
    )


def kernels(
    elements: Sequence[Element], config: WaveCameraConfig, *, depths: Sequence[float] | None = None
) -> ElementPsf:
    """PSFs of elements, by `psf_by_depth`; depths: mm, other than the camera's own."""
    return psf_by_depth(scene(elements, config, depths=depths))


def transfer(psf: ElementPsf, size: int | Sequence[int]) -> Tensor:
    """H (D, W, size, size) of kernels normalised by the light through the aperture; light beyond the window is haze."""
    H = transfer_functions(psf.kernel, size)
    haze = torch.zeros_like(H.real)
    haze[..., 0, 0] = 1
    return H + haze * (1 - psf.energy)[..., None, None]


# -- periodic pictures


def periodic(pictures: Pictures, size: int) -> Tensor:
    """Pictures (B, size, size) in [0, 1], float64: the middle of each, mirrored to a period of an endless picture."""
    half, periods = size // 2, []
    for sample in pictures.samples:
        if min(sample.shape) < half:
            raise ValueError(f"a picture of {sample.shape[0]} × {sample.shape[1]} pixels, expected {half} at least")
        row, column = ((n - half) // 2 for n in sample.shape)
        periods.append(mirrored(sample[row : row + half, column : column + half].astype(np.float64) / 255))
    return torch.as_tensor(np.stack(periods))


def mirrored(picture: np.ndarray) -> np.ndarray:
    """A picture (h, w) and its mirror images: one period (2h, 2w) without a jump."""
    picture = np.concatenate([picture, picture[::-1]], 0)
    return np.concatenate([picture, picture[:, ::-1]], 1)


def spectrum(pictures: Tensor) -> Tensor:
    """S (size, size) of periodic pictures (B, size, size)."""
    return power_spectrum(pictures, window="none")


def power(picture: Tensor) -> Tensor:
    """|X|² (n, n) of a periodic picture (n, n), over the number of its pixels."""
    transformed = torch.fft.fft2(picture)
    return (transformed.real**2 + transformed.imag**2) / picture.numel()


# -- errors of restored pictures


def errors_of_pictures(H: Tensor, G: Tensor, noise: float, powers: Tensor) -> Tensor:
    """Mean square errors (B, D, W) of pictures of `power` (B, n, n) behind filters G, expected over noise."""
    residual = torch.view_as_real(1 - G * H).square().sum(-1).flatten(2)  # (D, W, n²)
    added = noise**2 * torch.view_as_real(G).square().sum(-1).mean((-2, -1))
    return (residual @ powers.flatten(1).T / residual.shape[-1]).movedim(-1, 0) + added


def expected_error(H: Tensor, S: Tensor, noise: float) -> Tensor:
    """Mean square error behind the best depth-invariant filter, in closed form, mean over colours."""
    return depth_invariant_error(H, S, noise).mean()


class ClosedForm:
    """`expected_error` of elements of one camera, for pictures of spectrum S (n, n); differentiable.

    first: the elements for which the sampling is planned, with the steps of all later ones. Whatever their heights do
    not change is computed once. dtype: of the sums over a radius.
    """

    def __init__(
        self, first: Sequence[Element], config: WaveCameraConfig, S: Tensor, *, dtype: torch.dtype = torch.float64
    ):
        self.config, self.S, self._memo, self._dtype = config, S, Memo(), dtype
        self._first = scene(first, config)
        self.plan = plan(self._first)

    @functools.cached_property
    def _octant(self) -> Octant | None:
        if not fits(self._first, self.plan, self.S):
            return None
        return Octant(self._first, self.plan, self.S.shape[-1], dtype=self._dtype)

    def __call__(self, elements: Sequence[Element]) -> Tensor:
        if self._octant is not None:
            return self._octant.error(scene(elements, self.config), self.S, self.config.noise)
        return expected_error(self.transfer(elements), self.S, self.config.noise)

    def transfer(self, elements: Sequence[Element]) -> Tensor:
        """H (D, W, n, n)."""
        return transfer(psf(scene(elements, self.config), plan=self.plan, memo=self._memo), self.S.shape[-1])


def restored(H: Tensor, G: Tensor, pictures: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Captured and filtered images, each (B, W, N, N), of pictures (B, N, N) at one depth.

    H, G: (W, N, N); noise: (B, W, N, N), added.
    """
    image = torch.fft.ifft2(torch.fft.fft2(pictures)[:, None] * H).real + noise
    return image, torch.fft.ifft2(torch.fft.fft2(image) * G).real


def best_gamma(H: Tensor, S: Tensor, noise: float, at_design: Tensor) -> float:
    """The constant γ of the Wiener filter of the design depth (W, N, N) with the least error over all depths."""

    # The error of G = H*/(|H|² + γ), ⟨S|1 - G H_z|² + σ²|G|²⟩, needs but two means over the depths.
    square = at_design.real**2 + at_design.imag**2
    along = S * (at_design.conj() * H.mean(0)).real
    power = square * (S * (H.real**2 + H.imag**2).mean(0) + noise**2)
    rest = float(S.mean())

    def error(logarithm: float) -> float:
        weight = 1 / (square + 10**logarithm)
        return rest + float((weight * (power * weight - 2 * along)).mean())

    # Coarse steps first: far from the best γ the error is flat.
    places = np.arange(-6.0, 2.0, 0.5)
    start = min(places, key=error)
    if start in (places[0], places[-1]):
        message = f"no optimum of the filter's constant inside 10^{places[0]:g} to 10^{places[-1]:g}"
        warnings.warn(f"{message}: the error still falls at its end", NoOptimum, stacklevel=2)
    return 10 ** float(scipy.optimize.minimize_scalar(error, bounds=(start - 0.5, start + 0.5), method="bounded").x)


# -- image quality


@dataclasses.dataclass(frozen=True)
class Quality:
    """PSNR in dB of restored pictures, by filter.

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
    config: WaveCameraConfig,
    *,
    train: Tensor,
    test: Tensor,
    psf: ElementPsf | None = None,
) -> Quality:
    """Image quality of test pictures (B, N, N), expected over noise, with filters for training pictures (A, N, N).

    psf: `kernels` of the elements, if they are known.
    """
    psf = kernels(elements, config) if psf is None else psf
    H, S = transfer(psf, test.shape[-1]), spectrum(train)
    if config.design in config.depths:
        at_design = H[config.depths.index(config.design)]
    else:
        at_design = transfer(kernels(elements, config, depths=[config.design]), test.shape[-1])[0]
    gamma = best_gamma(H, S, config.noise, at_design)
    filters = {"wiener": wiener(at_design, gamma), "blind": depth_invariant_wiener(H, S, config.noise)}
    powers = torch.stack([power(picture) for picture in test])
    by_depth, by_colour, of_pictures = {}, {}, {}
    for name, G in filters.items():
        errors = errors_of_pictures(H, G, config.noise, powers)  # (B, D, W)
        pooled = errors.mean(0)
        of_pictures[name] = float(psnr(errors.mean(-1)).mean())
        by_depth[name] = tuple(psnr(pooled.mean(1)).tolist())
        by_colour[name] = tuple(psnr(pooled).mean(0).tolist())
    return Quality(
        by_depth,
        by_colour,
        {name: float(np.mean(values)) for name, values in by_depth.items()},
        of_pictures,
        {name: max(values) - min(values) for name, values in by_depth.items()},
        gamma,
        tuple(map(tuple, psf.energy.tolist())),
    )


@dataclasses.dataclass(frozen=True, repr=False)
class ElementReport(Result):
    """Elements of a camera, their kernels and image quality; initial: those before an optimisation, to compare with."""

    elements: Sequence[Element]
    config: WaveCameraConfig
    kernels: ElementPsf
    quality: Quality
    initial: "ElementReport | None" = dataclasses.field(default=None, kw_only=True)

    @styled
    def draw(self) -> Figure:
        """Height over the radius, and its difference from a fitted paraboloid where it is many waves high; PSNR over
        depth, kernels over depth and wavelength; of the initial elements, too."""
        figure = new_figure(9.2, 7.0 if self.initial is None else 11.2)
        heights = (1, 1.75) if self.initial is None else (1, 1.75, 1.75)
        top, *bottom = cast(np.ndarray, figure.subfigures(len(heights), 1, height_ratios=heights))
        radius = self.elements[0].radius
        r = torch.linspace(0, float(radius) * (1 - 1e-9), 4000, dtype=radius.dtype)
        drawn = [(element, FIELD_COLOURS[k % 3], element.glass.name) for k, element in enumerate(self.elements)]
        if self.initial is not None:
            drawn = [(element, GREY, "initial") for element in self.initial.elements] + drawn
        profiles = [1e3 * array(height(element, r, torch.zeros_like(r)).detach()) for element, *_ in drawn]
        tall = [h for h in profiles if np.ptp(h) > _TALL]
        profile, *texture, psnrs = top.subplots(1, 3 if tall else 2)
        radii = array(r)
        for (_, colour, label), h in zip(drawn, profiles, strict=True):
            look = {"lw": 0.9, "color": colour, "label": label}
            profile.plot(radii, h - h.min(), **look)
            if np.ptp(h) > _TALL:
                texture[0].plot(radii, h - np.polyval(np.polyfit(radii**2, h, 1), radii**2), **look)
        profile.set(xlabel="radius (mm)", ylabel="height (µm)", title="element")
        for panel in texture:
            panel.set(xlabel="radius (mm)", ylabel="height (µm)", title="less the fitted paraboloid")
        profile.legend(fontsize=8)
        dioptres = [1e3 / depth for depth in self.config.depths]
        labels = {"wiener": "Wiener, 1 m kernel", "blind": "best depth-invariant filter"}
        for filter, mark, colour in (("wiener", "o--", FIELD_COLOURS[0]), ("blind", "s-", FIELD_COLOURS[1])):
            psnrs.plot(dioptres, self.quality.by_depth[filter], mark, ms=4, label=labels[filter], color=colour)
            if self.initial is not None:
                look = {"ms": 3, "color": colour, "alpha": 0.4, "label": f"{labels[filter]}, initial"}
                psnrs.plot(dioptres, self.initial.quality.by_depth[filter], mark, **look)
        mark_depths(psnrs, self.config)
        psnrs.set(xlabel="object distance", ylabel="PSNR (dB)")
        psnrs.legend(fontsize=7, loc="lower center", bbox_to_anchor=(0.5, 1), borderaxespad=0)
        if self.initial is not None:
            _draw_kernels(bottom[0], self.initial.kernels, "PSFs of the initial element")
        _draw_kernels(bottom[-1], self.kernels)
        return figure


def _draw_kernels(figure: SubFigure, psf: ElementPsf, title: str = "PSFs") -> None:
    kernels, (D, W) = array(psf.kernel.detach()), psf.kernel.shape[:2]
    axes, colours = figure.subplots(W, D, squeeze=False), wavelength_colours(psf.wavelengths.tolist())
    half = 1e3 * float(psf.pitch) * kernels.shape[-1] / 2
    for w in range(W):
        brightest = kernels[:, w].max()
        for d in range(D):
            logarithm = np.log10(np.maximum(kernels[d, w] / brightest, _BLACK))
            extent = (-half, half, -half, half)
            axes[w, d].imshow(logarithm, cmap="inferno", vmin=np.log10(_BLACK), vmax=0, extent=extent)
            axes[w, d].set(xticks=[], yticks=[])
        axes[w, 0].set_ylabel(f"{1e3 * float(psf.wavelengths[w]):.0f} nm", color=colours[w], fontsize=9)
    for panel, depth in zip(axes[0], psf.depths.tolist(), strict=True):
        panel.set_title(depth_text(depth, "∞"), fontsize=9)
    figure.supxlabel(
        f"{title}, {2 * half:.0f} µm across; logarithmic, five decades down from the brightest pixel of a row",
        fontsize=8,
    )


def mark_depths(axes: Axes, config: WaveCameraConfig) -> None:
    """Near objects on the left, even in dioptres."""
    axes.set_xticks([1e3 / depth for depth in config.depths], [depth_text(depth, "∞") for depth in config.depths])
    axes.invert_xaxis()

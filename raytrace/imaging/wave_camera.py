"""Cameras with a phase element alone for extended depth of field: their numbers, pictures and image quality.

Pictures are periodic (mirrored to twice their size, without a jump at the border), each at one depth. Light outside the
window of the kernel is not lost: it is even haze over the whole picture. Two filters restore them: the Wiener filter of
the design depth with the best constant γ, and the best depth-invariant one ("blind" in stored results).
"""

import dataclasses
import math
import warnings
from collections.abc import Sequence
from typing import Any, Self, cast

import numpy as np
import scipy.optimize
import torch
from torch import Tensor, nn

from raytrace.imaging.camera import Camera
from raytrace.imaging.image import extend
from raytrace.imaging.pictures import Pictures
from raytrace.imaging.restoration import depth_invariant_wiener, errors, power_spectrum, psnr, wiener
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.spectral_response import SpectralResponse
from raytrace.imaging.variables import PhaseVariables
from raytrace.maths.numerics import as_tensor
from raytrace.maths.result import Result
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
from raytrace.wave_optics.element import Element, height

FILTERS = ("wiener", "blind")  # of restoration
_SIDE = 512  # pixels of the sensor along a side
_BLACK = 1e-5  # of the brightest pixel of a row of kernels
_TALL = 10.0  # µm of height, many waves, beyond which the texture is drawn as a difference


@dataclasses.dataclass(frozen=True)
class WaveCameraConfig:
    """Numbers of a camera with an element alone. Lengths in mm, wavelengths in µm.

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

    @property
    def sensor(self) -> Sensor:
        """A sensor with a channel for each wavelength, and white noise."""
        ascending, response = sorted(self.wavelengths), None
        if len(ascending) > 1:
            channels = [[float(known == wavelength) for known in ascending] for wavelength in self.wavelengths]
            response = SpectralResponse(ascending, channels)
        side, pixels = _SIDE * self.pixel, (_SIDE, _SIDE)
        return Sensor((side, side), pixels, response=response, read_noise=self.noise, saturation=math.inf)

    def camera(
        self, elements: Sequence[Element] | PhaseVariables, network: nn.Module | None = None, **options: Any
    ) -> Camera[PhaseVariables]:
        """The camera of constant elements in contact, or of variables; without a network; options: of `Camera`."""
        if not isinstance(elements, PhaseVariables):
            first, *others = elements
            elements = PhaseVariables(first, others=others).requires_grad_(False)
        optics = {"sensor_distance": self.sensor_distance, "wavelengths": self.wavelengths, "exact": self.exact}
        window = {"pixels": self.size, "normalise": "haze", "boundary": "circular", "fields": [0]}
        near_to_far = min(self.depths), max(self.depths)
        numbers: dict[str, Any] = {"sensor": self.sensor, "object_distances": near_to_far} | optics | window
        return Camera(elements, network or nn.Identity(), **(numbers | options))


def depth_text(depth: float, infinity: str = "infinity") -> str:
    """A depth in mm as text, in m."""
    return infinity if math.isinf(depth) else f"{1e-3 * depth:.3g} m"


def transfer(camera: Camera, size: int, distances: Sequence[float]) -> Tensor:
    """H (D, C, size, size) of a camera at object distances (D,) mm in its first field, on periodic pictures."""
    return camera.transfer(camera.kernels(distances), size)


def periodic(pictures: Pictures, size: int) -> Tensor:
    """Pictures (B, size, size) in [0, 1], float64: the middle of each, mirrored to a period of an endless picture."""
    half, periods = size // 2, []
    for sample in pictures.samples:
        if min(sample.shape) < half:
            raise ValueError(f"a picture of {sample.shape[0]} × {sample.shape[1]} pixels, expected {half} at least")
        row, column = ((n - half) // 2 for n in sample.shape)
        periods.append(sample[row : row + half, column : column + half].astype(np.float64) / 255)
    return mirrored(np.stack(periods))


def mirrored(picture: Tensor | np.ndarray) -> Tensor:
    """A picture (..., h, w) and its mirror images: one period (..., 2h, 2w) without a jump."""
    h, w = picture.shape[-2:]
    return extend(as_tensor(picture), (2 * h, 2 * w), boundary="reflect")


def best_gamma(H: Tensor, S: Tensor, noise: Tensor | float, at_design: Tensor) -> float:
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
    camera: Camera,
    depths: Sequence[float],
    *,
    design: float,
    train: Tensor,
    test: Tensor,
    kernels: Tensor | None = None,
) -> Quality:
    """Image quality of test pictures (B, N, N) at depths (D,) mm, expected over noise, with filters for training
    pictures (A, N, N).

    design: mm, the depth whose kernel the Wiener filter inverts; kernels: (D, C, h, w) of the camera, if known.
    """
    kernels = camera.kernels(depths) if kernels is None else kernels
    size, S = test.shape[-1], power_spectrum(train, window="none")
    H, noise = camera.transfer(kernels, size), camera.sensor.noise_deviation(S)
    at_design = H[depths.index(design)] if design in depths else transfer(camera, size, [design])[0]
    gamma = best_gamma(H, S, noise, at_design)
    filters = {"wiener": wiener(at_design, gamma), "blind": depth_invariant_wiener(H, S, noise)}
    powers = power_spectrum(test[None], window="none")[:, None, None]
    by_depth, by_colour, of_pictures = {}, {}, {}
    for name, G in filters.items():
        of_each = errors(H, powers, noise, filter=G)  # (B, D, C)
        pooled = of_each.mean(0)
        of_pictures[name] = float(psnr(of_each.mean(-1)).mean())
        by_depth[name] = tuple(psnr(pooled.mean(1)).tolist())
        by_colour[name] = tuple(psnr(pooled).mean(0).tolist())
    return Quality(
        by_depth,
        by_colour,
        {name: float(np.mean(values)) for name, values in by_depth.items()},
        of_pictures,
        {name: max(values) - min(values) for name, values in by_depth.items()},
        gamma,
        tuple(map(tuple, kernels.sum((-2, -1)).tolist())),
    )


@dataclasses.dataclass(frozen=True, repr=False)
class ElementReport(Result):
    """Elements of a camera, their kernels (D, C, h, w) and image quality; initial: those before an optimisation, to
    compare with."""

    elements: Sequence[Element]
    config: WaveCameraConfig
    kernels: Tensor
    quality: Quality
    initial: "ElementReport | None" = dataclasses.field(default=None, kw_only=True)

    @classmethod
    def of(cls, elements: Sequence[Element], config: WaveCameraConfig, *, train: Tensor, test: Tensor) -> Self:
        """Kernels and `quality` of elements."""
        camera = config.camera(elements)
        with torch.no_grad():
            kernels = camera.kernels(config.depths)
        rating = quality(camera, config.depths, design=config.design, train=train, test=test, kernels=kernels)
        return cls(elements, config, kernels, rating)

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
            _draw_kernels(bottom[0], self.initial, "PSFs of the initial element")
        _draw_kernels(bottom[-1], self)
        return figure


def _draw_kernels(figure: SubFigure, report: ElementReport, title: str = "PSFs") -> None:
    kernels, config = array(report.kernels.detach()), report.config
    D, W = kernels.shape[:2]
    axes, colours = figure.subplots(W, D, squeeze=False), wavelength_colours(config.wavelengths)
    half = 1e3 * config.pixel * kernels.shape[-1] / 2
    for w in range(W):
        brightest = kernels[:, w].max()
        for d in range(D):
            logarithm = np.log10(np.maximum(kernels[d, w] / brightest, _BLACK))
            extent = (-half, half, -half, half)
            axes[w, d].imshow(logarithm, cmap="inferno", vmin=np.log10(_BLACK), vmax=0, extent=extent)
            axes[w, d].set(xticks=[], yticks=[])
        axes[w, 0].set_ylabel(f"{1e3 * config.wavelengths[w]:.0f} nm", color=colours[w], fontsize=9)
    for panel, depth in zip(axes[0], config.depths, strict=True):
        panel.set_title(depth_text(depth, "∞"), fontsize=9)
    figure.supxlabel(
        f"{title}, {2 * half:.0f} µm across; logarithmic, five decades down from the brightest pixel of a row",
        fontsize=8,
    )


def mark_depths(axes: Axes, config: WaveCameraConfig) -> None:
    """Near objects on the left, even in dioptres."""
    axes.set_xticks([1e3 / depth for depth in config.depths], [depth_text(depth, "∞") for depth in config.depths])
    axes.invert_xaxis()

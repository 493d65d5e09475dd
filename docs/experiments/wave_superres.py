"""Super-resolution from one exposure: images finer than the pixels of the sensor.

    python docs/experiments/wave_superres.py --factor 2 3 --wavelength 0.55 --wavelength 0.46 0.55 0.64 -o FOLDER

A pixel of the sensor covers s × s pixels of the picture (`Camera(oversampling=s)`). A frequency of the sensor's image
holds the s² frequencies m of the picture that equal it modulo the sampling of the sensor, its aliases:

    Y_v = 1/s² Σ_m T_vm X_m + N_v      v: views of one picture; T: `Camera.transfer`

    X̂ = G Y,   G = S T† (T S T†/s² + σ²)⁻¹,   e = tr (S⁻¹ + T† T/(s σ)²)⁻¹/s², the mean over frequencies of the sensor

Two elements are compared with the plain lens. full frame: the scene fills the sensor, one view; polynomials on the lens
minimise e. small: a scene on a dark ground is imaged at V places, each at another part of a sensor pixel, by a plate in
front of the lens: the wedge of each place on a sector of the aperture, the phase of the sum of the waves of all wedges
(a hologram), or heights that minimise e from there. Learned elements are stored in FOLDER and read again.
"""

import argparse
import dataclasses
import math
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from experiments import Store, publish
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from pages import grid, picture
from torch import Tensor
from wave_noise import Interval, drawn, gain

from raytrace.cli.options import json, output_folder
from raytrace.cli.pictures import pictures_of
from raytrace.cli.progress import progress
from raytrace.cli.runner import present
from raytrace.cli.settings import (
    SEED,
    add_options,
    defaults_of,
    documents,
    option,
    picture_options,
    picture_words,
    words,
)
from raytrace.cli.types import positive_finite
from raytrace.files import table as csv
from raytrace.imaging.camera import Camera
from raytrace.imaging.pictures import Pictures, dead_leaves, digest, draws, split
from raytrace.imaging.restoration import power_spectrum, psnr
from raytrace.imaging.variables import PhaseVariables
from raytrace.imaging.wave_camera import WaveCameraConfig, periodic
from raytrace.materials.catalogs import find_glass
from raytrace.maths.result import Result
from raytrace.optimization.least_squares import minimise_tensors
from raytrace.plotting.style import array, new_figure, show_image, styled
from raytrace.settings import Settings as BaseSettings
from raytrace.wave_optics.compute import DESIGN
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element, Pixels, Zernike, excess_index

LIMIT = 80  # pictures
SIDE = 96  # pixels of a picture
BORDER = 16  # dark pixels of a small scene at every side
TILE, WIDE = 47, 145  # pixels of the window of a place, and of one over all places and their windows
CELLS = 400  # of a plate, across the aperture
NOISES = (0.0003, 0.001, 0.003, 0.01, 0.03)
SECTORS = "sectors"  # plates that the tables of the page leave out and the CSV files list
TERMS, SPREAD = 45, 0.03  # Noll's last polynomial; µm RMS of each in a random start
_START = 23  # last number of the key of a random start


@dataclasses.dataclass(frozen=True)
class Settings(BaseSettings):
    """wavelength: of each camera, µm; steps: of L-BFGS; starts: random ones of the polynomials, besides none."""

    factor: tuple[int, ...] = (2,)
    wavelength: tuple[list[float], ...] = ([0.55],)
    noise: float = 0.001
    steps: int = 40
    starts: int = 1
    seed: int = 0


ROWS = {
    "factor": option("sensor pixels, in pixels of the picture: 2 or 3", "S", type=int, choices=(2, 3)),
    "wavelength": option(
        "wavelengths of a camera; given again, of another", "UM", type=positive_finite, nargs="+", action="append"
    ),
    "noise": option("standard deviation, for images from 0 to 1", "S"),
    "steps": option("of the optimisation"),
    "starts": option("random starts of the polynomials on the lens, besides the plain lens"),
    "seed": SEED,
}


# -- linear inversion of aliases ---------------------------------------------------------------------------------------


def aliases(values: Tensor, factor: int) -> Tensor:
    """Values (..., rows, columns) of frequencies by frequency of the sensor: (..., rows/s, columns/s, s²)."""
    rows, columns = (n // factor for n in values.shape[-2:])
    apart = values.unflatten(-1, (factor, columns)).unflatten(-3, (factor, rows))
    return apart.movedim((-4, -2), (-2, -1)).flatten(-2)


def inversion(T: Tensor, S: Tensor, sigma: Tensor | float, factor: int) -> Tensor:
    """G (..., r, c, s², V) of the best linear inversion of V views with transfer functions T (..., V, rows, columns).

    S: power spectrum (rows, columns) of the pictures; sigma: standard deviation of the noise of the views, above 0.
    """
    T, S = aliases(T, factor).movedim(-4, -2), aliases(S, factor)[..., None, :]
    power = (T * S) @ T.mH / factor**2 + sigma**2 * torch.eye(T.shape[-2], dtype=S.dtype)
    return torch.linalg.solve(power, T * S).mH


def error(T: Tensor, S: Tensor, sigma: Tensor | float, factor: int) -> Tensor:
    """Mean square error of a pixel behind `inversion`; mean over the leading axes of T (..., V, rows, columns).

    A sum of squares, which keeps the precision of small errors: e = |L⁻¹ √S|², L Lᴴ = 1 + √S T† T √S/(s σ)².
    """
    T, root = aliases(T, factor).movedim(-4, -2), aliases(S.sqrt(), factor)
    seen = T * root[..., None, :] / (factor * sigma)
    L = torch.linalg.cholesky(torch.eye(factor**2, dtype=S.dtype) + seen.mH @ seen)
    left = torch.linalg.solve_triangular(L, root.diag_embed().to(L).expand(L.shape), upper=False)
    return (left.real**2 + left.imag**2).sum((-2, -1)).mean() / factor**2


def superresolve(views: Tensor, G: Tensor, factor: int) -> Tensor:
    """Images (..., s h, s w) from views (..., V, h, w), by `inversion`."""
    Y = torch.fft.fft2(views).movedim(-3, -1)[..., None]
    X = (G @ Y)[..., 0].unflatten(-1, (factor, factor)).movedim((-2, -1), (-4, -2))
    return torch.fft.ifft2(X.flatten(-2).flatten(-3, -2)).real


def least_error(S: Tensor, factor: int) -> Tensor:
    """The mean square error below which no kernel and no linear inversion of one view goes: of the aliases of each
    frequency all but the strongest are lost."""
    return S.mean() - aliases(S, factor).amax(-1).mean() / factor**2


def bicubic(image: Tensor, factor: int) -> Tensor:
    """Images (B, C, s H, s W) by cubic convolution (Keys, 1981), whose parameter -½ torch takes with antialias."""
    return torch.nn.functional.interpolate(image, scale_factor=factor, mode="bicubic", antialias=True)


# -- cameras -----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Setup:
    """A camera at one depth, with sensor pixels of `factor` times 3.69 µm."""

    factor: int
    wavelengths: tuple[float, ...]
    noise: float

    @property
    def key(self) -> str:
        return f"{self.factor}-{'-'.join(f'{1e3 * w:g}' for w in self.wavelengths)}-{self.noise:g}"

    @property
    def colours(self) -> str:
        return f"{', '.join(f'{1e3 * w:.0f}' for w in self.wavelengths)} nm"

    def config(self, size: int) -> WaveCameraConfig:
        pixel = self.factor * WaveCameraConfig.pixel
        return WaveCameraConfig((1000.0,), wavelengths=self.wavelengths, pixel=pixel, size=size, noise=self.noise)

    def camera(self, elements: Sequence[Element] | PhaseVariables, size: int = 65) -> Camera[PhaseVariables]:
        return self.config(size).camera(elements, oversampling=self.factor)

    def plate_camera(
        self, elements: Sequence[Element] | PhaseVariables, samples: int = 2 * CELLS
    ) -> Camera[PhaseVariables]:
        """A window over all places, on a dark ground: no haze. samples: across the aperture, a multiple of CELLS."""
        camera = self.config(WIDE).camera(elements, oversampling=self.factor, normalise="energy")
        camera.plan([1000.0], engine="pupil", samples=samples, nodes=4)
        return camera


def plain_lens() -> tuple[Element, ...]:
    return baseline("singlet", aim())


def kernels_of(camera: Camera) -> Tensor:
    """Kernels (C, K, K) at the depth of all scenes."""
    return camera.kernels([1000.0])[0]


def learned_lens(setup: Setup, S: Tensor, settings: Settings) -> Tensor:
    """Noll's polynomials (TERMS,) µm RMS on the plain lens that minimise the error of one view: the best of the starts,
    none and random ones."""
    best, least = torch.zeros(()), math.inf
    for number in range(settings.starts + 1):
        variables = polynomials()
        if number:
            random = draws(settings.seed, number, _START).standard_normal(TERMS)
            variables.change.data.copy_(SPREAD * torch.as_tensor(random))
        camera = setup.camera(variables)
        camera.plan([1000.0])
        loss = lambda camera=camera: error_of_frame(camera, S, setup)  # noqa: E731
        lowest = min(minimise_tensors([variables.change], loss, steps=settings.steps).values)
        if lowest < least:
            best, least = variables.change.detach(), lowest
    return best


def polynomials(change: Tensor | None = None) -> PhaseVariables:
    """Noll's polynomials in contact with the plain lens, of changes (TERMS,) µm RMS."""
    lens = plain_lens()
    radius = lens[0].radius.detach()
    variables = PhaseVariables(Element(Zernike(radius.new_zeros(TERMS)), radius, find_glass("PMMA")), others=lens)
    if change is not None:
        variables.change.data.copy_(change)
    return variables


def error_of_frame(camera: Camera, S: Tensor, setup: Setup) -> Tensor:
    """Mean square error of a scene that fills the sensor, mean over colours."""
    return error(camera.transfer(kernels_of(camera), S.shape)[:, None], S, setup.noise, setup.factor)


# -- plates that image a small scene at several places -----------------------------------------------------------------


def places_of(count: int) -> tuple[tuple[int, int], ...]:
    """(row, column) of 3 or 4 places from the axis, a scene apart, in pixels of the picture: whole ones of a sensor."""
    half = SIDE // 2
    last = ((half, 0),) if count == 3 else ((half, -half), (half, half))
    return ((-half, -half), (-half, half), *last)


def wedges(count: int, factor: int) -> Tensor:
    """Paths x·u/z (V, CELLS, CELLS) mm of wedges to the places u and parts of a sensor pixel beyond: the first image is
    there, the others are half a pixel aside, down, and both."""
    config = WaveCameraConfig()
    parts = 0.5 * factor * torch.tensor([[0, 0], [0, 1], [1, 0], [1, 1]][:count], dtype=torch.float64)
    u = (torch.tensor(places_of(count)) + parts) * (config.pixel / config.sensor_distance)
    x = _line() * (2 * config.radius / CELLS)
    return u[:, :1, None] * x[:, None] + u[:, 1:, None] * x


def _line() -> Tensor:
    return torch.arange(CELLS, dtype=torch.float64) - 0.5 * (CELLS - 1)


def sectors(paths: Tensor) -> Tensor:
    """The path (CELLS, CELLS) mm of a wedge on each of as many equal sectors: each place has the blur of a sector."""
    turn = torch.atan2(_line()[:, None], _line()) / (2 * math.pi) % 1
    number = (turn * len(paths)).long().clamp(max=len(paths) - 1)
    return paths.gather(0, number[None])[0]


def hologram(paths: Tensor, seed: int) -> Tensor:
    """The phase of the waves of all paths, as a path (CELLS, CELLS) mm: λ/2π · arg Σ_v exp(i (2π/λ path_v + φ_v)).

    Random φ_v: in step, further orders would meet at the places.
    """
    wave = 1e-3 * DESIGN
    turns = torch.as_tensor(draws(seed, len(paths), _START).uniform(0, 2 * math.pi, len(paths)))
    return wave / (2 * math.pi) * torch.exp(1j * (2 * math.pi / wave * paths + turns[:, None, None])).sum(0).angle()


def plate(path: Tensor) -> tuple[Element, ...]:
    """A plate of PMMA of a path (CELLS, CELLS) mm, in contact with the plain lens; its columns are those of kernels."""
    lens, glass = plain_lens(), find_glass("PMMA")
    radius, flat = lens[0].radius.detach(), Element(Pixels(path, path.new_tensor(1.0)), path.new_tensor(1.0), glass)
    excess = excess_index(flat, path.new_tensor([DESIGN]), path)
    # Columns of a sensor grow towards -x, those of a plate towards +x.
    return Element(Pixels((path / excess).flip(-1), 2 * radius / CELLS), radius, glass), *lens


def learned_plate(setup: Setup, elements: Sequence[Element], count: int, S: Tensor, steps: int) -> tuple[Element, ...]:
    """A plate whose heights minimise the error of all views, from those of elements."""
    # A unit of 0.1 mm: of 160 000 heights each changes little, and L-BFGS ends at small gradients.
    variables = PhaseVariables(elements[0], unit=0.1, others=elements[1:])
    camera = setup.plate_camera(variables, CELLS)
    loss = lambda: error_of_views(camera, kernels_of(camera), count, S, setup)  # noqa: E731
    minimise_tensors([variables.change], loss, steps=steps)
    return camera.elements()


def tiles(kernels: Tensor, count: int) -> Tensor:
    """Kernels (..., V, TILE, TILE) of the places, out of those (..., K, K) over all of them."""
    first = kernels.shape[-1] // 2 - TILE // 2
    return torch.stack([kernels[..., first + y :, first + x :][..., :TILE, :TILE] for y, x in places_of(count)], -3)


def error_of_views(camera: Camera, kernels: Tensor, count: int, S: Tensor, setup: Setup) -> Tensor:
    """Mean square error of a small scene behind the inversion of all views, mean over colours.

    Light outside the windows of the places adds other images of the scene to the views, as noise: σ² + ⟨S⟩ Σ k².
    """
    of_places = tiles(kernels, count)
    astray = kernels.square().sum((-2, -1)) - of_places.square().sum((-3, -2, -1))
    sigma = torch.sqrt(setup.noise**2 + S.mean() * astray.clamp_min(0.0).mean())
    return error(camera.transfer(of_places, S.shape), S, sigma, setup.factor)


def small_scenes(pictures: Pictures) -> Tensor:
    """Scenes (B, SIDE, SIDE) in [0, 1] on a dark ground: the middle of pictures, faded at its border."""
    side = SIDE - 2 * BORDER
    fade = torch.sin(math.pi * (torch.arange(side, dtype=torch.float64) + 0.5) / side).clamp(max=0.5) * 2
    middle = periodic(pictures, 2 * side)[:, :side, :side]
    return torch.nn.functional.pad(middle * fade[:, None] * fade, (BORDER,) * 4)


# -- rows of the table -------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Row:
    """A restoration. closed: PSNR in dB expected in closed form, None for bicubic; estimate (B, C, n, n); errors (B, C)
    mean square, of each picture."""

    name: str
    closed: float | None
    estimate: Tensor = dataclasses.field(repr=False)
    errors: Tensor = dataclasses.field(repr=False)

    @classmethod
    def of(cls, name: str, closed: Tensor | None, estimate: Tensor, pictures: Tensor) -> "Row":
        errors = (estimate - pictures[:, None]).square().mean((-2, -1))
        return cls(name, None if closed is None else float(psnr(closed)), estimate, errors)

    @property
    def psnr(self) -> float:
        """dB, of all pictures and colours."""
        return float(psnr(self.errors.mean()))

    def gain(self, base: "Row") -> Interval:
        """Over another row, dB, with its interval over samples of the pictures."""
        return gain(self.errors[:, None], base.errors[:, None], drawn(range(len(self.errors))))


def captured(camera: Camera, pictures: Tensor, seed: int) -> Tensor:
    """Noisy images (B, C, h, w) of pictures (B, n, n) that are the same in all colours."""
    light = pictures[:, None].expand(-1, len(camera.sensor.channels), -1, -1)
    return camera.demosaiced(camera.image(light, [1000.0]), index=range(len(pictures)), seed=seed)


@torch.no_grad()
def of_one_view(
    elements: dict[str, Sequence[Element]], setup: Setup, train: Tensor, test: Tensor, seed: int
) -> list[Row]:
    """The MMSE inversion of each element, and bicubic enlargement of the first; periodic pictures (B, n, n)."""
    S, factor, rows = power_spectrum(train, window="none"), setup.factor, []
    for name, parts in elements.items():
        camera = setup.camera(parts)
        image = captured(camera, test, seed)
        if not rows:
            rows.append(Row.of(f"{name}, bicubic", None, bicubic(image, factor), test))
        T = camera.transfer(kernels_of(camera), S.shape)[:, None]
        estimate = superresolve(image[:, :, None], inversion(T, S, setup.noise, factor), factor)
        rows.append(Row.of(f"{name}, MMSE", error(T, S, setup.noise, factor), estimate, test))
    return rows


@torch.no_grad()
def of_views(
    name: str, elements: Sequence[Element], count: int, setup: Setup, train: Tensor, test: Tensor, seed: int
) -> tuple[Row, Tensor, Tensor]:
    """The joint inversion of the images of all places, with kernels (C, K, K) and sensor images (B, C, h, w)."""
    S, factor, camera = power_spectrum(train, window="none"), setup.factor, setup.plate_camera(elements)
    kernels, reach = kernels_of(camera), WIDE // 2  # a multiple of both factors
    image = captured(camera, torch.nn.functional.pad(test, (reach,) * 4), seed)
    side = SIDE // factor
    first = [((reach + y) // factor, (reach + x) // factor) for y, x in places_of(count)]
    views = torch.stack([image[..., y : y + side, x : x + side] for y, x in first], -3)
    G = inversion(camera.transfer(tiles(kernels, count), S.shape), S, setup.noise, factor)
    closed = error_of_views(camera, kernels, count, S, setup)
    return Row.of(name, closed, superresolve(views, G, factor), test), kernels, image


@dataclasses.dataclass(frozen=True)
class Block:
    """A scene of a camera: its rows, bicubic and MMSE of the plain lens first, and the bound of one view, dB."""

    setup: Setup
    scene: str
    rows: list[Row]
    bound: float

    def records(self) -> Iterator[dict]:
        head = {"factor": self.setup.factor, "colours": self.setup.colours, "scene": self.scene}
        for row in self.rows:
            over = [row.gain(base) for base in self.rows[:2]]
            yield {
                **head,
                "way": row.name,
                "closed": "–" if row.closed is None else f"{row.closed:.2f}",
                "restored": f"{row.psnr:.2f}",
                "gain": f"{over[0].value:+.2f}",
                **{name: f"{value:+.2f}" for name, value in over[1].record("gain_mmse").items()},
            }
        yield {**head, "way": "upper bound of one image", "closed": f"{self.bound:.2f}", "restored": "–", "gain": "–"}


@dataclasses.dataclass(frozen=True)
class Study:
    """Test and training pictures, and the store of learned elements."""

    settings: Settings
    kind: str
    train: Pictures
    test: Pictures
    store: Store

    def full_frame(self, setup: Setup) -> tuple[Block, dict]:
        """A scene that fills the sensor; kernels for the figure."""
        train, test = periodic(self.train, 2 * SIDE), periodic(self.test, 2 * SIDE)
        S = power_spectrum(train, window="none")
        learned = lambda: {"change": learned_lens(setup, S, self.settings).numpy()}  # noqa: E731
        change = torch.tensor(self.store.arrays(f"full-{setup.key}", learned)["change"])
        elements = {"plain lens": plain_lens(), "learned": polynomials(change)()}
        rows = of_one_view(elements, setup, train, test, self.settings.seed)
        with torch.no_grad():
            shown = {name: kernels_of(setup.camera(parts)) for name, parts in elements.items()}
        return Block(setup, "full frame", rows, float(psnr(least_error(S, setup.factor)))), shown | {"picture": test[0]}

    def small(self, setup: Setup, counts: Sequence[int] = (3, 4)) -> tuple[Block, dict]:
        """A small scene at so many places; the last plate for the figure."""
        train, test, seed = small_scenes(self.train), small_scenes(self.test), self.settings.seed
        S, steps = power_spectrum(train, window="none"), self.settings.steps
        rows, shown = of_one_view({"plain lens": plain_lens()}, setup, train, test, seed), {"scene": test[0]}
        for count in counts:
            paths = wedges(count, setup.factor)
            start = plate(hologram(paths, seed))

            def learned(start: Sequence[Element] = start, count: int = count) -> dict[str, np.ndarray]:
                return {"heights": learned_plate(setup, start, count, S, steps)[0].numbers.detach().numpy()}

            heights = torch.tensor(self.store.arrays(f"small-{count}-{setup.key}", learned)["heights"])
            plates = {SECTORS: plate(sectors(paths)), "phase of the sum": start}
            plates["learned"] = (start[0].with_numbers(heights), *start[1:])
            for name, elements in plates.items():
                title = f"{count} places, {name}"
                row, kernels, image = of_views(title, elements, count, setup, train, test, seed)
                rows.append(row)
            shown |= {"plate": kernels, "sensor": image[0]}
        return Block(setup, "small", rows, float(psnr(least_error(S, setup.factor)))), shown


@dataclasses.dataclass(frozen=True)
class Table(Result):
    """All scenes of all cameras; noises: PSNR in dB of the small scene of the first camera, by noise and row."""

    blocks: list[Block]
    noises: list[dict]

    def document(self) -> dict:
        return {"rows": self.records(), "noises": self.noises}

    def records(self) -> list[dict]:
        return [record for block in self.blocks for record in block.records()]

    def __str__(self) -> str:
        return "\n".join(
            f"× {r['factor']} {r['colours']:>17} {r['scene']:>10} {r['way']:<27} {r['closed']:>6} {r['restored']:>6} "
            f"{r['gain']:>6} {r.get('gain_mmse', ''):>6}"
            for r in self.records()
        )

    def markdown(self, factor: int) -> str:
        """PSNR and gains with intervals over MMSE of the plain lens; a line for each restoration."""
        blocks = [block for block in self.blocks if block.setup.factor == factor]
        colours = list(dict.fromkeys(block.setup.colours for block in blocks))
        titles = (f"{each}: restored|over MMSE".split("|") for each in colours)
        header, lines = ["scene", "optics and restoration", *(name for title in titles for name in title)], []
        for scene in ("full frame", "small"):
            alike = [block for block in blocks if block.scene == scene]
            for rows in zip(*(block.rows for block in alike), strict=True):
                if rows[0].name.endswith(SECTORS):
                    continue
                cells = [scene, rows[0].name]
                for row, block in zip(rows, alike, strict=True):
                    base = block.rows[1]
                    cells += [f"{row.psnr:.2f}", "0" if row is base else str(row.gain(base))]
                lines.append(cells)
        return grid(header, lines)


# -- the page ----------------------------------------------------------------------------------------------------------


@styled
def superres_figure(full: Block, small: Block, shown: dict) -> Figure:
    """Restored images with PSNR and the kernels behind them, in the middle colour: top, of a scene that fills the
    sensor; bottom, of a small one."""
    colour, part = len(full.setup.wavelengths) // 2, slice(0, 64)
    figure = new_figure(9.2, 4.1)
    axes = figure.subplots(2, 6)
    show_image(axes[0, 0], array(shown["picture"])[part, part], "picture")
    show_image(axes[1, 0], array(shown["scene"]), "scene on dark ground")
    for panels, rows, cut in (
        (axes[0, 1:4], full.rows, part),
        (axes[1, 1:4], [*small.rows[:2], small.rows[-1]], slice(None)),
    ):
        for panel, row in zip(panels, rows, strict=True):
            show_image(panel, array(row.estimate[0, colour])[cut, cut], f"{row.name}\n{row.psnr:.1f} dB")
    for panel, name in zip(axes[0, 4:], ("plain lens", "learned"), strict=True):
        kernel = array(shown[name][colour])
        middle = slice(len(kernel) // 2 - 10, len(kernel) // 2 + 11)
        _show_kernel(panel, kernel[middle, middle], f"PSF: {name}")
    _show_kernel(axes[1, 4], array(shown["plate"][colour]), "PSF: plate")
    sensor = shown["sensor"][colour]
    show_image(axes[1, 5], array(sensor), "the sensor behind it", top=float(sensor.max()))
    return figure


def _show_kernel(panel: Axes, kernel: np.ndarray, title: str) -> None:
    """A kernel on a logarithmic scale of four decades."""
    top, size = float(kernel.max()), len(kernel)
    look = {"vmin": None, "top": None, "cmap": "magma", "norm": LogNorm(1e-4 * top, top)}
    show_image(panel, np.maximum(kernel, 1e-4 * top), f"{title}\n{size} × {size} pixels", **look)


def superres(arguments: argparse.Namespace) -> Table:
    """Every row of every camera; the page where --docs asks for it."""
    settings = Settings.of(vars(arguments))
    kind = "pictures" if arguments.data else "dead-leaves images"
    given, _ = pictures_of(arguments, SIDE, lambda: dead_leaves(arguments.limit, size=SIDE, seed=settings.seed))
    train, test = split(given)
    about = {"pictures": digest(given.samples), "steps": settings.steps, "starts": settings.starts}
    cameras = [
        Setup(factor, tuple(colours), settings.noise) for factor in settings.factor for colours in settings.wavelength
    ]
    with tempfile.TemporaryDirectory() as unkept:
        store = Store(Path(arguments.folder or unkept), about | {"seed": settings.seed})
        study, blocks, figure = Study(settings, kind, train, test, store), [], None
        for setup in progress(cameras, "camera"):
            (full, of_full), (small, of_small) = study.full_frame(setup), study.small(setup)
            figure = figure or superres_figure(full, small, of_full | of_small)
            blocks += [full, small]
        noises = []
        for noise in progress(NOISES, "noise"):
            rows = study.small(dataclasses.replace(cameras[0], noise=noise), (3,))[0].rows
            noises.append({"noise": noise, **{row.name: row.psnr for row in rows}})
    table = Table(blocks, noises)
    if arguments.docs:
        columns = ("factor", "colours", "scene", "way", "closed", "restored", "gain")
        columns += ("gain_mmse", "gain_mmse_low", "gain_mmse_high")
        tables = {
            "superres.csv": csv([{name: record.get(name, "–") for name in columns} for record in table.records()]),
            "superres_noise.csv": csv(noises, floats=lambda number: round(number, 4)),
        }
        # Pictures of other authors are not published.
        figures = {} if arguments.data else {"superres.png": figure}
        parts = _parts(table, study, _command(arguments, settings), figures)
        publish(Path(arguments.docs) / "wave_superres.md", "wave", parts, tables=tables, figures=figures)
    return table


def _command(arguments: argparse.Namespace, settings: Settings) -> str:
    rows = {name: row for name, row in ROWS.items() if name != "wavelength"}
    options = [*picture_words(arguments, LIMIT), *words(settings, rows)]
    options += [f"--wavelength {' '.join(f'{w:g}' for w in colours)}" for colours in settings.wavelength]
    return " ".join(["python docs/experiments/wave_superres.py", *options, "-o FOLDER --docs docs"])


def _parts(table: Table, study: Study, command: str, figures: dict) -> list[str]:
    settings, side = study.settings, SIDE - 2 * BORDER
    noises = table.noises
    names = [name for name in noises[0] if not name.endswith(SECTORS)]
    lines = [[f"{record['noise']:g}", *(f"{record[name]:.2f}" for name in names[1:])] for record in noises]
    caption = (
        "Restored images and kernels. Top: a scene that fills the sensor. Bottom: a small scene on a dark ground, "
        "imaged at several places and restored jointly. Kernels: logarithmic, four decades."
    )
    return [
        "# Super-resolution from one exposure: does a learned element help?",
        *_answer(table),
        f"    {command}",
        f"Aperture 5 mm, sensor at 35.5 mm, scene at 1 m. Picture pixels of 3.69 µm; sensor pixels 2 or 3 times as "
        f"large; noise {settings.noise:g} of white. Filters are made for {len(study.train)} {study.kind} and restore "
        f"{len(study.test)} others: the middle {SIDE} × {SIDE} pixels with mirrored borders, or for the small scene "
        f"the middle {side} × {side}. *MMSE*: the linear filter with least mean square error. PSNR in dB over all "
        "colours and the whole field; gains over the plain lens with the 95 % interval of 2,000 samples of the test "
        "images.",
        *(picture(f"wave/{name}", caption) for name in figures),
        f"## Pixels × {settings.factor[0]}",
        table.markdown(settings.factor[0]),
        "All pixels, plates of sectors, gains over bicubic enlargement, closed forms and the bound of one image: "
        "[superres.csv](wave/superres.csv).",
        f"## The small scene over noise, pixels × {settings.factor[0]}, {table.blocks[0].setup.colours}",
        grid(names, lines),
        "Elements and filters are made for each noise ([superres_noise.csv](wave/superres_noise.csv)).",
    ]


def _answer(table: Table) -> Iterator[str]:
    """Gains of the best learned element of each scene over the plain lens with its MMSE filter."""
    yield "Gains over the plain lens with the same kind of linear filter, in dB:"
    lines = []
    for scene, about in (("full frame", "A scene that fills the sensor"), ("small", "A small scene on a dark ground")):
        gains = []
        for block in (block for block in table.blocks if block.scene == scene):
            best = max((row for row in block.rows if "learned" in row.name), key=lambda row: row.psnr)
            gains.append(f"{best.gain(block.rows[1])} at pixels × {block.setup.factor}, {block.setup.colours}")
        lines.append(f"- **{about}**: {'; '.join(gains)}.")
    yield "\n".join(lines)


def options(parser: argparse.ArgumentParser) -> None:
    content = f"folder of pictures of {SIDE} × {SIDE} pixels or more; four fifths make the filters"
    add_options(parser, defaults_of(Settings), ROWS)
    picture_options(parser, content, limit=LIMIT)
    output_folder("folder of learned elements")(parser)
    documents(parser, "wave_superres.md and wave/")
    json(parser)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args(argv)
    present(superres(arguments), arguments)


if __name__ == "__main__":
    sys.exit(main())

"""What `raytrace wave superres` finds: as text, as a document, as a page."""

import argparse
import dataclasses
from collections.abc import Container, Sequence
from pathlib import Path

from torch import Tensor

from raytrace.cli.progress import progress
from raytrace.files import table
from raytrace.imaging.restoration import psnr
from raytrace.maths.result import Result
from raytrace.pages import grid
from raytrace.studies.edof.world import World, periodic, spectrum
from raytrace.studies.options import picture_words
from raytrace.studies.pictures import Pictures, dead_leaves, pictures, pictures_of, split
from raytrace.studies.publish import publish
from raytrace.studies.superres.command import LIMIT, Settings
from raytrace.studies.superres.experiment import (
    BORDER,
    FIELD,
    Plate,
    Row,
    full_frame,
    hologram,
    kernels,
    learn_heights,
    learned_lens,
    lens,
    multiplexed,
    parts_of_a_pixel,
    places_of,
    sectors,
    small_scenes,
    wide_kernels,
    world_of,
)
from raytrace.studies.superres.inversion import least_error

_FIGURE = (
    "![Restored pictures and kernels](wave/superres.png)",
    "*Above, a scene that fills the sensor; below, a small one on a dark ground, shown at several places of one sensor "
    "and inverted jointly. Kernels on a logarithmic scale of four decades.*",
)
_SIDE = 96  # pixels of a picture
_NOISES = (0.0003, 0.001, 0.003, 0.01, 0.03)
_KEYS = ("factor", "colours", "scene", "way", "closed", "restored", "gain")
_COLUMNS = ("scene", "optics and restoration", "expected", "restored", "over bicubic")


@dataclasses.dataclass(frozen=True)
class Scene:
    """Ways to the pictures of a scene, bicubic first, and the bound of one image, dB."""

    rows: list[Row]
    bound: float

    def document(self, name: str) -> dict:
        rows = [
            {"name": row.name, "closed_form": row.closed, "psnr": row.psnr, "by_colour": list(row.by_colour)}
            for row in self.rows
        ]
        return {name: rows, f"{name}_bound": self.bound}

    def lines(self, name: str) -> list[tuple[str, ...]]:
        first = self.rows[0].psnr
        rows = [
            (name, row.name, "–" if row.closed is None else f"{row.closed:.2f}", f"{row.psnr:.2f}",
             f"{row.psnr - first:+.2f}")
            for row in self.rows
        ]  # fmt: skip
        return [*rows, (name, "upper bound of one image", f"{self.bound:.2f}", "–", "–")]


@dataclasses.dataclass(frozen=True)
class Block:
    """One camera: a scene that fills its sensor, and a small one; drawn: what the figure shows of them."""

    factor: int
    wavelengths: tuple[float, ...]
    full: Scene
    small: Scene
    drawn: dict

    @property
    def colours(self) -> str:
        return f"{', '.join(f'{1e3 * w:.0f}' for w in self.wavelengths)} nm"

    @property
    def lines(self) -> list[tuple[str, ...]]:
        return [*self.full.lines("full frame"), *self.small.lines("small")]


@dataclasses.dataclass(frozen=True)
class Superresolution(Result):
    """Every camera; noise: of the sensor; kind: what was restored; trained, tested: how many."""

    noise: float
    kind: str
    trained: int
    tested: int
    blocks: list[Block]

    FIGURE = "studies.superres.figures.superres_figure"

    def document(self) -> dict:
        cameras = [
            {"factor": one.factor, "wavelengths": list(one.wavelengths), **one.full.document("full_frame"),
             **one.small.document("small_scene")}
            for one in self.blocks
        ]  # fmt: skip
        about = {"noise": self.noise, "pictures": self.kind, "trained": self.trained, "tested": self.tested}
        return about | {"cameras": cameras}

    def __str__(self) -> str:
        text = []
        for block in self.blocks:
            about = f"pixels × {block.factor}, {block.colours}, noise {self.noise:g}, {self.kind}; PSNR in dB"
            rows = [f"{a:>12} {b:<32} {c:>8} {d:>8} {e:>12}" for a, b, c, d, e in [_COLUMNS, *block.lines]]
            text += [about, *rows]
        return "\n".join(text)


def superres(arguments: argparse.Namespace) -> Superresolution:
    """Learn, restore and compare; write the page where --docs asks for it."""
    settings = Settings.of(vars(arguments))
    given, kind = pictures(arguments, _SIDE, lambda: dead_leaves(arguments.limit, size=_SIDE, seed=settings.seed))
    train, test = split(given)
    cameras = [(factor, tuple(colours)) for factor in settings.factor for colours in settings.wavelength]
    blocks = [_block(settings, factor, colours, train, test) for factor, colours in progress(cameras, "camera")]
    found = Superresolution(settings.noise, kind, len(train), len(test), blocks)
    if arguments.docs:
        noises = _over_noise(settings, train, test)
        lines = [(one.factor, one.colours, *line) for one in blocks for line in one.lines]
        tables = {
            "superres_noise.csv": table(noises, floats=lambda number: round(number, 4)),
            "superres.csv": table([dict(zip(_KEYS, line, strict=True)) for line in lines]),
        }
        # Pictures of others are not for pages.
        figures = {"superres.png": found.plot()} if kind == "dead leaves" else {}
        words = [*picture_words(arguments, LIMIT), *settings.words()]
        parts = _parts(found, settings, " ".join(["raytrace wave superres", *words, "--docs docs"]), noises, figures)
        publish(Path(arguments.docs) / "wave_superres.md", "wave", parts, tables=tables, figures=figures)
    return found


def _block(settings: Settings, factor: int, colours: tuple[float, ...], train: Pictures, test: Pictures) -> Block:
    world = world_of(colours, noise=settings.noise)
    own, others = periodic(train, 2 * _SIDE), periodic(test, 2 * _SIDE)
    S = spectrum(own)
    best = learned_lens(world, S, factor, starts=settings.starts, steps=settings.steps, seed=settings.seed)
    elements = {"plain lens": lens(world), "learned": best}
    full = full_frame(elements, world, factor, train=own, test=others, seed=settings.seed)
    small, drawn = _small(settings, world, factor, train, test, settings.places)
    drawn |= {"picture": others[0], **{name: kernels(one, world) for name, one in elements.items()}}
    return Block(factor, colours, Scene(full, _bound(S, factor)), small, drawn)


def _small(
    settings: Settings, world: World, factor: int, train: Pictures, test: Pictures, counts: Sequence[int]
) -> tuple[Scene, dict]:
    """The small scene, and what is drawn of its last row."""
    own, others = small_scenes(train), small_scenes(test)
    S = spectrum(own)
    rows, drawn = full_frame({"plain lens": lens(world)}, world, factor, train=own, test=others), {"scene": others[0]}
    for count in counts:
        plate = Plate(world, places_of(count), parts_of_a_pixel(count, factor))
        start = hologram(plate, seed=settings.seed)
        plates = {"sectors": sectors(plate), "phase of the sum": start}
        plates["learned"] = learn_heights(plate, start, S, factor, steps=settings.steps)
        for name, elements in plates.items():
            kernel = wide_kernels(elements, world)
            row, sensor = multiplexed(f"{count} places, {name}", kernel, plate, factor, train=own, test=others)
            rows.append(row)
            drawn |= {"plate": kernel, "sensor": sensor[0], "row": row}
    return Scene(rows, _bound(S, factor)), drawn


def _bound(S: Tensor, factor: int) -> float:
    return float(psnr(least_error(S, factor)))


def _over_noise(settings: Settings, train: Pictures, test: Pictures) -> list[dict]:
    """The small scene of the first camera at several noises, everything made for each."""
    found = []
    for noise in progress(_NOISES, "noise"):
        world = world_of(settings.wavelength[0], noise=noise)
        scene, _ = _small(settings, world, settings.factor[0], train, test, settings.places[:1])
        found.append({"noise": noise, **{row.name: row.psnr for row in scene.rows}})
    return found


def _parts(
    found: Superresolution, settings: Settings, command: str, noises: Sequence[dict], figures: Container[str]
) -> list[str]:
    side = FIELD - 2 * BORDER
    number = settings.starts
    starts = f", and from {number} random start{'s' if number > 1 else ''} around it, the best kept" if number else ""
    cells = [[f"{one['noise']:g}", *(f"{value:.2f}" for value in list(one.values())[1:])] for one in noises]
    return [
        "# Super-resolution: pictures finer than the sensor's pixels, from one exposure",
        f"    {command}",
        f"A camera of 5 mm aperture with its sensor at 35.5 mm looks at scenes 1 m away. The picture has pixels of "
        f"3.69 µm, the sensor pixels 2 or 3 times as large, noise {settings.noise:g} (white is 1). Filters are made "
        f"for {found.trained} {pictures_of(found.kind)} and restore {found.tested} others: of each the middle {_SIDE} "
        f"× {_SIDE} pixels and their mirror images, of a small scene its middle {side} × {side}, noise drawn once. "
        f"The learned element of the full frame begins from the plain lens{starts}. PSNR in dB of restored test "
        "pictures, over all colours; *expected*: the error of the filter in closed form, for pictures of the power "
        "spectrum it was made for; MMSE: the linear filter of least mean square error; *over bicubic*: gain over the "
        "plain lens and bicubic enlargement.",
        *(_FIGURE if "superres.png" in figures else ()),
        *(
            part
            for block in found.blocks
            for part in (f"## Pixels × {block.factor}, {block.colours}", grid(_COLUMNS, block.lines))
        ),
        f"## The small scene over noise, pixels × {settings.factor[0]}",
        grid(list(noises[0]), cells),
        "Elements and filters are made anew for each noise.",
    ]

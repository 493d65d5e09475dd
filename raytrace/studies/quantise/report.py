"""What `raytrace wave quantise` finds: as text, as a document, as a page."""

import argparse
import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from raytrace.cli.door import CommandError
from raytrace.cli.progress import progress
from raytrace.files import table
from raytrace.maths.result import Result
from raytrace.maths.value import detached
from raytrace.pages import grid
from raytrace.studies.edof.report import learn
from raytrace.studies.edof.settings import Settings as Learning
from raytrace.studies.edof.world import World, periodic, spectrum
from raytrace.studies.options import picture_words
from raytrace.studies.pictures import Pictures, dead_leaves, pictures, pictures_of, split
from raytrace.studies.publish import publish, published
from raytrace.studies.quantise.command import LIMIT, Settings
from raytrace.studies.quantise.experiment import (
    WAYS,
    Judge,
    Steps,
    Tolerance,
    efficiency,
    law,
    made,
    read,
    steps_of,
    tolerances_of,
)
from raytrace.wave_optics.designs import aim, baseline, singlet
from raytrace.wave_optics.element import Element
from raytrace.wave_optics.element_files import read_element
from raytrace.wave_optics.height_maps import FORMATS
from raytrace.words import did_you_mean

_NAMED = ("fresnel", "learned")  # elements that are no files
_SIDE = 128  # pixels of a picture


@dataclasses.dataclass(frozen=True)
class Etched:
    """Light at the focus of the Fresnel lens, the ideal lens's being 1: its law sinc²(1/L), its profile as it is, and
    that in rings of 2 µm; levels 0: any height."""

    levels: int
    law: float
    any_width: float
    rings: float


@dataclasses.dataclass(frozen=True)
class Fabrication(Result):
    """What levels and errors of height cost; kind: of the pictures; trained, tested: how many."""

    kind: str
    trained: int
    tested: int
    etched: list[Etched]
    steps: list[Steps]
    tolerances: list[Tolerance]

    FIGURE = "studies.quantise.figures.quantise_figure"

    def tables(self) -> dict[str, list[dict]]:
        named = {"efficiency": self.etched, "levels": self.steps, "tolerance": self.tolerances}
        return {name: [dataclasses.asdict(row) for row in rows] for name, rows in named.items()}

    def document(self) -> dict:
        return {"pictures": self.kind, "trained": self.trained, "tested": self.tested, **self.tables()}

    def __str__(self) -> str:
        return "\n\n".join(map(_text, self.tables().values()))


def quantise(arguments: argparse.Namespace) -> Fabrication:
    """Efficiency, expected PSNR over levels and tolerances; write the page where --docs asks for it."""
    settings = Settings.of(vars(arguments))
    given, kind = pictures(arguments, _SIDE, lambda: dead_leaves(arguments.limit, size=_SIDE, seed=settings.seed))
    train, test = split(given)
    own, others = periodic(train, 2 * _SIDE), periodic(test, 2 * _SIDE)
    S = spectrum(own)
    found = Fabrication(kind, len(train), len(test), _etched(settings.levels), [], [])
    for name in settings.element:
        title, element, world = _element(settings, name, train, S, arguments.folder)
        judge, ways = Judge(world, S), _ways(settings, name)
        rows, elements = steps_of(
            title,
            element,
            judge,
            others,
            levels=settings.levels,
            ways=ways,
            steps=settings.steps,
            progress=lambda cases: progress(cases, "element"),
        )
        found.steps.extend(rows)
        for way in ways:
            if way == "looped" and "trained" in ways:
                continue
            count = 0 if way == "whole" else 16 if 16 in settings.levels else max(settings.levels)
            nm = (0.0, *settings.tolerance)
            found.tolerances.extend(tolerances_of(title, way, elements[way, count], judge, nm=nm, seed=settings.seed))
    if arguments.docs:
        kept = {"quantise.csv": "levels", "quantise_tolerance.csv": "tolerance"}
        rows = {name: table(found.tables()[own], floats=lambda n: round(n, 4)) for name, own in kept.items()}
        named = [name if name in _NAMED else published(name, arguments.docs) for name in settings.element]
        words = [*picture_words(arguments, LIMIT), *dataclasses.replace(settings, element=tuple(named)).words()]
        parts = _parts(found, settings, " ".join(["raytrace wave quantise", *words, "--docs docs"]))
        page, figures = Path(arguments.docs) / "wave_quantise.md", {"quantise.png": found.plot()}
        publish(page, "wave", parts, tables=rows, figures=figures)
    return found


def _element(
    settings: Settings, name: str, train: Pictures, S: Tensor, folder: str | None
) -> tuple[str, Element, World]:
    """What an element is called, itself, and its world."""
    world, path = World(), Path(name)
    if name == "fresnel":
        (element,) = baseline("fresnel", aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design))
        return name, element, world
    if name == "learned":
        return name, *_learned(settings, world, train, folder)
    if path.is_dir():
        return path.name, *read(path, S)
    if path.suffix.lower() not in FORMATS:
        raise CommandError(
            f"--element {name}: expected fresnel, learned, the folder of a run, or a height map "
            f"({', '.join(FORMATS)}){did_you_mean(name, _NAMED)}"
        )
    own = {option: getattr(settings, option) for option in ("aperture", "glass", "pitch", "span")}
    element = read_element(name, **own)
    return path.name, element, dataclasses.replace(world, radius=0.5 * settings.aperture)


def _learned(settings: Settings, world: World, train: Pictures, folder: str | None) -> tuple[Element, World]:
    how = Learning(steps=settings.learn, starts=settings.starts, seed=settings.seed)
    with tempfile.TemporaryDirectory() as temporary:
        camera = learn(how, world, train, Path(folder or temporary), "learned")
    return detached(camera.variables()[0]), world


def _ways(settings: Settings, name: str) -> list[str]:
    """Of WAYS, those asked for; a kinoform lives by its wraps."""
    if name == "fresnel":
        return ["wrapped"]
    whole = [] if settings.wrap else ["whole"]
    if settings.wrap is False:
        return whole
    return [*whole, "wrapped", *(("looped", "trained") if settings.steps else ())]


def _etched(levels: Sequence[int]) -> list[Etched]:
    world, made_for = World(), aim()
    shapes = (*singlet(made_for), *baseline("fresnel", made_for))
    return [Etched(n, law(n), *(efficiency(made(one, n, wrap=True), world) for one in shapes)) for n in (*levels, 0)]


def _text(rows: Sequence[dict]) -> str:
    """The table, and below it what the words in the column `made` mean."""
    lines = [list(rows[0])] + [[_cell(value) for value in row.values()] for row in rows] if rows else []
    text = "\n".join("  ".join(f"{cell:>12}" for cell in line) for line in lines)
    ways = dict.fromkeys(row["made"] for row in rows if "made" in row)
    return "\n".join([text, "; ".join(f"{way}: {WAYS[way]}" for way in ways)]).rstrip()


def _cell(value) -> str:
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def _parts(found: Fabrication, settings: Settings, command: str) -> list[str]:
    learned = (
        f" The element *learned*, {settings.learn} steps from the best of {settings.starts} random starts, knows the "
        "spectrum of the same pictures."
    )
    levels = [0, *settings.levels]
    header = ("element", "how made", *(f"{n} levels" if n else "any height" for n in levels))
    by = {(row.element, row.made, row.levels): row for row in found.steps}
    kinds = list(dict.fromkeys((row.element, row.made) for row in found.steps))

    def of(column: str) -> str:
        cells = {kind: [f"{getattr(by[*kind, n], column):.2f}" for n in levels] for kind in kinds}
        return grid(header, [(name, WAYS[way], *cells[name, way]) for name, way in kinds])

    light = [
        (row.levels or "any", f"{row.law:.4f}", f"{row.any_width:.4f}", f"{row.rings:.4f}") for row in found.etched
    ]
    errors = [
        (row.element, WAYS[row.made], row.levels or "any", f"{row.nm:g}", f"{row.mean:.3f}",
         f"{row.least:.3f} … {row.greatest:.3f}")
        for row in found.tolerances
    ]  # fmt: skip
    return [
        "# What fabrication costs: levels, wrapping, errors of height",
        f"    {command}",
        "![Efficiency, levels and tolerance](wave/quantise.png)",
        "## A kinoform at its focus",
        grid(("levels", "sinc²(1/L)", "efficiency, steps of any width", "efficiency, rings of 2 µm"), light),
        "Light at the focus over that of an ideal lens: 5 mm, f/7.1, 0.55 µm.",
        "## Levels",
        "Expected PSNR in dB, in closed form, over 0.5 m to infinity at 460, 550 and 640 nm, behind the best filter "
        f"that knows no depth, made for {found.trained} {pictures_of(found.kind)}, of each the middle {_SIDE} × "
        f"{_SIDE} pixels and their mirror images, noise 0.01.{learned if 'learned' in settings.element else ''}",
        of("closed"),
        f"The same of {found.tested} others, restored by it, mean over depths, expected over noise:",
        of("restored"),
        "## Errors of height",
        "The height of every ring in error by a uniform random number within ±, five draws each:",
        grid(("element", "how made", "levels", "± nm", "mean PSNR (dB)", "draws"), errors),
    ]

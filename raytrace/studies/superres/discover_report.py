"""What `raytrace wave discover` finds: as text, as a document, as a page."""

import argparse
import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.cli.progress import progress
from raytrace.files import table, write_atomically
from raytrace.imaging.training import Run, read_state
from raytrace.maths.result import Result
from raytrace.pages import grid, picture
from raytrace.studies.edof.noise import Gains, drawn
from raytrace.studies.edof.world import World, periodic, spectrum
from raytrace.studies.options import picture_words
from raytrace.studies.pictures import Pictures, dead_leaves, digest, pictures, pictures_of, split
from raytrace.studies.publish import publish
from raytrace.studies.superres.discover import SIDE, Error, Found, Place, discover, errors_of_scenes, moments, starts
from raytrace.studies.superres.discover_command import LIMIT, Settings
from raytrace.studies.superres.experiment import world_of

_FACTOR = 2
_CROPS = 3  # scenes along a restored picture, and across


@dataclasses.dataclass(frozen=True)
class Plated:
    """A plate and what it is worth: PSNR in dB of restored scenes, gain over the plain lens behind its own filter."""

    colours: str
    found: Found
    gains: Gains

    def record(self) -> dict:
        own = {"colours": self.colours} | self.found.record()
        own |= {"psnr": self.gains.pooled_psnr, **self.gains.pooled.record("gain")}
        return own | {"mean_psnr": self.gains.mean_psnr, **self.gains.mean.record("mean_gain")}


@dataclasses.dataclass(frozen=True)
class Discovered(Result):
    """Every plate of every camera; pictures: how many gave scenes to restore; kind: of them."""

    plates: list[Plated]
    pictures: int
    kind: str
    noise: float

    FIGURE = "studies.superres.figures.discover_figure"

    def document(self) -> dict:
        return {"noise": self.noise, "pictures": self.kind, "plates": [one.record() for one in self.plates]}

    def lines(self, colours: str) -> list[tuple[str, ...]]:
        rows = []
        for one in self.plates:
            if one.colours == colours:
                own, places = one.found, one.found.places
                light = f"{sum(place.light for place in places):.2f}"
                cells = (
                    f"{own.before:.2f}",
                    f"{own.after:.2f}",
                    f"{one.gains.pooled_psnr:.2f}",
                    str(one.gains.pooled),
                    str(one.gains.mean),
                )
                rows.append((own.start, *cells, str(len(places)), light))
        return rows

    @property
    def cameras(self) -> list[str]:
        return list(dict.fromkeys(one.colours for one in self.plates))

    def __str__(self) -> str:
        text = []
        for colours in self.cameras:
            text.append(f"{colours}, {self.kind}; dB")
            text += [f"{row[0]:>32}" + "".join(f"{cell:>26}" for cell in row[1:]) for row in self._all(colours)]
        return "\n".join(text)

    def _all(self, colours: str) -> list[tuple[str, ...]]:
        return [_HEADER, *self.lines(colours)]


_HEADER = (
    "plate",
    "expected, start",
    "learned",
    "restored",
    "over the plain lens, pooled",
    "mean of PSNRs",
    "places",
    "light in them",
)


def discover_places(arguments: argparse.Namespace) -> Discovered:
    """Learn, judge and compare; write the page where --docs asks for it."""
    settings = Settings.of(vars(arguments))
    given, kind = pictures(arguments, 96, lambda: dead_leaves(arguments.limit, size=96, seed=settings.seed))
    train, test = split(given)
    plates = []
    with tempfile.TemporaryDirectory() as unkept:
        for colours in settings.wavelength:
            name = f"{', '.join(f'{1e3 * w:.0f}' for w in colours)} nm"
            folder = Path(arguments.folder or unkept) / name.replace(", ", "-").replace(" ", "-")
            plates += _camera(settings, name, tuple(colours), train, test, folder)
    result = Discovered(plates, len(test), kind, settings.noise)
    if arguments.docs:
        tables = {"discover.csv": table([one.record() for one in plates], floats=lambda n: round(n, 4))}
        words = [*picture_words(arguments, LIMIT), *settings.words()]
        parts = _parts(result, " ".join(["raytrace wave discover", *words, "-o FOLDER --docs docs"]))
        page = Path(arguments.docs) / "wave_discover.md"
        publish(page, "wave", parts, tables=tables, figures={"discover.png": result.plot()})
    return result


def _camera(
    settings: Settings, name: str, colours: tuple[float, ...], train: Pictures, test: Pictures, folder: Path
) -> list[Plated]:
    world = world_of(colours, noise=settings.noise)
    error = Error(world, moments(spectrum(periodic(train, 192))), _FACTOR)
    about = {"world": dataclasses.asdict(error.world), "steps": settings.steps, "pictures": digest(train.samples)}
    run = Run(folder, about)
    todo = starts(world, spreads=settings.spread, seeds=settings.starts, factor=_FACTOR)
    plates = []
    for title, path, learned in progress(todo, "plate"):
        plates.append(_kept(run, title, path, error, settings.steps * learned))
    return _judged(plates, name, error, _scenes(test), test.classes, settings)


def _kept(run: Run, title: str, path: Tensor, error: Error, steps: int) -> Found:
    """What is kept of a plate, or learned now."""
    file = run.folder / f"{title.replace(' ', '-').replace(',', '')}.pt"
    if not file.exists():
        found = discover(title, path, error, steps=steps)
        kept = {name: getattr(found, name) for name in ("before", "after", "kernel")}
        kept["places"] = torch.tensor([dataclasses.astuple(place) for place in found.places])
        write_atomically(file, lambda stream: torch.save(kept, stream))
    kept = read_state(file)
    places = tuple(Place(*row) for row in kept["places"].tolist())
    return Found(title, kept["before"], kept["after"], places, kept["kernel"])


def _scenes(test: Pictures) -> Tensor:
    """(B, crops, n²) of pictures in [0, 1]."""
    found = []
    for sample in test.samples:
        steps = [(min(sample.shape) - SIDE) * k // (_CROPS - 1) for k in range(_CROPS)]
        crops = [sample[a : a + SIDE, b : b + SIDE].reshape(-1) / 255 for a in steps for b in steps]
        found.append(torch.stack([torch.as_tensor(one) for one in crops]))
    return torch.stack(found).double()


def _judged(
    plates: Sequence[Found], name: str, error: Error, scenes: Tensor, classes: Sequence[str], settings: Settings
) -> list[Plated]:
    """Classes of pictures count as wholes where samples are drawn: scenes of one are not independent."""
    weights = drawn(classes, seed=settings.seed)
    left = []
    for one in plates:
        own = errors_of_scenes(one.kernel, error.C, error.world.noise, _FACTOR, scenes.flatten(0, 1))
        left.append(own.unflatten(0, scenes.shape[:2]).mean(1)[:, None])  # (B, 1, W)
    return [Plated(name, one, Gains.of(own, left[0], weights)) for one, own in zip(plates, left, strict=True)]


def _parts(found: Discovered, command: str) -> list[str]:
    world = World()
    return [
        "# Places that nobody prescribed",
        f"    {command}",
        f"A scene of {SIDE} × {SIDE} pixels of {1e3 * world.pixel:g} µm on a dark ground, {_FACTOR} × {_FACTOR} of "
        f"them to a pixel of the sensor, noise {found.noise:g}; 5 mm aperture, sensor at 35.5 mm, 1 m. Heights of a "
        "plate before the plain lens are learned by the exact error of the best linear restoration from all pixels of "
        "a wide sensor: neither places nor their number are part of it. *Expected*: that error as PSNR in dB; "
        f"*restored*: of scenes out of {found.pictures} {pictures_of(found.kind)} that the restoration was not made "
        "for, expected over noise, its gain over the plain lens behind its own best restoration with the interval of "
        "95 % of 2,000 samples of the classes of pictures, of errors pooled over pictures and of the mean of their "
        "PSNRs; *places*: peaks that hold 4 % of the light or more, in the middle "
        "colour.",
        picture("wave/discover.png", "Kernels of the plates, logarithmic over three decades, circles at their places."),
        *(part for colours in found.cameras for part in (f"## {colours}", grid(_HEADER, found.lines(colours)))),
        "All figures: [discover.csv](wave/discover.csv).",
    ]

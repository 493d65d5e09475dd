"""What `raytrace wave network` finds: as text, as a document, as a page."""

import argparse
import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch
from torch import Tensor

from raytrace.cli.door import CommandError
from raytrace.cli.progress import progress
from raytrace.files import table, write_json
from raytrace.imaging.training import read_json
from raytrace.maths.result import Result
from raytrace.pages import grid
from raytrace.studies.edof.command import LIMIT
from raytrace.studies.edof.network import Filtered, errors_behind, learn_network, patches
from raytrace.studies.edof.network_command import USUAL, Settings
from raytrace.studies.edof.noise import Gains, best_strengths, cases, drawn, mark_of_elements
from raytrace.studies.edof.noise_report import OF_INTERVALS, element_words, elements_in
from raytrace.studies.edof.report import contents_of
from raytrace.studies.edof.table import ROWS, Content, title_of
from raytrace.studies.edof.world import World, kernels, spectrum, transfer
from raytrace.studies.options import picture_words
from raytrace.studies.pictures import digest, pictures_of
from raytrace.studies.publish import publish
from raytrace.wave_optics.element import Element

_TRAINED, _RESTORED = 100, 24  # pictures


@dataclasses.dataclass(frozen=True)
class Behind:
    """One element: PSNR in dB behind the filter and with the network, what the network brings, and the gain of both
    over those of the first row."""

    row: str
    brings: Gains
    over_filter: Gains
    over_network: Gains

    def record(self) -> dict:
        found = {"row": self.row}
        for name, one in (("filter", self.over_filter), ("network", self.over_network)):
            found |= {name: one.pooled_psnr, f"mean_{name}": one.mean_psnr}
        for name in ("brings", "over_filter", "over_network"):
            own = getattr(self, name)
            found |= own.pooled.record(name) | own.mean.record(f"mean_{name}")
        return found


@dataclasses.dataclass(frozen=True)
class Networks(Result):
    """Every element; trained, pictures, classes: how many were learned from, restored, and of how many classes."""

    rows: list[Behind]
    trained: int
    pictures: int
    classes: int
    kind: str
    noise: float

    def document(self) -> dict:
        return {"pictures": self.pictures, "kind": self.kind, "rows": [row.record() for row in self.rows]}

    def lines(self) -> list[tuple[str, ...]]:
        return [
            (title_of(one.row), f"{one.over_filter.pooled_psnr:.2f}", f"{one.over_network.pooled_psnr:.2f}",
             str(one.brings.pooled), str(one.brings.mean), str(one.over_filter.pooled), str(one.over_filter.mean),
             str(one.over_network.pooled), str(one.over_network.mean))
            for one in self.rows
        ]  # fmt: skip

    @property
    def header(self) -> tuple[str, ...]:
        first = title_of(self.rows[0].row)
        gains = ("network brings", f"gain over the {first}, filters", "networks")
        return ("element", "filter", "network", *(f"{gain}, {mean}" for gain in gains for mean in ("pooled", "mean")))

    def __str__(self) -> str:
        lines = [f"{row[0]:>32}" + "".join(f"{cell:>26}" for cell in row[1:]) for row in [self.header, *self.lines()]]
        return "\n".join([f"{self.kind}, noise {self.noise:g}: PSNR in dB, gains (95 % interval)", *lines])


def networks(arguments: argparse.Namespace) -> Networks:
    """Learn what is left, judge everything; the page where --docs asks for it."""
    settings = Settings.of(vars(arguments))
    unknown = [row for row in arguments.rows if row not in ROWS or ROWS[row].learning]
    if unknown:
        baselines = ", ".join(row for row in ROWS if not ROWS[row].learning)
        raise CommandError(f"--rows {' '.join(unknown)}: expected {baselines}")
    files = elements_in(arguments.elements)
    content = contents_of(arguments)[0][-1 if arguments.data else 0]
    found, mark = {}, digest([*content.train.numpy(), *content.test.numpy()])
    for name, elements in _elements(arguments, files, settings, content):
        found[name] = _judged(name, elements, content, mark, settings, Path(arguments.folder))
    judged = _evenly(len(content.test), _RESTORED)
    classes = [content.classes[place] if content.classes else place for place in judged]
    counts = min(_TRAINED, len(content.train)), len(judged), len(set(classes))
    result = Networks(_rows(found, classes, settings), *counts, content.name, settings.noise)
    if arguments.docs:
        words = [f"--rows {' '.join(arguments.rows)}"] if tuple(arguments.rows) != USUAL else []
        words += [*element_words(arguments), *picture_words(arguments, LIMIT), *settings.words()]
        parts = _parts(result, " ".join(["raytrace wave network", *words, "-o FOLDER --docs docs"]))
        tables = {"network.csv": table([row.record() for row in result.rows], floats=lambda n: round(n, 4))}
        publish(Path(arguments.docs) / "wave_network.md", "wave", parts, tables=tables, figures={})
    return result


def _elements(
    arguments: argparse.Namespace, files: Mapping[str, Element], settings: Settings, content: Content
) -> Iterator[tuple[str, tuple[Element, ...]]]:
    cubic = any(row.startswith("cubic") for row in arguments.rows)
    strengths = best_strengths([settings.noise], spectrum(content.train)) if cubic else {}
    for row, elements, _ in cases(arguments.rows, [settings.noise], strengths):
        yield row, elements
    for name, element in files.items():
        yield name, (element,)


def _judged(
    name: str, elements: tuple[Element, ...], content: Content, mark: str, settings: Settings, root: Path
) -> dict[str, Tensor]:
    """Errors (B, D, W) behind the filter and behind both; mark: `digest` of all the content's pictures."""
    made: list[Filtered] = []

    def camera() -> Filtered:
        if not made:
            with torch.no_grad():
                H = transfer(kernels(elements, World()), content.test.shape[-1])
            made.append(Filtered.of(H, spectrum(content.train), settings.noise))
        return made[0]

    about = {"noise": settings.noise, "content": content.name, "pictures": mark}
    about |= {"element": mark_of_elements(elements)}
    folder = root / f"{name}-{settings.noise:g}"
    network = learn_network(
        folder,
        lambda: patches(camera(), content.train[_evenly(len(content.train), _TRAINED)], seed=settings.seed),
        about,
        steps=settings.steps,
        seed=settings.seed,
        bar=lambda steps: progress(steps, f"step of the network of {name}"),
    )
    file = folder / "errors.json"
    if not file.exists():
        errors = errors_behind(
            camera(),
            network,
            content.test[_evenly(len(content.test), _RESTORED)],
            progress=lambda own: progress(own, name),
        )
        write_json(file, {one: own.tolist() for one, own in errors.items()})
    return {one: torch.tensor(own, dtype=torch.float64) for one, own in read_json(file).items()}


def _evenly(total: int, most: int) -> list[int]:
    """Places of at most so many of all pictures: neighbours are of one kind."""
    count = min(most, total)
    return [number * total // count for number in range(count)]


def _rows(found: dict[str, dict[str, Tensor]], classes: Sequence, settings: Settings) -> list[Behind]:
    """classes: of each restored picture."""
    first, weights = next(iter(found.values())), drawn(classes, seed=settings.seed)
    return [
        Behind(
            name,
            Gains.of(own["network"], own["filter"], weights),
            *(Gains.of(own[one], first[one], weights) for one in ("filter", "network")),
        )
        for name, own in found.items()
    ]


def _parts(found: Networks, command: str) -> list[str]:
    return [
        "# A small network behind the filter",
        f"    {command}",
        "Camera, depths and colours of [wave_edof.md](wave_edof.md). Elements stay as they are; behind the best "
        "depth-invariant filter stands a network of 10,000 weights (RED-Net, 6 layers of 16 maps), told neither depth "
        f"nor colour, learned from patches of {found.trained} {pictures_of(found.kind)} at depths drawn, noise "
        f"{found.noise:g}. Judged on {found.pictures} others of {found.classes} classes, all depths and colours, noise "
        "drawn once and the same for both. PSNR in dB, mean over depths, of errors pooled over pictures; gains of "
        f"these and of the mean of the PSNRs of pictures, in brackets the {OF_INTERVALS}.",
        grid(found.header, found.lines()),
        "All figures: [network.csv](wave/network.csv).",
    ]

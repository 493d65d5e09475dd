"""What `raytrace wave noise` finds: as text, as a document, as a page."""

import argparse
import dataclasses
import functools
import io
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace.cli.door import CommandError
from raytrace.cli.progress import progress
from raytrace.files import table, write_atomically, write_json
from raytrace.imaging.training import DamagedRun, Run
from raytrace.maths.result import Result
from raytrace.maths.value import detached
from raytrace.pages import grid, picture
from raytrace.stores import number, read_document
from raytrace.studies.edof.command import LIMIT
from raytrace.studies.edof.noise import (
    Bank,
    Errors,
    Gains,
    Interval,
    Unit,
    best_strengths,
    cases,
    errors_of,
    mark_of,
    mark_of_elements,
    pooled_psnr,
    units,
)
from raytrace.studies.edof.noise_command import Settings
from raytrace.studies.edof.report import contents_of, heights_of, learn
from raytrace.studies.edof.table import ROWS, title_of
from raytrace.studies.edof.training import EdofCamera
from raytrace.studies.edof.world import FILTERS, WAVELENGTH, ClosedForm, World, kernels, transfer
from raytrace.studies.options import picture_words
from raytrace.studies.pictures import Pictures
from raytrace.studies.publish import publish, published
from raytrace.wave_optics.element import Element, Rings, fabricated, is_flat
from raytrace.wave_optics.element_files import SMOOTH, read_element, write_element
from raytrace.words import did_you_mean

#: What intervals of all pages of these studies are.
OF_INTERVALS = "interval of 95 % of 2,000 samples of the classes of restored pictures, drawn with replacement"
TITLES = {"wiener": "Wiener filter of the PSF at 1 m", "blind": "best depth-invariant filter"}
#: Means over pictures, and PSNR and gain as text of each.
MEANS: dict[str, Callable[[Gains], tuple[str, str]]] = {
    "errors pooled over pictures": lambda one: (f"{one.pooled_psnr:.2f}", str(one.pooled)),
    "mean of the PSNRs of pictures": lambda one: (f"{one.mean_psnr:.2f}", str(one.mean)),
}
_PUBLISHED = ROWS["learned"].published - ROWS["fresnel"].published


@dataclasses.dataclass(frozen=True)
class Score:
    """One element on one content behind one filter at one noise: PSNR in dB and gain over the Fresnel lens.

    starts: gains, of pooled errors, of all random starts it was kept from, that of least expected error first.
    """

    content: str
    filter: str
    noise: float
    row: str
    gains: Gains
    starts: tuple[float, ...] = ()

    def record(self) -> dict:
        ends = (min(self.starts), max(self.starts)) if self.starts else (None, None)
        own = {name: getattr(self, name) for name in ("content", "filter", "noise", "row")}
        found = self.gains
        own |= {"psnr": found.pooled_psnr, **found.pooled.record("gain")}
        own |= {"mean_psnr": found.mean_psnr, **found.mean.record("mean_gain")}
        return own | {"starts": len(self.starts) or None, "least_start": ends[0], "greatest_start": ends[1]}


@dataclasses.dataclass(frozen=True)
class OverNoise(Result):
    """Scores of all rows; pictures, classes: how many are restored, and of how many classes, by content."""

    scores: list[Score]
    pictures: dict[str, int]
    classes: dict[str, int] = dataclasses.field(default_factory=dict)

    FIGURE = "studies.edof.figures.noise_figure"

    def document(self) -> dict:
        return {"pictures": self.pictures, "rows": [score.record() for score in self.scores]}

    def of(self, content: str, filter: str) -> dict[str, dict[float, Score]]:
        """Scores by row and noise."""
        found: dict[str, dict[float, Score]] = {}
        for one in self.scores:
            if (one.content, one.filter) == (content, filter):
                found.setdefault(one.row, {})[one.noise] = one
        return found

    def lines(self, content: str, filter: str, cell: Callable[[Score], str]) -> tuple[list[str], list[list[str]]]:
        """Header and a line for each row, a column for each noise."""
        found = self.of(content, filter)
        noises = sorted({noise for row in found.values() for noise in row})
        lines = [
            [title_of(row), *(cell(own[noise]) if noise in own else "–" for noise in noises)]
            for row, own in found.items()
        ]
        return ["element", *(f"noise {noise:g}" for noise in noises)], lines

    def __str__(self) -> str:
        text = []
        for content in self.pictures:
            for filter in FILTERS:
                for mean, shown in MEANS.items():
                    head = f"{content}, {TITLES[filter]}: PSNR in dB, gain over the Fresnel lens (95 % interval)"
                    text.append(f"{head}, {mean}")
                    header, lines = self.lines(content, filter, lambda one, shown=shown: " ".join(shown(one.gains)))
                    text += [
                        f"{line[0]:>32}" + "".join(f"{cell:>30}" for cell in line[1:]) for line in [header, *lines]
                    ]
        return "\n".join(text)


def noise(arguments: argparse.Namespace) -> OverNoise:
    """Learn what is left to learn, judge everything; the page where --docs asks for it."""
    settings, rows, files = Settings.of(vars(arguments)), _rows(arguments.rows), elements_in(arguments.elements)
    contents, train = contents_of(arguments)
    todo = list(units(rows, settings.noise, settings.starts))
    with tempfile.TemporaryDirectory() as unkept:
        root = Path(arguments.folder or unkept)
        banks = [Bank.of(content.name, content.train, content.test, content.classes) for content in contents]
        del contents
        kept = Kept(root / "judged", banks)  # refuses other pictures before anything is learned
        for unit in todo:
            learn_unit(unit, settings, train, root)
        fixed = judge_baselines(rows, settings, banks, kept)
        fixed |= judge_files(files, settings, kept)
        bar = progress(todo, "learned element")
        learned = {unit: judge_learned(unit, settings, train, root, kept) for unit in bar}
        elements = _best_learned(todo, learned, settings, train, root)
    counts = ({one.name: len(one.powers) for one in banks}, {one.name: one.class_count for one in banks})
    found = OverNoise(list(scores(fixed, learned, banks, settings)), *counts)
    if arguments.docs:
        _publish(found, elements, settings, arguments)
    return found


def _rows(asked: Sequence[str] | None) -> list[str]:
    unknown = sorted(set(asked or ()) - set(ROWS))
    if unknown:
        meant = did_you_mean(unknown[0], ROWS)
        raise CommandError(f"--rows {' '.join(unknown)}: expected {', '.join(ROWS)}{meant}")
    wanted = {"fresnel", *(asked or (name for name, row in ROWS.items() if not row.is_extra))}
    return [name for name in ROWS if name in wanted]


def learn_unit(unit: Unit, settings: Settings, train: Pictures, root: Path) -> EdofCamera:
    """The camera of a unit, learned as far as is left."""
    label = f"{ROWS[unit.row].title}, noise {unit.noise:g}, start {unit.start}"
    return learn(unit.settings(settings.steps), unit.world(), train, unit.folder(root), label)


class Kept:
    """Errors of every picture, kept in a folder: computed once for these pictures."""

    def __init__(self, folder: Path, banks: Sequence[Bank]):
        self.banks, self._forms = banks, {}
        self.folder = Run(folder, {"pictures": {bank.name: bank.mark for bank in banks}}).folder

    def transfer(self, elements: Sequence[Element]) -> Tensor:
        """H (D, W, n, n) of learned elements, whatever the noise; of rings what heights do not change is kept."""
        S = self.banks[0].spectrum
        if len(elements) > 1 or not isinstance(elements[0].profile, Rings):
            return transfer(kernels(elements, World()), S.shape[-1])
        own = elements[0]
        mark = own.glass.formula, mark_of(own.glass.coefficients, own.profile.pitch, own.radius)
        if mark not in self._forms:
            whole = dataclasses.replace(own, period=None, levels=0)
            self._forms[mark] = ClosedForm((whole,), World(), S)
        return self._forms[mark].transfer(elements)

    def number(self, name: str, make: Callable[[], float]) -> float:
        """A number, made only where it is not kept."""
        file = self.folder / f"{name}.json"
        if not file.exists():
            write_json(file, make())
        return read_document(file, number(infinite=True), DamagedRun, "remove it to find it anew")

    def find(self, name: str, world: World, make: Callable[[], Tensor]) -> dict[str, Errors]:
        """Errors by content of transfer functions, made only where they are not kept."""
        file = self.folder / f"{name}.npz"
        if not file.exists():
            H = make()
            found = {bank.name: errors_of(H, world, bank) for bank in self.banks}
            arrays = {f"{one}/{filter}": e.numpy() for one, own in found.items() for filter, e in own.items()}
            packed = io.BytesIO()
            np.savez(packed, **arrays)
            write_atomically(file, lambda stream: stream.write(packed.getvalue()))
        with np.load(file) as read:
            return {
                bank.name: {filter: torch.as_tensor(read[f"{bank.name}/{filter}"]) for filter in FILTERS}
                for bank in self.banks
            }


def judge_baselines(
    rows: Sequence[str], settings: Settings, banks: Sequence[Bank], kept: Kept
) -> dict[tuple[str, float], dict[str, Errors]]:
    """Errors by row and noise."""
    size, found = banks[0].spectrum.shape[-1], {}
    cubic = any(row.startswith("cubic") for row in rows)
    strengths = best_strengths(settings.noise, banks[0].spectrum) if cubic else {}
    for row, elements, noises in progress(list(cases(rows, settings.noise, strengths)), "baseline"):
        made: list[Tensor] = []

        def H(made=made, elements=elements) -> Tensor:
            if not made:
                made.append(transfer(kernels(elements, World()), size))
            return made[0]

        for own in noises:
            world = dataclasses.replace(World(), noise=own)
            found[row, own] = kept.find(f"{row}-{own:g}", world, H)
    return found


def elements_in(files: Sequence[str]) -> dict[str, Element]:
    """Elements in files, of heights or smooth, by the name that they have in tables: of the file without its suffix.

    Raises CommandError for two of one name, or one of the name of a row.
    """
    by: dict[str, str] = {}
    for file in files:
        name = Path(file).stem
        if name in ROWS:
            raise CommandError(f"--elements {file}: {name} is the row {ROWS[name].title!r}; give the file another name")
        if name in by:
            raise CommandError(f"--elements {by[name]} {file}: both would be {name}; give one of them another name")
        by[name] = file
    return {name: read_element(file, aperture=2 * World().radius) for name, file in by.items()}


def judge_files(
    elements: Mapping[str, Element], settings: Settings, kept: Kept
) -> dict[tuple[str, float], dict[str, Errors]]:
    """Errors of elements in files, by name and noise."""
    found = {}
    for name, element in elements.items():
        mark, H = mark_of_elements([element]), functools.cache(lambda element=element: kept.transfer((element,)))
        for own in settings.noise:
            world = dataclasses.replace(World(), noise=own)
            found[name, own] = kept.find(f"file-{mark}-{own:g}", world, H)
    return found


def _best_learned(
    todo: Sequence[Unit],
    learned: Mapping[Unit, tuple[float, dict[str, Errors]]],
    settings: Settings,
    train: Pictures,
    root: Path,
) -> dict[str, Element]:
    """Of every row and noise the element that is kept, rings as they are made, by the name of its file."""
    best: dict[tuple[str, float], Unit] = {}
    for unit in todo:
        other = best.get((unit.row, unit.noise))
        one_element = ROWS[unit.row].learning["kind"] != "zernike"
        if one_element and (other is None or learned[unit][0] < learned[other][0]):
            best[unit.row, unit.noise] = unit
    found = {}
    for (row, own), unit in best.items():
        element = detached(learn_unit(unit, settings, train, root).variables()[0])
        name, made = (".npy", fabricated(element)) if is_flat(element) else (SMOOTH, element)
        found[f"{row}-{own:g}{name}"] = made
    return found


def judge_learned(
    unit: Unit, settings: Settings, train: Pictures, root: Path, kept: Kept
) -> tuple[float, dict[str, Errors]]:
    """Its expected error, that of learning, and errors of pictures."""
    name = f"{unit.row}-{unit.noise:g}-{unit.start}"
    camera = learn_unit(unit, settings, train, root)
    with torch.no_grad():
        elements = detached(camera.variables())
        found = kept.find(name, unit.world(), lambda: kept.transfer(elements))
        return kept.number(name, lambda: float(camera.expected(elements))), found


def scores(
    fixed: Mapping[tuple[str, float], dict[str, Errors]],
    learned: Mapping[Unit, tuple[float, dict[str, Errors]]],
    banks: Sequence[Bank],
    settings: Settings,
) -> Iterator[Score]:
    """Of every bank, filter, row and noise, from errors by content of baselines, by row and noise, and of learned
    elements beside what each is expected to leave."""
    by: dict[tuple[str, float], list] = {}
    for unit, own in learned.items():
        by.setdefault((unit.row, unit.noise), []).append(own)
    for bank in banks:
        weights = bank.drawn(seed=settings.seed)
        for filter in FILTERS:
            base = {own: fixed["fresnel", own][bank.name][filter] for own in settings.noise}
            for (row, own), errors in [*fixed.items(), *by.items()]:
                several = isinstance(errors, list)
                ordered = [e for _, e in sorted(errors, key=lambda one: one[0])] if several else [errors]
                given = [each[bank.name][filter] for each in ordered]
                starts = tuple(float(pooled_psnr(e) - pooled_psnr(base[own])) for e in given) if several else ()
                yield Score(bank.name, filter, own, row, Gains.of(given[0], base[own], weights), starts)


# --- the page


def publish_elements(elements: Mapping[str, Element], docs: Path) -> None:
    """Elements by file name, in `wave/elements` beside the page, to be judged again by anyone."""
    beside = docs / "wave" / "elements"
    beside.mkdir(parents=True, exist_ok=True)
    for name, element in elements.items():
        write_element(element, beside / name, design_wavelength=WAVELENGTH)


def element_words(arguments: argparse.Namespace) -> list[str]:
    """--elements as they were given."""
    files = [published(file, arguments.docs) for file in arguments.elements]
    return [f"--elements {' '.join(files)}"] if files else []


def _publish(
    found: OverNoise, elements: Mapping[str, Element], settings: Settings, arguments: argparse.Namespace
) -> None:
    publish_elements(elements, Path(arguments.docs))
    records = [score.record() for score in found.scores]
    tables = {"noise.csv": table(records, floats=lambda number: round(number, 4))}
    words = [f"--rows {' '.join(arguments.rows)}"] if arguments.rows else []
    words += element_words(arguments)
    words += [*picture_words(arguments, LIMIT), *settings.words()]
    command = " ".join(["raytrace wave noise", *words, "-o FOLDER --docs docs"])
    parts = _parts(found, elements, command)
    publish(Path(arguments.docs) / "wave_noise.md", "wave", parts, tables=tables, figures={"noise.png": found.plot()})


def _parts(found: OverNoise, elements: Mapping[str, Element], command: str) -> list[str]:
    """elements: those that were kept, by the name of their file."""
    shown = "pictures" if "pictures" in found.pictures else next(iter(found.pictures))
    others = [name for name in found.pictures if name != shown]
    return [
        "# Extended depth of field over noise",
        f"    {command}",
        "Camera, depths and colours of [wave_edof.md](wave_edof.md). For every noise elements are learned, filters "
        "made and the strength of cubic plates chosen anew; learned elements know only the spectrum of sharp dead "
        "leaves. Of several random starts that of least expected error is kept. PSNR in dB, mean over depths, of "
        "errors pooled over pictures and, the usual one, as the mean of the PSNRs of single pictures; gains are over "
        f"the Fresnel lens on the same pictures, with the {OF_INTERVALS}. Restored: "
        f"{counted(found.pictures, found.classes)}; filters are made for others.",
        *headline(found, shown),
        picture(
            "wave/noise.png",
            f"Gain over the Fresnel lens on {shown}, errors pooled over pictures; bands: 95 % intervals over classes.",
        ),
        *(part for filter in FILTERS for part in _tables(found, shown, filter)),
        *(part for name in others for part in _tables(found, name, "wiener", only_gain=True)),
        "All figures: [noise.csv](wave/noise.csv).",
        *([heights_of({Path(name).stem: one for name, one in elements.items()})] if elements else []),
        *_again(found, list(elements)),
    ]


def counted(pictures: Mapping[str, int], classes: Mapping[str, int]) -> str:
    """How many pictures are restored, by content, and of how many classes where these are not single pictures."""

    def of_classes(name: str) -> str:
        several = classes.get(name, pictures[name])
        return "" if several == pictures[name] else f" of {several} classes"

    return ", ".join(f"{count} of {name}{of_classes(name)}" for name, count in pictures.items())


def _again(found: OverNoise, files: Sequence[str]) -> Iterable[str]:
    """The command that judges what was kept at one noise, that of the table if it was asked for."""
    if not files:
        return
    noises = {one.noise for one in found.scores}
    noise = World.noise if World.noise in noises else min(noises)
    own = [f"docs/wave/elements/{name}" for name in files if Path(name).stem.endswith(f"-{noise:g}")]
    yield (
        "Elements that were kept stand in [wave/elements](wave/elements), to be judged again, on dead leaves or on "
        "pictures of one's own:"
    )
    yield f"    raytrace wave noise --rows fresnel --elements {' '.join(own)} --noises {noise:g}"


def _tables(found: OverNoise, content: str, filter: str, *, only_gain: bool = False) -> Iterable[str]:
    yield f"## {content[0].upper()}{content[1:]}, {TITLES[filter]}"
    for mean, shown in MEANS.items():
        yield f"Gain over the Fresnel lens, dB, {mean}:"
        yield grid(*found.lines(content, filter, lambda one, shown=shown: shown(one.gains)[1]))
    if only_gain:
        return
    for mean, shown in MEANS.items():
        yield f"PSNR, dB, {mean}:"
        yield grid(*found.lines(content, filter, lambda one, shown=shown: shown(one.gains)[0]))
    started = {row: own for row, own in found.of(content, filter).items() if any(one.starts for one in own.values())}
    if started:
        yield "Gain of every random start, errors pooled over pictures, from the least to the greatest:"
        header, _ = found.lines(content, filter, str)
        yield grid(
            header,
            (
                [title_of(row), *(f"{min(one.starts):+.2f} … {max(one.starts):+.2f}" for one in own.values())]
                for row, own in started.items()
            ),
        )


def headline(found: OverNoise, content: str) -> Iterable[str]:
    """The learned rings in the terms of Sitzmann et al., noise by noise, beside what they report."""
    own = found.of(content, "wiener").get("learned", {})
    if not own:
        return
    yield (
        f"## Learned rings on {content} behind the Wiener filter, the terms of Sitzmann et al. (2018): "
        f"they report {_PUBLISHED:+.2f} dB"
    )
    verdicts = [
        [f"{noise:g}", *(cell for gain in (one.gains.pooled, one.gains.mean) for cell in (str(gain), _verdict(gain)))]
        for noise, one in sorted(own.items())
    ]
    compared = f"compared with {_PUBLISHED:+.2f} dB"
    yield grid(("noise", "gain, dB, pooled", compared, "gain, dB, mean of PSNRs", compared), verdicts)


def _verdict(gain: Interval) -> str:
    return "more" if gain.low > _PUBLISHED else "less" if gain.high < _PUBLISHED else "within the interval"

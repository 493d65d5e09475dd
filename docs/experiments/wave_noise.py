"""Extended depth of field over noise: elements designed and filters made for each, judged on many pictures.

    python docs/experiments/wave_noise.py --data DIR --limit 400 -o FOLDER --docs docs

    e = ⟨P |1 - G H|²⟩ + σ² ⟨|G|²⟩       P: the power of one picture; ⟨·⟩ over frequencies: the mean over noise, undrawn

Two means over pictures are in use, and differ by about 1 dB:

    pooled: 10 log₁₀(1/⟨e⟩)         the mean of the errors: the pictures that are restored worst decide
    mean:   ⟨10 log₁₀(1/e)⟩         the mean of the PSNRs of single pictures: the usual one

Intervals are of samples of pictures drawn with replacement (bootstrap; Efron and Tibshirani, 1993). Pictures of one
class are alike, so that whole classes are drawn. Gains are paired: both elements on the same pictures.
"""

import argparse
import dataclasses
import functools
import hashlib
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from experiments import Store, cases, publish, published
from matplotlib.figure import Figure
from pages import grid, picture
from torch import Tensor
from wave_edof import ROWS, STRENGTHS, contents_of, look, title_of

from raytrace.cli.options import json, output_folder
from raytrace.cli.progress import progress
from raytrace.cli.runner import CommandError, present
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
from raytrace.cli.types import file_name
from raytrace.cli.wave_design import LIMIT, PICTURES
from raytrace.cli.wave_run import learn
from raytrace.files import table
from raytrace.imaging.camera import Camera
from raytrace.imaging.pictures import Pictures, draws
from raytrace.imaging.restoration import (
    depth_invariant_error,
    depth_invariant_wiener,
    errors,
    power_spectrum,
    psnr,
    wiener,
)
from raytrace.imaging.variables import PhaseVariables
from raytrace.imaging.wave_camera import FILTERS, WaveCameraConfig, best_gamma, transfer
from raytrace.imaging.wave_design import Design
from raytrace.maths.numerics import detached
from raytrace.maths.result import Result
from raytrace.plotting.style import FIELD_COLOURS, GREY, INK, new_figure, styled
from raytrace.settings import DesignSettings
from raytrace.settings import Settings as BaseSettings
from raytrace.wave_optics.compute import DESIGN
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element, Rings, is_flat
from raytrace.wave_optics.element_files import SMOOTH, read_element, write_element
from raytrace.wave_optics.fabrication import fabricated
from raytrace.words import did_you_mean


@dataclasses.dataclass(frozen=True)
class Settings(BaseSettings):
    """seed: of dead leaves, and of the samples of pictures for intervals; starts have seeds of their own."""

    noise: tuple[float, ...] = (0.001, 0.002, 0.005, 0.01, 0.02)
    starts: int = 5
    steps: int = 300


ROWS_OF_SETTINGS = {
    "noise": option("standard deviations (default 0.001 0.002 0.005 0.01 0.02)", "S", name="noises"),
    "starts": option("random starts of every designed element"),
    "steps": option("of the optimiser"),
    "seed": SEED,
}

_STEPS_OF_SMOOTH = 60
_DRAWS = 2000  # of the pictures
_BOOTSTRAP = 25  # last number of the key of a draw


@dataclasses.dataclass(frozen=True)
class Unit:
    """One element to be learned: a row of the table, for one noise, from one random start."""

    row: str
    noise: float
    start: int

    def settings(self, steps: int) -> DesignSettings:
        learning = ROWS[self.row].learning
        # What has seven numbers is found by the search for its start.
        steps = min(steps, _STEPS_OF_SMOOTH) if learning["kind"] == "smooth" else steps
        more = {"seed": self.start, "starts": 1, "steps": steps, "noise": (self.noise, self.noise)}
        return DesignSettings.of({}, **learning, **more)

    def config(self) -> WaveCameraConfig:
        return dataclasses.replace(WaveCameraConfig(), noise=self.noise)

    def folder(self, root: Path) -> Path:
        return root / f"noise-{self.noise:g}" / self.row / f"start-{self.start}"


def units(rows: Sequence[str], noises: Sequence[float], starts: int) -> Iterator[Unit]:
    """All that is learned; every noise and row once before any of them a second time."""
    learned = [row for row in rows if ROWS[row].learning]
    return (Unit(**case) for case in cases(start=range(starts), noise=noises, row=learned))


# --- what an element is worth on many pictures


def mark_of(*values: Tensor) -> str:
    """A hash of all their numbers."""
    found = hashlib.blake2b(digest_size=8)
    for own in values:
        found.update(f"{tuple(own.shape)}".encode())
        found.update(own.detach().contiguous().numpy())
    return found.hexdigest()


def mark_of_elements(elements: Sequence[Element]) -> str:
    """A hash of all that decides what they do to light: numbers, kind and size of the profile, the glass."""
    found = hashlib.blake2b(digest_size=8)
    for element in elements:
        profile, glass, period = element.profile, element.glass, element.period
        numbers = [getattr(profile, field.name) for field in dataclasses.fields(profile)]
        numbers += [element.radius, glass.coefficients, *([] if period is None else [period])]
        found.update(f"{type(profile).__name__} {element.levels} {glass.formula} {mark_of(*numbers)}".encode())
    return found.hexdigest()


@dataclasses.dataclass(frozen=True)
class Bank:
    """A content's pictures: S (n, n) of those that filters are made for, P (B, n, n) the power of each restored one.

    classes: of each restored one; by default each is a class of its own.
    """

    name: str
    spectrum: Tensor
    powers: Tensor
    classes: tuple[str, ...] = ()

    @property
    def mark(self) -> str:
        """What it is known by: of filters' pictures and of restored ones."""
        return mark_of(self.spectrum, self.powers)

    @classmethod
    def of(cls, name: str, train: Tensor, test: Tensor, classes: Sequence[str] = ()) -> "Bank":
        """Periodic pictures (A, n, n) to make filters for, (B, n, n) to restore, and the classes of the latter."""
        powers = power_spectrum(test[None], window="none")
        return cls(name, power_spectrum(train, window="none"), powers, tuple(classes))

    @property
    def class_count(self) -> int:
        return len(set(self.classes)) or len(self.powers)

    def drawn(self, *, seed: int = 0) -> Tensor:
        """`drawn` of the restored pictures."""
        return drawn(self.classes or range(len(self.powers)), seed=seed)


#: Errors (B, D, W) of every picture, by filter.
Errors = dict[str, Tensor]


@torch.no_grad()
def errors_of(H: Tensor, config: WaveCameraConfig, bank: Bank) -> Errors:
    """Of each picture at every depth in every colour, expected over noise, of transfer functions H (D, W, n, n)."""
    at_design = H[config.depths.index(config.design)]
    gamma = best_gamma(H, bank.spectrum, config.noise, at_design)
    filters = {"wiener": wiener(at_design, gamma), "blind": depth_invariant_wiener(H, bank.spectrum, config.noise)}
    powers = bank.powers[:, None, None]
    return {name: errors(H, powers, config.noise, filter=G) for name, G in filters.items()}


def pooled_psnr(errors: Tensor, weights: Tensor | None = None) -> Tensor:
    """PSNR (R,) in dB of the mean error over pictures and colours, mean over depths; errors: (B, D, W).

    weights: (R, B) of the pictures, by default once each.
    """
    return psnr(_shares(errors, weights) @ errors.mean(-1)).mean(-1)


def mean_psnr(errors: Tensor, weights: Tensor | None = None) -> Tensor:
    """PSNR (R,) in dB of each picture at each depth, mean over pictures and depths; arguments: of `pooled_psnr`."""
    return (_shares(errors, weights) @ psnr(errors.mean(-1))).mean(-1)


def _shares(errors: Tensor, weights: Tensor | None) -> Tensor:
    weights = errors.new_ones(1, len(errors)) if weights is None else weights
    return weights / weights.sum(1, keepdim=True)


def drawn(classes: Sequence, *, draws_of: int = _DRAWS, seed: int = 0) -> Tensor:
    """How often (R, B) each picture occurs in samples of as many classes, drawn with replacement.

    classes: (B,) of each picture.
    """
    order = sorted(set(classes))
    count, place = len(order), [order.index(own) for own in classes]
    random = draws(seed, count, _BOOTSTRAP)
    times = random.multinomial(count, np.full(count, 1 / count), draws_of).astype(np.float64)
    return torch.as_tensor(times)[:, place]


@dataclasses.dataclass(frozen=True)
class Interval:
    """A number, and where it lies in 95 of 100 samples of classes of pictures."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:+.2f} ({self.low:+.2f} … {self.high:+.2f})"

    def record(self, name: str) -> dict[str, float]:
        """Columns NAME, NAME_low, NAME_high."""
        return {name: self.value, f"{name}_low": self.low, f"{name}_high": self.high}


def gain(
    errors: Tensor, base: Tensor, weights: Tensor, *, mean: Callable[[Tensor, Tensor | None], Tensor] = pooled_psnr
) -> Interval:
    """PSNR of errors (B, D, W) over that of others, of the same pictures; mean: over pictures, by which of the two."""
    between = (mean(errors, weights) - mean(base, weights)).quantile(weights.new_tensor([0.025, 0.975]))
    return Interval(float(mean(errors, None) - mean(base, None)), *between.tolist())


@dataclasses.dataclass(frozen=True)
class Gains:
    """PSNR in dB of an element and its gain over another: of errors pooled over pictures, and as the mean of the PSNRs
    of single pictures."""

    pooled_psnr: float
    pooled: Interval
    mean_psnr: float
    mean: Interval

    @classmethod
    def of(cls, errors: Tensor, base: Tensor, weights: Tensor) -> "Gains":
        """Of errors (B, D, W) and those of the other element of the same pictures; weights: of `drawn`."""
        both = ((float(mean(errors)), gain(errors, base, weights, mean=mean)) for mean in (pooled_psnr, mean_psnr))
        return cls(*(one for pair in both for one in pair))


# --- baselines


def baselines(
    rows: Sequence[str], noises: Sequence[float], strengths: Mapping[float, float]
) -> Iterator[tuple[str, tuple[Element, ...], list[float]]]:
    """Baselines of the rows, and the noises that each is for; strengths: of cubic plates, by noise."""
    config = WaveCameraConfig()
    made_for = aim(radius=config.radius, sensor=config.sensor_distance, focus=config.design, exact=config.exact)
    for row in rows:
        if ROWS[row].learning:
            continue
        if not row.startswith("cubic"):
            yield row, baseline(row, made_for), list(noises)
            continue
        for strength in sorted(set(strengths.values())):
            own = [noise for noise in noises if strengths[noise] == strength]
            yield row, baseline(row, made_for, strength=strength), own


@torch.no_grad()
def best_strengths(noises: Sequence[float], S: Tensor) -> dict[float, float]:
    """The strength of cubic plates on the PMMA lens that is best for pictures of spectrum S (n, n), by noise."""
    config = WaveCameraConfig()
    made_for = aim(radius=config.radius, sensor=config.sensor_distance, focus=config.design, exact=config.exact)
    found = {}
    for strength in STRENGTHS:
        camera = config.camera(baseline("cubic-refractive", made_for, strength=strength))
        H = transfer(camera, S.shape[-1], config.depths)
        found[strength] = {noise: float(depth_invariant_error(H, S, noise).mean()) for noise in noises}
    return {noise: min(STRENGTHS, key=lambda own: found[own][noise]) for noise in noises}


# -- results -----------------------------------------------------------------------------------------------------------

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

    def document(self) -> dict:
        return {"pictures": self.pictures, "rows": [score.record() for score in self.scores]}

    def of(self, content: str, filter: str) -> dict[str, dict[float, Score]]:
        """Scores by row and noise."""
        found: dict[str, dict[float, Score]] = {}
        for one in self.scores:
            if (one.content, one.filter) == (content, filter):
                found.setdefault(one.row, {})[one.noise] = one
        return found

    def lines(
        self, content: str, filter: str, cell: Callable[[Score], str], noises: Sequence[float] = ()
    ) -> tuple[list[str], list[list[str]]]:
        """Header and a line for each row, a column for each noise (default: all)."""
        found = self.of(content, filter)
        noises = noises or sorted({noise for row in found.values() for noise in row})
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


def learn_unit(unit: Unit, settings: Settings, train: Pictures, root: Path) -> tuple[Design, Camera, Camera]:
    """The design of a unit, its initial camera and the one that is learned as far as is left."""
    label = f"{ROWS[unit.row].title}, noise {unit.noise:g}, start {unit.start}"
    return learn(unit.settings(settings.steps), unit.config(), train, unit.folder(root), label)


class Kept:
    """Errors of every picture, stored in a folder: computed once for these pictures."""

    def __init__(self, folder: Path, banks: Sequence[Bank]):
        self.banks, self._cameras = banks, {}
        self.store = Store(folder, {"pictures": {bank.name: bank.mark for bank in banks}})

    def transfer(self, elements: Sequence[Element]) -> Tensor:
        """H (D, W, n, n) of designed elements at any noise; the part that heights of rings do not change is cached."""
        config, size = WaveCameraConfig(), self.banks[0].spectrum.shape[-1]
        own, *others = elements
        if others or not isinstance(own.profile, Rings):
            return transfer(config.camera(elements), size, config.depths)
        # One sampling and its sums for rings of all heights: those of the first one, without wraps.
        mark = own.glass.formula, mark_of(own.glass.coefficients, own.profile.pitch, own.radius)
        if mark not in self._cameras:
            self._cameras[mark] = config.camera((dataclasses.replace(own, period=None, levels=0),))
            self._cameras[mark].plan(config.depths)
        camera = self._cameras[mark]
        camera.variables = PhaseVariables(own).requires_grad_(False)
        return transfer(camera, size, config.depths)

    def find(self, name: str, config: WaveCameraConfig, make: Callable[[], Tensor]) -> dict[str, Errors]:
        """Errors by content of transfer functions, computed only if they are not stored."""

        def arrays() -> dict[str, np.ndarray]:
            H = make()
            found = {bank.name: errors_of(H, config, bank) for bank in self.banks}
            return {f"{content}/{filter}": e.numpy() for content, own in found.items() for filter, e in own.items()}

        stored = self.store.arrays(name, arrays)
        return {
            bank.name: {filter: torch.as_tensor(stored[f"{bank.name}/{filter}"]) for filter in FILTERS}
            for bank in self.banks
        }


def judge_baselines(
    rows: Sequence[str], settings: Settings, banks: Sequence[Bank], kept: Kept
) -> dict[tuple[str, float], dict[str, Errors]]:
    """Errors by row and noise."""
    size, found = banks[0].spectrum.shape[-1], {}
    cubic = any(row.startswith("cubic") for row in rows)
    strengths = best_strengths(settings.noise, banks[0].spectrum) if cubic else {}
    for row, elements, noises in progress(list(baselines(rows, settings.noise, strengths)), "baseline"):
        made: list[Tensor] = []

        def H(made=made, elements=elements) -> Tensor:
            if not made:
                config = WaveCameraConfig()
                made.append(transfer(config.camera(elements), size, config.depths))
            return made[0]

        for own in noises:
            config = dataclasses.replace(WaveCameraConfig(), noise=own)
            found[row, own] = kept.find(f"{row}-{own:g}", config, H)
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
    return {name: read_element(file, aperture=2 * WaveCameraConfig().radius) for name, file in by.items()}


def judge_files(
    elements: Mapping[str, Element], settings: Settings, kept: Kept
) -> dict[tuple[str, float], dict[str, Errors]]:
    """Errors of elements in files, by name and noise."""
    found = {}
    for name, element in elements.items():
        mark, H = mark_of_elements([element]), functools.cache(lambda element=element: kept.transfer((element,)))
        for own in settings.noise:
            config = dataclasses.replace(WaveCameraConfig(), noise=own)
            found[name, own] = kept.find(f"file-{mark}-{own:g}", config, H)
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
        element = detached(learn_unit(unit, settings, train, root)[-1].elements()[0])
        name, made = (".npy", fabricated(element)) if is_flat(element) else (SMOOTH, element)
        found[f"{row}-{own:g}{name}"] = made
    return found


def judge_learned(
    unit: Unit, settings: Settings, train: Pictures, root: Path, kept: Kept
) -> tuple[float, dict[str, Errors]]:
    """Its expected error, that of learning, and errors of pictures."""
    name = f"{unit.row}-{unit.noise:g}-{unit.start}"
    design, _, camera = learn_unit(unit, settings, train, root)
    with torch.no_grad():
        elements = detached(camera.elements())
        found = kept.find(name, unit.config(), lambda: kept.transfer(elements))
        return kept.store.number(name, lambda: design.expected_error(camera)), found


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
            for (row, own), stored in [*fixed.items(), *by.items()]:
                several = isinstance(stored, list)
                ordered = [e for _, e in sorted(stored, key=lambda one: one[0])] if several else [stored]
                given = [each[bank.name][filter] for each in ordered]
                starts = tuple(float(pooled_psnr(e) - pooled_psnr(base[own])) for e in given) if several else ()
                yield Score(bank.name, filter, own, row, Gains.of(given[0], base[own], weights), starts)


# --- the page


def publish_elements(elements: Mapping[str, Element], docs: Path) -> None:
    """Elements by file name, in `wave/elements` beside the page, to be judged again by anyone."""
    beside = docs / "wave" / "elements"
    beside.mkdir(parents=True, exist_ok=True)
    for name, element in elements.items():
        write_element(element, beside / name, design_wavelength=DESIGN)


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
    given = [f"--rows {' '.join(arguments.rows)}"] if arguments.rows else []
    given += element_words(arguments)
    given += [*picture_words(arguments, LIMIT), *words(settings, ROWS_OF_SETTINGS)]
    command = " ".join(["python docs/experiments/wave_noise.py", *given, "-o FOLDER --docs docs"])
    figures = {"noise.png": noise_figure(found), "gain.png": gain_figure(found, _noise_of(found))}
    parts = _parts(found, elements, command)
    publish(Path(arguments.docs) / "wave_noise.md", "wave", parts, tables=tables, figures=figures)


def _noise_of(found: OverNoise) -> float:
    """The noise that is shown alone: that of the table of wave_edof.py if it is there."""
    noises = {one.noise for one in found.scores}
    return WaveCameraConfig.noise if WaveCameraConfig.noise in noises else min(noises)


def _parts(found: OverNoise, elements: Mapping[str, Element], command: str) -> list[str]:
    """elements: those that were kept, by the name of their file."""
    shown = _first(found)
    return [
        "# Extended depth of field over noise",
        *headline(found, shown),
        f"    {command}",
        "Camera, depths and wavelengths of [wave_edof.md](wave_edof.md). For every noise the elements are learned, the "
        "filters made and the strength of the cubic plates chosen again; learned elements know only the spectrum of "
        "sharp dead leaves. Of several random starts the one with the least expected error is kept. PSNR in dB, mean "
        "over depths. Gains are over the Fresnel lens on the same pictures, of errors pooled over pictures or as mean "
        f"of the PSNRs of single pictures, with the {OF_INTERVALS}. Restored: "
        f"{counted(found.pictures, found.classes)}; filters are made for others.",
        picture("wave/noise.png", f"Gain on {shown}, errors pooled over pictures; bands: 95 % intervals over classes."),
        picture("wave/gain.png", f"Gain at noise {_noise_of(found):g}; bars: 95 % intervals over classes."),
        *_table(found, shown, "wiener"),
        "All noises, contents and filters, both means, PSNR and the range of the random starts: "
        "[noise.csv](wave/noise.csv).",
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
    noise = _noise_of(found)
    own = [f"docs/wave/elements/{name}" for name in files if Path(name).stem.endswith(f"-{noise:g}")]
    yield "The kept elements are in `docs/wave/elements`; to evaluate them on dead leaves or on your own pictures:"
    yield f"    python docs/experiments/wave_noise.py --rows fresnel --elements {' '.join(own)} --noises {noise:g}"


def _table(found: OverNoise, content: str, filter: str) -> Iterable[str]:
    yield f"## {content[0].upper()}{content[1:]}, {TITLES[filter]}"
    yield "Gain over the Fresnel lens, dB, errors pooled over pictures:"
    noises = sorted({one.noise for one in found.scores})
    header, lines = found.lines(
        content, filter, lambda one: str(one.gains.pooled), sorted({noises[0], _noise_of(found), noises[-1]})
    )
    yield grid(header, [line for line in lines if line[0] != ROWS["fresnel"].title])


def headline(found: OverNoise, content: str) -> Iterable[str]:
    """Gain of the learned rings, noise by noise, compared with the gain that Sitzmann et al. report."""
    own = found.of(content, "wiener").get("learned", {})
    if not own:
        return
    yield (
        f"Learned rings on {content} behind the Wiener filter of the PSF at 1 m, compared with the "
        f"{_PUBLISHED:+.2f} dB that Sitzmann et al. (2018) report:"
    )
    verdicts = [
        [f"{noise:g}", *(cell for gain in (one.gains.pooled, one.gains.mean) for cell in (str(gain), _verdict(gain)))]
        for noise, one in sorted(own.items())
    ]
    compared = f"than {_PUBLISHED:+.2f} dB"
    yield grid(("noise", "gain, dB, pooled", compared, "gain, dB, mean of PSNRs", compared), verdicts)


def _verdict(gain: Interval) -> str:
    return "more" if gain.low > _PUBLISHED else "less" if gain.high < _PUBLISHED else "equal within the interval"


#: Panels of the figure over noise, by filter.
NOISE_TITLES = {"wiener": "Wiener filter, 1 m", "blind": "depth-invariant filter"}


_LABELLED = ("hybrid", "ideal", "cubic-refractive", "learned-smooth", "learned", "learned-16")


@styled
def noise_figure(found) -> Figure:
    """Gain over the Fresnel lens over noise, a panel for each filter, intervals as bands; found: an `OverNoise`.

    Baselines outside `_LABELLED` are thin grey lines; the published gain is drawn for the filter it refers to.
    """
    content = _first(found)
    figure = new_figure(9.2, 3.9)
    axes = figure.subplots(1, len(NOISE_TITLES), sharey=True)
    for panel, (filter, title) in zip(axes, NOISE_TITLES.items(), strict=True):
        rows = {row: own for row, own in found.of(content, filter).items() if row != "fresnel"}
        others = [row for row in rows if row in ROWS and row not in _LABELLED]
        labelled = [row for row in rows if row not in others]
        for row, own in rows.items():
            noises = sorted(own)
            gains = [own[noise].gains.pooled for noise in noises]
            if row in others:
                label = "other baselines" if row == others[0] else None
                panel.plot(noises, [one.value for one in gains], color=GREY, lw=0.7, alpha=0.6, label=label)
                continue
            style = look(row, labelled)
            panel.plot(noises, [one.value for one in gains], label=title_of(row), **style)
            low, high = ([getattr(one, end) for one in gains] for end in ("low", "high"))
            panel.fill_between(noises, low, high, color=style["color"], alpha=0.13, lw=0)
        if filter == "wiener":
            panel.axhline(_PUBLISHED, color=INK, lw=0.8, ls=(0, (1, 2)))
            panel.annotate("Sitzmann 2018", (1, _PUBLISHED), (-2, 2), xycoords=("axes fraction", "data"),
                           textcoords="offset points", ha="right", fontsize=7)  # fmt: skip
        panel.set(xscale="log", xlabel="noise, standard deviation", title=f"{content}, {title}")
        panel.set_xticks(noises, [f"{noise:g}" for noise in noises])
        panel.minorticks_off()
    axes[0].set_ylabel("gain over the Fresnel lens (dB)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=7.5)
    return figure


@styled
def gain_figure(found, noise: float) -> Figure:
    """Gains over the Fresnel lens at one noise with intervals, a panel for each content; found: an `OverNoise`."""
    rows = [row for row in found.of(_first(found), "wiener") if row != "fresnel"]
    place = np.arange(len(rows))[::-1]
    figure = new_figure(9.2, 0.36 * len(rows) + 1.1)
    axes = figure.subplots(1, len(found.pictures), sharey=True, squeeze=False)[0]
    for panel, content in zip(axes, sorted(found.pictures, key=lambda name: name != _first(found)), strict=True):
        for filter, shift, colour in (("wiener", 0.17, FIELD_COLOURS[0]), ("blind", -0.17, FIELD_COLOURS[2])):
            gains = [found.of(content, filter)[row][noise].gains.pooled for row in rows]
            ends = [[one.value - one.low for one in gains], [one.high - one.value for one in gains]]
            panel.errorbar([one.value for one in gains], place + shift, xerr=ends, fmt="os"[filter == "blind"],
                           ms=4, color=colour, elinewidth=1.2, label=NOISE_TITLES[filter])  # fmt: skip
        if content == _first(found):
            marks = [(ROWS[row].published - ROWS["fresnel"].published, y + 0.17)
                     for row, y in zip(rows, place, strict=True) if row in ROWS and ROWS[row].published]  # fmt: skip
            if marks:
                panel.plot(*zip(*marks, strict=True), "|", ms=9, mew=2, color=INK, label="Sitzmann 2018 (Wiener)")
        panel.axvline(0, color=GREY, lw=0.8)
        panel.set(title=content, xlabel="gain (dB)", ylim=(-0.6, len(rows) - 0.4))
        panel.grid(True, axis="x", lw=0.4)
    axes[0].set_yticks(place, [title_of(row) for row in rows])
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3, fontsize=7.5)
    return figure


def _first(found) -> str:
    """The content that page and figures show: pictures, if there are any."""
    return "pictures" if "pictures" in found.pictures else next(iter(found.pictures))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rows", metavar="ROW", nargs="+", help="only these of wave_edof.py (default: all but --also)")
    parser.add_argument(
        "--elements",
        metavar="FILE",
        nargs="+",
        type=file_name,
        default=(),
        help="further elements in files, heights of rings or smooth, as those of docs/wave/elements",
    )
    defaults = defaults_of(Settings)
    add_options(parser, defaults, ROWS_OF_SETTINGS, "noise", "starts", "steps")
    add_options(picture_options(parser, PICTURES, limit=LIMIT), defaults, ROWS_OF_SETTINGS, "seed")
    output_folder("folder of designed elements and their errors")(parser)
    documents(parser, "wave_noise.md and wave/")
    json(parser)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args(argv)
    present(noise(arguments), arguments)


if __name__ == "__main__":
    sys.exit(main())

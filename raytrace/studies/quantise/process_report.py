"""What `raytrace wave etch` finds: as text, as a document, as a page."""

import argparse
import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path

import torch

from raytrace.cli.progress import progress
from raytrace.files import table
from raytrace.imaging.restoration import psnr
from raytrace.imaging.training import Run
from raytrace.maths.result import Result
from raytrace.maths.value import detached
from raytrace.pages import grid, picture
from raytrace.studies.edof.command import LIMIT
from raytrace.studies.edof.noise import Bank, Errors, Gains, pooled_psnr
from raytrace.studies.edof.noise_command import Settings as Noise
from raytrace.studies.edof.noise_report import (
    TITLES,
    Kept,
    judge_baselines,
    judge_learned,
    learn_unit,
    publish_elements,
)
from raytrace.studies.edof.report import contents_of
from raytrace.studies.edof.world import FILTERS, ClosedForm, World, periodic, spectrum
from raytrace.studies.options import picture_words
from raytrace.studies.pictures import Pictures, digest
from raytrace.studies.publish import publish
from raytrace.studies.quantise.process import Case, cases, etch_rings, under_errors
from raytrace.studies.quantise.process_command import Settings
from raytrace.wave_optics.designs import aim, baseline
from raytrace.wave_optics.element import Element
from raytrace.wave_optics.element_files import read_element, write_element
from raytrace.wave_optics.etching import Process, relief

BASES = {"fresnel": "Fresnel lens", "hybrid": "hybrid achromat"}


@dataclasses.dataclass(frozen=True)
class Etched:
    """An element behind one filter on one content: PSNR in dB, its gains over the baselines by name.

    levels, waves: of its process, 0 of its model in whole heights; relief: mm; starts: gains of all starts over the
    Fresnel lens, that of least expected error first; lost: dB of its expected error by errors of height, mean of draws.
    """

    content: str
    filter: str
    noise: float
    waves: int
    levels: int
    relief: float
    gains: dict[str, Gains]
    starts: tuple[float, ...]
    lost: float

    def record(self) -> dict:
        own = {name: getattr(self, name) for name in ("content", "filter", "noise", "waves", "levels")}
        first = next(iter(self.gains.values()))
        own |= {"psnr": first.pooled_psnr, "mean_psnr": first.mean_psnr, "lost": self.lost}
        for base, one in self.gains.items():
            own |= one.pooled.record(f"over_{base}") | one.mean.record(f"mean_over_{base}")
        return own | {"least_start": min(self.starts), "greatest_start": max(self.starts), "starts": len(self.starts)}

    @property
    def title(self) -> str:
        if not self.waves:
            return "whole heights, the model"
        return f"{1e3 * self.relief:.2f} µm, {self.levels} levels"


@dataclasses.dataclass(frozen=True)
class Etching(Result):
    """Every process and its model."""

    rows: list[Etched]
    pictures: dict[str, int]
    tolerance: float

    FIGURE = "studies.quantise.figures.etch_figure"

    def document(self) -> dict:
        return {"pictures": self.pictures, "rows": [row.record() for row in self.rows]}

    def lines(self, content: str, filter: str) -> list[tuple[str, ...]]:
        chosen = [one for one in self.rows if (one.content, one.filter) == (content, filter)]
        return [
            (f"{one.noise:g}", one.title, f"{one.gains['fresnel'].pooled_psnr:.2f}",
             *(str(gain.pooled) for gain in one.gains.values()), f"{one.gains['fresnel'].mean_psnr:.2f}",
             *(str(gain.mean) for gain in one.gains.values()),
             f"{min(one.starts):+.2f} … {max(one.starts):+.2f}", f"{one.lost:.2f}")
            for one in chosen
        ]  # fmt: skip

    def __str__(self) -> str:
        text = []
        for content in self.pictures:
            for filter in FILTERS:
                text.append(f"{content}, {TITLES[filter]}: PSNR in dB, gains (95 % interval)")
                text += ["".join(f"{cell:>28}" for cell in line) for line in [_HEADER, *self.lines(content, filter)]]
        return "\n".join(text)


_OVER = tuple(f"over the {name}" for name in BASES.values())
_HEADER = ("noise", "relief, levels", "PSNR, pooled", *_OVER, "mean of PSNRs", *_OVER, "starts, pooled", "lost")


def etch(arguments: argparse.Namespace) -> Etching:
    """Learn what is left, judge everything; the page where --docs asks for it."""
    settings, root = Settings.of(vars(arguments)), Path(arguments.folder)
    contents, train = contents_of(arguments)
    todo = list(cases(settings.waves, settings.levels, settings.noise, settings.starts))
    banks = [Bank.of(content.name, content.train, content.test, content.classes) for content in contents]
    del contents
    kept = Kept(root / "judged", banks)  # refuses other pictures before anything is learned
    elements = {case: etched(case, settings, train, root) for case in progress(todo, "process")}
    names = {"noise": settings.noise, "starts": settings.starts, "steps": settings.learn}
    noise = Noise.of(names | {"seed": settings.seed})
    fixed = judge_baselines(list(BASES), noise, banks, kept)
    found = {case: _judged(case, element, settings, train, kept) for case, element in elements.items()}
    models = {case.model: judge_learned(case.model, noise, train, root, kept) for case in todo}
    rows = _rows(fixed, models, found, banks, settings)
    result = Etching(rows, {one.name: len(one.powers) for one in banks}, settings.tolerance)
    if arguments.docs:
        best = {(case.row, case.noise): case for case in sorted(todo, key=lambda case: found[case][0], reverse=True)}
        made = {f"{row}-{own:g}.npy": elements[case] for (row, own), case in best.items()}
        _publish(result, made, settings, arguments)
    return result


def process_of(case: Case, settings: Settings) -> Process:
    return Process(waves=case.waves, levels=case.levels, tolerance=settings.tolerance)


def etched(case: Case, settings: Settings, train: Pictures, root: Path) -> Element:
    """The element of a case, from its folder, or learned now."""
    folder = case.folder(root)
    asked = {name: getattr(settings, name) for name in ("steps", "moves", "tolerance", "learn")}
    asked |= {"pictures": digest(train.samples)}
    file = Run(folder, asked | dataclasses.asdict(case)).folder / "heights.npy"
    if not file.exists():
        noise = Noise.of({"steps": settings.learn})
        (model,) = detached(learn_unit(case.model, noise, train, root).variables())
        process, expected = process_of(case, settings), _expected(model, case, train)
        given = {"steps": settings.steps, "moves": settings.moves, "seed": case.start}
        found = etch_rings(model, process, expected, **given)
        write_element(found, file, design_wavelength=process.wavelength)
    return read_element(file, aperture=2 * World().radius)


def _expected(like: Element, case: Case, train: Pictures) -> ClosedForm:
    world = case.model.world()
    return ClosedForm((like,), world, spectrum(periodic(train, 256)), dtype=torch.float32)


@torch.no_grad()
def _judged(
    case: Case, element: Element, settings: Settings, train: Pictures, kept: Kept
) -> tuple[float, float, dict[str, Errors]]:
    """Its expected error with errors of height, what those cost in dB, and errors of pictures."""
    name, world = f"{case.row}-{case.noise:g}-{case.start}", case.model.world()
    expected = _expected(element, case, train)
    off = kept.number(
        f"{name}-errors", lambda: float(torch.tensor(under_errors(element, expected, settings.tolerance)).mean())
    )
    still = kept.number(name, lambda: float(expected((element,))))
    lost = float(psnr(torch.tensor(still)) - psnr(torch.tensor(off)))
    return off, lost, kept.find(name, world, lambda: kept.transfer((element,)))


def _rows(
    fixed: Mapping[tuple[str, float], dict[str, Errors]],
    models: Mapping,
    found: Mapping[Case, tuple[float, float, dict[str, Errors]]],
    banks: Sequence[Bank],
    settings: Settings,
) -> list[Etched]:
    several: dict[tuple[float, int, int], list] = {}
    for unit, (error, errors) in models.items():
        several.setdefault((unit.noise, 0, 0), []).append((error, 0.0, errors))
    for case, own in found.items():
        several.setdefault((case.noise, case.waves, case.levels), []).append(own)
    depth = _reliefs(settings)
    rows = []
    for bank in banks:
        weights = bank.drawn(seed=settings.seed)
        for filter in FILTERS:
            for (noise, waves, levels), given in several.items():
                ordered = sorted(given, key=lambda one: one[0])
                base = {name: fixed[name, noise][bank.name][filter] for name in BASES}
                errors = [own[bank.name][filter] for _, _, own in ordered]
                gains = {name: Gains.of(errors[0], own, weights) for name, own in base.items()}
                starts = tuple(float(pooled_psnr(own) - pooled_psnr(base["fresnel"])) for own in errors)
                about = (bank.name, filter, noise, waves, levels, depth.get((waves, levels), 0.0))
                rows.append(Etched(*about, gains, starts, ordered[0][1]))
    return rows


def _reliefs(settings: Settings) -> dict[tuple[int, int], float]:
    """mm by waves and levels."""
    (lens,) = baseline("fresnel", aim())
    return {
        (m, count): float(relief(lens, Process(waves=m, levels=count)))
        for m in settings.waves
        for count in settings.levels
    }


# --- the page


def _publish(
    found: Etching, elements: Mapping[str, Element], settings: Settings, arguments: argparse.Namespace
) -> None:
    publish_elements(elements, Path(arguments.docs))
    words = picture_words(arguments, LIMIT)
    command = " ".join(["raytrace wave etch", *words, *settings.words(), "-o FOLDER --docs docs"])
    tables = {"etch.csv": table([row.record() for row in found.rows], floats=lambda number: round(number, 4))}
    figures = {"etch.png": found.plot()}
    publish(Path(arguments.docs) / "wave_etch.md", "wave", _parts(found, command), tables=tables, figures=figures)


def _parts(found: Etching, command: str) -> list[str]:
    shown = "pictures" if "pictures" in found.pictures else next(iter(found.pictures))
    nm = 1e6 * found.tolerance
    return [
        "# An element one can make",
        f"    {command}",
        "Camera, depths and colours of [wave_edof.md](wave_edof.md), pictures and intervals of "
        "[wave_noise.md](wave_noise.md). Rings of 2 µm of fused silica, a relief below one or two waves of 550 nm, "
        f"its levels, heights that err by up to ± {nm:g} nm drawn anew at every step. The start is the depths nearest "
        "in phase, in all three colours, to rings learned in whole heights; then depths are learned modulo the "
        "relief, and levels move a few rings at a time. Of several starts that of least expected error, errors of "
        "height included, is kept. *Lost*: what those errors cost in expected PSNR, mean of ten draws.",
        picture("wave/etch.png", f"Gain over the Fresnel lens on {shown} by process, with 95 % intervals."),
        *(
            part
            for filter in FILTERS
            for part in (
                f"## {shown[0].upper()}{shown[1:]}, {TITLES[filter]}",
                grid(_HEADER, found.lines(shown, filter)),
            )
        ),
        "All figures: [etch.csv](wave/etch.csv). Heights of what was kept stand in [wave/elements](wave/elements).",
    ]

"""What `raytrace wave free` finds: as text, as a document, as a page."""

import argparse
import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from raytrace.cli.door import CommandError
from raytrace.cli.progress import progress
from raytrace.files import table
from raytrace.imaging.restoration import psnr
from raytrace.imaging.training import NotFinite, OtherSettings
from raytrace.maths.result import Result
from raytrace.pages import grid, picture
from raytrace.studies.edof.command import LIMIT
from raytrace.studies.edof.free import SPREAD, STARTS, TERMS, WHITE, Case, PixelForm, departure, learn_free
from raytrace.studies.edof.free_command import Settings
from raytrace.studies.edof.noise import Bank, Errors, Gains
from raytrace.studies.edof.noise_command import Settings as Noise
from raytrace.studies.edof.noise_report import TITLES, Kept, counted, judge_baselines
from raytrace.studies.edof.report import contents_of
from raytrace.studies.edof.world import FILTERS, WAVELENGTH, ClosedForm, World, depth_text, periodic, spectrum
from raytrace.studies.options import picture_words
from raytrace.studies.publish import publish, published
from raytrace.wave_optics.element import Element, Rings, as_pixels
from raytrace.wave_optics.element_files import read_element

_SHOWN = 500  # pixels of a drawn map along each side
_LENS = 4  # even powers of r, from a constant on, that are taken out of drawn heights


@dataclasses.dataclass(frozen=True)
class Judged:
    """An element behind one filter on one content: PSNR in dB, gains over the rings that were learned on, and over the
    Fresnel lens; expected: PSNR of the closed form; unround: nm RMS of its heights that no ring has."""

    content: str
    filter: str
    row: str
    expected: float
    over_control: Gains
    over_fresnel: Gains
    unround: float

    def record(self) -> dict:
        own = {name: getattr(self, name) for name in ("content", "filter", "row", "expected", "unround")}
        own |= {"psnr": self.over_fresnel.pooled_psnr, "mean_psnr": self.over_fresnel.mean_psnr}
        for name in ("over_control", "over_fresnel"):
            one = getattr(self, name)
            own |= one.pooled.record(name) | one.mean.record(f"mean_{name}")
        return own


@dataclasses.dataclass(frozen=True)
class Shown:
    """heights: µm beyond a smooth round lens, (rows, columns), NaN outside; kernels: (D, rows, columns) at 550 nm."""

    heights: np.ndarray
    kernels: np.ndarray


@dataclasses.dataclass(frozen=True)
class Freed(Result):
    """Every element; shown: maps by row; pictures, classes: how many, by content."""

    rows: list[Judged]
    shown: dict[str, Shown]
    pictures: dict[str, int]
    settings: Settings
    classes: dict[str, int] = dataclasses.field(default_factory=dict)

    FIGURE = "studies.edof.figures.free_figure"

    def document(self) -> dict:
        return {"pictures": self.pictures, "rows": [row.record() for row in self.rows]}

    def lines(self, content: str, filter: str) -> list[tuple[str, ...]]:
        return [
            (title_of(one.row), f"{one.expected:.2f}", f"{one.over_fresnel.pooled_psnr:.2f}",
             _over_control(one), str(one.over_fresnel.pooled), f"{one.over_fresnel.mean_psnr:.2f}",
             str(one.over_fresnel.mean), f"{one.unround:.0f}")
            for one in self.rows
            if (one.content, one.filter) == (content, filter)
        ]  # fmt: skip

    def __str__(self) -> str:
        text = []
        for content in self.pictures:
            for filter in FILTERS:
                text.append(f"{content}, {TITLES[filter]}: PSNR in dB, gains (95 % interval)")
                lines = [_HEADER, *self.lines(content, filter)]
                text += [f"{line[0]:>36}" + "".join(f"{cell:>30}" for cell in line[1:]) for line in lines]
        return "\n".join(text)


_HEADER = (
    "element",
    "expected",
    "PSNR, pooled",
    "over the rings learned on",
    "over the Fresnel lens",
    "mean of PSNRs",
    "over the Fresnel lens",
    "not round, nm RMS",
)
_ROWS = {"given": "rings as given", "cut": "rings cut to pixels", "control": "rings learned on"}


def title_of(row: str) -> str:
    return _ROWS[row] if row in _ROWS else f"free heights {STARTS[row][0]}"


def _over_control(one: Judged) -> str:
    return "–" if one.row == "control" else str(one.over_control.pooled)


def free(arguments: argparse.Namespace) -> Freed:
    """Learn what is left, judge everything; the page where --docs asks for it."""
    settings, root = Settings.of(vars(arguments)), Path(arguments.folder)
    rings = read_element(arguments.rings, aperture=2 * World().radius)
    if not isinstance(rings.profile, Rings):
        raise CommandError(f"--from {arguments.rings}: holds no rings; expected heights of rings")
    contents, train = contents_of(arguments)
    S = spectrum(periodic(train, 256))
    banks = [Bank.of(content.name, content.train, content.test, content.classes) for content in contents]
    del contents
    kept = Kept(root / "judged", banks)  # refuses other pictures before anything is learned
    elements = {"given": rings, "cut": as_pixels(rings, settings.feature)}
    for start in ("control", *settings.starts):
        case = Case(start, settings.noise, settings.feature, settings.steps, settings.rate, settings.seed)
        elements[start] = _learned(case, rings, S, root)
    noise = Noise.of({"noise": (settings.noise,), "seed": settings.seed})
    base = judge_baselines(["fresnel"], noise, banks, kept)["fresnel", settings.noise]
    found = {row: _judged(row, element, S, settings, kept) for row, element in progress(list(elements.items()), "map")}
    rows = list(_rows(found, base, elements, banks, settings))
    shown = {row: _shown(element, settings) for row, element in elements.items() if row not in ("given", "cut")}
    result = Freed(
        rows,
        shown,
        {one.name: len(one.powers) for one in banks},
        settings,
        {one.name: one.class_count for one in banks},
    )
    if arguments.docs:
        _publish(result, arguments)
    return result


def _learned(case: Case, rings: Element, S: Tensor, root: Path) -> Element:
    def bar(steps: Iterable, first: int) -> Iterator:
        with progress(case.steps, what=title_of(case.start), initial=first) as shown:
            for step in steps:
                shown.update()
                yield step

    try:
        return learn_free(case, rings, S, root, bar=bar)
    except (NotFinite, OtherSettings) as error:
        raise CommandError(str(error)) from error


@torch.no_grad()
def _judged(row: str, element: Element, S: Tensor, settings: Settings, kept: Kept) -> tuple[float, dict[str, Errors]]:
    """PSNR of the closed form, and errors of pictures."""
    world, name = dataclasses.replace(World(), noise=settings.noise), f"free-{row}-{settings.noise:g}"
    form = ClosedForm if isinstance(element.profile, Rings) else PixelForm
    expected = kept.number(name, lambda: float(psnr(form((element,), world, S)((element,)))))
    H = lambda: form((element,), world, kept.banks[0].spectrum).transfer((element,))  # noqa: E731
    return expected, kept.find(name, world, H)


def _rows(
    found: Mapping[str, tuple[float, dict[str, Errors]]],
    base: Mapping[str, Errors],
    elements: Mapping[str, Element],
    banks: Sequence[Bank],
    settings: Settings,
) -> Iterator[Judged]:
    unround = {row: departure(element) for row, element in elements.items()}
    for bank in banks:
        weights = bank.drawn(seed=settings.seed)
        for filter in FILTERS:
            control, fresnel = found["control"][1][bank.name][filter], base[bank.name][filter]
            for row, (expected, errors) in found.items():
                own = errors[bank.name][filter]
                gains = (Gains.of(own, base, weights) for base in (control, fresnel))
                yield Judged(bank.name, filter, row, expected, *gains, unround[row])


@torch.no_grad()
def _shown(element: Element, settings: Settings) -> Shown:
    pixels = as_pixels(element, settings.feature) if isinstance(element.profile, Rings) else element
    world = dataclasses.replace(World(), wavelengths=(WAVELENGTH,))
    kernels = PixelForm((pixels,), world, torch.ones(1), dtype=torch.float32).kernels((pixels,))
    every = max(1, len(pixels.numbers) // _SHOWN)
    heights = 1e3 * pixels.numbers[::every, ::every].numpy()
    x = (np.arange(len(heights)) + 0.5) / len(heights) * 2 - 1
    r2 = x**2 + x[:, None] ** 2
    inside = r2 <= 1
    powers = r2[inside][:, None] ** np.arange(_LENS)
    smooth, *_ = np.linalg.lstsq(powers, heights[inside], rcond=None)
    rest = np.full(heights.shape, np.nan)
    rest[inside] = heights[inside] - powers @ smooth
    return Shown(rest, kernels[:, 0].numpy())


# --- the page

_ON = f"on a lens for {depth_text(World.design)}"
_BEGUN = {
    "rings": "from the learned rings",
    "cubic": f"from the cubic plate of best strength {_ON}",
    "random": f"from random polynomials (Noll's up to {TERMS}, {SPREAD:g} µm RMS each) {_ON}",
}


def _publish(found: Freed, arguments: argparse.Namespace) -> None:
    words = [f"--from {published(arguments.rings, arguments.docs)}", *picture_words(arguments, LIMIT)]
    command = " ".join(["raytrace wave free", *words, *found.settings.words(), "-o FOLDER --docs docs"])
    tables = {"free.csv": table([row.record() for row in found.rows], floats=lambda number: round(number, 4))}
    figures = {"free.png": found.plot()}
    publish(Path(arguments.docs) / "wave_free.md", "wave", _parts(found, command), tables=tables, figures=figures)


def _parts(found: Freed, command: str) -> list[str]:
    shown = "pictures" if "pictures" in found.pictures else next(iter(found.pictures))
    own = found.settings
    across = round(2 * World().radius / own.feature)
    size = 4e-6 * across**2  # MB, in single precision
    begun = ", ".join(_BEGUN[start] for start in own.starts)
    return [
        "# Free heights, symmetry not assumed",
        f"    {command}",
        "Camera, depths and colours of [wave_edof.md](wave_edof.md), pictures and intervals of "
        f"[wave_noise.md](wave_noise.md), noise {own.noise:g}. Maps of {across:,} × {across:,} pixels of "
        f"{1e3 * own.feature:g} µm of fused silica, every height free, learned by the expected error of the best "
        f"depth-invariant filter: {own.steps} steps of Adam {begun}; each with a random change of "
        f"{1e3 * WHITE:g} nm RMS of every pixel. *Rings learned on*: the same rings, as many steps of the same rate, "
        "round. *Expected*: PSNR of the closed form on sharp leaves, which all are learned for. *Not "
        f"round*: what is left of the heights without their mean over each ring. Restored: "
        f"{counted(found.pictures, found.classes)}; filters are made for others.",
        picture(
            "wave/free.png", "Heights beyond a smooth lens, and PSFs from 0.5 m to infinity at 550 nm, five decades."
        ),
        *(
            part
            for name in [shown, *(one for one in found.pictures if one != shown)]
            for filter in FILTERS
            for part in (f"## {name[0].upper()}{name[1:]}, {TITLES[filter]}", grid(_HEADER, found.lines(name, filter)))
        ),
        f"All figures: [free.csv](wave/free.csv). A learned map takes {size:.2g} MB and does not ship.",
    ]

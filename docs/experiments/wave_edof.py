"""Extended depth of field: every baseline and the designed elements, on several kinds of pictures.

    python docs/experiments/wave_edof.py --data DIR --limit 60 --steps 150 --starts 5 -o FOLDER --docs docs

PSNR of restored pictures over 0.5 m to infinity behind two filters: the Wiener filter of the PSF at 1 m with the best
constant, and the best depth-invariant one. Designed elements are stored in FOLDER and read again. Sitzmann et al.
(SIGGRAPH 2018), who defined the task, give the PSNR of restored pictures for six elements; their pictures, filters and
prescriptions differ, so that gains over the Fresnel lens are compared.
"""

import argparse
import dataclasses
import sys
import tempfile
import textwrap
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
from experiments import publish, published
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from pages import grid, picture
from torch import Tensor

from raytrace.cli import wave_design
from raytrace.cli.options import json, output_folder
from raytrace.cli.progress import progress
from raytrace.cli.runner import CommandError, present, say
from raytrace.cli.settings import add_options, defaults_of, documents, picture_options, picture_words, words
from raytrace.cli.types import file_name
from raytrace.cli.wave_design import LIMIT, PICTURES
from raytrace.cli.wave_run import LEAVES, WIDE, learn, training_pictures
from raytrace.files import table as csv
from raytrace.imaging.closed_form import camera_error
from raytrace.imaging.image import transfer_functions
from raytrace.imaging.pictures import Pictures, dead_leaves, draws, split
from raytrace.imaging.render import ImageFormation, render
from raytrace.imaging.restoration import depth_invariant_wiener, power_spectrum, psnr, restore
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.wave_camera import (
    FILTERS,
    ElementReport,
    Quality,
    WaveCameraConfig,
    depth_text,
    mark_depths,
    mirrored,
    periodic,
    quality,
    transfer,
)
from raytrace.maths.result import Result, plain
from raytrace.plotting.style import FIELD_COLOURS, new_figure, save, show_image, styled
from raytrace.settings import DesignSettings
from raytrace.wave_optics.designs import Aim, aim, baseline
from raytrace.wave_optics.element import Element
from raytrace.wave_optics.element_files import read_element
from raytrace.wave_optics.fabrication import height_range
from raytrace.words import did_you_mean

_LEARNED = ("learned", "learned-16", "learned-smooth")


#: Figures of the page, by file name: what each shows.
CAPTIONS = {
    "depth.png": "PSNR over depth behind the depth-invariant filter.",
    "scene.png": "Dead leaves at three depths, restored by the depth-invariant filter.",
    "deep.png": "A scene from 0.5 m (bottom) to infinity (top) in nine layers; near leaves occlude far ones.",
    "learned.png": "Learned rings of fused silica: height, texture, PSNR on sharp leaves, PSFs.",
    "learned-smooth.png": "Learned smooth element of PMMA.",
}
_SHOWN = ("fresnel", "singlet", "ideal", "cubic-refractive", "learned")  # in the scenes


@dataclasses.dataclass(frozen=True)
class Row:
    """title: what it is called; published: PSNR in dB by Sitzmann et al.; learning: settings it is learned with, else
    it is the baseline of its name; is_extra: only there where it is asked for."""

    title: str
    published: float | None = None
    learning: dict | None = None
    is_extra: bool = False


_FROM_PICTURES = {"kind": "rings", "loss": "images", "restoration": "towards"}
_ADADELTA = {"optimizer": "adadelta", "schedule": "constant", "rate": 1.0}

ROWS = {
    "fresnel": Row("Fresnel lens", 17.95),
    "multifocal": Row("multifocal Fresnel lens", 18.32),
    "cubic": Row("cubic plate on a Fresnel lens", 18.33),
    "hybrid": Row("hybrid achromat", 18.92),
    "achromat": Row("diffractive achromat", 20.20),
    "singlet": Row("PMMA singlet"),
    "ideal": Row("ideal lens without dispersion"),
    "multifocal-refractive": Row("multifocal PMMA lens"),
    "cubic-refractive": Row("cubic plate on a PMMA lens"),
    "learned-smooth": Row("learned, smooth PMMA", learning={"kind": "smooth", "glass": "PMMA"}),
    "learned": Row("learned, fused silica rings", 24.30, {"kind": "rings"}),
    "learned-16": Row("learned, wrapped, 16 levels", learning={"kind": "rings", "levels": 16}),
    "learned-images": Row("rings, learned from pictures", learning=_FROM_PICTURES, is_extra=True),
    "learned-adadelta": Row("rings, from pictures by Adadelta", learning=_FROM_PICTURES | _ADADELTA, is_extra=True),
    "learned-zernike": Row(
        "learned, Zernike PMMA, by Adadelta",
        learning={"kind": "zernike", "glass": "PMMA", "terms": 22, "spread": 0.05, **_ADADELTA},
        is_extra=True,
    ),
}


def title_of(row: str) -> str:
    """Of a row of the table, or of a file."""
    return ROWS[row].title if row in ROWS else row


#: Strengths of cubic plates in waves that are tried; the best in closed form is taken.
STRENGTHS = (5.0, 10.0, 15.0, 20.0, 30.0)


@dataclasses.dataclass(frozen=True)
class Content:
    """Pictures (B, n, n), periodic: to make filters for, and to restore; classes: of those, each its own by default."""

    name: str
    train: Tensor
    test: Tensor
    classes: tuple[str, ...] = ()


def elements_of(
    rows: Iterable[str], config: WaveCameraConfig, S: Tensor, *, learned: Mapping[str, Sequence[Element]]
) -> dict[str, Sequence[Element]]:
    """The elements of rows, in the order of the table: learned ones as given, those that are not there left out.

    Cubic plates have the strength that is best for pictures of spectrum S (n, n) on the PMMA lens, searched once.
    """
    made_for = aim(radius=config.radius, sensor=config.sensor_distance, focus=config.design, exact=config.exact)
    named = [name for name in ROWS if name in set(rows)]
    options = {}
    if any(name.startswith("cubic") for name in named):
        options = {"strength": min(STRENGTHS, key=lambda own: _error_of_cubic(own, made_for, config, S))}
    found = {}
    for name in named:
        if ROWS[name].learning is None:
            found[name] = baseline(name, made_for, **(options if name.startswith("cubic") else {}))
        elif name in learned:
            found[name] = learned[name]
    return found


def _error_of_cubic(strength: float, made_for: Aim, config: WaveCameraConfig, S: Tensor) -> float:
    elements = baseline("cubic-refractive", made_for, strength=strength)
    return float(camera_error(config.camera(elements), S, config.depths).detach())


def table_of(
    contents: Sequence[Content],
    elements: Mapping[str, Sequence[Element]],
    config: WaveCameraConfig,
    *,
    progress: Callable[[Iterable], Iterable] = iter,
) -> dict[str, dict[str, Quality]]:
    """Quality by content and row, of the elements of each row."""
    found: dict[str, dict[str, Quality]] = {content.name: {} for content in contents}
    for name in progress(list(elements)):
        camera = config.camera(elements[name])
        with torch.no_grad():
            how = {"design": config.design, "kernels": camera.kernels(config.depths)}
        for content in contents:
            found[content.name][name] = quality(camera, config.depths, train=content.train, test=content.test, **how)
    return found


def records(found: Mapping[str, Mapping[str, Quality]]) -> list[dict]:
    """The table, a row for each content and element; gains over the Fresnel lens, dB."""
    result = []
    for content, rows in found.items():
        base = rows.get("fresnel")
        for name, own in rows.items():
            gains = {f"gain_{filter}": own.mean[filter] - base.mean[filter] if base else None for filter in own.mean}
            each = {f"mean_{filter}": value for filter, value in own.of_pictures.items()}
            each |= {
                f"mean_gain_{filter}": value - base.of_pictures[filter] if base else None
                for filter, value in own.of_pictures.items()
            }
            spread = {"spread_blind": own.spread["blind"], "worst_blind": min(own.by_depth["blind"])}
            head = {"content": content, "row": name}
            result.append({**head, **own.mean, **gains, **each, **spread, "published": ROWS[name].published})
    return result


# -- scenes of dead leaves, restored -----------------------------------------------------------------------------------

_KEY = 99  # of what is drawn
_LAYERS = 9  # of a deep scene, even in dioptres


@dataclasses.dataclass(frozen=True)
class Deep:
    """A scene from the nearest to the farthest depth: picture (h, w, 3), dioptres (h, w).

    seen, restored: by row what the sensor saw and what was made of it, (h, w, 3) each, with the PSNR.
    """

    picture: np.ndarray
    dioptres: np.ndarray
    seen: dict[str, np.ndarray]
    restored: dict[str, tuple[np.ndarray, float]]


def coloured_leaves(size: int, *, colours: int = 3, seed: int = 0) -> np.ndarray:
    """Dead leaves (colours, size, size) that end at one place in all colours: a colour for every shade of grey."""
    leaves = dead_leaves(1, size=size, seed=seed + _KEY, smallest=4.0).samples[0]
    return np.stack([table[leaves] for table in draws(seed, _KEY).uniform(0.05, 0.95, (colours, 256))])


@torch.no_grad()
def flat(
    elements: Mapping[str, Sequence[Element]], config: WaveCameraConfig, *, seed: int = 0
) -> tuple[dict[str, dict[str, tuple[np.ndarray, float]]], np.ndarray]:
    """A scene at the nearest, the middle and the farthest depth: by row and depth what is restored, with its PSNR; and
    the scene.
    """
    size, part = 512, slice(40, 200)
    leaves = coloured_leaves(size // 2, colours=len(config.wavelengths), seed=seed)
    picture = mirrored(leaves)
    S, noise = power_spectrum(picture, window="none"), noise_like(picture, config, seed)
    found: dict[str, dict[str, tuple[np.ndarray, float]]] = {}
    for name, own in elements.items():
        camera = config.camera(own)
        G = depth_invariant_wiener(transfer(camera, size, config.depths), S, config.noise)
        found[name] = {}
        for depth in (config.depths[0], config.depths[len(config.depths) // 2], config.depths[-1]):
            estimate = restore(camera.image(picture[None], [depth])[0] + noise, G)
            ratio = float(psnr((estimate - picture).square().mean()))
            found[name][depth_text(depth)] = shown(estimate[:, part, part]), ratio
    return found, shown(picture[:, part, part])


@torch.no_grad()
def deep(elements: Mapping[str, Sequence[Element]], config: WaveCameraConfig, *, seed: int = 0) -> Deep:
    """Leaves on a floor from the nearest depth, below, to the farthest, above; near layers hide far ones."""
    size, half = 320, config.size // 2
    picture = torch.as_tensor(coloured_leaves(size + 2 * half, colours=len(config.wavelengths), seed=seed))
    dioptres = [1e3 / depth for depth in config.depths]
    rise = torch.linspace(min(dioptres), max(dioptres), size, dtype=picture.dtype)
    depth = torch.cat([rise.new_full((half,), float(rise[0])), rise, rise.new_full((half,), float(rise[-1]))])
    depth = depth[:, None].expand(picture.shape[1:])
    pixels = picture.shape[2], picture.shape[1]
    response = {"wavelengths": config.wavelengths, "sensitivities": np.eye(len(config.wavelengths))}
    sensor = Sensor(tuple(config.pixel * count for count in pixels), pixels, response=response)
    how = {"sensor": sensor, "sensor_distance": config.sensor_distance, "wavelengths": config.wavelengths}
    how |= {"depth": 1e3 / depth, "planes": _LAYERS, "softness": 0.1, "size": config.size}
    truth, S = picture[:, half:-half, half:-half], power_spectrum(picture, window="none")
    seen, back = {}, {}
    for name, own in elements.items():
        # Columns of a sensor grow towards -x, those of the page towards +x.
        rendering = render(own, picture.flip(-1), **how, illumination=False, boundary="zero")
        image = rendering.image.flip(-1)[:, half:-half, half:-half]
        image = image + noise_like(image, config, seed)
        G = depth_invariant_wiener(transfer_of(rendering.optics), S, config.noise)
        estimate = restore(image, G, boundary="taper")
        seen[name] = shown(image)
        back[name] = shown(estimate), float(psnr((estimate - truth).square().mean()))
    return Deep(shown(truth), depth[half:-half, half:-half].numpy(), seen, back)


def transfer_of(formation: ImageFormation) -> Tensor:
    """H (D, C, rows, columns) of the kernels of elements, columns towards +x; light beyond the window is haze."""
    kernels = (1 - formation.haze)[..., None, None] * formation.kernels[0, 0].flip(-1)
    return transfer_functions(kernels, formation.sensor.pixels[::-1], haze=True)


def noise_like(like: Tensor, config: WaveCameraConfig, seed: int) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return config.noise * torch.randn(like.shape, generator=random, dtype=like.dtype)


def shown(picture: Tensor) -> np.ndarray:
    return picture.flip(0).movedim(0, -1).numpy()


# -- figures -----------------------------------------------------------------------------------------------------------


@styled
def depth_figure(found: Mapping[str, Mapping[str, Quality]], config: WaveCameraConfig) -> Figure:
    """PSNR behind the depth-invariant filter over depth in dioptres, a panel for each content, a line for each row."""
    figure = new_figure(3.1 * len(found) + 1.9, 3.8)
    axes = np.atleast_1d(figure.subplots(1, len(found), sharey=True))
    dioptres = [1e3 / depth for depth in config.depths]
    for panel, (content, rows) in zip(axes, found.items(), strict=True):
        for name, own in rows.items():
            panel.plot(dioptres, own.by_depth["blind"], label=ROWS[name].title, **look(name, list(rows)))
        panel.set(title=content, xlabel="object distance")
        mark_depths(panel, config)
    axes[0].set_ylabel("PSNR, depth-invariant filter (dB)")
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside right center", fontsize=7.5)
    return figure


@styled
def scene_figure(columns: Mapping[str, Mapping[str, tuple[np.ndarray, float]]], picture: np.ndarray) -> Figure:
    """Restored scenes: a column for each row of the table, a line for each depth; the picture itself once, in front.

    columns: name -> what it shows -> (picture (h, w, 3), its PSNR).
    """
    depths = list(next(iter(columns.values())))
    figure = new_figure(1.55 * (len(columns) + 1), 1.62 * len(depths) + 0.3)
    axes = figure.subplots(len(depths), len(columns) + 1, squeeze=False)
    _show(axes[0, 0], picture, "scene")
    for line, depth in enumerate(depths):
        axes[line, 0].axis("on" if line == 0 else "off")
        for column, (row, cells) in enumerate(columns.items(), 1):
            image, ratio = cells[depth]
            _show(axes[line, column], image, _title(row) if line == 0 else "")
            axes[line, column].set_xlabel(f"{ratio:.1f} dB", fontsize=7.5, labelpad=2)
        axes[line, 1].set_ylabel(f"object at {depth}", fontsize=8)
    return figure


@styled
def deep_figure(found: Deep) -> Figure:
    """A scene in depth: above what the sensors saw, below what was restored; in front the scene and its depth."""
    figure = new_figure(1.9 * (len(found.seen) + 1), 4.3)
    axes = figure.subplots(2, len(found.seen) + 1, squeeze=False)
    _show(axes[0, 0], found.picture, "scene")
    shades = axes[1, 0].imshow(found.dioptres, cmap="cividis")
    axes[1, 0].set(xticks=[], yticks=[])
    axes[1, 0].set_title("depth", fontsize=7.5)
    bar = figure.colorbar(shades, ax=axes[1, 0], location="bottom", fraction=0.06, pad=0.04)
    marks = [mark for mark in (0, 0.5, 1, 1.5, 2) if found.dioptres.min() <= mark <= found.dioptres.max()]
    bar.set_ticks(marks, labels=["∞" if mark == 0 else f"{1 / mark:.2g} m" for mark in marks], fontsize=6.5)
    for column, name in enumerate(found.seen, 1):
        _show(axes[0, column], found.seen[name], _title(name))
        image, ratio = found.restored[name]
        _show(axes[1, column], image, "")
        axes[1, column].set_xlabel(f"{ratio:.1f} dB", fontsize=7.5, labelpad=2)
    axes[0, 1].set_ylabel("sensor", fontsize=8)
    axes[1, 1].set_ylabel("restored", fontsize=8)
    return figure


def _show(axes: Axes, picture: np.ndarray, title: str) -> None:
    show_image(axes, np.clip(picture, 0, 1), title)


def _title(name: str) -> str:
    return textwrap.fill(ROWS[name].title, 18)


def look(name: str, rows: Sequence[str]) -> dict:
    if name in _LEARNED:
        style = ("-", "--", ":")[_LEARNED.index(name)]
        return {"color": FIELD_COLOURS[2], "lw": 2, "ls": style, "marker": "o", "ms": 3.5}
    colours = [colour for colour in FIELD_COLOURS if colour != FIELD_COLOURS[2]]
    number = [row for row in rows if row not in _LEARNED].index(name)
    style = ("-", "--", ":")[number // len(colours) % 3]
    return {"color": colours[number % len(colours)], "lw": 1.2, "ls": style}


# -- the page ----------------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class Table(Result):
    """Quality by content and row."""

    found: dict[str, dict[str, Quality]]

    def document(self) -> dict:
        return {"rows": plain(records(self.found))}

    def rows(self, content: str) -> Iterator[tuple]:
        """Of each row its record, its quality, and PSNR by filter and as published, gains over the Fresnel lens beside
        them: of pooled errors, then as the mean of the PSNRs of pictures."""
        base = ROWS["fresnel"].published
        for record in records({content: self.found[content]}):
            columns = [(f"{mean}{filter}", f"{mean}gain_{filter}") for mean in ("", "mean_") for filter in FILTERS]
            published = record["published"]
            yield (
                record,
                self.found[content][record["row"]],
                *(
                    f"{record[one]:.2f}" + ("" if record[gain] is None else f" ({record[gain]:+.2f})")
                    for one, gain in columns
                ),
                f"{published:.2f} ({published - base:+.2f})" if published else "",
            )

    def __str__(self) -> str:
        text = []
        for content in self.found:
            text.append(
                f"{content}: PSNR of restored pictures, dB (gain over the Fresnel lens); errors pooled over "
                "pictures, then the mean of their PSNRs"
            )
            text.append(
                f"{'':>32}" + 2 * f" {'Wiener':>14} {'invariant':>14}" + f" {'spread':>7} {'Sitzmann 2018':>14}"
            )
            for record, _, *cells, printed in self.rows(content):
                title, spread = ROWS[record["row"]].title, record["spread_blind"]
                shown = "".join(f" {cell:>14}" for cell in cells)
                text.append(f"{title:>32}{shown} {spread:>7.2f} {printed:>14}")
            text.append("")
        return "\n".join(text)

    def markdown(self, content: str) -> str:
        header = ("element", "Wiener, 1 m", "depth-invariant", "spread", "light in window", "Sitzmann 2018")
        lines = []
        for record, own, wiener, invariant, *_, printed in self.rows(content):
            numbers = (record["spread_blind"], min(min(row) for row in own.energy))
            cells = (cell.removesuffix(" (+0.00)") for cell in (wiener, invariant))
            last = (f"{number:.2f}" for number in numbers)
            lines.append([ROWS[record["row"]].title, *cells, *last, printed or "–"])
        return grid(header, lines)


def edof(arguments: argparse.Namespace) -> Table:
    """Every row on every content; the page where --docs asks for it."""
    for option, given in (("rows", arguments.rows), ("also", arguments.also)):
        unknown = sorted(set(given or ()) - set(ROWS))
        if unknown:
            meant = did_you_mean(unknown[0], ROWS)
            raise CommandError(f"--{option} {' '.join(unknown)}: expected {', '.join(ROWS)}{meant}")
    usual = (name for name, row in ROWS.items() if not row.is_extra)
    rows, config = [*(arguments.rows or usual), *(arguments.also or ())], WaveCameraConfig()
    contents, train = contents_of(arguments)
    learned = _learned(arguments, rows, config, train)
    elements = elements_of(rows, config, power_spectrum(contents[0].train, window="none"), learned=learned)
    found = table_of(contents, elements, config, progress=lambda given: progress(given, "row"))
    if arguments.figures:
        Path(arguments.figures).mkdir(parents=True, exist_ok=True)
        for name, figure in figures(found, elements, config, arguments.seed or 0).items():
            save(figure, Path(arguments.figures) / name)
    if arguments.docs:
        drawn = figures(found, elements, config, arguments.seed or 0)
        named = [name for name in CAPTIONS if name in drawn]
        single = {title_of(name): own[0] for name, own in elements.items() if name in learned and len(own) == 1}
        parts = _parts(Table(found), contents, config, _command(arguments), named, single)
        rows = {"table.csv": csv(records(found), floats=lambda number: round(number, 3))}
        publish(Path(arguments.docs) / "wave_edof.md", "wave", parts, tables=rows, figures=drawn)
    return Table(found)


def contents_of(arguments: argparse.Namespace) -> tuple[list[Content], Pictures]:
    """All contents of the table, and the pictures that elements are learned from: sharp leaves."""
    leaves = argparse.Namespace(**vars(arguments) | {"data": None})
    parts = {name: split(training_pictures(leaves, name)) for name in progress(LEAVES, "dead leaf")}
    if arguments.data:
        parts["pictures"] = split(training_pictures(arguments, "sharp leaves"))
    contents = [
        Content(name, *(periodic(part, WIDE) for part in both), both[1].classes) for name, both in parts.items()
    ]
    return contents, parts["sharp leaves"][0]


def _learned(
    arguments: argparse.Namespace, rows: Sequence[str], config: WaveCameraConfig, train: Pictures
) -> dict[str, tuple[Element, ...]]:
    """The learned ones of the rows."""
    common = {name: getattr(arguments, name) for name in ("steps", "starts", "seed")}
    stored = {Path(file).stem.rpartition("-")[0]: file for file in arguments.elements}
    asked = {name: row.learning for name, row in ROWS.items() if row.learning and name in rows}
    if set(asked) - set(stored) and not arguments.folder:
        say("learned elements are not kept: -o FOLDER keeps them")
    found = {}
    with tempfile.TemporaryDirectory() as unkept, torch.no_grad():
        for name, learning in asked.items():
            if name in stored:
                found[name] = (read_element(stored[name], aperture=2 * config.radius),)
                continue
            folder = Path(arguments.folder or unkept) / name
            with torch.enable_grad():
                *_, camera = learn(DesignSettings.of(common, **learning), config, train, folder, ROWS[name].title)
            found[name] = camera.elements()
    return found


def _command(arguments: argparse.Namespace) -> str:
    options = [f"--{name} {' '.join(given)}" for name in ("rows", "also") if (given := getattr(arguments, name))]
    own = DesignSettings.of({name: getattr(arguments, name) for name in ("steps", "starts", "seed")})
    if arguments.elements:
        options.append("--elements " + " ".join(published(file, arguments.docs) for file in arguments.elements))
    options += [*picture_words(arguments, LIMIT), *words(own, wave_design.ROWS)]
    return " ".join(["python docs/experiments/wave_edof.py", *options, "-o FOLDER --docs docs"])


def figures(found, elements: Mapping[str, Sequence[Element]], config: WaveCameraConfig, seed: int) -> dict:
    """Figures of the page, by file name. Only dead leaves are shown."""
    first = next(iter(found.values()))
    made = {"depth.png": depth_figure(found, config)}
    for name in {"learned", "learned-smooth"} & set(elements):
        with torch.no_grad():
            kernels = config.camera(elements[name]).kernels(config.depths)
        report = ElementReport(elements[name], config, kernels, first[name])
        made[f"{name}.png"] = report.plot()
    scene = {name: elements[name] for name in _SHOWN if name in elements}
    made["scene.png"] = scene_figure(*flat(scene, config, seed=seed))
    made["deep.png"] = deep_figure(deep(scene, config, seed=seed))
    return made


def heights_of(elements: Mapping[str, Element]) -> str:
    """A sentence on the heights of elements inside their aperture, by title."""
    ranges = {title: height_range(element) for title, element in elements.items()}
    listed = "; ".join(f"{title} {1e3 * (high - low):.3g} µm" for title, (low, high) in ranges.items())
    return f"Heights, largest less smallest inside the aperture: {listed}."


def _parts(
    table: Table,
    given: Sequence[Content],
    config: WaveCameraConfig,
    command: str,
    figures: Sequence[str],
    learned: Mapping[str, Element],
) -> list[str]:
    depths = ", ".join(map(depth_text, config.depths))
    colours = ", ".join(f"{1e3 * w:.0f}" for w in config.wavelengths)
    tested = ", ".join(f"{len(one.test)} {pictures_of(one.name)}" for one in given)
    others = ", ".join(str(len(one.train)) for one in given)
    shown = [name for name in ("pictures", *table.found) if name in table.found][:1]
    return [
        "# Extended depth of field with one phase element",
        *_answer(table, shown),
        f"    {command}",
        f"Aperture {2 * config.radius:g} mm, sensor at {config.sensor_distance:g} mm, {colours} nm, objects at "
        f"{depths}. Pixels of {1e3 * config.pixel:g} µm, kernels of {config.size} × {config.size} pixels; light "
        f"outside them is spread evenly. Noise: standard deviation {config.noise:g}. All baselines are designed for "
        f"{config.design / 1e3:g} m at 550 nm. Tested on {tested}, in closed form over noise; filters are "
        f"made for {others} others. Learned elements know only the spectrum of sharp dead leaves.",
        *(part for name in shown for part in (f"## {name[0].upper()}{name[1:]}", table.markdown(name))),
        "PSNR in dB, mean over depths, of errors pooled over pictures. In brackets: gain over the Fresnel lens. "
        "Spread: best less worst depth, behind the depth-invariant filter. Sitzmann 2018: published figures, other "
        "pictures. All contents, worst depth and mean of the PSNRs of single pictures: [table.csv](wave/table.csv).",
        *([heights_of(learned)] if learned else []),
        *(picture(f"wave/{name}", CAPTIONS[name]) for name in figures),
    ]


def _answer(table: Table, shown: Sequence[str]) -> Iterator[str]:
    """Gains of the learned rings and of the best baseline behind the Wiener filter."""
    for name in shown:
        gains = {row["row"]: row["gain_wiener"] for row in records({name: table.found[name]})}
        fixed = {row: gain for row, gain in gains.items() if row not in _LEARNED and gain is not None}
        if fixed and gains.get("learned") is not None:
            best = max(fixed, key=fixed.get)
            yield (
                f"On {name}, behind the Wiener filter of the PSF at 1 m, the learned rings gain "
                f"{gains['learned']:+.2f} dB over the Fresnel lens; Sitzmann et al. (SIGGRAPH 2018) report +6.35 dB. "
                f"The best baseline, {ROWS[best].title}, gains {fixed[best]:+.2f} dB."
            )


def pictures_of(kind: str) -> str:
    """The name of pictures of a kind, dead leaves or "pictures"."""
    return kind if kind == "pictures" else f"pictures of {kind}"


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rows", metavar="ROW", nargs="+", help="only these (default: all but those of --also)")
    parser.add_argument(
        "--also",
        metavar="ROW",
        nargs="+",
        help="further rows: learned-images (--loss images --filter towards), learned-adadelta (the same by Adadelta), "
        "learned-zernike (22 polynomials, no symmetry, by Adadelta)",
    )
    parser.add_argument(
        "--elements",
        metavar="FILE",
        nargs="+",
        type=file_name,
        default=(),
        help="stored elements ROW-NOISE.npy or .json for learned rows, which are not learned again",
    )
    parser.add_argument("--figures", metavar="FOLDER", help="write only the figures of the page, into this folder")
    defaults = defaults_of(DesignSettings)
    add_options(parser, defaults, wave_design.ROWS, "steps", "starts")
    add_options(picture_options(parser, PICTURES, limit=LIMIT), defaults, wave_design.ROWS, "seed")
    output_folder("folder of designed elements")(parser)
    documents(parser, "wave_edof.md and wave/")
    json(parser)


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args(argv)
    present(edof(arguments), arguments)


if __name__ == "__main__":
    sys.exit(main())

"""What `raytrace wave edof` and `raytrace wave table` find: as text, as a document, as a page."""

import argparse
import dataclasses
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import torch

from raytrace.cli.door import CommandError, say
from raytrace.cli.progress import progress
from raytrace.files import table as csv
from raytrace.files import write_json
from raytrace.imaging.training import NotFinite, OtherSettings
from raytrace.maths.result import Result, called, plain
from raytrace.pages import grid, picture
from raytrace.studies.edof.command import LIMIT
from raytrace.studies.edof.scene import deep, flat
from raytrace.studies.edof.settings import Settings
from raytrace.studies.edof.table import ROWS, Content, elements_of, records, table_of, title_of
from raytrace.studies.edof.training import EdofCamera, begin, learn_element
from raytrace.studies.edof.world import (
    FILTERS,
    Judged,
    Quality,
    World,
    depth_text,
    kernels,
    periodic,
    quality,
    spectrum,
)
from raytrace.studies.options import picture_words
from raytrace.studies.pictures import Pictures, dead_leaves, digest, pictures, pictures_of, split
from raytrace.studies.publish import publish
from raytrace.wave_optics.element import Element, as_pixels, fabricated, height_range
from raytrace.wave_optics.element_files import write_element
from raytrace.words import did_you_mean

_WIDE = 512  # pixels of a period that is restored
_LEAVES = 40  # pictures of dead leaves
#: Contents of dead leaves: name -> smallest radius, pixels.
LEAVES = {"sharp leaves": 2.5, "smooth leaves": 8.0}

#: Figures of the page, by file name: what each shows.
CAPTIONS = {
    "gain.png": "Gains over the Fresnel lens, by content and filter, beside those that Sitzmann et al. published.",
    "depth.png": "PSNR over depth behind the best linear filter that does not know the depth.",
    "scene.png": "A scene of dead leaves at three depths as each element's camera restores it (depth-invariant "
    "filter).",
    "deep.png": "A scene from 0.5 m (below) to infinity (above) in nine layers, near leaves hiding far ones.",
    "learned.png": "The learned element: rings of fused silica, its PSFs over depth and colour, its PSNR.",
    "learned-smooth.png": "The learned smooth element of PMMA.",
}
_SHOWN = ("fresnel", "singlet", "ideal", "cubic-refractive", "learned")  # in the scenes


# --- one element


@dataclasses.dataclass(frozen=True)
class Learned(Judged):
    """A learned element, and what it is worth."""

    settings: Settings

    def document(self) -> dict:
        named = {"settings": self.settings, "world": self.world}
        return plain({name: dataclasses.asdict(one) for name, one in named.items()} | dataclasses.asdict(self.quality))

    def __str__(self) -> str:
        own, world = self.quality, self.world
        rows = [(depth_text(depth), *both) for depth, *both in zip(world.depths, *own.by_depth.values(), strict=True)]
        rows += [("mean", *own.mean.values()), ("spread", *own.spread.values())]
        lowest = min(min(row) for row in own.energy)
        return "\n".join(
            [
                f"{'object at':>12} {'Wiener':>9} {'invariant':>9}   PSNR of restored pictures, dB; invariant: the "
                "filter that knows no depth",
                *(f"{name:>12} {classic:>9.2f} {invariant:>9.2f}" for name, classic, invariant in rows),
                f"light inside the window of {world.size} × {world.size} pixels: {lowest:.3f} or more",
            ]
        )


def edof(arguments: argparse.Namespace) -> Learned:
    """Learn one element, or go on with it; then say what it is worth."""
    world, settings, folder = _world(arguments), _settings(arguments), Path(arguments.folder)
    train, test = split(_pictures(arguments, "sharp leaves"))
    camera = learn(settings, world, train, folder, f"{settings.kind}, seed {settings.seed}")
    with torch.no_grad():
        elements = camera.variables()
        found = kernels(elements, world)
        own = quality(elements, world, train=periodic(train, _WIDE), test=periodic(test, _WIDE), found=found)
    learned = Learned(elements, world, found, own, settings)
    write_json(folder / "outcome.json", learned.document())
    made = fabricated(elements[0]) if settings.kind == "rings" else as_pixels(elements[0], world.pixel)
    write_element(made, folder / "heights.npy", design_wavelength=world.wavelengths[len(world.wavelengths) // 2])
    say(f"written: {folder / 'outcome.json'}, {folder / 'heights.npy'}")
    return learned


def _world(arguments: argparse.Namespace) -> World:
    if arguments.size % 2 == 0:
        raise CommandError(f"--size {arguments.size}: a window needs a pixel at its middle; take an odd number")
    return World(
        radius=0.5 * arguments.aperture,
        sensor_distance=arguments.sensor,
        depths=tuple(arguments.depths),
        design=arguments.focus,
        wavelengths=tuple(arguments.wavelengths),
        pixel=arguments.pixel,
        size=arguments.size,
        noise=arguments.noise or World.noise,
        exact=arguments.exact,
    )


def _settings(arguments: argparse.Namespace) -> Settings:
    kind = arguments.kind or Settings.kind
    if kind != "rings":
        for option, given in (("feature", arguments.feature), ("tolerance", 1e6 * (arguments.tolerance or 0))):
            if given:
                raise CommandError(f"--{option} {given:g}: a {kind} element has no rings; take --element rings")
    named = {name: value for name, value in vars(arguments).items() if name not in ("noise", "size")}
    usual = {"glass": "F_SILICA" if kind == "rings" else "PMMA", "terms": 36 if kind == "zernike" else 7}
    more = {name: named.get(name) or value for name, value in usual.items()}
    more |= {"pitch": arguments.feature} if arguments.feature else {}
    more |= {"noise": (arguments.noise, arguments.noise)} if arguments.noise else {}
    more |= {"restoration": "blind"} if arguments.loss != "images" else {}
    return Settings.of(named, **more)


def learn(settings: Settings, world: World, train: Pictures, folder: Path, label: str) -> EdofCamera:
    """A learned camera, trained as far as is left, with a bar."""
    S = spectrum(periodic(train, settings.size))
    try:
        camera, run = begin(
            settings,
            world,
            S,
            folder,
            pictures=digest(train.samples),
            progress=lambda given: progress(given, "start", what=label),
        )
        bar, last = None, None
        for step, record in learn_element(camera, train, settings, run):
            bar = bar or progress(settings.steps, what=label, initial=step)
            bar.set_postfix_str(f"loss {record['loss']:.6f}", refresh=False)
            bar.update()
            last = record
    except (NotFinite, OtherSettings) as error:
        raise CommandError(str(error)) from error
    if bar is None:
        say(f"{label}: finished before, nothing to learn")
    else:
        bar.close()
        say(f"{label}: loss {last['loss']:.6f} after {settings.steps} steps")
    return camera


def _pictures(arguments: argparse.Namespace, leaves: str) -> Pictures:
    """Those of --data, else leaves of this content."""
    made = {"size": _WIDE // 2, "seed": arguments.seed or 0, "smallest": LEAVES[leaves]}
    return pictures(arguments, _WIDE // 2, lambda: dead_leaves(_LEAVES, **made))[0]


# --- the table


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
            for record, _, *cells, published in self.rows(content):
                title, spread = ROWS[record["row"]].title, record["spread_blind"]
                shown = "".join(f" {cell:>14}" for cell in cells)
                text.append(f"{title:>32}{shown} {spread:>7.2f} {published:>14}")
            text.append("")
        return "\n".join(text)

    def markdown(self, content: str) -> str:
        means = ("Wiener, 1 m", "depth-invariant", "Wiener, mean of PSNRs", "depth-invariant, mean of PSNRs")
        header = ("element", *means, "worst", "spread", "light in window", "Sitzmann 2018")
        lines = []
        for record, own, *psnrs, published in self.rows(content):
            base = record["row"] == "fresnel"
            cells = [cell.partition(" ")[0] if base else cell for cell in psnrs]
            numbers = (record["worst_blind"], record["spread_blind"], min(min(row) for row in own.energy))
            cells += [*(f"{number:.2f}" for number in numbers), published or "–"]
            lines.append([ROWS[record["row"]].title, *cells])
        return grid(header, lines)


def table(arguments: argparse.Namespace) -> Table:
    """Every row on every content; the page where --docs asks for it."""
    for option, given in (("rows", arguments.rows), ("also", arguments.also)):
        unknown = sorted(set(given or ()) - set(ROWS))
        if unknown:
            meant = did_you_mean(unknown[0], ROWS)
            raise CommandError(f"--{option} {' '.join(unknown)}: expected {', '.join(ROWS)}{meant}")
    usual = (name for name, row in ROWS.items() if not row.is_extra)
    rows, world = [*(arguments.rows or usual), *(arguments.also or ())], World()
    contents, train = contents_of(arguments)
    learned = _learned(arguments, rows, world, train)
    elements = elements_of(rows, world, spectrum(contents[0].train), learned=learned)
    found = table_of(contents, elements, world, progress=lambda given: progress(given, "row"))
    if arguments.docs:
        drawn = _figures(found, elements, world, arguments.seed or 0)
        named = [name for name in CAPTIONS if name in drawn]
        single = {title_of(name): own[0] for name, own in elements.items() if name in learned and len(own) == 1}
        parts = _parts(Table(found), contents, world, _command(arguments), named, single)
        rows = {"table.csv": csv(records(found), floats=lambda number: round(number, 3))}
        publish(Path(arguments.docs) / "wave_edof.md", "wave", parts, tables=rows, figures=drawn)
    return Table(found)


def contents_of(arguments: argparse.Namespace) -> tuple[list[Content], Pictures]:
    """All contents of the table, and the pictures that elements are learned from: sharp leaves."""
    leaves = argparse.Namespace(**vars(arguments) | {"data": None})
    parts = {name: split(_pictures(leaves, name)) for name in progress(LEAVES, "dead leaf")}
    if arguments.data:
        parts["pictures"] = split(_pictures(arguments, "sharp leaves"))
    contents = [
        Content(name, *(periodic(part, _WIDE) for part in both), both[1].classes) for name, both in parts.items()
    ]
    return contents, parts["sharp leaves"][0]


def _learned(
    arguments: argparse.Namespace, rows: Sequence[str], world: World, train: Pictures
) -> dict[str, tuple[Element, ...]]:
    """The learned ones of the rows."""
    common = {name: getattr(arguments, name) for name in ("steps", "starts", "seed")}
    asked = {name: row.learning for name, row in ROWS.items() if row.learning and name in rows}
    if asked and not arguments.folder:
        say("learned elements are not kept: -o FOLDER keeps them")
    found = {}
    with tempfile.TemporaryDirectory() as unkept, torch.no_grad():
        for name, learning in asked.items():
            folder = Path(arguments.folder or unkept) / name
            with torch.enable_grad():
                camera = learn(Settings.of(common, **learning), world, train, folder, ROWS[name].title)
            found[name] = camera.variables()
    return found


def _command(arguments: argparse.Namespace) -> str:
    words = [f"--{name} {' '.join(given)}" for name in ("rows", "also") if (given := getattr(arguments, name))]
    own = Settings.of({name: getattr(arguments, name) for name in ("steps", "starts", "seed")})
    words += [*picture_words(arguments, LIMIT), *own.words()]
    return " ".join(["raytrace wave table", *words, "-o FOLDER --docs docs"])


def _figures(found, elements: Mapping[str, Sequence[Element]], world: World, seed: int) -> dict:
    """Figures of the page, by file name. Only dead leaves are shown."""

    def figure(name: str, *given):
        return called(f"studies.edof.figures.{name}")(*given)

    first = next(iter(found.values()))
    made = {"depth.png": figure("depth_figure", found, world)}
    if "fresnel" in first:
        made["gain.png"] = figure("gain_figure", found)
    for name in ("learned", "learned-smooth"):
        if name in elements:
            made[f"{name}.png"] = Judged(elements[name], world, kernels(elements[name], world), first[name]).plot()
    shown = {name: elements[name] for name in _SHOWN if name in elements}
    made["scene.png"] = figure("scene_figure", *flat(shown, world, seed=seed))
    made["deep.png"] = figure("deep_figure", deep(shown, world, seed=seed))
    return made


def heights_of(elements: Mapping[str, Element]) -> str:
    """A sentence on the heights of elements inside their aperture, by title."""
    ranges = {title: height_range(element) for title, element in elements.items()}
    listed = "; ".join(f"{title} {1e3 * (high - low):.3g} µm" for title, (low, high) in ranges.items())
    return f"Heights, largest less smallest inside the aperture: {listed}."


def _parts(
    table: Table,
    given: Sequence[Content],
    world: World,
    command: str,
    figures: Sequence[str],
    learned: Mapping[str, Element],
) -> list[str]:
    depths = ", ".join(map(depth_text, world.depths))
    colours = ", ".join(f"{1e3 * w:.0f}" for w in world.wavelengths)
    judged = ", ".join(f"{len(one.test)} {pictures_of(one.name)}" for one in given)
    others = ", ".join(str(len(one.train)) for one in given)
    contents = [(f"## {name[0].upper()}{name[1:]}", table.markdown(name)) for name in table.found]
    return [
        "# Extended depth of field with one phase element",
        f"    {command}",
        f"Aperture {2 * world.radius:g} mm, sensor at {world.sensor_distance:g} mm, {colours} nm, objects at {depths}; "
        f"pixels of {1e3 * world.pixel:g} µm, kernels of {world.size} × {world.size} pixels, light beyond them spread "
        f"evenly as haze; noise of standard deviation {world.noise:g}. All lenses are made for "
        f"{world.design / 1e3:g} m at 550 nm. Judged on {judged}, expected over noise, none drawn; filters are "
        f"made for {others} others. Learned elements know only the spectrum of sharp dead leaves.",
        *(part for parts in contents for part in parts),
        "PSNR in dB, mean over depths, of errors pooled over pictures and as the mean of the PSNRs of single pictures; "
        "in brackets the gain over the Fresnel lens. Worst: the worst depth, spread: the best less the worst, both "
        "behind the depth-invariant filter. Sitzmann 2018: as published by Sitzmann et al., SIGGRAPH 2018, of other "
        "pictures. "
        "All figures: [table.csv](wave/table.csv).",
        *([heights_of(learned)] if learned else []),
        *(picture(f"wave/{name}", CAPTIONS[name]) for name in figures),
    ]

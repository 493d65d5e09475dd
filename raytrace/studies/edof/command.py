"""`raytrace wave edof` and `raytrace wave table`: elements of extended depth of field, learned and compared."""

import argparse
import dataclasses
import json
import math
import tempfile
from collections.abc import Sequence
from pathlib import Path

import torch

from raytrace.camera.training import NotFinite, OtherSettings
from raytrace.cli.door import CommandError, print_json, say
from raytrace.cli.options import did_you_mean
from raytrace.cli.progress import progress
from raytrace.files import write_atomically
from raytrace.formats.pictures import NoPictures, Pictures, dead_leaves, files, read, split
from raytrace.plot.style import save
from raytrace.studies.codesign.page import below_the_mark
from raytrace.studies.codesign.setup import plain
from raytrace.studies.edof import figures as drawn
from raytrace.studies.edof.page import CAPTIONS, markdown
from raytrace.studies.edof.scene import deep, flat
from raytrace.studies.edof.table import NAMES, PUBLISHED, ROWS, Content, elements_of, records, table_of, write_records
from raytrace.studies.edof.training import EdofCamera, Settings, begin, learn_element
from raytrace.studies.edof.words import STARTS, STEPS
from raytrace.studies.edof.world import Quality, World, kernels, periodic, quality, spectrum
from raytrace.wave.element import Element, as_made, as_pixels
from raytrace.wave.element_file import write_element

_WIDE = 512  # pixels of a period that is restored
_LEAVES = 40  # pictures of dead leaves
#: Contents of dead leaves: name -> smallest radius, pixels.
LEAVES = {"sharp leaves": 2.5, "smooth leaves": 8.0}


def edof(arguments: argparse.Namespace) -> None:
    """Learn one element, or go on with it; then say what it is worth."""
    world, settings = _world(arguments), _settings(arguments)
    train, test = _pictures(arguments)
    folder = Path(arguments.output)
    camera = _learn(settings, world, train, folder, f"{settings.kind}, seed {settings.seed}")
    with torch.no_grad():
        elements = camera.variables()
        found = kernels(elements, world)
        own = quality(
            elements, world, train=periodic(train, _WIDE), test=periodic(test, _WIDE), seed=settings.seed, found=found
        )
    known = {"settings": settings, "world": world}
    document = plain({name: dataclasses.asdict(one) for name, one in known.items()} | dataclasses.asdict(own))
    write_atomically(folder / "outcome.json", lambda file: file.write(json.dumps(document, indent=1).encode()))
    made = as_made(elements[0]) if settings.kind == "rings" else as_pixels(elements[0], world.pixel)
    write_element(made, folder / "heights.npy", design_wavelength=world.wavelengths[len(world.wavelengths) // 2])
    if arguments.plot:
        save(drawn.element_figure(elements, found, own, world), arguments.plot)
    if arguments.json:
        print_json(document)
    else:
        _print_quality(own, world)
    say(f"written: {folder / 'outcome.json'}, {folder / 'heights.npy'}")


def table(arguments: argparse.Namespace) -> None:
    """Every row on every content; the page where --docs asks for it."""
    for option, given in (("rows", arguments.rows), ("also", arguments.also)):
        unknown = sorted(set(given or ()) - set(NAMES))
        if unknown:
            meant = did_you_mean(unknown[0], NAMES)
            raise CommandError(f"--{option} {' '.join(unknown)}: expected {', '.join(NAMES)}{meant}")
    rows = [*(arguments.rows or (name for name, *_ in ROWS)), *(arguments.also or ())]
    world = World()
    contents, train = _contents(arguments)
    learned = _learned(arguments, rows, world, train)
    elements = elements_of(rows, world, spectrum(contents[0].train), learned=learned)
    found = table_of(contents, elements, world, progress=lambda given: progress(given, "row"))
    if arguments.docs:
        _write_page(Path(arguments.docs), found, elements, world, arguments)
    if arguments.json:
        print_json({"rows": plain(records(found))})
    else:
        _print_table(found)


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
        noise=World.noise if arguments.noise is None else arguments.noise,
        exact=arguments.exact,
    )


def _settings(arguments: argparse.Namespace) -> Settings:
    kind = arguments.element
    if arguments.feature and kind != "rings":
        raise CommandError(f"--feature {arguments.feature:g}: a {kind} element has no rings; take --element rings")
    if arguments.tolerance and kind != "rings":
        raise CommandError(f"--tolerance {arguments.tolerance:g}: a {kind} element has no rings; take --element rings")
    return Settings(
        kind=kind,
        glass=arguments.glass or ("F_SILICA" if kind == "rings" else "PMMA"),
        terms=arguments.terms or (36 if kind == "zernike" else 7),
        levels=arguments.levels or 0,
        loss=arguments.loss,
        restoration=arguments.filter if arguments.loss == "images" else "blind",
        optimizer=arguments.optimizer,
        schedule=arguments.schedule,
        rate=arguments.rate,
        steps=arguments.steps,
        starts=arguments.starts,
        tolerance=1e-6 * (arguments.tolerance or 0.0),
        pitch=arguments.feature or Settings.pitch,
        noise=(arguments.noise, arguments.noise) if arguments.noise else Settings.noise,
        seed=arguments.seed,
    )


def _learn(settings: Settings, world: World, train: Pictures, folder: Path, label: str) -> EdofCamera:
    """A learned camera, trained as far as is left, with a bar."""
    S = spectrum(periodic(train, settings.size))
    try:
        camera, run = begin(settings, world, S, folder, progress=lambda given: progress(given, "start", what=label))
        bar, last = None, None
        for step, record in learn_element(camera, train, settings, run):
            bar = bar or progress(settings.steps, what=label, initial=step)
            bar.set_postfix_str(f"loss {record['loss']:.6f}", refresh=False)
            bar.update()
            last = record
        if bar is not None:
            bar.close()
            say(f"{label}: loss {last['loss']:.6f} after {settings.steps} steps")
        else:
            say(f"{label}: finished before, nothing to learn")
    except (NotFinite, OtherSettings) as error:
        raise CommandError(str(error)) from error
    return camera


def _pictures(arguments: argparse.Namespace) -> tuple[Pictures, Pictures]:
    """To learn from, and to restore."""
    if not arguments.data:
        return split(dead_leaves(_LEAVES, size=_WIDE // 2, seed=arguments.seed, smallest=LEAVES["sharp leaves"]))
    return split(_from_folder(arguments))


def _from_folder(arguments: argparse.Namespace) -> Pictures:
    try:
        paths = files(arguments.data)
        paths = [paths[i * len(paths) // arguments.limit] for i in range(min(arguments.limit, len(paths)))]
        return read(list(dict.fromkeys(paths)), least=_WIDE // 2, progress=lambda given: progress(given, "picture"))
    except NoPictures as error:
        raise CommandError(str(error)) from error


def _contents(arguments: argparse.Namespace) -> tuple[list[Content], Pictures]:
    """All contents of the table, and the pictures that elements are learned from: sharp leaves."""
    made = {
        name: dead_leaves(_LEAVES, size=_WIDE // 2, seed=arguments.seed, smallest=smallest)
        for name, smallest in progress(LEAVES.items(), "dead leaf")
    }
    learn_from = split(made["sharp leaves"])[0]
    if arguments.data:
        made["pictures"] = _from_folder(arguments)
    parts = {name: split(pictures) for name, pictures in made.items()}
    contents = [Content(name, *(periodic(part, _WIDE) for part in both)) for name, both in parts.items()]
    return contents, learn_from


def _learned(
    arguments: argparse.Namespace, rows: Sequence[str], world: World, train: Pictures
) -> dict[str, tuple[Element, ...]]:
    """The learned ones of the rows."""
    common = {"steps": arguments.steps, "starts": arguments.starts, "seed": arguments.seed}
    pictures = {"kind": "rings", "loss": "images", "restoration": "towards"}
    wanted = {
        "learned-smooth": Settings(kind="smooth", glass="PMMA", **common),
        "learned": Settings(kind="rings", **common),
        "learned-16": Settings(kind="rings", levels=16, **common),
        "learned-images": Settings(**pictures, **common),
        "learned-adadelta": Settings(**pictures, optimizer="adadelta", schedule="constant", rate=1.0, **common),
        "learned-zernike": Settings(
            kind="zernike", glass="PMMA", terms=22, spread=0.05, optimizer="adadelta", schedule="constant", rate=1.0,
            **common
        ),
    }  # fmt: skip
    asked = {name: own for name, own in wanted.items() if name in rows}
    with tempfile.TemporaryDirectory() as unkept:
        if asked and not arguments.output:
            say("learned elements are not kept: -o FOLDER keeps them")
        folder = Path(arguments.output or unkept)
        found = {}
        for name, settings in asked.items():
            camera = _learn(settings, world, train, folder / name, NAMES[name])
            with torch.no_grad():
                found[name] = camera.variables()
    return found


def _write_page(docs: Path, found, elements, world: World, arguments: argparse.Namespace) -> None:
    folder = docs / "wave"
    folder.mkdir(parents=True, exist_ok=True)
    write_records(found, folder / "table.csv")
    made = _figures(found, elements, world, arguments.seed)
    for name, figure in made.items():
        save(figure, folder / name)
    page = docs / "wave_edof.md"
    kept = below_the_mark(page.read_text()) if page.exists() else ""
    data = f"--data DIR --limit {arguments.limit} " if arguments.data else ""
    effort = "".join(
        f"--{name} {getattr(arguments, name)} "
        for name, usual in (("starts", STARTS), ("steps", STEPS))
        if getattr(arguments, name) != usual
    )
    also = f"--also {' '.join(arguments.also)} " if arguments.also else ""
    command = f"raytrace wave table {data}{effort}{also}-o FOLDER --docs docs"
    text = markdown(found, world, command=command, figures=[n for n in CAPTIONS if n in made], kept=kept)
    write_atomically(page, lambda file: file.write(text.encode()))
    say(f"written: {page}")


def _figures(found, elements, world: World, seed: int) -> dict:
    """Figures of the page, by file name. Only dead leaves are shown."""
    made = {"depth.png": drawn.depth_figure(found, world)}
    first = next(iter(found.values()))
    if "fresnel" in first:
        made["gain.png"] = drawn.gain_figure(found)
    for name in ("learned", "learned-smooth"):
        if name in elements:
            found_kernels = kernels(elements[name], world)
            made[f"{name}.png"] = drawn.element_figure(elements[name], found_kernels, first[name], world)
    shown = ("fresnel", "singlet", "ideal", "cubic-refractive", "learned")
    shown = {name: elements[name] for name in shown if name in elements}
    made["scene.png"] = drawn.scene_figure(*flat(shown, world, seed=seed))
    made["deep.png"] = drawn.deep_figure(deep(shown, world, seed=seed))
    return made


def _print_quality(own: Quality, world: World) -> None:
    print(
        f"{'object at':>12} {'Wiener':>9} {'invariant':>9}   PSNR of restored pictures, dB; invariant: the filter "
        "that knows no depth"
    )
    for i, depth in enumerate(world.depths):
        name = "infinity" if math.isinf(depth) else f"{depth / 1e3:.3g} m"
        print(f"{name:>12} {own.by_depth['wiener'][i]:>9.2f} {own.by_depth['blind'][i]:>9.2f}")
    print(f"{'mean':>12} {own.mean['wiener']:>9.2f} {own.mean['blind']:>9.2f}")
    print(f"{'spread':>12} {own.spread['wiener']:>9.2f} {own.spread['blind']:>9.2f}")
    lowest = min(min(row) for row in own.energy)
    print(f"light inside the window of {world.size} × {world.size} pixels: {lowest:.3f} or more")


def _print_table(found) -> None:
    for content in found:
        print(f"{content}: PSNR of restored pictures, dB (gain over the Fresnel lens)")
        print(f"{'':>32} {'Wiener':>14} {'invariant':>14} {'spread':>7} {'Sitzmann 2018':>14}")
        for record in (r for r in records(found) if r["content"] == content):
            published = (
                f"{record['published']:.2f} ({record['published'] - PUBLISHED['fresnel']:+.2f})"
                if record["published"]
                else ""
            )
            cells = [
                f"{record[f]:.2f}" + ("" if record[f"gain_{f}"] is None else f" ({record[f'gain_{f}']:+.2f})")
                for f in ("wiener", "blind")
            ]
            print(
                f"{NAMES[record['row']]:>32} {cells[0]:>14} {cells[1]:>14} {record['spread_blind']:>7.2f} "
                f"{published:>14}"
            )
        print()

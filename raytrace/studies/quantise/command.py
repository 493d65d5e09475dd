"""`raytrace wave quantise`."""

import argparse
import dataclasses
import tempfile
from collections.abc import Sequence
from pathlib import Path

from torch import Tensor

from raytrace.cli.door import CommandError, print_json
from raytrace.cli.options import did_you_mean
from raytrace.cli.progress import progress
from raytrace.formats.pictures import Pictures
from raytrace.studies.codesign.page import table
from raytrace.studies.edof.training import Settings
from raytrace.studies.edof.world import World, periodic, spectrum
from raytrace.studies.quantise.experiment import (
    WAYS,
    Judge,
    Steps,
    Tolerance,
    efficiency,
    law,
    learned,
    made,
    read,
    steps_of,
    tolerances_of,
)
from raytrace.studies.superres.command import folders, page, pictures, write_csv
from raytrace.wave.designs import aim, baseline, singlet
from raytrace.wave.element import Element
from raytrace.wave.element_file import read_element
from raytrace.wave.exchange import FORMATS


def quantise(arguments: argparse.Namespace) -> None:
    """Efficiency, expected PSNR over levels and tolerances; draw, write the page."""
    train, test, kind = pictures(arguments, 128)
    own, others = periodic(train, 256), periodic(test, 256)
    S = spectrum(own)
    steps: list[Steps] = []
    tolerances: list[Tolerance] = []
    for given in arguments.element:
        name, element, world = _element(arguments, given, train, S)
        judge, ways = Judge(world, S), _ways(arguments, given)
        rows, elements = steps_of(
            name,
            element,
            judge,
            others,
            levels=arguments.levels,
            ways=ways,
            steps=arguments.steps,
            progress=lambda cases: progress(cases, "element"),
        )
        steps += rows
        for way in ways:
            if way == "looped" and "trained" in ways:
                continue
            count = 0 if way == "whole" else 16 if 16 in arguments.levels else max(arguments.levels)
            made_so = elements[way, count]
            nm = (0.0, *arguments.tolerance)
            tolerances += tolerances_of(name, way, made_so, judge, nm=nm, seed=arguments.seed)
    etched = _etched(arguments.levels)
    document = {
        "efficiency": [{"levels": n, "law": law(n), "any_width": one, "rings": two} for n, one, two in etched],
        "levels": [dataclasses.asdict(row) for row in steps],
        "tolerance": [dataclasses.asdict(row) for row in tolerances],
    }
    if arguments.json:
        print_json({"pictures": kind, **document})
    else:
        print("\n\n".join(_text(rows) for rows in document.values()))
    if arguments.docs:
        _quantise_docs(arguments, kind, etched, steps, tolerances, document)


def _element(arguments, given: str, train: Pictures, S: Tensor) -> tuple[str, Element, World]:
    world = World()
    if given == "fresnel":
        (element,) = baseline("fresnel", aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design))
        return given, element, world
    if given != "learned" and Path(given).suffix.lower() in FORMATS and not Path(given).is_dir():
        made_of = read_element(
            given, aperture=arguments.aperture, glass=arguments.glass, pitch=arguments.pitch, span=arguments.span
        )
        return Path(given).name, made_of, dataclasses.replace(world, radius=0.5 * arguments.aperture)
    if given != "learned" and not Path(given).is_dir():
        raise CommandError(
            f"--element {given}: expected fresnel, learned, the folder of a run, or a height map "
            f"({', '.join(FORMATS)}){did_you_mean(given, ('fresnel', 'learned'))}"
        )
    try:
        return (Path(given).name, *read(given, S)) if given != "learned" else _learned(arguments, world, train, S)
    except ValueError as error:
        raise CommandError(str(error)) from error


def _learned(arguments, world: World, train: Pictures, S: Tensor) -> tuple[str, Element, World]:
    settings = Settings(steps=arguments.learn, starts=arguments.starts, seed=arguments.seed)
    with tempfile.TemporaryDirectory() as temporary:
        folder = arguments.output or temporary
        for _ in progress(learned(settings, world, S, train, folder), what="learning"):
            pass
        return "learned", *read(folder, S)


def _ways(arguments, given: str) -> list[str]:
    """Of WAYS, those asked for; a kinoform lives by its wraps."""
    if given == "fresnel":
        return ["wrapped"]
    whole = [] if arguments.wrap else ["whole"]
    if arguments.wrap is False:
        return whole
    return [*whole, "wrapped", *(("looped", "trained") if arguments.steps else ())]


def _etched(levels: Sequence[int]) -> list[tuple[int, float, float]]:
    """Efficiency of the Fresnel lens as it is and in rings of 2 µm, by levels; 0: any height."""
    world, made_for = World(), aim()
    (smooth,) = singlet(made_for)
    (rings,) = baseline("fresnel", made_for)
    found = []
    for count in (*levels, 0):
        found.append((count, *(efficiency(made(one, count, wrap=True), world) for one in (smooth, rings))))
    return found


def _text(rows: Sequence[dict]) -> str:
    """The table, and below it what the words in the column `made` mean."""
    known = [f"{way}: {WAYS[way]}" for way in dict.fromkeys(row["made"] for row in rows)]
    lines = [list(rows[0])] + [[_cell(value) for value in row.values()] for row in rows] if rows else []
    return "\n".join("  ".join(f"{cell:>12}" for cell in line) for line in lines) + "\n" + "; ".join(known)


def _cell(value) -> str:
    return f"{value:.4f}" if isinstance(value, float) else str(value)


def _quantise_docs(arguments, kind: str, etched, steps, tolerances, document: dict) -> None:
    from raytrace.plot.style import save
    from raytrace.studies.superres.figures import quantise_figure

    docs, folder = folders(arguments.docs)
    save(quantise_figure(etched, steps, tolerances), folder / "quantise.png")
    write_csv(document["levels"], folder / "quantise.csv")
    write_csv(document["tolerance"], folder / "quantise_tolerance.csv")
    page(docs / "wave_quantise.md", _quantise_page(arguments, kind, etched, steps, tolerances))


def _quantise_page(arguments, kind: str, etched, steps: Sequence[Steps], tolerances: Sequence[Tolerance]) -> list[str]:
    words = [f"--element {' '.join(arguments.element)} --levels {' '.join(map(str, arguments.levels))}"]
    words += [f"--tolerance {' '.join(f'{nm:g}' for nm in arguments.tolerance)} --steps {arguments.steps}"]
    words += ["--data DIR"] if arguments.data else []
    levels = [0, *arguments.levels]
    by = {(row.element, row.made, row.levels): row for row in steps}
    header = ("element", "how made", *(f"{n} levels" if n else "any height" for n in levels))
    kinds = list(dict.fromkeys((row.element, row.made) for row in steps))

    def of(column: str) -> str:
        return table(
            header,
            [(name, WAYS[way], *(f"{getattr(by[name, way, n], column):.2f}" for n in levels)) for name, way in kinds],
        )

    errors = [
        (row.element, WAYS[row.made], row.levels or "any", f"{row.nm:g}", f"{row.mean:.3f}",
         f"{row.least:.3f} … {row.greatest:.3f}")
        for row in tolerances
    ]  # fmt: skip
    return [
        "# What fabrication costs: levels, wrapping, errors of height",
        f"    raytrace wave quantise {' '.join(words)} --docs docs",
        "![Efficiency, levels and tolerance](wave/quantise.png)",
        "## A kinoform at its focus",
        table(
            ("levels", "sinc²(1/L)", "efficiency, steps of any width", "efficiency, rings of 2 µm"),
            [(n or "any", f"{law(n):.4f}", f"{one:.4f}", f"{two:.4f}") for n, one, two in etched],
        ),
        "Light at the focus over that of an ideal lens: 5 mm, f/7.1, 0.55 µm. The law is met where steps may be as "
        "narrow as they come; rings of 2 µm are too wide for the outermost zones of 4 µm.",
        "## Levels",
        "Expected PSNR in dB, in closed form, over 0.5 m to infinity at 460, 550 and 640 nm, behind the best filter "
        f"that knows no depth; {kind}, noise 0.01:",
        of("closed"),
        "The same of test pictures that the filter was not made for, mean over depths:",
        of("restored"),
        "## Errors of height",
        "The height of every ring in error by a uniform random number within ±, five draws each:",
        table(("element", "how made", "levels", "± nm", "mean PSNR (dB)", "draws"), errors),
    ]

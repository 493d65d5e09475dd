"""`raytrace wave superres`; and what it shares with `raytrace wave quantise`: pictures, pages and tables."""

import argparse
import csv
import dataclasses
import io
from collections.abc import Sequence
from pathlib import Path

from raytrace.camera.deconvolve import psnr
from raytrace.cli.door import print_json, say
from raytrace.cli.progress import progress
from raytrace.files import write_atomically
from raytrace.formats.pictures import Pictures, dead_leaves, files, split
from raytrace.formats.pictures import read as read_pictures
from raytrace.studies.codesign.page import KEPT, below_the_mark, table
from raytrace.studies.edof.world import World, periodic, spectrum
from raytrace.studies.superres.experiment import (
    Plate,
    Row,
    full_frame,
    hologram,
    learn_heights,
    learned_lens,
    lens,
    multiplexed,
    parts_of_a_pixel,
    places_of,
    sectors,
    small_scenes,
    wide_kernels,
    world_of,
)
from raytrace.studies.superres.experiment import kernels as kernels_of
from raytrace.studies.superres.inversion import least_error

_NOISES = (0.0003, 0.001, 0.003, 0.01, 0.03)


def pictures(arguments: argparse.Namespace, least: int) -> tuple[Pictures, Pictures, str]:
    """To make filters for, to restore, and what they are."""
    if not arguments.data:
        return *split(dead_leaves(arguments.limit, size=least, seed=arguments.seed)), "dead leaves"
    paths = files(arguments.data)
    if arguments.limit < len(paths):
        paths = [paths[i * len(paths) // arguments.limit] for i in range(arguments.limit)]
    return *split(read_pictures(paths, least=least, progress=lambda given: progress(given, "picture"))), "pictures"


# --- super-resolution


@dataclasses.dataclass(frozen=True)
class _Block:
    """One camera: what a scene that fills its sensor and a small one are restored to, and the bounds, dB."""

    factor: int
    wavelengths: tuple[float, ...]
    full: list[Row]
    full_bound: float
    small: list[Row]
    small_bound: float
    drawn: dict


_COLUMNS = ("scene", "optics and restoration", "expected", "restored", "over bicubic")


def superres(arguments: argparse.Namespace) -> None:
    """Learn, restore and compare; draw, write the page."""
    train, test, kind = pictures(arguments, 96)
    cameras = [(factor, tuple(colours)) for factor in arguments.factor for colours in arguments.wavelength or [[0.55]]]
    blocks = [_block(arguments, factor, colours, train, test) for factor, colours in progress(cameras, "camera")]
    noises = _over_noise(arguments, train, test) if arguments.docs else []
    if arguments.json:
        print_json({"noise": arguments.noise, "pictures": kind, "cameras": [_document(block) for block in blocks]})
    else:
        for block in blocks:
            print(
                f"pixels × {block.factor}, {_colours(block.wavelengths)}, noise {arguments.noise:g}, {kind}; PSNR in dB"
            )
            for scene, name, closed, restored, gain in [_COLUMNS, *_table_rows(block)]:
                print(f"{scene:>12} {name:<32} {closed:>8} {restored:>8} {gain:>12}")
    _draw(arguments, blocks[0], kind, noises, blocks)


def _block(arguments, factor: int, colours: tuple[float, ...], train: Pictures, test: Pictures) -> _Block:
    world = world_of(colours, noise=arguments.noise)
    own, others = periodic(train, 192), periodic(test, 192)
    S = spectrum(own)
    best = learned_lens(world, S, factor, starts=arguments.starts, steps=arguments.steps, seed=arguments.seed)
    elements = {"plain lens": lens(world), "learned": best}
    full = full_frame(elements, world, factor, train=own, test=others, seed=arguments.seed)
    small, small_bound, drawn = _small(arguments, world, factor, train, test, arguments.places)
    drawn |= {
        "picture": others[0],
        "lens": kernels_of(elements["plain lens"], world),
        "learned": kernels_of(best, world),
    }
    return _Block(factor, colours, full, float(psnr(least_error(S, factor))), small, small_bound, drawn)


def _small(arguments, world: World, factor: int, train: Pictures, test: Pictures, counts: Sequence[int]):
    """Rows of the small scene, its bound, and what is drawn of the last one."""
    own, others = small_scenes(train), small_scenes(test)
    S = spectrum(own)
    rows, drawn = full_frame({"plain lens": lens(world)}, world, factor, train=own, test=others), {"scene": others[0]}
    for count in counts:
        plate = Plate(world, places_of(count), parts_of_a_pixel(count, factor))
        start = hologram(plate, seed=arguments.seed)
        plates = {"sectors": sectors(plate), "phase of the sum": start}
        plates["learned"] = learn_heights(plate, start, S, factor, steps=arguments.steps)
        for name, elements in plates.items():
            kernel = wide_kernels(elements, world)
            row, sensor = multiplexed(f"{count} places, {name}", kernel, plate, factor, train=own, test=others)
            rows.append(row)
            drawn |= {"plate": kernel, "sensor": sensor[0], "row": row}
    return rows, float(psnr(least_error(S, factor))), drawn


def _over_noise(arguments, train: Pictures, test: Pictures) -> list[dict]:
    """The small scene of the first camera at several noises, everything made for each."""
    colours = (arguments.wavelength or [[0.55]])[0]
    found = []
    for noise in progress(_NOISES, "noise"):
        world = world_of(colours, noise=noise)
        rows, _, _ = _small(arguments, world, arguments.factor[0], train, test, arguments.places[:1])
        found.append({"noise": noise, **{row.name: row.psnr for row in rows}})
    return found


def _colours(wavelengths: Sequence[float]) -> str:
    return f"{', '.join(f'{1e3 * w:.0f}' for w in wavelengths)} nm"


def _table_rows(block: _Block) -> list[tuple[str, str, str, str, str]]:
    rows = []
    for scene, found, bound in (
        ("full frame", block.full, block.full_bound),
        ("small", block.small, block.small_bound),
    ):
        for row in found:
            closed = "–" if row.closed is None else f"{row.closed:.2f}"
            rows.append((scene, row.name, closed, f"{row.psnr:.2f}", f"{row.psnr - found[0].psnr:+.2f}"))
        rows.append((scene, "upper bound of one image", f"{bound:.2f}", "–", "–"))
    return rows


def _document(block: _Block) -> dict:
    def plain(rows: Sequence[Row]) -> list[dict]:
        return [
            {"name": row.name, "closed_form": row.closed, "psnr": row.psnr, "by_colour": list(row.by_colour)}
            for row in rows
        ]

    return {
        "factor": block.factor,
        "wavelengths": list(block.wavelengths),
        "full_frame": plain(block.full),
        "full_frame_bound": block.full_bound,
        "small_scene": plain(block.small),
        "small_scene_bound": block.small_bound,
    }


def _draw(arguments, block: _Block, kind: str, noises: list[dict], blocks: Sequence[_Block]) -> None:
    if not (arguments.plot or arguments.docs):
        return
    from raytrace.plot.style import save
    from raytrace.studies.superres.figures import superres_figure

    drawn, middle = block.drawn, len(block.wavelengths) // 2
    figure = superres_figure(
        block.full,
        drawn["picture"],
        [*block.small[:2], drawn["row"]],
        drawn["scene"],
        {"plain lens": drawn["lens"][middle], "learned": drawn["learned"][middle], "plate": drawn["plate"][middle]},
        drawn["sensor"][middle],
    )
    if arguments.plot:
        save(figure, arguments.plot)
        say(f"written: {arguments.plot}")
    if arguments.docs:
        docs, folder = folders(arguments.docs)
        if kind == "dead leaves":  # pictures of others are not for pages
            save(figure, folder / "superres.png")
        write_csv(noises, folder / "superres_noise.csv")
        lines = [
            {"factor": one.factor, "colours": _colours(one.wavelengths), "scene": scene, "way": name, "closed": closed,
             "restored": restored, "gain": gain}
            for one in blocks
            for scene, name, closed, restored, gain in _table_rows(one)
        ]  # fmt: skip
        write_csv(lines, folder / "superres.csv")
        page(docs / "wave_superres.md", _superres_page(arguments, blocks, kind, noises))


def _superres_page(arguments, blocks: Sequence[_Block], kind: str, noises: list[dict]) -> list[str]:
    words = [f"--factor {' '.join(map(str, arguments.factor))}"]
    words += [f"--wavelength {' '.join(f'{w:g}' for w in colours)}" for colours in arguments.wavelength or []]
    words += [f"--noise {arguments.noise:g} --places {' '.join(map(str, arguments.places))} --steps {arguments.steps}"]
    words += ["--data DIR"] if arguments.data else []
    parts = [
        "# Super-resolution: pictures finer than the sensor's pixels, from one exposure",
        f"    raytrace wave superres {' '.join(words)} --docs docs",
        f"A camera of 5 mm aperture with its sensor at 35.5 mm looks at scenes 1 m away. The picture has pixels of "
        f"3.69 µm, the sensor pixels 2 or 3 times as large, noise {arguments.noise:g} (white is 1). Filters are made "
        f"for some {kind} and restore others. PSNR in dB of restored test pictures, over all colours; *expected*: "
        "the error of the filter in closed form, for pictures of the power spectrum it was made for; MMSE: the linear "
        "filter of least mean square error; *over bicubic*: gain over the plain lens and bicubic enlargement.",
        "![Restored pictures and kernels](wave/superres.png)",
        "*Above, a scene that fills the sensor; below, a small one on a dark ground, shown at several places of one "
        "sensor and inverted jointly. Kernels on a logarithmic scale of four decades.*",
    ]
    for block in blocks:
        parts.append(f"## Pixels × {block.factor}, {_colours(block.wavelengths)}")
        parts.append(table(_COLUMNS, _table_rows(block)))
    if noises:
        columns = list(noises[0])
        rows = [
            tuple(f"{one[name]:g}" if name == "noise" else f"{one[name]:.2f}" for name in columns) for one in noises
        ]
        parts += [
            f"## The small scene over noise, pixels × {arguments.factor[0]}",
            table(columns, rows),
            "Elements and filters are made anew for each noise. The places share the light: each copy has a third or a "
            "quarter of it, with the noise of a whole image.",
        ]
    return [*parts, _SUPERRES_TEXT]


_SUPERRES_TEXT = """## What it shows

* **A scene that fills the sensor**: behind pixels s times as large, every spatial frequency of the image holds the
  sum of s² aliased frequencies of the scene. By the expected error, no PSF can do better than to pass the strongest
  of them and to suppress the others (*upper bound of one image*): the learned element is a better low-pass filter
  than the lens, no more. Restored test pictures may lie above the bound, because their power spectrum is not that of
  the pictures which the filter was made for. Showing such a scene at three places does not help: the copies overlap
  and add up to one image.
* **A small scene on a dark ground**: copies that do not overlap are independent measurements, and joint inversion
  separates aliased frequencies that one image cannot. Wedges on sectors of the aperture lose no light, but each sector
  has a wider blur than the whole aperture; a plate with the phase of the sum of all tilted waves keeps the narrow blur.
  PSNR is that of the whole field, dark ground included, for every row.
* **What it costs**: light, and sensor. The copies take three or four times the pixels of one image: a lens of twice the
  focal length would magnify the small scene to as many. In strong noise the light is better kept together: the learned
  plate then gives up places."""


# --- files


def folders(docs: str) -> tuple[Path, Path]:
    folder = Path(docs) / "wave"
    folder.mkdir(parents=True, exist_ok=True)
    return Path(docs), folder


def page(path: Path, parts: Sequence[str]) -> None:
    kept = below_the_mark(path.read_text(encoding="utf-8")) if path.exists() else ""
    text = "\n\n".join([*parts, f"{KEPT}\n{kept}".strip()]) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))
    say(f"written: {path}")


def write_csv(rows: Sequence[dict], path: Path) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: round(v, 4) if isinstance(v, float) else v for k, v in row.items()} for row in rows)
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))

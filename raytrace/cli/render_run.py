"""`raytrace render`: pictures as a lens and a sensor record them."""

import argparse
import dataclasses
import inspect
import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

import raytrace
from raytrace.cli.progress import Bar, Lines, progress
from raytrace.cli.runner import CommandError, open_lens, options_of, say
from raytrace.cli.types import OutputFolder
from raytrace.imaging.image import linearised
from raytrace.imaging.render import checked_depth, default_sensor
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.spectral_response import channel_names, read_response
from raytrace.io.pictures import read_depth, read_levels
from raytrace.maths.result import Result
from raytrace.system.lens import Lens


@dataclasses.dataclass(frozen=True, repr=False)
class RenderedPictures(Result):
    """A text and a record each; record: file, written (None without -o), and the document of the rendering."""

    texts: tuple[str, ...]
    records: tuple[dict, ...]

    def document(self) -> dict:
        return {"pictures": [*self.records]}

    def __str__(self) -> str:
        if len(self.texts) == 1:
            return self.texts[0]
        return "\n".join(f"{record['file']}\n{text}" for record, text in zip(self.records, self.texts, strict=True))


@torch.no_grad()
def render_files(arguments: argparse.Namespace) -> RenderedPictures:
    """Render and write pictures one after the other; all are read once before the first is rendered."""
    files, targets = arguments.picture, _targets(arguments.picture, arguments.output)
    options = {name: value for name, value in options_of(arguments).items() if name in _names(raytrace.render)}
    for name in ("picture", "sensor", "progress", "sensor_distance"):  # the last one is of the lens
        options.pop(name, None)
    lens, options["depth"] = open_lens(arguments), _depth(arguments)
    if arguments.background is not None:
        options["background"] = linearised(read_levels(arguments.background))
    if arguments.raw and any(target is not None and target.suffix == ".png" for target in targets):
        raise CommandError("--raw writes light: expected -o with a .tif or .npy file")
    pictures = [_picture(arguments, lens, file, options["depth"]) for file in files]
    texts, records, rendering = [], [], None
    for number, file in enumerate(progress(files, "picture", what="render") if len(files) > 1 else files):
        load, sensor = pictures[number]
        with _named(arguments.lens), progress(1, "convolution", what=f"render {file}") as bar:
            advance = partial(_advance, bar)
            if rendering is None or rendering.optics.sensor != sensor:
                rendering = raytrace.render(lens, load(), sensor=sensor, **options, progress=advance)
            else:
                how = {"background": options.get("background"), "boundary": options["boundary"], "progress": advance}
                rendering = rendering.with_picture(load(), options["depth"], **how)
            capture = rendering.raw if arguments.raw else rendering.demosaiced
            recorded = capture(torch.tensor(number), arguments.seed)
        target = targets[number]
        if target is not None:
            target.parent.mkdir(parents=True, exist_ok=True)
            recorded.save(target, arguments.png_bits)
            say(f"written: {target}")
        if path := arguments.plot:
            path = Path(path) if len(files) == 1 else Path(path).with_stem(f"{Path(path).stem}_{Path(file).stem}")
            recorded.plot(path)
            say(f"written: {path}")
        written = None if target is None else str(target)
        records.append({"file": str(file), "written": written, **recorded.document()})
        texts.append(str(recorded))
    arguments.plot = arguments.output = None
    return RenderedPictures(tuple(texts), tuple(records))


def _advance(bar: Bar | Lines, done: int, total: int) -> None:
    """Move the progress of a picture, whose number of convolutions is known when its kernels are."""
    bar.total = total
    bar.update(done)


def _names(function: Callable) -> set[str]:
    return {*inspect.signature(function).parameters}


@contextmanager
def _named(name: str) -> Iterator[None]:
    """Errors within the block begin with the name of their file."""
    try:
        yield
    except ValueError as error:
        raise CommandError(f"{name}: {error}") from error


def _targets(files: list[str], output: str | None) -> Sequence[Path | None]:
    """The file to write of every picture."""
    if output is None:
        return [None] * len(files)
    if not isinstance(output, OutputFolder):
        if len(files) > 1:
            raise CommandError(f"-o {output}: {len(files)} pictures; expected the name of a folder")
        return [Path(output)]
    twice = [name for name, count in Counter(Path(file).stem for file in files).items() if count > 1]
    if twice:
        raise CommandError(f"-o {output}: several pictures would be {twice[0]}.png there; give them other names")
    targets = [Path(output) / f"{Path(file).stem}.png" for file in files]
    for target in targets:
        if os.path.realpath(target) in map(os.path.realpath, files):
            raise CommandError(f"-o {output}: {target} is a picture to render; give another folder")
    return targets


def _depth(arguments: argparse.Namespace) -> Tensor | None:
    if arguments.depth is None:
        if arguments.depth_range:
            raise CommandError("--depth-range is that of a picture --depth MAP: give the map")
        return None
    depth = torch.as_tensor(read_depth(arguments.depth, arguments.depth_range))
    with _named(arguments.depth):
        return checked_depth(depth, depth)


def _picture(
    arguments: argparse.Namespace, lens: Lens, file: str, depth: Tensor | None
) -> tuple[Callable[[], Tensor], Sensor]:
    """How to read a picture as light (C, H, W), and its sensor."""
    names = _names(Sensor) - {"size"}  # which is --sensor; --size is the window of the kernels
    options = {name: value for name, value in vars(arguments).items() if name in names and value is not None}
    channels = None
    if "response" in options:
        options["response"] = read_response(options["response"])
        channels = len(channel_names(options["response"]))

    def load() -> Tensor:
        return linearised(read_levels(file, channels))

    light = load()
    rows, columns = light.shape[-2:]
    if depth is not None and depth.shape != (rows, columns):
        size = f"{depth.shape[1]} × {depth.shape[0]}"
        raise CommandError(
            f"{arguments.depth}: a depth map of {size} pixels; expected {columns} × {rows}, those of {file}"
        )
    with _named(file):
        return load, default_sensor(lens, light, size=arguments.sensor, **options)

"""Latency of the viewer by percentile: from an event of a slider to the reply with all new numbers, as JSON.

Every event moves a curvature or a thickness of the lens by up to 1 %, as a drag does. Elapsed time and processor time:
other processes on the machine lengthen the second less.
"""

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

import raytrace as rt
from raytrace.system.lens import Lens
from raytrace.viewer import compute
from raytrace.viewer.session import Session
from raytrace.viewer.state import shown_fields

PERCENTILES = 5, 50, 95, 99
FIRST = 20  # events that are not counted


def percentiles(name: str, work: Callable[[int], object], count: int) -> str:
    """A line of the table: percentiles of the milliseconds that the work takes, elapsed and of the processor."""
    found = []
    for k in range(count):
        started = time.perf_counter(), time.process_time()
        work(k)
        found.append((time.perf_counter() - started[0], time.process_time() - started[1]))
    figures = 1e3 * np.percentile(found, PERCENTILES, axis=0).T
    return f"{name:<28} " + "   ".join(" ".join(f"{figure:>8.1f}" for figure in line) for line in figures)


def events(lens: Lens, count: int) -> Iterator[dict]:
    """Drags of all curvatures and thicknesses in turn, of 20 events each."""
    numbers = [(k, "thickness", float(one.thickness)) for k, one in enumerate(lens.surfaces[1:-1], 1)]
    bent = [(k, one.curvature) for k, one in enumerate(lens.surfaces) if one.curvature is not None]
    numbers += [(k, "curvature", float(curvature)) for k, curvature in bent]
    for k in range(count):
        surface, quantity, value = numbers[k // 20 % len(numbers)]
        value *= 1 + 0.01 * math.sin(2 * math.pi * (k % 20) / 20)
        yield {"type": "edit", "surface": surface, "quantity": quantity, "value": value, "drag": True}


def measure(arguments: argparse.Namespace) -> None:
    torch.set_num_threads(1)  # as the server does
    lens = rt.read_lens(arguments.lens)
    session, todo = Session(lens), [*events(lens, arguments.events + FIRST)]
    for event in todo[:FIRST]:
        if message := session.answer(event)["message"]:
            raise ValueError(message)
    fields = shown_fields(lens)
    print(f"{arguments.lens}: {fields.shape[1]} fields, {len(lens.wavelengths)} wavelengths")
    heads = " ".join(f"{f'p{p}, ms':>8}" for p in PERCENTILES)
    print(f"{'':<28} {'elapsed':>{len(heads)}}   {'processor':>{len(heads)}}\n{'':<28} {heads}   {heads}")
    answer = lambda k: json.dumps(session.answer(todo[FIRST + k]))  # noqa: E731
    print(percentiles("event to new numbers", answer, arguments.events))
    if arguments.parts:
        state = session.state
        with torch.no_grad():
            for name, work in {
                "  layout": lambda k: compute.layout_of(lens, fields),
                "  spots": lambda k: compute.spots_of(lens, fields),
                "  ray fans": lambda k: compute.fans_of(lens, fields),
                "  MTF of rays": lambda k: compute.mtf_of(lens, fields, state.frequency),
                "  field curves": lambda k: compute.curvature_of(lens),
                "  first-order data": lambda k: compute.first_order_of(lens),
                "  prescription": lambda k: compute.prescription(state),
            }.items():
                print(percentiles(name, work, 50))
        print(percentiles("MTF of diffraction, a field", lambda k: compute.mtf_of_field(session.state, 1), 5))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lens", nargs="?", default="cooke_triplet", help="lens file, or the name of a shipped lens")
    parser.add_argument("--events", type=int, default=300, help="drags that are timed (default 300)")
    parser.add_argument("--parts", action="store_true", help="time the analyses one by one, too")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    measure(parser.parse_args(argv))


if __name__ == "__main__":
    sys.exit(main())

"""Latency of the viewer by percentile: from an event of a slider to the reply with all new numbers, as JSON.

python docs/experiments/viewer_latency.py [LENS] [EVENTS] [--parts]

Every event moves a curvature or a thickness of the lens. --parts also times the analyses one by one.
"""

import json
import sys
import time

import numpy as np
import torch

import raytrace as rt
from raytrace.viewer import compute
from raytrace.viewer.session import Session
from raytrace.viewer.state import shown_fields

PERCENTILES = 5, 50, 95, 99


def percentiles(name: str, seconds: list[float]) -> str:
    figures = " ".join(f"{figure:>8.1f}" for figure in np.percentile(1e3 * np.array(seconds), PERCENTILES))
    return f"{name:<28} {figures}"


def timed(work, count: int) -> list[float]:
    found = []
    for k in range(count):
        started = time.perf_counter()
        work(k)
        found.append(time.perf_counter() - started)
    return found


def events(lens, count: int):
    """Drags of all curvatures and thicknesses in turn, each by up to 1 %, and back."""
    numbers = [(k, "thickness", float(one.thickness)) for k, one in enumerate(lens.surfaces[1:-1], 1)]
    numbers += [
        (k, "curvature", float(one.curvature)) for k, one in enumerate(lens.surfaces) if one.curvature is not None
    ]
    for k in range(count):
        surface, quantity, value = numbers[k // 20 % len(numbers)]
        value *= 1 + 0.01 * np.sin(2 * np.pi * (k % 20) / 20)
        yield {"type": "edit", "surface": surface, "quantity": quantity, "value": value, "drag": True}


def main(name: str = "cooke_triplet", count: str = "400", *options: str) -> None:
    torch.set_num_threads(1)  # as the server does
    lens = rt.read_lens(name)
    session = Session(lens)
    todo = [*events(lens, int(count) + 20)]
    for event in todo[:20]:
        session.answer(event)
    fields, wavelengths = shown_fields(lens).shape[1], len(lens.wavelengths)
    print(f"{name}: {fields} fields, {wavelengths} wavelengths, {torch.get_num_threads()} threads")
    print(f"{'':<28} " + " ".join(f"{f'p{p}, ms':>8}" for p in PERCENTILES))
    print(percentiles("event to new numbers", timed(lambda k: json.dumps(session.answer(todo[20 + k])), int(count))))
    if "--parts" in options:
        state, fields = session.state, shown_fields(lens)
        with torch.no_grad():
            for words, work in {
                "  layout": lambda k: compute.layout_of(lens, fields),
                "  spots": lambda k: compute.spots_of(lens, fields),
                "  ray fans": lambda k: compute.fans_of(lens, fields),
                "  MTF of rays": lambda k: compute.mtf_of(lens, fields, state.frequency),
                "  field curves": lambda k: compute.curvature_of(lens),
                "  first-order data": lambda k: compute.first_order_of(lens),
                "  prescription": lambda k: compute.prescription(state),
            }.items():
                print(percentiles(words, timed(work, 50)))
        print(percentiles("MTF of diffraction, a field", timed(lambda k: compute.mtf_of_field(session.state, 1), 5)))


if __name__ == "__main__":
    main(*sys.argv[1:])

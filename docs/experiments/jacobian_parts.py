"""Processor time of the derivatives of the optimiser's rays, by parts, and of the same by `rt.jacobian`.

126 rays of the double Gauss (3 fields, 3 wavelengths, 14 points of the pupil) by 21 variables, one thread.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import numpy as np
import torch

import raytrace as rt
from raytrace.maths.numerics import Dual
from raytrace.optimization.lens_state import Bundle
from raytrace.optimization.variables import design_variables
from raytrace.tracing.compiled import trace_engine

VARY, FIELDS = "curvature thickness", (0.0, 0.5, 1.0)


def milliseconds(call: Callable[[], object], repeats: int) -> float:
    """Median of several calls, after one that is not counted."""
    times = []
    for _ in range(repeats + 1):
        start = time.process_time()
        call()
        times.append(time.process_time() - start)
    return 1e3 * statistics.median(times[1:])


def parts(lens: rt.Lens, repeats: int) -> dict[str, float]:
    """ms of each step."""
    pupil = rt.maths.gauss_rings(2, 7)
    model = design_variables(lens, VARY)
    bundle = Bundle(model.views[0], len(lens.surfaces) - 1)
    for wavelength in range(len(lens.wavelengths)):
        for height in FIELDS:
            for point in pupil[0].T.tolist():
                bundle.ask(wavelength, (0.0, height), point)
    x = Dual(model.start, np.eye(len(model.start)))
    state = model.views[0].state(x)
    launched = bundle.launched(state)
    fields = [height * float(lens.fields.extent) for height in FIELDS]

    def first_order():
        moved = model.views[0].state(x)
        return moved.gaussian(moved.primary), moved.entrance_pupil_diameter, moved.field_scale

    def jacobian():
        return rt.jacobian(lens, VARY, fields=fields, pupil=pupil)

    return {
        "numbers of the lens": milliseconds(lambda: model.views[0].state(x), repeats),
        "and first-order data": milliseconds(first_order, repeats),
        "and launch, aiming": milliseconds(lambda: bundle.launched(model.views[0].state(x)), repeats),
        "and trace: all of the optimiser's": milliseconds(lambda: bundle.hits(model.views[0].state(x)), repeats),
        "of it the trace": milliseconds(lambda: bundle._traced(state, *launched), repeats),
        "variables of `rt.jacobian`": milliseconds(lambda: design_variables(lens, VARY).views, repeats),
        "`rt.jacobian`": milliseconds(jacobian, repeats),
    }


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--repeats", metavar="N", type=int, default=50, help="calls, whose median is printed")


def main(argv: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    options(parser)
    repeats = parser.parse_args(argv).repeats
    torch.set_num_threads(1)
    rt.tracing.prepare()
    lens = rt.read_lens("double_gauss").at(ray_aiming="off")
    aimed = lens.at(ray_aiming="real")
    columns = [parts(lens, repeats), parts(aimed, repeats)]
    with trace_engine("eager"):
        columns.append(parts(lens, max(repeats // 5, 1)))
    print("| ms | not aimed | real ray aiming | not aimed, without a compiler |\n|---|---:|---:|---:|")
    for name in columns[0]:
        print(f"| {name} | " + " | ".join(f"{column[name]:.2f}" for column in columns) + " |")


if __name__ == "__main__":
    main()

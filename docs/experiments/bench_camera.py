"""Figure of docs/bench_camera.md: seconds of `raytrace bench camera`, drawn from its JSON document.

raytrace bench camera --repeats 15 --threads 2 -o camera.json
python docs/experiments/bench_camera.py camera.json docs/bench_camera.png
"""

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from raytrace.plotting.style import new_figure, save, styled


@styled
def figure(rows: Sequence[Mapping]) -> Figure:
    """Seconds of the step and of the pictures, preparation included."""
    drawing = new_figure(7.0, 0.6 + 0.5 * len(rows))
    axes = drawing.subplots()
    names = [row["what"] + ("" if row["tol"] is None else f", {row['tol']:g}") for row in rows]
    axes.barh(names, [row["seconds"] + (row["prepared"] or 0.0) for row in rows])
    axes.set(xscale="log", xlabel="seconds")
    axes.invert_yaxis()
    return drawing


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("document", type=Path, help="JSON document of the command")
    parser.add_argument("figure", help="file to write (.png, .pdf, .svg)")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    options(parser)
    arguments = parser.parse_args(argv)
    save(figure(json.loads(arguments.document.read_text(encoding="utf-8"))["rows"]), arguments.figure)


if __name__ == "__main__":
    sys.exit(main())

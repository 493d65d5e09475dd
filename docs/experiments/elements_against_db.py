"""Restored dB against the number of elements: lenses designed by their spots, and by the error behind a Wiener filter.

    python docs/experiments/elements_against_db.py --data DIR -o FOLDER   # runs what the CSV lacks
    python docs/experiments/elements_against_db.py --data DIR -o FOLDER --moves   # the route by moves alone
    python docs/experiments/elements_against_db.py --table                # prints the table of docs/reference/search.md
    python docs/experiments/elements_against_db.py --plot                 # draws the figure

f = 50 mm, F/4, fields of 0, 9.8 and 14°, F, d and C of equal weight, a grey sensor of 5 µm pixels with noise of 0.02,
spheres of N-LAK9 and N-SF5. Every lens begins at plane plates: `rt.search` with 16 starts of a seed. Both designs of a
seed have the same starts.

- `spots`: the minimum of the mean square spot.
- `restoration`: the best of these minima are followed to minima of the error behind a Wiener filter, by lifted least
  squares.

Each has a second route: the best lens of one element more, of the same design and seed, loses each of its elements in
turn (`delete`). A third route leads by moves from the three plates of a seed to lenses of one to five elements
(`insert split delete`), of the glasses that these give: one search, whose time is shared equally by the five numbers.
The best lens of a design, by what it minimises, counts. As the error takes longer, the design by spots has further
starts from plates until its processor time is that of the other.

The test is by other fields (0, 3.5, 7, 10.5 and 14°), 16 times the rays, and pictures that are in no training: one
patch of each, blurred at one of the fields, noisy, behind the Wiener filter of its field. Diffraction is neglected.
"""

import argparse
import csv
import itertools
import json
import math
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from second_order_network import kernels_of, transfer_of
from torch import Tensor

import raytrace as rt
from raytrace.imaging.closed_form import patch_spectrum
from raytrace.imaging.image import blur, transfer_functions
from raytrace.imaging.pictures import Pictures, crop, files, read, split
from raytrace.imaging.restoration import depth_invariant_density, depth_invariant_wiener, restore
from raytrace.optimization.quantities import Points
from raytrace.optimization.search import Searched as Found
from raytrace.plotting import style
from raytrace.tracing.compiled import prepare

ROWS = Path(__file__).parents[1] / "elements_against_db.csv"
FIGURE = ROWS.with_suffix(".png")
F, F_NUMBER, FIELDS, WAVES = 50.0, 4.0, (0.0, 9.8, 14.0), (0.4861327, 0.5875618, 0.6562725)
PIXEL, NOISE = 0.005, 0.02
SIZE, RINGS = 32, 12  # of the loss: pixels and rings of rays
TEST_FIELDS, TEST_RINGS, PATCH, WINDOW = (0.0, 3.5, 7.0, 10.5, 14.0), 48, 96, 127
ELEMENTS, SEEDS, STARTS = ((3, 4, 2), (1, 5)), 3, 16  # the numbers of elements in the middle come first
DESIGNS = "spots", "restoration"
NAMES = {"spots": "least spots", "restoration": "least error behind the filter"}
LIMIT = "no aberrations"
#: The glasses from the front, and the number of elements in front of the stop.
GLASSES = {1: ("A", 1), 2: ("AB", 1), 3: ("ABA", 2), 4: ("ABAA", 2), 5: ("AABBA", 3)}
GLASS = {"A": "N-LAK9", "B": "N-SF5"}
HOW = dict(
    merit=rt.optimization.DefaultMerit("spot", glass_thickness=(1.5, 8), air_thickness=(0.5, 12), edge=1),
    vary="curvature thickness", hold=f"efl={F:g}", bounds="sensor:15..60",
)  # fmt: skip
COLUMNS = (
    *("elements", "seed", "design", "route", "seconds", "merit", "error", "between", "pictures"),
    *("restored", "low", "high"),
)


def plates(elements: int) -> rt.Lens:
    """Plane plates 4 mm thick, 4 mm apart."""
    kinds, before = GLASSES[elements]
    rows: list[dict] = []
    for number, kind in enumerate(kinds, 1):
        rows += [dict(radius=math.inf, thickness=4, glass=GLASS[kind]), dict(radius=math.inf, thickness=4)]
        if number == before:
            rows.append(dict(radius=math.inf, thickness=4))
            stop = len(rows)
    return rt.lens(
        rows, name=f"{elements} elements", stop=stop, entrance_pupil_diameter=F / F_NUMBER, fields=list(FIELDS),
        wavelengths=list(WAVES), primary_wavelength=2, catalogs=["schott"],
    )  # fmt: skip


class WienerError:
    """Mean square error () of a pixel behind the Wiener filters of all fields, of landing points (2, 1, F, W, P)."""

    def __init__(self, spectrum: Tensor):
        self.spectrum = spectrum

    def __call__(self, points: Tensor) -> Tensor:
        transfer = transfer_of(points, PIXEL, len(self.spectrum))
        return depth_invariant_density(transfer, self.spectrum, NOISE).mean()


class Test:
    """Restored pictures of a lens."""

    def __init__(self, train: Pictures, test: Pictures):
        self.size = PATCH + WINDOW - 1
        self.spectrum = patch_spectrum(train, self.size, crops=1)
        patches = [crop(test, sample, epoch=0, size=self.size, crops=1) for sample in range(len(test))]
        self.patches = torch.as_tensor(np.stack(patches))
        edge = WINDOW // 2
        self.target = self.patches[:, edge:-edge, edge:-edge]

    @torch.no_grad()
    def __call__(self, lens: rt.Lens) -> Tensor:
        """Mean square error (N,) of every picture."""
        return self.by(Points(TEST_RINGS)(lens.at(fields=list(TEST_FIELDS))))

    def by(self, points: Tensor) -> Tensor:
        """Mean square error (N,) of every picture, of landing points (2, 1, F, W, P)."""
        farthest = float((points - points.mean((-2, -1), keepdim=True)).abs().max()) / PIXEL
        if not farthest < WINDOW / 2:
            print(f"rays {farthest:.0f} pixels from the centroid, beyond the window", flush=True)
        kernels = kernels_of(transfer_of(points, PIXEL, WINDOW))
        filters = depth_invariant_wiener(transfer_functions(kernels, self.size), self.spectrum, NOISE)
        generator, error = torch.Generator().manual_seed(0), torch.zeros(len(self.patches), dtype=torch.float64)
        for k, (kernel, filter) in enumerate(zip(kernels[0].float(), filters, strict=True)):
            at = slice(k, None, len(TEST_FIELDS))
            image = blur(self.patches[at], kernel)
            image = image + NOISE * torch.randn(image.shape, generator=generator)
            restored = restore(image, filter.to(torch.complex64), boundary="taper")
            error[at] = (restored - self.target[at]).square().mean((-2, -1)).double()
        return error


def decibels(errors: Tensor) -> tuple[float, float, float]:
    """Restored dB of the mean error, and its 95 % interval over the pictures, by resampling."""
    picked = torch.randint(len(errors), (2000, len(errors)), generator=torch.Generator().manual_seed(0))
    ends = (-10 * torch.log10(errors[picked].mean(1))).quantile(torch.tensor([0.025, 0.975], dtype=torch.float64))
    return float(-10 * torch.log10(errors.mean())), *ends.tolist()


def seconds(folder: Path, *, of_error: bool) -> float:
    """Processor seconds of the tasks of a search; of_error: with the descents of the error."""
    with (folder / "search.jsonl").open() as file:
        tasks = [line for line in map(json.loads, file) if "task" in line]
    return sum(task["seconds"] for task in tasks if of_error or ", loss " not in task["task"])


def stored() -> list[dict]:
    if not ROWS.exists():
        return []
    with ROWS.open(newline="") as file:
        return [{key: _value(text) for key, text in row.items()} for row in csv.DictReader(file)]


def _value(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


class Study:
    """The searches of all designs; folder: where they resume."""

    def __init__(self, pictures: Pictures, folder: Path):
        train, test = split(pictures)
        self.folder, self.test = folder, Test(train, test)
        self.error = WienerError(patch_spectrum(train, SIZE, crops=1))

    def searched(self, elements: int, seed: int, design: str, *, larger: rt.Lens | None = None) -> Found | None:
        """Minima of a design, from plates, or from a lens of one element more; None where it has none."""
        loss = self.loss(design)
        if larger is None:
            route, place = "plates", self.folder / f"plates_{elements}_{seed}"
            found = rt.search(plates(elements), starts=STARTS, seed=seed, folder=place, **HOW, **loss)
        else:
            route, place = "deletion", self.folder / f"deletion_{elements}_{seed}_{design}"
            try:
                found = rt.search(larger, moves="delete", folder=place, **HOW, **loss)
            except rt.NoProblem as problem:
                print(elements, seed, design, problem, flush=True)
                return None
        self.add(elements, seed, design, route, found, seconds(place, of_error=design != "spots"))
        return found

    def loss(self, design: str) -> dict:
        """Options of a search."""
        return {} if design == "spots" else dict(loss=self.error, of=Points(RINGS))

    def moved(self, seed: int, design: str) -> None:
        """Lenses of all numbers of elements by moves from plates of three."""
        place = self.folder / f"moves_{seed}_{design}"
        found = rt.search(
            plates(3), starts=STARTS, seed=seed, moves="insert split delete", elements=(min(GLASSES), max(GLASSES)),
            folder=place, **HOW, **self.loss(design),
        )  # fmt: skip
        each, spent = found.elements.tolist(), seconds(place, of_error=design != "spots") / len(GLASSES)
        for elements in GLASSES:
            if elements in each:
                self.add(elements, seed, design, "moves", found, spent, each.index(elements))

    def deletions(self, seed: int) -> None:
        """From the best lens of each number of elements to one element less, down to a single one."""
        for design in DESIGNS:
            larger = None
            for elements in sorted(GLASSES, reverse=True):
                found = [self.searched(elements, seed, design)]
                found += [self.searched(elements, seed, design, larger=larger)] if larger is not None else []
                best = min(filter(None, found), key=lambda each: float(least(each)[0]))
                larger = best.lens

    def further(self, elements: int, seed: int) -> None:
        """Further starts of the design by spots, until it has the processor time of the other."""
        rows = [row for row in stored() if (row["elements"], row["seed"]) == (elements, seed)]
        spent = {design: sum(row["seconds"] for row in rows if row["design"] == design) for design in DESIGNS}
        done = sum(row["route"].startswith("further") for row in rows)
        while rows and spent["spots"] < spent["restoration"]:
            done += 1
            place = self.folder / f"plates_{elements}_{seed}_further_{done}"
            found = rt.search(plates(elements), starts=STARTS, seed=seed + 100 * done, folder=place, **HOW)
            spent["spots"] += seconds(place, of_error=True)
            self.add(elements, seed, "spots", f"further plates {done}", found, seconds(place, of_error=True))

    def add(
        self, elements: int, seed: int, design: str, route: str, found: Found, seconds: float, minimum: int = 0
    ) -> None:
        """A row of the best lens of a route, or of another minimum."""
        key = (elements, seed, design, route)
        if self.is_done(*key):
            return
        lens = found.lenses[minimum]
        error = float(self.error(Points(TEST_RINGS)(lens)))
        numbers = (round(seconds, 1), float(found.merit[minimum]), error, float(found.between[minimum]))
        self.write(key, numbers, self.test(lens))

    def is_done(self, *key: float | str) -> bool:
        """Whether a row with these elements, seed, design and route is stored."""
        return key in [tuple(row[name] for name in COLUMNS[:4]) for row in stored()]

    def limit(self) -> None:
        """A row of a lens without aberrations."""
        if not any(row["design"] == LIMIT for row in stored()):
            points = torch.zeros(2, 1, len(TEST_FIELDS), 1, 1, dtype=torch.float64)
            self.write((0, 0, LIMIT, ""), (0, 0, float(self.error(points)), 1), self.test.by(points))

    def write(self, key: tuple, numbers: tuple, errors: Tensor) -> None:
        values = (*key, *numbers, len(errors))
        row = dict(zip(COLUMNS, (*values, *(round(number, 3) for number in decibels(errors))), strict=True))
        print(row, flush=True)
        is_new = not ROWS.exists()
        with ROWS.open("a", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
            if is_new:
                writer.writeheader()
            writer.writerow(row)


def least(found: Found) -> Tensor:
    """What the search minimises, at its minima."""
    return found.merit if found.loss is None else found.loss


def chosen(rows: Sequence[dict], elements: int, design: str) -> list[dict]:
    """The best row of every seed by what the design minimises, with the processor time of all its routes."""
    best = []
    for seed in range(SEEDS):
        each = [row for row in rows if (row["elements"], row["seed"], row["design"]) == (elements, seed, design)]
        if each:
            by = min(each, key=lambda row: row["merit" if design == "spots" else "error"])
            best.append({**by, "seconds": sum(row["seconds"] for row in each)})
    return best


def gains(before: Sequence[dict], after: Sequence[dict]) -> list[float]:
    """dB from one design to the other, of every seed that both have."""
    levels = {row["seed"]: row["restored"] for row in before}
    return [row["restored"] - levels[row["seed"]] for row in after if row["seed"] in levels]


def table() -> None:
    """Restored dB, median (least … largest) of the seeds."""
    rows = stored()
    for elements in GLASSES:
        for design in DESIGNS:
            best = chosen(rows, elements, design)
            levels = [row["restored"] for row in best]
            if levels:
                print(f"{elements} {design:12} {np.median(levels):6.2f} dB ({min(levels):.2f} … {max(levels):.2f}) "
                      f"{np.median([row['seconds'] for row in best]):5.0f} s   "
                      f"{', '.join(str(row['route']) for row in best)}")  # fmt: skip
        each = gains(*(chosen(rows, elements, design) for design in DESIGNS))
        print("   gain", ", ".join(f"{gain:+.2f}" for gain in each))


@style.styled
def draw() -> None:
    """Restored dB of every seed with a line through the medians, and the gain of every seed."""
    rows, figure = stored(), style.new_figure(9.6, 4.0)
    axes, gain = figure.subplots(1, 2, width_ratios=(3, 2))
    best = {design: {elements: chosen(rows, elements, design) for elements in GLASSES} for design in DESIGNS}
    for design, offset in zip(DESIGNS, (-0.04, 0.04), strict=True):
        levels = {elements: [row["restored"] for row in each] for elements, each in best[design].items()}
        line = axes.plot([*levels], [np.median(each) for each in levels.values()], "-", label=NAMES[design])[0]
        for elements, each in levels.items():
            axes.plot([elements + offset] * len(each), each, "o", color=line.get_color(), markersize=4)
    (limit,) = [row["restored"] for row in rows if row["design"] == LIMIT]
    axes.axhline(limit, color="0.5", linestyle=":", label=LIMIT)
    axes.set_ylabel("restored pictures, dB")
    axes.set_title(f"f = {F:g} mm, F/{F_NUMBER:g}, ±{FIELDS[-1]:g}°: a point for each seed, medians joined", fontsize=9)
    axes.legend(loc="lower right")
    for elements in GLASSES:
        each = gains(best["spots"][elements], best["restoration"][elements])
        gain.plot([elements] * len(each), each, "o", color=line.get_color(), markersize=4)
    gain.axhline(0, color="0.5", linestyle=":")
    gain.set_title("gain over the least spots, dB", fontsize=9)
    for panel in (axes, gain):
        panel.set_xticks([*GLASSES])
        panel.set_xlabel("elements")
    style.save(figure, FIGURE)


def options(parser: argparse.ArgumentParser) -> None:
    """The options of this script."""
    parser.add_argument("--data", metavar="DIR", help="folder of pictures; four fifths train, the others test")
    parser.add_argument("-o", "--folder", type=Path, default=Path("elements_against_db"), help="of the searches")
    parser.add_argument("--moves", action="store_true", help="run the route by moves alone")
    parser.add_argument("--table", action="store_true", help="print the table alone")
    parser.add_argument("--plot", action="store_true", help="draw the figure alone")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    asked = parser.parse_args()
    if asked.table:
        table()
    elif asked.plot:
        draw()
    else:
        torch.set_num_threads(1)
        prepare()
        warnings.simplefilter("ignore")  # spots between fields, which the CSV has
        study = Study(read(files(asked.data), least=PATCH + WINDOW - 1), asked.folder)
        study.limit()
        for seed, elements, design in itertools.chain(
            *(itertools.product(range(SEEDS), each, DESIGNS) for each in (() if asked.moves else ELEMENTS))
        ):
            if not study.is_done(elements, seed, design, "plates"):
                study.searched(elements, seed, design)
        for seed in range(0 if asked.moves else SEEDS):
            study.deletions(seed)
        for seed, design in itertools.product(range(SEEDS), DESIGNS):
            if not all(study.is_done(elements, seed, design, "moves") for elements in GLASSES):
                study.moved(seed, design)
        for seed, elements in itertools.product(range(0 if asked.moves else SEEDS), GLASSES):
            study.further(elements, seed)

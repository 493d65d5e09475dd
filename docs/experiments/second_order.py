"""Lifted least squares against Adam and L-BFGS-B: the error behind the best linear filter, of five lenses, from the
best spots and from the file's lens.

    python docs/experiments/second_order.py            # runs what is missing in docs/second_order.csv, a row a run
    python docs/experiments/second_order.py --pace     # prints the time to the error of Adam's end
    python docs/experiments/second_order.py --table    # prints the table of docs/reference/loss.md

Every run starts at a lens whose free numbers are displaced at random. The loss is the mean square error of a pixel
behind a Wiener filter, of scenes of a 1/f² spectrum and noise of 0.02, from the geometric transfer functions of 128
rays a field and wavelength, one filter for each field and wavelength and all object distances; the end is judged by 512
rays. Pixels have 5 µm, of the phone 1.5 µm. The last curvature is solved for the focal length, thicknesses are within
bounds. Adam has its best rate of five, from the best spots that of each seed, from the file that of seed 0, and a
budget of processor time; the others end by themselves. `lm` is one descent; `optimize`, from the best spots alone, is
what `rt.optimize(loss=…)` does: two restarts, and further descents with denser rays where these change the loss by more
than 2 %. Time is processor time of one thread.
"""

import argparse
import csv
import dataclasses
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import scipy.optimize
import torch
from torch import Tensor

import raytrace as rt
from raytrace.optimization.least_squares import Cycle, CycleStart, least_squares
from raytrace.optimization.lifted import Lifted
from raytrace.optimization.loss import Loss, LossDescents
from raytrace.optimization.merit import merit_for
from raytrace.optimization.problem import FunctionMerit, Problem, typical_of
from raytrace.optimization.quantities import Points
from raytrace.optimization.variables import bounds_of, design_variables
from raytrace.system.optimization_data import Solve

ROWS = Path(__file__).parents[1] / "second_order.csv"
BUDGET = 30.0  # s, of Adam
RATES = (0.0001, 0.0005, 0.002, 0.006, 0.02)  # of Adam: RMS blur of a step, mm, that each number makes alone
SEEDS = 5
SIZE, NOISE = 24, 0.02
INF = float("inf")

#: A microscope objective 60×/0.55 traced from the image to the specimen, radius, thickness and glass, at f = 98.6 mm.
OBJECTIVE = (
    (553.26, 64.9, "N-FK51"), (-247.644, 4.4, ""), (115.162, 59.4, "J-LLF2"), (57.131, 17.6, ""), (INF, 17.6, ""),
    (-57.646, 74.8, "SF5"), (196.614, 77.0, "N-FK51"), (-129.243, 4.4, ""), (2062.37, 15.4, "N-KZFS4"),
    (203.781, 48.4, "CAF2"), (-224.003, 4.4, ""), (219.864, 35.2, "CAF2"), (793.3, 4.4, ""), (349.26, 26.4, "N-FK51"),
    (-401.95, 4.4, ""), (91.992, 39.6, "N-SK11"), (176.0, 96.189, ""),
)  # fmt: skip


def objective() -> rt.Lens:
    rows = [dict(radius=r, thickness=t, **({"glass": glass} if glass else {})) for r, t, glass in OBJECTIVE]
    return rt.lens(
        rows, stop=5, f_number=0.9, fields=[0, 0.7, 1], wavelengths=[0.4861, 0.5876, 0.6563], primary_wavelength=2,
        catalogs=["schott", "hikari", "infrared", "misc"],
    )  # fmt: skip


def c_mount() -> rt.Lens:
    """The shipped Tessar at a quarter of its size: 25 mm, F/2.8, an image circle of 2/3", 20 mm behind the lens."""
    lens = rt.read_lens("tessar")
    for k, surface in enumerate(lens.surfaces[1:-1], 1):
        curvature = {} if surface.curvature is None else {"curvature": 4 * surface.curvature}
        lens = lens.replace(k, thickness=surface.thickness / 4, **curvature)
    return lens.at(entrance_pupil_diameter=lens.aperture.value / 4)


@dataclasses.dataclass(frozen=True)
class Design:
    """Variables, the surface of the solve, bounds, displacement, object distances, wavelengths, pixel in mm."""

    lens: Callable[[], rt.Lens]
    vary: str
    solved: int
    bounds: str = ""
    displacement: float = 0.01
    distances: tuple[float, ...] | None = None
    wavelengths: tuple[float, ...] | None = None
    pixel: float = 0.005


LENSES = {
    "cooke_triplet": Design(
        partial(rt.read_lens, "cooke_triplet"), "curvature:1-4,6 thickness:1-6", 7,
        "thickness_1:2..12 thickness_2:0.5..60 thickness_3:2..12 thickness_4:0.5..60 thickness_5:0.5..60 "
        "thickness_6:2..12",
    ),
    "double_gauss": Design(
        partial(rt.read_lens, "double_gauss"), "curvature:1-5,7-10 thickness:2,5,6,9 sensor", 11,
        displacement=0.003, distances=(10e3, 20e3, 50e3), wavelengths=(0.53,),
    ),
    "phone": Design(
        partial(rt.read_lens, "phone"), "curvature:2-12 a4:2-13 a6:2-13", 13, displacement=0.001, pixel=0.0015
    ),
    "microscope objective": Design(
        objective, "curvature:1-4,6-16 thickness:4,5 sensor", 17, "thickness:5..60 sensor:80..110", displacement=0.001
    ),
    "C-mount lens": Design(
        c_mount, "curvature:1-3,5-7 thickness:3,4,6 sensor", 8, "thickness:0.2..20 sensor:15..25"
    ),
}  # fmt: skip
STARTS = ("spots", "file")
COLUMNS = ("lens", "seed", "start", "optimizer", "rate", "error", "seconds", "evaluations")


class WienerError:
    """Mean square error () of a pixel, of points (2, D, F, W, P): a filter for each field and wavelength."""

    def __init__(self, pixel: float):
        frequency = torch.fft.fftfreq(SIZE, dtype=torch.float64) / pixel
        half = frequency[: SIZE // 2 + 1].abs()
        self.grid = torch.stack(torch.meshgrid(frequency, half, indexing="ij")).flatten(1)
        edge = (self.grid[1] == 0) | (self.grid[1] == self.grid[1].max())
        self.share = torch.where(edge, 1.0, 2.0)  # of conjugate frequencies
        power = 1 / (self.grid.square().sum(0) + (SIZE * pixel) ** -2)
        self.power = power * 0.06 / (self.share * power).sum()
        self.box = torch.sinc(self.grid * pixel).prod(0)

    def __call__(self, points: Tensor) -> Tensor:
        about = points - points.mean((-2, -1), keepdim=True)
        phase = 2 * np.pi * torch.einsum("cv,cdfwp->dfwvp", self.grid, about)
        real, imaginary = (self.box * part.mean(-1) for part in (torch.cos(phase), torch.sin(phase)))
        noise = NOISE**2 / SIZE**2
        mean, square = torch.stack([real, imaginary]).mean(1), (real.square() + imaginary.square()).mean(0)
        error = self.power - self.power**2 * mean.square().sum(0) / (self.power * square + noise)
        return (self.share * error).sum(-1).mean()


class Case:
    """A lens with its variables, displaced by a seed, and the loss."""

    def __init__(self, name: str, seed: int):
        design = LENSES[name]
        lens = design.lens()
        lens = lens if design.wavelengths is None else lens.at(wavelengths=list(design.wavelengths))
        lens = lens if design.distances is None else rt.focus(lens.at(object_distance=design.distances[1])).lens
        efl = float(rt.first_order(lens).effective_focal_length)
        solve = Solve(design.solved, "curvature", "focal_length", (efl,))
        self.model = dataclasses.replace(design_variables(lens, design.vary), solves=(solve,))
        distances = None if design.distances is None else torch.tensor(design.distances, dtype=torch.float64)
        error = WienerError(design.pixel)
        self.losses = [Loss(error, Points(rings), distances) for rings in (8, 16)]
        rows = merit_for(lens, "spot")
        self.problem = Problem(self.model, rows.rows, **rows.options)
        self.typical, self.function = typical_of(self.model), FunctionMerit(self.model, self.losses[0])
        lower, upper = bounds_of(self.model.lens, self.model.variables, design.bounds or None)
        self.ends = {"lower": lower, "upper": upper}
        random = np.random.default_rng(seed)
        displaced = self.model.start * (1 + design.displacement * random.uniform(-1, 1, len(self.model.start)))
        self.start = np.clip(displaced, lower, upper)

    def at_spots(self, x: np.ndarray) -> np.ndarray:
        return least_squares(self.problem.state, x, typical=self.typical, cycles=100, **self.ends).state.x

    def lifted(self) -> Lifted:
        return Lifted(self.function, self.problem.state, typical=self.typical, **self.ends)

    def checked(self, x: np.ndarray) -> float:
        return FunctionMerit(self.model, self.losses[1])(x)[0]


def lm(case: Case, x: np.ndarray) -> np.ndarray:
    return case.lifted().descend(x, cycles=300).state.x


def whole(case: Case, x: np.ndarray) -> np.ndarray:
    """With restarts and denser rays."""
    descents = LossDescents(case.problem, case.losses[0], (case.ends["lower"], case.ends["upper"]))
    end = descents.run(x, first=False, restarts=2, cycles=None, until=INF)
    case.function.evaluations = end.evaluations
    return end.x


def units(case: Case, x: np.ndarray) -> np.ndarray:
    """Change (n,) of each number that makes an RMS blur of 1 mm alone."""
    return 1 / np.linalg.norm(case.problem.state(x, True).jacobian, axis=0)


def lbfgs(case: Case, x: np.ndarray) -> np.ndarray:
    scale = 0.002 * units(case, x)

    def scaled(y: np.ndarray) -> tuple[float, np.ndarray]:
        value, gradient = case.function(x + scale * y)
        value, gradient = (value, gradient) if np.isfinite(value) else (1e3, np.zeros_like(gradient))
        return 1e3 * value, 1e3 * gradient * scale

    bounds = scipy.optimize.Bounds(*((case.ends[end] - x) / scale for end in ("lower", "upper")))
    end = scipy.optimize.minimize(
        scaled, 0 * x, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 400, "maxcor": 20, "ftol": 1e-9}
    )
    return x + scale * end.x


def adam(case: Case, x: np.ndarray, rate: float) -> np.ndarray:
    started, scale = time.process_time(), units(case, x)
    y = torch.zeros(len(x), dtype=torch.float64, requires_grad=True)
    optimizer = torch.optim.Adam([y], rate)
    best, kept = np.inf, x
    while (elapsed := time.process_time() - started) < BUDGET:
        optimizer.param_groups[0]["lr"] = rate * 0.5 * (1 + np.cos(np.pi * elapsed / BUDGET))
        moved = np.clip(x + scale * y.detach().numpy(), case.ends["lower"], case.ends["upper"])
        value, gradient = case.function(moved)
        if not np.isfinite(value):
            break
        best, kept = (value, moved) if value < best else (best, kept)
        y.grad = torch.tensor(gradient * scale)
        optimizer.step()
    return kept


def run(name: str, seed: int, start: str, optimizer: str, rate: float) -> dict:
    case = Case(name, seed)
    started, x = time.process_time(), case.start
    if start == "spots":
        x = case.at_spots(x)
    if optimizer == "adam":
        x = adam(case, x, rate)
    elif optimizer != "none":
        x = {"lm": lm, "lbfgs": lbfgs, "optimize": whole}[optimizer](case, x)
    seconds = time.process_time() - started
    values = (name, seed, start, optimizer, rate, case.checked(x), round(seconds, 2), case.function.evaluations)
    return dict(zip(COLUMNS, values, strict=True))


def stored() -> list[dict]:
    if not ROWS.exists():
        return []
    with ROWS.open(newline="") as file:
        return list(csv.DictReader(file))


def best_rate(name: str, start: str, seed: int = 0) -> float:
    """Adam's rate of the least error of a seed."""
    rows = [row for row in stored() if (row["lens"], row["start"], row["optimizer"]) == (name, start, "adam")]
    rows = [row for row in rows if row["seed"] == str(seed) and np.isfinite(float(row["error"]))]
    return float(min(rows, key=lambda row: float(row["error"]))["rate"]) if rows else RATES[1]


def runs(name: str, seed: int, starts: Sequence[str]) -> list[tuple]:
    listed = []
    for start in starts:
        optimizers = ("none", "lm", "lbfgs", "optimize") if start == "spots" else ("none", "lm", "lbfgs")
        listed += [(name, seed, start, optimizer, 0.0) for optimizer in optimizers]
        rates = RATES if seed == 0 or start == "spots" else (best_rate(name, start),)
        listed += [(name, seed, start, "adam", rate) for rate in rates]
    return listed


def measure(name: str, starts: Sequence[str]) -> None:
    torch.set_num_threads(1)
    for seed in range(SEEDS):
        for key in runs(name, seed, starts):
            done = {tuple(row[column] for column in COLUMNS[:5]) for row in stored()}
            if tuple(map(str, key)) in done:
                continue
            row, is_new = run(*key), not ROWS.exists()
            with ROWS.open("a", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                if is_new:
                    writer.writeheader()
                writer.writerow(row)
            print(row, flush=True)


def table() -> None:
    """dB below the error of the best spots, mean and range over the seeds, median time and evaluations."""
    for name in LENSES:
        rows = {}
        for row in stored():
            if row["lens"] == name and (
                row["optimizer"] != "adam" or float(row["rate"]) == best_rate(name, row["start"], int(row["seed"]))
            ):
                rows[row["start"], row["optimizer"], row["seed"]] = row
        for start in ("file", "spots"):
            for optimizer in ("adam", "lbfgs", "lm", "optimize"):
                own = [seed for seed in map(str, range(SEEDS)) if (start, optimizer, seed) in rows]
                of_runs = [rows[start, optimizer, seed] for seed in own]
                errors = np.array([float(row["error"]) for row in of_runs])
                spots = np.array([float(rows["spots", "none", seed]["error"]) for seed in own])
                if not len(errors):
                    continue
                fail, gains = np.isnan(errors), 10 * np.log10(spots / errors)
                seconds = np.median([float(row["seconds"]) for row in of_runs])
                counts = [int(row["evaluations"]) for row in of_runs if row["evaluations"] != "0"]
                said = [f"{np.median(counts):.0f} evaluations"] if counts else []
                said += [f"rates {', '.join(row['rate'] for row in of_runs)}"] if optimizer == "adam" else []
                said += [f"{fail.sum()} fail by denser rays"] if fail.any() else []
                print(
                    f"{name:20} from {start:6}{optimizer:9} {np.nanmean(gains):6.2f} dB ({np.nanmin(gains):6.2f} … "
                    f"{np.nanmax(gains):5.2f}) {seconds:6.1f} s, {len(gains)} seeds "
                    f"{', '.join(said)}"
                )


class Passed(Exception):
    """The error of Adam's end is passed."""


def pace(name: str) -> None:
    """Processor seconds of lifted least squares from the best spots until the error of Adam's end is passed."""
    ends = [row for row in stored() if (row["lens"], row["start"], row["optimizer"]) == (name, "spots", "adam")]
    seeds = (int(row["seed"]) for row in ends)
    best = {seed: best_rate(name, "spots", seed) for seed in seeds}
    ends = {int(row["seed"]): row for row in ends if float(row["rate"]) == best[int(row["seed"])]}
    ratios = []
    for seed, row in sorted(ends.items()):
        case, checks = Case(name, seed), 0.0
        started = time.process_time()
        x = case.at_spots(case.start)
        spots = time.process_time() - started

        def watch(cycle: Cycle, start: CycleStart, case: Case = case, aim: float = float(row["error"])) -> None:
            nonlocal checks
            begun = time.process_time()
            error = case.checked(start.x)
            checks += time.process_time() - begun
            if error <= aim:
                raise Passed

        seconds = np.inf
        try:
            case.lifted().descend(x, cycles=300, watch=watch)
        except Passed:
            seconds = time.process_time() - started - checks
        ratios.append((float(row["seconds"]) - spots) / (seconds - spots))
        print(
            f"{name} seed {seed}: {seconds:.2f} s, of it {spots:.2f} for the spots; Adam {row['seconds']} s", flush=True
        )
    print(f"{name}: without the spots {np.median(ratios):.0f} times faster, {min(ratios):.0f} … {max(ratios):.0f}")


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--table", action="store_true", help="print the table alone")
    parser.add_argument("--pace", action="store_true", help="print the time to the error of Adam's end alone")
    parser.add_argument("--lens", nargs="+", choices=LENSES, default=[*LENSES], help="of these lenses alone")
    parser.add_argument("--start", nargs="+", choices=STARTS, default=[*STARTS], help="from these starts alone")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    asked = parser.parse_args()
    torch.set_num_threads(1)
    if asked.table:
        table()
    elif asked.pace:
        for lens in asked.lens:
            pace(lens)
    else:
        for lens in asked.lens:
            measure(lens, asked.start)

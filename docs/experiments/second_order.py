"""Steps of second order against Adam and L-BFGS-B: the closed-form error of a camera, from the file's lens and from the
best spots.

    python docs/experiments/second_order.py            # runs what is missing in second_order.csv, a row a run
    python docs/experiments/second_order.py --table    # prints the table of docs/loss.md and draws its figure

Every run starts at a lens whose free numbers are displaced at random. The error is the mean square error of a pixel
behind the best linear filter of all object distances (`imaging.closed_form.camera_error`), of Gaussian PSFs while the
lens is optimised, and of PSFs of all rays (DRT) at the end. Adam has its best rate of three, by seed 0, and a budget of
processor time; the others end by themselves. Time is processor time of one thread.
"""

import argparse
import csv
import time
from pathlib import Path

import numpy as np
import torch

import raytrace as rt
from raytrace.imaging.closed_form import camera_error, even_distances, optimise_closed_form
from raytrace.imaging.lens_steps import LensSteps
from raytrace.tracing.focus import focused

DOCS = Path(__file__).parents[1]
ROWS = DOCS / "second_order.csv"
BUDGET = 20.0  # s, of Adam
RATES = (1e-3, 3e-3, 1e-2)  # of Adam, in units of blur, mm
#: Variables and displacement of each lens, and the half width of its patch of the image.
LENSES = {
    "cooke_triplet": ("thickness:2,4 sensor curvature", 0.01, (0.0, 8.4, 11.9)),
    "double_gauss": ("thickness:2,5,6,9 sensor curvature:1-5,7-11", 0.003, (0.0, 9.8, 14.0)),
}
COLUMNS = ("lens", "seed", "start", "optimizer", "rate", "error", "error_drt", "seconds", "evaluations")


def spectrum(size: int) -> torch.Tensor:
    """1/f² with a variance of 0.06, of pictures of that many pixels."""
    frequency = torch.fft.fftfreq(size, dtype=torch.float64)
    power = 1 / (frequency[:, None] ** 2 + frequency**2 + size**-2.0)
    return power * 0.06 / power.mean()


SPECTRUM = spectrum(64)


def camera(name: str, seed: int) -> rt.Camera:
    vary, displacement, fields = LENSES[name]
    lens = focused(rt.read_lens(name).at(wavelengths=[0.53]), 25e3)
    sensor = rt.Sensor(size=(1, 1), pixels=(200, 200), read_noise=0.02)
    variables = rt.Variables(lens, vary, hold="efl", step="blur")
    own = rt.Camera(variables, torch.nn.Identity(), sensor=sensor, fields=list(fields), pixels=31)
    own.plan()
    random = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for variable in variables.variables:
            if variable.name != "sensor":
                moved = displacement * variable.start * (2 * torch.rand((), generator=random) - 1)
                variables.get_parameter(variable.name).fill_(moved / variable.unit)
    variables.project()
    return own


def adam(own: rt.Camera, distances: torch.Tensor, rate: float) -> int:
    started, steps = time.process_time(), 0
    optimizer = torch.optim.Adam(own.variables.parameters(), rate)
    best, kept = np.inf, own.variables.state_dict()
    while (elapsed := time.process_time() - started) < BUDGET:
        optimizer.param_groups[0]["lr"] = rate * 0.5 * (1 + np.cos(np.pi * elapsed / BUDGET))
        optimizer.zero_grad()
        error = camera_error(own, SPECTRUM, distances) + own.variables.violation()
        if float(error.detach()) < best:
            best = float(error.detach())
            kept = {name: part.clone() for name, part in own.variables.state_dict().items()}
        error.backward()
        optimizer.step()
        own.variables.project()
        steps += 1
    own.variables.load_state_dict(kept)
    return steps


def run(name: str, seed: int, start: str, optimizer: str, rate: float) -> dict:
    own = camera(name, seed)
    distances, started = even_distances(own, 3), time.process_time()
    if start == "spots":
        LensSteps(own.variables).minimise_spots()
    if optimizer == "adam":
        evaluations = adam(own, distances, rate)
    elif optimizer == "none":
        evaluations = 0
    else:
        course = optimise_closed_form(own, SPECTRUM, distances=distances, optimizer=optimizer)
        evaluations = len(course.errors)
    seconds = time.process_time() - started
    with torch.no_grad():
        error = float(camera_error(own, SPECTRUM, distances))
        own.use("drt")
        error_drt = float(camera_error(own, SPECTRUM, distances))
    values = (name, seed, start, optimizer, rate, error, error_drt, round(seconds, 2), evaluations)
    return dict(zip(COLUMNS, values, strict=True))


def stored() -> list[dict]:
    if not ROWS.exists():
        return []
    with ROWS.open(newline="") as file:
        return list(csv.DictReader(file))


def runs() -> list[tuple]:
    """Runs in order; those of seed 0 choose Adam's rate."""
    listed = []
    for seed in range(5):
        for name in LENSES:
            for start in ("file", "spots"):
                listed.append((name, seed, start, "none", 0.0))
                listed += [(name, seed, start, optimizer, 0.0) for optimizer in ("lm", "lbfgs")]
                rates = RATES if seed == 0 else (best_rate(name, start),)
                listed += [(name, seed, start, "adam", rate) for rate in rates]
    return listed


def best_rate(name: str, start: str) -> float:
    rows = [row for row in stored() if (row["lens"], row["start"], row["optimizer"]) == (name, start, "adam")]
    rows = [row for row in rows if row["seed"] == "0"]
    return float(min(rows, key=lambda row: float(row["error_drt"]))["rate"]) if rows else RATES[1]


def measure() -> None:
    torch.set_num_threads(1)
    for seed in range(5):
        for key in [run for run in runs() if run[1] == seed]:
            done = {
                (row["lens"], int(row["seed"]), row["start"], row["optimizer"], float(row["rate"])) for row in stored()
            }
            if key in done:
                continue
            row, is_new = run(*key), not ROWS.exists()
            with ROWS.open("a", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                if is_new:
                    writer.writeheader()
                writer.writerow(row)
            print(row, flush=True)


def table() -> None:
    """Mean and range over the seeds of dB below the error of the best spots, the median time, and the time in which lm
    passes Adam's end."""
    for name in LENSES:
        rows = {}
        for row in stored():
            if row["lens"] == name and (
                row["optimizer"] != "adam" or float(row["rate"]) == best_rate(name, row["start"])
            ):
                rows[row["start"], row["optimizer"], row["seed"]] = row
        seeds = sorted({seed for _, _, seed in rows})
        print(f"\n{name}: dB below the best spots, mean (least … largest): own PSFs, then DRT; median s, evaluations")
        for start in ("file", "spots"):
            for optimizer in ("adam", "lbfgs", "lm"):
                own = [seed for seed in seeds if {(start, optimizer, seed), ("spots", "none", seed)} <= rows.keys()]
                words = []
                for error in ("error", "error_drt"):
                    gains = [
                        10 * np.log10(float(rows["spots", "none", s][error]) / float(rows[start, optimizer, s][error]))
                        for s in own
                    ]
                    words.append(f"{np.mean(gains):5.2f} ({min(gains):5.2f} … {max(gains):5.2f})" if gains else "")
                if own:
                    of_runs = [rows[start, optimizer, seed] for seed in own]
                    seconds = np.median([float(row["seconds"]) for row in of_runs])
                    count = np.median([int(row["evaluations"]) for row in of_runs])
                    print(
                        f"  {start:6}{optimizer:6}",
                        *words,
                        f"{seconds:5.1f} s {count:5.0f} ({len(own)} seeds)",
                        sep="  ",
                    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", action="store_true", help="print the table alone")
    table() if parser.parse_args().table else measure()

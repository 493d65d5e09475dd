"""Restored dB of five lenses behind a Wiener filter and behind a small network: the lens of the best spots, that of the
closed form by steps of second order, and the lens trained by Adam together with the network.

    python docs/experiments/second_order_network.py --data DIR   # runs what the CSV lacks, a lens and seed at a time
    python docs/experiments/second_order_network.py --table      # prints the tables of docs/reference/loss.md

Lenses, variables, bounds, pixels and displaced starts are those of second_order.py; a seed also decides the weights of
the network, the patches and their noise. Arms: `spots`, a network behind the best spots; `lm`, the lens at the minimum
of the error behind one Wiener filter for all fields and distances, as `rt.optimize(loss=…)` finds it (two restarts,
denser rays), then the network; `each`, the same behind a filter for each field; `adam`, lens and network together, the
rate of the lens the best one of second_order.csv. They begin at the best spots of a seed; `lm` and `adam` also at the
displaced lens of the file. Budgets: in `equal time` each arm has the
processor time of one thread of the lens of `lm` and 30 s for the network, for lens and network together; in `equal
steps` the network has 400. Adam's rates fall to 0 along half a cosine of what remains. Losses are mean square errors.
PSFs are polychromatic, of 128 rays a field and colour in training (512 where denser rays check the closed form) and of
1,152 in the test. Test pictures are in no
training: one patch of each, at every field and distance. Gains are over the best spots of the same seed and budget,
with 95 % intervals over the test pictures in the CSV and, where there are several seeds, of Student's t over these in
the tables.
"""

import argparse
import csv
import dataclasses
import itertools
import time
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import scipy.stats
import second_order
import torch
from torch import Tensor

import raytrace as rt
from raytrace.imaging.closed_form import patch_spectrum
from raytrace.imaging.image import blur, transfer_functions
from raytrace.imaging.network import UNetShape, network
from raytrace.imaging.pictures import Pictures, crop, draws, files, read, split
from raytrace.imaging.restoration import depth_invariant_wiener, kernel_error, restore
from raytrace.optimization.loss import Loss, LossDescents
from raytrace.optimization.quantities import Points
from raytrace.tracing.compiled import prepare

ROWS = Path(__file__).parents[1] / "second_order_network.csv"
NETWORK_SECONDS = 30.0  # of processor time of one thread, behind the lens of `lm`
STEPS = 400
SEEDS, ALL_ARMS = 5, 1  # seeds, and seeds with `each` and the arms from the lens of the file
RESTARTS = 2
WINDOW, PATCH, BATCH = 41, 64, 8
RINGS, TEST_RINGS = 8, 24
RATE = 2e-3  # of the network
INF = float("inf")
COLUMNS = (
    *("lens", "seed", "arm", "start", "budget", "seconds", "lens_seconds", "network_steps", "patches"),
    *("wiener", "network", "wiener_gain", "wiener_low", "wiener_high", "network_gain", "network_low", "network_high"),
)
BUDGETS = "equal time", "equal steps"


def transfer_of(points: Tensor, pixel: float, size: int) -> Tensor:
    """Transfer functions (D, F, size, size), as by `fft2`, of landing points (2, D, F, W, P) about the centroid of all
    colours; pixel: mm."""
    about = (points - points.mean((-2, -1), keepdim=True)) / pixel
    frequency = torch.fft.fftfreq(size, dtype=torch.float64)
    columns, rows = (
        torch.polar(torch.ones(()).double(), -2 * np.pi * part.flatten(-2)[..., None] * frequency) for part in about
    )
    of_pixel = torch.sinc(frequency)
    return torch.einsum("dfpu,dfpv->dfuv", rows, columns) / rows.shape[-2] * of_pixel[:, None] * of_pixel


def kernels_of(transfer: Tensor) -> Tensor:
    """PSFs (..., size, size), their centroid in the middle, of energy 1."""
    return torch.fft.fftshift(torch.fft.ifft2(transfer).real, (-2, -1))


class Case:
    """A lens at a displaced start and at its best spots, the closed form of its error, and its pictures."""

    def __init__(self, name: str, seed: int, pictures: Pictures):
        self.design, self.seed, self.case = second_order.LENSES[name], seed, second_order.Case(name, seed)
        self.train, self.test = split(pictures)
        self.spectrum = patch_spectrum(self.train, PATCH + WINDOW - 1, crops=1)
        self.distances = self.case.losses[0].object_distances

    def closed_form(self, points: Tensor) -> Tensor:
        """The error behind one filter for all fields and distances."""
        kernels = kernels_of(transfer_of(points, self.design.pixel, WINDOW))
        return kernel_error(kernels.flatten(0, 1), self.spectrum, second_order.NOISE)

    def of_each_field(self, points: Tensor) -> Tensor:
        """The error behind a filter for each field and all distances."""
        kernels = kernels_of(transfer_of(points, self.design.pixel, WINDOW))
        return kernel_error(kernels, self.spectrum, second_order.NOISE).mean()

    def optimised(self, function: Callable[[Tensor], Tensor], x: np.ndarray) -> np.ndarray:
        """The minimum of a closed form, as by `rt.optimize`."""
        loss, ends = Loss(function, Points(RINGS), self.distances), (self.case.ends["lower"], self.case.ends["upper"])
        descents = LossDescents(self.case.problem, loss, ends)
        return descents.run(x, first=False, restarts=RESTARTS, cycles=None, until=INF).x

    def variables(self, x: np.ndarray) -> rt.Variables:
        words = self.design.vary.split()
        words = [word for word in words if not word.startswith("curvature")] + [
            *(word for word in words if word.startswith("curvature")), f"curvature:{self.design.solved}"
        ]  # fmt: skip
        lens = self.case.model.lens_at(x)
        return rt.Variables(lens, " ".join(words), bounds=self.design.bounds or None, hold="efl", step="blur")

    def kernels(self, lens: rt.Lens, rings: int = RINGS) -> Tensor:
        """PSFs (D, F, rows, columns) on pixels about the centroid of all colours, of energy 1."""
        points = Points(rings)(lens, self.distances)
        return kernels_of(transfer_of(points, self.design.pixel, WINDOW))

    def patches(self, pictures: Pictures, samples: range, seed: int) -> Tensor:
        """Patches (B, H, W) with the margin of the PSFs."""
        size = PATCH + WINDOW - 1
        each = [crop(pictures, sample % len(pictures), epoch=seed, size=size, crops=1) for sample in samples]
        return torch.as_tensor(np.stack(each))


def recorded(patches: Tensor, kernels: Tensor, random: torch.Generator) -> Tensor:
    image = blur(patches, kernels)
    return image + second_order.NOISE * torch.randn(image.shape, generator=random)


def target(patches: Tensor) -> Tensor:
    edge = WINDOW // 2
    return patches[..., edge:-edge, edge:-edge]


@dataclasses.dataclass
class Budget:
    """Seconds of processor time, or steps."""

    seconds: float = INF
    steps: float = INF

    def __post_init__(self) -> None:
        self.started = time.process_time()

    def used(self, step: int) -> float:
        """The share that is used after so many steps."""
        return max((time.process_time() - self.started) / self.seconds, step / self.steps)


def trained(case: Case, variables: rt.Variables, budget: Budget, rate: float) -> tuple[torch.nn.Module, int]:
    """A network, and its steps; rate: of the lens, 0 if it is fixed."""
    unet = network(UNetShape(2, 8), seed=case.seed)
    groups = [{"params": [*unet.parameters()], "lr": RATE}]
    groups += [{"params": [*variables.parameters()], "lr": rate}] if rate else []
    optimizer, rates, step, before = torch.optim.Adam(groups), [group["lr"] for group in groups], 0, {}
    fixed = None if rate else case.kernels(variables()).detach()
    while (used := budget.used(step)) < 1:
        random, generator = draws(case.seed, step, 1), torch.Generator().manual_seed(10**6 * (case.seed + 1) + step)
        patches = case.patches(case.train, range(step * BATCH, (step + 1) * BATCH), case.seed * 1000 + step)
        kernels = case.kernels(variables()) if fixed is None else fixed
        chosen = kernels.flatten(0, 1)[random.integers(kernels.shape[0] * kernels.shape[1], size=BATCH)].float()
        restored = unet(recorded(patches, chosen, generator)[:, None])[:, 0]
        loss = (restored - target(patches)).square().mean()
        if not torch.isfinite(loss):  # rays fail: the lens is fixed where they arrived
            variables.load_state_dict(before)
            fixed, rates[1] = case.kernels(variables()).detach(), 0.0
            continue
        if fixed is None:
            before = {key: part.clone() for key, part in variables.state_dict().items()}
        for group, largest in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = largest * 0.5 * (1 + np.cos(np.pi * used))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if fixed is None:
            variables.project()
        step += 1
    return unet, step


@torch.no_grad()
def tested(case: Case, lens: rt.Lens, unet: torch.nn.Module) -> dict[str, Tensor]:
    """Mean square error (N,) of every test picture, over all fields and distances, by restoration."""
    kernels, generator = case.kernels(lens, TEST_RINGS), torch.Generator().manual_seed(0)
    transfer = transfer_functions(kernels, PATCH + WINDOW - 1)
    filters = depth_invariant_wiener(transfer, case.spectrum, second_order.NOISE)
    patches, errors = case.patches(case.test, range(len(case.test)), 0), {"wiener": [], "network": []}
    for at_distance in kernels.float():
        for kernel, filter in zip(at_distance, filters, strict=True):
            images = recorded(patches, kernel, generator)
            images_restored = {
                "wiener": restore(images, filter.to(torch.complex64), boundary="taper"),
                "network": torch.cat([unet(part[:, None])[:, 0] for part in images.split(64)]),
            }
            for name, restored in images_restored.items():
                errors[name].append((restored - target(patches)).square().mean((-2, -1)))
    return {name: torch.stack(each).mean(0).double() for name, each in errors.items()}


def gain(errors: Tensor, reference: Tensor) -> tuple[float, float, float]:
    """Gain, dB, over a reference, and its 95 % interval over the pictures, by resampling."""
    picked = torch.randint(len(errors), (2000, len(errors)), generator=torch.Generator().manual_seed(0))
    resampled = 10 * torch.log10(reference[picked].mean(1) / errors[picked].mean(1))
    low, high = resampled.quantile(torch.tensor([0.025, 0.975], dtype=torch.float64)).tolist()
    return float(10 * torch.log10(reference.mean() / errors.mean())), low, high


def timed(function: Callable[[np.ndarray], np.ndarray], x: np.ndarray) -> tuple[np.ndarray, float]:
    started = time.process_time()
    return function(x), time.process_time() - started


def run(name: str, seed: int, pictures: Pictures) -> list[dict]:
    """Rows of all arms of a lens and seed."""
    case, rows, reference = Case(name, seed, pictures), [], {}
    spots, of_spots = timed(case.case.at_spots, case.case.start)
    lens, of_lens = timed(partial(case.optimised, case.closed_form), spots)
    arms = [(*arm, budget) for budget in BUDGETS for arm in (
        ("spots", "spots", spots, of_spots), ("lm", "spots", lens, of_spots + of_lens),
        ("adam", "spots", spots, of_spots),
    )]  # fmt: skip
    total = of_spots + of_lens + NETWORK_SECONDS
    if seed < ALL_ARMS:
        lens, of_lens = timed(partial(case.optimised, case.of_each_field), spots)
        arms += [("each", "spots", lens, of_spots + of_lens, BUDGETS[1])]
        lens, of_lens = timed(partial(case.optimised, case.closed_form), case.case.start)
        arms += [("lm", "file", lens, of_lens, BUDGETS[1]), ("adam", "file", case.case.start, 0.0, BUDGETS[1])]
    for arm, start, x, lens_seconds, budget in arms:
        variables, rate = case.variables(x), second_order.best_rate(name, start) if arm == "adam" else 0.0
        left = Budget(total - lens_seconds) if budget == BUDGETS[0] else Budget(steps=STEPS)
        unet, steps = trained(case, variables, left, rate)
        seconds = lens_seconds + time.process_time() - left.started
        errors = tested(case, variables(), unet)
        reference.setdefault(budget, errors)
        gains = {kind: gain(errors[kind], reference[budget][kind]) for kind in errors}
        levels = [float(-10 * torch.log10(errors[kind].mean())) for kind in errors]
        values = (name, seed, arm, start, budget, seconds, lens_seconds, steps, len(case.test), *levels)
        values += (*gains["wiener"], *gains["network"])
        rows.append({key: round(v, 4) if isinstance(v, float) else v for key, v in zip(COLUMNS, values, strict=True)})
        print(rows[-1], flush=True)
    return rows


def stored() -> list[dict]:
    if not ROWS.exists():
        return []
    with ROWS.open(newline="") as file:
        return list(csv.DictReader(file))


def measure(names: Sequence[str], pictures: Pictures) -> None:
    """Seed 0 of all lenses first."""
    for seed in range(SEEDS):
        for name in names:
            if any((row["lens"], row["seed"]) == (name, str(seed)) for row in stored()):
                continue
            rows, is_new = run(name, seed, pictures), not ROWS.exists()
            with ROWS.open("a", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                if is_new:
                    writer.writeheader()
                writer.writerows(rows)


def interval(gains: np.ndarray) -> str:
    """Mean and 95 % interval by Student's t."""
    if len(gains) == 1:
        return f"{gains[0]:+.2f}"
    half = scipy.stats.t.ppf(0.975, len(gains) - 1) * gains.std(ddof=1) / np.sqrt(len(gains))
    return f"{gains.mean():+.2f} ± {half:.2f} ({gains.min():+.2f} … {gains.max():+.2f})"


def table() -> None:
    for name, start, budget in itertools.product(second_order.LENSES, second_order.STARTS, BUDGETS):
        of = {arm: [row for row in stored() if (row["lens"], row["start"], row["budget"], row["arm"])
                    == (name, start, budget, arm)] for arm in ("lm", "each", "adam")}  # fmt: skip
        for kind in ("wiener", "network"):
            gains = {arm: np.array([float(row[f"{kind}_gain"]) for row in rows]) for arm, rows in of.items() if rows}
            said = [f"{arm} {interval(each)}" for arm, each in gains.items()]
            said += [f"lm less adam {interval(gains['lm'] - gains['adam'])}"] if gains else []
            if said:
                print(f"{name:20} from {start:6}{budget:12}{kind:8} {'   '.join(said)}, {len(of['lm'])} seeds")
    for name in second_order.LENSES:
        rows = [row for row in stored() if (row["lens"], row["start"], row["budget"]) == (name, "spots", BUDGETS[0])]
        for arm in ("spots", "lm", "adam"):
            of_arm = [row for row in rows if row["arm"] == arm]
            if of_arm:
                medians = (np.median([float(row[key]) for row in of_arm]) for key in COLUMNS[5:8])
                print("{:20} {:6} {:.0f} s, of these {:.1f} s for the lens, {:.0f} steps".format(name, arm, *medians))


def options(parser: argparse.ArgumentParser) -> None:
    """The options of this script."""
    parser.add_argument("--data", metavar="DIR", help="folder of pictures; four fifths train, the others test")
    parser.add_argument("--lens", nargs="+", choices=[*second_order.LENSES], default=[*second_order.LENSES],
                        help="of these lenses alone")  # fmt: skip
    parser.add_argument("--table", action="store_true", help="print the table alone")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    asked = parser.parse_args()
    if asked.table:
        table()
    else:
        torch.set_num_threads(1)
        prepare()
        warnings.simplefilter("ignore")  # rays that miss the stop of the files
        measure(asked.lens, read(files(asked.data), least=PATCH + WINDOW - 1))

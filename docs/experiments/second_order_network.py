"""Restored dB of five lenses behind a Wiener filter and behind a small network: the lens of the best spots, that of the
closed form by steps of second order, and that of Adam, lens and network together, in equal processor time.

    python docs/experiments/second_order_network.py --data DIR   # runs what the CSV lacks, a lens and seed at a time
    python docs/experiments/second_order_network.py --table      # prints the table of docs/reference/loss.md

Lenses, variables, bounds, pixels and displaced starts are those of second_order.py; a seed also decides the weights of
the network, the patches and their noise. All arms start at the best spots of a seed. Each has the same seconds of
processor time of one thread for lens and network together; Adam's rates fall to 0 along half a cosine of the time that
remains. `lm`: the lens at the minimum of the error behind a Wiener filter of each field, then the network; `adam`: the
rate of the lens is the best one of second_order.csv. Losses are mean square errors. PSFs are polychromatic, of 217 rays
a field and colour in training and of 817 in the test. Test pictures are in no training: one patch of each, at every
field and distance. Gains are over the best spots of the same seed, with 95 % intervals over the test pictures.
"""

import argparse
import csv
import time
import warnings
from pathlib import Path

import numpy as np
import second_order
import torch
from torch import Tensor

import raytrace as rt
from raytrace.imaging.closed_form import patch_spectrum
from raytrace.imaging.image import blur, transfer_functions
from raytrace.imaging.lens_steps import LensSteps
from raytrace.imaging.network import UNetShape, network
from raytrace.imaging.pictures import Pictures, crop, draws, files, read, split
from raytrace.imaging.restoration import depth_invariant_wiener, kernel_error, restore
from raytrace.optimization.quantities import Points
from raytrace.tracing.compiled import prepare

ROWS = Path(__file__).parents[1] / "second_order_network.csv"
BUDGET = 40.0  # s of processor time of an arm
SEEDS = {name: 1 for name in second_order.LENSES} | {"cooke_triplet": 3}
WINDOW, PATCH, BATCH = 41, 64, 8
RINGS, TEST_RINGS = 8, 16
RATE = 2e-3  # of the network
INF = float("inf")
COLUMNS = (
    *("lens", "seed", "arm", "budget", "seconds", "lens_seconds", "network_steps", "patches", "wiener", "network"),
    *("wiener_gain", "wiener_low", "wiener_high", "network_gain", "network_low", "network_high"),
)


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
    """A lens at the best spots of a displaced start, its PSFs and its pictures."""

    def __init__(self, name: str, seed: int, pictures: Pictures):
        self.design, self.name, self.seed = second_order.LENSES[name], name, seed
        case, started = second_order.Case(name, seed), time.process_time()
        words = self.design.vary.split()
        words = [word for word in words if not word.startswith("curvature")] + [
            *(word for word in words if word.startswith("curvature")), f"curvature:{self.design.solved}"
        ]  # fmt: skip
        self.variables = rt.Variables(
            case.model.lens_at(case.start), " ".join(words), bounds=self.design.bounds or None, hold="efl", step="blur"
        )
        LensSteps(self.variables).minimise_spots()
        self.spot_seconds = time.process_time() - started
        self.at_spots = {key: part.clone() for key, part in self.variables.state_dict().items()}
        distances = self.design.distances
        self.distances = None if distances is None else torch.tensor(distances, dtype=torch.float64)
        self.train, self.test = split(pictures)
        self.spectrum = patch_spectrum(self.train, PATCH + WINDOW - 1, crops=1)

    def kernels(self, rings: int = RINGS) -> Tensor:
        """PSFs (D, F, rows, columns) on pixels about the centroid of all colours, of energy 1."""
        points = Points(rings)(self.variables(), self.distances)
        return kernels_of(transfer_of(points, self.design.pixel, WINDOW))

    def closed_form(self) -> Tensor:
        return kernel_error(self.kernels(), self.spectrum, second_order.NOISE).mean()

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


def trained(case: Case, seconds: float, rate: float) -> tuple[torch.nn.Module, int]:
    """A network after so many seconds of processor time, and its steps; rate: of the lens, 0 if it is fixed."""
    started, unet = time.process_time(), network(UNetShape(2, 8), seed=case.seed)
    case.variables.requires_grad_(rate > 0)
    groups = [{"params": [*unet.parameters()], "lr": RATE}]
    groups += [{"params": [*case.variables.parameters()], "lr": rate}] if rate else []
    optimizer, rates, step = torch.optim.Adam(groups), [group["lr"] for group in groups], 0
    fixed = None if rate else case.kernels().detach()
    before = {}
    while (elapsed := time.process_time() - started) < seconds:
        random, generator = draws(case.seed, step, 1), torch.Generator().manual_seed(10**6 * (case.seed + 1) + step)
        patches = case.patches(case.train, range(step * BATCH, (step + 1) * BATCH), case.seed * 1000 + step)
        kernels = case.kernels() if fixed is None else fixed
        chosen = kernels.flatten(0, 1)[random.integers(kernels.shape[0] * kernels.shape[1], size=BATCH)].float()
        restored = unet(recorded(patches, chosen, generator)[:, None])[:, 0]
        loss = (restored - target(patches)).square().mean()
        if not torch.isfinite(loss):  # rays fail: the lens is fixed where they arrived
            case.variables.load_state_dict(before)
            fixed, rates[1] = case.kernels().detach(), 0.0
            continue
        if fixed is None:
            before = {key: part.clone() for key, part in case.variables.state_dict().items()}
        for group, largest in zip(optimizer.param_groups, rates, strict=True):
            group["lr"] = largest * 0.5 * (1 + np.cos(np.pi * elapsed / seconds))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        if fixed is None:
            case.variables.project()
        step += 1
    return unet, step


@torch.no_grad()
def tested(case: Case, unet: torch.nn.Module) -> dict[str, Tensor]:
    """Mean square error (N,) of every test picture, over all fields and distances, by restoration."""
    kernels, generator = case.kernels(TEST_RINGS), torch.Generator().manual_seed(0)
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


def run(name: str, seed: int, pictures: Pictures) -> list[dict]:
    """Rows of the three arms."""
    case = Case(name, seed, pictures)
    rates = {"spots": 0.0, "lm": 0.0, "adam": second_order.best_rate(name, "spots")}
    rows, reference = [], {}
    for arm, rate in rates.items():
        case.variables.load_state_dict(case.at_spots)
        case.variables.requires_grad_(True)
        started = time.process_time()
        if arm == "lm":
            LensSteps(case.variables).minimise(case.closed_form)
        lens_seconds = case.spot_seconds + time.process_time() - started
        unet, steps = trained(case, BUDGET - lens_seconds, rate)
        seconds = case.spot_seconds + time.process_time() - started
        errors = tested(case, unet)
        reference = reference or errors
        gains = {kind: gain(errors[kind], reference[kind]) for kind in errors}
        levels = [float(-10 * torch.log10(errors[kind].mean())) for kind in errors]
        values = (name, seed, arm, BUDGET, seconds, lens_seconds, steps, len(case.test), *levels)
        values += (*gains["wiener"], *gains["network"])
        rows.append({key: round(v, 4) if isinstance(v, float) else v for key, v in zip(COLUMNS, values, strict=True)})
        print(rows[-1], flush=True)
    return rows


def stored() -> list[dict]:
    if not ROWS.exists():
        return []
    with ROWS.open(newline="") as file:
        return list(csv.DictReader(file))


def measure(pictures: Pictures) -> None:
    """Seed 0 of all lenses first."""
    for seed in range(max(SEEDS.values())):
        for name in second_order.LENSES:
            if seed >= SEEDS[name] or any((row["lens"], row["seed"]) == (name, str(seed)) for row in stored()):
                continue
            rows, is_new = run(name, seed, pictures), not ROWS.exists()
            with ROWS.open("a", newline="") as file:
                writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
                if is_new:
                    writer.writeheader()
                writer.writerows(rows)


def table() -> None:
    for row in stored():
        kinds = "   ".join(
            f"{kind} {float(row[kind]):.2f} dB, {float(row[f'{kind}_gain']):+.2f} ({float(row[f'{kind}_low']):+.2f} … "
            f"{float(row[f'{kind}_high']):+.2f})"
            for kind in ("wiener", "network")
        )
        print(f"{row['lens']:20} seed {row['seed']} {row['arm']:6} {kinds}   {row['lens_seconds']} s, "
              f"{row['network_steps']} steps, {row['patches']} pictures")  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    """The options of this script."""
    parser.add_argument("--data", metavar="DIR", help="folder of pictures; four fifths train, the others test")
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
        measure(read(files(asked.data), least=PATCH + WINDOW - 1))

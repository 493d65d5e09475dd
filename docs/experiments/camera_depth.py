"""Depth from defocus: sensor distances learned for depth, for restoration and for both, by Gaussian, DRT and wave PSFs.

    python docs/experiments/camera_depth.py double_gauss --data DIR -o FOLDER --docs docs

Everything is in closed form for Gaussian random fields of the pictures' power spectrum (`depth_estimation.py`,
`imaging.restoration`), and differentiable in the sensor distance. Learned cameras are then tested on patches of unseen
pictures, imaged by wave PSFs. A second call computes what is missing.
"""

import argparse
import csv
import dataclasses
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from depth_estimation import (
    blurred_spectra,
    cramer_rao,
    expected_log_likelihood_ratios,
    expected_square_error,
    most_likely,
)
from experiments import Store
from scipy.stats import t as student
from torch import Tensor

from raytrace.imaging.closed_form import patch_spectrum
from raytrace.imaging.image import blur, transfer_functions, visible
from raytrace.imaging.pictures import Pictures, crop, digest, draws, files, read, split
from raytrace.imaging.restoration import (
    depth_invariant_error,
    depth_invariant_wiener,
    mean_square_error,
    power_spectrum,
    psnr,
    restore,
)
from raytrace.imaging.variables import Variables
from raytrace.io import as_lens
from raytrace.maths.sampling import grid
from raytrace.optimization.least_squares import minimise_tensors
from raytrace.plotting.style import FIELD_COLOURS, new_figure, save
from raytrace.psf_models import Execution, model_of, psf
from raytrace.system.lens import Lens
from raytrace.tracing.compiled import prepare
from raytrace.tracing.paraxial import paraxial_image_distance
from raytrace.tracing.scene import Memo

F_NUMBER, NEAR, FAR, NOISE = 3.0, 10e3, 50e3, 0.1
PIXEL, WINDOW, PATCH, DEPTHS = 0.005, 91, 96, 97  # mm, pixels across kernels and patches, places of equal 1/z
PIXELS = 64**2  # of a patch of likelihoods: 96 × 96 under a Hann window tell as much
#: PSF models and their order: finer ones change no digit shown.
MODELS = {"gaussian": 10, "drt": 4, "wave": -1}
NAMES = {"gaussian": "Gaussian", "drt": "DRT", "wave": "wave"}
WEIGHTS = (0.0, 0.25, 0.5, 1.0)  # w of depth, in w ln √D + (1 - w) ln R
SENSORS = np.linspace(-0.6, 0.5, 23)  # mm from the paraxial image at 25 m
_CROPS, _TEST = 2, 10_000  # patches of each test picture; number of the epoch of the test
_CONTRASTS = 2.0 ** np.arange(-5.0, 3.0)
_STEP = 2e-7  # 1/mm, for derivatives by 1/z
_BOUNDS = slice(4, None, 8)  # places at which the bound is computed


@dataclasses.dataclass(frozen=True)
class Setup:
    """A lens and the power spectrum (rows, columns) of patches."""

    lens: Lens
    spectrum: Tensor

    @cached_property
    def middle(self) -> float:
        """Paraxial sensor distance of an object at 25 m, mm."""
        return float(paraxial_image_distance(self.lens, self.spectrum.new_tensor(25e3)))

    @cached_property
    def places(self) -> Tensor:
        """Reciprocal distances, 1/mm."""
        return torch.linspace(1 / FAR, 1 / NEAR, DEPTHS, dtype=torch.float64)


class Design:
    """A camera of one PSF model whose sensor distance is a variable."""

    def __init__(self, setup: Setup, model: str):
        self.setup, self.model, self.memo = setup, model, Memo()
        lens = setup.lens.at(sensor_distance=setup.middle)
        self.variables = Variables(lens, "sensor")
        self.sensor = self.variables.get_parameter("sensor")

    def kernels(self, places: Tensor) -> Tensor:
        """PSFs (D, h, w) of sum 1 on the axis, of reciprocal distances (D,) 1/mm."""
        return psf(
            self.variables(),
            model_of(self.model, order=MODELS[self.model]),
            fields=places.new_zeros(2, 1),
            object_distances=1 / places,
            grid=grid(places.new_tensor(PIXEL), WINDOW),
            normalise="window",
            execution=Execution(memo=self.memo),
        ).kernel[:, 0]

    def transfer(self, places: Tensor) -> Tensor:
        return transfer_functions(self.kernels(places), PATCH)

    def errors(self) -> tuple[Tensor, Tensor]:
        """√D, the RMS error of 1/z of a patch, 1/mm, and R, the mean square error of a restored pixel."""
        H, S = self.transfer(self.setup.places), self.setup.spectrum
        D = expected_square_error(blurred_spectra(H, S, NOISE), self.setup.places, pixels=PIXELS).mean()
        return D.sqrt(), depth_invariant_error(H, S, NOISE)

    @torch.no_grad()
    def report(self, sensor: float) -> dict[str, float]:
        """Predictions at a sensor distance, mm from `middle`.

        Depth error and Cramér-Rao bound (median), mD; PSNR, dB; expected log-likelihood ratio of objects at the ends of
        the range, nats; mean square error of a restored pixel.
        """
        self.sensor.fill_(sensor)
        places, S = self.setup.places, self.setup.spectrum
        H = self.transfer(places)
        P = blurred_spectra(H, S, NOISE)
        D, R = expected_square_error(P, places, pixels=PIXELS).mean(), depth_invariant_error(H, S, NOISE)
        some = places[_BOUNDS]
        sides = [blurred_spectra(self.transfer(some + step), S, NOISE) for step in (-_STEP, _STEP)]
        bound = cramer_rao(P[_BOUNDS], (sides[1] - sides[0]) / (2 * _STEP), pixels=PIXELS)
        ratios = expected_log_likelihood_ratios(P, pixels=PIXELS)
        return {
            "depth_mD": 1e6 * float(D.sqrt()),
            "bound_mD": 1e6 * float(bound.median().sqrt()),
            "psnr_dB": float(psnr(R)),
            "ratio": float(ratios[0, -1]),
            "error": float(R),
        }


@torch.no_grad()
def ratio_of_ends(design: Design, sensor: float) -> float:
    """Expected log-likelihood ratio of an object at 50 m and one at 10 m, nats, at a sensor distance from `middle`."""
    design.sensor.fill_(sensor)
    ends = design.setup.places[[0, -1]]
    spectra = blurred_spectra(design.transfer(ends), design.setup.spectrum, NOISE)
    return float(expected_log_likelihood_ratios(spectra, pixels=PIXELS)[0, 1])


def learned(design: Design, weight: float, scan: Sequence[dict]) -> float:
    """The sensor distance, mm from `middle`, of least w ln √D + (1 - w) ln R; scan: reports at SENSORS."""
    losses = [weight * np.log(row["depth_mD"]) + (1 - weight) * np.log(row["error"]) for row in scan]

    def loss() -> Tensor:
        depth, error = design.errors()
        return weight * depth.log() + (1 - weight) * error.log()

    with torch.no_grad():
        design.sensor.fill_(SENSORS[int(np.argmin(losses))])
    bounds = [(SENSORS[0], SENSORS[-1])]
    minimise_tensors([design.sensor], loss, unit=0.3, bounds=bounds, tolerance=1e-7, steps=6)
    return float(design.sensor.detach())


# -- patches of pictures


@torch.no_grad()
def tested(design: Design, estimators: dict[str, Tensor], pictures: Pictures, seed: int) -> dict[str, float]:
    """RMS and median error of the most likely 1/z, mD, and PSNR, dB, of test patches imaged by the design's PSFs.

    estimators: transfer functions of the likelihood, by name; the restoration filter is that of the design's PSFs.
    """
    places, S = design.setup.places, design.setup.spectrum
    count = _CROPS * len(pictures)
    picture = torch.stack([
        torch.as_tensor(crop(pictures, k, epoch=_TEST, size=PATCH + WINDOW - 1, crops=_CROPS, seed=seed)).double()
        for k in range(count)
    ])  # fmt: skip
    random = draws(seed, _TEST, 7)
    place = torch.as_tensor(random.uniform(1 / FAR, 1 / NEAR, count))
    image = blur(picture, design.kernels(place)) + NOISE * torch.as_tensor(
        random.standard_normal((count, PATCH, PATCH))
    )
    H = design.transfer(places)
    restored = restore(image, depth_invariant_wiener(H, S, NOISE))
    error = mean_square_error(restored, visible(picture, (WINDOW, WINDOW)), margin=PATCH // 6)
    found = {"psnr_dB": float(psnr(error.mean()))}
    periodograms = torch.cat([power_spectrum(one[None])[None] for one in image])
    for name, transfer in estimators.items():
        number = most_likely(periodograms, transfer, S, NOISE, torch.as_tensor(_CONTRASTS))
        wrong = 1e6 * (places[number] - place)
        found |= {
            f"depth_mD_{name}": float(wrong.square().mean().sqrt()),
            f"median_mD_{name}": float(wrong.abs().median()),
        }
    return found


@torch.no_grad()
def of_fields(transfer: Tensor, setup: Setup, count: int = 400) -> float:
    """RMS error of the most likely 1/z of Gaussian random fields of the spectra, mD, over its expectation."""
    places, P = setup.places, blurred_spectra(transfer, setup.spectrum, NOISE)
    random = draws(0, _TEST, 8)
    number = torch.as_tensor(random.integers(len(places), size=count))
    white = torch.fft.fft2(torch.as_tensor(random.standard_normal((count, PATCH, PATCH))))
    periodograms = P[number] * (white.real**2 + white.imag**2) / PATCH**2
    found = most_likely(periodograms, transfer, setup.spectrum, NOISE, P.new_ones(1))
    expected = expected_square_error(P, places)[number].mean()
    return float(((places[found] - places[number]).square().mean() / expected).sqrt())


# -- tables and the figure


def interval(values: Sequence[float]) -> tuple[float, float]:
    """Mean and half width of its 95 % interval of Student's t."""
    width = student.ppf(0.975, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values))
    return float(np.mean(values)), float(width)


def with_interval(values: Sequence[float], form: str) -> str:
    mean, width = interval(values)
    return f"{mean:{form}} ± {width:{form.lstrip('+')}}"


def table(rows: list[dict], tests: list[dict]) -> str:
    """A line for each design."""
    heads = ["design model", "weight of depth", "sensor, mm", "expected depth error, own PSFs, mD", "waves"]
    heads += ["depth error of pictures, mD", "PSNR of pictures, dB"]
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    for row in rows:
        own = [one for one in tests if (one["model"], one["weight"]) == (row["model"], row["weight"])]
        cells = [NAMES[row["model"]], f"{row['weight']:g}", f"{row['sensor_mm']:+.3f}"]
        cells += [f"{row[f'depth_mD_{judge}']:.2f}" for judge in (row["model"], "wave")]
        cells += [with_interval([one[key] for one in own], ".2f") for key in ("depth_mD_wave", "psnr_dB")]
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def differences(tests: list[dict], model: str, weight: float, key: str) -> list[float]:
    """Designs of a model less those of waves, by seed."""
    by = {(one["model"], one["weight"], one["seed"]): one[key] for one in tests}
    seeds = sorted({one["seed"] for one in tests})
    return [by[model, weight, seed] - by["wave", weight, seed] for seed in seeds]


def summary(rows: list[dict], tests: list[dict], designs: dict[str, Design]) -> str:
    """Paired differences, and log-likelihood ratios, as text."""
    lines = ["designs less those of waves: depth error of pictures, mD; PSNR, dB"]
    for model in ("gaussian", "drt"):
        for weight in WEIGHTS:
            depth, ratio = (differences(tests, model, weight, key) for key in ("depth_mD_wave", "psnr_dB"))
            lines.append(f"{model} {weight:g}: {with_interval(depth, '+.2f')}, {with_interval(ratio, '+.3f')}")
    own = [one for one in tests if (one["model"], one["weight"]) == ("wave", 0)]
    words = (f"{model} {with_interval([one[f'depth_mD_{model}'] for one in own], '.2f')}" for model in MODELS)
    lines.append("error of Gaussian fields over its expectation: " + ", ".join(f"{row['fields']:.2f}" for row in rows))
    lines.append("expected log-likelihood ratio of 50 m and 10 m by sensor distance: " + ", ".join(MODELS))
    for sensor in (-0.023, -0.01, -0.0075, -0.005, 0.0):
        lines.append(f"{sensor:+.4f}: " + ", ".join(f"{ratio_of_ends(one, sensor):.2f}" for one in designs.values()))
    lines.append("estimates of the wave design of restoration by likelihoods of other PSFs: " + "; ".join(words))
    return "\n".join(lines)


def figure(rows: list[dict], tests: list[dict], scans: dict[str, list[dict]]):
    """Expected depth error over the sensor distance, and against PSNR with the learned designs, as waves judge them."""
    drawn = new_figure(10.0, 3.6)
    left, middle, right = drawn.subplots(1, 3)
    for (model, name), colour in zip(NAMES.items(), FIELD_COLOURS, strict=False):
        scan = scans[model]
        left.semilogy(SENSORS, [row["depth_mD"] for row in scan], color=colour, label=f"{name} PSFs", lw=1.3)
        own = [row for row in rows if row["model"] == model]
        middle.semilogy(
            [row["psnr_dB"] for row in scan], [row["depth_mD"] for row in scan], color=colour, lw=0.8, alpha=0.5
        )
        look = {"marker": "os^"[list(NAMES).index(model)], "ms": 5, "ls": "", "color": colour}
        middle.plot(
            [row["psnr_dB_wave"] for row in own],
            [row["depth_mD_wave"] for row in own],
            label=f"learned by {name}",
            **look,
        )
        for row in own:
            values = [one for one in tests if (one["model"], one["weight"]) == (model, row["weight"])]
            x, y = ([one[key] for one in values] for key in ("psnr_dB", "depth_mD_wave"))
            (x, dx), (y, dy) = interval(x), interval(y)
            right.errorbar(x, y, dy, dx, capsize=2, lw=0.8, **look)
    left.set(xlabel="sensor distance from the image of 25 m (mm)", ylabel="expected error of 1/z (mD)")
    middle.set(xlabel="expected PSNR (dB)", ylabel="expected error of 1/z (mD)")
    middle.set_title("closed form; points: by wave PSFs", fontsize=9)
    right.set(xlabel="PSNR (dB)", ylabel="RMS error of 1/z (mD)")
    right.set_title("pictures, imaged by wave PSFs", fontsize=9)
    for panel in (left, middle):
        panel.set_yticks([2, 3, 5, 10, 20, 30], ["2", "3", "5", "10", "20", "30"])
        panel.minorticks_off()
    left.set_title("closed form", fontsize=9)
    left.legend(fontsize=7)
    middle.legend(fontsize=7)
    return drawn


def write_csv(path: Path, rows: list[dict]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, [*rows[0]], lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lens")
    parser.add_argument("--data", required=True, help="folder of pictures")
    parser.add_argument("--limit", type=int, default=200, help="pictures, evenly spaced")
    parser.add_argument("-o", dest="folder", type=Path, required=True, help="folder of the results")
    parser.add_argument("--docs", type=Path, help="folder of documentation, for the tables and the figure")
    parser.add_argument("--seeds", type=int, default=5)


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    chosen = parser.parse_args(words)
    torch.set_num_threads(1)
    prepare()
    lens = as_lens(chosen.lens, "the study").at(f_number=F_NUMBER)
    train, test = split(read(files(chosen.data, chosen.limit), least=PATCH + WINDOW - 1))
    about = {"lens": chosen.lens, "pictures": digest(train.samples), "models": MODELS, "sizes": [PATCH, WINDOW, DEPTHS]}
    store = Store(chosen.folder, about)
    setup = Setup(lens, patch_spectrum(train, PATCH))
    designs = {model: Design(setup, model) for model in MODELS}

    def reports(model: str) -> dict[str, np.ndarray]:
        found = [designs[model].report(sensor) for sensor in SENSORS]
        return {key: np.array([row[key] for row in found]) for key in found[0]}

    scans = {}
    for model in MODELS:
        arrays = store.arrays(f"scan_{model}", lambda model=model: reports(model))
        scans[model] = [{key: float(array[k]) for key, array in arrays.items()} for k in range(len(SENSORS))]
    rows, tests = [], []
    for model in MODELS:
        for weight in WEIGHTS:
            key = f"{model}_{weight:g}"
            sensor = store.number(key, lambda m=model, w=weight: learned(designs[m], w, scans[m]))
            row = {"model": model, "weight": weight, "sensor_mm": sensor}
            for judge, design in designs.items():
                row |= {f"{name}_{judge}": value for name, value in design.report(sensor).items() if name != "error"}
            rows.append(row)
            with torch.no_grad():
                for design in designs.values():
                    design.sensor.fill_(sensor)
                estimators = {name: design.transfer(setup.places) for name, design in designs.items()}
            row["fields"] = store.number(f"fields_{key}", lambda t=estimators["wave"]: of_fields(t, setup))
            for seed in range(chosen.seeds):

                def measure(estimators=estimators, seed=seed) -> dict[str, np.ndarray]:
                    found = tested(designs["wave"], estimators, test, seed)
                    return {name: np.array(value) for name, value in found.items()}

                found = store.arrays(f"{key}_{seed}", measure)
                tests.append({"model": model, "weight": weight, "seed": seed} | {k: float(v) for k, v in found.items()})
            print(row, flush=True)
    print(table(rows, tests))
    print(summary(rows, tests, designs))
    if chosen.docs:
        write_csv(chosen.docs / "camera_depth.csv", rows)
        write_csv(chosen.docs / "camera_depth_pictures.csv", tests)
        save(figure(rows, tests, scans), chosen.docs / "camera_depth.png")


if __name__ == "__main__":
    main()

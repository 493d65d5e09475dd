"""Error of the kernels of a rendering against its processor time, by tolerance.

The reference is the DRT PSF of order 4 at random pixels, at 41 wavelengths over the response of the sensor.
"""

import argparse
import sys
import time
import warnings
from collections.abc import Sequence

import torch

import raytrace as rt
from raytrace.imaging.field_kernels import field_kernels
from raytrace.imaging.render import optics
from raytrace.imaging.varying_blur import bilinear
from raytrace.words import RaytraceWarning


def measure(arguments: argparse.Namespace) -> None:
    lens, generator = rt.read_lens(arguments.lens), torch.Generator().manual_seed(0)
    sensor = rt.Sensor((24, 16), (240, 160), response="rgb")
    row, column = (torch.randint(count, (arguments.places,), generator=generator) for count in (160, 240))
    print(f"{'tol':>6} {'places':>8} {'colours':>7} {'s':>7} {'mean':>8} {'largest':>8}   Σ|h - ĥ|")
    for tol in arguments.tol:
        started = time.process_time()
        ready = optics(lens, sensor, tol=tol)
        seconds = time.process_time() - started
        kernels = ready.kernels[:, :, 0]
        (m, n), size = kernels.shape[:2], kernels.shape[-1]
        down, right = bilinear(160, 0, m, like=kernels)[:, row], bilinear(240, 0, n, like=kernels)[:, column]
        between = torch.einsum("mk,nk,mncij->kcij", down, right, kernels)
        sampled = lens.at(wavelengths=[float(lens.primary), *torch.linspace(0.35, 0.70, 41).tolist()])
        weights = sensor.weights(sampled.wavelengths)
        distance = lens.surfaces[0].thickness.reshape(-1)
        exact = field_kernels(sampled, sensor, "drt", 4, size, distance, weights).at(sensor.points(column, row))[:, 0]
        error = (between - exact).abs().sum((-2, -1))
        numbers = f"{tol:>6g} {m:>4}×{n:<3} {len(ready.wavelengths):>7} {seconds:>7.1f}"
        print(f"{numbers} {error.mean():>8.1e} {error.max():>8.1e}", flush=True)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("lens", nargs="?", default="cooke_triplet", help="file, or name of a shipped lens")
    parser.add_argument("--tol", type=float, nargs="+", default=[0.1, 0.03, 0.01], help="tolerances")
    parser.add_argument("--places", type=int, default=16, help="pixels whose kernels are compared")


def main(words: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    options(parser)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RaytraceWarning)
        measure(parser.parse_args(words))


if __name__ == "__main__":
    sys.exit(main())

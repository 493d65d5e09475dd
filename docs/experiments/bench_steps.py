"""Processor time of training steps of cameras: python bench_steps.py [clipped] [built] [element] [stop]

clipped: eight colour patches at eight places and object distances, forward and backward by curvatures and thicknesses,
through a lens without rims and with rims at its semi-diameters, or a share of them, in turns.
built: kernels of perturbed lenses, each at its own place and object distance, three wavelengths; the sensor follows the
best focus of each lens.
element: kernels of a height map of 200 × 200 pixels without a lens at four object distances, forward and backward by
all heights.
stop: the same at the stop of the double Gauss, by `rt.wave_optics.hybrid_psf`.
"""

import argparse
import dataclasses
import statistics
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence

import torch
from second_order import c_mount
from torch import Tensor

import raytrace as rt
from raytrace.system.apertures import Aperture
from raytrace.tracing.launch import stop_radius

REPEATS = 3
PATCHES, SIDE, WINDOW = 8, 128, 51


def medians(jobs: Mapping[str, Callable[[], object]]) -> dict[str, float]:
    """Median processor time, s, of each job; they take turns."""
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for turn in range(REPEATS + 1):
        for name, job in jobs.items():
            start = time.process_time()
            job()
            if turn:  # the first turn warms up
                times[name].append(time.process_time() - start)
    return {name: statistics.median(some) for name, some in times.items()}


def with_rims(lens: rt.Lens, share: float) -> rt.Lens:
    """The lens with rims of a share of its semi-diameters at all surfaces but the stop."""
    surfaces = list(lens.surfaces)
    for number, surface in enumerate(surfaces[1:-1], 1):
        if surface.semi_diameter is not None and number != lens.stop:
            rim = Aperture("circular", (0.0, share * float(surface.semi_diameter)))
            surfaces[number] = dataclasses.replace(surface, apertures=(rim,))
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


#: The lens, the share of its semi-diameters that its rims have, and the size of the sensor in mm.
LENSES: Mapping[str, tuple[Callable[[], rt.Lens], float, tuple[float, float]]] = {
    "Cooke triplet": (lambda: rt.read_lens("cooke_triplet"), 0.8, (28.8, 21.6)),
    "double Gauss": (lambda: rt.read_lens("double_gauss"), 1.0, (24.0, 18.0)),
    "C-mount lens": (c_mount, 0.25 * 0.7, (8.8, 6.6)),
}


def patches_step(lens: rt.Lens, size: tuple[float, float], model: str) -> Callable[[], Tensor]:
    """A step of patches at places and distances of their own; returns the loss."""
    sensor = rt.Sensor(size=size, pixels=(4096, 3072), response="rgb")
    chosen = rt.psf_models.Gaussian(order=4) if model == "gaussian" else rt.psf_models.DRT(order=0)
    camera = rt.Camera(
        rt.Variables(lens, "curvature thickness"), torch.nn.Identity(), sensor=sensor, model=chosen, pixels=WINDOW
    )
    draws = torch.Generator().manual_seed(1)
    pictures = torch.rand(PATCHES, 3, SIDE + WINDOW - 1, SIDE + WINDOW - 1, generator=draws)
    shares = torch.tensor([0.0, 0.7, 1.0] * 3, dtype=torch.float64)[:PATCHES]
    points = 0.5 * shares * torch.tensor(size, dtype=torch.float64)[:, None]
    distances = 1 / torch.linspace(1 / 5e4, 1 / 1e4, PATCHES, dtype=torch.float64)

    def step() -> Tensor:
        camera.zero_grad()
        loss = camera.image(pictures, distances, points=points).square().mean()
        loss.backward()
        return loss.detach()

    return step


def clipped() -> None:
    for name, (lens_of, share, size) in LENSES.items():
        lens = rt.focus(lens_of()).lens
        for model in ("gaussian", "drt"):
            free, clips = medians(
                {rims: patches_step(one, size, model) for rims, one in (("no", lens), ("yes", with_rims(lens, share)))}
            ).values()
            print(
                f"{name}, {model}: {1e3 * free:.0f} ms, with rims {1e3 * clips:.0f} ms, × {clips / free:.1f}",
                flush=True,
            )


def built() -> None:
    for aiming in ("off", "real"):
        lens = rt.focus(rt.read_lens("double_gauss")).lens.at(wavelengths=[0.48, 0.55, 0.64], ray_aiming=aiming)
        tolerances, sensor = rt.tolerances(lens, grade="precision"), rt.Sensor((18, 12), (3600, 2400), response="rgb")
        camera = rt.Camera(
            rt.Variables(lens, "curvature sensor"), torch.nn.Identity(), sensor=sensor, tolerances=tolerances,
            model=rt.psf_models.Gaussian(order=4),
        )  # fmt: skip
        for count in (8, 32, 128):
            draws = torch.Generator().manual_seed(3)
            points = (torch.rand(2, count, generator=draws, dtype=torch.float64) - 0.5) * torch.tensor([[18.0], [12.0]])
            distances = 1 / torch.empty(count, dtype=torch.float64).uniform_(1 / 5e4, 1 / 1e4, generator=draws)
            errors = rt.tolerancing.draw_errors(tolerances, count, seed=1)

            def kernels(points=points, distances=distances, errors=errors, camera=camera):
                with torch.no_grad():
                    return camera.kernels(distances, errors=errors, points=points)

            def step(points=points, distances=distances, errors=errors, camera=camera):
                camera.zero_grad()
                camera.kernels(distances, errors=errors, points=points).square().sum().backward()

            alone, both = (count / seconds for seconds in medians({"kernels": kernels, "step": step}).values())
            print(f"aiming {aiming}, {count} lenses: {alone:.0f} kernels/s, {both:.0f}/s with gradients", flush=True)


def element() -> None:
    side, aperture, focal_length = 200, 2.0, 35.5
    pitch = 1.02 * aperture / side
    x = pitch * (torch.arange(side, dtype=torch.float64) - 0.5 * (side - 1))
    square, draws = x * x + (x * x)[:, None], torch.Generator().manual_seed(0)
    heights = (square.max() - square) / focal_length + 2e-4 * torch.rand(side, side, generator=draws).double()
    variables = rt.imaging.PhaseVariables(rt.element(heights, aperture=aperture, glass=1.5, pitch=pitch))
    sensor, distances = rt.Sensor((1, 1), (200, 200)), [1e3, 2e3, 1e4, 1e5]
    camera = rt.Camera(variables, torch.nn.Identity(), sensor=sensor, sensor_distance=focal_length, wavelengths=[0.55])
    camera.plan(distances)

    def step():
        camera.zero_grad()
        camera.kernels(distances, [0] * len(distances)).square().sum().backward()

    print(f"{side} × {side} heights, {camera._sampling}: {1e3 * medians({'step': step})['step']:.0f} ms", flush=True)


def stop() -> None:
    side, distances = 200, [1e4, 2e4, 4e4, 1e5]
    for name in ("double_gauss", "tessar"):
        lens = rt.focus(rt.read_lens(name)).lens.at(wavelengths=[0.55])
        aperture = 2.1 * float(stop_radius(lens))
        heights = 2e-4 * torch.rand(side, side, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        heights.requires_grad_()

        def kernels(order, lens=lens, aperture=aperture, heights=heights):
            plate = rt.element(heights, aperture=aperture, glass=1.5, pitch=1.02 * aperture / side)
            return rt.wave_optics.hybrid_psf(lens, plate, fields=[0.0], object_distances=distances, order=order)

        def step(kernels=kernels):
            kernels(0).kernel.square().sum().backward()

        seconds = medians({"step": step})["step"]
        with torch.no_grad():
            usual, fine = kernels(0), kernels(3)
        change = (usual.kernel - fine.kernel).abs().sum((-2, -1)) / fine.kernel.sum((-2, -1))
        print(
            f"{name}, {side} × {side} heights at the stop, {int(usual.rays)} samples: {1e3 * seconds:.0f} ms; order 0 "
            f"differs from order 3 by {float(change.max()):.1e} of the light",
            flush=True,
        )


PARTS = {"clipped": clipped, "built": built, "element": element, "stop": stop}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"{', '.join(PARTS)}; by default all")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    parts = parser.parse_args(argv).parts or [*PARTS]
    if unknown := [part for part in parts if part not in PARTS]:
        parser.error(f"{unknown[0]!r} is not known; expected {', '.join(PARTS)}")
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    for part in parts:
        PARTS[part]()


if __name__ == "__main__":
    sys.exit(main())

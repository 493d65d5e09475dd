"""PSF models and a training step of a camera on a device against the CPU: python bench_device.py cuda

Prints one line for each: milliseconds with gradients on the CPU and on the device (medians of turns, warmed up), and
the largest difference of the results relative to their maximum.
"""

import statistics
import sys

import torch

import raytrace as rt
from raytrace.bench.measure import in_turns, variables, with_leaves


def psf_step(model, lens, rays=None, size=65):
    """Gradient of the energy in the central pixel with respect to all curvatures and thicknesses."""
    chosen = model if rays is None else rt.psf_models.DRT(rays=rays)
    lens, leaves = with_leaves(lens, variables(lens))

    def step():
        kernel = rt.psf(lens, chosen, fields=[0.0, 7.0, 10.0], pixel=0.004, size=size).kernel
        return kernel.detach(), torch.autograd.grad(kernel[..., size // 2, size // 2].sum(), leaves, allow_unused=True)

    return step


def training_step(device, dtype=torch.float32):
    torch.manual_seed(0)
    lens = rt.to(rt.read_lens("double_gauss"), device=device)
    camera = rt.Camera(rt.Variables(lens, "curvature sensor"), rt.imaging.RedNet(), model="gaussian").to(device)
    images = torch.rand(8, 256, 256, dtype=dtype, generator=torch.Generator().manual_seed(1)).to(device)
    distances = torch.linspace(20e3, 40e3, 8, dtype=torch.float64, device=device)

    def step():
        for parameter in camera.parameters():
            parameter.grad = None
        loss = (camera(images, distances) - camera.target(images)).square().mean()
        loss.backward()
        return loss.detach(), ()

    return step


def main(device: str) -> None:
    lens = {where: rt.to(rt.read_lens("double_gauss"), device=where) for where in ("cpu", device)}
    cases = {
        model: {w: psf_step(model, lens[w]) for w in lens} for model in ("paraxial", "fourier", "gaussian", "wave")
    }
    for rays in (10_000, 1_000_000):
        cases[f"DRT, {rays:,} rays"] = {w: psf_step("drt", lens[w], rays) for w in lens}
    cases["training step, 8 × 256², RED-Net"] = {w: training_step(w) for w in lens}
    for name, jobs in cases.items():
        results = {where: job()[0].cpu() for where, job in jobs.items()}
        error = (results[device] - results["cpu"]).abs().max() / results["cpu"].abs().max()
        seconds = in_turns(jobs, repeats=5, threads=torch.get_num_threads())
        middle = {where: 1e3 * statistics.median(times) for where, times in seconds.items()}
        print(
            f"{name}: CPU {middle['cpu']:.1f} ms, {device} {middle[device]:.1f} ms, difference {error:.1e}", flush=True
        )


if __name__ == "__main__":
    main(sys.argv[1])

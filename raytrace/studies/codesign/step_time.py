"""Time of a training step, part by part: PSFs, image formation, network, each forward and backward."""

import copy
import dataclasses
import statistics
import time
from collections.abc import Callable

import torch

from raytrace.camera.camera import Camera
from raytrace.camera.image import blur
from raytrace.studies.codesign.experiment import Batch


@dataclasses.dataclass(frozen=True)
class StepTime:
    """Median times in ms of a batch, forward and backward."""

    model: str
    psf: float
    image: float
    network: float


def step_time(camera: Camera, batch: Batch, *, repeats: int = 5) -> StepTime:
    """What the parts of one step cost with this camera and batch; the camera is left as it was, without gradients."""
    kernels = camera.kernels(batch.distance).detach().to(batch.picture.dtype).requires_grad_()
    image = camera.image(batch.picture, batch.distance).detach().requires_grad_()
    before = copy.deepcopy(camera.variables.state_dict())

    def psf() -> None:
        _nudge(camera)
        camera.kernels(batch.distance).square().sum().backward()

    found = StepTime(
        model=camera.model,
        psf=_median(psf, 4 * repeats),  # the shortest, and what models are compared by
        image=_median(lambda: blur(batch.picture, kernels).square().sum().backward(), repeats),
        network=_median(lambda: camera.restore(image).square().sum().backward(), repeats),
    )
    camera.variables.load_state_dict(before)
    camera.zero_grad(set_to_none=True)
    return found


@torch.no_grad()
def _nudge(camera: Camera) -> None:
    """Move the lens by next to nothing: what a step of training computes anew is then computed anew."""
    for parameter in camera.variables.parameters():
        parameter.add_(1e-9)


def _median(work: Callable[[], None], repeats: int) -> float:
    work()  # the first call plans and fills caches
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)

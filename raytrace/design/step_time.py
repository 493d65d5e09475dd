"""Time of a training step, part by part: PSFs, image formation, network, each forward and backward."""

import dataclasses
import statistics
import time
from collections.abc import Callable


from raytrace.design.camera import Camera
from raytrace.design.codesign import Batch
from raytrace.image import blur


@dataclasses.dataclass(frozen=True)
class StepTime:
    """Median times in ms of a batch, forward and backward."""

    model: str
    psf: float
    image: float
    network: float


def step_time(camera: Camera, batch: Batch, *, repeats: int = 5) -> StepTime:
    """What the parts of one step cost with this camera and batch; gradients of the camera are cleared."""
    kernels = camera.kernels(batch.distance).detach().to(batch.picture.dtype).requires_grad_()
    image = camera.image(batch.picture, batch.distance).detach().requires_grad_()
    found = StepTime(
        model=camera.model,
        psf=_median(lambda: camera.kernels(batch.distance).square().sum().backward(), repeats),
        image=_median(lambda: blur(batch.picture, kernels).square().sum().backward(), repeats),
        network=_median(lambda: camera.restore(image).square().sum().backward(), repeats),
    )
    camera.zero_grad(set_to_none=True)
    return found


def _median(work: Callable[[], None], repeats: int) -> float:
    work()  # the first call plans and fills caches
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        work()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)

"""PSFs of a wave scene: depth × wavelength, integrated over the pixels of the sensor, by the engine that fits."""

from torch import Tensor

from raytrace.maths.grid import Grid
from raytrace.maths.value import value
from raytrace.wave import plan as planning
from raytrace.wave.plan import Plan
from raytrace.wave.reuse import Memo
from raytrace.wave.scene import WaveScene


@value
class WavePsf:
    """Kernels of a wave scene.

    kernel: (D, W, rows, columns), light in each pixel, 1 = all through the aperture, so that its sum is the light
    inside the window; depths: (D,) mm; wavelengths: (W,) µm; grid: the pixels; plan: how it was computed, with the
    predicted error.
    """

    kernel: Tensor
    depths: Tensor
    wavelengths: Tensor
    grid: Grid
    plan: Plan

    @property
    def energy(self) -> Tensor:
        """(D, W): light inside the window."""
        return self.kernel.sum((-2, -1))

    @property
    def pitch(self) -> Tensor:
        """Of the pixels, mm."""
        return self.grid.pitch

    @property
    def engine(self) -> str:
        return self.plan.engine

    @property
    def error(self) -> float:
        """Predicted, relative L2 of the worst kernel."""
        return self.plan.error


def psf(
    scene: WaveScene,
    *,
    engine: str = "auto",
    samples: int | None = None,
    nodes: int | None = None,
    tol: float = 1e-3,
    pad: float = 2.0,
    band_limit: bool = True,
    plan: Plan | None = None,
    memo: Memo | None = None,
) -> WavePsf:
    """PSFs of a scene, differentiable in every number of it.

    engine, samples, nodes, tol, pad, band_limit: as `plan.plan` takes them. plan: of an earlier call, instead of them:
    for loops, nothing is estimated. memo: sums that do not depend on the heights, which are not made again while the
    rest of the scene stays as it is.
    Raises what `plan.plan` raises.
    """
    if plan is None:
        plan = planning.plan(
            scene, engine=engine, samples=samples, nodes=nodes, tol=tol, pad=pad, band_limit=band_limit
        )
    return WavePsf(_kernels(scene, plan, memo), scene.depths, scene.wavelengths, scene.grid, plan)


def _kernels(scene: WaveScene, plan: Plan, memo: Memo | None) -> Tensor:
    engine = planning.ENGINES[plan.engine]
    if engine.prepare is None:
        return engine.kernels(scene, None, plan)
    sums = engine.prepare(scene, plan) if memo is None else memo.find(scene, plan, engine.prepare)
    return engine.kernels(scene, sums, plan)

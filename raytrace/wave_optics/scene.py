"""WaveScene: point sources at depths on the axis, elements in contact in one round aperture, and the pixels behind it.

    U(u) = 1/(iλ) ∬_aperture exp(ik [W(x) + S(|x|², z') + S(|x - u|², z)]) (cos θ)/|x - u| dA,   k = 2π/λ

W is the path of the elements, z' the depth of the source, z the sensor distance and S the path to a point beyond that
of the axis. Every phase is a sum of such path differences, never k times a distance: at 10 m a float32 phase k·r steps
by 8 rad. The light of the source is uniform over the aperture.
"""

import torch
from torch import Tensor

from raytrace.materials.glass import check_unit, index
from raytrace.maths.numerics import value
from raytrace.maths.sampling import Grid
from raytrace.wave_optics.element import Element, is_radial, path


@value
class WaveScene:
    """The elements, sources and sensor of a wave camera.

    elements: in contact; the radius of the first is that of the aperture. sensor_distance: z, mm; depths: (D,) mm of
    point sources on the axis, inf allowed; wavelengths: (W,) µm; grid: pixels, its centre counted from the axis.
    exact: the true spheres instead of Fresnel's paraboloids.
    """

    elements: tuple[Element, ...]
    sensor_distance: Tensor
    depths: Tensor
    wavelengths: Tensor
    grid: Grid
    exact: bool = False


def check(scene: WaveScene) -> None:
    """Refuse an invalid scene: ValueError, `glass.InvalidIndex`; warns `glass.OutOfRange`."""
    if not scene.elements:
        raise ValueError("a wave scene needs an element: its radius is the aperture")
    if scene.depths.dim() != 1 or scene.wavelengths.dim() != 1 or not len(scene.depths) or not len(scene.wavelengths):
        shapes = f"depths {tuple(scene.depths.shape)} and wavelengths {tuple(scene.wavelengths.shape)}"
        raise ValueError(f"expected depths (D,) and wavelengths (W,), found {shapes}; write a single number as a list")
    if scene.grid.centre.dim() != 1:
        raise ValueError(f"a wave scene has one window, found a grid with centres {tuple(scene.grid.centre.shape)}")
    positive = {"sensor distance (mm)": scene.sensor_distance, "depths (mm; inf for a plane wave)": scene.depths}
    positive |= {"wavelengths (µm)": scene.wavelengths, "pixel pitch (mm)": scene.grid.pitch}
    for name, numbers in (positive | {"aperture radius (mm)": aperture(scene)}).items():
        if not bool((numbers > 0).all()):
            raise ValueError(f"{name} must be greater than 0, found {numbers.detach().flatten().tolist()}")
    check_unit(scene.wavelengths, (element.glass for element in scene.elements))
    if not bool(torch.isfinite(scene.sensor_distance)):
        raise ValueError("the sensor distance is infinite: put the sensor at a focal length of a lens in the aperture")
    for element in scene.elements:
        if bool(element.radius.detach() < scene.elements[0].radius.detach()):
            raise ValueError("an element is smaller than the first one, whose radius is the aperture: put it first")
        index(element.glass, scene.wavelengths)


def aperture(scene: WaveScene) -> Tensor:
    """R, mm."""
    return scene.elements[0].radius


def excess(r2: Tensor, vergence: Tensor) -> Tensor:
    """√(r² + z²) - z = r² v/(1 + √(1 + r² v²)) mm, v = 1/z: no cancellation, 0 at v = 0."""
    return r2 * vergence / (1 + torch.sqrt(1 + r2 * vergence**2))


def spheres(scene: WaveScene, r2: Tensor) -> Tensor:
    """Path (D, ...) mm from the sources to points at r² (...) mm² and on to the sensor's centre, beyond the axis's."""
    near = (1 / scene.depths).reshape(-1, *[1] * r2.dim())
    behind = 1 / scene.sensor_distance
    if not scene.exact:
        return r2 * (0.5 * (near + behind))
    return excess(r2, near) + excess(r2, behind)


def residual(scene: WaveScene, x: Tensor, y: Tensor, sphere: Tensor | None = None) -> Tensor:
    """Residual path (D, W, ...) mm to the sensor's centre through points (...) mm of the aperture.

    A lens that focuses there leaves 0. sphere: of `spheres`, if it is known.
    """
    sphere = spheres(scene, x * x + y * y) if sphere is None else sphere
    return sphere[:, None] + path(scene.elements, x, y, scene.wavelengths)


def millimetres(scene: WaveScene) -> Tensor:
    """Wavelengths (W,) mm."""
    return 1e-3 * scene.wavelengths.to(scene.sensor_distance)


def is_round(scene: WaveScene) -> bool:
    """Whether all elements depend on the distance from the axis alone."""
    return all(is_radial(element) for element in scene.elements)

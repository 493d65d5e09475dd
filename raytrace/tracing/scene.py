"""Scene: object distance × field × wavelength, and the rays of one."""

from collections.abc import Callable

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.autograd import forward_ad

from raytrace.budget import RAY_BYTES, afford
from raytrace.maths.value import value
from raytrace.system.apertures import SHAPES
from raytrace.system.lens import Lens, with_object_distance
from raytrace.system.rays import Rays
from raytrace.system.surface import is_posed, is_round
from raytrace.tracing.memo import Bundle, Memo, cross_bundle, trace_bundle
from raytrace.tracing.trace import Crossing
from raytrace.tracing.vignetting import vignette


def _own(number: Tensor) -> Tensor:
    return number


@value
class Scene:
    """Object distance × field × wavelength: batch shape (D, F, W) of everything a model computes.

    lens: its object distance is (D, 1, 1), all finite or all inf.
    fields: (2, F) in the lens's kind of field; wavelengths: (W,) µm.
    memo: rays of earlier scenes to go on from, if any.
    largest: of numbers () or (K,) that this scene has, those of the whole that it is a block of: what is decided for
        all kernels together is decided by these. The scene is the whole unless told otherwise.
    """

    lens: Lens
    fields: Tensor
    wavelengths: Tensor
    memo: Memo | None = None
    largest: Callable[[Tensor], Tensor] = _own

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, F, W)."""
        return len(self.lens.surfaces[0].thickness), self.fields.shape[1], len(self.wavelengths)

    def everywhere(self, condition: Tensor) -> bool:
        """Whether a condition () holds in all of the whole."""
        return not bool(self.largest(~condition))


def scene(lens: Lens, fields: Tensor, object_distances: Tensor, wavelengths: Tensor, memo: Memo | None = None) -> Scene:
    """A scene; object_distances: (D,) mm, all finite or all inf; fields: (2, F); wavelengths: (W,) µm."""
    return Scene(with_object_distance(lens, object_distances[:, None, None]), fields, wavelengths, memo)


def trace_scene(scene: Scene, pupil: Tensor) -> Rays:
    """Rays (3, D, F, W, P) of pupil points (2, P) or (2, D, F, W, P) on the sensor, vignetting factors applied.

    Raises budget.OverBudget for more rays than memory holds.
    """
    D, F, W = scene.shape
    P = pupil.shape[-1]
    afford(
        RAY_BYTES * D * F * W * P,
        f"{D * F * W * P:,} rays ({D} object distances × {F} fields × {W} wavelengths × {P:,} of the pupil)",
        helps="ask for fewer fields, wavelengths or pupil points",
    )
    rays = trace_bundle(_bundle(scene, pupil), scene.memo)
    batch = D, F, W, P
    return Rays(
        rays.position.expand(3, *batch),
        rays.direction.expand(3, *batch),
        rays.valid.expand(batch),
        rays.opl if rays.opl is None else rays.opl.expand(batch),
    )


def cross_scene(scene: Scene, pupil: Tensor) -> list[Crossing]:
    """What happens to the same rays at every surface after the object; axes D, F and W may be 1 where all are alike."""
    return cross_bundle(_bundle(scene, pupil), scene.memo)


def chief_landing(scene: Scene) -> Tensor:
    """Points (2, D, F, W) mm of the sensor where the chief rays land, with their derivatives.

    Where symmetry holds light on the axis, whatever the numbers of the lens are, they are constants, 0: models of round
    light see that.
    """
    if symmetry(scene) == "round":
        return scene.fields.new_zeros(2, *scene.shape)
    return trace_scene(scene, scene.fields.new_zeros(2, 1)).position[:2, ..., 0]


def _bundle(scene: Scene, pupil: Tensor) -> Bundle:
    lens = with_object_distance(scene.lens, scene.lens.surfaces[0].thickness[..., None])
    return lens, scene.fields[:, :, None, None], scene.wavelengths[:, None], pupil


_FOLDS = ("round", "mirror", "none")


def symmetry(scene: Scene) -> str:
    """What the light of every field has in common with its images: "round", "mirror" or "none", of the whole scene.

    "round": symmetric about the axis, a meridian of the pupil stands for all of it; "mirror": symmetric in x, the half
    of x > 0 stands for the other. Fields and vignetting factors to be differentiated have none: moving one breaks it;
    nor has a lens with a surface of a kind that is not round, whatever its numbers are.
    """
    return _FOLDS[int(scene.largest(torch.tensor(_FOLDS.index(_symmetry(scene)))))]


def _symmetry(scene: Scene) -> str:
    if not all(is_round(surface) and not is_posed(surface) for surface in scene.lens.surfaces):
        return "none"
    apertures = [aperture for surface in scene.lens.surfaces for aperture in surface.apertures]
    moving = [scene.fields, scene.lens.fields.vignetting, *(c for aperture in apertures for c in aperture.centre)]
    if any(varies(number) for number in moving):
        return "none"
    centre, along_x, along_y = _beams(scene)
    tilted = (scene.fields[0] != 0).any() | (centre[0] != 0).any() | (along_x[1] != 0).any() | (along_y[0] != 0).any()
    if bool(tilted) or any(aperture.centre[0] != 0 for aperture in apertures):
        return "none"
    skewed = (scene.fields[1] != 0).any() | (centre[1] != 0).any() | (along_x[0] != along_y[1]).any()
    own = {SHAPES[aperture.shape].symmetry for aperture in apertures}
    if "none" in own:
        return "none"
    if bool(skewed) or any(aperture.centre[1] != 0 for aperture in apertures) or "mirror" in own:
        return "mirror"
    return "round"


def is_on_axis(scene: Scene) -> bool:
    """Whether every field is on the axis, and stays there under differentiation."""
    return not varies(scene.fields) and not bool((scene.fields != 0).any())


def beam_share(scene: Scene) -> Tensor:
    """Share (1, F, 1) of the entrance pupil that the vignetting factors of each field leave, (1 - VCX)(1 - VCY)."""
    _, along_x, along_y = _beams(scene)
    return (along_x[0] * along_y[1] - along_x[1] * along_y[0]).abs()[None, :, None]


def _beams(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Centre and half axes (2, F) of the beams in the entrance pupil, vignetting factors applied."""
    corners = scene.fields.new_tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    centre, x, y = vignette(scene.lens, scene.fields[:, :, None], corners).unbind(-1)
    return centre, x - centre, y - centre


def varies(number: Tensor | float | None) -> bool:
    """Whether a derivative may be asked for by this number: backward, forward, or by a transform of torch.func.

    Inside nested transforms a tensor tells only of the innermost one: wrapped at all, it may vary for one further out.
    """
    if not isinstance(number, Tensor):
        return False
    if number.requires_grad or is_functorch_wrapped_tensor(number):
        return True
    return getattr(forward_ad, "_current_level", -1) >= 0 and forward_ad.unpack_dual(number).tangent is not None

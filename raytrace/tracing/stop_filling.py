"""Filling: how far the rays of each field miss the points of the stop that they stand for.

Without ray aiming, rays go through the paraxial entrance pupil. Its aberrations move them on the stop: the chief ray
leaves its centre, and marginal rays fall short of its rim or beyond it.
"""

import warnings

import torch
from torch import Tensor
from torch._C._functorch import is_functorch_wrapped_tensor
from torch.utils import _pytree as pytree

from raytrace.maths.value import detached, value
from raytrace.system.lens import FIELD_UNITS, Lens, name_of_field
from raytrace.tracing.aiming import at_stop
from raytrace.tracing.axis import aiming_of
from raytrace.tracing.launch import points_of_stop, rays_of_field, with_ray_aiming
from raytrace.tracing.vignetting import vignette
from raytrace.words import calling_level

#: What the beam may miss the stop by without a warning, of the stop's semi-diameter.
TOLERANCE = 0.02

MOST_FIELDS = 64  # that are measured of one call: a map of a field asks for thousands


class UnfilledStop(UserWarning):
    """The beam of a field misses the stop by more than TOLERANCE; the message has figures and a remedy."""

    of_result = True  # said of a result: an error that ends the command stands alone


@value
class Filling:
    """How far rays miss the stop, fractions of its semi-diameter; inf for a ray that does not reach it.

    chief: (F,) chief ray from the centre. marginal: (F,) the worst of four marginal rays, from its point of the rim; of
    a field with vignetting factors from the point that these leave. lost: (F,) whether no ray reaches the stop; radius:
    () mm, semi-diameter of the stop.
    """

    chief: Tensor
    marginal: Tensor
    lost: Tensor
    radius: Tensor


@torch.no_grad()
def filling(lens: Lens, fields: Tensor) -> Filling:
    """How far the rays of fields (2, F) miss the stop as the lens launches them, at the primary wavelength.

    Five rays a field are traced to the stop. The stop is as wide as the real marginal ray of the axial beam makes it.
    """
    lens, fields = detached(lens), fields.detach()
    wavelength = lens.primary
    five = fields.new_tensor([[0.0, 0.0, 0.0, -1.0, 1.0], [0.0, -1.0, 1.0, 0.0, 0.0]])
    pupil = vignette(lens, fields[:, :, None], five)
    target, radius = points_of_stop(with_ray_aiming(lens, "real"), pupil)
    position, arrives = at_stop(lens, rays_of_field(lens, fields[:, :, None], pupil, wavelength=wavelength), wavelength)
    missed = torch.linalg.vector_norm(position - target, dim=0) / radius
    missed = torch.where(arrives & torch.isfinite(missed), missed, torch.inf)
    return Filling(missed[:, 0], missed[:, 1:].amax(1), ~arrives.any(1), radius)


def warn_of_filling(lens: Lens, fields: Tensor, *, ray_aiming: str | None = None) -> None:
    """Warn UnfilledStop of the field of (2, F) that misses the stop most, if it does by more than TOLERANCE.

    Of more than MOST_FIELDS so many are measured, evenly spread over them, and the largest one.
    A field that loses all its rays in front of the stop is left to LostRays. Nothing is traced where rays are aimed,
    where chief rays are parallel in object space, and in optimisation: where numbers of the lens or fields require a
    gradient or are inside a transform of torch.func.
    """
    lens = with_ray_aiming(lens, ray_aiming)
    if _is_being_optimised((lens, fields)) or lens.fields.telecentric or aiming_of(lens) != "off":
        return
    if fields.shape[1] > MOST_FIELDS:
        spread = torch.linspace(0, fields.shape[1] - 1, MOST_FIELDS, dtype=torch.float64).long()
        fields = fields[:, [*spread.tolist(), int(fields.norm(dim=0).argmax())]]
    found = filling(lens, fields)
    worst = torch.where(found.lost, 0.0, torch.maximum(found.chief, found.marginal))
    if not bool((worst > TOLERANCE).any() & (found.radius > 1e-9)):  # a point has no rim
        return
    at = int(worst.argmax())
    named = f"{name_of_field(fields[:, at])} {FIELD_UNITS[lens.fields.kind]}"
    many = f" ({int((worst > TOLERANCE).sum())} of {len(worst)} fields by more than {TOLERANCE:.0%})"
    warnings.warn(
        f"field {named}: rays miss the stop, whose semi-diameter is {float(found.radius):.4g} mm: the chief ray "
        f"{_words(found.chief[at], 'centre')}, marginal rays {_words(found.marginal[at], 'rim')}"
        f"{many if len(worst) > 1 else ''}; `ray_aiming=real` aims them, in Python lens.at(ray_aiming='real')",
        UnfilledStop,
        stacklevel=calling_level(),
    )


def _words(missed: Tensor, place: str) -> str:
    """How far from its place of the stop a ray passes, of the semi-diameter."""
    return f"by {100 * float(missed):.3g} % of it from the {place}" if bool(missed.isfinite()) else "altogether"


def _is_being_optimised(numbers: tuple[Lens, Tensor]) -> bool:
    leaves = [leaf for leaf in pytree.tree_leaves(numbers) if isinstance(leaf, Tensor)]
    return any(is_functorch_wrapped_tensor(leaf) or leaf.requires_grad for leaf in leaves)

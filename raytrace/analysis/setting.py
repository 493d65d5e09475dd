"""The scene of an analysis: fields, wavelengths and their weights, as a scene of one object distance."""

import dataclasses
from collections.abc import Sequence

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.budget import RAY_BYTES, afford
from raytrace.maths.numerics import is_wrapped
from raytrace.maths.sampling import gauss_rings
from raytrace.system.lens import Lens, field_points, name_of_field, with_field_kind, with_wavelengths
from raytrace.tracing.launch import is_at_infinity, object_field, warn_of_filling
from raytrace.tracing.paraxial import axial_beam, largest_field
from raytrace.tracing.ray_failures import check_reach, ray_failures
from raytrace.tracing.scene import Scene
from raytrace.tracing.scene import scene as make_scene
from raytrace.tracing.spot import EmptySpot
from raytrace.words import RaytraceError, RaytraceWarning, option

#: Fields, y or pairs (x, y), and other numbers as analyses take them; None: those of the lens.
Points = Tensor | Sequence | float | None
Numbers = Tensor | Sequence[float] | float | None

_DENSE = 65  # fields of a curve over the field that is drawn


class NothingToShow(RaytraceError, ValueError):
    """An analysis of a lens, or of fields, that would show nothing."""


class Incomplete(RaytraceWarning):
    """A field lacks a part of the results of an analysis."""


def setting(
    lens: Lens, fields: Points, wavelengths: Numbers, *, samples: int | None = None, every: bool = False
) -> tuple[Lens, Tensor]:
    """The lens at the wavelengths of an analysis, of equal weight and the first of them primary, and its fields (2, F).

    fields: None for the lens's own, or for `samples` from the axis to its largest. Rays must reach the sensor from one
    of those listed, or from `every` one, see `check_reach`; of batches of lenses and inside transforms of torch.func
    this is not checked.
    Warns UnfilledStop.
    """
    lens = lens if wavelengths is None else with_wavelengths(lens, wavelengths)
    if fields is None and samples is not None:
        curve = field_range(lens, samples)
        warn_of_filling(lens, curve)
        return lens, curve
    points = field_points(fields, like=lens)
    warn_of_filling(lens, points)
    hidden = any(isinstance(leaf, Tensor) and is_wrapped(leaf) for leaf in pytree.tree_leaves(lens))
    if not hidden and lens.count is None:
        check_reach(lens, None if fields is None else points, every=every)
    return lens, points


def primary_wavelength(lens: Lens) -> Tensor:
    """() µm."""
    return lens.primary


def scene_of(lens: Lens, fields: Tensor) -> Scene:
    """The scene (1, F, W), (L, F, W) of a batch, of the lens at its own object distance; fields: (2, F)."""
    return make_scene(lens, fields, lens.surfaces[0].thickness.reshape(-1).expand(lens.count or 1), lens.wavelengths)


def wavelength_shares(lens: Lens) -> Tensor:
    """Weights (W,) of the wavelengths, 1 together."""
    return lens.wavelength_weights / lens.wavelength_weights.sum()


def like(lens: Lens) -> dict:
    """dtype and device of a lens."""
    return {"dtype": lens.wavelengths.dtype, "device": lens.wavelengths.device}


def field_range(lens: Lens, size: int) -> Tensor:
    """Fields (2, size) along y from the axis to the lens's largest. Raises OverBudget for too many to be traced."""
    afford(RAY_BYTES * size * len(lens.wavelengths), f"{size:,} fields", helps="ask for fewer {samples}")
    return largest_field(lens) * torch.linspace(0.0, 1.0, size, **like(lens))


def field_line(fields: Tensor) -> Tensor:
    """Many fields (2, F) from the axis to the largest of these, if they lie on one line to it; else these."""
    size = torch.hypot(*fields)
    largest = fields[:, size.argmax()]
    along = (fields * largest[:, None]).sum(0) / size.max()
    if not size.max() > 0 or bool((along < (1 - 1e-9) * size).any()):
        return fields
    return largest[:, None] * torch.linspace(0, 1, _DENSE, dtype=fields.dtype, device=fields.device)


def field_words(lens: Lens, field: Tensor) -> str:
    """A field (2,) with its unit."""
    return f"{name_of_field(field)} {lens.fields.unit}"


def refuse_dark(lens: Lens, fields: Tensor, lit: Tensor, quantity: str) -> None:
    """Raise EmptySpot, with the first field (2, F) and wavelength without light and the ends of its rays.

    lit: (F, W); quantity: that is not defined there.
    """
    if bool(lit.all()):
        return
    f, w = torch.nonzero(~lit)[0].tolist()
    wavelength = lens.wavelengths[w : w + 1]
    losses = ray_failures(lens, gauss_rings(6, **like(lens))[0], fields=fields[:, f : f + 1], wavelengths=wavelength)
    lost = losses.words(0, 0) if int(losses.arrived) == 0 else "too few rays reach the sensor"
    where = f"field {field_words(lens, fields[:, f])}, {float(wavelength):g} µm"
    raise EmptySpot(f"{where} has no {quantity}: {lost}; leave the field out")


def refuse_axis(fields: Tensor) -> None:
    """Raise NothingToShow for fields (2, F) that lie all on the axis."""
    if not bool(fields.any()):
        raise NothingToShow(
            f"nothing to show over the field: all fields are on the axis; give others by {option('fields')}"
        )


def unvignetted(lens: Lens) -> Lens:
    """The lens without vignetting factors, which would bend a curve over the field at every field listed."""
    return dataclasses.replace(lens, fields=dataclasses.replace(lens.fields, vignetting=None))


def in_object_space(lens: Lens, fields: Tensor) -> tuple[Lens, Tensor, Tensor, Tensor]:
    """The lens with fields of a kind that scales with the object, those fields (2, F), and tan θ or mm (2, F).

    And whether they exist (F,): no chief ray may reach a real image height.
    """
    extent, exist = object_field(lens, fields, axial_beam(lens))
    infinite = is_at_infinity(lens)
    described = torch.rad2deg(torch.atan(extent)) if infinite else extent
    kind = "angle" if infinite else "object_height"
    return with_field_kind(lens, kind), described, extent, exist

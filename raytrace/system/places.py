"""Places: the numbers of a surface by name, whatever its kind is: of its shape, its phase and its pose."""

import dataclasses
import re
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.system.pose import Pose
from raytrace.system.shapes import EVEN, KINDS, Kind
from raytrace.system.surface import SHAPE, Surface

_POSED = ("x", "y", "z", "tilt_x", "tilt_y", "tilt_z")


class Place(NamedTuple):
    """Where a surface holds a number: the fields from it down, and which entry of a tensor of several."""

    path: tuple[str, ...]
    entry: int | None = None


def places(surface: Surface) -> dict[str, Place]:
    """Every number by its name: curvature, conic, a4 (of r⁴) …, and the fields of a departure, a phase and the poses.

    Entries of a tensor are counted from 1, coefficients by the power of r, or of y, that they belong to. The pose
    behind the surface has its names with "_after", as tilt_x_after.
    """
    found: dict[str, Place] = {}
    for field in dataclasses.fields(Surface):
        part = getattr(surface, field.name)
        if field.name == "coefficients":
            found |= _coefficients(part, KINDS[surface.kind])
        elif field.name in SHAPE and field.type == Tensor | None:
            found[field.name] = Place((field.name,))
        elif field.name in (*SHAPE, "phase", "before", "after") and dataclasses.is_dataclass(part):
            behind = "_after" if field.name == "after" else ""
            for own in dataclasses.fields(part):
                found |= _entries((field.name, own.name), getattr(part, own.name), own.name + behind)
    return found


def _coefficients(part: Tensor | None, kind: Kind) -> dict[str, Place]:
    if part is None:
        return {}
    return {kind.name_of(entry): Place(("coefficients",), entry) for entry in range(part.numel())}


def _entries(path: tuple[str, ...], part: Tensor | None, name: str) -> dict[str, Place]:
    if not isinstance(part, Tensor):
        return {}
    if part.dim() == 0:
        return {name: Place(path)}
    return {f"{name}{entry + 1}": Place(path, entry) for entry in range(part.numel())}


def number_at(part, place: Place) -> Tensor | None:
    """The number in its place; None where it is not modelled."""
    for name in place.path:
        part = getattr(part, name)
    return part if place.entry is None else part.reshape(-1)[place.entry]


def with_number(part, place: Place, number: Tensor):
    """The surface with another number in that place."""
    name, *rest = place.path
    old = getattr(part, name)
    if rest:
        number = with_number(old, Place(tuple(rest), place.entry), number)
    elif place.entry is not None:
        flat = old.reshape(-1)
        number = torch.cat([flat[: place.entry], number[None], flat[place.entry + 1 :]]).reshape(old.shape)
    return dataclasses.replace(part, **{name: number})


def modelled(surface: Surface, name: str) -> Surface:
    """The surface with a number modelled, at 0 where it was not; the surface itself where it cannot have that number.

    Curvature and conic, the terms a2, a4, … of an even asphere, and the fields of the pose before the surface or, with
    "_after", behind it.
    """
    zero = torch.zeros_like(surface.thickness)
    if name in ("curvature", "conic"):
        return surface if getattr(surface, name) is not None else dataclasses.replace(surface, **{name: zero})
    if name in places(surface):
        return surface
    term = re.fullmatch(r"a(\d+)", name)
    if term and surface.kind == EVEN and 2 <= int(term[1]) <= 2 * KINDS[EVEN].parameters and not int(term[1]) % 2:
        own = zero.new_zeros(0) if surface.coefficients is None else surface.coefficients
        further = zero.new_zeros((int(term[1]) // 2 - len(own), *own.shape[1:]))
        return dataclasses.replace(surface, coefficients=torch.cat([own, further]))
    field, side = name.removesuffix("_after"), "after" if name.endswith("_after") else "before"
    pose = getattr(surface, side) or Pose()
    if field in _POSED and isinstance(pose, Pose):
        return dataclasses.replace(surface, **{side: dataclasses.replace(pose, **{field: zero})})
    return surface

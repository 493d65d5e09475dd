"""Batches of lenses: any number of a lens may be a tensor of shape (L,), one entry for each of L lenses.

Behind the axes that a number has by itself (the terms of an asphere, say) the axis of the lenses follows. `aligned`
puts axes of 1 behind it, against which fields, wavelengths and pupil points broadcast: rays of a batch have the shape
(3, L, F, W, P). Fields, wavelengths and apertures of surfaces are common to all lenses of a batch.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import TypeVar

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import broadcast_shape

Part = TypeVar("Part")

#: Axes that numbers have by themselves, by the name of their field; all others are single numbers.
_OWN_AXES = {"coefficients": 1, "heights": 2, "first": 1, "second": 1, "rotation": 2, "shift": 1}

#: The parts of a lens whose numbers may differ between the lenses of a batch.
_PARTS = ("surfaces", "aperture", "environment")


def lens_count(lens) -> int | None:
    """L, how many lenses the numbers of a lens describe; None for a single lens.

    Raises ValueError for numbers of different counts.
    """
    counts: dict[int, str] = {}

    def note(number: Tensor, own: int, place: str) -> Tensor:
        if number.dim() > own and number.shape[own] != 1:
            counts.setdefault(number.shape[own], place)
        elif number.dim() > own:
            counts.setdefault(1, place)
        return number

    _mapped(lens, note)
    several = {count: place for count, place in counts.items() if count != 1}
    if len(several) > 1:
        (one, here), (other, there), *_ = several.items()
        raise ValueError(f"{here} has numbers of {one} lenses, {there} of {other}; expected as many, or one")
    return next(iter(several or counts), None)


def batch_shape(lens) -> torch.Size:
    """The shape (L, 1, …) that the numbers of an `aligned` batch broadcast to; () of a single lens."""
    shapes: list[torch.Size] = [torch.Size()]

    def note(number: Tensor, own: int, place: str) -> Tensor:
        shapes.append(number.shape[own:])
        return number

    _mapped(lens, note)
    return broadcast_shape(*{*shapes})


def aligned(lens: Part, axes: int) -> Part:
    """The lens with numbers (…, L) of a batch as (…, L, 1, …), at least so many axes of 1 behind the lenses.

    A number that is common to all lenses, or has the axes, stays the same tensor.
    """

    def align(number: Tensor, own: int, place: str) -> Tensor:
        missing = own + 1 + axes - number.dim()
        return number if number.dim() <= own or missing <= 0 else number.reshape(*number.shape, *(1,) * missing)

    return _mapped(lens, align)


def one_lens(lens: Part, number: int | slice | Tensor) -> Part:
    """Lens `number` of a batch, from 0; of a slice or of a tensor of numbers, a batch of them.

    Raises TypeError for a single lens, IndexError beyond the last lens.
    """
    count = lens_count(lens)
    if count is None:
        raise TypeError("a single lens, not a batch of lenses: no number has the shape (L,)")
    if isinstance(number, int) and not -count <= number < count:
        raise IndexError(f"lens {number} of a batch of {count} lenses; expected 0 to {count - 1}")

    def take(entries: Tensor, own: int, place: str) -> Tensor:
        if entries.dim() <= own:
            return entries
        chosen = (slice(None),) * own
        if entries.shape[own] == 1:
            return entries[(*chosen, 0)] if isinstance(number, int) else entries
        return entries[(*chosen, number)]

    return _mapped(lens, take)


def batch(lenses: Sequence[Part]) -> Part:
    """One batch of several lenses that differ in their numbers alone.

    What is equal in all of them stays single. Raises ValueError for none, and for lenses of different structure: other
    surfaces, glass formulas, apertures.
    """
    if not lenses:
        raise ValueError("a batch of no lenses; expected one or more")
    if any(lens_count(lens) is not None for lens in lenses):
        raise ValueError("a lens of the batch is a batch itself; expected single lenses")
    parts = [{name: part for name in _PARTS if (part := getattr(lens, name)) is not None} for lens in lenses]
    flat = [pytree.tree_flatten(found) for found in parts]
    leaves, structures = zip(*flat, strict=True)
    for k, (numbers, structure) in enumerate(zip(leaves, structures, strict=True)):
        if structure != structures[0] or [n.shape for n in numbers] != [n.shape for n in leaves[0]]:
            raise ValueError(f"lens {k} has other surfaces, glasses or apertures than lens 0; expected other numbers")
    rows = {id(column[0]): column for column in zip(*leaves, strict=True)}

    def join(number: Tensor, own: int, place: str) -> Tensor:
        column = rows[id(number)]
        if all(entry is number or (not entry.requires_grad and torch.equal(entry, number)) for entry in column):
            return number
        return torch.stack(column, own)

    return _mapped(lenses[0], join)


def _mapped(lens: Part, change: Callable[[Tensor, int, str], Tensor]) -> Part:
    """The lens with changed numbers; change: number, how many axes it has by itself, its place in words -> number.

    A number that occurs in several places (the coefficients of air, say) stays one.
    """
    made: dict[int, Tensor] = {}

    def walk(part, name: str, place: str):
        if isinstance(part, Tensor):
            if id(part) not in made:
                made[id(part)] = change(part, _OWN_AXES.get(name, 0), place.replace("_", " "))
            return made[id(part)]
        if isinstance(part, tuple):
            places = [f"surface {k}" if name == "surfaces" else place for k in range(len(part))]
            found = tuple(walk(entry, name, where) for entry, where in zip(part, places, strict=True))
            return part if all(a is b for a, b in zip(found, part, strict=True)) else found
        if not dataclasses.is_dataclass(part):
            return part
        changes = {}
        for field in dataclasses.fields(part):
            before = getattr(part, field.name)
            after = walk(before, field.name, f"{place}: {field.name}")
            if after is not before:
                changes[field.name] = after
        return dataclasses.replace(part, **changes) if changes else part

    changes = {}
    for name in _PARTS:
        before = getattr(lens, name)
        after = walk(before, name, name)
        if after is not before:
            changes[name] = after
    return dataclasses.replace(lens, **changes) if changes else lens

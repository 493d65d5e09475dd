"""Parts of stock in a lens: inserted, or in the place of an element or a cemented group."""

import dataclasses
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeAlias

from torch import Tensor

from raytrace.edit.choice import At, BadEdit, LeftOut, surfaces_at, warn_of
from raytrace.edit.numbering import GAP
from raytrace.edit.surfaces import inserted, medium_before
from raytrace.edit.turning import turned
from raytrace.io import FORMATS, read_lens
from raytrace.materials.glass import is_air
from raytrace.maths.numerics import as_tensor
from raytrace.stock.index import DEFAULT, StockPart, part_named
from raytrace.stock.parts import data_of, part_surfaces
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import GLASS_NUMBER, OF_LENS, sensor
from raytrace.system.surface import Surface, is_posed
from raytrace.words import option

#: A part: of an index, a lens, or the path of a lens file.
Part: TypeAlias = StockPart | Lens | str | os.PathLike


def faces_of(part: Part, *, reverse: bool = False) -> tuple[Surface, ...]:
    """The surfaces of a part, behind the last one air without thickness; reverse: turned around. Raises NoPart."""
    lens = part if isinstance(part, Lens) else part.lens if isinstance(part, StockPart) else read_lens(part)
    faces = part_surfaces(lens)
    return turned_part(faces) if reverse else faces


def turned_part(faces: Sequence[Surface]) -> tuple[Surface, ...]:
    """The surfaces of a part turned around."""
    back, gaps = [turned(face) for face in reversed(faces)], [*reversed(faces[:-1]), faces[-1]]
    return tuple(
        dataclasses.replace(face, **{name: getattr(gap, name) for name in GAP}, expansion=gap.expansion)
        for face, gap in zip(back, gaps, strict=True)
    )


def name_of(part: Part) -> str:
    """The number of a part, or the name of its file or lens."""
    if isinstance(part, StockPart):
        return part.figures.part
    return part.name if isinstance(part, Lens) else Path(part).stem


def insert_part(lens: Lens, before: At, part: Part, *, reverse: bool = False, gap: Tensor | float = 0.0) -> Lens:
    """The lens with a part of stock before a surface, as `insert`; the first face has the part's number as its comment.

    part: of an index (`rt.stock_find(…).parts`), a lens, or the path of a vendor's file; reverse: turned around. The
    gap before it keeps its thickness; gap: mm of the air behind it. Its semi-diameters are fixed. Raises BadEdit and
    NoPart.
    """
    k, _ = surfaces_at(lens, before)
    if k == 0:
        raise BadEdit(
            f"{option('insert_part')}: no surface is in front of the object; expected 1 to {sensor(lens) + 1}"
        )
    medium = medium_before(lens, k)
    if not is_air(medium.glass):
        raise BadEdit(f"{option('insert_part')}: {medium.glass.name} is before surface {k}; parts are in air")
    faces = [*faces_of(part, reverse=reverse)]
    like = lens.surfaces[1].thickness
    last: dict[str, Any] = {
        "thickness": as_tensor(gap, dtype=like.dtype),
        "glass": medium.glass,
        "environment": medium.environment,
    }
    faces[-1] = dataclasses.replace(faces[-1], **last)
    faces[0] = dataclasses.replace(faces[0], comment=name_of(part))
    return _with_sizes(inserted(lens, k, faces), range(k, k + len(faces)))


def replace_part(lens: Lens, element: At, part: Part, *, reverse: bool = False) -> Lens:
    """The lens with a part of stock in the place of an element or a cemented group of as many surfaces, as "3-4".

    The principal planes of the part are in the places of those of the element, as far as both air spaces allow.
    Variables, solves and pickups of the element are left out, in one warning (`LeftOut`). Raises BadEdit and NoPart.
    """
    first, last = surfaces_at(lens, element)
    faces = faces_of(part, reverse=reverse)
    where = f"{option('replace_part')} {first}-{last}"
    if why := no_group(lens, first, last):
        raise BadEdit(f"{where}: {why}")
    if len(faces) != last - first + 1:
        raise BadEdit(f"{where}: {name_of(part)} has {len(faces)} surfaces; delete the element, and insert the part")
    new, lost = with_part(lens, first, faces, name=name_of(part))
    warn_of(LeftOut, f"{where}: left out with the element", lost)
    return new


def no_group(lens: Lens, first: int, last: int) -> str:
    """Why surfaces are not a centred element or cemented group in air, "" where they are."""
    if not 1 <= first < last <= sensor(lens):
        return "expected the surfaces of an element or a cemented group, as 3-4"
    faces = lens.surfaces[first : last + 1]
    if any(face.is_mirror or face.phase is not None for face in faces):
        return "has a mirror or a phase"
    if any(is_posed(face) for face in faces):
        return "is tilted or decentred"
    if any(is_air(face.glass) for face in faces[:-1]) or not is_air(faces[-1].glass):
        return "is no single element or cemented group, from air to air"
    if not is_air(medium_before(lens, first).glass):
        return "does not begin in air"
    moved = {
        operand.name for operand in lens.operands for scaled in operand.paths if _is_inside(scaled.path, first, last)
    }
    return f"differs between configurations ({', '.join(sorted(moved))})" if moved else ""


def _is_inside(path: tuple, first: int, last: int) -> bool:
    """Whether a path in the lens is of the group, and not of the gap behind it."""
    inside = path[:1] == ("surfaces",) and len(path) > 2 and first <= path[1] <= last
    return inside and not (path[1] == last and path[2] in GAP)


def with_part(
    lens: Lens, first: int, faces: Sequence[Surface], *, name: str = "", moves: tuple[bool, bool] = (True, True)
) -> tuple[Lens, list[str]]:
    """The lens with the faces of a part from surface `first` on, and the rules of the former faces that are left out.

    moves: whether the gaps before and behind may change, to keep the places of the principal planes.
    """
    last = first + len(faces) - 1
    old = lens.surfaces[first : last + 1]
    bare = (*old[:-1], dataclasses.replace(old[-1], thickness=0 * old[-1].thickness))
    was, now = data_of(bare, lens.primary), data_of(faces, lens.primary)
    shifts = was.front_principal_plane - now.front_principal_plane, now.rear_principal_plane - was.rear_principal_plane
    surfaces = list(lens.surfaces)
    for k, shift, may_change in zip((first - 1, last), shifts, moves, strict=True):
        gap = surfaces[k].thickness
        if may_change and bool((gap + shift).isfinite()):
            surfaces[k] = dataclasses.replace(surfaces[k], thickness=(gap + shift).clamp(min=min(0.0, float(gap))))
    for k, face in enumerate(faces, first):
        kept: dict[str, Any] = {"comment": name if k == first else ""}
        if k == last:
            kept |= {field: getattr(surfaces[k], field) for field in (*GAP, "expansion")}
        surfaces[k] = dataclasses.replace(face, **kept)
    lost: list[str] = []
    lens = dataclasses.replace(lens, surfaces=tuple(surfaces))
    if (data := lens.optimization_data) is not None:
        variables, solves = left_of(data.variables, data.solves, first, last, lost)
        _, stored = left_of((), data.kept, first, last, lost)
        data = dataclasses.replace(data, variables=variables, solves=solves, kept=stored)
        lens = dataclasses.replace(lens, optimization_data=data)
    return _with_sizes(lens, range(first, last + 1)), lost


def left_of(
    variables: Sequence[Vary], solves: Sequence[Solve], first: int, last: int, lost: list[str] | None = None
) -> tuple[tuple[Vary, ...], tuple[Solve, ...]]:
    """The variables and solves that are not of the group of surfaces first to last; lost: the names of the others."""

    def is_of(address: tuple[int, str]) -> bool:
        surface, quantity = address
        of_gap = quantity in GAP or quantity.startswith(GLASS_NUMBER) or quantity in ("index", "abbe_number")
        return address not in OF_LENS and first <= surface <= last and not (surface == last and of_gap)

    def stays(rule: Vary | Solve) -> bool:
        picks = isinstance(rule, Solve) and rule.kind == "pickup" and rule.operand is None
        gone = is_of(rule.address) or (picks and is_of(rule.address_of_source))  # type: ignore[union-attr]
        if gone and lost is not None:
            lost.append(f"{'variable' if isinstance(rule, Vary) else 'solve'} {rule}")
        return not gone

    return tuple(filter(stays, variables)), tuple(filter(stays, solves))


def _with_sizes(lens: Lens, surfaces: range) -> Lens:
    """The lens with the semi-diameters of these surfaces fixed."""
    data = lens.optimization_data
    if data is None:
        return lens
    sized = {*data.semi_diameters, *(k for k in surfaces if lens.surfaces[k].semi_diameter)}
    return dataclasses.replace(lens, optimization_data=dataclasses.replace(data, semi_diameters=tuple(sorted(sized))))


def part_of_words(name: str, index: str = DEFAULT) -> Part:
    """A part by its number in an index, or by the name of a vendor's file. Raises NoPart and BadStock."""
    path = Path(name)
    return path if path.suffix.lower() in FORMATS and path.exists() else part_named(index, name)

"""Surfaces and elements that are inserted, deleted, joined, split and bent; titles and comments."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from raytrace.edit.choice import At, BadEdit, LeftOut, surfaces_at, warn_of
from raytrace.edit.numbering import GAP, Numbering
from raytrace.materials.glass import is_air
from raytrace.maths.numerics import as_tensor
from raytrace.system import prescription
from raytrace.system.configurations import Operand, ScaledPath, same
from raytrace.system.lens import Lens, check, media
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import sensor
from raytrace.system.surface import Surface, is_posed, medium_surfaces, vertex_curvature, ynu
from raytrace.words import option

# -- surfaces that come and go -----------------------------------------------------------------------------------------


def insert(lens: Lens, before: At, rows: Iterable[Mapping] = ({"thickness": 0.0},)) -> Lens:
    """The lens with more surfaces before a surface, by rows as those of `rt.lens`; one plane without thickness alone.

    A row without a glass has the medium of the gap in which it is inserted. The gap before it keeps its thickness: what
    follows moves back by the thicknesses of the rows. Raises BadEdit, BadPrescription and UnknownGlass.
    """
    k, _ = surfaces_at(lens, before)
    if k == 0:
        raise BadEdit(f"{option('insert')}: no surface is in front of the object; expected 1 to {sensor(lens) + 1}")
    medium = medium_before(lens, k)
    rows = [dict(row) for row in rows]
    new = [
        dataclasses.replace(
            prescription.surface({"glass": medium.glass, **row}, k + number, lens.catalogs),
            environment=None if "glass" in row else medium.environment,
        )
        for number, row in enumerate(rows)
    ]
    return inserted(lens, k, new)


def medium_before(lens: Lens, k: int) -> Surface:
    """The surface whose medium is in front of a surface."""
    return lens.surfaces[medium_surfaces(lens.surfaces)[k - 1]]


def inserted(lens: Lens, k: int, new: Sequence[Surface]) -> Lens:
    """The lens with new surfaces before surface k; the gap before them stays that of the surface before."""
    result = as_inserted(lens, k, len(new)).with_surfaces((*lens.surfaces[:k], *new, *lens.surfaces[k:]))
    check(result)
    return result


def as_inserted(lens: Lens, k: int, count: int) -> Numbering:
    """The numbering of so many new surfaces before surface k."""
    numbers = tuple(number + count if number >= k else number for number in range(len(lens.surfaces)))
    return Numbering(lens, numbers, numbers)


def delete(lens: Lens, surfaces: At) -> Lens:
    """The lens without some surfaces: one, those of an element as "3-4", of a comment. All others stay in their places.

    The gap in their place has the thickness of all gaps that it joins, and is air if air is on one of its sides. Its
    solve or variable is that of the gap before or behind that has one, a solve rather than a variable. A stop among the
    surfaces stays, as a plane. What refers to a deleted surface is left out, in one warning (`LeftOut`): variables,
    solves, pickups, operands of configurations, merit rows and tolerances. Raises BadEdit for the object, the image, a
    mirror, and all surfaces of a lens.
    """
    first, last = surfaces_at(lens, surfaces)
    where = f"delete {first}-{last}" if last > first else f"delete {first}"
    if not 1 <= first <= last <= sensor(lens):
        raise BadEdit(f"{where}: expected surfaces from 1 to {sensor(lens)}; object and image stay")
    if mirrors := [k for k in range(first, last + 1) if lens.surfaces[k].is_mirror]:
        raise BadEdit(f"{where}: surface {mirrors[0]} is a mirror, behind which light runs the other way")
    if first == last == lens.stop and lens.surfaces[first].is_plane and _no_dummy(lens, first) == "is the stop":
        raise BadEdit(f"{where}: is the stop, a plane that does nothing else; it stays")
    if last - first + 1 == sensor(lens) and not first <= lens.stop <= last:
        raise BadEdit(f"{where}: these are all surfaces of the lens")
    new, numbering = without(lens, first, last)
    stays = "; the stop stays, as a plane" if first <= lens.stop <= last else ""
    warn_of(LeftOut, f"{where}: left out with the surfaces{stays}", numbering.lost)
    return new


def without(lens: Lens, first: int, last: int, rules: Sequence[Vary | Solve] | None = None) -> tuple[Lens, Numbering]:
    """The lens without some surfaces, as `delete`, and the numbering of what is left.

    rules: variables and solves that decide which of two gaps names the gap that joins them; by default the lens's.
    """
    if rules is None:
        rules = () if lens.optimization_data is None else lens.optimization_data.rules
    outer = medium_before(lens, first), lens.surfaces[medium_surfaces(lens.surfaces)[last]]
    medium = next((surface for surface in outer if is_air(surface.glass)), outer[0])
    behind: dict[str, Any] = {"glass": medium.glass, "environment": medium.environment}
    before = lens.surfaces[first - 1]
    if not same(medium.glass, outer[0].glass):
        before = dataclasses.replace(before, **behind)
    has_stop = first <= lens.stop <= last
    cut = lens.stop if has_stop else last + 1
    joined = [range(first - 1, cut), *([range(cut, last + 1)] if has_stop else [])]
    thicknesses = [_sum(lens.surfaces[gap].thickness for gap in gaps) for gaps in joined]
    kept = [_gap_kept(lens, joined[0], rules), last] if has_stop else [_gap_kept(lens, joined[0], rules)]
    new = [dataclasses.replace(before, thickness=thicknesses[0])]
    if has_stop:
        stop = lens.surfaces[lens.stop]
        kept_of_stop: dict[str, Any] = {name: getattr(stop, name) for name in ("semi_diameter", "comment", "apertures")}
        new.append(Surface(thicknesses[1], **kept_of_stop, **behind))
    surfaces = (*lens.surfaces[: first - 1], *new, *lens.surfaces[last + 1 :])
    fewer = len(lens.surfaces) - len(surfaces)
    numbers = [k if k < first else k - fewer if k > last else None for k in range(len(lens.surfaces))]
    gaps = list(numbers)
    gaps[first - 1] = None
    for place, gap in enumerate(kept):
        gaps[gap] = first - 1 + place
    grown = zip(kept, thicknesses, strict=True)
    thicker = {gap: float((thickness - lens.surfaces[gap].thickness).detach()) for gap, thickness in grown if gap}
    outer_gaps = {first - 1: first - 1, last: first - 1 + has_stop}
    numbering = Numbering(lens, tuple(numbers), tuple(gaps), joined=outer_gaps, thicker=thicker)
    operands: list[Operand | None] = list(lens.operands)
    for gap, together in zip(kept, joined, strict=True):
        operands = _joined_operands(lens, operands, gap, together)
    return numbering.with_surfaces(surfaces, stop=first if has_stop else None, operands=operands), numbering


def _sum(numbers: Iterable[Tensor]) -> Tensor:
    first, *others = numbers
    return sum(others, first)


def _gap_kept(lens: Lens, joined: range, rules: Sequence[Vary | Solve]) -> int:
    """The first or the last of the gaps that are joined, whose variable or solve is that of the gap in their place."""
    first, last = joined[0], joined[-1]
    ranks = {first: 0, last: 0}
    for rule in rules:
        if rule.quantity == "thickness" and rule.operand is None and rule.surface in ranks:
            ranks[rule.surface] = max(ranks[rule.surface], 1 + isinstance(rule, Solve))
    if first == 0 or ranks[first] > ranks[last]:
        return first
    return last if ranks[last] > ranks[first] or last == sensor(lens) else first


def _joined_operands(lens: Lens, operands: Sequence[Operand | None], kept: int, joined: range) -> list[Operand | None]:
    """The operands of the configurations, with one thickness of the gap that joins others: their sum."""
    result = list(operands)
    of_gaps: dict[Any, int] = {}
    for k, operand in enumerate(operands):
        path = operand.paths[0].path if operand is not None and operand.paths else ()
        if path[:1] == ("surfaces",) and path[2:] == ("thickness",) and path[1] in joined:
            of_gaps[path[1]] = k
    if not of_gaps:
        return result
    differing: dict[Any, Any] = {gap: lens.operands[k].numbers for gap, k in of_gaps.items()}
    sums = _sum(differing.get(gap, lens.surfaces[gap].thickness) for gap in joined)
    place = of_gaps.get(kept, min(of_gaps.values()))
    for k in of_gaps.values():
        result[k] = None
    joint = ScaledPath(("surfaces", kept, "thickness"))
    further = lens.operands[place].paths[1:]
    result[place] = dataclasses.replace(lens.operands[place], number=kept, paths=(joint, *further), numbers=sums)
    return result


def join(lens: Lens, surface: At) -> Lens:
    """The lens without a surface that does nothing: the gaps before and behind it become one, as thick as both.

    Raises BadEdit for a surface that is no dummy: between two media, a mirror, with a phase, a pose or an aperture, or
    the stop. `delete` takes out any surface.
    """
    first, last = surfaces_at(lens, surface)
    for k in range(first, last + 1):
        if why := _no_dummy(lens, k):
            raise BadEdit(f"join: surface {k} {why}")
    return delete(lens, (first, last))


def _no_dummy(lens: Lens, k: int) -> str:
    """Why a surface does something, "" where it does nothing."""
    if not 1 <= k <= sensor(lens):
        return f"joins no two gaps: expected a surface from 1 to {sensor(lens)}"
    surface, behind = lens.surfaces[k], lens.surfaces[medium_surfaces(lens.surfaces)[k]]
    before = medium_before(lens, k)
    if not same(before.glass, behind.glass) or surface.is_mirror:
        return "refracts or reflects; delete it instead"
    if k == lens.stop:
        return "is the stop"
    for name, part in (("a phase", surface.phase), ("an aperture, which stops rays", surface.apertures)):
        if part:
            return f"has {name}; delete it instead"
    return "is tilted or decentred, or a coordinate break; delete it instead" if is_posed(surface) else ""


# -- elements ----------------------------------------------------------------------------------------------------------


def split(
    lens: Lens,
    surfaces: At,
    *,
    share: Tensor | float = 0.5,
    gap: Tensor | float = 0.0,
    curvature: Tensor | float = 0.0,
) -> Lens:
    """The lens with an element, as "3-4", cut into two; or, of one surface, with a meniscus of no thickness before it.

    An element is cut at `share` of its thickness by two faces, `gap` mm of the medium in front of it apart, the first
    one of a `curvature` in 1/mm, a plane by default. The other has the curvature with which both parts together have
    the power of the element at the primary wavelength: without a gap the same one, so that no ray changes.

    The meniscus has the shape of the surface and the adjacent glass, and changes no ray: `rt.search(moves="insert")`
    begins with it. Raises BadEdit for other than centred refracting surfaces.
    """
    first, last = surfaces_at(lens, surfaces)
    if first == last:
        return with_meniscus(lens, first)
    k = _element(lens, (first, last), "split")
    front, share_of = lens.surfaces[k], as_tensor(share, dtype=lens.wavelengths.dtype)
    if not 0 < float(share_of.detach()) < 1:
        raise BadEdit(
            f"split {k}-{k + 1}: {option('share', f'{float(share_of.detach()):g}')}: expected a part between 0 and 1"
        )
    like = front.thickness
    bend, air = (like.new_tensor(n) if not isinstance(n, Tensor) else n for n in (curvature, gap))
    if float(air.detach()) < 0:
        raise BadEdit(f"split {k}-{k + 1}: {option('gap', f'{float(air.detach()):g}')}: expected 0 mm or more")
    medium, n = medium_before(lens, k), media(lens, lens.primary)
    before, glass, behind = n[k - 1], n[k], n[k + 1]
    parts = share_of * like, (1 - share_of) * like
    bends = vertex_curvature(front), vertex_curvature(lens.surfaces[k + 1])
    strengths = [(glass - before) * bends[0], (before - glass) * bend, (behind - glass) * bends[1]]
    gaps = [parts[0] / glass, air / before, parts[1] / glass]
    whole = _power([strengths[0], strengths[2]], [like / glass])
    trials = [_power([*strengths[:2], (glass - before) * x, strengths[2]], gaps) for x in (0.0, 1.0)]
    other = (whole - trials[0]) / (trials[1] - trials[0]) if isinstance(gap, Tensor) or gap else bend
    faces = [
        Surface(air, bend, glass=medium.glass, environment=medium.environment, semi_diameter=front.semi_diameter),
        Surface(parts[1], other, glass=front.glass, environment=front.environment, semi_diameter=front.semi_diameter),
    ]
    new = inserted(lens, k + 1, faces)
    return new.replace(k, thickness=parts[0])


def cement(lens: Lens, surfaces: At, *, curvature: Tensor | float | None = None) -> Lens:
    """The lens with two elements cemented: the facing surfaces of an air space, as "2-3", become one, without air.

    The shared surface has a `curvature` in 1/mm, by default the mean of both; what follows moves forward by the air
    space. What refers to the second surface or to the air space is left out, in one warning (`LeftOut`); a stop at
    either surface is at the shared one. Raises BadEdit for other than centred refracting spheres with air between two
    different glasses.
    """
    first, last = surfaces_at(lens, surfaces)
    where = f"cement {first}-{last}"
    if last != first + 1:
        raise BadEdit(f"{where}: expected the two surfaces of an air space, as {first}-{first + 1}")
    for k in (first, last):
        if why := _objection(lens, k):
            raise BadEdit(f"{where}: surface {k} {why}")
    if why := no_air_space(lens, first):
        raise BadEdit(f"{where}: {why}")
    new, numbering = cemented(lens, first)
    if curvature is not None:
        new = new.replace(first, curvature=as_tensor(curvature, dtype=lens.surfaces[first].thickness.dtype))
    warn_of(LeftOut, f"{where}: left out with the air space", numbering.lost)
    return new


def no_air_space(lens: Lens, k: int) -> str:
    """Why surfaces k and k + 1 cannot become one cemented surface, "" where they can."""
    faces = lens.surfaces[k : k + 2]
    if not is_air(faces[0].glass) or is_air(faces[1].glass) or is_air(medium_before(lens, k).glass):
        return "no air space between two glasses"
    if same(medium_before(lens, k).glass, faces[1].glass):
        return f"both elements are of {faces[1].glass.name}; cemented they were one element"
    if any(part is not None for face in faces for part in (face.conic, face.coefficients, face.sag_terms)):
        return "expected spheres"
    return ""


def cemented(lens: Lens, k: int) -> tuple[Lens, Numbering]:
    """The lens with surfaces k and k + 1 as one, of their mean curvature, as `cement`, and the numbering."""
    front, back = lens.surfaces[k : k + 2]
    curvature = 0.5 * (vertex_curvature(front) + vertex_curvature(back))
    gap = {name: getattr(back, name) for name in GAP}
    shared = dataclasses.replace(front, curvature=curvature, expansion=back.expansion, **gap)
    numbers = [number if number <= k else number - 1 for number in range(len(lens.surfaces))]
    places: list[int | None] = [*numbers[: k + 1], None, *numbers[k + 2 :]]
    gaps: list[int | None] = [*numbers[:k], None, k, *numbers[k + 2 :]]
    numbering = Numbering(lens, tuple(places), tuple(gaps))
    surfaces = (*lens.surfaces[:k], shared, *lens.surfaces[k + 2 :])
    stop = k if lens.stop == k + 1 else None
    new = numbering.with_surfaces(surfaces, stop=stop)
    check(new)
    return new, numbering


def _power(strengths: Sequence[Tensor], gaps: Sequence[Tensor]) -> Tensor:
    """Power in 1/mm of surfaces of given powers, t/n apart."""
    return -ynu(torch.ones_like(gaps[0]), torch.zeros_like(gaps[0]), strengths, gaps)[-1][1]


def with_meniscus(lens: Lens, k: int) -> Lens:
    """The lens with a meniscus without thickness before surface k, of the adjacent glass; no ray changes."""
    if why := _objection(lens, k):
        raise BadEdit(f"split: surface {k} {why}")
    surface = lens.surfaces[k]
    thin = dataclasses.replace(surface, thickness=0 * surface.thickness, apertures=(), comment="")
    around = surface, medium_before(lens, k)  # behind the two new surfaces
    new = [dataclasses.replace(thin, glass=medium.glass, environment=medium.environment) for medium in around]
    return inserted(lens, k, new)


def bend(lens: Lens, element: At, shape: Tensor | float, *, keep: str = "efl") -> Lens:
    """The lens with an element, as "3-4", of another shape factor X = (c₁ + c₂)/(c₁ - c₂) and the same power.

    X is 0 of an equiconvex lens, 1 of a plano-convex one with its power in front, -1 of one with its power behind.
    keep: "efl", the power of the thick element at the primary wavelength, φ = φ₁ + φ₂ - (t/n) φ₁ φ₂; or "thin", its
    power without thickness. With c₁, c₂ = K (X ± 1)/2 the first is a quadratic equation for K. Terms of r² of an
    asphere count to the curvatures, and stay. Other elements, and all thicknesses, stay, so that the focal length of a
    lens of several elements changes by the shift of the principal planes.

    Raises BadEdit for other than centred refracting elements in one medium, and where no element has that shape.
    """
    if keep not in ("efl", "thin"):
        raise BadEdit(f"{option('keep', keep)}: expected efl or thin")
    k = _element(lens, surfaces_at(lens, element), "bend")
    front, back = lens.surfaces[k : k + 2]
    before, glass, behind = media(lens, lens.primary)[k - 1 : k + 2]
    if not same(medium_before(lens, k).glass, lens.surfaces[k + 1].glass):
        raise BadEdit(f"bend {k}-{k + 1}: is cemented; its faces are those of its neighbours too")
    x = shape if isinstance(shape, Tensor) else front.thickness.new_tensor(shape)
    c = vertex_curvature(front), vertex_curvature(back)
    steps = glass - before, behind - glass
    depth = front.thickness / glass if keep == "efl" else 0.0 * front.thickness
    wanted = steps[0] * c[0] + steps[1] * c[1] - depth * steps[0] * steps[1] * c[0] * c[1]
    linear = 0.5 * (steps[0] * (x + 1) + steps[1] * (x - 1))
    square = -0.25 * depth * steps[0] * steps[1] * (x * x - 1)
    radicand = linear * linear + 4 * square * wanted
    if not float(radicand.detach()) > 0:
        raise BadEdit(
            f"bend {k}-{k + 1}: no element of the shape {float(x.detach()):g} has its power and its thickness"
        )
    size = 2 * wanted / (linear + torch.copysign(torch.sqrt(radicand), linear))
    new = lens
    for number, (surface, old, sign) in enumerate(((front, c[0], 1), (back, c[1], -1)), k):
        curvature = surface.thickness.new_zeros(()) if surface.curvature is None else surface.curvature
        new = new.replace(number, curvature=0.5 * size * (x + sign) + (curvature - old))
    return new


def _element(lens: Lens, ends: tuple[int, int], edit: str) -> int:
    """The first surface of an element of two centred refracting surfaces. Raises BadEdit."""
    k, last = ends
    if last != k + 1:
        raise BadEdit(f"{edit} {k}-{last}: expected the two surfaces of one element, as {k}-{k + 1}")
    for surface in ends:
        if why := _objection(lens, surface):
            raise BadEdit(f"{edit} {k}-{last}: surface {surface} {why}")
    if is_air(lens.surfaces[k].glass):
        raise BadEdit(f"{edit} {k}-{last}: no glass between them")
    return k


def _objection(lens: Lens, k: int) -> str:
    """Why a surface is no centred refracting one, "" where it is."""
    if not 1 <= k <= sensor(lens):
        return f"is none of this lens, which has surfaces 1 to {sensor(lens)} between object and image"
    surface = lens.surfaces[k]
    if surface.is_mirror:
        return "is a mirror, whose power and shape are those of one face: give it another radius instead"
    if surface.phase is not None:
        return "has a phase"
    return "is tilted or decentred, or a coordinate break" if is_posed(surface) else ""


# -- names -------------------------------------------------------------------------------------------------------------


def rename(lens: Lens, title: str | None = None, *, comments: Mapping[int | str, str] | None = None) -> Lens:
    """The lens with another title, and with other comments of surfaces, by their number or their comment.

    A comment of several surfaces, "3-4", is that of the first. Raises BadEdit.
    """
    surfaces = list(lens.surfaces)
    for choice, comment in (comments or {}).items():
        k, _ = surfaces_at(lens, choice)
        surfaces[k] = dataclasses.replace(surfaces[k], comment=comment)
    return dataclasses.replace(lens, name=lens.name if title is None else title, surfaces=tuple(surfaces))

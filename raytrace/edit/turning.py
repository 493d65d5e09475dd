"""A lens, or a group of its surfaces, turned around: by 180° about y, as a lens that is mounted the other way.

    (x, y, z) -> (-x, y, -z)        z = S(x, y) -> z = -S(-x, y)

Light then passes the surface from the other side. A path that a phase adds is the same from either side, at x -> -x.
The pose before the surface is the inverse of the one that was behind it, in the turned axes.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from raytrace.edit.choice import At, BadEdit, LeftOut, surfaces_at, warn_of
from raytrace.edit.numbering import Numbering
from raytrace.materials.glass import AIR, label
from raytrace.maths.bivariate import powers
from raytrace.maths.zernike import Order, fringe, noll
from raytrace.system.apertures import Aperture
from raytrace.system.configurations import same
from raytrace.system.lens import Fields, Lens, SystemAperture
from raytrace.system.poses import Pose, undone
from raytrace.system.shapes import KINDS
from raytrace.system.surface import Surface, is_posed, medium_surfaces
from raytrace.tracing.paraxial import first_order
from raytrace.words import option


def reverse(lens: Lens, surfaces: At | None = None, *, swap_conjugates: bool = False) -> Lens:
    """The lens with all of its surfaces turned around, or with a group of them: "3-6", (3, 6), a comment.

    Surfaces, media and thicknesses follow one another the other way round; semi-diameters, apertures, comments, poses
    and the stop go with their surfaces. The spaces before and behind the group, the object and the image stay.
    swap_conjugates: object and image change their places as well, so that the rays of the lens are traced backwards;
    object heights become real image heights, image heights object heights; the beam is that through the stop.

    Solves by rays do not hold at a turned surface: they are left out, as rows of curvatures over turned and other
    surfaces, in one warning (`LeftOut`). Raises BadEdit for an odd number of mirrors, for a group that is cemented to
    other surfaces, and for conjugates that cannot be swapped.
    """
    last = len(lens.surfaces) - 1
    first, end = (0, last) if swap_conjugates else (1, last - 1) if surfaces is None else surfaces_at(lens, surfaces)
    if swap_conjugates and surfaces is not None:
        raise BadEdit(f"{option('swap_conjugates')} turns the whole lens around; leave {option('surfaces')} out")
    if not swap_conjugates and not 1 <= first <= end < last:
        raise BadEdit(f"reverse {first}-{end}: expected surfaces from 1 to {last - 1}; the object and the image stay")
    group = range(first, end + 1)
    if sum(lens.surfaces[k].is_mirror for k in group) % 2:
        raise BadEdit(f"reverse {first}-{end}: an odd number of mirrors: light leaves where it enters")
    media = [lens.surfaces[k] for k in medium_surfaces(lens.surfaces)]
    if (first, end) not in ((1, last - 1), (0, last)):
        before, behind = media[first - 1].glass, media[end].glass
        if not same(before, behind):
            names = " and ".join(label(medium) or "air" for medium in (before, behind))
            message = f"reverse {first}-{end}: the media before and behind are {names}"
            raise BadEdit(f"{message}; choose the whole cemented group, as the surfaces from air to air")
    if swap_conjugates:
        _check_conjugates(lens)
    order = [*range(first), *reversed(group), *range(end + 1, last + 1)]
    gaps = [*range(first), *(first + end - g - 1 for g in range(first, end)), *range(end, last + 1)]
    numbering = Numbering(lens, tuple(order), tuple(gaps), group, turned)
    new = numbering.with_surfaces(_reversed(lens, media, order, gaps, group))
    warn_of(LeftOut, f"reverse {first}-{end}: left out, as they do not hold there", numbering.lost)
    return _with_swapped_conjugates(lens, new) if swap_conjugates else new


def _reversed(
    lens: Lens, media: Sequence[Surface], order: Sequence[int], gaps: Sequence[int], group: range
) -> list[Surface]:
    """The surfaces in their new order; order, gaps: the old numbers of surfaces and of the gaps behind them; media: the
    surface whose medium fills each gap."""
    surfaces = list(lens.surfaces)
    for place in group:
        surface, gap = turned(lens.surfaces[order[place]]), gaps[place]
        medium = media[gap] if place < len(order) - 1 else lens.surfaces[-1]
        surfaces[place] = dataclasses.replace(
            surface,
            thickness=lens.surfaces[gap].thickness,
            glass=surface.glass if surface.is_mirror else AIR if surface.is_break else medium.glass,
            environment=medium.environment,
        )
    return surfaces


def _check_conjugates(lens: Lens) -> None:
    """Refuse a lens whose object and image cannot change their places."""
    why = ""
    if not math.isfinite(float(lens.surfaces[0].thickness)):
        why = "the object is at infinity, and no image can be; set an object distance"
    elif is_posed(lens.surfaces[-1]):
        why = "the image is tilted or decentred"
    elif any(scaled.path[0] in ("fields", "aperture") for operand in lens.operands for scaled in operand.paths):
        why = "configurations differ in fields or aperture; take one of them"
    if why:
        raise BadEdit(f"{option('swap_conjugates')}: {why}")


def _with_swapped_conjugates(lens: Lens, new: Lens) -> Lens:
    """The turned lens with the fields and the beam of the rays of the lens, traced backwards."""
    data, fields = first_order(lens), lens.fields
    x, y = 0.0 - fields.x, fields.y
    kind = "real_image_height" if fields.kind == "object_height" else "object_height"
    if fields.kind == "angle":
        tangents = (torch.tan(torch.deg2rad(angle)) * data.angular_magnification for angle in (fields.x, fields.y))
        x, y = (torch.rad2deg(torch.atan(slope)) for slope in tangents)
        kind, y = "angle", 0.0 - y
    if fields.vignetting is not None:
        warn_of(LeftOut, "reverse: left out, as they are of the former entrance pupil", ["vignetting factors"])
    return dataclasses.replace(
        new,
        fields=Fields(kind, x, y, fields.weight),
        aperture=SystemAperture("float_by_stop", data.stop_height.abs()),
    )


def turned(surface: Surface) -> Surface:
    """A surface turned around; its thickness and medium, which belong to the gap behind it, are left."""
    is_bare = surface.is_break and surface.after is None
    before, after = _pose(surface.after), _pose(surface.pose)
    return dataclasses.replace(
        surface,
        curvature=_negative(surface.curvature),
        coefficients=_coefficients(surface),
        sag_terms=_part(surface.sag_terms),
        phase=_part(surface.phase),
        before=after if is_bare else before,
        after=None if is_bare else after,
        apertures=tuple(map(_aperture, surface.apertures)),
    )


def _negative(number: Any) -> Any:
    """-x, and 0 of 0."""
    return None if number is None else 0.0 - number


def _coefficients(surface: Surface) -> Tensor | None:
    a, kind = surface.coefficients, KINDS[surface.kind]
    if a is None:
        return None
    return _with_signs(a, [kind.sign_of(entry) for entry in range(len(a))])


def _with_signs(numbers: Tensor, signs: Sequence[int]) -> Tensor:
    by_entry = numbers.new_tensor(signs).reshape(-1, *(1,) * (numbers.dim() - 1))
    return numbers * by_entry + 0.0


def _pose(pose: Pose | None) -> Pose | None:
    """The inverse pose in the turned axes."""
    if pose is None:
        return None
    back = undone(pose)
    changes: dict[str, Any] = {name: _negative(getattr(back, name)) for name in ("x", "z", "tilt_x", "tilt_z")}
    return dataclasses.replace(back, **changes)


def _aperture(aperture: Aperture) -> Aperture:
    x, y = aperture.centre
    extent = aperture.extent
    if aperture.shape == "polygon":
        extent = tuple(size if k % 2 else 0.0 - size for k, size in enumerate(extent))
    return dataclasses.replace(aperture, extent=extent, centre=(0.0 - x, y))


def _of_power(count: int) -> list[int]:
    """The parity in x of the powers x, y, x², xy, …"""
    return [(-1) ** i for i, _ in powers(count)]


def _of_order(orders: Sequence[Order]) -> list[int]:
    """The parity in x of cos mφ (m ≥ 0) and sin |m|φ (m < 0), φ from x."""
    return [(-1) ** (abs(m) + (m < 0)) for _, m in orders]


def _of_noll(count: int) -> list[int]:
    return _of_order([noll(j) for j in range(1, count + 1)])


def _of_fringe(count: int) -> list[int]:
    return _of_order([fringe(j) for j in range(1, count + 1)])


def _terms(parities: Callable[[int], list[int]], sign: int) -> Callable[[Any], dict[str, Any]]:
    """The turned coefficients of a sum of terms by their parities in x; sign: -1 of a sag, 1 of a path."""

    def changes(part: Any) -> dict[str, Any]:
        signs = [sign * parity for parity in parities(len(part.coefficients))]
        negated = [name for name in ("centre_x", "height") if hasattr(part, name)]
        return {
            "coefficients": _with_signs(part.coefficients, signs),
            **{name: _negative(getattr(part, name)) for name in negated},
        }

    return changes


def _hologram(part: Any) -> dict[str, Any]:
    """Light comes from where it went."""
    return {name: _with_signs(point, (-1, 1, -1)) for name, point in (("first", part.second), ("second", part.first))}


#: The numbers of sag terms and phases that change, by their class.
_TURNED: dict[str, Callable[[Any], dict[str, Any]]] = {
    "GridSag": lambda sag: {"heights": _negative(sag.heights.flip(1))},
    "SplineSag": lambda sag: {"coefficients": _negative(sag.coefficients.flip(1))},
    "ZernikeSag": _terms(_of_noll, -1),
    "FringeSag": _terms(_of_fringe, -1),
    "PolynomialSag": _terms(_of_power, -1),
    "PowerSag": _terms(_of_power, -1),
    "IrregularSag": lambda sag: {
        name: _negative(getattr(sag, name)) for name in ("spherical", "astigmatism", "coma", "angle")
    },
    "TiltSag": lambda sag: {"tan_y": _negative(sag.tan_y)},
    "PolynomialPhase": _terms(_of_power, 1),
    "FringePhase": _terms(_of_fringe, 1),
    "PolynomialPath": _terms(_of_power, 1),
    "Hologram": _hologram,
    "HologramPath": _hologram,
    "IdealLens": lambda lens: {"vergence": None},  # which is that of the whole lens
    **dict.fromkeys(("Grating", "RadialPhase", "RadialPath", "Facets"), lambda phase: {}),
}


def _part(part: Any) -> Any:
    return None if part is None else dataclasses.replace(part, **_TURNED[type(part).__name__](part))

"""Expansion: the surfaces of a lens at another temperature. With s = 1 + α ΔT of a glass and σ = 1 + α′ ΔT of a spacer:

    surface   z′(x, y) = s z(x/s, y/s): radius s R, terms of r^n times s^(1-n), conic unchanged, semi-diameter s h
    glass     t′ = s t
    space     t′ = σ (t + z₂(h₂) - z₁(h₁)) + z₁′(σ h₁) - z₂′(σ h₂)

A surface expands as the glass behind it, else as the glass before it, else as the space behind it (a stop, a mirror in
air). The spacer of a space is a tube between the edges of the two surfaces, whose radii of contact h₁, h₂ expand with
it. These rules reproduce every number that OpticStudio stored for a doublet at 100 °C in an aluminium barrel, to the 13
digits of its file. Expansion is linear: α is that from -30 to 70 °C.

`Surface.expansion` is that of the space behind it, or of a medium whose catalog lists none.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from raytrace.materials.glass import Glass, is_air, label
from raytrace.system.apertures import Aperture
from raytrace.system.shapes import KINDS
from raytrace.system.surface import SIZES, Surface, medium_surfaces, sag_at

_UNIT = 1e-6  # of coefficients, 1/K

#: Powers of length of the numbers of sag terms, phases and poses; all others have none.
_LENGTHS = {
    **dict.fromkeys(("heights", "pitch", "radius", "centre_x", "centre_y", "height"), 1),
    **dict.fromkeys(("spherical", "astigmatism", "coma", "first", "second", "wavelength", "x", "y", "z"), 1),
    "frequency": -1,
}

#: Axes that a number has in one lens, in front of that of a batch.
_AXES = {"coefficients": 1, "first": 1, "second": 1, "heights": 2}


def is_solid(glass: Glass) -> bool:
    """Whether a medium has a thickness of its own: no gas, and no liquid that its mount holds (AGF, fifth of ED)."""
    held = next((numbers[4:5] for word, numbers in glass.records if word == "ED"), ())
    return not is_air(glass) and held != (1.0,)


def spaces(surfaces: Sequence[Surface]) -> list[int]:
    """The surfaces from 1 in front of spaces, which have a spacer or the mount between the elements."""
    media = medium_surfaces(surfaces)
    return [k for k in range(1, len(media) - 1) if not is_solid(surfaces[media[k]].glass)]


def unexpanded(surfaces: Sequence[Surface]) -> dict[int, str]:
    """The names of media without an expansion, listed or stated, by the first surface of each."""
    names: dict[str, int] = {}
    for k, surface in enumerate(surfaces[:-1]):
        begins = medium_surfaces(surfaces)[k] == k and surface.glass.formula != "mirror"
        if begins and is_solid(surface.glass) and surface.glass.expansion is None and surface.expansion is None:
            names.setdefault(label(surface.glass), k)
    return {k: name for name, k in names.items()}


def in_contact(surfaces: Sequence[Surface]) -> list[int]:
    """The surfaces from 1 that end a space and are curved: the thickness of the space depends on their edges."""
    ends = {j for k in spaces(surfaces) for j in (k, k + 1)}
    return [k for k in sorted(ends) if not (surfaces[k].is_plane or surfaces[k].is_break)]


def growth(surfaces: Sequence[Surface], warmer: Tensor) -> tuple[list[Tensor], list[Tensor]]:
    """Factors s of the surfaces, and those of the media and spaces behind them.

    warmer: () K. A medium in an environment of its own keeps its temperature.
    """
    media = medium_surfaces(surfaces)
    solid = [is_solid(surfaces[k].glass) for k in media]

    def factor(k: int, listed: float | None) -> Tensor:
        α: Tensor | float = 0.0 if listed is None else listed
        stated = surfaces[k].expansion
        α = stated if listed is None and stated is not None else α
        return 1.0 + _UNIT * α * (warmer if surfaces[media[k]].environment is None else 0.0 * warmer)

    behind = [
        factor(media[k], surfaces[media[k]].glass.expansion) if solid[k] else factor(k, None) for k in range(len(media))
    ]
    faces = [behind[k] if solid[k] or k == 0 or not solid[k - 1] else behind[k - 1] for k in range(len(media))]
    return faces, behind


def expanded(surfaces: Sequence[Surface], warmer: Tensor, heights: Mapping[int, Tensor]) -> tuple[Surface, ...]:
    """The surfaces at a temperature that is `warmer` by () K; the object distance stays unless its expansion is stated.

    heights: mm, radii of contact of the surfaces `in_contact`. Differentiable in all numbers.
    """
    faces, behind = growth(surfaces, warmer)
    media = medium_surfaces(surfaces)
    after = [_grown(surface, s) for surface, s in zip(surfaces, faces, strict=True)]
    for k, σ in enumerate(behind[:-1]):
        thickness = surfaces[k].thickness
        if k == 0 and surfaces[0].expansion is None:
            continue
        if is_solid(surfaces[media[k]].glass):
            after[k] = dataclasses.replace(after[k], thickness=σ * thickness)
            continue
        step = _edges(surfaces, k, heights)
        hot = _edges(after, k, {j: σ * h for j, h in heights.items()})
        after[k] = dataclasses.replace(after[k], thickness=σ * thickness + (σ * step - hot))
    return tuple(after)


def _edges(surfaces: Sequence[Surface], k: int, heights: Mapping[int, Tensor]) -> Tensor:
    """z₂(h₂) - z₁(h₁) mm of the surfaces k and k + 1, at the contact of the spacer along y."""
    front, back = (
        sag_at(surfaces[j], torch.zeros_like(heights[j]), heights[j])
        if j in heights
        else torch.zeros_like(surfaces[k].thickness)
        for j in (k, k + 1)
    )
    return back - front


def _grown(surface: Surface, s: Tensor) -> Surface:
    """A surface whose shape, decentres, apertures and sizes are s times as large."""
    size, changes = float(s.detach().mean()), dict[str, Any]()
    if surface.curvature is not None:
        changes["curvature"] = surface.curvature / s
    if surface.coefficients is not None:
        kind, a = KINDS[surface.kind], surface.coefficients
        powers = s.new_tensor([kind.power_of(entry) for entry in range(len(a))])
        changes["coefficients"] = _spread(a, s, 1) * s ** powers.reshape(-1, *(1,) * s.dim())
    if surface.sag_terms is not None:
        changes["sag_terms"] = _lengthened(surface.sag_terms, s, {**_LENGTHS, "coefficients": 1})
    for name in ("phase", "before", "after"):
        if (held := getattr(surface, name)) is not None:
            changes[name] = _lengthened(held, s, _LENGTHS)
    for name in SIZES:
        if (length := getattr(surface, name)) is not None:
            changes[name] = size * length
    changes["apertures"] = tuple(_larger(aperture, size) for aperture in surface.apertures)
    return dataclasses.replace(surface, **changes)


def _larger(aperture: Aperture, size: float) -> Aperture:
    extent, centre = (tuple(size * number for number in numbers) for numbers in (aperture.extent, aperture.centre))
    return dataclasses.replace(aperture, extent=extent, centre=centre)


def _lengthened(held: Any, s: Tensor, powers: Mapping[str, int]) -> Any:
    """Sag terms, a phase or a pose whose lengths are s times as large."""
    lengths = {name: number for name in powers if (number := getattr(held, name, None)) is not None}
    grown = {name: _spread(n, s, _AXES.get(name, 0)) * s ** powers[name] for name, n in lengths.items()}
    return dataclasses.replace(held, **grown)


def _spread(number: Tensor, s: Tensor, axes: int) -> Tensor:
    """A number with an axis for the lenses of a batch behind its own axes, where s has one."""
    return number.reshape((*number.shape, *(1,) * (axes + s.dim() - number.dim())))

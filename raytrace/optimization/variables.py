"""Vary: what an optimisation may change and what follows, as words name it.

curvature thickness           all surfaces that bend light; all gaps from surface 1 to the image
curvature:1-4,7 conic:3 a4:3  of some surfaces
tilt:5 decentre:5             tilt_x and tilt_y; x and y of the pose
sensor                        the last gap
index glass:2                 the index of all glasses, as model glasses; a glass that may be exchanged
thickness:6@2                 in configuration 2, of a number that differs from one to the next
curvature:4=-curvature:3      follows: a number times another and one more, as thickness:8=2*thickness:2+1
curvature:7=f_number(4)       follows: a solve, a row of SOLVED_BY
"""

import dataclasses
import re
import warnings
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import torch

from raytrace.materials.glass import (
    Glass,
    abbe_number,
    is_air,
    model_glass,
    nd,
    normal_line_deviation,
    refractive_index,
)
from raytrace.optimization.lens_model import GLASS, Address, names_at
from raytrace.system.configurations import same
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import (
    BadVariables,
    counted,
    joined,
    modelled,
    parameter_paths,
    parse_bounds,
    sensor,
)
from raytrace.system.surface import medium_surfaces
from raytrace.words import calling_level, did_you_mean

#: Words for several numbers at once.
GROUPS = {"tilt": ("tilt_x", "tilt_y"), "decentre": ("x", "y")}

#: What a solve is called, for which number it may stand, and how many numbers it takes, least and most.
SOLVED_BY = {
    "marginal_angle": ("curvature", 1, 1),
    "f_number": ("curvature", 1, 1),
    "marginal_height": ("thickness", 1, 2),
    "edge_thickness": ("thickness", 1, 2),
}

#: Numbers that belong to a medium.
MEDIA = (*GLASS, "glass")

#: What is not varied by that name, and what is instead.
_INSTEAD = {"radius": "curvature", "focus": "sensor", "glasses": "glass", "abbe": "abbe_number"}

_NUMBER = r"\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?"
_PICKUP = re.compile(rf"([-+]?)(?:({_NUMBER})\*)?([a-z]\w*):(\d+)(?:([-+])({_NUMBER}))?")
_SOLVE = re.compile(r"([a-z]\w*)\(([^()]*)\)")


class VariedGlass(UserWarning):
    """A glass of a catalog is a model glass now, whose numbers can vary."""


@dataclass(frozen=True)
class Freedom:
    """What varies and what follows: of a lens in which all of it is modelled, also where it is 0 now."""

    lens: Lens
    variables: tuple[Vary, ...]
    solves: tuple[Solve, ...] = ()


def freedom(lens: Lens, vary: str | Sequence[str] | None = None) -> Freedom:
    """What varies of a lens: what words name, or without any what its file does.

    Solves of the file hold where no word says otherwise: a number that is named varies, and one that belongs to no
    surface's name ("curvature") varies where no solve holds. Raises BadVariables.
    """
    own = () if lens.optimization_data is None else lens.optimization_data.solves
    if vary is None:
        if lens.optimization_data is None or not lens.optimization_data.variables:
            raise BadVariables("the file tells no variables: `vary` names them, as 'curvature thickness'")
        return Freedom(lens, lens.optimization_data.variables, own)
    words = _words(joined(vary))
    told = tuple(solve for word in words if "=" in word for solve in _solves(lens, word))
    found: dict[str, Vary] = {}
    for word in words:
        if "=" not in word:
            follow = set() if ":" in word or word == "sensor" else _addresses((*told, *own))
            found |= {name_of(one): one for one in varied(lens, word) if not _addresses([one]) & follow}
    if not found:
        raise BadVariables(
            f"`vary={joined(vary)}` leaves nothing to vary; expected words like curvature thickness:5,6 conic:3"
        )
    free = _addresses(found.values())
    for surface, quantity, *_ in free & _addresses(told):
        raise BadVariables(f"{quantity}:{surface} is to vary and to follow: leave one out")
    solves = (*(one for one in own if not _addresses([one]) & (free | _addresses(told))), *told)
    _refuse_circles(solves)
    return Freedom(with_modelled(lens, (*found.values(), *told)), tuple(found.values()), solves)


def _address(one: Vary | Solve) -> Address:
    return one.surface, one.quantity


def _addresses(several: Iterable[Vary | Solve]) -> set[tuple]:
    """Those of numbers; a glass that follows another with all its numbers, one of the configurations as that alone."""
    found: set[tuple] = set()
    for one in several:
        follows = isinstance(one, Solve)
        if not (follows and one.operand is not None):
            found.add(_address(one))
        if one.operand is not None:
            found.add((*_address(one), one.configuration))
        if follows and one.quantity == "glass":
            found |= {(one.surface, name) for name in GLASS}
    return found


def varied(lens: Lens, word: str) -> tuple[Vary, ...]:
    """The numbers that one word names, by surface and configuration. Raises BadVariables."""
    named, _, configurations = word.partition("@")
    kind, colon, numbers = named.partition(":")
    _refuse_kind(lens, kind, bool(colon), word)
    if kind == "sensor":
        kind, surfaces = "thickness", [sensor(lens)]
    elif numbers or colon:
        surfaces = counted(word, numbers)
    else:
        surfaces = [k for k in range(1, sensor(lens) + 1) if _makes_sense(lens, kind, k)]
    only = counted(word, configurations, "configuration") if configurations else []
    found = [one for k in surfaces for quantity in _quantities(lens, kind, k, word) for one in _each(lens, k, quantity)]
    found = [one for one in found if not only or one.configuration in only]
    if found:
        return tuple(dict.fromkeys(found))
    if only:
        raise BadVariables(f"{word!r}: no such number differs in {_listed('configuration', only)}; leave @ out")
    raise BadVariables(f"{word!r}: no surface has that yet; name surfaces, as {kind}:3")


def name_of(one: Vary) -> str:
    """A variable as bounds and tables call it: thickness_6, in configuration 2 thickness_6@2."""
    return f"{one.quantity}_{one.surface}" + (f"@{one.configuration}" if one.configuration else "")


def bounds_of(
    lens: Lens, variables: Sequence[Vary], text: str | Sequence[str] | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest value (n,) of every variable, of words like "thickness:2..15 curvature_3:-0.1,0".

    A name stands for all variables of a kind, for one of a surface (thickness_3, or thickness:3-5 of several), or for
    one in a configuration (thickness_3@2); what comes later in the text counts. Raises BadVariables for a name that
    none of them has.
    """
    own = [one.bounds or (-np.inf, np.inf) for one in variables]
    low, high = (np.array([ends[k] for ends in own], dtype=float) for k in range(2))
    for name, ends in parse_bounds(joined(text or "")).items():
        kind, _, surfaces = name.partition(":")
        wanted = {f"{kind}_{k}" for k in counted(name, surfaces)} if surfaces else {name}
        chosen = [position for position, one in enumerate(variables) if wanted & _names(lens, one)]
        if not chosen:
            known = [known for one in variables for known in _names(lens, one)]
            raise BadVariables(f"`bounds` for {name}, not among the variables{did_you_mean(name, known)}")
        low[chosen], high[chosen] = ends
    return low, high


def with_modelled(lens: Lens, moved: Sequence[Vary | Solve]) -> Lens:
    """The lens with every such number modelled, at 0 where it was not, and glasses whose numbers move as model glasses.

    Warns VariedGlass of the latter: between the lines of its definition a model glass is only near that of a catalog.
    """
    surfaces = list(lens.surfaces)
    for one in moved:
        surface = surfaces[one.surface]
        if one.quantity in GLASS:
            surfaces[one.surface] = dataclasses.replace(surface, glass=_model_of(surface.glass, one.surface, lens))
        elif one.quantity not in MEDIA:
            surfaces[one.surface] = modelled(surface, one.quantity)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def _model_of(glass: Glass, surface: int, lens: Lens) -> Glass:
    """The model glass of the same index, Abbe number and partial dispersion."""
    if glass.formula in ("model", "constant"):
        return glass
    found = model_glass(nd(glass).detach(), abbe_number(glass).detach(), normal_line_deviation(glass).detach())
    off = refractive_index(found, lens.wavelengths) - refractive_index(glass, lens.wavelengths)
    warnings.warn(
        f"surface {surface}: {glass.name} varies as a model glass, whose index is off by {float(off.abs().max()):.1g}",
        VariedGlass,
        stacklevel=calling_level(),
    )
    return found


def _names(lens: Lens, one: Vary) -> set[str]:
    group = {name for name, quantities in GROUPS.items() if one.quantity in quantities}
    kinds = {one.quantity, *group}
    last = {"sensor"} if (one.surface, one.quantity) == (sensor(lens), "thickness") else set()
    return {name_of(one), *kinds, *(f"{kind}_{one.surface}" for kind in kinds), *last}


def _words(text: str) -> list[str]:
    """The words of a list; in what follows spaces may stand around signs."""
    return re.sub(r"\s*([-=*+,(])\s*|\s*(\))", r"\1\2", text).split()


def _refuse_kind(lens: Lens, kind: str, of_surfaces: bool, word: str) -> None:
    """Raise BadVariables for what is no number of any surface."""
    if (kind == "sensor" and of_surfaces) or kind in _INSTEAD:
        meant = f"; did you mean {_INSTEAD[kind]}?" if kind in _INSTEAD else " without surfaces"
        raise BadVariables(f"{word!r}: expected {kind if kind == 'sensor' else 'a number of a lens'}{meant}")
    own = (name for surface in lens.surfaces for name in parameter_paths(modelled(surface, kind)))
    known = dict.fromkeys(["thickness", "sensor", *MEDIA, *GROUPS, *own])
    if kind not in known:
        raise BadVariables(f"{word!r}: no {kind!r}; this lens has {', '.join(known)}{did_you_mean(kind, known)}")


def _makes_sense(lens: Lens, kind: str, k: int) -> bool:
    """Whether a kind that is named alone means surface k too."""
    surface = lens.surfaces[k]
    if kind == "curvature":
        return bends_light(lens, k)
    if kind == "thickness":
        return k == sensor(lens) or bool(surface.thickness != 0)
    if kind in MEDIA:
        return not (surface.is_mirror or surface.is_break or is_air(surface.glass))
    present = parameter_paths(surface)
    if kind == "conic":
        return surface.conic is not None
    return any(quantity in present for quantity in GROUPS.get(kind, (kind,)))


def bends_light(lens: Lens, k: int) -> bool:
    """Whether a surface is a mirror, or has other media before and behind it."""
    surfaces, media = lens.surfaces, medium_surfaces(lens.surfaces[: k + 1])
    return surfaces[k].is_mirror or not same(surfaces[media[k - 1]].glass, surfaces[media[k]].glass)


def _quantities(lens: Lens, kind: str, k: int, word: str) -> list[str]:
    """The numbers of a surface that a kind stands for."""
    if kind == "thickness" and k == 0 and bool(torch.isfinite(lens.surfaces[0].thickness)):
        return [kind]
    if not 1 <= k <= sensor(lens):
        raise BadVariables(f"{word!r}: surface {k}; this lens has surfaces 1 to {sensor(lens)} to vary")
    surface = lens.surfaces[k]
    if kind in MEDIA:
        if surface.is_mirror or surface.is_break or is_air(surface.glass):
            raise BadVariables(f"{word!r}: behind surface {k} there is no glass")
        return [kind]
    wanted = GROUPS.get(kind, (kind,))
    known = {"thickness", *(name for quantity in wanted for name in parameter_paths(modelled(surface, quantity)))}
    if surface.is_break and kind in ("curvature", "conic"):
        raise BadVariables(f"{word!r}: surface {k} is a coordinate break")
    if missing := [quantity for quantity in wanted if quantity not in known]:
        there = ", ".join(["thickness", *parameter_paths(surface)])
        raise BadVariables(f"{word!r}: surface {k} has no {missing[0]}; it has {there}")
    return list(wanted)


def _each(lens: Lens, k: int, quantity: str) -> list[Vary]:
    """A number of a surface, or where it differs between the configurations one for each of them."""
    for position, operand in enumerate(lens.operands):
        for place in operand.paths if operand.numbers is not None else ():
            if place.path[:2] == ("surfaces", k) and quantity in names_at(lens.surfaces[k], place.path[2:]):
                own = operand.paths[0].path  # which other places of the operand follow
                first = names_at(lens.surfaces[own[1]], own[2:])[0] if own[0] == "surfaces" else ""
                at = (own[1], first) if first else (k, quantity)
                return [Vary(*at, number, position) for number in range(1, len(operand.numbers) + 1)]
    return [Vary(k, quantity)]


# -- what follows ------------------------------------------------------------------------------------------------------


def _solves(lens: Lens, word: str) -> list[Solve]:
    """The solves of "curvature:4=-curvature:3" or "curvature:7=f_number(4)", one for every surface on the left."""
    left, _, right = word.partition("=")
    kind, _, numbers = left.partition(":")
    targets = [(sensor(lens), "thickness")] if left == "sensor" else [(k, kind) for k in counted(word, numbers)]
    for k, quantity in targets:
        _quantities(lens, quantity, k, word)
    if pickup := _PICKUP.fullmatch(right):
        return [_pickup(lens, word, k, quantity, pickup.groups()) for k, quantity in targets]
    solve = _SOLVE.fullmatch(right)
    if solve is None or solve[1] not in SOLVED_BY:
        known = ", ".join(f"{name}(…)" for name in SOLVED_BY)
        meant = did_you_mean(solve[1] if solve else right, SOLVED_BY)
        raise BadVariables(f"{word!r}: expected a number that it follows, as -2*curvature:3+0.1, or {known}{meant}")
    return [Solve(k, quantity, solve[1], _arguments(word, solve[1], quantity, solve[2])) for k, quantity in targets]


def _pickup(lens: Lens, word: str, k: int, quantity: str, parts: tuple) -> Solve:
    sign, scale, source, surface, side, offset = parts
    _quantities(lens, source, int(surface), word)
    if (k, quantity) == (int(surface), source):
        raise BadVariables(f"{word!r}: {quantity}:{k} cannot follow itself")
    return Solve(
        k,
        quantity,
        "pickup",
        source=int(surface),
        scale=(-1 if sign == "-" else 1) * float(scale or 1),
        offset=(-1 if side == "-" else 1) * float(offset or 0),
        quantity_of_source="" if source == quantity else source,
    )


def _arguments(word: str, solve: str, quantity: str, text: str) -> tuple[float, ...]:
    """The numbers of a solve, if they are as many as it takes and it is one for that number of a surface."""
    solved, least, most = SOLVED_BY[solve]
    try:
        found = tuple(float(part) for part in text.split(",") if part)
    except ValueError:
        raise BadVariables(f"{word!r}: {text!r} are no numbers; expected {solve}(number)") from None
    if quantity != solved or not least <= len(found) <= most:
        expected = f"{least}" if least == most else f"{least} or {most}"
        raise BadVariables(f"{word!r}: {solve} solves for a {solved}, by {expected} number(s)")
    return (*found, 0.0) if most == 2 and len(found) == 1 else found


def _refuse_circles(solves: Sequence[Solve]) -> None:
    """Raise BadVariables for numbers that follow one another round a circle."""
    after = {
        _address(one): (one.source, one.quantity_of_source or one.quantity)
        for one in solves
        if one.kind == "pickup" and one.operand is None
    }
    for start in after:
        at, passed = after[start], 0
        while at in after and passed <= len(after):
            at, passed = after[at], passed + 1
        if passed > len(after):
            raise BadVariables(f"{start[1]}:{start[0]} follows itself, by way of other numbers")


def _listed(noun: str, numbers: Sequence[int]) -> str:
    return f"{noun}{'s' if len(numbers) > 1 else ''} {', '.join(map(str, numbers))}"

"""Variable syntax: design variables, solves and pickups, bounds and constraints of `optimize`, `search` and cameras.

curvature thickness           all refracting and reflecting surfaces; all gaps from surface 1 to the image
curvature:1-4,7 conic:3 a4:3  of some surfaces
tilt:5 decentre:5             tilt_x and tilt_y; x and y of the pose; of the image, too
sensor                        the last gap
aperture                      the number of the system aperture: F/#, entrance pupil, NA, or the radius of the stop
temperature pressure          of lens and air, °C and atm, by which the indices change; radii do not
index glass:2                 the index of all glasses, as model glasses; a glass that may be exchanged
thickness:6@2                 in configuration 2, of a number that differs between configurations
curvature:4=-curvature:3      pickup: a factor times another number plus an offset, as thickness:8=2*thickness:2+1
curvature:7=f_number(4)       solve, a row of SOLVED_BY
thickness:2..15 sensor:57..58 bounds, of `bounds_of`; an open end is left out
efl=50 total_track<=80        constraints, split by `constraint_words`; "efl" alone keeps the number of the lens

`design_variables` makes the `DesignVariables` of a lens of them (`optimization.lens_state`).
"""

import dataclasses
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence

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
from raytrace.optimization.lens_state import DesignVariables, addresses_of
from raytrace.system.configurations import same
from raytrace.system.lens import Lens, with_environment
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import (
    GLASS,
    OF_LENS,
    PRESSURE,
    TEMPERATURE,
    BadVariables,
    counted,
    joined,
    modelled,
    parameter_paths,
    parse_bounds,
    sensor,
)
from raytrace.system.surface import medium_surfaces
from raytrace.words import RaytraceError, RaytraceWarning, calling_level, did_you_mean, option

#: Words for several numbers at once.
GROUPS = {"tilt": ("tilt_x", "tilt_y"), "decentre": ("x", "y")}

#: Solves by name: the quantity that each sets, and the smallest and largest count of its numbers.
SOLVED_BY = {
    "marginal_angle": ("curvature", 1, 1),
    "f_number": ("curvature", 1, 1),
    "marginal_height": ("thickness", 1, 2),
    "edge_thickness": ("thickness", 1, 2),
}

#: Words that take no surfaces.
_ALONE = ("sensor", *(name for _, name in OF_LENS))

#: Numbers that belong to a medium.
MEDIA = (*GLASS, "glass")

#: Names that are no variables, and the variable that is meant.
_INSTEAD = {"radius": "curvature", "focus": "sensor", "glasses": "glass", "abbe": "abbe_number"}

_NUMBER = r"\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?"
_PICKUP = re.compile(rf"([-+]?)(?:({_NUMBER})\*)?([a-z]\w*):(\d+)(?:([-+])({_NUMBER}))?")
_SOLVE = re.compile(r"([a-z]\w*)\(([^()]*)\)")


class VariedGlass(RaytraceWarning):
    """A glass of a catalog is replaced by a model glass, whose numbers can vary."""


def design_variables(lens: Lens, vary: str | Sequence[str | Vary] | None = None) -> DesignVariables:
    """The variables, solves and pickups of a lens by variable syntax, or by default those of its file.

    Solves of the file are kept unless the syntax overrides them: a number that is named varies, and a word without
    surfaces ("curvature") leaves solved numbers out. Raises BadVariables.
    """
    data = lens.optimization_data
    of_file = () if data is None else data.solves
    if vary is None:
        if data is None or not data.variables:
            raise BadVariables(f"the file has no variables: {option('vary')} names them, as 'curvature thickness'")
        return DesignVariables(lens, data.variables, of_file)
    listed = [vary] if isinstance(vary, str) else vary
    variables: dict[str, Vary] = {variable.name: variable for variable in listed if not isinstance(variable, str)}
    words = split_words([word for word in listed if isinstance(word, str)])
    if variables and not words:
        return DesignVariables(lens, tuple(variable for variable in listed if isinstance(variable, Vary)), of_file)
    new = tuple(solve for word in words if "=" in word for solve in _solves(lens, word))
    for word in words:
        if "=" not in word:
            solved = set() if ":" in word or word == "sensor" else _addresses((*new, *of_file))
            variables |= {
                variable.name: variable for variable in varied(lens, word) if not _addresses([variable]) & solved
            }
    if not variables:
        raise BadVariables(
            f"{option('vary', joined(words))} leaves nothing to vary; expected words like curvature thickness:5,6 "
            "conic:3"
        )
    free, solved = _addresses(variables.values()), _addresses(new)
    for surface, quantity, *_ in free & solved:
        raise BadVariables(f"{quantity}:{surface} is to vary and to follow: leave one out")
    solves = (*(solve for solve in of_file if not _addresses([solve]) & (free | solved)), *new)
    after = {
        solve.address: solve.address_of_source for solve in solves if solve.kind == "pickup" and solve.operand is None
    }
    for start in after:
        followed, passed = after[start], 0
        while followed in after and passed <= len(after):
            followed, passed = after[followed], passed + 1
        if passed > len(after):
            raise BadVariables(f"{start[1]}:{start[0]} follows itself, by way of other numbers")
    return DesignVariables(with_modelled(lens, (*variables.values(), *new)), tuple(variables.values()), solves)


def _addresses(several: Iterable[Vary | Solve]) -> set[tuple]:
    """The addresses of numbers: all numbers of a glass that is picked up; with its configuration, if it has one."""
    addresses: set[tuple] = set()
    for moved in several:
        address, is_solve = moved.address, isinstance(moved, Solve)
        if not (is_solve and moved.operand is not None):
            addresses.add(address)
        if moved.operand is not None:
            addresses.add((*address, moved.configuration))
        if is_solve and moved.quantity == "glass":
            addresses |= {(moved.surface, name) for name in GLASS}
    return addresses


def _spaces(lens: Lens, kind: str) -> str:
    """The variable syntax of all air spaces, or of the thicknesses of all elements, by a name such as "air_spaces"."""
    match = re.fullmatch("(air|glass)(_(space|gap|thickness|thicknesse)s?)?", kind)
    inside = lens.surfaces[1:-1]
    in_air = [surface.glass.name in ("", "MIRROR") for surface in inside]
    numbers = [k for k, air in enumerate(in_air, 1) if match and air == (match[1] == "air")]
    return f"thickness:{','.join(map(str, numbers))}" if numbers else ""


def varied(lens: Lens, word: str) -> tuple[Vary, ...]:
    """The variables that a word names, by surface and configuration. Raises BadVariables."""
    kind_of_surfaces, _, configurations = word.partition("@")
    kind, colon, numbers = kind_of_surfaces.partition(":")
    of_surfaces = (name for surface in lens.surfaces for name in parameter_paths(modelled(surface, kind)))
    known = dict.fromkeys(["thickness", *_ALONE, *MEDIA, *GROUPS, *of_surfaces])
    if (kind in _ALONE and colon) or (kind in _INSTEAD and kind not in known):
        meant = f"; did you mean {_INSTEAD[kind]}?" if kind in _INSTEAD else " without surfaces"
        raise BadVariables(f"{word!r}: expected {kind if kind in _ALONE else 'a number of a lens'}{meant}")
    if kind not in known:
        meant = f"; did you mean {spaces}?" if (spaces := _spaces(lens, kind)) else did_you_mean(kind, known)
        raise BadVariables(f"{word!r}: no {kind!r}; this lens has {', '.join(known)}{meant}")
    if (0, kind) in OF_LENS:
        holder, *_ = OF_LENS[0, kind].path
        of_lens = "system aperture" if holder == "aperture" else kind
        if configurations:
            raise BadVariables(f"{word!r}: all configurations have the same {of_lens}; leave @ out")
        if any(place.path[0] == holder for operand in lens.operands for place in operand.paths):
            raise BadVariables(f"{word!r}: the {of_lens} differs between the configurations, and is not varied")
        return (Vary(0, kind),)
    if kind == "sensor":
        kind, surfaces = "thickness", [sensor(lens)]
    elif numbers or colon:
        surfaces = counted(word, numbers)
    else:
        surfaces = [k for k in range(1, sensor(lens) + 1) if _makes_sense(lens, kind, k)]
    only = counted(word, configurations, "configuration") if configurations else []
    each = [(k, name) for k in surfaces for name in _quantities(lens, kind, k, word)]
    variables = [variable for k, name in each for variable in _each(lens, k, name)]
    variables = [variable for variable in variables if not only or variable.configuration in only]
    if variables:
        return tuple(dict.fromkeys(variables))
    if only:
        listed = f"configuration{'s' if len(only) > 1 else ''} {', '.join(map(str, only))}"
        raise BadVariables(f"{word!r}: no such number differs in {listed}; leave @ out")
    raise BadVariables(f"{word!r}: no surface has that yet; name surfaces, as {kind}:3")


def split_words(vary: str | Sequence[str]) -> list[str]:
    """The words of variable syntax; a solve or pickup may have spaces around its signs."""
    return re.sub(r"\s*([-=*+,(])\s*|\s*(\))", r"\1\2", joined(vary)).split()


def bounds_of(
    lens: Lens,
    variables: Sequence[Vary],
    bounds: str | Sequence[str] | Mapping[str, tuple[float, float]] | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest value (n,) of the variables, by words as "thickness:2..15 curvature_3:-0.1..0", or by name.

    A name means all variables of a kind, one of a surface (thickness_3, or thickness:3-5 of several), or one in a
    configuration (thickness_3@2); later names override earlier ones. Raises BadVariables for a name of no variable.
    """
    of_file = [variable.bounds or (-np.inf, np.inf) for variable in variables]
    low, high = (np.array([ends[k] for ends in of_file], dtype=float) for k in range(2))
    ends_by_name = bounds if isinstance(bounds, Mapping) else parse_bounds(joined(bounds or ""))
    names = []
    for variable in variables:
        groups = {name for name, quantities in GROUPS.items() if variable.quantity in quantities}
        kinds = {variable.quantity, *groups}
        last = {"sensor"} if variable.address == (sensor(lens), "thickness") else set()
        names.append({variable.name, *kinds, *(f"{kind}_{variable.surface}" for kind in kinds), *last})
    for name, ends in ends_by_name.items():
        kind, _, surfaces = name.partition(":")
        wanted = {f"{kind}_{k}" for k in counted(name, surfaces)} if surfaces else {name}
        chosen = [position for position, known in enumerate(names) if wanted & known]
        if not chosen:
            meant = did_you_mean(name, [known_name for known in names for known_name in known])
            raise BadVariables(f"{option('bounds')} for {name}, not among the variables{meant}")
        low[chosen], high[chosen] = ends
    return low, high


def with_modelled(lens: Lens, moved: Sequence[Vary | Solve]) -> Lens:
    """The lens with these numbers modelled, at 0 where they were not, and with model glasses where their numbers move.

    Warns VariedGlass of model glasses, which are only near the glass of a catalog between the lines of their
    definition. A lens whose temperature or pressure moves is in air of 20 °C and 1 atm if nothing else is given.
    """
    if {number.address for number in moved} & {TEMPERATURE, PRESSURE}:
        lens = with_environment(lens, None, None)
    surfaces = list(lens.surfaces)
    for number in moved:
        if number.address in OF_LENS:
            continue
        surface = surfaces[number.surface]
        if number.quantity in GLASS:
            surfaces[number.surface] = dataclasses.replace(
                surface, glass=_model_of(surface.glass, number.surface, lens)
            )
        elif number.quantity not in MEDIA:
            surfaces[number.surface] = modelled(surface, number.quantity)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))


def _model_of(glass: Glass, surface: int, lens: Lens) -> Glass:
    """The model glass of the same index, Abbe number and partial dispersion."""
    if glass.formula in ("model", "constant"):
        return glass
    model = model_glass(nd(glass).detach(), abbe_number(glass).detach(), normal_line_deviation(glass).detach())
    off = refractive_index(model, lens.wavelengths) - refractive_index(glass, lens.wavelengths)
    warnings.warn(
        f"surface {surface}: {glass.name} varies as a model glass, whose index is off by {float(off.abs().max()):.1g}",
        VariedGlass,
        stacklevel=calling_level(),
    )
    return model


def _makes_sense(lens: Lens, kind: str, k: int) -> bool:
    """Whether a kind without surfaces, as "curvature", includes surface k."""
    surface = lens.surfaces[k]
    if kind == "curvature":
        return has_power(lens, k)
    if kind == "thickness":
        return k == sensor(lens) or bool(surface.thickness != 0)
    if kind in MEDIA:
        return not (surface.is_mirror or surface.is_break or is_air(surface.glass))
    present = parameter_paths(surface)
    if kind == "conic":
        return surface.conic is not None
    return any(quantity in present for quantity in GROUPS.get(kind, (kind,)))


def has_power(lens: Lens, k: int) -> bool:
    """Whether a surface is a mirror, or has other media before and behind it."""
    surfaces, media = lens.surfaces, medium_surfaces(lens.surfaces)
    return surfaces[k].is_mirror or not same(surfaces[media[k - 1]].glass, surfaces[media[k]].glass)


def _quantities(lens: Lens, kind: str, k: int, word: str) -> list[str]:
    """The numbers of a surface that belong to a kind, as tilt_x and tilt_y to "tilt"."""
    if kind == "thickness" and k == 0 and bool(torch.isfinite(lens.surfaces[0].thickness)):
        return [kind]
    last = sensor(lens) if kind in ("thickness", *MEDIA) else sensor(lens) + 1  # nothing is behind the image
    if not 1 <= k <= last:
        raise BadVariables(f"{word!r}: surface {k}; this lens has surfaces 1 to {last} to vary")
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
        present = ", ".join(["thickness", *parameter_paths(surface)])
        raise BadVariables(f"{word!r}: surface {k} has no {missing[0]}; it has {present}")
    return list(wanted)


def _each(lens: Lens, k: int, quantity: str) -> list[Vary]:
    """The variable of a number of a surface; where it differs between configurations, a variable for each of them that
    does not follow another by expansion."""
    rules = () if lens.optimization_data is None else lens.optimization_data.solves
    expanding = {(rule.operand, rule.configuration) for rule in rules if rule.kind == "thermal"}
    for position, operand in enumerate(lens.operands):
        addresses = [address for address, _ in addresses_of(lens, operand)]
        if operand.numbers is not None and (k, quantity) in addresses:
            first = addresses[0] if operand.paths[0].path[0] == "surfaces" else (k, quantity)  # the others follow it
            numbers = range(1, len(operand.numbers) + 1)
            return [Vary(*first, number, position) for number in numbers if (position, number) not in expanding]
    return [Vary(k, quantity)]


# -- glasses that vary ------------------------------------------------------------------------------------------------


def without_glass(free: DesignVariables, vary: str | Sequence | None) -> tuple[DesignVariables, tuple[int, ...]]:
    """The design variables without "glass", and the surfaces whose glasses vary.

    Where a word means all glasses, those that the file marks vary, if it marks any. Other numbers of varied glasses do
    not vary. The variables of the file vary where the words name glasses alone. Raises BadVariables.
    """
    chosen = {variable.surface for variable in free.variables if variable.quantity == "glass"}
    if not chosen:
        return free, ()
    chosen = _marked(free.lens, vary, chosen) - set(followers(free.lens))
    paths = [place.path for operand in free.lens.operands for place in operand.paths]
    differing = [k for k in sorted(chosen) if any(path[:3] == ("surfaces", k, "glass") for path in paths)]
    if differing or not chosen:
        which = f"of surface {differing[0]} differs between the configurations" if differing else "follows another"
        raise BadVariables(f"{option('vary', 'glass')}: the glass {which}")
    of_file = () if free.lens.optimization_data is None else free.lens.optimization_data.variables
    others = _others(free.variables, chosen) or _others(of_file, chosen)
    if not others:
        raise BadVariables(
            f"{option('vary', 'glass')}: nothing but glasses varies; name what follows them, as 'curvature glass'"
        )
    return dataclasses.replace(free, variables=others), tuple(sorted(chosen))


def _others(variables: Sequence[Vary], chosen: set[int]) -> tuple[Vary, ...]:
    """The variables without "glass" and without numbers of the chosen glasses."""
    of_media = (*MEDIA, *GLASS)
    return tuple(
        variable
        for variable in variables
        if variable.quantity != "glass" and not (variable.quantity in of_media and variable.surface in chosen)
    )


def _marked(lens: Lens, vary: str | Sequence | None, surfaces: set[int]) -> set[int]:
    """The surfaces whose glasses the file marks as exchangeable, of those that vary; all, if words name surfaces."""
    words = vary if isinstance(vary, str) else " ".join(word for word in vary or () if isinstance(word, str))
    kept = () if lens.optimization_data is None else lens.optimization_data.kept
    marked = {solve.surface for solve in kept if (solve.quantity, solve.kind) == ("glass", "substitute")}
    all_meant = "glass" in words.split()
    return (marked & surfaces or surfaces) if all_meant else surfaces


def followers(lens: Lens) -> dict[int, int]:
    """Surfaces whose glass follows that of another surface, and that surface."""
    rules = () if lens.optimization_data is None else (*lens.optimization_data.solves, *lens.optimization_data.kept)
    return {
        rule.surface: rule.source
        for rule in rules
        if (rule.quantity, rule.kind) == ("glass", "pickup") and rule.operand is None
    }


# -- solves and pickups ------------------------------------------------------------------------------------------------


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
    """The numbers of a solve. Raises BadVariables for another count of them, or a solve of another quantity."""
    solved, least, most = SOLVED_BY[solve]
    try:
        numbers = tuple(float(part) for part in text.split(",") if part)
    except ValueError:
        raise BadVariables(f"{word!r}: {text!r} are no numbers; expected {solve}(number)") from None
    if quantity != solved or not least <= len(numbers) <= most:
        expected = f"{least}" if least == most else f"{least} or {most}"
        raise BadVariables(f"{word!r}: {solve} solves for a {solved}, by {expected} number(s)")
    return (*numbers, 0.0) if most == 2 and len(numbers) == 1 else numbers


# -- constraints -------------------------------------------------------------------------------------------------------

#: Relations of constraints by their spellings.
_RELATIONS = {"=": "=", "==": "=", "<=": "<=", "<": "<=", "≤": "<=", ">=": ">=", ">": ">=", "≥": ">="}


class BadHold(RaytraceError, ValueError):
    """Constraints that cannot be read, or of a quantity that the lens does not have."""


def constraint_words(hold: str | Sequence[str] | None) -> list[str]:
    """The words of constraint syntax, like "efl=50 total_track<=80"."""
    return re.sub(r"\s*([<>=≤≥,(])\s*|\s+([)%])", r"\1\2", joined(hold or "")).split()


def split_constraint(word: str) -> tuple[str, int, str, str]:
    """Name, configuration (0: the current one), relation (=, <= or >=) and number of "efl@2=100"; of "efl" alone the
    relation is = and the number "", that of the lens as it is. Raises BadHold."""
    parts = re.fullmatch(r"([^<>=≤≥@]+?)(?:@(\d+))?(?:(<=|>=|==|[<>=≤≥])(.+))?", word)
    if not parts:
        raise BadHold(f"{option('hold')}: {word!r}: expected a name, = or <= or >=, and a number, as efl=50")
    return parts[1], int(parts[2] or 0), _RELATIONS[parts[3] or "="], parts[4] or ""

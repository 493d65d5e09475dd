"""Which glasses vary, and what varies beside them."""

import dataclasses
from collections.abc import Sequence

from raytrace.media.glass import Glass
from raytrace.merit.model import GLASS
from raytrace.merit.vary import MEDIA, Freedom
from raytrace.optimization.problem import NoProblem
from raytrace.system.intent import Vary
from raytrace.system.lens import Lens


def without_glass(free: Freedom, vary: str | Sequence | None) -> tuple[Freedom, tuple[int, ...]]:
    """What varies but for glasses, and the surfaces whose glasses do.

    Those that the file marks, where words mean all; other numbers of those glasses vary no more. The file's variables
    follow where words name nothing but glasses. Raises NoProblem.
    """
    chosen = {one.surface for one in free.variables if one.quantity == "glass"}
    if not chosen:
        return free, ()
    chosen = _marked(free.lens, vary, chosen) - set(followers(free.lens))
    differing = [k for k in sorted(chosen) if _differs(free.lens, k)]
    if differing or not chosen:
        which = f"of surface {differing[0]} differs between the configurations" if differing else "follows another"
        raise NoProblem(f"`vary=glass`: the glass {which}")
    own = () if free.lens.intent is None else free.lens.intent.variables
    others = _others(free.variables, chosen) or _others(own, chosen)
    if not others:
        raise NoProblem("`vary=glass`: nothing but glasses varies; name what follows them, as 'curvature glass'")
    return dataclasses.replace(free, variables=others), tuple(sorted(chosen))


def _others(variables: Sequence[Vary], chosen: set[int]) -> tuple[Vary, ...]:
    """The variables but for glasses, and for numbers of glasses that are chosen."""
    of_media = (*MEDIA, *GLASS)
    return tuple(
        one for one in variables if one.quantity != "glass" and not (one.quantity in of_media and one.surface in chosen)
    )


def _marked(lens: Lens, vary: str | Sequence | None, surfaces: set[int]) -> set[int]:
    """Of the surfaces whose glasses vary those that the file marks as exchangeable, unless words name surfaces."""
    words = vary if isinstance(vary, str) else " ".join(one for one in vary or () if isinstance(one, str))
    kept = () if lens.intent is None else lens.intent.kept
    told = {one.surface for one in kept if (one.quantity, one.kind) == ("glass", "substitute")}
    all_meant = "glass" in words.split()
    return (told & surfaces or surfaces) if all_meant else surfaces


def followers(lens: Lens) -> dict[int, int]:
    """Surfaces whose glass is that of another, and which one's."""
    rules = () if lens.intent is None else (*lens.intent.solves, *lens.intent.kept)
    return {
        one.surface: one.source
        for one in rules
        if (one.quantity, one.kind) == ("glass", "pickup") and one.operand is None
    }


def _differs(lens: Lens, surface: int) -> bool:
    return any(place.path[:3] == ("surfaces", surface, "glass") for one in lens.operands for place in one.places)


def with_glasses(lens: Lens, glasses: dict[int, Glass]) -> Lens:
    """The lens with other glasses behind its surfaces, and behind those that follow them."""
    surfaces = list(lens.surfaces)
    follow = {k: glasses[source] for k, source in followers(lens).items() if source in glasses}
    for k, glass in (glasses | follow).items():
        surfaces[k] = dataclasses.replace(surfaces[k], glass=glass)
    return dataclasses.replace(lens, surfaces=tuple(surfaces))

"""Perturbation: a lens with errors of manufacture, an error for each row of its tolerances.

Errors of one surface and of nested elements combine. They are applied in this order: operands of configurations; radii,
thicknesses and other numbers, with the pickups and position solves that follow them; sag terms; motions.

    before′ = M_group ∘ M_element ∘ before ∘ M_surface            M: decentre, then tilts about x, y and z
    after′  = M_surface⁻¹ ∘ after ∘ E_element ∘ E_group           E = T⁻¹ M⁻¹ T,  T: the way through the element

A surface, an element or a group is moved rigidly about the vertex of its first surface, or a pivot behind it, and what
follows keeps its place: as with a coordinate break before it and one behind it. Motions are poses of surfaces, so that
surfaces keep their numbers and the compiled trace carries the lens. Their shifts along z are those of the thicknesses
before and behind: first-order data count them, and lens files hold them. Before an object at infinity there is no such
thickness: the axes from which rays start follow the vertex of surface 1.
"""

import dataclasses
import functools
import itertools
from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any, cast

import torch
from torch import Tensor

from raytrace.materials.glass import has_abbe_number, is_air
from raytrace.maths.numerics import in_transform
from raytrace.system import configurations
from raytrace.system.lens import Lens, per_lens
from raytrace.system.optimization_data import Solve
from raytrace.system.parameter_paths import ParameterPath, modelled, number_at, parameter_paths, with_number
from raytrace.system.poses import Pose, Rows, pose_of, rows_along, rows_back, rows_of_both, undone
from raytrace.system.sag_terms import with_powers
from raytrace.system.surface import Surface, with_z_in_thicknesses
from raytrace.system.tolerance_data import KINDS, MOST_TERM, Compensator, Gauge, Tolerance
from raytrace.tolerancing.table import BadTolerance, ToleranceTable, check_limits, rows_of
from raytrace.tracing.geometry import semi_diameters
from raytrace.tracing.launch import with_ray_aiming
from raytrace.tracing.trace import aiming_of
from raytrace.words import did_you_mean

_UNMEASURED = Gauge(None, 0.0)

#: Parameters of an Irregular surface by the names of a lens.
_IRREGULAR = {"x": 1, "y": 2, "tilt_x": 3, "tilt_y": 4, "spherical": 5}


def perturbed(lens: Lens, tolerances: ToleranceTable | Iterable[Tolerance], errors: Tensor | Sequence[float]) -> Lens:
    """The lens with an error for each tolerance.

    tolerances: a table, or rows; errors: (N,) in the rows' units, or (L, N) for L lenses at once, whose numbers that
    differ from lens to lens then are (L, 1, 1, 1) and broadcast against rays (lens, field, wavelength, pupil).
    Differentiable in the errors and in the lens. Numbers that no error touches stay the same tensors.
    A lens of several configurations is perturbed in all of them, and loses the others where an element moves whose
    thicknesses or poses differ between them: perturb each `lens.configuration(k)` then. Pickups and position solves
    follow; other solves keep the nominal number. Rays find the stop as in the lens: its ray aiming "auto" becomes what
    it resolves to.
    Raises BadTolerance for a tolerance that the lens does not have, and for errors that are not one for each row.
    """
    return Perturbation(lens, tolerances)(errors)


class Perturbation:
    """A lens with its tolerances, checked once and applied to any errors: `perturbed` for many batches of one lens."""

    def __init__(self, lens: Lens, tolerances: ToleranceTable | Iterable[Tolerance]):
        # The perturbed lens, whose axis bends, finds its stop as the nominal one does.
        self.lens, self.rows = with_ray_aiming(lens, aiming_of(lens)), rows_of(tolerances)
        fringes = tolerances if isinstance(tolerances, ToleranceTable) else ToleranceTable(self.rows)
        self.wavelength = 1e-3 * fringes.test_wavelength
        check_tolerances(lens, self.rows)
        needed = any(KINDS[row.kind].needs_semi_diameter for row in self.rows)
        self.radii = semi_diameters(lens) if needed else None

    def __call__(self, errors: Tensor | Sequence[float], lens: Lens | None = None) -> Lens:
        """The lens with errors (N,), or (L, N) for L lenses. Raises BadTolerance for another number of them.

        lens: with other numbers; the semi-diameters, to which fringes refer, stay.
        """
        rows = self.rows
        lens = self.lens if lens is None else with_ray_aiming(lens, self.lens.ray_aiming)
        like = lens.wavelengths
        errors = errors.to(like) if isinstance(errors, Tensor) else like.new_tensor(errors)
        if errors.dim() not in (1, 2) or errors.shape[-1] != len(rows):
            shape, count = tuple(errors.shape), len(rows)
            raise BadTolerance(f"errors of shape {shape}: expected ({count},), an error for each row, or (L, {count})")
        values = [per_lens(error) for error in errors.unbind(-1)]
        pairs = list(zip(rows, values, strict=True))
        gauges = _gauges(lens, pairs, self.wavelength, self.radii)
        start = with_operands(lens, [pair for pair in pairs if pair[0].kind == "operand"])
        surfaces = list(start.surfaces)
        for row, value in pairs:
            _change(lens, surfaces, row, value, gauges)
        _follow(start, surfaces)
        numbers = list(surfaces)
        spread = [
            (row, k, f * KINDS[row.kind].step(value, gauges.get(row.surfaces[0], _UNMEASURED)))
            for row, value in pairs
            for k, f in _carriers(lens, row)
        ]
        _add_sags(surfaces, [part for part in spread if KINDS[part[0].kind].sag], gauges)
        moved = _move(surfaces, pairs, [part for part in spread if KINDS[part[0].kind].motion])
        for k, surface in enumerate(surfaces):  # a shift along z is one of thicknesses
            numbers[k] = dataclasses.replace(numbers[k], thickness=surface.thickness)
        operands = _operands(start, tuple(numbers), moved)
        return dataclasses.replace(start, surfaces=tuple(surfaces), operands=operands)


# -- numbers ----------------------------------------------------------------------------------------------------------


def _gauges(
    lens: Lens, pairs: Sequence[tuple[Tolerance, Tensor]], wavelength: float, radii: Sequence[float] | None
) -> dict[int, Gauge]:
    """The references of the errors of each surface; radii: the semi-diameters, where they are needed."""
    angles: dict[int, Tensor] = {}
    for row, value in pairs:
        if row.kind == "irregularity_angle":
            k = row.surfaces[0]
            angles[k] = angles[k] + value if k in angles else value
    used = {row.surfaces[0] for row, _ in pairs if KINDS[row.kind].sag or KINDS[row.kind].needs_semi_diameter}
    gauges = {}
    for k in used:
        radius = radii[k] if radii else lens.surfaces[k].semi_diameter or 0.0
        gauges[k] = Gauge(radius if radius > 0 else None, wavelength, angles.get(k))
    for row, _ in pairs:
        if KINDS[row.kind].needs_semi_diameter and gauges[row.surfaces[0]].semi_diameter is None:
            message = "the surface has no semi-diameter, and no ray reaches it; give the surface one"
            raise BadTolerance(f"{_named(row)}: {message}")
    return gauges


def _change(lens: Lens, surfaces: list[Surface], row: Tolerance, value: Tensor, gauges: dict[int, Gauge]) -> None:
    """Change the number of a row, and with a thickness the adjusting thickness."""
    change = KINDS[row.kind].change
    if change is None:
        return
    k = row.surfaces[0]
    gauge = gauges.get(k, _UNMEASURED)
    if row.kind == "parameter":
        gauge = gauge._replace(path=path_of(lens.surfaces[k], row.parameter))
        surfaces[k] = modelled(surfaces[k], row.parameter)
    surfaces[k] = change(surfaces[k], value, row, gauge)
    if row.kind == "thickness" and row.adjust not in (None, k):
        surfaces[row.adjust] = change(surfaces[row.adjust], -value, row, gauge)


def raised(surface: Surface, quantity: str, change: Tensor) -> Surface:
    """The surface with a quantity larger by a change."""
    path = path_of(surface, quantity)
    assert path is not None  # the lens is checked
    return with_number(surface, path, number_at(surface, path) + change)


def path_of(nominal: Surface, quantity: str) -> ParameterPath | None:
    """The path of a quantity of a surface, None if the surface does not have it."""
    if quantity == "thickness":
        return ParameterPath((quantity,))
    return parameter_paths(modelled(nominal, quantity)).get(quantity)


def _follow(lens: Lens, surfaces: list[Surface]) -> None:
    """The numbers that follow others by pickups and position solves; those whose sources are the same stay."""
    solves = _solves(lens)
    known: dict[tuple[int, str], Tensor | None] = {}

    def step(place: tuple[int, str]) -> Tensor | None:
        """The change of a number, None if it has not changed."""
        if place not in known:
            known[place] = None  # a number that follows itself stays
            known[place] = _solved(solves[place]) if place in solves else _difference(lens, surfaces, *place)
        return known[place]

    def _solved(solve: Solve) -> Tensor | None:
        if solve.kind == "pickup":
            change = step(solve.address_of_source)
            return None if change is None else solve.scale * change
        k, source = solve.surface, solve.source
        others = range(source, k) if source <= k else range(k + 1, source)
        changes = [change for j in others if (change := step((j, "thickness"))) is not None]
        return -functools.reduce(torch.add, changes) if changes else None

    changes = {place: step(place) for place in solves if solves[place].quantity != "glass"}
    for (k, quantity), change in changes.items():
        if change is not None:
            surfaces[k] = raised(modelled(surfaces[k], quantity), quantity, change)
    for (k, quantity), solve in solves.items():
        source = solve.source
        while (source, quantity) in solves and source != k:
            source = solves[source, quantity].source
        if quantity == "glass" and surfaces[source].glass is not lens.surfaces[source].glass:
            surfaces[k] = dataclasses.replace(surfaces[k], glass=surfaces[source].glass)


def _solves(lens: Lens) -> dict[tuple[int, str], Solve]:
    """The pickups and position solves of the lens, by surface and quantity."""
    data = lens.optimization_data
    solves = () if data is None else data.solves
    return {s.address: s for s in solves if s.kind in ("pickup", "position") and s.operand is None}


def _difference(lens: Lens, surfaces: Sequence[Surface], k: int, quantity: str) -> Tensor | None:
    """The difference of a number from that of the lens; None where it is the same tensor, or not modelled."""
    path = path_of(lens.surfaces[k], quantity)
    if lens.surfaces[k] is surfaces[k] or path is None:
        return None
    old, new = _part(lens.surfaces[k], path), _part(surfaces[k], path)
    if new is None or new is old:
        return None
    return (new if old is None else new - old)[() if path.entry is None else path.entry]


def _part(surface: Surface, path: ParameterPath) -> Tensor | None:
    """The tensor at a path, of all its entries; None where it is not modelled."""
    part: Any = surface
    for name in path.path:
        part = getattr(part, name, None)
    return part


def _carriers(lens: Lens, row: Tolerance) -> list[tuple[int, float]]:
    """The surfaces that have the error of a surface, and its factor: with those that pick it up as irregular ones."""
    kind = KINDS[row.kind]
    if kind.elements or not (kind.sag or kind.motion):
        return []
    source, carriers = row.surfaces[0], [(row.surfaces[0], 1.0)]
    data = lens.optimization_data
    for solve in () if data is None or not kind.parameter else data.kept:
        picked = solve.kind == "PPAR" and solve.quantity == f"PARM {kind.parameter}" and len(solve.numbers) > 1
        if picked and int(solve.numbers[0]) == source:
            carriers.append((solve.surface, solve.numbers[1]))
    for solve in () if data is None or not kind.parameter else data.solves:
        picked = solve.kind == "pickup" and _IRREGULAR.get(solve.quantity) == kind.parameter
        if picked and solve.source == source and not lens.surfaces[solve.surface].is_break:
            carriers.append((solve.surface, solve.scale))
    return carriers


# -- sag terms --------------------------------------------------------------------------------------------------------


def _add_sags(surfaces: list[Surface], parts: Sequence[tuple[Tolerance, int, Tensor]], gauges: dict) -> None:
    """Add the powers of all errors of a surface to its sag."""
    sums: dict[tuple[int, float], list[Tensor]] = {}
    for row, k, value in parts:
        gauge, sag = gauges[row.surfaces[0]], KINDS[row.kind].sag
        assert sag is not None
        terms = sag(value, row, gauge)
        old = sums.get((k, gauge.radius), [])
        pairs = itertools.zip_longest(old, terms)
        sums[k, gauge.radius] = [b if a is None else a if b is None else a + b for a, b in pairs]
    for (k, radius), terms in sums.items():
        coefficients = torch.stack(torch.broadcast_tensors(*terms))
        added = with_powers(surfaces[k].sag_terms, coefficients, coefficients.new_tensor(radius))
        surfaces[k] = dataclasses.replace(surfaces[k], sag_terms=added)


# -- motions ----------------------------------------------------------------------------------------------------------


def _move(
    surfaces: list[Surface],
    pairs: Sequence[tuple[Tolerance, Tensor]],
    parts: Sequence[tuple[Tolerance, int, Tensor]],
) -> list[tuple[int, int]]:
    """Move surfaces and elements rigidly; returns the first and last surface of each that moves."""
    of_surfaces: dict[int, dict[str, Any]] = {}
    for row, k, value in parts:
        _add_to(of_surfaces.setdefault(k, {}), KINDS[row.kind].motion, value)
    of_elements: dict[tuple[int, int, float], dict[str, Any]] = {}
    for row, value in pairs:
        kind = KINDS[row.kind]
        if kind.elements:
            _add_to(of_elements.setdefault((*_range(row), row.pivot), {}), kind.motion, value)
    # From the outermost to the innermost: a longer range holds a shorter one.
    ranges = sorted(of_elements, key=lambda place: place[0] - place[1])
    still = tuple(surfaces)
    before: dict[int, list[Pose]] = defaultdict(list)
    behind: dict[int, list[Rows]] = defaultdict(list)
    for first, last, pivot in ranges:
        motion, z = Pose(**of_elements[first, last, pivot]), still[first].thickness.new_tensor(pivot)
        motions = [Pose(z=z), motion, Pose(z=-z)] if pivot else [motion]
        back, way = rows_back(rows_along(motions)), rows_along(_way(still[first : last + 1]))
        before[first] += motions
        behind[last].insert(0, rows_of_both(rows_of_both(rows_back(way), back), way))
    for k in {*before, *behind, *of_surfaces}:
        surface, of_surface = still[k], [Pose(**of_surfaces[k])] if k in of_surfaces else []
        front = [pose for pose in (*before[k], surface.before, *of_surface) if isinstance(pose, Pose)]
        rear = [pose for pose in (*map(undone, of_surface), surface.after) if isinstance(pose, Pose)]
        rows = rows_along(rear)
        for element in behind[k]:
            rows = rows_of_both(rows, element)
        surfaces[k] = dataclasses.replace(
            surfaces[k],
            before=_single(front) or (_pose(rows_along(front), k) if front else None),
            after=_single(rear) if not behind[k] and len(rear) < 2 else undone(_pose(rows_back(rows), k)),
        )
    surfaces[:] = with_z_in_thicknesses(surfaces, {*before, *behind, *of_surfaces})
    return [(first, last) for first, last, _ in ranges] + [(k, k) for k in of_surfaces]


def _add_to(motion: dict[str, Any], field: str, value: Tensor) -> None:
    motion[field] = motion[field] + value if field in motion else value


def _range(row: Tolerance) -> tuple[int, int]:
    return row.surfaces[0], row.surfaces[-1]


def _way(surfaces: Sequence[Surface]) -> list[Any]:
    """The poses and thicknesses from the axes in front of the first surface to those behind the last."""
    steps: list[Any] = []
    for surface in surfaces:
        steps += [surface.before, surface.after, surface.thickness]
    return steps[:-1]


def _single(poses: Sequence[Pose]) -> Pose | None:
    """The pose of a single one, whose angles then are not rounded; None of several."""
    return poses[0] if len(poses) == 1 else None


def _pose(rows: Rows, k: int) -> Pose:
    """The pose of a passage. Raises BadTolerance where its tilt about y is a right angle."""
    sine, hidden = rows[2][0], in_transform()
    if isinstance(sine, Tensor) and not hidden and bool((sine.detach().abs() > 1 - 1e-12).any()):
        message = "its axes turn by 90° about y, where a further tilt has no angles about x and z"
        raise BadTolerance(f"surface {k}: {message}; put the turn on a coordinate break of its own")
    return pose_of(rows)


# -- configurations ---------------------------------------------------------------------------------------------------


def with_operands(lens: Lens, pairs: Sequence[tuple[Tolerance | Compensator, Tensor]]) -> Lens:
    """The lens with errors, or with changes of compensators, of operands of configurations."""
    for row, value in pairs:
        assert row.operand is not None
        operand = lens.operands[row.operand]
        if value.dim() and any(isinstance(scaled.path[-1], tuple) for scaled in operand.paths):
            raise BadTolerance(f"{row}: a coefficient that differs between configurations; expected one lens")
        lens = dataclasses.replace(
            lens, operands=tuple(_raised(old, row, value) if old is operand else old for old in lens.operands)
        )
        if row.configuration == lens.current_configuration:
            for path, factor, _ in operand.paths:
                lens = configurations.with_part(lens, path, configurations.part(lens, path) + factor * value)
    return lens


def _raised(operand: configurations.Operand, row: Tolerance | Compensator, value: Tensor) -> configurations.Operand:
    k = row.configuration - 1
    assert operand.numbers is not None  # the lens is checked
    numbers = configurations.with_entry(operand.numbers, (k,), operand.numbers[k] + value)
    return dataclasses.replace(operand, numbers=numbers)


def _operands(lens: Lens, numbers: tuple[Surface, ...], moved: Sequence[tuple[int, int]]) -> tuple:
    """The operands of configurations with the errors of the numbers that they hold; none where a motion needs them.

    numbers: the surfaces with errors of their numbers; moved: first and last surfaces of what moves.
    """

    def differs(path: configurations.Path) -> bool:
        if path[0] != "surfaces":
            return False
        k, posed = cast(int, path[1]), path[2] in ("before", "after")
        return any(a <= k <= b if posed else path[2] == "thickness" and a <= k < b for a, b in moved)

    if any(differs(scaled.path) for operand in lens.operands for scaled in operand.paths):
        return ()
    changed, operands = dataclasses.replace(lens, surfaces=numbers), []
    for operand in lens.operands:
        if operand.paths and operand.numbers is not None and not isinstance(operand.paths[0].path[-1], tuple):
            old, new = (configurations.part(view, operand.paths[0].path) for view in (lens, changed))
            if isinstance(new, Tensor) and isinstance(old, Tensor) and new is not old:
                step = (new - old) / operand.paths[0].factor
                operand = dataclasses.replace(operand, numbers=configurations.spread_for(operand.numbers, step) + step)
        operands.append(operand)
    return tuple(operands)


# -- checks ----------------------------------------------------------------------------------------


def _named(row: Tolerance) -> str:
    return f"{row.name} of {row.where}" + (f" ({row.source})" if row.source else "")


def check_tolerances(lens: Lens, rows: Iterable[Tolerance]) -> None:
    """Refuse tolerances that a lens does not have. Raises BadTolerance naming what was found and expected."""
    last = len(lens.surfaces) - 1
    ranges: dict[tuple[int, int], Tolerance] = {}
    solves = _solves(lens)
    for row in rows:
        if row.kind not in KINDS:
            meant = did_you_mean(row.kind, KINDS)
            raise BadTolerance(f"kind {row.kind!r}{meant}: expected one of {', '.join(KINDS)}")
        check_limits(row)
        kind = KINDS[row.kind]
        if row.kind == "operand":
            _check_operand(lens, row)
            continue
        if len(row.surfaces) not in ((1, 2) if kind.elements else (1,)):
            wanted = "its first and last surface, as (1, 2)" if kind.elements else "one surface, as (3,)"
            raise BadTolerance(f"{row.kind} of surfaces {row.surfaces}: expected {wanted}")
        least = 0 if row.kind == "thickness" else 1
        most = last if kind.motion or kind.sag else last - 1
        if not all(least <= k <= most for k in row.surfaces):
            raise BadTolerance(f"{_named(row)}: this lens has surfaces {least} to {most} with such an error")
        if kind.elements:
            first, end = _range(row)
            if first > end:
                raise BadTolerance(f"{_named(row)}: the first surface lies behind the last; expected ({end}, {first})")
            _check_nested(row, ranges)
            ranges.setdefault((first, end), row)
        else:
            _check_surface(lens, row, solves)


def _check_operand(lens: Lens, row: Tolerance) -> None:
    count = configurations.count(lens.operands)
    if row.operand is None or not 0 <= row.operand < len(lens.operands):
        raise BadTolerance(f"{_named(row)}: this lens has {len(lens.operands)} operands of configurations")
    if not 1 <= row.configuration <= count:
        raise BadTolerance(f"{_named(row)}: this lens has configurations 1 to {count}")
    if lens.operands[row.operand].numbers is None:
        raise BadTolerance(f"{_named(row)}: {lens.operands[row.operand]} is no number; expected one that has a value")


def _check_nested(row: Tolerance, ranges: dict[tuple[int, int], Tolerance]) -> None:
    """Refuse an element that holds a part of another."""
    first, end = _range(row)
    for (a, b), other in ranges.items():
        if not (a < first <= b < end or first < a <= end < b):
            continue
        if first == b or a == end:
            shared, group = (b if first == b else a), (min(a, first), max(b, end))
            message = f"its element shares the cemented surface {shared} with {a}-{b} ({other.kind}), and would move it"
            element = (shared + 1, end) if first == b else (shared + 1, b)
            fix = f"tolerance the cemented group {group}, or the surfaces {element} of the element behind it alone"
            raise BadTolerance(f"{_named(row)}: {message} twice; {fix}")
        message = f"it shares a part of surfaces {a}-{b} ({other.kind}); expected one inside the other, or apart"
        raise BadTolerance(f"{_named(row)}: {message}")


def _check_surface(lens: Lens, row: Tolerance, solves: dict[tuple[int, str], Solve]) -> None:
    k = row.surfaces[0]
    surface, message = lens.surfaces[k], ""
    if row.adjust is not None and not 0 <= row.adjust < len(lens.surfaces) - 1:
        message = f"the adjusting surface {row.adjust}; this lens has surfaces 0 to {len(lens.surfaces) - 2}"
    elif row.kind == "parameter":
        if row.parameter not in parameter_paths(modelled(surface, row.parameter)):
            known = ", ".join(parameter_paths(surface))
            message = f"the surface has no {row.parameter!r}; it has {known}"
    elif surface.is_break and row.kind != "thickness":
        message = 'the surface is a coordinate break; expected "parameter" with its tilt_x, x, …, or an optical surface'
    elif row.kind in MOST_TERM and not 2 <= row.term <= MOST_TERM[row.kind]:
        message = f"term {row.term}; expected a number from 2 to {MOST_TERM[row.kind]}"
    quantity = {"radius": "curvature", "power": "curvature", "index": "glass", "abbe": "glass"}.get(row.kind, row.kind)
    quantity = row.parameter if row.kind == "parameter" else quantity
    if (k, quantity) in solves and not message:
        source = solves[k, quantity].source
        message = f"its {quantity} follows that of surface {source}; put the tolerance there"
    if not message and not in_transform():
        message = _objection(lens, row, surface)
    if message:
        raise BadTolerance(f"{_named(row)}: {message}")


def _objection(lens: Lens, row: Tolerance, surface: Surface) -> str:
    """The reason why the values of a lens do not allow a tolerance, "" where they do."""
    if row.kind == "radius" and (surface.curvature is None or not bool((surface.curvature != 0).any())):
        return "the surface is a plane, whose radius has no error; expected power (fringes) or curvature"
    if row.kind in ("index", "abbe") and (surface.is_mirror or is_air(surface.glass)):
        return f"the surface is {'a mirror' if surface.is_mirror else 'followed by air'}; expected one before glass"
    if row.kind == "abbe" and not has_abbe_number(surface.glass):
        return "the medium has no dispersion at the lines d, F and C; expected a glass"
    if row.kind == "thickness" and not bool(torch.isfinite(surface.thickness).all()):
        return "the thickness is infinite"
    return ""

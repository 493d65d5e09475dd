"""New numbers of surfaces and gaps, in everything that refers to them: rules, rows, configurations, tolerances.

A gap is the space behind a surface, and has the number of that surface: its thickness, its medium, its environment. All
other numbers are of the surface. An edit gives every surface and every gap its new number, or None where it is gone;
surfaces that are turned around have other signs. What refers to a surface or a gap that is gone is left out, and named.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import torch

from raytrace.io.zemax.surfaces import ROWS
from raytrace.io.zemax.tolerances import ToleranceLine, rewritten
from raytrace.system.configurations import Operand, Path, ScaledPath, count, differences, part, with_part
from raytrace.system.dimensions import ARGUMENTS
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Row, Solve, Vary
from raytrace.system.parameter_paths import (
    GLASS,
    GLASS_NUMBER,
    OF_LENS,
    UnknownNumber,
    modelled,
    names_at,
    path_of,
)
from raytrace.system.surface import Surface

#: Fields of a surface that belong to the gap behind it, and names of their numbers.
GAP = ("thickness", "glass", "environment")
_OF_GAP = (*GAP, *GLASS)

#: Solves by rays, which do not hold at a surface that is turned around.
_BY_RAYS = (
    *("marginal_angle", "f_number", "marginal_height", "marginal_normal"),
    *("chief_angle", "chief_normal", "aplanatic"),
)
#: Kinds of solves whose first number is a surface.
_NUMBERED = "PZUP", "PPAR", "concentric_with_surface"
#: Rows of curvatures on a surface that is turned around: their name there, with the target negated.
_OPPOSITE = {"CVGT": "CVLT", "CVLT": "CVGT", "CVVA": "CVVA", "MNCV": "MXCV", "MXCV": "MNCV"}
#: Operands of the configurations without a path in the lens that have the number of a surface.
_OF_SURFACE = (
    "IGNR IGNM FLTP SATP CAOR CBOR CROR CRSR CSP1 CSP2 PSP1 PSP2 PSP3 TSP1 TSP2 TSP3 NCOM NCOT NGLS NPAR NPOS NPRO"
)

Rule = TypeVar("Rule", Vary, Solve)


@dataclass(frozen=True)
class Numbering:
    """The new numbers of the surfaces of a lens.

    lens: before the edit; surfaces, gaps: (S,) the new number of each, None where it is gone; turned: the surfaces that
    are turned around, with `turn`. joined: the new number of a gap that is part of another, for rows and tolerances;
    thicker: mm by which a gap has grown, by its old number. lost: the names of all that is left out, which
    `with_surfaces` fills.
    """

    lens: Lens
    surfaces: tuple[int | None, ...]
    gaps: tuple[int | None, ...]
    turned: range = range(0)
    turn: Callable[[Surface], Surface] = lambda surface: surface
    joined: dict[int, int] = field(default_factory=dict)
    thicker: dict[int, float] = field(default_factory=dict)
    lost: list[str] = field(default_factory=list)

    def with_surfaces(
        self, surfaces: Sequence[Surface], *, stop: int | None = None, operands: Sequence[Operand | None] | None = None
    ) -> Lens:
        """The lens of the new surfaces, in which all that refers to the old ones has their new numbers.

        stop: its new number, where its surface is gone. operands: of the lens before the edit, with other numbers, and
        None for one whose numbers another has.
        """
        stop = self.surfaces[self.lens.stop] if stop is None else stop
        assert stop is not None, "an edit keeps the stop"
        lens = replace(self.lens, surfaces=tuple(surfaces), stop=stop)
        old = self.lens.operands if operands is None else operands
        moved = [None if operand is None else self.operand(operand) for operand in old]
        kept = tuple(operand for operand in moved if operand is not None)
        if old and not kept:
            kept = (Operand("MOFF", words=(("",),) * count(self.lens.operands)),)  # keeps their count
        places = iter(range(len(kept)))
        numbers = [None if operand is None else next(places) for operand in moved]
        lens = replace(lens, operands=kept)
        data = self.lens.optimization_data
        return lens if data is None else replace(lens, optimization_data=self.data(data, numbers))

    # -- numbers of surfaces ------------------------------------------------------------------------------------------

    def moved(self, surface: int, quantity: str) -> tuple[int, str, float] | None:
        """The new surface and name of a number of a surface, and its sign there; None where it is gone."""
        if (surface, quantity) in OF_LENS or not 0 <= surface < len(self.surfaces):
            return surface, quantity, 1.0
        of_gap = quantity in _OF_GAP or quantity.startswith(GLASS_NUMBER)
        number = (self.gaps if of_gap else self.surfaces)[surface]
        if number is None or of_gap or surface not in self.turned:
            return None if number is None else (number, quantity, 1.0)
        old = modelled(self.lens.surfaces[surface], quantity)
        try:
            path, sign = self._turned_path(old, path_of(old, quantity).steps)
        except UnknownNumber:
            return number, quantity, 1.0
        return number, next(iter(names_at(self.turn(old), path)), quantity), sign

    def _turned_path(self, surface: Surface, path: Path) -> tuple[Path, float]:
        """The path in the turned surface of a number of a surface, and its sign there."""
        number = part(surface, path)
        if isinstance(number, torch.Tensor):
            before, after = ((self.turn(with_part(surface, path, number.detach() * 0 + k))) for k in (1.0, 2.0))
        elif isinstance(number, float):
            before, after = ((self.turn(with_part(surface, path, k))) for k in (1.0, 2.0))
        else:
            return path, 1.0
        new = next(differences(before, after), path)
        changed, start = part(after, new), part(before, new)
        return new, 1.0 if changed is None else float(changed) - float(start)

    def path(self, path: Path) -> tuple[Path, float] | None:
        """A path in the lens by its new numbers, and the sign of the number there; None where it is gone."""
        if path[:1] != ("surfaces",) or len(path) < 3 or not isinstance(old := path[1], int):
            return path, 1.0
        of_gap = path[2] in GAP
        number = (self.gaps if of_gap else self.surfaces)[old]
        if number is None:
            return None
        inner, sign = path[2:], 1.0
        if not of_gap and old in self.turned:
            inner, sign = self._turned_path(self.lens.surfaces[old], inner)
        return ("surfaces", number, *inner), sign

    def ends(self, first: int, last: int, *, of_gaps: bool = False) -> tuple[int, int] | None:
        """The ends of a range of surfaces, or gaps, of a row by their new numbers; None where all are gone."""
        numbers = {**dict(enumerate(self.gaps)), **self.joined} if of_gaps else dict(enumerate(self.surfaces))
        new = (numbers[k] for k in range(min(first, last), max(first, last) + 1))
        kept = [number for number in new if number is not None]
        return (min(kept), max(kept)) if kept else None

    # -- configurations -----------------------------------------------------------------------------------------------

    def operand(self, operand: Operand) -> Operand | None:
        """An operand of the configurations; None where its surface is gone."""
        moved = [(scaled, self.path(scaled.path)) for scaled in operand.paths]
        places = [(scaled, place) for scaled, place in moved if place is not None]
        number: int | None = operand.number
        of_surface = operand.name in _OF_SURFACE or (operand.name in ROWS and ROWS[operand.name].argument == "surface")
        if of_surface and 0 <= operand.number < len(self.surfaces):
            of_gap = bool(operand.paths) and operand.paths[0].path[2:3] in [(name,) for name in GAP]
            number = (self.gaps if of_gap else self.surfaces)[operand.number]
        if number is None or (operand.paths and not places):
            self.lost.append(f"configuration operand {operand}")
            return None
        changes: dict[str, Any] = {"number": number}
        if places:
            sign = places[0][1][1]
            changes["paths"] = tuple(
                ScaledPath(path, scaled.factor * of_path * sign, scaled.offset * of_path)
                for scaled, (path, of_path) in places
            )
        if places and operand.numbers is not None and sign < 0:
            changes["numbers"] = 0.0 - operand.numbers
        if operand.words and operand.paths:
            kept = [k for k, (_, place) in enumerate(moved) if place is not None]
            changes["words"] = tuple(tuple(self._word(operand, k, words[k]) for k in kept) for words in operand.words)
        return replace(operand, **changes)

    def _word(self, operand: Operand, k: int, word: Any) -> Any:
        """The contents of a path of an operand: the number of the stop, or a part of a surface that is turned."""
        path = operand.paths[k].path
        if path == ("stop",):
            stop = self.surfaces[word]
            return self.lens.stop if stop is None else stop
        if path[:1] != ("surfaces",) or path[1] not in self.turned or path[2] in GAP or isinstance(word, str | bool):
            return word
        place = self.path(path)
        old = with_part(self.lens, path, word)
        return word if place is None else part(self.turn(old.surfaces[path[1]]), place[0][2:])

    # -- optimisation data --------------------------------------------------------------------------------------------

    def data(self, data: OptimizationData, operands: Sequence[int | None]) -> OptimizationData:
        """Optimisation data of the new lens; operands: the new position of each operand of the configurations."""
        sizes = [self.surfaces[surface] for surface in data.semi_diameters if surface < len(self.surfaces)]
        variables, solves = self.variables(data.variables, operands), self.solves(data.solves, operands)
        if self.turned:
            variables, solves = _backwards(variables, solves)
        return replace(
            data,
            variables=variables,
            solves=solves,
            kept=self.solves(data.kept, operands),
            merit=self.rows(data.merit, operands),
            tolerances=self.lines(data.tolerances, operands),
            semi_diameters=tuple(sorted(number for number in sizes if number is not None)),
        )

    def variables(self, variables: Sequence[Vary], operands: Sequence[int | None] = ()) -> tuple[Vary, ...]:
        """The variables that are left, in their order."""
        moved = [self.variable(variable, operands) for variable in variables]
        return tuple(variable for variable in moved if variable is not None)

    def variable(self, variable: Vary, operands: Sequence[int | None] = ()) -> Vary | None:
        """A variable by its new numbers; None where its number is gone."""
        if variable.operand is not None:
            return self._of_operand(variable, operands)
        place = self.moved(variable.surface, variable.quantity)
        if place is None:
            self.lost.append(f"variable {variable}")
            return None
        surface, quantity, sign = place
        bounds = tuple(sorted(sign * end for end in variable.bounds))
        return replace(variable, surface=surface, quantity=quantity, bounds=bounds)

    def solves(self, solves: Sequence[Solve], operands: Sequence[int | None] = ()) -> tuple[Solve, ...]:
        """The solves and pickups that are left, in their order."""
        moved = [self.solve(solve, operands) for solve in solves]
        return tuple(solve for solve in moved if solve is not None)

    def solve(self, solve: Solve, operands: Sequence[int | None] = ()) -> Solve | None:
        """A solve or pickup by its new numbers; None, with its name in `lost`, where it is gone."""
        if solve.operand is not None:
            return self._of_operand(solve, operands)
        place = self.moved(solve.surface, solve.quantity)
        changes: dict[str, Any] | None = {}
        if place is not None and solve.kind == "pickup":
            changes = self._picked_up(solve, place[2])
        elif place is not None and solve.kind == "position":
            source = self.surfaces[solve.source]
            is_one = (solve.source in self.turned) == (solve.surface in self.turned)
            changes = {"source": source} if source is not None and is_one else None
        elif place is not None and solve.kind in _NUMBERED and solve.numbers:
            old = int(solve.numbers[0])
            source = self.surfaces[old] if 0 <= old < len(self.surfaces) else old
            changes = None if source is None else {"numbers": (float(source), *solve.numbers[1:])}
        elif solve.kind in _BY_RAYS and solve.surface in self.turned and place != (solve.surface, solve.quantity, 1.0):
            changes = None
        if place is None or changes is None:
            self.lost.append(f"{'pickup' if solve.kind == 'pickup' else 'solve'} {solve}")
            return None
        return replace(solve, surface=place[0], quantity=place[1], **changes)

    def _picked_up(self, solve: Solve, sign: float) -> dict[str, Any] | None:
        """The new source of a pickup; None where it is gone."""
        source = self.moved(*solve.address_of_source)
        if source is None:
            return None
        surface, quantity, of_source = source
        new = self.moved(solve.surface, solve.quantity)
        added, of_gap = solve.offset, self.thicker.get
        if solve.quantity == "thickness":
            added += of_gap(solve.surface, 0.0)
        if solve.address_of_source[1] == "thickness":
            added -= solve.scale * of_gap(solve.source, 0.0)
        of_other = {"quantity_of_source": "" if new is not None and quantity == new[1] else quantity}
        return {"source": surface, "scale": sign * solve.scale * of_source, "offset": sign * added} | of_other

    def _of_operand(self, rule: Rule, operands: Sequence[int | None]) -> Rule | None:
        """A rule of a number of the configurations."""
        old = rule.operand
        new = operands[old] if old is not None and old < len(operands) else old
        followed = int(rule.numbers[0]) if isinstance(rule, Solve) and rule.numbers else None
        source = followed if followed is None or followed >= len(operands) else operands[followed]
        if new is None or (followed is not None and source is None):
            self.lost.append(f"{'variable' if isinstance(rule, Vary) else 'pickup'} {rule}")
            return None
        place = self.moved(rule.surface, rule.quantity) or (rule.surface, rule.quantity, 1.0)
        changes: dict[str, Any] = {"surface": place[0], "quantity": place[1], "operand": new}
        if isinstance(rule, Solve):
            changes |= {"offset": place[2] * rule.offset}
            changes |= {} if source is None else {"numbers": (float(source), *rule.numbers[1:])}
        else:
            changes |= {"bounds": tuple(sorted(place[2] * end for end in rule.bounds))}
        return replace(rule, **changes)

    def rows(self, rows: Sequence[Row], operands: Sequence[int | None] = ()) -> tuple[Row, ...]:
        """The rows of a merit function: those of surfaces that are gone, and rows that take their values, are left out.

        Rows that take the values of other rows have their new numbers.
        """
        moved = [self.row(row, operands) for row in rows]
        while True:  # rows of rows that are gone
            gone = {k for k, row in enumerate(moved, 1) if row is None}
            more = [k for k, row in enumerate(moved) if row is not None and _takes(row) & gone]
            if not more:
                break
            for k in more:
                moved[k] = None
        self.lost.extend(
            f"row {k} {row.name} {row.integers[0]} {row.integers[1]}" for k, row in enumerate(rows, 1) if k in gone
        )
        places = {k: k - sum(other < k for other in gone) for k in range(len(rows) + 1) if k not in gone}
        return tuple(_with_rows(row, places) for row in moved if row is not None)

    def row(self, row: Row, operands: Sequence[int | None] = ()) -> Row | None:
        """A row by the new numbers of its surfaces; None where these are gone."""
        first, second = ARGUMENTS.get(row.operand, ("", "")) if isinstance(row.operand, str) else ("", "")
        a, b = row.integers
        if first == "operand":
            number = operands[a - 1] if 1 <= a <= len(operands) else a - 1
            return None if number is None else replace(row, integers=(number + 1, b))
        if first not in ("surface", "gap", "contribution") or (first == "contribution" and a == 0):
            return row
        of_gaps, is_range = first == "gap", bool(second)
        if not all(0 <= number < len(self.surfaces) for number in (a, b if is_range else a)):
            return row
        new = self.ends(a, b if is_range else a, of_gaps=of_gaps)
        if new is None:
            return None
        row = replace(row, integers=new if is_range else (new[0], b))
        if row.operand not in _OPPOSITE or not self.turned:
            return row
        inside = [number in self.turned for number in range(a, (b if is_range else a) + 1)]
        if any(inside) and not all(inside):
            return None
        return replace(row, operand=_OPPOSITE[str(row.operand)], target=0.0 - row.target) if all(inside) else row

    def lines(self, lines: Sequence[str], operands: Sequence[int | None] = ()) -> tuple[str, ...]:
        """The lines of tolerances by their new numbers; those of surfaces that are gone are left out."""
        pivot = 0
        of_gaps: set[tuple] = set()

        def moved(line: ToleranceLine) -> list[ToleranceLine]:
            nonlocal pivot
            if line.name == "MPVT":
                pivot = line.integers[0]
            integers = self._integers(line, operands)
            # of a gap that joins two, one line of each name is left
            is_of_joined = line.arguments[0] == "gap" and line.integers[0] in self.joined
            if integers is None or (is_of_joined and (line.name, integers) in of_gaps):
                self.lost.append(f"tolerance {line}")
                return []
            of_gaps.update([(line.name, integers)] if is_of_joined else [])
            new = replace(line, integers=integers)
            if line.arguments[0] not in ("surface", "element") or line.integers[0] not in self.turned:
                return [new]
            new = new.negated() if line.sign(self.lens, self._sign_of) < 0 else new
            if not line.has_pivot or pivot == _TURNED_PIVOTS.get(pivot, pivot):
                return [new]
            before, behind = (ToleranceLine("MPVT", (code, 0, 0)) for code in (_TURNED_PIVOTS[pivot], pivot))
            return [before, new, behind]

        return rewritten(lines, moved)

    def _integers(self, line: ToleranceLine, operands: Sequence[int | None]) -> tuple[int, int, int] | None:
        """The whole numbers of a line of tolerances by their new numbers; None where its surface is gone."""
        first, second, third = line.integers
        kind, other, seat = line.arguments
        if kind == "operand":
            number = operands[first - 1] if 1 <= first <= len(operands) else first - 1
            return None if number is None else (number + 1, second, third)
        numbers = {**dict(enumerate(self.gaps)), **self.joined} if kind == "gap" else dict(enumerate(self.surfaces))
        if not kind or first not in numbers:
            return line.integers
        if kind == "element":
            ends = self.ends(first, min(second or first, len(numbers) - 1))
            if ends is None:
                return None
            of_seat = self.surfaces[third or first] if seat else third
            return None if of_seat is None else (*ends, of_seat)
        new = numbers[first]
        if new is None:
            return None
        if other == "gap" and second in numbers:
            adjuster = numbers[second]
            second = new if adjuster is None else adjuster
        return new, second, third

    def _sign_of(self, surface: int, quantity: str) -> float:
        place = self.moved(surface, quantity)
        return 1.0 if place is None else place[2]


#: The pivot of the tilts of an element that is turned around, by that before: first and last surface, and their edges.
_TURNED_PIVOTS = {0: 1, 1: 0, 2: 3, 3: 2}


def _backwards(variables: tuple[Vary, ...], solves: tuple[Solve, ...]) -> tuple[tuple[Vary, ...], tuple[Solve, ...]]:
    """Variables and solves in which pickups follow surfaces in front of them, as in files, where that is possible.

    y = s x + o of a surface behind is x = y/s - o/s: y is the variable then, and what followed x follows y.
    """
    solved = {solve.address for solve in solves}
    ahead = [
        solve
        for solve in solves
        if solve.kind == "pickup"
        and solve.operand is None
        and solve.scale
        and solve.source > solve.surface
        and not solve.quantity_of_source
        and solve.quantity != "glass"
        and solve.address_of_source not in solved
    ]
    if not ahead:
        return variables, solves
    first = min(ahead, key=lambda solve: solve.surface)
    x, scale, offset = first.address_of_source, first.scale, first.offset

    def followed(solve: Solve) -> Solve:
        if solve is first:
            back: dict[str, Any] = {"scale": 1 / scale, "offset": 0.0 - offset / scale}
            return replace(solve, surface=solve.source, source=solve.surface, **back)
        if solve.kind != "pickup" or solve.operand is not None or solve.address_of_source != x:
            return solve
        times = solve.scale / scale
        return replace(solve, source=first.surface, scale=times, offset=solve.offset - times * offset)

    def varied(variable: Vary) -> Vary:
        if variable.operand is not None or variable.address != x:
            return variable
        bounds = tuple(sorted(scale * end + offset for end in variable.bounds))
        return replace(variable, surface=first.surface, bounds=bounds)

    return _backwards(tuple(map(varied, variables)), tuple(map(followed, solves)))


def _takes(row: Row) -> set[int]:
    """The numbers of the rows whose values a row takes."""
    kinds = ARGUMENTS.get(row.operand, ("", "")) if isinstance(row.operand, str) else ("", "")
    first, last = row.integers
    if kinds[0] == "row":
        return {first, last} - {0} if kinds[1] else {first} - {0}
    return set()


def _with_rows(row: Row, places: dict[int, int]) -> Row:
    """A row that takes the values of others, by their new numbers; the ends of a range are those of the rows left."""
    kinds = ARGUMENTS.get(row.operand, ("", "")) if isinstance(row.operand, str) else ("", "")
    first, last = row.integers
    if kinds[0] == "row":
        return replace(row, integers=(places.get(first, first), places.get(last, last) if kinds[1] else last))
    if kinds[0] != "rows":
        return row
    kept = [places[k] for k in range(min(first, last), max(first, last) + 1) if k in places]
    return replace(row, integers=(min(kept), max(kept))) if kept else row

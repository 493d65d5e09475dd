"""Structure: a run of surfaces as the compiled trace reads it, apart from the numbers that go with it.

A structure is a table of integers, one row a surface: its kind, what it does to light, and which of the numbers it
takes; axes that turn on the way to a surface have a row of their own before it, and are all that a coordinate break
is. The numbers are tensors, and autograd sees how they were put together.
"""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.utils._pytree import tree_leaves

from raytrace.system.apertures import SHAPES
from raytrace.system.phases import Facets, HologramPath, IdealLens, Phase, PolynomialPath, RadialPath, kind_of, path_of
from raytrace.system.poses import Gap, Turn, passage
from raytrace.system.sag_terms import PowerSag
from raytrace.system.shapes import EVEN, KINDS, SAG_TERMS, SagTerms
from raytrace.system.surface import Surface, gap_behind

_TURN, _PLANE, _SPHERE, _CONIC = range(-1, 3)  # and the codes of shapes.KINDS
_WITH_SAG_TERMS, _FRAME = 7, 4  # kWithSagTerms of sags.h; kFrame of sag_terms.h, its numbers before the coefficients
_NONE, _REFRACT, _REFLECT = range(3)

#: What a phase becomes before it is traced, by `Form` of paths.h.
FORMS = (None, PolynomialPath, RadialPath, IdealLens, HologramPath, Facets)


class _Row(NamedTuple):
    """`Layout` of block.h: the first six are told there, the others are places of numbers, -1 where there is none."""

    kind: int
    bend: int
    side: int
    terms: int
    apertures: int
    first_aperture: int
    gap: int
    curvature: int
    conic: int
    coefficients: int
    before: int
    behind: int
    rim: int
    phase: int = 0
    phase_terms: int = 0
    phase_numbers: int = 0
    sag_term_count: int = 0
    sag_term_numbers: int = 0


@dataclasses.dataclass(frozen=True, eq=False)
class Structure:
    """Surfaces without their numbers.

    layout: (S, 18) int32, a `_Row` each; constants: (C,) float64, what no derivative is asked for: rims and apertures.
    """

    layout: np.ndarray
    constants: np.ndarray


def is_expressible(surface: Surface) -> bool:
    """Whether the compiled trace knows the surface: kind, sag_terms, phase and apertures compiled, few terms."""
    if surface.is_break:
        return True
    if surface.phase is not None and not _is_known(surface):
        return False
    if any(SHAPES[aperture.shape].code is None for aperture in surface.apertures):
        return False
    if surface.sag_terms is not None and not (surface.kind == EVEN and _has_powers(surface.sag_terms)):
        return False
    kind = KINDS[surface.kind]
    return surface.coefficients is None or (kind.code is not None and len(surface.coefficients) <= kind.compiled)


def _is_known(surface: Surface) -> bool:
    """Whether the compiled trace knows the phase of a surface; facets only of an even asphere that light passes."""
    kind = kind_of(surface.phase)
    if kind.flat:
        return surface.kind == EVEN and surface.sag_terms is None and not surface.is_mirror
    return kind.slopes or kind.path is not None


def _has_powers(sag_terms: SagTerms) -> bool:
    """Whether the compiled trace knows sag terms: as powers of x and y, not too many, the same for all rays."""
    kind, numbers = SAG_TERMS[type(sag_terms).__name__], tree_leaves(sag_terms)
    few = kind.compiled is None or all(number.numel() <= kind.compiled for number in numbers)
    return kind.powers is not None and few and all(number.dim() <= 1 for number in numbers)


class _Table:
    """What the rows of a structure point to: numbers, each of which stands once, and constants."""

    def __init__(self):
        self.numbers: list[Tensor] = []
        self.constants: list[float] = []
        self._places: dict[int, int] = {}

    def place(self, number: Tensor | None) -> int:
        if number is None:
            return -1
        if id(number) not in self._places:
            self._places[id(number)] = len(self.numbers)
            self.numbers.append(number)
        return self._places[id(number)]

    def place_all(self, numbers: Sequence[Tensor]) -> int:
        """The place of the first of numbers that stand in a row."""
        self.numbers.extend(numbers)
        return len(self.numbers) - len(numbers)

    def place_rim(self, surface: Surface) -> int:
        """The place of the semi-diameter, behind which the apertures stand."""
        place = len(self.constants)
        self.constants.append(float("inf") if surface.semi_diameter is None else surface.semi_diameter)
        for aperture in surface.apertures:
            code, sizes = SHAPES[aperture.shape].code, aperture.extent
            self.constants += [code, float(aperture.obscures), *aperture.centre, len(sizes), *sizes]
        return place


def structure_of(
    surfaces: Sequence[Surface],
    indices: Sequence[Tensor],
    side: int,
    gap: Tensor | Gap | None,
    wavelength: Tensor | None = None,
) -> tuple[Structure, list[Tensor]]:
    """The structure of a run of surfaces, and the tensors (...) it counts as its numbers; arguments as for `steps`."""
    table, rows = _Table(), []
    for surface, n1, n2 in zip(surfaces, indices[:-1], indices[1:], strict=True):
        if surface.is_break or surface.before is not None or isinstance(gap, Gap):
            rows.append(_turn(table, surface, gap, side, n1))
            gap = None
        if not surface.is_break:
            rows.append(_row(table, surface, gap, side, n1, n2, wavelength))
        gap, side = gap_behind(surface), -side if surface.is_mirror else side
    return Structure(np.array(rows, dtype=np.int32), np.array(table.constants, dtype=np.float64)), table.numbers


def rows_of(structure: Structure, surfaces: Sequence[Surface]) -> list[int]:
    """The row of the structure behind which rays have passed each of its surfaces, in their own axes."""
    found, row = [], -1
    for surface in surfaces:
        row += 1
        if not surface.is_break and structure.layout[row, 0] == _TURN:
            row += 1
        found.append(row)
    return found


def _row(
    table: _Table, surface: Surface, gap: Tensor | None, side: int, n1: Tensor, n2: Tensor, wavelength: Tensor | None
) -> _Row:
    form, phase = _form_of(surface.phase, wavelength) if not _is_faceted(surface) else _facets_of(surface, n1)
    if _is_faceted(surface):
        surface = dataclasses.replace(surface, curvature=None, conic=None, coefficients=None)
    terms = () if surface.coefficients is None else surface.coefficients.unbind(0)
    first_term, rim = table.place_all(terms), table.place_rim(surface)
    sag_terms = _numbers_of(surface.sag_terms)
    return _Row(
        kind=_kind(surface),
        bend=_REFLECT if surface.is_mirror else _NONE if n2 is n1 else _REFRACT,
        side=side,
        terms=len(terms),
        apertures=len(surface.apertures),
        first_aperture=rim + 1,
        gap=table.place(gap),
        curvature=table.place(surface.curvature),
        conic=table.place(surface.conic),
        coefficients=first_term,
        before=table.place(n1),
        behind=table.place(n2),
        rim=rim,
        phase=form,
        phase_terms=len(phase),
        phase_numbers=table.place_all(phase),
        sag_term_count=max(len(sag_terms) - _FRAME, 0),
        sag_term_numbers=table.place_all(sag_terms),
    )


def _is_faceted(surface: Surface) -> bool:
    return isinstance(surface.phase, Facets)


def _facets_of(surface: Surface, n1: Tensor) -> tuple[int, Sequence[Tensor]]:
    """The shape of a Fresnel lens as the numbers of its phase: its surface is a plane."""
    shape = [n1.new_zeros(()) if number is None else number for number in (surface.curvature, surface.conic)]
    return FORMS.index(Facets), (*shape, *(() if surface.coefficients is None else surface.coefficients.unbind(0)))


def _numbers_of(sag_terms: SagTerms | None) -> Sequence[Tensor]:
    """Those of sag terms as sag_terms.h has them."""
    if sag_terms is None:
        return ()
    *frame, coefficients = tree_leaves(SAG_TERMS[type(sag_terms).__name__].powers(sag_terms))
    return *frame, *coefficients.unbind(0)


def _turn(table: _Table, surface: Surface, gap: Tensor | Gap | None, side: int, n1: Tensor) -> _Row:
    """The way over a gap into the axes of a surface, as `Turn` and turns.h have its numbers."""
    thickness = gap.thickness if isinstance(gap, Gap) else gap
    rows = passage(gap, surface.before)
    lag = 0.0 if thickness is None else n1 * (thickness * side)
    numbers = [*(entry for row in rows for entry in row[:3]), *(row[3] for row in rows), lag]
    known = {exact: n1.new_tensor(exact) for exact in {x for x in numbers if isinstance(x, float)}}
    first = table.place_all([known[x] if isinstance(x, float) else x for x in numbers])
    rim, medium = table.place_rim(Surface(surface.thickness)), table.place(n1)
    return _Row(_TURN, _NONE, side, len(numbers), 0, rim + 1, -1, -1, -1, first, medium, medium, rim)


def _form_of(phase: Phase | None, wavelength: Tensor | None) -> tuple[int, Sequence[Tensor]]:
    """Which of the FORMS a phase takes, and its numbers there."""
    if phase is None:
        return 0, ()
    if isinstance(phase, IdealLens):
        vergence = torch.zeros_like(phase.power_x) if phase.vergence is None else phase.vergence
        return FORMS.index(IdealLens), (phase.power_x, phase.power_y, vergence)
    path = path_of(phase, wavelength)
    if isinstance(path, HologramPath):
        return FORMS.index(HologramPath), (*path.first.unbind(0), *path.second.unbind(0), path.scale)
    if isinstance(path, PolynomialPath):
        constant = path.coefficients.new_zeros(()) if path.constant is None else path.constant
        return FORMS.index(PolynomialPath), (constant, *path.coefficients.unbind(0))
    return FORMS.index(type(path)), path.coefficients.unbind(0)


def with_numbers(
    structure: Structure, surfaces: Sequence[Surface], numbers: Sequence[Tensor]
) -> tuple[list[Surface], list[Tensor], Tensor | None]:
    """Surfaces, indices and gap of a structure with these numbers in their places: `structure_of` undone.

    Every row becomes a surface: what turned the axes is a coordinate break.
    """
    rows = [_Row(*row) for row in structure.layout.tolist()]
    gaps = [None if row.gap < 0 else numbers[row.gap] for row in rows]
    given = iter([surface for surface in surfaces if not surface.is_break])
    own = [_turned(row, numbers) if row.kind == _TURN else _rebuilt(row, next(given), numbers) for row in rows]
    none = torch.zeros_like(numbers[rows[0].before])
    own = [
        dataclasses.replace(surface, thickness=none if thickness is None else thickness)
        for surface, thickness in zip(own, [*gaps[1:], none], strict=True)
    ]
    return own, [numbers[rows[0].before], *(numbers[row.behind] for row in rows)], gaps[0]


def _rebuilt(row: _Row, surface: Surface, numbers: Sequence[Tensor]) -> Surface:
    def number(place: int) -> Tensor | None:
        return None if place < 0 else numbers[place]

    terms = numbers[row.coefficients : row.coefficients + row.terms]
    if _is_faceted(surface):
        curvature, conic, *terms = numbers[row.phase_numbers : row.phase_numbers + row.phase_terms]
        shape = {"curvature": curvature, "conic": conic, "coefficients": torch.stack(terms) if terms else None}
        return dataclasses.replace(surface, **shape, before=None, after=None)
    return dataclasses.replace(
        surface,
        curvature=number(row.curvature),
        conic=number(row.conic),
        coefficients=surface.coefficients if not terms else torch.stack(list(terms)),
        phase=_phase_of(row, numbers),
        sag_terms=_sag_terms_of(row, numbers),
        before=None,
        after=None,
    )


def _phase_of(row: _Row, numbers: Sequence[Tensor]) -> Phase | None:
    own = numbers[row.phase_numbers : row.phase_numbers + row.phase_terms]
    if FORMS[row.phase] in (None, IdealLens):
        return IdealLens(*own) if row.phase else None
    if FORMS[row.phase] is HologramPath:
        first, second = (torch.stack(torch.broadcast_tensors(*own[i : i + 3])) for i in (0, 3))
        return HologramPath(first, second, own[6])
    constant, own = ((own[0],), own[1:]) if FORMS[row.phase] is PolynomialPath else ((), own)
    none = numbers[row.before].new_zeros(0)
    return FORMS[row.phase](torch.stack(torch.broadcast_tensors(*own)) if own else none, *constant)


def _sag_terms_of(row: _Row, numbers: Sequence[Tensor]) -> PowerSag | None:
    """Its numbers are the same in every row of a table: those of the first one are taken."""
    if row.kind != _WITH_SAG_TERMS:
        return None
    last = row.sag_term_numbers + _FRAME + row.sag_term_count
    own = torch.stack([number.reshape(-1)[0] for number in numbers[row.sag_term_numbers : last]])
    return PowerSag(*own[:_FRAME].unbind(0), own[_FRAME:])


def _turned(row: _Row, numbers: Sequence[Tensor]) -> Surface:
    own = numbers[row.coefficients : row.coefficients + row.terms]
    rotation = torch.stack([torch.stack(list(own[3 * i : 3 * i + 3])) for i in range(3)])
    return Surface(own[12], before=Turn(rotation, torch.stack(list(own[9:12])), own[12]), is_break=True)


def _kind(surface: Surface) -> int:
    if surface.sag_terms is not None:
        return _WITH_SAG_TERMS
    if surface.coefficients is not None:
        return KINDS[surface.kind].code
    if surface.curvature is None:
        return _PLANE
    return _SPHERE if surface.conic is None else _CONIC

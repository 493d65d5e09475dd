"""The lens in the terms of a .zmx file: the same surfaces in space, where the lens holds them by other numbers.

    sag terms       powers about a centre and Noll's polynomials become an extended polynomial. On an even asphere
                    powers to the fifth become fringe terms; of higher ones the terms of the asphere become powers, too
    decentres z     of a pose before a surface belong to the thickness before, of one behind it to that behind; old =
                    d + R new is there R (new + Rᵀd). An object at infinity stays where it is
    poses behind    a coordinate break become one pose with that of the break

Numbers of configurations follow. Solves of numbers that change, and variables that the new terms do not have, are left
out.
"""

import dataclasses

import torch
from torch import Tensor

from raytrace.io.source import LensFileError, Place
from raytrace.system.configurations import Operand
from raytrace.system.lens import Lens
from raytrace.system.optimization_data import OptimizationData, Solve, Vary
from raytrace.system.poses import Pose, pose_of, rows_along
from raytrace.system.sag_terms import (
    IrregularSag,
    PolynomialSag,
    PowerSag,
    SagTerms,
    TiltSag,
    ZernikeSag,
    about_vertex,
    as_fringe,
    with_even_terms,
)
from raytrace.system.shapes import EVEN, KINDS
from raytrace.system.surface import Surface, with_z_in_thicknesses

#: Terms of an extended polynomial, to x²⁰ … y²⁰.
MOST_TERMS = 230

#: Fields of a surface's shape and poses, whose numbers change with them.
_CHANGED = ("sag_terms", "coefficients", "before", "after")
#: Rules of quantities that a surface keeps whatever its shape is.
_KEPT = ("thickness", "curvature", "conic", "glass", "semi_diameter", "index", "abbe_number", "partial_dispersion")

_EXACT = 1e-12  # of rotations, and of decentres in mm or relative to their size


def in_file_terms(lens: Lens, place: Place) -> Lens:
    """The lens with the same surfaces by numbers that a .zmx file holds.

    Raises LensFileError where it holds none: sums of powers on other surfaces than even aspheres, terms beyond
    MOST_TERMS, poses whose tilts about y are right angles, and configurations that differ in numbers that change.
    """
    surfaces = [_with_polynomial(surface, place._replace(surface=k)) for k, surface in enumerate(lens.surfaces)]
    surfaces = [_joined(surface) for surface in surfaces]
    posed = with_z_in_thicknesses(surfaces)
    for k, pair in enumerate(zip(surfaces, posed, strict=True)):
        _check_poses(*pair, place._replace(surface=k))
    if all(a is b for a, b in zip(posed, lens.surfaces, strict=True)):
        return lens
    operands = tuple(_followed(operand, lens, posed, place) for operand in lens.operands)
    changed = dataclasses.replace(lens, surfaces=tuple(posed), operands=operands)
    return dataclasses.replace(changed, optimization_data=_rules(lens, changed))


# -- sag terms --------------------------------------------------------------------------------------------------------


def _with_polynomial(surface: Surface, place: Place) -> Surface:
    """A surface whose sag terms are fringe terms or an extended polynomial, where no type holds them otherwise."""
    sag = surface.sag_terms
    on_terms = surface.coefficients is not None and isinstance(sag, PolynomialSag | IrregularSag | TiltSag)
    if sag is None or not (isinstance(sag, PowerSag | ZernikeSag) or on_terms):
        return surface
    _refuse_batch(sag, place)
    if surface.coefficients is not None and surface.kind != EVEN:
        message = f"errors of the sag of a surface that is {KINDS[surface.kind].name}, expected an even asphere at most"
        raise LensFileError(f"{message}; a .zmx file holds no such surface", place)
    polynomial, height = about_vertex(sag)
    few = surface.coefficients is not None and len(surface.coefficients) <= KINDS[EVEN].parameters
    if few and (sum_of_fringes := as_fringe(polynomial)) is not None:
        return _raised(dataclasses.replace(surface, sag_terms=sum_of_fringes), height)
    if surface.coefficients is not None:
        polynomial = with_even_terms(polynomial, surface.coefficients)
    count = int(torch.nonzero(polynomial.coefficients).max()) + 1 if bool(polynomial.coefficients.any()) else 1
    if count > MOST_TERMS:
        message = f"{count} powers of x and y in the sag, an extended polynomial has {MOST_TERMS}"
        raise LensFileError(f"{message} (to x²⁰ … y²⁰); leave out the higher terms", place)
    polynomial = dataclasses.replace(polynomial, coefficients=polynomial.coefficients[:count])
    return _raised(dataclasses.replace(surface, sag_terms=polynomial, coefficients=None, kind=EVEN), height)


def _raised(surface: Surface, height: Tensor) -> Surface:
    """A surface shifted along z by a height () mm."""
    if not bool(height):
        return surface
    before, after = _joint(surface.pose, Pose(z=height)), _joint(Pose(z=-height), surface.after)
    return dataclasses.replace(surface, before=before, after=after)


def _refuse_batch(sag: SagTerms, place: Place) -> None:
    numbers = {field.name: getattr(sag, field.name) for field in dataclasses.fields(sag)}
    for name, number in numbers.items():
        if number.dim() > (name == "coefficients"):
            message = f"the {name} of sag terms has the shape {tuple(number.shape)}"
            raise LensFileError(f"{message}; a file holds one lens: write one of them", place)


# -- poses ------------------------------------------------------------------------------------------------------------


def _joint(*poses: Pose | None) -> Pose:
    """The pose of several in sequence."""
    modelled = [pose for pose in poses if pose is not None]
    return modelled[0] if len(modelled) == 1 else pose_of(rows_along(modelled))


def _joined(surface: Surface) -> Surface:
    """A coordinate break with one pose alone."""
    if not surface.is_break or surface.after is None:
        return surface
    return dataclasses.replace(surface, before=_joint(surface.pose, surface.after), after=None)


def _check_poses(surface: Surface, posed: Surface, place: Place) -> None:
    """Refuse poses whose tilts are not unique: a right angle about y."""
    for name in ("before", "after"):
        old, new = getattr(surface, name), getattr(posed, name)
        if old is new or old is None:
            continue
        ways = [_rotation(pose) for pose in (old, new)]
        if not bool((ways[0] - ways[1]).abs().max() < _EXACT):
            message = "a decentre along z together with a tilt by 90° about y, where a .zmx file has no order for both"
            raise LensFileError(f"{message}; put the turn on a coordinate break of its own", place)


def _rotation(pose: Pose | None) -> Tensor:
    rows = rows_along([pose])
    return torch.tensor([[float(entry) for entry in row[:3]] for row in rows], dtype=torch.float64)


# -- operands of configurations, and rules ----------------------------------------------------------------------------


def _followed(operand: Operand, lens: Lens, posed: list[Surface], place: Place) -> Operand:
    """An operand of configurations whose thickness has the step of that of the lens."""
    steps: list[Tensor | None] = []
    for scaled in operand.paths:
        step = None
        if scaled.path[0] == "surfaces" and isinstance(k := scaled.path[1], int):
            field = str(scaled.path[2])
            old, new, place = lens.surfaces[k], posed[k], place._replace(surface=k)
            if field == "thickness" and new.thickness is not old.thickness:
                step = (new.thickness - old.thickness) / scaled.factor
            elif field in _CHANGED and getattr(old, field) is not getattr(new, field):
                step = new.thickness * torch.nan  # no number of the operand has a step that gives the new ones
        steps.append(step)
    if all(step is None for step in steps):
        return operand
    first = steps[0]
    if operand.numbers is None or first is None or not all(step is not None and bool(step == first) for step in steps):
        message = f"{operand}: errors change numbers that follow it, which a .zmx file does not hold in other terms"
        raise LensFileError(f"{message}; write one configuration", place)
    return dataclasses.replace(operand, numbers=operand.numbers + first)


def _rules(lens: Lens, changed: Lens) -> OptimizationData | None:
    """The optimisation data without the rules of numbers that changed."""
    data = lens.optimization_data
    if data is None:
        return None

    def holds(rule: Vary | Solve) -> bool:
        old, new = lens.surfaces[rule.surface], changed.surfaces[rule.surface]
        if rule.operand is not None or old is new:
            return True
        if rule.quantity == "thickness":
            return isinstance(rule, Vary) or new.thickness is old.thickness
        return rule.quantity in _KEPT or all(getattr(old, field) is getattr(new, field) for field in _CHANGED)

    return dataclasses.replace(
        data,
        variables=tuple(filter(holds, data.variables)),
        solves=tuple(filter(holds, data.solves)),
        kept=tuple(filter(holds, data.kept)),
    )

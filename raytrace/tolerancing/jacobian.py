"""Derivatives of rays, merit functions, and any function of a lens by its design variables and its errors, in one pass.

The numbers of the lens are tensors that carry their derivatives (`maths.tangents`) by all variables, through solves and
pickups, and by all errors of manufacture. The quantity is computed from this lens once: by the compiled trace where it
supports the surfaces, else by torch. Launch and ray aiming follow every number.
"""

import dataclasses
import warnings
from collections.abc import Callable, Iterable, Sequence
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Columns, Result, Table
from raytrace.maths.tangents import MovingTensor, tangents_of, value_of, with_tangents
from raytrace.optimization.merit import DefaultMerit, Evaluation, Merit, merit_for
from raytrace.optimization.variables import DesignVariables, design_variables
from raytrace.system.lens import Lens, aligned
from raytrace.system.optimization_data import Row, Vary
from raytrace.system.rays import Rays
from raytrace.system.tolerance_data import Tolerance
from raytrace.tolerancing import grades
from raytrace.tolerancing.perturbation import Perturbation
from raytrace.tolerancing.table import ToleranceTable
from raytrace.tracing.launch import rays
from raytrace.tracing.trace import trace_lens
from raytrace.words import RaytraceWarning, calling_level, did_you_mean, named_value, option


class NoDerivatives(RaytraceWarning):
    """A quantity that carries no derivatives by the numbers of the lens."""


@value
class Jacobian(Result):
    """A quantity of a lens and its derivatives by n design variables and errors of manufacture.

    value: (...) of the quantity; derivatives: (n, ...), in the unit of the quantity per unit of the number (mm of
    thicknesses and decentres, 1/mm of curvatures, degrees of tilts, °C; of errors the unit of their limits); variables:
    names, as thickness_6, of errors their kind and place; numbers: (n,) the values, 0 of errors. quantity: its name.
    """

    value: Tensor
    derivatives: Tensor
    variables: tuple[str, ...]
    numbers: Tensor
    quantity: str

    COLUMNS = (
        Column("variable", form="<"),
        Column("number", form=".9g"),
        Column("rms", form=".6g", heading="RMS of the derivatives"),
        Column("largest", form=".6g", heading="largest derivative"),
    )

    def columns(self) -> dict[str, Tensor]:
        each = self.derivatives.detach().reshape(len(self.variables), -1)
        return {
            "variable": torch.arange(len(self.variables)),
            "number": self.numbers,
            "rms": each.square().mean(-1).sqrt(),
            "largest": each.abs().amax(-1),
        }

    def words(self) -> dict[str, Sequence[str]]:
        return {"variable": self.variables}

    def tables(self) -> list[Table]:
        columns: Columns = {**self.columns(), "variable": [*self.variables]}
        shape = " × ".join(map(str, self.value.shape)) or "one number"
        return [Table(columns, [f"derivatives of {self.quantity} ({shape}) by {len(self.variables)} numbers"])]

    def document(self) -> dict[str, Any]:
        return {
            "analysis": "jacobian",
            "quantity": self.quantity,
            "variables": [*self.variables],
            "numbers": self.numbers.tolist(),
            "value": self.value.detach().tolist(),
            "derivatives": self.derivatives.detach().tolist(),
        }


def _landing_points(end: Rays) -> Tensor:
    return end.position[:2]


def _directions(end: Rays) -> Tensor:
    return end.direction


def _paths(end: Rays) -> Tensor:
    assert end.opl is not None
    return end.opl


#: Quantities of rays behind the lens, by the name of `of`.
OF_RAYS: dict[str, Callable[[Rays], Tensor]] = {
    "points": _landing_points,
    "directions": _directions,
    "paths": _paths,
}


def jacobian(
    lens: Lens,
    vary: str | Sequence[str | Vary] | None = None,
    *,
    of: str | Callable[[Lens], Tensor] = "points",
    tolerances: ToleranceTable | Iterable[Tolerance] | None = None,
    grade: Literal["commercial", "precision", "high"] | None = None,
    limits: str | Sequence[str] = "",
    fields: Tensor | Sequence | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    pupil: Tensor | tuple[Tensor, Tensor] | None = None,
    merit: Merit | DefaultMerit | Sequence[Row] | str | None = None,
) -> Jacobian:
    """A quantity of a lens and its derivatives by all design variables and errors of manufacture, in one pass.

    vary: variables, pickups and solves, as of `optimize`; by default the file's, or none where errors are named.
    of: "points" (2, F, W, P) mm, where rays land on the image, "directions" (3, F, W, P) behind the lens, "paths"
    (F, W, P) mm, less the axial ray's, of the rays of fields, wavelengths and pupil points as of `rays`; "merit", the
    residuals (m,) of a merit function as of `evaluate`, whose squares sum up to M²; or a function of a lens that
    returns a tensor (...), as lambda lens: rt.spot(lens).whole.rms_radius. tolerances: rows whose errors follow the
    variables, each 0, as of `perturbed`; grade, limits: as of `tolerances` instead. Derivatives are exact to rounding;
    failed rays have 0. Raises BadVariables, BadTolerance, TypeError, ValueError.
    """
    selected = of.removeprefix("landing ") if isinstance(of, str) else of  # former name: landing points
    of_rays = [
        name
        for name, given in (("fields", fields), ("wavelengths", wavelengths), ("pupil", pupil))
        if given is not None
    ]
    if of_rays and not (isinstance(selected, str) and selected in OF_RAYS):
        raise ValueError(
            f"jacobian: {option(of_rays[0])} belongs to quantities of rays, {', '.join(OF_RAYS)}: leave it out"
        )
    if merit is not None and selected != "merit":
        raise ValueError(
            f"jacobian: {option('merit')} belongs to {option('of', 'merit')}: name it, or leave the merit function out"
        )
    perturbation = _perturbation(lens, tolerances, grade, limits)
    alone = vary is None and perturbation is not None
    model = DesignVariables(lens) if alone else design_variables(lens, vary)
    if selected == "merit":
        if perturbation is not None:
            raise ValueError(
                "jacobian: the residuals of a merit function have derivatives by design variables alone; for errors "
                f"give {option('of')} a function, as lambda lens: rt.spot(lens).whole.rms_radius"
            )
        quantity, derivatives = _of_merit(model, lens, merit)
    else:
        if callable(selected):
            function = selected
        elif selected in OF_RAYS:
            function = _of_rays(OF_RAYS[selected], fields, wavelengths, pupil)
        else:
            known = (*OF_RAYS, "merit")
            raise ValueError(
                f"jacobian: {option('of')} is {named_value(of)}; expected {', '.join(known)} or a function of a lens"
                + (did_you_mean(of, known) if isinstance(of, str) else "")
            )
        errors = 0 if perturbation is None else len(perturbation.rows)
        start = torch.from_numpy(np.append(model.start, np.zeros(errors)))
        numbers = with_tangents(start, torch.eye(len(start), dtype=start.dtype))
        with torch.enable_grad():
            moving = model.lens_at(numbers[: len(model.variables)])
            moving = moving if perturbation is None else perturbation(numbers[len(model.variables) :], moving)
        quantity, derivatives = derivatives_of(function, moving, len(start))
    rows = () if perturbation is None else ToleranceTable(perturbation.rows).labels
    return Jacobian(
        quantity,
        derivatives,
        (*(variable.name for variable in model.variables), *rows),
        torch.as_tensor(np.concatenate([model.start, np.zeros(len(rows))])),
        {"points": "landing points"}.get(selected, selected)
        if isinstance(selected, str)
        else getattr(selected, "__name__", "a function").replace("<lambda>", "a function"),
    )


def _perturbation(
    lens: Lens, tolerances: ToleranceTable | Iterable[Tolerance] | None, grade: str | None, limits: str | Sequence[str]
) -> Perturbation | None:
    """The lens with the errors of tolerances, None without tolerances."""
    if tolerances is not None and (grade or limits):
        raise ValueError(f"jacobian: `tolerances` are given: leave {option('grade')} and {option('limits')} out")
    if tolerances is None and not (grade or limits):
        return None
    return Perturbation(lens, grades.tolerances(lens, limits, grade=grade) if tolerances is None else tolerances)


def derivatives_of(function: Callable[[Lens], Tensor], lens: Lens, count: int) -> tuple[Tensor, Tensor]:
    """The value (...) of a function of a lens that moves, and its derivatives (n, ...). Raises TypeError."""
    with torch.enable_grad():
        number = function(lens)
    if not isinstance(number, Tensor):
        raise TypeError(
            f"jacobian: {option('of')} returns {named_value(number)}; expected a tensor, as of lambda lens: "
            "rt.spot(lens).whole.rms_radius"
        )
    if not isinstance(number, MovingTensor):
        warnings.warn(
            "jacobian: the quantity carries no derivatives, and 0 is returned: it does not depend on the variables, or "
            "it is computed without them, by detach(), torch.no_grad() or plain numbers",
            NoDerivatives,
            stacklevel=calling_level(),
        )
        return number.detach(), number.new_zeros(count, *number.shape)
    return value_of(number).detach(), tangents_of(number, count).detach()


def _of_rays(
    quantity: Callable[[Rays], Tensor],
    fields: Tensor | Sequence | None,
    wavelengths: Tensor | Sequence[float] | None,
    pupil: Tensor | tuple[Tensor, Tensor] | None,
) -> Callable[[Lens], Tensor]:
    def function(lens: Lens) -> Tensor:
        launched = rays(lens, fields=fields, pupil=pupil, wavelengths=wavelengths)
        if quantity is not _paths:
            launched = dataclasses.replace(launched, opl=None)
        assert launched.wavelength is not None
        return quantity(trace_lens(aligned(lens, 3), launched, launched.wavelength))

    return function


def _of_merit(
    model: DesignVariables, lens: Lens, merit: Merit | DefaultMerit | Sequence[Row] | str | None
) -> tuple[Tensor, Tensor]:
    """The residuals (m,) of a merit function, whose squares sum up to M², and their derivatives (n, m)."""
    function = merit_for(lens, merit)
    evaluated = Evaluation(model, function.rows, **function.options)(model.start, derivatives=True)
    return torch.from_numpy(evaluated.residuals), torch.from_numpy(evaluated.jacobian.T.copy())

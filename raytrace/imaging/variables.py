"""Design variables of a lens or a thin element as parameters of a module, and thickness limits.

    variables = Variables(lens, "sensor thickness:5,6 curvature:1-4")
    changed = variables()                               # the lens with its variables, differentiable
    limits = limits_of(changed, glass=(2, 15), edge=1)  # thicknesses of glass, its edge thickness, mm
    variables.project()                                 # after a step: onto bounds and constraints, rays brought back
    violation(changed, limits)                          # Σ (excess over a limit)², mm²; 0 can be fabricated

`Variables` are a module around `DesignVariables`, with the variable and bound syntax, solves and pickups of `optimize`
(`optimization.variables`). The parameters are offsets from the lens. A state carries the identity of its lens, which is
compared when it is loaded (`Owned`). A focal length that is held is one more solve, of a number with power.

`PhaseVariables` are the heights of a thin element as parameters.
"""

import abc
import dataclasses
import functools
import json
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.utils import _pytree as pytree

from raytrace.imaging.constraints import Constraints, FurtherLimits, GlassLimits, joined_limits
from raytrace.io import as_lens
from raytrace.materials.glass import is_air
from raytrace.maths.numerics import safe_divide, to
from raytrace.maths.sampling import gauss_rings
from raytrace.maths.tangents import tangents_of, with_tangents
from raytrace.optimization.conditions import Condition, conditions_in_unit, conditions_of
from raytrace.optimization.glass_choice import catalogs_of, pool_of, with_glasses
from raytrace.optimization.variables import (
    BadHold,
    DesignVariables,
    bounds_of,
    constraint_words,
    design_variables,
    split_constraint,
    split_words,
    varied,
)
from raytrace.system.identity import alike, digest, identity, other_lens
from raytrace.system.lens import Lens, field_points
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import (
    GLASS,
    OF_LENS,
    Address,
    BadVariables,
    joined,
    number_at,
    path_of,
    sensor,
    stored_number,
    with_number,
)
from raytrace.system.surface import medium_surfaces, sag_at
from raytrace.tracing.geometry import clear_semi_diameters, edge_thickness, gaps, rims, semi_diameters
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.spot import image_rays
from raytrace.wave_optics.element import Element
from raytrace.words import RaytraceError, option

# -- thickness limits --------------------------------------------------------------------------------------------------

#: Default minimum thickness relative to the largest diameter of the lens: of glass at its centre (1 mm of 50 mm) and at
#: its edge, and of air.
_GLASS, _EDGE, _AIR = 1 / 50, 1 / 100, 1 / 2000


@dataclass(frozen=True)
class Limits:
    """Minimum and maximum axial thickness in mm, of glass and of air; edge: minimum edge thickness of glass."""

    glass: tuple[float, float]
    air: tuple[float, float]
    edge: float


def limits_of(
    lens: Lens,
    *,
    glass: tuple[float, float] | None = None,
    air: tuple[float, float] | None = None,
    edge: float | None = None,
) -> Limits:
    """Limits, mm. Defaults relative to the largest diameter of the lens: glass at least 1/50, at its edge 1/100, air
    between elements 1/2000, no maximum."""
    diameter = 2 * max((size for size in semi_diameters(lens)[1:-1] if size > 0), default=0.0)
    return Limits(
        glass=(_GLASS * diameter, math.inf) if glass is None else glass,
        air=(_AIR * diameter, math.inf) if air is None else air,
        edge=_EDGE * diameter if edge is None else edge,
    )


def violation(lens: Lens, limits: Limits | None = None) -> Tensor:
    """Σ (thickness beyond its limits)² in mm², over all elements and air spaces; 0 can be fabricated.

    limits: `limits_of(lens)` by default. An air space extends from element to element (`gaps`), across the stop and
    other surfaces with air on both sides: elements touch neither on the axis nor at the rim. The stop may lie inside
    the sagitta of an element. The space before the image has no maximum; spaces about a coordinate break have no limit.
    """
    limits = limits_of(lens) if limits is None else limits
    total = torch.zeros_like(lens.surfaces[-2].thickness)
    for shortfall in _shortfalls(lens, limits):
        total = total + shortfall.clamp_min(0).square()
    return total


def _shortfalls(lens: Lens, limits: Limits) -> Iterator[Tensor]:
    """Shortfall of each thickness, on the axis and at the edge; negative where its limit is met.

    Automatic semi-diameters follow the rays, with their derivatives.
    """
    surfaces, last = lens.surfaces, len(lens.surfaces) - 1
    spaces, ends = gaps(lens, to_image=True), np.arange(last + 1)
    in_air = np.array([is_air(surfaces[k].glass) for k in medium_surfaces(surfaces)])
    for start, end, _ in spaces:
        ends[start] = end
    # The image has a rim only where its semi-diameter is stored.
    numbers = [k for k in range(1, last) if not surfaces[k].is_break] + [last] * bool(surfaces[last].semi_diameter)
    heights = {k: h + (surfaces[k].chip_zone or 0.0) for k, h in clear_semi_diameters(lens, numbers).items()}
    sizes = np.array([float(heights[k].detach()) if k in heights else math.nan for k in range(last + 1)])
    edges = rims(sizes, ends, ~in_air & (ends > np.arange(last + 1)))
    for start, end, side in spaces:
        least, most = limits.air if in_air[start] else limits.glass
        thickness = torch.stack([surface.thickness for surface in surfaces[start:end]]).sum()
        yield least - side * thickness
        if math.isfinite(most) and not (in_air[start] and end == last):
            yield side * thickness - most
        if math.isfinite(edges[start]):
            y = heights[int(np.flatnonzero(sizes == edges[start])[0])]
            front, back = (sag_at(surfaces[k], torch.zeros_like(y), y) for k in (start, end))
            yield (0.0 if in_air[start] else limits.edge) - side * edge_thickness(thickness, front, back)


# -- states that carry their identity ----------------------------------------------------------------------------------

KEY = "_extra_state"  # torch's key of module state other than parameters


class OtherLens(RaytraceError, ValueError):
    """A state of another lens or element, or one without an identity; the message names both."""


def encoded_text(document: dict) -> Tensor:
    """A document as the bytes of its JSON, a uint8 tensor, so that a state remains a dictionary of tensors."""
    return torch.tensor(list(json.dumps(document).encode()), dtype=torch.uint8)


def decoded_text(stored: Tensor) -> dict:
    """The document of `encoded_text`. Raises OtherLens where it is damaged."""
    try:
        document = json.loads(bytes(stored.tolist()).decode())
    except (ValueError, TypeError, AttributeError, RecursionError):
        document = None
    if not isinstance(document, dict):
        raise OtherLens("the state does not say which lens or element it is of: its identity is damaged")
    return document


class Owned(nn.Module, abc.ABC):
    """A module of offsets, which are meaningless without the lens or element that they are offsets from.

    Its `state_dict` has a further entry "_extra_state": the text of `identity` in JSON, as bytes (a uint8 tensor), so
    that a state remains a dictionary of tensors. `bytes(state["_extra_state"].tolist()).decode()` shows it.
    `load_state_dict` refuses a state of another identity, or without one, as older versions wrote it, before any
    parameter is changed. Raises OtherLens.
    """

    @abc.abstractmethod
    def identity(self) -> dict:
        """The lens or element of the parameters, as plain values for JSON."""

    @abc.abstractmethod
    def difference(self, before: dict) -> str:
        """How an identity differs from this one, "" where it does not."""

    def get_extra_state(self) -> Tensor:
        return encoded_text(self.identity())

    def set_extra_state(self, state: Tensor) -> None:
        """Does nothing: the identity of a module is constant."""

    def _load_from_state_dict(
        self, state_dict: dict, prefix: str, local_metadata: dict, strict: bool, *lists: list[str]
    ) -> None:
        stored = state_dict.get(prefix + KEY)
        if stored is None:
            if any(prefix + name in state_dict for name, _ in self.named_parameters(recurse=False)):
                raise OtherLens(
                    "the state does not say which lens or element it is of; an older version wrote it. Learn anew, or, "
                    f"if it is of this one, set state[{prefix + KEY!r}] = module.get_extra_state(), of this "
                    f"{type(self).__name__}, first"
                )
        else:
            if words := self.difference(decoded_text(stored)):
                raise OtherLens(f"the state is of {words}")
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, *lists)


def converted(values: tuple, fn: Callable[[Tensor], Tensor]) -> tuple:
    """Values of tensors in the dtype and on the device that `fn` of `nn.Module._apply` gives floating-point numbers.

    `to` converts them: a lens keeps its numbers where `fn` makes empty tensors, and a coarse dtype is refused.
    """
    like = fn(torch.zeros((), dtype=_floating(values).dtype, device=_floating(values).device))
    return to(values, dtype=like.dtype, device=like.device)


def _floating(values: tuple) -> Tensor:
    return next(leaf for leaf in pytree.tree_leaves(values) if isinstance(leaf, Tensor) and leaf.is_floating_point())


# -- variables of a lens -----------------------------------------------------------------------------------------------

#: Units of numbers that are not of a shape, and of numbers of the lens.
_UNITS = {
    **dict.fromkeys(("thickness", "x", "y", "z"), 1.0),
    **{"index": 0.01, "abbe_number": 1.0, "partial_dispersion": 0.01},
    **{"temperature": 10.0, "pressure": 0.1},
}
_APERTURE = 0.1  # of the number of the system aperture: its unit
_BLUR_RAYS = 4, 8  # of units of blur
_NEGLIGIBLE = 1e-9  # relative change of the power by a number that does not affect it


@dataclass(frozen=True)
class Variable:
    """One number of a lens as a parameter.

    name: of `Vary`, or "sensor" of the last thickness; start: its value in the lens; unit:
    of the parameter, in the unit of the number. Thicknesses and decentres are in mm; numbers of the shape and tilts in
    the change that moves the surface by 1 mm of sag at its semi-diameter, so that a step has one meaning for all.
    The system aperture is in tenths of its number at the start, the temperature in 10 °C, the pressure in 0.1 atm.
    `Variables(step="blur")` takes other units.
    """

    name: str
    number: Vary
    start: float
    unit: float

    @property
    def address(self) -> Address:
        return self.number.surface, self.number.quantity


@dataclass(frozen=True)
class Held:
    """A focal length in mm, and the variable that is solved for it."""

    focal_length: float
    by: Variable

    def number(self, lens: Lens) -> Tensor:
        """The solved number in a lens, which models it as every variable."""
        number = stored_number(lens, self.by.address)
        assert number is not None
        return number


def _of_lens(lens: Lens, words: Sequence[str]) -> list[str]:
    """The conditions of a lens of other quantities than those of words of `hold`. Raises BadVariables."""
    try:
        stored, current = [c for c in lens.conditions if c.on and c.is_worded], lens.current_configuration
        given = [word for word in words if word not in ("buildable", "catalog")] if stored else ()
        others = conditions_of(lens, given)
        return [str(condition) for condition in stored if not any(c.excludes(condition, current) for c in others)]
    except BadHold as error:
        raise BadVariables(str(error)) from error


class Variables(Owned):
    """The variables of a lens as parameters: number = `Variable.start` + `Variable.unit` · parameter, 0 at the start.

    vary: variable syntax as of `optimize` (`optimization.variables`), as "sensor thickness:5,6 a4:3 temperature
        curvature:6=-curvature:1". Solves and pickups are those named here alone: the sensor stays where it is put even
        if the file solves for it. Glasses are not exchanged, and the camera sets the distance of the object.
    bounds: smallest and largest number by name ("sensor", "curvature_3"), or bound syntax; `project` clamps.
    hold: "efl" keeps the focal length of the lens, "efl=100" that one in mm: the last variable of `vary` that changes
        it is then not a parameter but solved for, and its bounds count in `violation`. Further conditions, of the
        constraint syntax of `optimize` as "total_track<=80", "buildable", thicknesses within their limits, and
        "catalog", model glasses within the hull of the catalogs' glasses, are met by `project`, and so are the
        conditions of the lens of other quantities, unless `stored` is False.
    catalog: of glasses, names or AGF files, by default those of the lens, else SCHOTT; glasses: a selection of them,
        as "preferred price<=3" (`rt.glasses`).
    step: unit of the parameters: "sag" as of `Variable`, or "blur": the change that spreads the rays of all fields by
        1 mm, RMS about their centroids, so that a rate of an optimiser means the same blur for all numbers of any lens.
    glass_thickness, air_thickness: minimum and maximum in mm on the axis; edge: minimum of glass at its edge; by
        default relative to the size of the lens (`limits_of`). `violation` is the penalty of the lens beyond them.
    `.to(device)`, `.float()` and `.double()` convert the lens with its parameters (`to`).
    `state_dict` carries the lens that the parameters are offsets from, and loads into that one alone (`Owned`).
    Raises BadVariables.
    """

    def __init__(
        self,
        lens: Lens | str | os.PathLike,
        vary: str = "sensor",
        *,
        bounds: Mapping[str, tuple[float, float]] | str | None = None,
        hold: str = "",
        stored: bool = True,
        glass_thickness: tuple[float, float] | None = None,
        air_thickness: tuple[float, float] | None = None,
        edge: float | None = None,
        catalog: Sequence[str | os.PathLike] = (),
        glasses: str = "",
        step: Literal["sag", "blur"] = "sag",
    ):
        super().__init__()
        if step not in ("sag", "blur"):
            raise BadVariables(f"step {step!r}: expected sag or blur")
        self.catalog, self.glasses = tuple(catalog), glasses
        self.lens = lens = as_lens(lens, "Variables")
        #: The variables in double precision on the processor, and the lens with all of them modelled.
        self.design, words = _design(lens, vary), constraint_words(hold)
        self._modelled = to(self.design.lens, dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)
        efl = [word for word in words if re.fullmatch("efl(=.*)?", word)]
        self.conditions = tuple(word for word in words if word not in efl)
        self._all = _variables(self.design, vary)
        self.held = self._held(" ".join(efl))
        self.conditions = (*(_of_lens(self.design.lens, words) if stored else ()), *self.conditions)
        self.variables = tuple(v for v in self._all if self.held is None or v is not self.held.by)
        self.names = tuple(variable.name for variable in self._all)
        lower, upper = bounds_of(lens, self.design.variables, bounds)
        ends = zip(self.names, lower.tolist(), upper.tolist(), strict=True)
        self.bounds = {name: (low, high) for name, low, high in ends if low > -math.inf or high < math.inf}
        self.limits = limits_of(lens, glass=glass_thickness, air=air_thickness, edge=edge)
        self.held_to = self._conditions()
        if "catalog" in self.conditions:
            self._glasses  # noqa: B018 - refuses lenses whose glasses do not vary
        for variable in self.variables:
            start = torch.zeros((), dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)
            self.register_parameter(variable.name, nn.Parameter(start))
        if step == "blur":
            self._rescale()
        self._before = self._values()  # numbers whose rays arrive
        if beyond := self.beyond():
            raise BadVariables(
                f"hold {hold!r}: {beyond}; hold another focal length, or end {option('vary')} with another variable"
            )

    @torch.no_grad()
    def _rescale(self) -> None:
        """Units of equal blur: the RMS distance from the centroid by which rays of all fields move."""
        like, count = self.lens.wavelengths, len(self.variables)
        pupil, weights = gauss_rings(*_BLUR_RAYS, dtype=like.dtype, device=like.device)
        units = torch.diag(like.new_tensor([variable.unit for variable in self.variables]))
        with torch.enable_grad():
            lens = self.free.lens_at(with_tangents(self._numbers(), units), self._modelled)
            rays = image_rays(lens, pupil, fields=field_points(None, like=self.lens))
        moved, weight = tangents_of(rays.position, count)[:, :2], weights * rays.valid
        about = moved - safe_divide((weight * moved).sum(-1, keepdim=True), weight.sum(-1, keepdim=True))
        blur = safe_divide((weight * about.square().sum(1)).sum((1, 2, 3)), weight.sum()).sqrt()
        scaled = {
            variable.name: dataclasses.replace(variable, unit=variable.unit / spread)
            for variable, spread in zip(self.variables, blur.tolist(), strict=True)
            if spread > _NEGLIGIBLE
        }
        self.variables = tuple(scaled.get(v.name, v) for v in self.variables)
        self._all = tuple(scaled.get(v.name, v) for v in self._all)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # The lens first: it refuses a dtype too coarse for optics before any parameter is converted.
        self.lens, self._modelled = converted((self.lens, self._modelled), fn)
        return super()._apply(fn, recurse)

    def extra_repr(self) -> str:
        return ", ".join(f"{name}={value:.6g}" for name, value in self.numbers().items())

    def _held(self, hold: str) -> Held | None:
        """The focal length of "efl" or "efl=100", and the last variable that changes it. Raises BadVariables."""
        if not hold:
            return None
        try:
            (word,) = constraint_words(hold)
            name, configuration, relation, number = split_constraint(word)
            length = math.nan
            if (name, configuration, relation) == ("efl", 0, "="):
                length = float(number or first_order(self.lens).effective_focal_length)
        except (BadHold, ValueError):
            length = math.nan
        if length == 0 or not math.isfinite(length):
            raise BadVariables(f"hold {hold!r}: expected efl, the focal length of the file, or one in mm as efl=100")
        for variable in reversed(self._all):
            is_solvable = variable.number.quantity not in GLASS and variable.address not in OF_LENS
            if is_solvable and variable.number.operand is None and self._has_power(variable):
                return Held(length, variable)
        raise BadVariables(
            f"hold {hold!r}: none of the variables changes the focal length; vary a thickness or a curvature "
            "whose pickups do not change it, too"
        )

    def _has_power(self, variable: Variable) -> bool:
        """Whether the power of the lens is linear in a variable, with all that follows it, and is not constant."""
        design = dataclasses.replace(self.design, variables=(variable.number,))
        view = design.views[self.lens.current_configuration - 1]
        states = (view.state(np.array([number])) for number in (0.0, 1.0, 2.0))
        at_zero, at_one, at_two = (state.gaussian(state.primary).C for state in states)
        change, bend = at_one - at_zero, at_two - 2 * at_one + at_zero
        return abs(change) > _NEGLIGIBLE * abs(at_zero) and abs(bend) <= _NEGLIGIBLE * max(abs(at_zero), abs(at_two))

    @functools.cached_property
    def free(self) -> DesignVariables:
        """The variables that are parameters, and the solve for the focal length."""
        if self.held is None:
            return self.design
        solve = Solve(*self.held.by.address, "focal_length", (self.held.focal_length,))
        free = tuple(variable.number for variable in self.variables)
        return dataclasses.replace(self.design, variables=free, solves=(*self.design.solves, solve))

    def _numbers(self) -> Tensor:
        """The numbers (n,) of the variables that are parameters, which are tensors under functional_call."""
        numbers = [variable.start + variable.unit * getattr(self, variable.name) for variable in self.variables]
        return torch.stack(numbers) if numbers else self.lens.wavelengths.new_zeros(0)

    def forward(self) -> Lens:
        """The lens with the current values of its variables."""
        return self.free.lens_at(self._numbers(), self._modelled)

    def _every(self) -> tuple[Variable, ...]:
        return self.variables if self.held is None else (*self.variables, self.held.by)

    def identity(self) -> dict:
        """The lens (`identity.identity`), and each variable's number in it and unit."""
        starts = {variable.name: [variable.start, variable.unit] for variable in self._every()}
        held = None if self.held is None else ["efl", self.held.focal_length, self.held.by.name]
        further = {"constraints": [*self.conditions], "solves": [*map(str, self.design.solves)]}
        further = {name: words for name, words in further.items() if words}
        return {**identity(self.lens), "variables": starts, "hold": held, **further}

    def difference(self, before: dict) -> str:
        """The difference of a stored identity from this one, "" where there is none."""
        now = self.identity()
        try:
            if words := other_lens(before, now):
                return words
            if set(before["variables"]) != set(now["variables"]):
                return f"the variables {', '.join(before['variables'])}, not {', '.join(now['variables'])}"
            if not alike(before["hold"], now["hold"]):
                return f"variables of which {before['hold'] or 'nothing'} is held, not {now['hold'] or 'nothing'}"
            for further, joint in (("constraints", " "), ("solves", ", ")):
                if before.get(further) != now.get(further):
                    stored, current = (joint.join(state.get(further, ["none"])) for state in (before, now))
                    return f"variables with the {further} {stored}, not {current}"
            for name, pair in before["variables"].items():
                if not alike(pair, now["variables"][name]):
                    return "{} from {:.9g} in units of {:.9g}, not from {:.9g} in units of {:.9g}".format(
                        name, *pair, *now["variables"][name]
                    )
        except (KeyError, TypeError, ValueError, AttributeError):
            return "a lens of a damaged identity"
        return ""

    @torch.no_grad()
    def numbers(self) -> dict[str, float]:
        """The number of every variable in the lens, by name."""
        numbers = dict(zip((variable.name for variable in self.variables), self._numbers().tolist(), strict=True))
        if self.held is not None:
            numbers[self.held.by.name] = float(self.held.number(self()))
        return {name: numbers[name] for name in self.names}

    def beyond(self) -> str:
        """A solved number beyond its bounds, as a text for an error; "" within them."""
        if self.held is None:
            return ""
        value, (low, high) = self.numbers()[self.held.by.name], self._range(self.held)
        return "" if low <= value <= high else f"{self.held.by.name} would be {value:.6g}, not from {low:g} to {high:g}"

    def _range(self, held: Held) -> tuple[float, float]:
        """Bounds of the solved number; a thickness without any is at least 0."""
        least = 0.0 if held.by.number.quantity == "thickness" else -math.inf
        return self.bounds.get(held.by.name, (least, math.inf))

    @torch.no_grad()
    def project(self) -> None:
        """Move variables to the nearest ones within their bounds that meet the conditions of `hold`, after a step.

        Rays of the rim of every field that fail are brought back; variables that need no gradient do not move. Warns
        NotReached for conditions that are not met.
        """
        frozen = [not self.get_parameter(variable.name).requires_grad for variable in self.variables]
        if all(frozen):
            return
        for variable in self.variables:
            if variable.name in self.bounds:
                low, high = ((end - variable.start) / variable.unit for end in self.bounds[variable.name])
                self.get_parameter(variable.name).clamp_(min(low, high), max(low, high))
        x = self._values()
        with torch.device("cpu"):  # whatever the default device
            held = self._constraints
            nearest = x if held is None else held.nearest(x, self._before, fixed=np.array(frozen))
        for variable, before, after in zip(self.variables, x, nearest, strict=True):
            if after != before:
                self.get_parameter(variable.name).fill_((after - variable.start) / variable.unit)
        self._before = self._values()

    @torch.no_grad()
    def _values(self) -> np.ndarray:
        """The numbers (n,) of the variables that are parameters."""
        return np.array(self._numbers().tolist())

    def _load_from_state_dict(self, *arguments: Any) -> None:
        super()._load_from_state_dict(*arguments)
        self._before = self._values()

    def __getstate__(self) -> dict:
        """The state without the prepared conditions, which a copy prepares again."""
        return {name: part for name, part in vars(self).items() if name not in ("_constraints", "_glasses")}

    def _conditions(self) -> tuple[Condition, ...]:
        """The conditions of `hold` on the lens. Raises BadVariables."""
        words = [word for word in self.conditions if word not in ("buildable", "catalog")]
        try:
            return conditions_in_unit(self.design.lens, words, 1.0)
        except BadHold as error:
            raise BadVariables(str(error)) from error

    @functools.cached_property
    def _constraints(self) -> Constraints | None:
        """The conditions of `hold`, and rays that arrive; None where the sensor alone varies, or the aperture."""
        if not self.conditions and all(name in ("sensor", "aperture") for name in self.names):
            return None
        lower, upper = np.array([self.bounds.get(v.name, (-math.inf, math.inf)) for v in self.variables]).T
        return Constraints(
            self.free,
            self.held_to,
            unit=np.array([abs(variable.unit) for variable in self.variables]),
            lower=lower,
            upper=upper,
            limits=self.further_limits,
        )

    @property
    def further_limits(self) -> FurtherLimits | None:
        """Limits of thicknesses, of the solved number and of glasses; None without any."""
        limits: list[FurtherLimits] = []
        if "buildable" in self.conditions or self.held is not None:
            limits.append(self._excess)
        if "catalog" in self.conditions:
            limits.append(self._glasses)
        return joined_limits(limits)

    @functools.cached_property
    def _glasses(self) -> GlassLimits:
        """The model glasses and those of the catalogs. Raises BadVariables where no glass varies."""
        numbers = self.free.variables
        columns = [(n.surface, GLASS[n.quantity]) if n.quantity in GLASS else None for n in numbers]
        surfaces = dict.fromkeys(column[0] for column in columns if column is not None)
        if not surfaces:
            raise BadVariables(f"no glass varies: name its numbers in {option('vary')}, as index:1,3 abbe_number:1,3")
        lens = self.design.lens
        pool = pool_of(lens, catalogs_of(lens, self.catalog), self.glasses)
        start = {k: lens.surfaces[k].glass.coefficients.numpy()[: pool.count] for k in surfaces}
        return GlassLimits(pool, start, columns)

    @torch.no_grad()
    def snapped(self) -> Lens:
        """The current lens with the nearest glasses of the catalogs instead of its model glasses. Raises BadVariables.

        Train it again without the numbers of the glasses: its image has changed.
        """
        return with_glasses(self(), self._glasses.nearest(self._values()))

    def _excess(self, x: np.ndarray, derivatives: bool) -> tuple[np.ndarray, np.ndarray | None]:
        """Excess (K,) of thicknesses, mm, and of the solved number, in its unit, over their limits at numbers x (n,),
        and its derivatives (K, n)."""
        numbers = torch.tensor(x)
        with torch.set_grad_enabled(derivatives):
            numbers = with_tangents(numbers, torch.eye(len(x), dtype=numbers.dtype)) if derivatives else numbers
            lens = self.free.lens_at(numbers)
            each = [*_shortfalls(lens, self.limits)] if "buildable" in self.conditions else []
            each += self._solved_beyond(lens)
        excess = np.array([float(amount.detach()) for amount in each])
        if not derivatives:
            return excess, None
        slopes = [tangents_of(amount, len(x)).detach().numpy() for amount in each]
        return excess, np.array(slopes).reshape(-1, len(x))

    def violation(self) -> Tensor:
        """`violation` of the limits of the lens, mm², and of the bounds of the solved number, in its units squared."""
        lens = self()
        return sum((e.clamp_min(0).square() for e in self._solved_beyond(lens)), violation(lens, self.limits))

    def _solved_beyond(self, lens: Lens) -> list[Tensor]:
        """Excess of the solved number of a lens over each of its bounds, in its unit."""
        if self.held is None:
            return []
        number, unit = self.held.number(lens), abs(self.held.by.unit)
        low, high = self._range(self.held)
        return [excess / unit for end, excess in ((low, low - number), (high, number - high)) if math.isfinite(end)]


def _design(lens: Lens, vary: str | Sequence[str]) -> DesignVariables:
    """The variables, solves and pickups of variable syntax, without solves of the file, in double precision on the
    processor. Raises BadVariables for numbers that a camera does not vary."""
    if not split_words(vary):
        raise BadVariables("no variables: give sensor, or thickness:…, curvature:…, conic:… with surface numbers")
    lens, data = to(lens, dtype=torch.float64, device="cpu"), lens.optimization_data
    unsolved = None if data is None else dataclasses.replace(data, solves=())
    design = design_variables(dataclasses.replace(lens, optimization_data=unsolved), vary)
    for number in design.variables:
        if number.quantity == "glass" or (number.surface, number.quantity) == (0, "thickness"):
            raise BadVariables(
                f"{option('vary', joined(vary))}: {number.name} is a variable of optimize and jacobian alone"
            )
    return dataclasses.replace(design, lens=dataclasses.replace(design.lens, optimization_data=data))


def _variables(design: DesignVariables, vary: str | Sequence[str]) -> tuple[Variable, ...]:
    """The variables of a design; the last thickness is called "sensor" where the last word for it is. Raises
    BadVariables for a variable that changes nothing."""
    lens, last = design.lens, sensor(design.lens)
    naming = [word for word in split_words(vary) if "=" not in word and Vary(last, "thickness") in varied(lens, word)]
    names = [number.name for number in design.variables]
    if naming and naming[-1] == "sensor":
        names = ["sensor" if name == f"thickness_{last}" else name for name in names]
    numbers = zip(names, design.variables, design.start.tolist(), strict=True)
    return tuple(Variable(name, number, start, _unit(lens, number, start)) for name, number, start in numbers)


def _unit(lens: Lens, number: Vary, start: float) -> float:
    """The unit of a variable of a lens in which it is modelled. Raises BadVariables where the image does not change.

    Units of numbers of the shape follow from the first term of the series z ≈ c r²/2 + (1 + k) c³ r⁴/8 + … at the
    semi-diameter, or at the radius of the entrance pupil where the surface has none.
    """
    quantity = number.quantity
    if quantity == "aperture":
        return _APERTURE * start
    if quantity in _UNITS:
        return _UNITS[quantity]
    surface = lens.surfaces[number.surface]
    edge = surface.semi_diameter or float(first_order(lens).entrance_pupil_diameter) / 2
    if quantity == "curvature":
        moved = edge**2 / 2
    elif quantity == "conic":
        moved = abs(0.0 if surface.curvature is None else float(surface.curvature)) ** 3 * edge**4 / 8
    elif quantity.startswith("tilt_"):
        moved = math.radians(edge)
    else:
        path = path_of(surface, quantity)
        held = number_at(surface, path).detach()
        angle = torch.linspace(0, 2 * math.pi, 33, dtype=held.dtype, device=held.device)
        x, y = edge * torch.cos(angle), edge * torch.sin(angle)
        with torch.enable_grad():
            moving = with_number(surface, path, with_tangents(held, torch.ones_like(held)[None]))
            moved = float(tangents_of(sag_at(moving, x, y), 1).abs().max())
    if moved == 0:
        why = "is flat, and a conic constant" if quantity == "conic" else "has a number that"
        raise BadVariables(f"'{quantity}:{number.surface}': the surface {why} changes nothing there")
    return 1 / moved


# -- variables of an element -------------------------------------------------------------------------------------------


class PhaseVariables(Owned):
    """An element whose numbers are parameters, alone or with others in contact.

        numbers = start + unit · B c      c = `change`, from zero;   without a basis B = 1

    element: the initial design; unit: mm of a change of 1, by default 1 µm, so that learning rates are in µm.
    basis: (numbers..., K) of the heights or coefficients, as `radial_powers`. others: constant elements in contact.
    tolerance: uniform random height error of ± so many mm, resampled with `draw`.
    `state_dict` carries the element of the changes, and loads into that one alone (`Owned`).
    """

    def __init__(
        self,
        element: Element,
        *,
        unit: float = 1e-3,
        basis: Tensor | None = None,
        others: Sequence[Element] = (),
        tolerance: float = 0.0,
    ):
        super().__init__()
        self.element, self.unit, self.others, self.tolerance = element, unit, tuple(others), tolerance
        self.start = element.numbers
        self.basis = basis
        shape = self.start.shape if basis is None else basis.shape[-1:]
        if basis is not None and basis.shape[:-1] != self.start.shape:
            raise ValueError(
                f"a basis of {tuple(basis.shape)} for numbers of {tuple(self.start.shape)}: expected "
                f"{(*self.start.shape, 'K')}"
            )
        self.change = nn.Parameter(torch.zeros(shape, dtype=self.start.dtype, device=self.start.device))

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        values = self.element, self.others, self.start, self.basis
        self.element, self.others, self.start, self.basis = converted(values, fn)
        return super()._apply(fn, recurse)

    def identity(self) -> dict:
        """The element: its profile, shape, glass, aperture in mm, the unit in mm; digests of its initial numbers, the
        basis, its glass and the elements in contact."""
        return {
            "profile": type(self.element.profile).__name__,
            "numbers": list(self.start.shape),
            "glass": self.element.glass.name,
            "aperture": 2 * float(self.element.radius.detach()),
            "unit": self.unit,
            "start": digest(self.start),
            "basis": digest(self.basis),
            "material": digest(self.element.glass),
            "others": digest(self.others),
        }

    def difference(self, before: dict) -> str:
        """The difference of a stored identity from this one, "" where there is none."""
        for name, value in self.identity().items():
            stored = before.get(name)
            if not alike(stored, value):
                is_digest = name in ("start", "basis", "material", "others")
                return "an element of " + (f"other {name}" if is_digest else f"{name} {stored}, not {value}")
        return ""

    def numbers(self) -> Tensor:
        """Current heights or coefficients, mm."""
        change = self.change if self.basis is None else self.basis @ self.change
        return self.start + self.unit * change

    def forward(self, *, draw: torch.Generator | None = None) -> tuple[Element, ...]:
        """The current element, and those in contact; draw: generator of errors of fabrication."""
        numbers = self.numbers()
        if draw is not None and self.tolerance:
            error = torch.rand(numbers.shape, generator=draw, dtype=numbers.dtype, device=numbers.device)
            numbers = numbers + self.tolerance * (2 * error - 1)
        return (self.element.with_numbers(numbers), *self.others)

"""Model: the numbers of a lens, in all its configurations, as functions of the variables of an optimisation.

What a variable moves, what follows by a solve or a pickup, and where the tables of the compiled trace hold it, is found
once; a `LensState` is the lens at given variables.
"""

import dataclasses
from collections.abc import Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from raytrace.optimization.lens_state import LensState
from raytrace.optimization.variables import GLASS, Address, UnknownNumber, names_at, path_of, with_numbers_of
from raytrace.system.lens import Lens, is_round_about_axis, media
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import ParameterPath, number_at, parameter_paths
from raytrace.system.phases import power_of
from raytrace.system.surface import gap_behind, medium_surfaces, vertex_curvature
from raytrace.tracing.compiled import structure_of
from raytrace.tracing.paraxial import signed
from raytrace.tracing.trace import sequence_of

#: Numbers that a surface keeps at 0 as None.
_AT_ZERO = ("curvature", "conic")

#: Power of length of what a pickup between configurations adds.
_POWERS = {"thickness": 1, "curvature": -1}


@dataclasses.dataclass(frozen=True)
class Model:
    """A lens whose variables move.

    lens: as it is at the start; variables, solves: of `OptimizationData`; opening: the fraction of pupil and field that
    the rays of a merit function fill. Raises UnknownNumber for numbers that it does not have.
    """

    lens: Lens
    variables: tuple[Vary, ...] = ()
    solves: tuple[Solve, ...] = ()
    opening: float = 1.0

    def __post_init__(self):
        for one in (*self.variables, *self.solves):
            if not 0 <= one.surface < len(self.lens.surfaces):
                last = len(self.lens.surfaces) - 1
                raise UnknownNumber(f"{one.quantity} of surface {one.surface}: this lens has surfaces 0 to {last}")
        named = {
            (one.surface, one.quantity) if one.operand is None else (one.operand, one.configuration, "operand")
            for one in self.variables
        }
        if len(named) < len(self.variables):
            raise UnknownNumber("a variable is named twice")
        object.__setattr__(self, "lens", _with_picked_glasses(self.lens, self.variables, self.solves))

    @cached_property
    def views(self) -> tuple["View", ...]:
        """The lens in each of its configurations."""
        return tuple(View(self, number) for number in range(1, len(self.lens.configurations) + 1))

    @cached_property
    def start(self) -> np.ndarray:
        """The variables (n,) as they stand."""
        return np.array([self._standing(one) for one in self.variables])

    def _standing(self, one: Vary) -> float:
        if one.operand is not None:
            return float(self.lens.operands[one.operand].numbers[one.configuration - 1])
        held = number_at(self.lens.surfaces[one.surface], self._place(one))
        return 0.0 if held is None else float(held)

    def _place(self, one: Vary | Solve) -> ParameterPath:
        return path_of(self.lens.surfaces[one.surface], one.quantity, f"surface {one.surface}: ")

    def lens_at(self, variables: np.ndarray) -> Lens:
        """The lens with its variables there, and with all that follows from them."""
        lens = self.lens
        like = lens.wavelengths
        operands = list(lens.operands)
        for configuration in range(1, len(self.lens.configurations) + 1) if operands else ():
            for k, (variable, scale, offset) in followed(self, configuration).items():
                numbers = operands[k].numbers.clone()
                numbers[configuration - 1] = scale * float(variables[variable]) + offset
                operands[k] = dataclasses.replace(operands[k], numbers=numbers)
        lens = dataclasses.replace(lens, operands=tuple(operands)) if operands else lens
        current = self.views[lens.current_configuration - 1]
        numbers = current.state(np.asarray(variables, dtype=float)).numbers
        there = {at: like.new_tensor(float(n), dtype=torch.float64) for at, n in numbers.items()}
        return with_numbers_of(lens, there)


class View:
    """A lens in one configuration: what of it moves, and what stays."""

    def __init__(self, model: Model, configuration: int, *, clips: bool = False):
        """clips: whether apertures clip rays; else those that a merit function names count wherever they go."""
        self.model, self.configuration = model, configuration
        lens = model.lens.configuration(configuration) if model.lens.operands else model.lens
        lens = lens if clips else _open(lens)
        overridden = _overridden(lens)
        #: By address which variable a number is, by what factor, and what is added.
        self.variables: dict[Address, tuple[int, float, float]] = _of_operands(model, configuration)
        for number, one in enumerate(model.variables):
            if one.operand is None and (one.surface, one.quantity) not in overridden:
                self.variables[one.surface, one.quantity] = number, 1.0, 0.0
        own = [one for one in model.solves if one.operand is None and (one.surface, one.quantity) not in overridden]
        own = [one for one in own if one.quantity == "glass" or not self._is_idle(one, lens)]
        own = _with_glasses(own, self.variables)
        self.solves = sorted(own, key=lambda one: (one.surface, one.quantity == "thickness"))
        moved = (*self.variables, *((one.surface, one.quantity) for one in self.solves))
        self.moved: tuple[Address, ...] = tuple(dict.fromkeys(moved))
        self.lens = _modelled(lens, self.moved)
        self.stored = {at: self.number(at) for at in self.moved}
        surfaces = self.lens.surfaces
        self._held = {(k, quantity): path_of(surfaces[k], quantity) for k, quantity in self.moved}

    def _is_idle(self, one: Solve, lens: Lens) -> bool:
        """Whether a pickup is of a number that does not vary, and that the lens does not model, for it is 0."""
        at = [(one.source, one.quantity_of_source or one.quantity), (one.surface, one.quantity)]
        known = all(quantity in ("thickness", *parameter_paths(lens.surfaces[surface])) for surface, quantity in at)
        return one.kind == "pickup" and not known and at[0] not in self.variables

    @cached_property
    def clipping(self) -> "View":
        """The same with its apertures."""
        return View(self.model, self.configuration, clips=True)

    @cached_property
    def waits(self) -> bool:
        """Whether a solve waits for others that come later, or for the entrance pupil that it moves itself."""
        solved = {(one.surface, one.quantity): position for position, one in enumerate(self.solves)}

        def is_late(position: int, one: Solve) -> bool:
            if one.kind == "pickup":
                return solved.get((one.source, one.quantity_of_source or one.quantity), -1) >= position
            if one.kind in ("power", "position"):
                return one.source > one.surface
            if one.kind == "edge_thickness":
                shape = [
                    at for surface, quantity in solved if (at := quantity) != "thickness" and surface > one.surface
                ]
                return bool(shape) or not any(one.numbers[1:])
            return one.surface < self.lens.stop or self.lens.aperture.kind in (
                "image_f_number",
                "paraxial_working_f_number",
            )

        return any(is_late(*found) for found in enumerate(self.solves))

    def number(self, at: Address) -> float:
        """A number of the lens as it is stored."""
        surface, quantity = at
        held = number_at(self.lens.surfaces[surface], path_of(self.lens.surfaces[surface], quantity))
        return 0.0 if held is None else float(held)

    @cached_property
    def wavelengths(self) -> list[float]:
        return self.lens.wavelengths.tolist()

    @cached_property
    def indices(self) -> np.ndarray:
        """Signed index (W, S) behind every surface, the object first."""
        n = signed(self.lens.surfaces[1:], media(self.lens, self.lens.wavelengths))
        return np.stack([x.detach().numpy() for x in n], -1)

    @cached_property
    def media(self) -> list[int]:
        """The surface whose glass fills the space behind each surface."""
        return medium_surfaces(self.lens.surfaces)

    @cached_property
    def glasses(self) -> dict[int, list[Address]]:
        """What moves of the media, by the surface that tells them."""
        found: dict[int, list[Address]] = {}
        for surface, quantity in self.moved:
            if quantity in GLASS:
                found.setdefault(surface, []).append((surface, quantity))
        return found

    @cached_property
    def thickness(self) -> list[float]:
        return [float(surface.thickness.detach()) for surface in self.lens.surfaces]

    @cached_property
    def curvature(self) -> list[float]:
        return [
            0.0 if surface.curvature is None else float(surface.curvature.detach()) for surface in self.lens.surfaces
        ]

    @cached_property
    def further_power(self) -> tuple[np.ndarray, np.ndarray]:
        """What bends light beside the curvature: the vertex by terms of r² (S,) in 1/mm, phases (W, S) in 1/mm."""
        bend, phase = np.zeros(len(self.lens.surfaces)), np.zeros_like(self.indices)
        for k, surface in enumerate(self.lens.surfaces):
            if k == 0 or surface.is_break:
                continue
            bend[k] = float(vertex_curvature(surface).detach()) - self.curvature[k]
            if surface.phase is not None:
                phase[:, k] = power_of(surface.phase, self.lens.wavelengths)[1].detach().numpy()
        return bend, phase

    @cached_property
    def is_symmetric(self) -> bool:
        """Whether all of it is round about one axis."""
        return is_round_about_axis(self.lens)

    @cached_property
    def is_plain(self) -> bool:
        """Whether all first-order data follow from thicknesses and curvatures alone."""
        with torch.enable_grad():
            numbers, lens = self.leaves()
            powers = [vertex_curvature(s).reshape(()) for s in lens.surfaces if s.curvature is not None or s.is_plane]
            phases = [power_of(s.phase, lens.wavelengths)[1].sum() for s in lens.surfaces if s.phase is not None]
            plain = "curvature", "thickness", *GLASS
            others = [n for (_, quantity), n in numbers.items() if quantity not in plain]
            total = sum([p for p in (*powers, *phases) if p.requires_grad], torch.zeros((), dtype=torch.float64))
            if not others or not total.requires_grad:
                return True
            found = torch.autograd.grad(total, others, allow_unused=True)
        return all(g is None or not bool(g.any()) for g in found)

    def leaves(self, values: dict[Address, float] | None = None) -> tuple[dict[Address, Tensor], Lens]:
        """What moves, as tensors that require a gradient, and the lens that holds them."""
        values = self.stored if values is None else values
        numbers = {at: torch.tensor(float(n), dtype=torch.float64, requires_grad=True) for at, n in values.items()}
        return numbers, self.held(numbers)

    def held(self, numbers: dict[Address, Tensor]) -> Lens:
        """The lens with other numbers."""
        return with_numbers_of(self.lens, numbers, self._held)

    def table_of(self, last: int, lens: Lens, indices: dict[int, Tensor] | None = None):
        """The structure of the surfaces 1 to `last`, and the table (W, K) of their numbers.

        Rays on the image have the direction in front of it: the image does not refract.

        indices: (W,) of media by the surface in front of each, instead of the indices of the lens.
        """
        wavelength = lens.wavelengths[:, None]
        surfaces = sequence_of(lens)[:last]
        given = indices or {}
        indices = [
            given[surface][:, None] if surface in given else n
            for surface, n in zip(self.media[: last + 1], media(lens, wavelength), strict=False)
        ]
        indices = unbent(lens, indices)
        gap = gap_behind(lens.surfaces[0]) if lens.surfaces[0].after is not None else None
        structure, table = structure_of(surfaces, indices, 1, gap, wavelength)
        rows = [torch.broadcast_to(n[..., 0] if n.dim() else n, wavelength.shape[:1]) for n in table]
        return surfaces, structure, torch.stack(rows, -1)

    def state(self, variables) -> LensState:
        return LensState(self, variables)


def _of_operands(model: Model, configuration: int) -> dict[Address, tuple[int, float, float]]:
    """What variables of the operands move in a configuration: their own numbers, those that pick them up, and both of
    operands that pick up the number of another configuration."""
    found = {}
    for operand, (number, scale, offset) in followed(model, configuration).items():
        for place in model.lens.operands[operand].paths:
            if place.path[0] == "surfaces":
                surface = model.lens.surfaces[place.path[1]]
                linear = number, place.factor * scale, place.factor * offset + place.offset
                found |= {(place.path[1], name): linear for name in names_at(surface, place.path[2:])}
    return found


def followed(model: Model, configuration: int) -> dict[int, tuple[int, float, float]]:
    """By operand that moves in a configuration: which variable moves it, by what factor, and what is added to it.

    A pickup of another configuration is scale · (number there) + offset, and that may be one, too.
    """
    moved = {
        (one.operand, one.configuration): (number, 1.0, 0.0)
        for number, one in enumerate(model.variables)
        if one.operand is not None
    }
    pickups = [one for one in model.solves if one.operand is not None and one.kind == "pickup" and one.numbers]
    for _ in pickups:
        for one in pickups:
            source, at = (int(one.numbers[0]), one.source), (one.operand, one.configuration)
            if source in moved and at not in moved:
                number, scale, offset = moved[source]
                added = (
                    one.offset * model.lens.optimization_data.unit ** _POWERS.get(one.quantity, 0)
                    if model.lens.optimization_data
                    else 0.0
                )
                moved[at] = number, one.scale * scale, one.scale * offset + added
    return {operand: linear for (operand, at), linear in moved.items() if at == configuration}


def _with_picked_glasses(lens: Lens, variables: Sequence[Vary], solves: Sequence[Solve]) -> Lens:
    """The lens whose pickups of glasses that vary have the glass that they pick up."""
    moved, surfaces = {one.surface for one in variables if one.quantity in GLASS}, list(lens.surfaces)
    pickups = [one for one in solves if (one.quantity, one.kind) == ("glass", "pickup")]
    for one in sorted(pickups, key=lambda one: one.surface):
        if one.source in moved:
            glass = surfaces[one.source].glass
            surfaces[one.surface] = dataclasses.replace(surfaces[one.surface], glass=glass)
            moved.add(one.surface)
    return dataclasses.replace(lens, surfaces=tuple(surfaces)) if pickups else lens


def _with_glasses(solves: Sequence[Solve], variables: dict) -> list[Solve]:
    """Pickups of glasses as those of the numbers that vary of the glass that is picked up."""
    moved, found = set(variables), []
    for one in sorted(solves, key=lambda one: one.surface):
        if one.quantity != "glass":
            found.append(one)
            continue
        names = [name for name in GLASS if (one.source, name) in moved]
        moved |= {(one.surface, name) for name in names}
        found += [Solve(one.surface, name, "pickup", source=one.source) for name in names]
    return found


def unbent(lens: Lens, indices: list) -> list:
    """Indices behind the first surfaces of a lens, the object's first; behind the image as before it."""
    return [*indices[:-1], indices[-2]] if len(indices) == len(lens.surfaces) else indices


def _overridden(lens: Lens) -> set[Address]:
    """What operands of the configurations hold: there the surface's own variable or solve is void."""
    found = set()
    for operand in lens.operands:
        for place in operand.paths:
            if place.path[0] == "surfaces" and operand.numbers is not None:
                found |= {(place.path[1], name) for name in names_at(lens.surfaces[place.path[1]], place.path[2:])}
    return found


def _open(lens: Lens) -> Lens:
    """The lens without apertures: a ray that a merit function names counts also where it is clipped."""
    return dataclasses.replace(lens, surfaces=tuple(dataclasses.replace(s, apertures=()) for s in lens.surfaces))


def _modelled(lens: Lens, moved: Sequence[Address]) -> Lens:
    """The lens with what moves modelled, also where it is 0 now."""
    surfaces = list(lens.surfaces)
    for surface, quantity in moved:
        if quantity in _AT_ZERO and getattr(surfaces[surface], quantity) is None:
            zero = torch.zeros_like(surfaces[surface].thickness)
            surfaces[surface] = dataclasses.replace(surfaces[surface], **{quantity: zero})
    return dataclasses.replace(lens, surfaces=tuple(surfaces))

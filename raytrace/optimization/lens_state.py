"""Design variables: a lens as a function of its variables, and the fast path of an optimisation through it.

`DesignVariables` are a lens with its variables and solves, `lens_at` the lens at any of their values; a `View` is one
configuration of it, a `LensState` the view at given variables: its numbers, first-order data and rays, with
derivatives. Numbers are plain, or dual (`maths.numerics`) where derivatives are computed, or the tensors of
`DesignVariables.lens_at`; the formulas are the same. SOLVES computes the numbers of a lens that follow from others, at
the primary wavelength; n is signed, ω = n u.

A `Bundle` launches and traces all rays of a merit function's rows in one pass. Rays start as in `tracing.launch`. Rays
that depend on the lens only through its first-order data are launched and aimed in numpy: 126 rays and 21 variables
take 1.4 ms with derivatives, compared with 9 ms of `rt.jacobian` by `tracing.launch` and tensors that carry them; 4 ms
compared with 25 ms with real ray aiming. `tracing.launch` launches all others (real image heights, telecentric objects,
curved objects, bent axes).

Ray aiming solves s(a, x) = p r(x) for the pupil points a, s the hit on the stop, p the point of the pupil, r the radius
of the stop: by Newton's method from the last solution, and ∂a/∂x = (∂s/∂a)⁻¹ (p ∂r/∂x - ∂s/∂x).
"""

import copy
import dataclasses
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any, NamedTuple, TypeAlias, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import Dual, Number, Vector, dot, is_any, slope_of, value_of
from raytrace.maths.tangents import tangents_of, with_tangents
from raytrace.system.configurations import Operand, ScaledPath, with_entry, with_operands
from raytrace.system.expansion import growth, in_contact, is_solid
from raytrace.system.lens import Lens, index_behind, is_round_about_axis, media, per_lens, temperature_of
from raytrace.system.optimization_data import Solve, Vary
from raytrace.system.parameter_paths import (
    GLASS,
    GLASS_NUMBER,
    OF_LENS,
    PRESSURE,
    TEMPERATURE,
    Address,
    UnknownNumber,
    modelled,
    names_at,
    parameter_paths,
    path_of,
    sensor,
    stored_number,
    with_numbers_of,
)
from raytrace.system.phases import power_of
from raytrace.system.rays import Rays
from raytrace.system.shapes import EVEN
from raytrace.system.surface import Surface, is_flat, medium_surfaces, power, sag_at, signed, vertex_curvature
from raytrace.tracing.compiled import Task, is_expressible, rows_of, structure_of
from raytrace.tracing.geometry import contact_heights, edge_thickness, semi_diameter, with_thermal_numbers
from raytrace.tracing.launch import path_from_point, path_towards_lens, rays_of_field, vignette
from raytrace.tracing.paraxial import CONES, Gaussian, brackets, field_scale, gaussian
from raytrace.tracing.trace import (
    aiming_of,
    ends,
    is_bent,
    pushed,
    pushed_everywhere,
    rays_at,
    sequence_of,
    trace_surfaces,
    without_apertures,
)

Kept = TypeVar("Kept")
Pair: TypeAlias = tuple[Number, Number]
#: Position and direction, three arrays or dual numbers (W, R) each, path and validity (W, R).
Launch: TypeAlias = tuple[Sequence[Number], Sequence[Number], Number, np.ndarray]
#: Columns of a table of numbers by the address of the number, or by the surface before a medium.
Columns: TypeAlias = dict[Address | int, np.ndarray]

# -- the lens as a function of its variables ---------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class DesignVariables:
    """The numbers of a lens that move, in all its configurations, and the lens at any of their values.

    lens: at the start, where all these numbers are modelled, also those that are 0; variables, solves: of
    `OptimizationData`; opening: the fraction of pupil and field that the rays of a merit function fill. Raises
    UnknownNumber for numbers that the lens does not have.
    """

    lens: Lens
    variables: tuple[Vary, ...] = ()
    solves: tuple[Solve, ...] = ()
    opening: float = 1.0

    def __post_init__(self) -> None:
        numbers: tuple[Vary | Solve, ...] = (*self.variables, *self.solves)
        for number in numbers:
            if not 0 <= number.surface < len(self.lens.surfaces):
                last = len(self.lens.surfaces) - 1
                raise UnknownNumber(
                    f"{number.quantity} of surface {number.surface}: this lens has surfaces 0 to {last}"
                )
        moved: set[tuple] = {
            variable.address if variable.operand is None else (variable.operand, variable.configuration, "operand")
            for variable in self.variables
        }
        if len(moved) < len(self.variables):
            raise UnknownNumber("a variable is named twice")
        lens = _with_picked_glasses(self.lens, self.variables, self.solves)
        object.__setattr__(self, "lens", with_thermal_numbers(lens, self.solves))

    @cached_property
    def views(self) -> tuple["View", ...]:
        """The lens in each of its configurations."""
        return tuple(View(self, number) for number in range(1, len(self.lens.configurations) + 1))

    @cached_property
    def start(self) -> np.ndarray:
        """The current variables (n,)."""
        return np.array(
            [
                stored_or_0(self.lens, variable.address)
                if variable.operand is None
                else float(_numbers_of(self.lens.operands[variable.operand])[variable.configuration - 1])
                for variable in self.variables
            ]
        )

    def lens_at(self, variables: Tensor | np.ndarray, lens: Lens | None = None) -> Lens:
        """The lens at variables (n,), or L lenses at (L, n), with solves and pickups.

        lens: the same lens in the dtype and on the device of the variables, if they differ.

        Differentiable to first and second order by tensors: by their graph, by transforms of torch.func, and by
        tensors that carry derivatives (`maths.tangents`). Numbers of L lenses are (L, 1, 1, 1), as of `perturbed`.
        """
        lens = lens or self.lens
        if not isinstance(variables, Tensor):
            variables = lens.wavelengths.new_tensor(variables, dtype=torch.float64)
        each, operands = tuple(map(per_lens, variables.unbind(-1))), list(lens.operands)
        for configuration in range(1, len(lens.configurations) + 1) if operands else ():
            for k, (variable, scale, offset) in followed(self, configuration).items():
                number = scale * each[variable] + offset
                changed = with_entry(_numbers_of(operands[k]), (configuration - 1,), number)
                operands[k] = dataclasses.replace(operands[k], numbers=changed)
        view = self.views[lens.current_configuration - 1]
        lens = dataclasses.replace(lens, operands=tuple(operands))
        numbers = LensState(view, each, lens).tensors() if view.solves else view.numbers(each)
        return with_thermal_numbers(with_numbers_of(lens, numbers, view.places), self.solves)

    @cached_property
    def growths(self) -> dict[Solve, tuple[list[float], list[float]]]:
        """Factors of surfaces and of media, as of `expansion.growth`, from the source of a thermal pickup to it."""
        rules = [rule for rule in self.solves if rule.kind == "thermal"]
        factors: dict[tuple[int, int], tuple[list[float], list[float]]] = {}
        for source, configuration in {(rule.source, rule.configuration) for rule in rules}:
            start, here = (with_operands(self.lens, number) for number in (source, configuration))
            faces, behind = growth(start.surfaces, temperature_of(here) - temperature_of(start))
            factors[source, configuration] = [*map(float, faces)], [*map(float, behind)]
        return {rule: factors[rule.source, rule.configuration] for rule in rules}

    def is_of_edges(self, rule: Solve) -> bool:
        """Whether a thermal pickup is that of a space, whose thickness follows from the edges of its surfaces."""
        if (rule.kind, rule.quantity) != ("thermal", "thickness"):
            return False
        surfaces = self.lens.surfaces
        return not is_solid(surfaces[medium_surfaces(surfaces)[rule.surface]].glass)


def _numbers_of(operand: Operand) -> Tensor:
    """The numbers (C,) of an operand that varies."""
    assert operand.numbers is not None
    return operand.numbers


def _with_picked_glasses(lens: Lens, variables: Sequence[Vary], solves: Sequence[Solve]) -> Lens:
    """The lens whose pickups of glasses that vary have the glass that they pick up."""
    moved, surfaces = {variable.surface for variable in variables if variable.quantity in GLASS}, list(lens.surfaces)
    pickups = [solve for solve in solves if (solve.quantity, solve.kind) == ("glass", "pickup")]
    for pickup in sorted(pickups, key=lambda pickup: pickup.surface):
        if pickup.source in moved:
            glass = surfaces[pickup.source].glass
            surfaces[pickup.surface] = dataclasses.replace(surfaces[pickup.surface], glass=glass)
            moved.add(pickup.surface)
    return dataclasses.replace(lens, surfaces=tuple(surfaces)) if pickups else lens


# -- a lens in one configuration ---------------------------------------------------------------------------------------

#: Power of length of the offset of a pickup between configurations.
_POWERS = {"thickness": 1, "curvature": -1}


class View:
    """A lens in one configuration: its numbers that move, and data that stay the same."""

    def __init__(self, model: DesignVariables, configuration: int, *, clips: bool = False) -> None:
        """clips: whether apertures clip rays; the rays of a merit function pass all apertures."""
        self.model, self.configuration = model, configuration
        lens = model.lens.configuration(configuration) if model.lens.operands else model.lens
        if not clips:
            surfaces = tuple(dataclasses.replace(surface, apertures=()) for surface in lens.surfaces)
            lens = dataclasses.replace(lens, surfaces=surfaces)
        #: Numbers that operands of the configurations set: they override variables and solves of the surface.
        operands = (operand for operand in lens.operands if operand.numbers is not None)
        overridden = {address for operand in operands for address, _ in addresses_of(lens, operand)}
        #: By address: the variable that a number follows, its factor and its offset.
        self.variables: dict[Address, tuple[int, float, float]] = _of_operands(model, configuration)
        for number, variable in enumerate(model.variables):
            if variable.operand is None and variable.address not in overridden:
                self.variables[variable.address] = number, 1.0, 0.0
        solves = [solve for solve in model.solves if solve.operand is None and solve.address not in overridden]
        solves = [solve for solve in solves if solve.quantity == "glass" or not self._is_idle(solve, lens)]
        solves = _with_glasses(solves, self.variables)
        solves += [rule for rule in model.growths if rule.configuration == configuration and model.is_of_edges(rule)]
        self.solves = sorted(solves, key=lambda solve: (solve.surface, solve.quantity == "thickness"))
        moved = (*self.variables, *(solve.address for solve in self.solves))
        self.moved: tuple[Address, ...] = tuple(dict.fromkeys(moved))
        changed = list(lens.surfaces)
        for surface, quantity in self.moved:
            changed[surface] = modelled(changed[surface], quantity)
        self.lens = dataclasses.replace(lens, surfaces=tuple(changed))
        self.stored = {address: self.number(address) for address in self.moved}
        #: Where the lens holds the numbers that move.
        self.places = {
            (k, quantity): path_of(self.lens.surfaces[k], quantity)
            for k, quantity in self.moved
            if (k, quantity) not in OF_LENS
        }

    def _is_idle(self, solve: Solve, lens: Lens) -> bool:
        """Whether a pickup follows a number that does not vary and is 0, because the lens does not model it."""
        addresses = [solve.address_of_source, solve.address]
        known = all(
            quantity in ("thickness", *parameter_paths(lens.surfaces[surface])) for surface, quantity in addresses
        )
        return solve.kind == "pickup" and not known and addresses[0] not in self.variables

    @cached_property
    def clipping(self) -> "View":
        """The view with its apertures."""
        return View(self.model, self.configuration, clips=True)

    @cached_property
    def waits(self) -> bool:
        """Whether a solve depends on later solves, or on the entrance pupil, which it moves itself."""
        solved = {solve.address: position for position, solve in enumerate(self.solves)}

        def is_late(position: int, solve: Solve) -> bool:
            if solve.kind == "pickup":
                return solved.get(solve.address_of_source, -1) >= position
            if solve.kind in ("power", "position"):
                return solve.source > solve.surface
            last = sensor(self.lens), "thickness"  # which changes no power
            if solve.kind == "focal_length":
                return any(later.address != last for later in self.solves[position + 1 :])
            if solve.address == last:
                return False
            if solve.kind in ("edge_thickness", "thermal"):
                shapes = any(quantity != "thickness" and surface > solve.surface for surface, quantity in solved)
                return shapes or (solve.kind == "edge_thickness" and not any(solve.numbers[1:]))
            return solve.surface < self.lens.stop or self.lens.aperture.kind in (
                "image_f_number",
                "paraxial_working_f_number",
            )

        return any(map(is_late, range(len(self.solves)), self.solves))

    def numbers(self, variables: Number) -> dict[Address, Number]:
        """The numbers that variables move, without those that are solved."""
        return {
            address: variables[number] if (scale, offset) == (1.0, 0.0) else scale * variables[number] + offset
            for address, (number, scale, offset) in self.variables.items()
        }

    def number(self, address: Address) -> float:
        """A number of the lens as it is stored."""
        return stored_or_0(self.lens, address)

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
        """Addresses of the numbers that change each medium, by the surface in front of it."""
        air = [address for address in (TEMPERATURE, PRESSURE) if address in self.moved]
        moving: dict[int, list[Address]] = {k: [*air] for k in self.media if air}
        for surface, quantity in self.moved:
            if quantity in GLASS or quantity.startswith(GLASS_NUMBER):
                moving.setdefault(surface, []).append((surface, quantity))
        return moving

    @cached_property
    def thickness(self) -> list[float]:
        return [float(surface.thickness.detach()) for surface in self.lens.surfaces]

    @cached_property
    def curvature(self) -> list[float]:
        return [
            0.0 if surface.curvature is None else float(surface.curvature.detach()) for surface in self.lens.surfaces
        ]

    @cached_property
    def of_surfaces(self) -> dict[str, np.ndarray]:
        """Thickness, curvature, conic and even terms a2, a4 … (S,) of all surfaces, 0 where a surface has none."""
        surfaces = self.lens.surfaces
        conics = [0.0 if surface.conic is None else float(surface.conic.detach()) for surface in surfaces]
        numbers = {name: np.array(n) for name, n in (("thickness", self.thickness), ("curvature", self.curvature))}
        terms = [s.coefficients.tolist() if s.coefficients is not None and s.kind == EVEN else [] for s in surfaces]
        for j in range(max(map(len, terms))):
            numbers[f"a{2 * j + 2}"] = np.array([even[j] if j < len(even) else 0.0 for even in terms])
        return numbers | {"conic": np.array(conics)}

    @cached_property
    def further_power(self) -> tuple[np.ndarray, np.ndarray]:
        """Power in addition to the curvature: the vertex by terms of r² (S,) in 1/mm, phases (W, S) in 1/mm."""
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
        """Whether the lens is symmetric about its axis."""
        return is_round_about_axis(self.lens)

    @cached_property
    def is_plain(self) -> bool:
        """Whether all first-order data follow from thicknesses and curvatures alone."""
        plain = "curvature", "thickness", *GLASS
        others = [
            address for address in self.stored if address[1] not in plain and not address[1].startswith(GLASS_NUMBER)
        ]
        units = torch.eye(len(others), dtype=torch.float64)
        numbers = {address: torch.tensor(float(self.stored[address]), dtype=torch.float64) for address in others}
        with torch.enable_grad():
            lens = self.held({address: with_tangents(numbers[address], units[k]) for k, address in enumerate(others)})
            powers = [vertex_curvature(s) for s in lens.surfaces if s.curvature is not None or s.is_plane]
            powers += [power_of(s.phase, lens.wavelengths)[1] for s in lens.surfaces if s.phase is not None]
        return not any(bool(tangents_of(power, len(others)).any()) for power in powers)

    def held(self, numbers: dict[Address, Tensor]) -> Lens:
        """The lens with these numbers instead of its own."""
        return with_numbers_of(self.lens, numbers, self.places)

    def table_of(
        self, last: int, lens: Lens, indices: dict[int, Tensor] | None = None
    ) -> tuple[Sequence[Surface], Any, Tensor]:
        """The structure of the surfaces 1 to `last`, and the table (W, K) of their numbers.

        indices: (W,) of media by the surface in front of each, instead of the indices of the lens.
        """
        wavelength = lens.wavelengths[:, None]
        surfaces = sequence_of(lens)[:last]
        given = indices or {}
        behind = [
            given[surface][:, None] if surface in given else n
            for surface, n in zip(self.media[: last + 1], media(lens, wavelength), strict=False)
        ]
        structure, table = structure_of(surfaces, behind, 1, None, wavelength)
        rows = [torch.broadcast_to(n[..., 0] if n.dim() else n, wavelength.shape[:1]) for n in table]
        return surfaces, structure, torch.stack(rows, -1)

    def state(self, variables: Number) -> "LensState":
        return LensState(self, variables)


def stored_or_0(lens: Lens, address: Address) -> float:
    """A number of a lens as it is stored, 0 where it is not modelled."""
    number = stored_number(lens, address)
    return 0.0 if number is None else float(number)


def _of_operands(model: DesignVariables, configuration: int) -> dict[Address, tuple[int, float, float]]:
    """Variable, factor and offset of the numbers of surfaces that operands move in a configuration, by address."""
    return {
        address: (number, place.factor * scale, place.factor * offset + place.offset)
        for operand, (number, scale, offset) in followed(model, configuration).items()
        for address, place in addresses_of(model.lens, model.lens.operands[operand])
    }


def followed(model: DesignVariables, configuration: int) -> dict[int, tuple[int, float, float]]:
    """The variable, factor and offset of each operand that moves in a configuration.

    A pickup of another configuration is scale · (number there) + offset; the number there may be a pickup itself.
    """
    moved: dict[tuple[int | None, int], tuple[int, float, float]] = {
        (variable.operand, variable.configuration): (number, 1.0, 0.0)
        for number, variable in enumerate(model.variables)
        if variable.operand is not None
    }
    pickups = [
        solve for solve in model.solves if solve.operand is not None and solve.kind == "pickup" and solve.numbers
    ]
    pickups += [
        dataclasses.replace(rule, scale=_grown(rule, *growths), offset=0.0)
        for rule, growths in model.growths.items()
        if not model.is_of_edges(rule)
    ]
    for _ in pickups:
        for pickup in pickups:
            source, place = (int(pickup.numbers[0]), pickup.source), (pickup.operand, pickup.configuration)
            if source in moved and place not in moved:
                number, scale, offset = moved[source]
                added = (
                    pickup.offset * model.lens.optimization_data.unit ** _POWERS.get(pickup.quantity, 0)
                    if model.lens.optimization_data
                    else 0.0
                )
                moved[place] = number, pickup.scale * scale, pickup.scale * offset + added
    here = {operand: linear for (operand, number), linear in moved.items() if number == configuration}
    return {operand: linear for operand, linear in here.items() if operand is not None}


def _grown(rule: Solve, faces: list[float], behind: list[float]) -> float:
    """The factor of a number with a thermal pickup: s of a thickness, 1/s of a curvature, s^(1-n) of a term of r^n."""
    if rule.quantity == "thickness":
        return behind[rule.surface]
    return faces[rule.surface] ** (-1 if rule.quantity == "curvature" else 1 - int(rule.quantity[1:]))


def _with_glasses(solves: Sequence[Solve], variables: Iterable[Address]) -> list[Solve]:
    """The solves, with each pickup of a glass replaced by pickups of the numbers of that glass that vary."""
    moved, expanded = set(variables), []
    for solve in sorted(solves, key=lambda solve: solve.surface):
        if solve.quantity != "glass":
            expanded.append(solve)
            continue
        names = [name for name in GLASS if (solve.source, name) in moved]
        moved |= {(solve.surface, name) for name in names}
        expanded += [Solve(solve.surface, name, "pickup", source=solve.source) for name in names]
    return expanded


def addresses_of(lens: Lens, operand: Operand) -> Iterator[tuple[Address, ScaledPath]]:
    """The numbers of surfaces that an operand of the configurations sets, each with its place."""
    for place in operand.paths:
        if place.path[0] == "surfaces":
            surface = cast(int, place.path[1])
            yield from (((surface, name), place) for name in names_at(lens.surfaces[surface], place.path[2:]))


# -- solves and pickups ------------------------------------------------------------------------------------------------


def _marginal_ray_before(state: "LensState", surface: int) -> tuple[Number, Number]:
    """(y, ω) of the paraxial marginal ray in front of a surface."""
    y, omega = state.marginal_height, state.marginal_height * state.vergence
    if surface == 1:
        return y, omega
    A, B, C, D = state.matrix(1, surface - 1, state.primary, to_next=True)
    return A * y + B * omega, C * y + D * omega


def _pickup(state: "LensState", solve: Solve) -> Number:
    return solve.scale * state.number(*solve.address_of_source) + solve.offset


def _curvature_for(state: "LensState", solve: Solve, omega_behind: Number) -> Number:
    """c = (ω - ω′ - K y)/(y (n′ - n)) behind which the marginal ray has ω′; K: power of the surface without c."""
    k, n = solve.surface, state.index(state.primary)
    y, omega = _marginal_ray_before(state, k)
    return ((omega - omega_behind) / y - state.further_power(k, state.primary)) / (n[k] - n[k - 1])


def _marginal_angle(state: "LensState", solve: Solve) -> Number:
    return _curvature_for(state, solve, state.index(state.primary)[solve.surface] * solve.numbers[0])


def _f_number(state: "LensState", solve: Solve) -> Number:
    return _curvature_for(state, solve, -abs(state.index(state.primary)[solve.surface]) / (2 * solve.numbers[0]))


def _marginal_height(state: "LensState", solve: Solve) -> Number:
    """t = n′ (h - y)/ω′ behind the surface, of the paraxial ray, or of the real one through a part of the pupil."""
    if any(solve.numbers[1:]):
        return state.through_torch(lambda lens: [_real_height(lens, solve)])[0]
    k, primary = solve.surface, state.primary
    y, omega = _marginal_ray_before(state, k)
    return state.index(primary)[k] * (solve.numbers[0] - y) / (omega - state.power(k, primary) * y)


def _real_height(lens: Lens, solve: Solve) -> Tensor:
    """t = z + (N/M)(h - y) - z′(h) with which a real axial ray meets the next surface at the height h, or nan."""
    k, (height, part) = solve.surface, solve.numbers
    like = lens.wavelengths
    rays = rays_of_field(lens, like.new_zeros(2), like.new_tensor([0.0, part]), wavelength=lens.primary)
    (rays,) = rays_at(lens, lens.primary, (k,))(rays)
    (_, y, z), (_, M, N) = rays.position, rays.direction
    crosses = rays.valid & (M != 0)
    ratio = N / torch.where(crosses, M, torch.ones_like(M))
    y_next = z.new_tensor(height)
    thickness = z + ratio * (y_next - y) - sag_at(lens.surfaces[k + 1], torch.zeros_like(y_next), y_next)
    return torch.where(crosses, thickness, torch.nan)


def _edge_thickness(state: "LensState", solve: Solve) -> Number:
    """t = e + z - z′ of both surfaces at one height, by default the semi-diameter of the first."""
    k, (edge, height) = solve.surface, solve.numbers

    def thickness(lens: Lens) -> list[Tensor]:
        y = lens.wavelengths.new_tensor(height) if height else semi_diameter(lens, k)
        near, far = (sag_at(surface, torch.zeros_like(y), y) for surface in lens.surfaces[k : k + 2])
        return [edge - edge_thickness(0.0, near, far)]

    return state.through_torch(thickness)[0]


def _thermal(state: "LensState", solve: Solve) -> Number:
    """t′ = σ t + σ (z₂ - z₁) - (z₂′ - z₁′) of a space, t that of its source; z(h) = z′(s h)/s of a face grown by s."""
    model, k = state.view.model, solve.surface
    faces, behind = model.growths[solve]
    σ, operand = behind[k], cast(int, solve.operand)
    start = with_operands(model.lens, solve.source)
    heights = contact_heights(start, in_contact(start.surfaces))

    def from_edges(lens: Lens) -> list[Tensor]:
        step = lens.surfaces[k].thickness.new_zeros(())
        for j, sign in ((k, -1.0), (k + 1, 1.0)):
            if j in heights:
                surface, h, s = lens.surfaces[j], heights[j], faces[j]
                cold, hot = (sag_at(surface, torch.zeros_like(h), grown * h) for grown in (s, σ))
                step = step + sign * (σ / s * cold - hot)
        return [step]

    moved = followed(model, solve.source)
    source: Number = float(_numbers_of(model.lens.operands[operand])[solve.source - 1])
    if operand in moved:
        number, scale, offset = moved[operand]
        source = scale * state.variables[number] + offset
    return σ * source + state.through_torch(from_edges)[0]


def _power(state: "LensState", solve: Solve) -> Number:
    """c = P/(n′ - n) of the power that a surface has by its curvature."""
    k, n = solve.surface, state.index(state.primary)
    return solve.numbers[0] / (n[k] - n[k - 1])


def _position(state: "LensState", solve: Solve) -> Number:
    """The thickness that completes the sum of thicknesses between surface `source` and this one."""
    k, source = solve.surface, solve.source
    others = range(source, k) if source <= k else range(k + 1, source)
    return solve.numbers[0] - sum(state.thickness[j] for j in others)


def _focal_length(state: "LensState", solve: Solve) -> Number:
    """v with φ(0) + v [φ(1) - φ(0)] = |n′|/f: by Gauss's brackets the power φ of a lens is linear in each curvature and
    thickness v. It is finite where the lens is afocal."""
    powers: list[Number] = []
    for number in (0.0, 1.0):
        state.numbers[solve.address] = number
        state.forget()
        powers.append(-state.gaussian(state.primary).C)
    wanted = abs(state.index(state.primary)[-2]) / solve.numbers[0]
    return (wanted - powers[0]) / (powers[1] - powers[0])


#: The number of a state that a solve sets, by kind.
SOLVES: dict[str, Callable[["LensState", Solve], Number]] = {
    "pickup": _pickup,
    "marginal_angle": _marginal_angle,
    "f_number": _f_number,
    "marginal_height": _marginal_height,
    "edge_thickness": _edge_thickness,
    "power": _power,
    "position": _position,
    "focal_length": _focal_length,
    "thermal": _thermal,
}


_PASSES = 60  # through solves that depend on one another
_CONVERGED = 5  # units of rounding
_SLOPES = 1e-12  # relative to the largest derivative of a number
_FREE = 1e-9  # |1 - ∂P/∂s| of solves that leave a number free

#: Attributes that define a state; all others are computed from them.
_GIVEN = {"view", "lens", "variables", "numbers", "_kept"}


class LensState:
    """A view at given variables: numbers, first-order data and rays of the lens, with derivatives.

    variables: (n,) numbers, a Dual of them, or a tuple of tensors, () or (L, 1, 1, 1). lens: with
    tensors, the lens of the view in their dtype and on their device.
    """

    def __init__(self, view: View, variables: Number, lens: Lens | None = None) -> None:
        self.view, self.lens, self.variables = view, lens or view.lens, variables
        self.numbers = view.numbers(variables)
        self._kept: dict[tuple, Any] = {}
        if view.solves:
            self._solve()

    @property
    def is_of_tensors(self) -> bool:
        return isinstance(self.variables, tuple)

    @property
    def count(self) -> int:
        """The number of variables with derivatives; 0 of a state without derivatives."""
        return len(self.variables.slope) if isinstance(self.variables, Dual) else 0

    def fixed(self) -> "LensState":
        """The state without derivatives."""
        return LensState(self.view, value_of(self.variables)) if self.count else self

    def number(self, surface: int, quantity: str) -> Number:
        """A number of a surface: solved, picked up, varied or stored."""
        number = self.numbers.get((surface, quantity))
        return self.view.number((surface, quantity)) if number is None else number

    @cached_property
    def thickness(self) -> list[Number]:
        """mm behind every surface, the object's first."""
        return self._listed("thickness", self.view.thickness)

    @cached_property
    def curvature(self) -> list[Number]:
        """1/mm of every surface, terms of r² left out."""
        return self._listed("curvature", self.view.curvature)

    @cached_property
    def vertex_curvature(self) -> list[Number]:
        """1/mm of every surface at its vertex, terms of r² included."""
        if self.view.is_plain:
            return [c + bend for c, bend in zip(self.curvature, self.view.further_power[0], strict=True)]
        return self.through_torch(lambda lens: [vertex_curvature(surface) for surface in lens.surfaces])

    def of_surfaces(self, quantity: str) -> np.ndarray | Dual:
        """A number (S,) of all surfaces, of `View.of_surfaces`; 0 where a surface has none."""
        stored = self.view.of_surfaces
        values = (stored[quantity] if quantity in stored else 0.0 * stored["conic"]).copy()
        slopes: np.ndarray | None = None
        for (surface, name), number in self.numbers.items():
            if name == quantity:
                values[surface] = value_of(number)
                if isinstance(number, Dual):
                    slopes = np.zeros((self.count, len(values))) if slopes is None else slopes
                    slopes[:, surface] = number.slope
        return values if slopes is None else Dual(values, slopes)

    def _listed(self, quantity: str, stored: list[float]) -> list[Number]:
        numbers: list[Number] = list(stored)
        for (surface, name), number in self.numbers.items():
            if name == quantity:
                numbers[surface] = number
        return numbers

    def index(self, wavelength: int) -> Number:
        """Signed index behind every surface at a wavelength, counted from 0."""
        stored = self.view.indices[wavelength]
        if not self.view.glasses:
            return stored
        pairs = zip(stored, self.view.media, strict=True)
        return [np.sign(n) * self.media[k][wavelength] if k in self.media else n for n, k in pairs]

    @cached_property
    def media(self) -> dict[int, Number]:
        """Indices (W,) of variable media, by the surface in front of them; of tensors (W, ...)."""
        glasses = self.view.glasses
        if not glasses:
            return {}
        moved = [address for addresses in glasses.values() for address in addresses]
        axes = max((number.dim() for number in self.variables), default=0) if self.is_of_tensors else 0
        waves = self.lens.wavelengths.reshape(-1, *[1] * axes)
        indices = self.in_one_pass(lambda lens: [index_behind(lens, k, waves) for k in glasses], only=moved)
        return dict(zip(glasses, indices, strict=True))

    def power(self, k: int, wavelength: int) -> Number:
        """Power in 1/mm of a surface."""
        if not self.view.is_plain:
            return self.kept(_powers, wavelength)[k - 1]
        n = self.index(wavelength)
        return self.curvature[k] * (n[k] - n[k - 1]) + self.further_power(k, wavelength)

    def further_power(self, k: int, wavelength: int) -> Number:
        """Power in 1/mm of a surface in addition to c Δn: of terms of r² and of a phase."""
        n = self.index(wavelength)
        if not self.view.is_plain:
            return self.power(k, wavelength) - self.curvature[k] * (n[k] - n[k - 1])
        bend, phase = self.view.further_power
        return bend[k] * (n[k] - n[k - 1]) + phase[wavelength, k] if bend[k] else phase[wavelength, k]

    def matrix(self, first: int, last: int, wavelength: int, *, to_next: bool = False) -> tuple[Number, ...]:
        """(A, B, C, D) from the vertex of a surface, before it, to behind another, or to the vertex after that."""
        n = self.index(wavelength)
        steps = range(first, last + 1)
        gaps = [self.thickness[k] / n[k] for k in (steps if to_next else steps[:-1])]
        return brackets([self.power(k, wavelength) for k in steps], gaps)

    def gaussian(self, wavelength: int) -> Gaussian:
        """The system matrices at a wavelength."""
        return self.kept(_gaussian, wavelength)

    def kept(self, function: Callable[..., Kept], *arguments: Any) -> Kept:
        """function(state, *arguments), computed once."""
        key = function, *arguments
        if key not in self._kept:
            self._kept[key] = function(self, *arguments)
        return self._kept[key]

    @property
    def primary(self) -> int:
        return self.lens.primary_wavelength - 1

    # -- the beam ------------------------------------------------------------------------------------------------------

    @cached_property
    def vergence(self) -> Number:
        """n / object distance at the primary wavelength, 0 for an object at infinity."""
        return self.vergence_at(self.primary)

    def vergence_at(self, wavelength: int) -> Number:
        return self.index(wavelength)[0] / self.object_distance

    @property
    def is_at_infinity(self) -> bool:
        return bool(np.isinf(value_of(self.thickness[0])))

    @cached_property
    def field_scale(self) -> Number:
        """Slope or object height in mm per tan θ or mm of the fields, as `paraxial.field_scale`."""
        data, at_infinity = self.gaussian(self.primary), self.is_at_infinity
        return field_scale(
            self.lens.fields.kind,
            at_infinity=at_infinity,
            distance=self.thickness[0],
            entrance_pupil=data.entrance_pupil_position,
            power=-data.C / data.n_object,
            magnification=None if at_infinity else data.magnification(self.vergence),
        )

    @property
    def object_distance(self) -> Number:
        distance = self.thickness[0]
        return np.finfo(float).tiny ** 0.5 if isinstance(distance, float) and distance == 0 else distance

    @cached_property
    def entrance_pupil_diameter(self) -> Number:
        """mm, of the aperture of the lens at the primary wavelength."""
        kind, data = self.lens.aperture.kind, self.gaussian(self.primary)
        number, distance = self.number(0, "aperture"), self.thickness[0]
        return data.entrance_pupil_diameter(kind, number, distance, self.vergence, self.tan_cone)

    @property
    def tan_cone(self) -> Number:
        """Tangent of the half angle of the cone at the object, of an aperture that is specified as one."""
        kind, number = self.lens.aperture.kind, self.number(0, "aperture")
        if kind not in CONES:
            return None
        number = number / self.index(self.primary)[0] if kind == "object_na" else number
        library = torch if isinstance(number, Tensor) else np
        return library.tan(library.arcsin(number) if kind == "object_na" else library.deg2rad(number))

    @cached_property
    def marginal_height(self) -> Number:
        """mm at surface 1 of the paraxial marginal ray."""
        kind, diameter = self.lens.aperture.kind, self.entrance_pupil_diameter
        data = self.gaussian(self.primary)
        return data.marginal_height(kind, diameter, self.thickness[0], self.vergence, self.tan_cone)

    # -- solves and pickups --------------------------------------------------------------------------------------------

    def _solve(self) -> None:
        """Solves and pickups in the order of surfaces, repeated until they converge where one depends on later ones."""
        stored = [self.view.stored[solve.address] for solve in self.view.solves]
        if not self.view.waits:
            self._passed(stored)
        elif self.is_of_tensors:
            self._solve_tensors(stored)
        else:
            self._settled(stored)

    def _passed(self, solved: Sequence[Number]) -> list[Number]:
        """The numbers of the solves after a pass through all of them."""
        passed: list[Number] = []
        self._take(solved)
        for solve in self.view.solves:
            passed.append(SOLVES[solve.kind](self, solve))
            self.numbers[solve.address] = passed[-1]
            self.forget()
        return passed

    def _settled(self, solved: Sequence[Number]) -> Sequence[Number]:
        """The numbers of the solves that a pass does not change, with their derivatives."""
        for _ in range(_PASSES):
            before, solved = solved, self._passed(solved)
            if all(map(_is_settled, solved, before)):
                break
        return solved

    def _solve_tensors(self, stored: Sequence[Number]) -> None:
        """The numbers s = P(s, x) of solves, P a pass through all of them, with derivatives of any number of variables.

        Passes without derivatives come to s. From there a step of Newton's method has the first derivatives of s by x,
        ds/dx = (1 - ∂P/∂s)⁻¹ ∂P/∂x, and a second step the second ones.
        """
        addresses = [solve.address for solve in self.view.solves]

        def passed(state: LensState, solved: Tensor) -> Tensor:
            state._passed(solved.unbind())
            return torch.stack([number.expand(solved.shape[1:]) for number in state.tensors(addresses).values()])

        still = copy.copy(self)
        still._kept, still.numbers = {}, {address: number.detach() for address, number in self.numbers.items()}
        with torch.no_grad():
            still._settled(stored)
        solved = torch.stack(torch.broadcast_tensors(*still.tensors(addresses).values()))
        unit = torch.eye(len(addresses), dtype=solved.dtype, device=solved.device)
        units = unit.reshape(*unit.shape, *[1] * (solved.dim() - 1)).expand(-1, *solved.shape)
        with torch.enable_grad():
            slopes = tangents_of(passed(still, with_tangents(solved, units)), len(addresses))
        matrix = unit - slopes.movedim((0, 1), (-1, -2))
        is_free = torch.linalg.det(matrix).abs()[..., None, None] < _FREE
        inverse = torch.linalg.inv(torch.where(is_free, unit, matrix)).movedim((-2, -1), (0, 1))
        for _ in range(2):
            solved = solved + (inverse * (passed(self, solved) - solved)).sum(1)
        self._take(solved.unbind())

    def _take(self, solved: Sequence[Number]) -> None:
        """Set the numbers of the solves."""
        self.numbers |= {solve.address: n for solve, n in zip(self.view.solves, solved, strict=True)}
        self.forget()

    def forget(self) -> None:
        """Drop results that depend on changed numbers."""
        for name in vars(self).keys() - _GIVEN:
            del vars(self)[name]
        self._kept.clear()

    # -- functions of torch ----------------------------------------------------------------------------------------

    def through_torch(self, function: Callable[[Lens], Sequence[Tensor]], *, clips: bool = False) -> list[Number]:
        """Few numbers () that a function takes from a lens with torch, with their derivatives, one backward pass each.

        clips: whether the lens has its apertures; a lens of tensors has none.
        """
        if self.is_of_tensors:
            return [*function(self.moving_lens())]
        with torch.set_grad_enabled(self.count > 0):
            leaves = {address: _tensor(number).requires_grad_() for address, number in self.numbers.items()}
            numbers = [n.reshape(()) for n in function((self.view.clipping if clips else self.view).held(leaves))]
        return [self._chained(number, leaves) if self.count else float(number) for number in numbers]

    def _chained(self, number: Tensor, leaves: dict[Address, Tensor]) -> Dual:
        """A number () computed from leaves, with its derivatives by the variables."""
        value, slope = float(number.detach()), np.zeros(self.count)
        if number.requires_grad:
            by = torch.autograd.grad(number, list(leaves.values()), retain_graph=True, allow_unused=True)
            for address, derivative in zip(leaves, by, strict=True):
                moved = self.numbers[address]
                if derivative is not None and isinstance(moved, Dual):
                    slope = slope + float(derivative) * moved.slope
        return Dual(value, slope)

    def in_one_pass(
        self, function: Callable[[Lens], Sequence[Tensor]], only: Sequence[Address] | None = None
    ) -> list[Number]:
        """Numbers or arrays that a function takes from a lens with torch, with their derivatives in one forward pass.

        only: addresses of the numbers that the function depends on.
        """
        if self.is_of_tensors:
            return [*function(self.moving_lens(only))]
        with torch.set_grad_enabled(self.count > 0):
            return [*map(self._taken, function(self.moving_lens(only)))]

    def _taken(self, number: Tensor) -> Number:
        """A number or an array from torch, with its derivatives by the variables."""
        value = number.detach().numpy()[()]
        return Dual(value, tangents_of(number, self.count).detach().numpy()) if self.count else value

    def tensors(self, only: Sequence[Address] | None = None) -> dict[Address, Tensor]:
        """The numbers, or some, as tensors, by address; dual ones carry their derivatives by all variables."""
        numbers = {address: self.numbers[address] for address in only or self.numbers}
        if self.is_of_tensors:
            like = self.lens.wavelengths
            return {address: n if isinstance(n, Tensor) else like.new_tensor(n) for address, n in numbers.items()}
        if not self.count:
            return {address: _tensor(number) for address, number in numbers.items()}
        return {
            address: with_tangents(_tensor(n), torch.tensor(slope_of(n, self.count))) for address, n in numbers.items()
        }

    def moving_lens(self, only: Sequence[Address] | None = None) -> Lens:
        """The lens without apertures, whose numbers carry their derivatives by all variables."""
        if self.is_of_tensors:
            return with_numbers_of(without_apertures(self.lens), self.tensors(only), self.view.places)
        return self.view.held(self.tensors(only))

    def each_through_torch(self, function: Callable[..., Tensor], arrays: Sequence[Number]) -> Number:
        """Numbers (R,) that a function takes with torch from a lens and the entries of arrays (R,), one from each."""
        entries = [torch.tensor(value_of(array)) for array in arrays]
        entries = [
            with_tangents(entry, torch.tensor(array.full())) if isinstance(array, Dual) else entry
            for entry, array in zip(entries, arrays, strict=True)
        ]
        return self.in_one_pass(lambda lens: [function(lens, *entries)])[0]


def _tensor(number: Number) -> Tensor:
    """The value () of a number."""
    return torch.tensor(float(value_of(number)), dtype=torch.float64)


def _is_settled(number: Number, before: Number) -> bool:
    """Whether a number of a solve and its derivatives are the same before and after a pass, to rounding."""
    a, b = value_of(number), value_of(before)
    if isinstance(a, Tensor):
        return not is_any((a != b) & ~((a - b).abs() <= _CONVERGED * torch.finfo(a.dtype).eps * a.abs()))
    if a != b and not abs(a - b) <= _CONVERGED * np.finfo(float).eps * abs(a):
        return False
    if not isinstance(number, Dual):
        return True
    change = np.abs(number.slope - slope_of(before, len(number.slope)))
    return bool((change <= _SLOPES * np.abs(number.slope).max(initial=0.0)).all())


def _powers(state: LensState, wavelength: int) -> list[Number]:
    """Powers in 1/mm of the surfaces from 1 to that before the image, of any kind of number that varies."""

    def powers(lens: Lens) -> list[Tensor]:
        wavelength_um, surfaces = lens.wavelengths[wavelength], lens.surfaces[1:-1]
        n = signed(surfaces, media(lens, wavelength_um)[:-1])
        return [power(*part, wavelength_um) for part in zip(surfaces, n[:-1], n[1:], strict=True)]

    return state.in_one_pass(powers)


def _gaussian(state: LensState, wavelength: int) -> Gaussian:
    if not state.view.is_plain:
        return _gaussian_by_torch(state, wavelength)
    n, stop, last = state.index(wavelength), state.lens.stop, len(state.lens.surfaces) - 2
    A1, B1, C1, D1 = state.matrix(1, stop - 1, wavelength, to_next=True)
    A2, B2, C2, D2 = state.matrix(stop, last, wavelength)
    whole = A2 * A1 + B2 * C1, A2 * B1 + B2 * D1, C2 * A1 + D2 * C1, C2 * B1 + D2 * D1
    return Gaussian(*whole, (A1, B1), lambda: (B2, D2), n[0], n[last])


def _gaussian_by_torch(state: LensState, wavelength: int) -> Gaussian:
    """System matrices where other variables than curvatures, thicknesses and glasses change the power of a surface."""

    def matrices(lens: Lens) -> list[Tensor]:
        wavelength_um = lens.wavelengths[wavelength]
        matrix = gaussian(lens, signed(lens.surfaces[1:-1], media(lens, wavelength_um)[:-1]), wavelength_um)
        return [matrix.A, matrix.B, matrix.C, matrix.D, *matrix.front, *matrix.rear]

    A, B, C, D, A1, B1, B2, D2 = state.through_torch(matrices)
    n = state.index(wavelength)
    return Gaussian(A, B, C, D, (A1, B1), lambda: (B2, D2), n[0], n[-2])


def listed(numbers: Sequence[Number], count: int) -> np.ndarray | Dual:
    """Numbers () as one array (R,), with derivatives by `count` variables if there are any."""
    values = np.array([float(value_of(number)) for number in numbers])
    return Dual(values, np.stack([slope_of(n, count) for n in numbers], -1)) if count else values


# -- rays --------------------------------------------------------------------------------------------------------------


def launched(
    state: LensState, field: np.ndarray, pupil: Sequence[Number] | np.ndarray
) -> tuple[Vector, Sequence[Number], Number]:
    """Rays through the paraxial entrance pupil, as `tracing.launch` starts them: position, direction and path."""
    data = state.gaussian(state.primary)
    kind, distance = state.lens.fields.kind, state.thickness[0]
    index = np.abs(state.view.indices[:, :1])
    radius, depth = 0.5 * state.entrance_pupil_diameter, data.entrance_pupil_position
    x, y = (state.field_scale * part for part in (np.tan(np.deg2rad(field)) if kind == "angle" else field))
    aim = Vector((radius * pupil[0], radius * pupil[1], depth))
    if state.is_at_infinity:
        length = np.sqrt(x * x + y * y + 1.0)
        direction = x / length, y / length, 1.0 / length
        return aim, direction, index * dot(aim, direction)
    source = Vector((x, y, -distance))
    chord = aim - source
    length, far = np.sqrt(dot(chord, chord)), np.sqrt(dot(source, source))
    distance, depth = value_of(distance), value_of(depth)
    backward, nearer = depth < -distance, abs(distance) < abs(depth)
    path = path_from_point(aim, source, length, far)
    path = path_towards_lens(path, far, backward=backward, virtual=distance < 0, nearer=nearer)
    direction = chord * ((-1.0 if backward else 1.0) / length)
    return source if nearer else aim, direction, index * path


_STEPS = 12
_CLOSE = 1e-9  # of the radius of the stop: one more step ends at rounding

#: The hits (x, y) on the stop of rays through pupil points (2, W, R), and which arrive.
AtStop: TypeAlias = Callable[[LensState, Pair], tuple[Pair, np.ndarray]]


def aimed(
    state: LensState, at_stop: AtStop, target: np.ndarray, radius: Number, last: np.ndarray
) -> tuple[Pair, np.ndarray, np.ndarray]:
    """Pupil points, two of (W, R), plain or dual, which of them converged, and their values (2, W, R).

    state: with or without derivatives; target: (2, W, R), of the stop; radius: mm, signed; last: initial points.
    """
    fixed = state.fixed()
    goal = target * value_of(radius)
    points, converged, inverse = _root(fixed, at_stop, goal, abs(value_of(radius)), last)
    if not state.count:
        return (points[0], points[1]), converged, points
    (x, y), _ = at_stop(state, (points[0], points[1]))
    slopes = [slope_of(part, state.count) for part in (target[0] * radius - x, target[1] * radius - y)]
    by_x, by_y = (np.where(converged, row[0] * slopes[0] + row[1] * slopes[1], 0.0) for row in inverse)
    return (Dual(points[0], by_x), Dual(points[1], by_y)), converged, points


def _root(
    state: LensState, at_stop: AtStop, goal: np.ndarray, size: float, start: np.ndarray
) -> tuple[np.ndarray, np.ndarray, tuple[Pair, Pair]]:
    """Points (2, W, R), which of them converged, and the inverse of ∂s/∂a there, by components."""
    points, done = start.copy(), False
    for _ in range(_STEPS):
        a, b = (Dual(part, np.eye(2)[:, k, None, None] * np.ones_like(part)) for k, part in enumerate(points))
        (x, y), arrives = at_stop(state, (a, b))
        missed = goal - np.stack([x.value, y.value])
        (xx, xy), (yx, yy) = x.full(), y.full()
        determinant = xx * yy - xy * yx
        usable = arrives & (determinant != 0)
        scale = np.where(usable, determinant, 1.0)
        inverse = ((yy / scale, -xy / scale), (-yx / scale, xx / scale))
        step = np.stack([row[0] * missed[0] + row[1] * missed[1] for row in inverse])
        points = np.where(usable, points + step, points)
        close = usable & (np.abs(missed).max(0) <= _CLOSE * size)
        if done or not usable.any():
            break
        done = bool((close | ~usable).all())
    return points, close, inverse


def rays_by_torch(
    state: LensState, function: Callable[[Lens], Rays], shape: tuple[int, int]
) -> tuple[list[Number], np.ndarray]:
    """x, y, z, L, M, N and path (W, R) of the rays that a function takes from the lens at a state; and validity."""
    with torch.set_grad_enabled(state.count > 0):
        rays = function(state.moving_lens())
        parts = [part.expand(shape) for part in (*rays.position, *rays.direction, rays.opl)]
    valid = rays.valid.expand(shape).numpy().copy()
    values = [part.detach().numpy().copy() for part in parts]
    if not state.count:
        return values, valid
    slopes = [np.where(valid, tangents_of(part, state.count).detach().numpy(), 0.0) for part in parts]
    return [Dual(value, slope) for value, slope in zip(values, slopes, strict=True)], valid


class Ray(NamedTuple):
    """A ray by its wavelength (from 0), field (Hx, Hy) as part of the largest, and pupil point before vignetting."""

    wavelength: int
    field: tuple[float, float]
    pupil: tuple[float, float]


class Hits:
    """Rays (R,) behind a surface: `position` x, y, z mm in the axes of its vertex; `direction` L, M, N; `opl`; `valid`.

    Components are arrays or dual numbers, each taken from the table of the trace when it is first needed.
    """

    def __init__(
        self, parts: Sequence[np.ndarray], slopes: Sequence[np.ndarray] | None, valid: np.ndarray, places: np.ndarray
    ) -> None:
        """parts: x, y, z, L, M, N and path (W, R) each; slopes: (n, W, R) each; places: in the flat table."""
        self._parts, self._slopes, self._valid, self._places = parts, slopes, valid, places
        self.valid = valid.reshape(-1)[places]
        self.position, self.direction = _Components(self, 0), _Components(self, 3)

    def component(self, k: int) -> np.ndarray | Dual:
        value = self._parts[k].reshape(-1)[self._places]
        if self._slopes is None:
            return value
        slope = self._slopes[k]
        slope = slope.reshape(len(slope), -1)[:, self._places]
        return Dual(value, slope if self.valid.all() else np.where(self.valid, slope, 0.0))

    @cached_property
    def opl(self) -> Number:
        return self.component(6)

    def at(self, rays: np.ndarray) -> "Hits":
        """The hits of some rays, by their numbers."""
        return Hits(self._parts, self._slopes, self._valid, self._places[rays])


class _Components:
    """Three components of rays, each computed once."""

    def __init__(self, hits: Hits, first: int) -> None:
        self._hits, self._first = hits, first
        self._computed: dict[int, Number] = {}

    def __iter__(self) -> Iterator[Number]:
        return (self[k] for k in range(3))

    def __getitem__(self, k: int) -> Number:
        if not 0 <= k < 3:
            raise IndexError(k)
        if k not in self._computed:
            self._computed[k] = self._hits.component(self._first + k)
        return self._computed[k]

    def __sub__(self, other: Iterable[Number]) -> Vector:
        return Vector(self) - other

    def __mul__(self, factor: Number) -> Vector:
        return Vector(self) * factor


class Marks(NamedTuple):
    """Rays (R,) on the surfaces 1 to `last` (S,) of a bundle.

    x, y: (S, R) mm in the axes of the vertices; valid: (S, R) bool, up to there; by_x, by_y: (S, V, R), their
    derivatives by V variables, or None.
    """

    x: np.ndarray
    y: np.ndarray
    valid: np.ndarray
    by_x: np.ndarray | None = None
    by_y: np.ndarray | None = None


class Bundle:
    """The rays asked for of a lens in one configuration, behind the surfaces 1 to `last`."""

    def __init__(self, view: View, last: int) -> None:
        self.view, self.last = view, last
        self.rays: dict[Ray, int] = {}

    def ask(self, wavelength: int, field: tuple[float, float], pupil: tuple[float, float]) -> int:
        """The number of a ray, by which `Hits.at` finds it."""
        return self.rays.setdefault(Ray(wavelength, (field[0], field[1]), (pupil[0], pupil[1])), len(self.rays))

    # -- computed once ------------------------------------------------------------------------------------------------

    @cached_property
    def _places(self) -> tuple[np.ndarray, list[list[Ray]]]:
        """The place of every ray in a table of wavelengths and rays, and the rows of the table, of equal length."""
        rows: list[list[Ray]] = [[] for _ in self.view.wavelengths]
        places = []
        for ray in self.rays:
            places.append((ray.wavelength, len(rows[ray.wavelength])))
            rows[ray.wavelength].append(ray)
        length = max(map(len, rows))
        axis = Ray(0, (0.0, 0.0), (0.0, 0.0))
        rows = [row + [row[0] if row else axis] * (length - len(row)) for row in rows]
        return np.array([w * length + r for w, r in places]), rows

    @cached_property
    def field(self) -> np.ndarray:
        """(2, W, R) in the lens's own kind of field."""
        scale = self._opening * float(self.view.lens.fields.extent)
        return scale * np.array([[ray.field for ray in row] for row in self._places[1]]).transpose(2, 0, 1)

    @cached_property
    def pupil(self) -> np.ndarray:
        """(2, W, R) of the entrance pupil, vignetted."""
        points = self._opening * np.array([[ray.pupil for ray in row] for row in self._places[1]]).transpose(2, 0, 1)
        return vignette(self.view.lens, torch.from_numpy(self.field), torch.from_numpy(points.copy())).numpy()

    @property
    def _opening(self) -> float:
        return self.view.model.opening

    @cached_property
    def _template(self) -> tuple[Sequence[Surface], Any, np.ndarray, Columns | None]:
        """Surfaces, structure and table (W, K) as stored, and the columns of the numbers that move (`_columns`)."""
        view = self.view
        of_media = {address for addresses in view.glasses.values() for address in addresses}
        indices = torch.from_numpy(np.abs(view.indices))
        numbers = {
            address: torch.tensor(float(n), dtype=torch.float64)
            for address, n in view.stored.items()
            if address not in of_media
        }
        of_glasses = {k: indices[:, k].clone() for k in view.glasses}
        both: dict[Any, Tensor] = {**numbers, **of_glasses}
        places: dict[Address | int, slice] = {}
        moving: dict[Address | int, Tensor] = {}
        first, count = 0, sum(number.numel() for number in both.values())
        for address, number in both.items():
            places[address] = slice(first, first := first + number.numel())
            unit = torch.eye(count, dtype=torch.float64)[:, places[address]].reshape(count, *number.shape)
            moving[address] = with_tangents(number, unit)
        media = {k: moving[k] for k in of_glasses}
        with torch.enable_grad():
            lens = view.held({address: moving[address] for address in numbers})
            _, structure, table = view.table_of(self.last, lens, media)
        columns = _columns(table, both, places)
        return view.table_of(self.last, view.lens)[0], structure, table.detach().numpy().copy(), columns

    @cached_property
    def is_expressible(self) -> bool:
        """Whether the compiled trace supports all the surfaces."""
        return all(map(is_expressible, self.view.lens.surfaces[1 : self.last + 1]))

    @cached_property
    def _launches_itself(self) -> bool:
        lens = self.view.lens
        usual = lens.fields.kind in ("angle", "object_height", "paraxial_image_height") and not lens.fields.telecentric
        return is_flat(lens.surfaces[0]) and usual and (not self._aims or not is_bent(lens))

    @cached_property
    def _aims(self) -> bool:
        return aiming_of(self.view.lens) != "off"

    def on(self, surface: int) -> "Bundle":
        """The same rays on another surface."""
        bundle = Bundle(self.view, surface)
        bundle.rays = self.rays
        return bundle

    @cached_property
    def _at_stop(self) -> "Bundle":
        return self.on(self.view.lens.stop)

    @cached_property
    def _marginal(self) -> "Bundle":
        """The axial ray through the edge of the paraxial entrance pupil, on the stop."""
        bundle = Bundle(self.view, self.view.lens.stop)
        bundle.ask(self.view.lens.primary_wavelength - 1, (0.0, 0.0), (0.0, 1.0 / self._opening))
        return bundle

    # -- at a state ---------------------------------------------------------------------------------------------------

    def hits(self, state: LensState) -> Hits:
        """All rays on surface `last`, in the order of `ask`; in front of surface 1 if `last` is 0."""
        if self.last == 0:
            return self._at_object(state)
        if not self.is_expressible:
            return self._hits_by_torch(state)
        return self._hits(*self._traced(state, *self.launched(state)))

    def _at_object(self, state: LensState) -> Hits:
        """The rays on the plane of the object; nan for one at infinity."""
        position, direction, opl, valid = self.launched(state)
        if np.isinf(value_of(state.thickness[0])):
            return self._as_hits(state, (*[np.full(valid.shape, np.nan)] * 3, *direction, opl), valid)
        step = (-state.thickness[0] - position[2]) / direction[2]
        x, y = (position[k] + step * direction[k] for k in range(2))
        return self._as_hits(state, (x, y, 0 * step, *direction, opl), valid)

    def marks(self, state: LensState) -> Marks:
        """All rays on all surfaces from 1 to `last`, in the order of `ask`."""
        if self.is_expressible:
            surfaces, task, changes, start, count = self._task(state, *self.launched(state))
            rays = pushed_everywhere(surfaces, task, changes[: count or 0], start)
            if rays is not None:
                places, size, rows = self._places[0], self.field[0].size, rows_of(task.structure, surfaces)

                def picked(part: Tensor) -> np.ndarray:
                    return part.numpy().reshape(*part.shape[:-2], size)[rows][..., places]

                x, y = map(picked, rays.position[:2])
                by_x, by_y = (None, None) if count is None else map(picked, rays.by_position[:2])
                return Marks(x, y, picked(rays.valid), by_x, by_y)
        hits = [bundle.hits(state) for bundle in self._each]
        parts = [[hit.position[k] for hit in hits] for k in range(2)]
        x, y = (np.stack([value_of(number) for number in part]) for part in parts)
        slopes = ([slope_of(number, state.count) for number in part] for part in parts)
        by_x, by_y = map(np.stack, slopes) if state.count else (None, None)
        return Marks(x, y, np.stack([hit.valid for hit in hits]), by_x, by_y)

    @cached_property
    def _each(self) -> list["Bundle"]:
        return [self.on(surface) for surface in range(1, self.last + 1)]

    def _traced(
        self, state: LensState, position: Sequence[Number], direction: Sequence[Number], opl: Number, valid: np.ndarray
    ) -> tuple[Any, int | None]:
        """Rays behind surface `last` as a table, and by how many variables they change, if any."""
        surfaces, task, changes, start, count = self._task(state, position, direction, opl, valid)
        return (ends(surfaces, task) if count is None else pushed(surfaces, task, changes, start)), count

    def _task(
        self, state: LensState, position: Sequence[Number], direction: Sequence[Number], opl: Number, valid: np.ndarray
    ) -> tuple[Sequence[Surface], Task, Tensor, tuple[Tensor, Tensor, Tensor] | None, int | None]:
        """Surfaces, task of the trace, changes of table and rays, and by how many variables, None without changes."""
        surfaces, structure, *_ = self._template
        table, changes = self.table(state)
        moving = [part for part in (*position, *direction, opl) if isinstance(part, Dual)]
        given = [np.stack([value_of(p) for p in part]) for part in (position, direction)] + [value_of(opl)]
        points, along, path = (torch.from_numpy(np.ascontiguousarray(part)) for part in given)
        task = Task(structure, torch.from_numpy(valid), (points, along, path, torch.from_numpy(table)))
        count = state.count or max((len(part.slope) for part in moving), default=0)
        if not count:
            return surfaces, task, torch.from_numpy(changes), None, None
        start = None
        if moving:
            slopes = torch.from_numpy(np.stack([slope_of(part, count) for part in (*position, *direction, opl)]))
            start = slopes[:3], slopes[3:6], slopes[6]
        changes = changes if state.count else np.zeros((count, *table.shape))
        return surfaces, task, torch.from_numpy(changes), start, count

    def starts(self, state: LensState) -> Hits:
        """All rays at their launch, before surface 1 and in its axes, in the order of `ask`."""
        position, direction, opl, valid = self.launched(state)
        return self._as_hits(state, (*position, *direction, opl), valid)

    def _as_hits(self, state: LensState, parts: Sequence[Number], valid: np.ndarray) -> Hits:
        slopes = [slope_of(part, state.count) for part in parts] if state.count else None
        return Hits([value_of(part) for part in parts], slopes, valid, self._places[0])

    def _hits(self, end: Any, count: int | None) -> Hits:
        """The rays of `ask`, from the table of a trace."""
        parts = [*end.position.numpy(), *end.direction.numpy(), end.opl.numpy()]
        slopes = None
        if count is not None:
            slopes = [*end.by_position.numpy(), *end.by_direction.numpy(), end.by_opl.numpy()]
        return Hits(parts, slopes, end.valid.numpy(), self._places[0])

    def table(self, state: LensState) -> tuple[np.ndarray, np.ndarray]:
        """The table (W, K) of the lens at a state, and its derivatives (n, W, K)."""
        _, _, stored, columns = self._template
        if columns is None:
            return self._table_by_torch(state)
        table = stored.copy()
        changes = np.zeros((state.count, *table.shape))
        for address, number in state.numbers.items():
            if address not in columns:
                continue
            table[:, columns[address]] = value_of(number)
            if isinstance(number, Dual):
                changes[:, :, columns[address]] = number.slope[:, None, None]
        for surface, index in state.media.items():
            if surface in columns:
                table[:, columns[surface]] = value_of(index)[:, None]
                if isinstance(index, Dual):
                    changes[:, :, columns[surface]] = index.slope[:, :, None]
        return table, changes

    def _table_by_torch(self, state: LensState) -> tuple[np.ndarray, np.ndarray]:
        with torch.set_grad_enabled(state.count > 0):
            table = self.view.table_of(self.last, state.moving_lens())[2]
        return table.detach().numpy(), tangents_of(table, state.count).detach().numpy()

    def launched(self, state: LensState) -> Launch:
        """Position and direction (three of (W, R) each), path (W, R) and validity of the rays before surface 1."""
        if not self._launches_itself:
            parts, valid = rays_by_torch(state, self._start_by_torch, self.field.shape[1:])
            return parts[:3], parts[3:6], parts[6], valid
        if not self._aims:
            return self._through(state, self.pupil)
        pupil, aimed = self._aimed(state)
        position, direction, opl, valid = self._through(state, pupil)
        return position, direction, opl, valid & aimed

    def _through(self, state: LensState, pupil: Pair | np.ndarray) -> Launch:
        shape = self.field.shape[1:]
        position, direction, opl = launched(state, self.field, pupil)
        filled = [part + np.zeros(shape) for part in (*position, *direction, opl)]
        return filled[:3], filled[3:6], filled[6], np.ones(shape, dtype=bool)

    def _aimed(self, state: LensState) -> tuple[Pair, np.ndarray]:
        """Pupil points, two of (W, R), whose rays pass the stop at `pupil`, and which of them converged."""
        stop, shape = self._at_stop, self.field.shape[1:]

        def at_stop(state: LensState, pupil: Pair) -> tuple[Pair, np.ndarray]:
            end, count = stop._traced(state, *self._through(state, pupil))
            x, y = end.position[:2].numpy()
            if count is None:
                return (x, y), end.valid.numpy()
            by = end.by_position.numpy()
            return (Dual(x, by[0]), Dual(y, by[1])), end.valid.numpy()

        radius = self._stop_radius(state)
        pupil, converged, points = aimed(state, at_stop, self.pupil, radius, self._last_aim)
        if not converged.all() and self._last_aim is not self.pupil:
            pupil, converged, points = aimed(state, at_stop, self.pupil, radius, self.pupil)
        self._last_aim = np.where(converged, points, self.pupil)
        return (pupil[0] + np.zeros(shape), pupil[1] + np.zeros(shape)), converged

    @cached_property
    def _last_aim(self) -> np.ndarray:
        """The pupil points of the last aiming, from which the next aiming starts."""
        return self.pupil

    def _stop_radius(self, state: LensState) -> Number:
        """mm, negative where the entrance pupil is an inverted image of the stop."""
        lens = self.view.lens
        paraxial = 0.5 * state.entrance_pupil_diameter * state.gaussian(state.primary).front[0]
        if lens.aperture.kind == "float_by_stop":
            return state.number(0, "aperture") * np.sign(value_of(paraxial))
        if lens.ray_aiming == "paraxial":
            return paraxial
        marginal = self._marginal
        hits = marginal._hits(*marginal._traced(state, *marginal._through(state, marginal.pupil)))
        height = hits.position[1][np.array([0])]
        real = np.abs(height) * np.sign(value_of(paraxial))
        return real[0] if hits.valid[0] else paraxial

    def _start_by_torch(self, lens: Lens) -> Rays:
        field, pupil = torch.from_numpy(self.field), torch.from_numpy(self.pupil)
        return rays_of_field(lens, field, pupil, wavelength=lens.wavelengths[:, None])

    def _hits_by_torch(self, state: LensState) -> Hits:
        def end(lens: Lens) -> Rays:
            wavelength = lens.wavelengths[:, None]
            indices = media(lens, wavelength)[: self.last + 1]
            rays = self._start_by_torch(lens)
            return trace_surfaces(sequence_of(lens)[: self.last], rays, indices=indices, wavelength=wavelength)

        parts, valid = rays_by_torch(state, end, self.field.shape[1:])
        return self._as_hits(state, parts, valid)


def _columns(table: Tensor, numbers: Mapping[Any, Tensor], places: Mapping[Any, slice]) -> Columns | None:
    """The columns of a table (W, K) that hold a number unchanged, by address; None if one holds a function of a number.

    The table carries its derivatives by the entries of all numbers, () or (W,), at their places.
    """
    columns: Columns = {}
    values = table.detach().numpy()
    by = tangents_of(table, max((place.stop for place in places.values()), default=0)).detach().numpy()
    for address, number in numbers.items():
        stored, derivative = number.numpy(), by[places[address]]  # (1 or W, W, K)
        held = (values == (stored if stored.ndim == 0 else stored[:, None])).all(0)
        unchanged = np.eye(len(values))[:, :, None] if stored.ndim else np.ones((1, len(values), 1))
        moving = (derivative != 0).any((0, 1))
        if not (held[moving].all() and (derivative[:, :, moving] == unchanged).all()):
            return None
        if moving.any():
            columns[address] = np.flatnonzero(moving)
    return columns

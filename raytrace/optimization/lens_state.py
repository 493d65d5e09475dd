"""LensState: a lens in one configuration at given variables: its numbers and first-order data, with their derivatives.

Numbers are plain, or dual (`maths.numerics`) where derivatives are computed; the formulas are the same. SOLVES computes
the numbers of a lens that follow from others, at the primary wavelength; n is signed, ω = n u.
"""

from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import Dual, slope_of, value_of
from raytrace.system.lens import Lens, index_behind, media
from raytrace.system.optimization_data import Solve
from raytrace.system.rays import Rays
from raytrace.system.surface import sag_at, signed, vertex_curvature
from raytrace.tracing.launch import rays_of_field, vignette
from raytrace.tracing.paraxial import CONES, Gaussian, brackets, field_scale, gaussian
from raytrace.tracing.trace import sequence_of, trace_surfaces

#: Through which points of the pupil light reaches furthest from the vertex of a surface.
ENDS = ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0))


def _marginal_ray_before(state, surface: int):
    """(y, ω) of the paraxial marginal ray in front of a surface."""
    y, omega = state.marginal_height, state.marginal_height * state.vergence
    if surface == 1:
        return y, omega
    A, B, C, D = state.matrix(1, surface - 1, state.primary, to_next=True)
    return A * y + B * omega, C * y + D * omega


def _pickup(state, solve: Solve):
    return solve.scale * state.number(solve.source, solve.quantity_of_source or solve.quantity) + solve.offset


def _curvature_for(state, solve: Solve, omega_behind):
    """c = (ω - ω′ - K y)/(y (n′ - n)) behind which the marginal ray has ω′; K: power of the surface without c."""
    k, n = solve.surface, state.index(state.primary)
    y, omega = _marginal_ray_before(state, k)
    return ((omega - omega_behind) / y - state.further_power(k, state.primary)) / (n[k] - n[k - 1])


def _marginal_angle(state, solve: Solve):
    return _curvature_for(state, solve, state.index(state.primary)[solve.surface] * solve.numbers[0])


def _f_number(state, solve: Solve):
    return _curvature_for(state, solve, -abs(state.index(state.primary)[solve.surface]) / (2 * solve.numbers[0]))


def _marginal_height(state, solve: Solve):
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
    rays = _behind(lens, k, like.new_zeros(2), like.new_tensor([0.0, part]), lens.primary)
    (_, y, z), (_, M, N) = rays.position, rays.direction
    crosses = rays.valid & (M != 0)
    ratio = N / torch.where(crosses, M, torch.ones_like(M))
    at = z.new_tensor(height)
    thickness = z + ratio * (at - y) - sag_at(lens.surfaces[k + 1], torch.zeros_like(at), at)
    return torch.where(crosses, thickness, torch.nan).reshape(())


def _edge_thickness(state, solve: Solve):
    """t = e + z - z′ of both surfaces at one height, by default the semi-diameter of the first."""
    k, (edge, height) = solve.surface, solve.numbers

    def thickness(lens: Lens) -> list[Tensor]:
        at = lens.wavelengths.new_tensor(height) if height else semi_diameter(lens, k)
        near, far = (sag_at(surface, torch.zeros_like(at), at) for surface in lens.surfaces[k : k + 2])
        return [(edge + near - far).reshape(())]

    return state.through_torch(thickness)[0]


def semi_diameter(lens: Lens, k: int) -> Tensor:
    """mm: fixed, or the extent of the rays of all fields and wavelengths with the margin of `OptimizationData`."""
    data, stored = lens.optimization_data, lens.surfaces[k].semi_diameter
    if stored and (data is None or k in data.semi_diameters):
        return lens.wavelengths.new_tensor(stored)
    field = torch.stack([lens.fields.x, lens.fields.y])[:, None, :, None]
    points = lens.wavelengths.new_tensor(ENDS).T[:, None, None]
    rays = _behind(lens, k, field, vignette(lens, field, points), lens.wavelengths[:, None, None])
    height = torch.where(rays.valid, rays.position[0].square() + rays.position[1].square(), 0.0).amax().sqrt()
    percent, length = (0.0, 0.0) if data is None or k == lens.stop else data.semi_diameter_margin
    return (1 + percent / 100) * height + length


def _behind(lens: Lens, k: int, field: Tensor, pupil: Tensor, wavelength: Tensor) -> Rays:
    """Rays behind surface k, in the axes of its vertex."""
    rays = rays_of_field(lens, field, pupil, wavelength=wavelength)
    return trace_surfaces(sequence_of(lens)[:k], rays, indices=media(lens, wavelength)[: k + 1], wavelength=wavelength)


def _power(state, solve: Solve):
    """c = P/(n′ - n) of the power that a surface has by its curvature."""
    k, n = solve.surface, state.index(state.primary)
    return solve.numbers[0] / (n[k] - n[k - 1])


def _position(state, solve: Solve):
    """The thickness that completes the sum of thicknesses between surface `source` and this one."""
    k, source = solve.surface, solve.source
    others = range(source, k) if source <= k else range(k + 1, source)
    return solve.numbers[0] - sum(state.thickness[j] for j in others)


#: The number of a state that a solve sets, by kind.
SOLVES = {
    "pickup": _pickup,
    "marginal_angle": _marginal_angle,
    "f_number": _f_number,
    "marginal_height": _marginal_height,
    "edge_thickness": _edge_thickness,
    "power": _power,
    "position": _position,
}


_PASSES = 60  # through solves that depend on one another
_CONVERGED = 1e-15  # relative


class LensState:
    """view: `lens_model.View`; variables: (n,) numbers, or a Dual of them."""

    def __init__(self, view, variables):
        self.view, self.lens, self.variables = view, view.lens, variables
        self.numbers: dict = {
            at: variables[number] if (scale, offset) == (1.0, 0.0) else scale * variables[number] + offset
            for at, (number, scale, offset) in view.variables.items()
        }
        self._kept: dict = {}
        self._solve()

    @property
    def count(self) -> int:
        """How many variables there are derivatives by; 0 where none are asked for."""
        return len(self.variables.slope) if isinstance(self.variables, Dual) else 0

    def fixed(self) -> "LensState":
        """The same state without derivatives."""
        return LensState(self.view, value_of(self.variables)) if self.count else self

    def number(self, surface: int, quantity: str):
        """A number of a surface, solved, picked up, varied or as it is stored."""
        number = self.numbers.get((surface, quantity))
        return self.view.number((surface, quantity)) if number is None else number

    @cached_property
    def thickness(self) -> list:
        """mm behind every surface, the object's first."""
        return self._listed("thickness", self.view.thickness)

    @cached_property
    def curvature(self) -> list:
        """1/mm of every surface, terms of r² left out."""
        return self._listed("curvature", self.view.curvature)

    @cached_property
    def vertex_curvature(self) -> list:
        """1/mm of every surface at its vertex, terms of r² included."""
        if self.view.is_plain:
            return [c + bend for c, bend in zip(self.curvature, self.view.further_power[0], strict=True)]
        return self.through_torch(lambda lens: [vertex_curvature(surface).reshape(()) for surface in lens.surfaces])

    def _listed(self, quantity: str, stored: list[float]) -> list:
        numbers = list(stored)
        for (surface, name), number in self.numbers.items():
            if name == quantity:
                numbers[surface] = number
        return numbers

    def index(self, wavelength: int) -> Sequence:
        """Signed index behind every surface at a wavelength, counted from 0."""
        stored = self.view.indices[wavelength]
        if not self.view.glasses:
            return stored
        pairs = zip(stored, self.view.media, strict=True)
        return [np.sign(n) * self.media[k][wavelength] if k in self.media else n for n, k in pairs]

    @cached_property
    def media(self) -> dict:
        """Indices (W,) of variable media, by the surface in front of them."""
        if not self.view.glasses:
            return {}
        glasses, waves = self.view.glasses, self.lens.wavelengths
        moved = [at for addresses in glasses.values() for at in addresses]
        numbers = self.through_torch(
            lambda lens: [n for k in glasses for n in index_behind(lens, k, waves)], only=moved
        )
        each = [numbers[k : k + len(waves)] for k in range(0, len(numbers), len(waves))]
        return {surface: listed(indices, self.count) for surface, indices in zip(self.view.glasses, each, strict=True)}

    def power(self, k: int, wavelength: int):
        """Power in 1/mm of a surface."""
        n = self.index(wavelength)
        return self.curvature[k] * (n[k] - n[k - 1]) + self.further_power(k, wavelength)

    def further_power(self, k: int, wavelength: int):
        """Power in 1/mm of a surface in addition to c Δn: of terms of r² and of a phase."""
        bend, phase = self.view.further_power
        if bend[k] == 0:
            return phase[wavelength, k]
        n = self.index(wavelength)
        return bend[k] * (n[k] - n[k - 1]) + phase[wavelength, k]

    def matrix(self, first: int, last: int, wavelength: int, *, to_next: bool = False):
        """(A, B, C, D) from the vertex of a surface, before it, to behind another, or to the vertex after that."""
        n = self.index(wavelength)
        steps = range(first, last + 1)
        gaps = [self.thickness[k] / n[k] for k in (steps if to_next else steps[:-1])]
        return brackets([self.power(k, wavelength) for k in steps], gaps)

    def gaussian(self, wavelength: int) -> Gaussian:
        """The system matrices at a wavelength."""
        return self.kept(_gaussian, wavelength)

    def kept(self, function: Callable, *arguments):
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
    def vergence(self):
        """n / object distance at the primary wavelength, 0 for an object at infinity."""
        return self.vergence_at(self.primary)

    def vergence_at(self, wavelength: int):
        return self.index(wavelength)[0] / self.object_distance

    @property
    def is_at_infinity(self) -> bool:
        return bool(np.isinf(value_of(self.thickness[0])))

    @cached_property
    def field_scale(self):
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
    def object_distance(self):
        distance = self.thickness[0]
        return np.finfo(float).tiny ** 0.5 if not isinstance(distance, Dual) and distance == 0 else distance

    @cached_property
    def entrance_pupil_diameter(self):
        """mm, of the aperture of the lens at the primary wavelength."""
        aperture, data = self.lens.aperture, self.gaussian(self.primary)
        number, distance = float(aperture.value), self.thickness[0]
        return data.entrance_pupil_diameter(aperture.kind, number, distance, self.vergence, self.tan_cone)

    @property
    def tan_cone(self) -> float | None:
        """Tangent of the half angle of the cone at the object, of an aperture that is specified as one."""
        kind, number = self.lens.aperture.kind, float(self.lens.aperture.value)
        if kind not in CONES:
            return None
        return np.tan(np.arcsin(number / self.index(self.primary)[0]) if kind == "object_na" else np.deg2rad(number))

    @cached_property
    def marginal_height(self):
        """mm at surface 1 of the paraxial marginal ray."""
        kind, diameter = self.lens.aperture.kind, self.entrance_pupil_diameter
        data = self.gaussian(self.primary)
        return data.marginal_height(kind, diameter, self.thickness[0], self.vergence, self.tan_cone)

    # -- solves and pickups --------------------------------------------------------------------------------------------

    def _solve(self) -> None:
        """Solves and pickups in the order of surfaces, repeated until they converge where one depends on later ones."""
        solves = self.view.solves
        if not solves:
            return
        self.numbers |= {(one.surface, one.quantity): self.view.stored[one.surface, one.quantity] for one in solves}
        for _ in range(_PASSES):
            before = dict(self.numbers)
            for one in solves:
                self.numbers[one.surface, one.quantity] = SOLVES[one.kind](self, one)
                self._forget()
            pairs = ((value_of(number), value_of(before[at])) for at, number in self.numbers.items())
            moved = (abs(a - b) / max(abs(a), abs(b), 1e-300) if a != b else 0.0 for a, b in pairs)
            if not self.view.waits or all(step <= _CONVERGED for step in moved):
                break

    def _forget(self) -> None:
        for name in (
            "thickness",
            "curvature",
            "vertex_curvature",
            "media",
            "vergence",
            "field_scale",
            "entrance_pupil_diameter",
            "marginal_height",
        ):
            self.__dict__.pop(name, None)
        self._kept.clear()

    # -- functions of torch, the only ways from there to dual numbers, but for whole bundles (`ray_bundle`) -----------

    def through_torch(
        self, function: Callable[[Lens], Sequence[Tensor]], *, clips: bool = False, only: Sequence | None = None
    ) -> list:
        """Numbers () that a function takes from a lens with torch, with their derivatives, one backward pass each.

        clips: whether the lens has its apertures; only: addresses of the numbers that the function depends on.
        """
        view = self.view.clipping if clips else self.view
        with torch.set_grad_enabled(self.count > 0):
            leaves, lens = view.leaves({at: value_of(self.numbers[at]) for at in only or self.numbers})
            numbers = function(lens)
        return [self._chained(number, leaves) if self.count else float(number) for number in numbers]

    def each_through_torch(self, function: Callable, arrays: Sequence):
        """Numbers (R,) that a function takes with torch from a lens and the entries of arrays (R,), one from each."""
        with torch.set_grad_enabled(self.count > 0):
            leaves, lens = self.view.leaves({at: value_of(n) for at, n in self.numbers.items()})
            entries = [torch.tensor(value_of(array), requires_grad=self.count > 0) for array in arrays]
            numbers = function(lens, *entries)
            if not self.count:
                return numbers.numpy()
            by = torch.autograd.grad(numbers.sum(), entries, retain_graph=True, allow_unused=True)
            slopes = np.zeros((self.count, len(numbers)))
            for array, derivative in zip(arrays, by, strict=True):
                if isinstance(array, Dual) and derivative is not None:
                    slopes += array.full() * derivative.numpy()
            of_lens = torch.autograd.grad(numbers.sum(), list(leaves.values()), retain_graph=True, allow_unused=True)
            if any(derivative is not None for derivative in of_lens):
                slopes += np.stack([self._chained(number, leaves).slope for number in numbers], -1)
        return Dual(numbers.detach().numpy(), slopes)

    def _chained(self, number: Tensor, leaves: dict) -> Dual:
        """A number () computed from leaves, with its derivatives by the variables."""
        value, slope = float(number.detach()), np.zeros(self.count)
        if number.requires_grad:
            by = torch.autograd.grad(number, list(leaves.values()), retain_graph=True, allow_unused=True)
            for at, derivative in zip(leaves, by, strict=True):
                moved = self.numbers[at]
                if derivative is not None and isinstance(moved, Dual):
                    slope = slope + float(derivative) * moved.slope
        return Dual(value, slope)


def _gaussian(state: LensState, wavelength: int) -> Gaussian:
    if not state.view.is_plain:
        return _gaussian_by_torch(state, wavelength)
    n, stop, last = state.index(wavelength), state.lens.stop, len(state.lens.surfaces) - 2
    A1, B1, C1, D1 = state.matrix(1, stop - 1, wavelength, to_next=True)
    A2, B2, C2, D2 = state.matrix(stop, last, wavelength)
    whole = A2 * A1 + B2 * C1, A2 * B1 + B2 * D1, C2 * A1 + D2 * C1, C2 * B1 + D2 * D1
    return Gaussian(*whole, (A1, B1), (B2, D2), n[0], n[last])


def _gaussian_by_torch(state: LensState, wavelength: int) -> Gaussian:
    """Where variables other than curvatures, thicknesses and glasses change the power of a surface."""

    def matrices(lens: Lens) -> list[Tensor]:
        at = lens.wavelengths[wavelength]
        found = gaussian(lens, signed(lens.surfaces[1:-1], media(lens, at)[:-1]), at)
        return [*found[:4], *found.front, *found.rear]

    A, B, C, D, A1, B1, B2, D2 = state.through_torch(matrices)
    n = state.index(wavelength)
    return Gaussian(A, B, C, D, (A1, B1), (B2, D2), n[0], n[-2])


def listed(numbers: Sequence, count: int):
    """Numbers () as one array (R,), with derivatives by `count` variables if there are any."""
    values = np.array([float(value_of(number)) for number in numbers])
    return Dual(values, np.stack([slope_of(n, count) for n in numbers], -1)) if count else values

"""Ray bundles: all rays of a merit function's rows, launched and traced in one pass, with derivatives.

Rays start as in `tracing.launch`. Rays that depend on the lens only through its first-order data are launched and aimed
in numpy: 126 rays and 21 variables take 1.3 ms with derivatives, compared with 490 ms by `tracing.launch` and a forward
derivative for every variable; 2.8 ms compared with 9.7 s with real ray aiming. `tracing.launch` launches all others
(real image heights, telecentric objects, curved objects, bent axes).

Ray aiming solves s(a, x) = p r(x) for the pupil points a, s the hit on the stop, p the point of the pupil, r the radius
of the stop: by Newton's method from the last solution, and ∂a/∂x = (∂s/∂a)⁻¹ (p ∂r/∂x - ∂s/∂x).
"""

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.autograd import forward_ad

from raytrace.maths.numerics import Dual, Vector, dot, slope_of, value_of
from raytrace.optimization.lens_model import unbent
from raytrace.optimization.lens_state import LensState
from raytrace.optimization.variables import GLASS
from raytrace.system.lens import Lens, media
from raytrace.system.rays import Rays
from raytrace.tracing.compiled import Task, is_expressible, rows_of
from raytrace.tracing.launch import path_from_point, path_towards_lens, rays_of_field, vignette
from raytrace.tracing.trace import aiming_of, ends, is_bent, pushed, pushed_everywhere, sequence_of, trace_surfaces


def launched(state: LensState, field: np.ndarray, pupil: np.ndarray):
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
AtStop = Callable[[LensState, tuple], tuple]


def aimed(state: LensState, at_stop: AtStop, target: np.ndarray, radius, last: np.ndarray):
    """Pupil points, two of (W, R), plain or dual, which of them converged, and their values (2, W, R).

    state: with or without derivatives; target: (2, W, R), of the stop; radius: mm, signed; last: initial points.
    """
    fixed = state.fixed()
    goal = target * value_of(radius)
    points, converged, inverse = _root(fixed, at_stop, goal, abs(value_of(radius)), last)
    if not state.count:
        return tuple(points), converged, points
    (x, y), _ = at_stop(state, tuple(points))
    slopes = [slope_of(part, state.count) for part in (target[0] * radius - x, target[1] * radius - y)]
    moved = [inverse[k][0] * slopes[0] + inverse[k][1] * slopes[1] for k in range(2)]
    dual = tuple(Dual(at, np.where(converged, by, 0.0)) for at, by in zip(points, moved, strict=True))
    return dual, converged, points


def _root(state: LensState, at_stop: AtStop, goal: np.ndarray, size: float, start: np.ndarray):
    """Points (2, W, R), which of them converged, and the inverse of ∂s/∂a there, by components."""
    points, done = start.copy(), False
    for _ in range(_STEPS):
        moving = tuple(Dual(part, np.eye(2)[:, k, None, None] * np.ones_like(part)) for k, part in enumerate(points))
        (x, y), arrives = at_stop(state, moving)
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
    state: LensState, function: Callable[[Lens], Rays], shape: tuple[int, int], *, backward: bool = False
) -> tuple[list, np.ndarray]:
    """x, y, z, L, M, N and path (W, R) of the rays that a function takes from the lens at a state; and validity.

    backward: one backward pass for each number, if the function takes forward derivatives of its own (rays aimed about
    a base ray), which do not nest; else one forward pass for each variable, of which there are fewer than rays.
    """

    def parts_of(lens: Lens) -> list[Tensor]:
        rays = function(lens)
        return [part.expand(shape) for part in (*rays.position, *rays.direction, rays.opl, rays.valid)]

    values = {at: torch.tensor(float(value_of(n)), dtype=torch.float64) for at, n in state.numbers.items()}
    with torch.no_grad():
        *parts, valid = (part.numpy().copy() for part in parts_of(state.view.held(values)))
    if not state.count:
        return parts, valid
    if backward:
        numbers = state.through_torch(lambda lens: [n for part in parts_of(lens)[:-1] for n in part.reshape(-1)])
        slopes = np.stack([number.slope for number in numbers], -1).reshape(state.count, 7, *shape).swapaxes(0, 1)
    else:
        slopes = np.zeros((7, state.count, *shape))
        for variable in range(state.count):
            with forward_ad.dual_level():
                moved = {
                    at: forward_ad.make_dual(values[at], values[at].new_tensor(float(number.slope[variable])))
                    for at, number in state.numbers.items()
                    if isinstance(number, Dual)
                }
                for slope, part in zip(slopes, parts_of(state.view.held(values | moved))[:-1], strict=True):
                    tangent = forward_ad.unpack_dual(part).tangent
                    if tangent is not None:
                        slope[variable] = tangent.numpy()
    return [Dual(value, np.where(valid, slope, 0.0)) for value, slope in zip(parts, slopes, strict=True)], valid


def largest_field(lens: Lens) -> float:
    """Distance of the outermost field from the axis, in the lens's own kind of field."""
    return float(torch.hypot(lens.fields.x, lens.fields.y).max())


class Ray(NamedTuple):
    """A ray by its wavelength (from 0), field (Hx, Hy) as part of the largest, and pupil point before vignetting."""

    wavelength: int
    field: tuple[float, float]
    pupil: tuple[float, float]


class Hits:
    """Rays (R,) behind a surface: `position` x, y, z mm in the axes of its vertex; `direction` L, M, N; `opl`; `valid`.

    Components are arrays or dual numbers, each taken from the table of the trace when it is first needed.
    """

    def __init__(self, parts: Sequence, slopes: Sequence | None, valid: np.ndarray, places: np.ndarray):
        """parts: x, y, z, L, M, N and path (W, R) each; slopes: (n, W, R) each; places: in the flat table."""
        self._parts, self._slopes, self._valid, self._places = parts, slopes, valid, places
        self.valid = valid.reshape(-1)[places]
        self.position, self.direction = _Components(self, 0), _Components(self, 3)

    def component(self, k: int):
        value = self._parts[k].reshape(-1)[self._places]
        if self._slopes is None:
            return value
        slope = self._slopes[k]
        slope = slope.reshape(len(slope), -1)[:, self._places]
        return Dual(value, slope if self.valid.all() else np.where(self.valid, slope, 0.0))

    @cached_property
    def opl(self):
        return self.component(6)

    def at(self, rays: np.ndarray) -> "Hits":
        """Those of some rays."""
        return Hits(self._parts, self._slopes, self._valid, self._places[rays])


class _Components:
    """Three components of rays, each computed once."""

    def __init__(self, hits: Hits, first: int):
        self._hits, self._first, self._computed = hits, first, {}

    def __getitem__(self, k: int):
        if not 0 <= k < 3:
            raise IndexError(k)
        if k not in self._computed:
            self._computed[k] = self._hits.component(self._first + k)
        return self._computed[k]

    def __sub__(self, other) -> Vector:
        return Vector(self) - other

    def __mul__(self, factor) -> Vector:
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

    def __init__(self, view, last: int):
        self.view, self.last = view, last
        self.rays: dict[Ray, int] = {}

    def ask(self, wavelength: int, field: tuple[float, float], pupil: tuple[float, float]) -> int:
        """The number of a ray, by which `Hits.at` finds it."""
        return self.rays.setdefault(Ray(wavelength, tuple(field), tuple(pupil)), len(self.rays))

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
        scale = self._opening * largest_field(self.view.lens)
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
    def _template(self):
        """Surfaces, structure and table (W, K) as stored, and the columns of what moves (`_columns`)."""
        view = self.view
        with torch.enable_grad():
            shapes = {at: n for at, n in view.stored.items() if at[1] not in GLASS}
            leaves, lens = view.leaves(shapes)
            n = torch.from_numpy(np.abs(view.indices))
            media = {k: n[:, k].clone().requires_grad_() for k in view.glasses}
            _, structure, table = view.table_of(self.last, lens, media)
            columns = _columns(table, leaves | media)
        return view.table_of(self.last, view.lens)[0], structure, table.detach().numpy().copy(), columns

    @cached_property
    def is_expressible(self) -> bool:
        """Whether the compiled trace has all the surfaces."""
        return all(map(is_expressible, self.view.lens.surfaces[1 : self.last + 1]))

    @cached_property
    def _launches_itself(self) -> bool:
        lens = self.view.lens
        source = lens.surfaces[0]
        plane = source.is_plane and source.after is None
        usual = lens.fields.kind in ("angle", "object_height", "paraxial_image_height") and not lens.fields.telecentric
        return plane and usual and (not self._aims or not is_bent(lens))

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
        """All rays on surface `last`, in the order of `ask`; 0: in front of surface 1."""
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
            found = pushed_everywhere(surfaces, task, changes[: count or 0], start)
            if found is not None:
                places, size, rows = self._places[0], self.field[0].size, rows_of(task.structure, surfaces)

                def picked(part: Tensor) -> np.ndarray:
                    return part.numpy().reshape(*part.shape[:-2], size)[rows][..., places]

                by = () if count is None else map(picked, found.by_position[:2])
                return Marks(*map(picked, found.position[:2]), picked(found.valid), *by)
        hits = [bundle.hits(state) for bundle in self._each]
        parts = [[hit.position[k] for hit in hits] for k in range(2)]
        values = (np.stack([value_of(one) for one in part]) for part in parts)
        slopes = (np.stack([slope_of(one, state.count) for one in part]) for part in parts if state.count)
        return Marks(*values, np.stack([hit.valid for hit in hits]), *slopes)

    @cached_property
    def _each(self) -> list["Bundle"]:
        return [self.on(surface) for surface in range(1, self.last + 1)]

    def _traced(self, state: LensState, position, direction, opl, valid: np.ndarray):
        """Rays behind surface `last` as a table, and by how many variables they change, if any."""
        surfaces, task, changes, start, count = self._task(state, position, direction, opl, valid)
        return (ends(surfaces, task) if count is None else pushed(surfaces, task, changes, start)), count

    def _task(self, state: LensState, position, direction, opl, valid: np.ndarray):
        """Surfaces, what to trace, how table and rays change, and by how many variables, if any."""
        surfaces, structure, *_ = self._template
        table, changes = self.table(state)
        moving = [part for part in (*position, *direction, opl) if isinstance(part, Dual)]
        given = [np.stack([value_of(p) for p in part]) for part in (position, direction)] + [value_of(opl)]
        given = [torch.from_numpy(np.ascontiguousarray(part)) for part in given]
        task = Task(structure, torch.from_numpy(valid), (*given, torch.from_numpy(table)))
        count = state.count or max((len(part.slope) for part in moving), default=0)
        if not count:
            return surfaces, task, torch.from_numpy(changes), None, None
        start = self._start(count, position, direction, opl) if moving else None
        changes = changes if state.count else np.zeros((count, *table.shape))
        return surfaces, task, torch.from_numpy(changes), start, count

    def starts(self, state: LensState) -> Hits:
        """All rays at their launch, before surface 1 and in its axes, in the order of `ask`."""
        position, direction, opl, valid = self.launched(state)
        return self._as_hits(state, (*position, *direction, opl), valid)

    def _as_hits(self, state: LensState, parts, valid: np.ndarray) -> Hits:
        slopes = [slope_of(part, state.count) for part in parts] if state.count else None
        return Hits([value_of(part) for part in parts], slopes, valid, self._places[0])

    def _start(self, count: int, position, direction, opl) -> tuple[Tensor, Tensor, Tensor]:
        slopes = torch.from_numpy(np.stack([slope_of(part, count) for part in (*position, *direction, opl)]))
        return slopes[:3], slopes[3:6], slopes[6]

    def _hits(self, end, count: int | None) -> Hits:
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
        for at, number in state.numbers.items():
            if at not in columns:
                continue
            table[:, columns[at]] = value_of(number)
            if isinstance(number, Dual):
                changes[:, :, columns[at]] = number.slope[:, None, None]
        for surface, index in state.media.items():
            if surface in columns:
                table[:, columns[surface]] = value_of(index)[:, None]
                if isinstance(index, Dual):
                    changes[:, :, columns[surface]] = index.slope[:, :, None]
        return table, changes

    def _table_by_torch(self, state: LensState) -> tuple[np.ndarray, np.ndarray]:
        with torch.enable_grad():
            leaves, lens = self.view.leaves({at: value_of(n) for at, n in state.numbers.items()})
            table = self.view.table_of(self.last, lens)[2]
            by = _by_leaves(table, leaves) if state.count else {}
        changes = np.zeros((state.count, *table.shape))
        for at, derivative in by.items():
            if isinstance(state.numbers[at], Dual):
                changes += state.numbers[at].slope[:, None, None] * derivative
        return table.detach().numpy(), changes

    def launched(self, state: LensState):
        """Position and direction (three of (W, R) each), path (W, R) and validity of the rays before surface 1."""
        if not self._launches_itself:
            return self._launched_by_torch(state)
        if not self._aims:
            return self._through(state, self.pupil)
        pupil, found = self._aimed(state)
        *rays, valid = self._through(state, pupil)
        return *rays, valid & found

    def _through(self, state: LensState, pupil):
        shape = self.field.shape[1:]
        position, direction, opl = launched(state, self.field, pupil)
        filled = [part + np.zeros(shape) for part in (*position, *direction, opl)]
        return filled[:3], filled[3:6], filled[6], np.ones(shape, dtype=bool)

    def _aimed(self, state: LensState):
        """Pupil points, two of (W, R), whose rays pass the stop at `pupil`, and which of them converged."""
        stop, shape = self._at_stop, self.field.shape[1:]

        def at_stop(state: LensState, pupil):
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
        return tuple(part + np.zeros(shape) for part in pupil), converged

    @cached_property
    def _last_aim(self) -> np.ndarray:
        """The pupil points of the last aiming, where the next one starts."""
        return self.pupil

    def _stop_radius(self, state: LensState):
        """mm, negative where the entrance pupil is an inverted image of the stop."""
        lens = self.view.lens
        paraxial = 0.5 * state.entrance_pupil_diameter * state.gaussian(state.primary).front[0]
        if lens.aperture.kind == "float_by_stop":
            return float(lens.aperture.value) * np.sign(value_of(paraxial))
        if lens.ray_aiming == "paraxial":
            return paraxial
        marginal = self._marginal
        hits = marginal._hits(*marginal._traced(state, *marginal._through(state, marginal.pupil)))
        height = hits.position[1][np.array([0])]
        real = np.abs(height) * np.sign(value_of(paraxial))
        return real[0] if hits.valid[0] else paraxial

    def _launched_by_torch(self, state: LensState):
        parts, valid = rays_by_torch(state, self._start_by_torch, self.field.shape[1:], backward=self._aims_bent)
        return parts[:3], parts[3:6], parts[6], valid

    def _start_by_torch(self, lens: Lens) -> Rays:
        field, pupil = torch.from_numpy(self.field), torch.from_numpy(self.pupil)
        return rays_of_field(lens, field, pupil, wavelength=lens.wavelengths[:, None])

    @cached_property
    def _aims_bent(self) -> bool:
        return self._aims and is_bent(self.view.lens)

    def _hits_by_torch(self, state: LensState) -> Hits:
        def end(lens: Lens) -> Rays:
            wavelength = lens.wavelengths[:, None]
            indices = unbent(lens, media(lens, wavelength)[: self.last + 1])
            rays = self._start_by_torch(lens)
            return trace_surfaces(sequence_of(lens)[: self.last], rays, indices=indices, wavelength=wavelength)

        parts, valid = rays_by_torch(state, end, self.field.shape[1:], backward=self._aims_bent)
        return self._as_hits(state, parts, valid)


def _by_leaves(table: Tensor, leaves: dict) -> dict:
    """∂table/∂leaf (W, K), or (W, K, W) of a leaf (W,), of every leaf that it depends on."""
    every = torch.eye(table.numel(), dtype=table.dtype)
    if not leaves or not table.requires_grad:
        return {}
    by = torch.autograd.grad(table.reshape(-1), list(leaves.values()), every, is_grads_batched=True, allow_unused=True)
    pairs = zip(leaves, by, strict=True)
    return {at: g.reshape(*table.shape, *leaves[at].shape).numpy() for at, g in pairs if g is not None}


def _columns(table: Tensor, leaves: dict) -> dict | None:
    """The columns that hold a leaf unchanged, by address; None if a column holds a function of a leaf."""
    columns = {}
    for at, derivative in _by_leaves(table, leaves).items():
        leaf = leaves[at].detach().numpy()
        held = (table.detach().numpy() == (leaf if leaf.ndim == 0 else leaf[:, None])).all(0)
        unchanged = np.eye(len(table)) if leaf.ndim else np.ones(len(table))
        by_column = derivative.swapaxes(0, 1)  # (K, W, …)
        moving = (by_column != 0).reshape(len(by_column), -1).any(-1)
        if not (held[moving].all() and (by_column[moving] == unchanged).all()):
            return None
        columns[at] = np.flatnonzero(moving)
    return columns

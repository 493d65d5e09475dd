"""Sequential ray tracing: transfer, intersection, deflection and clipping at one surface after the other.

The trace is a generator: to record, draw or find where a ray failed, consume `steps`; to resume from stored rays, pass
them with the remaining surfaces. `trace_surfaces` and `trace_lens` return the last rays only, through the compiled
engine where that is available and pays. Numbers that carry derivatives by variables (`maths.tangents`) hand them to the
rays: in the compiled engine each ray carries its derivatives from surface to surface, and no graph is made.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from typing import NamedTuple, TypedDict

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import detached, dot, is_wrapped, value
from raytrace.maths.tangents import tangents_of, value_of, with_tangents
from raytrace.system.apertures import inside
from raytrace.system.intersection import meet
from raytrace.system.lens import Lens, media, shared
from raytrace.system.phases import IdealLens, kind_of
from raytrace.system.poses import Gap, Turn, direction_in, point_in
from raytrace.system.rays import Rays
from raytrace.system.surface import Surface, gap_behind, is_posed, is_round
from raytrace.tracing.compiled import (
    Changes,
    Prepared,
    Pushed,
    Task,
    forward,
    is_expressible,
    push,
    rows_of,
    task_of,
    trace_compiled,
    uses_compiled,
    with_numbers,
)
from raytrace.tracing.paraxial import power, signed, ynu
from raytrace.tracing.refraction import deflect
from raytrace.words import RaytraceError, named

_STRAIGHT = 1e-9  # mm and direction cosines: smaller deviations of an axial ray are ignored


@value
class Crossing:
    """Rays behind one surface, in its vertex frame, and the reasons why rays end there.

    missed, totally_reflected: (...) bool, also of a ray that was vignetted before, which is traced on.
    clipped: (...) bool, the ray is vignetted here and was valid before.
    """

    rays: Rays
    missed: Tensor
    totally_reflected: Tensor
    clipped: Tensor


class Passage(TypedDict):
    """Options of `steps` and `trace_surfaces` for one run of surfaces."""

    indices: Sequence[Tensor]
    wavelength: Tensor | None
    side: int
    gap: Tensor | Gap | None


class _Ray(NamedTuple):
    """Rays by components, as the loop over surfaces carries them."""

    position: Sequence[Tensor]
    direction: Sequence[Tensor]
    valid: Tensor
    opl: Tensor | None

    @staticmethod
    def of(rays: Rays) -> "_Ray":
        return _Ray(rays.position.unbind(0), rays.direction.unbind(0), rays.valid, rays.opl)

    def rays(self) -> Rays:
        x, y, z, L, M, N = torch.broadcast_tensors(*self.position, *self.direction)
        return Rays(torch.stack([x, y, z]), torch.stack([L, M, N]), self.valid, self.opl)


def cross(
    surface: Surface,
    rays: Rays,
    gap: Tensor | Gap | None,
    side: int,
    n1: Tensor,
    n2: Tensor,
    wavelength: Tensor | None = None,
) -> Crossing:
    """Carry rays over the gap before a surface and through the surface.

    rays: in the frame of the surface before or, if gap is None, of this one before its pose; gap: mm between the two
    vertices, or a `gap_behind`; side: σ = ±1, the axial direction of light in the gap; n1, n2: (...) indices before and
    behind; wavelength: (...) µm, needed by surfaces with a phase. n2 the same tensor as n1: a dummy surface.
    """
    return _crossing(_Ray.of(rays), *_cross(surface, _Ray.of(rays), gap, side, n1, n2, wavelength))


def _crossing(before: _Ray, after: _Ray, met: Tensor, passes: Tensor | None, clear: Tensor | None) -> Crossing:
    survives = met if passes is None else met & passes
    return Crossing(
        after.rays(),
        ~met,
        torch.zeros_like(met) if passes is None else met & ~passes,
        torch.zeros_like(after.valid) if clear is None else before.valid & survives & ~clear,
    )


#: Rays behind a surface, and whether those before it meet it, are not totally reflected, pass its apertures.
_Crossed = tuple[_Ray, Tensor, Tensor | None, Tensor | None]


def _cross(
    surface: Surface,
    rays: _Ray,
    gap: Tensor | Gap | None,
    side: int,
    n1: Tensor,
    n2: Tensor,
    wavelength: Tensor | None,
) -> _Crossed:
    if isinstance(gap, Gap) or surface.before is not None or surface.is_break:
        rays, gap = _in_axes_of(surface, rays, gap, side, n1), None
        if surface.is_break:
            return rays, torch.ones_like(rays.valid), None, None
    direction = rays.direction
    x, y, z = rays.position
    meeting = meet(surface, rays.position if gap is None else (x, y, z - gap), direction)
    hit, met, opl = meeting.hit, meeting.met, rays.opl
    if opl is not None:
        opl = opl + n1 * _reduced_path(rays.position, hit, direction, gap, side)
    direction, passes, added = deflect(surface, meeting, direction, n1, n2, wavelength)
    opl = opl if opl is None or added is None else opl + added
    survives = met if passes is None else met & passes
    clear = inside(surface.apertures, hit) if surface.apertures else None
    valid = rays.valid & survives
    after = _Ray(
        position=[x if surface.is_plane and i == 2 else torch.where(survives, x, 0.0) for i, x in enumerate(hit)],
        direction=[torch.where(survives, d, axis) for d, axis in zip(direction, (0.0, 0.0, 1.0), strict=True)],
        valid=valid if clear is None else valid & clear,
        opl=opl if opl is None else torch.where(survives, opl, 0.0),
    )
    return after, met, passes, clear


def _in_axes_of(surface: Surface, rays: _Ray, gap: Tensor | Gap | None, side: int, n1: Tensor) -> _Ray:
    """Rays in the axes of the surface; their path less that of the axial ray in the gap, n1 T σ."""
    position, direction, opl = rays.position, rays.direction, rays.opl
    if isinstance(gap, Gap):
        position, direction = point_in(gap.pose, position), direction_in(gap.pose, direction)
    thickness = gap.thickness if isinstance(gap, Gap) else gap
    if thickness is not None:
        x, y, z = position
        position = x, y, z - thickness
        opl = opl if opl is None else opl - n1 * (thickness * side)
    if surface.before is not None:
        position, direction = point_in(surface.before, position), direction_in(surface.before, direction)
        if isinstance(surface.before, Turn) and opl is not None:
            opl = opl - surface.before.path
    return _Ray(position, direction, rays.valid, opl)


def _reduced_path(
    start: Sequence[Tensor], hit: Sequence[Tensor], direction: Sequence[Tensor], gap: Tensor | None, side: int
) -> Tensor:
    """Path from start (old frame) to hit (new frame) less the axial ray's T σ, without forming either.

    t - T σ = (hit - start)·d + T (N - σ),   N - σ = -σ (L² + M²)/(1 + σ N)
    """
    path = dot([a - b for a, b in zip(hit, start, strict=True)], direction)
    if gap is None:
        return path
    L, M, N = direction
    forward = side * N > 0
    lag = torch.where(forward, -side * (L * L + M * M) / torch.where(forward, 1 + side * N, 1.0), N - side)
    return path + gap * lag


def steps(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    wavelength: Tensor | None = None,
    side: int = 1,
    gap: Tensor | Gap | None = None,
) -> Iterator[Crossing]:
    """Yield the `Crossing` of each surface in turn.

    rays: before surfaces[0], in its frame before its pose or, with `gap`, in that of the surface before it (mm, or its
    `surface.gap_behind`); indices: len(surfaces) + 1 media (...), the first before surfaces[0]; wavelength: (...) µm,
    needed by surfaces with a phase; side: axial direction of light before surfaces[0] (-1 behind an odd number of
    mirrors).
    """
    for before, crossed in _walk(surfaces, rays, indices=indices, wavelength=wavelength, side=side, gap=gap):
        yield _crossing(before, *crossed)


def _walk(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    wavelength: Tensor | None,
    side: int,
    gap: Tensor | Gap | None,
) -> Iterator[tuple[_Ray, _Crossed]]:
    """The rays before each surface in turn, and behind it."""
    before = _Ray.of(rays)
    for surface, n1, n2 in zip(surfaces, indices[:-1], indices[1:], strict=True):
        crossed = _cross(surface, before, gap, side, n1, n2, wavelength)
        yield before, crossed
        before, gap = crossed[0], gap_behind(surface)
        side = -side if surface.is_mirror else side


def trace_surfaces(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    wavelength: Tensor | None = None,
    side: int = 1,
    gap: Tensor | Gap | None = None,
    prepared: Prepared | None = None,
) -> Rays:
    """The rays behind the last of the surfaces; arguments as for `steps`. prepared: of earlier calls that differ in the
    rays alone; the call adds its own.

    The compiled engine traces the runs of surfaces that it supports, where it pays: see `tracing.compiled`.
    """
    if torch.compiler.is_compiling():
        return _eager(surfaces, rays, indices=indices, wavelength=wavelength, side=side, gap=gap)
    first = 0
    for expressible, run in itertools.groupby(surfaces, is_expressible):
        last = first + len(list(run))
        passage = Passage(indices=indices[first : last + 1], wavelength=wavelength, side=side, gap=gap)
        end = None
        if expressible and uses_compiled(rays, indices[first], last - first):
            of_run = None if prepared is None else prepared.setdefault(first, {})
            end = trace_compiled(surfaces[first:last], rays, **passage, eager=_eager, prepared=of_run)
        rays = _eager(surfaces[first:last], rays, **passage) if end is None else end
        side = side * side_behind(surfaces[first:last])
        gap, first = gap_behind(surfaces[last - 1]), last
    return rays


def _eager(
    surfaces: Sequence[Surface],
    rays: Rays,
    *,
    indices: Sequence[Tensor],
    wavelength: Tensor | None = None,
    side: int,
    gap: Tensor | Gap | None,
) -> Rays:
    after = None
    for _, crossed in _walk(surfaces, rays, indices=indices, wavelength=wavelength, side=side, gap=gap):
        after = crossed[0]
    return rays if after is None else after.rays()


def trace_lens(lens: Lens, rays: Rays, wavelength: Tensor) -> Rays:
    """Rays traced from the frame of surface 1 to the image surface, in its frame.

    wavelength: µm, broadcast against the batch shape of the rays.
    """
    return trace_surfaces(sequence_of(lens), rays, indices=media(lens, wavelength), wavelength=wavelength)


def lens_steps(lens: Lens, rays: Rays, wavelength: Tensor) -> Iterator[Crossing]:
    """The crossings of rays before surface 1 with every surface after the object; wavelength: (...) µm."""
    return steps(sequence_of(lens), rays, indices=media(lens, wavelength), wavelength=wavelength)


def lens_task(lens: Lens, rays: Rays, wavelength: Tensor) -> Task | None:
    """The input of the compiled trace for `trace_lens`; None where it does not support these surfaces or rays."""
    surfaces = sequence_of(lens)
    if not all(map(is_expressible, surfaces)):
        return None
    return task_of(surfaces, rays, indices=media(lens, wavelength), wavelength=wavelength)


def points_on_surfaces(lens: Lens, rays: Rays, wavelength: Tensor) -> Tensor | None:
    """Points (3, K, ...) mm of rays before surface 1 on the K surfaces after the object, each in its own axes.

    By the compiled trace, without gradients; None where it does not support these rays, or where a ray fails.
    """
    surfaces, task = sequence_of(lens), lens_task(lens, rays, wavelength)
    if task is None or not _is_compiled(surfaces, task):
        return None
    no_changes = task.inputs[3].new_empty(0, *task.inputs[3].shape)
    behind = push(task, no_changes, everywhere=True)
    return behind.position[:, rows_of(task.structure, surfaces)] if bool(behind.valid.all()) else None


def axial_path(surfaces: Sequence[Surface], indices: Sequence[Tensor], side: int = 1) -> Tensor:
    """Σ n T σ (...) in mm of the axial ray, first to last vertex: add it to `Rays.opl` for the full path."""
    total = torch.zeros_like(indices[0])
    for surface, n in zip(surfaces[:-1], indices[1:-1], strict=True):
        side = -side if surface.is_mirror else side
        total = total + n * surface.thickness * side
    return total


def sequence_of(lens: Lens) -> tuple[Surface, ...]:
    """The surfaces after the object as they are traced: ideal lenses with the vergence of the axial object point.

    It is that of the paraxial ray on the straightened axis, at the primary wavelength.
    """
    surfaces = lens.surfaces[1:]
    if not any(isinstance(surface.phase, IdealLens) for surface in surfaces):
        return surfaces
    indices, sequence = media(lens, lens.primary), []
    n = signed(surfaces, indices)
    powers = [power(*each, lens.primary) for each in zip(surfaces, n[:-1], n[1:], strict=True)]
    gaps = [surface.thickness / behind for surface, behind in zip(surfaces, n[1:], strict=True)]
    rays = ynu(torch.ones_like(n[0]), n[0] / lens.surfaces[0].thickness, powers, gaps)
    for surface, before, (y, omega) in zip(surfaces, indices, rays, strict=False):
        if isinstance(surface.phase, IdealLens):
            vergence = omega / (before * torch.where(y == 0, torch.finfo(y.dtype).tiny ** 0.5, y))
            surface = dataclasses.replace(surface, phase=dataclasses.replace(surface.phase, vergence=vergence))
        sequence.append(surface)
    return tuple(sequence)


def at_stop(lens: Lens, rays: Rays, wavelength: Tensor) -> tuple[Tensor, Tensor]:
    """The points (2, ...) mm where rays in front of surface 1 meet the stop, and whether they do, vignetted or not."""
    (stop,), arrives = points_at(lens, wavelength, (lens.stop,))(rays)
    return stop, arrives


@shared
def without_apertures(lens: Lens) -> Lens:
    """The lens without apertures: no ray is vignetted."""
    if not any(surface.apertures for surface in lens.surfaces):
        return lens
    return dataclasses.replace(lens, surfaces=_unclipped(lens.surfaces))


def _unclipped(surfaces: Sequence[Surface]) -> tuple[Surface, ...]:
    return tuple(dataclasses.replace(each, apertures=()) if each.apertures else each for each in surfaces)


def points_at(lens: Lens, wavelength: Tensor, numbers: Sequence[int]) -> Callable[[Rays], tuple[list[Tensor], Tensor]]:
    """The map from rays to where they meet the surfaces of these ascending numbers, (2, ...) mm each, and whether they
    reach the last."""
    trace = rays_at(lens, wavelength, numbers)

    def points(rays: Rays) -> tuple[list[Tensor], Tensor]:
        *_, last = each = trace(dataclasses.replace(rays, opl=None))
        return [met.position[:2] for met in each], last.valid

    return points


def rays_at(
    lens: Lens, wavelength: Tensor, numbers: Sequence[int], *, first: int = 0, indices: Sequence[Tensor] | None = None
) -> Callable[[Rays], list[Rays]]:
    """The map from rays to those behind each of the surfaces of these ascending numbers; no ray is vignetted.

    Surfaces and media are prepared once, for searches that trace many batches in turn. first: the surface that the rays
    are behind, 0 in front of surface 1; indices: of all media, computed by default.
    """
    indices = media(lens, wavelength) if indices is None else indices
    surfaces = lens.surfaces[0], *_unclipped(sequence_of(lens))
    runs: list[tuple[Sequence[Surface], Passage, Prepared]] = []
    side = side_behind(surfaces[: first + 1])
    for last in numbers:
        run, gap = surfaces[first + 1 : last + 1], gap_behind(lens.surfaces[first]) if first else None
        runs.append((run, Passage(indices=indices[first : last + 1], wavelength=wavelength, side=side, gap=gap), {}))
        first, side = last, side * side_behind(run)

    def trace(rays: Rays) -> list[Rays]:
        each = []
        for run, passage, prepared in runs:
            rays = trace_surfaces(run, rays, **passage, prepared=prepared)
            each.append(rays)
        return each

    return trace


def side_behind(surfaces: Sequence[Surface]) -> int:
    """The axial direction of light that has entered them towards +z: -1 behind an odd number of mirrors."""
    return -1 if sum(surface.is_mirror for surface in surfaces) % 2 else 1


def is_bent(lens: Lens) -> bool:
    """Whether the axis bends: a surface is tilted or decentred, a coordinate break, or deflects the axial ray.

    A tilted object counts, whose image along the axis depends on the field.
    """
    return is_posed(lens.surfaces[0]) or _bends(lens, lens.surfaces)


def aiming_of(lens: Lens) -> str:
    """The ray aiming of a lens, "off", "paraxial" or "real".

    "auto" resolves to "real" if a surface in front of the stop bends the axis, or the stop is tilted or decentred (the
    straightened entrance pupil is then no image of the stop), and else to "off".
    """
    if lens.ray_aiming != "auto":
        return lens.ray_aiming
    stop = lens.surfaces[lens.stop]
    moved = stop.is_break or stop.before is not None
    return "real" if moved or _bends(lens, lens.surfaces[: lens.stop]) else "off"


def _bends(lens: Lens, surfaces: Sequence[Surface]) -> bool:
    """Whether these first surfaces of a lens bend its axis."""
    if any(map(is_posed, surfaces[1:])):
        return True
    if all(map(is_round, surfaces)):
        return False
    if any(isinstance(n, Tensor) and is_wrapped(n) for n in pytree.tree_leaves(lens)):
        # Values are hidden inside a transform.
        phases = [kind_of(surface.phase) for surface in surfaces if surface.phase is not None]
        return any(not kind.is_round and not kind.slopes for kind in phases)
    with torch.no_grad():
        lens = detached(lens)
        axis = lens.surfaces[-2].thickness.new_tensor([0.0, 0.0, 1.0])
        off = [0 * axis[:2]]
        for crossing in islice(lens_steps(lens, Rays(0 * axis, axis, axis[2] > 0), lens.primary), len(surfaces) - 1):
            off += [crossing.rays.position[:2], crossing.rays.direction[:2]]
        return bool((torch.stack(off).abs() > _STRAIGHT).any())


class Bent(RaytraceError, ValueError):
    """A quantity that needs a straight axis is requested of a lens whose axis bends; the message has the surface."""


def need_axis(lens: Lens, what: str, instead: str = "") -> None:
    """Raise Bent for a lens whose axis bends. what: the quantity; instead: an alternative for the message."""
    if not is_bent(lens):
        return
    posed = [k for k, surface in enumerate(lens.surfaces) if is_posed(surface)]
    other = [k for k, surface in enumerate(lens.surfaces) if not is_round(surface)]
    reason = "it bends"
    if posed:
        surface = lens.surfaces[posed[0]]
        reason = f"surface {posed[0]} is " + ("a coordinate break" if surface.is_break else "tilted or decentred")
    elif other:
        surface = lens.surfaces[other[0]]
        part = surface.sag_terms if surface.phase is None else surface.phase
        reason = f"surface {other[0]} ({named(part)}) takes light off it"
    message = f"{what} needs one straight axis, but {reason}"
    raise Bent(f"{message}; {instead}" if instead else message)


def pushed(surfaces: Sequence[Surface], task: Task, changes: Tensor, start: Changes | None = None) -> Pushed:
    """`compiled.push` by the engine that is chosen; surfaces: those that the task was made of."""
    if _is_compiled(surfaces, task):
        return push(task, changes, start)
    return _pushed_by_torch(surfaces, task, changes, start)


def pushed_everywhere(
    surfaces: Sequence[Surface], task: Task, changes: Tensor, start: Changes | None = None
) -> Pushed | None:
    """`compiled.push` behind every row; None where the compiled trace does not support these rays."""
    return push(task, changes, start, everywhere=True) if _is_compiled(surfaces, task) else None


def ends(surfaces: Sequence[Surface], task: Task) -> Rays:
    """The rays behind the last surface alone, by the engine that is chosen."""
    return forward(task) if _is_compiled(surfaces, task) else _behind(surfaces, task, *task.inputs)


def _is_compiled(surfaces: Sequence[Surface], task: Task) -> bool:
    position, direction, opl, table = task.inputs
    return uses_compiled(Rays(position, direction, task.valid, opl), table, len(surfaces))


def _behind(
    surfaces: Sequence[Surface], task: Task, position: Tensor, direction: Tensor, opl: Tensor | None, table: Tensor
) -> Rays:
    rebuilt, indices, gap = with_numbers(task.structure, surfaces, table, task.valid.shape[:-1])
    return trace_surfaces(rebuilt, Rays(position, direction, task.valid, opl), indices=indices, gap=gap)


def _pushed_by_torch(surfaces: Sequence[Surface], task: Task, changes: Tensor, start: Changes | None) -> Pushed:
    """As `push`, by tensors that carry their derivatives."""
    position, direction, opl, table = detached(task.inputs)
    if start is not None:
        by_position, by_direction, by_opl = start
        position = with_tangents(position, by_position.movedim(1, 0))
        direction = with_tangents(direction, by_direction.movedim(1, 0))
        opl = opl if by_opl is None or opl is None else with_tangents(opl, by_opl)
    with torch.enable_grad():
        end = _behind(surfaces, task, position, direction, opl, with_tangents(table, changes))
    return Pushed(
        value_of(end.position),
        value_of(end.direction),
        None if end.opl is None else value_of(end.opl),
        end.valid,
        tangents_of(end.position, len(changes)).movedim(0, 1),
        tangents_of(end.direction, len(changes)).movedim(0, 1),
        None if end.opl is None else tangents_of(end.opl, len(changes)),
    )

"""Scenes: object distance × field × wavelength, their rays on the sensor, and rays reused between calls.

In an optimisation the same rays meet the same first surfaces again and again. A `Memo` stores them in front of the
first surface that depends on a variable, and later calls resume there: with the sensor distance as the only variable,
rays are only propagated to the new sensor. A number is a variable if autograd says that it requires a gradient.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.budget import afford_rays
from raytrace.maths.numerics import broadcast_shape, in_transform, value, varies
from raytrace.system.apertures import SHAPES, Aperture
from raytrace.system.lens import Lens, aligned, is_round_about_axis, media, one_lens, with_object_distance
from raytrace.system.rays import Rays
from raytrace.system.surface import SHAPE, gap_behind
from raytrace.tracing.launch import rays_of_field, vignette
from raytrace.tracing.trace import points_at, rays_at, sequence_of, side_behind, trace_lens, trace_surfaces

_NODES = 10  # object distances that are traced in place of a range
_CLOSE = 1e-9  # mm and direction cosines: accepted error of interpolated rays

#: lens, field (2, ...), wavelength (...) µm, pupil (2, ...) of a bundle of rays.
Bundle = tuple[Lens, Tensor, Tensor, Tensor]


# -- reuse of rays -----------------------------------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True)
class _Front:
    """Rays behind the first `count` surfaces after the object, in the frame of the last of them (of surface 1 if 0).

    points: (2, ...) mm where they meet the requested surfaces among these; indices: of all media, None if one depends
    on a variable; smooth: whether polynomials in 1/distance reproduce the rays.
    """

    count: int
    rays: Rays | None
    points: list[Tensor]
    indices: list[Tensor] | None
    smooth: bool = False


@dataclasses.dataclass(frozen=True)
class _Stored:
    """A result and the numbers that it is valid for; None marks a variable."""

    structure: Any
    constants: list[Tensor | None]
    result: Any

    def holds_for(self, numbers: Sequence[Tensor], structure: Any) -> bool:
        return self.structure == structure and all(
            stored is None or (not number.requires_grad and _equal(stored, number))
            for stored, number in zip(self.constants, numbers, strict=True)
        )


def _equal(a: Tensor, b: Tensor) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)


class Memo:
    """Results reused between calls, as in `psf(..., memo=memo)` of an optimisation loop.

    Of a lens these are rays. Numbers of the lens, fields and wavelengths that require a gradient are variables; the
    others are compared at each call, and rays are retraced after a change: a memo changes no result. Of a wave scene
    it is everything that does not depend on the heights of its elements. Inside transforms of `torch.func`, which hide
    the variables, a memo is ignored. most: bundles stored, the oldest being dropped first; made: bundles made so far;
    crossed: surfaces traced through. object_distances: range in mm of scenes with random distances: their rays are a
    polynomial in 1/distance through ten traced ones if its error is below 1e-9 mm, else traced.
    """

    def __init__(self, most: int = 64, *, object_distances: tuple[float, float] | None = None):
        self._stored: list[_Stored] = []
        self._most = most
        self._range = object_distances
        self.made = self.crossed = 0

    def find(
        self, numbers: Sequence[Tensor], structure: Any, make: Callable[[], Any], *, most: int | None = None
    ) -> Any:
        """`make()`, or its stored result for the same structure and constants."""
        for stored in self._stored:
            if stored.holds_for(numbers, structure):
                return stored.result
        result = make()
        self.made += 1
        constants = [None if n.requires_grad else n.detach().clone() for n in numbers]
        self._stored = [*self._stored, _Stored(structure, constants, result)][-(most or self._most) :]
        return result

    def front(self, bundle: Bundle, numbers: tuple[int, ...] | None = None) -> _Front:
        """The rays in front of the first surface that depends on a variable.

        numbers: of surfaces whose points are requested; then the rays have no paths, and no aperture stops them.
        """
        distance, pupil = bundle[0].surfaces[0].thickness, bundle[3]
        # Where rays fail, each object distance has its own pupil points.
        if self._range is not None and distance.dim() == 4 and pupil.dim() == 2:
            low, high = self._range
            if bool(((distance >= low) & (distance <= high)).all()):
                front = self._find_or_trace(_at_nodes(bundle, self._range), numbers, judge=_is_smooth)
                if front.rays is not None and front.smooth:
                    near, far = 1 / low, 1 / high
                    weights = _series_weights((2 / distance.flatten() - (near + far)) / (near - far))
                    return _at_distances(front, front.rays, weights)
        return self._find_or_trace(bundle, numbers, judge=lambda front: False)

    def _find_or_trace(
        self, bundle: Bundle, numbers: tuple[int, ...] | None, *, judge: Callable[[_Front], bool]
    ) -> _Front:
        leaves, structure = pytree.tree_flatten((bundle, numbers))
        key = structure, tuple(None if isinstance(leaf, Tensor) else leaf for leaf in leaves)

        def trace() -> _Front:
            front = _constant_front(bundle, numbers)
            self.crossed += front.count
            return dataclasses.replace(front, smooth=judge(front))

        return self.find([leaf for leaf in leaves if isinstance(leaf, Tensor)], key, trace)


def trace_bundle(bundle: Bundle, memo: Memo | None = None) -> Rays:
    """The rays of field and pupil points at the image surface; everything broadcasts."""
    lens, _, wavelength, _ = bundle
    if memo is None or in_transform():
        return trace_lens(lens, _launched(bundle), wavelength)
    front = memo.front(bundle)
    done, rays, indices = _resumed(bundle, front, memo)
    return trace_surfaces(
        sequence_of(lens)[done:],
        rays,
        indices=indices[done:],
        wavelength=wavelength,
        side=side_behind(lens.surfaces[1 : done + 1]),
        gap=gap_behind(lens.surfaces[done]) if done else None,
    )


def points_of_bundle(bundle: Bundle, numbers: tuple[int, ...], memo: Memo | None = None) -> tuple[list[Tensor], Tensor]:
    """`points_at` of the rays of field and pupil points; everything broadcasts."""
    lens, _, wavelength, _ = bundle
    if memo is None or in_transform():
        return points_at(lens, wavelength, numbers)(_launched(bundle))
    front = memo.front(bundle, numbers)
    done, rays, indices = _resumed(bundle, front, memo)
    left = numbers[len(front.points) :]
    trace = rays_at(lens, wavelength, left, first=done, indices=indices)
    each = trace(dataclasses.replace(rays, opl=None))
    return [*front.points, *(met.position[:2] for met in each)], (each[-1] if each else rays).valid


def _launched(bundle: Bundle) -> Rays:
    lens, field, wavelength, pupil = bundle
    return rays_of_field(lens, field, vignette(lens, field, pupil), wavelength=wavelength)


def _resumed(bundle: Bundle, front: _Front, memo: Memo) -> tuple[int, Rays, list[Tensor]]:
    """The surface behind which the trace of a bundle resumes, its rays there, and the indices of all media."""
    lens, _, wavelength, _ = bundle
    memo.crossed += len(lens.surfaces) - 1 - front.count
    rays = _launched(bundle) if front.rays is None else front.rays
    return front.count, rays, media(lens, wavelength) if front.indices is None else front.indices


def _constant_front(bundle: Bundle, numbers: tuple[int, ...] | None) -> _Front:
    """The rays traced until they depend on a variable; without rays where they do from the start."""
    lens, _, wavelength, _ = bundle
    with torch.enable_grad():
        rays, indices = _launched(bundle), media(lens, wavelength)
    constant_indices = None if any(index.requires_grad for index in indices) else indices
    if any(t is not None and t.requires_grad for t in (rays.position, rays.direction, rays.opl)):
        return _Front(0, None, [], constant_indices)
    surfaces, points = sequence_of(lens), []
    for count, surface in enumerate(surfaces):  # up to a surface whose position, shape or media depend on a variable
        gap = gap_behind(lens.surfaces[count]) if count else None
        shape = [getattr(surface, name) for name in (*SHAPE, "phase", "before")]
        phased = (wavelength,) if surface.phase is not None else ()
        leaves = pytree.tree_leaves((gap, shape, *phased, *indices[count : count + 2]))
        if any(isinstance(leaf, Tensor) and leaf.requires_grad for leaf in leaves):
            break
    else:
        count = len(surfaces)
    with torch.enable_grad():
        if numbers is None:
            rays = trace_surfaces(surfaces[:count], rays, indices=indices[: count + 1], wavelength=wavelength)
        elif count:
            passed = [number for number in numbers if number <= count]
            stops = dict.fromkeys([*passed, count])
            trace = rays_at(lens, wavelength, [*stops], indices=indices)
            each = trace(dataclasses.replace(rays, opl=None))
            rays, points = each[-1], [met.position[:2] for met in each[: len(passed)]]
    return _Front(count, rays, points, constant_indices)


# -- interpolation in object distance ---------------------------------------------------------------------------------


def _at_nodes(bundle: Bundle, ends: tuple[float, float]) -> Bundle:
    """The bundle at _NODES object distances (Chebyshev points of 1/distance) and, as a check, at as many between."""
    lens, field, wavelength, pupil = bundle
    odd = torch.arange(1, 2 * _NODES, 2, dtype=torch.float64, device="cpu")
    node = torch.cos(math.pi / (2 * _NODES) * torch.cat([odd, odd + 1]))
    near, far = 1 / ends[0], 1 / ends[1]
    distance = 1 / (0.5 * (near + far) + 0.5 * (near - far) * node)
    like = lens.surfaces[0].thickness
    distance = distance.to(dtype=like.dtype, device=like.device).reshape(-1, *(1,) * (like.dim() - 1))
    return with_object_distance(lens, distance), field, wavelength, pupil


def _series_weights(x: Tensor) -> Tensor:
    """Weights (D, K) of values at the Chebyshev points for those at x (D,) of [-1, 1]: Σ_m T_m(x) c_mk."""
    terms = [torch.ones_like(x), x]
    for _ in range(_NODES - 2):
        terms.append(2 * x * terms[-1] - terms[-2])
    angle = (2 * torch.arange(_NODES, dtype=x.dtype, device=x.device) + 1) * (math.pi / (2 * _NODES))
    order = torch.arange(_NODES, dtype=x.dtype, device=x.device)[:, None]
    series = torch.cos(order * angle) * torch.where(order == 0, 1.0, 2.0) / _NODES
    return torch.stack(terms, -1) @ series


def _is_smooth(front: _Front) -> bool:
    """Whether the polynomials reproduce the rays of the distances between the nodes."""
    if front.rays is None or front.count == 0 or front.rays.position.shape[1] != 2 * _NODES:
        return False
    valid = front.rays.valid.expand(front.rays.shape)
    if not torch.equal(valid, valid[:1].expand_as(valid)):
        return False
    between = torch.cos(math.pi / (2 * _NODES) * (2 * torch.arange(_NODES, dtype=torch.float64, device="cpu") + 2))
    interpolated = _combined(front.rays, _series_weights(between.to(front.rays.position)))
    traced = _part(front.rays, slice(_NODES, None))
    pairs = [(interpolated.position, traced.position), (interpolated.direction, traced.direction)]
    pairs += [] if interpolated.opl is None or traced.opl is None else [(interpolated.opl, traced.opl)]
    tolerance = _CLOSE if front.rays.position.dtype == torch.float64 else 1e-4
    return all(float((a - b).abs().max()) <= tolerance for a, b in pairs)


def _at_distances(front: _Front, rays: Rays, weights: Tensor) -> _Front:
    """The front, with its rays, of a range of object distances at those of the weights (D, K)."""
    points = [_sum_of_nodes(point, weights) for point in front.points]
    return dataclasses.replace(front, rays=_combined(rays, weights), points=points)


def _part(rays: Rays, rows: slice) -> Rays:
    """The rays of some of the object distances."""
    opl = None if rays.opl is None else rays.opl.expand(broadcast_shape(rays.shape, rays.opl.shape))[rows]
    return Rays(rays.position[:, rows], rays.direction[:, rows], rays.valid.expand(rays.shape)[rows], opl)


def _combined(rays: Rays, weights: Tensor) -> Rays:
    """Σ_k w_dk of the rays of the nodes; all of them are valid, or none of them."""
    rays = _part(rays, slice(None, _NODES))
    position, direction = (_sum_of_nodes(part, weights) for part in (rays.position, rays.direction))
    opl = None if rays.opl is None else torch.einsum("dk,k...->d...", weights, rays.opl)
    return Rays(position, direction, rays.valid[:1].expand(len(weights), *rays.valid.shape[1:]), opl)


def _sum_of_nodes(vector: Tensor, weights: Tensor) -> Tensor:
    """Σ_k w_dk of a vector (2 or 3, K, ...) of the nodes and, behind them, of the distances between."""
    return torch.einsum("dk,ck...->cd...", weights, vector[:, :_NODES])


# -- scenes ------------------------------------------------------------------------------------------------------------


@value
class Scene:
    """Object distance × field × wavelength: batch shape (D, F, W) of everything a model computes.

    lens: its object distance is (D, 1, 1), all finite or all inf, and of a batch so are other numbers; fields: (2, F)
    in the lens's kind of field, or (2, D, F), others for each object distance or lens; wavelengths: (W,) µm; memo:
    stored rays of earlier scenes, if any.
    largest: maximum of numbers () or (K,) over the whole scene that this one is a chunk of, by which decisions common
    to all its kernels are made. By default the scene is the whole.
    last: number of the surface behind which rays end, 0 in front of surface 1; by default the image.
    """

    lens: Lens
    fields: Tensor
    wavelengths: Tensor
    memo: Memo | None = None
    largest: Callable[[Tensor], Tensor] = lambda number: number
    last: int | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, F, W)."""
        return len(self.lens.surfaces[0].thickness), self.fields.shape[-1], len(self.wavelengths)

    @property
    def apertures(self) -> dict[int, tuple[Aperture, ...]]:
        """The apertures on the way of the rays, by surface."""
        surfaces = self.lens.surfaces[1 : None if self.last is None else self.last + 1]
        return {k: surface.apertures for k, surface in enumerate(surfaces, 1) if surface.apertures}

    def of(self, distances: slice | Tensor) -> "Scene":
        """The scene of some of the object distances or lenses."""
        fields = self.fields if self.fields.dim() == 2 else self.fields[:, distances]
        return dataclasses.replace(self, lens=one_lens(self.lens, distances), fields=fields)

    def of_pairs(self, numbers: Tensor) -> "Scene":
        """The scene of K pairs of an object distance, or lens, and a field: (K, 1, W), of one distance (1, K, W).

        numbers: (K,) of the pairs, d F + f.
        """
        count, fields, _ = self.shape
        distance, field = numbers // fields, numbers % fields
        places = self.fields[:, field] if self.fields.dim() == 2 else self.fields[:, distance, field]
        if count == 1:
            return dataclasses.replace(self, fields=places)
        return dataclasses.replace(self, lens=one_lens(self.lens, distance), fields=places[..., None])

    def everywhere(self, condition: Tensor) -> bool:
        """Whether a condition () holds in all of the whole scene."""
        return not bool(self.largest(~condition))


def scene(lens: Lens, fields: Tensor, object_distances: Tensor, wavelengths: Tensor, memo: Memo | None = None) -> Scene:
    """A scene; object_distances: (D,) mm, all finite or all inf; fields: (2, F), (2, D, F); wavelengths: (W,) µm.

    Of a batch of lenses (L,) there is an object distance for each, and D is L.
    """
    lens = aligned(with_object_distance(lens, object_distances), 2, exactly=True)
    return Scene(lens, fields, wavelengths, memo)


def trace_scene(scene: Scene, pupil: Tensor) -> Rays:
    """Rays (3, D, F, W, P) of pupil points (2, P) or (2, D, F, W, P) on the sensor, vignetting factors applied.

    Of a scene whose rays end at a surface: those behind it, in its frame. Raises budget.OverBudget for more rays than
    fit in memory.
    """
    (D, F, W), P = scene.shape, pupil.shape[-1]
    afford_rays(P, object_distances=D, fields=F, wavelengths=W)
    bundle = _bundle(scene, pupil)
    rays = trace_bundle(bundle, scene.memo) if scene.last is None else _rays_behind(bundle, scene.last)
    batch = D, F, W, P
    return Rays(
        rays.position.expand(3, *batch),
        rays.direction.expand(3, *batch),
        rays.valid.expand(batch),
        rays.opl if rays.opl is None else rays.opl.expand(batch),
    )


def _rays_behind(bundle: Bundle, last: int) -> Rays:
    lens, _, wavelength, _ = bundle
    indices = media(lens, wavelength)[: last + 1]
    return trace_surfaces(sequence_of(lens)[:last], _launched(bundle), indices=indices, wavelength=wavelength)


def trace_apertures(scene: Scene, disc: Tensor) -> tuple[Tensor, list[tuple[Aperture, Tensor]], Tensor]:
    """Image points (2, D, F, W, P) on the sensor, crossings of every aperture, and which rays meet every surface.

    No ray is vignetted. disc: pupil points (2, P), or (2, D, F, W, P) with axes of length 1 to broadcast. Of a scene
    whose rays end at a surface: points on it, and surfaces up to it.
    """
    apertures = scene.apertures
    if not apertures:
        rays = trace_scene(scene, disc)
        return rays.position[:2], [], rays.valid
    shape = (*scene.shape, disc.shape[-1])
    last = len(scene.lens.surfaces) - 1 if scene.last is None else scene.last
    hits, met = points_of_bundle(_bundle(scene, disc), (*apertures, last), scene.memo)
    *crossings, image = (hit.expand(2, *shape) for hit in hits)
    pairs = zip(apertures, crossings, strict=True)
    return image, [(a, hit) for k, hit in pairs for a in apertures[k]], met.expand(shape)


def _bundle(scene: Scene, pupil: Tensor) -> Bundle:
    return aligned(scene.lens, 3), scene.fields[..., None, None], scene.wavelengths[:, None], pupil


def chief_landing(scene: Scene) -> Tensor:
    """Points (2, D, F, W) mm where the chief rays meet the sensor, with their derivatives.

    Of an axial scene with rotational symmetry, whatever the numbers of the lens, they are constants, 0, by which models
    recognise it.
    """
    if symmetry(scene) == "round":
        return scene.fields.new_zeros(2, *scene.shape)
    return trace_scene(scene, scene.fields.new_zeros(2, 1)).position[:2, ..., 0]


_FOLDS = ("round", "mirror", "none")


def symmetry(scene: Scene) -> str:
    """The symmetry that the light of every field of the whole scene has: "round", "mirror" or "none".

    "round": rotational, a meridian of the pupil represents all of it; "mirror": in x, the half x > 0 represents the
    other. Fields, vignetting factors and aperture centres that are differentiated break it; a surface of a kind that is
    not round has none, whatever its numbers.
    """
    return _FOLDS[int(scene.largest(torch.tensor(_FOLDS.index(_symmetry(scene)), device="cpu")))]


def _symmetry(scene: Scene) -> str:
    if not is_round_about_axis(scene.lens):
        return "none"
    apertures = [aperture for surface in scene.lens.surfaces for aperture in surface.apertures]
    moving = [scene.fields, scene.lens.fields.vignetting, *(c for aperture in apertures for c in aperture.centre)]
    if any(varies(number) for number in moving):
        return "none"
    centre, along_x, along_y = _beams(scene)
    tilted = (scene.fields[0] != 0).any() | (centre[0] != 0).any() | (along_x[1] != 0).any() | (along_y[0] != 0).any()
    if bool(tilted) or any(aperture.centre[0] != 0 for aperture in apertures):
        return "none"
    skewed = (scene.fields[1] != 0).any() | (centre[1] != 0).any() | (along_x[0] != along_y[1]).any()
    shapes = {SHAPES[aperture.shape].symmetry for aperture in apertures}
    if "none" in shapes:
        return "none"
    if bool(skewed) or any(aperture.centre[1] != 0 for aperture in apertures) or "mirror" in shapes:
        return "mirror"
    return "round"


def is_on_axis(scene: Scene) -> bool:
    """Whether every field is on the axis and is not differentiated."""
    return not varies(scene.fields) and not bool((scene.fields != 0).any())


def beam_share(scene: Scene) -> Tensor:
    """Share (1 or D, F, 1) of the entrance pupil that vignetting factors of each field leave, (1 - VCX)(1 - VCY)."""
    _, along_x, along_y = _beams(scene)
    return (along_x[0] * along_y[1] - along_x[1] * along_y[0]).abs().reshape(-1, scene.shape[1], 1)


def _beams(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Centre and half axes (2, F), (2, D, F) of the beams in the entrance pupil, vignetting factors applied."""
    corners = scene.fields.new_tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
    centre, x, y = vignette(scene.lens, scene.fields[..., None], corners).unbind(-1)
    return centre, x - centre, y - centre

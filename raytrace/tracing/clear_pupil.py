"""Clear pupil: a rule of points and weights whose edge is the rim that clips the beam, and how it moves with the lens.

The light of a field fills the part Ω of its pupil that passes every aperture. An integral over Ω changes with a number
q of the lens by a term of its edge, which the derivatives of a fixed set of rays lack (Reynolds' transport theorem; Teh
et al., "Aperture-aware lens design", SIGGRAPH 2024):

    d/dq ∫_Ω f dA = ∫_Ω ∂f/∂q dA + ∮_∂Ω f v_n ds,   v_n the speed of the edge along its outward normal

Here the pupil is a bundle of arms from a point inside it, and the rule fills each arm from edge to edge, so that both
terms are the derivative of one sum. An edge ρ of the clear part of an arm is a zero of a clearance c of
`clearances_of`. It is found with traced rays without derivatives. Two Newton steps with a constant slope s,
ρ - c(ρ)/s, then carry its derivatives.

Where the images of two rims cross in the pupil, ρ has a kink as a function of the angle of the arm, at which the
angles of a rule of equal steps err by the step squared, and their derivatives by the step. The angles are therefore
Gaussian nodes between kinks.
"""

import dataclasses
import math

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.maths.numerics import detached, in_transform, safe_divide, value
from raytrace.maths.sampling import gauss_legendre, gauss_rings
from raytrace.system.apertures import clearances_of, stands_inside
from raytrace.system.lens import Lens, computed_once, field_points
from raytrace.system.rays import Rays
from raytrace.tracing.launch import with_ray_aiming
from raytrace.tracing.scene import Scene, scene, trace_apertures, trace_scene
from raytrace.tracing.trace import without_apertures

_SCAN, _COARSER = 32, 8  # steps along an arm in the search for edges, with and without an aperture inside the beam
_NARROW, _NEAR, _ROUNDS = 2**-11, 1 / 32, 9  # an edge is enclosed in 2⁻¹¹ of its arm: slopes are good to 5e-4
_NARROWER = 2**-20  # of an arm, where rays miss a surface: no slope leads on to the edge
_MOST_PARTS = 3  # clear parts of one arm
_COARSE = 64  # arms round the pupil between which kinks are looked for
_NEWTON = 4  # steps to a kink
_RIM = 1 - 1e-6  # of the pupil: a stop at its very edge clips nothing
_INNER = 6, 24  # rings and arms of the rays whose mean is a point inside the clear pupil
_NEARBY = 0.5  # radians that a kink moves by, at most, between lenses near each other
_DIFFERENCE = 1e-4  # of the radius of the pupil: step of the differences that are slopes of clearances
_SETTLED, _ROUNDED = 1e-2, 1e-9  # of the radius: the last step that was not yet taken; of clearances
_TOGETHER = 32  # lenses whose clear pupils are searched at once
_NODES, _DENSER = 8, 1.25  # of a span between kinks; more of them than arms of equal steps
_DENSER_AT_KINKS = 0.7  # β: halfway between kinks angles are 1 + β/2 as far apart, at them 1 - β


@value
class Edges:
    """Both ends of the clear parts of arms, each on an edge.

    radius: (2, D, F, W, B) inner and outer; number: (2, D, F, W, B) of the clearance that is 0 there, as of
    `_clearances_at`: 0 for the edge of the pupil, -1 for the origin; slope: (2, D, F, W, B) of that clearance along the
    arm, 0 at the ends of the arm; exists: (D, F, W, B), whether the arm has this part.
    """

    radius: Tensor
    number: Tensor
    slope: Tensor
    exists: Tensor


@value
class Kinks:
    """Where another edge begins to bound the clear pupil, (D, F, W, K); the angle is inf where a kernel has fewer.

    radius: near that point; pair: (2, D, F, W, K) numbers of the clearances that are 0 there; count: of arms.
    """

    angle: Tensor
    radius: Tensor
    pair: Tensor
    count: int


@value
class Arms:
    """Arms of the pupil of every object distance, field and wavelength, and the parts of them that are clear.

    origin: (2, D, F, W) pupil point from which they start, unit: (2, D, F, W, B) their directions, share: (D, F, W, B)
    of the full angle that each represents, 1 in all. inner, outer: (D, F, W, B) radii between which light passes, with
    derivatives. rays: how many were traced for each kernel. edges, kinks: the start of `rule_near`.
    """

    origin: Tensor
    unit: Tensor
    share: Tensor
    inner: Tensor
    outer: Tensor
    rays: int
    edges: Edges
    kinks: Kinks

    def rule(self, rings: int) -> tuple[Tensor, Tensor]:
        """Pupil points (2, D, F, W, P) and weights (D, F, W, P): `rings` nodes on each part, those of a ring together.

            ∫ f r dr ≈ (o - i) Σ_n w_n f(r_n) r_n,   r_n = i + (o - i) t_n,   with Gauss-Legendre nodes t_n

        Rings of equal steps in r² need opposite arms of the same length: else odd powers of r, roots of r², do not
        cancel. A pupil that is clear as a whole has them, those of `sampling.gauss_rings`, whatever clips other fields.
        The weights of a clear pupil sum to 1.
        """
        nodes, weights = (self.inner.new_tensor(t)[:, None] for t in gauss_legendre(rings))
        inner, length, along = self.inner[..., None, :], (self.outer - self.inner)[..., None, :], 0.5 * (nodes + 1)
        area = self.area()[..., None, None]
        is_whole = area > 1 - 64 * torch.finfo(area.dtype).eps
        radius = torch.where(is_whole, length * along.sqrt(), inner + length * along)
        step = length * torch.where(is_whole, 0.5 * length, radius)  # of r² from ring to ring, per weight
        points = self.origin[..., None, None] + radius * self.unit[..., None, :]
        return points.flatten(-2), (weights * step * self.share[..., None, :]).flatten(-2)

    def area(self) -> Tensor:
        """Area (D, F, W) of the clear pupils relative to the whole pupil, with derivatives."""
        return (self.share * (self.outer**2 - self.inner**2)).sum(-1)

    def ends(self) -> tuple[Tensor, Tensor]:
        """Pupil points (2, D, F, W, 2 B) at both ends of every part, on the edge; and which parts there are."""
        exists = self.outer > self.inner
        points = [self.origin[..., None] + radius * self.unit for radius in (self.inner, self.outer)]
        return torch.cat(points, -1), torch.cat([exists, exists], -1)


def clear_pupil(
    lens: Lens,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    ray_aiming: str | None = None,
    rings: int = 12,
    arms: int = 48,
) -> tuple[Tensor, Tensor]:
    """Pupil points (2, F, W, P) and weights (F, W, P) over the clear pupil of every field and wavelength.

        Σ_p w_p f(x_p) → (1/π) ∬ f dx dy   over the part of the unit disc whose rays pass every aperture

    Value and derivatives by all numbers of the lens, fields and extents of apertures converge as those of a smooth
    integrand, also where rims cross. Without a clipped ray the rule is `gauss_rings(rings, arms)`. fields, wavelengths,
    ray_aiming: as for `launch`. An edge where rays miss a surface or are totally reflected has no derivative. See
    `arms_of` for obscurations and polygons.
    """
    lens = with_ray_aiming(lens, ray_aiming)
    fields = field_points(fields, like=lens)
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    pupil = scene(lens, fields, lens.surfaces[0].thickness.reshape(1), wavelengths)
    points, weights = gauss_rings(rings, arms, dtype=lens.surfaces[-2].thickness.dtype, device=wavelengths.device)
    if is_clipped(pupil, points):
        points, weights = arms_of(pupil, arms).rule(rings)
        return points[:, 0], weights[0]
    shape = fields.shape[1], len(wavelengths), points.shape[1]
    return points[:, None, None].expand(2, *shape), weights.expand(shape)


def clear_rays(scene: Scene, rings: int) -> tuple[Rays, Tensor]:
    """Rays (3, D, F, W, P) on the sensor that fill the clear pupils, and their weights (D, F, W, P).

    `rings` nodes on each of about 4·rings arms; the ends of the arms, on the edge, have no weight. See `Arms.rule`.
    """
    arms = arms_of(scene, 4 * rings)
    (points, weights), (ends, exist) = arms.rule(rings), arms.ends()
    bare = dataclasses.replace(scene, lens=without_apertures(scene.lens))
    rays = trace_scene(bare, torch.cat([points, ends], -1))
    valid = rays.valid & torch.cat([weights > 0, exist], -1)
    return dataclasses.replace(rays, valid=valid), torch.cat([weights, torch.zeros_like(ends[0])], -1)


@torch.no_grad()
def is_clipped(scene: Scene, points: Tensor | None = None) -> bool:
    """Whether a ray of the whole scene through pupil points (2, P), or just inside the edge of the pupil, fails.

    Without points rays at the edge alone are traced, and none where no aperture could stop them.
    """
    return not scene.everywhere(~clipped(scene, points).any())


@torch.no_grad()
def clipped(scene: Scene, points: Tensor | None = None) -> Tensor:
    """Whether rays (D, F, W) of an object distance, or lens of a batch, fail; arguments as for `is_clipped`."""
    points = scene.wavelengths.new_zeros(2, 0) if points is None else points
    if scene.apertures:
        angle = torch.arange(_COARSE, dtype=points.dtype, device=points.device) * (2 * math.pi / _COARSE)
        points = torch.cat([points, _RIM * torch.stack([torch.cos(angle), torch.sin(angle)])], 1)
    if points.shape[1] == 0:
        return torch.zeros(scene.shape, dtype=torch.bool, device=points.device)
    return ~trace_scene(scene, points).valid.all(-1)


def arms_of(scene: Scene, count: int, fold: str = "none") -> Arms:
    """About `count` arms round the pupil, at angles that integrate over it, and their clear parts.

    fold: the symmetry of the light, as of `scene.symmetry`: "mirror": arms in x > 0 alone; "round": a single one.
    They start inside the clear pupil. Where an aperture can stop light in the midst of the beam (an obscuration, a
    polygon) they start at the centre of the pupil; if it does not cover the centre, the angles are of equal steps, and
    a second or third clear part of all arms follows the first ones.
    """
    with computed_once():  # beams and media of the search
        return _arms_of(scene, _still(scene), count, fold)


def _still(scene: Scene) -> Scene:
    """The scene without derivatives, for a search: its rays share beams and media. Not of a memo, which needs them."""
    return scene if scene.memo is not None or in_transform() else detached(scene)


def _arms_of(scene: Scene, still: Scene, count: int, fold: str) -> Arms:
    """`arms_of`; still: the scene without derivatives."""
    like = scene.wavelengths
    around = 2 * math.pi if fold == "none" else math.pi
    apertures = [aperture for each in scene.apertures.values() for aperture in each]
    if fold == "round":
        unit, origin = like.new_tensor([[0.0], [1.0]]).reshape(2, 1, 1, 1, 1), like.new_zeros(2, *scene.shape)
        unit = unit.expand(2, *scene.shape, 1)
        edges, traced = _enclosed(still, unit, origin)
        return _clear_parts(scene, origin, unit, torch.ones_like(unit[0]), edges, traced, _no_kinks(edges, 1))
    is_hollow = any(map(stands_inside, apertures))
    with torch.no_grad():
        origin, traced = like.new_zeros(2, *scene.shape), 0
        if not is_hollow:
            points, weights = gauss_rings(*_INNER, dtype=like.dtype, device=like.device)
            passes = torch.where(trace_scene(still, points).valid, weights, 0.0)
            origin = torch.stack([safe_divide((passes * part).sum(-1), passes.sum(-1)) for part in points])
            origin = torch.stack([torch.zeros_like(origin[0]), origin[1]]) if fold == "mirror" else origin
            traced = points.shape[1]
    kinks, searched = _kinks(scene, still, origin, count, fold, is_hollow)
    angle, share = _angles(kinks.angle, count, around)
    unit = torch.stack([torch.sin(angle), torch.cos(angle)])
    edges, enclosing = _enclosed(still, unit, origin)
    return _clear_parts(scene, origin, unit, share, edges, traced + searched + enclosing, kinks)


def rule_near(
    scene: Scene, points: Tensor, weights: Tensor, arms: Arms | None = None, rings: int = 12
) -> tuple[Tensor, Tensor]:
    """Pupil points (2, D, F, W, P) and weights (D, F, W, P) over the clear pupils of lenses near a known one.

    points, weights: the rule of the known lens, of `rings`; arms: its arms (1, F, W, B) by `arms_of`, None if it clips
    no ray. Newton steps move its kinks and edges to those of each lens, by five rays an edge. The clear pupil of a lens
    that other apertures bound is searched as by `arms_of`.
    """
    if not scene.apertures:
        return points, weights
    if arms is None:
        is_near, count = ~clipped(scene, points).flatten(1).any(-1), 4 * rings
        points, weights = points[:, None, None, None].expand(2, *scene.shape, -1), weights.expand(*scene.shape, -1)
    else:
        moved, is_near = _moved(scene, arms)
        (points, weights), count = moved.rule(rings), arms.kinks.count
    others = (~is_near).nonzero()[:, 0]
    for some in others.split(_TOGETHER) if len(others) else ():
        chosen = scene if len(is_near) == 1 else dataclasses.replace(scene.of(some), memo=None)
        searched, shares = arms_of(chosen, count).rule(rings)
        more = searched.shape[-1] - points.shape[-1]
        points, weights = (torch.nn.functional.pad(t, (0, max(0, more))) for t in (points, weights))
        searched, shares = (torch.nn.functional.pad(t, (0, max(0, -more))) for t in (searched, shares))
        points, weights = points.index_copy(1, some, searched), weights.index_copy(0, some, shares)
    return points, weights


def _moved(scene: Scene, arms: Arms) -> tuple[Arms, Tensor]:
    """The arms of lenses near a known one, and whether (D,) the same apertures set their edges."""
    edges, kinks = pytree.tree_map(
        lambda t: t.expand(*t.shape[:-4], *scene.shape, -1) if isinstance(t, Tensor) else t, (arms.edges, arms.kinks)
    )
    origin = arms.origin.expand(2, *scene.shape)
    if kinks.angle.shape[-1]:
        start = kinks.radius, kinks.angle.nan_to_num(posinf=0.0)
        angle, _ = _crossing(scene, _still(scene), origin, start, kinks.pair, _NEARBY)
        kinks = dataclasses.replace(kinks, angle=torch.where(kinks.angle.isfinite(), angle, torch.inf))
    angle, share = _angles(kinks.angle, kinks.count, 2 * math.pi)
    unit = torch.stack([torch.sin(angle), torch.cos(angle)])
    with torch.no_grad():
        each = unit.repeat(1, 1, 1, 1, edges.radius.shape[-1] // unit.shape[-1])
        reach = _reach(each, origin)
        clips = edges.number > 0
        edges = dataclasses.replace(edges, radius=torch.where(edges.number == 0, reach, edges.radius))
        edges = dataclasses.replace(edges, radius=_step(scene, edges, each, origin))
        inward = _DIFFERENCE * edges.number.new_tensor([1, -1]).reshape(2, 1, 1, 1, 1)
        here, inside = (_clearances(scene, edges.radius + step, each, origin) for step in (0.0, inward))
        setting = (edges.number - 1).clamp_min(0)[None]
        rest, slopes = (t.gather(0, setting)[0] for t in (here, (inside - here) / inward))
        others = torch.where(clips, here.scatter(0, setting, torch.inf), here).amin(0)
        rest, slope = torch.where(clips, rest, 0.0), torch.where(clips, slopes, 0.0)
        is_same = (others >= -2 * rest.abs() - _ROUNDED) & (rest.abs() <= _SETTLED * slope.abs())
        is_same &= (clips <= (edges.slope != 0)) & (edges.radius >= 0) & (edges.radius <= reach)
        is_same &= edges.radius[1] > edges.radius[0]
        edges = dataclasses.replace(edges, radius=edges.radius - safe_divide(rest, slope), slope=slope)
    is_near = (is_same | ~edges.exists).all(0).flatten(1).all(-1)
    return _clear_parts(scene, origin, unit, share, edges, 0, kinks), is_near


def _angles(kinks: Tensor, count: int, around: float) -> tuple[Tensor, Tensor]:
    """Angles (D, F, W, A) from the y axis, and the share of each in `around`, as many as the kernel with most needs.

    kinks: (D, F, W, K), inf where a kernel has fewer. One without kinks has angles of equal steps; another has Gaussian
    nodes in spans between its kinks and a few fixed angles, so that its rule does not depend on other kernels.
    """
    count = count if around > 4 else (count + 1) // 2
    step = (torch.arange(count, dtype=kinks.dtype, device=kinks.device) + 0.5) * (around / count)
    fixed = math.ceil(_DENSER * count / _NODES)
    nodes, weights = (kinks.new_tensor(t) for t in gauss_legendre(_NODES))
    kinks, known = torch.remainder(kinks, around).nan_to_num(torch.inf).sort(-1).values, torch.isfinite(kinks).sum(-1)
    most = int(known.max()) if kinks.shape[-1] else 0
    size = max(count, (fixed + most) * _NODES if most else 0)
    angles, shares = kinks.new_zeros(*known.shape, size), kinks.new_zeros(*known.shape, size)
    for number in range(most + 1):
        if number:
            bounds = torch.arange(fixed, dtype=kinks.dtype, device=kinks.device) * (around / fixed)
            bounds = torch.cat([bounds.expand(*known.shape, -1), kinks[..., :number]], -1).sort(-1).values
            span = torch.cat([bounds[..., 1:], torch.full_like(bounds[..., :1], around)], -1) - bounds
            angle = (bounds[..., None] + span[..., None] * 0.5 * (nodes + 1)).flatten(-2)
            share = (span[..., None] * weights / (2 * around)).flatten(-2)
        else:
            angle, share = (t.expand(*known.shape, -1) for t in (step, torch.full_like(step, 1 / count)))
        rest = (*known.shape, size - angle.shape[-1])
        here = (known == number)[..., None]
        angles = torch.where(here, torch.cat([angle, angle[..., -1:].expand(rest)], -1), angles)
        shares = torch.where(here, torch.cat([share, share.new_zeros(rest)], -1), shares)
    return _denser_at_kinks(angles, shares, kinks, known, around) if most else (angles, shares)


def _denser_at_kinks(
    angles: Tensor, shares: Tensor, kinks: Tensor, known: Tensor, around: float
) -> tuple[Tensor, Tensor]:
    """Angles and shares (D, F, W, A) moved towards the kinks (D, F, W, K), sorted, on either side of each.

    The edge of a vane of half width b is at b/sin θ, steep beside the kink at sin θ = b. Between two kinks a and a + Λ

        θ = a + Λ g(s),   s = (θ₀ - a)/Λ,   g = (1 - β) s + β s² (3 - 2 s)
    """
    is_bent = (known > 0)[..., None]
    first, last = kinks[..., :1], kinks.gather(-1, (known - 1).clamp_min(0)[..., None])
    first, last = (torch.where(is_bent, end, 0.0) for end in (first, last))
    # The kinks of the other half, or of the next turn, are those of this one.
    before, after = (last - around, first + around) if around > 4 else (-first, 2 * around - last)
    ends = torch.cat([before, torch.where(torch.isfinite(kinks), kinks, after), after], -1)
    place = torch.searchsorted(kinks.detach().contiguous(), angles.detach().contiguous())
    low, high = ends.gather(-1, place), ends.gather(-1, place + 1)
    s = (angles - low) / (high - low)
    moved = low + (high - low) * s * (1 - _DENSER_AT_KINKS * (1 - s) * (1 - 2 * s))
    parts = shares * (1 - _DENSER_AT_KINKS * (1 - 6 * s * (1 - s)))
    return torch.where(is_bent, moved, angles), torch.where(is_bent, parts, shares)


def _no_kinks(edges: Edges, count: int) -> Kinks:
    none = edges.radius[0, ..., :0]
    return Kinks(none, none, edges.number[..., :0], count)


def _kinks(scene: Scene, still: Scene, origin: Tensor, count: int, fold: str, is_hollow: bool) -> tuple[Kinks, int]:
    """Where another edge begins to bound the clear pupil, or blocked arms begin, for `count` arms.

    No kinks of a kernel of which an arm has several clear parts. Also returns the number of rays traced for each one.
    """
    is_whole = fold == "none"
    coarse = _COARSE if is_whole else _COARSE // 2
    step = 2 * math.pi / _COARSE
    angle = (torch.arange(coarse, dtype=origin.dtype, device=origin.device) + 0.5) * step
    unit = torch.stack([torch.sin(angle), torch.cos(angle)])[:, None, None, None].expand(2, *scene.shape, -1)
    edges, traced = _enclosed(still, unit, origin)
    kinks = [_no_kinks(edges, count)]
    is_simple = ~edges.exists[..., coarse:].any(-1, keepdim=True)
    (inner, outer), (number_in, number_out), exists = (
        t[..., :coarse] for t in (edges.radius, edges.number, edges.exists)
    )
    exists_after = exists.roll(-1, -1)
    changes = []
    for radius, number in ((inner, number_in), (outer, number_out))[0 if is_hollow else 1 :]:
        after = number.roll(-1, -1)
        changes.append((exists & exists_after & (number != after), 0.5 * (radius + radius.roll(-1, -1)), number, after))
    # The last arm before blocked ones ends where its two edges meet.
    ends = (0.5 * (inner + outer), number_in, number_out)
    radius, number, other = (torch.where(exists, t, t.roll(-1, -1)) for t in ends)
    changes.append(((exists != exists_after) & (number >= 0), radius, number, other))
    for change, radius, number, other in changes:
        change = change & is_simple
        if not is_whole:
            change = torch.cat([change[..., :-1], torch.zeros_like(change[..., :1])], -1)
        most = int(change.sum(-1).max())
        if not most:
            continue
        order = change.to(torch.int8).argsort(dim=-1, descending=True, stable=True)[..., :most]
        pair = torch.stack([number.gather(-1, order), other.gather(-1, order)]).clamp_min(0)
        start = radius.gather(-1, order), angle[order] + 0.5 * step
        kink, rays = _crossing(scene, still, origin, start, pair, step)
        traced += rays
        kinks.append(Kinks(torch.where(change.gather(-1, order), kink, torch.inf), start[0], pair, count))
    return pytree.tree_map(lambda *parts: torch.cat(parts, -1), *kinks), traced


def _crossing(
    scene: Scene, still: Scene, origin: Tensor, start: tuple[Tensor, Tensor], pair: Tensor, step: float
) -> tuple[Tensor, int]:
    """Angle (D, F, W, K) where two clearances (2, D, F, W, K) vanish together, near a radius and an angle; and rays."""
    radius, angle = start
    here = origin[..., None] + radius * torch.stack([torch.sin(angle), torch.cos(angle)])
    small = torch.finfo(here.dtype).eps ** (1 / 3)
    shifts = small * here.new_tensor([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]).reshape(2, 1, 1, 1, 1, 3)
    with torch.no_grad():
        for _ in range(_NEWTON):
            shifted = here[..., None] + shifts
            values = _clearances_at(still, shifted.flatten(-2)).unflatten(-1, (-1, 3))
            c = values.gather(0, pair[..., None].expand(*pair.shape, 3))  # (2, D, F, W, K, 3)
            differences = c[..., 1:] - c[..., :1]
            here = here - _newton(c[..., 0], differences, small).clamp(-step, step)
    for _ in range(2):  # with constant slopes, as in `_clear_parts`
        here = here - _newton(_clearances_at(scene, here).gather(0, pair), differences, small)
    x, y = here - origin[..., None]
    turned = torch.remainder(torch.atan2(x, y) - angle + math.pi, 2 * math.pi) - math.pi
    return angle + torch.where(turned.abs() <= 0.51 * step, turned, 0.0), (3 * _NEWTON + 2) * radius.shape[-1]


def _newton(clearances: Tensor, differences: Tensor, small: float) -> Tensor:
    """Step (2, ...) to the zero of clearances (2, ...); differences: (2, ..., 2) of theirs over `small` in x and y."""
    u, v = clearances
    (a, b), (p, q) = (both.unbind(-1) for both in differences)
    determinant = a * q - b * p
    return small * torch.stack([safe_divide(q * u - b * v, determinant), safe_divide(a * v - p * u, determinant)])


def _clear_parts(
    scene: Scene, origin: Tensor, unit: Tensor, share: Tensor, edges: Edges, traced: int, kinks: Kinks
) -> Arms:
    """Arms in the directions (2, D, F, W, A) whose parts end at edges that are known closely.

    B is A, or a multiple of it if an obstruction lies in an arm: then the second clear parts of all arms follow the
    first ones. A part that an arm does not have lies between 0 and 0. First derivatives are exact to 1e-6, second ones
    to 1e-3, where an aperture of any shape sets the edge; where rays miss a surface or are totally reflected the edge
    has none. traced: rays traced so far for each kernel.
    """
    parts = edges.radius.shape[-1] // unit.shape[-1]
    unit, share = unit.repeat(1, 1, 1, 1, parts), share.repeat(1, 1, 1, parts)
    # A step with a constant slope has the error (1 - c'/s)(ρ - ρ₀) to first order, in value and derivatives.
    for _ in range(2 if bool((edges.slope != 0).any()) else 0):
        edges = dataclasses.replace(edges, radius=_step(scene, edges, unit, origin))
        traced += 2 * unit.shape[-1]
    radius = torch.where(edges.number == 0, _reach(unit, origin), edges.radius)
    inner, outer = torch.where(edges.exists, radius, 0.0)
    return Arms(origin, unit, share, inner, outer, traced, dataclasses.replace(edges, radius=radius.detach()), kinks)


def _step(scene: Scene, edges: Edges, unit: Tensor, origin: Tensor) -> Tensor:
    """Radii (2, D, F, W, B) of edges, after a Newton step with their slopes."""
    clearances = _clearances(scene, edges.radius, unit, origin)
    here = clearances.gather(0, (edges.number - 1).clamp_min(0)[None])[0]
    return edges.radius - safe_divide(here, edges.slope)


def _enclosed(scene: Scene, unit: Tensor, origin: Tensor) -> tuple[Edges, int]:
    """Edges on arms in the directions (2, D, F, W, A), just inside the clear side, without derivatives.

    Also the number of rays traced for each kernel. Parts and gaps shorter than 1/32 of an arm may be missed, or 1/8
    where no aperture stops light within the beam; gaps behind the third part are filled.
    """
    arms = unit.shape[-1]
    with torch.no_grad():
        reach = _reach(unit, origin)
        apertures = [aperture for each in scene.apertures.values() for aperture in each]
        steps = _SCAN if any(map(stands_inside, apertures)) else _COARSER
        step = torch.linspace(0, 1, steps + 1, dtype=unit.dtype, device=unit.device)
        scanned = _clearances(scene, step[:, None, None, None, None] * reach, unit, origin)
        passed = (scanned >= 0).all(0)
        part = (passed & ~torch.cat([torch.zeros_like(passed[:1]), passed[:-1]])).cumsum(0).clamp_max(_MOST_PARTS)
        count = max(1, int(part.max()))
        here = torch.cat([passed & (part == number + 1) for number in range(count)], -1)
        unit, reach, scanned = (torch.cat([t] * count, -1) for t in (unit, reach, scanned))
        first, last = (t.to(torch.int8).argmax(0) for t in (here, here.flip(0)))
        within, beyond = torch.stack([first, steps - last]), torch.stack([first - 1, steps - last + 1])
        ends = torch.stack([beyond[0] < 0, beyond[1] > steps])  # at the origin, at the edge of the pupil
        places = [place.clamp(0, steps) for place in (within, beyond)]
        passes, blocked = (step[place] * reach for place in places)
        inside, outside = (scanned.gather(1, place.expand(len(scanned), *place.shape)) for place in places)
        traced = arms * (steps + 1)
        # Rays near the zero of the first clearance along a chord, and halfway; at quarters if rays miss a surface.
        quarters = step.new_tensor([0.25, 0.5, 0.75]).reshape(3, 1, 1, 1, 1, 1)
        for _ in range(_ROUNDS):
            missed = outside.argmin(0) == len(outside) - 1
            wide = (blocked - passes).abs() > torch.where(missed, _NARROWER, _NARROW) * reach
            some = slice(int(not bool(wide[0].any())), None)  # most arms start at a clear point
            if not bool(wide.any()):
                break
            zero = torch.where(outside < 0, safe_divide(inside, inside - outside), 1.0).amin(0)[some]
            share = torch.stack([zero - _NEAR, zero + _NEAR, torch.full_like(zero, 0.5)]).clamp(0, 1).sort(0).values
            share = torch.where(missed[some], quarters, share)
            radii = passes[some] + share * (blocked - passes)[some]
            between = _clearances(scene, radii.flatten(0, 1), unit, origin).unflatten(1, radii.shape[:2])
            traced += radii.shape[0] * radii.shape[1] * unit.shape[-1]
            line = torch.cat([inside[:, None, some], between, outside[:, None, some]], 1)
            radii = torch.cat([passes[None, some], radii, blocked[None, some]])
            index = (between >= 0).all(0).to(torch.int64).cumprod(0).sum(0)[None]
            for place, radius, clearance in ((index, passes, inside), (index + 1, blocked, outside)):
                new = line.gather(1, place.expand(len(line), *place.shape))[:, 0]
                clearance[:, some] = torch.where(wide[some], new, clearance[:, some])
                radius[some] = torch.where(wide[some], radii.gather(0, place)[0], radius[some])
        # The aperture that stops the ray; a missed surface, last in the list, has no slope.
        lowest, number = outside.min(0)
        slope = safe_divide((outside - inside).gather(0, number[None])[0], blocked - passes)
        slope = torch.where((lowest < 0) & (number < len(scanned) - 1) & ~ends, slope, 0.0)
        number = torch.where(ends, number.new_tensor([-1, 0]).reshape(2, 1, 1, 1, 1), number + 1)
    return Edges(passes, number, slope, here.any(0)), traced


def _reach(unit: Tensor, origin: Tensor) -> Tensor:
    """Lengths (D, F, W, B) of arms from the origin to the edge of the pupil."""
    along = (origin[..., None] * unit).sum(0)
    return torch.sqrt(along * along + 1 - (origin * origin).sum(0)[..., None]) - along


def _clearances(scene: Scene, radii: Tensor, unit: Tensor, origin: Tensor) -> Tensor:
    """Clearances (C + 1, K, D, F, W, B) at radii (K, D, F, W, B) of the arms; the last: ±1, whether the ray arrives."""
    points = origin[:, None, ..., None] + radii * unit[:, None]
    flat = points.movedim(1, -2).flatten(-2)
    return _traced(scene, flat).unflatten(-1, (len(radii), unit.shape[-1])).movedim(-2, 1)


def _clearances_at(scene: Scene, points: Tensor) -> Tensor:
    """Clearances (C + 2, D, F, W, P) at pupil points (2, D, F, W, P), that of the pupil's edge first."""
    return torch.cat([(1 - (points * points).sum(0))[None], _traced(scene, points)])


def _traced(scene: Scene, points: Tensor) -> Tensor:
    _, crossed, met = trace_apertures(scene, points)
    arrives = torch.where(met, 1.0, -1.0).to(points.dtype)
    return torch.stack([*(c for aperture, hit in crossed for c in clearances_of(aperture, hit)), arrives])

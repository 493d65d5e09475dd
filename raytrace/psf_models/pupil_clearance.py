"""Clear pupil: where along arms of the pupil light passes every aperture, and how those edges move with the lens.

An edge ρ of the clear part of an arm is a zero of a clearance c of `apertures.clearance`. It is found with traced rays
without derivatives. Two Newton steps with a constant slope s, ρ - c(ρ)/s, then carry its derivatives.
"""

import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide
from raytrace.maths.sampling import gauss_legendre
from raytrace.psf_models.drt import trace_apertures
from raytrace.system.apertures import clearance
from raytrace.tracing.scene import Scene

_SCAN = 32  # steps along an arm in which edges are looked for
_SECTIONS, _ZOOMS = 8, 2  # an edge is enclosed in 8⁻² of a step: slopes are good to 5e-4
_MOST_PARTS = 3  # clear parts of one arm


def clear_arms(scene: Scene, unit: Tensor) -> tuple[Tensor, Tensor]:
    """Radii (D, F, W, B) between which light passes on arms in the directions (2, A).

    B is A, or a multiple of it if an obstruction lies in an arm: then the second clear parts of all arms follow the
    first ones. A part that an arm does not have lies between 0 and 0. First derivatives are exact to 1e-6, second ones
    to 1e-3, where an aperture of any shape sets the edge; where rays miss a surface or are totally reflected the edge
    has none. Parts and gaps shorter than 1/32 may be missed; gaps behind the third part are filled.
    """
    arms = unit.shape[1]
    with torch.no_grad():
        step = torch.linspace(0, 1, _SCAN + 1, dtype=unit.dtype, device=unit.device)
        passed = (_clearances(scene, step[:, None, None, None, None].expand(-1, 1, 1, 1, arms), unit) >= 0).all(0)
        part = (passed & ~torch.cat([torch.zeros_like(passed[:1]), passed[:-1]])).cumsum(0).clamp_max(_MOST_PARTS)
        count = max(1, int(part.max()))
        here = torch.cat([passed & (part == number + 1) for number in range(count)], -1)
        first, last = (t.to(torch.int8).argmax(0) for t in (here, here.flip(0)))
        passes, blocked = torch.stack([first, _SCAN - last]), torch.stack([first - 1, _SCAN - last + 1])
    edges = _edges(scene, step[passes], step[blocked.clamp(0, _SCAN)], unit.repeat(1, count))
    inner, outer = torch.where(here.any(0), edges, 0.0)
    return inner, outer


def rays_of_search(arms: int, parts: int) -> int:
    """How many rays `clear_arms` traced for one kernel to find so many parts of arms."""
    return arms * (_SCAN + 1) + parts * 2 * (_ZOOMS * (_SECTIONS + 1) + 2)


def between(inner: Tensor, outer: Tensor, unit: Tensor, *, rings: int) -> tuple[Tensor, Tensor]:
    """Pupil points (2, ..., P) and weights (..., P) on the clear parts (..., B) of arms in the directions (2, A).

        ∫ f r dr ≈ (o - i) Σ_n w_n f(r_n) r_n,   r_n = i + (o - i) t_n,   with Gauss-Legendre nodes t_n

    `rings` nodes on each part, those of one ring together. Rings of equal steps in r² (`sampling.gauss_rings`) need
    opposite arms of the same length: else odd powers of r, roots of r², do not cancel. The weights of a clear pupil
    sum to 1.
    """
    nodes, weights = (inner.new_tensor(t)[:, None] for t in gauss_legendre(rings))
    inner, length = inner[..., None, :], (outer - inner)[..., None, :]
    radius = inner + length * 0.5 * (nodes + 1)
    directions = unit.repeat(1, inner.shape[-1] // unit.shape[1])
    points = torch.stack([(radius * direction).flatten(-2) for direction in directions])
    return points, (weights * radius * length / unit.shape[1]).flatten(-2)


def _clearances(scene: Scene, radii: Tensor, unit: Tensor) -> Tensor:
    """Clearances (C + 1, K, D, F, W, B) at radii (K, D, F, W, B) of the arms; the last: ±1, whether the ray arrives."""
    points = torch.stack([(radii * direction).movedim(0, -2).flatten(-2) for direction in unit])
    _, crossed, met = trace_apertures(scene, points)
    arrives = torch.where(met, 1.0, -1.0).to(radii.dtype)
    clearances = torch.stack([*(clearance(aperture, hit) for aperture, hit in crossed), arrives])
    return clearances.unflatten(-1, (len(radii), unit.shape[1])).movedim(-2, 1)


def _edges(scene: Scene, passes: Tensor, blocked: Tensor, unit: Tensor) -> Tensor:
    """Zeros (2, D, F, W, B) of the clearance between radii that pass and those that are blocked."""
    with torch.no_grad():
        share = torch.linspace(0, 1, _SECTIONS + 1, dtype=passes.dtype, device=passes.device)
        for _ in range(_ZOOMS):
            radii = passes + share[:, None, None, None, None, None] * (blocked - passes)
            clearances = _clearances(scene, radii.flatten(0, 1), unit).unflatten(1, radii.shape[:2])
            index = (clearances >= 0).all(0)[1:].to(torch.int64).cumprod(0).sum(0)[None]
            pair = index, (index + 1).clamp_max(_SECTIONS)
            passes, blocked = (radii.gather(0, at)[0] for at in pair)
        inside, outside = (clearances.gather(1, at.expand(len(clearances), *at.shape))[:, 0] for at in pair)
        # The aperture that stops the ray; a missed surface, last in the list, has no slope.
        lowest, number = outside.min(0, keepdim=True)
        slope = safe_divide((outside - inside).gather(0, number)[0], blocked - passes)
        slope = torch.where(((lowest < 0) & (number < len(clearances) - 1))[0], slope, 0.0)
    # A step with a constant slope has the error (1 - c'/s)(ρ - ρ₀) to first order, in value and derivatives.
    radius = passes
    for _ in range(2):
        radius = radius - safe_divide(_clearances(scene, radius, unit).gather(0, number)[0], slope)
    return radius

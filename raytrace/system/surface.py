"""Surface: shape, pose, medium and apertures of one refracting or reflecting surface, and its sag.

    z = c r² / (1 + √(1 - (1+k) c² r²)) + Σ_j a_j b_j(r²) + D(x, y),  j = 1, 2, …

b_j = r^(2j) of an even asphere; other kinds, some of which are not round, and the sag terms D are rows of `shapes`.
Functions work in the frame of the vertex, components first, for any batch shape. `intersection` has the normal and the
intersection with rays.
"""

import dataclasses
from collections.abc import Collection, Sequence

import torch
from torch import Tensor

from raytrace.materials.environment import Environment
from raytrace.materials.glass import AIR, Glass
from raytrace.maths.numerics import Number, is_any, value
from raytrace.system.apertures import Aperture
from raytrace.system.phases import Phase, kind_of, power_of
from raytrace.system.poses import Gap, Pose, decentred_first, tilted_first, without_z
from raytrace.system.sag_terms import SAG_TERMS, Sag, SagTerms, relief
from raytrace.system.shapes import EVEN, KINDS, conic_terms


@value
class Surface:
    """One surface of a lens and the gap behind it. Fields that are None are not modelled.

    thickness: mm from this vertex to the next; the object's may be inf.
    curvature: c, 1/mm; None is a plane (a tensor of 0 makes a plane's curvature differentiable).
    conic: k; None is a sphere.
    coefficients: (m, ...) a_1, a_2, … of the `kind`, a key of `shapes.KINDS`: of an even asphere of r², r⁴, … in
        mm^(1-2j), of a toroid its curvature along x and terms of y², y⁴, …; None if not aspheric.
    sag_terms: added sag D, of a kind of `sag_terms.SAG_TERMS`, or None. A height at the vertex belongs to the thickness
        before: paraxial optics takes D(0, 0) and the slopes there as 0.
    phase: optical path added by the surface, or its action in place of Snell's law, of a kind of `phases.PHASES`; None
        for a surface that refracts or reflects.
    before, after: the pose of the surface's axes in those of its vertex, and of the axes of the thickness in those of
        the surface; None where they are the same. That of the object tilts it alone, about its vertex.
    is_break: a coordinate break: rays only change to the axes of `before`, and meet nothing.
    glass: the medium behind the surface; MIRROR reflects and keeps the medium before it, as a coordinate break does.
    semi_diameter: mm, as stored in the file; it never clips a ray (only `apertures` do), but bounds the search for
        the first crossing with an asphere that a ray may cross more than once.
    apertures: a ray must pass all of them.
    comment: free text of the file.
    environment: temperature and pressure of the medium behind the surface, where they are not the lens's.
    expansion: linear expansion, 1e-6/K, of the spacer of the space behind the surface, or of a medium there whose
        catalog lists none; None: none is stated, and the spacer keeps its length.
    chip_zone: mm by which the polished surface exceeds its clear semi-diameter; None: 0.
    mechanical_semi_diameter: mm, fixed, of the part; from the chip zone to there it is flat. None: it is the largest
        clear semi-diameter with its chip zone of the element, or of the cemented group (`tracing.geometry`).
    """

    thickness: Tensor
    curvature: Tensor | None = None
    conic: Tensor | None = None
    coefficients: Tensor | None = None
    kind: str = EVEN
    sag_terms: SagTerms | None = None
    phase: Phase | None = None
    before: Pose | None = None
    after: Pose | None = None
    is_break: bool = False
    glass: Glass = AIR
    semi_diameter: float | None = None
    apertures: tuple[Aperture, ...] = ()
    comment: str = ""
    environment: Environment | None = None
    expansion: Tensor | None = None
    chip_zone: float | None = None
    mechanical_semi_diameter: float | None = None

    @property
    def radius(self) -> Tensor:
        """mm, 1 / curvature; inf of a plane."""
        return torch.full_like(self.thickness, torch.inf) if self.curvature is None else 1 / self.curvature

    @property
    def pose(self) -> Pose | None:
        """The pose before the surface, None without one; in the compiled trace a passage is in its place."""
        return self.before if isinstance(self.before, Pose) else None

    @property
    def is_mirror(self) -> bool:
        return self.glass.formula == "mirror"

    @property
    def is_plane(self) -> bool:
        """True if the surface has neither curvature nor aspheric terms nor sag terms to model."""
        return self.curvature is None and self.coefficients is None and self.sag_terms is None


#: The fields of a surface that are sizes in mm: plain numbers, by which no ray is clipped.
SIZES = ("semi_diameter", "chip_zone", "mechanical_semi_diameter")

#: The fields of a surface that make its shape.
SHAPE = ("curvature", "conic", "coefficients", "kind", "sag_terms")


def gap_behind(surface: Surface) -> Tensor | Gap:
    """The gap to the next surface: the thickness, with the pose behind the surface if it has one."""
    return surface.thickness if surface.after is None else Gap(surface.after, surface.thickness)


def with_z_in_thicknesses(surfaces: Sequence[Surface], numbers: Collection[int] | None = None) -> list[Surface]:
    """The same surfaces in space, with every decentre along z in the thickness before or behind its surface.

    A pose before a surface is decentred first, one behind it tilted first. An object at infinity stays there: rays then
    start from axes that have followed the vertex of surface 1. numbers: of the surfaces whose decentres are moved, by
    default all.
    """
    result = list(surfaces)
    for k in range(len(surfaces)) if numbers is None else sorted(numbers):
        before, after = surfaces[k].before, surfaces[k].after
        if k and isinstance(before, Pose) and before.z is not None:
            pose = decentred_first(before)
            if is_any(result[k - 1].thickness.detach() < torch.inf):
                result[k - 1] = _thicker(result[k - 1], pose.z)
            result[k] = dataclasses.replace(result[k], before=without_z(pose))
        if after is not None and after.z is not None:
            pose = tilted_first(after)
            result[k] = _thicker(dataclasses.replace(result[k], after=without_z(pose)), pose.z)
    return result


def _thicker(surface: Surface, z: Tensor | None) -> Surface:
    return surface if z is None else dataclasses.replace(surface, thickness=surface.thickness + z)


def medium_surfaces(surfaces: Sequence[Surface]) -> list[int]:
    """The surface whose glass fills the space behind each surface of a lens, object to image.

    Mirrors, coordinate breaks and the image keep the medium: the sensor is in the last gap, and refracts nothing.
    """
    media: list[int] = []
    for k, surface in enumerate(surfaces):
        keeps = surface.is_mirror or surface.is_break or k == len(surfaces) - 1
        media.append(media[-1] if k and keeps else k)
    return media


def is_posed(surface: Surface) -> bool:
    """Whether the surface is tilted or decentred, or a coordinate break."""
    return surface.is_break or surface.before is not None or surface.after is not None


def is_flat(source: Surface) -> bool:
    """Whether the object is a plane across the axis."""
    return source.is_plane and source.before is None


def is_round(surface: Surface) -> bool:
    """Whether sag and phase are symmetric about the axis, by their kind and whatever their numbers are."""
    if (surface.phase is not None and not kind_of(surface.phase).is_round) or is_freeform(surface):
        return False
    return surface.sag_terms is None or SAG_TERMS[type(surface.sag_terms).__name__].is_round


def is_freeform(surface: Surface) -> bool:
    """Whether the sag without sag terms is of a kind that is not round: a toroid, a biconic."""
    return surface.coefficients is not None and not KINDS[surface.kind].is_round


def is_even(surface: Surface) -> bool:
    """Whether the surface is a centred conic with at most the terms of an even asphere, a type of all lens programs."""
    plain = surface.sag_terms is None and surface.phase is None and not is_posed(surface)
    return plain and (surface.coefficients is None or surface.kind == EVEN)


def is_searched(surface: Surface) -> bool:
    """Whether the intersection is found by iteration: no closed form exists."""
    return surface.coefficients is not None or surface.sag_terms is not None


def vertex_curvature(surface: Surface) -> Tensor:
    """c + 2 P'(0) + (D_xx + D_yy)/2 in 1/mm: a term a r² adds to the vertex curvature.

    Of a toroid or a biconic it is that of the section along y, as in other programs. The curvatures of sag terms along
    x and y are averaged. Slopes at the vertex, of sag terms or of an odd asphere, are ignored.
    """
    centre = torch.zeros_like(surface.thickness)
    total = centre if surface.curvature is None else surface.curvature
    if is_freeform(surface):
        total = freeform_sag(surface, centre, centre, 2).yy
    elif surface.coefficients is not None:
        total = total + 2 * sag_and_derivatives(centre, None, None, surface.coefficients, 1, kind=surface.kind)[1]
    if surface.sag_terms is None:
        return total
    added = relief(surface.sag_terms).sag(centre, centre)
    return total + 0.5 * (added.xx + added.yy)


def sag(surface: Surface, radius_squared: Tensor) -> Tensor:
    """Sag z in mm at r² (...) in mm²; the radicand is clamped at 0 beyond the edge of a closed conic.

    Raises ValueError for a surface that is not round: see `sag_at`.
    """
    if surface.sag_terms is not None or is_freeform(surface):
        raise ValueError("the sag of a surface that is not round depends on x and y: use sag_at(surface, x, y)")
    return round_sag(surface, radius_squared, 0)[0]


def sag_at(surface: Surface, x: Tensor, y: Tensor) -> Tensor:
    """Sag z in mm of any surface at points (...) mm; beyond the edge of a closed conic, the sag of the edge."""
    z = freeform_sag(surface, x, y, 0).z if is_freeform(surface) else round_sag(surface, x * x + y * y, 0)[0]
    return z if surface.sag_terms is None else z + relief(surface.sag_terms).sag(x, y, highest=0).z


def round_sag(surface: Surface, u: Tensor, highest: int, along: Tensor | float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """`sag_and_derivatives` of a round kind, without sag terms."""
    c, k, a = surface.curvature, surface.conic, surface.coefficients
    return sag_and_derivatives(u, c, k, a, highest, along=along, kind=surface.kind)


def sag_and_derivatives(
    u: Tensor,
    curvature: Tensor | None,
    conic: Tensor | None,
    coefficients: Tensor | None,
    highest: int = 2,
    *,
    along: Tensor | float = 1.0,
    kind: str = EVEN,
) -> tuple[Tensor, Tensor, Tensor]:
    """S(u), dS/du, v² d²S/du² with u = r² (...) in mm²; derivatives above the `highest` are 0.

    along: v; the second derivative has the factor v² because c³ alone leaves the range of numbers before any length or
    curvature does. Beyond the edge of a closed conic its radicand is held at 0+.

    S = c u/(1+w) + Σ_j a_j b_j,  w = √(1 - (1+k) c² u);  dS = c/2w + …;  d²S = (1+k) c³/4w³ + …
    """
    S = dS = d2S = torch.zeros_like(u)
    if curvature is not None:
        S, dS, d2S = conic_terms(u, curvature, conic, highest, along)
    if coefficients is not None:
        P, dP, d2P = KINDS[kind].terms(u, coefficients, highest, along)
        S = S + P
        dS = dS if dP is None else dS + dP
        d2S = d2S if d2P is None else d2S + d2P
    return S, dS, d2S


def freeform_sag(surface: Surface, x: Tensor, y: Tensor, highest: int) -> Sag:
    """The sag of a kind that is not round, without sag terms. Raises TypeError for a round surface."""
    form, a = KINDS[surface.kind].form, surface.coefficients
    if form is None or a is None:
        raise TypeError(f"a round surface (kind {surface.kind!r}); expected a kind that is not round")
    c, k = (a.new_zeros(()) if number is None else number for number in (surface.curvature, surface.conic))
    return form.sag(c, k, a, x, y, highest)


# -- paraxial refraction and the y-nu trace: ω = n u of a slope u = dy/dz, n signed, negative towards -z ---------------


def signed(surfaces: Sequence[Surface], indices: Sequence[Number]) -> list[Number]:
    """Indices made negative where light travels towards -z; indices: before and behind the surfaces, one more."""
    side, result = 1, [indices[0]]
    for surface, n in zip(surfaces, indices[1:], strict=True):
        side = -side if surface.is_mirror else side
        result.append(side * n)
    return result


def power(surface: Surface, before: Tensor, behind: Tensor, wavelength: Tensor | None = None) -> Tensor:
    """Power (...) in 1/mm of a surface between signed indices (...), by its section along y; wavelength: of a phase."""
    refractive = vertex_curvature(surface) * (behind - before)
    return refractive if surface.phase is None else refractive + power_of(surface.phase, wavelength)[1]


def ynu(y: Number, omega: Number, powers: Sequence[Number], gaps: Sequence[Number]) -> list[tuple[Number, Number]]:
    """(y, ω) of a paraxial ray before each surface, and behind the last surface, or behind its gap if that is given.

    powers: of the surfaces, 1/mm; gaps: t/n behind all of them, or all but the last. Any number type.
    """
    rays = [(y, omega)]
    for k, strength in enumerate(powers):
        omega = omega - strength * y
        y = y + gaps[k] * omega if k < len(gaps) else y
        rays.append((y, omega))
    return rays

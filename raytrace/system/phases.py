"""Phases: optical path that a thin structure adds on a surface, or its action in place of Snell's law.

A grating, a hologram or a diffractive lens adds a path p(x, y), in mm, and its gradient to the tangential component of
n d: [n2 d2] = [n1 d1] + ∇p (`tracing.trace`). An ideal lens changes slopes instead, and the facets of a Fresnel lens
stand on a plane. A new kind is a new value and a new row of PHASES: rays, derivatives, first order, variables and files
read it.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from raytrace.maths.bivariate import fringe_to_powers, polynomial_xy
from raytrace.maths.numerics import dot, polynomial, value

_MICROMETRE = 1e-3  # mm

#: A point or a direction: x, y, z (...).
Vector = Tensor | Sequence[Tensor]


class Added(NamedTuple):
    """The path (...) mm that is added at a point, and its derivatives (...) by x and y."""

    path: Tensor
    x: Tensor
    y: Tensor


@value
class PolynomialPath:
    """The path itself, p = constant + Σ c_k x^i y^j in the order x, y, x², xy, y², …

    coefficients: (K, ...) mm^(1-i-j); constant: (...) mm, None for a path that is 0 at the vertex.
    """

    coefficients: Tensor
    constant: Tensor | None = None


@value
class RadialPath:
    """The path itself, p = Σ a_j r^2j; coefficients: (J, ...) mm^(1-2j)."""

    coefficients: Tensor


@value
class HologramPath:
    """The path itself, p = scale (|P - first| + |P - second|) less that of the vertex; first, second: (3, ...) mm."""

    first: Tensor
    second: Tensor
    scale: Tensor


Path = PolynomialPath | RadialPath | HologramPath


@value
class Grating:
    """Straight grooves along x, equally spaced in the projection on the x-y plane: p = order · frequency · λ y.

    frequency: lines per µm along y; order: of diffraction.
    """

    frequency: Tensor
    order: Tensor


@value
class RadialPhase:
    """p = order λ/2π Σ A_j ρ^2j, ρ = r/radius: "binary 2". coefficients: (J,) A_j in radians; radius: mm."""

    coefficients: Tensor
    radius: Tensor
    order: Tensor


@value
class PolynomialPhase:
    """p = order λ/2π Σ A_k (x/radius)^i (y/radius)^j: "binary 1". coefficients: (K,) radians of x, y, x², xy, y², …"""

    coefficients: Tensor
    radius: Tensor
    order: Tensor


@value
class FringePhase:
    """p = order λ Σ A_k Z_k(ρ, φ), Zernike's fringe terms, not normalised. coefficients: (K,) waves; radius: mm."""

    coefficients: Tensor
    radius: Tensor
    order: Tensor


@value
class Hologram:
    """The interference of waves from one point and towards another, recorded on the plane of the vertex.

        p = -order λ/λ0 (|P - first| + |P - second|), less its value at the vertex

    first, second: (3,) mm, where light comes from and goes to if it is the recording one; wavelength: λ0, µm.
    """

    first: Tensor
    second: Tensor
    wavelength: Tensor
    order: Tensor


@value
class IdealLens:
    """A thin lens without aberrations: n2 tan θ2 = n1 tan θ1 - power · height, in x and in y.

    power_x, power_y: 1/mm. vergence: 1/s, s mm from the point that is imaged sharply, in the direction of light, to the
    lens: light from there has the same path along every ray (of unequal powers only near the axis); None, or 0, for a
    point at infinity. It is computed where a whole lens is traced: see `tracing.trace.sequence_of`.
    opd_mode: OpticStudio's mode of the path, 0 to 3; kept for the file.
    """

    power_x: Tensor
    power_y: Tensor
    vergence: Tensor | None = None
    opd_mode: int = 0


@value
class Facets:
    """A Fresnel lens: rays meet the plane of the vertex, and refract as at the curved surface above that point."""


Phase = Grating | RadialPhase | PolynomialPhase | FringePhase | Hologram | IdealLens | Facets | Path


@dataclasses.dataclass(frozen=True)
class PhaseKind:
    """A kind of phase; λ is (...) µm, and either of the first two is None for a kind that does not have it.

    path: phase, λ -> the path itself.
    power: phase, λ -> -∂²p/∂x² and -∂²p/∂y² at the vertex in 1/mm: its paraxial power.
    slopes: whether it changes slopes by that power, in place of Snell's law; flat: whether rays meet the plane of the
    vertex, whatever the shape of the surface is; is_round: about the axis; chromatic: whether it depends on λ.
    """

    path: Callable[[Any, Any], Path] | None = None
    power: Callable[[Any, Any], tuple[Tensor, Tensor]] | None = None
    slopes: bool = False
    flat: bool = False
    is_round: bool = False
    chromatic: bool = True


def _grating(phase: Grating, wavelength: Tensor) -> PolynomialPath:
    slope = phase.order * phase.frequency * wavelength
    return PolynomialPath(torch.stack([torch.zeros_like(slope), slope]))


def _radial(phase: RadialPhase, wavelength: Tensor) -> RadialPath:
    scale = phase.order * wavelength * (_MICROMETRE / (2 * math.pi))
    orders = [2 * j for j in range(1, len(phase.coefficients) + 1)]
    return RadialPath(_scaled(phase.coefficients, phase.radius, orders, scale))


def _polynomial(phase: PolynomialPhase, wavelength: Tensor) -> PolynomialPath:
    scale = phase.order * wavelength * (_MICROMETRE / (2 * math.pi))
    return PolynomialPath(_scaled(phase.coefficients, phase.radius, _degrees(len(phase.coefficients)), scale))


def _fringe(phase: FringePhase, wavelength: Tensor) -> PolynomialPath:
    matrix, constants = map(phase.coefficients.new_tensor, fringe_to_powers(phase.coefficients.shape[0]))
    terms = torch.tensordot(matrix, phase.coefficients, dims=1)
    scale = phase.order * wavelength * _MICROMETRE
    piston = scale * torch.tensordot(constants, phase.coefficients, dims=1)
    return PolynomialPath(_scaled(terms, phase.radius, _degrees(len(terms)), scale), piston)


def _degrees(count: int) -> list[int]:
    return [n for n in range(1, count + 1) for _ in range(n + 1)][:count]


def _scaled(terms: Tensor, radius: Tensor, orders: list[int], scale: Tensor) -> Tensor:
    """c_k s/R^n (K, ...) of terms (K, ...) of orders n."""
    if not orders:
        return scale.new_zeros(0, *scale.shape)
    return torch.stack([c * scale / radius**n for c, n in zip(terms.unbind(0), orders, strict=True)])


def _hologram_added(hologram: HologramPath, x: Tensor, y: Tensor) -> Added:
    scale = hologram.scale
    path = slope_x = slope_y = torch.zeros_like(x)
    for point in (hologram.first, hologram.second):
        a, b, c = point.unbind(0)
        from_vertex, from_point = torch.sqrt(dot(point, point)), torch.sqrt((x - a) ** 2 + (y - b) ** 2 + c * c)
        path = path + (x * (x - 2 * a) + y * (y - 2 * b)) / (from_point + from_vertex)
        slope_x, slope_y = slope_x + (x - a) / from_point, slope_y + (y - b) / from_point
    return Added(scale * path, scale * slope_x, scale * slope_y)


def _hologram(phase: Hologram, wavelength: Tensor) -> HologramPath:
    return HologramPath(phase.first, phase.second, -phase.order * wavelength / phase.wavelength)


def _hologram_power(phase: Hologram | HologramPath, wavelength: Tensor) -> tuple[Tensor, Tensor]:
    def power_along(axis: int) -> Tensor:
        total = torch.zeros_like(scale)
        for point in (phase.first, phase.second):
            squared = dot(point, point)
            total = total + (squared - point[axis] ** 2) / squared**1.5
        return -scale * total

    scale = (phase if isinstance(phase, HologramPath) else _hologram(phase, wavelength)).scale
    return power_along(0), power_along(1)


#: Kinds of phase, by the name of their class.
PHASES = {
    "Grating": PhaseKind(path=_grating),
    "RadialPhase": PhaseKind(path=_radial, is_round=True),
    "PolynomialPhase": PhaseKind(path=_polynomial),
    "FringePhase": PhaseKind(path=_fringe),
    "Hologram": PhaseKind(path=_hologram, power=_hologram_power),
    "IdealLens": PhaseKind(power=lambda lens, _: (lens.power_x, lens.power_y), slopes=True, chromatic=False),
    "Facets": PhaseKind(flat=True, is_round=True, chromatic=False),
    "PolynomialPath": PhaseKind(path=lambda path, _: path, chromatic=False),
    "RadialPath": PhaseKind(path=lambda path, _: path, is_round=True, chromatic=False),
    "HologramPath": PhaseKind(path=lambda path, _: path, power=_hologram_power, chromatic=False),
}


def kind_of(phase: Phase) -> PhaseKind:
    """The row of a phase."""
    return PHASES[type(phase).__name__]


def _kind_at(phase: Phase, wavelength: Tensor | None) -> PhaseKind:
    """The row of a phase. Raises ValueError for a chromatic phase without wavelengths."""
    kind = kind_of(phase)
    if kind.chromatic and wavelength is None:
        raise ValueError(f"the action of a phase ({type(phase).__name__}) depends on the wavelength: pass `wavelength`")
    return kind


def path_of(phase: Phase, wavelength: Tensor | None) -> Path | None:
    """The path that a phase adds; None for a phase that adds none. wavelength: (...) µm."""
    kind = _kind_at(phase, wavelength)
    return None if kind.path is None else kind.path(phase, wavelength)


def added_path(phase: Phase, x: Tensor, y: Tensor, wavelength: Tensor | None) -> Added:
    """The path that is added at points (...) mm, of any kind that adds one; wavelength: (...) µm."""
    path = path_of(phase, None if wavelength is None else wavelength.to(x.dtype))
    if isinstance(path, HologramPath):
        return _hologram_added(path, x, y)
    if isinstance(path, RadialPath):
        a, u = path.coefficients, x * x + y * y
        order = torch.arange(1, len(a) + 1, dtype=a.dtype, device=a.device).reshape(-1, *(1,) * (a.dim() - 1))
        twice = 2 * polynomial(order * a, u)
        return Added(u * polynomial(a, u), twice * x, twice * y)
    if path is None:
        raise TypeError(f"a phase ({type(phase).__name__}) adds no path")
    z, slope_x, slope_y, *_ = polynomial_xy(path.coefficients, x, y, highest=1)
    return Added(z if path.constant is None else z + path.constant, slope_x, slope_y)


def power_of(phase: Phase, wavelength: Tensor | None) -> tuple[Tensor, Tensor]:
    """The paraxial power (...) 1/mm in x and y, -∂²p/∂x² and -∂²p/∂y² at the vertex. wavelength: (...) µm."""
    kind = _kind_at(phase, wavelength)
    if kind.power is not None:
        return kind.power(phase, wavelength)
    path, zero = path_of(phase, wavelength), torch.zeros(()) if wavelength is None else torch.zeros_like(wavelength)
    c = path.coefficients if isinstance(path, PolynomialPath | RadialPath) else ()
    along_x, along_y = (0, 0) if kind.is_round else (2, 4)
    return (-2 * c[along_x] if len(c) > along_x else zero), (-2 * c[along_y] if len(c) > along_y else zero)


def ideal_path(lens: IdealLens, point: Vector, before: Vector, behind: Vector, n1: Tensor, n2: Tensor) -> Tensor:
    """The path (...) mm through an ideal lens that makes it alike along all rays of a point, O, to its image, I.

        Δ = n1 (|O| - |OP|) + n2 (|I| - |PI|) + (φx - φy) (x² - y²)/4,  n1/s + n2/s′ = (φx + φy)/2
        |O| - |OP| = (v |P|² - 2 d·P)/(|v P - d| + 1),  v = |N|/s the inverse distance along the ray d, and so for I

    point: P = (x, y, ...) mm on the lens; before, behind: directions by components. A point at infinity is v = 0. Of
    unequal powers no point has a sharp image: the mean power has the path of a round lens along the bent rays, and the
    last term makes Δ -(φx x² + φy y²)/2 near the axis. Δ is smooth in both powers.
    """
    x, y = point[0], point[1]
    vergence = torch.zeros_like(lens.power_x) if lens.vergence is None else lens.vergence
    onward = (0.5 * (lens.power_x + lens.power_y) - n1 * vergence) / n2
    round_part = n1 * _longer(x, y, before, vergence, -1.0) + n2 * _longer(x, y, behind, onward, 1.0)
    return round_part + 0.25 * (lens.power_x - lens.power_y) * (x * x - y * y)


def _longer(x: Tensor, y: Tensor, direction: Vector, vergence: Tensor, sign: float) -> Tensor:
    """|O| - |OP| of `ideal_path` of a ray's direction, or of its image."""
    L, M, N = direction
    v = N.abs() * vergence
    along = sign * (L * x + M * y)
    reach = torch.sqrt((v * x + sign * L) ** 2 + (v * y + sign * M) ** 2 + N * N)
    return (v * (x * x + y * y) + 2 * along) / (reach + 1)

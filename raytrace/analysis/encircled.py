"""Encircled energy: the share of a field's light within a circle, a rectangle or a slit about its centroid."""

import math
from typing import Any, Literal

import torch
from torch import Tensor

from raytrace.analysis.panels import by_field, chart, finished, mark_fields
from raytrace.analysis.pupil_autocorrelation import ExitPupil, exit_pupil
from raytrace.analysis.result import Analysis, fine
from raytrace.analysis.setting import (
    Numbers,
    Points,
    primary_wavelength,
    refuse_dark,
    scene_of,
    setting,
    wavelength_shares,
)
from raytrace.budget import RAY_BYTES, afford, piece
from raytrace.maths.numerics import safe_divide, safe_sqrt, value
from raytrace.maths.result import Column
from raytrace.plotting.style import GREY, Figure, array, styled
from raytrace.psf_models.dft import phasor
from raytrace.system.lens import Lens, vector
from raytrace.tracing.f_number import axial_f_number
from raytrace.tracing.scene import Scene
from raytrace.tracing.spot import image_rays
from raytrace.words import option

_RAYS = 4096
_RINGS_PER_STEP = 16

Shape = Literal["circle", "square", "rectangle", "x", "y"]

#: Half-widths along x and y of the shapes with straight sides, relative to the half-width of the call.
_SIDES = {"square": (1.0, 1.0), "x": (1.0, math.inf), "y": (math.inf, 1.0)}

#: Relative half-widths along x and y, inf where unlimited.
Sides = tuple[float, float]

#: The abscissa of the figure, and its title.
_NAMES = {
    "circle": ("radius from the centroid", "encircled energy"),
    "square": ("half-width of the square about the centroid", "ensquared energy"),
    "rectangle": ("half-width along x of the rectangle about the centroid", "energy in a rectangle"),
    "x": ("half-width along x of the slit about the centroid", "energy in a slit"),
    "y": ("half-width along y of the slit about the centroid", "energy in a slit"),
}


@value
class EncircledEnergy(Analysis):
    """Share (F, K) of the light that reaches the sensor within radii (K,) mm of the centroid (2, F) mm of the rays.

    fields: (2, F); geometric: of rays, without diffraction; marked: whether the radii were specified, and are marked on
    the curves; shape, aspect: as for `encircled_energy`: radii of other shapes than the circle are half-widths.
    """

    lens: Lens
    fields: Tensor
    radii: Tensor
    share: Tensor
    centroid: Tensor
    geometric: bool
    marked: bool = False
    shape: str = "circle"
    aspect: float | None = None

    COMMAND = "encircled-energy"
    EVERY = 5
    COLUMNS = (Column("half_width", "mm"),)

    def columns(self) -> dict[str, Tensor]:
        name = "radius" if self.shape == "circle" else "half_width"
        return {**self.heads(**{name: self.radii}), "share": self.share}

    def about(self) -> dict[str, Any]:
        return {"shape": self.shape} | ({} if self.aspect is None else {"aspect": self.aspect})

    def drawn(self) -> "EncircledEnergy":
        return _encircled(self.lens, self.fields, fine(self.radii), self.geometric, self.shape, self.aspect)

    @styled
    def draw(self) -> Figure:
        """Share of the light over the radius or half-width about the centroid. Specified radii are marked."""
        curves = self.drawn()
        abscissa, name = _NAMES[self.shape]
        panel = chart(6.0, 3.8, f"{abscissa} (µm)", name)
        radii = 1e3 * array(curves.radii)
        by_field(panel, curves, radii, share=array(curves.share))
        if self.marked:
            mark_fields(panel, 1e3 * array(self.radii), array(self.share))
        panel.axhline(0.8, color=GREY, linewidth=0.7, linestyle=":")
        panel.set(xlim=(0, radii.max()), ylim=(0, 1.02))
        light = "geometric" if curves.geometric else "diffraction"
        if self.aspect is not None:
            name += f" {self.aspect:g} times as high as wide"
        return finished(panel, curves, f"{light} {name}", 6)


def encircled_energy(
    lens: Lens,
    radii: Numbers = None,
    *,
    shape: Shape = "circle",
    aspect: float | None = None,
    geometric: bool = False,
    fields: Points = None,
    wavelengths: Numbers = None,
) -> EncircledEnergy:
    """Encircled energy at radii (K,) mm, by default 41 up to the larger of the blur and six wavelengths times the F/#.

        E(r) = ∬ OTF(ν) r J₁(2πrν)/ν d²ν                           of diffraction, within a circle
        E(a, b) = ∬ OTF(ν) 4ab sinc(2aν_x) sinc(2bν_y) d²ν         within |x| < a, |y| < b
        E(a) = ∫ OTF(ν_x, 0) 2a sinc(2aν_x) dν_x                   within a slit, |x| < a: the line spread integrated
        E(r) = Σ_j w_j [|x_j - x̄| < r]                              geometric, linear between one ray and the next

    radii: about the centroid of the rays, mm, by default from 0 to almost all of the light; of other shapes than the
    circle, half-widths; shape: "circle"; "square" (ensquared energy); "rectangle", of half-width a along x and a·aspect
    along y; "x" or "y", a slit: within a half-width along x or y, unlimited along the other axis; aspect: height over
    width of the rectangle; geometric: of rays alone, without diffraction; fields: y or (x, y); wavelengths: µm.
    Differentiable in the lens. Raises ValueError where too few rays arrive, and for an unknown shape.
    """
    _sides(shape, aspect)  # refused before rays are traced
    lens, fields = setting(lens, fields, wavelengths, every=True)
    return _encircled(lens, fields, None if radii is None else vector(radii, like=lens), geometric, shape, aspect)


def _sides(shape: str, aspect: float | None) -> Sides | None:
    """Relative half-widths along x and y of a shape with straight sides, None for the circle. Raises ValueError."""
    if shape not in _NAMES:
        raise ValueError(f"{option('shape')} {shape!r} is not known; expected one of {', '.join(_NAMES)}")
    if shape != "rectangle":
        if aspect is not None:
            raise ValueError(f"{option('aspect')} belongs to {option('shape', 'rectangle')}; leave it out for {shape}")
        return _SIDES.get(shape)
    if aspect is None or not 0 < aspect < math.inf:
        reason = "is missing" if aspect is None else f"is {aspect:g}"
        raise ValueError(f"{option('aspect')}, height over width of the rectangle, {reason}; expected a number above 0")
    return 1.0, float(aspect)


def _encircled(
    lens: Lens, fields: Tensor, radii: Tensor | None, geometric: bool, shape: str, aspect: float | None
) -> EncircledEnergy:
    sides = _sides(shape, aspect)
    distance, energy, centroid = _rays(lens, fields, sides)
    marked = radii is not None
    if radii is None:
        airy = 6e-3 * primary_wavelength(lens) * axial_f_number(lens)
        blur = torch.where(energy > 0, distance, 0.0).max()
        airy = torch.where(airy.isfinite(), airy, 0.0) / min(sides or (1.0,))  # of a parallel beam there is none
        top = torch.maximum(blur * 1.02, airy * (not geometric)).detach()
        radii = top * torch.linspace(0, 1, 41, dtype=top.dtype, device=top.device)
    share = _of_rays(distance, energy, radii) if geometric else _of_waves(lens, fields, centroid, radii, sides)
    return EncircledEnergy(lens, fields, radii, share, centroid, geometric, marked, shape, aspect)


def _rays(lens: Lens, fields: Tensor, sides: Sides | None) -> tuple[Tensor, Tensor, Tensor]:
    """Distances (F, W·P) from the centroid (2, F) of all wavelengths, and shares (F, W·P) of the light.

    The distance is the radius, or half-width, of the smallest shape that holds the ray.
    """
    F, W = fields.shape[1], len(lens.wavelengths)
    afford(
        64 * F * W * _RAYS,
        f"{F * W * _RAYS:,} rays ({F} fields × {W} wavelengths)",
        helps="ask for fewer {fields}",
    )
    parts = [_rays_of(lens, some, sides) for some in fields.split(piece(RAY_BYTES * W * _RAYS), 1)]
    distance, energy, centroid = zip(*parts, strict=True)
    return torch.cat(distance), torch.cat(energy), torch.cat(centroid, 1)


def _rays_of(lens: Lens, fields: Tensor, sides: Sides | None) -> tuple[Tensor, Tensor, Tensor]:
    rays = image_rays(lens, _spiral(_RAYS, lens.wavelengths), fields=fields)
    energy = torch.where(rays.valid, wavelength_shares(lens)[:, None] / _RAYS, 0.0).flatten(1)
    hits = torch.where(rays.valid, rays.position[:2], 0.0).flatten(2)
    total = energy.sum(-1)
    refuse_dark(lens, fields, (total > 0)[:, None], "encircled energy")
    energy = energy / total[:, None]
    centroid = (energy * hits).sum(-1)
    x, y = torch.where(energy > 0, hits - centroid[..., None], 0.0)
    distance = safe_sqrt(x * x + y * y) if sides is None else torch.maximum(x.abs() / sides[0], y.abs() / sides[1])
    return distance, energy, centroid


def _of_rays(distance: Tensor, energy: Tensor, radii: Tensor) -> Tensor:
    """Half of the light of a ray counts at its distance; the curve is linear in between, and starts at 0."""
    distance, order = torch.where(energy > 0, distance, distance.max()).sort(-1)
    energy = torch.gather(energy, -1, order)
    half = energy.cumsum(-1) - 0.5 * energy
    zero = torch.zeros_like(distance[:, :1])
    place = torch.cat([zero, distance, distance[:, -1:]], -1)
    height = torch.cat([zero, half, torch.ones_like(zero)], -1)
    inside = torch.searchsorted(place.detach(), radii.expand(len(place), -1).contiguous(), right=True)
    after = inside.clamp(1, place.shape[-1] - 1)
    low, high = (torch.gather(place, -1, k) for k in (after - 1, after))
    below, above = (torch.gather(height, -1, k) for k in (after - 1, after))
    share = below + (above - below) * safe_divide(radii - low, high - low)
    return torch.where(radii >= place[:, -1:], 1.0, share)


def _of_waves(lens: Lens, fields: Tensor, centroid: Tensor, radii: Tensor, sides: Sides | None) -> Tensor:
    whole, rows = scene_of(lens, fields), []
    for f, field in enumerate(fields.split(1, 1)):
        pupil = exit_pupil(Scene(whole.lens, field, whole.wavelengths))
        weights = wavelength_shares(lens) * pupil.light[0]
        parts = torch.stack([_of_wave(pupil, w, centroid[:, f], radii, sides) for w in range(len(weights))])
        rows.append((weights[:, None] * parts).sum(0) / weights.sum())
    return torch.stack(rows)


def _of_wave(pupil: ExitPupil, w: int, centroid: Tensor, radii: Tensor, sides: Sides | None) -> Tensor:
    """E (K,) of one wavelength of a field about the centroid (2,)."""
    size = pupil.amplitude.shape[-1]
    spectrum = torch.fft.fft2(pupil.amplitude[0, w], s=(2 * size, 2 * size))
    overlap = torch.fft.ifft2(spectrum.real**2 + spectrum.imag**2) / pupil.energy[0, w]
    first = torch.zeros_like(overlap, dtype=torch.bool)
    first[0, 0] = True
    overlap = torch.where(first, 1.0 + 0j, overlap)  # the rim's cells count by their share, not by its square
    lag = torch.fft.fftfreq(2 * size, 1 / (2 * size), dtype=radii.dtype, device=radii.device)
    step = pupil.step[:, 0, w]
    x, y = lag * step[0], lag[:, None] * step[1]
    offset_x, offset_y = centroid - pupil.centre[:, 0, w]
    offset, period = torch.hypot(offset_x, offset_y).detach(), 1 / step  # the transform repeats the light
    _refuse_far(offset, 0.5 * period.detach().min())
    otf = (overlap * phasor(x * offset_x + y * offset_y)).real * step.prod()
    radii = radii.detach()
    if sides is None:
        return _in_circle(otf, x, y, radii, period.detach(), offset)
    # A side of one period, the most there is, leaves the frequency 0 alone: it is unlimited.
    widths = [2 * torch.minimum(half, 0.5 * p) for half, p in zip(_halves(radii, sides), period, strict=True)]
    by_x, by_y = (
        width[:, None] * torch.sinc(width[:, None] * line.flatten()) for width, line in zip(widths, (x, y), strict=True)
    )
    return ((by_y @ otf) * by_x).sum(-1)


def _halves(radii: Tensor, sides: Sides) -> list[Tensor]:
    """Half-widths (K,) along x and along y, inf where unlimited."""
    return [radii * side if math.isfinite(side) else torch.full_like(radii, math.inf) for side in sides]


def _in_circle(otf: Tensor, x: Tensor, y: Tensor, radii: Tensor, period: Tensor, offset: Tensor) -> Tensor:
    """E (K,) within circles; the sum over ν is gathered in rings first, linearly, and so are its derivatives."""
    width = float((1 / period).min()) / _RINGS_PER_STEP
    place, otf = safe_sqrt(x * x + y * y).flatten() / width, otf.flatten()
    ring = place.detach().floor().to(torch.int64)
    rings = otf.new_zeros(int(ring.max()) + 2)
    rings = rings.index_add(0, ring, otf * (ring + 1 - place)).index_add(0, ring + 1, otf * (place - ring))
    frequency = (torch.arange(len(rings), dtype=radii.dtype, device=radii.device) * width).clamp_min(1e-6 * width)
    r = radii.clamp_max(0.5 * period.min())[:, None]
    share = (r * torch.special.bessel_j1(2 * math.pi * r * frequency) / frequency) @ rings
    return torch.where(radii < 0.5 * torch.hypot(*period) + offset, share, 1.0)


def _refuse_far(offset: Tensor, reach: Tensor) -> None:
    """Raise ValueError for light so far (mm) from the centroid that the transform would count its repetitions."""
    if bool(offset > reach):
        raise ValueError(
            f"light of one wavelength lands {float(offset):.3g} mm from the centroid of all, beyond the "
            f"{float(reach):.3g} mm that waves are followed: ask for {option('geometric')}, or for one of the "
            f"{option('wavelengths')}"
        )


def _spiral(count: int, like: Tensor) -> Tensor:
    """Points (2, P) of a sunflower: equal areas, no two at one radius, so that a share grows evenly with the radius."""
    j = torch.arange(count, dtype=like.dtype, device=like.device)
    radius, angle = torch.sqrt((j + 0.5) / count), j * (math.pi * (3 - math.sqrt(5)))
    return torch.stack([radius * torch.cos(angle), radius * torch.sin(angle)])

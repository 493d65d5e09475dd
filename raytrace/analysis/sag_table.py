"""Sag table: sag and slope of a surface over its radius, its departure from the vertex sphere and the best-fit sphere.

    s(r) = c r²/(1 + w),  w = √(1 - c² r²);  ∂s/∂c = r²/(w (1 + w)),  ∂²s/∂c² = c r⁴ (1 + 2w)/(w³ (1 + w)²)

BEST_FIT lists the definitions of the best-fit sphere. A departure is the sag of the surface minus the sphere's sag.
"""

import dataclasses
import math
from typing import Any

import torch
from torch import Tensor

from raytrace.analysis.panels import ruled
from raytrace.analysis.result import Analysis
from raytrace.maths.numerics import detached, value
from raytrace.maths.result import Column, Table, masked, number
from raytrace.maths.sampling import gauss_rings
from raytrace.plotting import style
from raytrace.system.intersection import normal
from raytrace.system.lens import Lens
from raytrace.system.shapes import conic_terms, curvature_through
from raytrace.system.surface import Surface, is_round, sag_at, vertex_curvature
from raytrace.tracing.geometry import edge_radius, semi_diameters
from raytrace.words import option

#: Definitions of the best-fit sphere.
BEST_FIT = {
    "rms": "least squares of the sag over the aperture, by area, through the vertex",
    "offset": "least squares of the sag over the aperture, by area, shifted along z",
    "rim": "through the vertex and the rim",
}

_RINGS, _ARMS, _DENSE = 48, 32, 2001  # of the least squares; radii at which the largest departure is looked for
_STEPS = 30


@value
class SagTable(Analysis):
    """Sag (N,) mm and slope (N,) of a surface at radii (N,) mm, along one direction, and departures (N,) mm.

    surface: its number; semi_diameter: mm, of the table and of the fits; azimuth: of the direction, degrees from x.
    vertex_departure, best_fit_departure: (N,) mm, from the sphere of the vertex curvature (nan where that closes) and
        from the best-fit sphere.
    best_fit: a key of BEST_FIT; best_fit_curvature: () 1/mm; offset: () mm along z of that sphere's vertex.
    largest, rms: () mm of the departure from the best-fit sphere over the aperture; steepest: () slope of the surface.
    """

    lens: Lens
    surface: int
    semi_diameter: float
    azimuth: float
    radii: Tensor
    sag: Tensor
    slope: Tensor
    vertex_curvature: Tensor
    vertex_departure: Tensor
    best_fit: str
    best_fit_curvature: Tensor
    offset: Tensor
    best_fit_departure: Tensor
    largest: Tensor
    rms: Tensor
    steepest: Tensor

    COMMAND = "sag"
    COLUMNS = (
        Column("radius", "mm"), Column("sag", "mm", ".7f"), Column("slope", "", ".7f"),
        Column("vertex_departure_um", "µm", ".4f", "from the\nvertex sphere"),
        Column("best_fit_departure_um", "µm", ".4f", "from the\nbest-fit sphere"),
    )  # fmt: skip

    @property
    def best_fit_radius(self) -> Tensor:
        """() mm of the best-fit sphere; inf of a plane."""
        return 1 / self.best_fit_curvature

    def columns(self) -> dict[str, Tensor]:
        departures = {"vertex": self.vertex_departure, "best_fit": self.best_fit_departure}
        in_um = {f"{name}_departure_um": 1e3 * departure for name, departure in departures.items()}
        return {"radius": self.radii, "sag": self.sag, "slope": self.slope} | in_um

    def about(self) -> dict:
        return {
            "surface": self.surface,
            "semi_diameter": self.semi_diameter,
            "azimuth": self.azimuth,
            "vertex_radius": number(1 / self.vertex_curvature),
            "best_fit": self.best_fit,
            "best_fit_radius": number(self.best_fit_radius),
            "offset_um": number(1e3 * self.offset),
            "largest_departure_um": number(1e3 * self.largest),
            "rms_departure_um": number(1e3 * self.rms),
            "largest_slope": number(self.steepest),
        }

    def tables(self) -> list[Table]:
        along = "" if is_round(self.lens.surfaces[self.surface]) else f", along {self.azimuth:g}° from x"
        shift = f", shifted by {1e3 * float(self.offset):.4f} µm" if self.best_fit == "offset" else ""
        title = [
            f"surface {self.surface} up to a radius of {self.semi_diameter:.6g} mm{along}",
            f"  vertex sphere    radius {_radius(self.vertex_curvature)}",
            f"  best-fit sphere  radius {_radius(self.best_fit_curvature)}{shift}: {BEST_FIT[self.best_fit]}",
            f"  departure from it at most {1e3 * float(self.largest):.4f} µm, RMS {1e3 * float(self.rms):.4f} µm",
            f"  slope at most {float(self.steepest):.6f}, {math.degrees(math.atan(float(self.steepest))):.4f}°",
            "",
        ]
        return [Table(self.columns(), title)]

    @style.styled
    def draw(self) -> style.Figure:
        """Sag and slope, and the departures, over the radius."""
        fine = sag(
            self.lens,
            self.surface,
            step=self.semi_diameter / 200,
            semi_diameter=self.semi_diameter,
            best_fit=self.best_fit,
            azimuth=self.azimuth,
        )
        figure = style.new_figure(8.0, 3.6)
        left, right = figure.subplots(1, 2)
        r = style.array(fine.radii)
        ruled(left).plot(r, style.array(fine.sag), color=style.INK, label="sag (mm)")
        left.plot(r, style.array(fine.slope), color=style.field_colour(0), linestyle=(0, (4, 2)), label="slope")
        ruled(right).plot(
            r, 1e3 * style.array(fine.best_fit_departure), color=style.field_colour(2),
            label=f"from the best-fit sphere, R {_radius(self.best_fit_curvature)}",
        )  # fmt: skip
        right.plot(
            r, 1e3 * style.array(fine.vertex_departure), color=style.GREY, linestyle=(0, (4, 2)),
            label=f"from the vertex sphere, R {_radius(self.vertex_curvature)}",
        )  # fmt: skip
        left.set_xlabel("radius (mm)")
        right.set(xlabel="radius (mm)", ylabel="departure (µm)")
        for panel in (left, right):
            panel.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=1)
            panel.axhline(0, color=style.GREY, linewidth=0.6)
        name = self.lens.name or "Lens"
        figure.suptitle(style.fill(f"{name}\nsag of surface {self.surface}", 8.0, 10, bold=True), fontweight="bold")
        return figure


def sag(
    lens: Lens,
    surface: int,
    *,
    step: float | None = None,
    semi_diameter: float | None = None,
    best_fit: str = "rms",
    azimuth: float = 90.0,
) -> SagTable:
    """Sag, slope and departure from the vertex sphere and the best-fit sphere of a surface, by its number.

    step: of the radius, mm, by default a round tenth of the semi-diameter; semi_diameter: mm of the aperture, by
    default the surface's own, or that of the rays of all fields; best_fit: "rms", least squares over the aperture by
    area through the vertex, "offset", the same with a shift along z, or "rim", through vertex and rim; azimuth: of the
    direction, degrees from x, of surfaces that are not round. Numbers have derivatives by those of the surface.
    Raises ValueError for a surface without a sag there.
    """
    last = len(lens.surfaces) - 1
    if not 1 <= surface <= last or lens.surfaces[surface].is_break:
        kind = "is a coordinate break" if 1 <= surface <= last else "does not exist"
        raise ValueError(f"surface {surface} {kind}; expected a surface with a sag, from 1 to {last}")
    if best_fit not in BEST_FIT:
        raise ValueError(f"{option('best_fit', best_fit)}: expected one of {', '.join(BEST_FIT)}")
    place = dataclasses.replace(lens.surfaces[surface], phase=None)  # facets have slopes that are not those of the sag
    h = semi_diameters(detached(lens))[surface] if semi_diameter is None else semi_diameter
    edge = edge_radius(detached(place))
    if not 0 < h < edge:
        state = "no semi-diameter is known" if math.isnan(h) else f"a semi-diameter of {h:.6g} mm"
        raise ValueError(
            f"surface {surface}: {state}; expected one above 0 and below {edge:.6g} mm, where the sag "
            f"ends: give {option('semi_diameter')}"
        )
    step = style.round_length(h / 10) if step is None else step
    if not step > 0:
        raise ValueError(f"{option('step', step)}: expected a length above 0 mm")
    like: dict[str, Any] = {"dtype": torch.float64, "device": lens.wavelengths.device}
    count = math.ceil(h / step * (1 - 1e-12))
    radii = torch.tensor([*(k * step for k in range(count)), h], **like)
    angle = math.radians(azimuth)
    z, slope = _sag_and_slope(place, radii, torch.tensor(angle, **like))
    at_vertex = vertex_curvature(place).double()
    c, offset, rms = _best_fit(place, h, best_fit, like)
    arms = torch.tensor([angle] if is_round(place) else [angle + 2 * math.pi * k / _ARMS for k in range(_ARMS)], **like)
    dense = torch.linspace(0, h, _DENSE, **like)
    everywhere, slopes = _sag_and_slope(place, dense, arms[:, None])
    return SagTable(
        lens=lens,
        surface=surface,
        semi_diameter=h,
        azimuth=azimuth,
        radii=radii,
        sag=z,
        slope=slope,
        vertex_curvature=at_vertex,
        vertex_departure=masked(z - _sphere(at_vertex, radii), (at_vertex * radii).abs() < 1),
        best_fit=best_fit,
        best_fit_curvature=c,
        offset=offset,
        best_fit_departure=z - _sphere(c, radii) - offset,
        largest=(everywhere - _sphere(c, dense) - offset).abs().max(),
        rms=rms,
        steepest=slopes.abs().max(),
    )


def _sag_and_slope(surface: Surface, radii: Tensor, angle: Tensor) -> tuple[Tensor, Tensor]:
    """Sag in mm and dz/dr at radii (N,) mm along directions (...) radians from x."""
    x, y = radii * torch.cos(angle), radii * torch.sin(angle)
    z = sag_at(surface, x, y)
    (n_x, n_y, n_z), _ = normal(surface, (x, y, z))
    return z, -(n_x * torch.cos(angle) + n_y * torch.sin(angle)) / n_z


def _sphere(c: Tensor, radii: Tensor) -> Tensor:
    return conic_terms(radii * radii, c, None, 0)[0]


def _best_fit(surface: Surface, h: float, kind: str, like: dict) -> tuple[Tensor, Tensor, Tensor]:
    """Curvature () 1/mm, shift () mm of the best-fit sphere, and the RMS () mm of the departure over the aperture.

    The root of F(c) = Σ w (s - z) ∂s/∂c, of "offset" with both factors less their means. The last two steps of Newton's
    method carry the first and second derivatives of the root.
    """
    points, weights = gauss_rings(_RINGS, 1 if is_round(surface) else _ARMS, **like)
    x, y = h * points
    u, z = x * x + y * y, sag_at(surface, x, y)
    weights = weights / weights.sum()
    ring = torch.arange(_ARMS, **like) * (2 * math.pi / _ARMS)
    c = curvature_through(sag_at(surface, h * torch.cos(ring), h * torch.sin(ring)).mean(), h)

    def centred(values: Tensor) -> Tensor:
        return values - (weights * values).sum() if kind == "offset" else values

    def newton(c: Tensor, z: Tensor) -> Tensor:
        w = torch.sqrt(1 - c * c * u)
        d, g = centred(c * u / (1 + w) - z), u / (w * (1 + w))
        g_c = c * u * u * (1 + 2 * w) / (w**3 * (1 + w) ** 2)
        slope = (weights * (centred(g) ** 2 + d * g_c)).sum()
        return c - (weights * d * centred(g)).sum() / slope

    if kind != "rim":
        fixed, limit = c.detach(), (1 - 1e-9) / h
        for _ in range(_STEPS):
            fixed = newton(fixed, z.detach()).clamp(0.5 * (fixed - limit), 0.5 * (fixed + limit))
        c = newton(newton(fixed, z), z)
    departure = z - _sphere(c, torch.sqrt(u))
    offset = (weights * departure).sum() if kind == "offset" else torch.zeros_like(c)
    return c, offset, torch.sqrt((weights * (departure - offset) ** 2).sum())


def _radius(curvature: Tensor) -> str:
    return f"{style.number_text(1 / float(curvature), 7)} mm" if float(curvature) else "∞ (plane)"

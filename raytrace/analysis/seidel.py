"""Seidel: the five third-order aberrations and the two first-order colours, surface by surface, and their sums.

With marginal ray (y, u), chief ray (ȳ, ū), A = n i = n (u + y c), Ā likewise and H = n (ū y - u ȳ), at every surface

    S1 = -A² y Δ(u/n),  S2 = -A Ā y Δ(u/n),  S3 = -Ā² y Δ(u/n),  S4 = -H² c Δ(1/n),
    S5 = -Ā³ y Δ(1/n²) + Ā ȳ c Δ(1/n) (H + Ā y),  C1 = A y Δ(δn/n),  C2 = Ā y Δ(δn/n)

and where the sag departs from that of the vertex sphere by G r⁴ also 8 G Δn (y⁴, y³ ȳ, y² ȳ², 0, y ȳ³). Indices are
negative while light travels towards -z. Source: Welford, Aberrations of Optical Systems (1986), chapters 8 and 10; S5
is his (Ā/A)(S3 + S4), written so that A may be 0. δn runs from the shortest wavelength to the longest, as in the tables
of OpticStudio, so that C1 of a single positive lens is negative; Welford's C has the other sign.
"""

from collections.abc import Callable, Sequence
from typing import Literal

import torch
from torch import Tensor

from raytrace.analysis.panels import field_axis, finished
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import Points, field_words, primary_wavelength
from raytrace.maths.numerics import Number, value
from raytrace.maths.result import Column, Table, cell, rounding
from raytrace.plotting.style import FAINT, GREY, INK, Figure, array, field_colour, new_figure, styled
from raytrace.system.lens import Lens, field_label, field_points, media
from raytrace.system.surface import Surface, is_even, vertex_curvature
from raytrace.tracing.launch import is_at_infinity, paraxial_field
from raytrace.tracing.paraxial import FirstOrder, chief_ray, first_order, largest_field, marginal_ray, signed, ynu
from raytrace.tracing.trace import need_axis
from raytrace.words import named, with_article

_SEIDEL = {
    "S1": "spherical", "S2": "coma", "S3": "astigmatism", "S4": "Petzval", "S5": "distortion", "C1": "axial colour",
    "C2": "lateral colour", "W040": "spherical", "W131": "coma", "W222": "astigmatism", "W220P": "Petzval",
    "W311": "distortion", "W020": "axial colour", "W111": "lateral colour",
}  # fmt: skip
#: Powers of the field by names, after their first letter for sums, transverse and longitudinal aberrations.
_POWERS = {
    **{"1": 0, "2": 1, "3": 2, "4": 2, "5": 3}, **{"SPH": 0, "SCO": 1, "TCO": 1, "AST": 2, "PFC": 2, "SFC": 2},
    **{"TFC": 2, "DIS": 3, "AXC": 0, "LAC": 1, "040": 0, "131": 1, "222": 2, "220P": 2, "311": 3, "020": 0, "111": 1},
}  # fmt: skip
_COLOURS = ("C1", "C2", "W020", "W111", "TAXC", "TLAC", "LAXC")

Pair = tuple[Number, Number]


@value
class Seidel(Analysis):
    """Contributions (J, F, K) of surfaces 1 … K to J aberrations of F fields; their sums over K are the lens's.

    names: of the aberrations; kind: a key of KINDS; unit: "mm" or "waves".
    marginal_yni, chief_yni: (F, K) mm, y n i and ȳ n ī at every surface.
    marginal_height, chief_height: (F, K) mm, y and ȳ there.
    invariant: (F,) mm, H; fields: (2, F); wavelength: () µm, of the rays.
    """

    lens: Lens
    fields: Tensor
    contributions: Tensor
    marginal_yni: Tensor
    chief_yni: Tensor
    marginal_height: Tensor
    chief_height: Tensor
    invariant: Tensor
    wavelength: Tensor
    names: tuple[str, ...]
    kind: str
    unit: str

    COMMAND = "seidel"
    COLUMNS = property(
        lambda self: [
            *(Column(name, self.unit) for name in self.names),
            Column("marginal_yni", "mm", heading="y n i"), Column("chief_yni", "mm", heading="ȳ n ī"),
        ]
    )  # fmt: skip

    def columns(self) -> dict[str, Tensor]:
        surfaces = torch.arange(1, self.contributions.shape[-1] + 1, device=self.fields.device)
        return {
            **self.heads(surface=surfaces),
            **dict(zip(self.names, self.contributions, strict=True)),
            "marginal_yni": self.marginal_yni,
            "chief_yni": self.chief_yni,
        }

    def about(self) -> dict[str, str]:
        return {"kind": self.kind, "unit": self.unit}

    def summary(self) -> dict[str, Tensor]:
        """A row for every field: the lens's aberrations, sums over the surfaces, and its invariant."""
        total = self.contributions.sum(-1)
        return {**self.heads(), **dict(zip(self.names, total, strict=True)), "optical_invariant": self.invariant}

    def roundings(self) -> dict[str, Tensor]:
        """Roundings of the sums over the surfaces, and of Ā y = H + A ȳ, which may cancel: S2 = S1 Ā/A has the size of
        S1 H/(A y)."""
        yni, H = self.marginal_yni, self.invariant[:, None]
        ratio = torch.where(yni.abs() > rounding(yni), H / yni, 0.0)
        by_power = torch.ones_like(ratio), ratio, ratio**2, ratio**2 * (H / yni.abs().max())
        sizes = dict(zip(self.names, self.contributions, strict=True))
        colour = next(name for name in self.names if name in _COLOURS)
        limits = {}
        for name, size in sizes.items():
            on_axis = sizes[colour if name in _COLOURS else self.names[0]]
            limits[name] = rounding(size, on_axis * by_power[_POWERS[name[1:]]])
        chief = rounding(self.chief_yni, self.chief_height * H / self.marginal_height.abs().max())
        return {**limits, "marginal_yni": rounding(yni), "chief_yni": chief}

    def tables(self) -> list[Table]:
        """A table for each field: a row for each surface, and their sums, of which y n i has none."""
        surfaces = [*map(str, range(1, self.contributions.shape[-1] + 1)), "sum"]
        heights = {"marginal_yni": self.marginal_yni, "chief_yni": self.chief_yni}
        tables = []
        for f, field in enumerate(self.fields.unbind(1)):
            columns = {name: [*row, row.sum()] for name, row in zip(self.names, self.contributions[:, f], strict=True)}
            if self.kind == "coefficients":
                columns |= {name: [*values[f], ""] for name, values in heights.items()}
            invariant = f"optical invariant {cell(abs(float(self.invariant[f])), '.6g')} mm"
            title = f"field {field_words(self.lens, field)}, {invariant}"
            tables.append(Table({Column("surface"): surfaces, **columns}, [title]))
        return tables

    @styled
    def draw(self) -> Figure:
        """A row for each aberration, a bar for each surface and one for the sum, of the outermost field."""
        field = int(field_axis(self).argmax())
        values = {name: row for name, row in zip(self.names, array(self.contributions[:, field]), strict=True)}
        # A lens of one wavelength has no colours to show.
        values = {name: row for name, row in values.items() if len(self.wavelengths) > 1 or name not in _COLOURS}
        surfaces = self.contributions.shape[-1]
        figure = new_figure(max(5.2, 0.24 * surfaces + 2.4), 0.78 * len(values) + 1.1)
        panels = figure.subplots(len(values), 1, sharex=True, squeeze=False)[:, 0]
        place = [*range(1, surfaces + 1), surfaces + 1.6]
        for panel, (name, row) in zip(panels, values.items(), strict=True):
            panel.grid(axis="y", color="#ececec", linewidth=0.6, zorder=0)
            panel.set_axisbelow(True)
            panel.bar(place, [*row, row.sum()], color=[field_colour(0)] * surfaces + [INK], width=0.7)
            panel.axhline(0, color=GREY, linewidth=0.6)
            panel.axvline(surfaces + 0.8, color=FAINT, linewidth=0.8)
            panel.set_ylabel(f"{name}\n{_SEIDEL.get(name, '')}".strip(), rotation=0, ha="right", va="center")
            panel.locator_params(axis="y", nbins=3)
            panel.tick_params(axis="x", length=0)
            panel.margins(y=0.15)
        shown = range(1, surfaces + 1, 1 if surfaces <= 24 else 2)
        panels[-1].set_xticks([*shown, place[-1]], [*(str(k) for k in shown), "sum"])
        panels[-1].set(xlim=(0.3, surfaces + 2.2), xlabel="surface")
        figure.align_ylabels(panels)
        quantity = "coefficients" if self.kind in ("coefficients", "waves") else f"{self.kind} aberrations"
        label = field_label(self.lens, self.fields[:, field].tolist())
        return finished(panels[0], self, f"Seidel {quantity} ({self.unit}), field {label}")


def seidel(
    lens: Lens,
    *,
    fields: Points = None,
    kind: Literal["coefficients", "waves", "transverse", "longitudinal"] = "coefficients",
) -> Seidel:
    """Third-order aberrations at the primary wavelength, colours between the shortest and the longest wavelength.

    kind: "coefficients": S1 … S5, C1, C2 in mm. "waves": W040 = S1/8, W131 = S2/2, W222 = S3/2, W220P = S4/4,
    W311 = S5/2, W020 = C1/2, W111 = C2. "transverse": mm by which rays of the rim miss the paraxial image point, the
    upper one where there is a choice. "longitudinal": mm along z from the paraxial
    focus to theirs. The last two are nan where image space is afocal.
    fields: y or (x, y), of which the distance from the axis counts; the lens's largest by default. Image heights are
    those of the paraxial image. Raises ValueError for a kind not named here, and for a surface of other terms than even
    powers of r.
    """
    if kind not in KINDS:
        raise ValueError(f"Seidel aberrations as {kind!r}: expected one of {', '.join(KINDS)}")
    instead = "`wavefront` and `ray_fan` have the aberrations of traced rays"
    need_axis(lens, "Seidel's theory", instead)
    for number, surface in enumerate(lens.surfaces):
        if not is_even(surface):
            defect = "has added sag terms" if surface.sag_terms is not None else f"is {with_article(surface.kind)}"
            defect = defect if surface.phase is None else f"is {named(surface.phase)}"
            raise ValueError(f"surface {number} {defect}: Seidel's theory is of even powers of r; {instead}")
    paraxial = first_order(lens)
    fields = largest_field(lens) if fields is None else field_points(fields, like=lens)
    marginal, chief = marginal_ray(lens), _chief_ray(lens, fields, paraxial)
    H = chief[1] * marginal[0] - marginal[1] * chief[0]
    names, convert, unit = KINDS[kind]
    surfaces, (signed_n, steps) = lens.surfaces[1:-1], _indices(lens)
    vertex = [vertex_curvature(surface) for surface in surfaces]
    powers = [c * (behind - before) for c, before, behind in zip(vertex, signed_n[:-1], signed_n[1:], strict=True)]
    gaps = [surface.thickness / behind for surface, behind in zip(surfaces, signed_n[1:], strict=True)]
    (y, omega), (y_bar, omega_bar) = (
        tuple(_per_surface(column, H) for column in zip(*ynu(*ray, powers, gaps), strict=True))
        for ray in (marginal, chief)
    )
    c, n, dispersion = _per_surface(vertex, H), _per_surface(signed_n, H), _per_surface(steps, H)
    departure = _per_surface([_departure(surface, v) for surface, v in zip(surfaces, vertex, strict=True)], H)
    before, behind = n[..., :-1], n[..., 1:]
    A, A_bar = (w[..., :-1] + before * h[..., :-1] * c for h, w in ((y, omega), (y_bar, omega_bar)))
    sums = third_order(
        (y[..., :-1], omega[..., :-1]),
        (y_bar[..., :-1], omega_bar[..., :-1]),
        c,
        (before, behind),
        departure,
        H[..., None],
    )
    colour = y[..., :-1] * (dispersion[..., 1:] / behind - dispersion[..., :-1] / before)
    wavelength = primary_wavelength(lens)
    return Seidel(
        lens=lens,
        fields=fields,
        contributions=convert(
            torch.stack([*sums, A * colour, A_bar * colour]), omega[..., -1:], n[..., -1:], 1e-3 * wavelength
        ),
        marginal_yni=y[..., :-1] * A,
        chief_yni=y_bar[..., :-1] * A_bar,
        marginal_height=y[..., :-1],
        chief_height=y_bar[..., :-1],
        invariant=H,
        wavelength=wavelength,
        names=names,
        kind=kind,
        unit=unit,
    )


def _chief_ray(lens: Lens, fields: Tensor, paraxial: FirstOrder) -> tuple[Tensor, Tensor]:
    """(ȳ, ω̄) (F,) in front of surface 1, of fields in the direction of +y."""
    upwards = torch.stack([torch.zeros_like(fields[0]), torch.hypot(*fields)])
    extent = paraxial_field(lens, upwards, paraxial)[1]
    pupil, n = paraxial.entrance_pupil_position, media(lens, primary_wavelength(lens))[0]
    height, slope = chief_ray(
        extent,
        at_infinity=is_at_infinity(lens),
        distance=lens.surfaces[0].thickness,
        entrance_pupil=pupil,
        parallel=lens.fields.telecentric or not bool(torch.isfinite(pupil)),
    )
    return height, n * slope


def _indices(lens: Lens) -> tuple[list[Tensor], list[Tensor]]:
    """Signed n of the primary wavelength before every surface and behind the last, and δn from shortest to longest."""
    primary, shortest, longest = (
        signed(lens.surfaces[1:-1], media(lens, wavelength)[:-1])
        for wavelength in (primary_wavelength(lens), lens.wavelengths.amin(), lens.wavelengths.amax())
    )
    return primary, [long - short for short, long in zip(shortest, longest, strict=True)]


def _per_surface(numbers: Sequence[Tensor], H: Tensor) -> Tensor:
    """Numbers of the surfaces as (F, K)."""
    return torch.stack(torch.broadcast_tensors(*numbers, H)[:-1], -1)


def third_order(marginal: Pair, chief: Pair, c: Number, n: Pair, departure: Number, H: Number) -> tuple[Number, ...]:
    """S1 … S5 in mm at every surface, of tensors or dual numbers.

    marginal, chief: (y, ω) before the surfaces; c: vertex curvature, 1/mm; n: signed indices before and behind;
    departure: G, 1/mm³; H: mm.
    """
    (y, omega), (y_bar, omega_bar), (before, behind) = marginal, chief, n
    A, A_bar, step = omega + before * c * y, omega_bar + before * c * y_bar, behind - before
    bending = y * ((omega - c * step * y) / (behind * behind) - omega / (before * before))
    inverse, asphere, y2, y_bar2 = 1 / behind - 1 / before, 8 * departure * step, y * y, y_bar * y_bar
    return (
        -A * A * bending + asphere * y2 * y2,
        -A * A_bar * bending + asphere * y2 * y * y_bar,
        -A_bar * A_bar * bending + asphere * y2 * y_bar2,
        -H * H * c * inverse,
        -(A_bar * A_bar * A_bar) * y * (1 / (behind * behind) - 1 / (before * before))
        + A_bar * y_bar * c * inverse * (H + A_bar * y)
        + asphere * y * y_bar2 * y_bar,
    )


def departure_from_sphere(curvature: Number, shape: Number, quartic: Number, vertex: Number) -> Number:
    """G in 1/mm³: the r⁴ term (1+k) c³/8 + a₂ of the sag less that of the sphere of the vertex curvature.

    shape: 1 + k; quartic: a₂, 1/mm³. Any number type.
    """
    return (shape * curvature * curvature * curvature - vertex * vertex * vertex) / 8 + quartic


def _departure(surface: Surface, vertex: Tensor) -> Tensor:
    terms = surface.coefficients
    return departure_from_sphere(
        0.0 if surface.curvature is None else surface.curvature,
        1.0 if surface.conic is None else 1 + surface.conic,
        0.0 if terms is None or len(terms) < 2 else terms[1],
        vertex,
    )


#: S1 … S5, C1, C2 over the coefficients W040, W131, W222, W220P, W311, W020, W111 of the wavefront.
OF_WAVEFRONT = 8, 2, 2, 4, 2, 2, 1


def _waves(S: Tensor, omega: Tensor, n: Tensor, wavelength: Tensor) -> Tensor:
    """W040, W131, W222, W220P, W311, W020, W111 of S1 … C2, wavelength in mm."""
    return S / S.new_tensor(OF_WAVEFRONT).reshape(-1, 1, 1) / wavelength


def _transverse(S: Tensor, omega: Tensor, n: Tensor, wavelength: Tensor) -> Tensor:
    """ε of the third order = (S1, S2, 3 S2, 2 S3, S4, S3 + S4, 3 S3 + S4, S5)/(2 n′u′), and -(C1, C2)/(n′u′).

    Spherical aberration, sagittal and tangential coma, astigmatism, Petzval, sagittal and tangential field curvature,
    distortion, axial and lateral colour (the shortest less the longest wavelength).
    """
    S1, S2, S3, S4, S5, C1, C2 = S
    mixed = torch.stack([S1, S2, 3 * S2, 2 * S3, S4, S3 + S4, 3 * S3 + S4, S5, -2 * C1, -2 * C2])
    return mixed / torch.where(omega == 0, torch.nan, 2 * omega)


def _longitudinal(S: Tensor, omega: Tensor, n: Tensor, wavelength: Tensor) -> Tensor:
    """-ε/u′ of spherical aberration, astigmatism, Petzval, sagittal and tangential field curvature, axial colour."""
    return -_transverse(S, omega, n, wavelength)[[0, 3, 4, 5, 6, 8]] * n / torch.where(omega == 0, torch.nan, omega)


#: Kinds of contributions: names, conversion of S1 … C2 by n′u′, n′ and the wavelength in mm, and unit.
KINDS: dict[str, tuple[tuple[str, ...], Callable, str]] = {
    "coefficients": (("S1", "S2", "S3", "S4", "S5", "C1", "C2"), lambda S, *_: S, "mm"),
    "waves": (("W040", "W131", "W222", "W220P", "W311", "W020", "W111"), _waves, "waves"),
    "transverse": (
        ("TSPH", "TSCO", "TTCO", "TAST", "TPFC", "TSFC", "TTFC", "TDIS", "TAXC", "TLAC"),
        _transverse,
        "mm",
    ),
    "longitudinal": (("LSPH", "LAST", "LPFC", "LSFC", "LTFC", "LAXC"), _longitudinal, "mm"),
}

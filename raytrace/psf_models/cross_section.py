"""Cross-sections of PSFs: profiles through the peak or the centroid along x and y, line spreads, and their widths."""

from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide, value
from raytrace.maths.result import Column, Result, Table, axis, number, rows
from raytrace.plotting.style import FIELD_COLOURS, GREY, INK, Figure, array, new_figure, styled
from raytrace.psf_models.figures import close_up_of, distance_text, row_labels, rows_of, worded
from raytrace.psf_models.result import Psf
from raytrace.system.lens import Lens

_LINE = 4  # panels of one distance in a line
_CURVES = ("profile", "line_spread")


@value
class CrossSection(Result):
    """Profiles and line spreads of kernels along x (axis 0 of the first of two) and y, N samples each.

    position: (2, D, F, N) or (2, D, F, W, N) mm from the peak or the centroid; profile: irradiance at these places on
    the lines through it, share of the light per mm²; line_spread: the same integrated across the line, per mm. nan
    where no light arrives, beyond the shorter side of a window, and everywhere if the centroid is outside the window.
    profile_fwhm, line_spread_fwhm: (2, D, F) or (2, D, F, W) mm, full widths between the outermost points at half of
    the maximum, linearly interpolated; nan where half of the maximum is not reached on both sides within the window.
    through: "peak" or "centroid"; pitch: (D, F) mm, width of a sample, which averages the light; psf: the kernels.
    """

    psf: Psf
    position: Tensor
    profile: Tensor
    line_spread: Tensor
    profile_fwhm: Tensor
    line_spread_fwhm: Tensor
    pitch: Tensor
    through: str

    COLUMNS = (
        Column("object_distance", "mm", "g", "object"), Column("wavelength", "µm", "g", "λ"),
        Column("axis", "", "<"), Column("position_um", "µm", ".4f"),
        Column("profile", "1/µm²"), Column("line_spread", "1/µm"),
        *(Column(f"{name}_fwhm_{a}_um", "µm", ".3f", f"{words}\nFWHM {a}") for name, words in
          (("profile", "profile"), ("line_spread", "line spread")) for a in "xy"),
    )  # fmt: skip

    @property
    def lens(self) -> Lens:
        return self.psf.lens

    def _heads(self, axes: int, first: int) -> dict[str, Tensor]:
        """Columns of object distance, field and wavelength: axes `first` and on of so many."""
        place = {name: column for name, column in self.psf.columns().items() if name in _HEADS}
        behind = axes - first - self.psf.energy.dim()
        return {name: t.reshape(*[1] * first, *t.shape, *[1] * behind) for name, t in place.items()}

    def columns(self) -> dict[str, Tensor]:
        """A row for every sample of both axes of every kernel."""
        axes = self.position.dim()
        return {
            **self._heads(axes, 1),
            "axis": axis(torch.arange(2), 0, axes),
            "position_um": 1e3 * self.position,
            "profile": 1e-6 * self.profile,
            "line_spread": 1e-3 * self.line_spread,
        }

    def words(self) -> dict[str, Any]:
        return {"axis": ("x", "y")}

    def summary(self) -> dict[str, Tensor]:
        """The widths, a row for every kernel."""
        widths = {"profile": self.profile_fwhm, "line_spread": self.line_spread_fwhm}
        return {
            **self._heads(self.psf.energy.dim(), 0),
            **{
                f"{name}_fwhm_{a}_um": 1e3 * t for name, both in widths.items() for a, t in zip("xy", both, strict=True)
            },
        }

    def document(self) -> dict:
        """Widths (`summary`) and samples for JSON."""
        results = rows(self.columns())
        for entry in results:
            entry["axis"] = "xy"[int(entry["axis"])]
        units = {name: unit for name in (*self.columns(), *self.summary()) if (unit := self.column(name).unit)}
        pitch = [number(p) for p in self.pitch.flatten()]
        about = {"model": self.psf.model, "through": self.through, "samples_mm": pitch, "units": units}
        return {**about, "summary": rows(self.summary()), "results": results}

    def tables(self) -> list[Table]:
        low, high = (1e3 * float(end) for end in (self.pitch.min(), self.pitch.max()))
        width = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        title = f"cross-sections of the {self.psf.model} PSF through the {self.through}; samples of {width} µm"
        notes = []
        if bool(torch.isnan(self.profile_fwhm).any()):
            notes.append("-: half of the maximum is not reached on both sides within the window")
        return [Table(self.summary(), [title], [*notes, "--json and -o have all samples"])]

    @styled
    def draw(self) -> Figure:
        """A panel for each kernel: profiles along x and y, and line spreads, relative to their maxima."""
        psfs, labels = self.psf, row_labels(self.psf)
        distances = psfs.object_distances.tolist()
        flows = len(distances) == 1 and len(labels) > 1
        shape = (-(-len(labels) // _LINE), min(len(labels), _LINE)) if flows else (len(labels), len(distances))
        figure = new_figure(
            2.3 * shape[1] + (2.5 if shape[1] > 1 else 4.1), (2.0 if max(shape) > 1 else 2.8) * shape[0] + 1.2
        )
        grid = figure.subplots(*shape, squeeze=False, sharey=True)
        position = [rows_of(1e3 * array(part), 1) for part in self.position]
        curves = {name: [rows_of(array(part), 1) for part in getattr(self, name)] for name in _CURVES}
        widths = {name: [rows_of(1e3 * array(p), 0) for p in getattr(self, f"{name}_fwhm")] for name in _CURVES}
        axes = grid.reshape(-1, 1)[: len(labels)] if flows else grid
        for (row, column), panel in np.ndenumerate(axes):
            for k, (name, dash) in enumerate(zip(_CURVES, ("solid", (0, (4, 2))), strict=True)):
                for a, colour in zip((0, 1), (FIELD_COLOURS[0], FIELD_COLOURS[2]), strict=True):
                    x, y = position[a][row][column], curves[name][a][row][column]
                    peak = np.nanmax(y, initial=0.0) or 1.0
                    label = f"{name.replace('_', ' ')} along {'xy'[a]}"
                    panel.plot(x, y / peak, color=colour, linestyle=dash, linewidth=1.2, label=label)
                numbers = (widths[name][a][row][column] for a in (0, 1))
                text = " × ".join("–" if np.isnan(n) else f"{n:.3g}" if n < 100 else f"{n:.0f}" for n in numbers)
                panel.text(
                    0.03, 0.97 - 0.1 * k, f"{('profile', 'line')[k]} {text}", transform=panel.transAxes, va="top",
                    fontsize=6.5, color=GREY,
                )  # fmt: skip
            panel.set_ylim(0, 1.32)
            panel.set_yticks([0, 0.5, 1])
            panel.axhline(0.5, color=GREY, linewidth=0.5, linestyle=":")
            head = labels[row].replace("\n", ", ")
            if flows:
                panel.set_title(head, color=INK)
            elif row == 0:
                panel.set_title(distance_text(distances[column]), color=INK)
            if column == 0 and not flows:
                panel.set_ylabel(head)
        for panel in grid.flat[len(labels) :] if flows else ():
            panel.axis("off")
        first = axes[0, 0]
        figure.legend(*first.get_legend_handles_labels(), loc="outside right center")
        name = ": ".join(filter(None, (self.lens.name, f"{psfs.model} PSF, cross-sections")))
        note = [
            f"abscissa: µm from the {self.through}; each curve relative to its maximum; numbers: FWHM along x × y, µm"
        ]
        if flows:
            text = distance_text(distances[0])
            note.append(text if text.startswith("object") else f"object at {text}")
        return worded(figure, name, note)


_HEADS = ("object_distance", "field_x", "field_y", "wavelength")


def cross_section(psfs: Psf, through: Literal["peak", "centroid"] = "peak") -> CrossSection:
    """Cross-sections of the kernels of a `Psf` through their peaks or centroids.

    Of pixels that were specified (pixel, size or grid of `psf`) and of independent rays the kernels themselves, with
    their derivatives by the lens; otherwise of the light finely sampled, as a figure of the kernels shows it, without
    derivatives. Through the centroid, a profile is interpolated linearly between two rows of samples. The peak is
    the centre of the brightest sample. Raises ValueError for another place.
    """
    if through not in ("peak", "centroid"):
        raise ValueError(f"through {through!r} is not known; expected peak or centroid")
    light, batch = psfs.kernel, psfs.energy.shape
    centre = psfs.grid.centre.reshape(2, *(psfs.grid.centre.shape[1:] or (1, 1)))
    pitch = psfs.grid.pitch
    if not psfs.framed and psfs.order is not None:
        close = close_up_of(psfs)
        light, centre = close.light, close.centre
        pitch = 2 * close.half / light.shape[-1]
    pitch = pitch.expand(batch[:2])
    wide = pitch.reshape(*batch[:2], *[1] * (len(batch) - 2))
    centre = centre.expand(2, *batch[:2]).reshape(2, *wide.shape)
    bright = light.detach().flatten(-2).argmax(-1)
    size = light.shape[-1], light.shape[-2]  # along x, along y
    peak = torch.stack([bright % size[0], bright // size[0]]).to(light.dtype)
    counts = light.new_tensor(size).reshape(2, *[1] * len(batch))
    place = peak if through == "peak" else (psfs.centroid - centre) / wide + 0.5 * (counts - 1)
    dark = (light.detach() <= 0).all(-1).all(-1)
    seen = (place.detach() >= 0) & (place.detach() <= counts - 1)  # nan, of no light, is not
    shown = ~dark & seen.all(0)
    most = max(size)
    parts: list[list[Tensor]] = [[], [], []]
    for a in (0, 1):
        across = light if a == 0 else light.mT  # rows lie across the axis
        at_across = torch.where(shown, place[1 - a], 0.0)
        low = at_across.detach().floor().clamp_max(max(size[1 - a] - 2, 0)).to(torch.int64)
        near, next_ = (
            torch.gather(across, -2, k[..., None, None].expand(*k.shape, 1, size[a]))[..., 0, :]
            for k in (low, (low + 1).clamp_max(size[1 - a] - 1))
        )
        share = (at_across - low)[..., None]
        profile = ((1 - share) * near + share * next_) / wide[..., None] ** 2
        spread = across.sum(-2) / wide[..., None]
        offset = (torch.arange(size[a], dtype=light.dtype, device=light.device) - place[a][..., None]) * wide[..., None]
        for part, curve in zip(parts, (offset, profile, spread), strict=True):
            curve = torch.where(shown[..., None], curve, torch.nan)
            part.append(torch.nn.functional.pad(curve, (0, most - size[a]), value=torch.nan))
    position, profile, spread = (torch.stack(part) for part in parts)
    profile_fwhm, spread_fwhm = (fwhm(position, curve) for curve in (profile, spread))
    return CrossSection(psfs, position, profile, spread, profile_fwhm, spread_fwhm, pitch, through)


def fwhm(position: Tensor, curve: Tensor) -> Tensor:
    """Full width (…) between the outermost points of curves (…, N) at half of their maximum, linearly interpolated.

    nan at the end of a curve is left out. nan where half of the maximum is not reached on both sides.
    """
    curve = torch.where(curve.isnan(), -torch.inf, curve)
    half = 0.5 * curve.amax(-1, keepdim=True)
    above = (curve >= half) & curve.isfinite()
    number = torch.arange(curve.shape[-1], device=curve.device)
    first = torch.where(above, number, curve.shape[-1]).amin(-1)
    last = torch.where(above, number, -1).amax(-1)
    count = curve.isfinite().sum(-1)
    reached = (first > 0) & (last < count - 1) & (last >= 0)

    def crossing(inside: Tensor, outside: Tensor) -> Tensor:
        inside, outside = (torch.where(reached, k, 0)[..., None] for k in (inside, outside))
        (x1, y1), (x0, y0) = ([torch.gather(t, -1, k) for t in (position, curve)] for k in (inside, outside))
        return (x1 + (x0 - x1) * safe_divide(y1 - half, y1 - y0))[..., 0]

    return torch.where(reached, crossing(last, last + 1) - crossing(first, first - 1), torch.nan)

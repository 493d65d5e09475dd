"""Grid distortion: where a square grid of object points lands on the sensor."""

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.panels import finished, wavelength_label
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import (
    Numbers,
    field_range,
    in_object_space,
    primary_wavelength,
    refuse_axis,
    unvignetted,
)
from raytrace.budget import RAY_BYTES, afford
from raytrace.maths.numerics import safe_divide, safe_sqrt, value
from raytrace.maths.result import Column, Table, axis, masked
from raytrace.plotting.style import GREY, Axes, Figure, array, field_colour, new_figure, number_text, styled
from raytrace.system.lens import Lens, with_wavelengths
from raytrace.tracing.launch import is_at_infinity, warn_of_filling
from raytrace.tracing.spot import chief_points

_NEAR_AXIS = 1e-4  # of the largest field: its rays give the scale of the image; they leave 1e-8 of the distortion


@value
class GridDistortion(Analysis):
    """Chief rays (2, W, N, N) mm on the sensor, of a grid of object points along y (rows) and x (columns).

    actual: where they land; ideal: where they would without distortion, by the linear map of rays close to the axis.
    distortion: (W, N, N) relative, |actual|/|ideal| - 1 from the image of the axis; 0 there; in the
        table in per cent. valid: (W, N, N) bool.
    fields: (2, N, N) tan θ of an object at infinity, else mm of it.
    """

    lens: Lens
    fields: Tensor
    actual: Tensor
    ideal: Tensor
    distortion: Tensor
    valid: Tensor

    COMMAND = "distortion-grid"
    COLUMNS = property(
        lambda self: [
            *(Column(name, "mm") for name in ("ideal_x", "ideal_y", "actual_x", "actual_y")),
            *(Column(name, "" if is_at_infinity(self.lens) else "mm") for name in ("field_x", "field_y")),
        ]
    )

    def columns(self) -> dict[str, Tensor]:
        (x, y), (ideal_x, ideal_y) = (masked(point, self.valid) for point in (self.actual, self.ideal))
        return {
            "wavelength": axis(self.wavelengths, 0, 3),
            "field_x": self.fields[0],
            "field_y": self.fields[1],
            "ideal_x": ideal_x,
            "ideal_y": ideal_y,
            "actual_x": x,
            "actual_y": y,
            "distortion_percent": self._percent(),
        }

    def summary(self) -> dict[str, Tensor]:
        return {"wavelength": self.wavelengths, "largest_percent": 100 * self.largest()}

    def largest(self) -> Tensor:
        """The distortion (W,) of largest size, with its sign; 0 where no ray arrives."""
        shown = torch.where(self.valid, self.distortion, 0.0).flatten(1)
        return shown.gather(1, shown.abs().argmax(1, keepdim=True))[:, 0]

    def tables(self) -> list[Table]:
        """A map in per cent for each wavelength: y of the grid in rows, the top row first, x in columns."""
        unit = self.column("field_x").unit or "tan θ"
        x, y = self.fields[0, 0].tolist(), self.fields[1, :, 0].tolist()
        tables = []
        for wavelength, largest, grid in zip(self.wavelengths, self.largest(), self._percent(), strict=True):
            columns = {Column(f"x = {number:.4g}", form=".4f"): grid[:, k].flip(0) for k, number in enumerate(x)}
            title = f"distortion in % at {wavelength:g} µm over the grid ({unit}), largest {100 * largest:.6f} %"
            tables.append(Table({Column("y"): [f"{number:.4g}" for number in y[::-1]], **columns}, [title]))
        return tables

    def _percent(self) -> Tensor:
        return masked(100 * self.distortion, self.valid)

    @styled
    def draw(self, *, exaggerate: float = 1.0) -> Figure:
        """The ideal grid in grey, the real one over it, its distortion exaggerated; of the first wavelength."""
        figure = new_figure(4.6, 5.0)
        panel = figure.add_subplot(aspect="equal")
        draw_grid(panel, self, field_colour(0), exaggerate)
        panel.set(xlabel="x on the sensor (mm)", ylabel="y on the sensor (mm)")
        largest = number_text(100 * float(self.largest()[0]), 3)
        return finished(panel, self, f"grid distortion, largest {largest} % ({wavelength_label(self, 0)})", 2)


def draw_grid(panel: Axes, grid: GridDistortion, colour: str, exaggerate: float = 1.0) -> None:
    """The ideal grid in grey and the real one over it, of the first wavelength; its distortion exaggerated."""
    ideal, actual = (array(points[:, 0]) for points in (grid.ideal, grid.actual))
    actual = np.where(array(grid.valid[0]).astype(bool), ideal + exaggerate * (actual - ideal), np.nan)
    rays = "chief rays" + (f", distortion × {exaggerate:g}" if exaggerate != 1 else "")
    for points, label, ink, width in ((ideal, "ideal", GREY, 0.8), (actual, rays, colour, 1.2)):
        panel.plot(*points, color=ink, linewidth=width)
        panel.plot(*points.transpose(0, 2, 1), color=ink, linewidth=width)
        panel.plot([], [], color=ink, linewidth=width, label=label)


def distortion_grid(lens: Lens, *, wavelengths: Numbers = None, points: int = 11) -> GridDistortion:
    """Distortion over `points` × `points` objects, at whose corners the largest field lies, square in tan θ or in mm.

    With the points (0, 0), (δ, 0) and (0, δ) close to the axis the ideal image of a field f is J f, J their differences
    over δ, counted from the image of the axis: on the sensor at its position, in focus or not. wavelengths: µm, the
    lens's primary one by default. points: across the grid. Vignetting factors are left out: chief rays go through the
    middle of the pupil. Raises NothingToShow for the axis alone.
    """
    lens = with_wavelengths(unvignetted(lens), primary_wavelength(lens) if wavelengths is None else wavelengths)
    largest = field_range(lens, 2)[:, 1:]
    refuse_axis(largest)
    warn_of_filling(lens, largest)
    rays = points**2 * len(lens.wavelengths)
    afford(RAY_BYTES * rays, f"{rays:,} chief rays of {points:,} × {points:,} objects", helps="ask for fewer {points}")
    described, _, corner, exists = in_object_space(lens, largest)
    half = safe_sqrt((corner * corner).sum() / 2)
    line = half * (2 * torch.arange(points, dtype=half.dtype, device=half.device) + 1 - points) / max(points - 1, 1)
    y, x = torch.meshgrid(line, line, indexing="ij")
    step = _NEAR_AXIS * half
    zero = torch.zeros_like(step)
    close = torch.stack([torch.stack([zero, step, zero]), torch.stack([zero, zero, step])])
    wanted = torch.cat([close, torch.stack([x, y]).flatten(1)], 1)
    angles = torch.rad2deg(torch.atan(wanted)) if is_at_infinity(lens) else wanted
    landed, valid = chief_points(described, angles, lens.wavelengths)
    landed = (landed - landed[:, :1]).movedim(1, -1)  # (2, W, 3 + N²)
    along_x, along_y = landed[..., 1:2] / step, landed[..., 2:3] / step
    ideal = along_x * wanted[0, 3:] + along_y * wanted[1, 3:]
    length, reached = (safe_sqrt((p * p).sum(0)) for p in (ideal, landed[..., 3:]))
    grid = (points, points)
    return GridDistortion(
        lens=lens,
        fields=torch.stack([x, y]),
        actual=landed[..., 3:].unflatten(-1, grid),
        ideal=ideal.unflatten(-1, grid),
        distortion=safe_divide(reached - length, length).unflatten(-1, grid),
        valid=(valid & exists).movedim(0, -1)[:, 3:].unflatten(-1, grid),
    )

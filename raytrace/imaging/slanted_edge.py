"""MTF of a picture of a slanted edge, as of a measured camera (ISO 12233, e-SFR).

Every line across the edge samples its profile at another phase, so that all lines together sample it four times a
pixel: the edge spread function. Its derivative is the line spread function, whose spectrum is the MTF of all between
scene and picture: lens, pixels and any processing.
"""

import dataclasses
import math

import numpy as np
import torch
from torch import Tensor

from raytrace.imaging.image import as_picture, linearised
from raytrace.maths.numerics import as_tensor
from raytrace.maths.result import Column, Result, Table
from raytrace.plotting.style import GREY, Figure, array, field_colour, new_figure, styled

_OVERSAMPLING = 4  # bins a pixel
_LEAST_SIDE, _LEAST_MARGIN = 16, 6  # pixels of a picture, and from its edge to the border
_LEAST_STEP = 4.0  # standard deviations of the light on either side
_STRAIGHT = 2.0  # pixels: RMS distance of the lines' centroids from the fitted edge
_PASSES = 4


@dataclasses.dataclass(frozen=True, repr=False)
class SlantedEdgeMtf(Result):
    """frequencies: (K,) cycles/mm up to one a pixel, perpendicular to the edge; mtf: (K,), 1 at 0.

    angle: degrees from the edge to the columns, or where `across` is "y" to the rows, of the picture; across: "x" or
    "y", the direction whose frequencies are measured. distances: (N,) mm from the edge; edge_spread: (N,) levels there.
    """

    frequencies: Tensor
    mtf: Tensor
    angle: float
    across: str
    distances: Tensor
    edge_spread: Tensor
    pitch: float

    COLUMNS = (Column("mtf", "", ".4f"),)

    @property
    def mtf50(self) -> float:
        """The lowest frequency at which the MTF is 0.5, cycles/mm; nan if there is none."""
        below = torch.nonzero(self.mtf.detach() < 0.5)[:, 0]
        if not len(below):
            return math.nan
        k = int(below[0])
        (f, g), (high, low) = self.frequencies[k - 1 : k + 1].tolist(), self.mtf[k - 1 : k + 1].tolist()
        return f + (g - f) * (high - 0.5) / (high - low)

    def at(self, frequencies: Tensor) -> Tensor:
        """MTF (...) at frequencies (...) cycles/mm, linear between those measured."""
        step = self.frequencies[1]
        place = (as_tensor(frequencies).to(self.mtf) / step).clamp(0, len(self.mtf) - 1)
        left = place.floor().clamp_max(len(self.mtf) - 2).long()
        return self.mtf[left] + (place - left) * (self.mtf[left + 1] - self.mtf[left])

    def columns(self) -> dict[str, Tensor]:
        return {"frequency": self.frequencies, "mtf": self.mtf}

    def document(self) -> dict:
        head = {"angle": self.angle, "across": self.across, "mtf50": None if math.isnan(self.mtf50) else self.mtf50}
        return {**head, **super().document()}

    def tables(self) -> list[Table]:
        lines = "columns" if self.across == "x" else "rows"
        half = "the MTF stays above 0.5" if math.isnan(self.mtf50) else f"MTF50 {self.mtf50:.4g} cycles/mm"
        return [Table(self.columns(), [f"edge {self.angle:.2f}° from the {lines}, {half}"])]

    @styled
    def draw(self) -> Figure:
        """The edge spread function over the distance from the edge, and the MTF up to one cycle a pixel."""
        figure = new_figure(8.0, 3.2)
        left, right = figure.subplots(1, 2)
        left.plot(1e3 * array(self.distances), array(self.edge_spread), color=field_colour(0), linewidth=1.3)
        left.set(xlabel="distance from the edge (µm)", ylabel="level")
        right.plot(array(self.frequencies), array(self.mtf), color=field_colour(0), linewidth=1.5)
        right.axvline(0.5 / self.pitch, color=GREY, linewidth=0.8, linestyle=":", label="Nyquist frequency")
        right.set(xlabel="spatial frequency (cycles/mm)", ylabel="modulation", xlim=(0, 1 / self.pitch), ylim=(0, None))
        right.legend()
        return figure


def slanted_edge_mtf(picture: Tensor | np.ndarray, pitch: float) -> SlantedEdgeMtf:
    """The MTF of a picture of one straight edge that is a few degrees from the columns or the rows (ISO 12233).

        MTF(ν) = |Σ_k w_k (E_k+1 - E_k) exp(-2πi ν k p/4)| / (|Σ_k w_k (E_k+1 - E_k)| sinc²(ν p/4))

    picture: (H, W), one channel, with all of it in the mean direction of the edge; linear in light, integers of 8 or 16
    bits are encoded as sRGB (levels of a raw file: divide by the largest). pitch: p, mm. E_k: the mean level of pixels
    in bins of p/4 perpendicular to the edge; the line of the edge is fitted through the centroids of the lines' own
    derivatives; sinc²: of the bins and of the differences; w: a window, flat over the middle half (Tukey), in place of
    the standard's, which would lower the MTF of blur with wide tails. Differentiable in the picture.
    Raises ValueError for pictures without an edge, too small ones, clipped levels of integers, and edges that are
    parallel to the pixels.
    """
    levels = as_tensor(picture)
    if levels.dim() != 2 or min(levels.shape) < _LEAST_SIDE:
        raise ValueError(
            f"a picture of shape {tuple(levels.shape)}: expected (H, W) of one channel, {_LEAST_SIDE} pixels or more a "
            "side"
        )
    if not (isinstance(pitch, int | float) and 0 < pitch < math.inf):
        raise ValueError(f"pitch {pitch!r}: expected the distance of pixels in mm, above 0")
    _refuse_clipped(levels)
    light = linearised(as_picture(levels) if levels.is_floating_point() else levels).to(torch.float64)
    if not bool(torch.isfinite(light.detach()).all()):
        raise ValueError("a picture with levels that are nan or infinite: expected light in every pixel")
    steps = [_step(light.detach()), _step(light.detach().T)]
    light, across = (light, "x") if abs(steps[0]) >= abs(steps[1]) else (light.T, "y")
    slope, start = _line(light.detach())
    distances, spread = _edge_spread(light, slope, start)
    half = len(spread) // (2 * _OVERSAMPLING)  # pixels on either side
    line = spread.diff() * _tukey(len(spread) - 1).to(spread)
    spectrum = torch.fft.rfft(line, n=len(spread)).abs()[: 2 * half + 1]
    cycles = torch.arange(2 * half + 1, dtype=spread.dtype, device=spread.device) / (2 * half)  # a pixel
    mtf = spectrum / (spectrum[0] * torch.sinc(cycles / _OVERSAMPLING) ** 2)
    return SlantedEdgeMtf(
        cycles / pitch, mtf, math.degrees(math.atan(slope)), across, distances * pitch, spread, float(pitch)
    )


def _refuse_clipped(levels: Tensor) -> None:
    if levels.is_floating_point():
        return
    largest = torch.iinfo(levels.dtype).max
    clipped = float(((levels == largest) | (levels == 0)).double().mean())
    if clipped > 0.001:
        raise ValueError(
            f"{100 * clipped:.1f} % of the pixels are at level 0 or {largest}, clipped: expose the edge between them"
        )


def _step(light: Tensor) -> float:
    """Difference of the light at the right and at the left border."""
    width = max(2, light.shape[1] // 8)
    return float(light[:, -width:].mean() - light[:, :width].mean())


def _line(light: Tensor) -> tuple[float, float]:
    """Slope and start of the edge, column = start + slope · row. Raises ValueError where there is none."""
    rows, columns = light.shape
    width = max(2, columns // 8)
    noise = max(float(light[:, side].std(0).mean()) for side in (slice(None, width), slice(-width, None)))
    step = _step(light)
    # Rounding noise of a constant picture is no step.
    if not abs(step) > max(_LEAST_STEP * noise / math.sqrt(rows), 1e-6 * float(light.abs().max())):
        raise ValueError(
            f"no edge: the light on both sides differs by {abs(step):.2g}, with a noise of {noise:.2g}; expected one "
            "straight edge through the whole picture, from side to side or from top to bottom"
        )
    derivative = light.diff(dim=1) * math.copysign(1.0, step)
    place = torch.arange(columns - 1, dtype=light.dtype, device=light.device) + 0.5
    row = torch.arange(rows, dtype=light.dtype, device=light.device)
    middle = torch.full_like(row, float((derivative.sum(0) * place).sum() / derivative.sum()))
    for turn in range(_PASSES):
        reach = max(columns / 2 ** (turn + 1), 8.0)
        inside = ((place - middle[:, None]).abs() / reach).clamp_max(1.0)
        weighted = derivative * (0.5 + 0.5 * torch.cos(math.pi * inside))
        total = weighted.sum(1)
        known = total > 0.2 * abs(step)
        if int(known.sum()) < 0.8 * rows:
            raise _no_straight_edge()
        centroid = ((weighted * place).sum(1) / torch.where(known, total, 1.0))[known]
        basis = torch.stack([torch.ones_like(row), row], 1)
        start, slope = torch.linalg.lstsq(basis[known], centroid[:, None]).solution[:, 0]
        middle = start + slope * row
    if float((centroid - middle[known]).square().mean().sqrt()) > _STRAIGHT:
        raise _no_straight_edge()
    return float(slope), float(start)


def _no_straight_edge() -> ValueError:
    return ValueError("no straight edge: expected one edge through the whole picture, crossed once by every line")


def _edge_spread(light: Tensor, slope: float, start: float) -> tuple[Tensor, Tensor]:
    """Distances from the edge, pixels, and mean levels of bins of a quarter of a pixel."""
    rows, columns = light.shape
    if abs(slope) * rows < 1:
        raise ValueError(
            f"an edge that moves by {abs(slope) * rows:.2f} columns over {rows} rows: expected 1 or more; turn it by "
            "about 5°, or take a larger part of it"
        )
    rows = int(int(rows * abs(slope)) / abs(slope))  # whole cycles of the phase
    row = torch.arange(rows, dtype=light.dtype, device=light.device)
    edge = start + slope * row
    margin = min(float(edge.min()), columns - 1 - float(edge.max()))
    half = int(margin)
    if half < _LEAST_MARGIN:
        raise ValueError(
            f"the edge is {max(margin, 0.0):.1f} pixels from the border of the picture: expected {_LEAST_MARGIN} or "
            "more"
        )
    column = torch.arange(columns, dtype=light.dtype, device=light.device)
    distance = (column - edge[:, None]) * math.cos(math.atan(slope))
    half = int(half * math.cos(math.atan(slope)))
    number = (distance * _OVERSAMPLING).floor().long() + half * _OVERSAMPLING
    inside = (number >= 0) & (number < 2 * half * _OVERSAMPLING)
    number, values = number[inside], light[:rows][inside]
    count = torch.zeros(2 * half * _OVERSAMPLING, dtype=light.dtype, device=light.device)
    count = count.index_add(0, number, torch.ones_like(values.detach()))
    if bool((count == 0).any()):
        raise ValueError(
            f"an edge of slope {slope:.3f}, at which the pixels leave {int((count == 0).sum())} of {len(count)} bins "
            "empty: expected an angle of a few degrees, such as 5°, or a larger picture"
        )
    spread = torch.zeros_like(count).index_add(0, number, values) / count
    places = (torch.arange(len(count), dtype=light.dtype, device=light.device) + 0.5) / _OVERSAMPLING - half
    # Pixels of a bin are not centred in it: the profile is linear between the bins' mean distances.
    mean = torch.zeros_like(count).index_add(0, number, distance[inside]) / count
    (slopes,) = torch.gradient(spread, spacing=(mean,))
    return places, spread + (places - mean) * slopes


def _tukey(count: int) -> Tensor:
    """A window (count,), 1 over its middle half, with cosine flanks to 0."""
    place = (torch.arange(count, dtype=torch.float64) + 0.5) / count
    flank = (4 * torch.minimum(place, 1 - place)).clamp_max(1.0)
    return 0.5 - 0.5 * torch.cos(math.pi * flank)

"""Wavefront maps: the OPD over the whole pupil, its Zernike coefficients and the Strehl ratio."""

import dataclasses
import itertools
import math
import warnings
from collections.abc import Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.panels import field_labels, finished, seen, wavelength_label
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import Incomplete, Numbers, Points, field_words, like, scene_of, setting
from raytrace.budget import RAY_BYTES, afford, piece
from raytrace.maths import zernike
from raytrace.maths.numerics import placed, value
from raytrace.maths.result import Column, Table
from raytrace.maths.sampling import gauss_rings
from raytrace.plotting.style import GREY, INK, Axes, Figure, new_figure, number_text, styled
from raytrace.psf_models.strehl import strehl
from raytrace.system.lens import Lens
from raytrace.tracing.scene import Scene, symmetry
from raytrace.tracing.wavefront import clear_wavefront, peak_to_valley, rms, wavefront_of, zernike_coefficients
from raytrace.words import calling_level

if TYPE_CHECKING:  # slow to load
    from matplotlib.colors import ListedColormap, Normalize
    from matplotlib.image import AxesImage

_RINGS = 14, 56
_GRID = 127
_MAP_BYTES = 24  # of a point of a map, while it is made
_BY_FIELD = ("opd", "valid", "coefficients", "rms", "peak_to_valley", "strehl")
_UNITS = {"rms": "waves RMS", "rim": "waves at the rim"}


@value
class WavefrontMap(Analysis):
    """The wavefront of every field and wavelength, of a batch of every lens, field and wavelength (L, F, W).

    opd: (F, W, N, N) waves at pupil points y (rows) and x (columns) of `pupil` (N,), 0 where `valid` is False.
    coefficients: (F, W, J) Zernike coefficients 1 … J over the entrance pupil, numbered as `numbering` says: "noll", in
        waves RMS, or "fringe", in waves at the rim.
    rms: (F, W) waves about the mean, over the clear pupil up to its edges; peak_to_valley: (F, W) waves, over a square
        grid of 127 points across the pupil, centre and ends of its axes among them.
    strehl: (F, W) the largest intensity on the sensor over that without aberrations, defocus counted among them; nan
        where the blur is too large for the sum of waves.
    fields: (2, F); listed: whether the text lists the coefficients.
    """

    lens: Lens
    fields: Tensor
    pupil: Tensor
    opd: Tensor
    valid: Tensor
    coefficients: Tensor
    rms: Tensor
    peak_to_valley: Tensor
    strehl: Tensor
    numbering: str
    listed: bool = False

    COMMAND = "wavefront"
    COLUMNS = Column("rms", "waves"), Column("peak_to_valley", "waves"), Column("coefficient", "waves")

    def columns(self) -> dict[str, Tensor]:
        term = torch.arange(1, self.coefficients.shape[-1] + 1, device=self.opd.device)
        heads = self.heads(wavelength=self.wavelengths, **{self.numbering: term})
        return {**heads, "coefficient": self.coefficients}

    def summary(self) -> dict[str, Tensor]:
        measures = {name: getattr(self, name) for name in ("rms", "peak_to_valley", "strehl")}
        return {**self.heads(wavelength=self.wavelengths), **measures}

    def tables(self) -> list[Table]:
        """The summary, and if `listed` the coefficients of each field: a row for each term, a column a wavelength."""
        tables = [Table(self.summary())]
        order, unity = zernike.NUMBERINGS[self.numbering]
        for field, values in zip(self.fields.T, self.coefficients, strict=True) if self.listed else ():
            terms = range(1, values.shape[-1] + 1)
            n, m = zip(*map(order, terms), strict=True)
            columns: dict[Any, Tensor | Sequence] = {
                Column("j"): terms,
                Column("n"): n,
                Column("m"): m,
                Column("term", form="<"): [zernike.WORDS.get(nm, "") for nm in zip(n, m, strict=True)],
                **self.by_wavelength(values.T, form=".8f"),
            }
            name = f"{self.numbering.capitalize()} coefficients of field {field_words(self.lens, field)}"
            tables.append(Table(columns, ["", f"{name}, {_UNITS[unity]}"]))
        return tables

    @styled
    def draw(self) -> Figure:
        """A panel for each field (rows) and wavelength (columns), one scale for all; RMS, P-V, Strehl below.

        Maps of a single wavelength follow each other in lines of four. 0 is white; the scale ends with the maps.
        """
        labels, count = field_labels(self), len(self.wavelengths)
        flows = count == 1
        shape = (-(-len(labels) // 4), min(len(labels), 4)) if flows else (len(labels), count)
        side = 2.9 if shape == (1, 1) else 1.9
        figure = new_figure(side * shape[1] + 1.3, (side + 0.6) * shape[0] + (0.75 if shape[0] > 1 else 0.95))
        grid = figure.subplots(*shape, squeeze=False)
        axes = grid.reshape(-1, 1) if flows else grid
        opd = seen(self.opd, self.valid)
        colours, scale = diverging(opd)
        for row, w in itertools.product(range(len(labels)), range(count)):
            panel = axes[row, w]
            drawn = draw_map(panel, opd[row, w], colours, scale)
            rms, valley, strehl = (
                number_text(float(v[row, w]), 3) for v in (self.rms, self.peak_to_valley, self.strehl)
            )
            panel.set_xlabel(f"RMS {rms}, P–V {valley}\nStrehl {strehl}", fontsize=7.5, color=GREY)
            if flows:
                panel.set_title(labels[row], color=INK)
            elif row == 0:
                panel.set_title(wavelength_label(self, w), color=INK)
            if w == 0 and not flows:
                panel.set_ylabel(labels[row])
        for panel in axes.ravel()[len(labels) * count :]:
            panel.axis("off")
        bar = figure.colorbar(drawn, ax=grid, shrink=0.8, aspect=30, pad=0.02)
        bar.set_label("OPD (waves)")
        bar.outline.set_visible(False)
        return finished(grid[0, 0], self, f"wavefront, {wavelength_label(self, 0)}" if flows else "wavefront")


def draw_map(panel: Axes, opd: np.ndarray, colours: "ListedColormap", scale: "Normalize") -> "AxesImage":
    """A map (N, N) of waves over the pupil, without the single points that lie on the rim of the pupil itself."""
    half = len(opd) / (len(opd) - 1)  # points at the ends of the axes are middles of pixels
    line = np.linspace(-1, 1, len(opd))
    inside = np.hypot(line, line[:, None]) < 1 - 1e-9
    opd = np.where(inside, opd, np.nan)
    panel.set(xticks=[], yticks=[])
    panel.spines[:].set_visible(False)
    return panel.imshow(opd, origin="lower", cmap=colours, norm=scale, extent=(-half, half, -half, half))


def wavefront(
    lens: Lens,
    *,
    fields: Points = None,
    wavelengths: Numbers = None,
    size: int = _GRID,
    terms: int | None = None,
    numbering: Literal["noll", "fringe"] | None = None,
) -> WavefrontMap:
    """OPD over `size` × `size` pupil points, and the coefficients 1 … `terms` of 784 rays, see `zernike_coefficients`.

    fields: y or (x, y); wavelengths: µm; size: pixels across a map; terms: number of Zernike terms, 37 by default;
    numbering: "noll" (default) or "fringe"; the text lists the coefficients where one of them is given. Undefined
    numbers are nan: all of them where no ray arrives, the coefficients, with a warning, where the light fills too
    little of the pupil. Raises budget.OverBudget for more points than memory holds.
    """
    lens, fields = setting(lens, fields, wavelengths, every=True)
    F, W = fields.shape[1], len(lens.wavelengths)
    afford(
        _MAP_BYTES * F * W * size * size,
        f"the wavefronts of {F} fields × {W} wavelengths at {size} × {size} points",
        helps="ask for a smaller {size}, or fewer fields or wavelengths",
    )
    zernike.refuse_few(math.prod(_RINGS), terms or 37)  # before they are computed
    listed = bool(terms or numbering)
    rule = partial(_map_of, size=size, terms=terms or 37, numbering=numbering or "noll", listed=listed)
    parts = [rule(lens, some) for some in fields.split(piece(RAY_BYTES * W * max(size, _GRID) ** 2), 1)]
    over = 0 if lens.count is None else 1
    joined: dict[str, Any] = {name: torch.cat([getattr(part, name) for part in parts], over) for name in _BY_FIELD}
    maps = dataclasses.replace(parts[0], fields=fields, **joined)
    unknown = maps.coefficients.detach()[..., 0].isnan() & maps.rms.detach().isfinite()
    for f in torch.nonzero(unknown.any(-1).reshape(-1, F).any(0))[:, 0].tolist():
        field = f"field {field_words(lens, fields[:, f])}"
        words = f"{field}: the light fills too little of the entrance pupil for Zernike coefficients"
        warnings.warn(words, Incomplete, stacklevel=calling_level())
    return maps


def _map_of(lens: Lens, fields: Tensor, *, size: int, terms: int, numbering: str, listed: bool) -> WavefrontMap:
    view = scene_of(lens, fields)
    folded = symmetry(view) != "none"  # the half x ≥ 0 of the pupil has the other's OPD
    line, inside, points = _grid(size, folded, **like(lens))
    drawn = wavefront_of(view, points)
    dense = drawn if size == _GRID else wavefront_of(view, _grid(_GRID, folded, **like(lens))[2])
    clear = clear_wavefront(view, *_RINGS)
    front = clear if clear.pupil.dim() == 2 else wavefront_of(view, *gauss_rings(*_RINGS, **like(lens)))
    wave = 1e-3 * lens.wavelengths

    def by_lens(numbers: Tensor) -> Tensor:
        return numbers[0] if lens.count is None else numbers

    opd, valid = placed(by_lens(drawn.opd) / wave[:, None], inside), placed(by_lens(drawn.valid), inside)
    if folded:
        opd, valid = (torch.cat([half.flip(-1)[..., : size // 2], half], -1) for half in (opd, valid))
    return WavefrontMap(
        lens=lens,
        fields=fields,
        pupil=line,
        opd=opd,
        valid=valid,
        coefficients=by_lens(zernike_coefficients(front, terms, numbering)) / wave[:, None],
        rms=by_lens(rms(clear)) / wave,
        peak_to_valley=by_lens(peak_to_valley(dense)) / wave,
        strehl=by_lens(_strehl(view)),
        numbering=numbering,
        listed=listed,
    )


def _grid(size: int, folded: bool, **like: Any) -> tuple[Tensor, Tensor, Tensor]:
    """A line of `size` points from -1 to 1, which of their pairs (y, x) lie in the pupil, and those (2, P).

    folded: of x the half from the middle on.
    """
    line = torch.linspace(-1.0, 1.0, size, **like)
    y, x = torch.meshgrid(line, line[size // 2 if folded else 0 :], indexing="ij")
    inside = x * x + y * y <= 1
    return line, inside, torch.stack([x[inside], y[inside]])


def _strehl(view: Scene) -> Tensor:
    """Strehl ratios (D, F, W); nan for a field whose blur would need too many rays."""
    ratios = []
    for field in view.fields.split(1, 1):
        try:
            ratios.append(strehl(Scene(view.lens, field, view.wavelengths)))
        except ValueError:  # a map of so many waves is still shown
            ratios.append(view.wavelengths.new_full((view.shape[0], 1, view.shape[2]), torch.nan))
    return torch.cat(ratios, 1)


def diverging(values: np.ndarray) -> tuple["ListedColormap", "Normalize"]:
    """Blue below 0, white at 0, red above, equally deep on either side; from the least to the largest of the values."""
    import matplotlib
    from matplotlib.colors import ListedColormap, Normalize

    low, high = min(float(np.nanmin(values, initial=0.0)), 0.0), max(float(np.nanmax(values, initial=0.0)), 0.0)
    largest = max(-low, high, 1e-4)
    low, high = (low, high) if high - low > 1e-4 else (-largest, largest)
    shades = matplotlib.colormaps["RdBu_r"](0.5 + 0.5 * np.linspace(low, high, 256) / largest)
    return ListedColormap(shades), Normalize(low, high)

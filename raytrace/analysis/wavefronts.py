"""Wavefront maps: the OPD over the whole pupil, its Zernike coefficients and the Strehl ratio."""

import dataclasses

import torch
from torch import Tensor

from raytrace.analysis.setting import scene_of
from raytrace.budget import RAY_BYTES, afford, piece
from raytrace.kernels.diffraction import strehl
from raytrace.maths.pupil import gauss_rings
from raytrace.maths.result import Result, axis
from raytrace.maths.value import value
from raytrace.optics.scene import Scene
from raytrace.optics.wavefront import peak_to_valley, rms, wavefront_of, zernike_coefficients
from raytrace.system.lens import Lens

_RINGS = 14, 56
_GRID = 127
_MAP_BYTES = 24  # of a point of a map, while it is made
_BY_FIELD = ("opd", "valid", "coefficients", "rms", "peak_to_valley", "strehl")


@value
class WavefrontMap(Result):
    """The wavefront of every field and wavelength.

    opd: (F, W, N, N) waves at pupil points y (rows) and x (columns) of `pupil` (N,), 0 where `valid` is False.
    coefficients: (F, W, J) Zernike coefficients 1 … J over the entrance pupil, numbered as `numbering` says: "noll", in
        waves RMS, or "fringe", in waves at the rim.
    rms: (F, W) waves about the mean; peak_to_valley: (F, W) waves, over a square grid of 127 points across the pupil,
        centre and ends of its axes among them.
    strehl: (F, W) the largest intensity on the sensor over that without aberrations, defocus counted among them; nan
        where the blur is too large for the sum of waves.
    fields: (2, F); wavelengths: (W,) µm.
    """

    opd: Tensor
    valid: Tensor
    pupil: Tensor
    coefficients: Tensor
    rms: Tensor
    peak_to_valley: Tensor
    strehl: Tensor
    fields: Tensor
    wavelengths: Tensor
    numbering: str

    def columns(self) -> dict[str, Tensor]:
        term = torch.arange(1, self.coefficients.shape[-1] + 1, device=self.opd.device)
        return {
            "field_x": axis(self.fields[0], 0, 3),
            "field_y": axis(self.fields[1], 0, 3),
            "wavelength": axis(self.wavelengths, 1, 3),
            self.numbering: axis(term, 2, 3),
            "coefficient": self.coefficients,
        }

    def summary(self) -> dict[str, Tensor]:
        """The columns of a table with a row for every field and wavelength."""
        return {
            "field_x": axis(self.fields[0], 0, 2),
            "field_y": axis(self.fields[1], 0, 2),
            "wavelength": axis(self.wavelengths, 1, 2),
            "rms": self.rms,
            "peak_to_valley": self.peak_to_valley,
            "strehl": self.strehl,
        }


def wavefront_map(
    lens: Lens,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    size: int = _GRID,
    terms: int = 37,
    numbering: str = "noll",
) -> WavefrontMap:
    """OPD over `size` × `size` pupil points, and the coefficients 1 … `terms` of 784 rays, see `zernike_coefficients`.

    What a field does not have is nan: everything where no ray arrives, the coefficients where the light fills too
    little of the pupil. Raises budget.OverBudget for more points than memory holds.
    """
    view = scene_of(lens, fields, wavelengths)
    F, W = view.fields.shape[1], len(view.wavelengths)
    afford(
        _MAP_BYTES * F * W * size * size,
        f"the wavefronts of {F} fields × {W} wavelengths at {size} × {size} points",
        helps="ask for a smaller --size, or fewer fields or wavelengths",
    )
    together = piece(RAY_BYTES * W * max(size, _GRID) ** 2)
    parts = [
        _map_of(dataclasses.replace(view, fields=some), size, terms, numbering)
        for some in view.fields.split(together, 1)
    ]
    if len(parts) == 1:
        return parts[0]
    joined = {name: torch.cat([getattr(part, name) for part in parts]) for name in _BY_FIELD}
    return dataclasses.replace(parts[0], fields=view.fields, **joined)


def _map_of(view: Scene, size: int, terms: int, numbering: str) -> WavefrontMap:
    like = {"dtype": view.wavelengths.dtype, "device": view.wavelengths.device}
    line, inside, points = _grid(size, **like)
    drawn = wavefront_of(view, points)
    dense = drawn if size == _GRID else wavefront_of(view, _grid(_GRID, **like)[2])
    front = wavefront_of(view, *gauss_rings(*_RINGS, **like))
    wave = 1e-3 * view.wavelengths
    opd = drawn.opd.new_zeros(*drawn.opd.shape[1:3], size, size)
    opd[..., inside] = drawn.opd[0] / wave[:, None]
    valid = torch.zeros_like(opd, dtype=torch.bool)
    valid[..., inside] = drawn.valid[0]
    return WavefrontMap(
        opd=opd,
        valid=valid,
        pupil=line,
        coefficients=zernike_coefficients(front, terms, numbering)[0] / wave[:, None],
        rms=rms(front)[0] / wave,
        peak_to_valley=peak_to_valley(dense)[0] / wave,
        strehl=_strehl(view),
        fields=view.fields,
        wavelengths=view.wavelengths,
        numbering=numbering,
    )


def _grid(size: int, **like) -> tuple[Tensor, Tensor, Tensor]:
    """A line of `size` points from -1 to 1, which of their pairs (y, x) lie in the pupil, and those (2, P)."""
    line = torch.linspace(-1.0, 1.0, size, **like)
    y, x = torch.meshgrid(line, line, indexing="ij")
    inside = x * x + y * y <= 1
    return line, inside, torch.stack([x[inside], y[inside]])


def _strehl(view: Scene) -> Tensor:
    """Strehl ratios (F, W); nan for a field whose blur would need too many rays."""
    ratios = []
    for field in view.fields.split(1, 1):
        try:
            ratios.append(strehl(Scene(view.lens, field, view.wavelengths))[0])
        except ValueError:  # a map of so many waves is still worth seeing
            ratios.append(torch.full_like(view.wavelengths, torch.nan)[None])
    return torch.cat(ratios)

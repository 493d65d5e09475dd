"""Spectral responses of sensors: three Gaussians, tables, CSV files and measured cameras."""

import csv
import dataclasses
import itertools
import math
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Self

import torch
from torch import Tensor

from raytrace.words import did_you_mean, named_value

#: Centre and full width at half maximum, µm, of red, green and blue: Gaussians fitted by least squares to the Nikon
#: 5100 measured by the National Physical Laboratory (Darrodi et al., J. Opt. Soc. Am. A 32, 381, 2015).
GAUSSIANS = {"r": (0.607, 0.060), "g": (0.532, 0.099), "b": (0.464, 0.074)}
#: Measured cameras of the package colour-science.
CAMERAS = ("Nikon 5100 (NPL)", "Sigma SDMerill (NPL)")
#: A channel has no response where its sensitivity is below this fraction of its maximum.
NO_RESPONSE = 1e-3

_UNITS = {"wavelength_um": 1.0, "wavelength_nm": 1e-3}
_LONGEST = 50.0  # µm: larger numbers are in nm
_EXPECTED = 'expected None, "rgb", a table {"wavelengths": (N,) µm, "sensitivities": (C, N)}, a CSV file'


@dataclasses.dataclass(frozen=True)
class SpectralResponse:
    """Sensitivities (C, N) of channels at ascending wavelengths (N,) µm; linear between them, 0 outside.

    names: of the channels, (C,); by default r, g, b of three channels, grey of one. Raises ValueError for other tables.
    """

    wavelengths: Sequence[float]
    sensitivities: Sequence[Sequence[float]]
    names: Sequence[str] = ()

    def __post_init__(self) -> None:
        wavelengths, rows = _floats(self.wavelengths), tuple(map(_floats, self.sensitivities))
        names = tuple(map(str, self.names)) or _names(len(rows))
        for name, entry in (("wavelengths", wavelengths), ("sensitivities", rows), ("names", names)):
            object.__setattr__(self, name, entry)
        counts = [len(row) for row in rows]
        if not rows or len(wavelengths) < 2 or set(counts) != {len(wavelengths)}:
            raise ValueError(
                f"response: {len(wavelengths)} wavelengths and channels of {counts} sensitivities; expected at least "
                "two wavelengths (N,) and as many sensitivities for each channel (C, N)"
            )
        if len(names) != len(rows) or len(set(names)) != len(names):
            raise ValueError(f"response: {len(rows)} channels named {', '.join(names)}; expected a name for each")
        if not (wavelengths[0] > 0 and all(a < b for a, b in itertools.pairwise(wavelengths))):
            raise ValueError("response: the wavelengths do not ascend from above 0; sort the table by wavelength")
        if wavelengths[-1] > _LONGEST:
            raise ValueError(f"response: a wavelength of {wavelengths[-1]:g} µm; expected µm: divide nm by 1000")
        for name, row in zip(names, rows, strict=True):
            if not (all(math.isfinite(entry) and entry >= 0 for entry in row) and any(row)):
                raise ValueError(f"response: channel {name}: expected sensitivities from 0 up, at least one above 0")

    def __repr__(self) -> str:
        return f"<{', '.join(self.names)} from {self.wavelengths[0]:g} to {self.wavelengths[-1]:g} µm>"

    def at(self, wavelengths: Tensor) -> Tensor:
        """Sensitivities (C, W) at wavelengths (W,) µm, relative to the maximum of each channel."""
        known, rows = (
            torch.tensor(numbers, dtype=wavelengths.dtype, device=wavelengths.device)
            for numbers in (self.wavelengths, self.sensitivities)
        )
        above = torch.searchsorted(known, wavelengths.detach().contiguous()).clamp(1, len(known) - 1)
        share = (wavelengths - known[above - 1]) / (known[above] - known[above - 1])
        between = rows[:, above - 1] + share * (rows[:, above] - rows[:, above - 1])
        inside = (wavelengths >= known[0]) & (wavelengths <= known[-1])
        return torch.where(inside, between, 0.0) / rows.amax(-1, keepdim=True)

    def ranges(self) -> list[tuple[float, float]]:
        """The shortest and the longest wavelength, µm, of the response of each channel."""
        responding = (
            [λ for λ, entry in zip(self.wavelengths, row, strict=True) if entry >= NO_RESPONSE * max(row)]
            for row in self.sensitivities
        )
        return [(wavelengths[0], wavelengths[-1]) for wavelengths in responding]

    @classmethod
    def from_csv(cls, path: str | os.PathLike) -> Self:
        """The table of a file with the header wavelength_nm (or wavelength_um), r, g, b: a row for each wavelength.

        The names of the columns are those of the channels. Raises ValueError naming file and line.
        """
        path = Path(path)
        if not path.is_file():
            raise ValueError(f"response {str(path)!r}: no such file; expected a CSV file wavelength_nm,r,g,b")
        with path.open(encoding="utf-8-sig", newline="") as file:
            lines = [(number, row) for number, row in enumerate(csv.reader(file), 1) if any(map(str.strip, row))]
        header = [name.strip() for name in lines[0][1]] if lines else []
        if len(header) < 2 or header[0].lower() not in _UNITS:
            raise ValueError(
                f"{path}:1: header {','.join(header)!r}; expected wavelength_nm or wavelength_um and a name for each "
                "channel, as wavelength_nm,r,g,b"
            )
        columns: list[list[float]] = [[] for _ in header]
        for number, row in lines[1:]:
            try:
                for column, entry in zip(columns, row, strict=True):
                    column.append(float(entry))
            except ValueError:
                raise ValueError(f"{path}:{number}: {','.join(row)!r}; expected {len(header)} numbers") from None
        try:
            return cls([λ * _UNITS[header[0].lower()] for λ in columns[0]], columns[1:], header[1:])
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    @classmethod
    def of_camera(cls, name: str) -> Self:
        """A measured camera of CAMERAS, from the package colour-science. Raises ImportError where it is missing."""
        if name not in CAMERAS:
            near = did_you_mean(name, ("rgb", *CAMERAS))
            raise ValueError(f"response {name!r}: {_EXPECTED} or a measured camera: {', '.join(CAMERAS)}{near}")
        try:
            import colour
        except ImportError as error:
            message = f"response {name!r} needs colour-science: install it by pip install 'raytrace[colour]'"
            raise ImportError(message, name=error.name) from error
        measured = colour.MSDS_CAMERA_SENSITIVITIES[name]
        return cls(1e-3 * measured.wavelengths, measured.values.T)


class _Gaussians:
    """The response "rgb": sensitivities exp(-4 ln 2 (λ - λ₀)²/w²) of GAUSSIANS."""

    names = tuple(GAUSSIANS)

    def at(self, wavelengths: Tensor) -> Tensor:
        centre, width = wavelengths.new_tensor([*GAUSSIANS.values()]).T[..., None]
        return torch.exp(-4 * math.log(2) * ((wavelengths - centre) / width) ** 2)

    def ranges(self) -> list[tuple[float, float]]:
        reach = math.sqrt(-math.log(NO_RESPONSE) / (4 * math.log(2)))
        return [(centre - reach * width, centre + reach * width) for centre, width in GAUSSIANS.values()]


def read_response(response: object) -> SpectralResponse | str | None:
    """What a user specifies as a response: None, or "grey", and "rgb" as they are, all others as a table.

    Raises ValueError, TypeError, ImportError as `SpectralResponse`.
    """
    if response is None or isinstance(response, SpectralResponse):
        return response
    if isinstance(response, str) and response == "grey":
        return None
    if isinstance(response, str) and response == "rgb":
        return response
    if isinstance(response, os.PathLike) or (isinstance(response, str) and response.lower().endswith(".csv")):
        return SpectralResponse.from_csv(response)
    if isinstance(response, str):
        return SpectralResponse.of_camera(response)
    if isinstance(response, Mapping):
        if not {"wavelengths", "sensitivities"} <= {*response} <= {"wavelengths", "sensitivities", "names"}:
            raise ValueError(f"response: a mapping of {', '.join(map(str, response))}; {_EXPECTED}")
        return SpectralResponse(**response)
    if isinstance(response, Sequence) and len(response) == 2:
        return SpectralResponse(*response)
    raise TypeError(f"response: {named_value(response)}; {_EXPECTED} or the name of a measured camera")


def channel_names(response: SpectralResponse | str | None) -> tuple[str, ...]:
    """The names of the channels of a response: grey if there is none."""
    return _names(1) if response is None else tuple(_of(response).names)


def band(response: SpectralResponse | str) -> tuple[float, float]:
    """The shortest and the longest wavelength, µm, at which a channel responds."""
    low, high = zip(*_of(response).ranges(), strict=True)
    return min(low), max(high)


def channel_weights(response: SpectralResponse | str, wavelengths: Tensor) -> Tensor:
    """Sensitivities (C, W) at wavelengths (W,) µm, divided by their sum over the wavelengths.

    Raises ValueError for a channel that has no response (NO_RESPONSE) at any of them.
    """
    sensitivities = _of(response).at(wavelengths)
    largest = sensitivities.detach().amax(-1).tolist()
    for name, most, (low, high) in zip(_of(response).names, largest, _of(response).ranges(), strict=True):
        if most < NO_RESPONSE:
            listed = ", ".join(f"{number:.6g}" for number in wavelengths.detach().tolist())
            raise ValueError(
                f"channel {name} of the sensor has no response at the wavelengths {listed} µm; it responds from "
                f"{low:.4g} to {high:.4g} µm: add a wavelength there, as lens.at(wavelengths=…), or give a response "
                "without this channel"
            )
    return sensitivities / sensitivities.sum(-1, keepdim=True)


def _of(response: SpectralResponse | str) -> SpectralResponse | _Gaussians:
    return _Gaussians() if isinstance(response, str) else response


def _floats(numbers: Iterable) -> tuple[float, ...]:
    return tuple(float(number) for number in (numbers.tolist() if hasattr(numbers, "tolist") else numbers))


def _names(count: int) -> tuple[str, ...]:
    return {1: ("grey",), 3: ("r", "g", "b")}.get(count) or tuple(f"channel {k + 1}" for k in range(count))

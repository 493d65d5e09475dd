"""The sensor of a camera: its pixels and their field points, spectral response, Bayer mosaic, noise and quantisation.

A picture is the upright view of the scene, and the image on the sensor is inverted: rows grow downwards in the scene,
towards +y on the sensor, and columns grow to the right of the scene, towards -x on the sensor.

Random numbers are keyed by whole numbers (seed, index of the picture), as in `pictures`: the noise and the patch of a
picture are the same in any batch and in any process.
"""

import dataclasses
import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from raytrace.imaging.image import add_noise, add_shot_noise, as_picture, count_electrons, digitise
from raytrace.imaging.pictures import draws
from raytrace.imaging.spectral_response import SpectralResponse, channel_names, channel_weights, read_response
from raytrace.io import as_lens
from raytrace.maths.numerics import as_tensor, differentiating, varies
from raytrace.system.lens import Lens, aligned, wavelengths_of, with_field_kind
from raytrace.tracing.launch import field_of_object, object_field, rays_of_field
from raytrace.tracing.paraxial import axial_beam
from raytrace.tracing.trace import points_at
from raytrace.words import named_value

#: Colours of the pixels (0, 0), (1, 0), (0, 1), (1, 1), as (column, row), of Bayer patterns.
PATTERNS = ("RGGB", "BGGR", "GRBG", "GBRG")
_SQUARE = 1e-6  # relative difference of the pitches that rounded sizes leave
_BLACK = 5.0  # standard deviations of the read noise
_NOISE, _PATCH = 4, 5  # last numbers of keys; `pictures` has those below


@dataclasses.dataclass(frozen=True)
class Sensor:
    """A sensor of square pixels.

    size: (width, height) mm, pitch times `pixels`; pixels: (columns, rows); offset: of its centre from the optical
        axis, (x, y) mm.
    response: None or "grey", one channel; "rgb", three Gaussians (`spectral_response.GAUSSIANS`); a table
        {"wavelengths": (N,) µm, "sensitivities": (C, N)}, linear between its wavelengths and 0 outside; the path of a
        CSV file with the header wavelength_nm (or wavelength_um), r, g, b; "Nikon 5100 (NPL)" or "Sigma SDMerill
        (NPL)", measured cameras of the extra: pip install 'raytrace[colour]'.
    mosaic: "none", every pixel records all channels, or a Bayer pattern of PATTERNS.
    full_well: electrons at level 1, where pixels saturate; None: no shot noise.
    read_noise: standard deviation in electrons; without a full well a fraction of level 1.
    bits: of the quantisation; None: continuous levels.
    saturation: level at which pixels saturate; inf: never.
    black_level: offset of the quantisation, in the unit of the read noise: the 2^bits levels reach from -black_level to
        the full well, so that the noise of dark pixels keeps its mean and variance; None: five times the read noise.

    The centre of pixel (column c, row r), counted from 0, is at

        x = offset_x - (c - (columns - 1)/2) pitch,   y = offset_y + (r - (rows - 1)/2) pitch

    so that a picture is the upright view of the scene. `dataclasses.asdict` gives the arguments of an equal sensor.
    Raises ValueError for pixels that are not square and for other numbers, TypeError for other kinds of response.
    """

    size: tuple[float, float] = (24.0, 16.0)
    pixels: tuple[int, int] = (4800, 3200)
    response: SpectralResponse | str | None = None
    mosaic: str = "none"
    full_well: float | None = None
    read_noise: float = 0.0
    bits: int | None = None
    offset: tuple[float, float] = (0.0, 0.0)
    black_level: float | None = None
    saturation: float = 1.0

    def __post_init__(self) -> None:
        for name, kind, expected in (
            ("size", float, "(width, height) mm, above 0"),
            ("pixels", int, "(columns, rows), whole numbers above 0"),
            ("offset", float, "(x, y) mm"),
        ):
            object.__setattr__(self, name, _pair(getattr(self, name), name, kind, expected))
        object.__setattr__(self, "response", read_response(self.response))
        self._check_pixels()
        self._check_levels()

    def _check_pixels(self) -> None:
        (width, height), (columns, rows) = self.size, self.pixels
        across, down = width / columns, height / rows
        if abs(across - down) <= _SQUARE * across:
            return
        more = round(height / across)
        fits = more > 0 and abs(height / more - across) <= _SQUARE * across
        raise ValueError(
            f"pixels of {1e3 * across:.6g} × {1e3 * down:.6g} µm: expected square ones; give size=({width:g}, "
            f"{rows * across:.9g})" + (f", or pixels=({columns}, {more})" if fits else "")
        )

    def _check_levels(self) -> None:
        if self.mosaic != "none" and self.mosaic not in PATTERNS:
            raise ValueError(f"mosaic {self.mosaic!r}: expected none or a Bayer pattern: {', '.join(PATTERNS)}")
        if self.mosaic != "none" and len(self.channels) != 3:
            raise ValueError(
                f"mosaic {self.mosaic} of a sensor with {len(self.channels)} channels ({', '.join(self.channels)}): "
                'expected three, red, green and blue: give response="rgb", or mosaic="none"'
            )
        if self.full_well is not None and not 0 < self.full_well < math.inf:
            raise ValueError(f"full_well {self.full_well!r}: expected electrons, above 0; None for no shot noise")
        if not 0 <= self.read_noise < math.inf:
            raise ValueError(f"read_noise {self.read_noise!r}: expected 0, or electrons above 0")
        if self.full_well is None and self.read_noise >= 1:
            raise ValueError(
                f"read_noise {self.read_noise:g} without a full well is a fraction of level 1: expected less than 1; "
                "for electrons give full_well=…"
            )
        if self.black_level is not None and not 0 <= self.black_level < math.inf:
            raise ValueError(f"black_level {self.black_level!r}: expected 0 or more, in the unit of the read noise")
        if not self.saturation >= 1 or (self.bits is not None and self.saturation != 1):
            raise ValueError(
                f"saturation {self.saturation!r}: expected 1, the level of the full well; without bits more, or inf"
            )
        if self.bits is not None and (self.bits != int(self.bits) or not 1 <= self.bits <= 32):
            raise ValueError(f"bits {self.bits!r}: expected a whole number from 1 to 32; None for continuous levels")

    # -- pixels --------------------------------------------------------------------------------------------------------

    @property
    def pitch(self) -> float:
        """Distance of neighbouring pixels, mm."""
        return self.size[0] / self.pixels[0]

    @property
    def half_diagonal(self) -> float:
        """Half of the diagonal, mm: the largest image height, where the offset is 0."""
        return 0.5 * math.hypot(*self.size)

    @property
    def corners(self) -> Tensor:
        """Points (2, 4) mm of the upper left, upper right, lower left and lower right corner of the picture."""
        columns, rows = self.pixels
        left, right, top, bottom = -0.5, columns - 0.5, -0.5, rows - 0.5
        return self.points(_numbers([left, right, left, right]), _numbers([top, top, bottom, bottom]))

    def on_diagonal(self, shares: Tensor | Sequence[float]) -> Tensor:
        """Points (2, N) mm at shares (N,) of the way from the middle of the sensor to its upper left corner."""
        middle = self.corners.mean(1, keepdim=True)
        return middle + (self.corners[:, :1] - middle) * _numbers(shares)

    def points(self, columns: Tensor | float, rows: Tensor | float) -> Tensor:
        """Points (2, ...) mm on the sensor of pixel coordinates, which broadcast; whole numbers are pixel centres."""
        column, row = torch.broadcast_tensors(_numbers(columns), _numbers(rows))
        x = self.offset[0] - (column - 0.5 * (self.pixels[0] - 1)) * self.pitch
        y = self.offset[1] + (row - 0.5 * (self.pixels[1] - 1)) * self.pitch
        return torch.stack([x, y])

    def pixel_of(self, points: Tensor) -> Tensor:
        """Pixel coordinates (column, row), (2, ...), of points (2, ...) mm: the inverse of `points`."""
        x, y = _components(points, "points")
        column = 0.5 * (self.pixels[0] - 1) - (x - self.offset[0]) / self.pitch
        row = 0.5 * (self.pixels[1] - 1) + (y - self.offset[1]) / self.pitch
        return torch.stack([column, row])

    # -- chief rays ----------------------------------------------------------------------------------------------------

    def fields(self, lens: Lens, points: Tensor) -> Tensor:
        """Field points (2, ...), in the lens's kind of field, whose chief ray meets the sensor at points (2, ...) mm.

        The real chief ray at the primary wavelength, through the centre of the pupil: vignetting factors and apertures
        are left out. nan where there is none. Differentiable in the numbers of the lens; of a batch (2, L, ...).
        """
        lens = as_lens(lens, "Sensor.fields")
        points = _components(points, "points").to(lens.surfaces[-2].thickness)
        known = torch.isfinite(points.detach()).all(0)
        lens, points = aligned(lens, points.dim() - 1, exactly=True), torch.where(known, points, 0.0)
        paraxial = axial_beam(lens)
        extent, arrives = object_field(with_field_kind(lens, "real_image_height"), points, paraxial)
        of_image = lens.fields.kind == "real_image_height"
        fields = points.expand_as(extent) if of_image else field_of_object(lens, extent, paraxial)
        return torch.where(arrives & known, fields, torch.nan)

    def landing(self, lens: Lens, fields: Tensor, wavelengths: Tensor | Sequence[float] | None = None) -> Tensor:
        """Points (2, ...) mm where the chief rays of fields (2, ...) meet the sensor: the inverse of `fields`.

        wavelengths: (W,) µm, for points (2, ..., W); by default the primary one. nan where a ray does not arrive.
        """
        lens = as_lens(lens, "Sensor.landing")
        fields = _components(fields, "fields").to(lens.surfaces[-2].thickness)
        if wavelengths is None:
            wavelength = lens.primary
        else:
            wavelength, fields = wavelengths_of(lens, wavelengths), fields[..., None]
        return landing_of(aligned(lens, fields.dim() - 1, exactly=True), fields, wavelength)

    # -- colours -------------------------------------------------------------------------------------------------------

    @functools.cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of the channels, as many as there are."""
        return channel_names(self.response)

    def weights(self, wavelengths: Tensor | Sequence[float], wavelength_weights: Tensor | None = None) -> Tensor:
        """Weights (C, W) of wavelengths (W,) µm in each channel, of sum 1 for each channel.

        wavelength_weights: (W,), those of a sensor without a response, such as the lens's; by default all equal.
        Raises ValueError for a channel that has no response at any of the wavelengths.
        """
        wavelengths = _numbers(wavelengths).reshape(-1)
        if self.response is not None:
            return channel_weights(self.response, wavelengths)
        weights = torch.ones_like(wavelengths) if wavelength_weights is None else wavelength_weights.to(wavelengths)
        if weights.shape != wavelengths.shape:
            raise ValueError(f"{weights.numel()} wavelength_weights; expected {len(wavelengths)}, one per wavelength")
        return (weights / weights.sum())[None]

    def sample(self, image: Tensor, origin: Tensor | Sequence[int] = (0, 0)) -> Tensor:
        """The mosaic (..., 1, H, W) of images (..., 3, H, W): of every pixel the channel of the Bayer pattern.

        origin: (column, row) of the image's first pixel on the sensor; (..., 2) for patches. Unchanged without mosaic.
        """
        image = as_picture(image, "image")
        if self.mosaic == "none":
            return image
        self._check_channels(image)
        channel = self._channel(image.shape, origin, image.device)[..., None, :, :]
        return image.gather(-3, channel.expand(*image.shape[:-3], 1, *image.shape[-2:]))

    def demosaic(self, mosaic: Tensor, origin: Tensor | Sequence[int] = (0, 0)) -> Tensor:
        """Images (..., 3, H, W) of mosaics (..., 1, H, W): missing colours by bilinear interpolation.

        At a border the mean of the neighbours that there are. origin: as for `sample`. Unchanged without mosaic.
        """
        mosaic = as_picture(mosaic, "mosaic")
        if self.mosaic == "none":
            return mosaic
        if mosaic.dim() < 3 or mosaic.shape[-3] != 1 or min(mosaic.shape[-2:]) < 2:
            raise ValueError(f"a mosaic of shape {tuple(mosaic.shape)}: expected (..., 1, H, W), 2 × 2 pixels or more")
        channel = self._channel(mosaic.shape, origin, mosaic.device)[..., None, :, :]
        ours = (channel == torch.arange(3, device=mosaic.device)[:, None, None]).to(mosaic.dtype)
        ours = ours.expand(*mosaic.shape[:-3], 3, *mosaic.shape[-2:])
        # Green samples are diagonal neighbours of each other, red and blue ones are not.
        line = mosaic.new_tensor([0.5, 1.0, 0.5])
        square = line[:, None] * line
        cross = square * square.new_tensor([[0, 0.5, 0], [0.5, 1, 0.5], [0, 0.5, 0]])
        kernels = torch.stack([square, cross, square])[:, None]

        def spread(values: Tensor) -> Tensor:
            flat = values.reshape(-1, 3, *values.shape[-2:])
            return conv2d(flat, kernels, padding=1, groups=3).reshape(values.shape)

        return spread(ours * mosaic) / spread(ours)

    def _channel(self, shape: Sequence[int], origin: Tensor | Sequence[int], device: torch.device) -> Tensor:
        """The number of the channel (..., H, W) that each pixel of images of this shape records."""
        origin = torch.as_tensor(origin, device=device)
        if origin.is_floating_point() or not origin.shape or origin.shape[-1] != 2:
            raise ValueError(f"origin of shape {tuple(origin.shape)}, {origin.dtype}: expected whole (column, row)")
        if origin.shape[:-1] not in ((), tuple(shape[:-3])):
            count = f"{tuple(origin.shape[:-1])} origins of images {tuple(shape)}"
            raise ValueError(f"{count}: expected one (column, row), or one for each image")
        columns = (torch.arange(shape[-1], device=device) + origin[..., 0, None]) % 2
        rows = (torch.arange(shape[-2], device=device) + origin[..., 1, None]) % 2
        pattern = torch.tensor(["RGB".index(colour) for colour in self.mosaic], device=device)
        return pattern[2 * rows[..., :, None] + columns[..., None, :]]

    # -- noise ---------------------------------------------------------------------------------------------------------

    def capture(
        self,
        irradiance: Tensor,
        index: Tensor | Sequence[int] | None = None,
        seed: int = 0,
        origin: Tensor | Sequence[int] = (0, 0),
    ) -> Tensor:
        """The recorded picture (..., C, H, W), or its mosaic (..., 1, H, W), of irradiance (..., C, H, W).

        irradiance: level 1 fills the full well; integers of 8 or 16 bits are scaled to 0 … 1.
        index: global numbers (...) of the pictures, by default 0, 1, …: the noise of a picture depends on seed and
        index alone (of one dtype and shape, on one kind of device). origin: (column, row) of the first pixel on the
        sensor, or (..., 2).

        In this order: mosaic; shot noise, Poisson (`count_electrons`), or, where a derivative by the irradiance may be
        requested, its Gaussian approximation with its derivative (`add_shot_noise`); read noise; saturation;
        quantisation (`digitise`) from -black_level on, which the derivative ignores. Dark pixels have a mean of 0:
        levels below 0 remain, to -black_level with bits. Raises ValueError.
        """
        picture = as_picture(irradiance, "picture")
        self._check_channels(picture)
        if not bool(torch.isfinite(picture.detach()).all()):
            count = int((~torch.isfinite(picture.detach())).sum())
            raise ValueError(f"a picture with {count} pixels that are nan or infinite: expected levels from 0 to 1")
        index = _indices(picture.shape[:-3], index)
        picture = self.sample(picture, origin)
        if self.full_well is not None or self.read_noise > 0:
            each = zip(picture.reshape(-1, *picture.shape[-3:]), index, strict=True)
            noisy = [self._noisy(part, _generator(seed, number, picture.device)) for part, number in each]
            picture = torch.stack(noisy).reshape(picture.shape)
        if self.bits is None:
            return picture.clamp(max=self.saturation)
        black = self.black
        return (1 + black) * digitise((picture + black) / (1 + black), self.bits) - black

    @property
    def black(self) -> float:
        """The black level relative to level 1."""
        black = _BLACK * self.read_noise if self.black_level is None else self.black_level
        return black / (self.full_well or 1.0)

    def noise_deviation(self, spectrum: Tensor) -> Tensor:
        """Standard deviation of the noise of a pixel of mean level, (1, 1), of pictures of a spectrum (rows, columns).

        (C, 1, 1) of spectra (C, rows, columns) of channels and of cross spectra (C, C, rows, columns).
        """
        rows, columns = spectrum.shape[-2:]
        constant = spectrum[..., 0, 0]
        mean = ((constant.diagonal().real if spectrum.dim() == 4 else constant) / (rows * columns)).sqrt()
        well, read = self.full_well, self.read_noise
        variance = torch.full_like(mean, read**2) if well is None else mean / well + (read / well) ** 2
        return variance.sqrt()[..., None, None]

    def _noisy(self, picture: Tensor, generator: torch.Generator) -> Tensor:
        """A picture (C, H, W) with shot and read noise."""
        if self.full_well is not None:
            shot = add_shot_noise if differentiating() and varies(picture) else count_electrons
            picture = shot(picture, self.full_well, generator=generator)
        if self.read_noise > 0:
            picture = add_noise(picture, self.read_noise / (self.full_well or 1.0), generator=generator)
        return picture

    def _check_channels(self, picture: Tensor) -> None:
        if picture.dim() < 3 or picture.shape[-3] != len(self.channels) or 0 in picture.shape:
            names = ", ".join(self.channels)
            raise ValueError(
                f"a picture of shape {tuple(picture.shape)}: expected (..., {len(self.channels)}, H, W), the channels "
                f"{names} of the sensor"
            )

    # -- patches -------------------------------------------------------------------------------------------------------

    def random_patches(self, index: Tensor | Sequence[int], size: int | tuple[int, int], seed: int = 0) -> Tensor:
        """Origins (B, 2), (column, row), of patches on the sensor: uniform, functions of seed and index (B,) alone.

        size: (rows, columns) of the patches, or one number. Raises ValueError for patches larger than the sensor.
        """
        height, width = self._patch(size)
        (columns, rows), index = self.pixels, as_tensor(index).reshape(-1)
        random = (draws(_whole(seed, "seed"), number, _PATCH) for number in _indices(index.shape, index))
        origins = [[r.integers(columns - width + 1), r.integers(rows - height + 1)] for r in random]
        return torch.from_numpy(np.array(origins, np.int64).reshape(-1, 2))

    def patch_points(self, origins: Tensor, size: int | tuple[int, int]) -> Tensor:
        """Centre points (2, ...) mm of patches with origins (..., 2) and a size as for `random_patches`."""
        height, width = self._patch(size)
        origins = _numbers(origins)
        return self.points(origins[..., 0] + 0.5 * (width - 1), origins[..., 1] + 0.5 * (height - 1))

    def _patch(self, size: int | tuple[int, int]) -> tuple[int, int]:
        size = (size, size) if isinstance(size, int) else size
        height, width = _pair(size, "size", int, "(rows, columns) of a patch, or one number")
        columns, rows = self.pixels
        if height > rows or width > columns:
            raise ValueError(f"patches of {height} × {width} pixels on a sensor of {rows} × {columns} rows and columns")
        return height, width


def landing_of(lens: Lens, fields: Tensor, wavelength: Tensor) -> Tensor:
    """Points (2, ...) mm where the chief rays of fields (2, ...) at wavelengths (...) µm meet the sensor of a lens;
    everything broadcasts. See `Sensor.landing`."""
    known = torch.isfinite(fields.detach()).all(0)
    fields = torch.where(known, fields, 0.0)
    rays = rays_of_field(lens, fields, torch.zeros_like(fields), wavelength=wavelength)
    (points,), arrives = points_at(lens, wavelength, (len(lens.surfaces) - 1,))(rays)
    return torch.where(arrives & known, points, torch.nan)


def _pair(numbers: Any, name: str, kind: type, expected: str) -> tuple:
    """Two plain numbers; those of a size and of pixels are above 0."""
    try:
        pair = tuple(kind(number) for number in numbers)
        usable = len(pair) == 2 and all(map(math.isfinite, pair)) and pair == tuple(map(float, numbers))
    except (TypeError, ValueError):
        usable = False
    if not usable or (name != "offset" and min(pair) <= 0):
        shown = numbers if isinstance(numbers, (tuple, list)) else named_value(numbers)
        raise ValueError(f"{name} {shown}: expected {expected}")
    return pair


def _numbers(numbers: object) -> Tensor:
    """Floating-point numbers; plain and whole ones are of float64."""
    numbers = as_tensor(numbers, dtype=torch.float64)
    return numbers if numbers.is_floating_point() else numbers.to(torch.float64)


def _components(points: object, name: str) -> Tensor:
    """Points (2, ...)."""
    points = _numbers(points)
    if not points.dim() or len(points) != 2:
        raise ValueError(f"{name} of shape {tuple(points.shape)}: expected (2, ...), x and y")
    return points


def _whole(number: float, name: str) -> int:
    if isinstance(number, float) or int(number) < 0:
        raise ValueError(f"{name} {number!r}: expected a whole number from 0 up")
    return int(number)


def _indices(batch: Sequence[int], index: Tensor | Sequence[int] | None) -> list[int]:
    """The numbers of the pictures of a batch, in order."""
    if index is None:
        return [*range(math.prod(batch))]
    index = as_tensor(index)
    if index.is_floating_point() or tuple(index.shape) != tuple(batch) or bool((index < 0).any()):
        shown = f"{tuple(index.shape)}, {str(index.dtype).removeprefix('torch.')}"
        raise ValueError(f"index of shape {shown}: expected whole numbers {tuple(batch)} from 0 up, one per picture")
    return index.flatten().tolist()


def _generator(seed: int, index: int, device: torch.device) -> torch.Generator:
    """Random numbers of a picture, of whatever batch it is."""
    number = int(draws(_whole(seed, "seed"), index, _NOISE).integers(2**63))
    return torch.Generator(device).manual_seed(number)

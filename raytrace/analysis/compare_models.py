"""Comparison of PSF models: kernels over object distance, and the properties that each can represent."""

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from raytrace.maths.numerics import safe_divide, safe_sqrt, value
from raytrace.maths.result import Column, Result, Table, axis, number, numbers
from raytrace.maths.sampling import Grid, grid
from raytrace.plotting.style import Figure, array, styled
from raytrace.psf_models.figures import brightness, distance_text, panels, window, worded
from raytrace.psf_models.models import MODELS, PIXEL, SIZE, Model, NotConverged, psf
from raytrace.psf_models.result import Psf
from raytrace.system.lens import Lens, SystemAperture, media, with_sensor_distance, with_wavelengths
from raytrace.tracing.focus import NoImage, focused, real_image_distance
from raytrace.tracing.paraxial import first_order, largest_field
from raytrace.tracing.trace import need_axis
from raytrace.words import option

STARTS = ("paraxial", "rms")
DISTANCES = (10e3, 20e3, 30e3, 40e3, 50e3)  # mm

_ROWS = sorted(MODELS.values(), key=lambda model: model.row)  # the last one is the reference of the others
_TOLERANCE = 0.01  # of abilities: the counting noise of a few rays would pass for aberrations and for rings
_CONIC = 0.2  # by how much the conic of the most curved surface grows
_SLOW = 16.0  # F-number, or the lens's own if it is slower, at which the first dark ring is searched
_AIRY_PIXELS = 24  # pixels in the radius of the ideal ring


#: Properties of each model, and the whole numbers among them.
_SHOWN = (
    Column("conic", "", ".4f", "Δ conic"),
    Column("anisotropy", "", ".4f", "σ long/short"),
    Column("asymmetry", "", ".4f"),
    Column("dark_ring", "", ".4f", "dark ring/Airy"),
    Column("parameters", "", ".0f"),
    Column("rays", "", ".0f"),
)
_WHOLE = ("parameters", "rays")


@value
class Abilities(Result):
    """The properties that each model can represent, of the object in focus: one number (M,) for each model.

    conic: relative L1 change of the kernel when the conic of the most curved surface grows by 0.2 (aberrations).
    anisotropy: longer over shorter σ of the largest field, before pixels and window (of "wave": of its rays);
        asymmetry: relative L1 difference of that field's kernel from itself turned by 180° about the centroid of the
        light (off axis).
    dark_ring: radius of the first minimum at F/16 in radii of the Airy disc, nan without a minimum (diffraction).
    parameters: number of curvatures, conics and thicknesses by which the kernel has a derivative other than 0.
    rays: traced for one kernel on the axis.
    """

    COLUMNS = (Column("model", form="<"), *_SHOWN)

    conic: Tensor
    anisotropy: Tensor
    asymmetry: Tensor
    dark_ring: Tensor
    parameters: Tensor
    rays: Tensor
    models: tuple[str, ...]

    def columns(self) -> dict[str, Tensor]:
        model = torch.arange(len(self.models), device=self.conic.device)
        return {"model": model, **{column.name: getattr(self, column.name) for column in _SHOWN}}

    def words(self) -> dict:
        return {"model": self.models}

    def of(self, m: int) -> dict[str, float | int | None]:
        """The answers of one model."""
        return {name: (int if name in _WHOLE else number)(getattr(self, name)[m]) for name, *_ in _SHOWN}

    def tables(self) -> list[Table]:
        return [Table(self.columns(), ["properties of each model: see `raytrace compare-models --help`"])]


@value
class Comparison(Result):
    """Kernels of every model on the axis, over object distance, on one sensor.

    psfs: of each model, kernels (D, 1, rows, columns); models: their names.
    object_distances: (D,) mm; sensor_distance: () mm from the last surface; wavelength: () µm.
    abilities: the properties that each model can represent, or None.
    """

    psfs: tuple[Psf, ...]
    object_distances: Tensor
    sensor_distance: Tensor
    wavelength: Tensor
    models: tuple[str, ...]
    abilities: Abilities | None = None

    @property
    def sigma(self) -> Tensor:
        """σ (M, D) mm of each kernel along x or y, before pixels: √((σ_x² + σ_y²)/2).

        Of "Fourier" and "wave" of the light inside the window, see `Psf.covariance`.
        """
        covariance = torch.stack([psfs.covariance[..., 0] for psfs in self.psfs])
        return safe_sqrt(0.5 * (covariance[:, 0] + covariance[:, 2]))

    @property
    def difference(self) -> Tensor:
        """Relative L1 difference (M, D) of each kernel from that of the last model."""
        kernels = torch.stack([psfs.kernel[:, 0] for psfs in self.psfs])
        return safe_divide((kernels - kernels[-1]).abs().sum((-2, -1)), kernels[-1].sum((-2, -1)))

    @property
    def error(self) -> Tensor:
        """Estimated error (M, D) of each kernel against its own model's limit, see `Psf.error`."""
        return torch.stack([psfs.error[:, 0] for psfs in self.psfs])

    def columns(self) -> dict[str, Tensor]:
        return {
            "model": axis(torch.arange(len(self.models), device=self.object_distances.device), 0, 2),
            "object_distance": axis(self.object_distances, 1, 2),
            "sigma_um": 1e3 * self.sigma,
            "energy": torch.stack([psfs.energy[:, 0] for psfs in self.psfs]),
            "difference": self.difference,
            "error": self.error,
            "rays": axis(self.object_distances.new_tensor([psfs.rays for psfs in self.psfs]), 0, 2),
        }

    def words(self) -> dict:
        return {"model": self.models}

    @property
    def sensor(self) -> str:
        """The sensor distance and the wavelength, in words."""
        return f"one sensor at {float(self.sensor_distance):.7f} mm, {float(self.wavelength):g} µm"

    def document(self) -> dict:
        """Every model by its name: its properties, differences and kernels."""
        models = {
            name: {
                **({} if self.abilities is None else self.abilities.of(m)),
                "difference": numbers(self.difference[m]),
                "results": self.psfs[m].document()["results"],
            }
            for m, name in enumerate(self.models)
        }
        place = {"sensor_distance": number(self.sensor_distance), "wavelength": number(self.wavelength)}
        return {**place, "models": models}

    def tables(self) -> list[Table]:
        """A row for each model, and for each object distance its σ, difference and error."""
        pixels = self.psfs[-1].grid
        size = f"{pixels.columns} × {pixels.rows} pixels of {1000 * float(pixels.pitch):g} µm"
        title = [
            f"{self.sensor}; on the axis, {size}",
            f"σ in µm (Fourier, wave: of the light inside the window), relative L1 difference from {self.models[-1]}, "
            "estimated error of the kernel (Gaussian DRT: of σ), for objects at",
        ]
        columns: dict[str | Column, Tensor | Sequence] = {Column("model", form="<"): self.models}
        table = self.columns()
        for k, distance in enumerate(self.object_distances.tolist()):
            columns |= {
                Column(f"sigma {k}", "µm", ".3f", f"{distance:g} mm\nσ"): table["sigma_um"][:, k],
                Column(f"difference {k}", "", ".3f", " \nΔ"): table["difference"][:, k],
                Column(f"error {k}", "", ".1e", " \nerror"): table["error"][:, k],
            }
        return [Table(columns, title, [] if self.abilities is None else [str(self.abilities)])]

    @styled
    def draw(self, *, log: bool = False) -> Figure:
        """Kernels over object distance (columns) and model (rows, with the number of its rays).

        Below each kernel: its energy inside the window, and its relative L1 difference from the last row.
        log: four decades of brightness below the peak.
        """
        kernels = [array(psfs.kernel)[:, 0] for psfs in self.psfs]
        notes = [
            [
                f"energy {k.sum():.2f}" + (f",  Δ {d:.2f}" if models is not kernels[-1] else "")
                for k, d in zip(models, row, strict=True)
            ]
            for models, row in zip(kernels, array(self.difference), strict=True)
        ]
        labels = [
            f"{name}\n" + (f"({psfs.rays} rays)" if psfs.rays else "")
            for name, psfs in zip(self.models, self.psfs, strict=True)
        ]
        grid = self.psfs[-1].grid
        pitch, headings = float(grid.pitch), [distance_text(distance) for distance in self.object_distances.tolist()]
        half = 0.5 * pitch * grid.columns
        figure, _ = panels(kernels, [[half] * len(headings)] * len(labels), headings, labels, notes, log)
        title = ": ".join(filter(None, (self.psfs[-1].lens.name, self.sensor)))
        return worded(
            figure, title, [window(grid), brightness(log), f"Δ: relative L¹ difference from {self.models[-1]}"]
        )


def compare_models(
    lens: Lens,
    *,
    object_distances: Tensor | Sequence[float] = DISTANCES,
    focus_distance: float = 25e3,
    wavelengths: Sequence[float] = (0.53,),
    start: Literal["paraxial", "rms"] = "paraxial",
    pixel: float = PIXEL,
    size: int = SIZE,
) -> Comparison:
    """The PSF models on the axis over object distances (D,) mm, and the properties that each can represent.

    start: sensor position, the "paraxial" image or the minimum "rms" spot radius on the axis; focus_distance: object in
    focus, mm; wavelengths: µm, of which the first is taken; pixel: pitch, mm; size: pixels across the windows. Raises
    NoImage for a distance of which the lens forms no real image.
    """
    need_axis(lens, "the comparison of PSF models on the axis", "ask for kernels of one model by `psf`")
    distances = torch.as_tensor(object_distances, dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)
    try:
        lens = common_focus(lens, focus_distance, wavelength=wavelengths[0], start=start)
        real_image_distance(lens, distances)
    except NoImage as error:
        length = float(first_order(lens).effective_focal_length)
        raise NoImage(
            f"{error}; its focal length is {length:.6g} mm, give {option('focus_distance')} and "
            f"{option('object_distances')} beyond, or inf"
        ) from error
    pixels = grid(lens.wavelengths.new_tensor(pixel), size)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotConverged)  # the estimated errors are part of the result
        kernels = side_by_side(lens, distances, pixels=pixels)
        return dataclasses.replace(kernels, abilities=abilities(lens, pixels=pixels))


def common_focus(lens: Lens, focus_distance: float, *, wavelength: float | Tensor, start: str = "paraxial") -> Lens:
    """The lens at one wavelength (µm), focused at an object distance (mm, inf allowed), on the axis.

    start: "paraxial", the paraxial image; "rms", the sensor of the least RMS spot. Raises ValueError for another start
    and where the lens forms no real image of the object.
    """
    if start not in STARTS:
        raise ValueError(f"start {start!r} is not known; expected {' or '.join(STARTS)}")
    return focused(with_wavelengths(lens, [float(wavelength)]), focus_distance, on=start)


def side_by_side(lens: Lens, object_distances: Tensor, *, pixels: Grid | None = None) -> Comparison:
    """Kernels of every model on the axis for objects at distances (D,) mm, sensor as it is.

    pixels: about the axis, by default 21 × 21 of 5 µm.
    """
    return Comparison(
        psfs=tuple(_psf(lens, m, object_distances=object_distances, grid=pixels, **m.compared) for m in _ROWS),
        object_distances=object_distances,
        sensor_distance=lens.surfaces[-2].thickness,
        wavelength=lens.primary,
        models=tuple(model.title for model in _ROWS),
    )


def abilities(lens: Lens, *, pixels: Grid | None = None) -> Abilities:
    """The properties that each model can represent, of a lens at one wavelength, its object and sensor distance.

    pixels: about the axis, by default 21 × 21 of 5 µm.
    """
    changed, upright, rows = _with_conic(lens), largest_field(lens), []
    for model in _ROWS:
        work = {"tol": _TOLERANCE} if "model" in model.compared else model.compared
        focused = _psf(lens, model, grid=pixels, **work)
        away = _psf(lens, model, fields=upright, grid=_about_light(lens, upright, focused.grid, model), **work)
        rows.append(
            {
                "conic": _relative(_psf(changed, model, grid=pixels, **work).kernel, focused.kernel),
                "anisotropy": _anisotropy(away.ray_covariance[:, 0, 0]),
                "asymmetry": _relative(away.kernel.flip(-2, -1), away.kernel),
                "dark_ring": _dark_ring(lens, model, work),
                "parameters": _parameters(lens, model, work),
                "rays": model.compared["model"].rays if "model" in model.compared else focused.rays,
            }
        )
    table = {key: lens.wavelengths.new_tensor([float(row[key]) for row in rows]) for key, *_ in _SHOWN}
    return Abilities(**table, models=tuple(model.title for model in _ROWS))


def _psf(lens: Lens, model: Model, /, **options: Any) -> Psf:
    """Kernels as `psf` gives them; on the axis and at the lens's object distance by default."""
    return psf(lens, **{"model": model.name, "fields": lens.wavelengths.new_zeros(2, 1), **options})


def _relative(kernel: Tensor, other: Tensor) -> Tensor:
    return safe_divide((kernel - other).abs().sum(), other.sum())


def _anisotropy(covariance: Tensor) -> float:
    """√(larger/smaller eigenvalue) of a covariance (3,) mm²; 1 for a point."""
    short, long = torch.linalg.eigvalsh(covariance[[0, 1, 1, 2]].reshape(2, 2)).clamp_min(0).tolist()
    return math.sqrt(long / short) if short > 1e-18 else 1.0


def _about_light(lens: Lens, fields: Tensor, pixels: Grid, model: Model) -> Grid:
    """The pixels about the centroid of the light of a field (2, 1), as the least model that traces, or not, has it."""
    least = next(other for other in MODELS.values() if other.traces == model.traces)
    psfs = _psf(lens, least, fields=fields, grid=pixels, **least.compared)
    return dataclasses.replace(psfs.grid, centre=psfs.centroid[:, 0, 0].detach())


def _most_curved(lens: Lens) -> int:
    """Number of the most curved refracting or reflecting surface: the image and dummy surfaces may be curved, too."""
    indices = media(lens, lens.primary)
    strength = {
        k: abs(float(surface.curvature))
        for k, surface in enumerate(lens.surfaces[:-1])
        if k > 0 and surface.curvature is not None and (surface.is_mirror or indices[k] is not indices[k - 1])
    }
    if not strength:
        raise ValueError(
            "the comparison of PSF models changes a conic, but no refracting or reflecting surface of this lens is "
            "curved; ask for kernels of one model by `psf`"
        )
    return max(strength, key=strength.__getitem__)


def _with_conic(lens: Lens) -> Lens:
    k = _most_curved(lens)
    conic = lens.surfaces[k].conic
    return lens.replace(k, conic=_CONIC if conic is None else conic + _CONIC)


def _dark_ring(lens: Lens, model: Model, work: Mapping[str, Any]) -> float:
    """First minimum along x of the kernel of the slowed lens, below a twentieth of the peak; nan without one."""
    slow = torch.clamp(first_order(lens).f_number, min=_SLOW)
    slowed = dataclasses.replace(lens, aperture=SystemAperture("image_f_number", slow))
    airy = 1.2197e-3 * lens.wavelengths[0] * first_order(slowed).paraxial_working_f_number
    psfs = _psf(slowed, model, grid=grid(airy / _AIRY_PIXELS, (1, 4 * _AIRY_PIXELS + 1)), **work)
    line = psfs.kernel[0, 0, 0, 2 * _AIRY_PIXELS :].tolist()
    for i in range(1, len(line) - 1):
        a, b, c = line[i - 1 : i + 2]
        # A geometric kernel falls to 0 and stays there; a ring rises again.
        if a > b < c and b < 0.05 * line[0] and max(line[i:]) > 1e-3 * line[0]:
            return (i + 0.5 * (a - c) / (a - 2 * b + c)) / _AIRY_PIXELS
    return math.nan


def _parameters(lens: Lens, model: Model, work: Mapping[str, Any]) -> int:
    """Number of variables of the lens that change the kernel on a sensor 8 λN² behind its own: in no model a point."""
    surfaces, numbers = list(lens.surfaces), list[Tensor]()
    for k, surface in enumerate(surfaces[:-1]):
        changes: dict[str, Any] = {"thickness": surface.thickness}
        if surface.curvature is not None and float(surface.curvature) != 0:
            conic = torch.zeros_like(surface.thickness) if surface.conic is None else surface.conic
            changes |= {"curvature": surface.curvature, "conic": conic}
        changes = {key: number.detach().clone().requires_grad_() for key, number in changes.items()}
        numbers += changes.values()
        surfaces[k] = dataclasses.replace(surface, **changes)
    lens = dataclasses.replace(lens, surfaces=tuple(surfaces))
    number = first_order(lens).paraxial_working_f_number.detach()
    blur = 1e-3 * lens.wavelengths[0] * number
    lens = with_sensor_distance(lens, surfaces[-2].thickness + 8 * blur * number)
    work = {**work, "tol": 0.05} if "tol" in work else work
    psfs = _psf(lens, model, grid=grid(2 * blur, 5), **work)
    gradients = torch.autograd.grad(psfs.kernel.square().sum(), numbers, allow_unused=True)
    slopes = [float(gradient) for gradient in gradients if gradient is not None]
    return sum(math.isfinite(slope) and slope != 0 for slope in slopes)

"""Fields: optima of the closed form over fields, their error at each, and what windows hold of the light."""

import dataclasses
import statistics
import time
from collections.abc import Callable, Iterable, Sequence

import torch
from torch import Tensor

from raytrace.imaging.camera import Camera
from raytrace.imaging.image import transfer_functions
from raytrace.imaging.restoration import errors
from raytrace.studies.codesign import optima
from raytrace.studies.codesign.closed_form import even_distances
from raytrace.studies.codesign.experiment import camera
from raytrace.studies.codesign.kept import Kept, found_once
from raytrace.studies.codesign.optima import closed_form
from raytrace.studies.codesign.settings import MODELS, Settings
from raytrace.system.lens import Lens

_REPEATS = 5


@dataclasses.dataclass(frozen=True)
class Case:
    """One optimum to find."""

    settings: Settings


@dataclasses.dataclass(frozen=True)
class Row(optima.Place):
    """One optimum. window: pixels across; fields: those it is the optimum over; by_field: mean square errors there with
    DRT PSFs and one filter for all of them."""

    window: int = 0
    fields: tuple[float, ...] = ()
    by_field: tuple[float, ...] = ()

    def document(self) -> dict:
        """All of it, a number for the error at each field."""
        found = dataclasses.asdict(self)
        own = {f"error_drt_at_{field:g}": one for field, one in zip(self.fields, found.pop("by_field"), strict=True)}
        return {**found, "fields": " ".join(f"{field:g}" for field in self.fields), **own}


#: Columns of the table, before those of the errors by field.
COLUMNS = ("window", "fields", *optima.COLUMNS)


def cases(settings: Settings) -> list[Case]:
    """All optima: over all fields with the window of the settings and with the usual one, then on the axis alone."""
    over = [dataclasses.replace(settings, size=size) for size in dict.fromkeys((settings.size, Settings.size))]
    alone = [dataclasses.replace(settings, fields=(0.0,))] if any(settings.fields) else []
    return [Case(dataclasses.replace(one, model=model)) for one in (*over, *alone) for model in MODELS]


def fields(
    lens: Lens,
    settings: Settings,
    spectrum: Callable[[Settings], Tensor],
    *,
    progress: Callable[[Sequence[Case]], Iterable[Case]] = iter,
    kept: Kept | None = None,
) -> list[Row]:
    """The optimum of every case. spectrum: of the pictures, as large as these settings need it; else as for `sweep`."""
    pairs = found_once(cases(settings), lambda own: _found(lens, own, spectrum(own)), progress=progress, kept=kept)
    return [
        Row(
            **{**found, "by_field": tuple(found["by_field"])},
            window=case.settings.size,
            fields=case.settings.fields,
        )
        for case, found in pairs
    ]


def _found(lens: Lens, settings: Settings, spectrum: Tensor) -> dict:
    found = closed_form(lens, settings, spectrum)
    own = camera_at(lens, found.sensor_mm, dataclasses.replace(settings, model="drt", rays=None, drt_rays=None))
    by_field = error_by_field(own, spectrum, even_distances(own, spread=settings.spread))
    values = (*(getattr(found, name) for name in optima.COLUMNS), by_field.tolist())
    return dict(zip(FOUND, values, strict=True))


#: What an optimum is kept with.
FOUND = (*optima.COLUMNS, "by_field")


def camera_at(lens: Lens, sensor: float, settings: Settings) -> Camera:
    """The camera of settings with its sensor at a distance in mm."""
    return camera(lens, dataclasses.replace(settings, start=repr(sensor)))


@torch.no_grad()
def error_by_field(own: Camera, spectrum: Tensor, distances: Tensor) -> Tensor:
    """Mean square error (F,) at each field, by the filter that is best for all of them and all distances (Z,) mm."""
    kernels = torch.cat([own.kernels(distances, field) for field in range(own.fields.shape[1])])
    found = errors(transfer_functions(kernels, spectrum.shape[-1]), spectrum.to(kernels.dtype), own.noise)
    return found.reshape(own.fields.shape[1], len(distances)).mean(1)


ENERGY_COLUMNS = ("field", "pixels", "energy_nearest", "energy_mean")


@torch.no_grad()
def energies(own: Camera, sizes: Sequence[int], *, spread: str = "uniform") -> list[dict[str, float]]:
    """Part of the light through the entrance pupil that falls into windows so many pixels across, by field.

    own: a camera whose PSFs are normalised to energy and as large as the largest window. Of an object at the nearest
    distance, and the mean over the range.
    """
    nearest = own.fields.new_tensor([own.range[0]])
    distances, rows = torch.cat([nearest, even_distances(own, spread=spread)]), []
    for field, y in enumerate(own.fields[1].tolist()):
        kernels = own.kernels(distances, field)
        for size in sizes:
            cut = (kernels.shape[-1] - size) // 2
            inside = kernels[:, cut : cut + size, cut : cut + size].sum((-2, -1)).tolist()
            rows.append(dict(zip(ENERGY_COLUMNS, (y, size, inside[0], statistics.fmean(inside[1:])), strict=True)))
    return rows


TIME_COLUMNS = ("model", "field", "milliseconds")


def times(lens: Lens, settings: Settings, *, batch: int = 32) -> list[dict[str, float | str]]:
    """Median processor time in ms of the PSFs of an equal part of a batch at each field, and of their derivatives.

    In as many threads as torch has: processor time is the sum over them.
    """
    count, rows = -(-batch // len(settings.fields)), []
    for model in MODELS:
        own = camera(lens, dataclasses.replace(settings, model=model))
        distances = even_distances(own, count)
        rows += [
            dict(zip(TIME_COLUMNS, (model, y, _median_ms(own, distances, field)), strict=True))
            for field, y in enumerate(settings.fields)
        ]
    return rows


def _median_ms(own: Camera, distances: Tensor, field: int) -> float:
    found = []
    for _ in range(1 + _REPEATS):
        with torch.no_grad():  # as a step of training does: what the lens fixes is found anew
            for parameter in own.variables.parameters():
                parameter.add_(1e-9)
        start = time.process_time()
        own.kernels(distances, field).square().sum().backward()
        found.append(1e3 * (time.process_time() - start))
    return statistics.median(found[1:])

"""Ray listing: rays on the image, and the table of their positions and directions surface by surface."""

import csv
import dataclasses
import io
import itertools
import json
import math
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.files import write_atomically
from raytrace.io.ray_tables import read_rays
from raytrace.maths.numerics import value
from raytrace.maths.result import Result
from raytrace.system.lens import Lens, aligned, field_points, media, one_lens, vector, wavelengths_of
from raytrace.system.rays import COLUMNS, Rays
from raytrace.tracing.launch import rays as launched
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.ray_failures import STATUS, LostRays
from raytrace.tracing.trace import axial_path, sequence_of, steps, trace_lens
from raytrace.words import RaytraceWarning, calling_level, option

_OK, _VIGNETTED, _MISS, _TIR = (STATUS.index(name) for name in ("ok", "vignetted", "miss", "tir"))
_LOST = {_MISS: "missed", _TIR: "were totally reflected at", _VIGNETTED: "were vignetted at"}
_BATCH = 20_000  # rays whose table is held at a time


class ChangesNothing(RaytraceWarning):
    """An option has no effect on the result."""


#: Launch conditions of chief and marginal rays: mm, degrees or mm, µm, and fractions of the pupil.
LABELS = ("object_distance", "field_x", "field_y", "wavelength", "pupil_x", "pupil_y")


@value
class Traced(Rays, Result):
    """Rays (3, ...) on the image, and a table with a row for every ray and surface that it reaches, or fails at.

    lens, launched: the lens, and the rays in front of surface 1, with their wavelength; labels: (6, ...) LABELS of rays
    that `trace` launched. Rays that could not be launched are not in the table.
    """

    lens: Lens = dataclasses.field(kw_only=True)
    launched: Rays = dataclasses.field(kw_only=True)
    labels: Tensor | None = dataclasses.field(kw_only=True)

    @property
    def count(self) -> int:
        """Number of rays launched."""
        return int(self.launched.valid.sum())

    def columns(self) -> dict[str, Tensor]:
        parts = [*self._parts()]
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    def words(self) -> dict:
        return {"status": STATUS}

    def lost(self) -> list[dict]:
        """How many rays end at each surface, by status."""
        counts: Counter = Counter()
        for way in self._ways():
            before = torch.nn.functional.pad(way.status[:, :-1], (1, 0), value=_OK)
            for status in _LOST:
                newly = (way.shown & (way.status == status) & (before != status)).sum(0).tolist()
                counts.update({(k, STATUS[status]): n for k, n in enumerate(newly, 1) if n})
        return [{"surface": k, "status": status, "rays": n} for (k, status), n in sorted(counts.items())]

    def failures(self) -> list[str]:
        """The same as sentences."""
        lost = self.lost()
        return [f"{row['rays']} rays {_LOST[STATUS.index(row['status'])]} surface {row['surface']}" for row in lost]

    def document(self) -> dict:
        rows = [row for part in self._parts() for row in _rows(part)]
        return {"rays": self.count, "results": rows, "lost": self.lost()}

    def write_json(self, put: Callable[[str], object]) -> None:
        """Write the document in chunks, a line for each row of the table."""
        put(f'{{"rays": {self.count}, "results": [')
        separator = "\n"
        for part in self._parts():
            if lines := [json.dumps(row) for row in _rows(part)]:
                put(separator + ",\n".join(lines))
                separator = ",\n"
        put(f'\n], "lost": {json.dumps(self.lost())}}}\n')

    def write(self, put: Callable[[str], object], progress: Callable[[int], object] = lambda count: None) -> None:
        """Write the table as CSV in chunks; floats as the shortest text that reads back the same.

        progress: called with the number of rays of each chunk.
        """
        for first, part in enumerate(self._parts()):
            text = io.StringIO()
            writer = csv.writer(text, lineterminator="\n")
            writer.writerows([part] if first == 0 else [])
            writer.writerows(zip(*_cells(part), strict=True))
            put(text.getvalue())
            progress(min(_BATCH, self.count - first * _BATCH))

    def save(self, path: str | os.PathLike, progress: Callable[[int], object] = lambda count: None) -> None:
        """Write the table as .csv atomically; progress: as for `write`."""
        write_atomically(path, lambda file: self.write(lambda text: file.write(text.encode()), progress))

    def __str__(self) -> str:
        text = io.StringIO()
        self.write(text.write)
        return text.getvalue().rstrip("\n")

    def of_lens(self, number: int) -> "Traced":
        """The rays of one lens of a batch."""

        def ends(rays: Rays) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None]:
            path = rays.opl if rays.opl is None else rays.opl.expand(rays.shape)[number]
            return rays.position[:, number], rays.direction[:, number], rays.valid[number], path, rays.wavelength

        labels = None if self.labels is None else self.labels[:, number]
        launched = Rays(*ends(self.launched))
        return Traced(*ends(self), lens=one_lens(self.lens, number), launched=launched, labels=labels)

    def _parts(self) -> Iterator[dict[str, Tensor]]:
        """The columns of the table in chunks of _BATCH rays; of a batch with the number of the lens."""
        for number in range(self.lens.count or 0):
            for part in self.of_lens(number)._parts():
                yield {"lens": torch.full_like(part["ray"], number), **part}
        if self.lens.count is not None:
            return
        valid = self.launched.valid.flatten()
        labels = () if self.labels is None else self.labels.reshape(len(LABELS), -1)[:, valid]
        for first, way in zip(itertools.count(0, _BATCH), self._ways(), strict=False):
            chunk, (rays, surfaces) = slice(first, first + _BATCH), way.shown.shape
            index = torch.arange(max(rays, surfaces), device=way.shown.device)
            table = {"ray": index[:rays, None] + first, "surface": index[:surfaces] + 1}
            table |= dict(zip((*COLUMNS, "opl"), way.values, strict=True)) | {"status": way.status}
            table |= {name: column[chunk, None] for name, column in zip(LABELS, labels, strict=False)}
            yield {name: column.expand(way.shown.shape)[way.shown] for name, column in table.items()}

    def _ways(self) -> Iterator["_Way"]:
        """The surface data of the rays launched, in chunks of _BATCH rays."""
        if self.lens.count is not None:
            for number in range(self.lens.count):
                yield from self.of_lens(number)._ways()
            return
        rays, valid = self.launched, self.launched.valid.flatten()
        assert rays.wavelength is not None  # as `trace` gives it
        opl = torch.zeros_like(rays.position[0]) if rays.opl is None else rays.opl
        opl, wavelength = (t.detach().expand(rays.shape).flatten()[valid] for t in (opl, rays.wavelength))
        position, direction = (t.detach().reshape(3, -1)[:, valid] for t in (rays.position, rays.direction))
        for first in range(0, max(len(opl), 1), _BATCH):
            chunk = slice(first, first + _BATCH)
            rays = Rays(position[:, chunk], direction[:, chunk], valid[valid][chunk], opl[chunk])
            yield _way(self.lens, rays, wavelength[chunk])


def trace(
    lens: Lens,
    rays: Rays | str | os.PathLike | None = None,
    *,
    object_distances: Sequence[float] | Tensor | None = None,
    fields: Tensor | Sequence | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    ray_aiming: str | None = None,
) -> Traced:
    """Rays on the image surface, and a table of their positions and directions surface by surface.

    rays: in front of surface 1, as `rt.tracing.rays` returns them, or a table of rays (.csv) with columns x, y, z, l,
    m, n and optionally wavelength; rays without one have that of `wavelengths`, by default the primary one. By default:
    chief, upper, lower and side ray of every object distance, field and wavelength, batch shape (D, F, W, 4), or (F, W,
    4) for the lens's distance; fields as for `rt.tracing.rays`, wavelengths the primary one unless given. Rays of a
    batch of lenses have their axis first, (3, L, …). Paths count from the wavefront of the object point that passes the
    vertex of surface 1.
    """
    labels, lens = None, aligned(lens, 3)
    if rays is None:
        launched, labels = _chief_and_marginal(lens, object_distances, fields, wavelengths, ray_aiming)
    else:
        if object_distances is not None or fields is not None:
            placed = f"{option('object_distances')} and {option('fields')}"
            message = f"{placed} change nothing: a table defines where its rays start"
            warnings.warn(message, ChangesNothing, stacklevel=calling_level())
        launched = rays if isinstance(rays, Rays) else read_rays(rays, lens)
    wavelength = launched.wavelength
    if wavelength is None:
        wavelength = (lens.primary if wavelengths is None else wavelengths_of(lens, wavelengths)).squeeze()
        launched = dataclasses.replace(launched, wavelength=wavelength)
    end = trace_lens(lens, launched, wavelength)
    ends = end.position, end.direction, end.valid, end.opl, wavelength
    return Traced(*ends, lens=lens, launched=launched, labels=labels)


def _chief_and_marginal(
    lens: Lens,
    object_distances: Sequence[float] | Tensor | None,
    fields: Tensor | Sequence | None,
    wavelengths: Tensor | Sequence[float] | None,
    ray_aiming: str | None,
) -> tuple[Rays, Tensor]:
    pupil = lens.wavelengths.new_tensor([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, -1.0, 0.0]])
    fields = field_points(fields, like=lens)
    wavelengths = lens.primary[None] if wavelengths is None else wavelengths_of(lens, wavelengths)
    warn_of_filling(lens, fields, ray_aiming=ray_aiming)
    distance = lens.surfaces[0].thickness
    launch = partial(launched, fields=fields, pupil=pupil, wavelengths=wavelengths, ray_aiming=ray_aiming)
    if object_distances is None:
        rays = launch(lens)
    else:
        distance = vector(object_distances, like=lens).reshape(-1, 1, 1, 1)
        each = [launch(lens.at(object_distance=d)) for d in distance.flatten()]
        rays = Rays(
            torch.stack([rays.position for rays in each], 1),
            torch.stack([rays.direction for rays in each], 1),
            torch.stack([rays.valid for rays in each]),
            torch.stack([rays.opl for rays in each if rays.opl is not None]),
            wavelengths[:, None],
        )
    if unaimed := int((~rays.valid).sum()):
        message = f"{unaimed} rays could not be aimed at their points of the stop and are left out"
        warnings.warn(message, LostRays, stacklevel=calling_level())
    labels = (distance, *fields[:, :, None, None], wavelengths[:, None], *pupil)
    return rays, torch.stack([label.detach().expand(rays.shape) for label in labels])


class _Way(NamedTuple):
    """Whether a ray reaches each surface (P, K), its status there, and x, y, z, l, m, n and path (7, P, K) behind."""

    shown: Tensor
    status: Tensor
    values: Tensor


@torch.no_grad()
def _way(lens: Lens, rays: Rays, wavelength: Tensor) -> _Way:
    surfaces, indices = sequence_of(lens), media(lens, wavelength)
    ended = vignetted = torch.zeros_like(rays.valid)
    shown, status, values = [], [], []
    for k, crossing in enumerate(steps(surfaces, rays, indices=indices, wavelength=wavelength), 1):
        vignetted = vignetted | crossing.clipped
        state = torch.where(vignetted, _VIGNETTED, _OK)
        state = torch.where(crossing.totally_reflected, _TIR, torch.where(crossing.missed, _MISS, state))
        assert crossing.rays.opl is not None  # as the rays start with paths
        path = crossing.rays.opl + axial_path(surfaces[:k], indices[: k + 1])
        stopped = crossing.missed | crossing.totally_reflected
        shown.append(~ended)
        status.append(state)
        numbers = torch.stack([*crossing.rays.position, *crossing.rays.direction, path])
        values.append(torch.where(stopped, torch.nan, numbers))
        ended = ended | stopped
    return _Way(torch.stack(shown, -1), torch.stack(status, -1), torch.stack(values, -1))


def _cells(part: dict[str, Tensor]) -> list[list]:
    """The columns as numbers and words; None for nan."""
    plain = {name: column.tolist() for name, column in part.items()}
    plain["status"] = [STATUS[status] for status in plain["status"]]
    return [[None if cell != cell else cell for cell in column] for column in plain.values()]


def _rows(part: dict[str, Tensor]) -> list[dict]:
    columns = [[None if c in (math.inf, -math.inf) else c for c in column] for column in _cells(part)]
    return [dict(zip(part, row, strict=True)) for row in zip(*columns, strict=True)]

"""Ray listing: rays on the image, with the table of their way there, surface by surface."""

import csv
import dataclasses
import io
import json
import math
import os
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from raytrace.files import write_atomically
from raytrace.io.ray_tables import read_rays
from raytrace.maths.result import Result
from raytrace.maths.value import value
from raytrace.system.lens import Lens, field_points, media, vector, wavelengths_of
from raytrace.system.rays import COLUMNS, Rays
from raytrace.tracing.launch import rays as launched
from raytrace.tracing.launch import warn_of_filling
from raytrace.tracing.ray_failures import STATUS, LostRays
from raytrace.tracing.trace import axial_path, sequence_of, steps, trace_lens
from raytrace.words import calling_level

_OK, _VIGNETTED, _MISS, _TIR = (STATUS.index(name) for name in ("ok", "vignetted", "miss", "tir"))
_LOST = {_MISS: "missed", _TIR: "were totally reflected at", _VIGNETTED: "were vignetted at"}
_BATCH = 20_000  # rays whose table is held at a time


class ChangesNothing(UserWarning):
    """Something is asked for that makes no difference to what is done."""


#: What chief and marginal rays were launched for: mm, degrees or mm, µm, and fractions of the pupil.
LABELS = ("object_distance", "field_x", "field_y", "wavelength", "pupil_x", "pupil_y")


@value
class Traced(Rays, Result):
    """Rays (3, ...) on the image, and as a table: a row for every ray and surface that it reaches, or is lost at.

    lens, begun: the lens, and the rays in front of surface 1, with their wavelength; labels: (6, ...) LABELS, where the
    trace itself launched them. Rays that never set out are not in the table.
    """

    lens: Lens | None = None
    begun: Rays | None = None
    labels: Tensor | None = None

    @property
    def count(self) -> int:
        """How many rays set out."""
        return int(self.begun.valid.sum())

    def columns(self) -> dict[str, Tensor]:
        parts = [*self._parts()]
        return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}

    def words(self) -> dict:
        return {"status": STATUS}

    def lost(self) -> list[dict]:
        """How many rays end at which surface, and by what."""
        counts: Counter = Counter()
        for way in self._ways():
            before = torch.nn.functional.pad(way.status[:, :-1], (1, 0), value=_OK)
            for status in _LOST:
                newly = (way.shown & (way.status == status) & (before != status)).sum(0).tolist()
                counts.update({(k, STATUS[status]): n for k, n in enumerate(newly, 1) if n})
        return [{"surface": k, "status": status, "rays": n} for (k, status), n in sorted(counts.items())]

    def failures(self) -> list[str]:
        """The same in words."""
        words = {STATUS[status]: said for status, said in _LOST.items()}
        return [f"{one['rays']} rays {words[one['status']]} surface {one['surface']}" for one in self.lost()]

    def document(self) -> dict:
        rows = [row for part in self._parts() for row in _rows(part)]
        return {"rays": self.count, "results": rows, "lost": self.lost()}

    def write_json(self, put: Callable[[str], object]) -> None:
        """Write the document part by part, a line for each row of the table."""
        put(f'{{"rays": {self.count}, "results": [')
        separator = "\n"
        for part in self._parts():
            if lines := [json.dumps(row) for row in _rows(part)]:
                put(separator + ",\n".join(lines))
                separator = ",\n"
        put(f'\n], "lost": {json.dumps(self.lost())}}}\n')

    def write(self, put: Callable[[str], object], progress: Callable[[int], object] = lambda count: None) -> None:
        """Write the table as CSV part by part; every float as the shortest text that reads back the same.

        progress: called with the number of rays of each part.
        """
        for first, part in enumerate(self._parts()):
            text = io.StringIO()
            writer = csv.writer(text, lineterminator="\n")
            writer.writerows([part] if first == 0 else [])
            writer.writerows(zip(*_cells(part), strict=True))
            put(text.getvalue())
            progress(min(_BATCH, self.count - first * _BATCH))

    def save(self, path: str | os.PathLike, progress: Callable[[int], object] = lambda count: None) -> None:
        """Write the table as .csv, as a whole or not at all; progress: as for `write`."""
        write_atomically(path, lambda file: self.write(lambda text: file.write(text.encode()), progress))

    def __str__(self) -> str:
        text = io.StringIO()
        self.write(text.write)
        return text.getvalue().rstrip("\n")

    def _parts(self) -> Iterator[dict[str, Tensor]]:
        """The columns of the table, of so many rays at a time."""
        kept = self.begun.valid.flatten()
        labels = () if self.labels is None else self.labels.reshape(len(LABELS), -1)[:, kept]
        for place, way in enumerate(self._ways()):
            some = slice(place * _BATCH, (place + 1) * _BATCH)
            rays, surfaces = (torch.arange(n, device=way.shown.device) for n in way.shown.shape)
            table = {"ray": rays[:, None] + some.start, "surface": surfaces + 1}
            table |= dict(zip((*COLUMNS, "opl"), way.values, strict=True)) | {"status": way.status}
            table |= {name: column[some, None] for name, column in zip(LABELS, labels, strict=False)}
            yield {name: column.expand(way.shown.shape)[way.shown] for name, column in table.items()}

    def _ways(self) -> Iterator["_Way"]:
        rays = _flat(self.begun)
        for first in range(0, max(rays.valid.numel(), 1), _BATCH):
            some = slice(first, first + _BATCH)
            part = Rays(rays.position[:, some], rays.direction[:, some], rays.valid[some], rays.opl[some])
            yield _way(self.lens, part, rays.wavelength[some])


def trace(
    lens: Lens,
    rays: Rays | str | os.PathLike | None = None,
    *,
    object_distances: Sequence[float] | Tensor | None = None,
    fields: Tensor | Sequence | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    ray_aiming: str | None = None,
) -> Traced:
    """Rays on the image surface, and on demand the table of their way there.

    rays: in front of surface 1, as `rt.rays` gives them, or a table of rays (.csv) with columns x, y, z, l, m, n and
    perhaps wavelength; those without a wavelength have the one of `wavelengths`, by default the primary one. By default
    chief, upper, lower and side ray of every object distance, field and wavelength, batch shape (D, F, W, 4), or
    (F, W, 4) for the lens's own distance: fields as for `rt.rays`, wavelengths the primary one unless given. Their path
    counts from the wavefront of the object point that passes the vertex of surface 1.
    """
    labels = None
    if rays is None:
        begun, labels = _chief_and_marginal(lens, object_distances, fields, wavelengths, ray_aiming)
    else:
        if object_distances is not None or fields is not None:
            message = "`object_distances` and `fields` change nothing: a table defines where its rays start"
            warnings.warn(message, ChangesNothing, stacklevel=calling_level())
        begun = rays if isinstance(rays, Rays) else read_rays(rays, lens)
    if begun.wavelength is None:
        begun = dataclasses.replace(begun, wavelength=_chosen(lens, wavelengths).squeeze())
    end = trace_lens(lens, begun, begun.wavelength)
    return Traced(end.position, end.direction, end.valid, end.opl, begun.wavelength, lens, begun, labels)


def _chosen(lens: Lens, wavelengths: Tensor | Sequence[float] | None) -> Tensor:
    primary = lens.primary[None]
    return primary if wavelengths is None else wavelengths_of(lens, wavelengths)


def _chief_and_marginal(lens: Lens, object_distances, fields, wavelengths, ray_aiming) -> tuple[Rays, Tensor]:
    pupil = lens.wavelengths.new_tensor([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, -1.0, 0.0]])
    fields, wavelengths = field_points(fields, like=lens), _chosen(lens, wavelengths)
    warn_of_filling(lens, fields, ray_aiming=ray_aiming)
    distance = lens.surfaces[0].thickness
    how = {"fields": fields, "pupil": pupil, "wavelengths": wavelengths, "ray_aiming": ray_aiming}
    if object_distances is None:
        found = launched(lens, **how)
    else:
        distance = vector(object_distances, like=lens).reshape(-1, 1, 1, 1)
        each = [launched(lens.at(object_distance=d), **how) for d in distance.flatten()]
        parts = (torch.stack([getattr(one, name) for one in each], axis) for name, axis in _AXES.items())
        found = Rays(*parts, wavelength=wavelengths[:, None])
    if unaimed := int((~found.valid).sum()):
        message = f"{unaimed} rays could not be aimed at their points of the stop and are left out"
        warnings.warn(message, LostRays, stacklevel=calling_level())
    labels = (distance, *fields[:, :, None, None], wavelengths[:, None], *pupil)
    return found, torch.stack([label.detach().expand(found.shape) for label in labels])


_AXES = {"position": 1, "direction": 1, "valid": 0, "opl": 0}  # of Rays, where distances go


class _Way(NamedTuple):
    """Which of the surfaces (P, K) a ray reaches, its status there, and x, y, z, l, m, n and path (7, P, K) behind."""

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
        path = crossing.rays.opl + axial_path(surfaces[:k], indices[: k + 1])
        stopped = crossing.missed | crossing.totally_reflected
        found = torch.stack([*crossing.rays.position, *crossing.rays.direction, path])
        shown.append(~ended)
        status.append(state)
        values.append(torch.where(stopped, torch.nan, found))
        ended = ended | stopped
    return _Way(torch.stack(shown, -1), torch.stack(status, -1), torch.stack(values, -1))


def _flat(rays: Rays) -> Rays:
    """The rays that set out, in one row, with their path and wavelength."""
    kept = rays.valid.flatten()
    opl = torch.zeros_like(rays.position[0]) if rays.opl is None else rays.opl
    opl, wavelength = (t.detach().expand(rays.shape).flatten()[kept] for t in (opl, rays.wavelength))
    position, direction = (t.detach().reshape(3, -1)[:, kept] for t in (rays.position, rays.direction))
    return Rays(position, direction, kept[kept], opl, wavelength)


def _cells(part: dict[str, Tensor]) -> list[list]:
    """The columns as numbers and words; None for what is not there."""
    plain = {name: column.tolist() for name, column in part.items()} | {
        "status": [STATUS[s] for s in part["status"].tolist()]
    }
    return [[None if cell != cell else cell for cell in column] for column in plain.values()]


def _rows(part: dict[str, Tensor]) -> list[dict]:
    columns = [[None if c in (math.inf, -math.inf) else c for c in column] for column in _cells(part)]
    return [dict(zip(part, row, strict=True)) for row in zip(*columns, strict=True)]

"""Tables of rays: read the rays of `raytrace trace --rays`, write what became of them at every surface."""

import difflib
import json
import math
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import pandas
import torch

from raytrace.cli.door import CommandError, primary
from raytrace.optics.launch import launch
from raytrace.optics.trace import axial_path, media, steps
from raytrace.system.lens import Lens, check_media, with_object_distance
from raytrace.system.rays import Rays, start

COLUMNS = ("x", "y", "z", "l", "m", "n")
OUTPUT = ("ray", "surface", *COLUMNS, "opl", "status")
_BATCH = 20_000


@dataclass(frozen=True)
class Batch:
    """Rays (3, P) in front of surface 1 with their wavelengths (P,) µm, the number of the first, and names (P,)."""

    rays: Rays
    wavelength: torch.Tensor
    first: int
    names: dict[str, torch.Tensor] = field(default_factory=dict)


@dataclass
class Fates:
    """How many rays were lost where, and why."""

    lost: Counter = field(default_factory=Counter)

    def counts(self) -> list[dict]:
        return [{"surface": k, "status": status, "rays": n} for (k, status), n in sorted(self.lost.items())]

    def lines(self) -> list[str]:
        words = {"miss": "missed", "tir": "were totally reflected at", "vignetted": "were vignetted at"}
        return [f"{n} rays {words[status]} surface {k}" for (k, status), n in sorted(self.lost.items())]


def read(path: str, lens: Lens) -> tuple[Iterator[Batch], int]:
    """Batches of the rays in a CSV file and their number. Raises CommandError naming file, line and column.

    A ray without a wavelength has the primary one of the lens. Columns of words and those that `trace` itself writes
    are left out; any other is an error: a misspelt wavelength must not become the primary one.
    """
    try:
        with warnings.catch_warnings(), open(path, "rb") as file:
            warnings.simplefilter("error", pandas.errors.ParserWarning)  # a row longer than the header
            table = pandas.read_csv(file, skipinitialspace=True, dtype=str, index_col=False, skip_blank_lines=False)
    except FileNotFoundError:
        raise CommandError(f"{path}: no such file; expected a table of rays with columns {','.join(COLUMNS)}") from None
    except (pandas.errors.ParserError, pandas.errors.ParserWarning) as error:
        raise CommandError(f"{path}: a row has more entries than the header: {_words(error)}") from error
    except (pandas.errors.EmptyDataError, UnicodeDecodeError) as error:
        raise CommandError(f"{path}: not a table of rays: {_words(error)}") from error
    except OSError as error:
        raise CommandError(f"{path}: cannot be read: {error.strerror or error}") from error
    table.columns = [_words(name).lower() for name in table.columns]
    table = table.dropna(how="all")  # blank lines; the index still counts them
    lines = table.index.to_numpy() + 2
    missing = [name for name in COLUMNS if name not in table.columns]
    if missing:
        raise CommandError(
            f"{path}:1: column {missing[0]!r} is missing; expected a header {','.join(COLUMNS)}[,wavelength], "
            f"found {','.join(table.columns)}"
        )
    nameless = [k for k, name in enumerate(table.columns) if name.startswith("unnamed:")]
    empty = [k for k in nameless if k == 0 or table.iloc[:, k].isna().all()]  # a running number, a comma at the end
    _refuse_columns(table.iloc[:, [k for k in range(table.shape[1]) if k not in empty]], path)
    names = [*COLUMNS, *(["wavelength"] if "wavelength" in table.columns else [])]
    values = np.stack([_floats(table[name]) for name in names], axis=1).reshape(-1, len(names))
    wrong = np.argwhere(~np.isfinite(values))
    if len(wrong):
        row, column = wrong[0]
        found = table[names].iloc[row, column]
        found = repr(found) if isinstance(found, str) else "nothing"
        raise CommandError(f"{path}:{lines[row]}: column {names[column]}: expected a finite number, found {found}")
    pointless = np.flatnonzero((values[:, 3:6] == 0).all(1))
    if len(pointless):
        raise CommandError(f"{path}:{lines[pointless[0]]}: the direction l,m,n is 0,0,0; expected direction cosines")
    wavelengths = values[:, 6] if "wavelength" in table.columns else np.full(len(values), float(primary(lens)))
    negative = np.flatnonzero(~(wavelengths > 0))
    if len(negative):
        raise CommandError(f"{path}:{lines[negative[0]]}: wavelength {wavelengths[negative[0]]:g}: expected µm above 0")

    check_media(lens, torch.from_numpy(np.unique(wavelengths)), where=path)

    def batches() -> Iterator[Batch]:
        for first in range(0, len(values), _BATCH):
            part = torch.from_numpy(values[first : first + _BATCH, :6].T.copy())
            rays = start(part[:3], part[3:], torch.zeros_like(part[0]))
            yield Batch(rays, torch.from_numpy(wavelengths[first : first + _BATCH].copy()), first)

    return batches(), len(values)


def _refuse_columns(table: pandas.DataFrame, path: str) -> None:
    """Raise CommandError for a column that stands twice, and for one of numbers that is not known."""
    known, names = (*COLUMNS, "wavelength", *OUTPUT), list(table.columns)
    for k, name in enumerate(names):
        if name in names[:k]:
            raise CommandError(f"{path}:1: column {name[:40]!r} stands twice")
        if name not in known and np.isfinite(_floats(table.iloc[:, k])).any():
            near = difflib.get_close_matches(name, known, n=1) or ["wavelength"] * name.startswith(("wave", "λ", "lam"))
            meant = f"is {near[0]!r} meant?" if near else f"expected {','.join(COLUMNS)}[,wavelength]"
            raise CommandError(f"{path}:1: column {name[:40]!r} is not known; {meant}")


def _words(error: object) -> str:
    return " ".join(str(error).split())


def _floats(column: pandas.Series) -> np.ndarray:
    """The column as float64, every text read to the nearest double; nan where it is no number."""
    try:
        return column.to_numpy(dtype=np.float64, na_value=np.nan)
    except ValueError:
        return np.array([_float(entry) for entry in column])


def _float(entry: object) -> float:
    try:
        return float(entry)
    except (TypeError, ValueError):
        return math.nan


def chief_and_marginal(
    lens: Lens,
    *,
    object_distances: Sequence[float],
    fields: torch.Tensor,
    wavelengths: torch.Tensor,
    ray_aiming: str | None,
) -> tuple[list[Batch], int, int]:
    """Chief, upper, lower and side ray from every distance, field (2, F) and wavelength (W,); how many, and unaimed.

    Their path counts from the wavefront of the object point that passes the vertex of surface 1.
    """
    pupil = lens.wavelengths.new_tensor([[0.0, 0.0, 0.0, 1.0], [0.0, 1.0, -1.0, 0.0]])
    batches, count, unaimed = [], 0, 0
    for distance in object_distances:
        seen = with_object_distance(lens, distance)
        rays = launch(seen, pupil, fields=fields, wavelengths=wavelengths, ray_aiming=ray_aiming)
        aimed = rays.valid.flatten()
        names = {
            "object_distance": pupil.new_tensor(distance),
            "field_x": fields[0, :, None, None],
            "field_y": fields[1, :, None, None],
            "wavelength": wavelengths[:, None],
            "pupil_x": pupil[0],
            "pupil_y": pupil[1],
        }
        names = {name: column.expand(rays.shape).flatten()[aimed] for name, column in names.items()}
        position, direction = rays.position.reshape(3, -1)[:, aimed], rays.direction.reshape(3, -1)[:, aimed]
        kept = Rays(position, direction, aimed[aimed], rays.opl.flatten()[aimed])
        batches.append(Batch(kept, names["wavelength"], count, names))
        count, unaimed = count + int(aimed.sum()), unaimed + int((~aimed).sum())
    return batches, count, unaimed


def traced(lens: Lens, batch: Batch, fates: Fates) -> pandas.DataFrame:
    """One row per ray and surface that the ray reaches, or at which it is lost; columns OUTPUT."""
    surfaces, indices = lens.surfaces[1:], media(lens, batch.wavelength)
    count = len(batch.wavelength)
    ended = torch.zeros(count, dtype=torch.bool)
    vignetted = torch.zeros(count, dtype=torch.bool)
    frames = []
    for k, crossing in enumerate(steps(surfaces, batch.rays, indices=indices), 1):
        vignetted = vignetted | crossing.clipped
        stopped = crossing.missed | crossing.totally_reflected
        status = np.full(count, "ok", dtype=object)
        status[vignetted.numpy()] = "vignetted"
        status[crossing.missed.numpy()] = "miss"
        status[crossing.totally_reflected.numpy()] = "tir"
        opl = crossing.rays.opl + axial_path(surfaces[:k], indices[: k + 1])
        values = torch.stack([*crossing.rays.position, *crossing.rays.direction, opl])
        values = torch.where(stopped, math.nan, values)
        shown = ~ended
        frame = pandas.DataFrame(values[:, shown].T.numpy(), columns=[*COLUMNS, "opl"])
        frame.insert(0, "ray", batch.first + torch.arange(count)[shown].numpy())
        frame.insert(1, "surface", k)
        frame["status"] = status[shown.numpy()]
        for name, column in batch.names.items():
            frame[name] = column[shown].numpy()
        frames.append(frame)
        for name, mask in (
            ("miss", crossing.missed),
            ("tir", crossing.totally_reflected),
            ("vignetted", crossing.clipped),
        ):
            if bool((mask & ~ended).any()):
                fates.lost[k, name] += int((mask & ~ended).sum())
        ended = ended | stopped
    return pandas.concat(frames).sort_values(["ray", "surface"], kind="stable", ignore_index=True)


def write_json(put: Callable[[str], object], lens: Lens, batches: Iterable[Batch], total: int, fates: Fates) -> None:
    """Write one JSON document batch by batch: {"rays", "results": [row, …], "lost"}; null for an empty coordinate."""
    put(f'{{"rays": {total}, "results": [')
    separator = "\n"
    for batch in batches:
        rows = traced(lens, batch, fates).to_dict("records")
        put(separator + ",\n".join(json.dumps(_for_json(row)) for row in rows))
        separator = ",\n"
    put(f'\n], "lost": {json.dumps(fates.counts())}}}\n')


def _for_json(row: dict) -> dict:
    return {k: None if isinstance(entry, float) and not math.isfinite(entry) else entry for k, entry in row.items()}


def write_csv(
    put: Callable[[str], object], lens: Lens, batches: Iterable[Batch], fates: Fates, progress: Callable[[int], object]
) -> None:
    """Write the traced batches as CSV; every float as the shortest text that reads back the same.

    progress: called with the number of rays of each batch.
    """
    header = ",".join(OUTPUT)
    for batch in batches:
        if header:
            put(",".join([header, *batch.names]) + "\n")
            header = ""
        put(traced(lens, batch, fates).to_csv(header=False, index=False))
        progress(len(batch.wavelength))
    if header:
        put(header + "\n")

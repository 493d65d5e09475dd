"""Monte Carlo: the criterion of perturbed and compensated lenses, each seeded by its number; a file of the finished."""

import dataclasses
import math
from collections.abc import Callable
from os import PathLike
from typing import Any

import torch
from torch import Tensor

from raytrace.shards import Share, total
from raytrace.stores import Kind, Records, listed, number, record, whole
from raytrace.system.identity import digest, identity
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.study import CHUNK, Study
from raytrace.tolerancing.table import BadTolerance
from raytrace.tracing.compiled import WORTH_COMPILING, prepare

_JOURNAL = Kind(
    damaged=BadTolerance,
    advice="give a new name for the checkpoint",
    other=BadTolerance,
    refusal="{path} holds the trials of another study: {difference}; give a new name for the checkpoint",
)
_TRIALS = record({"first": whole(), "rows": listed(listed(number(infinite=True)))})


class _Trials:
    """Finished trials in a file: rows of criterion, light and compensators, by the number of their first trial."""

    def __init__(self, path: str | PathLike, study: Study, seed: int):
        rows = [dataclasses.astuple(row) for row in (*study.tolerances, *study.compensators)]
        about: dict[str, Any] = {"of": "raytrace tolerance", "lens": identity(study.lens)}
        about |= {"criterion": study.criterion.name, "seed": seed}
        about |= {"tolerances": digest(repr(rows), study.tolerances.test_wavelength)}
        about |= {"fields and pupil": digest([view.sampling for view in study.views]), "loss": study.loss}
        settings = [view.criterion.settings for view in study.views]
        about |= {"settings": digest(repr(settings))} if any(settings) else {}
        self.store = Records(path, about, _JOURNAL, _TRIALS)
        self.found = {record["first"]: record["rows"] for _, record in self.store.read()}

    def put(self, first: int, rows: Tensor) -> None:
        # JSON has no nan: a trial without light is infinite
        self.store.append({"first": first, "rows": torch.nan_to_num(rows, nan=math.inf).tolist()})


def monte_carlo(
    study: Study,
    trials: int,
    seed: int,
    *,
    checkpoint: str | PathLike | None,
    share: Share | None,
    progress: Callable[[int, str], Any] | None,
) -> tuple[Tensor, Tensor, Tensor]:
    """The criterion (T,) of the trials, the changes (T, C) of their compensators, and their share (T,) of the light."""
    lens, sampling, count, others = study.lens, study.sampling, len(study.tolerances), len(study.compensators)
    rays = sampling.fields.shape[1] * len(lens.wavelengths) * sampling.points.shape[-1]
    if trials * rays * len(lens.surfaces) >= WORTH_COMPILING:
        prepare()  # a batch of lenses is launched as one lens
    results = study.half.new_zeros(trials, 2 + others)
    chunks = [range(first, min(first + CHUNK, trials)) for first in range(0, trials, CHUNK)]
    mine = (share or Share()).of(range(len(chunks)))
    stored = _Trials(checkpoint, study, seed) if checkpoint is not None else None
    bar = progress(trials, "trial") if progress and trials else None
    for k in mine:
        part = chunks[k]
        rows = stored.found.get(part.start) if stored else None
        if rows is None or len(rows) != len(part):
            errors = draw_errors(study.tolerances, len(part), seed, first=part.start).to(study.half)
            q, changes, light = study.compensated(errors.reshape(len(part), count))
            rows = torch.cat([study.criterion.value(q)[:, None], light[:, None], changes], -1)
            if stored:
                stored.put(part.start, rows)
        results[part.start : part.stop] = torch.as_tensor(rows, dtype=results.dtype)
        if bar is not None:
            bar.update(len(part))
    if bar is not None:
        bar.close()
    if share is not None and share.processes > 1:
        results = total(results)
    return torch.where(results[:, 0].isfinite(), results[:, 0], torch.nan), results[:, 2:], results[:, 1]

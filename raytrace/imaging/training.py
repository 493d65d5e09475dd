"""Training: steps of an optimiser that may be interrupted at any moment and resume bit-identically.

A run is a folder: `settings.json`, `log.csv` (a row for each step) and `checkpoint.pt` (the last state, replaced as a
whole). Random numbers of a step do not depend on earlier ones, so that a resumed run repeats the steps since its
checkpoint bit by bit.

Several processes (`raytrace.shards`) share every batch: each takes its samples, and gradients are summed over all of
them. Only the first process writes.
"""

import csv
import io
import json
import math
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import torch
from torch import Tensor, nn

from raytrace.files import append_text, write_atomically
from raytrace.shards import Share, share, total
from raytrace.stores import DamagedLine, anything, mapped, read_document
from raytrace.tracing.compiled import prepare
from raytrace.words import calling_level

#: Numbers of a step by the name of their column in the log.
Record = dict[str, float]


class NotFinite(ArithmeticError, ValueError):
    """A loss or a gradient is not finite; the run stops, its last checkpoint remains."""


class OtherSettings(ValueError):
    """A run is resumed with settings other than its own."""


class DamagedRun(ValueError):
    """A file of a run cannot be read."""


def read_state(path: Path) -> dict:
    """The contents of a file of `torch.save`, on the processor: tensors and plain values only, nothing is executed.

    The archive is checked before torch reads it: lengths of its entries and their checksums. Raises DamagedRun.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if any(part.compress_type or part.file_size > path.stat().st_size for part in archive.infolist()):
                raise DamagedRun("its entries are longer than the file")
            if wrong := archive.testzip():
                raise DamagedRun(f"{wrong} does not match its checksum")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise DamagedRun(f"it holds a {type(state).__name__}")
    except Exception as error:  # zipfile and torch raise errors of any class
        reason = _words(error) or type(error).__name__
        raise DamagedRun(f"{path}: no checkpoint, or a damaged one ({reason}); remove it to begin anew") from error
    return state


def load_state(module: nn.Module, state: dict, path: Path, optimizer: torch.optim.Optimizer | None = None) -> int:
    """Load a checkpoint into a module, and an optimiser; returns its step. Raises DamagedRun."""
    try:
        step = state["step"]
        if not isinstance(step, int) or step < 0:
            raise TypeError(f"step {step!r}")
        module.load_state_dict(state["module"])
        if optimizer is not None:
            optimizer.load_state_dict(state["optimizer"])
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, IndexError) as error:
        raise DamagedRun(f"{path}: not a checkpoint of this run ({_words(error)}); choose another folder") from error
    return step


class Run:
    """A folder of a training run.

    settings: whatever decides the result, as JSON; a folder with others is refused with OtherSettings. usual: defaults
    of settings that an older folder does not have.
    """

    def __init__(self, folder: str | Path, settings: Mapping, *, usual: Mapping = MappingProxyType({})):
        self.folder = Path(folder)
        settings, usual = (json.loads(json.dumps(dict(values))) for values in (settings, usual))
        self.folder.mkdir(parents=True, exist_ok=True)
        file = self.folder / "settings.json"
        if not file.exists():
            if share().rank == 0:
                write_atomically(file, lambda stream: stream.write(json.dumps(settings, indent=1).encode()))
            return
        before = {key: value for key, value in usual.items() if key in settings} | read_json(file)
        differ = [
            f"{_words(key)} was {before.get(key)!r}, now {settings.get(key)!r}"
            for key in sorted({*before, *settings})
            if before.get(key) != settings.get(key)
        ]
        if differ:
            raise OtherSettings(f"{self.folder} holds another run: {'; '.join(differ)}; choose another folder")

    @property
    def checkpoint(self) -> Path:
        return self.folder / "checkpoint.pt"

    @property
    def log(self) -> Path:
        return self.folder / "log.csv"

    def save(self, state: dict) -> None:
        write_atomically(self.checkpoint, lambda file: torch.save(state, file))

    def load(self) -> dict | None:
        """The last checkpoint, on the processor, or None."""
        return read_state(self.checkpoint) if self.checkpoint.exists() else None

    def rows(self) -> list[dict[str, float]]:
        """The log, a dict for every step."""
        return read_log(self.log) if self.log.exists() else []

    def forget_after(self, step: int) -> None:
        """Drop rows of the log from `step` on: those that an interrupted run wrote after its last checkpoint."""
        if not self.log.exists():
            return
        header, *rows = _lines(self.log)
        kept = []
        for line, row in enumerate(rows, 2):
            if _numbers(row, len(header)) is not None:
                kept += [row] if int(row[0]) < step else []
            elif line <= len(rows):  # the last one may be incomplete
                words = f"found {_words(','.join(row))!r}, expected {len(header)} numbers; the line is dropped"
                warnings.warn(f"{self.log}, line {line}: {words}", DamagedLine, stacklevel=calling_level())
        write_atomically(self.log, lambda file: file.write(_csv([header, *kept]).encode()))

    def append(self, rows: list[tuple[int, Record]]) -> None:
        if rows:
            header = [] if self.log.exists() else [["step", *rows[0][1]]]
            append_text(self.log, _csv(header + [[step, *map(repr, record.values())] for step, record in rows]))


def read_log(path: Path) -> list[dict[str, float]]:
    """A log, a dict for every step. Raises DamagedRun."""
    header, *rows = _lines(path)
    records = []
    for line, row in enumerate(rows, 2):
        if (numbers := _numbers(row, len(header))) is None:
            expected = f"expected {len(header)} numbers, of {_words(','.join(header))}"
            raise DamagedRun(f"{path}, line {line}: found {_words(','.join(row))!r}, {expected}")
        records.append(dict(zip(header, numbers, strict=True)))
    return records


def _numbers(row: list[str], count: int) -> list[float] | None:
    """A row of a log, whose first number is its step; None of a damaged one."""
    try:
        numbers = list(map(float, row))
    except ValueError:
        return None
    is_whole = len(numbers) == count and not any(map(math.isnan, numbers)) and row[0].isdecimal()
    return numbers if is_whole else None


def _lines(path: Path) -> list[list[str]]:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return list(csv.reader(file)) or [[]]
    except (ValueError, csv.Error) as error:
        raise DamagedRun(f"{path}: no table of steps ({_words(error)})") from error


def read_json(path: Path) -> dict:
    """A document of settings or results. Raises DamagedRun."""
    return read_document(path, mapped(anything), DamagedRun, "remove the folder to begin anew")


def _words(error: object) -> str:
    return " ".join(str(error).split())[:400]


def _csv(rows: list[list]) -> str:
    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(rows)
    return text.getvalue()


def train(
    module: nn.Module,
    optimizer: torch.optim.Optimizer,
    loss: Callable[[int, Share], tuple[Tensor, Record]],
    *,
    steps: int,
    run: Run,
    every: int = 100,
    seconds: float = 60.0,
    after_step: Callable[[], None] = lambda: None,
    penalty: Callable[[], Tensor] | None = None,
) -> Iterator[tuple[int, Record]]:
    """The remaining steps, each taken when its item is taken from the iterator: (step, record of the log).

    loss: (step, share of this process) -> its part of the loss of the batch, to be summed over processes, and numbers
    for the log (of the first process); every, seconds: steps and time between checkpoints, whichever passes first;
    after_step: for example a projection; penalty: minimised together with the loss, equal in all processes. It is added
    for the gradient alone: the log has it in its own column.
    Raises NotFinite for a loss or a gradient that is not finite, before the step.
    """
    prepare()  # numbers must not depend on the moment at which the trace is compiled
    state, mine, saved_at = run.load(), share(), time.monotonic()
    step = 0 if state is None else load_state(module, state, run.checkpoint, optimizer)
    if mine.rank == 0:
        run.forget_after(step)
    rows: list[tuple[int, Record]] = []
    parameters = [p for p in module.parameters() if p.requires_grad]
    while step < steps:
        optimizer.zero_grad(set_to_none=True)
        value, record = loss(step, mine)
        added = None if penalty is None else penalty()
        # By one process: gradients are summed over processes.
        whole = value if added is None or mine.rank else value + added.to(value.dtype)
        if whole.requires_grad:
            whole.backward()
        summed = _sum_over_processes(parameters, value.detach())
        if not math.isfinite(summed):
            last = (
                f"the last checkpoint is {run.checkpoint}" if run.checkpoint.exists() else "no checkpoint was made yet"
            )
            raise NotFinite(f"step {step}: the loss is {summed}, or its gradient is none; {last}")
        optimizer.step()
        after_step()
        record = {"loss": summed} | ({} if added is None else {"penalty": float(added.detach())}) | record
        rows.append((step, record))
        step += 1
        due = step % every == 0 or step == steps or time.monotonic() - saved_at >= seconds
        if mine.rank == 0 and due:
            # The log first: rows after a checkpoint are dropped on resuming, missing ones could not be restored.
            run.append(rows)
            run.save({"step": step, "module": module.state_dict(), "optimizer": optimizer.state_dict()})
            rows, saved_at = [], time.monotonic()
        yield step - 1, record


def _sum_over_processes(parameters: list[nn.Parameter], value: Tensor) -> float:
    """Sum gradients and the loss over processes; NaN if any gradient is not finite."""
    if share().processes > 1:
        for parameter in parameters:
            # The sums are equal in all processes to the last bit, so that all take the same step.
            parameter.grad = total(torch.zeros_like(parameter) if parameter.grad is None else parameter.grad)
        value = total(value)
    finite = all(bool(torch.isfinite(p.grad).all()) for p in parameters if p.grad is not None)
    return float(value) if finite else math.nan

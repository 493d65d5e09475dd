"""Training: steps of an optimiser that may be killed at any moment and go on as if nothing had happened.

A run lives in a folder: `settings.json` (what it was asked for), `log.csv` (one row a step) and `checkpoint.pt` (the
last state, replaced as a whole). Nothing that a step draws depends on what was drawn before, so a resumed run repeats
the steps since its checkpoint bit by bit.

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

#: What a step reports: numbers by name, a column of the log each.
Record = dict[str, float]


class NotFinite(ArithmeticError, ValueError):
    """A loss or a gradient is not finite; the run stops, its last checkpoint remains."""


class OtherSettings(ValueError):
    """A run that is resumed with other settings than it was begun with."""


class DamagedRun(ValueError):
    """A file of a run that cannot be read: what it is, and what to do."""


def read_state(path: Path) -> dict:
    """What `torch.save` wrote, on the processor: tensors and plain values only, nothing is executed.

    The archive is checked before torch reads it: stored bytes as long as announced, with the right checksums.
    Raises DamagedRun.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if any(part.compress_type or part.file_size > path.stat().st_size for part in archive.infolist()):
                raise DamagedRun("its entries are longer than the file")
            wrong = archive.testzip()
            if wrong:
                raise DamagedRun(f"{wrong} does not match its checksum")
        state = torch.load(path, map_location="cpu", weights_only=True)
        if not isinstance(state, dict):
            raise DamagedRun(f"it holds a {type(state).__name__}")
    except Exception as error:  # zipfile and torch raise whatever their parsing meets
        reason = _words(error) or type(error).__name__
        raise DamagedRun(f"{path}: no checkpoint, or a damaged one ({reason}); remove it to begin anew") from error
    return state


def load_state(module: nn.Module, state: dict, path: Path, optimizer: torch.optim.Optimizer | None = None) -> int:
    """Bring a module, and an optimiser, to a checkpoint; the step it was made at. Raises DamagedRun."""
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

    settings: whatever decides the result, as JSON; a folder begun with others is refused with OtherSettings. usual:
    of settings that a folder may not know, begun when there was no other way.
    """

    def __init__(self, folder: str | Path, settings: Mapping, *, usual: Mapping = MappingProxyType({})):
        self.folder = Path(folder)
        self.settings, self.usual = (json.loads(json.dumps(dict(one))) for one in (settings, usual))
        self.folder.mkdir(parents=True, exist_ok=True)
        written = self.folder / "settings.json"
        if written.exists():
            self._compare(read_json(written))
        elif share().rank == 0:
            write_atomically(written, lambda file: file.write(json.dumps(self.settings, indent=1).encode()))

    def _compare(self, before: dict) -> None:
        before = {key: value for key, value in self.usual.items() if key in self.settings} | before
        differ = [
            f"{_words(key)} was {before.get(key)!r}, now {self.settings.get(key)!r}"
            for key in sorted({*before, *self.settings})
            if before.get(key) != self.settings.get(key)
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
        """The last checkpoint, or None; its tensors as they were, on the processor."""
        if not self.checkpoint.exists():
            return None
        return read_state(self.checkpoint)

    def rows(self) -> list[dict[str, float]]:
        """The log as numbers, a dict for every step."""
        return read_log(self.log) if self.log.exists() else []

    def forget_after(self, step: int) -> None:
        """Drop rows of the log from `step` on: those that a killed run wrote after its last checkpoint."""
        if not self.log.exists():
            return
        header, *rows = _lines(self.log)
        whole = [_numbers(row, len(header)) is not None for row in rows]
        for line, row in enumerate(rows[:-1], 2):  # the last one may be torn
            if not whole[line - 2]:
                words = f"found {_words(','.join(row))!r}, expected {len(header)} numbers; the line is dropped"
                warnings.warn(f"{self.log}, line {line}: {words}", DamagedLine, stacklevel=calling_level())
        kept = [row for row, is_whole in zip(rows, whole, strict=True) if is_whole and int(row[0]) < step]
        write_atomically(self.log, lambda file: file.write(_csv([header, *kept]).encode()))

    def append(self, rows: list[tuple[int, Record]]) -> None:
        if not rows:
            return
        new = not self.log.exists()
        header = [["step", *rows[0][1]]] if new else []
        lines = [[step, *(repr(value) for value in record.values())] for step, record in rows]
        append_text(self.log, _csv(header + lines))


def read_log(path: Path) -> list[dict[str, float]]:
    """A log as numbers, a dict for every step. Raises DamagedRun."""
    header, *rows = _lines(path)
    found = []
    for line, row in enumerate(rows, 2):
        if (numbers := _numbers(row, len(header))) is None:
            expected = f"expected {len(header)} numbers, of {_words(','.join(header))}"
            raise DamagedRun(f"{path}, line {line}: found {_words(','.join(row))!r}, {expected}")
        found.append(dict(zip(header, numbers, strict=True)))
    return found


def _numbers(row: list[str], count: int) -> list[float] | None:
    """A row of a log, whose first number is its step; None where it is damaged."""
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
    """Take the steps that are left, one for each item taken from this iterator: (step, what it reports).

    loss: (step, share of this process) -> its part of the loss of the batch, to be summed over processes, and numbers
    for the log (of the first process); every, seconds: steps and time between checkpoints, whichever passes first;
    after_step: a projection, say; penalty: what is made small beside the loss, the same in all processes. It is added
    for the gradient alone: the log has it in a column of its own.
    Raises NotFinite at a loss or a gradient that is no number, before it is stepped into.
    """
    prepare()  # numbers must not depend on when somebody else compiles the trace
    step, mine, kept_at = _resume(module, optimizer, run), share(), time.monotonic()
    rows: list[tuple[int, Record]] = []
    parameters = [p for p in module.parameters() if p.requires_grad]
    while step < steps:
        optimizer.zero_grad(set_to_none=True)
        value, record = loss(step, mine)
        added = None if penalty is None else penalty()
        # Once: gradients are summed over processes.
        whole = value if added is None or mine.rank else value + added.to(value.dtype)
        if whole.requires_grad:
            whole.backward()
        summed = _sum_over_processes(parameters, value.detach())
        if not math.isfinite(summed):
            kept = (
                f"the last checkpoint is {run.checkpoint}" if run.checkpoint.exists() else "no checkpoint was made yet"
            )
            raise NotFinite(f"step {step}: the loss is {summed}, or its gradient is none; {kept}")
        optimizer.step()
        after_step()
        record = {"loss": summed} | ({} if added is None else {"penalty": float(added.detach())}) | record
        rows.append((step, record))
        step += 1
        due = step % every == 0 or step == steps or time.monotonic() - kept_at >= seconds
        if mine.rank == 0 and due:
            # The log first: rows beyond a checkpoint are dropped on resuming, missing ones could not be made up.
            run.append(rows)
            run.save({"step": step, "module": module.state_dict(), "optimizer": optimizer.state_dict()})
            rows, kept_at = [], time.monotonic()
        yield step - 1, record


def _resume(module: nn.Module, optimizer: torch.optim.Optimizer, run: Run) -> int:
    """Bring module and optimiser to the last checkpoint; returns the step to go on with."""
    state = run.load()
    step = 0 if state is None else load_state(module, state, run.checkpoint, optimizer)
    if share().rank == 0:
        run.forget_after(step)
    return step


def _sum_over_processes(parameters: list[nn.Parameter], value: Tensor) -> float:
    """Sum gradients and the loss over processes; NaN if any gradient is not finite."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    if share().processes > 1:
        for parameter in parameters:
            # The sums are the same in all processes to the last bit, so all take the same step.
            mine = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
            parameter.grad = total(mine)
        value = total(value)
        gradients = [p.grad for p in parameters]
    finite = all(bool(torch.isfinite(g).all()) for g in gradients)
    return float(value) if finite else math.nan

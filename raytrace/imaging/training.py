"""Training: steps of an optimiser that may be interrupted at any moment and resume bit-identically.

A run is a folder: `settings.json`, `log.csv` (a row for each step) and `checkpoint.pt` (the last state, replaced as a
whole). The random numbers of a step depend on the seed and the number of the step alone, so that a resumed run is
bit-identical.

Several processes (`raytrace.shards`) share every batch: each takes its samples, and gradients are summed over all of
them. Only the first process writes.
"""

import io
import logging
import math
import time
import warnings
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import torch
from torch import Tensor, nn

from raytrace.files import write_atomically
from raytrace.shards import Share, share, total
from raytrace.stores import DamagedLine, Folder, Kind, Table, Unfit, anything, mapped, read_document, read_file
from raytrace.tracing.compiled import prepare
from raytrace.words import RaytraceError, calling_level

_LOG = logging.getLogger(__name__)
_MAX_BYTES = 1 << 34  # size of a checkpoint
_RESTART = "remove it to restart the training"

#: Numbers of a step by the name of their column in the log.
Record = dict[str, float]


#: Factor of the learning rate as a function of the progress of the training (0 to 1), so that runs resume.
SCHEDULES: dict[str, Callable[[float], float]] = {
    "constant": lambda part: 1.0,
    "linear": lambda part: 1 - part,
    "cosine": lambda part: 0.5 * (1 + math.cos(math.pi * part)),
}


class NotFinite(RaytraceError, ArithmeticError, ValueError):
    """A loss or a gradient is not finite; the run stops, its last checkpoint remains."""


class OtherSettings(RaytraceError, ValueError):
    """A run is resumed with settings other than those that it was started with."""


class DamagedRun(RaytraceError, ValueError):
    """A file of a run cannot be read."""


RUN = Kind(
    DamagedRun,
    "remove the folder to restart the training",
    OtherSettings,
    "{path} holds another run: {difference}; choose another folder",
)


def read_state(path: Path) -> dict:
    """The contents of a file of `torch.save`, on the processor: tensors and plain values; pickled code is not executed.

    The archive is checked before torch reads it: lengths of its entries and their checksums. Raises DamagedRun.
    """

    def decode(content: bytes) -> dict:
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                if any(part.compress_type or part.file_size > len(content) for part in archive.infolist()):
                    raise Unfit("its entries are longer than the file")
                if wrong := archive.testzip():
                    raise Unfit(f"{wrong} does not match its checksum")
            state = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
            if not isinstance(state, dict):
                raise Unfit(f"it contains a {type(state).__name__}; expected a dict")
        except Exception as error:  # zipfile and torch raise errors of any class
            raise Unfit(f"not a readable checkpoint ({_single_line(error) or type(error).__name__})") from error
        return state

    try:
        return read_file(path, decode, DamagedRun, _RESTART, _MAX_BYTES)
    except OSError as error:
        raise DamagedRun(f"{path}: not a readable checkpoint ({error.strerror}); {_RESTART}") from error


def write_state(path: Path, state: dict) -> None:
    """Replace a file that `read_state` reads."""
    write_atomically(path, lambda file: torch.save(state, file))


def load_state(module: nn.Module, state: dict, path: Path, optimizer: torch.optim.Optimizer | None = None) -> int:
    """Load a checkpoint into a module, and an optimiser; returns its step. Raises DamagedRun."""
    try:
        step = state["step"]
        if not isinstance(step, int) or step < 0:
            raise TypeError(f"step {step!r}: expected an integer ≥ 0")
        module.load_state_dict(state["module"])
        if optimizer is not None:
            optimizer.load_state_dict(state["optimizer"])
    except (KeyError, TypeError, ValueError, RuntimeError, AttributeError, IndexError) as error:
        raise DamagedRun(
            f"{path}: not a checkpoint of this run ({_single_line(error)}); choose another folder"
        ) from error
    return step


class Run(Folder):
    """A folder of a training run.

    settings: all inputs that determine the result, as JSON; a folder with others is refused with OtherSettings.
    usual: defaults of settings that an older folder does not have.
    """

    def __init__(self, folder: str | Path, settings: Mapping, *, usual: Mapping = MappingProxyType({})):
        super().__init__(folder, settings, RUN, usual=usual)
        self.checkpoint, self.log = self.path / "checkpoint.pt", self.path / "log.csv"

    def save(self, state: dict) -> None:
        write_state(self.checkpoint, state)

    def load(self) -> dict | None:
        """The last checkpoint, on the processor, or None."""
        return read_state(self.checkpoint) if self.checkpoint.exists() else None

    def rows(self) -> list[dict[str, float]]:
        """The log, a dict for every step. Raises DamagedRun."""
        return read_log(self.log) if self.log.exists() else []

    def drop_rows_from(self, step: int) -> None:
        """Drop the rows of the log from `step` on, which an interrupted run wrote after its last checkpoint."""
        if self.log.exists():
            log = Table(self.log)
            header, rows, damaged = log.scan(RUN.damaged, RUN.advice)
            for message in damaged:
                warnings.warn(f"{message}; the line is dropped", DamagedLine, stacklevel=calling_level())
            log.begin(header or [], *(row for _, row in rows if row[0] < step))

    def append(self, rows: list[tuple[int, Record]]) -> None:
        if rows:
            log = Table(self.log)
            header = [] if self.log.exists() else [["step", *rows[0][1]]]
            log.append(*header, *([step, *map(float, record.values())] for step, record in rows))


def read_log(path: Path) -> list[dict[str, float]]:
    """A log, a dict for every step. Raises DamagedRun."""
    header, rows, damaged = Table(path).scan(RUN.damaged, RUN.advice)
    if damaged:
        raise DamagedRun(damaged[0])
    return [dict(zip(header, row, strict=True)) for _, row in rows]


def read_json(path: Path) -> dict:
    """A document of settings or results. Raises DamagedRun."""
    return read_document(path, mapped(anything), RUN.damaged, RUN.advice)


def _single_line(error: object) -> str:
    return " ".join(str(error).split())[:400]


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
    schedule: str | None = None,
) -> Iterator[tuple[int, Record]]:
    """Iterator over the remaining steps: each `next()` performs one training step and yields (step, record of the log).

    loss: (step, share of this process) -> the share of this process of the loss of the batch, which is summed over
    processes, and values for the log, which the first process alone writes. every, seconds: steps and time between
    checkpoints, whichever passes first. after_step: called after each step of the optimiser, as to project variables
    onto their bounds. penalty: added to the loss for the gradient, equal in all processes; the log has it in the column
    `penalty`, not in `loss`. schedule: of the learning rates of the optimiser, one of SCHEDULES; by default `loss` may
    set them.
    Raises NotFinite for a loss or a gradient that is not finite, before the step.
    """
    prepare()  # compiled first: results must not depend on the moment of compilation
    rates = [group["lr"] for group in optimizer.param_groups]  # before a checkpoint sets those of its step
    state, process_share, saved_at = run.load(), share(), time.monotonic()
    step = 0 if state is None else load_state(module, state, run.checkpoint, optimizer)
    if process_share.rank == 0:
        run.drop_rows_from(step)
    rows: list[tuple[int, Record]] = []
    parameters = [p for p in module.parameters() if p.requires_grad]
    while step < steps:
        if schedule is not None:
            for group, rate in zip(optimizer.param_groups, rates, strict=True):
                group["lr"] = rate * SCHEDULES[schedule](step / steps)
        optimizer.zero_grad(set_to_none=True)
        value, record = loss(step, process_share)
        penalty_value = None if penalty is None else penalty()
        # Only the first process adds the penalty, because gradients are summed over processes.
        objective = value if penalty_value is None or process_share.rank else value + penalty_value.to(value.dtype)
        if objective.requires_grad:
            objective.backward()
        total_loss, has_gradient = _sum_over_processes(parameters, value.detach())
        if not (has_gradient and math.isfinite(total_loss)):
            problem = "a gradient is not finite" if math.isfinite(total_loss) else f"the loss is {total_loss}"
            last = f"last checkpoint: {run.checkpoint}" if run.checkpoint.exists() else "no checkpoint was written yet"
            raise NotFinite(f"step {step}: {problem}; lower the learning rate; {last}")
        optimizer.step()
        after_step()
        record = (
            {"loss": total_loss}
            | ({} if penalty_value is None else {"penalty": float(penalty_value.detach())})
            | record
        )
        rows.append((step, record))
        step += 1
        due = step % every == 0 or step == steps or time.monotonic() - saved_at >= seconds
        if process_share.rank == 0 and due:
            # The log before the checkpoint: a resumed run drops surplus rows and cannot restore missing ones.
            run.append(rows)
            run.save({"step": step, "module": module.state_dict(), "optimizer": optimizer.state_dict()})
            _LOG.info("step %d of %d: loss %.6g", step, steps, total_loss)
            rows, saved_at = [], time.monotonic()
        yield step - 1, record


def _sum_over_processes(parameters: list[nn.Parameter], value: Tensor) -> tuple[float, bool]:
    """Sum gradients and the loss over processes; returns the loss, and whether all gradients are finite."""
    if share().processes > 1:
        for parameter in parameters:
            # The sums are equal in all processes to the last bit, so that all take the same step.
            parameter.grad = total(torch.zeros_like(parameter) if parameter.grad is None else parameter.grad)
        value = total(value)
    return float(value), all(bool(torch.isfinite(p.grad).all()) for p in parameters if p.grad is not None)

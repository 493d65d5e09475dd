"""Shards: processes started by torchrun that compute one result together, and end together.

    torchrun --nproc-per-node 2 -m raytrace psf LENS …

Every process takes its `Share`; `total` sums the parts, in all of them; within `agreeing` they also take the same
decisions and fail together. In a single process they do nothing.
"""

import contextlib
import dataclasses
import importlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from typing import NoReturn

import torch
from torch import Tensor, distributed

from raytrace.words import RaytraceError

_NUMBERS = 8  # agreed on at once, at most
_PATIENCE = 600.0  # s that processes wait for each other to start
_COURTESY = 10.0  # s that a process with an error waits for the first process to report it


class ProcessLost(RaytraceError, ConnectionError):
    """Another process of the job has ended; this one ends as well."""


class FailedElsewhere(RaytraceError, ValueError):
    """Another process of the job refused its share; the message is that of its error."""


@dataclasses.dataclass(frozen=True)
class Share:
    """The share of one process: samples `rank`, `rank + processes`, …, or part number `rank` of a row."""

    rank: int = 0
    processes: int = 1

    def of(self, samples: range) -> list[int]:
        return list(samples[self.rank :: self.processes])

    def part(self, count: int) -> slice:
        """Contiguous part of `count` entries; the sizes of parts differ by at most one."""
        return slice(count * self.rank // self.processes, count * (self.rank + 1) // self.processes)


def share() -> Share:
    """The share of this process: all, unless torch.distributed is running."""
    if distributed.is_available() and distributed.is_initialized():
        return Share(distributed.get_rank(), distributed.get_world_size())
    return Share()


# -- communication between processes -----------------------------------------------------------------------------------


def total(part: Tensor) -> Tensor:
    """The sum of a tensor over all processes, bit-identical in all of them; without gradient. Raises ProcessLost."""
    if share().processes == 1:
        return part
    part = part.detach().clone(memory_format=torch.contiguous_format)
    _reduce(part, "SUM")
    return part


def gathered(part: Tensor) -> Tensor:
    """(processes, ...) from the tensor (...) of each process, of one shape in all; without gradient."""
    mine = share()
    rows = part.new_zeros(mine.processes, *part.shape)
    rows[mine.rank] = part.detach()
    return total(rows)


@contextlib.contextmanager
def agreeing() -> Iterator[Callable[[Tensor], Tensor]]:
    """Each process computes a part of one result, with the same decisions; an error in one is raised by all.

    Yields a function from numbers () or (K,), K < 8, to the maximum of each over all processes, without gradient, which
    every process calls equally often in the block. Errors of others are raised there, or at its end.
    """
    if share().processes == 1:
        yield lambda numbers: numbers
        return
    try:
        yield _agree
        _agree(torch.zeros(0))
    except (ProcessLost, FailedElsewhere):
        raise
    except Exception as error:
        _agree(torch.zeros(0), error)
        raise


def _agree(numbers: Tensor, error: Exception | None = None) -> Tensor:
    """The maximum of each number over processes; an error of another process is raised as FailedElsewhere."""
    mine = share()
    message = torch.zeros(_NUMBERS, dtype=torch.float64)  # on the CPU, where all processes can meet
    message[0] = 0 if error is None else mine.rank + 1
    message[1 : 1 + numbers.numel()] = numbers.detach().reshape(-1)
    _reduce(message, "MAX")
    failed = int(message[0])
    if failed:
        expected = isinstance(error, ValueError | LookupError | OSError)
        text = [f"{error}" if expected else f"{type(error).__name__}: {error}"]
        distributed.broadcast_object_list(text, src=failed - 1, device=torch.device("cpu"))
        if error is None:
            raise FailedElsewhere(text[0])
    return message[1 : 1 + numbers.numel()].reshape(numbers.shape).to(numbers)


def _reduce(numbers: Tensor, operation: str) -> None:
    """Combine a tensor in place over processes: "SUM" or "MAX"."""
    try:
        distributed.all_reduce(numbers, getattr(distributed.ReduceOp, operation))
        return
    except RuntimeError:
        pass  # its traceback would keep the process group alive: it is let go before the next line
    raise ProcessLost("another process of this job has ended before its share was done")


# -- start and end -----------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Within the block, this number of threads of torch."""
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@contextlib.contextmanager
def processes() -> Iterator[Share]:
    """Within the block, the processes of torchrun, of which only the first prints. Without torchrun, this process.

    Tensors on the CPU are sent by gloo, those on a GPU by NCCL; each process has its own GPU where there are enough. An
    error ends all processes: one raises it, if possible the first; the others raise SystemExit.
    """
    if not (distributed.is_available() and distributed.is_torchelastic_launched()):
        yield Share()
        return
    with _ended_by_signals():
        store = _begin()
        try:
            with contextlib.ExitStack() as stack:
                if share().rank:
                    nowhere = stack.enter_context(open(os.devnull, "w"))
                    stack.enter_context(contextlib.redirect_stdout(nowhere))
                    stack.enter_context(contextlib.redirect_stderr(nowhere))
                yield share()
        except BaseException as error:
            if not _reports(error, store):
                raise SystemExit(1) from None
            raise
        finally:
            distributed.destroy_process_group()


def _begin() -> "distributed.Store":
    """Start the process group once all processes are there; the store, kept by torchrun, outlives them."""
    # Its functions take the current group as a default argument, and an optimiser imports it at the first step: then
    # the group would outlive its end, and its threads, killed at the exit of the interpreter, would abort the process.
    importlib.import_module("torch.distributed.nn.functional")
    store, rank, count = next(iter(distributed.rendezvous("env://")))
    store = distributed.PrefixStore("raytrace", store)
    store.set(f"here {rank}", "")
    # Not left to the process group: it waits where no signal arrives.
    if not _wait(lambda: store.check([f"here {other}" for other in range(count)]), _PATIENCE):
        raise ProcessLost(f"not all of {count} processes have started after {_PATIENCE:.0f} s")
    gpus = torch.cuda.device_count()
    has_own_gpu = gpus >= int(os.environ.get("LOCAL_WORLD_SIZE", count)) > 0
    if has_own_gpu:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", rank)))
    backend = "cpu:gloo,cuda:nccl" if has_own_gpu else "gloo"
    distributed.init_process_group(backend, store=store, rank=rank, world_size=count)
    return store


@contextlib.contextmanager
def _ended_by_signals() -> Iterator[None]:
    """Within the block, SIGTERM, by which torchrun ends the others if a process fails, raises: files are cleaned up."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: object) -> NoReturn:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        raise ProcessLost("ended by torchrun, because another process of this job has failed")

    before = signal.signal(signal.SIGTERM, end)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)


def _reports(error: BaseException, store: "distributed.Store") -> bool:
    """Whether this process reports the error: the first if it fails as well, else any single one."""
    if threading.current_thread() is threading.main_thread():
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    with contextlib.suppress(RuntimeError):  # torchrun itself is gone, and the store with it
        if share().rank == 0:
            store.set("first failed", "")
        else:
            lost = isinstance(error, ProcessLost)
            if _wait(lambda: store.check(["first failed"]), 1.0 if lost else _COURTESY):
                return False
        return store.add("speakers", 1) == 1
    return True


def _wait(condition: Callable[[], bool], seconds: float) -> bool:
    """Whether a condition becomes true within a time in which signals are received."""
    until = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > until:
            return False
        time.sleep(0.02)
    return True

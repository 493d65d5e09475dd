"""Session of the viewer: a state with its file and its optimisation. An event of the page gives a reply for it."""

import dataclasses
import os
import threading
import time
from collections.abc import Mapping
from pathlib import Path

from raytrace.io import WRITTEN, write_lens
from raytrace.optimization.checkpoint import STOPPED
from raytrace.optimization.least_squares import Cycle
from raytrace.optimization.optimize import optimize
from raytrace.optimization.optimized import Optimized
from raytrace.system.lens import Lens
from raytrace.tracing.compiled import prepare
from raytrace.viewer.compute import mtf_of_field, refresh, remarks
from raytrace.viewer.state import (
    EVENTS,
    FIELD,
    FLAG,
    TEXT,
    WHOLE,
    Event,
    State,
    edited,
    in_words,
    initial,
    merit_of,
    named,
    reduce,
    refusal,
    requirements,
    variables,
)

#: All events: those of a session and those of its state.
SESSION_EVENTS = {
    "open": Event({}),
    "save": Event({"path": TEXT, "overwrite": FLAG}),
    "settle": Event({"field": FIELD}),
    "optimise": Event({}),
    "progress": Event({"cycles": WHOLE}),
    "stop": Event({}),
    **EVENTS,
}
#: Events that change what is shown but not the lens: they are answered while an optimisation runs.
_VIEWS = ("open", "compare", "frequency")
_SHOWN = 4  # requirements of the file that are listed


class Optimisation:
    """An optimisation in a thread: `lens` of its last cycle, `merits` of all of them, and its result or failure."""

    def __init__(self, state: State):
        self.lens, self.is_stopped = state.lens, False
        self.merits: list[float] = []
        self.required = in_words(state.lens, requirements(state.lens))
        self.result: Optimized | None = None
        self.failure = ""
        self.thread = threading.Thread(target=self._run, args=(state,), daemon=True)
        self.thread.start()

    def _run(self, state: State) -> None:
        try:
            self.result = optimize(state.lens, merit=merit_of(state), vary=variables(state), watch=self._watch)
        except (Exception, KeyboardInterrupt) as error:  # whatever it is, the page shows it
            self.failure = str(error) or type(error).__name__

    def _watch(self, cycle: Cycle, lens: Lens) -> None:
        if self.is_stopped:
            raise KeyboardInterrupt
        self.lens = lens
        self.merits.append(cycle.merit)

    @property
    def words(self) -> str:
        count = f"{len(self.merits)} cycle{'' if len(self.merits) == 1 else 's'}"
        if self.result is not None:
            end, rows = self.result.lens, self.result.merit
            missed = [str(named(end, rows, condition)) for condition in self.result.conditions if not condition.met]
            before, after = self.result.merit_before, self.result.merit_after
            reason = STOPPED[self.result.stopped]
            return "; ".join([f"{count}, merit {before:.6g} → {after:.6g}: {reason}", *self._of_file, *missed])
        running = f"{count}, merit {self.merits[-1]:.6g}" if self.merits else "before the first cycle"
        return "; ".join([running, *self._of_file])

    @property
    def _of_file(self) -> list[str]:
        """The requirements of the file, in words."""
        more = f", and {len(self.required) - _SHOWN} more" if len(self.required) > _SHOWN else ""
        return [f"with {', '.join(self.required[:_SHOWN])}{more} of the file"] if self.required else []


class Session:
    """One page: its state, the file of the lens (None of a lens without one) and the optimisation that runs."""

    def __init__(self, lens: Lens, file: Path | None = None):
        prepare()
        self.state, self.file = initial(lens), file
        self.optimisation: Optimisation | None = None
        self._lock = threading.Lock()

    def answer(self, event: Mapping) -> dict:
        """The reply to an event: `message`, and what changed. Sessions answer at the same time, each in its thread."""
        with self._lock:
            started = time.perf_counter()
            reply = self._answer(event)
        return {"message": "", **reply, "milliseconds": 1e3 * (time.perf_counter() - started)}

    @property
    def shown(self) -> State:
        """The state, with the lens of the optimisation that runs."""
        return self.state if self.optimisation is None else dataclasses.replace(self.state, lens=self.optimisation.lens)

    def _answer(self, event: Mapping) -> dict:
        if words := refusal(event, SESSION_EVENTS):
            return {"message": words}
        kind = event["type"]
        if kind == "save":
            return {"message": self.save(event.get("path", ""), overwrite=event.get("overwrite", False))}
        if kind == "settle":  # field by field, so that no drag waits for long
            field = event.get("field")
            return {"remarks": remarks(self.state)} if field is None else mtf_of_field(self.state, field)
        if kind in ("progress", "stop"):
            return self._progress(event.get("cycles", 0), stop=kind == "stop")
        if self.optimisation is not None and kind not in _VIEWS:
            return {"message": "an optimisation is running: stop it, or wait for its end"}
        if kind == "optimise":
            if not self.state.vary:
                return {"message": "nothing varies: tick the variables first"}
            self.optimisation = Optimisation(self.state)
            return self._progress(0)
        if kind == "open":
            path = str(self.file.with_stem(f"{self.file.stem}_edited")) if self.file else "lens.zmx"
            return {**refresh(self.shown), "path": path, "formats": WRITTEN, **self._progress(0)}
        self.state = reduce(self.state, event)
        return {**refresh(self.shown), **({"refused": True} if self.state.message else {})}

    def _progress(self, cycles: int, *, stop: bool = False) -> dict:
        """The optimisation, with the numbers of its lens if it has passed more cycles; its end is one step of undo."""
        work = self.optimisation
        if work is None:
            return {"optimisation": None}
        runs = work.thread.is_alive() and not stop
        document = {"running": runs, "words": work.words, "merits": work.merits[-400:], "cycles": len(work.merits)}
        if runs:
            return {"optimisation": document, **(refresh(self.shown) if len(work.merits) > cycles else {})}
        self.optimisation, work.is_stopped = None, True
        if work.failure:
            return {**refresh(self.state), "optimisation": document, "message": work.failure}
        if work.merits or work.result:
            self.state = edited(self.state, work.result.lens if work.result else work.lens)
        words = f"{work.words}; stopped" if stop else work.words
        return {"optimisation": {**document, "words": words}, **refresh(self.state)}

    def save(self, path: str, *, overwrite: bool = False) -> str:
        """Write the lens in the format of the suffix; a file that exists is replaced if `overwrite`. In words."""
        target = Path(os.path.expanduser(path))  # which leaves the home of an unknown user as it is
        if not path.strip():
            return "save: give the name of a file, as lens.zmx"
        if target.is_file() and not overwrite:
            return f"save: {target} exists; tick “replace” to write over it, or give another name"
        try:
            write_lens(self.state.lens, target)
        except (OSError, ValueError, LookupError) as error:
            return f"save: {error}"
        return f"written: {target.resolve()}"

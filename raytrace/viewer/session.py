"""Session of the viewer: a state with its file and its optimisation. An event of the page gives a reply for it."""

import threading
import time
from collections.abc import Mapping
from pathlib import Path

from raytrace.io import write_lens
from raytrace.optimization.optimize import Optimized, optimize
from raytrace.system.lens import Lens
from raytrace.tracing.compiled import prepare
from raytrace.viewer.compute import mtf_of_field, refresh, remarks
from raytrace.viewer.state import State, edited, initial, merit_of, reduce, variables

#: Analyses change the filters of warnings, which all threads share: one event is answered at a time.
_ONE_AT_A_TIME = threading.Lock()


class Optimisation:
    """An optimisation in a thread; it is its own progress bar, as `optimize` calls it."""

    def __init__(self, state: State):
        self.cycles, self.merits, self.words, self.stopping = 0, [], "", False
        self.result: Optimized | None = None
        self.failure = ""
        self.thread = threading.Thread(target=self._run, args=(state,), daemon=True)
        self.thread.start()

    def _run(self, state: State) -> None:
        try:
            self.result = optimize(
                state.lens, merit=merit_of(state), vary=variables(state), progress=lambda work, unit: self
            )
        except KeyboardInterrupt:
            self.failure = "stopped before the first cycle"
        except (ValueError, RuntimeError, LookupError) as error:
            self.failure = str(error)

    def update(self, cycles: int) -> None:
        self.cycles += cycles
        if self.stopping:
            raise KeyboardInterrupt  # ends the descent with its best lens

    def set_postfix_str(self, words: str) -> None:
        self.words = words
        self.merits.append(float(words.split()[1].rstrip(",")))

    def close(self) -> None:
        """The descent has ended; its result is evaluated."""

    def document(self) -> dict:
        return {
            "running": self.thread.is_alive(),
            "cycles": self.cycles,
            "words": self.words,
            "merits": self.merits[-400:],
            "failure": self.failure,
        }


class Session:
    """One page: its state, the file of the lens (None of a lens without one) and the optimisation that runs."""

    def __init__(self, lens: Lens, file: Path | None = None):
        prepare()
        self.state, self.file, self.optimisation = initial(lens), file, None

    def answer(self, event: Mapping) -> dict:
        """The reply to an event: `message`, and what changed."""
        started = time.perf_counter()
        with _ONE_AT_A_TIME:
            reply = self._answer(event)
        return {"message": "", **reply, "milliseconds": 1e3 * (time.perf_counter() - started)}

    def _answer(self, event: Mapping) -> dict:
        kind = event.get("type")
        if kind == "progress":
            return self._progress()
        if kind == "stop":
            if self.optimisation is not None:
                self.optimisation.stopping = True
            return self._progress()
        if kind == "save":
            return {"message": self.save(str(event.get("path") or ""), overwrite=bool(event.get("overwrite")))}
        if kind == "settle":  # field by field, so that no drag waits for long
            field = event.get("field")
            return {"remarks": remarks(self.state)} if field is None else mtf_of_field(self.state, int(field))
        if self.optimisation is not None:
            return {"message": "an optimisation is running: stop it, or wait for its end"}
        if kind == "optimise":
            if not self.state.vary:
                return {"message": "nothing varies: tick the variables first"}
            self.optimisation = Optimisation(self.state)
            return self._progress()
        if kind != "open":
            self.state = reduce(self.state, event)
            if self.state.message:
                return {"message": self.state.message, "refused": True, **refresh(self.state)}
        saved = str(self.file.with_stem(f"{self.file.stem}_edited")) if self.file else "lens.zmx"
        return {**refresh(self.state), **({"path": saved} if kind == "open" else {})}

    def _progress(self) -> dict:
        if self.optimisation is None:
            return {"optimisation": None}
        document = self.optimisation.document()
        if document["running"]:
            return {"optimisation": document}
        result, self.optimisation = self.optimisation.result, None
        if result is None:
            return {"optimisation": document, "message": document["failure"]}
        self.state = edited(self.state, result.lens)
        document["words"] = f"merit {result.merit_before:.6g} → {result.merit_after:.6g}, {result.stopped}"
        return {"optimisation": document, **refresh(self.state)}

    def save(self, path: str, *, overwrite: bool = False) -> str:
        """Write the lens in the format of the suffix; a file that exists is replaced if `overwrite`. In words."""
        target = Path(path).expanduser()
        if not path.strip():
            return "save: give the name of a file, as lens.zmx"
        if target.exists() and not overwrite:
            return f"save: {target} exists; tick “replace” to write over it, or give another name"
        try:
            write_lens(self.state.lens, target)
        except (OSError, ValueError, LookupError) as error:
            return f"save: {error}"
        return f"written: {target.resolve()}"

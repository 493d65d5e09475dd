"""A process that runs tools for the server, one after the other.

Requests come as lines of JSON by standard input: {"tool": …, "arguments": …}. Answers are lines of JSON:
{"progress": [seconds, total, message]}, then {"result": …}. The signal of Ctrl-C interrupts the tool that runs. The
process ends with its standard input.
"""

import base64
import contextlib
import io
import json
import os
import queue
import re
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TextIO

from raytrace.agents.folder import check_files
from raytrace.agents.tools import tool_of
from raytrace.budget import keep_freed_memory
from raytrace.cli import execute
from raytrace.cli.progress import Lines
from raytrace.words import RaytraceError

_SENDING = threading.Lock()  # progress comes from a thread of its own


def answer(name: str, values: dict, report: Callable[[Lines], object] | None = None) -> dict:
    """The result of a tool in the present folder: text, pictures (base64 of .png), document of `json`, is_error."""
    out, err = io.StringIO(), io.StringIO()
    with tempfile.TemporaryDirectory() as scratch:
        try:
            tool = tool_of(name)
            arguments = tool.arguments(values)
            check_files(arguments, Path.cwd(), overwrite=getattr(arguments, "overwrite", False))
        except RaytraceError as error:
            return {"text": str(error), "is_error": True}
        vars(arguments).pop("overwrite", None)
        if "plot" in arguments:
            arguments.plot = f"{scratch}/figure.png" if arguments.plot or tool.pictured else None
        with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
            execute(arguments, report)
        figures = [base64.b64encode(path.read_bytes()).decode() for path in sorted(Path(scratch).glob("*.png"))]
    printed = out.getvalue().strip()
    notes = re.findall("^raytrace: (.*)$", err.getvalue(), re.MULTILINE)
    notes = [tool.in_parameters(note) for note in notes if scratch not in note]
    failed = any(note.startswith("error: ") for note in notes)
    document = json.loads(printed) if printed and getattr(arguments, "json", False) else None
    text = printed if document is None else json.dumps(document, ensure_ascii=False)
    text = "\n\n".join(filter(None, [text, "\n".join(note.removeprefix("error: ") for note in notes)]))
    return {"text": text, "pictures": figures, "document": document, "is_error": failed}


def main() -> None:
    """Answer requests in the folder of the first argument until the end of standard input."""
    os.chdir(sys.argv[1])
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a client may have started the server without it
    keep_freed_memory()
    wire = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # whatever else is printed
    requests: queue.SimpleQueue[dict] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(requests,), daemon=True).start()
    with contextlib.suppress(KeyboardInterrupt):
        while True:
            request, start = requests.get(), time.monotonic()

            def report(lines: Lines, start: float = start) -> None:
                passed, left = time.monotonic() - start, lines.left
                _send(wire, {"progress": [passed, None if left is None else passed + left, str(lines)]})

            _send(wire, {"result": answer(request["tool"], request["arguments"], report)})


def _listen(requests: "queue.SimpleQueue[dict]") -> None:
    for line in sys.stdin:
        requests.put(json.loads(line))
    os.killpg(0, signal.SIGKILL)  # with compilers that it started


def _send(wire: TextIO, message: dict) -> None:
    with _SENDING:
        wire.write(json.dumps(message) + "\n")
        wire.flush()


if __name__ == "__main__":
    main()

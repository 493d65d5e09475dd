"""Pages of the reference that follow from tables of the package: the commands and the operands of merit functions.

The build calls `write`; the pages are in docs/reference/generated, which is not part of the repository.
"""

import contextlib
import io
from pathlib import Path

from raytrace.cli import main
from raytrace.cli.commands import COMMANDS
from raytrace.optimization.operands.table import OPERANDS

FOLDER = Path(__file__).parent / "reference" / "generated"
WAVE = ("psf", "design", "restore")


def help_of(*words: str) -> str:
    """The text of `raytrace … --help`."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return out.getvalue().rstrip()


def commands() -> str:
    """A section for each command, with its help."""
    names = [(command.name,) for command in COMMANDS]
    at = names.index(("wave",))
    names[at : at + 1] = [("wave", part) for part in WAVE]
    parts = [f"## `raytrace {' '.join(words)}`\n\n```text\n{help_of(*words)}\n```\n" for words in names]
    return "# Commands\n\nThe text of `raytrace COMMAND --help`.\n\n" + "\n".join(parts)


def operands() -> str:
    """A table of the operands, with the convention chosen where OpticStudio leaves one open."""

    def cell(text: str) -> str:
        return text.replace("|", "\\|")

    rows = [f"| `{name}` | {cell(one.text)} | {cell(one.convention)} |" for name, one in sorted(OPERANDS.items())]
    text = f"""# Operands of merit functions

{len(rows)} operands, by the names of OpticStudio. Lengths are in the unit of the lens file. A function of a lens in
Python is an operand too: `rt.Measure`.

| operand | value | convention |
|---|---|---|
"""
    return text + "\n".join(rows) + "\n"


def write(*_) -> None:
    """Write the pages whose text has changed."""
    FOLDER.mkdir(exist_ok=True)
    for name, text in (("commands", commands()), ("operands", operands())):
        page = FOLDER / f"{name}.md"
        if not page.exists() or page.read_text("utf-8") != text:
            page.write_text(text, "utf-8")

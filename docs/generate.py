"""Pages of the reference that follow from tables of the package: commands, operands of merit functions, file keywords.

The build calls `write`; the pages are in docs/reference/generated, which is not part of the repository.
"""

import contextlib
import io
from collections.abc import Iterable, Mapping
from pathlib import Path

from raytrace.agents.tools import TOOLS
from raytrace.cli import main
from raytrace.cli.commands import COMMANDS
from raytrace.io import FORMATS, oslo, ray_optics
from raytrace.io.codev import keywords as codev
from raytrace.io.table import columns
from raytrace.io.table.text import KEYS
from raytrace.io.zemax import configurations, optimization, surfaces
from raytrace.optimization.operands.table import OPERANDS

FOLDER = Path(__file__).parent / "reference" / "generated"


def help_of(*words: str) -> str:
    """The text of `raytrace … --help`."""
    out = io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        main([*words, "--help"])
    return out.getvalue().rstrip()


def commands() -> str:
    """A section for each command, with its help."""
    names = [
        (command.name, *part)
        for command in COMMANDS
        for part in [(child.name.removeprefix(f"{command.name}-"),) for child in command.subcommands] or [()]
    ]
    parts = [f"## `raytrace {' '.join(words)}`\n\n```text\n{help_of(*words)}\n```\n" for words in names]
    return "# Commands\n\nThe text of `raytrace COMMAND --help`.\n\n" + "\n".join(parts)


def tools() -> str:
    """A section for each tool of the server of agents, with its parameters."""
    parts = ["# Tools of agents\n\nParameters of the tools that `raytrace mcp` serves.\n"]
    for tool in TOOLS.values():
        schema = tool.schema(in_full=True)
        parts.append(f"## `{tool.name}`\n\n{tool.description}\n\n| parameter | type | meaning |\n|---|---|---|")
        for name, parameter in schema["properties"].items():
            needed = " (required)" if name in schema["required"] else ""
            meaning = parameter["description"].replace("|", "\\|")
            parts.append(f"| `{name}`{needed} | {_kind(parameter)} | {meaning} |")
        parts.append("")
    return "\n".join(parts)


def _kind(schema: Mapping) -> str:
    """The type of a JSON schema in words."""
    if "items" in schema:
        return f"list of {_kind(schema['items'])}"
    if "enum" in schema:
        return ", ".join(f"`{choice}`" for choice in schema["enum"])
    if "const" in schema:
        return f"`{schema['const']}`"
    if "anyOf" in schema:
        return " or ".join(map(_kind, schema["anyOf"]))
    kinds = schema["type"]
    return " or ".join(kinds) if isinstance(kinds, list) else kinds


def operands() -> str:
    """A table of the operands, with the convention chosen where OpticStudio leaves one open."""

    def cell(text: str) -> str:
        return text.replace("|", "\\|")

    rows = [f"| `{name}` | {cell(one.text)} | {cell(one.convention)} |" for name, one in sorted(OPERANDS.items())]
    text = f"""# Operands of merit functions

{len(rows)} operands, by the names of OpticStudio. Lengths are in the unit of the lens file. A function of a lens in
Python is an operand too: `rt.optimization.Measure`.

| operand | value | convention |
|---|---|---|
"""
    return text + "\n".join(rows) + "\n"


#: Keywords of .zmx files that are read in old files; a written file has the present keyword of the same number.
OLD = {"WAVL", "WAVN", "WWGT", "WWGN"} | {
    keyword for row in surfaces.FIELD_LISTS.values() for keyword in row.keywords[1:]
}
REFUSED_IF_SET = "IGNR"  # a surface that OpticStudio leaves out of the trace


def row_of(treatment: str, words: Iterable[str], reason: str = "") -> str:
    return f"| {treatment} | {' '.join(f'`{word}`' for word in words)} | {reason} |"


def by_reason(treatment: str, reasons: Mapping[str, str]) -> list[str]:
    """A row for each reason, with its keywords."""
    rows: dict[str, list[str]] = {}
    for word, reason in reasons.items():
        rows.setdefault(reason, []).append(word)
    return [row_of(treatment, words, reason) for reason, words in rows.items()]


def section(title: str, *rows: str, note: str = "") -> str:
    note = f"{note}\n\n" if note else ""
    return f"### {title}\n\n{note}| treatment | keywords | remark |\n|---|---|---|\n" + "\n".join(rows) + "\n"


def zemax() -> list[str]:
    """The tables of `raytrace.io.zemax`."""
    system, surface = list(surfaces.SYSTEM_READ), [*surfaces._SURFACE_READ, *surfaces.aperture_keywords()]
    solves = [f"{code} ({row.kind})" for code, row in optimization.CURVATURE_SOLVES.items()]
    followed = [row.kind for row in optimization.CURVATURE_SOLVES.values() if row.followed]
    thickness = [f"{word} ({row.kind})" for word, row in optimization.THICKNESS_SOLVES.items()]
    types = surfaces.types()
    return [
        section(
            "System",
            row_of("read and written", [word for word in system if word not in OLD]),
            row_of("read only", [word for word in system if word in OLD], "spelling of older files"),
            *by_reason("reported, ignored", surfaces.SYSTEM_IGNORED),
        ),
        section(
            "Surface",
            row_of(
                "read and written",
                dict.fromkeys(word for word in surface if word not in OLD and word != REFUSED_IF_SET),
            ),
            row_of("refused where it is set", [REFUSED_IF_SET], "a surface to be ignored"),
            *by_reason("reported, ignored", surfaces.SURFACE_IGNORED),
        ),
        section(
            "Surface type (`TYPE`)",
            *(row_of("read and written", [word], row.name) for word, row in types.items()),
            *(
                row_of("refused", [word], name)
                for word, name in surfaces.TYPE_NAMES.items()
                if word not in surfaces.types()
            ),
        ),
        section(
            "Solves",
            row_of("kept and written", solves, f"`CURV`; evaluated: {', '.join(followed)}"),
            row_of("kept and written", thickness, "`DISZ`; all are evaluated"),
        ),
        section(
            "Multi-configuration operands (`MNUM`)",
            row_of("read and written", surfaces.ROWS),
            row_of("kept and written", configurations.KEPT, "they change no ray"),
            *by_reason("reported, ignored", configurations._LEFT_OUT),
            *by_reason("refused where configurations differ", configurations._REFUSED),
        ),
        section(
            "Merit function and tolerances",
            row_of(
                "read and written",
                ["EFFL", "TRAC", "…"],
                "[Operands](operands.md); unknown ones are kept and reported",
            ),
            row_of(
                "read and written",
                ["TOL", "TCMM"],
                "tolerances, evaluated by `rt.tolerance`; unknown lines are kept and reported",
            ),
        ),
    ]


def formats() -> str:
    """The keywords of each format by their treatment."""
    parts = [
        "## OpticStudio (`.zmx`, `.zar`)\n\nA `.zar` archive is read only; its lens file is a `.zmx` file.\n",
        *zemax(),
    ]
    parts += [
        "## CODE V (`.seq`)\n",
        section(
            "Commands",
            row_of(
                "read and written",
                sorted({*codev.SYSTEM_READ, *codev.SURFACE_READ}),
                "or an equivalent command is written",
            ),
            *by_reason("reported, ignored", codev.LEFT_OUT),
            *by_reason("refused", codev.REFUSED),
        ),
        "## OSLO (`.len`)\n\nThe format is read only.\n",
        section(
            "System",
            row_of("read", oslo._SYSTEM_READ),
            *by_reason("reported, ignored", oslo._SYSTEM_IGNORED),
            *by_reason("refused", oslo._SYSTEM_REFUSED),
            *by_reason("refused unless off", oslo._SWITCHES),
        ),
        section(
            "Surface",
            row_of("read", oslo._SURFACE_READ),
            *by_reason("reported, ignored", oslo._SURFACE_IGNORED),
            *by_reason("refused", oslo._SURFACE_REFUSED),
            row_of("read", oslo._PICKUPS, "pickups from earlier surfaces"),
        ),
        "## ray-optics (`.roa`)\n\nThe format is read only.\n",
        section(
            "Model",
            row_of("read", ["seq_model", "optical_spec", "system_spec"]),
            row_of("read", ray_optics._PROFILES, "profiles"),
            row_of("read", ray_optics._SHAPES, "apertures"),
            *by_reason("reported, ignored", ray_optics._LEFT_OUT),
        ),
        "## Prescription tables (`.csv`, `.tsv`, `.txt`)\n",
        section(
            "Header lines `# key: value`",
            *(
                row_of("read and written" if key not in ("ignore", "units") else "read only", [key])
                for key in dict.fromkeys(KEYS.values())
            ),
            note="Lengths are written in mm.",
        ),
        section(
            "Columns",
            *(row_of("read", [name], spellings) for name, spellings in columns._SPELLINGS.items()),
            *(row_of("reported, ignored", [], f"{reason}: {names}") for reason, names in columns._OTHERS.items()),
            note="A heading is recognised in these spellings. `A4`, `r^4` … are coefficients of r⁴; `nF`, `νe` … are "
            "indices and Abbe numbers at a spectral line. A column of numbers with another heading is refused.",
        ),
    ]
    suffixes = ", ".join(f"`{suffix}`" for suffix, form in FORMATS.items() if form.write)
    head = f"# Keywords of lens files\n\nFormats that are written: {suffixes}. All are read.\n\n"
    return head + "\n".join(parts)


def write(*_) -> None:
    """Write the pages whose text has changed."""
    FOLDER.mkdir(exist_ok=True)
    pages = {"commands": commands(), "tools": tools(), "operands": operands(), "formats": formats()}
    for name, text in pages.items():
        page = FOLDER / f"{name}.md"
        if not page.exists() or page.read_text("utf-8") != text:
            page.write_text(text, "utf-8")

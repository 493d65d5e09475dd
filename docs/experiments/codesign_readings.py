"""The page of all readings of the published co-design study: losses, focus and claims of every study side by side.

    python docs/experiments/codesign_readings.py --docs docs

Reads table2.csv and claims.csv of the folders that codesign.py writes.
"""

import argparse
import csv
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from codesign_study import NAMES
from pages import grid, write_page

#: Folder and reading.
READINGS = {
    "codesign": "F/3",
    "codesign_f2": "F/2",
    "codesign_f1.92": "F/1.92",
    "codesign_f1.9": "F/1.9",
    "codesign_f1.76": "F/1.76",
}


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def claims_table(docs: Path) -> str:
    """Whether each claim holds in each reading."""
    tables = [_rows(docs / folder / "claims.csv") for folder in READINGS]
    lines = []
    for number, row in enumerate(zip(*tables, strict=True), 1):
        answers = [claim["answer"].replace("not applicable", "–").replace("yes", "**yes**") for claim in row]
        lines.append((f"{number}. {row[0]['claim']}", *answers, row[0]["criterion"]))
    counts = (f"{sum(claim['answer'] == 'yes' for claim in table)} of 21" for table in tables)
    return grid(("claim", *READINGS.values(), "yes if"), [*lines, ("yes", *counts, "")])


def losses_table(docs: Path) -> str:
    lines = []
    for folder, reading in READINGS.items():
        rows = _rows(docs / folder / "table2.csv")
        for model in dict.fromkeys(row["model"] for row in rows):
            of = [row for row in rows if row["model"] == model]
            lines.append((reading, NAMES[model], *(_spread(of, column, digits) for column, digits in _COLUMNS.items())))
    return grid(("reading", "model", "L¹, step 1", "L¹, step 2", "focus, paraxial (m)", "focus, RMS (m)"), lines)


_COLUMNS = {"l1_joint": 4, "l1_drt": 4, "focus_paraxial_m": 1, "focus_rms_m": 1}


def _spread(rows: Sequence[Mapping[str, str]], column: str, digits: int) -> str:
    values = [float(row[column]) for row in rows]
    deviation = statistics.stdev(values) if len(values) > 1 else 0.0
    return f"{statistics.fmean(values):.{digits}f} ± {deviation:.{digits}f}"


_ANSWER = """The paper prints neither its aperture nor its numbers of rays. Five readings were trained, three seeds
each:

- **The ranking is reproduced in four of five**: at F/3, F/2, F/1.92 and F/1.9 the lens of Gaussian DRT has the
  lowest loss of the paper's three models; at F/1.9 three seeds do not show the difference.
- **The gain is never the paper's 17 and 18 %**: at most 8.9 and 8.7 % (F/3).
- **The three focus distances in one definition, within 2 m, and a gain come together at F/1.92 only**.
- **The losses are never reproduced**: 34 to 97 % above the paper's."""
_NOTE = """Mean ± standard deviation over seeds, test pictures."""
_CLAIMS = """The figures behind each answer: claims.csv of [F/3](codesign/claims.csv), [F/2](codesign_f2/claims.csv),
[F/1.92](codesign_f1.92/claims.csv), [F/1.9](codesign_f1.9/claims.csv) and [F/1.76](codesign_f1.76/claims.csv);
for F/3 and F/1.92 also [papers.md](papers.md). “Simple” models are paraxial and Fourier optics."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--docs", metavar="FOLDER", type=Path, required=True, help="folder of the page and the tables")


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    docs = parser.parse_args(argv).docs
    parts = [
        "# Co-design at other apertures and numbers of rays",
        _ANSWER,
        "    python docs/experiments/codesign_readings.py --docs docs",
        "## Loss and focus",
        losses_table(docs),
        _NOTE,
        "## The paper's claims",
        claims_table(docs),
        _CLAIMS,
    ]
    write_page(docs / "codesign_readings.md", parts)


if __name__ == "__main__":
    sys.exit(main())

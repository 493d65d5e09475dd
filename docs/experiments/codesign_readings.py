"""The page of all readings of the published co-design study: losses, focus and claims of every study side by side.

    python docs/experiments/codesign_readings.py --docs docs

Reads table2.csv and claims.csv of the folders that codesign.py writes.
"""

import argparse
import csv
import re
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from codesign_study import NAMES

from raytrace.pages import grid, write_page

#: Folder and reading.
READINGS = {
    "codesign": "F/3",
    "codesign_f2": "F/2",
    "codesign_f1.92": "F/1.92",
    "codesign_f1.9": "F/1.9",
    "codesign_f1.76": "F/1.76",
}
#: Figures of each claim in order: a pattern of the numbers of claims.csv; None: by model, a string: verbatim match.
FORMS: tuple[str | None, ...] = (
    *("{0}, {1} m", "{4} m off", "{0} µm", "{0} / {1} m", "{2} m off"),
    *(None, None, None, None, None),
    *("{0} to {1} %", None, "{0}, {1} %", "{0} %", "{0} for {1}, {3}", "{0}, {1} %", "", "{0} m ({1} %)"),
    *("{0}/{1}, {2}/{3}, {4}/{5}", None, None),
)
_MODEL = re.compile(r"(paraxial|Fourier|Gaussian DRT|DRT) (?:least at |after |by )?([\d.]+)")


def _rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def figures_of(claim: Mapping[str, str], form: str | None) -> str:
    """The numbers of a claim, without the names: paraxial, Fourier, Gaussian DRT, DRT."""
    if claim["answer"] not in ("yes", "no"):
        return ""
    text = claim["figures"]
    if form is None:
        of = dict(_MODEL.findall(text))
        return ", ".join(of[name] for name in ("paraxial", "Fourier", "Gaussian DRT", "DRT") if name in of)
    if not form:
        better = [z for gain, z in re.findall(r"([+-])[\d.]+ % at (\d+) m", text) if gain == "+"]
        return f"at {', '.join(better)} m"
    short = form.format(*re.findall(r"[+-]?\d+(?:\.\d+)?", text))
    side = re.search("(nearer to|further from) the lens", text)
    return f"{short} {side[1].split()[0]}" if side else short


def claims_table(docs: Path) -> str:
    tables = [_rows(docs / folder / "claims.csv") for folder in READINGS]
    lines = []
    for number, (form, *row) in enumerate(zip(FORMS, *tables, strict=True), 1):
        cells = [f"**{claim['answer']}** {figures_of(claim, form)}" for claim in row]
        cells = [cell.replace("**not applicable** ", "–") for cell in cells]
        lines.append((f"{number}. {row[0]['claim']}", *cells, row[0]["criterion"]))
    count = ["", *(f"{sum(claim['answer'] == 'yes' for claim in table)} of 21" for table in tables), ""]
    return grid(("claim", *READINGS.values(), "yes if"), [*lines, ("yes", *count[1:])])


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

- **The ranking is reproduced in four of five**: at F/3, F/2, F/1.92 and F/1.9 the lens of Gaussian DRT
  has the lowest loss of the paper's three models; at F/1.9 three seeds do not show the difference, and
  at F/1.76 it is not lowest.
- **The gain is never the paper's 17 and 18 %**: at most 8.9 and 8.7 % (F/3), 8.2 and 8.5 % (F/2), 5.9
  and 5.6 % (F/1.92).
- **The three focus distances in one definition, within 2 m, and a gain come together at F/1.92 only**,
  with 37 hexapolar rays for Gaussian DRT and 271 for DRT.
- **The size of the losses is never reproduced**: 34 to 97 % above the paper's."""
_NOTE = """Mean ± standard deviation over seeds, test pictures. The paper: L¹ 0.0415, 0.0408, 0.0429 (step 1) and
0.0504, 0.0509, 0.0430 (step 2); focus 33.9, 35.7, 27.3 m, for paraxial, Fourier and Gaussian DRT."""
_CLAIMS = """Numbers in the order paraxial, Fourier, Gaussian DRT, DRT; focus as paraxial conjugate / least RMS spot.
Claims 6 (fraction of step 1, %), 7 (m), 8 to 10 (µm), 20 and 21 (ms). The full text of each cell:
claims.csv in each folder ([F/3](codesign/claims.csv), [F/2](codesign_f2/claims.csv),
[F/1.92](codesign_f1.92/claims.csv), [F/1.9](codesign_f1.9/claims.csv),
[F/1.76](codesign_f1.76/claims.csv)). “Simple” models are paraxial and Fourier optics."""


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

"""Write glass_catalogs/*.AGF from tables of public figures (provenance of the shipped catalogs).

    python tests/oracles/make_catalogs.py TABLES glass_catalogs

TABLES is a folder of four tables:

coefficients.csv    one row a glass: catalog, glass, formula (AGF number), coefficients, nd_listed, Vd_listed,
                    wl_min_um, wl_max_um, thermal figures, status, nd_Vd_consistency, confidence, sources_agreeing,
                    sources_deviating; a row is there only if two sources agree on the coefficients, and sources that
                    deviate are listed with their largest |Δn|
additional.csv      further glasses, also of a single source: coefficients, nd, Vd, range, sources, files
properties.csv      expansion, density and relative cost, each with the number of sources that agree
transmittance.csv   internal transmittance of 10 mm at wavelengths, each with the number of sources that agree

Rules:

* One row a name and catalog. Two rows of one name (capitals ignored) stop this script: no edition is chosen silently.
* Coefficients are cut or padded with zeros to what the formula takes; a coefficient beyond that, not zero, stops it.
* Figures the tables do not have are written as AGF writes "not known": expansion and density 0, cost and resistances
  -1, no IT record. ΔP_gF is computed from the coefficients where g, F, d and C lie in range, else 0.
* The catalog of an additional glass is that of its files (FILES), the first of them in SHIPPED. A glass whose
  coefficients contradict its listed nd or Vd (CONTRADICTION) is left out, and so is a name of ALIASES.csv; both are
  printed. nd and Vd are listed only where the d line is in range.
* Expansions from 20 to 300 °C that some makers state in 1e-7/K (48 of HOYA, 5 of RPO: ten times that to 70 °C) are
  divided by ten. A density of exactly 1 is the default of catalog files, and left out.
* A transmittance beyond 0 to 1 is left out, and that of a glass for which all sources list 1 everywhere, or 0: it is
  not measured.
* The comment has the number of sources of every figure.
* "alternatives" of an obsolete glass: up to three standard or preferred glasses of the same catalog with
  |Δn_d| < 5e-4 and |ΔV_d| < 0.5 %, the nearest first. They are hints for a reader, never used in a lookup.
* "caution" where the curve is not that of a transparent medium over all of its listed range: the stretches in which n
  rises with wavelength or is below 1 (some plastics list a range wider than their polynomial holds).
"""

import csv
import sys
from collections import defaultdict
from dataclasses import replace
from itertools import islice, pairwise
from pathlib import Path
from typing import NamedTuple

import torch

from raytrace.materials.agf import Catalog, write_agf
from raytrace.materials.catalogs import SHIPPED, aliases
from raytrace.materials.glass import (
    BY_NUMBER,
    FORMULAS,
    LINES,
    Glass,
    abbe_number,
    nd,
    normal_line_deviation,
    refractive_index,
)

TITLE = "{name}: figures of public sources, which each glass names in its comment"


def glass(row: dict[str, str], alternatives: list[str], figures: "Figures") -> Glass:
    formula = BY_NUMBER[int(row["formula"])]
    numbers = [float(word) for word in row["coefficients"].split()]
    count = FORMULAS[formula].count
    if any(numbers[count:]):
        raise SystemExit(f"{row['catalog']} {row['glass']}: more coefficients than formula {formula} takes")
    numbers = (numbers + [0.0] * count)[:count]
    span = float(row["wl_min_um"]), float(row["wl_max_um"])
    bare = Glass(row["glass"], formula, torch.tensor(numbers, dtype=torch.float64), wavelength_range=span)
    thermal = tuple(float(word) for word in row["thermal_D0_D1_D2_E0_E1_Ltk_T"].split())
    agreeing, deviating = (
        row[column].split(";") if row[column] else [] for column in ("sources_agreeing", "sources_deviating(max|dn|)")
    )
    comment = [f"alternatives: {' '.join(alternatives)}"] if alternatives else []
    comment += caution(bare)
    comment += [f"confidence {row['confidence']}", f"nd and Vd by the coefficients: {row['nd_Vd_consistency']}"]
    comment += [f"{len(agreeing)} sources agree: {', '.join(agreeing)}"]
    comment += [f"{len(deviating)} deviate by max |dn|: {', '.join(deviating)}"] if deviating else []
    unlisted = row["nd_listed"] == "1.0" and row["Vd_listed"] == "0.0"
    return filled(
        Glass(
            name=row["glass"],
            formula=formula,
            coefficients=bare.coefficients,
            catalog=row["catalog"],
            wavelength_range=span,
            status="" if row["status"] == "-1" else row["status"],
            nd_listed=None if unlisted else float(row["nd_listed"]),
            abbe_listed=None if unlisted else float(row["Vd_listed"]),
            comment="; ".join(comment),
            records=(("TD", thermal),) if thermal else (),
        ),
        figures,
    )


def filled(glass: Glass, figures: "Figures") -> Glass:
    """The glass with its figures, or what AGF writes for unknown ones, and their numbers of sources."""
    span, key = glass.wavelength_range, (glass.catalog, glass.name)
    visible = span and span[0] <= LINES["g"] and span[1] >= LINES["C"]
    deviation = round(float(normal_line_deviation(glass)), 6) if visible else 0.0
    known = figures.properties.get(key, {})
    expansion, expansion_to_300, density = (known.get(name, (0.0, 0))[0] for name in NAMES[:3])
    cost = known.get("relative cost", (-1.0, 0))[0]
    lines = figures.transmittance.get(key, [])
    sources = [f"{name} by {known[name][1]}" for name in NAMES if name in known]
    if lines:
        counts = sorted({count for *_, count in lines})
        sources.append(f"internal transmittance by {' to '.join(map(str, dict.fromkeys((counts[0], counts[-1]))))}")
    comment = [glass.comment, *([f"sources of figures: {', '.join(sources)}"] if sources else [])]
    return replace(
        glass,
        catalog="",
        comment="; ".join(comment),
        records=(
            ("ED", (expansion, expansion_to_300, density, deviation, 0.0)),
            *glass.records,
            ("OD", (cost, *(-1.0,) * 5)),
            *(("IT", (wavelength, transmittance, 10.0)) for wavelength, transmittance, _ in lines),
        ),
    )


class Figures(NamedTuple):
    """By (catalog, glass): figures and numbers of sources by name, and rows (µm, internal transmittance, sources)."""

    properties: dict[tuple[str, str], dict[str, tuple[float, int]]]
    transmittance: dict[tuple[str, str], list[tuple[float, float, int]]]


#: An expansion above this, in 1e-6/K, and of five times that to 70 °C, is in 1e-7/K; a figure that states nothing.
TENFOLD, BLANK = 20.0, {"density": 1.0}
NAMES = "expansion from -30 to 70 C", "expansion from 20 to 300 C", "density", "relative cost"


def figures_of(folder: Path) -> Figures:
    properties, transmittance = {}, defaultdict(list)
    with open(folder / "properties.csv", encoding="utf-8", newline="") as file:
        for catalog, name, *numbers in islice(csv.reader(file), 1, None):
            pairs = zip(NAMES, numbers[::2], numbers[1::2], strict=True)
            known = {title: (float(n), int(count)) for title, n, count in pairs if n}
            (near, _), (far, count) = (known.get(title, (0.0, 0)) for title in NAMES[:2])
            if far > max(TENFOLD, 5 * near):
                known[NAMES[1]] = round(far / 10, 6), count
            properties[catalog, name] = {title: entry for title, entry in known.items() if entry[0] != BLANK.get(title)}
    with open(folder / "transmittance.csv", encoding="utf-8", newline="") as file:
        for catalog, name, *numbers, count in islice(csv.reader(file), 1, None):
            if 0 <= float(numbers[1]) <= 1:
                transmittance[catalog, name].append((*map(float, numbers), int(count)))
    measured = {key: sorted(lines) for key, lines in transmittance.items() if any(0 < τ < 1 for _, τ, _ in lines)}
    return Figures(properties, measured)


#: The catalog of the glasses of a file, by the beginning of its name.
FILES = {
    "angstromlink": "PLASTIC", "cdgm": "CDGM", "corning": "CORNING", "hoya": "HOYA", "infrared": "INFRARED",
    "irphotonics": "INFRARED", "lightpath": "LIGHTPATH", "lzos": "LZOS", "nhg": "NHG", "nikon": "HIKARI",
    "ohara": "OHARA", "pilkington": "PILKINGTON", "plastic": "PLASTIC", "schott_ig": "INFRARED", "schott": "SCHOTT",
    "sumita": "SUMITA", "zeon": "ZEON", "": "MISC",
}  # fmt: skip
#: Differences of nd and Vd between coefficients and listing, beyond which a glass of a single listing is not trusted.
CONTRADICTION = 1e-4, 0.3


def additional(row: dict[str, str], figures: Figures) -> tuple[str, Glass | None]:
    """The catalog of a further glass, and the glass; None for one that contradicts its own listing."""
    files = [file.split(":")[1].lower() for file in row["files"].split(";")]
    catalog = min((next(FILES[stem] for stem in FILES if file.startswith(stem)) for file in files), key=SHIPPED.index)
    formula, numbers = BY_NUMBER[int(row["agf_formula"])], [float(word) for word in row["coefficients"].split()]
    count, (shortest, longest) = FORMULAS[formula].count, map(float, row["range_um"].split())
    if any(numbers[count:]):
        raise SystemExit(f"{row['glass']}: more coefficients than formula {formula} takes")
    coefficients = torch.tensor((numbers + [0.0] * count)[:count], dtype=torch.float64)
    span = (shortest, longest) if longest else None
    glass = Glass(row["glass"], formula, coefficients, catalog, span)
    listed = float(row["nd"]), float(row["Vd"])
    if listed == (1.0, 0.0) or not (span and span[0] <= LINES["d"] <= span[1]):
        listed = None, None
    else:
        off = abs(float(nd(glass)) - listed[0]), abs(float(abbe_number(glass)) - listed[1])
        if off[0] > CONTRADICTION[0] or off[1] > CONTRADICTION[1]:
            return catalog, None
    count, others = int(row["independent_sources"]), int(row["other_versions"])
    comment = caution(glass) if span else []
    comment.append(f"{count} source{'s agree' if count > 1 else ' alone'}: {row['files'].replace(';', ', ')}")
    comment += [f"{others} of other coefficients deviate by some |dn|"] if others else []
    made = replace(glass, nd_listed=listed[0], abbe_listed=listed[1], comment="; ".join(comment))
    return catalog, filled(made, figures)


def caution(glass: Glass) -> list[str]:
    if glass.name == "VACUUM":  # below 1 and rising by right: air is the reference
        return []
    wavelengths = torch.linspace(*glass.wavelength_range, 400, dtype=torch.float64)
    n = refractive_index(glass, wavelengths)
    wrong = ((n[1:] > n[:-1]) | (n[1:] < 1.0)).tolist()
    stretches: list[list[float]] = []
    for i, (start, end) in enumerate(pairwise(wavelengths.tolist())):
        if wrong[i] and i and wrong[i - 1]:
            stretches[-1][1] = end
        elif wrong[i]:
            stretches.append([start, end])
    listed = ", ".join(f"{start:.2f}-{end:.2f} um" for start, end in stretches)
    return [f"caution: n rises with wavelength or is below 1 at {listed}"] if stretches else []


def alternatives(row: dict[str, str], rows: list[dict[str, str]]) -> list[str]:
    if row["status"] != "obsolete" or row["nd_Vd_consistency"] != "ok":
        return []
    n, v = float(row["nd_listed"]), float(row["Vd_listed"])
    near = []
    for other in rows:
        steps = abs(float(other["nd_listed"]) - n) / 5e-4, abs(float(other["Vd_listed"]) / v - 1.0) / 5e-3 if v else 1.0
        if other["status"] in ("standard", "preferred") and max(steps) < 1.0:
            near.append((sum(steps), other["glass"]))
    return [name for _, name in sorted(near)[:3]]


def main(tables: str, folder: str) -> None:
    catalogs, figures = {name: [] for name in SHIPPED}, figures_of(Path(tables))
    further = {name: [] for name in SHIPPED}
    with open(Path(tables) / "coefficients.csv", encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            catalogs[row["catalog"]].append(row)
    with open(Path(tables) / "additional.csv", encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            catalog, made = additional(row, figures)
            if row["glass"].upper() in aliases():
                print(f"{catalog} {row['glass']}: left out; it is an alias of a glass of more sources")
                continue
            further[catalog] += [made] if made else []
            if made is None:
                print(f"{catalog} {row['glass']}: left out; its coefficients contradict nd {row['nd']}, Vd {row['Vd']}")
    for name, rows in catalogs.items():
        glasses = {}
        for made in (*(glass(row, alternatives(row, rows), figures) for row in rows), *further[name]):
            if made.name.upper() in {listed.upper() for listed in glasses}:
                raise SystemExit(f"{name} {made.name}: two rows of one name; choose an edition in the table")
            glasses[made.name] = made
        write_agf(Catalog(name, glasses, (TITLE.format(name=name),)), Path(folder) / f"{name}.AGF")
        print(f"{name}: {len(glasses)}")


if __name__ == "__main__":
    main(*sys.argv[1:])

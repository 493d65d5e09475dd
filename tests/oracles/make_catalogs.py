"""Write glass_catalogs/*.AGF from a table of dispersion coefficients (provenance of the shipped catalogs).

    python tests/oracles/make_catalogs.py coefficients.csv glass_catalogs

The table has one row a glass: catalog, glass, formula (AGF number), coefficients, nd_listed, Vd_listed, wl_min_um,
wl_max_um, thermal figures, status, nd_Vd_consistency, confidence, sources_agreeing, sources_deviating. A row is in the
table only if two sources agree on the coefficients; sources that deviate are listed with their largest |Δn|. Rules:

* One row a name and catalog. Two rows of one name (capitals ignored) stop this script: no edition is chosen silently.
* Coefficients are cut or padded with zeros to what the formula takes; a coefficient beyond that, not zero, stops it.
* Figures the table does not have are written as AGF writes "not known": expansion and density 0, cost and
  resistances -1. ΔP_gF is computed from the coefficients where g, F, d and C lie in range, else 0.
* "alternatives" of an obsolete glass: up to three standard or preferred glasses of the same catalog with
  |Δn_d| < 5e-4 and |ΔV_d| < 0.5 %, the nearest first. They are hints for a reader, never used in a lookup.
* "caution" where the curve is not that of a transparent medium over all of its listed range: the stretches in which n
  rises with wavelength or is below 1 (some plastics list a range wider than their polynomial holds).
"""

import csv
import sys
from collections import defaultdict
from itertools import pairwise
from pathlib import Path

import torch

from raytrace.materials.agf import Catalog, write_agf
from raytrace.materials.glass import BY_NUMBER, FORMULAS, LINES, Glass, normal_line_deviation, refractive_index

TITLE = "{name}: dispersion coefficients that agree in two or more public sources; each glass names them in its comment"


def glass(row: dict[str, str], alternatives: list[str]) -> Glass:
    formula = BY_NUMBER[int(row["formula"])]
    numbers = [float(word) for word in row["coefficients"].split()]
    count = FORMULAS[formula].count
    if any(numbers[count:]):
        raise SystemExit(f"{row['catalog']} {row['glass']}: more coefficients than formula {formula} takes")
    numbers = (numbers + [0.0] * count)[:count]
    span = float(row["wl_min_um"]), float(row["wl_max_um"])
    bare = Glass(row["glass"], formula, torch.tensor(numbers, dtype=torch.float64), wavelength_range=span)
    visible = span[0] <= LINES["g"] and span[1] >= LINES["C"]
    deviation = round(float(normal_line_deviation(bare)), 6) if visible else 0.0
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
    return Glass(
        name=row["glass"],
        formula=formula,
        coefficients=bare.coefficients,
        wavelength_range=span,
        status="" if row["status"] == "-1" else row["status"],
        nd_listed=None if unlisted else float(row["nd_listed"]),
        abbe_listed=None if unlisted else float(row["Vd_listed"]),
        comment="; ".join(comment),
        records=(
            ("ED", (0.0, 0.0, 0.0, deviation, 0.0)),
            *([("TD", thermal)] if thermal else []),
            ("OD", (-1.0,) * 6),
        ),
    )


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


def main(table: str, folder: str) -> None:
    with open(table, encoding="utf-8", newline="") as file:
        catalogs = defaultdict(list)
        for row in csv.DictReader(file):
            catalogs[row["catalog"]].append(row)
    for name, rows in catalogs.items():
        glasses = {}
        for row in rows:
            if row["glass"].upper() in {listed.upper() for listed in glasses}:
                raise SystemExit(f"{name} {row['glass']}: two rows of one name; choose an edition in the table")
            glasses[row["glass"]] = glass(row, alternatives(row, rows))
        write_agf(Catalog(name, glasses, (TITLE.format(name=name),)), Path(folder) / f"{name}.AGF")
        print(f"{name}: {len(glasses)}")


if __name__ == "__main__":
    main(*sys.argv[1:])

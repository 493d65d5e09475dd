"""Real files with tilted, toroidal, diffractive and ideal surfaces against an oracle, and against OpticStudio itself.

Oracle: ../shared/tier2/oracle_dev.json: rays of an independent tracer, by formulas that are settled by semi-diameters
which OpticStudio stored in the files; two tables of rays that it listed; and made-up files. The stored ones are
reproduced here once more. `python tests/test_corpus_types.py docs` writes corpus.md and corpus.csv of both corpora.
"""

import csv
import dataclasses
import functools
import itertools
import json
import math
import sys
import warnings
from collections import Counter
from pathlib import Path

import pytest
import torch
from corpus_comparison import MILLIMETRES, REFUSED, RIGHT, WRONG, Comparison, numbers, table
from problems import SHARED
from problems import number as real
from zemax_by_definition import surfaces, trace

from raytrace.io import UnsupportedSurface, read_lens
from raytrace.io.source import Place, decode
from raytrace.io.zemax.surfaces import types
from raytrace.materials.catalogs import UnknownGlass
from raytrace.materials.glass import refractive_index
from raytrace.system.lens import Lens, media
from raytrace.system.rays import start
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.trace import axial_path, steps

CORPUS = SHARED / "tier2"
FILES = json.loads((CORPUS / "oracle_dev.json").read_text())["files"] if (CORPUS / "oracle_dev.json").exists() else {}

INDEX_TOLERANCE = 1e-6
FIRST_ORDER_TOLERANCE = 1e-8  # relative: a few hundred roundings of two programs in float64
RAY_TOLERANCE = 1e-9  # mm, or of the distance from the vertex where that is longer than 1 m; and direction cosines
SEMI_DIAMETER_TOLERANCE = 1e-6  # relative above 1 unit of length: what the digits of all files allow

#: Source of the convention of a type.
SETTLED = {
    "COORDBRK": "stored semi-diameters (the other sign of a tilt fails); order 1 by rays that OpticStudio listed",
    "surface tilts": "stored semi-diameters of a fold mirror, and of a spectrometer (order 1)",
    "PARAX_XY": "stored semi-diameters of a held-out file",
    "PARAXIAL": "stored semi-diameters; its path is a choice of OpticStudio's and not compared",
    "DGRATING": "stored semi-diameters, in transmission and in reflection, on planes and on curved surfaces",
    "TILTSURF": "stored semi-diameters",
    "TOROIDAL": "stored semi-diameters of cylinders and of toroids",
    "ODDASPHE": "stored semi-diameters (the term r); the others by the vendor's documentation",
    "XASPHERE": "the vendor's documentation, and five programs that write such files",
    "BICONICX": "the vendor's documentation",
    "FZERNPHA": "stored semi-diameters",
    "FZERNSAG": "the vendor's documentation (the one real file, held out, has no term but 0)",
    "BINARY_1": "stored semi-diameters of a held-out file",
    "BINARY_2": "stored semi-diameters",
    "FRESNELS": "stored semi-diameters of a held-out file; its path is not defined and not compared",
    "HOLOGRM2": "stored semi-diameters, in transmission and in reflection",
    "XPOLYNOM": "stored semi-diameters (x² and y²); the order of the others by the vendor's documentation",
    "IRREGULA": "stored semi-diameters (all but the angle and the tilt about y)",
    "JONESMAT": "stored semi-diameters: a plane; polarisation is not modelled",
}


@functools.cache
def compare(name: str) -> Comparison:
    """Read one file and hold everything its oracle marks as certain against it."""
    entry = FILES[name]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            lens = read_lens(CORPUS / "dev" / name)
    except (UnsupportedSurface, UnknownGlass) as refusal:
        return Comparison(name, REFUSED, f"{type(refusal).__name__}: {refusal}".replace(f"{CORPUS / 'dev'}/", ""))
    result = Comparison(name, RIGHT, "")
    faults = [
        *compare_indices(lens, entry, result),
        *compare_first_order(lens, entry, result),
        *compare_rays(lens, entry, result),
    ]
    if len(lens.surfaces) != entry["system"]["nsurf"] or lens.stop != entry["system"]["stop"]:
        faults.append(f"{len(lens.surfaces)} surfaces, the stop {lens.stop}")
    if faults:
        result.outcome, result.details = WRONG, "; ".join(faults[:4])
    return result


def compare_indices(lens: Lens, entry: dict, result: Comparison) -> list[str]:
    faults = []
    for medium in entry["index"]:
        ours = refractive_index(lens.surfaces[medium["surf"]].glass, lens.wavelengths)
        difference = float((ours - real(medium["n"])).abs().max())
        if medium["oracle"]:
            result.index = max(result.index, difference)
            if not difference <= INDEX_TOLERANCE:
                faults.append(f"index of {medium['glass']} off by {difference:.1e}")
    return faults


def compare_first_order(lens: Lens, entry: dict, result: Comparison) -> list[str]:
    """The straightened figures; the sign of a focal length is that of the side on which it is measured."""
    data, unit = first_order(lens), MILLIMETRES[entry["system"]["unit"]]
    expected, faults = entry["first_order"], []
    for key, name in (("efl", "effective_focal_length"), ("epd", "entrance_pupil_diameter")):
        if not expected[f"{key}_oracle"]:
            continue
        theirs, ours = abs(expected[key]) * unit, abs(float(getattr(data, name)))
        difference = abs(ours - theirs) / max(theirs, 1.0)
        result.first_order = max(result.first_order, difference)
        if not difference <= FIRST_ORDER_TOLERANCE:
            faults.append(f"{name} {ours!r}, oracle {theirs!r}")
    return faults


def compare_rays(lens: Lens, entry: dict, result: Comparison) -> list[str]:
    """Every hit and every direction at every surface in its own axes; and the path where that is no choice."""
    unit, faults = MILLIMETRES[entry["system"]["unit"]], []
    surfaces = [dataclasses.replace(surface, apertures=()) for surface in lens.surfaces[1:]]
    for ray in entry["rays"]:
        if ray["status"] != "ok":
            continue
        wavelength = real(ray["wavelength"])
        indices = media(lens, wavelength)
        rays = start(real(ray["P"]) * unit, real(ray["D"]), real(0.0))
        walk = steps(surfaces, rays, indices=indices, wavelength=wavelength)
        for number, (crossing, out) in enumerate(zip(walk, ray["out"], strict=True), 1):
            if out is None:
                continue
            expected = real(out)
            expected[:3] *= unit
            found = torch.cat([crossing.rays.position, crossing.rays.direction])
            difference = (found - expected).abs().max() / max(1.0, 1e-3 * float(expected[:3].abs().max()))
            difference = float(difference) if bool(crossing.rays.valid) else math.inf
            result.rays = max(result.rays, difference)
            if not difference <= RAY_TOLERANCE:
                faults.append(f"ray {ray['name']} off by {difference:.1e} mm at surface {number}")
                break
        if entry["facts"]["opl"]["oracle"]:
            path = float(crossing.rays.opl + axial_path(surfaces, indices))
            difference = abs(path - ray["opl"][-1] * unit) / max(1.0, 1e-3 * abs(path))
            result.rays = max(result.rays, difference)
            if not difference <= RAY_TOLERANCE:
                faults.append(f"ray {ray['name']}: path off by {difference:.1e} mm")
    return faults


# -- semi-diameters that OpticStudio computed and stored --------------------------------------------------------------


def ring(count: int, shift: float = 0.0) -> list[tuple[float, float]]:
    angles = [2 * math.pi * (k + shift) / count for k in range(count)]
    return [(math.cos(angle), math.sin(angle)) for angle in angles]


#: Points of the rim that OpticStudio takes: 2 of an axially symmetric file, else what its version and settings say.
RIMS = {"2": [(0.0, 1.0), (0.0, -1.0)], "8": ring(8), "32": ring(32), "4 diagonal": ring(4, 0.5), "4": ring(4)}


def stored_semi_diameters(path: Path) -> dict[int, float]:
    """Those that are automatic (second number of DIAM 0), by surface, in the file's unit."""
    found, surface, kind = {}, 0, "STANDARD"
    for line in decode(path.read_bytes(), Place(str(path))).split("\n"):
        word, *words = line.split() or [""]
        if word == "SURF":
            surface, kind = int(words[0]), "STANDARD"
        elif word == "TYPE":
            kind = words[0]
        elif word == "DIAM" and words[1:2] == ["0"] and float(words[0]) > 0 and surface and kind != "COORDBRK":
            found[surface] = float(words[0])
    return found


def rim_rays(lens: Lens, entry: dict, rim: list[tuple[float, float]]) -> tuple[torch.Tensor, torch.Tensor]:
    """Through points of the straightened paraxial entrance pupil, in the file's unit: on the plane of surface 1."""
    system, first = entry["system"], entry["first_order"]
    distance = float(lens.surfaces[0].thickness) / MILLIMETRES[system["unit"]]
    found = []
    for (hx, hy), (px, py) in itertools.product(system["fields"], rim):
        pupil = real([px * first["epd"] / 2, py * first["epd"] / 2, first["enp"]])
        if system["ftyp"] == 1:
            way = pupil - real([hx, hy, -distance])
        else:
            slopes = [math.tan(math.radians(h)) if system["ftyp"] == 0 else h / first["efl"] for h in (hx, hy)]
            reach = distance + first["enp"]
            way = real([*slopes, 1.0])
            if math.isfinite(distance):
                way = pupil - real([-slopes[0] * reach, -slopes[1] * reach, -distance])
        way = way / way.norm() * torch.sign(way[2])
        found.append((pupil - pupil[2] / way[2] * way, way))
    return tuple(torch.stack([ray[part] for ray in found], -1) for part in (0, 1))


@functools.cache
def reproduced(name: str) -> tuple[int, int, float]:
    """How many stored semi-diameters one choice of the rim reproduces, of how many; and the largest difference."""
    lens, entry, stored = read_lens(CORPUS / "dev" / name), FILES[name], stored_semi_diameters(CORPUS / "dev" / name)
    unit, best = MILLIMETRES[entry["system"]["unit"]], (0, len(stored), math.inf)
    surfaces = [dataclasses.replace(surface, apertures=()) for surface in lens.surfaces[1:]]
    for rim in RIMS.values():
        position, direction = rim_rays(lens, entry, rim)
        largest = torch.zeros(len(surfaces), dtype=torch.float64)
        for wavelength in lens.wavelengths:
            walk = steps(
                surfaces, start(position * unit, direction), indices=media(lens, wavelength), wavelength=wavelength
            )
            for k, crossing in enumerate(walk):
                radius = torch.linalg.vector_norm(crossing.rays.position[:2], dim=0) * crossing.rays.valid
                largest[k] = torch.maximum(largest[k], radius.max())
        differences = [abs(float(largest[k - 1]) / unit - size) / max(1.0, size) for k, size in stored.items()]
        near = [difference for difference in differences if difference < SEMI_DIAMETER_TOLERANCE]
        best = max(best, (len(near), len(stored), max(near, default=0.0)), key=lambda one: (one[0], -one[2]))
    return best


@pytest.mark.needs(CORPUS)
@pytest.mark.parametrize("name", FILES)
def test_file_is_right(name):
    result = compare(name)
    assert result.outcome == RIGHT, result.details


@pytest.mark.needs(CORPUS)
@pytest.mark.parametrize("name", [name for name in FILES if FILES[name]["stored_semidiameters"]["matched"]])
@pytest.mark.filterwarnings("ignore")
def test_stored_semi_diameters_are_reproduced(name):
    expected = FILES[name]["stored_semidiameters"]
    matched, total, _ = reproduced(name)
    assert total == expected["total"]
    assert matched == expected["matched"] == total


@pytest.mark.needs(CORPUS)
@pytest.mark.parametrize("name", FILES)
def test_the_definitions_of_the_tests_are_those_of_the_oracle(name):
    """The tracer by definition, against which surfaces of every type are held, where it knows all media."""
    content = decode((CORPUS / "dev" / name).read_bytes(), Place(name))
    if any(block.get("GLAS", ["AIR"])[0] not in ("AIR", "___BLANK", "MIRROR") for block in surfaces(content)):
        pytest.skip("a glass of a catalog")
    for ray in FILES[name]["rays"]:
        if ray["status"] == "ok":
            found = trace(content, ray["P"], ray["D"], ray["wavelength"])
            assert [one is None for one in found] == [one is None for one in ray["out"]]
            pairs = [(one, out) for one, out in zip(found, ray["out"], strict=True) if out is not None]
            assert max(abs(one - out).max() / max(1.0, abs(one).max()) for one, out in pairs) < RAY_TOLERANCE


# -- the document -----------------------------------------------------------------------------------------------------

_PAGE = """# Corpus of real lens files

{right} of {count} comparisons of {files} real `.zmx` files agree with independent figures; {refused} is refused by
name and line, {wrong} is wrong.

    python tests/test_corpus_types.py docs

Nearly all files were collected from public repositories. The figures are those of two other programs, of
an independent tracer, or values that OpticStudio stored in the file. "Loaded and right" means: every
index marked certain agrees to 1e-6; every first-order quantity to 1e-8 relative; every ray to 1e-9 mm
(of the distance from the vertex beyond 1 m). Largest differences of all files: index {index:.0e}, first
order {first:.0e}, rays {rays:.0e} mm. Every file: [corpus.csv](corpus.csv). The files are not part of
this repository; the tests are skipped without them.

{types} and the types of the table are read and written. Every other type, and a glass that is not shipped, is
refused by name, surface and line.

## Surface types

Files with a surface beyond conics and even aspheres. An automatic semi-diameter is the largest height of
a few rays at the rim, which OpticStudio traced and stored. A single number: all of them.

{table}

## Refused files

{refusals}
"""


def types_of(name: str) -> list[str]:
    """The types of a file beyond the even asphere, with its surface tilts."""
    return FILES[name]["special"] or ["surface tilts"]


def part(count: int, total: int) -> str:
    """`total` where all count."""
    return str(total) if count == total else f"{count} of {total}"


def by_type() -> str:
    lines = [
        "| type | files right | semi-diameters reproduced | source of the convention |",
        "|---|---|---|---|",
    ]
    kinds = dict.fromkeys([*SETTLED, *itertools.chain(*map(types_of, FILES))])
    for kind in kinds:
        names = [name for name in FILES if kind in types_of(name)]
        right = part(sum(compare(name).outcome == RIGHT for name in names), len(names)) if names else "–"
        sizes = [reproduced(n) for n in names if FILES[n]["stored_semidiameters"]["matched"]]
        matched = part(sum(one[0] for one in sizes), sum(one[1] for one in sizes)) if sizes else ""
        called = types()[kind].name if kind in types() else "before and after any surface (SCBD)"
        lines.append(f"| `{kind}` {called} | {right} | {matched} | {SETTLED[kind]} |")
    return "\n".join(lines)


def by_file() -> list[dict[str, str]]:
    """Its rows in docs/corpus.csv."""
    rows = []
    for name in sorted(FILES):
        result, details = compare(name), ""
        if FILES[name]["stored_semidiameters"]["matched"]:
            details = "{} of {} semi-diameters reproduced, largest difference {:.0e}".format(*reproduced(name))
        details = details if result.outcome == RIGHT else result.details
        types_here = ", ".join(types_of(name))
        here = {"corpus": "surface types", "file": name, "types": types_here}
        rows.append(here | numbers(result) | {"details": details})
    return rows


def document(rows: list[dict[str, str]]) -> str:
    outcomes = Counter(row["outcome"] for row in rows)
    largest = {
        key: max(float(row[name]) for row in rows if row[name])
        for key, name in (("index", "index"), ("first", "first order, relative"), ("rays", "rays, mm"))
    }
    refusals = [f"- `{r['file']}`: {r['details'].partition('; ')[0]}" for r in rows if r["outcome"] != RIGHT]
    return _PAGE.format(
        count=len(rows), files=len({row["file"] for row in rows}),
        right=outcomes[RIGHT], refused=outcomes[REFUSED] or "none", wrong=outcomes[WRONG] or "none",
        types=", ".join(f"`{kind}`" for kind in types() if kind not in SETTLED), table=by_type(),
        refusals="\n".join(refusals) or "None.",
        **largest,
    )  # fmt: skip


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    every, folder = by_file() + table(), Path(sys.argv[1])
    (folder / "corpus.md").write_text(document(every), encoding="utf-8")
    with (folder / "corpus.csv").open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, every[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(every)

"""Effective focal lengths of a folder of lens files, as raytrace and Optiland 0.6.3 read them, against answers.

    python docs/experiments/corpus_optiland.py FOLDER ANSWERS.json

The answers: {file: {"paraxial_at_own_index": {"efl": {"own": …, "efl_air": …, "oracle": whether it is certain}}}}.
"""

import contextlib
import dataclasses
import io
import json
import sys
import warnings
from pathlib import Path

from optiland.fileio import load_zemax_file

import raytrace as rt

TOLERANCE = 1e-6  # relative
UNITS = (1.0, 10.0, 25.4, 1000.0)  # mm, cm, inch, m: raytrace gives mm, Optiland and the answers the unit of the file


def by_raytrace(path: Path) -> float:
    lens = dataclasses.replace(rt.read_lens(path), environment=None)  # the indices of the answers, radii as stored
    return float(rt.first_order(lens).effective_focal_length)


def by_optiland(path: Path) -> float:
    with contextlib.redirect_stdout(io.StringIO()):
        return float(load_zemax_file(str(path)).paraxial.f2())


def main(folder: Path, answers: Path) -> None:
    warnings.simplefilter("ignore")
    counts = {"raytrace": [0, 0, 0], "Optiland": [0, 0, 0]}
    for name, answer in json.loads(answers.read_text()).items():
        efl = answer["paraxial_at_own_index"]["efl"]
        if not efl["oracle"]:
            continue
        for program, read in (("raytrace", by_raytrace), ("Optiland", by_optiland)):
            try:
                length = abs(read(folder / name))
            except Exception as error:
                counts[program][1] += 1
                print(f"{name}: {program} refuses it: {type(error).__name__}: {str(error)[:90]}")
                continue
            expected = [abs(efl[key]) * unit for key in ("own", "efl_air") for unit in UNITS]
            right = any(abs(length / one - 1) < TOLERANCE for one in expected)
            counts[program][0 if right else 2] += 1
            if not right:
                print(f"{name}: {program} has EFL {length:.6f}, the answer is {abs(efl['own']):.6f}")
    for program, (right, refused, other) in counts.items():
        print(f"{program}: {right} right, {refused} refused, {other} with another focal length")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))

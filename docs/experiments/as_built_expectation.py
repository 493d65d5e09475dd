"""The expectation of the lens as built by second order against Monte Carlo, of three lenses at three grades.

The folder keeps the finished trials (.jsonl), from which an interrupted run goes on, and expectation.csv.
"""

import argparse
import math
import time
from functools import partial
from pathlib import Path

import pandas as pd
import torch

import raytrace as rt
from raytrace.tolerancing import study
from raytrace.tolerancing.criteria import criterion_of

LENSES, GRADES = ("cooke_triplet", "double_gauss", "phone"), ("commercial", "precision", "high")


def focused(name: str) -> rt.Lens:
    """The lens at its own best focus of the criterion's rays, aimed as its file says."""
    lens = rt.read_lens(name)
    return rt.focus(lens).lens


def seconds_of_expectation(lens: rt.Lens, grade: str, criterion: str) -> float:
    """Processor time in s of the expectation alone, without changes at the limits."""
    rows, views = (
        rt.tolerances(lens, grade=grade),
        study.views_of(lens, partial(criterion_of, criterion), None, None, None),
    )
    drawn = rt.tolerancing.draw_errors(rows, 2**15, seed=1)
    mean, variance = (drawn.new_tensor(part) for part in zip(*map(study.moments, rows), strict=True))
    for _ in range(3):  # the first compiles, and fills tables
        start = time.process_time()
        with torch.no_grad():
            model = study.Study(views, rows, loss=0.01).second_order()
            model.means(drawn, mean, variance, views[0].criterion.value)
        seconds = time.process_time() - start
    return seconds


def timed(**options) -> tuple[rt.tolerancing.ToleranceAnalysis, float]:
    """A study and its processor time in s."""
    start = time.process_time()
    found = rt.tolerance(**options)
    return found, time.process_time() - start


def row(name: str, grade: str, criterion: str, trials: int, folder: Path) -> dict:
    about = {"lens": focused(name), "grade": grade, "criterion": criterion}
    model, without = timed(**about, trials=0)
    seconds = seconds_of_expectation(**about)
    file = folder / f"{name}_{grade}_{criterion}.jsonl"
    fresh = not file.exists()
    built, whole = timed(**about, trials=trials, checkpoint=file)
    good = built.trials[~built.trials.isnan()]
    mean = float(good.mean())
    predicted = torch.quantile(model.predicted, 0.9)
    return {
        "lens": name, "criterion": criterion, "grade": grade, "tolerances": len(built.tolerances),
        "nominal": float(built.nominal), "expected": float(model.expected), "mean of the trials": mean,
        "standard error": float(good.std()) / math.sqrt(len(good)), "off, %": 100 * (float(model.expected) / mean - 1),
        "90 % within, trials": float(built.percentile(90)), "second order": float(predicted),
        "off at 90 %, %": 100 * (float(predicted) / float(built.percentile(90)) - 1),
        "without light": int(built.trials.isnan().sum()), "trials": len(built.trials), "s, second order": seconds,
        "s, trials": whole - without if fresh else math.nan,
    }  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="for the finished trials and expectation.csv")
    parser.add_argument("--trials", type=int, default=100_000)
    parser.add_argument("--criterion", default="rms")
    parser.add_argument("--grades", nargs="+", default=GRADES)
    parser.add_argument("--lenses", nargs="+", default=LENSES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    chosen = parser.parse_args()
    chosen.folder.mkdir(parents=True, exist_ok=True)
    table = chosen.folder / "expectation.csv"
    for name in chosen.lenses:
        for grade in chosen.grades:
            new = pd.DataFrame([row(name, grade, chosen.criterion, chosen.trials, chosen.folder)])
            rows = pd.concat([pd.read_csv(table), new]) if table.exists() else new
            rows = rows.drop_duplicates(["lens", "criterion", "grade"], keep="last")
            rows.to_csv(table, index=False)
            print(new.to_string(index=False), flush=True)


if __name__ == "__main__":
    main()

"""The lens as built in the merit: the expectation by samples of different kinds, and two lenses made less sensitive.

    python docs/experiments/as_built.py runs/as_built --plot docs/as_built.png

Figures that the folder already holds are not computed again. All expectations are root mean squares of the RMS spot
radius in µm, of the refocused lens at precision grade.
"""

import argparse
import csv
import time
import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch
from experiments import Store

import raytrace as rt
from raytrace.analysis.layout import draw_layout, on_one_scale
from raytrace.optimization.optimized_figure import drawn_fields
from raytrace.plotting.style import new_figure, save
from raytrace.tolerancing.as_built import AsBuiltTerm
from raytrace.tolerancing.study import moments

GRADE, SEED, TRIALS = "precision", 2026, 2000
#: Lens, F-number, largest field in degrees; rings of the pupil in the term, its weight, and cycles of both second
#: optimisations.
CASES = {
    "Cooke triplet": ("cooke_triplet", 5.6, 4.0, 3, 0.45, 100),
    "double Gauss": ("double_gauss", 5.6, 14.0, 2, 1.0, 60),
}
#: Other conditions, of "What bounds the gain".
CONDITIONS = {
    "Cooke triplet, F/3.5, 11.9°": ("cooke_triplet", 3.5, 11.9, 3, 2.0, 100),
    "Cooke triplet, F/5.6, 4°": ("cooke_triplet", 5.6, 4.0, 3, 1.0, 100),
    "Cooke triplet, F/5, 6°": ("cooke_triplet", 5.0, 6.0, 3, 1.0, 100),
    "double Gauss, F/3, 14°": ("double_gauss", 3.0, 14.0, 2, 2.0, 60),
    "double Gauss, F/8, 14°": ("double_gauss", 8.0, 14.0, 2, 1.0, 60),
}


def start_of(name: str, f_number: float, field: float):
    """The shipped lens at its conditions, with merit, variables and constraints of both optimisations."""
    lens = rt.read_lens(name)
    length = float(rt.first_order(lens).effective_focal_length)
    track = float(sum(surface.thickness for surface in lens.surfaces[1:-1]))
    lens = lens.at(f_number=f_number, fields=[0, 0.7 * field, field])
    merit = rt.optimization.DefaultMerit("spot", glass_thickness=(2, 20), air_thickness=(0.3, 30), edge=1)
    hold = f"efl={length} total_track<={1.05 * track}"
    return lens, {"merit": merit, "vary": "curvature thickness", "hold": hold}


def numbers_of(lens) -> np.ndarray:
    return np.array([[float(s.curvature or 0), float(s.thickness)] for s in lens.surfaces[1:-1]])


def lens_of(lens, numbers: np.ndarray):
    for k, (curvature, thickness) in enumerate(numbers, 1):
        bent = {"curvature": curvature} if curvature else {}
        lens = lens.replace(k, thickness=thickness, **bent)
    return lens


def desensitised(
    name: str, f_number: float, field: float, rings: int, weight: float, cycles: int
) -> dict[str, np.ndarray]:
    """Curvatures and thicknesses by the optimisation without the term, and from there by as many cycles of both."""
    lens, settings = start_of(name, f_number, field)
    first = rt.optimize(lens, cycles=900, **settings)
    ends = {"usual": rt.optimize(first.lens, cycles=cycles, **settings)}
    as_built = rt.tolerancing.AsBuilt(GRADE, rings=rings, weight=weight)
    ends["robust"] = rt.optimize(first.lens, cycles=cycles, as_built=as_built, **settings)
    return {key: numbers_of(end.lens) for key, end in ends.items()}


def judged(lens) -> dict[str, np.ndarray]:
    """Monte Carlo of a seed that no optimisation has seen."""
    built = rt.tolerance(lens, grade=GRADE, trials=TRIALS, seed=SEED)
    return {"nominal": built.nominal.numpy(), "trials": built.trials.numpy()}


def sensitivity(lens) -> dict[str, np.ndarray]:
    """RMS wavefront of 300 lenses, changes (N,) of the spot at the worse limit of every tolerance, and √E[q], µm."""
    waves = rt.tolerance(lens, grade=GRADE, criterion="wavefront", trials=300, seed=SEED)
    spots = rt.tolerance(lens, grade=GRADE, trials=0)
    changes = torch.maximum(spots.minimum, spots.maximum)
    expected = 1e3 * rt.tolerancing.AsBuilt(GRADE).of(lens).expected(lens).sqrt()
    of_waves = {"nominal": waves.nominal.numpy(), "waves": waves.trials.numpy()}
    return {**of_waves, "changes": changes.numpy(), "expected": expected.detach().numpy()}


def samples(term: AsBuiltTerm) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Errors (L, N) and weights (L,) of samples for the expectation."""
    mean, variance = (
        torch.tensor(part, dtype=torch.float64) for part in zip(*map(moments, term.tolerances), strict=True)
    )
    count, sigma, errors = len(mean), variance.sqrt(), term.errors
    half = 0.5 * (term.tolerances.maximum - term.tolerances.minimum)

    def alike(errors):
        return errors, torch.full((len(errors),), 1 / len(errors), dtype=torch.float64)

    def differences(step):
        part, each = torch.eye(count, dtype=torch.float64) * step, 0.5 * variance / step**2
        return torch.cat([mean[None], mean + part, mean - part]), torch.cat([1 - 2 * each.sum()[None], each, each])

    drawn = rt.tolerancing.draw_errors(term.tolerances, len(errors), seed=7)
    found = {"two levels, L = " + str(len(errors)): alike(errors), "two levels and their negatives": None}
    found["two levels and their negatives"] = alike(torch.cat([errors, 2 * mean - errors]))
    found["second order, differences of 0.05 half widths"] = differences(0.05 * half)
    found["each error alone, ± σ"] = differences(sigma)
    found["random"] = alike(drawn)
    found["random, antithetic"] = alike(torch.cat([drawn, -drawn]))
    return found


def expectation(lens, term: AsBuiltTerm, errors: torch.Tensor, weights: torch.Tensor) -> np.ndarray:
    """E[q] in µm², its derivatives by curvatures and thicknesses in units of 1/150 mm and 15 mm, and the seconds."""
    started, leaves = time.process_time(), []
    for k in range(1, len(lens.surfaces) - 1):
        for name, unit in (("curvature", 1 / 150), ("thickness", 15.0)):
            number = getattr(lens.surfaces[k], name)
            if number is not None and not (name == "curvature" and float(number) == 0):
                leaf = (number.detach() / unit).requires_grad_()
                lens, leaves = lens.replace(k, **{name: unit * leaf}), [*leaves, leaf]
    found = np.zeros(1 + len(leaves))
    for part, weight in zip(errors.split(256), weights.split(256), strict=True):
        q = 1e6 * (weight * term.mean_squares(lens, part)).sum()
        found += [float(q), *map(float, torch.autograd.grad(q, leaves, retain_graph=True))]
    return np.array([*found, time.process_time() - started])


def table_of_samples(store: Store, name: str, reference: int = 6000) -> list[str]:
    lens = rt.read_lens(name)
    term = rt.tolerancing.AsBuilt(GRADE).of(lens)
    drawn = rt.tolerancing.draw_errors(term.tolerances, reference, seed=5)
    pairs = torch.cat([drawn, -drawn])
    cases = samples(term) | {"reference": (pairs, torch.full((len(pairs),), 1 / len(pairs), dtype=torch.float64))}
    cases["nominal"] = torch.zeros_like(drawn[:1]), torch.ones(1, dtype=torch.float64)
    compute = lambda key: lambda: {"found": expectation(lens, term, *cases[key])}  # noqa: E731
    found = {key: store.arrays(f"{name}_{n}", compute(key))["found"] for n, key in enumerate(cases)}
    most, least = found["reference"], found["nominal"]
    lines = [
        f"{name}: E {most[0] ** 0.5:.4f} µm by {len(pairs)} lenses, {most[-1]:.1f} s; nominal {least[0] ** 0.5:.4f}"
    ]
    for key in samples(term):
        one = found[key]
        errors = (one[0] - most[0]) / (most[0] - least[0]), np.linalg.norm((one - most)[1:-1])
        errors = errors[0], errors[1] / np.linalg.norm((most - least)[1:-1])
        size = len(cases[key][0])
        lines.append(f"| {key} | {size} | {100 * errors[0]:+.2f} % | {100 * errors[1]:.1f} % | {one[-1]:.2f} s |")
    return lines


def rows_of_conditions(store: Store) -> Iterator[dict]:
    """Spots of the usual and of the robust lens of each condition, µm: nominal, and of the trials."""
    for title, case in (CASES | CONDITIONS).items():
        key = "".join(c if c.isalnum() else "_" for c in title)
        ends = store.arrays(key, lambda case=case: desensitised(*case))
        for end, numbers in ends.items():
            lens = lens_of(start_of(*case[:3])[0], numbers)
            judgement = store.arrays(f"{key}_{end}_trials", lambda lens=lens: judged(lens))
            trials = judgement["trials"]
            yield {
                **dict(zip(("lens", "f_number", "field"), case, strict=False)),
                "weight": case[4],
                "lens_of": end,
                "nominal": float(judgement["nominal"]),
                "root_mean_square": float(np.sqrt((trials**2).mean())),
                "mean": float(trials.mean()),
                "below_90": float(np.quantile(trials, 0.9)),
            }


def table_of_conditions(rows: list[dict]) -> Iterator[str]:
    """A row for each condition: nominal spot and those of the trials of the usual lens, their changes by the term."""
    for usual, robust in zip(rows[::2], rows[1::2], strict=True):
        columns = ("nominal", "root_mean_square", "below_90")
        cells = [f"{usual[name]:.2f}, {100 * (robust[name] / usual[name] - 1):+.1f} %" for name in columns]
        condition = f"{usual['lens']}, F/{usual['f_number']:g}, {usual['field']:g}°"
        yield " | ".join([f"| {condition}", f"{usual['weight']:g}", *cells]).replace("-", "−") + " |"


def write_csv(path: Path, rows: list[dict]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows({k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="figures computed so far")
    parser.add_argument("--plot", type=Path, help="figure to write")
    parser.add_argument("--csv", type=Path, help="spots of all conditions, as CSV")
    parser.add_argument("--only", choices=[*CASES, "samples", "conditions"], help="one part")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(parser)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")
    store = Store(arguments.folder, {"grade": GRADE, "seed": SEED, "trials": TRIALS})
    if arguments.only in (None, "samples"):
        for name in ("cooke_triplet", "double_gauss"):
            print("\n".join(table_of_samples(store, name)))
    if arguments.only in (None, "conditions"):
        rows = list(rows_of_conditions(store))
        print("\n".join(table_of_conditions(rows)))
        if arguments.csv:
            write_csv(arguments.csv, rows)
    figure = new_figure(9.0, 3.4 * len(CASES))
    panels = figure.subplots(len(CASES), 3, width_ratios=(1, 1, 1.1))
    for row, (title, case) in zip(panels, CASES.items(), strict=True):
        if arguments.only not in (None, title):
            continue
        ends = store.arrays(title.replace(" ", "_"), lambda case=case: desensitised(*case))
        lens = start_of(*case[:3])[0]
        draw(row, title, {key: lens_of(lens, numbers) for key, numbers in ends.items()}, store)
    if arguments.plot and arguments.only is None:
        save(figure, arguments.plot)


def draw(row, title: str, lenses: dict, store: Store) -> None:
    """Both lenses, the histograms of their trials, and the numbers of the table."""
    for axes, (key, lens) in zip(row, lenses.items(), strict=False):
        found = store.arrays(f"{title}_{key}_trials".replace(" ", "_"), lambda lens=lens: judged(lens))
        trials, nominal = found["trials"], float(found["nominal"])
        draw_layout(axes, lens, fields=drawn_fields(lens), rays=3)
        axes.set_title(f"{title}, {'as built in the merit' if key == 'robust' else 'nominal merit'}", fontsize=9)
        label = f"{'as built' if key == 'robust' else 'nominal'} merit: {nominal:.2f} µm without errors"
        row[2].hist(trials, bins=60, histtype="step", density=True, label=label)
        bound = np.std(trials) / len(trials) ** 0.5
        high = np.quantile(trials, 0.9)
        print(f"{title} {key}: nominal {nominal:.3f}, mean {trials.mean():.3f} ± {bound:.3f}, 90 % below {high:.3f}")
        rms = np.sqrt((trials**2).mean())
        print(f"   root mean square {rms:.3f}; EFL {float(rt.first_order(lens).effective_focal_length):.4f}")
        stored = store.arrays(f"{title}_{key}_sensitivity".replace(" ", "_"), lambda lens=lens: sensitivity(lens))
        waves, changes = stored["waves"], stored["changes"]
        print(f"   root of E[q] in the merit {stored['expected']:.3f} µm")
        print(
            f"   RMS wavefront {float(stored['nominal']):.4f}, root mean square {np.sqrt((waves**2).mean()):.4f} waves"
        )
        print(f"   largest change {changes.max():+.3f} µm: {rt.tolerances(lens, grade=GRADE)[int(changes.argmax())]}")
        angles = np.abs(rt.incidence(lens).angle.numpy()).max((0, 1, 2))
        for k, (curvature, thickness) in enumerate(numbers_of(lens), 1):
            print(f"   {k:2d} {1 / curvature if curvature else np.inf:10.3f} {thickness:8.3f} {angles[k - 1]:6.1f}°")
    row[2].set(xlabel="RMS spot radius as built, µm", ylabel="density")
    row[2].legend(fontsize=7)
    on_one_scale(row[:2])


if __name__ == "__main__":
    main()

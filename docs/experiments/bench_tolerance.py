"""Speed of tolerancing: Cooke triplets perturbed and refocused in a second, and the same errors in Optiland.

    python docs/experiments/bench_tolerance.py --threads 2 --docs FOLDER

docs/tolerancing.md quotes the tables of tables.md.
The lens is Optiland's Cooke triplet, of which its tutorial prints the focal length and the RMS spot radius while the
first radius is moved. Every radius, thickness, decentre and tilt of a surface then has an error, and the sensor is put
where the sum of the mean square spot radii is least: three fields, three wavelengths, each spot about its centroid.
"""

import argparse
import dataclasses
import statistics
import sys
from collections.abc import Callable, Sequence

import bench_kit as kit
import torch
from bench_kit import Page, Request, clock_of, in_words
from pages import digits, listing, significant
from torch import Tensor

from raytrace.bench.measure import clock
from raytrace.cli.progress import progress
from raytrace.materials.catalogs import find_glass
from raytrace.maths.sampling import gauss_rings, hexapolar
from raytrace.plotting.style import new_figure, styled
from raytrace.system.lens import Lens, aligned
from raytrace.system.prescription import lens as lens_of
from raytrace.system.tolerance_data import Compensator, Tolerance
from raytrace.tolerancing.criteria import Criterion, Sampling
from raytrace.tolerancing.perturbation import perturbed
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.study import Study, View
from raytrace.tolerancing.table import ToleranceTable
from raytrace.tracing.focus import spot_parabola
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.spot import image_rays, spot_of

#: Radius and thickness of every surface in mm, and the glass behind it.
ROWS = (
    (22.01359, 3.25896, "SK16"),
    (-435.76044, 6.00755, None),
    (-22.21328, 0.99997, "F2"),
    (20.29192, 4.75041, None),
    (79.68360, 2.95208, "SK16"),
    (-18.39533, 42.20778, None),
)
_CATALOGS = {"SK16": "HIKARI", "F2": "SCHOTT"}
#: Radius of the first surface, focal length and RMS spot radius on the axis, mm, as Optiland's tutorial prints them.
PUBLISHED = ((15.0, 33.469945, 2.701670), (15 + 15 / 127, 33.743491, 2.634001))
TRIALS, PEER_TRIALS = 2048, 12
_RINGS = 4


@dataclasses.dataclass(frozen=True)
class Row:
    """Lenses perturbed and refocused in a second; ratio: over Optiland's; error: the largest relative difference."""

    program: str
    rays: int
    errors: int
    lenses: int
    speed: float
    ratio: float | None = None
    difference: float | None = None


COLUMNS = {
    "program": lambda row: row.program,
    "rays a lens": lambda row: f"{row.rays}",
    "errors": lambda row: f"{row.errors}",
    "lenses/s": lambda row: significant(row.speed),
    "× Optiland": lambda row: significant(row.ratio),
    "largest difference": lambda row: digits(row.difference, none="–"),
}
SWEPT = {
    "radius": lambda row: f"{row[0]:.6f}",
    "focal length, printed": lambda row: f"{row[1]:.6f}",
    "here": lambda row: f"{row[3]:.6f}",
    "RMS spot radius, printed": lambda row: f"{row[2]:.6f}",
    "here|2": lambda row: f"{row[4]:.6f}",
}


def triplet() -> Lens:
    """The lens, F/5, 20 degrees."""
    glasses = {name: find_glass(name, catalogs=(catalog,)) for name, catalog in _CATALOGS.items()}
    return lens_of(
        [{"radius": radius, "thickness": gap, "glass": glasses.get(name)} for radius, gap, name in ROWS],
        stop=4, entrance_pupil_diameter=10.0, fields=(0.0, 14.0, 20.0), wavelengths=(0.48, 0.55, 0.65),
        primary_wavelength=2, name="Cooke triplet of Optiland", ray_aiming="off",
    )  # fmt: skip


def tolerances() -> ToleranceTable:
    """Radius, thickness, decentres and a tilt of every surface, but no decentre of the first.

    In Optiland the beam follows a decentre of the first surface, here the entrance pupil stays.
    """
    rows = [Tolerance("radius", (k,), -0.1, 0.1, unit="%") for k in range(1, 7)]
    rows += [Tolerance("thickness", (k,), -0.05, 0.05) for k in range(1, 6)]
    for axis in "xy":
        rows += [Tolerance(f"element_decenter_{axis}", (k, k), -0.05, 0.05) for k in range(2, 7)]
    rows += [Tolerance(f"element_tilt_{'xy'[k % 2]}", (k, k), -0.05, 0.05) for k in range(1, 7)]
    return ToleranceTable(tuple(rows), (Compensator(6),))


def sampling(lens: Lens, points: Tensor, weights: Tensor) -> Sampling:
    fields = torch.stack([lens.fields.x, lens.fields.y])
    return Sampling(fields, torch.full_like(fields[0], 1 / fields.shape[1]), points, weights)


def _parabola(lens: Lens, given: Sampling) -> tuple[Tensor, Tensor, Tensor]:
    """The mean over fields and wavelengths of the mean square spot radius (L,) as the sensor moves, mm."""
    rays = image_rays(lens, given.points, fields=given.fields)
    return tuple(part.mean((-1, -2)) for part in spot_parabola(rays, given.weights))


def _square(lens: Lens, given: Sampling) -> Tensor:
    return _parabola(lens, given)[0]


CRITERION = Criterion("RMS spot radius of each wavelength", "mm", _square, _parabola)


def study(lens: Lens, rule: tuple[Tensor, Tensor]) -> Study:
    return Study([View(lens, CRITERION, sampling(lens, *rule))], tolerances(), loss=0.01)


@torch.no_grad()
def sweep(lens: Lens, radii: Sequence[float]) -> list[tuple[float, float]]:
    """Focal length and RMS spot radius on the axis, mm, at the primary wavelength, by the first radius."""
    rows = [Tolerance("radius", (1,), -30.0, 30.0)]
    errors = torch.tensor([[radius - ROWS[0][0]] for radius in radii], dtype=torch.float64)
    lenses = aligned(perturbed(lens, rows, errors), 3)
    points, weights = equal_rings(5)
    rays = image_rays(lenses, points, fields=torch.zeros(2, 1, dtype=torch.float64), wavelengths=lens.primary[None])
    spots = spot_of(rays, weights).rms_radius.flatten()
    return list(zip(first_order(lenses).effective_focal_length.flatten().tolist(), spots.tolist(), strict=True))


def bench(request: Request) -> Page:
    """Own and Optiland's trials in a second, and their differences."""
    repeats, lens = request.arguments.repeats, triplet()
    studies = {"hexapolar": study(lens, equal_rings(_RINGS)), "gauss": study(lens, gauss_rings(_RINGS, 6))}
    rows, errors = [], draw_errors(tolerances(), TRIALS)
    with (
        progress(2 * repeats + (PEER_TRIALS + 1 if request.peers else 0), "call", what="measuring") as bar,
        torch.no_grad(),
    ):
        for each in studies.values():
            seconds = _timed(lambda each=each: each.compensated(errors), request.threads, repeats, bar.update)
            rows.append(Row("raytrace", _rays(each), errors.shape[1], TRIALS, TRIALS / seconds))
        if request.peers:
            spots, seconds = request.peers.tolerancing(
                tolerances(), errors[:PEER_TRIALS], _RINGS, bar.update, request.threads
            )
            mine = studies["hexapolar"].compensated(errors[:PEER_TRIALS])[0].sqrt()
            off = float((torch.tensor(spots) / mine - 1).abs().max())
            speed = 1 / statistics.median(seconds)
            rows[0] = dataclasses.replace(rows[0], ratio=rows[0].speed / speed, difference=off)
            rows.append(Row("Optiland", rows[0].rays, errors.shape[1], PEER_TRIALS, speed, 1.0))
    about = {"repeats": repeats, "machine": request.about()}
    lines = report(rows, sweep(lens, [radius for radius, *_ in PUBLISHED]), **about)
    return Page(rows, lines, about, figure, ("tables.md", "tolerancing"))


def equal_rings(rings: int) -> tuple[Tensor, Tensor]:
    """Hexapolar rings, all points of the same weight, as Optiland has them."""
    points, weights = hexapolar(rings)
    return points, torch.full_like(weights, 1 / len(weights))


def _rays(study: Study) -> int:
    return study.sampling.points.shape[1] * study.sampling.fields.shape[1] * len(study.lens.wavelengths)


def _timed(call: Callable[[], object], threads: int, repeats: int, done: Callable[[], object]) -> float:
    """Median s of a call, after one that is not timed."""
    call()
    seconds, now = [], clock(threads)
    for _ in range(repeats):
        start = now()
        call()
        seconds.append(now() - start)
        done()
    return statistics.median(seconds)


def report(rows: Sequence[Row], swept: Sequence[tuple[float, float]], *, repeats: int, machine: dict) -> list[str]:
    """The speeds, the published sweep, and the machine."""
    return [
        "Cooke triplets perturbed and refocused: radii ±0.1 %, thicknesses ±0.05 mm, decentres ±0.05 mm along x and y "
        "of all surfaces but the first, a tilt of ±0.05° of every surface; the sensor at the least mean square spot "
        f"radius of 3 fields and 3 wavelengths. Median {clock_of(machine)} of {repeats} runs of {TRIALS} lenses, of "
        "Optiland of single lenses. Difference: of the criterion, over the lenses that both computed. Optiland's beam "
        "follows a decentre of the first surface, here the entrance pupil stays: this decentre is left out.",
        "",
        *listing(COLUMNS, rows),
        "",
        "The first radius moved, on the axis, as Optiland's tutorial prints it:",
        "",
        *listing(SWEPT, [(*printed, *computed) for printed, computed in zip(PUBLISHED, swept, strict=True)]),
        "",
        in_words(machine) + ".",
    ]


@styled
def figure(rows: Sequence[dict]):
    """Lenses a second of each program."""
    made = new_figure(6.0, 2.6)
    axes = made.subplots()
    names = [f"{row['program']}, {row['rays']} rays" for row in rows]
    speeds = [row["speed"] for row in rows]
    axes.barh(names, speeds)
    for k, speed in enumerate(speeds):
        axes.annotate(f" {significant(speed, 3)}", (speed, k), va="center")
    axes.set(xscale="log", xlabel="lenses perturbed and refocused in a second", xlim=(None, 4 * max(speeds)))
    axes.invert_yaxis()
    return made


def options(parser: argparse.ArgumentParser) -> None:
    kit.shared(parser, "tables.md, tolerancing.csv and tolerancing.png")


def main(argv: Sequence[str] | None = None) -> None:
    kit.run(bench, options, argv, peers=True)


if __name__ == "__main__":
    sys.exit(main())

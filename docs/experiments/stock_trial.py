"""Three lenses built of stock: a triplet, a relay of two doublets and a beam expander (docs/reference/stock.md).

    python docs/experiments/stock_trial.py FOLDER

writes FOLDER/parts.csv, a table of lenses as catalogs list them, by formulas: plano-convex, biconvex, meniscus, plano-
and biconcave lenses of N-BK7, negative ones of N-SF11 too, and achromats of two pairs of glasses; its index
FOLDER/stock.sqlite; and the three designs, FOLDER/triplet.zmx, relay.zmx and expander.zmx, and fits them.
"""

import argparse
import csv
import functools
import math
import time
import warnings
from pathlib import Path

import torch
from scipy.optimize import minimize_scalar

import raytrace as rt

DIAMETERS = 6, 9, 12.5, 25, 50
SINGLETS = 10, 12, 15, 18, 20, 25, 30, 35, 40, 50, 60, 75, 100, 125, 150, 200, 250, 300, 400, 500
NEGATIVE = 10, 15, 20, 25, 30, 40, 50, 75, 100, 150, 200
ACHROMATS = 15, 20, 25, 30, 35, 40, 50, 60, 75, 100, 125, 150, 200, 250, 300, 400, 500
PAIRS = ("N-BK7", "N-SF5"), ("N-BAF10", "N-SF10")
EDGE, CENTRE = 2.0, 2.0  # mm, least thickness of positive lenses at the edge, of negative ones at the centre
D_LINE = 0.5875618


def sag(c: float, h: float) -> float:
    return c * h * h / (1 + (1 - c * c * h * h) ** 0.5)


@functools.cache
def numbers(name: str) -> tuple[float, float]:
    """n_d and V_d of a glass."""
    glass = rt.materials.find_glass(name)
    n = [float(rt.materials.refractive_index(glass, torch.tensor(wave))) for wave in (D_LINE, 0.4861327, 0.6562725)]
    return n[0], (n[0] - 1) / (n[1] - n[2])


def rounded(thickness: float) -> float:
    """To 0.1 mm, upwards."""
    return -(-thickness * 10 // 1) / 10


def focal_length(rows: list[dict]) -> float:
    """Of a paraxial ray at the height 1."""
    y, u, n = 1.0, 0.0, 1.0
    for row in rows:
        behind = numbers(row["glass"])[0] if "glass" in row else 1.0
        u = (n * u - y * (behind - n) * row["curvature"]) / behind
        y, n = y + u * row["thickness"], behind
    return -1 / u


def crossing(rows: list[dict], h: float) -> float:
    """mm from the last vertex at which a real ray at the height h crosses the axis; nan where it fails."""
    y, sine, n, z = h, 0.0, 1.0, 0.0  # sine: of the angle to the axis
    for row in rows:
        c, cosine = row["curvature"], (1 - sine * sine) ** 0.5
        behind = numbers(row["glass"])[0] if "glass" in row else 1.0
        # the sphere c (y² + z²) = 2 z, by the distance s along the ray from its point (y, z)
        B, C = c * (y * sine + z * cosine) - cosine, c * (y * y + z * z) - 2 * z
        if c * C > B * B:
            return math.nan
        s = C / (-B + (B * B - c * C) ** 0.5)
        y, z = y + s * sine, z + s * cosine
        normal = math.asin(c * y)
        angle = math.asin(sine) + normal
        if abs(n * math.sin(angle) / behind) > 1:
            return math.nan
        sine = math.sin(math.asin(n * math.sin(angle) / behind) - normal)
        z, n = z - row["thickness"], behind
    return z - y / math.tan(math.asin(sine))


def singlet(f: float, diameter: float, glass: str, shape: float) -> list[dict] | None:
    """A lens of a focal length and a shape factor X; None where a face is steeper than 55° at the rim."""
    h = diameter / 2
    n, _ = numbers(glass)

    def faces(k: float) -> tuple[float, float]:
        return 0.5 * k * (shape + 1), 0.5 * k * (shape - 1)

    def rows(k: float) -> list[dict]:
        bends = faces(k)
        if max(abs(c) for c in bends) * h > 0.82:
            return []
        between = sag(bends[0], h) - sag(bends[1], h)
        thickness = rounded(max(EDGE + between, CENTRE))
        face = {"semi_diameter": h}
        return [
            {"curvature": bends[0], "thickness": thickness, "glass": glass, **face},
            {"curvature": bends[1], "thickness": 0.0, **face},
        ]

    k = 1 / (f * (n - 1))
    for _ in range(30):  # of the thick lens
        made = rows(k)
        if not made:
            return None
        k *= focal_length(made) / f
    return rows(k) or None


def achromat(f: float, diameter: float, pair: tuple[str, str]) -> list[dict] | None:
    """A cemented lens, F and C together, bent to least spherical aberration of an object at infinity."""
    h = diameter / 2
    (n1, v1), (n2, v2) = map(numbers, pair)
    crown, flint = v1 / (v1 - v2), -v2 / (v1 - v2)

    def rows(c1: float, scale: float = 1.0) -> list[dict]:
        c2 = c1 - scale * crown / f / (n1 - 1)
        c3 = c2 - scale * flint / f / (n2 - 1)
        if max(abs(c1), abs(c2), abs(c3)) * h > 0.82:
            return []
        first = rounded(max(EDGE + sag(c1, h) - sag(c2, h), CENTRE))
        second = rounded(max(EDGE + sag(c2, h) - sag(c3, h), CENTRE))
        face = {"semi_diameter": h}
        return [
            {"curvature": c1, "thickness": first, "glass": pair[0], **face},
            {"curvature": c2, "thickness": second, "glass": pair[1], **face},
            {"curvature": c3, "thickness": 0.0, **face},
        ]

    def spherical(c1: float) -> float:
        made = rows(c1)
        error = abs(crossing(made, 0.8 * h) - crossing(made, 1e-4 * h)) if made else math.inf
        return error if error < 1e9 else 1e9

    best = minimize_scalar(spherical, bounds=(0.3 / f, 3.0 / f), method="bounded", options={"xatol": 1e-4 / f})
    scale, c1 = 1.0, best.x
    for _ in range(30):
        made = rows(c1 * scale, scale)
        if not made:
            return None
        scale *= focal_length(made) / f
    return rows(c1 * scale, scale) or None


def parts() -> list[tuple[str, list[dict]]]:
    """Numbers and faces of all parts, made where their faces are not too steep."""
    made = []
    for diameter in DIAMETERS:
        for f in SINGLETS:
            if 0.9 * diameter < f < 30 * diameter:
                for kind, shape in (("PX", 1.0), ("BX", 0.0), ("PM", 2.0)):
                    made.append((f"{kind}-{diameter:g}-{f}", singlet(f, diameter, "N-BK7", shape)))
        for f in NEGATIVE:
            if 0.9 * diameter < f < 20 * diameter:
                for glass in ("N-BK7", "N-SF11"):
                    mark = "" if glass == "N-BK7" else "F"
                    for kind, shape in (("PC", -1.0), ("BC", 0.0)):
                        made.append((f"{kind}{mark}-{diameter:g}-{f}", singlet(-f, diameter, glass, shape)))
        for f in ACHROMATS:
            if 1.6 * diameter < f < 20 * diameter:
                for mark, pair in zip("AB", PAIRS, strict=True):
                    made.append((f"AC{mark}-{diameter:g}-{f}", achromat(f, diameter, pair)))
    return [(name, rows) for name, rows in made if rows]


def table(path: Path) -> int:
    """Write the parts as a table; their count."""
    every = parts()
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        faces = [f"{name}_{k}" for k in (1, 2) for name in ("radius", "thickness", "glass")]
        writer.writerow(["part", "vendor", "diameter", *faces, "radius_3"])
        for name, rows in every:
            cells: list = [name, "formulas", 2 * rows[0]["semi_diameter"]]
            for row in rows:
                radius = "inf" if not row["curvature"] else repr(1 / float(row["curvature"]))
                cells += [radius, row["thickness"], row["glass"]] if "glass" in row else [radius]
            writer.writerow(cells)
    return len(every)


def designs() -> dict[str, tuple[rt.Lens, dict]]:
    """The designs, and how each is optimised."""
    colours = {"wavelengths": [D_LINE, 0.4861, 0.6563]}
    triplet = rt.edit.scale("cooke_triplet", efl=50).at(f_number=5.6, fields=[0, 7, 10])
    relay = rt.lens(
        [
            dict(radius=61, thickness=6, glass="N-BK7"), dict(radius=-45, thickness=2.5, glass="N-SF5"),
            dict(radius=-130, thickness=30), dict(thickness=30),
            dict(radius=130, thickness=2.5, glass="N-SF5"), dict(radius=45, thickness=6, glass="N-BK7"),
            dict(radius=-61, thickness=95),
        ],
        stop=4, object_distance=95.0, fields=[0, 3, 5], object_na=0.07, name="Relay 1 : 1 of two doublets", **colours,
    )  # fmt: skip
    expander = rt.lens(
        [
            dict(radius=-30, thickness=2.5, glass="N-BK7"), dict(radius=30, thickness=100),
            dict(radius=75, thickness=6, glass="N-BK7"), dict(radius=-60, thickness=3, glass="N-SF5"),
            dict(radius=-180, thickness=50),
        ],
        stop=1, entrance_pupil_diameter=4, fields=[0, 0.5], name="Beam expander 5 x", **colours,
    )  # fmt: skip
    free = {"vary": "curvature thickness", "merit": "spot"}
    return {
        "triplet": (triplet, free | {
            "vary": "curvature thickness:2,4,5,7", "hold": "efl=50 air_thickness>=0.5 total_track<=80",
        }),
        "relay": (relay, free | {
            "vary": "curvature thickness:0,3,4,7", "hold": "magnification=-1 air_thickness>=0.5",
        }),
        "expander": (expander, free | {
            "vary": "curvature thickness:2", "merit": "angular", "hold": "angular_magnification=0.2",
            "bounds": "thickness_2:60..130",
        }),
    }  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("folder", type=Path, help="folder of the parts, their index and the lenses")


def main(folder: Path) -> None:
    torch.set_num_threads(1)
    warnings.simplefilter("ignore")
    folder.mkdir(exist_ok=True)
    print(f"{table(folder / 'parts.csv')} parts")
    started = time.process_time()
    print(rt.stock_index(folder / "parts.csv", folder / "stock.sqlite"))
    print(f"index: {time.process_time() - started:.1f} s of processor time")
    for name, (lens, how) in designs().items():
        designed = rt.optimize(lens, **how)
        rt.write_lens(designed.lens, folder / f"{name}.zmx")
        started = time.process_time()
        fitted = rt.optimize(designed.lens, stock=folder / "stock.sqlite", **how)
        seconds = time.process_time() - started
        rt.write_lens(fitted.lens, folder / f"{name}_stock.zmx")
        print(f"{name}: merit {designed.merit_after:.6g} → {fitted.merit_after:.6g}, {seconds:.1f} s of processor time")
        print(fitted, flush=True)


if __name__ == "__main__":
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options(arguments)
    main(**vars(arguments.parse_args()))

"""The table of extended depth of field: every baseline and the learned elements, on several kinds of pictures.

Sitzmann et al. (SIGGRAPH 2018), who defined the task, give the PSNR of restored pictures for six elements;
its pictures, filters and prescriptions are its own, so that gains over its Fresnel lens are what compares.
"""

import csv
import dataclasses
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from torch import Tensor

from raytrace.files import write_atomically
from raytrace.studies.edof.world import Quality, World, expected_error, kernels, quality, transfer
from raytrace.wave.designs import Aim, aim, baseline
from raytrace.wave.element import Element

#: PSNR in dB as Sitzmann et al. published it, by our name of the row.
PUBLISHED = {
    "fresnel": 17.95,
    "multifocal": 18.32,
    "cubic": 18.33,
    "hybrid": 18.92,
    "achromat": 20.20,
    "learned": 24.30,
}

#: Rows: (name, what it is called, of BASELINES or None where it is learned).
ROWS: tuple[tuple[str, str, str | None], ...] = (
    ("fresnel", "Fresnel lens", "fresnel"),
    ("multifocal", "multifocal Fresnel lens", "multifocal"),
    ("cubic", "cubic plate on a Fresnel lens", "cubic"),
    ("hybrid", "hybrid achromat", "hybrid"),
    ("achromat", "diffractive achromat", "achromat"),
    ("singlet", "PMMA singlet", "singlet"),
    ("ideal", "ideal lens without dispersion", "ideal"),
    ("multifocal-refractive", "multifocal PMMA lens", "multifocal-refractive"),
    ("cubic-refractive", "cubic plate on a PMMA lens", "cubic-refractive"),
    ("learned-smooth", "learned, smooth PMMA", None),
    ("learned", "learned, fused silica rings", None),
    ("learned-16", "learned, wrapped, 16 levels", None),
)
#: Other ways of learning, (name, what it is called): rows that are there only where they are asked for.
ALSO = (
    ("learned-images", "rings, learned from pictures"),
    ("learned-adadelta", "rings, from pictures by Adadelta"),
    ("learned-zernike", "learned, Zernike PMMA, by Adadelta"),
)
NAMES = {name: title for name, title, *_ in (*ROWS, *ALSO)}

#: Strengths of cubic plates in waves that are tried; the best in closed form is taken.
STRENGTHS = (5.0, 10.0, 15.0, 20.0, 30.0)

COLUMNS = ("content", "row", "wiener", "blind", "gain_wiener", "gain_blind", "spread_blind", "worst_blind", "published")


@dataclasses.dataclass(frozen=True)
class Content:
    """Pictures (B, n, n), periodic: to make filters for, and to restore."""

    name: str
    train: Tensor
    test: Tensor


def aim_of(world: World) -> Aim:
    return aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design, exact=world.exact)


def elements_of(
    rows: Iterable[str], world: World, S: Tensor, *, learned: Mapping[str, Sequence[Element]]
) -> dict[str, Sequence[Element]]:
    """The elements of rows, in the order of the table: learned ones as given, those that are not there left out.

    Cubic plates have the strength that is best for pictures of spectrum S (n, n) on the PMMA lens, searched once.
    """
    made_for, wanted = aim_of(world), set(rows)
    kinds = {name: kind for name, _, kind in ROWS if name in wanted and kind}
    options = {}
    if any(kind.startswith("cubic") for kind in kinds.values()):
        options = {"strength": min(STRENGTHS, key=lambda own: _error_of_cubic(own, made_for, world, S))}
    found = {
        name: baseline(kind, made_for, **(options if kind.startswith("cubic") else {})) for name, kind in kinds.items()
    }
    found |= {name: elements for name, elements in learned.items() if name in wanted}
    return {name: found[name] for name in NAMES if name in found}


def _error_of_cubic(strength: float, made_for: Aim, world: World, S: Tensor) -> float:
    elements = baseline("cubic-refractive", made_for, strength=strength)
    return float(expected_error(transfer(kernels(elements, world), S.shape[-1]), S, world.noise))


def table_of(
    contents: Sequence[Content],
    elements: Mapping[str, Sequence[Element]],
    world: World,
    *,
    progress: Callable[[Iterable], Iterable] = iter,
) -> dict[str, dict[str, Quality]]:
    """Quality by content and row, of the elements of each row."""
    found: dict[str, dict[str, Quality]] = {content.name: {} for content in contents}
    for name in progress(list(elements)):
        own = kernels(elements[name], world)
        for content in contents:
            found[content.name][name] = quality(
                elements[name], world, train=content.train, test=content.test, found=own
            )
    return found


def records(found: Mapping[str, Mapping[str, Quality]]) -> list[dict]:
    """The table, a row for each content and element; gains over the Fresnel lens, dB."""
    result = []
    for content, rows in found.items():
        base = rows.get("fresnel")
        for name, own in rows.items():
            record = {"content": content, "row": name, **own.mean}
            for filter in own.mean:
                record[f"gain_{filter}"] = own.mean[filter] - base.mean[filter] if base else None
            record["spread_blind"] = own.spread["blind"]
            record["worst_blind"] = min(own.by_depth["blind"])
            record["published"] = PUBLISHED.get(name)
            result.append(record)
    return result


def write_records(found: Mapping[str, Mapping[str, Quality]], path: Path) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, lineterminator="\n")
    writer.writeheader()
    writer.writerows({key: _rounded(value) for key, value in record.items()} for record in records(found))
    write_atomically(path, lambda file: file.write(text.getvalue().encode()))


def _rounded(value):
    return round(value, 3) if isinstance(value, float) else "" if value is None else value

"""The table of extended depth of field: every baseline and the learned elements, on several kinds of pictures.

The talk that defined the task (Sitzmann et al., SIGGRAPH 2018) gives the PSNR of restored pictures for six elements;
its pictures, filters and prescriptions are its own, so that gains over its Fresnel lens are what compares.
"""

import csv
import dataclasses
import io
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path

from torch import Tensor

from raytrace.design.edof import Quality, World, expected_error, kernels, quality, spectrum, transfer
from raytrace.files import write_atomically
from raytrace.wave.aim import Aim, aim
from raytrace.wave.baselines import baseline
from raytrace.wave.element import Element

#: PSNR in dB as the talk gives it, by our name of the row.
TALK = {
    "fresnel": 17.95,
    "multifocal": 18.32,
    "cubic": 18.33,
    "hybrid": 18.92,
    "achromat": 20.20,
    "learned": 24.30,
}

#: Rows: (name, what it is called, of BASELINES or None where it is learned, its options).
ROWS: tuple[tuple[str, str, str | None, dict], ...] = (
    ("fresnel", "Fresnel lens", "fresnel", {}),
    ("multifocal", "multifocal Fresnel lens", "multifocal", {}),
    ("cubic", "cubic plate on a Fresnel lens", "cubic", {}),
    ("hybrid", "hybrid achromat", "hybrid", {}),
    ("achromat", "diffractive achromat", "achromat", {}),
    ("singlet", "PMMA singlet", "singlet", {}),
    ("ideal", "ideal lens without dispersion", "ideal", {}),
    ("multifocal-refractive", "multifocal PMMA lens", "multifocal-refractive", {}),
    ("cubic-refractive", "cubic plate on a PMMA lens", "cubic-refractive", {}),
    ("learned-smooth", "learned, smooth PMMA", None, {}),
    ("learned", "learned, fused silica rings", None, {}),
    ("learned-16", "learned, wrapped, 16 levels", None, {}),
)
NAMES = {name: title for name, title, *_ in ROWS}

#: Strengths of cubic plates in waves that are tried; the best in closed form is taken.
STRENGTHS = (5.0, 10.0, 15.0, 20.0, 30.0)

COLUMNS = ("content", "row", "wiener", "blind", "gain_wiener", "gain_blind", "spread_blind", "worst_blind", "talk")


@dataclasses.dataclass(frozen=True)
class Content:
    """Pictures (B, n, n), periodic: to make filters for, and to restore."""

    name: str
    train: Tensor
    test: Tensor


def aim_of(world: World) -> Aim:
    return aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design, exact=world.exact)


def elements_of(name: str, world: World, S: Tensor) -> tuple[Element, ...]:
    """A baseline; of cubic plates the strength that is best for pictures of spectrum S (n, n), on the PMMA lens."""
    made_for = aim_of(world)
    (kind,) = [kind for row, _, kind, _ in ROWS if row == name]
    if not name.startswith("cubic"):
        return baseline(kind, made_for)
    strength = min(
        STRENGTHS, key=lambda own: _closed_form(baseline("cubic-refractive", made_for, strength=own), world, S)
    )
    return baseline(kind, made_for, strength=strength)


def _closed_form(elements: Sequence[Element], world: World, S: Tensor) -> float:
    return float(expected_error(transfer(kernels(elements, world), S.shape[-1]), S, world.noise))


def table_of(
    contents: Sequence[Content],
    world: World,
    learned: Mapping[str, Sequence[Element]],
    *,
    rows: Sequence[str] | None = None,
    progress: Callable[[Iterable], Iterable] = iter,
) -> dict[str, dict[str, Quality]]:
    """Quality by content and row. learned: the elements of the rows that are not baselines."""
    wanted = [name for name, _, kind, _ in ROWS if (rows is None or name in rows) and (kind or name in learned)]
    found: dict[str, dict[str, Quality]] = {content.name: {} for content in contents}
    S = spectrum(contents[0].train)
    for name in progress(wanted):
        elements = learned[name] if name in learned else elements_of(name, world, S)
        found_kernels = kernels(elements, world)
        for content in contents:
            found[content.name][name] = quality(
                elements, world, train=content.train, test=content.test, found=found_kernels
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
            record["talk"] = TALK.get(name)
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

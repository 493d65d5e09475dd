"""The table of extended depth of field: every baseline and the learned elements, on several kinds of pictures.

Sitzmann et al. (SIGGRAPH 2018), who defined the task, give the PSNR of restored pictures for six elements;
its pictures, filters and prescriptions are its own, so that gains over its Fresnel lens are what compares.
"""

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence

from torch import Tensor

from raytrace.studies.edof.world import Quality, World, expected_error, kernels, quality, transfer
from raytrace.wave_optics.designs import Aim, aim, baseline
from raytrace.wave_optics.element import Element


@dataclasses.dataclass(frozen=True)
class Row:
    """title: what it is called; published: PSNR in dB by Sitzmann et al.; learning: settings it is learned with, else
    it is the baseline of its name; is_extra: only there where it is asked for."""

    title: str
    published: float | None = None
    learning: dict | None = None
    is_extra: bool = False


_FROM_PICTURES = {"kind": "rings", "loss": "images", "restoration": "towards"}
_ADADELTA = {"optimizer": "adadelta", "schedule": "constant", "rate": 1.0}

ROWS = {
    "fresnel": Row("Fresnel lens", 17.95),
    "multifocal": Row("multifocal Fresnel lens", 18.32),
    "cubic": Row("cubic plate on a Fresnel lens", 18.33),
    "hybrid": Row("hybrid achromat", 18.92),
    "achromat": Row("diffractive achromat", 20.20),
    "singlet": Row("PMMA singlet"),
    "ideal": Row("ideal lens without dispersion"),
    "multifocal-refractive": Row("multifocal PMMA lens"),
    "cubic-refractive": Row("cubic plate on a PMMA lens"),
    "learned-smooth": Row("learned, smooth PMMA", learning={"kind": "smooth", "glass": "PMMA"}),
    "learned": Row("learned, fused silica rings", 24.30, {"kind": "rings"}),
    "learned-16": Row("learned, wrapped, 16 levels", learning={"kind": "rings", "levels": 16}),
    "learned-images": Row("rings, learned from pictures", learning=_FROM_PICTURES, is_extra=True),
    "learned-adadelta": Row("rings, from pictures by Adadelta", learning=_FROM_PICTURES | _ADADELTA, is_extra=True),
    "learned-zernike": Row(
        "learned, Zernike PMMA, by Adadelta",
        learning={"kind": "zernike", "glass": "PMMA", "terms": 22, "spread": 0.05, **_ADADELTA},
        is_extra=True,
    ),
}


def title_of(row: str) -> str:
    """Of a row of the table, or of a file."""
    return ROWS[row].title if row in ROWS else row


#: Strengths of cubic plates in waves that are tried; the best in closed form is taken.
STRENGTHS = (5.0, 10.0, 15.0, 20.0, 30.0)


@dataclasses.dataclass(frozen=True)
class Content:
    """Pictures (B, n, n), periodic: to make filters for, and to restore; classes: of those, each its own by default."""

    name: str
    train: Tensor
    test: Tensor
    classes: tuple[str, ...] = ()


def elements_of(
    rows: Iterable[str], world: World, S: Tensor, *, learned: Mapping[str, Sequence[Element]]
) -> dict[str, Sequence[Element]]:
    """The elements of rows, in the order of the table: learned ones as given, those that are not there left out.

    Cubic plates have the strength that is best for pictures of spectrum S (n, n) on the PMMA lens, searched once.
    """
    made_for = aim(radius=world.radius, sensor=world.sensor_distance, focus=world.design, exact=world.exact)
    named = [name for name in ROWS if name in set(rows)]
    options = {}
    if any(name.startswith("cubic") for name in named):
        options = {"strength": min(STRENGTHS, key=lambda own: _error_of_cubic(own, made_for, world, S))}
    found = {}
    for name in named:
        if ROWS[name].learning is None:
            found[name] = baseline(name, made_for, **(options if name.startswith("cubic") else {}))
        elif name in learned:
            found[name] = learned[name]
    return found


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
            gains = {f"gain_{filter}": own.mean[filter] - base.mean[filter] if base else None for filter in own.mean}
            each = {f"mean_{filter}": value for filter, value in own.of_pictures.items()}
            each |= {
                f"mean_gain_{filter}": value - base.of_pictures[filter] if base else None
                for filter, value in own.of_pictures.items()
            }
            spread = {"spread_blind": own.spread["blind"], "worst_blind": min(own.by_depth["blind"])}
            head = {"content": content, "row": name}
            result.append({**head, **own.mean, **gains, **each, **spread, "published": ROWS[name].published})
    return result

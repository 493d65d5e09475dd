"""Label: what belongs to a height map beside its heights, in a file next to it: heights.npy has heights.npy.json.

Heights are a lens only in their material: the same heights in another glass bend light by another n - 1. The label
holds the whole glass, so that it needs no catalog, the wavelength that the heights were made for, and their size.
"""

import dataclasses
import json
import os
from pathlib import Path

import torch

from raytrace.files import write_atomically
from raytrace.media.formulas import FORMULAS
from raytrace.media.glass import Glass
from raytrace.wave.element import Element
from raytrace.wave.exchange import HeightMapError, write_heights


@dataclasses.dataclass(frozen=True, eq=False)
class Label:
    """glass: the material; design_wavelength: µm; pitch, aperture: mm, of the heights and the element's diameter."""

    glass: Glass
    design_wavelength: float
    pitch: float
    aperture: float


def write_element(element: Element, path: str | os.PathLike, *, design_wavelength: float) -> tuple[Path, Path]:
    """Write the heights of an element in the format of the suffix, and its label next to them; both paths.

    Raises HeightMapError for what the format cannot hold.
    """
    path, glass = Path(path), element.glass
    write_heights(element.profile, path)
    document = {
        "material": glass.name,
        "catalog": glass.catalog,
        "formula": glass.formula,
        "coefficients": glass.coefficients.detach().tolist(),
        "wavelength_range": glass.wavelength_range,
        "design_wavelength": design_wavelength,
        "pitch": float(element.profile.pitch.detach()),
        "aperture": 2 * float(element.radius.detach()),
    }
    label = label_of(path)
    write_atomically(label, lambda file: file.write(json.dumps(document, indent=1).encode()))
    return path, label


def label_of(path: str | os.PathLike) -> Path:
    """The file of the label of a height map."""
    return Path(f"{path}.json")


def read_label(path: str | os.PathLike) -> Label | None:
    """The label of a height map, None where there is none. Raises HeightMapError for one that cannot be read."""
    file = label_of(path)
    if not file.exists():
        return None
    try:
        found = json.loads(file.read_text(encoding="utf-8"))
        coefficients = torch.tensor(found["coefficients"], dtype=torch.float64)
        if FORMULAS[found["formula"]].count != len(coefficients):
            raise ValueError(f"{len(coefficients)} coefficients of {found['formula']}")
        span = found["wavelength_range"]
        numbers = {key: float(found[key]) for key in ("design_wavelength", "pitch", "aperture")}
        if not all(0 < number < float("inf") for number in numbers.values()):
            raise ValueError(f"found {numbers}, expected numbers above 0")
        glass = Glass(
            str(found["material"]),
            found["formula"],
            coefficients,
            str(found["catalog"]),
            wavelength_range=None if span is None else (float(span[0]), float(span[1])),
        )
    except (OSError, ValueError, KeyError, TypeError, IndexError, RecursionError) as error:
        words = f"{type(error).__name__}: {' '.join(str(error).split())[:120]}"
        raise HeightMapError(f"is no label of a height map ({words}); remove it", str(file)) from error
    return Label(glass, **numbers)

"""An element in files: its heights, and beside them what else belongs to it: heights.npy has heights.npy.json.

Heights are a lens only in their material: the same heights in another glass bend light by another n - 1. The label
holds the whole glass, so that it needs no catalog, the wavelength that the heights were made for, and their size.
"""

import dataclasses
import json
import os
from collections.abc import Sequence
from pathlib import Path

import torch

from raytrace.files import write_json
from raytrace.media.catalog import find_glass
from raytrace.media.formulas import FORMULAS
from raytrace.media.glass import Glass
from raytrace.wave.element import Element, Rings, wrapped
from raytrace.wave.exchange import HeightMapError, read_heights, write_heights


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
    write_json(_label_of(path), document)
    return path, _label_of(path)


def read_element(
    path: str | os.PathLike,
    *,
    aperture: float,
    glass: Glass | str | None = None,
    pitch: float | None = None,
    span: Sequence[float] | None = None,
    design_wavelength: float | None = None,
    levels: int = 0,
    catalog: Sequence[str | os.PathLike] = (),
) -> Element:
    """The element of a file of heights in an aperture of so many mm.

    glass: its material, by default that of its label; a name is looked up, first in the catalogs (.agf) given. pitch,
    span: mm, of a file that does not say them (`read_heights`), nor its label. design_wavelength (µm), levels: the
    heights are wrapped there, in so many steps, if either is given.
    Raises HeightMapError for a file that cannot be read, ValueError for heights that do not fill the aperture or whose
    material or design wavelength nobody knows.
    """
    label = read_label(path)
    profile = read_heights(path, pitch=pitch or (label and label.pitch), span=tuple(span) if span else None)
    profile = dataclasses.replace(profile, heights=profile.heights.double(), pitch=profile.pitch.double())
    counts = (2 * len(profile.heights),) if isinstance(profile, Rings) else profile.heights.shape
    across = min(counts) * float(profile.pitch)
    # What is cut to whole features may miss the rim by one of them.
    if across + 2 * float(profile.pitch) < aperture:
        raise ValueError(
            f"{path}: the heights are {across:.6g} mm across, less than the aperture of {aperture:g} mm; "
            f"give `aperture={across:.6g}`"
        )
    if isinstance(glass, str):
        glass = find_glass(glass, user=tuple(catalog))
    if glass is None and label is None:
        raise ValueError(
            f"{path}: does not say its material (there is no {_label_of(path).name} beside it); give `glass=NAME`, as "
            "PMMA, or `index=N` for each wavelength where that is taken"
        )
    element = Element(profile, torch.tensor(0.5 * aperture, dtype=torch.float64), glass or label.glass)
    if not (design_wavelength or levels):
        return element
    design = design_wavelength or (label and label.design_wavelength)
    if not design:
        raise ValueError(f"{path}: does not say what it was made for; give `design_wavelength`")
    return wrapped(element, design, levels=levels)


def read_label(path: str | os.PathLike) -> Label | None:
    """The label of a height map, None where there is none. Raises HeightMapError for one that cannot be read."""
    file = _label_of(path)
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


def _label_of(path: str | os.PathLike) -> Path:
    return Path(f"{path}.json")

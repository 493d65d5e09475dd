"""Files of an element: its heights, as heights.npy, and a label with its other data, heights.npy.json.

Heights are a lens only with their material. The label holds the whole glass, so that it needs no catalog, the design
wavelength and the size. A smooth element is a few coefficients: all of it is in its label, smooth.json.
"""

import dataclasses
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from raytrace.files import read_bytes, write_json
from raytrace.materials.catalogs import find_glass
from raytrace.materials.glass import FORMULAS, Glass
from raytrace.maths.numerics import to
from raytrace.stores import Unfit, either, exactly, listed, number, parsed, record, text
from raytrace.wave_optics.element import Element, EvenPowers, Profile, Zernike, check_fills, has_features
from raytrace.wave_optics.fabrication import fabricated, height_range, wrapped
from raytrace.wave_optics.height_maps import FORMATS, HeightMapError, read_heights, write_heights
from raytrace.words import option

#: Suffix of smooth elements, and their profiles by their name in the file.
SMOOTH = ".json"
_PROFILES: dict[str, type[EvenPowers | Zernike]] = {
    "even powers of r, mm^(1 - 2k)": EvenPowers,
    "Noll's polynomials, mm RMS": Zernike,
}

_MOST = 1 << 26  # bytes of a label

#: Suffixes of all files that hold an element.
ELEMENT_FORMATS = (*FORMATS, SMOOTH)


@dataclasses.dataclass(frozen=True, eq=False)
class Label:
    """glass: the material; design_wavelength: µm; pitch, aperture: mm, of the heights and the element's diameter.

    profile: of a smooth element, which has no pitch.
    """

    glass: Glass
    design_wavelength: float
    aperture: float
    pitch: float | None = None
    profile: EvenPowers | Zernike | None = None


def write_element(element: Element, path: str | os.PathLike, *, design_wavelength: float) -> tuple[Path, Path]:
    """Write the heights of an element in the format of the suffix, and its label next to them; both paths. A smooth
    element's name ends in .json: it is its shape label.

    Heights are those of `fabricated`: modulo the period, in steps; the file has no period. The label has their range in
    the aperture, mm. Raises HeightMapError for data that the format cannot hold.
    """
    path, glass, profile = Path(path), element.glass, element.profile
    shape: dict[str, Any] = {}
    if has_features(profile):
        write_heights(fabricated(element).profile, path)
        shape = {"pitch": float(profile.pitch.detach())}
    elif path.suffix.lower() != SMOOTH:
        write_heights(profile, path)  # raises HeightMapError
    elif element.period is not None:
        raise HeightMapError("a wrapped profile is not smooth; take as_rings or as_pixels", str(path))
    else:
        name = next(name for name, kind in _PROFILES.items() if isinstance(element.profile, kind))
        shape = {"profile": name, "coefficients_of_profile": element.numbers.detach().tolist()}
    document = {
        "material": glass.name,
        "catalog": glass.catalog,
        "formula": glass.formula,
        "coefficients": glass.coefficients.detach().tolist(),
        "wavelength_range": glass.wavelength_range,
        "design_wavelength": design_wavelength,
        "aperture": 2 * float(element.radius.detach()),
        "height_range": height_range(element),
        **shape,
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
    """The element of a file of heights, or of a smooth one, in an aperture of so many mm.

    glass: its material, by default that of its label; a name is looked up, first in the catalogs (.agf) of `catalog`.
    pitch, span: mm, of a file without them (`read_heights`) and without a label. design_wavelength (µm), levels: the
    heights are wrapped there, in so many steps, if either is given. Raises HeightMapError for a file that cannot be
    read, ValueError for heights that do not fill the aperture or without material or design wavelength.
    """
    label, file = read_label(path), str(path)
    if isinstance(glass, str):
        glass = find_glass(glass, user=tuple(map(Path, catalog)))
    profile: Profile
    if Path(path).suffix.lower() == SMOOTH:
        if label is None or label.profile is None:
            raise HeightMapError("is no smooth element: expected the coefficients of one", file)
        if pitch is not None or span is not None:
            raise ValueError(f"{file}: is smooth; {option('pitch')} and {option('span')} belong to a height map")
        profile, is_fixed = label.profile, isinstance(label.profile, Zernike)
        if aperture > label.aperture * (1 + 1e-9) or (is_fixed and aperture < label.aperture * (1 - 1e-9)):
            raise ValueError(f"{file}: is made for an aperture of {label.aperture:g} mm, not {aperture:g} mm")
    else:
        low_high = (span[0], span[1]) if span else None
        heights = read_heights(path, pitch=pitch or (None if label is None else label.pitch), span=low_high)
        profile = to(heights, dtype=torch.float64)
        check_fills(profile, aperture, f"{path}: ")
    if glass is None and label is not None:
        glass = label.glass
    if glass is None:
        raise ValueError(
            f"{path}: has no material (there is no {_label_of(path).name}); give {option('glass', 'NAME')}, as PMMA, "
            "or "
            f"{option('index', 'N')} for each wavelength"
        )
    element = Element(profile, torch.tensor(0.5 * aperture, dtype=torch.float64), glass)
    if not (design_wavelength or levels):
        return element
    design = design_wavelength or (None if label is None else label.design_wavelength)
    if not design:
        raise ValueError(f"{path}: has no design wavelength; give {option('design_wavelength')}")
    return wrapped(element, design, levels=levels)


def read_label(path: str | os.PathLike) -> Label | None:
    """The label of a height map, None if there is none. Raises HeightMapError for one that cannot be read."""
    file = _label_of(path)
    if not file.exists():
        return None
    try:
        document = parsed(read_bytes(file, _MOST))
        is_smooth = isinstance(document, dict) and "profile" in document
        label: Any = (_SMOOTH if is_smooth else _OF_HEIGHTS)(document)
        count, span = FORMULAS[label["formula"]].count, label["wavelength_range"]
        if len(label["coefficients"]) != count:
            raise Unfit(f"coefficients: found a list of {len(label['coefficients'])}, expected {count} of them")
        if span is not None and not span[0] < span[1]:
            raise Unfit(f"wavelength_range: found {span[0]:g} to {span[1]:g} µm, expected the shorter wavelength first")
    except (OSError, Unfit) as error:
        line = error.line or None if isinstance(error, Unfit) else None
        raise HeightMapError(f"is no label of a height map ({error}); remove it", str(file), line) from error
    sizes = ("design_wavelength", "aperture", *([] if "profile" in label else ["pitch"]))
    coefficients = torch.tensor(label["coefficients"], dtype=torch.float64)
    span = None if span is None else tuple(span)
    glass = Glass(label["material"], label["formula"], coefficients, label["catalog"], wavelength_range=span)
    profile = None
    if "profile" in label:
        coefficients = torch.tensor(label["coefficients_of_profile"], dtype=torch.float64)
        profile = _PROFILES[label["profile"]](coefficients)
    return Label(glass, **{name: label[name] for name in sizes}, profile=profile)


_ABOVE_0 = number(math.ulp(0.0))
_GLASS = {
    "material": text,
    "catalog": text,
    "formula": exactly(*FORMULAS),
    "coefficients": listed(number()),
    "wavelength_range": either(exactly(None), listed(_ABOVE_0, 2, 2)),
    "design_wavelength": _ABOVE_0,
    "aperture": _ABOVE_0,
}
_INFORMATION = {"height_range": listed(number(), 2, 2)}  # older labels have none
_OF_HEIGHTS = record(_GLASS | {"pitch": _ABOVE_0}, _INFORMATION)
_PROFILE = {"profile": exactly(*_PROFILES), "coefficients_of_profile": listed(number(), 1)}
_SMOOTH = record(_GLASS | _PROFILE, _INFORMATION)


def _label_of(path: str | os.PathLike) -> Path:
    return Path(path) if Path(path).suffix.lower() == SMOOTH else Path(f"{path}.json")

"""Identity of a lens in the files that store numbers for it."""

import dataclasses
import hashlib
import math
from collections.abc import Mapping, Sequence
from typing import Any

import torch
from torch import Tensor

from raytrace.maths.result import number, plain
from raytrace.system.lens import Lens

#: Fields that change no ray.
_WORDS = {
    *("name", "notes", "comment", "catalogs", "optimization_data", "catalog", "status", "nd_listed", "abbe_listed"),
    *("alternatives", "listed_name", "records", "wavelength_range", "afocal"),
}
_SHOWN = ("curvature", "thickness")  # of a surface, in its identity
#: Names that fields had when the first identities were stored: a digest hashes these, so that stored ones stay valid.
_DIGESTED = {"sag_terms": "departure", "paths": "places"}


def identity(lens: Lens) -> dict[str, Any]:
    """The lens's name, the curvatures (1/mm), thicknesses (mm) and glasses of its surfaces, and two digests: of all
    numbers of the surfaces behind the object, and of the conditions, such as object distance, fields and wavelengths.

    Plain values, for JSON. A lens has one identity in float32 and float64: digests are of numbers to seven digits.
    """
    surfaces = [[*(number(getattr(surface, name)) for name in _SHOWN), surface.glass.name] for surface in lens.surfaces]
    conditions = {field.name: getattr(lens, field.name) for field in dataclasses.fields(lens)} | {
        "surfaces": lens.surfaces[0]
    }
    return {
        "lens": lens.name,
        "surfaces": plain(surfaces),
        "prescription": digest(lens.surfaces[1:]),
        "conditions": digest(conditions),
    }


def digest(*values: object) -> str:
    """A digest of tensors, numbers, texts, and dataclasses and lists of them, but for their comments."""
    hashed = hashlib.sha256()
    _add(hashed, values)
    return hashed.hexdigest()[:32]


def _add(hashed: "hashlib._Hash", value: object) -> None:
    if isinstance(value, Tensor):
        hashed.update(repr(tuple(value.shape)).encode())
        numbers = value.detach().cpu()
        # + 0.0 makes -0 a 0
        hashed.update((numbers.to(torch.float32) + 0.0).contiguous().numpy().tobytes())
    elif isinstance(value, float):
        _add(hashed, torch.tensor(value))
    elif dataclasses.is_dataclass(value):
        hashed.update(type(value).__name__.encode())
        names = [field.name for field in dataclasses.fields(value)]
        _add(hashed, {_DIGESTED.get(name, name): getattr(value, name) for name in names})
    elif isinstance(value, Mapping):
        _add(hashed, [(name, entry) for name, entry in value.items() if name not in _WORDS])
    elif isinstance(value, Sequence) and not isinstance(value, str):
        hashed.update(b"[")
        for entry in value:
            _add(hashed, entry)
        hashed.update(b"]")
    else:
        hashed.update(f"{value!r};".encode())


def other_lens(before: Mapping, now: Mapping) -> str:
    """How one lens differs from another by their identities, "" where it does not; conditions are not compared."""
    if before["prescription"] == now["prescription"]:
        return ""
    names = before["lens"] or "a lens without a name", now["lens"] or "a lens without a name"
    counts = [len(lens["surfaces"]) - 1 for lens in (before, now)]
    if names[0] != names[1] or counts[0] != counts[1]:
        return f"{names[0]!r} of {counts[0]} surfaces, not {names[1]!r} of {counts[1]}"
    for k, (a, b) in enumerate(zip(before["surfaces"], now["surfaces"], strict=True)):
        for quantity, stored, current in zip((*_SHOWN, "glass"), a, b, strict=True):
            if k and not alike(stored, current):
                return f"{names[0]!r} with {quantity} {_shown(stored)} of surface {k}, not {_shown(current)}"
    return f"{names[0]!r} with other numbers of its surfaces"


def unlike(before: Mapping, now: Mapping) -> str:
    """How the conditions of stored numbers differ from the current ones, "" where they do not.

    Both: `identity` of a lens, the names of its variables, and all else that decides the numbers, by name.
    """
    try:
        if "prescription" in now and "prescription" not in before:
            return "an unidentified lens; an older version wrote it"
        if "prescription" in now and (words := other_lens(before, now)):
            return f"another lens: {words}"
        if "variables" in now and before["variables"] != now["variables"]:
            missing = [name for name in now["variables"] if name not in before["variables"]]
            expected = f"{missing[0]} among them" if missing else ", ".join(now["variables"])
            return f"other variables: {', '.join(map(str, before['variables']))}; expected {expected}"
    except (KeyError, TypeError, ValueError, AttributeError):
        return "a lens whose identity is damaged"
    other = [name for name in now if name not in ("lens", "surfaces") and before.get(name) != now[name]]
    return f"other {', '.join(other)}" if other else ""


def alike(a: object, b: object) -> bool:
    """Whether plain values are equal, numbers to the precision of float32."""
    if isinstance(a, list) and isinstance(b, list):
        return len(a) == len(b) and all(map(alike, a, b))
    if isinstance(a, float) and isinstance(b, float):
        return math.isclose(a, b, rel_tol=1e-6)
    return a == b


def _shown(value: object) -> str:
    return f"{value:.9g}" if isinstance(value, float) else repr(value)

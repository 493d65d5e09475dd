"""The objects of a file of ray-optics: JSON in which each has a class, attributes, and a place for errors."""

import json
from pathlib import Path
from typing import NamedTuple

from raytrace.io.source import MAX_BYTES, LensFileError, Place, UnsupportedSurface, read_content, shown

_MOST = 1000  # fields, wavelengths or terms


class Part(NamedTuple):
    """An object of the file: module and name of its class, its attributes, its path in the file, and its surface."""

    module: str
    kind: str
    attributes: dict
    path: str
    place: Place

    def error(self, message: str) -> LensFileError:
        return LensFileError(f"{self.path}: {message}", self.place)

    def unsupported(self, message: str) -> UnsupportedSurface:
        return UnsupportedSurface(f"{self.path}: {message}", self.place)

    def has(self, name: str) -> bool:
        return self.attributes.get(name) is not None

    def number(self, name: str, default: float | None = None) -> float:
        """A finite number; `default` where there is none."""
        found = self.attributes.get(name, default)
        if isinstance(found, bool) or not isinstance(found, int | float):
            raise self.error(f"{name} is {shown(repr(found))}, expected a number")
        return self._finite(name, found)

    def _finite(self, name: str, found: float) -> float:
        if not abs(found) < 1e300:
            raise self.error(f"{name} is {shown(repr(found))}, expected a finite number")
        return float(found)

    def text(self, name: str, default: str = "") -> str:
        found = self.attributes.get(name, default)
        if not isinstance(found, str):
            raise self.error(f"{name} is {shown(repr(found))}, expected a text")
        return found

    def numbers(self, name: str) -> list[float]:
        """The finite numbers of a list or an array, none where it is absent."""
        found = self.attributes.get(name) or []
        found = found.get("__ndarray__") if isinstance(found, dict) else found
        if not isinstance(found, list) or len(found) > _MOST:
            raise self.error(f"{name} is {shown(repr(found))}, expected a list of at most {_MOST} numbers")
        if any(isinstance(one, bool) or not isinstance(one, int | float) for one in found):
            raise self.error(f"{name} is {shown(repr(found))}, expected numbers")
        return [self._finite(name, one) for one in found]

    def part(self, name: str) -> "Part":
        if not self.has(name):
            raise self.error(f"no {name}; cut off, or another kind of model?")
        return part_of(self.attributes[name], f"{self.path}.{name}", self.place)

    def parts(self, name: str, most: int = _MOST, surfaces: bool = False) -> list["Part"]:
        """The objects of a list; surfaces: whether they are counted as those of the lens."""
        found = self.attributes.get(name)
        if not isinstance(found, list) or len(found) > most:
            raise self.error(f"{name} is no list of at most {most}")
        places = [self.place._replace(surface=k) if surfaces else self.place for k in range(len(found))]
        return [part_of(one, f"{self.path}.{name}[{k}]", places[k]) for k, one in enumerate(found)]


def part_of(found: object, path: str, place: Place) -> Part:
    """An object of the file, whose class is told by __instance_type__. Raises LensFileError for anything else."""
    type_ = found.get("__instance_type__") if isinstance(found, dict) else None
    attributes = found.get("attributes") if isinstance(found, dict) else None
    told = isinstance(type_, list) and len(type_) == 2 and all(isinstance(word, str) for word in type_)
    if not told or not isinstance(attributes, dict):
        raise LensFileError(f"{path} is {shown(repr(found))}, expected an object with __instance_type__", place)
    return Part(type_[0], type_[1], attributes, path, place)


def load(path: Path) -> bytes:
    """The bytes of a file; its JSON may stand in one long line."""
    return read_content(path, MAX_BYTES)


def model_of(content: bytes, place: Place) -> Part:
    """The optical model of a file's bytes. Raises LensFileError."""
    try:
        found = json.loads(content)
    except (ValueError, RecursionError) as error:
        line = getattr(error, "lineno", None)
        what = str(error)[:80] if line else "nested too deeply, or no text"
        raise LensFileError(
            f"no JSON file of ray-optics: {what}; damaged or cut off?", place._replace(line=line)
        ) from None
    if not isinstance(found, dict) or "optical_model" not in found:
        raise LensFileError("no optical_model; is it a model of ray-optics (.roa)?", place)
    return part_of(found["optical_model"], "optical_model", place)

"""Edits one after the other, as the words of `raytrace edit`, and what they change."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from raytrace.edit.choice import At, BadEdit, surfaces_at
from raytrace.edit.parts import insert_part, part_of_words, replace_part
from raytrace.edit.scaling import scale
from raytrace.edit.sizes import semi_diameters
from raytrace.edit.surfaces import bend, cement, delete, insert, join, rename, split
from raytrace.edit.turning import reverse
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Result, Table, number
from raytrace.system.expansion import spaces
from raytrace.system.lens import Lens
from raytrace.tracing.paraxial import first_order
from raytrace.words import did_you_mean, option

#: An edit by its name, and its words.
Step = tuple[str, Any]


@value
class Edited(Result):
    """A lens after edits, with the lens before them."""

    before: Lens
    lens: Lens

    def figures(self, lens: Lens) -> dict[str, float]:
        """Effective focal length and track from surface 1 to the image in mm, F/#, surfaces, stop, configurations."""
        data, z, places = first_order(lens), 0.0, [0.0]
        for surface in lens.surfaces[1:-1]:
            z += float(surface.thickness)
            places.append(z)
        return {
            "effective_focal_length": float(data.effective_focal_length),
            "total_track": max(places) - min(places),
            "f_number": float(data.f_number),
            "surfaces": len(lens.surfaces),
            "stop": lens.stop,
            "configurations": len(lens.configurations),
        }

    def document(self) -> dict:
        before, after = self.figures(self.before), self.figures(self.lens)
        return {name: {"before": number(before[name]), "after": number(after[name])} for name in before}

    def tables(self) -> list[Table]:
        before, after = self.figures(self.before), self.figures(self.lens)
        quantities = ["effective focal length, mm", "total track, mm", "F/#", "surfaces", "stop", "configurations"]
        columns: dict[Any, Sequence] = {
            Column("quantity", form="<", heading=" "): quantities,
            Column("before", form=".9g"): [*before.values()],
            Column("after", form=".9g"): [*after.values()],
        }
        return [Table(columns)]


def edited(lens: Lens, steps: Sequence[Step], mount: str | float | None = None) -> Edited:
    """The lens after edits in their order; surfaces are numbered as the edits before have left them.

    A step "at" chooses the surfaces of the steps behind it that name none. mount: material of all spaces without a
    stated expansion, when the temperature changes and in the lens after all edits. Raises BadEdit.
    """
    now, chosen = lens, ""
    for name, words in steps:
        if name == "temperatures":
            now = _mounted(now, mount)
        if name == "at":
            surfaces_at(now, words)
            chosen = words
        else:
            now = STEPS[name](now, words, chosen)
    return Edited(lens, _mounted(now, mount))


def _mounted(lens: Lens, mount: str | float | None) -> Lens:
    return lens if mount is None else lens.at(mount=mount)


def _chosen(words: Sequence[str], chosen: str, name: str, further: int = 0) -> tuple[str, list[str], dict[str, Any]]:
    """The surfaces of a step, its further words, and its settings NAME=VALUE. Raises BadEdit."""
    settings = dict(word.split("=", 1) for word in words if "=" in word)
    plain = [word for word in words if "=" not in word]
    surfaces = plain.pop(0) if len(plain) > further else chosen
    if not surfaces:
        raise BadEdit(f"{option(name)}: no surfaces; give numbers as 3-4, a comment, or {option('at')} before it")
    if len(plain) != further:
        raise BadEdit(f"{option(name)} {' '.join(words)}: {len(plain)} values behind the surfaces, expected {further}")
    return surfaces, plain, {key: _value(text) for key, text in settings.items()}


def _value(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text


def _known(settings: Mapping[str, Any], known: Sequence[str], name: str) -> dict[str, Any]:
    """The settings of a step. Raises BadEdit for an unknown one."""
    for key in settings:
        if key not in known:
            raise BadEdit(f"{option(name)}: no setting {key!r}; expected some of {', '.join(known)}")
    return dict(settings)


def _insert(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    rows = [word for word in words if "=" in word]
    surfaces, _, _ = _chosen([word for word in words if "=" not in word], chosen, "insert")
    made = [{key: _value(text) for key, _, text in (cell.partition("=") for cell in row.split(","))} for row in rows]
    made = [{"thickness": 0.0, **row} for row in made]
    return insert(lens, surfaces, made) if made else insert(lens, surfaces)


def _reverse(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    return reverse(lens, _chosen(words, chosen, "reverse")[0] if words or chosen else None)


def _split(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    surfaces, _, settings = _chosen(words, chosen, "split")
    return split(lens, surfaces, **_known(settings, ("share", "gap", "curvature"), "split"))


def _cement(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    surfaces, _, settings = _chosen(words, chosen, "cement")
    return cement(lens, surfaces, **_known(settings, ("curvature",), "cement"))


def _bend(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    surfaces, (shape,), settings = _chosen(words, chosen, "bend", 1)
    factor = _value(shape)
    if isinstance(factor, str):
        raise BadEdit(f"{option('bend')} {shape!r}: expected a shape factor, as 0.5")
    return bend(lens, surfaces, factor, **_known(settings, ("keep",), "bend"))


def _semi_diameters(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    known = ("clear", "margin", "chip_zone", "mechanical")
    settings = _known(dict(word.split("=", 1) for word in words if "=" in word), known, "semi_diameters")
    plain = [word for word in words if "=" not in word]
    if len(plain) > 1:
        raise BadEdit(
            f"{option('semi_diameters')} {' '.join(words)}: expected surfaces, as 3-4, and settings, as clear=5"
        )
    given: dict[str, Any] = {name: _value(text) for name, text in settings.items()}
    if "margin" in settings:
        try:
            percent, length = (*map(float, settings["margin"].split(",")), 0.0, 0.0)[:2]
        except ValueError as error:
            message = f"margin={settings['margin']}: expected per cent and mm, as 2,0.5"
            raise BadEdit(f"{option('semi_diameters')} {message}") from error
        given["margin"] = percent, length
    return semi_diameters(lens, plain[0] if plain else chosen or None, **given)


def _temperatures(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    """Temperatures as configurations: °C …, and materials of single spaces, as 4=invar."""
    celsius = [_value(word) for word in words if "=" not in word]
    if not celsius or not all(isinstance(number, float) for number in celsius):
        raise BadEdit(f"{option('temperatures')} {' '.join(words)}: expected °C, as -20 60, and materials, as 4=invar")
    for places, _, material in (word.partition("=") for word in words if "=" in word):
        first, last = surfaces_at(lens, places)
        known = spaces(lens.surfaces)
        here = [k for k in known if first <= k <= last]
        if not here:
            listed = ", ".join(map(str, known)) or "none"
            raise BadEdit(f"{places}={material}: no space behind {places}; this lens has spaces behind {listed}")
        for k in here:
            lens = lens.replace(k, expansion=material)
    return lens.with_temperatures([float(number) for number in celsius])


#: What `--system` changes, the words of `Lens.at`: how its text is read.
_SYSTEM: dict[str, Callable[[str], Any]] = {
    **dict.fromkeys(
        ("object_distance", "magnification", "sensor_distance", "f_number", "entrance_pupil_diameter", "temperature",
         "pressure"), float,
    ),
    **dict.fromkeys(
        ("wavelengths", "wavelength_weights", "field_weights"), lambda text: [*map(float, text.split(","))]
    ),
    "fields": lambda text: [
        tuple(map(float, point.split(":"))) if ":" in point else float(point) for point in text.split(",")
    ],
    "primary_wavelength": int,
    "ray_aiming": str,
}  # fmt: skip


def _system(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    """The lens under other conditions, `Lens.at`: NAME=VALUE …"""
    given: dict[str, Any] = {}
    for word in words:
        name, _, text = word.partition("=")
        if name not in _SYSTEM:
            meant = did_you_mean(name, _SYSTEM)
            raise BadEdit(f"{option('system')} {word}: no {name!r}{meant}; expected some of {', '.join(_SYSTEM)}")
        try:
            given[name] = _SYSTEM[name](text)
        except ValueError as error:
            raise BadEdit(
                f"{option('system')} {word}: {text!r} is no number or list of them; expected it as f_number=4, "
                "fields=0,7,10, or fields=0:0,3:4 of x:y"
            ) from error
    if any(isinstance(point, tuple) for point in given.get("fields", ())):
        given["fields"] = [point if isinstance(point, tuple) else (0.0, point) for point in given["fields"]]
    try:
        return lens.at(**given)
    except ValueError as error:
        raise BadEdit(f"{option('system')} {' '.join(words)}: {error}") from error


def _conditions(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    """The lens with conditions, `Lens.with_conditions`; "none" removes all."""
    return lens.with_conditions([], only=True) if [*words] == ["none"] else lens.with_conditions(" ".join(words))


def _comment(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    surfaces, text = (chosen, words[0]) if len(words) == 1 and chosen else (words[0], " ".join(words[1:]))
    return rename(lens, comments={surfaces: text})


def _insert_part(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    surfaces, part, settings = _part_words(words, chosen, "insert_part", ("gap",))
    return insert_part(lens, surfaces, part, **settings)


def _replace_part(lens: Lens, words: Sequence[str], chosen: str) -> Lens:
    surfaces, part, settings = _part_words(words, chosen, "replace_part", ())
    return replace_part(lens, surfaces, part, **settings)


def _part_words(words: Sequence[str], chosen: str, name: str, known: Sequence[str]) -> tuple[str, Any, dict[str, Any]]:
    """The surfaces, the part and the settings of a step: [SURFACES] PART [reversed] [index=FILE] …"""
    plain = [word for word in words if word != "reversed"]
    surfaces, (part,), settings = _chosen(plain, chosen, name, 1)
    settings = _known(settings, ("index", *known), name)
    index = {"index": str(settings.pop("index"))} if "index" in settings else {}
    return surfaces, part_of_words(part, **index), {**settings, "reverse": len(plain) < len(words)}


def _of_surfaces(edit: Callable[[Lens, At], Lens], name: str) -> Callable[[Lens, Sequence[str], str], Lens]:
    return lambda lens, words, chosen: edit(lens, _chosen(words, chosen, name)[0])


#: The edits by the names of their options: lens, words, surfaces of "at" -> lens.
STEPS: dict[str, Callable[[Lens, Any, str], Lens]] = {
    "scale": lambda lens, factor, chosen: scale(lens, factor),
    "efl": lambda lens, efl, chosen: scale(lens, efl=efl),
    "reverse": lambda lens, words, chosen: reverse(
        lens, _chosen(words, chosen, "reverse")[0] if words or chosen else None
    ),
    "swap_conjugates": lambda lens, words, chosen: reverse(lens, swap_conjugates=True),
    "insert": _insert,
    "insert_part": _insert_part,
    "replace_part": _replace_part,
    "delete": _of_surfaces(delete, "delete"),
    "join": _of_surfaces(join, "join"),
    "split": _split,
    "cement": _cement,
    "bend": _bend,
    "semi_diameters": _semi_diameters,
    "temperatures": _temperatures,
    "system": _system,
    "conditions": _conditions,
    "rename": lambda lens, title, chosen: rename(lens, title),
    "comment": _comment,
}

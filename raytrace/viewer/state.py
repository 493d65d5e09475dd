"""State of the viewer: a lens that is edited, and the function from a state and an event to the next state.

An event is a mapping with a `type`, a key of EVENTS, as the page sends it; `refusal` checks its parts by their kinds.
Numbers are named as in the variable syntax: a surface and a quantity of `parameter_paths`. An event that cannot be
carried out changes nothing but `message`.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.mtf import frequency_range
from raytrace.optimization.attained import Attained
from raytrace.optimization.conditions import Condition, conditions_of, named_row
from raytrace.optimization.merit import KINDS, DefaultMerit, Merit, merit_for
from raytrace.optimization.operands.mtf import MODULATION
from raytrace.optimization.operands.rays import RAYS
from raytrace.optimization.operands.wavefront import PATH, QUALITY
from raytrace.optimization.variables import DesignVariables, design_variables
from raytrace.plotting import style
from raytrace.system.configurations import freed, kept
from raytrace.system.lens import Fields, Lens, SystemAperture, check, field_points
from raytrace.system.optimization_data import Row, Solve, Vary
from raytrace.system.parameter_paths import modelled, parameter_paths, path_of, with_number
from raytrace.system.surface import SIZES
from raytrace.tracing.geometry import gaps, semi_diameters
from raytrace.tracing.launch import factors_at
from raytrace.tracing.paraxial import first_order
from raytrace.words import named_value

#: Operands of the quality of the image, which a chosen merit function replaces.
OF_IMAGE = {
    *(name for name in RAYS if name[:3] in ("TRA", "TRC", "ANA", "ANC")),
    *(name for table in (PATH, QUALITY, MODULATION) for name in table),
}

#: Steps of undo that are kept.
DEPTH = 500
#: Fields and wavelengths of a lens, as many as OpticStudio admits; cycles/mm of an MTF; mm of a gap.
MOST_FIELDS, MOST_WAVELENGTHS, HIGHEST, FARTHEST = 200, 24, 1e5, 1e6
_LONGEST = 4096  # characters of a text


@dataclass(frozen=True)
class State:
    """The content of the viewer.

    lens, vary: the lens and its variables, words of the variable syntax; stored: the lens of the file, for comparison.
    past, future: pairs (lens, vary), the latest last. merit: the merit function, a key of `merit.KINDS` or "" for that
    of the file; frequency: the highest of the MTF, cycles/mm. compare: whether the stored lens is drawn
    too; dragged: the number that a slider moves; message: why the last event changed nothing.
    """

    lens: Lens
    stored: Lens
    vary: tuple[str, ...] = ()
    merit: str = ""
    past: tuple[tuple[Lens, tuple[str, ...]], ...] = ()
    future: tuple[tuple[Lens, tuple[str, ...]], ...] = ()
    frequency: float = 100.0
    compare: bool = False
    dragged: str = ""
    message: str = ""


def initial(lens: Lens) -> State:
    """The state of a lens as it was read, with the variables of its file."""
    data = lens.optimization_data
    words = dict.fromkeys(word_of(vary) for vary in (data.variables if data else ()) if is_shown(lens, vary))
    try:
        highest = style.round_length(float(frequency_range(lens, shown_fields(lens), 2)[-1]))
    except ValueError:
        highest = 100.0
    return State(lens, lens, tuple(words), "" if has_merit(lens) else "spot", frequency=highest)


def shown_fields(lens: Lens) -> Tensor:
    """The fields that are drawn (2, F), at most five, spread over all."""
    points = field_points(None, like=lens)
    count = points.shape[1]
    return points[:, torch.linspace(0, count - 1, min(count, 5)).round().long()]


def reduce(state: State, event: Mapping) -> State:
    """The state behind an event; the same one with a message where the event cannot be carried out."""
    if words := refusal(event, EVENTS):
        return dataclasses.replace(state, message=words)
    try:
        return EVENTS[event["type"]].change(dataclasses.replace(state, message=""), event)
    except (ValueError, TypeError, RuntimeError, LookupError, ArithmeticError) as error:
        words = f"{error.args[0]!r} is missing" if type(error) is KeyError else str(error)
        return dataclasses.replace(state, message=words)


class Part(NamedTuple):
    """A kind of value in an event. admits: whether a value is of the kind; words: the kind in a message."""

    admits: Callable[[object], bool]
    words: str


def _is_text(value: object) -> bool:
    return isinstance(value, str) and len(value) <= _LONGEST


def _is_number(value: object) -> bool:
    return type(value) in (int, float) or _is_text(value)


WHOLE = Part(lambda value: type(value) is int, "a whole number")
FLAG = Part(lambda value: isinstance(value, bool), "true or false")
TEXT = Part(_is_text, f"a text of at most {_LONGEST} characters")
NUMBER = Part(_is_number, "a number, or its text")
NUMBERS = Part(
    lambda value: _is_text(value) or (isinstance(value, list) and all(map(_is_number, value))),
    f"numbers, or their text of at most {_LONGEST} characters",
)
AXIS = Part(lambda value: value in ("x", "y"), "x or y")
FIELD = Part(lambda value: value is None or WHOLE.admits(value), "a whole number or null")


class Event(NamedTuple):
    """A kind of event. parts: those that it may have, by their names; change: the state after it."""

    parts: Mapping[str, Part]
    change: Callable[[State, Mapping], State] = lambda state, event: state


def refusal(event: Mapping, known: Mapping[str, Event]) -> str:
    """Why an event is refused: an unknown kind, or a part that is unknown or has a wrong value; empty if it is not."""
    kind = event.get("type")
    if not isinstance(kind, str) or kind not in known:
        return f"unknown event {named_value(kind)}; expected one of {', '.join(known)}"
    for name, value in event.items():
        part = known[kind].parts.get(name)
        if name != "type" and part is None:
            return f"{kind} has no part {named_value(name)}; it has {', '.join(known[kind].parts) or 'none'}"
        if part and not part.admits(value):
            return f"{kind}: {name} is {named_value(value)}; expected {part.words}"
    return ""


def word_of(number: Vary | Solve) -> str:
    """A variable or solve in the variable syntax, "curvature:3"; of all configurations."""
    return f"{number.quantity}:{number.surface}"


def is_shown(lens: Lens, variable: Vary) -> bool:
    """Whether the table has the number of a variable: glasses and conditions of the lens are not in it."""
    return variable.quantity == "thickness" or variable.quantity in parameter_paths(lens.surfaces[variable.surface])


def variables(state: State) -> list[str | Vary]:
    """The variables for `optimize`: those of the file with their bounds, others as words."""
    data = state.lens.optimization_data
    of_file = [variable for variable in (data.variables if data else ()) if word_of(variable) in state.vary]
    return [*of_file, *(word for word in state.vary if word not in map(word_of, of_file))]


def merit_of(state: State) -> Merit | None:
    """The merit function for `optimize`; None: the file's. The MTF is that at 1/4 and 1/2 of the highest frequency.

    A default merit function replaces rows of image quality; conditions, boundaries and other rows of the file remain.
    """
    if not state.merit:
        return None
    frequencies = (state.frequency / 4, state.frequency / 2) if state.merit == "mtf" else ()
    chosen = merit_for(state.lens, DefaultMerit(state.merit, frequencies=frequencies))
    return dataclasses.replace(chosen, skip_unknown=True) + requirements(state.lens)


def has_merit(lens: Lens) -> bool:
    """Whether the file has a merit function, and not conditions alone."""
    return lens.optimization_data is not None and any(row.weight > 0 for row in lens.optimization_data.merit)


def requirements(lens: Lens) -> Merit:
    """The merit function of the file, rows of image quality without weight unless they are conditions."""
    data = lens.optimization_data
    rows = data.merit if data else ()
    of_image = [row.operand in OF_IMAGE and row.weight > 0 for row in rows]
    free = (dataclasses.replace(row, weight=0.0) if image else row for row, image in zip(rows, of_image, strict=True))
    return Merit(tuple(free), data.unit if data else 1.0)


def in_words(lens: Lens, merit: Merit) -> list[str]:
    """The rows of a merit function that have a weight, as "efl=50"."""
    words = []
    for k, row in enumerate(merit.rows, 1):
        condition = named_row(lens, merit.rows, k, merit.unit) if row.weight else None
        words += [str(condition)] if condition else [f"{row.name}={row.target:.6g}"] if row.weight else []
    return [*dict.fromkeys(words)]


def named(lens: Lens, rows: Sequence[Row], result: Attained) -> Attained:
    """A result of a boundary or row of a merit function under the name that conditions have, as "edge"."""
    condition = named_row(lens, rows, result.row, 1.0) if result.row else None
    return dataclasses.replace(result, name=condition.quantity) if condition else result


# -- numbers


def number(text: object, what: str) -> float:
    """A number from a table or a slider. Raises ValueError for a text that is none, and for nan."""
    try:
        value = float(str(text).strip().replace("−", "-").replace("∞", "inf"))
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise ValueError(f"{what}: {str(text)!r} is not a number; nothing was changed")
    return value


def numbers(texts: str | Sequence, what: str, most: int) -> list[float]:
    """Several numbers, a list or a text like "0, 14 20", at most so many. Raises ValueError."""
    words = re.split(r"[,;\s]+", texts.strip()) if isinstance(texts, str) else texts
    words = [word for word in words if word != ""]
    if not 0 < len(words) <= most:
        raise ValueError(f"{what}: found {len(words)} numbers; expected 1 to {most}; nothing was changed")
    return [number(word, what) for word in words]


def limits(lens: Lens, surface: int, quantity: str) -> tuple[float, float]:
    """Least and largest number of a surface. A gap between powered surfaces is not negative along the light."""
    if quantity != "thickness" or surface == 0:
        return -math.inf, math.inf
    for front, end, side in gaps(lens):
        if front <= surface < end:
            others = sum(float(lens.surfaces[k].thickness) for k in range(front, end) if k != surface)
            return (-others, FARTHEST) if side > 0 else (-FARTHEST, -others)
    return -FARTHEST, FARTHEST


def slider_ends(lens: Lens, surface: int, quantity: str, value: float) -> tuple[float, float]:
    """The ends of the slider of a number, about its value and within its limits.

    The sensor's is 100 depths of focus 2 λ F² long; a curvature ends at a hemisphere of the semi-diameter.
    """
    size = lens.surfaces[surface].semi_diameter or 10.0
    low, high = limits(lens, surface, quantity)
    power = re.fullmatch(r"a(\d+)", quantity)
    if quantity == "curvature":
        reach, low, high = max(0.15 / size, 0.3 * abs(value)), -1 / size, 1 / size
    elif quantity == "thickness" and surface == len(lens.surfaces) - 2 and (depth := _depth_of_focus(lens)):
        reach = 50 * depth
    elif quantity in ("thickness", "conic"):
        reach = max(1.0, 0.5 * abs(value))
    else:
        least = 0.02 * size ** (1 - int(power[1])) if power else 5.0 if "tilt" in quantity else 1.0
        reach = max(least, 0.5 * abs(value))
    return min(value, max(value - reach, low)), max(value, min(value + reach, high))


def _depth_of_focus(lens: Lens) -> float:
    """2 λ F² in mm at the primary wavelength and the paraxial working F/#; 0 of an afocal image space."""
    depth = 2e-3 * float(lens.primary * first_order(lens).paraxial_working_f_number ** 2)
    return depth if math.isfinite(depth) else 0.0


def with_value(lens: Lens, surface: int, quantity: str, text: object) -> Lens:
    """The lens with another number, or glass, of a surface; its solves and pickups follow. Raises ValueError."""
    what = f"{quantity} of surface {surface}"
    if not 0 <= surface < len(lens.surfaces):
        raise ValueError(f"{what}: this lens has surfaces 0 to {len(lens.surfaces) - 1}")
    if quantity == "glass":
        lens = lens.replace(surface, glass=str(text))
    elif quantity in SIZES:
        size = number(text, what) if str(text).strip() else None
        if size is not None and not 0 <= size < math.inf:
            raise ValueError(f"{what}: found {size:g}; expected mm, 0 or more")
        lens = lens.replace(surface, **{quantity: size or (size if quantity == "semi_diameter" else None)})
        width, clear = lens.surfaces[surface].mechanical_semi_diameter, semi_diameters(lens)[surface]
        if width is not None and width < clear:
            raise ValueError(
                f"surface {surface}: the mechanical semi-diameter of {width:.6g} mm is smaller than the clear one, "
                f"{clear:.6g} mm"
            )
    else:
        given = number(text, what)
        if quantity == "radius":
            if given == 0:
                raise ValueError(f"{what}: found 0; a plane has radius inf")
            quantity, given = "curvature", 1 / given
        if not math.isfinite(given) and (surface, quantity) != (0, "thickness"):
            raise ValueError(f"{what}: found {given:g}; expected a finite number")
        low, high = limits(lens, surface, quantity)
        if not low <= given <= high:
            raise ValueError(f"{what}: found {given:.6g} mm; expected {low + 0.0:.6g} to {high + 0.0:.6g} mm")
        whole = modelled(lens.surfaces[surface], quantity)
        place = path_of(whole, quantity, f"surface {surface}: ")
        changed = with_number(whole, place, lens.surfaces[-2].thickness.new_tensor(given))
        surfaces = (*lens.surfaces[:surface], changed, *lens.surfaces[surface + 1 :])
        lens = dataclasses.replace(lens, surfaces=surfaces)
        lens = kept(lens) if lens.operands else lens
    check(lens)
    return solved(lens)


def solved(lens: Lens) -> Lens:
    """The lens whose solves and pickups hold."""
    solves = lens.optimization_data.solves if lens.optimization_data else ()
    return DesignVariables(lens, (), solves).lens_at(np.zeros(0)) if solves else lens


def aperture_sizes(lens: Lens) -> dict[str, float]:
    """The paraxial beam by the kinds of system aperture that the viewer offers, the lens's own first."""
    stored, paraxial = {lens.aperture.kind: float(lens.aperture.value)}, first_order(lens)
    sizes = {"image_f_number": paraxial.f_number, "entrance_pupil_diameter": paraxial.entrance_pupil_diameter}
    return stored | {kind: float(size) for kind, size in sizes.items() if kind not in stored}


# -- events


def edited(state: State, lens: Lens, vary: tuple[str, ...] | None = None, drag: str = "") -> State:
    """The state with another lens; the one before can be undone. A drag of one number is one step."""
    goes_on = bool(state.dragged) and state.dragged == drag
    past = state.past if goes_on else (*state.past, (state.lens, state.vary))[-DEPTH:]
    vary = state.vary if vary is None else vary
    return dataclasses.replace(state, lens=lens, vary=vary, past=past, future=(), dragged=drag)


def _dragged(state: State, event: Mapping, lens: Lens, key: str) -> State:
    """The lens of an event of the slider `key`, or of its text field, which ends the drag."""
    drag = bool(event.get("drag"))
    after = edited(state, lens, drag=key if drag or state.dragged == key else "")
    return after if drag else dataclasses.replace(after, dragged="")


def _edit(state: State, event: Mapping) -> State:
    surface, quantity = event["surface"], event["quantity"]
    dragged = "curvature" if quantity == "radius" else quantity
    lens = with_value(state.lens, surface, quantity, event["value"])
    return _dragged(state, event, lens, f"{dragged}:{surface}")


def _vary(state: State, event: Mapping) -> State:
    word = f"{event['quantity']}:{event['surface']}"
    chosen = tuple(other for other in state.vary if other != word)
    if event.get("on"):
        design_variables(state.lens, word)
        chosen = (*chosen, word)
    return edited(state, state.lens, chosen)


def _fields(state: State, event: Mapping) -> State:
    """Fields by their y, or with `axis` "x" by their x. All else of them stays; of fewer or more y, those that the lens
    does not have take x and vignetting factors between their neighbours."""
    lens, axis, values = state.lens, event.get("axis", "y"), numbers(event["values"], "fields", MOST_FIELDS)
    old = lens.fields
    if len(values) == len(old.y):
        heights = old.y.new_tensor(values)
        fields = dataclasses.replace(old, x=heights) if axis == "x" else dataclasses.replace(old, y=heights)
    elif axis == "x":
        raise ValueError(f"x of the fields: found {len(values)} numbers; this lens has {len(old.y)} fields")
    else:
        fields = _fields_at(lens, values)
    field_points(torch.stack([fields.x, fields.y]).T.tolist(), like=lens)
    lens = dataclasses.replace(freed(lens, fields=values), fields=fields)
    check(lens)
    return edited(state, solved(lens))


def _fields_at(lens: Lens, values: Sequence[float]) -> Fields:
    old, left = lens.fields, list(range(len(lens.fields.y)))
    taken = [next((left.pop(i) for i, k in enumerate(left) if float(old.y[k]) == y), None) for y in values]
    order = old.y.argsort(stable=True)
    x = np.interp(values, old.y[order], old.x[order])
    points = old.y.new_tensor([[x[i] if k is None else old.x[k] for i, k in enumerate(taken)], values])
    weight = old.y.new_tensor([1.0 if k is None else old.weight[k] for k in taken])
    return dataclasses.replace(old, x=points[0], y=points[1], weight=weight, vignetting=factors_at(lens, points))


def _wavelengths(state: State, event: Mapping) -> State:
    """A wavelength of the old list keeps its weight, and is primary if it was. Of a list of the same length those that
    are new take the place of the old ones; else weights are 1, and the wavelength nearest to the old primary is."""
    lens, values = state.lens, numbers(event["values"], "wavelengths", MOST_WAVELENGTHS)
    old, weights, primary = lens.wavelengths.tolist(), lens.wavelength_weights.tolist(), float(lens.primary)
    same = len(values) == len(old)
    places = [old.index(value) if value in old else k if same else None for k, value in enumerate(values)]
    if primary in values or not same:
        number = min(range(len(values)), key=lambda k: abs(values[k] - primary))
    else:
        number = lens.primary_wavelength - 1
    lens = lens.at(
        wavelengths=values,
        wavelength_weights=[1.0 if k is None else weights[k] for k in places],
        primary_wavelength=1 + number,
    )
    return edited(state, solved(lens))


def _primary(state: State, event: Mapping) -> State:
    return edited(state, solved(state.lens.at(primary_wavelength=event["number"])))


def _aperture(state: State, event: Mapping) -> State:
    kind, sizes = event.get("kind") or state.lens.aperture.kind, aperture_sizes(state.lens)
    if kind not in sizes:
        raise ValueError(f"aperture {kind!r}: expected one of {', '.join(sizes)}")
    size = number(event["value"], "aperture") if "value" in event else sizes[kind]
    lens = freed(state.lens, f_number=size)
    lens = dataclasses.replace(lens, aperture=SystemAperture(kind, lens.wavelengths.new_tensor(size)))
    check(lens)
    return _dragged(state, event, solved(lens), "aperture")


def _frequency(state: State, event: Mapping) -> State:
    highest = number(event["value"], "highest frequency")
    if not 0 < highest <= HIGHEST:
        raise ValueError(f"highest frequency: found {highest:g}; expected cycles/mm, more than 0, at most {HIGHEST:g}")
    return dataclasses.replace(state, frequency=highest)


def _step(state: State, source: str) -> State:
    """Undo, from "past", or redo, from "future"."""
    before = state.past if source == "past" else state.future
    if not before:
        return dataclasses.replace(state, message=f"nothing to {'undo' if source == 'past' else 'redo'}", dragged="")
    (lens, vary), here = before[-1], (state.lens, state.vary)
    past, future = (before[:-1], (*state.future, here)) if source == "past" else ((*state.past, here), before[:-1])
    return dataclasses.replace(state, lens=lens, vary=vary, past=past, future=future, dragged="")


def _merit(state: State, event: Mapping) -> State:
    kind = event["kind"]
    if kind not in KINDS and not (kind == "" and has_merit(state.lens)):
        raise ValueError(f"merit {kind!r}: expected one of {', '.join(KINDS)}")
    return dataclasses.replace(state, merit=kind)


def _condition(state: State, event: Mapping) -> State:
    """A new condition by its words, or another text, switch or the removal of a condition by its number, from 0."""
    if "number" not in event:
        return edited(state, state.lens.with_conditions(event["words"]))
    conditions, number = [*state.lens.conditions], event["number"]
    if not 0 <= number < len(conditions):
        raise ValueError(f"condition {number + 1}: this lens has {len(conditions)}")
    changed: list[Condition] = [] if event.get("remove") else [conditions[number]]
    if "words" in event:
        is_on = conditions[number].on
        changed = [dataclasses.replace(c, on=is_on) for c in conditions_of(state.lens, event["words"])]
    elif "on" in event:
        changed = [dataclasses.replace(conditions[number], on=event["on"])]
    conditions[number : number + 1] = changed
    return edited(state, state.lens.with_conditions(conditions, only=True))


_EDIT = {"surface": WHOLE, "quantity": TEXT, "value": NUMBER, "drag": FLAG}

#: Events by their type.
EVENTS = {
    "edit": Event(_EDIT, _edit),
    "vary": Event({"surface": WHOLE, "quantity": TEXT, "on": FLAG}, _vary),
    "fields": Event({"values": NUMBERS, "axis": AXIS}, _fields),
    "wavelengths": Event({"values": NUMBERS}, _wavelengths),
    "primary": Event({"number": WHOLE}, _primary),
    "aperture": Event({"kind": TEXT, "value": NUMBER, "drag": FLAG}, _aperture),
    "configuration": Event(
        {"number": WHOLE}, lambda state, event: edited(state, state.lens.configuration(event["number"]))
    ),
    "frequency": Event({"value": NUMBER}, _frequency),
    "merit": Event({"kind": TEXT}, _merit),
    "condition": Event({"words": TEXT, "number": WHOLE, "on": FLAG, "remove": FLAG}, _condition),
    "compare": Event({"on": FLAG}, lambda state, event: dataclasses.replace(state, compare=event["on"])),
    "undo": Event({}, lambda state, event: _step(state, "past")),
    "redo": Event({}, lambda state, event: _step(state, "future")),
    "restore": Event({}, lambda state, event: edited(state, state.stored, initial(state.stored).vary)),
}

"""Public functions as the package exports them: paths as lenses, single numbers as lists, `field` as `fields`.

Other values of the wrong kind are refused. Calls inside the package do not pass through here.
"""

import contextlib
import functools
import inspect
import math
import os
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Union, get_args, get_origin

import torch
from torch import Tensor

from raytrace.io import as_lens
from raytrace.system.lens import Lens, computed_once
from raytrace.words import known_option, named_value, nameless, option, with_article

#: Options of several numbers, and which of them may be infinite; those of `fields` may be pairs.
_FINITE = ("fields", "frequencies", "radii", "wavelengths")
_SEVERAL = (*_FINITE, "depths", "object_distances", "distance_weights", "field_weights", "wavelength_weights")


#: Functions that take a batch of lenses; the others take one.
BATCHED = {
    *("first_order", "rays", "trace", "spot", "wavefront", "psf", "mtf", "perturbed", "to", "evaluate"),
    *("with_object_distance", "with_sensor_distance"),
}

#: Modules whose classes are checked; a module, an optimizer or a generator of torch may be any similar object.
_CHECKED = r"builtins|collections\.abc|os|pathlib|raytrace\..*|torch"
_ITERABLE = {Sequence, Iterable, list, tuple}
#: Classes as a message names them.
_KINDS: dict[Any, str] = {
    **{Tensor: "a tensor", str: "a text", os.PathLike: "a path", Path: "a path", int: "a whole number"},
    **{float: "a number", Sequence: "a sequence", Iterable: "a sequence", tuple: "a pair", Callable: "a function"},
}
#: Values that functions make, by the name of their class: how to make one.
_MADE = {
    "Element": "an Element of rt.wave_optics.phase_elements (a name, a file) or rt.wave_optics.phase_element (an array)"
}
#: Of an array where the name or the file of an element is expected.
_OF_HEIGHTS = "; an array of heights: rt.wave_optics.phase_element(heights, pitch=…, aperture=…, glass=…)"


@functools.cache
def public(function: Callable, name: str, home: str = "raytrace") -> Callable:
    """A public function as a package, `home`, exports it, with the signature and the docstring of the function.

    It reads a lens given as a path or as the name of a shipped lens, takes the other spelling of an option (SPELLINGS)
    and single numbers where several are expected. Raises TypeError and ValueError, which name function and argument,
    for no lens, for unknown or missing options, and for values that are no numbers, nan or of the wrong kind;
    RuntimeError where `torch.func.vmap` hides numbers that the function reads.
    """
    parameters = inspect.signature(function).parameters
    names = tuple(parameters)
    sharing = computed_once if "lens" in parameters else contextlib.nullcontext
    every = any(option.kind is option.VAR_KEYWORD for option in parameters.values())
    readers = {key: reader for key, parameter in parameters.items() if (reader := _reader(parameter))}

    @functools.wraps(function)
    def verb(*given: Any, **options: Any) -> Any:
        options = {known_option(name, word, names, options, every): value for word, value in options.items()}
        _check_call(name, parameters, given, options)
        taken = [_read(name, readers, word, value) for word, value in zip(names, given, strict=False)]
        taken += given[len(names) :]
        options = {word: _read(name, readers, word, value) for word, value in options.items()}
        try:
            with sharing():
                return function(*taken, **options)
        except RuntimeError as error:
            if (clear := _under_vmap(name, error)) is error:
                raise
            raise clear from error

    verb.__module__, verb.__qualname__ = home, name  # where pickle finds it
    return verb


def _check_call(verb: str, parameters: Mapping[str, inspect.Parameter], values: Sequence, words: Iterable[str]) -> None:
    """Raises TypeError for too many values without a name, and for options that are given twice or left out."""
    kinds = inspect.Parameter
    by_place = kinds.POSITIONAL_ONLY, kinds.POSITIONAL_OR_KEYWORD
    placed = [name for name, option in parameters.items() if option.kind in by_place]
    several = any(option.kind is kinds.VAR_POSITIONAL for option in parameters.values())
    if len(values) > len(placed) and not several:
        options = [name for name, option in parameters.items() if option.kind is kinds.KEYWORD_ONLY]
        raise TypeError(f"{verb}: {nameless(values[len(placed)], options)}")
    read = {*placed[: len(values)]}
    for name in sorted(read & {*words}):
        raise TypeError(f"{verb}: {option(name)} is given twice, with and without its name: leave one out")
    for name, parameter in parameters.items():
        open_ended = parameter.kind in (kinds.VAR_POSITIONAL, kinds.VAR_KEYWORD)
        if parameter.default is parameter.empty and not open_ended and name not in read and name not in words:
            raise TypeError(f"{verb}: {option(name)} is missing and has no default; add {name}=…")


def _under_vmap(verb: str, error: RuntimeError) -> RuntimeError:
    """The error of a function that reads numbers of the lens under `torch.func.vmap`; other errors as they are."""
    if not re.match(r"vmap:|Cannot access data pointer", str(error)):
        return error
    return RuntimeError(
        f"{verb} does not work under torch.func.vmap: it reads numbers that vmap hides. Call it for each lens in a "
        "loop; under vmap work first_order, rays, base_ray, and launch, trace_lens and spot_of of raytrace.tracing"
    )


def _reader(parameter: inspect.Parameter) -> Callable | None:
    """The reader of a parameter's values, (verb, name, value) -> value; None if they pass unchanged."""
    if parameter.name == "lens":
        others = _kinds(parameter.annotation) - {Lens, str, os.PathLike, Sequence}
        return functools.partial(_lens_or, tuple(others)) if others else _lens
    reader = _reader_of_values(parameter)
    optional = parameter.default is None or NoneType in get_args(parameter.annotation)
    if reader is None or not optional:
        return reader
    return lambda verb, name, value: None if value is None else reader(verb, name, value)


def _reader_of_values(parameter: inspect.Parameter) -> Callable | None:
    if parameter.name in _SEVERAL:
        return _several
    if parameter.annotation in (int, int | None):
        return _count
    if parameter.annotation in (float, float | None):
        return _number
    kinds = _kinds(parameter.annotation)
    if not kinds or (kinds == {str} and parameter.default is not parameter.empty):  # a choice, which the function lists
        return None
    return functools.partial(_of_kinds, kinds)


def _kinds(annotation: object) -> set[type]:
    """The classes of an annotation; empty if one of them cannot be checked."""
    parts = get_args(annotation) if get_origin(annotation) in (Union, UnionType) else (annotation,)
    kinds = {get_origin(part) or part for part in parts} - {NoneType}
    checked = all(isinstance(kind, type) and re.fullmatch(_CHECKED, kind.__module__) for kind in kinds)
    return kinds if checked and bool not in kinds else set()


def _read(verb: str, readers: Mapping[str, Callable], name: str, value: object) -> object:
    reader = readers.get(name)
    return value if reader is None else reader(verb, name, value)


def _lens(verb: str, name: str, value: Any) -> Lens:
    if not isinstance(value, Lens):
        return as_lens(value, verb)
    if verb not in BATCHED and value.count is not None:
        raise ValueError(f"{verb} takes one lens, not a batch of {value.count}: call it for each, `for lens in lenses`")
    return value


def _lens_or(kinds: tuple[type, ...], verb: str, name: str, value: object) -> object:
    """A lens, or one or several values of other classes, as elements."""
    several = value if isinstance(value, (list, tuple)) else [value]
    return value if several and all(isinstance(part, kinds) for part in several) else _lens(verb, name, value)


def _of_kinds(kinds: set[type], verb: str, name: str, value: object) -> object:
    """A value of one of some classes; where tensors are expected alone, numbers become one, float64."""
    is_text = isinstance(value, (str, bytes))
    numeric = isinstance(value, (Real, list, tuple)) or hasattr(value, "tolist")
    if kinds == {Tensor} and isinstance(value, Real):
        return torch.tensor(_number(verb, name, value), dtype=torch.float64)
    if isinstance(value, tuple(kinds)) and not (is_text and str not in kinds):
        return value
    if (kinds & {Tensor, float} and numeric) or (kinds & {int} and isinstance(value, Integral)):
        return value
    if kinds & _ITERABLE and isinstance(value, Iterable) and not is_text:
        return value
    words = {_KINDS.get(kind) or _MADE.get(kind.__name__) or with_article(kind.__name__) for kind in kinds}
    expected = " or ".join(sorted(words))
    hint = _OF_HEIGHTS if verb in ("phase_elements", "read_element") and hasattr(value, "__len__") else ""
    raise TypeError(f"{verb}: {option(name)} is {named_value(value)}; expected {expected}{hint}")


def _several(verb: str, name: str, value: object) -> Tensor | tuple | list:
    """Numbers, of one or several; tensors unchanged, their values unread."""
    if isinstance(value, Tensor):
        if value.numel() == 0:
            raise ValueError(f"{verb}: {option(name)} is empty; expected {_numbers(name)}")
        return value.reshape(1) if value.dim() == 0 else value
    value = value.tolist() if hasattr(value, "tolist") else value  # of numpy and pandas
    if isinstance(value, Real):
        value = [value]
    if not isinstance(value, Iterable) or isinstance(value, (str, bytes, Mapping)):
        raise TypeError(f"{verb}: {option(name)} is {named_value(value)}; expected {_numbers(name)}")
    value = value if isinstance(value, (tuple, list)) else [*value]
    if not value:
        raise ValueError(f"{verb}: {option(name)} is empty; expected {_numbers(name)}")
    return type(value)([_entry(verb, name, entry) for entry in value]) if type(value) in (tuple, list) else value


def _entry(verb: str, name: str, entry: object) -> object:
    if isinstance(entry, Tensor):
        return entry
    if isinstance(entry, Real):
        if math.isnan(entry) or (math.isinf(entry) and name in _FINITE):
            raise ValueError(f"{verb}: {option(name)} holds {entry}; expected {_numbers(name)}")
        return entry if isinstance(entry, (int, float)) else float(entry)
    if name == "fields" and isinstance(entry, Iterable) and not isinstance(entry, (str, bytes, Mapping)):
        return tuple(_entry(verb, "field", part) for part in entry)
    raise TypeError(f"{verb}: {option(name)} holds {named_value(entry)}; expected {_numbers(name)}")


def _numbers(name: str) -> str:
    pairs = ", y or pairs (x, y)" if name in ("fields", "field") else ""
    return f"a number or several{pairs}"


def _number(verb: str, name: str, value: object) -> object:
    if isinstance(value, Tensor):
        return value
    if not isinstance(value, Real):
        raise TypeError(f"{verb}: {option(name)} is {named_value(value)}; expected a number")
    if math.isnan(value):
        raise ValueError(f"{verb}: {option(name)} is nan; expected a number")
    return value


def _count(verb: str, name: str, value: object) -> object:
    if isinstance(value, Tensor) or (isinstance(value, Real) and value == value // 1):
        return int(value) if isinstance(value, float) else value
    kind = TypeError if not isinstance(value, Real) else ValueError
    raise kind(f"{verb}: {option(name)} is {named_value(value)}; expected a whole number")

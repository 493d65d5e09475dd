"""Results of analyses: a lens, columns, text and figure."""

import abc
from typing import Any, ClassVar, Self, TypeVar

import torch
from torch import Tensor

from raytrace.analysis.setting import NothingToShow, field_line, refuse_axis
from raytrace.maths.numerics import broadcast_shape
from raytrace.maths.result import Column, Result, Table, axis, flat, rows
from raytrace.system.lens import Lens

_FINE = 321  # points of a curve over frequency or radius, when it is drawn


class Analysis(Result):
    """A value that holds `lens`, the lens as it was analysed, and `fields` (2, F) in its kind of field, if any."""

    __slots__ = ()

    lens: Lens
    fields: Tensor

    #: The command, and the step of the points of a curve that the text lists.
    COMMAND: ClassVar[str] = ""
    EVERY: ClassVar[int] = 1

    @property
    def wavelengths(self) -> Tensor:
        """(W,) µm, those of the lens."""
        return self.lens.wavelengths

    def heads(self, **others: Tensor) -> dict[str, Tensor]:
        """The columns of the fields, along axis 0, and of vectors along the axes behind it."""
        axes = 1 + len(others)
        names = {"field_x": self.fields[0], "field_y": self.fields[1]}
        table = {name: axis(values, 0, axes) for name, values in names.items()}
        return table | {name: axis(values, k, axes) for k, (name, values) in enumerate(others.items(), 1)}

    def about(self) -> dict[str, Any]:
        """Entries of a document for the result as a whole."""
        return {}

    def summary(self) -> dict[str, Tensor]:
        """The columns of a shorter table, if there is one: the text, and the entry `summary` of JSON."""
        return {}

    def units(self) -> dict[str, str]:
        return {name: unit for name in (*self.columns(), *self.summary()) if (unit := self.column(name).unit)}

    def document(self) -> dict:
        document = {"analysis": self.COMMAND, **self.about(), "units": self.units(), "results": rows(self.columns())}
        summary = self.summary()
        return {**document, "summary": rows(summary)} if summary else document

    def drawn(self) -> Self:
        """The same curves with points as close as a drawn line needs."""
        return self

    def tables(self) -> list[Table]:
        summary = self.summary()
        return [Table(summary) if summary else self.thinned(self.columns(), self.EVERY)]

    def thinned(self, columns: dict[str, Tensor], every: int) -> Table:
        """Columns of every `every`-th point of longer curves, along the last axis."""
        length = broadcast_shape(*(c.shape for c in columns.values()))[-1]
        if every == 1 or length <= 2 * every:
            return Table(columns)
        thin = {name: c[..., ::every] if c.shape[-1] == length else c for name, c in columns.items()}
        return Table(thin, notes=[f"{len(range(0, length, every))} of {length} points of each curve; --json lists all"])

    def by_wavelength(self, values: Tensor, unit: str = "", form: str = ".6g") -> dict[Column, Tensor]:
        """Columns of text of values (..., W), one for each wavelength."""
        headings = (f"{wavelength:g} µm" for wavelength in self.wavelengths.tolist())
        return dict(zip((Column(name, unit, form) for name in headings), values.unbind(-1), strict=True))


def fine(places: Tensor) -> Tensor:
    """Frequencies or radii from 0 to the last of these, close enough for a smooth curve."""
    return places.max() * torch.linspace(0, 1, _FINE, dtype=places.dtype, device=places.device)


class OverField(Analysis, abc.ABC):
    """Curves over the field: their figure is drawn through many fields on the line to the outermost."""

    __slots__ = ()

    @abc.abstractmethod
    def at(self, fields: Tensor) -> Self:
        """The same analysis at other fields (2, F), which need not be in reach."""

    def drawn(self) -> Self:
        refuse_axis(self.fields)
        return self.at(field_line(self.fields))


_HEADS = ("field_x", "field_y", "wavelength")

Shown = TypeVar("Shown", bound=Analysis)


def shown(result: Shown) -> Shown:
    """The result. Raises NothingToShow if all its numbers are undefined."""
    values = flat({name: column for name, column in result.columns().items() if name not in _HEADS})
    if not any(torch.from_numpy(column).isfinite().any() for column in values.values()):
        raise NothingToShow(
            f"nothing to show: no number of {result.COMMAND.replace('-', ' ')} exists for this lens; `raytrace info` "
            "shows whether it has a focal length and an image"
        )
    return result

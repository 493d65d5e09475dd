"""Phase variables: the heights of a thin element as parameters of a module."""

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from raytrace.imaging.variables import Owned
from raytrace.system.identity import digest
from raytrace.wave_optics.element import Element


class PhaseVariables(Owned):
    """An element whose numbers are learned, alone or with others in contact.

        numbers = start + unit · B c      c = `change`, from zero;   without a basis B = 1

    element: where it starts; unit: mm of a change of 1, a micrometre by default, so that rates of learning read in µm.
    basis: (numbers..., K), what the K changes add to its heights or coefficients: `radial_powers`, say.
    others: elements in contact that stay as they are. tolerance: heights err by up to so many mm, evenly, by `draw`.
    `state_dict` carries the element that the changes are of, and loads into that one alone (`Owned`).
    """

    def __init__(
        self,
        element: Element,
        *,
        unit: float = 1e-3,
        basis: Tensor | None = None,
        others: Sequence[Element] = (),
        tolerance: float = 0.0,
    ):
        super().__init__()
        self.element, self.unit, self.others, self.tolerance = element, unit, tuple(others), tolerance
        self.start = element.numbers
        self.basis = basis
        shape = self.start.shape if basis is None else basis.shape[-1:]
        if basis is not None and basis.shape[:-1] != self.start.shape:
            raise ValueError(
                f"a basis of {tuple(basis.shape)} for numbers of {tuple(self.start.shape)}: expected "
                f"{(*self.start.shape, 'K')}"
            )
        self.change = nn.Parameter(torch.zeros(shape, dtype=self.start.dtype, device=self.start.device))

    def identity(self) -> dict:
        """The element: its profile, shape, glass, aperture in mm, the unit in mm; digests of where its numbers start,
        of the basis, of its glass and of the elements in contact."""
        return {
            "profile": type(self.element.profile).__name__,
            "numbers": list(self.start.shape),
            "glass": self.element.glass.name,
            "aperture": 2 * float(self.element.radius.detach()),
            "unit": self.unit,
            "start": digest(self.start),
            "basis": digest(self.basis),
            "material": digest(self.element.glass),
            "others": digest(self.others),
        }

    def difference(self, before: dict) -> str:
        """How a stored identity differs from this one, "" where it does not."""
        for name, value in self.identity().items():
            stored = before.get(name)
            numbers = isinstance(stored, float) and isinstance(value, float)
            if not (math.isclose(stored, value, rel_tol=1e-6) if numbers else stored == value):
                is_digest = name in ("start", "basis", "material", "others")
                words = f"other {name}" if is_digest else f"{name} {stored}, not {value}"
                return f"an element of {words}"
        return ""

    def numbers(self) -> Tensor:
        """Heights or coefficients as they are now, mm."""
        change = self.change if self.basis is None else self.basis @ self.change
        return self.start + self.unit * change

    def forward(self, *, draw: torch.Generator | None = None) -> tuple[Element, ...]:
        """The element as it is now, and those in contact; draw: errors of fabrication are drawn from it."""
        numbers = self.numbers()
        if draw is not None and self.tolerance:
            error = torch.rand(numbers.shape, generator=draw, dtype=numbers.dtype, device=numbers.device)
            numbers = numbers + self.tolerance * (2 * error - 1)
        return (self.element.with_numbers(numbers), *self.others)

"""Sweep: optima of the closed form over what the paper leaves open: aperture, ρ, noise, normalisation, start.

Every factor is varied alone, then aperture, noise and normalisation together.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Sequence

from torch import Tensor

from raytrace.studies.codesign import optima
from raytrace.studies.codesign.optima import Optimum, Place, closed_form
from raytrace.studies.codesign.settings import MODELS, Settings
from raytrace.system.lens import Lens

DEFAULT, COMBINED = "default", "combination"


@dataclasses.dataclass(frozen=True)
class Factor:
    """One of the settings, the values it takes while all others stay, and how one of them is written."""

    name: str
    values: tuple[float | str, ...]
    text: str
    models: tuple[str, ...] = MODELS


FACTORS = (
    Factor("f_number", (3.0, 4.0, 5.0, 6.5), "F/{}"),
    Factor("rho", (0.3, 0.5, 0.7), "ρ {}", models=("paraxial",)),  # of no other model
    Factor("noise", (0.01, 0.1), "noise {}"),
    Factor("normalise", ("window", "energy"), "normalised to {}"),
    Factor("start", ("paraxial", "rms"), "start {}"),
)
TOGETHER = ("f_number", "noise", "normalise")


@dataclasses.dataclass(frozen=True)
class Case:
    """One optimum to find."""

    factor: str
    value: str
    settings: Settings


@dataclasses.dataclass(frozen=True)
class Row(Place):
    """One optimum, and what it is the optimum for."""

    factor: str = ""
    value: str = ""


COLUMNS = ("factor", "value", *optima.COLUMNS)


@dataclasses.dataclass(frozen=True)
class Reading:
    """One way to read the experiment: the optima of all models in it."""

    factor: str
    value: str
    of: dict[str, Row]

    @property
    def text(self) -> str:
        return {one.name: one for one in FACTORS}[self.factor].text.format(self.value) if self.is_alone else self.value

    @property
    def is_alone(self) -> bool:
        return self.factor not in (DEFAULT, COMBINED)

    def penalty(self, model: str) -> float:
        """Error of a model's lens with DRT PSFs over the least of all, less 1."""
        return self.of[model].error_drt / min(row.error_drt for row in self.of.values()) - 1


def cases(settings: Settings, factors: Sequence[Factor] = FACTORS) -> list[Case]:
    """All optima of a sweep around these settings: as they are, each factor alone, those of `TOGETHER` together."""
    found = [Case(DEFAULT, "as set", dataclasses.replace(settings, model=model)) for model in MODELS]
    for factor in factors:
        found += [
            Case(factor.name, _text(value), dataclasses.replace(settings, model=model, **{factor.name: value}))
            for value in factor.values
            for model in factor.models
        ]
    together = [factor for factor in factors if factor.name in TOGETHER]
    for values in itertools.product(*(factor.values for factor in together)) if len(together) > 1 else ():
        changed = list(zip(together, values, strict=True))
        text = ", ".join(factor.text.format(_text(value)) for factor, value in changed)
        own = dataclasses.replace(settings, **{factor.name: value for factor, value in changed})
        found += [Case(COMBINED, text, dataclasses.replace(own, model=model)) for model in MODELS]
    return found


def sweep(
    lens: Lens,
    settings: Settings,
    spectrum: Tensor,
    *,
    factors: Sequence[Factor] = FACTORS,
    progress: Callable[[Sequence[Case]], Iterable[Case]] = iter,
) -> list[Row]:
    """The optimum of every case; one that was found for another case is not sought again.

    spectrum: `power_spectrum` of the pictures; progress: wraps the cases, for a bar.
    """
    known: dict[Settings, Optimum] = {}
    found = []
    for case in progress(cases(settings, factors)):
        if case.settings not in known:
            known[case.settings] = closed_form(lens, case.settings, spectrum)
        optimum = {name: getattr(known[case.settings], name) for name in optima.COLUMNS}
        found.append(Row(**optimum, factor=case.factor, value=case.value))
    return found


def readings(rows: Sequence[Row]) -> list[Reading]:
    """The rows by what they have in common; a factor that does not reach a model leaves it as by default."""
    default = {row.model: row for row in rows if row.factor == DEFAULT}
    groups: dict[tuple[str, str], dict[str, Row]] = {}
    for row in rows:
        groups.setdefault((row.factor, row.value), dict(default))[row.model] = row
    return [Reading(factor, value, of) for (factor, value), of in groups.items()]


def distinct(found: Sequence[Reading]) -> list[Reading]:
    """The readings without those that repeat another: each factor has a value that is the default one."""
    kept: dict[tuple[float, ...], Reading] = {}
    for one in found:
        kept.setdefault(tuple(row.sensor_mm for row in one.of.values()), one)
    return list(kept.values())


def _text(value: float | str) -> str:
    return value if isinstance(value, str) else f"{value:g}"

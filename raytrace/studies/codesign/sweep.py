"""Sweep: optima of the closed form over what the paper leaves open: aperture, ρ, noise, normalisation, how distances
lie, start, how many rays and where they cross the pupil.

Every factor is varied alone, then aperture and others together.
"""

import dataclasses
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType

from torch import Tensor

from raytrace.studies.codesign import optima
from raytrace.studies.codesign.kept import Kept, found_once
from raytrace.studies.codesign.optima import Place, closed_form
from raytrace.studies.codesign.settings import MODELS, Settings
from raytrace.studies.codesign.study import PAPER
from raytrace.system.lens import Lens

DEFAULT, COMBINED = "default", "combination"


@dataclasses.dataclass(frozen=True)
class Factor:
    """One of the settings, the values it takes while all others stay, and how one of them is written.

    field: its setting, by default that of its name; also: settings that go with it; models: those it reaches.
    """

    name: str
    values: tuple[float | str, ...]
    text: str
    models: tuple[str, ...] = MODELS
    field: str = ""
    also: tuple[tuple[str, str], ...] = ()

    def of(self, value: float | str) -> dict[str, float | str]:
        """The settings that a value is."""
        return {self.field or self.name: value, **dict(self.also)}


_TRACED = ("gaussian", "drt")
_FAST = (1.6, 1.65, 1.7, 1.72, 1.74, 1.76, 1.78, 1.8, 1.85, 1.9, 2.0, 2.2, 2.4, 2.7)
FACTORS = (
    Factor("f_number", (*_FAST, 3.0, 4.0, 5.0, 6.5), "F/{}"),
    Factor("rho", (0.3, 0.5, 0.7), "ρ {}", models=("paraxial",)),
    Factor("noise", (0.01, 0.1), "noise {}"),
    Factor("normalise", ("window", "energy"), "normalised to {}"),
    Factor("spread", ("uniform", "reciprocal"), "{} distances"),
    Factor("start", ("paraxial", "rms"), "start {}"),
    Factor("rays", (12, 50, 256), "{} Sobol rays", models=_TRACED),
    Factor("hexapolar", (12, 50, 256), "{} hexapolar rays", _TRACED, "rays", (("sampling", "hexapolar"),)),
)
#: Factors that are varied together, and the apertures tried with them: closely where the rim's aberration changes sign.
TOGETHER = {
    ("f_number", "noise", "normalise", "spread"): (1.7, 1.74, 1.76, 1.8, 1.9, 2.0, 2.4, 3.0, 4.0),
    ("f_number", "rays"): (1.7, 1.74, 1.76, 1.78, 1.8, 1.85, 1.9, 2.0, 3.0),
    ("f_number", "hexapolar"): (1.7, 1.74, 1.76, 1.78, 1.8, 1.85, 1.9, 2.0, 3.0),
}


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

    def focus(self, definition: Callable[[Row], float]) -> tuple[float, ...]:
        """Focus distances in m of the models of the paper, by a definition."""
        return tuple(definition(self.of[model]) for model in PAPER)

    def departure(self, definition: Callable[[Row], float]) -> float:
        """The most by which one of them departs from the paper's, m."""
        found = zip(self.focus(definition), PAPER.values(), strict=True)
        return max(abs(metres - focus) for metres, (*_, focus) in found)

    @property
    def is_alone(self) -> bool:
        return self.factor not in (DEFAULT, COMBINED)

    def penalty(self, model: str) -> float:
        """Error of a model's lens with DRT PSFs over the least of all, less 1."""
        return self.of[model].error_drt / min(row.error_drt for row in self.of.values()) - 1


def cases(settings: Settings, factors: Sequence[Factor] = FACTORS) -> list[Case]:
    """All optima of a sweep around these settings: as they are, each factor alone, those of `TOGETHER` together."""
    found = [Case(DEFAULT, "as set", _of_model(settings, model)) for model in MODELS]
    for factor in factors:
        found += [
            Case(factor.name, _text(value), _of_model(dataclasses.replace(settings, **factor.of(value)), model))
            for value in factor.values
            for model in factor.models
        ]
    by_name = {factor.name: factor for factor in factors}
    for names, apertures in TOGETHER.items():
        if by_name.keys() >= set(names):
            found += _together(settings, [by_name[name] for name in names], apertures)
    return found


def _together(settings: Settings, factors: Sequence[Factor], apertures: Sequence[float]) -> Iterator[Case]:
    """All values of several factors with one another, of the aperture these."""
    values = [apertures if one.name == "f_number" else one.values for one in factors]
    for chosen in itertools.product(*values):
        text = ", ".join(one.text.format(_text(value)) for one, value in zip(factors, chosen, strict=True))
        changed = {key: of for one, value in zip(factors, chosen, strict=True) for key, of in one.of(value).items()}
        own = dataclasses.replace(settings, **changed)
        yield from (Case(COMBINED, text, _of_model(own, model)) for model in MODELS)


def _of_model(settings: Settings, model: str) -> Settings:
    """The settings for a model, those that do not reach it as they always are: the same optimum is then sought once."""
    names = [name for reached, names in _REACH.items() if model not in reached for name in names]
    if settings.drt_rays is not None:
        names = [name for name in names if name != "sampling"]  # DRT PSFs judge the lenses of all models
    usual = {field.name: field.default for field in dataclasses.fields(Settings) if field.name in names}
    return dataclasses.replace(settings, model=model, **usual)


_REACH = {("paraxial",): ("rho",), _TRACED: ("rays", "sampling")}


def sweep(
    lens: Lens,
    settings: Settings,
    spectrum: Tensor,
    *,
    factors: Sequence[Factor] = FACTORS,
    progress: Callable[[Sequence[Case]], Iterable[Case]] = iter,
    kept: Kept | None = None,
) -> list[Row]:
    """The optimum of every case; one that was found for another case, or is kept, is not sought again.

    spectrum: `power_spectrum` of the pictures; progress: wraps the cases, for a bar.
    """

    pairs = found_once(cases(settings, factors), _finder(lens, spectrum), progress=progress, kept=kept)
    return [Row(**found, factor=case.factor, value=case.value) for case, found in pairs]


def _finder(lens: Lens, spectrum: Tensor) -> Callable[[Settings], dict]:
    """What finds the optimum of settings, by the names of its columns."""

    def find(own: Settings) -> dict:
        optimum = closed_form(lens, own, spectrum)
        return {name: getattr(optimum, name) for name in optima.COLUMNS}

    return find


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


# ---------------------------------------------------------------- the size of the pictures

SCALES = (0.75, 1.0, 1.5, 2.0, 2.5)
SCALE_COLUMNS = ("scale", "deviation", "model", "sensor_mm", "focus_paraxial_m", "rms_error", "rms_error_drt")


def by_scale(
    lens: Lens,
    settings: Settings,
    spectrum: Callable[[float], Tensor],
    *,
    kept: Mapping[float, Kept] = MappingProxyType({}),
) -> list[dict[str, float | str]]:
    """Optima for pictures resized before patches are cut: errors as roots of mean squares, of pictures from 0 to 1.

    spectrum: of pictures of so many times the size; deviation: theirs about the mean of each patch; kept: by scale.
    """
    rows = []
    for scale in SCALES:
        power = spectrum(scale)
        deviation = float((power.mean() - power[0, 0] / power.numel()).sqrt())
        own = [Case("scale", f"{scale:g}", _of_model(settings, model)) for model in MODELS]
        for case, found in found_once(own, _finder(lens, power), kept=kept.get(scale)):
            values = (scale, deviation, case.settings.model, found["sensor_mm"], found["focus_paraxial_m"])
            errors = (found["error"] ** 0.5, found["error_drt"] ** 0.5)
            rows.append(dict(zip(SCALE_COLUMNS, (*values, *errors), strict=True)))
    return rows

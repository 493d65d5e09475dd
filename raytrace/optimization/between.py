"""Spots between the fields, wavelengths and rays of a merit function, where an optimised lens may be much worse."""

import warnings
from collections.abc import Iterator, Sequence

import torch
from torch import Tensor

from raytrace.analysis.spot_diagram import spot
from raytrace.maths.numerics import detached, value
from raytrace.optimization.merit import DefaultMerit
from raytrace.system.lens import Lens, field_label, field_points, with_wavelengths
from raytrace.words import RaytraceWarning, calling_level

WORSE = 1.5  # ratio of spots from which it is said
_LEAST = 1e-6  # mm, of a spot that is smaller than any use


class WorseBetween(RaytraceWarning):
    """Spots of an optimised lens that are much larger between its fields, wavelengths or rays than at them."""


@value
class Between:
    """The largest spot of one kind between samples of a merit function, relative to that at the samples.

    samples: "fields", "wavelengths" or "rays"; place: where, in words; radius: the RMS spot radius there, mm; nearest:
    the largest at the samples beside it, mm; configuration: 0 for a lens with a single one.
    """

    samples: str
    place: str
    radius: float
    nearest: float
    configuration: int = 0

    @property
    def ratio(self) -> float:
        return self.radius / max(self.nearest, 1e-300)

    @property
    def is_worse(self) -> bool:
        return self.radius > WORSE * max(self.nearest, _LEAST)

    def __str__(self) -> str:
        configuration = f" of configuration {self.configuration}" if self.configuration else ""
        return (
            f"RMS spot radius between the {self.samples}{configuration}, {self.place}: {1e3 * self.radius:.4g} µm, "
            f"{self.ratio:.3g} times the {1e3 * self.nearest:.4g} µm beside it; {_ADVICE[self.samples]}"
        )


_EVEN = {"fields": "between fields", "wavelengths": "between wavelengths", "rays": "over the whole pupil"}
_ADVICE = {
    "fields": "add fields",
    "wavelengths": "add wavelengths",
    "rays": "take more rings in the merit function",
}


@torch.no_grad()
def between(lens: Lens) -> tuple[Between, ...]:
    """The largest spots halfway between neighbouring fields, halfway between neighbouring wavelengths, and of the whole
    pupil with its rim against the few rays of a default merit function; of every configuration.

    `rt.spot` computes the spots, RMS about the centroid of all wavelengths of the field, mm. Fields are neighbours in
    the order of their height. Neglected: other places than these halfway points, and light beyond the lens's own band.
    """
    several = len(lens.configurations) > 1
    lenses = [(number if several else 0, detached(each)) for number, each in enumerate(lens.configurations, 1)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RaytraceWarning)
        return tuple(worst for number, each in lenses for worst in _of_lens(each, number))


def worse_between(lens: Lens) -> tuple[Between, ...]:
    """Those of `between` that are more than 1.5 times as large."""
    return tuple(worst for worst in between(lens) if worst.is_worse)


def summary(gaps: Sequence[Between], beside: str = "the spots of the merit function") -> list[str]:
    """Lines of the gaps that are worse, and one of the largest ratios of all others; beside: what they are between."""
    lines = [str(gap) for gap in gaps if gap.is_worse]
    largest: dict[str, Between] = {}
    for gap in gaps:
        if gap.ratio >= largest.get(gap.samples, gap).ratio:
            largest[gap.samples] = gap
    even = [f"{gap.ratio:.3g} {_EVEN[gap.samples]}" for gap in largest.values() if not gap.is_worse]
    return [
        *lines,
        *([f"largest ratio of RMS spot radii to {beside}: {', '.join(even)}"] if even else []),
    ]


def warn_of_worse(gaps: Sequence[Between]) -> None:
    """Warn WorseBetween of each gap that is worse."""
    for gap in (gap for gap in gaps if gap.is_worse):
        warnings.warn(str(gap), WorseBetween, stacklevel=calling_level())


def _of_lens(lens: Lens, configuration: int) -> Iterator[Between]:
    points = field_points(None, like=lens)
    points = points[:, points.norm(dim=0).argsort()]
    middle = 0.5 * (points[:, :-1] + points[:, 1:])
    count = points.shape[1]
    whole = spot(lens, fields=torch.cat([points, middle], 1)).whole
    radii, centre = whole.rms_radius, whole.centroid[:, :count]
    of_fields, of_middle = radii[:count], radii[count:]
    labels = [field_label(lens, point) for point in points.T.tolist()]
    places = [f"at {field_label(lens, point)}" for point in middle.T.tolist()]
    yield from _largest("fields", places, of_middle, torch.maximum(of_fields[:-1], of_fields[1:]), configuration)

    waves = lens.wavelengths.sort().values
    between_waves = 0.5 * (waves[:-1] + waves[1:])
    if len(between_waves):
        each = _about(centre, lens, points, torch.cat([waves, between_waves]))
        neighbours = torch.maximum(each[:, : len(waves) - 1], each[:, 1 : len(waves)])
        places = [f"at {wave:.4g} µm, {label}" for label in labels for wave in between_waves.tolist()]
        yield from _largest("wavelengths", places, each[:, len(waves) :].flatten(), neighbours.flatten(), configuration)

    few = spot(lens, fields=points, rings=DefaultMerit().rings).whole.rms_radius
    yield from _largest("rays", [f"at {label}" for label in labels], of_fields, few, configuration)


def _about(centre: Tensor, lens: Lens, fields: Tensor, wavelengths: Tensor) -> Tensor:
    """RMS radii (F, W) in mm of single wavelengths about points (2, F) mm."""
    primary_first = torch.cat([lens.primary.reshape(1), wavelengths])
    each = spot(with_wavelengths(lens, primary_first), fields=fields).each
    return (each.mean_square_radius + (each.centroid - centre[..., None]).square().sum(0)).sqrt()[:, 1:]


def _largest(
    samples: str, places: Sequence[str], radii: Tensor, nearest: Tensor, configuration: int
) -> Iterator[Between]:
    """The place of the largest ratio, of spots that light reaches."""
    ratios = (radii / nearest.clamp(min=_LEAST)).nan_to_num(nan=0.0, posinf=0.0)
    if len(ratios) and float(ratios.max()) > 0:
        k = int(ratios.argmax())
        yield Between(samples, places[k], float(radii[k]), float(nearest[k]), configuration)

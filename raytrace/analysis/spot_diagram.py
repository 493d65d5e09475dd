"""Spots: the spot of every field and wavelength on the sensor, of rays that are kept or of any number that are not."""

import warnings
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.maths import pupil
from raytrace.maths.result import Result, axis, cell, number, numbers
from raytrace.maths.value import value
from raytrace.system.lens import FIELD_UNITS, Lens, field_points, name_of_field, with_wavelengths
from raytrace.tracing.launch import warn_of_filling, with_ray_aiming
from raytrace.tracing.ray_failures import STATUS, LostRays, warn_of_failures
from raytrace.tracing.spot import Arrivals, Spot, arrivals, chief_reference, spot_of, spot_of_points
from raytrace.tracing.streaming import MAX_BYTES, StreamedSpot, stream_spots
from raytrace.words import calling_level

_TRIED = 4096  # rays that tell where all are lost
_RIM = 72  # rays on the rim of the pupil, for the largest radius, as the spot of few rays has them
_REFERENCES, _WEIGHTS = ("centroid", "chief"), ("area", "equal")


def _of_each(name: str) -> property:
    return property(lambda spots: getattr(spots.each, name), doc=f"(F, W): `{name}` of every spot.")


@value
class Spots(Result):
    """Spots (F, W) of every field and wavelength on the sensor, mm: what Spot says of them, this says, too.

    each: (F, W) Spot, or StreamedSpot of rays that were not kept; whole: (F,) those of all wavelengths together, by
    their weights. arrivals: the rays, None where none were kept. reference, weights: as for `spot`.
    lens, fields: (2, F), what was looked at. The table has a row a spot; `save` writes the rays.
    """

    lens: Lens
    fields: Tensor
    each: Spot | StreamedSpot
    whole: Spot | StreamedSpot
    arrivals: Arrivals | None = None
    reference: str = "centroid"
    weights: str = "area"

    FIGURE = "plotting.spots.spot_diagram"

    centroid = _of_each("centroid")
    mean_square_radius = _of_each("mean_square_radius")
    rms_radius = _of_each("rms_radius")
    geometric_radius = _of_each("geometric_radius")
    rays = _of_each("rays")

    @property
    def launched(self) -> int:
        """How many set out for each field and wavelength."""
        return self.each.launched if self.arrivals is None else self.each.valid.shape[-1]

    def columns(self) -> dict[str, Tensor]:
        x, y = (axis(component, 0, 2) for component in self.fields)
        names = ("rms_radius", "geometric_radius", "rays")
        return {
            "field_x": x, "field_y": y, "wavelength": self.lens.wavelengths,
            "centroid_x": self.centroid[0], "centroid_y": self.centroid[1],
            **{name: getattr(self.each, name) for name in names},
        }  # fmt: skip

    def units(self) -> dict[str, str]:
        field = FIELD_UNITS[self.lens.fields.kind]
        lengths = ("centroid_x", "centroid_y", "rms_radius", "geometric_radius")
        return {"field_x": field, "field_y": field, "wavelength": "µm", **dict.fromkeys(lengths, "mm")}

    def document(self) -> dict:
        places = [(f, w) for f in range(self.fields.shape[1]) for w in range(len(self.lens.wavelengths))]
        unit = {"field_type": self.lens.fields.kind, "field_unit": FIELD_UNITS[self.lens.fields.kind]}
        about = {} if self.arrivals is None else {"reference": self.reference, "weights": self.weights}
        return {**unit, "results": [self._entry(*place) for place in places], **about}

    def _entry(self, f: int, w: int) -> dict:
        """What JSON says of a spot: null where no ray arrives."""
        found = {
            "field": numbers(self.fields[:, f]),
            "wavelength": number(self.lens.wavelengths[w]),
            "centroid": numbers(self.centroid[:, f, w]),
            "rms_radius": number(self.rms_radius[f, w]),
            "geometric_radius": number(self.geometric_radius[f, w]),
            "rays": int(self.rays[f, w]),
        }
        if self.arrivals is None:
            found["geometric_bound"] = number(self.each.geometric_bound[f, w])
        else:
            found["vignetted"] = int((self.arrivals.status[f, w] == STATUS.index("vignetted")).sum())
        return {**found, "launched": self.launched}

    def __str__(self) -> str:
        unit, width = FIELD_UNITS[self.lens.fields.kind], 7 if self.arrivals is not None else 11
        heads = ("centroid x", "centroid y", "RMS", "GEO"), ("mm", "mm", "µm", "µm")
        lines = [f"{'field':>10} {'wavelength':>11} {_row(heads[0])} {'rays':>{width}}"]
        lines += [f"{unit:>10} {'µm':>11} {_row(heads[1])} {'lost':>{width}}"]
        colours = self.lens.wavelengths.tolist()
        for f, field in enumerate(self.fields.unbind(1)):
            for w, wavelength in enumerate(colours):
                lost = self.launched - int(self.rays[f, w])
                lines.append(
                    f"{name_of_field(field):>10} {wavelength:>11g} {_cells(self.each, (f, w))} {lost:>{width}}"
                )
            if len(colours) > 1:
                lines.append(f"{'':>10} {'all':>11} {_cells(self.whole, (f,))}")
        return "\n".join(lines)

    def plot(self, path=None, **options):
        """The spot diagram; also saved under `path` if one is given. Raises ValueError where no rays were kept."""
        self._kept("`plot`")
        return Result.plot(self, path, **options)

    def save(self, path) -> None:
        """Write the rays as .csv: field, wavelength, pupil point, x, y, weight, status."""
        self._kept("`output`").save(path)

    def _kept(self, what: str) -> Arrivals:
        if self.arrivals is None:
            raise ValueError(f"{what} needs the rays, and `rays` keeps none: leave one out")
        return self.arrivals


def spot(
    lens: Lens,
    *,
    fields: Tensor | Sequence | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    sampling: str = "gauss",
    rings: int | None = None,
    points: int | None = None,
    seed: int = 0,
    rays: int | None = None,
    reference: str = "centroid",
    weights: str = "area",
    ray_aiming: str | None = None,
    max_bytes: int | None = None,
    progress: Callable | None = None,
) -> Spots:
    """The spot of every field and wavelength on the sensor, differentiable in every number of the lens.

    fields: y, (x, y) or (2, F), in the lens's own kind of field, by default its own; wavelengths: µm, alike in weight,
    the first one primary, by default the lens's. sampling, rings, points, seed: as for `pupil.sampled`; rays: instead,
    so many sobol or random rays for each field and wavelength, traced in chunks of no more than max_bytes, none kept
    and nothing differentiated. reference: radii about the "centroid" or the "chief" ray of the primary wavelength;
    weights: rays count by their share of the pupil's "area", or all "equal". ray_aiming: a key of RAY_AIMING.
    Warns LostRays for fields that lose all their rays, UnfilledStop. Raises ValueError for what is not known.
    progress: called with (work, unit), gives what is gone through or a bar to update.
    """
    for name, word, known in (("reference", reference, _REFERENCES), ("weights", weights, _WEIGHTS)):
        if word not in known:
            raise ValueError(f"{name} {word!r}: expected one of {', '.join(known)}")
    lens = lens if wavelengths is None else with_wavelengths(lens, wavelengths)
    fields = field_points(fields, like=lens)
    warn_of_filling(lens, fields, ray_aiming=ray_aiming)
    if rays is not None:
        _refuse_of_many(sampling, rings, points, reference, weights)
        how = {"seed": seed, "ray_aiming": ray_aiming, "max_bytes": max_bytes}
        return _of_many(lens, fields, rays, "random" if sampling == "random" else "sobol", progress, **how)
    like = lens.surfaces[-2].thickness
    at, shares = pupil.sampled(sampling, rings=rings, points=points, seed=seed, dtype=like.dtype, device=like.device)
    if weights == "equal":
        shares = torch.full_like(shares, 1 / len(shares))
    else:  # the rim carries no weight: it shows in the geometric radius, which Gaussian nodes inside the pupil miss
        at, shares = pupil.with_rim(at, shares)
    each = iter if progress is None else lambda work: progress(work, "field")
    found = arrivals(lens, at, shares, fields=fields, ray_aiming=ray_aiming, progress=each)
    if unaimed := int((found.status == STATUS.index("unaimed")).sum()):
        told = f"{unaimed} of {found.status.numel()} rays found no way to their point of the stop"
        warnings.warn(told, LostRays, stacklevel=calling_level())
    about = None if reference == "centroid" else chief_reference(with_ray_aiming(lens, ray_aiming), fields)
    spots = spot_of(found.rays, shares, about=about)
    warn_of_failures(lens, at, spots.rms_radius.isnan(), fields=fields, ray_aiming=ray_aiming)
    hits, valid = found.rays.position[:2].flatten(2), found.rays.valid.flatten(1)
    about = None if about is None else about[..., 0]
    whole = spot_of_points(hits, valid, found.weight.flatten(), about=about)
    return Spots(lens, fields, spots, whole, found, reference, weights)


def _refuse_of_many(sampling: str, rings: int | None, points: int | None, reference: str, weights: str) -> None:
    if (reference, weights) != ("centroid", "area"):
        raise ValueError("`rays` gives radii about the centroid by area: leave `reference` and `weights` out")
    for name, given in (("rings", rings), ("points", points)):
        if given is not None:
            raise ValueError(f"`rays` and `{name}` exclude each other: both are a number of rays")
    if sampling in ("hexapolar", "square"):
        raise ValueError(f"`rays` takes `sampling=sobol` (its default) or random, not {sampling}")


def _of_many(lens, fields, rays: int, sampling: str, progress, *, seed: int, ray_aiming, max_bytes) -> Spots:
    how = {"sampling": sampling, "seed": seed, "rim": _RIM, "ray_aiming": ray_aiming}
    how["max_bytes"] = MAX_BYTES if max_bytes is None else max_bytes
    if progress is None:
        each, whole = stream_spots(lens, rays, fields=fields, **how)
    else:
        with progress(rays * fields.shape[1] * len(lens.wavelengths), "ray") as bar:
            each, whole = stream_spots(lens, rays, fields=fields, **how, progress=bar.update)
    tried = pupil.sobol(min(rays, _TRIED))[0].to(lens.surfaces[-2].thickness)
    warn_of_failures(lens, tried, each.rays == 0, fields=fields, ray_aiming=ray_aiming)
    return Spots(lens, fields, each, whole)


def _row(cells: Sequence[str]) -> str:
    return " ".join(f"{words:>{width}}" for words, width in zip(cells, (13, 13, 10, 10), strict=True))


def _cells(spots: Spot | StreamedSpot, at: tuple[int, ...]) -> str:
    """Centroid in mm, RMS and geometric radius in µm of one spot, as the table has them; - where no ray arrives."""
    x, y = spots.centroid[(slice(None), *at)].tolist()
    radii = (1000 * float(radius[at]) for radius in (spots.rms_radius, spots.geometric_radius))
    return " ".join([*(cell(v, ">13.7f") for v in (x, y)), *(cell(v, ">10.4f") for v in radii)])

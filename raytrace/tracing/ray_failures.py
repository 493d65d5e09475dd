"""Ray failures: where the rays of every field and wavelength fail or are vignetted, and messages about them."""

import dataclasses
import warnings
from collections.abc import Iterator

import torch
from torch import Tensor

from raytrace.budget import RAY_BYTES, afford
from raytrace.maths.numerics import value
from raytrace.maths.sampling import hexapolar
from raytrace.system.lens import FIELD_UNITS, Lens, name_of_field, one_lens
from raytrace.system.rays import Rays
from raytrace.tracing.launch import launch
from raytrace.tracing.paraxial import axial_beam
from raytrace.tracing.trace import Crossing, lens_steps, trace_lens
from raytrace.words import RaytraceError, RaytraceWarning, calling_level, option

#: Status of a ray, and its wording at a surface.
FATES = {
    "ok": "arrived",
    "vignetted": "vignetted at surface {}",
    "miss": "missed surface {}",
    "tir": "totally reflected at surface {}",
    "unaimed": "not aimed at the stop",
}
STATUS = tuple(FATES)
_OK = STATUS.index("ok")
#: Failures of a ray at a surface, in the order of reports.
LOST = ("miss", "tir", "vignetted")
_RINGS = 8  # of the rays that try a field


class LostRays(RaytraceWarning):
    """Rays do not reach the sensor; the message has their field, the surfaces where they end and a remedy."""


class OutOfReach(RaytraceError, ValueError):
    """No ray of a field reaches the sensor; the message has the surfaces where they end and a remedy."""


@value
class Losses:
    """Number of rays that end at every surface, by their first failure.

    lost: (3, K, F, W) missed, totally reflected and vignetted at surface k + 1; unaimed: (F, W) not launched, because
    ray aiming failed; launched: number of each field and wavelength.
    """

    lost: Tensor
    unaimed: Tensor
    launched: int

    @property
    def arrived(self) -> Tensor:
        """Number of rays (F, W) that reach the image."""
        return self.launched - self.lost.sum((0, 1)) - self.unaimed

    def words(self, field: int, wavelength: int) -> str:
        """The rays of one field and wavelength as text, "all 648 rays lost: 648 vignetted at surface 6"."""
        arrived = int(self.arrived[field, wavelength])
        parts = [f"{n} {FATES['unaimed']}"] if (n := int(self.unaimed[field, wavelength])) else []
        for k, of_surface in enumerate(self.lost[:, :, field, wavelength].T.tolist(), 1):
            parts += [f"{n} {FATES[name].format(k)}" for name, n in zip(LOST, of_surface, strict=True) if n]
        if not parts:
            return f"all {self.launched} rays arrive"
        lost = f"all {self.launched}" if arrived == 0 else f"{self.launched - arrived} of {self.launched}"
        return f"{lost} rays lost: " + (parts[0].split(" ", 1)[1] if len(parts) == 1 else ", ".join(parts))


def ray_status(lens: Lens, rays: Rays, wavelength: Tensor) -> Iterator[tuple[Crossing, Tensor]]:
    """The crossing of each surface in turn, as of `trace.steps`, and the status (...) of every ray behind it.

    wavelength: (...) µm; status: index in STATUS of the first failure.
    """
    status = torch.where(rays.valid, _OK, STATUS.index("unaimed"))
    for crossing in lens_steps(lens, rays, wavelength):
        for name, fate in zip(LOST, (crossing.missed, crossing.totally_reflected, crossing.clipped), strict=True):
            status = torch.where((status == _OK) & fate, STATUS.index(name), status)
        yield crossing, status


@torch.no_grad()
def ray_failures(
    lens: Lens,
    pupil: Tensor,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    ray_aiming: str | None = None,
) -> Losses:
    """Where rays fail or are vignetted; arguments as for `launch`."""
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    rays = launch(lens, pupil, fields=fields, wavelengths=wavelengths, ray_aiming=ray_aiming)
    codes = [STATUS.index(name) for name in LOST]
    ended = [
        torch.stack([(status == code).expand(rays.shape).sum(-1) for code in codes])
        for _, status in ray_status(lens, rays, wavelengths[:, None])
    ]
    so_far = torch.stack(ended, 1)
    return Losses(so_far.diff(dim=1, prepend=torch.zeros_like(so_far[:, :1])), (~rays.valid).sum(-1), pupil.shape[-1])


def warn_of_failures(
    lens: Lens,
    pupil: Tensor,
    dark: Tensor,
    *,
    fields: Tensor,
    wavelengths: Tensor | None = None,
    ray_aiming: str | None = None,
    prefix: str = "",
) -> None:
    """Warn LostRays, with causes, of every field whose rays all fail at a wavelength; and of too wide a beam.

    pupil: (2, P), through which rays are traced once more; dark: (F, W), which of the fields (2, F) and wavelengths
    (W,), the lens's by default; prefix: of the message, as the object distance.
    """
    if not bool(dark.any()):
        return
    if dark.dim() > 2:  # of a batch: the first lens that loses a field
        of_lens = dark.any(-1).any(-1)
        first, several = int(of_lens.int().argmax()), f"{int(of_lens.sum())} of {len(of_lens)} lenses"
        lens, dark, prefix = one_lens(lens, first), dark[first], f"{prefix}lens {first} ({several} lose fields): "
    some = dark.any(1)
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    losses = ray_failures(lens, pupil, fields=fields[:, some], wavelengths=wavelengths, ray_aiming=ray_aiming)
    for place, (field, lost) in enumerate(zip(fields[:, some].unbind(1), dark[some].tolist(), strict=True)):
        wavelengths_of: dict[str, list[str]] = {}
        for w, wavelength in enumerate(wavelengths.tolist()):
            if lost[w]:
                wavelengths_of.setdefault(losses.words(place, w), []).append(f"{wavelength:g}")
        for words, colours in wavelengths_of.items():
            _warn(f"{prefix}field {_named(lens, field)}, {', '.join(colours)} µm: {words}")
    if hint := beam_hint(lens):
        _warn(f"{hint}; see {option('f_number')} and {option('entrance_pupil_diameter')}")


@torch.no_grad()
def check_reach(lens: Lens, fields: Tensor | None = None, *, every: bool) -> None:
    """Report fields (2, F), by default the lens's, whose rays all fail at the primary wavelength, with a remedy.

    Raises OutOfReach if there is one and every field is needed, or if no field is left; else warns LostRays.
    """
    tried = torch.stack([lens.fields.x, lens.fields.y]) if fields is None else fields
    pupil, _ = hexapolar(_RINGS, dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)
    primary = lens.primary[None]
    F, P = tried.shape[1], pupil.shape[1]
    afford(RAY_BYTES * F * P, f"{F * P:,} rays that try {F:,} fields", helps="ask for fewer {fields}")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of aiming: the failures are reported below
        rays = launch(lens, pupil, fields=tried, wavelengths=primary)
        arrives = trace_lens(lens, dataclasses.replace(rays, opl=None), primary[:, None]).valid
        dark = (~arrives.any(-1)[:, 0]).nonzero()[:, 0].tolist()
        if not dark:
            return
        losses = ray_failures(lens, pupil, fields=tried[:, dark], wavelengths=primary)
    names, help_words = [_named(lens, tried[:, f]) for f in dark], _help(lens, fields)
    messages = [
        f"no ray of field {name} reaches the sensor: {losses.words(place, 0)}; {help_words}"
        for place, name in enumerate(names)
    ]
    if every or len(dark) == tried.shape[1]:
        raise OutOfReach(messages[0])
    for words in messages:
        _warn(words)


def _help(lens: Lens, fields: Tensor | None) -> str:
    if hint := beam_hint(lens):
        return f"{hint}; see {option('f_number')} and {option('entrance_pupil_diameter')}"
    if fields is not None:
        largest = float(lens.fields.extent)
        return (
            f"the fields of the lens reach {largest:g} {FIELD_UNITS[lens.fields.kind]}, give {option('fields')} within"
        )
    return (
        f"give other fields by {option('fields')}, a smaller beam by {option('f_number')} or "
        f"{option('entrance_pupil_diameter')}"
    )


def beam_hint(lens: Lens) -> str:
    """The remedy for a beam that grows with the object distance, "" unless the aperture is a cone at the object."""
    if lens.aperture.kind not in ("object_na", "object_cone_angle"):
        return ""
    number = float(lens.aperture.value)
    cone = f"object NA of {number:g}" if lens.aperture.kind == "object_na" else f"object cone of ±{number:g} degrees"
    distance, diameter = float(lens.surfaces[0].thickness), float(axial_beam(lens).entrance_pupil_diameter)
    return (
        f"the aperture is an {cone}, whose entrance pupil is {diameter:.4g} mm wide for an object at {distance:g} mm; "
        "an F-number, an entrance pupil diameter or another aperture that the lens keeps would hold its beam"
    )


def _named(lens: Lens, field: Tensor) -> str:
    return f"{name_of_field(field)} {FIELD_UNITS[lens.fields.kind]}"


def _warn(words: str) -> None:
    warnings.warn(words, LostRays, stacklevel=calling_level())

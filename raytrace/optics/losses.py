"""Losses: where the rays of every field and wavelength end, and why."""

import torch
from torch import Tensor

from raytrace.maths.value import value
from raytrace.optics.launch import launch
from raytrace.optics.paraxial import first_order
from raytrace.optics.trace import media, steps
from raytrace.system.lens import Lens

#: What happens to a ray, entry of Losses by surface -> how it is said.
_WORDS = {
    "missed": "missed surface {}",
    "totally_reflected": "totally reflected at surface {}",
    "vignetted": "vignetted at surface {}",
}


@value
class Losses:
    """How many rays end at every surface, each counted where it was lost first.

    missed, totally_reflected, vignetted: (K, F, W) at surface k + 1; unaimed: (F, W) never set out, for no ray through
    their pupil point was found; launched: how many there were of each field and wavelength.
    """

    missed: Tensor
    totally_reflected: Tensor
    vignetted: Tensor
    unaimed: Tensor
    launched: int

    @property
    def arrived(self) -> Tensor:
        """How many rays (F, W) reach the image."""
        lost = (self.missed + self.totally_reflected + self.vignetted).sum(0) + self.unaimed
        return self.launched - lost

    def words(self, field: int, wavelength: int) -> str:
        """What became of the rays of one field and wavelength, as "all 648 rays lost: 648 vignetted at surface 6"."""
        arrived = int(self.arrived[field, wavelength])
        parts = [f"{n} not aimed at the stop"] if (n := int(self.unaimed[field, wavelength])) else []
        for k in range(len(self.missed)):
            for name, said in _WORDS.items():
                if count := int(getattr(self, name)[k, field, wavelength]):
                    parts.append(f"{count} {said.format(k + 1)}")
        if not parts:
            return f"all {self.launched} rays arrive"
        lost = f"all {self.launched}" if arrived == 0 else f"{self.launched - arrived} of {self.launched}"
        alone = len(parts) == 1
        return f"{lost} rays lost: " + (parts[0].split(" ", 1)[1] if alone else ", ".join(parts))


@torch.no_grad()
def losses(
    lens: Lens,
    pupil: Tensor,
    *,
    fields: Tensor | None = None,
    wavelengths: Tensor | None = None,
    ray_aiming: str | None = None,
) -> Losses:
    """Where rays are lost on their way to the image; arguments as for `launch`."""
    wavelengths = lens.wavelengths if wavelengths is None else wavelengths
    rays = launch(lens, pupil, fields=fields, wavelengths=wavelengths, ray_aiming=ray_aiming)
    unaimed = (~rays.valid).sum(-1)
    counts = {name: [] for name in _WORDS}
    for crossing in steps(lens.surfaces[1:], rays, indices=media(lens, wavelengths[:, None])):
        fates = {
            "missed": rays.valid & crossing.missed,
            "totally_reflected": rays.valid & crossing.totally_reflected,
            "vignetted": crossing.clipped,
        }
        for name, fate in fates.items():
            counts[name].append(fate.expand(rays.shape).sum(-1))
        rays = crossing.rays
    found = {name: torch.stack(count) for name, count in counts.items()}
    return Losses(**found, unaimed=unaimed, launched=pupil.shape[-1])


def beam_hint(lens: Lens) -> str:
    """What to do about a beam that grows with the object distance, "" where the aperture is no cone at the object."""
    if lens.aperture.kind not in ("object_na", "object_cone_angle"):
        return ""
    number = float(lens.aperture.value)
    what = f"object NA of {number:g}" if lens.aperture.kind == "object_na" else f"object cone of ±{number:g} degrees"
    distance, diameter = float(lens.surfaces[0].thickness), float(first_order(lens).entrance_pupil_diameter)
    return (
        f"the aperture is an {what}, whose entrance pupil is {diameter:.4g} mm wide for an object at {distance:g} mm; "
        "an F-number, an entrance pupil diameter or another aperture that the lens keeps would hold its beam"
    )

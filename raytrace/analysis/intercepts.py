"""Intercepts: where and at which angles named rays of each field meet every surface, and the largest of these."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.incidence import field_directions, in_axes_of
from raytrace.analysis.panels import chart, finished
from raytrace.analysis.result import Analysis
from raytrace.analysis.setting import Numbers, Points, primary_wavelength, setting
from raytrace.maths.numerics import dot_2, safe_sqrt, value
from raytrace.maths.result import Column, Table, masked, plain
from raytrace.plotting.style import GREY, Figure, array, field_colour, styled
from raytrace.system.intersection import normal
from raytrace.system.lens import Lens
from raytrace.system.surface import gap_behind
from raytrace.tracing.launch import launch
from raytrace.tracing.trace import lens_steps
from raytrace.words import did_you_mean, option

#: Named rays: pupil coordinates along the direction of the field and, looking along it, to its right.
RAYS = {"chief": (0.0, 0.0), "upper": (1.0, 0.0), "lower": (-1.0, 0.0), "right": (0.0, 1.0), "left": (0.0, -1.0)}


@value
class Intercepts(Analysis):
    """Rays (F, W, R, K) at surfaces 1 … K, the last of them the sensor, each in the axes of its surface.

    position: (3, F, W, R, K) mm; direction: (3, F, W, R, K) cosines behind the surface; incidence, refraction: degrees
        (F, W, R, K) between the normal and the ray in front of and behind the surface (of a mirror the reflected one).
        0 where `valid` is False.
    valid: (F, W, R, K) bool, whether they get there; a chief ray that is only vignetted does.
    rays: R names of RAYS; fields: (2, F); each: whether the text lists every ray, not only the largest numbers.
    """

    lens: Lens
    fields: Tensor
    position: Tensor
    direction: Tensor
    incidence: Tensor
    refraction: Tensor
    valid: Tensor
    rays: tuple[str, ...]
    each: bool = False

    COMMAND = "intercepts"
    COLUMNS = (
        Column("surface", "", ".0f"), *(Column(name, "mm", ".6f") for name in ("x", "y", "z", "height")),
        *(Column(name, "", ".8f") for name in "lmn"),
        *(Column(name, "°", ".4f") for name in ("incidence", "refraction")),
    )  # fmt: skip

    def words(self) -> dict[str, Sequence[str]]:
        return {"ray": self.rays}

    def columns(self) -> dict[str, Tensor]:
        ray = torch.arange(len(self.rays), device=self.incidence.device)
        numbers = torch.arange(1, self.incidence.shape[-1] + 1, device=self.incidence.device)
        vectors = zip("xyzlmn", (*self.position, *self.direction), strict=True)
        return {
            **self.heads(wavelength=self.wavelengths, ray=ray, surface=numbers),
            **{name: masked(part, self.valid) for name, part in vectors},
            "incidence": masked(self.incidence, self.valid),
            "refraction": masked(self.refraction, self.valid),
        }

    def summary(self) -> dict[str, Tensor]:
        """A row for every surface: the largest height and angles of all fields, wavelengths and rays, and the field."""
        table = {"surface": torch.arange(1, self.incidence.shape[-1] + 1, device=self.incidence.device)}
        for name, (largest, place) in self._largest().items():
            f = place.clamp_min(0) // (len(self.rays) * len(self.wavelengths))
            table[name] = masked(largest, place >= 0)
            for across, fields in zip("xy", self.fields, strict=True):
                if across == "y" or bool((fields != 0).any()):
                    table[f"{name}_field_{across}"] = masked(fields[f], place >= 0)
        return table

    def _largest(self) -> dict[str, tuple[Tensor, Tensor]]:
        """The largest numbers (K,) at every surface, and their places among fields, wavelengths and rays; -1: none."""
        each = {"height": safe_sqrt(dot_2(self.position, self.position)), "incidence": self.incidence}
        each["refraction"] = self.refraction
        maxima = {name: torch.where(self.valid, values, -1.0).flatten(0, 2).max(0) for name, values in each.items()}
        return {name: (largest, torch.where(largest < 0, -1, place)) for name, (largest, place) in maxima.items()}

    def _rays_of_largest(self) -> dict[str, list[str]]:
        """Names of the rays of the largest numbers, by the name of their column."""
        return {
            f"{name}_ray": [self.rays[int(place) % len(self.rays)] if place >= 0 else "-" for place in places]
            for name, (_, places) in self._largest().items()
        }

    def column(self, name: str) -> Column:
        rest = name.partition("_")[2]
        if rest in ("field_x", "field_y"):
            return Column(name, self.lens.fields.unit, ".6g", f"at\n{rest}")
        if rest == "ray":
            return Column(name, "", "<", "of\nray")
        return Analysis.column(self, name)

    def document(self) -> dict:
        document = Analysis.document(self)
        for row in document["results"]:
            row["ray"] = self.rays[int(row["ray"])]
        for name, rays in self._rays_of_largest().items():
            for row, ray in zip(document["summary"], rays, strict=True):
                row[name] = ray
        return plain(document)

    def tables(self) -> list[Table]:
        rays = self._rays_of_largest()
        columns: dict[str, Tensor | Sequence[str]] = {}
        for name, values in self.summary().items():
            columns[name] = values
            quantity, _, rest = name.partition("_")
            if rest == "field_y":
                columns[f"{quantity}_ray"] = rays[f"{quantity}_ray"]
        wavelengths = ", ".join(f"{wavelength:g}" for wavelength in self.wavelengths.tolist())
        largest = Table(columns, title=[f"largest numbers of all fields and rays, at {wavelengths} µm", ""])
        return [largest, Table(self.columns(), title=["", "each ray", ""])] if self.each else [largest]

    @styled
    def draw(self) -> Figure:
        """The largest angles of incidence and refraction at every surface."""
        panel = chart(6.2, 3.6, "surface", "largest angle to the normal (°)")
        table = {name: array(values) for name, values in self.summary().items()}
        k = table["surface"]
        panel.bar(k - 0.2, np.nan_to_num(table["incidence"]), 0.4, color=field_colour(0), label="incidence")
        panel.bar(k + 0.2, np.nan_to_num(table["refraction"]), 0.4, color=field_colour(2), label="refraction")
        panel.axhline(0, color=GREY, linewidth=0.6)
        panel.set_xticks([*map(int, k)])
        return finished(panel, self, "angles of incidence and refraction", 2)


def intercepts(
    lens: Lens,
    *,
    fields: Points = None,
    wavelengths: Numbers = None,
    rays: Sequence[str] | str = "",
    each: bool = False,
) -> Intercepts:
    """Where named rays of each field meet every surface: point, direction cosines, angles of incidence and refraction.

    fields: y or (x, y), by default the lens's own; wavelengths: µm, by default the primary one; rays: "chief", and on
    the rim of the beam "upper" and "lower" along the direction of the field, "right" and "left" across it, +y for the
    axis; all of them by default; each: list every ray in the text. The text has the largest height and angles at each
    surface. Vignetting factors and ray aiming apply; a coordinate break has no angles. Numbers have derivatives. Raises
    ValueError for an unknown ray.
    """
    names = tuple(rays.split() if isinstance(rays, str) else rays) or tuple(RAYS)
    for name in names:
        if name not in RAYS:
            raise ValueError(f"{option('rays', name)}{did_you_mean(name, RAYS)}: expected {', '.join(RAYS)}")
    lens, fields = setting(lens, fields, primary_wavelength(lens) if wavelengths is None else wavelengths)
    along = field_directions(lens, fields)[:, :, None, None]  # (2, F, 1, 1), against (F, W, R)
    across = torch.stack([along[1], -along[0]])
    up, right = fields.new_tensor([RAYS[name] for name in names]).T
    beams = launch(lens, along * up + across * right, fields=fields)
    points, directions, angles, arrive, reached, gap = [], [], [], [], beams.valid, None
    is_chief = torch.tensor([name == "chief" for name in names], device=fields.device)
    before = beams.direction
    for surface, crossing in zip(lens.surfaces[1:], lens_steps(lens, beams, lens.wavelengths[:, None]), strict=True):
        behind = crossing.rays
        reached = reached & ~(crossing.missed | crossing.totally_reflected)
        met = reached & (behind.valid | is_chief)
        incoming = in_axes_of(surface, gap, before)
        n = torch.stack(torch.broadcast_tensors(*normal(surface, behind.position.unbind(0))[0]))
        points.append(behind.position)
        directions.append(behind.direction)
        angles.append(torch.stack([_angle(n, incoming), _angle(n, behind.direction)]))
        arrive.append(torch.zeros_like(met) if surface.is_break else met)
        before, gap = behind.direction, gap_behind(surface)
    valid = torch.stack(arrive, -1)
    position, direction, angle = (
        torch.where(valid, torch.stack([part.expand(len(part), *valid.shape[:-1]) for part in parts], -1), 0.0)
        for parts in (points, directions, angles)
    )
    return Intercepts(lens, fields, position, direction, angle[0], angle[1], valid, names, each)


def _angle(n: Tensor, d: Tensor) -> Tensor:
    """Degrees between lines along unit vectors (3, ...), by atan2(|n × d|, |n·d|)."""
    across = torch.linalg.cross(*torch.broadcast_tensors(n, d), dim=0)
    return torch.rad2deg(torch.atan2(safe_sqrt((across * across).sum(0)), (n * d).sum(0).abs()))

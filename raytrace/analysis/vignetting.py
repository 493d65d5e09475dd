"""Vignetting: the share of the entrance pupil whose light reaches the sensor, and the share that each surface cuts."""

import dataclasses
from typing import Any

import numpy as np
import torch
from torch import Tensor

from raytrace.analysis.panels import chart, field_axis, field_name, finished
from raytrace.analysis.result import OverField
from raytrace.analysis.setting import (
    Numbers,
    Points,
    field_line,
    like,
    refuse_axis,
    scene_of,
    setting,
    unvignetted,
    wavelength_shares,
)
from raytrace.maths.numerics import value
from raytrace.maths.result import Column, Table
from raytrace.maths.sampling import gauss_rings, with_rim
from raytrace.plotting.style import FAINT, GREY, INK, Figure, array, field_colours, styled
from raytrace.system.apertures import Aperture
from raytrace.system.lens import Lens
from raytrace.tracing.clear_pupil import arms_of
from raytrace.tracing.geometry import semi_diameters
from raytrace.tracing.launch import launch
from raytrace.tracing.ray_failures import LOST, STATUS, ray_status
from raytrace.tracing.scene import Scene, beam_share
from raytrace.tracing.trace import aiming_of

_RINGS, _RIM = (16, 64), 128  # of the rays that look for surfaces at which light ends
_RIM_SHARE = 1e-9  # of the rays at the rim, which mark a surface that clips the rim alone; how far inside they are
_ARMS = 96  # of the pupil, up to the edges of apertures
_WORDS = {"vignetted": "aperture", "miss": "missed", "tir": "total\nreflection"}
_GRAZING = 1e-9  # of a semi-diameter, by which the ray that defines it passes
_COARSER = 4  # fields of a drawn line: each takes a search for the edges of its pupil
_WHOLE = 1e-9  # of the pupil: a smaller loss is rounding


@value
class Vignetting(OverField):
    """Shares of the entrance pupil, wavelengths by their weights; passed, of the factors, and cut add up to 1.

    passed: (F,) whose rays reach the sensor; cut: (F, K) whose rays end at the surfaces `surfaces`, K numbers.
    of_factors: (F,) that the vignetting factors of the lens leave out; unaimed: (F,) that ray aiming does not reach.
    reasons: K words of LOST, why most rays end there; fields: (2, F); sampled: whether rays were counted, to 1 %.
    """

    lens: Lens
    fields: Tensor
    passed: Tensor
    cut: Tensor
    of_factors: Tensor
    unaimed: Tensor
    surfaces: tuple[int, ...]
    reasons: tuple[str, ...]
    sampled: bool = False

    COMMAND = "vignetting"

    def columns(self) -> dict[str, Tensor]:
        cuts = {f"surface_{k}_percent": cut for k, cut in zip(self.surfaces, self.cut.unbind(-1), strict=True)}
        others = {"factors_percent": self.of_factors, "unaimed_percent": self.unaimed}
        shares = {"passed_percent": self.passed, **cuts}
        shares |= {name: share for name, share in others.items() if bool((share > _WHOLE).any())}
        return {**self.heads(), **{name: 100 * share for name, share in shares.items()}}

    def column(self, name: str) -> Column:
        headings = {"passed_percent": "passed", "factors_percent": "vignetting\nfactors", "unaimed_percent": "unaimed"}
        for k, reason in zip(self.surfaces, self.reasons, strict=True):
            headings[f"surface_{k}_percent"] = f"surface {k},\n{_WORDS[reason].split()[-1]}"
        return Column(name, "%", ".3f", headings[name]) if name in headings else OverField.column(self, name)

    def about(self) -> dict[str, Any]:
        return {"surfaces": [{"surface": k, "reason": r} for k, r in zip(self.surfaces, self.reasons, strict=True)]}

    def tables(self) -> list[Table]:
        clipping = any(surface.apertures for surface in self.lens.surfaces)
        note = "no surface has an aperture, and semi-diameters clip no ray; with rims they do"
        return [Table(self.columns(), notes=[] if clipping else [note])]

    def at(self, fields: Tensor) -> "Vignetting":
        return _vignetting(self.lens, fields, sampled=self.sampled)

    def drawn(self) -> "Vignetting":
        refuse_axis(self.fields)
        line = field_line(self.fields)
        return self if line is self.fields else self.at(line[:, ::_COARSER])

    @styled
    def draw(self) -> Figure:
        """The share that passes over the field, and above it those that surfaces and factors cut."""
        curves = self.drawn()
        panel = chart(6.4, 3.8, field_name(curves.lens), "share of the entrance pupil (%)")
        order = np.argsort(field_axis(curves), kind="stable")
        field, passed = field_axis(curves)[order], 100 * array(curves.passed)[order]
        parts = {f"cut by surface {k}": 100 * array(curves.cut[:, i]) for i, k in enumerate(curves.surfaces)}
        parts |= {"cut by vignetting factors": 100 * array(curves.of_factors), "not aimed": 100 * array(curves.unaimed)}
        parts = {name: part[order] for name, part in parts.items() if part.max() > 100 * _WHOLE}
        colours = [*field_colours(max(len(parts), 1)), GREY]
        if parts:
            panel.stackplot(
                field, passed, *parts.values(), labels=["_", *parts], colors=["white", *colours], alpha=0.55
            )
        panel.fill_between(field, 0, passed, color=FAINT, alpha=0.35, linewidth=0)
        panel.plot(field, passed, color=INK, linewidth=1.6, label="reaches the sensor", clip_on=False, zorder=4)
        panel.set(xlim=(0, field.max() or 1.0), ylim=(0, 100))
        return finished(panel, curves, "vignetting", 3)


def vignetting(
    lens: Lens, *, fields: Points = None, wavelengths: Numbers = None, samples: int = 11, rims: bool = False
) -> Vignetting:
    """The share of the entrance pupil whose light reaches the sensor over the field, and the share cut by each surface.

        1 = passed + factors + unaimed + Σ_k cut_k,   cut_k = (A_{k-1} - A_k) s

    A_k is the area of the pupil whose rays pass the surfaces 1 to k, up to the edges of their apertures, and s the area
    that vignetting factors leave: a ray is counted at the first surface where it ends. Areas are those of the pupil
    in which rays are launched, the stop with ray aiming. fields: y or (x, y); by default `samples` from the axis to the
    lens's largest; wavelengths: µm. Semi-diameters clip no ray, only apertures do; rims: with `with_rims`, the
    semi-diameters as apertures instead of the vignetting factors, of aimed rays by counting 1024 rays (to 1 %). Else
    shares have derivatives by the numbers of the lens, to the motion of the edges (`tracing.clear_pupil`).
    """
    lens, fields = setting(with_rims(lens) if rims else lens, fields, wavelengths, samples=samples)
    return _vignetting(lens, fields, sampled=rims and aiming_of(lens) != "off")


def _vignetting(lens: Lens, fields: Tensor, *, sampled: bool = False) -> Vignetting:
    scene, weights = scene_of(lens, fields), wavelength_shares(lens)
    factors = beam_share(scene)[0, :, 0].expand(fields.shape[1])
    ended, kinds = _ended(lens, fields)  # (F, W, K + 1)
    surfaces = tuple(ended[..., 1:].sum((0, 1)).nonzero()[:, 0].add(1).tolist())
    if sampled:
        areas = 1 - ended.cumsum(-1)[..., [0, *surfaces]]
    else:
        whole = ended.new_ones(ended.shape[:2])
        launched = clear_share(scene, 0)[0] if bool(ended[..., 0].any()) else whole
        areas = torch.stack([launched, *(clear_share(scene, k)[0] for k in surfaces)], -1)
    areas = factors[:, None] * (areas * weights[:, None]).sum(1)
    return Vignetting(
        lens=lens,
        fields=fields,
        passed=areas[:, -1],
        cut=areas[:, :-1] - areas[:, 1:],
        of_factors=1 - factors,
        unaimed=factors - areas[:, 0],
        surfaces=surfaces,
        reasons=tuple(LOST[kinds[k - 1]] for k in surfaces),
        sampled=sampled,
    )


@torch.no_grad()
def _ended(lens: Lens, fields: Tensor) -> tuple[Tensor, list[int]]:
    """Shares (F, W, K + 1) of the rays of a fixed sampling that are not aimed, and that end at surfaces 1 to K; and why
    most of them end there, K numbers of LOST."""
    points, shares = with_rim(*gauss_rings(*_RINGS, **like(lens)), _RIM)
    shares = (shares + _RIM_SHARE / _RIM * (shares == 0)) / (1 + _RIM_SHARE)
    rays = launch(lens, points * (1 - _RIM_SHARE), fields=fields)
    codes = [STATUS.index(name) for name in LOST]
    by_kind = torch.stack(
        [
            torch.stack([torch.where(status == code, shares, 0.0).sum(-1) for code in codes])
            for _, status in ray_status(lens, rays, lens.wavelengths[:, None])
        ],
        -1,
    )  # (3, F, W, K), of all surfaces so far
    by_kind = by_kind.diff(dim=-1, prepend=torch.zeros_like(by_kind[..., :1]))
    unaimed = torch.where(rays.valid, 0.0, shares).sum(-1)
    return torch.cat([unaimed[..., None], by_kind.sum(0)], -1), by_kind.sum((1, 2)).argmax(0).tolist()


def with_rims(lens: Lens) -> Lens:
    """The lens with its clear semi-diameters, as `rt.info` prints them, as circular apertures; no vignetting factors.

    A surface that has an aperture keeps it, and the image gets none.
    """
    surfaces = list(lens.surfaces)
    for k, size in enumerate(semi_diameters(lens)[:-1]):
        has_rim = any(not aperture.obscures for aperture in surfaces[k].apertures)
        if k and size > 0 and not has_rim and not surfaces[k].is_break:
            rim = Aperture("circular", (0.0, size * (1 + _GRAZING)))
            surfaces[k] = dataclasses.replace(surfaces[k], apertures=(*surfaces[k].apertures, rim))
    return unvignetted(dataclasses.replace(lens, surfaces=tuple(surfaces)))


def clear_share(scene: Scene, last: int | None = None) -> Tensor:
    """Area (D, F, W) of the pupil whose rays pass the surfaces 1 to `last`, relative to the beam that is launched."""
    return arms_of(dataclasses.replace(scene, last=last), _ARMS).area()

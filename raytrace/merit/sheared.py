"""Beams whose modulation of diffraction is asked for: their rays, and the MTF of all of them with its derivatives."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from raytrace.analysis.shear import Fit, layout_of, otf
from raytrace.maths.dual import Dual, slope_of, value_of
from raytrace.merit.path import directions_to, image_index, path_to, sphere_of
from raytrace.merit.plan import Now, Planner
from raytrace.optics.axis import is_bent

_MISSED = 0.02  # waves of RMS that the polynomials of a wave may leave
_NOTHING = 1e-30  # in the square of a modulation, whose root has a slope there
_RULES = (12, 16, 20, 28, 40, 56, 80, 112, 160)  # points along and across


class Section(NamedTuple):
    """A frequency in cycles/mm of patterns that vary along x (0) or y (1)."""

    frequency: float
    axis: int


class Pupil:
    """The rays of one field (2,) at some wavelengths and their shares.

    Of a field on the y axis of a lens of revolution the right half of the pupil tells the wave, of the axis one arm.
    """

    def __init__(self, planner: Planner, number: int, colours: dict[int, float], degree: int):
        """number: of the field, from 0."""
        fields = planner.lens.fields
        largest = float(torch.hypot(fields.x, fields.y).max()) or 1.0
        self.field = float(fields.x[number]) / largest, float(fields.y[number]) / largest
        self.colours = np.array(list(colours))
        self.shares = np.array(list(colours.values())) / sum(colours.values())
        mirrored, is_round = _symmetry(planner, number)
        self.layout = layout_of(degree, half=mirrored)
        radius = np.round(np.hypot(*self.layout.points), 14)
        points = np.stack([0 * radius, radius]) if is_round else self.layout.points
        self.turn = self.layout.points / radius if is_round else None
        asked = [[planner.ask(w, self.field, p, clips=True) for p in points.T.tolist()] for w in colours]
        self.rays = np.array(asked)
        self.chiefs = np.array([planner.ask(w, self.field, (0.0, 0.0), clips=True) for w in colours])

    @property
    def kind(self) -> tuple:
        """What beams have in common that are evaluated together."""
        return self.layout.degree, self.layout.half, len(self.colours)

    def turned(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Components (..., R) of directions, from those of the arm where one tells all."""
        return (x, y) if self.turn is None else (self.turn[0] * y, self.turn[1] * y)


def _symmetry(planner: Planner, number: int) -> tuple[bool, bool]:
    """Whether the beam of a field is mirrored in the y axis, and whether it is round."""
    fields = planner.lens.fields
    if not planner.view.is_symmetric or float(fields.x[number]) != 0:
        return False, False
    factors = [0.0] * 5 if fields.vignetting is None else fields.vignetting[:, number].tolist()
    vdx, vdy, vcx, vcy, angle = factors
    mirrored = vdx == 0 and angle == 0
    return mirrored, mirrored and float(fields.y[number]) == 0 and vdy == 0 and vcx == vcy


class Sent(NamedTuple):
    """The waves of beams: `wave` (B, R) in waves, `directions` s (2, B, R) in 1/mm, `places` (2, B) mm of chief rays on
    the image, each with its slopes behind an axis of variables, or None; blur: mm; valid: (B, R)."""

    wave: tuple[np.ndarray, np.ndarray]
    directions: tuple[np.ndarray, np.ndarray]
    places: tuple[np.ndarray, np.ndarray]
    blur: np.ndarray
    valid: np.ndarray


def sent(now: Now, beams: Sequence[Pupil]) -> Sent:
    """The waves of beams of one kind, those of one beam after those of another."""
    rays, chiefs, colours = (
        np.concatenate([getattr(beam, name) for beam in beams]) for name in ("rays", "chiefs", "colours")
    )
    shape, each, count = rays.shape, np.repeat(np.arange(len(rays)), rays.shape[1]), now.moment.count
    hits, chief = now.hits(rays.ravel(), clips=True), now.hits(chiefs, clips=True)
    sphere, index = sphere_of(now, chief, is_bent(now.planner.lens)), image_index(now, colours)
    per_wave = 1e3 / np.array(now.planner.view.wavelengths)[colours]
    path = path_to(sphere.at(each), hits, index[each]) - path_to(sphere, chief, index)[each]
    scale = (index * per_wave)[each]
    found = [path * per_wave[each], *(scale * part for part in directions_to(sphere.at(each), hits)[:2])]
    values = [value_of(part).reshape(shape) for part in found]
    slopes = [slope_of(part, count).reshape(count, *shape) for part in found]
    offset = [np.abs(value_of(hits.position[k]) - value_of(chief.position[k])[each]).reshape(shape) for k in range(2)]
    places = [chief.position[k] for k in range(2)]
    return Sent(
        (values[0], slopes[0]),
        (_turned(beams, *values[1:]), _turned(beams, *slopes[1:])),
        (np.stack([value_of(part) for part in places]), np.stack([slope_of(part, count) for part in places], 1)),
        np.maximum(*offset).max(-1),
        hits.valid.reshape(shape) & chief.valid[:, None],
    )


def _turned(beams: Sequence[Pupil], x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Components (..., B, R) of all rays, one before the other: (2, ..., B, R)."""
    size = len(beams[0].colours)
    places = [(..., slice(k * size, (k + 1) * size), slice(None)) for k in range(len(beams))]
    return np.concatenate([np.stack(beam.turned(x[at], y[at])) for beam, at in zip(beams, places, strict=True)], -2)


def modulations(now: Now, beams: Sequence[Pupil], sections: Sequence[Section]) -> tuple[Dual | np.ndarray, np.ndarray]:
    """MTF (F, Q) of beams of one kind in sections, and for which of them (F,) their rays tell it."""
    light, colours = sent(now, beams), len(beams[0].colours)
    told = light.valid.all(-1).reshape(-1, colours).all(-1)
    values, slopes = (
        np.full((len(beams), len(sections)), np.nan),
        np.zeros((now.moment.count, len(beams), len(sections))),
    )
    rule = _rule(light.blur.reshape(-1, colours).max(-1), sections)
    told &= rule > 0
    for chosen in [np.flatnonzero(told)] if told.any() else []:
        some = _picked(light, (chosen[:, None] * colours + np.arange(colours)).ravel())
        fit = Fit(beams[0].layout, some.wave[0], some.directions[0])
        shares = np.stack([beams[k].shares for k in chosen])
        found = _modulated(fit, some, sections, shares, int(rule[chosen].max()), now.moment.count)
        values[chosen], slopes[:, chosen] = found
        told[chosen] &= (fit.missed.reshape(-1, colours) < _MISSED).all(-1)
    return (Dual(values, slopes) if now.moment.count else values), told


def _picked(light: Sent, rows: np.ndarray) -> Sent:
    wave, directions = ([part[..., rows, :] for part in pair] for pair in (light.wave, light.directions))
    places = [part[..., rows] for part in light.places]
    return Sent(tuple(wave), tuple(directions), tuple(places), light.blur[rows], light.valid[rows])


def _rule(blur: np.ndarray, sections: Sequence[Section]) -> np.ndarray:
    """Points (F,) of a rule that a phase of 2π ν blur to either side asks for; 0 where that is too many."""
    needed = 10 + 4.0 * blur * max(section.frequency for section in sections)
    return np.array([next((n for n in _RULES if n >= least), 0) for least in needed])


def _modulated(fit: Fit, light: Sent, sections: Sequence[Section], shares: np.ndarray, points: int, count: int):
    """MTF (F, Q), and its slopes (n, F, Q)."""
    fields, colours = shares.shape
    axes = np.array([section.axis for section in sections])
    frequencies = np.array([section.frequency for section in sections])
    along_y = torch.from_numpy(axes == 1)[:, None, None, None]
    with torch.set_grad_enabled(count > 0):
        polynomials = torch.from_numpy(fit.polynomials)[:, None].repeat(1, len(sections), 1, 1, 1)
        places = torch.from_numpy(light.places[0])[axes]
        polynomials.requires_grad_(count > 0), places.requires_grad_(count > 0)
        shear = torch.from_numpy(frequencies[:, None] / fit.scale[axes])
        parts = otf(torch.where(along_y, polynomials, polynomials.mT), shear, points)
        turn = -2 * np.pi * torch.from_numpy(frequencies)[:, None] * places
        parts = (parts * torch.exp(1j * turn)).unflatten(-1, (fields, colours))
        total = (torch.from_numpy(shares) * parts).sum(-1)
        found = torch.sqrt(total.real**2 + total.imag**2 + _NOTHING)
    values = found.detach().numpy().T
    if not count:
        return values, np.zeros((0, *values.shape))
    by_fit, by_place = (part.numpy() for part in torch.autograd.grad(found.sum(), (polynomials, places)))
    by_wave, by_directions = fit.by_rays(by_fit)
    slopes = _gathered(by_wave, light.wave[1], fields)
    for k in range(2):
        slopes = slopes + _gathered(by_directions[k], light.directions[1][k], fields)
    moved = (by_place * light.places[1][:, axes]).reshape(count, len(sections), fields, colours).sum(-1)
    return values, slopes + moved.swapaxes(1, 2)


def _gathered(by: np.ndarray, slopes: np.ndarray, fields: int) -> np.ndarray:
    """Σ over the rays and colours of a field: from (Q, B, R) and (n, B, R) to (n, F, Q)."""
    one = by.reshape(len(by), fields, -1).transpose(1, 2, 0)
    return (slopes.reshape(len(slopes), fields, -1).transpose(1, 0, 2) @ one).swapaxes(0, 1)

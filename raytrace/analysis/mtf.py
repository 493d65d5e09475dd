"""Modulation transfer: of diffraction, by autocorrelation of the traced wave; of rays, by quadrature."""

import contextlib
import dataclasses
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from scipy.interpolate import CubicSpline
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.analysis.panels import by_field, chart, finished, mark_fields
from raytrace.analysis.pupil_autocorrelation import (
    MARGIN,
    ExitPupil,
    beam_of,
    exit_pupil,
    otf,
    points_needed,
    polynomials_of,
)
from raytrace.analysis.result import Analysis, fine
from raytrace.analysis.setting import (
    NothingToShow,
    Numbers,
    Points,
    field_words,
    like,
    primary_wavelength,
    refuse_dark,
    scene_of,
    setting,
    wavelength_shares,
)
from raytrace.budget import RAY_BYTES, piece
from raytrace.maths.numerics import safe_divide, safe_sqrt, value, varies
from raytrace.maths.result import Table, axis
from raytrace.maths.sampling import gauss_rings
from raytrace.plotting.style import GREY, Figure, array, number_text, styled
from raytrace.psf_models.dft import TooManyPoints, phasor, rings_and_arms
from raytrace.system.lens import Lens, aligned, vector, with_sensor_distance
from raytrace.system.rays import Rays
from raytrace.tracing.clear_pupil import clear_pupil
from raytrace.tracing.f_number import axial_f_number, working_f_number
from raytrace.tracing.scene import Memo, Scene
from raytrace.tracing.spot import image_rays, spot_of
from raytrace.words import option

_SMOOTH = 241  # sensor distances of a smooth curve
_LEAST_RINGS, _MOST_RAYS = 24, 100_000
_PROBE_ARMS = 24  # of as many rings, where all rays of all fields are too many at once
_MARGIN = 3  # orders of `rings_and_arms`, by which aberrations of high order are integrated to 1e-5
_LEAST_PHASE = 70.0  # radians along a pupil radius that the former integrate, see `rings_and_arms`
_FREQUENCIES, _DISTANCES = 41, 21  # default numbers of them
_BUNDLES = 16  # stored of a field: its probe and the fits of its wave
_SECONDS = 1.5  # of the trace of a field, from where the transfer of rays is tried first
_NO_MATTER = 1e-3  # of modulation: the change by diffraction up to which the transfer of rays is given
_LEAST_GRID = 128  # points across the pupil of a limit where rays give the modulation
_FINE_GRID = 512  # points across the pupil, from where a quadrature of the sheared pupil is tried
_RULES = (16, 20, 28, 40, 56, 80, 112, 160, 224)  # its points along and across


@value
class Mtf(Analysis):
    """Modulation of all wavelengths together, by field and spatial frequency.

    tangential, sagittal: (F, K), of patterns that vary along y and along x.
    limit: (2, F, K) tangential and sagittal, of the same light from the same clear pupils without aberrations, which no
        modulation exceeds; None for rays alone.
    frequencies: (K,) cycles/mm on the sensor; fields: (2, F); geometric: all fields by rays, without diffraction.
    by_rays: (F,) bool, fields by rays, without diffraction.
    marked: whether the frequencies were specified, and are marked on the curves.
    """

    lens: Lens
    fields: Tensor
    frequencies: Tensor
    tangential: Tensor
    sagittal: Tensor
    limit: Tensor | None
    geometric: bool
    by_rays: Tensor
    marked: bool = False

    COMMAND = "mtf"
    EVERY = 5

    def columns(self) -> dict[str, Tensor]:
        heads = self.heads(frequency=self.frequencies)
        table = {**heads, "tangential": self.tangential, "sagittal": self.sagittal}
        return (
            table
            if self.limit is None
            else {**table, "tangential_limit": self.limit[0], "sagittal_limit": self.limit[1]}
        )

    def about(self) -> dict:
        return {"transfer": transfer(self)}

    def drawn(self) -> "Mtf":
        return _mtf(self.lens, self.fields, fine(self.frequencies), self.by_rays)

    def tables(self) -> list[Table]:
        return _tables(self)

    @styled
    def draw(self) -> Figure:
        """Modulation over spatial frequency: tangential solid, sagittal dashed, the highest diffraction limit grey."""
        curves = self.drawn()
        panel = chart(6.4, 4.0, "spatial frequency (cycles/mm)", "modulation")
        frequency = array(curves.frequencies)
        by_field(panel, curves, frequency, tangential=array(curves.tangential), sagittal=array(curves.sagittal))
        if self.marked:
            mark_fields(panel, array(self.frequencies), array(self.tangential), array(self.sagittal))
        if curves.limit is not None:
            limit = array(curves.limit.amax((0, 1)))
            panel.plot(frequency, limit, color=GREY, linewidth=1.0, linestyle=":", label="diffraction limit")
        panel.set(xlim=(0, frequency.max()), ylim=(0, 1.0))
        return finished(panel, curves, f"{transfer(curves)} MTF", 6)


@value
class ThroughFocusMtf(Analysis):
    """Modulation at one frequency over sensor distances: tangential, sagittal (S, F); sensor_distances: (S,) mm.

    frequency: (1,) cycles/mm; fields: (2, F); geometric: all by rays, without diffraction; by_rays: (S, F) bool.
    """

    lens: Lens
    fields: Tensor
    frequency: Tensor
    sensor_distances: Tensor
    tangential: Tensor
    sagittal: Tensor
    geometric: bool
    by_rays: Tensor

    COMMAND = "mtf"

    def about(self) -> dict:
        return {"transfer": transfer(self)}

    def tables(self) -> list[Table]:
        return _tables(self)

    def columns(self) -> dict[str, Tensor]:
        return {
            "field_x": axis(self.fields[0], 1, 2),
            "field_y": axis(self.fields[1], 1, 2),
            "sensor_distance": axis(self.sensor_distances, 0, 2),
            "frequency": axis(self.frequency, 0, 2),
            "tangential": self.tangential,
            "sagittal": self.sagittal,
        }

    @styled
    def draw(self) -> Figure:
        """Modulation at one frequency over the sensor distance, a smooth curve through the places computed."""
        modulation = f"modulation at {number_text(float(self.frequency), 4)} cycles/mm"
        panel = chart(6.4, 4.0, "sensor distance (mm)", modulation)
        distance = array(self.sensor_distances)
        fine = np.linspace(distance.min(), distance.max(), _SMOOTH)
        curves = {"tangential": self.tangential, "sagittal": self.sagittal}
        smooth = {name: CubicSpline(distance, array(curve))(fine).T.clip(0, 1) for name, curve in curves.items()}
        by_field(panel, self, fine, **smooth)
        panel.axvline(float(self.lens.surfaces[-2].thickness), color=GREY, linewidth=0.8)
        panel.set(xlim=(distance.min(), distance.max()), ylim=(0, 1.0))
        return finished(panel, self, f"{transfer(self)} MTF through focus", 6)


def mtf(
    lens: Lens,
    frequencies: Numbers = None,
    *,
    geometric: bool | None = None,
    through_focus: float | None = None,
    fields: Points = None,
    wavelengths: Numbers = None,
    progress: Callable | None = None,
) -> Mtf | ThroughFocusMtf:
    """MTF at frequencies (K,) cycles/mm, by default 41 of `frequency_range`; of diffraction, or geometric:

        OTF(ν) = ∬ A(L, M + λν) A*(L, M) dL dM / ∬ |A|²              diffraction
        OTF(ν) = Σ_j w_j exp(-2πi ν y_j),  y_j where ray j lands      geometric

    geometric: of rays alone, or always of diffraction; by default of diffraction, except for a field that would need
    more than 1280 points across the pupil or a trace of more than 1.5 s, and whose modulation diffraction is predicted
    to change by at most 1e-3 at every frequency: that field is geometric, as `by_rays` reports. The wavelengths' OTFs
    add by weight and transmitted light, each at its own place on the sensor: lateral colour counts. frequencies:
    cycles/mm, by default 41 from 0 to the resolution of the sharpest field, at most half of the diffraction cutoff;
    through_focus: move the sensor by ± this, mm, at one frequency; progress, such as tqdm, is then called with (work,
    unit) and returns the iterable. fields: y or (x, y); wavelengths: µm. Raises ValueError where too few rays arrive or
    the blur is too large.
    """
    if lens.count is not None and not (geometric and through_focus is None and frequencies is not None):
        message = (
            f"a batch of lenses has the geometric MTF alone: give {option('frequencies')} and "
            f"{option('geometric', 'True')}"
        )
        raise ValueError(f"{message}, or call it for each lens")
    lens, fields = setting(aligned(lens, 3), fields, wavelengths, every=True)
    asked = None if frequencies is None else vector(frequencies, like=lens)
    choice = None if geometric is None else torch.full_like(fields[0], geometric, dtype=torch.bool)
    if through_focus is not None:
        if asked is None or len(asked) != 1:
            raise ValueError(f"{option('through_focus')} needs one spatial frequency: give {option('frequencies')}")
        distances = lens.surfaces[-2].thickness + through_focus * torch.linspace(-1, 1, _DISTANCES, **like(lens))
        return _through_focus(lens, fields, asked, distances, choice, progress)
    given = frequency_range(lens, fields, _FREQUENCIES) if asked is None else asked
    return _mtf(lens, fields, given, choice, marked=asked is not None)


def _mtf(lens: Lens, fields: Tensor, frequencies: Tensor, choice: Tensor | None, *, marked: bool = False) -> Mtf:
    """choice: (F,) bool, fields by rays; None: as `mtf` decides for each."""
    if choice is not None and bool(choice.all()):
        return geometric_mtf(lens, fields, frequencies, marked=marked)
    wanted: list[bool | None] = [None] * fields.shape[1] if choice is None else choice.tolist()
    rows = [_of_field(lens, *each, frequencies) for each in zip(fields.split(1, 1), wanted, strict=True)]
    tangential, sagittal = (torch.cat(parts) for parts in list(zip(*rows, strict=True))[:2])
    by_rays = torch.tensor([row[2] for row in rows], device=fields.device)
    whole = bool(by_rays.all())
    limit = None if whole else torch.stack([torch.cat(row[3]()) for row in rows], 1)
    return Mtf(lens, fields, frequencies, tangential, sagittal, limit, whole, by_rays, marked)


def modulations(lens: Lens, fields: Tensor, frequencies: Tensor) -> tuple[Tensor, Tensor]:
    """Tangential and sagittal MTF (F, K) of fields (2, F), as `mtf` has them, without the limit of diffraction."""
    rows = [_of_field(lens, field, None, frequencies)[:2] for field in fields.split(1, 1)]
    tangential, sagittal = (torch.cat(parts) for parts in zip(*rows, strict=True))
    return tangential, sagittal


def geometric_mtf(lens: Lens, fields: Tensor, frequencies: Tensor, *, marked: bool = False) -> Mtf:
    """The MTF of rays of fields (2, F), which have to reach the sensor. Raises EmptySpot, TooManyPoints."""
    by_rays = torch.ones_like(fields[0], dtype=torch.bool)
    return Mtf(lens, fields, frequencies, *_geometric(lens, fields, frequencies), None, True, by_rays, marked)


def _of_field(
    lens: Lens, field: Tensor, geometric: bool | None, frequencies: Tensor, memo: Memo | None = None
) -> tuple[Tensor, Tensor, bool, Callable[[], tuple[Tensor, Tensor]]]:
    """Tangential and sagittal MTF (1, K) of a field (2, 1), whether of rays, and the function that makes its limit.

    memo: of its beam at other sensors.
    """
    scene = dataclasses.replace(scene_of(lens, field), memo=memo or Memo(_BUNDLES))  # the beam is traced once
    shares = wavelength_shares(lens)

    def limit(pupil: ExitPupil | None = None) -> tuple[Tensor, Tensor]:
        pupil = exit_pupil(scene, size=_LEAST_GRID, fit=True) if pupil is None else pupil
        perfect = dataclasses.replace(pupil, amplitude=pupil.amplitude.abs() + 0j, centre=0 * pupil.centre)
        return _of_pupil(perfect, frequencies, shares)

    if geometric:
        return *_geometric(lens, field, frequencies), True, limit
    sheared = _sheared(scene, frequencies)
    if sheared is not None:
        return *sheared(), False, lambda: sheared(perfect=True)
    seconds = None if geometric is False else _SECONDS
    try:
        pupil = exit_pupil(scene, seconds=seconds, fit=True)
    except TooManyPoints:
        if geometric is False:
            raise
        both = _where_diffraction_is_no_matter(scene, frequencies)
        if both is not None:
            return *both, True, limit
        pupil = exit_pupil(scene, fit=True)
    return *_of_pupil(pupil, frequencies, shares), False, lambda: limit(pupil)


def _where_diffraction_is_no_matter(scene: Scene, frequencies: Tensor) -> tuple[Tensor, Tensor] | None:
    """MTF (1, K) of rays where diffraction changes it by less than 1e-3, else None; see `_change_by_diffraction`."""
    try:
        both = _geometric(scene.lens, scene.fields, frequencies)
        change = _change_by_diffraction(scene, frequencies, both)
    except TooManyPoints:
        return None
    return both if change <= _NO_MATTER else None


def _change_by_diffraction(scene: Scene, frequencies: Tensor, both: tuple[Tensor, Tensor]) -> float:
    """Largest |G(ν) - C G(ν - k ν (1 - C))| for k = 1/2 and 1, of the MTF G (1, K) of rays along both sections.

    Two pupils cover each other by a share C, that of a clear pupil, which a defocus sees as a blur narrower by about
    1 - C along the shear.
    """
    changes = []
    with torch.no_grad():
        highest = beam_of(scene).cutoffs.amin(-1).flip(0)
        for section, (geometric, top) in enumerate(zip(both, highest, strict=True)):
            share = clear_circle(frequencies / top)
            for k in (0.5, 1.0):
                narrowed = _geometric(scene.lens, scene.fields, frequencies * (1 - k * (1 - share)))[section]
                changes.append((geometric - share * narrowed).abs().max())
    return float(torch.stack(changes).max())


def _through_focus(
    lens: Lens, fields: Tensor, frequency: Tensor, distances: Tensor, choice: Tensor | None, progress: Callable | None
) -> ThroughFocusMtf:
    """The MTF at each sensor distance (S,). A beam is aimed and traced once: for the `Memo` of a field the sensor
    distance is a variable, so that rays are stored in front of the sensor."""
    wanted: list[bool | None] = [None] * fields.shape[1] if choice is None else choice.tolist()
    constant = not any(varies(number) for number in pytree.tree_leaves((lens, fields, frequency)))
    work = [(f, distance) for f in range(len(wanted)) for distance in distances]
    memo, last, rows = None, None, []
    with torch.no_grad() if constant else contextlib.nullcontext():
        for f, distance in work if progress is None else progress(work, "sensor distance"):
            memo, last = (memo if f == last else Memo(_BUNDLES)), f
            sensor = distance.detach().requires_grad_() if constant else distance
            moved = with_sensor_distance(lens, sensor)
            rows.append(_of_field(moved, fields[:, f : f + 1], wanted[f], frequency, memo))
    shape = len(wanted), len(distances)
    tangential, sagittal = (torch.cat(c)[:, 0].reshape(shape).T for c in list(zip(*rows, strict=True))[:2])
    by_rays = torch.tensor([row[2] for row in rows], device=fields.device).reshape(shape).T
    whole = bool(by_rays.all())
    return ThroughFocusMtf(lens, fields, frequency, distances, tangential, sagittal, whole, by_rays)


def transfer(curves: Mtf | ThroughFocusMtf) -> str:
    """The transfer of a result: "diffraction", "geometric", or both with the fields, as for a title."""
    some = curves.by_rays.any(0) if curves.by_rays.dim() == 2 else curves.by_rays
    if curves.geometric or not bool(some.any()):
        return "geometric" if curves.geometric else "diffraction"
    names = " and ".join(field_words(curves.lens, field) for field in curves.fields.T[some])
    return f"diffraction (geometric for {names})"


def _tables(curves: Mtf | ThroughFocusMtf) -> list[Table]:
    """The table, with a line on fields that are geometric by default."""
    table = curves.thinned(curves.columns(), curves.EVERY)
    note = [f"transfer: {transfer(curves)}"] if bool(curves.by_rays.any()) else []
    return [table._replace(notes=[*table.notes, *note])]


def frequency_range(lens: Lens, fields: Tensor, size: int) -> Tensor:
    """Frequencies (size,) cycles/mm from 0 to 2/σ, σ along a section of the spot of the sharpest field (2, F), and to
    half the cutoff of diffraction at the most; not differentiated. Raises NothingToShow where no cone of light ends on
    the sensor."""
    with torch.no_grad():
        points, weights = gauss_rings(6, **like(lens))
        rays = image_rays(lens, points, fields=fields)
        radius = spot_of(rays, weights).rms_radius
        sharpest = torch.where(rays.valid.any(-1), radius, torch.inf).amin() * 0.5**0.5
        top = torch.minimum(0.5 * cutoff(lens, primary_wavelength(lens)), 2 / sharpest)
    if not bool(top > 0):
        raise NothingToShow(f"nothing to show: the lens has no focus; give {option('frequencies')}, or focus the lens")
    return top * torch.linspace(0, 1, size, dtype=top.dtype, device=top.device)


def cutoff(lens: Lens, wavelength: Tensor) -> Tensor:
    """Highest frequency 1/(λ N) in cycles/mm that passes on the axis, N the working F/# of the real marginal ray, or of
    the paraxial one where it is lost."""
    real = working_f_number(lens)
    return 1e3 / (wavelength * torch.where(torch.isfinite(real), real, axial_f_number(lens)))


def mtf_on_grid(scene: Scene, frequencies: Tensor, shares: Tensor, **grid: Any) -> tuple[Tensor, Tensor]:
    """Tangential and sagittal MTF (1, K) of a field, on a grid of the pupil as fine as its blur needs.

    shares: (W,) of the wavelengths of the scene; grid: options of `exit_pupil`.
    """
    return _of_pupil(exit_pupil(scene, **grid), frequencies, shares)


def _of_pupil(pupil: ExitPupil, frequencies: Tensor, shares: Tensor) -> tuple[Tensor, Tensor]:
    shift, weights = pupil.centre - pupil.centre[..., :1], shares * pupil.light
    sections = zip((pupil.amplitude.mT, pupil.amplitude), pupil.step.flip(0), shift.flip(0), strict=True)
    otfs = ((otf_along(lines, pupil.energy, frequencies, step), place) for lines, step, place in sections)
    tangential, sagittal = (modulation(otf, frequencies, place, weights) for otf, place in otfs)
    return tangential, sagittal


def _sheared(scene: Scene, frequencies: Tensor) -> Callable[..., tuple[Tensor, Tensor]] | None:
    """The function that makes the same by a quadrature of the sheared pupil, where the wave is polynomial and the grid
    is slower; `perfect`: without aberrations.

    The grid needs points for all that the blur could modulate, the quadrature for the frequencies that are listed.
    """
    beam = beam_of(scene)
    beam = dataclasses.replace(beam, middle=beam.middle.detach(), half=beam.half.detach())  # choices of coordinates
    usual = not points_needed(beam) > _FINE_GRID
    if usual or frequencies.requires_grad or not bool(beam.wavefront.valid.all()):
        return None
    turns = ((beam.blur.max() * frequencies.abs()).detach()).tolist()
    rules = [rule for rule in map(rule_of_blur, turns) if rule is not None]
    polynomials = polynomials_of(scene, beam) if len(rules) == len(turns) else None
    if polynomials is None:
        return None
    shift = _from_primary(scene.lens, beam.wavefront.centre[:2, 0])
    weights = wavelength_shares(scene.lens) * beam.wavefront.energy.sum(-1)[0]

    def sections(*, perfect: bool = False) -> tuple[Tensor, Tensor]:
        light = polynomials * polynomials.new_tensor([1.0, 1.0, 1.0 - perfect]).reshape(3, 1, 1, 1, 1)
        curves = []
        for section, along in ((1, light), (0, light.mT)):
            shear = frequencies[:, None] / (beam.half[section, 0, 0] * beam.waves_per)
            parts = _overlaps(along, shear, [_RULES[0]] * len(rules) if perfect else rules)
            curves.append(modulation(parts.mT[None], frequencies, (1 - perfect) * shift[section], weights))
        return curves[0], curves[1]

    return sections


def rule_of_blur(turns: float) -> int | None:
    """Points along and across for a phase of 2π `turns` from the chief ray to the rim; None: more than there are."""
    return next((n for n in _RULES if n >= 16 + 6 * turns), None)


def _overlaps(polynomials: Tensor, shear: Tensor, rules: Sequence[int]) -> Tensor:
    """OTF (K, W) of polynomials (3, 1, W, N, N) at shears (K, W) by rules (K,), 1 without a shear."""
    transfers = torch.ones_like(shear) + 0j
    sheared = (shear != 0).any(-1).tolist()
    for points in sorted(set(rules)):
        chosen = torch.tensor([k for k, rule in enumerate(rules) if rule == points and sheared[k]], dtype=torch.int64)
        together = piece(64 * points**2 * polynomials.shape[-1] * shear.shape[1])
        for some in chosen.to(shear.device).split(together) if len(chosen) else []:
            stacked = polynomials.expand(-1, len(some), -1, -1, -1)
            transfers = transfers.index_copy(0, some, otf(stacked, shear[some].abs(), points))
    return transfers


def otf_along(lines: Tensor, energy: Tensor, frequencies: Tensor, step: Tensor) -> Tensor:
    """OTF (F, W, K) of waves (F, W, N, N) shifted along their last axis.

    Between whole steps by sin(πt)/(πt), of what is left when a clear circle's OTF, which has the same kink at zero
    frequency, is taken off.
    """
    size = lines.shape[-1]
    spectrum = torch.fft.fft(lines, n=2 * size)
    overlap = torch.fft.ifft((spectrum.real**2 + spectrum.imag**2).sum(-2))
    # Without a shift the rim's cells count by their share itself, not by its square.
    overlap = torch.cat([(energy + 0j)[..., None], overlap[..., 1:]], -1) / energy[..., None]
    lag = torch.fft.fftfreq(2 * size, 1 / (2 * size), dtype=step.dtype, device=step.device)
    steps = frequencies / step[..., None]
    smooth = overlap - clear_circle(lag.abs() * MARGIN / size)
    between = torch.sinc(steps[..., None] - lag)
    return (between.to(overlap.dtype) @ smooth[..., None])[..., 0] + clear_circle(steps * MARGIN / size)


def clear_circle(s: Tensor) -> Tensor:
    """OTF (2/π)(acos s - s √(1 - s²)) of a clear circle, s the frequency over its cutoff; 0 beyond."""
    passes = s < 1
    s = torch.where(passes, s, 0.5)
    return torch.where(passes, (2 / math.pi) * (torch.acos(s) - s * safe_sqrt(1 - s * s)), 0.0)


def _geometric(lens: Lens, fields: Tensor, frequencies: Tensor) -> tuple[Tensor, Tensor]:
    """Tangential and sagittal MTF (F, K) of rays, as many as the blur needs."""
    pupil = gauss_rings(_LEAST_RINGS, 4 * _LEAST_RINGS, **like(lens))
    if _together(lens, pupil) < fields.shape[1]:
        probe = gauss_rings(_LEAST_RINGS, _PROBE_ARMS, **like(lens))[0]
        with torch.no_grad():
            rays = image_rays(lens, probe, fields=fields)
    else:
        probe, rays = pupil[0], image_rays(lens, pupil[0], fields=fields)
    with torch.no_grad():
        along, around = _steepness(probe, torch.where(rays.valid, rays.position[:2], torch.nan))
        turns = 2 * math.pi * float(frequencies.max())
        rings, arms = rings_and_arms(turns * along, _MARGIN)[0], rings_and_arms(turns * around, _MARGIN)[1]
    rings, arms = max(rings, _LEAST_RINGS), max(arms, 4 * _LEAST_RINGS)
    if rings * arms > _MOST_RAYS:
        raise TooManyPoints(
            f"the blur needs {rings * arms} rays at {float(frequencies.max()):g} cycles/mm: focus the lens"
        )
    is_clipped = lens.count is None and not bool(rays.valid.all())
    if rays.shape[-1] == rings * arms and not is_clipped:
        return _of_spots(lens, fields, frequencies, rays, pupil[1])
    points, rule = gauss_rings(rings, arms, **like(lens))
    parts = []
    for some in fields.split(_together(lens, (points, rule)), 1):
        if is_clipped:  # light up to the edges of the apertures
            points, rule = clear_pupil(lens, fields=some, rings=rings, arms=arms)
        parts.append(_of_spots(lens, some, frequencies, image_rays(lens, points, fields=some), rule))
    tangential, sagittal = (torch.cat(part) for part in zip(*parts, strict=True))
    return tangential, sagittal


def _steepness(points: Tensor, hits: Tensor) -> tuple[float, float]:
    """Largest 2 |∂/∂θ| and |∂/∂φ| in mm of the hits (2, ..., P) of pupil points (2, P) in `_LEAST_RINGS` rings.

    Rings have the radius cos(θ/2), in which a Gauss rule has equally spaced θ; φ: azimuth. Where the image is linear in
    the pupil both are its radius; aberrations of high order are steeper, and take more rings and arms.
    """
    each = hits.unflatten(-1, (_LEAST_RINGS, -1))
    angle = 2 * torch.arccos(torch.hypot(*points).reshape(_LEAST_RINGS, -1)[:, :1])
    along = 2 * (each.diff(dim=-2) / angle.diff(dim=0)).abs().nan_to_num(0.0).max()
    around = (each.roll(-1, -1) - each).abs().nan_to_num(0.0).max() / (2 * math.pi / each.shape[-1])
    return float(along), float(around)


def least_reach(blur: float) -> float:
    """The frequency in cycles/mm up to which the fewest rays give the MTF of an image linear in the pupil, `blur` mm
    in radius; aberrations of high order take more rays (`_steepness`)."""
    return _LEAST_PHASE / (2 * math.pi * blur) if blur > 0 else math.inf


def _together(lens: Lens, pupil: tuple[Tensor, Tensor]) -> int:
    """Number of fields that are traced together."""
    return piece(2 * RAY_BYTES * len(lens.wavelengths) * len(pupil[1]))


def _of_spots(lens: Lens, fields: Tensor, frequencies: Tensor, rays: Rays, rule: Tensor) -> tuple[Tensor, Tensor]:
    """Tangential and sagittal MTF (F, K) of rays (3, F, W, P) of weights (P,)."""
    energy = torch.where(rays.valid, rule, 0.0)
    light = energy.sum(-1)
    refuse_dark(lens, fields, light > 0, "MTF")
    hits = torch.where(rays.valid, rays.position[:2], 0.0)
    mean = (energy * hits).sum(-1) / light
    shift, weights = _from_primary(lens, mean), wavelength_shares(lens) * light
    curves = []
    for along in (1, 0):
        offset = torch.where(rays.valid, hits[along] - mean[along][..., None], 0.0)
        otf = torch.stack([wave.sum(-1) for wave in _phasors(frequencies, offset, energy)], -1) / light[..., None]
        curves.append(modulation(otf, frequencies, shift[along], weights))
    return curves[0], curves[1]


def _phasors(frequencies: Tensor, offset: Tensor, weight: Tensor) -> Iterator[Tensor]:
    """w e^{-2πi ν y} of offsets y for every frequency ν; of equally spaced ones from 0, each the last one times one."""
    step = frequencies[-1] / max(len(frequencies) - 1, 1)
    equal = step * torch.arange(len(frequencies), dtype=step.dtype, device=step.device)
    if len(frequencies) < 3 or not torch.allclose(frequencies, equal, rtol=1e-13, atol=0.0):
        yield from (weight * phasor(-frequency * offset) for frequency in frequencies)
        return
    turn = phasor(-step * offset)
    phase = weight.to(turn.dtype)
    for _ in frequencies:
        yield phase
        phase = phase * turn


def _from_primary(lens: Lens, place: Tensor) -> Tensor:
    """Places (..., W) of the wavelengths, from that of the primary one."""
    return place - place[..., lens.primary_wavelength - 1, None]


def modulation(otf: Tensor, frequencies: Tensor, shift: Tensor, weights: Tensor) -> Tensor:
    """|OTF| (F, K) of OTFs (F, W, K) at places `shift` (F, W) mm, added by weights (F, W)."""
    weights = safe_divide(weights, weights.sum(-1, keepdim=True))[..., None]
    total = (weights * otf * phasor(-frequencies * shift[..., None])).sum(-2)
    return safe_sqrt(total.real**2 + total.imag**2)

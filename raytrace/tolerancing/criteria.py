"""Criteria: measures of image quality of lenses as built, of a batch of lenses in one pass.

A criterion f is a function of a quantity q that the compensators minimise: f = √q where q is a mean square, f = 1 - q
of the MTF. The mean square radius of spots is a parabola in the position of a plane sensor, whose minimum needs no
second trace.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from raytrace.analysis.setting import scene_of, wavelength_shares
from raytrace.analysis.sheared_batch import ShearedPupils
from raytrace.maths.numerics import safe_divide, value
from raytrace.maths.sampling import square
from raytrace.optimization.merit import DefaultMerit, Merit, merit_for
from raytrace.optimization.merit_of_batch import MeritOfBatch
from raytrace.psf_models.models import DRT, Gaussian, psf
from raytrace.psf_models.result import Psf
from raytrace.system.lens import Lens, aligned
from raytrace.system.optimization_data import Row
from raytrace.system.rays import Rays
from raytrace.tracing.clear_pupil import Arms, rule_near
from raytrace.tracing.focus import shift_to_focus, spot_parabola
from raytrace.tracing.paraxial import first_order
from raytrace.tracing.scene import Scene, trace_scene
from raytrace.tracing.spot import image_rays
from raytrace.tracing.trace import without_apertures
from raytrace.tracing.wavefront import wavefront_of, without
from raytrace.words import did_you_mean, option

_ACROSS = 10  # points across the pupil, by which lost light is measured


@value
class Sampling:
    """Fields (2, F) with weights (F,), and pupil points with weights: (2, P) and (P,), or (2, 1, F, W, P) and
    (1, F, W, P) where apertures clip the beams of the nominal lens, `rings` of them on each of its arms."""

    fields: Tensor
    field_weights: Tensor
    points: Tensor
    weights: Tensor
    rings: int = 4
    arms: Arms | None = None

    def of(self, lens: Lens) -> tuple[Scene, Tensor, Tensor]:
        """The scene of a lens near the nominal one, and points and weights over its clear pupils."""
        scene = scene_of(lens, self.fields)
        return scene, *rule_near(scene, self.points, self.weights, self.arms, self.rings)


@dataclasses.dataclass(frozen=True)
class Criterion:
    """A measure of image quality f(q) of a quantity q that the compensators minimise.

    quantity: q (L,) of a batch of lenses, ready for rays (`aligned`). parabola: q₀, q₁, q₂ (L,) of q₀ + 2 s q₁ + s² q₂
    with the sensor s mm further along its normal; None: no closed form. value: f of q; quantity_of: q of f; sign: -1
    where a larger f is better. scale: of q, where it is 0 for the nominal lens. together: lenses traced at once with
    derivatives. settings: on which q depends besides lens, fields and pupil. angle: radians of a unit, 0 for no angle.
    allows_idle: whether compensators without effect on q stay at 0; else they are refused.
    """

    name: str
    unit: str
    quantity: Callable[[Lens, Sampling], Tensor]
    parabola: Callable[[Lens, Sampling], tuple[Tensor, Tensor, Tensor]] | None = None
    value: Callable[[Tensor], Tensor] = torch.sqrt
    quantity_of: Callable[[float], float] = lambda f: f * f
    sign: int = 1
    scale: float = 0.0
    together: int = 256
    settings: tuple = ()
    angle: float = 0.0
    allows_idle: bool = False


def _mean_square_radius(lens: Lens, sampling: Sampling) -> Tensor:
    """Mean square spot radius (L,) µm², all wavelengths together, about the centroid of each field."""
    return _spot_parabola(lens, sampling)[0]


def _spot_parabola(lens: Lens, sampling: Sampling) -> tuple[Tensor, Tensor, Tensor]:
    """The mean square spot radius as a parabola of the position of the sensor, µm², µm²/mm, µm²/mm²."""
    scene, points, weights = sampling.of(lens)
    rays, weights = trace_scene(scene, points), (wavelength_shares(lens)[:, None] * weights).flatten(-2)
    together = Rays(rays.position.flatten(-2), rays.direction.flatten(-2), rays.valid.flatten(-2))
    q0, q1, q2 = (1e6 * (sampling.field_weights * part).sum(-1) for part in spot_parabola(together, weights))
    return q0, q1, q2


def _mean_square_angle(lens: Lens, sampling: Sampling) -> Tensor:
    """Mean square angle (L,) mrad² of the rays at the sensor, of all wavelengths, about the mean of each field."""
    scene, points, weights = sampling.of(lens)
    rays, weights = trace_scene(scene, points), (wavelength_shares(lens)[:, None] * weights).flatten(-2)
    weights = torch.where(rays.valid.flatten(-2), weights, 0.0)
    total, directions = weights.sum(-1, keepdim=True), rays.direction.flatten(-2)
    share = safe_divide(weights, total)
    offset = directions - (share * directions).sum(-1, keepdim=True)
    squares = (share * (offset * offset).sum(0)).sum(-1)
    return 1e6 * (sampling.field_weights * torch.where(total[..., 0] > 0, squares, torch.nan)).sum(-1)


@torch.no_grad()
def light(lens: Lens, sampling: Sampling) -> Tensor:
    """Share (L,) of the light of the pupils that arrives, at the primary wavelength, of `square` points."""
    points, _ = square(_ACROSS, dtype=lens.wavelengths.dtype, device=lens.wavelengths.device)
    arriving = image_rays(lens, points, fields=sampling.fields, wavelengths=lens.primary[None]).valid
    return (sampling.field_weights * arriving[..., 0, :].to(points).mean(-1)).sum(-1)


def _wavefront_variance(lens: Lens, sampling: Sampling) -> Tensor:
    """Mean square (L,) of the OPD about its mean and tilt, waves²."""
    front = wavefront_of(*sampling.of(lens))
    lit = (front.energy > 0).sum(-1, keepdim=True) >= 3  # fewer rays have no mean and tilt
    front = dataclasses.replace(front, energy=torch.where(lit, front.energy, 1.0))
    flat = without(front, 3) / (1e-3 * lens.wavelengths[:, None])
    share = front.energy / front.energy.sum(-1, keepdim=True)
    squares = torch.where(lit[..., 0], (share * flat * flat).sum(-1), torch.nan)
    return (sampling.field_weights * (squares * wavelength_shares(lens)).sum(-1)).sum(-1)


def _modulation(frequency: float, lens: Lens, sampling: Sampling) -> Criterion:
    """Mean of tangential and sagittal MTF over the fields; q = 1 - MTF."""
    pupils = ShearedPupils(lens, sampling.fields, frequency)

    def quantity(lenses: Lens, sampling: Sampling) -> Tensor:
        tangential, sagittal = pupils(lenses)
        return 1 - (sampling.field_weights * 0.5 * (tangential + sagittal)).sum(-1)

    name = f"MTF at {frequency:g} cycles/mm"
    return Criterion(
        name, "", quantity, value=lambda q: 1 - q, quantity_of=lambda f: 1 - f, sign=-1, scale=1.0, together=32
    )


def _psf_change(
    lens: Lens, sampling: Sampling, model: str, pixel: float | None, size: int | tuple[int, int] | None
) -> Criterion:
    """RMS difference of PSFs from the nominal lens's, relative to that PSF, over the fields."""
    kinds: dict[str, type[Gaussian] | type[DRT]] = {"gaussian": Gaussian, "drt": DRT}
    if model not in kinds:
        raise ValueError(f"model {model!r}: expected one of {', '.join(kinds)}{did_you_mean(model, kinds)}")

    def kernels(lens: Lens, model: str | Gaussian | DRT) -> Psf:
        return psf(lens, model, fields=sampling.fields, pixel=pixel, size=size)

    with torch.no_grad():
        order = kernels(lens, model).order
        nominal = kernels(lens, kinds[model](order=order)).kernel
    energy = nominal.square().sum((-2, -1))

    def quantity(lenses: Lens, sampling: Sampling) -> Tensor:
        kernel = kernels(lenses, kinds[model](order=order)).kernel
        change = (kernel - nominal).square().sum((-2, -1)) / energy
        return (sampling.field_weights * change).sum(-1)

    settings = (model, order, pixel, size)
    return Criterion("change of the PSF", "", quantity, scale=1.0, settings=settings, together=32)


def _boresight(lens: Lens, sampling: Sampling) -> Criterion:
    """Distance on the sensor from the nominal chief ray of the axial field, at the primary wavelength."""

    def place(lenses: Lens) -> Tensor:
        axis, bare = lenses.wavelengths.new_zeros(2, 1), without_apertures(lenses)
        rays = image_rays(bare, axis, fields=axis, wavelengths=lenses.primary[None])
        return torch.where(rays.valid, rays.position[:2], torch.nan)[..., 0, 0, 0]

    with torch.no_grad():
        nominal = place(lens)
        focal_length = float(first_order(lens).effective_focal_length)

    def quantity(lenses: Lens, sampling: Sampling) -> Tensor:
        return 1e6 * (place(lenses) - nominal.reshape(2, 1)).square().sum(0).expand(lenses.count or 1)

    angle = 1e-3 / abs(focal_length) if math.isfinite(focal_length) else 0.0
    return Criterion("boresight error", "µm", quantity, scale=1.0, angle=angle, allows_idle=True)


def _merit(lens: Lens, merit: Merit | DefaultMerit | Sequence[Row] | str | None) -> Criterion:
    """A merit function, of the file or as `optimize` takes it; q is its square."""
    function = merit_for(lens, merit) if merit is None or isinstance(merit, Merit) else None

    def quantity(lenses: Lens, sampling: Sampling) -> Tensor:
        # a default merit function has the rays of the symmetry that the lens with errors has
        return MeritOfBatch(lenses, function or merit_for(aligned(lenses, 0, exactly=True)[0], merit)).square()

    rows = merit_for(lens, merit)
    return Criterion("merit function", "", quantity, settings=(repr(rows.rows), rows.unit))


#: Criteria of every lens by name; the others of NAMES depend on the nominal lens.
CRITERIA = {
    "rms": Criterion("RMS spot radius", "µm", _mean_square_radius, _spot_parabola),
    "wavefront": Criterion("RMS wavefront", "waves", _wavefront_variance),
    "angle": Criterion("RMS angle", "mrad", _mean_square_angle, allows_idle=True),
}
NAMES = (*CRITERIA, "mtf@F", "merit", "psf", "boresight")


def size_of_image(lens: Lens) -> Criterion:
    """The criterion "rms": of spots, or of an afocal lens of angles."""
    return CRITERIA["angle" if lens.afocal else "rms"]


def criterion_of(
    word: str,
    lens: Lens,
    sampling: Sampling,
    *,
    model: str = "gaussian",
    pixel: float | None = None,
    size: int | tuple[int, int] | None = None,
    merit: Merit | DefaultMerit | Sequence[Row] | str | None = None,
) -> Criterion:
    """The criterion of a word, "rms" or "mtf@30", for lenses near a nominal one.

    model, pixel, size: of "psf"; merit: of "merit". Raises ValueError for other words and options, BadMerit for a lens
    without a merit function.
    """
    if word != "merit" and merit is not None:
        raise ValueError(f"criterion {word!r}: {option('merit')} belongs to the criterion merit; leave it out")
    if word != "psf" and (model, pixel, size) != ("gaussian", None, None):
        raise ValueError(
            f"criterion {word!r}: {option('model')}, {option('pixel')} and {option('size')} belong to the criterion "
            "psf; leave them out"
        )
    if word in CRITERIA:
        return size_of_image(lens) if word == "rms" else CRITERIA[word]
    if word == "merit":
        return _merit(lens, merit)
    if word == "psf":
        return _psf_change(lens, sampling, model, pixel, size)
    if word == "boresight":
        return _boresight(lens, sampling)
    name, mark, number = word.partition("@")
    if name == "mtf":
        try:
            return _modulation(float(number), lens, sampling)
        except ValueError as error:
            message = str(error) if mark and _is_number(number) else "expected a frequency in cycles/mm, as mtf@30"
            raise ValueError(f"criterion {word!r}: {message}") from error
    raise ValueError(f"criterion {word!r}: expected one of {', '.join(NAMES)}{did_you_mean(name, NAMES)}")


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def at_best_focus(parabola: Sequence[Tensor], least: Tensor, most: Tensor) -> tuple[Tensor, Tensor]:
    """The least of q₀ + 2 s q₁ + s² q₂ between limits of s, and s; (L,) each, differentiable."""
    q0, q1, q2 = parabola
    shift = torch.clamp(shift_to_focus(q1, q2), least, most)
    return q0 + shift * (2 * q1 + shift * q2), shift

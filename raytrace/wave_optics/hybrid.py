"""Phase elements and traced lenses together.

    element_lens   a height map as a plano lens whose rays are traced: plane, glass, surface z = h(x, y)
    stop_alone     a plane stop in front of a sensor, which elements without a lens are in
    hybrid_psf     a lens whose stop carries elements: the traced wavefront plus their path

        U(x, y) = (n/λ) Σ_j √(E_j Ω_j) exp(2πi [W_j + Σ_e (n_e(λ) - 1) h_e(x_j, y_j) + n (L_j x + M_j y)]/λ)

(x_j, y_j) is where ray j of the lens without elements meets its stop. An element is thin there: rays have no path
inside it and are not traced anew behind it. Compared with refraction at the height itself this neglects a path of
(h_max - h) θ²/2 where rays behind it run at an angle θ to the axis, and, of second order in the slopes of the element,
that rays deflected by it cross the rest of the lens elsewhere.
"""

import dataclasses
import math
from collections.abc import Sequence

import torch
from torch import Tensor

from raytrace.materials.glass import index
from raytrace.maths.numerics import safe_divide, to
from raytrace.maths.sampling import Grid, gauss_rings
from raytrace.maths.sampling import grid as make_grid
from raytrace.maths.zernike import noll
from raytrace.psf_models.dft import rings_and_arms
from raytrace.psf_models.result import Kernels, Psf, polychromatic
from raytrace.psf_models.wave import (
    Waves,
    amplitude,
    by_field,
    half_spread,
    phase_along_radius,
    probe_of,
    sensor_points,
    waves,
)
from raytrace.system.lens import Fields, Lens, SystemAperture, field_points, media, with_object_distance
from raytrace.system.sag_terms import GridSag, SplineSag, ZernikeSag, relief, spline
from raytrace.system.surface import Surface, sag_at
from raytrace.tracing.launch import rays_of_field, vignette, warn_of_filling
from raytrace.tracing.scene import Scene, chief_landing, scene, symmetry
from raytrace.tracing.trace import at_stop
from raytrace.tracing.wavefront import Wavefront, wavefront_of
from raytrace.wave_optics.direction_grid import (
    Directions,
    TooCoarse,
    cells_across,
    directions_of,
    rays_of_series,
)
from raytrace.wave_optics.direction_grid import amplitude as amplitude_of_pixels
from raytrace.wave_optics.element import (
    Element,
    EvenPowers,
    Pixels,
    Rings,
    Zernike,
    has_features,
    in_contact,
    is_flat,
    is_radial,
    path,
    slopes_of,
)

_MOST_RAYS = 400_000  # of one kernel

_FINE = 32, 64  # rings and arms of the points where slopes of an element are evaluated
_PER_PIXEL = 8.0  # radians of phase that count for a flat pixel: two rays across it along a radius
_PER_ZONE = 4.0  # times the phase of a wrapped height: twelve rays across a zone
_WIDER = 1.05  # beam over element


def element_lens(
    element: Element,
    *,
    sensor_distance: Tensor | float,
    object_distance: Tensor | float = math.inf,
    wavelengths: Tensor | Sequence[float] = (0.55,),
    substrate: Tensor | float = 0.0,
) -> Lens:
    """A plano lens of one element: the stop, its round rim, is on the height's side, which faces the sensor.

    sensor_distance: mm from the vertex of the height, the plane of the thin element; object_distance: mm from the
    plane, inf allowed; wavelengths: (W,) µm; substrate: mm of glass below height 0. Raises ValueError for a stepped or
    wrapped element, which diffracts, and for heights that lie beyond the plane.
    """
    front, back = surfaces_of(element, substrate=substrate)
    back = dataclasses.replace(back, thickness=torch.as_tensor(sensor_distance, dtype=front.thickness.dtype))
    zero = torch.zeros_like(front.thickness)
    before, image = (Surface(torch.as_tensor(t, dtype=zero.dtype)) for t in (object_distance, zero))
    wavelengths = torch.as_tensor(wavelengths, dtype=zero.dtype)
    axis = wavelengths.new_zeros(1)
    return Lens(
        surfaces=(before, front, back, image),
        stop=2,
        aperture=SystemAperture("float_by_stop", element.radius),
        fields=Fields("angle", axis, axis, torch.ones_like(axis)),
        wavelengths=wavelengths,
        wavelength_weights=torch.ones_like(wavelengths),
    )


def stop_alone(
    elements: Sequence[Element],
    *,
    sensor_distance: Tensor | float,
    object_distance: Tensor | float = math.inf,
    wavelengths: Tensor | Sequence[float] = (0.55,),
) -> Lens:
    """A plane stop in air, the aperture of elements in contact, without their paths: a lens without power.

    sensor_distance: mm from the stop; object_distance: mm from it, inf allowed; wavelengths: (W,) µm.
    """
    radius = elements[0].radius
    numbers = object_distance, sensor_distance, 0.0
    distances = (torch.as_tensor(number, dtype=radius.dtype, device=radius.device) for number in numbers)
    before, behind, image = (Surface(t) for t in distances)
    wavelengths = torch.as_tensor(wavelengths, dtype=radius.dtype, device=radius.device)
    axis = wavelengths.new_zeros(1)
    return Lens(
        surfaces=(before, dataclasses.replace(behind, semi_diameter=float(radius.detach())), image),
        stop=1,
        aperture=SystemAperture("float_by_stop", radius),
        fields=Fields("angle", axis, axis, torch.ones_like(axis)),
        wavelengths=wavelengths,
        wavelength_weights=torch.ones_like(wavelengths),
        name=" + ".join(element.kind.words for element in elements),
    )


def is_stop_alone(lens: Lens) -> bool:
    """Whether a lens is a plane stop in air, as `stop_alone`: elements there are the only power."""
    stop = lens.surfaces[1]
    is_flat = stop.is_plane and stop.sag_terms is None and stop.phase is None
    return len(lens.surfaces) == 3 and is_flat and all(bool((n == 1).all()) for n in media(lens, lens.wavelengths))


def surfaces_of(element: Element, *, substrate: Tensor | float = 0.0) -> tuple[Surface, Surface]:
    """The plane and the height of an element, in air; errors as for `element_lens`.

    The thickness between their vertices is the substrate plus the height at the axis; even powers become those of an
    asphere, all other profiles sag terms without a height at its vertex.
    """
    profile, radius = element.profile, float(element.radius.detach())
    if element.period is not None or isinstance(profile, Rings):
        kind = "rings" if element.period is None else "a wrapped height"
        raise ValueError(f"{kind} diffract, which rays do not: give whole smooth heights (pixels, Zernike, powers)")
    zero = torch.zeros_like(element.radius)
    back, centre = Surface(thickness=zero, semi_diameter=radius), zero
    if isinstance(profile, EvenPowers):
        back = dataclasses.replace(back, coefficients=profile.coefficients)
    else:
        sag_terms: ZernikeSag | SplineSag
        if isinstance(profile, Zernike):
            sag_terms = ZernikeSag(profile.coefficients, element.radius)
        else:
            sag_terms = spline(GridSag(profile.heights, profile.pitch))
        centre = relief(sag_terms).sag(zero, zero, highest=0).z
        # The piston of a series; the weights of a spline sum to 1. Found once, however often it is traced.
        is_series = isinstance(profile, Zernike)
        pistons = torch.nn.functional.pad(centre[None], (0, len(element.numbers) - 1)) if is_series else centre
        sag_terms = dataclasses.replace(sag_terms, coefficients=sag_terms.coefficients - pistons)
        back = dataclasses.replace(back, sag_terms=sag_terms)
    thickness = centre + torch.as_tensor(substrate, dtype=zero.dtype)
    with torch.no_grad():
        lowest = float((thickness + sag_at(back, *_disc(element.radius))).min())
    if lowest < 0 or not float(thickness.detach()) > 0:
        least = float(torch.as_tensor(substrate)) + max(-lowest, 0.0)
        raise ValueError(f"the height lies {-lowest:.3g} mm beyond the plane: give a substrate above {least:.3g} mm")
    return Surface(thickness=thickness, glass=element.glass, semi_diameter=radius), back


def hybrid_psf(
    lens: Lens,
    elements: Element | Sequence[Element],
    *,
    fields: Tensor | Sequence | None = None,
    object_distances: Tensor | Sequence[float] | None = None,
    wavelengths: Tensor | Sequence[float] | None = None,
    pixel: float = 0.005,
    size: int | tuple[int, int] = 21,
    order: int = 0,
) -> Psf:
    """PSFs (D, F, W, rows, columns) of a lens that carries phase elements in contact at its stop, by waves.

    The path (n - 1) h of the elements at the ray's point of the stop is added to the traced wavefront. Aberrations,
    vignetting, field and diffraction at the rim of the pupil and at the features of the heights are modelled. The
    elements are thin: obliquity inside them, and the other way through the lens of rays that they deflect, are not,
    nor are Fresnel losses; rays are not traced through them.

    elements: of `rt.wave_optics.phase_elements` or `rt.wave_optics.phase_element`, at least as wide as the beam at the
    stop, which must lie in air. fields: y, pairs (x, y) or (2, F) in the lens's kind of field; object_distances: (D,)
    mm; wavelengths: (W,) µm; by default those of the lens. pixel, size: pitch in mm and number of pixels around the
    chief ray at the primary wavelength, which they follow in the derivatives too. order: of the pupil sampling, -2 … 5
    as for `rt.psf_models.Wave`; a higher one checks convergence, the error is not estimated. Differentiable in the
    numbers of the elements and of the lens.

    Flat pixels are summed over a square grid of directions, other profiles over rays (`rays`: their number).
    Raises ValueError for a stop between other media than air and a beam wider than an element, TooCoarse where more
    than 400,000 rays or 4,096² directions would be needed.
    """
    parts = in_contact(elements)
    like = lens.wavelengths
    fields = field_points(fields, like=lens)
    distances = lens.surfaces[0].thickness.reshape(1) if object_distances is None else object_distances
    distances, colours = (
        torch.as_tensor(t).to(like) for t in (distances, like if wavelengths is None else wavelengths)
    )
    warn_of_filling(lens, fields)
    view = scene(lens, fields, distances, colours)
    chief = chief_landing(dataclasses.replace(view, wavelengths=lens.primary[None]))
    window = make_grid(like.new_tensor(pixel), size, chief.expand(*chief.shape[:-1], len(colours)))
    psfs = polychromatic(kernels(view, parts, window, order=order), view, None, "hybrid")
    weights = torch.ones_like(colours) if wavelengths is not None else lens.wavelength_weights
    return dataclasses.replace(
        psfs,
        order=order,
        reason=f"phase elements at the stop; σ of the light inside the window; order {order}, error not estimated",
        lens=lens,
        fields=fields,
        object_distances=distances,
        wavelengths=colours,
        wavelength_weights=weights / weights.sum(),
    )


def kernels(scene: Scene, elements: tuple[Element, ...], grid: Grid, *, order: int = 0) -> Kernels:
    """Wave PSFs of a scene whose lens carries elements in contact at its stop.

    Differentiable in the numbers of the elements and of the lens. order: as for the wave model (`psf_models.wave`).
    Flat pixels are summed over a square grid of directions (`direction_grid`), with four cells of it to a pixel in
    order 0, which leaves an error of 1e-4 to 1e-3 of the light. Kernels of rings and wrapped heights, and of pixels in
    a clipped beam, are sums over rays and converge slowly, by the rays across a step. Moments are those of the light
    inside the window. Raises ValueError for a stop between other media than air, a beam wider than an element at the
    stop (by more than 5 %), TooCoarse where more than 400,000 rays or 4,096² directions would be needed.
    """
    elements = tuple(to(element, dtype=torch.float64) for element in elements)
    stop = scene.lens.stop
    if any(bool(((n - 1).abs() > 1e-3).any()) for n in media(scene.lens, scene.wavelengths)[stop - 1 : stop + 1]):
        raise ValueError(f"elements need air on both sides; the stop, surface {stop}, borders on another medium")
    radial = all(is_radial(element) for element in elements)
    pixels = tuple(element for element in elements if isinstance(element.profile, Pixels))
    others = tuple(element for element in elements if not isinstance(element.profile, Pixels))

    def of_field(part: Scene, window: Grid) -> Kernels:
        probe = probe_of(part)
        gridded = _directions(part) if pixels else None
        points = sensor_points(part, probe, window, order, is_round=radial and symmetry(part) == "round")
        stepped = elements if gridded is None else others
        reach = points.corner + _reach_of_elements(part, probe, elements, stepped=stepped)
        if gridded is None:
            light = _over_rays(part, probe, elements, reach, order)
            U, front, samples = amplitude(light, points.x, points.y), light.wavefront, light.amplitude.shape[-1]
        else:
            directions, front = gridded
            cells = cells_across(directions, pixels, phase_along_radius(probe, reach), order)
            U = amplitude_of_pixels(directions, front, points.x, points.y, pixels=pixels, others=others, cells=cells)
            samples = cells**2
        kernel, centroid, covariance = points.integrated_amplitude(U, probe)
        return Kernels(kernel, window, centroid, covariance, samples, front.energy.sum(-1))

    return by_field(scene, grid, of_field)


def _directions(scene: Scene) -> tuple[Directions, Wavefront] | None:
    """`directions_of` one field, and the rays of its series."""
    front = wavefront_of(scene, *rays_of_series(scene.wavelengths))
    directions = directions_of(scene, front, _at_stop(scene, front.pupil))
    return None if directions is None else (directions, front)


def _over_rays(
    scene: Scene, probe: Wavefront, elements: tuple[Element, ...], reach: Tensor | float, order: int
) -> Waves:
    """Waves with the path of elements, all rays of them where an element does not share their symmetry."""
    rings, arms = rings_and_arms(phase_along_radius(probe, reach), order)
    if elements and rings * arms > _MOST_RAYS:
        raise TooCoarse(
            f"the elements need {rings} × {arms} rays, more than {_MOST_RAYS}: take coarser or weaker ones, a "
            "smaller window, or the wave camera, which takes any height but no lens"
        )
    light = waves(scene, reach, order=order, probe=probe)
    if not elements:
        return light
    stop = _at_stop(scene, light.wavefront.pupil)
    if light.symmetry != "none" and not all(is_radial(element) for element in elements):
        light, stop = _unfolded(light, stop, arms)
    front = light.wavefront
    x, y = stop
    colours = range(x.shape[2])
    added = [path(elements, x[:, :, w], y[:, :, w], front.wavelength[w : w + 1])[0] for w in colours]
    return dataclasses.replace(light, wavefront=dataclasses.replace(front, opd=front.opd + torch.stack(added, 2)))


def _at_stop(scene: Scene, pupil: Tensor) -> Tensor:
    """Where the rays of pupil points meet the stop, (2, D, F, W, P) mm."""
    lens = with_object_distance(scene.lens, scene.lens.surfaces[0].thickness[..., None])
    field, wavelength = scene.fields[..., None, None], scene.wavelengths[:, None]
    rays = rays_of_field(lens, field, vignette(lens, field, pupil), wavelength=wavelength)
    return at_stop(lens, rays, wavelength)[0].expand(2, *scene.shape, pupil.shape[-1])


def _unfolded(light: Waves, stop: Tensor, arms: int) -> tuple[Waves, Tensor]:
    """All rays of waves of which symmetry left out some: an element does not share it."""
    front = light.wavefront
    N, pairs = front.direction[2], [front.direction[:2], stop]
    if light.symmetry == "mirror":
        copies = 2
        L_M, stop = (torch.stack([torch.cat([a, -a], -1), torch.cat([b, b], -1)]) for a, b in pairs)
    else:
        copies = arms
        angle = (torch.arange(arms, dtype=N.dtype, device=N.device) + 0.5) * (2 * math.pi / arms)
        c, s = torch.cos(angle)[:, None], torch.sin(angle)[:, None]
        columns = ((a[..., None, :], b[..., None, :]) for a, b in pairs)
        L_M, stop = (torch.stack([c * a - s * b, s * a + c * b]).flatten(-2) for a, b in columns)
    opd, N, amplitude = (torch.cat([t] * copies, -1) for t in (front.opd, N, light.amplitude / copies))
    front = dataclasses.replace(front, opd=opd, direction=torch.cat([L_M, N[None]]))
    return Waves(amplitude, front, "none"), stop


def _reach_of_elements(
    scene: Scene, probe: Wavefront, elements: tuple[Element, ...], *, stepped: tuple[Element, ...]
) -> float:
    """Additional spread (mm) of rays on the sensor by the elements, plus a distance that represents the steps of some.

    A slope g of path at the stop moves a ray of the lens, whose directions are (L, M) = -K s for points s of the stop,
    by K⁻ᵀ g/n on the sensor, with the K that fits the directions best; elements that focus make the blur smaller.
    """
    if not elements:
        return 0.0
    with torch.no_grad():
        points = _disc(torch.ones_like(scene.wavelengths[0]))
        front = wavefront_of(scene, points)
        stop = torch.where(front.usable, _at_stop(scene, points), 0.0)
        beam = torch.linalg.vector_norm(stop, dim=0).max()
        for element in elements:
            if beam > _WIDER * element.radius:
                raise ValueError(
                    f"the beam at the stop has a radius of {float(beam):.4g} mm, the element of "
                    f"{float(element.radius):.4g} mm: make the element larger, or the aperture of the lens smaller"
                )
        s, d = (t - t.mean(-1, keepdim=True) for t in (stop.movedim(0, -2), front.direction[:2].movedim(0, -2)))
        to_stop, to_directions = s @ s.mT, -d @ s.mT
        small = 1e-12 * torch.eye(2, dtype=s.dtype, device=s.device)
        slopes = _slopes(elements, stop, front.wavelength).movedim(0, -2)
        shift = torch.linalg.solve(to_directions.mT + small, to_stop @ slopes).movedim(-2, 0) / front.index[:, None]
        spread = torch.where(front.usable, torch.linalg.vector_norm(front.landing + shift, dim=0), 0.0).amax(-1)
        alone = torch.where(probe.usable, torch.linalg.vector_norm(probe.landing, dim=0), 0.0).amax(-1)
        # `waves` samples 2πn a/λ of phase for each mm between a ray and a point, a the spread of directions.
        phases = sum((_phase_of_steps(element, beam, probe.wavelength) for element in stepped), torch.zeros_like(alone))
        steps = safe_divide(phases, 2 * math.pi * half_spread(probe) * probe.index / (1e-3 * probe.wavelength))
        return float((spread + steps - alone).max())


def _slopes(elements: tuple[Element, ...], stop: Tensor, wavelengths: Tensor) -> Tensor:
    """Gradient (2, D, F, W, P) of the path, no unit, of the smooth elements at points of the stop."""
    total = torch.zeros_like(stop)
    for element in elements:
        if not is_flat(element):
            excess = (index(element.glass, wavelengths) - 1).to(wavelengths)
            total = total + excess[:, None] * slopes_of(element, *stop)
    return total


def _phase_of_steps(element: Element, beam: Tensor, wavelengths: Tensor) -> Tensor:
    """Phase (W,) in radians along a radius that represents the steps of an element, and its periods round the pupil."""
    profile, none = element.profile, torch.zeros_like(wavelengths)
    excess = 2e3 * math.pi * (index(element.glass, wavelengths) - 1).abs().to(wavelengths) / wavelengths
    if has_features(profile):
        heights = profile.heights
        steps = [heights.diff(dim=axis).abs().max() for axis in range(heights.dim()) if heights.shape[axis] > 1]
        slope = torch.stack([*steps, heights.new_zeros(())]).max() / profile.pitch
        least = torch.where(slope > 0, _PER_PIXEL * beam / profile.pitch, 0.0)
        return torch.maximum(excess * slope * beam, least + none)
    phase = excess * torch.linalg.vector_norm(slopes_of(element, *_disc(beam)), dim=0).max() * beam
    total = none if element.period is None else _PER_ZONE * phase
    if isinstance(profile, Zernike) and bool((profile.coefficients != 0).any()):
        # Extends the margin of `rings_and_arms` to polynomials of more than one period round the pupil.
        turns = max(abs(noll(int(j) + 1)[1]) for j in torch.nonzero(profile.coefficients))
        total = total + max(turns - 1, 0) * (6 + 1.5 * phase ** (1 / 3))
    return total


def _disc(radius: Tensor) -> Tensor:
    """Points (2, P) mm all over a disc, its centre and its rim among them."""
    points, _ = gauss_rings(*_FINE, dtype=radius.dtype, device=radius.device)
    rim = points[:, -_FINE[1] :]
    rim = rim / torch.linalg.vector_norm(rim, dim=0)
    return radius.detach() * torch.cat([torch.zeros_like(points[:, :1]), points, rim], 1)

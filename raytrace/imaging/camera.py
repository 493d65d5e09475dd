"""Camera: a lens with variables, a sensor and a restoration network as one module.

A training step of lens and network, in colour, at random places of the sensor:

    lens = rt.read_lens("cooke_triplet")
    sensor = rt.Sensor(size=(24, 16), pixels=(4800, 3200), response="rgb", full_well=2e4, read_noise=3)
    camera = rt.Camera(rt.Variables(lens, "curvature thickness"), rt.UNet(channels=3), sensor=sensor)
    optimizer = torch.optim.Adam(camera.rates(optics=1e-3, network=1e-3))
    index = torch.arange(2)                                  # (B,): global numbers of the samples
    points = sensor.patch_points(sensor.random_patches(index, size=32), 32)
    pictures = torch.rand(2, 3, 32 + camera.margin, 32 + camera.margin)
    distances = 10e3 + 40e3 * torch.rand(len(pictures))      # mm, one per image
    restored = camera(pictures, distances, points=points, index=index)  # (B, 3, 32, 32): blurred, recorded, restored
    loss = (restored - camera.target(pictures)).abs().mean() + camera.variables.violation()
    optimizer.zero_grad()
    loss.backward()
    optimizer.step()
    camera.variables.project()                               # onto the bounds, if there are any

Without a sensor the pictures are grey, (B, H, W), at one of the `fields`, with white noise. A phase element at the
stop, whose heights are learned with the lens, or an element without a lens:

    camera = rt.Camera(rt.Variables(lens, "sensor"), network, element=rt.PhaseVariables(element), sensor=sensor)
    camera = rt.Camera(rt.PhaseVariables(element), network, sensor_distance=35.5, sensor=sensor)
"""

import dataclasses
import warnings
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Literal, Self

import torch
from torch import Tensor, nn

from raytrace.imaging.built_lens import lens_as_built, sensor_compensator
from raytrace.imaging.field_kernels import check_model, order_of
from raytrace.imaging.image import add_noise, as_picture, blur
from raytrace.imaging.render import Rendering, element_in_stop, linearised, patch_kernels, render
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.variables import KEY, OtherLens, PhaseVariables, Variables, converted, decoded_text, encoded_text
from raytrace.maths.numerics import safe_divide
from raytrace.maths.result import plain
from raytrace.maths.sampling import Grid, grid
from raytrace.psf_models import MODELS, Execution, NotConverged, Paraxial, drt, model_of, psf
from raytrace.psf_models.gaussian import gaussian_pixels
from raytrace.psf_models.models import is_sampled_in_common
from raytrace.psf_models.result import moments_of_rays
from raytrace.system.identity import alike
from raytrace.system.lens import Lens, field_points
from raytrace.tolerancing.perturbation import check_tolerances
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.table import Tolerances
from raytrace.tracing.launch import UnfilledStop, warn_of_filling
from raytrace.tracing.scene import Memo, beam_share, chief_landing, scene, symmetry, trace_scene
from raytrace.wave_optics.element import Element
from raytrace.words import named_value

_RAY_WIDTH = 0.25  # half width in pixels of a ray of pupil_points with "drt", for a derivative
_LARGEST = 2.0  # allowed value of an image in [0, 1]: resampling overshoots


class Camera(nn.Module):
    """Simulated capture and restoration of images in [0, 1], each at its own object distance.

    With a sensor the images are (B, C, H, W), linear in light, of the C channels of its response, each at its place on
    the sensor; without one they are grey, (B, H, W), at one of the `fields`.

    variables: of the lens, or of a phase element without a lens, `sensor_distance` mm before the sensor, at wavelengths
    (W,) µm as for `render`; element: variables of one at the stop of the lens. Elements need a sensor.
    network: (B, C, h, w) -> the same, C = 1 without a sensor; model: a PSF model, by default "gaussian", with elements
    "wave".
    sensor: its response, noise, quantisation and mosaic are those of the images; whole pictures: see `render`.
    object_distances: smallest and largest, mm; fields: (2, F), or a list of y or (x, y), in the lens's kind of field,
    on the axis by default; with a sensor they are those of its centre, of 0.7 and of 1 of its half diagonal.
    pixels: the PSF window, a Grid, 21 × 21 of 5 µm by default, or its number of pixels of the sensor, 21 by default.
    normalise: "window" or "energy", as for `psf`; illumination: images of a sensor have the relative illumination of
    their places.
    noise: standard deviation of the sensor noise. tol: allowed error of the kernels: the order of the PSF model is
    chosen once, for the lens at the first call (`plan`). rho: of the paraxial model.
    network_dtype: torch.bfloat16 runs the network in it (autocast); the optics keep the dtype of the lens.
    pupil_points: (2, P), PSFs of these rays, all of one weight, instead of as many rays as `tol` needs ("gaussian",
    "drt"): a Gaussian of twelve rays has their centroid and covariance, not those of all light.
    center: of the PSF window, "chief" (the chief ray) or "centroid" (of the light, as `psf`): image position is no
    error. tolerances: of the lens as built: calls then take `errors` (N,) of one lens for all images, or (B, N), a lens
    for each, of `draw_errors(tolerances, …)`. Every lens is focused again by its sensor distance where that is the
    compensator of the tolerances: it moves by as much as the errors move the best focus over the fields.
    pupil_points, center, tolerances, normalise and noise are those of cameras without a sensor.
    The object is planar and upright; image inversion and magnification are ignored. `state_dict` describes the lens,
    its variables and the sensor, and loads into a camera of the same ones alone.
    Warns UnfilledStop once, for the lens at construction.
    """

    def __init__(
        self,
        variables: Variables | PhaseVariables,
        network: nn.Module,
        *,
        element: PhaseVariables | None = None,
        sensor_distance: float | None = None,
        wavelengths: Sequence[float] | None = None,
        model: str | None = None,
        object_distances: tuple[float, float] = (1e4, 5e4),
        fields: Tensor | Sequence | None = None,
        pixels: Grid | int | None = None,
        normalise: str = "window",
        noise: float = 0.1,
        tol: float = 1e-2,
        rho: float = 0.5,
        network_dtype: torch.dtype | None = None,
        pupil_points: Tensor | None = None,
        center: Literal["chief", "centroid"] = "chief",
        tolerances: Tolerances | None = None,
        sensor: Sensor | None = None,
        illumination: bool = False,
    ):
        super().__init__()
        if not isinstance(variables, Variables | PhaseVariables):
            kind = named_value(variables)
            expected = "the Variables of a lens: Variables(lens, …), or of an element: PhaseVariables(element)"
            raise TypeError(f"Camera: `variables` is {kind}; expected {expected}")
        self.variables, self.element, self.network = variables, element, network
        self.range, self.sensor, self.illumination = object_distances, sensor, illumination
        self.sensor_distance, self.wavelengths = sensor_distance, wavelengths
        self._check_element()
        self.model = model or ("wave" if self.elements() else "gaussian")
        with torch.no_grad():
            lens = self.lens()
        like = lens.wavelengths
        if fields is not None:
            self.fields = field_points(fields, like=lens)
        else:
            self.fields = like.new_zeros(2, 1) if sensor is None else self._fields_of_sensor()
        self._places = None if sensor is None else sensor.landing(lens, self.fields).detach()
        warn_of_filling(lens, self.fields)
        pitch = like.new_tensor(0.005 if sensor is None else sensor.pitch)
        self.pixels = pixels if isinstance(pixels, Grid) else grid(pitch, pixels or 21)
        self.normalise, self.noise, self.tol, self.rho, self.network_dtype = normalise, noise, tol, rho, network_dtype
        self.pupil_points, self._order = pupil_points, None
        self.center, self.tolerances = center, tolerances
        self._check()
        self._memo = Memo(object_distances=object_distances)

    def _check_element(self) -> None:
        """Refuse elements without a sensor, and numbers of the other kind of camera. Raises ValueError, TypeError."""
        is_alone = isinstance(self.variables, PhaseVariables)
        if self.element is not None and not isinstance(self.element, PhaseVariables):
            raise TypeError(f"Camera: `element` is {named_value(self.element)}; expected PhaseVariables(element)")
        if is_alone and self.element is not None:
            raise ValueError("an element at the stop of an element: give others=… to its PhaseVariables")
        if is_alone != (self.sensor_distance is not None):
            needed = "give sensor_distance=…, mm" if is_alone else "leave sensor_distance out: the lens has it"
            raise ValueError(f"a camera {'of an element without' if is_alone else 'with'} a lens: {needed}")
        if self.wavelengths is not None and not is_alone:
            raise ValueError("wavelengths of a camera with a lens: give lens.at(wavelengths=…)")
        if self.sensor is None and (is_alone or self.element is not None):
            raise ValueError("a camera with a phase element: give sensor=rt.Sensor(…), whose pixels its kernels have")

    def lens(self) -> Lens:
        """The current lens; of an element without one, the stop that it is in."""
        if isinstance(self.variables, Variables):
            return self.variables()
        return element_in_stop(self.variables(), self.sensor, self.sensor_distance, self.wavelengths)

    def elements(self) -> tuple[Element, ...]:
        """The current phase elements, in contact."""
        element = self.variables if isinstance(self.variables, PhaseVariables) else self.element
        return () if element is None else element()

    def _check(self) -> None:
        """Refuse what cannot be simulated. Raises ValueError, BadTolerance."""
        check_model(self.model, self.elements())
        if self.center not in ("chief", "centroid"):
            raise ValueError(f"center {self.center!r}: expected chief or centroid")
        if self.center == "centroid" and self.pupil_points is not None:
            raise ValueError("windows of the rays of pupil_points are about the chief ray: give center chief")
        if self.sensor is not None and self.pupil_points is not None:
            raise ValueError("pupil_points and a sensor: the kernels of a sensor have as many rays as tol needs")
        if self.sensor is not None and (self.pixels.rows, self.pixels.columns) != (self.size, self.size):
            shape = f"{self.pixels.columns} × {self.pixels.rows}"
            raise ValueError(f"pixels {shape}: expected a square window of an odd number of pixels of the sensor")
        if self.tolerances is None:
            return
        if self.elements():
            raise ValueError("tolerances of a camera with a phase element: expected a lens alone")
        if not MODELS[self.model].traces:
            raise ValueError(f"model {self.model!r} traces no rays of a lens as built; expected gaussian, drt or wave")
        check_tolerances(self.variables.lens, self.tolerances)
        sensor_compensator(self.variables.lens, self.tolerances)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        values = self.fields, self.pixels, self.pupil_points, self._places
        self.fields, self.pixels, self.pupil_points, self._places = converted(values, fn)
        self._memo = Memo(object_distances=self.range)  # its rays are of the former dtype and device
        return super()._apply(fn, recurse)

    def _fields_of_sensor(self, shares: Sequence[float] = (0.0, 0.7, 1.0)) -> Tensor:
        """Field points (2, F) of shares of the way from the middle of the sensor to its corner, where there are any."""
        with torch.no_grad():
            fields = self.sensor.fields(self.lens(), self.sensor.on_diagonal(shares))
        return fields[:, ~fields.isnan().any(0)]

    @property
    def size(self) -> int:
        """Pixels across the PSF window."""
        return self.pixels.rows - (self.pixels.rows + 1) % 2

    def rates(self, *, optics: float, network: float, element: float | None = None) -> list[dict]:
        """Groups of parameters for an optimiser of torch, with rates of their own: of the variables and the network.

        element: of the heights of an element at the stop, by default that of the variables.
        """
        groups = [
            {"params": [*self.variables.parameters()], "lr": optics},
            {"params": [*self.network.parameters()], "lr": network},
        ]
        if self.element is not None:
            groups.append({"params": [*self.element.parameters()], "lr": optics if element is None else element})
        return groups

    # -- states that describe themselves -------------------------------------------------------------------------------

    def description(self) -> dict:
        """Lens, variables, sensor, window, model, network and versions, as plain values for JSON."""
        return {
            **self.variables.identity(),
            "element": None if self.element is None else self.element.identity(),
            "sensor_distance": self.sensor_distance,
            "sensor": None if self.sensor is None else plain(dataclasses.asdict(self.sensor)),
            "window": [self.pixels.rows, self.pixels.columns, float(self.pixels.pitch)],
            "model": self.model,
            "object_distances": list(self.range),
            "network": type(self.network).__name__,
            "versions": {"raytrace": metadata.version("raytrace"), "torch": torch.__version__},
        }

    def get_extra_state(self) -> Tensor:
        return encoded_text(self.description())

    def set_extra_state(self, state: Tensor) -> None:
        """Does nothing: a state is compared before it is loaded."""

    def _load_from_state_dict(self, state_dict, prefix, local_metadata, strict, missing, *lists) -> None:
        stored = state_dict.get(prefix + KEY)
        if stored is not None:
            before, now = decoded_text(stored), self.description()
            for name in ("sensor", "window", "sensor_distance"):
                if not alike(before.get(name), now[name]):
                    raise OtherLens(f"the state is of {_difference(name, before.get(name), now[name])}")
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, missing, *lists)
        if stored is None and prefix + KEY in missing:  # of an older version
            missing.remove(prefix + KEY)

    @property
    def margin(self) -> int:
        """Rows and columns by which the PSF window shrinks an image."""
        return self.pixels.rows - 1

    def use(self, model: str, pupil_points: Tensor | None = None) -> None:
        """Simulate with another PSF model; pupil_points: as for the constructor."""
        self.model, self.pupil_points, self._order = model, pupil_points, None
        self._check()

    def as_built(self, errors: Tensor | Sequence[float]) -> Lens:
        """The lens with errors (N,), or a lens for each row of (L, N), its sensor focused again."""
        if self.tolerances is None:
            raise ValueError("errors, but no tolerances: give Camera(…, tolerances=rt.tolerances(lens, grade=…))")
        return lens_as_built(self.variables(), self.tolerances, errors, self.fields)

    @torch.no_grad()
    def plan(self) -> int:
        """The order of the PSF model that meets the tolerance at the ends and the middle of the range."""
        near, far = self.range
        distances = self.fields.new_tensor([near, 2 / (1 / near + 1 / far), far])
        errors = None if self.tolerances is None else draw_errors(self.tolerances, len(distances))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotConverged)  # the finest order is used
            warnings.simplefilter("ignore", UnfilledStop)  # it was warned of at construction
            if self.sensor is not None:
                about = self.lens(), self.sensor, self.model, self._places, distances, self.size, self.tol
                self._order = order_of(*about, elements=self.elements())
                return self._order
            each = self.fields.split(1, 1)  # alone, as in `order_of`
            self._order = max(self._psf(distances, field, tol=self.tol, errors=errors).order for field in each)
        return self._order

    def kernels(
        self,
        object_distances: Tensor | Sequence[float] | float,
        field: int = 0,
        errors: Tensor | None = None,
        *,
        points: Tensor | None = None,
    ) -> Tensor:
        """PSFs (B, rows, columns) of object distances (B,) mm at one of the fields, in a window about its `center`.

        object_distances: a tensor, a sequence or one number.
        errors: of manufacture, (N,) of one lens or (B, N). points: (2, B) mm on the sensor, one for each distance: PSFs
        (B, C, rows, columns) of its channels, of sum 1 or the relative illumination, 0 where no light arrives, with the
        warning DarkPlaces. Raises ValueError for points that are not finite.
        """
        if (points is None) != (self.sensor is None):
            missing = "places of the images: give points=sensor.patch_points(…)" if self.sensor else "sensor: give none"
            raise ValueError(f"the camera has no {missing}")
        object_distances = self._distances(object_distances)
        if self.sensor is not None:
            if errors is not None:
                raise ValueError("errors of manufacture at places of a sensor: expected a camera without a sensor")
            return self._kernels_of_places(points.to(self.fields), object_distances)
        if self.pupil_points is not None:
            return self._kernels_of_points(object_distances, self.fields[:, [field]], errors)
        order = self.plan() if self._order is None else self._order
        parts = [(object_distances, errors)]
        if is_sampled_in_common(self.variables.lens, self.model):
            many = [errors] * len(object_distances) if errors is None or errors.dim() == 1 else errors.split(1)
            parts = zip(object_distances.expand(len(many)).split(1), many, strict=True)
        fields = self.fields[:, field : field + 1]
        return torch.cat([self._psf(z, fields, order=order, errors=some).kernel[:, 0] for z, some in parts])

    def kernels_over_field(self, object_distances: Tensor, points: Tensor | None = None) -> Tensor:
        """PSFs (Z, N, C, rows, columns) of object distances (Z,) mm at points (2, N) mm on the sensor.

        points: by default those of `fields` of the initial lens. Of sum 1, or the relative illumination.
        """
        points, distances = self._places if points is None else points, self._distances(object_distances)
        pairs = points.to(distances).repeat(1, len(distances)), distances.repeat_interleave(points.shape[1])
        return self._kernels_of_places(*pairs).unflatten(0, (len(distances), -1))

    def _kernels_of_places(self, points: Tensor, distances: Tensor) -> Tensor:
        """PSFs (B, C, rows, columns) of pairs of points (2, B) and distances (B,) mm."""
        return patch_kernels(
            self.lens(),
            points,
            sensor=self.sensor,
            size=self.size,
            order=self.plan() if self._order is None else self._order,
            model=self.model,
            object_distances=distances,
            illumination=self.illumination,
            elements=self.elements(),
        )

    def _distances(self, object_distances: Tensor | Sequence[float] | float) -> Tensor:
        """Object distances (B,) mm. Raises ValueError for none and for other shapes."""
        distances = torch.as_tensor(object_distances, dtype=self.fields.dtype, device=self.fields.device)
        if distances.dim() > 1 or not distances.numel():
            shape = tuple(distances.shape)
            raise ValueError(f"object_distances of shape {shape}: expected (B,) mm, one for each of B images, B ≥ 1")
        return distances.reshape(-1)

    def _lens(self, errors: Tensor | None) -> tuple[Lens, Memo | None]:
        """The current lens with its stored rays, or as built, whose rays are of one call."""
        return (self.variables(), self._memo) if errors is None else (self.as_built(errors), None)

    def _psf(
        self,
        distances: Tensor,
        fields: Tensor,
        *,
        tol: float | None = None,
        order: int | None = None,
        errors: Tensor | None = None,
    ):
        # First-order models have the same PSF at every field, about the paraxial chief ray, which differs from the
        # traced one by the distortion and by tilts.
        traces = MODELS[self.model].traces
        lens, memo = self._lens(errors)
        return psf(
            lens,
            Paraxial(self.rho, order) if self.model == "paraxial" else model_of(self.model, order=order),
            tol=tol,
            fields=fields if traces else torch.zeros_like(fields),
            object_distances=distances,
            grid=self.pixels,
            center=self.center if traces or self.center == "centroid" else "axis",
            normalise=self.normalise,
            execution=Execution(memo=memo),
        )

    def _kernels_of_points(self, distances: Tensor, fields: Tensor, errors: Tensor | None) -> Tensor:
        """PSFs (B, rows, columns) of the rays through the pupil points alone."""
        lens, memo = self._lens(errors)
        light = scene(lens, fields, distances, lens.wavelengths, memo)
        chief = chief_landing(dataclasses.replace(light, wavelengths=lens.primary[None]))
        centre = self.pixels.centre[:, None, None, None] + chief.expand(2, *light.shape)
        window = dataclasses.replace(self.pixels, centre=centre)
        points = self.pupil_points.to(fields)
        weights = torch.full_like(points[0], 1 / len(points[0]))
        if self.model == "drt":
            kernels = drt.kernels_of_points(light, window, points, weights, width=_RAY_WIDTH).kernel
        else:
            traced = trace_scene(light, points)
            arrives = torch.where(traced.valid, weights, 0.0).expand(*light.shape, -1)
            centroid, covariance = moments_of_rays(traced.position[:2].expand(2, *arrives.shape), arrives)
            mirrored = points * points.new_tensor([[-1.0], [1.0]])
            distance = (mirrored[:, :, None] - points[:, None]).abs().amax(0).amin(1)
            if symmetry(light) != "none" and bool((distance < 1e-12).all()):
                covariance = covariance[[0, 2]]  # xy is 0 but for rounding, and costs a quadrature over every pixel
            energy = arrives.sum(-1) * beam_share(light)
            kernels = energy[..., None, None] * gaussian_pixels(window, centroid, covariance)
        shares = lens.wavelength_weights / lens.wavelength_weights.sum()
        kernel = (kernels * shares[:, None, None]).sum(2)[:, 0]
        return safe_divide(kernel, kernel.sum((-2, -1), keepdim=True)) if self.normalise == "window" else kernel

    def image(
        self,
        picture: Tensor,
        object_distances: Tensor,
        field: int = 0,
        errors: Tensor | None = None,
        *,
        points: Tensor | None = None,
    ) -> Tensor:
        """The noise-free sensor image, (B, H - margin, W - margin), or (B, C, …) with a sensor.

        picture: (B, H, W), or (H, W) for all distances (B,), in [0, 1]; integers of 8 or 16 bits are scaled to that.
        With a sensor (B, C, H, W), centred at points (2, B) mm on it; integers are levels of sRGB (`linearised`).
        Pictures of half precision are blurred in float32, which the image has.
        errors: of manufacture, (N,) of one lens or (B, N).
        Raises ValueError for other shapes and other ranges, as 0 to 255.
        """
        object_distances = self._distances(object_distances)
        if self.sensor is None:
            picture = _grey(picture, object_distances)
        else:
            picture = self._of_channels(picture, object_distances)
        kernels = self.kernels(object_distances, field, errors, points=points)
        light = picture.to(torch.promote_types(picture.dtype, torch.float32))
        return blur(light, kernels.to(light.dtype))

    def _of_channels(self, picture: Tensor, object_distances: Tensor) -> Tensor:
        """Light (B, C, H, W) of pictures of the channels of the sensor, at object distances (B,)."""
        light = linearised(picture)
        expected = len(object_distances), len(self.sensor.channels)
        if light.dim() != 4 or tuple(light.shape[:2]) != expected:
            raise ValueError(
                f"pictures of shape {tuple(light.shape)}: expected ({expected[0]}, {expected[1]}, H, W), one for each "
                f"object distance, of the channels {', '.join(self.sensor.channels)} of the sensor"
            )
        return _in_range(light)

    def render(self, scene: Tensor, depth: Tensor | None = None, **options) -> Rendering:
        """The picture that the current lens projects onto the whole sensor, by the camera's PSF model: see `rt.render`.

        scene: (..., C, H, W) linear in light, of as many pixels as the sensor; depth: (H, W) mm; options: those of
        `rt.render`.
        """
        options = {"sensor": self.sensor, "model": self.model, **options}
        if not isinstance(self.variables, PhaseVariables):
            return render(self.variables(), scene, depth=depth, elements=self.elements(), **options)
        alone = {"sensor_distance": self.sensor_distance, "wavelengths": self.wavelengths, "size": self.size}
        return render(self.elements(), scene, depth=depth, **{**alone, **options})

    def restore(self, image: Tensor) -> Tensor:
        """The network's estimate (B, h, w), or (B, C, h, w) with a sensor, from a noisy image."""
        is_grey = self.sensor is None
        with torch.autocast(image.device.type, self.network_dtype, enabled=self.network_dtype is not None):
            image = as_picture(image, "image")
            like = next((p.dtype for p in self.network.parameters() if p.is_floating_point()), image.dtype)
            stack = (image[:, None] if is_grey else image).to(like, memory_format=torch.channels_last)
            restored = self.network(stack).to(image.dtype)
            return restored[:, 0] if is_grey else restored

    def forward(
        self,
        picture: Tensor,
        object_distances: Tensor,
        *,
        field: int = 0,
        noise: Tensor | None = None,
        generator: torch.Generator | None = None,
        errors: Tensor | None = None,
        points: Tensor | None = None,
        index: Tensor | Sequence[int] | None = None,
        seed: int = 0,
    ) -> Tensor:
        """Blur, add noise, restore. noise: (B, h, w) of unit deviation, instead of random noise.

        errors: of manufacture, (N,) of one lens or (B, N). points: (2, B) mm on the sensor, of the images' centres;
        index, seed: of its noise, see `Sensor.capture`.
        """
        image = self.image(picture, object_distances, field, errors, points=points)
        if self.sensor is not None:
            return self.restore(self.recorded(image, points, index, seed))
        if noise is None:
            return self.restore(add_noise(image, self.noise, generator=generator))
        return self.restore(image + self.noise * noise)

    def recorded(
        self, image: Tensor, points: Tensor, index: Tensor | Sequence[int] | None = None, seed: int = 0
    ) -> Tensor:
        """The sensor's record (B, C, h, w) of noise-free images, interpolated where it has a mosaic.

        points: (2, B) mm of their centres; index, seed: of the noise, see `Sensor.capture`.
        """
        size = image.new_tensor([image.shape[-1], image.shape[-2]], dtype=torch.float64)
        first = self.sensor.pixel_of(points.detach().to(size)).T - 0.5 * (size - 1)
        origin = (first + 1e-6).floor().long()
        return self.sensor.demosaic(self.sensor.capture(image, index, seed, origin), origin)

    def target(self, picture: Tensor) -> Tensor:
        """The ideal output: the image without its margin; with a sensor as light."""
        picture = as_picture(picture) if self.sensor is None else linearised(picture)
        rows, columns = self.pixels.rows // 2, self.pixels.columns // 2
        bottom, right = self.pixels.rows - 1 - rows, self.pixels.columns - 1 - columns
        return picture[..., rows : picture.shape[-2] - bottom, columns : picture.shape[-1] - right]


def _difference(name: str, before: object, now: object) -> str:
    """The first difference of a stored sensor or window from this one."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in now:
            if not alike(before.get(key), now[key]):
                return f"a sensor of {key} {before.get(key)}, not {now[key]}"
    return f"a camera of {name} {before}, not {now}"


def _grey(picture: Tensor, object_distances: Tensor) -> Tensor:
    """Pictures (B, H, W) or (H, W) of object distances (B,) in [0, 1]."""
    picture = as_picture(picture)
    shape, count = tuple(picture.shape), len(object_distances)
    if not (picture.dim() == 2 or (picture.dim() == 3 and (count == 1 or shape[0] in (1, count)))):
        raise ValueError(
            f"pictures of shape {shape} at {count} object distances: expected grey ones (B, H, W), one for each "
            "distance; colours are a batch, as picture.flatten(0, 1) with distances.repeat_interleave(3)"
        )
    return _in_range(picture)


def _in_range(picture: Tensor) -> Tensor:
    """Raises ValueError for pictures far above 1."""
    if (most := float(picture.detach().max())) > _LARGEST:
        raise ValueError(
            f"a picture with values up to {most:g}: expected 0 to 1, as the noise is; divide it by its white"
        )
    return picture

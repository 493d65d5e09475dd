"""Camera: a lens with variables, a sensor and a restoration network as one module.

A training step of lens and network, in colour, at random places of the sensor:

    lens = rt.read_lens("cooke_triplet")
    sensor = rt.Sensor(size=(24, 16), pixels=(4800, 3200), response="rgb", full_well=2e4, read_noise=3)
    camera = rt.Camera(rt.Variables(lens, "curvature thickness"), rt.imaging.UNet(channels=3), sensor=sensor)
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

Alternatively `lens_step` takes second-order steps of the lens within bounds and conditions; torch trains the network:

    def loss():
        return (camera(pictures, distances, points=points, index=index) - camera.target(pictures)).abs().mean()

    camera.lens_step(loss)

Monochrome images (B, H, W) at field points, which are selected by their index:

    grey = rt.Sensor(size=(1, 1), pixels=(200, 200), read_noise=0.1)
    camera = rt.Camera(rt.Variables(lens, "sensor"), rt.imaging.RedNet(), sensor=grey, fields=[0, 14])
    restored = camera(torch.rand(2, 64, 64), [25e3, 30e3], field=[0, 1])              # (B, 1, 44, 44)

A phase element at the stop, whose heights are learned with the lens, or an element without a lens:

    camera = rt.Camera(rt.Variables(lens, "sensor"), network, element=rt.imaging.PhaseVariables(element), sensor=sensor)
    camera = rt.Camera(rt.imaging.PhaseVariables(element), network, sensor_distance=35.5, sensor=sensor)

For a phase element without a lens, pictures may be periodic:

    camera = rt.Camera(…, boundary="circular", normalise="haze", filter=DepthInvariantFilter(spectrum, distances))
"""

import dataclasses
import functools
import warnings
from collections.abc import Callable, Sequence
from importlib import metadata
from typing import Any, Generic, Literal, Self, TypeVar, cast, get_args

import numpy as np
import torch
from torch import Tensor, nn

from raytrace.imaging.built_lens import lens_as_built, sensor_compensator
from raytrace.imaging.camera_filters import LinearFilter
from raytrace.imaging.field_kernels import (
    ElementKernels,
    EnergyOutside,
    FieldKernels,
    KernelSum,
    Model,
    Normalisation,
    by_angle,
    check_model,
    check_points,
    has_points,
    of_sum_1,
    order_of,
    warn_of_dark_places,
)
from raytrace.imaging.image import (
    BOUNDARIES,
    as_picture,
    blur,
    linearised,
    pixel_means,
    pixel_transfer,
    transfer_functions,
)
from raytrace.imaging.lens_steps import LensSteps
from raytrace.imaging.render import Rendering, element_in_stop, illumination_at, render
from raytrace.imaging.restoration import restore
from raytrace.imaging.sensor import Sensor
from raytrace.imaging.variables import KEY, OtherLens, PhaseVariables, Variables, converted, decoded_text, encoded_text
from raytrace.maths.numerics import as_tensor
from raytrace.maths.result import plain
from raytrace.psf_models import MODELS, NotConverged, model_name, model_of, name_of
from raytrace.system.identity import alike
from raytrace.system.lens import Lens, field_points
from raytrace.tolerancing.perturbation import check_tolerances
from raytrace.tolerancing.sampling import draw_errors
from raytrace.tolerancing.table import ToleranceTable
from raytrace.tracing.focus import NoImage, real_image_distance
from raytrace.tracing.geometry import Unbuildable, defects
from raytrace.tracing.launch import UnfilledStop, warn_of_filling
from raytrace.tracing.scene import Memo
from raytrace.wave_optics.element import Element
from raytrace.wave_optics.plan import Plan
from raytrace.wave_optics.plan import plan as sampling_plan
from raytrace.words import calling_level, former_name, named_value

#: The variables of a camera: of a lens, or of a phase element without one.
V = TypeVar("V", bound=Variables | PhaseVariables)
F = TypeVar("F", bound=Callable[..., Any])

_NEAREST = 0.01  # fraction of the nearest object distance of a camera; smaller distances indicate a wrong unit
_OUTSIDE = 0.1  # of the light outside the window, which kernels of sum 1 hide
_LARGEST = 2.0  # allowed value of an image in [0, 1]: resampling overshoots


def uncompiled(function: F) -> F:
    """A function that `torch.compile` does not enter: a graph ends before it, and the next one begins behind it.

    `torch.compiler.disable` alone imports the compiler, which takes seconds.
    """

    @functools.wraps(function)
    def call(*arguments: Any, **options: Any) -> Any:
        if torch.compiler.is_dynamo_compiling():
            return torch.compiler.disable(function)(*arguments, **options)
        return function(*arguments, **options)

    return cast(F, call)


class Camera(nn.Module, Generic[V]):
    """Simulated capture and restoration of images in [0, 1], each at its own object distance and place.

    Images are (B, C, H, W), linear in light, of the C channels of the sensor's response; of one channel also (B, H, W),
    or (H, W) for all object distances.

    variables: `Variables` of a lens, or `PhaseVariables` of a phase element without a lens, which is `sensor_distance`
    mm before the sensor, at wavelengths (W,) µm as for `render`; exact: its spherical wavefronts instead of the Fresnel
    approximation. element: `PhaseVariables` of an element at the stop of the lens. network: maps (B, C, h, w) to the
    same shape. sensor: gives the images its response, noise, quantisation and mosaic; by default `rt.Sensor()`,
    monochrome and without noise. Whole pictures: see `render`.
    model: a PSF model or its name, by default "gaussian", with elements "wave". Gaussian(rays=points) and
    DRT(rays=points) take the rays of these pupil points, instead of as many as `tol` needs.
    object_distances: smallest and largest, mm; fields: (2, F), or a list of y or (x, y), in the lens's kind of field,
    whose image positions follow the chief ray while the lens changes. Default: 0, 0.7 and 1 of the half diagonal of the
    sensor, fixed on the sensor; on axis without a sensor.
    oversampling: pixels of pictures and PSFs across a pixel of the sensor, which records their mean: for
    super-resolution, whose network maps (B, C, h, w) to the pixels of the picture, s h × s w.
    pixels: across the PSF window, those of pictures, an odd number, 21 by default.
    center: of the PSF window, "chief" (the chief ray) or "centroid" (of the light, as `psf`), which the window follows,
    so that displacement of the image is not counted as blur. normalise: "window" (PSFs of sum 1; `energy_outside` is
    the share of the light that they leave out) or "energy" (the sum is the share of the light through the entrance
    pupil); of elements alone also "haze": as "energy", and the light outside the window becomes a uniform background.
    boundary: of pictures, as for `blur`: "valid", images are smaller by `margin`; "circular", pictures are periods of
    an endless one; or they are extended. illumination: images have the relative illumination of their places, too.
    filter: of elements alone, a linear filter of the image before the network, computed from the PSFs at its object
    distances (`camera_filters`).
    tol: allowed error of the kernels: the order of the PSF model is chosen once, for the lens at the first call
    (`plan`); with elements alone each call chooses its sampling until `plan` fixes it.
    network_dtype: torch.bfloat16 runs the network in it (autocast); the optics keep the dtype of the lens.
    tolerances: manufacturing tolerances. Calls then accept `errors` of `draw_errors(tolerances, …)`, (N,) for one
    perturbed lens or (B, N), one lens per image. If the sensor distance is the compensator of the tolerances, each lens
    is refocused by the shift of its best focus over the fields.
    The object is planar and upright; image inversion and magnification are ignored. `state_dict` describes the lens,
    its variables and the sensor, and loads only into a camera with the same ones; it holds the order of the PSF model
    and the curvature of `lens_step`, so that a resumed training is bit-identical.
    Warns UnfilledStop once, for the lens at construction.
    """

    variables: V
    element: PhaseVariables | None
    network: nn.Module
    filter: LinearFilter | None
    _order: int | None
    _sampling: Plan | None
    psf_parameters: Model | None

    def __init__(
        self,
        variables: V,
        network: nn.Module | None = None,
        *,
        sensor: Sensor | None = None,
        element: PhaseVariables | None = None,
        sensor_distance: float | None = None,
        wavelengths: Sequence[float] | None = None,
        exact: bool = False,
        model: str | Model | None = None,
        object_distances: tuple[float, float] = (1e4, 5e4),
        fields: Tensor | Sequence | None = None,
        oversampling: int = 1,
        pixels: int = 21,
        center: Literal["chief", "centroid"] = "chief",
        normalise: Normalisation = "window",
        boundary: Literal["valid", "circular", "zero", "reflect", "taper"] = "valid",
        illumination: bool = False,
        filter: LinearFilter | None = None,
        tol: float = 1e-2,
        network_dtype: torch.dtype | None = None,
        tolerances: ToleranceTable | None = None,
    ):
        super().__init__()
        if not isinstance(variables, Variables | PhaseVariables):
            kind = named_value(variables)
            expected = "the Variables of a lens: Variables(lens, …), or of an element: PhaseVariables(element)"
            raise TypeError(f"Camera: `variables` is {kind}; expected {expected}")
        if network is None:
            raise TypeError(
                "Camera: `network` is missing: give a module, as rt.imaging.RedNet() or torch.nn.Identity(); a "
                "photograph alone is rt.render(lens, picture)"
            )
        self.variables, self.element, self.network = variables, element, network
        self._steps: LensSteps | None = None
        self.range, self.sensor, self.illumination = object_distances, sensor or Sensor(), illumination
        self.sensor_distance, self.wavelengths, self.exact = sensor_distance, wavelengths, exact
        self.boundary, self.filter, self.oversampling = boundary, filter, oversampling
        self._check_element()
        with torch.no_grad():
            lens = self.lens()
            self._check_range(lens)
        if fields is None and sensor is None:
            fields = [0]
        #: Field points (2, F) of the places that `field` numbers, and their points (2, F) mm where these stay.
        self.fields = self._fields_of_sensor() if fields is None else field_points(fields, like=lens)
        self.points = self.sensor.landing(lens, self.fields).detach() if fields is None else None
        warn_of_filling(lens, self.fields)
        self.size, self.center, self.normalise = pixels, center, normalise
        self.tol, self.network_dtype, self.tolerances = tol, network_dtype, tolerances
        self.use(model or ("wave" if self.elements() else "gaussian"))
        self._memo = Memo(object_distances=object_distances)
        self._has_warned = self._is_unbuildable = False  # EnergyOutside and Unbuildable are each said once

    def _check_element(self) -> None:
        """Refuse options of the other kind of camera, with a lens or without. Raises ValueError, TypeError."""
        is_alone = isinstance(self.variables, PhaseVariables)
        if self.element is not None and not isinstance(self.element, PhaseVariables):
            raise TypeError(f"Camera: `element` is {named_value(self.element)}; expected PhaseVariables(element)")
        if is_alone and self.element is not None:
            raise ValueError(
                "variables and element are both phase elements: give the second one as PhaseVariables(…, others=…)"
            )
        if is_alone != (self.sensor_distance is not None):
            raise ValueError(
                "a phase element without a lens requires sensor_distance=…, mm"
                if is_alone
                else "a lens defines the sensor distance: leave sensor_distance out"
            )
        if self.wavelengths is not None and not is_alone:
            raise ValueError("wavelengths applies only to a phase element without a lens: give lens.at(wavelengths=…)")
        if not is_alone and (self.exact or self.filter is not None):
            option = "exact" if self.exact else "filter"
            raise ValueError(f"{option} applies only to a phase element without a lens: leave {option} out")

    def _check_range(self, lens: Lens) -> None:
        """Refuse a range of object distances that has no real image on the sensor's side. Raises ValueError."""
        near, far = self.range
        if not (abs(near) > 0 and abs(far) > 0):
            raise ValueError(f"object_distances {near:g} to {far:g} mm: expected distances in mm, not 0")
        if self.elements():
            return  # which may focus the light
        try:
            real_image_distance(lens, lens.wavelengths.new_tensor(self.range))
        except NoImage as error:
            raise NoImage(
                f"object_distances {near:g} to {far:g} mm: {error}; give the range of the scene in mm"
            ) from None

    @property
    def picture_sensor(self) -> Sensor:
        """The sensor with pixels as small as those of pictures, over which PSFs are integrated."""
        if self.oversampling == 1:
            return self.sensor
        columns, rows = self.sensor.pixels
        return dataclasses.replace(self.sensor, pixels=(self.oversampling * columns, self.oversampling * rows))

    def lens(self) -> Lens:
        """The current lens; of an element without one, the stop that it is in."""
        if isinstance(self.variables, Variables):
            return self.variables()
        return element_in_stop(self.variables(), self.sensor, self.sensor_distance, self.wavelengths)

    def elements(self, *, draw: torch.Generator | None = None) -> tuple[Element, ...]:
        """The current phase elements, in contact; draw: generator of errors of fabrication."""
        element = self.variables if isinstance(self.variables, PhaseVariables) else self.element
        return () if element is None else element(draw=draw)

    def _check(self) -> None:
        """Refuse options that cannot be simulated. Raises ValueError, BadTolerance."""
        check_model(self.model, self.elements())
        for name, word, known in (
            ("center", self.center, ("chief", "centroid")),
            ("normalise", self.normalise, get_args(Normalisation)),
            ("boundary", self.boundary, BOUNDARIES),
        ):
            if word not in known:
                raise ValueError(f"{name} {word!r}: expected {' or '.join(known)}")
        if isinstance(self.size, bool) or not isinstance(self.size, int) or self.size < 1 or self.size % 2 == 0:
            raise ValueError(f"pixels {self.size!r}: expected an odd integer ≥ 1, the width of the PSF window")
        if self.center == "centroid" and has_points(self.psf_parameters):
            raise ValueError("center centroid is not supported with fixed pupil points (rays): give center chief")
        if self.elements() and self.center != "chief":
            raise ValueError(f"center {self.center!r} is not supported with a phase element: leave center out")
        if self.element is not None and self.normalise != "window":
            raise ValueError(
                f"normalise {self.normalise!r} is not supported with a phase element at the stop, whose PSFs have sum "
                "1: leave normalise out"
            )
        if isinstance(self.oversampling, bool) or not isinstance(self.oversampling, int) or self.oversampling < 1:
            raise ValueError(f"oversampling {self.oversampling!r}: expected an integer ≥ 1")
        if self.oversampling > 1 and self.filter is not None:
            raise ValueError("filter with oversampling: its formula has no aliases; leave filter out")
        if self.normalise == "haze" and (self.illumination or not isinstance(self.variables, PhaseVariables)):
            raise ValueError("normalise 'haze': expected an element without a lens, and no illumination")
        if self.tolerances is None:
            return
        if self.elements() or not isinstance(self.variables, Variables):
            raise ValueError("tolerances of a camera with a phase element: expected a lens alone")
        if not MODELS[self.model].traces:
            raise ValueError(f"model {self.model!r} traces no rays of a lens as built; expected gaussian, drt or wave")
        check_tolerances(self.variables.lens, self.tolerances)
        sensor_compensator(self.variables.lens, self.tolerances)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        self.fields, self.points, self.psf_parameters = converted((self.fields, self.points, self.psf_parameters), fn)
        self._memo = Memo(object_distances=self.range)  # its rays are of the former dtype and device
        return super()._apply(fn, recurse)

    def _fields_of_sensor(self, shares: Sequence[float] = (0.0, 0.7, 1.0)) -> Tensor:
        """Field points (2, F) at shares of the half diagonal of the sensor; points without a chief ray are left out."""
        with torch.no_grad():
            fields = self.sensor.fields(self.lens(), self.sensor.on_diagonal(shares))
        return fields[:, ~fields.isnan().any(0)]

    def rates(self, *, optics: float, network: float, element: float | None = None) -> list[dict]:
        """Parameter groups for an optimiser of torch: the variables and the network, each with its learning rate.

        element: learning rate of the heights of an element at the stop, by default the rate of the variables.
        """
        groups = [
            {"params": [*self.variables.parameters()], "lr": optics},
            {"params": [*self.network.parameters()], "lr": network},
        ]
        if self.element is not None:
            groups.append({"params": [*self.element.parameters()], "lr": optics if element is None else element})
        return groups

    def lens_step(self, loss: Callable[[], Tensor]) -> float:
        """Take one second-order step of the lens variables that lowers a loss; returns the loss before the step.

        loss: a function without arguments, as
        lambda: (camera(pictures, distances, index=index) - camera.target(pictures)).square().mean(). It is also
        evaluated at trial lenses: give `index`, so that all have the same noise. The step is within the bounds and
        meets the conditions of the variables, without `project`; an optimiser of the network takes its steps in
        between. Warns Unbuildable once where a step leads to a lens that cannot be made, as the loss and the conditions
        allow it.
        """
        if not isinstance(self.variables, Variables):
            raise ValueError("lens_step: the camera has a phase element without a lens; take a step of its heights")
        if self._steps is None:
            self._steps = LensSteps(self.variables)
        before = self._steps.step(loss)
        self._warn_of_defects(self.variables())
        return before

    def _warn_of_defects(self, lens: Lens) -> None:
        """Warn once of a lens that cannot be made."""
        if not self._is_unbuildable and (defect := next(iter(defects(lens)), None)):
            self._is_unbuildable = True
            advice = "give Variables(…, hold='buildable'), or add camera.variables.violation() to the loss"
            warnings.warn(
                f"{defect}; no limit of thicknesses is met: {advice}", Unbuildable, stacklevel=calling_level()
            )

    @uncompiled
    def _warn_of_negative_gaps(self, lens: Lens) -> None:
        """Warn once of a lens that cannot be made, after a training has turned the sign of a thickness."""
        if self._is_unbuildable or not isinstance(self.variables, Variables):
            return
        lenses = lens, self.variables.lens
        now, start = (torch.stack([s.thickness.detach() for s in each.surfaces[1:-1]]) for each in lenses)
        if bool(((now < 0) & (start >= 0)).any()):  # all defects take longer to find than kernels
            self._warn_of_defects(lens)

    def __getstate__(self) -> dict:
        """The state without the step history of `lens_step`."""
        return {**vars(self), "_steps": None}

    # -- states that describe themselves -------------------------------------------------------------------------------

    def description(self) -> dict:
        """Lens, variables, sensor, window, model, network and versions, as plain values for JSON."""
        return {
            **self.variables.identity(),
            "element": None if self.element is None else self.element.identity(),
            "sensor_distance": self.sensor_distance,
            "sensor": plain(dataclasses.asdict(self.sensor)),
            "window": [self.size, self.size, self.picture_sensor.pitch],
            "model": self.model,
            "object_distances": list(self.range),
            "network": type(self.network).__name__,
            "versions": {"raytrace": metadata.version("raytrace"), "torch": torch.__version__},
        }

    def get_extra_state(self) -> Tensor:
        """The description, the sampling of the PSFs as `plan` fixed it, and the curvature that `lens_step` knows."""
        return encoded_text(
            {
                **self.description(),
                "order": self._order,
                "sampling": self._sampling and dataclasses.asdict(self._sampling),
                "lens_steps": self._steps and self._steps.memory(),
            }
        )

    def set_extra_state(self, state: Tensor) -> None:
        """Resume with the sampling of the PSFs and the steps of the lens of the state, which was compared before.

        An order that the parameters of the PSF model give remains.
        """
        stored = decoded_text(state)
        if stored["model"] == self.model and getattr(self.psf_parameters, "order", None) is None:
            self._order = stored.get("order", self._order)
        if sampling := stored.get("sampling"):
            self._sampling = Plan(**{**sampling, "band": tuple(sampling["band"])})
        self._steps = None
        if isinstance(self.variables, Variables) and (memory := stored.get("lens_steps")) is not None:
            self._steps = LensSteps(self.variables, memory)

    def _load_from_state_dict(
        self, state_dict: dict, prefix: str, local_metadata: dict, strict: bool, missing: list[str], *lists: list[str]
    ) -> None:
        stored = state_dict.get(prefix + KEY)
        if stored is not None:
            before, now = decoded_text(stored), self.description()
            for name in ("sensor", "window", "sensor_distance"):
                if not alike(before.get(name), now[name]):
                    raise OtherLens(_difference(name, before.get(name), now[name]))
        super()._load_from_state_dict(state_dict, prefix, local_metadata, strict, missing, *lists)
        if stored is None and prefix + KEY in missing:  # of an older version
            missing.remove(prefix + KEY)

    @property
    def margin(self) -> int:
        """Rows and columns, in pixels of the picture, by which the PSF window shrinks an image."""
        return self.size - 1 if self.boundary == "valid" else 0

    def use(self, model: str | Model) -> None:
        """Simulate with another PSF model, given by its name or with its parameters."""
        if isinstance(model, str):
            self.model = model_name(model)
            self.psf_parameters = model_of(self.model)
        else:
            self.model, self.psf_parameters = name_of(model), model
        self._order, self._sampling = getattr(self.psf_parameters, "order", None), None
        self._check()

    def as_built(self, errors: Tensor | Sequence[float]) -> Lens:
        """The lens with errors (N,), or a lens for each row of (L, N), refocused by its sensor distance."""
        return self._built(self.lens(), errors)

    def _built(self, lens: Lens, errors: Tensor | Sequence[float]) -> Lens:
        if self.tolerances is None:
            raise ValueError("errors, but no tolerances: give Camera(…, tolerances=rt.tolerances(lens, grade=…))")
        return lens_as_built(lens, self.tolerances, errors, self.fields)

    @torch.no_grad()
    def plan(self, object_distances: Tensor | Sequence[float] | None = None, **sampling: Any) -> int:
        """The order of the PSF model that meets the tolerance at object distances (Z,) mm.

        By default at the ends and the middle of the range. With elements alone their sampling is fixed; the order is 0.
        sampling: of elements alone, engine, samples, nodes and tol as for `wave_optics.plan.plan`.
        """
        near, far = self.range
        default_distances = (near, 2 / (1 / near + 1 / far), far)
        distances = self._distances(default_distances if object_distances is None else object_distances)
        if isinstance(self.variables, PhaseVariables):
            self._sampling = sampling_plan(self.element_kernels(distances).scene, **sampling)
            return 0
        if sampling:
            raise TypeError(f"{next(iter(sampling))} applies only to a phase element without a lens: leave it out")
        lens = self.lens()
        if self.tolerances is not None:
            lens = self.as_built(draw_errors(self.tolerances, len(distances)))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotConverged)  # the finest order is used
            warnings.simplefilter("ignore", UnfilledStop)  # it was warned of at construction
            self._order = order_of(
                lens, self.picture_sensor, self.model, self.fields, distances, self.size, self.tol,
                elements=self.elements(), center=self.center, parameters=self.psf_parameters,
            )  # fmt: skip
        return self._order

    def element_kernels(
        self, object_distances: Tensor | Sequence[float], *, draw: torch.Generator | None = None
    ) -> ElementKernels:
        """Kernels of the current elements without a lens, at object distances (D,) mm; draw: as for `elements`."""
        distances, elements = self._distances(object_distances), self.elements(draw=draw)
        lens = element_in_stop(elements, self.sensor, self.sensor_distance, self.wavelengths)
        weights = self.sensor.weights(lens.wavelengths, lens.wavelength_weights).to(distances)
        sensor, how = self.picture_sensor, (self.exact, self.normalise, self._sampling, self._memo)
        return ElementKernels(lens, elements, sensor, self.size, distances, weights, *how)

    @uncompiled
    def kernels(
        self,
        object_distances: Tensor | Sequence[float] | float,
        field: int | Sequence[int] = 0,
        errors: Tensor | None = None,
        *,
        points: Tensor | None = None,
        draw: torch.Generator | None = None,
    ) -> Tensor:
        """PSFs (B, C, rows, columns) of object distances (B,) mm, of the channels of the sensor.

        object_distances: a tensor, a sequence, or one number for all images. field: index of one of the camera's
        `fields`, or (B,) indices; points: instead, sensor positions (2, B) mm. errors: of manufacture, (N,) of one
        lens or (B, N); the object points are those that the nominal lens images at these positions. PSFs are 0 where no
        light arrives, with the warning DarkPlaces. Of PSFs of sum 1, EnergyOutside warns once, where more than 10 % of
        the light is outside the window. draw: of an element alone, generator of errors of fabrication. Raises
        ValueError for positions beyond the sensor and other shapes.
        """
        is_of_sum_1 = self.normalise == "window"
        kernels, lens, points = self._kernels(
            object_distances, field, errors, points, "arrived" if is_of_sum_1 else self.normalise, draw
        )
        if is_of_sum_1:
            self._warn_of_energy_outside(kernels.detach().sum((-2, -1)))
            kernels = of_sum_1(kernels)
        if points is None and (self.illumination or bool((kernels.detach() == 0).all((1, 2, 3)).any())):
            points = self.sensor.landing(lens, self._of_field(self.fields, field, len(kernels)))
        if points is not None:
            warn_of_dark_places(kernels, points)
        if self.illumination and points is not None:
            kernels = kernels * illumination_at(lens, self.sensor, points)[:, None, None, None]
        return kernels

    def energy_outside(
        self,
        object_distances: Tensor | Sequence[float] | float,
        field: int | Sequence[int] = 0,
        errors: Tensor | None = None,
        *,
        points: Tensor | None = None,
    ) -> Tensor:
        """Shares (B, C) of the light on the sensor plane that are outside the windows of PSFs; arguments as for
        `kernels`.

        Differentiable, as for a penalty in a training. Light that is vignetted does not count; 1 where none arrives.
        """
        kernels = self._kernels(object_distances, field, errors, points, "arrived")[0]
        return (1 - kernels.sum((-2, -1))).clamp_min(0.0)

    def _warn_of_energy_outside(self, inside: Tensor) -> None:
        """Warn once of windows with a share (B, C) of the light, of which they hold too little."""
        least = float(torch.where(inside > 0, inside, 1.0).min())  # DarkPlaces warns of 0
        if least > 1 - _OUTSIDE or self._has_warned:
            return
        self._has_warned = True
        warnings.warn(
            f"{100 * (1 - least):.0f} % of the light are outside the PSF window of {self.size} pixels, and kernels of "
            "sum 1 leave them out: focus the lens, give more pixels, or normalise='energy'; camera.energy_outside(…) "
            "gives the share",
            EnergyOutside,
            stacklevel=calling_level(),
        )

    def _kernels(
        self,
        object_distances: Tensor | Sequence[float] | float,
        field: int | Sequence[int],
        errors: Tensor | None,
        points: Tensor | None,
        normalise: KernelSum,
        draw: torch.Generator | None = None,
    ) -> tuple[Tensor, Lens, Tensor | None]:
        """PSFs as of `kernels`, of other sums, without illumination; the lens; points of the sensor, if known."""
        distances, nominal = self._distances(object_distances), self.lens()
        if len(distances) == 1:  # of all places
            distances = distances.expand(points.shape[-1] if isinstance(points, Tensor) else np.size(field))
        lens, count = nominal, len(distances)
        self._warn_of_negative_gaps(nominal)
        if points is None and self.points is not None:
            points = self._of_field(self.points, field, count)
        if points is not None:
            check_points(points, count)
            self._check_on_sensor(points)
            points, lens = points.to(self.fields), by_angle(nominal)
        built = None if errors is None else self._built(nominal, errors)
        kernel_source: FieldKernels | ElementKernels
        if isinstance(self.variables, PhaseVariables):
            kernel_source = self.element_kernels(distances, draw=draw)
        else:
            kernel_source = FieldKernels(
                lens,
                self.picture_sensor,
                self.model,
                self.plan() if self._order is None else self._order,
                self.size,
                distances,
                self.sensor.weights(lens.wavelengths, lens.wavelength_weights).to(distances),
                elements=self.elements(),
                parameters=self.psf_parameters,
                center=self.center,
                memo=self._memo if points is None and errors is None else None,
            )
        kernel_source = dataclasses.replace(kernel_source, normalise=normalise)
        if isinstance(kernel_source, ElementKernels):  # shift-invariant PSF
            kernels = kernel_source.paired(self.fields)
        elif errors is None and points is not None:
            kernels = kernel_source.paired(points)
        else:
            at_field = self._of_field(self.fields, field, count)
            fields = at_field if points is None else self.sensor.fields(lens, points)
            if built is not None:
                if built.count not in (None, count):
                    raise ValueError(
                        f"errors of {built.count} lenses at {count} object distances: expected one for each"
                    )
                kernel_source = dataclasses.replace(
                    kernel_source, lens=by_angle(built) if points is not None else built
                )
            arrives = ~fields.isnan().any(0)
            kernels = kernel_source.of_pairs(fields.nan_to_num(0.0))
            kernels = torch.where(arrives[:, None, None, None], kernels, 0.0)
        return kernels, lens, points

    @staticmethod
    def _of_field(places: Tensor, field: int | Sequence[int], count: int) -> Tensor:
        """Places (2, B), of the camera's (2, F), at one number of a field, or at one for each of B images."""
        numbers, most = as_tensor(field), places.shape[1]
        if numbers.numel() not in (1, count) or not bool(((-most <= numbers) & (numbers < most)).all()):
            expected = f"the number of a field, 0 to {most - 1}, or one for each of {count} images"
            raise ValueError(f"field {numbers.tolist()}: expected {expected}")
        return places[:, numbers.to(places.device).expand(count)]

    def kernels_over_field(
        self,
        object_distances: Tensor | Sequence[float],
        points: Tensor | None = None,
        *,
        draw: torch.Generator | None = None,
    ) -> Tensor:
        """PSFs (Z, N, C, rows, columns) of object distances (Z,) mm at the camera's fields, or at points (2, N) mm."""
        distances = self._distances(object_distances)
        if points is not None:
            check_points(points, np.shape(points)[-1])
        count = self.fields.shape[1] if points is None else points.shape[1]
        each, places = distances.repeat_interleave(count), [*range(count)] * len(distances)
        if points is None:
            kernels = self.kernels(each, places, draw=draw)
        else:
            kernels = self.kernels(each, points=points.to(distances)[:, places], draw=draw)
        return kernels.unflatten(0, (len(distances), -1))

    def _check_on_sensor(self, points: Tensor) -> None:
        """Raise ValueError for points (2, B) mm beyond the edges of the sensor."""
        corners = self.sensor.corners.to(points)
        middle, half = corners.mean(1, keepdim=True), 0.5 * (corners.amax(1) - corners.amin(1))[:, None]
        beyond = ((points.detach() - middle).abs() > (1 + 1e-6) * half).any(0)
        if bool(beyond.any()):
            x, y = points.detach()[:, beyond][:, 0].tolist()
            width, height = self.sensor.size
            transposed = points.T if tuple(points.shape) == (2, 2) else points.flip(0)
            is_swapped = bool(((transposed.detach() - middle).abs() <= (1 + 1e-6) * half).all())
            advice = "; expected points (2, B), all x and then all y" if is_swapped else ""
            raise ValueError(
                f"a point at ({x:g}, {y:g}) mm is beyond the edges of the sensor of {width:g} x {height:g} mm{advice}"
            )

    @uncompiled
    def _distances(self, object_distances: Tensor | Sequence[float] | float) -> Tensor:
        """Object distances (B,) mm. Raises ValueError for none and for other shapes."""
        distances = torch.as_tensor(object_distances, dtype=self.fields.dtype, device=self.fields.device)
        if distances.dim() > 1 or not distances.numel():
            shape = tuple(distances.shape)
            raise ValueError(f"object_distances of shape {shape}: expected (B,) mm, one for each of B images, B ≥ 1")
        if not bool((distances.detach().abs() > 0).all()):
            raise ValueError(f"object distances {distances.detach().tolist()}: expected distances in mm, not 0 or nan")
        near = min(self.range)
        if bool((distances.detach().abs() < _NEAREST * near).any()):
            least = float(distances.detach().abs().min())
            raise ValueError(
                f"object distance {least:g} mm is below {100 * _NEAREST:g} % of the camera's range, {near:g} to "
                f"{max(self.range):g} mm: give mm, or Camera(…, object_distances=(nearest, furthest))"
            )
        return distances.reshape(-1)

    def image(
        self,
        picture: Tensor,
        object_distances: Tensor | Sequence[float] | float,
        field: int | Sequence[int] = 0,
        errors: Tensor | None = None,
        *,
        points: Tensor | None = None,
    ) -> Tensor:
        """The noise-free sensor image, (B, C, H - margin, W - margin); the margin is 0 unless the boundary is "valid".
        With oversampling s its pixels are means of s × s: (B, C, (H - margin)/s, (W - margin)/s).

        picture: (B, C, H, W) in [0, 1], centred at the places that field, points and errors give, as for `kernels`;
        integers of 8 or 16 bits are levels of sRGB (`linearised`). Half-precision pictures are blurred in float32; the
        image is float32. Raises ValueError for other shapes and other ranges, as 0 to 255.
        """
        distances = self._distances(object_distances)
        picture = self._of_channels(picture, distances)
        return self.blurred(picture, self.kernels(distances, field, errors, points=points))

    def blurred(self, light: Tensor, kernels: Tensor) -> Tensor:
        """Light (B, C, H, W) convolved with kernels (B, C, h, w), with the boundary extension and haze background, in
        pixels of the sensor."""
        light = light.to(torch.promote_types(light.dtype, torch.float32))
        kernels = kernels.to(light.dtype)
        image = blur(light, kernels, boundary=self.boundary)
        if self.normalise == "haze":
            image = image + (1 - kernels.sum((-2, -1), keepdim=True)) * light.mean((-2, -1), keepdim=True)
        return pixel_means(image, self.oversampling)

    def transfer(self, kernels: Tensor, size: int | Sequence[int]) -> Tensor:
        """H (..., rows, columns) of kernels (..., h, w) of the camera on periodic images of this size, with haze.

        With oversampling s, size is that of pictures, and H includes the mean over s × s pixels (`pixel_transfer`).
        """
        transfer = transfer_functions(kernels, size, haze=self.normalise == "haze")
        if self.oversampling == 1:
            return transfer
        return transfer * pixel_transfer(transfer.shape[-2:], self.oversampling).to(transfer)

    @uncompiled
    def _of_channels(self, picture: Tensor, distances: Tensor) -> Tensor:
        """Light (B, C, H, W) of pictures of the channels of the sensor, at object distances (B,). Raises ValueError."""
        light, channels = self._light(picture), self.sensor.channels
        count = len(distances)
        if (
            light.dim() != 4
            or light.shape[1] != len(channels)
            or (light.shape[0] != count and 1 not in (len(light), count))
        ):
            raise ValueError(
                f"pictures of shape {tuple(np.shape(picture))} at {count} object distances: expected "
                f"({count if count > 1 else 'B'}, {len(channels)}, H, W), of the channels {', '.join(channels)} of the "
                "sensor, one picture for each distance"
            )
        if (most := float(light.detach().max())) > _LARGEST:
            raise ValueError(
                f"a picture with values up to {most:g}: expected 0 to 1, as the noise model takes 1 as white; "
                "divide it by the white level"
            )
        return light

    def _light(self, picture: Tensor) -> Tensor:
        """Light (B, C, H, W) of pictures; of one channel also of (B, H, W) and (H, W)."""
        light = linearised(picture)
        if len(self.sensor.channels) == 1 and light.dim() in (2, 3):
            light = light[..., None, :, :]
        return light[None] if light.dim() == 3 else light

    def render(self, scene: Tensor, depth: Tensor | None = None, **options: Any) -> Rendering:
        """The picture that the current lens projects onto the whole sensor, by the camera's PSF model: see `rt.render`.

        scene: (..., C, H, W) linear in light, of as many pixels as the sensor; depth: (H, W) mm; options: those of
        `rt.render`.
        """
        options = {"sensor": self.sensor, "model": self.model, **options}
        if not isinstance(self.variables, PhaseVariables):
            return render(self.variables(), scene, depth=depth, elements=self.elements(), **options)
        if self.exact:
            raise ValueError(
                "render does not support exact=True: it uses the Fresnel approximation; build the camera without exact"
            )
        alone = {"sensor_distance": self.sensor_distance, "wavelengths": self.wavelengths, "size": self.size}
        return render(self.elements(), scene, depth=depth, **{**alone, **options})

    def restore(self, image: Tensor, transfer: Tensor | None = None) -> Tensor:
        """The estimate (B, C, h, w) of filter and network from a noisy image.

        transfer: (Z, C, rows, columns) at the distances of the filter, if it is known.
        """
        if self.filter is not None:
            if transfer is None:
                transfer = self.transfer(self.kernels(self.filter.distances), self.filter.spectrum.shape[-2:])
            G = self.filter(transfer, self.sensor)
            image = restore(image, G, boundary="circular" if self.boundary == "circular" else "taper")
        with torch.autocast(image.device.type, self.network_dtype, enabled=self.network_dtype is not None):
            image = as_picture(image, "image")
            like = next((p.dtype for p in self.network.parameters() if p.is_floating_point()), image.dtype)
            return self.network(image.to(like, memory_format=torch.channels_last)).to(image.dtype)

    def forward(
        self,
        picture: Tensor,
        object_distances: Tensor | Sequence[float] | float,
        *,
        field: int | Sequence[int] = 0,
        errors: Tensor | None = None,
        points: Tensor | None = None,
        index: Tensor | Sequence[int] | None = None,
        seed: int = 0,
    ) -> Tensor:
        """Blur, record, restore: arguments as for `image`; index, seed: of the noise, as for `demosaiced`."""
        image = self.image(picture, object_distances, field, errors, points=points)
        return self.restore(self.demosaiced(image, points, index, seed))

    @uncompiled
    def demosaiced(
        self,
        image: Tensor,
        points: Tensor | None = None,
        index: Tensor | Sequence[int] | None = None,
        seed: int = 0,
    ) -> Tensor:
        """Noise-free images as the sensor captures them, (B, C, h, w), the missing colours of a mosaic interpolated.

        points: (2, B) mm of their centres, by default the middle of the sensor; index, seed: of the noise, see
        `Sensor.capture`, by default random numbers of torch's generator.
        """
        if index is None:
            index = torch.randint(2**62, (len(image),), device="cpu")
        centre = self.sensor.corners.mean(1, keepdim=True) if points is None else points.detach()
        size = image.new_tensor([image.shape[-1], image.shape[-2]], dtype=torch.float64)
        first = self.sensor.pixel_of(centre.to(size)).T - 0.5 * (size - 1)
        origin = (first + 1e-6).floor().long().expand(len(image), 2)
        return self.sensor.demosaic(self.sensor.capture(image, index, seed, origin), origin)

    recorded = former_name("recorded", "demosaiced")

    def target(self, picture: Tensor) -> Tensor:
        """Reference output (B, C, h, w): the light of the picture cropped by the margin."""
        edge, light = self.margin // 2, self._light(picture)
        return light[..., edge : light.shape[-2] - edge, edge : light.shape[-1] - edge]


def _difference(name: str, before: object, now: object) -> str:
    """The first difference of a stored sensor, window or sensor distance from this one, as a message."""
    if isinstance(before, dict) and isinstance(now, dict):
        for key in now:
            if not alike(before.get(key), now[key]):
                return _difference(f"sensor.{key}", before.get(key), now[key])
    return (
        f"the state is of a camera with {name} = {before}, this one has {now}: build the camera with the stored value"
    )

"""raytrace: a sequential, differentiable ray tracer with lens-file I/O, on torch.

    >>> import raytrace as rt
    >>> lens = rt.read_lens("double_gauss")
    >>> float(rt.first_order(lens).effective_focal_length)
    99.5145515665...

The nouns and verbs stand here, each in the room that PUBLIC names, and are imported when first used: `import raytrace`
alone loads neither torch nor matplotlib nor pandas. A verb that takes a lens takes the path of its file, too, or the
name of a shipped lens (`raytrace.public`).
"""

import importlib
from types import FunctionType

#: Public names, and where each is defined: "room.file", or "room.file:name" if it has another name there.
PUBLIC = {
    # lenses and their files
    "Aperture": "system.aperture",
    "Fields": "system.lens",
    "Lens": "system.lens",
    "Facets": "system.phases",
    "FringePhase": "system.phases",
    "Grating": "system.phases",
    "Hologram": "system.phases",
    "IdealLens": "system.phases",
    "PolynomialPhase": "system.phases",
    "RadialPhase": "system.phases",
    "Pose": "system.pose",
    "Surface": "system.surface",
    "SystemAperture": "system.lens",
    "BadPrescription": "system.build",
    "LensFileError": "formats",
    "UnsupportedSurface": "formats",
    "check": "merit.check",
    "convert": "formats",
    "lens": "system.build",
    "read_lens": "formats",
    "read_merit": "formats.zemax_merit",
    "write_lens": "formats",
    "with_object_distance": "system.lens",
    "with_sensor_distance": "system.lens",
    # media
    "AIR": "media.glass",
    "MIRROR": "media.glass",
    "Glass": "media.glass",
    "UnknownGlass": "media.catalog",
    "find_glass": "media.catalog",
    "glass": "media.figures",
    "refractive_index": "media.glass",
    # rays
    "BaseRay": "optics.base_ray",
    "FirstOrder": "optics.paraxial",
    "Rays": "system.rays",
    "LostRays": "optics.losses",
    "NoFocus": "optics.focusing",
    "OutOfReach": "optics.losses",
    "Spot": "optics.spot",
    "UnfilledStop": "optics.filling",
    "base_ray": "optics.base_ray",
    "first_order": "optics.paraxial",
    "focus": "optics.focusing",
    "gauss_rings": "maths.pupil",
    "hexapolar": "maths.pupil",
    "hit_jacobian": "optics.jacobian",
    "info": "optics.views",
    "layout": "optics.views",
    "mean_square_gradient": "optics.stream_gradient",
    "paraxial_image_distance": "optics.paraxial",
    "prepare": "fused",
    "rays": "optics.launch",
    "read_rays": "formats.ray_table",
    "sobol": "maths.pupil",
    "spot": "optics.spots",
    "to": "maths.value",
    "trace": "optics.traced",
    "tracing": "fused",
    # optimisation
    "BadMerit": "merit.default",
    "Condition": "merit.hold",
    "Measure": "merit.measure",
    "Merit": "merit.value",
    "Readings": "merit.readings",
    "NoProblem": "optimization.problem",
    "Optimized": "optimization.result",
    "Row": "system.intent",
    "Vary": "system.intent",
    "evaluate": "merit.evaluate",
    "BadSearch": "optimization.journal",
    "Searched": "optimization.searched",
    "optimize": "optimization.optimize",
    "search": "optimization.search",
    # images and analyses
    "Memo": "optics.reuse",
    "Psf": "kernels",
    "Incomplete": "analysis.setting",
    "NothingToShow": "analysis.setting",
    "compare": "analysis",
    "distortion": "analysis.chief",
    "distortion_grid": "analysis.grid",
    "encircled_energy": "analysis.encircled",
    "field_curvature": "analysis.chief",
    "incidence": "analysis.incidence",
    "lateral_colour": "analysis.chief",
    "chromatic_focal_shift": "analysis.chromatic",
    "longitudinal_aberration": "analysis.longitudinal",
    "mtf": "analysis.mtf",
    "opd_fan": "analysis.fans",
    "ray_fan": "analysis.fans",
    "relative_illumination": "analysis.illumination",
    "rms_over_field": "analysis.rms",
    "seidel": "analysis.seidel",
    "wavefront": "analysis.wavefronts",
    "grid": "maths.grid",
    "psf": "kernels",
    # waves behind thin elements
    "as_pixels": "wave.element",
    "as_rings": "wave.element",
    "element_lens": "wave.bridge",
    "elements": "wave.compute",
    "fabricated": "wave.element",
    "hybrid_psf": "wave.bridge",
    "read_element": "wave.element_file",
    "wave_psf": "wave.compute",
    "write_element": "wave.element_file",
    # pictures and learning
    "add_noise": "camera.noise",
    "add_shot_noise": "camera.noise",
    "blind_filter": "camera.deconvolve",
    "blur": "camera.image",
    "blur_layers": "camera.image",
    "count_electrons": "camera.noise",
    "depth_masks": "camera.image",
    "digitise": "camera.noise",
    "power_law": "camera.deconvolve",
    "power_spectrum": "camera.deconvolve",
    "psnr": "camera.deconvolve",
    "restore": "camera.deconvolve",
    "wiener": "camera.deconvolve",
    "Camera": "camera",
    "PhaseVariables": "camera",
    "RedNet": "camera",
    "Run": "camera.training",
    "Variables": "camera",
    "train": "camera.training",
}

__all__ = [*PUBLIC]


def __getattr__(name: str):
    if name not in PUBLIC:
        raise AttributeError(f"module 'raytrace' has no attribute {name!r}")
    place, _, own = PUBLIC[name].partition(":")
    found = getattr(importlib.import_module(f"raytrace.{place}"), own or name)
    if not isinstance(found, FunctionType):
        return found
    return importlib.import_module("raytrace.public").public(found, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

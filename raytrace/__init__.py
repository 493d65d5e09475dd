"""raytrace: a sequential, differentiable ray tracer with lens-file I/O, on torch.

    >>> import raytrace as rt
    >>> lens = rt.read_lens("double_gauss")
    >>> float(rt.first_order(lens).effective_focal_length)
    99.5145515665...

Public names are imported from the modules that PUBLIC lists when they are first used: `import raytrace`
alone loads neither torch nor matplotlib nor pandas. A function of a lens also takes the path of its file, or the
name of a shipped lens (`raytrace.public`).
"""

import importlib
from threading import RLock
from types import FunctionType

#: Public names, and where each is defined: "package.module", or "package.module:name" if it has another name there.
PUBLIC = {
    # lenses and their files
    "Aperture": "system.apertures",
    "Fields": "system.lens",
    "Lens": "system.lens",
    "Facets": "system.phases",
    "FringePhase": "system.phases",
    "Grating": "system.phases",
    "Hologram": "system.phases",
    "IdealLens": "system.phases",
    "PolynomialPhase": "system.phases",
    "RadialPhase": "system.phases",
    "Pose": "system.poses",
    "Surface": "system.surface",
    "SystemAperture": "system.lens",
    "BadPrescription": "system.prescription",
    "LensFileError": "io",
    "UnsupportedSurface": "io",
    "check": "optimization.file_check",
    "convert": "io",
    "lens": "system.prescription",
    "read_lens": "io",
    "read_merit": "io.zemax.optimization",
    "write_lens": "io",
    "with_object_distance": "system.lens",
    "with_sensor_distance": "system.lens",
    # media
    "AIR": "materials.glass",
    "MIRROR": "materials.glass",
    "Glass": "materials.glass",
    "UnknownGlass": "materials.catalogs",
    "find_glass": "materials.catalogs",
    "nearest_glasses": "materials.catalogs",
    "glass": "materials.properties",
    "internal_transmittance": "materials.glass",
    "refractive_index": "materials.glass",
    # rays
    "RaytraceError": "words",
    "RaytraceWarning": "words",
    "BaseRay": "tracing.base_ray",
    "FirstOrder": "tracing.paraxial",
    "Rays": "system.rays",
    "LostRays": "tracing.ray_failures",
    "NoFocus": "analysis.focus_report",
    "OutOfReach": "tracing.ray_failures",
    "Spot": "tracing.spot",
    "UnfilledStop": "tracing.launch",
    "base_ray": "tracing.base_ray",
    "batch": "system.lens",
    "first_order": "tracing.paraxial",
    "focus": "analysis.focus_report",
    "gauss_rings": "maths.sampling",
    "hexapolar": "maths.sampling",
    "info": "tracing.lens_report",
    "layout": "analysis.layout",
    "mean_square_gradient": "tracing.streaming",
    "paraxial_image_distance": "tracing.paraxial",
    "prepare": "tracing.compiled",
    "rays": "tracing.launch",
    "read_rays": "io.ray_tables",
    "sobol": "maths.sampling",
    "spot": "analysis.spot_diagram",
    "to": "maths.numerics",
    "trace": "tracing.ray_listing",
    "trace_engine": "tracing.compiled",
    # optimisation
    "BadMerit": "optimization.merit",
    "Condition": "optimization.problem",
    "Measure": "optimization.operands.operand",
    "DefaultMerit": "optimization.merit",
    "Merit": "optimization.merit",
    "Conventions": "optimization.operands.operand",
    "NoProblem": "optimization.problem",
    "Optimized": "optimization.optimized",
    "Row": "system.optimization_data",
    "Vary": "system.optimization_data",
    "evaluate": "optimization.evaluate",
    "Jacobian": "tolerancing.jacobian",
    "jacobian": "tolerancing.jacobian",
    "BadSearch": "optimization.search_tasks",
    "Searched": "optimization.search",
    "optimize": "optimization.optimize",
    "search": "optimization.search",
    # errors of manufacture
    "AsBuilt": "tolerancing.as_built",
    "BadTolerance": "tolerancing.table",
    "Compensator": "system.tolerance_data",
    "Tolerance": "system.tolerance_data",
    "Tolerances": "tolerancing.table",
    "cemented_groups": "tolerancing.elements",
    "draw_errors": "tolerancing.sampling",
    "lens_elements": "tolerancing.elements",
    "perturbed": "tolerancing.perturbation",
    "read_tolerances": "tolerancing.files",
    "Toleranced": "tolerancing.analysis",
    "tolerance": "tolerancing.analysis",
    "tolerances": "tolerancing.grades",
    # images and analyses
    "Memo": "tracing.scene",
    "DRT": "psf_models",
    "Execution": "psf_models",
    "Fourier": "psf_models",
    "Gaussian": "psf_models",
    "Paraxial": "psf_models",
    "Psf": "psf_models",
    "Wave": "psf_models",
    "Incomplete": "analysis.setting",
    "NothingToShow": "analysis.setting",
    "compare": "analysis.compare",
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
    "grid": "maths.sampling",
    "psf": "psf_models",
    "view": "viewer.widget",
    # waves behind thin elements
    "as_pixels": "wave_optics.fabrication",
    "as_rings": "wave_optics.fabrication",
    "element": "wave_optics.element",
    "element_lens": "wave_optics.hybrid",
    "elements": "wave_optics.compute",
    "fabricated": "wave_optics.fabrication",
    "hybrid_psf": "wave_optics.hybrid",
    "read_element": "wave_optics.element_files",
    "wave_psf": "wave_optics.compute",
    "write_element": "wave_optics.element_files",
    # pictures and learning
    "add_noise": "imaging.image",
    "add_shot_noise": "imaging.image",
    "depth_invariant_wiener": "imaging.restoration",
    "blur": "imaging.image",
    "blur_layers": "imaging.image",
    "count_electrons": "imaging.image",
    "cross_spectrum": "imaging.restoration",
    "depth_masks": "imaging.image",
    "digitise": "imaging.image",
    "joint_wiener": "imaging.restoration",
    "power_law": "imaging.restoration",
    "power_spectrum": "imaging.restoration",
    "psnr": "imaging.restoration",
    "restore": "imaging.restoration",
    "restore_jointly": "imaging.restoration",
    "transfer_functions": "imaging.image",
    "wiener": "imaging.restoration",
    "Camera": "imaging",
    "PhaseVariables": "imaging",
    "RedNet": "imaging",
    "Run": "imaging.training",
    "Sensor": "imaging.sensor",
    "UNet": "imaging.network",
    "Variables": "imaging",
    "render": "imaging.render",
    "slanted_edge_mtf": "imaging.slanted_edge",
    "train": "imaging.training",
}

__all__ = [*PUBLIC]

#: One thread imports at a time. A folder imports its modules and a module imports its folder first: two threads that
#: begin at either end would wait for each other, and Python then hands out modules that are partially initialized.
_IMPORTING = RLock()


def __getattr__(name: str):
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("raytrace")
    if name not in PUBLIC:
        raise AttributeError(f"module 'raytrace' has no attribute {name!r}")
    place, _, defined = PUBLIC[name].partition(":")
    with _IMPORTING:
        value = getattr(importlib.import_module(f"raytrace.{place}"), defined or name)
        if not isinstance(value, FunctionType):
            return value
        return importlib.import_module("raytrace.public").public(value, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

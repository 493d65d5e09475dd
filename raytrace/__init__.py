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
import warnings
from collections.abc import Callable
from threading import RLock
from types import FunctionType
from typing import Any

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
    "check": "optimization.file_check",
    "convert": "io",
    "lens": "system.prescription",
    "read_lens": "io",
    "read_merit": "io.zemax.optimization",
    "write_lens": "io",
    "with_object_distance": "system.lens",
    "with_sensor_distance": "system.lens",
    # edits
    "scale": "edit.scaling",
    "reverse": "edit.turning",
    "insert": "edit.surfaces",
    "insert_part": "edit.parts",
    "replace_part": "edit.parts",
    "delete": "edit.surfaces",
    "join": "edit.surfaces",
    "split": "edit.surfaces",
    "cement": "edit.surfaces",
    "bend": "edit.surfaces",
    "rename": "edit.surfaces",
    "semi_diameters": "edit.sizes",
    # parts of vendors
    "stock_find": "stock.index",
    "stock_index": "stock.index",
    # media
    "AIR": "materials.glass",
    "MIRROR": "materials.glass",
    "Glass": "materials.glass",
    "MOUNTS": "materials.mounts",
    "find_glass": "materials.catalogs",
    "nearest_glasses": "materials.catalogs",
    "glass": "materials.properties",
    "glasses": "materials.selection",
    "internal_transmittance": "materials.glass",
    "refractive_index": "materials.glass",
    # rays
    "RaytraceError": "words",
    "RaytraceWarning": "words",
    "BaseRay": "tracing.base_ray",
    "FirstOrder": "tracing.paraxial",
    "Rays": "system.rays",
    "Spot": "tracing.spot",
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
    "Condition": "optimization.conditions",
    "Measure": "optimization.operands.operand",
    "DefaultMerit": "optimization.merit",
    "Merit": "optimization.merit",
    "Conventions": "optimization.operands.operand",
    "Points": "optimization.quantities",
    "Otf": "optimization.quantities",
    "Kernels": "optimization.quantities",
    "Optimized": "optimization.optimized",
    "Row": "system.optimization_data",
    "Vary": "system.optimization_data",
    "evaluate": "optimization.evaluate",
    "Jacobian": "tolerancing.jacobian",
    "jacobian": "tolerancing.jacobian",
    "Searched": "optimization.search",
    "optimize": "optimization.optimize",
    "search": "optimization.search",
    # errors of manufacture
    "AsBuilt": "tolerancing.as_built",
    "Compensator": "system.tolerance_data",
    "Tolerance": "system.tolerance_data",
    "ToleranceTable": "tolerancing.table",
    "cemented_groups": "tolerancing.grades",
    "draw_errors": "tolerancing.sampling",
    "lens_elements": "tolerancing.grades",
    "perturbed": "tolerancing.perturbation",
    "read_tolerances": "tolerancing.files",
    "ToleranceAnalysis": "tolerancing.analysis",
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
    "compare": "analysis.compare",
    "compare_models": "analysis.compare_models",
    "distortion": "analysis.chief",
    "distortion_grid": "analysis.grid",
    "encircled_energy": "analysis.encircled",
    "field_curvature": "analysis.chief",
    "depth_of_field": "analysis.depth_of_field",
    "footprint": "analysis.footprint",
    "incidence": "analysis.incidence",
    "intercepts": "analysis.intercepts",
    "lateral_colour": "analysis.chief",
    "chromatic_focal_shift": "analysis.chromatic",
    "longitudinal_aberration": "analysis.longitudinal",
    "mtf": "analysis.mtf",
    "opd_fan": "analysis.fans",
    "ray_fan": "analysis.fans",
    "relative_illumination": "analysis.illumination",
    "rms_over_field": "analysis.rms",
    "sag": "analysis.sag_table",
    "thermal": "analysis.thermal",
    "vignetting": "analysis.vignetting",
    "seidel": "analysis.seidel",
    "wavefront": "analysis.wavefronts",
    "grid": "maths.sampling",
    "psf": "psf_models",
    "view": "viewer.widget",
    # drawings and solids
    "draw": "workshop.sheets",
    "report": "workshop.report",
    # waves behind thin elements
    "as_pixels": "wave_optics.fabrication",
    "as_rings": "wave_optics.fabrication",
    "phase_element": "wave_optics.element",
    "element_lens": "wave_optics.hybrid",
    "phase_elements": "wave_optics.compute",
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
    "DepthInvariantFilter": "imaging.camera_filters",
    "LensPictures": "imaging.lens_pictures",
    "PhaseVariables": "imaging",
    "RedNet": "imaging",
    "Run": "imaging.training",
    "Sensor": "imaging.sensor",
    "TowardsMeasurement": "imaging.camera_filters",
    "UNet": "imaging.network",
    "Variables": "imaging",
    "render": "imaging.render",
    "slanted_edge_mtf": "imaging.slanted_edge",
    "train": "imaging.training",
}

#: Errors and warnings, and where each is defined.
ERRORS = {
    "Aliased": "psf_models.dft",
    "AliasedSampling": "wave_optics.plan",
    "AmbiguousGlass": "materials.catalogs",
    "ArrayError": "maths.arrays",
    "BadCheckpoint": "optimization.checkpoint",
    "BadEdit": "edit.choice",
    "BadIndication": "workshop.indications",
    "BadHold": "optimization.variables",
    "BadLimits": "system.parameter_paths",
    "BadMerit": "optimization.merit",
    "BadParameter": "agents.tools",
    "BadPlates": "stock.plates",
    "BadPrescription": "system.prescription",
    "BadRow": "optimization.operands.operand",
    "BadReport": "workshop.report",
    "BadSearch": "optimization.search_tasks",
    "BadSelection": "materials.selection",
    "BadSettings": "cli.settings",
    "BadStock": "stock.index",
    "BadSubstitute": "io.source",
    "BadTolerance": "tolerancing.table",
    "BadVariables": "system.parameter_paths",
    "Bent": "tracing.trace",
    "BeyondFields": "imaging.render",
    "CatalogError": "materials.agf",
    "CatalogWarning": "materials.agf",
    "ChangesNothing": "tracing.ray_listing",
    "Circle": "optimization.merit",
    "ClippedBeam": "analysis.sheared_batch",
    "CommandError": "cli.runner",
    "DamagedLine": "stores",
    "DamagedRun": "imaging.training",
    "DarkPlaces": "imaging.field_kernels",
    "EmptyPsf": "psf_models.result",
    "EmptySpot": "tracing.spot",
    "EnergyOutside": "imaging.field_kernels",
    "FailedElsewhere": "shards",
    "GoalMissed": "tolerancing.analysis",
    "HeightMapError": "wave_optics.height_maps",
    "ImplausibleWavelength": "materials.glass",
    "Incomparable": "analysis.compare",
    "Incomplete": "analysis.setting",
    "InvalidIndex": "materials.glass",
    "LeftAsItWas": "edit.choice",
    "LeftOut": "edit.choice",
    "LensFileError": "io.source",
    "LensFileWarning": "io.source",
    "LostRays": "tracing.ray_failures",
    "MarginalRayLost": "tracing.launch",
    "MissingExtra": "words",
    "NoCompiler": "tracing.compiler",
    "NoDerivatives": "tolerancing.jacobian",
    "NoFocus": "analysis.focus_report",
    "NoFolder": "agents.server",
    "NoImage": "tracing.focus",
    "NoLight": "optimization.problem",
    "NoMelt": "materials.glass",
    "NoOptimum": "optimization.least_squares",
    "NoPart": "stock.parts",
    "NoPictures": "imaging.pictures",
    "NoProblem": "optimization.problem",
    "NoSolid": "workshop.parts",
    "NoStep": "optimization.least_squares",
    "NoThermalCoefficients": "materials.environment",
    "NotConverged": "psf_models.models",
    "NotFinite": "imaging.training",
    "NotFitted": "optimization.fitting",
    "NotReached": "optimization.attained",
    "NotWritten": "files",
    "NothingToShow": "analysis.setting",
    "OtherLens": "imaging.variables",
    "OtherSettings": "imaging.training",
    "OutOfRange": "materials.glass",
    "OutOfReach": "tracing.ray_failures",
    "OverBudget": "budget",
    "PictureChanged": "io.pictures",
    "PictureError": "io.pictures",
    "ProcessLost": "shards",
    "RayTableError": "io.ray_tables",
    "RefusedFile": "agents.folder",
    "ReplacedCondition": "optimization.conditions",
    "TakesLong": "budget",
    "TooCoarse": "wave_optics.direction_grid",
    "TooManyPoints": "psf_models.dft",
    "Unbuildable": "tracing.geometry",
    "UnfilledStop": "tracing.launch",
    "Unfit": "stores",
    "UnknownGlass": "materials.catalogs",
    "UnknownNumber": "system.parameter_paths",
    "UnknownOperand": "optimization.merit",
    "UnsupportedSurface": "io.source",
    "Unlit": "tolerancing.as_built",
    "Untrusted": "tracing.compiler",
    "VariedGlass": "optimization.variables",
    "VirtualImage": "analysis.focus_report",
    "WindowTooLarge": "imaging.field_kernels",
    "WorseBetween": "optimization.between",
}

#: The names that are typed: lenses and their files, the functions that commands run, and what a camera is made of. All
#: others are names of their packages, `rt.imaging.blur`.
TOP = (
    *("Lens", "lens", "read_lens", "write_lens", "convert", "check", "info", "layout", "draw", "report"),
    *("view", "glass"),
    *("glasses", "to", "trace", "base_ray", "spot", "first_order", "focus", "psf", "mtf", "wavefront"),
    *("compare", "compare_models"),
    "seidel",
    *("ray_fan", "opd_fan", "distortion", "distortion_grid", "field_curvature", "lateral_colour", "incidence"),
    *("chromatic_focal_shift", "longitudinal_aberration", "encircled_energy", "relative_illumination"),
    *("footprint", "vignetting", "intercepts", "depth_of_field"),
    *("rms_over_field", "sag", "thermal", "optimize", "search", "evaluate", "jacobian", "Merit", "tolerance"),
    *("tolerances", "stock_index", "stock_find"),
    *("Camera", "Variables", "Sensor", "render", "train", "RaytraceError", "RaytraceWarning"),
)
#: Packages whose public names are typed with them.
NAMESPACES = (
    *("system", "io", "edit", "materials", "maths", "tracing", "analysis", "psf_models", "optimization", "tolerancing"),
    *("imaging", "wave_optics"),
)
#: Names of older versions that changed, and their names now.
RENAMED = {
    **{"element": "phase_element", "elements": "phase_elements"},
    **{"Tolerances": "ToleranceTable", "Toleranced": "ToleranceAnalysis"},
}

__all__ = [*TOP, *NAMESPACES]

#: One thread imports at a time. A folder imports its modules and a module imports its folder first: two threads that
#: begin at either end would wait for each other, and Python then hands out modules that are partially initialized.
_IMPORTING = RLock()


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return importlib.import_module("importlib.metadata").version("raytrace")
    if name in NAMESPACES:
        with _IMPORTING:
            return importlib.import_module(f"raytrace.{name}")
    now = RENAMED.get(name, name)
    if now not in PUBLIC and now not in ERRORS:
        raise AttributeError(f"module 'raytrace' has no attribute {name!r}")
    if now in PUBLIC and now not in TOP:
        message = f"rt.{name} is rt.{package_of(now)}.{now}; the short name goes with version 0.3"
        warnings.warn(message, DeprecationWarning, stacklevel=2)
    return public_name(now)


def __dir__() -> list[str]:
    return sorted(__all__)


def public_name(name: str) -> Any:
    """A public function, class, error or value by its name."""
    place, _, defined = (PUBLIC.get(name) or ERRORS[name]).partition(":")
    with _IMPORTING:
        value = getattr(importlib.import_module(f"raytrace.{place}"), defined or name)
        if not isinstance(value, FunctionType):
            return value
        home = "raytrace" if name in TOP else f"raytrace.{package_of(name)}"
        return importlib.import_module("raytrace.public").public(value, name, home)


def package_of(name: str) -> str:
    """The package whose name a public one is, such as imaging."""
    return PUBLIC[name].partition(":")[0].partition(".")[0]


def namespace(package: str) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """`__getattr__` and `__dir__` of a package, by which it has the public names that are defined in it."""
    names = [name for name in PUBLIC if f"raytrace.{package_of(name)}" == package]

    def find(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return public_name(name)

    return find, lambda: names

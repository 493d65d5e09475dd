"""raytrace: a sequential, differentiable ray tracer with lens-file I/O, on torch.

    >>> import raytrace
    >>> lens = raytrace.read_lens("lenses/double_gauss.zmx")
    >>> float(raytrace.first_order(lens).effective_focal_length)
    99.5145515665...

The nouns and the most used verbs stand here; the rest are in modules named after what they do (`raytrace.trace`,
`raytrace.launch`, `raytrace.spot`, `raytrace.focus`, …). Everything is imported when first used: `import raytrace`
alone loads neither torch nor matplotlib nor pandas.
"""

import importlib

#: Public names and the modules that define them.
_PUBLIC = {
    "AIR": "glass",
    "MIRROR": "glass",
    "Aperture": "surface",
    "Fields": "lens",
    "FirstOrder": "paraxial",
    "Glass": "glass",
    "Lens": "lens",
    "LensFileError": "formats",
    "Rays": "rays",
    "Spot": "spot",
    "Surface": "surface",
    "SystemAperture": "lens",
    "UnknownGlass": "catalog",
    "UnsupportedSurface": "formats",
    "find_glass": "catalog",
    "first_order": "paraxial",
    "paraxial_image_distance": "paraxial",
    "prepare": "fused",
    "read_lens": "formats",
    "refractive_index": "glass",
    "to": "value",
    "tracing": "fused",
    "with_object_distance": "lens",
    "with_sensor_distance": "lens",
    "write_lens": "formats",
}
_MODULES = (
    "catalog", "focus", "formats", "glass", "launch", "lens", "paraxial", "plot", "pupil", "rays", "spot", "surface",
    "trace", "wavefront",
)  # fmt: skip

__all__ = [*_PUBLIC, *_MODULES]


def __getattr__(name: str):
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"raytrace.{_PUBLIC[name]}"), name)
    if name in _MODULES:
        return importlib.import_module(f"raytrace.{name}")
    raise AttributeError(f"module 'raytrace' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})

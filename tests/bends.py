"""Lenses whose axis bends, made of others or of numbers."""

import dataclasses

import torch
from problems import number as real

import raytrace as rt


def pose(**numbers) -> rt.system.Pose:
    flag = numbers.pop("tilts_first", False)
    tensors = {name: number if isinstance(number, torch.Tensor) else real(number) for name, number in numbers.items()}
    return rt.system.Pose(**tensors, tilts_first=flag)


def _minus(number):
    return None if number is None else -number


def flipped(surface: rt.system.Surface) -> rt.system.Surface:
    """A surface for light that runs the other way along z."""
    changes = {name: _minus(getattr(surface, name)) for name in ("thickness", "curvature", "coefficients")}
    return dataclasses.replace(surface, **changes)


def inserted(lens: rt.Lens, behind: int, new: list[rt.system.Surface], rest=lambda surface: surface) -> rt.Lens:
    """The lens with surfaces put in behind one of them, and those that follow changed."""
    surfaces = [*lens.surfaces[: behind + 1], *new, *map(rest, lens.surfaces[behind + 1 :])]
    stop = lens.stop + (len(new) if behind < lens.stop else 0)
    return dataclasses.replace(lens, surfaces=tuple(surfaces), stop=stop)


def folded(lens: rt.Lens, behind: int, share: float = 0.5, **tilts) -> rt.Lens:
    """The lens with a plane mirror in the gap behind a surface, at a share of it; its axes follow the light."""
    gap = lens.surfaces[behind].thickness
    # With R = Rx Ry the mirror turns the axes by R D Rᵀ D, D = diag(1, 1, -1): R before it, Ry Rx behind.
    poses = {"before": pose(**tilts), "after": pose(**tilts, tilts_first=True)}
    mirror = rt.system.Surface(thickness=(share - 1) * gap, glass=rt.materials.MIRROR, **poses)
    return inserted(lens.replace(behind, thickness=share * gap), behind, [mirror], flipped)


def turned_back(lens: rt.Lens, behind: int, share: float = 0.5) -> rt.Lens:
    """The lens with a plane mirror across the axis, behind which z is turned by 180° about y: light runs along +z."""
    gap = lens.surfaces[behind].thickness
    mirror = rt.system.Surface(thickness=real(0.0), glass=rt.materials.MIRROR)
    back = rt.system.Surface(thickness=(1 - share) * gap, before=pose(tilt_y=180.0), is_break=True)
    return inserted(lens.replace(behind, thickness=share * gap), behind, [mirror, back])


def on_tilted_sensor(lens: rt.Lens, **tilts) -> rt.Lens:
    """The lens with its sensor tilted about its vertex."""
    image = dataclasses.replace(lens.surfaces[-1], before=pose(**tilts))
    return dataclasses.replace(lens, surfaces=(*lens.surfaces[:-1], image))


def tilted_mirror(radius: float, degrees: float, distance: float, **others) -> rt.Lens:
    """A sphere (mm) used at an angle of incidence, the sensor across the ray behind it, stop on the mirror."""
    tilt = pose(tilt_x=degrees)
    row = {"radius": radius, "glass": "MIRROR", "before": tilt, "after": tilt, "thickness": -distance}
    return rt.lens([row], stop=1, **({"entrance_pupil_diameter": 4.0} | others))


def _both(before: float, after: float | None = None) -> dict:
    return {"before": pose(tilt_x=before), "after": pose(tilt_x=before if after is None else after)}


_GROOVES = rt.system.Grating(0.6, -1.0)


def spectrometer(ray_aiming: str = "real") -> rt.Lens:
    """A Czerny-Turner spectrometer whose stop is the grating: straightened, it would be at infinity."""
    return rt.lens(
        [
            {"radius": -200.0, "thickness": -100.0, "glass": "MIRROR", **_both(8.0)},
            {"thickness": 100.0, "glass": "MIRROR", **_both(-20.0, -5.0), "phase": _GROOVES},
            {"radius": -200.0, "thickness": -95.0, "glass": "MIRROR", **_both(-8.0)},
        ],
        stop=2,
        fields=[0.0, 1.0],
        wavelengths=[0.5, 0.55, 0.6],
        primary_wavelength=2,
        object_distance=100.0,
        object_na=0.05,
        ray_aiming=ray_aiming,
    )  # fmt: skip

"""Pool: the glasses of catalogs that a lens may take, by the numbers of model glasses, and the hull of these."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial import ConvexHull, QhullError

from raytrace.media.catalog import Catalog, CatalogError, load, missing_catalogs, shipped_catalog
from raytrace.media.glass import Glass, is_air, model_glass, refractive_index
from raytrace.merit.model import GLASS
from raytrace.optimization.problem import NoProblem
from raytrace.system.lens import Lens

_MATTERS = 1e-6  # of the index: what a number of a glass must change of it at the wavelengths, to vary

#: Statuses that are chosen from; a merit counts so much more with a glass of another than the first.
STATUSES = {"preferred": 1.0, "standard": 1.03, "": 1.03}
_PRICE = 0.02  # the power of the price, relative to that of the catalog's cheapest sort, by which a merit counts more


class Pool:
    """Glasses to choose from: their numbers (G, k) and the hull of these, normal (F, k) · p ≤ reach (F,)."""

    def __init__(self, glasses: Sequence[Glass], wavelengths: torch.Tensor):
        self.wavelengths, self.basis = wavelengths, _basis(wavelengths)
        self.glasses = tuple(glasses)
        found = np.array([self.numbers_of(glass) for glass in self.glasses]).reshape(-1, self.count)
        usable = np.isfinite(found).all(1)
        self.glasses = tuple(glass for glass, use in zip(self.glasses, usable, strict=True) if use)
        self.numbers = found[usable]
        if not len(self.numbers):
            raise NoProblem("no glass of the catalogs covers the wavelengths of the lens; name others by `catalog`")
        self.normal, self.reach = hull(self.numbers)

    @property
    def count(self) -> int:
        return self.basis.shape[1]

    @property
    def names(self) -> tuple[str, ...]:
        """What varies of a model glass."""
        return tuple(GLASS)[: self.count]

    def numbers_of(self, glass: Glass) -> np.ndarray:
        """(k,) of the model glass whose indices come nearest at the wavelengths; as many of them are met exactly."""
        excess = refractive_index(glass, self.wavelengths).numpy() - 1
        found = np.linalg.lstsq(self.basis, excess, rcond=None)[0]
        n, dispersion, deviation = np.pad(found, (0, 3 - self.count))
        if self.count == 1:
            return np.array([1 + n])
        return np.array([1 + n, n / dispersion, deviation / dispersion])[: self.count]

    def model(self, numbers: np.ndarray) -> Glass:
        """The model glass of numbers (k,)."""
        return model_glass(*np.pad(numbers, (0, 3 - self.count)))


def _basis(wavelengths: torch.Tensor) -> np.ndarray:
    """(W, k): n - 1 of a model glass by n - 1, (n - 1)/V and ΔP (n - 1)/V, of which it is a linear function.

    As many of the three, in this order, as change the index at the wavelengths independently.
    """
    at = lambda *numbers: refractive_index(model_glass(*numbers), wavelengths).numpy() - 1  # noqa: E731
    if len(wavelengths) == 1:
        return np.ones((1, 1))
    whole, half, deviating = at(2.0, 1.0), at(2.0, 2.0), at(2.0, 1.0, 1.0)
    basis = np.stack([2 * half - whole, 2 * (whole - half), deviating - whole], -1)[:, : len(wavelengths)]
    typical = np.array([0.6, 0.012, 1e-4])[: basis.shape[1]]
    new = np.abs(np.diag(np.linalg.qr(basis * typical)[1])) > _MATTERS
    return basis[:, : int(np.argmin(new)) if not new.all() else len(new)]


def hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The convex hull of points (G, k): normal (F, k) · p ≤ reach (F,), a length of 1 as large as all of them.

    A box where they are too few, or in a plane.
    """
    low, size = points.min(0), np.maximum(np.ptp(points, axis=0), 1e-9)
    scaled = (points - low) / size
    try:
        found = ConvexHull(scaled).equations
    except (QhullError, ValueError):
        axes = np.eye(points.shape[1])
        found = np.concatenate([np.c_[axes, -scaled.max(0)], np.c_[-axes, scaled.min(0)]])
    found = np.unique(found.round(12), axis=0)
    normal = found[:, :-1] / size
    return normal, normal @ low - found[:, -1]


def catalogs_of(lens: Lens, catalog: Sequence[str | Path] = ()) -> tuple[Catalog, ...]:
    """Catalogs by their names or AGF files; without any those that the lens names, else SCHOTT. Raises CatalogError."""
    shipped = [name for name in lens.catalogs if name not in missing_catalogs([name])]
    return tuple(_catalog(name) for name in (catalog or shipped or ("SCHOTT",)))


def _catalog(name: str | Path) -> Catalog:
    if Path(name).suffix or Path(name).is_file():
        return load(name)
    try:
        return shipped_catalog(str(name))
    except CatalogError as error:
        raise NoProblem(f"`catalog`: {error}") from None


def pool_of(lens: Lens, catalogs: Sequence[Catalog]) -> Pool:
    """Glasses of STATUSES whose range covers the wavelengths of the lens. Raises NoProblem where there is none."""
    shortest, longest = float(lens.wavelengths.min()), float(lens.wavelengths.max())
    span = lambda glass: glass.wavelength_range or (0.0, np.inf)  # noqa: E731
    found = [
        dataclasses.replace(glass, name=glass.listed_name or glass.name)
        for one in catalogs
        for glass in one.glasses.values()
        if glass.status in STATUSES and span(glass)[0] <= shortest and longest <= span(glass)[1] and not is_air(glass)
    ]
    return Pool(found, lens.wavelengths)


def charge(glass: Glass) -> float:
    """By how much a merit counts more with a glass that its maker does not prefer, or that is dear."""
    price = next((numbers[0] for keyword, numbers in glass.records if keyword == "OD" and numbers), 0.0)
    return STATUSES.get(glass.status, max(STATUSES.values())) * max(price, 1.0) ** _PRICE

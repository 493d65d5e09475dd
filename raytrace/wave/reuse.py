"""Memo: what the heights of an element do not change, kept from one step of an optimisation to the next."""

import dataclasses
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from raytrace.wave.element import EvenPowers
from raytrace.wave.plan import Plan
from raytrace.wave.scene import WaveScene


@dataclasses.dataclass(frozen=True)
class _Kept:
    structure: Any
    numbers: list[Tensor]
    sums: Any


class Memo:
    """Sums of earlier calls: `psf(..., memo=memo)` in a loop.

    Everything in the scene but heights and coefficients is compared at each call, and what has changed or requires a
    gradient is computed anew; so a memo changes no result. most: so many are kept, the oldest is forgotten first.
    made: how many times sums were computed. Under the transforms of `torch.func` it is passed by.
    """

    def __init__(self, most: int = 8):
        self._kept: list[_Kept] = []
        self._most = most
        self.made = 0

    def find(self, scene: WaveScene, plan: Plan, make: Callable) -> Any:
        """`make(scene, plan)`, from memory where it would be the same."""
        numbers, structure = _constants(scene)
        structure = (structure, plan)
        if torch._C._are_functorch_transforms_active() or any(n.requires_grad for n in numbers):
            self.made += 1
            return make(scene, plan)
        for kept in self._kept:
            if kept.structure == structure and all(map(_equal, kept.numbers, numbers)):
                return kept.sums
        with torch.no_grad():
            sums = make(scene, plan)
        self.made += 1
        held = [n.detach().clone() for n in numbers]
        self._kept = [*self._kept, _Kept(structure, held, sums)][-self._most :]
        return sums


def _constants(scene: WaveScene) -> tuple[list[Tensor], Any]:
    """All numbers of a scene that sums depend on, and its structure."""
    leaves, structure = pytree.tree_flatten(dataclasses.replace(scene, elements=()))
    for element in scene.elements:
        profile = element.profile
        free = element.numbers
        # Of free heights only how many there are counts; where a wrapped smooth one jumps moves with its coefficients.
        jumps = isinstance(profile, EvenPowers) and element.period is not None
        held = [free.detach()] if jumps else []
        parts = [element.radius, getattr(profile, "pitch", None), element.period]
        leaves += [t for t in (*parts, *held) if t is not None]
        structure = (structure, type(profile), free.shape, free.dtype, free.device, element.levels)
    return leaves, structure


def _equal(a: Tensor, b: Tensor) -> bool:
    return a.shape == b.shape and a.dtype == b.dtype and a.device == b.device and torch.equal(a, b)

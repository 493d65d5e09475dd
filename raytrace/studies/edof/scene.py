"""Scenes of dead leaves as cameras of extended depth of field see and restore them: flat ones, and deep ones.

Restored by the best blind filter of each element. Pictures are (h, w, 3), red, green and blue the wavelengths from long
to short.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from raytrace.imaging.image import blur_layers, depth_masks
from raytrace.imaging.restoration import depth_invariant_wiener, psnr, restore
from raytrace.studies.edof.world import World, depth_text, kernels, mirrored, spectrum, transfer
from raytrace.studies.pictures import dead_leaves, draws
from raytrace.wave_optics.element import Element

_KEY = 99  # of what is drawn
_LAYERS = 9  # of a deep scene, even in dioptres


@dataclasses.dataclass(frozen=True)
class Deep:
    """A scene from the nearest to the farthest depth: picture (h, w, 3), dioptres (h, w).

    seen, restored: by row what the sensor saw and what was made of it, (h, w, 3) each, with the PSNR.
    """

    picture: np.ndarray
    dioptres: np.ndarray
    seen: dict[str, np.ndarray]
    restored: dict[str, tuple[np.ndarray, float]]


def coloured_leaves(size: int, *, colours: int = 3, seed: int = 0) -> np.ndarray:
    """Dead leaves (colours, size, size) that end at one place in all colours: a colour for every shade of grey."""
    leaves = dead_leaves(1, size=size, seed=seed + _KEY, smallest=4.0).samples[0]
    return np.stack([table[leaves] for table in draws(seed, _KEY).uniform(0.05, 0.95, (colours, 256))])


@torch.no_grad()
def flat(
    elements: Mapping[str, Sequence[Element]], world: World, *, seed: int = 0
) -> tuple[dict[str, dict[str, tuple[np.ndarray, float]]], np.ndarray]:
    """A scene at the nearest, the middle and the farthest depth: by row and depth what is restored, with its PSNR; and
    the scene.
    """
    size, part = 512, slice(40, 200)
    leaves = coloured_leaves(size // 2, colours=len(world.wavelengths), seed=seed)
    picture = torch.as_tensor(np.stack([mirrored(colour) for colour in leaves]))
    S, noise = spectrum(picture), _noise(picture, world, seed)
    found: dict[str, dict[str, tuple[np.ndarray, float]]] = {}
    for name, own in elements.items():
        H = transfer(kernels(own, world), size)
        G = depth_invariant_wiener(H, S, world.noise)
        found[name] = {}
        for d in (0, len(H) // 2, len(H) - 1):
            estimate = torch.fft.ifft2(torch.fft.fft2(torch.fft.ifft2(torch.fft.fft2(picture) * H[d]).real + noise) * G)
            ratio = float(psnr((estimate.real - picture).square().mean()))
            found[name][depth_text(world.depths[d])] = _shown(estimate.real[:, part, part]), ratio
    return found, _shown(picture[:, part, part])


@torch.no_grad()
def deep(elements: Mapping[str, Sequence[Element]], world: World, *, seed: int = 0) -> Deep:
    """Leaves on a floor from the nearest depth, below, to the farthest, above; near layers hide far ones."""
    size, half = 320, world.size // 2
    picture = torch.as_tensor(coloured_leaves(size + 2 * half, colours=len(world.wavelengths), seed=seed))
    dioptres = [1e3 / depth for depth in world.depths]
    rise = torch.linspace(min(dioptres), max(dioptres), size, dtype=picture.dtype)
    depth = torch.cat([rise.new_full((half,), float(rise[0])), rise, rise.new_full((half,), float(rise[-1]))])
    depth = depth[:, None].expand(picture.shape[1:])
    planes = torch.linspace(min(dioptres), max(dioptres), _LAYERS, dtype=picture.dtype)
    masks = depth_masks(depth, planes, softness=0.1 * float(planes[1] - planes[0]))
    truth, S = picture[:, half:-half, half:-half], spectrum(picture)
    seen, back = {}, {}
    depths = [math.inf if plane == 0 else 1e3 / plane for plane in planes.tolist()]
    for name, own in elements.items():
        found = kernels(own, world, depths=depths)
        # What misses the window comes back as haze, even over the scene.
        haze = (1 - found.energy.mean(0))[:, None, None] * picture.mean((-2, -1), keepdim=True)
        image = blur_layers(picture, masks, found.kernel) + haze
        image = image + _noise(image, world, seed)
        G = depth_invariant_wiener(transfer(found, picture.shape[-1]), S, world.noise)
        estimate = restore(image, G, boundary="taper")
        seen[name] = _shown(image)
        back[name] = _shown(estimate), float(psnr((estimate - truth).square().mean()))
    return Deep(_shown(truth), depth[half:-half, half:-half].numpy(), seen, back)


def _noise(like: Tensor, world: World, seed: int) -> Tensor:
    random = torch.Generator().manual_seed(seed)
    return world.noise * torch.randn(like.shape, generator=random, dtype=like.dtype)


def _shown(picture: Tensor) -> np.ndarray:
    return picture.flip(0).movedim(0, -1).numpy()

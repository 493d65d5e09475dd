"""Convolutional networks for image restoration: RED-Net and a small U-Net.

Both return pictures of the shape of their input, of one channel or of several, and are residual: their last layer
starts from zero, and an untrained network returns its input.
"""

import dataclasses
from collections.abc import Sequence
from typing import TypeAlias

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d, pad

from raytrace.imaging.image import as_picture

Convolution: TypeAlias = nn.Conv2d | nn.ConvTranspose2d


@dataclasses.dataclass(frozen=True)
class RedNetShape:
    """depth: layers of encoder and decoder together, even; width: feature maps of the inner layers."""

    depth: int = 10
    width: int = 32


@dataclasses.dataclass(frozen=True)
class UNetShape:
    """levels: number of poolings; width: feature maps at full resolution, doubled by every pooling."""

    levels: int = 2
    width: int = 16


_CPU = RedNetShape(10, 32)
#: By name: RED-Net of the published comparison, one that two CPU cores train in minutes, and a U-Net of similar cost.
PRESETS: dict[str, RedNetShape | UNetShape] = {"paper": RedNetShape(30, 64), "cpu": _CPU, "unet": UNetShape()}


def network(preset: str | RedNetShape | UNetShape, *, channels: int = 1, seed: int = 0) -> nn.Module:
    """The network of a name in `PRESETS`, or of a shape, untrained. Raises ValueError for other names."""
    if isinstance(preset, str) and preset not in PRESETS:
        raise ValueError(f"network {preset!r}: expected {', '.join(PRESETS)}")
    shape = PRESETS[preset] if isinstance(preset, str) else preset
    if isinstance(shape, UNetShape):
        return UNet(channels=channels, width=shape.width, levels=shape.levels, seed=seed)
    return RedNet(shape, channels=channels, seed=seed)


class RedNet(nn.Module):
    """Residual encoder-decoder: depth/2 convolutions 3 × 3, as many deconvolutions, and symmetric skip connections.

        x + D_n(… D_1(E_n(… E_1(x)))),   after D_i: ReLU(D_i + E_(n-i)),   i = 1, 3, 5 … < n = depth/2

    Every layer keeps the image size. A deconvolution of stride 1 is computed as the convolution with weights rotated by
    180°: its gradient takes a third of the time on a CPU. The last layer starts from zero: an untrained network returns
    its input. channels: of the pictures, 3 for colours, which are restored together. Mao, Shen and Yang, NIPS 2016
    (arXiv:1603.09056).
    """

    def __init__(self, shape: RedNetShape = _CPU, *, channels: int = 1, seed: int = 0):
        super().__init__()
        if shape.depth < 2 or shape.depth % 2 or shape.width < 1:
            raise ValueError(f"RED-Net of depth {shape.depth} and width {shape.width}: expected an even depth ≥ 2")
        self.channels = _checked_channels("RED-Net", channels)
        half, width = shape.depth // 2, shape.width
        encoder = [nn.Conv2d(width if i else channels, width, 3, padding=1) for i in range(half)]
        ends = [*[width] * (half - 1), channels]
        decoder = [nn.ConvTranspose2d(width, maps, 3, padding=1) for maps in ends]
        self.encoder, self.decoder = nn.ModuleList(encoder), nn.ModuleList(decoder)
        _start([*encoder, *decoder], seed)

    def forward(self, picture: Tensor) -> Tensor:
        """picture: (B, C, H, W) of the network's channels; returns the restored images of the same shape.

        Raises ValueError for other shapes.
        """
        picture = _checked(picture, self.channels)
        features, x = [], picture
        for layer in self.encoder:
            x = layer(x).relu_()
            features.append(x)
        last = len(self.decoder)
        for i, layer in enumerate(self.decoder, 1):
            assert isinstance(layer, nn.ConvTranspose2d)
            x = conv2d(x, layer.weight.flip(-2, -1).transpose(0, 1), layer.bias, padding=1)
            if i < last:
                x = (x.add_(features[last - i - 1]) if i % 2 else x).relu_()
        return picture + x


class UNet(nn.Module):
    """A small U-Net: pairs of convolutions 3 × 3 at 1, 1/2, 1/4 … of the resolution, joined by skip connections.

        x + L(U_0),   E_0 = P(x),  E_i = P(max(E_(i-1))),  U_n = E_n,  U_i = P([E_i, T(U_(i+1))]),   n = levels

    P: two convolutions with ReLU, max: the largest of 2 × 2 pixels, T: a deconvolution 2 × 2 of stride 2, L: a
    convolution 1 × 1, which starts from zero: an untrained network returns its input. Level i has width·2^i maps. Sides
    that are no multiples of 2^levels are extended by their last pixels, and the result is cut back. channels: of the
    pictures, 3 for colours, which are restored together. Weights are in the memory format channels_last, in which
    convolutions of few maps are fast on a CPU. Ronneberger, Fischer and Brox, MICCAI 2015 (arXiv:1505.04597), whose
    convolutions have no padding.
    """

    def __init__(self, *, channels: int = 1, width: int = 16, levels: int = 2, seed: int = 0):
        super().__init__()
        if levels < 1 or width < 1:
            raise ValueError(f"U-Net of {levels} levels and width {width}: expected at least 1 of each, as 2 and 16")
        self.channels = _checked_channels("U-Net", channels)
        maps = [width * 2**level for level in range(levels + 1)]
        self.encoder = nn.ModuleList(map(_pair, [channels, *maps[:-1]], maps))
        self.upward = nn.ModuleList(nn.ConvTranspose2d(2 * m, m, 2, stride=2) for m in maps[:-1])
        self.decoder = nn.ModuleList(_pair(2 * m, m) for m in maps[:-1])
        self.last = nn.Conv2d(width, channels, 1)
        _start([layer for layer in self.modules() if isinstance(layer, nn.Conv2d | nn.ConvTranspose2d)], seed)
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]  # not in torch's overloads

    def forward(self, picture: Tensor) -> Tensor:
        """picture: (B, C, H, W) of the network's channels; returns the restored images of the same shape.

        Raises ValueError for other shapes.
        """
        picture = _checked(picture, self.channels)
        rows, columns = picture.shape[-2:]
        multiple = 2 ** len(self.decoder)
        x = pad(picture, (0, -columns % multiple, 0, -rows % multiple), mode="replicate")
        x = x.contiguous(memory_format=torch.channels_last)
        features = []
        for level, pair in enumerate(self.encoder):
            x = pair(nn.functional.max_pool2d(x, 2) if level else x)
            features.append(x)
        for level in reversed(range(len(self.decoder))):
            x = self.decoder[level](torch.cat([features[level], self.upward[level](x)], 1))
        return picture + self.last(x)[..., :rows, :columns]


def _pair(before: int, after: int) -> nn.Sequential:
    """Two convolutions 3 × 3 with ReLU."""
    layers = (nn.Conv2d(before, after, 3, padding=1), nn.Conv2d(after, after, 3, padding=1))
    return nn.Sequential(layers[0], nn.ReLU(inplace=True), layers[1], nn.ReLU(inplace=True))


@torch.no_grad()
def _start(layers: Sequence[Convolution], seed: int) -> None:
    """Random weights of layers in this order, and of the last one zero."""
    generator = torch.Generator().manual_seed(seed)
    for layer in layers:
        # He et al., ICCV 2015: preserves the variance after a ReLU; so many weights for every input map.
        count = layer.kernel_size[0] * layer.kernel_size[1] // (layer.stride[0] * layer.stride[1])
        scale = (2 / (count * layer.in_channels)) ** 0.5
        layer.weight.copy_(scale * torch.randn(layer.weight.shape, generator=generator))
        if layer.bias is not None:
            layer.bias.zero_()
    layers[-1].weight.zero_()


def _checked_channels(network: str, channels: int) -> int:
    if isinstance(channels, bool) or not isinstance(channels, int) or channels < 1:
        raise ValueError(f"{network} of channels={channels!r}: expected a whole number, 1 for grey or 3 for colours")
    return channels


def _checked(picture: Tensor, channels: int) -> Tensor:
    """Pictures (B, C, H, W) of so many channels. Raises ValueError for others."""
    picture = as_picture(picture)
    if picture.dim() == 4 and picture.shape[1] == channels:
        return picture
    shape = f"pictures of shape {tuple(picture.shape)}"
    if channels == 1:
        raise ValueError(
            f"{shape}: expected grey ones (B, 1, H, W); colours are a batch, as picture.flatten(0, 1)[:, None], or "
            "need a network of so many channels, as channels=3"
        )
    raise ValueError(f"{shape}: expected (B, {channels}, H, W), as the network was made with channels={channels}")

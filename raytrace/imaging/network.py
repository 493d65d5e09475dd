"""RED-Net, a convolutional network for image restoration.

Mao, Shen and Yang, "Image Restoration Using Very Deep Convolutional Encoder-Decoder Networks with Symmetric Skip
Connections", NIPS 2016 (arXiv:1603.09056).
"""

import dataclasses

import torch
from torch import Tensor, nn
from torch.nn.functional import conv2d

from raytrace.imaging.image import as_picture


@dataclasses.dataclass(frozen=True)
class RedNetShape:
    """depth: layers of encoder and decoder together, even; width: feature maps of the inner layers."""

    depth: int = 10
    width: int = 32


#: By name: the size of the published comparison, and one that two CPU cores train in minutes.
PRESETS = {"paper": RedNetShape(30, 64), "cpu": RedNetShape(10, 32)}


class RedNet(nn.Module):
    """Residual encoder-decoder: depth/2 convolutions 3 × 3, as many deconvolutions, and symmetric skip connections.

        x + D_n(… D_1(E_n(… E_1(x)))),   after D_i: ReLU(D_i + E_(n-i)),   i = 1, 3, 5 … < n = depth/2

    Every layer keeps the image size. A deconvolution of stride 1 is computed as the convolution with weights rotated by
    180°: its gradient takes a third of the time on a CPU. The last layer starts from zero: an untrained network returns
    its input.
    """

    def __init__(self, shape: RedNetShape = PRESETS["cpu"], *, seed: int = 0):
        super().__init__()
        if shape.depth < 2 or shape.depth % 2 or shape.width < 1:
            raise ValueError(f"RED-Net of depth {shape.depth} and width {shape.width}: expected an even depth ≥ 2")
        half, width = shape.depth // 2, shape.width
        self.encoder = nn.ModuleList(nn.Conv2d(width if i else 1, width, 3, padding=1) for i in range(half))
        self.decoder = nn.ModuleList(
            nn.ConvTranspose2d(width, width if i < half - 1 else 1, 3, padding=1) for i in range(half)
        )
        generator = torch.Generator().manual_seed(seed)
        with torch.no_grad():
            for layer in [*self.encoder, *self.decoder]:
                # He et al., ICCV 2015: preserves the variance after a ReLU; 9 weights for every input map.
                scale = (2 / (9 * layer.in_channels)) ** 0.5
                layer.weight.copy_(scale * torch.randn(layer.weight.shape, generator=generator))
                layer.bias.zero_()
            self.decoder[-1].weight.zero_()

    def forward(self, picture: Tensor) -> Tensor:
        """picture: (B, 1, H, W); returns the restored images of the same shape. Raises ValueError for other shapes."""
        picture = as_picture(picture)
        if picture.dim() != 4 or picture.shape[1] != 1:
            raise ValueError(
                f"pictures of shape {tuple(picture.shape)}: expected grey ones (B, 1, H, W); colours are a batch, "
                "as picture.flatten(0, 1)[:, None]"
            )
        features, x = [], picture
        for layer in self.encoder:
            x = layer(x).relu_()
            features.append(x)
        last = len(self.decoder)
        for i, layer in enumerate(self.decoder, 1):
            x = conv2d(x, layer.weight.flip(-2, -1).transpose(0, 1), layer.bias, padding=1)
            if i < last:
                x = (x.add_(features[last - i - 1]) if i % 2 else x).relu_()
        return picture + x

"""RED-Net and U-Net: their sizes, their skips, their start."""

import pytest
import torch

from raytrace.imaging.network import PRESETS, RedNet, RedNetShape, UNet, network

EARLIER = -0.44378799200057983, 62.78232338519113  # of a grey RED-Net, before there were colours


def parameters(network) -> int:
    return sum(p.numel() for p in network.parameters())


def test_sizes_are_those_of_the_paper():
    """2·half layers of 9·w² weights but for the first and the last, and their biases."""
    assert parameters(RedNet(PRESETS["paper"])) == 28 * (9 * 64 * 64 + 64) + (9 * 64 + 64) + (9 * 64 + 1) == 1_035_201
    assert parameters(RedNet(PRESETS["cpu"])) == 8 * (9 * 32 * 32 + 32) + (9 * 32 + 32) + (9 * 32 + 1) == 74_593


def test_an_untrained_network_returns_the_picture():
    picture = torch.rand(2, 1, 24, 17)
    torch.testing.assert_close(RedNet()(picture), picture, atol=0, rtol=0)


def test_seeds_decide_the_start():
    one, same, other = (RedNet(seed=s).encoder[1].weight for s in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert float(one.std()) == pytest.approx((2 / (9 * 32)) ** 0.5, rel=0.05)


def test_skips_carry_the_mirrored_layer_past_the_middle():
    """With the deepest layers dead, the output still depends on the picture: through the skip of E_4 to D_1."""
    network = RedNet(RedNetShape(10, 8))
    with torch.no_grad():
        network.decoder[-1].weight.fill_(0.1)
        network.encoder[4].weight.zero_()
        network.decoder[0].weight.zero_()
        picture = torch.rand(1, 1, 16, 16)
        learned = network(picture) - picture
        assert float(learned.std()) > 1e-4
        for layer in (network.encoder[3], network.encoder[1]):  # the layers that skips start from
            layer.weight.zero_()
        assert float((network(picture) - picture).std()) < 1e-9


def test_a_decoder_layer_is_the_deconvolution_that_holds_its_weights():
    """Two layers: x + D(ReLU(E(x))), with value and gradients of torch's ConvTranspose2d."""
    network = RedNet(RedNetShape(2, 5)).double()
    encode, decode = network.encoder[0], network.decoder[0]
    torch.manual_seed(0)
    torch.nn.init.normal_(decode.weight)
    torch.nn.init.normal_(decode.bias)
    picture = torch.rand(2, 1, 7, 9, dtype=torch.float64)

    def value_and_gradients(restored):
        return restored, *torch.autograd.grad(restored.square().sum(), list(network.parameters()))

    ours, expected = (
        value_and_gradients(network(picture)),
        value_and_gradients(picture + decode(encode(picture).relu())),
    )
    torch.testing.assert_close(ours, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize(
    ("network", "steps"),
    [(RedNet(RedNetShape(6, 16)), 30), (RedNet(RedNetShape(6, 16), channels=3), 60), (UNet(width=8, channels=3), 60)],
)
def test_it_learns_to_remove_noise(network, steps):
    """A few steps on one noisy picture reduce its error by a fifth."""
    torch.manual_seed(0)
    clean = torch.rand(4, network.channels, 1, 1).expand(-1, -1, 24, 24)
    noisy = clean + 0.1 * torch.randn(clean.shape)
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    errors = []
    for _ in range(steps):
        error = (network(noisy) - clean).abs().mean()
        optimizer.zero_grad()
        error.backward()
        optimizer.step()
        errors.append(float(error.detach()))
    assert errors[-1] < 0.8 * errors[0]


@pytest.mark.parametrize("shape", [RedNetShape(7, 8), RedNetShape(0, 8), RedNetShape(4, 0)])
def test_impossible_shapes_are_refused(shape):
    with pytest.raises(ValueError, match="expected an even depth"):
        RedNet(shape)


# -- colours


def test_channels_of_red_net():
    """Only the first and the last layer know of colours; the start of a grey network is that of earlier versions."""
    grey, colour = RedNet(seed=4), RedNet(channels=3, seed=4)
    assert parameters(colour) - parameters(grey) == 2 * (9 * 2 * 32) + 2
    shapes = [{name: tensor.shape for name, tensor in net.state_dict().items()} for net in (grey, colour)]
    assert {name for name in shapes[0] if shapes[0][name] != shapes[1][name]} == {
        "encoder.0.weight", "decoder.4.weight", "decoder.4.bias",
    }  # fmt: skip
    assert float(grey.encoder[0].weight[0, 0, 0, 0]) == pytest.approx(EARLIER[0], rel=1e-6)
    assert float(grey.decoder[3].weight.double().square().sum()) == pytest.approx(EARLIER[1], rel=1e-6)
    assert float(colour.encoder[0].weight.std()) == pytest.approx((2 / 27) ** 0.5, rel=0.05)
    assert not colour.decoder[-1].weight.any()


@pytest.mark.parametrize("preset", ["cpu", "unet"])
def test_colours_are_restored_together(preset):
    """Every restored channel depends on every channel of the picture."""
    restoring = network(preset, channels=3, seed=1)
    last = restoring.last if preset == "unet" else restoring.decoder[-1]
    torch.nn.init.normal_(last.weight, std=0.1, generator=torch.Generator().manual_seed(0))
    picture = torch.rand(1, 3, 16, 16, generator=torch.Generator().manual_seed(1)).requires_grad_()
    for channel in range(3):
        (slope,) = torch.autograd.grad(restoring(picture)[0, channel].sum(), picture)
        assert bool((slope[0].abs().amax((-2, -1)) > 1e-6).all())


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("channels", [1, 3])
def test_wrong_channels_are_refused(preset, channels):
    restoring = network(preset, channels=channels)
    for shape in ((2, 4 - channels, 8, 8), (8, 8), (1, channels, 1, 8, 8)):
        with pytest.raises(ValueError, match=rf"shape \({shape[0]}, .*expected (grey ones )?\(B, {channels}, H, W\)"):
            restoring(torch.rand(shape))
    with pytest.raises(ValueError, match="channels=0: expected a whole number"):
        network(preset, channels=0)


def test_other_networks_are_refused():
    with pytest.raises(ValueError, match="network 'vnet': expected paper, cpu, unet"):
        network("vnet")


# -- U-Net


def test_the_size_of_the_u_net():
    """Pairs of 9·w·w′ weights, deconvolutions of 4·w·w′, the last layer of w, and a bias for every map."""

    def pair(w, v):
        return 9 * w * v + v + 9 * v * v + v

    expected = pair(1, 16) + pair(16, 32) + pair(32, 64) + pair(64, 32) + pair(32, 16) + (16 + 1)
    expected += (4 * 64 * 32 + 32) + (4 * 32 * 16 + 16)
    assert parameters(UNet()) == expected == 116_753
    assert 4.0 < parameters(UNet(levels=3)) / expected < 4.3


@pytest.mark.parametrize("size", [(24, 17), (8, 8), (1, 1), (3, 64)])
@pytest.mark.parametrize("levels", [1, 2, 3])
def test_an_untrained_u_net_returns_pictures_of_any_size(size, levels):
    picture = torch.rand(2, 3, *size)
    torch.testing.assert_close(UNet(channels=3, width=4, levels=levels)(picture), picture, atol=0, rtol=0)


def trained(levels: int, seed: int = 0) -> UNet:
    """A U-Net whose last layer is not zero, in float64."""
    restoring = UNet(width=4, levels=levels, seed=seed).double()
    torch.nn.init.normal_(restoring.last.weight, generator=torch.Generator().manual_seed(seed))
    return restoring


def test_the_u_net_moves_with_the_picture():
    """A picture moved by 2^levels pixels is restored moved, far from its borders; by one pixel only nearly."""
    restoring = trained(2)
    with torch.no_grad():
        wide = torch.rand(1, 1, 68, 68, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
        whole, cut = restoring(wide), restoring(wide[..., 4:, 4:])
        torch.testing.assert_close(whole[..., 28:44, 28:44], cut[..., 24:40, 24:40], rtol=0, atol=1e-12)
        odd = restoring(wide[..., 1:, 1:])
        assert float((whole[..., 28:44, 28:44] - odd[..., 27:43, 27:43]).abs().max()) > 1e-3


def test_pictures_of_odd_size_are_extended_by_their_last_pixels():
    restoring = trained(3)
    picture = torch.rand(1, 1, 21, 30, dtype=torch.float64)
    extended = torch.cat([picture, picture[..., -1:].expand(-1, -1, -1, 2)], -1)
    extended = torch.cat([extended, extended[..., -1:, :].expand(-1, -1, 3, -1)], -2)
    torch.testing.assert_close(restoring(picture), restoring(extended)[..., :21, :30], rtol=0, atol=1e-14)


def test_skips_of_the_u_net():
    """Without the way through the lowest resolution the output depends on neighbours, through the skips alone."""
    restoring = trained(2)
    picture = torch.zeros(1, 1, 32, 32, dtype=torch.float64)
    point = picture.clone()
    point[..., 16, 16] = 1

    def reach() -> int:
        changed = (restoring(point) - restoring(picture)).abs()[0, 0] > 1e-9
        return int((changed.nonzero() - 16).abs().max())

    with torch.no_grad():
        assert 8 < reach() <= 18
        restoring.upward[0].weight.zero_()  # four convolutions 3 × 3 at full resolution remain
        assert reach() == 4
        restoring.decoder[0][0].weight[:, :4].zero_()  # which the skip carries
        assert reach() == 0


def test_the_u_net_has_derivatives():
    restoring = trained(2)
    picture = torch.rand(1, 1, 6, 5, dtype=torch.float64, requires_grad=True)
    names, weights = zip(*restoring.named_parameters(), strict=True)

    def call(picture, *weights):
        return torch.func.functional_call(restoring, dict(zip(names, weights, strict=True)), (picture,)).sum()

    assert torch.autograd.gradcheck(call, (picture, *weights), fast_mode=True)


@pytest.mark.parametrize(("levels", "width"), [(0, 4), (2, 0)])
def test_impossible_u_nets_are_refused(levels, width):
    with pytest.raises(ValueError, match="expected at least 1 of each"):
        UNet(levels=levels, width=width)

"""RED-Net: its size, its skips, its start."""

import pytest
import torch

from raytrace.imaging.network import PRESETS, RedNet, RedNetShape


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


def test_it_learns_to_remove_noise():
    """Ten steps on one noisy picture reduce its error by a fifth."""
    torch.manual_seed(0)
    network, clean = RedNet(RedNetShape(6, 16)), torch.rand(4, 1, 1, 1).expand(4, 1, 24, 24)
    noisy = clean + 0.1 * torch.randn(4, 1, 24, 24)
    optimizer = torch.optim.Adam(network.parameters(), 3e-3)
    errors = []
    for _ in range(30):
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

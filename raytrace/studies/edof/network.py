"""A small network in place of a filter alone: what it brings behind the best filter that knows no depth.

The element stays as it is. Pictures at depths drawn are blurred, noise is added, the filter restores them; the network
sees patches of that in any colour, told neither depth nor colour, and learns what the filter leaves.
"""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

import torch
from torch import Tensor, nn

from raytrace.imaging.network import RedNet, RedNetShape
from raytrace.imaging.restoration import depth_invariant_wiener
from raytrace.imaging.training import Record, Run, Share, train
from raytrace.studies.edof.training import scheduled
from raytrace.studies.edof.world import restored
from raytrace.studies.pictures import draws

_PATCH, _CROPS, _BATCH, _RATE = 64, 8, 16, 1e-3
_BLUR, _BATCHES, _JUDGE = 29, 30, 31  # last numbers of the keys of what is drawn


@dataclasses.dataclass(frozen=True)
class Filtered:
    """Transfer functions H (D, W, n, n), the best blind filter G (W, n, n) and the noise of one camera."""

    H: Tensor
    G: Tensor
    noise: float

    @classmethod
    def of(cls, H: Tensor, S: Tensor, noise: float) -> "Filtered":
        return cls(H, depth_invariant_wiener(H, S, noise), noise)

    def estimate(self, picture: Tensor, depth: int, *key: int) -> Tensor:
        """The filter's picture (W, n, n) of one (n, n) at a depth, noise drawn by the key."""
        noise = torch.as_tensor(draws(*key, depth, _BLUR).standard_normal(self.G.shape)).to(picture)
        return restored(self.H[depth], self.G, picture[None], self.noise * noise[None])[1][0]


def patches(camera: Filtered, pictures: Tensor, *, seed: int = 0) -> tuple[Tensor, Tensor]:
    """Filtered ones and true ones (N, 1, 64, 64), single precision, of pictures (B, n, n), each at a depth drawn."""
    half, given, true = pictures.shape[-1] // 2, [], []
    for number, picture in enumerate(pictures):
        random = draws(seed, number, _BLUR)
        estimate = camera.estimate(picture, int(random.integers(len(camera.H))), seed, number)
        for _ in range(_CROPS):
            row, column = (int(n) for n in random.integers(0, half - _PATCH + 1, 2))
            cut = (..., slice(row, row + _PATCH), slice(column, column + _PATCH))
            given.append(estimate[cut].float())
            true.append(picture[cut].float().expand_as(given[-1]))
    return torch.cat(given)[:, None], torch.cat(true)[:, None]


def learn_network(
    folder: Path,
    data: Callable[[], tuple[Tensor, Tensor]],
    settings: dict,
    *,
    steps: int,
    seed: int = 0,
    bar: Callable[[Iterator], Iterable] = iter,
) -> RedNet:
    """A network that has learned what was left; resumed where the run stands. Data: made only where steps are left."""
    network, run = RedNet(RedNetShape(6, 16), seed=seed), Run(folder, settings | {"steps": steps, "seed": seed})
    state = run.load()
    if state is not None and state["step"] >= steps:
        network.load_state_dict(state["module"])
        return network
    given, true = data()
    optimizer = torch.optim.Adam(network.parameters(), lr=_RATE)

    def loss(step: int, share: Share) -> tuple[Tensor, Record]:
        for group in optimizer.param_groups:
            group["lr"] = _RATE * scheduled("cosine", step / steps)
        chosen = torch.as_tensor(draws(seed, step, _BATCHES).integers(0, len(given), _BATCH))
        return (network(given[chosen]) - true[chosen]).square().mean() / share.processes, {}

    for _ in bar(train(network, optimizer, loss, steps=steps, run=run, every=50)):
        pass
    return network


@torch.no_grad()
def errors_behind(
    camera: Filtered, network: nn.Module, pictures: Tensor, *, progress: Callable[[Iterable], Iterable] = iter
) -> dict[str, Tensor]:
    """Errors (B, D, W) of pictures (B, n, n) behind the filter alone and with the network, the same noise."""
    half = pictures.shape[-1] // 2
    found: dict[str, list[Tensor]] = {"filter": [], "network": []}
    for number, picture in progress(list(enumerate(pictures))):
        own: dict[str, list[Tensor]] = {name: [] for name in found}
        for depth in range(len(camera.H)):
            estimate = camera.estimate(picture, depth, number, _JUDGE)[:, :half, :half]
            better = network(estimate[:, None].float())[:, 0].to(estimate)
            for name, one in (("filter", estimate), ("network", better)):
                own[name].append((one - picture[:half, :half]).square().mean((-2, -1)))
        for name, rows in own.items():
            found[name].append(torch.stack(rows))
    return {name: torch.stack(rows) for name, rows in found.items()}

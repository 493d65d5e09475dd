"""A training of a few steps."""

import torch

from raytrace.imaging.training import Run, train


def fit(folder, steps, *, every=5, seconds=60.0, stop_at=None, poison=None):
    """Adam on a small regression whose samples are keyed by their number; returns the weights."""
    module = torch.nn.Sequential(torch.nn.Linear(3, 4), torch.nn.Tanh(), torch.nn.Linear(4, 1)).double()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in module.parameters():
            p.copy_(torch.randn(p.shape, generator=generator, dtype=torch.float64))
    optimizer = torch.optim.Adam(module.parameters(), 1e-2)

    def loss(step, share):
        total = torch.zeros((), dtype=torch.float64)
        for sample in share.of(range(8 * step, 8 * step + 8)):
            x = torch.randn(3, generator=torch.Generator().manual_seed(sample), dtype=torch.float64)
            total = total + (module(x) - x.sum()).square().sum() / 8
        return total * (float("nan") if step == poison else 1.0), {"weight": float(module[0].bias[0].detach())}

    run = Run(folder, {"rate": 1e-2})
    for step, _ in train(module, optimizer, loss, steps=steps, run=run, every=every, seconds=seconds):
        if stop_at is not None and step == stop_at:
            return None
    return [p.detach().clone() for p in module.parameters()]

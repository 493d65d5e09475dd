"""Training runs: killed, resumed, stopped at a loss that is not a number; two processes: `test_shards`."""

import itertools
import os
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch
from problems_training import fit

import raytrace
from raytrace.imaging.training import NotFinite, OtherSettings, Run, Share, train

#: Where processes started by a test find it and the package.
PATHS = [os.path.dirname(__file__), str(Path(raytrace.__file__).parents[1])]


def test_a_stopped_run_resumes_bit_identically(tmp_path):
    whole = fit(tmp_path / "whole", 23)
    for stop_at in (13, 4, 17):
        fit(tmp_path / "parts", 23, stop_at=stop_at)
    parts = fit(tmp_path / "parts", 23)
    assert all(torch.equal(a, b) for a, b in zip(whole, parts, strict=True))
    assert (tmp_path / "whole/log.csv").read_bytes() == (tmp_path / "parts/log.csv").read_bytes()
    rows = Run(tmp_path / "parts", {"rate": 1e-2}).rows()
    assert [row["step"] for row in rows] == list(range(23))
    assert rows[-1]["loss"] < rows[0]["loss"]
    assert set(rows[0]) == {"step", "loss", "weight"}


def test_checkpoints_by_time_change_no_number(tmp_path):
    """With no time between checkpoints there is one behind every step: a run stopped at 7 goes on there."""
    whole = fit(tmp_path / "whole", 12, every=100)
    fit(tmp_path / "parts", 12, every=100, seconds=0.0, stop_at=7)
    assert Run(tmp_path / "parts", {"rate": 1e-2}).load()["step"] == 8
    parts = fit(tmp_path / "parts", 12, every=100)
    assert all(torch.equal(a, b) for a, b in zip(whole, parts, strict=True))
    assert (tmp_path / "whole/log.csv").read_bytes() == (tmp_path / "parts/log.csv").read_bytes()


@pytest.mark.slow
def test_a_killed_process_leaves_a_run_that_resumes(tmp_path):
    """kill -9 in the middle, twice; the end is that of a run that was never killed."""
    script = textwrap.dedent(f"""
        import sys, time
        sys.path[:0] = {PATHS!r}
        import raytrace.imaging.training as training
        from test_training import fit
        append = training.Run.append
        def slowly(self, rows):
            append(self, rows)
            print("row", flush=True)
            time.sleep(0.05)
        training.Run.append = slowly
        fit({str(tmp_path / "killed")!r}, 40, every=2)
    """)
    for _ in range(2):
        process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True)
        for _ in range(4):
            process.stdout.readline()
        process.send_signal(signal.SIGKILL)
        process.wait()
        process.stdout.close()
    checkpoint = Run(tmp_path / "killed", {"rate": 1e-2}).load()
    assert 0 < checkpoint["step"] < 40
    killed, whole = fit(tmp_path / "killed", 40, every=2), fit(tmp_path / "whole", 40, every=2)
    assert all(torch.equal(a, b) for a, b in zip(whole, killed, strict=True))
    assert (tmp_path / "whole/log.csv").read_bytes() == (tmp_path / "killed/log.csv").read_bytes()


def test_other_settings_are_refused(tmp_path):
    fit(tmp_path, 3)
    with pytest.raises(OtherSettings, match=r"rate was 0\.01, now 0\.1; .*another folder"):
        Run(tmp_path, {"rate": 0.1})


def test_a_loss_that_is_no_number_stops_the_run_before_the_step(tmp_path):
    with pytest.raises(NotFinite, match=r"step 7: .*nan.*checkpoint\.pt"):
        fit(tmp_path, 20, poison=7)
    state = Run(tmp_path, {"rate": 1e-2}).load()
    assert state["step"] == 5
    assert all(bool(torch.isfinite(p).all()) for p in state["module"].values())
    with pytest.raises(NotFinite, match="the loss is nan; lower the learning rate; no checkpoint was written yet"):
        fit(tmp_path / "early", 20, poison=2)


def test_a_gradient_that_is_not_finite_is_reported_as_such(tmp_path):
    module = torch.nn.Linear(1, 1)

    def root(step, share):
        return torch.sqrt(0.0 * module.weight.sum()), {}

    steps = train(module, torch.optim.SGD(module.parameters(), 0.1), root, steps=3, run=Run(tmp_path, {}))
    with pytest.raises(NotFinite, match="step 0: a gradient is not finite; lower the learning rate"):
        next(steps)


def test_rates_follow_the_schedule_of_the_whole_run(tmp_path):
    """In a resumed run too, whose checkpoint holds the rates of its step."""
    for stop in (2, None):
        module = torch.nn.Linear(1, 1)
        groups = [{"params": [module.weight], "lr": 1.0}, {"params": [module.bias], "lr": 0.5}]
        optimizer, rates = torch.optim.SGD(groups), {}

        def loss(step, share, module=module, optimizer=optimizer, rates=rates):
            rates[step] = [group["lr"] for group in optimizer.param_groups]
            return module(torch.ones(1)).square().sum(), {}

        run = Run(tmp_path, {})
        for step, _ in train(module, optimizer, loss, steps=4, run=run, every=1, schedule="linear"):
            if step == stop:
                break
    assert rates == {3: [0.25, 0.125]}


def test_shares_of_a_batch_are_all_of_it():
    shares = [Share(rank, 3).of(range(32, 64)) for rank in range(3)]
    assert sorted(itertools.chain(*shares)) == list(range(32, 64))
    assert max(map(len, shares)) - min(map(len, shares)) <= 1

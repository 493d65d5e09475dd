"""Processes of torchrun: what they compute together is what one computes, and they end together."""

import json
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from problems_training import fit

import raytrace as rt
from raytrace import shards
from raytrace.cli import main
from raytrace.files import shipped
from raytrace.maths.sampling import grid
from raytrace.psf_models import Execution, Fourier, Gaussian, model_of, models, psf
from raytrace.psf_models.result import mixture
from raytrace.shards import Share
from raytrace.system.lens import Lens
from raytrace.system.surface import Aperture

ROOT = Path(rt.__file__).parents[1]
#: One process and several differ in the order of sums only: a few roundings of numbers up to 40 (mm).
ROUNDING = 1e-12
FOCUS = 57.662  # mm, sensor of the double Gauss

#: Conditions of `raytrace.psf_models.psf`: every axis is cut, and every decision differs between the blocks of a scene.
CASES = {
    # A field on the axis is round, one in y-z a mirror image of itself, one off it neither.
    "fields": {"model": "gaussian", "fields": [[0.0, 0.0, 5.0], [0.0, 9.0, 5.0]], "center": "chief", "order": 3},
    "fields of a map": {"model": "drt", "fields": [[0.0, 0.0], [0.0, 2.0]], "center": "chief", "order": 1},
    # Cells are as fine as the largest blur needs, of all object distances.
    "distances": {"model": "drt", "object_distances": [5e3, 2e4, 3e4], "fields": [[0.0], [2.0]], "center": "chief"},
    "wavelengths": {"model": "drt", "wavelengths": [0.45, 0.55, 0.65], "order": 1},
    "waves of distances": {"model": "wave", "object_distances": [2.2e4, 3e4], "wavelengths": [0.6], "order": -2},
    "waves of fields": {"model": "wave", "fields": [[0.0, 0.0, 0.0], [0.0, 1.0, 2.0]], "center": "chief", "order": -2},
    "rings": {"model": "fourier", "wavelengths": [0.45, 0.65], "object_distances": [2.3e4], "order": 0},
    "rays of one kernel": {"model": "gaussian", "fields": [[0.0], [7.0]], "wavelengths": [0.55], "center": "centroid"},
    "plain rays": {"model": "drt", "fields": [[0.0, 0.0], [0.0, 9.0]], "center": "chief", "rays": 333},
    "one plain ray": {"model": "drt", "wavelengths": [0.55], "rays": 1},
    "clipped fields": {"model": "gaussian", "fields": [[0.0, 0.0], [0.0, 9.0]], "center": "chief", "order": 3},
    "to a tolerance": {"model": "gaussian", "fields": [[0.0, 0.0], [0.0, 9.0]], "center": "chief", "tol": 1e-3},
    "finite and infinite": {"model": "gaussian", "object_distances": [1e4, float("inf"), 3e4], "order": 3},
    "one kernel of a ray map": {"model": "drt", "wavelengths": [0.55], "order": 1},
    "paraxial": {"model": "paraxial", "fields": [[0.0, 0.0], [0.0, 9.0]], "center": "chief"},
}
CLIPPED = ("clipped fields",)


def lens() -> Lens:
    """The double Gauss, in focus at 25 m."""
    found = rt.system.with_object_distance(rt.read_lens(shipped("lenses") / "double_gauss.zmx"), 25000.0)
    return rt.system.with_sensor_distance(found, FOCUS)


def kernels(of: Lens, case: dict) -> dict[str, np.ndarray]:
    """The numbers of a case, computed by the processes there are."""
    words = {"fields": [[0.0], [0.0]], **case}
    words = {key: torch.tensor(v, dtype=torch.float64) if isinstance(v, list) else v for key, v in words.items()}
    with torch.no_grad():
        numbers = {key: words.pop(key) for key in ("order", "rays") if key in words}
        model = model_of(words.pop("model"), **numbers)
        found = psf(of, model, grid=grid(0.01, 9), execution=Execution(share=shards.share()), **words)
    numbers = {name: getattr(found, name) for name in ("kernel", "energy", "error", "centroid", "covariance")}
    return {**{name: t.numpy() for name, t in numbers.items()}, "rays": np.array(found.rays)}


def vignetted() -> Lens:
    """The double Gauss with a front that cuts the beam of 9° and lets that of the axis pass."""
    return lens().replace(1, apertures=(Aperture("circular", (0.0, 20.0)),))


def cases(names: tuple[str, ...]) -> dict[str, dict[str, np.ndarray]]:
    """Cases of these names, by the processes there are."""
    clear, clipped = lens(), vignetted()
    return {name: kernels(clipped if name in CLIPPED else clear, CASES[name]) for name in names}


def work(folder: str, names: tuple[str, ...]) -> None:
    """Each process of the tests of two: kernels, ten steps of training, an error."""
    with shards.processes() as share:
        weights = fit(Path(folder, "training of two"), 10)
        if share.rank == 0:
            torch.save(weights, Path(folder, "weights.pt"))
        found = {f"{name}/{key}": t for name, numbers in cases(names).items() for key, t in numbers.items()}
        np.savez(Path(folder, f"{share.rank}.npz"), **found)
        try:
            with shards.agreeing() as largest:
                if share.rank == 1:
                    raise ValueError("the share of 1 makes no sense")
                largest(torch.zeros(()))
            said = "nothing"
        except ValueError as error:
            said = f"{type(error).__name__}: {error}"
        Path(folder, f"{share.rank}.txt").write_text(said)


def kill_itself(*words: str) -> None:
    """The command line of a process that is killed, if it is number 1, as soon as kernels are put together."""
    together = models.total

    def killed(part):
        if shards.share().rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        return together(part)

    models.total = killed
    sys.exit(main(words))


def begin(*words: str, folder: Path, processes: int = 2) -> subprocess.CompletedProcess:
    """Run a command of Python by torchrun; nothing of it is left behind."""
    head = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node", str(processes)]
    paths = os.pathsep.join([str(Path(__file__).parent), str(ROOT)])
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1"}
    with subprocess.Popen(
        [*head, *words], cwd=folder, env=environment, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as begun:
        try:
            out, err = begun.communicate(timeout=120)
        finally:
            begun.terminate()  # torchrun ends its processes
    return subprocess.CompletedProcess(words, begun.returncode, out, err)


def run_function(call: str, *, folder: Path, processes: int = 2) -> subprocess.CompletedProcess:
    (folder / "script").mkdir()
    (folder / "script" / "begin.py").write_text(f"import test_shards\n\ntest_shards.{call}\n")
    return begin(str(folder / "script" / "begin.py"), folder=folder, processes=processes)


# ---------------------------------------------------------------- several processes


EACH_AXIS = ("fields", "distances", "wavelengths", "paraxial")


@pytest.mark.slow
@pytest.mark.parametrize("names", [EACH_AXIS, tuple(CASES)], ids=["one of each axis", "all"])
def test_two_processes_compute_and_train_as_one_does(tmp_path, names):
    """One start of torchrun. Kernels of every model, each axis of a scene cut in turn."""
    done = run_function(f"work({str(tmp_path)!r}, {names!r})", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    check_work(tmp_path, names)


def work_in_a_fork(rank: int, port: int, folder: str) -> None:
    """The work of one of two processes, in the environment that torchrun would give it."""
    words = {"TORCHELASTIC_RUN_ID": "test", "MASTER_ADDR": "localhost", "MASTER_PORT": port}
    numbers = {"RANK": rank, "LOCAL_RANK": rank, "WORLD_SIZE": 2, "LOCAL_WORLD_SIZE": 2}
    os.environ |= {name: str(value) for name, value in (words | numbers).items()}
    torch.set_num_threads(1)  # a fork has none of the other threads
    work(folder, EACH_AXIS)


@pytest.mark.skipif(torch.cuda.is_available(), reason="autograd does not fork where there is a GPU")
def test_two_forks_compute_and_train_as_one_process_does(tmp_path):
    """Without torchrun, which would load torch three times anew."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    context = multiprocessing.get_context("fork")
    forks = [context.Process(target=work_in_a_fork, args=(rank, port, str(tmp_path))) for rank in range(2)]
    for fork in forks:
        fork.start()
    for fork in forks:
        fork.join(120)
    assert [fork.exitcode for fork in forks] == [0, 0]
    check_work(tmp_path, EACH_AXIS)


def check_work(tmp_path, names):
    """Kernels to rounding in both processes; weights after ten steps of Adam, to 1e-12; an error of one process is
    raised in all."""
    together = [np.load(tmp_path / f"{rank}.npz") for rank in range(2)]
    for name, numbers in cases(names).items():
        for key, expected in numbers.items():
            first, second = (found[f"{name}/{key}"] for found in together)
            np.testing.assert_array_equal(first, second, err_msg=f"{name}: {key} of the processes")
            # An estimated error is a small difference of sums, and has two digits.
            close = 1e-9 if key == "error" else ROUNDING
            np.testing.assert_allclose(first, expected, rtol=close, atol=close, err_msg=f"{name}: {key}")
    torch.testing.assert_close(torch.load(tmp_path / "weights.pt"), fit(tmp_path / "one", 10), atol=1e-12, rtol=1e-12)
    assert (tmp_path / "0.txt").read_text() == "FailedElsewhere: the share of 1 makes no sense"
    assert (tmp_path / "1.txt").read_text() == "ValueError: the share of 1 makes no sense"


COMMAND = ("psf", "double_gauss", "--model", "drt", "--rays", "200", "--field", "0", "14", "--json")


@pytest.mark.slow
def test_torchrun_writes_the_output_of_the_command_once(command, tmp_path):
    code, out, _ = command(*COMMAND, "-o", "one.npz", "--plot", "one.png")
    assert code == 0
    done = begin("-m", "raytrace", *COMMAND, "-o", "two.npz", "--plot", "two.png", folder=tmp_path)
    assert done.returncode == 0, done.stderr
    one, two = json.loads(out), json.loads(done.stdout)
    assert (two["model"], len(two["results"])) == (one["model"], len(one["results"])) == ("drt", 2)
    for a, b in zip(one["results"], two["results"], strict=True):
        assert b["centroid"] == pytest.approx(a["centroid"], rel=ROUNDING, abs=ROUNDING)
        assert (b["energy"], b["rays"]) == (pytest.approx(a["energy"], rel=ROUNDING), a["rays"])
    with np.load("one.npz") as a, np.load("two.npz") as b:
        assert a.files == b.files
        np.testing.assert_allclose(b["psf"], a["psf"], rtol=0, atol=ROUNDING)
    assert done.stderr.count("written: two.npz") == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.npz", "one.png", "two.npz", "two.png"]


@pytest.mark.slow
def test_a_killed_process_ends_the_job_with_one_line_and_no_file(tmp_path):
    words = ("psf", "double_gauss", "--model", "gaussian", "--field", "0", "14", "-o", "kernels.npz")
    done = run_function(f"kill_itself(*{words!r})", folder=tmp_path)
    assert done.returncode != 0
    said = [line for line in done.stderr.splitlines() if line.startswith("raytrace: ")]
    assert len(said) == 1, done.stderr
    assert "raytrace: error: " in said[0]
    assert "another process of this job has" in said[0]
    assert (done.stdout, [path.name for path in tmp_path.iterdir()]) == ("", ["script"])


@pytest.mark.slow
def test_a_refusal_is_reported_once(tmp_path):
    done = begin("-m", "raytrace", "psf", "double_gaus", folder=tmp_path)
    assert done.returncode != 0
    assert done.stderr.count("raytrace: error: double_gaus: no such lens file") == 1, done.stderr


# ---------------------------------------------------------------- one process


@pytest.mark.parametrize(
    ("shape", "processes", "by_field", "expected"),
    [
        ((4, 3, 3), 2, False, (2, 1, 1)),
        ((1, 3, 5), 4, False, (1, 3, 1)),
        ((1, 3, 5), 6, False, (1, 1, 5)),
        ((1, 3, 5), 20, False, (1, 3, 5)),
        ((1, 1, 1), 8, False, (1, 1, 1)),
        ((2, 2, 2), 8, True, (2, 1, 2)),
        ((2, 3, 1), 3, True, (1, 3, 1)),
    ],
)
def test_axes_are_cut_for_the_smallest_largest_block(shape, processes, by_field, expected):
    """(2, 2, 2) by field: four kernels in turn for two fields each, or one field at a time on four of the processes."""
    assert models._cuts(shape, processes, by_field=by_field) == expected


@pytest.mark.parametrize(("shape", "cut"), [((4, 3, 3), (2, 1, 3)), ((5, 2, 7), (3, 2, 4)), ((1, 1, 1), (1, 1, 1))])
def test_blocks_hold_every_kernel_once(shape, cut):
    seen = np.zeros(shape, int)
    for number in range(int(np.prod(cut))):
        seen[models._block(shape, cut, number)] += 1
    assert (seen == 1).all()


def test_parts_of_a_row_are_all_of_it():
    for count in (1, 2, 7, 100):
        found = [i for rank in range(3) for i in range(count)[Share(rank, 3).part(count)]]
        assert found == list(range(count))


def test_moments_of_parts_are_those_of_all_light():
    """A spot of 1 nm at 1 m off the axis, in three parts, one of them dark, against numbers of 1 nm about the axis."""
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(2, 300, generator=generator, dtype=torch.float64)
    weights = torch.rand(300, generator=generator, dtype=torch.float64)
    weights[100:200] = 0

    def moments(x, y, w):
        energy = w.sum()
        share = w / energy if energy > 0 else w
        mean = torch.stack([(share * x).sum(), (share * y).sum()])
        a, b = x - mean[0], y - mean[1]
        return energy, mean, torch.stack([(share * p * q).sum() for p, q in ((a, a), (a, b), (b, b))])

    parts = [moments(*points[:, n : n + 100], weights[n : n + 100]) for n in (0, 100, 200)]
    mean, covariance = mixture(*(torch.stack(column, -1) for column in zip(*parts, strict=True)))
    _, expected_mean, expected = moments(*points, weights)
    torch.testing.assert_close(mean, expected_mean, rtol=1e-14, atol=1e-14)
    torch.testing.assert_close(covariance, expected, rtol=1e-14, atol=1e-14)


def test_shared_kernels_have_no_gradient():
    of = lens()
    sensor = of.surfaces[-2].thickness.clone().requires_grad_()
    of = rt.system.with_sensor_distance(of, sensor)
    with pytest.raises(ValueError, match="no gradient: leave share out"):
        psf(of, Gaussian(order=3), execution=Execution(share=Share(0, 2)))
    with pytest.raises(ValueError, match="one rho and one zernike"):
        psf(lens(), Fourier(order=0, zernike=torch.zeros(4, 1, 2, 1)), execution=Execution(share=Share(0, 2)))

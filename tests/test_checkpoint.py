"""Checkpoints of an optimisation: resumed bit-identically, refused where they are of something else, or damaged; and
time that is kept to."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from problems_stores import STRANGE, put

import raytrace as rt
from raytrace import stores
from raytrace.io import read_lens
from raytrace.materials.catalogs import find_glass
from raytrace.optimization import checkpoint, least_squares
from raytrace.optimization.checkpoint import BadCheckpoint
from raytrace.optimization.least_squares import Sides, SumOfSquares, best_of_paths
from raytrace.optimization.lifted import Lifted

TRIPLET = read_lens("cooke_triplet")
SPOT = {"merit": "spot", "vary": "curvature sensor", "cycles": 8}
PATHS = {"merit": "spot", "vary": "curvature thickness", "hold": "efl=100", "bounds": "thickness:1..", "paths": 3}


def mean_square(lens):
    """mm², a merit that is not a sum of squares."""
    return rt.spot(lens, fields=[0.0, 8.0]).whole.rms_radius.square().mean()


DEAR = ("a function", "paths that end by themselves")
HOW = {
    "one path": SPOT,
    "paths that end by themselves": {**PATHS, "vary": "curvature:1-3", "bounds": None, "cycles": 60},
    "held, bounded, ended by cycles": {**PATHS, "cycles": 14},
    "a function": {"merit": mean_square, "vary": "curvature:1,2 sensor", "cycles": 6},
}


class Stops(Exception):
    pass


def stops_at(cycle):
    """A bar of progress that raises after so many cycles, as a process that is killed does."""

    class Bar:
        def __init__(self, *arguments):
            self.n = 0

        def update(self, n):
            self.n += n
            if self.n >= cycle:
                raise Stops

        set_postfix_str = close = lambda self, *arguments: None

    return Bar


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in DEAR else ()) for name in HOW])
def test_an_interrupted_run_resumes_to_the_same_end(name, tmp_path, monkeypatch):
    """The same variables, merits, dampings and evaluations to the last bit, wherever it was interrupted."""
    monkeypatch.setattr(checkpoint, "EVERY", 0.0)
    how, path, log = HOW[name], tmp_path / "kept.json", tmp_path / "log.csv"
    whole = rt.optimize(TRIPLET, log=tmp_path / "whole.csv", **how)
    for cycle in (1, 3, whole.cycles - 1):
        with pytest.raises(Stops):
            rt.optimize(TRIPLET, checkpoint=path, progress=stops_at(cycle), **how)
        again = rt.optimize(TRIPLET, resume=path, checkpoint=path, log=log, **how)
        assert torch.equal(again.variables_after, whole.variables_after)
        assert torch.equal(again.history[:, :4], whole.history[:, :4])
        assert (again.evaluations, again.stopped, again.merit_after) == (
            whole.evaluations,
            whole.stopped,
            whole.merit_after,
        )
        rows = [
            [line.split(",")[:6] for line in file.read_text().splitlines()] for file in (log, tmp_path / "whole.csv")
        ]
        assert rows[0] == rows[1]


def test_cycles_count_from_the_start_and_more_cycles_resume(tmp_path):
    path = tmp_path / "kept.json"
    first = rt.optimize(TRIPLET, checkpoint=path, **SPOT | {"cycles": 3})
    assert first.cycles == 3
    same = rt.optimize(TRIPLET, resume=path, **SPOT | {"cycles": 3})
    assert (same.cycles, same.stopped, same.merit_after) == (3, "cycles", first.merit_after)
    more, whole = (rt.optimize(TRIPLET, **given, **SPOT) for given in ({"resume": path}, {}))
    assert torch.equal(more.variables_after, whole.variables_after)


OTHERS = {
    "another lens: 'Cooke triplet.* of 8 surfaces, not 'Tessar": (
        read_lens("tessar"),
        {"vary": "curvature:1-4 sensor"},
    ),
    "another lens: .* glass 'SK4' of surface 1, not 'N-BK7'": (TRIPLET.replace(1, glass=find_glass("N-BK7")), {}),
    "another lens: .* thickness 12.93 of surface 2, not 13": (TRIPLET.replace(2, thickness=13.0), {}),
    "other conditions": (TRIPLET.at(fields=[0.0, 7.0]), {}),
    "other variables: .*; expected thickness_1 among them": (TRIPLET, {"vary": "curvature:1-4 sensor thickness:1"}),
    "other merit": (TRIPLET, {"merit": rt.optimization.DefaultMerit("spot", rings=4)}),
    "other hold": (TRIPLET, {"hold": "efl=100"}),
    "other paths": (TRIPLET, {"paths": 2}),
    "other bounds": (TRIPLET, {"bounds": "sensor:70..90"}),
    "other glasses that vary": (TRIPLET, {"vary": "curvature:1-4 sensor glass:1"}),
}


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    path = tmp_path_factory.mktemp("kept") / "kept.json"
    rt.optimize(TRIPLET, checkpoint=path, merit="spot", vary="curvature:1-4 sensor", cycles=2)
    return path


@pytest.mark.parametrize("words", OTHERS)
def test_a_checkpoint_of_something_else_is_refused_by_name(words, kept):
    lens, how = OTHERS[words]
    with pytest.raises(BadCheckpoint, match=f"kept.json: a checkpoint of {words}"):
        rt.optimize(lens, resume=kept, **{"merit": "spot", "vary": "curvature:1-4 sensor", "cycles": 3} | how)


def test_a_checkpoint_of_an_older_version_is_refused(kept, tmp_path):
    document = json.loads(kept.read_text())
    path = tmp_path / "old.json"
    path.write_text(json.dumps({key: document[key] for key in ("merit", "cycles", "variables")}))
    with pytest.raises(BadCheckpoint, match=r"old.json: .*older version"):
        rt.optimize(TRIPLET, resume=path, merit="spot", vary="curvature:1-4 sensor")


def mutations(document: dict):
    """A checkpoint with every part in turn replaced by whatever JSON can hold, as texts."""
    places = [(key,) for key in ("of", "variables", "cycles", "descent")]
    places += [("descent", key) for key in document["descent"]] + [("variables", "sensor"), ("of", "prescription")]
    places += [
        ("descent", "history", 0),
        ("descent", "history", 0, 1),
        ("descent", "history", 0, 7),
        ("descent", "x", 0),
    ]
    marker = "@@@"
    for place in places:
        changed = json.loads(json.dumps(document))
        inside = changed
        for key in place[:-1]:
            inside = inside[key]
        inside[place[-1]] = marker
        text = json.dumps(changed)
        for name, content in STRANGE.items():
            if (place, name) == (("descent", "best"), "null"):
                continue
            if place[-1] == 7 and name in ("text", "lone half"):
                continue
            yield f"{place} {name}", text.replace(f'"{marker}"', content)
    for name, content in STRANGE.items():
        yield f"all {name}", content
    for key in ("x", "start"):
        for values in ([], document["descent"]["x"][1:], [*document["descent"]["x"], 0.0]):
            yield f"{key} of {len(values)}", json.dumps(document | {"descent": document["descent"] | {key: values}})
    yield "before", json.dumps(document | {"descent": document["descent"] | {"before": [9, 0]}})
    yield "best", json.dumps(document | {"descent": document["descent"] | {"best": [[1.0], "merit"]}})
    yield "glasses", json.dumps(document | {"glasses": {"x": ["SCHOTT", "N-BK7"]}})
    yield "evaluated", json.dumps(document | {"evaluated": [[1.0, 2.0], [1.0]]})


def test_damaged_checkpoints_are_refused_in_a_line(kept, tmp_path):
    document, path, count = json.loads(kept.read_text()), tmp_path / "damaged.json", 0
    of, names = document["of"], [*document["variables"]]
    assert checkpoint.read_checkpoint(kept, of, names).descent is not None
    for name, content in mutations(document):
        put(path, content)
        with pytest.raises(BadCheckpoint, match=r"damaged.json(, line \d+)?: ") as error:
            checkpoint.read_checkpoint(path, of, names)
        assert "\n" not in str(error.value), name
        assert len(str(error.value)) < 600, name
        count += 1
    assert count > 200


def test_a_checkpoint_that_cannot_be_written_ends_nothing(tmp_path, monkeypatch):
    def full(path, document):
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(stores, "write_json", full)
    with pytest.warns(rt.files.NotWritten, match=r"kept.json: No space left.*continues"):
        found = rt.optimize(TRIPLET, checkpoint=tmp_path / "kept.json", **SPOT | {"cycles": 2})
    assert found.cycles == 2


@pytest.mark.parametrize(
    ("files", "words"),
    [
        ({"log": "no/log.csv"}, "the folder .*no does not exist"),
        ({"checkpoint": "no/kept.json"}, "the folder .*no does not exist"),
        ({"checkpoint": "kept.zmx"}, "expected a name that ends in .json"),
        ({"log": "lens.zmx"}, "expected a name that ends in .csv"),
        ({"log": "a.csv", "resume": "a.csv"}, "`log` and `resume` are one file"),
    ],
)
def test_files_are_checked_before_the_work(files, words, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((OSError, ValueError), match=words):
        rt.optimize(TRIPLET, **SPOT, **files)


# -- time -------------------------------------------------------------------------------------------------------------


class Clock:
    """Time that passes in evaluations alone: 1 s each, 10 s with derivatives."""

    def __init__(self, monkeypatch):
        self.now = 100.0
        monkeypatch.setattr(least_squares.time, "monotonic", lambda: self.now)

    def state(self, x, derivatives):
        """A narrow valley (Rosenbrock)."""
        self.now += 10.0 if derivatives else 1.0
        r = np.array([10 * (x[1] - x[0] ** 2), 1 - x[0]])
        none, slope = np.zeros(0), np.zeros((0, 2))
        J = np.array([[-20 * x[0], 10.0], [-1.0, 0.0]]) if derivatives else None
        return SumOfSquares(x, r, 0, Sides.none(2), none, none, J, slope, slope)

    def __call__(self, x):
        self.now += 10.0
        state = self.state(x, True)
        return state.cost, 2 * state.jacobian.T @ state.residuals


FREE = {"lower": np.full(2, -np.inf), "upper": np.full(2, np.inf)}


@pytest.mark.parametrize("seconds", [0.0, 5.0, 25.0, 40.0, 77.0, 120.0])
def test_no_step_begins_that_would_not_end_in_time(seconds, monkeypatch):
    clock = Clock(monkeypatch)
    found = best_of_paths(clock.state, np.array([-1.2, 1.0]), seconds=seconds, paths=3, **FREE)
    assert found.stopped == "seconds"
    first = 10.0  # what nothing is known of takes longer than there is
    assert clock.now - 100.0 <= max(seconds, first)
    assert clock.now - 100.0 >= seconds - 13  # nor does it end long before
    assert found.cycles == len(found.history)
    clock.now = 100.0
    lifted = Lifted(clock, clock.state, typical=np.ones(2), **FREE)
    lifted.descend(np.array([-1.2, 1.0]), cycles=1000, until=100.0 + seconds)
    assert clock.now - 100.0 <= max(seconds, 30.0 + 21.0)  # the first evaluations with derivatives and without


@pytest.mark.slow
def test_cycles_on_a_narrower_beam_are_counted():
    """From a start that loses most rays the beam is opened first: those are cycles, too."""
    lens = TRIPLET.replace(1, curvature=0.06).replace(6, curvature=-0.06)
    found = rt.optimize(lens, merit="spot", vary="curvature thickness:2,4", bounds="thickness:1..", cycles=1)
    assert found.history.shape[0] <= 1
    assert found.cycles >= found.history.shape[0]


# -- killed -----------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_killed_process_resumes_to_the_same_lens(tmp_path):
    """kill -9 in the middle, as often as the run lasts; nothing hidden stays in the folder."""
    words = ["optimize", "cooke_triplet", "--merit", "spot", "--vary", "curvature", "thickness", "--hold", "efl=100"]
    words += ["--bounds", "thickness:1..", "--cycles", "60", "--paths", "3", "--rings", "40"]
    command = [sys.executable, "-m", "raytrace", *words]
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    run = {"cwd": tmp_path, "env": env, "stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    assert subprocess.run([*command, "-o", "whole.csv"], timeout=300, check=True, **run).returncode == 0
    resume = []
    for _ in range(3):
        process = subprocess.Popen([*command, "--checkpoint", "kept.json", *resume, "-o", "killed.csv"], **run)
        before = (tmp_path / "kept.json").stat().st_mtime_ns if resume else 0
        while process.poll() is None and not _newer(tmp_path / "kept.json", before):
            time.sleep(0.02)
        process.send_signal(signal.SIGKILL)
        process.wait()
        resume = ["--resume", "kept.json"]
    subprocess.run([*command, *resume, "-o", "again.csv"], timeout=300, check=True, **run)
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "whole.csv").read_bytes()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


def _newer(path: Path, time_ns: int) -> bool:
    return path.exists() and path.stat().st_mtime_ns > time_ns

"""Memory budget: computations beyond it are refused before they start, in the library and by every command."""

import dataclasses
import importlib
import os
import subprocess
import sys
import time
import warnings
from pathlib import Path

import pytest
import torch

import raytrace
import raytrace as rt
from raytrace import budget
from raytrace.budget import OverBudget, TakesLong, afford, free_bytes, in_words, piece, within
from raytrace.cli import build_parser, main
from raytrace.cli.commands import COMMANDS
from raytrace.files import shipped
from raytrace.psf_models import psf
from raytrace.psf_models.dft import rings_to_grid, to_grid, to_grid_mirrored
from raytrace.system.lens import SystemAperture
from raytrace.tracing.spot import image_rays

LENS = shipped("lenses") / "double_gauss.zmx"


@pytest.fixture(scope="module")
def lens():
    return raytrace.read_lens(LENS)


def test_a_limit_holds_within_its_block_and_half_of_what_is_free_elsewhere(monkeypatch):
    monkeypatch.setattr(budget, "free_bytes", lambda: 4e9)
    afford(1.9e9, "a thing", helps="less")
    with pytest.raises(OverBudget, match=r"a thing \(2.1 GB; 2 GB .*--max-bytes"):
        afford(2.1e9, "a thing", helps="less")
    with within(1e8), pytest.raises(OverBudget, match="100 MB may be taken"):
        afford(1.01e8, "a thing", helps="less")
    with within(1e12):
        afford(1e11, "a thing", helps="less")
        with pytest.raises(OverBudget, match="more bytes than there are"):
            afford(float("inf"), "a thing", helps="less")


def test_a_control_group_counts_without_the_files_it_can_drop(monkeypatch, tmp_path):
    for name, text in (("max", "3000000"), ("current", "2500000"), ("stat", "anon 1\ninactive_file 1000000\n")):
        (tmp_path / f"memory.{name}").write_text(text)
    monkeypatch.setattr(budget, "_groups", lambda: [tmp_path, tmp_path / "none"])
    assert free_bytes() == 1.5e6
    (tmp_path / "memory.max").write_text("max\n")
    assert free_bytes() > 1e7


def test_pieces_fit_into_the_limit():
    with within(4e6):
        assert piece(1e3) == 1000
        assert piece(1e9) == 1


def test_bytes_in_words():
    assert [in_words(size) for size in (1500, 2.5e6, 57e9, 3e14, 1e22)] == [
        "1.5 kB", "2.5 MB", "57 GB", "300 TB", "1.0e+10 TB",
    ]  # fmt: skip


# -- pieces give what the whole gives ----------------------------------------------------------------------------------


def test_sums_of_waves_in_pieces_are_those_of_all_at_once():
    generator = torch.Generator().manual_seed(3)
    field = torch.randn(2, 100, dtype=torch.complex128, generator=generator)
    L, M = 0.1 * torch.rand(2, 2, 100, dtype=torch.float64, generator=generator)
    x, y = torch.linspace(-0.01, 0.01, 7, dtype=torch.float64), torch.linspace(-0.01, 0.02, 5, dtype=torch.float64)
    wavelength = torch.tensor([5e-4, 6e-4], dtype=torch.float64)
    for total, waves in ((to_grid, (L, M)), (to_grid_mirrored, (L, M)), (rings_to_grid, (L,))):
        whole = total(field, *waves, x, y, wavelength)
        with within(4e4):
            torch.testing.assert_close(total(field, *waves, x, y, wavelength), whole, rtol=1e-12, atol=1e-12)


def test_analyses_in_pieces_are_those_of_all_at_once(lens, monkeypatch):
    frequencies, fields = (
        lens.wavelengths.new_tensor([10.0, 40.0]),
        lens.wavelengths.new_tensor([[0.0, 0.0], [0.0, 9.0]]),
    )
    wavefronts = importlib.import_module("raytrace.analysis.wavefronts")
    monkeypatch.setattr(wavefronts, "_strehl", lambda view: view.fields.T[:, :1])  # slow, and by field in any case
    found = {}
    for pieces in (False, True):
        if pieces:
            for module in ("pupil_autocorrelation", "mtf", "wavefronts", "encircled"):
                each = importlib.import_module(f"raytrace.analysis.{module}")
                monkeypatch.setattr(each, "piece", lambda each: 1 if each > 1e4 else 5000)
        found_map = rt.wavefront(lens, size=9, fields=fields)
        found[pieces] = (
            rt.mtf(lens, frequencies, geometric=True, fields=fields).tangential,
            rt.mtf(lens, frequencies, fields=fields).sagittal,
            rt.encircled_energy(lens, frequencies / 1e4, geometric=True, fields=fields).share,
            *(getattr(found_map, name) for name in ("opd", "rms", "coefficients")),
        )
    for one, whole in zip(found[True], found[False], strict=True):
        torch.testing.assert_close(one, whole, rtol=1e-9, atol=1e-9)


# -- what is refused ---------------------------------------------------------------------------------------------------


def fast(lens, number: float):
    value = torch.tensor(number, dtype=torch.float64)
    return dataclasses.replace(lens, aperture=SystemAperture("image_f_number", value))


NASTY = {
    "fourier": lambda lens: psf(fast(lens, 0.02), "fourier", fields=torch.zeros(2, 1, dtype=torch.float64)),
    "wave of x-rays": lambda lens: psf(
        lens, "wave", fields=torch.zeros(2, 1, dtype=torch.float64), wavelengths=lens.wavelengths.new_tensor([1e-6])
    ),
    "wavefront": lambda lens: rt.wavefront(lens, size=10**5),
    "encircled": lambda lens: rt.encircled_energy(lens, fields=torch.zeros(2, 10**6, dtype=torch.float64)),
    "rays": lambda lens: image_rays(lens, torch.zeros(2, 1, dtype=torch.float64).expand(2, 10**9)),
}


@pytest.mark.parametrize("name", NASTY)
def test_excessive_requests_are_refused_within_seconds(name, lens):
    began = time.process_time()
    with within(1e9), pytest.raises(OverBudget, match="--max-bytes"):
        NASTY[name](lens)
    assert time.process_time() - began < 10


def test_long_computations_are_reported_before_they_start(lens):
    """Ideal waves at F/0.1: minutes. The warning made an error stops them."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", TakesLong)
        with pytest.raises(TakesLong, match=r"about \d+ (s|minutes); .*smaller"):
            psf(fast(lens, 0.1), "fourier", fields=torch.zeros(2, 1, dtype=torch.float64))


@pytest.mark.parametrize(
    ("words", "option"),
    [
        ("psf --size 100000", "--size"),
        ("wavefront --terms 100000", "--terms"),
        ("distortion-grid --points 100000", "--points"),
        ("chromatic-focal-shift --samples 1000000000", "--samples"),
        ("longitudinal-aberration --points 10000000000", "--points"),
        ("ray-fan --points 10000000000", "--points"),
        ("spot --rings 100000", "--rings"),
        ("layout --rays 100000000", "--rays"),
        ("tolerance --grade precision --trials 1000000000000", "--trials"),
    ],
)
def test_a_refusal_names_its_option_before_any_work(words, option, capsys):
    command, *rest = words.split()
    began = time.process_time()
    assert main([command, "cooke_triplet", *rest]) == 1
    assert time.process_time() - began < 5
    error = [line for line in capsys.readouterr().err.splitlines() if "error" in line]
    assert len(error) == 1
    assert f"{option}" in error[0].replace("--max-bytes", "")


def test_memory_that_runs_out_names_the_largest_option(capsys, monkeypatch):
    def run(arguments):
        raise MemoryError

    monkeypatch.setattr("raytrace.cli.runner.carry_out", run)
    assert main(["psf", "cooke_triplet", "--size", "5000"]) == 1
    assert "not enough memory; ask for less by --size, which is 5000" in capsys.readouterr().err


def test_commands_refuse_in_one_line(capsys):
    assert main(["wavefront", "double_gauss", "--size", "20000", "--max-bytes", "1GB"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    points = "the wavefronts of 3 fields × 1 wavelengths at 20000 × 20000 points ("
    assert line.startswith(f"raytrace: error: double_gauss: {points}")
    assert "1 GB may be taken" in line


@pytest.mark.parametrize("name", [command for command in COMMANDS if command.name not in ("lenses", "mcp", "stock")])
def test_every_command_that_computes_has_the_option(name, capsys):
    words = [name.name if hasattr(name, "name") else name]
    if words == ["wave"]:
        words.append("psf")
    with pytest.raises(SystemExit):
        build_parser().parse_args([*words, "--help"])
    assert "--max-bytes" in capsys.readouterr().out


#: Commands that take memory, and what they are allowed.
HEAVY = (
    (["encircled-energy", "double_gauss", "--field", *map(str, range(0, 14))], 1.0e9),
    (["wavefront", "double_gauss", "--size", "1500"], 2.0e9),
    (["psf", "double_gauss", "--model", "wave", "--field", "14", "--size", "41"], 1.0e9),
)


@pytest.mark.slow
@pytest.mark.parametrize(("words", "most"), HEAVY)
def test_memory_stays_within_the_limit(words, most):
    """A process with a memory limit either refuses, or takes at most twice the limit in addition to torch."""
    code = (
        "import sys; from raytrace.budget import keep_freed_memory; from raytrace.cli import main;"
        "keep_freed_memory(); code = main(sys.argv[1:]);"
        "lines = dict(line.split(':') for line in open('/proc/self/status'));"  # ru_maxrss counts the parent's too
        "print(1024 * int(lines['VmHWM'].split()[0]), file=sys.stderr); sys.exit(code)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(raytrace.__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-c", code, *words, "--max-bytes", str(int(most))],
        env=environment, capture_output=True, text=True, timeout=600,
    )  # fmt: skip
    assert int(done.stderr.splitlines()[-1]) < 2 * most + 0.4e9


def test_freed_memory_is_used_again():
    """Pages that the system clears: of eight blocks of 40 MB one after another, those of a few blocks."""
    code = (
        "import resource; from raytrace.budget import keep_freed_memory as keep;"
        "faults = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_minflt;"
        "blocks = lambda: any(len(40_000_000 * bytearray(b'1')) == 0 for _ in range(8));"
        "start = faults(); blocks(); middle = faults(); able = keep(); blocks();"
        "print(int(able), middle - start, faults() - middle)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(raytrace.__file__).parents[1]), "OMP_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True)
    able, given_back, kept = map(int, done.stdout.split())
    if not able:
        pytest.skip("the C library has no mallopt")
    assert kept < 0.5 * given_back

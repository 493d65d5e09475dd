"""Limits of input: excessive sizes are refused before the computation, and pipes are not read."""

import os

import pytest

import raytrace as rt
from raytrace.budget import OverBudget
from raytrace.cli import main
from raytrace.io.ray_tables import RayTableError
from raytrace.optimization.merit import BadMerit, DefaultMerit
from raytrace.system.parameter_paths import BadVariables, counted

SINGLET = rt.read_lens("singlet")


@pytest.mark.parametrize("path", ["/dev/zero", "fifo"])
def test_rays_are_read_from_a_regular_file(path, tmp_path):
    if path == "fifo":
        path = tmp_path / "fifo"
        os.mkfifo(path)
    with pytest.raises(RayTableError, match="cannot be read: is not a regular file"):
        rt.io.read_rays(path, SINGLET)


def test_a_table_of_rays_is_no_larger_than_its_bound(tmp_path):
    with open(tmp_path / "rays.csv", "wb") as file:
        file.truncate(2**30)  # a sparse file: no disk is used
    with pytest.raises(RayTableError, match="is larger than 256 MB"):
        rt.io.read_rays(tmp_path / "rays.csv", SINGLET)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rings": 100_000}, "rows of a merit function, expected at most 100,000"),
        ({"arms": 10**12}, "rows of a merit function, expected at most 100,000"),
        ({"kind": "mtf", "frequencies": [10.0] * 10**5}, "100000 `frequencies`: 300,000 rows"),
    ],
)
def test_a_default_merit_function_has_no_more_rows_than_its_bound(options, message):
    with pytest.raises(BadMerit, match=message):
        DefaultMerit(**options).rows(SINGLET)


@pytest.mark.parametrize("numbers", ["1-1000000000000", "99999999999999999999", "1-9999,1-9999", "9" * 5000])
def test_surfaces_are_counted_up_to_a_bound(numbers):
    with pytest.raises(BadVariables, match="which no lens has") as error:
        counted(f"curvature:{numbers}", numbers)
    assert len(str(error.value)) < 300


@pytest.mark.parametrize(
    "rule",
    [
        lambda: rt.maths.gauss_rings(100_000),
        lambda: rt.maths.hexapolar(10**6),
        lambda: rt.spot(SINGLET, sampling="square", points=10**7),
        lambda: rt.spot(SINGLET, sampling="sobol", points=10**12),
        lambda: rt.distortion(SINGLET, samples=10**12),
        lambda: rt.ray_fan(SINGLET, points=10**12),
    ],
)
def test_samplings_that_fit_into_no_memory_are_refused(rule):
    with pytest.raises(OverBudget):
        rule()


@pytest.mark.parametrize(
    ("command", "message"),
    [
        ("spot singlet --rings 100000", "100000 rings of 400000 arms: 4e+10 points of the pupil"),
        ("evaluate singlet --merit spot --arms 1000000", "rows of a merit function"),
        ("optimize singlet --merit spot --vary curvature:1-1000000000000", "reaches beyond surface 10000"),
        ("trace singlet --rays /dev/zero", "/dev/zero: cannot be read: is not a regular file"),
    ],
)
def test_commands_report_limits_in_one_line(command, message, capsys):
    assert main(command.split()) == 1
    err = capsys.readouterr().err
    assert message in err
    assert err.count("\n") == 1

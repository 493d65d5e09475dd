"""Progress of long commands: lines in a log, a bar on a terminal."""

import io
import re
import time

import pytest

from raytrace.cli import progress as module
from raytrace.cli.progress import Bar, Lines, clock, heartbeat, progress
from raytrace.io import read_lens


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(module, "EVERY", 0.02)


def test_a_log_gets_lines_also_while_a_step_lasts(quick, capsys):
    with heartbeat("psf"):
        with progress(4, "ray", what="tracing") as bar:
            time.sleep(0.1)
            bar.update(3)
            bar.set_postfix_str("nearly done")
            time.sleep(0.1)
        time.sleep(0.1)
    lines = capsys.readouterr().err.splitlines()
    assert "raytrace: tracing: 0:00 elapsed" in lines
    assert "raytrace: tracing: 3/4 rays, 0:00 elapsed, about 0:00 left, nearly done" in lines
    assert lines[-1] == "raytrace: psf: 0:00 elapsed"  # what counts nothing lives, too
    assert len(lines) >= 6
    time.sleep(0.1)
    assert capsys.readouterr().err == ""
    assert not module._open


def test_a_short_command_prints_no_progress(capsys):
    with heartbeat("info"):
        assert list(progress([1, 2, 3], "field")) == [1, 2, 3]
    assert capsys.readouterr().err == ""


def test_a_terminal_gets_a_bar_and_no_lines(quick, monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr("sys.stderr", terminal)
    with heartbeat("spot"):
        bar = progress(range(5), "field", what="spot")
        assert isinstance(bar, Bar)
        for _ in bar:
            time.sleep(0.05)
        assert isinstance(progress(None), Lines)  # nothing to measure a bar by
    assert "raytrace:" not in terminal.getvalue()
    assert re.search(r"spot: +0%.*0/5", terminal.getvalue())


def test_abandoned_progress_is_closed(quick, capsys):
    with pytest.raises(ValueError, match="broken"), heartbeat("psf"), progress(10, "kernel"):
        raise ValueError("broken")
    assert not module._open


def test_clock():
    assert [clock(s) for s in (0.4, 59.6, 3661)] == ["0:00", "1:00", "1:01:01"]


def test_every_command_has_a_heartbeat(quick, monkeypatch, capsys):
    """Also while it does what counts nothing."""
    from raytrace.cli import main
    from raytrace.tracing import lens_report as views

    found = views.info(read_lens("double_gauss"))
    monkeypatch.setattr(views, "info", lambda lens: time.sleep(0.2) or found)
    assert main(["info", "double_gauss"]) == 0
    assert "raytrace: info: 0:00 elapsed\n" in capsys.readouterr().err

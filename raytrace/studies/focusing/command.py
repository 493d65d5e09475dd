"""`raytrace wave focus`."""

import argparse
import time

import torch

from raytrace import plot
from raytrace.cli.door import CommandError, print_json, refuse_suffix, say
from raytrace.cli.progress import progress
from raytrace.studies.focusing import figures
from raytrace.studies.focusing.experiment import Learned, Setting, learn_to_focus
from raytrace.wave.element_file import write_element
from raytrace.wave.exchange import FORMATS

_SHOWN = (0, 5, 10, 20, 40, 80, 160)  # steps of learning that the figure shows


def focus(arguments: argparse.Namespace) -> None:
    """A flat plate learns to be a lens: print, draw, save."""
    refuse_suffix("-o", arguments.output, tuple(FORMATS))
    setting = _setting(arguments)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # arrays are small: a second thread would only wait
    torch.optim.SGD([torch.zeros(1)], 1.0)  # torch loads its compiler with the first optimiser: no part of learning
    began, busy = time.perf_counter(), time.process_time()
    with progress(arguments.steps, what="learning") as bar:

        def show(step: int, ratio: float) -> None:
            bar.set_postfix_str(f"peak {ratio:.3f} of the ideal lens's")
            bar.update(min(1, step))

        found = learn_to_focus(setting, steps=arguments.steps, frames=_SHOWN, progress=show)
    seconds, busy = time.perf_counter() - began, time.process_time() - busy
    torch.set_num_threads(threads)
    if arguments.output:
        write_element(found.element, arguments.output, design_wavelength=setting.wavelength)
    if arguments.plot:
        plot.save(figures.focus_figure(found, title=_goal(found)), arguments.plot)
    if arguments.json:
        print_json(_course(found) | {"seconds": seconds, "processor_seconds": busy})
    else:
        _print_course(found, seconds)
    for path in filter(None, (arguments.output, arguments.plot)):
        say(f"written: {path}")


def _setting(arguments: argparse.Namespace) -> Setting:
    """What `wave focus` learns."""
    if len(arguments.wavelengths) > 1:
        raise CommandError("--wavelength: a lens is learned at one wavelength")
    if arguments.feature and arguments.feature > 0.5 * arguments.aperture:
        raise CommandError(
            f"--feature {arguments.feature:g}: wider than half of the aperture of {arguments.aperture:g} mm"
        )
    return Setting(
        diameter=arguments.aperture,
        distance=arguments.sensor,
        wavelength=arguments.wavelengths[0],
        samples=round(arguments.aperture / arguments.feature) if arguments.feature else arguments.samples,
        pixel=arguments.pixel,
        size=arguments.size,
        method=arguments.method,
        seed=arguments.seed,
        collimator=arguments.collimator,
    )


def _course(found: Learned) -> dict:
    """What `raytrace wave focus --json` writes, but for the seconds."""
    return {
        "peak_ratio": found.peak_ratios[-1],
        "initial_peak_ratio": found.peak_ratios[0],
        "steps": found.steps,
        "residual_waves": found.residual,
        "flat_pixels_peak_ratio": found.flat_ratio,
        "flat_pixels_best": found.flat_bound,
        "method": found.setting.method,
        "collimator": found.setting.collimator,
        "loss": found.losses[-1] if found.losses else None,
    }


def _goal(found: Learned) -> str:
    words = "A flat plate learns to collimate" if found.setting.collimator else "A flat plate learns to focus"
    return f"{words}: {found.setting.samples}² heights, peak {found.peak_ratios[-1]:.3f} of the ideal lens's"


def _print_course(found: Learned, seconds: float) -> None:
    print(_goal(found))
    print(f"from {found.peak_ratios[0]:.4f} in {found.steps} steps, {seconds:.1f} s")
    print(f"residual phase: {found.residual:.4f} waves RMS")
    print(
        f"peak with the height constant over each pixel: {found.flat_ratio:.3f}; the most that such pixels can "
        f"reach: {found.flat_bound:.3f}"
    )

"""`raytrace bench`: the subject, its options and its threads."""

import argparse
from collections.abc import Callable

import torch

from raytrace.bench import camera, psf, trace
from raytrace.bench.result import Measured
from raytrace.cli.runner import CommandError, open_lens
from raytrace.shards import torch_threads
from raytrace.system.lens import Lens

#: The measurement of a subject, its default lenses, its own settings, and whether it has a figure.
_SUBJECTS: dict[str, tuple[Callable[..., Measured], tuple[str, ...], tuple[str, ...], bool]] = {
    "trace": (trace.bench, ("double_gauss",), ("rays", "device"), True),
    "psf": (psf.bench, ("double_gauss", "phone"), (), True),
    "camera": (camera.bench, ("cooke_triplet",), ("sensor",), False),
}


def run(arguments: argparse.Namespace) -> Measured:
    """Measure the subject. Raises CommandError for options of another one."""
    subject = arguments.what
    bench, defaults, options, has_figure = _SUBJECTS[subject]
    for name in {"rays", "device", "sensor", "plot"} - {*options, *["plot"] * has_figure}:
        if getattr(arguments, name):
            raise CommandError(f"bench {subject} takes no --{name}")
    names = list(dict.fromkeys(arguments.lenses or defaults))
    if subject != "psf" and len(names) > 1:
        raise CommandError(f"bench {subject} measures one lens, found {len(names)}: {' '.join(names)}")
    threads = arguments.threads or torch.get_num_threads()
    settings = {name: getattr(arguments, name) for name in options}
    with torch_threads(threads):
        lenses = {name: _lens(name) for name in names}
        return bench(lenses, repeats=arguments.repeats, threads=threads, **settings)


def _lens(name: str) -> Lens:
    return open_lens(argparse.Namespace(lens=name, catalog=[]))

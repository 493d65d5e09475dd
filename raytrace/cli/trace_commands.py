"""`raytrace trace`."""

import argparse
import sys

from raytrace.cli import ray_table
from raytrace.cli.door import field_points, open_lens, primary, print_json, ray_aiming, say
from raytrace.cli.progress import Lines, progress
from raytrace.files import write_atomically


def trace(arguments: argparse.Namespace) -> None:
    """Rays of a table, or the chief and marginal rays of the fields, surface by surface."""
    lens = open_lens(arguments)
    if arguments.rays is not None:
        if arguments.object_distances or arguments.fields:
            say("warning: --object-distance and --field change nothing: the rays of a table begin where it says")
        batches, total = ray_table.read(arguments.rays, lens)
    else:
        batches, total, unaimed = ray_table.chief_and_marginal(
            lens,
            object_distances=arguments.object_distances or [float(lens.surfaces[0].thickness)],
            fields=field_points(lens, arguments),
            wavelengths=lens.wavelengths if arguments.wavelengths else primary(lens)[None],
            ray_aiming=ray_aiming(arguments),
        )
        if unaimed:
            say(f"warning: {unaimed} rays found no way to their point of the stop and are left out")
    fates = ray_table.Fates()
    if arguments.output:

        def write(file):
            ray_table.write_csv(lambda text: file.write(text.encode()), lens, batches, fates, bar.update)

        with progress(total, "ray", what="trace") as bar:
            write_atomically(arguments.output, write)
        if arguments.json:
            print_json({"rays": total, "output": arguments.output, "lost": fates.counts()})
        else:
            say(f"{total} rays written to {arguments.output}")
    elif arguments.json:
        ray_table.write_json(sys.stdout.write, lens, batches, total, fates)
    else:
        with Lines(total, "ray", what="trace") as lines:  # no bar: the terminal may be where the rays are written
            ray_table.write_csv(sys.stdout.write, lens, batches, fates, lines.update)
    for line in fates.lines():
        say(line)

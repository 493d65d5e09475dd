"""The page of extended depth of field, as Markdown."""

import math
from collections.abc import Mapping, Sequence

from raytrace.studies.codesign.page import KEPT
from raytrace.studies.edof.table import NAMES, PUBLISHED
from raytrace.studies.edof.world import Quality, World

CAPTIONS = {
    "gain.png": "Gains over the Fresnel lens, by content and filter, beside those that Sitzmann et al. published.",
    "depth.png": "PSNR over depth behind the best linear filter that does not know the depth.",
    "scene.png": "A scene of dead leaves at three depths as each element's camera restores it (depth-invariant "
    "filter).",
    "deep.png": "A scene from 0.5 m (below) to infinity (above) in nine layers, near leaves hiding far ones.",
    "learned.png": "The learned element: rings of fused silica, its PSFs over depth and colour, its PSNR.",
    "learned-smooth.png": "The learned smooth element of PMMA.",
}


def markdown(
    found: Mapping[str, Mapping[str, Quality]],
    world: World,
    *,
    command: str,
    figures: Sequence[str],
    kept: str = "",
) -> str:
    """The page: command, world, tables, figures; `kept` below the mark."""
    depths = ", ".join("infinity" if math.isinf(d) else f"{d / 1e3:.3g} m" for d in world.depths)
    colours = ", ".join(f"{1e3 * w:.0f}" for w in world.wavelengths)
    parts = [
        "# Extended depth of field with one phase element",
        f"    {command}",
        f"Aperture {2 * world.radius:g} mm, sensor at {world.sensor_distance:g} mm, {colours} nm, objects at {depths}; "
        f"pixels of {1e3 * world.pixel:g} µm, kernels of {world.size} × {world.size} pixels, light beyond them spread "
        f"evenly as haze; noise of standard deviation {world.noise:g}. All lenses are made for "
        f"{world.design / 1e3:g} m at 550 nm. Filters are made for pictures other than those restored. Learned "
        "elements know only the spectrum of sharp dead leaves.",
    ]
    for content, rows in found.items():
        parts += [f"## {content[0].upper()}{content[1:]}", _table(rows)]
    parts.append(
        "Mean PSNR over depths in dB, in brackets the gain over the Fresnel lens. Worst: the worst depth, spread: the "
        "best less the worst, both behind the depth-invariant filter. Sitzmann 2018: as published by Sitzmann et "
        "al., SIGGRAPH 2018, of other pictures. "
        "All figures: [table.csv](wave/table.csv)."
    )
    parts += [f"![{CAPTIONS[name]}](wave/{name})\n\n*{CAPTIONS[name]}*" for name in figures]
    return "\n\n".join(parts) + f"\n\n{KEPT}\n{kept}"


def _table(rows: Mapping[str, Quality]) -> str:
    lines = [
        "| element | Wiener, 1 m | depth-invariant | worst | spread | light in window | Sitzmann 2018 |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    base = rows.get("fresnel")
    for name, own in rows.items():
        cells = []
        for filter in ("wiener", "blind"):
            gain = f" ({own.mean[filter] - base.mean[filter]:+.2f})" if base and own is not base else ""
            cells.append(f"{own.mean[filter]:.2f}{gain}")
        published = (
            f"{PUBLISHED[name]:.2f} ({PUBLISHED[name] - PUBLISHED['fresnel']:+.2f})" if name in PUBLISHED else "–"
        )
        worst, light = min(own.by_depth["blind"]), min(min(row) for row in own.energy)
        cells += [f"{worst:.2f}", f"{own.spread['blind']:.2f}", f"{light:.2f}", published]
        lines.append(f"| {' | '.join([NAMES[name], *cells])} |")
    return "\n".join(lines)

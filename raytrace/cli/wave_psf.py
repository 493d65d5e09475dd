"""`raytrace wave psf`: words, options, and more figures than one. No torch."""

import argparse

from raytrace.cli.options import json, output, picture_file, plot
from raytrace.cli.wave_options import camera, element, engine, light, pixels

SUMMARY = "point spread functions over depth and colour"

DESCRIPTION = """\
Kernels of a phase element for points on the axis, over depth and wavelength, integrated over pixels. 1 is all light
through the aperture: `energy` is the share inside the window, `peak` that in the brightest pixel, or in a pixel centred
on the axis, where a window of an even number of pixels has a corner. Named elements are listed under --element:
smooth ones (ideal, singlet, …-refractive) of PMMA, wrapped ones of fused silica, all for one focus.

The engine is chosen by the scene, its sampling by --tol; a sampling that would repeat the image inside the window is
refused. --samples sets it by hand."""

EXAMPLES = """examples:
  raytrace wave psf --element singlet --focus 1000 --depth 500 1000 inf -o psf.npz --plot psf.png
  raytrace wave psf --element fresnel --levels 16 --depth 1000 --wavelength 0.46 0.55 0.64 --json
  raytrace wave psf --element cubic --focus 1000 --pixel 0.00369 --size 128 --exact -o cubic.npz
  raytrace wave psf --element heights.npy --glass F_SILICA --design-wavelength 0.55 --levels 16 --plot made.png
  raytrace wave psf --element ideal --depth 500 --engine fresnel --samples 2500 --json"""

_FIGURES = {
    "heights": "the height of the element, as a disc and as a profile,",
    "caustic": "the light behind the element, over distance and radius,",
    "encircled": "the share of the light within a radius",
}


def options(parser: argparse.ArgumentParser) -> None:
    element(parser)
    camera(parser)
    light(parser)
    pixels(parser)
    engine(parser)
    json(parser)
    output(
        parser,
        "arrays to write (.npz): psf[depth, wavelength, y, x], pixel_pitch, energy, depths, wavelengths, engine, error",
        (".npz",),
    )
    plot(parser, "the kernels")
    figures = parser.add_argument_group("more figures")
    for name, what in _FIGURES.items():
        help = f"save {what} as .png, .pdf or .svg"
        figures.add_argument(f"--{name}", dest=f"plot_{name}", metavar="FILE", type=picture_file, help=help)


def run(arguments: argparse.Namespace):
    import raytrace
    from raytrace.cli.door import catalogs, say
    from raytrace.cli.run import options_of, printed_anyway

    wanted = options_of(raytrace.cli.wave_psf, arguments) | {"catalog": catalogs(arguments)}
    found = raytrace.wave_psf(**wanted)
    for name in _FIGURES:
        if path := vars(arguments).pop(f"plot_{name}"):
            with printed_anyway(found, arguments):
                found.plot(path, what=name, progress=wanted["progress"])
            say(f"written: {path}")
    return found

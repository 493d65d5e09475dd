"""A lens as a value: surfaces, apertures, fields and wavelengths, in mm and µm.

| module            | contents                                                                                   |
|-------------------|--------------------------------------------------------------------------------------------|
| lens              | Lens, Fields, SystemAperture; media, conditions (`at`), checks                             |
| surface           | Surface; its sag and vertex curvature, powers, the y-nu trace                              |
| shapes            | even and odd asphere, toroid, biconic: table KINDS                                         |
| sag_terms         | sag added to a shape: height maps, Zernike, fringe, x-y polynomials: table SAG_TERMS       |
| apertures         | circular, rectangular, elliptic, polygon: table SHAPES                                     |
| phases            | gratings, holograms, diffractive lenses, ideal lenses, Fresnel facets: table PHASES        |
| poses             | decentres and tilts                                                                        |
| intersection      | rays and surfaces: point, normal, the first crossing of an asphere                         |
| expansion         | the surfaces at another temperature                                                        |
| rays              | Rays: positions, directions, validity, optical path                                        |
| configurations    | the configurations of a zoom or multi-configuration lens                                   |
| parameter_paths   | numbers of a lens by name                                                                  |
| optimization_data | variables, solves, pickups and merit function of a file; dimensions: powers of length      |
| elements          | elements and cemented groups, found from the media and mirrors                             |
| prescription      | `rt.lens`: a lens from rows of plain numbers                                               |
| identity          | digest of a lens in the files that store numbers for it                                    |

To add:

- a shape: its sag and derivatives in `shapes`, a row of KINDS, and its sag in tracing/cpp/sags.h for the compiled trace
  (`code=None`: torch alone);
- sag terms: a value and its functions in `sag_terms`, a row of SAG_TERMS;
- an aperture: its edges in `apertures`, a row of SHAPES, and its lines in tracing/cpp/apertures.h;
- a phase: a value and its path in `phases`, a row of PHASES;
- of all of them: the powers of length of their numbers, a row of `dimensions.POWERS` or `shapes.HEADS`, and their
  numbers on a surface that is turned around, a row of `edit.turning`.

Tests: tests/test_MODULE.py; test_shapes adds a kind of each to the tables; test_asphere and test_freeform (sags),
test_compiled_sags and test_compiled_poses (against the compiled trace), test_hardcases (extreme numbers).
"""

from raytrace import namespace

__getattr__, __dir__ = namespace(__name__)

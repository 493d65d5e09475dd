"""The same trace compiled: one loop in C++ over all surfaces, and its adjoint by hand.

choice      which trace carries a batch of rays, and the switch to force one
library     the C++ of this folder, compiled once for a machine
trust       what may be executed: what nobody else can have written
structure   a run of surfaces as that code reads it
run         the code called on tensors, forward and backward
block.h     what it works on: blocks of rays that stay in the cache
sags.h      the kinds of sag, as rows of shapes.py; freeform.h: those that are not round
paths.h     the paths that phases add, as polynomials; sag_terms.h: the powers that a sag has beside
apertures.h the shapes of apertures, as rows of aperture.py
loops.h     the surfaces as loops over a block, where nothing can go wrong
search.h    the first crossing of one ray with what is more than a conic, as search.py finds it
facets.h    the facets of Fresnel lenses
careful.h   one ray at one surface, with every case that surface.py and search.py know
phases.h    what gratings, diffractive and ideal lenses do to rays; phase_slopes.h: differentiated
turns.h     axes that turn between two surfaces
adjoint.h   the adjoint of a surface, with its derivation; tangent.h: its derivative in a direction
trace.cpp   rays through all surfaces and back, block by block
"""

from raytrace.tracing.compiled.library import NoCompiler as NoCompiler
from raytrace.tracing.compiled.library import engine as engine
from raytrace.tracing.compiled.library import prepare as prepare
from raytrace.tracing.compiled.library import trace_engine as trace_engine

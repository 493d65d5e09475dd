"""The verbs of geometric optics: trace, launch, aim, spot, focus, wavefront."""

"""Optimisation: numbers of a lens moved to where its merit function is least."""

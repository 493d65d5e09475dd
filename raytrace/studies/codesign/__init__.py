"""Lens and network learned together, by PSF model: the comparison of a published study, and a sweep."""

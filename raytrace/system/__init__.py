"""The nouns of a lens: surfaces, rays, the lens itself, and how one is built from plain numbers."""

"""A flat plate that learns to be a lens."""

"""What fabrication costs: steps of height, wrapping, errors of height."""

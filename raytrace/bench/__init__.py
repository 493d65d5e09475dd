"""Benchmarks: speed against error, by independent references of high precision, and compared with other packages."""

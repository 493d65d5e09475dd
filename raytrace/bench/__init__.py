"""Benchmarks: speed beside error, against an independent reference of high precision and against a peer."""

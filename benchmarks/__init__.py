"""Benchmarks: cases as data, one runner, results as JSON. Run from a checkout: ``python -m benchmarks.NAME``."""

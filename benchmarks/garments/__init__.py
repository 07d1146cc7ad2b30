"""Garments against theory, and on bodies: ``python -m benchmarks.garments``."""

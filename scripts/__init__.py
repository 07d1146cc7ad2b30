"""Maintenance scripts of the suite: run from a checkout (``python -m scripts.NAME``), not part of the wheel."""

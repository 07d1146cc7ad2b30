"""Training scripts: one algorithm a file. Run from a checkout (``python -m agents.train``), not part of the wheel."""

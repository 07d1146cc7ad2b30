"""Trainings, controllers and evaluations, run from a checkout (``python -m agents.NAME``); not part of the wheel."""

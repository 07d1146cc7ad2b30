"""Scores of agents and of short trainings."""

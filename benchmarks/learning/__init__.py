"""Scores of agents and of short training runs."""

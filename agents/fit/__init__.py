"""Physical parameters from what is seen, measured or recorded: ``python -m agents.fit CONFIG.yaml``; see docs/fit.md.

A study varies settings of an environment within bounds, plays every trial, and scores it. :mod:`.space` maps the
parameters to settings, :mod:`.rollout` plays, :mod:`.scorers` judge, :mod:`.study` proposes trials and keeps them in a
SQLite file of Optuna, and :mod:`.posterior` finds the best of them in spite of noise.
"""

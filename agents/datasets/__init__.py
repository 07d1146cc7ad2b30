"""Offline data: episodes of expert, medium and random play as Minari datasets, and baselines that learn from them."""

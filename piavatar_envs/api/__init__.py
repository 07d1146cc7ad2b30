"""Views of the batched environment: Gymnasium, PettingZoo, Stable-Baselines3, skrl and rsl_rl."""

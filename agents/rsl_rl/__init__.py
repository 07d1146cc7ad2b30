"""PPO with rsl_rl on a batch of environments."""

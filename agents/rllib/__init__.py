"""PPO by RLlib, on one machine or several."""

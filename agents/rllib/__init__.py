"""PPO with RLlib, on one machine or several."""

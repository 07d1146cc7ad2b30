"""Training runs with stable-baselines3: PPO, SAC, worlds of several agents and self-play."""

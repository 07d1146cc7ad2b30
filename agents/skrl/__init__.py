"""Multi-agent PPO with skrl on a batch of worlds."""

"""The batched environment: simulation, actions, observations, step and reset."""

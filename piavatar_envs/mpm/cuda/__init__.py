"""P2G and G2P paths for GPUs: tiles of particles for large bodies, a block per environment for small ones."""

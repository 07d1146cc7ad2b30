"""P2G and G2P paths for GPUs: ``tiled_*`` for large bodies, ``block_*`` (a block per environment) for small ones."""

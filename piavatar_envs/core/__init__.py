"""Foundations below the physics: launch graphs, CUDA intrinsics, shared memory and array access."""

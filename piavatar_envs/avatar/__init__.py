"""Skeleton-driven soft bodies: the body asset, its particles, motions, drive and tracking. No RL here."""

"""Soft props: balls, boxes and the like, their particles, how they are placed and how they are tracked. No RL here."""

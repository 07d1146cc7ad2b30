"""Loose garments: meshes of cloth, the skin that they touch and their solver. No simulation, no tasks."""

"""Embedded clips, one file each with a ``build(rest_joints) -> Motion``. All made by hand here: procedural."""

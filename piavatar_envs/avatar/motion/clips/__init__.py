"""Embedded clips, one file each with a ``build(rest_joints) -> Motion``. All made by hand here: procedural.

A clip gives key poses to :func:`piavatar_envs.avatar.motion.keyframes.animate`, which interpolates them.
"""

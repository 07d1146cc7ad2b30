"""Motion clips: embedded procedural ones, DeepMimic's (installed ``pybullet``) and AMASS files."""

from piavatar_envs.avatar.motion.library import list_motions, load_motion, register_motion
from piavatar_envs.avatar.motion.motion import Motion

__all__ = ["Motion", "list_motions", "load_motion", "register_motion"]

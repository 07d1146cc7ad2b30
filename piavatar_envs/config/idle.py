"""Settings that were changed and have no effect, because actions are of another kind."""

from __future__ import annotations

from piavatar_envs.config import EnvConfig
from piavatar_envs.config.schema import DriveConfig

_NAMES = list(DriveConfig.model_fields)
#: Where in the section ``drive`` the settings of bodies under torques begin, and those of commanded poses.
_TORQUES, _POSES = _NAMES.index("root_assist"), _NAMES.index("bone_contact") + 1


def idle_settings(config: EnvConfig) -> list[str]:
    """What to say of each setting of ``drive`` that is not the task's default and that its ``control`` does not use."""
    drive, default = config.drive, type(config)().drive
    posed = drive.control == "pose"
    names, others = (_NAMES[_TORQUES:_POSES], "'pd' and 'torque'") if posed else (_NAMES[_POSES:], "'pose'")
    return [
        f"drive.{name}={getattr(drive, name)!r} has no effect under control={drive.control!r}; it is for {others}"
        for name in names
        if getattr(drive, name) != getattr(default, name)
    ]

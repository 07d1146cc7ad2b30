"""Soft human avatars for reinforcement learning: importing this package registers its Gymnasium ids.

Nothing heavy is imported and no GPU is touched until an environment is made.
"""

from __future__ import annotations

from gymnasium.envs.registration import register

from piavatar_envs.tasks import task_modules

__version__ = "0.1.0"

for _env_id in task_modules():
    register(
        id=_env_id,
        entry_point="piavatar_envs.api.gymnasium:AvatarEnv",
        vector_entry_point="piavatar_envs.api.vector:AvatarVectorEnv",
        # the time limit lives inside, so that a saved state holds it
        max_episode_steps=None,
        kwargs={"task": _env_id},
    )

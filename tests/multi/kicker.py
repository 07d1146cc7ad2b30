"""A scripted player for PassBall."""

from __future__ import annotations

import numpy as np

from piavatar_envs.avatar.body.skeleton import joint_index
from piavatar_envs.envs.batch_env import BatchEnv


class Kicker:
    """A scripted agent: a foot behind the ball, then through it, so that it goes to the next; else back home."""

    SPEED, LEAD, BEHIND, WIDTH = 2.0, 0.1, 0.25, 0.12  # of the pass [m/s]; ahead of the ball [s]; of the ball [m]
    FEET = ("left", "right")

    def __init__(self, batch: BatchEnv) -> None:
        self.layout, self.names, self.root_speed = batch.layout, batch.action_spec.names(), batch.config.root_speed

    def __call__(self, observation: np.ndarray) -> np.ndarray:
        rows = observation.reshape(-1, observation.shape[-1])
        actions = [self.act(self.layout.split(row.astype(float))) for row in rows]
        return np.clip(actions, -1.0, 1.0).reshape(*observation.shape[:-1], -1).astype(np.float32)

    def act(self, seen: dict[str, np.ndarray]) -> list[float]:
        bones = seen["bone_positions"].reshape(-1, 3)
        thighs = {side: joint_index(f"{side}_knee") - 1 for side in ("left", "right")}
        lifted = {side: (bones[thighs[side] - 3] - bones[thighs[side]])[1] / 0.4 for side in thighs}
        hips = {f"{side}_hip.x": lifted[side] / 0.15 for side in thighs}
        ball = facing = seen["ball_position"][:2]
        move = seen["place"][:2] / 0.2
        if seen["turn"][0]:
            facing = seen["other_0_position"][:2] - ball
            # the change of velocity that sends it there
            way = self.SPEED * facing / np.linalg.norm(facing) - seen["ball_velocity"][:2]
            way /= np.linalg.norm(way)
            lead = self.LEAD * seen["ball_velocity"][:2]
            feet = {side: seen[f"ball_from_{side}_foot"][:2] + lead for side in self.FEET}  # to where the ball will be
            side = min(feet, key=lambda side: np.linalg.norm(feet[side] - self.BEHIND * way))
            aside = abs(feet[side] @ [-way[1], way[0]])
            behind = -0.05 < feet[side] @ way < self.BEHIND + 0.05 and aside < self.WIDTH
            move = way if behind else (feet[side] - self.BEHIND * way) / (0.15 * self.root_speed)
            hips[f"{side}_hip.x"] = -1.0 * (lifted[side] < 0.6) if behind else 0.5 * (lifted[side] > -0.25)
            facing = way
        turn = np.arctan2(facing[0], -facing[1]) / 0.2
        chosen = hips | {"root.x": move[0], "root.y": move[1], "root.yaw": turn}
        return [chosen.get(name, 0.0) for name in self.names]

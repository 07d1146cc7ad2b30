"""One body whose joints move under torques, without a task: built, held, aimed, measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import runner
from benchmarks.physics.rig import Rig, World, joint_gaps
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, NUM_JOINTS, forward_kinematics, joint_index
from piavatar_envs.avatar.body.sources import load_asset
from piavatar_envs.avatar.torque_control.articulated_body import ArticulatedBody
from piavatar_envs.config import PoseControlConfig
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep

HOLD = 1e5, 1e4  # spring and damper of a held pelvis, of its place and of its turn [SI units]


@dataclass(frozen=True)
class Options(runner.Options):
    """Options of the torque benchmark."""

    #: resolution of the body
    fidelity: str = "coarse"
    #: control steps of each case
    steps: int = 45
    #: substeps between two mass matrices
    refresh: int = 2
    #: halvings of the interval in which a largest stable value lies
    halvings: int = 6
    #: poses that a body is asked for wherever its stability is tried
    poses: int = 2


class Limbs:
    """One body whose joints move under torques, at rest in a pose.

    Attributes:
        rig: the world; its own drive does not act.
        body: the joints.
        graph: a control step.
    """

    def __init__(
        self,
        options: Options,
        gravity: float,
        rotations: np.ndarray,
        rate: float = 0.0,
        ground: bool = False,
        firm_bones: bool = True,
        bone_contact: bool = True,
    ) -> None:
        """Build it in a pose of rotation vectors ``(22, 3)``; ``rate`` attaches flesh to bones, if not zero.

        With ``firm_bones`` particles of bones are put into their places after every control step, with
        ``bone_contact`` bones stop at the floor, as in environments.
        """
        world = World(
            fidelity=options.fidelity, num_substeps=None, gravity=gravity, ground=ground, device=options.device
        )
        asset = load_asset()
        self.rig = Rig(world, PoseControlConfig(), asset.parameters()[None])
        self.rig.reset(rotations[None])
        rates = np.full((1, self.rig.points.num_points), rate) if rate > 0.0 else None
        none = np.zeros((1, 1 + NUM_JOINTS))
        chosen = firm_bones & (self.rig.points.bone >= 0)
        built = self.rig.points, self.rig.avatar.body, self.rig.model
        self.body = ArticulatedBody(*built, none, none, rates, chosen, bone_contact)
        local, joints = Rotation.from_rotvec(rotations), self.rig.points.joints[0].astype(float)
        world_rotations, positions = forward_kinematics(local.as_matrix(), joints[0], joints)
        self.body.state.rotation.assign(Rotation.from_matrix(world_rotations).as_quat()[None].astype(np.float32))
        self.body.state.position.assign(positions[None].astype(np.float32))
        self.body.target.root.assign(positions[None, 0].astype(np.float32))
        self.aim(rotations)
        self.body.mass.refresh = options.refresh
        self._build_mass()
        self.graph = self.record()

    def _build_mass(self) -> None:
        graph = LaunchGraph(self.rig.model.device)
        self.body.record_mass(graph, self.rig.state)
        graph.run()

    def record(self, joints: bool = True) -> LaunchGraph:
        """Record a control step, with ``joints`` or of the Material Point Method alone."""
        rig, graph = self.rig, LaunchGraph(self.rig.model.device)
        record_begin(graph, rig.model, rig.state, rig.scratch)
        for step in range(rig.model.num_substeps):
            if joints:
                self.body.record_substep(graph, rig.state, rig.scratch, step)
            record_substep(graph, rig.model, rig.state, rig.scratch, step)
        record_end(graph, rig.model, rig.state, rig.scratch)
        if joints:
            self.body.record_end(graph, rig.state)
        return graph

    def set_springs(self, stiffness: np.ndarray | float, damping: np.ndarray | float, held: bool = False) -> None:
        """Set springs and dampers of all joints but the pelvis, a number or ``(21,)``; the pelvis is held or free."""
        values = np.zeros((2, 1, 1 + NUM_JOINTS), np.float32)
        values[0, 0, 2:], values[1, 0, 2:] = stiffness, damping
        values[:, 0, :2] = np.array(HOLD)[:, None] * held
        self.body.springs.stiffness.assign(values[0])
        self.body.springs.damping.assign(values[1])

    def aim(self, rotations: np.ndarray) -> None:
        """Set the rest pose of the springs, rotation vectors ``(22, 3)``."""
        self.body.target.rotation.assign(Rotation.from_rotvec(rotations).as_quat()[None].astype(np.float32))

    def arm(self, side: str) -> np.ndarray:
        """Return the vector from shoulder to wrist [m]."""
        position = self.body.state.position.numpy()[0]
        return (position[joint_index(f"{side}_wrist")] - position[joint_index(f"{side}_shoulder")]).astype(float)

    def gaps(self) -> np.ndarray:
        """Return the distance of joints from their places on the parents' bones [m], shape ``(21,)``."""
        graph = LaunchGraph(self.rig.model.device)
        self.rig.avatar.record_tracking(graph, self.rig.state)
        graph.run()
        return joint_gaps(self.rig.avatar.tracked, self.rig.points.joints)[0]


def widest(gaps: Sequence[np.ndarray]) -> dict[str, Any]:
    """Return the largest of the gaps ``(T, 21)`` [m] of a course, and its joint."""
    found = np.array(gaps)
    joint = int(found.max(0).argmax())
    return {"largest_gap_mm": float(1e3 * found.max()), "widest_joint": JOINT_NAMES[1 + joint]}


def critical_damping(body: ArticulatedBody, stiffness: np.ndarray | float) -> np.ndarray:
    """Return critical damping of all joints but the pelvis, by the inertia beyond each [N m s/rad], ``(21,)``."""
    diagonal = np.diagonal(body.mass.read()[0])
    inertia = diagonal[6:].reshape(-1, 3).mean(1).astype(float)
    return 2.0 * np.sqrt(stiffness * inertia)

"""An articulated body in a test: its pose, its parts one by one, and its Jacobian in double precision."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from piavatar_envs.avatar.body.skeleton import NUM_JOINTS, PARENTS, forward_kinematics
from piavatar_envs.avatar.torque_control.articulated_body import ArticulatedBody
from piavatar_envs.avatar.torque_control.mass_matrix import NUM_DOF
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep

#: Springs of the joints, none of the pelvis.
GAINS = np.r_[0.0, 0.0, np.ones(NUM_JOINTS - 1)][None]


def carried_by() -> np.ndarray:
    """Return whether joint ``c`` carries bone ``b``, shape ``(c, b)``."""
    carries = np.eye(NUM_JOINTS)
    for bone in range(NUM_JOINTS - 1, 0, -1):
        above = PARENTS[bone]
        while above >= 0:
            carries[above, bone] = 1.0
            above = PARENTS[above]
    return carries


def momentum_of(J: np.ndarray, m: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Return the generalised momentum ``J^T m v`` of velocities of the particles, shape ``(69,)``."""
    return np.einsum("pia,p,pi->a", J, m, v)


class Joints:
    """An articulated body beside a rig's particles, and graphs of its parts."""

    def __init__(self, rig, stiffness=0.0, damping=0.0, attachment=None, firm=None, solid=False):
        self.rig, self.model, self.state = rig, rig.model, rig.state
        rates = None if attachment is None else np.broadcast_to(attachment, (1, rig.points.num_points))
        body = rig.points, rig.avatar.body, rig.model
        self.body = ArticulatedBody(*body, stiffness * GAINS, damping * GAINS, rates, firm, solid)

    def pose(self, rotvec, root=None):
        """Put pose and particles where the local rotation vectors have them, at rest."""
        joints = self.rig.points.joints[0].astype(float)
        rotations = Rotation.from_rotvec(np.asarray(rotvec)).as_matrix()
        root = joints[0] if root is None else root
        world, positions = forward_kinematics(rotations, root, joints)
        n = self.model.num_envs
        quaternions = Rotation.from_matrix(world).as_quat().astype(np.float32)
        self.body.state.rotation.assign(np.broadcast_to(quaternions, (n, NUM_JOINTS, 4)).copy())
        self.body.state.position.assign(np.broadcast_to(positions.astype(np.float32), (n, NUM_JOINTS, 3)).copy())
        self.state.x.assign(
            np.broadcast_to(self.rig.skinned(rotations, root).astype(np.float32), self.state.x.shape + (3,)).copy()
        )
        self.build_mass()
        return self

    def build_mass(self) -> None:
        """Build the mass matrix where pose and particles are."""
        graph = LaunchGraph(self.model.device)
        self.body.record_mass(graph, self.state)
        graph.run()

    def substep(self, step: int) -> LaunchGraph:
        """Record the first substep of a control step (0), or one without a mass matrix of its own (1).

        Either finds joints wherever they have been put.
        """
        graph, self.body.mass.refresh = LaunchGraph(self.model.device), 2
        if step > 0:
            self.body.record_pose(graph, self.state)
        self.body.record_substep(graph, self.state, self.rig.scratch, step)
        return graph

    def control_step(self) -> LaunchGraph:
        """Record a control step of joints and particles."""
        rig, model, graph = self.rig, self.model, LaunchGraph(self.model.device)
        record_begin(graph, model, rig.state, rig.scratch)
        for step in range(model.num_substeps):
            self.body.record_substep(graph, rig.state, rig.scratch, step)
            record_substep(graph, model, rig.state, rig.scratch, step)
        record_end(graph, model, rig.state, rig.scratch)
        return graph

    @property
    def jacobian(self) -> np.ndarray:
        """Return ``J`` at the particles, shape ``(P, 3, 69)``."""
        return self.jacobian_at(self.rig.read("x"), self.body.state.position.numpy()[0].astype(float))

    def jacobian_at(self, x, position) -> np.ndarray:
        """Return ``J`` where particles and joints are at other places [m]."""
        share = self.rig.weights.astype(float)
        share = (share / share.sum(1, keepdims=True)) @ carried_by().T
        J = np.zeros((len(x), 3, NUM_DOF))
        J[:, :, :3] = np.eye(3)
        for c in range(NUM_JOINTS):
            arm = x - position[c]
            for axis in range(3):
                J[:, :, 3 + 3 * c + axis] = share[:, c, None] * np.cross(np.eye(3)[axis], arm)
        return J

    def moved(self, velocity, time) -> tuple[np.ndarray, np.ndarray]:
        """Return local rotations, ``(22, 3, 3)``, and the place of the pelvis after a time [s] at a velocity."""
        s = self.body.state
        spin = carried_by().T @ velocity[3:].reshape(NUM_JOINTS, 3)  # a bone spins with all joints that carry it
        begin = Rotation.from_quat(s.rotation.numpy()[0].astype(float))
        world = (Rotation.from_rotvec(time * spin) * begin).as_matrix()
        local = np.stack([world[0], *(world[PARENTS[b]].T @ world[b] for b in range(1, NUM_JOINTS))])
        return local, s.position.numpy()[0, 0].astype(float) + time * velocity[:3]

    def skinning(self, velocity) -> np.ndarray:
        """Return the velocity of the skinned places, by central differences, shape ``(P, 3)``."""
        after, before = (self.rig.skinned(*self.moved(velocity, time)) for time in (1e-4, -1e-4))
        return (after - before) / 2e-4

    def bias_change(self, velocity) -> np.ndarray:
        """``M^-1 h``: centripetal and Coriolis forces of bones that have their share of each particle rigidly."""
        x, at = self.rig.read("x"), self.body.state.position.numpy()[0].astype(float)
        spins = carried_by().T @ velocity[3:].reshape(NUM_JOINTS, 3)
        pull = np.zeros((NUM_JOINTS, 3))
        for b in range(1, NUM_JOINTS):
            spin = spins[PARENTS[b]]
            pull[b] = pull[PARENTS[b]] + np.cross(spin, np.cross(spin, at[b] - at[PARENTS[b]]))
        share = self.rig.weights / self.rig.weights.sum(1, keepdims=True) * self.rig.mass[:, None]
        h = np.zeros(NUM_DOF)
        for b in range(NUM_JOINTS):
            force = share[:, b, None] * (pull[b] + np.cross(spins[b], np.cross(spins[b], x - at[b])))
            h[:3] += force.sum(0)
            for c in np.flatnonzero(carried_by()[:, b]):
                h[3 + 3 * c : 6 + 3 * c] += np.cross(x - at[c], force).sum(0)
        J, m = self.jacobian, self.rig.mass
        return np.linalg.solve(np.einsum("p,pia,pib->ab", m, J, J) + np.diag(self.besides), h)

    def skinned_now(self) -> np.ndarray:
        """Skinned places of the particles in the current pose [m]."""
        s = self.body.state
        world = Rotation.from_quat(s.rotation.numpy()[0].astype(float)).as_matrix()
        local = np.stack([world[0], *(world[PARENTS[b]].T @ world[b] for b in range(1, NUM_JOINTS))])
        return self.rig.skinned(local, s.position.numpy()[0, 0].astype(float))

    def halfway(self, velocity) -> np.ndarray:
        """Return ``J`` half a step on, bones and particles moved by a velocity of the joints."""
        half = 0.5 * self.model.step.dt
        _, positions = forward_kinematics(*self.moved(velocity, half), self.rig.points.joints[0].astype(float))
        return self.jacobian_at(self.rig.read("x") + half * (self.jacobian @ velocity), positions)

    @property
    def besides(self) -> np.ndarray:
        """Return the inertia with which joints take over, besides that of the limbs they move, shape ``(69,)``."""
        return self.body._workspace.diagonals.numpy()[0].astype(float)

    @property
    def mass(self) -> np.ndarray:
        """Return the mass matrix, shape ``(69, 69)``."""
        return self.body.mass.read()[0]

    @property
    def total(self) -> np.ndarray:
        """Return the velocity of the particles [m/s]."""
        return self.rig.read("u") + self.rig.read("vk")

    def momenta(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Return the momentum, angular momentum, and the sum of ``m |v|``."""
        m, x, v = self.rig.mass, self.rig.read("x"), self.total
        return m @ v, m @ np.cross(x, v), float(m @ np.linalg.norm(v, axis=1))

"""The observer of a world: the layout of its observation, and the kernels that write it term by term."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, NUM_JOINTS, joint_index
from piavatar_envs.avatar.torque_control.controller import TorqueController
from piavatar_envs.avatar.types import Body
from piavatar_envs.core.arrays import matrix_at
from piavatar_envs.core.cuda_intrinsics import environment_of
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.episodes import EpisodeArrays
from piavatar_envs.envs.observations import (
    CONTACT_TERMS,
    JOINT_TERMS,
    LANDMARKS,
    SELF_TERMS,
    ObservationLayout,
    other_terms,
    prop_terms,
    write_rotation,
    write_vector,
)
from piavatar_envs.envs.parameters import Parameters
from piavatar_envs.envs.task import Task
from piavatar_envs.mpm.materials import kirchhoff_stress, von_mises_stress
from piavatar_envs.mpm.types import Particles, Sensors, row
from piavatar_envs.sim.world import Simulation

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

_NUM_PARTS = wp.constant(len(BODY_PARTS))
_LANDMARK = wp.constant(wp.types.vector(length=5, dtype=wp.int32)(*(joint_index(name) for name in LANDMARKS)))


class Observer:
    """Layout of the observation, and the launches that write it.

    The terms are those of the agent itself, of contact (if the task observes it), of joint velocities (under torque
    control), of props, of other agents, of the task, and the drawn parameters (``observe_parameters``). Other agents
    are counted from the observing one, so that the world looks alike to each of them.

    Attributes:
        layout: of the flat observation.
        task_start: first component of the task's terms.
        parameters: the term of drawn parameters, or None.
        all_envs: a mask of all environments, ``(num_envs,)`` bool.
    """

    def __init__(self, simulation: Simulation, task: Task) -> None:
        """Lay out the terms and upload what their kernels read."""
        self.simulation, self.task = simulation, task
        others = len(simulation.avatars) - 1 if task.observes_others else 0
        terms = [*SELF_TERMS]
        if task.observes_contact:
            terms += CONTACT_TERMS
        if task.config.control.mode != "pose":
            terms += JOINT_TERMS
        self._first_prop = sum(term.size for term in terms)
        for name in task.observed_props():
            terms += prop_terms(name)
        self._first_other = sum(term.size for term in terms)
        for index in range(others):
            terms += other_terms(index)
        self.task_start = sum(term.size for term in terms)
        self._num_others = others
        self.parameters = Parameters(simulation, task.drawn()) if task.config.observe_parameters else None
        last = [self.parameters.term] if self.parameters else []
        self.layout = ObservationLayout((*terms, *task.terms(), *last))
        device = simulation.device
        self.all_envs = wp.full(simulation.num_envs, True, dtype=wp.bool, device=device)
        self._part = [wp.array(flesh.part, dtype=int, device=device) for flesh in simulation.flesh]

    def record(self, graph: LaunchGraph, agent: int, observation: wp.array, mask: wp.array | None = None) -> None:
        """Record the launches that write all terms of ``agent`` but the task's, and change nothing else.

        Args:
            graph: records.
            agent: index of the observing agent.
            observation: shape ``(num_envs, num_agents, size)``.
            mask: environments for which the pass over the particles runs; all if not given.
        """
        mask = self.all_envs if mask is None else mask
        sim = self.simulation
        n, avatar = sim.num_envs, sim.avatars[agent]
        start = self.layout["stress"].slice.start
        tracked = avatar.tracked
        bones = [tracked.rotation, tracked.position, tracked.velocity, tracked.local]
        graph.launch(observe_body, (n, NUM_JOINTS), [agent, *bones], [observation])
        graph.launch(clear_stress, (n, len(BODY_PARTS)), [mask, agent, start], [observation])
        modulus = 1.0 / sim.flesh[agent].physics.young_modulus
        graph.launch(
            observe_stress,
            n * avatar.num_points,
            [mask, avatar.body, sim.model.particles, sim.state.F, self._part[agent], agent, start, modulus],
            [observation],
        )
        if self.task.observes_contact:
            at = self.layout[CONTACT_TERMS[0].name].slice.start
            graph.launch(
                observe_contact, (n, len(BODY_PARTS)), [agent, at, tracked.rotation, sim.sensors], [observation]
            )
        controller = sim.controllers[agent]
        if isinstance(controller, TorqueController):
            at, joints = self.layout[JOINT_TERMS[0].name].slice.start, controller.state
            inputs = [agent, at, avatar.body, joints.rotation, joints.velocity, sim.sensors]
            graph.launch(observe_joints, (n, NUM_JOINTS), inputs, [observation])
        self._record_others(graph, agent, observation)

    def _record_others(self, graph: LaunchGraph, agent: int, observation: wp.array) -> None:
        """Record the terms of props and of other agents."""
        sim = self.simulation
        tracked, state = sim.avatars[agent].tracked, sim.props.state
        at, size = self._first_prop, sum(term.size for term in prop_terms("a prop"))
        for name in self.task.observed_props():
            graph.launch(
                observe_prop,
                sim.num_envs,
                [
                    agent, at, sim.props.index(name), tracked.rotation, tracked.position,
                    state.position, state.rotation, state.velocity, state.spin, state.deformation,
                ],
                [observation],
            )  # fmt: skip
            at += size
        at, size = self._first_other, sum(term.size for term in other_terms(0))
        for index in range(self._num_others):
            other = sim.avatars[(agent + 1 + index) % len(sim.avatars)].tracked
            graph.launch(
                observe_other,
                sim.num_envs,
                [agent, at, tracked.rotation, tracked.position, other.rotation, other.position, other.velocity],
                [observation],
            )
            at += size

    def connect(self, env: EpisodeArrays) -> None:
        """Find the arrays of the task's drawn parameters, once the task has allocated them."""
        if self.parameters:
            self.parameters.connect(env.num_envs, self.task.drawn_values(env))

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Record the launches that store the parameters which the masked environments have drawn."""
        if self.parameters:
            self.parameters.record_reset(graph, mask)

    def record_settings(self, graph: LaunchGraph) -> None:
        """Record the launches that read settings which may have changed since the last observation."""
        if self.parameters:
            self.parameters.record_settings(graph)

    def record_parameters(self, graph: LaunchGraph, env: EpisodeArrays, agent: int) -> None:
        """Record the launch that writes the drawn parameters for ``agent`` and changes nothing else."""
        if self.parameters:
            self.parameters.record_observe(graph, env, agent)

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays of a checkpoint by name."""
        return self.parameters.arrays() if self.parameters else {}

    def record_clean(self, graph: LaunchGraph, observation: wp.array) -> None:
        """Record the launch that sets values which are not finite, as a failed environment may have, to zero."""
        graph.launch(clean_observation, observation.shape, [], [observation])


@wp.kernel
def observe_body(
    agent: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    velocity: wp.array2d(dtype=wp.vec3),
    local: wp.array2d(dtype=wp.quat),
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the terms of ``SELF_TERMS`` of the tracked bones; over ``(num_envs, bones)``."""
    e, b = wp.tid()
    bones = rotation.shape[1]
    to_root = wp.quat_inverse(rotation[e, 0])
    joints_at = 7
    positions_at = joints_at + 6 * (bones - 1)
    velocities_at = positions_at + 3 * (bones - 1)
    if b == 0:
        observation[e, agent, 0] = position[e, 0][2]
        write_rotation(observation, e, agent, 1, rotation[e, 0])
    else:
        write_rotation(observation, e, agent, joints_at + 6 * (b - 1), local[e, b])
        offset = wp.quat_rotate(to_root, position[e, b] - position[e, 0])
        write_vector(observation, e, agent, positions_at + 3 * (b - 1), offset)
    write_vector(observation, e, agent, velocities_at + 3 * b, wp.quat_rotate(to_root, velocity[e, b]))


@wp.kernel
def clear_stress(mask: wp.array(dtype=wp.bool), agent: int, start: int, observation: wp.array3d(dtype=float)):
    """Set the peaks of the masked environments to zero; over ``(num_envs, parts)``."""
    e, part = wp.tid()
    if mask[e]:
        observation[e, agent, start + part] = 0.0


# neighbouring particles are mostly of one part, whose peak a warp then raises with one atomic
@wp.func_native("""
wp::float32* const at = &wp::index(observation, e, agent, n);
#if defined(__CUDA_ARCH__)
int one = 0;
const unsigned together = __activemask(), bits = __float_as_uint(value) & 0x7fffffffu;  // in the order of numbers
__match_all_sync(together, (unsigned long long)at, &one);
#if __CUDA_ARCH__ >= 800
if (one) {
    const unsigned peak = __reduce_max_sync(together, bits);
    if ((threadIdx.x & 31) == __ffs(together) - 1) atomicMax((unsigned*)at, peak);
    return;
}
#endif
atomicMax((unsigned*)at, bits);
#else
if (value > *at) *at = value;
#endif
""")
def raise_peak(observation: wp.array3d(dtype=float), e: int, agent: int, n: int, value: float):
    """Raise a component of the observation to ``value`` if it is smaller; both must be non-negative."""
    ...


@wp.kernel
def observe_stress(
    mask: wp.array(dtype=wp.bool),
    body: Body,
    particles: Particles,
    F: wp.array3d(dtype=float),
    part: wp.array(dtype=int),
    agent: int,
    start: int,
    inverse_modulus: float,
    # out
    observation: wp.array3d(dtype=float),
):
    """Raise the peak von Mises stress of each body part, in units of Young's modulus."""
    at = environment_of(wp.tid(), body.count)
    e = at[0]
    p = at[1]
    if not mask[e]:
        return
    q = body.first + p
    G = matrix_at(F, e, q)
    tau = kirchhoff_stress(
        particles.material[row(e, particles.material.shape[0]), q],
        G,
        particles.mu[row(e, particles.mu.shape[0]), q],
        particles.lam[row(e, particles.lam.shape[0]), q],
    )
    stress = von_mises_stress(tau, wp.determinant(G)) * inverse_modulus
    if wp.isfinite(stress):
        raise_peak(observation, e, agent, start + part[p], stress)


@wp.kernel
def observe_contact(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    sensors: Sensors,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the impulse on each body part by all subjects but the avatar itself, whose subject is ``agent``."""
    e, part = wp.tid()
    total = wp.vec3()
    for s in range(sensors.part_impulse.shape[2]):
        if s != agent:
            total += sensors.part_impulse[e, agent * _NUM_PARTS + part, s]
    write_vector(observation, e, agent, start + 3 * part, wp.quat_rotate(wp.quat_inverse(rotation[e, 0]), total))


@wp.kernel
def observe_joints(
    agent: int,
    start: int,
    body: Body,
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=float),
    sensors: Sensors,
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the terms of ``JOINT_TERMS`` from component ``start`` on; over ``(num_envs, bones)``."""
    e, b = wp.tid()
    frame = rotation[e, 0]
    if b > 0:
        frame = rotation[e, body.parent[b]]
    spin = wp.vec3(velocity[e, 3 + 3 * b], velocity[e, 4 + 3 * b], velocity[e, 5 + 3 * b])
    write_vector(observation, e, agent, start + 3 * b, wp.quat_rotate_inv(frame, spin))
    if b == 0:
        impulse = wp.quat_rotate_inv(frame, sensors.boundary_impulse[e, agent])
        write_vector(observation, e, agent, start + 3 * rotation.shape[1], impulse)


@wp.kernel
def clean_observation(observation: wp.array3d(dtype=float)):
    """Set values that are not finite to zero."""
    e, agent, n = wp.tid()
    if not wp.isfinite(observation[e, agent, n]):
        observation[e, agent, n] = 0.0


@wp.kernel
def observe_prop(
    agent: int,
    start: int,
    prop: int,
    root_rotation: wp.array2d(dtype=wp.quat),
    root_position: wp.array2d(dtype=wp.vec3),
    position: wp.array2d(dtype=wp.vec3),
    rotation: wp.array2d(dtype=wp.quat),
    velocity: wp.array2d(dtype=wp.vec3),
    spin: wp.array2d(dtype=wp.vec3),
    deformation: wp.array2d(dtype=float),
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the terms of :func:`prop_terms` from component ``start`` on."""
    e = wp.tid()
    to_root = wp.quat_inverse(root_rotation[e, 0])
    offset = position[e, prop] - root_position[e, 0]
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, offset))
    write_rotation(observation, e, agent, start + 3, to_root * rotation[e, prop])
    write_vector(observation, e, agent, start + 9, wp.quat_rotate(to_root, velocity[e, prop]))
    write_vector(observation, e, agent, start + 12, wp.quat_rotate(to_root, spin[e, prop]))
    observation[e, agent, start + 15] = deformation[e, prop]


@wp.kernel
def observe_other(
    agent: int,
    start: int,
    rotation: wp.array2d(dtype=wp.quat),
    position: wp.array2d(dtype=wp.vec3),
    other_rotation: wp.array2d(dtype=wp.quat),
    other_position: wp.array2d(dtype=wp.vec3),
    other_velocity: wp.array2d(dtype=wp.vec3),
    # out
    observation: wp.array3d(dtype=float),
):
    """Write the terms of :func:`other_terms` from component ``start`` on."""
    e = wp.tid()
    to_root = wp.quat_inverse(rotation[e, 0])
    at = position[e, 0]
    write_vector(observation, e, agent, start, wp.quat_rotate(to_root, other_position[e, 0] - at))
    write_rotation(observation, e, agent, start + 3, to_root * other_rotation[e, 0])
    write_vector(observation, e, agent, start + 9, wp.quat_rotate(to_root, other_velocity[e, 0]))
    for n in range(5):
        mark = other_position[e, _LANDMARK[n]]
        write_vector(observation, e, agent, start + 12 + 3 * n, wp.quat_rotate(to_root, mark - at))

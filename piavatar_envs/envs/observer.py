"""What the agents of a world observe, term by term, and the launches that write it."""

from __future__ import annotations

import warp as wp

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, NUM_JOINTS
from piavatar_envs.avatar.torque_control.controller import TorqueController
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.episodes import EpisodeArrays
from piavatar_envs.envs.observations import (
    CONTACT_TERMS,
    JOINT_TERMS,
    SELF_TERMS,
    ObservationLayout,
    clean_observation,
    clear_stress,
    observe_body,
    observe_contact,
    observe_joints,
    observe_other,
    observe_prop,
    observe_stress,
    other_terms,
    prop_terms,
    tracked_arrays,
)
from piavatar_envs.envs.parameters import Parameters
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.world import Simulation


class Observer:
    """Layout of the observation, and how it comes about.

    Every agent observes itself, then (where the task says so) contact, (under torques) its joints' velocities,
    props and the other agents, then the task's own terms and, if the configuration says so, what the episode has
    drawn. The others are counted on from oneself, so that all agents see the world alike.

    Attributes:
        layout: of the flat observation.
        task_start: first component of the task's terms.
        parameters: what the episode has drawn, or None.
        everybody: a mask of all environments, ``(num_envs,)`` bool.
    """

    def __init__(self, simulation: Simulation, task: Task) -> None:
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
        self.everybody = wp.full(simulation.num_envs, True, dtype=wp.bool, device=device)
        self._part = [wp.array(flesh.part, dtype=int, device=device) for flesh in simulation.flesh]

    def record(self, graph: LaunchGraph, agent: int, observation: wp.array, mask: wp.array | None = None) -> None:
        """Append: write all but the task's terms of ``agent``. Changes nothing else.

        What takes a pass over the particles is written where there is no ``mask``, or where it is set.
        """
        mask = self.everybody if mask is None else mask
        sim = self.simulation
        n, avatar = sim.num_envs, sim.avatars[agent]
        start = self.layout["stress"].slice.start
        graph.launch(observe_body, (n, NUM_JOINTS), [agent, *tracked_arrays(avatar.tracked)], [observation])
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
                observe_contact, (n, len(BODY_PARTS)), [agent, at, avatar.tracked.rotation, sim.sensors], [observation]
            )
        controller = sim.controllers[agent]
        if isinstance(controller, TorqueController):
            at, joints = self.layout[JOINT_TERMS[0].name].slice.start, controller.state
            inputs = [agent, at, avatar.body, joints.rotation, joints.velocity, sim.sensors]
            graph.launch(observe_joints, (n, NUM_JOINTS), inputs, [observation])
        self._record_others(graph, agent, observation)

    def _record_others(self, graph: LaunchGraph, agent: int, observation: wp.array) -> None:
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
        """Find what is observed of the task's draws, when the task has allocated it."""
        if self.parameters:
            self.parameters.connect(env.num_envs, self.task.drawn_values(env))

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Append, when all has been drawn: keep what the masked environments have drawn."""
        if self.parameters:
            self.parameters.record_reset(graph, mask)

    def record_settings(self, graph: LaunchGraph) -> None:
        """Append, before anybody observes: look at what may have been changed since."""
        if self.parameters:
            self.parameters.record_settings(graph)

    def record_parameters(self, graph: LaunchGraph, env: EpisodeArrays, agent: int) -> None:
        """Append: write what the episode has drawn for ``agent``. Changes nothing else."""
        if self.parameters:
            self.parameters.record_observe(graph, env, agent)

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of a checkpoint, by name."""
        return self.parameters.arrays() if self.parameters else {}

    def record_clean(self, graph: LaunchGraph, observation: wp.array) -> None:
        """Append: numbers that are not finite, of an environment that has failed, become zero."""
        graph.launch(clean_observation, observation.shape, [], [observation])

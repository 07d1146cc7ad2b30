"""Kernels by which episodes begin, are counted, and end."""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def count_episodes(
    mask: wp.array(dtype=wp.bool),
    new_seed: wp.array(dtype=int),
    # in and out
    seeded: wp.array(dtype=wp.bool),
    # out
    seed: wp.array(dtype=int),
    episode: wp.array(dtype=int),
    begins: wp.array(dtype=int),
):
    """The next episode of the masked environments, or the first one of a new seed; whether any ``begins``."""
    e = wp.tid()
    if not mask[e]:
        return
    begins[0] = 1
    episode[e] = episode[e] + 1
    if seeded[e]:
        seeded[e] = False
        seed[e] = new_seed[e]
        episode[e] = 0


@wp.kernel
def find_ended(
    terminated: wp.array2d(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
    # out
    mask: wp.array(dtype=wp.bool),
):
    """Where every agent has terminated or the clock has run out."""
    e = wp.tid()
    ended = bool(True)
    for agent in range(terminated.shape[1]):
        if not terminated[e, agent]:
            ended = False
    mask[e] = ended or truncated[e]


@wp.kernel
def begin_episode(
    mask: wp.array(dtype=wp.bool),
    # out
    step_count: wp.array(dtype=int),
    head_start: wp.array(dtype=int),
    terminated: wp.array2d(dtype=wp.bool),
    truncated: wp.array(dtype=wp.bool),
    success: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
    begins: wp.array(dtype=int),
):
    """Clocks and flags of the masked environments back to the start; that any ``begins`` is known by now."""
    e, agent = wp.tid()
    begins[0] = 0
    if mask[e]:
        step_count[e] = 0
        head_start[e] = 0
        truncated[e] = False
        terminated[e, agent] = False
        success[e, agent] = False
        alive[e, agent] = True


@wp.kernel
def retire(agent: int, alive: wp.array2d(dtype=wp.bool), let_go: wp.array(dtype=int)):
    """Nothing holds the root of an agent that is out."""
    e = wp.tid()
    if not alive[e, agent]:
        let_go[e] = 1


@wp.kernel
def end_agent(
    agent: int,
    num_agents: int,
    failure: wp.array(dtype=int),
    let_go: wp.array(dtype=int),
    terms: wp.array3d(dtype=float),
    cost_terms: wp.array3d(dtype=float),
    # out
    reward: wp.array2d(dtype=float),
    cost: wp.array2d(dtype=float),
    # in and out
    terminated: wp.array2d(dtype=wp.bool),
    alive: wp.array2d(dtype=wp.bool),
):
    """Sum the terms of an agent; a fall and a failure terminate it. What is out among several earns nothing."""
    e = wp.tid()
    out = num_agents > 1 and not alive[e, agent]
    total = float(0.0)
    for n in range(terms.shape[2]):
        if out or not wp.isfinite(terms[e, agent, n]):
            terms[e, agent, n] = 0.0
        total += terms[e, agent, n]
    reward[e, agent] = total
    total = float(0.0)
    for n in range(cost_terms.shape[2]):
        if out or not wp.isfinite(cost_terms[e, agent, n]):
            cost_terms[e, agent, n] = 0.0
        total += cost_terms[e, agent, n]
    cost[e, agent] = total
    terminated[e, agent] = failure[e] != 0 or let_go[e] != 0 or terminated[e, agent] or out
    alive[e, agent] = not terminated[e, agent]


@wp.kernel
def end_step(
    max_steps: int,
    terminated: wp.array2d(dtype=wp.bool),
    head_start: wp.array(dtype=int),
    # in and out
    step_count: wp.array(dtype=int),
    # out
    truncated: wp.array(dtype=wp.bool),
):
    """Count the step; the clock truncates where an agent is still in."""
    e = wp.tid()
    step_count[e] = step_count[e] + 1
    left = int(0)
    for agent in range(terminated.shape[1]):
        if not terminated[e, agent]:
            left += 1
    truncated[e] = step_count[e] + head_start[e] >= max_steps and left > 0

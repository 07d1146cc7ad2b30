"""All paths of P2G give the same physics, and those in fixed point the same bits every time."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.physics.matter import lattice
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.cuda import tiled_p2g
from piavatar_envs.mpm.cuda.block_grid import MOST_PARTICLES
from piavatar_envs.mpm.cuda.tile_grid import CAPACITY
from piavatar_envs.mpm.memory import ACTIVE_MARGIN, LARGE_MARGIN, estimate_active_blocks
from piavatar_envs.mpm.model import MaterialPoints
from piavatar_envs.mpm.p2g import MAX_QUANTA
from piavatar_envs.mpm.solver import record_first_activation, record_p2g
from piavatar_envs.mpm.types import FAILURE_CFL, PATHS

ARRAYS = ("x", "u", "C", "F")
CUBES = [
    {"box": ((-0.2, -0.1, -0.1), (0.0, 0.1, 0.1)), "velocity": (1.0, 0.2, 0.0)},
    {"box": ((0.0, -0.12, -0.07), (0.2, 0.08, 0.13)), "velocity": (-1.0, 0.0, 0.4)},
]
#: Slots that are enough for them.
SLOTS = 250
PLANE = [((0.0, 0.0, 1.0), -0.11, 0.5)]


@pytest.fixture
def path(request, device):
    """Return a path of P2G, or skip the paths of a GPU on a CPU."""
    if request.param != "plain" and device == "cpu":
        pytest.skip("only the plain path is for a CPU")
    return request.param


def heights(sim, owner):
    """Return the heights of the nodes of a block [m]."""
    grid = sim.model.grid
    return float(grid.origin[2]) + float(grid.dx) * (4 * (owner % int(grid.blocks[2])) + np.arange(64) % 4)


@pytest.fixture
def collide(meet):
    """Return two cubes that tumble into each other and a plane, in three worlds, in a random order of the particles."""

    def build(**kwargs):
        sim = meet(CUBES, friction=0.3, planes=PLANE, gravity=(0.0, 0.0, -9.81), num_envs=3, **kwargs)
        rng = np.random.default_rng(4)
        shape = (3, len(sim.rest), 3)
        return sim.set(u=sim.state.u.numpy() + rng.normal(0.0, 0.1, shape), C=rng.normal(0.0, 1.0, (*shape, 3)))

    return build


def records_of(sums):
    """Return masses and momenta, and offsets, in fixed point or not."""
    return (sums.fixed, sums.offset_fixed) if sums.is_fixed else (sums.value, sums.offset)


def node_sums(sim):
    """Return mass, momenta and offsets of the nodes of active blocks, ``{(env, owner): (64, 10)}``."""
    model, scratch, graph = sim.model, sim.scratch, LaunchGraph(sim.model.device)
    record_first_activation(graph, model, sim.state, scratch)
    record_p2g(graph, model, sim.state, scratch)
    graph.run()
    count, owner = scratch.blocks.num_active.numpy(), scratch.blocks.owner.numpy()
    own, places = records_of(scratch.accumulators)
    halves = own.numpy().astype(float).reshape(model.num_envs, -1, 2, 64, 4)
    offsets = places.numpy().astype(float).reshape(model.num_envs, -1, 64, 4)
    sums = np.concatenate([halves[:, :, 0], halves[:, :, 1, :, :3], offsets[..., :3]], axis=-1)
    if scratch.accumulators.is_fixed:
        mass = scratch.accumulators.mass_quantum.numpy()[0, 0]
        sums[..., 0] *= mass
        sums[..., 1:7] *= scratch.accumulators.momentum_quantum.numpy()[0, 0]
        sums[..., 7:] *= mass * float(model.grid.dx)
    records = sums.reshape(model.num_envs, model.max_active_blocks, 64, 10)
    return {(e, owner[e, s]): records[e, s] for e in range(model.num_envs) for s in range(count[e])}


def nodes_by_hand(sim):
    """Return these sums in double precision, of unstrained bodies: ``w m`` times 1, velocities and offsets."""
    model, grid = sim.model, sim.model.grid
    origin, dx = np.asarray(grid.origin, float), float(grid.dx)
    blocks, num_blocks = np.asarray(grid.blocks), model.num_blocks
    mass, field = model.particles.mass.numpy()[0].astype(float), model.particles.field.numpy()
    found = {}
    for e in range(model.num_envs):
        x, u, C, vk = (sim.get(name, e) for name in ("x", "u", "C", "vk"))
        base = np.floor((x - origin) / dx - 0.5).astype(int)
        f = (x - origin) / dx - base
        w = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2], axis=1)
        for offset in np.ndindex(3, 3, 3):
            node = base + offset
            weight = mass * np.prod([w[:, o, axis] for axis, o in enumerate(offset)], axis=0)
            d = (np.array(offset) - f) * dx
            share = np.column_stack([np.ones(len(x)), u + np.einsum("pij,pj->pi", C, d), vk, d]) * weight[:, None]
            b = node // 4
            block = field * num_blocks + (b[:, 0] * blocks[1] + b[:, 1]) * blocks[2] + b[:, 2]
            local = ((node[:, 0] & 3) * 4 + (node[:, 1] & 3)) * 4 + (node[:, 2] & 3)
            for p in range(len(x)):
                found.setdefault((e, block[p]), np.zeros((64, 10)))[local[p]] += share[p]
    return found


@pytest.mark.parametrize("path", [name for name in PATHS if name != "block"], indirect=True)
def test_sums_are_those_of_the_equations(collide, path):
    # Of unstrained bodies; what stress adds is held by the momentum and energy tests. Kinematic momentum and offsets
    # are for contact: nodes have them whole that two bodies are at, or matter that is at the plane.
    sim = collide(path=path)
    rng = np.random.default_rng(5)
    sim.set(vk=rng.normal(0.0, 0.3, sim.state.vk.numpy().shape))
    found, expected = node_sums(sim), nodes_by_hand(sim)
    assert set(found) >= set(expected)
    compared = 0
    for key, sums in found.items():
        scale, by_hand = 0.125, expected.get(key, np.zeros((64, 10)))  # a cell of matter [kg], at 1 m/s
        np.testing.assert_allclose(sums[:, :4], by_hand[:, :4], atol=3e-6 * scale, err_msg=str(key))
        shared = sum((key[0], key[1] % sim.model.num_blocks + f * sim.model.num_blocks) in found for f in range(2)) > 1
        known = shared | (heights(sim, key[1]) < PLANE[0][1] + 2.0 * float(sim.model.grid.dx))
        np.testing.assert_allclose(sums[known, 4:], by_hand[known, 4:], atol=3e-6 * scale, err_msg=str(key))
        compared += np.count_nonzero(by_hand[known, 4:])
    assert compared > 1000


@pytest.mark.parametrize("path", [name for name in PATHS if name != "block"], indirect=True)
@pytest.mark.parametrize("edges", [(4.0, 4.0, 2.4), (7.0, 5.0, 2.4)])
def test_contact_candidates_in_boxes_of_any_size(simulate, path, edges):
    # Kinematic momentum and offsets of candidates, which a tile adds at once or, in large boxes, in two rounds.
    rng = np.random.default_rng(7)
    sim = simulate(rest=rng.uniform(0.3, 1.0, (30, 3)), planes=[((0.0, 0.0, 1.0), 0.0, 0.5)], path=path)
    dx = float(sim.model.grid.dx)
    x = dx * rng.uniform(0.0, edges, (30, 3))
    x[:2] = [[0.0, 0.0, 0.0], dx * np.array(edges)]
    sim.set(x=x + [0.0, 0.0, 0.3 * dx], vk=rng.normal(0.0, 0.3, (30, 3)))
    base = np.floor((sim.get("x") - np.array(sim.model.grid.origin)) / dx - 0.5).astype(int)
    subblocks = np.prod((base.max(0) + 2) // 2 - base.min(0) // 2 + 1)  # of 2 x 2 x 2 nodes, around all particles
    assert (subblocks > CAPACITY // 2) == (edges[0] > 4.0) and subblocks <= CAPACITY
    found, expected = node_sums(sim), nodes_by_hand(sim)
    assert set(found) >= set(expected)
    for key, sums in found.items():
        by_hand = expected.get(key, np.zeros((64, 10)))
        np.testing.assert_allclose(sums, by_hand, atol=2e-7, err_msg=str(key))


@pytest.mark.parametrize("path", ["tiled"], indirect=True)
def test_without_mass_nothing_is_added(simulate, path):
    # Light particles are fast: their momentum counts, their mass is less than a unit. A node with momentum and no mass
    # would be skipped, and keep its momentum.
    rng = np.random.default_rng(8)
    light = np.arange(8) > 3
    rest = rng.uniform(-0.02, 0.02, (8, 3)) + np.where(light, 0.15, -0.15)[:, None] * [1.0, 0.0, 0.0]
    points = MaterialPoints.uniform(np.where(light, 1e-10, 1.0) * 0.025**3)
    sim = simulate(rest=rest, points=points, path=path).set(u=np.where(light, 1e4, 0.0)[:, None])
    assert len(sim.model.particles.tiles) == 2  # of all, and where it ends
    sums = np.concatenate(list(node_sums(sim).values()))
    assert sim.failures == [0] and 27 <= np.count_nonzero(sums[:, 0]) <= 64
    assert not sums[:, 1:].any()


@pytest.mark.parametrize(("share", "failure"), [(0.1, 0), (0.95, FAILURE_CFL)])
def test_sums_too_large_for_their_words_fail(simulate, device, share, failure):
    # Particles that may be added up, but are too much together: a node has those of eight.
    if device == "cpu":
        pytest.skip("a CPU adds floating-point numbers")
    sim = simulate(path="tiled")
    unit, mass = sim.scratch.accumulators.momentum_quantum.numpy()[0, 0], sim.model.particles.mass.numpy()[0, 0]
    sim.set(u=(share * float(MAX_QUANTA) * float(unit) / float(mass), 0.0, 0.0))
    node_sums(sim)
    assert sim.failures == [failure]


@pytest.mark.parametrize("path", [name for name in PATHS if name != "plain"], indirect=True)
def test_paths_agree_and_repeat_bit_for_bit(collide, path):
    # With the plain one, to what round-off makes of a collision of viscous matter; with themselves in every bit, with
    # contact, sensors and all.
    matter = {"retardation": 2e-3}
    other, again = (collide(path=path, max_active_blocks=SLOTS, **matter).run(2) for _ in range(2))
    plain = collide(path="plain", **matter).run(2)
    for array, atol in zip(ARRAYS, (1e-5, 2e-3, 2e-1, 1e-3), strict=True):
        np.testing.assert_array_equal(getattr(other.state, array).numpy(), getattr(again.state, array).numpy())
        for e in range(3):
            np.testing.assert_allclose(other.get(array, e), plain.get(array, e), atol=atol, err_msg=array)
    for name in ("boundary_impulse", "pair_impulse", "part_impulse"):
        found = getattr(other.scratch.sensors, name).numpy()
        assert found.any(), name
        np.testing.assert_array_equal(found, getattr(again.scratch.sensors, name).numpy(), err_msg=name)


def test_small_tiles_agree(collide, device, monkeypatch):
    # Tiles have their own quanta, and some need several passes.
    if device == "cpu":
        pytest.skip("tiles are a GPU's")
    monkeypatch.setattr(tiled_p2g, "TILE_SIZES", ((2**31, 32),))
    grouped, plain = collide(path="tiled", max_active_blocks=SLOTS).run(2), collide(path="plain").run(2)
    for e in range(3):
        for array, atol in zip(ARRAYS, (1e-5, 2e-3, 2e-1, 1e-3), strict=True):
            np.testing.assert_allclose(grouped.get(array, e), plain.get(array, e), atol=atol, err_msg=array)


def test_subblocks_that_do_not_fit_go_in_rounds(collide, device):
    # Sums are integers: how many subblocks shared memory holds at once changes no bit of the sums.
    if device == "cpu":
        pytest.skip("shared memory is a GPU's")
    once, often = (collide(path="block", max_active_blocks=SLOTS) for _ in range(2))
    assert once.scratch.arena.capacity > 150
    often.scratch.arena.capacity = 40
    once.run(2), often.run(2)
    for array in ARRAYS:
        np.testing.assert_array_equal(
            getattr(once.state, array).numpy(), getattr(often.state, array).numpy(), err_msg=array
        )


def test_a_large_arena_gives_the_same(simulate, equal, device, monkeypatch):
    # One world has it to itself; in a batch there are two in a multiprocessor.
    if device == "cpu":
        pytest.skip("shared memory is a GPU's")
    start = {"u": (0.3, -0.2, 0.1), "C": np.diag([1.0, -2.0, 0.5])}
    large = simulate(path="block", max_active_blocks=SLOTS // 2).set(**start)
    assert large.scratch.large_arena
    monkeypatch.setattr("piavatar_envs.mpm.cuda.block_grid.needs_large_arena", lambda model, partitions: False)
    small = simulate(path="block", max_active_blocks=SLOTS // 2, control_dt=large.model.control_dt).set(**start)
    assert not small.scratch.large_arena
    for array in ARRAYS:
        assert equal(large.run(2).get(array), small.run(2).get(array)), array


@pytest.mark.parametrize("copies", [80, 300])
def test_a_crowd_is_counted_in_larger_quanta(simulate, device, copies):
    # A node with more than sixteen particles of one field overflows its words, which must be noticed each time. A
    # corner of the box is crowded; the sums of the others must not depend on the rounds that subblocks go in.
    if device == "cpu":
        pytest.skip("a CPU adds floating-point numbers")
    box = simulate(spacing=0.05).rest
    rest = np.concatenate([np.repeat(box[:1], copies, axis=0), box[1:]])
    moved = []
    for capacity in (None, 12, 7):
        sim = simulate(rest=rest, path="block", max_active_blocks=SLOTS).set(u=(0.3, -0.2, 0.1))
        sim.scratch.arena.capacity = capacity or sim.scratch.arena.capacity
        sim.run(3)
        assert sim.failures == [0]
        np.testing.assert_allclose(sim.get("u"), np.tile([0.3, -0.2, 0.1], (len(rest), 1)), atol=1e-5)
        moved.append(sim.get("x"))
    np.testing.assert_array_equal(*moved[1:])  # with a single round G2P reads shared memory


def test_too_few_active_blocks_fail_one_environment(simulate):
    # A body that flies apart needs more blocks than there are: that environment fails, says so, and can be reset.
    sim = simulate(num_envs=2, num_substeps=10, max_active_blocks=40, margin=1.0)
    together = sim.state.x.numpy().copy()
    apart = together.copy()
    apart[1] *= 6.0
    sim.set(x=apart).run()
    assert sim.failures == [0, 16] and np.array_equal(sim.state.x.numpy()[1], apart[1].astype(np.float32))
    sim.state.failure.zero_()
    fresh = simulate(num_envs=2, num_substeps=10, max_active_blocks=40, margin=1.0).set(x=together).run()
    zero = np.zeros(3)
    sim.set(x=together, u=zero, C=np.zeros((3, 3)), F=np.eye(3)).run()
    assert sim.failures == [0, 0] and sim.accumulators_are_clear
    np.testing.assert_array_equal(sim.state.x.numpy(), fresh.state.x.numpy())


def test_active_blocks_that_run_out_in_flight(simulate):
    # A body that leaves its blocks within a control step, with no active block to spare.
    still = simulate(num_substeps=10).run()
    used = int(still.scratch.blocks.num_active.numpy()[0])
    assert simulate(num_substeps=10, max_active_blocks=used).run().failures == [0]
    moving = simulate(num_substeps=10, max_active_blocks=used).set(u=(6.0, 0.0, 0.0))
    assert moving.run().failures == [16] and moving.accumulators_are_clear


def test_fast_bodies_leave_their_blocks_behind(simulate):
    # 20 m/s: in a control step the body sweeps many times the blocks that it ever needs at once.
    active_blocks = estimate_active_blocks(simulate().rest, None, 0.05)
    sim = (
        simulate(num_substeps=80, control_dt=0.1, margin=2.5, max_active_blocks=active_blocks)
        .set(u=(20.0, 0.0, 0.0))
        .run()
    )
    assert sim.failures == [0]
    np.testing.assert_allclose(sim.get("x") - sim.rest, np.tile([2.0, 0.0, 0.0], (len(sim.rest), 1)), atol=1e-3)


def test_large_bodies_have_more_blocks_to_leave_behind():
    # Their blocks are activated every 25 substeps, in which they move many grid spacings.
    box = {"lower": (-0.3, -0.675, -0.675), "upper": (0.3, 0.675, 0.675), "spacing": 0.05}
    rest = lattice(**box)
    assert len(rest) > MOST_PARTICLES
    few, enough = (estimate_active_blocks(rest, None, 0.05, margin) for margin in (ACTIVE_MARGIN, LARGE_MARGIN))
    assert estimate_active_blocks(rest, None, 0.05) == enough
    assert estimate_active_blocks(rest[:MOST_PARTICLES], None, 0.05) <= few

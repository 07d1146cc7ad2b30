"""Substeps that are one launch each give what substeps of three launches give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from piavatar_envs.mpm import relay_contact, solver
from piavatar_envs.mpm.build import MaterialPoints
from piavatar_envs.mpm.relay import PORTION, portions
from piavatar_envs.mpm.team_others import meets_others
from piavatar_envs.mpm.turns import has_turns
from piavatar_envs.mpm.types import FAILURE_BLOCKS, FAILURE_CFL, FAILURE_NONFINITE, FAILURE_OUT_OF_GRID

ARRAYS = ("x", "u", "C", "F")


def same(a, b, atol=(1e-6, 1e-4, 1e-2, 1e-5)):
    for array, tolerance in zip(ARRAYS, atol, strict=True):
        for e in range(a.model.num_envs):
            np.testing.assert_allclose(a.get(array, e), b.get(array, e), atol=tolerance, err_msg=array)


@pytest.mark.parametrize("decoupling", ["split", "none", "no_stress"])
def test_relays_are_substeps(drop, one_by_one, decoupling):
    """With a floor that the body slides on, kinematic velocities, and what the sensors say of it."""
    relay, apart = drop(decoupling=decoupling), one_by_one(drop(decoupling=decoupling))
    assert "carry_on" in relay.program.names and "carry_on" not in apart.program.names
    start = relay.get("x")
    relay.run(2), apart.run(2)
    assert relay.failures == apart.failures == [0, 0, 0]
    assert np.abs(relay.get("x") - start).max() > 0.01
    same(relay, apart)
    for name in ("boundary_impulse", "boundary_moment"):
        found, expected = (getattr(sim.scratch.sensors, name).numpy() for sim in (relay, apart))
        assert np.abs(expected).max() > 0.01
        np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4, err_msg=name)
    assert relay.sums_are_clear and apart.sums_are_clear


@pytest.mark.parametrize("count", [1, PORTION, PORTION + 1, 100, 3 * PORTION + 2])
def test_portions_are_equal(count):
    parts = portions(count)
    assert sum(parts) == count and max(parts) <= PORTION and max(parts) - min(parts) <= 1


def test_a_single_substep_is_one_too(drop, one_by_one):
    relay, apart = drop(num_substeps=1, control_dt=1e-3), one_by_one(drop(num_substeps=1, control_dt=1e-3))
    same(relay.run(3), apart.run(3))
    assert relay.sums_are_clear


def test_bodies_that_go_far(drop, one_by_one):
    """Through blocks that they mark themselves, over several portions, turned by nothing."""
    settings = {"num_substeps": PORTION + 10, "num_envs": 1, "planes": (), "gravity": (0.0, 0.0, 0.0)}
    relay, apart = drop(**settings), one_by_one(drop(**settings))
    for sim in (relay, apart):
        sim.set(u=(12.0, 3.0, -5.0), C=np.zeros((3, 3)), vk=(-1.0, 0.0, 0.5), spin=np.zeros(3)).run()
    assert relay.failures == [0]
    np.testing.assert_allclose(
        relay.get("x") - relay.rest, [[11.0 / 30, 3.0 / 30, -4.5 / 30]] * len(relay.rest), atol=1e-3
    )
    same(relay, apart)
    assert relay.sums_are_clear


def test_more_blocks_than_warps(drop, one_by_one):
    """Each particle is in blocks of its own, and a warp of four clears dozens."""
    rest = np.random.default_rng(6).uniform(-0.5, 0.5, (60, 3))
    settings = {"rest": rest, "num_envs": 2, "planes": [((0.0, 0.0, 1.0), -0.51, 0.5)]}
    relay, apart = drop(**settings).run(), one_by_one(drop(**settings)).run()
    assert relay.scratch.blocks.count.numpy().min() > 4 * 60 / 4
    same(relay, apart)
    assert relay.sums_are_clear and relay.failures == [0, 0]


def test_relays_repeat_bit_for_bit(drop):
    first, second = (drop(num_envs=2).run(2) for _ in range(2))
    for array in ARRAYS:
        np.testing.assert_array_equal(getattr(first.state, array).numpy(), getattr(second.state, array).numpy())
    for name in ("boundary_impulse", "boundary_moment"):
        found = getattr(first.scratch.sensors, name).numpy()
        np.testing.assert_array_equal(found, getattr(second.scratch.sensors, name).numpy(), err_msg=name)


@pytest.mark.parametrize(
    ("array", "value", "failure"),
    [
        ("u", np.nan, FAILURE_NONFINITE),
        ("u", 400.0, FAILURE_CFL),
        ("vk", np.inf, FAILURE_NONFINITE),
        ("x", 3.0, FAILURE_OUT_OF_GRID),
    ],
)
def test_who_fails_fails_alone(drop, one_by_one, array, value, failure):
    """As without relays: the others go on bit for bit, and the failed environment stands still for good."""
    well, ill = drop(), drop()
    values = ill.state.numpy()[array]
    values[1, 7] = value
    apart = one_by_one(drop().set(**{array: values}))
    well.run(2), ill.set(**{array: values}).run(), apart.run()
    assert ill.failures[0] == ill.failures[2] == 0 and ill.failures[1] & failure
    assert ill.failures == apart.failures
    stopped = ill.state.numpy()
    ill.run()
    for name in ARRAYS:
        after = ill.state.numpy()[name]
        np.testing.assert_array_equal(after[1], stopped[name][1], err_msg=name)
        np.testing.assert_array_equal(after[[0, 2]], well.state.numpy()[name][[0, 2]], err_msg=name)
    assert ill.sums_are_clear


@pytest.mark.parametrize("extra", [1, 3, 6])
@pytest.mark.parametrize("way", [(15.0, 0.0, 0.0), (0.0, 13.0, 5.0)])
def test_slots_that_run_out(drop, extra, way):
    """In flight: that environment fails and says so, nobody waits for ever, nothing of it comes to its neighbour."""
    world = {"planes": (), "gravity": (0.0, 0.0, 0.0), "num_envs": 2, "num_substeps": 30}
    still = {"u": np.zeros(3), "vk": np.zeros(3), "C": np.zeros((3, 3)), "spin": np.zeros(3)}
    used = int(drop(**world).set(**still).run().scratch.blocks.count.numpy()[0])
    rest = drop(max_slots=used + extra, **world).set(**still).run()
    sims = []
    for _ in range(2):
        sim = drop(max_slots=used + extra, **world).set(**still)
        sims.append(sim.set(u=np.stack([np.zeros((len(sim.rest), 3)), np.tile(way, (len(sim.rest), 1))])).run())
        assert sim.failures == [0, FAILURE_BLOCKS] and sim.sums_are_clear
    for name in ARRAYS:
        first, second = (sim.state.numpy()[name] for sim in sims)
        np.testing.assert_array_equal(first[0], rest.state.numpy()[name][0], err_msg=name)
        np.testing.assert_array_equal(first, second, err_msg=name)


@pytest.mark.parametrize("count", [401, 402, 403])
def test_warps_that_are_not_full(drop, one_by_one, count):
    """Two oblique walls besides, and particles of several masses that differ from world to world."""
    rest = np.random.default_rng(9).uniform(-0.1, 0.1, (count, 3))
    planes = [((0.0, 0.0, 1.0), -0.11, 0.5), ((0.6, 0.0, 0.8), -0.13, 0.3), ((0.0, 1.0, 1.0), -0.16, 0.0)]
    density = np.random.default_rng(1).uniform(900.0, 1100.0, (3, count))
    points = replace(MaterialPoints.uniform(np.full(count, 2e-5)), density=density)
    relay, apart = (drop(rest=rest, planes=planes, points=points) for _ in range(2))
    same(relay.run(), one_by_one(apart).run())
    assert relay.failures == [0, 0, 0] and relay.sums_are_clear


def test_what_relays_are_for(drop, simulate, meet):
    """A field a subject, normals of pairs, resting boundaries, and another variant than the paper's."""
    assert has_turns(drop().model)
    assert not has_turns(drop(decoupling="paper").model)
    assert not has_turns(simulate(scatter="runs").model)
    assert not has_turns(drop(spacing=0.0125).model)  # 64 particles a cell: too many to count
    balls = [{"ball": ((x, 0.0, 0.0), 0.1)} for x in (-0.2, 0.2)]
    assert has_turns(meet(balls, scatter="singles").model)
    assert not has_turns(meet(balls, scatter="singles", normals="own").model)


SENSED = ("boundary_impulse", "boundary_moment", "pair_impulse", "part_impulse", "penetration")


def test_relays_of_several_fields_are_substeps(clash, one_by_one):
    """Three subjects that meet each other and a floor, and what sensors say of all that."""
    relay, apart = clash(), one_by_one(clash())
    assert "carry_fields_on" in relay.program.names and "carry_fields_on" not in apart.program.names
    for _ in range(3):
        relay.run(), apart.run()
        assert relay.failures == apart.failures == [0, 0]
        same(relay, apart, (2e-5, 1e-2, 1.0, 1e-3))  # contact of nodes that are new comes a substep late
        for name in SENSED:
            found, expected = (getattr(sim.scratch.sensors, name).numpy() for sim in (relay, apart))
            np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-3, err_msg=name)
    assert all(np.abs(getattr(apart.scratch.sensors, name).numpy()).max() > 0.01 for name in SENSED)
    assert relay.sums_are_clear and apart.sums_are_clear


def test_portions_of_several_fields_are_substeps(clash, one_by_one, monkeypatch):
    """Who is where, which nodes are listed and what has been touched are forgotten where blocks are marked anew."""
    monkeypatch.setattr(solver, "portions", lambda count: [3] * (count // 3))
    settings = {"num_substeps": 37, "control_dt": 0.037}
    relay, apart = clash(**settings), one_by_one(clash(**settings))
    assert relay.program.names.count("begin_contact") == 12
    relay.run(), apart.run()
    assert relay.failures == [0, 0] and relay.sums_are_clear
    same(relay, apart, (1e-4, 3e-2, 3.0, 1e-3))
    for name in SENSED:
        found, expected = (getattr(sim.scratch.sensors, name).numpy() for sim in (relay, apart))
        np.testing.assert_allclose(found, expected, rtol=5e-3, atol=5e-3, err_msg=name)


@pytest.mark.parametrize("extra", [1, 4, 7])
def test_slots_that_run_out_of_several_fields(clash, extra):
    """In flight, while fields meet: what is left does not depend on who came first, nothing stays on the grid."""
    used = clash(num_substeps=2, control_dt=0.002).run().scratch.blocks.count.numpy().max()
    first, second = (clash(num_substeps=20, control_dt=0.03, max_slots=used + extra).run() for _ in range(2))
    assert any(failure & FAILURE_BLOCKS for failure in first.failures) and first.failures == second.failures
    assert first.sums_are_clear and second.sums_are_clear
    for name in ARRAYS:
        np.testing.assert_array_equal(first.state.numpy()[name], second.state.numpy()[name], err_msg=name)
    for name in SENSED:
        found, again = (getattr(sim.scratch.sensors, name).numpy() for sim in (first, second))
        np.testing.assert_array_equal(found, again, err_msg=name)


@pytest.mark.parametrize("num_substeps", [1, 2])
def test_few_substeps_of_several_fields(clash, one_by_one, num_substeps):
    """The last is always launched apart: with one, nothing is left for a relay."""
    settings = {"num_substeps": num_substeps, "control_dt": 1e-3 * num_substeps}
    relay, apart = clash(**settings).run(3), one_by_one(clash(**settings)).run(3)
    assert ("carry_fields_on" in relay.program.names) == (num_substeps > 1)
    assert relay.failures == [0, 0] and relay.sums_are_clear
    same(relay, apart, (2e-5, 1e-2, 1.0, 1e-3))


@wp.kernel
def ask_around(others: wp.array2d(dtype=int), base: wp.array(dtype=wp.vec3i), found: wp.array(dtype=bool)):
    """A particle of eight threads, each with the slot of its own number."""
    i = wp.tid()
    found[i] = meets_others(8, others, 0, wp.vec2i(i % 8, 0), base[i // 8])


@wp.kernel
def four_ask_around(others: wp.array2d(dtype=int), base: wp.array(dtype=wp.vec3i), found: wp.array(dtype=bool)):
    """The same of four threads, each with two slots, the lower and the upper along x."""
    i = wp.tid()
    at = base[i // 4]
    lower = i % 4
    upper = lower + 4
    if (at[0] & 3) < 2:
        upper = lower  # where the stencil lies in one block along an axis, that is the lower
    found[i] = meets_others(4, others, 0, wp.vec2i(lower, upper), at)


@pytest.mark.parametrize(("kernel", "team"), [(ask_around, 8), (four_ask_around, 4)])
def test_who_has_others_at_its_nodes(device, kernel, team):
    """By the bits of every node of the blocks around: all places of a stencil, one node at a time and several."""
    if device == "cpu":
        pytest.skip("relays are a GPU's")
    rng = np.random.default_rng(3)
    base = np.array(list(np.ndindex(4, 4, 4)))
    for count in (1, 1, 1, 2, 5):
        nodes = np.zeros((8, 8, 8), bool)  # two blocks along each axis
        nodes[tuple(rng.integers(0, 6, (3, count)))] = True
        bits = np.zeros((8, 2), np.uint32)  # slot, half
        for x, y, z in np.argwhere(nodes):
            local = 16 * (x % 4) + 4 * (y % 4) + z % 4
            bits[4 * (x // 4) + 2 * (y // 4) + z // 4, local // 32] |= np.uint32(1 << (local % 32))
        expected = [nodes[i : i + 3, j : j + 3, k : k + 3].any() for i, j, k in base]
        assert 0 < sum(expected) < len(base)
        # the slots of a stencil that lies in one block along an axis are those of the lower
        lower = base % 4 < 2
        found = wp.zeros(team * len(base), dtype=bool, device=device)
        others = wp.array(bits.reshape(1, -1).view(np.int32), dtype=int, device=device)
        at = wp.array(base.astype(np.int32), dtype=wp.vec3i, device=device)
        wp.launch(kernel, team * len(base), [others, at], [found], device=device, block_dim=128)
        by_thread = found.numpy().reshape(-1, team)
        for axis, bit in enumerate((4, 2, 1)):
            upper = (np.arange(team) & bit) != 0
            by_thread &= ~(lower[:, axis, None] & upper)
        np.testing.assert_array_equal(by_thread.any(1), expected)


def test_fields_that_meet_keep_momentum(clash):
    """What one loses the other gains: in the world, and in what sensors say of every body."""
    sim = clash(planes=(), num_substeps=30, control_dt=0.03)
    mass = sim.model.particles.mass.numpy()[0]
    field = sim.model.particles.field.numpy()

    def momenta():
        p = mass[:, None] * sim.get("u").astype(float)
        return np.stack([p[field == f].sum(0) for f in range(3)])

    before = momenta()
    sim.run()
    after = momenta()
    given = np.abs(after - before).max()
    assert sim.failures == [0, 0] and given > 0.5
    np.testing.assert_allclose(after.sum(0), before.sum(0), atol=1e-6 * np.abs(before).sum() + 1e-5)
    felt = sim.scratch.sensors.part_impulse.numpy()[0].sum(1)  # on the sensor of each, from all
    np.testing.assert_allclose(felt, after - before, atol=2e-4 * given)
    pairs = sim.scratch.sensors.pair_impulse.numpy()[0].reshape(3, 3, 3)
    np.testing.assert_allclose(pairs.sum(1) - pairs.sum(0), after - before, atol=2e-4 * given)


def test_relays_of_several_fields_repeat_bit_for_bit(clash):
    """Blocks are marked in flight in another order each time, and fields come to each other's."""
    first, second = (clash(num_substeps=PORTION + 9, control_dt=0.05).run(2) for _ in range(2))
    assert first.failures == [0, 0]
    for array in ARRAYS:
        np.testing.assert_array_equal(getattr(first.state, array).numpy(), getattr(second.state, array).numpy())
    for name in SENSED:
        found = getattr(first.scratch.sensors, name).numpy()
        np.testing.assert_array_equal(found, getattr(second.scratch.sensors, name).numpy(), err_msg=name)


def test_warps_that_have_several_nodes(clash, monkeypatch):
    """Where there are many environments, a warp comes back for more nodes at which fields may touch, and slots."""
    many = clash(planes=(), num_substeps=30, control_dt=0.03)
    monkeypatch.setattr(relay_contact, "warps_of_meeting", lambda model: 2)
    monkeypatch.setattr(relay_contact, "warps_that_clear", lambda model: 3)
    two = clash(planes=(), num_substeps=30, control_dt=0.03)
    dims = {launch.dim for launch in two.program._launches if launch.kernel.key == "meet_fields"}
    # the first has nobody to see to, the second nothing to clear
    assert sorted(dim - min(dims) for dim in dims) == [n * 32 * two.model.num_envs for n in (0, 2, 5)]
    many.run(), two.run()
    assert np.abs(two.scratch.sensors.part_impulse.numpy()).max() > 0.1
    for array in ARRAYS:
        np.testing.assert_array_equal(many.get(array), two.get(array), err_msg=array)
    for name in SENSED:
        found, expected = (getattr(sim.scratch.sensors, name).numpy() for sim in (two, many))
        np.testing.assert_array_equal(found, expected, err_msg=name)
    assert many.sums_are_clear and two.sums_are_clear


def test_fields_that_fail_fail_alone(clash, one_by_one):
    """The others go on bit for bit, who fails feels nothing from then on, and nothing is left on the grid."""
    well, ill, apart = clash().run(2), clash().run(), one_by_one(clash()).run()
    for sim in (ill, apart):
        u = sim.state.u.numpy()
        u[1, 5] = 400.0
        sim.set(u=u).run()
    for name in SENSED[:4]:
        found, expected = (getattr(sim.scratch.sensors, name).numpy()[1] for sim in (ill, apart))
        np.testing.assert_allclose(found, expected, rtol=5e-3, atol=5e-3, err_msg=name)
    assert ill.failures[0] == 0 and ill.failures[1] & FAILURE_CFL
    for name in ARRAYS:
        np.testing.assert_array_equal(ill.state.numpy()[name][0], well.state.numpy()[name][0], err_msg=name)
    for name in SENSED:
        found, expected = (getattr(sim.scratch.sensors, name).numpy()[0] for sim in (ill, well))
        np.testing.assert_array_equal(found, expected, err_msg=name)
    assert ill.sums_are_clear

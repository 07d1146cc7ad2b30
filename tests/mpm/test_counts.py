"""Sums of 32 bits, two a word: what they hold, at which speeds they count, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.mpm.counts import MOST_MASS, UNITS, Counts, give_numbers, numbers_at, vec2l, vec4i
from piavatar_envs.mpm.measures import (
    countable,
    forget_measures,
    known_speed,
    measure_speed,
    prepare_speeds,
    speed_of_counts,
)
from piavatar_envs.mpm.types import FAILURE_CFL, FAILURE_NONFINITE, group

wp.set_module_options({"enable_backward": False, "block_dim": 32})


@pytest.fixture(autouse=True)
def _on_a_gpu(device):
    if device == "cpu":
        pytest.skip("relays are a GPU's")


@wp.kernel
def give_and_read(given: wp.array2d(dtype=vec4i), words: wp.array2d(dtype=vec2l), found: wp.array(dtype=vec4i)):
    at = wp.tid()
    for n in range(given.shape[0]):
        give_numbers(words, 0, at, given[n, at])
    found[at] = numbers_at(words, 0, at)


def test_numbers_of_a_word_do_not_mix(device):
    """Of any sign, one after the other, up to all that 32 bits hold."""
    rng = np.random.default_rng(3)
    given = rng.integers(-(2**27), 2**27, (15, 64, 4)).astype(np.int32)
    given[0, :4] = [[0, 0, 0, 0], [-1, 0, -1, 0], [-1, -1, 1, -1], [1, -1, -1, 1]]
    given[1:, :4] = 0
    given[:, 4] = 0
    given[0, 4] = [2**31 - 1, -(2**31), -(2**31), 2**31 - 1]
    words = wp.zeros((1, 64), dtype=vec2l, device=device)
    found = wp.zeros(64, dtype=vec4i, device=device)
    inputs = [wp.array(given, dtype=vec4i, device=device)]
    wp.launch(give_and_read, 64, inputs, [words, found], device=device, block_dim=32)
    assert np.array_equal(found.numpy(), given.sum(0, dtype=np.int64))


@wp.kernel
def carry_speeds(index: int, speed: wp.array2d(dtype=float), counts: Counts, counted: wp.array2d(dtype=float)):
    """A warp an environment: at what speed the sums of a number count, and who is measured for those after the next."""
    e = wp.tid() // 32
    counted[e, index] = speed_of_counts(counts, e, index)
    known = known_speed(counts, e, index + 1)
    measure_speed(counts, e, index + 1, known, speed[e, wp.tid() % 32])
    if wp.tid() % 32 == 0:
        prepare_speeds(counts, e, index)


@wp.kernel
def measure_first(speed: wp.array2d(dtype=float), counts: Counts):
    e = wp.tid() // 32
    measure_speed(counts, e, 0, known_speed(counts, e, 0), speed[e, wp.tid() % 32])


@wp.kernel
def forget_all(counts: Counts):
    forget_measures(counts, wp.tid())


def test_speeds_are_those_of_the_fastest(device):
    """A power of two from four to eight times what the fastest had a substep before, or half of that before."""
    num_envs, steps, slowest = 3, 40, 0.25
    rng = np.random.default_rng(5)
    speed = rng.uniform(0.0, 1.0, (steps, num_envs, 32)) * np.exp2(rng.integers(-6, 6, (steps, num_envs, 1)))
    speed = speed.astype(np.float32)
    speed[10:20, 1] = 0.0
    zeros = {name: wp.zeros((num_envs, 4), dtype=int, device=device) for name in ("fastest", "heaviest")}
    counts = group(Counts, **zeros, slowest=slowest)
    counted = wp.zeros((num_envs, steps), dtype=float, device=device)

    def launch(kernel, threads, inputs, outputs):
        wp.launch(kernel, threads, inputs, outputs, device=device, block_dim=32)

    launch(measure_first, 32 * num_envs, [wp.array(speed[0], device=device)], [counts])
    for index in range(steps):  # as a relay: launch ``index - 1`` adds the sums of that number
        inputs = [index, wp.array(speed[max(index, 1)], device=device)]
        launch(carry_speeds, 32 * num_envs, inputs, [counts, counted])
    most = speed.max(2).T
    known = np.zeros((num_envs, steps + 2))
    known[:, 0] = known[:, 1] = most[:, 0]
    for index in range(steps):
        if index > 0:
            known[:, index + 1] = np.maximum(known[:, index - 1] / 2, most[:, index])
    expected = np.exp2(np.ceil(np.log2(4.0 * np.maximum(slowest, known[:, :steps]))))
    np.testing.assert_array_equal(counted.numpy()[:, 2:], expected[:, 2:])
    assert np.all(counted.numpy()[:, 2:] >= 4.0 * most[:, 1 : steps - 1])
    launch(forget_all, num_envs, [], [counts])
    assert not counts.fastest.numpy().any()


@wp.kernel
def admit(
    speed: wp.array(dtype=float), takes: wp.array(dtype=bool), failure: wp.array(dtype=int), found: wp.array(dtype=bool)
):
    n = wp.tid()
    found[n] = countable(takes[n], speed[n], 8.0, n, failure)


def test_who_is_too_fast_or_no_number_fails(device):
    speed = [0.0, 8.0, 8.1, np.inf, np.nan, np.nan]
    takes = [True, True, True, True, True, False]
    failure, found = wp.zeros(6, dtype=int, device=device), wp.zeros(6, dtype=bool, device=device)
    inputs = [wp.array(speed, dtype=float, device=device), wp.array(takes, dtype=bool, device=device)]
    wp.launch(admit, 6, inputs, [failure, found], device=device)
    assert found.numpy().tolist() == [True, True, False, False, False, False]
    assert failure.numpy().tolist() == [0, 0, FAILURE_CFL, FAILURE_NONFINITE, FAILURE_NONFINITE, 0]


def totals_of(counts: Counts, sets: int, at: int = 0, half: int = 0) -> np.ndarray:
    """Totals of the four physical or kinematic numbers of the first environment in a set of sums, exactly."""
    words = counts.sum.numpy()[0].reshape(sets, -1, 2, 64, 2)[at, :, half].reshape(-1, 2)
    low = words.astype(np.int32).astype(np.int64)
    high = (words - low) >> 32
    return np.stack([low, high], -1).reshape(-1, 4).sum(0)


@pytest.mark.parametrize("name", ["drop", "clash"])
def test_nothing_is_lost_by_what_is_rounded(request, name):
    """The middle node gets what the others leave: a particle adds as much as it has, rounded once."""
    thin = {"upper": (0.1, 0.1, -0.07)} if name == "drop" else {}  # all particles are near the floor, and tell that
    sim = request.getfixturevalue(name)(control_dt=0.012, decoupling="no_stress", **thin)
    mass, field = sim.model.particles.mass.numpy()[0], sim.model.particles.field.numpy()
    u = np.float32([1.3, -0.7, 0.0]) + 0.0 * sim.state.u.numpy()
    vk = np.float32([0.3, -0.2, 9.0]) + 0.0 * u  # which particles may tell, and so is measured
    sim.set(u=u, C=np.zeros((*u.shape, 3), np.float32), vk=vk, spin=0.0 * u)
    launches = sim.program.launches
    first = next(n for n, (own, _) in enumerate(launches) if own == "singles_to_counts")
    for _, launch in launches[: first + 1]:
        launch()
    counts = sim.scratch.turns.counts
    assert np.allclose(counts.fastest.numpy().view(np.float32)[:, :2], 9.0, rtol=1e-6)
    speed = 2.0 ** np.ceil(np.log2(4.0 * 9.0))
    heaviest = counts.heaviest.numpy().view(np.float32)[0]
    assert np.array_equal(heaviest, [mass[field == f].max() for f in range(len(heaviest))])
    unit = (2.0 ** np.ceil(np.log2(heaviest)) / float(UNITS)).astype(np.float32)[field]
    momentum_unit, sets = unit * np.float32(speed), 3 if name == "drop" else 2

    def total(numbers: np.ndarray) -> int:
        return int(np.rint(numbers).astype(np.int64).sum())

    expected = [total(mass / unit), *(total(mass * u[0, :, c] / momentum_unit) for c in range(3))]
    assert np.array_equal(totals_of(counts, sets), expected)
    if thin:
        expected = [*(total(mass * vk[0, :, c] / momentum_unit) for c in range(3)), 0]
        assert np.array_equal(totals_of(counts, sets, half=1), expected)
    is_first = True
    for own, launch in launches[first + 1 :]:
        launch()
        if own.startswith("carry") and is_first:
            assert totals_of(counts, sets, at=1)[0] == total(mass / unit)
            is_first = False
    assert not is_first and sim.failures == [0] * sim.model.num_envs and sim.sums_are_clear


@pytest.mark.parametrize("several", [False, True])
def test_momentum_of_free_bodies_is_kept(drop, meet, several):
    """Over 180 substeps, as what is rounded, and how momenta are divided by masses, take neither side."""
    kwargs = {"num_substeps": 60, "control_dt": 0.06, "planes": (), "gravity": (0.0, 0.0, 0.0)}
    if several:
        boxes = [{"box": ((x, -0.1, -0.1), (x + 0.2, 0.1, 0.1)), "density": d} for x, d in ((-0.6, 1000), (0.2, 70))]
        sim = meet(boxes, scatter="singles", **kwargs)
    else:
        sim = drop(num_envs=1, **kwargs)
    u = np.random.default_rng(6).normal(0.0, 0.2, (1, len(sim.rest), 3))
    sim.set(u=u - u.mean(1, keepdims=True) + [1.0, 0.0, -0.5])
    before = sim.totals()
    after = sim.run(3).totals()
    assert ("carry_fields_on" if several else "carry_on") in sim.program.names and sim.failures == [0]
    assert np.abs(after.momentum - before.momentum).max() < 2e-7 * before.momentum_scale
    assert np.abs(after.angular_momentum - before.angular_momentum).max() < 1e-6 * before.momentum_scale


def test_too_many_at_a_node_are_a_failure(drop):
    """All particles of one world at a place, those of another twice as dense."""
    sim = drop(num_substeps=4, control_dt=4e-3, num_envs=3, planes=(), decoupling="no_stress")
    x = sim.state.x.numpy()
    x[1] = x[1].mean(0) + 1e-3 * x[1]
    x[2] = x[2].mean(0) + 0.8 * (x[2] - x[2].mean(0))
    sim.set(x=x, u=0.0 * x, C=np.zeros((*x.shape, 3), np.float32), vk=0.0 * x).run()
    assert sim.failures[0] == sim.failures[2] == 0 and sim.failures[1] & FAILURE_CFL
    assert sim.sums_are_clear
    assert float(MOST_MASS) / float(UNITS) == 24.0


@pytest.mark.parametrize("factor", [20.0, 1e-2])
def test_masses_may_change_after_programs_are_built(drop, one_by_one, factor):
    """They count anew when blocks are marked: of other mass, as stiff for its mass."""
    relay, apart = drop(), one_by_one(drop())
    for sim in (relay, apart):
        sim.run()
        for name in ("mass", "mu", "lam"):
            array = getattr(sim.model.particles, name)
            array.assign(factor * array.numpy())
        sim.run()
    assert relay.failures == apart.failures == [0, 0, 0]
    for name, atol in (("x", 1e-6), ("u", 1e-4), ("F", 1e-5)):
        np.testing.assert_allclose(relay.get(name, 1), apart.get(name, 1), atol=atol, err_msg=name)


def test_what_is_no_number_fails_its_world(drop):
    sim = drop(num_substeps=6, control_dt=6e-3)
    C = sim.state.numpy()["C"]
    C[1, 7, 0, 2] = np.nan
    sim.set(C=C).run()
    assert sim.failures == [0, FAILURE_NONFINITE, 0] and sim.sums_are_clear


def test_what_falls_from_rest_does_not_fail(drop):
    """As fast as gravity makes it in a substep: 0.8 m/s, of 6 that make a grid spacing."""
    sim = drop(num_substeps=6, control_dt=0.048, gravity=(0.0, 0.0, -100.0), young_modulus=2e3, planes=(), margin=1.5)
    rest = 0.0 * sim.state.u.numpy()
    sim.set(u=rest, vk=rest, spin=rest, C=np.zeros((*rest.shape, 3), np.float32)).run()
    assert sim.failures == [0, 0, 0]
    np.testing.assert_allclose(sim.get("u")[:, 2], -4.8, rtol=1e-4)


def test_what_is_hit_by_a_light_part_may_be_as_fast(meet):
    """A limb of a hundredth of its body's density: what it hits is of one density and gets its speed."""
    boxes = [
        {"box": ((-0.2, -0.1, -0.1), (-0.01, 0.1, 0.1)), "velocity": (0.0, 0.0, 0.0)},
        {"box": ((0.02, -0.1, -0.1), (0.2, 0.1, 0.1)), "density": 10.0},
    ]
    sim = meet(boxes, scatter="singles", num_substeps=12, control_dt=0.012)
    particles, limb = sim.model.particles, (sim.rest[:, 0] > -0.08) & sim.of(0)
    for name in ("mass", "mu", "lam"):
        array, values = getattr(particles, name), getattr(particles, name).numpy()
        values[:, limb] /= 100.0
        array.assign(values)
    u = sim.state.u.numpy()
    u[:, limb] = [6.0, 0.0, 0.0]
    sim.set(u=u).run(2)
    assert "carry_fields_on" in sim.program.names and sim.failures == [0]
    assert sim.get("u")[sim.of(1), 0].max() > 0.4


def test_what_one_field_loses_the_other_gains(meet):
    """To the last unit, of fields whose units are others: by all launches of contact of a control step."""
    boxes = [
        {"box": ((-0.2, -0.1, -0.1), (0.0, 0.1, 0.1)), "velocity": (1.0, 0.3, 0.0)},
        {"box": ((0.0, -0.1, -0.1), (0.2, 0.1, 0.1)), "velocity": (-1.0, 0.0, 0.1), "density": 30.0},
    ]
    sim = meet(boxes, scatter="singles", friction=0.4, num_substeps=12, control_dt=0.012)
    for _, launch in sim.program.launches[:1]:
        launch()
    counts, held = sim.scratch.turns.counts, sim.scratch.blocks.held
    gathered, changed = 0, 0

    def momenta() -> list[list[int]]:
        """Of each field, in the units of the second one."""
        units = 2.0 ** np.ceil(np.log2(counts.heaviest.numpy().view(np.float32)[0]))
        field = held.numpy()[0] // sim.model.num_blocks
        words = counts.sum.numpy()[0].reshape(2, -1, 2, 64, 2)[gathered, :, 0]
        low = words.astype(np.int32).astype(np.int64)
        numbers = np.stack([low, (words - low) >> 32], -1).reshape(len(field), 64, 4)[..., 1:]
        return [(int(units[f] / units[1]) * numbers[field == f].sum((0, 1))).tolist() for f in range(2)]

    for name, launch in sim.program.launches[1:]:
        before = momenta() if name == "meet_fields" else None
        launch()
        if before is not None:
            after = momenta()
            assert np.array_equal(np.sum(after, 0), np.sum(before, 0))
            changed += after != before
        gathered = gathered ^ 1 if name == "carry_fields_on" else 0 if name == "sweep_sums" else gathered
    assert changed > 5 and sim.failures == [0]


def test_who_gains_too_much_in_a_substep_fails_alone(drop):
    """Where momenta are not counted as if gravity were at work: who falls from rest is too fast, who moves is not."""
    well, ill = (drop(num_substeps=6, control_dt=6e-3, gravity=(0.0, 0.0, -9.81), planes=()) for _ in range(2))
    for sim in (well, ill):
        rest = 0.0 * sim.state.u.numpy()
        u = rest.copy()
        u[[0, 2]] = [1.0, 0.0, 0.0]
        sim.set(u=u, vk=rest, spin=rest, C=np.zeros((*rest.shape, 3), np.float32))
    ill.scratch.turns.counts.slowest = 1e-6
    assert well.run().failures == [0, 0, 0] and ill.run().failures == [0, FAILURE_CFL, 0]
    assert ill.sums_are_clear
    for name in ("x", "u", "F"):
        for env in (0, 2):
            np.testing.assert_allclose(ill.get(name, env), well.get(name, env), atol=1e-6, err_msg=name)

"""LaunchGraphs whose launches go beside each other."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import warp as wp

from piavatar_envs.core.launch_graph import LaunchGraph


@wp.kernel
def double(values: wp.array(dtype=int), turns: int):
    """A long way to twice as much and one more, to be still on it when others come too early."""
    i = wp.tid()
    value = values[i]
    for _ in range(turns):
        value = value ^ 1
    values[i] = 2 * value + 1


@wp.kernel
def add_up(a: wp.array(dtype=int), b: wp.array(dtype=int), c: wp.array(dtype=int), total: wp.array(dtype=int)):
    i = wp.tid()
    total[i] += a[i] + b[i] + c[i]


class Forked:
    """Three arrays, each doubled twice in a branch of its own, and the sum of all, twice in a row."""

    def __init__(self, device: str, condition: wp.array | None = None) -> None:
        self.a, self.b, self.c = (wp.array(np.full(64, n), dtype=int, device=device) for n in (1, 10, 100))
        self.total = wp.zeros(64, dtype=int, device=device)
        self.graph = LaunchGraph(device, condition)
        for _ in range(2):
            self.graph.parallel(*map(self.branch, (self.a, self.c, self.b), (100_000, 100_000, 0)))
            self.graph.launch(add_up, 64, [self.a, self.b, self.c], [self.total], block_dim=32)

    def branch(self, values: wp.array, turns: int) -> LaunchGraph:
        branch = LaunchGraph(values.device)
        for _ in range(2):
            branch.launch(double, 64, [values, turns], block_dim=32)
        return branch


@pytest.mark.parametrize("run", ["run", "run_eager"])
def test_what_follows_a_fork_waits_for_its_branches(device, run):
    forked = Forked(device)
    assert forked.graph.names == 2 * (6 * ["double"] + ["add_up"])
    getattr(forked.graph, run)()
    after = [4 * n + 3 for n in (1, 10, 100)]
    again = [4 * n + 3 for n in after]
    np.testing.assert_array_equal(forked.total.numpy(), np.full(64, sum(after) + sum(again)))


@pytest.mark.parametrize("holds", [0, 1])
def test_a_fork_of_a_program_with_a_condition(device, holds):
    condition = wp.array([holds], dtype=int, device=device)
    forked = Forked(device, condition)
    forked.graph.run()
    assert (forked.total.numpy()[0] > 0) == (forked.c.numpy()[0] > 100) == bool(holds)


def test_a_fork_waits_for_the_one_before(device):
    """Though nothing is launched between them; the branches of the second begin where those of the first had ended."""
    graph, forked = LaunchGraph(device), Forked(device)
    graph.parallel(forked.branch(forked.a, 0), forked.branch(forked.b, 100_000))
    graph.parallel(forked.branch(forked.b, 0), forked.branch(forked.a, 0))
    graph.run()
    assert [(launch.fork, launch.branch) for launch in graph._launches] == [
        (fork, branch) for fork in (1, 2) for branch in (0, 0, 1, 1)
    ]
    np.testing.assert_array_equal(forked.a.numpy(), np.full(64, 16 + 15))
    np.testing.assert_array_equal(forked.b.numpy(), np.full(64, 160 + 15))


def test_a_branch_without_launches_is_no_fork(device):
    graph, one, none = LaunchGraph(device), LaunchGraph(device), LaunchGraph(device)
    values = wp.zeros(4, dtype=int, device=device)
    one.launch(double, 4, [values, 0], block_dim=32)
    graph.parallel(none, one)
    graph.parallel(one, none)
    graph.parallel(none, LaunchGraph(device))
    graph.launch(double, 4, [values, 0], block_dim=32)
    graph.run()
    np.testing.assert_array_equal(values.numpy(), [7, 7, 7, 7])


def test_forks_are_refused(device):
    forked = Forked(device)
    conditional = LaunchGraph(device, condition=wp.zeros(1, dtype=int, device=device))
    for branches in ((forked.graph, LaunchGraph(device)), (LaunchGraph(device), conditional)):
        graph = LaunchGraph(device)
        with pytest.raises(ValueError, match="a fork or a condition"):
            graph.parallel(*branches)
        assert len(graph) == 0
    graph, branch = LaunchGraph(device), LaunchGraph(device)
    for branches in ((branch, branch), (graph, branch)):
        with pytest.raises(ValueError, match="give different ones"):
            graph.parallel(*branches)
    forked.graph.run()
    with pytest.raises(RuntimeError, match="build a new one"):
        forked.graph.parallel(LaunchGraph(device), LaunchGraph(device))


@pytest.mark.parametrize(
    "compiles",
    [
        "from piavatar_envs.doctor import compile_kernels; compile_kernels(DEVICE)",
        "from piavatar_envs.mpm import graph, blocks; p = graph.LaunchGraph(DEVICE); "
        "p.launch(blocks.reset_active_blocks, 1, [None], []); p.compile()",
    ],
)
def test_a_device_is_acquired_before_threads_compile_for_it(device, compiles):
    """Else each of them would, at once, and some processes would end in a segmentation fault."""
    if "cuda" not in device:
        pytest.skip("nothing has to be acquired of a CPU")
    begin = f"""
import warp as wp

DEVICE = {device!r}

def compiled(*args, **options):
    print("acquired" if wp.get_device(DEVICE).has_context else "not yet")
    raise SystemExit

wp.load_module = wp.force_load = compiled
assert not wp.get_device(DEVICE).has_context
"""
    done = subprocess.run([sys.executable, "-c", begin + compiles], capture_output=True, text=True, timeout=600)
    assert done.stdout.splitlines()[-1:] == ["acquired"], done.stdout + done.stderr

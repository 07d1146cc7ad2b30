"""Launch graphs: parallel branches, conditions, compilation."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from piavatar_envs.core.kernel_cache import KernelCacheError
from piavatar_envs.core.launch_graph import LaunchGraph, compile_graphs
from tests.gpu_on_cpu import NAME as GPU_ON_CPU


@wp.kernel
def double(values: wp.array(dtype=int), delay: int):
    """Compute ``2 value + 1`` slowly, so that launches that do not wait overtake it."""
    i = wp.tid()
    value = values[i]
    for _ in range(delay):
        value = value ^ 1
    values[i] = 2 * value + 1


@wp.kernel
def add_up(a: wp.array(dtype=int), b: wp.array(dtype=int), c: wp.array(dtype=int), total: wp.array(dtype=int)):
    i = wp.tid()
    total[i] += a[i] + b[i] + c[i]


class Branched:
    """Three arrays, each doubled twice in a branch of its own, and the sum of all, twice in a row."""

    def __init__(self, device: str, condition: wp.array | None = None) -> None:
        self.a, self.b, self.c = (wp.array(np.full(64, n), dtype=int, device=device) for n in (1, 10, 100))
        self.total = wp.zeros(64, dtype=int, device=device)
        self.graph = LaunchGraph(device, condition)
        for _ in range(2):
            self.graph.parallel(*map(self.branch, (self.a, self.c, self.b), (100_000, 100_000, 0)))
            self.graph.launch(add_up, 64, [self.a, self.b, self.c], [self.total], block_dim=32)

    def branch(self, values: wp.array, delay: int) -> LaunchGraph:
        branch = LaunchGraph(values.device)
        for _ in range(2):
            branch.launch(double, 64, [values, delay], block_dim=32)
        return branch


@pytest.mark.parametrize("run", ["run", "run_eager"])
def test_later_launches_wait_for_branches(device, run):
    branched = Branched(device)
    assert branched.graph.names == 2 * (6 * ["double"] + ["add_up"])
    getattr(branched.graph, run)()
    after = [4 * n + 3 for n in (1, 10, 100)]
    again = [4 * n + 3 for n in after]
    np.testing.assert_array_equal(branched.total.numpy(), np.full(64, sum(after) + sum(again)))


@pytest.mark.parametrize("holds", [0, 1])
def test_branches_of_a_graph_with_a_condition(device, holds):
    condition = wp.array([holds], dtype=int, device=device)
    branched = Branched(device, condition)
    branched.graph.run()
    assert (branched.total.numpy()[0] > 0) == (branched.c.numpy()[0] > 100) == bool(holds)


def test_a_section_waits_for_the_one_before(device):
    # Though nothing is launched between them; the branches of the second begin where those of the first had ended.
    graph, branched = LaunchGraph(device), Branched(device)
    graph.parallel(branched.branch(branched.a, 0), branched.branch(branched.b, 100_000))
    graph.parallel(branched.branch(branched.b, 0), branched.branch(branched.a, 0))
    graph.run()
    np.testing.assert_array_equal(branched.a.numpy(), np.full(64, 16 + 15))
    np.testing.assert_array_equal(branched.b.numpy(), np.full(64, 160 + 15))


def test_bad_branches_are_refused(device):
    branched = Branched(device)
    conditional = LaunchGraph(device, condition=wp.zeros(1, dtype=int, device=device))
    for branches in ((branched.graph, LaunchGraph(device)), (LaunchGraph(device), conditional)):
        graph = LaunchGraph(device)
        with pytest.raises(ValueError, match="branches or a condition"):
            graph.parallel(*branches)
        assert len(graph) == 0
    graph, branch = LaunchGraph(device), LaunchGraph(device)
    for branches in ((branch, branch), (graph, branch)):
        with pytest.raises(ValueError, match="give different ones"):
            graph.parallel(*branches)
    branched.graph.run()
    with pytest.raises(RuntimeError, match="build a new one"):
        branched.graph.parallel(LaunchGraph(device), LaunchGraph(device))


@wp.kernel
def count_runs(runs: wp.array(dtype=int)):
    runs[wp.tid()] += 1


@wp.kernel
def reset(condition: wp.array(dtype=int)):
    condition[0] = 0


def test_a_condition_skips_the_graph(device):
    # The condition is read once, before the first launch: the graph itself may change it.
    if wp.get_device(device).is_cuda and device != GPU_ON_CPU and not wp.is_conditional_graph_supported():
        pytest.skip("graphs of this CUDA have no branches")
    condition, runs = wp.zeros(1, dtype=int, device=device), wp.zeros(3, dtype=int, device=device)
    graph = LaunchGraph(device, condition)
    graph.launch(reset, 1, [], [condition])
    graph.launch(count_runs, 3, [], [runs])
    for holds, expected in ((0, 0), (1, 1), (0, 1), (2, 2), (0, 2)):
        condition.assign(np.array([holds], np.int32))
        graph.run()
        assert runs.numpy().tolist() == [expected] * 3
        graph.run()  # the graph has reset it
        assert runs.numpy().tolist() == [expected] * 3
    condition.assign(np.array([1], np.int32))
    graph.run_eager()
    assert runs.numpy().tolist() == [3] * 3 and condition.numpy()[0] == 0


def test_a_launch_with_wrong_arguments_is_refused_before_anything_runs(device):
    runs, graph = wp.zeros(3, dtype=int, device=device), LaunchGraph(device)
    graph.launch(count_runs, 3, [], [runs])
    graph.launch(count_runs, 3, [runs, 1.0])
    with pytest.raises(RuntimeError, match="count_runs"):
        graph.run()
    assert runs.numpy().tolist() == [0] * 3


@pytest.mark.parametrize("shape, dtype", [((2,), int), ((1,), float), ((1, 1), int)])
def test_bad_conditions(device, shape, dtype):
    with pytest.raises(ValueError, match=r"use \(1,\) int32"):
        LaunchGraph(device, wp.zeros(shape, dtype=dtype, device=device))


@wp.kernel(module="unique")
def write_index(out: wp.array(dtype=int)):
    out[wp.tid()] = wp.tid()


def written_by_its_own_module() -> list[int]:
    """Compile or load a kernel of a module of its own, and return what it writes."""
    write_index.module.unload()
    out = wp.zeros(3, dtype=int, device="cpu")
    graph = LaunchGraph("cpu")
    graph.launch(write_index, 3, [], [out])
    compile_graphs([graph])
    graph.run()
    return out.numpy().tolist()


@pytest.mark.parametrize("content", [b"", b"damaged"])
def test_damaged_objects_of_the_cache_are_compiled_anew(empty_kernel_cache, content):
    assert written_by_its_own_module() == [0, 1, 2]
    for suffix in (".o", ".meta"):
        [path] = empty_kernel_cache.rglob(f"*{suffix}")
        path.write_bytes(content)
        assert written_by_its_own_module() == [0, 1, 2]
        assert path.read_bytes() != content


def test_a_cache_that_cannot_be_written_is_named_with_the_remedy(empty_kernel_cache):
    empty_kernel_cache.touch()  # a file in the folder's place
    with pytest.raises(KernelCacheError, match=r"kernel_cache .*WARP_CACHE_PATH") as caught:
        written_by_its_own_module()
    assert "\n" not in str(caught.value)
    write_index.module.unload()


@pytest.mark.parametrize("run", ["run", "run_eager"])
@pytest.mark.parametrize("holds", [None, 0, 1])
def test_sort_is_stable_and_looks_at_the_low_bits(device, run, holds):
    condition = None if holds is None else wp.array([holds], dtype=int, device=device)
    given = np.random.default_rng(0).integers(0, 2**32, 3000, dtype=np.uint32)
    keys = wp.array(np.concatenate([given, 0 * given]), dtype=wp.uint32, device=device)
    values = wp.array(np.concatenate([np.arange(3000), np.zeros(3000)]), dtype=int, device=device)
    graph = LaunchGraph(device, condition)
    graph.launch(double, 64, [wp.zeros(64, dtype=int, device=device), 0], block_dim=32)
    graph.sort_pairs(keys, values, 3000, 8)
    assert graph.names == ["double", "sort_pairs"]
    getattr(graph, run)()
    order = np.arange(3000) if holds == 0 else np.argsort(given & 255, kind="stable")
    np.testing.assert_array_equal(values.numpy()[:3000], order)


def test_sorts_of_wrong_arrays_are_refused(device):
    graph, keys = LaunchGraph(device), wp.zeros(8, dtype=wp.uint32, device=device)
    for count, values in ((5, wp.zeros(10, dtype=int, device=device)), (4, wp.zeros(8, dtype=float, device=device))):
        with pytest.raises(ValueError, match="of shape"):
            graph.sort_pairs(keys, values, count, 8)

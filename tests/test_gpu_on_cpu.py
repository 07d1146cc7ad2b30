"""Emulated GPU threads exchange values as the CUDA programming guide specifies."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from tests.gpu_on_cpu import gpu_on_cpu, on_cpu

wp.set_module_options({"enable_backward": False, "default_grid_stride": False})

BLOCK = 96


def on_gpu(cuda: str) -> str:
    """Return a CUDA snippet that returns -1 on a CPU."""
    return f"#if defined(__CUDA_ARCH__)\n{cuda}\n#else\nreturn -1;\n#endif\n"


@wp.func_native(
    on_gpu("""
int sum = value;
for (int distance = 16; distance > 0; distance >>= 1) sum += __shfl_xor_sync(0xffffffffu, sum, distance);
__shared__ int warps[3];
if ((threadIdx.x & 31) == 0) warps[threadIdx.x >> 5] = sum;
__syncthreads();
return warps[0] + warps[1] + warps[2] + 1000 * (int)blockIdx.x;
""")
)
def sum_of_block(value: int) -> int:
    """Return the block's sum plus a thousand times its index."""
    ...


@wp.func_native(on_gpu("return (int)__ballot_sync(0xffffffffu, value > 0);"))
def positive_lanes(value: int) -> int:
    """Return a mask of lanes."""
    ...


@wp.func_native(
    on_gpu("""
if (value > 0)
    return (int)__activemask();
else
    return (int)__activemask();
""")
)
def active_lanes(value: int) -> int:
    """Return a mask of the lanes in the same branch."""
    ...


@wp.func_native(on_gpu("return (int)__match_any_sync(0xffffffffu, value);"))
def lanes_with_equal_values(value: int) -> int:
    """Return a mask of lanes."""
    ...


@wp.func_native(on_gpu("return __reduce_max_sync(0xffffffffu, value) - __shfl_sync(0xffffffffu, value, 7);"))
def greatest_over_the_seventh(value: int) -> int:
    """Return the warp's greatest value less that of its seventh lane."""
    ...


@wp.kernel
def evaluate(value: wp.array(dtype=int), question: int, answer: wp.array(dtype=int)):
    t = wp.tid()
    if t >= value.shape[0]:
        return
    if question == 0:
        answer[t] = sum_of_block(value[t])
    elif question == 1:
        answer[t] = positive_lanes(value[t])
    elif question == 2:
        answer[t] = active_lanes(value[t])
    elif question == 3:
        answer[t] = lanes_with_equal_values(value[t])
    else:
        answer[t] = greatest_over_the_seventh(value[t])


@pytest.fixture(scope="module")
def answers():
    """Evaluate a question for each value; surplus threads of the last block end early."""

    def evaluate_all(question: int, values: np.ndarray) -> np.ndarray:
        value = wp.array(values, dtype=int, device="cpu")
        answer = wp.zeros(len(values), dtype=int, device="cpu")
        threads = -(-len(values) // BLOCK) * BLOCK
        wp.launch(evaluate, threads, [value, question], [answer], device="cpu", block_dim=BLOCK)
        return answer.numpy()

    with gpu_on_cpu():
        yield evaluate_all


def test_the_cpu_is_itself_before_and_after():
    """The same kernel returns -1 on a plain CPU; contexts may be nested."""
    value, found = wp.ones(4, dtype=int, device="cpu"), []
    for inside in (False, True, False):
        answer = wp.zeros(4, dtype=int, device="cpu")
        if inside:
            with gpu_on_cpu() as name, gpu_on_cpu():
                wp.launch(evaluate, BLOCK, [value, 1], [answer], device=name, block_dim=BLOCK)
        else:
            wp.launch(evaluate, 4, [value, 1], [answer], device="cpu")
        found.append(answer.numpy().tolist())
    assert found == [[-1] * 4, [0b1111] * 4, [-1] * 4]


def bits(yes: np.ndarray) -> np.ndarray:
    """Return the ballot of every warp, for each of its threads."""
    whole = np.zeros(-(-len(yes) // 32) * 32, bool)
    whole[: len(yes)] = yes
    masks = (whole.reshape(-1, 32) * (1 << np.arange(32, dtype=np.uint64))).sum(1)
    return np.repeat(masks, 32)[: len(yes)].astype(np.uint32).view(np.int32)


def equal_lanes(values: np.ndarray) -> np.ndarray:
    expected = np.zeros(len(values), np.int32)
    for value in np.unique(values):
        expected[values == value] = bits(values == value)[values == value]
    return expected


#: Intrinsics, and what they return by the programming guide.
EXPECTED = {
    1: lambda values: bits(values > 0),
    2: lambda values: np.where(values > 0, bits(values > 0), bits(values <= 0)),
    3: equal_lanes,
    4: lambda values: [values[t // 32 * 32 :][:32].max() - values[t // 32 * 32 + 7] for t in range(len(values))],
}


@pytest.mark.parametrize("count", [BLOCK, 2 * BLOCK, BLOCK + 50])
@pytest.mark.parametrize("question", EXPECTED)
def test_lanes_of_a_warp_exchange_values(answers, question, count):
    values = np.random.default_rng(count).integers(-3, 4, count).astype(np.int32)
    np.testing.assert_array_equal(answers(question, values), EXPECTED[question](values))


def test_shared_memory_and_shuffles(answers):
    values = np.arange(2 * BLOCK, dtype=np.int32) % 7
    sums = values.reshape(2, BLOCK).sum(1) + [0, 1000]
    np.testing.assert_array_equal(answers(0, values), np.repeat(sums, BLOCK))


@wp.func_native(
    on_gpu("""
__shared__ int written;
if (threadIdx.x == 0) written = 7;
if (value > 0) __syncthreads();
const int seen = written;
__syncthreads();
if (threadIdx.x == 0) written = 0;
__syncthreads();
return seen;
""")
)
def written_by_the_first(value: int) -> int:
    """Return what the first thread has written; reliable only if all values are positive."""
    ...


@wp.kernel
def read_what_is_written(value: wp.array(dtype=int), answer: wp.array(dtype=int)):
    t = wp.tid()
    answer[t] = written_by_the_first(value[t])


@pytest.mark.parametrize("waits", [True, False])
def test_a_missing_barrier_shows(waits):
    """In one of two blocks the first thread does not run first."""
    value = wp.full(2 * BLOCK, 1 if waits else 0, dtype=int, device="cpu")
    answer = wp.zeros(2 * BLOCK, dtype=int, device="cpu")
    with gpu_on_cpu():
        wp.launch(read_what_is_written, 2 * BLOCK, [value], [answer], device="cpu", block_dim=BLOCK)
    assert (answer.numpy() == 7).all() == waits


def test_single_threads_would_be_a_cpus(answers):
    with pytest.raises(RuntimeError, match="block_dim=1"):
        wp.launch(evaluate, 4, [wp.ones(4, dtype=int, device="cpu"), 1], device="cpu", block_dim=1)


def test_unknown_modules_are_refused():
    with pytest.raises(RuntimeError, match="format unknown"):
        on_cpu("void nothing() {}")
    source = '#include "deterministic.h"\n'
    for way, arguments in (("forward", "payload->args"), ("backward", "payload->args, payload->adj_args")):
        source += "    const size_t task_index = payload->block_first + (size_t)lane;\n"
        source += f"    k_cpu_kernel_{way}<false>(*dim, task_index, {arguments});\n"
    assert on_cpu(source).count("gpu::begin(lane") == on_cpu(source).count("gpu::end()") == 2
    with pytest.raises(RuntimeError, match=r"asm.*replacement"):
        on_cpu(source + 'asm volatile("brkpt;");\n')

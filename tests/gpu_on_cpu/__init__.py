"""What the package has for a GPU, on a CPU: for tests of what comes out, not of how fast.

Its kernels for a GPU ask for shared memory, and for what the threads of a warp or of a CUDA block tell each other. Warp
can run the threads of a block on a CPU, as fibers that take turns (``wp.config.enable_cpu_blocks``); ``threads.h`` has
the rest. Inside :func:`gpu_on_cpu` the package takes the CPU for a GPU, and such kernels are compiled with the CUDA in
them. That does not find what only real threads do: races, and what a GPU rounds in another way.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import warp as wp
from warp._src import build, context

#: By which Warp knows the CPU that the package takes for a GPU.
NAME = "gpu_on_cpu"
#: Threads of a CUDA block, if a launch says nothing else.
THREADS = 256
_HEADER = Path(__file__).with_name("threads.h")

#: Where Warp's modules for a CPU include its own headers, begin and end a thread.
_INCLUDES = '#include "deterministic.h"\n'
_BEGIN = "    const size_t task_index = payload->block_first + (size_t)lane;\n"
_RUN = r"(    \w+_cpu_kernel_forward<false>\(\*dim, task_index, payload->args\);\n)"
#: What a snippet has as its shared memory.
_ROOM = "extern __shared__ int piavatar_room[];"
#: Instructions in PTX, and what they do.
_PTX = (
    (
        r'asm\("mad\.wide\.s32 %0, %1, %2, %3;"\s*: "=l"\((.*?)\) : "r"\((.*)\), "r"\((.*?)\), "l"\((.*?)\)\);',
        r"\1 = \4 + (size_t)((long long)(\2) * (\3));",
    ),
    (
        r'asm volatile\("red\.global\.add\.s32 \[%0\], %1;"\s*:: "l"\((.*?)\), "r"\((.*)\) : "memory"\);',
        r"*(wp::int32*)\1 += \2;",
    ),
    (
        r'asm volatile\("red\.global\.add\.f32 \[%0\], %1;"\s*:: "l"\((.*?)\), "f"\((.*)\) : "memory"\);',
        r"*(wp::float32*)\1 += \2;",
    ),
    (
        r'asm volatile\("cp\.async\.ca\.shared\.global \[%0\], \[%1\], 4;"\s*'
        r':: "r"\((.*?)\), "l"\((.*?)\) : "memory"\);',
        r"*(wp::int32*)((char*)gpu::room + \1) = *\2;",
    ),
    (r'asm volatile\("cp\.async\.wait_all;" ::: "memory"\);', ""),
    (r'asm volatile\("" : "\+r"\(t\)\);', ""),
)


def on_cpu(source: str) -> str:
    """A module that Warp has generated for blocks on a CPU, with the CUDA of its snippets instead of what is beside it.

    Raises:
        RuntimeError: it is not as this version of Warp writes it, or has instructions in PTX that are not known here.
    """
    source = source.replace(_INCLUDES, f'{_INCLUDES}#include "{_HEADER}"\n', 1)
    source = source.replace("__CUDA_ARCH__", "GPU_ARCH").replace(_ROOM, "int* const piavatar_room = gpu::room;")
    for pattern, replacement in _PTX:
        source = re.sub(pattern, replacement, source)
    left = "dim->size - payload->block_first"
    count = f"{left} < gpu::THREADS ? (int)({left}) : gpu::THREADS"
    begin = f"{_BEGIN}    gpu::begin(lane, {count}, payload->block_first / gpu::THREADS);\n"
    threads = source.count(_BEGIN)
    source, ended = re.subn(_RUN, r"\1    gpu::end(lane);\n", source.replace(_BEGIN, begin))
    if _HEADER.name not in source or threads != ended or threads == 0:
        raise RuntimeError(f"Warp {wp.__version__} writes modules for a CPU in another way than {__file__} knows")
    if unknown := re.search(r"\basm\b.*", source):
        raise RuntimeError(f"{unknown.group()}: tell {__file__} what this does")
    return source


class EmulatedGpu(str):
    """A name of the CPU that says it were an H200."""

    is_cuda, is_cpu, arch, sm_count, max_shared_memory_per_block = True, False, 90, 132, 227 * 1024
    free_memory = 2**37
    alias = name = NAME


@contextmanager
def gpu_on_cpu() -> Iterator[str]:
    """Let the package build and run on the CPU what it has for a GPU; gives the name of the device.

    What is built inside belongs to it. One process has one.
    """
    wp.init()
    context.runtime.device_map[NAME] = context.runtime.device_map["cpu"]
    get_device, compile_cpu, blocks = wp.get_device, build.build_cpu, wp.config.enable_cpu_blocks
    resolve = context._resolve_launch_block_dim

    def seen_device(name: Any = None) -> Any:
        own = sys._getframe(1).f_globals["__name__"].startswith(("piavatar_envs.", "tests."))
        return EmulatedGpu(NAME) if own else get_device(name)

    def threads_of_block(device: Any, block_dim: int | None) -> int:
        return resolve(device, THREADS if block_dim is None else block_dim)

    def build_cpu(obj_path: str, cpp_path: str, *args: Any, **kwargs: Any) -> Any:
        path = Path(cpp_path)
        if "_cpu_block_payload_forward" in (source := path.read_text()):
            path.write_text(on_cpu(source))
        return compile_cpu(obj_path, cpp_path, *args, **kwargs)

    wp.get_device, build.build_cpu, wp.config.enable_cpu_blocks = seen_device, build_cpu, True
    context._resolve_launch_block_dim = threads_of_block
    try:
        yield NAME
    finally:
        wp.get_device, build.build_cpu, wp.config.enable_cpu_blocks = get_device, compile_cpu, blocks
        context._resolve_launch_block_dim = resolve
        del context.runtime.device_map[NAME]

"""GPU kernels emulated on a CPU, to test their results, not their speed.

The package's GPU kernels use shared memory and exchanges within a warp or a CUDA block. Warp can run the threads of a
block on a CPU as fibers (``wp.config.enable_cpu_blocks``); ``threads.h`` has the rest. Inside :func:`gpu_on_cpu` the
package treats the CPU as a GPU, and its kernels are compiled with their CUDA snippets. The emulation reveals results
that depend on the order of threads, shared memory that is read before it is written or written beyond its end, and
deadlocks. It does not reveal races of truly concurrent threads, nor differences in rounding.
"""

from __future__ import annotations

import hashlib
import re
import shutil
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from threading import Lock
from typing import Any

import warp as wp
from warp._src import build, context

#: Warp device name of the emulated GPU.
NAME = "gpu_on_cpu"
#: Threads of a CUDA block unless a launch sets them.
THREADS = 256
#: Of the compiler: kernels take longer to compile than to run here.
OPTIMIZATION = 1
_HEADER = Path(__file__).with_name("threads.h")

#: Lines in Warp's generated CPU modules: its headers, the begin and the end of a thread.
_INCLUDES = '#include "deterministic.h"\n'
_BEGIN = "    const size_t task_index = payload->block_first + (size_t)lane;\n"
_RUN = r"(    \w+_cpu_kernel_(?:for|back)ward<false>\(\*dim, task_index, payload->args(?:, payload->adj_args)?\);\n)"
#: Declaration of shared memory in a snippet, and the words that a kernel reserves.
_ARENA = "extern __shared__ int piavatar_arena[];"
_RESERVED = r"tile_alloc_empty<wp::int32,wp::tile_shape_t<(\d+)>"
#: PTX instructions and their replacements.
_PTX = (
    (
        r'asm\("mad\.wide\.s32 %0, %1, %2, %3;"\s*: "=l"\((.*?)\) : "r"\((.*)\), "r"\((.*?)\), "l"\((.*?)\)\);',
        r"\1 = \4 + (size_t)((long long)(\2) * (\3));",
    ),
    (
        r'asm\("mul\.wide\.s32 %0, %1, %2;"\s*: "=l"\((.*?)\) : "r"\((.*?)\), "r"\((.*?)\)\);',
        r"\1 = (long long)(\2) * (\3);",
    ),
    (
        r'asm volatile\("red\.global\.add\.u64 \[%0\], %1;"\s*:: "l"\((.*?)\), "l"\((.*)\) : "memory"\);',
        r"*(wp::int64*)(\1) += \2;",
    ),
    (
        r'asm volatile\("cp\.async\.ca\.shared\.global \[%0\], \[%1\], 4;"\s*'
        r':: "r"\((.*?)\), "l"\((.*?)\) : "memory"\);',
        r"*(wp::int32*)((char*)gpu::arena + \1) = *(const wp::int32*)(\2);",
    ),
    (r'asm volatile\("cp\.async\.wait_all;" ::: "memory"\);', ""),
    (r'asm volatile\("" : "\+[rf]"\(.*?\)\);', ""),
    (r'asm volatile\("prefetch\.global\.L2 \[%0\];" :: "l"\(line\)\);', ";"),
)


def on_cpu(source: str) -> str:
    """Return a module that Warp has generated for blocks on a CPU, with the CUDA branches of its snippets.

    Raises:
        RuntimeError: its format is not that of the known Warp version, or it has unknown PTX instructions.
    """
    words = max((int(words) for words in re.findall(_RESERVED, source)), default=0)
    source = source.replace(_INCLUDES, f'{_INCLUDES}#define GPU_ARENA_WORDS {words}\n#include "{_HEADER}"\n', 1)
    source = source.replace("__CUDA_ARCH__", "GPU_ARCH").replace(_ARENA, "int* const piavatar_arena = gpu::arena;")
    for pattern, replacement in _PTX:
        source = re.sub(pattern, replacement, source)
    begin = """\
    gpu::begin(lane, dim->size, payload->block_first);
    const size_t task_index = payload->block_first + (size_t)gpu::own();
"""
    threads = source.count(_BEGIN)
    source, ended = re.subn(_RUN, r"\1    gpu::end();\n", source.replace(_BEGIN, begin))
    if _HEADER.name not in source or threads != ended or threads == 0:
        raise RuntimeError(f"Warp {wp.__version__} generates CPU modules in a format unknown to {__file__}")
    if unknown := re.search(r"\basm\b.*", source):
        raise RuntimeError(f"{unknown.group()}: add its replacement to {__file__}")
    return source


class Stream:
    """A stream whose launches run at once."""

    def wait_stream(self, other: Any) -> None:
        """Nothing to do."""


class EmulatedGpu(str):
    """A device name with the properties of an H200."""

    is_cuda, is_cpu, arch, sm_count, max_shared_memory_per_block = True, False, 90, 132, 227 * 1024
    free_memory = 2**37
    alias = name = NAME
    stream = Stream()


def _own_cache() -> Path:
    """Return a kernel cache apart from that of plain CPU kernels and of other versions of the emulation."""
    known = hashlib.sha256(_HEADER.read_bytes() + Path(__file__).read_bytes()).hexdigest()[:8]
    return Path(wp.config.kernel_cache_dir) / f"{NAME}_{known}"


@contextmanager
def _compiled_once(path: Path, folder: Path) -> Iterator[bool]:
    """Hold a lock on a module; yields whether ``path`` must be compiled, else it is a copy of another process's object.

    Objects are kept in ``folder``.

    Without file locks (Windows) every process compiles.
    """
    try:
        import fcntl
    except ImportError:
        yield True
        return
    kept = folder / path.name
    folder.mkdir(parents=True, exist_ok=True)
    with kept.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if kept.exists():
            shutil.copy(kept, path)
            yield False
        else:
            yield True
            shutil.copy(path, kept.with_suffix(".new"))
            kept.with_suffix(".new").replace(kept)


@contextmanager
def gpu_on_cpu() -> Iterator[str]:
    """Build and run GPU kernels on the CPU; yields the name of the device.

    Worlds that are built inside must not be used outside. Nested contexts have no effect.
    """
    wp.init()
    if NAME in context.runtime.device_map:
        yield NAME
        return
    resolve = context._resolve_launch_block_dim

    def seen_device(name: Any = None) -> Any:
        own = sys._getframe(1).f_globals["__name__"].startswith(("piavatar_envs.", "tests."))
        return EmulatedGpu(NAME) if own else get_device(name)

    def threads_of_block(device: Any, block_dim: int | None) -> int:
        threads = resolve(device, THREADS if block_dim is None else block_dim)
        if threads == 1:
            raise RuntimeError("block_dim=1 would run the CPU branches of snippets; use 2 threads or more")
        return threads

    compiled: set[int] = set()
    first_of_its_size = Lock()

    def build_cpu(obj_path: str, cpp_path: str, *args: Any, **kwargs: Any) -> None:
        path, size = Path(cpp_path), kwargs["block_dim"]
        path.write_text(on_cpu(path.read_text()))
        with _compiled_once(Path(obj_path), objects) as missing:
            if missing:
                # threads share precompiled headers, one set for each size of a block
                with nullcontext() if size in compiled else first_of_its_size:
                    compile_cpu(obj_path, cpp_path, *args, **{**kwargs, "pch_dir": headers.name})
                compiled.add(size)

    def stream(device: Any, **kwargs: Any) -> Any:
        return Stream() if device == NAME else make_stream(device, **kwargs)

    def on_stream(stream: Any, **kwargs: Any) -> Any:
        return scoped_stream(None if isinstance(stream, Stream) else stream, **kwargs)

    headers, objects = tempfile.TemporaryDirectory(prefix="headers_"), _own_cache() / "objects"
    get_device, compile_cpu, blocks = wp.get_device, build.build_cpu, wp.config.enable_cpu_blocks
    make_stream, scoped_stream = wp.Stream, wp.ScopedStream
    caches = wp.config.kernel_cache_dir, build._resolved_kernel_cache_dir
    level, wp.config.optimization_level = wp.config.optimization_level, OPTIMIZATION
    build.init_kernel_cache(str(_own_cache()))
    context.runtime.device_map[NAME] = context.runtime.device_map["cpu"]
    wp.get_device, build.build_cpu, wp.config.enable_cpu_blocks = seen_device, build_cpu, True
    wp.Stream, wp.ScopedStream = stream, on_stream
    context._resolve_launch_block_dim = threads_of_block
    try:
        yield NAME
    finally:
        wp.config.optimization_level = level
        wp.get_device, build.build_cpu, wp.config.enable_cpu_blocks = get_device, compile_cpu, blocks
        wp.Stream, wp.ScopedStream = make_stream, scoped_stream
        context._resolve_launch_block_dim = resolve
        del context.runtime.device_map[NAME]
        wp.config.kernel_cache_dir, build._resolved_kernel_cache_dir = caches

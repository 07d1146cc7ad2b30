"""Report on this machine: devices, versions, kernel cache, extras, and the memory of an environment."""

from __future__ import annotations

import importlib
import importlib.metadata
import importlib.util
import json
import pkgutil
import platform
import time
from pathlib import Path
from types import ModuleType
from typing import Any

import gymnasium

from piavatar_envs.core.extras import EXTRAS, install_command
from piavatar_envs.core.launch_graph import compiling_threads
from piavatar_envs.tasks import NAMESPACE

PACKAGES = ("piavatar-envs", "warp-lang", "numpy", "scipy", "gymnasium", "pydantic", "stable-baselines3", "torch")


def examine() -> dict[str, Any]:
    """Collect the report, as plain values fit for JSON."""
    return {
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: version for name in PACKAGES if (version := package_version(name))},
        "devices": devices(),
        "kernel_cache": kernel_cache(),
        "extras": {name: [m for m in modules if not _found(m)] for name, modules in EXTRAS.items()},
        "default_env": memory_estimate(),
    }


def package_version(name: str) -> str | None:
    """Return the version of an installed distribution, or None."""
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None


def devices() -> list[dict[str, Any]]:
    """List Warp's devices: alias, name, kind, and of a GPU memory [GiB] and architecture."""
    wp = quiet_warp()
    found = []
    for device in wp.get_devices():
        entry: dict[str, Any] = {"alias": device.alias, "kind": "cuda" if device.is_cuda else "cpu"}
        entry["name"] = device.name if device.is_cuda else cpu_model()
        if device.is_cuda:
            entry |= {"arch": f"sm_{device.arch}", "memory_gib": round(device.total_memory / 2**30, 1)}
            entry["free_gib"] = round(device.free_memory / 2**30, 1)
        found.append(entry)
    return found


def cpu_model() -> str:
    """Return the CPU's model name, where the system reports it."""
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def kernel_cache() -> dict[str, Any]:
    """Return path, bytes and number of modules of the kernel cache."""
    wp = quiet_warp()
    root = Path(wp.config.kernel_cache_dir)
    sizes = [file.stat().st_size for file in root.rglob("*") if file.is_file()] if root.is_dir() else []
    modules = sum(1 for folder in root.iterdir() if folder.is_dir()) if root.is_dir() else 0
    return {"path": str(root), "bytes": sum(sizes), "modules": modules}


def memory_estimate() -> dict[str, Any]:
    """Return particles, grid nodes, substeps per step and bytes of one environment with default settings.

    Besides, the vertices of a skirt and the bytes that an environment has more with one.
    """
    from piavatar_envs.cloth.garments import cut_garment
    from piavatar_envs.cloth.mesh import ClothMesh
    from piavatar_envs.cloth.wearer import Wearer
    from piavatar_envs.config import EnvConfig
    from piavatar_envs.mpm.bspline import BLOCK_NODES
    from piavatar_envs.mpm.memory import estimate_bytes
    from piavatar_envs.sim.garments import bytes_of_garments
    from piavatar_envs.sim.world import Simulation

    simulation = Simulation(EnvConfig(), num_envs=1, device="cpu")
    model, flesh = simulation.model, simulation.flesh
    cut = cut_garment("skirt", Wearer.of(flesh[0].asset, flesh[0].base_parameters), {})
    skirt = ClothMesh.build(cut.faces, cut.measure)
    nodes = int(BLOCK_NODES) * model.max_active_blocks
    size = {"particles": model.num_particles, "nodes": nodes, "substeps": model.num_substeps}
    return {
        **size,
        "bytes": estimate_bytes(1, model.num_particles, model.max_active_blocks, num_blocks=model.num_blocks),
        "skirt_vertices": skirt.num_vertices,
        "skirt_bytes": bytes_of_garments([skirt], flesh, ()),
    }


def find_device(device: str) -> str:
    """Return the name of a Warp device; Warp prints nothing.

    Raises:
        ValueError: there is no such device.
    """
    quiet_warp()
    from piavatar_envs.sim.world import check_device

    return check_device(device)


def compile_kernels(device: str, *, environments: bool = True) -> float:
    """Compile all kernels for ``device``; returns the seconds it took.

    Args:
        device: a Warp device.
        environments: also step each environment once, because some kernels are generated for their sizes.

    Raises:
        KernelCacheError: Warp's cache cannot be written.
        ValueError: Warp has no such device.
    """
    wp = quiet_warp()
    from piavatar_envs import ENTRY_POINT
    from piavatar_envs.core.kernel_cache import unusable
    from piavatar_envs.core.launch_graph import acquire

    target = wp.get_device(find_device(device))
    start = time.perf_counter()
    folders = ("core", "mpm", "avatar", "sim", "envs", "tasks", "render") + (("multi",) if _found("pettingzoo") else ())
    for folder in folders:
        package = importlib.import_module(f"piavatar_envs.{folder}")
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            importlib.import_module(module.name)
    acquire(target)
    try:
        wp.force_load(target, max_workers=compiling_threads())
    except OSError as error:
        raise unusable(error) from error
    for env_id, spec in sorted(gymnasium.registry.items()):
        if environments and spec.namespace == NAMESPACE and spec.entry_point == ENTRY_POINT:
            env = gymnasium.make(env_id, device=device, fidelity="tiny")
            env.reset(seed=0)
            env.step(env.action_space.sample())
            env.close()
    return time.perf_counter() - start


def show(report: dict[str, Any], *, as_json: bool = False) -> None:
    """Print a report, as a table for people or as JSON."""
    if as_json:
        print(json.dumps(report, indent=2))
        return
    rows: list[tuple[str, str]] = []  # whole lines, so that commands can be copied
    rows.append(("python", f"{report['python']}, {report['platform']}"))
    rows.append(("packages", ", ".join(f"{name} {version}" for name, version in report["packages"].items())))
    for entry in report["devices"]:
        memory = f", {entry['free_gib']} of {entry['memory_gib']} GiB free, {entry['arch']}" if "arch" in entry else ""
        rows.append((f"device {entry['alias']}", f"{entry['name']}{memory}"))
    cache = report["kernel_cache"]
    rows.append(("kernel cache", f"{cache['path']}: {cache['modules']} modules, {cache['bytes'] / 2**20:.1f} MiB"))
    for name, missing in report["extras"].items():
        remedy = install_command(name)
        rows.append((f"extra {name}", f"missing {', '.join(missing)}: {remedy}" if missing else "present"))
    size = report["default_env"]
    shape = f"{size['particles']} particles, {size['nodes']} grid nodes, {size['substeps']} substeps per step"
    rows.append(("default env", f"{shape}: {size['bytes'] / 2**20:.1f} MiB each"))
    skirt = f"{size['skirt_vertices']} vertices: {size['skirt_bytes'] / 2**20:.1f} MiB more in an environment"
    rows.append(("with a skirt", skirt))
    if "compile" in report:
        rows.append(("compiled", f"for {report['compile']['device']} in {report['compile']['seconds']} s"))
    width = max(len(name) for name, _ in rows)
    for name, text in rows:
        print(f"{name:{width}}  {text}")


def quiet_warp() -> ModuleType:
    """Return Warp, initialised without its banner."""
    import warp as wp

    from piavatar_envs.core.kernel_cache import init_warp

    init_warp()
    return wp


def _found(module: str) -> bool:
    return importlib.util.find_spec(module) is not None

"""Pictures that agents observe: drawn for all environments at the end of a recorded step."""

from __future__ import annotations

import warp as wp

from piavatar_envs.config import PixelsConfig, PlacedCamera
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.episodes import EpisodeArrays
from piavatar_envs.envs.task import Task
from piavatar_envs.render.cameras import BatchCamera
from piavatar_envs.render.painter import Painter
from piavatar_envs.render.scene import Camera
from piavatar_envs.render.stage import Stage, bytes_of_stage

wp.set_module_options({"enable_backward": False})

#: Height of the bodies that tasks place their cameras for, at most [m].
SHOWN_HEIGHT = 1.8
#: Memory of a pixel: its bytes, colour and inverse depth; of its depth, as drawn and as observed; and of the share and
#: the colour of what splats are blended beside [bytes].
BYTES_OF_PIXEL, BYTES_OF_DEPTH, BYTES_BESIDE = 3 + 12 + 4, 4 + 4, 4 + 16


class PixelObserver:
    """Draws what agents observe under ``obs_mode="pixels"`` and ``"pixels+state"``.

    A picture is a function of the state alone: cameras do not glide, and nothing is kept from one step to the next.

    Attributes:
        stage: the surfaces of all environments.
        painters: one a camera.
        arrays: by name, an array for each agent: ``"pixels"`` ``(num_envs, height, width, 3)`` uint8, ``"depth"``
            ``(num_envs, height, width, 1)`` float32 [m], ``"segmentation"`` ``(num_envs, height, width, 1)`` uint8.
            Agents that see through the same camera share them.
    """

    def __init__(
        self, env: EpisodeArrays, task: Task, settings: PixelsConfig | None = None, count: int | None = None
    ) -> None:
        """Build the surfaces, and allocate the pictures.

        Args:
            env: the environments.
            task: the task of these environments.
            settings: of the pictures; the task's if not given.
            count: number of environments that are shown, the first ones; all if not given.

        Raises:
            ConfigError: the task has markers that only the host can draw.
            ValueError: the pictures do not fit into the memory of a GPU.
        """
        task.check_pixels()
        self._env, self._task = env, task
        settings, device, count = settings or task.config.pixels, env.device, count or env.num_envs
        of_each_agent = settings.camera.kind not in ("task", "placed")
        cameras, markers = env.num_agents if of_each_agent else 1, task.marker_specs()
        splats = any(flesh.asset.drawn.splats is not None for flesh in env.simulation.flesh)
        own, stage = bytes_of_pixels(settings, cameras, splats), bytes_of_stage(env.simulation, markers)
        check_memory(count, own, stage, settings, device)
        self.stage = Stage(env.simulation, markers, range(count))
        size = settings.height, settings.width
        self._eyes: list[tuple[BatchCamera, Painter]] = []
        for agent in range(cameras):
            painter = Painter(
                self.stage.surfaces,
                count,
                *size,
                device,
                depth=settings.depth,
                segmentation=settings.segmentation,
                vertices=self.stage.vertices,
            )
            painter.layers += self.stage.layers(*size)
            out = painter.views, painter.centers
            self._eyes.append((_camera_of(settings, task, env, self.stage, agent, out), painter))
        self._all = wp.full(count, True, dtype=wp.bool, device=device)
        shape = (count, *size, 1)
        self._farthest, self.painters = settings.farthest, [painter for _, painter in self._eyes]
        painters = self.painters
        views = {"pixels": [painter.picture for painter in painters]}
        if settings.depth:
            views["depth"] = [wp.zeros(shape, dtype=float, device=device) for _ in painters]
        if settings.segmentation:
            views["segmentation"] = [painter.labels.reshape(shape) for painter in painters]
        self._views = views
        agents = range(env.num_agents)
        self.arrays = {name: [own[agent % len(own)] for agent in agents] for name, own in views.items()}

    def record(self, graph: LaunchGraph, mask: wp.array | None = None) -> None:
        """Record the launches that draw the present state.

        Args:
            graph: records.
            mask: environments whose pictures change, ``(num_envs,)`` bool; all if not given.
        """
        chosen = self._all if mask is None else mask
        self._task.record_markers(self._env, graph, self.stage.markers)
        self.stage.record(graph, chosen)
        for camera, painter in self._eyes:
            camera.record(graph)
            graph.launch(choose, len(painter.drawn), [chosen], [painter.drawn])
            painter.record(graph)
        for (_, painter), depth in zip(self._eyes, self._views.get("depth", ()), strict=False):
            graph.launch(cut_depth, depth.shape[:3], [painter.depth, self._farthest], [depth])


def bytes_of_pixels(settings: PixelsConfig, num_cameras: int, has_splats: bool = False) -> int:
    """Return the memory of the pixels of an environment [bytes].

    Args:
        settings: of the pictures.
        num_cameras: of each environment.
        has_splats: whether an avatar is drawn as splats.
    """
    pixel = BYTES_OF_PIXEL + BYTES_OF_DEPTH * settings.depth + settings.segmentation + BYTES_BESIDE * has_splats
    return num_cameras * settings.width * settings.height * pixel


def check_memory(num_envs: int, of_pixels: int, of_stage: int, settings: PixelsConfig, device: str) -> None:
    """Check that the pictures of a batch fit into memory, but for workspaces, which do not grow with it.

    Args:
        num_envs: number of environments.
        of_pixels: memory of the pixels of each [bytes].
        of_stage: memory of the surfaces and splats of each [bytes].
        settings: of the pictures.
        device: Warp device.

    Raises:
        ValueError: they exceed the free memory of a CUDA device.
    """
    target = wp.get_device(device)
    if not target.is_cuda:
        return
    each, free = of_pixels + of_stage, target.free_memory
    if num_envs * each > free:
        fewer = f"use num_envs <= {free // each}, or " if free >= each else "use "
        raise ValueError(
            f"pictures of {settings.width} x {settings.height} pixels of {num_envs} environments need "
            f"{num_envs * each / 2**30:.1f} GiB, {of_stage / each:.0%} of it for surfaces and splats; {target} has "
            f"{free / 2**30:.1f} GiB free; {fewer}less of pixels.width and pixels.height"
        )


def _camera_of(
    settings: PixelsConfig, task: Task, env: EpisodeArrays, stage: Stage, agent: int, out: tuple[wp.array, wp.array]
) -> BatchCamera:
    """Return the camera that an agent sees through.

    Args:
        settings: of the pictures.
        task: the task, whose camera is ``"task"``.
        env: the environments.
        stage: what is seen, one picture per environment.
        agent: index of the agent.
        out: arrays of views and centers that the camera writes.
    """
    chosen, camera, follows = settings.camera, settings.camera.kind, True
    angle = settings.field_of_view
    if isinstance(chosen, PlacedCamera):
        camera, follows = Camera(chosen.position, chosen.target, angle or Camera().field_of_view), chosen.follows
    elif chosen.kind == "task":
        aspect, follows = settings.width / settings.height, task.camera_follows
        camera = task_camera(env, task, aspect, angle)
    size = settings.width, settings.height
    return BatchCamera(
        env.simulation, camera, *size, stage.envs, follows=follows, agent=agent, field_of_view=angle, out=out
    )


def task_camera(env: EpisodeArrays, task: Task, aspect: float, field_of_view: float | None = None) -> Camera:
    """Return the task's camera, farther from bodies taller than :data:`SHOWN_HEIGHT` unless settings place it.

    Args:
        env: the environments.
        task: the task of these environments.
        aspect: width over height of the pictures that it takes.
        field_of_view: vertical angle instead of the camera's own [deg].
    """
    render = task.config.render
    size = max(1.0, max(flesh.height for flesh in env.simulation.flesh) / SHOWN_HEIGHT)
    if render.camera_position is not None or render.camera_target is not None:
        size = 1.0
    position, target = (tuple(size * value for value in place) for place in task.place_camera(aspect))
    return Camera(position, target, field_of_view or Camera().field_of_view)


@wp.kernel
def choose(mask: wp.array(dtype=wp.bool), drawn: wp.array(dtype=wp.bool)):
    """Choose the pictures that change."""
    e = wp.tid()
    drawn[e] = mask[e]


@wp.kernel
def cut_depth(distance: wp.array3d(dtype=float), farthest: float, depth: wp.array4d(dtype=float)):
    """Cut depth off, and give the sky the greatest."""
    e, i, j = wp.tid()
    here = distance[e, i, j]
    depth[e, i, j, 0] = wp.where(here < farthest, wp.max(here, 0.0), farthest)

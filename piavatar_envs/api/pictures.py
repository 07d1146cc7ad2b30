"""Pictures of the environments of a batch: scene descriptions, frames, and the live view in a web browser.

The renderer is imported when the first picture is drawn, so that environments without pictures start quickly.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np

from piavatar_envs.avatar.body.skeleton import BODY_PARTS, JOINT_NAMES, body_part_of_joint
from piavatar_envs.avatar.skinning import unpack
from piavatar_envs.config import BodyColor, PixelsConfig, RenderConfig
from piavatar_envs.core.extras import missing
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.envs.batch_env import BatchEnv
from piavatar_envs.envs.task import Task
from piavatar_envs.sim.forces import Target

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

    from piavatar_envs.avatar.skin import Skin
    from piavatar_envs.avatar.types import Body as MovedBody
    from piavatar_envs.envs.pixels import PixelObserver
    from piavatar_envs.render import Arrow, Body, Marker, MovedSplats, Scene
    from piavatar_envs.render.live import Drag, LiveView
    from piavatar_envs.render.stage import Stage
    from piavatar_envs.sim.markers import MarkerSpec
    from piavatar_envs.sim.prop_surface import SolidSurface
    from piavatar_envs.sim.props import Prop

#: Render modes of one environment, and of a batch: a live view shows one.
RENDER_MODES = ("rgb_array", "human")
BATCH_RENDER_MODES = ("rgb_array",)
#: Least time between two scenes sent to a browser [s]: no screen shows more.
_LEAST_INTERVAL = 1.0 / 60.0


def check_render_mode(render_mode: str | None, modes: tuple[str, ...] = RENDER_MODES) -> str | None:
    """Return a render mode of one environment.

    Raises:
        ValueError: it is unknown.
    """
    if render_mode is not None and render_mode not in modes:
        known = f"{', '.join(['None', *modes[:-1]])} or {modes[-1]}"
        raise ValueError(f"render_mode={render_mode!r} is not known; use {known}")
    return render_mode


def check_extra(render_mode: str | None, color: str) -> None:
    """Refuse pictures whose text cannot be drawn, before anything is built; nothing heavy is imported.

    Raises:
        ImportError: ``render_mode="rgb_array"`` with a colour scale, and without Pillow (extra ``render``).
    """
    if render_mode == "rgb_array" and color != "skin" and find_spec("PIL") is None:
        raise missing(f"the scale of color={color!r}", "PIL", "render")


def check_batch_render_mode(render_mode: str | None) -> str | None:
    """Return a render mode of a batch of environments.

    Raises:
        ValueError: it is unknown, or the live view.
    """
    if render_mode == "human":
        raise ValueError(
            "render_mode='human' is a live view of one environment, and this is a batch; use rgb_array here, or "
            "watch one: gym.make(id, render_mode='human') or python -m piavatar_envs watch ID"
        )
    return check_render_mode(render_mode, BATCH_RENDER_MODES)


class SceneReader:
    """Reads scene descriptions from a batch: skins, props, colliders and the task's markers.

    Everything is computed on the device of the batch, and only what is shown leaves it.
    """

    def __init__(self, batch: BatchEnv) -> None:
        """Bake nothing yet; the first scene does."""
        self.batch = batch

    @cached_property
    def stage(self) -> Stage:
        """The surfaces of one environment."""
        from piavatar_envs.render.stage import Stage

        return Stage(self.batch.simulation, self._specs, envs=[0])

    @property
    def _specs(self) -> Sequence[MarkerSpec]:
        """Markers of the task that are drawn."""
        return self.batch.task.marker_specs() if self.batch.config.render.overlays else ()

    @cached_property
    def _graph(self) -> LaunchGraph:
        """The launches that write the vertices of the stage."""
        graph, task = LaunchGraph(self.batch.simulation.device), self.batch.task
        if self._specs:
            task.record_markers(self.batch, graph, self.stage.markers)
        self.stage.record(graph)
        return graph

    def scene(self, env: int, color: BodyColor = "skin") -> Scene:
        """Describe the scene of environment ``env`` now, the bodies in their own colours or coloured by a quantity."""
        from piavatar_envs.render import Body, Scene, Solid, Sphere

        simulation, task = self.batch.simulation, self.batch.task
        self.stage.select([env])
        self._graph.run()
        vertices = self.stage.vertices.numpy()[0].copy()
        bodies: list[Body] = []
        garments: list[Body] = []
        markers: list[Marker] = []
        for number, part in enumerate(self.stage.parts):
            own = vertices[part.vertices]
            if part.kind == "garment":
                garments.append(Body(own, part.faces, part.color, part.colors, textures=part.textures))
            elif part.kind in ("avatar", "prop"):
                splats = self._splats(len(bodies))
                body = Body(own, part.faces, part.color, part.colors, splats=splats, textures=part.textures)
                bodies.append(self._colored(body, env, len(bodies), color))
            elif np.isfinite(own[0, 0]):  # hidden ones are NaN
                markers.append(Solid(part.kind, own, part.faces, part.color, number - len(bodies)))
        if self.batch.config.render.overlays:
            markers += [Sphere(*m) if isinstance(m, tuple) else m for m in task.markers(self.batch, env)]
        roots = [avatar.tracked.position.numpy()[env, 0] for avatar in simulation.avatars]
        follow = np.mean(roots, axis=0) if task.camera_follows else None
        return Scene([*bodies, *garments], markers, follow)

    def _splats(self, index: int) -> MovedSplats | None:
        """Return the splats of a body, if it is drawn as such."""
        splats = self.stage.splats
        return None if splats is None or index not in splats.bound else splats.moved(0, index)

    def _colored(self, body: Body, env: int, index: int, color: BodyColor) -> Body:
        """Return a body, and its splats, coloured by a quantity, unless it keeps its own colours."""
        from piavatar_envs.render.coloring import color_by
        from piavatar_envs.render.quantities import QUANTITIES, of_particles

        simulation, avatars = self.batch.simulation, len(self.stage.skins)
        if color == "skin" or (color == "impulse" and index >= avatars):
            return body
        if index < avatars:
            matter: MovedBody | Prop = simulation.avatars[index].body
            surface: Skin | SolidSurface = self.stage.skins[index]
        else:
            matter, surface = simulation.props.props[index - avatars], self.stage.solids[index - avatars]
        own, scale = slice(matter.first, matter.first + matter.count), QUANTITIES[color]
        values, splats = of_particles(simulation, env, own, color), body.splats
        if splats is not None and self.stage.splats is not None:
            of_splats = self.stage.splats.bound[index].skin.interpolate(values)
            splats = replace(splats, colors=color_by(of_splats, scale.maximum))
        scalars = surface.interpolate(values)
        return replace(body, scalars=scalars, scalar_max=scale.maximum, scalar_label=scale.label, splats=splats)


class Progress:
    """Simulated time of an environment between two pictures."""

    def __init__(self, batch: BatchEnv, env: int) -> None:
        """Start without a picture."""
        self._batch, self._env = batch, env
        self._last: tuple[int, ...] | None = None

    def since_last(self) -> float | None:
        """Return the simulated time since the last call [s]; None at first, and if time has jumped since.

        Time jumps where another episode has begun, and where a state was restored.
        """
        batch = self._batch
        counters = (batch.seed, batch.episode, batch.step_count)
        now = (batch.restarts, *(int(array.numpy()[self._env]) for array in counters))
        before, self._last = self._last, now
        if before is None or now[:3] != before[:3] or now[3] < before[3]:
            return None
        return (now[3] - before[3]) * batch.config.physics.control_dt


class Picture:
    """Draws environments of a batch with one renderer."""

    def __init__(self, batch: BatchEnv, config: RenderConfig, scenes: SceneReader | None = None) -> None:
        """Open the renderer.

        Args:
            batch: holds the environments.
            config: size and colours.
            scenes: reads them, if pictures share one.
        """
        from piavatar_envs.envs.pixels import task_camera
        from piavatar_envs.render import Renderer

        self.config = config
        camera = task_camera(batch, batch.task, config.width / config.height)
        self.renderer = Renderer(config.width, config.height, camera, scale=config.overlays)
        self._scenes = scenes or SceneReader(batch)

    def cut(self) -> None:
        """Let the camera jump to the next scene instead of gliding there."""
        self.renderer.reset_camera()

    def frame(self, env: int, elapsed: float) -> np.ndarray:
        """Draw the scene of environment ``env``, ``(height, width, 3)`` uint8, a time [s] after the last picture."""
        scene = self._scenes.scene(env, self.config.color)
        return self.renderer.render(scene.bodies, scene.markers, follow=scene.follow, elapsed=elapsed)

    def close(self) -> None:
        """Close the renderer."""
        self.renderer.close()


class Pictures:
    """Pictures of any environments, each with a camera of its own, opened when it is first drawn."""

    def __init__(self, place: Callable[[int], tuple[BatchEnv, int]], config: RenderConfig) -> None:
        """Open nothing yet.

        Args:
            place: returns the batch that holds an environment, and its index there.
            config: size and colours.
        """
        self._place, self._config = place, config
        self._opened: dict[int, Picture] = {}
        self._scenes: dict[int, SceneReader] = {}  # by batch
        self._progress: dict[int, Progress] = {}
        self._observers: dict[int, tuple[LaunchGraph, PixelObserver]] = {}  # by batch

    def frame(self, env: int) -> np.ndarray:
        """Draw the scene of environment ``env``, ``(height, width, 3)`` uint8.

        Raises:
            ImportError: pictures have text, and Pillow is not installed (extra ``render``).
        """
        batch, own = self._place(env)
        if env not in self._opened:
            scenes = self._scenes.setdefault(id(batch), SceneReader(batch))
            self._opened[env], self._progress[env] = Picture(batch, self._config, scenes), Progress(batch, own)
        elapsed = self._progress[env].since_last()
        if elapsed is None:
            self._opened[env].cut()
        return self._opened[env].frame(own, elapsed or 0.0)

    def mosaic(self, count: int) -> np.ndarray:
        """Draw the first ``count`` environments side by side, in rows as near to a square as can be; the rest is black.

        They are drawn together on their device, by cameras that do not glide, unless the settings ask for what only
        the host draws.

        Raises:
            ImportError: the extra ``render`` is not installed.
        """
        task = self._place(0)[0].task
        plain = self._config.color == "skin" and self._config.overlays and type(task).markers is Task.markers
        frames = np.stack(self._together(count) if plain else [self.frame(env) for env in range(count)])
        columns = math.ceil(math.sqrt(count))
        rows = math.ceil(count / columns)
        height, width = frames.shape[1:3]
        tiles = np.zeros((rows * columns, *frames.shape[1:]), np.uint8)
        tiles[:count] = frames
        grid = tiles.reshape(rows, columns, height, width, 3).swapaxes(1, 2)
        return grid.reshape(rows * height, columns * width, 3)

    def _together(self, count: int) -> list[np.ndarray]:
        """Draw the first ``count`` environments, all of a batch at once."""
        from piavatar_envs.envs.pixels import PixelObserver

        frames: list[np.ndarray] = []
        while len(frames) < count:
            batch, _ = self._place(len(frames))
            if id(batch) not in self._observers:
                size = PixelsConfig.model_construct(width=self._config.width, height=self._config.height)
                shown = min(batch.num_envs, count - len(frames))
                graph, observer = LaunchGraph(batch.device), PixelObserver(batch, batch.task, size, shown)
                observer.record(graph)
                self._observers[id(batch)] = graph, observer
            graph, observer = self._observers[id(batch)]
            graph.run()
            frames += list(observer.arrays["pixels"][0].numpy())
        return frames

    def close(self) -> None:
        """Close all renderers."""
        for picture in self._opened.values():
            picture.close()
        self._opened.clear()
        self._scenes.clear()
        self._observers.clear()


class Pace:
    """Holds a loop back to a given time a turn; a slower loop is not delayed."""

    def __init__(self, clock: Callable[[], float] = time.perf_counter, sleep: Callable[[float], None] = time.sleep):
        """Begin the first turn.

        Args:
            clock: returns the time [s].
            sleep: waits for a time [s].
        """
        self.clock, self._sleep = clock, sleep
        self.begin()

    def begin(self) -> None:
        """Begin a turn now."""
        self._began = self.clock()

    def wait(self, seconds: float) -> None:
        """Sleep for the rest of a turn of that length, and begin the next one."""
        due, now = self._began + seconds, self.clock()
        if due <= now:
            self._began = now
            return
        self._sleep(due - now)
        # from the due time, because a sleep ends late and the delays would add up
        self._began = due

    def rest(self, seconds: float) -> None:
        """Sleep, and begin a turn."""
        self._sleep(seconds)
        self.begin()


#: Rate of the spring between a dragged point and the mouse [1/s], and its greatest force over the dragged mass [m/s^2].
DRAG_RATE, MOST_DRAG = 10.0, 20.0


@dataclass(frozen=True, eq=False)
class Grip:
    """A bone or prop that a mouse has grabbed.

    Attributes:
        name, agent: of what is grabbed, as ``apply_force`` takes them.
        target: the same on the device.
        local: the grabbed point in the target's frame, shape ``(3,)`` [m].
        mass: what moves with it: the prop, the limb or, with a bone of the trunk, the body [kg].
        own_mass: the bone alone, or the prop [kg].
    """

    name: str
    agent: str | None
    target: Target
    local: np.ndarray
    mass: float
    own_mass: float

    def point(self, env: int) -> np.ndarray:
        """Return where the grabbed point of environment ``env`` is [m]."""
        at, turn = frame_of(self.target, env)
        return at + turn.apply(self.local)


def frame_of(target: Target, env: int) -> tuple[np.ndarray, Rotation]:
    """Return position and rotation of a target's frame in environment ``env``."""
    from scipy.spatial.transform import Rotation

    frame = target.frame
    position, rotation = (array.numpy()[env, target.column].astype(float) for array in (frame.position, frame.rotation))
    return position, Rotation.from_quat(rotation)


def grip_at(batch: BatchEnv, env: int, drag: Drag) -> Grip | None:
    """Return the bone or prop at the point where a drag began; None of a garment that is worn by none."""
    simulation = batch.simulation
    avatars, props = simulation.avatars, simulation.props
    worn = drag.body - len(avatars) - len(props.props)
    if worn >= 0 and simulation.garments is not None:
        wearer = simulation.garments.garments[worn].wearer
        if wearer < 0:
            return None
        drag = replace(drag, body=wearer)
    mass = simulation.model.particles.mass.numpy()
    mass = mass[min(env, len(mass) - 1)].astype(float)
    if drag.body >= len(avatars):
        name, agent = props.names[drag.body - len(avatars)], None
        target, prop = simulation.receivers.find(name), props.props[drag.body - len(avatars)]
        whole = own = mass[prop.first : prop.first + prop.count].sum()
    else:
        body = avatars[drag.body].body
        particles = slice(body.first, body.first + body.count)
        bones, weights = unpack(body.skin)
        main = bones[np.arange(len(bones)), weights.argmax(axis=1)]
        bone = main[np.linalg.norm(simulation.state.x.numpy()[env, particles] - drag.start, axis=1).argmin()]
        name, agent = JOINT_NAMES[bone], batch.task.agent_names[drag.body]
        target, part = simulation.receivers.find(name, drag.body), body_part_of_joint()
        moves = np.ones(len(main), bool) if name in BODY_PARTS["torso"] else part[main] == part[bone]
        whole, own = mass[particles][moves].sum(), mass[particles][main == bone].sum()
    at, turn = frame_of(target, env)
    return Grip(name, agent, target, turn.inv().apply(drag.start - at), float(whole), float(own))


class MouseForce:
    """Spring that pulls a grabbed point of a bone or prop to a mouse.

    Its stiffness is that of the mass that moves, at natural frequency :data:`DRAG_RATE`. Its damper is critical for the
    grabbed bone alone, because the force is constant during a control step, in which a stronger one would turn a light
    limb around.

    Attributes:
        force: in the last control step [N], shape ``(3,)``.
    """

    def __init__(self, batch: BatchEnv, env: int, push: Callable[..., None], number: int | None = None) -> None:
        """Drag nothing yet.

        Args:
            batch: holds the environment.
            env: its index.
            push: ``apply_force`` of a view of the environments.
            number: index of the environment there; ``env`` if not given.
        """
        self._batch, self._env, self._push = batch, env, push
        self._number = env if number is None else number
        self.force = np.zeros(3)
        self._drag: Drag | None = None
        self._grip: Grip | None = None
        self._before: np.ndarray | None = None  # the grabbed point before the last control step [m]

    def apply(self, drag: Drag) -> None:
        """Let the force of a drag act in the next control step."""
        self.force = np.zeros(3)
        if self._drag is None or drag.start is not self._drag.start:
            self._grip = grip_at(self._batch, self._env, drag)
            self.settle()
        self._drag, grip = drag, self._grip
        if grip is None:
            return
        point = grip.point(self._env)
        before = point if self._before is None else self._before
        velocity = (point - before) / self._batch.config.physics.control_dt
        self._before = point
        force = grip.mass * DRAG_RATE**2 * (drag.end - point) - 2.0 * grip.own_mass * DRAG_RATE * velocity
        force *= min(1.0, MOST_DRAG * grip.mass / max(float(np.linalg.norm(force)), 1e-9))
        self.force = force
        self._push(grip.name, force, point, agent=grip.agent, envs=[self._number])

    def settle(self) -> None:
        """Take what is grabbed to be at rest, because it was placed."""
        self._before = None

    def arrow(self) -> Arrow | None:
        """Return an arrow from the grabbed point to the mouse, if something is dragged."""
        from piavatar_envs.render import Arrow

        if self._grip is None or self._drag is None:
            return None
        point = self._grip.point(self._env)
        return Arrow(point, self._drag.end - point)


class Live:
    """Shows an environment in a web browser while it is simulated, at most in real time.

    The server starts with the first scene.

    Attributes:
        color: of the bodies, ``"skin"`` or a quantity; may be changed at any time.
        pace: holds the steps back.
    """

    def __init__(
        self,
        batch: BatchEnv,
        push: Callable[..., None],
        color: BodyColor = "skin",
        port: int | None = None,
        env: int = 0,
        pace: Pace | None = None,
    ) -> None:
        """Open nothing yet.

        Args:
            batch: holds the environment.
            push: ``apply_force`` of a view of it, by which the mouse pulls.
            color: of the bodies.
            port: of this machine, or the next one that is free.
            env: index of the environment in the batch.
            pace: holds the steps back to real time; by the computer's clock if not given.

        Raises:
            ImportError: the extra ``live`` is not installed.
        """
        from piavatar_envs.render.live import PORT, import_viser

        import_viser()  # so that a missing library is reported before the first reset
        self.color, self.pace = color, pace or Pace()
        self._port = PORT if port is None else port
        self._view: LiveView | None = None
        self._shown, self._behind = 0.0, False
        self.select(batch, push, env)

    def select(self, batch: BatchEnv, push: Callable[..., None], env: int = 0, number: int | None = None) -> None:
        """Show another environment from the next scene on.

        Args:
            batch: holds the environment.
            push: ``apply_force`` of a view of it, by which mice pull.
            env: index of the environment in the batch.
            number: its index in ``push``; ``env`` if not given.
        """
        self._batch, self._env, self._push = batch, env, push
        self._number = env if number is None else number
        self._progress, self._scenes = Progress(batch, env), SceneReader(batch)
        self._mice: dict[int, MouseForce] = {}

    @property
    def view(self) -> LiveView:
        """The view; the first use opens it.

        Raises:
            ValueError: a port out of range.
        """
        if self._view is None:
            from piavatar_envs.envs.pixels import task_camera
            from piavatar_envs.render.live import LiveView

            # a browser's window is hardly narrower than high
            self._view = LiveView(task_camera(self._batch, self._batch.task, 1.0), self._port)
        return self._view

    def begin(self) -> None:
        """Show the scene after a reset, and begin a control step now."""
        for mouse in self._mice.values():
            mouse.settle()
        self.show()
        self.pace.begin()

    def before_step(self) -> None:
        """Let mice pull at what they drag, in the control step that follows."""
        drags = {} if self._view is None else dict(self._view.drags)
        self._mice = {number: mouse for number, mouse in self._mice.items() if number in drags}
        for number, drag in drags.items():
            if number not in self._mice:
                self._mice[number] = MouseForce(self._batch, self._env, self._push, self._number)
            self._mice[number].apply(drag)

    @property
    def pull(self) -> float:
        """Sum of the magnitudes of the impulses of all mice in the last control step [N s]."""
        dt = self._batch.config.physics.control_dt
        return dt * sum(float(np.linalg.norm(mouse.force)) for mouse in self._mice.values())

    def scene(self) -> Scene:
        """Describe the present scene, with an arrow for every mouse that drags."""
        scene = self._scenes.scene(self._env, self.color)
        arrows = [arrow for mouse in self._mice.values() if (arrow := mouse.arrow())]
        return replace(scene, markers=[*scene.markers, *arrows]) if arrows else scene

    def step(self, speed: float = 1.0) -> None:
        """Show the scene after a control step, and wait for the rest of its time.

        Args:
            speed: greatest ratio of simulated to real time.
        """
        self._behind = True
        if self._view is not None and self.pace.clock() - self._shown >= _LEAST_INTERVAL:
            self.show()
        self.pace.wait(self._batch.config.physics.control_dt / speed)

    def catch_up(self) -> None:
        """Show the last step, if it followed the one before too soon to be sent."""
        if self._behind and self._view is not None:
            self.show()

    def show(self) -> None:
        """Show the present scene."""
        self._shown, self._behind = self.pace.clock(), False
        self.view.show(self.scene(), self._progress.since_last())

    def close(self) -> None:
        """Stop the server, if it was started; closing twice is fine."""
        if self._view is not None:
            self._view.close()
            self._view = None

"""The interface of a task: its settings, its scene, and the launches that reset, judge and observe it.

A task records kernel launches into the graphs of the :class:`~piavatar_envs.envs.batch_env.BatchEnv`. Every launch
covers all environments, and nothing that a task does leaves the device.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from keyword import iskeyword
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import joint_limits
from piavatar_envs.config import AvatarConfig, ConfigError, EnvConfig, SceneConfig, replace
from piavatar_envs.config.schema import select_joints
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.framing import Sphere, around_avatar, around_prop, frame
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.envs.parameters import Drawn, component
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.episodes import EpisodeArrays
    from piavatar_envs.render.scene import Marker
    from piavatar_envs.sim.markers import Markers, MarkerSpec

#: Prefixes of the terms of reward and cost in ``info``; no metric's name can begin with one.
REWARD, COST = "reward_", "cost_"
#: Keys of every environment's ``info`` and of its views; no metric can have these names.
NAMES_OF_INFO = (
    "success", "failure", "limited_share", "root_force", "root_torque", "root_released", "cost",
    "final_info", "final_obs", "final_state", "episode", "is_success", "terminal_observation", "TimeLimit.truncated",
    "acted", "alive", "time_outs", "log",
)  # fmt: skip


@dataclass(frozen=True)
class Term:
    """A named part of the reward or of the cost.

    Attributes:
        name: its key in ``info`` is ``reward_<name>`` or ``cost_<name>``.
        description: its value, with the settings that shape it (Markdown, for the task's page).
    """

    name: str
    description: str = ""


@dataclass(frozen=True)
class Metric:
    """A number in ``info`` that is neither reward nor cost.

    Attributes:
        name: key in ``info``.
        unit: physical unit, ``"-"`` for none.
        description: one line.
    """

    name: str
    unit: str = "-"
    description: str = ""


@dataclass(frozen=True)
class TaskArray:
    """An array of a task, which becomes its attribute ``name``, of shape ``(num_envs, *shape)``.

    Attributes:
        name: of the attribute, and in a saved state.
        dtype: Warp type of an element.
        shape: sizes after the first; a name stands for the setting of that name.
        cleared: whether an episode begins with zeros.
        drawn: the meaning of its components where episodes draw them, for ``observe_parameters``.
    """

    name: str
    dtype: Any = float
    shape: tuple[int | str, ...] = ()
    cleared: bool = False
    drawn: tuple[Parameter, ...] = ()


class Columns(tuple):
    """Declared terms or metrics, whose attributes are their columns in the arrays that kernels write.

    A kernel writes ``outcome.metrics[e, agent, MyTask.metrics.distance]``; Warp compiles the attribute as a constant.
    """

    def __new__(cls, declared: Iterable[Term | Metric]) -> Columns:
        """Number the terms or metrics in their order."""
        self = super().__new__(cls, declared)
        vars(self).update({one.name: column for column, one in enumerate(self)})
        return self


class Task:
    """Base of all tasks.

    The page attributes are Markdown for the task's page in ``docs/envs``, which ``python -m scripts.env_pages`` writes.

    Class attributes:
        Config: class of the settings.
        description: one line for listings.
        observation_terms: terms that the task adds to the observation.
        rewards: terms of the reward, which is their sum; become :class:`Columns`, as costs and metrics do.
        costs: terms of ``info["cost"]``, for constrained learning; not part of the reward.
        metrics: other numbers in ``info``.
        state_arrays: arrays that a saved state holds.
        scratch_arrays: arrays that every step computes anew.
        observes_contact: whether agents observe the impulses of other bodies on their body parts.
        observes_others: whether agents observe each other.
        targets_about_reference: whether, under ``control="pd"``, targets are counted from the reference pose; else from
            the rest pose.
        camera_direction: from the scene to the camera of pictures, which is as near as it can be to hold :meth:`shown`.
        camera_follows: whether the camera goes with the agents' middle.
        camera_position, camera_target: the eye and the point that it looks at [m], from the ground below the agents'
            middle, or from the origin if the camera does not follow; None where :meth:`place_camera` computes them for
            the shape of a picture, unless a task or the settings give them.
        reward_names, cost_names, metric_names: names of the terms and metrics; derived.

    Page attributes:
        summary: a paragraph: the situation, and what a good agent does.
        success_doc: the condition of ``info["success"]``.
        termination_doc: conditions that terminate an episode, besides a released root and a failure; may be empty.
        history: versions and what each changed, the newest first.
        picture_seconds: moment of the picture [s].
        picture_actions: how the avatars act until then: ``"zero"``, ``"random"`` or constant actions by component name.
        picture_settings: settings of the picture other than the defaults.

    Attributes:
        config: the settings.
        joints: names of the joints that act.
        scene: avatars, props and colliders.
        motion_names: of the motions of which an episode draws one. Empty in most tasks; one that names some has, after
            :meth:`allocate`, the index of the drawn one as ``playing``, ``(num_envs,)`` int32, and the cumulative
            probabilities by which it is drawn as ``motion_shares``, ``(num_envs, motions)`` float32; a row that ends in
            zero is uniform.
    """

    Config: ClassVar[type[EnvConfig]] = EnvConfig
    description: ClassVar[str] = ""
    observation_terms: ClassVar[tuple[ObservationTerm, ...]] = ()
    rewards: ClassVar[tuple[Term, ...]] = Columns(())
    costs: ClassVar[tuple[Term, ...]] = Columns(())
    metrics: ClassVar[tuple[Metric, ...]] = Columns(())
    state_arrays: ClassVar[tuple[TaskArray, ...]] = ()
    scratch_arrays: ClassVar[tuple[TaskArray, ...]] = ()

    observes_contact: ClassVar[bool] = False
    observes_others: ClassVar[bool] = False
    targets_about_reference: ClassVar[bool] = False

    camera_direction: ClassVar[tuple[float, float, float]] = (1.75, -3.7, 0.76)
    camera_position: tuple[float, float, float] | None = None
    camera_target: tuple[float, float, float] | None = None
    camera_follows: bool = True
    motion_names: tuple[str, ...] = ()
    motion_shares: wp.array

    reward_names: ClassVar[tuple[str, ...]] = ()
    cost_names: ClassVar[tuple[str, ...]] = ()
    metric_names: ClassVar[tuple[str, ...]] = ()

    summary: ClassVar[str] = ""
    success_doc: ClassVar[str] = ""
    termination_doc: ClassVar[str] = ""
    history: ClassVar[tuple[tuple[str, str], ...]] = (("v0", "first version"),)
    picture_seconds: ClassVar[float] = 2.0
    picture_actions: ClassVar[str | Mapping[str, float]] = "random"
    picture_settings: ClassVar[Mapping[str, Any]] = {}

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Check the declarations and derive names and columns.

        Raises:
            ValueError: a declaration of another type, or a name that is not a name, is given twice or is taken.
        """
        super().__init_subclass__(**kwargs)
        cls.reward_names = cls._names("rewards", Term)
        cls.cost_names = cls._names("costs", Term)
        cls.metric_names = cls._names("metrics", Metric, NAMES_OF_INFO, "info has that key anyway")
        for name in cls.metric_names:
            if name.startswith((REWARD, COST)):
                raise ValueError(
                    f"{cls.__name__}.metrics has {name!r}, but info has terms of reward and cost under "
                    f"'{REWARD}' and '{COST}'; choose a name that begins otherwise"
                )
        cls.rewards, cls.costs, cls.metrics = Columns(cls.rewards), Columns(cls.costs), Columns(cls.metrics)
        taken = (*dir(cls), "config", "joints", "scene")
        state = cls._names("state_arrays", TaskArray, taken, "the task has that attribute")
        cls._names("scratch_arrays", TaskArray, (*taken, *state), "the task has that attribute or array")

    @classmethod
    def _names(cls, what: str, kind: type, taken: Sequence[str] = (), reason: str = "") -> tuple[str, ...]:
        """Return the names of what the attribute ``what`` declares.

        Raises:
            ValueError: see :meth:`__init_subclass__`.
        """
        declared, where = getattr(cls, what), f"{cls.__name__}.{what}"
        example = f"{what} = ({kind.__name__}({'...' if kind is TaskArray else chr(34) + 'near' + chr(34) + ', ...'}),)"
        if not isinstance(declared, tuple) or not all(isinstance(one, kind) for one in declared):
            raise ValueError(f"{where}={declared!r} is not a tuple of {kind.__name__}; write {example}")
        names = tuple(one.name for one in declared)
        for index, name in enumerate(names):
            if not isinstance(name, str) or not name.isidentifier() or name.startswith("_") or iskeyword(name):
                raise ValueError(
                    f"{where} has {name!r}; a name is an identifier that does not begin with an underscore"
                )
            if name in names[:index]:
                raise ValueError(f"{where} has {name!r} twice; rename one of them")
            if name in taken:
                raise ValueError(f"{where} has {name!r}, but {reason}; choose another name")
        return names

    def __init__(self, config: EnvConfig) -> None:
        """Build the scene.

        Raises:
            ConfigError: settings that do not fit the task.
        """
        self.config = config
        self.joints = select_joints(config.joints)
        self.scene = self.build_scene()
        for name in ("camera_position", "camera_target", "camera_follows"):
            chosen = getattr(config.render, name)
            if chosen is not None:
                setattr(self, name, chosen)
        self.place_camera(config.render.width / config.render.height)

    def place_camera(self, aspect: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Return :attr:`camera_position` and :attr:`camera_target`, or such that a picture shows everything.

        Args:
            aspect: width over height of the picture.

        Raises:
            ConfigError: the camera would look at its own place.
        """
        position, target = self.camera_position, self.camera_target
        if position is None or target is None:
            middle = (
                np.mean([avatar.position for avatar in self.scene.avatars], axis=0) if self.camera_follows else (0, 0)
            )
            spheres = [(x - middle[0], y - middle[1], z, radius) for x, y, z, radius in self.shown()]
            framed = frame(spheres, self.camera_direction, aspect)
            position, target = position or framed[0], target or framed[1]
        if np.allclose(position, target):
            raise ConfigError(
                f"render.camera_position={list(position)} is where it looks; move it or render.camera_target"
            )
        return position, target

    def build_scene(self) -> SceneConfig:
        """Return the configured scene with what the task adds to it.

        Raises:
            ConfigError: the configured scene does not fit the task.
        """
        scene = self.config.scene
        if len(scene.avatars) > 1:
            raise ConfigError(f"scene.avatars has {len(scene.avatars)} entries; this task has one avatar")
        return scene if scene.avatars else replace(scene, avatars=[AvatarConfig()])

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Names of the agents, one per avatar."""
        return tuple(f"agent_{index}" for index in range(len(self.scene.avatars)))

    def alone(self) -> Task:
        """Return the task itself, if it has one agent.

        Raises:
            ValueError: it has several.
        """
        if len(self.agent_names) != 1:
            name, count = type(self).__name__, len(self.agent_names)
            raise ValueError(
                f"{name} has {count} agents, and this is an environment of one; use "
                f"piavatar_envs.api.pettingzoo.AvatarParallelEnv({name})"
            )
        return self

    def terms(self) -> tuple[ObservationTerm, ...]:
        """Return the terms that the task adds to the observation under its settings."""
        return self.observation_terms

    def observed_props(self) -> tuple[str, ...]:
        """Return the names of the props that agents observe."""
        return tuple(prop.name for prop in self.scene.props)

    def prop_places(self) -> Mapping[str, Sequence[Sequence[float]]]:
        """Return, by name of a prop, corners of the region in which episodes may put its middle, each x, y, z [m].

        Covers props that :meth:`record_reset` places. An environment is refused when one would begin outside the
        domain; the places that the scene gives are checked anyway.
        """
        return {}

    def shown(self) -> list[Sphere]:
        """Return what pictures show from the first: places of an adult's avatars, props and marks, and their radii.

        A task with marks adds those to avatars and props; x, y, z and radius each [m].
        """
        places = self.prop_places()
        avatars = [sphere for avatar in self.scene.avatars for sphere in around_avatar(avatar)]
        return avatars + [s for prop in self.scene.props for s in around_prop(prop, places.get(prop.name, ()))]

    def drawn(self) -> tuple[Parameter, ...]:
        """Return the numbers that the task draws for each episode, for ``observe_parameters``.

        They include all that changes the episode except the first poses and places of bodies, which are observed
        anyway, and also numbers that the task's own terms contain. By default, those of the declared arrays.
        """
        return tuple(parameter for array in self._declared_arrays() for parameter in array.drawn)

    def drawn_values(self, env: EpisodeArrays) -> tuple[Drawn, ...]:
        """Return the arrays of these numbers, in the order of :meth:`drawn`; called once, after :meth:`allocate`."""
        return tuple(
            Drawn(values if len(array.drawn) == 1 else component(values, index))
            for array in self._declared_arrays()
            for values in [getattr(self, array.name)]
            for index in range(len(array.drawn))
        )

    def _declared_arrays(self) -> tuple[TaskArray, ...]:
        return (*self.state_arrays, *self.scratch_arrays)

    def action_spec(self) -> ActionSpec:
        """Return the joints that act, and whether the root does."""
        return ActionSpec(self.joints, joint_speed=self.config.control.joint_speed_limit)

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the joints' rotation vectors [rad], each ``(22, 3)``."""
        return joint_limits()

    def domain(self) -> Domain:
        """Return the box in which particles may move."""
        return Domain().around([avatar.position for avatar in self.scene.avatars])

    def impulses(self) -> dict[str, float]:
        """Return the greatest impulse that the task gives a bone at once [N s], by joint; it bounds the time step."""
        return {}

    def allocate_declared(self, env: EpisodeArrays) -> None:
        """Create the declared arrays as attributes."""
        for array in self._declared_arrays():
            sizes = [getattr(self.config, size) if isinstance(size, str) else size for size in array.shape]
            setattr(self, array.name, wp.zeros((env.num_envs, *sizes), dtype=array.dtype, device=env.device))

    def allocate(self, env: EpisodeArrays) -> None:
        """Create kernel constants, and arrays of other shapes than :class:`TaskArray` has; the declared ones exist."""

    def arrays(self) -> dict[str, wp.array]:
        """Return the arrays that a saved state holds, by name."""
        return {array.name: getattr(self, array.name) for array in self.state_arrays}

    def cleared_words(self) -> list[wp.array]:
        """Return the arrays declared ``cleared`` as 32-bit words, each ``(num_envs, words)``; they share the memory.

        Raises:
            ValueError: an array of another type, such as bool.
        """
        found: list[wp.array] = []
        for declared in self._declared_arrays():
            if declared.cleared:
                array = getattr(self, declared.name)
                size = wp.types.type_size_in_bytes(array.dtype)
                if size % 4:
                    raise ValueError(f"{declared.name} has elements of {size} byte; cleared takes multiples of 4")
                shape = array.shape[0], size // 4 * array.size // array.shape[0]
                found.append(wp.array(ptr=array.ptr, shape=shape, dtype=int, device=array.device))
        return found

    def record_reset(self, env: EpisodeArrays, graph: LaunchGraph) -> None:
        """Append: for environments of ``env.mask``, write the avatars' first commanded poses and draw the task.

        Props and colliders start where the scene says, unless this writes other places into
        ``env.simulation.props.initial`` (and ``.density``) or ``env.simulation.initial_colliders``. The setting
        ``top_speed`` in the scene bounds their speed, then and later; the time step is short enough for it.

        Raises:
            NotImplementedError: a task that does not define it.
        """
        raise NotImplementedError(f"{type(self).__name__} must define record_reset(env, graph)")

    def record_references(self, env: EpisodeArrays, graph: LaunchGraph) -> list[tuple[wp.array, wp.array]]:
        """Append launches that precede the physics; return the pose that actions are added to, of every avatar.

        A pose is its local rotations and its root; by default the pose commanded last.
        """
        states = [avatar.state for avatar in env.simulation.avatars]
        return [(state.command_rotation, state.command_root) for state in states]

    def record_outcome(self, env: EpisodeArrays, graph: LaunchGraph) -> None:
        """Append, after the physics: write reward and cost terms, metrics, success and termination of every agent.

        Raises:
            NotImplementedError: a task that does not define it.
        """
        raise NotImplementedError(f"{type(self).__name__} must define record_outcome(env, graph)")

    def record_observe(self, env: EpisodeArrays, graph: LaunchGraph, agent: int, start: int) -> None:
        """Append: write the task's observation terms from component ``start``. Must not change any state."""

    def marker_specs(self) -> Sequence[MarkerSpec]:
        """Return what pictures show besides matter, such as a target; where it moves, see :meth:`record_markers`."""
        return ()

    def record_markers(self, env: EpisodeArrays, graph: LaunchGraph, markers: Markers) -> None:
        """Append launches that write the rows of the declared markers from the present state, of all environments.

        Must not change any state. Columns are in the order of :meth:`marker_specs`; those that no launch writes stay
        where their specifications put them.
        """

    def markers(
        self, env: EpisodeArrays, index: int
    ) -> Sequence[tuple[np.ndarray, float, tuple[float, float, float]] | Marker]:
        """Return further marks for environment ``index``: spheres ``(position [m], radius [m], rgb)``, or markers.

        Markers are those of :mod:`piavatar_envs.render`. They are computed on the host, so that ``render()`` and the
        live view show them, and observed pixels cannot; see :meth:`check_pixels`.
        """
        return []

    def check_pixels(self) -> None:
        """Refuse pixels as observations of a task that describes marks on the host.

        Raises:
            ConfigError: it overrides :meth:`markers`.
        """
        if type(self).markers is not Task.markers:
            name = type(self).__name__
            raise ConfigError(
                f"{name}.markers describes marks on the host, which pixels that agents observe cannot show; declare "
                f"them in {name}.marker_specs and move them in record_markers, or use obs_mode='flat'"
            )

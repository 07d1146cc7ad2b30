"""What a task is: a configuration, where bodies start, what they shall do, what it is worth.

A task records kernel launches into the graphs of the :class:`~piavatar_envs.envs.batch_env.BatchEnv`; it never sees
single environments, and nothing it does leaves the device.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import warp as wp

from piavatar_envs.avatar.body.skeleton import joint_limits
from piavatar_envs.config import AvatarConfig, ConfigError, EnvConfig, SceneConfig, replace
from piavatar_envs.config.schema import select_joints
from piavatar_envs.envs.actions import ActionSpec
from piavatar_envs.envs.observations import ObservationTerm
from piavatar_envs.sim.randomize import Parameter
from piavatar_envs.sim.scene import Domain

if TYPE_CHECKING:
    from piavatar_envs.core.launch_graph import LaunchGraph
    from piavatar_envs.envs.episodes import EpisodeArrays
    from piavatar_envs.envs.parameters import Drawn
    from piavatar_envs.render.scene import Marker


#: What ``info`` says of every environment, and what views of it add; no metric can have these names.
NAMES_OF_INFO = (
    "success", "failure", "root_force", "root_torque", "root_let_go", "reward_terms", "cost", "cost_terms",
    "final_info", "final_obs", "final_state", "episode", "is_success", "terminal_observation", "TimeLimit.truncated",
    "acted", "alive", "time_outs", "log",
)  # fmt: skip


class Task:
    """Base of all tasks; a task subclasses it once.

    Class attributes:
        Config: the task's configuration class.
        description: one line for listings.
        observation_terms: what the task adds to the observation.
        reward_terms: names of the reward's terms; the reward is their sum.
        metrics: names of other numbers reported in ``info``.
        observes_contact: whether agents feel the impulses of other bodies on their body parts.
        observes_others: whether agents see each other.
        targets_about_reference: whether, under ``control="pd"``, targets are counted from the reference pose; else from
            the rest pose.
        camera_position, camera_target: the eye and what it looks at [m], from the ground below the agents' middle, or
            from the origin if the camera does not follow them (``camera_follows``).
        cost_terms: names of what is summed in ``info["cost"]``, for constrained learning; not part of the reward.

    Class attributes for the task's page in ``docs/envs`` (Markdown; ``python -m scripts.env_pages`` writes it):
        summary: a paragraph: what happens, and what a good agent does.
        reward_docs, metric_docs, cost_docs: what each of the names above means, with its unit and its settings.
        success_doc: when ``info["success"]`` is True.
        termination_doc: what else terminates an episode than a root that lets go and a failure; empty for nothing.
        history: version and what was new in it, the newest first.
        picture_seconds: moment of the picture [s]; picture_actions: how the avatars acted until then: ``"zero"``,
            ``"random"`` or constant actions by component name; picture_settings: settings other than the defaults.

    Attributes:
        config: the settings.
        joints: names of those that act.
        scene: what is in the world.
    """

    Config: ClassVar[type[EnvConfig]] = EnvConfig
    description: ClassVar[str] = ""
    observation_terms: ClassVar[tuple[ObservationTerm, ...]] = ()
    reward_terms: ClassVar[tuple[str, ...]] = ()
    metrics: ClassVar[tuple[str, ...]] = ()
    cost_terms: ClassVar[tuple[str, ...]] = ()

    observes_contact: ClassVar[bool] = False
    observes_others: ClassVar[bool] = False
    targets_about_reference: ClassVar[bool] = False

    camera_position: tuple[float, float, float] = (1.75, -3.75, 1.62)
    camera_target: tuple[float, float, float] = (0.0, -0.04, 0.86)
    camera_follows: bool = True

    summary: ClassVar[str] = ""
    reward_docs: ClassVar[Mapping[str, str]] = {}
    metric_docs: ClassVar[Mapping[str, str]] = {}
    cost_docs: ClassVar[Mapping[str, str]] = {}
    success_doc: ClassVar[str] = ""
    termination_doc: ClassVar[str] = ""
    history: ClassVar[tuple[tuple[str, str], ...]] = (("v0", "first version"),)
    picture_seconds: ClassVar[float] = 2.0
    picture_actions: ClassVar[str | Mapping[str, float]] = "random"
    picture_settings: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, config: EnvConfig) -> None:
        """Settle what is in the world.

        Raises:
            ConfigError: settings that do not fit the task.
            ValueError: names of its terms or metrics that cannot be told apart in ``info``.
        """
        self._check_names()
        self.config = config
        self.joints = select_joints(config.joints)
        self.scene = self.build_scene()
        self._move_camera()

    def _check_names(self) -> None:
        """See that every number in ``info`` has a name of its own.

        Raises:
            ValueError: one has not.
        """
        for what in ("reward_terms", "cost_terms", "metrics"):
            names, where = getattr(self, what), f"{type(self).__name__}.{what}"
            if isinstance(names, str):
                raise ValueError(f"{where}={names!r} is one string; give a tuple of names: ({names!r},)")
            for index, name in enumerate(names):
                if not isinstance(name, str) or not name or name.startswith("_"):
                    raise ValueError(f"{where} has {name!r}; a name is a string that does not begin with an underscore")
                if name in names[:index]:
                    raise ValueError(
                        f"{where} has {name!r} twice, of which info would keep the last; call one otherwise"
                    )
                if what == "metrics" and name in NAMES_OF_INFO:
                    raise ValueError(
                        f"{where} has {name!r}, which info has anyway, besides {', '.join(NAMES_OF_INFO)}; call it "
                        "otherwise"
                    )

    def _move_camera(self) -> None:
        """To where the settings of pictures have it, if they do.

        Raises:
            ConfigError: it would look at where it is.
        """
        for name in ("camera_position", "camera_target", "camera_follows"):
            chosen = getattr(self.config.render, name)
            if chosen is not None:
                setattr(self, name, chosen)
        if np.allclose(self.camera_position, self.camera_target):
            place = list(self.camera_position)
            raise ConfigError(f"render.camera_position={place} is where it looks; move it or render.camera_target")

    def build_scene(self) -> SceneConfig:
        """What is in the world: the configured scene and what the task adds to it.

        Raises:
            ConfigError: the configured scene does not fit the task.
        """
        scene = self.config.scene
        if len(scene.avatars) > 1:
            raise ConfigError(f"scene.avatars has {len(scene.avatars)} entries; this task has one avatar")
        return scene if scene.avatars else replace(scene, avatars=[AvatarConfig()])

    @property
    def agent_names(self) -> tuple[str, ...]:
        """Names of the agents, one an avatar."""
        return tuple(f"agent_{index}" for index in range(len(self.scene.avatars)))

    def alone(self) -> Task:
        """The task itself, if it has one agent.

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
        """What the task adds to the observation."""
        return self.observation_terms

    def observed_props(self) -> tuple[str, ...]:
        """Names of the props that agents see."""
        return tuple(prop.name for prop in self.scene.props)

    def prop_places(self) -> Mapping[str, Sequence[Sequence[float]]]:
        """Where episodes may put props, of those that :meth:`record_reset` places, by name.

        Corners of what holds the middles [m], each x, y, z. What would begin outside the domain is refused when the
        environment is built; where the scene has its props is looked at anyway.
        """
        return {}

    def drawn(self) -> tuple[Parameter, ...]:
        """Numbers that the task draws for each episode and that ``observe_parameters`` shows.

        All that changes what will happen, but the bodies' first poses and places, which agents see anyway; also what
        the task's own terms tell.
        """
        return ()

    def drawn_values(self, env: EpisodeArrays) -> tuple[Drawn, ...]:
        """Where those numbers are, in the order of :meth:`drawn`; called once, after :meth:`allocate`."""
        return ()

    def action_spec(self) -> ActionSpec:
        """Joints that act, and whether the root does."""
        return ActionSpec(self.joints, joint_speed=self.config.control.joint_speed_limit)

    def limits(self) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the joints' rotation vectors [rad], each ``(22, 3)``."""
        return joint_limits()

    def domain(self) -> Domain:
        """Where particles may go."""
        return Domain().around([avatar.position for avatar in self.scene.avatars])

    def impulses(self) -> dict[str, float]:
        """Greatest impulse that the task gives a bone at once [N s], by joint: substeps are short enough for it."""
        return {}

    def allocate(self, env: EpisodeArrays) -> None:
        """Create the task's arrays."""

    def arrays(self) -> dict[str, wp.array]:
        """Arrays of the task that a checkpoint must hold."""
        return {}

    def record_reset(self, env: EpisodeArrays, graph: LaunchGraph) -> None:
        """Append: for environments of ``env.mask``, write the avatars' first commanded poses and draw the task.

        Props and colliders start where the scene says, unless this writes other places into
        ``env.simulation.props.spawn`` (and ``.density``) or ``env.simulation.collider_spawn``.
        How fast they will be then, or later, ``top_speed`` in the scene says: substeps are short enough for it.

        Raises:
            NotImplementedError: a task that does not define it.
        """
        raise NotImplementedError(f"{type(self).__name__} must define record_reset(env, graph)")

    def record_references(self, env: EpisodeArrays, graph: LaunchGraph) -> list[tuple[wp.array, wp.array]]:
        """Append what comes before the physics; return the pose that actions are added to, of every avatar.

        A pose is its local rotations and its root; by default what was commanded last.
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

    def markers(
        self, env: EpisodeArrays, index: int
    ) -> Sequence[tuple[np.ndarray, float, tuple[float, float, float]] | Marker]:
        """Things to draw for environment ``index``: ``(position [m], radius [m], rgb)`` spheres, or what renders them.

        Whoever draws has the renderer; a task imports it here and nowhere else.
        """
        return []

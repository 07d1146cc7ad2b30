"""The physical world of an environment: bodies, props, grid and drives for a whole batch, without tasks or rewards."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.sampling import sample_particles, spacing_for
from piavatar_envs.avatar.controller import Controller
from piavatar_envs.avatar.pose_control.controller import PoseController
from piavatar_envs.avatar.torque_control.controller import LONGEST_SUBSTEP, TorqueController
from piavatar_envs.config import AvatarConfig, ConfigError, EnvConfig, SceneConfig, replace
from piavatar_envs.config.schema import MOST_SUBSTEPS, select_joints
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider, make_boundaries, place_colliders
from piavatar_envs.mpm.contact_sensors import clear_masked_sensors
from piavatar_envs.mpm.memory import allocate, estimate_active_blocks
from piavatar_envs.mpm.model import build_model, choose_num_substeps, make_grid
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep
from piavatar_envs.mpm.types import Model, Scratch, State
from piavatar_envs.sim.bodies import Flesh, Shapes, check_shape_names, drive_settings, load_avatar
from piavatar_envs.sim.checks import STRUCK, check_beside_solids, commanded_speed, fastest_blow, fastest_thing
from piavatar_envs.sim.prop_geometry import PropPoints
from piavatar_envs.sim.props import PropSet, check_apart, check_places
from piavatar_envs.sim.randomize import Randomization, fastest_wave
from piavatar_envs.sim.scene import Domain, assemble, prop_matter, prop_points

#: Grid spacings in a standing mean body, by fidelity; "fine" is the paper's scale, about 1 cm.
GRID_PER_HEIGHT: dict[str, float] = {
    "tiny": 12.0,
    "coarse": 32.0,
    "medium": 64.0,
    "fine": 166.0,
}


class Simulation:
    """Avatars and props in each of ``num_envs`` worlds.

    Attributes:
        domain: where particles may go.
        model: constants of the continuum.
        state: particles; scratch: grid; sensors: contact of the last control step.
        flesh: matter of every avatar (NumPy).
        avatars: the avatars; controllers: what moves each of them.
        props: the soft props.
        randomization: factors on mass, stiffness and friction, and what follows from them.
        shapes: bodies of random shape.
        collider_spawn: poses and velocities that a reset gives the colliders.
        subjects: names and particles of both, avatars first.
    """

    def __init__(
        self,
        config: EnvConfig,
        num_envs: int = 1,
        device: str = "cpu",
        domain: Domain | None = None,
        scene: SceneConfig | None = None,
        avatar_names: Sequence[str] | None = None,
        asset: AvatarAsset | None = None,
        impulses: Mapping[str, float] | None = None,
    ) -> None:
        """Build and allocate; nothing is placed until the first reset.

        Args:
            config: resolution, material, drive and shape.
            num_envs: worlds in the batch.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            domain: where particles may go.
            scene: what is in the world; the configuration's own if not given.
            avatar_names: of the avatars; ``agent_0`` ... if not given.
            asset: the body of all avatars; those of their sources if not given.
            impulses: the greatest that a bone may get at once [N s], by joint.

        Raises:
            ConfigError: a scene that cannot be.
            ValueError: an unknown device, an unstable time step, a batch that does not fit.
        """
        self.config, self.num_envs, self.device = config, num_envs, check_device(device)
        self.scene = scene or config.scene
        avatars = self.scene.avatars or (AvatarConfig(),)
        assets = [asset or load_avatar(replace(config.avatar, avatar.avatar)) for avatar in avatars]
        self.asset, physics = assets[0], config.physics
        self.dx = float(np.ptp(self.asset.mean_body().vertices[:, 2])) / GRID_PER_HEIGHT[physics.fidelity]
        spacing = spacing_for(self.dx)
        names = avatar_names or [f"agent_{index}" for index in range(len(avatars))]
        self.flesh = [
            Flesh(config, avatar, own, sample_particles(own, spacing), num_envs)
            for avatar, own in zip(avatars, assets, strict=True)
        ]
        check_shape_names(self.flesh)
        solids = [prop_points(prop, spacing) for prop in self.scene.props]
        matter = [prop_matter(p, points, physics) for p, points in zip(self.scene.props, solids, strict=True)]
        rows = num_envs if solids or any(flesh.shape.randomize for flesh in self.flesh) else 1
        joints = [flesh.joint_settings() for flesh in self.flesh]
        domain = domain or Domain().around([a.position for a in avatars])
        self.domain, walls = self._room(domain, solids, any(joints))
        self.subjects = assemble(self.scene, physics, names, self.flesh, matter, walls, rows)
        rest = np.concatenate([*(flesh.points.rest[0] for flesh in self.flesh), *(points.rest for points in solids)])
        wave = fastest_wave(config.randomize, [flesh.matter() for flesh in self.flesh])
        self.model = build_model(
            self.subjects.matter,
            make_grid(self.domain.lower, self.domain.upper, self.dx),
            num_envs=num_envs,
            device=self.device,
            control_dt=physics.control_dt,
            num_substeps=self._substeps(wave, solids, impulses or {}),
            cfl=physics.cfl,
            gravity=(0.0, 0.0, -physics.gravity),
            decoupling=physics.decoupling,
            colliders=self.subjects.colliders,
            fields=self.subjects.fields,
            max_active_blocks=estimate_active_blocks(rest, self.subjects.matter.field, self.dx),
            rest=rest,
            sound_speed=wave,
        )
        self.state, self.scratch = allocate(self.model)
        self.sensors = self.scratch.sensors
        first, count, fields = self.subjects.first, len(self.flesh), self.model.contact.num_fields
        self.collider_spawn = make_boundaries(self.subjects.colliders, fields, num_envs, self.device)
        self.avatars = [
            Avatar(flesh.points, begin, self.model) for flesh, begin in zip(self.flesh, first, strict=False)
        ]
        self.controllers: list[Controller] = [
            TorqueController(avatar, flesh.points, torque)
            if torque
            else PoseController(avatar, drive_settings(flesh.control))
            for avatar, flesh, torque in zip(self.avatars, self.flesh, joints, strict=True)
        ]
        # before anything is recorded: it gives what varies rows of its own
        self.randomization = Randomization(config.randomize, self.model, self.avatars)
        self.shapes = Shapes(self.flesh, self.avatars, self.model, self.randomization)
        columns = [self.subjects.fields.subject.index(count + index) for index in range(len(solids))]
        self.props = PropSet(self.scene.props, solids, matter, first[count:-1], columns, self.model)

    @property
    def avatar(self) -> Avatar:
        """The first avatar."""
        return self.avatars[0]

    def _room(self, domain: Domain, solids: Sequence[PropPoints], driven: bool) -> tuple[Domain, tuple[Collider, ...]]:
        """The domain, wider where joints are driven by torques, and the walls around it.

        Raises:
            ConfigError: a prop would begin outside or in a solid, or one of those that are configured in another.
        """
        own = {prop.name for prop in self.config.scene.props}  # a task places its own at every reset
        given = [(prop, rest) for prop, rest in zip(self.scene.props, solids, strict=True) if prop.name in own]
        check_apart(self.dx, [prop for prop, _ in given], [rest for _, rest in given])
        walled = self.scene.walls and (bool(solids) or len(self.flesh) > 1 or domain.fenced)
        domain = domain.for_falls(walled) if driven else domain
        check_places(
            domain, self.dx, self.scene.props, solids, {prop.name: [prop.position] for prop in self.scene.props}
        )
        check_beside_solids(self.dx, self.scene.ground, self.config.scene.colliders, given)
        return domain, domain.walls() if walled else ()

    def _substeps(self, wave: float, solids: Sequence[PropPoints], impulses: Mapping[str, float]) -> int:
        """Substeps of a control step as configured, or as few as such a wave [m/s], commands and fast things allow.

        Fast is also flesh that gets one of the ``impulses``.

        Nothing may go further than a grid spacing in a substep, which soft bodies, that need few, soon would.

        Raises:
            ConfigError: as configured they are too long for torques or for something fast, or more would be needed than
                can be configured.
        """
        physics, control, asked = self.config.physics, self.config.control.mode, self.config.physics.num_substeps
        by_torques = 1 if control == "pose" else math.ceil(physics.control_dt / LONGEST_SUBSTEP - 1e-9)
        striking = fastest_thing(self.scene, solids, self.domain, physics.gravity)
        struck = fastest_blow(impulses, self.flesh, self.config.randomize.mass_factor[0])
        thing, speed = max(striking, struck, key=lambda found: found[1])
        if asked is not None:
            least = choose_num_substeps(physics.control_dt, self.dx, speed, 1.0)
            if asked < least:
                raise ConfigError(
                    f"physics.num_substeps={asked}: {thing!r}, at up to {speed:.3g} m/s, would go further than a "
                    f"grid spacing ({self.dx:.3g} m) in a substep of {1e3 * physics.control_dt / asked:.3g} ms; use at "
                    f"least {least}"
                )
            if asked < by_torques:
                raise ConfigError(
                    f"physics.num_substeps={asked}: substeps of {1e3 * physics.control_dt / asked:.3g} ms are too long "
                    f"for control.mode={control!r} ({1e3 * LONGEST_SUBSTEP:g} ms); use at least {by_torques}"
                )
            return asked
        commanded = commanded_speed(self.config.control, select_joints(self.config.joints), self.flesh)
        moving = max(commanded, STRUCK * striking[1], struck[1])
        waves = max(wave, self.subjects.matter.sound_speed())
        chosen = choose_num_substeps(physics.control_dt, self.dx, max(waves, physics.cfl * moving), physics.cfl)
        if chosen > MOST_SUBSTEPS:
            raise ConfigError(
                f"waves of {waves:.3g} m/s and things of up to {moving:.3g} m/s would need {chosen} substeps a control "
                f"step, and {MOST_SUBSTEPS} is the limit; use a shorter physics.control_dt, softer or denser matter "
                "(young_modulus, density, randomize), or slower things"
            )
        return max(chosen, by_torques)

    def record_draws(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Append: the masked environments draw bodies from pools, then the factors on what those are made of."""
        self.shapes.record_draws(graph, mask, seed, episode)
        self.randomization.record_reset(graph, mask, seed, episode)

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Append: place the masked environments' avatars in their commanded poses and their props, and track them."""
        for avatar, controller in zip(self.avatars, self.controllers, strict=True):
            avatar.record_reset(graph, self.state, mask)
            controller.record_reset(graph, self.state, mask)
        self.props.record_reset(graph, self.state, mask)
        graph.launch(clear_masked_sensors, self.num_envs, [mask], [self.sensors])
        if self.model.moving_boundaries:
            boundaries = self.model.boundaries
            graph.launch(place_colliders, boundaries.position.shape, [mask, self.collider_spawn], [boundaries])
        graph.parallel_for_each(self.avatars, lambda avatar, own: avatar.record_tracking(own, self.state))
        self.props.record_tracking(graph, self.state)

    def record_control_step(self, graph: LaunchGraph) -> None:
        """Append: one control step towards the avatars' goals, then track."""
        record_control_step(graph, self.avatars, self.controllers, self.model, self.state, self.scratch)
        self.props.record_tracking(graph, self.state)

    def arrays(self) -> dict[str, wp.array]:
        """Every array of a checkpoint, by name."""
        found = {f"particles.{field.name}": getattr(self.state, field.name) for field in fields(self.state)}
        for index, (avatar, controller) in enumerate(zip(self.avatars, self.controllers, strict=True)):
            for source, arrays in (("avatar", avatar.arrays()), ("controller", controller.arrays())):
                found |= {f"{source}_{index}.{name}": array for name, array in arrays.items()}
        if self.model.moving_boundaries:
            names = ("position", "rotation", "velocity", "spin")
            found |= {f"colliders.{name}": getattr(self.model.boundaries, name) for name in names}
        found |= self.shapes.arrays() | self.randomization.arrays()
        sensors = ("boundary_impulse", "boundary_moment", "pair_impulse", "part_impulse", "penetration")
        found |= {f"sensors.{name}": getattr(self.sensors, name) for name in sensors}
        return found | self.props.arrays()


def record_control_step(
    graph: LaunchGraph,
    avatars: Sequence[Avatar],
    controllers: Sequence[Controller],
    model: Model,
    state: State,
    scratch: Scratch,
) -> None:
    """Append one control step of a world, after which its avatars are tracked.

    Controllers of different avatars run in parallel: none reads what another one writes.
    """
    world = (model, state, scratch)
    begins = graph.branches(controllers, lambda controller, own: controller.record_begin(own))
    record_begin(graph, *world, branches=begins)  # activates blocks
    for step in range(model.num_substeps):
        graph.parallel_for_each(
            controllers, lambda c, own, step=step: c.record_before_substep(own, state, scratch, step)
        )
        record_substep(graph, *world, step)

    def end(index: int, own: LaunchGraph) -> None:
        controllers[index].record_end(own, state)
        avatars[index].record_tracking(own, state)

    ends = graph.branches(range(len(avatars)), end)
    # sensors read the particles where the substeps have left them
    in_order = any(controller.moves_particles for controller in controllers)
    record_end(graph, *world, branches=() if in_order else ends)
    if in_order:
        graph.parallel(*ends)


def check_device(device: str) -> str:
    """Name of an available Warp device.

    Raises:
        ValueError: there is no such device.
    """
    device = str(device)  # of torch, too
    if device.startswith("cuda") and not wp.get_cuda_device_count():
        raise ValueError(f"device={device!r} is not available (no CUDA device, or no driver for one); use one of cpu")
    try:
        return str(wp.get_device(device).alias)
    except (ValueError, RuntimeError) as error:
        available = ", ".join(d.alias for d in wp.get_devices())
        raise ValueError(f"device={device!r} is not available ({error}); use one of {available}") from None

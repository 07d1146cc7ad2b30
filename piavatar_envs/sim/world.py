"""The physical world of a batch: avatars, props and their grid, without tasks and rewards.

:func:`record_control_step` is the control step, stage by stage.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields

import numpy as np
import warp as wp

from piavatar_envs.avatar.avatar import Avatar
from piavatar_envs.avatar.body.asset import AvatarAsset
from piavatar_envs.avatar.body.sampling import sample_particles, spacing_for
from piavatar_envs.avatar.controller import Controller
from piavatar_envs.avatar.pose_control.controller import PoseController
from piavatar_envs.avatar.pose_control.resistance import ResistingPoseController
from piavatar_envs.avatar.torque_control.controller import TorqueControl, TorqueController
from piavatar_envs.config import AvatarConfig, EnvConfig, SceneConfig
from piavatar_envs.core.kernel_cache import init_warp
from piavatar_envs.core.launch_graph import LaunchGraph
from piavatar_envs.mpm.colliders import Collider, make_boundaries, place_colliders
from piavatar_envs.mpm.contact_sensors import clear_masked_sensors
from piavatar_envs.mpm.memory import allocate, estimate_active_blocks
from piavatar_envs.mpm.model import CFL_STABLE, build_model, make_grid
from piavatar_envs.mpm.solver import record_begin, record_end, record_substep
from piavatar_envs.mpm.types import Model, Scratch, State
from piavatar_envs.sim.bodies import Flesh, load_avatar, pose_control
from piavatar_envs.sim.checks import check_apart, check_beside_solids, check_places
from piavatar_envs.sim.forces import Forces, Receivers
from piavatar_envs.sim.garments import Garments, WornCloth, bytes_of_garments, tailor, worn_by
from piavatar_envs.sim.prop_cores import PropCores
from piavatar_envs.sim.props import PropSet, prop_matter, prop_points
from piavatar_envs.sim.randomize import Randomization, fastest_wave, limiting_wave
from piavatar_envs.sim.resolution import GRID_PER_HEIGHT, check_sizes
from piavatar_envs.sim.scene import Domain, assemble
from piavatar_envs.sim.shapes import Shapes, check_shape_names
from piavatar_envs.sim.shells import ShellGarments, bytes_of_shells, shell_matter, with_shells
from piavatar_envs.sim.time_step import choose_substeps, reference_substeps


class Simulation:
    """Avatars and props in each of ``num_envs`` worlds.

    Its arrays are live: every step overwrites them, and on a CPU their ``numpy()`` is a view of them.
    :meth:`piavatar_envs.api.host.HostView.read` returns copies.

    Attributes:
        config, scene: settings, and what is in the world.
        asset: the body of the first avatar.
        dx: grid spacing [m].
        domain: box of the particles.
        flesh: matter of every avatar (NumPy).
        subjects: all matter, avatars first.
        model: constants of the continuum.
        state: particles; scratch: grid; sensors: contact of the last control step.
        avatars, controllers: the avatars, and the controller of each.
        props: the soft props.
        cores: of the props, which thin colliders stop.
        randomization: factors on mass, stiffness and friction, and the constants that they scale.
        shapes: bodies of random shape.
        garments: what the avatars wear; None without garments.
        receivers: what external forces can act on.
        forces: external forces; None before :meth:`enable_forces`.
        initial_colliders: poses and velocities of the colliders after a reset.
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
        largest_impulses: Mapping[str, float] | None = None,
    ) -> None:
        """Build and allocate a world; nothing is placed until the first reset.

        Args:
            config: resolution, material, control and shape.
            num_envs: number of environments in the batch.
            device: Warp device, ``"cpu"`` or ``"cuda:0"``.
            domain: box of the particles; around the avatars if not given.
            scene: avatars, props and colliders; those of ``config`` if not given.
            avatar_names: names of the avatars; ``agent_0`` ... if not given.
            asset: the body of all avatars; those of their sources if not given.
            largest_impulses: on each bone [N s], by joint.

        Raises:
            ConfigError: an impossible scene.
            ValueError: an unknown device, an unstable time step, or a batch that does not fit.
        """
        self.config, self.num_envs, self.device = config, num_envs, check_device(device)
        self.scene = scene or config.scene
        self._load_bodies(asset)
        self._build_matter()
        walls = self._set_domain(domain)
        self._assemble(avatar_names, walls)
        self._build_model(largest_impulses or {})
        self.state, self.scratch = allocate(self.model)
        self.sensors = self.scratch.sensors
        self._build_avatars()
        # before anything is recorded, because constants that vary get arrays of their own
        self.randomization = Randomization(config.randomize, self.model, self.avatars)
        self.shapes = Shapes(self.flesh, self.avatars, self.model, self.randomization)
        self._build_props()
        self.garments = self._dress()
        self.receivers = Receivers(self.avatars, self.controllers, self.props)
        self.forces: Forces | None = None

    @property
    def avatar(self) -> Avatar:
        """The first avatar."""
        return self.avatars[0]

    def _load_bodies(self, asset: AvatarAsset | None) -> None:
        """Load the body of every avatar; the height of the first sets the grid spacing."""
        config = self.config
        self._avatar_configs = self.scene.avatars or (AvatarConfig(),)
        self._assets = [asset or load_avatar(config.avatar.of_avatar(own.avatar)) for own in self._avatar_configs]
        self.asset = self._assets[0]
        self.dx = float(np.ptp(self.asset.mean_body().vertices[:, 2])) / GRID_PER_HEIGHT[config.physics.fidelity]

    def _build_matter(self) -> None:
        """Shape the avatars, and fill them and the props with particles."""
        spacing, physics = spacing_for(self.dx), self.config.physics
        self.flesh = [
            Flesh(self.config, avatar, asset, sample_particles(asset, spacing), self.num_envs)
            for avatar, asset in zip(self._avatar_configs, self._assets, strict=True)
        ]
        check_shape_names(self.flesh)
        self._tailored = tailor(self.config, self.flesh) if any(worn_by(self.config, own) for own in self.flesh) else []
        self._torque = [flesh.torque_control() for flesh in self.flesh]
        self._solids = [prop_points(prop, spacing) for prop in self.scene.props]
        self._prop_matter = [
            prop_matter(prop, points, physics) for prop, points in zip(self.scene.props, self._solids, strict=True)
        ]

    def _set_domain(self, domain: Domain | None) -> tuple[Collider, ...]:
        """Set the domain, wider for tall bodies and under torque control, and return the walls around it.

        Raises:
            ConfigError: a prop would begin outside of it, in a solid or in another prop.
        """
        props, solids = self.scene.props, self._solids
        domain = domain or Domain().around([avatar.position for avatar in self._avatar_configs])
        walled = self.scene.walls and (bool(solids) or len(self.flesh) > 1 or domain.fenced)
        domain = domain.for_height(max(flesh.height for flesh in self.flesh))
        self.domain = domain.for_falls(walled) if any(self._torque) else domain
        # a task places its own props at every reset, so that only those of the settings are checked
        configured = {prop.name for prop in self.config.scene.props}
        given = [(prop, points) for prop, points in zip(props, solids, strict=True) if prop.name in configured]
        check_apart(self.dx, [prop for prop, _ in given], [points for _, points in given])
        check_places(self.domain, self.dx, props, solids, {prop.name: [prop.position] for prop in props})
        check_beside_solids(self.dx, self.scene.ground, self.config.scene.colliders, given)
        return self.domain.walls() if walled else ()

    def _assemble(self, avatar_names: Sequence[str] | None, walls: Sequence[Collider]) -> None:
        """Put all matter in one list, with a row per environment where it may differ between environments."""
        names = avatar_names or [f"agent_{index}" for index in range(len(self.flesh))]
        differs = bool(self._solids) or any(flesh.shape.randomize for flesh in self.flesh)
        rows = self.num_envs if differs else 1
        self.subjects = assemble(self.scene, self.config.physics, names, self.flesh, self._prop_matter, walls, rows)
        self._shells = shell_matter(self.config, self._tailored, self.dx)
        if self._shells:
            self.subjects = with_shells(self.subjects, self._tailored, self._shells, self.dx)
        props = zip(self.scene.props, self._solids, strict=True)
        check_sizes(self.dx, self.config.physics.fidelity, self.scene.colliders, props)

    def _build_model(self, largest_impulses: Mapping[str, float]) -> None:
        """Choose the time step and upload the constants of the continuum."""
        config, physics, subjects = self.config, self.config.physics, self.subjects
        rest = np.concatenate(
            [
                *(flesh.points.rest[0] for flesh in self.flesh),
                *(points.rest for points in self._solids),
                *([self._shells.rest] if self._shells else []),
            ]
        )
        matter = [flesh.matter() for flesh in self.flesh]
        wave, limiting = fastest_wave(config.randomize, matter), limiting_wave(config.randomize, matter, self.dx)
        viscous = physics.cfl / CFL_STABLE * max(limiting, subjects.matter.limiting_speed(self.dx))
        fastest = max(wave, subjects.matter.sound_speed(), viscous)
        cloth = float(self._shells.wave.max()) if self._shells else 0.0
        bounds = config, self.scene, self.domain, self.flesh, self._solids, largest_impulses, self.dx
        self.model = build_model(
            subjects.matter,
            make_grid(self.domain.lower, self.domain.upper, self.dx),
            num_envs=self.num_envs,
            device=self.device,
            control_dt=physics.control_dt,
            num_substeps=choose_substeps(*bounds, fastest),
            reference_substeps=reference_substeps(*bounds, max(wave, cloth)),
            cfl=physics.cfl,
            gravity=(0.0, 0.0, -physics.gravity),
            decoupling=physics.decoupling,
            colliders=subjects.colliders,
            fields=subjects.fields,
            max_active_blocks=estimate_active_blocks(rest, subjects.matter.field, self.dx),
            rest=rest,
            sound_speed=wave,
            limiting_speed=limiting,
            more_bytes=self._bytes_of_garments(),
        )
        fields = self.model.contact.num_fields
        self.initial_colliders = make_boundaries(subjects.colliders, fields, self.num_envs, self.device)

    def _build_avatars(self) -> None:
        """Allocate the avatars and their controllers."""
        first = self.subjects.first
        self.avatars = [
            Avatar(flesh.points, begin, self.model) for flesh, begin in zip(self.flesh, first, strict=False)
        ]
        self.controllers = [self._control(*own) for own in zip(self.avatars, self.flesh, self._torque, strict=True)]

    def _control(self, avatar: Avatar, flesh: Flesh, torque: TorqueControl | None) -> Controller:
        """Return the controller of an avatar."""
        if torque is not None and flesh.control.mode != "pose":
            return TorqueController(avatar, flesh.points, torque)
        parameters = pose_control(flesh.control, self.model)
        if torque is not None:
            return ResistingPoseController(avatar, flesh.points, parameters, torque)
        return PoseController(avatar, flesh.points, parameters, flesh.shape_rates(self.model))

    def _build_props(self) -> None:
        """Allocate the props, whose subjects follow those of the avatars."""
        count, subject = len(self.flesh), self.subjects.fields.subject
        columns = [subject.index(count + index) for index in range(len(self._solids))]
        first = self.subjects.first[count:-1]
        self.props = PropSet(self.scene.props, self._solids, self._prop_matter, first, columns, self.model)
        self.cores = PropCores(self._solids, self.props.props, columns, self.model)

    def _bytes_of_garments(self) -> int:
        """Estimate the memory of the garments of an environment besides their particles [bytes]."""
        meshes = [own.mesh for own in self._tailored]
        if self._shells:
            return bytes_of_shells(meshes)
        apart = self.config.cloth.self_collision
        return bytes_of_garments(meshes, self.flesh, self._solids, apart, self.num_envs, self.device)

    def _dress(self) -> WornCloth | None:
        """Allocate the garments, whose fabrics vary as the settings say."""
        if not self._tailored:
            return None
        garments: WornCloth
        if self._shells:
            of_world = self.flesh, self.avatars, self.shapes, self.model, self.state, self.scratch
            first = self.subjects.first[-1]
            garments = ShellGarments(self._tailored, self._shells, self.config.cloth, *of_world, first)
        else:
            bodies = self.flesh, self.avatars, self.props, self.shapes, self.model, self.state
            garments = Garments(self._tailored, self.config, *bodies)
        self.randomization.scale_cloth(garments.cloth.fabric)
        return garments

    def record_randomization(self, graph: LaunchGraph, mask: wp.array, seed: wp.array, episode: wp.array) -> None:
        """Record the launches by which the masked environments draw bodies, then factors on their constants."""
        self.shapes.record_reset(graph, mask, seed, episode)
        self.randomization.record_reset(graph, mask, seed, episode)

    def record_reset(self, graph: LaunchGraph, mask: wp.array) -> None:
        """Record the launches that place avatars, props and colliders of the masked environments, and track them."""
        for avatar, controller in zip(self.avatars, self.controllers, strict=True):
            avatar.record_reset(graph, self.state, mask)
            controller.record_reset(graph, self.state, mask)
        self.props.record_reset(graph, self.state, mask)
        graph.launch(clear_masked_sensors, self.num_envs, [mask], [self.sensors])
        if self.model.moving_boundaries:
            boundaries = self.model.boundaries
            graph.launch(place_colliders, boundaries.position.shape, [mask, self.initial_colliders], [boundaries])
        graph.parallel_for_each(self.avatars, lambda avatar, own: avatar.record_tracking(own, self.state))
        self.props.record_tracking(graph, self.state)
        if self.garments:
            self.garments.record_reset(graph, mask)

    def enable_forces(self) -> Forces:
        """Return the external forces, which control steps that are recorded from now on apply."""
        self.forces = self.forces or Forces(self.model, self.receivers)
        return self.forces

    def record_step(self, graph: LaunchGraph) -> None:
        """Append a control step towards the avatars' goals; see :func:`record_control_step`."""
        simulated = self.avatars, self.controllers, self.model, self.state, self.scratch
        record_control_step(graph, *simulated, self.props, self.cores, self.forces, self.garments)

    def arrays(self) -> dict[str, wp.array]:
        """Return all arrays of a checkpoint by name."""
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
        found |= self.garments.arrays() if self.garments else {}
        return found | self.props.arrays() | (self.forces.arrays() if self.forces else {})


def record_control_step(
    graph: LaunchGraph,
    avatars: Sequence[Avatar],
    controllers: Sequence[Controller],
    model: Model,
    state: State,
    scratch: Scratch,
    props: PropSet | None = None,
    cores: PropCores | None = None,
    forces: Forces | None = None,
    garments: WornCloth | None = None,
) -> None:
    """Append one control step, after which avatars and props are tracked.

    Controllers of different avatars run in parallel: none reads what another one writes. Cloth follows all of them.
    """
    simulated = (model, state, scratch)
    if garments:
        garments.record_begin(graph)
    begins = graph.branches(controllers, lambda controller, own: controller.record_begin(own))
    record_begin(graph, *simulated, branches=begins)  # activates blocks
    if forces:
        forces.record_begin(graph)
    for step in range(model.num_substeps):
        if forces:
            forces.record_before_controllers(graph, state)
        graph.parallel_for_each(
            controllers, lambda c, own, step=step: c.record_before_substep(own, state, scratch, step)
        )
        if forces:
            forces.record_before_substep(graph, state, step)
        if garments:
            garments.record_before_substep(graph)
        if cores:
            cores.record_before_substep(graph, state, scratch)
        record_substep(graph, *simulated, step)

    def end(index: int, own: LaunchGraph) -> None:
        controllers[index].record_end(own, state)
        avatars[index].record_tracking(own, state)

    ends = graph.branches(range(len(avatars)), end)
    # sensors are read before a controller moves particles
    sensors_first = any(controller.moves_particles for controller in controllers)
    record_end(graph, *simulated, branches=() if sensors_first else ends)
    if sensors_first:
        graph.parallel(*ends)
    if props:
        props.record_tracking(graph, state)
    if garments:
        garments.record_end(graph)
    if garments and garments.reacts_at_end:
        # cloth has changed velocities
        graph.parallel_for_each(avatars, lambda avatar, own: avatar.record_tracking(own, state))
        if props:
            props.record_tracking(graph, state)
    if forces:
        forces.record_end(graph, state)


def check_device(device: str) -> str:
    """Return the name of an available Warp device.

    Raises:
        KernelCacheError: Warp cannot create the folder of its compiled kernels.
        ValueError: there is no such device.
    """
    init_warp()
    device = str(device)  # a torch.device as well
    if device.startswith("cuda") and not wp.get_cuda_device_count():
        raise ValueError(f"device={device!r} is not available (no CUDA device, or no driver for one); use one of cpu")
    try:
        return str(wp.get_device(device).alias)
    except (ValueError, RuntimeError) as error:
        available = ", ".join(d.alias for d in wp.get_devices())
        raise ValueError(f"device={device!r} is not available ({error}); use one of {available}") from None

"""The number of substeps, from the speeds of elastic waves and of the fastest matter that the settings allow."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from piavatar_envs.avatar.body.device import bone_masses
from piavatar_envs.avatar.body.skeleton import JOINT_NAMES, PARENTS, joint_index
from piavatar_envs.avatar.torque_control.controller import LONGEST_SUBSTEP
from piavatar_envs.config import (
    ColliderConfig,
    ConfigError,
    ControlConfig,
    EnvConfig,
    PhysicsConfig,
    PropConfig,
    SceneConfig,
    TorqueControlConfig,
)
from piavatar_envs.config.schema import MOST_SUBSTEPS, select_joints
from piavatar_envs.mpm.model import choose_num_substeps
from piavatar_envs.sim.bodies import Flesh
from piavatar_envs.sim.prop_geometry import PropPoints
from piavatar_envs.sim.scene import Domain

#: Joints that turn about one axis, but for a few degrees.
HINGES = ("left_knee", "right_knee", "left_elbow", "right_elbow")
#: Greatest speed of flesh that a fast collider strikes, over the collider's speed.
STRUCK = 1.5
#: Courant number of substeps that are not configured.
USUAL_CFL = float(PhysicsConfig.model_fields["cfl"].default)
#: Mass of a bone with its flesh in the lightest random body, over that in the body that was built.
LIGHTEST = 0.5


def choose_substeps(
    config: EnvConfig,
    scene: SceneConfig,
    domain: Domain,
    flesh: Sequence[Flesh],
    solids: Sequence[PropPoints],
    impulses: Mapping[str, float],
    dx: float,
    wave: float,
) -> int:
    """Return the number of substeps of a control step: as configured, or the smallest that is stable.

    The CFL limit holds for elastic waves, and no matter may move farther than a grid spacing in a substep.

    Args:
        config: time step, control and, if given, the number of substeps.
        scene: props and colliders.
        domain: the box of the particles.
        flesh: matter of the avatars.
        solids: particles of the props.
        impulses: the greatest impulse on each bone [N s], by joint.
        dx: grid spacing [m].
        wave: speed of the fastest elastic wave, or more where viscosity limits the time step [m/s].

    Raises:
        ConfigError: the configured substeps are too long for torque control or for something fast, or more substeps
            would be needed than can be configured.
    """
    physics = config.physics
    mode, given = config.control.mode, physics.num_substeps
    least = _least(config, flesh)
    if given is None:
        return max(least, _fewest(physics, dx, wave, _moving_speed(config, scene, domain, flesh, solids, impulses)))
    thing = fastest_thing(scene, solids, domain, physics.gravity)
    blow = fastest_blow(impulses, flesh, config.randomize.mass_factor[0])
    name, speed = max(thing, blow, key=lambda found: found[1])
    fewest = choose_num_substeps(physics.control_dt, dx, speed, 1.0)
    if given < fewest:
        raise ConfigError(
            f"physics.num_substeps={given}: {name!r}, at up to {speed:.3g} m/s, would move farther than a grid spacing "
            f"({dx:.3g} m) in a substep of {1e3 * physics.control_dt / given:.3g} ms; use at least {fewest}"
        )
    if given < least:
        raise ConfigError(
            f"physics.num_substeps={given}: substeps of {1e3 * physics.control_dt / given:.3g} ms are too long "
            f"for control.mode={mode!r} ({1e3 * LONGEST_SUBSTEP:g} ms); use at least {least}"
        )
    return given


def reference_substeps(
    config: EnvConfig,
    scene: SceneConfig,
    domain: Domain,
    flesh: Sequence[Flesh],
    solids: Sequence[PropPoints],
    impulses: Mapping[str, float],
    dx: float,
    wave: float,
) -> int:
    """Return the substeps per control step whose damping of short waves further ones keep.

    Unless they are set, they are those of elastic flesh and moving parts at the usual Courant number, whatever
    ``num_substeps`` and ``cfl`` (:mod:`piavatar_envs.mpm.retention`). ``wave`` is the speed of the fastest elastic
    wave, of the avatars and what they wear alone [m/s]; the other arguments are those of :func:`choose_substeps`.
    """
    if config.physics.reference_substeps is not None:
        return config.physics.reference_substeps
    speed = max(wave, USUAL_CFL * _moving_speed(config, scene, domain, flesh, solids, impulses))
    return max(_least(config, flesh), choose_num_substeps(config.physics.control_dt, dx, speed, USUAL_CFL))


def _moving_speed(
    config: EnvConfig,
    scene: SceneConfig,
    domain: Domain,
    flesh: Sequence[Flesh],
    solids: Sequence[PropPoints],
    impulses: Mapping[str, float],
) -> float:
    """Return the greatest speed of anything that moves [m/s]; the arguments are those of :func:`choose_substeps`."""
    thing = fastest_thing(scene, solids, domain, config.physics.gravity)
    blow = fastest_blow(impulses, flesh, config.randomize.mass_factor[0])
    return max(commanded_speed(config.control, select_joints(config.joints), flesh), STRUCK * thing[1], blow[1])


def _least(config: EnvConfig, flesh: Sequence[Flesh]) -> int:
    """Return the fewest substeps that control takes."""
    jointed = any(isinstance(one.control, TorqueControlConfig) or one.control.resistance == "joints" for one in flesh)
    return math.ceil(config.physics.control_dt / LONGEST_SUBSTEP - 1e-9) if jointed else 1


def _fewest(physics: PhysicsConfig, dx: float, wave: float, speed: float) -> int:
    """Return the fewest substeps for a wave and a moving part of these speeds [m/s].

    Raises:
        ConfigError: more than can be configured.
    """
    chosen = choose_num_substeps(physics.control_dt, dx, max(wave, physics.cfl * speed), physics.cfl)
    if chosen > MOST_SUBSTEPS:
        raise ConfigError(
            f"waves of {wave:.3g} m/s and parts of up to {speed:.3g} m/s need {chosen} substeps per control step, "
            f"and {MOST_SUBSTEPS} is the limit; use a shorter physics.control_dt, softer, denser or less viscous "
            "matter (young_modulus, density, viscosity, randomize), or slower parts"
        )
    return chosen


def lever(joints: Sequence[str], rest: np.ndarray, places: np.ndarray, bones: np.ndarray) -> float:
    """Return the greatest lever arm of any flesh about the acting joints [m], as if all turned it in one direction.

    Times the rotation speed about each axis, it bounds the speed of flesh. Knees and elbows turn about one axis, other
    joints about three at once.

    Args:
        joints: names of the acting joints.
        rest: particles [m], shape ``(P, 3)``.
        places: positions of all joints [m], shape ``(22, 3)``.
        bones: the joint that moves each particle most, shape ``(P,)``.
    """
    turns = np.where(np.isin(JOINT_NAMES, joints), np.where(np.isin(JOINT_NAMES, HINGES), 1.0, math.sqrt(3.0)), 0.0)
    total, at = np.zeros(len(rest)), bones.astype(int)
    while (at >= 0).any():  # from every particle to the pelvis
        total += np.where(at >= 0, turns[at] * np.linalg.norm(rest - places[at], axis=1), 0.0)
        at = np.where(at >= 0, np.take(PARENTS, at), -1)
    return float(total.max())


def commanded_speed(control: ControlConfig, joints: Sequence[str], flesh: Sequence[Flesh]) -> float:
    """Return the greatest speed that commands give to flesh [m/s]; 0 under torque control."""
    if control.mode != "pose":
        return 0.0
    levers = [lever(joints, one.points.rest[0], one.points.joints[0], one.sampled.skin_joints[:, 0]) for one in flesh]
    return control.joint_speed_limit * max(levers)


def fastest_thing(
    scene: SceneConfig, solids: Sequence[PropPoints], domain: Domain, gravity: float
) -> tuple[str, float]:
    """Return name and greatest speed [m/s] of the fastest prop or collider; ``("", 0)`` if there is none.

    Speeds come from bounds, never from a draw, since an environment of a batch must equal the single environment.

    Args:
        scene: props and colliders.
        solids: particles of the props.
        domain: the box of the particles, whose height bounds a fall.
        gravity: gravitational acceleration [m/s^2].
    """
    drop = domain.upper[2] - domain.lower[2]
    speeds = {
        prop.name: _prop_speed(prop, solid, drop, gravity) for prop, solid in zip(scene.props, solids, strict=True)
    }
    speeds |= {collider.name: _collider_speed(collider, domain) for collider in scene.colliders}
    return max(speeds.items(), key=lambda item: item[1], default=("", 0.0))


def fastest_blow(impulses: Mapping[str, float], flesh: Sequence[Flesh], mass_factor: float) -> tuple[str, float]:
    """Return name and greatest change of velocity [m/s] by a task's impulses; ``("", 0)`` if there are none.

    Args:
        impulses: the greatest on each bone [N s], by joint.
        flesh: matter of the avatars.
        mass_factor: the least factor on their masses.
    """
    speeds = {}
    for name, impulse in impulses.items():
        of_bone = [bone_masses(one.points)[0][:, joint_index(name)].min() for one in flesh]
        lightest = [mass * (LIGHTEST if one.shape.randomize else 1.0) for mass, one in zip(of_bone, flesh, strict=True)]
        speeds[f"the impulse on {name}"] = impulse / (mass_factor * min(lightest))
    return max(speeds.items(), key=lambda item: item[1], default=("", 0.0))


def _prop_speed(prop: PropConfig, solid: PropPoints, drop: float, gravity: float) -> float:
    """Return the greatest speed of a prop that falls by ``drop`` [m]."""
    reach = float(np.linalg.norm(solid.rest, axis=1).max())
    thrown = max(math.hypot(*prop.velocity) + math.hypot(*prop.spin) * reach, prop.top_speed)
    return math.sqrt(thrown**2 + 2.0 * gravity * drop)


def _collider_speed(collider: ColliderConfig, domain: Domain) -> float:
    """Return the speed of the part of a collider that is farthest from its origin; of a plane, within the domain."""
    reach = math.hypot(*collider.size)
    if collider.kind == "plane":
        corner = np.maximum(np.subtract(domain.upper, collider.position), np.subtract(collider.position, domain.lower))
        reach = float(np.linalg.norm(corner))
    elif collider.kind == "capsule":
        reach = sum(collider.size)
    return max(math.hypot(*collider.velocity) + math.hypot(*collider.spin) * reach, collider.top_speed)

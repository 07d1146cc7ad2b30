"""Measures of the supplement's acts: a row of numbers from the course of each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.paper import acts
from benchmarks.paper.stage import Course
from piavatar_envs.avatar.body.flesh import bone_distance, softness
from piavatar_envs.avatar.body.skeleton import BODY_PARTS, JOINT_NAMES

Row = dict[str, Any]
LAST_SECONDS = 0.4  # over which a settled value is averaged
NEAR = 0.12  # [m] from where something hits
TOUCH = 0.01  # [N s] in a control step
FRONT = 0.02  # |F - R| of a front of strain
SLICE, TRUNK, LEAST_HEIGHT = 0.08, 0.2, 0.2  # [m]: thickness, half width, and height above the feet
HEM = 0.02  # [m] of height above the lowest vertex of a garment
JIGGLING = 0.6  # softness of the flesh that is watched


def settled(course: Course, values: np.ndarray) -> float:
    """Return the mean over the last moments."""
    return float(values[course.time > course.time[-1] - LAST_SECONDS].mean())


def pose_error(course: Course) -> Row:
    """Return the worst joint's error, at its peak and in the end, and the joint's name."""
    worst = course.joint_errors.max(1)
    peak = int(worst.argmax())
    return {
        "peak_joint_error_deg": worst[peak],
        "settled_joint_error_deg": settled(course, worst),
        "worst_joint": JOINT_NAMES[1 + int(course.joint_errors[peak].argmax())],
    }


def contact(course: Course, subject: int = 1) -> Row:
    """Return the impulse of a subject on the avatar, in sum and at most in a control step, and the depth of contact."""
    impulse = np.linalg.norm(course.impulse[:, :, subject].sum(1), axis=1)
    return {
        "impulse_n_s": float(np.linalg.norm(course.impulse[:, :, subject].sum((0, 1)))),
        "peak_impulse_n_s": float(impulse.max()),
        "peak_penetration_mm": 1e3 * float(course.penetration[:, subject].max()),
    }


def kick(course: Course) -> Row:
    """Measure the bend of the kicking leg and the speed of the ball."""
    error = course.errors_of("right_hip", "right_knee", "right_ankle", "right_foot")
    row = pose_error(course) | {"peak_leg_error_deg": float(error.max()), "mean_error_deg": course.joint_errors.mean()}
    if course.stage.simulation.props.names:
        row |= contact(course) | {"ball_speed_m_s": float(np.linalg.norm(course.speed[:, 0], axis=1).max())}
    return row


def throw(course: Course) -> Row:
    """Measure the dent of a thrown ball; of its lengths the one along the throw, the shortest, counts."""
    prop = course.stage.simulation.props.props[0]
    along = np.ptp(course.x[:, prop.first : prop.first + prop.count, 1], axis=1)
    return contact(course) | {
        "peak_ball_dent_mm": 1e3 * float(course.dent.max()),
        "flattening": float(1.0 - along.min() / along[0]),
        "rebound_m_s": float(-course.speed[:, 0, 1].min()),
    }


def head_hit(course: Course) -> Row:
    """Measure the bend of neck and head, at the worst and in the end."""
    head = course.errors_of("neck", "head")
    bent = course.errors_of("left_hip", "left_knee", "right_hip", "right_knee", "spine1", "spine2", "spine3")
    return (
        pose_error(course)
        | contact(course)
        | {
            "peak_head_deg": float(head.max()),
            "settled_head_deg": settled(course, head),
            "settled_trunk_and_legs_deg": settled(course, bent),
        }
    )


def crowd(course: Course) -> Row:
    """Measure the contacts of all props with the avatar."""
    simulation = course.stage.simulation
    row = pose_error(course)
    for subject, name in enumerate(simulation.props.names, start=1):
        row |= {f"{name}_{key}": value for key, value in contact(course, subject).items() if key == "impulse_n_s"}
        row[f"{name}_peak_penetration_mm"] = 1e3 * float(course.penetration[:, subject].max())
    row["objects_that_touched"] = sum(row[f"{name}_impulse_n_s"] > 0.01 for name in simulation.props.names)
    row["dx_mm"] = 1e3 * simulation.dx
    return row


def near(course: Course, place: Sequence[float], reach: float = NEAR) -> np.ndarray:
    """Return a mask ``(P,)`` of the avatar's particles around a place of the standing body."""
    rest = course.stage.simulation.flesh[0].points.rest[0]
    return np.linalg.norm(rest - np.asarray(place), axis=1) < reach


def belly(course: Course) -> Row:
    """Measure the dent of the belly, at its deepest and later."""
    dent = 1e3 * course.displacements(near(course, acts.BELLY))
    deepest = int(dent.mean(1).argmax())

    def after(seconds: float) -> float:
        return float(dent[min(deepest + round(30 * seconds), len(dent) - 1)].mean())

    return contact(course) | {
        "peak_dent_mm": float(dent.max()),
        "peak_mean_dent_mm": float(dent[deepest].mean()),
        "mean_dent_after_0.3_s_mm": after(0.3),
        "mean_dent_after_1_s_mm": after(1.0),
        "largest_dent_after_1_s_mm": float(dent[min(deepest + 30, len(dent) - 1)].max()),
    }


def overlap_of_legs(course: Course) -> np.ndarray:
    """Return the volume that both legs fill, over that of the first moment [m^3], shape ``(T,)``."""
    part, names = course.stage.simulation.flesh[0].part, list(BODY_PARTS)
    left, right = (part == names.index(f"{side}_leg") for side in ("left", "right"))
    overlap = np.array([overlap_volume(course, x, left, right) for x in course.x])
    return overlap - overlap[0]


def legs(course: Course) -> Row:
    """Measure the overlap of the legs, and their pose afterwards."""
    part, names = course.stage.simulation.flesh[0].part, list(BODY_PARTS)
    volume = course.stage.simulation.model.particles.volume.numpy()[0, : len(part)]
    left = part == names.index("left_leg")
    overlap, worst = overlap_of_legs(course), course.joint_errors.max(1)
    return pose_error(course) | {
        "peak_overlap_cm3": 1e6 * float(overlap.max()),
        "overlap_after_cm3": 1e6 * float(overlap[-1]),
        "leg_volume_cm3": 1e6 * float(volume[left].sum()),
        "error_after_deg": float(worst[-1]),
        "joint_after": JOINT_NAMES[1 + int(course.joint_errors[-1].argmax())],
        "ankle_error_after_deg": float(np.max([course.errors_of(f"{side}_ankle")[-1] for side in ("left", "right")])),
    }


def overlap_volume(course: Course, x: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Return the volume [m^3] that two sets of the avatar's particles both fill, with particles at ``x`` [m].

    Volumes are spread by quadratic B-splines, as the solver spreads masses, over nodes half a grid spacing apart: about
    one for each particle, so that surfaces that only touch are blurred by little.
    """
    simulation = course.stage.simulation
    h, volume = 0.5 * simulation.dx, simulation.model.particles.volume.numpy()[0]
    low = x.min(0) - 2.0 * h
    shape = tuple(np.ceil((x.max(0) - low) / h).astype(int) + 3)
    found = []
    for chosen in (first, second):
        at = (x[: len(chosen)][chosen] - low) / h
        base = np.floor(at - 0.5).astype(int)
        f = at - base
        weight = np.stack([0.5 * (1.5 - f) ** 2, 0.75 - (f - 1.0) ** 2, 0.5 * (f - 0.5) ** 2])
        filled = np.zeros(shape)
        for i, j, k in np.ndindex(3, 3, 3):
            share = weight[i, :, 0] * weight[j, :, 1] * weight[k, :, 2] * volume[: len(chosen)][chosen]
            np.add.at(filled, tuple((base + (i, j, k)).T), share)
        found.append(filled)
    return float(np.minimum(*found).sum())


def pillow(course: Course) -> Row:
    """Measure the effects of a pillow and the head on each other."""
    return contact(course) | {
        "peak_head_deg": float(course.errors_of("neck", "head").max()),
        "peak_pillow_dent_mm": 1e3 * float(course.dent.max()),
    }


def around_hit(course: Course) -> np.ndarray:
    """Return a mask ``(P,)`` of the avatar's particles around the place of a can's hardest hit."""
    hit = int(np.linalg.norm(course.impulse[:, :, 1].sum(1), axis=1).argmax())
    # the skin is a can's radius and a little flesh away from where the can is
    return near(course, course.place[hit, 0], 1.5 * NEAR)


def can(course: Course) -> Row:
    """Measure the response of a place of the body to a can."""
    simulation, chosen = course.stage.simulation, around_hit(course)
    way = course.speed[0, 0] / np.linalg.norm(course.speed[0, 0])
    row = contact(course) | {
        "rebound_m_s": float(-(course.speed[:, 0] @ way).min()),
        "peak_dent_mm": 1e3 * float(course.displacements(chosen).max()) if chosen.any() else None,
    }
    regions = simulation.flesh[0].avatar.regions
    return row | {"particles_of_the_region": int(simulation.flesh[0].in_region(regions[0]).sum()) if regions else 0}


def belly_flesh(course: Course) -> np.ndarray:
    """Return a mask ``(P,)`` of the avatar's softest particles between pelvis and chest, on the front."""
    flesh = course.stage.simulation.flesh[0]
    sampled, rest = flesh.sampled, flesh.points.rest[0]
    low, high = course.stage.simulation.asset.joints[[0, 6], 2]
    soft = softness(rest, sampled.bone, sampled.skin_joints, sampled.skin_weights)
    return (soft > JIGGLING) & (rest[:, 1] < 0.0) & (rest[:, 2] > low) & (rest[:, 2] < high)


def jump(course: Course) -> Row:
    """Measure the motion of the belly's soft flesh relative to its bones, from the landing on."""
    sampled, belly = course.stage.simulation.flesh[0].sampled, belly_flesh(course)
    moved = 1e3 * course.displacements(belly)
    amplitude = np.sqrt((moved**2).mean(1))
    flight = int(course.joints[:, 0, 2].argmax())  # the landing is after the top
    peak = flight + int(amplitude[flight:].argmax())
    later = amplitude[min(peak + 9, len(amplitude) - 1)]
    return {
        "belly_particles": int(belly.sum()),
        "deepest_flesh_mm": 1e3 * float(bone_distance(sampled.rest_positions, sampled.bone)[belly].max()),
        "peak_rms_mm": float(amplitude[peak]),
        "peak_largest_mm": float(moved[flight:].max()),
        "peak_at_s": float(course.time[peak]),
        "rms_0.3_s_later_mm": float(later),
        "peak_joint_error_deg": float(course.joint_errors.max()),
    }


def hem_of(course: Course) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest vertices of the first garment ``(n,)``, and where they are in the pelvis' frame over time.

    Returns:
        The vertices; their places about the pelvis joint, turned back by its yaw [m], shape ``(T, n, 3)``.
    """
    garment = course.stage.simulation.garments.garments[0]
    height = garment.draped[:, 2]
    hem = np.flatnonzero(height < height.min() + HEM)
    offset = course.cloth[:, hem] - course.joints[:, None, 0]
    forward = Rotation.from_quat(course.bones[:, 0].astype(float)).apply([1.0, 0.0, 0.0])
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    cosine, sine = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y = offset[..., 0], offset[..., 1]
    return hem, np.stack([cosine * x + sine * y, cosine * y - sine * x, offset[..., 2]], axis=-1)


def hem_lift(course: Course) -> np.ndarray:
    """Return how much higher the hem is over the pelvis than at the start [m], shape ``(T,)``."""
    height = hem_of(course)[1][..., 2].mean(axis=1)
    return height - height[0]


def loose_garment(course: Course) -> Row:
    """Measure how a garment's hem lags, lifts, billows unevenly and swings on, and how far its cloth is stretched."""
    hem, places = hem_of(course)
    angle = np.unwrap(np.arctan2(places[..., 1], places[..., 0]), axis=0)
    lag = np.degrees((angle - angle[0]).mean(axis=1))
    radius, lift = np.linalg.norm(places[..., :2], axis=-1), hem_lift(course)
    speed = np.linalg.norm(np.diff(course.cloth[:, hem], axis=0), axis=-1).mean(axis=1) / course.stage.dt
    garment = course.stage.simulation.garments.garments[0]
    strain = garment.mesh.strain(course.cloth[:, : garment.mesh.num_vertices].astype(float))
    rms = np.sqrt((strain**2).mean(axis=1))
    return {
        "vertices": garment.mesh.num_vertices,
        "peak_lag_deg": float(np.abs(lag).max()),
        "peak_lift_mm": 1e3 * float(lift.max()),
        "lowest_mm": 1e3 * float(lift.min()),
        "peak_unevenness_mm": 1e3 * float(radius.std(axis=1).max()),
        "unevenness_at_rest_mm": 1e3 * float(radius[0].std()),
        "peak_hem_speed_m_s": float(speed.max()),
        "settled_hem_speed_m_s": settled(course, np.append(speed[:1], speed)),
        "mean_edge_strain_rms": float(rms.mean()),
        "worst_edge_strain_rms": float(rms.max()),
        "largest_edge_strain": float(strain.max()),
    }


def stickiness(course: Course) -> Row:
    """Measure how far from the belly a ball is a step before it touches it, how long it does, and its speed after."""
    touching = np.linalg.norm(course.impulse[:, :, 1].sum(1), axis=1) > TOUCH
    return belly(course) | {
        "gap_before_touch_mm": 1e3
        * float(acts.BELLY[1] - acts.BALL_RADIUS - course.place[max(0, int(touching.argmax()) - 1), 0, 1]),
        "contact_s": float(touching.sum() * course.stage.dt),
        "restitution": float(-course.speed[:, 0, 1].min() / course.speed[0, 0, 1]),
    }


def waves(course: Course) -> Row:
    """Measure how fast strain travels down from a blow, beside the speeds of waves in an elastic solid.

    The front is at a height when the mean ``|F - R|`` there first reaches :data:`FRONT`.
    """
    height, strain = strain_by_height(course)
    reached = strain >= FRONT
    below = (height < acts.BELLY[2] - NEAR) & (height > LEAST_HEIGHT) & reached.any(0)
    row: Row = {"peak_distortion": float(course.distortion.max()), "heights_reached": int(below.sum())}
    row["height_m"] = height.tolist()
    physics = course.stage.config.physics
    young, nu, density = physics.young_modulus, physics.poisson_ratio, physics.density
    row |= {
        "shear_wave_m_s": float(np.sqrt(young / (2.0 * (1.0 + nu) * density))),
        "pressure_wave_m_s": float(np.sqrt(young * (1.0 - nu) / ((1.0 + nu) * (1.0 - 2.0 * nu) * density))),
    }
    if below.sum() > 2:
        row["front_m_s"] = -float(np.polyfit(course.time[reached.argmax(0)[below]], height[below], 1)[0])
    return row


def strain_by_height(course: Course) -> tuple[np.ndarray, np.ndarray]:
    """Return heights ``(Z,)`` [m] of slices of trunk, head and legs at rest, and mean ``|F - R|`` there ``(T, Z)``."""
    rest = course.stage.simulation.flesh[0].points.rest[0]
    edges = np.arange(0.0, rest[:, 2].max(), SLICE)
    chosen = np.abs(rest[:, 0]) < TRUNK
    slices = [chosen & (rest[:, 2] >= low) & (rest[:, 2] < low + SLICE) for low in edges]
    found = [
        (low + 0.5 * SLICE, course.distortion[:, s].mean(1)) for low, s in zip(edges, slices, strict=True) if s.any()
    ]
    return np.array([at for at, _ in found]), np.array([mean for _, mean in found]).T

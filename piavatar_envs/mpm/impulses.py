"""Impulses of contact, added up over a control step in fixed point: in whatever order they come, the sum is the same.

A list an environment: of the colliders on every subject, of every pair of subjects, of every subject on every contact
sensor, and the moments of the colliders' impulses.
"""

from __future__ import annotations

import warp as wp

from piavatar_envs.mpm.types import Sensors

wp.set_module_options({"enable_backward": False})

#: Units in a newton second: sums are right to 1e-12 N s, and end at 8e6 N s.
UNITS = wp.constant(float(2**40))


@wp.func
def boundary_entry(sensors: Sensors, subject: int):
    """Place of the colliders' impulse on a subject."""
    return subject


@wp.func
def pair_entry(sensors: Sensors, pair: int):
    """Place of a pair's impulse."""
    return sensors.boundary_impulse.shape[1] + pair


@wp.func
def part_entry(sensors: Sensors, sensor: int, giver: int):
    """Place of the impulse that subject ``giver`` has given a sensor."""
    subjects = sensors.boundary_impulse.shape[1]
    return subjects + subjects * subjects + sensor * subjects + giver


@wp.func
def moment_entry(sensors: Sensors, subject: int):
    """Place of the moment of the colliders' impulse on a subject."""
    return part_entry(sensors, sensors.part_impulse.shape[1], 0) + subject


@wp.func
def add_impulse(sensors: Sensors, e: int, entry: int, J: wp.vec3):
    """Add an impulse [N s] to an entry."""
    for axis in range(3):
        wp.atomic_add(sensors.sums, e, 3 * entry + axis, wp.int64(wp.rint(UNITS * J[axis])))


@wp.func
def impulse_at(sensors: Sensors, e: int, entry: int):
    """Sum of an entry [N s]."""
    x = float(sensors.sums[e, 3 * entry])
    y = float(sensors.sums[e, 3 * entry + 1])
    z = float(sensors.sums[e, 3 * entry + 2])
    return wp.vec3(x, y, z) / UNITS


@wp.func
def forget(e: int, sensors: Sensors):
    """Zero the sensors of an environment."""
    for n in range(sensors.sums.shape[1]):
        sensors.sums[e, n] = wp.int64(0)
    for s in range(sensors.boundary_impulse.shape[1]):
        sensors.boundary_impulse[e, s] = wp.vec3(0.0)
        sensors.boundary_moment[e, s] = wp.vec3(0.0)
        sensors.penetration[e, s] = 0.0
    for s in range(sensors.pair_impulse.shape[1]):
        sensors.pair_impulse[e, s] = wp.vec3(0.0)
    for i in range(sensors.part_impulse.shape[1]):
        for s in range(sensors.part_impulse.shape[2]):
            sensors.part_impulse[e, i, s] = wp.vec3(0.0)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
const float4 v = *reinterpret_cast<const float4*>(&wp::index(node, e, r));
return wp::vec_t<4, wp::float32>(v.x, v.y, v.z, v.w);
#else
return wp::index(node, e, r);
#endif
""")
def read_change(node: wp.array2d(dtype=wp.vec4), e: int, r: int) -> wp.vec4:
    """``node[e, r]``, of the sensors or of what faces what, on a GPU in one load of 16 bytes."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
*reinterpret_cast<float4*>(&wp::index(node, e, r)) = make_float4(value[0], value[1], value[2], value[3]);
#else
wp::index(node, e, r) = value;
#endif
""")
def write_change(node: wp.array2d(dtype=wp.vec4), e: int, r: int, value: wp.vec4):
    """``node[e, r] = value`` in one store."""
    ...


@wp.kernel
def clear_sensors(sensors: Sensors):
    """Forget the contacts of the last control step."""
    forget(wp.tid(), sensors)


@wp.kernel
def clear_masked_sensors(mask: wp.array(dtype=wp.bool), sensors: Sensors):
    """Forget the contacts of the masked environments."""
    e = wp.tid()
    if mask[e]:
        forget(e, sensors)


@wp.kernel
def read_impulses(sensors: Sensors):
    """Write the impulses that have been added up since the sensors were cleared; a thread has an entry."""
    e, entry = wp.tid()
    subjects = sensors.boundary_impulse.shape[1]
    J = impulse_at(sensors, e, entry)
    if entry < pair_entry(sensors, 0):
        sensors.boundary_impulse[e, entry - boundary_entry(sensors, 0)] = J
    elif entry < part_entry(sensors, 0, 0):
        sensors.pair_impulse[e, entry - pair_entry(sensors, 0)] = J
    elif entry < moment_entry(sensors, 0):
        n = entry - part_entry(sensors, 0, 0)
        sensors.part_impulse[e, n // subjects, n % subjects] = J
    else:
        sensors.boundary_moment[e, entry - moment_entry(sensors, 0)] = J

"""What the threads that a particle has, its team, do together: they share its stencil's nodes, and what it becomes.

A ``team`` is of eight threads or of four. Kernels say which by a literal, so that their compiler knows what each thread
has: see :mod:`piavatar_envs.mpm.team_nodes`. What they find is added up by exchanges, after which all of them know it.
"""

from __future__ import annotations

import re

import warp as wp

from piavatar_envs.mpm.counts import Counts
from piavatar_envs.mpm.gather import Gathered
from piavatar_envs.mpm.shared_memory import native
from piavatar_envs.mpm.types import Moving, Particles

wp.set_module_options({"enable_backward": False, "default_grid_stride": False, "fast_math": True})

#: Where the numbers of a particle begin among those that its threads have read: see :func:`read_by_team`.
_F, _VK, _SPIN, _MASS, _VOLUME, _MU, _LAM, _MATERIAL, _HEAVIEST = (
    wp.constant(n) for n in (0, 9, 12, 15, 16, 17, 18, 19, 20)
)
KINEMATIC_VELOCITY, SPIN, MASS, HEAVIEST = _VK, _SPIN, _MASS, _HEAVIEST
#: Those that a thread has read, of which one of eight has three.
vec6 = wp.types.vector(6, float)


@wp.func_native(
    native(
        """
wp::mat_t<4, 4, wp::float32> sums = own;
#pragma unroll
for (int distance = 1; distance < 8; distance *= 2)
    if (distance < team)
#pragma unroll
        for (int i = 0; i < 4; ++i)
#pragma unroll
            for (int c = 1; c < 4; ++c) sums.data[i][c] += __shfl_xor_sync(0xffffffffu, sums.data[i][c], distance);
return sums;
""",
        "return own;",
    )
)
def sum_of_team(team: int, own: wp.mat44) -> wp.mat44:
    """Sum of the last three columns over the threads of a particle; all threads of a warp come here."""
    ...


@wp.func_native(
    native(
        """
const int apart = moved.C.strides[1] / 4;  // the components of both matrices
// an array chosen by a thread would be copied to its own memory, so addresses are
auto at = [=](const auto& array, int words) {
    return (float*)((char*)array.data + (wp::int64)array.strides[0] * e) + words;
};
#pragma unroll
for (int n = 0; n < 2; ++n) {
    if (n * team >= 8) break;
    const int row = (threadIdx.x & team - 1) + n * team, matrix = row < 5 ? row - 2 : row - 5;
    float a[3];
#pragma unroll
    for (int c = 0; c < 3; ++c) {
        a[c] = row == 0 ? s.x[c] : s.u[c];
#pragma unroll
        for (int r = 0; r < 3; ++r) {
            if (row == 2 + r) a[c] = s.C.data[r][c];
            if (row == 5 + r) a[c] = s.F.data[r][c];
        }
    }
    float* to = at(moved.x, 3 * p);
    if (row == 1) to = at(moved.u, 3 * p);
    if (row > 1) to = at(moved.C, 3 * matrix * apart + p);
    if (row > 4) to = at(moved.F, 3 * matrix * apart + p);
    const int next = row < 2 ? 1 : apart;
#pragma unroll
    for (int c = 0; c < 3; ++c) to[c * next] = a[c];
}
""",
        "",
    )
)
def store_by_team(team: int, moved: Moving, e: int, p: int, s: Gathered):
    """Write what a particle has become, a vector or a row of a matrix a thread, or two of these."""
    ...


#: Where the numbers of a particle lie that its threads read: number ``n``, from the first of its kind on.
_READ = {
    _F: "at(moved.F, n * apart + p)",
    _VK: f"at(moved.vk, 3 * p + n - {_VK})",
    _SPIN: f"at(moved.spin, 3 * p + n - {_SPIN})",
    _MASS: "constant(particles.mass, p)",
    _VOLUME: "constant(particles.volume, p)",
    _MU: "constant(particles.mu, p)",
    _LAM: "constant(particles.lam, p)",
    _MATERIAL: "constant(particles.material, p)",
    _HEAVIEST: "constant(counts.heaviest, field)",
}


def _reading(team: int) -> str:
    """What thread ``t`` of a ``team`` reads: its own of the first ``team`` numbers, of the next ones, and so on.

    Written down number by number: of a loop a compiler makes choices of all addresses, for all numbers.
    """
    lines = []
    for row, begin in enumerate(range(0, 24, team)):
        kinds = [max(k for k in _READ if k <= begin), *(k for k in _READ if begin < k < begin + team)]
        for kind, end in zip(kinds, [*kinds[1:], begin + team], strict=True):
            here = max(kind, begin)
            alone = here + 1 == end or kind >= _MASS
            place = re.sub(r"\bn\b", str(here) if alone else f"(t + {begin})", _READ[kind])
            condition = f"if (t {'==' if alone else '>='} {here - begin}) "
            lines.append(f"{condition if kind > begin else 'const float* '}from_{row} = {place};")
    lines += [f"read[{row}] = *from_{row};" for row in range(24 // team)]
    return "\n    ".join(lines)


@wp.func_native(
    native(
        f"""
// an array chosen by a thread would be copied to its own memory, so addresses are
auto at = [=](const auto& array, int words) {{
    return (const float*)((const char*)array.data + (wp::int64)array.strides[0] * e) + words;
}};
auto constant = [=](const auto& array, int word) {{
    const int row = min(e, (int)array.shape[0] - 1);
    return (const float*)((const char*)array.data + (wp::int64)array.strides[0] * row) + word;
}};
const int apart = moved.F.strides[1] / 4, t = threadIdx.x & team - 1;
wp::vec_t<6, wp::float32> read;
if (team == 8) {{
    {_reading(8)}
}} else {{
    {_reading(4)}
}}
return read;
""",
        "return wp::vec_t<6, wp::float32>();",
    )
)
def read_by_team(team: int, particles: Particles, moved: Moving, counts: Counts, e: int, p: int, field: int) -> vec6:
    """A thread's three or six of the numbers of a particle of a ``field``.

    Those are its deformation, kinematic velocity, spin and substance, and the mass of its field's heaviest one: they
    would take many registers of every thread until it needs them, and as many loads.
    """
    ...


def _of_team(result: str, otherwise: str) -> str:
    share = """
auto number = [=](int n) {
    float own = read[0];
#pragma unroll
    for (int row = 1; row < 6; ++row)
        if (n / team == row) own = read[row];
    return __shfl_sync(0xffffffffu, own, (threadIdx.x & 32 - team) | (n & team - 1));
};
"""
    return native(f"{share}return {result};", f"return {otherwise};")


@wp.func_native(_of_team("wp::mat33(" + ", ".join(f"number({n})" for n in range(9)) + ")", "wp::mat33()"))
def deformation_of_team(team: int, read: vec6) -> wp.mat33:
    """Deformation gradient out of what the threads have :func:`read_by_team`, as are those below."""
    ...


@wp.func_native(_of_team("wp::vec3(number(first), number(first + 1), number(first + 2))", "wp::vec3()"))
def vector_of_team(team: int, read: vec6, first: int) -> wp.vec3:
    """The vector whose numbers begin at ``first``."""
    ...


@wp.func_native(_of_team("number(n)", "0.0f"))
def number_of_team(team: int, read: vec6, n: int) -> float:
    """The ``n``-th number."""
    ...


@wp.func_native(_of_team(f"__float_as_int(number({int(_MATERIAL)}))", "0"))
def material_of_team(team: int, read: vec6) -> int:
    """The particle's material."""
    ...


@wp.struct
class Substance:
    """What a particle is made of, see :class:`piavatar_envs.mpm.types.Particles`."""

    mass: float
    volume: float
    mu: float
    lam: float
    material: int


@wp.func
def substance_of_team(team: int, read: vec6):
    """What the particle is made of."""
    s = Substance()
    s.mass = number_of_team(team, read, _MASS)
    s.volume = number_of_team(team, read, _VOLUME)
    s.mu = number_of_team(team, read, _MU)
    s.lam = number_of_team(team, read, _LAM)
    s.material = material_of_team(team, read)
    return s


@wp.func
def field_of(several: bool, particles: Particles, p: int):
    """Field of a particle; nothing is read where there are not ``several``."""
    field = int(0)
    if several:
        field = particles.field[p]
    return field

"""Particles of props: inside, with the volume, centre and inertia of the solid, and a closed surface around them."""

from __future__ import annotations

import pickle
import sys

import numpy as np
import pytest
from scipy.integrate import quad

from piavatar_envs.avatar.body.asset import mesh_volume
from piavatar_envs.sim import prop_geometry as geometry

RADIUS, HALF_SIZE, TUBE = 0.11, (0.1, 0.2, 0.05), (0.06, 0.15)
SPACINGS = (1.0, 0.06, 0.03, 0.012)


def capsule_integrals(radius, half_length):
    """Volume, and mean squares across and along the axis, from discs stacked along it."""

    def integral(of_disc):
        def disc(z):
            return of_disc(radius**2 - max(abs(z) - half_length, 0.0) ** 2, z)

        end = radius + half_length
        return quad(disc, -end, end, points=[-half_length, half_length], epsabs=1e-12)[0]

    volume = integral(lambda square, z: np.pi * square)
    across = integral(lambda square, z: np.pi * square**2 / 4)
    along = integral(lambda square, z: np.pi * square * z**2)
    return volume, across / volume, along / volume


def solids():
    """Name, maker of particles, volume, mean of x^2, y^2 and z^2 over the solid, and whether points are outside."""
    a = np.array(HALF_SIZE)
    volume, across, along = capsule_integrals(*TUBE)

    def beyond_capsule(p):
        axis = p - np.clip(p[:, 2], -TUBE[1], TUBE[1])[:, None] * [0, 0, 1]
        return np.linalg.norm(axis, axis=1) - TUBE[0]

    return [
        pytest.param(
            lambda spacing: geometry.sphere(RADIUS, spacing),
            4 / 3 * np.pi * RADIUS**3,
            np.full(3, RADIUS**2 / 5),
            lambda p: np.linalg.norm(p, axis=1) - RADIUS,
            id="sphere",
        ),
        pytest.param(
            lambda spacing: geometry.box(HALF_SIZE, spacing),
            8 * a.prod(),
            a**2 / 3,
            lambda p: (np.abs(p) - a).max(axis=1),
            id="box",
        ),
        pytest.param(
            lambda spacing: geometry.capsule(*TUBE, spacing),
            volume,
            np.array([across, across, along]),
            beyond_capsule,
            id="capsule",
        ),
    ]


def moments(points):
    """Volume, centre and mean of ``x x^T`` of point masses, in double precision."""
    rest, volume = points.rest.astype(float), points.volume.sum()
    share = points.volume / volume
    return volume, share @ rest, np.einsum("p,pi,pj->ij", share, rest, rest)


@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize(("make", "volume", "squares", "beyond"), solids())
def test_mass_centre_and_inertia_are_the_solids(make, volume, squares, beyond, spacing):
    points = make(spacing)
    total, centre, spread = moments(points)
    assert points.volume.dtype == np.float64 and np.all(points.volume > 0.0)
    assert total == pytest.approx(volume, rel=1e-14 if volume != pytest.approx(capsule_integrals(*TUBE)[0]) else 1e-9)
    assert np.abs(centre).max() < 1e-8
    assert spread == pytest.approx(np.diag(squares), abs=1e-5 * squares.max())
    assert beyond(points.rest.astype(float)).max() < 0.0


@pytest.mark.parametrize(("make", "volume", "squares", "beyond"), solids())
def test_particles_are_even_and_as_dense_as_asked(make, volume, squares, beyond):
    spacing = 0.015
    points = make(spacing)
    assert len(points) == pytest.approx(volume / spacing**3, rel=0.2)
    assert points.volume.min() > 0.25 * points.volume.max()
    gap = np.linalg.norm(points.rest[:, None] - points.rest[None], axis=-1) + np.eye(len(points))
    assert 0.5 * spacing < gap.min(axis=1).min() and gap.min(axis=1).max() < 1.3 * spacing


@pytest.mark.parametrize(("make", "volume", "squares", "beyond"), solids())
def test_the_smallest_prop_has_eight_well_spread_particles(make, volume, squares, beyond):
    """Kabsch needs points in all directions, or a ball could not be seen to roll."""
    points = make(10.0)
    assert len(points) == geometry.MIN_PARTICLES
    assert np.linalg.matrix_rank(points.rest) == 3


@pytest.mark.parametrize(("make", "volume", "squares", "beyond"), solids())
def test_surface_is_closed_outward_and_where_the_solid_is(make, volume, squares, beyond):
    points = make(0.03)
    vertices, faces = points.vertices.astype(float), points.faces
    assert np.abs(beyond(vertices)).max() < 1e-7
    assert mesh_volume(vertices, faces) == pytest.approx(volume, rel=0.02)
    # closed: every edge has its opposite, vertices of equal place taken for one
    place = np.unique(vertices.round(6), axis=0, return_inverse=True)[1].ravel()[faces]
    edges = np.concatenate([place[:, [k, (k + 1) % 3]] for k in range(3)])
    assert len(np.unique(edges, axis=0)) == len(edges)
    assert np.array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))


def test_arrays_are_read_only_and_the_same_every_time():
    one, two = (geometry.sphere(RADIUS, 0.03) for _ in range(2))
    for name, array in vars(one).items():
        assert not array.flags.writeable
        assert array.tobytes() == getattr(two, name).tobytes()


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: geometry.sphere(-0.1, 0.03), r"sphere radius=-0.1 must be positive"),
        (lambda: geometry.sphere(np.nan, 0.03), r"sphere radius=nan must be positive"),
        (lambda: geometry.sphere(0.1, 0.0), r"spacing=0.0 must be positive"),
        (lambda: geometry.box((0.1, 0.0, 0.1), 0.03), r"box half_size\[1\]=0.0 must be positive"),
        (lambda: geometry.box((0.1, 0.2), 0.03), r"three lengths"),
        (lambda: geometry.capsule(0.1, np.inf, 0.03), r"capsule half_length=inf must be positive"),
        (lambda: geometry.sphere(0.1, 1e-3), r"8e\+06 cells \(at most 200000\); use a spacing above 0.0034 m"),
    ],
)
def test_bad_lengths_are_refused(call, message):
    with pytest.raises(ValueError, match=message) as error:
        call()
    assert "\n" not in str(error.value)


def test_the_remedy_of_a_lattice_too_large_works():
    assert len(geometry.sphere(0.1, 0.0035)) < geometry.MAX_CELLS


# ---- meshes
def write_obj(path, vertices, faces, texture=False):
    """A mesh as text; ``texture`` gives each corner of each triangle a texture coordinate of its own."""
    lines = ["mtllib no_such_file.mtl", "usemtl skin"] + [f"v {x} {y} {z}" for x, y, z in vertices]
    if texture:
        lines += [f"vt {n / (3 * len(faces))} 0.5" for n in range(3 * len(faces))]
    for f, corners in enumerate(faces):
        words = [f"{v + 1}/{3 * f + k + 1}" if texture else f"{v + 1}" for k, v in enumerate(corners)]
        lines.append(" ".join(["f", *words]))
    path.write_text("\n".join(lines) + "\n")
    return path


#: A simplex of unit legs, and the mean of x x^T about its centre: 3/80 on the diagonal, -1/80 off it.
TETRAHEDRON = (
    np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]),
    np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]),
)
TETRAHEDRON_SPREAD = (4 * np.eye(3) - 1) / 80


@pytest.fixture
def trimesh():
    return pytest.importorskip("trimesh", reason="an optional extra")


@pytest.mark.parametrize("inverted", [False, True])
@pytest.mark.parametrize("spacing", [0.2, 0.07])
def test_mesh_against_the_integrals_of_a_tetrahedron(trimesh, tmp_path, spacing, inverted):
    vertices, faces = TETRAHEDRON
    shift, scale = np.array([3.0, -2.0, 7.0]), 0.5
    path = write_obj(tmp_path / "solid.obj", vertices + shift, faces[:, ::-1] if inverted else faces)
    points = geometry.mesh(path, spacing * scale, scale)
    total, centre, spread = moments(points)
    assert total == pytest.approx(scale**3 / 6, rel=1e-12)
    assert np.abs(centre).max() < 1e-7
    assert spread == pytest.approx(scale**2 * TETRAHEDRON_SPREAD, abs=1e-4 * scale**2)
    assert mesh_volume(points.vertices, points.faces) == pytest.approx(total, rel=1e-5)  # and outward
    assert np.sort(points.vertices, axis=0) == pytest.approx(np.sort(scale * (vertices - 0.25), axis=0), abs=1e-6)
    at = points.rest / scale + 0.25
    assert at.min() > 0.0 and at.sum(axis=1).max() < 1.0


#: Three bars along the axes, apart from each other: most of the bounding box, and its middle, are empty.
BARS = np.array([[[0, 0, 0], [1, 0.2, 0.2]], [[0, 0.25, 0], [0.2, 1, 0.2]], [[0, 0, 0.25], [0.2, 0.2, 1]]])


@pytest.mark.parametrize("suffix", geometry.MESH_FORMATS)
def test_every_format_gives_the_same_prop(trimesh, tmp_path, suffix):
    shape = trimesh.util.concatenate([trimesh.creation.box(bounds=bounds) for bounds in BARS])
    path = tmp_path / f"bars{suffix}"
    shape.export(path)
    points = geometry.mesh(path, 0.06)
    total, centre, spread = moments(points)
    edges = BARS[:, 1] - BARS[:, 0]
    share = edges.prod(axis=1) / edges.prod(axis=1).sum()
    middles = BARS.mean(axis=1)
    of_bars = np.einsum("b,bi,bj->ij", share, middles, middles) + np.diag(share @ edges**2) / 12.0
    middle = share @ middles
    assert total == pytest.approx(edges.prod(axis=1).sum(), rel=1e-6)
    assert np.abs(centre).max() < 1e-7
    assert spread == pytest.approx(of_bars - np.outer(middle, middle), abs=0.02 * np.trace(spread))
    at = points.rest + middle
    assert np.any([np.all((at > low) & (at < high), axis=1) for low, high in BARS], axis=0).all()


def test_between_the_teeth_of_a_comb_there_is_nothing(trimesh, tmp_path):
    """Four plates, two to a cell: the middle of what a cell holds is in the gap, and no particle may stay there."""
    low = np.array([[0.06 * k, 0.0, 0.0] for k in range(4)])
    plates = [trimesh.creation.box(bounds=[corner, corner + [0.03, 0.4, 0.4]]) for corner in low]
    trimesh.util.concatenate(plates).export(tmp_path / "comb.stl")
    points = geometry.mesh(tmp_path / "comb.stl", 0.1)
    assert np.abs(moments(points)[1]).max() < 1e-7
    at = points.rest - points.vertices.min(axis=0)
    assert np.any([np.all((at > c) & (at < c + [0.03, 0.4, 0.4]), axis=1) for c in low], axis=0).all()


@pytest.mark.parametrize("outward", [True, False])
def test_a_hollow_body_is_hollow(trimesh, tmp_path, outward):
    """Also where the file has it inside out."""
    outer, inner = (trimesh.creation.box(extents=[edge] * 3) for edge in (0.4, 0.2))
    inner.invert()
    shape = trimesh.util.concatenate([outer, inner])
    if not outward:
        shape.invert()
    shape.export(tmp_path / "hollow.stl")
    points = geometry.mesh(tmp_path / "hollow.stl", 0.04)
    assert points.volume.sum() == pytest.approx(0.4**3 - 0.2**3, rel=1e-6)
    assert np.abs(points.rest).max(axis=1).min() > 0.1 and np.abs(points.rest).max() < 0.2
    assert mesh_volume(points.vertices, points.faces) == pytest.approx(points.volume.sum(), rel=1e-5)


def test_triangles_without_area_do_not_open_a_mesh(trimesh, tmp_path):
    """Exporters leave slivers that collapse when vertices are merged."""
    vertices, faces = TETRAHEDRON
    extra = np.concatenate([vertices, vertices[1:2]])
    points = geometry.mesh(write_obj(tmp_path / "sliver.obj", extra, np.concatenate([faces, [[1, 4, 2]]])), 0.2)
    assert points.volume.sum() == pytest.approx(1.0 / 6.0, rel=1e-12)


def test_texture_seams_do_not_open_a_mesh(trimesh, tmp_path):
    plain = geometry.mesh(write_obj(tmp_path / "plain.obj", *TETRAHEDRON), 0.1)
    seamed = geometry.mesh(write_obj(tmp_path / "seamed.obj", *TETRAHEDRON, texture=True), 0.1)
    assert np.array_equal(plain.rest, seamed.rest) and np.array_equal(plain.volume, seamed.volume)


def hollow_ball(trimesh):
    """Two balls, one inside the other and turned outside in: a skin of 2 mm."""
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.198)
    inner.invert()
    return trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=3, radius=0.2), inner])


#: Name, contents (bytes, or what makes a shape to export), and the message that refuses it.
BAD_FILES = {
    "model.pkl": (pickle.dumps({"vertices": []}), r"unknown mesh format '\.pkl'; use one of \.glb, \.obj"),
    "model.zip": (b"PK", r"unknown mesh format '\.zip'"),
    "model": (b"", r"unknown mesh format ''"),
    "pickle.obj": (pickle.dumps({"vertices": []}), r"no triangles"),
    "nothing.obj": (b"", r"no triangles"),
    "nothing.stl": (b"", r"no triangles"),
    "noise.ply": (bytes(range(256)), r"readable \.ply mesh"),
    "noise.glb": (bytes(range(256)), r"readable \.glb mesh"),
    "cloud.ply": (lambda trimesh: trimesh.PointCloud(TETRAHEDRON[0]), r"no triangles"),
    "open.off": (
        lambda trimesh: trimesh.Trimesh(TETRAHEDRON[0], TETRAHEDRON[1][1:]),
        r"not watertight \(3 edges without two sides\); close it",
    ),
    "mixed.off": (
        lambda trimesh: trimesh.Trimesh(TETRAHEDRON[0], [*TETRAHEDRON[1][:2], *TETRAHEDRON[1][2:, ::-1]]),
        r"normals consistent",
    ),
    "shell.stl": (hollow_ball, r"too thin for spacing=0\.05 m: \d+ particles.* use a spacing under 0\.025 m"),
    "needle.ply": (
        lambda trimesh: trimesh.creation.cylinder(0.002, segment=[[0, 0, 0], [1, 1, 1]]),
        r"too thin for spacing",
    ),
}


@pytest.mark.parametrize("name", list(BAD_FILES))
def test_bad_meshes_are_refused_in_one_line(trimesh, tmp_path, name):
    content, message = BAD_FILES[name]
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    else:
        content(trimesh).export(path)
    with pytest.raises(ValueError, match=message) as error:
        geometry.mesh(path, 0.05)
    assert name in str(error.value) and "\n" not in str(error.value)


def test_a_missing_file_is_named(trimesh, tmp_path):
    with pytest.raises(FileNotFoundError, match=r"no mesh at .*none\.obj"):
        geometry.mesh(tmp_path / "none.obj", 0.05)


@pytest.mark.parametrize("scale", [0.0, -1.0, np.inf])
def test_bad_scales_are_refused(tmp_path, scale):
    with pytest.raises(ValueError, match=r"scale=.* must be positive"):
        geometry.mesh(tmp_path / "solid.obj", 0.05, scale)


def test_without_trimesh_the_error_says_what_to_install(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ImportError) as error:
        geometry.mesh(tmp_path / "solid.obj", 0.05)
    assert "pip install piavatar-envs[props]" in str(error.value) and "\n" not in str(error.value)
    assert len(geometry.sphere(RADIUS, 0.05)) >= 8  # needs no extra

"""Rendered scenes: light against Fresnel, meshes, what stands before an object, and the sensor.

A smooth ball under an even sky: every zenith and azimuth, known exactly.
"""

import contextlib
import math
import random
import struct
from pathlib import Path

import msgspec
import numpy as np
import pytest
import torch
from faults import Fault
from scipy.spatial import ConvexHull, Delaunay
from torch import Tensor

from polarguide import optics
from polarguide.capture.sensor.pattern import sensor_pattern
from polarguide.core.errors import PolarguideError
from polarguide.geometry.camera import Camera, look_at
from polarguide.geometry.vectors import unit_array as unit
from polarguide_synth.build import BuiltScene, _mesh, _user_mesh, build_scene
from polarguide_synth.colmap import place_cameras
from polarguide_synth.ground_truth import base_colors, ground_truth_maps, intersect
from polarguide_synth.schema import Thing, parse_scene
from polarguide_synth.sensor import LobeRadiance, Sensor, mosaic, noisy, render_lobes
from polarguide_synth.settings import PRESETS, find_scene
from polarguide_synth.transport import PathLimits

INDEX = 1.5
BALL = {
    "name": "ball",
    "camera": {"rings": [{"radius": 3, "height": 1}]},
    "environment": {"type": "uniform", "radiance": [1, 1, 1], "height": 4},
    "things": [
        {
            "name": "ball",
            "shape": {"type": "ball", "radius": 1},
            "material": {"color": [0.6, 0.3, 0.15], "roughness": 0.001, "index": INDEX},
        }
    ],
}


@pytest.fixture(scope="module")
def camera() -> Camera:
    """Off the axis of the ball, so that frames off the axis count, and turned against the world."""
    return Camera(
        20, 16, 20.0, 20.0, 10.0, 8.0, *look_at((2.2, -1.4, 1.1), (0.2, 0.15, 0.1), (0.0, 0.0, 1.0))
    )


@pytest.fixture(scope="module")
def ball(mitsuba: None, tmp_path_factory: pytest.TempPathFactory) -> BuiltScene:
    folder = tmp_path_factory.mktemp("ball")
    return build_scene(parse_scene(BALL, "ball", folder=folder), folder)


@pytest.fixture(scope="module")
def light(ball: BuiltScene, camera: Camera) -> LobeRadiance:
    return render_lobes(ball.scenes, camera, 64, seed=3, limits=PathLimits(depth=3), center=True)


@pytest.fixture(scope="module")
def normals(camera: Camera) -> tuple[Tensor, Tensor]:
    """Analytic normals of the unit ball in camera axes, [H, W, 3] float64, and where there is one."""
    eye = camera.center.numpy()
    rays = camera.world_rays(dtype=torch.float64).numpy()
    along = rays @ eye
    inside = along**2 - (eye @ eye - 1)
    reach = -along - np.sqrt(np.maximum(inside, 0))
    world = unit(eye + reach[..., None] * rays)
    return camera.to_camera(torch.from_numpy(world)), torch.from_numpy(inside > 0.03)


def angle_error(stokes: Tensor, expected: Tensor) -> Tensor:
    """Difference of AoLP modulo half a turn, degrees."""
    return torch.rad2deg(torch.remainder(optics.aolp(stokes) - expected + math.pi / 2, math.pi) - math.pi / 2)


@pytest.mark.parametrize("lobe", ["specular", "diffuse"])
def test_each_lobe_obeys_fresnel(
    lobe: str, light: LobeRadiance, normals: tuple[Tensor, Tensor], camera: Camera
) -> None:
    normal, where = normals
    rays = camera.rays(dtype=torch.float64)
    zenith, azimuth = optics.zenith(normal, rays), optics.azimuth(normal, rays)
    # Near the middle there is no direction, at the rim the highlight of a rough surface is cut off.
    where = where & (zenith > math.radians(15)) & (zenith < math.radians(78))
    assert where.sum() > 80
    stokes = optics.luminance(torch.from_numpy(getattr(light, lobe)))
    degree = optics.specular_dolp if lobe == "specular" else optics.diffuse_dolp
    error = (optics.dolp(stokes) - degree(zenith, INDEX))[where].abs()
    assert error.max() < 1e-3
    turn = math.pi / 2 if lobe == "specular" else 0.0
    off = angle_error(stokes, azimuth + turn)[where]
    assert off.abs().mean() < 0.01
    assert off.mean().abs() < 0.005


def test_specular_light_is_fresnels_reflectance(
    light: LobeRadiance, normals: tuple[Tensor, Tensor], camera: Camera
) -> None:
    normal, where = normals
    zenith = optics.zenith(normal, camera.rays(dtype=torch.float64))
    rs, rp = optics.reflectances(zenith, INDEX)
    found = torch.from_numpy(light.specular[0]).mean(-1)
    where = where & (zenith < math.radians(75))
    ratio = found[where] / ((rs + rp) / 2)[where]
    assert ratio.mean() == pytest.approx(1, abs=5e-3)
    assert (ratio - 1).abs().max() < 0.02


def test_full_polarization_at_brewsters_angle(
    ball: BuiltScene, camera: Camera, normals: tuple[Tensor, Tensor], light: LobeRadiance
) -> None:
    normal, where = normals
    zenith = optics.zenith(normal, camera.rays(dtype=torch.float64))
    # Rp vanishes as the square of the distance from Brewster's angle: sqrt(1 - DoLP), signed, crosses zero there.
    near = where & ((zenith - optics.brewster(INDEX)).abs() < math.radians(12))
    degree = optics.dolp(optics.luminance(torch.from_numpy(light.specular)))[near]
    inner = zenith[near]
    root = torch.sqrt((1 - degree).clamp(min=0)) * torch.sign(inner - optics.brewster(INDEX))
    basis = torch.stack([torch.ones_like(inner), inner, inner**2, inner**3], -1)
    weights = torch.linalg.lstsq(basis, root[:, None]).solution[:, 0]
    angles = torch.linspace(math.radians(52), math.radians(61), 9001, dtype=torch.float64)
    curve = torch.stack([angles**k for k in range(4)], -1) @ weights
    crossing = float(angles[curve.abs().argmin()])
    assert math.degrees(crossing) == pytest.approx(math.degrees(float(optics.brewster(INDEX))), abs=0.1)


def test_lobes_add_up_and_predict_the_polarization(
    light: LobeRadiance, normals: tuple[Tensor, Tensor], camera: Camera
) -> None:
    normal, where = normals
    total = light.stokes
    np.testing.assert_allclose(total[0], light.specular[0] + light.diffuse[0] + light.emitted, atol=1e-12)
    rays = camera.rays(dtype=torch.float64)
    where = where & (optics.zenith(normal, rays) < math.radians(78))
    model = optics.predicted_stokes(
        torch.from_numpy(light.specular[0]), torch.from_numpy(light.diffuse[0]), normal, rays, INDEX
    )
    assert (model - torch.from_numpy(total)).abs()[:, where].max() < 1e-3


def test_what_is_seen_directly_is_the_sky(light: LobeRadiance, normals: tuple[Tensor, Tensor]) -> None:
    _, where = normals
    assert light.emitted[0, 0] == pytest.approx(1.0, abs=0.02)
    assert not light.specular[0, 0].any()
    assert not light.diffuse[:, 0, 0].any()
    assert not light.emitted[where.numpy()].any()


def test_pixel_truth_agrees_with_the_geometry(
    ball: BuiltScene, camera: Camera, normals: tuple[Tensor, Tensor]
) -> None:
    ground_truth = ground_truth_maps(ball, camera)
    normal, where = normals
    found = camera.to_camera(torch.from_numpy(ground_truth["normal"].astype(np.float64)))
    assert ((torch.nn.functional.normalize(found, dim=-1) * normal).sum(-1)[where] > 0.99999).all()
    assert (torch.from_numpy(ground_truth["mask"])[where]).all()
    eye = camera.center.numpy()
    places = (
        eye
        + ground_truth["depth"].astype(np.float64)[..., None]
        * (camera.world_rays(dtype=torch.float64) / camera.rays(dtype=torch.float64)[..., 2:]).numpy()
    )
    size = np.linalg.norm(places[where.numpy()], axis=-1)
    np.testing.assert_allclose(size, 1, atol=4e-3)  # half precision


SURFACES = {
    **BALL,
    "name": "surfaces",
    "things": [
        {
            "name": "tiles",
            "shape": {"type": "ball", "radius": 0.7},
            "material": {"color": {"type": "mottled", "a": [0.6, 0.1, 0.1], "b": [0.1, 0.4, 0.6], "pixels": 32},
                         "roughness": 0.1, "index": 1.7},
        },
        {
            "name": "gold",
            "position": [0.9, 0.9, 0],
            "shape": {"type": "box", "size": [0.9, 0.9, 1.5]},
            "material": {"type": "metal", "roughness": 0.2, "eta": [0.2, 0.4, 1.4], "k": [3.0, 2.4, 1.9]},
        },
        {
            "name": "chalk",
            "position": [-0.66, -0.88, 0],
            "shape": {"type": "solid", "parts": [
                {"kind": "ellipsoid", "at": [0, 0, 0], "size": [0.4, 0.4, 0.6], "color": [0.8, 0.7, 0.1]}]},
            "material": {"type": "matte", "color": "own"},
        },
    ],
}  # fmt: skip


@pytest.mark.usefixtures("mitsuba")
def test_material_truth_is_what_mitsuba_renders_with(camera: Camera, tmp_path: Path) -> None:
    """The reference for dielectrics is Mitsuba's diffuse lobe without two passages through the coat."""
    built = build_scene(parse_scene(SURFACES, "surfaces", folder=tmp_path), tmp_path)
    rays = camera.world_rays().numpy().astype(np.float64).reshape(-1, 3)
    origins = np.broadcast_to(camera.center.numpy(), rays.shape)
    hits = intersect(built, origins, rays)
    colors = base_colors(built, hits)
    here = {thing.name: hits.thing == number for number, thing in enumerate(built.spec.things, 1)}
    mi = pytest.importorskip("mitsuba")
    corners = [mi.Vector3f(np.ascontiguousarray(v.T, np.float32)) for v in (origins, rays)]
    only_diffuse = mi.BSDFContext()
    only_diffuse.type_mask = int(mi.BSDFFlags.Diffuse)
    up = mi.Vector3f(0, 0, 1)
    for channel, scene in enumerate(built.scenes):
        surface = scene.ray_intersect(mi.Ray3f(mi.Point3f(corners[0]), corners[1]))
        surface.wi = up
        lobe = np.array(surface.bsdf().eval(only_diffuse, surface, up, surface.is_valid())[0, 0]).ravel()
        for name, passage in (("tiles", 4 * 1.7 / 2.7**2), ("chalk", 1.0)):
            assert here[name].sum() > 8
            expected = lobe[here[name]] * math.pi / passage**2
            np.testing.assert_allclose(colors[here[name], channel], expected, atol=1e-5)
    assert colors[here["tiles"]].std() > 0.05
    np.testing.assert_allclose(
        colors[here["gold"]], [[0.9234, 0.7927, 0.4023]] * here["gold"].sum(), atol=1e-3
    )
    maps = {
        name: values.reshape(-1, *values.shape[2:])
        for name, values in ground_truth_maps(built, camera).items()
    }
    for name, (roughness, metalness, index) in {
        "tiles": (0.1, 0, 1.7),
        "gold": (0.2, 1, 0),
        "chalk": (1, 0, 0),
    }.items():
        of_material = np.stack([maps[key][here[name]] for key in ("roughness", "metalness", "index")], -1)
        np.testing.assert_allclose(of_material, [[roughness, metalness, index]] * here[name].sum(), atol=1e-3)
    np.testing.assert_allclose(
        np.median(maps["albedo"][here["gold"]], axis=0), [0.9234, 0.7927, 0.4023], atol=1e-3
    )


def test_base_color_is_the_mean_of_each_pixel(ball: BuiltScene, camera: Camera) -> None:
    """The mean includes only the part of the pixel that shows the ball."""
    albedo = ground_truth_maps(ball, camera)["albedo"].astype(float)
    drawn = albedo.any(axis=-1)
    np.testing.assert_allclose(albedo[drawn], [[0.6, 0.3, 0.15]] * drawn.sum(), atol=1e-3)
    centers = ground_truth_maps(ball, camera)["objid"] > 0
    assert drawn[centers].all()
    assert centers.sum() < drawn.sum() < centers.sum() + 60  # of 320 pixels, those at the outline


def test_lobes_add_up_to_mitsubas_own_path_tracer(
    ball: BuiltScene, camera: Camera, light: LobeRadiance
) -> None:
    """The same scene by ``stokes`` over ``path``; its frame differs off the axis, S0 and DoLP do not."""
    import mitsuba as mi

    axes = np.eye(4)
    rows = camera.rotation.numpy()
    axes[:3] = np.stack((-rows[0], -rows[1], rows[2], camera.center.numpy()), -1)
    sensor = mi.load_dict({
        "type": "perspective", "fov_axis": "x", "fov": math.degrees(2 * math.atan(camera.width / 2 / camera.fx)),
        "to_world": mi.ScalarTransform4f(axes), "near_clip": 1e-3,
        "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}},
    })  # fmt: skip
    inner = {"type": "path", "max_depth": 4}
    integrator = mi.load_dict({"type": "stokes", "inner": inner})
    theirs = np.array(mi.render(ball.scenes[0], sensor=sensor, integrator=integrator, spp=64), np.float64)
    names = integrator.aov_names()
    found = [
        theirs[..., theirs.shape[-1] - len(names) + names.index(f"S{k}.{c}")] for k in range(3) for c in "RGB"
    ]
    other = np.stack(found).reshape(3, 3, camera.height, camera.width).transpose(0, 2, 3, 1)
    mine = render_lobes(ball.scenes, camera, 64, seed=5, limits=PathLimits(depth=3)).stokes
    inside = np.s_[5:11, 6:14]
    for image in (other, mine):
        assert image[0][inside].min() > 0
    a, b = (
        optics.luminance(torch.from_numpy(image[(slice(None), *inside)][..., :1])) for image in (other, mine)
    )
    assert float(a[0].mean()) == pytest.approx(float(b[0].mean()), rel=0.02)
    assert (optics.dolp(a) - optics.dolp(b)).abs().mean() < 5e-3


HEAD = "ply\nformat binary_little_endian 1.0\nelement vertex {}\n" + "".join(
    f"property float {axis}\n" for axis in "xyz"
)
FACES = "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
PLACES = struct.pack("<9f", 0, 0, 0, 1, 0, 0, 0, 1, 0)


def ply(vertices: object, faces: object, body: bytes) -> bytes:
    return (HEAD.format(vertices) + FACES.format(faces)).encode() + body


def corners(*numbers: int) -> bytes:
    return bytes([len(numbers)]) + struct.pack(f"<{len(numbers)}i", *numbers)


@pytest.mark.usefixtures("mitsuba")
def test_a_triangle(tmp_path: Path) -> None:
    (tmp_path / "m.ply").write_bytes(ply(3, 1, PLACES + corners(0, 1, 2)))
    mesh = _user_mesh(tmp_path / "m.ply")
    assert mesh.points.shape == (3, 3)
    assert mesh.faces.tolist() == [[0, 1, 2]]


@pytest.mark.usefixtures("mitsuba")
@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("m.ply", ply(-5, 1, b"")),
        ("m.ply", ply("9" * 5000, 1, b"")),
        ("m.ply", ply(3, 1, PLACES + corners(0, 1, 99))),
        ("m.ply", ply(3, 1, PLACES + corners(0, 1, -1))),
        ("m.ply", ply(3, 1, PLACES + b"\xff")),
        ("m.ply", ply(3, 0, PLACES)),
        ("m.ply", b"ply\nformat"),
        ("m.ply", HEAD.format(3).encode() + b"\xffelement face 1\n"),
        ("m.obj", b""),
        ("m.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
        ("m.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
    ],
)
def test_damaged_ones_are_named(tmp_path: Path, name: str, data: bytes) -> None:
    (tmp_path / name).write_bytes(data)
    Fault(name).raised_by(_user_mesh, tmp_path / name)


@pytest.mark.usefixtures("mitsuba")
@pytest.mark.parametrize("seed", range(40))
def test_random_damage_is_read_or_named(tmp_path: Path, seed: int) -> None:
    """Corners beyond the points once made Mitsuba write where nothing was, which ended a later test or none."""
    draw = random.Random(seed)
    count = draw.choice([3, 40, 400])
    points = struct.pack(f"<{3 * count}f", *(draw.uniform(-1, 1) for _ in range(3 * count)))
    triangles = b"".join(corners(*(draw.randrange(count) for _ in range(3))) for _ in range(2 * count))
    data = bytearray(ply(count, 2 * count, points + triangles))
    for _ in range(draw.choice([1, 2, 20])):
        place = draw.randrange(len(data) - 4)
        data[place : place + 4] = struct.pack(
            "<i", draw.choice([-1, 99_999, 2**31 - 1, draw.randrange(2**31)])
        )
    (tmp_path / "m.ply").write_bytes(data)
    with contextlib.suppress(PolarguideError):
        mesh = _user_mesh(tmp_path / "m.ply")
        assert 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.points)


POINTS = 20_000


def spread(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Points all over the triangles, more of each where there are few."""
    side = max(2, int(np.sqrt(2 * POINTS / len(faces))))
    a, b = (grid.ravel() for grid in np.meshgrid(np.linspace(0, 1, side), np.linspace(0, 1, side)))
    a, b = a[a + b <= 1], b[a + b <= 1]
    corners = vertices[faces]
    points = corners[:, None, 0] + a[:, None] * (corners[:, 1:2] - corners[:, :1])
    return (points + b[:, None] * (corners[:, 2:3] - corners[:, :1])).reshape(-1, 3)


def projected(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    local = (points - camera.center.numpy()) @ camera.rotation.numpy().T
    return local[:, :2] / np.maximum(local[:, 2:], 1e-9), local[:, 2]


def coarse(thing: Thing) -> Thing:
    detail = {"detail": 48} if thing.shape.get("type") == "solid" else {}
    return msgspec.structs.replace(thing, shape=dict(thing.shape) | detail)


@pytest.mark.parametrize("name", [name for name in PRESETS if find_scene(name).object_only])
def test_nothing_stands_before_the_object(name: str) -> None:
    spec = find_scene(name)
    meshes = {thing.name: _mesh(coarse(thing), spec) for thing in spec.things}
    subject = np.concatenate([meshes[thing.name].points for thing in spec.things if thing.foreground])
    subject = subject[ConvexHull(subject).vertices]
    others = {
        thing.name: spread(meshes[thing.name].points, meshes[thing.name].faces)
        for thing in spec.things
        if not thing.foreground and meshes[thing.name].points[:, 2].max() > subject[:, 2].min() + 0.01
    }
    for camera in place_cameras(spec.camera, 192, 144, 0):
        shown, depth = projected(camera, subject)
        outline = Delaunay(shown)
        for other, points in others.items():
            where, away = projected(camera, points)
            before = (away > 0) & (away < depth.max()) & (outline.find_simplex(where) >= 0)
            assert not before.any(), f"{other} hides a part of the object"


IDEAL = Sensor(extinction=1e9, gains=(1, 1, 1, 1))


def even(s0: float, s1: float, s2: float, size: int = 64) -> np.ndarray:
    return np.tile(np.array([s0, s1, s2])[:, None, None, None], (1, size, size, 3))


def samples(raw: np.ndarray, name: str, angle: int) -> np.ndarray:
    pattern = sensor_pattern(name)
    repeat = [side // pattern.period for side in raw.shape]
    return raw[np.tile(pattern.angles, repeat) == angle].astype(float)


@pytest.mark.parametrize("name", ["IMX250MYR", "IMX250MZR"])
def test_an_ideal_sensor_stores_maluss_law(name: str) -> None:
    raw = mosaic(even(0.8, 0.3, -0.2), name, 0, np.random.default_rng(0), IDEAL)
    assert raw.dtype == np.uint16
    for angle, expected in ((0, 0.55), (45, 0.3), (90, 0.25), (135, 0.5)):
        value = (samples(raw, name, angle) - 64) / (4095 - 64)
        np.testing.assert_allclose(value, expected, atol=2e-4)


def test_faults_have_their_sizes() -> None:
    sensor = Sensor(extinction=99.0, gains=(1.0, 0.9, 1.1, 1.0))
    raw = mosaic(even(0.5, 0.5, 0.0), "IMX250MZR", 0, np.random.default_rng(0), sensor)
    value = {a: (samples(raw, "IMX250MZR", a).mean() - 64) / (4095 - 64) for a in (0, 45, 90, 135)}
    assert value[0] == pytest.approx(0.495, abs=1e-3)
    assert value[90] == pytest.approx(1.1 * 0.005, abs=1e-3)
    assert value[45] / value[135] == pytest.approx(0.9, abs=1e-3)


def test_noise_is_that_of_photons_and_reading() -> None:
    sensor = Sensor()
    for noise in (1.0, 4.0):
        found = noisy(np.full(200000, 0.3), noise, np.random.default_rng(1), sensor)
        electrons = sensor.full_well / noise**2
        expected = np.sqrt(0.3 * electrons + sensor.read_noise**2) / electrons
        assert found.mean() == pytest.approx(0.3, abs=4 * expected / np.sqrt(200000))
        assert found.std() == pytest.approx(expected, rel=0.02)
    assert (noisy(np.full(3, 0.3), 0, np.random.default_rng(1), sensor) == 0.3).all()


def test_values_stop_at_full_scale_and_at_zero() -> None:
    raw = mosaic(even(5.0, 0, 0, 8), "IMX250MYR", 1, np.random.default_rng(0), Sensor())
    assert (raw == 4095).all()
    dark = mosaic(even(0, 0, 0), "IMX250MYR", 1, np.random.default_rng(0), Sensor())
    assert dark.mean() == pytest.approx(64, abs=0.2)

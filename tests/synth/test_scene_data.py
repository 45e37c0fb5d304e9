"""Scenes as data: the presets, what is refused, shapes and textures. No renderer is needed."""

import json
import os
from importlib import resources
from pathlib import Path

import numpy as np
import plyfile
import pytest
from faults import Fault

from polarguide.core.errors import PolarguideError
from polarguide_synth.build import _mesh, area_light_dict, make_mesh
from polarguide_synth.colmap import place_cameras
from polarguide_synth.mesh import Mesh, write_ply
from polarguide_synth.schema import (
    SceneSpec,
    parse_scene,
    read_scene_file,
    require_light,
    require_solid,
    require_unicode,
    with_current_keys,
)
from polarguide_synth.settings import PRESETS, Overrides, find_scene
from polarguide_synth.textures import ENVIRONMENTS, TEXTURES, directions, make_environment, make_texture

SMALL = {
    "name": "small",
    "camera": {"rings": [{"radius": 3, "height": 1}], "views": 9},
    "environment": {"type": "uniform"},
    "things": [{"name": "a", "shape": {"type": "sphere"}}],
}
SHAPES = [
    {"type": "sphere", "radius": 0.5},
    {"type": "box", "size": [1, 2, 3], "bevel": 0.1},
    {"type": "lathe", "profile": [[0, 0], [0.5, 0], [0.5, 1], [0, 1]], "smooth": 0},
    {"type": "rock", "radius": 1, "seed": 3},
    {
        "type": "solid",
        "detail": 32,
        "parts": [
            {"kind": "ellipsoid", "at": [0, 0, 0], "size": [1, 0.7, 0.6], "color": [1, 0, 0]},
            {
                "kind": "capsule",
                "from": [0, 0.3, 0],
                "to": [0, 0.5, 1],
                "radius": 0.2,
                "mirror": "y",
                "color": [0, 0, 1],
            },
            {"kind": "box", "at": [0, 0, -0.6], "size": [0.3, 0.3, 0.3], "cut": True},
        ],
    },
]


def parsed(**changes: object) -> SceneSpec:
    return parse_scene({**json.loads(json.dumps(SMALL)), **changes}, "test", folder=Path())


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_full_scenes(name: str) -> None:
    spec = find_scene(name)
    assert spec.name == name
    assert spec.exposure
    if name != "proof":
        assert spec.about
        assert len(spec.things) >= (5 if spec.object_only else 8)
        assert not all(thing.foreground for thing in spec.things)


def test_a_field_that_is_off_is_not_part_of_the_request() -> None:
    """Folders that were begun before the field existed go on."""
    assert "object_only" not in parsed().data()
    assert parsed(object_only=False) == parsed()
    alone = parsed(object_only=True)
    assert alone.data()["object_only"]
    assert parse_scene(alone.data(), "again", folder=Path()) == alone


def test_keys_of_earlier_versions_are_accepted() -> None:
    color = {"type": "stripes", "colors": [[0, 0, 0]]}
    things = [{"name": "ball", "shape": {"type": "ball"}, "material": {"color": color}}]
    lights = [{"position": [0, 0, 2], "toward": [0, 0, 0], "size": [1, 1], "radiance": [1, 1, 1]}]
    new = {**SMALL, "things": things, "lights": lights}
    old = json.loads(json.dumps(new).replace('"color', '"colour').replace('"toward', '"towards'))
    assert "towards" in json.dumps(old)
    assert parse_scene(old, "old", folder=Path()) == parse_scene(new, "new", folder=Path())


@pytest.mark.parametrize(
    ("changes", "fault"),
    [
        ({"wings": 2}, Fault(found="wings")),
        ({"things": []}, Fault("(things)", "length >= 1", "[]")),
        ({"things": [{"name": "a", "shape": {}}, {"name": "a", "shape": {}}]}, Fault(found="'a', 'a'")),
        ({"things": [{"name": "a"}]}, Fault(expected="field shape")),
        ({"things": [{"name": "a", "shape": {}, "material": {"index": 0.9}}]}, Fault(found="0.9")),
        ({"things": [{"name": "a", "shape": {}, "material": {"type": "cheese"}}]}, Fault(found="cheese")),
        ({"camera": {"rings": []}}, Fault("rings")),
        ({"camera": None}, Fault("camera")),
    ],
)
def test_mistakes_in_a_scene_are_named(changes: dict[str, object], fault: Fault) -> None:
    fault.raised_by(parsed, **changes)


def test_files_that_are_no_scene(tmp_path: Path) -> None:
    Fault("no-such-scene", "figure, kit").raised_by(find_scene, "no-such-scene")
    (tmp_path / "a.json").write_text("{")
    Fault("a.json", "JSON").raised_by(read_scene_file, tmp_path / "a.json")


@pytest.mark.parametrize("name", PRESETS)
def test_presets_use_names_of_today(name: str) -> None:
    text = (resources.files("polarguide_synth") / "presets" / f"{name}.json").read_text("utf-8")
    assert with_current_keys(json.loads(text)) == json.loads(text)


@pytest.mark.parametrize("shape", SHAPES, ids=lambda shape: shape["type"])
def test_shapes_face_outwards(shape: dict[str, object]) -> None:
    mesh = make_mesh(shape, "test")
    a, b, c = (mesh.points[mesh.faces[:, k]] for k in range(3))
    across = np.cross(b - a, c - a)
    assert (a * np.cross(b, c)).sum() > 0  # six times the volume
    full = np.linalg.norm(across, axis=1) > 1e-9
    agree = (across * mesh.normals[mesh.faces].mean(1)).sum(-1) > 0
    assert agree[full].mean() > 0.995
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)


def test_a_painted_solid_keeps_its_colors() -> None:
    mesh = make_mesh(SHAPES[-1], "test")
    colors = mesh.palette[(mesh.uv[:, 0] * len(mesh.palette)).astype(int)]
    top = mesh.points[:, 2] > 0.9
    assert (colors[top] == [0, 0, 1]).all()
    assert len(np.unique(colors, axis=0)) == 2


@pytest.mark.parametrize(
    "shape",
    [
        {"type": "cat"},
        {},
        {"type": "box", "wings": 1},
        {"type": "box", "size": [1, 1, 1], "bevel": 5},
        {"type": "lathe", "profile": [[-1, 0], [1, 1]]},
        {"type": "solid", "parts": [{"kind": "x", "at": [0, 0, 0], "size": [1, 1, 1]}]},
    ],
)
def test_mistakes_in_a_shape_are_named(shape: dict[str, object]) -> None:
    Fault("test shape").raised_by(make_mesh, shape, "test")


@pytest.mark.parametrize(
    ("shape", "found"),
    [
        ({"type": "lathe", "profile": [[0, 0]]}, "[1, 2] where points are [2 or more, 2]"),
        ({"type": "lathe", "profile": [[0, 0], [1]]}, "not all 2 numbers"),
        ({"type": "lathe", "profile": "abc"}, "not all 2 numbers"),
        ({"type": "tube", "path": []}, "[0] where points are [2 or more, 3]"),
    ],
)
def test_points_of_a_curve_are_counted(shape: dict[str, object], found: str) -> None:
    Fault("test shape", "the fields of a", found).raised_by(make_mesh, shape, "test")


@pytest.mark.parametrize("kind", [name for name in TEXTURES if name != "image"])
def test_textures_are_reflectances(kind: str) -> None:
    picture = make_texture({"type": kind, "pixels": 64}, "test", Path())
    assert picture.shape == (64, 64, 3)
    assert picture.min() >= 0
    assert picture.max() <= 1
    assert picture.std() > 0.005


@pytest.mark.parametrize("kind", [name for name in ENVIRONMENTS if name != "image"])
def test_environments(kind: str) -> None:
    picture = make_environment({"type": kind, "height": 32}, "test", Path())
    assert picture.shape == (32, 64, 3)
    assert np.isfinite(picture).all()
    assert (picture >= 0).all()


def test_panoramas_turn_to_the_right() -> None:
    d = directions(64)
    np.testing.assert_allclose(d[32, 0], [1, 0, 0], atol=0.05)
    np.testing.assert_allclose(d[32, 32], [0, -1, 0], atol=0.05)
    assert d[0, 0, 2] > 0.99


@pytest.mark.parametrize("data", [{"type": "moon"}, {}, {"type": "sky", "wings": 1}])
def test_mistakes_in_an_environment_are_named(data: dict[str, object]) -> None:
    Fault("environment").raised_by(make_environment, data, "test", Path())


def test_cameras_look_at_the_target() -> None:
    cameras = place_cameras(find_scene("cup").camera, 64, 48, 0)
    assert len(cameras) == 72
    for camera in cameras:
        ahead = camera.rotation[2].numpy()
        toward = np.array([0, 0, 0.42]) - camera.center.numpy()
        assert ahead @ toward / np.linalg.norm(toward) > 0.99
        assert camera.rotation[1, 2] < 0  # y goes down
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=1e-12)


def test_spacing_sets_the_angle_between_neighbors() -> None:
    spec = Overrides(views=5, spacing=10.0).apply(parsed())  # type: ignore[arg-type]
    centers = np.stack([camera.center.numpy() for camera in place_cameras(spec.camera, 64, 48, 0)])
    turns = np.degrees(np.arctan2(centers[:, 1], centers[:, 0])) % 360
    np.testing.assert_allclose(np.diff(turns), 10, atol=3.1)


def test_overrides_reach_foreground_plastic_only() -> None:
    spec = Overrides(roughness=0.3, index=1.7).apply(find_scene("car"))
    for thing, before in zip(spec.things, find_scene("car").things, strict=True):
        changed = thing.foreground and thing.material.type == "plastic"
        assert thing.material.roughness == (0.3 if changed else before.material.roughness)
        assert thing.material.index == (1.7 if changed else before.material.index)
    Fault(expected="above 1 and below 4", found="0.5").raised_by(
        Overrides(index=0.5).apply, find_scene("cup")
    )


def test_ply_files_hold_the_mesh(tmp_path: Path) -> None:
    mesh = make_mesh({"type": "box"}, "test")
    write_ply(tmp_path / "a.ply", mesh)
    data = plyfile.PlyData.read(str(tmp_path / "a.ply"))
    assert len(data["vertex"]) == len(mesh.points)
    assert (np.stack(list(data["face"]["vertex_indices"])) == mesh.faces).all()
    assert isinstance(mesh, Mesh)


@pytest.mark.parametrize("name", ["../../outside/x", "/tmp/x", "a\\b", "a\n", "", ".x", "x" * 101, "con:"])
def test_a_thing_is_called_as_a_file_can_be(name: str) -> None:
    Fault("things[0].name").raised_by(parsed, things=[{"name": name, "shape": {"type": "sphere"}}])


@pytest.mark.parametrize(
    ("changes", "where"),
    [({"camera": {"rings": [{"radius": 3, "height": 1}], "views": 10**9}}, "views"),
     ({"camera": {"rings": [{"radius": 0, "height": 1}]}}, "radius"),
     ({"camera": {"rings": [{"radius": "far", "height": 1}]}}, "radius"),
     ({"camera": {"rings": [{"radius": 3, "height": 1e300}]}}, "height"),
     ({"camera": {"rings": [{"radius": 3, "height": 1, "share": 0}]}}, "rings"),
     ({"depth": 10**9}, "depth"), ({"exposure": 0}, "exposure"),
     ({"things": [{"name": "a", "shape": {"type": "sphere"}, "scale": 0}]}, "scale"),
     ({"things": [{"name": "a", "shape": {"type": "sphere", "radius": 1e300}}]}, "shape.radius"),
     ({"things": [{"name": "a", "shape": {"type": "sphere", "detail": 10**6}}]}, "shape.detail"),
     ({"things": [{"name": "a", "shape": {"type": "tube", "path": [[0, 0, 0]] * 2000}}]}, "shape.path"),
     ({"environment": {"type": "uniform", "radiance": [1e30, 1, 1]}}, "environment"),
     ({"exposure": 1e-30}, "exposure"), ({"clamp": 1e30}, "clamp"),
     ({"camera": {"rings": [{"radius": 3, "height": 1}], "spacing": 0}}, "spacing"),
     *(({"things": [{"name": "a", "shape": {"type": "sphere"}, "material": {"color": color}}]}, "material.color")
       for color in ("red", [1, 1], [1, 1, 1, 1], [2, 0, 0], [-1, 0, 0], [True, 0, 0], None)),
     *(({"things": [{"name": "a", "shape": {"type": "sphere"}, "material": {"type": "metal", **index}}]}, "material")
       for index in ({"eta": [0, 1, 1]}, {"k": [-1, 1, 1]}))],
)  # fmt: skip
def test_numbers_out_of_all_bounds_are_named(changes: dict[str, object], where: str) -> None:
    Fault(where).raised_by(parsed, **changes)


def test_light_that_is_none_and_objects_without_an_extent_are_named() -> None:
    for wrong in (-np.ones((2, 4, 3)), np.full((2, 4, 3), np.nan), np.ones((2, 4))):
        Fault("test", "finite radiance").raised_by(require_light, wrong, "test")
    for points in (np.zeros((0, 3)), np.ones((5, 3)), np.full((5, 3), np.inf)):
        Fault("test", "with an extent").raised_by(require_solid, points, "test")


def test_a_name_that_is_no_text_is_refused_before_the_renderer_sees_it(tmp_path: Path) -> None:
    require_unicode(tmp_path / "r\u00e4ume")
    Fault(expected="a name in UTF-8").raised_by(require_unicode, tmp_path / os.fsdecode(b"\xff"))


@pytest.mark.parametrize(
    ("shape", "where"),
    [
        ({"type": "ball", "foo": 1}, "foo"),
        ({"type": "ball", "radius": 0}, "radius"),
        ({"type": "ball", "radius": True}, "radius"),
        ({"type": "mesh", "file": "a.ply", "size": 1}, "size"),
        ({"type": "mesh"}, "file"),
    ],
)
def test_fields_of_balls_and_files_are_checked(shape: dict[str, object], where: str) -> None:
    scene = parsed(things=[{"name": "a", "shape": shape}])
    with pytest.raises(PolarguideError, match=where) as caught:
        _mesh(scene.things[0], scene)
    assert str(caught.value.where).startswith("a shape")


@pytest.mark.parametrize(
    "change",
    [{"toward": [0, 0, 5]}, {"size": [0, 1]}, {"position": [0, 0]}, {"radiance": [-1, 0, 0]}, {"radiance": [1]}],
)  # fmt: skip
def test_lamps_that_are_none_are_named(change: dict[str, object]) -> None:
    pytest.importorskip("mitsuba", reason="no Mitsuba -> pip install '.[synth]'")
    light = {"position": [0, 0, 5], "toward": [0, 0, 0], "size": [1, 1], "radiance": [1, 1, 1]}
    Fault("small (lights)").raised_by(area_light_dict, {**light, **change}, 0, "small")

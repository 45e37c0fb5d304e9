"""Splats as glTF: what the file holds, in whose axes and colors, and what the validator of Khronos says of all GLB."""

import json
import os
import shutil
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from glb_files import read_glb
from random_runs import random_state

import polarguide
from polarguide.capture.presentation import Presentation, write_presentation
from polarguide.core.options import ModelOptions
from polarguide.gaussians.harmonics import SH_C0
from polarguide.gaussians.ply import read_ply
from polarguide.optics.color import srgb_decode_array
from polarguide.results.export.splats import COLOR_SPACES, EXTENSION, write_splat_glb
from polarguide.runs.model import write_run_ply

MODULES = Path(os.environ.get("NODE_PATH", Path(__file__).resolve().parents[3] / "build/node/node_modules"))
NODE = shutil.which("node")
VALIDATE = """
const validator = require("gltf-validator"), file = require("fs").readFileSync(process.argv[1]);
validator.validateBytes(new Uint8Array(file), { maxIssues: 0 }).then((r) => console.log(JSON.stringify(r.issues)));
"""
FLOAT = 5126
ATTRIBUTES = {
    "POSITION": "VEC3",
    f"{EXTENSION}:ROTATION": "VEC4",
    f"{EXTENSION}:SCALE": "VEC3",
    f"{EXTENSION}:OPACITY": "SCALAR",
    **{f"{EXTENSION}:SH_DEGREE_{n}_COEF_{k}": "VEC3" for n in range(4) for k in range(2 * n + 1)},
}
"""Attributes of the kernel ``ellipse`` with their accessor types, from the section Attributes of the specification."""
PROPERTIES = {
    "kernel": {"ellipse"},
    "colorSpace": {"srgb_rec709_display", "lin_rec709_display"},
    "projection": {"perspective"},
    "sortingMethod": {"cameraDistance"},
}
"""Values in ``mesh.primitive.KHR_gaussian_splatting.schema.json`` of KhronosGroup/glTF."""
UNKNOWN = "MESH_PRIMITIVE_INVALID_ATTRIBUTE"
"""The validator's code for attributes of an extension that it does not know."""


@pytest.mark.parametrize("encoding", COLOR_SPACES)
def test_the_file_holds_what_the_extension_wants(encoding: Any, tmp_path: Path) -> None:
    """Scales and opacities are no logarithms, quaternions end in w, and each harmonic is an attribute."""
    state, shading = random_state("3dgs-dr", 9)
    write_run_ply(tmp_path / "a.ply", state, shading, linear=encoding == "linear")
    write_splat_glb(tmp_path / "a.glb", tmp_path / "a.ply", {"generator": "test"}, encoding)
    ply, (tree, found) = read_ply(tmp_path / "a.ply"), read_glb(tmp_path / "a.glb")
    primitive = tree["meshes"][0]["primitives"][0]
    assert primitive["mode"] == 0
    about = primitive["extensions"][EXTENSION]
    assert about["colorSpace"] == COLOR_SPACES[encoding]
    assert about.keys() == PROPERTIES.keys()
    assert all(about[name] in values for name, values in PROPERTIES.items())
    accessors = {name: tree["accessors"][number] for name, number in primitive["attributes"].items()}
    assert {name: each["type"] for name, each in accessors.items()} == ATTRIBUTES
    assert {each["componentType"] for each in accessors.values()} == {FLOAT}
    assert tree["extensionsUsed"] == [EXTENSION]
    values = {name.removeprefix(EXTENSION + ":"): each for name, each in found.items()}
    np.testing.assert_array_equal(values["POSITION"], ply["means"])
    np.testing.assert_allclose(values["SCALE"], ply["log_scales"].exp().numpy(), rtol=1e-6)
    np.testing.assert_allclose(
        values["OPACITY"][:, 0], torch.sigmoid(ply["opacity_logits"]).numpy(), rtol=1e-5
    )
    quaternions = torch.nn.functional.normalize(ply["quaternions"], dim=1).numpy()
    np.testing.assert_allclose(values["ROTATION"], np.roll(quaternions, -1, axis=1), atol=1e-6)
    np.testing.assert_array_equal(values["SH_DEGREE_0_COEF_0"], ply["sh_dc"][:, 0])
    for number, name in ((0, "SH_DEGREE_1_COEF_0"), (3, "SH_DEGREE_2_COEF_0"), (14, "SH_DEGREE_3_COEF_6")):
        np.testing.assert_array_equal(values[name], ply["sh_rest"][:, number])
    assert len(values) == 4 + 16


def means(colors: np.ndarray) -> np.ndarray:
    """Mean color of all splats, as far as it does not depend on the view, from harmonics of degree 0."""
    return np.asarray((0.5 + SH_C0 * colors).mean(axis=0))


def test_both_variants_show_the_same_upright_and_balanced(trained: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(trained, tmp_path / "copy"))
    write_presentation(copy, Presentation(up_axis=(0.0, 0.3, 1.0), meters_per_unit=0.5, whole=True))
    read = {}
    for name, gains in (("as it is", None), ("balanced", (1.0, 0.5, 1.0))):
        if gains:
            write_presentation(
                copy,
                Presentation(white_balance=gains, up_axis=(0.0, 0.3, 1.0), meters_per_unit=0.5, whole=True),
            )
        out = tmp_path / name
        polarguide.open_run(copy).export("splat-glb", out)
        assert sorted(path.name for path in out.iterdir()) == ["splats-linear.glb", "splats-srgb.glb"]
        read[name] = {kind: read_glb(out / f"splats-{kind}.glb")[1] for kind in COLOR_SPACES}
    place = read_ply(copy / "point_cloud.ply")["means"].double().numpy()
    up = np.array([0.0, 0.3, 1.0]) / np.hypot(0.3, 1.0)
    for kind in COLOR_SPACES:
        found = read["as it is"][kind]["POSITION"].astype(float)
        np.testing.assert_allclose(found[:, 1], 0.5 * place @ up, atol=1e-4 * np.abs(place).max())
        np.testing.assert_allclose(
            np.linalg.norm(found, axis=1), 0.5 * np.linalg.norm(place, axis=1), rtol=1e-4
        )
    srgb, linear = (
        {name: means(files[kind][f"{EXTENSION}:SH_DEGREE_0_COEF_0"]) for name, files in read.items()}
        for kind in ("srgb", "linear")
    )
    np.testing.assert_allclose(srgb_decode_array(srgb["as it is"]), linear["as it is"], rtol=0.3)
    np.testing.assert_allclose(linear["balanced"], linear["as it is"] * [1, 0.5, 1], rtol=0.02)
    assert srgb["balanced"][1] < 0.85 * srgb["as it is"][1]
    np.testing.assert_allclose(srgb["balanced"][[0, 2]], srgb["as it is"][[0, 2]], rtol=1e-5)


@pytest.mark.skipif(
    NODE is None or not (MODULES / "gltf-validator").is_dir(),
    reason="no gltf-validator -> apt-get install nodejs npm; make test",
)
@pytest.mark.parametrize("kind", ["mesh", "glb", "splat-glb"])
def test_the_validator_has_nothing_to_say(kind: Any, trained: Path, tmp_path: Path) -> None:
    """No error and no warning; of splats none but that it does not know their extension."""
    assert NODE is not None
    opened = polarguide.open_run(trained)
    for unlit in (False, True)[: 1 + (kind == "glb")]:
        small = ModelOptions(triangles=500, texture=128, unlit=unlit)
        opened.export(kind, tmp_path, resolution=32, model=small)
    files = sorted(tmp_path.glob("*.glb"))
    assert len(files) == (1 if kind == "mesh" else 2)
    for path in files:
        environment = {**os.environ, "NODE_PATH": str(MODULES)}
        command = [NODE, "-e", VALIDATE, str(path)]
        said = json.loads(subprocess.run(command, capture_output=True, check=True, env=environment).stdout)
        serious = [each for each in said["messages"] if each["severity"] <= 1]
        if kind == "splat-glb":
            serious = [
                each for each in serious if each["code"] != UNKNOWN or f"/{EXTENSION}:" not in each["pointer"]
            ]
        assert not serious, path.name

"""Export of models and splats as USDZ packages, +y up, with an explicit ``metersPerUnit``.

The default unit of USD is the centimeter.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from polarguide.core.errors import PolarguideError, optional_import
from polarguide.core.files import temporary_folder, write_whole
from polarguide.gaussians.ply import read_ply
from polarguide.results.export.model.gltf import Textured, encoded

ROOT = "/model"
WHAT = "a USDZ package"


def write_usdz(path: Path, model: Textured, about: dict[str, Any], *, jpeg: bool) -> None:
    """Write a textured mesh with a UsdPreviewSurface. An unlit mesh emits its color.

    Args:
        path: the file.
        model: the mesh, +y up.
        about: custom data of the stage.
        jpeg: encode base color, roughness and metalness as JPEG instead of PNG.

    Raises:
        PolarguideError: usd-core is not installed, or the file cannot be written.
    """
    vt = _module("Vt")
    geom = _module("UsdGeom")
    sdf = _module("Sdf")

    def fill(stage: Any, folder: Path) -> None:
        mesh = geom.Mesh.Define(stage, f"{ROOT}/mesh")
        points = vt.Vec3fArray.FromNumpy(model.vertices.astype("f4"))
        mesh.CreatePointsAttr(points)
        mesh.CreateExtentAttr(geom.PointBased.ComputeExtent(points))
        mesh.CreateFaceVertexCountsAttr([3] * len(model.faces))
        mesh.CreateFaceVertexIndicesAttr(vt.IntArray.FromNumpy(model.faces.ravel().astype("i4")))
        mesh.CreateNormalsAttr(vt.Vec3fArray.FromNumpy(model.normals.astype("f4")))
        mesh.SetNormalsInterpolation("vertex")
        mesh.CreateSubdivisionSchemeAttr("none")
        uv = model.uv.astype("f4")
        uv[:, 1] = 1 - uv[:, 1]  # In USD v starts at the last row.
        coordinates = geom.PrimvarsAPI(mesh).CreatePrimvar("st", sdf.ValueTypeNames.TexCoord2fArray, "vertex")
        coordinates.Set(vt.Vec2fArray.FromNumpy(uv))
        _bind(stage, mesh, model, folder, jpeg=jpeg)

    _package(path, about, fill)


def _bind(stage: Any, mesh: Any, model: Textured, folder: Path, *, jpeg: bool) -> None:
    shade = _module("UsdShade")
    types = _module("Sdf").ValueTypeNames
    material = shade.Material.Define(stage, f"{ROOT}/material")

    def shader(name: str, kind: str, **inputs: tuple[Any, Any]) -> Any:
        node = shade.Shader.Define(stage, f"{ROOT}/material/{name}")
        node.CreateIdAttr(kind)
        for key, (type_name, value) in inputs.items():
            node.CreateInput(key, type_name).Set(value)
        return node

    def texture(name: str, pixels: Any, space: str) -> Any:
        kind, data = encoded(pixels, jpeg=jpeg)
        file = f"{name}.{'jpg' if kind.endswith('jpeg') else 'png'}"
        (folder / file).write_bytes(data)
        clamp = (types.Token, "clamp")
        node = shader(
            name,
            "UsdUVTexture",
            file=(types.Asset, f"./{file}"),
            sourceColorSpace=(types.Token, space),
            wrapS=clamp,
            wrapT=clamp,
        )
        node.CreateInput("st", types.Float2).ConnectToSource(coordinates.CreateOutput("result", types.Float2))
        return node

    coordinates = shader("st", "UsdPrimvarReader_float2", varname=(types.String, "st"))
    surface = shader("surface", "UsdPreviewSurface", ior=(types.Float, model.index))
    color = texture("color", model.base_color, "sRGB").CreateOutput("rgb", types.Float3)
    if model.surface is None:
        surface.CreateInput("diffuseColor", types.Color3f).Set((0, 0, 0))
        surface.CreateInput("emissiveColor", types.Color3f).ConnectToSource(color)
        surface.CreateInput("roughness", types.Float).Set(1.0)
    else:
        surface.CreateInput("diffuseColor", types.Color3f).ConnectToSource(color)
        values = texture("reflection", model.surface, "raw")
        for name, channel in (("roughness", "g"), ("metallic", "b")):
            surface.CreateInput(name, types.Float).ConnectToSource(values.CreateOutput(channel, types.Float))
    material.CreateSurfaceOutput().ConnectToSource(surface.CreateOutput("surface", types.Token))
    shade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)


def write_splat_usdz(path: Path, ply: Path, about: dict[str, Any]) -> None:
    """Write splats as a ``ParticleField3DGaussianSplat``, without the fields that only this program uses.

    Args:
        path: the file.
        ply: file from ``write_run_ply``, +y up.
        about: custom data of the stage.

    Raises:
        PolarguideError: usd-core is missing or does not support splats, or the file cannot be written.
    """
    vt = _module("Vt")
    kind = getattr(_module("UsdVol"), "ParticleField3DGaussianSplat", None)
    if kind is None:
        raise PolarguideError(
            "usd-core",
            expected="a version with ParticleField3DGaussianSplat",
            found="an older version",
            remedy="Run pip install -U usd-core.",
        )
    gaussians = read_ply(ply)
    harmonics = torch.cat((gaussians["sh_dc"], gaussians["sh_rest"]), dim=1).reshape(-1, 3)
    # USD stores the real part last.
    quaternions = torch.nn.functional.normalize(gaussians["quaternions"], dim=1)[:, [1, 2, 3, 0]]
    scales = gaussians["log_scales"].exp()
    reach = 3 * scales.amax(dim=1, keepdim=True)
    corners = torch.stack(
        ((gaussians["means"] - reach).amin(dim=0), (gaussians["means"] + reach).amax(dim=0))
    )

    def fill(stage: Any, _: Path) -> None:
        field = kind.Define(stage, f"{ROOT}/splats")
        vectors = {
            "Positions": gaussians["means"],
            "Extent": corners,
            "Scales": scales,
            "RadianceSphericalHarmonicsCoefficients": harmonics,
        }
        for name, values in vectors.items():
            getattr(field, f"Create{name}Attr")(vt.Vec3fArray.FromNumpy(values.numpy()))
        field.CreateOrientationsAttr(vt.QuatfArray.FromNumpy(quaternions.contiguous().numpy()))
        field.CreateOpacitiesAttr(vt.FloatArray.FromNumpy(torch.sigmoid(gaussians["opacity_logits"]).numpy()))
        field.CreateRadianceSphericalHarmonicsDegreeAttr(3)

    _package(path, about, fill)


def _module(name: str) -> Any:
    return optional_import(f"pxr.{name}", WHAT)


def _package(path: Path, about: dict[str, Any], fill: Callable[[Any, Path], None]) -> None:
    """Write a USD stage as a package.

    The function ``fill`` adds content to the stage. It may write textures into the folder that it receives.
    """
    usd, geom, utils, sdf = (_module(name) for name in ("Usd", "UsdGeom", "UsdUtils", "Sdf"))
    with temporary_folder(path.with_suffix(".parts")) as folder:
        stage = usd.Stage.CreateNew(str(folder / "model.usdc"))
        geom.SetStageUpAxis(stage, geom.Tokens.y)
        geom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetDefaultPrim(geom.Xform.Define(stage, ROOT).GetPrim())
        stage.GetRootLayer().customLayerData = about
        fill(stage, folder)
        stage.Save()
        package = folder / "package.usdz"
        if not utils.CreateNewUsdzPackage(sdf.AssetPath(str(folder / "model.usdc")), str(package)):
            raise PolarguideError(
                path, expected="a USDZ package", found="none", remedy="Free space on the disk."
            )
        write_whole(path, package.read_bytes())

"""Draw a model from cameras into EXR files of radiance. ``blender.py`` runs this in the environment with bpy."""

import json
import math
import sys
from pathlib import Path

import bpy
from mathutils import Matrix

UPRIGHT = Matrix(((1, 0, 0, 0), (0, 0, -1, 0), (0, 1, 0, 0), (0, 0, 0, 1)))  # +y up to +z up


def set_light(scene, environment: str, *, unlit: bool) -> None:
    """Set a panorama as the world's light, with its center toward glTF's -z; black if the model has its own color."""
    scene.world = bpy.data.worlds.new("world")
    scene.world.use_nodes = True
    nodes, links = scene.world.node_tree.nodes, scene.world.node_tree.links
    background = next(node for node in nodes if node.type == "BACKGROUND")
    if unlit:
        background.inputs["Strength"].default_value = 0.0
        return
    texture, place = nodes.new("ShaderNodeTexEnvironment"), nodes.new("ShaderNodeMapping")
    texture.image = bpy.data.images.load(environment)
    texture.image.colorspace_settings.name = "Linear Rec.709"
    place.inputs["Rotation"].default_value = (0, 0, -math.pi / 2)  # Blender has the center at +x
    links.new(nodes.new("ShaderNodeTexCoord").outputs["Generated"], place.inputs["Vector"])
    links.new(place.outputs["Vector"], texture.inputs["Vector"])
    links.new(texture.outputs["Color"], background.inputs["Color"])


def main() -> None:
    """Draw the job of the command line."""
    job = json.loads(Path(sys.argv[1]).read_text())
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    read = bpy.ops.wm.usd_import if job["model"].endswith(".usdz") else bpy.ops.import_scene.gltf
    read(filepath=job["model"])
    set_light(scene, job["environment"], unlit=job["unlit"])
    scene.render.engine = "CYCLES"
    scene.cycles.device, scene.cycles.samples, scene.cycles.use_denoising = "CPU", job["samples"], True
    scene.render.threads_mode, scene.render.threads = "FIXED", 1
    scene.view_settings.view_transform = "Raw"
    scene.render.image_settings.file_format, scene.render.image_settings.color_depth = "OPEN_EXR", "32"
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    camera.data.sensor_fit, camera.data.clip_start = "HORIZONTAL", 0.01
    scene.collection.objects.link(camera)
    scene.camera = camera
    for name, frame in job["frames"].items():
        camera.matrix_world = UPRIGHT @ Matrix(frame["pose"])
        camera.data.lens = frame["lens"] * camera.data.sensor_width
        camera.data.shift_x, camera.data.shift_y = frame["shift"]
        scene.render.resolution_x, scene.render.resolution_y = frame["width"], frame["height"]
        scene.render.resolution_percentage = 100
        scene.render.pixel_aspect_y = frame["stretch"]
        scene.render.filepath = f"{job['out']}/{name}.exr"
        bpy.ops.render.render(write_still=True)


main()

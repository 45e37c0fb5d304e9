"""Compare exported splats in other engines, in a headless Chromium with software WebGL, with our final picture.

    npm install three @babylonjs/core @babylonjs/loaders playcanvas @sparkjsdev/spark esbuild     # anywhere
    pip install '.[browser]'                                               # in polarguide's source folder
    python benchmarks/accuracy/splat_engines.py RUN... --node-modules DIR/node_modules > benchmarks/records/engines.md

Prints a Markdown table with the mean PSNR of display pictures over the first test views: of the subject in each engine,
and of the diffuse layer alone. The diffuse layer is the upper bound of a file without baked reflections.
"""

from __future__ import annotations

import argparse
import base64
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from statistics import fmean
from typing import Any

import cv2
import numpy as np
import torch
from PIL import Image

from polarguide import Run, open_run
from polarguide.capture import View
from polarguide.geometry.camera import Camera
from polarguide.results.export.placement import Presented
from polarguide.visualization import figures
from polarguide.visualization.figures import Picture

FLAGS = (
    "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist"
)
STILL = 6  # equal pictures in a row
NEAR, FAR = 0.01, 1000.0

DRAWS_WITH_THREE = """
  camera.matrixAutoUpdate = false;
  return (frame) => {
    renderer.setSize(frame.width, frame.height, false);
    camera.matrix.fromArray(frame.pose);
    camera.updateMatrixWorld(true);
    camera.projectionMatrix.fromArray(frame.projection);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
    renderer.render(scene, camera);
  };
};
"""

# Each script gets a canvas and a file, and returns a function that draws a camera. The camera has its view and
# pose (camera to world) in OpenGL's axes, its projection, all in the matrix order of WebGL, and its size.
ENGINES = {
    "three": """
import * as THREE from "three/webgpu";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { GLTFGaussianSplatLoaderExtension } from "three/addons/loaders/GLTFGaussianSplatLoaderExtension.js";

export default async (canvas, url) => {
  const renderer = new THREE.WebGPURenderer({ canvas, forceWebGL: true, antialias: false });
  await renderer.init();

  const loader = new GLTFLoader().register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
  scene.background = new THREE.Color(0);
  scene.add((await loader.loadAsync(url)).scene);
"""
    + DRAWS_WITH_THREE,
    "babylon": """
import { Engine } from "@babylonjs/core/Engines/engine.js";
import { Scene } from "@babylonjs/core/scene.js";
import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera.js";
import { Matrix, Vector3 } from "@babylonjs/core/Maths/math.vector.js";
import { Color4 } from "@babylonjs/core/Maths/math.color.js";
import { ImportMeshAsync } from "@babylonjs/core/Loading/sceneLoader.js";
import "@babylonjs/loaders/glTF/2.0/index.js";

export default async (canvas, url) => {
  const engine = new Engine(canvas, false, { preserveDrawingBuffer: true });
  const scene = new Scene(engine);
  scene.useRightHandedSystem = true;
  scene.clearColor = new Color4(0, 0, 0, 1);

  const camera = new FreeCamera("camera", Vector3.Zero(), scene);
  await ImportMeshAsync(url, scene);

  return (frame) => {
    engine.setSize(frame.width, frame.height);

    camera._getViewMatrix = () => Matrix.FromArray(frame.view);
    camera.position = new Vector3(...frame.pose.slice(12, 15));
    camera.getViewMatrix(true);
    camera.freezeProjectionMatrix(Matrix.FromArray(frame.projection));
    scene.render();
  };
};""",
    "playcanvas": """
import * as pc from "playcanvas";

export default async (canvas, url) => {
  const device = await pc.createGraphicsDevice(canvas, {
    deviceTypes: ["webgl2"], antialias: false, preserveDrawingBuffer: true });
  const options = new pc.AppOptions();
  options.graphicsDevice = device;
  options.componentSystems = [pc.RenderComponentSystem, pc.CameraComponentSystem, pc.GSplatComponentSystem];
  options.resourceHandlers = [pc.ContainerHandler, pc.TextureHandler];

  const app = new pc.AppBase(canvas);
  app.init(options);
  app.setCanvasFillMode(pc.FILLMODE_NONE);
  app.autoRender = false;
  app.start();

  const asset = await new Promise((resolve, reject) =>
    app.assets.loadFromUrl(url, "container", (error, asset) => error ? reject(error) : resolve(asset)));
  app.root.addChild(asset.resource.instantiateRenderEntity());
  const camera = new pc.Entity();
  camera.addComponent("camera", { clearColor: new pc.Color(0, 0, 0, 1) });
  app.root.addChild(camera);

  return (frame) => {
    app.resizeCanvas(frame.width, frame.height);
    device.setResolution(frame.width, frame.height);

    const pose = new pc.Mat4();
    pose.data.set(frame.pose);
    camera.setPosition(pose.getTranslation());
    camera.setRotation(new pc.Quat().setFromMat4(pose));
    camera.camera.calculateProjection = (matrix) => matrix.data.set(frame.projection);
    app.update(0);
    app.render();
  };
};""",
    "spark": """
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";

export default async (canvas, url) => {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera();
  scene.add(new SparkRenderer({ renderer, maxStdDev: 3.33, minAlpha: 1 / 255 }));
  const mesh = new SplatMesh({ url });
  if (url.endsWith(".spz")) mesh.quaternion.set(1, 0, 0, 0);  // own axes (right, up, back) to the world's axes
  scene.add(mesh);
  await mesh.initialized;
"""
    + DRAWS_WITH_THREE,
}
FILES = {
    "three": ("splat-glb", "splats-linear.glb"),
    "babylon": ("splat-glb", "splats-srgb.glb"),
    "playcanvas": ("splat-glb", "splats-srgb.glb"),
    "spark": ("ply", "splats.ply"),
}
"""Export format and file of each engine. ``--file`` replaces it."""
TITLES = {"three": "three.js", "babylon": "Babylon", "playcanvas": "PlayCanvas", "spark": "Spark"}
MAIN = """
import start from "./engine.js";
const canvas = document.querySelector("canvas");

// A worker sorts between frames. The picture is complete when it has not changed for several frames.
window.show = async (frame, still, wait) => {
  window.draw ??= await start(canvas, "/" + frame.file);

  let now = "";
  for (let same = 0, before = ""; same < still; ) {
    window.draw(frame);
    now = canvas.toDataURL("image/png");
    same = now === before ? same + 1 : 0;
    before = now;
    await new Promise((resolve) => setTimeout(resolve, wait));
  }
  return now;
};
window.ready = true;
"""
PAGE = (
    '<!doctype html><meta charset="utf-8"><canvas></canvas><script type="module" src="/bundle.js"></script>'
)


def frame_of(camera: Camera, axes: torch.Tensor) -> dict[str, Any]:
    """Return a camera of the scene for the engines. ``axes`` [3, 3] turns the scene's directions into the file's."""
    flip = np.diag([1.0, -1.0, -1.0])
    view = np.eye(4)
    view[:3, :3] = flip @ (camera.rotation @ axes.T).numpy()
    view[:3, 3] = flip @ camera.translation.numpy()
    projection = np.zeros((4, 4))
    projection[0, 0], projection[1, 1] = 2 * camera.fx / camera.width, 2 * camera.fy / camera.height
    projection[0, 2] = 1 - 2 * camera.cx / camera.width
    projection[1, 2] = 2 * camera.cy / camera.height - 1
    projection[2, 2:] = -(FAR + NEAR) / (FAR - NEAR), -2 * FAR * NEAR / (FAR - NEAR)
    projection[3, 2] = -1
    matrices = {"view": view, "pose": np.linalg.inv(view), "projection": projection}
    named = {name: matrix.T.flatten().tolist() for name, matrix in matrices.items()}
    return {**named, "width": camera.width, "height": camera.height}


@contextmanager
def browser_page() -> Iterator[Any]:
    """Open an empty page of a headless Chromium with software WebGL. Its errors and warnings are printed."""
    from playwright.sync_api import sync_playwright

    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if chromium is None:
        sys.exit("no Chromium -> apt-get install chromium")
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=FLAGS.split())
        page = browser.new_page()
        page.set_default_timeout(600_000)
        page.on("pageerror", lambda error: print("error in the page:", error, file=sys.stderr))
        page.on("console", report)
        yield page
        browser.close()


def report(message: Any) -> None:
    """Print a warning or an error of a page."""
    if message.type in ("warning", "error"):
        print("message of the page:", message.text[:200], file=sys.stderr)


@contextmanager
def engine_page(engine: str, file: Path, modules: Path, folder: Path) -> Iterator[Any]:
    """Open a page of an engine that has ``show``. The file is served under its name."""
    (folder / "node_modules").symlink_to(modules.resolve())
    (folder / "engine.js").write_text(ENGINES[engine])
    (folder / "main.js").write_text(MAIN)
    bundler = [
        str(modules / ".bin" / "esbuild"),
        "main.js",
        "--bundle",
        "--format=esm",
        "--outfile=bundle.js",
    ]
    subprocess.run([*bundler, "--log-level=error"], cwd=folder, check=True)
    answers = {
        "": PAGE.encode(),
        "bundle.js": (folder / "bundle.js").read_bytes(),
        file.name: file.read_bytes(),
    }
    kinds = {"": "text/html", "bundle.js": "text/javascript"}

    def answer(route: Any) -> None:
        name = route.request.url.split("/", 3)[3]
        if name in answers:
            route.fulfill(body=answers[name], content_type=kinds.get(name, "application/octet-stream"))
        else:
            route.abort()

    with browser_page() as page:
        page.route("**/*", answer)
        page.goto("http://localhost/")
        page.wait_for_function("window.ready")
        yield page


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Return the PSNR of two uint8 pictures in dB."""
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9)))


def drawn_by(
    engine: str, run: Run, path: Path, views: Sequence[View], modules: Path, wait: int
) -> list[Picture]:
    """Return the pictures of a file by an engine, from the cameras of views."""
    upright = path.suffix == ".glb"
    axes = run.frame.panorama_axes().T if upright else torch.eye(3, dtype=torch.float64)
    pictures = []
    with tempfile.TemporaryDirectory() as folder, engine_page(engine, path, modules, Path(folder)) as page:
        for view in views:
            frame = {**frame_of(view.camera, axes), "file": path.name}
            call = "([text, still, wait]) => show(JSON.parse(text), still, wait)"
            address = page.evaluate(call, [json.dumps(frame), STILL, wait])
            pictures.append(decoded(address))
    return pictures


def decoded(address: str) -> Picture:
    """Return the picture of a data URL with a PNG file."""
    data = np.frombuffer(base64.b64decode(address.split(",")[1]), np.uint8)
    return np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])


def compared(run: Run, arguments: argparse.Namespace) -> tuple[str, list[Picture]]:
    """Return the row of a run in the table, and pictures of the first view: ours, then those of the engines."""
    views = run.scene.test_views[: arguments.views]
    within = Presented(run).subject.holds
    results = [run.result(view.camera, within=within).to("cpu") for view in views]
    ours = [figures.radiance_to_rgb(result.final) for result in results]
    layers = [r.base if r.diffuse is None else r.diffuse for r in results]
    scores = []
    shown = ours[:1]
    for engine in arguments.engines:
        with tempfile.TemporaryDirectory() as folder:
            kind, file = FILES[engine]
            path = arguments.file or Path(folder) / file
            if not arguments.file:
                run.export(kind, Path(folder))
            found = drawn_by(engine, run, path, views, arguments.node_modules, arguments.wait)
        scores.append(fmean(map(psnr, found, ours)))
        shown.append(found[0])
    alone = fmean(map(psnr, map(figures.radiance_to_rgb, layers), ours))
    cells = [f"{score:.1f}" for score in (*scores, alone)]
    return f"| {' | '.join((f'`{run.scene.root.name}`', *cells))} |", shown


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--node-modules", type=Path, required=True)
    parser.add_argument(
        "--engines", nargs="+", choices=[*ENGINES], default=["three", "babylon", "playcanvas"]
    )
    parser.add_argument(
        "--file", type=Path, help="this export in place of a new one of the kind that is for the engine"
    )
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--wait", type=int, default=400, help="milliseconds between frames")
    parser.add_argument("--figure", type=Path, help="JPEG to write: a row of pictures for each run")
    arguments = parser.parse_args()
    titles = [TITLES[engine] for engine in arguments.engines]
    print(f"| run of `polarguide-stokes` | {' | '.join(titles)} | diffuse layer alone |")
    print(f"|---|{'---:|' * (len(arguments.engines) + 1)}")
    rows = []
    for folder in arguments.runs:
        row, pictures = compared(open_run(folder), arguments)
        print(row, flush=True)
        rows.append(pictures)
    if arguments.figure:
        sheet = figures.contact_sheet(rows, [""] * len(rows), ["polarguide", *titles], minimum_width=1)
        Image.fromarray(sheet).save(arguments.figure, quality=88)


if __name__ == "__main__":
    main()

"""How an exported file looks in today's viewers: Spark (three.js) in a headless Chromium, against our final picture.

    npm install three @sparkjsdev/spark          # anywhere; say where with --node-modules
    pip install '.[browser]'                     # in polarguide's source folder
    python benchmarks/accuracy/spark.py RUN --node-modules DIR --format ply

For each test view it prints PSNR against the final layer: of the file in Spark, and of the diffuse layer alone, which
is what a file without baked reflections would show at best.
"""

from __future__ import annotations

import argparse
import base64
import json
import shutil
import sys
import tempfile
from pathlib import Path

import cv2
import numpy as np
import torch

from polarguide.api import open_run
from polarguide.results.export.placement import transforms
from polarguide.visualization import figures

FLAGS = (
    "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader --enable-unsafe-swiftshader "
    "--ignore-gpu-blocklist"
)
STILL = 6  # equal pictures in a row
PAGE = """<!doctype html><script type="importmap">{"imports": {"three": "/three/build/three.module.js",
"three/addons/": "/three/examples/jsm/",
"@sparkjsdev/spark": "/@sparkjsdev/spark/dist/spark.module.js"}}</script><script type="module">
import * as THREE from "three";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
const renderer = new THREE.WebGLRenderer({ antialias: false, preserveDrawingBuffer: true });
const scene = new THREE.Scene(), spark = new SparkRenderer({ renderer, maxStdDev: 3.33, minAlpha: 1 / 255 });
scene.add(spark);
const mesh = new SplatMesh({ url: "/FILE" });
if ("FILE".endsWith(".spz")) mesh.quaternion.set(1, 0, 0, 0);  // from its own axes (right, up, back) to the world's
scene.add(mesh);
window.show = async (frame) => {
  await mesh.initialized;
  renderer.setSize(frame.w, frame.h, false);
  const camera = new THREE.PerspectiveCamera(), near = 0.01, far = 1000;
  camera.matrixAutoUpdate = false;
  camera.matrix.set(...frame.transform_matrix.flat());
  camera.updateMatrixWorld(true);
  const left = -frame.cx / frame.fl_x, right = (frame.w - frame.cx) / frame.fl_x;
  const top = frame.cy / frame.fl_y, bottom = (frame.cy - frame.h) / frame.fl_y;
  camera.projectionMatrix.makePerspective(near * left, near * right, near * top, near * bottom, near, far);
  camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  // Sorting happens in a worker, between frames: until the picture has stayed the same for a while.
  for (let same = 0, before = ""; same < STILL; ) {
    renderer.render(scene, camera);
    const now = renderer.domElement.toDataURL("image/png");
    same = now === before ? same + 1 : 0;
    before = now;
    await new Promise((resolve) => setTimeout(resolve, WAIT));
  }
  return renderer.domElement.toDataURL("image/png");
};
window.ready = true;
</script>"""


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Of two uint8 pictures, dB."""
    return float(10 * np.log10(255**2 / max(np.mean((a.astype(float) - b) ** 2), 1e-9)))


def main() -> None:
    """Print a line a view, and the means."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--node-modules", type=Path, required=True)
    parser.add_argument("--format", choices=("ply", "spz", "sog"), default="ply")
    parser.add_argument("--views", type=int, default=3)
    parser.add_argument("--wait", type=int, default=400, help="milliseconds between frames")
    parser.add_argument("--pictures", type=Path, help="folder for Spark's and our pictures")
    arguments = parser.parse_args()
    chromium = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        sys.exit("skipped: Playwright is not installed")
    if chromium is None or not (arguments.node_modules / "@sparkjsdev" / "spark").is_dir():
        sys.exit("skipped: no Chromium, or no @sparkjsdev/spark in --node-modules")
    opened = open_run(arguments.run)
    views = opened.scene.test_views[: arguments.views]
    frames = transforms({view.name: view.camera for view in views})["frames"]
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        opened.export(arguments.format, folder)
        file = f"splats.{arguments.format}"

        def answer(route) -> None:
            name = route.request.url.split("/", 3)[3]
            if not name:
                text = (
                    PAGE.replace("FILE", file)
                    .replace("WAIT", str(arguments.wait))
                    .replace("STILL", str(STILL))
                )
                return route.fulfill(body=text, content_type="text/html")
            path = Path(folder) / file if name == file else arguments.node_modules / name
            kind = "text/javascript" if path.suffix == ".js" else "application/octet-stream"
            return (
                route.fulfill(body=path.read_bytes(), content_type=kind) if path.is_file() else route.abort()
            )

        page = playwright.chromium.launch(executable_path=chromium, args=FLAGS.split()).new_page()
        page.set_default_timeout(600_000)
        page.on("pageerror", lambda error: print("in the page:", error))
        page.route("**/*", answer)
        page.goto("http://localhost/")
        page.wait_for_function("window.ready")
        scores = []
        for view, frame in zip(views, frames, strict=True):
            address = page.evaluate("(text) => show(JSON.parse(text))", json.dumps(frame))
            data = np.frombuffer(base64.b64decode(address.split(",")[1]), np.uint8)
            found = np.ascontiguousarray(cv2.imdecode(data, cv2.IMREAD_COLOR)[..., ::-1])
            result = opened.result(view.camera).to("cpu")
            ours = figures.radiance_to_rgb(result.final)
            diffuse = figures.radiance_to_rgb(result.base if result.diffuse is None else result.diffuse)
            scores.append((psnr(found, ours), psnr(diffuse, ours)))
            print(
                f"{view.name}: {arguments.format} in Spark {scores[-1][0]:.2f} dB, diffuse alone {scores[-1][1]:.2f} dB"
            )
            if arguments.pictures:
                arguments.pictures.mkdir(parents=True, exist_ok=True)
                both = np.concatenate((found, ours), axis=1)
                figures.write_png(arguments.pictures / f"{view.name}_{arguments.format}.png", both)
        mean = torch.tensor(scores).mean(dim=0)
        print(f"mean: {arguments.format} in Spark {mean[0]:.2f} dB, diffuse alone {mean[1]:.2f} dB")


if __name__ == "__main__":
    main()

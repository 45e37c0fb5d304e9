"""Compare the pictures of shared pages, in a headless Chromium with software WebGL, with our renderings.

    pip install '.[browser]'                                               # in polarguide's source folder
    python benchmarks/accuracy/shared_pages.py RUN... > benchmarks/records/shared-pages.md

Prints a Markdown table: for each run the Gaussians of the subject, the size of the page, and the PSNR of the first
held-out view's 8-bit pictures in dB. Normals are blended, as on the page. The specular layer has the page's factor on
its brightness.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from splat_engines import browser_page, decoded, psnr

import polarguide as pg
from polarguide.results.export.placement import Presented
from polarguide.visualization.figures import Picture, layer_picture, radiance_to_rgb

LAYERS = ("final", "specular", "diffuse", "base", "strength", "roughness", "normal")


def pictures_of_page(path: Path, view: str) -> tuple[dict[str, Picture], float]:
    """Return the pictures of a page's layers at the pose of a view, and the factor on the specular layer."""
    with browser_page() as page:
        page.goto(path.as_uri())
        # The policy of the page forbids wait_for_function, which evaluates text.
        while not page.evaluate("document.getElementById('message').hidden"):
            time.sleep(0.1)
        layers = [layer for layer in page.evaluate("polarguide.scene.layers") if layer in LAYERS]
        gloss = page.evaluate("polarguide.scene.gloss")
        addresses = page.evaluate("([v, l]) => polarguide.pictures(v, l)", [view, layers])
    pictures = {layer: decoded(address) for layer, address in zip(layers, addresses, strict=True)}
    return pictures, gloss


def row(run: pg.Run) -> str:
    """Return the row of a run."""
    view = run.scene.test_views[0]
    presented = Presented(run)
    result = run.result(view.camera, surface=False, within=presented.subject.holds)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "page.html"
        run.share(path)
        size = path.stat().st_size
        drawn, gloss = pictures_of_page(path, view.name)
    ours = {layer: layer_picture(result, layer, view.camera) for layer in drawn}
    if "specular" in ours:
        ours["specular"] = radiance_to_rgb(gloss * result.layers["specular"])
    cells = [f"{psnr(drawn[layer], ours[layer]):.1f}" if layer in drawn else "" for layer in LAYERS]
    name = f"`{run.scene.root.name}`, `{run.recipe.name}`"
    count = len(presented.gaussians["means"])
    return f"| {' | '.join((name, f'{count:,}', f'{size / 1e6:.1f} MB', *cells))} |"


def main() -> None:
    print(f"| run | Gaussians | file | {' | '.join(LAYERS)} |\n|---|---:|---:|{'---:|' * len(LAYERS)}")
    for folder in sys.argv[1:]:
        print(row(pg.open_run(folder)), flush=True)


if __name__ == "__main__":
    main()

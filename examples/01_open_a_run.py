"""Open a trained run, list its content, and render a held-out view.

python examples/01_open_a_run.py runs/demo
"""

import sys

import polarguide

run = polarguide.open_run(sys.argv[1])
print(run)

# Parameters of the Gaussians by name, with a row for each Gaussian.
for name, parameters in run.gaussians.items():
    print(f"  {name:16} {list(parameters.shape)}")

# Linear radiance and world normals of a view by its name.
view = run.scene.test_names[0]
layers = run.render(view, layers=["final", "normal", "depth"])
print(f"view {view}: mean radiance {layers['final'].mean():.4f}, median depth {layers['depth'].median():.3f}")

# Scores of polarguide eval or run.evaluate(), if they exist.
try:
    print(f"PSNR of the test views: {run.metrics()['psnr']:.2f} dB")
except polarguide.PolarguideError as error:
    print(error)

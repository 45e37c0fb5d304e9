"""Train on a scene, score it, turn its light, and write pictures, a web page and a point cloud.

python examples/04_train_relight_export.py src/polarguide/data/demo runs/small 400
"""

import sys

import polarguide

scene = polarguide.load_scene(sys.argv[1], downscale=2)
settings = polarguide.TrainSettings(steps=int(sys.argv[3]))
run = polarguide.train(scene, sys.argv[2], recipe="polarguide-stokes", settings=settings)
print(f"PSNR of the test views: {run.evaluate()['psnr']:.2f} dB")
print("written:", run.share(), *run.export("ply"))

run.relight(degrees=90)  # a panorama of your own: run.relight("studio.hdr")
print("relit:", run.write_pictures(layers=["final", "specular"]))

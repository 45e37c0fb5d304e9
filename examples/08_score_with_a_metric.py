"""Score held-out views with a metric of your own: the error of the brightest tenth of the photograph.

python examples/08_score_with_a_metric.py runs/demo
"""

import sys

import torch

import polarguide
from polarguide.results.evaluation.metric import Metric
from polarguide.results.evaluation.target import SceneFacts, ViewTarget


def highlight_error(target, layers):
    """Return the mean error [] of the brightest tenth of the photograph, as a share of full scale."""
    brightness = target.photograph.mean(dim=-1)
    bright = target.valid.mask & (brightness >= brightness.quantile(0.9))
    return (layers["final"] - target.photograph).abs().mean(dim=-1)[bright].mean()


HIGHLIGHTS = Metric(
    "highlight_error", "highlight error", "%", 2, "lower", measure=highlight_error, factor=100
)


if __name__ == "__main__":
    run = polarguide.open_run(sys.argv[1])
    facts = SceneFacts.of(run.scene)
    for view in run.scene.test_views:
        target = ViewTarget.of_view(view, facts, torch.device("cpu"))
        value = HIGHLIGHTS.measure(target, run.render(view.camera))
        print(f"{view.name}: {HIGHLIGHTS.label} {HIGHLIGHTS.text(float(value))}")

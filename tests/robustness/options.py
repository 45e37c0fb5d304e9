"""Options with values that no command should take."""

from __future__ import annotations

from collections.abc import Iterator

from base import EVAL as EVAL_RUN
from base import MOSAICS, TRAIN
from forked import Case

WRONG = {
    "count": ("-1", "1e3", "nan", "99999999999999999999", "x", "", "1.5"),
    "number": ("nan", "inf", "-inf", "1e400", "x", ""),
    "text": ("", "../x", "no such thing", "\u202e", "[bold]"),
}
ACCEPTED = {
    ("path", ""): "no path: pictures of the views",
    ("transfer", ""): "",
}
"""Values that pass, and why."""
VERBS: list[tuple[list[str], dict[str, str]]] = [
    (TRAIN, {
        "count": "steps seed threads downscale views-per-step checkpoint-every viewer-port",
        "number": "refractive-index", "text": "recipe device transfer",
    }),
    (EVAL_RUN, {"count": "threads", "text": "device"}),
    (["render", "run", "--out", "new"], {
        "count": "frames", "number": "rotate-environment", "text": "views layers path environment",
    }),
    (["export", "run", "--out", "new"], {"count": "resolution", "text": "format"}),
    (["priors", "scene", "--out", "new"], {
        "count": "downscale", "number": "refractive-index threshold", "text": "views",
    }),
    (MOSAICS, {
        "count": "bits saturation offset-x seed", "number": "black-level zero",
        "text": "order white-balance sensor calibration dark-frame masks poses intrinsics",
    }),
    (["measure", "mosaics", "--out", "new", "--sensor", "IMX250MYR", "--bits", "16"], {
        "count": "bits saturation offset-x offset-y threads",
        "number": "threshold settle patience idle black-level full-well read-noise snr",
        "text": "roi limits reference calibration dark-frame sensor",
    }),
    (["inspect", "scene", "--out", "new"], {"count": "steps downscale", "number": "refractive-index"}),
    (["compare", "scene", "--out", "new"], {"count": "seeds jobs threads steps", "text": "recipes"}),
]  # fmt: skip
"""Command lines, and the kind of their options' values."""


def option_cases() -> Iterator[Case]:
    """Every option with every value of the wrong kind."""
    for command, options in VERBS:
        for kind, names in options.items():
            for option in names.split():
                for number, value in enumerate(WRONG[kind]):
                    arguments = [*command, f"--{option}", value]
                    name = f"option {command[0]} --{option}={value}"
                    yield Case(name, number, lambda f, r, a=arguments: a, ACCEPTED.get((option, value), ""))

"""Options with values that no command should take, alone and together; names of hosts, layers and films."""

from __future__ import annotations

from pathlib import Path

from base import COMPARE, EVAL, FLAGS, MEASURE, MOSAICS, ONE, READ, RENDER, SHOTS, TRAIN, export
from case import Case, nothing, table

from polarguide_bench.options import BENCH

HELD_BACK = BENCH.held_back[0]
CASES: list[Case] = []
WRONG = {
    "count": ("-1", "1e3", "nan", "9" * 20, "x", "1.5"),
    "number": ("nan", "inf", "-inf", "1e400", "x"),
    "text": ("", "../x", "no such thing", "\u202e", "[bold]"),
}
ACCEPTED = {("path", ""): "no path: pictures of the views"}
"""Values that pass, and why."""
VERBS = (
    (TRAIN, "steps seed threads downscale checkpoint-every viewer-port", "refractive-index",
     "recipe device transfer"),
    (EVAL, "threads", "", "device"),
    ("render run --out new", "frames", "rotate-environment", "views layers path environment"),
    ("export run --out new", "resolution", "", "format layout picture"),
    ("priors scene --out new", "downscale", "refractive-index threshold", "views"),
    (MOSAICS, "bits saturation offset-x seed", "black-level zero",
     "order sensor calibration dark-frame masks poses intrinsics"),
    (MEASURE.replace(f" {ONE}", ""), "bits saturation offset-x offset-y threads",
     "threshold settle patience idle black-level full-well read-noise snr",
     "roi limits reference calibration dark-frame sensor"),
    ("inspect scene --out new", "steps downscale", "refractive-index", ""),
    ("compare scene --out new", "seeds jobs threads steps", "", "recipes"),
)  # fmt: skip
"""Command lines, and their options whose values are counts, numbers and texts."""
# Every option with every value of the wrong kind; in turn, one value of each is always tried.
OPTIONS = [
    (verb, option, kind)
    for verb, *kinds in VERBS for kind, names in zip(WRONG, kinds, strict=True) for option in names.split()
]  # fmt: skip
CASES += [
    Case(f"option {verb.split()[0]} --{option}={value}", nothing, verb, [f"--{option}", value],
         passes=ACCEPTED.get((option, value), ""), ci=number % len(WRONG[kind]) == k)
    for number, (verb, option, kind) in enumerate(OPTIONS) for k, value in enumerate(WRONG[kind])
]  # fmt: skip

# Just outside of what an option may be.
train, priors = TRAIN.replace(f" {FLAGS}", ""), READ.replace(" --views v001 --threads 1", "")
CASES += [
    Case(f"option {command.split()[0]} --{option} {value}", nothing, command, f"--{option} {value}", where=option,
         expected=words, ci=True)
    for command, option, value, words in (
        (train, "threads", "1025", "up to 1024"), (train, "threads", "-1", "0 or more"),
        (TRAIN, "seed", str(2**63), f"up to {2**63 - 1}"), (TRAIN, "seed", "-1", "0 or more"),
        (TRAIN, "refractive-index", "nan", "between 1 and 4"),
        (priors, "threshold", "nan", ""), (MOSAICS, "black-level", "inf", ""), (MOSAICS, "zero", "nan", ""),
    )
]  # fmt: skip

start = f"train scene --out new {FLAGS}"
viewed = f"{TRAIN} --viewer"
hosts = "--allow-host: expected a name"
bound = "the number bounds what is added to those of the beginning"
CASES += table(
    "train with", TRAIN,
    Case("steps of 21 digits", command=start, more=f"--steps {'9' * 21}"),
    Case("memory of nothing", more="--memory 1e-9"),
    Case("one Gaussian", more="--gaussians 1", passes=bound),
    Case("pictures of one pixel", more="--downscale 20", passes="a picture may be small"),
    Case("a host that there is not", command=viewed, more="--viewer-host no.such.host.invalid", prints="viewer's host",
         ci=True),
    Case("a pattern of hosts", command=viewed, more="--allow-host *", prints=hosts, ci=True),
    Case("two hosts in one", command=viewed, more=["--allow-host", "a b"], prints=hosts, ci=True),
    Case("an option that begins like another", command="train -- --out new"),
) + table(
    "view with", "view run",
    Case("a host that no network can have", more=["--host", "xn--\u2603.."], ci=True),
)  # fmt: skip


def _layers_once() -> None:
    assert len(list(Path("new").glob("*_final.png"))) == 2


film = f"render run --path orbit --frames 2 {ONE}"
CASES += table(
    "render with", RENDER,
    Case("layers twice and left out", command=f"render run --out new {ONE}", more="--layers ,final,,final",
         passes="each is written once", check=_layers_once),
    Case("a layer that there is not", command=f"render run --out new {ONE}", more="--layers final,x", ci=True),
    Case("frames without a path", more="--frames 5", ci=True),
    Case("a film as text", command=film, more="--video new.txt", ci=True),
)  # fmt: skip

ablate = "ablate scene --steps 2 --out new"
many = "0" + ",0" * 100_000
CASES += table(
    "option of", COMPARE,
    Case("a scene twice", command=["compare", "scene", *COMPARE.split()[1:]]),
    Case("one recipe twice", command=COMPARE.replace("--recipes 3dgs", "--recipes 3dgs 3dgs"), ci=True),
    Case("a billion seeds", more="--seeds 1000000000", ci=True),
    Case("a comparison against what is no row", more="--against 3dgs-dr"),
    Case("jobs below zero", more="--jobs -3"),
    Case("nothing that an ablation has", command=ablate, more="--only nothing-of-the-kind"),
    Case("a base of a path", command=f"ablate scene --base ../run --out new {ONE}"),
    Case("a mesh of 100000 voxels", command=export("mesh"), more="--resolution 100000", ci=True),
    Case("a diameter of a kilometer", command="scale --diameter 1e9"),
    Case("a scale into a folder that is not there", command="scale --diameter 70 --out no/such/new.svg",
         passes="folders are made", ci=True),
    Case("a scene that is held back", command=f"bench --out new --scenes {HELD_BACK}"),
    Case("an order of 100000 angles", command=SHOTS, more=["--order", many], prints=r"\A.{,1000}\Z", ci=True),
)  # fmt: skip

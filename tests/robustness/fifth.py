"""More of the corpus, by a fifth tester, who knew the documentation alone: files, records and options of all verbs."""

from __future__ import annotations

from collections.abc import Iterator

import fifth_options
import fifth_raw
import fifth_runs
import fifth_scenes
from making import MadeCase

MAKERS = (
    fifth_scenes.record_cases, fifth_scenes.model_cases, fifth_scenes.picture_cases, fifth_scenes.truth_cases,
    fifth_runs.configuration_cases, fifth_runs.checkpoint_cases, fifth_runs.record_cases, fifth_runs.name_cases,
    fifth_raw.mosaic_cases, fifth_raw.shot_cases, fifth_raw.pose_cases, fifth_raw.measure_cases,
    fifth_raw.calibrate_cases,
    fifth_options.train_cases, fifth_options.render_cases, fifth_options.synth_cases, fifth_options.other_cases,
)  # fmt: skip
FOUND = """
cameras.txt: a principal point at 1e9
cameras.txt: a focal length far below a pixel
cameras.txt: no pixels
images.bin: a quaternion that is no number
picture: transparent everywhere
pictures: four angles are one file
pictures: all of every training view is invalid
pictures: all of one training view is invalid
run without test views
run of a scene without a name
run in a folder whose name is no UTF-8: eval
run in a folder whose name is no UTF-8: export environment
run in a folder whose name is no UTF-8: maps
environment that is no number
environment without light
path of two sizes, as a film
scene file of a lathe of one point
scene file of a lathe of lists of all lengths
scene file of a mesh without a suffix
scale into a folder that is not there
""".strip().splitlines()
"""Cases that ended otherwise than they should before what they showed was mended."""
SHARE_OF_OTHERS = 3
"""One of so many of the others is always run, all by ``make fuzz``; those that render or train take seconds each."""
SLOW = ("synth", "eval", "train", "inspect", "share", "export", "render")


def fifth_cases(*, every: bool) -> Iterator[MadeCase]:
    """All cases, or those that are always run."""
    for number, case in enumerate(case for make in MAKERS for case in make()):
        slow = case.command in SLOW and bool(case.accepted)
        if every or case.name.removeprefix("fifth ") in FOUND or (number % SHARE_OF_OTHERS == 0 and not slow):
            yield case

"""More of the corpus, by a tester who had not written the program: every verb, and files as people have them."""

from __future__ import annotations

from collections.abc import Iterator

import further_folders
import further_line
import further_pictures
import further_poses
import further_process
import further_records
from making import MadeCase

MAKERS = (
    further_folders.place_cases, further_folders.name_cases, further_folders.text_cases,
    further_pictures.tiff_cases, further_pictures.other_cases,
    further_poses.nerfstudio_cases, further_poses.metashape_cases, further_poses.idr_cases, further_poses.colmap_cases,
    further_line.option_cases, further_line.limit_cases, further_line.table_cases, further_line.analyzer_cases,
    further_line.calibrate_cases,
    further_records.presentation_cases, further_records.run_cases, further_records.table_cases,
    further_records.synth_cases,
    further_process.process_cases,
)  # fmt: skip


FOUND = """
train into its scene
priors into its scene
mosaic called that is no UTF-8
shots that all are one file
spec.json with a mark of its bytes
mosaic TIFF of 40 pages
mosaic TIFF where white is 0
mosaic TIFF whose directory is at its end, behind a hole
mosaic TIFF of 2 GiB, sparse, with a small picture in it
measure with 5000 digits
measure with noise without a full well
table of a line of another format
table of 10^30 nanoseconds
table whose lines are a link outside
table whose lines are a pipe
table whose pictures go outside
analyzers of vectors of 1e30
analyzers of vectors of 1e-30
analyzers of four polarizers alike
analyzers for priors of a scene
polarizer shots with a lens of two lines
polarizer shots with a lens of a million letters
presentation of a meter of 1e-300
results of two into the folder of one
results of half a character
scene file of a name that leaves
scene file of 10^9 views
scene file of rings of nothing
scene file of a ball of nothing
scene file of a tube of 10^5 points
scene file of negative light
process with no more memory, sharing
process with ranks in words
process with a world of 10^9
scene file of a thing that leaves
measured mosaic of 12000 pixels a side and little memory
process given empty names
transforms.json of 100000 frames
""".strip().splitlines()
"""Cases that ended otherwise than they should before what they showed was mended."""
SHARE_OF_OTHERS = 5
"""One of so many of the others is always run, all cases by ``make fuzz``."""


def further_cases(*, every: bool) -> Iterator[MadeCase]:
    """All cases, or those that are always run."""
    for number, case in enumerate(case for make in MAKERS for case in make()):
        if (
            every
            or case.name.removeprefix("further ") in FOUND
            or (number % SHARE_OF_OTHERS == 0 and case.command != "demo")
        ):
            yield case

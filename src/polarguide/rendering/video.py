"""Pictures one after the other as an MP4 file (H.264)."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from polarguide.errors import PolarguideError, optional_import
from polarguide.files import atomic
from polarguide.visualization.sheet import Picture


def write_video(path: Path, pictures: Iterable[Picture], *, frames_per_second: float) -> int:
    """Write uint8 RGB pictures [H, W, 3] of one size; odd sides lose their last row or column, as H.264 wants.

    Returns:
        How many were written.

    Raises:
        PolarguideError: imageio-ffmpeg is not installed, or the encoder fails.
    """
    encoder = optional_import("imageio_ffmpeg", "--video")
    count = 0
    # The encoder chooses the format by the name's suffix.
    with atomic(path) as temporary:
        named = temporary.with_name(temporary.name + ".mp4")
        writer = None
        try:
            for picture in pictures:
                height, width = (side - side % 2 for side in picture.shape[:2])
                if writer is None:
                    writer = encoder.write_frames(
                        str(named),
                        (width, height),
                        fps=frames_per_second,
                        codec="libx264",
                        macro_block_size=2,
                        output_params=["-crf", "18", "-movflags", "+faststart"],
                    )
                    writer.send(None)
                writer.send(np.ascontiguousarray(picture[:height, :width]))
                count += 1
            if writer is not None:
                writer.close()
                _require_whole(encoder, named, count)
            named.replace(temporary)
        except (OSError, RuntimeError) as error:
            raise PolarguideError(
                path,
                expected="that the video can be encoded",
                found=str(error).strip().splitlines()[-1][:200] if str(error).strip() else "a failure",
                remedy="Make room, choose another place or fewer layers.",
            ) from None
        finally:
            if writer is not None:
                with contextlib.suppress(OSError, RuntimeError):
                    writer.close()  # the encoder would go on to write what is unlinked here
            named.unlink(missing_ok=True)
    return count


def _require_whole(encoder: Any, path: Path, count: int) -> None:
    """Count the pictures of a video: the encoder is another program, whose end on a full disk nobody reports.

    Raises:
        OSError: there are fewer than were written.
    """
    try:
        found, _ = encoder.count_frames_and_secs(path)
    except RuntimeError:  # it cannot be read at all
        found = 0
    if found != count:
        raise OSError(f"a file of {found} of {count} pictures, as on a full disk")

"""A video appears whole or not at all, though another program writes it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from polarguide.core.errors import PolarguideError
from polarguide.results.rendering.film import write_video

encoder = pytest.importorskip("imageio_ffmpeg")
PICTURES = [np.full((16, 16, 3), 40 * k, np.uint8) for k in range(5)]


def test_all_pictures_are_in_it(tmp_path: Path) -> None:
    assert write_video(tmp_path / "a.mp4", PICTURES, frames_per_second=10) == 5
    assert encoder.count_frames_and_secs(tmp_path / "a.mp4")[0] == 5


@pytest.mark.parametrize("share", [0.0, 0.6])
def test_an_encoder_that_ends_on_a_full_disk_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float
) -> None:
    (tmp_path / "a.mp4").write_bytes(b"the older one")
    write_frames = encoder.write_frames

    def cut(name: str, *given: object, **options: object) -> Iterator[object]:
        inner = write_frames(name, *given, **options)
        try:
            inner.send(None)
            while True:
                inner.send((yield))
        finally:
            inner.close()
            whole = Path(name).read_bytes()
            Path(name).write_bytes(whole[: int(share * len(whole))])

    monkeypatch.setattr(encoder, "write_frames", cut)
    with pytest.raises(PolarguideError, match=r"a\.mp4: .* of 5 pictures, as on a full disk.* Make room"):
        write_video(tmp_path / "a.mp4", PICTURES, frames_per_second=10)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mp4"]
    assert (tmp_path / "a.mp4").read_bytes() == b"the older one"


def test_pictures_that_fail_leave_nothing(tmp_path: Path) -> None:
    def pictures() -> Iterator[np.ndarray]:
        yield from PICTURES
        raise PolarguideError("path", expected="cameras", found="none", remedy="Give some.")

    with pytest.raises(PolarguideError, match="path: expected cameras"):
        write_video(tmp_path / "a.mp4", pictures(), frames_per_second=10)
    time.sleep(0.3)  # an encoder that goes on would write by now
    assert list(tmp_path.iterdir()) == []

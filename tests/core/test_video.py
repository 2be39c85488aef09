"""Videos: what is written is what was given, the same bytes every time, whole or not at all."""

import os
import subprocess
import sys

import av
import numpy as np
import pytest
from PIL import Image

from surgicai_vision.core.errors import BadFile, InputError
from surgicai_vision.core.video import read_video, write_animation, write_video


def moving(count, height=64, width=96):
    """A bright square that moves over a ramp."""
    ramp = np.linspace(20, 200, width).astype(np.uint8)
    frames = np.repeat(np.tile(ramp, (height, 1))[None, ..., None], count, axis=0).repeat(3, axis=3)
    for index, frame in enumerate(frames):
        frame[8:24, 2 * index : 2 * index + 16] = (250, 120, 30)
    return frames


def test_frames_come_back_in_order_and_nearly_as_they_were(tmp_path):
    frames = moving(30)
    assert write_video(tmp_path / "new" / "a.mp4", iter(frames), 25) == 30
    found = read_video(tmp_path / "new" / "a.mp4")
    assert found.shape == frames.shape
    distances = np.abs(found[:, None].astype(int) - frames[None]).mean(axis=(2, 3, 4))
    assert (distances.argmin(axis=1) == np.arange(30)).all()
    assert np.diag(distances).max() < 4


def test_the_file_is_one_that_browsers_play(tmp_path):
    write_video(tmp_path / "a.mp4", moving(3), 12.5)
    with av.open(str(tmp_path / "a.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 12.5
    content = (tmp_path / "a.mp4").read_bytes()
    assert content.index(b"moov") < content.index(b"mdat"), "it plays while it loads"


def test_the_same_frames_give_the_same_bytes(tmp_path):
    for name in "ab":
        write_video(tmp_path / f"{name}.mp4", moving(12), 25)
    assert (tmp_path / "a.mp4").read_bytes() == (tmp_path / "b.mp4").read_bytes()


WRITE = """
import sys
from pathlib import Path
import numpy as np
from surgicai_vision.core.video import write_video
from surgicai_vision.dataset.video import VideoWriter
frames = np.load("frames.npy")
write_video(Path(sys.argv[1], "one.mp4"), frames, 25)
writer = VideoWriter(Path(sys.argv[1], "dataset.mp4"), "h264", 25, frames.shape[1])
for frame in frames:
    writer.add(frame)
writer.close()
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="glibc's MALLOC_PERTURB_")
def test_what_memory_held_before_does_not_show_in_a_video(tmp_path):
    """`MALLOC_PERTURB_` fills allocated memory, which exposes code that reads it uninitialised."""
    np.save(tmp_path / "frames.npy", moving(12, 96, 96))
    for fill in ("85", "170"):
        (tmp_path / fill).mkdir()
        subprocess.run(
            [sys.executable, "-c", WRITE, fill],
            cwd=tmp_path,
            env=os.environ | {"MALLOC_PERTURB_": fill},
            check=True,
        )
    for name in ("one.mp4", "dataset.mp4"):
        assert (tmp_path / "85" / name).read_bytes() == (tmp_path / "170" / name).read_bytes()


def test_a_failure_leaves_the_earlier_video(tmp_path):
    path = tmp_path / "a.mp4"
    write_video(path, moving(4), 25)
    before = path.read_bytes()
    with pytest.raises(InputError, match="frame 4 has shape"):
        write_video(path, [*moving(4), *moving(1, 32, 32)], 25)
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "frames", "message"),
    [
        ("a.avi", moving(2), "not a .mp4 file"),
        ("a.mp4", [], "no frames"),
        ("a.mp4", moving(2, 63, 64), "63 × 64"),
    ],
)
def test_what_cannot_be_a_video_is_refused(tmp_path, name, frames, message):
    with pytest.raises(InputError, match=message):
        write_video(tmp_path / name, frames, 25)
    assert not list(tmp_path.iterdir())


def test_what_is_no_video_is_said(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"no video")
    with pytest.raises(BadFile, match="cannot be decoded"):
        read_video(tmp_path / "a.mp4")


def test_an_animation_holds_its_frames_in_order_and_runs_for_ever(tmp_path):
    frames = moving(6)
    assert write_animation(tmp_path / "a.webp", frames, 10) == 6
    with Image.open(tmp_path / "a.webp") as animation:
        assert animation.n_frames == 6 and animation.info["loop"] == 0
        for index, frame in enumerate(frames):
            animation.seek(index)
            assert animation.info.get("duration", 100) == 100
            shown = np.asarray(animation.convert("RGB"), np.int16)
            assert np.abs(shown - frame).mean() < 6


def test_what_cannot_be_an_animation_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"not a \.webp file"):
        write_animation(tmp_path / "a.gif", moving(2), 10)
    with pytest.raises(InputError, match="no frames"):
        write_animation(tmp_path / "a.webp", [], 10)
    assert not list(tmp_path.iterdir())

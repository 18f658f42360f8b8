"""The depth that is written for a capture."""

import numpy as np

from tests.prepare import boards
from warpgs.data.writer import write_depth
from warpgs.prepare.cameras.posed_frames import PosedFrames
from warpgs.prepare.depth.estimate import DepthMethod, add_depth, as_half


def test_depth_without_a_known_pixel_is_written_as_unknown(tmp_path):
    write_depth(tmp_path, "a", as_half(np.full((4, 5), np.nan, np.float32)))
    assert np.isnan(np.load(tmp_path / "depth/1x/a.npy")).all()


def test_a_frame_without_any_depth_is_named(tmp_path):
    boards.write_capture(tmp_path, 4)
    cameras = boards.true_cameras(tmp_path, [f"shot{k:03d}" for k in range(4)])

    def estimate(frames: PosedFrames, dynamic: object, weights: None, quiet: bool) -> list[np.ndarray]:
        return [np.full((192, 256), np.nan if k == 2 else 0.5, np.float32) for k in range(4)]

    summary, notes = add_depth(tmp_path, [cameras], DepthMethod(estimate), None, True)
    assert summary == "known on 75% of the pixels"
    assert notes == ["depth is unknown everywhere in shot002"]

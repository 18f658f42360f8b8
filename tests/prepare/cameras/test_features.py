"""Features and matches of COLMAP."""

import numpy as np
import pycolmap

from tests.prepare import boards
from warpgs.prepare.cameras.features import Job, extract_and_match

COUNT = 8


def found(folder, work):
    """The images of the database in the order of their numbers, and the verified matches by pair."""
    work.mkdir()
    names = [f"shot{k:03d}" for k in range(COUNT)]
    job = Job(str(folder), names, str(work), "SIMPLE_RADIAL", None, False, False, None, False)
    extract_and_match(job, lambda *progress: None)
    opened = pycolmap.Database.open(job.database)
    try:
        images = [image.name for image in opened.read_all_images()]
        pairs = zip(*opened.read_two_view_geometries(), strict=True)
        return images, {key: np.asarray(geometry.inlier_matches).tolist() for key, geometry in pairs}
    finally:
        opened.close()


def test_features_and_matches_are_the_same_every_time_whatever_the_threads_do(tmp_path):
    folder = boards.write_folder(tmp_path / "shots", boards.record(COUNT)[0])
    (images, matches), again = (found(folder, tmp_path / work) for work in ("first", "second"))
    assert images == [f"shot{k:03d}.png" for k in range(COUNT)]
    assert len(matches) > COUNT
    assert (images, matches) == again

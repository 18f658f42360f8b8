"""Which Gaussians the numbers in a file are of: they change when a run is trained further or again."""

import hashlib
from typing import NamedTuple

from warpgs.runs.trained import TrainedScene

DIGEST_BYTES = 8
"""Size of a fingerprint [bytes]."""


class Identity(NamedTuple):
    """The Gaussians of a scene.

    Attributes:
        iteration: Of the checkpoint.
        fingerprint: Of the means of the static and dynamic Gaussians, in hexadecimal digits.
    """

    iteration: int
    fingerprint: str


def identity_of(scene: TrainedScene) -> Identity:
    """The identity of a scene that is not edited."""
    digest = hashlib.blake2b(digest_size=DIGEST_BYTES)
    for gaussians in (scene.scene.static, scene.scene.dynamic):
        means = gaussians.means.detach().cpu().contiguous().numpy()
        digest.update(f"{means.shape} ".encode())
        digest.update(means.tobytes())
    return Identity(scene.metadata.iteration, digest.hexdigest())

"""Dynamic masks tracked through the video by SAM 2 (Ravi et al. 2024).

A few masks found by motion are the prompts; the network segments all frames from them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, UInt8
from torch import Tensor
from torch.nn.functional import interpolate

from warpgs.command_line.progress import progress

from ..networks import load, normalized
from ..weights import SAM2

NUM_PROMPTS = 4
"""Number of parts of the sequence that give a prompt each."""

OBJECT_ID = 1
"""Id of the one object that is tracked: everything dynamic."""


def choose_prompts(dynamic: Sequence[Bool[np.ndarray, "H W"]]) -> list[int]:
    """The frames whose masks are prompts: in each part of the sequence the one of median area.

    Parts without dynamic pixels give none.
    """
    chosen = []
    for part in np.array_split(np.arange(len(dynamic)), NUM_PROMPTS):
        by_area = sorted((int(dynamic[k].sum()), int(k)) for k in part if dynamic[k].any())
        if by_area:
            chosen.append(by_area[len(by_area) // 2][1])
    return chosen


@dataclass(frozen=True)
class _Video:
    """The video as the network reads it, converted on access because a frame takes 12 MB."""

    images: Sequence[np.ndarray]
    side: int

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, k: int) -> Tensor:
        return normalized(self.images[k], self.side, self.side)


@torch.inference_mode()
def track(
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    dynamic: Sequence[Bool[np.ndarray, "H W"]],
    weights: Path,
    quiet: bool = True,
) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] true where each image is dynamic according to the network.

    Args:
        images: [H, W, 3] of one size, in temporal order.
        dynamic: [H, W] masks found by motion.
        weights: Folder with the network's weights.
        quiet: Whether to show no progress.

    Raises:
        ValueError: If the weights are damaged.
    """
    prompts = choose_prompts(dynamic)
    if not prompts:
        return list(dynamic)
    network = load(SAM2, weights)
    session = _session(network, images)
    for k in prompts:
        _add_prompt(network, session, k, dynamic[k])
    found: dict[int, np.ndarray] = {}
    for reverse in (False, True):
        steps = network.propagate_in_video_iterator(session, start_frame_idx=prompts[0], reverse=reverse)
        count = prompts[0] if reverse else len(images) - prompts[0]
        for _, step in zip(progress(range(count + reverse), "SAM 2", quiet), steps, strict=False):
            logits = interpolate(step.pred_masks.float(), images[0].shape[:2], mode="bilinear", align_corners=False)
            found[step.frame_idx] = (logits[0, 0] > 0.0).cpu().numpy()
    return [found[k] for k in range(len(images))]


def _session(network: Any, images: Sequence[np.ndarray]) -> Any:
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    height, width = images[0].shape[:2]
    session = Sam2VideoInferenceSession(
        video_height=height, video_width=width, inference_device=network.device, dtype=torch.float32
    )
    session.processed_frames = _Video(images, network.config.image_size)
    return session


def _add_prompt(network: Any, session: Any, frame: int, mask: np.ndarray) -> None:
    side = network.config.image_size
    resized = interpolate(torch.from_numpy(mask)[None, None].float(), (side, side), mode="bilinear", antialias=True)
    session.add_mask_inputs(session.obj_id_to_idx(OBJECT_ID), frame, (resized >= 0.5).float())
    session.obj_with_new_inputs = [OBJECT_ID]
    network(session, frame_idx=frame)

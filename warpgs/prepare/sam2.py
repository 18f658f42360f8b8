"""Masks of what moves, followed through the video by SAM 2 (Ravi et al. 2024), prompted by the masks of motion.

A few masks of motion are given to the network as they are; from them it draws those of all frames between.
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

from warpgs.progress import progress

from .networks import SAM2, load, normalised

PROMPTS = 4
"""Parts of the sequence that give a prompt each."""

BODY = 1
"""Number of the one object that is followed: all that moves."""


def prompted(moving: Sequence[Bool[np.ndarray, "H W"]]) -> list[int]:
    """Frames whose masks are prompts: in each part of the sequence that of median area, neither torn nor swollen.

    Parts in which nothing moves give none.
    """
    chosen = []
    for part in np.array_split(np.arange(len(moving)), PROMPTS):
        by_area = sorted((int(moving[k].sum()), int(k)) for k in part if moving[k].any())
        if by_area:
            chosen.append(by_area[len(by_area) // 2][1])
    return chosen


@dataclass(frozen=True)
class _Frames:
    """The video as the network reads it: made when it is asked for, because it takes 12 MB a frame."""

    images: Sequence[np.ndarray]
    side: int

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, k: int) -> Tensor:
        return normalised(self.images[k], self.side, self.side)


@torch.inference_mode()
def follow(
    images: Sequence[UInt8[np.ndarray, "H W 3"]],
    moving: Sequence[Bool[np.ndarray, "H W"]],
    weights: Path,
    quiet: bool = True,
) -> list[Bool[np.ndarray, "H W"]]:
    """[H, W] true where each picture moves, as the network sees it.

    Args:
        images: [H, W, 3] of one size, in the order of time.
        moving: [H, W] masks of motion.
        weights: Folder of the network's weights.
        quiet: Whether to show no progress.

    Raises:
        ValueError: If the weights are damaged.
    """
    prompts = prompted(moving)
    if not prompts:
        return list(moving)
    network = load(SAM2, weights)
    session = _session(network, images)
    for k in prompts:
        _prompt(network, session, k, moving[k])
    found: dict[int, np.ndarray] = {}
    for backwards in (False, True):
        steps = network.propagate_in_video_iterator(session, start_frame_idx=prompts[0], reverse=backwards)
        count = prompts[0] if backwards else len(images) - prompts[0]
        for _, step in zip(progress(range(count + backwards), "SAM 2", quiet), steps, strict=False):
            logits = interpolate(step.pred_masks.float(), images[0].shape[:2], mode="bilinear", align_corners=False)
            found[step.frame_idx] = (logits[0, 0] > 0.0).cpu().numpy()
    return [found[k] for k in range(len(images))]


def _session(network: Any, images: Sequence[np.ndarray]) -> Any:
    from transformers.models.sam2_video.modeling_sam2_video import Sam2VideoInferenceSession

    height, width = images[0].shape[:2]
    session = Sam2VideoInferenceSession(
        video_height=height, video_width=width, inference_device=network.device, dtype=torch.float32
    )
    session.processed_frames = _Frames(images, network.config.image_size)
    return session


def _prompt(network: Any, session: Any, frame: int, mask: np.ndarray) -> None:
    side = network.config.image_size
    resized = interpolate(torch.from_numpy(mask)[None, None].float(), (side, side), mode="bilinear", antialias=True)
    session.add_mask_inputs(session.obj_id_to_idx(BODY), frame, (resized >= 0.5).float())
    session.obj_with_new_inputs = [BODY]
    network(session, frame_idx=frame)

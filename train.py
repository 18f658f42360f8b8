"""python train.py: renders the built-in scene. Training is not there yet."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import torch
import tyro
from rich.progress import track

from warpgs.config import RenderSettings
from warpgs.render import Layer, Rendering, render
from warpgs.scene.builtin import builtin_camera, builtin_splats


@dataclass(frozen=True)
class PreviewConfig:
    """Renders the built-in scene: joint, static and dynamic image and depth, two by two."""

    out: Path = Path("runs/builtin")
    """Folder for the pictures."""
    frames: int = 8
    """Moments to render, spread over the scene's time."""
    device: Literal["cpu", "cuda"] = "cuda" if torch.cuda.is_available() else "cpu"
    """Where to render; CUDA if there is a GPU."""


def contact_sheet(rendering: Rendering) -> np.ndarray:
    """Joint, static, dynamic image and joint depth (near is bright), two by two, as 8-bit BGR."""

    def picture(image: torch.Tensor) -> np.ndarray:
        return (image.detach().clamp(0, 1) * 255).round().byte().cpu().numpy()[..., ::-1]

    def inverse_depth(layer: Layer) -> torch.Tensor:
        assert layer.depth is not None
        value = torch.where(layer.alpha > 0.5, 1.0 / layer.depth.clamp_min(1e-3), torch.zeros_like(layer.depth))
        return (value / value.max().clamp_min(1e-6))[..., None].expand(-1, -1, 3)

    assert rendering.static is not None
    assert rendering.dynamic is not None
    top = np.concatenate([picture(rendering.joint.image), picture(rendering.static.image)], 1)
    bottom = np.concatenate([picture(rendering.dynamic.image), picture(inverse_depth(rendering.joint))], 1)
    return np.concatenate([top, bottom])


def main(config: PreviewConfig) -> None:
    """Renders the scene at each moment and writes one contact sheet a moment."""
    if config.frames < 1:
        raise ValueError(f"--frames must be at least 1, got {config.frames}")
    if config.device == "cuda" and not torch.cuda.is_available():
        raise ValueError("--device cuda was asked for, but torch sees no CUDA device; use --device cpu")
    config.out.mkdir(parents=True, exist_ok=True)
    print("The trainer does not exist yet: rendering the built-in scene instead.")
    background = torch.tensor([0.70, 0.78, 0.86], device=config.device)
    settings = RenderSettings(branches=True, depth=True, antialias=True)
    for frame in track(range(config.frames), description="Rendering", disable=not sys.stdout.isatty()):
        time = frame / config.frames
        with torch.no_grad():
            splats = builtin_splats(time).to(config.device)
            rendering = render(splats, builtin_camera(time).to(config.device), background, settings)
        path = config.out / f"{frame:03d}.png"
        if not cv2.imwrite(str(path), contact_sheet(rendering)):
            raise OSError(f"{path} could not be written")
    print(f"{config.frames} pictures (joint | static over dynamic | depth) are in {config.out}")


if __name__ == "__main__":
    try:
        main(tyro.cli(PreviewConfig))
    except (ValueError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        sys.exit(130)

"""Captures opened by their folder, by the name of a built-in one, or as a config says."""

import os
import reprlib
from pathlib import Path

import torch

from warpgs.config import MaskPerturbation, TrainConfig
from warpgs.config.builtin import is_builtin, require_factor
from warpgs.data.capture import Capture
from warpgs.data.loaders import LoadOptions, load_with
from warpgs.synthetic.folder import builtin_folder
from warpgs.synthetic.room import builtin_capture


def capture_folder(data: Path | str, quiet: bool = False, factor: int | None = None) -> Path:
    """The folder of a capture; a built-in one is created on the first call, with the errors of ``builtin_folder``."""
    return builtin_folder(data, quiet, factor) if is_builtin(data) else Path(data)


def load_capture(
    root: Path | str,
    dataset: str | None = None,
    *,
    factor: int | None = None,
    perturbation: MaskPerturbation | None = None,
    cache_frames: int = LoadOptions.cache_frames,
    distortion: bool = LoadOptions.distortion,
    readout: float | None = None,
) -> Capture:
    """Opens a capture: reads cameras and points and checks that every file exists; images are read on use.

    Args:
        root: Folder of the capture, or a built-in one (``config/builtin.py``).
        dataset: Key of ``LOADERS`` (``data/loaders``); recognized from the files if None.
        factor: Downscaling factor of the images; the dataset's default if None.
        perturbation: Perturbation of the training masks; evaluation frames keep the true ones.
        cache_frames: Number of frames to keep in memory.
        distortion: Whether cameras have the distortion and the principal point of their lens; if not, they are pinholes
            with the principal point at the centre of the image. HyperNeRF's captures of two cameras (vrig) have a
            default factor of 4 then, as in Deformable-3DGS.
        readout: See ``Capture.readout``; that of the capture's files, which is 0 without any, if None.

    Raises:
        ValueError: If anything is missing, damaged or inconsistent; one line that names the file.
    """
    if not isinstance(root, str | os.PathLike):
        raise ValueError(f"a capture is opened by the path of its folder, got {reprlib.repr(root)}")
    options = LoadOptions(factor, perturbation or MaskPerturbation(), cache_frames, distortion, readout=readout)
    capture = load_with(capture_folder(root, factor=factor), dataset, options)
    capture.is_builtin = is_builtin(root)
    return capture


def open_capture(config: TrainConfig, quiet: bool = False) -> Capture:
    """The capture of a config, over its background; without one the built-in scene, rendered on the first call.

    Raises:
        ValueError: If a file of the capture is missing or damaged; the message names it.
        OSError: If the built-in scene cannot be written.
    """
    if config.data is not None:
        root = capture_folder(config.data, quiet, config.factor)
    else:
        require_factor("builtin:room", config.factor)
        root = builtin_capture(device=torch.device(config.device or "cpu"), quiet=quiet)
    damage = MaskPerturbation.parse(config.damage_masks)
    options = LoadOptions(
        config.factor,
        damage,
        distortion=config.distortion,
        depth=config.depth,
        readout=config.readout,
        readout_from=config.readout_from,
    )
    capture = load_with(root, config.dataset, options)
    capture.is_builtin = config.data is None or is_builtin(config.data)
    asked = config.background
    return capture if asked == "auto" or asked == "capture" or asked == "mean" else capture.over(asked)

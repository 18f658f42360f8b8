"""Networks that prepare can use where their weights lie on this machine already; nothing is ever downloaded."""

import json
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

MEAN = np.array([0.485, 0.456, 0.406], np.float32)
DEVIATION = np.array([0.229, 0.224, 0.225], np.float32)
"""Of ImageNet's RGB values in [0, 1]; both networks were trained on pictures normalised by them."""


@dataclass(frozen=True)
class Network:
    """A network of the transformers package.

    Attributes:
        option: What asks for it.
        title: For messages.
        kind: ``model_type`` in its config.json.
        model: Its class.
        names: Of its weights in the Hugging Face cache, best first.
    """

    option: str
    title: str
    kind: str
    model: str
    names: tuple[str, ...]


SAM2 = Network(
    "--masks sam2",
    "SAM 2",
    "sam2_video",
    "Sam2VideoModel",
    tuple(f"facebook/sam2.1-hiera-{size}" for size in ("large", "base-plus", "small", "tiny")),
)
DEPTH_ANYTHING = Network(
    "--depth anything",
    "Depth Anything V2",
    "depth_anything",
    "DepthAnythingForDepthEstimation",
    tuple(f"depth-anything/Depth-Anything-V2-{size}-hf" for size in ("Large", "Base", "Small")),
)


def find_weights(network: Network, folder: Path | None) -> Path:
    """The folder with config.json and weights of a network.

    Args:
        network: Which.
        folder: Where to look, in it and in its subfolders; the Hugging Face cache if None.

    Raises:
        ImportError: If the transformers package is missing.
        ValueError: If the weights are not there; says how to get them.
    """
    if find_spec("transformers") is None:
        raise ImportError(f"{network.option} needs the package transformers: pip install 'warpgs[networks]'")
    places = _cached(network) if folder is None else [folder, *sorted(p for p in folder.glob("*") if p.is_dir())]
    found = next((p for p in places if _kind(p) == network.kind and any(p.glob("*.safetensors"))), None)
    if found is None:
        raise ValueError(
            f"{network.option} needs the weights of {network.title}, which are not in "
            f"{folder or 'the Hugging Face cache'}: get them once with `hf download {network.names[0]}`, or name their "
            "folder (config.json and model.safetensors) with --weights"
        )
    return found


def _cached(network: Network) -> list[Path]:
    from huggingface_hub import try_to_load_from_cache  # comes with transformers

    found = [try_to_load_from_cache(name, "config.json") for name in network.names]
    return [Path(path).parent for path in found if isinstance(path, str)]


def _kind(folder: Path) -> str | None:
    try:
        facts = json.loads((folder / "config.json").read_text())
    except (OSError, ValueError):
        return None
    return facts.get("model_type") if isinstance(facts, dict) else None


def load(network: Network, folder: Path) -> Any:
    """The network with its weights, on the GPU if there is one.

    Raises:
        ValueError: If the weights are damaged or incomplete.
    """
    import transformers

    transformers.utils.logging.set_verbosity(transformers.utils.logging.CRITICAL)  # what fails is told below
    transformers.utils.logging.disable_progress_bar()
    kind = getattr(transformers, network.model)
    try:
        model, facts = kind.from_pretrained(
            folder, local_files_only=True, use_safetensors=True, output_loading_info=True
        )
    except Exception as error:  # safetensors has its own
        raise ValueError(f"{folder}: the weights of {network.title} can't be read: {error}") from error
    if missing := facts["missing_keys"]:
        raise ValueError(
            f"{folder}: {len(missing)} tensors of {network.title} are missing, {sorted(missing)[0]} the first"
        )
    return model.eval().to("cuda" if torch.cuda.is_available() else "cpu")


def normalised(image: UInt8[np.ndarray, "H W 3"], width: int, height: int) -> Float[Tensor, "3 h w"]:
    """An RGB picture in another size, less ImageNet's mean, over its deviation."""
    resized = cv2.resize(image, (width, height), interpolation=cv2.INTER_CUBIC)
    values = (resized.astype(np.float32) / 255.0 - MEAN) / DEVIATION
    return torch.from_numpy(np.ascontiguousarray(values.transpose(2, 0, 1)))
